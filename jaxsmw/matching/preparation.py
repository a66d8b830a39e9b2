"""Prepares shapes, and pairs of shapes, for refinement: spectra, samples and descriptors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.linalg
from jaxtyping import Float, Float64, Int, Int64, Shaped

from jaxsmw.choices import DEFAULT_BACKEND, Backend, Eigensolver, Laplacian
from jaxsmw.core.arrays import Array, namespace, on_host
from jaxsmw.core.module import import_jax
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError, check_whole_number
from jaxsmw.geometry.creases import crease_eigenvectors
from jaxsmw.geometry.eigenbasis import as_spectrum, choose_eigensolver, eigenpairs
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples, poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_DIMENSION, SHOT_RADIUS, shot_descriptors
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.spectral_pair import SpectralPair, common_range
from jaxsmw.matching.stages import Preset, Sizes
from jaxsmw.runtime.backends import chosen_backend
from jaxsmw.runtime.progress import Step, no_step
from jaxsmw.runtime.threads import one_blas_thread, side_by_side

Computed = TypeVar("Computed")

# A mesh with more than `_COMPARED_FROM` vertices is reduced to about `_COMPARED` samples. Descriptors
# cannot distinguish two vertices whose distance is below a few hundredths of the square root of the area.
# Therefore 10 000 samples are dense enough.
_COMPARED, _COMPARED_FROM = 10_000, 15_000
# If a mesh has at least this number of vertices, two meshes are prepared one after the other, which takes
# half of the memory.
_ONE_BY_ONE_FROM = 200_000


@dataclass(frozen=True, eq=False)
class PreparedShape:
    """A shape, with the data that are needed to match it with any other shape.

    **Attributes:**

    - `mesh`: the `Mesh` (n vertices), as it is matched: cut, mirrored or trimmed.
    - `spectrum`: the `Spectrum`, with descriptors and crease eigenvectors if stages use them. Its unit is the
      square root of the area or, in a partial pair, `Pair.units_of_length`.
    - `compared`: the `SurfaceSamples` at which descriptors are compared; None for all vertices. On a mesh
      with more than 15 000 vertices, they are about 10 000 evenly spread samples.
    - `samples`: the samples (s,) on which stages iterate, as 0-based vertices in farthest-point order; None
      if no stage uses samples.
    """

    mesh: Mesh
    spectrum: Spectrum
    compared: SurfaceSamples | None = None
    samples: Int[Array, " s"] | None = None

    @classmethod
    def of(cls, mesh: Mesh, spectrum: Spectrum) -> PreparedShape:
        """Return a shape without samples, from a mesh and its spectrum at all n vertices.

        **Raises:** `InputError` if the spectrum and the mesh have different numbers of vertices.
        """
        if (rows := spectrum.eigenvectors.shape[0]) != (n := len(mesh.vertices)):
            raise InputError(
                f"{mesh.name}: the mesh has {n} vertices, but its spectrum has {rows}: give the mesh's own "
                "spectrum."
            )
        return cls(mesh, spectrum, compared_samples(mesh))

    @cached_property
    def compared_spectrum(self) -> Spectrum:
        """The spectrum at the compared vertices."""
        if self.compared is None:
            return self.spectrum
        return self.spectrum.sample(self.compared.vertices)

    def compared_rows(self, vertices: Int64[np.ndarray, " v"]) -> Int64[np.ndarray, " v"]:
        """Return the row of each vertex (v,), or of the sample nearest to it, among the compared vertices."""
        return vertices if self.compared is None else self.compared.nearest[vertices]

    def everywhere(self, rows: Shaped[np.ndarray, "a ..."]) -> Shaped[np.ndarray, "n ..."]:
        """Extend values from the compared vertices (a, ...) to all vertices (n, ...)."""
        return rows if self.compared is None else rows[self.compared.nearest]

    def at_compared(self, rows: Shaped[np.ndarray, "n ..."]) -> Shaped[np.ndarray, "a ..."]:
        """Restrict values at all vertices (n, ...) to the compared vertices (a, ...)."""
        return rows if self.compared is None else rows[self.compared.vertices]

    def shot(self, radius: float = SHOT_RADIUS) -> Float[np.ndarray, "a 352"]:
        """Return SHOT at the compared vertices; see `shot_descriptors`, which keeps them in the cache."""
        return shot_descriptors(self.mesh, radius=radius, samples=self.compared)

    def mirrored(self) -> PreparedShape:
        """Return the mirror image of a shape without descriptors."""
        return replace(self, mesh=self.mesh.mirrored(), spectrum=self.spectrum.reflect())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the shape as arrays, for a file."""
        arrays = {name: np.asarray(value) for name, value in vars(self.spectrum).items() if value is not None}
        arrays |= {"mesh_vertices": self.mesh.vertices, "mesh_faces": self.mesh.faces}
        if self.samples is not None:
            arrays["samples"] = np.asarray(self.samples)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], name: str) -> PreparedShape:
        """Return the shape, given the result of the method `arrays`."""
        names = [field.name for field in fields(Spectrum) if field.name in arrays]
        spectrum = Spectrum(**{name: arrays[name] for name in names})
        samples = arrays.get("samples")
        mesh = Mesh(arrays["mesh_vertices"], arrays["mesh_faces"], name)
        return cls(mesh, spectrum, compared_samples(mesh), samples)


