"""Exact nearest-neighbour search.

An exhaustive search compares all queries with all database points. A search in patches skips most patches of
the database.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int32, Shaped

from jaxsmw.core.linear_algebra import orthonormal_columns, product

# BLOCK is the number of queries per block, and _CHUNK is the number of database rows per chunk. Both sizes
# were chosen by measurements with scripts/benchmark_speed.py on two CPU cores. The scores of a block must fit
# into the cache of the CPU. Chunks are useful because XLA vectorises a maximum over a chunk, but not an
# argmax.
BLOCK = 128
_CHUNK = 64
# On accelerators, the scores of a block are at most _SCORES numbers, which is 256 MiB in float32.
_SCORES = 2**26
# `_maximum` divides each chunk into parts of _RUN rows, and the list of all patches into _PARTS parts.
_RUN, _PARTS = 8, 16
# `make_patches` divides points along their first _COORDINATES coordinates. After _POWER_ITERATIONS power
# iterations, `Patches.variations` has nearly converged.
_COORDINATES, _POWER_ITERATIONS = 6, 4
# One step of the search in patches compares a block of queries with _GROUP patches, by one matrix product.
_GROUP = 4
# A region contains at most _REGION patches. Its box has at most _REGION_AXES axes, because regions are larger
# than patches and therefore more curved.
_REGION, _REGION_AXES = 16, 12


def nearest_neighbor(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    *,
    database_mask: Bool[Array, " n"] | None = None,
) -> Int32[Array, " m"]:
    """Return, for each query, the index of the database row that is nearest in Euclidean distance.

    The search compares every query with every row, and it is exact up to rounding errors. Of several
    identical database rows, the first is returned. The queries are processed in blocks, so no array of size m
    x n is stored.

    The score of a database row b for a query q is `q·b - |b|²/2`, which is largest for the nearest row. The
    search compares the distances to the best rows of the two chunks of rows with the best scores, because
    scores have large rounding errors if `|b|` is large compared to the distance.

    **Arguments:**

    - `queries`, `database`: query points (m, d) and database points (n, d), in the same unit.
    - `database_mask`: a Boolean array (n,), False for rows that are never chosen; at least one must be True.
      With None (the default), all rows can be chosen.

    **Returns:** One index from 0 to n - 1 per query, an int32 array (m,).

    **Raises:** `TypeError` if queries and database have different dimensions d. `ValueError` if the database
    is empty, an array does not have two dimensions, or `database_mask` does not have shape (n,).
    """
    n = database.shape[0]
    chunks = -(-n // _CHUNK)
    half_norms = 0.5 * jnp.sum(database**2, axis=1)
    if database_mask is not None:
        half_norms = jnp.where(database_mask, half_norms, jnp.inf)
    half_norms = jnp.pad(half_norms, (0, chunks * _CHUNK - n), constant_values=jnp.inf)
    rows = jnp.pad(database, ((0, chunks * _CHUNK - n), (0, 0)))
    size = queries_per_block(queries.shape[0], n)

    def search(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
        products = product(rows, block.T)
        # The queries are on the last axis, so XLA computes maxima over chunks for several neighbouring
        # queries at once.
        scores = (products - half_norms[:, None]).reshape(chunks, _CHUNK, size)
        chunk_scores = _maximum(scores, 1, _CHUNK // _RUN)
        best_chunks = _two_best(chunk_scores)
        chunk_rows = scores[best_chunks, :, jnp.arange(size)[None, :]]
        candidates = best_chunks * _CHUNK + jnp.argmax(chunk_rows, axis=2)
        masked = jnp.isinf(half_norms[candidates])
        return _nearest(block, rows[candidates], candidates, masked, n).astype(jnp.int32)

    return in_blocks(search, queries, size)


def queries_per_block(m: int, n: int) -> int:
    """Return how many of m queries an exhaustive search compares with n database rows at once.

    On accelerators, small blocks leave most of a GPU idle.
    """
    if jax.default_backend() == "cpu":
        return BLOCK
    return BLOCK * max(1, min(-(-m // BLOCK), _SCORES // (n * BLOCK)))


class SearchProblem(NamedTuple):
    """The arguments of one search by `nearest_vertices`."""

    queries: Float[Array, "m d"]
    database: Float[Array, "n d"]
    database_mask: Bool[Array, " n"]
    patches: tuple[Patches, Patches] | None = None


def nearest_vertices(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    database_mask: Bool[Array, " n"],
    patches: tuple[Patches, Patches] | None = None,
) -> Int32[Array, " m"]:
    """Return the nearest database row of each query, (m,). Patches replace `database_mask`."""
    if patches is None:
        return nearest_neighbor(queries, database, database_mask=database_mask)
    return nearest_neighbor_in_patches(queries, database, *patches)


def nearest_in_both(
    first: SearchProblem, second: SearchProblem
) -> tuple[Int32[Array, " m_1"], Int32[Array, " m_2"]]:
    """Return the results of two searches, (m_1,) and (m_2,), of which the sizes may differ.

    Without patches, both searches are iterations of one loop, so JAX compiles the search only once.
    """
    if first.patches is not None or second.patches is not None:
        return nearest_vertices(*first), nearest_vertices(*second)
    d = max(first.queries.shape[1], second.queries.shape[1])

    def stacked(*arrays: Array) -> Array:
        most = max(map(len, arrays))
        return jnp.stack(
            [jnp.pad(a, ((0, most - len(a)), *((0, d - a.shape[-1]),) * (a.ndim - 1))) for a in arrays]
        )

    arguments = tuple(stacked(*pair) for pair in zip(first[:3], second[:3], strict=True))
    nearest = lax.map(lambda one: nearest_vertices(*one), arguments)
    return nearest[0, : len(first.queries)], nearest[1, : len(second.queries)]


def in_blocks(
    search: Callable[[Float[Array, "block d"]], Shaped[Array, "block ..."]],
    queries: Float[Array, "m d"],
    size: int,
) -> Shaped[Array, "m ..."]:
    """Return the results of `search` for blocks (size, d) of queries, with one row per query (m, ...)."""
    m, d = queries.shape
    blocks = -(-m // size)
    padded = jnp.pad(queries, ((0, blocks * size - m), (0, 0)))
    found = lax.map(search, padded.reshape(blocks, size, d))
    return found.reshape(blocks * size, *found.shape[2:])[:m]


def _maximum(values: Array, axis: int, parts: int) -> Array:
    """Return the maximum along an axis, folded into parts first, which saves 10 % of a search on CPUs."""
    size = values.shape[axis]
    width = -(-size // parts)
    starts = (min(part * width, size - width) for part in range(parts))
    folded = (lax.slice_in_dim(values, start, start + width, axis=axis) for start in starts)
    return jnp.max(functools.reduce(jnp.maximum, folded), axis=axis)


def _two_best(scores: Float[Array, "s block"]) -> Int[Array, "2 block"]:
    """Return the indices of the largest and the second largest score of each query."""
    first = jnp.argmax(scores, axis=0)
    is_first = jnp.arange(scores.shape[0])[:, None] == first[None, :]
    return jnp.stack([first, jnp.argmax(jnp.where(is_first, -jnp.inf, scores), axis=0)])


def _nearest(
    queries: Float[Array, "block d"],
    candidates: Float[Array, "c block d"],
    rows: Int[Array, "c block"],
    masked: Bool[Array, "c block"],
    n: int,
) -> Int[Array, " block"]:
    """Return the row of the nearest candidate of each query: the lowest of equals, or n if all are NaN."""
    distances = jnp.sum((queries[None, :, :] - candidates) ** 2, axis=2)
    distances = jnp.where(masked, jnp.inf, distances)
    nearest = jnp.min(distances, axis=0, keepdims=True)
    return jnp.min(jnp.where(distances == nearest, rows, n), axis=0)


class Patches(eqx.Module):
    """Groups of nearby points. All groups contain the same number of points.

    Patches make searches in the spectral embedding of a surface faster. In this embedding, the points of a
    patch differ mainly along a few directions, because patches are small compared to the wavelengths of the
    eigenfunctions. Up to 16 neighbouring patches form a region.

    **Attributes:**

    - `rows`: (g, c, s), int32, the 0-based indices of the s points of each of the c patches of g regions. The
      indices of a patch are in ascending order, with padding at the end.
    - `mask`: (g, c, s), False for padding and for masked points, True for all other points.
    - `variations`: (g, c, r, s), the coefficients of r linear combinations of the s points of each patch: the
      directions along which the points of the patch differ most.
    - `region_variations`: (g, q, c), the same for the centres of the c patches of each region.
    """

    rows: Int32[Array, "g c s"]
    mask: Bool[Array, "g c s"]
    variations: Float[Array, "g c r s"]
    region_variations: Float[Array, "g q c"]


def make_patches(points: Float[Array, "n d"], mask: Bool[Array, " n"], *, size: int, rank: int) -> Patches:
    """Divide points into patches of equal size by repeated halving. Their number is a power of two.

    The function halves each group of points along the coordinate with the largest variance, among the first 6
    coordinates. The first eigenvectors of a surface vary slowly, so neighbouring vertices have similar
    coordinates.

    **Arguments:**

    - `points`: the points (n, d), such as the rows of the matrix of eigenvectors.
    - `mask`: a Boolean array (n,), False for points that are ignored.
    - `size`: the desired number of points per patch. The actual number is 0.7 to 1.4 times this number.
    - `rank`: the number r of `variations` per patch; 0 for patches of queries, which need no variations.
    """
    n = points.shape[0]
    levels = max(0, round(math.log2(n / size)))
    width = -(-n // 2**levels)
    total = width * 2**levels
    rows = _halved(
        jnp.pad(points[:, :_COORDINATES], ((0, total - n), (0, 0))), jnp.pad(mask, (0, total - n)), levels
    )
    valid = jnp.pad(mask, (0, total - n))[rows]
    # The rows of a patch are sorted, so the first of several equally near candidates has the lowest index.
    # Padding has the highest indices, so it comes last.
    shape = (-1, min(_REGION, 2**levels), width)
    rows, valid = lax.sort([rows.reshape(shape), valid.reshape(shape)], dimension=2, num_keys=1)
    rows = jnp.minimum(rows, n - 1)
    if rank == 0:
        none = jnp.zeros((*rows.shape[:2], 0, width), points.dtype)
        return Patches(rows, valid, none, none[:, :, :, 0].swapaxes(1, 2))

    def variations(
        region: tuple[Int32[Array, "c s"], Bool[Array, "c s"]],
    ) -> tuple[Float[Array, "c r s"], Float[Array, "q c"]]:
        there, counts = points[region[0]], region[1]
        centers, _ = _centered(there, counts)
        of_region = _variations(centers[None], jnp.any(counts, axis=1)[None], _REGION_AXES)[0]
        return _variations(there, counts, rank), of_region

    return Patches(rows, valid, *lax.map(variations, (rows, valid)))


def _halved(
    coordinates: Float[Array, "total c"], mask: Bool[Array, " total"], levels: int
) -> Int32[Array, " total"]:
    """Return the indices of all points, ordered by patch; each of the 2^levels equal parts is one patch."""
    total, dtype = coordinates.shape[0], coordinates.dtype

    def halve(level: Int[Array, ""], rows: Int32[Array, " total"]) -> Int32[Array, " total"]:
        group = jnp.arange(total) // (total >> level)
        here, valid = coordinates[rows], mask[rows]

        def sums(values: Float[Array, "total ..."]) -> Float[Array, "groups ..."]:
            return jax.ops.segment_sum(values, group, 2**levels, indices_are_sorted=True)

        counts = jnp.maximum(sums(valid.astype(dtype)), 1)[:, None]
        means = sums(jnp.where(valid[:, None], here, 0)) / counts
        squares = sums(jnp.where(valid[:, None], (here - means[group]) ** 2, 0))
        along = here[jnp.arange(total), jnp.argmax(squares, axis=1)[group]]
        _, _, ordered = lax.sort([group, jnp.where(valid, along, jnp.inf), rows], num_keys=2)
        return ordered

    # With a `fori_loop`, JAX compiles the sort once instead of once per level.
    return lax.fori_loop(0, levels, halve, jnp.arange(total, dtype=jnp.int32))


def _variations(points: Float[Array, "p s d"], mask: Bool[Array, "p s"], rank: int) -> Float[Array, "p r s"]:
    """Compute the `variations` (p, r, s) of patches by power iteration."""
    _, deviations = _centered(points, mask)
    products = product(deviations, jnp.swapaxes(deviations, 1, 2))

    def iterate(_: Int[Array, ""], variations: Float[Array, "p r s"]) -> Float[Array, "p r s"]:
        return _orthonormal(product(variations, products))

    # Each initial vector of the power iteration contains one coordinate of all points of a patch. The first
    # vector contains coordinate 1, the second vector contains coordinate 2, and so on. Coordinate 0 comes
    # last, because the first eigenvector of a surface is constant and does not distinguish points.
    _, width, d = points.shape
    start = jnp.swapaxes(deviations[..., (1 + jnp.arange(min(rank, d, width))) % d], 1, 2)
    return lax.fori_loop(0, _POWER_ITERATIONS, iterate, start)


def _centered(
    points: Float[Array, "p s d"], mask: Bool[Array, "p s"]
) -> tuple[Float[Array, "p d"], Float[Array, "p s d"]]:
    """Return the mean of each group of points, and the deviations from it, zero for masked points."""
    counts = jnp.maximum(jnp.sum(mask, axis=1), 1).astype(points.dtype)
    center = jnp.sum(jnp.where(mask[..., None], points, 0), axis=1) / counts[:, None]
    return center, jnp.where(mask[..., None], points - center[:, None, :], 0)


def _orthonormal(vectors: Float[Array, "p r d"]) -> Float[Array, "p r d"]:
    """Return, for each group, r orthonormal vectors whose span contains the r given vectors of the group."""
    return jax.vmap(lambda rows: orthonormal_columns(rows.T).T)(vectors)


def nearest_neighbor_in_patches(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    query_patches: Patches,
    database_patches: Patches,
) -> Int32[Array, " m"]:
    """Return the same indices as `nearest_neighbor`, but skip patches that are too far away.

    Each patch of the database has a bounding box with r axes through its centre, and a radius: the largest
    distance from a point of the patch to the space that the axes span. The box gives a lower bound on the
    distances from a query to the points of the patch, by only r + 1 scalar products. Each region has such a
    box as well.

    For each query, a point in the region with the nearest box is the first candidate. A region is too far
    away if its lower bound exceeds the distance to this candidate. In the other regions, a point of the patch
    with the nearest box is the second candidate. A patch is too far away if its lower bound exceeds the
    distance to the nearer candidate. For each patch of queries, the search skips what is too far away from
    every query. The bounds allow for rounding errors, so no nearest point is skipped. If the points are
    spread evenly in all dimensions, nothing is skipped, and `nearest_neighbor` is faster.

    The patches are the results of `make_patches`. They remain valid if a linear map is applied to their
    points. Masked points of the database are never chosen. The results for masked queries are meaningless.
    """
    found, _ = search_in_patches(queries, database, query_patches, database_patches)
    return found


class SearchedNumbers(NamedTuple):
    """The numbers of regions and patches that a search did not skip, for each patch of queries (p,)."""

    regions: Int32[Array, " p"]
    patches: Int32[Array, " p"]


def search_in_patches(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    query_patches: Patches,
    database_patches: Patches,
) -> tuple[Int32[Array, " m"], SearchedNumbers]:
    """Return the result of `nearest_neighbor_in_patches` (m,), and the `SearchedNumbers`."""
    queries, database = lax.stop_gradient((queries, database))  # indices have no derivatives
    regions, patches = _boxes(database, database_patches)
    vertices = database_patches.rows.reshape(-1)

    def search(patch: tuple[Array, Array]) -> tuple[Int32[Array, " block"], SearchedNumbers]:
        block, counts = queries[patch[0]], patch[1]
        squared, bounds = _bounds(regions, block)
        in_region = _nearest_center(patches, block, _position_of_minimum(squared))
        reach = _distance_to_candidate(patches, block, in_region)
        near = _within(bounds, reach, counts)
        nearest, bounds = _bounds_in_regions(patches, block, near)
        reach = jnp.minimum(reach, _distance_to_candidate(patches, block, nearest))
        needed = _within(bounds, reach, counts)
        rows, masked = _two_best_rows(patches, block, needed)
        points = patches.points.reshape(-1, block.shape[1])[rows]
        numbers = (jnp.sum(selected, dtype=jnp.int32) for selected in (near, needed))
        return _nearest(block, points, vertices[rows], masked, database.shape[0]), SearchedNumbers(*numbers)

    blocks = [field.reshape(-1, field.shape[2]) for field in (query_patches.rows, query_patches.mask)]
    found, numbers = lax.map(search, tuple(blocks))
    # The indices of padding and of masked queries are set out of range, so the scatter operation ignores
    # them.
    everywhere = jnp.zeros(queries.shape[0], jnp.int32)
    kept = jnp.where(query_patches.mask, query_patches.rows, queries.shape[0])
    return everywhere.at[kept.reshape(-1)].set(found.reshape(-1), mode="drop"), numbers


class _Boxes(NamedTuple):
    """The bounding boxes of b groups of points: r orthonormal axes through the centre, and a radius.

    `directions` lists the first axes of all groups, then the second axes, and so on, and the centres last.
    With this order, one matrix product gives all bounds. `low` and `high` limit the points along the axes,
    relative to the centre. `center_norms` are infinite for groups without points.
    """

    directions: Float[Array, "r+1 b d"]
    offsets: Float[Array, "r b"]
    center_norms: Float[Array, " b"]
    low: Float[Array, "r b"]
    high: Float[Array, "r b"]
    radius: Float[Array, " b"]


class _PatchBoxes(NamedTuple):
    """The points and the boxes of the c patches of each of g regions.

    `half_norms` are half of the squared norms, infinite for masked points. `local` contains the coordinates
    of the points along the axes of their box.
    """

    points: Float[Array, "g c s d"]
    half_norms: Float[Array, "g c s"]
    local: Float[Array, "g c s r"]
    boxes: _Boxes


def _boxes(database: Float[Array, "n d"], patches: Patches) -> tuple[_Boxes, _PatchBoxes]:
    """Return the boxes of all regions and of all patches of a database."""

    def of_region(one: Patches) -> tuple[_Boxes, _PatchBoxes]:
        points = database[one.rows]
        half_norms = jnp.where(one.mask, 0.5 * jnp.sum(points**2, axis=2), jnp.inf)
        centers, deviations = _centered(points, one.mask)
        boxes, local = _bounding_boxes(centers, product(one.variations, deviations), points, one.mask)
        (center,), around = _centered(centers[None], jnp.any(one.mask, axis=1)[None])
        everything, mask = points.reshape(1, -1, points.shape[2]), one.mask.reshape(1, -1)
        region, _ = _bounding_boxes(
            center[None], product(one.region_variations[None], around), everything, mask
        )
        return region, _PatchBoxes(points, half_norms, local, boxes)

    regions, of_patches = lax.map(of_region, patches)

    def along_boxes(field: Array) -> Array:
        # Each region has one box, so the axis of the regions replaces the axis of the boxes.
        return jnp.swapaxes(field, 0, min(field.ndim - 1, 2))[0]

    return jax.tree.map(along_boxes, regions), of_patches


def _bounding_boxes(
    center: Float[Array, "b d"],
    spanning: Float[Array, "b r d"],
    points: Float[Array, "b s d"],
    mask: Bool[Array, "b s"],
) -> tuple[_Boxes, Float[Array, "b s r"]]:
    """Return the boxes whose axes span the same space as `spanning`, and the points' coordinates in them."""
    axes = _orthonormal(spanning)
    deviations = jnp.where(mask[..., None], points - center[:, None, :], 0)
    local = product(deviations, jnp.swapaxes(axes, 1, 2))
    beside = deviations - product(local, axes)
    radius = jnp.sqrt(jnp.max(jnp.sum(beside**2, axis=2), axis=1)) * (1 + _precision(points))
    boxes = _Boxes(
        jnp.concatenate([jnp.swapaxes(axes, 0, 1), center[None]]),
        jnp.sum(axes * center[:, None, :], axis=2).T,
        jnp.where(jnp.any(mask, axis=1), jnp.sum(center**2, axis=1), jnp.inf),
        jnp.min(local, axis=1).T,
        jnp.max(local, axis=1).T,
        radius,
    )
    return boxes, local


