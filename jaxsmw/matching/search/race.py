"""The race: maps of a pair are refined together on proxies, and the best go on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool

from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.errors import InputError
from jaxsmw.matching.executor import run_all
from jaxsmw.matching.judge import discontinuous_parts, orientation_reversal
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.search.evidence import Evidence
from jaxsmw.matching.search.hypotheses import HYPOTHESES, Hypothesis
from jaxsmw.matching.search.proxies import SampleMap
from jaxsmw.matching.search.reading import COMMON, NUMBER_OF_DESCRIPTORS, Reading
from jaxsmw.matching.stages import Stage

# The routes by which each map is refined, and the stages by which the given number of the best maps of full
# shapes is refined once more. Between animals that differ much in form, functional maps of wavelets move the
# right map away from its place, and the regression alone does not. Coarse levels of registration move limbs
# that finer levels leave in place. (Entry R49 of docs/research_log.md)
_REGRESSION = Stage(FeatureRegression((20, 20, 26, 35)), number_of_descriptors=NUMBER_OF_DESCRIPTORS)
_ROUTES = ((Stage(WaveletPreservation(), number_of_eigenvectors=50), _REGRESSION), (_REGRESSION,))
_LAST_STAGES = (Stage(Registration((8, 12, 20, 35, 60)), number_of_descriptors=NUMBER_OF_DESCRIPTORS),)
_REGISTERED = 10
# The number of the best maps that are mended in each round, and the number of rounds.
_MENDED, _ROUNDS = 4, 2
# Two maps are different if they differ on at least this share of the area.
DIFFERENT_AREA = 0.02
SMALL_FAULT = 0.002
"""Faults on a smaller share of the area are not mended."""
# Faults on more than the first share of the area are not mended either. A map that reverses more than the
# second share of the area is tried for the other hand.
_LARGE, _MOSTLY = 0.5, 0.4
# The evidence of opposite hands for two shapes that are nearly their own mirror images.
SAME_HAND = -2.5


@dataclass(frozen=True, eq=False)
class Candidate:
    """A map of the samples of a reading, and its `Evidence`."""

    reading: Reading
    matches: SampleMap
    evidence: Evidence

    @property
    def log_odds(self) -> float:
        """The log-odds that the map is right."""
        return self.evidence.log_odds

    def is_twin(self, other: Candidate) -> bool:
        """Return whether two maps differ on less than 2 % of the area, or on less than 25 % for two parts.

        The matches of points without a counterpart are arbitrary.
        """
        least = COMMON if self.reading.two_parts else DIFFERENT_AREA
        return self.reading.difference(self.matches, other.matches) < least


Kind = TypeVar("Kind", bound=Candidate)


def race(
    readings: Sequence[Reading], known: Iterable[Candidate], hypotheses: Sequence[Hypothesis] = HYPOTHESES
) -> list[Candidate]:
    """Refine maps of samples together, and return different maps, the best first.

    **Arguments:**

    - `readings`: the readings of the pair.
    - `known`: known maps of samples.
    - `hypotheses`: the kinds of hypothesis that are refined as well, for each reading.
    """
    starts = [task for reading in readings for task in _hypotheses(reading, hypotheses)]
    found = _refined([*starts, *map(_Task.of, known)])
    moved: list[Candidate] = []
    for _ in range(_ROUNDS):
        new = [best for best in islice(different(found), _MENDED) if best not in moved]
        found += _refined([move for best in new for move in _moves(best, readings)])
        moved += new
    best = list(islice(different(found), _REGISTERED))
    # Registration improves most maps. It makes a limb of others collapse, so they stay as they were as well.
    # Registration also moves parts away from their place on different bodies.
    full = [_Task.of(one) for one in best if not one.reading.prepared.pair.partial]
    return list(different([*best, *_refined(full, (_LAST_STAGES,))]))


def hand_evidence(reading: Reading) -> float:
    """Return the log-odds that X and Y have opposite hands, from the best map of each hand.

    Shapes that are nearly their own mirror images are not compared. They have the same hand.
    """
    if not reading.is_asymmetric():
        return SAME_HAND
    direct, mirrored = (
        max((one.log_odds for one in _refined(list(_hypotheses(hand)))), default=-np.inf)
        for hand in (reading, reading.mirror())
    )
    return mirrored - direct if np.isfinite(direct + mirrored) else SAME_HAND


def different(candidates: Sequence[Kind]) -> Iterator[Kind]:
    """Yield candidates that differ from all better ones, the best first."""
    yielded: list[Kind] = []
    for candidate in sorted(candidates, key=lambda candidate: -candidate.log_odds):
        if not any(candidate.is_twin(other) for other in yielded):
            yielded.append(candidate)
            yield candidate


class _Task(NamedTuple):
    """A map of samples to be refined, perhaps without some samples of X in its first functional map."""

    reading: Reading
    matches: SampleMap
    excluded: Bool[np.ndarray, " s"] | None = None

    @classmethod
    def of(cls, candidate: Candidate) -> _Task:
        return cls(candidate.reading, candidate.matches)


def _hypotheses(reading: Reading, hypotheses: Sequence[Hypothesis] = HYPOTHESES) -> Iterator[_Task]:
    for hypothesis in hypotheses:
        with suppress(InputError):  # the samples can be too sparse for SHOT of this radius
            for matches in hypothesis(reading):
                yield _Task(reading, matches)


def _refined(tasks: Sequence[_Task], routes: Sequence[Sequence[Stage]] = _ROUTES) -> list[Candidate]:
    """Refine maps of samples by each route, and judge those whose refinement succeeds."""
    if not tasks:
        return []
    fewest = min(len(side.areas) for task in tasks for side in (task.reading.x, task.reading.y))
    starts = [(task.reading.spectra, Start(task.matches, excluded=task.excluded)) for task in tasks]
    return [
        Candidate(task.reading, outcome.pointwise_map, Evidence.of(task.reading, outcome.pointwise_map))
        for route in routes
        for task, outcome in zip(
            tasks, run_all([stage.fitted(fewest) for stage in route], starts), strict=True
        )
        if outcome.successful
    ]


def _moves(candidate: Candidate, readings: Sequence[Reading]) -> Iterator[_Task]:
    """Yield what may mend a map: to leave out its faults, or to read it with the other hand."""
    reading, matches = candidate.reading, candidate.matches
    pair, spectrum = reading.prepared.pair, reading.prepared.x.spectrum.truncate(50)
    everywhere = reading.extended(matches)
    reversed_ = orientation_reversal(pair, everywhere, spectrum)
    for fault in (reversed_, discontinuous_parts(pair, everywhere)):
        if SMALL_FAULT < pair.mesh_x.average(fault) < _LARGE:
            yield _Task(reading, matches, fault[reading.x.samples.vertices])
    if pair.mesh_x.average(reversed_) <= _MOSTLY:
        return
    for other in readings:
        if other.x.distances is reading.x.distances and other.x.mirrored != reading.x.mirrored:
            yield _Task(other, matches)
