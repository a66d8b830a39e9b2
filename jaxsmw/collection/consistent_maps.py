"""Consistent maps through a template, and the edges whose maps contradict the consistent maps."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.collection.consistency import Edge, estimate_edge_errors
from jaxsmw.collection.edges import EdgeMap
from jaxsmw.collection.result import MatchedEdge
from jaxsmw.collection.synchronization import Network, synchronize, vertex_map_between
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.shape import PreparedShape

# Lengths are in units of the square root of the area of each shape. Table R26 is in `docs/research_log.md`.
# The number of samples of each shape at which cycles are compared.
_CYCLE_SAMPLES = 200
# An edge contradicts the collection if the mean distance between its maps and the maps through the template
# is at least this value. The edge is then matched again, from the consistent map. (Table R26)
_CONTRADICTED_FROM = 0.05
# The error of an edge grows by this number times the squared logarithm of the distortion of its map. (Table
# R26)
_DISTORTION_WEIGHT = 2.0
# A new map replaces the old map of an edge only if its distortion is at most this multiple of the old one.
_DISTORTION_TOLERANCE = 1.02
# A shape is an outlier if the errors of all its edges are at least this value. In collections of one kind of
# body, every shape had an edge with an error of at most 0.04.
OUTLIER_FROM = 0.1


@dataclass(frozen=True, eq=False)
class ConsistentMaps:
    """Maps from a template to all shapes, chosen to agree best with the maps of the edges.

    **Attributes:**

    - `maps`: the map of each edge. An edge whose match failed has no map.
    - `network`: the shapes, the maps and their estimated errors.
    - `template`: the index of the template in `shapes`.
    - `points`: for each shape, one `SurfacePoints` with an entry for each vertex of the template.
    - `cycle_errors`: the error of each triangle of edges (c,), in units of the square root of the area.
    """

    maps: Mapping[Edge, EdgeMap]
    network: Network
    template: int
    points: Sequence[SurfacePoints]
    cycle_errors: Float64[np.ndarray, " c"]

    @classmethod
    def of(cls, shapes: Sequence[PreparedShape], maps: Mapping[Edge, EdgeMap]) -> ConsistentMaps:
        """Synchronise the maps of edges that connect all shapes, through `Network.medoid`."""
        meshes, units = [shape.mesh for shape in shapes], [shape.mesh.area**0.5 for shape in shapes]
        points = _both_directions(maps)
        # The distortion of an isometry is 1.
        distortions = [max(edge.distortion, 1.0) for edge in maps.values()]
        distorted = _DISTORTION_WEIGHT * np.log(distortions) ** 2
        prior = np.array([edge.expected_error for edge in maps.values()]) + distorted
        estimated, cycle_errors, _ = estimate_edge_errors(
            list(maps),
            {(i, j): images.nearest_corners(meshes[j]) for (i, j), images in points.items()},
            [mesh.vertices / unit for mesh, unit in zip(meshes, units, strict=True)],
            [_cycle_samples(shape) for shape in shapes],
            prior,
        )
        # A small cycle error can arise by chance, so the estimated error is raised to at least half of the
        # prior. Wrong maps can be consistent with each other, but their distortions are large. A penalty for
        # distortion is therefore added.
        errors = np.maximum(estimated, prior / 2) + distorted
        network = Network(meshes, points, dict(zip(maps, errors.tolist(), strict=True)))
        medoid = network.medoid()
        return cls(maps, network, medoid, synchronize(network, medoid), cycle_errors)

    def through(self, template: int) -> ConsistentMaps:
        """Return the consistent maps through another template."""
        if template == self.template:
            return self
        return replace(self, template=template, points=synchronize(self.network, template))

    def residual(self, edge: Edge, network: Network | None = None) -> float:
        """Return the larger `Network.residual` of both directions, for the maps in `network`."""
        (i, j), network = edge, network or self.network
        return max(network.residual(self.points, i, j), network.residual(self.points, j, i))

    def contradicted(self, edges: Iterable[Edge]) -> list[Edge]:
        """Return the edges whose match failed or whose maps contradict the consistent maps."""
        return [e for e in edges if e not in self.maps or self.residual(e) >= _CONTRADICTED_FROM]

    def vertex_map(self, i: int, j: int) -> Int64[np.ndarray, " m"]:
        """Return the map of shape i to shape j through the template."""
        meshes = self.network.meshes
        return vertex_map_between(self.points[i], self.points[j], meshes[self.template], meshes[i], meshes[j])

    def improvements(self, again: Mapping[Edge, EdgeMap]) -> dict[Edge, EdgeMap]:
        """Return each new map that agrees better with the consistent maps than the edge's old map.

        A new map with a larger distortion probably started from a wrong consistent map, and is left out.
        """
        better = {}
        errors = {edge: new.expected_error for edge, new in again.items()}
        network = Network(self.network.meshes, _both_directions(again), errors)
        for edge, new in again.items():
            old = self.maps.get(edge)
            residual = np.inf if old is None else self.residual(edge)
            largest_distortion = np.inf if old is None else old.distortion * _DISTORTION_TOLERANCE
            if self.residual(edge, network) < residual and new.distortion <= largest_distortion:
                better[edge] = new
        return better

    def matched_edge(self, edge: Edge, replaced: Container[Edge]) -> MatchedEdge:
        """Return the scores of an edge, given the edges whose first maps were replaced."""
        if edge not in self.maps:
            return MatchedEdge(*edge, np.inf, np.inf, np.inf, np.inf, "contradicted", True)
        matched, residual = self.maps[edge], self.residual(edge)
        wrong = residual >= _CONTRADICTED_FROM
        decision = "contradicted" if wrong else "replaced" if edge in replaced else "kept"
        error = self.network.error(*edge)
        doubtful = wrong or error >= OUTLIER_FROM
        scores = matched.expected_error, matched.distortion, error, residual
        return MatchedEdge(*edge, *scores, decision, doubtful)


def _both_directions(maps: Mapping[Edge, EdgeMap]) -> dict[tuple[int, int], SurfacePoints]:
    """Return the maps of all edges (i, j) with the keys (i, j) and (j, i)."""
    forward = {edge: matched.forward for edge, matched in maps.items()}
    return forward | {(j, i): matched.backward for (i, j), matched in maps.items()}


def _cycle_samples(shape: PreparedShape) -> Int64[np.ndarray, " s"]:
    if shape.samples is None:
        used = shape.mesh.referenced_indices
        return used[:: max(1, len(used) // _CYCLE_SAMPLES)]
    return np.asarray(shape.samples, np.int64)[:_CYCLE_SAMPLES]
