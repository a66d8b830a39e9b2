"""Errors while reading or writing files are one sentence, and no file is left incomplete."""

import errno
import os
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest
from messages import refused

from jaxsmw.errors import InputError
from jaxsmw.runtime import files
from jaxsmw.runtime.files import (
    atomic_write,
    check_directory,
    check_writable,
    make_directory,
    read_bytes,
    remove_leftovers,
)


def test_a_file_is_written_completely_or_not_at_all(tmp_path):
    path = tmp_path / "result.npz"
    with atomic_write(str(path)) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".npz" and temporary.read_bytes() == b""
        temporary.write_bytes(b"one")
        assert not path.exists()
    assert path.read_bytes() == b"one"

    def fail() -> None:
        with atomic_write(path) as temporary:
            temporary.write_bytes(b"half of")
            raise KeyError("in the middle")

    with pytest.raises(KeyError):
        fail()
    assert path.read_bytes() == b"one" and list(tmp_path.iterdir()) == [path]


def test_system_errors_become_one_sentence(tmp_path):
    def fill() -> None:
        with atomic_write(tmp_path / "a.txt"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with refused("a.txt", "cannot be written", "No space left on device"):
        fill()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["x" * 300, "missing/a.txt", "/dev/null", ".", "/"])
def test_unwritable_paths_are_refused_and_leave_no_files(tmp_path, name):
    with pytest.raises(InputError, match=r"cannot be written"), atomic_write(tmp_path / name) as temporary:
        temporary.write_text("x")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["-", "a/", "missing/"])
