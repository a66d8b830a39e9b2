"""Exhaustive nearest-neighbour search with JAX; `jaxsmw.core.search` describes the functions."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int, Int32

from jaxsmw.core.arrays import Array, in_blocks
from jaxsmw.core.linear_algebra import product

# BLOCK is the number of queries per block, and _CHUNK is the number of database rows per chunk. Both sizes
# were chosen by measurements with scripts/benchmark_speed.py on two CPU cores. The scores of a block must fit
# into the cache of the CPU. Chunks are useful because XLA vectorises a maximum over a chunk, but not an
# argmax.
BLOCK = 128
_CHUNK = 64
# On accelerators, the scores of a block are at most _SCORES numbers, which is 256 MiB in float32.
_SCORES = 2**26
# `_maximum` divides each chunk into parts of _RUN rows.
_RUN = 8

# The queries (m, d), the database (n, d) and its mask (n,) of one search.
_Problem = tuple[Array, Array, Array]


def nearest_neighbor(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    database_mask: Bool[Array, " n"] | None,
) -> Int32[Array, " m"]:
    queries, database = jnp.asarray(queries), jnp.asarray(database)
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


def nearest_in_both(first: _Problem, second: _Problem) -> tuple[Int32[Array, " m_1"], Int32[Array, " m_2"]]:
    # Both searches are iterations of one loop, so JAX compiles the search only once.
    d = max(first[0].shape[1], second[0].shape[1])

    def stacked(*arrays: Array) -> Array:
        most = max(map(len, arrays))
        return jnp.stack(
            [jnp.pad(a, ((0, most - len(a)), *((0, d - a.shape[-1]),) * (a.ndim - 1))) for a in arrays]
        )

    arguments = tuple(stacked(*pair) for pair in zip(first, second, strict=True))
    nearest = lax.map(lambda one: nearest_neighbor(*one), arguments)
    return nearest[0, : len(first[0])], nearest[1, : len(second[0])]


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
