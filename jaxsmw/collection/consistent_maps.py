"""Consistent maps through a template, and the edges whose maps contradict the consistent maps."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.collection.consistency import Edge, estimate_edge_errors
from jaxsmw.collection.edges import EdgeMap
from jaxsmw.collection.result import MatchedEdge
from jaxsmw.collection.settings import CollectionSettings
from jaxsmw.collection.synchronization import Network, synchronize, vertex_map_between
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.matching.shapes import PreparedShape


@dataclass(frozen=True, eq=False)
class ConsistentMaps:
    """Maps from a template to all shapes, chosen to agree best with the maps of the edges.

    **Attributes:**

    - `shapes`: the N shapes.
    - `maps`: the map of each edge. An edge whose match failed has no map.
    - `settings`: the settings of the collection.
    - `network`: the shapes, the maps and their estimated errors.
    - `template`: the index of the template in `shapes`.
    - `points`: for each shape, one `SurfacePoints` with an entry for each vertex of the template.
    - `cycle_errors`: the error of each triangle of edges (c,), in units of the square root of the area.
    """

    shapes: Sequence[PreparedShape]
    maps: Mapping[Edge, EdgeMap]
    settings: CollectionSettings
    network: Network
    template: int
    points: Sequence[SurfacePoints]
    cycle_errors: Float64[np.ndarray, " c"]

    @classmethod
    def of(
        cls,
        shapes: Sequence[PreparedShape],
        maps: Mapping[Edge, EdgeMap],
        settings: CollectionSettings,
    ) -> ConsistentMaps:
        """Estimate the errors of all edges from cycles, and synchronise the maps through `Network.medoid`.

        **Arguments:**

        - `shapes`: the N shapes.
        - `maps`: the map of each edge. The edges must connect all shapes.
        - `settings`: the settings of the collection.
        """
        meshes, units = [shape.mesh for shape in shapes], [shape.mesh.area**0.5 for shape in shapes]
        points = _both_directions(maps)
        distorted = settings.distortion_weight * _squared_log_distortions(maps)
        prior = np.array([found.expected_error for found in maps.values()]) + distorted
        estimated, cycle_errors, _ = estimate_edge_errors(
            list(maps),
            {(i, j): found.nearest_corners(meshes[j]) for (i, j), found in points.items()},
            [mesh.vertices / unit for mesh, unit in zip(meshes, units, strict=True)],
            [_cycle_samples(shape, settings.cycle_samples) for shape in shapes],
            prior,
        )
        # A small cycle error can arise by chance, so the estimated error is raised to at least half of the
        # prior. Wrong maps can be consistent with each other, but their distortions are large. A penalty for
        # distortion is therefore added.
        errors = np.maximum(estimated, prior / 2) + distorted
        network = Network(
            meshes, points, dict(zip(maps, errors.tolist(), strict=True)), settings.synchronization
        )
        medoid = network.medoid()
        return cls(shapes, maps, settings, network, medoid, synchronize(network, medoid), cycle_errors)

    def through(self, template: int) -> ConsistentMaps:
        """Return the consistent maps through another template, the index of a shape in `shapes`."""
        if template == self.template:
            return self
        return replace(self, template=template, points=synchronize(self.network, template))

    def residual(self, edge: Edge, network: Network | None = None) -> float:
        """Return the mean distance between the maps of an edge and the maps through the template.

        The residual is the larger of the residuals of both directions; see `Network.residual`.

        **Arguments:**

        - `edge`: the edge.
        - `network`: a network with other maps of the edges. The default is the network of `self`.
        """
        (i, j), network = edge, network or self.network
        return max(network.residual(self.points, i, j), network.residual(self.points, j, i))

    def contradicted(self, edges: Iterable[Edge]) -> list[Edge]:
        """Return the edges whose match failed or whose maps contradict the consistent maps."""
        limit = self.settings.contradicted_from
        return [edge for edge in edges if edge not in self.maps or self.residual(edge) >= limit]

    def vertex_map(self, i: int, j: int) -> Int64[np.ndarray, " m"]:
        """Return the map of shape i (m vertices) to shape j through the template, as vertices of shape j."""
        meshes = self.network.meshes
        return vertex_map_between(self.points[i], self.points[j], meshes[self.template], meshes[i], meshes[j])

    def improvements(self, again: Mapping[Edge, EdgeMap]) -> dict[Edge, EdgeMap]:
        """Return each new map that agrees better with the consistent maps than the edge's old map.

        A new map is left out if its distortion exceeds the old distortion by more than the factor
        `distortion_tolerance`. Such a map probably started from a wrong consistent map.

        **Arguments:**

        - `again`: new maps of some edges.
        """
        better = {}
        errors = {edge: found.expected_error for edge, found in again.items()}
        new = Network(self.network.meshes, _both_directions(again), errors, self.network.settings)
        for edge, found in again.items():
            old, before = np.inf, np.inf
            if edge in self.maps:
                old, before = self.maps[edge].distortion, self.residual(edge)
            not_more_distorted = found.distortion <= old * self.settings.distortion_tolerance
            if self.residual(edge, new) < before and not_more_distorted:
                better[edge] = found
        return better

    def describe_edge(self, edge: Edge, replaced: Container[Edge]) -> MatchedEdge:
        """Return the scores of an edge, and how its map was used.

        **Arguments:**

        - `edge`: the edge.
        - `replaced`: the edges whose first maps were replaced.
        """
        if edge not in self.maps:
            return MatchedEdge(*edge, np.inf, np.inf, np.inf, np.inf, "contradicted", True)
        found, residual = self.maps[edge], self.residual(edge)
        wrong = residual >= self.settings.contradicted_from
        decision = "contradicted" if wrong else "replaced" if edge in replaced else "kept"
        error = self.network.error(*edge)
        doubtful = wrong or error >= self.settings.outlier_from
        return MatchedEdge(*edge, found.expected_error, found.distortion, error, residual, decision, doubtful)


def _both_directions(maps: Mapping[Edge, EdgeMap]) -> dict[tuple[int, int], SurfacePoints]:
    """Return the maps of all edges (i, j) with the keys (i, j) and (j, i)."""
    forward = {edge: found.forward for edge, found in maps.items()}
    return forward | {(j, i): found.backward for (i, j), found in maps.items()}


def _squared_log_distortions(maps: Mapping[Edge, EdgeMap]) -> Float64[np.ndarray, " e"]:
    """Return the squared logarithm of the distortion of each edge's map; zero for isometries."""
    return np.log([max(found.distortion, 1.0) for found in maps.values()]) ** 2


def _cycle_samples(shape: PreparedShape, number: int) -> Int64[np.ndarray, " s"]:
    """Return about `number` vertices of a shape, from which cycle errors are computed."""
    if shape.samples is None:
        used = np.flatnonzero(shape.mesh.referenced_vertices)
        return used[:: max(1, len(used) // number)]
    return np.asarray(shape.samples, np.int64)[:number]
