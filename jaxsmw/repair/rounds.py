"""Refinement in stages, with the repair of maps that look wrong."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import jax
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.preparation import PreparedPair
from jaxsmw.repair.alternatives import Alternatives
from jaxsmw.repair.outcome import Judge, Outcome
from jaxsmw.repair.settings import WITHOUT_REPAIR, RepairSettings
from jaxsmw.runtime.padding import pad_rows
from jaxsmw.stage import Stage

logger = logging.getLogger("jaxsmw")


def refine_in_stages(
    prepared: PreparedPair,
    stages: Sequence[Stage],
    repair: RepairSettings | None = None,
    *,
    alternatives: Iterable[Int64[np.ndarray, " m"]] | None = None,
    refined: Outcome | None = None,
    history: bool = False,
) -> Outcome:
    """Refine the initial map of a pair by the given stages in order, and repair a map that looks wrong.

    If the initial map exchanges symmetric limbs, refinement does not correct this error, because both limbs
    have the same shape. With `repair`, the outcome is checked for orientation reversal and discontinuities
    (`jaxsmw.repair.scores`). If the outcome looks wrong, repair takes the following three steps. The stage at
    position `repair.stage` is called the repeated stage.

    1. Rounds: each round runs the repeated stage and all later stages again. In the repeated stage, vertices
       with a fault in the previous map have weight zero. If a map has both orientation reversal and
       discontinuous parts, successive rounds leave out these two faults alternately.
    2. Fallback: the repeated stage and all later stages run once more, from the best outcome of the rounds.
       The repeated stage then uses the numbers of eigenvectors in `fallback_levels`. The map of the fallback
       is kept if its score is better. The map of the fallback is also kept if it looks right and its score is
       worse by less than `score_tolerance`. In all other cases, the best map of the rounds is kept.
    3. Alternatives: if the outcome still looks wrong, alternative initial maps are refined up to and
       including the repeated stage. The repeated stage then runs again in up to `rough_rounds` rounds. Up to
       `finalists` different outcomes with the best scores go through all later stages and through repair.
       Among the outcomes that look right, the outcome with the best score is returned. If no outcome looks
       right, but at least `agreeing` initial maps lead to the same map, this map is returned. If fewer
       initial maps agree, the outcome with the best score is returned.

    **Arguments:**

    - `prepared`: the pair with its spectra and its initial map.
    - `stages`: the stages, in the order in which they run.
    - `repair`: the settings of the repair. With None, the outcome is judged but not repaired.
    - `alternatives`: alternative initial maps (m,), as an iterable that is consumed only if needed. By
      default, the maps come from `jaxsmw.repair.alternatives` if the initial map is `"shot"`. For other
      initial maps, there are no alternatives by default.
    - `refined`: the outcome of all stages from the initial map, for example from `refine_batch`. By default,
      the stages run first.
    - `history`: whether each refinement records its iterations; see `jaxsmw.refine`.

    **Returns:** An `Outcome` with padded maps. Refinement stops at the first stage that fails.

    **Raises:** `InputError` if alternative initial maps cannot be computed.
    """
    views = [prepared.view(stage) for stage in stages]
    runner = _Runner(prepared, list(zip(views, stages, strict=True)), history)
    first = prepared.padded_map(prepared.initial_map)
    finest = max((of_x for of_x, _ in views), key=lambda of_x: of_x.eigenvalues.shape[0])
    judge = Judge(prepared.pair, finest, repair or WITHOUT_REPAIR)
    if repair is None:
        return judge.judged(refined or runner.run(0, Outcome([], first)))
    repairer = _Repairer(runner, judge, repair)
    best = judge.judged(refined) if refined else repairer.finished(repairer.begun(first))
    if not (best.successful and best.suspicious):
        return best
    logger.info(
        "limbs may be swapped (distortion %.3f; correct maps have at most %.2f)",
        best.distortion,
        repair.suspicious,
    )
    if alternatives is None:
        alternatives = ()
        if isinstance(prepared.init, str) and prepared.init == "shot":
            proxies = Alternatives(prepared, repair)
            repairer = replace(repairer, judge=replace(judge, measure_deformation=proxies.deformation))
            alternatives = proxies.best(prepared.unpadded_map(best.pointwise_map))
    return repairer.best_of_alternatives(best, map(prepared.padded_map, alternatives))


_View = tuple[Spectrum, Spectrum]


@dataclass(frozen=True)
class _Runner:
    """Runs stages on one pair. `steps` contains each stage with the two spectra on which it runs."""

    prepared: PreparedPair
    steps: list[tuple[_View, Stage]]
    history: bool

    def run(self, first: int, before: Outcome, last: int | None = None) -> Outcome:
        """Run the stages from position `first` up to, but not including, position `last`.

        **Returns:** The outcome `before`, extended by the refinements of the stages that ran.
        """
        for view, stage in self.steps[first:last]:
            if not before.successful:
                break
            before = self.run_one(view, stage, before)
        return before

    def run_one(self, view: _View, stage: Stage, before: Outcome) -> Outcome:
        """Run one more stage and return the extended outcome."""
        found = stage.run(
            *view,
            before.pointwise_map,
            self.prepared.samples,
            partial=self.prepared.pair.partial,
            history=self.history,
        )
        return before._replace(refinements=[*before.refinements, found])


@dataclass(frozen=True)
class _Repairer:
    """A repairer of outcomes. The repairer repeats the stage at position `settings.stage` and all later
    stages.
    """

    runner: _Runner
    judge: Judge
    settings: RepairSettings

    def begun(self, first: Int[Array, " m"]) -> Outcome:
        """Run all stages up to and including the repeated stage, without judging the outcome."""
        return self.runner.run(0, Outcome([], first), self.settings.stage + 1)

    def finished(self, outcome: Outcome) -> Outcome:
        """Run all stages after the repeated stage and return the judged outcome."""
        return self.judge.judged(self.runner.run(self.settings.stage + 1, outcome))

    def repaired(self, outcome: Outcome) -> Outcome:
        """Repair a finished outcome by rounds and by the fallback."""
        outcome = self._without_faults(outcome, self.settings.rounds, finish=True)
        (spectrum_x, _), stage = self.runner.steps[self.settings.stage]
        fallback = stage.with_levels(
            tuple(min(level, stage.number_of_eigenvectors) for level in self.settings.fallback_levels)
        )
        last = self.finished(self._repeated(outcome, spectrum_x, fallback))
        # The fallback depends less on the faults of previous maps than the rounds do. The outcome of the
        # fallback is preferred if it looks right and its score is not much worse. Upside-down maps are not
        # preferred, because their scores are worse by more than `score_tolerance`.
        score = self.judge.score
        preferred = (
            self.judge.looks_right(last) and score(last) < score(outcome) + self.settings.score_tolerance
        )
        best = last if preferred else min(outcome, last, key=score)
        return best._replace(suspicious=not self.judge.looks_right(best))

    def best_of_alternatives(self, best: Outcome, alternatives: Iterable[Int[Array, " m"]]) -> Outcome:
        """Finish alternative maps, and return the best of these outcomes and `best`, repaired if needed."""
        finished = [self.judge.judged(best)]
        for number, start in enumerate(islice(alternatives, self.settings.finalists), 2):
            logger.info("map %d ...", number)
            outcome = self.runner.run(self.settings.stage, Outcome([], start))
            finished.append(self.judge.judged(outcome))
        best = min(finished, key=self.judge.score)
        if not self.judge.looks_right(best):
            best = self.repaired(best)
        return best._replace(suspicious=not self.judge.looks_right(best))

    def _without_faults(self, outcome: Outcome, rounds: int, *, finish: bool = False) -> Outcome:
        """Run rounds of repair and return the best outcome.

        Each round chooses one kind of fault of the previous map. Vertices with this fault have weight
        zero. If `finish` is True, each round also runs all stages after the repeated stage.
        """
        (spectrum_x, _), stage = self.runner.steps[self.settings.stage]
        areas = np.asarray(spectrum_x.vertex_areas)
        best = last = outcome
        for done in range(rounds):
            if not (last.successful and best.suspicious and (faults := self.judge.faults(last))):
                break
            fault = faults[done % len(faults)]
            sound = np.where(pad_rows(fault, len(areas)), 0, areas)
            last = self._repeated(last, replace(spectrum_x, vertex_areas=jax.device_put(sound)), stage)
            last = self.finished(last) if finish else self.judge.judged(last)
            best = min(best, last, key=self.judge.score)
        return best

    def _repeated(self, outcome: Outcome, spectrum_x: Spectrum, stage: Stage) -> Outcome:
        """Run `stage` instead of the repeated stage, starting from the final map of an outcome.

        In the returned outcome, `distortion` and `suspicious` are still those of the given outcome.
        """
        (_, spectrum_y), _ = self.runner.steps[self.settings.stage]
        found = self.runner.run_one((spectrum_x, spectrum_y), stage, Outcome([], outcome.pointwise_map))
        before = outcome.refinements[: self.settings.stage]
        return outcome._replace(refinements=[*before, *found.refinements])
