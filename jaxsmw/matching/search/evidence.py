"""The judge: what shows without ground truth whether a map is right, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsmw.geometry.alignment import patch_motions
from jaxsmw.matching.search.proxies import Proxy, SampleMap
from jaxsmw.matching.search.reading import Reading

# The weights of the evidence in the log-odds, from a regression of right maps (scripts/learn_judge.py).
_INTERCEPT, _DEFORMATION, _IN_PLACE, _DISCONTINUITY = -6.6, -3.5, 1.4, -6.7
_UNCOVERED, _AGREEMENT = -3.1, 1.3
# The weight of the logarithm of the inconsistency, which only counts between maps of the same pair.
_INCONSISTENCY = -5.0
# Smaller inconsistencies are equal. Exact maps have none, but neither has the identity from the mirror image
# of a body to the body, which is wrong.
_CONSISTENT = 0.003
# How much differences of log-odds count between maps of the same pair.
_CONTRAST = 5.0
# This number is added to the deformation, because even right maps of samples have such a deformation.
_LEAST = 0.01
# A map is in place if the mean distance between the given positions of samples and of their matches is below
# this number of units of Y.
_NEAR = 0.1
# The matches of two neighbours are far apart if their distance along the surface is larger, in units of the
# square root of the area.
_FAR = 0.3
# A sample of Y is uncovered if no match is nearer, in the same units.
_COVERED = 0.1


class Evidence(NamedTuple):
    """What shows whether a map is right, measured on the samples.

    A map that is right has a right reverse map, in which each sample of Y has the sample of X whose match is
    nearest. The deformation is the mean over the map and its reverse map. The discontinuity is that of the
    map that tears less: the right map tears a surface that is fused with itself, but its reverse map does
    not. If one shape is a part of the other, both are those of the map. If X is the whole, they are measured
    on the samples of X to which the reverse map takes the part.

    **Attributes:**

    - `deformation`: how far the map is from a rigid motion around each sample, from 0 to 1; see
      `deformation`.
    - `in_place`: whether matches have nearly the same given positions, because the meshes were aligned.
    - `discontinuity`: the share of neighbouring samples whose matches are far apart; see `discontinuity`.
    - `uncovered`: the share of Y's area, from 0 to 1, that is far from all matches, less the share that has
      no counterpart on a partial X.
    - `agreement`: the share of X's area, from 0 to 1, on which the map agrees with the map of the first
      start. It is 0 for maps of the other hand.
    """

    deformation: float
    in_place: bool
    discontinuity: float
    uncovered: float
    agreement: float

    @classmethod
    def of(cls, reading: Reading, matches: SampleMap) -> Evidence:
        """Measure a map of samples (s,)."""
        x, y, pair = reading.x, reading.y, reading.prepared.pair
        to_matches = y.distances[:, matches]
        reverse, areas_x, lacking = to_matches.argmin(axis=1), x.areas, 0.0
        if pair.source_is_whole:
            areas_x = np.bincount(reverse, weights=y.areas, minlength=len(x.areas)).astype(float)
        elif pair.partial:
            lacking = 1 - pair.areas[0] / pair.areas[1]
        deformed = [areas_x @ deformation(x, y, matches)]
        torn = [discontinuity(x, y, matches, areas_x)]
        if not pair.partial:
            deformed.append(y.areas @ deformation(y, x, reverse))
            torn.append(discontinuity(y, x, reverse, y.areas))
        uncovered = float(y.areas @ (to_matches.min(axis=1) > _COVERED))
        offsets = np.linalg.norm(x.positions * x.unit - y.positions[matches] * y.unit, axis=1)
        return cls(
            deformation=float(np.mean(deformed)),
            in_place=bool(areas_x @ offsets < _NEAR * y.unit) and not x.mirrored,
            discontinuity=min(torn),
            uncovered=max(0.0, uncovered - lacking),
            agreement=reading.agreement(matches),
        )

    @property
    def log_odds(self) -> float:
        """The logarithm of the odds that the map is right, rather than none."""
        return float(
            _INTERCEPT
            + _DEFORMATION * np.log(self.deformation + _LEAST)
            + _IN_PLACE * self.in_place
            + _DISCONTINUITY * np.sqrt(self.discontinuity)
            + _UNCOVERED * np.sqrt(self.uncovered)
            + _AGREEMENT * self.agreement
        )


NO_EVIDENCE = Evidence(np.inf, in_place=False, discontinuity=1.0, uncovered=1.0, agreement=0.0)
"""What there is for a map whose refinement failed. Its log-odds are minus infinity."""


def shares(
    log_odds: Sequence[float], inconsistencies: Sequence[float] | None = None
) -> Float[np.ndarray, " c"]:
    """Return the probability of each of several different maps (c,) to be right, if one of them is.

    The maps are compared by a multinomial logistic model, in which differences of the log-odds (c,) count
    `_CONTRAST` times, because maps of the same pair are easier to compare than maps of different pairs.

    If the inconsistencies of the maps are given (c,), more consistent maps are preferred. A map that
    exchanges two legs in opposite poses can deform patches less than the right map, but it stretches the
    surface between the legs.
    """
    preferences = np.asarray(log_odds, float)
    if not np.isfinite(preferences).any():
        return np.zeros(len(preferences))
    if inconsistencies is not None:
        preferences = preferences + _INCONSISTENCY * np.log(np.maximum(inconsistencies, _CONSISTENT))
    exponentials = np.exp(_CONTRAST * (preferences - preferences.max()))
    return exponentials / exponentials.sum()


def probability(log_odds: float) -> float:
    """Return the probability with the given log-odds.

    The log-odds of the best map of a pair say how probable it is that one of its maps is right.
    """
    return float(1 / (1 + np.exp(-log_odds)))


def discontinuity(source: Proxy, target: Proxy, matches: SampleMap, areas: Float[np.ndarray, " s"]) -> float:
    """Measure how much a map tears neighbouring samples apart, as where exchanged limbs begin.

    **Returns:** The share of the neighbouring pairs of source samples whose matches are far apart along the
    surface of the target, from 0 to 1. A pair counts by the product of the `areas` of its samples (s,).
    """
    first, second = source.neighbours
    weights = areas[first] * areas[second]
    torn = target.distances[matches[first], matches[second]] > _FAR
    return float(weights @ torn / max(weights.sum(), np.finfo(float).tiny))


def deformation(source: Proxy, target: Proxy, matches: SampleMap) -> Float[np.ndarray, " s"]:
    """Measure how far a map deviates from a rigid motion on the patch around each source sample.

    A rotation and a translation carry the patch as close as possible to its matches (`patch_motions`). The
    deformation is the distance that remains. A map that bends a body at its joints deforms most patches
    little. Mirrored and upside-down maps deform most patches. The deformation is an "as-rigid-as-possible"
    energy (Sorkine, Alexa 2007).

    **Returns:** The deformation of each patch (s,), from 0 for a rigid motion to at most 1.
    """
    goals = target.positions[matches], target.normals[matches]
    return patch_motions(source.patches, source.positions, source.normals, *goals).deformations
