"""Reading and atomic writing of files. Every failure raises an `InputError` with a one-sentence message.

No library serves: filelock locks files of its own, so it cannot tell the temporary files of killed processes
from those of living ones, and python-atomicwrites is no longer maintained.
"""

from __future__ import annotations

import csv
import os
import re
import stat
import sys
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile

from jaxsmw.errors import InputError

if sys.platform != "win32":
    import fcntl

# A text file of this size, in bytes, describes a mesh of ten million vertices. Parsing it needs up to 15 GiB
# of memory.
_LARGEST_FILE = 2**30

FilePath = str | os.PathLike[str]


def largest_contents(size_of_file: int) -> int:
    """Return the largest number of bytes to which a compressed file of a given size may unpack.

    A malicious file can unpack to a thousand times its size. Of all honest contents, only eigenvectors can be
    larger than `_LARGEST_FILE`, and compression hardly makes them smaller.
    """
    return max(_LARGEST_FILE, 4 * size_of_file)


def read_bytes(path: FilePath, *, largest: int | None = _LARGEST_FILE) -> bytes:
    """Read a whole regular file of at most `largest` bytes, which must not change while it is read."""
    before = _status(path)
    if largest is not None and before.st_size > largest:
        raise InputError(
            f"{path}: is larger than {largest >> 30} GiB, the largest size that can be read: decimate the "
            "mesh."
        )
    try:
        with open(path, "rb") as file:
            contents = file.read(before.st_size + 1)
    except OSError as error:
        raise _unreadable(path, error) from error
    after = _status(path)
    if len(contents) != before.st_size or after.st_mtime_ns != before.st_mtime_ns:
        raise InputError(f"{path}: changes while it is read: wait until the file is complete.")
    return contents


def size_of_file(path: FilePath) -> int:
    """Return the size of a regular file in bytes."""
    return _status(path).st_size


def _status(path: FilePath) -> os.stat_result:
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: does not exist: check the path.") from None
    except (OSError, ValueError) as error:  # `ValueError` if the name contains a null character
        raise _unreadable(path, error) from error
    if not stat.S_ISREG(status.st_mode):  # reading pipes and devices may never end
        raise InputError(f"{path}: is not a regular file: give the path of a file.")
    return status


def _unreadable(path: FilePath, error: OSError | ValueError) -> InputError:
    return InputError(f"{path}: cannot be read ({_reason(error)}): check the path and its permissions.")


@contextmanager
def atomic_write(path: FilePath) -> Iterator[Path]:
    """Provide an empty temporary file to write to, and move the file to `path` when the block succeeds.

    If the block raises an exception, `path` is unchanged; an `OSError` becomes an `InputError`. The temporary
    file has the suffix of `path`, because writers such as `numpy.savez` and `savefig` depend on it. If `path`
    is a symbolic link, the target of the link is replaced.
    """
    target = _target(path)
    temporary = _temporary(target)
    _unfinished.add(temporary)
    lock = None
    try:
        _check_target(path, target)
        if target.parent not in _without_leftovers:
            remove_leftovers(target.parent)
            _without_leftovers.add(target.parent)
        lock = _create_locked(temporary)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        # The temporary file does not exist if it was moved to `path`, or if the directory does not exist.
        if os.path.lexists(temporary):
            temporary.unlink()
        # Another process could take the file for a leftover if the lock ended earlier.
        if lock is not None:
            os.close(lock)
        _unfinished.discard(temporary)


# The temporary files of all open blocks of `atomic_write`.
_unfinished: set[Path] = set()
# The directories from which this process has removed leftovers.
_without_leftovers: set[Path] = set()


