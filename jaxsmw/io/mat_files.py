"""Readers and writers of variables in MATLAB's `.mat` files.

MATLAB code for functional maps uses the following names. `T12` is the pointwise map from shape 1 to shape 2,
with 1-based vertices. `C21` is the functional map that takes functions on shape 2 to functions on shape 1. A
shape is a struct with the fields `surface`, `evals`, `evecs` and `A`. The field `surface` is a struct with
the coordinates `X`, `Y` and `Z` and the faces `TRIV`. The field `A` contains the vertex areas. In this
library, X is shape 1 and Y is shape 2, so `T12` is T and `C21` is C.
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
    """Return whether a file name has the suffix `.mat`, in upper or lower case."""
    return Path(path).suffix.lower() == ".mat"


def parse_variables(data: bytes) -> dict[str, Any]:
    """Parse the contents of a `.mat` file into a dictionary from the names of variables to their values.

    Structs become dictionaries, and axes of length 1 are dropped.

    **Raises:** `InputError` if the contents are damaged, in format 7.3, or too large
    (`jaxsmw.io.mat_format.unpacked` documents the limit). The message does not name the file.
    """
    try:
        variables = scipy.io.loadmat(io.BytesIO(unpacked(data)), simplify_cells=True)
    except InputError:
        raise
    except Exception:  # SciPy can raise any exception for damaged files
        raise InputError(
            "is damaged or not a .mat file: save it again, with save(..., '-v7') in MATLAB or with "
            "scipy.io.savemat in Python."
        ) from None
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def read_variables(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the variables of a `.mat` file of any size; see `parse_variables`.

    **Raises:** `InputError` if the file cannot be read or `parse_variables` refuses its contents. The message
    names the file.
    """
    data = read_bytes(path, largest=None)
    try:
        return parse_variables(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def find_structs(variables: Mapping[str, Any], *fields: str) -> dict[str, Mapping[str, Any]]:
    """Find all structs, including nested structs, that have all of the given fields.

    **Arguments:**

    - `variables`: a dictionary from the names of a file's variables to their values. The dictionary itself is
      treated as a struct with an empty name.
    - `fields`: the names of the required fields.

    **Returns:** A dictionary that maps the full names of the structs, such as `S.surface`, to the structs.
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
    """Read a matrix of real numbers from a `.mat` file.

    If the file contains only one suitable matrix, the matrix may have any name. A matrix with a single row is
    read as a column, because a list in MATLAB may be either a row or a column.

    **Arguments:**

    - `path`: the file.
    - `name`: the name of the matrix to read if the file contains several suitable matrices.
    - `columns`: the number of columns. Matrices with another number of columns are not suitable. If `columns`
      is 1, only a list (a single row or column) is suitable. With `None`, any number of columns is suitable.

    **Returns:** The matrix (rows, columns), float64.

    **Raises:** `InputError` if the file cannot be read or contains no suitable matrix. `InputError` is also
    raised if the file contains several suitable matrices, and none of these has the given name. The message
    names the file and the variables.
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
            f"{path}: contains more than one {what} ({', '.join(matrices)}): save the right one as {name}."
        )
    else:
        found = f"contains {', '.join(map(ascii, variables))}" if variables else "is empty"
        raise InputError(f"{path}: {found}, but no {what}: save the {what} as {name}.")
    matrix = chosen.astype(np.float64)
    return matrix[:, None] if matrix.ndim == 1 else matrix


def is_real(value: Any) -> bool:
    """Return whether a variable is a non-empty list or a non-empty matrix of real numbers."""
    return (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "iuf"
        and value.ndim in (1, 2)
        and value.size > 0
    )


def write_variables(path: str | os.PathLike[str], variables: Mapping[str, Any]) -> None:
    """Write variables to a `.mat` file.

    Lists are written as columns. The write is atomic: an incomplete file never appears at `path`.

    **Arguments:**

    - `path`: the file to create or to replace.
    - `variables`: a dictionary from names to arrays, numbers, or dictionaries (which become structs).

    **Raises:** `InputError` if a variable is too large for the format, or the file cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        try:
            scipy.io.savemat(file, dict(variables), do_compression=True, oned_as="column")
        except MatWriteError:
            raise InputError(
                f"{path}: a variable is larger than 4 GiB, the limit of .mat files: write fewer eigenvectors."
            ) from None