def test_names_of_no_file_are_refused(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for write in (check_writable, lambda path: atomic_write(path).__enter__()):
        with pytest.raises(InputError, match=f"^{name}: cannot be written because it"):
            write(name)
    assert list(tmp_path.iterdir()) == []


def test_write_protection_is_respected(tmp_path, monkeypatch):
    path = tmp_path / "kept.txt"
    path.write_text("old")
    monkeypatch.setattr(os, "access", lambda *_: False)  # the superuser can write despite missing permissions
    with pytest.raises(InputError, match="write-protected"), atomic_write(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "old"


def test_new_files_have_the_default_permissions(tmp_path):
    (tmp_path / "plain").touch()
    with atomic_write(tmp_path / "atomic"):
        pass
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_files_that_change_while_they_are_read_are_refused(tmp_path):
    file = tmp_path / "growing.off"
    file.write_bytes(bytes(50_000_000))
    ended = threading.Event()

    def grow() -> None:
        with open(file, "ab", buffering=0) as growing:
            while not ended.is_set():
                growing.write(b"0")

    writer = threading.Thread(target=grow)
    writer.start()
    try:
        with refused("growing.off", "changes while it is read", "wait"):
            for _ in range(100):  # on a busy machine, the writer may wait during the first reads
                read_bytes(file)
    finally:
        ended.set()
        writer.join()
    assert read_bytes(file) == file.read_bytes()


def test_symbolic_links_are_followed(tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "link.txt").symlink_to(tmp_path / "store" / "real.txt")
    with atomic_write(tmp_path / "link.txt") as temporary:
        temporary.write_text("x")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "store" / "real.txt").read_text() == "x"


def test_concurrent_writers_leave_one_complete_file(tmp_path):
    path = tmp_path / "shared.txt"

    def write(letter: str) -> None:
        with atomic_write(path) as temporary:
            temporary.write_text(letter * 100_000)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in "abcdefgh"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.stat().st_size == 100_000 and len(set(path.read_text())) == 1
    assert list(tmp_path.iterdir()) == [path]


def test_leftovers_of_killed_processes_are_removed_and_nothing_else(tmp_path):
    for name in ("map.txt", "noext"):
        with atomic_write(tmp_path / name) as temporary:
            leftover = temporary.name
        (tmp_path / leftover).touch()
    kept = {"map.txt", "noext", ".hidden.txt", ".lock", f".{'0' * 32}.a.b"}
    for name in kept:
        (tmp_path / name).touch()
    remove_leftovers(tmp_path)
    assert set(os.listdir(tmp_path)) == kept
    remove_leftovers(tmp_path / "missing")


def test_files_of_living_processes_are_no_leftovers(tmp_path):
    """Another process is in the middle of a write. Its file stays until the process is killed."""
    program = """
        import sys, time
        from jaxsmw.runtime.files import atomic_write
        with atomic_write(sys.argv[1]) as temporary:
            temporary.write_text("half")
            print("ready", flush=True)
            time.sleep(60)
        """
    call = [sys.executable, "-c", textwrap.dedent(program), str(tmp_path / "map.txt")]
    with subprocess.Popen(call, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        (unfinished,) = os.listdir(tmp_path)
        remove_leftovers(tmp_path)
        assert os.listdir(tmp_path) == [unfinished]
        process.kill()
    # The first write of a process removes leftovers from the directory.
    files._without_leftovers.discard(tmp_path)
    with atomic_write(tmp_path / "other.txt"):
        assert unfinished not in os.listdir(tmp_path)
    assert os.listdir(tmp_path) == ["other.txt"]


def test_without_locks_no_file_is_removed(tmp_path, monkeypatch):
    """Some network file systems refuse locks. Writes work, and files of other processes stay."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    leftover = tmp_path / f".{'0' * 32}.txt"
    leftover.touch()
    files._without_leftovers.discard(tmp_path)
    with atomic_write(tmp_path / "map.txt") as temporary:
        temporary.write_text("whole")
    assert (tmp_path / "map.txt").read_text() == "whole" and leftover.exists()


def test_check_writable_raises_what_atomic_write_would_raise_later(tmp_path):
    check_writable(tmp_path / "new.txt")
    (tmp_path / "old.txt").write_text("x")
    check_writable(tmp_path / "old.txt")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["old.txt"]
    # Nobody can create files in /proc, although its permissions allow it.
    for path in (
        tmp_path,
        tmp_path / "no" / "such.txt",
        *([Path("/proc/x")] if Path("/proc").exists() else []),
    ):
        with pytest.raises(InputError, match="cannot be written"):
            check_writable(path)


LONG = "x" * 300
NAMES = {
    "too long": f"{LONG}.txt",
    "too long, in a new directory": f"new/{LONG}",
    "too long a directory": f"{LONG}/map.txt",
    "with a null character": "a\0b.txt",
    "a loop of links": "loop",
    "through a file": "file/map.txt",
}
CALLS = {
    "atomic_write": lambda path: atomic_write(path).__enter__(),
    "check_writable": check_writable,
    "check_directory": check_directory,
    "make_directory": make_directory,
    "read_bytes": read_bytes,
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_impossible_names_are_refused_in_one_sentence(tmp_path, name, call):
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    path = tmp_path / name
    if call is make_directory and name.startswith("new"):
        path.parent.mkdir()  # otherwise make_directory would create this parent before its error
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as caught:
        call(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message and message.endswith(".")
    assert sorted(tmp_path.rglob("*")) == before


def test_names_with_a_too_long_temporary_name_are_refused(tmp_path):
    """The temporary name repeats the long suffix, so only the temporary name exceeds the limit."""
    path = tmp_path / ("a." + "x" * 250)
    for write in (check_writable, lambda path: atomic_write(path).__enter__()):
        with pytest.raises(InputError, match="File name too long"):
            write(path)


def test_read_bytes_refuses_large_missing_and_special_files(tmp_path):
    (tmp_path / "data").write_bytes(b"\0\1")
    assert read_bytes(tmp_path / "data") == b"\0\1" == read_bytes(str(tmp_path / "data"), largest=2)
    with pytest.raises(InputError, match="data: is larger than 0 GiB"):
        read_bytes(tmp_path / "data", largest=1)
    with pytest.raises(InputError, match="missing: does not exist"):
        read_bytes(tmp_path / "missing")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(InputError, match="is not a regular file"):
            read_bytes(path)


def test_check_directory_creates_nothing_and_refuses_impossible_paths(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "kept").mkdir()
    check_directory(tmp_path / "new" / "one")
    check_directory(tmp_path / "kept")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "kept"]
    with pytest.raises(InputError, match="cannot be created as a directory"):
        check_directory(tmp_path / "file" / "one")
