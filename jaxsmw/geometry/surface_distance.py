"""Distances from points to the surface of a mesh."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float64

from jaxsmw.geometry.mesh import Mesh


def distances_to_surface(points: Float64[np.ndarray, "p 3"], mesh: Mesh) -> Float64[np.ndarray, " p"]:
    """Compute the distance from each point to the nearest point on the triangles of a mesh.

    **Arguments:**

    - `points`: positions (p, 3), in the unit and the coordinate system of the mesh.
    - `mesh`: a `Mesh`. Unreferenced vertices have no influence.

    **Returns:** The Euclidean distances (p,), in the unit of the mesh.
    """
    if not len(points):
        return np.empty(0)
    # The shift keeps the precision of a mesh that is far from the origin.
    middle = mesh.vertices[mesh.referenced_vertices].mean(axis=0)
    squared, _, _ = igl.point_mesh_squared_distance(points - middle, mesh.vertices - middle, mesh.faces)
    return np.sqrt(np.maximum(np.atleast_1d(squared), 0))


def bounding_box_diagonal(mesh: Mesh) -> float:
    """Return the length of the diagonal of the box around all faces of a mesh, in the unit of the mesh."""
    return float(np.linalg.norm(np.ptp(mesh.vertices[mesh.referenced_vertices], axis=0)))
