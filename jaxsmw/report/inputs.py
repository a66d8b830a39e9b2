"""Checks the errors and functional maps that figures and pages show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Float64

from jaxsmw.core.arrays import Array
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh


def check_errors(
    mesh_x: Mesh, errors: Mapping[str, Float[np.ndarray | Array, " m"]]
) -> dict[str, Float64[np.ndarray, " m"]]:
    """Check that each kind of error has a non-negative number or NaN for every vertex of X (m,).

    Return the errors in float64.
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


def check_functional_map(
    functional_map: Float[np.ndarray | Array, "k_out k_in"],
) -> Float64[np.ndarray, "k_out k_in"]:
    """Check that a functional map is a non-empty matrix of finite numbers, and return it in float64."""
    matrix = np.asarray(functional_map, dtype=float)
    if matrix.ndim != 2 or not matrix.size or not np.isfinite(matrix).all():
        raise InputError(
            f"the functional map has shape {matrix.shape}, and {np.sum(~np.isfinite(matrix))} of its entries "
            "are not finite; give a non-empty matrix of finite numbers."
        )
    return matrix
