"""The judge: what shows without ground truth whether a map is right, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsmw.geometry.alignment import nearest_rotations
from jaxsmw.matching.search.proxies import SampleMap
from jaxsmw.matching.search.reading import Reading

# The weights of the evidence in the log-odds, from a regression of right maps (scripts/learn_judge.py).
_INTERCEPT, _DEFORMATION, _DISSIMILARITY, _IN_PLACE, _DISCONTINUITY = -0.2, -1.9, -2.7, 1.1, -3.0
# How much differences of log-odds count between maps of the same pair.
_CONTRAST = 7.0
# This number is added to the deformation, because even right maps of samples have such a deformation.
_LEAST = 0.01
# The distance of the points on normals from the surface, in units of the square root of the area.
_THICKNESS = 0.1
# A map is in place if the mean distance between the given positions of samples and of their matches is below
# this number of units of Y.
_NEAR = 0.1
# The matches of two neighbours are far apart if their distance along the surface is larger, in units of the
# square root of the area.
_FAR = 0.3


class Evidence(NamedTuple):
    """What shows whether a map is right, measured on the samples.

    **Attributes:**

    - `deformation`: how far the map is from a rigid motion around each sample, from 0 to 1; see
      `deformation`.
    - `dissimilarity`: the mean squared difference between the SHOT descriptors of samples and of their
      matches, divided by its mean for random matches. It is 0 for congruent shapes.
    - `in_place`: whether matches have nearly the same given positions, because the meshes were aligned.
    - `discontinuity`: the share of neighbouring samples whose matches are far apart; see `discontinuity`.
    """

    deformation: float
    dissimilarity: float
    in_place: bool
    discontinuity: float

    @classmethod
    def of(cls, reading: Reading, matches: SampleMap) -> Evidence:
        """Measure a map of samples (s,)."""
        x, y, of_patches = reading.x, reading.y, deformation(reading, matches)
        areas = _overlapping_areas(reading, of_patches)
        of_x, of_y = (spectrum.descriptors for spectrum in reading.spectra.both)
        dissimilarity = 1.0  # as for random matches
        if of_x is not None and of_y is not None:
            # The descriptors are principal components of variance 1.
            differences = ((np.asarray(of_x) - np.asarray(of_y)[matches]) ** 2).mean(axis=1) / 2
            dissimilarity = float(areas @ differences)
        offsets = np.linalg.norm(x.positions * x.unit - y.positions[matches] * y.unit, axis=1)
        in_place = bool(areas @ offsets < _NEAR * y.unit) and not x.mirrored
        torn = discontinuity(reading, matches)
        return cls(float(areas @ of_patches), dissimilarity, in_place, torn)

    @property
    def log_odds(self) -> float:
        """The logarithm of the odds that the map is right, rather than none."""
        return float(
            _INTERCEPT
            + _DEFORMATION * np.log(self.deformation + _LEAST)
            + _DISSIMILARITY * self.dissimilarity
            + _IN_PLACE * self.in_place
            + _DISCONTINUITY * np.sqrt(self.discontinuity)
        )


NO_EVIDENCE = Evidence(np.inf, np.inf, in_place=False, discontinuity=1.0)
"""What there is for a map whose refinement failed. Its log-odds are minus infinity."""


def probabilities(log_odds: Sequence[float]) -> Float[np.ndarray, " c"]:
    """Return the probability of each of several different maps to be right, given the log-odds of each (c,).

    The log-odds of the best map say how probable it is that one of the maps is right. This probability is
    divided among the maps by a multinomial logistic model, in which differences of the log-odds count
    `_CONTRAST` times, because maps of the same pair are easier to compare than maps of different pairs.
    """
    odds = np.asarray(log_odds, float)
    if not np.isfinite(odds).any():
        return np.zeros(len(odds))
    shares = np.exp(_CONTRAST * (odds - odds.max()))
    return shares / shares.sum() / (1 + np.exp(-odds.max()))


def _overlapping_areas(reading: Reading, deformations: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    """Return the areas of the samples of X that count, with the sum 1.

    If Y is a part of X, only the least deformed patches count, with the area of Y in total.
    """
    areas, pair = reading.x.areas, reading.prepared.pair
    area_x, area_y = pair.areas
    if not pair.partial or area_y >= area_x:
        return areas
    order = np.argsort(deformations, kind="stable")
    before = np.cumsum(areas[order]) - areas[order]
    counted = np.zeros(len(areas))
    counted[order] = np.where(before < area_y / area_x, areas[order], 0)
    return counted / counted.sum()


def discontinuity(reading: Reading, matches: SampleMap) -> float:
    """Measure how much a map tears neighbouring samples apart, as where exchanged limbs begin.

    **Returns:** The share of the neighbouring pairs of samples of X whose matches are far apart along the
    surface of Y, from 0 to 1. A pair counts by the product of the areas of its samples.
    """
    pairs, weights = reading.neighbours
    first, second = matches[pairs]
    return float(weights @ (reading.y.distances[first, second] > _FAR))


def deformation(reading: Reading, matches: SampleMap) -> Float[np.ndarray, " s"]:
    """Measure how far a map deviates from a rigid motion on the patch around each sample of X.

    A rotation and a translation carry the patch as close as possible to its matches. The deformation is the
    mean squared distance that remains, divided by the size of the patch. The size is the variance of the
    patch's positions plus the variance of its matches. For each sample, two points on its normal count, one
    on either side of the surface, because a reflection of a thin flat patch would only turn it over.

    A map that bends a body at its joints deforms most patches little. Mirrored and upside-down maps deform
    most patches. The deformation is an "as-rigid-as-possible" energy (Sorkine, Alexa 2007).

    **Returns:** The deformation of each patch (s,), from 0 for a rigid motion to at most 1.
    """
    source, target = reading.x.positions, reading.y.positions[matches]
    products = np.einsum("sa,sb->sab", source, target)
    # The sums over two points on the normal of each sample, one on either side of the surface.
    products += _THICKNESS**2 * np.einsum("sa,sb->sab", reading.x.normals, reading.y.normals[matches])
    squares = np.sum(source**2 + target**2, axis=1, keepdims=True) + 2 * _THICKNESS**2
    columns = reading.patches @ np.hstack([source, target, products.reshape(-1, 9), squares])
    mean_x, mean_y = columns[:, :3], columns[:, 3:6]
    moments = columns[:, 6:15].reshape(-1, 3, 3) - np.einsum("sa,sb->sab", mean_x, mean_y)
    size = columns[:, 15] - np.sum(mean_x**2 + mean_y**2, axis=1)
    _, traces = nearest_rotations(moments)
    return np.clip((size - 2 * traces) / np.maximum(size, np.finfo(float).tiny), 0, 1)
