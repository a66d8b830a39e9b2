"""The benchmark command: what it finds, what it keeps when killed, and what it refuses."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from synthetic import bumpy_mesh

from jaxsmw import InputError
from jaxsmw.evaluation.benchmark import Settings, choose_pairs, run_benchmark
from jaxsmw.evaluation.datasets import open_data_set
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.mesh_files import write_mesh


@pytest.fixture(scope="module")
def scape(tmp_path_factory) -> Path:
    """Three poses of no body at all, laid out like SCAPE."""
    directory = tmp_path_factory.mktemp("bodies")
    mesh = bumpy_mesh(4)
    for number, stretch in enumerate(([1, 1, 1], [1.05, 1, 0.97], [1, 0.95, 1.04])):
        write_mesh(directory / f"mesh{number:03}.off", make_mesh(mesh.vertices * stretch, mesh.faces))
    return directory


def command(data: Path, output: Path, *options: str) -> list[str]:
    methods = ["start", "mwp", "zoomout"]
    arguments = ["benchmark", data, "--output", output, "--methods", *methods, *options]
    return [sys.executable, "-m", "jaxsmw", *map(str, arguments)]


def test_one_command_finishes_what_a_killed_one_began(scape, tmp_path):
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
    kept = kept[: 1 + 3 * ((len(kept) - 1) // 3)]

    second = subprocess.run(call, check=True, capture_output=True, text=True)
    lines = results.read_text().splitlines()
    assert lines[: len(kept)] == kept
    assert len(lines) == len(set(lines)) == 1 + 6 * 3
    assert second.stdout.startswith("| method | mean error |")
    third = subprocess.run(call, check=True, capture_output=True, text=True)
    assert third.stdout == second.stdout and results.read_text().splitlines() == lines

    table = pyarrow.parquet.read_table(output / "results.parquet").to_pylist()
    assert len(table) == 18 and table[0]["curve"][-1] <= 1 and isinstance(table[0]["mean"], float)
    means = {
        name: np.mean([row["mean"] for row in table if row["method"] == name]) for name in ("start", "mwp")
    }
    assert means["mwp"] < 0.5 * means["start"]
    for name in ("summary.md", "table.tex", "curves.png", "shapes.csv", "provenance.json"):
        assert (output / name).stat().st_size > 100

    other = subprocess.run([*call, "--seed", "1"], capture_output=True, text=True)
    assert other.returncode == 2 and "seed in settings was 0 and not 1" in other.stderr


def test_workers_of_a_dask_cluster_one_of_which_dies(scape, tmp_path):
    """A real scheduler and two workers on loopback: all results arrive, none twice."""
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
        rows = list(csv.DictReader(results.open()))
        keys = [(row["source"], row["target"], row["method"]) for row in rows]
        assert len(keys) == len(set(keys)) == 18
    finally:
        for process in started:
            process.kill()
            process.wait()


def wait_for(condition, processes) -> None:
    deadline = time.monotonic() + 300
    while not condition():
        assert all(process.poll() is None for process in processes) and time.monotonic() < deadline
        time.sleep(0.05)


def test_nobody_answers(scape, tmp_path):
    call = command(scape, tmp_path / "results", "--scheduler", "tcp://127.0.0.1:1")
    outcome = subprocess.run(call, capture_output=True, text=True)
    assert outcome.returncode == 2 and "no Dask scheduler answers" in outcome.stderr


def test_pairs_are_chosen(scape, tmp_path):
    data_set = open_data_set(scape)
    every = [pair.name for pair in data_set.pairs]
    assert len(every) == 6
    assert [pair.name for pair in choose_pairs(data_set, None, 0)] == every
    assert [pair.name for pair in choose_pairs(data_set, "99", 0)] == every
    drawn = [[pair.name for pair in choose_pairs(data_set, "3", seed)] for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2] and len(drawn[0]) == 3
    (tmp_path / "list.txt").write_text("mesh002 mesh000\n")
    assert [pair.name for pair in choose_pairs(data_set, str(tmp_path / "list.txt"), 0)] == [
        "mesh002 to mesh000"
    ]
    with pytest.raises(InputError, match="at least 1"):
        choose_pairs(data_set, "0", 0)
    (tmp_path / "list.txt").write_text("mesh002 mesh002\n")
    with pytest.raises(InputError, match="not a pair of"):
        choose_pairs(data_set, str(tmp_path / "list.txt"), 0)


def test_unknown_methods_are_refused(scape, tmp_path):
    with pytest.raises(InputError, match=r"'magic' is no method: choose from start, mwp"):
        run_benchmark([], tmp_path, ["magic"], Settings(), executor=None)
