"""Ground truth in every form in which it circulates, pointwise maps and landmarks in files.

All are text, one row per line. What their indices count from a file does not say, so each form has the base
with which it circulates.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jaxsmw.errors import InputError
from jaxsmw.files import atomic_write
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh

IndexBase = Literal[0, 1]

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)

# How far weights in a file, printed with few digits, may lie below 0 and their sum from 1.
_WEIGHT_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Which points of Y some vertices of X are, in truth.

    **Attributes:**

    - `source_vertices`: vertices of X (p,), 0-based; each any number of times, or never.
    - `targets`: the same points on Y (p,), as 0-based vertices or as `SurfacePoints`.
    """

    source_vertices: Int64[np.ndarray, " p"]
    targets: Int64[np.ndarray, " p"] | SurfacePoints

    def __post_init__(self) -> None:
        if len(self.source_vertices) != len(self.targets):
            raise InputError(
                f"ground truth: there are {len(self.source_vertices)} source vertices and "
                f"{len(self.targets)} targets: give one target for each."
            )

    @classmethod
    def of_all_vertices(cls, targets: Int64[np.ndarray, " m"] | SurfacePoints) -> GroundTruth:
        """The targets of vertices 0, 1, … of X, in this order."""
        return cls(np.arange(len(targets)), targets)

    def everywhere(self, mesh_x: Mesh) -> Int64[np.ndarray, " m"]:
        """A pointwise map X -> Y: every vertex gets the target of the nearest one that has one.

        **Raises:** `InputError` if the targets are not vertices.
        """
        if not isinstance(self.targets, np.ndarray):
            raise InputError("ground truth: its targets are points on triangles, where vertices are needed.")
        _, nearest = KDTree(mesh_x.vertices[self.source_vertices]).query(mesh_x.vertices)
        return self.targets[nearest]


def read_ground_truth(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    mesh_x: Mesh,
    mesh_y: Mesh,
    *,
    index_base: IndexBase | None = None,
) -> GroundTruth:
    """Read the ground truth of a pair of meshes.

    The suffix and the number of columns tell the form:

    - two `.vts` files, the source's first: one vertex per line, and equal lines are the same point; 1-based.
      Two files with other suffixes are read alike, but 0-based.
    - `.baryc_gt` or `.baryc_gt_sym`: for each source vertex a face of the target and three barycentric
      weights; 1-based.
    - two columns: a source vertex and its target vertex; 1-based.
    - one column: for each source vertex its target vertex; 0-based, as `write_pointwise_map` writes.

    The truth of the mirrored body (`.sym.vts`, `.baryc_gt_sym`) is ground truth like any other.

    **Arguments:**

    - `paths`: one file, or the two of a pair.
    - `mesh_x`, `mesh_y`: source X and target Y.
    - `index_base`: what the files' indices count from, where it is not what the list says.

    **Returns:** A `GroundTruth`.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    if len(files) not in (1, 2):
        raise InputError(f"ground truth: {len(files)} files were given: give one, or the two of a pair.")

    def base(usual: IndexBase) -> IndexBase:
        return usual if index_base is None else index_base

    if len(files) == 2:
        tables = [_Table(file, columns=1) for file in files]
        if len(tables[0].words) != len(tables[1].words):
            raise InputError(
                f"{files[1]}: has {len(tables[1].words)} lines where {files[0]} has {len(tables[0].words)}, "
                "but equal lines should be the same point: give two files of one set."
            )
        return GroundTruth(
            *(
                table.vertices(0, mesh, base(1 if table.path.suffix == ".vts" else 0))
                for table, mesh in zip(tables, (mesh_x, mesh_y), strict=True)
            )
        )

    (file,) = files
    if file.suffix == ".vts":
        raise InputError(f"{file}: is one half of a pair: give the source's .vts file and the target's.")
    if file.suffix in (".baryc_gt", ".baryc_gt_sym"):
        table = _Table(file, columns=4)
        table.require_rows(mesh_x)
        return GroundTruth.of_all_vertices(SurfacePoints(table.faces(0, mesh_y, base(1)), table.weights(1)))
    table = _Table(file)
    if table.columns == 2:
        return GroundTruth(table.vertices(0, mesh_x, base(1)), table.vertices(1, mesh_y, base(1)))
    if table.columns != 1:
        raise InputError(
            f"{file}, line 1: has {table.columns} numbers: give a truth with one per line (target vertex) "
            "or two (source and target vertex), or with the suffix .baryc_gt four (face and weights)."
        )
    table.require_rows(mesh_x)
    return GroundTruth.of_all_vertices(table.vertices(0, mesh_y, base(0)))


def write_ground_truth(path: str | os.PathLike[str], ground_truth: GroundTruth, mesh_y: Mesh) -> None:
    """Write the points that all vertices of X are, as a `.baryc_gt` file (see `read_ground_truth`).

    **Arguments:**

    - `path`: the file to create or to replace; with the suffix `.baryc_gt`, or it will not be read as such.
    - `ground_truth`: of vertices 0, 1, … of X, with `SurfacePoints` as targets. (Where the targets are
      vertices, `write_pointwise_map` writes them.)
    - `mesh_y`: the target Y. Faces get the numbers of its file, which counts those that reading dropped, too.

    **Raises:** `InputError` if the ground truth is another or the file cannot be written.
    """
    points = ground_truth.targets
    in_order = np.array_equal(ground_truth.source_vertices, np.arange(len(points)))
    if not isinstance(points, SurfacePoints) or not in_order:
        raise InputError(f"{path}: a .baryc_gt file needs a point on a face for each source vertex in order.")
    with atomic_write(path) as temporary, temporary.open("w", encoding="ascii") as file:
        for face, weights in zip(
            mesh_y.face_numbers[points.faces].tolist(), points.weights.tolist(), strict=True
        ):
            file.write(f"{face + 1} {' '.join(map(repr, weights))}\n")


def read_pointwise_map(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase = 0
) -> Int64[np.ndarray, " m"]:
    """Read a pointwise map T: X -> Y, one target vertex per line.

    **Arguments:**

    - `path`: the file.
    - `mesh_x`, `mesh_y`: X (m vertices) and Y.
    - `index_base`: what the indices in the file count from; many published maps count from 1.

    **Returns:** The target vertex of each source vertex (m,), 0-based.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    table = _Table(Path(path), columns=1)
    table.require_rows(mesh_x)
    return table.vertices(0, mesh_y, index_base)


