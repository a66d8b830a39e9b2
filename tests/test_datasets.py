"""Data sets are recognised by their published layouts, and error messages name missing files."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from messages import refused
from sampled_cases import first_always
from synthetic import bumpy_mesh, grid_mesh

from jaxsmw import InputError, read_mesh
from jaxsmw.benchmark import compare_shapes, datasets
from jaxsmw.benchmark.datasets import DataSet, open_data_set, read_pairs
from jaxsmw.cli.run import run_command
from jaxsmw.evaluation import GroundTruth
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.io.meshes import write_mesh

VERTICES, FACES = grid_mesh(4, 5)


def put(path: Path, contents: str | None = None) -> None:
    """Write a file with the given contents, or a mesh with twenty vertices if there are no contents."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if contents is not None:
        path.write_text(contents)
    elif path.suffix == ".obj":
        lines = ["v {} {} {}".format(*v) for v in VERTICES] + ["f {} {} {}".format(*(f + 1)) for f in FACES]
        path.write_text("\n".join(lines))
    elif path.suffix == ".mat":
        surface = dict(zip("XYZ", VERTICES.T[:, :, None], strict=True), TRIV=FACES + 1)
        scipy.io.savemat(path, {"surface": surface})
    else:
        write_mesh(path, make_mesh(VERTICES, FACES))


def column(numbers) -> str:
    return "".join(f"{number}\n" for number in numbers)


def remeshed(directory: Path) -> None:
    for name in ("cat1", "cat2", "cat10", "dog0"):
        put(directory / "off" / f"{name}.off")
        put(directory / "corres" / f"{name}.vts", column(range(1, 11)))
        put(directory / "corres" / f"{name}.sym.vts", column(range(10, 0, -1)))


def shrec19(directory: Path) -> None:
    for name in ("1", "2", "10"):
        put(directory / "obj" / f"{name}.obj")
    for name in ("1_2", "2_10"):
        put(directory / "matches" / "FARMgt_txt" / f"{name}.txt", column(range(20, 0, -1)))


def partial(directory: Path) -> None:
    put(directory / "null" / "cat.off")
    for kind in ("cuts", "holes"):
        put(directory / kind / f"{kind}_cat_shape_1.off")
        put(directory / kind / f"{kind}_cat_shape_1.baryc_gt", "2 0.5 0.5 0\n" * 20)
    put(directory / "cuts" / "cuts_cat_shape_1.baryc_gt_sym", "3 0.5 0.5 0\n" * 20)


A, B, C = "cuts_1_cat_01", "cuts_2_dog_03", "cuts_0_cow_10"
# The last ten vertices of A correspond to the first ten of B, and the last five of A to the last five of C.
OVERLAPS = {
    (A, B): [-1] * 10 + list(range(10)),
    (A, C): [-1] * 15 + list(range(15, 20)),
    (B, A): list(range(10, 20)) + [-1] * 10,
}


def two_parts(directory: Path) -> None:
    for name in (A, B, C):
        put(directory / "shapes" / f"{name}.off")
    for (x, y), lines in OVERLAPS.items():
        put(directory / "maps" / f"{x}_{y}.vts", column(lines))


def two_cuts(directory: Path) -> None:
    for name in ("cat-01", "cat-02"):
        put(directory / "off" / f"{name}.off")
    put(directory / "maps" / "cat-01_cat-02.map", column(OVERLAPS[A, B] + [1] * 11 + [0] * 9))


def topology(directory: Path) -> None:
    for number in range(3):
        put(directory / f"kid{number:02}.off")
        if number:
            put(directory / f"kid{number:02}_ref.txt", "1 3\n2 4\n")


def faust(directory: Path) -> None:
    for number in (0, 2, 11):
        put(directory / "training" / "registrations" / f"tr_reg_{number:03}.ply")


def scape(directory: Path) -> None:
    for number in range(3):
        put(directory / f"mesh{number:03}.off")


def tosca(directory: Path) -> None:
    for name in ("cat0", "cat1", "wolf0", "wolf2"):
        put(directory / f"{name}.mat")


def partial_copy(directory: Path) -> None:
    """Write SHREC'16 partial as in the copy of Cao et al."""
    put(directory / "null" / "off" / "cat.off")
    put(directory / "cuts" / "off" / "cuts_cat_shape_1.off")
    put(directory / "cuts" / "corres" / "cuts_cat_shape_1.vts", column(range(20, 0, -1)))


