"""Methods of refinement in one or more stages, each a call of `jaxsmw.refine`, under names of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Array, Int

from jaxsmw.core.compilation import compiled
from jaxsmw.core.feature_regression import FeatureRegression
from jaxsmw.core.refinement import Refinement, Refiner, Samples, WaveletPreservation, refine
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError


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

    **Raises:** `InputError` for what cannot work.
    """

    refiner: Refiner = field(default_factory=WaveletPreservation)
    number_of_eigenvectors: int = 100
    number_of_descriptors: int = 0
    iterations: int = 3
    number_of_samples: int | None = None
    stop_when_unchanged: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.refiner, Refiner):
            raise InputError(
                f"refiner is {self.refiner!r}; give a Refiner such as WaveletPreservation(bank=Meyer(8))."
            )
        if self.iterations < 1:
            raise InputError(f"{self.iterations} iterations were asked for; at least 1 is needed.")
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
        """Two shapes as this stage sees them; of a partial pair the range that both spectra have."""
        seen = []
        for spectrum in (spectrum_x, spectrum_y):
            descriptors = None
            if self.number_of_descriptors and spectrum.descriptors is not None:
                descriptors = spectrum.descriptors[:, : self.number_of_descriptors]
            seen.append(spectrum.truncate(self.number_of_eigenvectors).describe(descriptors))
        return common_range(*seen) if partial else (seen[0], seen[1])


def common_range(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Spectrum, Spectrum]:
    """Two spectra cut at the smaller of their largest eigenvalues (MWP paper, partial shapes)."""
    spectra = spectrum_x, spectrum_y
    last = min(float(spectrum.eigenvalues[-1]) for spectrum in spectra)
    cut = [s.truncate(int((np.asarray(s.eigenvalues) <= last).sum())) for s in spectra]
    return cut[0], cut[1]


def _regression(levels: tuple[int, ...], number_of_samples: int) -> Stage:
    """Feature regression, once per level."""
    return Stage(FeatureRegression(levels), max(levels), 30, len(levels), number_of_samples)


Preset = Literal["paper", "accurate"]
_PAPER = (Stage(),)
PRESETS: dict[Preset, tuple[Stage, ...]] = {
    "paper": _PAPER,
    "accurate": (
        *_PAPER,
        _regression((20, 20, 20, 26, 26, 26, 35, 35, 35, 50, 50, 50), 1000),
        _regression((100, 200), 1000),
    ),
}
"""The paper's setting, and what docs/accuracy.md arrives at."""


def chosen_stages(preset: str | Stage | Sequence[Stage], vertices: int) -> tuple[Stage, ...]:
    """The stages of a preset for shapes of at least so many vertices, or one's own as they are.

    **Raises:** `InputError` if there is no such preset, or no stage.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise InputError(f"{preset!r} is no preset: choose from {', '.join(PRESETS)}, or give stages.")
        return tuple(_fitting(stage, vertices) for stage in PRESETS[preset])
    stages = (preset,) if isinstance(preset, Stage) else tuple(preset)
    if not stages or not all(isinstance(stage, Stage) for stage in stages):
        raise InputError(f"preset is {preset!r}; give one of {', '.join(PRESETS)}, or stages.")
    return stages


def _fitting(stage: Stage, vertices: int) -> Stage:
    """A stage with what few vertices can give: eigenvectors up to their half, samples if there are more."""
    samples = stage.number_of_samples
    return replace(
        stage,
        number_of_eigenvectors=max(1, min(stage.number_of_eigenvectors, vertices // 2)),
        number_of_samples=None if samples is None or samples >= vertices else samples,
    )


def refine_in_stages(
    spectra: Sequence[tuple[Spectrum, Spectrum]],
    pointwise_map: Int[Array, " m"],
    stages: Sequence[Stage],
    samples: Samples | None = None,
    *,
    history: bool = False,
) -> list[Refinement]:
    """Refine by one stage after the other, as long as they go well: the outcome of each.

    **Arguments:**

    - `spectra`: of X and Y as each stage sees them (`Stage.view`).
    - `samples`: vertices of X and of Y in farthest-point order, as many as any stage takes of them.
    - `history`: see `jaxsmw.refine`.
    """
    refinements: list[Refinement] = []
    for (spectrum_x, spectrum_y), stage in zip(spectra, stages, strict=True):
        chosen: dict[str, Any] = {}
        if stage.number_of_samples is not None and samples is not None:
            for side, vertices in zip(("samples_x", "samples_y"), samples, strict=True):
                chosen[side] = vertices[: stage.number_of_samples]
        refinement = compiled(refine)(
            spectrum_x, spectrum_y, pointwise_map, **chosen, **stage.settings, history=history
        )
        refinements.append(refinement)
        if refinement.result != RESULTS.successful:
            break
        pointwise_map = refinement.pointwise_map
    return refinements
