"""Writing files so that a reader never meets half of one."""

from __future__ import annotations

import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from jaxsmw.errors import InputError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path to write to; it becomes `path` when the block ends well, and is gone otherwise.

    The temporary file lies in the target's directory (so that the move is one atomic step) and has the
    target's suffix (because writers such as `numpy.savez` and `savefig` look at it). Where `path` is a link,
    the file it points to is replaced.

    **Arguments:**

    - `path`: the file to create or to replace.

    **Returns:**

    A context manager that yields the temporary `Path`, which exists and is empty.

    **Raises:**

    `InputError` when the target cannot be written, be it before the block (no such directory, no permission,
    not a regular file) or by an `OSError` in it (disk full).
    """
    target = Path(os.path.realpath(path))
    temporary = target.parent / f".{uuid.uuid4().hex}{target.suffix}"
    _unfinished.add(temporary)
    try:
        _check_target(path)
        temporary.touch(exist_ok=False)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        # Nothing is left to remove after success, nor where the directory itself was the trouble.
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
    """Tell now what would make `atomic_write` fail later.

    **Raises:**

    `InputError` if there is no such directory, or it or the file in it may not be written to.
    """
    try:
        _check_target(path)
        # A file system may refuse files in spite of the permissions.
        with tempfile.TemporaryFile(dir=Path(os.path.realpath(path)).parent):
            pass
    except OSError as error:
        raise _unwritable(path, error) from error


def _check_target(path: str | os.PathLike[str]) -> None:
    """Refuse what no file can or may be put in place of."""
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputError(
            f"{path}: cannot be written because {target.parent} is not a directory: "
            "create it first or choose another place."
        )
    if target.exists() and not target.is_file():
        raise InputError(f"{path}: cannot be written because it is not a file: choose another name.")
    if target.exists() and not os.access(target, os.W_OK):
        raise InputError(f"{path}: is write-protected: choose another name or change permissions.")


def _unwritable(path: str | os.PathLike[str], error: OSError) -> InputError:
    return InputError(
        f"{path}: cannot be written ({error.strerror or error}): choose a place with free space where you "
        "may create files."
    )


def check_directory(path: str | os.PathLike[str]) -> None:
    """Tell now what would make `make_directory` fail later; nothing is left behind.

    **Raises:**

    `InputError` if it cannot be made or written to.
    """
    # `Path.exists` would raise an error for a name that is too long; `make_directory` refuses such a name.
    missing = [place for place in (Path(path), *Path(path).parents) if not os.path.lexists(place)]
    make_directory(path)
    for place in missing:
        place.rmdir()


def make_directory(path: str | os.PathLike[str]) -> Path:
    """The directory, made if it is not there yet."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be made a directory ({error.strerror}); choose another place."
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written to; choose another place or change its permissions.")
    return Path(path)
