"""Transfer of the skeleton of an animated character."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from jaxsmw.geometry.alignment import rigid_fit
from jaxsmw.geometry.surface_distance import nearest_surface_points
from jaxsmw.io.mesh_data import Skeleton, Skin
from jaxsmw.transfer.landmarks import carried_by_space
from jaxsmw.transfer.registered_mesh import RegisteredMesh


def with_moved_skeleton(skin: Skin, registered: RegisteredMesh) -> Skin:
    """Return the skin of X with its skeleton, if it has one, in the pose and the proportions of Y.

    A thin-plate spline of space carries the joints from X to Y, as it does landmarks off the surface. A joint
    turns with the vertices that it moves, by the rigid motion that brings them closest to the registered
    mesh, with their weights. A joint that moves no vertex turns with its parent, or else with the whole body.
    """
    if skin.skeleton is None:
        return skin
    parents, matrices = skin.skeleton
    places = matrices[:, :3, 3]
    feet, _ = nearest_surface_points(places, registered.mesh_x)
    moved = matrices.copy()
    moved[:, :3, 3] = carried_by_space(places, feet, registered)
    areas = registered.mesh_x.vertex_areas
    weights = np.maximum(skin.weights, 0) * areas[:, None]
    for joint in range(len(parents)):
        moving = joint
        while moving >= 0 and not weights[:, moving].any():
            moving = int(parents[moving])
        rotation = _rotation(areas if moving < 0 else weights[:, moving], registered)
        moved[joint, :3, :3] = rotation @ matrices[joint, :3, :3]
    return skin._replace(skeleton=Skeleton(parents, moved))


def _rotation(weights: Float64[np.ndarray, " m"], registered: RegisteredMesh) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation that brings the vertices of X closest to the registered mesh."""
    return rigid_fit(registered.mesh_x.vertices, registered.vertices, weights).rotation