def prepare_shapes(
    meshes: Sequence[Mesh],
    sizes: Sizes,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    backend: Backend = DEFAULT_BACKEND,
    step: Step = no_step,
) -> list[PreparedShape]:
    """Compute the spectra, crease eigenvectors and samples of shapes; two shapes side by side.

    **Arguments:**

    - `meshes`: the meshes, each a `Mesh` in any unit of length.
    - `sizes`: the numbers of eigenvectors, crease eigenvectors and samples of each shape.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`. All meshes get the same eigensolver, because
      their spectra are compared.
    - `backend`: see `jaxsmw.match`. The arrays of the spectra are of NumPy or JAX.
    - `step`: reports and measures the steps.

    **Returns:** One `PreparedShape` per mesh, without descriptors, in units in which its area is 1.

    **Raises:** `InputError` if a spectrum cannot be computed, or if all of its eigenvalues are zero.
    """
    if eigensolver == "auto":
        eigensolver = choose_eigensolver(*meshes)
    pairwise = len(meshes) == 2 and max(len(mesh.vertices) for mesh in meshes) < _ONE_BY_ONE_FROM

    def each(compute: Callable[[Mesh], Computed]) -> Sequence[Computed]:
        return side_by_side(compute, *meshes) if pairwise else [compute(mesh) for mesh in meshes]

    number, creases, samples = sizes
    with step("eigenbases"):
        pairs = each(lambda mesh: eigenpairs(mesh, number, laplacian=laplacian, eigensolver=eigensolver))
        # Spectra are made outside of the threads, because threads do not inherit `jax.enable_x64`.
        shapes = [_shape(mesh, *of_mesh) for mesh, of_mesh in zip(meshes, pairs, strict=True)]
    if samples:
        with step("samples"):
            vertices = each(lambda mesh: farthest_point_samples(mesh, samples))
        shapes = [
            replace(shape, samples=on_host(chosen)) for shape, chosen in zip(shapes, vertices, strict=True)
        ]
    if creases:
        with step("crease eigenvectors"):
            vectors = each(lambda mesh: crease_eigenvectors(mesh, creases))
        shapes = [
            replace(shape, spectrum=shape.spectrum.with_crease_eigenvectors(on_host(columns)))
            for shape, columns in zip(shapes, vectors, strict=True)
        ]
    if chosen_backend(backend) == "numpy":
        return shapes
    jax = import_jax()

    return [
        replace(shape, spectrum=jax.device_put(shape.spectrum), samples=jax.device_put(shape.samples))
        for shape in shapes
    ]


