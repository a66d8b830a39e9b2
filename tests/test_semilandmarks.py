"""Semilandmarks: the energy, the slide, the rounds on meshes, and the files."""

import csv

import numpy as np
import pytest
from known_collections import known_collection
from messages import refused
from scipy.spatial.distance import cdist
from synthetic import bumpy_mesh

from jaxsmw.collection import (
    Sliders,
    align,
    bending_energy_matrix,
    place_semilandmarks,
    read_sliders,
    slide,
    slide_semilandmarks,
)
from jaxsmw.collection.files import write_semilandmarks
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_distance import distances_to_surface
from jaxsmw.io.formats.morphometrics import format_specimens
from jaxsmw.io.landmarks import Landmarks

K = 15


def cloud(seed: int, count: int = K) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


def directions(seed: int, count: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def energy_of(matrix: np.ndarray, points: np.ndarray) -> float:
    return float(np.trace(points.T @ matrix @ points))


# ---- The energy


def test_the_energy_is_a_block_of_the_inverse_of_the_spline_system():
    reference = cloud(0)
    affine = np.hstack([np.ones((K, 1)), reference])
    system = np.block([[-cdist(reference, reference), affine], [affine.T, np.zeros((4, 4))]])
    np.testing.assert_allclose(bending_energy_matrix(reference), np.linalg.inv(system)[:K, :K], atol=1e-9)


def test_affine_maps_have_no_energy_and_all_others_have_some():
    reference = cloud(0)
    matrix = bending_energy_matrix(reference)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    values = np.linalg.eigvalsh(matrix)
    assert (values > -1e-10).all() and (values > 1e-6).sum() == K - 4
    affine = reference @ cloud(1, 3) + [4.0, -2.0, 1.0]
    np.testing.assert_allclose(matrix @ affine, 0, atol=1e-10)
    assert energy_of(matrix, cloud(2)) > 0.1


def test_points_in_a_plane_have_an_energy():
    flat = cloud(0) * [1, 1, 0]
    matrix = bending_energy_matrix(flat)
    np.testing.assert_allclose(matrix @ flat, 0, atol=1e-10)
    assert (np.linalg.eigvalsh(matrix) > 1e-6).sum() == K - 3


# ---- One slide


@pytest.mark.parametrize("bending", [True, False])
def test_a_slide_solves_the_linear_system_and_reaches_the_smallest_energy(bending):
    reference, points = cloud(0), cloud(1)
    matrix = bending_energy_matrix(reference) if bending else np.eye(K)
    rows = np.array([5, 6, 7, 8, 8, 9, 9])
    tangents = directions(2, 7)
    moved = slide(points, reference, rows, tangents, matrix)
    np.testing.assert_array_equal(np.delete(moved, rows, axis=0), np.delete(points, rows, axis=0))
    # The formula of Gunz, Mitteroecker and Bookstein, with the coordinates in one vector.
    basis = np.zeros((3 * K, 7))
    for column, (row, tangent) in enumerate(zip(rows, tangents, strict=True)):
        basis[3 * row : 3 * row + 3, column] = tangent
    whole = np.kron(matrix, np.eye(3))
    lengths = -np.linalg.solve(basis.T @ whole @ basis, basis.T @ whole @ (points - reference).ravel())
    np.testing.assert_allclose(moved.ravel(), points.ravel() + basis @ lengths, atol=1e-8)
    least = energy_of(matrix, moved - reference)
    assert least < energy_of(matrix, points - reference)
    for seed in range(20):
        other = moved.copy()
        np.add.at(other, rows, 0.1 * np.random.default_rng(seed).normal(size=(7, 1)) * tangents)
        assert energy_of(matrix, other - reference) > least


@pytest.mark.parametrize("bending", [True, False])
def test_displaced_semilandmarks_slide_back(bending):
    reference = cloud(0)
    rows, tangents = np.array([3, 4, 10]), directions(1, 3)
    displaced = reference.copy()
    displaced[rows] += np.array([[0.3], [-0.2], [0.5]]) * tangents
    matrix = bending_energy_matrix(reference) if bending else np.eye(K)
    np.testing.assert_allclose(slide(displaced, reference, rows, tangents, matrix), reference, atol=1e-9)


def test_directions_are_chords_and_tangent_planes():
    sliders = Sliders(np.array([[0, 1, 2]]), np.array([3, 4]))
    points, normals = cloud(0, 5), directions(1, 5)
    rows, tangents = sliders.directions(points, normals)
    assert rows.tolist() == [1, 3, 4, 3, 4]
    chord = points[2] - points[0]
    np.testing.assert_allclose(tangents[0], chord / np.linalg.norm(chord))
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1)
    for one, other, point in ((1, 3, 3), (2, 4, 4)):
        np.testing.assert_allclose(tangents[[one, other]] @ normals[point], 0, atol=1e-12)
        assert tangents[one] @ tangents[other] == pytest.approx(0, abs=1e-12)


