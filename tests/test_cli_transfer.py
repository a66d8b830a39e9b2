"""`jaxsmw transfer` writes registered meshes, landmarks and attributes, and refuses what it cannot use."""

import json

import numpy as np
import pytest
import trimesh
from command_line import SMALL, assert_refused, write_pair

import jaxsmw
from jaxsmw.io import (
    Landmarks,
    read_blend_shapes,
    read_landmark_file,
    read_mesh_data,
    write_blend_shapes,
    write_landmark_file,
    write_mesh,
    write_mesh_data,
)
from jaxsmw.io.mesh_data import MeshData, Texture

pytestmark = pytest.mark.usefixtures("small_pictures")


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A pair with its true map; the source has labels, and landmarks."""
    directory = write_pair(tmp_path_factory.mktemp("pair"))
    mesh = jaxsmw.read_mesh(directory / "x.off")
    labels = (mesh.vertices[:, 0] > 0).astype(np.int64)
    write_mesh_data(directory / "x.ply", MeshData(mesh, mesh.faces, vertex_data={"side": labels}))
    write_landmark_file(
        directory / "x.mrk.json", Landmarks(("a", "b"), mesh.vertices[[3, 400]], coordinates="LPS")
    )
    markups = json.loads((directory / "x.mrk.json").read_text())
    markups["markups"][0]["coordinateUnits"] = "um"
    (directory / "x.mrk.json").write_text(json.dumps(markups))
    write_landmark_file(directory / "x.csv", Landmarks(("a", "b"), mesh.vertices[[3, 400]]))
    return directory


def test_all_files_are_written(run, pair, tmp_path):
    outcome = run(
        "transfer", pair / "x.ply", pair / "y.ply", *SMALL,
        "--registered", tmp_path / "r.vtp", "--attributes", tmp_path / "a.ply",
        "--landmarks", pair / "x.mrk.json", "--landmarks-output", tmp_path / "l.csv",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    source, target = jaxsmw.read_mesh(pair / "x.off"), jaxsmw.read_mesh(pair / "y.ply")
    truth = np.loadtxt(pair / "truth.txt", dtype=int)
    registered = read_mesh_data(tmp_path / "r.vtp")
    np.testing.assert_array_equal(registered.faces, source.faces)
    root = np.sqrt(target.area)
    apart = np.linalg.norm(registered.mesh.vertices - target.vertices[truth], axis=1) / root
    assert apart.mean() < 0.05
    labels = read_mesh_data(tmp_path / "a.ply").vertex_data["side"]
    assert set(np.unique(labels)) == {0, 1}
    assert (labels[truth] == (source.vertices[:, 0] > 0)).mean() > 0.9
    carried = read_landmark_file(tmp_path / "l.csv")
    assert carried.names == ("a", "b")
    assert np.linalg.norm(carried.positions - target.vertices[truth[[3, 400]]], axis=1).max() < 0.2 * root
    assert (
        "distance to the target" in outcome.output
        and "expected errors of landmarks, in the unit of the target:\n  a: 0." in outcome.output
    )
    assert "are in LPS coordinates" in outcome.errors


def test_missing_pictures_and_coordinate_systems_are_noted(run, pair, tmp_path):
    mesh = jaxsmw.read_mesh(pair / "x.off")
    texture = Texture(mesh.vertices[:, :2], mesh.faces)
    write_mesh_data(tmp_path / "x.obj", MeshData(mesh, mesh.faces, texture=texture))
    outcome = run(
        "transfer", tmp_path / "x.obj", pair / "y.ply", "--map", pair / "truth.txt",
        "--registered", tmp_path / "r.glb", "--attributes", tmp_path / "a.ply",
        "--landmarks", pair / "x.csv", "--landmarks-output", tmp_path / "l.mrk.json", "--coordinates", "RAS",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    for name in ("r.glb", "a.ply"):
        assert f"{name}: the file contains texture coordinates, but no picture" in outcome.errors
    assert "x.csv: the file states no coordinate system, so its positions are used as RAS" in outcome.errors
    assert read_landmark_file(tmp_path / "l.mrk.json").coordinates == "RAS"


def test_a_map_replaces_the_match(run, pair, tmp_path):
    outcome = run(
        "transfer",
        pair / "x.off",
        pair / "y.ply",
        "--map",
        pair / "truth.txt",
        "--registered",
        tmp_path / "r.off",
    )
    assert outcome.code == 0, outcome.errors
    assert "refinement" not in outcome.errors
    target = jaxsmw.read_mesh(pair / "y.ply")
    truth = np.loadtxt(pair / "truth.txt", dtype=int)
    apart = np.linalg.norm(jaxsmw.read_mesh(tmp_path / "r.off").vertices - target.vertices[truth], axis=1)
    assert np.quantile(apart, 0.99) < 0.02 * np.sqrt(target.area)


def test_a_map_of_other_meshes_is_reported(run, pair, tmp_path):
    truth = np.loadtxt(pair / "truth.txt", dtype=int)
    np.savetxt(tmp_path / "other.txt", np.random.default_rng(0).permutation(truth), fmt="%d")
    files = "transfer", pair / "x.off", pair / "y.ply", "--registered", tmp_path / "r.off", "--map"
    outcome = run(*files, tmp_path / "other.txt")
    assert outcome.code == 0, outcome.errors
    assert "flipped, so the map is probably wrong: check that" in outcome.errors
    assert "warning" not in run(*files, pair / "truth.txt").errors


def test_the_report_shows_a_registered_mesh_that_is_computed_once(run, pair, tmp_path, monkeypatch):
    calls = []
    for name in ("surface_points", "registered_mesh"):
        method = getattr(jaxsmw.Correspondence, name)

        def counted(self, *, name=name, method=method, **settings):
            calls.append(name)
            return method(self, **settings)

        monkeypatch.setattr(jaxsmw.Correspondence, name, counted)
    outcome = run(
        "transfer", pair / "x.off", pair / "y.ply", *SMALL, "--report", tmp_path / "report", "--up", "z",
        "--landmarks", pair / "x.csv", "--landmarks-output", tmp_path / "l.csv",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    assert "report.html" in outcome.errors and "mean expected error" in outcome.output
    page = (tmp_path / "report" / "report.html").read_text()
    assert '"registered"' in page and "x.off to y.ply" in page
    assert (
        page.count('"names": ["a", "b"]') + page.count('"names":["a","b"]') == 2
    )  # of the source and of the target
    summary = json.loads((tmp_path / "report" / "summary.json").read_text())
    assert summary["settings"]["preset"] == "paper"
    assert "registered mesh and expected error" in summary["seconds"]
    assert sorted(calls) == ["registered_mesh", "surface_points"]


def test_landmarks_with_large_expected_errors_are_marked(run, pair, tmp_path, monkeypatch):
    expected = np.full(642, 0.01)
    expected[[3, 400]] = 0.015, 0.021
    monkeypatch.setattr(jaxsmw.Correspondence, "expected_error", lambda self: expected)
    vertices = jaxsmw.read_mesh(pair / "x.off").vertices
    names = ("a", "b", "c", "d", "e")
    write_landmark_file(tmp_path / "l.csv", Landmarks(names, vertices[[3, 400, 100, 200, 300]]))
    outcome = run(
        "transfer", pair / "x.off", pair / "y.ply", *SMALL, "--init", "shot",
        "--landmarks", tmp_path / "l.csv", "--landmarks-output", tmp_path / "t.csv",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    unit = np.sqrt(jaxsmw.read_mesh(pair / "y.ply").area)
    lines = outcome.output.splitlines()
    first = lines.index("expected errors of landmarks, in the unit of the target:") + 1
    assert lines[first : first + 5] == [
        f"  a: {0.015 * unit:.3g}",
        f"  b: {0.021 * unit:.3g} (more than twice the median: check this landmark)",
        *(f"  {name}: {0.01 * unit:.3g}" for name in names[2:]),
    ]


def test_landmarks_off_the_surface(run, pair, tmp_path):
    write_landmark_file(
        tmp_path / "x.csv", Landmarks(("center", "b c"), np.array([[0.0, 0, 0], [0.2, 0, 0]]))
    )
    files = "transfer", pair / "x.off", pair / "y.ply", "--map", pair / "truth.txt"
    call = *files, "--landmarks", tmp_path / "x.csv", "--landmarks-output", tmp_path / "y.pts"
    assert_refused(run(*call, "--quiet"), naming="the median distance of the landmarks")
    outcome = run(*call, "--off-surface")
    assert outcome.code == 0, outcome.errors
    assert "y.pts: .pts files hold neither blanks" in outcome.errors
    carried = read_landmark_file(tmp_path / "y.pts")
    # The target is three times as large.
    assert carried.names == ("center", "b_c")
    assert np.allclose(carried.positions, [[0, 0, 0], [0.6, 0, 0]], atol=0.05)
    refused = run(*files, "--off-surface", "--registered", tmp_path / "r.off", "--quiet")
    assert_refused(refused, naming="--off-surface: has no effect without --landmarks")


def test_blend_shapes_of_a_folder(run, pair, tmp_path):
    mesh = jaxsmw.read_mesh(pair / "x.off")
    moves = {"smile": 0.1 * mesh.vertex_normals, "left/up": np.tile([0.0, 0, 0.2], (len(mesh.vertices), 1))}
    data = MeshData(mesh, mesh.faces, blend_shapes=moves)
    assert [path.name for path in write_blend_shapes(tmp_path / "in", data)] == ["smile.obj", "left_up.obj"]
    write_mesh(tmp_path / "in" / "neutral.obj", mesh)
    again = read_blend_shapes(tmp_path / "in", MeshData(mesh, mesh.faces)).blend_shapes
    assert list(again) == ["left_up", "smile"] and np.allclose(again["smile"], moves["smile"], atol=1e-15)
    files = "transfer", pair / "x.off", pair / "y.ply", "--map", pair / "truth.txt", "--quiet"
    call = *files, "--blend-shapes", tmp_path / "in"
    outcome = run(*call, "--blend-shapes-output", tmp_path / "out")
    assert outcome.code == 0, outcome.errors
    target = jaxsmw.read_mesh(pair / "y.ply")
    for name, expected in (("smile", 0.3 * target.vertex_normals), ("left_up", np.array([0, 0, 0.6]))):
        shape = trimesh.load(tmp_path / "out" / f"{name}.obj", process=False)
        assert np.array_equal(shape.faces, target.faces)
        assert np.abs(shape.vertices - target.vertices - expected).mean() < 0.02
    (tmp_path / "empty").mkdir()
    write_mesh(tmp_path / "empty" / "neutral.obj", mesh)
    (tmp_path / "other").mkdir()
    write_mesh(tmp_path / "other" / "a.obj", target)
    output = "--blend-shapes-output", tmp_path / "new"
    for arguments, fault in (
        ((*call, "--blend-shapes-output", tmp_path / "in"), "is an input"),
        ((*call, "--report", tmp_path / "r"), "--blend-shapes: has no effect without"),
        (call, "nothing to write"),
        ((*files, *output), "has no blend shapes for --blend-shapes-output"),
        ((*files, *output, "--blend-shapes", tmp_path / "missing"), "cannot be read as a folder"),
        ((*files, *output, "--blend-shapes", tmp_path / "empty"), "contains no OBJ file with another shape"),
        ((*files, *output, "--blend-shapes", tmp_path / "other"), "that are not those of"),
    ):
        assert_refused(run(*arguments), naming=fault)
    assert not (tmp_path / "new").exists()


def test_the_unit_of_the_landmarks_is_kept(run, pair, tmp_path):
    outcome = run(
        "transfer", pair / "x.off", pair / "y.ply", "--map", pair / "truth.txt",
        "--landmarks", pair / "x.mrk.json", "--landmarks-output", tmp_path / "l.mrk.json",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    assert read_landmark_file(tmp_path / "l.mrk.json").unit == "um"
    assert "the unit is 'um'; the target is assumed to have the same unit" in outcome.errors


def test_a_stiffer_mesh_is_farther_away(run, pair, tmp_path):
    far = []
    for stiffness in ("0.003", "0.1"):
        outcome = run(
            "transfer", pair / "x.off", pair / "y.ply", "--map", pair / "truth.txt",
            "--registered", tmp_path / f"{stiffness}.off", "--stiffness", stiffness,
        )  # fmt: skip
        far.append(float(outcome.output.split("mean ")[1].split(" %")[0]))
    assert far[1] > 2 * far[0]


def test_landmarks_of_both_meshes_are_the_initial_map(run, pair, tmp_path):
    target = jaxsmw.read_mesh(pair / "y.ply")
    source = jaxsmw.read_mesh(pair / "x.off")
    truth = np.loadtxt(pair / "truth.txt", dtype=int)
    chosen = np.arange(0, len(truth), 60)
    names = tuple(f"p{i}" for i in chosen)
    write_landmark_file(tmp_path / "x.csv", Landmarks((*names, "alone"), source.vertices[[*chosen, 1]]))
    write_landmark_file(tmp_path / "y.csv", Landmarks(names[::-1], target.vertices[truth[chosen]][::-1]))
    np.savetxt(tmp_path / "pairs.txt", np.stack([chosen, truth[chosen]], axis=1), "%d")
    for init, output in ((f"{tmp_path}/x.csv,{tmp_path}/y.csv", "a.txt"), (f"{tmp_path}/pairs.txt", "b.txt")):
        outcome = run(
            "match",
            pair / "x.off",
            pair / "y.ply",
            *SMALL,
            "--init",
            f"landmarks:{init}",
            "--output",
            tmp_path / output,
        )
        assert outcome.code == 0, outcome.errors
        assert ("without a partner, such as 'alone'" in outcome.errors) == (output == "a.txt")
    assert (tmp_path / "a.txt").read_text() == (tmp_path / "b.txt").read_text()


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("", "nothing to write"),
        ("--landmarks {p}/x.mrk.json", "nothing to write"),
        ("--landmarks-output {t}/l.csv", "--landmarks-output: has no effect without --landmarks"),
        (
            "--registered {t}/r.off --landmarks {p}/x.mrk.json",
            "--landmarks: has no effect without --landmarks-output or --report",
        ),
        ("--registered {t}/r.off --coordinates LPS", "--coordinates: has no effect without --landmarks"),
        ("--registered {t}/r.xyz", "r.xyz: meshes cannot be written"),
        ("--attributes {t}/r", "meshes cannot be written as"),
        ("--attributes {t}/a.ply", "x.off: has no attributes"),
        ("--registered {p}/x.off", "would be overwritten"),
        ("--registered {t}/a.off --attributes {t}/a.off", "two outputs have this name"),
        ("--registered {t}/r.off --stiffness 0", "is not a positive number"),
        ("--registered {t}/r.off --stiffness nan", "is not a positive number"),
        ("--registered {t}/r.off --map {t}/missing.txt", "missing.txt"),
        ("--registered {t}/r.off --map {p}/truth.txt --preset fast", "--preset has no effect with --map"),
        ("--registered {t}/r.off --map {p}/truth.txt --init wks", "--init has no effect with --map"),
        ("--report {t}/r --map {p}/truth.txt", "--report: describes a match, but --map gives a map"),
        ("--registered {t}/r.off --up z", "--up: has no effect without --report"),
        ("--report {p}/x.off", "is an input"),
        ("--registered {t}/r/report.html --report {t}/r", "meshes cannot be written"),
        ("--registered {t}/r.off --index-base 1", "--index-base: has no effect without --map"),
        ("--landmarks {p}/x.mrk.json --landmarks-output {t}/l.mps", "l.mps"),
        ("--landmarks {p}/x.off --landmarks-output {t}/l.csv", "x.off"),
        ("--landmarks {t}/missing.pp --landmarks-output {t}/l.csv", "missing.pp"),
        ("--landmarks {p}/x.mrk.json --landmarks-output {t}/l.csv --coordinates XYZ", "invalid choice: 'XYZ'"),
        (
            "--landmarks {p}/x.csv --landmarks-output {t}/l.mrk.json",
            "the one of {p}/x.csv is not known: set --coordinates LPS or --coordinates RAS",
        ),
        ("--registered {t}/r.off --init landmarks:{p}/x.mrk.json,{t}/missing.csv", "missing.csv"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused(run, pair, tmp_path, arguments, fault):
    given = arguments.format(p=pair, t=tmp_path).split()
    outcome = run("transfer", pair / "x.off", pair / "y.ply", *given, "--quiet")
    assert_refused(outcome, naming=fault.format(p=pair))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("match {m} --output m --init landmarks:a.csv,b.off", "b.off: the suffix '.off' is not supported"),
        ("match {m} --output m --init landmarks:a.png,b.csv", "a.png: the suffix '.png' is not supported"),
        (
            "match {m} --output m --init landmarks:a.mrk.json",
            "a.mrk.json: contains landmarks of one mesh only",
        ),
        ("transfer {m} --registered r.off --init landmarks:a.csv,b.off", "b.off: the suffix '.off'"),
        (
            "transfer {m} --landmarks a.off --landmarks-output b.csv",
            "a.off: the suffix '.off' is not supported",
        ),
        ("demo --output {t}/d --init landmarks:a.fcsv", "a.fcsv: contains landmarks of one mesh only"),
        ("match {m} --output m --init landmarks:a.PP", "a.PP: contains landmarks of one mesh only"),
        ("match {m} --output m --init landmarks:{p}/x.csv", "x.csv: contains landmarks of one mesh only"),
        ("transfer {m} --attributes a.stl", "a.stl: STL files contain only triangles"),
        ("match {m} --output m --init landmarks:a.mps", "a.mps: contains landmarks of one mesh only"),
        (
            "match {p}/x.off {p}/y.ply --output {t}/m.fcsv",
            "m.fcsv: maps are written as text, .npy, .npz, .safetensors or .mat, not as .fcsv",
        ),
        # A table may contain vertices of both meshes, so the command goes on and reads a mesh.
        ("match {m} --output {t}/m --init landmarks:a.csv", "missing_x.off"),
    ],
)
def test_suffixes_of_landmark_files_are_checked_before_the_meshes_are_read(
    run, pair, tmp_path, arguments, fault
):
    # Both meshes are missing, so a command that reads them first names a mesh.
    outcome = run(*arguments.format(m="missing_x.off missing_y.off", p=pair, t=tmp_path).split(), "--quiet")
    assert_refused(outcome, naming=fault)
    assert list(tmp_path.iterdir()) == []


def test_landmarks_without_a_common_name_are_refused(run, pair, tmp_path):
    other = json.loads((pair / "x.mrk.json").read_text())
    for point in other["markups"][0]["controlPoints"]:
        point["label"] += "2"
    (tmp_path / "y.mrk.json").write_text(json.dumps(other))
    init = f"landmarks:{pair / 'x.mrk.json'},{tmp_path / 'y.mrk.json'}"
    outcome = run(
        "match", pair / "x.off", pair / "y.ply", "--init", init, "--output", tmp_path / "m.txt", "--quiet"
    )
    assert_refused(outcome, naming="has no landmark with the name of a landmark of")
