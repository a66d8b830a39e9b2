"""Vertices of the target that a deformed source should reach but does not, and slits that it bridges."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csr_array, diags_array
from scipy.spatial import KDTree

from jaxsmw.geometry.arrays import first_equal_rows, sides_of, unit_vectors
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_distance import nearest_surface_points

# A vertex of the target is uncovered if its distance from the source is between `_UNCOVERED` and `_MISSING`.
# Distances are in units of the square root of the target's area. Vertices at larger distances would stretch
# single triangles into spikes. (Entry R37 of docs/research_log.md)
_UNCOVERED, _MISSING = 0.005, 0.03
# A vertex on the lip of a slit is compared with this number of nearest boundary vertices.
_NEIGHBORS = 32


class Attraction(NamedTuple):
    """Weighted vertices of the target, each with the point of the source that the vertex attracts."""

    interpolation: csr_array  # (c, m): the points are this matrix times the vertex positions of the source
    weights: Float64[np.ndarray, " c"]
    positions: Float64[np.ndarray, "c 3"]

    def matrix(self) -> csr_array:
        return csr_array(self.interpolation.T @ (diags_array(self.weights) @ self.interpolation))

    def right_side(self) -> Float64[np.ndarray, "m 3"]:
        return self.interpolation.T @ (self.weights[:, None] * self.positions)


class UncoveredVertices:
    """The vertices of Y that a deformation of X does not reach, such as the tips of ears and fingers.

    A vertex does not count as uncovered if the nearest triangle of X touches a boundary of X. Otherwise holes
    of X would close, and boundaries of X would stretch to parts of the body that X lacks.
    """

    def __init__(self, mesh_x: Mesh, mesh_y: Mesh) -> None:
        self._mesh = mesh_x
        self._root = np.sqrt(mesh_y.area)
        used = mesh_y.referenced_indices
        self._positions, self._areas = mesh_y.vertices[used], mesh_y.vertex_areas[used]
        self._first = True

    def attraction(
        self, positions: Float64[np.ndarray, "m 3"], strengths: Float64[np.ndarray, " m"]
    ) -> Attraction | None:
        """Return the attraction of the uncovered vertices of Y, weighted by area and `strengths`, or None."""
        deformed = replace(self._mesh, vertices=positions)
        points, distances = nearest_surface_points(self._positions, deformed)
        if self._first:  # later calls leave out the vertices that are clearly covered now
            near = np.flatnonzero(distances > 0.5 * _UNCOVERED * self._root)
            self._positions, self._areas = self._positions[near], self._areas[near]
            points, distances, self._first = points[near], distances[near], False
        corners = self._mesh.faces[points.faces]
        rows = (distances > _UNCOVERED * self._root) & (distances < _MISSING * self._root)
        rows &= ~self._mesh.boundary_vertices[corners].any(axis=1)
        if not rows.any():
            return None
        corners, weights = corners[rows], points.weights[rows]
        starts = np.arange(0, weights.size + 1, 3)
        shape = len(weights), len(positions)
        interpolation = csr_array((weights.ravel(), corners.ravel(), starts), shape=shape)
        return Attraction(
            interpolation, self._areas[rows] * (interpolation @ strengths), self._positions[rows]
        )


def at_slits(mesh: Mesh, width: float) -> Bool[np.ndarray, " n"]:
    """Return a mask of the vertices on the lips of slits and pinholes (n,).

    Two boundary vertices lie on opposite lips if their distance is at most `width`, each lies in front of the
    other's boundary, and their normals agree. Seams of duplicated vertices are not slits.
    """
    at_lips = np.zeros(len(mesh.vertices), bool)
    rows = np.unique(mesh.boundary_edges)
    # Vertices at one position belong to a seam, where the surface does not end.
    lowest = first_equal_rows(mesh.vertices[rows])
    rows = rows[np.bincount(lowest, minlength=len(rows))[lowest] == 1]
    if not len(rows):
        return at_lips
    # A limited number of neighbours bounds the memory.
    positions = mesh.vertices[rows]
    distances, others = KDTree(positions).query(
        positions, k=np.arange(1, _NEIGHBORS), distance_upper_bound=width
    )
    near = np.isfinite(distances)
    first, second = np.repeat(rows, near.sum(axis=1)), rows[others[near]]
    between = mesh.vertices[second] - mesh.vertices[first]
    outward, normals = _outward_directions(mesh), mesh.vertex_normals
    facing = (outward[first] * outward[second]).sum(axis=1) < 0
    facing &= (outward[first] * between).sum(axis=1) >= 0
    facing &= (outward[second] * between).sum(axis=1) <= 0
    facing &= (normals[first] * normals[second]).sum(axis=1) > 0
    at_lips[np.concatenate([first[facing], second[facing]])] = True
    return at_lips


def _outward_directions(mesh: Mesh) -> Float64[np.ndarray, "n 3"]:
    """Return at each vertex the sum of the outward directions of its boundary edges.

    The outward direction of an edge is perpendicular to the edge, in the plane of its face.
    """
    n = len(mesh.vertices)
    tails, heads, thirds = sides_of(mesh.faces)
    numbers = np.minimum(tails, heads) * n + np.maximum(tails, heads)
    at_boundary = np.isin(numbers, mesh.boundary_edges @ [n, 1])
    tails, heads, thirds = tails[at_boundary], heads[at_boundary], thirds[at_boundary]
    along, inward = (mesh.vertices[ends] - mesh.vertices[tails] for ends in (heads, thirds))
    along = unit_vectors(along)
    outward = unit_vectors(along * (along * inward).sum(axis=1, keepdims=True) - inward)
    sums = np.zeros((n, 3))
    np.add.at(sums, tails, outward)
    np.add.at(sums, heads, outward)
    return sums