# ---- Specimens


def specimens(count: int = 5) -> tuple[list[Mesh], np.ndarray, Sliders]:
    """Stretched bodies. The semilandmarks are displaced on the surface, differently on each."""
    body, random = bumpy_mesh(2), np.random.default_rng(0)
    vertices = [body.vertices * random.uniform(0.9, 1.1, 3) for _ in range(count)]
    meshes = [Mesh(one, body.faces, f"shape{i}") for i, one in enumerate(vertices)]
    chosen = random.permutation(len(body.vertices))[:20]
    positions = np.array([mesh.vertices[chosen] for mesh in meshes])
    positions[:, 8:] += 0.1 * random.normal(size=(count, 12, 3))
    return meshes, positions, Sliders(np.array([[0, 8, 1], [1, 9, 2]]), np.arange(10, 20))


@pytest.mark.parametrize("sliding", ["bending", "procrustes"])
def test_semilandmarks_slide_on_the_surfaces(sliding):
    meshes, positions, sliders = specimens()
    found = slide_semilandmarks(meshes, positions, sliders, sliding=sliding)
    np.testing.assert_array_equal(found.positions[:, :8], positions[:, :8])
    for mesh, points in zip(meshes, found.positions, strict=True):
        assert distances_to_surface(points, mesh).max() < 1e-9
    assert found.energies[-1] < 0.5 * found.energies[0]
    np.testing.assert_allclose(found.mean, align(found.positions, scale=True).mean)
    more = slide_semilandmarks(meshes, positions, sliders, sliding=sliding, rounds=1)
    assert len(more.energies) == 2 and more.energies[0] == found.energies[0]


def test_results_do_not_depend_on_unit_and_position():
    meshes, positions, sliders = specimens()
    found = slide_semilandmarks(meshes, positions, sliders).positions
    moved = [Mesh(1000 * mesh.vertices + 7, mesh.faces, mesh.name) for mesh in meshes]
    other = slide_semilandmarks(moved, 1000 * positions + 7, sliders).positions
    np.testing.assert_allclose(other, 1000 * found + 7, atol=1e-5)


def test_a_collection_gives_semilandmarks_and_files(tmp_path):
    meshes, _, sliders = specimens(4)
    shapes = np.array([mesh.vertices for mesh in meshes])
    mirrored = np.arange(4) == 3
    collection = known_collection(shapes, meshes[0].faces, mirrored)
    names = tuple(f"p{i}" for i in range(20))
    found = place_semilandmarks(collection, Landmarks(names, meshes[0].vertices[7:27]), sliders)
    for mesh, points in zip(collection.meshes, found.positions, strict=True):
        assert distances_to_surface(points, mesh).max() < 1e-9
    # The mirror image of a mesh has the mirror images of the semilandmarks.
    plain = known_collection(shapes, meshes[0].faces, np.zeros(4, bool))
    same = place_semilandmarks(plain, Landmarks(names, meshes[0].vertices[7:27]), sliders)
    np.testing.assert_allclose(found.positions[3] * [-1, 1, 1], same.positions[3], atol=1e-3)
    files = write_semilandmarks(collection, names, found, sliders, tmp_path)
    assert all(file.is_file() for file in files)
    folder = tmp_path / "semilandmarks"
    rows = list(csv.reader((folder / "semilandmarks.csv").read_text().splitlines()))
    assert rows[0][:4] == ["mesh", "p0_X", "p0_Y", "p0_Z"]
    np.testing.assert_array_equal(np.array(rows[2][1:], float).reshape(20, 3), found.positions[1])
    assert list(csv.reader((folder / "curves.csv").read_text().splitlines()))[1] == ["1", "9", "2"]
    assert list(csv.reader((folder / "surfaces.csv").read_text().splitlines()))[:2] == [["surface"], ["11"]]
    blocks = (folder / "semilandmarks.tps").read_text().split("\n\n")
    lines = blocks[1].splitlines()
    assert (lines[0], lines[-1], len(blocks)) == ("LM3=20", "ID=shape1", 4)
    np.testing.assert_array_equal(np.array([line.split() for line in lines[1:-1]], float), found.positions[1])


