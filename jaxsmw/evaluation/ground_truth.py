"""Ground truth in every form in which it circulates, pointwise maps and landmarks in files.

Text, one row per line, or a matrix in MATLAB's `.mat` format, one row each. What their indices count from a
file does not say, so each form has the base with which it circulates; in `.mat` files that is always 1.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh, count_of
from jaxsmw.io.mat_files import POINTWISE_MAP, is_mat_file, read_matrix, write_variables
from jaxsmw.runtime.files import atomic_write

IndexBase = Literal[0, 1]

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)

# How far weights in a file, printed with few digits, may lie below 0 and their sum from 1.
_WEIGHT_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The true points on Y of some vertices of X.

    **Attributes:**

    - `source_vertices`: 0-based vertices of X (p,); a vertex may occur several times, or never.
    - `targets`: the true point of each source vertex (p,), as 0-based vertices of Y or as `SurfacePoints`.
    """

    source_vertices: Int64[np.ndarray, " p"]
    targets: Int64[np.ndarray, " p"] | SurfacePoints

    def __post_init__(self) -> None:
        if len(self.source_vertices) != len(self.targets):
            raise InputError(
                f"ground truth: there are {len(self.source_vertices)} source vertices and "
                f"{len(self.targets)} targets: give one target for each source vertex."
            )

    @classmethod
    def of_all_vertices(cls, targets: Int64[np.ndarray, " m"] | SurfacePoints) -> GroundTruth:
        """Returns the ground truth in which vertices 0, 1, … of X have these targets, in this order."""
        return cls(np.arange(len(targets)), targets)

    def everywhere(self, mesh_x: Mesh) -> Int64[np.ndarray, " m"]:
        """Returns a map X -> Y (m,): each vertex takes the target of the nearest vertex with ground truth.

        **Raises:** `InputError` if the targets are not vertices.
        """
        if not isinstance(self.targets, np.ndarray):
            raise InputError("ground truth: its targets are points on triangles: give vertices as targets.")
        _, nearest = KDTree(mesh_x.vertices[self.source_vertices]).query(mesh_x.vertices)
        return self.targets[nearest]


def read_ground_truth(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    mesh_x: Mesh,
    mesh_y: Mesh,
    *,
    index_base: IndexBase | None = None,
) -> GroundTruth:
    """Reads the ground truth of a pair of meshes.

    The suffix and the number of columns determine the format:

    - two `.vts` files, first the file of the source: one vertex per line; line i of both files is the same
      point; 1-based. Two files with other suffixes have the same format, but are 0-based.
    - `.baryc_gt` or `.baryc_gt_sym`: for each source vertex a face of the target and three barycentric
      weights; 1-based.
    - two columns: a source vertex and its target vertex; 1-based.
    - one column: for each source vertex its target vertex; 0-based, and 1-based in `.mat` files, as written
      by `write_pointwise_map`.

    Files of mirrored ground truth (`.sym.vts`, `.baryc_gt_sym`) are read like all others.

    **Arguments:**

    - `paths`: one file, or the two files of a pair.
    - `mesh_x`, `mesh_y`: source X and target Y.
    - `index_base`: the number of the first vertex and face in the files; by default that of the format.

    **Returns:** A `GroundTruth` without unreferenced vertices of X; a warning gives their number.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    truth = _read_all(files, mesh_x, mesh_y, index_base)
    used = mesh_x.used_vertices[truth.source_vertices]
    if used.all():
        return truth
    if not used.any():
        raise InputError(
            f"{files[0]}: has only vertices that no face of {mesh_x.name} references: give the ground truth "
            "of this mesh."
        )
    warnings.warn(
        f"{files[0]}: {(~used).sum()} of {len(used)} points are vertices that no face of {mesh_x.name} "
        "references; these points are left out",
        stacklevel=2,
    )
    return GroundTruth(truth.source_vertices[used], truth.targets[used])


def _read_all(files: list[Path], mesh_x: Mesh, mesh_y: Mesh, index_base: IndexBase | None) -> GroundTruth:
    if len(files) not in (1, 2):
        raise InputError(f"ground truth: {len(files)} files were given: give one file, or the two of a pair.")

    if len(files) == 2:
        tables = [_Table(file, columns=1) for file in files]
        if tables[0].rows != tables[1].rows:
            raise InputError(
                f"{files[1]}: has {tables[1].rows} lines where {files[0]} has {tables[0].rows}, "
                "but line i of both must be the same point: give two files of one data set."
            )
        return GroundTruth(
            *(
                table.vertices(0, mesh, table.base(index_base, usual=1 if table.path.suffix == ".vts" else 0))
                for table, mesh in zip(tables, (mesh_x, mesh_y), strict=True)
            )
        )

    (file,) = files
    if file.suffix == ".vts":
        raise InputError(f"{file}: is one half of a pair: give the source's .vts file and the target's.")
    if file.suffix in (".baryc_gt", ".baryc_gt_sym"):
        table = _Table(file, columns=4)
        table.require_rows(mesh_x)
        base = table.base(index_base, usual=1)
        return GroundTruth.of_all_vertices(SurfacePoints(table.faces(0, mesh_y, base), table.weights(1)))
    table = _Table(file)
    if table.columns == 2:
        base = table.base(index_base, usual=1)
        return GroundTruth(table.vertices(0, mesh_x, base), table.vertices(1, mesh_y, base))
    if table.columns != 1:
        raise InputError(
            f"{file}, line 1: has {table.columns} numbers: give a file with one per line (target vertex), "
            "with two (source and target vertex), or a .baryc_gt file with four (face and weights)."
        )
    table.require_rows(mesh_x)
    return GroundTruth.of_all_vertices(table.vertices(0, mesh_y, table.base(index_base)))


def write_ground_truth(path: str | os.PathLike[str], ground_truth: GroundTruth, mesh_y: Mesh) -> None:
    """Writes the true points of all vertices of X as a `.baryc_gt` file (see `read_ground_truth`).

    **Arguments:**

    - `path`: the file to create or to replace; `read_ground_truth` needs the suffix `.baryc_gt`.
    - `ground_truth`: the ground truth of vertices 0, 1, … of X, with `SurfacePoints` as targets.
      (`write_pointwise_map` writes targets that are vertices.)
    - `mesh_y`: the target Y. Faces are numbered as in its file, including faces that were dropped on reading.

    **Raises:** `InputError` if the ground truth is of another kind, or if the file cannot be written.
    """
    points = ground_truth.targets
    in_order = np.array_equal(ground_truth.source_vertices, np.arange(len(points)))
    if not isinstance(points, SurfacePoints) or not in_order:
        raise InputError(
            f"{path}: a .baryc_gt file needs a point on a face for each source vertex, in order."
        )
    with atomic_write(path) as temporary, temporary.open("w", encoding="ascii") as file:
        for face, weights in zip(
            mesh_y.face_numbers[points.faces].tolist(), points.weights.tolist(), strict=True
        ):
            file.write(f"{face + 1} {' '.join(map(repr, weights))}\n")


def read_pointwise_map(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None = None
) -> Int64[np.ndarray, " m"]:
    """Read a pointwise map T: X -> Y, one target vertex per line, or from a `.mat` or `.npy` file.

    **Arguments:**

    - `path`: the file. One with the suffix `.mat` holds a single list of numbers, or among others one called
        `T12` (X is 1, Y is 2).
    - `mesh_x`, `mesh_y`: X (m vertices) and Y.
    - `index_base`: what the indices in the file count from. By default 1 in `.mat` files, as MATLAB counts,
        and 0 in all others, though many published maps count from 1.

    **Returns:** The target vertex of each source vertex (m,), 0-based.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    table = _Table(Path(path), columns=1)
    table.require_rows(mesh_x)
    return table.vertices(0, mesh_y, table.base(index_base))


