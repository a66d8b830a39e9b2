"""One-to-one maps, in which no two source vertices share a target vertex."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.errors import InputError

# The largest allowed value of m n, the product of the numbers of vertices. A computation of this size takes
# 3 GiB of memory and 15 minutes.
_LARGEST = 20_000**2


def one_to_one_map(
    embedding_x: Float[np.ndarray, "m d"],
    embedding_y: Float[np.ndarray, "n d"],
    *,
    mask_x: Bool[np.ndarray, " m"] | None = None,
    mask_y: Bool[np.ndarray, " n"] | None = None,
) -> Int64[np.ndarray, " m"]:
    """Compute the one-to-one map X -> Y with the least sum of squared distances between matched points.

    SciPy computes the exact optimum by shortest augmenting paths (Crouse 2016, "On implementing 2D
    rectangular assignment algorithms"). The function stores an (m, n) matrix in float64. For two real bodies
    of 5000 vertices each, the computation takes 15 seconds and 0.7 GiB of memory. The time grows with the
    third power of the number of vertices.

    One-to-one maps suit shapes whose vertices correspond one by one, such as shapes with the same
    triangulation. On pairs of the remeshed FAUST data set, the restriction to one-to-one maps increases the
    mean geodesic error from 0.022 to 0.062, because several vertices of X often have the same best match.

    **Arguments:**

    - `embedding_x`, `embedding_y`: points (m, d) and (n, d), one per vertex of X and of Y, in the same unit.
      The map matches vertices whose points are close together.
    - `mask_x`, `mask_y`: Boolean arrays (m,) and (n,), False for vertices that are not matched. By default,
      all vertices are matched.

    **Returns:** An integer array (m,): the 0-based vertex of Y for each vertex of X, and -1 for each masked
    vertex of X.

    **Raises:** `InputError` if Y has fewer unmasked vertices than X, if the product of these two numbers of
    vertices is above 20 000², if a point of an unmasked vertex is not finite, or if array shapes do not
    match.
    """
    for points, mask, side in ((embedding_x, mask_x, "x"), (embedding_y, mask_y, "y")):
        if points.ndim != 2:
            raise InputError(f"embedding_{side} has shape {points.shape}: give one point per row.")
        if mask is not None and mask.shape != points.shape[:1]:
            raise InputError(
                f"mask_{side} has shape {mask.shape}, but embedding_{side} has {len(points)} points: give "
                "one entry per point."
            )
    if embedding_x.shape[1] != embedding_y.shape[1]:
        raise InputError(
            f"the points of X have {embedding_x.shape[1]} dimensions, but the points of Y have "
            f"{embedding_y.shape[1]}: give points of equal dimension."
        )
    rows, columns = (
        np.arange(len(points)) if mask is None else np.flatnonzero(mask)
        for points, mask in ((embedding_x, mask_x), (embedding_y, mask_y))
    )
    check_one_to_one(len(rows), len(columns))
    x, y = embedding_x[rows].astype(np.float64), embedding_y[columns].astype(np.float64)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("an embedding for a one-to-one map contains NaN or infinity: give finite points.")
    # The squared distance is |x - y|² = |x|² + |y|² - 2 x·y. The term |x|² is left out, because it is the
    # same for every match of x.
    costs = x @ (-2 * y.T)
    costs += np.sum(y**2, axis=1)
    from scipy.optimize import linear_sum_assignment  # this import is slow and rarely needed

    matched, found = linear_sum_assignment(costs)
    pointwise_map = np.full(len(embedding_x), -1)
    pointwise_map[rows[matched]] = columns[found]
    return pointwise_map


def check_one_to_one(vertices_x: int, vertices_y: int) -> None:
    """Raise `InputError` if `one_to_one_map` cannot match meshes with these numbers of vertices."""
    if vertices_x > vertices_y:
        raise InputError(
            f"the {vertices_x} vertices of the source cannot be matched one to one to the {vertices_y} of "
            "the target, because the target has fewer vertices: swap the meshes."
        )
    if vertices_x * vertices_y > _LARGEST:
        raise InputError(
            f"a one-to-one map from {vertices_x} to {vertices_y} vertices would take "
            f"{vertices_x * vertices_y * 8 >> 30} GiB of memory and hours of computation: "
            "decimate the meshes to 20000 vertices."
        )
