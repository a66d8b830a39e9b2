"""Damaged files and strange options cause one sentence: no traceback, no hang, no large memory, no output file.

The tests damage the files in `tests/corpus`. Some damages know the structure of the formats: they replace
numbers, words and lines of texts, integers of binary files, and members of archives. Each test has ten parts with
different cases, of which the quick selection runs the first. Together, the parts try 1000 cases. The command

    JAXSMW_FUZZING=20000 python -m pytest -m "" tests/test_fuzzing.py

tries 20 000 cases in the ten parts of each test.
"""

import contextlib
import io
import os
import re
import signal
import struct
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import COMMANDS
from hypothesis import HealthCheck, example, given, seed, settings
from hypothesis import strategies as st

from jaxsmw.cli.run import run_command
from jaxsmw.errors import InputError
from jaxsmw.io.landmark_files import read_landmark_file
from jaxsmw.io.overlays import read_overlay

CORPUS = Path(__file__).parent / "corpus"
MESHES = sorted(
    p.name
    for p in CORPUS.iterdir()
    if re.match(r"jaxsmw|trimesh|vtk|scipy|pycollada|draco|points\.(xyz|npy)|.*pcd", p.name)
)
OVERLAYS = sorted(p.name for p in CORPUS.iterdir() if p.name.startswith("overlay"))
LANDMARKS = sorted(p.name for p in CORPUS.iterdir() if p.name.startswith("landmarks"))
MAPS = ["map.txt", "map.npy", "map.mat", "map.npz", "map.safetensors"]
TRUTHS = ["map.txt", "pairs.txt", "points.baryc_gt"]
# The largest time of a command, and the largest growth of the memory of the process.
SECONDS, BYTES = 20, 2 * 2**30
PARTS = 10

NUMBERS = (
    b"-1",
    b"0",
    b"1e308",
    b"nan",
    b"-inf",
    b"2147483648",
    b"9223372036854775808",
    b"1" + b"0" * 40,
    b"1.5",
    b"",
    b"x",
)
INTEGERS = (0, 1, -1, 3, 127, 2**31 - 1, -(2**31), 2**32 - 1, 2**62, -(2**63))


def fuzzed(cases: int, *strategies: st.SearchStrategy, first: tuple | None = None) -> Callable:
    """Return a decorator that makes a test with ten parts of a function that checks one case.

    **Arguments:** the number of cases, which the environment variable `JAXSMW_FUZZING` replaces, the strategies for
    the arguments of the function, and the arguments of the case that every part tries first.
    """
    checks = [HealthCheck.too_slow, HealthCheck.large_base_example]
    chosen = settings(
        max_examples=int(os.environ.get("JAXSMW_FUZZING", cases)) // PARTS, suppress_health_check=checks
    )

    def decorate(check: Callable) -> Callable:
        @pytest.mark.parametrize(
            "part", [pytest.param(part, marks=pytest.mark.sampled if part else ()) for part in range(PARTS)]
        )
        def test(part: int) -> None:
            cases = given(*strategies)(check)
            chosen(seed(part)(example(*first)(cases) if first else cases))()

        return test

    return decorate


# A kind of damage, a place from 0 to 1, another place, and a choice.
damages = st.tuples(
    st.sampled_from(
        ["flip", "cut", "repeat", "insert", "end", "number", "word", "line", "swap", "integer", "member"]
    ),
    st.floats(0, 1, exclude_max=True),
    st.floats(0, 1, exclude_max=True),
    st.integers(0, 2**16 - 1),
)


