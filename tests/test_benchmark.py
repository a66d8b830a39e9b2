"""The benchmark command returns correct results, continues after a kill, and refuses bad input."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest
from jax._src import monitoring
from messages import refused
from scipy.spatial import KDTree
from synthetic import bumpy_mesh, random_spectrum, sphere_mesh

from jaxsmw import InputError
from jaxsmw.benchmark import measurement
from jaxsmw.benchmark.benchmark import Results, run_benchmark
from jaxsmw.benchmark.datasets import choose_pairs, open_data_set
from jaxsmw.benchmark.journal import Journal
from jaxsmw.benchmark.measurement import CURVE, FIGURES, OPTIONAL_FIGURES, RESULT_COLUMNS, Settings
from jaxsmw.benchmark.opponents.base import Method, MethodInput
from jaxsmw.benchmark.opponents.registry import METHODS, PEERS, find_methods
from jaxsmw.benchmark.tables import _introduction, latex_table, markdown, markdown_table, summarize_methods
from jaxsmw.cli.run import run_command
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import write_mesh
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.runtime.provenance import measured_code
from jaxsmw.runtime.workers import open_executor


@pytest.fixture(scope="module")
def scape(tmp_path_factory) -> Path:
    """Three deformed copies of a bumpy sphere, in the directory layout of the data set SCAPE."""
    directory = tmp_path_factory.mktemp("bodies")
    mesh = bumpy_mesh(3)
    for number, stretch in enumerate(([1, 1, 1], [1.05, 1, 0.97], [1, 0.95, 1.04])):
        write_mesh(directory / f"mesh{number:03}.off", make_mesh(mesh.vertices * stretch, mesh.faces))
    return directory


def command(data: Path, output: Path, *options: str) -> list[str]:
    methods = ["initial", "mwp"]
    arguments = ["benchmark", data, "--output", output, "--methods", *methods, *options]
    return [sys.executable, "-m", "jaxsmw", *map(str, arguments)]


@pytest.mark.slow
def test_the_same_command_continues_after_a_kill(scape, tmp_path, capsys):
    output = tmp_path / "results"
    call = command(scape, output, "--workers", "1", "--evaluation-samples", "300")
    first = subprocess.Popen(
        call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    results = output / "results.csv"
    deadline = time.monotonic() + 300
    while not results.exists() or len(results.read_text().splitlines()) < 4:
        assert first.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    kept = results.read_text().splitlines()
    kept = kept[: 1 + 2 * ((len(kept) - 1) // 2)]

    second = subprocess.run(call, check=True, capture_output=True, text=True)
    lines = results.read_text().splitlines()
    assert lines[: len(kept)] == kept  # repeated measurements would have different times
    assert len(lines) == len(set(lines)) == 1 + 6 * 2
    assert second.stdout.startswith("| method | mean error |")
    assert run_command(call[3:]) == 0
    assert capsys.readouterr().out == second.stdout and results.read_text().splitlines() == lines

    table = pyarrow.parquet.read_table(output / "results.parquet").to_pylist()
    assert len(table) == 12 and table[0]["curve"][-1] <= 1 and isinstance(table[0]["mean"], float)
    means = {
        name: np.mean([row["mean"] for row in table if row["method"] == name]) for name in ("initial", "mwp")
    }
    assert means["mwp"] < 0.5 * means["initial"]
    for name in ("summary.md", "table.tex", "curves.png", "shapes.csv", "provenance.json"):
        assert (output / name).stat().st_size > 100

    assert run_command([*call[3:], "--seed", "1"]) == 2
    assert "seed = 0 (settings), but this run has seed = 1" in capsys.readouterr().err


@pytest.mark.cluster
def test_each_result_arrives_once_although_a_dask_worker_is_killed(scape, tmp_path):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
             "--dashboard-address", "127.0.0.1:0", "--scheduler-file", str(tmp_path / "scheduler.json")],
            env=environment, stderr=subprocess.DEVNULL,
        )
    ]  # fmt: skip
    try:
        wait_for((tmp_path / "scheduler.json").exists, started)
        for _ in range(2):
            started.append(
                subprocess.Popen(
                    [sys.executable, "-m", "distributed.cli.dask_worker", "--no-nanny", "--nthreads", "1",
                     "--scheduler-file", str(tmp_path / "scheduler.json"), "--no-dashboard"],
                    env=environment, stderr=subprocess.DEVNULL,
                )
            )  # fmt: skip
        address = json.loads((tmp_path / "scheduler.json").read_text())["address"]
        output = tmp_path / "results"
        call = command(scape, output, "--scheduler", address, "--evaluation-samples", "100")
        benchmark = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        started.append(benchmark)
        results = output / "results.csv"
        wait_for(lambda: results.exists() and len(results.read_text().splitlines()) > 3, started)
        started[1].kill()
        _, errors = benchmark.communicate(timeout=300)
        assert benchmark.returncode == 0, errors
        rows = list(csv.DictReader(results.read_text().splitlines()))
        keys = [(row["source"], row["target"], row["method"]) for row in rows]
        assert len(keys) == len(set(keys)) == 12
    finally:
        for process in started:
            process.kill()
            process.wait()


def wait_for(condition, processes) -> None:
    deadline = time.monotonic() + 300
    while not condition():
        assert all(process.poll() is None for process in processes) and time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_named(scape, tmp_path):
    call = command(scape, tmp_path / "results", "--scheduler", "tcp://127.0.0.1:1")
    outcome = subprocess.run(call, capture_output=True, text=True)
    assert outcome.returncode == 2 and "no Dask scheduler answers" in outcome.stderr
    for address in ("somewhere", "tcp://somewhere:x"):
        with pytest.raises(InputError, match="no Dask scheduler answers"), open_executor(1, address):
            pass


def test_pairs_are_drawn_by_the_seed_or_read_from_a_list(scape, tmp_path):
    data_set = open_data_set(scape)
    every = [pair.name for pair in data_set.pairs]
    assert len(every) == 6
    assert [pair.name for pair in choose_pairs(data_set, None, 0)] == every
    assert [pair.name for pair in choose_pairs(data_set, "99", 0)] == every
    drawn = [[pair.name for pair in choose_pairs(data_set, "3", seed)] for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2] and len(drawn[0]) == 3
    (tmp_path / "list.txt").write_text("# some\nmesh002 mesh000  # twice\n\nmesh002 mesh000\n")
    assert [pair.name for pair in choose_pairs(data_set, str(tmp_path / "list.txt"), 0)] == [
        "mesh002 to mesh000"
    ]
    with pytest.raises(InputError, match="at least 1"):
        choose_pairs(data_set, "0", 0)
    (tmp_path / "list.txt").write_text("mesh002 mesh002\n")
    with pytest.raises(InputError, match="has no ground truth for mesh002 to mesh002"):
        choose_pairs(data_set, str(tmp_path / "list.txt"), 0)


def test_a_template_makes_a_method_for_partial_shapes(tmp_path):
    file = tmp_path / "whole.off"
    write_mesh(file, bumpy_mesh(1))
    methods = find_methods(["accurate:mammal", f"accurate:{file}"])
    assert list(methods) == ["accurate:mammal", "accurate:whole.off"]
    assert all(
        method.partial_only and "through the template" in method.reference for method in methods.values()
    )
    with pytest.raises(InputError, match=r"missing\.off"):
        find_methods([f"accurate:{tmp_path / 'missing.off'}"])
    (tmp_path / "other").mkdir()
    namesake = tmp_path / "other" / file.name
    write_mesh(namesake, bumpy_mesh(2))
    with pytest.raises(InputError, match=r"another template already has the name whole\.off: rename it"):
        find_methods([f"accurate:{file}", f"accurate:{namesake}"])


def test_unknown_methods_and_initial_maps_are_refused(tmp_path):
    with refused("'magic'", "method", "initial, mwp"):
        find_methods(["mwp", "magic"])
    with refused("'luck'", "initial map", "auto, shot"):
        Settings("luck")
    for name in ("mwp", "mine", "other/mine"):
        (tmp_path / name).mkdir(parents=True)
    assert list(find_methods(["mwp", "initial", "mwp", str(tmp_path / "mine")])) == ["mwp", "initial", "mine"]
    for names in (["mwp"], ["mine", "other/mine"]):
        with pytest.raises(InputError, match="another method already has the name m"):
            find_methods([str(tmp_path / name) for name in names])


def test_help_names_every_method():
    outcome = subprocess.run(
        [sys.executable, "-m", "jaxsmw", "benchmark", "--help"], capture_output=True, text=True
    )
    assert {*METHODS, *PEERS} <= set(re.findall(r"[\w-]+", re.sub(r"-\s+", "-", outcome.stdout)))
    assert all(isinstance(method, Method) for method in (*METHODS.values(), *PEERS.values()))


TOO_LONG = "x" * 300


def test_the_data_set_is_refused_as_the_output(scape, capsys):
    before = sorted(scape.iterdir())
    assert run_command(["benchmark", str(scape), "--methods", "initial", "--output", str(scape)]) == 2
    assert "is the directory of the data set: choose another directory" in capsys.readouterr().err
    assert sorted(scape.iterdir()) == before


def test_names_longer_than_the_file_system_allows_are_refused(scape, capsys):
    for call in (
        [TOO_LONG],
        [str(scape), "--methods", TOO_LONG],
        [str(scape), "--init", TOO_LONG],
        [str(scape), "--pairs", TOO_LONG],
    ):
        assert run_command(["benchmark", *call]) == 2
        (message,) = capsys.readouterr().err.splitlines()
        option = call[1] if len(call) > 1 else "DATASET_DIRECTORY"
        assert option in message and TOO_LONG[:50] in message
        assert "cannot be used (File name too long): choose another name" in message


def test_functions_refuse_names_longer_than_the_file_system_allows(scape):
    calls = [
        (lambda: open_data_set(TOO_LONG), "is not a directory"),
        (lambda: find_methods([TOO_LONG]), "is not a method"),
        (lambda: Settings(TOO_LONG), "is not an initial map"),
        (lambda: choose_pairs(open_data_set(scape), TOO_LONG, 0), "cannot be read as text"),
    ]
    for call, message in calls:
        with pytest.raises(InputError, match=f"{TOO_LONG}.*{message}"):
            call()


class LocalExecutor(Executor):
    """Run each task immediately, in this process."""

    def submit(self, function, /, *arguments, **options):
        future = Future()
        try:
            future.set_result(function(*arguments, **options))
        except InputError as error:
            future.set_exception(error)
        return future


def run_here(names, output: Path, data: Path, pairs="2", **settings) -> Results:
    data_set = open_data_set(data)
    chosen, every = choose_pairs(data_set, pairs, 0), Settings(evaluated_points=100, **settings)
    return run_benchmark(data_set, chosen, output, find_methods(names), every, LocalExecutor())


@pytest.fixture
def measure(scape, tmp_path):
    def run(names, *, output=tmp_path, data=scape, **options):
        return run_here(names, output, data, **options)

    return run


@pytest.fixture(scope="module")
def finished(scape, tmp_path_factory) -> Path:
    """A directory with the results of one method on two pairs."""
    directory = tmp_path_factory.mktemp("finished")
    run_here(["initial"], directory, scape)
    return directory


@pytest.mark.slow
def test_published_maps_serve_as_initial_maps_and_as_methods(measure, tmp_path):
    generator = np.random.default_rng(0)
    for kind, wrong in (("rough", 0.3), ("perfect", 0.0)):
        (tmp_path / kind).mkdir()
        for x, y in permutations(("mesh000", "mesh001", "mesh002"), 2):
            truth = np.arange(642)
            shuffled = np.where(generator.random(642) < wrong, generator.permutation(truth), truth)
            np.savetxt(tmp_path / kind / f"{x}_{y}.map", shuffled + 1, fmt="%d")
    output = tmp_path / "output"
    output.mkdir()
    rows = measure(
        ["initial", "mwp", str(tmp_path / "perfect")], output=output, init=str(tmp_path / "rough")
    ).rows
    means = {
        name: [float(r["mean"]) for r in rows if r["method"] == name]
        for name in ("initial", "mwp", "perfect")
    }
    assert means["perfect"] == [0, 0]
    assert min(means["initial"]) > 0.1 and max(means["mwp"]) < 0.02
    assert [row["seconds"] for row in rows if row["method"] == "perfect"] == ["nan", "nan"]
    other = tmp_path / "other"
    other.mkdir()
    (tmp_path / "perfect" / "mesh000_mesh001.map").unlink()
    with refused("mesh000_mesh001.map", "missing", "1 of 6"):
        measure(["initial", str(tmp_path / "perfect")], output=other, pairs="6")
    (tmp_path / "perfect" / "mesh000_mesh001.map").write_text("1\n2\n")
    found = measure(["initial", str(tmp_path / "perfect")], output=other, pairs="6")
    assert list(found.failures) == ["mesh000 to mesh001"] and len(found.rows) == 10
    with pytest.raises(InputError, match=r"stored results are kept\):\nmesh000 to mesh001: .*has 2 lines"):
        found.check()


@pytest.mark.slow
def test_a_mirrored_map_is_compared_with_the_mirrored_truth_only_on_request(measure, tmp_path):
    """The ground truth is the identity. The mirrored ground truth and the map are the same reflection."""
    vertices, faces = sphere_mesh(3)
    reflected = KDTree(vertices).query(vertices * [-1, 1, 1])[1]
    data = tmp_path / "data"
    (data / "off").mkdir(parents=True)
    (data / "corres").mkdir()
    (tmp_path / "flipped").mkdir()
    for number in range(2):
        write_mesh(data / "off" / f"ball{number}.off", make_mesh(vertices, faces))
        np.savetxt(data / "corres" / f"ball{number}.vts", np.arange(len(vertices)) + 1, fmt="%d")
        np.savetxt(data / "corres" / f"ball{number}.sym.vts", reflected + 1, fmt="%d")
        np.savetxt(tmp_path / "flipped" / f"ball{number}_ball{1 - number}.map", reflected + 1, fmt="%d")
    for mirrored in (False, True):
        output = tmp_path / f"mirrored-{mirrored}"
        output.mkdir()
        (row, _) = measure(
            ["initial"], data=data, output=output, mirrored=mirrored, init=str(tmp_path / "flipped")
        ).rows
        assert row["truth"] == ("mirrored" if mirrored else "direct")
        assert float(row["mean"]) == 0 if mirrored else float(row["mean"]) > 0.2


@pytest.mark.slow
def test_a_changed_shape_is_detected(measure, scape, tmp_path):
    data, output = tmp_path / "data", tmp_path / "output"
    shutil.copytree(scape, data)
    output.mkdir()
    measure(["initial"], data=data, output=output)
    for file in data.iterdir():
        file.write_text(file.read_text() + "\n")
    with pytest.raises(InputError, match="has changed since results"):
        measure(["initial"], data=data, output=output)


@pytest.mark.slow
def test_a_bad_shape_does_not_stop_other_pairs(measure, scape, tmp_path):
    data, output = tmp_path / "data", tmp_path / "output"
    shutil.copytree(scape, data)
    output.mkdir()
    contents = (data / "mesh002.off").read_text()
    (data / "mesh002.off").write_text(contents[: len(contents) // 2])
    found = measure(["initial"], data=data, output=output, pairs="6")
    assert len(found.rows) == 2 and len((output / "results.csv").read_text().splitlines()) == 1 + 2
    with pytest.raises(InputError) as caught:
        found.check()
    _, *causes = caught.value.lines()
    assert len(causes) == 1 and "and 2 more: " in causes[0] and causes[0].count("mesh002.off") == 1
    (data / "mesh002.off").write_text(contents)
    found = measure(["initial"], data=data, output=output, pairs="6")
    found.check()
    assert len(found.rows) == 6


def without_last_value(lines: list[str]) -> list[str]:
    return [*lines[:-1], lines[-1].rpartition(",")[0]]


def with_one_more_column(lines: list[str]) -> list[str]:
    return [f"{lines[0]},more", *(f"{line},1" for line in lines[1:])]


def with_words_for_numbers(lines: list[str]) -> list[str]:
    return [lines[0], *(re.sub(r"\d+\.\d+", "many", line) for line in lines[1:])]


@pytest.mark.parametrize("name", ["results.csv", "shapes.csv"])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda lines: ["a,b", "1,2"], "line 1: is not the header"),
        (lambda lines: ["", *lines], "line 1: is not the header"),
        (lambda lines: lines[1:], "line 1: is not the header"),
        (with_one_more_column, "line 1: is not the header"),
        (without_last_value, r"line \d: has \d+ values for \d+ columns"),
        (lambda lines: [lines[0], "", *lines[1:]], r"line 2: has 0 values for \d+ columns"),
        (with_words_for_numbers, "line 2: has 'many' in the column seconds"),
        (lambda lines: [lines[0], '"' + lines[1], *lines[2:]], "is not a table of results"),
    ],
)
def test_damaged_results_are_named_and_not_changed(measure, finished, tmp_path, name, damage, message):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    damaged = "".join(f"{line}\n" for line in damage((tmp_path / name).read_text().splitlines()))
    (tmp_path / name).write_text(damaged)
    with pytest.raises(InputError, match=message) as caught:
        measure(["initial"])
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)
    assert "restore the file, or remove it" in str(caught.value)
    assert (tmp_path / name).read_text() == damaged


@pytest.mark.parametrize("name", ["results.csv", "shapes.csv", "provenance.json"])
@pytest.mark.parametrize("contents", [bytes(range(256)) * 4, b"\0" * 100 + b"\n", b"not a table", b"\xff\n"])
def test_files_of_another_kind_are_named_and_not_changed(measure, finished, tmp_path, name, contents):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    (tmp_path / name).write_bytes(contents)
    with pytest.raises(
        InputError, match=f"{name}(, line 1)?: (is not the header|is not a table|the file is damaged)"
    ) as caught:
        measure(["initial"])
    assert "\n" not in str(caught.value) and (tmp_path / name).read_bytes() == contents


@pytest.mark.slow
@pytest.mark.parametrize("name", ["results.csv", "shapes.csv"])
@pytest.mark.parametrize("kept", [None, 0, 10])
def test_rows_of_removed_empty_or_unfinished_files_are_measured_again(
    measure, finished, tmp_path, name, kept
):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    contents = (tmp_path / name).read_bytes()
    (tmp_path / name).unlink()
    if kept is not None:
        (tmp_path / name).write_bytes(contents[:kept])
    assert len(measure(["initial"]).rows) == 2
    header, *rows = (tmp_path / name).read_text().splitlines()
    assert header == contents.decode().splitlines()[0]
    assert len(rows) == contents.decode().count("\n") - 1


def test_the_command_refuses_damaged_results_with_one_sentence(scape, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxsmw.runtime.workers.open_executor", lambda *_: nullcontext(LocalExecutor()))
    call = ["benchmark", str(scape), "--methods", "initial", "--pairs", "1", "--output", str(tmp_path)]
    assert run_command([*call, "--evaluation-samples", "50", "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    (tmp_path / "results.csv").write_bytes(b"\x89PNG\r\n\x1a\n")
    capsys.readouterr()
    assert run_command([*call, "--evaluation-samples", "50"]) == 2
    (message,) = [line for line in capsys.readouterr().err.splitlines() if "results.csv" in line]
    assert "is not a table of results" in message and "remove it to measure its rows again" in message


@pytest.mark.slow
def test_a_benchmark_does_not_change_the_calling_process(measure):
    double = jax.jit(lambda x: 2 * x)
    double(1.0)
    environment, listeners = dict(os.environ), list(monitoring.get_event_duration_listeners())
    assert len(measure(["initial", "mwp"]).rows) == 4
    assert dict(os.environ) == environment
    assert monitoring.get_event_duration_listeners() == listeners
    assert double._cache_size() == 1


def test_a_missing_package_is_named_before_any_pair_is_measured(scape, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert run_command(command(scape, tmp_path / "r")[3:]) == 2
    assert "benchmarks need pyarrow, which is not installed" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


@pytest.fixture(scope="module")
def imported():
    """What a process prints that imports the benchmark: whether no listener is added, and the files of the modules."""
    script = """if True:
        import equinox, jax, optimistix, sys
        from jax._src import monitoring
        before = list(monitoring.get_event_duration_listeners())
        import jaxsmw.benchmark.benchmark
        print(monitoring.get_event_duration_listeners() == before)
        print(*(m.__file__ for n, m in sys.modules.items() if n.split('.')[0] == 'jaxsmw'))
    """
    found = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    return found.stdout.splitlines()


def test_importing_the_benchmark_registers_no_listener(imported):
    assert imported[0] == "True"


def test_tables_are_written_although_a_shape_cannot_be_read(scape, tmp_path, monkeypatch, capsys):
    data, output = tmp_path / "data", tmp_path / "output"
    shutil.copytree(scape, data)
    (data / "mesh002.off").write_text("OFF\n1")
    monkeypatch.setattr("jaxsmw.runtime.workers.open_executor", lambda *_: nullcontext(LocalExecutor()))
    call = ["benchmark", str(data), "--methods", "initial", "--output", str(output)]
    assert run_command([*call, "--evaluation-samples", "50"]) == 2
    printed = capsys.readouterr()
    assert "| initial |" in printed.out and "| initial |" in (output / "summary.md").read_text()
    assert "2 of 6 pairs" in (output / "summary.md").read_text()
    assert "5 shapes or pairs could not be measured" in (output / "summary.md").read_text()
    assert printed.err.count("mesh002.off:") == 1 and (output / "results.parquet").exists()


@pytest.mark.slow
def test_results_of_another_data_set_are_refused(measure, scape, tmp_path):
    output, data = tmp_path / "output", tmp_path / "data"
    output.mkdir()
    measure(["initial"], output=output)
    for file in scape.iterdir():
        data.mkdir(exist_ok=True)
        shutil.copy(file, data / file.name.replace("mesh", "tr_reg_"))
    kept = (output / "results.csv").read_bytes()
    with pytest.raises(InputError, match=r"results of another data set, with a shape mesh00\d"):
        measure(["initial"], data=data, output=output)
    assert (output / "results.csv").read_bytes() == kept


def row(
    source: str, method: str, mean: float, *, result: str = "successful", seconds: float = 1.0
) -> dict[str, str]:
    numbers = dict.fromkeys(FIGURES, str(mean)) | {"seconds": str(seconds)}
    curve = " ".join(["0.5"] * len(CURVE))
    identity = {"source": source, "target": "y", "method": method, "machine": "m", "truth": "direct"}
    return identity | {"result": result} | numbers | {"curve": curve}


def test_tables_summarise_the_rows():
    rows = [
        *(row(f"x{i}", "mwp", 0.01 * (i + 1), seconds=i) for i in range(5)),
        *(row(f"x{i}", "a_b", 0.01 * (i + 1) + 0.02, seconds=np.nan) for i in range(4)),
        row("x4", "a_b", np.nan, result="it went wrong"),
    ]
    seconds = {"seconds_spectrum": "2", "seconds_descriptors": "3"}
    shapes = {name: seconds for name in ("y", *(f"x{i}" for i in range(5)))}
    summaries = summarize_methods(Results(rows, shapes, {}))
    mwp, other = summaries["mwp"], summaries["a_b"]
    assert mwp.mean == mwp.median == pytest.approx(30) and np.isnan(mwp.difference.mean)
    assert (mwp.seconds, mwp.pipeline_seconds, mwp.failures) == (2, 12, 0)
    assert other.mean == pytest.approx(45) and other.failures == 1 and np.isnan(other.seconds)
    assert other.difference.mean == pytest.approx(20)
    text = markdown_table(summaries)
    assert "| a_b | 45.0 | 45.0 | +20.0" in text and "| — | — | 5 | 1 |" in text
    latex = latex_table(summaries)
    assert r"mwp & \textbf{30.0} &" in latex and r"a\_b & 45.0 &" in latex and "—" not in latex
    assert all(line.count("&") == 10 for line in latex.splitlines()[2:] if "&" in line)


def test_tables_show_the_overlap_of_two_parts():
    rows = [
        row("x", "accurate", 0.01) | {"overlap_source": "0.6", "overlap_target": "0.8"},
        row("x", "mwp", 0.02) | {"overlap_source": "nan", "overlap_target": "nan"},
    ]
    seconds = {"seconds_spectrum": "2", "seconds_descriptors": "3"}
    summaries = summarize_methods(Results(rows, {"x": seconds, "y": seconds}, {}))
    assert summaries["accurate"].overlap == pytest.approx(0.7) and np.isnan(summaries["mwp"].overlap)
    header, _, accurate, mwp = markdown_table(summaries).splitlines()
    at = header.split(" | ").index("overlap IoU")
    assert [line.split(" | ")[at] for line in (accurate, mwp)] == ["70.0%", "—"]
    assert "overlap IoU & " in latex_table(summaries)
    assert "overlap" not in markdown_table({"mwp": summaries["mwp"]})


def test_stored_results_of_older_versions_are_read():
    files = sorted((Path(__file__).parent.parent / "docs" / "results").rglob("results.csv"))
    assert len(files) > 20
    for file in files:
        journal = Journal(
            file, ["source", "target", "method"], RESULT_COLUMNS, optional=OPTIONAL_FIGURES, read_only=True
        )
        assert journal.rows and float(journal.rows[0]["mean"]) > 0


class Slow(Method):
    """A method that sleeps, compiles a program in each run, and counts its runs."""

    number_of_eigenvectors = 1
    reference = "nothing"

    def __init__(self, seconds: float):
        self.seconds, self.runs = seconds, 0

    def __call__(self, pair):
        self.runs += 1
        time.sleep(self.seconds)
        return jax.jit(lambda initial_map: jnp.sort(initial_map + self.runs))(pair.initial_map)


def test_times_exclude_compilation(monkeypatch):
    """A method runs a second time if its first run compiles a program and is short."""
    monkeypatch.setattr(measurement, "_LONG", 0.5)
    monkeypatch.setattr(measurement, "_warm", {"short"})
    spectrum = random_spectrum(30, 5, seed=0)
    pair = MethodInput(SpectralPair(spectrum, spectrum), jnp.arange(30))
    for name, seconds, runs in (("short", 0.0, 2), ("long", 0.6, 1)):
        method = Slow(seconds)
        with measurement._compilation_seconds() as compilation:
            began = time.perf_counter()
            measured = measurement._timed(name, method, [pair])[0].seconds
            elapsed = time.perf_counter() - began
        assert method.runs == runs
        assert sum(compilation) > 0
        assert seconds <= measured <= elapsed - sum(compilation)


def test_the_first_row_of_a_table_is_its_header():
    rows = markdown([["a", "b"], ["1", "2"]])
    assert rows == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_the_digest_covers_all_code_that_results_depend_on(imported):
    """The digest prevents results of changed code from being mixed with older results."""
    measured = {path.resolve() for path in measured_code()}
    loaded = {Path(name).resolve() for name in imported[1].split()}
    drawing = {path for path in loaded if path.parent.name == "report"}
    assert len(loaded) > 40 and loaded - drawing <= measured
    assert not {"cli.py", "page.py"} & {path.name for path in measured}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("target", "share"), [("b", "1 of 2 pairs"), ("c", "1 given pairs")])
def test_the_summary_says_whether_pairs_belong_to_the_list_of_the_data_set(target, share):
    """The list of a remeshed set contains pairs of one class only, but a given list may contain others."""
    pairs = [SimpleNamespace(names=("a", name), both_partial=False) for name in ("b", "d")]
    results = SimpleNamespace(rows=[{"source": "a", "target": target, "machine": "a machine"}], failures=[])
    data_set = SimpleNamespace(pairs=pairs, layout="a set")
    assert _introduction(data_set, results, Settings("shot")).startswith(share)
