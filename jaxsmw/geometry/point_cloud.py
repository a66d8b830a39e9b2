"""Surfaces of point clouds: triangle meshes whose vertices are the given points.

The tetrahedra of the Delaunay triangulation of the points are labelled inside or outside, and the surface
consists of the triangles between inside and outside tetrahedra. Unlike triangulations in tangent planes, this
method separates sheets that nearly touch, and orients the surface consistently.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float64, Int64
from numpy.typing import ArrayLike
from scipy.sparse.linalg import cg
from scipy.spatial import Delaunay, KDTree, QhullError

from jaxsmw.errors import InputError
from jaxsmw.geometry.arrays import first_equal_rows
from jaxsmw.geometry.mesh import Mesh, check_extent, make_mesh, numeric_rows
from jaxsmw.geometry.scans import usable_positions
from jaxsmw.wording import count_of

FEWEST_POINTS = 20
"""The smallest number of different points that `triangulate_points` accepts."""

# The weight of a pair of tetrahedra is between exp(-4) and exp(4), as in the paper that `triangulate_points`
# cites.
_CONTRAST = 4.0
# `_AROUND` points are added on a sphere around the cloud. The radius of the sphere is `_DISTANCE_AROUND`
# times the extent of the cloud. Every tetrahedron with an added point as a corner is labelled outside.
_AROUND, _DISTANCE_AROUND = 60, 3.0
# A tetrahedron is almost flat if the radius of its circumsphere is above `_LARGEST_RADIUS` times the extent
# of the cloud.
_LARGEST_RADIUS = 20.0
# At this relative residual, the signs of the labels no longer change. The solver reaches this residual in 100
# to 200 iterations.
_TOLERANCE, _ITERATIONS = 1e-6, 5000
# Triangles that close holes are dropped. A triangle closes a hole if one of its edges is longer than `_GAP`
# times the spacing at each end of the edge. The spacing at a point is the distance to its 12th nearest point.
_GAP, _NEIGHBORS = 1.5, 12
# At least this share of the points must be vertices of the surface.
_ON_SURFACE = 0.5
# Normals are ignored if the share of finite, non-zero normals is below this number.
_KNOWN_NORMALS = 0.5
# Points on a surface have about 7 tetrahedra per point. Qhull takes very long for points that have far more
# tetrahedra, for example points on two lines. Therefore `_TRIED` random points are triangulated first. No
# surface is computed if these random points have more than `_MOST_TETRAHEDRA` tetrahedra per point.
_MOST_TETRAHEDRA, _TRIED = 50, 1000


def triangulate_points(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    *,
    name: str = "point cloud",
    notes: Sequence[str] = (),
) -> Mesh:
    """Triangulate a point cloud: make a mesh whose vertices are the points, in the same order.

    The function labels the tetrahedra of the Delaunay triangulation as inside or outside, with the weights of
    Kolluri, Shewchuk, O'Brien, "Spectral surface reconstruction from noisy point clouds", SGP 2004. Adjacent
    tetrahedra whose circumspheres overlap deeply are likely to have the same label. Each point has two poles,
    which are vertices of its Voronoi cell: the farthest vertex on each side of the surface. The tetrahedra of
    the two poles are likely to have opposite labels. The labels are real numbers that minimise a weighted sum
    of squared violations of these two conditions. Tetrahedra far from the points are labelled outside in
    advance. The function solves a linear system, whereas the paper solves an eigenvalue problem.

    Triangles whose edges are much longer than the distances between neighbouring points are dropped, so open
    surfaces stay open. These points are unreferenced vertices: outliers that the surface does not use, later
    points at the position of another point, and points that are not finite or very far from the others.

    **Arguments:**

    - `points`: positions (n, 3) in any unit, on the surface of a solid body. The points may be noisy and have
      holes.
    - `normals`: the normals of the points (n, 3), of any length and either sign, or None. Normals help to
      find the poles where the surface is thin.
    - `name`: the name of the point cloud in messages.
    - `notes`: sentences that precede the notes of the mesh.

    **Returns:** A `Mesh` with the n points as vertices, in the same unit, whose normals point outward. Its
    `notes` say how many triangles join the points.

    **Raises:** `InputError` if an array has a wrong shape or type, if there are fewer than 20 different
    points, if the extent of the points is below 1e-60 or above 1e60, or if fewer than half of the points lie
    on the surface of a body.
    """
    position = numeric_rows(points, "points", name).astype(np.float64)
    direction = None if normals is None else numeric_rows(normals, "normals", name).astype(np.float64)
    if direction is not None and len(direction) != len(position):
        raise InputError(
            f"{name}: {len(direction)} normals belong to {len(position)} points: give one normal for each "
            "point."
        )
    notes = list(notes)
    if direction is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            known = (lengths := np.linalg.norm(direction, axis=1)) > 0
            known &= np.isfinite(lengths)
        if known.mean() < _KNOWN_NORMALS:
            notes.append(f"Normals ignored: {count_of(int((~known).sum()), 'normal')} without a direction.")
            direction = None
        else:
            direction[~known] = 0
    usable = usable_positions(position)
    position[~usable] = np.median(position[usable], axis=0) if usable.any() else np.nan
    distinct = np.flatnonzero((first_equal_rows(position) == np.arange(len(position))) & usable)
    if len(distinct) < FEWEST_POINTS:
        raise InputError(
            f"{name}: there are no faces, and {count_of(len(distinct), 'different point')} cannot represent "
            f"a surface: give the faces, or at least {FEWEST_POINTS} points."
        )
    check_extent(position, name)
    faces = _surface(position[distinct], None if direction is None else direction[distinct])
    used = len(np.unique(faces)) / len(distinct)
    if used < _ON_SURFACE:
        raise InputError(
            f"{name}: only {used:.0%} of the points lie on the surface of a body. The points may fill a "
            "volume, or lie in a plane or on a line: triangulate them with another program, and give the "
            "mesh."
        )
    notes.append(f"A point cloud without faces: {count_of(len(faces), 'triangle')} join the points.")
    if not usable.all():
        notes.append(f"{count_of(int((~usable).sum()), 'point')} without a usable position.")
    return make_mesh(position, distinct[faces], name=name, notes=notes)


def _surface(
    points: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"] | None
) -> Int64[np.ndarray, "f 3"]:
    """Return the triangles (f, 3) between inside and outside, except triangles that close holes."""
    tetrahedra = _tetrahedra(points)
    if tetrahedra is None:
        return np.empty((0, 3), np.int64)
    inside = _inside(tetrahedra, *_poles(tetrahedra, len(points), normals))
    faces = _boundary(tetrahedra, inside)
    reach = KDTree(points).query(points, k=[min(_NEIGHBORS + 1, len(points))])[0][:, 0]
    corners = points[faces]
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    longest = _GAP * np.maximum(reach[faces], reach[np.roll(faces, -1, axis=1)])
    return faces[(lengths <= longest).all(axis=1)]


class _Tetrahedra(NamedTuple):
    """The Delaunay triangulation of the points, scaled to extent 1, and of points added far away."""

    points: Float64[np.ndarray, "p 3"]
    corners: Int64[np.ndarray, "t 4"]
    neighbors: Int64[np.ndarray, "t 4"]  # across the triangle opposite to each corner, or -1
    centers: Float64[np.ndarray, "t 3"]
    radii: Float64[np.ndarray, " t"]
    outer: Bool[np.ndarray, " t"]  # whether a corner is an added point

    def overlap(self, i: Int64[np.ndarray, " k"], j: Int64[np.ndarray, " k"]) -> Float64[np.ndarray, " k"]:
        """Return the cosines of the angles at which circumspheres intersect. Equal spheres have cosine 1."""
        apart = ((self.centers[i] - self.centers[j]) ** 2).sum(axis=1)
        cosines = (self.radii[i] ** 2 + self.radii[j] ** 2 - apart) / (2 * self.radii[i] * self.radii[j])
        return np.clip(cosines, -1, 1)


def _tetrahedra(points: Float64[np.ndarray, "n 3"]) -> _Tetrahedra | None:
    """Return the tetrahedra, or None if all points lie in a plane or on few lines."""
    scaled = (points - points.mean(axis=0)) / np.ptp(points, axis=0).max()
    if np.linalg.svd(scaled, compute_uv=False)[2] < 1e-9 * len(points) ** 0.5:
        return None
    # A Fibonacci lattice is an even distribution of points on a sphere.
    step = np.arange(_AROUND) + 0.5
    height, azimuth = 1 - 2 * step / _AROUND, np.pi * (1 + 5**0.5) * step
    around = np.stack([np.cos(azimuth), np.sin(azimuth), height / np.sqrt(1 - height**2)], axis=1)
    around *= _DISTANCE_AROUND * np.sqrt(1 - height**2)[:, None]
    scaled = np.concatenate([scaled, around])
    tried = np.random.default_rng(0).permutation(len(points))[:_TRIED]
    try:
        if len(Delaunay(scaled[tried]).simplices) > _MOST_TETRAHEDRA * len(tried):
            return None
        triangulation = Delaunay(scaled)
    except QhullError:
        return None
    corners = triangulation.simplices.astype(np.int64)
    centers, radii = _circumspheres(scaled[corners])
    outer = (corners >= len(points)).any(axis=1)
    return _Tetrahedra(scaled, corners, triangulation.neighbors.astype(np.int64), centers, radii, outer)


def _circumspheres(
    corners: Float64[np.ndarray, "t 4 3"],
) -> tuple[Float64[np.ndarray, "t 3"], Float64[np.ndarray, " t"]]:
    """Return the centres and radii of circumspheres; flat tetrahedra get centroids and `_LARGEST_RADIUS`."""
    a, b, c = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    volume = np.einsum("ti,ti->t", a, np.cross(b, c))
    squares = ((v**2).sum(axis=1)[:, None] for v in (a, b, c))
    weighted = sum(s * np.cross(u, v) for s, (u, v) in zip(squares, ((b, c), (c, a), (a, b)), strict=True))
    with np.errstate(all="ignore"):
        offsets = weighted / (2 * volume[:, None])
        radii = np.linalg.norm(offsets, axis=1)
    flat = ~((radii > 1 / _LARGEST_RADIUS**9) & (radii <= _LARGEST_RADIUS))
    centers = np.where(flat[:, None], corners.mean(axis=1), corners[:, 0] + offsets)
    return centers, np.where(flat, _LARGEST_RADIUS, radii)


def _poles(
    tetrahedra: _Tetrahedra, n: int, normals: Float64[np.ndarray, "n 3"] | None
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    """Return, for each point with poles on both sides, the tetrahedra of its two poles."""
    # Without normals, the first pole is the farthest circumcentre around the point, and the second pole is
    # the farthest circumcentre in the opposite half-space. With normals, the tangent plane separates the
    # sides.
    point, tetrahedron = tetrahedra.corners.ravel(), np.repeat(np.arange(len(tetrahedra.corners)), 4)
    given = point < n
    point, tetrahedron = point[given], tetrahedron[given]
    offsets = tetrahedra.centers[tetrahedron] - tetrahedra.points[point]
    distances = np.linalg.norm(offsets, axis=1)

    def farthest(on_side: Bool[np.ndarray, " q"]) -> Int64[np.ndarray, " n"]:
        order = np.lexsort([distances[on_side], point[on_side]])
        points, numbers = point[on_side][order], tetrahedron[on_side][order]
        last = np.append(points[1:] != points[:-1], np.ones(min(len(points), 1), dtype=bool))
        found = np.full(n, -1)
        found[points[last]] = numbers[last]
        return found

    if normals is None:
        first = farthest(np.ones(len(point), dtype=bool))
        axes = tetrahedra.centers[first] - tetrahedra.points[:n]
        side = np.einsum("qi,qi->q", offsets, axes[point])
    else:
        side = np.einsum("qi,qi->q", offsets, normals[point])
        first = farthest(side > 0)
    second = farthest(side < 0)
    both = (first >= 0) & (second >= 0)
    return first[both], second[both]


def _inside(
    tetrahedra: _Tetrahedra, first: Int64[np.ndarray, " k"], second: Int64[np.ndarray, " k"]
) -> Bool[np.ndarray, " t"]:
    """Label the tetrahedra: True for inside."""
    # The labels x are real numbers, negative for inside. They minimise the sum of w (x_i - x_j)^2 over
    # adjacent tetrahedra i, j plus the sum of w (x_i + x_j)^2 over the two poles i, j of each point. The
    # label of every outer tetrahedron is fixed at 1.
    count = int((~tetrahedra.outer).sum())
    unknown = np.full(len(tetrahedra.outer), count)  # all outer tetrahedra have the index `count`
    unknown[~tetrahedra.outer] = np.arange(count)
    i, j = np.repeat(np.arange(len(unknown)), 4), tetrahedra.neighbors.ravel()
    i, j = i[once := i < j], j[once]
    weights = [
        np.exp(_CONTRAST * tetrahedra.overlap(i, j)),
        np.exp(-_CONTRAST * tetrahedra.overlap(first, second)),
    ]
    ends = [unknown[np.stack(pair)] for pair in ((i, j), (first, second))]
    apart = [pair[0] != pair[1] for pair in ends]
    rows, columns = np.concatenate([pair[:, kept] for pair, kept in zip(ends, apart, strict=True)], axis=1)
    weight = np.concatenate([w[kept] for w, kept in zip(weights, apart, strict=True)])
    sign = np.repeat([-1.0, 1.0], [kept.sum() for kept in apart])
    size = (count + 1, count + 1)
    off_diagonal = sp.coo_array((sign * weight, (rows, columns)), size).tocsr()
    diagonal = np.bincount(np.concatenate([rows, columns]), np.tile(weight, 2), count + 1)
    matrix = (off_diagonal + off_diagonal.T + sp.diags_array(diagonal)).tocsr()
    scale = 1 / np.sqrt(diagonal[:count])
    scaled = sp.diags_array(scale) @ matrix[:count, :count] @ sp.diags_array(scale)
    right_hand_side = -scale * matrix[:count, [count]].toarray()[:, 0]
    labels, unfinished = cg(scaled, right_hand_side, rtol=_TOLERANCE, maxiter=_ITERATIONS)
    if unfinished:
        warnings.warn(
            f"the inside of the point cloud was not determined exactly in {_ITERATIONS} iterations: look at "
            "the surface, or give the points with normals.",
            stacklevel=2,
        )
    return np.append(labels, 1.0)[unknown] < 0


def _boundary(tetrahedra: _Tetrahedra, inside: Bool[np.ndarray, " t"]) -> Int64[np.ndarray, "f 3"]:
    """Return the triangles between inside and outside, with corners counter-clockwise seen from outside."""
    number, opposite = np.nonzero(inside[:, None] & ~inside[tetrahedra.neighbors])
    others = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
    faces = tetrahedra.corners[number[:, None], others[opposite]]
    corners, apex = tetrahedra.points[faces], tetrahedra.points[tetrahedra.corners[number, opposite]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fi,fi->f", normals, apex - corners[:, 0]) > 0
    faces[inward] = faces[inward][:, ::-1]
    return faces
