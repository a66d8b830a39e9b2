"""The provenance of a result: the versions of the software, the code and the machine."""

from __future__ import annotations

import ast
import hashlib
import os
import platform
import subprocess
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from pathlib import Path

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
_LIBRARY = Path(__file__).parents[1]


def versions() -> dict[str, str]:
    """Return a dictionary from names to versions, for Python and the packages on which results depend."""
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
    """Return the git commit of the library. The suffix `-dirty` marks uncommitted changes.

    If there is no git checkout or git is missing, return the installed version.
    """
    call = ["git", "-C", str(_LIBRARY), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=40"]
    try:
        return subprocess.run(call, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return metadata.version("jaxsmw")


def made_with() -> str:
    """Return the commit, the machine and the versions as one line of text."""
    return f"Commit {commit()}, {machine()}, " + ", ".join(f"{k} {v}" for k, v in versions().items()) + "."


def measured_code() -> list[Path]:
    """Return the library's Python files, except those of the command line and of the report.

    Changes to these files can change numerical results.
    """
    left_out = ("report", "cli", "__main__.py")
    return [p for p in sorted(_LIBRARY.rglob("*.py")) if p.relative_to(_LIBRARY).parts[0] not in left_out]


def code_digest(paths: Iterable[Path]) -> str:
    """Return a hash of the code in Python files, as 16 hexadecimal digits.

    The hash depends on the names and the order of the files, but not on comments, docstrings or layout.
    """
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
