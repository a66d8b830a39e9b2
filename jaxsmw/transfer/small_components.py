"""Small components, such as eyes, teeth and shoes, move with their surroundings to their counterparts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.spatial import KDTree

from jaxsmw.geometry.alignment import nearest_rotations
from jaxsmw.geometry.mesh import Mesh, components_of_faces, extend_from
from jaxsmw.transfer.neighborhoods import Neighborhoods, Similarities

# A component of Y can be the counterpart of a moved component of X if they differ by at most the diameter of
# the moved component plus _REACH, in units of the square root of Y's area. Maps have errors of this size.
_REACH = 0.03
# The weight of the order of components, which decides between equal components at the same position.
_ORDER = 1e-9


class _Components:
    """The small components of a mesh: their vertices `rows` (u,), and the component `of_row` of each (u,)."""

    def __init__(self, mesh: Mesh) -> None:
        faces, n = mesh.small_faces, len(mesh.vertices)
        self.rows = np.unique(faces)
        labels = components_of_faces(faces, n)[1][self.rows]
        numbers, self.of_row = np.unique(labels, return_inverse=True)
        of_corners = np.repeat(Mesh(mesh.vertices, faces).face_areas / 3, 3)
        areas = np.bincount(faces.ravel(), of_corners, n)[self.rows].astype(np.float64)
        areas = np.maximum(areas, np.finfo(float).eps * mesh.area)  # a component can have no area
        self.areas = np.bincount(self.of_row, areas, len(numbers))
        self._weights = csr_array(
            (areas / self.areas[self.of_row], (self.of_row, np.arange(len(areas)))),
            shape=(len(numbers), len(areas)),
        )
        points = mesh.vertices[self.rows]
        self.centers = self.mean(points)
        offsets = points - self.centers[self.of_row]
        moments = self.mean(offsets[:, :, None] * offsets[:, None])
        # The standard deviations of a component along its principal axes are its size and its proportions.
        self.deviations = np.sqrt(np.maximum(np.linalg.eigvalsh(moments), 0))
        self.radii = np.linalg.norm(self.deviations, axis=1)

    def mean(self, values: Float64[np.ndarray, "u ..."]) -> Float64[np.ndarray, "c ..."]:
        """Return the area-weighted mean of values at `rows`, for each of the c components."""
        columns = values.reshape(len(values), math.prod(values.shape[1:]))
        return (self._weights @ columns).reshape(-1, *values.shape[1:])


def follow_surroundings(
    mesh_x: Mesh, mesh_y: Mesh, positions: Float64[np.ndarray, "m 3"], similarities: Similarities
) -> tuple[Float64[np.ndarray, "m 3"], Similarities, Int64[np.ndarray, " m"], float]:
    """Move the vertices of X without faces with their surroundings.

    Each vertex without faces moves with the nearest vertex that has faces. A small component is rigid: all
    its vertices have their mean transformation. A component of Y is the counterpart of a moved component if
    their positions, sizes and proportions agree. The moved component then takes the position and size of its
    counterpart, and its vertices are matched to the nearest vertices of the counterpart. The vertices of
    other components are matched to the nearest vertices of Y that have faces.

    `positions` (m, 3) are those of the vertices of X on Y, in the unit of Y, to which `similarities` take X.

    **Returns:** The positions (m, 3) and the transformations of all vertices, where vertices that have faces
    keep theirs; the matches (m,) of the vertices of small components, as vertices of Y, and -1 for all
    others; and the share of X's area in small components that have no counterpart on Y.
    """
    matches, known = np.full(len(positions), -1), mesh_x.referenced_vertices
    positions, similarities = _with_nearest(known, mesh_x, positions, similarities)
    if not len(mesh_x.small_faces):
        return positions, similarities, matches, 0.0
    parts, others = _Components(mesh_x), _Components(mesh_y)
    rows, of_row = parts.rows, parts.of_row
    scales = parts.mean(similarities.scales[rows])
    hand = similarities.hand
    rotations = hand * nearest_rotations(hand * parts.mean(similarities.rotations[rows]))[0]
    centers, radii = parts.mean(positions[rows]), scales * parts.radii
    counterparts = _counterparts(
        np.hstack([centers, scales[:, None] * parts.deviations]),
        np.hstack([others.centers, others.deviations]),
        2 * radii + _REACH * np.sqrt(mesh_y.area),
    )
    paired = counterparts >= 0
    centers[paired] = others.centers[counterparts[paired]]
    resized = paired & (radii > 0)
    scales[resized] *= others.radii[counterparts[resized]] / radii[resized]
    of_rows = Similarities(rotations[of_row], scales[of_row])
    positions[rows] = centers[of_row] + of_rows.of_vectors(mesh_x.vertices[rows] - parts.centers[of_row])
    similarities.rotations[rows], similarities.scales[rows] = of_rows
    for counterpart in np.unique(counterparts[of_row]):
        own = rows[counterparts[of_row] == counterpart]
        is_paired = counterpart >= 0
        candidates = others.rows[others.of_row == counterpart] if is_paired else mesh_y.referenced_indices
        matches[own] = candidates[KDTree(mesh_y.vertices[candidates]).query(positions[own])[1]]
    # Welding leaves vertices without faces at the positions of vertices of small components.
    known = known | (matches >= 0)
    positions, similarities = _with_nearest(known, mesh_x, positions, similarities)
    left_out = parts.areas[~paired].sum() / (mesh_x.area + parts.areas.sum())
    return positions, similarities, matches, float(left_out)


def match_small_components(
    mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int64[np.ndarray, " m"], *, scale: float
) -> tuple[Int64[np.ndarray, " m"], float]:
    """Match the small components of X, given a map of its other vertices; see `follow_surroundings`.

    **Arguments:**

    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y.
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `scale`: the factor from lengths on X to lengths on Y.

    **Returns:** The map (m,), in which only the vertices without faces have new matches, and the share of X's
    area that has no counterpart.
    """
    if not len(mesh_x.small_faces):
        return pointwise_map, 0.0
    # Positions are relative to the middle of Y, because large coordinates would lose digits.
    target = replace(mesh_y, vertices=mesh_y.vertices - mesh_y.middle)
    mapped = target.vertices[pointwise_map]
    similarities = Neighborhoods(mesh_x, scale).similarities(mapped)
    similarities = Similarities(similarities.rotations, scale * similarities.scales)
    _, _, matches, left_out = follow_surroundings(mesh_x, target, mapped, similarities)
    matches = np.where(matches < 0, pointwise_map, matches)
    known = mesh_x.referenced_vertices.copy()
    known[mesh_x.small_faces] = True
    return extend_from(known, mesh_x, matches), left_out


def _counterparts(
    shapes_x: Float64[np.ndarray, "c 6"],
    shapes_y: Float64[np.ndarray, "d 6"],
    reach: Float64[np.ndarray, " c"],
) -> Int64[np.ndarray, " c"]:
    """Pair components so that the sum of squared differences is least. A component within no reach has -1."""
    number = len(shapes_x)
    near = KDTree(shapes_y).query_ball_point(shapes_x, reach) if len(shapes_y) else [[]] * number
    first = np.repeat(np.arange(number), [len(found) for found in near])
    second = np.concatenate([*near, []]).astype(np.int64)
    costs = ((shapes_x[first] - shapes_y[second]) ** 2).sum(axis=1)
    order = first / number - second / max(len(shapes_y), 1)
    costs += _ORDER * reach[first] ** 2 * order**2
    # A component without a counterpart is paired with an entry of its own. The added 1 keeps costs positive.
    at = (
        np.concatenate([first, np.arange(number)]),
        np.concatenate([second, len(shapes_y) + np.arange(number)]),
    )
    entries = 1 + np.concatenate([costs, reach**2]) / (reach**2).max()
    table = csr_array((entries, at), shape=(number, len(shapes_y) + number))
    paired = min_weight_full_bipartite_matching(table)[1].astype(np.int64)
    return np.where(paired < len(shapes_y), paired, -1)


def _with_nearest(
    known: Bool[np.ndarray, " m"],
    mesh: Mesh,
    positions: Float64[np.ndarray, "m 3"],
    similarities: Similarities,
) -> tuple[Float64[np.ndarray, "m 3"], Similarities]:
    """Move each vertex that is not known with the nearest known vertex."""
    nearest = extend_from(known, mesh, np.arange(len(positions)))
    followed = Similarities(similarities.rotations[nearest], similarities.scales[nearest])
    return positions[nearest] + followed.of_vectors(mesh.vertices - mesh.vertices[nearest]), followed
