"""Cuts shortcuts, the places where a surface is fused with another part of itself."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.sparse import csgraph, csr_array

from jaxsmw.geometry.arrays import sides_of, unit_vectors
from jaxsmw.geometry.mesh import Mesh, components_of_faces, connected_components
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.geometry.scans import in_small_components
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.wording import count_of

logger = logging.getLogger("jaxsmw")

# A surface with more handles than this number is porous, for example a scanned bone, and is not cut.
_MOST_HANDLES = 30
# The depth of a vertex is the largest angle between the normals of the two faces of a concave edge. Between
# the depths _FLAT and _VALLEY, the weight of an edge's length falls from 1 to _VALLEY_WEIGHT. (Table R41 of
# docs/research_log.md)
_FLAT, _VALLEY, _VALLEY_WEIGHT = np.radians(30), np.radians(60), 0.05
# A loop surrounds a contact if its weighted length is at most _CONTACT times its length. (Table R41)
_CONTACT = 0.35
# Shortest paths begin at this number of vertices in valleys. On large meshes, which take longer, there are
# fewer of these vertices, so that all shortest paths together reach _REACHED vertices.
_BASE_POINTS, _FEWEST_BASE_POINTS, _REACHED = 160, 16, 1_600_000


def cut_shortcuts(mesh: Mesh) -> Mesh:
    """Cut a mesh where the surface is fused with another part of itself, for example a hand with a hip.

    If parts of a body touch each other, a scan often contains one surface that surrounds both parts. Such
    *topological noise* shortens geodesic distances. Each contact is a handle of the surface and is surrounded
    by a valley. The function searches loops around handles that are short, where edges in valleys count less
    than their length. Candidates are the loops of tree-cotree decompositions (Erickson, Whittlesey 2005,
    *Greedy optimal homotopy and homology generators*). For each handle, the function cuts the loop that
    follows valleys best, if most of this loop is in valleys. The cut is a gap, which is one face wide.

    **Returns:** A `Mesh` with the same vertices and fewer faces. A few vertices beside a gap can lose all
    their faces. The result is `mesh` itself if no loop is cut, or if the surface has more than 30 handles.
    Handles are not found if many faces are misoriented, or if the faces share no vertices (triangle soup).
    """
    manifold, origin = (part.astype(np.int64) for part in igl.split_nonmanifold(mesh.faces))
    genus = _genus(manifold)
    if not 0 < genus <= _MOST_HANDLES:
        return mesh
    surface = Mesh(mesh.vertices[origin], manifold)
    cut, opened, chosen = np.zeros(manifold.shape, bool), manifold, []
    # Loops that follow valleys best come first. Shorter loops can cross a limb beside the contact.
    loops = {loop.edges: loop for loop in _handle_loops(surface, genus) if loop.relative_length <= _CONTACT}
    for loop in sorted(loops.values(), key=lambda loop: loop.relative_length):
        trial = cut.copy()
        trial.flat[np.concatenate([loop.left, loop.right])] = True
        further = igl.cut_mesh(surface.vertices, manifold, trial)[1].astype(np.int64)
        # A second cut around the same handle does not reduce the genus.
        if (reduced := _genus(further)) < genus:
            cut, opened, genus = trial, further, reduced
            chosen.append(loop)
        if genus == 0:
            break
    if not chosen:
        return mesh
    logger.info("%s: fused with itself, and cut along %s", mesh.name, count_of(len(chosen), "loop"))
    removed = np.zeros(len(manifold), bool)
    for loop in chosen:
        strips = _faces_along(opened, loop.left), _faces_along(opened, loop.right)
        removed |= min(strips, key=lambda strip: float(mesh.face_areas[strip].sum()))
    # A gap can isolate a few faces, whose eigenfunctions would be useless.
    kept = np.flatnonzero(~removed)
    _, component = components_of_faces(mesh.faces[kept], len(mesh.vertices))
    at_gap = np.isin(component[mesh.faces[kept, 0]], component[mesh.faces[removed]])
    small, _ = in_small_components(component[mesh.faces[kept, 0]], mesh.face_areas[kept], at_gap)
    removed[kept] = small & at_gap
    return mesh.without_faces(removed)


def points_on_uncut(points: SurfacePoints, cut: Mesh, mesh: Mesh) -> SurfacePoints:
    """Return points of a cut mesh as points of the given mesh; see `cut_shortcuts`."""
    faces = np.searchsorted(mesh.face_numbers, cut.face_numbers[points.faces])
    return SurfacePoints(faces, points.weights)


def _genus(manifold: Int64[np.ndarray, "f 3"]) -> int:
    """Return the number of handles of a manifold surface, with any boundaries and components."""
    # With c components and b boundary loops, Euler's formula is V - E + F = 2 (c - genus) - b.
    components, _ = components_of_faces(manifold, int(manifold.max()) + 1)
    boundaries = len(igl.boundary_loop_all(manifold))
    return components - (igl.euler_characteristic(manifold) + boundaries) // 2


def _faces_along(opened: Int64[np.ndarray, "f 3"], sides: Int64[np.ndarray, " l"]) -> Bool[np.ndarray, " f"]:
    """Return a mask of the faces that touch the given sides of faces, after the surface was cut open."""
    touched = np.zeros(int(opened.max()) + 1, bool)
    touched[opened.ravel()[sides]] = True
    touched[np.roll(opened, -1, axis=1).ravel()[sides]] = True
    return np.asarray(touched[opened].any(axis=1))


class _HandleLoop(NamedTuple):
    """A closed path along interior edges, with the sides 3 f + i of faces f to its left and to its right."""

    weighted_length: float
    length: float
    left: Int64[np.ndarray, " l"]
    right: Int64[np.ndarray, " l"]

    @property
    def relative_length(self) -> float:
        """The ratio of weighted length to length, which is smaller the more of the loop is in valleys."""
        return self.weighted_length / self.length

    @property
    def edges(self) -> bytes:
        """A key that is the same for all loops along the same edges."""
        return np.sort(np.minimum(self.left, self.right)).tobytes()


class _Edges(NamedTuple):
    """The interior edges of a manifold surface. Each edge leads along the side `left` of a face."""

    tail: Int64[np.ndarray, " e"]
    head: Int64[np.ndarray, " e"]
    left: Int64[np.ndarray, " e"]
    right: Int64[np.ndarray, " e"]
    length: Float64[np.ndarray, " e"]
    weighted_length: Float64[np.ndarray, " e"]
    in_valley: Bool[np.ndarray, " e"]

    @classmethod
    def of(cls, surface: Mesh, twin: Int64[np.ndarray, " s"]) -> _Edges:
        """Return the interior edges; `twin` is the number of the same side in the other face, or -1."""
        left = np.flatnonzero(np.arange(len(twin)) < twin)
        right = twin[left]
        tails, heads, opposite = sides_of(surface.faces)
        tail, head, beyond = tails[left], heads[left], opposite[right]
        # Unit vectors keep products of normals in the range of float64, whatever the unit of length.
        unit = unit_vectors(surface.area_vectors)
        normals = unit[left // 3], unit[right // 3]
        # Normals point outward, so the face to the right of a valley rises above the plane of the left
        # face. If the surface is inside out, the signs are reversed.
        above = np.sum((surface.vertices[beyond] - surface.vertices[tail]) * normals[0], axis=1)
        sine, cosine = np.linalg.norm(np.cross(*normals), axis=1), np.sum(normals[0] * normals[1], axis=1)
        angle = np.arctan2(sine, cosine) * np.sign(above) * (-1 if surface.is_inside_out else 1)
        # A valley does not follow edges exactly, so the steepest edge at each vertex decides.
        steepest = np.zeros(len(surface.vertices))
        np.maximum.at(steepest, np.concatenate([tail, head]), np.tile(angle, 2))
        depth = np.minimum(steepest[tail], steepest[head])
        length = np.linalg.norm(surface.vertices[head] - surface.vertices[tail], axis=1)
        weight = np.interp(depth, [_FLAT, _VALLEY], [1, _VALLEY_WEIGHT])
        return cls(tail, head, left, right, length, weight * length, depth >= _VALLEY)


def _handle_loops(surface: Mesh, genus: int) -> Iterator[_HandleLoop]:
    """Return short loops around the handles of a manifold surface with the given number of handles."""
    n = len(surface.vertices)
    adjacent, side = igl.triangle_triangle_adjacency(surface.faces)
    twin = np.where(adjacent < 0, -1, 3 * adjacent + side).ravel().astype(np.int64)
    edges = _Edges.of(surface, twin)
    if not edges.in_valley.any():
        return
    valleys = replace(surface, faces=surface.faces[np.unique(edges.left[edges.in_valley] // 3)])
    # The handles can belong to different components.
    number = max(min(_BASE_POINTS, max(_FEWEST_BASE_POINTS, _REACHED // n)), 3 * genus)
    number = min(number, len(valleys.referenced_indices))
    graph = csr_array((edges.weighted_length, (edges.tail, edges.head)), shape=(n, n))
    distances, predecessors = csgraph.dijkstra(
        graph, directed=False, indices=farthest_point_samples(valleys, number), return_predecessors=True
    )
    arcs = _dual_arcs(surface, edges, twin)
    # A loop traverses an edge from tail to head, with the side `left` on its left, or from head to tail.
    key = np.concatenate([edges.tail * n + edges.head, edges.head * n + edges.tail])
    order = np.argsort(key)
    for distance, predecessor in zip(distances, predecessors, strict=True):
        in_tree = (predecessor[edges.tail] == edges.head) | (predecessor[edges.head] == edges.tail)
        weighted_length = distance[edges.tail] + distance[edges.head] + edges.weighted_length
        for edge in _generators(*arcs, np.where(in_tree, np.inf, weighted_length)):
            path = _closed_path(predecessor, int(edges.tail[edge]), int(edges.head[edge]))
            along = order[np.searchsorted(key, path * n + np.roll(path, -1), sorter=order)]
            edge_numbers = along % len(edges.tail)
            forward = along == edge_numbers
            left = np.where(forward, edges.left[edge_numbers], edges.right[edge_numbers])
            yield _HandleLoop(
                float(edges.weighted_length[edge_numbers].sum()),
                float(edges.length[edge_numbers].sum()),
                left,
                twin[left],
            )


def _closed_path(predecessor: Int32[np.ndarray, " n"], tail: int, head: int) -> Int64[np.ndarray, " l"]:
    """Return the vertices of the closed path through an edge and the shortest paths of its ends."""
    branches = []
    for vertex in (tail, head):
        branch = [vertex]
        while (vertex := int(predecessor[vertex])) >= 0:
            branch.append(vertex)
        branches.append(branch)
    there, back = branches
    while len(there) > 1 and len(back) > 1 and there[-2] == back[-2]:
        there.pop()
        back.pop()
    return np.array(there + back[-2::-1])


def _dual_arcs(
    surface: Mesh, edges: _Edges, twin: Int64[np.ndarray, " s"]
) -> tuple[Int64[np.ndarray, "e 2"], Int64[np.ndarray, "b 2"]]:
    """Return the dual arcs across interior and boundary edges; nodes are faces, and then boundary loops."""
    boundary = np.flatnonzero(twin < 0)
    tails, heads, _ = sides_of(surface.faces)
    ends = np.stack([tails[boundary], heads[boundary]], axis=1)
    loop = connected_components(ends, len(surface.vertices))[1][ends[:, 0]]
    interior = np.sort(np.stack([edges.left // 3, edges.right // 3], axis=1), axis=1)
    return interior, np.stack([boundary // 3, len(surface.faces) + loop], axis=1)


def _generators(
    interior: Int64[np.ndarray, "e 2"], boundary: Int64[np.ndarray, "b 2"], length: Float64[np.ndarray, " e"]
) -> Int64[np.ndarray, " g"]:
    """Return the edges whose loops generate all loops of a component, two edges for each handle."""
    # A dual tree crosses all boundary edges and the edges with the longest loops. The generators are the
    # edges that are neither in the tree of shortest paths nor crossed by the dual tree. `length` is that of
    # the loop through each interior edge, and infinite in the tree and in components without the base point.
    usable = np.flatnonzero(np.isfinite(length))
    if not usable.size:
        return usable
    crossing = np.concatenate([interior[usable], boundary])
    # The minimum spanning tree prefers small weights, which must be positive.
    weight = np.concatenate([2 - length[usable] / length[usable].max(), np.full(len(boundary), 0.5)])
    size = int(crossing.max()) + 1
    key = crossing[:, 0] * size + crossing[:, 1]
    order = np.lexsort((weight, key))
    first = order[np.diff(key[order], prepend=-1) > 0]  # the smallest weight of parallel arcs
    graph = csr_array((weight[first], tuple(crossing[first].T)), shape=(size, size))
    tree = csgraph.minimum_spanning_tree(graph).tocoo()
    in_tree = first[np.isin(key[first], tree.row.astype(np.int64) * size + tree.col)]
    return np.setdiff1d(usable, usable[in_tree[in_tree < len(usable)]])
