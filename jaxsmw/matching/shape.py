"""One shape with everything that is needed to match it: its spectrum, samples and crease eigenvectors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int, Int64, Shaped

from jaxsmw.choices import DEFAULT_BACKEND, Backend, Eigensolver, Laplacian
from jaxsmw.core.arrays import Array, float_type, namespace, on_host
from jaxsmw.core.spectrum import Basis, Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.bases import add_bases
from jaxsmw.geometry.creases import crease_eigenvectors
from jaxsmw.geometry.eigenbasis import as_spectrum, choose_eigensolver, eigenpairs
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples, poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, shot_descriptors
from jaxsmw.matching.stages import Sizes
from jaxsmw.runtime.backends import chosen_backend
from jaxsmw.runtime.progress import Step, no_step
from jaxsmw.runtime.threads import side_by_side

Computed = TypeVar("Computed")

# A mesh with more than `_COMPARED_FROM` vertices is reduced to about `_COMPARED` samples. Descriptors
# cannot distinguish two vertices whose distance is below a few hundredths of the square root of the area.
# Therefore 10 000 samples are dense enough.
_COMPARED, _COMPARED_FROM = 10_000, 15_000


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

    def with_descriptors(self, components: Float[np.ndarray, "a d"]) -> PreparedShape:
        """Return the shape with descriptors, given at its compared vertices (a, d)."""
        rows = components.astype(self.spectrum.eigenvectors.dtype)
        everywhere = self.everywhere(rows) * np.asarray(self.spectrum.mask)[:, None]
        descriptors = namespace(self.spectrum.eigenvectors).asarray(everywhere)
        return replace(self, spectrum=self.spectrum.with_descriptors(descriptors))

    def without_descriptors(self) -> PreparedShape:
        """Return the shape without descriptors."""
        return replace(self, spectrum=self.spectrum.with_descriptors(None))

    def mirrored(self) -> PreparedShape:
        """Return the mirror image, without descriptors, because those of a mirror image differ."""
        spectrum = self.spectrum.reflect().with_descriptors(None)
        return replace(self, mesh=self.mesh.mirrored(), spectrum=spectrum)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the shape as arrays, for a file."""
        values = vars(self.spectrum).items()
        arrays = {name: np.asarray(value) for name, value in values if value is not None and name != "bases"}
        for basis in self.spectrum.bases:
            arrays[f"eigenvalues_of_basis_{basis.name}"] = np.asarray(basis.eigenvalues)
            arrays[f"eigenvectors_of_basis_{basis.name}"] = np.asarray(basis.eigenvectors)
        arrays |= {"mesh_vertices": self.mesh.vertices, "mesh_faces": self.mesh.faces}
        if self.samples is not None:
            arrays["samples"] = np.asarray(self.samples)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], name: str) -> PreparedShape:
        """Return the shape, given the result of the method `arrays`."""
        names = [field.name for field in fields(Spectrum) if field.name in arrays]
        values, vectors = "eigenvalues_of_basis_", "eigenvectors_of_basis_"
        bases = [key.removeprefix(values) for key in arrays if key.startswith(values)]
        spectrum = Spectrum(
            **{name: arrays[name] for name in names},
            bases=tuple(Basis(basis, arrays[values + basis], arrays[vectors + basis]) for basis in bases),
        )
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
    """Compute the spectra, bases, crease eigenvectors and samples of shapes; two shapes side by side.

    **Arguments:**

    - `meshes`: the meshes, each a `Mesh` in any unit of length.
    - `sizes`: the numbers of eigenvectors, crease eigenvectors and samples of each shape, and its bases.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`. All meshes get the same eigensolver, because
      their spectra are compared.
    - `backend`: see `jaxsmw.match`. The arrays of the spectra are of NumPy or JAX.
    - `step`: reports and measures the steps.

    **Returns:** One `PreparedShape` per mesh, without descriptors, in units in which its area is 1.

    **Raises:** `InputError` if a spectrum cannot be computed, or if all of its eigenvalues are zero.
    """
    if eigensolver == "auto":
        eigensolver = choose_eigensolver(*meshes)
    dtype = float_type()  # threads do not inherit `jax.enable_x64`

    def each(compute: Callable[[Any], Computed], inputs: Sequence[Any] = meshes) -> Sequence[Computed]:
        return side_by_side(compute, *inputs) if len(inputs) == 2 else [compute(one) for one in inputs]

    def shape(mesh: Mesh) -> PreparedShape:
        pairs = eigenpairs(mesh, number, laplacian=laplacian, eigensolver=eigensolver)
        return _shape(mesh, as_spectrum(mesh, *pairs, dtype=dtype))

    number, creases, samples, bases = sizes
    with step("eigenbases"):
        shapes = list(each(shape))
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
    if bases:
        with step("further bases"):
            spectra = each(lambda shape: add_bases(shape.mesh, shape.spectrum, bases), shapes)
        shapes = [replace(shape, spectrum=spectrum) for shape, spectrum in zip(shapes, spectra, strict=True)]
    if chosen_backend(backend) == "numpy":
        return shapes
    import jax

    return [
        replace(shape, spectrum=jax.device_put(shape.spectrum), samples=jax.device_put(shape.samples))
        for shape in shapes
    ]


def _shape(mesh: Mesh, spectrum: Spectrum) -> PreparedShape:
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
