"""How the two shapes of a pair differ besides their deformation: by rotation, scale and triangulation.

Methods differ in what they cope with: some need shapes that face the same way, or of the same scale, and the
errors of others are smaller if both shapes have the same triangulation. All differences are computed from the
meshes and the ground truth. Nothing here imports JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64
from scipy.spatial.transform import Rotation

from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.geometry.geodesics import geodesic_distances_between
from jaxsmw.geometry.mesh import Mesh

# A pair counts as rotated above this angle in degrees, as rescaled beyond this factor, and as re-triangulated
# below this share of kept faces. On the data sets of `docs/datasets.md`, poses alone rotate most bodies by up
# to 45 degrees, and sizes of people and animals differ by up to a fifth. Unrelated triangulations keep up to
# half of the faces, and cuts and edits of one triangulation keep more.
LARGEST_ANGLE, LARGEST_FACTOR, LEAST_KEPT = 45.0, 1.25, 0.5
# The scale is the median of the ratios of this number of distances.
_DISTANCES = 50


class Differences(NamedTuple):
    """The differences between two shapes X and Y, as `compare_shapes` returns them.

    **Attributes:**

    - `angle`: the angle in degrees, from 0 to 180, of the rotation that brings the points of X closest to
      their true points on Y after a translation (Kabsch 1976).
    - `factor`: the scale of Y, if that of X is 1: the median ratio of geodesic distances between the same
      points on Y and on X. Rotations and poses have no influence on geodesic distances.
    - `kept_faces`: the share of faces of X whose corners have the corners of a face of Y as true points. Only
      faces count whose corners all have true points; without such faces, it is 1 if both shapes have the same
      list of faces, and otherwise 0.
    """

    angle: float
    factor: float
    kept_faces: float

    @property
    def rotated(self) -> bool:
        """Whether the angle is above 45 degrees."""
        return self.angle > LARGEST_ANGLE

    @property
    def rescaled(self) -> bool:
        """Whether the factor is above 1.25 or below 1 / 1.25."""
        return not 1 / LARGEST_FACTOR <= self.factor <= LARGEST_FACTOR

    @property
    def retriangulated(self) -> bool:
        """Whether fewer than half of the faces are kept."""
        return self.kept_faces < LEAST_KEPT


def compare_shapes(mesh_x: Mesh, mesh_y: Mesh, ground_truth: GroundTruth) -> Differences:
    """Compute how X and Y differ by rotation, scale and triangulation.

    **Arguments:** `mesh_x`, `mesh_y`, `ground_truth`: the meshes and their `GroundTruth`, as
    `DataPair.read` returns them.

    **Returns:** The `Differences`. The factor is NaN if no distance between two points is finite.
    """
    pairs = ground_truth.vertex_pairs(mesh_y)
    points_x, points_y = mesh_x.vertices[pairs[:, 0]], mesh_y.vertices[pairs[:, 1]]
    rotation, _ = Rotation.align_vectors(points_y - points_y.mean(axis=0), points_x - points_x.mean(axis=0))
    angle = float(np.degrees(rotation.magnitude()))
    return Differences(angle, _factor(mesh_x, mesh_y, pairs), _kept_faces(mesh_x, mesh_y, pairs))


def _factor(mesh_x: Mesh, mesh_y: Mesh, pairs: Int64[np.ndarray, "p 2"]) -> float:
    rows = np.random.default_rng(0).integers(len(pairs), size=(2, _DISTANCES))
    on_x, on_y = (
        geodesic_distances_between(mesh, *vertices[rows])
        for mesh, vertices in zip((mesh_x, mesh_y), pairs.T, strict=True)
    )
    good = np.isfinite(on_x) & np.isfinite(on_y) & (on_x > 0) & (on_y > 0)
    return float(np.median(on_y[good] / on_x[good])) if good.any() else np.nan


def _kept_faces(mesh_x: Mesh, mesh_y: Mesh, pairs: Int64[np.ndarray, "p 2"]) -> float:
    target = np.full(len(mesh_x.vertices), -1)
    target[pairs[:, 0]] = pairs[:, 1]
    images = target[mesh_x.faces]
    images = images[(images >= 0).all(axis=1)]
    if len(images) == 0:
        return float(np.array_equal(mesh_x.faces, mesh_y.faces))
    faces = set(map(tuple, np.sort(mesh_y.faces, axis=1).tolist()))
    return float(np.mean([tuple(image) in faces for image in np.sort(images, axis=1).tolist()]))


def differences_row(differences: Sequence[Differences]) -> list[str]:
    """Return the cells of a table for the numbers of rotated, rescaled and re-triangulated pairs."""
    angle, factor, kept = (np.array(values) for values in zip(*differences, strict=True))
    size = np.nanmedian(np.maximum(factor, 1 / factor))
    count = len(differences)
    rotated, rescaled, retriangulated = (
        sum(getattr(pair, name) for pair in differences) for name in ("rotated", "rescaled", "retriangulated")
    )
    return [
        f"{rotated} of {count} (median {np.median(angle):.0f}°)",
        f"{rescaled} of {count} (median factor {size:.2f})",
        f"{retriangulated} of {count} (median {100 * np.median(kept):.0f} % of faces kept)",
    ]
