"""Transfer of texture coordinates, so that no face of the target crosses a seam of the source."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from jaxsmw.geometry.arrays import ranges
from jaxsmw.geometry.mesh import components_of_faces, connected_components
from jaxsmw.geometry.surface_distance import nearest_points_of_triangles, nearest_surface_points
from jaxsmw.io.mesh_data import Texture, texture_at_corners, texture_of_corners
from jaxsmw.transfer.registered_mesh import RegisteredMesh

# Texture vertices of one vertex are merged if their coordinates are equal after rounding to a grid. The
# spacing of the grid is this fraction of the extent of all texture coordinates.
_SAME = 1e-7
# At most this number of points walk over the mesh at the same time. A limit is necessary to save memory.
_BLOCK = 20_000


def transfer_texture(
    texture: Texture, registered: RegisteredMesh, faces: Int64[np.ndarray, "f 3"]
) -> Texture:
    """Transfer texture coordinates from X to Y.

    The registered mesh is cut along the seams of the texture. The centroid of each face of Y lies on one side
    of a seam. Each corner of the face receives the texture coordinates of the nearest point on this side.
    Seams inside one chart, such as the seam of a cylinder, are also respected.

    **Arguments:**

    - `texture`: the `Texture` of X, with one row of corners for each face of `registered.mesh_x`.
    - `registered`: the `RegisteredMesh` of X on Y.
    - `faces`: the triangles of Y (f, 3), as vertices of `registered.mesh_y`.

    **Returns:** A `Texture` with corners (f, 3). The texture vertices are in the order of Y's vertices. If
    the nearest face of X has a corner without a texture vertex, the face of Y has no texture vertices.
    """
    mesh, vertices = registered.mesh, registered.mesh_y.vertices
    uv, cut = texture_of_corners(mesh.faces.ravel(), texture_at_corners(texture).reshape(-1, 2))
    cut = cut.reshape(-1, 3)
    textured: Bool[np.ndarray, " g"] = np.all(cut >= 0, axis=1)
    nearest = nearest_surface_points(vertices[faces].mean(axis=1), mesh)[0].faces
    corners, shown = np.full(faces.shape, -1), textured[nearest]
    if not shown.any():
        return Texture(np.empty((0, 2)), corners)
    rows = np.where(textured, np.cumsum(textured) - 1, -1)
    surface = _CutSurface(mesh.vertices[mesh.faces[textured]] - mesh.middle, cut[textured])
    positions, start = (vertices - mesh.middle)[faces[shown]], rows[nearest[shown]]
    near = _near_seams(registered, cut, faces[shown])

    points = registered.points_of_target[faces[shown].ravel()]
    found, weights = rows[points.faces], points.weights.copy()
    start_of_corner = np.repeat(start, 3)
    apart = (found < 0) | (surface.charts[found] != surface.charts[start_of_corner]) | np.repeat(near, 3)
    found[apart], weights[apart], distances = surface.walk(
        positions.reshape(-1, 3)[apart], start_of_corner[apart]
    )
    lengths = np.zeros(len(found))
    lengths[apart] = distances
    best = _best_of_sides(surface, faces[shown], positions, start, near, lengths)
    at_corners = np.einsum("pk,pkx->px", weights[best], uv[surface.faces[found[best]]])
    kept, number = _without_repetitions(faces[shown].ravel(), at_corners, uv)
    corners[shown] = number.reshape(-1, 3)
    return Texture(at_corners[kept], corners)


def _without_repetitions(
    vertices: Int64[np.ndarray, " c"], at_corners: Float64[np.ndarray, "c 2"], uv: Float64[np.ndarray, "u 2"]
) -> tuple[Int64[np.ndarray, " t"], Int64[np.ndarray, " c"]]:
    """Return a corner for each texture vertex, and the texture vertex of each corner."""
    grid = _SAME * max(float(np.ptp(uv, axis=0).max()), np.finfo(float).tiny)
    # The shift keeps regular coordinates, such as multiples of 1/8, away from the borders of grid cells.
    keys = np.floor((at_corners - uv.min(axis=0)) / grid + np.sqrt(0.1)).astype(np.int64)
    keys = np.column_stack([vertices, keys])
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first, number.ravel()


def _best_of_sides(
    surface: _CutSurface,
    faces: Int64[np.ndarray, "f 3"],
    positions: Float64[np.ndarray, "f 3 3"],
    start: Int64[np.ndarray, " f"],
    near: Bool[np.ndarray, " f"],
    lengths: Float64[np.ndarray, " c"],
) -> Int64[np.ndarray, " c"]:
    """For each of the c = 3 f corners, return the shortest corner at its vertex and side of the seams."""
    tail, head = np.arange(3 * len(faces)), np.roll(np.arange(3 * len(faces)).reshape(-1, 3), -1, 1).ravel()
    vertex = faces.ravel()
    turned = vertex[tail] > vertex[head]
    tail, head = np.where(turned, head, tail), np.where(turned, tail, head)
    order = np.lexsort((vertex[head], vertex[tail]))
    tail, head = tail[order], head[order]
    same = (vertex[tail[1:]] == vertex[tail[:-1]]) & (vertex[head[1:]] == vertex[head[:-1]])
    same &= near[tail[1:] // 3] | near[tail[:-1] // 3]
    sides = np.flatnonzero(same)
    # Two faces with a common edge are on the same side if no seam stops a walk between the two faces.
    centroids, before, after = positions.mean(axis=1), tail[sides] // 3, tail[sides + 1] // 3
    _, _, reached = surface.walk(centroids[after], start[before])
    _, nearest = nearest_points_of_triangles(centroids[after], surface.triangles[start[after]])
    size = np.linalg.norm(positions[after] - centroids[after, None], axis=2).max(axis=1)
    sides = sides[reached <= nearest + 1e-6 * size]
    links = [np.column_stack([ends[sides], ends[sides + 1]]) for ends in (tail, head)]
    side = connected_components(np.concatenate(links), len(lengths))[1]
    order = np.lexsort((lengths, side))
    return order[np.searchsorted(side[order], side)]


@dataclass(frozen=True, eq=False)
class _CutSurface:
    """A surface that is cut along seams: the positions of f triangles, and their texture vertices."""

    triangles: Float64[np.ndarray, "f 3 3"]
    faces: Int64[np.ndarray, "f 3"]

    @cached_property
    def charts(self) -> Int32[np.ndarray, " f"]:
        """The connected component of each triangle."""
        return components_of_faces(self.faces, int(self.faces.max()) + 1)[1][self.faces[:, 0]]

    @cached_property
    def neighbors(self) -> csr_array:
        """The adjacency matrix (f, f) of triangles that share a texture vertex, each also with itself."""
        f = len(self.faces)
        entries = np.ones(3 * f), self.faces.ravel(), 3 * np.arange(f + 1)
        corners = csr_array(entries, shape=(f, int(self.faces.max()) + 1))
        return csr_array(corners @ corners.T)

    def walk(
        self, goals: Float64[np.ndarray, "p 3"], start: Int64[np.ndarray, " p"]
    ) -> tuple[Int64[np.ndarray, " p"], Float64[np.ndarray, "p 3"], Float64[np.ndarray, " p"]]:
        """Walk to goals without crossing a seam. Return the last triangles, nearest points and distances."""
        found, weights, distances = start.copy(), np.empty((len(goals), 3)), np.empty(len(goals))
        for first in range(0, len(goals), _BLOCK):
            block = np.arange(first, min(first + _BLOCK, len(goals)))
            weights[block], distances[block] = nearest_points_of_triangles(
                goals[block], self.triangles[found[block]]
            )
            while len(block):
                other, there, lengths = self._nearest_neighbor(goals[block], found[block])
                nearer = lengths < distances[block] * (1 - 1e-9)
                block = block[nearer]
                found[block], weights[block] = other[nearer], there[nearer]
                distances[block] = lengths[nearer]
        return found, weights, distances

    def _nearest_neighbor(
        self, goals: Float64[np.ndarray, "p 3"], triangles: Int64[np.ndarray, " p"]
    ) -> tuple[Int64[np.ndarray, " p"], Float64[np.ndarray, "p 3"], Float64[np.ndarray, " p"]]:
        """Return the nearest neighbour of each goal's triangle, its nearest point and the distance."""
        indptr = self.neighbors.indptr.astype(np.int64)
        first, counts = indptr[triangles], indptr[triangles + 1] - indptr[triangles]
        owner, position = ranges(first, counts)
        other = self.neighbors.indices[position].astype(np.int64)
        weights, lengths = nearest_points_of_triangles(goals[owner], self.triangles[other])
        best = np.lexsort((other, lengths, owner))[np.cumsum(counts) - counts]
        return other[best], weights[best], lengths[best]


def _near_seams(
    registered: RegisteredMesh,
    cut: Int64[np.ndarray, "g 3"],
    faces: Int64[np.ndarray, "f 3"],
) -> Bool[np.ndarray, " f"]:
    """Return a mask of the faces of Y that a seam, or the edge of the textured part of X, may cross."""
    mesh, vertices = registered.mesh, registered.mesh_y.vertices
    pairs = np.unique(np.column_stack([mesh.faces.ravel(), cut.ravel()]), axis=0)
    several = np.bincount(pairs[:, 0], minlength=len(mesh.vertices)) > 1
    if not several.any():
        return np.zeros(len(faces), bool)
    ends = mesh.vertices[mesh.edges[several[mesh.edges].all(axis=1)]]
    longest = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max(initial=0)
    centroids = vertices[faces].mean(axis=1)
    reach = np.linalg.norm(vertices[faces] - centroids[:, None], axis=2).max(axis=1)
    reach = 2 * reach + registered.target_distances[faces].max(axis=1) + longest / 2
    return KDTree(mesh.vertices[several]).query(centroids)[0] <= reach
