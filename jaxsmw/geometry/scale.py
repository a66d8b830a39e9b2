"""An estimate of the relative scale of a partial shape and a full shape in different units of length."""

from __future__ import annotations

from operator import itemgetter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, sampled_shot_descriptors
from jaxsmw.runtime.threads import one_blas_thread, side_by_side

# Lengths are in units of the square root of the full shape's area. Table R33 is in `docs/research_log.md`.
# The tested ratios of the partial shape's area to the full shape's area.
_SHARES = (0.08, 0.11, 0.15, 0.2, 0.27, 0.36, 0.49, 0.66, 0.9)
# The approximate number of samples of the full shape. (Table R33)
_SAMPLES = 3000
# The radii of SHOT, as multiples of `SHOT_RADIUS`. (Table R33)
_RADII = (1.0, 2.0)
# Two samples of the partial shape are compared with their matches only if the distance between the samples is
# in this range. Larger distances vary more between poses. (Table R33)
_DISTANCES = (0.05, 0.4)
# Two samples are compared with their matches only if the cosines of three angles differ by less than this
# number: the angles between both normals, and between each normal and the line that connects the points.
# (Table R33)
_ANGLE_TOLERANCE = 0.15
# Two ratios agree if their logarithms differ by less than this number.
_TOLERANCE = 0.05
# An estimate with a smaller support is uncertain. (Table R33)
_UNCERTAIN_BELOW = 1.5
# The largest absolute logarithm of the most frequent ratio. At larger values, the tested share is so wrong
# that the SHOT radii on the two shapes differ too much.
_FARTHEST = 0.3
# If fewer pairs than this number are compared, their ratios can agree by chance.
_FEWEST = 30


class ScaleEstimate(NamedTuple):
    """The estimated relative scale of two meshes.

    **Attributes:**

    - `scale`: the factor by which lengths on X are multiplied to become lengths in the unit of Y.
    - `support`: the mean number of other matches that confirm a match. Two matches confirm each other if the
      distance on X, times `scale`, is nearly the distance on Y.
    - `uncertain`: whether `support` is below 1.5, so that the scale can be wrong.
    """

    scale: float
    support: float
    uncertain: bool


def estimate_scale(mesh_x: Mesh, mesh_y: Mesh) -> ScaleEstimate:
    """Estimate the relative scale of a partial shape and a full shape, in either order and in any units.

    The shape with the longer boundary, relative to the square root of its area, is taken as the partial
    shape. The function tests several ratios of the partial shape's area to the full shape's area (shares).
    Each share implies a common unit of length, in which SHOT has the same radius on both shapes. Samples with
    mutually nearest descriptors are matched. For two nearby samples, the distance between the matches is
    divided by the distance between the samples. The ratios of correct matches agree, and the ratios of wrong
    matches are scattered. The corrected share is the share times the square of the most frequent ratio. The
    function chooses the share with the largest support (see `ScaleEstimate`). The corrected share and the
    areas of both meshes give the scale. Pairs of samples are compared only if their normals agree (point pair
    features; Drost, Ulrich, Navab, Ilic, "Model globally, match locally", 2010).

    **Raises:** `InputError` if neither mesh has a boundary, or if the meshes are too coarse.
    """
    boundary_x, boundary_y = (relative_boundary(mesh) for mesh in (mesh_x, mesh_y))
    names = f"{mesh_x.name} and {mesh_y.name}"
    if boundary_x == boundary_y == 0:
        raise InputError(
            f"{names}: both meshes are closed, so neither seems to be a partial shape: give the scale as a "
            "number, or match the meshes as full shapes."
        )
    x_is_part = boundary_x >= boundary_y
    part, full = (mesh_x, mesh_y) if x_is_part else (mesh_y, mesh_x)
    sampled = _sample(full, 1.0)

    def vote(share: float) -> tuple[float, float]:
        try:
            return _vote(_sample(part, share), sampled, share)
        except InputError:  # the samples are too sparse for SHOT
            return share, 0.0

    with one_blas_thread():
        best = max(map(vote, _SHARES), key=itemgetter(1))
        # The corrected share is tested too. SHOT then has the same radius on both shapes, so more
        # descriptors match.
        share, support = max(best, vote(best[0]), key=itemgetter(1))
    if support == 0:
        raise InputError(
            f"{names}: no scale can be estimated, because the meshes have too few similar points: give the "
            "scale as a number, or finer meshes."
        )
    from_part = float(np.sqrt(share * full.area / part.area))
    scale = from_part if x_is_part else 1 / from_part
    return ScaleEstimate(scale, support, support < _UNCERTAIN_BELOW)


