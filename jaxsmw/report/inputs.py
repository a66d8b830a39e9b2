"""What the pictures are given, checked once for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float, Float64, Int, Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh

# The error scale ends at the 98th percentile, but never below this fraction of sqrt(area): a map without
# errors shall not look full of them.
_PERCENTILE, _SMALLEST_LIMIT = 98, 1e-3


def check_map(
    mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int[np.ndarray | Array, " m"]
) -> Int64[np.ndarray, " m"]:
    """The pointwise map from X to Y as NumPy indices.

    **Raises:** `InputError` unless it has one vertex of Y for every vertex of X.
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
    mesh_x: Mesh, errors: Mapping[str, Float[np.ndarray | Array, " m"]], limit: float | None
) -> tuple[dict[str, Float64[np.ndarray, " m"]], float]:
    """The errors as NumPy numbers by name, and where the colour scale of all ends.

    **Raises:** `InputError` unless there is one error for every vertex of X, non-negative or NaN (not known),
    and the limit, where given, is positive.
    """
    m, checked = len(mesh_x.vertices), {}
    for name, of_vertices in errors.items():
        values = checked[name] = np.asarray(of_vertices, dtype=float)
        if values.shape != (m,) or np.any(values < 0):
            raise InputError(
                f"{name}: there must be {m} non-negative numbers, one for each vertex of {mesh_x.name} (NaN "
                f"where it is not known), but they have shape {values.shape} and {np.sum(values < 0)} are "
                "negative."
            )
    if limit is None:
        finite = [values[np.isfinite(values)] for values in checked.values()]
        ends = [float(np.percentile(values, _PERCENTILE)) for values in finite if len(values)]
        limit = max(_SMALLEST_LIMIT, *ends, 0)
    if not 0 < limit < np.inf:
        raise InputError(f"the error scale must end at a positive number, not at {limit}.")
    return checked, limit


def check_functional_map(
    functional_map: Float[np.ndarray | Array, "k_out k_in"],
) -> Float64[np.ndarray, "k_out k_in"]:
    """C in NumPy float64.

    **Raises:** `InputError` if it is not a finite matrix.
    """
    matrix = np.asarray(functional_map, dtype=float)
    if matrix.ndim != 2 or not matrix.size or not np.isfinite(matrix).all():
        raise InputError(
            f"a functional map is a matrix of finite numbers, but this one has shape {matrix.shape}."
        )
    return matrix


def describe(mesh: Mesh) -> tuple[str, str]:
    """What the caption of a body says: the file's name without its directory, and the size."""
    # A file's name need not be text; what is not becomes a question mark.
    name = Path(mesh.name).name.encode("utf-8", "replace").decode()
    return name, f"{len(mesh.vertices)} vertices"
