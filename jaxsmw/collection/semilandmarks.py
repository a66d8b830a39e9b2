"""Semilandmarks: points on curves and surfaces, which slide until the specimens differ least."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float64, Int64
from scipy.spatial.distance import cdist

from jaxsmw.choices import Sliding
from jaxsmw.collection.result import Collection
from jaxsmw.collection.shape_models import align
from jaxsmw.errors import InputError, check_choice, check_whole_number, naming
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_distance import SurfaceTree
from jaxsmw.geometry.surface_points import check_indices
from jaxsmw.io.landmarks import Landmarks
from jaxsmw.runtime.files import read_bytes
from jaxsmw.transfer.landmarks import transfer_landmarks

# The rounds end when the points move by less than this multiple of the centroid size, in the mean.
_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Sliders:
    """The points that slide, as 0-based indices into k points.

    **Attributes:**

    - `curves`: one row (c, 3) for each point on a curve: the point before, the point that slides, the point
      after. This is the matrix `curves` of geomorph, which counts from 1.
    - `surfaces`: the points that slide on the surface (s,). This is the vector `surfaces` of geomorph.
    """

    curves: Int64[np.ndarray, "c 3"]
    surfaces: Int64[np.ndarray, " s"]

    def check(self, count: int) -> None:
        """Check that the indices belong to `count` points, and that each point slides at most once.

        **Raises:** `InputError` if they do not, or if no point slides.
        """
        rows = check_indices(self.curves.ravel(), count, "sliders: point").reshape(-1, 3)
        check_indices(self.surfaces, count, "sliders: point")
        for row, (before, point, after) in enumerate(rows.tolist()):
            if len({before, point, after}) < 3:
                raise InputError(f"sliders: row {row} of the curves names a point twice: give three points.")
        sliding = np.concatenate([rows[:, 1], self.surfaces])
        if not len(sliding):
            raise InputError("sliders: no point slides: give points on curves or on surfaces.")
        points, times = np.unique(sliding, return_counts=True)
        if times.max() > 1:
            raise InputError(f"sliders: point {points[times.argmax()]} slides twice: remove one of its rows.")

    def directions(
        self, positions: Float64[np.ndarray, "k 3"], normals: Float64[np.ndarray, "k 3"]
    ) -> tuple[Int64[np.ndarray, " d"], Float64[np.ndarray, "d 3"]]:
        """Return the unit directions in which points may slide: the points (d,) and the directions (d, 3).

        A point on a curve slides along the chord between its neighbours, and a point on a surface in its
        tangent plane.
        """
        before, point, after = self.curves.T
        chords = positions[after] - positions[before]
        lengths = np.linalg.norm(chords, axis=1, keepdims=True)
        chords = np.divide(chords, lengths, out=np.zeros_like(chords), where=lengths > 0)
        # The axis that is least parallel to the normal spans the tangent plane, together with the normal.
        facing = normals[self.surfaces]
        axes = np.eye(3)[np.abs(facing).argmin(axis=1)]
        first = np.cross(facing, axes)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), np.finfo(float).tiny)
        rows = np.concatenate([point, self.surfaces, self.surfaces])
        return rows, np.concatenate([chords, first, np.cross(facing, first)])


@dataclass(frozen=True, eq=False)
class Semilandmarks:
    """The result of `slide_semilandmarks`: k landmarks and semilandmarks on N specimens.

    **Attributes:**

    - `positions`: the positions on the surfaces (N, k, 3), in the coordinates of each mesh.
    - `mean`: the mean of the specimens after Procrustes alignment (k, 3), with their mean size.
    - `energies`: the sum over the specimens of what is minimised, at the start and after each round
      (rounds + 1,): the bending energies, or the squared Procrustes distances. Each specimen has centroid
      size 1 first.
    """

    positions: Float64[np.ndarray, "N k 3"]
    mean: Float64[np.ndarray, "k 3"]
    energies: Float64[np.ndarray, " _"]


def bending_energy_matrix(reference: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k k"]:
    """Return the bending energy matrix B of thin-plate splines in space (k, k), from a reference.

    The spline that takes the reference to points Y has the bending energy trace(Yᵀ B Y), up to a constant
    factor (Bookstein, "Landmark methods for forms without landmarks", MedIA 1997). Its kernel is minus the
    distance. Affine maps have no energy.

    **Raises:** `InputError` if two points of the reference coincide.
    """
    distances = cdist(reference, reference)
    affine = np.hstack([np.ones((len(reference), 1)), reference - reference.mean(axis=0)])
    closest = distances + np.diag(np.full(len(reference), np.inf))
    if closest.min() <= np.finfo(float).eps * distances.max():
        one, other = np.unravel_index(closest.argmin(), closest.shape)
        raise InputError(f"the points {one} and {other} coincide: remove one of them.")
    # On vectors orthogonal to all affine functions, the kernel is positive definite.
    free = scipy.linalg.null_space(affine.T)
    return free @ np.linalg.solve(free.T @ -distances @ free, free.T)


def slide(
    positions: Float64[np.ndarray, "k 3"],
    reference: Float64[np.ndarray, "k 3"],
    rows: Int64[np.ndarray, " d"],
    directions: Float64[np.ndarray, "d 3"],
    energy: Float64[np.ndarray, "k k"],
) -> Float64[np.ndarray, "k 3"]:
    """Move points along directions, such that an energy of their offsets from the reference is minimal.

    The energy of offsets Z is trace(Zᵀ E Z) (Gunz, Mitteroecker, Bookstein, "Semilandmarks in three
    dimensions", 2005). Among several minima, the shortest slide is chosen.

    **Arguments:**

    - `positions`, `reference`: points (k, 3) in common coordinates.
    - `rows`, `directions`: the points that slide (d,), and their directions (d, 3); see `Sliders.directions`.
    - `energy`: a positive semidefinite matrix E (k, k): `bending_energy_matrix(reference)`, or the identity
      for the Procrustes distance.

    **Returns:** The moved points (k, 3).
    """
    products = energy[np.ix_(rows, rows)] * (directions @ directions.T)
    slopes = ((energy @ (positions - reference))[rows] * directions).sum(axis=1)
    lengths = np.linalg.lstsq(products, -slopes, rcond=1e-10)[0]
    moved = positions.copy()
    np.add.at(moved, rows, lengths[:, None] * directions)
    return moved


def slide_semilandmarks(
    meshes: Sequence[Mesh],
    positions: Float64[np.ndarray, "N k 3"],
    sliders: Sliders,
    *,
    sliding: Sliding = "bending",
    rounds: int = 10,
) -> Semilandmarks:
    """Slide semilandmarks on all specimens, until they differ as little as possible from their mean.

    In each round, the specimens are aligned by generalised Procrustes analysis with scaling. The
    semilandmarks of each specimen slide along tangents of curves and in tangent planes of surfaces, such that
    the bending energy from the mean (or the Procrustes distance) is minimal. They are then projected onto the
    surface. The rounds end when the points hardly move.

    **Arguments:**

    - `meshes`: the N specimens, each a `Mesh`, all of one hand.
    - `positions`: corresponding points on the specimens (N, k, 3), such as landmarks that were transferred
      through registered meshes, in the coordinates of each mesh.
    - `sliders`: the `Sliders`. All other points are landmarks, which keep their positions.
    - `sliding`: `"bending"` (the default) for the bending energy, or `"procrustes"`.
    - `rounds`: the largest number of rounds, at least 1.

    **Returns:** `Semilandmarks`.

    **Raises:** `InputError` if the numbers of meshes and positions differ, if there are fewer than two
    specimens, if a slider does not exist, or if two points coincide.
    """
    check_choice(sliding, Sliding, "a criterion of sliding")
    rounds = check_whole_number("rounds", rounds, 1)
    if len(meshes) != len(positions) or len(meshes) < 2:
        raise InputError(
            f"there are {len(meshes)} meshes and positions of {len(positions)} specimens: give positions on "
            "each of at least two meshes."
        )
    sliders.check(positions.shape[1])
    points, trees = positions.copy(), [SurfaceTree(mesh) for mesh in meshes]
    moving = np.zeros(positions.shape[1], bool)
    moving[np.concatenate([sliders.curves[:, 1], sliders.surfaces])] = True
    energies = []
    for _ in range(rounds):
        found = align(points, scale=True)
        matrix, energy = _energy(found.aligned, found.mean, sliding)
        energies.append(energy)
        before = points.copy()
        for i, (mesh, tree) in enumerate(zip(meshes, trees, strict=True)):
            rotation, scale = found.rotations[i], found.scales[i]
            normals = tree.nearest(points[i])[0].interpolate(mesh.vertex_normals, mesh) @ rotation.T
            rows, directions = sliders.directions(found.aligned[i], _unit(normals))
            moved = slide(found.aligned[i], found.mean, rows, directions, matrix)
            back = (moved[moving] - found.translations[i]) @ rotation / scale
            points[i, moving] = tree.nearest(back)[0].positions(mesh)
        change = found.scales[:, None] * np.linalg.norm(points - before, axis=2)
        size = np.sqrt(((found.mean - found.mean.mean(axis=0)) ** 2).sum())
        if change.mean() <= _TOLERANCE * size:
            break
    found = align(points, scale=True)
    energies.append(_energy(found.aligned, found.mean, sliding)[1])
    return Semilandmarks(points, found.mean, np.array(energies))


def place_semilandmarks(
    collection: Collection,
    landmarks: Landmarks,
    sliders: Sliders,
    *,
    source: int | None = None,
    sliding: Sliding = "bending",
) -> Semilandmarks:
    """Place landmarks and semilandmarks of one shape on all shapes of a collection, and slide them.

    The first positions are the corresponding points of the registered meshes. Shapes of the other hand than
    the template are mirrored while points slide.

    **Arguments:**

    - `collection`: the result of `match_collection`, with N shapes.
    - `landmarks`: `Landmarks` with k points on the shape `source`.
    - `sliders`: the `Sliders` among these points.
    - `source`: the number of the shape with the landmarks, by default the template.
    - `sliding`: see `slide_semilandmarks`.

    **Returns:** `Semilandmarks` with positions in the coordinates of each mesh.

    **Raises:** `InputError` as `slide_semilandmarks` and `transfer_landmarks`.
    """
    source = collection.template if source is None else source
    carried = [
        landmarks.positions
        if target == source
        else transfer_landmarks(landmarks, collection.registered_mesh(source, target)).landmarks.positions
        for target in range(len(collection.meshes))
    ]
    signs = collection.signs[:, None, :]
    meshes = [
        mesh.mirrored() if sign[0, 0] < 0 else mesh
        for mesh, sign in zip(collection.meshes, signs, strict=True)
    ]
    found = slide_semilandmarks(meshes, np.array(carried) * signs, sliders, sliding=sliding)
    return Semilandmarks(found.positions * signs, found.mean, found.energies)


def read_sliders(path: str | os.PathLike[str], names: Sequence[str]) -> Sliders:
    """Read the `Sliders` among named landmarks from a table (`.csv`).

    The columns before, slide and after contain names of landmarks. A row without the names before and after
    is a point on the surface. The first row may contain the titles of the columns.

    **Arguments:**

    - `path`: the file, in UTF-8 and with commas.
    - `names`: the names of the k landmarks.

    **Raises:** `InputError` if the file cannot be read, a row does not have this form, a name does not exist,
    or a point slides twice.
    """
    numbers = {name: number for number, name in enumerate(names)}
    curves, surfaces = [], []
    with naming(path):
        text = read_bytes(path).decode("utf-8-sig", errors="replace")
        for line, text_of_row in enumerate(text.splitlines(), start=1):
            cells = [cell.strip() for cell in next(csv.reader([text_of_row]), [])]
            if not any(cells) or (line == 1 and cells == list(TITLES)):
                continue
            if len(cells) != 3 or not cells[1] or bool(cells[0]) != bool(cells[2]):
                raise InputError(
                    f"line {line} is no slider: give the names before, slide and after, or only slide for a "
                    "point on the surface."
                )
            if unknown := [cell for cell in cells if cell and cell not in numbers]:
                raise InputError(
                    f"line {line}: no landmark has the name {unknown[0][:40]!a}: correct the name."
                )
            if cells[0]:
                curves.append([numbers[cell] for cell in cells])
            else:
                surfaces.append(numbers[cells[1]])
        sliders = Sliders(np.array(curves, np.int64).reshape(-1, 3), np.array(surfaces, np.int64))
        sliders.check(len(names))
    return sliders


TITLES = ("before", "slide", "after")
"""The titles of the columns of a table of sliders, as in geomorph."""


def _energy(
    aligned: Float64[np.ndarray, "N k 3"], mean: Float64[np.ndarray, "k 3"], sliding: Sliding
) -> tuple[Float64[np.ndarray, "k k"], float]:
    """Return the matrix of the energy, and the sum of the energies of all specimens of centroid size 1."""
    size = float(np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum()))
    matrix = bending_energy_matrix(mean / size) if sliding == "bending" else np.eye(len(mean))
    away = (aligned - mean) / size
    return matrix, float(np.einsum("ikc,kl,ilc->", away, matrix, away))


def _unit(vectors: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)
