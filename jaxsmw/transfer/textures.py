"""Transfer of texture coordinates, so that no face of the target crosses a seam of the source."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from jaxsmw.geometry.mesh import connected_components
from jaxsmw.geometry.surface_distance import nearest_points_of_triangles, nearest_surface_points
from jaxsmw.io.formats.data import Texture, texture_at_corners, texture_of_corners
from jaxsmw.transfer.registered_mesh import RegisteredMesh

# Texture vertices of one vertex are the same if their coordinates round to the same multiple of this fraction
# of the extent of all texture coordinates.
_SAME = 1e-7
# The number of points that walk over the mesh at the same time, which limits the memory.
_BLOCK = 20_000


def transfer_texture(
    texture: Texture, registered: RegisteredMesh, faces: Int64[np.ndarray, "f 3"]
) -> Texture:
    """Transfer texture coordinates from X to Y.

    The registered mesh is cut along the seams of the texture. The centroid of each face of Y lies on one side
    of a seam. The corners of the face have the coordinates of their nearest points on the same side. Thus a
    seam that does not separate two charts, such as the seam of a cylinder, is respected as well.

    **Arguments:**

    - `texture`: the `Texture` of X, with one row of corners for each face of `registered.mesh_x`.
    - `registered`: the `RegisteredMesh` of X on Y.
    - `faces`: the triangles of Y (f, 3), as vertices of `registered.mesh_y`.

    **Returns:** A `Texture` with corners (f, 3). The texture vertices are in the order of Y's vertices. A
    face of Y whose nearest face of X has a corner without a texture vertex has no texture vertices.
    """
    mesh, vertices = registered.mesh, registered.mesh_y.vertices
    uv, cut = texture_of_corners(mesh.faces.ravel(), texture_at_corners(texture).reshape(-1, 2))
    cut = cut.reshape(-1, 3)
    centroids = vertices[faces].mean(axis=1)
    nearest = nearest_surface_points(centroids, mesh)[0].faces
    textured: Bool[np.ndarray, " g"] = np.all(cut >= 0, axis=1)
    corners = np.full(faces.shape, -1)
    shown = textured[nearest]
    if not shown.any():
        return Texture(np.empty((0, 2)), corners)
    cut_faces, row = cut[textured], np.cumsum(textured) - 1

    # One pair per corner of a face of Y with texture: the vertex, and the face of X at the centroid.
    pair_vertex, start = faces[shown].ravel(), np.repeat(row[nearest[shown]], 3)
    points = registered.points_of_target[pair_vertex]
    found, weights = np.where(textured[points.faces], row[points.faces], -1), points.weights.copy()
    chart = connected_components(np.concatenate([cut_faces[:, :2], cut_faces[:, 1:]]), len(uv))[1][
        cut_faces[:, 0]
    ]
    apart = (found < 0) | (chart[found] != chart[start])
    apart |= np.repeat(_near_seams(registered, cut, faces[shown], centroids[shown]), 3)
    middle = vertices[pair_vertex].mean(axis=0)
    triangles = mesh.vertices[mesh.faces[textured]] - middle
    found[apart], weights[apart] = _walk(
        vertices[pair_vertex[apart]] - middle, start[apart], triangles, cut_faces
    )
    at_pairs = np.einsum("pk,pkx->px", weights, uv[cut_faces[found]])

    grid = _SAME * max(float(np.ptp(uv, axis=0).max()), np.finfo(float).tiny)
    # The shift keeps regular coordinates, such as multiples of 1/8, away from the limits of rounding.
    keys = np.floor((at_pairs - uv.min(axis=0)) / grid + np.sqrt(0.1)).astype(np.int64)
    _, first, number = np.unique(
        np.column_stack([pair_vertex, keys]), axis=0, return_index=True, return_inverse=True
    )
    corners[shown] = number.reshape(-1, 3)
    return Texture(at_pairs[first], corners)


def _near_seams(
    registered: RegisteredMesh,
    cut: Int64[np.ndarray, "g 3"],
    faces: Int64[np.ndarray, "f 3"],
    centroids: Float64[np.ndarray, "f 3"],
) -> Bool[np.ndarray, " f"]:
    """Return True for faces of Y that a seam, or the edge of the textured part of X, may cross."""
    mesh, vertices = registered.mesh, registered.mesh_y.vertices
    pairs = np.unique(np.column_stack([mesh.faces.ravel(), cut.ravel()]), axis=0)
    several = np.bincount(pairs[:, 0], minlength=len(mesh.vertices)) > 1
    if not several.any():
        return np.zeros(len(faces), bool)
    ends = mesh.vertices[mesh.edges[several[mesh.edges].all(axis=1)]]
    longest = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max(initial=0)
    reach = np.linalg.norm(vertices[faces] - centroids[:, None], axis=2).max(axis=1)
    reach = 2 * reach + registered.target_distances[faces].max(axis=1) + longest / 2
    return KDTree(mesh.vertices[several]).query(centroids)[0] <= reach


def _walk(
    goals: Float64[np.ndarray, "p 3"],
    start: Int64[np.ndarray, " p"],
    triangles: Float64[np.ndarray, "f 3 3"],
    cut_faces: Int64[np.ndarray, "f 3"],
) -> tuple[Int64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
    """Walk from a triangle to the nearest point of each goal, over triangles that share a texture vertex.

    Return the last triangle (p,), which is nearer to the goal than all its neighbours, and the barycentric
    weights of the nearest point (p, 3).
    """
    f = len(cut_faces)
    entries = np.ones(3 * f), cut_faces.ravel(), 3 * np.arange(f + 1)
    corners = csr_array(entries, shape=(f, int(cut_faces.max()) + 1))
    neighbors = csr_array(corners @ corners.T)
    found, weights = start.copy(), np.empty((len(goals), 3))
    for block in _blocks(len(goals)):
        weights[block], distances = nearest_points_of_triangles(goals[block], triangles[found[block]])
        while len(block):
            first, counts = neighbors.indptr[found[block]], np.diff(neighbors.indptr)[found[block]]
            begin = np.cumsum(counts) - counts
            owner = np.repeat(np.arange(len(block)), counts)
            other = neighbors.indices[np.arange(len(owner)) + (first - begin)[owner]].astype(np.int64)
            there, lengths = nearest_points_of_triangles(goals[block[owner]], triangles[other])
            order = np.lexsort((other, lengths, owner))[begin]  # each owner's best candidate
            nearer = lengths[order] < distances * (1 - 1e-9)
            block, order = block[nearer], order[nearer]
            found[block], weights[block], distances = other[order], there[order], lengths[order]
    return found, weights


def _blocks(count: int) -> Iterator[Int64[np.ndarray, " b"]]:
    for start in range(0, count, _BLOCK):
        yield np.arange(start, min(start + _BLOCK, count))
