"""The judge: what shows without ground truth whether a map is right, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsmw.geometry.alignment import patch_motions
from jaxsmw.matching.search.proxies import Proxy, SampleMap
from jaxsmw.matching.search.reading import COMMON, Reading

# The weights of `Evidence.features` in the log-odds, and those for two parts of a body. They follow
# regressions (scripts/learn_judge.py), with the changes that entry R49 of docs/research_log.md explains.
_WEIGHTS = (-7.6, -2.5, -3.5, -1.7, 2.0, 2.0)
_WEIGHTS_OF_TWO_PARTS = (-10.3, -2.1, 0.0, 0.0, 4.8, 2.0)
# How much differences of log-odds count between maps of the same pair.
_CONTRAST = 5.0
# Between full shapes, a larger agreement counts no more. Right maps of different animals agree with the first
# map on half of the area, and maps that take a head to a tail on a quarter. (Entry R49)
_AGREEING = 0.4
# These numbers are added to the deformation and to the change of orientations, because even right maps of
# samples have as much.
_LEAST_DEFORMATION, _LEAST_CHANGE = 0.01, 0.05
# A map is in place if the mean distance between the given positions of samples and of their matches exceeds
# that of the nearest samples by less than this number of units of Y.
_NEAR = 0.023
# A sample of Y is uncovered if no match is nearer, in units of the square root of the area.
_COVERED = 0.1
# The least number of extremities from which sides are seen. With fewer of them, all maps have this change of
# orientations, which lies between those of right and of wrong maps.
_FEWEST_ENDS, _UNKNOWN_CHANGE = 3, 0.2


class Evidence(NamedTuple):
    """What shows whether a map is right, measured on the samples.

    A map that is right has a right reverse map, in which each sample of Y has the sample of X whose match is
    nearest. The deformation and the change of orientations are means over the map and its reverse map. If one
    shape is a part of the other, the reverse map is not defined everywhere. The deformation is then that of
    the map, on the samples of the part, or on the samples of X to which the reverse map takes the part. The
    change of orientations is that of the map from the part. If both shapes are parts of a body, no region of
    which is known to have a counterpart, the deformation is that of the least deformed quarter of the area.

    **Attributes:**

    - `deformation`: how far the map is from a rigid motion around each sample, from 0 to 1; see
      `deformation`.
    - `uncovered`: the share of Y's area, from 0 to 1, that is far from all matches, less the share that has
      no counterpart on a partial X.
    - `orientation_change`: how often the map exchanges the sides of the body, such as belly and back, from 0
      to 1; see `orientation_change`.
    - `agreement`: the share of X's area, from 0 to 1, on which the map agrees with the first map of its
      reading. It is 0.2 for all maps if both hands are compared.
    - `in_place`: whether matches are hardly farther away than the nearest samples, in the given positions,
      because the meshes were aligned.
    - `partial`, `two_parts`: whether one shape is read as a part, and whether both are parts of a body.
    """

    deformation: float
    uncovered: float
    orientation_change: float
    agreement: float
    in_place: bool
    partial: bool = False
    two_parts: bool = False

    @classmethod
    def of(cls, reading: Reading, matches: SampleMap) -> Evidence:
        """Measure a map of samples (s,)."""
        x, y, pair = reading.x, reading.y, reading.prepared.pair
        reverse, areas_x = reading.reverse(matches), reading.shared_areas(matches)
        deformed = [_mean(deformation(x, y, matches), areas_x, COMMON if reading.two_parts else 1.0)]
        ways = [(x, y, matches), (y, x, reverse)]
        if pair.partial:
            ways = [ways[pair.source_is_whole]]
        else:
            deformed.append(y.areas @ deformation(y, x, reverse))
        to_matches = y.distances[np.arange(len(reverse)), matches[reverse]]
        uncovered = float(y.areas @ (to_matches > _COVERED))
        lacking = max(0.0, 1 - pair.areas[0] / pair.areas[1])
        return cls(
            deformation=float(np.mean(deformed)),
            uncovered=max(0.0, uncovered - lacking),
            orientation_change=float(np.mean([orientation_change(*way) for way in ways])),
            agreement=reading.agreement(matches),
            in_place=is_in_place(reading, matches),
            partial=pair.partial,
            two_parts=reading.two_parts,
        )

    @property
    def features(self) -> Float[np.ndarray, " f"]:
        """What the log-odds depend on linearly, with 1 for the intercept first."""
        deformation = np.log(self.deformation + _LEAST_DEFORMATION)
        orientation_change = np.log(self.orientation_change + _LEAST_CHANGE)
        uncovered, agreement = np.sqrt(self.uncovered), min(self.agreement / _AGREEING, 1.0)
        if self.partial:
            agreement = (1 + self.agreement) / 2  # the first maps of parts are wrong more often (entry R49)
        if self.two_parts:
            # Any region can lack a counterpart, and extremities can lie on cuts. Right maps agree widely.
            orientation_change, uncovered, agreement = 0.0, 0.0, self.agreement
        return np.array([1.0, deformation, uncovered, orientation_change, agreement, self.in_place])

    @property
    def log_odds(self) -> float:
        """The logarithm of the odds that the map is right, rather than none."""
        return float((_WEIGHTS_OF_TWO_PARTS if self.two_parts else _WEIGHTS) @ self.features)


NO_EVIDENCE = Evidence(np.inf, uncovered=1.0, orientation_change=1.0, agreement=0.0, in_place=False)
"""What there is for a map whose refinement failed. Its log-odds are minus infinity."""


def shares(log_odds: Sequence[float]) -> Float[np.ndarray, " c"]:
    """Return the probability of each of several different maps (c,) to be right, if one of them is.

    The maps are compared by a multinomial logistic model, in which differences of the log-odds (c,) count
    `_CONTRAST` times, because maps of the same pair are easier to compare than maps of different pairs.
    """
    preferences = np.asarray(log_odds, float)
    if not np.isfinite(preferences).any():
        return np.zeros(len(preferences))
    exponentials = np.exp(_CONTRAST * (preferences - preferences.max()))
    return exponentials / exponentials.sum()


def probability(log_odds: float) -> float:
    """Return the probability with the given log-odds.

    The log-odds of the best map of a pair say how probable it is that one of its maps is right.
    """
    return float(1 / (1 + np.exp(-log_odds)))


def is_in_place(reading: Reading, matches: SampleMap) -> bool:
    """Return whether matches are hardly farther away than the nearest samples, in the given positions."""
    excess = reading.shared_areas(matches) @ reading.excess(matches)
    return not reading.prepared.mirrored and bool(excess < _NEAR)


def _mean(values: Float[np.ndarray, " s"], areas: Float[np.ndarray, " s"], share: float) -> float:
    """Return the mean of the smallest values on a share of the area."""
    order = np.argsort(values)
    until = np.minimum(np.cumsum(areas[order]), share)
    return float(np.diff(until, prepend=0.0) @ values[order] / share)


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


def orientation_change(source: Proxy, target: Proxy, matches: SampleMap) -> float:
    """Measure how often a map exchanges the sides of a body, such as belly and back, or left and right.

    The side of a sample is its orientation with respect to each two extremities of the source
    (`Proxy.orientations`). The side of its match is that with respect to the matches of these extremities. A
    map that exchanges two limbs, or that turns a head, exchanges sides although it deforms few patches.

    **Returns:** The share of the extremity pairs for which a sample and its match are on opposite sides,
    averaged over the area, from 0 to 1. A pair counts by the product of both volumes, because sides are
    uncertain where a volume is small. With fewer than three extremities, the share is 0.2: the two ends of
    a long body lie in opposite directions, so all volumes are small.
    """
    ends = source.extremities.samples
    if len(ends) < _FEWEST_ENDS:
        return _UNKNOWN_CHANGE
    first, second = np.triu_indices(len(ends), 1)
    ours = source.sides[:, first, second]
    theirs = target.orientations(matches[ends])[matches][:, first, second]
    same, either = (ours * theirs).sum(axis=1), np.abs(ours * theirs).sum(axis=1)
    return float(source.areas @ (1 - same / np.maximum(either, np.finfo(float).tiny))) / 2
