"""Parts of raw scans that do not belong to the scanned surface: lost vertices and small components."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

# Lost vertices are moved only if their share is at most this number. A mesh with more lost vertices is
# probably damaged. Its lost vertices are kept, and later checks refuse far positions and positions that are
# not finite.
_MOST_LOST = 1e-3
# A vertex is lost if its distance from the median position exceeds `_FAR` times the 90th percentile of these
# distances. It is also lost if its position is not finite. Some scans have coordinates of about 1e30, because
# a program wrote uninitialised memory.
_FAR = 100.0
# A component is small if its share of the mesh's area is below _SMALL, or below SMALL_CLOSED for a closed
# component. If the share of the largest component is below _LARGEST, no component is small. In scans, small
# components are dust and enclosed bubbles. A component with 5 % of the area has fewer than 10 of 200
# eigenfunctions, so its vertices cannot be matched. An open component of this size can be a severed limb.
_SMALL, SMALL_CLOSED, _LARGEST = 0.01, 0.05, 0.5


def usable_positions(position: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return a mask of the positions that are finite and not very far from the median position."""
    usable = np.isfinite(position).all(axis=1)
    if usable.any():
        with np.errstate(over="ignore", invalid="ignore"):
            distances = np.abs(position - np.median(position[usable], axis=0)).max(axis=1)
            usable &= distances <= _FAR * np.quantile(distances[usable], 0.9)
    return usable


def lost_vertices(
    position: Float64[np.ndarray, "n 3"], triangles: Int64[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " n"]:
    """Return a mask of the vertices to move: those without a usable position, unless they are too many."""
    # Nothing needs the position of a vertex without faces, so any number of these may be not finite.
    idle = ~np.isfinite(position).all(axis=1)
    idle[triangles] = False
    lost = ~usable_positions(position) & ~idle
    return lost | idle if lost.sum() <= _MOST_LOST * len(position) else idle


def between_neighbors(
    position: Float64[np.ndarray, "n 3"], triangles: Int64[np.ndarray, "f 3"], lost: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Move each lost vertex to the mean of its usable neighbours, or of all vertices if it has none."""
    placed = position.copy()
    for vertex in np.flatnonzero(lost):
        around = np.unique(triangles[(triangles == vertex).any(axis=1)])
        around = around[~lost[around]]
        placed[vertex] = position[around if len(around) else ~lost].mean(axis=0)
    return placed


def in_small_components(
    component: Int32[np.ndarray, " f"],
    face_areas: Float64[np.ndarray, " f"],
    at_boundary: Bool[np.ndarray, " f"],
) -> tuple[Bool[np.ndarray, " f"], int]:
    """Return a mask of the triangles in small components, and the number of small components.

    `component` numbers the component of each triangle. A component is closed if `at_boundary` is False for
    all of its triangles.
    """
    areas = np.bincount(component, weights=face_areas)
    has_faces = np.bincount(component) > 0
    is_open = np.bincount(component, weights=at_boundary) > 0
    small = (areas < np.where(is_open, _SMALL, SMALL_CLOSED) * areas.sum()) & has_faces
    if areas.max() < _LARGEST * areas.sum():
        small[:] = False
    return small[component], int(small.sum())
