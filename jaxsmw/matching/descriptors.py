"""The descriptors of a pair: SHOT at all vertices or at samples, and principal components of SHOT."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float, Int64

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_DIMENSION, SHOT_RADIUS, shot_descriptors
from jaxsmw.matching.pair import Pair
from jaxsmw.runtime.threads import one_blas_thread, side_by_side

# A mesh with more than `_COMPARED_FROM` vertices is reduced to about `_COMPARED` samples. Descriptors
# cannot distinguish two vertices whose distance is below a few hundredths of the square root of the area.
# Therefore 10 000 samples are dense enough.
_COMPARED, _COMPARED_FROM = 10_000, 15_000
# On meshes with at least `_FINE` vertices, a neighbourhood of the smaller radius contains at least about ten
# vertices.
_FINE, _FINE_RADIUS = 2000, 2 / 3 * SHOT_RADIUS
# Descriptors with a radius above `SHOT_RADIUS` vary slowly over the surface. Therefore they are computed at
# only about `_SPREAD` samples.
_SPREAD = 2000


class SampledShape(NamedTuple):
    """A shape, and the vertices at which its descriptors are compared (the compared vertices).

    On a large mesh, descriptors are compared only at samples. On any other mesh, they are compared at all
    vertices.

    **Attributes:**

    - `mesh`: the `Mesh` with n vertices.
    - `samples`: the `SurfaceSamples` of the mesh, or None if descriptors are compared at all vertices.
    - `spectrum`: the `Spectrum` of the mesh, restricted to the compared vertices.
    """

    mesh: Mesh
    samples: SurfaceSamples | None
    spectrum: Spectrum

    @classmethod
    def make(cls, mesh: Mesh, samples: SurfaceSamples | None, spectrum: Spectrum) -> SampledShape:
        """Make a sampled shape from a mesh and its spectrum at all n vertices.

        **Raises:** `InputError` if the spectrum and the mesh have different numbers of vertices.
        """
        if (rows := spectrum.eigenvectors.shape[0]) != (n := len(mesh.vertices)):
            raise InputError(
                f"{mesh.name}: the mesh has {n} vertices, but its spectrum has {rows}: give the mesh's own "
                "spectrum."
            )
        if samples is not None:
            spectrum = spectrum.sample(jnp.asarray(samples.vertices))
        return cls(mesh, samples, spectrum)

    def rows(self, vertices: Int64[np.ndarray, " v"]) -> Int64[np.ndarray, " v"]:
        """Return the row of each vertex (v,) in an array with one row per compared vertex.

        A vertex that is not a sample shares the row of the nearest sample. On a shape without samples, the
        row of a vertex is the vertex index itself.
        """
        return vertices if self.samples is None else self.samples.nearest[vertices]


@dataclass(frozen=True, eq=False)
class SampledPair:
    """A pair of shapes, each with the vertices at which its descriptors are compared.

    **Attributes:**

    - `pair`: the `Pair` of the source X and the target Y.
    - `x`, `y`: the source X and the target Y, each a `SampledShape`.
    """

    pair: Pair
    x: SampledShape
    y: SampledShape

    @property
    def sides(self) -> tuple[SampledShape, SampledShape]:
        """The sampled shapes X and Y."""
        return self.x, self.y

    @cached_property
    def shot(self) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
        """SHOT of X and Y at the compared vertices, with the usual radius; see `paired_shot`.

        The arrays are dimensionless and have one row per compared vertex and 352 columns.
        """
        return paired_shot(self)


def sample_pair(pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum) -> SampledPair:
    """Choose the vertices of X and of Y at which descriptors are compared.

    On a mesh with more than 15 000 vertices, descriptors are compared at about 10 000 evenly spread samples.
    On any other mesh, descriptors are compared at all vertices.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `spectrum_x`, `spectrum_y`: the spectra at all vertices of X and of Y.

    **Returns:** The sampled pair.

    **Raises:** `InputError` if a spectrum and its mesh have different numbers of vertices.
    """
    samples_x, samples_y = side_by_side(compared_samples, *pair.meshes)
    return SampledPair(
        pair,
        SampledShape.make(pair.mesh_x, samples_x, spectrum_x),
        SampledShape.make(pair.mesh_y, samples_y, spectrum_y),
    )


def compared_samples(mesh: Mesh) -> SurfaceSamples | None:
    """Return the samples at which descriptors are compared, or None for all vertices; see `sample_pair`."""
    return poisson_disk_samples(mesh, _COMPARED) if len(mesh.vertices) > _COMPARED_FROM else None


def describe(
    pair: Pair,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    number_of_descriptors: int,
    *,
    sampled: SampledPair | None = None,
) -> tuple[Spectrum, Spectrum]:
    """Add vertex descriptors, which are principal components of SHOT, to the spectra of both shapes.

    SHOT is computed with a radius of 0.06 times the square root of the area. If both meshes have at least
    2000 vertices and are fine enough for a smaller radius, SHOT is also computed with two thirds of this
    radius. The principal components are computed for both shapes together. Each component is scaled so that
    its mean square over the areas of both shapes is 1.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices), a `Pair`.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, each a `Spectrum` from `paired_spectra`.
    - `number_of_descriptors`: the number d of components, from 1 to 352. The d components of largest variance
      are used.
    - `sampled`: the `SampledPair` that `jaxsmw.matching.descriptors.sample_pair` returns for this pair, if it
      was
      already computed.

    **Returns:** The spectra of X and Y, with dimensionless `descriptors` of shapes (m, d) and (n, d). The
    function issues a `UserWarning` if a mesh is too coarse for SHOT at more than 1 % of its vertices.

    **Raises:** `InputError` if `number_of_descriptors` is not from 1 to 352, if a mesh is too coarse for SHOT
    at more than half of its vertices, or if a spectrum and its mesh have different numbers of vertices.
    """
    if not 1 <= number_of_descriptors <= SHOT_DIMENSION:
        raise InputError(
            f"{number_of_descriptors} descriptors were requested: give a number from 1 to {SHOT_DIMENSION}."
        )
    sampled = sampled or sample_pair(pair, spectrum_x, spectrum_y)
    dtype = spectrum_x.eigenvectors.dtype
    shot = np.hstack([np.concatenate(both) for both in _shot_at_all_radii(sampled)], dtype=dtype)
    areas = [np.asarray(side.spectrum.vertex_areas, np.float64) for side in sampled.sides]
    weight = np.concatenate([a / a.sum() / 2 for a in areas]).astype(dtype)
    components = principal_components(shot, weight, number_of_descriptors)
    of_x, of_y = np.split(components, [len(areas[0])])
    return _at_all_vertices(sampled.x, spectrum_x, of_x), _at_all_vertices(sampled.y, spectrum_y, of_y)


def _at_all_vertices(
    shape: SampledShape, spectrum: Spectrum, components: Float[np.ndarray, "a d"]
) -> Spectrum:
    """Extend descriptors from the compared vertices to all vertices, and add them to the spectrum."""
    everywhere = components if shape.samples is None else components[shape.samples.nearest]
    everywhere = everywhere * np.asarray(spectrum.mask)[:, None]
    return spectrum.with_descriptors(jax.device_put(everywhere))


class DescriptorAxes(NamedTuple):
    """The axes in which the SHOT descriptors of all shapes of a collection are expressed.

    Because all shapes share these axes, descriptors are comparable between any two shapes of the collection.
    By contrast, the function `describe` computes axes for one pair of shapes alone.

    **Attributes:**

    - `radii`: the radii of SHOT, a tuple of floats in units of the square root of the area.
    - `principal`: the `PrincipalAxes` of SHOT at all radii. All shapes have equal weights.
    """

    radii: tuple[float, ...]
    principal: PrincipalAxes

    @classmethod
    def of(cls, shapes: Sequence[SampledShape], number_of_descriptors: int) -> DescriptorAxes:
        """Compute the axes of largest variance.

        SHOT has the same radii as in `describe`: the smaller radius is used if all shapes allow it.

        **Arguments:**

        - `shapes`: the shapes of the collection, each a `SampledShape`.
        - `number_of_descriptors`: the number d of axes, from 1 to 352.

        **Raises:** `InputError` if a mesh is too coarse for SHOT.
        """
        for radii in ((SHOT_RADIUS, _FINE_RADIUS), (SHOT_RADIUS,)):
            if len(radii) > 1 and min(len(shape.mesh.vertices) for shape in shapes) < _FINE:
                continue
            with suppress(InputError) if len(radii) > 1 else nullcontext():
                return cls(radii, PrincipalAxes.of(_Blocks(shapes, radii), number_of_descriptors))
        raise AssertionError("the usual radius returns axes or raises an error")

    def describe(self, shape: SampledShape, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum of a shape (n vertices) with descriptors (n, d).

        **Arguments:**

        - `shape`: the `SampledShape` with its compared vertices.
        - `spectrum`: the `Spectrum` at all vertices.

        **Returns:** The `Spectrum` with dimensionless `descriptors` (n, d), whose mean squares are about 1.

        **Raises:** `InputError` if the mesh is too coarse for SHOT.
        """
        dtype = spectrum.eigenvectors.dtype
        return _at_all_vertices(
            shape, spectrum, self.principal.components(_shot_rows(shape, self.radii).astype(dtype))
        )


