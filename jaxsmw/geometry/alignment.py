"""Rigid alignment of two sets of points, by iterative closest points from many rotations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxsmw.geometry.rotations import nearest_rotations

# `_FIRST` iterations run from every rotation. `_FURTHER` iterations then run from the `_BEST` best results.
_FIRST, _FURTHER = 10, 30
_BEST = 5
# The number of iterations with distances to tangent planes.
_TO_PLANES = 10
# The mean distance after the iterations with tangent planes, divided by the mean distance before, must be
# below this number. Otherwise the result of these iterations is not used. (Entry R24)
_MUCH_SMALLER = 0.5
# The first iterations move at most this number of points of x.
_MOVED_FIRST = 500


class Alignment(NamedTuple):
    """A rigid motion: a point p moves to `rotation @ p + offset`.

    **Attributes:**

    - `rotation`: a rotation (3, 3) without reflection.
    - `offset`: a translation (3,), in the unit of the points.
    """

    rotation: Float64[np.ndarray, "3 3"]
    offset: Float64[np.ndarray, " 3"]

    def apply(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Move points (p, 3)."""
        return points @ self.rotation.T + self.offset


def align_rigidly(
    x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "q 3"],
    normals: Float64[np.ndarray, "q 3"] | None = None,
) -> Alignment:
    """Find the rigid motion that brings the points x near the points y.

    The method of iterative closest points (Besl, McKay, "A method for registration of 3-D shapes", PAMI 1992)
    runs from the identity, from the 24 rotations between the principal axes of both sets, and from the 60
    rotations of an icosahedron. Each resulting motion is rated by the sum of two mean distances: from x to
    the nearest points of y, and from y to the nearest points of x. The motion with the smallest sum is
    chosen.

    The method of iterative closest points hardly slides one nearly round surface along another. If normals
    are given, further iterations therefore minimise the distances to tangent planes (Chen, Medioni, "Object
    modelling by registration of multiple range images", 1992). The result of these iterations is used only if
    the shapes fit each other.

    **Arguments:**

    - `x`, `y`: points (p, 3) and (q, 3), evenly spread over the surfaces, in the same unit.
    - `normals`: unit normals of the surface at y (q, 3), or None.

    **Returns:** The motion from x to y.
    """
    middle_x, middle_y = x.mean(axis=0), y.mean(axis=0)
    tree = KDTree(y)
    between_axes = _principal_axes(y - middle_y) @ Rotation.create_group("O").as_matrix()
    rotations = [
        np.eye(3),
        *between_axes @ _principal_axes(x - middle_x).T,
        *Rotation.create_group("I").as_matrix(),
    ]

    def closest_points(motion: Alignment, iterations: int, step: int = 1) -> Alignment:
        moving = x[::step]
        for _ in range(iterations):
            _, nearest = tree.query(motion.apply(moving))
            motion = rigid_fit(moving, y[nearest])
        return motion

    def distance(motion: Alignment) -> float:
        moved = motion.apply(x)
        return float(tree.query(moved)[0].mean() + KDTree(moved).query(y)[0].mean())

    starts = [Alignment(rotation, middle_y - rotation @ middle_x) for rotation in rotations]
    step = -(-len(x) // _MOVED_FIRST)
    first = sorted((closest_points(start, _FIRST, step) for start in starts), key=distance)[:_BEST]
    best = min((closest_points(motion, _FURTHER) for motion in first), key=distance)
    return best if normals is None else _slide(x, y, normals, tree, best)


def _slide(
    x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "q 3"],
    normals: Float64[np.ndarray, "q 3"],
    tree: KDTree,
    motion: Alignment,
) -> Alignment:
    """Minimise the distances of x to the tangent planes at the nearest points of y."""
    # If the shapes do not fit each other, the iterations slide x too far. The mean distance then decreases
    # only slightly, and the given motion is returned.

    def to_planes(
        motion: Alignment,
    ) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3"], Float64[np.ndarray, " p"]]:
        moved = motion.apply(x)
        nearest = tree.query(moved)[1]
        return moved, normals[nearest], ((y[nearest] - moved) * normals[nearest]).sum(axis=1)

    first = motion
    for _ in range(_TO_PLANES):
        moved, normal, distances = to_planes(motion)
        # The first three unknowns are a small rotation vector, the last three a translation.
        step = np.linalg.lstsq(np.hstack([np.cross(moved, normal), normal]), distances, rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        motion = Alignment(turn @ motion.rotation, turn @ motion.offset + step[3:])
    before, after = (np.abs(to_planes(either)[2]).mean() for either in (first, motion))
    return motion if after < _MUCH_SMALLER * before else first


def _principal_axes(points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return a right-handed frame whose columns are the principal axes."""
    axes = np.linalg.svd(points, full_matrices=False)[2].T
    return axes * np.linalg.det(axes)


def rigid_fit(
    x: Float64[np.ndarray, "p 3"],
    targets: Float64[np.ndarray, "p 3"],
    weights: Float64[np.ndarray, " p"] | None = None,
) -> Alignment:
    """Return the rigid motion of x that minimises the weighted sum of squared distances to the targets.

    With `weights` None (the default), all points have the same weight.
    """
    middle, middle_of_targets = (np.average(points, axis=0, weights=weights) for points in (x, targets))
    pulls = targets - middle_of_targets
    if weights is not None:
        pulls *= weights[:, None]
    (rotation,), _ = nearest_rotations((pulls.T @ (x - middle))[None])
    return Alignment(rotation, middle_of_targets - rotation @ middle)
