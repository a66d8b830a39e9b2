"""Several commands share one cache, also if one of them is killed, or if the cache disappears while they run."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from command_line import SMALL, write_pair
from sampled_cases import first_always

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="signals need Linux")]

# `JAXSMW_KILLS` also chooses the long form of tests/test_killed_commands.py.
AT_ONCE = 8 if "JAXSMW_KILLS" in os.environ else 3


@pytest.fixture
def pair(tmp_path) -> Path:
    (tmp_path / "meshes").mkdir()
    return write_pair(tmp_path / "meshes")


def match_words(pair: Path, output: Path) -> list[str]:
    """Return the arguments of a match."""
    call = [
        "match",
        pair / "x.off",
        pair / "y.ply",
        "--output",
        output,
        "--preset",
        "paper",
        *SMALL,
        "--quiet",
    ]
    return list(map(str, call))


def started(pair: Path, output: Path, cache: Path, *options: str) -> subprocess.Popen[str]:
    """Start a match that uses a cache directory."""
    return subprocess.Popen(
        [sys.executable, "-m", "jaxsmw", *match_words(pair, output), *options],
        env={**os.environ, "JAXSMW_CACHE": str(cache)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process: subprocess.Popen[str]) -> str:
    """Wait for a command, which must succeed. Return what it printed on standard error."""
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    return errors


def test_commands_at_once_share_a_cache(tmp_path, pair):
    """All commands start with an empty cache, and one is killed while it fills the cache."""
    cache, out = tmp_path / "cache", tmp_path / "out"
    cache.mkdir()
    out.mkdir()
    processes = [started(pair, out / f"{number}.txt", cache) for number in range(AT_ONCE)]
    while not any(cache.rglob("*")):
        assert processes[0].poll() is None
        time.sleep(0.02)
    processes[0].send_signal(signal.SIGKILL)
    for process in processes[1:]:
        assert finished(process) == ""
    processes[0].communicate()
    maps = {(out / f"{number}.txt").read_text() for number in range(1, AT_ONCE)}
    assert len(maps) == 1
    # Another command uses what the killed command left, and removes its unfinished files.
    assert finished(started(pair, out / "0.txt", cache)) == ""
    assert {(out / "0.txt").read_text()} == maps


def assert_warned_at_most_once(errors: str) -> None:
    """Check that a command printed nothing, or one warning that results cannot be cached."""
    assert not errors or re.fullmatch(r"warning: results cannot be cached in .*\.\n", errors), errors


def test_a_cache_that_disappears_changes_nothing(tmp_path, pair):
    cache, expected, found = tmp_path / "cache", tmp_path / "expected.txt", tmp_path / "found.txt"
    cache.mkdir()
    finished(started(pair, expected, cache))
    stop = threading.Event()

    def remove_again_and_again() -> None:
        while not stop.is_set():
            shutil.rmtree(cache, ignore_errors=True)
            time.sleep(0.05)

    remover = threading.Thread(target=remove_again_and_again)
    remover.start()
    try:
        errors = finished(started(pair, found, cache))
    finally:
        stop.set()
        remover.join()
    assert_warned_at_most_once(errors)
    assert found.read_text() == expected.read_text()


# A limit on the size of files stands for a full disk, because `/dev/full` cannot be a directory.
FULL_DISK = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
"""
# What some network file systems answer.
NO_LOCKS = """
import errno, fcntl
def refuse(*_):
    raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = refuse
"""


@pytest.mark.parametrize("fault", first_always([FULL_DISK, NO_LOCKS]), ids=["full disk", "no locks"])
def test_a_cache_on_an_unsuitable_disk_changes_nothing(tmp_path, pair, fault):
    expected, found = tmp_path / "expected.txt", tmp_path / "found.txt"
    finished(started(pair, expected, tmp_path / "whole"))
    program = f"{fault}\nfrom jaxsmw.cli import main\nmain()"
    ended = subprocess.run(
        [sys.executable, "-c", program, *match_words(pair, found)],
        # With the variables of the tests, programs would be stored in another directory.
        env={
            **{name: value for name, value in os.environ.items() if "CACHE" not in name},
            "JAXSMW_CACHE": str(tmp_path / "unsuitable"),
        },
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ended.returncode == 0, ended.stderr
    assert_warned_at_most_once(ended.stderr)
    assert found.read_text() == expected.read_text()
    if fault == NO_LOCKS:  # Results are cached, and programs are not.
        cache = tmp_path / "unsuitable"
        assert any(cache.glob("spectrum-*.npz")) and not any(cache.rglob("*-cache"))
