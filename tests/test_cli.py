"""The commands of `jaxsmw` print help texts, results and notes, and write their output files."""

import argparse
import base64
import inspect
import json
import os
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest
import scipy.io
import trimesh
from command_line import COMMANDS, SMALL, Outcome, assert_refused, write_pair
from messages import assert_names
from sampled_cases import first_always
from scipy.spatial import KDTree
from synthetic import grid_mesh

import jaxsmw
import jaxsmw.matching.match
from jaxsmw.banks import CubicSpline, Itersine, Meyer, SpectralDistribution, Warped
from jaxsmw.benchmark.measurement import Settings
from jaxsmw.cli.banks import BANKS, bounds_unless_tight, make_bank
from jaxsmw.cli.console import with_options
from jaxsmw.cli.run import run_command
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.evaluation.ground_truth import read_ground_truth
from jaxsmw.evaluation.metrics import geodesic_error
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.maps import read_pointwise_map
from jaxsmw.io.meshes import read_mesh, write_mesh
from jaxsmw.matching.match import match
from jaxsmw.matching.search.alternatives import Alternative
from jaxsmw.matching.stages import PRESETS, Stage, choose_preset
from jaxsmw.report.texture import TEXTURE_FILES
from jaxsmw.wording import percentage

pytestmark = pytest.mark.usefixtures("small_pictures")


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> Path:
    return write_pair(tmp_path_factory.mktemp("pair"))


def mean_error(line: str) -> float:
    return float(re.search(r"mean ([\d.]+)", line)[1])


