"""Turns meshes upright, scales them for pictures, and guesses which axis of a mesh file points up."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.choices import Axis
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.alignment import rigid_fit
from jaxsmw.geometry.mesh import Mesh

# A dictionary from each axis to the rotation that makes this axis of a file point up. In files with y up,
# bodies face +z. In files with z up, bodies face -y. In both cases, bodies face +z after the rotation.
_STAND = {
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "-y": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}

# The usual conventions of files: y points up in computer graphics, z points up in engineering, and y points
# down in computer vision.
_CONVENTIONS: tuple[Axis, ...] = ("y", "z", "-y")
# A body is slender along y if its spread along z is at most this multiple of its spread along y. For standing
# people in y-up files, the spread along z is at most 0.42 times the spread along y. For animals in z-up
# files, the spread along z is at least 0.47 times the spread along y. The only exceptions are two animals
# that leap or crouch.
_SLENDER = 0.45
# The number that is added to the score of the usual axis (see `guess_up`). For people who stand on one foot
# with raised arms, an upside-down axis scores up to 0.18 higher than the correct axis. For bodies that sit or
# leap, a wrong axis scores up to 0.09 higher than the correct axis.
_HEAD_START_IF_SLENDER, _HEAD_START = 0.25, 0.1
_STABILITY_WEIGHT = 0.25
# Stability is clipped to this range, in units of the square root of the area. Outside of the range, stability
# does not show which axis is correct.
_STABILITY_RANGE = (-0.2, 0.1)
# A point is treated as touching the ground if its height above the lowest point is at most this share of the
# body's height.
_CONTACT = 0.1
_DIRECTIONS = 32
# `_CELL` is the side length of the grid cells in which vertices are merged. The vertices of a body are in
# about 1500 cells. Limbs up to the length `_SHORTEST_LIMB` are ignored as noise. Both lengths are in units of
# the square root of the area.
_CELL, _SHORTEST_LIMB = 1 / 30, 0.05

# A shape is treated as partial if its area is between these multiples of the area of the other shape.
_SMALLEST_PART, _LARGEST_PART = 1 / 16, 0.6
# Two shapes are nearly rigid copies of each other, such as two jaws, if their root mean square distance after
# alignment is at most _RIGID, in units of the square root of the area. X is turned like Y if this divides the
# distance by at least _MUCH_NEARER.
_RIGID, _MUCH_NEARER = 0.15, 2.0


def stand(mesh: Mesh, up: Axis | None = None) -> Mesh:
    """Turn a mesh upright, scale it to area 1, and centre its bounding box on the origin.

    Faces are reoriented such that their normals point outward. The numbering of the vertices does not change.
    In the result, y points up. If the file follows one of the usual conventions (y up, z up or y down), x
    runs across the body, and z points forward. `up` is the axis of the file that points up, such as `"y"` or
    `"-z"`; by default the result of `guess_up`.

    **Raises:** `InputError` if the mesh has no area or `up` is not an axis.
    """
    mesh = _outward(mesh)
    if up is None:
        up = _guess_up(mesh)
    else:
        check_choice(up, Axis, "an axis")
    vertices = mesh.vertices @ np.array(_STAND[up], dtype=float).T / np.sqrt(mesh.area)
    return replace(mesh, vertices=_centered(vertices, mesh))


def _outward(mesh: Mesh) -> Mesh:
    """Return the mesh with outward normals: on average, the normals of a patch point away from its centre."""
    if not mesh.area > 0:
        raise InputError(
            f"{mesh.name}: there is nothing to draw because the faces have no area; give a surface."
        )
    faces, patches = igl.bfs_orient(mesh.faces)
    faces, _ = igl.orient_outward(mesh.vertices, faces, patches[:, None])
    return replace(mesh, faces=faces.astype(np.int64))


def facing(mesh: Mesh) -> Float64[np.ndarray, " 3"]:
    """Return the direction that the outside of an open surface faces: the mean of its outward normals.

    For example, the result for a mask is the direction of the nose, with a length near 0.6. The result for a
    closed surface is 0.
    """
    return mesh.area_vectors.sum(axis=0) / (2 * mesh.area)


def stand_pair(
    mesh_x: Mesh, mesh_y: Mesh, up: Axis | None = None, pointwise_map: Int64[np.ndarray, " m"] | None = None
) -> tuple[Mesh, Mesh]:
    """Turn both meshes upright, and scale them for a common picture; see `stand`.

    Y is scaled to area 1. The scale of X depends on the ratio of the smaller area to the larger area. If the
    ratio is between 1/16 and 0.6, one of the shapes seems to be partial, and X keeps its size relative to Y.
    Otherwise X is also scaled to area 1. A ratio above 0.6 suggests two full shapes, and a ratio below 1/16
    suggests different units of length.

    If a map T: X -> Y (m,) shows that both shapes are nearly rigid copies, such as two jaws, X is turned like
    Y, unless `up` is given.

    **Raises:** `InputError` if a mesh has no area, or if `up` is not an axis.
    """
    standing_x, standing_y = stand(mesh_x, up), stand(mesh_y, up)
    ratio = mesh_x.area / mesh_y.area
    if _SMALLEST_PART < min(ratio, 1 / ratio) < _LARGEST_PART:
        standing_x = replace(standing_x, vertices=np.sqrt(ratio) * standing_x.vertices)
    if up is None and pointwise_map is not None:
        standing_x = _turned_like(standing_x, standing_y.vertices[pointwise_map])
    return standing_x, standing_y


def _turned_like(mesh: Mesh, matches: Float64[np.ndarray, "m 3"]) -> Mesh:
    """Turn a mesh by the rotation that aligns it with its matches, if the mesh is nearly a rigid copy."""
    share = mesh.vertex_areas / mesh.area
    turned = rigid_fit(mesh.vertices, matches, share).apply(mesh.vertices)

    def distance(positions: Float64[np.ndarray, "m 3"]) -> float:
        offsets = positions - matches
        return float(np.sqrt(share @ ((offsets - share @ offsets) ** 2).sum(axis=1)))

    if distance(turned) > min(_RIGID, distance(mesh.vertices) / _MUCH_NEARER):
        return mesh
    return replace(mesh, vertices=_centered(turned, mesh))


def _centered(positions: Float64[np.ndarray, "n 3"], mesh: Mesh) -> Float64[np.ndarray, "n 3"]:
    """Move new positions of a mesh such that the middle of the bounding box is the origin."""
    used = visible(mesh, positions)
    return positions - (used.min(axis=0) + used.max(axis=0)) / 2


def visible(mesh: Mesh, values: Float64[np.ndarray, "n ..."] | None = None) -> Float64[np.ndarray, "_ ..."]:
    """Return the positions, or other values, of the vertices that faces use. Pictures show only these."""
    return (mesh.vertices if values is None else values)[mesh.referenced_vertices]


def placement(mesh: Mesh, standing: Mesh) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """Return the similarity transformation from a mesh of `stand` or `stand_pair` back to its file.

    The transformation is `file = standing @ matrix + offset`. The matrix (3, 3) is a rotation times the
    scale, and the offset (3,) is in the unit of the file.
    """
    scale = np.sqrt(mesh.area / standing.area)
    motion = rigid_fit(scale * visible(mesh, standing.vertices), visible(mesh))
    return scale * motion.rotation.T, motion.offset


def guess_up(mesh: Mesh) -> Axis:
    """Guess which axis of the file points up (`"y"`, `"z"` or `"-y"`), from the limbs on which a body stands.

    The score of an axis is the sum of two terms. The first term measures the limbs that hang down along the
    axis. Legs and arms usually hang down, and only the head points up. The second term measures how stably
    the body would stand. The usual axis is y for a body that is slender along y, such as a person, and for an
    open surface that faces along z, such as a mask. For other bodies, the usual axis is z. The usual axis is
    returned unless the score of another axis is clearly higher.

    The guesses for several data sets were checked by eye. The guess is right for all 70 FAUST bodies, 41 of
    43 TOSCA bodies, 30 of 32 SMAL animals, 17 of 19 people of SHREC'19 and all 16 bodies of SHREC'16
    topology. The guess can be wrong for a body that leaps, crouches, lies down or is cut in half.

    **Raises:** `InputError` if the mesh has no area.
    """
    return _guess_up(_outward(mesh))


def _guess_up(mesh: Mesh) -> Axis:
    """Guess the axis that points up, for a mesh whose normals point outward."""
    unit = np.sqrt(mesh.area)
    center = mesh.vertex_areas @ mesh.vertices / mesh.area
    spread = np.sqrt(mesh.vertex_areas @ (mesh.vertices - center) ** 2) / mesh.area
    too_thick = spread[2] - _SLENDER * spread[1]
    preference = _suits_opening(mesh, "y") - _suits_opening(mesh, "z")
    usual: Axis = "y" if too_thick <= max(preference, 0) else "z"
    points, edges = _merge_vertices(mesh, _CELL * unit)
    points = (points - center) / unit
    scores: dict[Axis, float] = {}
    for axis in _CONVENTIONS:
        across, upwards, forward = np.array(_STAND[axis], dtype=float) @ points.T
        ground = np.stack([across, forward], axis=1)
        scores[axis] = _hanging_limbs(upwards, edges) + _STABILITY_WEIGHT * _stability(upwards, ground)
    scores[usual] += _HEAD_START_IF_SLENDER if too_thick <= 0 else _HEAD_START
    return max(scores, key=scores.__getitem__)


def _suits_opening(mesh: Mesh, up: Axis) -> float:
    """Return how well flat open surfaces face the camera, and how well deep ones stand on their rim."""
    outside = facing(mesh)
    across, upwards, forward = np.array(_STAND[up], dtype=float) @ outside
    flatness = float(np.linalg.norm(outside))
    return 2 * flatness * float(np.hypot(across, forward)) + (1 - flatness) * float(upwards)


def _merge_vertices(mesh: Mesh, cell: float) -> tuple[Float64[np.ndarray, "c 3"], Int64[np.ndarray, "e 2"]]:
    """Return the mean of the vertices in each grid cell, and the pairs of cells that edges join."""
    used = visible(mesh)
    # The number of cells along a thin mesh may exceed the range of integers, so the keys remain floats.
    keys = np.floor((used - used.min(axis=0)) / cell)
    _, cells, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    cells = cells.ravel()
    points = np.stack([np.bincount(cells, coordinate) / counts for coordinate in used.T], axis=1)
    number = np.zeros(len(mesh.vertices), dtype=np.int64)
    number[mesh.referenced_vertices] = cells
    edges = np.unique(np.sort(number[mesh.edges], axis=1), axis=0)
    return points, edges[edges[:, 0] != edges[:, 1]]


def _hanging_limbs(heights: Float64[np.ndarray, " c"], edges: Int64[np.ndarray, "e 2"]) -> float:
    """Return the sum of the squared lengths of the limbs that hang down."""
    # A limb extends upwards from its lowest point to the height at which it joins a part of the body that
    # reaches lower. Its length is the persistence of its component in the sublevel sets of the height
    # (Edelsbrunner, Letscher and Zomorodian, "Topological persistence and simplification", 2002). The limb
    # with the lowest point is left out, so a standing quadruped has three legs, and one on its back has none.
    parent, lowest = list(range(len(heights))), heights.tolist()

    def root(point: int) -> int:
        while parent[point] != point:
            parent[point] = point = parent[parent[point]]
        return point

    joins = heights[edges].max(axis=1)
    order = np.argsort(joins, kind="stable")
    total = 0.0
    for height, (i, j) in zip(joins[order].tolist(), edges[order].tolist(), strict=True):
        deeper, other = sorted((root(i), root(j)), key=lowest.__getitem__)
        if deeper != other:
            parent[other] = deeper
            length = height - lowest[other]
            total += length**2 if length > _SHORTEST_LIMB else 0.0
    return total


def _stability(heights: Float64[np.ndarray, " c"], ground: Float64[np.ndarray, "c 2"]) -> float:
    """Return the clipped distance from the centre, the origin, to the boundary of the support."""
    # The support is the convex hull of the lowest points. Outside of it, the distance is negative.
    low = ground[heights <= heights.min() + _CONTACT * np.ptp(heights)]
    angles = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    reach = (low @ np.stack([np.cos(angles), np.sin(angles)])).max(axis=0)
    return float(np.clip(reach.min(), *_STABILITY_RANGE))
