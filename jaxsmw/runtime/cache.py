"""Results on disk that are expensive to compute and depend on nothing but numbers: spectra, geodesic graphs.

An entry is found by a hash of everything it depends on, so it never goes stale; it is written in one step, so
any number of processes share the directory without locks; and nothing in it is believed that its checksums
do not confirm. Losing the directory costs time and nothing else.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

import numpy as np
import platformdirs

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write

# Part of every key: count it up when what is stored under the same inputs changes.
_FORMAT = 4

# The entries, and what a killed process may have left of one.
_OWN_FILES = re.compile(r"([a-z-]+-[0-9a-f]{64}|\.[0-9a-f]{32})\.npz")


def cached(
    kind: str,
    inputs: Sequence[np.ndarray | str | int | float],
    compute: Callable[[], dict[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """What `compute` returns, from the disk if it was computed before.

    `JAXSMW_CACHE` names the directory, by default the user's cache directory; empty or `off` means none.
    `JAXSMW_CACHE_LIMIT` is its size in GiB, by default 4: what was used least recently is removed first. A
    damaged entry is computed again. Where nothing can be written, a warning says so and work goes on.

    **Arguments:**

    - `kind`: what is computed, in lower-case words joined by hyphens; begins the entry's name.
    - `inputs`: all that the result depends on.
    - `compute`: computes the arrays, by name.

    **Returns:** The arrays, bit for bit as computed.

    **Raises:** `InputError` if `JAXSMW_CACHE_LIMIT` is not a number, or below 0.
    """
    place, limit = _place(), _limit()
    if place is None:
        return compute()
    key = _key(kind, inputs)
    path = place / f"{kind}-{key}.npz"
    arrays = None if _recomputing.get() else _load(path, key)
    if arrays is None:
        arrays = compute()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as temporary:
                contents = np.array([key, *arrays])
                np.savez(temporary, contents=contents, **arrays)  # type: ignore[arg-type]
            _remove_oldest(path.parent, limit)
        except (OSError, InputError):
            # Text and place are the same for every entry, so that Python shows it once.
            warnings.warn(
                f"results cannot be kept in {place} and will be computed again next time: make room there, "
                "or name another directory in JAXSMW_CACHE ('off' for none).",
                RuntimeWarning,
                stacklevel=1,
            )
    return arrays


_recomputing: ContextVar[bool] = ContextVar("recomputing", default=False)


@contextmanager
def recomputing() -> Iterator[None]:
    """Compute everything in the block anew, as if nothing had been kept, but keep it: to measure the time."""
    token = _recomputing.set(True)
    try:
        yield
    finally:
        _recomputing.reset(token)


def keep_programs() -> None:
    """Let JAX, not imported yet, keep what it compiles beside our results, for the next process.

    By settings of its own in the environment, unless some are there already; at most 0.25 GiB. What is
    compiled for one kind of processor must not run on another, which JAX does not tell apart, and a cache may
    be on a shared disk.
    """
    place = _place()
    if place is None:
        return
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
        return  # `cached` says so
    if not os.access(directory, os.W_OK):
        return  # JAX would warn of every program
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(directory),
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(int(min(2**28, _limit()))),
        # Many small programs take as long to compile as one large one.
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    if settings.keys().isdisjoint(os.environ):
        os.environ.update(settings)


def _place() -> Path | None:
    """The directory, if there is to be one."""
    place = os.environ.get("JAXSMW_CACHE", platformdirs.user_cache_dir("jaxsmw", appauthor=False))
    return None if place in ("", "off") else Path(place)


def _limit() -> float:
    """The size limit in bytes."""
    text = os.environ.get("JAXSMW_CACHE_LIMIT", "4")
    try:
        limit = float(text)
    except ValueError:
        limit = -1.0
    if not 0 <= limit < np.inf:
        raise InputError(f"JAXSMW_CACHE_LIMIT is {text!r}: give the size of the cache in GiB as a number.")
    return limit * 2**30


def _key(kind: str, inputs: Sequence[np.ndarray | str | int | float]) -> str:
    digest = hashlib.sha256()
    for value in (_FORMAT, kind, *inputs):
        array = np.asarray(value)
        # The header tells how many bytes follow, so that no two lists of inputs read the same.
        digest.update(f"{type(value).__name__} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _load(path: Path, key: str) -> dict[str, np.ndarray] | None:
    """The arrays of an entry, or None if it is missing, damaged or not what its name says."""
    # Whatever goes wrong while reading bytes of unknown origin, there is one remedy: compute.
    with suppress(Exception), path.open("rb") as file, np.load(file, allow_pickle=False) as entry:
        arrays = {name: entry[name] for name in entry.files}
        # Zip files have checksums for their members, but none for the list of them.
        if arrays.pop("contents").tolist() == [key, *arrays]:
            with suppress(OSError):
                os.utime(path)  # used now: `_remove_oldest` goes by this
            return arrays
    return None


def _remove_oldest(directory: Path, limit: float) -> None:
    """Bring our files in the directory below the limit."""
    files = []
    for entry in os.scandir(directory):
        with suppress(FileNotFoundError):  # another process removes, too
            if _OWN_FILES.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                files.append((entry.stat().st_mtime, entry.stat().st_size, entry.path))
    excess = sum(size for _, size, _ in files) - limit
    for _, size, path in sorted(files):
        if excess <= 0:
            break
        with suppress(FileNotFoundError):
            os.unlink(path)
        excess -= size
