"""Methods of refinement in one or more stages, each a call of `jaxsmw.refine`, under names of their own."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial as partial_function
from itertools import islice
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Int, Int64

from jaxsmw.core.refinement import Refinement, Refiner, Samples, WaveletPreservation, refine
from jaxsmw.core.refiners.coarse_to_fine import CoarseToFine
from jaxsmw.core.refiners.feature_regression import FeatureRegression, Regression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.shot import SHOT_DIMENSION
from jaxsmw.repair.faults import alike, distinct, flaw, reversed_orientation, torn_off
from jaxsmw.runtime.batches import pad_rows
from jaxsmw.runtime.compilation import compiled

logger = logging.getLogger("jaxsmw")


@dataclass(frozen=True)
class Stage:
    """One call of `jaxsmw.refine`.

    **Attributes:**

    - `refiner`: the method, for example `WaveletPreservation(bank=Meyer(8))`.
    - `number_of_eigenvectors`: k of both shapes.
    - `number_of_descriptors`: how many principal components of SHOT the refiner is given.
    - `iterations`: how many; at least 1.
    - `number_of_samples`: take turns on so many samples of each shape, and search all vertices at the end.
    - `stop_when_unchanged`: see `jaxsmw.refine`.
    - `mending`: what is done at last where the outcome of this stage and those after it looks as if limbs
      were swapped, and repeating these stages without the swapped matches does not help: see
      `refine_in_stages`. Of as many eigenvectors, descriptors and samples. One stage of several may have it.

    **Raises:** `InputError` for what cannot work.
    """

    refiner: Refiner = field(default_factory=WaveletPreservation)
    number_of_eigenvectors: int = 100
    number_of_descriptors: int = 0
    iterations: int = 3
    number_of_samples: int | None = None
    stop_when_unchanged: bool = False
    mending: Stage | None = None

    def __post_init__(self) -> None:
        for name in ("number_of_eigenvectors", "number_of_descriptors", "iterations", "number_of_samples"):
            value = getattr(self, name)
            if value is None and name == "number_of_samples":
                continue
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise InputError(f"{name} is {value!r}; give a whole number.")
            object.__setattr__(self, name, int(value))
        if not isinstance(self.mending, Stage | None):
            raise InputError(f"mending is {self.mending!r}; give a Stage.")
        if self.number_of_eigenvectors < 1:
            raise InputError(f"{self.number_of_eigenvectors} eigenvectors were asked for; give at least 1.")
        if not isinstance(self.refiner, Refiner):
            raise InputError(
                f"refiner is {self.refiner!r}; give a Refiner such as WaveletPreservation(bank=Meyer(8))."
            )
        if self.iterations < 1:
            raise InputError(f"{self.iterations} iterations were asked for; at least 1 is needed.")
        if not 0 <= self.number_of_descriptors <= SHOT_DIMENSION:
            raise InputError(
                f"{self.number_of_descriptors} descriptors were asked for; SHOT has {SHOT_DIMENSION}."
            )
        if self.mending is not None and self._sizes != self.mending._sizes:
            raise InputError(
                f"a stage with {self._sizes} is to be mended by one with {self.mending._sizes}: give both "
                "the same."
            )
        if self.mending is not None and self.mending.mending is not None:
            raise InputError("mending is a stage that has mending, too: leave that out.")
        if self.number_of_samples is not None and self.number_of_samples < self.number_of_eigenvectors:
            raise InputError(
                f"{self.number_of_samples} samples cannot tell {self.number_of_eigenvectors} eigenvectors "
                "apart; use more samples (five per eigenvector is usual) or fewer eigenvectors."
            )

    @property
    def _sizes(self) -> str:
        samples = self.number_of_samples or "no"
        return (
            f"{self.number_of_eigenvectors} eigenvectors, {self.number_of_descriptors} descriptors and "
            f"{samples} samples"
        )

    @property
    def settings(self) -> dict[str, Any]:
        """What `jaxsmw.refine` is told beside arrays."""
        return {
            "refiner": self.refiner,
            "iterations": self.iterations,
            "stop_when_unchanged": self.stop_when_unchanged,
        }

    def without_descriptors(self) -> Stage:
        """The same by eigenvectors alone."""
        mending = None if self.mending is None else self.mending.without_descriptors()
        return replace(self, number_of_descriptors=0, mending=mending)

    def view(
        self, spectrum_x: Spectrum, spectrum_y: Spectrum, *, partial: bool = False
    ) -> tuple[Spectrum, Spectrum]:
        """Two shapes as this stage sees them; of a partial pair what both spectra cover."""
        spectra, seen = (spectrum_x, spectrum_y), []
        for spectrum in spectra:
            descriptors = None
            if self.number_of_descriptors and spectrum.descriptors is not None:
                descriptors = spectrum.descriptors[:, : self.number_of_descriptors]
            seen.append(spectrum.truncate(self.number_of_eigenvectors).with_descriptors(descriptors))
        fewer = [now.eigenvalues.shape != s.eigenvalues.shape for now, s in zip(seen, spectra, strict=True)]
        return common_range(*seen) if partial and any(fewer) else (seen[0], seen[1])


def common_range(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Spectrum, Spectrum]:
    """Two spectra cut at the smaller of their largest eigenvalues (MWP paper, partial shapes)."""
    spectra = spectrum_x, spectrum_y
    last = min(float(spectrum.eigenvalues[-1]) for spectrum in spectra)
    cut = [s.truncate(int((np.asarray(s.eigenvalues) <= last).sum())) for s in spectra]
    return cut[0], cut[1]


def _regression(*levels: int, mending: Stage | None = None) -> Stage:
    """Feature regression, once per level."""
    return Stage(FeatureRegression(levels), max(levels), 60, len(levels), 1000, mending=mending)


def _registration(*levels: int) -> Stage:
    """Registration, once per level."""
    return Stage(Registration(levels), max(levels), 30, len(levels), 1000)


Preset = Literal["fast", "paper", "accurate"]
PRESETS: dict[Preset, tuple[Stage, ...]] = {
    "fast": (Stage(number_of_samples=500),),
    "paper": (Stage(),),
    "accurate": (
        Stage(),
        _regression(20, 20, 26, 35, mending=_regression(10, 10, 14, 14, 20, 20, 26, 35)),
        _registration(35, 60, 100, 200),
    ),
}
"""The MWP authors' fast variant, the paper's setting, and what docs/accuracy.md arrives at."""


def chosen_stages(
    preset: str | Stage | Sequence[Stage], vertices: int, *, partial: bool = False
) -> tuple[Stage, ...]:
    """The stages of a preset for shapes of at least so many vertices, or one's own as they are.

    **Arguments:**

    - `partial`: whether one shape is a part of the other.

    **Raises:** `InputError` if there is no such preset, or no stage.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise InputError(f"{preset!r} is no preset: choose from {', '.join(PRESETS)}, or give stages.")
        return tuple(fitting(stage, vertices, partial) for stage in PRESETS[preset])
    stages = tuple(preset) if isinstance(preset, Iterable) else (preset,)
    if not stages or not all(isinstance(stage, Stage) for stage in stages):
        raise InputError(f"preset is {preset!r}; give one of {', '.join(PRESETS)}, or stages.")
    if (mending := sum(stage.mending is not None for stage in stages)) > 1:
        raise InputError(f"{mending} stages are to mend: let one of them.")
    return stages


