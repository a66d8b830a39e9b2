"""The command line as a user meets it."""

import base64
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import trimesh
from synthetic import bumpy_mesh, grid_mesh

from jaxsmw.cli.main import _BANKS, _NOT_TIGHT, main
from jaxsmw.core.banks import filters
from jaxsmw.core.frames import frame_bounds
from jaxsmw.evaluation.ground_truth import read_ground_truth
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.mesh_files import read_mesh, write_mesh
from jaxsmw.report.texture import TEXTURE_FILES

SMALL = ["--eigenvectors", "20", "--filters", "4"]


class Outcome:
    def __init__(self, code: int, output: str, errors: str) -> None:
        self.code, self.output, self.errors = code, output, errors


@pytest.fixture
def run(capsys):
    """Run the command line in this process."""

    def run(*arguments: object) -> Outcome:
        with pytest.raises(SystemExit) as exit_of:
            main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Outcome(exit_of.value.code, captured.out, captured.err)

    return run


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> Path:
    """A directory with a body, a renumbered and noisy copy, and the truth in several formats."""
    directory = tmp_path_factory.mktemp("pair")
    mesh = bumpy_mesh(3)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    truth = np.argsort(order)
    write_mesh(directory / "x.off", mesh)
    noisy = mesh.vertices[order] + 0.01 * np.random.default_rng(1).normal(size=mesh.vertices.shape)
    write_mesh(directory / "y.ply", make_mesh(noisy * 3, truth[mesh.faces]))
    np.savetxt(directory / "truth.txt", truth, fmt="%d")
    np.savetxt(directory / "truth1.txt", truth + 1, fmt="%d")
    np.savetxt(directory / "x.vts", np.arange(len(truth)) + 1, fmt="%d")
    np.savetxt(directory / "y.vts", truth + 1, fmt="%d")
    np.savetxt(
        directory / "landmarks.txt", np.stack([np.arange(5) * 50, truth[np.arange(5) * 50]], 1), fmt="%d"
    )
    return directory


def mean_error(line: str) -> float:
    return float(re.search(r"mean ([\d.]+)", line)[1])


