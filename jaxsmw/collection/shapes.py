"""The data of each shape of a collection, which all pairs of the shape share."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace

import jax
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.choices import Eigensolver, Laplacian
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import DescriptorAxes, SampledPair, SampledShape, compared_samples
from jaxsmw.geometry.eigenbasis import choose_eigensolver, compute_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.initial_maps.nearest import nearest_map
from jaxsmw.pair import Pair, check_eigenvalues, number_of_usable_vertices
from jaxsmw.preparation import PreparedPair
from jaxsmw.presets import Preset


def _warned_already() -> AbstractContextManager[object]:
    """Ignore warnings about coarse meshes in the block, because `prepare_shape` has issued them."""
    return warnings.catch_warnings(action="ignore", category=UserWarning)


@dataclass(frozen=True, eq=False)
class PreparedShape:
    """A shape of a collection, with the data that the matches of all its pairs need.

    **Attributes:**

    - `mesh`: the mesh (n vertices).
    - `spectrum`: the spectrum in units in which the area is 1, with descriptors if the preset uses them.
    - `compared`: the `SurfaceSamples` at which descriptors are compared; None for all vertices.
    - `samples`: the samples (s,) on which stages iterate, in farthest-point order; None if no stage uses
      samples.
    """

    mesh: Mesh
    spectrum: Spectrum
    compared: SurfaceSamples | None
    samples: Int[Array, " s"] | None

    @property
    def sampled(self) -> SampledShape:
        """The shape with the vertices at which its descriptors are compared."""
        return SampledShape.make(self.mesh, self.compared, self.spectrum)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the shape as arrays, for a file."""
        found = {name: np.asarray(value) for name, value in vars(self.spectrum).items() if value is not None}
        found |= {"mesh_vertices": self.mesh.vertices, "mesh_faces": self.mesh.faces}
        if self.samples is not None:
            found["samples"] = np.asarray(self.samples)
        return found

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], name: str) -> PreparedShape:
        """Return the shape, given the result of the method `arrays`."""
        names = [field.name for field in fields(Spectrum) if field.name in arrays]
        spectrum = Spectrum(**{name: jax.device_put(arrays[name]) for name in names})
        samples = jax.device_put(arrays["samples"]) if "samples" in arrays else None
        mesh = Mesh(arrays["mesh_vertices"], arrays["mesh_faces"], name)
        return cls(mesh, spectrum, compared_samples(mesh), samples)


def prepare_shape(
    mesh: Mesh,
    preset: Preset,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "exact",
) -> PreparedShape:
    """Compute the spectrum and the samples of one shape, without descriptors.

    **Arguments:**

    - `mesh`: a `Mesh` (n vertices).
    - `preset`: the preset, whose stages determine the numbers of eigenvectors and samples. The preset is
      adapted to a small mesh; see `Preset.fitted`.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`. All shapes of a collection need the same
      eigensolver, because their spectra are compared.

    **Returns:** The `PreparedShape`.

    **Raises:** `InputError` if the spectrum cannot be computed, or SHOT is not defined on the mesh.
    """
    preset = fitted_preset(preset, mesh)
    spectrum = compute_spectrum(
        mesh, preset.number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver
    )
    samples = None
    if preset.number_of_samples:
        samples = jax.device_put(farthest_point_samples(mesh, preset.number_of_samples))
    check_eigenvalues(mesh, spectrum)
    compared = compared_samples(mesh)
    # This call stores the descriptors in the cache, and refuses meshes that are too coarse.
    shot_descriptors(mesh, samples=compared, required=True)
    return PreparedShape(mesh, spectrum, compared, samples)


def describe_shape(shape: PreparedShape, axes: DescriptorAxes) -> PreparedShape:
    """Return the shape with descriptors along the axes of the whole collection.

    **Raises:** `InputError` if SHOT is not defined on the mesh.
    """
    with _warned_already():
        return replace(shape, spectrum=axes.describe(shape.sampled, shape.spectrum))


def prepare_pair(
    x: PreparedShape, y: PreparedShape, init: Int64[np.ndarray, " m"] | None = None
) -> PreparedPair:
    """Return the prepared pair of two full shapes of a collection.

    **Arguments:**

    - `x`, `y`: the source X (m vertices) and the target Y.
    - `init`: the initial map X -> Y (m,), as 0-based vertices of Y. The default is `"shot"`.
    """
    pair = Pair(x.mesh, y.mesh)
    sampled = SampledPair(pair, x.sampled, y.sampled)
    with _warned_already():
        start = nearest_map(sampled, *sampled.shot) if init is None else init
    samples = None if x.samples is None or y.samples is None else (x.samples, y.samples)
    return PreparedPair(
        pair, x.spectrum, y.spectrum, "shot" if init is None else init, start, samples, sampled
    )


def descriptor_axes(shapes: Sequence[PreparedShape], preset: Preset) -> DescriptorAxes:
    """Compute the principal axes of the descriptors of all shapes; see `DescriptorAxes`."""
    with _warned_already():
        return DescriptorAxes.of([shape.sampled for shape in shapes], preset.number_of_descriptors)


def prepare_shapes(
    meshes: Sequence[Mesh], preset: Preset
) -> tuple[list[PreparedShape], DescriptorAxes | None]:
    """Prepare all shapes of a collection, with descriptors along common axes.

    **Arguments:**

    - `meshes`: the meshes, each a `Mesh`.
    - `preset`: the preset.

    **Returns:** The prepared shapes, and the axes of the descriptors. Without descriptors, the axes are None.

    **Raises:** `InputError` if a mesh cannot be used.
    """
    eigensolver = choose_eigensolver(*meshes) if meshes else "exact"
    shapes = [prepare_shape(mesh, preset, eigensolver=eigensolver) for mesh in meshes]
    if not (shapes and preset.number_of_descriptors):
        return shapes, None
    axes = descriptor_axes(shapes, preset)
    return [describe_shape(shape, axes) for shape in shapes], axes


def fitted_preset(preset: Preset, *meshes: Mesh) -> Preset:
    """Return the preset, adapted to the mesh with the fewest referenced vertices; see `Preset.fitted`.

    **Raises:** `InputError` if a mesh has too few vertices.
    """
    return preset.fitted(min(map(number_of_usable_vertices, meshes)))
