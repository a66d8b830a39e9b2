"""A stage of refinement: its method and its sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from jaxsmw.choices import ITERATIONS, NUMBER_OF_EIGENVECTORS
from jaxsmw.core.refinement import check_samples_use
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.coarse_to_fine import CoarseToFine
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.errors import InputError, check_whole_number
from jaxsmw.geometry.shot import SHOT_DIMENSION


@dataclass(frozen=True, init=False)
class Stage:
    """A stage of refinement: a refiner with its numbers of eigenvectors, iterations, descriptors and samples.

    `jaxsmw.match` and `Preset` accept stages. All arguments except `refiner` are keyword arguments. All
    arguments become attributes of the same names.

    **Attributes:**

    - `refiner`: the method, an instance of a subclass of `Refiner`: `WaveletPreservation` (the default),
      `FeatureRegression`, `Registration` or your own subclass. An example is
      `WaveletPreservation(bank=Meyer(8))`.
    - `number_of_eigenvectors`: the number of eigenvectors of each shape, at least 1; 100 by default. Leave
      the argument out for a refiner with levels, such as `Registration(levels=(35, 60))`. The stage then uses
      the largest level.
    - `iterations`: the number of iterations, at least 1; 3 by default. For a refiner with levels, leave the
      argument out, because each level is one iteration.
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

    **Raises:** `InputError` if `refiner` is not a `Refiner`, or if there are fewer samples than eigenvectors.
    `InputError` is also raised if `starts_on_samples` or `ends_on_samples` is True, but the stage has no
    samples, or its refiner does not support the option. `WaveletPreservation` supports neither option.
    `InputError` is also raised if a number of eigenvectors, iterations, descriptors, crease eigenvectors or
    samples is not an integer, is out of range or contradicts the refiner's levels.
    """

    refiner: Refiner
    number_of_eigenvectors: int
    iterations: int
    number_of_descriptors: int
    number_of_crease_eigenvectors: int
    number_of_samples: int | None
    starts_on_samples: bool
    ends_on_samples: bool
    stop_when_unchanged: bool

    def __init__(
        self,
        refiner: Refiner = WaveletPreservation(),  # noqa: B008 (immutable)
        *,
        number_of_eigenvectors: int | None = None,
        iterations: int | None = None,
        number_of_descriptors: int = 0,
        number_of_crease_eigenvectors: int = 0,
        number_of_samples: int | None = None,
        starts_on_samples: bool = False,
        ends_on_samples: bool = False,
        stop_when_unchanged: bool = False,
    ) -> None:
        if not isinstance(refiner, Refiner):
            raise InputError(
                f"refiner is {refiner!r}: give a Refiner such as WaveletPreservation(bank=Meyer(8))."
            )
        largest, count = max(refiner.levels, default=None), len(refiner.levels) or None
        sizes = {
            "number_of_eigenvectors": _derived(
                "number_of_eigenvectors", number_of_eigenvectors, largest, NUMBER_OF_EIGENVECTORS
            ),
            "iterations": _derived("iterations", iterations, count, ITERATIONS),
            "number_of_descriptors": number_of_descriptors,
            "number_of_crease_eigenvectors": number_of_crease_eigenvectors,
        }
        if number_of_samples is not None:
            sizes["number_of_samples"] = number_of_samples
        checked = {name: check_whole_number(name, value) for name, value in sizes.items()}
        try:
            check_samples_use(refiner, number_of_samples is not None, starts_on_samples, ends_on_samples)
        except ValueError as error:
            raise InputError(f"{error}.") from None
        others = {
            "refiner": refiner,
            "number_of_samples": None,
            "starts_on_samples": starts_on_samples,
            "ends_on_samples": ends_on_samples,
            "stop_when_unchanged": stop_when_unchanged,
        }
        for name, value in (others | checked).items():
            object.__setattr__(self, name, value)
        self._check_sizes()

    def _check_sizes(self) -> None:
        if self.number_of_eigenvectors < 1:
            raise InputError(f"{self.number_of_eigenvectors} eigenvectors were requested: give at least 1.")
        if self.iterations < 1:
            raise InputError(f"{self.iterations} iterations were requested: give at least 1.")
        if not 0 <= self.number_of_descriptors <= SHOT_DIMENSION:
            raise InputError(
                f"{self.number_of_descriptors} descriptors were requested, but SHOT has {SHOT_DIMENSION}: "
                f"give a number from 0 to {SHOT_DIMENSION}."
            )
        if self.number_of_crease_eigenvectors < 0:
            raise InputError(
                f"{self.number_of_crease_eigenvectors} crease eigenvectors were requested: give 0 or more."
            )
        if self.number_of_samples is not None and self.number_of_samples < self.number_of_eigenvectors:
            raise InputError(
                f"number_of_samples is {self.number_of_samples}, too few for {self.number_of_eigenvectors} "
                "eigenvectors: use more samples (usually five per eigenvector) or fewer eigenvectors."
            )

    @property
    def settings(self) -> dict[str, Any]:
        """The refiner, the iterations and the Boolean attributes, as keyword arguments of `jaxsmw.refine`.

        The levels of the refiner are an array, so stages with equally many levels share a compiled program.
        """
        refiner = self.refiner
        return {
            "refiner": refiner.with_traced_levels() if isinstance(refiner, CoarseToFine) else refiner,
            "iterations": self.iterations,
            "starts_on_samples": self.starts_on_samples,
            "ends_on_samples": self.ends_on_samples,
            "stop_when_unchanged": self.stop_when_unchanged,
        }

    def with_levels(self, levels: tuple[int, ...]) -> Stage:
        """Return the stage with other levels.

        The largest level is the new number of eigenvectors. The stage has one iteration per level.

        **Arguments:**

        - `levels`: the number of eigenvectors in each iteration, as a tuple of integers.

        **Raises:** `InputError` if the refiner has no levels, or if there are fewer samples than
        eigenvectors.
        """
        if not isinstance(self.refiner, CoarseToFine):
            raise InputError(
                f"{type(self.refiner).__name__} has no levels: use FeatureRegression or Registration."
            )
        refiner = replace(self.refiner, levels=levels)
        derived: dict[str, Any] = {"number_of_eigenvectors": None, "iterations": None}
        return replace(self, refiner=refiner, **derived)

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


def _derived(name: str, given: int | None, derived: int | None, default: int) -> int:
    """Return `derived` if the refiner has levels; else `given`, or `default` if `given` is None."""
    if derived is None:
        return default if given is None else given
    if given is not None and given != derived:
        raise InputError(
            f"{name} is {given!r}, but the refiner's levels require {derived}: leave {name} out."
        )
    return derived
