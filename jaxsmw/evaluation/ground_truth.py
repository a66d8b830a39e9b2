"""Ground truth, and its readers for all common file formats.

The files are parsed by `jaxsmw.io.map_files`. Each format has its usual index base.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from jaxsmw.choices import IndexBase
from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.map_files import Table
from jaxsmw.runtime.files import atomic_write

# The amount by which weights in a file may be below 0, and their sum may differ from 1. Files print weights
# with few digits.
_WEIGHT_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The true points on Y of some vertices of X.

    **Attributes:**

    - `source_vertices`: 0-based vertices of X (p,); a vertex may occur several times, or never.
    - `targets`: the true point of each source vertex (p,), as 0-based vertices of Y or as `SurfacePoints`.

    **Raises:** `InputError` if the numbers of source vertices and targets differ.
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
        """Returns the ground truth of all vertices of X. Entry i of `targets` (m,) belongs to vertex i.

        The targets are 0-based vertices of Y or `SurfacePoints` on Y.
        """
        return cls(np.arange(len(targets)), targets)

    def everywhere(self, mesh_x: Mesh) -> Int64[np.ndarray, " m"]:
        """Returns a map X -> Y (m,): each vertex takes the target of the nearest vertex with ground truth.

        The nearest vertex is the nearest in Euclidean distance on `mesh_x`. The map contains 0-based vertices
        of Y.

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

    - Two `.vts` files, the file of the source first: each has one vertex per line, and line i of both files
      is the same point. Vertices are 1-based. Two files with other suffixes have the same format, but are
      0-based.
    - `.baryc_gt` or `.baryc_gt_sym`: line i has a face of the target and three barycentric weights for source
      vertex i. Faces are 1-based.
    - Two columns: a source vertex and its target vertex, 1-based.
    - One column: line i has the target vertex of source vertex i. Vertices are 0-based, or 1-based in `.mat`
      files, as `write_pointwise_map` writes them.

    Files of mirrored ground truth (`.sym.vts`, `.baryc_gt_sym`) are read in the same way.

    **Arguments:**

    - `paths`: one file, or the two files of a pair.
    - `mesh_x`, `mesh_y`: source X and target Y.
    - `index_base`: the number of the first vertex and face in the files; by default the base of the format.

    **Returns:** A `GroundTruth` without unreferenced vertices of X. If vertices are left out, a warning gives
    their number.

    **Raises:** `InputError` if a file cannot be read, has an unknown format or does not fit the meshes. The
    message names the file, the line and the fault.
    """
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    truth = _read_all(files, mesh_x, mesh_y, index_base)
    used = mesh_x.referenced_vertices[truth.source_vertices]
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
        tables = [Table(file, columns=1) for file in files]
        if tables[0].rows != tables[1].rows:
            raise InputError(
                f"{files[1]}: has {tables[1].rows} lines where {files[0]} has {tables[0].rows}, "
                "but line i of both must be the same point: give two files of one data set."
            )
        bases = [t.index_base(index_base, default=1 if t.path.suffix == ".vts" else 0) for t in tables]
        sides = zip(tables, (mesh_x, mesh_y), bases, strict=True)
        return GroundTruth(*(table.vertices(0, mesh, base) for table, mesh, base in sides))

    (file,) = files
    if file.suffix == ".vts":
        raise InputError(f"{file}: is one half of a pair: give the source's .vts file and the target's.")
    if file.suffix in (".baryc_gt", ".baryc_gt_sym"):
        table = Table(file, columns=4)
        table.require_rows(mesh_x)
        base = table.index_base(index_base, default=1)
        return GroundTruth.of_all_vertices(SurfacePoints(_faces(table, 0, mesh_y, base), _weights(table, 1)))
    table = Table(file)
    if table.columns == 2:
        base = table.index_base(index_base, default=1)
        return GroundTruth(table.vertices(0, mesh_x, base), table.vertices(1, mesh_y, base))
    if table.columns != 1:
        raise InputError(
            f"{file}, line 1: has {table.columns} numbers: give a file with one per line (target vertex), "
            "with two (source and target vertex), or a .baryc_gt file with four (face and weights)."
        )
    table.require_rows(mesh_x)
    return GroundTruth.of_all_vertices(table.vertices(0, mesh_y, table.index_base(index_base)))


def write_ground_truth(path: str | os.PathLike[str], ground_truth: GroundTruth, mesh_y: Mesh) -> None:
    """Writes the true points of all vertices of X as a `.baryc_gt` file (see `read_ground_truth`).

    If the targets are vertices, use `jaxsmw.write_pointwise_map` instead.

    **Arguments:**

    - `path`: the file to create or to replace; `read_ground_truth` needs the suffix `.baryc_gt`.
    - `ground_truth`: the ground truth of vertices 0, 1, … of X, with `SurfacePoints` as targets.
    - `mesh_y`: the target Y. Faces are numbered as in its file, including faces that were dropped on reading.

    **Raises:** `InputError` if the targets are not `SurfacePoints`, if the source vertices are not 0, 1, … in
    this order, or if the file cannot be written.
    """
    points = ground_truth.targets
    in_order = np.array_equal(ground_truth.source_vertices, np.arange(len(points)))
    if not isinstance(points, SurfacePoints) or not in_order:
        raise InputError(
            f"{path}: a .baryc_gt file needs a point on a face for each source vertex, in order: give the "
            "ground truth of all source vertices as SurfacePoints."
        )
    with atomic_write(path) as temporary, temporary.open("w", encoding="ascii") as file:
        for face, weights in zip(
            mesh_y.face_numbers[points.faces].tolist(), points.weights.tolist(), strict=True
        ):
            file.write(f"{face + 1} {' '.join(map(repr, weights))}\n")


def _faces(table: Table, column: int, mesh: Mesh, base: IndexBase) -> Int64[np.ndarray, " p"]:
    """Returns a column as 0-based faces of a mesh. The numbers in the file also count dropped faces."""
    count = len(mesh.faces) + len(mesh.dropped_faces)
    given = table.indices(column, count, f"faces of {mesh.name}", base)
    faces = np.searchsorted(mesh.face_numbers, given)
    dropped = np.isin(given, mesh.dropped_faces)
    if dropped.any():
        row = int(dropped.argmax())
        raise InputError(
            f"{table.place(row)}: face {table.word(row, column)} was dropped from {mesh.name} because it "
            "repeats a vertex or another face: name a face that was kept."
        )
    return faces


def _weights(table: Table, column: int) -> Float64[np.ndarray, "p 3"]:
    """Returns three columns as barycentric weights: not negative, with sum 1."""
    weights = table.values[:, column : column + 3]
    good = (weights >= -_WEIGHT_TOLERANCE).all(axis=1)
    good &= np.abs(weights.sum(axis=1) - 1) <= _WEIGHT_TOLERANCE
    if not good.all():
        row = int(good.argmin())
        written = " ".join(table.word(row, at) for at in range(column, table.columns))
        raise InputError(
            f"{table.place(row)}: {written[:80]} are not barycentric weights, "
            "which are at least 0 and sum to 1: correct the line."
        )
    weights = np.maximum(weights, 0)
    return weights / weights.sum(axis=1, keepdims=True)