def _precision(points: Float[Array, "... d"]) -> float:
    """Return a limit on the relative rounding error of a bound: d products and about 12 operations."""
    return 2 * (points.shape[-1] + 12) * float(jnp.finfo(points.dtype).eps)


def _bounds(
    boxes: _Boxes, block: Float[Array, "block d"]
) -> tuple[Float[Array, "b block"], Float[Array, "b block"]]:
    """Return the squared distances from queries to boxes, and lower bounds on the distances to the points."""
    rank = len(boxes.offsets)
    products = product(boxes.directions.reshape(-1, block.shape[1]), block.T)
    products = products.reshape(rank + 1, -1, len(block))
    norms = boxes.center_norms[:, None] + jnp.sum(block**2, axis=1)[None, :]
    squared = norms - 2 * products[rank]
    for i in range(rank):  # A loop, because XLA does not vectorise a sum over the axes.
        along = products[i] - boxes.offsets[i, :, None]
        outside = along - jnp.clip(along, boxes.low[i, :, None], boxes.high[i, :, None])
        squared = squared + (outside**2 - along**2)
    precise = jnp.where(jnp.isinf(norms), jnp.inf, squared - _precision(block) * norms)
    return squared, jnp.sqrt(jnp.maximum(precise, 0)) - boxes.radius[:, None]