def _shot_rows(shape: SampledShape, radii: Sequence[float]) -> Float[np.ndarray, "a c"]:
    with warnings.catch_warnings():
        if len(radii) > 1:
            warnings.simplefilter("ignore")
        return np.hstack(
            [shot_descriptors(shape.mesh, radius=radius, samples=shape.samples) for radius in radii]
        )


class _Blocks:
    """The SHOT descriptors and weights of the shapes of a collection, one block per shape.

    Descriptors are computed or read from the cache in every pass, because the descriptors of a large
    collection may not fit into memory.
    """

    def __init__(self, shapes: Sequence[SampledShape], radii: Sequence[float]):
        self._shapes, self._radii = shapes, radii

    def __iter__(self) -> Iterator[tuple[Float[np.ndarray, "a c"], Float[np.ndarray, " a"]]]:
        for shape in self._shapes:
            areas = np.asarray(shape.spectrum.vertex_areas, np.float64)
            shot = _shot_rows(shape, self._radii)
            yield shot, (areas / areas.sum() / len(self._shapes)).astype(shot.dtype)


def _shot_at_all_radii(
    sampled: SampledPair,
) -> list[tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]]:
    """Compute SHOT of both shapes with the usual radius and, on fine meshes, also with the smaller radius."""
    shot = [sampled.shot]
    if min(len(mesh.vertices) for mesh in sampled.pair.meshes) >= _FINE:
        with suppress(InputError), warnings.catch_warnings():
            # A mesh that is too coarse for the smaller radius still has descriptors of the usual radius.
            warnings.simplefilter("ignore")
            shot.append(paired_shot(sampled, _FINE_RADIUS))
    return shot


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


def paired_shot(
    sampled: SampledPair, radius: float = SHOT_RADIUS
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Compute SHOT of both shapes at the compared vertices.

    **Arguments:**

    - `sampled`: the sampled pair, as `sample_pair` returns it.
    - `radius`: the radius of the neighbourhoods, in `Pair.units_of_length`.

    **Returns:** The descriptors of X (m, 352) and of Y (n, 352), where m and n are the numbers of compared
    vertices.

    **Raises:** `InputError` if a mesh is too coarse for the radius.
    """

    def of_one(argument: tuple[SampledShape, float]) -> Float[np.ndarray, "n d"]:
        (mesh, samples, _), unit = argument
        own_radius = radius * unit / mesh.area**0.5
        if radius <= SHOT_RADIUS or len(mesh.vertices) <= _SPREAD:
            return shot_descriptors(mesh, radius=own_radius, samples=samples)
        fewer = poisson_disk_samples(mesh, _SPREAD)
        nearest = fewer.nearest if samples is None else fewer.nearest[samples.vertices]
        return shot_descriptors(mesh, radius=own_radius, samples=fewer)[nearest]

    unit_x, unit_y = sampled.pair.units_of_length
    return side_by_side(of_one, (sampled.x, unit_x), (sampled.y, unit_y))
