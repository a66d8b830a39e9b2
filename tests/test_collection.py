"""Collections as a whole: consistency, interrupted runs, added meshes, hands, workers and the command."""

import csv
import json
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_refused
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

from jaxsmw import InputError, make_mesh, read_mesh, write_mesh
from jaxsmw.choices import EDGES_PER_SHAPE
from jaxsmw.collection import edges, match_collection
from jaxsmw.collection.files import write_registered
from jaxsmw.creature import CREATURES, creature
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_distance import distances_to_surface
from jaxsmw.io import Landmarks, MeshData, read_landmark_file, write_landmark_file
from jaxsmw.runtime.cache import Store

VERTICES = 800


def renumbered(mesh: Mesh, seed: int) -> tuple[Mesh, np.ndarray]:
    """A mesh with its vertices in a random order, and the new number of each vertex."""
    order = np.random.default_rng(seed).permutation(len(mesh.vertices))
    new = np.argsort(order)
    return make_mesh(mesh.vertices[order], new[mesh.faces], name=f"shape{seed}"), new


@pytest.fixture(scope="module")
def shapes():
    """Five poses of one creature, each with its own numbering, and the new number of each vertex."""
    poses = CREATURES["biped"][:5]
    return [renumbered(creature("biped", vertices=VERTICES, pose=pose), i) for i, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def meshes(shapes):
    return [mesh for mesh, _ in shapes]


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def found(meshes, work):
    return match_collection(meshes, preset="paper", edges_per_shape=2, mirror="no", directory=work)


def error(collection, shapes, i, j):
    """The mean distance of matches from the truth, in units of the square root of the area."""
    (_, new_x), (mesh_y, new_y) = shapes[i], shapes[j]
    offsets = mesh_y.vertices[collection.pointwise_map(i, j)[new_x]] - mesh_y.vertices[new_y]
    return np.linalg.norm(offsets, axis=1).mean() / np.sqrt(mesh_y.area)


@pytest.fixture
def matched(monkeypatch):
    """The pairs that a call matches, as lists of names."""
    pairs = []
    original = edges.match_edges

    def recording(tasks, *arguments):
        def noted():
            for task in tasks:
                pairs.append((task.x.mesh.name, task.y.mesh.name))
                yield task

        return original(noted(), *arguments)

    monkeypatch.setattr(edges, "match_edges", recording)
    return pairs


def test_all_pairs_are_matched_well_and_consistently(found, shapes):
    errors = [error(found, shapes, i, j) for i, j in permutations(range(5), 2)]
    assert len(found.edges) == 10
    assert np.mean(errors) < 0.03
    assert max(errors) < 0.1
    for i in range(5):
        there, back = found.from_template(i), found.to_template(i)
        template = found.meshes[found.template]
        assert there.shape == template.vertices.shape[:1]
        assert back.shape == found.meshes[i].vertices.shape[:1]
        detour = np.linalg.norm(template.vertices[back[there]] - template.vertices, axis=1)
        assert np.median(detour) == 0


def test_registered_meshes_have_the_template_s_triangulation(found):
    template = found.meshes[found.template]
    for mesh, registered in zip(found.meshes, found.registered, strict=True):
        assert registered.mesh.faces is template.faces
        assert np.quantile(registered.distances, 0.95) < 0.01 * np.sqrt(mesh.area)
    own = found.registered[found.template].vertices
    np.testing.assert_allclose(own, template.vertices, atol=1e-3 * np.sqrt(template.area))


def test_bad_numbers_of_shapes_are_refused(found):
    for numbers in ((0, -1), (-3, 0), (0, 99)):
        for method in (found.registered_mesh, found.pointwise_map):
            with pytest.raises(InputError, match="shape"):
                method(*numbers)


@pytest.mark.usefixtures("unchecked")
def test_equal_names_are_numbered_and_numpy_numbers_accepted(meshes):
    alike = [replace(mesh, name="mesh") for mesh in meshes[:2]]
    collection = match_collection(alike, preset="paper", edges_per_shape=np.int64(2), mirror="no")
    assert list(collection.names) == ["mesh 0", "mesh 1"]


def test_the_template_can_be_chosen(meshes, work):
    chosen = match_collection(
        meshes, preset="paper", edges_per_shape=2, mirror="no", directory=work, template=3
    )
    assert chosen.template == 3
    with pytest.raises(InputError, match="at least two meshes"):
        match_collection(meshes[:1], preset="paper")


def test_a_second_call_matches_nothing_and_gives_the_same_result(meshes, work, found, matched):
    again = match_collection(meshes, preset="paper", edges_per_shape=2, mirror="no", directory=work)
    assert matched == []
    for first, second in zip(found.registered, again.registered, strict=True):
        np.testing.assert_array_equal(first.vertices, second.vertices)
    assert again.edges == found.edges


@pytest.mark.sampled
def test_maps_of_another_eigensolver_are_not_reused(meshes, work, found, matched, monkeypatch):
    """A large mesh that is added to a collection changes the eigensolver of all shapes."""
    monkeypatch.setattr("jaxsmw.collection.matching.choose_eigensolver", lambda *_: "approximate")
    match_collection(meshes, preset="paper", edges_per_shape=2, mirror="no", directory=work)
    assert len(matched) >= len(found.edges)


def test_an_interrupted_call_continues(meshes, found, matched, tmp_path):
    class Interrupted(Exception):
        pass

    def interrupt(step, done, number):
        if step == "edges" and done == 4:
            raise Interrupted

    def run(progress=None):
        return match_collection(
            meshes, preset="paper", edges_per_shape=2, mirror="no", directory=tmp_path, progress=progress
        )

    with pytest.raises(Interrupted):
        run(interrupt)
    before = list(matched)
    # An unfinished temporary file and a damaged result, as a crash can leave them.
    (tmp_path / ".0123456789abcdef0123456789abcdef.npz").write_bytes(b"PK")
    damaged = next(tmp_path.glob("edge-*.npz"))
    damaged.write_bytes(damaged.read_bytes()[:1000])
    resumed = run()
    assert len(before) == 4
    # The fourth pair was matched, but not stored, and the damaged result is computed again.
    assert len(matched) == 4 + (10 - 3) + 1
    for first, second in zip(found.registered, resumed.registered, strict=True):
        np.testing.assert_array_equal(first.vertices, second.vertices)


@pytest.mark.slow
def test_an_added_mesh_is_matched_alone(meshes, matched, tmp_path):
    def run(number):
        return match_collection(
            meshes[:number], preset="paper", edges_per_shape=2, mirror="no", directory=tmp_path
        )

    run(4)
    matched.clear()
    added = run(5)
    assert 1 <= len(matched) <= 2
    assert all("shape4" in pair for pair in matched)
    assert len(added.meshes) == 5


def test_an_unusable_mesh_is_left_out_and_named(meshes, found, work):
    # A single triangle has too few vertices.
    triangle = make_mesh(np.eye(3), np.array([[0, 1, 2]]), name="triangle")
    result = match_collection(
        [*meshes, triangle], preset="paper", edges_per_shape=2, mirror="no", directory=work
    )
    assert list(result.left_out) == ["triangle"] and "3 vertices" in result.left_out["triangle"]
    assert result.names == found.names
    assert any("triangle" in sentence for sentence in result.sentences())


@pytest.mark.slow
def test_a_wrong_map_is_found_and_replaced(meshes, shapes, tmp_path, monkeypatch):
    """The first match of one pair maps every vertex to the mirror image of its match."""
    original = edges.match_edges

    def corrupting(tasks, *arguments):
        tasks = list(tasks)
        for task, edge in zip(tasks, original(iter(tasks), *arguments), strict=True):
            if task.init is None and (task.x.mesh.name, task.y.mesh.name) == ("shape1", "shape3"):
                shuffled = np.random.default_rng(0).permutation(len(edge.forward))
                back = np.random.default_rng(1).permutation(len(edge.backward))
                edge = edges.EdgeMap(
                    edge.forward[shuffled],
                    edge.backward[back],
                    edge.expected_error,
                    edge.distortion,
                )
            yield edge

    monkeypatch.setattr(edges, "match_edges", corrupting)
    options = {"preset": "paper", "edges_per_shape": 2, "mirror": "no", "directory": tmp_path}
    result = match_collection(meshes, **options)
    (edge,) = (edge for edge in result.edges if (edge.source, edge.target) == (1, 3))
    assert edge.decision == "replaced"
    # The same command keeps the template of its earlier results, which must not change the maps.
    again = match_collection(meshes, template=result.template, **options)
    for points, expected in zip(again.points, result.points, strict=True):
        np.testing.assert_array_equal(points.faces, expected.faces)
        np.testing.assert_array_equal(points.weights, expected.weights)
    assert "replaced" in edge.sentence(result.names)
    assert edge.residual < 0.05
    assert max(error(result, shapes, i, j) for i, j in permutations(range(5), 2)) < 0.1
    first, final = result.cycle_errors
    assert first.mean() > 3 * final.mean()


def test_a_mesh_whose_matches_all_fail_is_named(meshes, monkeypatch):
    original = edges.match_edges

    def failing(tasks, *arguments):
        for task in tasks:
            if "shape2" in (task.x.mesh.name, task.y.mesh.name):
                yield ArithmeticError(f"{task.x.mesh.name} to {task.y.mesh.name}: failed")
            else:
                yield from original(iter([task]), *arguments)

    monkeypatch.setattr(edges, "match_edges", failing)
    with pytest.raises(ArithmeticError, match="failed numerically: shape2"):
        match_collection(meshes[:3], preset="paper", edges_per_shape=2, mirror="no")


def test_the_store_keeps_kinds_and_inputs_apart(tmp_path):
    store = Store(tmp_path)
    store.save("edge", (np.arange(3), "a"), {"x": np.eye(2)})
    np.testing.assert_array_equal(store.load("edge", (np.arange(3), "a"))["x"], np.eye(2))
    assert store.load("edge", (np.arange(4), "a")) is None
    assert store.load("graph", (np.arange(3), "a")) is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"names": ["a", "b"]}, "2 different names for 5 meshes"),
        ({"names": list("abcda")}, "4 different names"),
        ({"mirror": "yes"}, "is not a mirror setting of a collection: choose auto, no"),
        ({"mirror": [True]}, "mirror has 1 entries for 5 meshes"),
        ({"template": 5}, "from 0 to 4"),
        ({"template": "a"}, "from 0 to 4"),
        ({"template": True}, "from 0 to 4"),
        ({"devices": []}, "give at least one JAX device"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": "0"}, "seed is '0'"),
        ({"stiffness": 0}, "stiffness is 0: give a positive finite number"),
        ({"edges_per_shape": 0}, "edges_per_shape is 0: give "),
        ({"edges_per_shape": np.inf}, "edges_per_shape is inf: give "),
        ({"edges_per_shape": None}, "edges_per_shape is None: give "),
        ({"directory": "no/such/directory"}, "is not a directory"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_arguments_are_refused(meshes, arguments, message):
    with pytest.raises(InputError, match=message):
        match_collection(meshes, preset="paper", **arguments)


def test_tasks_of_workers_are_kept_in_the_directory(meshes, work, found, monkeypatch):
    monkeypatch.setattr(edges, "TemporaryDirectory", None)
    with ThreadPoolExecutor(1) as executor:
        again = match_collection(
            meshes, preset="paper", edges_per_shape=2, mirror="no", directory=work, executor=executor
        )
    assert again.edges == found.edges


def test_sentences_name_shapes_that_do_not_fit(found):
    names = found.names
    (sentence,) = (text for text in replace(found, outliers=(1,)).sentences() if names[1] in text)
    assert "differ much" in sentence
    (sentence,) = (text for text in replace(found, outliers=(1, 3, 4)).sentences() if names[3] in text)
    assert "No good map was found for 3 of 5 shapes" in sentence
    nothing = replace(found, cycle_errors=(np.array([]), np.array([])))
    assert any("no cycles" in text for text in nothing.sentences())
    with pytest.raises(InputError, match="there is no shape 5"):
        found.pointwise_map(0, 5)


@pytest.mark.cluster
def test_workers_give_the_same_maps(meshes, found, tmp_path):
    from jaxsmw.runtime.workers import open_executor

    with open_executor(2) as executor:
        result = match_collection(
            meshes, preset="paper", edges_per_shape=2, mirror="no", directory=tmp_path, executor=executor
        )
    for i, j in permutations(range(5), 2):
        assert (result.pointwise_map(i, j) == found.pointwise_map(i, j)).mean() > 0.99


def signed_volume(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


@pytest.mark.slow
def test_meshes_of_the_other_hand_can_be_named(meshes, found):
    some = [mesh.mirrored() if number == 1 else mesh for number, mesh in enumerate(meshes)]
    result = match_collection(
        some, preset="paper", edges_per_shape=2, mirror=[False, True, False, False, False]
    )
    assert result.mirrored.tolist() == [False, True, False, False, False]
    for target in (0, 4):
        same = result.pointwise_map(1, target) == found.pointwise_map(1, target)
        assert same.mean() > 0.99


@pytest.mark.sampled
def test_shapes_of_the_other_hand_are_recognised(tmp_path):
    """Of four noisy asymmetric lumps, one is a mirror image."""
    lump = bumpy_mesh(3)
    lumps = []
    for seed in range(4):
        noise = 0.003 * np.random.default_rng(seed).normal(size=lump.vertices.shape)
        moved = Rotation.random(random_state=seed).apply(lump.vertices + noise)
        lumps.append(make_mesh(moved, lump.faces, name=f"lump{seed}"))
    lumps[2] = lumps[2].mirrored()
    result = match_collection(lumps, preset="paper", edges_per_shape=2)
    assert result.mirrored.tolist() == [False, False, True, False]
    assert any("other hand" in sentence and "lump2" in sentence for sentence in result.sentences())
    for i, j in permutations(range(4), 2):
        offsets = lumps[j].vertices[result.pointwise_map(i, j)] - lumps[j].vertices
        assert np.linalg.norm(offsets, axis=1).mean() < 0.02 * np.sqrt(lumps[j].area)
    # Faces of mirror images are written such that their normals point to the same side as on the meshes.
    template = lumps[result.template]
    files = write_registered(result, MeshData(template, template.faces), tmp_path, ".ply")
    for file, mesh in zip(files, lumps, strict=True):
        assert 0.9 < signed_volume(read_mesh(file)) / signed_volume(mesh) < 1.1
    # In the shape model, all lumps are of the template's hand, so they differ only by noise.
    model = result.shape_model()
    assert np.sqrt(model.total_variance) < 0.02 * np.sqrt(lump.area)


@pytest.mark.sampled
def test_real_people_through_the_template(shared):
    """Maps through the template are as good as direct maps, and no pair is lost."""
    data = shared / "data" / "faust_r"
    names = [f"tr_reg_{number:03}" for number in (0, 7, 12)]
    people = [read_mesh(data / "off" / f"{name}.off") for name in names]
    truth = [np.loadtxt(data / "corres" / f"{name}.vts", dtype=int) - 1 for name in names]
    result = match_collection(people, edges_per_shape=2.5, mirror="no")
    errors = []
    for i, j in permutations(range(3), 2):
        offsets = people[j].vertices[result.pointwise_map(i, j)[truth[i]]] - people[j].vertices[truth[j]]
        errors.append(np.linalg.norm(offsets, axis=1).mean() / np.sqrt(people[j].area))
    assert np.mean(errors) < 0.018
    assert max(errors) < 0.05


# ----------------------------------------------------------------------------------------------- the command


@pytest.fixture(scope="module")
def directory(meshes, tmp_path_factory):
    place = tmp_path_factory.mktemp("meshes")
    for mesh, suffix in zip(meshes[:4], (".ply", ".off", ".obj", ".stl"), strict=True):
        write_mesh(place / f"{mesh.name}{suffix}", mesh)
    for companion in ("notes.txt", "shape0.mtl", "skin.PNG", "points.fcsv", ".DS_Store"):
        (place / companion).write_text("not a mesh")
    (place / "broken.ply").write_text("ply\nformat")
    return place


def test_the_help_states_the_defaults_of_the_library(run):
    text = " ".join(run("collection", "--help").output.split())
    assert f"(default: {EDGES_PER_SHAPE})" in text
    assert "(default: accurate)" in text


OPTIONS = ("--preset", "paper", "--mirror", "no", "--edges", "2")


@pytest.fixture(scope="module")
def result_directory(directory, meshes, tmp_path_factory):
    from jaxsmw.cli.run import run_command

    output = tmp_path_factory.mktemp("results") / "result"
    landmarks = directory.parent / "shape1.csv"
    positions = meshes[1].vertices[[3, 50, 400]]
    write_landmark_file(landmarks, Landmarks(("a", "b", "c"), positions))
    sliders = directory.parent / "sliders.csv"
    sliders.write_text("before,slide,after\na,b,c\n")
    code = run_command(
        ["collection", str(directory), "--output", str(output), *OPTIONS, "--landmarks", str(landmarks),
         "--sliders", str(sliders),
         "--attributes-of", str(directory / "shape0.ply"), "--template", str(directory / "shape2.obj")]
    )  # fmt: skip
    assert code == 0
    return output


def test_the_command_writes_everything(result_directory):
    names = ["shape0", "shape1", "shape2", "shape3"]
    summary = json.loads((result_directory / "collection.json").read_text("utf-8"))
    assert summary["template"] == "shape2"
    assert [shape["name"] for shape in summary["shapes"]] == names
    assert list(summary["left_out"]) == ["broken.ply"]
    assert {edge["decision"] for edge in summary["edges"]} <= {"kept", "replaced", "contradicted"}
    template = read_mesh(result_directory / "registered" / "shape2.ply")
    for name in names:
        registered = read_mesh(result_directory / "registered" / f"{name}.ply")
        np.testing.assert_array_equal(registered.faces, template.faces)
        assert len((result_directory / "maps" / f"{name}_from_template.txt").read_text().split()) == len(
            template.vertices
        )
    modes = np.load(result_directory / "modes.npz")
    assert modes["modes"].shape == (3, len(template.vertices), 3)
    for row, name in enumerate(names):  # the mean and all modes together describe each shape exactly
        registered = read_mesh(result_directory / "registered" / f"{name}.ply").vertices
        moved = registered @ modes["matrices"][row].T + modes["translations"][row]
        displaced = np.einsum("v,vc,kvc->k", modes["weights"], moved - modes["mean"], modes["modes"])
        described = modes["mean"] + np.tensordot(displaced, modes["modes"], axes=1)
        np.testing.assert_allclose(moved, described, atol=1e-5 * np.ptp(moved))
    rows = list(csv.reader((result_directory / "scores.csv").read_text("utf-8").splitlines()))
    assert [row[0] for row in rows] == ["mesh", *names] and len(rows[1]) == 4
    assert read_mesh(result_directory / "mean.ply").vertices.shape == template.vertices.shape
    assert sorted(os.listdir(result_directory / "attributes")) == ["shape1.ply", "shape2.ply", "shape3.ply"]
    page = (result_directory / "index.html").read_text("utf-8")
    # The page has a list of its own for meshes that were left out, and does not name them a second time.
    assert "<html" in page and "<b>broken.ply</b>" in page and "Left out: broken.ply" not in page


def test_landmarks_appear_on_all_other_meshes(result_directory, shapes):
    _, new = shapes[1]
    rows = np.argsort(new)[[3, 50, 400]]  # the vertices of the creature
    for number in (0, 2, 3):
        mesh, other = shapes[number]
        carried = read_landmark_file(result_directory / "landmarks" / f"shape{number}.csv")
        assert carried.names == ("a", "b", "c")
        offsets = carried.positions - mesh.vertices[other[rows]]
        assert np.linalg.norm(offsets, axis=1).max() < 0.2 * np.sqrt(mesh.area)


def test_semilandmarks_are_written_for_all_meshes(result_directory, meshes):
    """The first and the last landmark do not slide, and the second slides on the surface."""
    rows = list(
        csv.reader((result_directory / "semilandmarks" / "semilandmarks.csv").read_text().splitlines())
    )
    assert [row[0] for row in rows] == ["mesh", *(f"shape{number}" for number in range(4))]
    for number in (0, 2, 3):
        points = np.array(rows[number + 1][1:], float).reshape(3, 3)
        carried = read_landmark_file(result_directory / "landmarks" / f"shape{number}.csv").positions
        np.testing.assert_allclose(points[[0, 2]], carried[[0, 2]], atol=1e-12)
        assert distances_to_surface(points, meshes[number]).max() < 1e-5 * np.sqrt(meshes[number].area)
    assert (result_directory / "semilandmarks" / "semilandmarks.tps").read_text().count("LM3=3\n") == 4


@pytest.mark.parametrize(
    ("text", "options", "naming"),
    [
        ("a,c,b\n", ("--landmarks", "{}"), "no landmark has the name 'c'"),
        ("a,b\n", ("--landmarks", "{}"), "line 1 is no slider"),
        (None, ("--landmarks", "{}"), "sliders.csv: does not exist"),
        ("a,b,c\n", (), "--sliders: has no effect without --landmarks"),
    ],
)
def test_bad_sliders_are_refused_before_the_computation(
    directory, meshes, run, tmp_path, text, options, naming
):
    landmarks, sliders = tmp_path / "shape1.csv", tmp_path / "sliders.csv"
    write_landmark_file(landmarks, Landmarks(("a", "b"), meshes[1].vertices[:2]))
    if text is not None:
        sliders.write_text(text)
    words = [word.format(landmarks) for word in options]
    outcome = run(
        "collection",
        directory,
        "--output",
        tmp_path / "out",
        *OPTIONS,
        *words,
        "--sliders",
        sliders,
        "--quiet",
    )
    assert outcome.code == 2 and naming in outcome.errors


def test_landmarks_in_another_unit_are_refused_before_the_computation(directory, meshes, run, tmp_path):
    landmarks = tmp_path / "landmarks.csv"
    write_landmark_file(landmarks, Landmarks(("a", "b"), 1000 * meshes[1].vertices[:2]))
    outcome = run(
        "collection", directory, "--output", tmp_path / "out", *OPTIONS, "--landmarks", landmarks,
        "--landmarks-of", "shape1.off",
    )  # fmt: skip
    assert outcome.code == 2 and "multiply the positions by 0.001" in outcome.errors
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_killed_runs_lose_nothing(directory, tmp_path):
    """The command is killed twice, whenever it has finished another pair."""

    def command(output):
        words = [sys.executable, "-m", "jaxsmw", "collection", directory, "--output", tmp_path / output]
        return [*map(str, words), *OPTIONS, "--quiet"]

    work, finished = tmp_path / "killed" / "work", 0
    for _ in range(2):
        process = subprocess.Popen(command("killed"), stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        while process.poll() is None and len(list(work.glob("edge-*.npz"))) <= finished:
            time.sleep(0.02)
        process.kill()
        process.wait()
        before, finished = finished, len(list(work.glob("edge-*.npz")))
        assert finished > before
    for output in ("killed", "whole"):
        subprocess.run(command(output), check=True, capture_output=True)
    for name in ("shape0", "shape1", "shape2", "shape3"):
        files = [tmp_path / output / "registered" / f"{name}.ply" for output in ("killed", "whole")]
        assert files[0].read_bytes() == files[1].read_bytes()
    assert not list(work.glob(".*.npz"))


def test_the_same_command_continues(result_directory, directory, run, matched):
    outcome = run("collection", directory, "--output", result_directory, *OPTIONS)
    assert outcome.code == 0, outcome.errors
    assert matched == []
    assert "4 shapes" in outcome.output and "Registered meshes: the mean distance" in outcome.output
    # The first run chose this template with `--template`.
    assert "template of the earlier results is kept: shape2" in outcome.errors
    assert json.loads((result_directory / "collection.json").read_text("utf-8"))["template"] == "shape2"
    assert "not read" not in outcome.errors  # the other files of the directory often accompany meshes


def test_files_that_are_not_read_are_named_in_one_line(result_directory, directory, run, tmp_path):
    place, output = tmp_path / "in", tmp_path / "out"
    shutil.copytree(directory, place)
    shutil.copytree(result_directory, output)
    (place / "folder.xyz").mkdir()
    (place / "link.ply").symlink_to("nowhere")
    for name in ("cloud.xyz", "Data.NPZ", "none", *(f"scan{number}.foo" for number in range(7))):
        (place / name).touch()
    outcome = run("collection", place, "--output", output, *OPTIONS, "--quiet")
    (line,) = (line for line in outcome.errors.splitlines() if "not read" in line)
    shown = [f"scan{number}.foo" for number in range(4)]
    listed = ", ".join(["Data.NPZ", "cloud.xyz", "link.ply (a broken link)", "none", *shown])
    assert f"{place}: these files are not read: {listed} and 3 more. Meshes have" in line


def test_other_settings_need_another_directory(result_directory, directory, run):
    outcome = run("collection", directory, "--output", result_directory, *OPTIONS, "--seed", "3", "--quiet")
    # The first line names the broken mesh.
    assert_refused(outcome._replace(errors=outcome.errors.split("\n", 1)[1]), naming="seed = 0")


def test_files_of_others_are_not_replaced(result_directory, directory, run, tmp_path):
    for name in ("index.html", "registered"):
        (tmp_path / name / "registered").mkdir(parents=True)
        (tmp_path / name / "registered" / "shape0.ply").write_text("precious")
        outcome = run("collection", directory, "--output", tmp_path / name, *OPTIONS, "--quiet")
        assert outcome.code == 2 and "contains registered, but no results of a collection" in outcome.errors
        assert os.listdir(tmp_path / name) == ["registered"]
    other = tmp_path / "other"
    other.mkdir()
    for file in directory.glob("shape*"):
        shutil.copy(file, other / f"body_{file.name}")
    before = (result_directory / "collection.json").read_bytes()
    outcome = run("collection", other, "--output", result_directory, *OPTIONS, "--quiet")
    assert_refused(outcome, naming="contains the results of other meshes, such as shape0")
    assert (result_directory / "collection.json").read_bytes() == before


def test_files_of_earlier_meshes_and_options_are_removed(result_directory, directory, meshes, run, tmp_path):
    output = tmp_path / "result"
    shutil.copytree(result_directory, output)
    (output / "registered" / "mine.txt").write_text("not a result")
    (tmp_path / "kept").write_text("outside of the results")
    summary = json.loads((output / "collection.json").read_text("utf-8"))
    summary["files"] += ["../kept", "registered/..", "maps/../../kept", 3]
    (output / "collection.json").write_text(json.dumps(summary), "utf-8")
    far = tmp_path / "far.csv"
    scales = np.array([[1.3], [1.0], [1.0]])
    write_landmark_file(far, Landmarks(("a", "b", "c"), scales * meshes[1].vertices[:3]))
    outcome = run(
        "collection", directory, "--output", output, *OPTIONS, "--exclude", "shape3.stl", "--suffix", "obj",
        "--landmarks", far, "--landmarks-of", "shape1.off",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    assert (tmp_path / "kept").exists()
    assert "3 shapes" in outcome.output and "from the surface" in outcome.errors
    names = ["shape0", "shape1", "shape2"]
    assert sorted(os.listdir(output / "registered")) == ["mine.txt", *(f"{name}.obj" for name in names)]
    assert sorted(os.listdir(output / "landmarks")) == ["shape0.csv", "shape2.csv"]
    assert os.listdir(output / "attributes") == []
    assert not any("shape3" in file for file in os.listdir(output / "maps"))
    assert not (output / "mean.ply").exists() and (output / "mean.obj").exists()


def test_a_failed_run_leaves_the_earlier_results_and_nothing_else(
    result_directory, directory, run, tmp_path, monkeypatch
):
    def files():
        found = {path.relative_to(output) for path in output.rglob("*") if path.is_file()}
        return {path: (output / path).read_bytes() for path in found if path.parts[0] != "work"}

    output = tmp_path / "result"
    shutil.copytree(result_directory, output)
    before = files()

    def fail(*_, **__):
        raise InputError("the disk is full: make room.")

    command = ("collection", directory, "--output", output, *OPTIONS, "--suffix", "obj", "--quiet")
    with monkeypatch.context() as patch:
        patch.setattr("jaxsmw.report.collection_page.write_collection_page", fail)
        assert run(*command).code == 2
    assert files() == before
    # A process that was killed while it wrote files left these.
    for place in ("registered", "work", "."):
        (output / place / f".{'0' * 32}.npz").touch()
    assert run(*command).code == 0
    summary = json.loads((output / "collection.json").read_text("utf-8"))
    assert {"workers", "scheduler", "suffix"} <= set(summary["provenance"]["settings"])
    assert {path.as_posix() for path in files()} == {
        *summary["files"], "collection.json", "provenance.json", ".lock"
    }  # fmt: skip
    assert not {"new", f".{'0' * 32}.npz"} & set(os.listdir(output / "work"))


@pytest.mark.parametrize(
    ("options", "naming"),
    [
        (("--suffix", ".docx"), ".docx"),
        (("--template", "elsewhere.ply"), "--template"),
        (("--exclude", "elsewhere.ply"), "--exclude"),
        (("--mirrored", "elsewhere.ply"), "--mirrored: elsewhere.ply is not a mesh file"),
        (("--mirrored", "shape0.ply", "--mirror", "no"), "--mirrored needs --mirror auto"),
        (("--landmarks-of", "shape0.ply"), "--landmarks"),
        (("--landmarks", "none.csv"), "none.csv: does not exist"),
        (("--attributes-of", "shape9.ply"), "--attributes-of"),
    ],
)
def test_bad_options_are_refused(directory, run, tmp_path, options, naming):
    outcome = run("collection", directory, "--output", tmp_path / "out", *options)
    assert_refused(outcome, naming=naming)
    assert not (tmp_path / "out").exists()


def test_a_directory_without_meshes_is_refused(run, tmp_path):
    assert_refused(run("collection", tmp_path, "--output", tmp_path / "out"), naming="needs two")
    assert_refused(run("collection", tmp_path / "none", "--output", tmp_path / "out"), naming="none")


def test_the_results_do_not_go_into_the_directory_of_the_meshes(directory, run):
    before = sorted(os.listdir(directory))
    assert_refused(run("collection", directory, "--output", directory), naming="another directory")
    assert sorted(os.listdir(directory)) == before


@pytest.mark.parametrize("folder", ["registered", "maps"])
def test_results_are_not_overwritten_as_inputs(result_directory, run, tmp_path, folder):
    output = tmp_path / "result"
    shutil.copytree(result_directory, output)
    for file in (output / "registered").glob("*.ply"):
        file.rename(output / folder / f"m{file.name}")
    before = {file: file.read_bytes() for file in (output / folder).iterdir()}
    outcome = run("collection", output / folder, "--output", output, *OPTIONS)
    assert_refused(outcome, naming="lies among the results")
    assert {file: file.read_bytes() for file in (output / folder).iterdir()} == before


def test_given_landmarks_are_not_overwritten(directory, meshes, run, tmp_path):
    landmarks = tmp_path / "out" / "landmarks" / "shape1.csv"
    landmarks.parent.mkdir(parents=True)
    write_landmark_file(landmarks, Landmarks(("a",), meshes[0].vertices[:1]))
    options = ("--landmarks", landmarks, "--landmarks-of", "shape0.ply")
    outcome = run("collection", directory, "--output", tmp_path / "out", *OPTIONS, *options)
    assert_refused(outcome, naming="lies among the results")


def test_names_that_are_too_long_are_refused_before_the_computation(meshes, run, tmp_path):
    for number, stem in enumerate(("x" * 230, "short")):
        write_mesh(tmp_path / f"{stem}.ply", meshes[number])
    outcome = run("collection", tmp_path, "--output", tmp_path / "out", *OPTIONS)
    assert_refused(outcome, naming="too long")


@pytest.mark.slow
def test_a_damaged_summary_and_names_of_any_bytes_do_not_stop_the_results(meshes, run, tmp_path):
    inputs, output = tmp_path / "in", tmp_path / "out"
    inputs.mkdir()
    for number, name in enumerate(
        (b"bad\xff.ply", "sch\xf6n.ply".encode(), b"a_ply.ply", b"a.ply", b"a.off")
    ):
        write_mesh(inputs / os.fsdecode(name), meshes[number])
    for _ in range(2):
        outcome = run("collection", inputs, "--output", output, *OPTIONS[:-1], "1")
        assert outcome.code == 0, outcome.errors
        summary = (output / "collection.json").read_text("utf-8")
        (output / "collection.json").write_text("[" * 100_000)
    names = json.loads(summary)["shapes"]
    assert len({shape["name"] for shape in names}) == 5 == len(list((output / "registered").iterdir()))
    assert len((output / "scores.csv").read_text("utf-8", "surrogateescape").splitlines()) == 6


def test_names_with_equal_stems_are_kept_apart(meshes, run, tmp_path):
    for suffix, mesh in ((".ply", meshes[0]), (".off", meshes[1])):
        write_mesh(tmp_path / f"a{suffix}", mesh)
    outcome = run("collection", tmp_path, "--output", tmp_path / "out", *OPTIONS)
    assert outcome.code == 0, outcome.errors
    assert sorted(path.name for path in Path(tmp_path / "out" / "registered").iterdir()) == [
        "a_off.ply",
        "a_ply.ply",
    ]