def topology_copy(directory: Path) -> None:
    """Write SHREC'16 topology as in the copy of Cao et al."""
    for number in range(3):
        put(directory / "off" / f"kid{number:02}.off")
        if number:
            put(directory / "corres" / f"kid{number:02}_ref.vts", column(range(20, 0, -1)))


# The names of landmarks, their vertices, and their faces and weights, counted from 1.
LANDMARKS = {
    "cow": ([1, 2, 7, 52], [3, 4, 5, 6], [[1, 1, 0, 0], [2, 0, 1, 0], [3, 0, 0, 1], [4, 0.5, 0.5, 0]]),
    "bison": ([2, 1, 9, 52], [7, 8, 9, 10], [[5, 1, 0, 0], [6, 0, 1, 0], [7, 0, 0, 1], [8, 0.2, 0.3, 0.5]]),
    "dog": ([1, 3], [11, 12], [[9, 0, 1, 0], [10, 1, 0, 0]]),
}


def animals(directory: Path) -> None:
    for name, (points, vertices, weights) in LANDMARKS.items():
        put(directory / "models" / f"{name}.obj")
        folder = directory.with_name(f"{directory.name}_gts")
        folder.mkdir(exist_ok=True)
        named = dict(fname=f"{name}.obj", points=points, verts=vertices, baryc=weights, centroids=np.eye(3))
        scipy.io.savemat(folder / f"{name}.mat", named)
    put(directory / "test-sets" / "test-set0.txt", "dog,cow\n")
    put(directory / "test-sets" / "test-set1.txt", "cow,bison\n")


LAYOUTS = {
    "a remeshed set": (remeshed, [("cat1", "cat2"), ("cat1", "cat10"), ("cat2", "cat1"), ("cat2", "cat10")]),
    "SHREC'19 humans": (shrec19, [("1", "2"), ("2", "10")]),
    "SHREC'16 partial": (partial, [("cuts_cat_shape_1", "cat"), ("holes_cat_shape_1", "cat")]),
    "PARTIALSMAL": (two_parts, [(A, C), (A, B), (B, A)]),
    "CP2P24": (two_cuts, [("cat-01", "cat-02")]),
    "SHREC'16 topology": (topology, [("kid01", "kid00"), ("kid02", "kid00")]),
    "SHREC'20": (animals, [("dog", "cow"), ("cow", "bison")]),
    "FAUST registrations": (faust, [("tr_reg_000", "tr_reg_002"), ("tr_reg_000", "tr_reg_011")]),
    "SCAPE": (scape, [("mesh000", "mesh001"), ("mesh000", "mesh002"), ("mesh001", "mesh000")]),
    "TOSCA": (tosca, [("cat0", "cat1"), ("cat1", "cat0"), ("wolf0", "wolf2"), ("wolf2", "wolf0")]),
}


def names(data_set: DataSet) -> list[tuple[str, str]]:
    return [(pair.source, pair.target) for pair in data_set.pairs]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_are_recognised_and_their_ground_truth_is_read(tmp_path, layout):
    build, first = LAYOUTS[layout]
    build(tmp_path / "set")
    data_set = open_data_set(tmp_path / "set")
    assert (data_set.layout, data_set.name) == (layout, "set")
    assert names(data_set)[: len(first)] == first
    known = (*data_set.pairs, *data_set.others)
    assert set(data_set.shapes) == {name for pair in known for name in pair.names}
    assert all(len(set(pair.names)) == 2 for pair in data_set.others)
    for pair in data_set.pairs:
        assert all(file.is_file() for file in (*pair.meshes, *pair.truth))
        meshes = [read_mesh(file) for file in (pair.source_file, pair.target_file)]
        truth = pair.ground_truth(*meshes)
        if layout == "a remeshed set":
            assert truth.source_vertices.tolist() == truth.targets.tolist() == list(range(10))
            mirrored = pair.ground_truth(*meshes, mirrored=True)
            assert mirrored.source_vertices.tolist() == list(range(9, -1, -1))
            assert mirrored.targets.tolist() == list(range(10))
        elif layout == "SHREC'19 humans":
            assert truth.targets.tolist() == list(range(19, -1, -1))
        elif layout == "SHREC'16 partial":
            assert isinstance(truth.targets, SurfacePoints) and set(truth.targets.faces.tolist()) == {1}
        elif layout == "SHREC'20":
            expected = {
                "dog": ([10], [0], [[1, 0, 0]]),
                "cow": ([2, 3, 5], [5, 4, 7], [[0, 1, 0], [1, 0, 0], [0.2, 0.3, 0.5]]),
            }
            sources, triangles, weights = expected[pair.source]
            assert truth.source_vertices.tolist() == sources
            assert truth.targets.faces.tolist() == triangles
            np.testing.assert_allclose(truth.targets.weights, weights)
            assert pair.partial == (pair.source == "dog")
        elif layout in ("PARTIALSMAL", "CP2P24"):
            lines = np.array(OVERLAPS[pair.names if layout == "PARTIALSMAL" else (A, B)])
            assert truth.source_vertices.tolist() == np.flatnonzero(lines >= 0).tolist()
            assert truth.targets.tolist() == lines[lines >= 0].tolist()
            assert pair.partial and pair.both_partial
        elif layout == "SHREC'16 topology":
            assert (truth.source_vertices.tolist(), truth.targets.tolist()) == ([0, 1], [2, 3])
        else:
            assert truth.targets.tolist() == truth.source_vertices.tolist() == list(range(20))
    if layout in ("SCAPE", "SHREC'19 humans"):
        with pytest.raises(InputError, match="no mirrored ground truth"):
            pair.ground_truth(*meshes, mirrored=True)