def read_landmarks(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None = None
) -> Int64[np.ndarray, "l 2"]:
    """Read landmarks, two columns: a vertex of X and the vertex of Y that is the same point.

    **Arguments:** As in `read_pointwise_map`; a `.mat` file holds a single matrix of two columns.

    **Returns:** Pairs of vertices (l, 2), 0-based.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    table = _Table(Path(path), columns=2)
    base = table.base(index_base)
    return np.stack([table.vertices(0, mesh_x, base), table.vertices(1, mesh_y, base)], axis=1)


def write_pointwise_map(path: str | os.PathLike[str], pointwise_map: ArrayLike) -> None:
    """Write a pointwise map T: X -> Y; never half of it.

    One 0-based target vertex per line; or, where the name ends in `.mat`, the column `T12` in MATLAB's
    format, which counts from 1 as MATLAB does; or, where it ends in `.npy`, an array for `numpy.load`.

    **Arguments:**

    - `path`: the file to create or to replace.
    - `pointwise_map`: the target vertex of each source vertex (m,), 0-based.

    **Raises:** `InputError` if these are not vertices, the name is that of another kind of file, or it cannot
    be written.
    """
    check_map_name(path)
    targets = np.asarray(pointwise_map)
    if targets.ndim != 1 or targets.dtype.kind not in "iu" or (targets < 0).any():
        raise InputError(
            f"{path}: what should be written is not a pointwise map: one vertex index, at least 0, is needed "
            "for each source vertex."
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
    """**Raises:** `InputError` if the name is that of a file in which others expect something else."""
    suffix = Path(path).suffix.lower()
    if suffix in (".npz", ".baryc_gt", ".vts", ".json"):
        raise InputError(
            f"{path}: a map is written as text, .npy or .mat, not as {suffix}: choose another name."
        )


def _is_npy_file(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".npy"


class _Table:
    """The numbers in a file, as many in each line of text or row of a matrix."""

    def __init__(self, path: Path, *, columns: int | None = None) -> None:
        self.path = path
        self.is_mat, self.is_text = is_mat_file(path), False
        if self.is_mat:
            self.values = read_matrix(path, POINTWISE_MAP, columns=columns)
        elif _is_npy_file(path):
            self.values = self._read_array(columns)
        else:
            self.is_text = True
            self._words = self._read_text(columns)
            self.values = np.array(self._words, dtype=np.float64)
        self.rows, self.columns = self.values.shape

    def _bytes(self) -> bytes:
        try:
            return self.path.read_bytes()
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be read ({error.strerror}): check the path and its permissions."
            ) from error

    def _read_array(self, columns: int | None) -> Float64[np.ndarray, "rows columns"]:
        """An array of NumPy's; of one column a list or a row will do, too."""
        data = io.BytesIO(self._bytes())
        try:
            array = np.lib.format.read_array(data, allow_pickle=False)
        except (ValueError, EOFError, MemoryError, SyntaxError, TokenError) as error:
            raise InputError(f"{self.path}: is no array that NumPy saved: give one, or text.") from error
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
        """The numbers as they are written."""
        path = self.path
        try:
            text = self._bytes().decode("utf-8-sig")
        except UnicodeDecodeError:
            text = "\0"
        if "\0" in text:
            raise InputError(f"{path}: is not a text file: give a file of numbers, one row per line.")
        lines = re.split("\r\n|\r|\n", text.rstrip())
        rows = [line.split() for line in lines]
        if not rows[0]:
            what = "is empty" if len(lines) == 1 else "begins with an empty line"
            raise InputError(f"{path}: {what}: give a file of numbers, one row per line.")
        columns = columns or len(rows[0])
        for row, words in enumerate(rows):
            for word in words:
                if not _NUMBER.fullmatch(word):
                    raise InputError(f"{self._at(row)}: {word[:40]!a} is not a number: correct the line.")
            if len(words) != columns:
                raise InputError(
                    f"{self._at(row)}: has {count_of(len(words), 'number')} where {columns} should be: "
                    "correct the line, or give the file that belongs here."
                )
        return rows

    def base(self, asked: IndexBase | None, *, usual: IndexBase = 0) -> IndexBase:
        """What indices count from: as asked, else as usual for the form, and as in MATLAB in its files."""
        if asked is not None:
            return asked
        return 1 if self.is_mat else usual

    def _at(self, row: int) -> str:
        return f"{self.path}, {'line' if self.is_text else 'row'} {row + 1}"

    def _word(self, row: int, column: int) -> str:
        """A number as it is written."""
        return self._words[row][column][:40] if self.is_text else f"{self.values[row, column]:.15g}"

    def require_rows(self, mesh_x: Mesh) -> None:
        """One for each source vertex."""
        m = len(mesh_x.vertices)
        if self.rows != m:
            raise InputError(
                f"{self.path}: has {self.rows} {'lines' if self.is_text else 'rows'}, but one is needed for "
                f"each of the {m} vertices of {mesh_x.name}: give the file that belongs to this pair, in "
                "this direction."
            )

    def vertices(self, column: int, mesh: Mesh, base: IndexBase) -> Int64[np.ndarray, " p"]:
        """A column as 0-based vertices of a mesh."""
        return self.indices(column, len(mesh.vertices), f"vertices of {mesh.name}", base)

    def faces(self, column: int, mesh: Mesh, base: IndexBase) -> Int64[np.ndarray, " p"]:
        """A column as 0-based faces of a mesh, where the file counts those that cleaning dropped, too."""
        count = len(mesh.faces) + len(mesh.dropped_faces)
        given = self.indices(column, count, f"faces of {mesh.name}", base)
        faces = np.searchsorted(mesh.face_numbers, given)
        dropped = np.isin(given, mesh.dropped_faces)
        if dropped.any():
            row = int(dropped.argmax())
            raise InputError(
                f"{self._at(row)}: face {self._word(row, column)} was dropped from {mesh.name}, for it "
                "repeats a vertex or another face: name a face that was kept."
            )
        return faces

    def indices(self, column: int, count: int, what: str, base: IndexBase) -> Int64[np.ndarray, " p"]:
        """A column as 0-based indices below a count."""
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
                f"{self._at(row)}: {self._word(row, column)} is not one of the {what}, which are "
                f"numbered {base} to {count - 1 + base}: {cure}."
            )
        return numbers.astype(np.int64) - base

    def weights(self, column: int) -> Float64[np.ndarray, "p 3"]:
        """Three columns as barycentric weights."""
        weights = self.values[:, column : column + 3]
        good = (weights >= -_WEIGHT_TOLERANCE).all(axis=1)
        good &= np.abs(weights.sum(axis=1) - 1) <= _WEIGHT_TOLERANCE
        if not good.all():
            row = int(good.argmin())
            written = " ".join(self._word(row, at) for at in range(column, self.columns))
            raise InputError(
                f"{self._at(row)}: {written[:80]} are no barycentric weights, "
                "which are at least 0 and sum to 1: correct the line."
            )
        weights = np.maximum(weights, 0)
        return weights / weights.sum(axis=1, keepdims=True)
