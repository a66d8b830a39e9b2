"""Methods of refinement in one or more stages, each a call of `jaxsmw.refine`, under names of their own."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial as partial_function
from itertools import chain
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Array, Int

from jaxsmw.core.compilation import compiled
from jaxsmw.core.feature_regression import FeatureRegression
from jaxsmw.core.refinement import Refinement, Refiner, Samples, WaveletPreservation, refine
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
    - `mending`: where the outcome swaps limbs, do it again up to so many times without their matches: see
      `refine_in_stages`.

    **Raises:** `InputError` for what cannot work.
    """

    refiner: Refiner = field(default_factory=WaveletPreservation)
    number_of_eigenvectors: int = 100
    number_of_descriptors: int = 0
    iterations: int = 3
    number_of_samples: int | None = None
    stop_when_unchanged: bool = False
    mending: int = 0

    def __post_init__(self) -> None:
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
        if self.mending < 0:
            raise InputError(f"{self.mending} rounds of mending were asked for; 0 is none.")
        if self.number_of_samples is not None and self.number_of_samples < self.number_of_eigenvectors:
            raise InputError(
                f"{self.number_of_samples} samples cannot tell {self.number_of_eigenvectors} eigenvectors "
                "apart; use more samples (five per eigenvector is usual) or fewer eigenvectors."
            )

    @property
    def settings(self) -> dict[str, Any]:
        """What `jaxsmw.refine` is told beside arrays."""
        return {
            "refiner": self.refiner,
            "iterations": self.iterations,
            "stop_when_unchanged": self.stop_when_unchanged,
        }

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


def _regression(levels: tuple[int, ...], number_of_samples: int, mending: int = 0) -> Stage:
    """Feature regression, once per level."""
    return Stage(FeatureRegression(levels), max(levels), 30, len(levels), number_of_samples, mending=mending)


