"""Reads ground truth from common file formats, and writes ground truth.

`jaxsmw.io.maps` parses the files. By default, the format of a file determines whether its vertices are
counted from 0 or from 1.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from jaxsmw.choices import IndexBase
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.io.formats.mat import is_mat_file, read_variables
from jaxsmw.io.maps import Table
from jaxsmw.runtime.files import atomic_write

# The barycentric weights in a file are rounded. A weight may be slightly negative, and the sum of three
# weights may differ slightly from 1. This number limits both deviations.
_WEIGHT_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The ground truth of a pair: the true points on Y of some or all vertices of X.

    **Attributes:**

    - `source_vertices`: 0-based vertices of X (p,), as int64. A vertex may occur several times or not at all.
    - `targets`: the true point on Y of each source vertex, as 0-based vertices of Y (p,) or as
      `SurfacePoints` on Y with p entries.

    **Raises:** `InputError` if the number of source vertices differs from the number of targets.
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
        """Return the ground truth in which entry i of `targets` (m,) is the true point of vertex i of X."""
        return cls(np.arange(len(targets)), targets)

    def vertex_pairs(self, mesh_y: Mesh) -> Int64[np.ndarray, "p 2"]:
        """Return the vertices of X and their true vertices of Y (p, 2), 0-based.

        A true point on a face of Y is replaced by the nearest corner of the face.
        """
        targets = self.targets
        if isinstance(targets, SurfacePoints):
            targets = targets.nearest_corners(mesh_y)
        return np.stack([self.source_vertices, targets], axis=1)

    def everywhere(self, mesh_x: Mesh) -> Int64[np.ndarray, " m"]:
        """Extend the ground truth to all vertices of X. Return a map X -> Y (m,), as 0-based vertices of Y.

        A vertex without ground truth receives the target of the nearest vertex (Euclidean) that has one.

        **Raises:** `InputError` if the targets are `SurfacePoints` and not vertices.
        """
        if not isinstance(self.targets, np.ndarray):
            raise InputError("ground truth: the targets are points on triangles: give vertices as targets.")
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

    The number of files, their suffix and their number of columns determine the format:

    - Two `.vts` files, of the source and of the target: each line contains one vertex, counted from 1. The
      vertices in line i of the two files correspond to each other.
    - Three `.vts` files: line i of the third file contains the line of the second file, counted from 1, that
      corresponds to line i of the first file.
    - Two `.mat` files with `points` (l,), the names of l landmarks as integers: landmarks of the same name
      correspond. `verts` (l,) contains their vertices. `baryc` (l, 4) contains their faces and barycentric
      weights, which take precedence on the target. All are counted from 1 (SHREC'20; Dyke et al. 2020).
    - Two files with other suffixes: the lines have the same meaning. Vertices are counted from 1 in `.mat`
      files, and from 0 in all other files.
    - One `.baryc_gt` or `.baryc_gt_sym` file: line i contains the true point of the i-th vertex of the
      source, as a face of the target, counted from 1, and three barycentric weights.
    - One file with two columns: each line contains a vertex of the source and its target vertex, both counted
      from 1.
    - One file with one column: line i contains the target vertex of the i-th vertex of the source, counted
      from 0 (from 1 in `.mat` files). `write_pointwise_map` writes this format.
    - One `.vts` or `.map` file of two partial shapes: as the previous format, with -1 for a vertex without a
      counterpart, which is left out. A `.map` file may contain n further lines, which `read_true_overlap`
      reads. A `.vts` file without -1 could describe one shape, so it is accepted only if `index_base` is
      given.

    **Arguments:**

    - `paths`: the path of one file, or a sequence of one to three paths.
    - `mesh_x`, `mesh_y`: the source X and the target Y, each a `Mesh`.
    - `index_base`: the index of the first vertex and of the first face in the files, 0 or 1; None (the
      default) for that of the format, as listed above.

    **Returns:** A `GroundTruth`. Vertices of X that no face references are left out, and a `UserWarning`
    states their number.

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
            f"{files[0]}: lists only vertices that no face of {mesh_x.name} references: give the ground "
            "truth of this mesh."
        )
    warnings.warn(
        f"{files[0]}: {(~used).sum()} of {len(used)} points are vertices that no face of {mesh_x.name} "
        "references; these points are left out",
        stacklevel=2,
    )
    return GroundTruth(truth.source_vertices[used], truth.targets[used])


def _read_all(files: list[Path], mesh_x: Mesh, mesh_y: Mesh, index_base: IndexBase | None) -> GroundTruth:
    if len(files) not in (1, 2, 3):
        raise InputError(f"ground truth: {len(files)} files were given: give one to three files.")

    if len(files) > 1:
        read = _read_named_points if _have_named_points(files) else _read_lines
        return read(files, mesh_x, mesh_y, index_base)

    (file,) = files
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
            f"{file}, line 1: has {table.columns} numbers: give a file with one per line (the target vertex) "
            "or two per line (the source and the target vertex), or a .baryc_gt file with four per line (a "
            "face and three weights)."
        )
    base = table.index_base(index_base)
    if file.suffix == ".vts" and index_base is None and (table.values != -1).all():
        raise InputError(f"{file}: describes only one shape: give the .vts files of both source and target.")
    if file.suffix not in (".vts", ".map"):
        table.require_rows(mesh_x)
        return GroundTruth.of_all_vertices(table.vertices(0, mesh_y, base))
    _target_mask(table, mesh_x, mesh_y)
    targets = table.counterparts(mesh_x, mesh_y, base)
    sources = np.flatnonzero(targets >= 0)
    if len(sources) == 0:
        raise InputError(
            f"{file}: is -1 on every line, so {mesh_x.name} and {mesh_y.name} do not overlap: remove this "
            "pair, or give another file."
        )
    return GroundTruth(sources, targets[sources])


def read_true_overlap(
    path: str | os.PathLike[str],
    mesh_x: Mesh,
    mesh_y: Mesh,
    *,
    reverse: str | os.PathLike[str] | None = None,
    index_base: IndexBase = 0,
) -> tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]]:
    """Read which vertices of two partial shapes have a counterpart on the other shape.

    A vertex of X has a counterpart if its line in the file contains a vertex. The vertices of Y on these
    lines have gaps between them, above all where Y is finer than X. So the mask of Y comes from the first of
    these sources that exists:

    - in a `.map` file, n further lines: 1 for a vertex of Y with a counterpart, and 0 for any other vertex;
    - the lines of the file from Y to X;
    - the vertices of Y in the file, after a closing: all their neighbours are added, and then all vertices
      with a neighbour outside are removed. In 16 pairs of PARTIALSMAL with both files, the intersection over
      union of this mask and the mask of the reverse file is 0.89 to 1.00, and 0.59 to 0.83 without closing.

    **Arguments:**

    - `path`, `index_base`: the file from X to Y, a `.vts` or `.map` file; see `read_ground_truth`.
    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y (n vertices), each a `Mesh`.
    - `reverse`: the file from Y to X, or None if there is none.

    **Returns:** A mask of the vertices of X (m,) and a mask of the vertices of Y (n,), True for vertices with
    a counterpart.

    **Raises:** `InputError` if a file cannot be read or does not fit the meshes.
    """
    table = Table(Path(path), columns=1)
    mask_y = _target_mask(table, mesh_x, mesh_y)
    targets = table.counterparts(mesh_x, mesh_y, index_base)
    mask_x = targets >= 0
    if mask_y is not None:
        return mask_x, mask_y
    if table.path.suffix == ".map":
        m, n = len(mesh_x.vertices), len(mesh_y.vertices)
        raise InputError(
            f"{path}: has {table.rows} lines, but needs {m} for the vertices of {mesh_x.name} and then {n} "
            f"for the vertices of {mesh_y.name}: give the file of this pair."
        )
    if reverse is not None:
        back = Table(Path(reverse), columns=1)
        back.require_rows(mesh_y)
        return mask_x, back.counterparts(mesh_y, mesh_x, index_base) >= 0
    matched = np.zeros(len(mesh_y.vertices), bool)
    matched[targets[mask_x]] = True
    return mask_x, ~_with_neighbours(mesh_y, ~_with_neighbours(mesh_y, matched))


def _target_mask(table: Table, mesh_x: Mesh, mesh_y: Mesh) -> Bool[np.ndarray, " n"] | None:
    """Return the mask of Y in the last n lines of a `.map` file; None if it ends after the m lines of X."""
    m, n = len(mesh_x.vertices), len(mesh_y.vertices)
    if table.path.suffix != ".map" or table.rows != m + n:
        table.require_rows(mesh_x)
        return None
    mask = table.values[m:, 0]
    good = np.isin(mask, (0, 1))
    if not good.all():
        row = m + int(good.argmin())
        raise InputError(
            f"{table.place(row)}: {table.word(row, 0)} is neither 0 nor 1, as the lines of the vertices of "
            f"{mesh_y.name} must be: correct the line, or give the file for this pair."
        )
    return mask == 1


def _with_neighbours(mesh: Mesh, mask: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    grown = mask.copy()
    grown[mesh.edges[mask[mesh.edges].any(axis=1)]] = True
    return grown


def _read_lines(files: list[Path], mesh_x: Mesh, mesh_y: Mesh, index_base: IndexBase | None) -> GroundTruth:
    """Read files for the source and the target, and perhaps a third file with lines of the second file."""
    tables = [Table(file, columns=1) for file in files]
    first, last = tables[0], tables[-1]
    if first.rows != last.rows:
        raise InputError(
            f"{last.path}: has {last.rows} lines and {first.path} has {first.rows}, but line i of both files "
            f"must describe the same point: give {len(files)} files of one data set."
        )
    bases = [t.index_base(index_base, default=1 if t.path.suffix == ".vts" else 0) for t in tables]
    sources, targets = (
        table.vertices(0, mesh, base)
        for table, mesh, base in zip(tables, (mesh_x, mesh_y), bases, strict=False)
    )
    if len(files) == 3:
        targets = targets[last.indices(0, len(targets), f"lines of {files[1]}", bases[2])]
    return GroundTruth(sources, targets)


def _have_named_points(files: list[Path]) -> bool:
    return len(files) == 2 and all(is_mat_file(file) and "points" in read_variables(file) for file in files)


def _read_named_points(
    files: list[Path], mesh_x: Mesh, mesh_y: Mesh, index_base: IndexBase | None
) -> GroundTruth:
    """Read two `.mat` files with named landmarks; landmarks of the same name correspond."""
    names, vertices = (
        [_variable(file, variable, columns=1) for file in files] for variable in ("points", "verts")
    )
    for name, vertex in zip(names, vertices, strict=True):
        if name.rows != vertex.rows:
            raise InputError(
                f"{name.path}: has {name.rows} points but {vertex.rows} verts: give the file of this data "
                "set."
            )
    shared, rows_x, rows_y = np.intersect1d(names[0].values[:, 0], names[1].values[:, 0], return_indices=True)
    if len(shared) == 0:
        raise InputError(f"{files[1]}: has no point in common with {files[0]}: give files of one data set.")
    base = vertices[0].index_base(index_base)
    sources = vertices[0].vertices(0, mesh_x, base)[rows_x]
    if "baryc" not in read_variables(files[1]):
        return GroundTruth(sources, vertices[1].vertices(0, mesh_y, base)[rows_y])
    table = _variable(files[1], "baryc", columns=4)
    if table.rows != names[1].rows:
        raise InputError(
            f"{files[1]}: has {names[1].rows} points but {table.rows} rows of baryc: give the file of this "
            "data set."
        )
    points = SurfacePoints(_faces(table, 0, mesh_y, base), _weights(table, 1))
    return GroundTruth(sources, points[rows_y])


def _variable(file: Path, name: str, *, columns: int) -> Table:
    if name not in read_variables(file):
        raise InputError(f"{file}: contains points, but no {name}: give the file of this data set.")
    return Table(file, columns=columns, variable=name)


def write_ground_truth(path: str | os.PathLike[str], ground_truth: GroundTruth, mesh_y: Mesh) -> None:
    """Write the true points of all vertices of X as a `.baryc_gt` file (see `read_ground_truth`).

    If the targets are vertices, use `jaxsmw.write_pointwise_map` instead.

    **Arguments:**

    - `path`: the file to create or to replace, with the suffix `.baryc_gt`.
    - `ground_truth`: the ground truth of vertices 0, 1, … of X, with `SurfacePoints` as targets.
    - `mesh_y`: the target Y, a `Mesh`. Faces are counted as in its file, with faces that were dropped.

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
    """Return a column of face numbers, which also count dropped faces, as rows of `mesh.faces`."""
    count = len(mesh.faces) + len(mesh.dropped_faces)
    numbers = table.indices(column, count, f"faces of {mesh.name}", base)
    faces = np.searchsorted(mesh.face_numbers, numbers)
    dropped = np.isin(numbers, mesh.dropped_faces)
    if dropped.any():
        row = int(dropped.argmax())
        raise InputError(
            f"{table.place(row)}: face {table.word(row, column)} was dropped from {mesh.name} because it "
            "repeats a vertex or another face: name a face that was kept."
        )
    return faces


def _weights(table: Table, column: int) -> Float64[np.ndarray, "p 3"]:
    """Return three columns of a table as barycentric weights, which are at least 0 and sum to 1."""
    weights = table.values[:, column : column + 3]
    good = (weights >= -_WEIGHT_TOLERANCE).all(axis=1)
    good &= np.abs(weights.sum(axis=1) - 1) <= _WEIGHT_TOLERANCE
    if not good.all():
        row = int(good.argmin())
        written = " ".join(table.word(row, at) for at in range(column, table.columns))
        raise InputError(
            f"{table.place(row)}: {written[:80]} are not barycentric weights, "
            "which must be at least 0 and sum to 1: correct the line."
        )
    weights = np.maximum(weights, 0)
    return weights / weights.sum(axis=1, keepdims=True)
