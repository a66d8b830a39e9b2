"""What is wrong with a pointwise map between two surfaces, as far as can be told without the truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.geometry.mesh import Mesh, connected_pieces

# Neighbours whose matches are farther apart than this, in square roots of the area, and than so many times
# their own distance, are torn apart. Matches of neighbours are 0.03 apart on bodies of 5000 vertices.
_TORN, _STRETCHED = 0.1, 3.0
# Where the smoothed density of signed area is below this, orientation is reversed: 1 is what isometries have.
_REVERSED = -0.2


def stretch(mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int64[np.ndarray, " m"]) -> float:
    """The squared distances of neighbours' matches, over those of the neighbours: a Dirichlet energy.

    In Euclidean distance, on surfaces scaled to area 1. About 1 for the true map between poses of one body;
    maps that tear or scatter have more.
    """
    before, after = _edge_lengths(mesh_x, mesh_y, pointwise_map)
    return float(np.sum(after**2) / np.sum(before**2))


def torn_off(mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int64[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
    """True for vertices of X outside the largest piece that is left where edges that the map tears are cut.

    Limbs that are swapped as a whole come off so.
    """
    before, after = _edge_lengths(mesh_x, mesh_y, pointwise_map)
    kept = mesh_x.edges[after < np.maximum(_TORN, _STRETCHED * before)]
    _, piece = connected_pieces(kept, len(mesh_x.vertices))
    return piece != np.argmax(np.bincount(piece, mesh_x.vertex_areas))


def reversed_orientation(
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int64[np.ndarray, " m"],
    eigenvectors_x: Float[np.ndarray, "m k"],
) -> Bool[np.ndarray, " m"]:
    """True for vertices of X around which the map turns left into right, as where limbs are swapped.

    **Arguments:**

    - `eigenvectors_x`: of X, of area 1: in the span of these the area that triangles cover on Y, negative
      where they come to lie upside down, is smoothed.
    """
    corners = pointwise_map[mesh_x.faces]
    a, b, c = (mesh_y.vertices[corner] for corner in corners.T)
    normals = mesh_y.vertex_normals[corners].sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    covered = 0.5 * np.sum(np.cross(b - a, c - a) * normals, axis=1) / mesh_y.area
    if mesh_x.is_inside_out != mesh_y.is_inside_out:
        covered = -covered
    # One triangle that is torn wide open should not outvote all around it.
    most = 2 * mesh_x.face_areas / mesh_x.area
    covered = np.clip(covered, -most, most)
    at_vertices = np.bincount(mesh_x.faces.ravel(), np.repeat(covered / 3, 3), len(mesh_x.vertices))
    density = eigenvectors_x @ (eigenvectors_x.T @ at_vertices)
    return density < _REVERSED


def _edge_lengths(
    mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int64[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Lengths of the edges of X, and distances of their ends' matches, on surfaces of area 1."""
    placed = (mesh_x.vertices / mesh_x.area**0.5, mesh_y.vertices[pointwise_map] / mesh_y.area**0.5)
    before, after = (np.linalg.norm(np.diff(v[mesh_x.edges], axis=1)[:, 0], axis=1) for v in placed)
    return before, after
