"""Checks the maps, errors and functional maps that figures and pages show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Float, Float64, Int, Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh


def check_map(
    mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int[np.ndarray | Array, " m"]
) -> Int64[np.ndarray, " m"]:
    """Check a pointwise map, and return the map as an int64 array (m,).

    **Arguments:**

    - `mesh_x`, `mesh_y`: source (m vertices) and target.
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.

    **Raises:** `InputError` if the map does not have one vertex of Y for every vertex of X.
    """
    indices = np.asarray(pointwise_map)
    m, n = len(mesh_x.vertices), len(mesh_y.vertices)
    if indices.shape != (m,) or not np.issubdtype(indices.dtype, np.integer):
        raise InputError(
            f"the pointwise map has shape {indices.shape} and type {indices.dtype}, but must have one "
            f"integer for each of the {m} vertices of {mesh_x.name}; give a map from X to Y."
        )
    if indices.min() < 0 or indices.max() >= n:
        raise InputError(
            f"the pointwise map has indices from {indices.min()} to {indices.max()}, but the vertices of "
            f"{mesh_y.name} are 0 to {n - 1}; give a map from X to Y with vertices counted from 0."
        )
    return indices.astype(np.int64)


def check_errors(
    mesh_x: Mesh, errors: Mapping[str, Float[np.ndarray | Array, " m"]]
) -> dict[str, Float64[np.ndarray, " m"]]:
    """Check the errors of matches, and return the errors as NumPy arrays.

    **Arguments:**

    - `errors`: a dictionary from the name of each kind of error to an array (m,). The array contains a
      non-negative error for each vertex of X, or NaN where the error is unknown.

    **Returns:** A dictionary from the same names to the arrays (m,) in float64.

    **Raises:** `InputError` if an array does not have one non-negative number or NaN for every vertex of X.
    """
    m, checked = len(mesh_x.vertices), {}
    for name, of_vertices in errors.items():
        values = checked[name] = np.asarray(of_vertices, dtype=float)
        if values.shape != (m,) or np.any(values < 0):
            raise InputError(
                f"{name}: the array has shape {values.shape} and {np.sum(values < 0)} negative entries; give "
                f"{m} non-negative numbers, one for each vertex of {mesh_x.name} (NaN where the error is "
                "unknown)."
            )
    return checked


def check_error_limit(limit: float) -> None:
    """Check the upper end of the colour scale of errors.

    **Raises:** `InputError` if the limit is not positive or not finite.
    """
    if not 0 < limit < np.inf:
        raise InputError(f"the colour scale of errors ends at {limit}; give a positive finite number.")


def check_functional_map(
    functional_map: Float[np.ndarray | Array, "k_out k_in"],
) -> Float64[np.ndarray, "k_out k_in"]:
    """Check a functional map C (k_out, k_in), and return it as a NumPy array of float64.

    **Raises:** `InputError` if C is not a matrix of finite numbers, or if the matrix is empty.
    """
    matrix = np.asarray(functional_map, dtype=float)
    if matrix.ndim != 2 or not matrix.size or not np.isfinite(matrix).all():
        raise InputError(
            f"the functional map has shape {matrix.shape}, and {np.sum(~np.isfinite(matrix))} of its entries "
            "are not finite; give a non-empty matrix of finite numbers."
        )
    return matrix
