"""Transfer of landmarks from the source to the target."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.geometry.surface_distance import bounding_box_diagonal, nearest_surface_points
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.io.landmarks import Landmarks, check_frame
from jaxsmw.transfer.registered_mesh import RegisteredMesh

# The number of points of X that determine the deformation of space, and the smallest distance between two of
# them, in units of the diagonal of the box around X.
_CENTERS, _APART = 1000, 1e-6


@dataclass(frozen=True, eq=False)
class TransferredLandmarks:
    """The result of `transfer_landmarks`: l landmarks on the target.

    **Attributes:**

    - `landmarks`: the `Landmarks` on the surface of Y, or near it if `off_surface` was True, in the unit of
      Y. The names of the coordinate system and of the unit are those of the given landmarks. They are
      correct only if X and Y have the same ones.
    - `source_distances`: the distance from each landmark on X to the surface of X (l,), in the unit of X.
    - `expected_errors`: the expected error of each landmark on Y (l,), in the unit of Y; None if no expected
      errors were given.
    - `notes`: a sentence for each landmark that was far from the surface of X.
    """

    landmarks: Landmarks
    source_distances: Float64[np.ndarray, " l"]
    expected_errors: Float64[np.ndarray, " l"] | None
    notes: tuple[str, ...] = ()


def transfer_landmarks(
    landmarks: Landmarks,
    registered: RegisteredMesh,
    *,
    expected_error: Float64[np.ndarray, " m"] | None = None,
    off_surface: bool = False,
) -> TransferredLandmarks:
    """Move landmarks from X to Y.

    Each landmark is projected onto X, moves with its triangle to the registered mesh, and is projected onto
    Y. If `off_surface` is True, a thin-plate spline of space moves the landmarks instead (Bookstein 1989),
    and a landmark inside X stays inside. The spline takes points that are spread evenly over X, and the
    projections of the landmarks onto X, to their images on Y.

    **Arguments:**

    - `landmarks`: `Landmarks` with l landmarks on X, in the unit and the coordinate system of X.
    - `registered`: the `RegisteredMesh` of X on Y.
    - `expected_error`: the expected error of each vertex of X (m,), divided by the square root of Y's area;
      see `Correspondence.expected_error`. The positions do not depend on this argument. The expected error of
      a landmark off the surface is that of its projection.
    - `off_surface`: True if landmarks lie off the surface on purpose, for example inside a skull.

    **Raises:** `InputError` if `expected_error` does not contain one number for each vertex of X, or if
    `jaxsmw.io.check_frame` finds that the landmarks are too far from the surface of X.
    """
    mesh_x, mesh_y = registered.mesh_x, registered.mesh_y
    if expected_error is not None and expected_error.shape != (len(mesh_x.vertices),):
        raise InputError(
            f"{mesh_x.name}: there are expected errors of shape {expected_error.shape} for "
            f"{len(mesh_x.vertices)} vertices: give one for each vertex."
        )
    notes = () if off_surface else check_frame(landmarks, mesh_x)
    points, distances = nearest_surface_points(landmarks.positions, mesh_x)
    if not off_surface:
        images = registered.project(points).positions(mesh_y)
    else:
        _check_near(landmarks, distances, mesh_x)
        images = carried_by_space(landmarks.positions, points, registered)
    errors = None
    if expected_error is not None:
        at_corners = expected_error[mesh_x.faces[points.faces]]
        errors = np.sqrt(mesh_y.area) * (points.weights * at_corners).sum(axis=1)
    moved = replace(landmarks, positions=images, name=f"landmarks on {mesh_y.name}", notes=())
    return TransferredLandmarks(moved, distances, errors, notes)


def _check_near(landmarks: Landmarks, distances: Float64[np.ndarray, " l"], mesh: Mesh) -> None:
    """Refuse landmarks that are farther from a mesh than the mesh is large."""
    diagonal, farthest = bounding_box_diagonal(mesh), int(distances.argmax())
    if distances[farthest] > diagonal:
        raise InputError(
            f"{landmarks.name}: the landmark {landmarks.names[farthest]!a} is {distances[farthest]:.3g} from "
            f"the surface of {mesh.name}, whose diagonal is {diagonal:.3g}: give landmarks of this mesh, in "
            "its unit and coordinates."
        )


def carried_by_space(
    positions: Float64[np.ndarray, "l 3"], feet: SurfacePoints, registered: RegisteredMesh
) -> Float64[np.ndarray, "l 3"]:
    """Move points by the thin-plate spline that takes X, and the projections of the points, to Y.

    **Arguments:**

    - `positions`: points near X (l, 3).
    - `feet`: the projections of the points onto X.
    - `registered`: the `RegisteredMesh` of X on Y.
    """
    from scipy.interpolate import RBFInterpolator  # 0.1 s, which only points off the surface need

    mesh_x = registered.mesh_x
    chosen = farthest_point_samples(mesh_x, min(_CENTERS, len(mesh_x.referenced_indices)))
    centers = np.concatenate([feet.positions(mesh_x), mesh_x.vertices[chosen]])
    images = registered.project(feet).positions(registered.mesh_y)
    values = np.concatenate([images, registered.vertices[chosen]])
    # Centres that nearly coincide would make the system singular.
    size = _APART * bounding_box_diagonal(mesh_x)
    _, kept = np.unique(np.rint(centers / size), axis=0, return_index=True)
    # In three dimensions, the kernel of the thin-plate spline is the distance. Points of a flat mesh do not
    # determine an affine map of space.
    offsets = centers[kept] - centers[kept].mean(axis=0)
    degree = int(np.linalg.matrix_rank(offsets, tol=size * len(kept) ** 0.5) == 3)
    return RBFInterpolator(centers[kept], values[kept], kernel="linear", degree=degree)(positions)


def landmark_vertices(
    landmarks_x: Landmarks, landmarks_y: Landmarks, mesh_x: Mesh, mesh_y: Mesh
) -> Int64[np.ndarray, "l 2"]:
    """Convert landmarks with equal names to pairs of vertices, which `match` accepts as the initial map.

    Both `Landmarks` have the same l names in the same order. Each landmark is projected onto the nearest
    face. Its vertex is the corner of this face that is nearest to the projection. The function issues a
    `UserWarning` for each landmark that is far from its surface.

    **Returns:** An array (l, 2) with one vertex of X and one vertex of Y for each landmark, 0-based.

    **Raises:** `InputError` if `jaxsmw.io.check_frame` finds that the landmarks are too far from a surface,
    or if two landmarks have the same vertex of X, but different vertices of Y.
    """
    pairs = []
    for landmarks, mesh in ((landmarks_x, mesh_x), (landmarks_y, mesh_y)):
        for far in check_frame(landmarks, mesh):
            warnings.warn(far, stacklevel=2)
        points, _ = nearest_surface_points(landmarks.positions, mesh)
        pairs.append(points.nearest_corners(mesh))
    matches, first = np.unique(np.stack(pairs, axis=1), axis=0, return_index=True)
    conflicts = np.flatnonzero(np.diff(matches[:, 0]) == 0)
    if len(conflicts):
        one, other = (landmarks_x.names[first[row]] for row in (conflicts[0], conflicts[0] + 1))
        raise InputError(
            f"{landmarks_x.name}: the landmarks {one!a} and {other!a} have the same nearest vertex of "
            f"{mesh_x.name}: remove one of them."
        )
    return np.stack(pairs, axis=1)
