"""Fits one sampled shape to another one of which it may be only a part, by locally rigid motions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.geometry.alignment import NORMAL_WEIGHT, PatchMotions, oriented_points, patch_motions
from jaxsmw.geometry.currents import Oriented, overlapping_alignments
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.matching.search.proxies import Proxy
from jaxsmw.runtime.threads import side_by_side

# The number of samples that are moved, of rigid motions, of fits that go on, and of resulting fits.
_MOVED, _MOTIONS, _CONTINUED, _FITS = 400, 40, 14, 4
# The numbers of motions and of fits that go on if only the scale is wanted, and the factors that are tried.
_FEW_MOTIONS, _FEW_CONTINUED = 16, 5
_FACTORS = (0.7, 0.83, 1.0, 1.2, 1.44)
# The radii of the patches that move rigidly, in units of the square root of the area: first in rough fits of
# all motions, then in the fits that go on. An infinite radius moves the shape as a whole.
_ROUGH = (np.inf, np.inf, np.inf, np.inf, 0.6, 0.6)
_FINE = (0.6, 0.4, 0.4, 0.4, 0.3, 0.3, 0.3, 0.2, 0.2, 0.2, 0.15, 0.15, 0.15)
# The radius of the patches whose deformation is judged.
_JUDGED = 0.2
# Matches have a weight that falls with their distance. The tolerance falls from the first number by this
# factor in each iteration, down to the last number.
_TOLERANCES = np.maximum(0.15 * 0.88 ** np.arange(len(_ROUGH) + len(_FINE)), 0.05)
# The weight of a match at a boundary, where parts without a counterpart gather, and of the present position.
_AT_BOUNDARY, _PRESENT = 0.1, 0.03
# This number is added to the two terms of the cost of a fit.
_LEAST = 0.01
# Two rough fits are different if the root mean square distance between their positions is larger, and two
# fits if more than this share of the area has matches farther apart than that distance.
_DIFFERENT_ROUGH, _DIFFERENT_AREA, _FAR = 0.05, 0.05, 0.2


class Fit(NamedTuple):
    """Moved positions and normals of all samples of the moved shape (s, 3), and the cost of the fit."""

    positions: Float[np.ndarray, "s 3"]
    normals: Float[np.ndarray, "s 3"]
    cost: float

    @property
    def features(self) -> Float[np.ndarray, "s 6"]:
        """The coordinates in which nearest points are matched."""
        return oriented_points(self.positions, self.normals)


def fits(moving: Proxy, fixed: Proxy, *, thorough: bool = True) -> Iterator[Fit]:
    """Yield different fits of a shape to another one, of which it may be a part, those of least cost first.

    The fits start from rigid motions with large overlap (`overlapping_alignments`). In each iteration, every
    patch of the shape moves rigidly towards the nearest points of the other shape, and each sample follows
    the mean motion of the patches around it. The patches shrink, so the shape first moves as a whole, and
    then bends at its joints. Matches at a boundary hardly count, because parts without a counterpart gather
    there (Turk, Levoy, "Zippered polygon meshes from range images", 1994).

    **Arguments:**

    - `moving`, `fixed`: the proxies of both shapes, in the same unit of length.
    - `thorough`: whether many motions are tried, or only a few.
    """
    fitting = _Fitting(moving, fixed)
    target = Oriented(fixed.positions, fixed.normals, fixed.areas)
    surface = Oriented(fitting.positions, fitting.normals, fitting.areas)
    number, continued = (_MOTIONS, _CONTINUED) if thorough else (_FEW_MOTIONS, _FEW_CONTINUED)
    motions = overlapping_alignments(surface, target, number, dense=thorough)
    starts = (surface.moved(motion)[:2] for motion in motions)
    rough = sorted((fitting.run(start, _ROUGH, 0) for start in starts), key=lambda fit: fit.cost)
    kept: list[Fit] = []
    for fit in rough:
        squares = (((fit.positions - other.positions) ** 2).sum(axis=1).mean() for other in kept)
        if len(kept) < continued and all(square > _DIFFERENT_ROUGH**2 for square in squares):
            kept.append(fit)
    fine = [fitting.run((fit.positions, fit.normals), _FINE, len(_ROUGH)) for fit in kept]
    yielded: list[Int64[np.ndarray, " s"]] = []
    for fit in sorted(fine, key=lambda fit: fit.cost):
        matches = fitting.nearest(fit)[0]
        apart = (fitting.areas @ (fixed.distances[matches, other] > _FAR) for other in yielded)
        if len(yielded) < _FITS and all(share > _DIFFERENT_AREA * fitting.areas.sum() for share in apart):
            yielded.append(matches)
            yield fitting.everywhere(fit)


def fitted_scale(pairs: Sequence[tuple[Proxy, Proxy, float]]) -> float:
    """Return the factor by which lengths on parts are multiplied, so that the parts fit their whole shapes.

    The factor minimises the sum of the costs of the best fits of all parts, with few motions, over
    `_FACTORS`. A parabola through the least cost and its two neighbours gives the factor more exactly.

    **Arguments:**

    - `pairs`: for each part, its proxy, the proxy of the whole shape, and an estimate of the factor, by which
      `_FACTORS` are multiplied. Both proxies are in the coordinates of their meshes.

    **Returns:** The factor relative to the estimates.
    """

    def cost(factor: float) -> float:
        total = 0.0
        for part, whole, estimate in pairs:
            unit = whole.mesh.area**0.5
            sides = part.in_unit(unit / (estimate * factor)), whole.in_unit(unit)
            total += next(iter(fits(*sides, thorough=False))).cost
        return total

    costs = np.array(side_by_side(cost, *_FACTORS))
    best = int(np.clip(costs.argmin(), 1, len(costs) - 2))
    logarithms = np.log(_FACTORS)
    curvature, slope, _ = np.polyfit(logarithms[best - 1 : best + 2], costs[best - 1 : best + 2], 2)
    if curvature <= 0:
        return float(_FACTORS[costs.argmin()])
    return float(np.exp(np.clip(-slope / (2 * curvature), logarithms[best - 1], logarithms[best + 1])))


class _Fitting:
    """The moved samples of a shape, and the points to which they move."""

    def __init__(self, moving: Proxy, fixed: Proxy) -> None:
        among, vertices = moving.samples.vertices, moving.samples.vertices
        if len(among) > _MOVED:
            vertices = farthest_point_samples(moving.mesh, _MOVED, among)
        self.rows = np.searchsorted(among, np.sort(vertices))
        self.moving, self.fixed = moving, fixed
        self.positions, self.normals = moving.positions[self.rows], moving.normals[self.rows]
        nearest = moving.distances[:, self.rows].argmin(axis=1)
        areas, self.fixed_areas = (side.areas * side.mesh.area / side.unit**2 for side in (moving, fixed))
        self.areas = np.bincount(nearest, areas, len(self.rows))
        self.on_boundary = np.bincount(nearest, moving.on_boundary, len(self.rows)) > 0
        self.features = oriented_points(fixed.positions, fixed.normals)
        self.fixed_features = self.features.astype(np.float32)
        among_moved = moving.distances[np.ix_(self.rows, self.rows)]
        self.patches = {radius: _patches(among_moved, self.areas, radius) for radius in {*_ROUGH, *_FINE}}
        self.around_all = _patches(moving.distances[:, self.rows], self.areas, _FINE[-1])

    def nearest(self, fit: Fit) -> tuple[Int64[np.ndarray, " s"], Int64[np.ndarray, " t"]]:
        """Return the nearest fixed point of each moved point, and vice versa."""
        # In single precision, a matrix product takes less time than a tree of so few points.
        moved = fit.features.astype(np.float32)
        products = moved @ self.fixed_features.T
        lengths, fixed_lengths = (0.5 * np.sum(rows**2, axis=1) for rows in (moved, self.fixed_features))
        return (products - fixed_lengths).argmax(axis=1), (products - lengths[:, None]).argmax(axis=0)

    def run(
        self,
        start: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
        radii: Sequence[float],
        first: int,
    ) -> Fit:
        """Run one iteration for each radius, and measure the cost."""
        fit = Fit(*start, np.inf)
        for number, radius in enumerate(radii, first):
            motions = self._motions(fit, radius, _TOLERANCES[number])
            fit = _moved(motions, self.patches[radius], self.positions, self.normals)
        return fit._replace(cost=self._cost(fit))

    def everywhere(self, fit: Fit) -> Fit:
        """Return the fit of all samples of the moving shape."""
        motions = self._motions(fit, _FINE[-1], _TOLERANCES[-1])
        moving = self.moving
        return _moved(motions, self.around_all, moving.positions, moving.normals)._replace(cost=fit.cost)

    def _motions(self, fit: Fit, radius: float, tolerance: float) -> PatchMotions:
        """Return the rigid motion of each patch, from the given positions towards the matches."""
        features, size = fit.features, len(self.rows)
        matches, matches_back = self.nearest(fit)
        far = np.linalg.norm(features - self.features[matches], axis=1)
        far_back = np.linalg.norm(features[matches_back] - self.features, axis=1)
        weights = self.areas * _weights(far, tolerance, self.fixed.on_boundary[matches])
        back = self.fixed_areas * _weights(far_back, tolerance, self.on_boundary[matches_back])
        present = _PRESENT * self.areas
        total = weights + np.bincount(matches_back, back, size) + present
        pulled = (weights[:, None] * self.features[matches] + present[:, None] * features).T
        pulled += [np.bincount(matches_back, back * column, size) for column in self.features.T]
        goals = (pulled / total).T
        shares = self.patches[radius] * (total / self.areas)
        shares /= shares.sum(axis=1, keepdims=True)
        return patch_motions(shares, self.positions, self.normals, goals[:, :3], goals[:, 3:] / NORMAL_WEIGHT)

    def _cost(self, fit: Fit) -> float:
        """Return the logarithms of the mean deformation of patches and of the mean distance, added."""
        matches, _ = self.nearest(fit)
        far = np.linalg.norm(fit.features - self.features[matches], axis=1)
        shares = self.areas / self.areas.sum()
        goals = self.fixed.positions[matches], self.fixed.normals[matches]
        motions = patch_motions(self.patches[_JUDGED], self.positions, self.normals, *goals)
        distance = shares @ np.minimum(far, _FAR)
        return float(np.log(shares @ motions.deformations + _LEAST) + np.log(distance + _LEAST))


def _moved(
    motions: PatchMotions,
    patches: Float[np.ndarray, "s p"],
    positions: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
) -> Fit:
    """Move each point by the mean motion of the patches around it."""
    means = patches @ np.hstack([motions.rotations.reshape(-1, 9), motions.offsets])
    turns = means[:, :9].reshape(-1, 3, 3)
    moved = np.einsum("sab,sb->sa", turns, positions) + means[:, 9:]
    turned = np.einsum("sab,sb->sa", turns, normals)
    lengths = np.linalg.norm(turned, axis=1, keepdims=True)
    return Fit(moved, turned / np.maximum(lengths, np.finfo(float).tiny), np.inf)


def _patches(
    distances: Float[np.ndarray, "s p"], areas: Float[np.ndarray, " p"], radius: float
) -> Float[np.ndarray, "s p"]:
    """Return weights that fall with the distance, and vanish beyond 1.5 radii. Each row has the sum 1."""
    weights = areas * np.exp(-0.5 * (distances / (radius / 1.5)) ** 2) * (distances < 1.5 * radius)
    return weights / weights.sum(axis=1, keepdims=True)


def _weights(
    far: Float[np.ndarray, " s"], tolerance: float, at_boundary: Bool[np.ndarray, " s"]
) -> Float[np.ndarray, " s"]:
    """Return the weights of matches at the given distances."""
    return np.exp(-0.5 * (far / tolerance) ** 2) * np.where(at_boundary, _AT_BOUNDARY, 1.0)
