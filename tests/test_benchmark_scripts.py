"""The scripts that measure speed and errors print complete tables for small shapes."""

import json
import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import benchmark_batches
import benchmark_collection
import benchmark_landmarks
import benchmark_speed
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial.transform import Rotation

from jaxsmw import make_mesh
from jaxsmw.creature import creature
from jaxsmw.io import Landmarks, write_mesh

pytestmark = pytest.mark.study


@pytest.fixture(autouse=True)
def single_precision():
    """Use float32, because the scripts measure the library with its default precision."""
    with jax.enable_x64(False):
        yield


def rows_of(monkeypatch, capsys, tmp_path, *arguments):
    """Run benchmark_batches.py, and return the first cells of the rows of its table."""
    arguments = [*arguments, "--repeats", "1", "--output", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["benchmark_batches.py", *arguments])
    monkeypatch.setenv("JAXSMW_CACHE", "off")
    benchmark_batches.main()
    printed = capsys.readouterr().out
    assert (tmp_path / "batches.md").read_text() in printed
    return [line.split(" | ")[0].removeprefix("| ") for line in printed.splitlines() if line.startswith("| ")]


def test_every_way_to_refine_a_batch_is_measured(monkeypatch, capsys, tmp_path):
    arguments = ["--quick", "--only", "paper", "--vertices", "150", "--eigenvectors", "8"]
    rows = rows_of(monkeypatch, capsys, tmp_path, *arguments)
    assert rows[2:] == ["products alone", "loop", "lax.map", "vmap of 2", "vmap of 8", "refine_pairs"]


def test_batches_of_methods_and_of_maps_of_descriptors_are_measured(monkeypatch, capsys, tmp_path):
    arguments = ["--quick", "--pairs", "2", "--vertices", "150", "--eigenvectors", "8", "--sizes", "6", "9"]
    rows = rows_of(monkeypatch, capsys, tmp_path, *arguments, "--only", "methods", "descriptors")
    assert {"LeastSquares", "FeatureRegression", "6", "9"} <= set(rows)


@pytest.mark.parametrize("mirrored", [False, True])
def test_opponents_carry_landmarks_to_a_turned_copy(mirrored):
    """All settings of CPD find a copy that is turned by a right angle and twice as large."""
    pytest.importorskip("rustcpd")
    body = creature("quadruped", vertices=1000)
    marks = Landmarks(("nose", "tail"), body.vertices[[3, 200]])
    hand = np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])
    turn = Rotation.from_rotvec([0.0, np.pi / 2, 0.0])
    faces = body.faces[:, ::-1] if mirrored else body.faces
    copy = make_mesh(2 * turn.apply(body.vertices * hand), faces)
    carried = benchmark_landmarks._opponents(body, copy, marks, mirrored)
    assert len(carried) == 9
    for positions, _ in carried.values():
        np.testing.assert_allclose(positions, copy.vertices[[3, 200]], atol=0.05 * copy.area**0.5)


@pytest.mark.sampled
def test_batches_of_the_preset_accurate_are_measured(monkeypatch, capsys, tmp_path):
    arguments = ["--only", "accurate", "--shapes", "2", "--vertices", "900", "--pairs", "2"]
    rows = rows_of(monkeypatch, capsys, tmp_path, *arguments, "--batch-sizes", "2", "8")
    assert rows[2:5] == ["products alone", "batches of 1", "batches of 2"] and rows[-1] == "match_pairs"
    _, numbers = json.loads((tmp_path / "batches.json").read_text())["accurate"]
    assert numbers["pairs"] == 2 and 0 < numbers["products"] < numbers["seconds"]["match_pairs"]


def run_on_two_devices(directory, *arguments):
    """Run benchmark_batches.py in a process with two CPU devices, and return what it prints."""
    command = [sys.executable, benchmark_batches.__file__, "--device", "--output", str(directory), *arguments]
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout


@pytest.mark.slow
def test_the_measurement_of_a_device_runs_on_the_cpu(tmp_path):
    sizes = ["--vertices", "700", "--pairs", "2", "--shapes", "2", "--batch-sizes", "2", "--repeats", "1"]
    printed = run_on_two_devices(tmp_path, "--eigenvectors", "8", "9", *sizes, "--only", "paper", "agreement")
    titles = [line.removeprefix("## ") for line in printed.splitlines() if line.startswith("## ")]
    assert titles == [
        "Preset paper, k = 8",
        "Preset paper, k = 9",
        "Agreement with the CPU, paper",
        "Agreement with the CPU, accurate",
    ]
    assert printed.count("100.00% | 100.00%") == 2


