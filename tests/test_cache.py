"""The disk cache handles bad entries, unwritable directories, a size limit and many processes."""

import concurrent.futures
import errno
import multiprocessing
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_line import SMALL
from synthetic import sphere_mesh

from jaxsmw.cli.run import run_command
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import write_mesh
from jaxsmw.runtime.cache import cache_compiled_programs, cache_contents, cached, clear_cache

INPUT = np.arange(6.0).reshape(2, 3)
RESULT = {"values": np.array([0.1, np.nan, -0.0]), "count": np.array(3), "none": np.empty((0, 2), np.int32)}


class Computation:
    """A computation that counts its runs."""

    def __init__(self, result=RESULT):
        self.result, self.runs = result, 0

    def __call__(self):
        self.runs += 1
        return self.result


@pytest.fixture
def directory(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path / "not" / "there" / "yet"))
    return tmp_path / "not" / "there" / "yet"


def assert_same(arrays, expected=RESULT):
    assert arrays.keys() == expected.keys()
    for name, array in arrays.items():
        assert array.dtype == expected[name].dtype and array.shape == expected[name].shape
        assert array.tobytes() == expected[name].tobytes()


def test_results_are_computed_once_and_returned_bit_for_bit(directory):
    compute = Computation()
    for _ in range(3):
        assert_same(cached("test", [INPUT, 7], compute))
    assert compute.runs == 1
    assert [entry.suffix for entry in directory.iterdir()] == [".npz"]


def test_the_memory_layout_of_inputs_has_no_effect(directory):
    compute = Computation()
    cached("test", [INPUT], compute)
    cached("test", [np.asfortranarray(INPUT)], compute)
    cached("test", [np.repeat(INPUT, 2, axis=0)[::2]], compute)
    assert compute.runs == 1


def test_every_property_of_the_inputs_is_part_of_the_key(directory):
    inputs = [
        [INPUT],
        [INPUT + 1e-15],
        [INPUT.T],
        [INPUT.ravel()],
        [INPUT.astype(np.float32)],
        [INPUT.view(np.int64)],
        [INPUT.astype(">f8")],
        [INPUT, INPUT],
        [INPUT, 7],
        [7, INPUT],
        [INPUT, 7.0],
        [INPUT, "7"],
        [INPUT, True],
        [INPUT, 1],
        [INPUT[:1], INPUT[1:]],
        ["ab", "c"],
        ["a", "bc"],
        ["abc"],
        [],
    ]
    computations = [Computation({"number": np.array(i)}) for i in range(len(inputs))]
    for _ in range(2):
        for i, (values, compute) in enumerate(zip(inputs, computations, strict=True)):
            assert cached("test", values, compute)["number"] == i
    assert cached("other", inputs[0], Computation({"number": np.array(-1)}))["number"] == -1
    assert {compute.runs for compute in computations} == {1}


