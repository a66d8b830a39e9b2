"""The base class of coarse-to-fine refiners, and functions that these refiners share."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Iterable
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int32

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.module import field
from jaxsmw.core.refiner import PreparedT, Refiner, State
from jaxsmw.core.spectrum import Spectrum


def _whole_numbers(levels: Iterable[int]) -> tuple[int, ...]:
    try:
        return tuple(operator.index(level) for level in levels)
    except TypeError:
        raise TypeError(f"the levels are {levels!r}, but they must be integers") from None


class CoarseToFineState(State):
    """The state of a coarse-to-fine refiner.

    **Attributes:**

    - `iteration`: the number of the iteration, an array of type int32. `update` computes it as `jnp.int32(0)`
      in the first iteration, and as `previous.iteration + 1` in later iterations.
    - `reverse_map`: the map Y -> X (n,) for refiners that use it, which `recover_both` adds; otherwise None.
    """

    iteration: Int32[Array, ""]
    reverse_map: Int32[Array, " n"] | None = field(default=None, kw_only=True)


CoarseStateT = TypeVar("CoarseStateT", bound=CoarseToFineState)


class CoarseToFine(Refiner[PreparedT, CoarseStateT], Generic[PreparedT, CoarseStateT]):
    """The abstract base class of refiners that use more eigenvectors in later iterations.

    The number of eigenvectors increases as in ZoomOut (Melzi et al. 2019). Ready subclasses are
    `FeatureRegression` and `Registration`. The states of a subclass are subclasses of `CoarseToFineState`.

    **Arguments:**

    - `levels`: the number of eigenvectors (the level) of each iteration, as an iterable of integers of at
      least 1. If a level exceeds the number of available eigenvectors, the iteration uses all of them. If X
      and Y have different numbers of eigenvectors, a level applies to the shape with more eigenvectors, and
      the other shape uses a proportional number. Iterations after the last level use all eigenvectors, as do
      all iterations if `levels` is empty (the default).

    **Raises:** `TypeError` if `levels` is not an iterable of integers; `ValueError` if a level is below 1.
    """

    levels: tuple[int, ...] = field(default=(), converter=_whole_numbers)

    def __check_init__(self) -> None:
        if any(level < 1 for level in self.levels):
            raise ValueError(f"the levels are {self.levels}, but each level needs at least 1 eigenvector")

    @property
    def matches_samples_with_all(self) -> bool:
        """Always True."""
        return True

    def with_levels(self, levels: tuple[int, ...]) -> CoarseToFine[PreparedT, CoarseStateT]:
        """Return the refiner with other levels."""
        return dataclasses.replace(self, levels=levels)

    def with_traced_levels(self) -> CoarseToFine[PreparedT, CoarseStateT]:
        """Return the refiner with levels as an array."""
        import equinox as eqx

        return eqx.tree_at(lambda refiner: refiner.levels, self, np.array(self.levels, np.int32))

    def active_eigenvectors(
        self, prepared: PreparedT, iteration: Int32[Array, ""]
    ) -> tuple[Bool[Array, " k_x"], Bool[Array, " k_y"]]:
        """Return masks of the eigenvectors of X (k_x,) and of Y (k_y,) that an iteration uses."""
        sizes = prepared.spectrum_x.eigenvalues.shape[0], prepared.spectrum_y.eigenvalues.shape[0]
        xp, largest = namespace(iteration), max(sizes)
        levels = xp.append(xp.asarray(self.levels, xp.int32), largest)
        level = xp.minimum(levels[xp.minimum(iteration, len(self.levels))], largest)

        def active(size: int) -> Bool[Array, " k"]:
            return xp.arange(size, dtype=xp.int32) < -(-level * size // largest)

        return active(sizes[0]), active(sizes[1])

    def is_settled(self, state: CoarseStateT) -> Bool[Array, ""]:
        """Return whether this iteration and all later iterations use all eigenvectors."""
        return state.iteration >= len(self.levels)


def check_features(spectrum_x: Spectrum, spectrum_y: Spectrum) -> None:
    """Raise `ValueError` unless two shapes have equal numbers of descriptors and of crease eigenvectors."""
    for kind in ("descriptors", "crease_eigenvectors"):
        arrays = [getattr(spectrum, kind) for spectrum in (spectrum_x, spectrum_y)]
        numbers = [0 if array is None else array.shape[1] for array in arrays]
        if numbers[0] != numbers[1]:
            name = kind.replace("_", " ")
            raise ValueError(
                f"X has {numbers[0]} {name} and Y has {numbers[1]}: give both shapes the same number of "
                f"{name}"
            )


def partial_matching_weights(
    weights_x: Float[Array, " m"],
    residuals_x: Float[Array, " m"],
    weights_y: Float[Array, " n"],
    residuals_y: Float[Array, " n"],
) -> tuple[Float[Array, " m"], Float[Array, " n"]]:
    """Reduce the weights of those vertices of the full shape that the partial shape probably lacks.

    The shape with the larger mean residual is treated as the full shape. For each vertex of the full shape,
    the weight w becomes `w / (1 + (r / mean)²)`. In this formula, r is the residual of the vertex (the
    squared distance to its match), and `mean` is the weighted mean residual of the other shape. Both shapes
    use the same unit. Then the weights of the full shape are scaled so that they sum to 1, as the given
    weights do. The weights of the other shape stay the same.
    """
    xp = namespace(weights_x)
    mean_x, mean_y = xp.sum(weights_x * residuals_x), xp.sum(weights_y * residuals_y)

    def reweighted(weights: Array, residuals: Array, mean: Array, other: Array) -> Array:
        falling = weights / (1 + (residuals / xp.maximum(other, xp.finfo(other.dtype).tiny)) ** 2)
        return xp.where(mean > other, falling / xp.sum(falling), weights)

    return (
        reweighted(weights_x, residuals_x, mean_x, mean_y),
        reweighted(weights_y, residuals_y, mean_y, mean_x),
    )
