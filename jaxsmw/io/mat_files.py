"""MATLAB's `.mat` files: variables in and out, and which of them is meant.

What the field's MATLAB code calls things: `T12`, the pointwise map from shape 1 to shape 2, counted from 1;
`C21`, the functional map that takes functions on shape 2 to functions on shape 1; a shape is a struct with
`surface` (`X`, `Y`, `Z`, `TRIV`), `evals`, `evecs` and the areas `A`. Our X is shape 1 and our Y shape 2, so
`T12` is T and `C21` is C.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from jaxtyping import Float64
from scipy.io.matlab import MatWriteError

from jaxsmw.errors import InputError
from jaxsmw.io.mat_format import unpacked
from jaxsmw.runtime.files import atomic_write, read_bytes

POINTWISE_MAP, FUNCTIONAL_MAP = "T12", "C21"


def is_mat_file(path: str | os.PathLike[str]) -> bool:
    """Whether the name says that it is one."""
    return Path(path).suffix.lower() == ".mat"


def parse_variables(data: bytes) -> dict[str, Any]:
    """The variables of a file, structs as dictionaries, axes of length 1 left out.

    **Raises:** `InputError`, without the file's name, if it is none, damaged, or in format 7.3.
    """
    try:
        variables = scipy.io.loadmat(io.BytesIO(unpacked(data)), simplify_cells=True)
    except InputError:
        raise
    except Exception:  # SciPy answers damaged files with whatever goes wrong first
        raise InputError(
            "is damaged or no file of MATLAB's: save it again, with save(..., '-v7') there or "
            "scipy.io.savemat here."
        ) from None
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def read_variables(path: str | os.PathLike[str]) -> dict[str, Any]:
    """`parse_variables` of a file.

    **Raises:** `InputError` that names the file.
    """
    data = read_bytes(path, largest=None)
    try:
        return parse_variables(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def find_structs(variables: Mapping[str, Any], *fields: str) -> dict[str, Mapping[str, Any]]:
    """All structs with some fields, by name: the file itself (`""`), its variables, what is in those."""
    found: dict[str, Mapping[str, Any]] = {}
    pending: list[tuple[str, Mapping[str, Any]]] = [("", variables)]
    while pending:
        name, struct = pending.pop(0)
        if all(field in struct for field in fields):
            found[name] = struct
        pending += [
            (f"{name}.{key}".lstrip("."), value) for key, value in struct.items() if isinstance(value, dict)
        ]
    return found


def read_matrix(
    path: str | os.PathLike[str], name: str, *, columns: int | None = None
) -> Float64[np.ndarray, "rows columns"]:
    """The one matrix of real numbers that a file holds, or of several the one with a given name.

    A row is read as a column, since MATLAB does not care which a list is.

    **Arguments:**

    - `columns`: how many it must have. Others do not count, and one of them is a list.

    **Raises:** `InputError` that names the file and what it holds instead.
    """
    variables = read_variables(path)
    matrices = {key: value for key, value in variables.items() if is_real(value)}
    if columns == 1:
        matrices = {key: value for key, value in matrices.items() if value.ndim == 1}
    elif columns is not None:
        matrices = {key: value for key, value in matrices.items() if value.shape[1:] == (columns,)}
    what = "list of numbers" if columns == 1 else f"matrix of {columns} columns" if columns else "matrix"
    if name in matrices:
        chosen = matrices[name]
    elif len(matrices) == 1:
        (chosen,) = matrices.values()
    elif matrices:
        raise InputError(
            f"{path}: holds more than one {what}, {', '.join(matrices)}: call the one that is meant {name}."
        )
    else:
        held = f"holds {', '.join(map(ascii, variables))}" if variables else "is empty"
        raise InputError(f"{path}: {held}, and no {what}: save the one that is meant as {name}.")
    matrix = chosen.astype(np.float64)
    return matrix[:, None] if matrix.ndim == 1 else matrix


def is_real(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "iuf"
        and value.ndim in (1, 2)
        and value.size > 0
    )


def write_variables(path: str | os.PathLike[str], variables: Mapping[str, Any]) -> None:
    """Write variables as MATLAB reads them: lists as columns, numbers as doubles; never half of it.

    **Raises:** `InputError` if the file cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        try:
            scipy.io.savemat(file, dict(variables), do_compression=True, oned_as="column")
        except MatWriteError:
            raise InputError(
                f"{path}: what should be written is larger than a .mat file can be (4 GiB): write fewer "
                "eigenvectors."
            ) from None
