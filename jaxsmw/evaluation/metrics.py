"""The quality of a pointwise map: geodesic errors, their statistics, and coverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike

from jaxsmw.errors import InputError
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.geometry.geodesics import (
    GeodesicMethod,
    SurfacePoints,
    check_indices,
    check_points,
    geodesic_distances_between,
)
from jaxsmw.geometry.mesh import Mesh

# The thresholds of reported shares and the end of reported curves, in square roots of the target's area.
THRESHOLDS = (0.02, 0.05, 0.1)
LARGEST_THRESHOLD = 0.25


@dataclass(frozen=True, eq=False)
class GeodesicError:
    """The geodesic errors of a map at some points, in square roots of the target's area.

    **Attributes:**

    - `errors`: the error of each evaluated row of the ground truth (p,); inf where the match and the true
      point are on different connected components of the target.
    - `source_vertices`: the vertex of X for each error (p,).
    - `method`: the method that computed the geodesic distances.
    """

    errors: Float64[np.ndarray, " p"]
    source_vertices: Int64[np.ndarray, " p"]
    method: GeodesicMethod

    @property
    def unreachable(self) -> float:
        """The share of points whose match is on another connected component than the true point."""
        return float(np.isinf(self.errors).mean())

    @property
    def mean(self) -> float:
        """The mean error of all points but those that `unreachable` counts; inf if no point is left.

        Report `unreachable` together with this mean.
        """
        reachable = self.errors[np.isfinite(self.errors)]
        return float(reachable.mean()) if len(reachable) else np.inf

    @property
    def median(self) -> float:
        """The median over all points. Unreachable points count with an infinite error."""
        return float(np.median(self.errors))

    @property
    def within(self) -> dict[float, float]:
        """The share of points with an error of at most 0.02, 0.05 and 0.1, by threshold."""
        shares = self.correspondence_quality_curve(np.array(THRESHOLDS))
        return dict(zip(THRESHOLDS, shares.tolist(), strict=True))

    def __str__(self) -> str:
        """The main figures in one line."""
        within = ", ".join(f"{share:.1%} within {threshold}" for threshold, share in self.within.items())
        elsewhere = f"; {self.unreachable:.2%} on another component" if self.unreachable else ""
        return (
            f"mean {self.mean:.5f}, median {self.median:.5f}, {within}, area under the curve "
            f"{self.area_under_curve():.4f} ({len(self.errors)} points, {self.method}{elsewhere})"
        )

    def as_dictionary(self) -> dict[str, Any]:
        """Returns the main figures and the correspondence quality curve as a dictionary for JSON.

        A mean or median that is infinite becomes None. The curve has 251 thresholds from 0 to 0.25.
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
        """Returns the share of points with an error of at most each threshold (Kim et al. 2011).

        **Arguments:**

        - `thresholds`: the thresholds (t,), in square roots of the target's area, in any order.

        **Returns:** The shares (t,), in [0, 1].
        """
        counts = np.searchsorted(np.sort(self.errors), np.asarray(thresholds), side="right")
        return counts / len(self.errors)

    def area_under_curve(self, largest: float = LARGEST_THRESHOLD) -> float:
        """Returns the mean height of the correspondence quality curve between 0 and a largest threshold.

        The curve has a step at each error e, so its mean height is exactly the mean of
        `max(0, 1 - e/largest)`. The value is in [0, 1]; a perfect map has 1.

        **Arguments:**

        - `largest`: the largest threshold, in square roots of the target's area.

        **Raises:** `InputError` if the threshold is not positive.
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
    """Computes the geodesic error of each match: its geodesic distance on Y to the true point.

    Distances are divided by the square root of the target's area (Kim, Lipman and Funkhouser 2011), so errors
    do not depend on the unit of length or the size of a shape.

    **Arguments:**

    - `mesh_y`: the target Y.
    - `pointwise_map`: T: X -> Y (m,), as 0-based vertices of Y or as `SurfacePoints` on Y.
    - `ground_truth`: the true points on Y of some vertices of X.
    - `method`: the method for distances; see `jaxsmw.geometry.geodesics.geodesic_distances`.
    - `number_of_samples`: the number of rows of the ground truth to evaluate, drawn without replacement. By
      default, and if there are fewer rows, all rows are evaluated.
    - `seed`: the seed of the draw.

    **Returns:** A `GeodesicError`.

    **Raises:** `InputError` if the map, the ground truth and the mesh do not fit each other, if the ground
    truth is empty, if `number_of_samples` is less than 1, or if the method `"exact"` is not available.
    """
    images = check_points(pointwise_map, mesh_y, "pointwise map")
    targets = check_points(ground_truth.targets, mesh_y, "ground truth")
    sources = ground_truth.source_vertices
    if len(sources) == 0:
        raise InputError("ground truth: it has no rows: give the true point of at least one source vertex.")
    if not 0 <= sources.min() <= sources.max() < len(images):
        raise InputError(
            f"ground truth: its source vertices are numbered {sources.min()} to {sources.max()}, but the "
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
    """Returns the coverage of a map: the share of the target's area that belongs to matched vertices.

    The coverage is in [0, 1] and needs no ground truth.

    **Arguments:**

    - `mesh_y`: the target Y.
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.

    **Raises:** `InputError` if the map does not fit the mesh.
    """
    image = np.unique(
        check_indices(pointwise_map, len(mesh_y.vertices), f"pointwise map on {mesh_y.name}: vertex")
    )
    return float(mesh_y.vertex_areas[image].sum() / mesh_y.vertex_areas.sum())
