"""Prepares the shapes of a collection, and makes their descriptors comparable."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxsmw.choices import Eigensolver, Laplacian
from jaxsmw.errors import InputError
from jaxsmw.geometry.eigenbasis import choose_eigensolver
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.shortcuts import cut_shortcuts
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.matching.pair import number_of_usable_vertices
from jaxsmw.matching.preparation import DescriptorAxes, PreparedShape, PrincipalAxes, prepare_shapes
from jaxsmw.matching.stages import Preset
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress, no_progress

logger = logging.getLogger("jaxsmw")


def warned_already() -> AbstractContextManager[object]:
    """Return a context that ignores warnings, because `prepare_shape` has already issued the warnings."""
    return warnings.catch_warnings(action="ignore", category=UserWarning)


def prepare_shape(
    mesh: Mesh,
    preset: Preset,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "exact",
) -> PreparedShape:
    """Prepare one shape for a preset. The result has no descriptors.

    **Arguments:**

    - `mesh`: a `Mesh` (n vertices).
    - `preset`: the preset, whose stages determine the numbers of eigenvectors and samples. If the mesh is
      small, the preset is adapted to the mesh; see `Preset.fitted`.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`. All shapes of a collection need the same
      eigensolver, because their spectra are compared.

    **Raises:** `InputError` if the shape cannot be prepared, or SHOT is not defined on the mesh.
    """
    if preset.cuts_shortcuts:
        mesh = cut_shortcuts(mesh)
    sizes = fitted_preset(preset, mesh).sizes
    (shape,) = prepare_shapes([mesh], sizes, laplacian=laplacian, eigensolver=eigensolver)
    # `shot_descriptors` raises an error if the mesh is too coarse, and stores the descriptors in the cache.
    shot_descriptors(mesh, samples=shape.compared, required=True)
    return shape


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
    sizes = preset.sizes
    numbers = sizes.number_of_eigenvectors, sizes.number_of_crease_eigenvectors
    return shape.mesh.vertices, shape.mesh.faces, *numbers


def preset_key(preset: Preset) -> tuple[Any, ...]:
    """Return the part of a `Store` key that identifies a preset: its text and its arrays."""
    refiners = [stage.refiner for stage in preset.stages]
    return repr(preset), *(np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(refiners, eqx.is_array)))


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
        axes = DescriptorAxes.of(shapes, preset.number_of_descriptors)
        return {
            "radii": np.array(axes.radii),
            "mean": axes.principal.mean,
            "axes": axes.principal.axes,
        }

    with warned_already():
        arrays = store.get("descriptor-axes", preset_key(preset), compute)
        axes = DescriptorAxes(tuple(arrays["radii"].tolist()), PrincipalAxes(arrays["mean"], arrays["axes"]))
        return [axes.describe(shape) for shape in shapes], axes


def prepare_collection(
    meshes: Sequence[Mesh], preset: Preset
) -> tuple[list[PreparedShape], DescriptorAxes | None]:
    """Prepare several shapes, and compute comparable descriptors; see `prepare_shape` and `describe_shapes`.

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
