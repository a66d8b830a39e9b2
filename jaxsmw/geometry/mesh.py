"""Triangle meshes, with checks, cleaning, areas, normals and a diagnosis of defects."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import igl
import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64, Shaped
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, csgraph
from scipy.spatial import KDTree

from jaxsmw.errors import InputError, check_number
from jaxsmw.geometry.arrays import first_equal_rows, ranges, sides_of
from jaxsmw.geometry.scans import between_neighbors, in_small_components, lost_vertices
from jaxsmw.wording import count_of

# A mesh of another library, in one of the forms that `make_mesh` lists. Such meshes are recognised by their
# attributes, because the other libraries are not imported.
MeshLike: TypeAlias = Any

# A triangle whose height is at most this fraction of its longest edge is degenerate. Near the origin,
# relative rounding errors are far smaller than this fraction. Triangles that are thin on purpose have far
# larger relative heights.
DEGENERATE_HEIGHT = 1e-10

# The smallest and the largest accepted extent of a mesh. A mesh outside these limits is damaged or has an
# unsuitable unit. Descriptors contain squares of areas, which neither overflow nor underflow within these
# limits.
SMALLEST_EXTENT, LARGEST_EXTENT = 1e-60, 1e60
# The largest accepted distance of a vertex from the origin, and from the middle of the mesh. Both distances
# are in units of the median edge length. At `LARGEST_COORDINATE` from the origin, float64 rounds positions by
# 1e-4 edge lengths. Maps are refined in float32. At `LARGEST_DISTANCE` from the middle of a mesh, float32
# rounds positions by 0.1 edge lengths. (The meshes of the data sets measure at most 1e4 edge lengths.)
LARGEST_COORDINATE, LARGEST_DISTANCE = 1e12, 1e6
# Two boundary vertices are one vertex, which rounding has split, if their distance is at most this share of
# the shortest edge at both. Numbers with six digits, which many programs write, stay below this share.
_ROUNDING = 0.01
# Welding without a tolerance looks for cracks: distances below `_CRACK` shortest edges, which a factor of at
# least `_GAP` separates from the distances above them. Vertices at a boundary without a crack are one edge
# apart.
_CRACK, _GAP = 0.25, 4.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh whose vertices have the same order as in the file or in the given array.

    Cleaning drops only faces. A vertex without faces keeps its number, and its entry in `referenced_vertices`
    is False. Use `read_mesh` or `make_mesh` to make a `Mesh`, because the constructor does not check or clean
    its input. All properties are computed when they are first used. Lengths and areas are in the unit of the
    vertices.

    **Attributes:**

    - `vertices`: positions (n, 3), float64, in the unit of the file.
    - `faces`: vertex indices (f, 3), int64, 0-based.
    - `name`: the name of the mesh in messages, which is the path of a mesh from a file.
    - `notes`: sentences about changes made by cleaning, and about unusual elements such as unreferenced
      vertices.
    - `dropped_faces`: the faces of the file that cleaning dropped, as ascending 0-based indices (d,). In
      ground-truth files, face numbers refer to all faces of the mesh file, including dropped faces.
    - `small_faces`: the faces of small components (g, 3), which are among the dropped faces; see `make_mesh`.
    """

    vertices: Float64[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "f 3"]
    name: str = "mesh"
    notes: tuple[str, ...] = ()
    dropped_faces: Int64[np.ndarray, " d"] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    small_faces: Int64[np.ndarray, "g 3"] = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))

    def mirrored(self) -> Mesh:
        """Return the mirror image of the mesh: all x coordinates change sign.

        The corners of each face are reversed, so that normals that point outward still point outward.
        """
        return replace(
            self,
            vertices=self.vertices * np.array([-1.0, 1.0, 1.0]),
            faces=np.ascontiguousarray(self.faces[:, ::-1]),
            small_faces=np.ascontiguousarray(self.small_faces[:, ::-1]),
        )

    @property
    def face_numbers(self) -> Int64[np.ndarray, " f"]:
        """The 0-based number of each face (f,) among all faces of the file, including dropped faces."""
        return np.delete(np.arange(len(self.faces) + len(self.dropped_faces)), self.dropped_faces)

    @cached_property
    def area_vectors(self) -> Float64[np.ndarray, "f 3"]:
        """The normals of the faces (f, 3), each with a length of twice the area of its face."""
        corners = self.vertices[self.faces]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @cached_property
    def face_areas(self) -> Float64[np.ndarray, " f"]:
        """The areas of the faces (f,)."""
        return 0.5 * np.linalg.norm(self.area_vectors, axis=1)

    @cached_property
    def area(self) -> float:
        """The total surface area."""
        return float(self.face_areas.sum())

    @cached_property
    def vertex_areas(self) -> Float64[np.ndarray, " n"]:
        """The vertex areas (n,): a third of the total area of the faces around each vertex."""
        return self.sum_at_vertices(self.face_areas / 3)

    def average(
        self, values: Float[np.ndarray, "n ..."] | Bool[np.ndarray, " n"]
    ) -> Float[np.ndarray, " ..."] | np.floating:
        """Return the area-weighted mean of values at the vertices (n, ...), or the share of a mask's area."""
        return np.average(values, axis=0, weights=self.vertex_areas)

    @cached_property
    def vertex_normals(self) -> Float64[np.ndarray, "n 3"]:
        """Unit normals (n, 3): the area-weighted means of the normals of the faces around each vertex.

        The normal is 0 where the normals of the faces cancel, and at vertices without faces.
        """
        total = np.stack([self.sum_at_vertices(component) for component in self.area_vectors.T], axis=1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        # If the normals of the faces do not cancel, `length` is about six times the vertex area.
        defined = length > 1e-10 * 6 * self.vertex_areas[:, None]
        return np.divide(total, length, out=np.zeros_like(total), where=defined)

    @cached_property
    def is_inside_out(self) -> bool:
        """Whether the normals point inward: True if the enclosed signed volume is negative."""
        corners = self.vertices[self.faces] - self.middle
        return bool(np.linalg.det(corners).sum() < 0)

    @cached_property
    def referenced_vertices(self) -> Bool[np.ndarray, " n"]:
        """A mask (n,), True for vertices with at least one face, False for unreferenced vertices."""
        referenced = np.zeros(len(self.vertices), dtype=bool)
        referenced[self.faces] = True
        return referenced

    @cached_property
    def referenced_indices(self) -> Int64[np.ndarray, " u"]:
        """The indices of the referenced vertices (u,), ascending."""
        return np.flatnonzero(self.referenced_vertices)

    @cached_property
    def middle(self) -> Float64[np.ndarray, " 3"]:
        """The mean position of the referenced vertices (3,)."""
        return self.vertices[self.referenced_indices].mean(axis=0)

    def compact(self) -> tuple[Float64[np.ndarray, "u 3"], Int64[np.ndarray, "f 3"]]:
        """Return the positions of the referenced vertices, and the faces as rows of these positions."""
        number = np.cumsum(self.referenced_vertices) - 1
        return self.vertices[self.referenced_indices], number[self.faces]

    def spread(self, rows: Shaped[np.ndarray, "u ..."]) -> Shaped[np.ndarray, "n ..."]:
        """Return rows of the referenced vertices (u, ...) as rows of all vertices, with zeros elsewhere."""
        if len(rows) == len(self.vertices):
            return rows
        everywhere = np.zeros((len(self.vertices), *rows.shape[1:]), rows.dtype)
        everywhere[self.referenced_indices] = rows
        return everywhere

    @cached_property
    def degenerate_faces(self) -> Bool[np.ndarray, " f"]:
        """A mask (f,), True for triangles whose height is at most 1e-10 of their longest edge."""
        longest = igl.squared_edge_lengths(self.vertices, self.faces).max(axis=1)
        return 2 * self.face_areas <= DEGENERATE_HEIGHT * longest

    def without_faces(self, removed: Bool[np.ndarray, " f"]) -> Mesh:
        """Return the mesh without the faces of a mask (f,). Vertices keep their numbers."""
        dropped = np.union1d(self.dropped_faces, self.face_numbers[removed])
        return replace(self, faces=self.faces[~removed], dropped_faces=dropped)

    @cached_property
    def edges(self) -> Int64[np.ndarray, "e 2"]:
        """The edges (e, 2) in lexicographic order. The lower vertex index of each edge is first."""
        return self._edge_table.edges

    def lengths(self, edges: Int64[np.ndarray, "b 2"]) -> Float64[np.ndarray, " b"]:
        """Return the lengths of edges, given as pairs of vertices."""
        return np.linalg.norm(np.diff(self.vertices[edges], axis=1)[:, 0], axis=1)

    @cached_property
    def boundary_edges(self) -> Int64[np.ndarray, "b 2"]:
        """The edges with exactly one face, (b, 2)."""
        return self.edges[self._edge_table.faces == 1]

    @cached_property
    def boundary_vertices(self) -> Bool[np.ndarray, " n"]:
        """A mask (n,), True for the ends of boundary edges."""
        at_boundary = np.zeros(len(self.vertices), dtype=bool)
        at_boundary[self.boundary_edges] = True
        return at_boundary

    @cached_property
    def nonmanifold_edges(self) -> Int64[np.ndarray, "b 2"]:
        """The edges with more than two faces, (b, 2)."""
        return self.edges[self._edge_table.faces > 2]

    @cached_property
    def misoriented_edges(self) -> Int64[np.ndarray, "b 2"]:
        """The edges that both of their two faces traverse in the same direction, (b, 2)."""
        return self.edges[(self._edge_table.faces == 2) & (self._edge_table.balance != 0)]

    @cached_property
    def nonmanifold_vertices(self) -> Bool[np.ndarray, " n"]:
        """A mask (n,), True for vertices whose faces form several fans that share no edge."""
        one_fan = igl.is_vertex_manifold(self.faces)
        pinched = self.referenced_vertices.copy()
        pinched[: len(one_fan)] &= ~one_fan
        return pinched

    @cached_property
    def _edge_table(self) -> _EdgeTable:
        """The edges, their numbers of faces, and how many more faces traverse them one way than the other."""
        n = len(self.vertices)
        tail, head, _ = sides_of(self.faces)
        key = np.minimum(tail, head) * n + np.maximum(tail, head)
        key, edge_of_side, faces = np.unique(key, return_inverse=True, return_counts=True)
        balance = np.bincount(edge_of_side, weights=np.sign(head - tail))
        return _EdgeTable(np.stack(np.divmod(key, n), axis=1), faces, balance)

    def faces_around(
        self, vertices: Int64[np.ndarray, " q"]
    ) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
        """Return all pairs of a given vertex and a face around it: rows of `vertices` (p,) and faces (p,)."""
        faces = np.argsort(self.faces.ravel(), kind="stable") // 3
        counts = np.bincount(self.faces.ravel(), minlength=len(self.vertices))
        first = np.cumsum(counts) - counts
        rows, position = ranges(first[vertices], counts[vertices])
        return rows, faces[position]

    def sum_at_vertices(self, per_face: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, " n"]:
        """Return the sums of values of faces (f,) over the faces around each vertex (n,)."""
        return np.bincount(self.faces.ravel(), weights=np.repeat(per_face, 3), minlength=len(self.vertices))


class _EdgeTable(NamedTuple):
    edges: Int64[np.ndarray, "e 2"]
    faces: Int64[np.ndarray, " e"]
    balance: Float64[np.ndarray, " e"]


# The attribute of `Diagnosis` for each kind of unusual element, and its name, place and meaning in words.
_UNUSUAL = (
    ("unreferenced_vertices", "unreferenced vertex", " (in no face)", "never chosen as a match"),
    ("boundary_edges", "boundary edge", " in {}", "the surface ends there"),
    ("nonmanifold_edges", "non-manifold edge", " (more than two faces)", "sheets of surface meet there"),
    ("nonmanifold_vertices", "non-manifold vertex", "", "sheets of surface touch in a single point there"),
    ("misoriented_edges", "edge", " between faces of opposite orientation", "normals are unreliable there"),
    ("degenerate_faces", "degenerate triangle", " without area", "corners coincide or lie on a line"),
)


@dataclass(frozen=True)
class Diagnosis:
    """The result of `diagnose`, which counts all unusual elements of a mesh, such as boundary edges.

    An unusual element is not necessarily an error. `str` explains the counts in sentences, one per line.

    **Attributes:**

    - `vertices`, `faces`: the numbers of vertices and of faces.
    - `components`: the number of connected components, without unreferenced vertices.
    - `unreferenced_vertices`: the number of vertices that no face references.
    - `boundary_edges`: the number of edges with exactly one face.
    - `boundary_loops`: the number of connected chains that the boundary edges form.
    - `nonmanifold_edges`: the number of edges with more than two faces.
    - `nonmanifold_vertices`: the number of vertices whose faces form several fans that share no edge.
    - `misoriented_edges`: the number of edges whose two faces have opposite orientations.
    - `degenerate_faces`: the number of triangles whose height is at most 1e-10 of their longest edge.
    """

    vertices: int
    faces: int
    components: int
    unreferenced_vertices: int
    boundary_edges: int
    boundary_loops: int
    nonmanifold_edges: int
    nonmanifold_vertices: int
    misoriented_edges: int
    degenerate_faces: int

    def sentences(self) -> tuple[str, ...]:
        """Return a sentence about the size of the mesh, and one for each kind of unusual element."""
        return self._size(), *(f"{number}: {meaning}." for number, meaning in self._unusual())

    def brief_sentences(self) -> tuple[str, ...]:
        """Return a sentence about the size of the mesh, and one that counts its unusual elements, if any.

        Unreferenced vertices do not count, because the notes of a mesh report them.
        """
        numbers = ", ".join(number for number, _ in replace(self, unreferenced_vertices=0)._unusual())
        return (self._size(), f"Unusual elements: {numbers}.") if numbers else (self._size(),)

    def _size(self) -> str:
        return (
            f"{count_of(self.vertices, 'vertex')}, {count_of(self.faces, 'face')}, "
            f"{count_of(self.components, 'connected component')}, "
            f"{'open' if self.boundary_edges else 'closed'}."
        )

    def _unusual(self) -> list[tuple[str, str]]:
        """Return the count and the meaning, both as text, of each kind of unusual element that occurs."""
        loops = count_of(self.boundary_loops, "loop")
        return [
            (count_of(count, name) + place.format(loops), meaning)
            for attribute, name, place, meaning in _UNUSUAL
            if (count := getattr(self, attribute))
        ]

    def __str__(self) -> str:
        return "\n".join(self.sentences())


def diagnose(mesh: Mesh) -> Diagnosis:
    """Count all unusual elements of a mesh, such as boundary edges and degenerate triangles."""
    unreferenced = len(mesh.vertices) - len(mesh.referenced_indices)
    boundary_chain = connected_components(mesh.boundary_edges, len(mesh.vertices))[1]
    return Diagnosis(
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        components=connected_components(mesh.edges, len(mesh.vertices))[0] - unreferenced,
        unreferenced_vertices=unreferenced,
        boundary_edges=len(mesh.boundary_edges),
        boundary_loops=len(np.unique(boundary_chain[mesh.boundary_edges])),
        nonmanifold_edges=len(mesh.nonmanifold_edges),
        nonmanifold_vertices=int(mesh.nonmanifold_vertices.sum()),
        misoriented_edges=len(mesh.misoriented_edges),
        degenerate_faces=int(mesh.degenerate_faces.sum()),
    )


def connected_components(edges: Int64[np.ndarray, "e 2"], n: int) -> tuple[int, Int32[np.ndarray, " n"]]:
    """Return the number of components of a graph with n vertices, and each vertex's component (n,)."""
    graph = coo_array((np.ones(len(edges), dtype=bool), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return csgraph.connected_components(graph, directed=False)


def components_of_faces(faces: Int64[np.ndarray, "f 3"], n: int) -> tuple[int, Int32[np.ndarray, " n"]]:
    """Return what `connected_components` returns, for the edges of faces."""
    return connected_components(np.concatenate([faces[:, :2], faces[:, 1:]]), n)


def extend_to_unreferenced(mesh_x: Mesh, matches: Shaped[np.ndarray, "m ..."]) -> Shaped[np.ndarray, "m ..."]:
    """Copy to each unreferenced vertex of X the row of the nearest referenced vertex."""
    return extend_from(mesh_x.referenced_vertices, mesh_x, matches)


def extend_from(
    known: Bool[np.ndarray, " n"], mesh: Mesh, values: Shaped[np.ndarray, "n ..."]
) -> Shaped[np.ndarray, "n ..."]:
    """Copy to each vertex outside the mask `known` (n,) the row of the nearest vertex inside it."""
    if known.all():
        return values
    _, nearest = KDTree(mesh.vertices[known]).query(mesh.vertices[~known])
    extended = values.copy()
    extended[~known] = values[known][nearest]
    return extended


def make_mesh(
    vertices: ArrayLike | MeshLike,
    faces: ArrayLike | None = None,
    *,
    name: str = "mesh",
    weld: bool | float = False,
    notes: Sequence[str] = (),
) -> Mesh:
    """Make a mesh from vertices and faces, or from a mesh of another library, after checks and cleaning.

    The function drops faces that repeat a vertex, and faces with the same three vertices as an earlier face.
    Vertices are never dropped or renumbered.

    Scans may contain vertices without a usable position, and small components such as dust. A vertex is lost
    if its position is not finite or is very far away. If at most one vertex in 1000 is lost, the faces of
    lost vertices are dropped, and each lost vertex is moved to the mean of its usable neighbours, or of all
    usable vertices. Otherwise, the checks under "Raises" apply to the lost vertices. Vertices without faces
    do not count: they are always moved if their position is not finite. If one component has at least half of
    the area, the faces of components with less than 1 % of the area are dropped. For closed components, such
    as enclosed bubbles, the limit is 5 %. The vertices of these small components become unreferenced, and
    `jaxsmw.transfer.match_small_components` matches them. All other unreferenced vertices receive the match
    of the nearest vertex.

    **Arguments:**

    - `vertices`: positions (n, 3) of any integer or float type, in any unit. The array is copied. If `faces`
      is None, `vertices` is a mesh of another library: an object with `vertices` and `faces` (trimesh, pyFM,
      geomfum), an object with `points` and `faces` (a `PolyData` of PyVista), or a tuple of both
      (potpourri3d).
    - `faces`: vertex indices (f, 3), 0-based, as integers or as floats with integer values. The array is
      copied.
    - `name`: the name of the mesh in messages.
    - `weld`: whether to merge vertices at the same position. Faces then use only the lowest-numbered vertex
      at each position, and the others become unreferenced. Welding closes seams along which some programs
      duplicate vertices. Vertices at the boundary are also merged if their distance is at most 1 % of the
      shortest edge at both, which rounding can explain. A number is a tolerance in the unit of the vertices:
      vertices at the boundary up to this distance are merged as well, but never the ends of an edge. True
      finds the tolerance from a gap: if many boundary vertices are less than a quarter of the shortest edge
      apart, and no others are less than four times as far apart, they are merged. A note states the distance.
    - `notes`: sentences to which this function appends its own notes.

    **Returns:** A `Mesh`. Its `notes` report how many faces were dropped or changed by welding, lost
    vertices, ignored small components, vertices that appear to be duplicated along a seam, and unreferenced
    vertices.

    **Raises:** `InputError` if an array has a wrong shape or type, a coordinate is not finite, an index is
    out of range, there are no faces, all faces are degenerate, or an object is not a triangle mesh.
    `InputError` is also raised if the extent of the mesh is below 1e-60 or above 1e60, if a vertex is more
    than 1e12 median edge lengths from the origin, or if a vertex of a face is more than 1e6 median edge
    lengths from the middle of the mesh.
    """
    if faces is None:
        vertices, faces = _parts(vertices, name)
    position = numeric_rows(vertices, "vertices", name)
    with np.errstate(over="ignore"):  # wider float types can overflow; `check_extent` reports infinities
        position = np.array(position, dtype=np.float64, order="C")
    triangles = _indices(numeric_rows(faces, "faces", name), len(position), name)
    notes = list(notes)
    lost = lost_vertices(position, triangles)
    if lost.any():
        position = between_neighbors(position, triangles, lost)
    check_extent(position, name)

    if weld is not False:
        if weld is not True:
            check_number("weld", weld)
        lowest, widest = coincident_vertices(position, triangles, weld)
        welded = int((lowest[triangles] != triangles).any(axis=1).sum())
        triangles = lowest[triangles]
        place = f"up to {widest:.3g} apart" if widest else "at the same position"
        notes.append(
            f"Welding changed {count_of(welded, 'face')}: vertices {place} became one."
            if welded
            else "Welding changed nothing: no two vertices of faces have the same position."
        )
    number, about_faces = _distinct_faces(triangles)
    notes += about_faces
    if lost.any():
        with_lost = lost[triangles[number]].any(axis=1)
        number = number[~with_lost]
        notes.append(
            f"{count_of(int(lost.sum()), 'vertex')} without a usable position (not finite, or very far "
            f"away), the first of them number {lost.argmax()} (counted from 0): "
            f"{count_of(int(with_lost.sum()), 'face')} dropped."
        )

    dropped_faces = np.delete(np.arange(len(triangles)), number)
    mesh = Mesh(position, triangles[number], name, dropped_faces=dropped_faces)
    if mesh.degenerate_faces.all():
        raise InputError(
            f"{name}: no triangle has an area, because all corners coincide or lie on a line: "
            "check the positions and the faces."
        )
    _check_resolution(mesh)
    component = connected_components(mesh.edges, len(position))[1][mesh.faces[:, 0]]
    at_boundary = np.asarray(mesh.boundary_vertices[mesh.faces].any(axis=1))
    small, count = in_small_components(component, mesh.face_areas, at_boundary)
    if count:
        notes.append(
            f"{count_of(count, 'small component')} with {mesh.face_areas[small].sum() / mesh.area:.1%} of "
            f"the area left out ({count_of(int(small.sum()), 'face')}): they take no part in the match, but "
            "move with their surroundings."
        )
        mesh = replace(mesh.without_faces(small), small_faces=mesh.faces[small])
    return replace(mesh, notes=(*notes, *_unusual_vertices(mesh)))


def as_mesh(mesh: Mesh | MeshLike, name: str) -> Mesh:
    """Return a `Mesh` unchanged, and any other mesh as the result of `make_mesh`."""
    return mesh if isinstance(mesh, Mesh) else make_mesh(mesh, name=name)


def _distinct_faces(triangles: Int64[np.ndarray, "f 3"]) -> tuple[Int64[np.ndarray, " g"], list[str]]:
    """Return the indices of faces (g,) without repeated vertices or faces, and notes about the others."""
    notes = []
    ordered = np.sort(triangles, axis=1)
    repeating = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if repeating.any():
        notes.append(f"{count_of(int(repeating.sum()), 'face')} dropped because of a repeated vertex.")
    number, ordered = np.flatnonzero(~repeating), ordered[~repeating]
    first = first_equal_rows(ordered) == np.arange(len(ordered))
    if not first.all():
        notes.append(
            f"{count_of(int((~first).sum()), 'face')} dropped because of an earlier face with equal vertices."
        )
    return number[first], notes


def _unusual_vertices(mesh: Mesh) -> list[str]:
    """Return notes about vertices that appear to be duplicated along a seam, and unreferenced vertices."""
    notes = []
    if len(mesh.faces) > 2 and len(mesh.referenced_indices) == mesh.faces.size:
        notes.append(
            f"This is a soup of triangles: no two of its {len(mesh.faces)} triangles share a vertex."
        )
    if seam := int(_split_vertices(mesh).sum()):
        notes.append(
            f"{count_of(seam, 'boundary vertex')} with another boundary vertex at the same position: if the "
            "surface should be closed there, weld it (`weld=True`)."
        )
    if unreferenced := len(mesh.vertices) - len(mesh.referenced_indices):
        notes.append(
            f"{count_of(unreferenced, 'unreferenced vertex')} (in no face) among {len(mesh.vertices)} "
            "vertices."
        )
    return notes


def check_extent(position: Float64[np.ndarray, "n 3"], name: str) -> None:
    """Refuse coordinates that are not finite, and a mesh that is too large or too small for float64."""
    lost = np.flatnonzero(~np.isfinite(position).all(axis=1))
    if len(lost):
        raise InputError(
            f"{name}: a coordinate is not a finite number at {count_of(len(lost), 'vertex')}, the first of "
            f"them number {lost[0]} (counted from 0): repair the positions."
        )
    with np.errstate(over="ignore"):
        extent = float(np.ptp(position, axis=0).max())
    if extent > LARGEST_EXTENT or 0 < extent < SMALLEST_EXTENT:
        raise InputError(
            f"{name}: the mesh measures {extent:.0e} across, which is outside the range from "
            f"{SMALLEST_EXTENT:.0e} to {LARGEST_EXTENT:.0e}: choose another unit."
        )


def _check_resolution(mesh: Mesh) -> None:
    """Refuse a mesh with a vertex so far away that rounding errors are comparable to edge lengths."""
    lengths = mesh.lengths(mesh.edges)
    median = np.median(lengths[lengths > 0])
    middle = np.median(mesh.vertices[mesh.referenced_indices], axis=0)
    for vertices, center, limit, place in (
        (np.arange(len(mesh.vertices)), 0, LARGEST_COORDINATE, "origin"),
        (mesh.referenced_indices, middle, LARGEST_DISTANCE, "middle of the mesh"),
    ):
        distances = np.abs(mesh.vertices[vertices] - center).max(axis=1) / median
        if distances.max() > limit:
            raise InputError(
                f"{mesh.name}: vertex {vertices[distances.argmax()]} (counted from 0) lies "
                f"{distances.max():.0e} median edge lengths from the {place}, where rounding "
                "errors are too large for its triangles: repair the position, or move the mesh to the origin."
            )


def _parts(mesh: MeshLike, name: str) -> tuple[ArrayLike, ArrayLike]:
    """Return the vertices and faces of a mesh of another library, recognised by its attributes."""
    if isinstance(mesh, tuple) and len(mesh) == 2:
        return mesh
    faces = getattr(mesh, "faces", None)
    if faces is not None and hasattr(mesh, "vertices"):
        return mesh.vertices, faces
    if faces is not None and hasattr(mesh, "points"):  # PyVista stores the number of corners before each face
        table = np.asarray(faces)
        if table.ndim == 1:
            if len(table) % 4 or (table[::4] != 3).any():
                raise InputError(f"{name}: not all faces are triangles: triangulate the mesh first.")
            table = table.reshape(-1, 4)[:, 1:]
        return mesh.points, table
    if isinstance(mesh, str | os.PathLike):
        raise InputError(f"{name}: {str(mesh)!r} is a file name: read the file with jaxsmw.read_mesh first.")
    raise InputError(
        f"{name}: {type(mesh).__name__} is not a triangle mesh, because it lacks vertices or faces: give "
        "both, or a mesh of trimesh, pyFM, geomfum or PyVista."
    )


def to_host(values: Any) -> Any:
    """Detach PyTorch tensors and copy them to the host. Other values are returned unchanged."""
    return values.detach().cpu() if hasattr(values, "detach") else values


def numeric_rows(values: ArrayLike, what: str, name: str) -> np.ndarray:
    """Return the values as a non-empty array (number of values, 3) of integers or floats."""
    expected = f"{name}: {what} must be a numeric array of shape (number of {what}, 3)"
    try:
        array = np.asarray(to_host(values))
        if array.dtype == object:  # NumPy stores integers too large for any integer type as objects
            array = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{expected}, but these values cannot be converted to an array.") from None
    if array.size == 0:
        cure = "; triangulate_points makes the faces of a point cloud" if what == "faces" else ""
        raise InputError(f"{name}: there are no {what}: give at least one row{cure}.")
    if array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{expected}, but these values are {array.dtype.name} of shape {array.shape}.")
    return array


def _indices(faces: np.ndarray, n: int, name: str) -> Int64[np.ndarray, "f 3"]:
    """Check that faces are valid indices of n vertices, and return them as int64."""
    # The indices are checked first, because the conversion to int64 would change very large numbers.
    outside = ~((faces >= 0) & (faces < n))
    if outside.any():
        at = int(outside.any(axis=1).argmax())
        cure = "correct the index or restore the missing vertices"
        if faces.min() == 1 and faces.max() == n:
            cure = "the faces seem to count from 1, so subtract 1"
        raise InputError(
            f"{name}: triangle {at} uses vertex {faces[at][outside[at]][0]:.15g}, but the vertices are 0 to "
            f"{n - 1}: {cure}."
        )
    # A plain copy of libigl's arrays would keep their type "long long", which NumPy does not treat as int64.
    triangles = np.empty(faces.shape, np.int64)
    triangles[...] = faces
    if (triangles != faces).any():
        raise InputError(f"{name}: a face has an index that is not a whole number: correct the faces.")
    return triangles


def coincident_vertices(
    position: Float64[np.ndarray, "n 3"], triangles: Int64[np.ndarray, "f 3"], weld: bool | float = 0.0
) -> tuple[Int64[np.ndarray, " n"], float]:
    """Return the lowest-numbered vertex at each vertex's position (n,), and the largest distance of a merged
    pair.

    `weld` is as for `make_mesh`; 0 merges boundary vertices only up to rounding. The distance is 0 if
    rounding can explain all merged pairs.
    """
    n = len(position)
    lowest, widest, limit = first_equal_rows(position), 0.0, 0.0
    while True:
        corners = lowest[triangles]
        whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
        pairs, distances, shortest = _near_vertices(Mesh(position, corners[whole]))
        if weld is True:
            limit = limit or _crack_width(distances / shortest)
            split = distances <= np.maximum(limit, _ROUNDING) * shortest
        else:
            # The ends of an edge are not nearer to each other than the shortest edge is long.
            split = (distances <= np.maximum(weld, _ROUNDING * shortest)) & (distances < shortest)
        if not split.any():
            return lowest, widest
        beyond = split & (distances > _ROUNDING * shortest)
        widest = max(widest, float(distances[beyond].max(initial=0.0)))
        _, group = connected_components(pairs[split], n)
        lowest = np.unique(group, return_index=True)[1][group][lowest]


def _crack_width(relative: Float64[np.ndarray, " b"]) -> float:
    """Return the width of cracks in units of the shortest edges, or 0 if no gap separates them from other
    pairs.

    `relative` contains the distance from each boundary vertex to the nearest other one, in the same unit.
    """
    ordered = np.append(np.sort(np.maximum(relative, _ROUNDING)), np.inf)
    # Without cracks, the nearest vertex is an end of an edge.
    gaps = np.minimum(ordered[1:], 1.0) / ordered[:-1]
    found = np.flatnonzero((ordered[:-1] < _CRACK) & (gaps >= _GAP))
    return float(ordered[found[-1]]) if len(found) else 0.0


def _split_vertices(mesh: Mesh) -> Bool[np.ndarray, " b"]:
    """Return which boundary vertices are so near to another one that rounding can explain it."""
    _, distances, shortest = _near_vertices(mesh)
    return distances <= _ROUNDING * shortest


def _near_vertices(
    mesh: Mesh,
) -> tuple[Int64[np.ndarray, "b 2"], Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]]:
    """Pair each boundary vertex with the nearest other one. Return the pairs, their distances, and the
    shortest edges.

    The shortest edges are those at either vertex of a pair.
    """
    boundary = np.unique(mesh.boundary_edges)
    if not len(boundary):
        return np.empty((0, 2), np.int64), np.empty(0), np.empty(0)
    shortest = np.full(len(mesh.vertices), np.inf)
    lengths = mesh.lengths(mesh.edges)
    np.minimum.at(shortest, mesh.edges, lengths[:, None])
    distance, nearest = KDTree(mesh.vertices[boundary]).query(mesh.vertices[boundary], k=2)
    pairs = np.stack([boundary, boundary[nearest[:, 1]]], axis=1)
    return pairs, distance[:, 1], shortest[pairs].min(axis=1)
