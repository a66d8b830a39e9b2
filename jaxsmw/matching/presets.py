"""The presets of `match`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import get_args

from jaxsmw.choices import PresetName
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.errors import InputError
from jaxsmw.matching.settings import RepairSettings
from jaxsmw.matching.stages import Stage


@dataclass(frozen=True)
class Preset:
    """Stages of refinement and settings of the repair, for the argument `preset` of `jaxsmw.match`.

    `jaxsmw.PRESETS` contains three ready presets.

    **Attributes:**

    - `stages`: a tuple of at least one `Stage`. The stages run in this order, and each stage starts from the
      map of the previous stage.
    - `repair`: the `RepairSettings` that determine when and how a map is repaired; None (the default) for no
      repair.
    - `large_stages`: the stages that run instead of `stages` if both meshes have at least 15 000 vertices;
      None (the default) to run `stages` on meshes of any size. `repair.stage` and `repair.final_stages` count
      these stages as well.

    **Raises:** `InputError` if there is no stage, if an attribute has the wrong type, or if no stage before
    the final stages has the position `repair.stage`. `InputError` is also raised if one of these rules is
    broken. The last stage, and the last stage before the final stages, must not end on samples. If a stage
    ends on samples, the next stage must start on samples, and must not have more samples. The stage that
    repair repeats must have levels.
    """

    stages: tuple[Stage, ...]
    repair: RepairSettings | None = None
    large_stages: tuple[Stage, ...] | None = None

    def __post_init__(self) -> None:
        if self.repair is not None and not isinstance(self.repair, RepairSettings):
            raise InputError(f"repair is {self.repair!r}: give RepairSettings or None.")
        _check_stages("stages", self.stages, self.repair)
        if self.large_stages is not None:
            _check_stages("large_stages", self.large_stages, self.repair)

    def fitted(self, number_of_vertices: int) -> Preset:
        """Return the preset for meshes of a given size.

        With at least 15 000 vertices, the `stages` of the result are the `large_stages` of this preset, if
        there are any. For a small number of vertices, every stage is adapted; see `Stage.fitted`.

        **Arguments:**

        - `number_of_vertices`: the number of referenced vertices of the smaller mesh.
        """
        stages = self.stages
        if self.large_stages is not None and number_of_vertices >= _LARGE_FROM:
            stages = self.large_stages
        return Preset(tuple(stage.fitted(number_of_vertices) for stage in stages), self.repair)

    def without_descriptors(self) -> Preset:
        """Return the preset with stages that use no descriptors."""

        def without(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
            return tuple(stage.without_descriptors() for stage in stages)

        large = None if self.large_stages is None else without(self.large_stages)
        return replace(self, stages=without(self.stages), large_stages=large)

    @property
    def judged_stages(self) -> tuple[Stage, ...]:
        """The stages whose map is judged and repaired; see `final_stages`."""
        return self.stages[: len(self.stages) - len(self.final_stages)]

    @property
    def final_stages(self) -> tuple[Stage, ...]:
        """The stages that run once, after repair; see `RepairSettings.final_stages`."""
        number = 0 if self.repair is None else self.repair.final_stages
        return self.stages[len(self.stages) - number :]

    @property
    def cuts_shortcuts(self) -> bool:
        """Whether meshes are cut where they are fused with themselves; see `RepairSettings.cut_shortcuts`."""
        return self.repair is not None and self.repair.cut_shortcuts

    @property
    def number_of_eigenvectors(self) -> int:
        """The largest number of eigenvectors that a stage uses."""
        return max(stage.number_of_eigenvectors for stage in self.stages)

    @property
    def number_of_descriptors(self) -> int:
        """The largest number of descriptors that a stage uses."""
        return max(stage.number_of_descriptors for stage in self.stages)

    @property
    def number_of_crease_eigenvectors(self) -> int:
        """The largest number of crease eigenvectors that a stage uses."""
        return max(stage.number_of_crease_eigenvectors for stage in self.stages)

    @property
    def number_of_samples(self) -> int:
        """The largest number of samples that a stage uses; 0 if no stage uses samples."""
        return max(stage.number_of_samples or 0 for stage in self.stages)


# `Preset.fitted` chooses the `large_stages` if the smaller mesh has at least this number of vertices.
_LARGE_FROM = 15_000


def _check_stages(name: str, stages: tuple[Stage, ...], repair: RepairSettings | None) -> None:
    """Raise `InputError` if stages cannot run one after another, or if repair cannot repeat its stage."""
    if not isinstance(stages, tuple) or not all(isinstance(stage, Stage) for stage in stages):
        raise InputError(f"{name} is {stages!r}: give a tuple of stages.")
    if not stages:
        raise InputError("a preset without stages cannot refine a map: give at least one stage.")
    if stages[-1].ends_on_samples:
        raise InputError("the last stage ends on samples, but it must match all vertices: use the default.")
    for position, (stage, following) in enumerate(pairwise(stages), 1):
        if stage.ends_on_samples and not (
            following.starts_on_samples
            and (following.number_of_samples or 0) <= (stage.number_of_samples or 0)
        ):
            raise InputError(
                f"stage {position - 1} matches only {stage.number_of_samples} samples: let stage {position} "
                "start on at most as many samples (starts_on_samples=True)."
            )
    if repair is None:
        return
    last = len(stages) - repair.final_stages - 1
    if last < 0:
        raise InputError(
            f"repair has {repair.final_stages} final stages, but there are {len(stages)} stages: give "
            "RepairSettings(final_stages=...) with a smaller number."
        )
    if not 0 <= repair.stage <= last:
        raise InputError(
            f"repair repeats stage {repair.stage}, but it can repeat only the stages 0 to {last}: give "
            "RepairSettings(stage=...) with one of these numbers."
        )
    if stages[last].ends_on_samples:
        raise InputError(
            f"stage {last} ends on samples, but its map is judged at all vertices: use the default."
        )
    if not stages[repair.stage].refiner.levels:
        raise InputError(
            f"repair repeats stage {repair.stage}, but {type(stages[repair.stage].refiner).__name__} has no "
            "levels: give RepairSettings(stage=...) with a stage of FeatureRegression or Registration."
        )


_WAVELETS = Stage()
_REGRESSION = Stage(
    FeatureRegression(levels=(20, 20, 26, 35)),
    number_of_descriptors=60,
    number_of_crease_eigenvectors=25,
    number_of_samples=1000,
)
_REGISTRATION = Stage(
    Registration(levels=(35, 60, 100, 200)), number_of_descriptors=30, number_of_samples=1000
)
_FINAL = Stage(Registration(levels=(70, 100, 141, 200)), number_of_descriptors=30)

PRESETS: dict[PresetName, Preset] = {
    "fast": Preset((Stage(number_of_samples=500),)),
    "paper": Preset((Stage(),)),
    "accurate": Preset(
        (_WAVELETS, _REGRESSION, _REGISTRATION, _FINAL),
        RepairSettings(stage=1, final_stages=1),
        # On large meshes, searches that match all vertices take most of the time. Crease eigenvectors are
        # left out, because they need the exact eigensolver.
        large_stages=(
            replace(_WAVELETS, number_of_samples=1000),
            replace(_REGRESSION, number_of_crease_eigenvectors=0, ends_on_samples=True),
            replace(_REGISTRATION, starts_on_samples=True),
            replace(_FINAL, number_of_samples=1000, starts_on_samples=True),
        ),
    ),
}
"""A dictionary from the names of the presets of `jaxsmw.match` to the presets, each a `Preset`.

`"paper"` has the settings of the MWP paper: one stage of `WaveletPreservation` with 100 eigenvectors and 3
iterations. `"fast"` has the same stage with iterations on 500 samples of each shape, as in the fast variant
of the MWP authors' program. `"accurate"` has four stages and repair: the stage of `"paper"`,
`FeatureRegression` with up to 35 eigenvectors, and `Registration` with up to 200 eigenvectors, twice. The
fourth stage runs once, after repair. If both meshes have at least 15 000 vertices, all stages of `"accurate"`
iterate on 1000 samples. `docs/accuracy.md` reports the errors of `"accurate"`.
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
