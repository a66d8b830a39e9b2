"""The presets of `match`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import get_args

from jaxsmw.choices import PresetName
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.errors import InputError
from jaxsmw.matching.settings import RepairSettings
from jaxsmw.matching.shapes import Sizes
from jaxsmw.matching.stages import Stage


@dataclass(frozen=True)
class Preset:
    """Stages of refinement and settings of the repair, for the argument `preset` of `jaxsmw.match`.

    The stages run in the order `first`, `repeated`, `final`, and each stage starts from the map of the
    previous stage. A map is judged before the final stages run. Repair runs the repeated stages again.
    `jaxsmw.PRESETS` contains three ready presets.

    **Attributes:**

    - `first`: a tuple of stages that run once, before the repeated stages. Without repair, these can be all
      stages.
    - `repeated`: a tuple of stages that repair runs again. Without repair, they run once.
    - `final`: a tuple of stages that run once, after repair (Table R42).
    - `repair`: the `RepairSettings` that determine when and how a map is repaired; None (the default) for no
      repair.
    - `large`: the preset that is used instead if both meshes have at least 15 000 vertices; None (the
      default) to use this preset for meshes of any size.

    **Raises:** `InputError` if there is no stage, if an attribute has the wrong type, or if there is repair,
    but no repeated stage. `InputError` is also raised if one of these rules is broken. The last stage, and
    the last stage before the final stages, must not end on samples. If a stage ends on samples, the next
    stage must start on samples, and must not have more samples. The first repeated stage must have levels.
    """

    first: tuple[Stage, ...] = ()
    repeated: tuple[Stage, ...] = ()
    final: tuple[Stage, ...] = ()
    repair: RepairSettings | None = None
    large: Preset | None = None

    def __post_init__(self) -> None:
        for name in ("first", "repeated", "final"):
            stages = getattr(self, name)
            if not isinstance(stages, tuple) or not all(isinstance(stage, Stage) for stage in stages):
                raise InputError(f"{name} is {stages!r}: give a tuple of stages.")
        if self.repair is not None and not isinstance(self.repair, RepairSettings):
            raise InputError(f"repair is {self.repair!r}: give RepairSettings or None.")
        if self.large is not None and not isinstance(self.large, Preset):
            raise InputError(f"large is {self.large!r}: give a Preset or None.")
        _check_order(self.stages)
        if self.final:
            if not self.judged:
                raise InputError("a preset of final stages has no map to judge: add stages before them.")
            if self.judged[-1].ends_on_samples:
                raise InputError(
                    "the last stage before the final stages ends on samples, but its map is judged at all "
                    "vertices: use the default."
                )
        if self.repair is None:
            return
        if not self.repeated:
            raise InputError("repair has no stage to repeat: give the preset repeated stages.")
        if not self.repeated[0].refiner.levels:
            raise InputError(
                f"repair repeats a stage of {type(self.repeated[0].refiner).__name__}, which has no levels: "
                "let the repeated stages begin with FeatureRegression or Registration."
            )

    @property
    def stages(self) -> tuple[Stage, ...]:
        """All stages, in the order in which they run."""
        return self.first + self.repeated + self.final

    @property
    def judged(self) -> tuple[Stage, ...]:
        """The stages before the final stages, whose map is judged and repaired."""
        return self.first + self.repeated

    def fitted(self, number_of_vertices: int) -> Preset:
        """Return the preset for meshes of a given size.

        With at least 15 000 vertices, the result is made from `large`, if there is such a preset. For a small
        number of vertices, every stage is adapted; see `Stage.fitted`.

        **Arguments:**

        - `number_of_vertices`: the number of referenced vertices of the smaller mesh.
        """
        if self.large is not None and number_of_vertices >= _LARGE_FROM:
            return self.large.fitted(number_of_vertices)
        return self._with_stages(lambda stage: stage.fitted(number_of_vertices))

    def without_descriptors(self) -> Preset:
        """Return the preset with stages that use no descriptors."""
        return self._with_stages(Stage.without_descriptors)

    def _with_stages(self, change: Callable[[Stage], Stage]) -> Preset:
        first, repeated, final = (tuple(map(change, s)) for s in (self.first, self.repeated, self.final))
        return Preset(first, repeated, final, self.repair)

    @property
    def cuts_shortcuts(self) -> bool:
        """Whether meshes are cut where they are fused with themselves; see `RepairSettings.cut_shortcuts`."""
        return self.repair is not None and self.repair.cut_shortcuts

    @property
    def sizes(self) -> Sizes:
        """What the stages need of each shape."""
        return Sizes(
            max(stage.number_of_eigenvectors for stage in self.stages),
            max(stage.number_of_crease_eigenvectors for stage in self.stages),
            max(stage.number_of_samples or 0 for stage in self.stages),
        )

    @property
    def number_of_descriptors(self) -> int:
        """The largest number of descriptors that a stage uses."""
        return max(stage.number_of_descriptors for stage in self.stages)


# `Preset.fitted` chooses the preset `large` if the smaller mesh has at least this number of vertices.
_LARGE_FROM = 15_000


def _check_order(stages: tuple[Stage, ...]) -> None:
    """Raise `InputError` if stages cannot run one after another."""
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
        (_WAVELETS,),
        (_REGRESSION, _REGISTRATION),
        (_FINAL,),
        RepairSettings(),
        # On large meshes, searches that match all vertices take most of the time. Crease eigenvectors are
        # left out, because they need the exact eigensolver.
        large=Preset(
            (replace(_WAVELETS, number_of_samples=1000),),
            (
                replace(_REGRESSION, number_of_crease_eigenvectors=0, ends_on_samples=True),
                replace(_REGISTRATION, starts_on_samples=True),
            ),
            (replace(_FINAL, number_of_samples=1000, starts_on_samples=True),),
            RepairSettings(),
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