def write_csv(path: FilePath, rows: Iterable[Iterable[object]]) -> None:
    """Write rows as a CSV file, all of it or nothing. Floats keep all digits."""
    with (
        atomic_write(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file,
    ):
        csv.writer(file, lineterminator="\n").writerows(rows)


def _create_locked(temporary: Path) -> int | None:
    """Create a file that is locked until its descriptor is closed, so that it is not taken for a leftover."""
    if sys.platform == "win32":  # Windows does not move open files
        temporary.touch(exist_ok=False)
        return None
    while True:
        descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        _lock(descriptor, wait=True)
        if os.path.exists(temporary):
            return descriptor
        # Another process removed the file before it was locked.
        os.close(descriptor)


def _lock(descriptor: int, *, wait: bool) -> bool:
    """Lock a file, and return whether this worked. Some systems and file systems have no locks."""
    if sys.platform == "win32":
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def can_lock(directory: Path) -> bool:
    """Return whether files can be created in a directory and locked, as some network file systems cannot."""
    if sys.platform == "win32":  # its file systems have locks
        return True
    with suppress(OSError), TemporaryFile(dir=directory) as file:
        return _lock(file.fileno(), wait=False)
    return False


def remove_unfinished() -> None:
    """Remove the temporary files of open blocks of `atomic_write`, before a signal ends this process."""
    for temporary in _unfinished.copy():
        with suppress(OSError):
            temporary.unlink()


def remove_leftovers(directory: Path) -> None:
    """Remove the temporary files that killed processes left in a directory. Files without locks stay."""
    with suppress(OSError):
        for name in filter(_TEMPORARY.fullmatch, os.listdir(directory)):
            with suppress(OSError), open(directory / name, "r+b") as file:
                if _lock(file.fileno(), wait=False):
                    (directory / name).unlink()


def check_working_directory() -> None:
    """Check that the working directory exists, because relative paths depend on it."""
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            f"the working directory cannot be used ({_reason(error)}): change to another directory."
        ) from error


def check_writable(path: FilePath) -> None:
    """Check that `atomic_write` can write a file. The check leaves no new file."""
    target = _target(path)
    temporary = _temporary(target)
    try:
        _check_target(path, target)
        # A check of the permissions is not sufficient, because some file systems refuse all new files.
        temporary.touch(exist_ok=False)
        temporary.unlink()
    except OSError as error:
        raise _unwritable(path, error) from error


def _target(path: FilePath) -> Path:
    """Return a path with all symbolic links resolved."""
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:  # the name contains a null character
        raise _unwritable(path, error) from error


# The names that `_temporary` returns.
_TEMPORARY = re.compile(r"\.[0-9a-f]{32}(\.[^.]+)?")


def _temporary(target: Path) -> Path:
    """Return a new hidden path in the directory of a file, with the same suffix."""
    return target.parent / f".{uuid.uuid4().hex}{target.suffix}"


def _check_target(path: FilePath, target: Path) -> None:
    """Refuse an output path at which no regular file can be written."""
    if os.fspath(path) == "-":
        raise InputError("-: cannot be written because it is no file name: choose the name of a file.")
    if os.fspath(path).endswith(("/", os.sep)):
        raise InputError(f"{path}: cannot be written because it names a directory: add the name of a file.")
    if not target.parent.is_dir():
        raise InputError(
            f"{path}: cannot be written because {target.parent} "
            f"{'is not a directory' if target.parent.exists() else 'does not exist'}: create the directory "
            "first, or choose another directory."
        )
    try:
        status = os.stat(target)
    except FileNotFoundError:
        return
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: cannot be written because it is not a file: choose another name.")
    if not os.access(target, os.W_OK):
        raise InputError(
            f"{path}: is write-protected: choose another name, or change the permissions of the file."
        )


def _unwritable(path: FilePath, error: OSError | ValueError) -> InputError:
    return InputError(
        f"{path}: cannot be written ({_reason(error)}): choose a valid name, in a directory with free space "
        "where you may create files."
    )


def _reason(error: OSError | ValueError) -> str:
    """Return the operating system's description of an error."""
    return getattr(error, "strerror", None) or str(error)


def check_directory(path: FilePath) -> None:
    """Check that `make_directory` can succeed. The check leaves no new directory."""
    missing = [place for place in (Path(path), *Path(path).parents) if not os.path.lexists(place)]
    try:
        make_directory(path)
    finally:
        for place in missing:
            with suppress(OSError, ValueError):  # the directory may not exist, or may be in use
                place.rmdir()


def make_directory(path: FilePath) -> Path:
    """Create a directory and its parents, unless they exist, and check that files can be written there."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # `ValueError` if the name contains a null character
        raise InputError(
            f"{path}: cannot be created as a directory ({_reason(error)}): choose another path."
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(
            f"{path}: cannot be written to: choose another directory, or change its permissions."
        )
    return Path(path)
