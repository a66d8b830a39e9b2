"""Pointwise maps and landmarks in files.

A file is text with one row per line, an array in NumPy's `.npy` format, or a matrix in MATLAB's `.mat`
format. Files do not say whether their indices count from 0 or from 1. By default `.mat` files count from 1,
as MATLAB does, and all others from 0; `index_base` overrides the default.
"""

from __future__ import annotations

import io
import os
import re
from pathlib import Path
from tokenize import TokenError

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import IndexBase
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, count_of
from jaxsmw.io.mat_files import POINTWISE_MAP, is_mat_file, read_matrix, write_variables
from jaxsmw.io.text import is_number
from jaxsmw.runtime.files import atomic_write, read_bytes


def read_pointwise_map(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None = None
) -> Int64[np.ndarray, " m"]:
    """Read a pointwise map T: X -> Y.

    **Arguments:**

    - `path`: the file: text with one target vertex per line, or `.npy` or `.mat`. A `.mat` file holds a
      single list of numbers, or a list called `T12` among other variables (X is shape 1, Y is shape 2).
    - `mesh_x`, `mesh_y`: X (m vertices) and Y.
    - `index_base`: the index of the first vertex in the file. The default is 1 for `.mat` files and 0 for all
      others, although many published maps count from 1.

    **Returns:** The target vertex of each source vertex (m,), 0-based.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    table = Table(Path(path), columns=1)
    table.require_rows(mesh_x)
    return table.vertices(0, mesh_y, table.index_base(index_base))


def read_landmarks(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None = None
) -> Int64[np.ndarray, "l 2"]:
    """Read landmarks: pairs of a vertex of X and the corresponding vertex of Y, in two columns.

    **Arguments:** As in `read_pointwise_map`; a `.mat` file holds a single matrix of two columns.

    **Returns:** Pairs of vertices (l, 2), 0-based.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    table = Table(Path(path), columns=2)
    base = table.index_base(index_base)
    return np.stack([table.vertices(0, mesh_x, base), table.vertices(1, mesh_y, base)], axis=1)


def write_pointwise_map(path: str | os.PathLike[str], pointwise_map: ArrayLike) -> None:
    """Write a pointwise map T: X -> Y. The file appears whole or not at all.

    The suffix of the file chooses the format: `.mat` for the column `T12` of 1-based vertices, as MATLAB
    counts; `.npy` for an array of 0-based vertices; any other for text with one 0-based vertex per line.

    **Arguments:**

    - `path`: the file to create or to replace.
    - `pointwise_map`: the target vertex of each source vertex (m,), 0-based.

    **Raises:** `InputError` if the array is not a list of vertices, the suffix belongs to another kind of
    file, or the file cannot be written.
    """
    check_map_name(path)
    targets = np.asarray(pointwise_map)
    if targets.ndim != 1 or targets.dtype.kind not in "iu" or (targets < 0).any():
        raise InputError(
            f"{path}: the array to write is not a pointwise map: give one vertex index, at least 0, for each "
            "source vertex."
        )
    if is_mat_file(path):
        write_variables(path, {POINTWISE_MAP: targets.astype(np.float64) + 1})
        return
    with atomic_write(path) as temporary:
        if _is_npy_file(path):
            np.save(temporary, targets.astype(np.int64))
        else:
            temporary.write_text("".join(f"{target}\n" for target in targets.tolist()), encoding="ascii")


