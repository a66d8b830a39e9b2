"""Meshes are checked and cleaned, have correct properties, and keep their data in all file formats."""

import dataclasses
import errno
import itertools
import math
import os
import re
import struct
from collections import Counter
from pathlib import Path

import igl
import numpy as np
import pytest
import scipy.sparse
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from messages import assert_names, refusal

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Diagnosis, Mesh, coincident_vertices, diagnose, make_mesh
from jaxsmw.io.meshes import read_mesh, write_mesh

OCTAHEDRON = make_mesh(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]],
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    name="octahedron",
)
SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
SQUARE_FACES = [[0, 1, 2], [0, 2, 3]]


def bumpy_grid(side: int, seed: int = 0) -> Mesh:
    """An open sheet with irregular triangles."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) + random.uniform(
        -0.3, 0.3, (side**2, 3)
    )
    i = np.arange(side**2).reshape(side, side)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return make_mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def same_mesh(a: Mesh, b: Mesh) -> bool:
    return a.vertices.tobytes() == b.vertices.tobytes() and np.array_equal(a.faces, b.faces)


@pytest.fixture
def saved(tmp_path):
    """A function that writes a file and returns its path."""

    def save(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return save


# ---------------------------------------------------------------------------------------- make_mesh


@pytest.mark.parametrize(
    "vertex_type", [np.float16, np.float32, np.float64, np.longdouble, np.int8, np.int64]
)
@pytest.mark.parametrize("face_type", [np.int8, np.uint8, np.int32, np.uint64, np.float32])
def test_all_numeric_types_are_accepted(vertex_type, face_type):
    mesh = make_mesh(np.array(SQUARE, vertex_type), np.array(SQUARE_FACES, face_type))
    assert mesh.vertices.dtype == np.float64 and mesh.vertices.tolist() == SQUARE
    assert mesh.faces.dtype == np.int64 and mesh.faces.tolist() == SQUARE_FACES
    assert mesh.notes == ()


def test_arrays_are_copied_and_stored_row_by_row():
    vertices, faces = np.asfortranarray(SQUARE, dtype=float), np.asfortranarray(SQUARE_FACES)
    mesh = make_mesh(vertices, faces)
    vertices[:], faces[:] = 7, 3
    assert mesh.vertices.tolist() == SQUARE and mesh.faces.tolist() == SQUARE_FACES
    assert mesh.vertices.flags.c_contiguous and mesh.faces.flags.c_contiguous


BUMPS = bumpy_grid(4).vertices.tolist()
BUMP_FACES = (bumpy_grid(4).faces + 4).tolist()

BAD_ARRAYS = {
    "no vertices": ([], SQUARE_FACES, "no vertices"),
    "no faces": (SQUARE, [], "no faces"),
    "no faces, right shape": (SQUARE, np.empty((0, 3), int), "no faces"),
    "flat vertices": (np.arange(12.0), SQUARE_FACES, "vertices must be"),
    "plane vertices": (np.ones((4, 2)), SQUARE_FACES, "vertices must be"),
    "stack of vertices": (np.ones((2, 4, 3)), SQUARE_FACES, "vertices must be"),
    "ragged vertices": ([[0, 0, 0], [1, 0]], SQUARE_FACES, "vertices must be"),
    "words": ([["a", "b", "c"]] * 4, SQUARE_FACES, "vertices must be"),
    "complex": (np.array(SQUARE) * 1j, SQUARE_FACES, "vertices must be"),
    "a single number": (np.array(3.0), SQUARE_FACES, "vertices must be"),
    "nan": ([*SQUARE[:3], [np.nan, 0, 0]], SQUARE_FACES, "1 vertex, the first of them number 3"),
    "inf": ([*SQUARE[:3], [0, np.inf, 0]], SQUARE_FACES, "finite"),
    "beyond float64": (np.array(SQUARE, np.longdouble) * np.longdouble("1e4000"), SQUARE_FACES, "finite"),
    "quads": (SQUARE, [[0, 1, 2, 3]], "faces must be"),
    "boolean faces": (SQUARE, np.ones((2, 3), bool), "faces must be"),
    "index too large": (SQUARE, [[0, 1, 2], [0, 1, 4]], "triangle 1 uses vertex 4"),
    "index negative": (SQUARE, [[0, 1, 2], [0, -1, 2]], "triangle 1 uses vertex -1"),
    "index beyond int64": (SQUARE, [[0, 1, 10**30]], "uses vertex 1e+30"),
    "index beyond int64, unsigned": (SQUARE, np.array([[0, 1, 2**64 - 1]], np.uint64), "uses vertex"),
    "index nan": (SQUARE, [[0, 1, np.nan]], "uses vertex nan"),
    "index inf": (SQUARE, [[0, 1, np.inf]], "uses vertex inf"),
    "index fractional": (SQUARE, [[0, 1, 1.5]], "whole number"),
    "counted from 1": (SQUARE, np.array(SQUARE_FACES) + 1, "subtract 1"),
    "all faces repeat a vertex": (SQUARE, [[0, 0, 1], [2, 3, 2]], "no triangle has an area"),
    "on a line": ([[0, 0, 0], [1, 1, 1], [3, 3, 3]], [[0, 1, 2]], "no triangle has an area"),
    "on a slanted line": (np.outer([0, 1, 3], [0.1, 0.7, 0.3]), [[0, 1, 2]], "no triangle has an area"),
    "all at one point": (np.ones((3, 3)), [[0, 1, 2]], "no triangle has an area"),
    "too large": (np.array(SQUARE) * 1e200, SQUARE_FACES, "another unit"),
    "extent beyond float64": ((np.array(SQUARE) * 2.0 - 1) * 1.7e308, SQUARE_FACES, "another unit"),
    "too small": (np.array(SQUARE) * 1e-200, SQUARE_FACES, "another unit"),
    "a corner far away": (
        [*SQUARE[:3], [0, -1e30, 0], *BUMPS],
        [*SQUARE_FACES, *BUMP_FACES],
        "vertex 3 (counted from 0) lies 9e+29 median edge lengths from the origin",
    ),
    "an unreferenced vertex far away": (
        [*SQUARE, [0, 0, 1e13]],
        SQUARE_FACES,
        "vertex 4 (counted from 0) lies 1e+13 median edge lengths from the origin",
    ),
    "a corner far from all others": (
        [*SQUARE[:3], [0, -1e7, 0], *BUMPS],
        [*SQUARE_FACES, *BUMP_FACES],
        "vertex 3 (counted from 0) lies 9e+06 median edge lengths from the middle",
    ),
    "far from the origin": (np.array(SQUARE) + 1e13, SQUARE_FACES, "move the mesh to the origin"),
}


@pytest.mark.parametrize(("vertices", "faces", "fault"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
@pytest.mark.parametrize("weld", [False, True])
def test_invalid_arrays_are_refused_in_one_sentence(vertices, faces, fault, weld):
    with pytest.raises(InputError) as caught:
        make_mesh(vertices, faces, name="my body", weld=weld)
    message = str(caught.value)
    assert message.startswith("my body: ") and fault in message
    assert "\n" not in message and message.endswith(".")


@pytest.mark.parametrize("scale", [1e-20, 1, 1e20])
def test_distant_vertices_are_accepted_within_the_limits(scale):
    for vertices in (np.array(SQUARE) + 1e11, [*SQUARE, [1e11, 0, 0]], [*SQUARE[:3], [0, 1e5, 0]]):
        mesh = make_mesh(np.array(vertices) * scale, SQUARE_FACES)
        np.testing.assert_array_equal(mesh.vertices, np.array(vertices) * scale)


def test_cleaning_drops_faces_and_keeps_vertices():
    faces = [[0, 1, 2], [2, 1, 0], [1, 1, 3], [0, 2, 3], [3, 0, 2], [0, 1, 2]]
    mesh = make_mesh([*SQUARE, [9, 9, 9]], faces, notes=["From afar."])
    assert mesh.faces.tolist() == SQUARE_FACES, "the first of several equal faces must keep its place"
    assert len(mesh.vertices) == 5 and mesh.referenced_vertices.tolist() == [True] * 4 + [False]
    given, repeated, equal, unreferenced = mesh.notes
    assert given == "From afar."
    assert_names(repeated, "1 face dropped", "repeated vertex")
    assert_names(equal, "3 faces dropped", "equal vertices")
    assert_names(unreferenced, "1 unreferenced vertex", "5 vertices")


def unwelded(mesh: Mesh) -> Mesh:
    """The same surface with three separate vertices for each face."""
    return make_mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3))


def test_welding_closes_a_seam_without_renumbering():
    seam = unwelded(OCTAHEDRON)
    assert diagnose(seam).components == 8
    assert any("24 boundary vertices" in note and "weld=True" in note for note in seam.notes)

    welded = make_mesh(seam.vertices, seam.faces, weld=True)
    assert welded.vertices.tobytes() == seam.vertices.tobytes()
    assert np.array_equal(welded.vertices[welded.faces], seam.vertices[seam.faces])
    found = diagnose(welded)
    assert (found.components, found.boundary_edges, found.unreferenced_vertices) == (1, 0, 18)
    # Among vertices at the same position, faces use the vertex with the lowest number.
    for i in np.flatnonzero(welded.referenced_vertices):
        assert i == (seam.vertices == seam.vertices[i]).all(axis=1).argmax()
    assert any("Welding changed" in note for note in welded.notes)
    assert not any("weld=True" in note for note in welded.notes)


@pytest.mark.parametrize(("gap", "joined"), [(1e-15, True), (1e-3, True), (-1e-3, True), (0.02, False)])
def test_welding_joins_positions_that_differ_by_rounding_and_both_zeros_are_equal(gap, joined):
    """Rounding splits a vertex if the gap is at most a hundredth of the shortest edge."""
    vertices = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [1 + gap, 0, 0], [0, -1, 0]]
    faces = [[0, 1, 2], [3, 5, 4]]
    welded = make_mesh(vertices, faces, weld=0.0)
    assert welded.faces.tolist() == [[0, 1, 2], [0, 5, 1 if joined else 4]]
    assert welded.vertices.tolist() == vertices
    reported = sum("4 boundary vertices" in note for note in make_mesh(vertices, faces).notes)
    assert reported == joined and not any("weld=True" in note for note in welded.notes)


def test_rounding_never_closes_a_short_edge():
    """A small triangle lies at the corner of a large one, whose edges are 500 times longer."""
    vertices = [[0, 0, 0], [100, 0, 0], [0, 100, 0], [0.2, 0, 0], [0.4, 0, 0], [0.2, -0.2, 0]]
    lowest, widest = coincident_vertices(np.array(vertices), np.array([[0, 1, 2], [3, 5, 4]]))
    assert lowest.tolist() == [*range(6)] and widest == 0


def cracked(width: float) -> tuple[np.ndarray, np.ndarray]:
    """A grid of 1 x 1 squares, cut along the middle into halves that are apart by a width with 30 % of noise."""
    x, y = np.meshgrid(np.arange(11.0), np.arange(6.0))
    left = np.stack([x.ravel(), y.ravel(), np.zeros(66)], axis=1)
    noise = np.random.default_rng(0).uniform(0.7, 1, size=66)
    right = left + np.stack([10 + width * noise, np.zeros(66), np.zeros(66)], axis=1)
    corner = (np.arange(10) + 11 * np.arange(5)[:, None]).ravel()[:, None]
    faces = np.concatenate([corner + np.array([0, 1, 12]), corner + np.array([0, 12, 11])])
    return np.concatenate([left, right]), np.concatenate([faces, faces + 66])


@pytest.mark.parametrize(
    ("width", "weld", "joined"),
    [
        (0.0, True, True),
        (0.005, 0.0, True),
        (0.05, 0.0, False),
        (0.05, True, True),
        (0.15, True, True),
        (0.24, True, True),
        (0.5, True, False),
        (0.5, 0.3, False),
        (0.5, 0.6, True),
        (0.05, 0.02, False),
        (0.5, 100.0, True),
    ],
)
def test_cracks_are_welded_up_to_the_tolerance_or_the_gap(width, weld, joined):
    vertices, faces = cracked(width)
    mesh = make_mesh(vertices, faces, weld=weld)
    assert diagnose(mesh).components == (1 if joined else 2)
    assert len(mesh.faces) == len(faces) and mesh.vertices.tobytes() == vertices.tobytes()
    said = re.search(r"vertices up to (0\.\d+) apart became one", " ".join(mesh.notes))
    assert bool(said) == (joined and width > 0.01)
    assert said is None or 0.9 * width < float(said[1]) <= width


def test_lips_at_all_distances_stay_apart():
    """Without a gap between the widths of a slit and the lengths of edges, only rounding is closed."""
    vertices, faces = cracked(0.0)
    vertices[66::11, 0] += np.array([0.0, 0.02, 0.06, 0.15, 0.3, 0.9])
    mesh = make_mesh(vertices, faces, weld=True)
    assert diagnose(mesh).components == 1
    assert "at the same position became one" in " ".join(mesh.notes)


@pytest.mark.parametrize("weld", [-1.0, math.nan, math.inf])
def test_impossible_tolerances_are_refused(weld):
    with pytest.raises(InputError, match=r"weld is .*give a finite number of at least 0"):
        make_mesh(*cracked(0.1), weld=weld)


def test_a_soup_of_triangles_is_named():
    soup = unwelded(OCTAHEDRON)
    assert "This is a soup of triangles: no two of its 8 triangles share a vertex." in " ".join(soup.notes)
    apart = make_mesh(soup.vertices + 3 * np.repeat(np.arange(8.0), 3)[:, None], soup.faces)
    assert "no two of its 8 triangles share a vertex." in " ".join(apart.notes)
    assert "soup" not in " ".join(make_mesh(soup.vertices, soup.faces, weld=True).notes)


@pytest.mark.parametrize("stray", [np.nan, np.inf, -np.inf])
def test_vertices_without_faces_need_no_position(stray):
    mesh = make_mesh([*SQUARE, *[[stray, 0, 0]] * 9], SQUARE_FACES)
    assert mesh.faces.tolist() == SQUARE_FACES and mesh.vertices[:4].tolist() == SQUARE
    assert np.isfinite(mesh.vertices).all() and len(mesh.vertices) == 13
    assert (
        "9 vertices" in mesh.notes[0] and "number 4" in mesh.notes[0] and "0 faces dropped" in mesh.notes[0]
    )


def test_no_seam_is_reported_away_from_boundaries():
    vertices = np.concatenate([OCTAHEDRON.vertices, OCTAHEDRON.vertices])
    mesh = make_mesh(vertices, np.concatenate([OCTAHEDRON.faces, OCTAHEDRON.faces + 6]))
    assert mesh.notes == ()


# --------------------------------------------------------------------------------------- properties


@pytest.fixture(params=["octahedron", "grid", "two sheets and a loose vertex"])
def mesh(request) -> Mesh:
    grid = bumpy_grid(6)
    if request.param == "two sheets and a loose vertex":
        vertices = np.concatenate([grid.vertices, [[7.0, 7, 7]], grid.vertices + np.array([0, 0, 3])])
        return make_mesh(vertices, np.concatenate([grid.faces, grid.faces + 37]))
    return grid if request.param == "grid" else OCTAHEDRON


def test_areas_and_normals_agree_with_libigl(mesh):
    assert np.allclose(2 * mesh.face_areas, igl.doublearea(mesh.vertices, mesh.faces), rtol=1e-13, atol=0)
    lumped = scipy.sparse.csc_matrix(
        igl.massmatrix(mesh.vertices, mesh.faces, igl.MASSMATRIX_TYPE_BARYCENTRIC)
    ).diagonal()
    assert np.allclose(mesh.vertex_areas, lumped, rtol=1e-13, atol=0)
    assert mesh.vertex_areas.sum() == pytest.approx(mesh.area, rel=1e-13)
    used = mesh.referenced_vertices
    normals = igl.per_vertex_normals(mesh.vertices, mesh.faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA)
    assert np.allclose(mesh.vertex_normals[used], normals[used], atol=1e-13)
    assert (mesh.vertex_normals[~used] == 0).all() and (mesh.vertex_areas[~used] == 0).all()


def test_edges_agree_with_a_plain_count(mesh):
    count = Counter(
        (min(i, j), max(i, j)) for a, b, c in mesh.faces.tolist() for i, j in ((a, b), (b, c), (c, a))
    )
    assert mesh.edges.tolist() == [list(edge) for edge in sorted(count)]
    assert mesh.boundary_edges.tolist() == [list(edge) for edge in sorted(count) if count[edge] == 1]


def test_properties_of_an_octahedron_follow_closed_forms():
    assert OCTAHEDRON.area == pytest.approx(4 * np.sqrt(3), rel=1e-15)
    assert np.allclose(OCTAHEDRON.vertex_areas, 2 / np.sqrt(3), rtol=1e-15)
    assert np.allclose(OCTAHEDRON.vertex_normals, OCTAHEDRON.vertices, atol=1e-15)
    assert diagnose(OCTAHEDRON) == Diagnosis(6, 8, 1, 0, 0, 0, 0, 0, 0, 0)
    assert str(diagnose(OCTAHEDRON)) == "6 vertices, 8 faces, 1 connected component, closed."


def test_normals_are_zero_where_they_cancel():
    # The front consists of one triangle and the back of two triangles, so rounding leaves a residue.
    corners = np.array(
        [[0.1, 0.2, 0.3], [1, 0, 0.5], [0, 1, 0.7], [1, 0, 0.5], [0, 1, 0.7], [0.3, 0.7, 0.64]]
    )
    mesh = make_mesh(corners, [[0, 1, 2], [0, 5, 3], [0, 4, 5]])
    assert mesh.area_vectors.sum(axis=0).any(), "without rounding errors the test is trivial"
    assert (mesh.vertex_normals[0] == 0).all()
    assert np.allclose(np.linalg.norm(mesh.vertex_normals[1:], axis=1), 1)


def test_properties_are_computed_once():
    mesh = bumpy_grid(4)
    for name in (
        "face_areas",
        "area",
        "vertex_areas",
        "vertex_normals",
        "referenced_vertices",
        "degenerate_faces",
    ):
        assert getattr(mesh, name) is getattr(mesh, name)
    assert mesh.edges is mesh.edges and mesh.boundary_edges is mesh.boundary_edges


def fan(center: int, ring: list[int]) -> list[list[int]]:
    return [[center, i, j] for i, j in itertools.pairwise(ring)]


POINTS = np.random.default_rng(5).normal(size=(12, 3))
DIAGNOSES = {
    "three faces at an edge": (
        [[0, 1, 2], [1, 0, 3], [0, 1, 4]],
        dict(nonmanifold_edges=1, boundary_edges=6),
    ),
    "two fans at a vertex": (
        fan(0, [1, 2, 3]) + fan(0, [4, 5, 6]),
        dict(nonmanifold_vertices=1, boundary_edges=8, boundary_loops=1),
    ),
    "a flipped face": ([[0, 1, 2], [0, 2, 3], [0, 4, 3]], dict(misoriented_edges=1, boundary_edges=5)),
    "two components": (
        [[0, 1, 2], [5, 6, 7]],
        dict(components=2, boundary_edges=6, boundary_loops=2, unreferenced_vertices=6),
    ),
    "a Moebius strip": (
        [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 1], [5, 0, 1]],
        dict(misoriented_edges=1, boundary_edges=6, boundary_loops=1),
    ),
    "a ring": (
        [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4], [2, 0, 5], [0, 3, 5]],
        dict(boundary_edges=6, boundary_loops=2, misoriented_edges=0),
    ),
}


@pytest.mark.parametrize(("faces", "expected"), DIAGNOSES.values(), ids=DIAGNOSES)
def test_diagnose_counts_defects(faces, expected):
    found = dataclasses.asdict(diagnose(make_mesh(POINTS, faces)))
    usual = dict(
        vertices=12, faces=len(faces), components=1, boundary_edges=0, boundary_loops=1, nonmanifold_edges=0,
        nonmanifold_vertices=0, misoriented_edges=0, degenerate_faces=0,
        unreferenced_vertices=12 - len(np.unique(faces)),
    )  # fmt: skip
    assert found == usual | expected


def test_each_finding_has_one_sentence():
    vertices = np.concatenate([POINTS, [POINTS[0] * 0.5 + POINTS[1] * 0.5]])
    faces = [[0, 1, 2], [1, 0, 3], [0, 1, 4], [5, 6, 7], [5, 6, 8], [5, 9, 10], [0, 1, 12]]
    sentences = diagnose(make_mesh(vertices, faces)).sentences()
    for sentence, part in zip(
        sentences,
        ["13 vertices, 7 faces, 2 connected components, open.", "1 unreferenced vertex (in no face): never",
         "15 boundary edges in 2 loops", "1 non-manifold edge (", "1 non-manifold vertex:",
         "1 edge between faces of opposite orientation", "1 degenerate triangle without area"],
        strict=True,
    ):  # fmt: skip
        assert sentence.startswith(part) and sentence.endswith(".") and "\n" not in sentence


def test_brief_sentences_contain_all_numbers_that_the_notes_do_not():
    vertices = np.concatenate([POINTS, [POINTS[0] * 0.5 + POINTS[1] * 0.5]])
    faces = [[0, 1, 2], [1, 0, 3], [0, 1, 4], [5, 6, 7], [5, 6, 8], [5, 9, 10], [0, 1, 12]]
    mesh = make_mesh(vertices, faces)
    counts, unusual = diagnose(mesh).brief_sentences()
    assert_names(counts, "13 vertices", "7 faces", "2 connected components", "open")
    assert_names(unusual, "15 boundary edges in 2 loops", "1 non-manifold edge", "1 non-manifold vertex")
    assert_names(unusual, "1 edge between faces of opposite orientation", "1 degenerate triangle")
    assert "1 unreferenced vertex (in no face) among 13 vertices." in mesh.notes
    assert diagnose(OCTAHEDRON).brief_sentences() == diagnose(OCTAHEDRON).sentences()


def test_degenerate_faces_are_found_at_any_scale():
    heights = np.array([0, 1e-14, 1e-11, 1e-9, 1e-3])
    for scale in (1e-55, 1e-6, 1, 1e6, 1e55):
        vertices = np.concatenate([[[0, 0, 0], [1, 0, 0]], [[0.5, h, 0] for h in heights]]) * scale
        mesh = make_mesh(vertices, [[0, 1, 2 + i] for i in range(len(heights))])
        assert mesh.degenerate_faces.tolist() == [True, True, True, False, False]


@given(seed=st.integers(0, 2**32 - 1), log_scale=st.floats(-20, 20))
@settings(max_examples=30, deadline=None)
def test_properties_are_invariant_to_renumbering_motion_and_scale(seed, log_scale):
    random = np.random.default_rng(seed)
    mesh = make_mesh(
        random.normal(size=(30, 3)), np.stack([random.choice(30, 3, replace=False) for _ in range(40)])
    )
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    renumber, scale = random.permutation(30), 10.0**log_scale
    moved_vertices = np.empty((30, 3))
    moved_vertices[renumber] = (mesh.vertices @ rotation.T + random.normal(size=3)) * scale
    turned = [np.roll(face, random.integers(3)) for face in renumber[mesh.faces]]
    moved = make_mesh(moved_vertices, random.permutation(turned))

    assert diagnose(moved) == diagnose(mesh)
    assert np.allclose(moved.vertex_areas[renumber], mesh.vertex_areas * scale**2, rtol=1e-9, atol=0)
    assert np.allclose(moved.vertex_normals[renumber], mesh.vertex_normals @ rotation.T, atol=1e-8)
    assert set(map(tuple, moved.edges.tolist())) == set(
        map(tuple, np.sort(renumber[mesh.edges], axis=1).tolist())
    )


# ------------------------------------------------------------------------------------------ reading

PLY_CODES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
    "f4": "float", "f8": "double",
}  # fmt: skip


def ply(encoding: str, elements, newline: str = "\n") -> bytes:
    """Return a PLY file. An element is (name, [(property, type, length type or None)], rows of values)."""
    order = ">" if "big" in encoding else "<"
    header, body = ["ply", f"format {encoding} 1.0", "comment made by hand"], b""
    for name, properties, rows in elements:
        header.append(f"element {name} {len(rows)}")
        for column, kind, length in properties:
            header.append(
                f"property {f'list {PLY_CODES[length]} ' if length else ''}{PLY_CODES[kind]} {column}"
            )
        for row in rows:
            words = []
            for (_, kind, length), value in zip(properties, row, strict=True):
                values = np.atleast_1d(value)
                if length:
                    words.append(str(len(values)))
                    body += np.array(len(values), order + length).tobytes() if encoding != "ascii" else b""
                words += [repr(v) for v in values.tolist()]
                body += values.astype(order + kind).tobytes() if encoding != "ascii" else b""
            body += (" ".join(words) + newline).encode() if encoding == "ascii" else b""
    return newline.join([*header, "end_header", ""]).encode() + body


PLY_ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
XYZ = [("x", "f8", None), ("y", "f8", None), ("z", "f8", None)]
CORNERS = [("vertex_indices", "i4", "u1")]

SQUARE_FILES = {
    "plain.off": "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "no end of line.off": "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3",
    "no edge count.off": "OFF\n4 2\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "one-line header.off": "OFF 4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "header without space.off": "OFF4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "UPPER.OFF": "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "dos.off": "OFF\r\n4 2 0\r\n0 0 0\r\n1 0 0\r\n1 1 0\r\n0 1 0\r\n3 0 1 2\r\n3 0 2 3\r\n",
    "old mac.off": "OFF\r4 2 0\r0 0 0\r1 0 0\r1 1 0\r0 1 0\r3 0 1 2\r3 0 2 3\r",
    "byte order mark.off": "\ufeffOFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "comments.off":
        "# Grüße\n\nOFF # counts\n\n 4 2 0 # four\n0 0 0\n\n1\t0  0 # one\n1e0 1. 0\n#\n0 1 0\n"
        "3 0 1 2\n  \n3 0 2 3 #\n#",
    "face colours.off": "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 255 0 0\n3 0 2 3 0.5 0.5 0.5 1\n",
    "colours.off":
        "COFF\n4 2 0\n0 0 0 255 0 0 255\n1 0 0 9 9 9 9\n1 1 0 1 2 3 4\n0 1 0 1 1 1 1\n3 0 1 2\n3 0 2 3\n",
    "normals.off": "NOFF\n4 2 0\n0 0 0 0 0 1\n1 0 0 0 0 1\n1 1 0 0 0 1\n0 1 0 0 0 1\n3 0 1 2\n3 0 2 3\n",
    "all.off": "STCNOFF\n4 2 0\n0 0 0 0 0 1\n1 0 0 0 0 1\n1 1 0 0 0 1\n0 1 0 0 0 1\n3 0 1 2\n3 0 2 3\n",
    "quad.off": "OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n",
    "plain.obj": "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n",
    "no end of line.obj": "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4",
    "quad.obj": "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n",
    "negative.obj": "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 3 -1\n",
    "faces first.obj": "f 1 2 3\nf 1 3 4\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n",
    "texture.obj": "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf 1/1 2/1 3/1\nf 1/1/1 3//1 4\n",
    "texture, negative.obj":
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nf -4/-1 -3/-1 -2/-1\nf -4/-1/-1 -2//-1 -1\n",
    "weights and colours.obj": "v 0 0 0 1\nv 1 0 0 .5 .5 .5\nv 1 1 0\nv 0 1 0 1 1 1 1\nf 1 2 3\nf 1 3 4\n",
    "clutter.obj":
        "# v 9 9 9\nmtllib f.mtl\no body\n  v\t0 0 0\nv 1 0 0 # one\ng a\r\nv 1 1 \\\n0\ns off\n"
        "usemtl f\nv 0 1 0\nvp 1 1\nl 1 2\np 1\nf 1 2\\\r\n 3\nf 1 3 4\n",
    **{
        f"{encoding}{newline!a} {'quad' if quad else 'triangles'}.ply": ply(
            encoding,
            [("vertex", XYZ, SQUARE),
             ("face", CORNERS, [[face] for face in ([[0, 1, 2, 3]] if quad else SQUARE_FACES)])],
            newline,
        )
        for encoding in PLY_ENCODINGS
        for newline in ("\n", "\r\n", "\r")
        for quad in (False, True)
    },
    **{
        f"{encoding} clutter.ply": ply(
            encoding,
            [
                ("camera", [("fov", "f4", None)], [[0.5]]),
                ("face",
                 [("flags", "u1", None), ("uv", "f4", "u1"), ("vertex_index", "u2", "i4"),
                  ("tail", "i2", None)],
                 [[1, [], [0, 1, 2], -1], [2, [0.5, 0.25], [0, 2, 3], -2]]),
                ("tristrips", [("strip", "i4", "i4")], [[[1, 2, 3, -1]]]),
                ("vertex",
                 [("red", "u1", None), ("z", "f4", None), ("bones", "u1", "u1"), ("y", "i2", None),
                  ("x", "f8", None)],
                 [[255, z, [7] * k, y, x] for k, (x, y, z) in enumerate(SQUARE)]),
                ("nothing", [("x", "f4", None)], []),
            ],
        )
        for encoding in PLY_ENCODINGS
    },
}  # fmt: skip


@pytest.mark.parametrize("name", SQUARE_FILES)
def test_all_files_of_a_square_give_the_same_mesh(saved, name):
    mesh = read_mesh(saved(name.replace("\\", ""), SQUARE_FILES[name]))
    assert mesh.vertices.tolist() == SQUARE and mesh.faces.tolist() == SQUARE_FACES
    assert (mesh.notes != ()) == ("quad" in name)


def test_the_name_is_the_path(saved):
    path = saved("a.off", SQUARE_FILES["plain.off"])
    assert read_mesh(path).name == str(path) == read_mesh(str(path)).name


def polygons_of(mixed: str) -> list[list[int]]:
    return {"hexagon": [[0, 1, 2, 3, 4, 5]], "mixed": [[0, 1, 2], [0, 2, 3, 4], [5, 4, 3, 2, 1], [1, 0, 5]]}[
        mixed
    ]


@pytest.mark.parametrize("form", ["off", "obj", *PLY_ENCODINGS])
@pytest.mark.parametrize("polygons", ["hexagon", "mixed"])
def test_polygons_become_fans_in_order(saved, form, polygons):
    faces = polygons_of(polygons)
    vertices = POINTS[:6].tolist()
    if form == "off":
        lines = [f"OFF\n6 {len(faces)} 0", *(" ".join(map(repr, v)) for v in vertices)]
        content = "\n".join(lines + [" ".join(map(str, [len(face), *face])) for face in faces])
    elif form == "obj":
        content = "\n".join(
            ["v " + " ".join(map(repr, v)) for v in vertices]
            + ["f " + " ".join(str(i + 1) for i in face) for face in faces]
        )
    else:
        content = ply(form, [("vertex", XYZ, vertices), ("face", CORNERS, [[face] for face in faces])])
    mesh = read_mesh(saved(f"p.{form if form in ('off', 'obj') else 'ply'}", content))
    assert mesh.vertices.tolist() == vertices
    assert mesh.faces.tolist() == [[f[0], f[i], f[i + 1]] for f in faces for i in range(1, len(f) - 1)]
    assert len(mesh.notes) == 1 and "more than three corners" in mesh.notes[0]


def binary_stl(corners: np.ndarray, count: int | None = None, header: bytes = b"") -> bytes:
    facets = b"".join(bytes(12) + c.astype("<f4").tobytes() + bytes(2) for c in corners)
    return header.ljust(80, b" ") + struct.pack("<I", len(corners) if count is None else count) + facets


def text_stl(corners: np.ndarray) -> str:
    lines = ["solid body #1"]
    for facet in corners.tolist():
        lines += ["facet normal 0 0 0", "  outer loop"]
        lines += [f"    vertex {x!r} {y!r} {z!r}" for x, y, z in facet]
        lines += ["  endloop", "endfacet"]
    return "\n".join([*lines, "endsolid body", ""])


@pytest.mark.parametrize("form", ["binary", "binary that says solid", "text", "TEXT", "text in one line"])
def test_stl_corners_are_merged_in_order_of_appearance(saved, form):
    corners = np.array(SQUARE, float)[[[2, 3, 0], [0, 1, 2]]]
    corners[1, 0] = -0.0  # the same position as 0.0
    content = {
        "binary": binary_stl(corners),
        "binary that says solid": binary_stl(corners, header=b"solid facet"),
        "text": text_stl(corners),
        "TEXT": text_stl(corners).upper(),
        "text in one line": text_stl(corners).replace("\n", " ").replace("#1", ""),
    }[form]
    mesh = read_mesh(saved("s.stl", content))
    assert mesh.vertices.tolist() == [[1, 1, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 3, 0]]
    assert len(mesh.notes) == 1 and "4 vertices, numbered by first appearance" in mesh.notes[0]


def test_welding_reports_that_it_changed_nothing(saved):
    """The reader already merges equal corners of an STL file."""
    path = saved("s.stl", binary_stl(np.array(SQUARE)[SQUARE_FACES]))
    plain, welded = read_mesh(path), read_mesh(path, weld=True)
    assert same_mesh(plain, welded) and diagnose(plain).components == 1
    *notes, last = welded.notes
    assert tuple(notes) == plain.notes
    assert_names(last, "welding changed nothing", "same position")
    mesh = make_mesh([*SQUARE, SQUARE[0]], SQUARE_FACES, weld=True)
    assert mesh.faces.tolist() == SQUARE_FACES and "Welding changed nothing" in mesh.notes[0]


@pytest.mark.parametrize("suffix", ["off", "obj", "ply", "stl"])
def test_files_written_by_trimesh_are_read(tmp_path, suffix):
    mesh = bumpy_grid(9)
    path = tmp_path / f"m.{suffix}"
    exporter = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert len(exporter.vertex_normals) == len(mesh.vertices)  # computes the normals to export
    exporter.export(path)
    again = read_mesh(path)
    if suffix == "stl":
        assert np.allclose(again.vertices[again.faces], mesh.vertices[mesh.faces], rtol=1e-6)
        assert len(again.vertices) == len(mesh.vertices)
    else:
        assert np.allclose(again.vertices, mesh.vertices, rtol=1e-6)
        assert np.array_equal(again.faces, mesh.faces)


def test_reading_cleans_and_welds(saved):
    vertices = "0 0 0\n1 0 0\n1 1 0\n0 0 0\n1 1 0\n0 1 0\n5 5 5\n"
    path = saved("s.off", f"OFF\n7 4 0\n{vertices}3 0 1 2\n3 3 4 5\n3 1 2 0\n3 0 0 1\n")
    mesh = read_mesh(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 5]] and len(mesh.notes) == 4
    welded = read_mesh(path, weld=True)
    assert welded.faces.tolist() == [[0, 1, 2], [0, 2, 5]] and np.array_equal(welded.vertices, mesh.vertices)


# ----------------------------------------------------------------------------------- hostile files

T = "0 0 0\n1 0 0\n0 1 0\n"
V = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
TRIANGLE = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACE = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
PLY_BINARY = ply("binary_little_endian", [("vertex", XYZ, TRIANGLE[0]), ("face", CORNERS, [[[0, 1, 2]]])])

PLY_STRIPS = "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"

# Flaws that matching does not need to refuse: name: (content, faces, what a note must name).
FORGIVEN = {
    "face of two.off": (f"OFF\n3 2 0\n{T}3 0 1 2\n2 0 1\n", [[0, 1, 2]], "1 face with 2 corners"),
    "face of two first.obj": (V + "f 1 2\nf 1/1 2/2 3/3\nf 2 3\n", [[0, 1, 2]], "2 faces with 2 corners"),
    "line and face.obj": (V + "l 1 2\nf 1 2 3\n", [[0, 1, 2]], ""),
    "texture without vt.obj": (V + "f 1/1 2/2 3/3\n", [[0, 1, 2]], "texture vertex 1, but the file has 0 vt lines"),
    "unreferenced nan.obj": (V + "v nan nan nan\nf 1 2 3\n", [[0, 1, 2]], "number 3"),
    "unreferenced inf.off": (f"OFF\n4 1 0\n{T}1e999 0 0\n3 0 1 2\n", [[0, 1, 2]], "number 3"),
    "face of two.ply": (
        PLY_HEAD + PLY_FACE.replace("face 1", "face 2") + T + "2 0 1\n3 0 1 2\n", [[0, 1, 2]], "1 face with 2 corners"
    ),
    "padded.ply": (PLY_BINARY + bytes(64), [[0, 1, 2]], ""),
    "strips.ply": (
        PLY_HEAD.replace("vertex 3", "vertex 5") + PLY_STRIPS.replace("tristrips 1", "tristrips 2") + T
        + "1 1 0\n2 2 2\n6 0 1 2 3 -1 4\n7 -1 2 1 4 -1 0 1\n",
        [[0, 1, 2], [2, 1, 3], [2, 1, 4]], "",
    ),
    "faces and strips.ply": (
        PLY_HEAD + PLY_FACE.replace("end_header", "property int part\n" + PLY_STRIPS[:-1]) + T.replace("0 1 0", "0 1 5")
        + "3 0 1 2 7\n3 1 0 2\n", [[0, 1, 2]], "'part'",
    ),
    "without end.stl": (text_stl(TRIANGLE).replace("endsolid", ""), [[0, 1, 2]], "endsolid"),
    "bytes behind.stl": (binary_stl(TRIANGLE) + bytes(64), [[0, 1, 2]], "64 bytes"),
    "one byte behind, says solid.stl": (binary_stl(TRIANGLE, header=b"solid") + b"x", [[0, 1, 2]], "1 byte "),
}  # fmt: skip


@pytest.mark.parametrize("name", FORGIVEN)
def test_harmless_flaws_are_read_with_a_note(saved, name):
    content, faces, named = FORGIVEN[name]
    mesh = read_mesh(saved(name, content))
    assert mesh.faces.tolist() == faces
    assert not named or any(named in note for note in mesh.notes)


@pytest.mark.parametrize("form", ["binary", "text"])
def test_stl_corners_that_differ_by_rounding_become_one_vertex(saved, form):
    mesh = bumpy_grid(12)
    corners = mesh.vertices[mesh.faces] + np.random.default_rng(0).normal(
        scale=1e-5, size=(len(mesh.faces), 3, 3)
    )
    content = binary_stl(corners) if form == "binary" else text_stl(corners)
    again = read_mesh(saved("s.stl", content))
    assert len(again.vertices) == len(mesh.vertices) and diagnose(again).boundary_edges == len(
        mesh.boundary_edges
    )
    assert np.abs(again.vertices[again.faces] - mesh.vertices[mesh.faces]).max() < 1e-4
    assert any(
        "rounding" in note and str(mesh.faces.size - len(mesh.vertices)) in note for note in again.notes
    )
    assert not any("weld=True" in note for note in again.notes)


HOSTILE = {
    # name: (content, what the message must say)
    "empty.off": ("", "is empty"),
    "empty.obj": ("", "is empty"),
    "empty.ply": ("", "is empty"),
    "empty.stl": ("", "is empty"),
    "empty.glb": ("", "is empty"),
    "utf-16.off": (SQUARE_FILES["plain.off"].encode("utf-16"), "UTF-16"),
    "utf-16.obj": (SQUARE_FILES["plain.obj"].encode("utf-16"), "UTF-16"),
    "blank.off": ("\n \n\t\n# only a comment\n", "OFF"),
    "nuls.off": (bytes(1000), "OFF"),
    "nuls.obj": (bytes(1000), "no line that begins with v"),
    "nuls.ply": (bytes(1000), "ply"),
    "nuls.stl": (bytes(1000), "fit"),
    "unknown.abc": (T, "known mesh format"),
    "suffixless": (T, "known mesh format"),
    "compressed.off.gz": (b"\x1f\x8b", "known mesh format"),
    "really stl.off": (binary_stl(TRIANGLE), "OFF"),
    "really off.obj": (SQUARE_FILES["plain.off"], "no line that begins with v"),
    "really off.ply": (SQUARE_FILES["plain.off"], "ply"),
    "really off.stl": (SQUARE_FILES["plain.off"], "STL"),
    "really obj.off": (SQUARE_FILES["plain.obj"], "OFF"),
    "binary.off": ("OFF BINARY\n\0\0\0\3", "binary"),
    "four dimensions.off": ("4OFF\n1 0 0\n0 0 0 0\n", "OFF"),
    "keyword only.off": ("OFF", "numbers of vertices"),
    "one count.off": ("OFF\n3\n", "numbers of vertices"),
    "words for counts.off": (f"OFF\nthree one 0\n{T}3 0 1 2\n", "numbers of vertices"),
    "negative count.off": (f"OFF\n-3 1 0\n{T}3 0 1 2\n", "numbers of vertices"),
    "fractional count.off": (f"OFF\n3.5 1 0\n{T}3 0 1 2\n", "numbers of vertices"),
    "count of 5000 digits.off": (f"OFF\n{'9' * 5000} 1 0\n{T}3 0 1 2\n", "numbers of vertices"),
    "too many vertices declared.off": (f"OFF\n4 1 0\n{T}3 0 1 2\n", "declares 4 vertices"),
    "too few vertices declared.off": (f"OFF\n2 1 0\n{T}3 0 1 2\n", "declares 2 vertices"),
    "vertices for faces.off": (f"OFF\n2 2 0\n{T}3 0 1 2\n", "0 corners"),
    "fractional vertices for faces.off": ("OFF\n2 2 0\n0 0 0\n1 0 0\n0.5 1 0\n3 0 1 2\n", "does not begin with the number of corners of a face"),
    "faces for vertices.off": (f"OFF\n4 0 0\n{T}3 0\n", "'3 0' is written where 3 numbers"),
    "too many faces declared.off": (f"OFF\n3 2 0\n{T}3 0 1 2\n", "2 faces"),
    "too few faces declared.off": (f"OFF\n3 1 0\n{T}3 0 1 2\n3 0 1 2\n", "and 1 face"),
    "a trillion vertices.off": (f"OFF\n1000000000000 1 0\n{T}3 0 1 2\n", "declares 1000000000000"),
    "a trillion faces.off": (f"OFF\n3 1000000000000 0\n{T}3 0 1 2\n", "1000000000000 faces"),
    "truncated in vertices.off": ("OFF\n3 1 0\n0 0 0\n1 0", "truncated"),
    "truncated in a face.off": (f"OFF\n3 1 0\n{T}3 0 1", "4 numbers"),
    "no faces.off": (f"OFF\n3 0 0\n{T}", "no faces"),
    "nothing at all.off": ("OFF\n0 0 0\n", "no vertices"),
    "nan.off": ("OFF\n3 1 0\n0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n", "number 1 (counted from 0)"),
    "inf.off": ("OFF\n3 1 0\n0 0 0\n1 0 -inf\n0 1 0\n3 0 1 2\n", "finite"),
    "overflow.off": ("OFF\n3 1 0\n0 0 0\n1e999 0 0\n0 1 0\n3 0 1 2\n", "finite"),
    "word.off": ("OFF\n3 1 0\n0 0 0\n1 zero 0\n0 1 0\n3 0 1 2\n", "'1 zero 0'"),
    "underscore.off": ("OFF\n3 1 0\n0 0 0\n1_0 0 0\n0 1 0\n3 0 1 2\n", "'1_0 0 0' is written where 3 numbers"),
    "underscore in a face.off": (f"OFF\n3 1 0\n{T}3 0 1 0_2\n", "'3 0 1 0_2' is written where 4 numbers"),
    "underscore in a count.off": (f"OFF\n3_0 1 0\n{T}3 0 1 2\n", "numbers of vertices"),
    "hexadecimal.off": ("OFF\n3 1 0\n0 0 0\n0x1 0 0\n0 1 0\n3 0 1 2\n", "'0x1 0 0'"),
    "comma.off": ("OFF\n3 1 0\n0,0 0,0 0,0\n1 0 0\n0 1 0\n3 0 1 2\n", "'0,0 0,0 0,0'"),
    "junk line.off": (b"OFF\n3 1 0\n0 0 0\n\xff\x00\x85\n0 1 0\n3 0 1 2\n", "3 numbers"),
    "two coordinates.off": ("OFF\n3 1 0\n0 0\n1 0\n0 1\n3 0 1 2\n", "'0 0'"),
    "index too large.off": (f"OFF\n3 1 0\n{T}3 0 1 3\n", "uses vertex 3"),
    "counted from one.off": (f"OFF\n3 1 0\n{T}3 1 2 3\n", "subtract 1"),
    "index negative.off": (f"OFF\n3 1 0\n{T}3 0 1 -1\n", "uses vertex -1"),
    "index beyond int64.off": (f"OFF\n3 1 0\n{T}3 0 1 99999999999999999999\n", "uses vertex 1e+20"),
    "index of 500 digits.off": (f"OFF\n3 1 0\n{T}3 0 1 {'9' * 500}\n", "uses vertex inf"),
    "index fractional.off": (f"OFF\n3 1 0\n{T}3 0 1 1.5\n", "whole number"),
    "index nan.off": (f"OFF\n3 1 0\n{T}3 0 1 nan\n", "uses vertex nan"),
    "only a face of two.off": (f"OFF\n3 1 0\n{T}2 0 1\n", "1 line (edges or faces with 2 corners)"),
    "face of one.off": (f"OFF\n3 2 0\n{T}3 0 1 2\n1 0\n", "face 1 has 1 corner,"),
    "face of none.off": (f"OFF\n3 1 0\n{T}0\n", "face 0 has 0 corners"),
    "face of minus one.off": (f"OFF\n3 1 0\n{T}-1 0 1 2\n", "'-1 0 1 2'"),
    "face of nan.off": (f"OFF\n3 1 0\n{T}nan 0 1 2\n", "'nan 0 1 2'"),
    "face of a billion.off": (f"OFF\n3 1 0\n{T}1000000000 0 1 2\n", "'1000000000 0 1 2'"),
    "face longer than its line.off": (f"OFF\n3 1 0\n{T}5 0 1 2\n", "6 numbers"),
    "no area.off": ("OFF\n3 1 0\n0 0 0\n1 1 1\n2 2 2\n3 0 1 2\n", "area"),
    "only folded faces.off": (f"OFF\n3 1 0\n{T}3 0 1 1\n", "no triangle has an area"),
    "no faces.obj": (V, "no faces"),
    "bare v.obj": (V + "v\nf 1 2 3\n", "3 numbers"),
    "bare v at the end.obj": (V + "f 1 2 3\nv", "3 numbers"),
    "underscore.obj": ("v 0 0 1_0\n" + V + "f 1 2 3\n", "'0 0 1_0'"),
    "underscore in a face.obj": (V + "f 1 2 0_3\n", "3 1 2 0_3"),
    "bare f.obj": (V + "f\n", "0 corners"),
    "word.obj": ("v 0 0 x\n" + V + "f 1 2 3\n", "'0 0 x'"),
    "nan.obj": ("v 0 0 nan\n" + V + "f 1 2 3\n", "finite"),
    "edge as face.obj": (V + "f 1 2\n", "2 corners"),
    "lines.obj": (V + "l 1 2 3\nl 3 1\n", "2 lines"),
    "free-form surface.obj": (V + "cstype bezier\nsurf 0 1 0 1 1 2 3\nend\n", "free-form surfaces"),
    "zero.obj": (V + "f 0 1 2\n", "count from 1"),
    "too large.obj": (V + "f 1 2 4\n", "uses vertex 4, but the file has 3 v lines"),
    "too negative.obj": (V + "f -4 -2 -1\n", "uses vertex -4"),
    "negative before its vertices.obj": ("f -3 -2 -1\n" + V, "uses vertex -3"),
    "huge.obj": (V + "f 1 2 99999999999999999999\n", "uses vertex 1e+20"),
    "word in a face.obj": (V + "f 1 2 c\n", "3 1 2 c"),
    "slashes.obj": (V + "f / // /\n", "0 corners"),
    "header without end.ply": (PLY_HEAD, "no end_header"),
    "no format.ply": (("ply\n" + PLY_HEAD[21:] + PLY_FACE + T + "3 0 1 2\n"), "not name exactly one of the formats"),
    "unknown format.ply": (PLY_HEAD.replace("ascii", "xml") + PLY_FACE, "not name exactly one of the formats"),
    "two formats.ply": (PLY_HEAD + "format ascii 1.0\n" + PLY_FACE + T + "3 0 1 2\n", "not name exactly one of the formats"),
    "version that does not exist.ply": (PLY_HEAD.replace("1.0", "9.9") + PLY_FACE + T + "3 0 1 2\n", "in version 1.0"),
    "no version.ply": (PLY_HEAD.replace(" 1.0", "") + PLY_FACE + T + "3 0 1 2\n", "in version 1.0"),
    "format without name.ply": (PLY_HEAD.replace(" ascii 1.0", "") + PLY_FACE, "not name exactly one of the formats"),
    "property first.ply": ("ply\nformat ascii 1.0\nproperty float x\nend_header\n", "property float x"),
    "unknown type.ply": (PLY_HEAD + "property quad w\n" + PLY_FACE, "property quad w"),
    "list of fractional length.ply": (PLY_HEAD + PLY_FACE.replace("uchar", "float"), "list float int"),
    "property twice.ply": (PLY_HEAD + "property float x\n" + PLY_FACE, "property float x"),
    "element twice.ply": (PLY_HEAD + "element vertex 3\n" + PLY_FACE, "element vertex 3"),
    "negative count.ply": (PLY_HEAD.replace("vertex 3", "vertex -3") + PLY_FACE, "element vertex -3"),
    "junk in the header.ply": (PLY_HEAD + "\xff\xfe\n" + PLY_FACE + T + "3 0 1 2\n", "invalid line"),
    "no vertices.ply": ("ply\nformat ascii 1.0\n" + PLY_FACE + "3 0 1 2\n", "no properties x, y and z"),
    "no z.ply": (PLY_HEAD.replace("float z", "float w") + PLY_FACE + T + "3 0 1 2\n", "no properties x, y and z"),
    "lists for z.ply": (
        PLY_HEAD.replace("property float z", "property list uchar float z") + PLY_FACE
        + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "no properties x, y and z",
    ),
    "no face element.ply": (PLY_HEAD + "end_header\n" + T, "no faces"),
    "faces without corners.ply": (
        PLY_HEAD + "element face 1\nproperty int flags\nend_header\n" + T + "1\n", "no faces"
    ),
    "number for corners.ply": (
        PLY_HEAD + "element face 1\nproperty int vertex_indices\nend_header\n" + T + "1\n", "1 corner,"
    ),
    "no faces.ply": (PLY_HEAD + PLY_FACE.replace("face 1", "face 0") + T, "no faces"),
    "word.ply": (PLY_HEAD + PLY_FACE + "0 0 zero\n1 0 0\n0 1 0\n3 0 1 2\n", "'zero' is written where a number"),
    "underscore.ply": (PLY_HEAD + PLY_FACE + "0 0 0\n1_0 0 0\n0 1 0\n3 0 1 2\n", "'1_0' is written where a number"),
    "underscore in a face.ply": (PLY_HEAD + PLY_FACE + T + "3 0 1 0_2\n", "'0_2' is written where a number"),
    "null character.ply": (PLY_HEAD + PLY_FACE + "0 0 0\0\n1 0 0\n0 1 0\n3 0 1 2\n", "'0\\x00' is written where a number"),
    "strange digit.ply": (PLY_HEAD + PLY_FACE + "0 0 \xb2\n1 0 0\n0 1 0\n3 0 1 2\n", "is written where a number"),
    "truncated.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 3", "truncated"),
    "truncated in texture.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 3/3\nf 1/1 3/", "truncated"),
    "truncated text.ply": (PLY_HEAD + PLY_FACE + T + "3 0 1", "'face'"),
    "truncated vertices.ply": (PLY_HEAD + PLY_FACE + T[:9], "'vertex'"),
    "text goes on.ply": (PLY_HEAD + PLY_FACE + T + "3 0 1 2\n3 0 1 2\n", "continues after the last declared row"),
    "list of minus one.ply": (PLY_HEAD + PLY_FACE + T + "-1 0 1 2\n", "-1 numbers"),
    "list of nan.ply": (PLY_HEAD + PLY_FACE + T + "nan 0 1 2\n", "nan numbers"),
    "list of one and a half.ply": (PLY_HEAD + PLY_FACE + T + "1.5 0 1 2\n", "1.5 numbers"),
    "list of a billion.ply": (PLY_HEAD + PLY_FACE + T + "1000000000 0 1 2\n", "1000000000 numbers"),
    "edges.ply": (
        PLY_HEAD + "element edge 2\nproperty int vertex1\nproperty int vertex2\nend_header\n" + T + "0 1\n1 2\n",
        "2 lines",
    ),
    "strip with a missing vertex.ply": (PLY_HEAD + PLY_STRIPS + T + "4 0 1 2 3\n", "uses vertex 3"),
    "strip with a negative vertex.ply": (PLY_HEAD + PLY_STRIPS + T + "4 0 1 2 -2\n", "uses vertex -2"),
    "face of two.ply": (PLY_HEAD + PLY_FACE + T + "2 0 1\n", "2 corners"),
    "nan.ply": (PLY_HEAD + PLY_FACE + "0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n", "finite"),
    "index too large.ply": (PLY_HEAD + PLY_FACE + T + "3 0 1 3\n", "uses vertex 3"),
    "index negative.ply": (PLY_HEAD + PLY_FACE + T + "3 0 1 -2\n", "uses vertex -2"),
    "a trillion vertices.ply": (PLY_BINARY.replace(b"vertex 3", b"vertex 1000000000000"), "1000000000000 r"),
    "a trillion faces.ply": (PLY_BINARY.replace(b"face 1", b"face 1000000000000"), "1000000000000 rows"),
    "a trillion of nothing.ply": (
        PLY_BINARY.replace(b"element face", b"element void 1000000000000\nelement face"), None
    ),
    "too many vertices.ply": (PLY_BINARY.replace(b"vertex 3", b"vertex 4"), "'vertex'"),
    "too few vertices.ply": (PLY_BINARY.replace(b"vertex 3", b"vertex 2"), "continues after the last declared row"),
    "truncated.ply": (PLY_BINARY[:-1], "'face'"),
    "goes on.ply": (PLY_BINARY + b"\1", "continues after the last declared row"),
    "list length negative.ply": (
        ply(
            "binary_big_endian",
            [("vertex", XYZ, TRIANGLE[0]), ("face", [("vertex_indices", "i4", "i4")], [[[0, 1, 2]]])],
        )[:-16] + b"\xff" * 16,
        "-1 numbers",
    ),
    "list length huge.ply": (
        ply(
            "binary_big_endian",
            [("vertex", XYZ, TRIANGLE[0]), ("face", [("vertex_indices", "i4", "u4")], [[[0, 1, 2]]])],
        )[:-16] + b"\xff" * 16,
        "4294967295 numbers",
    ),
    "short.stl": (b"\1" * 40, "neither"),
    "declares more.stl": (binary_stl(TRIANGLE, count=2), "declares 2 triangles"),
    "declares fewer.stl": (binary_stl(TRIANGLE, count=0), "declares 0 triangles"),
    "declares four billion.stl": (binary_stl(TRIANGLE, count=2**32 - 1), "declares 4294967295"),
    "truncated.stl": (binary_stl(TRIANGLE)[:-10], "declares 1 triangles"),
    "no triangles.stl": (binary_stl(TRIANGLE[:0]), "no vertices"),
    "nan.stl": (binary_stl(TRIANGLE * np.nan), "finite"),
    "in one point.stl": (binary_stl(TRIANGLE * 0), "no triangle has an area"),
    "truncated text.stl": (text_stl(TRIANGLE)[:90], "truncated"),
    "truncated after three corners.stl": (text_stl(TRIANGLE).partition("endloop")[0], "truncated"),
    "bytes as many as a facet.stl": (binary_stl(TRIANGLE) + bytes(50), "declares 1 triangles"),
    "bytes behind nothing.stl": (binary_stl(TRIANGLE[:0]) + bytes(64), "declares 0 triangles"),
    "four corners.stl": (text_stl(TRIANGLE).replace("outer loop", "outer loop vertex 1 1 1"), "4 corners"),
    "underscore.stl": (text_stl(TRIANGLE).replace("vertex 1", "vertex 1_0"), "'1_0 0 0'"),
    "word.stl": (text_stl(TRIANGLE).replace("vertex 1", "vertex one"), "'one 0 0'"),
    "two coordinates.stl": (text_stl(TRIANGLE).replace("vertex 0 1 0", "vertex 0 1"), "'0 1 endloop'"),
    "empty solid.stl": ("solid facetless\nendsolid\n", "no vertices"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_one_sentence(saved, name):
    content, fault = HOSTILE[name]
    path = saved(name, content)
    if fault is None:  # the file is unusual but valid
        assert read_mesh(path).faces.tolist() == [[0, 1, 2]]
        return
    assert fault in ": " + refusal(read_mesh, path, most_memory=4e6)


def test_paths_that_are_not_files_are_refused(tmp_path):
    for path, fault in [
        (tmp_path / "missing.off", "does not exist"),
        (tmp_path / "no" / "such" / "directory.off", "does not exist"),
        (tmp_path, "not a regular file"),
        (tmp_path / "d.off", "not a regular file"),
        (tmp_path / ("x" * 5000 + ".off"), "too long"),
        (tmp_path / "loop.off", ""),
        (Path("/dev/zero"), "not a regular file"),
    ]:
        (tmp_path / "d.off").mkdir(exist_ok=True)
        if path.name == "loop.off":
            path.symlink_to(path)
        with pytest.raises(InputError) as caught:
            read_mesh(path)
        assert str(caught.value).startswith(f"{path}: ") and fault in str(caught.value)


def test_a_pipe_is_refused_without_waiting(tmp_path):
    path = tmp_path / "pipe.off"
    os.mkfifo(path)
    with pytest.raises(InputError, match="not a regular file"):
        read_mesh(path)


def test_unreadable_files_are_refused(saved, monkeypatch):
    path = saved("secret.off", SQUARE_FILES["plain.off"])

    def refuse(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("jaxsmw.runtime.files.open", refuse, raising=False)
    with pytest.raises(InputError, match=r"secret\.off: cannot be read \(Permission denied\)"):
        read_mesh(path)


def test_a_file_of_a_terabyte_is_refused_without_reading(tmp_path):
    path = tmp_path / "sparse.off"
    with path.open("wb") as file:
        file.truncate(2**40)  # a sparse file takes no space on the disk
    with pytest.raises(InputError, match=r"sparse\.off: is larger than 1 GiB"):
        read_mesh(path)


SUFFIXES = [".off", ".obj", ".ply", ".stl"]
STARTS = [b"", b"OFF\n", b"OFF\n3 1 0\n", b"v 0 0 0\nf ", b"ply\nformat ascii 1.0\n", b"solid facet vertex "]


@pytest.fixture(scope="module")
def scratch(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("scratch")


def read_or_refuse(path: Path) -> None:
    """Read a file. The result must be a valid mesh or an error message of one sentence."""
    try:
        mesh = read_mesh(path)
    except InputError as error:
        message = str(error)
    else:
        message = None
    if message is not None:
        assert message.startswith(f"{path}: ") and "\n" not in message
        return
    assert np.isfinite(mesh.vertices).all() and 0 < mesh.area < np.inf
    assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)


@given(junk=st.binary(max_size=300), start=st.sampled_from(STARTS), suffix=st.sampled_from(SUFFIXES))
@settings(max_examples=200, deadline=None)
def test_junk_is_refused_in_one_sentence(scratch, junk, start, suffix):
    path = scratch / f"junk{suffix}"
    path.write_bytes(start + junk)
    read_or_refuse(path)


SOUND = [
    (".off", SQUARE_FILES["comments.off"].encode()),
    (".off", SQUARE_FILES["quad.off"].encode()),
    (".obj", SQUARE_FILES["texture, negative.obj"].encode()),
    (".obj", SQUARE_FILES["clutter.obj"].encode()),
    *((".ply", SQUARE_FILES[f"{encoding} clutter.ply"]) for encoding in PLY_ENCODINGS),
    (".ply", PLY_BINARY),
    (".stl", binary_stl(np.array(SQUARE)[SQUARE_FACES])),
    (".stl", text_stl(np.array(SQUARE)[SQUARE_FACES]).encode()),
]
SPLICES = st.one_of(
    st.binary(max_size=6),
    st.sampled_from([b"\n", b" ", b"-", b"nan", b"inf", b"1e308", b"4294967296", b"#"]),
    st.sampled_from([b"\x85", b"\xa0", b"\x1c", b"\0", b"\\\n", b"/", b"\r"]),
)


@given(data=st.data(), sound=st.sampled_from(SOUND))
@settings(max_examples=200, deadline=None)
def test_damaged_files_are_read_or_refused(scratch, data, sound):
    suffix, content = sound
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(content)))
        stop = data.draw(st.integers(start, min(start + 8, len(content))))
        content = content[:start] + data.draw(SPLICES) + content[stop:]
    path = scratch / f"damaged{suffix}"
    path.write_bytes(content)
    read_or_refuse(path)


# ------------------------------------------------------------------------------------------ writing

COORDINATES = st.one_of(
    st.floats(-1e50, 1e50), st.sampled_from([-0.0, 5e-324, 2.2e-308, 0.1, 1 / 3, 1e22, 123456789.123456789])
)


@given(vertices=hnp.arrays(np.float64, st.tuples(st.integers(3, 8), st.just(3)), elements=COORDINATES))
@settings(max_examples=30, deadline=None)
def test_written_meshes_are_read_back_bit_for_bit(scratch, vertices):
    vertices = np.concatenate([vertices, np.array(SQUARE) * 1e45])
    faces = np.array(SQUARE_FACES) + len(vertices) - 4
    faces = np.concatenate([faces, [[0, 1, 2]]])
    for suffix in (".off", ".ply"):
        for colors in (None, np.linspace(0, 1, vertices.size).reshape(-1, 3)):
            mesh = make_mesh(vertices, faces)
            write_mesh(scratch / f"m{suffix}", mesh, colors=colors)
            assert same_mesh(read_mesh(scratch / f"m{suffix}"), mesh)


@pytest.mark.parametrize("suffix", [".off", ".ply", ".OFF"])
def test_trimesh_reads_written_meshes(tmp_path, suffix):
    mesh = bumpy_grid(5)
    colors = np.random.default_rng(0).integers(0, 256, (25, 3), dtype=np.uint8)
    path = tmp_path / f"m{suffix}"
    write_mesh(path, mesh)
    other = trimesh.load(path, process=False)
    assert np.array_equal(other.vertices, mesh.vertices) and np.array_equal(other.faces, mesh.faces)
    write_mesh(path, mesh, colors=colors)
    other = trimesh.load(path, process=False)
    assert np.array_equal(other.vertices, mesh.vertices) and np.array_equal(other.faces, mesh.faces)
    if suffix == ".ply":
        assert np.array_equal(other.visual.vertex_colors[:, :3], colors)
    else:
        lines = path.read_text().split("\n")
        assert lines[0] == "COFF"
        assert [line.split()[3:] for line in lines[2:27]] == [[*map(str, c), "255"] for c in colors]


def test_colors_as_floats_and_as_bytes_are_the_same(tmp_path):
    mesh = bumpy_grid(16)
    levels = np.stack([np.arange(256), np.arange(256)[::-1], np.arange(256) // 2], axis=1).astype(np.uint8)
    for suffix in (".off", ".ply"):
        write_mesh(tmp_path / f"a{suffix}", mesh, colors=levels)
        write_mesh(tmp_path / f"b{suffix}", mesh, colors=levels / 255)
        write_mesh(tmp_path / f"c{suffix}", mesh, colors=(levels / 255).astype(np.float32).tolist())
        first = (tmp_path / f"a{suffix}").read_bytes()
        assert first == (tmp_path / f"b{suffix}").read_bytes() == (tmp_path / f"c{suffix}").read_bytes()


def test_colors_are_rounded(tmp_path):
    write_mesh(tmp_path / "m.off", OCTAHEDRON, colors=np.full((6, 3), 0.999))
    assert "1.0 0.0 0.0 255 255 255 255\n" in (tmp_path / "m.off").read_text()


@pytest.mark.parametrize(
    "colors",
    [np.zeros((5, 3)), np.zeros(18), np.zeros((6, 4)), np.full((6, 3), 1.01), np.full((6, 3), -0.1),
     np.full((6, 3), np.nan), np.zeros((6, 3), int), np.full((6, 3), "red")],
)  # fmt: skip
def test_invalid_colors_write_nothing(tmp_path, colors):
    with pytest.raises(InputError, match="colors"):
        write_mesh(tmp_path / "m.ply", OCTAHEDRON, colors=colors)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "name", ["m.xyz", "m.3mf", "m", "m.off.gz", "no/such/m.off", "file/m.off", "directory.off"]
)
def test_invalid_output_paths_write_nothing(tmp_path, name):
    (tmp_path / "file").touch()
    (tmp_path / "directory.off").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as caught:
        write_mesh(tmp_path / name, OCTAHEDRON)
    assert str(caught.value).startswith(f"{tmp_path / name}: ") and "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


# -------------------------------------------------------------------------------------- real shapes


def read_plainly(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read an OFF file of the data sets without the code under test."""
    words = path.read_text().split()
    n, f = int(words[1]), int(words[2])
    numbers = np.array(words[4:], float)
    return numbers[: 3 * n].reshape(n, 3), numbers[3 * n :].reshape(f, 4)[:, 1:].astype(int)


