"""Descriptors: principal components of SHOT in the same axes for all shapes, so that they are comparable."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float, Float32, Float64

from jaxsmw.errors import InputError
from jaxsmw.geometry.shot import SHOT_RADIUS
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.runtime.threads import one_blas_thread, side_by_side

# On meshes with at least `FINE_FROM` vertices, a neighbourhood of the smaller radius contains at least about
# ten vertices.
FINE_FROM, FINE_RADIUS = 2000, 2 / 3 * SHOT_RADIUS
# Rows do not vary along axes whose variance is a smaller share of the largest variance, except for rounding.
_LEAST_VARIANCE = 1e-12
# So many centred rows stay in the processor's cache.
_ROWS_PER_PRODUCT = 1000

ShotOfShapes = Callable[[float], Iterable[Float32[np.ndarray, "a 352"]]]
"""Returns SHOT at the compared vertices of each shape, one shape after another, for a radius."""


class PrincipalAxes(NamedTuple):
    """The principal axes of weighted rows.

    **Attributes:**

    - `mean`: the weighted mean of the rows (c,), in the unit of the rows.
    - `axes`: the axes (c, d), in order of decreasing variance. Each axis is divided by the standard deviation
      of the rows along the axis, so its unit is the inverse unit of the rows. An axis is zero if the rows do
      not vary along it.
    """

    mean: Float[np.ndarray, " c"]
    axes: Float[np.ndarray, "c d"]

    @classmethod
    def of(
        cls,
        blocks: Iterable[tuple[Float[np.ndarray, "n c"], Float[np.ndarray, " n"]]],
        number: int,
    ) -> PrincipalAxes:
        """Compute the first principal axes of rows that are given in blocks.

        **Arguments:**

        - `blocks`: pairs (rows, weights), which are arrays of shapes (n, c) and (n,). The weights of all
          blocks together sum to 1. The function reads `blocks` once.
        - `number`: the number d of axes.
        """
        origin, mean, moments = (np.zeros(()) for _ in range(3))
        for values, weight in blocks:
            origin = origin if origin.ndim else values.mean(axis=0)
            middle = len(values) // 2
            halves = (values[:middle], weight[:middle]), (values[middle:], weight[middle:])
            for first, second in side_by_side(functools.partial(_moments, origin), *halves):
                mean, moments = mean + first, moments + second
        covariance = moments - np.outer(mean, mean)
        # On a busy machine, waiting threads make this decomposition up to 50 times slower.
        with one_blas_thread():
            last = len(covariance) - 1
            variances, directions = scipy.linalg.eigh(
                covariance, subset_by_index=[last - number + 1, last], overwrite_a=True, check_finite=False
            )
        # All points of a sphere have nearly equal rows. Axes along which rows do not vary become zero.
        least = max(_LEAST_VARIANCE * variances[-1], np.finfo(np.float32).tiny)
        deviations = np.sqrt(np.maximum(variances, least))
        axes = np.where(variances > least, directions / deviations, 0)
        return cls(origin + mean, axes[:, ::-1])

    def components(self, values: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n d"]:
        """Return the principal components of rows (n, c), in the type of the rows."""
        components = values @ self.axes.astype(values.dtype)
        components -= (self.mean @ self.axes).astype(values.dtype)
        return components


def _moments(
    origin: Float[np.ndarray, " c"], rows: tuple[Float[np.ndarray, "n c"], Float[np.ndarray, " n"]]
) -> tuple[Float64[np.ndarray, " c"], Float64[np.ndarray, "c c"]]:
    """Return the weighted sums of rows and of their products, relative to an origin near their mean."""
    values, weight = rows
    roots = np.sqrt(weight).astype(values.dtype)[:, None]
    size = values.shape[1]
    first, second = np.zeros(size), np.zeros((size, size))
    for start in range(0, len(values), _ROWS_PER_PRODUCT):
        part = slice(start, start + _ROWS_PER_PRODUCT)
        centered = (values[part] - origin) * roots[part]
        first += roots[part, 0] @ centered
        second += centered.T @ centered  # BLAS takes half of the operations for such a product
    return first, second


class DescriptorAxes(NamedTuple):
    """The axes in which the SHOT descriptors of several shapes are expressed, so that they are comparable.

    **Attributes:**

    - `radii`: the radii of SHOT, a tuple of floats in units of the square root of the area.
    - `principal`: the `PrincipalAxes` of SHOT at all radii. All shapes have equal weights.
    """

    radii: tuple[float, ...]
    principal: PrincipalAxes

    @classmethod
    def of(
        cls, shapes: Sequence[PreparedShape], number_of_descriptors: int, shot: ShotOfShapes | None = None
    ) -> DescriptorAxes:
        """Compute the axes of largest variance.

        SHOT is computed with a radius of 0.06 times the square root of the area. If all meshes have at least
        2000 vertices and are fine enough for a smaller radius, SHOT is also computed with two thirds of this
        radius.

        **Arguments:**

        - `shapes`: the shapes, each a `PreparedShape`.
        - `number_of_descriptors`: the number d of axes, from 1 to 352.
        - `shot`: returns SHOT of the shapes for a radius. By default, SHOT of each shape is computed, or read
          from the cache, when it is needed, because that of a large collection may not fit into memory.

        **Raises:** `InputError` if a mesh is too coarse for SHOT.
        """

        def of_radii(*radii: float) -> DescriptorAxes:
            blocks = zip(_rows(shapes, radii, shot), _weights(shapes), strict=True)
            return cls(radii, PrincipalAxes.of(blocks, number_of_descriptors))

        if min(len(shape.mesh.vertices) for shape in shapes) >= FINE_FROM:
            with suppress(InputError), warnings.catch_warnings():
                # A mesh that is too coarse for the smaller radius still has descriptors of the usual radius.
                warnings.simplefilter("ignore")
                return of_radii(SHOT_RADIUS, FINE_RADIUS)
        return of_radii(SHOT_RADIUS)

    def describe(
        self, shapes: Sequence[PreparedShape], shot: ShotOfShapes | None = None
    ) -> list[PreparedShape]:
        """Return shapes (n vertices) with dimensionless descriptors (n, d), whose mean squares are about 1.

        **Raises:** `InputError` if a mesh is too coarse for SHOT.
        """
        with warnings.catch_warnings(), one_blas_thread():
            if len(self.radii) > 1:
                warnings.simplefilter("ignore")
            rows = _rows(shapes, self.radii, shot)
            components = map(self.principal.components, rows)
            return [
                shape.with_descriptors(of_shape) for shape, of_shape in zip(shapes, components, strict=True)
            ]


def _weights(shapes: Sequence[PreparedShape]) -> Iterator[Float[np.ndarray, " a"]]:
    """Yield the areas of the compared vertices of each shape (a,). Each shape has the same total weight."""
    for shape in shapes:
        areas = np.asarray(shape.compared_spectrum.vertex_areas, np.float64)
        yield areas / areas.sum() / len(shapes)


def _rows(
    shapes: Sequence[PreparedShape], radii: Sequence[float], shot: ShotOfShapes | None
) -> Iterator[Float32[np.ndarray, "a c"]]:
    """Yield SHOT of each shape at all radii, in one row per compared vertex."""

    def one_by_one(radius: float) -> Iterator[Float32[np.ndarray, "a 352"]]:
        return (shape.shot(radius) for shape in shapes)

    for of_shape in zip(*map(shot or one_by_one, radii), strict=True):
        yield np.hstack(of_shape)
