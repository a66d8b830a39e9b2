"""Commands that are killed at random moments leave complete files, no processes, and nothing twice.

Each test starts a command several times, and sends SIGKILL, SIGTERM or SIGINT to it at a random moment. CI uses
few moments. The command

    JAXSMW_KILLS=50 python -m pytest -m slow tests/test_killed_commands.py

uses 50 moments for each signal.
"""

import csv
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import SMALL, write_pair
from synthetic import bumpy_mesh

from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import write_mesh

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="signals need Linux")]

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
KILLS = int(os.environ.get("JAXSMW_KILLS", 1))
# After SIGINT, a command must end within this number of seconds. The machine of the tests may be busy.
PATIENCE = 2.0 if KILLS > 1 else 10.0


class Command:
    """A command that runs in a new session, as if a terminal had started it."""

    def __init__(self, *arguments: object):
        self.words = [sys.executable, "-m", "jaxsmw", *map(str, arguments)]

    def complete(self) -> float:
        """Run the command to its end. Return its duration in seconds."""
        start = time.monotonic()
        ended = subprocess.run(self.words, capture_output=True, text=True, timeout=300)
        assert ended.returncode == 0, ended.stderr
        return time.monotonic() - start

    def kill_after(self, seconds: float, number: signal.Signals) -> bool:
        """Start the command and send it a signal. Return False if the command ended before the signal.

        A terminal sends SIGINT to all processes of the command. The other signals reach only the first
        process.
        """
        with tempfile.TemporaryFile("w+") as errors:
            process = subprocess.Popen(
                self.words, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True
            )
            try:
                process.wait(timeout=seconds)
            except subprocess.TimeoutExpired:
                sent = time.monotonic()
                if number == signal.SIGINT:
                    os.killpg(process.pid, number)
                else:
                    process.send_signal(number)
                process.wait(timeout=60)
                assert number != signal.SIGINT or time.monotonic() - sent < PATIENCE
            # A shell reports a process that a signal ended as exit code 128 + number, which is 130 for SIGINT.
            assert process.returncode in (0, -number)
            self.assert_alone(process.pid)
            errors.seek(0)
            told = errors.read()
        # A worker cannot start properly if SIGKILL ends the command that starts it.
        assert number == signal.SIGKILL or "Traceback" not in told, told
        return process.returncode != 0

    @staticmethod
    def assert_alone(session: int) -> None:
        """Check that no process of the session is left after some seconds."""
        end = time.monotonic() + 30
        while left := subprocess.run(
            ["ps", "-o", "pid=,args=", "-s", str(session)], capture_output=True, text=True
        ).stdout:
            assert time.monotonic() < end, left
            time.sleep(0.1)


def moments(duration: float, seed: int) -> Iterator[tuple[float, signal.Signals]]:
    """Yield random moments up to the duration, each with a signal.

    In the first 0.1 s, Python itself starts. Only then can a command handle signals.
    """
    generator = random.Random(seed)
    for _ in range(KILLS):
        for number in SIGNALS:
            yield generator.uniform(0.1, duration), number


def files(directory: Path) -> dict[str, bytes]:
    """The names and contents of all files in a directory and its subdirectories."""
    return {
        str(p.relative_to(directory)): p.read_bytes() for p in sorted(directory.rglob("*")) if p.is_file()
    }


def test_a_killed_match_leaves_complete_files(tmp_path):
    meshes, out = tmp_path / "meshes", tmp_path / "out"
    meshes.mkdir()
    out.mkdir()
    pair = write_pair(meshes)
    command = Command(
        "match", pair / "x.off", pair / "y.ply", "--output", out / "map.txt", "--expected-error", out / "error.txt",
        "--surface-points", out / "points.baryc_gt", "--preset", "paper", *SMALL, "--quiet"
    )  # fmt: skip
    command.complete()
    complete = files(out)
    duration = command.complete()  # with all programs in the cache
    assert files(out) == complete
    killed = 0
    for moment, number in moments(duration, seed=0):
        for file in out.iterdir():
            file.unlink()
        killed += command.kill_after(moment, number)
        left = files(out)
        finished = left.keys() & complete.keys()
        assert all(left[name] == complete[name] for name in finished)
        if number != signal.SIGKILL:
            assert left.keys() == finished  # nothing unfinished
        command.complete()
        assert files(out) == complete  # the next run removes what a killed run left
    assert killed >= KILLS


@pytest.fixture
def data(tmp_path) -> Path:
    """A data set of four poses, which are copies with noise."""
    directory = tmp_path / "data"
    directory.mkdir()
    mesh = bumpy_mesh(3)
    for number in range(4):
        noise = 0.01 * np.random.default_rng(number).normal(size=mesh.vertices.shape)
        write_mesh(directory / f"mesh00{number}.off", make_mesh(mesh.vertices + noise, mesh.faces))
    return directory


def rows(output: Path) -> list[tuple[str, ...]]:
    """The rows of the results, without times."""
    with open(output / "results.csv", newline="") as file:
        return sorted(
            tuple(value for name, value in row.items() if "seconds" not in name)
            for row in csv.DictReader(file)
        )


@pytest.fixture
def dask() -> Iterator[str]:
    """The address of a Dask scheduler with two worker processes."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


@pytest.mark.sampled
@pytest.mark.parametrize("processes", ["two workers", "one worker", "Dask"][:KILLS])
def test_a_killed_benchmark_loses_no_pair_and_measures_none_twice(tmp_path, data, processes, request):
    options: dict[str, tuple[str, ...]] = {
        "one worker": ("--workers", "1"),
        "two workers": ("--workers", "2"),
    }
    workers = options.get(processes) or ("--scheduler", request.getfixturevalue("dask"))

    def command(output: Path) -> Command:
        return Command(
            "benchmark", data, "--methods", "initial", "no-filter", "--init", "wks", "--evaluation-samples", "20",
            "--output", output, "--quiet", *workers
        )  # fmt: skip

    reference = tmp_path / "reference"
    command(reference).complete()
    expected = rows(reference)
    assert len(expected) == 24 and len(set(expected)) == 24
    duration = command(tmp_path / "again").complete()
    output = tmp_path / "out"
    for run, (moment, number) in enumerate(moments(1.2 * duration, seed=len(processes)), start=1):
        command(output).kill_after(moment, number)
        if (output / "results.csv").exists():
            measured = rows(output)
            assert set(measured) <= set(expected) and len(set(measured)) == len(measured)
        if run % 4 == 0:
            command(output).complete()
            assert rows(output) == expected
            assert not leftovers(output)
            shutil.rmtree(output)
    command(output).complete()
    assert rows(output) == expected and not leftovers(output)


def leftovers(directory: Path) -> list[str]:
    """The temporary files in a directory and its subdirectories."""
    return [name for name in files(directory) if re.fullmatch(r"\.[0-9a-f]{32}.*", Path(name).name)]


@pytest.mark.sampled
def test_a_killed_collection_continues(tmp_path, data):
    out, reference = tmp_path / "out", tmp_path / "reference"

    def command(output: Path) -> Command:
        return Command("collection", data, "--output", output, "--preset", "paper", "--quiet")

    command(reference).complete()
    duration = command(tmp_path / "again").complete()
    expected = {name: content for name, content in files(reference).items() if name.startswith("maps/")}
    assert expected
    for run, (moment, number) in enumerate(moments(1.1 * duration, seed=3), start=1):
        command(out).kill_after(moment, number)
        if run % 3 == 0:
            command(out).complete()
            left = files(out)
            assert {name: left[name] for name in left if name.startswith("maps/")} == expected
            assert not leftovers(out)
            shutil.rmtree(out)