def test_the_overlap_of_two_parts_comes_from_the_most_reliable_file(tmp_path):
    two_parts(tmp_path / "parts")
    two_cuts(tmp_path / "cuts")
    mesh = make_mesh(VERTICES, FACES)
    masks = {pair.names: pair.true_overlap(mesh, mesh) for pair in open_data_set(tmp_path / "parts").pairs}
    for names, lines in OVERLAPS.items():
        assert (masks[names][0] == (np.array(lines) >= 0)).all()
    assert np.flatnonzero(masks[A, B][1]).tolist() == list(range(10))  # from the reverse file
    assert np.flatnonzero(masks[A, C][1]).tolist() == list(range(15, 20))  # from the targets
    (pair,) = open_data_set(tmp_path / "cuts").pairs
    assert np.flatnonzero(pair.true_overlap(mesh, mesh)[1]).tolist() == list(range(11))
    partial(tmp_path / "full")
    pair = open_data_set(tmp_path / "full").pairs[0]
    assert not pair.both_partial and pair.true_overlap(mesh, mesh) is None


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([-1] * 19 + [20], r"line 20: 20 is not one of the vertices of .* 0 to 19"),
        ([-1] * 19 + [-2], r"line 20: -2 is not one of the vertices of"),
        ([-1] * 18 + [0], "has 19 lines, but needs one for each of the 20 vertices"),
        ([-1] * 20, "is -1 on every line, so .* do not overlap: remove this pair"),
        ([*range(1, 20), 20], "line 20: 20 is not one of .*1-based"),
    ],
)
def test_bad_ground_truth_of_two_parts_is_refused_in_one_sentence(tmp_path, lines, message):
    two_parts(tmp_path)
    file = tmp_path / "maps" / f"{A}_{B}.vts"
    put(file, column(lines))
    pair = open_data_set(tmp_path).known_pairs[A, B]
    with pytest.raises(InputError, match=message) as caught:
        pair.ground_truth(*map(read_mesh, pair.meshes))
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_bad_masks_of_two_parts_are_refused(tmp_path):
    two_cuts(tmp_path)
    file = tmp_path / "maps" / "cat-01_cat-02.map"
    (pair,) = open_data_set(tmp_path).pairs
    meshes = [read_mesh(path) for path in pair.meshes]
    put(file, column(OVERLAPS[A, B] + [1] * 19 + [3]))
    with refused(str(file), "line 40", "3 is neither 0 nor 1"):
        pair.true_overlap(*meshes)
    put(file, column(OVERLAPS[A, B]))
    with refused(str(file), "has 20 lines", "needs 20", "then 20"):
        pair.true_overlap(*meshes)
    two_parts(tmp_path / "parts")
    put(tmp_path / "parts" / "maps" / f"{B}_{A}.vts", column([0] * 19))
    with refused(f"{B}_{A}.vts", "has 19 lines"):
        open_data_set(tmp_path / "parts").known_pairs[A, B].true_overlap(*meshes)


