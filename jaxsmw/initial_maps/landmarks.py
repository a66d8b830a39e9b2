"""Features for initial maps from landmarks: SHOT descriptors, and geodesic distances to the landmarks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.descriptors import SampledPair, SampledShape
from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import geodesic_distances
from jaxsmw.pair import Pair

# Distances to landmarks, in units of the square root of the area, are multiplied by this weight. A distance
# of half a unit becomes 1, which is the norm of a SHOT descriptor. On pairs of real bodies, weights from 1 to
# 3 give nearly the same maps.
_WEIGHT = 2.0
# This finite value replaces the infinite distance between two connected components. It is larger than any
# distance within a component.
_ELSEWHERE = 100.0


def landmark_features(
    sampled: SampledPair, landmarks: np.ndarray
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Compute SHOT and the weighted geodesic distances to all landmarks, on both shapes.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `landmarks`: landmarks (l, 2) that `check_landmarks` has checked.

    **Returns:** The features of X (m, d) and of Y (n, d), where m and n are the numbers of compared vertices.
    The first 352 columns are SHOT, and the other l columns are distances.

    **Raises:** `InputError` if a mesh is too coarse for SHOT.
    """
    sides = zip(sampled.sides, landmarks.T, sampled.pair.units_of_length, sampled.shot, strict=True)
    of_x, of_y = (
        np.hstack([described, distance_features(side, vertices.astype(np.int64), unit)])
        for side, vertices, unit, described in sides
    )
    return of_x, of_y


def check_landmarks(pair: Pair, landmarks: np.ndarray) -> None:
    """Check that each row of an array of integers contains a vertex of X and its match on Y.

    **Raises:** `InputError` if `landmarks` does not have the shape (l, 2), or gives two matches to one vertex
    of X. `InputError` is also raised if a number in `landmarks` is not a referenced vertex.
    """
    if landmarks.shape[1:] != (2,) or not len(landmarks):
        raise InputError(
            f"the initial map is an array of shape {landmarks.shape}: give shape (m,) for a map, or (l, 2) "
            "for landmarks."
        )
    for vertex in landmarks[:, 0]:
        if len(matches := np.unique(landmarks[landmarks[:, 0] == vertex, 1])) > 1:
            raise InputError(
                f"landmark {vertex} of {pair.mesh_x.name} has two matches, {matches[0]} and {matches[1]} of "
                f"{pair.mesh_y.name}: remove one of them."
            )
    for mesh, vertices in zip(pair.meshes, landmarks.T, strict=True):
        outside = (vertices < 0) | (vertices >= len(mesh.vertices))
        if outside.any() or not mesh.referenced_vertices[vertices].all():
            wrong = vertices[outside] if outside.any() else vertices[~mesh.referenced_vertices[vertices]]
            raise InputError(
                f"landmark {wrong[0]} is not a vertex in a face of {mesh.name}: choose a vertex in a face, "
                f"from 0 to {len(mesh.vertices) - 1}."
            )


def distance_features(
    side: SampledShape, vertices: Int64[np.ndarray, " l"], unit: float
) -> Float[np.ndarray, "n l"]:
    """Compute weighted geodesic distances to given vertices, as features that are appended to SHOT.

    **Arguments:**

    - `side`: X or Y, as a `SampledShape`.
    - `vertices`: vertices of the mesh (l,), to which distances are computed.
    - `unit`: a length in the unit of the mesh, by which the distances are divided; see
      `Pair.units_of_length`.

    **Returns:** The weighted distances (n, l) from the n compared vertices to the l given vertices.
    """
    distances = geodesic_distances(side.mesh, vertices).T / unit
    distances = _WEIGHT * np.where(np.isfinite(distances), distances, _ELSEWHERE)
    return distances if side.samples is None else distances[side.samples.vertices]
