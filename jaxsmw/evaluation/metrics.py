"""Measures of the quality of a map: geodesic errors, their statistics, coverage, and predicted overlaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike

from jaxsmw.errors import InputError
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.geometry.geodesics import GeodesicMethod, geodesic_distances_between
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints, check_indices, check_points

# Reports contain, for each of `THRESHOLDS`, the share of points with at most this error. Reported
# correspondence quality curves end at `LARGEST_THRESHOLD`. Thresholds are in units of the square root of the
# target's area.
THRESHOLDS = (0.02, 0.05, 0.1)
LARGEST_THRESHOLD = 0.25


@dataclass(frozen=True, eq=False)
class GeodesicError:
    """The geodesic errors of a pointwise map X -> Y, as `geodesic_error` returns them.

    All errors and thresholds are in units of the square root of the area of Y.

    **Attributes:**

    - `errors`: the errors (p,), float64, one for each evaluated row of the ground truth. An error is inf if
      the match and the true point are on different connected components of Y.
    - `source_vertices`: the vertex of X at which each error was measured (p,), int64, 0-based.
    - `method`: the method that computed the geodesic distances, `"strips"` or `"exact"`.
    """

    errors: Float64[np.ndarray, " p"]
    source_vertices: Int64[np.ndarray, " p"]
    method: GeodesicMethod

    @property
    def unreachable(self) -> float:
        """The share of points whose match and true point are on different connected components of Y."""
        return float(np.isinf(self.errors).mean())

    @property
    def mean(self) -> float:
        """The mean of all finite errors; inf if no error is finite. The others are `unreachable`."""
        reachable = self.errors[np.isfinite(self.errors)]
        return float(reachable.mean()) if len(reachable) else np.inf

    @property
    def median(self) -> float:
        """The median of all errors, including the infinite errors that `mean` leaves out."""
        return float(np.median(self.errors))

    @property
    def within(self) -> dict[float, float]:
        """A dictionary from each threshold (0.02, 0.05, 0.1) to the share of points within this error."""
        shares = self.correspondence_quality_curve(np.array(THRESHOLDS))
        return dict(zip(THRESHOLDS, shares.tolist(), strict=True))

    def __str__(self) -> str:
        """The main statistics of the errors, as one line of text."""
        within = ", ".join(f"{share:.1%} within {threshold}" for threshold, share in self.within.items())
        elsewhere = f"; {self.unreachable:.2%} on another component" if self.unreachable else ""
        return (
            f"mean {self.mean:.5f}, median {self.median:.5f}, {within}, area under the curve "
            f"{self.area_under_curve():.4f} ({len(self.errors)} points, {self.method}{elsewhere})"
        )

    def as_dictionary(self) -> dict[str, Any]:
        """Return the main statistics and the correspondence quality curve as a dictionary for JSON.

        An infinite mean or median becomes None. `points` is the number of errors. `curve` contains the lists
        `thresholds` (251 numbers from 0 to 0.25) and `shares`.
        """
        thresholds = np.linspace(0, LARGEST_THRESHOLD, 251)
        return {
            "mean": self.mean if np.isfinite(self.mean) else None,
            "median": self.median if np.isfinite(self.median) else None,
            "within": {str(threshold): share for threshold, share in self.within.items()},
            "area_under_curve": self.area_under_curve(),
            "unreachable": self.unreachable,
            "points": len(self.errors),
            "method": self.method,
            "curve": {
                "thresholds": thresholds.tolist(),
                "shares": self.correspondence_quality_curve(thresholds).tolist(),
            },
        }

    def correspondence_quality_curve(self, thresholds: ArrayLike) -> Float64[np.ndarray, " t"]:
        """Return the share of points with at most this error for each threshold (t,) (Kim et al. 2011)."""
        counts = np.searchsorted(np.sort(self.errors), np.asarray(thresholds), side="right")
        return counts / len(self.errors)

    def area_under_curve(self, largest: float = LARGEST_THRESHOLD) -> float:
        """Return the mean height of the correspondence quality curve between the thresholds 0 and `largest`.

        The curve has a step at each error e, so its mean height is the mean of `max(0, 1 - e/largest)`. It is
        in [0, 1], and is 1 if all errors are zero.

        **Raises:** `InputError` if `largest` is not positive.
        """
        if not largest > 0:
            raise InputError(f"the largest threshold is {largest}: give a positive number.")
        return float(np.maximum(0, 1 - self.errors / largest).mean())


def geodesic_error(
    mesh_y: Mesh,
    pointwise_map: ArrayLike | SurfacePoints,
    ground_truth: GroundTruth,
    *,
    method: GeodesicMethod = "strips",
    number_of_samples: int | None = None,
    seed: int = 0,
) -> GeodesicError:
    """Compute the geodesic error of each match: the geodesic distance on Y from the match to the true point.

    Distances are divided by the square root of the area of Y (Kim, Lipman and Funkhouser 2011).

    **Arguments:**

    - `mesh_y`: the target Y, a `Mesh` with n vertices.
    - `pointwise_map`: T: X -> Y (m,), as 0-based vertices of Y or as `SurfacePoints` on Y.
    - `ground_truth`: the `GroundTruth` of X and Y, with the true points on Y of some or all vertices of X.
    - `method`: the method that computes geodesic distances. `"strips"` (the default) finds shortest paths
      that consist of edges and of straight lines across faces. On meshes of bodies, these paths are 0.03 to
      0.07 % too long on average. `"exact"` takes about 100 times as long, and works only between vertices of
      a manifold mesh.
    - `number_of_samples`: the number of rows of the ground truth to evaluate, at least 1. These rows are
      drawn at random without replacement. If None (the default), or if the ground truth has fewer rows, all
      rows are evaluated.
    - `seed`: the seed of the random draw.

    **Returns:** A `GeodesicError` with one error for each evaluated row of the ground truth.

    **Raises:** `InputError` if the map or the ground truth contains a vertex or face that Y does not have; if
    the map has no entry for a vertex of X in the ground truth; if the ground truth is empty; if
    `number_of_samples` is less than 1; or if `"exact"` cannot be used (see
    `jaxsmw.geometry.geodesic_distances`).
    """
    images = check_points(pointwise_map, mesh_y, "pointwise map")
    targets = check_points(ground_truth.targets, mesh_y, "ground truth")
    sources = ground_truth.source_vertices
    if len(sources) == 0:
        raise InputError("the ground truth has no rows: give the true point of at least one source vertex.")
    if not 0 <= sources.min() <= sources.max() < len(images):
        raise InputError(
            f"ground truth: the source vertices are numbered {sources.min()} to {sources.max()}, but the "
            f"pointwise map has {len(images)} entries: give the map and the ground truth of the same source "
            "mesh."
        )
    if number_of_samples is not None:
        if number_of_samples < 1:
            raise InputError(f"{number_of_samples} samples cannot be evaluated: give at least 1.")
        rows = np.random.default_rng(seed).permutation(len(sources))[:number_of_samples]
        sources, targets = sources[rows], targets[rows]
    distances = geodesic_distances_between(mesh_y, images[sources], targets, method=method)
    return GeodesicError(distances / np.sqrt(mesh_y.area), sources, method)


def coverage(mesh_y: Mesh, pointwise_map: ArrayLike) -> float:
    """Return the coverage of a pointwise map: the share of the area of Y that belongs to matched vertices.

    **Arguments:**

    - `mesh_y`: the target Y, a `Mesh`.
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.

    **Raises:** `InputError` if an entry of the map is not a vertex of Y.
    """
    image = check_indices(pointwise_map, len(mesh_y.vertices), f"pointwise map on {mesh_y.name}: vertex")
    matched = np.zeros(len(mesh_y.vertices), bool)
    matched[image] = True
    return float(mesh_y.average(matched))


class OverlapScores(NamedTuple):
    """Two measures of the quality of a predicted overlap, as `overlap_scores` returns them.

    Vertices count equally, whatever their area.

    **Attributes:**

    - `intersection_over_union`: the number of vertices in both masks, divided by the number of vertices in at
      least one mask. It is 1 if both masks are empty.
    - `balanced_accuracy`: the mean of two shares: of the vertices in the true overlap, the share that is in
      the predicted overlap, and of the other vertices, the share that is not. If one of these sets is empty,
      the other share alone.
    """

    intersection_over_union: float
    balanced_accuracy: float


def overlap_scores(predicted: ArrayLike, true: ArrayLike) -> OverlapScores:
    """Compare a predicted overlap with the true overlap on one of two partial shapes.

    **Arguments:**

    - `predicted`, `true`: Boolean masks of the vertices (n,), True for vertices with a counterpart on the
      other shape. `Correspondence.overlap` predicts such masks.

    **Returns:** An `OverlapScores`.

    **Raises:** `InputError` if the masks are not Boolean, are empty or differ in length.
    """
    predicted, true = np.asarray(predicted), np.asarray(true)
    fit = predicted.shape == true.shape and true.ndim == 1 and len(true) > 0
    if not fit or {predicted.dtype, true.dtype} != {np.dtype(bool)}:
        raise InputError(
            f"overlap: the masks have the shapes {predicted.shape} and {true.shape} and the types "
            f"{predicted.dtype} and {true.dtype}: give two Boolean masks of the vertices of one mesh."
        )
    union = np.count_nonzero(predicted | true)
    shares = [np.mean(predicted[true == side] == side) for side in (True, False) if side in true]
    return OverlapScores(np.count_nonzero(predicted & true) / union if union else 1.0, float(np.mean(shares)))