def _within(
    bounds: Float[Array, "b block"], reach: Float[Array, " block"], counts: Bool[Array, " block"]
) -> Bool[Array, " b"]:
    """Return for each group whether the bound of a query that counts is at most the query's reach."""
    return jnp.any((bounds <= reach[None, :]) & counts[None, :], axis=1)


def _position_of_minimum(values: Float[Array, "b block"]) -> Int[Array, " block"]:
    """Return the position of the smallest value in each column."""
    # A minimum, followed by a search for its position, takes a third of the time of argmin.
    is_smallest = values == -_maximum(-values, 0, _PARTS)[None, :]
    return _maximum(jnp.where(is_smallest, jnp.arange(len(values))[:, None], 0), 0, _PARTS)


def _nearest_center(
    patches: _PatchBoxes, block: Float[Array, "block d"], region: Int[Array, " block"]
) -> Int[Array, " block"]:
    """Return, for each query, the patch of a given region whose centre is nearest."""
    centers, norms = patches.boxes.directions[region, -1], patches.boxes.center_norms[region]
    products = jnp.sum(centers * block[:, None, :], axis=2)
    return region * norms.shape[1] + jnp.argmin(norms - 2 * products, axis=1)


def _distance_to_candidate(
    patches: _PatchBoxes, block: Float[Array, "block d"], patch: Int[Array, " block"]
) -> Float[Array, " block"]:
    """Return the distance from each query to the point with the nearest projection, plus rounding errors."""
    region, there = jnp.divmod(patch, patches.points.shape[1])
    directions = patches.boxes.directions[region, :, there]
    along = jnp.sum(directions[:, :-1] * (block - directions[:, -1])[:, None, :], axis=2)
    beside = jnp.sum((patches.local[region, there] - along[:, None, :]) ** 2, axis=2)
    beside = jnp.where(jnp.isinf(patches.half_norms[region, there]), jnp.inf, beside)
    candidates = patches.points[region, there, jnp.argmin(beside, axis=1)]
    return jnp.sqrt(jnp.sum((block - candidates) ** 2, axis=1)) * (1 + _precision(block))


