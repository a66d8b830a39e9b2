"""Reading and atomic writing of files. Every failure is reported in one sentence."""

from __future__ import annotations

import os
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from jaxsmw.errors import InputError

LARGEST_FILE = 2**30
"""The largest file, in bytes, that is read whole: 1 GiB.

Parsing a text file takes up to fifteen times its size in memory. A text file of this size describes a mesh of
ten million vertices.
"""


def largest_contents(size_of_file: int) -> int:
    """Return the largest plausible size of the contents of a compressed file, in bytes.

    1 GiB is always plausible, because a mesh of ten million vertices has this size. Larger contents are
    eigenvectors, which compress little, so four times the size of their file is a generous limit. A malicious
    file can unpack to a thousand times its size.

    **Arguments:**

    - `size_of_file`: the size of the compressed file, in bytes.
    """
    return max(2**30, 4 * size_of_file)


def read_bytes(path: str | os.PathLike[str], *, largest: int | None = LARGEST_FILE) -> bytes:
    """Read a whole file.

    **Arguments:**

    - `path`: a regular file. Pipes and devices are refused, because they may never end.
    - `largest`: the largest size in bytes; None for no limit.

    **Returns:** The contents.

    **Raises:** `InputError` if the file does not exist, is not a regular file, is too large or unreadable.
    """
    size = size_of_file(path)
    if largest is not None and size > largest:
        raise InputError(
            f"{path}: is larger than {largest >> 30} GiB, the limit for reading: decimate the mesh."
        )
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error


def size_of_file(path: str | os.PathLike[str]) -> int:
    """Return the size of a regular file in bytes.

    **Raises:** `InputError` if the file does not exist, is not a regular file, or cannot be accessed.
    """
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: does not exist: check the path.") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise _unreadable(path, error) from error
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: is not a regular file: give the path of a file.")
    return status.st_size


def _unreadable(path: str | os.PathLike[str], error: OSError | ValueError) -> InputError:
    return InputError(f"{path}: cannot be read ({_reason(error)}): check the path and its permissions.")


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a temporary path to write to, and move the file to `path` when the block succeeds.

    After an exception the temporary file is removed, and `path` is unchanged. The temporary file is in the
    directory of `path`, so the move is atomic. The temporary file has the suffix of `path`, because writers
    such as `numpy.savez` and `savefig` depend on the suffix. If `path` is a symbolic link, the target of the
    link is replaced.

    **Arguments:**

    - `path`: the file to create or to replace.

    **Returns:**

    A context manager that yields the temporary `Path`, which exists and is empty.

    **Raises:**

    `InputError` before the block starts, if the directory or the name makes writing impossible. `InputError`
    after an `OSError` inside the block, for example because the disk is full.
    """
    target = _target(path)
    temporary = _temporary(target)
    _unfinished.add(temporary)
    try:
        _check_target(path, target)
        temporary.touch(exist_ok=False)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        # The file is gone after success, and was never there if the directory does not exist.
        if os.path.lexists(temporary):
            temporary.unlink()
        _unfinished.discard(temporary)


# The temporary files of all open blocks.
_unfinished: set[Path] = set()


def remove_unfinished() -> None:
    """Remove the temporary files of all open blocks of `atomic_write`.

    A process calls this function if it ends while a block is open.
    """
    for temporary in _unfinished.copy():
        with suppress(OSError):
            temporary.unlink()


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check, before a long computation, that `atomic_write` can write a file; leave nothing behind.

    **Raises:**

    `InputError` if the directory does not exist, the name is impossible, or permissions forbid writing.
    """
    target = _target(path)
    temporary = _temporary(target)
    try:
        _check_target(path, target)
        # Permissions alone are not conclusive, because some file systems refuse all new files.
        temporary.touch(exist_ok=False)
        temporary.unlink()
    except OSError as error:
        raise _unwritable(path, error) from error


def _target(path: str | os.PathLike[str]) -> Path:
    """Return the file of a path, with symbolic links resolved."""
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:  # a null character in the name
        raise _unwritable(path, error) from error


def _temporary(target: Path) -> Path:
    """Return a new hidden path in the directory of a file, with the same suffix."""
    return target.parent / f".{uuid.uuid4().hex}{target.suffix}"


def _check_target(path: str | os.PathLike[str], target: Path) -> None:
    """Refuse a target that cannot become a regular file.

    **Raises:** `InputError`; `OSError` if the system does not accept the name.
    """
    if not target.parent.is_dir():
        raise InputError(
            f"{path}: cannot be written because {target.parent} is not a directory: "
            "create it first or choose another place."
        )
    try:
        status = os.stat(target)
    except FileNotFoundError:
        return
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: cannot be written because it is not a file: choose another name.")
    if not os.access(target, os.W_OK):
        raise InputError(f"{path}: is write-protected: choose another name or change permissions.")


def _unwritable(path: str | os.PathLike[str], error: OSError | ValueError) -> InputError:
    return InputError(
        f"{path}: cannot be written ({_reason(error)}): choose a valid name in a place with free space where "
        "you may create files."
    )


def _reason(error: OSError | ValueError) -> str:
    """Return the operating system's description of an error."""
    return getattr(error, "strerror", None) or str(error)


def check_directory(path: str | os.PathLike[str]) -> None:
    """Check, before a long computation, that `make_directory` can succeed; leave nothing behind.

    **Raises:**

    `InputError` if the directory cannot be made, or no file can be written to the directory.
    """
    missing = [place for place in (Path(path), *Path(path).parents) if not os.path.lexists(place)]
    try:
        make_directory(path)
    finally:
        for place in missing:
            with suppress(OSError, ValueError):  # never made, or already in use by another process
                place.rmdir()


def make_directory(path: str | os.PathLike[str]) -> Path:
    """Make a directory and its parents, unless they exist.

    **Returns:** The path of the directory.

    **Raises:** `InputError` if the directory cannot be made, or no file can be written to the directory.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise InputError(
            f"{path}: cannot be made a directory ({_reason(error)}): choose another place."
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written to: choose another place or change its permissions.")
    return Path(path)
