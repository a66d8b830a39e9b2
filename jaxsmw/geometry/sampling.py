"""Evenly spread vertices."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh


def farthest_point_samples(mesh: Mesh, number_of_samples: int) -> Int64[np.ndarray, " s"]:
    """Vertices chosen one by one, each the farthest from those before, in Euclidean distance.

    The first is the one farthest from the centroid, so that renumbering the vertices chooses the same
    points (ties, which go to the lowest index, aside).

    **Arguments:**

    - `mesh`: the surface; unused vertices are never chosen.
    - `number_of_samples`: at least 1, at most the number of used vertices.

    **Raises:** `InputError` if that many cannot be chosen.
    """
    used = np.flatnonzero(mesh.used_vertices)
    if not 1 <= number_of_samples <= len(used):
        raise InputError(
            f"{mesh.name}: {number_of_samples} samples were asked for, but it has {len(used)} used vertices; "
            f"ask for between 1 and {len(used)}."
        )
    positions = mesh.vertices[used]
    chosen = np.empty(number_of_samples, dtype=np.int64)
    chosen[0] = np.argmax(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))
    squared_distance = np.full(len(used), np.inf)
    for index in range(1, number_of_samples):
        offsets = positions - positions[chosen[index - 1]]
        squared_distance = np.minimum(squared_distance, np.einsum("ud,ud->u", offsets, offsets))
        chosen[index] = np.argmax(squared_distance)
    return used[chosen]