def _bounds_in_regions(
    patches: _PatchBoxes, block: Float[Array, "block d"], near: Bool[Array, " g"]
) -> tuple[Int32[Array, " block"], Float[Array, "p block"]]:
    """Return the patch with the nearest box, and the `_bounds` of all patches, infinite in far regions."""
    listed = jnp.nonzero(near, size=len(near), fill_value=0)[0].astype(jnp.int32)
    each = patches.points.shape[1]

    def look(step: Int32[Array, ""], nearer: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        least, nearest, bounds = nearer
        region = listed[step]
        squared, in_region = _bounds(jax.tree.map(lambda field: field[region], patches.boxes), block)
        smallest = jnp.min(squared, axis=0)
        position = region * each + _position_of_minimum(squared).astype(jnp.int32)
        return (
            jnp.minimum(least, smallest),
            jnp.where(smallest < least, position, nearest),
            lax.dynamic_update_slice_in_dim(bounds, in_region, region * each, axis=0),
        )

    infinite = jnp.full((len(near) * each, len(block)), jnp.inf, block.dtype)
    start = infinite[0], jnp.zeros(len(block), jnp.int32), infinite
    _, nearest, bounds = lax.fori_loop(0, jnp.sum(near, dtype=jnp.int32), look, start)
    return nearest, bounds


def _two_best_rows(
    patches: _PatchBoxes, block: Float[Array, "block d"], needed: Bool[Array, " p"]
) -> tuple[Int32[Array, "2 block"], Bool[Array, "2 block"]]:
    """Return the rows of the two best candidates in the patches `needed`, and whether they are missing."""
    *_, size, d = patches.points.shape
    all_points, all_half_norms = patches.points.reshape(-1, size, d), patches.half_norms.reshape(-1, size)
    each = jnp.arange(block.shape[0])
    steps = -(-len(needed) // _GROUP)
    listed = jnp.nonzero(needed, size=steps * _GROUP, fill_value=len(needed))[0].astype(jnp.int32)

    def look(step: Int32[Array, ""], best_so_far: tuple[Array, Array]) -> tuple[Array, Array]:
        best_scores, best_rows = best_so_far
        group = lax.dynamic_slice(listed, (step * _GROUP,), (_GROUP,))
        points = all_points.at[group].get(mode="fill", fill_value=0).reshape(_GROUP * size, d)
        half_norms = all_half_norms.at[group].get(mode="fill", fill_value=jnp.inf)
        scores = product(points, block.T).reshape(_GROUP, size, -1) - half_norms[..., None]
        merged = jnp.concatenate([best_scores, jnp.max(scores, axis=1)])
        best = _two_best(merged)
        fresh = jnp.maximum(best - 2, 0)
        rows = group[fresh] * size + jnp.argmax(scores[fresh, :, each[None, :]], axis=2).astype(jnp.int32)
        rows = jnp.where(best < 2, jnp.take_along_axis(best_rows, jnp.minimum(best, 1), axis=0), rows)
        return jnp.take_along_axis(merged, best, axis=0), rows

    nothing = jnp.full((2, block.shape[0]), -jnp.inf, block.dtype)
    start = nothing, jnp.zeros(nothing.shape, jnp.int32)
    groups = -(-jnp.sum(needed, dtype=jnp.int32) // _GROUP)
    scores, rows = lax.fori_loop(0, groups, look, start)
    return rows, jnp.isinf(scores)
