"""Readers and writers of pointwise maps, and readers of landmarks.

A file has one of these formats: text with one row per line, NumPy's `.npy` and `.npz`, safetensors, or
MATLAB's `.mat`. Files do not say whether their indices count from 0 or from 1, so the argument `index_base`
overrides the default.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import IndexBase
from jaxsmw.errors import InputError, naming
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.formats.mat import POINTWISE_MAP, is_mat_file, read_matrix, write_variables
from jaxsmw.io.formats.named_arrays import (
    ARRAY_SUFFIXES,
    check_writable,
    is_array_file,
    read_named_array,
    write_named_arrays,
)
from jaxsmw.io.formats.npz import read_array
from jaxsmw.io.formats.text import is_number
from jaxsmw.io.landmark_files import LANDMARK_SUFFIXES
from jaxsmw.io.meshes import MESH_SUFFIXES, POINT_CLOUD_SUFFIXES
from jaxsmw.runtime.files import atomic_write, read_bytes
from jaxsmw.wording import count_of

# The name of a map in a file of named arrays.
_NAME = "pointwise_map"

# Suffixes of other kinds of files. The programs that open such files cannot open a map. The suffixes of
# formats in which maps are also written are not in this set.
_NOT_MAPS = {
    *(".baryc_gt", ".vts", ".json"),
    *(".png", ".jpg", ".jpeg", ".gif", ".bmp", ".tif", ".tiff", ".webp", ".svg", ".pdf", ".eps", ".ps"),
    *(".html", ".htm", ".xhtml"),
    *(*MESH_SUFFIXES, *POINT_CLOUD_SUFFIXES, *LANDMARK_SUFFIXES),
} - {".mat", ".npy", *ARRAY_SUFFIXES}


def read_pointwise_map(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None = None
) -> Int64[np.ndarray, " m"]:
    """Read a pointwise map T: X -> Y.

    **Arguments:**

    - `path`: a `.npy`, `.npz`, `.safetensors` or `.mat` file, or a text file with one target vertex per line.
      If a file contains several arrays, the map is `pointwise_map`, or `T12` in a `.mat` file. The name `T12`
      means that X is shape 1 and Y is shape 2.
    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y, each a `Mesh`.
    - `index_base`: the index of the first vertex in the file, 0 or 1. The default None means 1 for `.mat`
      files and 0 for all other files. Many published maps in text files count from 1.

    **Returns:** The target vertex of each source vertex, as an int64 array (m,), 0-based.

    **Raises:** `InputError` if the file cannot be read, does not have m rows, or contains a number that is
    not a vertex of Y.
    """
    table = Table(Path(path), columns=1)
    table.require_rows(mesh_x)
    return table.vertices(0, mesh_y, table.index_base(index_base))


def read_landmarks(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None = None
) -> Int64[np.ndarray, "l 2"]:
    """Read landmarks: vertices of X and their matches on Y.

    **Arguments:**

    - `path`: a `.npy` file, a `.mat` file, or a text file with a vertex of X and a vertex of Y per line. A
      `.mat` file contains either a single matrix with two columns, or such a matrix `T12` among others.
    - `mesh_x`, `mesh_y`, `index_base`: as for `read_pointwise_map`.

    **Returns:** The l landmarks as an int64 array (l, 2), 0-based.

    **Raises:** `InputError` if the file cannot be read, does not have two columns, or contains a number that
    is not a vertex.
    """
    table = Table(Path(path), columns=2)
    base = table.index_base(index_base)
    return np.stack([table.vertices(0, mesh_x, base), table.vertices(1, mesh_y, base)], axis=1)


def write_pointwise_map(path: str | os.PathLike[str], pointwise_map: ArrayLike) -> None:
    """Write a pointwise map T: X -> Y. An incomplete file never appears under this name.

    **Arguments:**

    - `path`: the file to create or to replace. A `.mat` file contains the column `T12` of 1-based vertices,
      as is usual in MATLAB. A `.npy` file contains an array (m,) of 0-based vertices; a `.npz` or
      `.safetensors` file contains this array as `pointwise_map`. A file with any other suffix is text with
      one 0-based vertex per line.
    - `pointwise_map`: the target vertex of each source vertex, as 0-based integers (m,).

    **Raises:** `InputError` if the array is not a list of non-negative integers, the file cannot be written,
    or the suffix is one of those that `check_map_name` refuses, such as `.ply`.
    """
    check_map_name(path)
    targets = np.asarray(pointwise_map)
    if targets.ndim != 1 or targets.dtype.kind not in "iu" or (targets < 0).any():
        raise InputError(
            f"{path}: the array to write is not a pointwise map: give one non-negative integer vertex index "
            "for each source vertex."
        )
    if is_mat_file(path):
        write_variables(path, {POINTWISE_MAP: targets.astype(np.float64) + 1})
        return
    if is_array_file(path):
        write_named_arrays(path, {_NAME: targets.astype(np.int64)})
        return
    with atomic_write(path) as temporary:
        if _is_npy_file(path):
            np.save(temporary, targets.astype(np.int64))
        else:
            temporary.write_text("".join(f"{target}\n" for target in targets.tolist()), encoding="ascii")


def check_map_name(path: str | os.PathLike[str]) -> None:
    """Refuse the suffix of another kind of file, such as a mesh, or of a format that needs a package."""
    suffix = Path(path).suffix.lower()
    if suffix in _NOT_MAPS:
        raise InputError(
            f"{path}: maps are written as text, .npy, .npz, .safetensors or .mat, not as {suffix}: choose a "
            "name with another suffix, such as .txt."
        )
    check_writable(path)


def _is_npy_file(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".npy"


class Table:
    """The numbers of a file of arrays or a text file as a matrix `values`, float64.

    Each row of the matrix is one line of a text file, or one row of an array in a file. In text files, spaces
    or tabs separate numbers. Commas are refused, because `3,5` could be a number with a decimal comma or the
    two vertices 3 and 5. `columns` is the required number of columns, or None for any number. `variable` is
    the name of the matrix in a `.mat` file with several matrices.
    """

    def __init__(self, path: Path, *, columns: int | None = None, variable: str = POINTWISE_MAP) -> None:
        self.path = path
        self._is_text = not (is_mat_file(path) or _is_npy_file(path) or is_array_file(path))
        if self._is_text:
            self._words = self._read_text(columns)
            self.values = np.array(self._words, dtype=np.float64)
        elif is_mat_file(path):
            self.values = read_matrix(path, variable, columns=columns)
        else:
            self.values = self._read_array(columns)
        self.rows, self.columns = self.values.shape

    def _read_array(self, columns: int | None) -> Float64[np.ndarray, "rows columns"]:
        """Read an array as a matrix. A list becomes one column, and so does a row if `columns` is 1."""
        if is_array_file(self.path):
            array = read_named_array(self.path, _NAME)
        else:
            data = read_bytes(self.path)
            with naming(self.path):
                array = read_array(data)
        is_list = array.ndim == 1 or (columns == 1 and array.shape[:-1] == (1,))
        table = array.reshape(-1, 1) if is_list else array
        fits = table.ndim == 2 and columns in (None, table.shape[1]) and table.size
        if not fits or table.dtype.kind not in "iuf":
            expected = "a list of numbers" if columns == 1 else f"numbers in {columns or 'some'} columns"
            raise InputError(
                f"{self.path}: contains an array of type {array.dtype} and shape {array.shape}: give a file "
                f"with {expected}."
            )
        return table.astype(np.float64)

    def _read_text(self, columns: int | None) -> list[list[str]]:
        """Return the words of each line. All of them are numbers, and each line has as many."""
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
                    cure = (
                        f"separate numbers with spaces, not with {mark[0]!r}" if mark else "correct the line"
                    )
                    raise InputError(f"{self.place(row)}: {word[:40]!a} is not a number: {cure}.")
            if len(words) != columns:
                raise InputError(
                    f"{self.place(row)}: has {count_of(len(words), 'number')} instead of {columns}: "
                    "correct the line, or give another file."
                )
        return rows

    def index_base(self, stated: IndexBase | None, *, default: IndexBase = 0) -> IndexBase:
        """Return the stated index of the first vertex or face, or else the default; 1 for `.mat` files."""
        if stated is not None:
            return stated
        return 1 if is_mat_file(self.path) else default

    def place(self, row: int) -> str:
        """Return the file name and the line number of a row, as text for messages. `row` is 0-based."""
        return f"{self.path}, {'line' if self._is_text else 'row'} {row + 1}"

    def word(self, row: int, column: int) -> str:
        """Return a number as it is written in the file, for messages. Row and column are 0-based."""
        return self._words[row][column][:40] if self._is_text else f"{self.values[row, column]:.15g}"

    def require_rows(self, mesh_x: Mesh) -> None:
        """Refuse a file without exactly one row for each vertex of X."""
        m = len(mesh_x.vertices)
        if self.rows != m:
            raise InputError(
                f"{self.path}: has {self.rows} {'lines' if self._is_text else 'rows'}, but needs one "
                f"for each of the {m} vertices of {mesh_x.name}: give the file for this pair, from source to "
                "target."
            )

    def vertices(self, column: int, mesh: Mesh, base: IndexBase) -> Int64[np.ndarray, " p"]:
        """Return a column as 0-based vertices (p,) of a mesh. The file counts from `base`."""
        return self.indices(column, len(mesh.vertices), f"vertices of {mesh.name}", base)

    def counterparts(self, mesh_x: Mesh, mesh_y: Mesh, base: IndexBase) -> Int64[np.ndarray, " m"]:
        """Return the vertex of Y (m,) on the line of each vertex of X, 0-based, or -1 if the line is -1."""
        m, n = len(mesh_x.vertices), len(mesh_y.vertices)
        return self.indices(0, n, f"vertices of {mesh_y.name}", base, rows=m, gaps=True)

    def indices(
        self,
        column: int,
        count: int,
        what: str,
        base: IndexBase,
        *,
        rows: int | None = None,
        gaps: bool = False,
    ) -> Int64[np.ndarray, " p"]:
        """Return a column as 0-based indices (p,) of `count` elements, which messages call `what`.

        If a number is not a valid index, but all numbers are valid with the other index base, the message
        recommends that index base. With `rows`, only the first rows are read. With `gaps`, -1 stays -1.
        """
        numbers = self.values[:rows, column]
        gap = (numbers == -1) & gaps
        good = gap | (numbers == np.floor(numbers)) & (numbers >= base) & (numbers < count + base)
        if not good.all():
            row = int(good.argmin())
            cure = "correct the number, or give the file for this pair"
            least, most = numbers[~gap].min(), numbers[~gap].max()
            if base == 0 and least >= 1 and most == count:
                cure = "the file looks 1-based: pass index_base=1"
            elif base == 1 and least == 0 and most < count:
                cure = "the file looks 0-based: pass index_base=0"
            raise InputError(
                f"{self.place(row)}: {self.word(row, column)} is not one of the {what}, which are "
                f"numbered {base} to {count - 1 + base}: {cure}."
            )
        return np.where(gap, -1, numbers - base).astype(np.int64)
