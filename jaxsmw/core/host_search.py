"""Exact nearest-neighbour search in NumPy arrays.

`nearest_neighbor` chooses between two searches, which give the same rows up to rounding errors:

- The exhaustive search compares all queries with all database points by matrix products.
- The search by tree rotates the points to the principal axes of the database and builds a k-d tree. It is
  faster if the first axes exclude most points, as in the joint space of `Registration`.

CPU times at 5000 queries and 5000 points in float32, on one core of an AMD EPYC, on data of a FAUST pair:
in the joint space of `Registration` (142 dimensions), the exhaustive search takes 0.085 s and the tree 0.036
s; in the embedding of `WaveletPreservation` (100 dimensions), they take 0.063 s and 0.62 to 1.1 s. The share
of points that the first axes do not exclude is 0.001 to 0.01 in the former, and above 0.5 in the latter.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
from jaxtyping import Bool, Float, Int, Int32
from scipy.spatial import KDTree

from jaxsmw.core.search import SearchProblem

# The exhaustive search multiplies _BLOCK queries by at most _CHUNK database points at once, so that the
# scores stay in the cache.
_BLOCK, _CHUNK = 256, 8192
# The largest number of points in a leaf of the tree. Of 10, 16 and 32, all take nearly the same time.
_LEAF = 16
# The principal axes are computed from _POINTS database points. _QUERIES queries decide between the searches.
_POINTS, _QUERIES = 512, 32
# The search by tree is chosen if the first axes exclude all but this share of the points. On FAUST, the tree
# takes 0.3 to 0.5 times the time of the exhaustive search at shares up to 0.01, and 2.5 times at 0.1.
_SHARE = 0.02
# The rotation of n points takes the time of an exhaustive search of d queries. With fewer than 16 d queries,
# the exhaustive search is faster.
_QUERIES_PER_AXIS = 16

# A prepared search returns the rows of a block of queries.
_Search = Callable[[Float[np.ndarray, "block d"]], Int[np.ndarray, " block"]]
_Map = Callable[..., Iterator]


def nearest_neighbor(
    queries: Float[np.ndarray, "m d"],
    database: Float[np.ndarray, "n d"],
    database_mask: Bool[np.ndarray, " n"] | None = None,
) -> Int32[np.ndarray, " m"]:
    """Return the same as `jaxsmw.core.search.nearest_neighbor`, but always an index from 0 to n - 1.

    If a query is NaN, its index is meaningless. The search uses all cores that the process may use; limit
    the threads of the linear algebra to one meanwhile. The number of cores does not affect the result.
    """
    (nearest,) = _nearest_of_all(SearchProblem(queries, database, database_mask))
    return nearest


def nearest_in_both(
    first: SearchProblem, second: SearchProblem
) -> tuple[Int32[np.ndarray, " m_1"], Int32[np.ndarray, " m_2"]]:
    """Return the results of two searches by `nearest_neighbor`, which run at the same time."""
    nearest_first, nearest_second = _nearest_of_all(first, second)
    return nearest_first, nearest_second


def _nearest_of_all(*problems: SearchProblem) -> list[Int32[np.ndarray, " m"]]:
    with _threads() as run:
        searches = list(run(_prepare, problems))
        blocks = [
            (number, start)
            for number, problem in enumerate(problems)
            for start in range(0, len(problem.queries), _BLOCK)
        ]

        def search(block: tuple[int, int]) -> Int[np.ndarray, " block"]:
            number, start = block
            with np.errstate(over="ignore", invalid="ignore"):
                return searches[number](problems[number].queries[start : start + _BLOCK])

        results = [np.empty(len(problem.queries), np.int32) for problem in problems]
        for (number, start), rows in zip(blocks, run(search, blocks), strict=True):
            results[number][start : start + _BLOCK] = rows
    return results


@contextmanager
def _threads() -> Iterator[_Map]:
    """Provide a `map` that uses all cores of the process."""
    cores = _cores()
    if cores == 1:
        yield map
        return
    with ThreadPoolExecutor(cores) as executor:
        yield executor.map


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _prepare(problem: SearchProblem) -> _Search:
    """Choose the search for a problem."""
    queries, database, mask = problem
    rows = _distinct_rows(database, mask)
    points = database if len(rows) == len(database) else database[rows]
    center = points.mean(axis=0, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        if len(points) > _LEAF and len(queries) > _QUERIES_PER_AXIS * queries.shape[1]:
            finite = np.isfinite(points).all() and np.isfinite(queries).all()
            axes = _principal_axes(points, center) if finite else None
            if axes is not None and _share_of_near_points(queries, points, center, axes) < _SHARE:
                return _by_tree(points, rows, center, axes)
        return _exhaustive(points, rows, center.astype(points.dtype))


def _distinct_rows(
    database: Float[np.ndarray, "n d"], mask: Bool[np.ndarray, " n"] | None
) -> Int[np.ndarray, " r"]:
    """Return the rows that can be chosen, without those that equal an earlier row."""
    allowed = np.arange(len(database)) if mask is None else np.flatnonzero(mask)
    if not len(allowed):
        return np.zeros(1, int)
    # The sum turns -0.0 into 0.0, which is equal but has other bits.
    points = np.ascontiguousarray(database[allowed] + 0)
    words = points.view(np.dtype(f"u{points.itemsize}"))
    factors = np.random.default_rng(0).integers(2**63, size=words.shape[1], dtype=np.uint64)
    hashes = (words * factors).sum(axis=1, dtype=np.uint64)
    _, first, same = np.unique(hashes, return_index=True, return_inverse=True)
    if len(first) == len(allowed):
        return allowed
    repeated = np.all(words == words[first[same]], axis=1) & (first[same] < np.arange(len(allowed)))
    return allowed[~repeated]


def _exhaustive(
    points: Float[np.ndarray, "n d"], rows: Int[np.ndarray, " n"], center: Float[np.ndarray, " d"]
) -> _Search:
    """Prepare a comparison of each query with all points, which the product of matrices contains.

    The score of a point b for a query q is `q·b - |b|²/2`. Exact distances decide between the two points with
    the best scores, because scores have larger rounding errors.
    """
    points = points - center
    columns = np.vstack([points.T, -0.5 * np.einsum("nd,nd->n", points, points)])
    chunks = range(0, len(points), _CHUNK)

    def search(block: Float[np.ndarray, "block d"]) -> Int[np.ndarray, " block"]:
        block = block - center
        extended = np.column_stack([block, np.ones(len(block), block.dtype)])
        each = np.arange(len(block))
        candidates, best = [], []
        for start in chunks:
            scores = extended @ columns[:, start : start + _CHUNK]
            for _ in range(2):
                highest = np.argmax(scores, axis=1)
                candidates.append(start + highest)
                best.append(scores[each, highest])
                scores[each, highest] = -np.inf
        order = np.argsort(-np.array(best), axis=0, kind="stable")[:2]
        both = np.sort(np.take_along_axis(np.array(candidates), order, axis=0), axis=0)
        distances = np.sum((block - points[both]) ** 2, axis=2)
        return rows[np.where(distances[1] < distances[0], both[1], both[0])]

    return search


def _by_tree(
    points: Float[np.ndarray, "n d"],
    rows: Int[np.ndarray, " n"],
    center: Float[np.ndarray, " d"],
    axes: Float[np.ndarray, "d d"],
) -> _Search:
    """Prepare a k-d tree of the points in the coordinates of principal axes, in float64."""
    # A tree of median splits takes longer to build. Nodes without compaction take twice as long to search.
    tree = KDTree((points - center) @ axes, leafsize=_LEAF, balanced_tree=False)
    return lambda block: rows[tree.query((block - center) @ axes)[1]]


def _principal_axes(
    points: Float[np.ndarray, "n d"], center: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "d d"]:
    """Return the principal axes of a part of the points as columns, in order of decreasing variance."""
    part = points[:: -(-len(points) // _POINTS)] - center
    return np.linalg.eigh(part.T @ part)[1][:, ::-1]


def _share_of_near_points(
    queries: Float[np.ndarray, "m d"],
    points: Float[np.ndarray, "n d"],
    center: Float[np.ndarray, " d"],
    axes: Float[np.ndarray, "d d"],
) -> float:
    """Return the share of points that the axes along which a tree splits cannot exclude, for a few queries.

    A tree of n / 16 leaves splits along about log2(n / 16) axes. It cannot exclude a point that is nearer to
    the query along these axes than the nearest point is.
    """
    few = queries[:: -(-len(queries) // _QUERIES)]
    center, axes = center.astype(points.dtype), axes.astype(points.dtype)
    few, points = few - center, points - center
    used = axes[:, : max(1, round(np.log2(len(points) / _LEAF)))]
    nearest = _squared_distances(few, points).min(axis=1, keepdims=True)
    return float(np.mean(_squared_distances(few @ used, points @ used) < nearest))


def _squared_distances(
    queries: Float[np.ndarray, "m d"], points: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "m n"]:
    squares = [np.einsum("nd,nd->n", rows, rows) for rows in (queries, points)]
    return squares[0][:, None] + squares[1] - 2 * queries @ points.T
