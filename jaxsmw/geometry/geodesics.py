"""Geodesic distances on piecewise flat surfaces, accurate even for short distances.

Maps are evaluated by the distances between matches and true points, which are often short. There, the heat
method has errors of several percent, and exact window propagation takes about 100 times as long as this
module.

This module runs Dijkstra's algorithm on a graph of mesh edges and of straight lines across faces. Strips of
triangles around each vertex are unfolded into the plane. If a straight line within a strip joins two
vertices, the graph contains an edge with the length of this line. Paths in this graph are paths on the
surface, so computed distances are never too short. On meshes of bodies, they are too long by 0.03 to 0.07 %
on average.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Complex128, Float32, Float64, Int, Int64
from numpy.typing import ArrayLike
from scipy.sparse import csgraph, csr_array

from jaxsmw.choices import GeodesicMethod
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.arrays import ranges, ratio, sides_of
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints, check_points
from jaxsmw.runtime.cache import cached

# A straight line of the graph may cross at most this number of edges of the mesh.
_DEPTH = 10

# Strips are unfolded from at most `_SIDES_AT_ONCE` sides at a time. `geodesic_distances_between` stores up to
# about `_DISTANCES_AT_ONCE` distances at a time. Both constants are chosen so that the arrays fit into the
# processor's cache.
_SIDES_AT_ONCE, _DISTANCES_AT_ONCE = 2**13, 2**20

# `geodesic_distances_between` first searches within the smallest radius, then within the larger radii, and
# finally on the whole surface. The radii are in units of the square root of the area. Each search takes far
# less time than the next search.
_RADII = (0.01, 0.05, 0.25)

# The number of rows of a matrix of distances in one entry of the cache.
_ROWS_IN_CACHE = 256

# libigl may never finish if the height of a triangle is less than this fraction of its longest edge.
_EXACT_HEIGHT = 1e-6


class _Sides(NamedTuple):
    """The sides of the f faces and of their mirror images: side 3 t + k starts at corner k of triangle t."""

    # Triangles f … 2 f - 1 are the faces with reversed order of corners. A line enters the next triangle by a
    # side in the opposite direction. If the next face has no such side, the line enters its mirror image.

    tail: Int64[np.ndarray, " s"]
    head: Int64[np.ndarray, " s"]
    apex: Int64[np.ndarray, " s"]
    length: Float64[np.ndarray, " s"]
    # The position of the apex as a complex number, in the frame in which the side leads from 0 to 1. The apex
    # is never below the real axis.
    shape: Complex128[np.ndarray, " s"]
    # If a line leaves a triangle by side i, it continues in all other triangles at this edge. It enters these
    # triangles by the sides across[first[i]:first[i + 1]].
    first: Int64[np.ndarray, " s1"]
    across: Int64[np.ndarray, " c"]


def _sides(mesh: Mesh) -> _Sides:
    n, f = len(mesh.vertices), len(mesh.faces)
    triangles = np.concatenate([mesh.faces, mesh.faces[:, ::-1]])
    tail, head, apex = sides_of(triangles)
    along = mesh.vertices[head] - mesh.vertices[tail]
    to_apex = mesh.vertices[apex] - mesh.vertices[tail]
    length = np.linalg.norm(along, axis=1)
    # For a side of length zero, `direction` and `shape` are zero. No line crosses such a side.
    direction = ratio(along, length[:, None])
    x, y = np.sum(direction * to_apex, axis=1), np.linalg.norm(np.cross(direction, to_apex), axis=1)
    shape = ratio(x + 1j * y, length)

    order = np.argsort(tail * n + head, kind="stable")
    keys = (tail * n + head)[order]
    start = np.searchsorted(keys, head * n + tail)
    count = np.searchsorted(keys, head * n + tail, side="right") - start
    leaving, position = ranges(start, count)
    across = order[position]
    to_other_face = leaving // 3 % f != across // 3 % f
    first = np.concatenate([[0], np.cumsum(np.bincount(leaving[to_other_face], minlength=6 * f))])
    return _Sides(tail, head, apex, length, shape, first, across[to_other_face])


class _Beams(NamedTuple):
    """Cones of lines from 0 through unfolded triangles of the complex plane, between two directions."""

    # A beam crosses the side `side`, whose ends are `right` and `left`.

    origin: Int64[np.ndarray, " b"]
    side: Int64[np.ndarray, " b"]
    right: Complex128[np.ndarray, " b"]
    left: Complex128[np.ndarray, " b"]
    rightmost: Complex128[np.ndarray, " b"]
    leftmost: Complex128[np.ndarray, " b"]

    def at(self, rows: np.ndarray) -> _Beams:
        return _Beams(*(values[rows] for values in self))


def _is_left(a: Complex128[np.ndarray, " b"], b: Complex128[np.ndarray, " b"]) -> Bool[np.ndarray, " b"]:
    """Return whether b is to the left of a, seen from 0."""
    return a.real * b.imag - a.imag * b.real > 0


def _visible(beams: _Beams, position: Complex128[np.ndarray, " b"]) -> Bool[np.ndarray, " b"]:
    """Return for each beam i whether `position[i]` lies inside the beam."""
    return _is_left(beams.rightmost, position) & _is_left(position, beams.leftmost)


def _unfold(
    sides: _Sides,
    origin: Int64[np.ndarray, " b"],
    side: Int64[np.ndarray, " b"],
    position: Complex128[np.ndarray, " b"],
    depth: int,
) -> Iterator[tuple[_Beams, Complex128[np.ndarray, " _"]]]:
    """Yield, for 1 … `depth` crossed sides, the beams and the corners opposite these sides."""
    # `position` is that of each beam's first point, in the frame in which `side` leads from 0 to 1.
    right, left = -position * sides.length[side], (1 - position) * sides.length[side]
    beams = _Beams(origin, side, right, left, right, left)
    for _ in range(depth):
        start = sides.first[beams.side]
        beam, entry = ranges(start, sides.first[beams.side + 1] - start)
        beams = beams.at(beam)._replace(side=sides.across[entry])
        corner = beams.left + sides.shape[beams.side] * (beams.right - beams.left)
        yield beams, corner
        # The corner splits each beam in two. Lines to the right of the corner leave the triangle by the side
        # between `right` and the corner. Lines to the left of the corner leave by the side between the corner
        # and `left`.
        triangle, k = np.divmod(beams.side, 3)
        visible = _visible(beams, corner)
        to_right = beams._replace(
            side=3 * triangle + (k + 1) % 3,
            left=corner,
            leftmost=np.where(visible, corner, beams.leftmost),
        ).at(_is_left(beams.rightmost, corner))
        to_left = beams._replace(
            side=3 * triangle + (k + 2) % 3,
            right=corner,
            rightmost=np.where(visible, corner, beams.rightmost),
        ).at(_is_left(corner, beams.leftmost))
        beams = _Beams(*(np.concatenate(both) for both in zip(to_right, to_left, strict=True)))


class _Lines(NamedTuple):
    """Straight lines on the surface, between nodes of a graph."""

    origins: Int[np.ndarray, " l"]
    ends: Int[np.ndarray, " l"]
    lengths: Float64[np.ndarray, " l"]

    def distances(
        self,
        to_vertices: Float64[np.ndarray, "s n"],
        sources: Int64[np.ndarray, " q"],
        points: Int64[np.ndarray, " q"],
    ) -> Float64[np.ndarray, " q"]:
        """Return the distances from `sources[i]` to the origin `points[i]`, given those to all vertices.

        The origins must be ascending. A path ends with a line to one of them, in the opposite direction.
        """
        start = np.searchsorted(self.origins, points)
        counts = np.searchsorted(self.origins, points, side="right") - start
        pair, line = ranges(start, counts)
        lengths = to_vertices[sources[pair], self.ends[line]] + self.lengths[line]
        return np.minimum.reduceat(lengths, np.cumsum(counts) - counts)


def _lines(sides: _Sides, origin: np.ndarray, side: np.ndarray, position: np.ndarray, depth: int) -> _Lines:
    """Return straight lines from the given points to vertices. Each line crosses at most `depth` sides."""
    found = []
    for beams, corner in _unfold(sides, origin, side, position, depth):
        seen = _visible(beams, corner)
        found.append((beams.origin[seen], sides.apex[beams.side[seen]], np.abs(corner[seen])))
    return _Lines(*(np.concatenate(part) for part in zip(*found, strict=True)))


def _shortest(lines: Sequence[_Lines], size: int) -> csr_array:
    """Return a square sparse matrix with the length of the shortest line between each pair of nodes."""
    origins, ends, lengths = (np.concatenate(part) for part in zip(*lines, strict=True))
    key = origins.astype(np.int64) * size + ends
    order = np.lexsort([lengths, key])
    key, lengths = key[order], lengths[order]
    first = np.ones(len(key), dtype=bool)
    first[1:] = key[1:] != key[:-1]
    return csr_array((lengths[first], np.divmod(key[first], size)), shape=(size, size))


@lru_cache(maxsize=4)
def geodesic_graph(mesh: Mesh, *, depth: int = _DEPTH) -> csr_array:
    """Return the graph of the edges of a mesh and of straight lines through strips of triangles.

    Graphs are cached on disk (`jaxsmw.runtime.cache`). The four most recently used graphs are also kept in
    memory. All callers share a matrix and must not change it.

    **Arguments:**

    - `mesh`: the surface with n vertices. Boundaries, several connected components and non-manifold edges are
      allowed.
    - `depth`: the maximum number of edges that a straight line may cross, at least 1. In a graph of depth 6,
      the shortest paths on bodies are too long by 0.1 to 0.2 % on average, and searches take 0.7 of the time.

    **Returns:** The lengths of the edges and lines as a sparse symmetric matrix (n, n), in the unit of the
    mesh. A stored zero is the length of a line between two vertices at the same position.
    """
    n, s = len(mesh.vertices), 3 * len(mesh.faces)

    def build() -> dict[str, np.ndarray]:
        sides = _sides(mesh)
        smaller, larger = mesh.edges.T
        lines = [_Lines(smaller, larger, mesh.lengths(mesh.edges))]
        # Lines start only in the original triangles, because the mirrored triangles would give the same lines
        # again.
        for start in range(0, s, _SIDES_AT_ONCE):
            side = np.arange(start, min(start + _SIDES_AT_ONCE, s))
            origins, ends, lengths = _lines(sides, sides.apex[side], side, sides.shape[side], depth)
            once = origins < ends  # each line is found from both ends
            lines.append(_Lines(origins[once], ends[once], lengths[once]))
        half = _shortest(lines, n).tocoo()
        rows, columns = np.concatenate([[half.row, half.col], [half.col, half.row]], axis=1)
        graph = csr_array((np.tile(half.data, 2), (rows, columns)), shape=(n, n))
        return {"lengths": graph.data, "columns": graph.indices, "first": graph.indptr}

    arrays = cached("geodesic-graph", [mesh.vertices, mesh.faces, depth], build)
    return csr_array((arrays["lengths"], arrays["columns"], arrays["first"]), shape=(n, n))


def geodesic_distances(
    mesh: Mesh,
    sources: ArrayLike | SurfacePoints,
    *,
    method: GeodesicMethod = "strips",
    limit: float = np.inf,
) -> Float64[np.ndarray, "s n"]:
    """Compute geodesic distances from points on a mesh to all its vertices.

    **Arguments:**

    - `mesh`: the surface with n vertices.
    - `sources`: the s sources, as 0-based vertex indices (s,) or as `SurfacePoints`. The result contains s
      times n numbers, so split a large number of sources into several calls.
    - `method`: `"strips"` is Dijkstra's algorithm on a graph of edges and straight lines across faces. On
      meshes of bodies, its distances are too long by 0.03 to 0.07 % on average. `"exact"` propagates windows
      (Mitchell, Mount and Papadimitriou 1987, implemented in libigl). It works only between vertices of
      manifold meshes, and takes about 100 times as long.
    - `limit`: the largest distance of interest, in the unit of the mesh. Larger distances become inf. With
      `"strips"`, a limit reduces the computation time.

    **Returns:** Distances (s, n), float64, in the unit of the mesh. A distance is inf if no path connects the
    source and the vertex, or if the distance is above the limit.

    **Raises:** `InputError` for sources that are not on the mesh, or an unknown method. With `"exact"`,
    `InputError` is also raised for `SurfacePoints`, and for meshes with non-manifold edges, non-manifold
    vertices or faces of almost zero height.
    """
    check_choice(method, GeodesicMethod, "a method for geodesic distances")
    points = check_points(sources, mesh, "sources")
    if method == "exact":
        distances = np.empty((len(points), len(mesh.vertices)))
        search = _exact_search(mesh)
        for row, source in zip(distances, _vertices(points), strict=True):
            row[:] = search(source, np.arange(len(mesh.vertices)))
        distances[distances > limit] = np.inf
        return distances
    graph, nodes = _network(mesh, points)
    return csgraph.dijkstra(graph, indices=nodes, limit=limit)[:, : len(mesh.vertices)]


def geodesic_matrix(mesh: Mesh, *, method: GeodesicMethod = "exact") -> Float32[np.ndarray, "n n"]:
    """Compute the geodesic distances between all vertices of a mesh, or read them from the cache.

    The cache on disk stores blocks of rows, so a call after an interruption continues. With `"exact"`, a mesh
    of 5000 vertices takes about an hour on one core; with `"strips"`, it takes half a minute. The cache must
    have room for 4 n² bytes; see `jaxsmw.runtime.cache.cached`.

    **Arguments:** `mesh`, `method`: as for `geodesic_distances`.

    **Returns:** The distances (n, n), float32, in the unit of the mesh; inf if no path connects two vertices.

    **Raises:** The errors of `geodesic_distances`.
    """
    n = len(mesh.vertices)
    matrix = np.empty((n, n), np.float32)
    for first in range(0, n, _ROWS_IN_CACHE):
        block = np.arange(first, min(first + _ROWS_IN_CACHE, n))

        def compute(block: np.ndarray = block) -> dict[str, np.ndarray]:
            return {"rows": geodesic_distances(mesh, block, method=method).astype(np.float32)}

        inputs = [mesh.vertices, mesh.faces, method, first, len(block)]
        matrix[block] = cached("geodesic-rows", inputs, compute)["rows"]
    return matrix


def geodesic_distances_between(
    mesh: Mesh,
    points: ArrayLike | SurfacePoints,
    partners: ArrayLike | SurfacePoints,
    *,
    method: GeodesicMethod = "strips",
) -> Float64[np.ndarray, " p"]:
    """Compute the geodesic distance (p,) between `points[i]` and `partners[i]` of each pair i.

    The search starts from `points` or from `partners`, whichever has fewer distinct points. Its radius grows
    in steps, so the function is much faster than `geodesic_distances` if partners are close together, and it
    never stores all p times n distances. Otherwise, both functions agree.

    **Raises:** The errors of `geodesic_distances`, and `InputError` for different numbers of points and
    partners.
    """
    check_choice(method, GeodesicMethod, "a method for geodesic distances")
    starts, ends = check_points(points, mesh, "points"), check_points(partners, mesh, "partners")
    if len(starts) != len(ends):
        raise InputError(
            f"every point needs a partner, but there are {len(starts)} points and {len(ends)} partners: "
            "give equal numbers of both."
        )
    if _number_of_different(ends) < _number_of_different(starts):
        starts, ends = ends, starts
    distances = np.full(len(starts), np.inf)
    if method == "exact":
        starts, ends = _vertices(starts), _vertices(ends)
        search = _exact_search(mesh)
        for source in np.unique(starts):
            pairs = np.flatnonzero(starts == source)
            distances[pairs] = search(source, ends[pairs])
        return distances

    if isinstance(starts, SurfacePoints) and isinstance(ends, SurfacePoints):
        distances = _straight_distances(mesh, starts, ends)
    graph, nodes = _network(mesh, starts)
    arrivals = _lines_from(mesh, ends)
    at_once = max(1, _DISTANCES_AT_ONCE // graph.shape[0])
    pending = np.argsort(nodes, kind="stable")
    for radius in [*(np.sqrt(mesh.area) * np.array(_RADII)), np.inf]:
        sources, row = np.unique(nodes[pending], return_inverse=True)
        for start in range(0, len(sources), at_once):
            rows = csgraph.dijkstra(graph, indices=sources[start : start + at_once], limit=radius)
            first, last = np.searchsorted(row, [start, start + at_once])
            pairs = pending[first:last]
            found = arrivals.distances(rows, row[first:last] - start, pairs)
            distances[pairs] = np.minimum(distances[pairs], found)
        pending = pending[distances[pending] > radius]
    return distances


def _number_of_different(points: Int64[np.ndarray, " p"] | SurfacePoints) -> int:
    return len(points) if isinstance(points, SurfacePoints) else len(np.unique(points))


def _exits(sides: _Sides, points: SurfacePoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the origins, sides and positions of three beams per point, one through each side of its face."""
    side = (3 * points.faces[:, None] + np.arange(3)).ravel()
    of_head, of_apex = (np.roll(points.weights, -k, axis=1).ravel() for k in (1, 2))
    return np.repeat(np.arange(len(points)), 3), side, of_head + of_apex * sides.shape[side]