def read_landmarks(
    path: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase = 0
) -> Int64[np.ndarray, "l 2"]:
    """Read landmarks, two columns: a vertex of X and the vertex of Y that is the same point.

    **Arguments:** As in `read_pointwise_map`.

    **Returns:** Pairs of vertices (l, 2), 0-based.

    **Raises:** `InputError` that names the file, the line and the fault.
    """
    table = _Table(Path(path), columns=2)
    return np.stack([table.vertices(0, mesh_x, index_base), table.vertices(1, mesh_y, index_base)], axis=1)


def write_pointwise_map(path: str | os.PathLike[str], pointwise_map: ArrayLike) -> None:
    """Write a pointwise map T: X -> Y, one 0-based target vertex per line; never half of it.

    **Arguments:**

    - `path`: the file to create or to replace.
    - `pointwise_map`: the target vertex of each source vertex (m,), 0-based.

    **Raises:** `InputError` if these are not vertices or the file cannot be written.
    """
    targets = np.asarray(pointwise_map)
    if targets.ndim != 1 or targets.dtype.kind not in "iu" or (targets < 0).any():
        raise InputError(
            f"{path}: what should be written is not a pointwise map: one vertex index, at least 0, is needed "
            "for each source vertex."
        )
    with atomic_write(path) as temporary:
        temporary.write_text("".join(f"{target}\n" for target in targets.tolist()), encoding="ascii")


class _Table:
    """The numbers in a text file, as many in each line."""

    def __init__(self, path: Path, *, columns: int | None = None) -> None:
        self.path = path
        try:
            text = path.read_bytes().decode("utf-8-sig")
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read ({error.strerror}): check the path and its permissions."
            ) from error
        except UnicodeDecodeError:
            text = "\0"
        if "\0" in text:
            raise InputError(f"{path}: is not a text file: give a file of numbers, one row per line.")
        lines = re.split("\r\n|\r|\n", text.rstrip())
        self.words = [line.split() for line in lines]
        if not self.words[0]:
            what = "is empty" if len(lines) == 1 else "begins with an empty line"
            raise InputError(f"{path}: {what}: give a file of numbers, one row per line.")
        self.columns = columns or len(self.words[0])
        for row, words in enumerate(self.words):
            for word in words:
                if not _NUMBER.fullmatch(word):
                    raise InputError(f"{self._at(row)}: {word[:40]!a} is not a number: correct the line.")
            if len(words) != self.columns:
                raise InputError(
                    f"{self._at(row)}: has {len(words)} numbers where {self.columns} should be: correct the "
                    "line, or give the file that belongs here."
                )
        self.values = np.array(self.words, dtype=np.float64)

    def _at(self, row: int) -> str:
        return f"{self.path}, line {row + 1}"

    def require_rows(self, mesh_x: Mesh) -> None:
        """One for each source vertex."""
        m = len(mesh_x.vertices)
        if len(self.words) != m:
            raise InputError(
                f"{self.path}: has {len(self.words)} lines, but one is needed for each of the {m} vertices "
                f"of {mesh_x.name}: give the file that belongs to this pair, in this direction."
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
                f"{self._at(row)}: face {self.words[row][column]} was dropped from {mesh.name}, for it "
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
                f"{self._at(row)}: {self.words[row][column][:40]} is not one of the {what}, which are "
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
            raise InputError(
                f"{self._at(row)}: {' '.join(self.words[row][column:])[:80]} are no barycentric weights, "
                "which are at least 0 and sum to 1: correct the line."
            )
        weights = np.maximum(weights, 0)
        return weights / weights.sum(axis=1, keepdims=True)