def check_map_name(path: str | os.PathLike[str]) -> None:
    """Refuse a name whose suffix promises something other than a pointwise map.

    **Raises:** `InputError` for the suffixes `.npz`, `.baryc_gt`, `.vts` and `.json`.
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".npz", ".baryc_gt", ".vts", ".json"):
        raise InputError(
            f"{path}: a map is written as text, .npy or .mat, not as {suffix}: choose another name."
        )


def _is_npy_file(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".npy"


class Table:
    """The numbers of a file as a matrix: one row per line of text, or per row of a stored array.

    Maps, landmarks and ground truth are read through this class, so that all refuse the same faults with the
    same sentences. In text, numbers are separated by spaces or tabs. Commas are refused: a decimal comma
    would turn the single number `3,5` into the two vertices 3 and 5.

    **Attributes:**

    - `path`: the file.
    - `values`: the numbers, float64.
    - `rows`, `columns`: the shape of `values`.

    **Raises:** `InputError` if the file cannot be read, or is not a matrix of numbers with the given
    `columns`.
    """

    def __init__(self, path: Path, *, columns: int | None = None) -> None:
        self.path = path
        self._is_text = not is_mat_file(path) and not _is_npy_file(path)
        if self._is_text:
            self._words = self._read_text(columns)
            self.values = np.array(self._words, dtype=np.float64)
        elif is_mat_file(path):
            self.values = read_matrix(path, POINTWISE_MAP, columns=columns)
        else:
            self.values = self._read_array(columns)
        self.rows, self.columns = self.values.shape

    def _read_array(self, columns: int | None) -> Float64[np.ndarray, "rows columns"]:
        """An array of the `.npy` format. Where one column is wanted, a list or a single row will do."""
        data = io.BytesIO(read_bytes(self.path))
        try:
            array = np.lib.format.read_array(data, allow_pickle=False)
        except (ValueError, EOFError, MemoryError, SyntaxError, TokenError) as error:
            raise InputError(
                f"{self.path}: is not an array that NumPy saved: give such an array, or text."
            ) from error
        is_list = array.ndim == 1 or (columns == 1 and array.shape[:-1] == (1,))
        table = array.reshape(-1, 1) if is_list else array
        fits = table.ndim == 2 and columns in (None, table.shape[1]) and table.size
        if not fits or table.dtype.kind not in "iuf":
            wanted = "a list of numbers" if columns == 1 else f"numbers in {columns or 'some'} columns"
            raise InputError(
                f"{self.path}: holds {array.dtype} of shape {array.shape}: give the file with {wanted}."
            )
        return table.astype(np.float64)

    def _read_text(self, columns: int | None) -> list[list[str]]:
        """The words of each line, all of them numbers."""
        path = self.path
        try:
            text = read_bytes(path).decode("utf-8-sig")
        except UnicodeDecodeError:
            text = "\0"
        if "\0" in text:
            raise InputError(f"{path}: is not a text file: give a file of numbers, one row per line.")
        lines = re.split("\r\n|\r|\n", text.rstrip())
        rows = [line.split() for line in lines]
        if not rows[0]:
            fault = "is empty" if len(lines) == 1 else "begins with an empty line"
            raise InputError(f"{path}: {fault}: give a file of numbers, one row per line.")
        columns = columns or len(rows[0])
        for row, words in enumerate(rows):
            for word in words:
                if not is_number(word):
                    mark = re.search("[,;]", word)
                    cure = f"separate numbers by spaces, not by {mark[0]!r}" if mark else "correct the line"
                    raise InputError(f"{self.place(row)}: {word[:40]!a} is not a number: {cure}.")
            if len(words) != columns:
                raise InputError(
                    f"{self.place(row)}: has {count_of(len(words), 'number')} where {columns} should be: "
                    "correct the line, or give the file that belongs here."
                )
        return rows

    def index_base(self, chosen: IndexBase | None, *, default: IndexBase = 0) -> IndexBase:
        """The index of the first vertex or face in the file.

        **Arguments:**

        - `chosen`: the user's choice, or None.
        - `default`: the base of this kind of file, unless MATLAB wrote it: `.mat` files count from 1.
        """
        if chosen is not None:
            return chosen
        return 1 if is_mat_file(self.path) else default

    def place(self, row: int) -> str:
        """The file and the line of a row, as messages name them."""
        return f"{self.path}, {'line' if self._is_text else 'row'} {row + 1}"

    def word(self, row: int, column: int) -> str:
        """A number as the file writes it, for messages."""
        return self._words[row][column][:40] if self._is_text else f"{self.values[row, column]:.15g}"

    def require_rows(self, mesh_x: Mesh) -> None:
        """Check that there is one row for each source vertex.

        **Raises:** `InputError` if not.
        """
        m = len(mesh_x.vertices)
        if self.rows != m:
            raise InputError(
                f"{self.path}: has {self.rows} {'lines' if self._is_text else 'rows'}, but one is "
                f"needed for each of the {m} vertices of {mesh_x.name}: give the file that belongs to this "
                "pair, in this direction."
            )

    def vertices(self, column: int, mesh: Mesh, base: IndexBase) -> Int64[np.ndarray, " p"]:
        """A column as 0-based vertices of a mesh.

        **Raises:** `InputError` for the first row that is not a vertex.
        """
        return self.indices(column, len(mesh.vertices), f"vertices of {mesh.name}", base)

    def indices(self, column: int, count: int, what: str, base: IndexBase) -> Int64[np.ndarray, " p"]:
        """A column as 0-based indices.

        **Arguments:**

        - `column`: the position of the column.
        - `count`: the number of things that the indices count.
        - `what`: the name of these things, in the plural, for messages.
        - `base`: the index of the first thing in the file.

        **Raises:** `InputError` for the first row that is not an index, with the other base as the cure if
        that base fits.
        """
        numbers = self.values[:, column]
        good = (numbers == np.floor(numbers)) & (numbers >= base) & (numbers < count + base)
        if not good.all():
            row = int(good.argmin())
            cure = "correct it, or give the file that belongs to this pair"
            if base == 0 and numbers.min() >= 1 and numbers.max() == count:
                cure = "the file looks 1-based: pass index_base=1 (--index-base 1)"
            elif base == 1 and numbers.min() == 0 and numbers.max() < count:
                cure = "the file looks 0-based: pass index_base=0 (--index-base 0)"
            raise InputError(
                f"{self.place(row)}: {self.word(row, column)} is not one of the {what}, which are "
                f"numbered {base} to {count - 1 + base}: {cure}."
            )
        return numbers.astype(np.int64) - base
