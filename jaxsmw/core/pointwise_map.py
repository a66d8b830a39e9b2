"""Functional maps read back as pointwise maps."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

from jaxsmw.core.functional_map import Convention
from jaxsmw.core.spectrum import Spectrum

# Queries scored at once, and database rows per chunk. Measured on two CPU cores (scripts/benchmark_speed.py):
# a block of scores has to stay in the cache, and a maximum over a chunk vectorises where an argmax does not.
_BLOCK = 128
_CHUNK = 64


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
    (m, d), n = queries.shape, database.shape[0]
    chunks, blocks = -(-n // _CHUNK), -(-m // _BLOCK)
    half_norms = 0.5 * jnp.sum(database**2, axis=1)
    if database_mask is not None:
        half_norms = jnp.where(database_mask, half_norms, jnp.inf)
    half_norms = jnp.pad(half_norms, (0, chunks * _CHUNK - n), constant_values=jnp.inf)
    rows = jnp.pad(database, ((0, chunks * _CHUNK - n), (0, 0)))

    def search(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
        # GPUs would otherwise multiply in less than float32, and the ranking with it.
        products = jnp.matmul(rows, block.T, precision=lax.Precision.HIGHEST)
        # Queries last: a maximum over chunks then runs over them side by side.
        scores = (products - half_norms[:, None]).reshape(chunks, _CHUNK, _BLOCK)
        chunk_scores = jnp.max(scores, axis=1)
        first = jnp.argmax(chunk_scores, axis=0)
        is_first = jnp.arange(chunks)[:, None] == first[None, :]
        second = jnp.argmax(jnp.where(is_first, -jnp.inf, chunk_scores), axis=0)
        best_chunks = jnp.stack([first, second])
        chunk_rows = scores[best_chunks, :, jnp.arange(_BLOCK)[None, :]]
        candidates = best_chunks * _CHUNK + jnp.argmax(chunk_rows, axis=2)
        distances = jnp.sum((block[None, :, :] - rows[candidates]) ** 2, axis=2)
        distances = jnp.where(jnp.isinf(half_norms[candidates]), jnp.inf, distances)
        nearest = jnp.min(distances, axis=0, keepdims=True)
        return jnp.min(jnp.where(distances == nearest, candidates, n), axis=0).astype(jnp.int32)

    padded = jnp.pad(queries, ((0, blocks * _BLOCK - m), (0, 0)))
    return lax.map(search, padded.reshape(blocks, _BLOCK, d)).reshape(-1)[:m]


def spectral_embeddings(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    """The two point sets among which a functional map looks for nearest neighbours.

    Pullback: `Phi_X` and `Phi_Y C^T`. Pushforward: `Phi_X C^T` and `Phi_Y`. The choice is not innocent: a
    filtered C shrinks what it maps. Shrunken *queries* (pushforward) all fall near the few database points
    of small norm, which become hubs that attract everything; a shrunken *database* (pullback) keeps its
    order as seen from any query. On real pairs this makes the difference between a good map and none.

    **Returns:** One row per vertex of X (the queries), one per vertex of Y (the database).
    """
    if convention == "pullback":
        return spectrum_x.eigenvectors, spectrum_y.eigenvectors @ functional_map.T
    return spectrum_x.eigenvectors @ functional_map.T, spectrum_y.eigenvectors


def decode(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
) -> Int32[Array, " m"]:
    """The pointwise map T: X -> Y of a functional map, by nearest neighbours (Algorithm 1, step 3).

    For each vertex of X the vertex of Y, masked ones excluded, that is nearest in `spectral_embeddings`.
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    return nearest_neighbor(queries, database, database_mask=spectrum_y.mask)


def matching_objective(
    functional_map: Float[Array, "k_out k_in"],
    pointwise_map: Int32[Array, " m"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
) -> Float[Array, ""]:
    """What `decode` minimises over T: the area-weighted mean squared distance between matched embeddings."""
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    squared_distances = jnp.sum((queries - database[pointwise_map]) ** 2, axis=1)
    return jnp.sum(spectrum_x.vertex_areas * squared_distances) / jnp.sum(spectrum_x.vertex_areas)
