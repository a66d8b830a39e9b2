"""The search for the right map: one start, a race of hypotheses if that is not certain, and one judge."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.choices import DEFAULT_INITIAL_MAP, Mirror
from jaxsmw.core.arrays import namespace
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.scale import may_be_part, relative_boundary
from jaxsmw.matching.executor import run
from jaxsmw.matching.judge import area_shape_difference, discontinuous_parts, distortion
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search.evidence import NO_EVIDENCE, Evidence, is_in_place, probability, shares
from jaxsmw.matching.search.hypotheses import HYPOTHESES
from jaxsmw.matching.search.race import SMALL_FAULT, Candidate, Kind, different, race
from jaxsmw.matching.search.reading import Reading
from jaxsmw.matching.settings import SearchSettings
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Preset
from jaxsmw.matching.starts import make_start

logger = logging.getLogger("jaxsmw")

# One mesh can be a part of the other if its boundary is longer than that of the other by this factor, both
# relative to the square root of the area.
_LONGER = 1.5
# The largest number of races. The maps of the first race, refined at all vertices, are mended by the second.
_ROUNDS = 2


@dataclass(frozen=True, eq=False)
class Judged(Candidate):
    """A map that was refined at all vertices, and the evidence for it.

    **Attributes:** those of `Candidate`, and

    - `outcome`: the `Outcome` of the stages.
    - `share`: the probability that this map is right if one of the maps of the search is right.
    """

    outcome: Outcome
    share: float = 1.0

    @classmethod
    def of(cls, reading: Reading, outcome: Outcome) -> Judged:
        """Judge the outcome of stages. After a failure, there is no evidence for the map."""
        matches = reading.reduced(outcome.pointwise_map)
        if not outcome.successful:
            return cls(reading, matches, NO_EVIDENCE, outcome)
        return cls(reading, matches, Evidence.of(reading, matches), outcome)

    @property
    def pointwise_map(self) -> Int64[np.ndarray, " m"]:
        """The map of the last stage (m,), 0-based vertices of Y."""
        return self.outcome.pointwise_map

    def with_turns(self) -> list[Judged]:
        """Return this map, and this map with each turn of a symmetric shape. They divide its probability.

        The turns are those of Y or, if Y is a part of X, those of X. The maps have the same evidence, except
        that not all maps of aligned meshes are in place.
        """
        if not self.outcome.successful:
            return [self]
        reading, matches = self.reading, self.pointwise_map
        if reading.prepared.pair.source_is_whole:
            maps = [matches[turn] for turn in reading.x.turns]
        else:
            maps = [turn[matches] for turn in reading.y.turns]
        judged = [self]
        for one in maps:
            turned = reading.reduced(one)
            evidence = self.evidence._replace(in_place=is_in_place(reading, turned))
            judged.append(Judged(reading, turned, evidence, Outcome(one)))
        parts = self.share * _shares_of(judged)
        return [replace(one, share=float(part)) for one, part in zip(judged, parts, strict=True)]


def search(
    prepared: PreparedPair,
    start: Start,
    preset: Preset,
    *,
    mirror: Mirror = "no",
    hypotheses: bool = True,
    outcome: Outcome | None = None,
) -> list[Judged]:
    """Find the right map, and other maps that could be right.

    docs/how_it_works.md explains the search.

    **Arguments:**

    - `prepared`: the prepared pair.
    - `start`: the first initial map.
    - `preset`: the stages, and the settings of the search. Without settings, only the first map is returned.
    - `mirror`: `"auto"` to consider mirror images of X as well.
    - `hypotheses`: whether other initial maps are tried if the map of the first start is uncertain.
    - `outcome`: the outcome of the stages before the final ones, if they have already run.

    **Returns:** Maps that differ from each other, the most probable first.
    """
    outcome = outcome or run(preset.before_final, prepared.spectra, start)
    settings = preset.search
    mirrors = settings is not None and hypotheses and mirror == "auto"
    reading, both_hands = read_pair(prepared, outcome.pointwise_map, mirrors=mirrors)
    if not outcome.successful:
        reading = replace(reading, first=None)
    first = Judged.of(reading, outcome)
    if settings is None:
        return _results([first], start, preset)
    judged = [first]
    certain = settings.certain == 0 or (_ends_the_search(first, settings) and not both_hands)
    readings = readings_of(reading, both_hands=both_hands) if hypotheses and not certain else [reading]
    if not both_hands:
        for part, other in enumerate(readings[1:], 1):
            with suppress(InputError):  # in its unit of length, the part can be too coarse for SHOT
                judged.append(_first(other, preset))
                readings[part] = judged[-1].reading
    for number in range(_ROUNDS):
        if certain:
            break
        logger.info("the map is uncertain, so other maps are tried ...")
        candidates = race(readings, judged, HYPOTHESES if hypotheses and number == 0 else ())
        # A twin can be better if it reads the pair in another way.
        new = [one for one in different([*judged, *candidates]) if one not in judged]
        likely = _likely(new, settings)
        if not likely:
            break
        if number == 0:  # The rivals have passed the race as well.
            again = [_refined(one, preset, settings) for one in judged]
            judged = [one for one in again if one.outcome.successful] or judged
        refined = [_refined(one, preset, settings) for one in likely]
        judged = list(different([*judged, *refined]))
        certain = _certain(judged, settings)
    # Further passes make some wrong maps nearly as good as the right one, so the evidence before them counts.
    before = _shares_of(judged)
    probable = _probable(before, settings)
    judged = [
        _finished(one, preset, settings) if again else one
        for one, again in zip(judged, probable, strict=True)
    ]
    parts = np.sqrt(before * _shares_of(judged))
    parts /= parts.sum() or 1.0
    judged = [replace(one, share=float(part)) for one, part in zip(judged, parts, strict=True)]
    return _results(judged, start, preset)


def _results(judged: Sequence[Judged], start: Start, preset: Preset) -> list[Judged]:
    """Return different maps and their turns, the most probable first. A best turn passes the last stage.

    A start that the user gave tells one turn of a symmetric shape from the others.
    """
    turned = list(judged)
    if start.origin not in ("map", "landmarks", "positions"):
        turned = [turn for one in judged for turn in one.with_turns()]
    best, *others = distinct(turned)
    if all(best.outcome is not one.outcome for one in judged):
        prepared = best.reading.prepared
        outcome = run(preset.before_final[-1:], prepared.spectra, Start(best.pointwise_map))
        best = replace(Judged.of(best.reading, outcome), share=best.share)
    return [best, *others]


def distinct(judged: Iterable[Judged]) -> list[Judged]:
    """Return the maps that differ from all more probable ones, the most probable first.

    A map has the shares of its twins as well. Maps whose refinement failed are left out, unless it is the
    best one.
    """
    found: list[Judged] = []
    for one in sorted(judged, key=lambda one: -one.share):
        twin = next((number for number, other in enumerate(found) if one.is_twin(other)), None)
        if twin is not None:
            found[twin] = replace(found[twin], share=found[twin].share + one.share)
        elif not found or one.outcome.successful:
            found.append(one)
    # The turns of a map have the same probability, up to rounding.
    return sorted(found, key=lambda one: -round(one.share, 6))


def _shares_of(maps: Sequence[Candidate]) -> Float[np.ndarray, " c"]:
    """Return the probability of each of several different maps (c,) to be right, if one of them is."""
    return shares([one.log_odds for one in maps])


def _ends_the_search(first: Judged, settings: SearchSettings) -> bool:
    """Return whether the first map needs no comparison with other maps.

    The probability alone does not suffice, because a map that exchanges two limbs of an animal can be as good
    on most patches as a right map of other animals. Such a map is not nearly isometric, or it tears the limbs
    off.
    """
    if not _certain([first], settings):
        return False
    prepared, matches = first.reading.prepared, first.pointwise_map
    torn_off = prepared.pair.mesh_x.average(discontinuous_parts(prepared.pair, matches))
    distorted = distortion(prepared.pair, matches, prepared.x.spectrum) > settings.certain_distortion
    return bool(torn_off <= SMALL_FAULT and not distorted)


def _certain(judged: Sequence[Judged], settings: SearchSettings) -> bool:
    """Return whether the best map is right with a large enough probability."""
    best = max(one.log_odds for one in judged)
    return bool(_shares_of(judged).max() * probability(best) >= settings.certain)


def _likely(maps: Sequence[Kind], settings: SearchSettings) -> list[Kind]:
    """Return the most probable maps, the best first."""
    parts = _shares_of(maps)
    order = np.argsort(-parts, kind="stable")[: settings.finalists]
    return [maps[number] for number in order[_probable(parts[order], settings)]]


def _probable(parts: Float[np.ndarray, " c"], settings: SearchSettings) -> Bool[np.ndarray, " c"]:
    """Return which maps are not much less probable than the best one, given the share of each (c,)."""
    return parts >= settings.likely * parts.max(initial=0.0)


def read_pair(
    prepared: PreparedPair, first: Int64[np.ndarray, " m"], *, mirrors: bool
) -> tuple[Reading, bool]:
    """Return the reading of a pair with its first map (m,), and whether both hands must be compared.

    Of asymmetric shapes, the wrong hand can have a good map, so both hands are compared if `mirrors` permits
    it. The reading then has no first map, because agreement with this map would prefer its hand. A shape that
    is nearly its own mirror image, such as a person, needs no second hand: its left stays its left.
    """
    reading = Reading.of(prepared)
    if mirrors and reading.is_asymmetric():
        return reading, True
    return reading.with_first(first), False


def readings_of(reading: Reading, *, both_hands: bool) -> list[Reading]:
    """Return a reading and those with a shape as a part of the other, perhaps with both hands of X."""
    readings = [reading, *_as_parts(reading)]
    return [*readings, *(one.mirror() for one in readings)] if both_hands else readings


def _as_parts(reading: Reading) -> Iterator[Reading]:
    """Yield the readings in which one of two shapes that were called full is a part of the other.

    The meshes have the same unit of length in the first reading, and different units in the second.
    """
    prepared, pair = reading.prepared, reading.prepared.pair
    # The boundaries of cuts through fused surfaces do not count.
    shorter, longer = sorted(map(relative_boundary, prepared.given.meshes))
    if pair.partial or longer < _LONGER * shorter or not any(map(may_be_part, prepared.given.meshes)):
        return
    known: list[float] = []
    for scale in (1.0, "unknown"):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # an uncertain scale gives a poor map, which loses
                part = Pair.make(*pair.meshes, partial=True, scale=scale)
            if all(abs(np.log(part.scale / other)) > _SAME_SCALE for other in known):
                known.append(part.scale)
                yield replace(Reading.of(prepared.as_part(part)), two_parts=False)
        except InputError:  # no scale can be estimated, or the closed mesh is the smaller one
            continue


# Two scales are the same if their logarithms differ by less.
_SAME_SCALE = 0.05


def _first(reading: Reading, preset: Preset) -> Judged:
    """Match a reading from a first start of its own, as if it were the only one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the given meshes have already caused the same warnings
        reading = reading.described(preset)
        start = make_start(reading.prepared, DEFAULT_INITIAL_MAP)
    outcome = run(preset.before_final, reading.prepared.spectra, start)
    return Judged.of(reading.with_first(outcome.pointwise_map) if outcome.successful else reading, outcome)