def damaged(content: bytes, damage: tuple[str, float, float, int]) -> bytes:
    """Return the content of a file after one damage."""
    kind, first, second, choice = damage
    n = len(content)
    start, end = sorted((int(first * n), int(second * n)))
    if kind == "flip":
        return content[:start] + bytes([choice % 256]) + content[start + 1 :]
    if kind == "cut":
        return content[:start] + content[end:]
    if kind == "repeat":
        return content[:end] + content[start:end] * (choice % 3 + 1) + content[end:]
    if kind == "insert":
        return content[:start] + struct.pack("<H", choice) * (choice % 9) + content[start:]
    if kind == "end":
        return content[: int(second * n)]
    if kind == "integer":
        form = "<>"[choice % 2] + "iq"[choice // 2 % 2]
        wanted = INTEGERS[choice // 4 % len(INTEGERS)]
        packed = wanted.to_bytes(16, "little" if form[0] == "<" else "big", signed=True)
        packed = packed[: struct.calcsize(form)] if form[0] == "<" else packed[-struct.calcsize(form) :]
        return content[:start] + packed + content[start + len(packed) :]
    if kind == "member":
        return damaged_member(content, damage)
    pattern = {
        "number": rb"-?\d+(?:\.\d+)?(?:e-?\d+)?",
        "word": rb"[A-Za-z_]+",
        "line": rb"[^\n]*\n",
        "swap": rb"[^\n]*\n",
    }
    places = [match.span() for match in re.finditer(pattern[kind], content)]
    if not places:
        return content
    (a, b), (c, d) = (places[int(place * len(places))] for place in (first, second))
    if kind == "number":
        return content[:a] + NUMBERS[choice % len(NUMBERS)] + content[b:]
    if kind == "line" and choice % 2:
        return content[:a] + content[b:]
    # One word or line takes the place of another one.
    return content[:a] + content[c:d] + content[b:]


def damaged_member(content: bytes, damage: tuple[str, float, float, int]) -> bytes:
    """Return an archive in which one member is damaged, or the content itself if it is not an archive."""
    _, first, second, choice = damage
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # earlier damages of an archive can raise any exception
        return content
    if not members:
        return content
    chosen = sorted(members)[choice % len(members)]
    kind = ("flip", "cut", "integer", "number", "end")[choice % 5]
    members[chosen] = damaged(members[chosen], (kind, first, second, choice // 5))
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Raise an error if the block takes more than `SECONDS`, or more than `BYTES` of additional memory."""

    def late(*_: object) -> None:
        raise TimeoutError(f"the command took more than {SECONDS} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    memory = peak_memory(reset=True)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert peak_memory() - memory < BYTES


def peak_memory(*, reset: bool = False) -> int:
    """Return the peak memory of this process in bytes; 0 on systems without `/proc`."""
    if not Path("/proc/self/clear_refs").exists():
        return 0
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    (kilobytes,) = re.findall(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return 1024 * int(kilobytes)


def assert_clean(arguments: list[object], inputs: Path, outputs: Path, *, naming: str | None = None) -> int:
    """Run a command in this process. It succeeds, or prints one sentence and leaves no file.

    **Arguments:** the words of the command, the directory that contains its inputs, the directory that may
    contain its outputs, and a text that the message must contain.

    **Returns:** the exit code.
    """
    before = {path: path.stat().st_mtime_ns for path in inputs.iterdir()}
    output, errors = io.StringIO(), io.StringIO()
    with limited(), contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        code = run_command([str(argument) for argument in arguments])
    told = [line for line in errors.getvalue().splitlines() if not line.startswith(("warning: ", "note: "))]
    assert {path: path.stat().st_mtime_ns for path in inputs.iterdir()} == before
    if code == 0:
        return code
    assert code in (1, 2), told
    assert len(told) == 1 and told[0].startswith("jaxsmw") and len(told[0]) > 40, told
    assert told[0].rstrip()[-1] in ".?)", told
    assert naming is None or naming in told[0], told
    assert list(outputs.iterdir()) == [], told
    return code


@contextlib.contextmanager
def directories() -> Iterator[tuple[Path, Path]]:
    """Two new directories, for inputs and for outputs."""
    with tempfile.TemporaryDirectory() as name:
        inputs, outputs = Path(name) / "in", Path(name) / "out"
        inputs.mkdir()
        outputs.mkdir()
        yield inputs, outputs


def write_damaged(directory: Path, name: str, changes: list, suffix_of: str | None = None) -> Path:
    """Write a damaged file of the corpus, perhaps with the suffix of another file."""
    content = (CORPUS / name).read_bytes()
    for change in changes:
        content = damaged(content, change)
    file = directory / ("file" + "".join(Path(suffix_of or name).suffixes))
    file.write_bytes(content)
    return file


def files(names: list[str]) -> st.SearchStrategy:
    """A file of the corpus, one to four damages, and rarely the suffix of another file."""
    suffix = st.one_of(*[st.none()] * 7, st.sampled_from(names))
    return st.tuples(st.sampled_from(names), st.lists(damages, min_size=1, max_size=4), suffix)


# The first case has a signalling NaN.
@fuzzed(500, files(MESHES), first=(("binary.pcd", [("integer", 0.96875, 0.939453125, 8)], None),))
def test_damaged_meshes(case):
    name, changes, suffix_of = case
    with directories() as (inputs, outputs):
        file = write_damaged(inputs, name, changes, suffix_of)
        call = ["spectrum", file, "--eigenvectors", 3, "--output", outputs / "spectrum.npz", "--quiet"]
        if assert_clean(call, inputs, outputs, naming=str(file)) == 0:
            with np.load(outputs / "spectrum.npz") as arrays:
                assert all(np.isfinite(values).all() for values in arrays.values())


# A damaged header of an array can look like one that NumPy wrote under Python 2. NumPy reads it with a warning.
@pytest.mark.filterwarnings("default:Reading `.npy`:UserWarning")
@fuzzed(
    150,
    files(MAPS),
    files(TRUTHS),
    first=(("map.npy", [("number", 0.5, 0.0, 1)], None), ("map.txt", [("cut", 0.0, 0.0, 0)], None)),
)
def test_damaged_maps_and_ground_truth(pointwise_map, truth):
    with directories() as (inputs, outputs):
        map_file = write_damaged(inputs, *pointwise_map)
        (inputs / "truth").mkdir()
        truth_file = write_damaged(inputs / "truth", *truth)
        mesh = CORPUS / "trimesh.off"
        call = [
            "evaluate",
            mesh,
            mesh,
            map_file,
            "--ground-truth",
            truth_file,
            "--output",
            outputs / "e.json",
        ]
        assert_clean([*call, "--quiet"], inputs, outputs)


def message_of(function: Callable[[], object]) -> str | None:
    """Return the message of the `InputError` that a function raises, or None."""
    try:
        function()
    except InputError as error:
        return str(error)
    return None


@fuzzed(250, files(OVERLAYS))
def test_damaged_overlays(case):
    with directories() as (inputs, _):
        file = write_damaged(inputs, *case)
        with limited():
            message = message_of(lambda: read_overlay(file))
        assert message is None or ("\n" not in message and str(file) in message)


@fuzzed(250, files(LANDMARKS))
def test_damaged_landmarks(case):
    with directories() as (inputs, _):
        file = write_damaged(inputs, *case)
        with limited():
            message = message_of(lambda: read_landmark_file(file))
        assert message is None or ("\n" not in message and str(file) in message)


words = st.one_of(
    st.sampled_from(COMMANDS),
    st.sampled_from(["--output", "--preset", "--eigenvectors", "--init", "--ground-truth", "--bank", "--seed", "--up", "--mirror"]),
    st.sampled_from(["paper", "-1", "0", "nan", "1e99", "9" * 30, "", " ", "..", "/dev/null", "--", "-", "\n", "\x00", "é", "\udcff"]),
    st.sampled_from([str(CORPUS / name) for name in ("trimesh.off", "map.txt", "README.md")] + [str(CORPUS)]),
    st.text(max_size=20),
)  # fmt: skip


@fuzzed(100, st.lists(words, max_size=8))
def test_strange_options(arguments):
    """Only the commands that never compile or match are completed by these words."""
    with directories() as (inputs, outputs), contextlib.chdir(outputs):
        if arguments[:1] in (["demo"], ["benchmark"]) or "--help" in arguments:
            return
        assert_clean(arguments, inputs, outputs)


if sys.platform != "linux":  # signals and memory limits differ elsewhere
    pytestmark = pytest.mark.skip("fuzzing needs Linux")
