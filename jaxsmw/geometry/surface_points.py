"""Points on the faces of a mesh, and checks that points and pointwise maps belong to meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on the faces of a mesh, given by barycentric weights.

    `len(points)` is the number p of points, and `points[rows]` selects points by 0-based indices. Functions
    that receive `SurfacePoints` check them; the constructor does not.

    **Attributes:**

    - `faces`: the face of each point, as 0-based indices (p,) into `Mesh.faces`, int64.
    - `weights`: the barycentric weights (p, 3) of the three corners of the face, float64. The weights are at
      least 0, and each row sums to 1.
    """

    faces: Int64[np.ndarray, " p"]
    weights: Float64[np.ndarray, "p 3"]

    def __len__(self) -> int:
        return len(self.faces)

    def __getitem__(self, rows: Int[np.ndarray, " q"]) -> SurfacePoints:
        return SurfacePoints(self.faces[rows], self.weights[rows])

    def positions(self, mesh: Mesh) -> Float64[np.ndarray, "p 3"]:
        """Return the positions (p, 3) of the points in space, in the unit of their mesh."""
        return self.interpolate(mesh.vertices, mesh)

    def interpolate(self, values: Float64[np.ndarray, "n x"], mesh: Mesh) -> Float64[np.ndarray, "p x"]:
        """Return the values at the points (p, x), given the values at the n vertices of the mesh."""
        return np.einsum("pk,pkx->px", self.weights, values[mesh.faces[self.faces]])

    def nearest_corners(self, mesh: Mesh) -> Int64[np.ndarray, " p"]:
        """Return for each point the nearest corner of its face, as a vertex (p,)."""
        corners = mesh.faces[self.faces]
        distances = np.linalg.norm(mesh.vertices[corners] - self.positions(mesh)[:, None], axis=2)
        return corners[np.arange(len(corners)), distances.argmin(axis=1)]


def check_pointwise_map(
    pointwise_map: ArrayLike, mesh_x: Mesh, mesh_y: Mesh, name: str = "pointwise map"
) -> Int64[np.ndarray, " m"]:
    """Check a map T: X -> Y, and return it as int64 (m,). `name` is its name in error messages.

    **Raises:** `InputError` if the map does not have one 0-based vertex of Y for every vertex of X.
    """
    targets = check_indices(pointwise_map, len(mesh_y.vertices), f"{name} on {mesh_y.name}: vertex")
    if len(targets) != (m := len(mesh_x.vertices)):
        raise InputError(
            f"the {name} has {len(targets)} entries, but {mesh_x.name} has {m} vertices: give one vertex of "
            f"{mesh_y.name} for each vertex."
        )
    return targets


def check_points(
    points: ArrayLike | SurfacePoints, mesh: Mesh, name: str
) -> Int64[np.ndarray, " p"] | SurfacePoints:
    """Check that vertex indices or `SurfacePoints` (p,) belong to a mesh. Return indices as int64.

    `name` is the name of the points in error messages.

    **Raises:** `InputError` if a vertex or face does not exist, or barycentric weights are negative or do not
    sum to 1.
    """
    if not isinstance(points, SurfacePoints):
        return check_indices(points, len(mesh.vertices), f"{name} on {mesh.name}: vertex")
    return check_surface_points(points, mesh, name)


def check_surface_points(points: SurfacePoints, mesh: Mesh, name: str) -> SurfacePoints:
    """Check that `SurfacePoints` belong to a mesh; see `check_points`."""
    faces = check_indices(points.faces, len(mesh.faces), f"{name} on {mesh.name}: face")
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false
        good = (points.weights >= 0).all(axis=1) & (np.abs(points.weights.sum(axis=1) - 1) < 1e-6)
    if not good.all():
        at = int(good.argmin())
        raise InputError(
            f"{name} on {mesh.name}: number {at} has the barycentric weights {points.weights[at].tolist()}, "
            "which must be at least 0 and sum to 1: correct the weights, or divide them by their sum."
        )
    return SurfacePoints(faces, points.weights)


def check_indices(values: ArrayLike, count: int, name: str) -> Int64[np.ndarray, " p"]:
    """Check that values are indices (p,) from 0 to `count` - 1. Return them as int64.

    `name` is the text before the word "indices" in error messages, such as "vertex".

    **Raises:** `InputError` if the values are not a list of integers in this range, or if some are masked.
    """
    if np.ma.is_masked(values):
        raise InputError(f"{name} indices are masked in part: fill in or remove the masked indices.")
    indices = np.asarray(values)
    if indices.ndim != 1 or indices.dtype.kind not in "iu":
        raise InputError(
            f"{name} indices must be a list of integers, but are {indices.dtype.name} of shape "
            f"{indices.shape}: give one index for each point."
        )
    outside = (indices < 0) | (indices >= count)
    if outside.any():
        at = int(outside.argmax())
        cure = "subtract 1, because they seem to count from 1" if indices.max() == count else "correct it"
        raise InputError(
            f"{name} indices must lie between 0 and {count - 1}, but entry {at} is {indices[at]}: {cure}."
        )
    return indices.astype(np.int64)
