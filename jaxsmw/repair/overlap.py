"""Predicts which vertices of a shape have a counterpart on the other shape."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.pair import Pair

# The largest detour of a vertex in the overlap, in `Pair.units_of_length`. (Entry R39 of
# docs/research_log.md)
_LARGEST_DETOUR = 0.04


def detours(
    pair: Pair, pointwise_map: Int64[np.ndarray, " m"], reverse_map: Int64[np.ndarray, " n"]
) -> Float[np.ndarray, " m"]:
    """Return the distance from each vertex of X to its image under the map and then the reverse map.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `reverse_map`: a map Y -> X (n,), 0-based vertices of X.

    **Returns:** The Euclidean distances (m,), in the unit of X in `Pair.units_of_length`.
    """
    vertices = pair.mesh_x.vertices
    offsets = vertices - vertices[reverse_map[pointwise_map]]
    return np.linalg.norm(offsets, axis=1) / pair.units_of_length[0]


def overlap(
    pair: Pair, pointwise_map: Int64[np.ndarray, " m"], reverse_map: Int64[np.ndarray, " n"]
) -> Bool[np.ndarray, " m"]:
    """Predict which vertices of X have a counterpart on Y.

    A vertex without a counterpart still has a match, for example at the boundary of Y. The reverse map does
    not lead from this match back to the vertex. A vertex is therefore in the overlap if its detour is small.
    The prediction is wrong where a part of X without a counterpart is matched to a part of Y without a
    counterpart.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `reverse_map`: a map Y -> X (n,), 0-based vertices of X.

    **Returns:** A mask (m,), True for the vertices in the overlap.
    """
    return detours(pair, pointwise_map, reverse_map) <= _LARGEST_DETOUR