def _shape(
    mesh: Mesh,
    eigenvalues: Float64[np.ndarray, " k"],
    eigenvectors: Float64[np.ndarray, "n k"],
    vertex_areas: Float64[np.ndarray, " n"],
) -> PreparedShape:
    spectrum = as_spectrum(mesh, eigenvalues, eigenvectors, vertex_areas)
    if np.asarray(spectrum.eigenvalues)[-1] == 0:
        raise InputError(
            f"{mesh.name}: the largest of the {len(spectrum.eigenvalues)} eigenvalues is zero, so the "
            "eigenvectors only distinguish connected components: compute more eigenvectors than the mesh has "
            "components, or join vertices at the same position (weld=True)."
        )
    return PreparedShape(mesh, spectrum, compared_samples(mesh))


def compared_samples(mesh: Mesh) -> SurfaceSamples | None:
    """Return the samples at which descriptors are compared, or None for all vertices."""
    return poisson_disk_samples(mesh, _COMPARED) if len(mesh.vertices) > _COMPARED_FROM else None


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


def with_descriptors(shape: PreparedShape, components: Float[np.ndarray, "a d"]) -> PreparedShape:
    """Return a shape with descriptors, given at its compared vertices (a, d)."""
    everywhere = shape.everywhere(components) * np.asarray(shape.spectrum.mask)[:, None]
    descriptors = namespace(shape.spectrum.eigenvectors).asarray(everywhere)
    return replace(shape, spectrum=shape.spectrum.with_descriptors(descriptors))


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


# In a partial pair, the smaller area must be at least this share of the larger area. A part with less than a
# thousandth of a body's area shows too little of the body's shape.
_SMALLEST_PART = 1e-3