def _refined(candidate: Candidate, preset: Preset, settings: SearchSettings) -> Judged:
    """Run the repeated stages of a preset from a map of samples."""
    reading = candidate.reading.described(preset)
    start = Start(reading.extended(candidate.matches))
    spectra, _ = _spectra(reading, start.pointwise_map, settings)
    return Judged.of(reading, run(preset.repeated, spectra, start))


def _finished(judged: Judged, preset: Preset, settings: SearchSettings) -> Judged:
    """Run further passes for shapes that differ in form, because their maps converge slowly.

    **Returns:** The map after the last pass, or the given map if no pass runs, if a pass fails, or if the
    passes make the map less probable.
    """
    if not judged.outcome.successful or judged.reading.prepared.pair.partial:
        return judged
    spectra, change = _spectra(judged.reading, judged.pointwise_map, settings)
    if change < settings.non_isometric:
        return judged
    passes = [preset.repeated] * settings.passes
    if change >= settings.coarse_from:
        *before, last = preset.repeated
        passes = [(*before, last.coarsened(levels)) for levels in settings.coarse_levels]
        passes.append(preset.repeated)
    outcome = judged.outcome
    for stages in passes:
        again = run(stages, spectra, Start(outcome.pointwise_map))
        if not again.successful:
            return judged
        first = max(0, len(outcome.runs) - len(stages))
        outcome = Outcome(outcome.initial_map, outcome.runs[:first]).followed_by(again)
    # Coarse passes worsen some maps of shapes with topological noise.
    after = Judged.of(judged.reading, outcome)
    return after if after.log_odds >= judged.log_odds - settings.pass_tolerance else judged


def _spectra(
    reading: Reading, pointwise_map: Int64[np.ndarray, " m"], settings: SearchSettings
) -> tuple[SpectralPair, float]:
    """Return the spectra by which a map (m,) is refined, and its area-based shape difference.

    Creases of shapes that differ much in form are not alike, so the crease eigenvectors of full shapes are
    then zero. They need no further program.
    """

    def zeroed(spectrum: Spectrum) -> Spectrum:
        creases = spectrum.crease_eigenvectors
        return spectrum.with_crease_eigenvectors(
            None if creases is None else namespace(creases).zeros_like(creases)
        )

    prepared, spectra = reading.prepared, reading.prepared.spectra
    change = area_shape_difference(prepared.pair, pointwise_map, *spectra.both)
    if prepared.pair.partial or change < settings.without_creases_from:
        return spectra, change
    return replace(spectra, x=zeroed(spectra.x), y=zeroed(spectra.y)), change
