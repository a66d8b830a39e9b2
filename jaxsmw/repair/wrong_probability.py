"""Estimates the probability that a map is wrong on a part of the body, without ground truth."""

from __future__ import annotations

import math

from jaxsmw.repair.settings import WrongProbabilitySettings


def wrong_probability(
    distortion: float,
    mean_expected_error: float,
    settings: WrongProbabilitySettings = WrongProbabilitySettings(),  # noqa: B008 (immutable)
) -> float:
    """Estimate the probability that a map is wrong, without ground truth.

    A map is called wrong if its errors exceed 0.25 times the square root of Y's area on at least 2 % of X's
    area. Maps with swapped limbs, mirrored maps and upside-down maps are wrong in this sense. A map with only
    small errors is not wrong in this sense. The estimate is a logistic regression on the logarithms of the
    distortion and of the mean expected error.

    **Arguments:**

    - `distortion`: the distortion of the map (`jaxsmw.repair.scores.distortion`), at least 0.
    - `mean_expected_error`: the mean of `jaxsmw.repair.expected_error`, in units of the square root of the
      area.
    - `settings`: the coefficients of the regression.

    **Returns:** A probability, from 0 to 1. `docs/accuracy.md` shows the calibration.
    """
    tiny = 1e-6
    evidence = (
        settings.intercept
        + settings.distortion_weight * math.log(max(distortion, tiny))
        + settings.expected_error_weight * math.log(max(mean_expected_error, tiny))
    )
    return 1 / (1 + math.exp(-min(max(evidence, -500), 500)))
