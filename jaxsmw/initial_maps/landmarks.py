"""Initial maps from landmarks: SHOT beside geodesic distances to the landmarks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.descriptors import SampledPair, SampledShape, paired_shot
from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import geodesic_distances

# The weight of distances to landmarks beside SHOT descriptors, which are unit vectors: half the square root
# of the area weighs as much as a SHOT descriptor. From 1 to 3 the maps of real pairs hardly change.
_WEIGHT = 2.0
# The distance to another connected component, farther than any distance on one component.
_ELSEWHERE = 100.0


def landmark_features(
    sampled: SampledPair, landmarks: np.ndarray
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """SHOT, and geodesic distances to each landmark.

    **Arguments:**

    - `landmarks`: (l, 2), a vertex of X and its match on Y in each row.

    **Raises:** `InputError` for another shape, contradicting landmarks, or vertices outside of the surface.
    """
    if landmarks.shape[1:] != (2,) or not len(landmarks):
        raise InputError(
            f"the initial map is an array of shape {landmarks.shape}; it must be (m,) for a map or (l, 2) "
            "for landmarks."
        )
    for vertex in landmarks[:, 0]:
        if len(matches := np.unique(landmarks[landmarks[:, 0] == vertex, 1])) > 1:
            raise InputError(
                f"landmark {vertex} of {sampled.x.mesh.name} has two matches, {matches[0]} and {matches[1]} "
                f"of {sampled.y.mesh.name}: keep one of them."
            )
    features = []
    zipped = zip(sampled.sides, landmarks.T, sampled.pair.units_of_length, paired_shot(sampled), strict=True)
    for side, vertices, unit, described in zipped:
        mesh = side.mesh
        outside = (vertices < 0) | (vertices >= len(mesh.vertices))
        if outside.any() or not mesh.referenced_vertices[vertices].all():
            wrong = vertices[outside] if outside.any() else vertices[~mesh.referenced_vertices[vertices]]
            raise InputError(
                f"landmark {wrong[0]} is not a vertex of the surface of {mesh.name}, whose vertices are 0 to "
                f"{len(mesh.vertices) - 1}."
            )
        features.append(np.hstack([described, distance_features(side, vertices.astype(np.int64), unit)]))
    return features[0], features[1]


def distance_features(
    side: SampledShape, vertices: Int64[np.ndarray, " l"], unit: float
) -> Float[np.ndarray, "n l"]:
    """Weighted geodesic distances from the compared vertices to some vertices, as features beside SHOT."""
    distances = geodesic_distances(side.mesh, vertices).T / unit
    distances = _WEIGHT * np.where(np.isfinite(distances), distances, _ELSEWHERE)
    return distances if side.samples is None else distances[side.samples.vertices]
