"""The presets of `match`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import get_args

from jaxsmw.choices import PresetName
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.errors import InputError
from jaxsmw.repair.settings import RepairSettings
from jaxsmw.stage import Stage


@dataclass(frozen=True)
class Preset:
    """Stages of refinement and settings of the repair, for the argument `preset` of `jaxsmw.match`.

    `jaxsmw.PRESETS` contains three ready presets.

    **Attributes:**

    - `stages`: a tuple of at least one `Stage`. The stages run in this order, and each stage starts from the
      map of the previous stage.
    - `repair`: the `RepairSettings` that determine when and how a map is repaired; None (the default) for no
      repair.

    **Raises:** `InputError` if there is no stage, if an attribute has the wrong type, or if no stage has the
    position `repair.stage`. `InputError` is also raised for the stage that repair repeats: if its refiner has
    no levels, or if the stage has fewer samples than the largest of `repair.fallback_levels`.
    """

    stages: tuple[Stage, ...]
    repair: RepairSettings | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.stages, tuple) or not all(isinstance(stage, Stage) for stage in self.stages):
            raise InputError(f"stages is {self.stages!r}: give a tuple of stages.")
        if not self.stages:
            raise InputError("a preset without stages cannot refine a map: give at least one stage.")
        if self.repair is None:
            return
        if not isinstance(self.repair, RepairSettings):
            raise InputError(f"repair is {self.repair!r}: give RepairSettings or None.")
        if not 0 <= self.repair.stage < len(self.stages):
            raise InputError(
                f"repair repeats stage {self.repair.stage}, but the stages are 0 to {len(self.stages) - 1}: "
                "give RepairSettings(stage=...) with one of these numbers."
            )
        self.stages[self.repair.stage].with_levels(self.repair.fallback_levels)

    def fitted(self, number_of_vertices: int) -> Preset:
        """Return the preset with every stage adapted to a small mesh; see `Stage.fitted`."""
        return replace(self, stages=tuple(stage.fitted(number_of_vertices) for stage in self.stages))

    def without_descriptors(self) -> Preset:
        """Return the preset with stages that use no descriptors."""
        return replace(self, stages=tuple(stage.without_descriptors() for stage in self.stages))

    @property
    def number_of_eigenvectors(self) -> int:
        """The largest number of eigenvectors that a stage uses."""
        return max(stage.number_of_eigenvectors for stage in self.stages)

    @property
    def number_of_descriptors(self) -> int:
        """The largest number of descriptors that a stage uses."""
        return max(stage.number_of_descriptors for stage in self.stages)

    @property
    def number_of_samples(self) -> int:
        """The largest number of samples that a stage uses; 0 if no stage uses samples."""
        return max(stage.number_of_samples or 0 for stage in self.stages)


PRESETS: dict[PresetName, Preset] = {
    "fast": Preset((Stage(number_of_samples=500),)),
    "paper": Preset((Stage(),)),
    "accurate": Preset(
        (
            Stage(),
            Stage(
                FeatureRegression(levels=(20, 20, 26, 35)), number_of_descriptors=60, number_of_samples=1000
            ),
            Stage(Registration(levels=(35, 60, 100, 200)), number_of_descriptors=30, number_of_samples=1000),
        ),
        RepairSettings(stage=1),
    ),
}
"""A dictionary from the names of the presets of `jaxsmw.match` to the presets, each a `Preset`.

`"paper"` has the settings of the MWP paper: one stage of `WaveletPreservation` with 100 eigenvectors and 3
iterations. `"fast"` has the same stage with iterations on 500 samples of each shape, as in the fast variant
of the MWP authors' program. `"accurate"` has three stages and repair: the stage of `"paper"`,
`FeatureRegression` with up to 35 eigenvectors, and `Registration` with up to 200 eigenvectors.
`docs/accuracy.md` reports the errors of `"accurate"`.
"""


def choose_preset(preset: str | Preset | Stage | Sequence[Stage]) -> Preset:
    """Return the preset with a given name, or a preset of given stages.

    **Arguments:**

    - `preset`: a key of `PRESETS`, a `Preset` (which is returned unchanged), a stage, or an iterable of
      stages.

    **Raises:** `InputError` if the name is unknown, or if the argument is not a preset, a stage or several
    stages.
    """
    if isinstance(preset, Preset):
        return preset
    if isinstance(preset, str):
        if preset not in get_args(PresetName):
            raise InputError(f"{preset!r} is not a preset: choose from {', '.join(PRESETS)}, or give stages.")
        return PRESETS[preset]  # type: ignore[index]
    stages = tuple(preset) if isinstance(preset, Iterable) else (preset,)
    if not stages or not all(isinstance(stage, Stage) for stage in stages):
        raise InputError(f"preset is {preset!r}: give one of {', '.join(PRESETS)}, or stages.")
    return Preset(stages)
