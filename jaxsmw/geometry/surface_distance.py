"""Nearest points of the surface of a mesh."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float64

from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh


def nearest_surface_points(
    points: Float64[np.ndarray, "p 3"], mesh: Mesh
) -> tuple[SurfacePoints, Float64[np.ndarray, " p"]]:
    """Find the nearest point on the triangles of a mesh for each point in space.

    **Arguments:**

    - `points`: positions (p, 3), in the unit and the coordinate system of the mesh.
    - `mesh`: a `Mesh`. Unreferenced vertices have no influence.

    **Returns:** The nearest points, p `SurfacePoints`, and the Euclidean distances to them (p,), in the
    unit of the mesh.
    """
    if not len(points):
        return SurfacePoints(np.empty(0, np.int64), np.empty((0, 3))), np.empty(0)
    # The shift keeps the precision of a mesh that is far from the origin.
    middle = mesh.vertices[mesh.referenced_vertices].mean(axis=0)
    vertices = mesh.vertices - middle
    squared, faces, nearest = igl.point_mesh_squared_distance(points - middle, vertices, mesh.faces)
    faces = np.atleast_1d(faces).astype(np.int64)
    corners = (np.ascontiguousarray(vertices[mesh.faces[faces, corner]]) for corner in range(3))
    weights = np.atleast_2d(igl.barycentric_coordinates(np.atleast_2d(nearest), *corners))
    # A triangle without area has no barycentric coordinates: its nearest corner represents the point.
    undefined = ~np.isfinite(weights).all(axis=1)
    if undefined.any():
        offsets = vertices[mesh.faces[faces[undefined]]] - np.atleast_2d(nearest)[undefined, None]
        weights[undefined] = np.eye(3)[np.linalg.norm(offsets, axis=2).argmin(axis=1)]
    weights = np.maximum(weights, 0)  # rounding errors can make weights negative
    weights /= weights.sum(axis=1, keepdims=True)
    return SurfacePoints(faces, weights), np.sqrt(np.maximum(np.atleast_1d(squared), 0))


def distances_to_surface(points: Float64[np.ndarray, "p 3"], mesh: Mesh) -> Float64[np.ndarray, " p"]:
    """Compute the distance from each point to the nearest point on the triangles of a mesh.

    **Arguments:**

    - `points`: positions (p, 3), in the unit and the coordinate system of the mesh.
    - `mesh`: a `Mesh`. Unreferenced vertices have no influence.

    **Returns:** The Euclidean distances (p,), in the unit of the mesh.
    """
    return nearest_surface_points(points, mesh)[1]


def bounding_box_diagonal(mesh: Mesh) -> float:
    """Return the length of the diagonal of the box around all faces of a mesh, in the unit of the mesh."""
    return float(np.linalg.norm(np.ptp(mesh.vertices[mesh.referenced_vertices], axis=0)))