@pytest.mark.sampled
def test_real_shapes_keep_vertices_and_faces(shared):
    paths = sorted((shared / "data").rglob("*.off"))
    assert len(paths) > 200
    for path in paths[::10]:
        vertices, faces = read_plainly(path)
        mesh = read_mesh(path)
        assert np.array_equal(mesh.vertices, vertices)
        if not mesh.notes:
            assert np.array_equal(mesh.faces, faces)
        assert (
            diagnose(mesh).components == 1
            and not mesh.degenerate_faces.any()
            and mesh.referenced_vertices.all()
        )


@pytest.mark.parametrize(
    ("file", "dropped", "nonmanifold_edges", "boundary_edges"),
    [("shrec16_partial/null/cat.off", 12, 12, 84), ("shrec16_topology/kid00.off", 1, 1, 90)],
)
def test_nonmanifold_real_shapes_are_diagnosed(shared, file, dropped, nonmanifold_edges, boundary_edges):
    mesh = read_mesh(shared / "data" / file)
    found = diagnose(mesh)
    assert (found.nonmanifold_edges, found.boundary_edges) == (nonmanifold_edges, boundary_edges)
    assert len(read_plainly(shared / "data" / file)[1]) - len(mesh.faces) == dropped
    assert len(mesh.notes) == 1 and mesh.notes[0].startswith(f"{dropped} face")


def test_real_shapes_agree_with_other_programs(shared):
    oracle = np.load(shared / "oracle" / "faust_r_002_007.npz")
    mesh = read_mesh(shared / "data" / "faust_r" / "off" / "tr_reg_002.off")
    assert np.allclose(mesh.vertex_areas, oracle["x_vertex_areas"], rtol=1e-12, atol=0)
    assert mesh.area == pytest.approx(float(oracle["x_area"]), rel=1e-12)
    found = diagnose(mesh)
    assert (found.boundary_edges, found.nonmanifold_edges, found.nonmanifold_vertices) == (0, 0, 0)
    assert len(mesh.vertices) - len(mesh.edges) + len(mesh.faces) == 2, "a sphere"


def test_a_written_real_shape_is_read_back_unchanged(shared, tmp_path):
    mesh = read_mesh(shared / "data" / "tosca" / "off" / "wolf0.off")
    for name in ("w.off", "w.ply"):
        write_mesh(tmp_path / name, mesh)
        assert same_mesh(read_mesh(tmp_path / name), mesh)
