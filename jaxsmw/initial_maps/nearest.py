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
    """
    dtype = y.spectrum.eigenvectors.dtype

    def padded(rows: np.ndarray) -> Array:
        return jax.device_put(pad_rows(rows, padded_size(len(rows))))

    nearest = compiled(nearest_neighbor)(
        *(padded(features.astype(dtype)) for features in (features_x, features_y)),
        database_mask=padded(np.asarray(y.spectrum.mask)),
    )
    return np.asarray(nearest)[: len(features_x)].astype(np.int64)


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
