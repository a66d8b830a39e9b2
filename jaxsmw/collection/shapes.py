"""The data of a shape that are computed once and shared by all pairs with this shape."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.choices import Eigensolver, Laplacian
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.creases import crease_eigenvectors
from jaxsmw.geometry.eigenbasis import choose_eigensolver, compute_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples
from jaxsmw.geometry.shortcuts import cut_shortcuts
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.matching.descriptors import (
    DescriptorAxes,
    PrincipalAxes,
    SampledPair,
    SampledShape,
    compared_samples,
)
from jaxsmw.matching.pair import Pair, check_eigenvalues, number_of_usable_vertices
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.presets import Preset
from jaxsmw.matching.starts import nearest_map
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress, no_progress

logger = logging.getLogger("jaxsmw")


def _warned_already() -> AbstractContextManager[object]:
    """Return a context that ignores warnings, because `prepare_shape` has already issued the warnings."""
    return warnings.catch_warnings(action="ignore", category=UserWarning)


@dataclass(frozen=True, eq=False)
class PreparedShape:
    """A shape of a collection, with the data that are needed to match the shape with any other shape.

    **Attributes:**

    - `mesh`: the `Mesh` (n vertices). If the preset cuts shortcuts, the mesh can have fewer faces than the
      given mesh; see `jaxsmw.geometry.cut_shortcuts`.
    - `spectrum`: the `Spectrum` in units in which the area is 1, with descriptors and crease
      eigenvectors if the preset uses them.
    - `compared`: the `SurfaceSamples` at which descriptors are compared; None for all vertices.
    - `samples`: the samples (s,) on which stages iterate, as 0-based vertices in farthest-point order; None
      if no stage uses samples.
    """

    mesh: Mesh
    spectrum: Spectrum
    compared: SurfaceSamples | None
    samples: Int[Array, " s"] | None

    @property
    def sampled(self) -> SampledShape:
        """The `SampledShape`, which contains the vertices at which descriptors are compared."""
        return SampledShape.make(self.mesh, self.compared, self.spectrum)

    def mirrored(self) -> PreparedShape:
        """Return the mirror image of a shape without descriptors."""
        return replace(self, mesh=self.mesh.mirrored(), spectrum=self.spectrum.reflect())

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
    """Compute the spectrum and the samples of one shape. The result has no descriptors.

    **Arguments:**

    - `mesh`: a `Mesh` (n vertices).
    - `preset`: the preset, whose stages determine the numbers of eigenvectors and samples. If the mesh is
      small, the preset is adapted to the mesh; see `Preset.fitted`.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`. All shapes of a collection need the same
      eigensolver, because their spectra are compared.

    **Returns:** The `PreparedShape`.

    **Raises:** `InputError` if the spectrum cannot be computed, or SHOT is not defined on the mesh.
    """
    if preset.cuts_shortcuts:
        mesh = cut_shortcuts(mesh)
    preset = fitted_preset(preset, mesh)
    spectrum = compute_spectrum(
        mesh, preset.number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver
    )
    if preset.number_of_crease_eigenvectors:
        creases = crease_eigenvectors(mesh, preset.number_of_crease_eigenvectors)
        spectrum = spectrum.with_crease_eigenvectors(jax.device_put(creases))
    samples = None
    if preset.number_of_samples:
        samples = jax.device_put(farthest_point_samples(mesh, preset.number_of_samples))
    check_eigenvalues(mesh, spectrum)
    compared = compared_samples(mesh)
    # `shot_descriptors` raises an error if the mesh is too coarse, and stores the descriptors in the cache.
    shot_descriptors(mesh, samples=compared, required=True)
    return PreparedShape(mesh, spectrum, compared, samples)


def prepare_usable_shapes(
    meshes: Sequence[Mesh], preset: Preset, progress: Progress = no_progress
) -> tuple[dict[int, PreparedShape], dict[str, str]]:
    """Compute the spectra and samples of all shapes that can be matched. The results have no descriptors.

    **Arguments:**

    - `meshes`: the meshes, each a `Mesh`.
    - `preset`: see `prepare_shape`.
    - `progress`: a function that is called after each shape.

    **Returns:** Two dictionaries. The first contains the `PreparedShape` of each usable mesh, and its keys
    are positions in `meshes`. The second contains the reasons why the other meshes cannot be matched, and its
    keys are the names of these meshes.
    """
    eigensolver = choose_eigensolver(*meshes) if meshes else "exact"
    shapes, left_out = {}, {}
    for number, mesh in enumerate(meshes):
        try:
            shapes[number] = prepare_shape(mesh, preset, eigensolver=eigensolver)
        except (InputError, ArithmeticError) as error:
            left_out[mesh.name] = str(error)
            logger.warning("%s is left out: %s", mesh.name, error)
        progress("shapes", number + 1, len(meshes))
    return shapes, left_out


def shape_key(shape: PreparedShape, preset: Preset) -> tuple[Any, ...]:
    """Return the part of a `Store` key that identifies a shape, apart from its descriptors."""
    numbers = preset.number_of_eigenvectors, preset.number_of_crease_eigenvectors
    return shape.mesh.vertices, shape.mesh.faces, *numbers


def preset_key(preset: Preset) -> tuple[Any, ...]:
    """Return the part of a `Store` key that identifies a preset: its text and its arrays."""
    refiners = [stage.refiner for stage in preset.stages]
    return repr(preset), *(np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(refiners, eqx.is_array)))


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


def describe_shapes(
    shapes: Sequence[PreparedShape],
    preset: Preset,
    store: Store = Store(),  # noqa: B008 (immutable)
) -> tuple[list[PreparedShape], DescriptorAxes | None]:
    """Compute descriptors for all shapes of a collection, if the preset uses descriptors.

    The descriptors are expressed in common axes, so the descriptors of any two shapes are comparable.

    **Arguments:**

    - `shapes`: the shapes.
    - `preset`: the preset, which determines the number of descriptors.
    - `store`: the store in which the axes are kept. The axes do not change if shapes are added to the
      collection later. The stored maps therefore remain valid.

    **Returns:** The shapes with descriptors, and the axes. Without descriptors, the axes are None.

    **Raises:** `InputError` if SHOT is not defined on a mesh.
    """
    if not (shapes and preset.number_of_descriptors):
        return list(shapes), None

    def compute() -> dict[str, np.ndarray]:
        axes = DescriptorAxes.of([shape.sampled for shape in shapes], preset.number_of_descriptors)
        return {
            "radii": np.array(axes.radii),
            "mean": axes.principal.mean,
            "axes": axes.principal.axes,
        }

    with _warned_already():
        arrays = store.get("descriptor-axes", preset_key(preset), compute)
        axes = DescriptorAxes(tuple(arrays["radii"].tolist()), PrincipalAxes(arrays["mean"], arrays["axes"]))
        return [replace(one, spectrum=axes.describe(one.sampled, one.spectrum)) for one in shapes], axes


def prepare_shapes(
    meshes: Sequence[Mesh], preset: Preset
) -> tuple[list[PreparedShape], DescriptorAxes | None]:
    """Prepare all shapes of a collection, and compute comparable descriptors.

    **Arguments:**

    - `meshes`: the meshes, each a `Mesh` in any unit of length.
    - `preset`: the `Preset`, such as `jaxsmw.PRESETS["accurate"]`. Its stages determine the numbers of
      eigenvectors, descriptors and samples.

    **Returns:** A list with one `PreparedShape` per mesh, and the `DescriptorAxes`. Without descriptors, the
    axes are None.

    **Raises:** `InputError` if a mesh cannot be used.
    """
    eigensolver = choose_eigensolver(*meshes) if meshes else "exact"
    shapes = [prepare_shape(mesh, preset, eigensolver=eigensolver) for mesh in meshes]
    return describe_shapes(shapes, preset)


def fitted_preset(preset: Preset, *meshes: Mesh) -> Preset:
    """Return the preset, adapted to the mesh with the fewest referenced vertices; see `Preset.fitted`.

    **Raises:** `InputError` if a mesh has too few vertices.
    """
    return preset.fitted(min(map(number_of_usable_vertices, meshes)))