# The timer of the script waits until the first table is printed, so that the test passes on a busy machine.
ENDLESS = """
import threading, time
import benchmark_batches

printed = threading.Event()

class Timer(threading.Timer):
    def run(self):
        printed.wait()
        super().run()

def paper(options):
    yield "First", "A note.", [["header"], ["row"]], {"number": 1}
    printed.set()
    time.sleep(3600)

threading.Timer = Timer
benchmark_batches.PARTS["paper"] = paper
benchmark_batches.main()
"""


def test_a_measurement_ends_in_time_and_keeps_its_tables(tmp_path):
    command = [sys.executable, "-c", ENDLESS, "--device", "--seconds", "1", "--output", str(tmp_path)]
    paths = os.pathsep.join([str(Path(benchmark_batches.__file__).parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths}
    printed = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
    assert "| row |" in printed and printed.endswith("ended after 1 s: later tables are missing.\n")
    assert json.loads((tmp_path / "batches.json").read_text())["paper"] == [{"number": 1}]


def test_matrix_products_are_counted_in_loops():
    def function(a, b, c):
        def step(state, _):
            return jnp.tanh(state @ c), None

        repeated, _ = jax.lax.scan(step, a @ b, length=3)
        return jax.lax.map(lambda row: jax.jit(jnp.dot)(row, c), repeated)

    found = benchmark_batches.matrix_products(function, *map(jnp.zeros, ((4, 5), (5, 6), (6, 6))))
    counts = {(one.left, one.right): (times, one.operations) for one, times in found.items()}
    assert counts == {
        ((4, 5), (5, 6)): (1, 4 * 5 * 6),
        ((4, 6), (6, 6)): (3, 4 * 6 * 6),
        ((6,), (6, 6)): (4, 6 * 6),
    }


@pytest.mark.parametrize(
    "part",
    first_always([benchmark_speed.eigenbasis, benchmark_speed.stages, benchmark_speed.refinement], always=2),
)
def test_each_part_of_the_speed_benchmark_measures_positive_times(part, monkeypatch):
    monkeypatch.setattr(benchmark_speed, "EIGENVECTORS", 30)
    monkeypatch.setattr(benchmark_speed, "SAMPLES", 100)
    measured = list(part(Namespace(sizes=[1000], rounds=1, quick=True, data=None)))
    assert measured
    for title, note, (header, *rows), numbers in measured:
        assert title and note and rows and all(len(row) == len(header) for row in rows)
        assert min(numbers["seconds"].values()) > 0


def test_the_steps_of_a_match_from_files_add_up(tmp_path):
    files = [str(tmp_path / f"{pose}.ply") for pose in ("rest", "stand")]
    for file, pose in zip(files, ("rest", "stand"), strict=True):
        write_mesh(file, creature(vertices=900, pose=pose))
    seconds, cpu, peak, maps = benchmark_speed.matched_from_files(files, "paper")
    assert list(seconds) == ["reading", "eigenbases", "initial map", "refinement", "other"]
    assert min(seconds.values()) > 0 and cpu > 0 and peak > 0.1
    assert [len(one) for one in maps] == [900, 900]


def test_lines_of_code_leave_out_docstring_and_stopwatch():
    counted = {
        name: benchmark_speed.lines_of_code(function)
        for name, (_, function, *_) in benchmark_speed.LIBRARIES.items()
    }
    assert counted["jaxsmw, paper, NumPy"] == 3
    assert counted["pyFM, its defaults"] == 7


def test_maps_of_a_collection_are_compared_with_direct_maps(tmp_path, monkeypatch, capsys):
    for folder in ("off", "corres"):
        (tmp_path / "tiny" / folder).mkdir(parents=True)
    for pose in ("rest", "stand", "walk"):
        mesh = creature(vertices=700, pose=pose)  # the same triangulation in all poses
        write_mesh(tmp_path / "tiny" / "off" / f"{pose}.off", mesh)
        np.savetxt(tmp_path / "tiny" / "corres" / f"{pose}.vts", np.arange(1, 701), fmt="%d")
    arguments = [str(tmp_path), "tiny", "--preset", "paper", "--pairs", "2", "--ablations"]
    monkeypatch.setattr(sys, "argv", ["benchmark_collection.py", *arguments, "--output", str(tmp_path)])
    monkeypatch.setattr(benchmark_collection, "_TRIANGLES", 5)
    monkeypatch.setattr(
        benchmark_collection, "ABLATIONS", dict([*benchmark_collection.ABLATIONS.items()][:2])
    )
    benchmark_collection.main()
    lines = capsys.readouterr().out.splitlines()
    default, fewer = (json.loads(line.split(": ", 1)[1]) for line in lines[:2])
    assert default["edges"] == 3 and fewer["edges"] == 3
    assert default["through_template"]["mean"] < 60 and default["direct"]["lost"] == 0
    assert default["without_registered_meshes"]["mean"] < 60
    assert 0 <= default["cycles"]["template"] < default["cycles"]["graph_first"]
    assert len((tmp_path / "tiny" / "direct.csv").read_text().splitlines()) == 3