def fitting(stage: Stage, vertices: int, partial: bool = False) -> Stage:
    """A stage with what few vertices can give: eigenvectors up to their half, samples if there are more."""
    samples, refiner = stage.number_of_samples, stage.refiner
    if isinstance(refiner, CoarseToFine):
        refiner = replace(refiner, partial=partial)
    return replace(
        stage,
        refiner=refiner,
        number_of_eigenvectors=max(1, min(stage.number_of_eigenvectors, vertices // 2)),
        number_of_samples=None if samples is None or samples >= vertices else samples,
        mending=None if stage.mending is None else fitting(stage.mending, vertices, partial),
    )


class Outcome(NamedTuple):
    """What `refine_in_stages` arrives at.

    - `refinements`: of each stage, up to the first that failed.
    - `initial_map`: the start that led there.
    - `flaw`: `jaxsmw.repair.faults.flaw` of the last map; None where no stage mends.
    - `suspicious`: whether limbs may still be swapped, by that.
    """

    refinements: list[Refinement]
    initial_map: Int[Array, " m"]
    flaw: float | None = None
    suspicious: bool = False

    @property
    def successful(self) -> bool:
        """Whether no stage failed."""
        return all(bool(found.result == RESULTS.successful) for found in self.refinements)

    @property
    def pointwise_map(self) -> Int[Array, " m"]:
        """The last map."""
        return self.refinements[-1].pointwise_map if self.refinements else self.initial_map


def refine_in_stages(
    spectra: Sequence[tuple[Spectrum, Spectrum]],
    pointwise_map: Int[Array, " m"],
    stages: Sequence[Stage],
    samples: Samples | None = None,
    *,
    meshes: tuple[Mesh, Mesh] | None = None,
    partial: bool = False,
    other_starts: Iterable[Int[Array, " m"]] = (),
    history: bool = False,
) -> Outcome:
    """Refine by one stage after the other, as long as they go well.

    Symmetric limbs that a start has swapped stay swapped: each fits where the other belongs, but for its
    left and right, and for where it joins the body. If a stage mends, the outcome is looked at for both
    (`jaxsmw.repair.faults`), and let be if it looks right. Otherwise that stage and those after it are gone
    through in rounds, each begun from a functional map in which the last one's faults had no say, one kind by
    turns; and at last, from the least doubtful outcome, with `mending` in its place. What that leads to is
    kept if it looks right, the less doubtful of both otherwise; and if that does not look right, other starts
    are tried.

    **Arguments:**

    - `spectra`: of X and Y as each stage sees them (`Stage.view`).
    - `samples`: vertices of X and of Y in farthest-point order, as many as any stage takes of them.
    - `meshes`: X and Y, for a stage that mends; with fewer vertices than spectra that are padded.
    - `partial`: one shape is a part of the other, in the same unit of length.
    - `other_starts`: taken if a stage that is to mend could not. All are taken up to that stage, and through
      two rounds of it; the least doubtful, of which no two are alike, through what is left, and are mended.
      The least doubtful outcome that looks right is returned, by its flaw and, of `FeatureRegression`, how
      badly features predict each other. If none does and three starts or more lead to the same map, the
      outcome of these is, otherwise the least doubtful.
    - `history`: see `jaxsmw.refine`.
    """
    run = partial_function(_run, samples=samples, history=history)
    steps = list(zip(spectra, stages, strict=True))
    position = next((place for place, stage in enumerate(stages) if stage.mending is not None), None)
    if position is None or meshes is None:
        return run(steps, Outcome([], pointwise_map))
    # Flaws show best in as many eigenvectors as there are.
    finest = max((of_x for of_x, _ in spectra), key=lambda of_x: of_x.eigenvalues.shape[0])
    judge = _Judge(meshes, finest, partial)
    mending = _Mending(run, judge, steps, position)

    best = mending.finished(mending.begun(pointwise_map))
    if best.successful and best.suspicious:
        best = mending.mended(best)
    if not (best.successful and best.suspicious):
        return best
    # Of several that look right one may be better: once in doubt, all are tried.
    logger.info("limbs may be swapped (flaw %.3f; right maps have up to %.2f)", best.flaw, SUSPICIOUS)
    rough: list[Outcome] = []
    for number, start in enumerate(other_starts, 2):
        logger.info("start %d ...", number)
        rough.append(mending.without_faults(judge(mending.begun(start)), _ROUGH_ROUNDS))
    rough = sorted((outcome for outcome in rough if outcome.successful), key=doubt)
    finished, tried = [best], [best, *rough]
    for outcome in islice(distinct(rough, judge.alike), _FINALISTS):
        finished.append(mending.mended(mending.finished(outcome)))
    best = min(finished, key=lambda outcome: (outcome.suspicious, doubt(outcome)))
    if best.suspicious:
        # Where a body touches itself, and its surface is one there, right maps look torn, too. Wrong ones are
        # each wrong in their own way, mostly.
        most = max(([o for o in tried if judge.alike(outcome, o)] for outcome in tried), key=len)
        if len(most) >= _AGREEING:
            known = [outcome for outcome in finished if judge.alike(outcome, most[0])]
            best = min(known, key=doubt) if known else mending.mended(mending.finished(most[0]))
    if rough:
        left = "; limbs may still be swapped" if best.suspicious else ""
        logger.info("the best of %d starts has flaw %.2f%s", len(tried), best.flaw, left)
    return best


def doubt(outcome: Outcome) -> float:
    """How doubtful an outcome is beside others of the same two shapes: the less, the better.

    The logarithm of its `jaxsmw.repair.faults.flaw`, and the uncertainty of `FeatureRegression`, if that
    was among the stages.
    """
    if not outcome.successful:
        return np.inf
    regressions = [found.updated for found in outcome.refinements if isinstance(found.updated, Regression)]
    uncertainty = regressions[-1].uncertainty if regressions else 0
    return float(np.log(outcome.flaw or 1) + _UNCERTAINTY * uncertainty)


_Step = tuple[tuple[Spectrum, Spectrum], Stage]


def _run(steps: Iterable[_Step], before: Outcome, *, samples: Samples | None, history: bool) -> Outcome:
    """The outcome of further stages."""
    for (spectrum_x, spectrum_y), stage in steps:
        if not before.successful:
            break
        found = run_stage(
            stage, spectrum_x, before.pointwise_map, spectrum_y=spectrum_y, samples=samples, history=history
        )
        before = before._replace(refinements=[*before.refinements, found])
    return before


def run_stage(
    stage: Stage,
    spectrum_x: Spectrum,
    pointwise_map: Int[Array, " m"],
    *,
    spectrum_y: Spectrum,
    samples: Samples | None,
    history: bool = False,
) -> Refinement:
    """One pass through a stage's iterations; the spectra are what it sees of both shapes (`Stage.view`)."""
    chosen: dict[str, Any] = {}
    if stage.number_of_samples is not None and samples is not None:
        for side, vertices in zip(("samples_x", "samples_y"), samples, strict=True):
            chosen[side] = vertices[: stage.number_of_samples]
    return compiled(refine)(
        spectrum_x, spectrum_y, pointwise_map, **chosen, **stage.settings, history=history
    )


@dataclass(frozen=True)
class _Judge:
    """What can be said of outcomes without the truth; X's spectrum is the one with most eigenvectors."""

    meshes: tuple[Mesh, Mesh]
    spectrum_x: Spectrum
    partial: bool

    def __call__(self, outcome: Outcome) -> Outcome:
        """The outcome with its flaw."""
        if not outcome.successful:
            return outcome._replace(flaw=np.inf, suspicious=True)
        flawed = flaw(*self.meshes, self._matches(outcome), self.spectrum_x, partial=self.partial)
        return outcome._replace(flaw=flawed, suspicious=not flawed < SUSPICIOUS)

    def faults(self, outcome: Outcome) -> list[Bool[np.ndarray, " m"]]:
        """What is reversed and what is torn off, if it is worth mending."""
        mesh_x, found = self.meshes[0], self._matches(outcome)
        both = (
            reversed_orientation(*self.meshes, found, self.spectrum_x, partial=self.partial),
            torn_off(*self.meshes, found, partial=self.partial),
        )
        areas = mesh_x.vertex_areas / mesh_x.area
        return [fault for fault in both if _NEGLIGIBLE < areas[fault].sum() < _TOO_MUCH]

    def looks_right(self, outcome: Outcome) -> bool:
        """Whether there is nothing to mend."""
        assert outcome.flaw is not None
        return not outcome.suspicious or (outcome.flaw < DOUBTFUL and not self.faults(outcome))

    def alike(self, one: Outcome, other: Outcome) -> bool:
        """Whether two outcomes are the same map but for details."""
        return alike(*self.meshes, self._matches(one), self._matches(other), partial=self.partial)

    def _matches(self, outcome: Outcome) -> Int64[np.ndarray, " m"]:
        return np.asarray(outcome.pointwise_map)[: len(self.meshes[0].vertices)].astype(np.int64)


@dataclass(frozen=True)
class _Mending:
    """What is done about maps that look wrong, by the stage at a position among all, which mends."""

    run: Callable[[Iterable[_Step], Outcome], Outcome]
    judge: _Judge
    steps: list[_Step]
    position: int

    def begun(self, start: Int[Array, " m"]) -> Outcome:
        """Up to the stage that mends: a rough outcome, not yet judged."""
        return self.run(self.steps[: self.position + 1], Outcome([], start))

    def finished(self, rough: Outcome) -> Outcome:
        """After all stages."""
        return self.judge(self.run(self.steps[self.position + 1 :], rough))

    def without_faults(self, outcome: Outcome, rounds: int, *, finished: bool = False) -> Outcome:
        """The least doubtful outcome of some rounds, each begun without the last one's faults."""
        (spectrum_x, _), stage = self.steps[self.position]
        areas = np.asarray(spectrum_x.vertex_areas)
        best = last = outcome
        for done in range(rounds):
            if not (last.successful and best.suspicious and (faults := self.judge.faults(last))):
                break
            # By turns, what is reversed and what is torn off.
            fault = faults[done % len(faults)]
            sound = np.where(pad_rows(fault, len(areas)), 0, areas)
            last = self._again(last, replace(spectrum_x, vertex_areas=jax.device_put(sound)), stage)
            last = self.finished(last) if finished else self.judge(last)
            best = min(best, last, key=doubt)
        return best

    def mended(self, outcome: Outcome) -> Outcome:
        """What becomes of a finished outcome without faults, and with the stage that mends at last."""
        outcome = self.without_faults(outcome, _ROUNDS, finished=True)
        (spectrum_x, _), stage = self.steps[self.position]
        assert stage.mending is not None
        last = self.finished(self._again(outcome, spectrum_x, stage.mending))
        # It knows least of what misled the others, and is preferred if it looks right and is hardly more
        # doubtful: those upside down are far more.
        preferred = self.judge.looks_right(last) and doubt(last) < doubt(outcome) + _HARDLY
        best = last if preferred else min(outcome, last, key=doubt)
        return best._replace(suspicious=not self.judge.looks_right(best))

    def _again(self, outcome: Outcome, spectrum_x: Spectrum, stage: Stage) -> Outcome:
        """The rough outcome, not yet judged, if this were the stage that mends, begun from another."""
        (_, spectrum_y), _ = self.steps[self.position]
        found = self.run([((spectrum_x, spectrum_y), stage)], Outcome([], outcome.pointwise_map))
        before = outcome.refinements[: self.position]
        return outcome._replace(refinements=[*before, *found.refinements])


_ROUNDS, _ROUGH_ROUNDS = 4, 2
# Smaller parts of the area are let be: fingertips come and go.
_NEGLIGIBLE = 0.002
# What is left of a body turned round as a whole is no help.
_TOO_MUCH = 0.5
# What is more flawed than the first is mended: right maps between poses of one body are less. What is more
# flawed than the second even then, or something of it looks faulty, is begun elsewhere: between bodies of
# different kinds some right maps are, too.
SUSPICIOUS, DOUBTFUL = 1.12, 1.15
# In `doubt`: right maps differ by less, mostly, and those upside down by more.
_HARDLY = 0.25
# Other starts of which so many are finished. Two that are wrong are sometimes alike, three seldom.
_FINALISTS, _AGREEING = 2, 3
# Beside the flaw's logarithm, when outcomes are compared: a map upside down is the more uncertain, one of
# the mirror image the larger flaw. From 6 to 12, nearly the same outcomes are chosen.
_UNCERTAINTY = 10.0
