"""Stages of refinement, and presets that say in which order they run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from typing import NamedTuple, get_args

from jaxsmw.choices import ITERATIONS, NUMBER_OF_EIGENVECTORS, PresetName
from jaxsmw.core.refinement import RefineSettings, check_samples_use
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.errors import InputError, check_whole_number
from jaxsmw.geometry.shot import SHOT_DIMENSION
from jaxsmw.matching.settings import SearchSettings


class _FromRefiner(int):
    """The default of a number that follows from the refiner. A caller's 0 is another object, and refused."""


_FROM_REFINER = _FromRefiner()


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of refinement: a refiner with its numbers of eigenvectors, iterations, descriptors and samples.

    `jaxsmw.match` and `Preset` accept stages. All arguments except `refiner` are keyword arguments.

    **Attributes:**

    - `refiner`: the method, an instance of a subclass of `Refiner`: `WaveletPreservation` (the default),
      `FeatureRegression`, `Registration` or your own subclass. An example is
      `WaveletPreservation(bank=Meyer(8))`.
    - `number_of_eigenvectors`: the number of eigenvectors of each shape, at least 1; 100 by default. For a
      refiner with levels, such as `Registration(levels=(35, 60))`, it is the largest level.
    - `iterations`: the number of iterations, at least 1; 3 by default. For a refiner with levels, each level
      is one iteration.
    - `number_of_descriptors`: the number of principal components of SHOT that the refiner uses, from 0 to
      352; 0 by default.
    - `number_of_crease_eigenvectors`: the number of crease eigenvectors of each shape that the refiner uses,
      at least 0; 0 by default. See `jaxsmw.geometry.crease_eigenvectors`.
    - `number_of_samples`: the number of samples of each shape, at least the number of eigenvectors. The
      iterations match only the samples, and a final nearest-neighbour search matches all vertices. With None
      (the default), all iterations use all vertices.
    - `starts_on_samples`: whether the first functional map uses the matches of the samples only; False by
      default. This argument must be True if the previous stage ends on samples.
    - `ends_on_samples`: whether the stage matches the samples only; False by default. This argument must be
      False for the last stage.
    - `stop_when_unchanged`: whether refinement stops when an iteration changes no match; False by default.
    - `history`: whether the stage records a `History`; False by default.

    **Raises:** `InputError` if `refiner` is not a `Refiner`, or if there are fewer samples than eigenvectors.
    `InputError` is also raised if `starts_on_samples` or `ends_on_samples` is True, but the stage has no
    samples, or its refiner does not support the option. `WaveletPreservation` supports neither option.
    `InputError` is also raised if a number of eigenvectors, iterations, descriptors, crease eigenvectors or
    samples is not an integer, is out of range or contradicts the refiner's levels.
    """

    refiner: Refiner = field(default=WaveletPreservation(), kw_only=False)
    number_of_eigenvectors: int = _FROM_REFINER
    iterations: int = _FROM_REFINER
    number_of_descriptors: int = 0
    number_of_crease_eigenvectors: int = 0
    number_of_samples: int | None = None
    starts_on_samples: bool = False
    ends_on_samples: bool = False
    stop_when_unchanged: bool = False
    history: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.refiner, Refiner):
            raise InputError(
                f"refiner is {self.refiner!r}: give a Refiner such as WaveletPreservation(bank=Meyer(8))."
            )
        self._derive("number_of_eigenvectors", max(self.refiner.levels, default=None), NUMBER_OF_EIGENVECTORS)
        self._derive("iterations", len(self.refiner.levels) or None, ITERATIONS)
        for name in ("number_of_eigenvectors", "iterations"):
            check_whole_number(name, getattr(self, name), 1)
        check_whole_number("number_of_descriptors", self.number_of_descriptors, 0, SHOT_DIMENSION)
        check_whole_number("number_of_crease_eigenvectors", self.number_of_crease_eigenvectors, 0)
        if self.number_of_samples is not None:
            check_whole_number("number_of_samples", self.number_of_samples, 1)
            if self.number_of_samples < self.number_of_eigenvectors:
                raise InputError(
                    f"number_of_samples is {self.number_of_samples}, too few for "
                    f"{self.number_of_eigenvectors} eigenvectors: use more samples (usually five per "
                    "eigenvector) or fewer eigenvectors."
                )
        samples_use = self.number_of_samples is not None, self.starts_on_samples, self.ends_on_samples
        check_samples_use(self.refiner, *samples_use)

    def _derive(self, name: str, derived: int | None, default: int) -> None:
        """Set a number that was left out, and check that a given number agrees with the refiner's levels."""
        number = getattr(self, name)
        if number is _FROM_REFINER:
            object.__setattr__(self, name, default if derived is None else derived)
        elif derived is not None and number != derived:
            raise InputError(
                f"{name} is {number!r}, but the refiner's levels require {derived}: leave {name} out."
            )

    @property
    def sizes(self) -> Sizes:
        """What the stage needs of each shape."""
        return Sizes(
            self.number_of_eigenvectors,
            self.number_of_crease_eigenvectors,
            self.number_of_samples or 0,
            self.refiner.further_bases,
        )

    def settings(self, *, partial: bool = False, traced: bool = True) -> RefineSettings:
        """Return the stage as keyword arguments of `jaxsmw.refine`, for two full shapes or a partial pair.

        If JAX traces the stage, the levels of the refiner are an array, so that stages with equally many
        levels share a compiled program.
        """
        return RefineSettings(
            refiner=self.refiner.with_traced_levels() if traced else self.refiner,
            iterations=self.iterations,
            starts_on_samples=self.starts_on_samples,
            ends_on_samples=self.ends_on_samples,
            partial=partial,
            stop_when_unchanged=self.stop_when_unchanged,
            history=self.history,
        )

    def with_levels(self, levels: tuple[int, ...]) -> Stage:
        """Return the stage with other levels.

        The largest level is the new number of eigenvectors. The stage has one iteration per level.

        **Arguments:**

        - `levels`: the number of eigenvectors in each iteration, as a tuple of integers.

        **Raises:** `InputError` if the refiner has no levels, or if there are fewer samples than
        eigenvectors.
        """
        refiner = self.refiner.with_levels(levels)
        return replace(self, refiner=refiner, number_of_eigenvectors=_FROM_REFINER, iterations=_FROM_REFINER)

    def coarsened(self, levels: tuple[int, ...]) -> Stage:
        """Return the stage with other levels, at most its number of eigenvectors each.

        A stage whose refiner has no levels is not changed.
        """
        if not self.refiner.levels:
            return self
        return self.with_levels(tuple(min(level, self.number_of_eigenvectors) for level in levels))

    def without_descriptors(self) -> Stage:
        """Return the stage without descriptors."""
        return replace(self, number_of_descriptors=0)

    def fitted(self, number_of_vertices: int) -> Stage:
        """Return the stage adapted to a small mesh.

        The numbers of eigenvectors and of crease eigenvectors are reduced to at most half the number of
        vertices. If the number of samples is at least the number of vertices, the stage uses all vertices
        instead of samples.

        **Arguments:**

        - `number_of_vertices`: the number of referenced vertices of the smaller mesh.
        """
        most, fitted = max(1, number_of_vertices // 2), self
        if self.number_of_samples is not None and self.number_of_samples >= number_of_vertices:
            fitted = replace(self, number_of_samples=None, starts_on_samples=False, ends_on_samples=False)
        if self.number_of_crease_eigenvectors > most:
            fitted = replace(fitted, number_of_crease_eigenvectors=most)
        if self.number_of_eigenvectors <= most:
            return fitted
        if self.refiner.levels:
            return fitted.with_levels(tuple(min(level, most) for level in self.refiner.levels))
        return replace(fitted, number_of_eigenvectors=most)


class Sizes(NamedTuple):
    """What stages need of each shape: numbers of eigenvectors, crease eigenvectors and samples, and bases."""

    number_of_eigenvectors: int
    number_of_crease_eigenvectors: int = 0
    number_of_samples: int = 0
    bases: tuple[str, ...] = ()

    @classmethod
    def of_all(cls, every: Iterable[Sizes]) -> Sizes:
        """Return what several stages need together."""
        eigenvectors, creases, samples, bases = zip(*every, strict=True)
        return cls(max(eigenvectors), max(creases), max(samples), tuple(dict.fromkeys(chain(*bases))))


@dataclass(frozen=True)
class Preset:
    """Stages of refinement and settings of the search, for the argument `preset` of `jaxsmw.match`.

    The stages run in the order `first`, `repeated`, `final`, and each stage starts from the map of the
    previous stage. A map is judged before the final stages run. The search runs the repeated stages again.
    `jaxsmw.PRESETS` contains three ready presets.

    **Attributes:**

    - `first`: a tuple of stages that run once, before the repeated stages. Without a search, these can be all
      stages.
    - `repeated`: a tuple of stages that the search runs again. Without a search, they run once.
    - `final`: a tuple of stages that run once, after the search (Table R42).
    - `search`: the `SearchSettings` that determine how the right map is searched for; None (the default) to
      take the first map.
    - `large`: the preset that is used instead if both meshes have at least 15 000 vertices; None (the
      default) to use this preset for meshes of any size.

    **Raises:** `InputError` if there is no stage, if an attribute has the wrong type, or if there is a
    search, but no repeated stage. `InputError` is also raised if one of these rules is broken. The last
    stage, and the last stage before the final stages, must not end on samples. If a stage ends on samples,
    the next stage must start on samples, and must not have more samples. The last repeated stage must have
    levels.
    """

    first: tuple[Stage, ...] = ()
    repeated: tuple[Stage, ...] = ()
    final: tuple[Stage, ...] = ()
    search: SearchSettings | None = None
    large: Preset | None = None

    def __post_init__(self) -> None:
        for name in ("first", "repeated", "final"):
            stages = getattr(self, name)
            if not isinstance(stages, tuple) or not all(isinstance(stage, Stage) for stage in stages):
                raise InputError(f"{name} is {stages!r}: give a tuple of stages.")
        if self.search is not None and not isinstance(self.search, SearchSettings):
            raise InputError(f"search is {self.search!r}: give SearchSettings or None.")
        if self.large is not None and not isinstance(self.large, Preset):
            raise InputError(f"large is {self.large!r}: give a Preset or None.")
        _check_order(self.stages)
        if self.final:
            if not self.before_final:
                raise InputError("a preset of final stages has no map to judge: add stages before them.")
            if self.before_final[-1].ends_on_samples:
                raise InputError(
                    "the last stage before the final stages ends on samples, but its map is judged at all "
                    "vertices: use the default."
                )
        if self.search is None:
            return
        if not self.repeated:
            raise InputError("the search has no stage to repeat: give the preset repeated stages.")
        if not self.repeated[-1].refiner.levels:
            raise InputError(
                f"the search repeats a stage of {type(self.repeated[-1].refiner).__name__}, which has no "
                "levels: let the repeated stages end with a refiner with levels, such as Registration."
            )

    @property
    def stages(self) -> tuple[Stage, ...]:
        """All stages, in the order in which they run."""
        return self.first + self.repeated + self.final

    @property
    def before_final(self) -> tuple[Stage, ...]:
        """The stages before the final stages, whose map is judged."""
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
        return replace(self, large=None)._with_stages(lambda stage: stage.fitted(number_of_vertices))

    def with_history(self) -> Preset:
        """Return the preset whose last stage records a `History`."""

        def recorded(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
            return (*stages[:-1], replace(stages[-1], history=True))

        if self.final:
            return replace(self, final=recorded(self.final))
        if self.repeated:
            return replace(self, repeated=recorded(self.repeated))
        return replace(self, first=recorded(self.first))

    def without_descriptors(self) -> Preset:
        """Return the preset with stages that use no descriptors."""
        return self._with_stages(Stage.without_descriptors)

    def _with_stages(self, change: Callable[[Stage], Stage]) -> Preset:
        first, repeated, final = (tuple(map(change, s)) for s in (self.first, self.repeated, self.final))
        large = None if self.large is None else self.large._with_stages(change)
        return replace(self, first=first, repeated=repeated, final=final, large=large)

    @property
    def cuts_shortcuts(self) -> bool:
        """Whether meshes are cut where they are fused with themselves; see `SearchSettings.cut_shortcuts`."""
        return self.search is not None and self.search.cut_shortcuts

    @property
    def sizes(self) -> Sizes:
        """What the stages need of each shape."""
        return Sizes.of_all(stage.sizes for stage in self.stages)

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
        search=SearchSettings(),
        # On large meshes, searches that match all vertices take most of the time. Crease eigenvectors are
        # left out, because they need the exact eigensolver.
        large=Preset(
            (replace(_WAVELETS, number_of_samples=1000),),
            (
                replace(_REGRESSION, number_of_crease_eigenvectors=0, ends_on_samples=True),
                replace(_REGISTRATION, starts_on_samples=True),
            ),
            (replace(_FINAL, number_of_samples=1000, starts_on_samples=True),),
            search=SearchSettings(),
        ),
    ),
}
"""A dictionary from the names of the presets of `jaxsmw.match` to the presets, each a `Preset`.

`"paper"` has the settings of the MWP paper: one stage of `WaveletPreservation` with 100 eigenvectors and 3
iterations. `"fast"` has the same stage with iterations on 500 samples of each shape, as in the fast variant
of the MWP authors' program. `"accurate"` has four stages and a search: the stage of `"paper"`,
`FeatureRegression` with up to 35 eigenvectors, and `Registration` with up to 200 eigenvectors, twice. The
fourth stage runs once, after the search. If both meshes have at least 15 000 vertices, all stages of
`"accurate"` iterate on 1000 samples. `docs/accuracy.md` reports the errors of `"accurate"`.
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