def test_help_loads_no_heavy_module():
    code = (
        "import sys\n"
        "from jaxsmw.cli.run import run_command\n"
        f"for command in [[], *([name] for name in {COMMANDS})]:\n"
        "    assert run_command([*command, '--help']) == 0\n"
        "print('loaded:', *sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    helps, _, loaded = result.stdout.partition("loaded:")
    for command in COMMANDS:
        assert f"usage: jaxsmw {command}" in helps
    heavy = {"jax", "numpy", "scipy", "equinox", "igl", "matplotlib", "importlib.metadata"}
    assert heavy.isdisjoint(loaded.split())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help_text(run, command):
    outcome = run(command, "--help")
    assert outcome.code == 0 and outcome.output.startswith(f"usage: jaxsmw {command}")


def test_the_help_states_the_defaults_of_the_library(run):
    words = {command: " ".join(run(command, "--help").output.split()) for command in COMMANDS}
    defaults = {name: entry.default for name, entry in inspect.signature(match).parameters.items()}
    assert f"(default: {defaults['preset']}, or paper if" in words["match"]
    assert f"map:FILE (default: {defaults['init']})" in words["match"]
    assert f"X_Y.map (default: {Settings().init})" in words["benchmark"]
    assert words["match"].count("(default: auto)") == 5
    automatic = [defaults[name] for name in ("init", "laplacian", "eigensolver", "mirror", "backend")]
    assert automatic == ["auto"] * 5
    eigenvectors = inspect.signature(compute_spectrum).parameters["number_of_eigenvectors"].default
    assert f"number of eigenvectors (default: {eigenvectors})" in words["spectrum"]
    assert f"eigenvectors per shape (default: {Stage().number_of_eigenvectors})" in words["match"]
    assert f"number of iterations (default: {Stage().iterations})" in words["match"]
    bank = re.search(r"identity \(default: (\S+)\)", words["match"])[1]
    assert BANKS[bank] == type(WaveletPreservation().bank).__name__
    assert make_bank(None, None).filters == WaveletPreservation().bank.filters
    solution = re.search(r"orthogonality \(default: (\S+)\)", words["match"])[1]
    assert solution == "filtering" and isinstance(WaveletPreservation().solution, Filtering)
    geodesics = inspect.signature(geodesic_error).parameters
    assert f"less than 0.5 % (default: {geodesics['method'].default})" in words["evaluate"]
    assert f"--evaluation-samples (default: {geodesics['seed'].default})" in words["evaluate"]


def test_the_version_is_printed(run):
    assert re.fullmatch(r"jaxsmw \d+\.\d+\.\d+\S*\n", run("--version").output)
    assert run("--version").output == f"jaxsmw {jaxsmw.__version__}\n"


def test_the_package_runs_as_a_module():
    result = subprocess.run([sys.executable, "-m", "jaxsmw", "--version"], capture_output=True, check=True)
    assert result.stdout.startswith(b"jaxsmw ")


def test_evaluate_confirms_the_error_that_match_prints(run, pair, tmp_path):
    output = tmp_path / "map.txt"
    outcome = run(
        "match",
        pair / "x.off",
        pair / "y.ply",
        "--output",
        output,
        *SMALL,
        "--init",
        "shot",
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
        if "--index-base" in truth:  # --index-base applies to all files of the call
            np.savetxt(tmp_path / "map1.txt", np.loadtxt(output, int) + 1, fmt="%d")
            maps = [tmp_path / "map1.txt"]
        else:
            maps = [output]
        evaluated = run("evaluate", pair / "x.off", pair / "y.ply", *maps, "--ground-truth", *truth)
        assert evaluated.code == 0, evaluated.errors
        assert mean_error(evaluated.output) == mean_error(after)
        assert "strips" in evaluated.output


def test_banks_that_are_not_tight_have_unequal_bounds():
    loose = {name for name in BANKS if bounds_unless_tight(make_bank(name, None))}
    assert loose == {"cubic-spline", "mexican-hat", "gabor"}


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
        assert (f"{bank} is not a tight frame" in outcome.errors) == noted


def test_quiet_prints_nothing_on_standard_error(run, pair, tmp_path):
    outcome = run("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet", *SMALL)
    assert outcome.code == 0 and outcome.errors == ""


@contextmanager
def recorded_calls() -> Iterator[list[dict]]:
    """Yield a list, which gets one dictionary of settings for each call of `match`."""
    calls, match = [], jaxsmw.matching.match.match

    def recorded(*meshes, preset, **settings):
        found = match(*meshes, preset=preset, **settings)
        of_stage, of_refiner = (
            {field.name: getattr(part, field.name) for field in fields(part)}
            for part in (preset, preset.refiner)
        )
        settings |= of_stage | of_refiner | {"float type": found.functional_map.dtype}
        del settings["refiner"]
        calls.append(settings)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jaxsmw.matching.match, "match", recorded)
        yield calls


@pytest.fixture
def calls():
    with recorded_calls() as calls:
        yield calls


def call_of_match(pair: Path, directory: Path) -> list[object]:
    return ["match", pair / "x.off", pair / "y.ply", "--output", directory / "map.txt", *SMALL]


@pytest.fixture(scope="module")
def usual_settings(pair, tmp_path_factory) -> dict:
    """The settings of `match` in `call_of_match` without further options."""
    with recorded_calls() as calls:
        call = call_of_match(pair, tmp_path_factory.mktemp("usual"))
        assert run_command([*map(str, call), "--quiet"]) == 0
    (settings,) = calls
    assert settings["mirror"] == "no"
    return settings


@pytest.mark.parametrize(
    ("options", "changed"),
    [
        ("--init wks", lambda: {"init": "wks"}),
        ("--init functional", lambda: {"init": "functional"}),
        ("--iterations 1", lambda: {"iterations": 1}),
        ("--samples 40", lambda: {"number_of_samples": 40}),
        ("--eigenvectors 15", lambda: {"number_of_eigenvectors": 15}),
        ("--filters 2", lambda: {"bank": Meyer(2)}),
        ("--bank itersine", lambda: {"bank": Itersine(4)}),
        ("--bank adapted-itersine", lambda: {"bank": Warped(Itersine(4), SpectralDistribution())}),
        ("--bank cubic-spline", lambda: {"bank": CubicSpline(4)}),
        ("--solution least-squares", lambda: {"solution": LeastSquares()}),
        ("--solution least-squares-frobenius", lambda: {"solution": LeastSquares(norm="frobenius")}),
        ("--solution regularized", lambda: {"solution": RegularizedLeastSquares()}),
        ("--laplacian robust", lambda: {"laplacian": "robust"}),
        ("--mirror yes", lambda: {"mirror": "yes"}),
        ("--mirror auto", lambda: {"mirror": "auto"}),
        ("--precision float64", lambda: {"float type": np.float64}),
        ("--stop-when-unchanged", lambda: {"stop_when_unchanged": True}),
    ],
)
@pytest.mark.filterwarnings("ignore:.*wrong as a whole")  # with some options, the map of the pair is wrong
def test_an_option_changes_the_setting_that_it_names_and_no_other(
    run, pair, tmp_path, calls, usual_settings, options, changed
):
    assert run(*call_of_match(pair, tmp_path), *options.split()).code == 0
    (settings,) = calls
    with jax.enable_x64(False):  # as in the command
        assert {name: value for name, value in settings.items() if value != usual_settings[name]} == changed()


@pytest.mark.parametrize("kind", ["landmarks", "map"])
def test_initial_maps_are_read_from_files(run, pair, tmp_path, calls, kind):
    file = pair / {"landmarks": "landmarks.txt", "map": "truth.txt"}[kind]
    assert run(*call_of_match(pair, tmp_path), "--init", f"{kind}:{file}").code == 0
    (settings,) = calls
    np.testing.assert_array_equal(settings["init"], np.loadtxt(file, dtype=int))


@pytest.mark.slow
def test_the_report_has_all_files_settings_and_maps(run, pair, tmp_path):
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


def test_the_default_preset_is_accurate_and_options_select_paper(run, pair, tmp_path, monkeypatch):
    chosen = []

    def recorded(*_, preset, **__):
        chosen.append(choose_preset(preset))
        raise ArithmeticError("recorded")

    monkeypatch.setattr("jaxsmw.matching.match.match", recorded)
    call = ("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet")
    for options in ((), ("--preset", "accurate"), ("--preset", "paper"), ("--eigenvectors", "100"),
                    ("--preset", "fast"), ("--samples", "500")):  # fmt: skip
        assert run(*call, *options).code == 1
    default, accurate, paper, changed, fast, sampled = chosen
    assert default == accurate == PRESETS["accurate"]
    assert paper == changed == PRESETS["paper"]
    assert fast == sampled == PRESETS["fast"]
    assert default != paper != fast
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
    # If two files have the same name, the page labels their maps with their paths.
    (tmp_path / "other").mkdir()
    np.savetxt(tmp_path / "other" / "zero.txt", np.ones(642), fmt="%d")
    two = tmp_path / "zero.txt", tmp_path / "other" / "zero.txt"
    assert run("render", *meshes, *two, "--output", rendered).code == 0
    assert [shown["name"] for shown in shown_maps(rendered)] == [str(path) for path in two]


@pytest.mark.filterwarnings("default")
def test_equal_warnings_are_printed_once(run, monkeypatch):
    def warn_twice(_):
        warnings.warn("the same", stacklevel=1)
        warnings.warn("the same", stacklevel=2)

    options = argparse.Namespace(quiet=True, run=warn_twice)
    monkeypatch.setattr("jaxsmw.cli.run.make_parser", lambda: Mock(parse_args=lambda _: options))
    assert run().errors == "warning: the same\n"


@pytest.mark.filterwarnings("default:the page has no wavelets")
def test_a_page_of_a_partial_shape_uses_a_common_range_of_eigenvalues(run, pair, tmp_path):
    call = ["render", pair / "x.off", pair / "y.ply", pair / "truth.txt", "--output", tmp_path / "p.html"]
    assert run(*call, "--partial").code == 0
    # In the common range, the smaller shape has fewer eigenvalues than the larger shape.
    functional = shown_maps(tmp_path / "p.html")[0]["functional"]
    rows = len(base64.b64decode(functional["values"])) // (4 * functional["columns"])
    assert rows < 30 < functional["columns"] == 100
    mesh = read_mesh(pair / "y.ply")
    write_mesh(tmp_path / "large.off", make_mesh(1e3 * mesh.vertices, mesh.faces))
    outcome = run(*call[:2], tmp_path / "large.off", *call[3:], "--partial")
    assert outcome.code == 0 and "warning: the page has no wavelets" in outcome.errors
    assert shown_maps(tmp_path / "p.html")[0]["functional"] is None


@pytest.mark.filterwarnings("default:.*wrong as a whole")
def test_the_overlap_of_partial_shapes_is_written(run, pair, tmp_path):
    mesh = read_mesh(pair / "x.off")
    high = mesh.vertices[:, 1] > np.quantile(mesh.vertices[:, 1], 0.4)
    part = make_mesh(mesh.vertices, mesh.faces[high[mesh.faces].all(axis=1)])
    write_mesh(tmp_path / "part.off", part)
    call = [
        "match",
        pair / "x.off",
        tmp_path / "part.off",
        "--output",
        tmp_path / "m.txt",
        "--preset",
        "fast",
    ]
    call += ["--overlap", tmp_path / "overlap.txt"]
    assert_refused(run(*call), naming="--overlap")
    assert_refused(run(*call[:-1], tmp_path / "o.npy", "--partial"), naming="the overlap is written as text")
    truth = tmp_path / "truth.txt"
    used = np.flatnonzero(part.referenced_vertices)
    np.savetxt(truth, used[KDTree(mesh.vertices[used]).query(mesh.vertices)[1]], "%d")
    outcome = run(*call, "--partial", "--init", f"map:{truth}")
    assert outcome.code == 0, outcome.errors
    of_source, of_target = (np.loadtxt(tmp_path / f"overlap{name}.txt") for name in ("", "_target"))
    found = of_source >= 0.5
    assert len(found) == len(mesh.vertices) == len(of_target)
    assert of_source.min() >= 0 and of_source.max() <= 1
    assert mesh.average(found == part.referenced_vertices) > 0.9
    assert f"overlap:     predicted on {mesh.average(found):.0%} of the source's area and" in outcome.output


@pytest.mark.filterwarnings("default:.*wrong as a whole")
def test_two_parts_are_matched_through_a_template(run, pair, tmp_path):
    mesh = read_mesh(pair / "x.off")
    heights = mesh.vertices[:, 1]
    for name, kept in (
        ("upper", heights > np.quantile(heights, 0.3)),
        ("lower", heights < np.quantile(heights, 0.7)),
    ):
        part = make_mesh(mesh.vertices, mesh.faces[kept[mesh.faces].all(axis=1)])
        write_mesh(tmp_path / f"{name}.off", part)
    files = [tmp_path / "upper.off", tmp_path / "lower.off", "--output", tmp_path / "m.txt"]
    call = ["match", *files, "--preset", "fast", "--template", pair / "x.off"]
    outcome = run(*call, "--overlap", tmp_path / "overlap.txt", "--report", tmp_path / "report")
    assert outcome.code == 0, outcome.errors
    assert "source to template" in outcome.output and "overlap:     " in outcome.output
    assert len(np.loadtxt(tmp_path / "m.txt")) == len(mesh.vertices)
    summary = json.loads((tmp_path / "report" / "summary.json").read_text("utf-8"))
    assert summary["partial"] and len(summary["overlap"]) == 2
    np.savetxt(tmp_path / "init.txt", np.zeros(len(mesh.vertices)), "%d")
    assert_refused(
        run(*call, "--init", f"map:{tmp_path / 'init.txt'}"), naming="--template: cannot be used with"
    )
    assert_refused(run(*call[:-1], tmp_path / "missing.off"), naming="missing.off")


def test_spectrum_writes_an_orthonormal_eigenbasis(run, pair, tmp_path):
    outcome = run(
        "spectrum", pair / "x.off", "--eigenvectors", 12, "--output", tmp_path / "s.npz", "--figure", tmp_path / "s.png"
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    assert "642 vertices" in outcome.output and "cotangent" in outcome.output
    with np.load(tmp_path / "s.npz") as saved:
        gram = saved["eigenvectors"].T @ (saved["vertex_areas"][:, None] * saved["eigenvectors"])
    np.testing.assert_allclose(gram, np.eye(12), atol=1e-8)
    assert (tmp_path / "s.png").stat().st_size > 1000


def test_spectrum_writes_a_shape_for_matlab(run, pair, tmp_path):
    outcome = run("spectrum", pair / "y.ply", "--eigenvectors", 12, "--output", tmp_path / "s.mat")
    assert outcome.code == 0, outcome.errors
    shape = scipy.io.loadmat(tmp_path / "s.mat")["S"][0, 0]
    np.testing.assert_allclose(shape["evecs"].T @ shape["A"] @ shape["evecs"], np.eye(12), atol=1e-8)
    assert len(read_mesh(tmp_path / "s.mat").faces) == len(read_mesh(pair / "y.ply").faces)


def test_maps_are_written_and_read_as_matlab_files(run, pair, tmp_path):
    meshes = pair / "x.off", pair / "y.ply"
    truth = np.loadtxt(pair / "truth.txt", dtype=int)
    scipy.io.savemat(tmp_path / "truth.mat", {"T12": truth + 1})
    scipy.io.savemat(tmp_path / "from_0.mat", {"T12": truth})
    written = tmp_path / "map.mat"
    init = f"map:{tmp_path / 'truth.mat'}"
    for name in ("map.txt", "map.mat"):
        outcome = run("match", *meshes, *SMALL, "--init", init, "--output", tmp_path / name, "--quiet")
        assert outcome.code == 0 and "is read with indices from 1, as usual in MATLAB" in outcome.errors
    found = scipy.io.loadmat(written)["T12"]
    np.testing.assert_array_equal(found[:, 0] - 1, np.loadtxt(tmp_path / "map.txt"))
    # The command reads indices from 1 in the map and in the ground truth, and prints a note for each file.
    call = ("evaluate", *meshes, tmp_path / "truth.mat", "--ground-truth", tmp_path / "truth.mat", "--quiet")
    outcome = run(*call)
    assert outcome.code == 0 and mean_error(outcome.output) == 0
    assert outcome.errors.count(f"note: {tmp_path / 'truth.mat'} is read with indices from 1") == 2
    from_0 = ("evaluate", *meshes, tmp_path / "from_0.mat", "--ground-truth", pair / "truth.txt", "--quiet")
    outcome = run(*from_0)
    assert outcome.code == 2 and "pass --index-base 0" in outcome.errors
    outcome = run(*from_0, "--index-base", "0")
    assert outcome.code == 0 and mean_error(outcome.output) == 0 and not outcome.errors


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("welding (weld=True).", "welding (--weld)."),
        ("the robust Laplacian (laplacian='robust').", "the robust Laplacian (--laplacian robust)."),
        ('set mirror="no"; if', "set --mirror no; if"),
        ("scale=1.5.ply: pass index_base=1.", "scale=1.5.ply: pass --index-base 1."),
        ("again with partial=True and scale=\"unknown\", which", "again with --partial and --scale unknown, which"),
        ("(see Correspondence.alternatives)", "(see match --alternatives 3)"),
        ("that jaxsmw.report.summary.write_report writes", "that --report DIR writes"),
        ("landmarks with init=landmarks.", "landmarks with --init landmarks:FILE."),
    ],
)  # fmt: skip
def test_messages_of_the_library_name_options(message, expected):
    assert with_options(message) == expected


