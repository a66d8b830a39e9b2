"""Nearest points of the surface of a mesh."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
from jaxtyping import Float64

from jaxsmw.geometry.arrays import ratio
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints

# If more than this share of the nearest triangles face away from the given normals, the triangles are not
# oriented consistently.
_LARGEST_SHARE_AWAY = 0.2


def nearest_surface_points(
    points: Float64[np.ndarray, "p 3"], mesh: Mesh
) -> tuple[SurfacePoints, Float64[np.ndarray, " p"]]:
    """Find the nearest point on the triangles of a mesh for each point in space.

    `points` (p, 3) are positions in the unit and the coordinate system of the mesh.

    **Returns:** The nearest points as p `SurfacePoints`, and the Euclidean distances to them (p,).
    """
    return SurfaceTree(mesh).nearest(points)


class SurfaceTree:
    """A tree of a mesh's triangles, for several searches for nearest points."""

    def __init__(self, mesh: Mesh) -> None:
        self._faces = mesh.faces
        # Coordinates relative to the middle of the mesh reduce rounding errors if the mesh is far from the
        # origin.
        self._middle = mesh.middle
        self._vertices = mesh.vertices - self._middle
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def nearest(self, points: Float64[np.ndarray, "p 3"]) -> tuple[SurfacePoints, Float64[np.ndarray, " p"]]:
        """Return the result of `nearest_surface_points`."""
        if not len(points):
            return SurfacePoints(np.empty(0, np.int64), np.empty((0, 3))), np.empty(0)
        vertices = self._vertices
        squared, faces, nearest = self._tree.squared_distance(vertices, self._faces, points - self._middle)
        faces = np.atleast_1d(faces).astype(np.int64)
        corners = (np.ascontiguousarray(vertices[self._faces[faces, corner]]) for corner in range(3))
        weights = np.atleast_2d(igl.barycentric_coordinates(np.atleast_2d(nearest), *corners))
        # Barycentric weights are undefined on a triangle without area, so the nearest corner is used.
        undefined = ~np.isfinite(weights).all(axis=1)
        if undefined.any():
            offsets = vertices[self._faces[faces[undefined]]] - np.atleast_2d(nearest)[undefined, None]
            weights[undefined] = np.eye(3)[np.linalg.norm(offsets, axis=2).argmin(axis=1)]
        weights = np.maximum(weights, 0)  # rounding errors can make weights negative
        weights /= weights.sum(axis=1, keepdims=True)
        return SurfacePoints(faces, weights), np.sqrt(np.maximum(np.atleast_1d(squared), 0))


def nearest_facing_points(
    points: Float64[np.ndarray, "p 3"],
    normals: Float64[np.ndarray, "p 3"],
    nearest: SurfacePoints,
    mesh: Mesh,
) -> SurfacePoints:
    """Replace nearest points on triangles that face away from the given normals.

    A triangle faces away if the angle between its normal and the given normal is above 90 degrees. For
    example, if two legs touch, a point on one leg can be nearest to a triangle of the other leg. A second
    search considers only triangles whose normals have roughly the direction of the given normal. The new
    point is used if its triangle does not face away. Nothing is replaced if more than 20 % of the nearest
    triangles face away, because the triangles of the mesh are then not oriented consistently.

    **Arguments:**

    - `points`: positions (p, 3), in the unit and the coordinate system of the mesh.
    - `normals`: the normals at the positions (p, 3), of any length.
    - `nearest`: the result of `nearest_surface_points` for the positions.
    - `mesh`: a `Mesh`.

    **Returns:** p `SurfacePoints`.
    """
    of_faces = mesh.area_vectors
    away = np.einsum("px,px->p", normals, of_faces[nearest.faces]) < 0
    if not 0 < away.sum() <= _LARGEST_SHARE_AWAY * len(away):
        return nearest
    faces, weights = nearest.faces.copy(), nearest.weights.copy()
    axes = np.abs(normals).argmax(axis=1)
    signs = np.sign(np.take_along_axis(normals, axes[:, None], axis=1)[:, 0])
    for axis in range(3):
        for sign in (-1, 1):
            rows = np.flatnonzero(away & (axes == axis) & (signs == sign))
            facing = np.flatnonzero(sign * of_faces[:, axis] > 0)
            if not len(rows) or not len(facing):
                continue
            found, _ = nearest_surface_points(points[rows], replace(mesh, faces=mesh.faces[facing]))
            chosen = facing[found.faces]
            better = np.einsum("px,px->p", normals[rows], of_faces[chosen]) > 0
            faces[rows[better]], weights[rows[better]] = chosen[better], found.weights[better]
    return SurfacePoints(faces, weights)


def distances_to_surface(points: Float64[np.ndarray, "p 3"], mesh: Mesh) -> Float64[np.ndarray, " p"]:
    """Return the distance from each point (p, 3) to the nearest point on the triangles of a mesh, (p,)."""
    return nearest_surface_points(points, mesh)[1]


def bounding_box_diagonal(mesh: Mesh) -> float:
    """Return the length of the diagonal of the box around all faces of a mesh."""
    return float(np.linalg.norm(np.ptp(mesh.vertices[mesh.referenced_indices], axis=0)))


def nearest_points_of_triangles(
    points: Float64[np.ndarray, "p 3"], triangles: Float64[np.ndarray, "p 3 3"]
) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, " p"]]:
    """Find the nearest point on a triangle for each point in space; each point has its own triangle.

    **Returns:** The barycentric weights of the nearest points (p, 3), and the distances to them (p,).
    """
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    away = points - a
    uu, uv, vv = (u * u).sum(axis=1), (u * v).sum(axis=1), (v * v).sum(axis=1)
    along_u, along_v = (away * u).sum(axis=1), (away * v).sum(axis=1)

    # The nearest point a + s u + t v lies on one of the three edges, or inside the triangle.
    on_u, on_v = np.clip(ratio(along_u, uu), 0, 1), np.clip(ratio(along_v, vv), 0, 1)
    across = np.clip(ratio(along_v - along_u + uu - uv, uu - 2 * uv + vv), 0, 1)
    determinant = uu * vv - uv**2
    s = ratio(vv * along_u - uv * along_v, determinant)
    t = ratio(uu * along_v - uv * along_u, determinant)
    inside = (determinant > 0) & (s >= 0) & (t >= 0) & (s + t <= 1)
    zero = np.zeros_like(on_u)
    options = np.stack(
        [
            np.stack([np.where(inside, s, on_u), np.where(inside, t, zero)]),
            np.stack([on_u, zero]),
            np.stack([zero, on_v]),
            np.stack([1 - across, across]),
        ]
    )
    rest = away - options[:, 0, :, None] * u - options[:, 1, :, None] * v
    squared = (rest**2).sum(axis=2)
    best, rows = squared.argmin(axis=0), np.arange(len(points))
    s, t = options[best, 0, rows], options[best, 1, rows]
    return np.stack([np.maximum(1 - s - t, 0), s, t], axis=1), np.sqrt(squared[best, rows])
