"""Consistent maps from a template to all shapes of a collection, computed from the maps of a graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from jaxsmw.collection.consistency import Edge
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_distance import nearest_surface_points
from jaxsmw.geometry.surface_points import SurfacePoints

# Lengths are in units of the square root of the area of each shape. Table R26 is in `docs/research_log.md`.
# Each iteration averages the points on every shape. (Table R26)
_ITERATIONS = 5
# A point at this distance from the mean has half of the weight of a point at the mean. Points of wrong maps
# are much farther away. (Table R26)
_ROBUST_SCALE = 0.02
# If the matches of a triangle's corners are farther apart, a point of the triangle follows the match of the
# nearest corner. Otherwise the matches are averaged.
_DISCONTINUITY_DISTANCE = 0.1


def vertices_as_points(mesh: Mesh) -> SurfacePoints:
    """Return the surface point nearest to each vertex of a mesh."""
    return nearest_surface_points(mesh.vertices, mesh)[0]


def carry(
    points: SurfacePoints,
    mesh: Mesh,
    images: Float64[np.ndarray, "n 3"],
    discontinuity_distance: float,
) -> Float64[np.ndarray, "p 3"]:
    """Carry points to positions near another surface, between the matches `images` of the mesh's vertices."""
    corners = images[mesh.faces[points.faces]]
    main = np.take_along_axis(corners, points.weights.argmax(axis=1)[:, None, None], axis=1)
    torn = np.linalg.norm(corners - main, axis=2).max(axis=1) > discontinuity_distance
    return np.where(torn[:, None], main[:, 0], np.einsum("pk,pkx->px", points.weights, corners))


def robust_mean(
    candidates: Float64[np.ndarray, "d n 3"],
    weights: Float64[np.ndarray, " d"],
    start: Float64[np.ndarray, "n 3"],
    scale: float,
) -> Float64[np.ndarray, "n 3"]:
    """Average d candidates for each point, with Cauchy's weights: half the weight at `scale`."""
    mean = start
    for _ in range(5):
        squared = np.sum((candidates - mean) ** 2, axis=2)
        share = weights[:, None] / (1 + squared / scale**2)
        total = np.maximum(share.sum(axis=0), np.finfo(float).tiny)
        mean = np.sum(share[:, :, None] * candidates, axis=0) / total[:, None]
    return mean


