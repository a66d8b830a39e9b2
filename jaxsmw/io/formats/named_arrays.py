"""Files of named arrays: NumPy's `.npz`, and safetensors."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxsmw.errors import InputError, naming
from jaxsmw.io.formats.npz import read_arrays
from jaxsmw.runtime.files import atomic_write, read_bytes

ARRAY_SUFFIXES = (".npz", ".safetensors")
"""The suffixes of files of named arrays."""


def is_array_file(path: str | os.PathLike[str]) -> bool:
    """Return whether the suffix of a file is one of `ARRAY_SUFFIXES`."""
    return Path(path).suffix.lower() in ARRAY_SUFFIXES


def read_named_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Return the arrays of a file by their names. A file of eigenvectors may be larger than a mesh."""
    data = read_bytes(path, largest=None)
    with naming(path):
        return read_arrays(data) if Path(path).suffix.lower() == ".npz" else _read_tensors(data)


def read_named_array(path: str | os.PathLike[str], name: str) -> np.ndarray:
    """Return the array with a name, or the only array of a file, which may have any name."""
    arrays = read_named_arrays(path)
    if name not in arrays and len(arrays) != 1:
        contents = f"contains {', '.join(map(ascii, sorted(arrays)))}"[:200] if arrays else "is empty"
        raise InputError(f"{path}: {contents}, but no {name}: save the array as {name}.")
    return arrays.get(name, next(iter(arrays.values())))


def write_named_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to a new file, in the format of its suffix."""
    check_writable(path)
    with atomic_write(path) as temporary:
        if Path(path).suffix.lower() == ".npz":
            np.savez(temporary, **arrays)  # type: ignore[arg-type]
            return
        from safetensors.numpy import save

        # `save_file` would replace the temporary file, and with it its lock and its permissions.
        temporary.write_bytes(save({name: np.ascontiguousarray(array) for name, array in arrays.items()}))


def check_writable(path: str | os.PathLike[str]) -> None:
    """Refuse a file whose format needs a package that is not installed, before a long computation."""
    if Path(path).suffix.lower() == ".safetensors":
        with naming(path):
            _need_safetensors()


def _read_tensors(data: bytes) -> dict[str, np.ndarray]:
    _need_safetensors()
    from safetensors.numpy import load

    try:
        return load(data)
    except Exception:  # the header is JSON, whose faults raise several exceptions; so do types without NumPy
        raise InputError(
            "is damaged, or contains numbers of a type that NumPy lacks, such as bfloat16: write the file "
            "again, for example in float32."
        ) from None


def _need_safetensors() -> None:
    try:
        import safetensors  # noqa: F401
    except ImportError:
        raise InputError(
            "this format needs the package safetensors: run pip install 'jaxsmw[safetensors]', or use a "
            ".npz file."
        ) from None