def test_lists_of_pairs_replace_the_pairs_of_the_layout(tmp_path):
    remeshed(tmp_path)
    put(tmp_path / "test_pairs.txt", "dog0\tcat1\n\ncat2 dog0\r\n")
    data_set = open_data_set(tmp_path)
    assert names(data_set) == [("dog0", "cat1"), ("cat2", "dog0")]
    # The unlisted pairs within a class also have ground truth, and other unlisted pairs in some sets.
    others = {pair.names for pair in data_set.others}
    assert len(others) == 10 and {("cat10", "cat2"), ("dog0", "cat2")} < others
    assert ("dog0", "cat1") not in others and len(data_set.shapes) == 4
    shrec19(tmp_path / "other")
    put(tmp_path / "other" / "PAIRS_list_SHREC19_connectivity.txt", "2,10\n")
    assert names(open_data_set(tmp_path / "other")) == [("2", "10")]
    two_parts(tmp_path / "parts")
    put(tmp_path / "parts" / "test_pairs.txt", f"{B} {A}\n")
    parts = open_data_set(tmp_path / "parts")
    assert names(parts) == [(B, A)] and {pair.names for pair in parts.others} == {(A, B), (A, C)}
    put(tmp_path / "list.txt", "cat1 cat2\ncat1 horse\n")
    with pytest.raises(InputError, match="line 2: 'horse' is not one of the shapes"):
        read_pairs(tmp_path / "list.txt", ["cat1", "cat2"])
    put(tmp_path / "list.txt", "cat1 cat2 cat1\n")
    with pytest.raises(InputError, match="line 1: does not name two"):
        read_pairs(tmp_path / "list.txt", ["cat1", "cat2"])
    with pytest.raises(InputError, match="cannot be read"):
        read_pairs(tmp_path / "none.txt", [])
    put(tmp_path / "list.txt", "# cat1 cat2\n")
    with pytest.raises(InputError, match="names no pair"):
        read_pairs(tmp_path / "list.txt", ["cat1", "cat2"])


def test_one_shape_in_two_formats_is_one_shape(tmp_path):
    scape(tmp_path)
    put(tmp_path / "mesh000.ply")
    data_set = open_data_set(tmp_path)
    assert len(data_set.shapes) == 3 and data_set.shapes["mesh000"].suffix == ".off"