def test_help_of_every_command_without_loading_jax():
    code = (
        "import sys, jaxsmw.cli.main\n"
        "try: jaxsmw.cli.main.main(['--help'])\n"
        "finally: assert 'jax' not in sys.modules and 'scipy' not in sys.modules"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for command in ("demo", "match", "evaluate", "spectrum", "render"):
        assert command in result.stdout


@pytest.mark.parametrize("command", ["demo", "match", "evaluate", "spectrum", "render"])
def test_help_of_a_command(run, command):
    outcome = run(command, "--help")
    assert outcome.code == 0 and outcome.output.startswith(f"usage: jaxsmw {command}")


def test_version(run):
    assert re.fullmatch(r"jaxsmw \d+\.\d+\.\d+\S*\n", run("--version").output)


def test_runs_as_a_module():
    result = subprocess.run([sys.executable, "-m", "jaxsmw", "--version"], capture_output=True, check=True)
    assert result.stdout.startswith(b"jaxsmw ")


def test_match_and_evaluate(run, pair, tmp_path):
    output = tmp_path / "map.txt"
    outcome = run(
        "match",
        pair / "x.off",
        pair / "y.ply",
        "--output",
        output,
        *SMALL,
        "--ground-truth",
        pair / "truth.txt",
    )
    assert outcome.code == 0, outcome.errors
    lines = output.read_text().splitlines()
    assert len(lines) == 642 and all(line.isdigit() for line in lines)
    before, after = (line for line in outcome.output.splitlines() if "map:" in line)
    assert mean_error(after) < 0.02 < mean_error(before)
    assert "refinement" in outcome.errors and "642 vertices" in outcome.errors

    for truth in (
        [pair / "truth.txt"],
        [pair / "x.vts", pair / "y.vts"],
        [pair / "truth1.txt", "--index-base", "1"],
    ):
        if "--index-base" in truth:  # the base is that of all files of the call
            np.savetxt(tmp_path / "map1.txt", np.loadtxt(output, int) + 1, fmt="%d")
            maps = [tmp_path / "map1.txt"]
        else:
            maps = [output]
        evaluated = run("evaluate", pair / "x.off", pair / "y.ply", *maps, "--ground-truth", *truth)
        assert evaluated.code == 0, evaluated.errors
        assert mean_error(evaluated.output) == mean_error(after)
        assert "strips" in evaluated.output


def test_a_tiny_mesh_is_told_what_it_lacks(run, tmp_path):
    (tmp_path / "tetrahedron.off").write_text(OFF.format(4, 4, TRIANGLES, FACES))
    call = ["match", *[tmp_path / "tetrahedron.off"] * 2, "--output", tmp_path / "map.txt", "--quiet"]
    assert_refused(run(*call), naming="--init wks")
    assert_refused(run(*call, "--eigenvectors", "100"), naming="choose a number from 1 to 3")
    assert_refused(run(*call, "--eigenvectors", "1", "--init", "hks"), naming="with 1 eigenvectors")
    assert_refused(run(*call, "--eigenvectors", "3"), naming="--init wks")
    assert run(*call, "--eigenvectors", "3", "--init", "hks").code == 0


def test_missing_matplotlib_is_told_before_the_work(run, pair, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    meshes, truth = [pair / "x.off", pair / "y.ply"], pair / "truth.txt"
    for arguments in (
        ["match", *meshes, "--output", tmp_path / "m", "--report", tmp_path / "r"],
        ["demo", "--output", tmp_path / "demo"],
        ["spectrum", pair / "x.off", "--figure", tmp_path / "s.png"],
        ["evaluate", *meshes, truth, "--ground-truth", truth, "--page", tmp_path / "p.html"],
    ):
        assert_refused(run(*arguments, "--quiet"), naming="pip install 'jaxsmw[report]'")
    assert list(tmp_path.iterdir()) == []


def test_benchmarks_without_their_libraries_are_refused(run, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "jaxsmw.evaluation.benchmark", raising=False)
    monkeypatch.setitem(sys.modules, "tqdm", None)
    outcome = run("benchmark", tmp_path, "--output", tmp_path / "o")
    assert_refused(outcome, naming="pip install 'jaxsmw[benchmark]'")
    assert list(tmp_path.iterdir()) == []


def test_banks_said_to_be_not_tight_are_those():
    for name, kind in _BANKS.items():
        lower, upper = frame_bounds(getattr(filters, kind)(), jnp.arange(101.0), over="interval")
        assert (0.99 < lower <= upper < 1.01) == (name not in _NOT_TIGHT)


def test_a_bank_that_is_not_tight_gets_a_note(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet", *SMALL]
    for bank, solution, noted in (
        ("mexican-hat", "filtering", True),
        ("mexican-hat", "least-squares", False),
        ("itersine", "filtering", False),
        ("adapted-itersine", "filtering", False),
    ):
        outcome = run(*call, "--bank", bank, "--solution", solution)
        assert outcome.code == 0
        assert (f"{bank} is no tight frame" in outcome.errors) == noted


def test_quiet_is_quiet(run, pair, tmp_path):
    outcome = run("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet", *SMALL)
    assert outcome.code == 0 and outcome.errors == ""


@pytest.mark.parametrize(
    "options",
    [
        ["--init", "wks"],
        ["--init", "landmarks:{pair}/landmarks.txt"],
        ["--init", "map:{pair}/truth.txt"],
        ["--iterations", "1"],
        ["--samples", "40"],
        ["--eigenvectors", "15"],
        ["--init", "functional"],
        ["--filters", "2"],
        ["--bank", "itersine"],
        ["--bank", "adapted-itersine"],
        ["--bank", "cubic-spline"],
        ["--solution", "least-squares"],
        ["--solution", "least-squares-frobenius"],
        ["--solution", "regularized"],
        ["--laplacian", "robust"],
        ["--precision", "float64"],
        ["--stop-when-unchanged", "--iterations", "20"],
    ],
    ids=" ".join,
)
def test_options_reach_the_method(run, pair, tmp_path, options, monkeypatch):
    import jaxsmw.matching

    calls, match = [], jaxsmw.matching.match

    def recorded(*meshes, **settings):
        calls.append((settings, match(*meshes, **settings)))
        return calls[-1][1]

    monkeypatch.setattr(jaxsmw.matching, "match", recorded)
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", *SMALL]
    assert run(*call).code == 0
    assert run(*call, *(option.format(pair=pair) for option in options)).code == 0
    (settings, plain), (other_settings, changed) = calls
    if "--stop-when-unchanged" in options:
        assert changed.iterations < 20
    elif "--laplacian" in options:  # the two Laplacians agree on triangles as good as these
        assert (settings["laplacian"], other_settings["laplacian"]) == ("auto", "robust")
    else:
        assert plain.functional_map.shape != changed.functional_map.shape or not np.array_equal(
            plain.functional_map, changed.functional_map
        )
    assert changed.functional_map.dtype == (np.float64 if "float64" in options else np.float32)


def test_report(run, pair, tmp_path):
    report = tmp_path / "deep" / "report"
    outcome = run(
        "match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", "--report", report, *SMALL,
        "--ground-truth", pair / "truth.txt", "--evaluation-samples", "100", "--seed", "3",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    assert sorted(path.name for path in report.iterdir()) == [
        "correspondence.png", "filters.png", "functional_map.png", "quality.png", "report.html", "summary.json",
    ]  # fmt: skip
    summary = json.loads((report / "summary.json").read_text())
    assert summary["settings"]["eigenvectors"] == 20 and summary["settings"]["preset"] == "paper"
    assert summary["result"]["vertices"] == "642 to 642"
    assert summary["provenance"]["jax"]
    assert "x.off to y.ply" in (report / "report.html").read_text()
    refined, initial = shown_maps(report / "report.html")
    assert (refined["name"], initial["name"]) == ("refined", "initial")
    assert set(refined["errors"]) == {"Error", "Expected error"} and set(initial["errors"]) == {"Error"}
    assert refined["functional"]["columns"] == initial["functional"]["columns"] == 20
    assert refined["functional"] != initial["functional"] and refined["map"] != initial["map"]


def test_presets(run, pair, tmp_path):
    """Accurate by default; options that change the paper's method are for that alone."""
    maps = {}
    for options in ((), ("--preset", "accurate"), ("--preset", "paper"), ("--eigenvectors", "100"),
                    ("--preset", "fast"), ("--samples", "500")):  # fmt: skip
        outcome = run("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", *options)
        assert outcome.code == 0, outcome.errors
        maps[options] = (tmp_path / "m").read_text()
    default, accurate, paper, changed, fast, sampled = maps.values()
    assert default == accurate != paper == changed != fast == sampled != default
    call = ("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet")
    outcome = run(*call, "--preset", "accurate", "--stop-when-unchanged")
    assert_refused(outcome, naming="--stop-when-unchanged: changes the paper's method")


def test_evaluate_writes_figures_and_numbers(run, pair, tmp_path):
    np.savetxt(tmp_path / "zero.txt", np.zeros(642), fmt="%d")
    outcome = run(
        "evaluate", pair / "x.off", pair / "y.ply", pair / "truth.txt", tmp_path / "zero.txt",
        "--ground-truth", pair / "truth.txt", "--output", tmp_path / "e.json", "--figure", tmp_path / "e.png",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    perfect, zero = json.loads((tmp_path / "e.json").read_text()).values()
    assert perfect["mean"] == 0 and zero["mean"] > 0.1
    assert (tmp_path / "e.png").read_bytes().startswith(b"\x89PNG")


def shown_maps(page: Path) -> list[dict]:
    data = re.search(r'id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    return json.loads(data[1])["maps"]


def test_a_page_compares_maps(run, pair, tmp_path):
    np.savetxt(tmp_path / "zero.txt", np.zeros(642), fmt="%d")
    meshes, maps = (pair / "x.off", pair / "y.ply"), (pair / "truth.txt", tmp_path / "zero.txt")
    evaluated, rendered = tmp_path / "evaluated.html", tmp_path / "rendered.html"
    outcome = run("evaluate", *meshes, *maps, "--ground-truth", pair / "truth.txt", "--page", evaluated)
    assert outcome.code == 0, outcome.errors
    assert run("render", *meshes, *maps, "--output", rendered, "--up", "z").code == 0
    for page in (evaluated, rendered):
        perfect, zero = shown_maps(page)
        assert (perfect["name"], zero["name"]) == ("truth", "zero")
        assert perfect["map"] != zero["map"] and perfect["functional"] != zero["functional"]
        assert perfect["functional"]["columns"] == 100
        assert 'value="wavelets"' in page.read_text()
        names = {"Error"} if page == evaluated else set()
        assert perfect["errors"].keys() == zero["errors"].keys() == names
    rows = re.findall(r'<tr><th scope="row">(\w+)</th><td>([\d.]+)<', evaluated.read_text())
    means = [mean_error(line) for line in outcome.output.splitlines()]
    assert [name for name, _ in rows] == ["truth", "zero"]
    assert [float(mean) for _, mean in rows] == pytest.approx(means, abs=1e-4)
    # Files of one name are told apart by more of their paths.
    (tmp_path / "other").mkdir()
    np.savetxt(tmp_path / "other" / "zero.txt", np.ones(642), fmt="%d")
    two = tmp_path / "zero.txt", tmp_path / "other" / "zero.txt"
    assert run("render", *meshes, *two, "--output", rendered).code == 0
    assert [shown["name"] for shown in shown_maps(rendered)] == [str(path) for path in two]


@pytest.mark.filterwarnings("default:the page does without wavelets")
def test_a_page_of_a_part_and_the_whole(run, pair, tmp_path):
    """Eigenvalues as they are in the same unit, up to the same; where that cannot be, a page all the same."""
    call = ["render", pair / "x.off", pair / "y.ply", pair / "truth.txt", "--output", tmp_path / "p.html"]
    assert run(*call, "--partial").code == 0
    # The smaller has fewer eigenvalues in that range.
    functional = shown_maps(tmp_path / "p.html")[0]["functional"]
    rows = len(base64.b64decode(functional["values"])) // (4 * functional["columns"])
    assert rows < 30 < functional["columns"] == 100
    mesh = read_mesh(pair / "y.ply")
    write_mesh(tmp_path / "large.off", make_mesh(1e3 * mesh.vertices, mesh.faces))
    outcome = run(*call[:2], tmp_path / "large.off", *call[3:], "--partial")
    assert outcome.code == 0 and "warning: the page does without wavelets" in outcome.errors
    assert shown_maps(tmp_path / "p.html")[0]["functional"] is None


def test_spectrum(run, pair, tmp_path):
    outcome = run(
        "spectrum", pair / "x.off", "--eigenvectors", 12, "--output", tmp_path / "s.npz", "--figure", tmp_path / "s.png"
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    assert "642 vertices" in outcome.output and "cotangent" in outcome.output
    saved = np.load(tmp_path / "s.npz")
    gram = saved["eigenvectors"].T @ (saved["vertex_areas"][:, None] * saved["eigenvectors"])
    np.testing.assert_allclose(gram, np.eye(12), atol=1e-8)
    assert (tmp_path / "s.png").stat().st_size > 1000


def test_spectrum_for_matlab(run, pair, tmp_path):
    outcome = run("spectrum", pair / "y.ply", "--eigenvectors", 12, "--output", tmp_path / "s.mat")
    assert outcome.code == 0, outcome.errors
    shape = scipy.io.loadmat(tmp_path / "s.mat")["S"][0, 0]
    np.testing.assert_allclose(shape["evecs"].T @ shape["A"] @ shape["evecs"], np.eye(12), atol=1e-8)
    assert len(read_mesh(tmp_path / "s.mat").faces) == len(read_mesh(pair / "y.ply").faces)


def test_maps_for_and_from_matlab(run, pair, tmp_path):
    meshes = pair / "x.off", pair / "y.ply"
    truth = np.loadtxt(pair / "truth.txt", dtype=int)
    scipy.io.savemat(tmp_path / "truth.mat", {"T12": truth + 1})
    scipy.io.savemat(tmp_path / "from_0.mat", {"T12": truth})
    written = tmp_path / "map.mat"
    init = f"map:{tmp_path / 'truth.mat'}"
    for name in ("map.txt", "map.mat"):
        outcome = run("match", *meshes, *SMALL, "--init", init, "--output", tmp_path / name, "--quiet")
        assert outcome.code == 0 and "counts, from 1" in outcome.errors
    found = scipy.io.loadmat(written)["T12"]
    np.testing.assert_array_equal(found[:, 0] - 1, np.loadtxt(tmp_path / "map.txt"))
    # The truth, too, is read as MATLAB counts, and a note says how maps are.
    call = ("evaluate", *meshes, tmp_path / "truth.mat", "--ground-truth", tmp_path / "truth.mat", "--quiet")
    outcome = run(*call)
    assert outcome.code == 0 and mean_error(outcome.output) == 0
    assert outcome.errors.count(f"note: {tmp_path / 'truth.mat'} is read as MATLAB counts, from 1") == 2
    from_0 = ("evaluate", *meshes, tmp_path / "from_0.mat", "--ground-truth", pair / "truth.txt", "--quiet")
    assert run(*from_0).code == 2
    outcome = run(*from_0, "--index-base", "0")
    assert outcome.code == 0 and mean_error(outcome.output) == 0 and not outcome.errors


def test_render(run, pair, tmp_path):
    for name, inputs in {
        "one.png": ["x.off"],
        "two.png": ["x.off", "y.ply", "truth.txt"],
        "two.html": ["x.off", "y.ply", "truth.txt"],
    }.items():
        outcome = run("render", *(pair / path for path in inputs), "--output", tmp_path / name)
        assert outcome.code == 0, outcome.errors
        assert (tmp_path / name).stat().st_size > 5000


def test_seams_are_named_and_welded(run, tmp_path):
    vertices, faces = grid_mesh(12, 12)
    soup = make_mesh(vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    write_mesh(tmp_path / "soup.off", soup)
    plain = run("spectrum", tmp_path / "soup.off", "--eigenvectors", "5")
    assert "--weld" in plain.output and "242 connected components" in plain.output
    assert (
        "1 connected component"
        in run("spectrum", tmp_path / "soup.off", "--eigenvectors", "5", "--weld").output
    )


def test_demo(run, tmp_path):
    small = ["--vertices", "1000", "--preset", "paper", "--eigenvectors", "40"]
    outcome = run("demo", "--output", tmp_path / "demo", *small)
    assert outcome.code == 0, outcome.errors
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert {
        "source.off",
        "target.off",
        "truth.baryc_gt",
        "map.txt",
        "report.html",
        "correspondence.png",
    } <= names
    before, after = (mean_error(line) for line in outcome.output.splitlines() if "map:" in line)
    assert after < before / 2
    again = run(
        "evaluate", *(tmp_path / "demo" / name for name in ("source.off", "target.off", "map.txt")),
        "--ground-truth", tmp_path / "demo" / "truth.baryc_gt",
    )  # fmt: skip
    assert mean_error(again.output) == pytest.approx(after, abs=2e-4)


def test_surface_points_are_written_and_measured(run, pair, tmp_path):
    x, y, points = pair / "x.off", pair / "y.ply", tmp_path / "points.baryc_gt"
    call = ["match", x, y, "--output", tmp_path / "map.txt", *SMALL]
    truth = ["--ground-truth", pair / "truth.txt"]
    outcome = run(*call, "--surface-points", points, *truth)
    assert outcome.code == 0, outcome.errors
    initial, surface, refined = (line for line in outcome.output.splitlines() if "map:" in line)
    assert surface.startswith("surface map:")
    # The truth is a vertex everywhere, so that the refined map, of vertices, may hit it exactly.
    assert mean_error(refined) < mean_error(surface) < 0.02 < mean_error(initial)

    mesh_y = read_mesh(y)
    written = read_ground_truth(points, read_mesh(x), mesh_y).targets
    matched = mesh_y.vertices[np.loadtxt(tmp_path / "map.txt", dtype=int)]
    apart = np.linalg.norm(written.positions(mesh_y) - matched, axis=1)
    assert 0 < np.median(apart) < 0.05 * mesh_y.area**0.5


def test_the_expected_error_is_written(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", *SMALL]
    assert run(*call, "--expected-error", tmp_path / "expected.txt").code == 0
    expected = np.loadtxt(tmp_path / "expected.txt")
    assert expected.shape == (642,) and expected.min() >= 0 and expected.mean() < 0.02
    assert_refused(run(*call, "--expected-error", tmp_path / "map.txt"), naming="another output as well")


def test_the_report_is_no_place_for_the_map(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--quiet", *SMALL]
    (tmp_path / "r").mkdir()
    for output in (tmp_path / "r" / "report.html", tmp_path / "new"):
        directory = tmp_path / "r" if output.name == "report.html" else output
        outcome = run(*call, "--output", output, "--report", directory)
        assert_refused(outcome, naming="is another output as well")
    assert not (tmp_path / "new").exists() and not list((tmp_path / "r").iterdir())


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("points.txt", "ends in it"),
        ("missing/points.baryc_gt", "missing"),
        ("truth.baryc_gt", "is an input"),
        ("errors.baryc_gt", "another output as well"),
        ("start.baryc_gt", "is an input"),
    ],
)
def test_surface_points_that_cannot_be_written(run, pair, tmp_path, name, fault):
    (tmp_path / "truth.baryc_gt").write_text("1 1 0 0\n" * 642)
    (tmp_path / "start.baryc_gt").write_text("0\n" * 642)
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", *SMALL, "--quiet"]
    call += ["--init", f"map:{tmp_path / 'start.baryc_gt'}", "--ground-truth", tmp_path / "truth.baryc_gt"]
    call += ["--expected-error", tmp_path / "errors.baryc_gt"]
    assert_refused(run(*call, "--surface-points", tmp_path / name), naming=fault)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["start.baryc_gt", "truth.baryc_gt"]
    assert (tmp_path / "start.baryc_gt").read_text() == "0\n" * 642


def test_one_to_one_map_and_texture_are_written(run, pair, tmp_path):
    x, y, points = pair / "x.off", pair / "y.ply", tmp_path / "points.baryc_gt"
    call = ["match", x, y, "--output", tmp_path / "map.txt", *SMALL, "--ground-truth", pair / "truth.txt"]
    call += ["--one-to-one", tmp_path / "one.txt", "--texture", tmp_path / "texture"]
    outcome = run(*call, "--surface-points", points)
    assert outcome.code == 0, outcome.errors
    assert "one-to-one map: " in outcome.output
    one_to_one = np.loadtxt(tmp_path / "one.txt", dtype=int)
    np.testing.assert_array_equal(np.sort(one_to_one), np.arange(642))

    directory = tmp_path / "texture"
    assert {path.name for path in directory.iterdir()} == set(TEXTURE_FILES)
    meshes, coordinates = {}, {}
    for name, path in (("source", x), ("target", y)):
        original, meshes[name] = read_mesh(path), read_mesh(directory / f"{name}.obj")
        np.testing.assert_array_equal(meshes[name].vertices, original.vertices)
        np.testing.assert_array_equal(meshes[name].faces, original.faces)
        loaded = trimesh.load(directory / f"{name}.obj", process=False, maintain_order=True)
        assert loaded.visual.material.image.size == (1024, 1024)
        coordinates[name] = loaded.visual.uv
        assert loaded.visual.uv.min() >= 0 and loaded.visual.uv.max() <= 1
        np.testing.assert_allclose(loaded.vertices, original.vertices, atol=1e-8)
    # The same point of the body has the same point of the picture.
    carried = read_ground_truth(points, meshes["source"], meshes["target"]).targets
    faces, weights = meshes["target"].faces[carried.faces], carried.weights
    expected = np.einsum("pk,pku->pu", weights, coordinates["target"][faces])
    np.testing.assert_allclose(coordinates["source"], expected, atol=1e-6)


def test_one_to_one_map_that_does_not_exist_is_refused_at_once(run, pair, tmp_path):
    write_mesh(tmp_path / "small.off", bumpy_mesh(2))
    call = ["match", pair / "x.off", tmp_path / "small.off", "--output", tmp_path / "map.txt", *SMALL]
    outcome = run(*call, "--quiet", "--one-to-one", tmp_path / "one.txt")
    assert_refused(outcome, naming="642 vertices of the source cannot be matched one to one to the 162")
    assert not (tmp_path / "map.txt").exists()


def test_outputs_of_one_name_are_refused(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "source.obj", *SMALL]
    assert_refused(run(*call, "--one-to-one", tmp_path / "source.obj"), naming="another output as well")
    assert_refused(run(*call, "--texture", tmp_path), naming="another output as well")
    (tmp_path / "target.obj").write_text("v 0 0 0\n")
    call = ["match", pair / "x.off", tmp_path / "target.obj", "--output", tmp_path / "map.txt", *SMALL]
    assert_refused(run(*call, "--texture", tmp_path), naming="is an input")


OFF = "OFF\n{} {} 0\n{}\n{}\n"
TRIANGLES = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
FACES = "3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
HOSTILE_MESHES = {
    "empty.off": b"",
    "blank.off": b"\n\n\n",
    "junk.off": bytes(range(256)) * 20,
    "junk.ply": bytes(range(256)) * 20,
    "junk.stl": bytes(range(256)) * 20,
    "junk.obj": bytes(range(256)) * 20,
    "header_only.off": b"OFF\n",
    "promises_more.off": OFF.format(400, 4, TRIANGLES, FACES).encode(),
    "promises_fewer.off": OFF.format(2, 1, TRIANGLES, FACES).encode(),
    "promises_a_trillion.off": OFF.format(10**12, 10**12, TRIANGLES, FACES).encode(),
    "negative_counts.off": OFF.format(-4, -4, TRIANGLES, FACES).encode(),
    "words.off": OFF.format(4, 4, TRIANGLES.replace("1", "one"), FACES).encode(),
    "truncated.off": OFF.format(4, 4, TRIANGLES, FACES).encode()[:40],
    "nan.off": OFF.format(4, 4, TRIANGLES.replace("1 0 0", "nan 0 0"), FACES).encode(),
    "infinite.off": OFF.format(4, 4, TRIANGLES.replace("1 0 0", "inf 0 0"), FACES).encode(),
    "overflow.off": OFF.format(4, 4, TRIANGLES.replace("1 0 0", "1e999 0 0"), FACES).encode(),
    "out_of_range.off": OFF.format(4, 4, TRIANGLES, FACES.replace("3 2\n", "3 4\n")).encode(),
    "negative_index.off": OFF.format(4, 4, TRIANGLES, FACES.replace("3 2\n", "3 -2\n")).encode(),
    "huge_index.off": OFF.format(
        4, 4, TRIANGLES, FACES.replace("3 2\n", "3 99999999999999999999\n")
    ).encode(),
    "two_corners.off": OFF.format(4, 4, TRIANGLES, FACES.replace("3 0 3 2", "2 0 3")).encode(),
    "no_faces.off": OFF.format(4, 0, TRIANGLES, "").encode(),
    "no_area.off": OFF.format(4, 4, TRIANGLES.replace("1", "0"), FACES).encode(),
    "no_end.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n",
    "short.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n1234",
    "no_z.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
    "lying.stl": b"\0" * 80 + (10**9).to_bytes(4, "little") + b"\0" * 50,
    "points.obj": b"v 0 0 0\nv 1 0 0\n",
    "zero.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n",
    "mesh.xyz": b"0 0 0\n",
    "mesh": b"OFF\n",
}


@pytest.mark.parametrize("name", HOSTILE_MESHES)
def test_hostile_meshes(run, pair, tmp_path, name):
    (tmp_path / name).write_bytes(HOSTILE_MESHES[name])
    for meshes in ([tmp_path / name, pair / "y.ply"], [pair / "x.off", tmp_path / name]):
        outcome = run("match", *meshes, "--output", tmp_path / "map.txt", "--quiet", *SMALL)
        assert_refused(outcome, naming=name)
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


HOSTILE_MAPS = {
    "empty": "",
    "too short": "0\n" * 641,
    "too long": "0\n" * 643,
    "out of range": "0\n" * 641 + "642\n",
    "negative": "0\n" * 641 + "-1\n",
    "huge": "0\n" * 641 + "9" * 40 + "\n",
    "fractions": "0.5\n" * 642,
    "words": "zero\n" * 642,
    "nan": "nan\n" * 642,
    "two columns": "0 0\n" * 642,
    "binary": "\0\1\2" * 300,
    "one-based": "\n".join(str(i) for i in range(1, 643)),
}


@pytest.mark.parametrize("use", ["init", "truth", "evaluate", "render"])
@pytest.mark.parametrize("name", HOSTILE_MAPS)
def test_hostile_maps(run, pair, tmp_path, name, use):
    if (name, use) == ("two columns", "truth"):
        pytest.skip("two columns are a legal form of ground truth")
    path = tmp_path / "hostile.txt"
    path.write_text(HOSTILE_MAPS[name])
    meshes, output = (pair / "x.off", pair / "y.ply"), tmp_path / "out.png"
    truth = ["--ground-truth", pair / "truth.txt"]
    outcome = {
        "init": lambda: run("match", *meshes, "--init", f"map:{path}", "--output", output, "--quiet"),
        "truth": lambda: run("match", *meshes, "--ground-truth", path, "--output", output, "--quiet"),
        "evaluate": lambda: run("evaluate", *meshes, path, *truth, "--figure", output, "--quiet"),
        "render": lambda: run("render", *meshes, path, "--output", output, "--quiet"),
    }[use]()
    assert_refused(outcome, naming="hostile.txt")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hostile.txt"]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("match {x} {y}", "--output"),
        ("match {x} {y} --output {t}/no/such/map.txt", "no/such"),
        (
            "match {x} {y} --output {t}/m --evaluation-samples 9",
            "--evaluation-samples: is for --ground-truth",
        ),
        ("match {x} {y} --output {t}/m --index-base 1", "--index-base: is for --ground-truth or a file"),
        ("match {x} {y} --output {t}/m --up z", "--up: is for a --report"),
        ("match {x} {y} --output {t}/m --geodesics exact", "--geodesics: is for --ground-truth"),
        ("match {x} {y} --output {t}/m --seed 3", "--seed: is for --evaluation-samples"),
        ("match {x} {y} --output {t}/m.npz", "m.npz: a map is written"),
        ("match {x} {y} --output {t}/m --one-to-one {t}/o.baryc_gt", "o.baryc_gt: a map is written"),
        ("evaluate {x} {y} {t}/m --ground-truth {t}/m --seed 3", "--seed: is for --evaluation-samples"),
        ("render {x} --output {t}/m.png --index-base 1", "--index-base: is for a map"),
        ("match {x} {y} --output {t}", "is not a file"),
        ("match {x} {y} --output /proc/map.txt", "/proc/map.txt"),
        ("match {x} {t}/missing.off --output {t}/m", "missing.off"),
        ("match {x} {t} --output {t}/m", "not a regular file"),
        ("match {x} {y} --output {t}/m --eigenvectors 642", "641"),
        ("match {x} {y} --output {t}/m --eigenvectors 99999999999999999999", "99999999999999999999"),
        ("match {x} {y} --output {t}/m --eigenvectors 0", "at least 1"),
        ("match {x} {y} --output {t}/m --eigenvectors many", "no whole number"),
        ("match {x} {y} --output {t}/m --filters 1", "at least 2"),
        ("match {x} {y} --output {t}/m --bank haar", "haar"),
        ("match {x} {y} --output {t}/m --bank held --filters 3", "--filters"),
        ("match {x} {y} --output {t}/m --bank half-cosine --filters 2", "at least 3 filters"),
        ("match {x} {y} --output {t}/m --solution guess", "guess"),
        ("match {x} {y} --output {t}/m --iterations 0", "at least 1"),
        ("match {x} {y} --output {t}/m --samples 5", "cannot tell"),
        ("match {x} {y} --output {t}/m --samples 5000 --eigenvectors 20", "from 642 referenced vertices"),
        ("match {x} {y} --output {t}/m --init shout", "shout"),
        ("match {x} {y} --output {t}/m --init map:", "map:"),
        ("match {x} {y} --output {t}/m --init map:{t}/missing.txt", "missing.txt"),
        ("match {x} {y} --output {t}/m --init landmarks:{x}", "x.off"),
        ("match {x} {y} --output {t}/m --report {x}", "is an input"),
        ("match {x} {y} --output {t}/m --ground-truth {t}/missing.vts {p}/y.vts", "missing.vts"),
        ("match {x} {y} --output {t}/m --ground-truth {p}/x.vts", "half of a pair"),
        ("match {x} {y} --output {t}/m --precision float16", "float16"),
        ("match {x} {y} --output {t}/m --evaluation-samples -3", "at least 1"),
        ("match {x} {y} --output {x}", "would be overwritten"),
        ("match {x} {y} --output {t}/m --expected-error {t}/e.npy", "written as text"),
        (
            "match {x} {y} --output {p}/../{p.name}/truth.txt --ground-truth {p}/truth.txt",
            "would be overwritten",
        ),
        ("match {x} {y} --output {p}/truth.txt --init map:{p}/truth.txt", "would be overwritten"),
        (
            "evaluate {x} {y} {p}/truth.txt --ground-truth {p}/x.vts {p}/y.vts --output {p}/y.vts",
            "overwritten",
        ),
        ("match {x} {y} --out {t}/m", "--output"),
        ("evaluate {x} {y} {p}/truth.txt", "--ground-truth"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --output {t}/no/e.json", "no/e.json"),
        ("spectrum {x} --eigenvectors 642", "641"),
        ("spectrum {x} --bank regular --filters 6 --figure {t}/f.png", "is fixed"),
        ("spectrum {x} --filters 6", "--figure"),
        ("spectrum {x} --figure {x}", "would be overwritten"),
        ("demo --vertices 500 --output {t}/demo --init map:{t}/missing.txt", "missing.txt"),
        ("demo --vertices 500 --output {t}/demo --init shout", "shout"),
        ("spectrum {x} --output {t}/s.txt", ".npz or .mat"),
        ("spectrum {x} --figure {t}/s.nonsense", "s.nonsense"),
        ("render {x} {y} --output {t}/a.png", "give the map"),
        ("render {x} --output {t}/a.html", "page"),
        ("render {x} {y} {p}/truth.txt {p}/truth1.txt --output {t}/a.png", "one map"),
        ("render {x} {y} {p}/truth.txt --output {p}/truth.txt", "would be overwritten"),
        ("render {x} {y} {p}/truth.txt --partial --output {t}/a.png", "--partial"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --page {t}/e.png", ".html"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --up z", "--page"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --page {t}/no/e.html", "no/e.html"),
        ("render {x} --output {t}/a.nonsense", "a.nonsense"),
        ("demo --output {x}", "cannot be made a directory"),
        ("demo --kind unicorn --output {t}/d", "unicorn"),
        ("demo --vertices 3 --output {t}/d", "3"),
        ("demo --vertices -5 --output {t}/d", "at least 1"),
        ("dance", "dance"),
        ("", "COMMAND"),
    ],
)
def test_hostile_arguments(run, pair, tmp_path, arguments, fault):
    words = arguments.format(x=pair / "x.off", y=pair / "y.ply", p=pair, t=tmp_path).split()
    outcome = run(*words, *(["--quiet"] if len(words) > 1 else []))
    assert_refused(outcome, naming=fault)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def assert_refused(outcome: Outcome, *, naming: str) -> None:
    assert outcome.code == 2, outcome.errors
    assert outcome.output == ""
    assert outcome.errors.count("\n") == 1 and len(outcome.errors) > 40
    assert naming in outcome.errors


def test_numbers_that_went_wrong_exit_with_1(run, pair, tmp_path, monkeypatch):
    import jaxsmw.matching

    def fail(*_, **__):
        raise ArithmeticError("x to y: the functional map became NaN.")

    monkeypatch.setattr(jaxsmw.matching, "match", fail)
    outcome = run("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet")
    assert outcome.code == 1 and outcome.errors == "jaxsmw: x to y: the functional map became NaN.\n"


def test_an_interrupted_run_ends_soon_and_leaves_nothing_behind(pair, tmp_path):
    """Both while Python runs (imports, reading) and within hours of compiled refinement."""
    # A test run in the background ignores the signal, and so would its children.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from jaxsmw.cli.main import main; main(sys.argv[1:])"
    )
    command = [
        sys.executable, "-c", program, "match", pair / "x.off", pair / "y.ply",
        "--output", tmp_path / "map.txt", "--iterations", "10000000",
    ]  # fmt: skip
    for last_line in ("eigenbases", "refinement"):
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            try:
                for line in process.stderr:
                    if line.startswith(last_line):
                        break
                time.sleep(3 if last_line == "refinement" else 0)
                process.send_signal(signal.SIGINT)
                _, errors = process.communicate(timeout=30)
            finally:
                process.kill()
        assert process.returncode in (-signal.SIGINT, 128 + signal.SIGINT)
        assert errors.endswith("jaxsmw: interrupted; files are written whole or not at all.\n")
        assert "Traceback" not in errors
        assert list(tmp_path.iterdir()) == []


def test_the_readme_names_existing_options(run):
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    helps = "".join(
        run(command, "--help").output
        for command in ("demo", "match", "evaluate", "benchmark", "spectrum", "render")
    )
    readme = re.sub(r"^python3 .*", "", readme, flags=re.MULTILINE)  # pip's and pytest's
    for option in set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", readme)) - {"--quiet", "--help"}:
        assert option in helps, option


def test_read_mesh_is_exported():
    import jaxsmw

    assert jaxsmw.read_mesh is read_mesh
    assert set(jaxsmw.__all__) <= set(dir(jaxsmw))
    for name in jaxsmw.__all__:
        assert getattr(jaxsmw, name) is not None


def test_every_bank_has_a_name(run, pair, tmp_path):
    pictures = set()
    for name in _BANKS:
        path = tmp_path / f"{name}.png"
        call = ["spectrum", pair / "x.off", "--eigenvectors", "20", "--figure", path, "--bank", name]
        assert run(*call).code == 0
        pictures.add(path.read_bytes())
    assert len(pictures) == len(_BANKS)
