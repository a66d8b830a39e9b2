"""Checks of the maps, errors and matrices that figures and pages show."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float, Float64, Int, Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh


def check_map(
    mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int[np.ndarray | Array, " m"]
) -> Int64[np.ndarray, " m"]:
    """Returns the pointwise map from X to Y as NumPy indices.

    **Raises:** `InputError` unless the map has one vertex of Y for every vertex of X.
    """
    indices = np.asarray(pointwise_map)
    m, n = len(mesh_x.vertices), len(mesh_y.vertices)
    if indices.shape != (m,) or not np.issubdtype(indices.dtype, np.integer):
        raise InputError(
            f"the pointwise map from {mesh_x.name} must hold one integer for each of its {m} vertices, but "
            f"has shape {indices.shape} and type {indices.dtype}; is the direction right (from X to Y)?"
        )
    if indices.min() < 0 or indices.max() >= n:
        raise InputError(
            f"the pointwise map to {mesh_y.name} holds indices from {indices.min()} to {indices.max()}, but "
            f"its vertices are 0 to {n - 1}; is the direction right (from X to Y) and the count from 0?"
        )
    return indices.astype(np.int64)


def check_errors(
    mesh_x: Mesh, errors: Mapping[str, Float[np.ndarray | Array, " m"]]
) -> dict[str, Float64[np.ndarray, " m"]]:
    """Returns the errors by name, as NumPy arrays.

    **Raises:** `InputError` unless there is one error for every vertex of X, non-negative or NaN (unknown).
    """
    m, checked = len(mesh_x.vertices), {}
    for name, of_vertices in errors.items():
        values = checked[name] = np.asarray(of_vertices, dtype=float)
        if values.shape != (m,) or np.any(values < 0):
            raise InputError(
                f"{name}: there must be {m} non-negative numbers, one for each vertex of {mesh_x.name} (NaN "
                f"where the error is unknown), but the array has shape {values.shape} and "
                f"{np.sum(values < 0)} negative entries."
            )
    return checked


def check_error_limit(limit: float) -> None:
    """Checks the end of the colour scale of errors.

    **Raises:** `InputError` unless the limit is positive and finite.
    """
    if not 0 < limit < np.inf:
        raise InputError(f"the error scale must end at a positive number, not at {limit}.")


def check_functional_map(
    functional_map: Float[np.ndarray | Array, "k_out k_in"],
) -> Float64[np.ndarray, "k_out k_in"]:
    """Returns the functional map C in NumPy float64.

    **Raises:** `InputError` if C is not a finite matrix.
    """
    matrix = np.asarray(functional_map, dtype=float)
    if matrix.ndim != 2 or not matrix.size or not np.isfinite(matrix).all():
        raise InputError(
            f"a functional map is a matrix of finite numbers, but this one has shape {matrix.shape}."
        )
    return matrix


def describe(mesh: Mesh) -> tuple[str, str]:
    """The caption of a body: the name of the file without its directory, and the number of vertices."""
    # File names may hold bytes that are not text; they become question marks.
    name = Path(mesh.name).name.encode("utf-8", "replace").decode()
    return name, f"{len(mesh.vertices)} vertices"
