"""Searches for nearest points on the host: padded, compiled, and checked."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int64

from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.triangles import nearest_point_on_candidates
from jaxsmw.runtime.batches import pad_rows, padded_size, program_size
from jaxsmw.runtime.compilation import compiled


def nearest_rows(
    queries: Float[np.ndarray, "a d"], database: Float[np.ndarray, "b d"], mask: Bool[np.ndarray, " b"]
) -> Int64[np.ndarray, " a"]:
    """Return the row of the nearest point of the database for each query (a,), 0-based.

    **Arguments:**

    - `queries`, `database`: the points, (a, d) and (b, d), of the same float type.
    - `mask`: the rows of the database that may be returned (b,).

    **Raises:** `ArithmeticError` if some of these rows are not the nearest; see `check_nearest`.
    """

    def padded(rows: np.ndarray) -> Array:
        return jax.device_put(pad_rows(rows, padded_size(len(rows))))

    nearest = compiled(nearest_neighbor)(padded(queries), padded(database), database_mask=padded(mask))
    rows = np.asarray(nearest)[: len(queries)].astype(np.int64)
    check_nearest(queries, database, np.flatnonzero(mask), rows)
    return rows


# The number of queries that `check_nearest` checks, and the tolerance relative to the squared norms.
_CHECKED_QUERIES, _TOLERANCE = 32, 1e-4


def check_nearest(
    queries: Float[np.ndarray, "a d"],
    database: Float[np.ndarray, "b d"],
    usable: Int64[np.ndarray, " u"],
    nearest: Int64[np.ndarray, " a"],
) -> None:
    """Check a few results of a nearest-neighbour search in float64, because all maps depend on this search.

    A broken installation of JAX, a broken processor or a compiler fault would otherwise give a wrong map
    without a message. Points with NaN are not checked here.

    **Raises:** `ArithmeticError` if a result is not usable, or is farther than the nearest row by more than
    the rounding errors of float32.
    """
    rows = np.linspace(0, len(queries) - 1, _CHECKED_QUERIES).astype(int)
    few, all_rows = queries[rows].astype(np.float64), database[usable].astype(np.float64)
    sizes, size = (all_rows**2).sum(axis=1), (few**2).sum(axis=1)
    if not (np.isfinite(sizes).all() and np.isfinite(size).all()):
        return
    squared = size[:, None] - 2 * few @ all_rows.T + sizes
    reached = ((few - database[nearest[rows]].astype(np.float64)) ** 2).sum(axis=1)
    tolerance = _TOLERANCE * (size + sizes.max())
    if not (np.isin(nearest[rows], usable).all() and (reached <= squared.min(axis=1) + tolerance).all()):
        raise ArithmeticError(
            "JAX returned wrong nearest neighbours, so numerical results of this installation cannot be "
            "trusted: install jax and jaxlib again, and unset XLA_FLAGS and JAX_PLATFORMS."
        )


def nearest_points(
    queries: Float[np.ndarray, "m d"],
    database: Float[np.ndarray, "n d"],
    faces: Int64[np.ndarray, "f 3"],
    rows: Int64[np.ndarray, " c"],
    candidates: Int64[np.ndarray, " c"],
) -> tuple[Int64[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    """Return the nearest point on given candidate triangles for each query.

    **Arguments:**

    - `queries`, `database`: the queries (m, d), and the corners of the triangles (n, d).
    - `faces`: the triangles (f, 3), as rows of the database.
    - `rows`, `candidates`: pairs of a query (c,) and a triangle (c,) that is a candidate for it.

    **Returns:** The triangle (m,), and the barycentric weights (m, 3) of the point on it.
    """
    padding = padded_size(len(rows)) - len(rows)
    rows, candidates = (np.pad(values, (0, padding), "edge") for values in (rows, candidates))
    padded = (
        pad_rows(queries, program_size(len(queries))),
        pad_rows(database, program_size(len(database))),
        pad_rows(faces, padded_size(len(faces))),
        rows,
        candidates,
    )
    points = compiled(nearest_point_on_candidates)(*jax.device_put(padded))
    nearest, weights = (np.asarray(values)[: len(queries)] for values in points)
    return nearest.astype(np.int64), weights.astype(np.float64)
