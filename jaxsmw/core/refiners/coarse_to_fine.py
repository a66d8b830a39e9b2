"""What refiners share that begin with few eigenvectors and know samples, parts and patches."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

from jaxsmw.core.checks import check_choice
from jaxsmw.core.refinement import Problem, Refiner
from jaxsmw.core.spectrum import Spectrum


def _whole_numbers(levels: Iterable[int]) -> tuple[int, ...]:
    try:
        return tuple(operator.index(level) for level in levels)
    except TypeError:
        raise TypeError(f"the levels are {levels!r}, but a tuple of whole numbers is needed") from None


class CoarseToFine(Refiner):
    """A refiner in whose iterations more and more eigenvectors count, as in ZoomOut (Melzi et al. 2019).

    What `update` makes has two attributes: `iteration`, from 0 on, and `functional_map`.

    **Arguments:**

    - `levels`: how many eigenvectors count in each iteration (of the shape with more of them; of the other in
      proportion); after these all of them count.
    - `partial`: one shape is a part of the other.
    - `search`: how the last matches are found, among all vertices: `"exhaustive"`, `"patches"` or `"auto"`.

    **Raises:** `TypeError` if `levels` is no tuple of integers; `ValueError` for a level below 1, or another
    kind of search.
    """

    levels: tuple[int, ...] = eqx.field(static=True, default=(), converter=_whole_numbers)
    partial: bool = eqx.field(static=True, default=False)
    search: Literal["auto", "exhaustive", "patches"] = eqx.field(static=True, default="auto")

    def __check_init__(self) -> None:
        check_choice("search", self.search, ("auto", "exhaustive", "patches"))
        if any(level < 1 for level in self.levels):
            raise ValueError(f"the levels are {self.levels}, but each needs an eigenvector at least")

    def counting_eigenvectors(
        self, problem: Problem, iteration: Int32[Array, ""]
    ) -> tuple[Bool[Array, " k_x"], Bool[Array, " k_y"]]:
        """Which eigenvectors of X and of Y count in an iteration."""
        sizes = problem.spectrum_x.eigenvalues.shape[0], problem.spectrum_y.eigenvalues.shape[0]
        largest = max(sizes)

        def counting(size: int) -> Bool[Array, " k"]:
            counts = [-(-min(level, largest) * size // largest) for level in (*self.levels, largest)]
            level = jnp.asarray(np.array(counts, np.int32))[jnp.minimum(iteration, len(self.levels))]
            return jnp.arange(size, dtype=jnp.int32) < level

        return counting(sizes[0]), counting(sizes[1])

    def functional_map(self, updated: Any) -> Float[Array, "k_x k_y"]:
        """That of the matches of this iteration."""
        return updated.functional_map

    def is_settled(self, updated: Any) -> Bool[Array, ""]:
        """Whether all levels have been gone through."""
        return updated.iteration >= len(self.levels)


def check_descriptors(spectrum_x: Spectrum, spectrum_y: Spectrum) -> None:
    """**Raises:** `ValueError` if only one shape has descriptors, or they differ in number."""
    numbers = [0 if s.descriptors is None else s.descriptors.shape[1] for s in (spectrum_x, spectrum_y)]
    if numbers[0] != numbers[1]:
        raise ValueError(f"X has {numbers[0]} descriptors and Y {numbers[1]}, but they must be the same")


def doubted(
    weights_x: Float[Array, " m"],
    residuals_x: Float[Array, " m"],
    weights_y: Float[Array, " n"],
    residuals_y: Float[Array, " n"],
) -> tuple[Float[Array, " m"], Float[Array, " n"]]:
    """Weights where that of the shape whose matches fit worse, the whole, falls with their residuals."""
    mean_x, mean_y = jnp.sum(weights_x * residuals_x), jnp.sum(weights_y * residuals_y)

    def doubt(weights: Array, residuals: Array, mean: Array, other: Array) -> Array:
        falling = weights / (1 + (residuals / jnp.maximum(other, jnp.finfo(other.dtype).tiny)) ** 2)
        return jnp.where(mean > other, falling / jnp.sum(falling), weights)

    return doubt(weights_x, residuals_x, mean_x, mean_y), doubt(weights_y, residuals_y, mean_y, mean_x)