@dataclass(frozen=True, eq=False)
class PreparedPair:
    """A pair with everything that stages need.

    **Attributes:**

    - `given`: the `Pair` as it was given, to whose vertices the result refers.
    - `pair`: the `Pair` that is matched. Its meshes may be cut, mirrored or trimmed, but have the same
      vertices.
    - `x`, `y`: the shapes X (m vertices) and Y (n vertices), each a `PreparedShape` in
      `Pair.units_of_length`.
    - `mirrored`: whether the mirror image of X is matched instead of X.
    - `trimmed`: whether the larger shape of a partial pair was trimmed; see
      `jaxsmw.matching.search.trimming`.
      The spectra of such a pair have equal numbers of eigenvectors, and need no common limit.
    - `laplacian`, `eigensolver`: how the spectra were computed; see `jaxsmw.compute_spectrum`.
    - `known_shot`: SHOT at the compared vertices, if it has already been computed for these meshes.
    """

    given: Pair
    pair: Pair
    x: PreparedShape
    y: PreparedShape
    mirrored: bool = False
    trimmed: bool = False
    laplacian: Laplacian = "auto"
    eigensolver: Eigensolver = "auto"
    known_shot: tuple[Float[np.ndarray, "a c"], Float[np.ndarray, "b c"]] | None = None

    @classmethod
    def of(
        cls,
        pair: Pair,
        x: PreparedShape,
        y: PreparedShape,
        *,
        given: Pair | None = None,
        mirrored: bool = False,
        trimmed: bool = False,
        laplacian: Laplacian = "auto",
        eigensolver: Eigensolver = "auto",
    ) -> PreparedPair:
        """Return the prepared pair of two shapes, each in units in which its area is 1.

        Two full shapes keep their own units. This compensates for a difference in size. The shapes of a
        partial pair are scaled by one common factor, so that the larger shape has area 1. Unless the pair is
        trimmed, their spectra are then cut at a common limit; see `common_range`. The shapes of a trimmed
        pair cover nearly the same region, so they have about as many eigenvalues below any limit.

        The arguments are the attributes. `given` is `pair` by default.
        """
        if pair.partial:
            area_x, area_y = pair.areas
            scaled = x.spectrum.scale(area_x), y.spectrum.scale(area_y)
            of_x, of_y = scaled if trimmed else common_range(*scaled)
            x, y = replace(x, spectrum=of_x), replace(y, spectrum=of_y)
        return cls(given or pair, pair, x, y, mirrored, trimmed, laplacian, eigensolver)

    @classmethod
    def from_spectra(cls, pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum) -> PreparedPair:
        """Return the prepared pair of meshes whose spectra are known, in `Pair.units_of_length`.

        **Raises:** `InputError` if a spectrum and its mesh have different numbers of vertices.
        """
        x, y = PreparedShape.of(pair.mesh_x, spectrum_x), PreparedShape.of(pair.mesh_y, spectrum_y)
        return cls(pair, pair, x, y)

    @property
    def shapes(self) -> tuple[PreparedShape, PreparedShape]:
        """The shapes X and Y."""
        return self.x, self.y

    @cached_property
    def spectra(self) -> SpectralPair:
        """The spectra and samples of both shapes, on which stages run."""
        samples = None
        if self.x.samples is not None and self.y.samples is not None:
            samples = self.x.samples, self.y.samples
        partial = self.pair.partial
        return SpectralPair(self.x.spectrum, self.y.spectrum, samples, partial, partial and not self.trimmed)

    @cached_property
    def shot(self) -> tuple[Float[np.ndarray, "a d"], Float[np.ndarray, "b d"]]:
        """SHOT of X and Y at the compared vertices, with the usual radius."""
        return self.known_shot or self.shot_of_radius(SHOT_RADIUS)

    def shot_of_radius(
        self, radius: float, samples: tuple[SurfaceSamples, SurfaceSamples] | None = None
    ) -> tuple[Float[np.ndarray, "a d"], Float[np.ndarray, "b d"]]:
        """Compute SHOT of X and Y, with a radius in `Pair.units_of_length`.

        SHOT is computed at `samples`, by default at the compared vertices.
        """

        def of_one(argument: tuple[Mesh, float, SurfaceSamples | None]) -> Float[np.ndarray, "a d"]:
            mesh, unit, at = argument
            return shot_descriptors(mesh, radius=radius * unit / mesh.area**0.5, samples=at)

        at = samples or (self.x.compared, self.y.compared)
        return side_by_side(of_one, *zip(self.pair.meshes, self.pair.units_of_length, at, strict=True))

    @property
    def matched(self) -> Pair:
        """The given pair, with the mirror image of X in place of X if it is matched."""
        return self.given.mirrored() if self.mirrored else self.given

    def usable(self, preset: Preset) -> Preset:
        """Return the preset, without descriptors if the pair has none."""
        return preset.without_descriptors() if self.x.spectrum.descriptors is None else preset

    def mirror(self) -> PreparedPair:
        """Return the prepared pair with the mirror image of X in place of X. There are no descriptors yet."""
        x = self.x.mirrored()
        return replace(self, pair=self.pair.mirrored(), x=x, mirrored=not self.mirrored, known_shot=None)

    def describe(self, number_of_descriptors: int, *, required: bool = False) -> PreparedPair:
        """Return the prepared pair with descriptors of both shapes in the same axes.

        **Arguments:**

        - `number_of_descriptors`: the number d of descriptors, from 1 to 352.
        - `required`: whether to raise `InputError` if a mesh is too coarse for descriptors. If False, the
          function issues a `UserWarning` instead, and the result has no descriptors.
        """
        check_whole_number("number_of_descriptors", number_of_descriptors, 1, SHOT_DIMENSION)
        try:
            shot = [self.shot]
        except InputError as error:
            if required:
                raise
            warnings.warn(f"refinement continues without descriptors: {error}", stacklevel=3)
            return self
        if min(len(shape.mesh.vertices) for shape in self.shapes) >= FINE_FROM:
            with suppress(InputError), warnings.catch_warnings():
                # A mesh that is too coarse for the smaller radius still has descriptors of the usual radius.
                warnings.simplefilter("ignore")
                shot.append(self.shot_of_radius(FINE_RADIUS))
        dtype = self.x.spectrum.eigenvectors.dtype
        rows = np.hstack([np.concatenate(both) for both in shot], dtype=dtype)
        weight = np.concatenate(weights(self.shapes)).astype(dtype)
        components = principal_components(rows, weight, number_of_descriptors)
        of_x, of_y = np.split(components, [len(self.shot[0])])
        return replace(
            self,
            x=with_descriptors(self.x, of_x),
            y=with_descriptors(self.y, of_y),
            known_shot=self.shot,
        )


