"""Refinement in stages, with the repair of maps that look wrong."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Int64

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.matching.judge import Judge, Outcome
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search.alternatives import Alternatives
from jaxsmw.matching.settings import WITHOUT_REPAIR, RepairSettings
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.padding import pad_rows

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
    (`jaxsmw.matching.scores`). If the outcome looks wrong, repair takes the following two steps. The stage at
    position `repair.stage` is called the repeated stage.

    1. Alternatives: `jaxsmw.matching.search.alternatives` refines many initial maps on a thousand samples.
      The best of
       these maps, at most `finalists`, are then refined by the repeated stage and all later stages. The
       outcome with the best score is kept, which can also be the outcome of the original initial map. If the
       kept outcome looks right, repair ends.
    2. Rounds: each round runs the repeated stage and all later stages again. Each round repairs one kind of
       fault of the previous map, orientation reversal or discontinuities. The first functional map of the
       repeated stage is computed without the vertices that have this fault. If a map has both kinds of fault,
       the first round repairs the orientation reversal, and further rounds alternate between the two kinds.
       If the second-best outcome of step 1 has faults, this outcome is repaired as well. The outcome with the
       best score is used.

    If the map of two near-isometric full shapes still looks wrong, both steps run a second time. The
    alternatives are then refined with crease eigenvectors as well (Table R45). The better outcome is kept.

    Some wrong maps look right. For two full shapes with the initial map `"shot"`, alternatives are therefore
    computed if the distortion of the outcome is at least `compared`. Only alternatives that differ from the
    map, and precede all similar maps in the order of their scores, are then refined at all vertices.

    Maps between non-isometric shapes need further passes; see `refine_further`.

    **Arguments:**

    - `prepared`: the pair with its spectra and its initial map.
    - `stages`: the stages, in the order in which they run.
    - `repair`: the settings of the repair. With None, the outcome is judged but not repaired.
    - `alternatives`: alternative maps (m,), the best first, as an iterable that is consumed only if needed.
      By default, the maps come from `jaxsmw.matching.search.alternatives` if the initial map is `"shot"`. For
      other initial maps, there are no alternatives by default.
    - `refined`: the outcome of all stages if they have already run, such as a result of `refine_batch`. By
      default, the function runs the stages itself.
    - `history`: whether each refinement records its iterations; see `jaxsmw.refine`.

    **Returns:** An `Outcome` with padded maps. Refinement stops at the first stage that fails.

    **Raises:** `InputError` if alternative maps cannot be computed.
    """
    runner, judge = _runner_and_judge(prepared, stages, repair or WITHOUT_REPAIR, history)
    first = prepared.padded_map(prepared.initial_map)
    best = judge.judged(refined or runner.run(0, Outcome([], first)))
    if repair is None or not best.successful:
        return best
    assert best.distortion is not None
    from_shot = isinstance(prepared.init, str) and prepared.init == "shot"
    computes_alternatives = alternatives is None and from_shot and repair.finalists > 0
    compares = computes_alternatives and not prepared.pair.partial
    if best.suspicious:
        logger.info(
            "limbs may be swapped (distortion %.3f; correct maps have at most %.2f, and faults on less than "
            "%.0f %% of the area)",
            best.distortion,
            repair.suspicious,
            100 * repair.suspicious_area,
        )
    elif compares and best.distortion >= repair.compared:
        logger.info("the map is compared with alternative maps (distortion %.3f)", best.distortion)
    else:
        return best
    if not computes_alternatives:
        repairer = _Repairer(runner, judge, repair)
        return repairer.repaired([best], map(prepared.padded_map, alternatives or ()))
    proxies = Alternatives(prepared, repair)
    judge = replace(judge, measure_deformation=proxies.deformation)
    repairer, usual = _Repairer(runner, judge, repair), best.unpadded_map(prepared.pair)
    found = proxies.best(usual, only_better=not best.suspicious)
    best = repairer.repaired([judge.measured(best)], map(prepared.padded_map, found))
    tries_again = best.suspicious and proxies.has_creases and not prepared.pair.partial
    # Between shapes that differ more, crease eigenvectors make some maps worse. (Table R45)
    if tries_again and judge.area_change(best) < repair.non_isometric:
        logger.info("further alternative maps are computed with crease eigenvectors ...")
        maps = [prepared.padded_map(one) for one in proxies.best(usual, creased=True)]
        if maps:
            best = min(best, repairer.repaired([], maps), key=judge.score)
    return best._replace(rivals=proxies.different(best, best.rivals))


