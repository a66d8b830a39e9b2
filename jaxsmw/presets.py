"""Methods of refinement in one or more stages, each a call of `jaxsmw.refine`, under names of their own."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial as partial_function
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Int, Int64

from jaxsmw.core.coarse_to_fine import CoarseToFine
from jaxsmw.core.compilation import compiled
from jaxsmw.core.feature_regression import FeatureRegression, Regression
from jaxsmw.core.refinement import Refinement, Refiner, Samples, WaveletPreservation, refine
from jaxsmw.core.registration import Registration
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.faults import flaw, reversed_orientation, torn_off
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.shot import SHOT_DIMENSION

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
      were swapped, and they done again without the matches of these do not help: see `refine_in_stages`. Of
      the same eigenvectors and descriptors.

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
                f"{self._sizes[0]} eigenvectors and {self._sizes[1]} descriptors are to be mended by a stage "
                f"with {self.mending._sizes[0]} and {self.mending._sizes[1]}: give both the same."
            )
        if self.number_of_samples is not None and self.number_of_samples < self.number_of_eigenvectors:
            raise InputError(
                f"{self.number_of_samples} samples cannot tell {self.number_of_eigenvectors} eigenvectors "
                "apart; use more samples (five per eigenvector is usual) or fewer eigenvectors."
            )

    @property
    def _sizes(self) -> tuple[int, int]:
        return self.number_of_eigenvectors, self.number_of_descriptors

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
            seen.append(spectrum.truncate(self.number_of_eigenvectors).describe(descriptors))
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
    - `flaw`: `jaxsmw.geometry.faults.flaw` of the last map; None where no stage mends.
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
    left and right, and for where it joins the body. From a stage that is to mend this on, the outcome is
    looked at for both (`jaxsmw.geometry.faults`), by turns, and these stages are gone through again from a
    functional map that the faulty part had no say in, and at last with `mending` in place of the first of
    them. That is the outcome if it looks right, otherwise the least doubtful map so far; and all stages are
    gone through from other starts, too. Maps that look right at once are let be.

    **Arguments:**

    - `spectra`: of X and Y as each stage sees them (`Stage.view`).
    - `samples`: vertices of X and of Y in farthest-point order, as many as any stage takes of them.
    - `meshes`: X and Y, for a stage that mends; with fewer vertices than spectra that are padded.
    - `partial`: one shape is a part of the other, in the same unit of length.
    - `other_starts`: taken if a stage that is to mend could not. The least doubtful outcome is returned, by
      its flaw and, of `FeatureRegression`, how badly features predict each other; but if not even that looks
      right and three starts or more lead to the same map, the least doubtful of these.
    - `history`: see `jaxsmw.refine`.
    """
    steps = list(zip(spectra, stages, strict=True))
    through = partial_function(
        _through, steps, samples=samples, meshes=meshes, partial=partial, history=history
    )
    best = through(pointwise_map)
    if not (best.successful and best.suspicious):
        return best
    # Of several that look right one may be better: once in doubt, all are tried.
    logger.info("limbs may be swapped (flaw %.3f; right maps have up to %.2f)", best.flaw, DOUBTFUL)
    tried = [best]
    for number, start in enumerate(other_starts, 2):
        logger.info("start %d", number)
        outcome = through(start)
        if outcome.successful:
            tried.append(outcome)
    best = min(tried, key=doubt)
    if best.suspicious and meshes is not None:
        # Where a body touches itself, and its surface is one there, right maps look torn, too. Wrong ones are
        # each wrong in their own way, mostly.
        alike = [[other for other in tried if _agree(*meshes, outcome, other)] for outcome in tried]
        most = max(alike, key=len)
        best = min(most, key=doubt) if len(most) >= _AGREEING else best
    if len(tried) > 1:
        left = "; limbs may still be swapped" if best.suspicious else ""
        logger.info("the best of %d starts has flaw %.2f%s", len(tried), best.flaw, left)
    return best


def _agree(mesh_x: Mesh, mesh_y: Mesh, one: Outcome, other: Outcome) -> bool:
    """Whether two outcomes are the same map but for details."""
    m = len(mesh_x.vertices)
    one_at, other_at = (mesh_y.vertices[np.asarray(found.pointwise_map)[:m]] for found in (one, other))
    apart = np.linalg.norm(one_at - other_at, axis=1) > _APART * mesh_y.area**0.5
    return bool(mesh_x.vertex_areas[apart].sum() < _NEARLY_NOTHING * mesh_x.area)


def doubt(outcome: Outcome) -> float:
    """How doubtful an outcome is beside others of the same two shapes: the less, the better.

    The logarithm of its `jaxsmw.geometry.faults.flaw`, and the uncertainty of `FeatureRegression`, if that
    was among the stages.
    """
    if not outcome.successful:
        return np.inf
    regressions = [found.updated for found in outcome.refinements if isinstance(found.updated, Regression)]
    uncertainty = regressions[-1].uncertainty if regressions else 0
    return float(np.log(outcome.flaw or 1) + _UNCERTAINTY * uncertainty)