BREAKAGES = {
    "no directory": (lambda d: None, "is not a directory"),
    "empty": (lambda d: d.mkdir(), "not laid out like a known data set"),
    "only text": (lambda d: put(d / "readme.txt", "x"), "remeshed set: off/NAME.off"),
    "no meshes": (lambda d: put(d / "corres" / "a.vts", "1\n"), "no folder with their meshes"),
    "no truth": (lambda d: (remeshed(d), (d / "corres" / "cat2.vts").unlink()), "cat2.vts: the ground truth of .* is missing"),
    "no mesh": (lambda d: (remeshed(d), (d / "off" / "cat2.off").unlink()), "no mesh for .*cat2.vts"),
    "several": (lambda d: (remeshed(d / "a"), faust(d / "b")), r"several data sets \(a, b\)"),
    "a kid without truth": (
        lambda d: (topology(d), (d / "kid02_ref.txt").unlink()), "kid02_ref.txt: the ground truth of .* is missing"
    ),
    "no null": (lambda d: put(d / "cuts" / "cuts_cat_shape_1.off"), "no null/"),
    "no partial shapes": (lambda d: put(d / "null" / "cat.off"), "no cuts/ or holes/"),
    "a partial shape without its full shape": (
        lambda d: (partial(d), put(d / "cuts" / "cuts_dog_shape_1.off")), "full shape of this partial shape is not in"
    ),
    "a partial shape without truth": (
        lambda d: (partial(d), (d / "cuts" / "cuts_cat_shape_1.baryc_gt").unlink()),
        "cuts_cat_shape_1.baryc_gt: the ground truth of .* is missing",
    ),
    "two parts without a mesh": (
        lambda d: (two_parts(d), (d / "shapes" / f"{C}.off").unlink()), f"{A}_{C}.vts: is not named after two meshes"
    ),
    "two listed parts without truth": (
        lambda d: (two_parts(d), put(d / "test_pairs.txt", f"{B} {C}")), f"{B}_{C}.vts: the ground truth of .* is missing"
    ),
    "two halves": (lambda d: (two_parts(d / "test"), two_parts(d / "train")), r"several data sets \(test, train\)"),
    "no kid00": (lambda d: (topology(d), (d / "kid00.off").unlink()), "no kid00"),
    "one shape": (lambda d: put(d / "cat0.off"), "no two of its shapes form a pair"),
    "a listed pair without truth": (
        lambda d: (shrec19(d), put(d / "PAIRS_list_x.txt", "1,10")), "ground truth 1_10 of a listed pair is missing"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BREAKAGES)
def test_missing_files_are_named(tmp_path, case):
    damage, message = BREAKAGES[case]
    damage(tmp_path / "set")
    with pytest.raises(InputError, match=message) as caught:
        open_data_set(tmp_path / "set")
    assert str(tmp_path / "set") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unreadable_directories_are_named(tmp_path, monkeypatch):
    def refuse(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with refused(str(tmp_path), "cannot be read", "Permission denied", "check its permissions"):
        open_data_set(tmp_path)


def test_the_mesh_folder_of_a_data_set_is_refused(tmp_path):
    remeshed(tmp_path)
    shutil.copytree(tmp_path / "off", tmp_path / "shapes")
    assert len(open_data_set(tmp_path).pairs) == 6
    with pytest.raises(
        InputError, match=f"only the mesh folder of a remeshed set: give {re.escape(str(tmp_path))}"
    ):
        open_data_set(tmp_path / "off")


def test_shapes_with_different_numbers_of_vertices_are_refused(tmp_path):
    put(tmp_path / "cat0.off")
    write_mesh(tmp_path / "cat1.off", make_mesh(*grid_mesh(5, 5)))
    pair = open_data_set(tmp_path).pairs[0]
    with pytest.raises(InputError, match=r"25 vertices and .* has 20"):
        pair.ground_truth(read_mesh(pair.source_file), read_mesh(pair.target_file))


def test_shapes_of_tosca_are_read_from_matlab_files(tmp_path):
    put(tmp_path / "cat0.mat")
    mesh = read_mesh(tmp_path / "cat0.mat")
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    scipy.io.savemat(tmp_path / "other.mat", {"shape": 1})
    (tmp_path / "damaged.mat").write_bytes((tmp_path / "cat0.mat").read_bytes()[:200])
    (tmp_path / "text.mat").write_text("no MATLAB at all")
    for name, fault in (
        ("other", "contains no struct 'surface'"),
        ("damaged", "is damaged"),
        ("text", "is damaged or not a .mat file"),
    ):
        with pytest.raises(InputError, match=f"{name}.mat: {fault}"):
            read_mesh(tmp_path / f"{name}.mat")


REAL = {
    "faust_r": ("a remeshed set", 165),
    "tosca_r": ("a remeshed set", 127),
    "tosca_nonisometric": ("a remeshed set", 45),
    "tosca": ("TOSCA", None),
    "shrec16_partial": ("SHREC'16 partial", 56),
    "partial_smal": ("PARTIALSMAL", 60),
    "shrec16_topology": ("SHREC'16 topology", 15),
    "smal_r": ("a remeshed set", None),
    "shrec19_r": ("a remeshed set", 62),
}
# The shapes of this set are training shapes.
TRAINING = {"faust_r"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* are vertices that no face")
@pytest.mark.parametrize("name", first_always(reversed(REAL)))
def test_real_data_sets_are_recognised(shared, name):
    layout, pairs = REAL[name]
    data_set = open_data_set(shared / "data" / name)
    assert data_set.layout == layout
    assert pairs is None or len(data_set.pairs) == pairs
    for pair in data_set.pairs[:1] + data_set.pairs[-1:]:
        mesh_x, mesh_y, truth = pair.read()
        pairs_of_vertices = truth.vertex_pairs(mesh_y)
        assert len(pairs_of_vertices) > 400
        assert (pairs_of_vertices.max(axis=0) < [len(mesh_x.vertices), len(mesh_y.vertices)]).all()
        differences = compare_shapes(mesh_x, mesh_y, truth)
        assert 0.6 < differences.factor < 1.6
        assert differences.retriangulated == (layout in ("a remeshed set", "PARTIALSMAL"))
    if name in TRAINING:
        assert len(data_set.split("train")) >= len(data_set.pairs)
        with pytest.raises(InputError, match="contains no pair of test shapes"):
            data_set.split("test")


@pytest.mark.parametrize("copy", [partial_copy, topology_copy])
def test_the_copies_of_a_training_framework_are_read(tmp_path, copy):
    copy(tmp_path)
    data_set = open_data_set(tmp_path)
    for pair in data_set.pairs:
        _, mesh_y, truth = pair.read()
        assert truth.vertex_pairs(mesh_y)[:, 1].tolist() == list(range(19, -1, -1))
    assert data_set.layout == {partial_copy: "SHREC'16 partial", topology_copy: "SHREC'16 topology"}[copy]
    assert len(data_set.pairs) == (1 if copy is partial_copy else 2)
    if copy is partial_copy:
        with pytest.raises(InputError, match=r"cuts: is only a part of a data set: give"):
            open_data_set(tmp_path / "cuts")


def unfit(directory: Path, name: str, **variables: object) -> None:
    points, vertices, weights = LANDMARKS[name]
    whole = dict(points=points, verts=vertices, baryc=weights) | variables
    saved = {key: value for key, value in whole.items() if value is not None}
    scipy.io.savemat(directory.with_name(f"{directory.name}_gts") / f"{name}.mat", saved)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        (dict(points=[3, 4, 5, 6]), r"bison.mat: has no point in common with .*cow.mat"),
        (dict(points=[1, 2, 7]), r"bison.mat: has 3 points but 4 verts"),
        (dict(verts=None), r"bison.mat: contains points, but no verts"),
        (dict(baryc=np.tile([1, 1, 0, 0], (3, 1))), r"bison.mat: has 4 points but 3 rows of baryc"),
        (dict(baryc=np.tile([1, 1, 1, 0], (4, 1))), r"bison.mat, row 1: 1 1 0 are not barycentric weights|not barycentric"),
        (dict(verts=[1, 2, 3, 21]), r"bison.mat, row 4: 21 is not one of the vertices|baryc"),
    ],
)  # fmt: skip
def test_bad_landmarks_are_refused(tmp_path, variables, message):
    animals(tmp_path / "set")
    if "verts" in variables:
        variables = variables | dict(baryc=None)
    unfit(tmp_path / "set", "bison", **variables)
    with pytest.raises(InputError, match=message):
        open_data_set(tmp_path / "set").pairs[1].read()


def test_landmarks_without_weights_have_vertices_as_targets(tmp_path):
    animals(tmp_path / "set")
    unfit(tmp_path / "set", "bison", baryc=None)
    _, mesh_y, truth = open_data_set(tmp_path / "set").pairs[1].read()
    assert truth.vertex_pairs(mesh_y).tolist() == [[2, 7], [3, 6], [5, 9]]


def test_missing_landmarks_are_named(tmp_path):
    animals(tmp_path / "set")
    (tmp_path / "set_gts" / "dog.mat").unlink()
    with pytest.raises(
        InputError, match=r"set_gts.dog.mat: the ground truth of .*dog.obj is missing: unpack set_gts"
    ):
        open_data_set(tmp_path / "set")


def split_names(data_set: DataSet, part: str) -> set[str]:
    return {name for pair in data_set.split(part) for name in pair.names}


def numbered(directory: Path) -> None:
    for number in (0, 79, 80, 99):
        put(directory / f"tr_reg_{number:03}.ply")


def numbered_poses(directory: Path) -> None:
    for number in (0, 50, 52, 71):
        put(directory / f"mesh{number:03}.off")


def listed(directory: Path) -> None:
    remeshed(directory)
    put(directory / "train_cat.txt", "cat1\ndog0\n")
    put(directory / "test_cat.txt", "cat2\ncat10\n")
    put(directory / "test.txt", "cat1\ncat2\n")


SPLITS = {
    "FAUST": (numbered, {"tr_reg_000", "tr_reg_079"}, {"tr_reg_080", "tr_reg_099"}),
    "SCAPE": (numbered_poses, {"mesh000", "mesh050"}, {"mesh052", "mesh071"}),
    "lists": (listed, {"cat1", "dog0"}, {"cat2", "cat10"}),
    "only tests": (topology, set(), {"kid00", "kid01", "kid02"}),
}


@pytest.mark.parametrize("case", SPLITS)
def test_published_splits_are_known(tmp_path, case):
    build, train, test = SPLITS[case]
    build(tmp_path)
    data_set = open_data_set(tmp_path)
    assert split_names(data_set, "test") == test
    if train:
        assert split_names(data_set, "train") == train
    else:
        with pytest.raises(InputError, match="contains no pair of train shapes"):
            data_set.split("train")


def test_the_halves_of_a_data_set_have_directories_of_their_own(tmp_path):
    for name in ("test", "SHREC16"):
        partial(tmp_path / name)
    assert open_data_set(tmp_path / "test").split("test") == open_data_set(tmp_path / "test").pairs
    for name, part in (("test", "train"), ("SHREC16", "test")):
        with pytest.raises(InputError, match=f"that it is the {part} half of SHREC'16 partial: open"):
            open_data_set(tmp_path / name).split(part)


def test_splits_that_do_not_exist_are_refused(tmp_path):
    tosca(tmp_path)
    data_set = open_data_set(tmp_path)
    with pytest.raises(InputError, match=r"has no published split: write .* into train.txt"):
        data_set.split("train")
    put(tmp_path / "train.txt", "cat0\ncow7\n")
    with pytest.raises(InputError, match="lacks the listed shapes cow7"):
        data_set.split("train")


def test_each_layout_names_papers(tmp_path):
    topology(tmp_path)
    assert "Lähner 2016" in open_data_set(tmp_path).papers
    text = (Path(__file__).parents[1] / "docs" / "datasets.md").read_text("utf-8")
    for layout in datasets.LAYOUTS.values():
        assert f"| {layout.papers} |" in text


def test_reading_a_pair_and_its_differences_does_not_load_jax(tmp_path):
    partial(tmp_path)
    code = (
        "import sys; from jaxsmw.benchmark import datasets\n"
        "from jaxsmw.benchmark.differences import compare_shapes\n"
        f"pair = datasets.open_data_set({str(tmp_path)!r}).pairs[0]\n"
        "compare_shapes(*pair.read())\n"
        "print([name for name in ('jax', 'torch', 'equinox') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_differences_between_shapes_are_computed_from_their_points():
    vertices, faces = bumpy_mesh(2).vertices, bumpy_mesh(2).faces
    mesh_x = make_mesh(vertices, faces)
    order = np.random.default_rng(0).permutation(len(vertices))
    place = np.argsort(order)
    turned = vertices[order] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]).T
    mesh_y = make_mesh(3 * turned + 7, place[faces])
    differences = compare_shapes(mesh_x, mesh_y, GroundTruth.of_all_vertices(place))
    np.testing.assert_allclose(differences, (90, 3, 1), rtol=1e-6)
    assert (differences.rotated, differences.rescaled, differences.retriangulated) == (True, True, False)
    # A shuffled truth keeps no face, and two landmarks say nothing about faces.
    shuffled = compare_shapes(mesh_x, mesh_x, GroundTruth.of_all_vertices(order))
    assert shuffled.kept_faces < 0.1 and shuffled.retriangulated
    landmarks = GroundTruth(np.arange(40, 44), np.arange(40, 44))
    same = compare_shapes(mesh_x, mesh_x, landmarks)
    np.testing.assert_allclose(same, (0, 1, 1), atol=1e-6)
    assert not (same.rotated or same.rescaled or same.retriangulated)
    assert compare_shapes(mesh_x, make_mesh(vertices, faces[::-1]), landmarks).kept_faces == 0


def test_the_command_describes_a_data_set(tmp_path, capsys):
    tosca(tmp_path / "TOSCA")
    assert run_command(["benchmark", str(tmp_path / "TOSCA"), "--describe", "--pairs", "2", "--quiet"]) == 0
    header, _, row = capsys.readouterr().out.splitlines()
    assert [cell.strip() for cell in header.strip("|").split("|")][2:5] == [
        "rotated",
        "rescaled",
        "re-triangulated",
    ]
    assert row.startswith(
        "| TOSCA | TOSCA | 0 of 2 (median 0°) | 0 of 2 (median factor 1.00) | 0 of 2 (median 100 % of faces kept) |"
    )
    assert run_command(["benchmark", str(tmp_path / "TOSCA"), "--describe", "--methods", "mwp"]) == 2
    assert "--describe matches nothing, so --methods has no effect: leave it out." in capsys.readouterr().err


def test_importing_data_sets_and_protocols_loads_no_heavy_module():
    code = "import sys, jaxsmw.benchmark.datasets, jaxsmw.benchmark.protocols; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "jaxsmw.benchmark.datasets" in loaded.split()
    assert {"jax", "numpy", "scipy", "igl"}.isdisjoint(loaded.split())
