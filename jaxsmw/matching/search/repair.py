"""The repair of maps that look wrong, and further passes for maps between non-isometric shapes."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import Bool, Int64

from jaxsmw.core.arrays import namespace
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.matching.executor import run
from jaxsmw.matching.judge import Judge, Scored
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search.alternatives import Alternatives
from jaxsmw.matching.settings import RepairSettings
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Preset, Stage

logger = logging.getLogger("jaxsmw")


def repair_map(prepared: PreparedPair, start: Start, preset: Preset, best: Scored) -> Scored:
    """Repair a map that looks wrong.

    docs/how_it_works.md explains the steps. Alternative maps are tried first, and only for the initial map
    `"shot"`. Rounds of repair follow if the best map still looks wrong. If the map of two near-isometric full
    shapes looks wrong after that, both steps run again with crease eigenvectors. Some wrong maps look right.
    For two full shapes, a map whose distortion is at least `compared` is therefore compared with alternative
    maps as well.

    **Arguments:**

    - `prepared`: the prepared pair.
    - `start`: the initial map.
    - `preset`: the stages and the repair. Without repair, the map is returned as it is.
    - `best`: the judged map of `preset.before_final`. A failed map is returned as it is.

    **Raises:** `InputError` if alternative maps cannot be computed.
    """
    repair = preset.repair
    if repair is None or not best.successful:
        return best
    judge = Judge.of(prepared, preset.before_final, preset.criteria)
    repeater = _Repeater(prepared.spectra, preset.repeated, judge, repair)
    has_alternatives = start.has_alternatives and repair.finalists > 0
    compares = has_alternatives and not prepared.pair.partial
    if best.suspicious:
        logger.info(
            "limbs may be swapped (distortion %.3f; correct maps have at most %.2f, and faults on less than "
            "%.0f %% of the area)",
            best.distortion,
            repair.judge.suspicious,
            100 * repair.judge.suspicious_area,
        )
    elif compares and best.distortion >= repair.compared:
        logger.info("the map is compared with alternative maps (distortion %.3f)", best.distortion)
    else:
        return best
    if not has_alternatives:
        return repeater.repaired([best])
    proxies = Alternatives(prepared, repair)
    judge = replace(judge, measure_deformation=proxies.deformation)
    repeater, usual = replace(repeater, judge=judge), best.pointwise_map
    alternatives = proxies.best(usual, only_better=not best.suspicious)
    best = repeater.repaired([judge.measured(best.outcome, suspicious=best.suspicious)], alternatives)
    tries_again = best.suspicious and proxies.has_creases and not prepared.pair.partial
    # Between shapes that differ more, crease eigenvectors make some maps worse. (Table R45)
    if tries_again and judge.area_change(best) < repair.non_isometric:
        logger.info("further alternative maps are computed with crease eigenvectors ...")
        if maps := list(proxies.best(usual, creased=True)):
            best = min(best, repeater.repaired([], maps), key=judge.score)
    return replace(best, rivals=proxies.different(best, best.rivals))


def refine_further(prepared: PreparedPair, start: Start, preset: Preset, scored: Scored) -> Scored:
    """Run further passes for non-isometric shapes, because their maps converge slowly.

    docs/how_it_works.md explains the passes, which also run from the `rivals` of the map.

    **Arguments:**

    - `prepared`: the prepared pair.
    - `start`: the initial map.
    - `preset`: the stages and the repair. Without repair, no pass runs.
    - `scored`: a result of `repair_map`.

    **Returns:** The map after the last pass, as suspicious as the given map. The given map is returned if no
    pass runs, if a pass fails, or if the passes worsen the score by more than `pass_tolerance`.
    """
    repair = preset.repair
    if repair is None or not scored.successful:
        return scored
    judge = Judge.of(prepared, preset.before_final, preset.criteria)
    change = judge.area_change(scored)
    # Rigidly aligned full shapes differ in form, not in pose. Coarse passes lower the errors of such pairs
    # even if the area-based shape difference is small. (Entry R24)
    aligned = start.is_rigid and not prepared.pair.partial
    if change < repair.non_isometric and not aligned:
        return scored
    repeater = _Repeater(prepared.spectra, preset.repeated, judge, repair)
    if change >= repair.without_creases_from:
        repeater = replace(repeater, spectra=_without_creases(repeater.spectra))
    passes = [repeater] * repair.passes
    if change >= repair.coarse_from or aligned:
        passes = [*map(repeater.coarse, repair.coarse_levels), repeater]
    if not passes:
        return scored

    def passed(before: Scored) -> Scored:
        outcome = before.outcome
        for one in passes:
            if outcome.successful:
                outcome = one.repeated(outcome)
        return judge.measured(outcome)

    after = passed(scored)
    # After the passes, scores distinguish right maps from wrong maps better than before. (Entry R36)
    best_rival = min(map(passed, scored.rivals), key=judge.score, default=after)
    if judge.score(best_rival) < judge.score(after) - repair.rival_margin * scored.suspicious:
        logger.info("another map has a better score after further passes")
        after = best_rival
    # Coarse passes worsen some maps of shapes with topological noise.
    if not judge.score(after) <= judge.score(replace(scored, deformation=0.0)) + repair.pass_tolerance:
        return scored
    # Passes also lower the distortion of wrong maps. Therefore a low distortion after the passes does not
    # show that a map is right. (Entry R36)
    return replace(after, suspicious=scored.suspicious)


def _without_creases(spectra: SpectralPair) -> SpectralPair:
    """Return the spectra with crease eigenvectors of zero, which need no further program."""

    def zeroed(spectrum: Spectrum) -> Spectrum:
        creases = spectrum.crease_eigenvectors
        return spectrum.with_crease_eigenvectors(
            None if creases is None else namespace(creases).zeros_like(creases)
        )

    return replace(spectra, x=zeroed(spectra.x), y=zeroed(spectra.y))


@dataclass(frozen=True, eq=False)
class _Repeater:
    """Runs the repeated stages again from the maps of outcomes, and judges the results."""

    spectra: SpectralPair
    stages: tuple[Stage, ...]
    judge: Judge
    settings: RepairSettings

    def coarse(self, levels: tuple[int, ...]) -> _Repeater:
        """Return a repeater whose last stage has the given levels."""
        *before, last = self.stages
        return replace(self, stages=(*before, last.coarsened(levels)))

    def repeated(self, outcome: Outcome, excluded: Bool[np.ndarray, " m"] | None = None) -> Outcome:
        """Run the repeated stages from the map of an outcome, without a mask of vertices of X (m,)."""
        start = Start(outcome.pointwise_map, excluded=excluded)
        again = run(self.stages, self.spectra, start)
        first = max(0, len(outcome.runs) - len(self.stages))
        return Outcome(outcome.initial_map, outcome.runs[:first]).followed_by(again)

    def repaired(
        self, known: Sequence[Scored], alternatives: Iterable[Int64[np.ndarray, " m"]] = ()
    ) -> Scored:
        """Return the best of judged maps and alternative maps, repaired by rounds if it looks wrong."""
        maps = [*known]
        for number, alternative in enumerate(islice(alternatives, self.settings.finalists), 1):
            logger.info("alternative map %d ...", number)
            maps.append(self.judge.judged(self.repeated(Outcome(alternative))))
        best, *others = sorted(maps, key=self.judge.score)
        if not self.judge.looks_right(best):
            # The second-best map is repaired as well, because a right map with faults can have a worse score
            # than a wrong map without faults.
            best, *others = sorted(map(self._without_faults, (best, *others[:1])), key=self.judge.score)
        wrong = not self.judge.looks_right(best)
        limit = self.judge.score(best) + self.settings.rival_margin
        close = (one for one in others if self.judge.score(one) <= limit)
        rivals = tuple(one for one in close if wrong or self.judge.looks_right(one))
        left = "; limbs may still be swapped" if wrong else ""
        logger.info("the best of %d maps has distortion %.2f%s", len(maps), best.distortion, left)
        return replace(best, suspicious=wrong, rivals=rivals)

    def _without_faults(self, scored: Scored) -> Scored:
        """Run rounds, each without the vertices of one kind of fault, and return the best map."""
        best = last = scored
        for done in range(self.settings.rounds):
            if not (last.successful and best.suspicious):
                break
            if not (faults := self.judge.faults(last.pointwise_map)):
                break
            last = self.judge.judged(self.repeated(last.outcome, faults[done % len(faults)]))
            best = min(best, last, key=self.judge.score)
        return best
