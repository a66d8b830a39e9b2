"""Transfer of the skeleton of an animated character."""

from __future__ import annotations

import numpy as np

from jaxsmw.geometry.alignment import rigid_fit
from jaxsmw.geometry.arrays import ratio
from jaxsmw.geometry.surface_distance import nearest_surface_points
from jaxsmw.io.mesh_data import Skeleton, Skin
from jaxsmw.transfer.landmarks import carried_by_space
from jaxsmw.transfer.registered_mesh import RegisteredMesh

# The share of the vertices of the parent among those with which a joint turns. It decides only if the
# vertices of the joint determine no rotation.
_ABOVE = 1e-4


def with_moved_skeleton(skin: Skin, registered: RegisteredMesh) -> Skin:
    """Return the skin of X with its skeleton, if it has one, in the pose and the proportions of Y.

    A thin-plate spline of space carries the joints from X to Y, as it does landmarks off the surface. A joint
    turns with the vertices that it moves, by the rigid motion that brings them closest to the registered
    mesh, with their weights. A joint that moves no vertices, or vertices in one place, turns with its parent.
    """
    if skin.skeleton is None:
        return skin
    mesh_x, (parents, matrices) = registered.mesh_x, skin.skeleton
    places = matrices[:, :3, 3]
    feet, _ = nearest_surface_points(places, mesh_x)
    moved = matrices.copy()
    moved[:, :3, 3] = carried_by_space(places, feet, registered)
    own = np.maximum(skin.weights, 0) * mesh_x.vertex_areas[:, None]
    weights = ratio(own, own.sum(axis=0))
    pending = np.flatnonzero(parents < 0).tolist()
    for joint in pending:  # parents before children
        above = mesh_x.vertex_areas / mesh_x.area if parents[joint] < 0 else weights[:, parents[joint]]
        weights[:, joint] += _ABOVE * above
        rotation = rigid_fit(mesh_x.vertices, registered.vertices, weights[:, joint]).rotation
        moved[joint, :3, :3] = rotation @ matrices[joint, :3, :3]
        weights[:, joint] /= weights[:, joint].sum()
        pending += np.flatnonzero(parents == joint).tolist()
    return skin._replace(skeleton=Skeleton(parents, moved))
