"""Maps by nearest neighbours of features, from the compared vertices to all vertices."""

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
    """The map of all vertices of X (m,) by nearest neighbours among features of the compared vertices."""
    return to_all_vertices(sampled, nearest_among_compared(features_x, features_y, sampled.y))


def nearest_among_compared(
    features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"], y: SampledShape
) -> Int64[np.ndarray, " a"]:
    """For every row of features of X the nearest compared vertex of Y."""
    dtype = y.spectrum.eigenvectors.dtype

    def padded(rows: np.ndarray) -> Array:
        return jax.device_put(pad_rows(rows, padded_size(len(rows))))

    nearest = compiled(nearest_neighbor)(
        *(padded(features.astype(dtype)) for features in (features_x, features_y)),
        database_mask=padded(np.asarray(y.spectrum.mask)),
    )
    return np.asarray(nearest)[: len(features_x)].astype(np.int64)


def to_all_vertices(sampled: SampledPair, found: Int64[np.ndarray, " a"]) -> Int64[np.ndarray, " m"]:
    """A map between compared vertices as a map of all vertices of X to vertices of Y."""
    if sampled.y.samples is not None:
        found = sampled.y.samples.vertices[found]
    return found if sampled.x.samples is None else found[sampled.x.samples.nearest]
