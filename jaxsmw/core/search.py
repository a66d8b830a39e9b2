"""Exact nearest neighbours: by comparison with all points, or by patches, most of which can be skipped."""

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

from jaxsmw.core.products import product

# Queries scored at once, and database rows per chunk. Measured on two CPU cores (scripts/benchmark_speed.py):
# a block of scores has to stay in the cache, and a maximum over a chunk vectorises where an argmax does not.
_BLOCK = 128
_CHUNK = 64
# In how long runs maxima are taken of chunks, and in how many parts of boxes.
_RUN, _PARTS = 8, 16


def nearest_neighbor(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    *,
    database_mask: Bool[Array, " n"] | None = None,
) -> Int32[Array, " m"]:
    """For every query the index of the nearest database row, exactly, in Euclidean distance.

    Ties go to the lowest index. Queries are searched in blocks, so that nothing of size m x n is ever
    stored. Within a block two levels keep the work near that of the matrix product alone: the best score
    of every chunk of database rows, then the best rows of the two best chunks, of which the true
    distances decide. (Scores `q·b - |b|²/2` lose digits where `|b|` is large against the distance: in
    float32 the second candidate is what makes the result agree with an exact search.)

    **Arguments:**

    - `queries`, `database`: points in d dimensions.
    - `database_mask`: rows with False are never chosen. If all are False the result is meaningless.
    """
    n = database.shape[0]
    chunks = -(-n // _CHUNK)
    half_norms = 0.5 * jnp.sum(database**2, axis=1)
    if database_mask is not None:
        half_norms = jnp.where(database_mask, half_norms, jnp.inf)
    half_norms = jnp.pad(half_norms, (0, chunks * _CHUNK - n), constant_values=jnp.inf)
    rows = jnp.pad(database, ((0, chunks * _CHUNK - n), (0, 0)))

    def search(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
        products = product(rows, block.T)
        # Queries last: a maximum over chunks then runs over them side by side.
        scores = (products - half_norms[:, None]).reshape(chunks, _CHUNK, _BLOCK)
        chunk_scores = _maximum(scores, 1, _CHUNK // _RUN)
        best_chunks = _two_best(chunk_scores)
        chunk_rows = scores[best_chunks, :, jnp.arange(_BLOCK)[None, :]]
        candidates = best_chunks * _CHUNK + jnp.argmax(chunk_rows, axis=2)
        masked = jnp.isinf(half_norms[candidates])
        return _nearest(block, rows[candidates], candidates, masked, n).astype(jnp.int32)

    return in_blocks(search, queries, _BLOCK)


def in_blocks(
    search: Callable[[Float[Array, "block d"]], Shaped[Array, "block ..."]],
    queries: Float[Array, "m d"],
    size: int,
) -> Shaped[Array, "m ..."]:
    """What a search finds for all queries, given to it so many at a time; to the last zeros are added."""
    m, d = queries.shape
    blocks = -(-m // size)
    padded = jnp.pad(queries, ((0, blocks * size - m), (0, 0)))
    found = lax.map(search, padded.reshape(blocks, size, d))
    return found.reshape(blocks * size, *found.shape[2:])[:m]


def _maximum(values: Array, axis: int, parts: int) -> Array:
    """The maximum along an axis, first of so many parts of it side by side: on CPUs a tenth faster.

    Parts may overlap.
    """
    size = values.shape[axis]
    width = -(-size // parts)
    starts = (min(part * width, size - width) for part in range(parts))
    pieces = (lax.slice_in_dim(values, start, start + width, axis=axis) for start in starts)
    return jnp.max(functools.reduce(jnp.maximum, pieces), axis=axis)


def _two_best(scores: Float[Array, "s block"]) -> Int[Array, "2 block"]:
    """Which of some scores are the largest and the second largest of each query."""
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
    """The row of each query's nearest candidate by true distance, the lowest of equals; n if all are NaN."""
    distances = jnp.sum((queries[None, :, :] - candidates) ** 2, axis=2)
    distances = jnp.where(masked, jnp.inf, distances)
    nearest = jnp.min(distances, axis=0, keepdims=True)
    return jnp.min(jnp.where(distances == nearest, rows, n), axis=0)


class Patches(eqx.Module):
    """Points that lie close together, in groups of equal size.

    On a surface a patch of neighbouring vertices varies, in spectral embedding, along few directions: the
    eigenfunctions are smooth, and the patch is small against their wavelengths.

    **Attributes:**

    - `rows`: (p, s), the points of each patch, ascending; where masked, padding.
    - `mask`: (p, s), False for padding and for points that were masked.
    - `variations`: (p, r, s), combinations of a patch's points that give the r directions in which it
      varies most.
    """

    rows: Int32[Array, "p s"]
    mask: Bool[Array, "p s"]
    variations: Float[Array, "p r s"]


def make_patches(points: Float[Array, "n d"], mask: Bool[Array, " n"], *, size: int, rank: int) -> Patches:
    """Halve points, again and again, along the one of their first coordinates in which they vary most.

    **Arguments:**

    - `points`: for surfaces their eigenvectors, whose first ones are coordinates along the body.
    - `mask`: False for points that do not count.
    - `size`: wanted number of points in a patch; from 0.7 to 1.4 times as many are taken.
    - `rank`: number of `variations`; queries need none.
    """
    n = points.shape[0]
    levels = max(0, round(math.log2(n / size)))
    width = -(-n // 2**levels)
    total = width * 2**levels
    coordinates = jnp.pad(points[:, :_ORDERED_BY], ((0, total - n), (0, 0)))
    mask = jnp.pad(mask, (0, total - n))

    def halve(level: Int[Array, ""], rows: Int32[Array, " total"]) -> Int32[Array, " total"]:
        group = jnp.arange(total) // (total >> level)
        here, valid = coordinates[rows], mask[rows]

        def sums(values: Float[Array, "total ..."]) -> Float[Array, "groups ..."]:
            return jax.ops.segment_sum(values, group, 2**levels, indices_are_sorted=True)

        counts = jnp.maximum(sums(valid.astype(points.dtype)), 1)[:, None]
        means = sums(jnp.where(valid[:, None], here, 0)) / counts
        squares = sums(jnp.where(valid[:, None], (here - means[group]) ** 2, 0))
        along = here[jnp.arange(total), jnp.argmax(squares, axis=1)[group]]
        _, _, ordered = lax.sort([group, jnp.where(valid, along, jnp.inf), rows], num_keys=2)
        return ordered

    # One sort to compile, whatever the number of levels.
    rows = lax.fori_loop(0, levels, halve, jnp.arange(total, dtype=jnp.int32))
    valid = mask[rows]
    # Ascending, so that the first of equals in a patch is the lowest; padding comes last.
    rows, valid = lax.sort([rows.reshape(-1, width), valid.reshape(-1, width)], dimension=1, num_keys=1)
    rows = jnp.minimum(rows, n - 1)
    if rank == 0:
        return Patches(rows, valid, jnp.zeros((len(rows), 0, width), points.dtype))
    _, deviations = _centered(points[rows], valid)
    products = product(deviations, jnp.swapaxes(deviations, 1, 2))

    def settle(_: Int[Array, ""], variations: Float[Array, "p r s"]) -> Float[Array, "p r s"]:
        return _orthonormal(product(variations, products))

    # The first coordinate of a surface, constant, says nothing of where on a patch a point is: it comes last.
    d = points.shape[1]
    start = jnp.swapaxes(deviations[..., (1 + jnp.arange(min(rank, d, width))) % d], 1, 2)
    return Patches(rows, valid, lax.fori_loop(0, _POWER_ITERATIONS, settle, start))


# Coordinates that patches are compact in, and turns in which their directions settle.
_ORDERED_BY, _POWER_ITERATIONS = 6, 4


def _centered(
    points: Float[Array, "p s d"], mask: Bool[Array, "p s"]
) -> tuple[Float[Array, "p d"], Float[Array, "p s d"]]:
    """The mean of each group, and what its points are away from it, zero where masked."""
    counts = jnp.maximum(jnp.sum(mask, axis=1), 1).astype(points.dtype)
    center = jnp.sum(jnp.where(mask[..., None], points, 0), axis=1) / counts[:, None]
    return center, jnp.where(mask[..., None], points - center[:, None, :], 0)


def _orthonormal(vectors: Float[Array, "p r d"]) -> Float[Array, "p r d"]:
    """For each group vectors of length 1, at right angles, that span the same and perhaps more."""
    return jnp.swapaxes(jnp.linalg.qr(jnp.swapaxes(vectors, 1, 2))[0], 1, 2)


def nearest_neighbor_in_patches(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    query_patches: Patches,
    database_patches: Patches,
) -> Int32[Array, " m"]:
    """The same as `nearest_neighbor`, and as exact, for points that patches describe well.

    A patch of the database lies in a box: r axes through its center, plus a distance that no point of it
    exceeds from the space that they span. From that follows how near to a query any of its points can be,
    at the price of r + 1 products for the whole patch. The most promising patch gives a candidate; only
    patches that could hold something nearer, to any query of a patch, are searched. Bounds allow for
    rounding. Where points are spread evenly in all dimensions, all patches are, at more cost than by
    `nearest_neighbor`.

    **Arguments:**

    - `queries`, `database`: points in d dimensions.
    - `query_patches`, `database_patches`: `make_patches` of them, or of what they are a linear image of.
      Points that are masked there are never chosen, and what is found for such queries means nothing.
    """
    found, _ = search_in_patches(queries, database, query_patches, database_patches)
    return found


def search_in_patches(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    query_patches: Patches,
    database_patches: Patches,
) -> tuple[Int32[Array, " m"], Int32[Array, " p"]]:
    """`nearest_neighbor_in_patches`, and how many patches of the database each one of the queries needed."""
    queries, database = lax.stop_gradient((queries, database))  # whole numbers have no derivatives
    boxes = _boxes(database, database_patches)
    patches, size, d = boxes.points.shape
    rank = boxes.low.shape[1]
    axes = jnp.concatenate([jnp.swapaxes(boxes.axes, 0, 1).reshape(rank * patches, d), boxes.center])
    offsets = jnp.sum(boxes.axes * boxes.center[:, None, :], axis=2).T
    center_norms = jnp.sum(boxes.center**2, axis=1)
    low, high = boxes.low.T[..., None], boxes.high.T[..., None]
    # Sums of d products, and the dozen operations that are made of them, each rounded.
    precision = 2 * (d + 12) * jnp.finfo(queries.dtype).eps
    radius = boxes.radius * (1 + precision)
    steps = -(-patches // _GROUP)

    def search(patch: tuple[Array, Array]) -> tuple[Int32[Array, " block"], Int32[Array, ""]]:
        block, counts = queries[patch[0]], patch[1]
        each = jnp.arange(block.shape[0])
        products = product(axes, block.T)
        norms = center_norms[:, None] + jnp.sum(block**2, axis=1)[None, :]
        squared = norms - 2 * products[rank * patches :]
        along = []
        for i in range(rank):  # a sum over an array's axis would not be vectorised
            along.append(products[i * patches : (i + 1) * patches] - offsets[i, :, None])
            outside = along[i] - jnp.clip(along[i], low[i], high[i])
            squared = squared + (outside**2 - along[i] ** 2)
        squared = jnp.where(boxes.counts[:, None], squared, jnp.inf)
        bounds = jnp.sqrt(jnp.maximum(squared - precision * norms, 0)) - radius[:, None]

        smallest = -_maximum(-squared, 0, _PARTS)  # and then where, which is three times as fast as argmin
        is_smallest = squared == smallest[None, :]
        promising = _maximum(jnp.where(is_smallest, jnp.arange(patches)[:, None], 0), 0, _PARTS)
        there = jnp.stack([axis[promising, each] for axis in along], axis=1)
        beside = jnp.sum((boxes.local[promising] - there[:, None, :]) ** 2, axis=2)
        beside = jnp.where(jnp.isinf(boxes.half_norms[promising]), jnp.inf, beside)
        candidates = boxes.points[promising, jnp.argmin(beside, axis=1)]
        reach = jnp.sqrt(jnp.sum((block - candidates) ** 2, axis=1)) * (1 + precision)
        needed = jnp.any((bounds <= reach[None, :]) & counts[None, :], axis=1)
        listed = jnp.nonzero(needed, size=steps * _GROUP, fill_value=patches)[0].astype(jnp.int32)

        def look(state: _Found) -> _Found:
            group = lax.dynamic_slice(listed, (state.step * _GROUP,), (_GROUP,))
            points = boxes.points.at[group].get(mode="fill", fill_value=0).reshape(_GROUP * size, d)
            half_norms = boxes.half_norms.at[group].get(mode="fill", fill_value=jnp.inf)
            scores = product(points, block.T).reshape(_GROUP, size, -1) - half_norms[..., None]
            merged = jnp.concatenate([state.scores, jnp.max(scores, axis=1)])
            best = _two_best(merged)
            fresh = jnp.maximum(best - 2, 0)
            rows = group[fresh] * size + jnp.argmax(scores[fresh, :, each[None, :]], axis=2).astype(jnp.int32)
            rows = jnp.where(best < 2, jnp.take_along_axis(state.rows, jnp.minimum(best, 1), axis=0), rows)
            return _Found(state.step + 1, jnp.take_along_axis(merged, best, axis=0), rows)

        nothing = jnp.full((2, block.shape[0]), -jnp.inf, queries.dtype)
        start = _Found(jnp.asarray(0, jnp.int32), nothing, jnp.full(nothing.shape, 0, jnp.int32))
        number = jnp.sum(needed, dtype=jnp.int32)
        found = lax.while_loop(lambda state: state.step * _GROUP < number, look, start)
        points = boxes.points.reshape(patches * size, d)[found.rows]
        vertices = database_patches.rows.reshape(-1)[found.rows]
        return _nearest(block, points, vertices, jnp.isinf(found.scores), database.shape[0]), number

    found, numbers = lax.map(search, (query_patches.rows, query_patches.mask))
    # Padding and masked queries are written nowhere.
    everywhere = jnp.zeros(queries.shape[0], jnp.int32)
    kept = jnp.where(query_patches.mask, query_patches.rows, queries.shape[0])
    return everywhere.at[kept.reshape(-1)].set(found.reshape(-1), mode="drop"), numbers


# Patches searched in one step: enough for a product that is worth its while.
_GROUP = 4


class _Boxes(NamedTuple):
    """Where each patch is: within `radius` of a box along orthonormal `axes` through its `center`."""

    points: Float[Array, "p s d"]
    half_norms: Float[Array, "p s"]
    center: Float[Array, "p d"]
    axes: Float[Array, "p r d"]
    local: Float[Array, "p s r"]
    low: Float[Array, "p r"]
    high: Float[Array, "p r"]
    radius: Float[Array, " p"]
    counts: Bool[Array, " p"]


def _boxes(database: Float[Array, "n d"], patches: Patches) -> _Boxes:
    points = database[patches.rows]
    half_norms = jnp.where(patches.mask, 0.5 * jnp.sum(points**2, axis=2), jnp.inf)
    center, deviations = _centered(points, patches.mask)
    axes = _orthonormal(product(patches.variations, deviations))
    local = product(deviations, jnp.swapaxes(axes, 1, 2))
    beside = deviations - product(local, axes)
    radius = jnp.sqrt(jnp.max(jnp.sum(beside**2, axis=2), axis=1))
    low, high = jnp.min(local, axis=1), jnp.max(local, axis=1)
    return _Boxes(points, half_norms, center, axes, local, low, high, radius, jnp.any(patches.mask, axis=1))


class _Found(NamedTuple):
    """The two best candidates of different patches so far, by score and by row among all patches' rows."""

    step: Int32[Array, ""]
    scores: Float[Array, "2 block"]
    rows: Int32[Array, "2 block"]
