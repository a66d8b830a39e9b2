"""Rigid alignment of points, and the rotations that best align vectors with given vectors."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

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
# Two alignments are different if the root mean square distance between the moved points exceeds this share of
# the root mean square distance of y from its mean.
_DIFFERENT = 0.25
# Two principal axes are interchangeable if the smaller variance is at least this share of the larger one.
_INTERCHANGEABLE = 0.85
# A rotation is a symmetry if the root mean square distance of moved samples from the tangent planes at the
# nearest samples is smaller, in units of length. That of people in nearly the same pose as their turned
# image is at least 0.01.
_ONTO_ITSELF = 0.005
# Fewer points do not show a symmetry. This share of the points must be near the surface.
_FEWEST, _NEARLY_ALL = 30, 0.98
# The distance of the points on normals from the surface, in units of length.
_THICKNESS = 0.1
# The weight of unit normals beside positions in oriented points, in units of length.
NORMAL_WEIGHT = 0.1
# A rotation is nearly ambiguous if `divisor` is at most `_AMBIGUOUS`. Otherwise, Newton's method for the
# trace converges in 4 to 14 steps, and the error of the rotation is below 1e-10.
_NEWTON_STEPS, _AMBIGUOUS = 16, 1e-3


def oriented_points(
    positions: Float64[np.ndarray, "p 3"], normals: Float64[np.ndarray, "p 3"]
) -> Float64[np.ndarray, "p 6"]:
    """Return coordinates in which points are near if their positions and their normals are near."""
    return np.hstack([positions, NORMAL_WEIGHT * normals])


class Alignment(NamedTuple):
    """A rigid motion: a point p moves to `rotation @ p + offset`, without a reflection."""

    rotation: Float64[np.ndarray, "3 3"]
    offset: Float64[np.ndarray, " 3"]

    def apply(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Move points (p, 3)."""
        return self.turn(points) + self.offset

    def turn(self, directions: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Turn directions, such as normals (p, 3)."""
        return directions @ self.rotation.T


def align_rigidly(
    x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "q 3"],
    normals: Float64[np.ndarray, "q 3"] | None = None,
) -> Alignment:
    """Find the rigid motion that brings the points x near the points y.

    The method of iterative closest points (Besl, McKay, "A method for registration of 3-D shapes", PAMI 1992)
    runs from the identity, from the 24 rotations between the principal axes of both sets, and from the 60
    rotations of an icosahedron. The motion with the smallest sum of two mean distances is chosen: from x to
    the nearest points of y, and from y to the nearest points of x.

    The method of iterative closest points hardly slides one nearly round surface along another. If normals
    are given, further iterations therefore minimise the distances to tangent planes (Chen, Medioni, "Object
    modelling by registration of multiple range images", 1992). Their result is used only if the shapes fit
    each other.

    **Arguments:**

    - `x`, `y`: points (p, 3) and (q, 3), evenly spread over the surfaces, in the same unit.
    - `normals`: unit normals of the surface at y (q, 3), or None.
    """
    tree = KDTree(y)
    first = _iterated(x, y, tree, [*_between_axes(x, y), *Rotation.create_group("I").as_matrix()])[:_BEST]
    further = [_closest_points(x, y, tree, motion, _FURTHER) for _, motion in first]
    best = min(further, key=lambda motion: _distance(x, y, tree, motion))
    if normals is None:
        return best
    slid = _slide(x, y, normals, tree, best)
    offsets = (_to_tangent_planes(x, y, normals, tree, motion)[2] for motion in (best, slid))
    before, after = (np.abs(offset).mean() for offset in offsets)
    # If the shapes do not fit each other, the iterations slide x too far. The mean distance then decreases
    # only slightly.
    return slid if after < _MUCH_SMALLER * before else best


def alignments(x: Float64[np.ndarray, "p 3"], y: Float64[np.ndarray, "q 3"], number: int) -> list[Alignment]:
    """Return rigid motions that bring the points x near the points y in different ways, the nearest first.

    The method of `align_rigidly` runs from the identity and from the 24 rotations between the principal axes.

    **Arguments:**

    - `x`, `y`: points (p, 3) and (q, 3), evenly spread over the surfaces, in the same unit.
    - `number`: the largest number of motions.
    """
    least = _DIFFERENT**2 * ((y - y.mean(axis=0)) ** 2).sum(axis=1).mean()
    motions = [motion for _, motion in _iterated(x, y, KDTree(y), _between_axes(x, y))]
    return different_alignments(motions, x, least, number)


def different_alignments(
    motions: Sequence[Alignment], points: Float64[np.ndarray, "p 3"], least: float, number: int
) -> list[Alignment]:
    """Return the first motions that differ from all earlier ones.

    **Arguments:**

    - `motions`: rigid motions, the best first.
    - `points`: the points that they move (p, 3).
    - `least`: two motions differ if the mean square distance between the moved points is larger.
    - `number`: the largest number of motions.
    """
    kept: list[tuple[Alignment, Float64[np.ndarray, "p 3"]]] = []
    for motion in motions:
        moved = motion.apply(points)
        if all(((moved - other) ** 2).sum(axis=1).mean() > least for _, other in kept):
            kept.append((motion, moved))
        if len(kept) == number:
            break
    return [motion for motion, _ in kept]


def symmetries(
    points: Float64[np.ndarray, "p 3"], normals: Float64[np.ndarray, "p 3"], *, mirrored: bool = False
) -> list[Alignment]:
    """Return the rotations that bring a surface onto itself, the identity left out.

    If `mirrored` is True, they bring the mirror image, whose points are `-points`, onto the surface instead.

    The iterations of `align_rigidly` run from a few rotations. The axis of a half turn is a principal axis.
    The axis of any other turn is the principal axis whose variance differs from the two others. If all three
    are equal, the axes of a cube and of an icosahedron are tried. A surface of revolution gets turns by
    multiples of 30°, and half turns. A symmetry by less than about 30° can be missed.

    **Arguments:**

    - `points`: points (p, 3), evenly spread over the surface, in units in which its area is about 1.
    - `normals`: the unit normals of the surface at the points (p, 3).
    """
    if len(points) < _FEWEST:
        return []
    variances, axes = np.linalg.eigh(np.cov(points.T))
    smaller, larger = variances[:2] >= _INTERCHANGEABLE * variances[1:]
    if smaller and larger:
        turns = Rotation.concatenate([Rotation.create_group(name) for name in "OI"])
    else:
        turns = Rotation.create_group("D12" if smaller or larger else "D2", axis="Z" if smaller else "X")
    axes *= np.linalg.det(axes)
    tree = KDTree(points)
    moving = -points if mirrored else points
    turned = _iterated(moving, points, tree, list(axes @ turns.as_matrix() @ axes.T))
    motions = [_slide(moving, points, normals, tree, motion) for _, motion in turned]
    offsets = (_to_tangent_planes(moving, points, normals, tree, motion)[2] for motion in motions)
    distances = np.array([np.sqrt(np.mean(offset**2)) for offset in offsets])
    closest = [motions[number] for number in np.argsort(distances)[: np.sum(distances < _ONTO_ITSELF)]]
    sides = -normals if mirrored else normals
    closest = [motion for motion in closest if _covers(moving, sides, points, normals, tree, motion)]
    least = _DIFFERENT**2 * variances.sum()
    if mirrored:
        return different_alignments(closest, moving, least, len(motions))
    identity = Alignment(np.eye(3), np.zeros(3))
    return different_alignments([identity, *closest], moving, least, len(motions))[1:]


def _covers(
    x: Float64[np.ndarray, "p 3"],
    normals_x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "p 3"],
    normals_y: Float64[np.ndarray, "p 3"],
    tree: KDTree,
    motion: Alignment,
) -> bool:
    """Return whether the moved points x cover the surface of y, with normals to the same side.

    Nearly all points then have a neighbour on the other surface that is hardly farther away than a sample is
    from the next one. The boundary of an open surface must fit too, which distances to planes do not show.
    """
    spacing = tree.query(y, 2)[0][:, 1].mean()
    moved = motion.apply(x)
    distances, nearest = tree.query(moved)
    back = KDTree(moved).query(y)[0]
    farthest = max(np.quantile(distances, _NEARLY_ALL), np.quantile(back, _NEARLY_ALL))
    same_side = (motion.turn(normals_x) * normals_y[nearest]).sum(axis=1).mean() > 0.5
    return bool(same_side and farthest < 2 * spacing)


def _between_axes(
    x: Float64[np.ndarray, "p 3"], y: Float64[np.ndarray, "q 3"]
) -> list[Float64[np.ndarray, "3 3"]]:
    """Return the identity and the 24 rotations that take principal axes of x to principal axes of y."""
    axes_x, axes_y = (_principal_axes(points - points.mean(axis=0)) for points in (x, y))
    return [np.eye(3), *axes_y @ Rotation.create_group("O").as_matrix() @ axes_x.T]


def _iterated(
    x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "q 3"],
    tree: KDTree,
    rotations: Sequence[Float64[np.ndarray, "3 3"]],
) -> list[tuple[float, Alignment]]:
    """Run the first iterations from each rotation. Return the mean distances and motions, the best first."""
    middle_x, middle_y = x.mean(axis=0), y.mean(axis=0)
    few = x[:: -(-len(x) // _MOVED_FIRST)]
    starts = (Alignment(rotation, middle_y - rotation @ middle_x) for rotation in rotations)
    motions = [_closest_points(few, y, tree, start, _FIRST) for start in starts]
    return sorted(((_distance(x, y, tree, motion), motion) for motion in motions), key=itemgetter(0))


def _closest_points(
    x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "q 3"],
    tree: KDTree,
    motion: Alignment,
    iterations: int,
) -> Alignment:
    for _ in range(iterations):
        _, nearest = tree.query(motion.apply(x))
        motion = rigid_fit(x, y[nearest])
    return motion


def _distance(
    x: Float64[np.ndarray, "p 3"], y: Float64[np.ndarray, "q 3"], tree: KDTree, motion: Alignment
) -> float:
    """Return the mean distance from x to y plus that from y to x, after the motion."""
    moved = motion.apply(x)
    return float(tree.query(moved)[0].mean() + KDTree(moved).query(y)[0].mean())


def _to_tangent_planes(
    x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "q 3"],
    normals: Float64[np.ndarray, "q 3"],
    tree: KDTree,
    motion: Alignment,
) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3"], Float64[np.ndarray, " p"]]:
    """Return the moved points x, the normals at the nearest points of y, and the distances to y's planes."""
    moved = motion.apply(x)
    nearest = tree.query(moved)[1]
    return moved, normals[nearest], ((y[nearest] - moved) * normals[nearest]).sum(axis=1)


def _slide(
    x: Float64[np.ndarray, "p 3"],
    y: Float64[np.ndarray, "q 3"],
    normals: Float64[np.ndarray, "q 3"],
    tree: KDTree,
    motion: Alignment,
) -> Alignment:
    """Minimise the distances of x to the tangent planes at the nearest points of y."""
    for _ in range(_TO_PLANES):
        moved, normal, distances = _to_tangent_planes(x, y, normals, tree, motion)
        # The first three unknowns are a small rotation vector, the last three a translation.
        step = np.linalg.lstsq(np.hstack([np.cross(moved, normal), normal]), distances, rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        motion = Alignment(turn @ motion.rotation, turn @ motion.offset + step[3:])
    return motion


def _principal_axes(points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return a right-handed frame whose columns are the principal axes."""
    axes = np.linalg.svd(points, full_matrices=False)[2].T
    return axes * np.linalg.det(axes)


def rigid_fit(
    x: Float64[np.ndarray, "p 3"],
    targets: Float64[np.ndarray, "p 3"],
    weights: Float64[np.ndarray, " p"] | None = None,
) -> Alignment:
    """Return the rigid motion of x that minimises the weighted sum of squared distances to the targets."""
    middle, middle_of_targets = (np.average(points, axis=0, weights=weights) for points in (x, targets))
    pulls = targets - middle_of_targets
    if weights is not None:
        pulls *= weights[:, None]
    (rotation,), _ = nearest_rotations((pulls.T @ (x - middle))[None])
    return Alignment(rotation, middle_of_targets - rotation @ middle)


class PatchMotions(NamedTuple):
    """The rigid motion that brings each of p patches as close as possible to its goals.

    **Attributes:**

    - `rotations`, `offsets`: the motions (p, 3, 3) and (p, 3); a point q moves to `rotation @ q + offset`.
    - `deformations`: the mean squared distance that remains, divided by the size of the patch (p,), from 0
      to 1. The size is the variance of the patch's positions plus the variance of its goals.
    """

    rotations: Float64[np.ndarray, "p 3 3"]
    offsets: Float64[np.ndarray, "p 3"]
    deformations: Float64[np.ndarray, " p"]


def patch_motions(
    patches: Float64[np.ndarray, "p s"],
    positions: Float64[np.ndarray, "s 3"],
    normals: Float64[np.ndarray, "s 3"],
    goals: Float64[np.ndarray, "s 3"],
    goal_normals: Float64[np.ndarray, "s 3"],
) -> PatchMotions:
    """Find the rigid motion of each patch of an oriented surface towards its goals.

    For each point, two points on its normal count, one on either side of the surface, because a reflection of
    a thin flat patch would only turn it over.

    **Arguments:**

    - `patches`: the weights of the s points in each of p patches (p, s). Each row has the sum 1.
    - `positions`, `normals`: the points (s, 3), in units in which the surface has an area of about 1, and
      their unit normals.
    - `goals`, `goal_normals`: where the points and their normals should move (s, 3).
    """
    products = np.einsum("sa,sb->sab", goals, positions)
    products += _THICKNESS**2 * np.einsum("sa,sb->sab", goal_normals, normals)
    squares = np.sum(positions**2 + goals**2, axis=1, keepdims=True) + 2 * _THICKNESS**2
    columns = patches @ np.hstack([positions, goals, products.reshape(-1, 9), squares])
    before, after = columns[:, :3], columns[:, 3:6]
    moments = columns[:, 6:15].reshape(-1, 3, 3) - np.einsum("pa,pb->pab", after, before)
    rotations, traces = nearest_rotations(moments)
    size = columns[:, 15] - np.sum(before**2 + after**2, axis=1)
    remaining = np.clip((size - 2 * traces) / np.maximum(size, np.finfo(float).tiny), 0, 1)
    return PatchMotions(rotations, after - np.einsum("pab,pb->pa", rotations, before), remaining)


def nearest_rotations(
    moments: Float64[np.ndarray, "n 3 3"],
) -> tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, " n"]]:
    """Find the rotation R that maximises the trace of Rᵀ M, for each matrix M.

    Usually M is a sum of products t gᵀ of a target vector t and a given vector g. R then turns the given
    vectors as close to their target vectors as possible in least squares (Kabsch 1976).

    The maximal trace is the largest root of a polynomial of degree four, which Newton's method finds. The
    rotation then has a closed form (Markley, "Attitude determination using vector observations: a fast
    optimal matrix algorithm", 1993). This takes a tenth of the time of a singular value decomposition, which
    is computed only where the rotation is nearly ambiguous.

    **Returns:** The rotations (n, 3, 3), with determinants 1, and the maximal traces (n,).
    """
    norms = np.sqrt((moments**2).sum(axis=(1, 2)))
    scaled = moments / np.where(norms > 0, norms, 1)[:, None, None]
    # The vertices are the last axis, along which NumPy computes fastest.
    m = np.ascontiguousarray(scaled.transpose(1, 2, 0))
    cofactors = np.stack([_cross(m[1], m[2]), _cross(m[2], m[0]), _cross(m[0], m[1])])
    determinants = (m[0] * cofactors[0]).sum(axis=0)
    constant = 1 - 4 * (cofactors**2).sum(axis=(0, 1))
    # Newton's method starts from an upper bound of the trace, and descends to the largest root.
    trace = np.full(len(moments), np.sqrt(3.0))
    for _ in range(_NEWTON_STEPS):
        square = trace**2
        slope = 4 * trace * (square - 1) - 8 * determinants
        value = (square - 2) * square - 8 * determinants * trace + constant
        trace -= value / np.maximum(slope, np.finfo(float).tiny)
    half = 0.5 * (trace**2 - 1)
    # The divisor is (s1 + s2)(s2 + s3)(s3 + s1), where s1, s2 and s3 are the singular values. Here s3 has the
    # sign of the determinant.
    divisor = half * trace - determinants
    unique = divisor > _AMBIGUOUS
    gram = np.einsum("ian,jan->ijn", m, m)
    rotations = (half + 1) * m + trace * cofactors - np.einsum("ijn,jkn->ikn", gram, m)
    rotations = np.ascontiguousarray((rotations / np.where(unique, divisor, 1)).transpose(2, 0, 1))
    traces = trace * norms
    if not unique.all():
        left, singular, right = np.linalg.svd(moments[~unique])
        signs = np.sign(np.linalg.det(left @ right))
        left[:, :, 2] *= signs[:, None]
        singular[:, 2] *= signs
        rotations[~unique], traces[~unique] = left @ right, singular.sum(axis=1)
    return rotations, traces


def _cross(u: Float64[np.ndarray, "3 n"], v: Float64[np.ndarray, "3 n"]) -> Float64[np.ndarray, "3 n"]:
    """Return the cross products of the columns."""
    return np.stack([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
