"""Variables of MATLAB's `.mat` files.

MATLAB code for functional maps uses these names: `T12` is the pointwise map from shape 1 to shape 2, counted
from 1. `C21` is the functional map that takes functions on shape 2 to functions on shape 1. A shape is a
struct with the fields `surface` (`X`, `Y`, `Z`, `TRIV`), `evals`, `evecs` and the areas `A`. Our X is shape
1 and our Y is shape 2, so `T12` is T and `C21` is C.
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
    """Whether a name has the suffix `.mat`."""
    return Path(path).suffix.lower() == ".mat"


def parse_variables(data: bytes) -> dict[str, Any]:
    """The variables of a `.mat` file. Structs become dictionaries, and axes of length 1 are dropped.

    **Arguments:**

    - `data`: the contents of the file.

    **Returns:** The variables by name.

    **Raises:** `InputError`, without the name of the file, if the contents are damaged, too large for the
    memory (`jaxsmw.io.mat_format`), or in format 7.3.
    """
    try:
        variables = scipy.io.loadmat(io.BytesIO(unpacked(data)), simplify_cells=True)
    except InputError:
        raise
    except Exception:  # damaged files can raise any exception in SciPy
        raise InputError(
            "is damaged or not a .mat file: save it again, with save(..., '-v7') in MATLAB or "
            "scipy.io.savemat in Python."
        ) from None
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def read_variables(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file with `parse_variables`.

    **Raises:** `InputError` that names the file.
    """
    data = read_bytes(path, largest=None)
    try:
        return parse_variables(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def find_structs(variables: Mapping[str, Any], *fields: str) -> dict[str, Mapping[str, Any]]:
    """Find all structs that have certain fields.

    **Arguments:**

    - `variables`: the variables of a file. The file itself counts as a struct with an empty name.
    - `fields`: the names of the fields.

    **Returns:** The structs, nested ones included, by name, such as `S.surface`.
    """
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
    """Read a matrix of real numbers.

    A single matrix in a file may have any name. A single row is read as a column, because lists in MATLAB may
    be either.

    **Arguments:**

    - `path`: the file.
    - `name`: the name of the matrix, if the file holds more than one.
    - `columns`: the number of columns; matrices with another number are ignored. 1 stands for a list.

    **Returns:** The matrix as float64 (rows, columns).

    **Raises:** `InputError` that names the file and lists its variables if there is no such matrix.
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
            f"{path}: holds more than one {what}, {', '.join(matrices)}: save the right one as {name}."
        )
    else:
        held = f"holds {', '.join(map(ascii, variables))}" if variables else "is empty"
        raise InputError(f"{path}: {held}, but no {what}: save one as {name}.")
    matrix = chosen.astype(np.float64)
    return matrix[:, None] if matrix.ndim == 1 else matrix


def is_real(value: Any) -> bool:
    """Whether a variable is a list or a matrix of real numbers."""
    return (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "iuf"
        and value.ndim in (1, 2)
        and value.size > 0
    )


def write_variables(path: str | os.PathLike[str], variables: Mapping[str, Any]) -> None:
    """Write variables for MATLAB, lists as columns. The file appears whole or not at all.

    **Raises:** `InputError` if a variable is too large for the format, or the file cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        try:
            scipy.io.savemat(file, dict(variables), do_compression=True, oned_as="column")
        except MatWriteError:
            raise InputError(
                f"{path}: a variable is larger than a .mat file can hold (4 GiB): write fewer eigenvectors."
            ) from None
