"""Exact nearest-neighbour search in NumPy arrays.

`nearest_neighbor` chooses among three searches, which give the same rows up to rounding errors:

- The exhaustive search compares all queries with all database points by matrix products.
- The search by tree rotates the points to the principal axes of the database and builds a k-d tree. It is
  faster if the first axes exclude most points, as in the joint space of `Registration`.
- The search in clusters skips most groups of points of large databases.

A few queries decide which search is the fastest. CPU times in seconds in float32 on one core of an AMD EPYC,
on data of a FAUST pair of which the large meshes were subdivided:

| points | space, dimensions          | exhaustive |  tree | clusters |
| -----: | -------------------------- | ---------: | ----: | -------: |
|  5 000 | `Registration`, 56         |      0.037 | 0.015 |          |
|  5 000 | `Registration`, 142        |      0.085 | 0.036 |          |
|  5 000 | `FeatureRegression`, 120   |      0.075 |  0.19 |          |
|  5 000 | `WaveletPreservation`, 100 |      0.064 |   0.9 |          |
| 20 000 | eigenvectors, 60           |       0.95 |       |     0.41 |
| 20 000 | eigenvectors, 120          |        1.6 |       |     0.97 |
| 80 000 | eigenvectors, 60           |         15 |   460 |      2.3 |
| 80 000 | eigenvectors, 120          |         25 |  1000 |      6.5 |
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int32
from scipy.spatial import KDTree

from jaxsmw.core.arrays import Array

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

# The search in clusters is possible from _CLUSTERED_FROM points on, if at least n / 4 queries share the cost
# of its preparation. It is chosen if a few blocks need less than _NEEDED of all clusters.
_CLUSTERED_FROM, _POINTS_PER_QUERY, _NEEDED = 15_000, 4, 0.4
# The number of points in a cluster, the number of axes of its box, and the number of queries in a block.
# These values gave the fastest search of 20 000 and of 80 000 points in 60 and in 120 dimensions.
_CLUSTER, _AXES, _CLUSTERED_BLOCK = 40, 6, 128
# The number of blocks that decide whether clusters are used.
_TRIED_BLOCKS = 8
# Iterations of the power method for the axes of clusters and for the axes along which clusters are halved.
_ITERATIONS = 3

# The queries (m, d), the database (n, d) and its mask (n,) of one search.
_Problem = tuple[Array, Array, Array | None]
# The rows of a block of queries.
_Block = slice | Int[np.ndarray, " block"]
# A prepared search returns the nearest database rows of a block of queries.
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
    (nearest,) = _nearest_of_all((queries, database, database_mask))
    return nearest


def nearest_in_both(
    first: _Problem, second: _Problem
) -> tuple[Int32[np.ndarray, " m_1"], Int32[np.ndarray, " m_2"]]:
    """Return the results of two searches by `nearest_neighbor`, which run at the same time."""
    nearest_first, nearest_second = _nearest_of_all(first, second)
    return nearest_first, nearest_second


def _nearest_of_all(*problems: _Problem) -> list[Int32[np.ndarray, " m"]]:
    with _threads() as run:
        prepared = list(run(_prepare, problems))
        tasks = [(number, block) for number, (blocks, _) in enumerate(prepared) for block in blocks]

        def search(task: tuple[int, _Block]) -> Int[np.ndarray, " block"]:
            number, block = task
            with np.errstate(over="ignore", invalid="ignore"):
                return prepared[number][1](np.asarray(problems[number][0])[block])

        results = [np.empty(len(problem[0]), np.int32) for problem in problems]
        for (number, block), rows in zip(tasks, run(search, tasks), strict=True):
            results[number][block] = rows
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


def _prepare(problem: _Problem) -> tuple[Sequence[_Block], _Search]:
    """Choose the search for a problem. Return the blocks of queries that it searches for at once, and it."""
    queries, database = (np.asarray(points) for points in problem[:2])
    mask = None if problem[2] is None else np.asarray(problem[2])
    rows = _distinct_rows(database, mask)
    points = database if len(rows) == len(database) else database[rows]
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(queries), _BLOCK)]
    with np.errstate(over="ignore", invalid="ignore"):
        center = points.mean(axis=0, dtype=np.float64)
        # Squared distances between very large numbers are infinite and exclude nothing.
        if np.isfinite(np.vdot(points, points) + np.vdot(queries, queries)):
            if len(points) > _LEAF and len(queries) > _QUERIES_PER_AXIS * queries.shape[1]:
                axes = _principal_axes(points, center)
                if _share_of_near_points(queries, points, center, axes) < _SHARE:
                    return blocks, _by_tree(points, rows, center, axes)
            if len(points) >= _CLUSTERED_FROM and len(queries) * _POINTS_PER_QUERY >= len(points):
                clusters = _Clusters.of(points, rows, center.astype(points.dtype))
                near_queries = _halved(queries, _CLUSTERED_BLOCK)
                tried = near_queries[:: -(-len(near_queries) // _TRIED_BLOCKS)]
                needed = np.mean([len(clusters.needed(queries[block])) for block in tried])
                if needed < _NEEDED * len(clusters.rows):
                    return list(near_queries), clusters.search
        return blocks, _exhaustive(points, rows, center.astype(points.dtype))


def _distinct_rows(
    database: Float[np.ndarray, "n d"], mask: Bool[np.ndarray, " n"] | None
) -> Int[np.ndarray, " r"]:
    """Return the rows that can be chosen, without those that equal an earlier row."""
    allowed = np.arange(len(database)) if mask is None else np.flatnonzero(mask)
    if not len(allowed):
        return np.zeros(1, int)
    # The sum turns -0.0 into 0.0, which is equal but has other bits.
    points = np.ascontiguousarray(database[allowed] + 0)
    # Words of 64 bits would have poor hashes, because only the first bits of round numbers are not zero.
    words = points.view(np.uint32)
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
        found = [_two_best(extended @ columns[:, start : start + _CHUNK]) for start in chunks]
        candidates = np.vstack([start + best for start, (best, _) in zip(chunks, found, strict=True)])
        order = np.argsort(-np.vstack([scores for _, scores in found]), axis=0, kind="stable")[:2]
        return rows[_nearer(block, points, np.take_along_axis(candidates, order, axis=0))]

    return search


def _two_best(
    scores: Float[np.ndarray, "block n"],
) -> tuple[Int[np.ndarray, "2 block"], Float[np.ndarray, "2 block"]]:
    """Return the columns of the two highest scores of each row, and these scores. Overwrite the scores."""
    each = np.arange(len(scores))
    best = np.argmax(scores, axis=1)
    highest = scores[each, best]
    scores[each, best] = -np.inf
    second = np.argmax(scores, axis=1)
    return np.stack([best, second]), np.stack([highest, scores[each, second]])


def _nearer(
    block: Float[np.ndarray, "block d"],
    points: Float[np.ndarray, "n d"],
    candidates: Int[np.ndarray, "2 block"],
) -> Int[np.ndarray, " block"]:
    """Return the nearer of two candidates of each query, or the lower one if both are equally near."""
    low, high = np.sort(candidates, axis=0)
    distances = [np.sum((block - points[rows]) ** 2, axis=1) for rows in (low, high)]
    return np.where(distances[1] < distances[0], high, low)


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


class _Clusters(NamedTuple):
    """Groups of s nearby points, each with a bounding box of r axes, in coordinates relative to `center`.

    The box gives a lower bound on the distances from a query to the points. The points of a cluster on a
    surface differ mainly along a few directions, so the axes span nearly all of the differences.

    - `members`: the positions of the points of each cluster in `points`, and `rows` those in the database.
    - `extended`: the points of each cluster, with `-|b|²/2` as last coordinate.
    - `axes`, `offsets`, `low`, `high`: the axes; the coordinate of the cluster's centre along each axis; and
      the smallest and the largest coordinate of its points.
    - `radii`, `thickness`: the largest distance of a point from the centre, and from the space through the
      centre that the axes span.
    - `precision`, `largest`: the relative rounding error of a squared distance, and the largest `|b|²`.
    """

    center: Float[np.ndarray, " d"]
    points: Float[np.ndarray, "n d"]
    rows: Int[np.ndarray, " n"]
    members: Int[np.ndarray, "c s"]
    extended: Float[np.ndarray, "c s d+1"]
    centers: Float[np.ndarray, "c d"]
    axes: Float[np.ndarray, "r c d"]
    offsets: Float[np.ndarray, "r c"]
    low: Float[np.ndarray, "r c"]
    high: Float[np.ndarray, "r c"]
    radii: Float[np.ndarray, " c"]
    thickness: Float[np.ndarray, " c"]
    precision: float
    largest: float

    @staticmethod
    def of(
        points: Float[np.ndarray, "n d"], rows: Int[np.ndarray, " n"], center: Float[np.ndarray, " d"]
    ) -> _Clusters:
        """Divide points into clusters and compute their boxes."""
        points = points - center
        d = points.shape[1]
        members = np.sort(_halved(points, _CLUSTER), axis=1)
        squares = np.einsum("nd,nd->n", points, points)
        extended = np.column_stack([points, -0.5 * squares])[members]
        centers = extended[:, :, :d].mean(axis=1)
        deviations = extended[:, :, :d] - centers[:, None]
        start = np.random.default_rng(0).normal(size=(d, min(_AXES, d))).astype(points.dtype)
        along = deviations @ start
        for _ in range(_ITERATIONS):
            axes = np.linalg.qr(_transposed(deviations) @ along)[0]
            along = deviations @ axes
        offsets = np.einsum("cd,cdr->rc", centers, axes)
        precision = 2 * (d + 12) * float(np.finfo(points.dtype).eps)
        radii = np.sqrt(np.einsum("csd,csd->cs", deviations, deviations).max(axis=1)) * (1 + precision)
        deviations -= along @ _transposed(axes)
        thickness = np.sqrt(np.einsum("csd,csd->cs", deviations, deviations).max(axis=1)) * (1 + precision)
        return _Clusters(
            center,
            points,
            rows,
            members,
            extended,
            centers,
            np.ascontiguousarray(axes.transpose(2, 0, 1)),
            offsets,
            offsets + along.min(axis=1).T,
            offsets + along.max(axis=1).T,
            radii,
            thickness,
            precision,
            float(squares.max()),
        )

    def search(self, block: Float[np.ndarray, "block d"]) -> Int[np.ndarray, " block"]:
        """Return the database rows that are nearest to nearby queries."""
        needed = self.needed(block)
        best, _ = _two_best(self._scores(block - self.center, needed))
        return self.rows[_nearer(block - self.center, self.points, self.members[needed].reshape(-1)[best])]

    def needed(self, block: Float[np.ndarray, "block d"]) -> Int[np.ndarray, " needed"]:
        """Return all clusters that can contain the nearest point of a query."""
        block = block - self.center
        squares = np.einsum("bd,bd->b", block, block)[:, None]
        tolerance = self.precision * (squares + self.largest)
        to_centers = squares + np.einsum("cd,cd->c", self.centers, self.centers) - 2 * block @ self.centers.T
        candidates = np.unique(np.argmin(to_centers, axis=1))
        scores = self._scores(block, candidates).max(axis=1, keepdims=True)
        reach = np.maximum(squares - 2 * scores, 0) + tolerance
        # The balls around the centres exclude many clusters before the boxes are used. The negations keep
        # clusters with bounds that are not a number.
        excluded = to_centers - tolerance > (np.sqrt(reach) + self.radii) ** 2
        near = np.flatnonzero(~excluded.all(axis=0))
        beside = to_centers[:, near] - tolerance
        bounds = np.zeros_like(beside)
        for axes, offsets, low, high in zip(self.axes, self.offsets, self.low, self.high, strict=True):
            along = block @ axes[near].T
            bounds += (along - np.clip(along, low[near], high[near])) ** 2
            beside -= (along - offsets[near]) ** 2
        beside = np.sqrt(np.maximum(beside, 0)) - self.thickness[near]
        bounds += np.maximum(beside, 0) ** 2
        return near[~(bounds > reach + tolerance).all(axis=0)]

    def _scores(
        self, block: Float[np.ndarray, "block d"], clusters: Int[np.ndarray, " c"]
    ) -> Float[np.ndarray, "block candidates"]:
        """Return the scores of all points of some clusters, as in `_exhaustive`."""
        extended = self.extended[clusters].reshape(-1, self.extended.shape[2])
        return np.column_stack([block, np.ones(len(block), block.dtype)]) @ extended.T


def _halved(points: Float[np.ndarray, "n d"], size: int) -> Int[np.ndarray, "c s"]:
    """Divide points into equal groups by repeated halving along the axis of largest variance of each group.

    The groups have 0.7 to 1.4 times `size` points. The last point is repeated to fill the groups.
    """
    levels = max(0, round(np.log2(len(points) / size)))
    total = -(-len(points) // 2**levels) * 2**levels
    groups = np.minimum(np.arange(total), len(points) - 1)[None]
    for _ in range(levels):
        deviations = points[groups]
        deviations -= deviations.mean(axis=1, keepdims=True)
        widest = np.einsum("gsd,gsd->gd", deviations, deviations).argmax(axis=1)
        along = np.take_along_axis(deviations, widest[:, None, None], axis=2)
        for _ in range(_ITERATIONS):
            axis = _transposed(deviations) @ along
            length = np.linalg.norm(axis, axis=1, keepdims=True)
            along = deviations @ (axis / np.where(length > 0, length, 1))
        order = np.argsort(along[:, :, 0], axis=1, kind="stable")
        groups = np.take_along_axis(groups, order, axis=1).reshape(2 * len(groups), -1)
    return groups


def _transposed(matrices: Float[np.ndarray, "c p q"]) -> Float[np.ndarray, "c q p"]:
    return matrices.transpose(0, 2, 1)


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