def _straight_distances(
    mesh: Mesh, points: SurfacePoints, partners: SurfacePoints
) -> Float64[np.ndarray, " p"]:
    """Return the lengths of straight lines from `points[i]` to `partners[i]`, or inf if no line exists."""
    lengths = np.linalg.norm(points.positions(mesh) - partners.positions(mesh), axis=1)
    lengths[points.faces != partners.faces] = np.inf
    sides = _sides(mesh)
    for all_beams, corners in _unfold(sides, *_exits(sides, points), _DEPTH):
        mirrored, face = np.divmod(all_beams.side // 3, len(mesh.faces))
        met = np.flatnonzero(face == partners.faces[all_beams.origin])
        beams, corner = all_beams.at(met), corners[met]
        weights = partners.weights[beams.origin]
        weights = np.where(mirrored[met, None] == 1, weights[:, ::-1], weights)
        turned = (beams.side[:, None] + np.arange(3)) % 3  # side 3 t + k begins at corner k
        of_left, of_right, of_corner = np.take_along_axis(weights, turned, axis=1).T
        position = of_left * beams.left + of_right * beams.right + of_corner * corner
        seen = _visible(beams, position)
        np.minimum.at(lengths, beams.origin[seen], np.abs(position[seen]))
    return lengths


def _network(
    mesh: Mesh, points: Int64[np.ndarray, " p"] | SurfacePoints
) -> tuple[csr_array, Int64[np.ndarray, " p"]]:
    """Add surface points to the geodesic graph as nodes; return the graph and these nodes."""
    # The added lines are directed from the points to vertices. Therefore no path leads through an added node,
    # and a distance does not depend on the other added points.
    graph, size = geodesic_graph(mesh), len(mesh.vertices)
    if not isinstance(points, SurfacePoints):
        return graph, points
    coordinates = graph.tocoo()
    added = _lines_from(mesh, points)
    lines = (
        _Lines(coordinates.row, coordinates.col, coordinates.data),
        added._replace(origins=size + added.origins),
    )
    return _shortest(lines, size + len(points)), size + np.arange(len(points))


def _lines_from(mesh: Mesh, points: Int64[np.ndarray, " p"] | SurfacePoints) -> _Lines:
    """Return straight lines from points to vertices, with the numbers of the points as origins, ascending."""
    if not isinstance(points, SurfacePoints):
        return _Lines(np.arange(len(points)), points, np.zeros(len(points)))
    corners, sides = mesh.faces[points.faces], _sides(mesh)
    offsets = mesh.vertices[corners] - points.positions(mesh)[:, None]
    number = np.repeat(np.arange(len(points)), 3)
    near = _Lines(number, corners.ravel(), np.linalg.norm(offsets, axis=2).ravel())
    far = _lines(sides, *_exits(sides, points), _DEPTH)
    order = np.argsort(np.concatenate([near.origins, far.origins]), kind="stable")
    return _Lines(*(np.concatenate(part)[order] for part in zip(near, far, strict=True)))


def _exact_search(mesh: Mesh) -> Callable[[np.int64, np.ndarray], np.ndarray]:
    """Return a function that computes exact distances from a source vertex to target vertices."""
    # libigl crashes at edges with three faces, stops early at vertices that join several fans of faces, and
    # does not terminate on slivers or in very small units. Such meshes are refused, and the unit is changed.
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    faults = {
        "edges with more than two faces": len(mesh.nonmanifold_edges),
        "vertices that join separate fans of faces": int(mesh.nonmanifold_vertices.sum()),
        "faces almost without height": int((2 * mesh.face_areas <= _EXACT_HEIGHT * longest**2).sum()),
    }
    for fault, count in faults.items():
        if count:
            raise InputError(
                f"{mesh.name}: exact geodesic distances cannot be computed because the mesh has {fault} "
                f"({count}): use method='strips'."
            )
    _, component = csgraph.connected_components(geodesic_graph(mesh), directed=False)
    scale = np.sqrt(mesh.area)
    vertices = mesh.vertices / scale

    def search(source: np.int64, targets: np.ndarray) -> np.ndarray:
        distances = igl.exact_geodesic(vertices, mesh.faces, VS=np.array([source]), VT=targets)
        return np.where(component[targets] == component[source], scale * distances, np.inf)

    return search


def _vertices(points: Int64[np.ndarray, " p"] | SurfacePoints) -> Int64[np.ndarray, " p"]:
    if isinstance(points, SurfacePoints):
        raise InputError(
            "exact geodesic distances are computed between vertices, not to points on faces: use "
            "method='strips'."
        )
    return points