@pytest.mark.parametrize("setting", ["", "off"])
def test_a_disabled_cache_writes_nothing(setting, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXSMW_CACHE", setting)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compute = Computation()
    for _ in range(2):
        assert_same(cached("test", [INPUT], compute))
    assert compute.runs == 2 and not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows knows the user's directory otherwise")
def test_a_user_without_a_home_directory_has_no_cache(monkeypatch):
    for name in ("JAXSMW_CACHE", "HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def unknown(_: int) -> None:
        raise KeyError("getpwuid(): uid not found")

    monkeypatch.setattr("pwd.getpwuid", unknown)
    assert cached("test", [1], lambda: {"a": np.arange(3)})["a"].tolist() == [0, 1, 2]
    assert cache_contents() == {}


def test_the_default_is_the_users_cache_directory(tmp_path, monkeypatch):
    monkeypatch.delenv("JAXSMW_CACHE", raising=False)
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda name, **_: str(tmp_path / name))
    cached("test", [INPUT], Computation())
    assert len(list((tmp_path / "jaxsmw").glob("test-*.npz"))) == 1


def test_every_wrong_byte_is_detected(directory):
    cached("test", [INPUT], Computation())
    (entry,) = directory.iterdir()
    good = entry.read_bytes()
    for position in range(0, len(good), 2):
        entry.write_bytes(good[:position] + bytes([good[position] ^ 0x55]) + good[position + 1 :])
        assert_same(cached("test", [INPUT], Computation()))


class Bomb:
    """Unpickling this object creates a file."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


def test_damaged_and_foreign_entries_are_computed_again_and_replaced(directory, tmp_path):
    cached("test", [INPUT], Computation())
    cached("test", ["another"], Computation({"values": np.zeros(3)}))
    key = next(e for e in directory.iterdir() if np.load(e)["values"].any()).name
    entry, trace = directory / key, tmp_path / "trace"
    good = entry.read_bytes()
    other = next(e for e in directory.iterdir() if e.name != key).read_bytes()
    np.savez(tmp_path / "unrelated.npz", values=np.zeros(3))
    np.save(tmp_path / "single.npy", np.zeros(3))
    np.savez(tmp_path / "pickle.npz", values=np.array([Bomb(trace)], dtype=object), contents=np.array(""))
    foreign = [(tmp_path / name).read_bytes() for name in ("unrelated.npz", "single.npy", "pickle.npz")]
    for content in [*(good[:size] for size in range(0, len(good), 101)), b"\0" * 500, other, *foreign]:
        entry.write_bytes(content)
        compute = Computation()
        for _ in range(2):
            assert_same(cached("test", [INPUT], compute))
        assert compute.runs == 1, content[:40]
    assert not trace.exists()


def test_an_unwritable_directory_causes_one_warning(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path / "file"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for number in range(3):
            assert_same(cached("test", [number], Computation()))
    assert len(caught) == 1
    assert str(tmp_path / "file") in str(caught[0].message) and "JAXSMW_CACHE" in str(caught[0].message)


def test_a_full_disk_leaves_no_unfinished_file(directory, monkeypatch):
    def full(path, **_):
        path.write_bytes(b"half an ent")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.warns(RuntimeWarning, match="free disk space"):
        assert_same(cached("test", [INPUT], Computation()))
    assert not list(directory.iterdir())


def test_a_directory_in_place_of_an_entry_causes_a_warning(directory):
    cached("test", [INPUT], Computation())
    (entry,) = directory.iterdir()
    entry.unlink()
    entry.mkdir()
    with pytest.warns(RuntimeWarning, match="cannot be cached"):
        assert_same(cached("test", [INPUT], Computation()))


def test_the_limit_removes_the_least_recently_used_entries_but_no_foreign_files(directory, monkeypatch):
    def entry(number):
        compute = Computation({"values": np.full(1000, float(number))})
        assert cached("test", [number], compute)["values"][0] == number
        return compute.runs

    directory.mkdir(parents=True)
    (directory / "thesis.npz").write_bytes(b"0" * 100_000)
    (directory / f".{'0' * 32}.npz").write_bytes(b"left by a killed process")
    os.utime(directory / f".{'0' * 32}.npz", (0, 0))
    # The limit has room for three entries of 8000 bytes and their overhead.
    monkeypatch.setenv("JAXSMW_CACHE_LIMIT", str(30_000 / 2**30))
    now = 1_000_000
    for number in range(3):
        assert entry(number) == 1
        for file in directory.glob("test-*"):
            if file.stat().st_mtime > now + 1000:
                os.utime(file, (now + number, now + number))
    assert entry(0) == 0  # entry 1 is now the least recently used entry
    assert entry(3) == 1
    assert not (directory / f".{'0' * 32}.npz").exists() and (directory / "thesis.npz").exists()
    assert [entry(number) for number in (0, 2, 3, 1)] == [0, 0, 0, 1]


@pytest.mark.parametrize("limit", ["4 GiB", "-1", "nan", "inf", ""])
def test_the_limit_must_be_a_number(directory, monkeypatch, limit):
    monkeypatch.setenv("JAXSMW_CACHE_LIMIT", limit)
    with pytest.raises(InputError, match=f"JAXSMW_CACHE_LIMIT is '{limit}': give the size"):
        cached("test", [INPUT], Computation())


def _work(seed):
    """Read and write a few entries in random order, in a cache that is always too small."""
    generator = np.random.default_rng(seed)
    for number in generator.integers(0, 4, 60).tolist():
        result = cached("test", [number], lambda number=number: {"values": np.full(3000, float(number))})
        assert (result["values"] == number).all()
    return True


@pytest.mark.slow
def test_many_processes_share_a_directory(directory, monkeypatch):
    monkeypatch.setenv("JAXSMW_CACHE_LIMIT", str(60_000 / 2**30))
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(3, mp_context=context) as pool:
        assert all(pool.map(_work, range(6)))
    assert all(entry.name.startswith("test-") for entry in directory.iterdir())


@pytest.mark.slow
def test_commands_cache_compiled_programs(tmp_path):
    mesh = tmp_path / "mesh.off"
    write_mesh(mesh, make_mesh(*sphere_mesh(2)))
    command = [sys.executable, "-m", "jaxsmw", "match", str(mesh), str(mesh), *SMALL]
    command += ["--init", "wks", "--backend", "jax", "--output", str(tmp_path / "map.txt")]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX")}

    def compiled(place: str) -> list[str]:
        settings = {"JAXSMW_CACHE": place, "JAX_LOG_COMPILES": "1"}
        done = subprocess.run(command, env=environment | settings, check=True, capture_output=True, text=True)
        return [line for line in done.stderr.splitlines() if "Persistent compilation cache hit" in line]

    cache = tmp_path / "cache"
    assert compiled("off") == [] and not cache.exists()
    assert compiled(str(cache)) == []
    (programs,) = cache.glob("programs-*")
    assert list(programs.glob("*-cache"))
    assert compiled(str(cache))


@pytest.fixture
def filled(directory):
    """A cache with two entries, a temporary file, a compiled program and files of the user."""
    cached("test", [1], Computation())
    cached("test", [2], Computation())
    cached("crease-eigenvectors", [2], Computation({"values": np.zeros(5000)}))
    (directory / f".{'a' * 32}.npz").write_bytes(b"x" * 10)
    programs = directory / f"programs-{'0' * 16}"
    programs.mkdir()
    for name in ("jit_f-0-cache", "jit_f-0-atime", ".lockfile"):
        (programs / name).write_bytes(b"x" * 100)
    (directory / "notes.npz").write_bytes(b"mine")
    (directory / f"test-{'b' * 64}.npz").symlink_to(directory / "notes.npz")
    return directory


def test_the_cache_lists_its_contents_by_size(filled):
    found = {kind: len(sizes) for kind, sizes in cache_contents().items()}
    assert next(iter(found)) == "crease-eigenvectors"
    assert found == {"crease-eigenvectors": 1, "test": 2, "compiled programs": 2, "temporary files": 1}
    sizes = {kind: sum(each) for kind, each in cache_contents().items()}
    assert sizes["compiled programs"] == 200 and sizes["temporary files"] == 10


def test_clearing_the_cache_keeps_other_files(filled):
    clear_cache()
    assert cache_contents() == {}
    left = {path.relative_to(filled).as_posix() for path in filled.rglob("*") if not path.is_dir()}
    assert left == {"notes.npz", f"test-{'b' * 64}.npz", f"programs-{'0' * 16}/.lockfile"}
    assert (filled / "notes.npz").read_bytes() == b"mine"
    compute = Computation()
    assert_same(cached("test", [1], compute))
    assert compute.runs == 1


@pytest.mark.parametrize("setting", ["", "off"])
def test_a_disabled_or_missing_cache_is_empty(setting, monkeypatch, tmp_path):
    for place in (setting, str(tmp_path / "missing")):
        monkeypatch.setenv("JAXSMW_CACHE", place)
        assert cache_contents() == {}
        clear_cache()
    assert not (tmp_path / "missing").exists()


def test_a_cache_that_is_no_directory_is_refused(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("x")
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path / "file"))
    for function in (cache_contents, clear_cache):
        with pytest.raises(InputError, match="cannot be read"):
            function()


def test_the_command_shows_and_clears_the_cache(filled, capsys):
    assert run_command(["cache"]) == 0
    shown = capsys.readouterr().out
    assert str(filled) in shown and "4 GiB" in shown
    for line in ("test:                2 files, 0.0 MiB", "total:               6 files, 0.0 MiB"):
        assert line in shown.splitlines()
    assert run_command(["cache", "--clear"]) == 0
    assert "is cleared: 6 files" in capsys.readouterr().out
    assert cache_contents() == {}


def test_the_command_says_that_the_cache_is_disabled(monkeypatch, capsys):
    monkeypatch.setenv("JAXSMW_CACHE", "off")
    assert run_command(["cache"]) == 0
    assert "disabled" in capsys.readouterr().out


def test_the_users_compilation_cache_is_respected(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    before = dict(os.environ)
    cache_compiled_programs()
    assert dict(os.environ) == before


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_programs_are_not_stored_in_a_directory_whose_name_is_not_utf8(monkeypatch, tmp_path):
    """JAX accepts only names in UTF-8."""
    for name in [name for name in os.environ if name.startswith("JAX_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path / "caf\udce9"))
    cache_compiled_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