def test_a_mesh_with_many_defects_has_one_line_of_each_kind(run, tmp_path):
    vertices, faces = grid_mesh(12, 12)
    faces = np.concatenate([faces, faces[:2], [[0, 1, 1], faces[0][::-1], [0, 14, 100]]])
    raw = tmp_path / "raw.off"
    lines = [f"OFF\n{len(vertices) + 3} {len(faces)} 0"]
    lines += [f"{x} {y} {z}" for x, y, z in np.concatenate([vertices, np.zeros((3, 3))])]
    raw.write_text("\n".join(lines + [f"3 {a} {b} {c}" for a, b, c in faces]))
    outcome = run("render", raw, "--output", tmp_path / "m.png")
    assert outcome.code == 0, outcome.errors
    size, notes, unusual, written = outcome.errors.splitlines()
    assert size.startswith(f"{raw}: 147 vertices, 243 faces, 1 connected component, open.")
    for number in (
        "1 face dropped because of a repeated vertex",
        "3 faces dropped",
        "3 unreferenced vertices",
    ):
        assert number in notes
    assert unusual.startswith(f"{raw}: Unusual elements: ") and "3 non-manifold vertices" in unusual
    assert written.startswith("wrote")


def test_seams_are_reported_and_welded(run, tmp_path):
    vertices, faces = grid_mesh(12, 12)
    soup = make_mesh(vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    write_mesh(tmp_path / "soup.off", soup)
    plain = run("spectrum", tmp_path / "soup.off", "--eigenvectors", "5")
    assert "--weld" in plain.output and "242 connected components" in plain.output
    assert (
        "1 connected component"
        in run("spectrum", tmp_path / "soup.off", "--eigenvectors", "5", "--weld").output
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*wrong as a whole:UserWarning")
def test_demo_writes_a_pair_and_a_better_map(run, tmp_path):
    small = ["--vertices", "1000", "--preset", "paper", "--eigenvectors", "40"]
    outcome = run("demo", "--output", tmp_path / "demo", *small)
    assert_written_files_are_named(outcome, files_in(tmp_path))
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
    call = ["match", x, y, "--output", tmp_path / "map.txt", *SMALL, "--init", "shot"]
    truth = ["--ground-truth", pair / "truth.txt"]
    outcome = run(*call, "--surface-points", points, *truth)
    assert outcome.code == 0, outcome.errors
    initial, surface, refined = (line for line in outcome.output.splitlines() if "map:" in line)
    assert surface.startswith("surface map:")
    # The ground truth consists of vertices, so only maps to vertices can have errors of exactly zero.
    assert mean_error(refined) < mean_error(surface) < 0.02 < mean_error(initial)

    mesh_y = read_mesh(y)
    written = read_ground_truth(points, read_mesh(x), mesh_y).targets
    matched = mesh_y.vertices[np.loadtxt(tmp_path / "map.txt", dtype=int)]
    apart = np.linalg.norm(written.positions(mesh_y) - matched, axis=1)
    assert 0 < np.median(apart) < 0.05 * mesh_y.area**0.5


QUALITY = re.compile(r"quality:     (.*)\n")


@pytest.mark.slow
def test_the_quality_of_the_map_is_printed(run, pair, tmp_path, monkeypatch):
    computed, estimate_error = [], jaxsmw.Correspondence.estimate_error

    def recorded(found, settings):
        computed.append(estimate_error(found, settings))
        return computed[-1]

    call = [
        "match",
        pair / "x.off",
        pair / "y.ply",
        "--output",
        tmp_path / "m",
        "--init",
        "shot",
        "--mirror",
        "no",
    ]
    monkeypatch.setattr(jaxsmw.Correspondence, "estimate_error", recorded)
    quality = QUALITY.search(run(*call, *SMALL).output)[1]
    assert re.match(r"distortion 1\.0\d\d \(1 for isometries\), ", quality) and len(computed) == 1
    output = run(*call, "--report", tmp_path / "r", "--expected-error", tmp_path / "e.txt", *SMALL).output
    source = read_mesh(pair / "x.off")
    mean = f"area-weighted mean expected error {1e3 * source.average(computed[0]):.2f} x 10^-3 sqrt(area)"
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    wrong = f"wrong as a whole with probability {percentage(summary['wrong_probability'])}"
    assert QUALITY.search(output)[1] == quality and quality.endswith(f", {mean}, {wrong}")
    assert len(computed) == 2
    written = source.average(np.loadtxt(tmp_path / "e.txt"))
    assert summary["result"]["expected error, mean"] == f"{written:.4f} √area"

    match = jaxsmw.matching.match.match
    others = tuple(Alternative(np.arange(642), share, "mirrored") for share in (0.2, 0.001))
    judged = {"distortion": 1.2345, "probability": 0.75, "alternatives": others}
    monkeypatch.setattr(jaxsmw.matching.match, "match", lambda *a, **k: replace(match(*a, **k), **judged))
    for command in (call, ["transfer", *call[1:3], "--registered", tmp_path / "r.off", *call[5:]]):
        lines = iter(run(*command, *SMALL).output.splitlines())
        quality = next(line for line in lines if line.startswith("quality:"))
        assert quality.endswith(
            f"distortion 1.234 (1 for isometries), {mean}, wrong as a whole with probability 25 %"
        )
        assert next(lines) == "other maps:  1. mirrored, right with probability 20 %"
        assert next(lines) == "             2. mirrored, right with probability below 1 %"
        assert next(lines) == "             no map is right with probability 5 %"


@pytest.mark.parametrize("name", ["map.txt", "map", "a.b.npy"])
def test_other_maps_are_written_beside_the_map(run, pair, tmp_path, monkeypatch, name):
    """The most probable ones are written, if there are as many."""
    others = tuple(Alternative(np.full(642, number), 0.1, "mirrored") for number in (7, 8))
    monkeypatch.setattr(
        jaxsmw.matching.match,
        "match",
        lambda *meshes, **_: replace(match(*meshes, preset="fast", mirror="no"), alternatives=others),
    )
    meshes = [read_mesh(pair / file) for file in ("x.off", "y.ply")]
    call = ["match", pair / "x.off", pair / "y.ply"]
    root, suffix = os.path.splitext(name)
    for most in (None, 1, 3):
        directory = tmp_path / str(most)
        directory.mkdir()
        asked = [] if most is None else ["--alternatives", most]
        outcome = run(*call, "--output", directory / name, *asked)
        written = {f"{root}_alternative_{k + 1}{suffix}" for k in range(min(2, most or 0))}
        assert {path.name for path in directory.iterdir()} == {name} | written
        assert_written_files_are_named(outcome, files_in(directory))
    for number, other in enumerate(others, 1):
        file = directory / f"{root}_alternative_{number}{suffix}"
        np.testing.assert_array_equal(read_pointwise_map(file, *meshes), other.pointwise_map)

    # A later run removes the alternatives of earlier runs, but no other file, and no file that it reads.
    first, second, similar = (f"{root}_alternative_{number}{suffix}" for number in ("1", "2", "01"))
    (directory / similar).touch()
    outcome = run(*call, "--output", directory / name, "--init", f"map:{directory / first}")
    assert {path.name for path in directory.iterdir()} == {name, first, similar}
    assert f"removed {directory / second}" in outcome.errors
    others = ()
    outcome = run(*call, "--output", directory / name, "--alternatives", 3)
    assert {path.name for path in directory.iterdir()} == {name, similar}
    assert "no other map was found" in outcome.errors


def test_the_expected_error_is_written(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", *SMALL]
    assert run(*call, "--expected-error", tmp_path / "expected.txt").code == 0
    expected = np.loadtxt(tmp_path / "expected.txt")
    assert expected.shape == (642,) and expected.min() >= 0 and expected.mean() < 0.02
    assert_refused(run(*call, "--expected-error", tmp_path / "map.txt"), naming="two outputs have this name")


def test_the_map_cannot_be_written_to_the_place_of_the_report(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--quiet", *SMALL]
    (tmp_path / "r").mkdir()
    for output in (tmp_path / "r" / "report.html", tmp_path / "new"):
        directory = tmp_path / "r" if output.name == "report.html" else output
        outcome = run(*call, "--output", output, "--report", directory)
        assert_refused(outcome, naming="two outputs have this name")
    assert not (tmp_path / "new").exists() and not list((tmp_path / "r").iterdir())


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
    # Corresponding points have the same texture coordinates.
    carried = read_ground_truth(points, meshes["source"], meshes["target"]).targets
    faces, weights = meshes["target"].faces[carried.faces], carried.weights
    expected = np.einsum("pk,pku->pu", weights, coordinates["target"][faces])
    np.testing.assert_allclose(coordinates["source"], expected, atol=1e-6)


def test_a_failed_computation_exits_with_1(run, pair, tmp_path, failing_match):
    outcome = run("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet")
    assert outcome.code == 1 and outcome.errors == f"jaxsmw: {failing_match}\n"


@pytest.fixture
def failing_match(monkeypatch) -> str:
    """Make every match fail immediately, and return the message of the failure."""
    message = "x to y: the functional map became NaN."

    def fail(*_, **__):
        raise ArithmeticError(message)

    monkeypatch.setattr("jaxsmw.matching.match.match", fail)
    return message


@pytest.mark.parametrize(
    "change",
    [
        ["--eigenvectors", "20"],
        ["--bank", "itersine"],
        ["--filters", "4"],
        ["--solution", "least-squares"],
        ["--iterations", "1"],
        ["--samples", "500"],
        ["--stop-when-unchanged"],
    ],
    ids=" ".join,
)
@pytest.mark.usefixtures("failing_match")
def test_a_note_says_that_an_option_replaces_the_preset(run, pair, tmp_path, change):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m"]
    note = f"note: preset paper replaces accurate, because {change[0]} changes the paper's method.\n"
    assert note in run(*call, *change).errors.splitlines(keepends=True)
    for options in ([*change, "--preset", "paper"], ["--preset", "fast"], []):
        assert "note:" not in run(*call, *options).errors


@pytest.mark.usefixtures("failing_match")
def test_a_note_names_all_options_that_replace_the_preset(run, tmp_path):
    outcome = run(
        "demo", "--vertices", "500", "--output", tmp_path / "d", "--iterations", "1", "--bank", "held"
    )
    assert "because --bank and --iterations change the paper's method" in outcome.errors


@pytest.mark.slow
def test_written_files_are_named(run, pair, tmp_path):
    meshes, truth = (pair / "x.off", pair / "y.ply"), pair / "truth.txt"
    for arguments in (
        ["evaluate", *meshes, truth, "--ground-truth", truth, "--output", tmp_path / "e.json",
         "--figure", tmp_path / "e.png", "--page", tmp_path / "e.html"],
        ["spectrum", meshes[0], "--eigenvectors", "9", "--output", tmp_path / "s.npz", "--figure", tmp_path / "s.png"],
        ["render", *meshes, truth, "--output", tmp_path / "r.png"],
        ["render", *meshes, truth, "--output", tmp_path / "r.html"],
        ["render", meshes[0], "--output", tmp_path / "one.png"],
        ["render", meshes[0], "--output", tmp_path / "r.svg"],
    ):  # fmt: skip
        before = files_in(tmp_path)
        outcome = run(*arguments)
        assert_written_files_are_named(outcome, files_in(tmp_path) - before)
        if arguments[0] == "render":
            assert arguments[-1].stat().st_size > 5000


def assert_written_files_are_named(outcome: Outcome, files: set[str]) -> None:
    assert outcome.code == 0, outcome.errors
    named = re.findall(r"^wrote (.*)$", outcome.errors, flags=re.MULTILINE)
    assert sorted(named) == sorted(files)


def files_in(directory: Path) -> set[str]:
    return {str(path) for path in directory.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_the_times_account_for_the_whole_run_and_all_files_are_named(run, pair, tmp_path):
    began = time.perf_counter()
    outcome = run(
        "match", pair / "x.off", pair / "y.ply", *SMALL, "--mirror", "auto", "--output", tmp_path / "m.txt", "--surface-points",
        tmp_path / "p.baryc_gt", "--expected-error", tmp_path / "e.txt", "--one-to-one", tmp_path / "o.txt",
        "--texture", tmp_path / "t", "--report", tmp_path / "r", "--ground-truth", pair / "truth.txt",
    )  # fmt: skip
    wall = time.perf_counter() - began
    assert_written_files_are_named(outcome, files_in(tmp_path))
    line = next(line for line in outcome.output.splitlines() if line.startswith("time:"))
    total = float(re.match(r"time: +([\d.]+) s: ", line)[1])
    steps = {name: float(seconds) for name, seconds in re.findall(r"([a-z-][a-z -]+) ([\d.]+) s\b", line)}
    assert list(steps) == [
        "loading", "reading", "eigenbases", "initial map", "refinement", "writing", "one-to-one map",
        "surface points", "expected error", "geodesic errors", "report", "other",
    ]  # fmt: skip
    assert sum(steps.values()) == pytest.approx(total, abs=0.01 * len(steps))
    assert 0.9 * wall < total <= wall + 0.01


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize(
    "arguments", [["--help"], ["match", "--help"], ["--version"], ["spectrum", "{pair}/x.off"]], ids=" ".join
)
@pytest.mark.parametrize("unbuffered", first_always(["", "1"]))
def test_output_that_cannot_be_written_is_reported(pair, arguments, unbuffered):
    call = [sys.executable, "-m", "jaxsmw", *(argument.format(pair=pair) for argument in arguments)]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        result = subprocess.run(call, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert_names(
        result.stderr, "jaxsmw: standard output", "No space left on device", "redirect", "free space"
    )


def test_a_closed_pipe_causes_no_error_message(pair):
    call = [sys.executable, "-m", "jaxsmw", "spectrum", pair / "x.off"]
    process = subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 1
    process.stderr.close()


def test_the_readme_names_existing_options(run):
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    helps = "".join(run(command, "--help").output for command in COMMANDS)
    readme = re.sub(r"^python3 .*", "", readme, flags=re.MULTILINE)  # lines with options of pip and pytest
    for option in set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", readme)) - {"--quiet", "--help"}:
        assert option in helps, option


def test_every_exported_name_exists():
    assert jaxsmw.read_mesh is read_mesh
    assert set(jaxsmw.__all__) <= set(dir(jaxsmw))
    for name in jaxsmw.__all__:
        assert getattr(jaxsmw, name) is not None


@pytest.mark.slow
def test_every_bank_has_a_different_figure(run, pair, tmp_path):
    pictures = set()
    for name in BANKS:
        path = tmp_path / f"{name}.png"
        call = ["spectrum", pair / "x.off", "--eigenvectors", "20", "--figure", path, "--bank", name]
        assert run(*call).code == 0
        pictures.add(path.read_bytes())
    assert len(pictures) == len(BANKS)
