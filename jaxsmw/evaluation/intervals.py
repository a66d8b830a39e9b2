"""How sure a mean is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.stats import bootstrap

CONFIDENCE = 0.95
RESAMPLES = 9999


class Interval(NamedTuple):
    """A mean difference with its bootstrap confidence interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        """With signs; a dash where there is no mean."""
        if np.isnan(self.mean):
            return "—"
        if np.isnan(self.low):
            return f"{self.mean:+.1f}".replace("-", "−")
        return "{:+.1f} [{:+.1f}, {:+.1f}]".format(*self).replace("-", "−")


def mean_interval(values: Float64[np.ndarray, " p"], seed: int) -> Interval:
    """The mean of a sample and its bias-corrected and accelerated bootstrap interval (Efron 1987).

    `seed` is of the resampling. The interval is NaN for fewer than three values, and all for none.
    """
    if len(values) == 0:
        return Interval(np.nan, np.nan, np.nan)
    mean = float(values.mean())
    if len(values) < 3:  # too few to say anything
        return Interval(mean, np.nan, np.nan)
    if np.ptp(values) == 0:  # as of the default with itself
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
