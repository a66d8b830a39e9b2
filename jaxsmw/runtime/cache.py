"""A cache on disk for expensive results, such as spectra, SHOT descriptors and geodesic graphs.

The name of an entry contains a hash of all values on which the result depends, so an entry never becomes
outdated. Entries are written atomically, so any number of processes can share the directory without locks.
Checksums are verified when an entry is read. The directory can be deleted at any time, because missing
results are computed again. joblib's `Memory` has no checksums: after one flipped bit it returned wrong data.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

import numpy as np
import platformdirs

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write, can_lock

# Every key is a hash that includes this number. Increment this number when a change of the code changes the
# results for the same inputs.
_FORMAT = 4

# This pattern matches the names of entries, and the names of temporary files that a killed process left
# behind.
_OWN_FILES = re.compile(r"(?:([a-z-]+)-[0-9a-f]{64}|\.[0-9a-f]{32})\.npz")
# JAX stores compiled programs in one subdirectory for each type of processor.
_PROGRAMS = re.compile(r"programs-[0-9a-f]{16}")
_PROGRAM_FILES = ("-cache", "-atime")


Inputs = Sequence[np.ndarray | str | int | float]
"""All values on which a result depends, in a fixed order."""
Arrays = dict[str, np.ndarray]


def cached(kind: str, inputs: Inputs, compute: Callable[[], Arrays]) -> Arrays:
    """Return the result of `compute`, or read the result from the disk if it was computed before.

    The environment variable `JAXSMW_CACHE` names the directory; an empty name or `off` disables the cache.
    `JAXSMW_CACHE_LIMIT` limits its size in GiB, by default to 4, by removing the least recently used entries.
    A damaged entry is computed again. If an entry cannot be written, the function warns.

    **Arguments:**

    - `kind`: the first part of the entry's name, in lower-case words joined by hyphens.
    - `inputs`: all values on which the result depends, in a fixed order.
    - `compute`: a function that returns the result as a dictionary from names to arrays.

    **Returns:** The result of `compute`, bit for bit.

    **Raises:** `InputError` if `JAXSMW_CACHE_LIMIT` is not a finite number, or is negative.
    """
    place, limit = cache_directory(), cache_limit()
    if place is None:
        return compute()
    store = Store(place)
    arrays = None if _recomputing.get() else store.load(kind, inputs)
    if arrays is None:
        arrays = compute()
        try:
            place.mkdir(parents=True, exist_ok=True)
            store.save(kind, inputs, arrays)
            _remove_oldest(place, limit)
        except (OSError, InputError):
            # The text and the line number are the same for all entries, so Python shows this warning once.
            warnings.warn(
                f"results cannot be cached in {place} and will be computed again next time: make the "
                "directory writable, free disk space, or set JAXSMW_CACHE to another directory ('off' for no "
                "cache).",
                RuntimeWarning,
                stacklevel=1,
            )
    return arrays


class Store:
    """A store of results in an existing directory; without a directory, the store keeps nothing.

    `cached` documents the arguments. `save` and `get` raise `InputError` if the result cannot be written.
    """

    def __init__(self, directory: Path | None = None):
        self.directory = directory

    def load(self, kind: str, inputs: Inputs) -> Arrays | None:
        """Return a stored result, or None if it is missing or damaged."""
        if self.directory is None:
            return None
        key = _key(kind, inputs)
        path = self.directory / f"{kind}-{key}.npz"
        # Reading a damaged file can raise any exception.
        with suppress(Exception), path.open("rb") as file, np.load(file, allow_pickle=False) as entry:
            arrays = {name: entry[name] for name in entry.files}
            # A zip file has checksums for its members, but not for the list of members.
            if arrays.pop("contents").tolist() == [key, *arrays]:
                with suppress(OSError):
                    os.utime(path)  # `_remove_oldest` reads the time of the last use
                return arrays
        return None

    def save(self, kind: str, inputs: Inputs, arrays: Mapping[str, np.ndarray]) -> None:
        """Store a result."""
        if self.directory is None:
            return
        key = _key(kind, inputs)
        with atomic_write(self.directory / f"{kind}-{key}.npz") as temporary:
            np.savez(temporary, contents=np.array([key, *arrays]), **arrays)  # type: ignore[arg-type]

    def get(self, kind: str, inputs: Inputs, compute: Callable[[], Arrays]) -> Arrays:
        """Return a stored result, or compute and store it."""
        arrays = self.load(kind, inputs)
        if arrays is None:
            arrays = compute()
            self.save(kind, inputs, arrays)
        return arrays


_recomputing: ContextVar[bool] = ContextVar("recomputing", default=False)


@contextmanager
def recomputing() -> Iterator[None]:
    """Make `cached` compute and write all results again within the block, to measure computation times."""
    token = _recomputing.set(True)
    try:
        yield
    finally:
        _recomputing.reset(token)


def cache_compiled_programs() -> None:
    """Make JAX store compiled programs on disk for later processes.

    The programs take at most 0.25 GiB. The function sets environment variables of JAX, so it must run before
    JAX is imported. It changes nothing if the user has set one of these variables.
    """
    place = cache_directory()
    if place is None:
        return
    # Each type of processor has its own directory, because JAX does not distinguish them, and machines with
    # different processors can share the disk.
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
        processor = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        processor = platform.processor()
    kind = hashlib.sha256(f"{platform.machine()} {processor}".encode()).hexdigest()[:16]
    directory = place / f"programs-{kind}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # `cached` will warn
    # JAX would warn about each program that it cannot store, would wait ten seconds for the lock of each
    # program, and accepts only names in UTF-8.
    if not os.access(directory, os.W_OK) or not can_lock(directory) or not _is_utf8(directory):
        return
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(directory),
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(int(min(2**28, cache_limit()))),
        # Small programs are also stored, because many small programs take as long to compile as one large
        # program.
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    if settings.keys().isdisjoint(os.environ):
        os.environ.update(settings)
        # On a full disk, or without the directory, JAX warns once for each program. `cached` warns about the
        # same directory.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")


def _is_utf8(directory: Path) -> bool:
    try:
        str(directory).encode()
    except UnicodeEncodeError:
        return False
    return True


def cache_contents() -> dict[str, list[int]]:
    """Return the sizes of the files of each kind in bytes; kinds with large files come first.

    A kind is that of `cached`, `"compiled programs"`, or `"temporary files"` that a killed process left.
    """
    sizes: dict[str, list[int]] = {}
    for kind, path in _own_files():
        with suppress(FileNotFoundError):  # another process may remove files
            sizes.setdefault(kind, []).append(path.stat().st_size)
    return dict(sorted(sizes.items(), key=lambda item: -sum(item[1])))


def clear_cache() -> None:
    """Remove all entries and all compiled programs. Commands that run at the same time compute them again."""
    for _, path in _own_files():
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(
                f"{path}: the file cannot be removed ({error.strerror}): make its directory writable."
            ) from error


def _own_files() -> Iterator[tuple[str, Path]]:
    """Yield the kind and the path of each file in the cache; other files in the directory are left out."""
    place = cache_directory()
    if place is None:
        return
    try:
        for path in sorted(place.iterdir()):
            if path.is_symlink():
                continue
            if (name := _OWN_FILES.fullmatch(path.name)) and path.is_file():
                yield name[1] or "temporary files", path
            elif _PROGRAMS.fullmatch(path.name) and path.is_dir():
                for program in sorted(path.iterdir()):
                    if program.name.endswith(_PROGRAM_FILES):
                        yield "compiled programs", program
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(
            f"{place}: the cache cannot be read ({error.strerror}): make it readable, or set JAXSMW_CACHE to "
            "another directory."
        ) from error


def cache_directory() -> Path | None:
    """Return the directory of the cache; None if it is disabled or the user has no home directory."""
    if (place := os.environ.get("JAXSMW_CACHE")) is not None:
        return None if place in ("", "off") else Path(place)
    try:
        return Path(platformdirs.user_cache_dir("jaxsmw", appauthor=False))
    except RuntimeError:  # an unknown user without the variable HOME, for example in a container
        return None


def cache_limit() -> float:
    """Return the largest total size of the entries in bytes, without compiled programs."""
    text = os.environ.get("JAXSMW_CACHE_LIMIT", "4")
    try:
        limit = float(text)
    except ValueError:
        limit = -1.0
    if not 0 <= limit < np.inf:
        raise InputError(f"JAXSMW_CACHE_LIMIT is {text!r}: give the size of the cache in GiB as a number.")
    return limit * 2**30


def _key(kind: str, inputs: Inputs) -> str:
    digest = hashlib.sha256()
    for value in (_FORMAT, kind, *inputs):
        array = np.asarray(value)
        # The header contains the size of each array. Without the sizes, different lists of arrays could give
        # the same bytes.
        digest.update(f"{type(value).__name__} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _remove_oldest(directory: Path, limit: float) -> None:
    """Remove the least recently used entries until they take at most `limit` bytes."""
    files = []
    for entry in os.scandir(directory):
        with suppress(FileNotFoundError):  # another process may also remove files
            if _OWN_FILES.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                files.append((entry.stat().st_mtime, entry.stat().st_size, entry.path))
    excess = sum(size for _, size, _ in files) - limit
    for _, size, path in sorted(files):
        if excess <= 0:
            break
        with suppress(FileNotFoundError):
            os.unlink(path)
        excess -= size
