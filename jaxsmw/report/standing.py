"""Bodies upright in pictures: which axis of a file points up, and how large a body is shown."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import igl
import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.choices import Axis
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh

# Proper rotations that turn the named axis up. Bodies in y-up and z-up files then face the same way: forward
# is +z in y-up files and -y in z-up files, and x runs across the body in both.
_STAND = {
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "-y": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}

# The conventions in use: y up in computer graphics, z up in engineering, y down in computer vision.
_CONVENTIONS: tuple[Axis, ...] = ("y", "z", "-y")
# A body is slender along y if its spread along z is at most this multiple of its spread along y. Standing
# people in y-up files have at most 0.42. Animals in z-up files are long along y, but all except two that leap
# or crouch have at least 0.47.
_SLENDER = 0.45
# How much better another axis must score than the usual axis. People who raise their arms and stand on one
# foot score up to 0.18 more upside down. Bodies that sit or leap score up to 0.09 more on a wrong axis.
_HEAD_STARTS: dict[Axis, float] = {"y": 0.25, "z": 0.1}
_STABILITY_WEIGHT = 0.25
# Beyond these values more stability says nothing. In square roots of the area.
_STABILITY_RANGE = (-0.2, 0.1)
# The share of the height in which a body touches the ground.
_CONTACT = 0.1
_DIRECTIONS = 32
# The side of the cells in which vertices are merged: about 1500 cells per body. Shorter limbs are noise.
_CELL, _SHORTEST_LIMB = 1 / 30, 0.05

# An area between these multiples of the other shape's area is that of a partial shape.
_SMALLEST_PART, _LARGEST_PART = 1 / 16, 0.6


def stand(mesh: Mesh, up: Axis | None = None) -> Mesh:
    """The mesh as pictures show it: upright, its bounding box centred on the origin, its area 1.

    Faces are reoriented so that neighbours agree on which side is out. Vertices keep their numbers.

    **Arguments:**

    - `mesh`: a surface of positive area.
    - `up`: the axis of the file that points up; by default `guess_up`.

    **Returns:** A `Mesh` in which x runs across the body, y points up and z forward, provided that the file
    follows a usual convention.

    **Raises:** `InputError` if the mesh has no area or `up` is not an axis.
    """
    if not mesh.area > 0:
        raise InputError(
            f"{mesh.name}: there is nothing to draw because its faces have no area; give a surface."
        )
    if up is None:
        up = guess_up(mesh)
    elif up not in _STAND:
        raise InputError(f"up={up!r} is not an axis; choose one of {', '.join(get_args(Axis))}.")
    vertices = mesh.vertices @ np.array(_STAND[up], dtype=float).T / np.sqrt(mesh.area)
    used = vertices[mesh.referenced_vertices]
    faces, _ = igl.bfs_orient(mesh.faces)
    return replace(
        mesh,
        vertices=vertices - (used.min(axis=0) + used.max(axis=0)) / 2,
        faces=faces.astype(np.int64),
    )


def stand_pair(mesh_x: Mesh, mesh_y: Mesh, up: Axis | None = None) -> tuple[Mesh, Mesh]:
    """Both meshes standing (`stand`): Y with area 1, and X with area 1 unless one shape is partial.

    If the area of one mesh is 1/16 to 0.6 times the area of the other, it counts as a partial shape, and X
    keeps its size relative to Y. Closer to 1, the two are full shapes; below 1/16, the units of length
    differ.
    """
    standing_x, standing_y = stand(mesh_x, up), stand(mesh_y, up)
    ratio = mesh_x.area / mesh_y.area
    if _SMALLEST_PART < min(ratio, 1 / ratio) < _LARGEST_PART:
        standing_x = replace(standing_x, vertices=np.sqrt(ratio) * standing_x.vertices)
    return standing_x, standing_y


def guess_up(mesh: Mesh) -> Axis:
    """The axis of the file that points up, guessed from the limbs on which the body stands: y, z or -y.

    An axis scores by the limbs that hang down along it (`_hanging_limbs`), because legs and arms hang and
    little but a head rises, and by how firmly the body would stand (`_stability`). The usual axis wins unless
    another one scores clearly better: y for a body that is slender along y, such as a person, and otherwise
    z.

    By eye the guess is right for all 70 FAUST bodies, 41 of 43 TOSCA bodies (z up; a leaping and a crouching
    animal are not upright), 30 of 32 SMAL animals (y down), 17 of 19 people of SHREC'19 (both conventions)
    and all 16 of SHREC'16 topology. Without limbs and stability the figures were 70, 41, 1, 16 and 16. A body
    that lies down or is cut in half can fool it.

    **Arguments:**

    - `mesh`: a surface of positive area.
    """
    unit = np.sqrt(mesh.area)
    center = mesh.vertex_areas @ mesh.vertices / mesh.area
    spread = np.sqrt(mesh.vertex_areas @ (mesh.vertices - center) ** 2)
    usual: Axis = "z" if spread[2] > _SLENDER * spread[1] else "y"
    points, edges = _merge_vertices(mesh, _CELL * unit)
    points = (points - center) / unit
    scores: dict[Axis, float] = {}
    for axis in _CONVENTIONS:
        across, upwards, forward = np.array(_STAND[axis], dtype=float) @ points.T
        ground = np.stack([across, forward], axis=1)
        scores[axis] = _hanging_limbs(upwards, edges) + _STABILITY_WEIGHT * _stability(upwards, ground)
    scores[usual] += _HEAD_STARTS[usual]
    return max(scores, key=scores.__getitem__)


def _merge_vertices(mesh: Mesh, cell: float) -> tuple[Float64[np.ndarray, "c 3"], Int64[np.ndarray, "e 2"]]:
    """A coarse copy of the mesh: the mean of the vertices in each cell of a grid, and edges between them."""
    used = mesh.vertices[mesh.referenced_vertices]
    keys = np.floor((used - used.min(axis=0)) / cell).astype(np.int64)
    _, cells, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    cells = cells.ravel()
    points = np.stack([np.bincount(cells, coordinate) / counts for coordinate in used.T], axis=1)
    number = np.zeros(len(mesh.vertices), dtype=np.int64)
    number[mesh.referenced_vertices] = cells
    edges = np.unique(np.sort(number[mesh.edges], axis=1), axis=0)
    return points, edges[edges[:, 0] != edges[:, 1]]


def _hanging_limbs(heights: Float64[np.ndarray, " c"], edges: Int64[np.ndarray, "e 2"]) -> float:
    """The sum of the squared lengths of the limbs that hang down.

    A limb reaches from its lowest point up to where it joins a part of the body that reaches lower: its
    length is the persistence of its component among the points below a height (Edelsbrunner, Letscher and
    Zomorodian, "Topological persistence and simplification", 2002). The part that reaches lowest does not
    count. A quadruped has three such limbs if it stands, and none if it lies on its back.
    """
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
    """How far inside the body's support its centre lies, negative outside; clipped to `_STABILITY_RANGE`.

    The support is the convex hull of the lowest points, seen from above. The centre is the origin.
    """
    low = ground[heights <= heights.min() + _CONTACT * np.ptp(heights)]
    angles = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    reach = (low @ np.stack([np.cos(angles), np.sin(angles)])).max(axis=0)
    return float(np.clip(reach.min(), *_STABILITY_RANGE))
