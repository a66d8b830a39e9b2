"""Means with bootstrap confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.stats import bootstrap

CONFIDENCE = 0.95
RESAMPLES = 9999


class Interval(NamedTuple):
    """A mean and its 95 % bootstrap confidence interval; `str` gives both as text, as in `+1.8 [+0.7, +4.8]`.

    **Attributes:**

    - `mean`: the mean.
    - `low`, `high`: the two ends of the interval; NaN for fewer than three values.
    """

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        """The mean and the interval as text, with signs and one decimal."""
        if np.isnan(self.mean):
            return "—"
        if np.isnan(self.low):
            return f"{self.mean:+.1f}".replace("-", "−")
        return "{:+.1f} [{:+.1f}, {:+.1f}]".format(*self).replace("-", "−")


def mean_interval(values: Float64[np.ndarray, " p"], seed: int) -> Interval:
    """Return the mean of a sample (p,), and its confidence interval by the BCa bootstrap (Efron 1987)."""
    if len(values) == 0:
        return Interval(np.nan, np.nan, np.nan)
    mean = float(values.mean())
    if len(values) < 3:  # a sample of one or two values is too small for a bootstrap interval
        return Interval(mean, np.nan, np.nan)
    if np.ptp(values) == 0:  # the bootstrap interval of equal values is undefined
        return Interval(mean, mean, mean)
    ends = bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="BCa",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(mean, float(ends.low), float(ends.high))