def test_tps_files_name_the_specimens():
    text = format_specimens(["a", "b"], np.arange(12.0).reshape(2, 2, 3))
    assert text == "LM3=2\n0.0 1.0 2.0\n3.0 4.0 5.0\nID=a\n\nLM3=2\n6.0 7.0 8.0\n9.0 10.0 11.0\nID=b\n"


# ---- Tables of sliders and bad input

NAMES = ("nose", "bridge", "brow", "cheek")


def test_a_table_of_sliders_is_read(tmp_path):
    (tmp_path / "s.csv").write_text("before,slide,after\nnose, bridge ,brow\n\n,cheek,\n")
    found = read_sliders(tmp_path / "s.csv", NAMES)
    assert found.curves.tolist() == [[0, 1, 2]] and found.surfaces.tolist() == [3]


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("", ("no point slides",)),
        ("before,slide,after\n", ("no point slides",)),
        ("nose,bridge\n", ("line 1 is no slider",)),
        ("nose,bridge,brow,cheek\n", ("line 1 is no slider",)),
        ("before,slide,after\nnose,,brow\n", ("line 2 is no slider",)),
        ("nose,bridge,\n", ("line 1 is no slider", "only slide")),
        ("nose;bridge;brow\n", ("line 1 is no slider",)),
        ("nose,chin,brow\n", ("line 1", "'chin'", "correct the name")),
        ("nose,nose,brow\n", ("row 0", "twice")),
        ("nose,bridge,brow\n,bridge,\n", ("point 1 slides twice", "remove one")),
        ("\0\xff,bridge,brow\n", ("line 1", "no landmark")),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, facts):
    (tmp_path / "s.csv").write_bytes(text.encode("latin-1"))
    with refused("s.csv: ", *facts):
        read_sliders(tmp_path / "s.csv", NAMES)


def test_a_missing_table_is_refused(tmp_path):
    with refused("s.csv: does not exist"):
        read_sliders(tmp_path / "s.csv", NAMES)


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"meshes": 4}, ("4 meshes", "5 specimens")),
        ({"meshes": 1, "positions": 1}, ("1 meshes", "at least two meshes")),
        ({"curves": [[0, 20, 1]]}, ("between 0 and 19",)),
        ({"curves": [[-1, 9, 1]]}, ("between 0 and 19",)),
        ({"curves": [[9, 9, 1]]}, ("names a point twice",)),
        ({"curves": [[0, 10, 1]]}, ("point 10 slides twice",)),
        ({"surfaces": [25]}, ("between 0 and 19",)),
        ({"curves": [], "surfaces": []}, ("no point slides",)),
        ({"rounds": 0}, ("rounds is 0", "at least 1")),
        ({"coincide": True}, ("coincide", "remove one")),
    ],
)
def test_bad_arguments_are_refused(changes, facts):
    meshes, positions, sliders = specimens()
    curves = np.array(changes.get("curves", sliders.curves), np.int64).reshape(-1, 3)
    surfaces = np.array(changes.get("surfaces", sliders.surfaces), np.int64)
    if changes.get("coincide"):
        positions[:, 1] = positions[:, 0]
    options = {name: changes[name] for name in ("sliding", "rounds") if name in changes}
    with refused(*facts):
        slide_semilandmarks(
            meshes[: changes.get("meshes", 5)],
            positions[: changes.get("positions", 5)],
            Sliders(curves, surfaces),
            **options,
        )
