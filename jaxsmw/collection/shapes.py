"""Prepares the shapes of a collection, and makes their descriptors comparable."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from jaxsmw.choices import Eigensolver
from jaxsmw.core.arrays import is_array
from jaxsmw.core.module import leaves
from jaxsmw.errors import InputError
from jaxsmw.geometry.eigenbasis import choose_eigensolver
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.shortcuts import cut_shortcuts
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.matching.descriptors import DescriptorAxes, PrincipalAxes
from jaxsmw.matching.pair import number_of_usable_vertices
from jaxsmw.matching.shape import PreparedShape, prepare_shapes
from jaxsmw.matching.stages import Preset
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress

logger = logging.getLogger("jaxsmw")


def warned_already() -> AbstractContextManager[object]:
    """Return a context that ignores the warnings that `prepare_shape` has already issued."""
    return warnings.catch_warnings(action="ignore", category=UserWarning)


def prepare_shape(mesh: Mesh, preset: Preset, eigensolver: Eigensolver) -> PreparedShape:
    """Prepare one shape for a preset, without descriptors.

    All shapes of a collection need the same eigensolver, because their spectra are compared.

    **Raises:** `InputError` if the shape cannot be prepared, or SHOT is not defined on the mesh.
    """
    if preset.cuts_shortcuts:
        mesh = cut_shortcuts(mesh)
    sizes = fitted_preset(preset, mesh).sizes
    (shape,) = prepare_shapes([mesh], sizes, eigensolver=eigensolver)
    # `shot_descriptors` raises an error if the mesh is too coarse, and stores the descriptors in the cache.
    shot_descriptors(mesh, samples=shape.compared, required=True)
    return shape


def prepare_usable_shapes(
    meshes: Sequence[Mesh], preset: Preset, eigensolver: Eigensolver, progress: Progress
) -> tuple[dict[int, PreparedShape], dict[str, str]]:
    """Prepare all shapes that can be matched; see `prepare_shape`.

    **Returns:** The `PreparedShape` of each usable mesh by its position in `meshes`, and the reasons why the
    other meshes cannot be matched by their names.
    """
    shapes, left_out = {}, {}
    for number, mesh in enumerate(meshes):
        try:
            shapes[number] = prepare_shape(mesh, preset, eigensolver)
        except (InputError, ArithmeticError) as error:
            left_out[mesh.name] = str(error)
            logger.warning("%s is left out: %s", mesh.name, error)
        progress("shapes", number + 1, len(meshes))
    return shapes, left_out


def shape_key(shape: PreparedShape, preset: Preset, eigensolver: Eigensolver) -> tuple[Any, ...]:
    """Return the part of a `Store` key that identifies a shape, apart from its descriptors."""
    sizes = preset.sizes
    numbers = sizes.number_of_eigenvectors, sizes.number_of_crease_eigenvectors
    return shape.mesh.vertices, shape.mesh.faces, eigensolver, *numbers, *sizes.bases


def preset_key(preset: Preset) -> tuple[Any, ...]:
    """Return the part of a `Store` key that identifies a preset: its text and its arrays."""
    refiners = tuple(stage.refiner for stage in preset.stages)
    return repr(preset), *(np.asarray(leaf) for leaf in leaves(refiners) if is_array(leaf))


def describe_shapes(
    shapes: Sequence[PreparedShape],
    preset: Preset,
    store: Store = Store(),  # noqa: B008 (immutable)
) -> tuple[list[PreparedShape], DescriptorAxes | None]:
    """Return shapes with descriptors in common axes, and the axes, if the preset uses descriptors.

    The axes are kept in the store. They do not change if shapes are added to the collection later, so the
    stored maps remain valid.
    """
    if not (shapes and preset.number_of_descriptors):
        return list(shapes), None

    def compute() -> dict[str, np.ndarray]:
        axes = DescriptorAxes.of(shapes, preset.number_of_descriptors)
        return {"radii": np.array(axes.radii), **axes.principal._asdict()}

    with warned_already():
        arrays = store.get("descriptor-axes", preset_key(preset), compute)
        axes = DescriptorAxes(tuple(arrays["radii"].tolist()), PrincipalAxes(arrays["mean"], arrays["axes"]))
        return axes.describe(shapes), axes


def prepare_collection(
    meshes: Sequence[Mesh], preset: Preset
) -> tuple[list[PreparedShape], DescriptorAxes | None]:
    """Prepare several shapes for a preset, with comparable descriptors.

    **Arguments:**

    - `meshes`: the meshes, each a `Mesh`. Their spectra are computed with the same eigensolver.
    - `preset`: the `Preset`, whose stages determine the numbers of eigenvectors, samples and descriptors.

    **Returns:** The shapes, each a `PreparedShape`, and the `DescriptorAxes`; None without descriptors.

    **Raises:** `InputError` if a mesh cannot be used.
    """
    eigensolver = choose_eigensolver(*meshes) if meshes else "exact"
    shapes = [prepare_shape(mesh, preset, eigensolver) for mesh in meshes]
    return describe_shapes(shapes, preset)


def fitted_preset(preset: Preset, *meshes: Mesh) -> Preset:
    """Return the preset, adapted to the mesh with the fewest referenced vertices; see `Preset.fitted`."""
    return preset.fitted(min(map(number_of_usable_vertices, meshes)))
