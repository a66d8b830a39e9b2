"""Exact nearest-neighbour search in NumPy arrays.

`nearest_neighbor` chooses among three searches, which give the same rows up to rounding errors:

- The exhaustive search compares all queries with all database points by matrix products.
- The search by tree rotates the points to the principal axes of the database and builds a k-d tree. It is
  faster if the first axes exclude most points, as in the joint space of `Registration`.
- The search in clusters divides large databases into groups of nearby points, these into smaller groups, and
  so on. It skips groups that are too far away from a block of nearby queries.

A few queries decide which search is the fastest. CPU times in seconds in float32 on one core of an AMD EPYC,
on data of a FAUST pair of which the large meshes were subdivided:

| points | space, dimensions          | exhaustive |  tree | clusters |
| -----: | -------------------------- | ---------: | ----: | -------: |
|  5 000 | `Registration`, 56         |      0.037 | 0.015 |          |
|  5 000 | `Registration`, 142        |      0.085 | 0.036 |          |
|  5 000 | `FeatureRegression`, 120   |      0.075 |  0.19 |          |
|  5 000 | `WaveletPreservation`, 100 |      0.064 |   0.9 |          |
| 30 000 | `WaveletPreservation`, 100 |            |       |      1.1 |
| 30 000 | `Registration`, 142        |            |   0.5 |      0.6 |
| 80 000 | eigenvectors, 60           |         15 |   460 |          |
| 80 000 | eigenvectors, 120          |         25 |  1000 |          |
|   10⁵  | `WaveletPreservation`, 100 |            |       |      3.6 |
|   10⁵  | `Registration`, 142        |            |   3.1 |      2.3 |
|   10⁶  | `WaveletPreservation`, 100 |            |       |       45 |
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

# Threads are started from this number of comparisons on. Without them, a search with 1000 queries of 1000
# points takes 0.5 to 0.8 times the CPU time.
_THREADS_FROM = 5_000_000

# The search in clusters is possible from _CLUSTERED_FROM points on, if at least n / 4 queries share the cost
# of its preparation. It is chosen if a few blocks need less than _NEEDED of all clusters.
_CLUSTERED_FROM, _POINTS_PER_QUERY, _NEEDED = 15_000, 4, 0.4
# The number of points in a cluster, the number of axes of its box, and the number of queries in a block.
# These values gave fast searches of 20 000 to 300 000 points in 60 to 120 dimensions. With clusters of 20
# points or with 4 axes, the time changes by less than 15 %.
_CLUSTER, _AXES, _CLUSTERED_BLOCK = 40, 6, 128
# The number of blocks that decide whether clusters are used.
_TRIED_BLOCKS = 8
# The number of parts of a group of clusters, a power of two. With 4 and 16, the time is nearly the same.
_PARTS = 8
# The number of random directions along which groups are halved. With all coordinates, halving a million
# points of 100 dimensions takes 2.5 times as long, and the search then takes 0.9 times as long.
_DIRECTIONS = 48
# The number of points that give the axis along which a group is halved. With 64 and 1024, the search takes
# nearly the same time.
_SPREAD = 256
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
    with _threads(sum(len(queries) * len(database) for queries, database, _ in problems)) as run:
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
def _threads(comparisons: int = _THREADS_FROM) -> Iterator[_Map]:
    """Provide a `map` that uses all cores of the process, if there is enough to compare."""
    cores = _cores()
    if cores == 1 or comparisons < _THREADS_FROM:
        yield map
        return
    with ThreadPoolExecutor(cores) as executor:
        yield executor.map


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _prepare(problem: _Problem) -> tuple[Sequence[_Block], _Search]:
    """Choose the search for a problem. Return the blocks of queries that it searches for at once, and it."""
    both = np.result_type(*problem[:2], np.float32)  # other types have no fast matrix products
    queries, database = (np.asarray(points, both) for points in problem[:2])
    mask = None if problem[2] is None else np.asarray(problem[2])
    rows = _distinct_rows(database, mask)
    points = database if len(rows) == len(database) else database[rows]
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(queries), _BLOCK)]
    with np.errstate(over="ignore", invalid="ignore"):
        center = points.mean(axis=0, dtype=np.float64)
        # Squared distances between very large numbers are infinite and exclude nothing.
        if np.isfinite(np.vdot(points, points) + np.vdot(queries, queries)):
            if len(points) >= _CLUSTERED_FROM and len(queries) * _POINTS_PER_QUERY >= len(points):
                with _threads() as run:
                    sizes = _CLUSTER, _CLUSTERED_BLOCK
                    members, near_queries = run(_halved, (points, queries), sizes)
                clusters = _Clusters.of(points, rows, center.astype(points.dtype), members)
                tried = near_queries[:: -(-len(near_queries) // _TRIED_BLOCKS)]
                needed = np.mean([len(clusters.needed(queries[block])) for block in tried])
                if needed < _NEEDED * len(members):
                    return list(near_queries), clusters.search
            if len(points) > _LEAF and len(queries) > _QUERIES_PER_AXIS * queries.shape[1]:
                axes = _principal_axes(points, center)
                if _share_of_near_points(queries, points, center, axes) < _SHARE:
                    return blocks, _by_tree(points, rows, center, axes)
        return blocks, _exhaustive(points, rows, center.astype(points.dtype))


def _distinct_rows(
    database: Float[np.ndarray, "n d"], mask: Bool[np.ndarray, " n"] | None
) -> Int[np.ndarray, " r"]:
    """Return the rows that can be chosen, without those that equal an earlier row."""
    allowed = np.arange(len(database)) if mask is None else np.flatnonzero(mask)
    if not len(allowed):
        return np.zeros(1, int)
    words = database.shape[1] * database.itemsize // 4
    factors = np.random.default_rng(0).integers(2**63, size=words, dtype=np.uint64)
    hashes = np.empty(len(allowed), np.uint64)
    for start in range(0, len(allowed), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        # The sum turns -0.0 into 0.0, which is equal but has other bits.
        points = np.ascontiguousarray(database[allowed[chunk]] + 0)
        # Words of 64 bits would have poor hashes, because only the first bits of round numbers are not zero.
        hashes[chunk] = points.view(np.uint32) @ factors
    _, first, same = np.unique(hashes, return_index=True, return_inverse=True)
    earlier = first[same]
    repeated = np.flatnonzero(earlier < np.arange(len(allowed)))
    equal = database[allowed[repeated]] == database[allowed[earlier[repeated]]]
    return np.delete(allowed, repeated[equal.all(axis=1)])


def _exhaustive(
    points: Float[np.ndarray, "n d"], rows: Int[np.ndarray, " n"], center: Float[np.ndarray, " d"]
) -> _Search:
    """Prepare a comparison of each query with all points, which the product of matrices contains.

    The score of a point b for a query q is `q·b - |b|²/2`. Exact distances decide between the two points with
    the best scores, because scores have larger rounding errors.
    """
    columns = np.empty((points.shape[1] + 1, len(points)), points.dtype)
    np.subtract(points.T, center[:, None], out=columns[:-1])
    columns[-1] = -0.5 * np.einsum("dn,dn->n", columns[:-1], columns[:-1])
    chunks = range(0, len(points), _CHUNK)

    def search(block: Float[np.ndarray, "block d"]) -> Int[np.ndarray, " block"]:
        extended = np.column_stack([block - center, np.ones(len(block), block.dtype)])
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


class _Boxes(NamedTuple):
    """Bounding boxes of c groups of points, each along r axes of the group.

    Nearby points of a surface differ mainly along a few directions, so the axes span nearly all of the
    differences between the points of a group.

    - `centers`: the centres of the boxes, with `-|c|²/2` as last coordinate.
    - `axes`: the axes, with minus the coordinate of the centre along the axis as last coordinate.
    - `lengths`: half the lengths of the boxes along their axes.
    - `radii`, `thickness`: the largest distance of a point from the centre, and from the space through the
      centre that the axes span.
    """

    centers: Float[np.ndarray, "c d+1"]
    axes: Float[np.ndarray, "r c d+1"]
    lengths: Float[np.ndarray, "r 1 c"]
    radii: Float[np.ndarray, " c"]
    thickness: Float[np.ndarray, " c"]

    @staticmethod
    def of(groups: Float[np.ndarray, "c s d"], precision: float) -> _Boxes:
        """Compute the boxes of groups of s points."""
        few = -(-_CHUNK // groups.shape[1])
        starts = range(0, len(groups), few)
        with _threads() as run:
            parts = list(run(lambda start: _Boxes._of_few(groups[start : start + few], precision), starts))
        centers, axes, *others = zip(*parts, strict=True)
        return _Boxes(
            np.concatenate(centers),
            np.concatenate(axes, axis=1),
            *(np.concatenate(columns, axis=-1) for columns in others),
        )

    @staticmethod
    def _of_few(groups: Float[np.ndarray, "c s d"], precision: float) -> _Boxes:
        centers = groups.mean(axis=1)
        deviations = groups - centers[:, None]
        d = groups.shape[2]
        start = np.random.default_rng(0).normal(size=(d, min(_AXES, d))).astype(groups.dtype)
        along = deviations @ start
        for _ in range(_ITERATIONS):
            axes = np.linalg.qr(_transposed(deviations) @ along)[0]
            along = deviations @ axes
        low, high = along.min(axis=1, keepdims=True), along.max(axis=1, keepdims=True)
        to_middle = ((low + high) / 2 @ _transposed(axes))[:, 0]
        centers += to_middle
        deviations -= to_middle[:, None]
        radii = np.einsum("csd,csd->cs", deviations, deviations).max(axis=1)
        deviations -= (deviations @ axes) @ _transposed(axes)
        thickness = np.einsum("csd,csd->cs", deviations, deviations).max(axis=1)
        radii, thickness = (np.sqrt(squares) * (1 + precision) for squares in (radii, thickness))
        offsets = np.einsum("cd,cdr->rc", centers, axes)[:, :, None]
        return _Boxes(
            np.column_stack([centers, -0.5 * np.einsum("cd,cd->c", centers, centers)]),
            np.concatenate([axes.transpose(2, 0, 1), -offsets], axis=2),
            (high - low).transpose(2, 1, 0) / 2,
            radii,
            thickness,
        )

    def nearest(
        self, block: Float[np.ndarray, "block e"], groups: Int[np.ndarray, " g"]
    ) -> Int[np.ndarray, " h"]:
        """Return the groups with the nearest centres to some query."""
        return groups[np.unique(np.argmax(block @ self.centers[groups].T, axis=1))]

    def within(
        self, reach: _Reach, block: Float[np.ndarray, "block e"], groups: Int[np.ndarray, " g"]
    ) -> Int[np.ndarray, " h"]:
        """Return the groups that can contain a point within the reach of its query."""
        to_centers = reach.squares - 2 * (block @ self.centers[groups].T) - reach.tolerance
        # The balls around the centres exclude many groups before the boxes are used. The negations keep
        # groups with bounds that are not a number.
        excluded = to_centers > (np.sqrt(reach.reach) + self.radii[groups]) ** 2
        kept = np.flatnonzero(~excluded.all(axis=0))
        near = groups[kept]
        along = block @ _transposed(self.axes[:, near])
        beside = to_centers[:, kept] - np.einsum("rbg,rbg->bg", along, along)
        beside = np.sqrt(np.maximum(beside, 0)) - self.thickness[near]
        np.abs(along, out=along)
        along -= self.lengths[:, :, near]
        np.maximum(along, 0, out=along)
        bounds = np.einsum("rbg,rbg->bg", along, along) + np.maximum(beside, 0) ** 2
        return near[~(bounds > reach.reach + reach.tolerance).all(axis=0)]


class _Reach(NamedTuple):
    """An upper bound on the squared distance from each query to its nearest point.

    `squares` are the squared lengths of queries, and `tolerance` bounds rounding errors of squared distances.
    """

    reach: Float[np.ndarray, "block 1"]
    squares: Float[np.ndarray, "block 1"]
    tolerance: Float[np.ndarray, "block 1"]


class _Clusters(NamedTuple):
    """Groups of s nearby points (clusters), groups of nearby clusters, groups of these, and so on.

    - `points`, `rows`: the points, and their rows in the database.
    - `center`: the mean of the points. The following coordinates are relative to it.
    - `members`, `extended`: the indices of the points of each cluster, and their coordinates with `-|b|²/2`
      as last coordinate.
    - `levels`: the boxes of the groups, from large groups to clusters. Each group but the clusters consists
      of consecutive groups of the next level.
    - `precision`, `largest`: the relative rounding error of a squared distance, and the largest `|b|²`.
    """

    points: Float[np.ndarray, "n d"]
    rows: Int[np.ndarray, " n"]
    center: Float[np.ndarray, " d"]
    members: Int[np.ndarray, "c s"]
    extended: Float[np.ndarray, "c s d+1"]
    levels: list[_Boxes]
    precision: float
    largest: float

    @staticmethod
    def of(
        points: Float[np.ndarray, "n d"],
        rows: Int[np.ndarray, " n"],
        center: Float[np.ndarray, " d"],
        members: Int[np.ndarray, "c s"],
    ) -> _Clusters:
        """Compute the boxes of the clusters that `_halved` gives, and of groups of them."""
        d = points.shape[1]
        extended = np.empty((*members.shape, d + 1), points.dtype)
        for few in range(0, len(members), _CHUNK // _CLUSTER):
            part = extended[few : few + _CHUNK // _CLUSTER]
            part[:, :, :d] = points[members[few : few + len(part)]] - center
            part[:, :, d] = -0.5 * np.einsum("csd,csd->cs", part[:, :, :d], part[:, :, :d])
        precision = 2 * (d + 12) * float(np.finfo(points.dtype).eps)
        levels = [_Boxes.of(extended[:, :, :d], precision)]
        while (groups := len(levels[0].centers) // _PARTS) >= _PARTS**2:
            levels.insert(0, _Boxes.of(extended.reshape(groups, -1, d + 1)[:, :, :d], precision))
        return _Clusters(
            points,
            rows,
            center,
            members,
            extended,
            levels,
            precision,
            -2 * float(extended[:, :, d].min()),
        )

    def search(self, block: Float[np.ndarray, "block d"]) -> Int[np.ndarray, " block"]:
        """Return the database rows that are nearest to nearby queries."""
        needed = self.needed(block)
        best, _ = _two_best(self._scores(self._extended(block), needed))
        return self.rows[_nearer(block, self.points, self.members[needed].reshape(-1)[best])]

    def needed(self, block: Float[np.ndarray, "block d"]) -> Int[np.ndarray, " needed"]:
        """Return all clusters that can contain the nearest point of a query."""
        block = self._extended(block)
        groups = np.arange(len(self.levels[0].centers))
        for number, level in enumerate(self.levels):
            groups = level.within(self._reach(block, self.levels[number:], groups), block, groups)
            if level is not self.levels[-1]:
                groups = _parts(groups)
        return groups

    def _extended(self, block: Float[np.ndarray, "block d"]) -> Float[np.ndarray, "block d+1"]:
        return np.column_stack([block - self.center, np.ones(len(block), block.dtype)])

    def _reach(
        self, block: Float[np.ndarray, "block e"], levels: list[_Boxes], groups: Int[np.ndarray, " g"]
    ) -> _Reach:
        """Return the reach to the points of those clusters in groups of the first level that seem nearest."""
        for level in levels[:-1]:
            groups = _parts(level.nearest(block, groups))
        scores = self._scores(block, levels[-1].nearest(block, groups)).max(axis=1, keepdims=True)
        squares = np.einsum("bd,bd->b", block, block)[:, None] - 1
        tolerance = self.precision * (squares + self.largest)
        return _Reach(np.maximum(squares - 2 * scores, 0) + tolerance, squares, tolerance)

    def _scores(
        self, block: Float[np.ndarray, "block e"], clusters: Int[np.ndarray, " c"]
    ) -> Float[np.ndarray, "block candidates"]:
        """Return the scores of all points of some clusters, as in `_exhaustive`."""
        return block @ self.extended[clusters].reshape(-1, self.extended.shape[2]).T


def _parts(groups: Int[np.ndarray, " g"]) -> Int[np.ndarray, " h"]:
    return (groups[:, None] * _PARTS + np.arange(_PARTS)).reshape(-1)


def _halved(points: Float[np.ndarray, "n d"], size: int) -> Int[np.ndarray, "c s"]:
    """Divide points into equal groups by repeated halving, nearly along the axis of largest variance.

    The groups have 0.7 to 1.4 times `size` points. The last point is repeated to fill the groups. The halves
    of a group stand next to each other. Coordinates along random directions replace the points, because they
    nearly preserve distances.
    """
    levels = max(0, round(np.log2(len(points) / size)))
    total = -(-len(points) // 2**levels) * 2**levels
    if points.shape[1] > _DIRECTIONS:
        shape = points.shape[1], _DIRECTIONS
        points = points @ np.random.default_rng(0).normal(size=shape).astype(points.dtype)
    # The points of a group are stored next to each other, so that each step finds them in the cache.
    members = np.minimum(np.arange(total), len(points) - 1)
    points = points[members]
    points -= points.mean(axis=0)
    for level in range(levels):
        size = total >> level
        rows = -(-_CHUNK // size) * size
        for start in range(0, total, rows):
            few = slice(start, start + rows)
            groups = points[few].reshape(-1, size, points.shape[1])
            along = groups @ _longest_axes(groups[:, :: -(-size // _SPREAD)])[:, :, None]
            order = np.argpartition(along[:, :, 0], size // 2, axis=1)
            order = (order + np.arange(0, groups.shape[0] * size, size)[:, None]).reshape(-1)
            members[few], points[few] = members[few][order], points[few][order]
    return members.reshape(2**levels, -1)


def _longest_axes(groups: Float[np.ndarray, "g s d"]) -> Float[np.ndarray, "g d"]:
    """Return nearly the axis of largest variance of each group of s points."""
    deviations = groups - groups.mean(axis=1, keepdims=True)
    covariances = _transposed(deviations) @ deviations
    axes = covariances.sum(axis=2)
    for _ in range(_ITERATIONS):
        axes = (covariances @ axes[:, :, None])[:, :, 0]
        length = np.linalg.norm(axes, axis=1, keepdims=True)
        axes = axes / np.where(length > 0, length, 1)
    return axes


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