class _Samples(NamedTuple):
    """The samples of a shape: positions in the unit of the full shape, normals and descriptors."""

    positions: Float[np.ndarray, "s 3"]
    normals: Float[np.ndarray, "s 3"]
    descriptors: Float[np.ndarray, "s d"]


# The shortest boundary of a part, divided by the square root of its area.
_LONG_BOUNDARY = 0.4


def relative_boundary(mesh: Mesh) -> float:
    """Return the length of the boundary, divided by the square root of the area; 0 for a closed surface."""
    return float(mesh.lengths(mesh.boundary_edges).sum() / mesh.area**0.5)


def may_be_part(mesh: Mesh) -> bool:
    """Return whether the boundary of a mesh is so long that the mesh may be a part of a body."""
    return relative_boundary(mesh) >= _LONG_BOUNDARY


def _sample(mesh: Mesh, share: float) -> _Samples:
    """Return samples with descriptors. `share` is the shape's area divided by the full shape's area."""
    unit = (mesh.area / share) ** 0.5
    samples = poisson_disk_samples(mesh, max(1, round(_SAMPLES * share)))
    shot = side_by_side(
        lambda radius: sampled_shot_descriptors(mesh, samples, radius=radius * SHOT_RADIUS / share**0.5),
        *_RADII,
    )
    vertices = samples.vertices
    return _Samples(mesh.vertices[vertices] / unit, mesh.vertex_normals[vertices], np.hstack(shot))


def _vote(part: _Samples, full: _Samples, share: float) -> tuple[float, float]:
    """Return the corrected share and the support for a tested share (see `estimate_scale`)."""
    rows, matches = _mutually_nearest(part.descriptors, full.descriptors)
    before, angles_before = _pair_features(part, rows)
    after, angles_after = _pair_features(full, matches)
    least, most = _DISTANCES
    compared = (least < before) & (before < most) & (after > 0)
    compared &= np.all(np.abs(angles_before - angles_after) < _ANGLE_TOLERANCE, axis=1)
    ratios = np.sort(np.log(after[compared] / before[compared]))
    if len(ratios) < _FEWEST:
        return share, 0.0
    # Two ratios agree if their logarithms differ by at most the tolerance. `counts` contains the number of
    # ratios that agree with each ratio. The ratio with the largest count is called the most frequent ratio.
    counts = np.searchsorted(ratios, ratios + _TOLERANCE) - np.searchsorted(ratios, ratios - _TOLERANCE)
    counts = np.where(np.abs(ratios) < _FARTHEST, counts, 0)
    near = ratios[np.abs(ratios - ratios[np.argmax(counts)]) < _TOLERANCE]
    return share * float(np.exp(2 * np.mean(near))), 2 * float(counts.max()) / len(rows)


def _pair_features(
    shape: _Samples, rows: Int64[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "q 3"]]:
    """Return the distance and the cosines of the three angles for each pair of samples."""
    first, second = np.triu_indices(len(rows), 1)
    positions, normals = shape.positions[rows], shape.normals[rows]
    lines = positions[second] - positions[first]
    distances = np.linalg.norm(lines, axis=1)
    lines /= np.maximum(distances, np.finfo(float).tiny)[:, None]
    pairs = ((normals[first], normals[second]), (normals[first], lines), (normals[second], lines))
    return distances, np.stack([np.sum(a * b, axis=1) for a, b in pairs], axis=1)


def _mutually_nearest(
    x: Float[np.ndarray, "s d"], y: Float[np.ndarray, "t d"]
) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """Return the rows of x and of y that are mutually nearest neighbours."""
    # All SHOT descriptors have the same norm, so the nearest descriptor has the largest inner product.
    products = x @ y.T
    forward, backward = products.argmax(axis=1), products.argmax(axis=0)
    rows = np.flatnonzero(backward[forward] == np.arange(len(x)))
    return rows, forward[rows]