def prepare(
    pair: Pair,
    sizes: Sizes,
    *,
    given: Pair | None = None,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    backend: Backend = DEFAULT_BACKEND,
    step: Step = no_step,
) -> PreparedPair:
    """Prepare both shapes of a pair, and pair them.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `sizes`: the numbers of eigenvectors, crease eigenvectors and samples of each shape.
    - `given`: the pair to whose vertices the result refers, if `pair` is cut; by default `pair`.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`.
    - `backend`: see `jaxsmw.match`.
    - `step`: reports and measures the steps.

    **Returns:** A `PreparedPair` without descriptors.

    **Raises:** `InputError` if a shape cannot be prepared (see `prepare_shapes`). For a partial pair,
    `InputError` is also raised if the area of one mesh is less than a thousandth of the other area.
    """
    if min(pair.areas) < _SMALLEST_PART:
        raise InputError(
            f"{pair.mesh_x.name} has area {pair.mesh_x.area * pair.scale**2:.3g} and {pair.mesh_y.name} has "
            f"area {pair.mesh_y.area:.3g}, so their units of length probably differ: scale one of the "
            'meshes, or set scale="unknown".'
        )
    x, y = prepare_shapes(
        pair.meshes, sizes, laplacian=laplacian, eigensolver=eigensolver, backend=backend, step=step
    )
    return PreparedPair.of(pair, x, y, given=given, laplacian=laplacian, eigensolver=eigensolver)


def paired_spectra(
    pair: Pair,
    number_of_eigenvectors: int,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
) -> tuple[Spectrum, Spectrum]:
    """Compute the spectra of the two meshes of a pair in comparable units.

    Two full shapes are each scaled to area 1. The shapes of a partial pair are scaled by one common factor,
    and their spectra are cut at a common limit; see
    `PreparedPair.of`.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices), a `Pair`.
    - `number_of_eigenvectors`: the number k of eigenvectors that are computed for each mesh. It must be at
      least 1, and less than the number of referenced vertices of each mesh.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`. Both meshes get the same eigensolver.

    **Returns:** Two spectra, each a `Spectrum` with positions and normals, in `Pair.units_of_length`. The
    spectrum of X has m vertices and k_X eigenvectors. The spectrum of Y has n vertices and k_Y eigenvectors.
    For two full shapes, k_X = k_Y = k. For a partial pair, k_X and k_Y usually differ.

    **Raises:** `InputError` if a spectrum cannot be computed (see `jaxsmw.compute_spectrum`), or if all
    eigenvalues of a mesh are zero. For a partial pair, `InputError` is also raised if the area of one mesh is
    less than a thousandth of the other area.
    """
    sizes = Sizes(number_of_eigenvectors)
    prepared = prepare(pair, sizes, laplacian=laplacian, eigensolver=eigensolver, backend="jax")
    return prepared.x.spectrum, prepared.y.spectrum


def describe(
    pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum, number_of_descriptors: int
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

    **Returns:** The spectra of X and Y, with dimensionless `descriptors` of shapes (m, d) and (n, d). The
    function issues a `UserWarning` if a mesh is too coarse for SHOT at more than 1 % of its vertices.

    **Raises:** `InputError` if `number_of_descriptors` is not from 1 to 352, if a mesh is too coarse for SHOT
    at more than half of its vertices, or if a spectrum and its mesh have different numbers of vertices.
    """
    prepared = PreparedPair.from_spectra(pair, spectrum_x, spectrum_y).describe(
        number_of_descriptors, required=True
    )
    return prepared.x.spectrum, prepared.y.spectrum
