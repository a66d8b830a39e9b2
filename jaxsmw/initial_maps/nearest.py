"""Pointwise maps by nearest-neighbour search in feature space, extended from samples to all vertices."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float, Int64

from jaxsmw.core.search import nearest_neighbor
from jaxsmw.descriptors import SampledPair, SampledShape
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size


def nearest_map(
    sampled: SampledPair, features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"]
) -> Int64[np.ndarray, " m"]:
    """Compute a pointwise map of all vertices of X by nearest-neighbour search in feature space.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `features_x`, `features_y`: the features of X (a, d) and of Y (b, d), with one row per compared vertex.

    **Returns:** The map T: X -> Y (m,), 0-based vertices of Y.
    """
    return to_all_vertices(sampled, nearest_among_compared(features_x, features_y, sampled.y))


def nearest_among_compared(
    features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"], y: SampledShape
) -> Int64[np.ndarray, " a"]:
    """Find the nearest row of `features_y` for every row of `features_x`.

    **Arguments:**

    - `features_x`: features (a, d) of X.
    - `features_y`: features (b, d) of Y, with one row per compared vertex.
    - `y`: the shape Y. Rows of masked vertices are never chosen.

    **Returns:** The row numbers in `features_y` (a,), 0-based.

    **Raises:** `ArithmeticError` if some of the found rows are not the nearest; see `_check_nearest`.
    """
    dtype = y.spectrum.eigenvectors.dtype

    def padded(rows: np.ndarray) -> Array:
        return jax.device_put(pad_rows(rows, padded_size(len(rows))))

    nearest = compiled(nearest_neighbor)(
        *(padded(features.astype(dtype)) for features in (features_x, features_y)),
        database_mask=padded(np.asarray(y.spectrum.mask)),
    )
    found = np.asarray(nearest)[: len(features_x)].astype(np.int64)
    usable = np.flatnonzero(np.asarray(y.spectrum.mask)[: len(features_y)])
    _check_nearest(features_x, features_y, usable, found)
    return found


def _check_nearest(
    queries: Float[np.ndarray, "a d"],
    database: Float[np.ndarray, "b d"],
    usable: Int64[np.ndarray, " u"],
    found: Int64[np.ndarray, " a"],
) -> None:
    """Check a few results of a nearest-neighbour search, because all maps depend on this search.

    NumPy computes the distances of some queries to the whole database in float64. A broken installation of
    JAX, a broken processor or a compiler fault would otherwise give a wrong map without a message.

    **Arguments:**

    - `queries`, `database`: the points, (a, d) and (b, d). Points with NaN are not checked here.
    - `usable`: the rows of the database that the search may return (u,).
    - `found`: the row of the database that the search returned for each query (a,).

    **Raises:** `ArithmeticError` if a result is not usable, or is farther than the nearest row by more than
    the rounding errors of float32.
    """
    rows = np.linspace(0, len(queries) - 1, _CHECKED_QUERIES).astype(int)
    few, all_rows = queries[rows].astype(np.float64), database[usable].astype(np.float64)
    sizes, size = (all_rows**2).sum(axis=1), (few**2).sum(axis=1)
    if not (np.isfinite(sizes).all() and np.isfinite(size).all()):
        return
    squared = size[:, None] - 2 * few @ all_rows.T + sizes
    reached = ((few - database[found[rows]].astype(np.float64)) ** 2).sum(axis=1)
    tolerance = _TOLERANCE * (size + sizes.max())
    if not (np.isin(found[rows], usable).all() and (reached <= squared.min(axis=1) + tolerance).all()):
        raise ArithmeticError(
            "JAX returned wrong nearest neighbours, so numerical results of this installation cannot be "
            "trusted: install jax and jaxlib again, and unset XLA_FLAGS and JAX_PLATFORMS."
        )


# The number of queries that `_check_nearest` checks, and the tolerance relative to the squared norms.
_CHECKED_QUERIES, _TOLERANCE = 32, 1e-4


def to_all_vertices(sampled: SampledPair, found: Int64[np.ndarray, " a"]) -> Int64[np.ndarray, " m"]:
    """Extend a map between compared vertices to a pointwise map of all vertices of X.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `found`: the match of each compared vertex of X (a,), as a 0-based index into the compared vertices of
      Y.

    **Returns:** The map T: X -> Y (m,), 0-based vertices of Y.
    """
    if sampled.y.samples is not None:
        found = sampled.y.samples.vertices[found]
    return found if sampled.x.samples is None else found[sampled.x.samples.nearest]