_Step = tuple[tuple[Spectrum, Spectrum], Stage]


def _through(
    steps: Sequence[_Step],
    pointwise_map: Int[Array, " m"],
    *,
    samples: Samples | None,
    meshes: tuple[Mesh, Mesh] | None,
    partial: bool,
    history: bool,
) -> Outcome:
    """The outcome of stages from one start. Without a stage that mends nobody asks for a flaw."""

    def run(steps: Sequence[_Step], before: Outcome) -> Outcome:
        for (spectrum_x, spectrum_y), stage in steps:
            found = run_stage(
                stage,
                spectrum_x,
                before.pointwise_map,
                spectrum_y=spectrum_y,
                samples=samples,
                history=history,
            )
            before = before._replace(refinements=[*before.refinements, found])
            if not before.successful:
                break
        return before

    mending = [position for position, (_, stage) in enumerate(steps) if stage.mending is not None]
    if not mending or meshes is None:
        return run(steps, Outcome([], pointwise_map))
    before = run(steps[: mending[0]], Outcome([], pointwise_map))
    if not before.successful:
        return before
    # Flaws show best in as many eigenvectors as there are.
    finest = max((of_x for (of_x, _), _ in steps), key=lambda of_x: of_x.eigenvalues.shape[0])
    return _mended(steps[mending[0] :], before, run, meshes, finest, partial)


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


def _mended(
    steps: Sequence[_Step],
    before: Outcome,
    run: Callable[[Sequence[_Step], Outcome], Outcome],
    meshes: tuple[Mesh, Mesh],
    finest: Spectrum,
    partial: bool,
) -> Outcome:
    """The outcome of stages after others, or of rounds of them, each begun without the last one's faults.

    At last the least doubtful one is mended with all, and that taken if it looks right, otherwise the least
    doubtful. What looks right at once is let be.
    """
    ((spectrum_x, spectrum_y), stage), *others = steps
    m = len(meshes[0].vertices)
    areas = np.asarray(spectrum_x.vertex_areas)
    eigenvectors = np.asarray(finest.eigenvectors)[:m, :_EIGENVECTORS]

    def matches(outcome: Outcome) -> Int64[np.ndarray, " m"]:
        return np.asarray(outcome.pointwise_map)[:m].astype(np.int64)

    def faults(outcome: Outcome) -> list[Bool[np.ndarray, " m"]]:
        found = matches(outcome)
        reversed_ = reversed_orientation(*meshes, found, eigenvectors, partial=partial)
        both = reversed_, torn_off(*meshes, found, partial=partial)
        return [fault for fault in both if _NEGLIGIBLE < areas[:m][fault].sum() / areas.sum() < _TOO_MUCH]

    def judged(first: _Step, pointwise_map: Int[Array, " m"]) -> Outcome:
        """What becomes of a map in these stages."""
        found = run([first, *others], Outcome([], pointwise_map))
        outcome = before._replace(refinements=[*before.refinements, *found.refinements])
        if not outcome.successful:
            return outcome._replace(flaw=np.inf, suspicious=True)
        flawed = flaw(*meshes, matches(outcome), finest, partial=partial)
        return outcome._replace(flaw=flawed, suspicious=flawed >= SUSPICIOUS)

    def looks_right(outcome: Outcome) -> bool:
        doubtful = outcome.flaw is None or outcome.flaw >= DOUBTFUL
        return not outcome.suspicious or not (doubtful or faults(outcome))

    best = last = judged(steps[0], before.pointwise_map)
    if not (best.successful and best.suspicious):
        return best
    for done in range(_ROUNDS):
        if not (last.successful and best.suspicious):
            break
        if not (some := faults(last)):
            break
        # By turns, what is reversed and what is torn off.
        sound = np.where(np.pad(some[done % len(some)], (0, len(areas) - m)), 0, areas)
        begun_without = replace(spectrum_x, vertex_areas=jax.device_put(sound))
        last = judged(((begun_without, spectrum_y), stage), last.pointwise_map)
        best = min(best, last, key=doubt)
    if stage.mending is not None:
        last = judged(((spectrum_x, spectrum_y), stage.mending), best.pointwise_map)
        # It knows least of what misled the others, and is preferred if it looks right and is hardly more
        # doubtful: those upside down are far more.
        preferred = looks_right(last) and doubt(last) < doubt(best) + _HARDLY
        best = last if preferred else min(best, last, key=doubt)
    return best._replace(suspicious=not looks_right(best))


_ROUNDS, _EIGENVECTORS = 4, 50
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
# Maps agree that differ by more than so many square roots of the area on less than such a share of it. Two
# that are wrong sometimes do.
_APART, _NEARLY_NOTHING, _AGREEING = 0.1, 0.03, 3
# Beside the flaw's logarithm, when outcomes are compared: a map upside down is the more uncertain, one of
# the mirror image the larger flaw. From 6 to 12, nearly the same outcomes are chosen.
_UNCERTAINTY = 10.0
