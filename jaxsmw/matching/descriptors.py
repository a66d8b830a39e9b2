"""Vertex descriptors that are comparable between shapes: principal components of SHOT."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg
from jaxtyping import Float

from jaxsmw.errors import InputError
from jaxsmw.geometry.shot import SHOT_DIMENSION, SHOT_RADIUS
from jaxsmw.matching.shapes import PreparedShape
from jaxsmw.runtime.threads import one_blas_thread

# On meshes with at least `FINE_FROM` vertices, a neighbourhood of the smaller radius contains at least about
# ten vertices.
FINE_FROM, FINE_RADIUS = 2000, 2 / 3 * SHOT_RADIUS


class DescriptorAxes(NamedTuple):
    """The axes in which the SHOT descriptors of several shapes are expressed, so that they are comparable.

    **Attributes:**

    - `radii`: the radii of SHOT, a tuple of floats in units of the square root of the area.
    - `principal`: the `PrincipalAxes` of SHOT at all radii. All shapes have equal weights.
    """

    radii: tuple[float, ...]
    principal: PrincipalAxes

    @classmethod
    def of(cls, shapes: Sequence[PreparedShape], number_of_descriptors: int) -> DescriptorAxes:
        """Compute the axes of largest variance.

        SHOT is computed with a radius of 0.06 times the square root of the area. If all meshes have at least
        2000 vertices and are fine enough for a smaller radius, SHOT is also computed with two thirds of this
        radius.

        **Arguments:**

        - `shapes`: the shapes, each a `PreparedShape`.
        - `number_of_descriptors`: the number d of axes, from 1 to 352.

        **Raises:** `InputError` if a mesh is too coarse for SHOT.
        """
        for radii in ((SHOT_RADIUS, FINE_RADIUS), (SHOT_RADIUS,)):
            if len(radii) > 1 and min(len(shape.mesh.vertices) for shape in shapes) < FINE_FROM:
                continue
            with suppress(InputError) if len(radii) > 1 else nullcontext():
                return cls(radii, PrincipalAxes.of(_Blocks(shapes, radii), number_of_descriptors))
        raise AssertionError("the usual radius returns axes or raises an error")

    def describe(self, shape: PreparedShape) -> PreparedShape:
        """Return a shape (n vertices) with dimensionless descriptors (n, d), whose mean squares are about 1.

        **Raises:** `InputError` if the mesh is too coarse for SHOT.
        """
        dtype = shape.spectrum.eigenvectors.dtype
        return with_descriptors(shape, self.principal.components(_shot_rows(shape, self.radii).astype(dtype)))


def check_number_of_descriptors(number: int) -> None:
    """Check that SHOT has a number of principal components.

    **Raises:** `InputError` if the number is not from 1 to 352.
    """
    if not 1 <= number <= SHOT_DIMENSION:
        raise InputError(f"{number} descriptors were requested: give a number from 1 to {SHOT_DIMENSION}.")


def with_descriptors(shape: PreparedShape, components: Float[np.ndarray, "a d"]) -> PreparedShape:
    """Return a shape with descriptors, given at its compared vertices (a, d)."""
    everywhere = shape.everywhere(components) * np.asarray(shape.spectrum.mask)[:, None]
    return replace(shape, spectrum=shape.spectrum.with_descriptors(jax.device_put(everywhere)))


def weights(shapes: Sequence[PreparedShape]) -> list[Float[np.ndarray, " a"]]:
    """Return the areas of the compared vertices of each shape (a,). Each shape has the same total weight."""
    areas = (np.asarray(shape.compared_spectrum.vertex_areas, np.float64) for shape in shapes)
    return [of_shape / of_shape.sum() / len(shapes) for of_shape in areas]


def _shot_rows(shape: PreparedShape, radii: Sequence[float]) -> Float[np.ndarray, "a c"]:
    with warnings.catch_warnings():
        if len(radii) > 1:
            warnings.simplefilter("ignore")
        return np.hstack([shape.shot(radius) for radius in radii])


class _Blocks:
    """The SHOT descriptors and weights of shapes, one block per shape.

    Descriptors are computed or read from the cache in every pass, because the descriptors of a large
    collection may not fit into memory.
    """

    def __init__(self, shapes: Sequence[PreparedShape], radii: Sequence[float]):
        self._shapes, self._radii = shapes, radii

    def __iter__(self) -> Iterator[tuple[Float[np.ndarray, "a c"], Float[np.ndarray, " a"]]]:
        for shape, weight in zip(self._shapes, weights(self._shapes), strict=True):
            shot = _shot_rows(shape, self._radii)
            yield shot, weight.astype(shot.dtype)


class PrincipalAxes(NamedTuple):
    """The principal axes of weighted rows.

    **Attributes:**

    - `mean`: the weighted mean of the rows (c,), in the unit of the rows.
    - `axes`: the axes (c, d), in order of decreasing variance. Each axis is divided by the standard deviation
      of the rows along the axis, so its unit is the inverse unit of the rows.
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
          blocks together sum to 1. The function reads `blocks` twice.
        - `number`: the number d of axes.
        """
        mean = sum(weight @ values for values, weight in blocks)
        covariance = 0
        for values, weight in blocks:
            centered = values - mean
            covariance = covariance + centered.T @ (weight[:, None] * centered)
        # On a busy machine, waiting threads make this decomposition up to 50 times slower.
        with one_blas_thread():
            size = len(mean)
            variances, directions = scipy.linalg.eigh(
                np.asarray(covariance, np.float64), subset_by_index=[size - number, size - 1]
            )
        scale = np.sqrt(np.maximum(variances[::-1], np.finfo(np.float64).tiny))
        return cls(np.asarray(mean), directions[:, ::-1] / scale)

    def components(self, values: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n d"]:
        """Return the principal components of rows (n, c), in the type of the rows."""
        return (values - self.mean) @ self.axes.astype(values.dtype)


def principal_components(
    values: Float[np.ndarray, "n c"], weight: Float[np.ndarray, " n"], number: int
) -> Float[np.ndarray, "n d"]:
    """Compute the first principal components of weighted rows, scaled to weighted mean squares of 1.

    **Arguments:**

    - `values`: the rows (n, c).
    - `weight`: the weights of the rows (n,), which sum to 1.
    - `number`: the number d of components.

    **Returns:** The components of the rows (n, d), in order of decreasing variance.
    """
    return PrincipalAxes.of([(values, weight)], number).components(values)