def refine_further(
    prepared: PreparedPair,
    stages: Sequence[Stage],
    repair: RepairSettings | None,
    outcome: Outcome,
    *,
    history: bool = False,
) -> Outcome:
    """Refine the map between non-isometric shapes further, because such maps converge slowly.

    In each pass, the repeated stage and all later stages run again. `RepairSettings` explains how many passes
    run, which passes are coarse, and which passes use crease eigenvectors. The passes also run from the
    `rivals` of the outcome. A rival replaces the map if its score after the passes is better. If the map is
    suspicious, the score must be better by more than `repair.rival_margin`.

    **Arguments:**

    - `prepared`: the pair with its spectra and the kind of its initial map.
    - `stages`: the stages from which the outcome was computed.
    - `repair`: the settings of the repair, or None for no passes.
    - `outcome`: an outcome of `refine_in_stages`.
    - `history`: whether each refinement records its iterations; see `jaxsmw.refine`.

    **Returns:** The `Outcome` of the last pass. The attribute `suspicious` is copied from the given outcome.
    The given outcome is returned if no pass runs, if a pass fails, or if the passes make the score (without
    the deformation) worse by more than `repair.pass_tolerance`.
    """
    if repair is None or not outcome.successful:
        return outcome
    runner, judge = _runner_and_judge(prepared, stages, repair, history)
    change = judge.area_change(outcome)
    # Rigidly aligned full shapes differ in form, not in pose. Coarse passes lower the errors of such pairs
    # even if the area-based shape difference is small. (Entry R24)
    aligned = isinstance(prepared.init, str) and prepared.init == "aligned" and not prepared.pair.partial
    if change < repair.non_isometric and not aligned:
        return outcome
    if change >= repair.without_creases_from:
        runner = runner.without_creases()
    runners = [runner] * repair.passes
    if change >= repair.coarse_from or aligned:
        runners = [*map(runner.coarse, repair.coarse_levels), runner]
    if not runners:
        return outcome

    def passed(start: Outcome) -> Outcome:
        for one in runners:
            if start.successful:
                start = _Repairer(one, judge, repair).repeated(start)
        return judge.measured(start)

    after = passed(outcome)
    # After the passes, scores distinguish right maps from wrong maps better than before. (Entry R36)
    best_rival = min(map(passed, outcome.rivals), key=judge.score, default=after)
    if judge.score(best_rival) < judge.score(after) - repair.rival_margin * outcome.suspicious:
        logger.info("another map has a better score after further passes")
        after = best_rival
    # Coarse passes worsen some maps of shapes with topological noise.
    if not judge.score(after) <= judge.score(outcome._replace(deformation=0.0)) + repair.pass_tolerance:
        return outcome
    # Passes also lower the distortion of wrong maps. Therefore a low distortion after the passes does not
    # show that a map is right. (Entry R36)
    return after._replace(suspicious=outcome.suspicious)


def finish(
    prepared: PreparedPair,
    stages: Sequence[Stage],
    final_stages: Sequence[Stage],
    repair: RepairSettings | None,
    outcome: Outcome,
    *,
    history: bool = False,
) -> Outcome:
    """Refine a map further, and run the final stages; see `RepairSettings.final_stages`.

    **Arguments:**

    - `final_stages`: the final stages, in the order in which they run.
    - the other arguments: see `refine_further`.

    **Returns:** The `Outcome` with the distortion of the final map. The attribute `suspicious` is copied from
    the given outcome.
    """
    outcome = refine_further(prepared, stages, repair, outcome, history=history)
    if not final_stages:
        return outcome
    runner, judge = _runner_and_judge(prepared, final_stages, repair or WITHOUT_REPAIR, history)
    return judge.measured(runner.run(0, outcome))


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

    def without_creases(self) -> _Runner:
        """Return a runner of the same stages, in which all crease eigenvectors are zero.

        Zeros instead of no crease eigenvectors keep the sizes of arrays, so no further program is compiled.
        """

        def zeroed(spectrum: Spectrum) -> Spectrum:
            creases = spectrum.crease_eigenvectors
            return spectrum.with_crease_eigenvectors(None if creases is None else jnp.zeros_like(creases))

        steps = [((zeroed(x), zeroed(y)), stage) for (x, y), stage in self.steps]
        return replace(self, steps=steps)

    def coarse(self, levels: tuple[int, ...]) -> _Runner:
        """Return a runner whose last stage has the given levels. A refiner without levels is not changed."""
        *before, (_, last) = self.steps
        coarse = with_coarse_levels(last, levels)
        return replace(self, steps=[*before, (self.prepared.view(coarse), coarse)])