Preset = Literal["fast", "paper", "accurate"]
_PAPER = (Stage(),)
PRESETS: dict[Preset, tuple[Stage, ...]] = {
    "fast": (Stage(number_of_samples=500),),
    "paper": _PAPER,
    "accurate": (
        *_PAPER,
        _regression((20, 20, 26, 26, 35, 35, 50, 50), 1000, mending=4),
        _regression((100, 200), 1000),
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
        return tuple(_fitting(stage, vertices, partial) for stage in PRESETS[preset])
    stages = (preset,) if isinstance(preset, Stage) else tuple(preset)
    if not stages or not all(isinstance(stage, Stage) for stage in stages):
        raise InputError(f"preset is {preset!r}; give one of {', '.join(PRESETS)}, or stages.")
    return stages


def _fitting(stage: Stage, vertices: int, partial: bool) -> Stage:
    """A stage with what few vertices can give: eigenvectors up to their half, samples if there are more."""
    samples, refiner = stage.number_of_samples, stage.refiner
    if isinstance(refiner, FeatureRegression):
        refiner = replace(refiner, partial=partial)
    return replace(
        stage,
        refiner=refiner,
        number_of_eigenvectors=max(1, min(stage.number_of_eigenvectors, vertices // 2)),
        number_of_samples=None if samples is None or samples >= vertices else samples,
    )


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
) -> tuple[list[Refinement], Int[Array, " m"]]:
    """Refine by one stage after the other, as long as they go well: the outcome of each, and the start.

    Symmetric limbs that a start has swapped stay swapped: each fits where the other belongs, but for its
    left and right, and for where it joins the body. A stage that is to mend this looks for both
    (`jaxsmw.geometry.faults`), by turns, and goes through its iterations again from a functional map that the
    faulty part had no say in. The least flawed map it came by is its outcome. Where that does not help, the
    stages are gone through from other starts, too. Maps that look right are let be.

    **Arguments:**

    - `spectra`: of X and Y as each stage sees them (`Stage.view`).
    - `samples`: vertices of X and of Y in farthest-point order, as many as any stage takes of them.
    - `meshes`: X and Y, for stages that mend; if they have fewer vertices than the spectra, those are padded.
    - `partial`: one shape is a part of the other, in the same unit of length.
    - `other_starts`: taken one by one if a stage is to mend, until an outcome looks right; the least flawed
      is returned, the first if none is clearly better.
    - `history`: see `jaxsmw.refine`.
    """
    best, least = None, np.inf
    for start in chain([pointwise_map], other_starts):
        refinements = _through(spectra, start, stages, samples, meshes, partial, history)
        failed = refinements[-1].result != RESULTS.successful
        if meshes is None or not any(stage.mending for stage in stages) or (failed and best is None):
            return refinements, start
        flawed = np.inf if failed else _flaw(refinements[-1], spectra[-1][0], meshes, partial)
        if best is None or flawed < _CLEARLY * least:
            best, least = (refinements, start), flawed
        if least < _SUSPICIOUS:
            break
        logger.info("limbs may be swapped (flaw %.2f, below %.2f is good): other starts", flawed, _SUSPICIOUS)
    assert best is not None  # the first start at the latest
    return best


def _through(
    spectra: Sequence[tuple[Spectrum, Spectrum]],
    pointwise_map: Int[Array, " m"],
    stages: Sequence[Stage],
    samples: Samples | None,
    meshes: tuple[Mesh, Mesh] | None,
    partial: bool,
    history: bool,
) -> list[Refinement]:
    """The outcomes of all stages, or up to the first that fails."""
    refinements: list[Refinement] = []
    for (spectrum_x, spectrum_y), stage in zip(spectra, stages, strict=True):
        run = partial_function(_run, stage, spectrum_y, samples, history)
        refinement = run(spectrum_x, pointwise_map)
        if stage.mending and meshes is not None and refinement.result == RESULTS.successful:
            refinement = _mended(refinement, spectrum_x, run, meshes, partial, stage.mending)
        refinements.append(refinement)
        if refinement.result != RESULTS.successful:
            break
        pointwise_map = refinement.pointwise_map
    return refinements


def _run(
    stage: Stage,
    spectrum_y: Spectrum,
    samples: Samples | None,
    history: bool,
    spectrum_x: Spectrum,
    pointwise_map: Int[Array, " m"],
) -> Refinement:
    """One pass through a stage's iterations."""
    chosen: dict[str, Any] = {}
    if stage.number_of_samples is not None and samples is not None:
        for side, vertices in zip(("samples_x", "samples_y"), samples, strict=True):
            chosen[side] = vertices[: stage.number_of_samples]
    return compiled(refine)(
        spectrum_x, spectrum_y, pointwise_map, **chosen, **stage.settings, history=history
    )


def _mended(
    refinement: Refinement,
    spectrum_x: Spectrum,
    run: Callable[[Spectrum, Int[Array, " m"]], Refinement],
    meshes: tuple[Mesh, Mesh],
    partial: bool,
    rounds: int,
) -> Refinement:
    """The least flawed of a refinement and of others, each begun without what was faulty in the last."""
    m = len(meshes[0].vertices)
    areas = np.asarray(spectrum_x.vertex_areas)
    eigenvectors = np.asarray(spectrum_x.eigenvectors)[:m]
    best, least = refinement, np.inf
    criteria = (
        lambda found: reversed_orientation(*meshes, found, eigenvectors, partial=partial),
        lambda found: torn_off(*meshes, found, partial=partial),
    )
    for done in range(rounds + 1):
        flawed = _flaw(refinement, spectrum_x, meshes, partial)
        if flawed < least:
            best, least = refinement, flawed
        if done == rounds or flawed < _SUSPICIOUS:
            return best
        found = np.asarray(refinement.pointwise_map)[:m].astype(np.int64)
        for criterion in criteria[done % 2 :] + criteria[: done % 2]:
            fault = criterion(found)
            if _NEGLIGIBLE < areas[:m][fault].sum() / areas.sum() < _TOO_MUCH:
                break
        else:
            return best
        sound = jax.device_put(np.where(np.pad(fault, (0, len(areas) - m)), 0, areas))
        refinement = run(replace(spectrum_x, vertex_areas=sound), refinement.pointwise_map)
        if refinement.result != RESULTS.successful:
            return best
    return best


def _flaw(refinement: Refinement, spectrum_x: Spectrum, meshes: tuple[Mesh, Mesh], partial: bool) -> float:
    m = len(meshes[0].vertices)
    found = np.asarray(refinement.pointwise_map)[:m].astype(np.int64)
    return flaw(*meshes, found, np.asarray(spectrum_x.eigenvectors)[:m], partial=partial)


# Smaller parts of the area are let be: fingertips come and go.
_NEGLIGIBLE = 0.002
# What is left of a body turned round as a whole is no help.
_TOO_MUCH = 0.5
# What is less flawed than this looks right.
_SUSPICIOUS = 2.0
# By so much less flawed another start's outcome has to be: the first is the right one more often.
_CLEARLY = 0.75