class Network:
    """The shapes of a collection and the maps along the edges of its graph, which are not checked.

    The function `synchronize` computes consistent maps from a network. The number of a shape is its 0-based
    position in `meshes`.

    **Arguments:**

    - `meshes`: the meshes of the N shapes, each a `Mesh` in any unit of length.
    - `maps`: the maps of each edge in both directions, by keys (i, j). Each is one `SurfacePoints` on mesh j,
      with one entry for every vertex of mesh i.
    - `errors`: the estimated error of the maps i -> j and j -> i of each edge, by keys (i, j) with i < j. An
      error is a mean distance in units of the square root of the area of the shape to which a map leads.

    **Attributes:** `meshes` and `errors`, and `units`: the square root of the area of each mesh.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        maps: Mapping[tuple[int, int], SurfacePoints],
        errors: Mapping[Edge, float],
    ):
        self.meshes, self.errors = meshes, errors
        self.units = [mesh.area**0.5 for mesh in meshes]
        self._images = {(i, j): points.positions(meshes[j]) for (i, j), points in maps.items()}
        self._neighbors = [sorted(i for i, k in maps if k == j) for j in range(len(meshes))]

    def error(self, i: int, j: int) -> float:
        """Return the estimated error of the maps between shapes i and j."""
        return self.errors[min(i, j), max(i, j)]

    def lengths(self) -> csr_array:
        """Return the errors of all edges as a symmetric sparse matrix (N, N)."""
        rows, columns = zip(*self._images, strict=True) if self._images else ((), ())
        # In the sparse matrix, an entry of zero would mean a missing edge.
        values = [max(self.error(i, j), 1e-6) for i, j in self._images]
        return csr_array((values, (rows, columns)), shape=(len(self.meshes),) * 2)

    def medoid(self) -> int:
        """Return the medoid: the shape whose best paths to all shapes have the smallest sum of errors."""
        return int(np.argmin(dijkstra(self.lengths(), directed=False).sum(axis=1)))

    def along_best_paths(self, template: int) -> list[SurfacePoints]:
        """Map the vertices of the template to all shapes along the paths with the smallest sums of errors.

        **Returns:** For each shape, one `SurfacePoints` with n entries, one for each vertex of the template.

        **Raises:** `ValueError` if a shape has no path to the template.
        """
        lengths, before = dijkstra(self.lengths(), directed=False, indices=template, return_predecessors=True)
        if not np.isfinite(lengths).all():
            raise ValueError("the graph is not connected: add edges between its parts")
        points = {template: vertices_as_points(self.meshes[template])}
        for shape in np.argsort(lengths, kind="stable").tolist():
            if shape != template:
                source = int(before[shape])
                points[shape] = self._project(self.carried(points[source], source, shape), shape)
        return [points[shape] for shape in range(len(self.meshes))]

    def carried(self, points: SurfacePoints, source: int, target: int) -> Float64[np.ndarray, "p 3"]:
        """Carry points along an edge to positions near shape `target` (p, 3), in the unit of this shape."""
        limit = _DISCONTINUITY_DISTANCE * self.units[target]
        return carry(points, self.meshes[source], self._images[source, target], limit)

    def averaged(self, points: Sequence[SurfacePoints], template: int) -> list[SurfacePoints]:
        """Move each point to the robust mean of the points that the edges carry from neighbouring shapes.

        The points on the template do not move.
        """

        def moved(shape: int) -> SurfacePoints:
            if shape == template:
                return points[shape]
            unit, neighbors = self.units[shape], self._neighbors[shape]
            weights = np.array([1 / max(self.error(i, shape), 1e-3) ** 2 for i in neighbors])
            candidates = np.stack([self.carried(points[i], i, shape) for i in neighbors])
            start = points[shape].positions(self.meshes[shape])
            mean = robust_mean(candidates, weights / weights.max(), start, _ROBUST_SCALE * unit)
            return self._project(mean, shape)

        return [moved(shape) for shape in range(len(self.meshes))]

    def residual(self, points: Sequence[SurfacePoints], i: int, j: int) -> float:
        """Return the mean distance of the map i -> j from the map through the template.

        The distance is in units of the square root of the area of j. Distances above 0.5 count as 0.5.
        """
        offsets = self.carried(points[i], i, j) - points[j].positions(self.meshes[j])
        return float(np.minimum(np.linalg.norm(offsets, axis=1) / self.units[j], 0.5).mean())

    def _project(self, positions: Float64[np.ndarray, "p 3"], shape: int) -> SurfacePoints:
        return nearest_surface_points(positions, self.meshes[shape])[0]


def synchronize(network: Network, template: int) -> list[SurfacePoints]:
    """Compute the maps from the template to all shapes, such that they agree with the maps of all edges.

    The first maps follow the best paths from the template (`Network.along_best_paths`). Each iteration moves
    the points on every shape to averages over its neighbours (`Network.averaged`). This is the
    synchronisation of pointwise maps (Huang, Guibas 2013) by iterated averages on the surfaces.

    **Arguments:**

    - `network`: the `Network` of shapes and maps.
    - `template`: the 0-based number of the template in `network.meshes`.

    **Returns:** A list with one `SurfacePoints` on each shape, with n entries, one for each vertex of the
    template.

    **Raises:** `ValueError` if a shape has no path to the template.
    """
    points = network.along_best_paths(template)
    for _ in range(_ITERATIONS):
        points = network.averaged(points, template)
    return points


def vertex_map_between(
    points_x: SurfacePoints, points_y: SurfacePoints, template: Mesh, mesh_x: Mesh, mesh_y: Mesh
) -> Int64[np.ndarray, " m"]:
    """Return the map X -> Y through the template, whose vertices match `points_x` and `points_y`."""
    registered = replace(template, vertices=points_x.positions(mesh_x))
    on_template, _ = nearest_surface_points(mesh_x.vertices, registered)
    images = on_template.positions(replace(template, vertices=points_y.positions(mesh_y)))
    return nearest_surface_points(images, mesh_y)[0].nearest_corners(mesh_y)