def with_coarse_levels(stage: Stage, levels: tuple[int, ...]) -> Stage:
    """Return the stage with other levels. No level exceeds the number of eigenvectors of the stage.

    A stage whose refiner has no levels is not changed.
    """
    if not stage.refiner.levels:
        return stage
    return stage.with_levels(tuple(min(level, stage.number_of_eigenvectors) for level in levels))


def _runner_and_judge(
    prepared: PreparedPair, stages: Sequence[Stage], settings: RepairSettings, history: bool
) -> tuple[_Runner, Judge]:
    """Return the runner of the stages, and the judge of their outcomes."""
    views = [prepared.view(stage) for stage in stages]
    finest = max(views, key=lambda view: view[0].eigenvalues.shape[0])
    runner = _Runner(prepared, list(zip(views, stages, strict=True)), history)
    return runner, Judge(prepared.pair, *finest, settings)


@dataclass(frozen=True)
class _Repairer:
    """A repairer of outcomes, which repeats the stage at position `settings.stage` and all later stages."""

    runner: _Runner
    judge: Judge
    settings: RepairSettings

    def repaired(self, known: Sequence[Outcome], alternatives: Iterable[Int[Array, " m"]]) -> Outcome:
        """Return the best of judged outcomes and alternative maps, repaired by rounds if it looks wrong."""
        outcomes = [*known]
        for number, start in enumerate(islice(alternatives, self.settings.finalists), 1):
            logger.info("alternative map %d ...", number)
            outcomes.append(self._from_repeated(Outcome([], start)))
        best, *others = sorted(outcomes, key=self.judge.score)
        if not self.judge.looks_right(best):
            # The second-best map is repaired as well, because a right map with faults can have a worse score
            # than a wrong map without faults.
            best, *others = sorted(map(self._without_faults, (best, *others[:1])), key=self.judge.score)
        wrong = not self.judge.looks_right(best)
        limit = self.judge.score(best) + self.settings.rival_margin
        close = (one for one in others if self.judge.score(one) <= limit)
        rivals = tuple(one for one in close if wrong or self.judge.looks_right(one))
        best = best._replace(suspicious=wrong, rivals=rivals)
        left = "; limbs may still be swapped" if best.suspicious else ""
        logger.info("the best of %d maps has distortion %.2f%s", len(outcomes), best.distortion, left)
        return best

    def _without_faults(self, outcome: Outcome) -> Outcome:
        """Run rounds of repair and return the best outcome.

        Each round chooses one kind of fault of the previous map. The first functional map of the repeated
        stage is computed without the vertices with this fault. Later iterations match all samples again.
        """
        best = last = outcome
        for done in range(self.settings.rounds):
            if not (last.successful and best.suspicious and (faults := self.judge.faults(last))):
                break
            last = self._from_repeated(last, faults[done % len(faults)])
            best = min(best, last, key=self.judge.score)
        return best

    def _from_repeated(self, outcome: Outcome, excluded: Bool[np.ndarray, " m"] | None = None) -> Outcome:
        """Run the repeated stage and all later stages from the map of an outcome, and judge the result."""
        return self.judge.judged(self.repeated(outcome, excluded))

    def repeated(self, outcome: Outcome, excluded: Bool[np.ndarray, " m"] | None = None) -> Outcome:
        """Run the repeated stage and all later stages from the map of an outcome.

        **Arguments:**

        - `outcome`: the outcome. If the outcome contains refinements of all stages, the refinements before
          the repeated stage are kept.
        - `excluded`: a mask of the vertices of X (m,) that the repeated stage leaves out. If the stage uses
          samples, the vertices are left out only in its first functional map.
        """
        position = self.settings.stage
        (spectrum_x, spectrum_y), stage = self.runner.steps[position]
        if excluded is not None:
            spectrum_x = spectrum_x.excluding(jnp.asarray(pad_rows(excluded, len(spectrum_x.mask))))
        before = Outcome([], outcome.pointwise_map)
        repeated = self.runner.run_one((spectrum_x, spectrum_y), stage, before)
        finished = self.runner.run(position + 1, repeated)
        kept = outcome.refinements[:position] if len(outcome.refinements) == len(self.runner.steps) else []
        return Outcome([*kept, *finished.refinements], outcome.initial_map)
