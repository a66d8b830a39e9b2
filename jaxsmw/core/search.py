"""Exact nearest-neighbour search."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxtyping import Bool, Float, Int32

from jaxsmw.core.arrays import Array, is_traced


def nearest_neighbor(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    *,
    database_mask: Bool[Array, " n"] | None = None,
) -> Int32[Array, " m"]:
    """Return, for each query, the index of the database row that is nearest in Euclidean distance.

    The search is exact up to rounding errors. Of several
    identical database rows, the first is returned. The queries are processed in blocks, so no array of size m
    x n is stored.

    JAX compares every query with every row. NumPy leaves rows out if a tree or a few clusters show that they
    are too far away; see `jaxsmw.core.host_search`. The score of a database row b for a query q is `q·b -
    |b|²/2`, which is largest for the nearest row. The search compares the distances to two of the rows with
    the best scores, because scores have large rounding errors if `|b|` is large compared to the distance.

    **Arguments:**

    - `queries`, `database`: query points (m, d) and database points (n, d), in the same unit.
    - `database_mask`: a Boolean array (n,), False for rows that are never chosen; at least one must be True.
      With None (the default), all rows can be chosen.

    **Returns:** One index from 0 to n - 1 per query, an int32 array (m,).

    **Raises:** `TypeError` if queries and database have different dimensions d. `ValueError` if the database
    is empty, an array does not have two dimensions, or `database_mask` does not have shape (n,).
    """
    if queries.ndim != 2 or database.ndim != 2 or not len(database):
        raise ValueError(
            f"the queries have shape {queries.shape} and the database has shape {database.shape}, but (m, d) "
            "and (n, d) with at least one row are needed"
        )
    if queries.shape[1] != database.shape[1]:
        raise TypeError(
            f"the queries have {queries.shape[1]} dimensions, and the database has {database.shape[1]}: give "
            "points of the same space"
        )
    if database_mask is not None and database_mask.shape != database.shape[:1]:
        raise ValueError(
            f"the mask has shape {database_mask.shape}, but the database has {len(database)} rows: give one "
            "entry for each row"
        )
    return _implementation(queries, database).nearest_neighbor(queries, database, database_mask)


class SearchProblem(NamedTuple):
    """The arguments of one search by `nearest_neighbor`."""

    queries: Float[Array, "m d"]
    database: Float[Array, "n d"]
    database_mask: Bool[Array, " n"] | None = None


def nearest_in_both(
    first: SearchProblem, second: SearchProblem
) -> tuple[Int32[Array, " m_1"], Int32[Array, " m_2"]]:
    """Return the results of two searches, (m_1,) and (m_2,), of which the sizes may differ."""
    return _implementation(*first, *second).nearest_in_both(first, second)


def _implementation(*arrays: Array | None) -> Any:
    if is_traced(*arrays):
        from jaxsmw.core import traced_search

        return traced_search
    from jaxsmw.core import host_search

    return host_search
