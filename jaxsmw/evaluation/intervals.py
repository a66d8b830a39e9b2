"""Means with bootstrap confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.stats import bootstrap

CONFIDENCE = 0.95
RESAMPLES = 9999


class Interval(NamedTuple):
    """A mean with the ends of its bootstrap confidence interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        """The mean and the interval with signs; a dash if the mean is NaN."""
        if np.isnan(self.mean):
            return "—"
        if np.isnan(self.low):
            return f"{self.mean:+.1f}".replace("-", "−")
        return "{:+.1f} [{:+.1f}, {:+.1f}]".format(*self).replace("-", "−")


def mean_interval(values: Float64[np.ndarray, " p"], seed: int) -> Interval:
    """Returns the mean of a sample and its bias-corrected and accelerated bootstrap interval (Efron 1987).

    **Arguments:**

    - `values`: the sample (p,).
    - `seed`: the seed of the resampling.

    **Returns:** The mean and its interval of confidence `CONFIDENCE`. For fewer than three values the
    interval is NaN; for no values the mean is NaN, too.
    """
    if len(values) == 0:
        return Interval(np.nan, np.nan, np.nan)
    mean = float(values.mean())
    if len(values) < 3:  # too few for a bootstrap
        return Interval(mean, np.nan, np.nan)
    if np.ptp(values) == 0:  # for which the BCa interval is undefined
        return Interval(mean, mean, mean)
    found = bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="BCa",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(mean, float(found.low), float(found.high))
