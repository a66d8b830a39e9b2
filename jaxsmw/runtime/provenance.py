"""The provenance of results: the versions of the software, the code and the machine.

All results in a directory are made with the same settings and software versions; see `claimed_directory`.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from jaxsmw.core.arrays import is_array
from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write, can_lock

_PACKAGES = (
    "jaxsmw",
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "equinox",
    "lineax",
    "optimistix",
    "libigl",
    "robust-laplacian",
)
LIBRARY = Path(__file__).parents[1]


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which results depend, by name."""
    return {
        **{package: metadata.version(package) for package in _PACKAGES},
        "python": platform.python_version(),
    }


def machine() -> str:
    """Return the operating system, the processor and the number of cores as one string."""
    processor = platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():  # on Linux `platform` gives only the architecture
        lines = cpuinfo.read_text("utf-8", "replace").splitlines()
        models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        processor = models[0] if models else processor
    return f"{platform.system()}, {processor}, {os.cpu_count()} cores"


def commit() -> str:
    """Return the git commit of the library (`-dirty` if it was changed), or else the installed version."""
    call = ["git", "-C", str(LIBRARY), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=40"]
    try:
        return subprocess.run(call, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return metadata.version("jaxsmw")


def made_with() -> str:
    """Return the commit, the machine and the versions as one line of text."""
    return f"Commit {commit()}, {machine()}, " + ", ".join(f"{k} {v}" for k, v in versions().items()) + "."


def measured_code() -> list[Path]:
    """Return the library's Python files that can change numerical results."""
    left_out = ("report", "cli", "__main__.py")
    return [p for p in sorted(LIBRARY.rglob("*.py")) if p.relative_to(LIBRARY).parts[0] not in left_out]


def code_digest(paths: Iterable[Path]) -> str:
    """Return a hash of the code in Python files, without comments, docstrings and layout (16 digits)."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(f"{path.name}\n{_source_digest(path.read_text('utf-8'))}\n".encode())
    return digest.hexdigest()[:16]


@cache
def _source_digest(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def value_digest(value: object) -> str:
    """Return a hash of a value and of the code in it that does not belong to this library (16 digits).

    The hash covers numbers, texts, arrays, containers and dataclasses, the source code of their classes, and
    functions with their closures and defaults. It does not cover what functions look up elsewhere.
    """
    digest = hashlib.sha256()
    _feed(digest.update, value, set())
    return digest.hexdigest()[:16]


def _feed(update: Callable[[bytes], None], value: Any, seen: set[int]) -> None:
    """Call `update` with bytes that depend on the value. `seen` contains the ids of the values around it."""
    if id(value) in seen:
        return
    seen = seen | {id(value)}
    update(f"\n{type(value).__name__} ".encode())
    function = inspect.unwrap(value) if callable(value) else value
    children: Iterable[Any] = ()
    if is_array(value):
        update(f"{value.dtype}{value.shape}".encode() + np.asarray(value).tobytes())
    elif isinstance(value, tuple | list):
        children = (len(value), *value)
    elif isinstance(value, Mapping):
        children = value.items()
    elif isinstance(value, partial):
        children = value.func, value.args, value.keywords
    elif inspect.isfunction(function):
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        update(_written(function))
        children = [*cells, function.__defaults__, function.__kwdefaults__]
    elif is_dataclass(value) and not isinstance(value, type):
        children = type(value), *((field.name, getattr(value, field.name)) for field in fields(value))
    elif isinstance(value, type):
        update(value.__qualname__.encode())
        if value.__module__.partition(".")[0] != "jaxsmw":  # the code of the library has its own digest
            update(_written(value))
    else:
        update(re.sub(" at 0x[0-9a-f]+", "", repr(value)).encode())
        if callable(value):
            children = type(value), getattr(value, "__self__", None), getattr(value, "__dict__", None)
    for child in children:
        _feed(update, child, seen)


def _written(code: Any) -> bytes:
    """Return the source code of a function or class; the bytecode of a function without source code."""
    try:
        return inspect.getsource(code).encode()
    except (OSError, TypeError):
        compiled = getattr(code, "__code__", None)
        return b"" if compiled is None else compiled.co_code + repr(compiled.co_names).encode()


@contextmanager
def claimed_directory(
    directory: Path,
    provenance: Mapping[str, Mapping[str, Any]],
    noted: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[None]:
    """Lock an existing directory against other processes while a `with` block adds results.

    **Arguments:**

    - `provenance`: groups of named values, such as `"settings"`, that must be the same for all results in the
      directory. The first call writes them to `provenance.json`, and later calls compare them.
    - `noted`: further information that the first call writes to the file.

    **Raises:** `InputError` if the stored provenance differs, is missing beside results or is damaged, if the
    directory cannot be locked, or if another process is adding results.
    """
    from filelock import FileLock, Timeout  # the import is slow

    if not can_lock(directory):
        # Some versions of `filelock` would report a lock of another process instead.
        raise InputError(
            f"{directory}: cannot be locked, because files cannot be created or locked there: give another "
            "output directory, on a file system with locks."
        )
    # The operating system releases the lock even if the process is killed.
    lock = FileLock(directory / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(
            f"{directory}: another process is adding results: wait until this process ends, or give another "
            "output directory."
        ) from None
    except OSError as error:
        raise InputError(
            f"{directory}: cannot be locked ({error.strerror}): give another output directory, or remove the "
            "directory."
        ) from error
    try:
        _check_origin(directory, provenance, noted)
        yield
    finally:
        lock.release()


def _check_origin(
    directory: Path, provenance: Mapping[str, Mapping[str, Any]], noted: Mapping[str, Any]
) -> None:
    path = directory / "provenance.json"
    wanted = json.loads(json.dumps(provenance))
    if path.exists():
        stored = read_provenance(path)
        stored.pop("noted", None)
        for group in {**stored, **wanted}:
            before, now = stored.get(group, {}), wanted.get(group, {})
            for name in {**before, **now}:
                if before.get(name) != now.get(name):
                    raise InputError(
                        f"{directory}: contains results with {name} = {before.get(name)} ({group}), but this "
                        f"run has {name} = {now.get(name)}: give another output directory, or remove "
                        "this one."
                    )
    elif any(directory.glob("*.csv")):
        raise InputError(
            f"{directory}: contains results of unknown origin, because provenance.json is missing: give "
            "another output directory."
        )
    else:
        contents = {**wanted, "noted": dict(noted)} if noted else wanted
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(contents, indent=2) + "\n", "utf-8")


def read_provenance(path: Path) -> dict[str, dict[str, Any]]:
    """Read the groups of a file `provenance.json`; raise `InputError` if the file is damaged."""
    try:
        stored = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        stored = None
    if not isinstance(stored, dict) or not all(isinstance(group, dict) for group in stored.values()):
        raise InputError(
            f"{path}: the file is damaged: give another output directory, or remove its directory."
        )
    return stored
