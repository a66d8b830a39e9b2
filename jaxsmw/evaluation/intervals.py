"""Means with bootstrap confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.stats import bootstrap

CONFIDENCE = 0.95
RESAMPLES = 9999


class Interval(NamedTuple):
    """A mean with the lower and upper end of its bootstrap confidence interval, in the unit of the sample.

    The ends are NaN if there is no interval.
    """

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        """The mean and the ends of the interval, with signs and one decimal; a dash if the mean is NaN."""
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

    **Returns:** The mean and its interval with confidence level `CONFIDENCE`, from `RESAMPLES` resamples. The
    ends of the interval are NaN for fewer than three values. The mean is also NaN for an empty sample.
    """
    if len(values) == 0:
        return Interval(np.nan, np.nan, np.nan)
    mean = float(values.mean())
    if len(values) < 3:  # too few for a bootstrap
        return Interval(mean, np.nan, np.nan)
    if np.ptp(values) == 0:  # the BCa interval of equal values is undefined
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
