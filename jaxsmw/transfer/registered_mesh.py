"""The registered mesh: the source's triangulation with positions on the target's surface."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from numpy.typing import ArrayLike
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg

from jaxsmw.errors import InputError
from jaxsmw.geometry.arrays import ratio
from jaxsmw.geometry.mesh import Mesh, connected_components
from jaxsmw.geometry.surface_distance import SurfaceTree, nearest_facing_points, nearest_surface_points
from jaxsmw.geometry.surface_points import SurfacePoints, check_pointwise_map, check_surface_points
from jaxsmw.runtime.threads import one_blas_thread
from jaxsmw.transfer.coverage import Attraction, UncoveredVertices, at_slits
from jaxsmw.transfer.neighborhoods import Neighborhoods, Similarities
from jaxsmw.transfer.small_components import follow_surroundings
from jaxsmw.wording import count_of

DEFAULT_STIFFNESS = 0.005
"""The default stiffness of a registered mesh, a length in units of the square root of the target's area."""

LARGEST_STIFFNESS = 1e6
"""The largest permitted stiffness. At 10, the mesh already keeps its shape. At 1e100, numbers overflow."""

# The stiffness with which `points_of_map` smooths a map to vertices. (Entry R22)
_STIFFNESS_OF_MAPS = 0.01


class _Round(NamedTuple):
    """A sequence of deformations. After each one, weights are reduced where faces are flipped."""

    deformations: int  # at most; a round that neither pulls nor covers ends as soon as no face is flipped
    factor: float  # multiplies the weights at flipped faces and at their neighbours
    neighbors: int  # the largest distance to these neighbours, in edges
    pull: float = 0.0  # the first weight of goals on Y for vertices of reduced weight, in vertex areas
    cover: float = 0.0  # the first weight of vertices of Y that are not reached, in vertex areas


# The first rounds remove folds, in small and then in larger regions. Then these regions are pulled to the
# target. The last round draws the source to uncovered vertices of the target, and removes new folds.
# (Entries R22 and R37)
_ROUNDS = (
    _Round(5, 0.2, 1),
    _Round(5, 0.4, 2),
    _Round(3, 0.4, 1, pull=0.2),
    _Round(6, 0.4, 1, cover=0.3),
)
# A map is probably wrong if two conditions hold: the share of flipped triangles exceeds _MANY_FLIPPED, and
# the mean change of angles exceeds _MANY_DEGREES. (Entry R35)
_MANY_FLIPPED, _MANY_DEGREES = 0.003, 16.0
# The map tears an edge of X if its length grows to more than _TORN_FACTOR times its length plus _TORN_LENGTH.
# Torn edges can cut X into several components. A component is an island if its share of the area is below
# _ISLAND. Lengths are in units of the square root of Y's area. (Entry R38)
_TORN_FACTOR, _TORN_LENGTH, _ISLAND = 4.0, 0.03, 0.005
# A slit of Y is at most as wide as a torn edge is long. While vertices at slits move with their surroundings,
# their weights are multiplied by _BRIDGING. A warning is issued if more than the share _MUCH_BRIDGED of X's
# area is at slits.
_BRIDGING, _MUCH_BRIDGED = 1e-3, 0.05
# The number of deformations that move islands and vertices at slits together with their surroundings.
_FILLING = 3
# The linear solver stops when the norm of the residual is at most this fraction of the norm of the right-hand
# side.
_TOLERANCE = 1e-5
# Vertices are not moved if their errors are below this fraction of the stiffness. (Entry R22)
_KEPT = 0.03


@dataclass(frozen=True, eq=False)
class RegisteredMesh:
    """A deformed source mesh that lies on the target: the result of `register_mesh`.

    A small component of X moves rigidly with its surroundings, to its counterpart on Y if there is one; see
    `follow_surroundings`. Any other unreferenced vertex moves with the nearest vertex. Vertices that welding
    merges keep exactly the same position.

    **Attributes:**

    - `mesh_x`, `mesh_y`: the source X (m vertices, f faces) and the target Y (n vertices), each a `Mesh`.
    - `vertices`: the positions of X's vertices on Y (m, 3), in Y's unit of length.
    - `similarities`: the `Similarities` (m) that take the neighbourhoods of X to the registered mesh. The
      scales include the change from X's unit of length to Y's.
    - `bridged`: the share of X's area that is matched to the lips of thin slits of Y, and moved with its
      surroundings instead.
    """

    mesh_x: Mesh
    mesh_y: Mesh
    vertices: Float64[np.ndarray, "m 3"]
    similarities: Similarities
    bridged: float = 0.0

    def __repr__(self) -> str:
        return f"RegisteredMesh({self.mesh_x.name} on {self.mesh_y.name}: {len(self.vertices)} vertices)"

    @cached_property
    def mesh(self) -> Mesh:
        """The registered mesh, with the faces of X in the order of X."""
        return replace(self.mesh_x, vertices=self.vertices, name=f"{self.mesh_x.name} on {self.mesh_y.name}")

    @cached_property
    def surface_points(self) -> SurfacePoints:
        """The nearest point of Y that faces each vertex: m `SurfacePoints`."""
        return nearest_facing_points(self.vertices, self._normals, self._nearest[0], self.mesh_y)

    @cached_property
    def _normals(self) -> Float64[np.ndarray, "m 3"]:
        """The vertex normals of the registered mesh, oriented like the normals of Y."""
        return self.similarities.hand * self.mesh.vertex_normals

    @cached_property
    def distances(self) -> Float64[np.ndarray, " m"]:
        """The distance from each vertex to Y, in Y's unit of length (m,)."""
        return self._nearest[1]

    @cached_property
    def _nearest(self) -> tuple[SurfacePoints, Float64[np.ndarray, " m"]]:
        return nearest_surface_points(self.vertices, self.mesh_y)

    @cached_property
    def flipped_faces(self) -> Bool[np.ndarray, " f"]:
        """A mask (f,), True for faces that are turned over relative to their neighbourhoods.

        The angle between the face's normal on X, rotated with its neighbourhood, and the normal of the
        registered face is then above 90 degrees.
        """
        normals = _normals(self.mesh_x.vertices, self.mesh_x)
        return _flipped_faces(self.mesh_x, normals, self.vertices, self.similarities)

    @cached_property
    def area_ratios(self) -> Float64[np.ndarray, " f"]:
        """The area of each registered face divided by its area on X (f,), with both meshes scaled to area 1.

        If a face has no area on X, its ratio is 1.
        """
        own = self.mesh_x.face_areas / self.mesh_x.area
        return ratio(self.mesh.face_areas / self.mesh.area, own, otherwise=1.0)

    @cached_property
    def angle_distortions(self) -> Float64[np.ndarray, " f"]:
        """The mean change of each face's angles from X to the registered mesh, in degrees (f,)."""
        before, after = (_angles(mesh.vertices[mesh.faces]) for mesh in (self.mesh_x, self.mesh))
        return np.degrees(np.abs(after - before).mean(axis=1))

    def carry(self, points: SurfacePoints) -> Float64[np.ndarray, "p 3"]:
        """Move `SurfacePoints` on X to the registered mesh. Return their positions (p, 3), in Y's unit.

        **Raises:** `InputError` if a point is not on X.
        """
        return check_surface_points(points, self.mesh_x, "points").positions(self.mesh)

    def project(self, points: SurfacePoints) -> SurfacePoints:
        """Map `SurfacePoints` on X to `SurfacePoints` on Y.

        Each point moves with its triangle to the registered mesh, and then to the nearest point of Y.
        Triangles of Y that face away are left out.

        **Raises:** `InputError` if a point is not on X.
        """
        positions = self.carry(points)
        nearest, _ = nearest_surface_points(positions, self.mesh_y)
        normals = points.interpolate(self._normals, self.mesh_x)
        return nearest_facing_points(positions, normals, nearest, self.mesh_y)

    def project_back(self, points: SurfacePoints) -> SurfacePoints:
        """Map `SurfacePoints` on Y to `SurfacePoints` on X.

        Each point moves to the nearest point of the registered mesh, whose triangles are those of X.
        Triangles that face away are left out.

        **Raises:** `InputError` if a point is not on Y.
        """
        positions = check_surface_points(points, self.mesh_y, "points").positions(self.mesh_y)
        nearest, _ = nearest_surface_points(positions, self.mesh)
        normals = self.similarities.hand * points.interpolate(self.mesh_y.vertex_normals, self.mesh_y)
        return nearest_facing_points(positions, normals, nearest, self.mesh)

    @cached_property
    def points_of_target(self) -> SurfacePoints:
        """The point of X for each vertex of Y, as by `project_back`: n `SurfacePoints`."""
        normals = self.similarities.hand * self.mesh_y.vertex_normals
        return nearest_facing_points(self.mesh_y.vertices, normals, self._nearest_of_target[0], self.mesh)

    @cached_property
    def target_distances(self) -> Float64[np.ndarray, " n"]:
        """The distance from each vertex of Y to the registered mesh, in Y's unit of length (n,)."""
        return self._nearest_of_target[1]

    @cached_property
    def _nearest_of_target(self) -> tuple[SurfacePoints, Float64[np.ndarray, " n"]]:
        return nearest_surface_points(self.mesh_y.vertices, self.mesh)

    @property
    def looks_wrong(self) -> bool:
        """Whether the map is probably wrong, because many triangles are flipped and angles change much."""
        flipped = self.flipped_faces.mean() > _MANY_FLIPPED
        return bool(flipped and self.angle_distortions.mean() > _MANY_DEGREES)

    def sentences(self) -> tuple[str, ...]:
        """Return sentences about the quality of the registered mesh."""
        unit = np.sqrt(self.mesh_y.area) / 100
        distances = self.distances[self.mesh_x.referenced_vertices] / unit
        flipped = int(self.flipped_faces.sum())
        areas = np.quantile(self.area_ratios, [0.05, 0.95])
        slits = f"{self.bridged:.1%} of the source lies at thin slits of the target, and bridges them."
        return (
            f"distance to the target: mean {distances.mean():.3f} %, 99th percentile "
            f"{np.quantile(distances, 0.99):.3f} % of the square root of the target's area.",
            f"{count_of(flipped, 'flipped triangle')} of {len(self.mesh_x.faces)} "
            f"({flipped / len(self.mesh_x.faces):.3%}).",
            f"area distortion: 90 % of the triangles have {areas[0]:.2f} to {areas[1]:.2f} times their area "
            f"on the source; angle distortion: {self.angle_distortions.mean():.1f} degrees in the mean.",
            *([slits] if self.bridged else []),
        )


def register_mesh(
    mesh_x: Mesh,
    mesh_y: Mesh,
    points: SurfacePoints,
    *,
    stiffness: float = DEFAULT_STIFFNESS,
    scale: float | None = None,
) -> RegisteredMesh:
    """Deform X onto Y, so that its vertices follow a map and its triangles keep their shapes.

    The positions minimise a sum of two terms: the squared distances to the points of the map, and the squared
    stiffness times the squared changes of edge vectors. Before the changes are measured, the edge vectors of
    X are rotated and scaled with their neighbourhoods. The rotations are those of as-rigid-as-possible
    deformation (Sorkine, Alexa 2007); jaxsmw adds the scales. Where faces would flip, the map has less
    weight, and vertices are also drawn to the nearest points of Y. Some vertices of Y, such as the tips of
    ears, are not reached by the deformation. The nearest points of X are drawn to these vertices, unless
    `scale` is given and X has less area than Y. Vertices that are matched to the lips of a thin slit of Y do
    not follow the map, but their surroundings, unless X has a boundary there. The function issues a
    `UserWarning` if more than 5 % of X's area is at slits.

    **Arguments:**

    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y, each a `Mesh`.
    - `points`: the map X -> Y, as m `SurfacePoints` on Y; see `Correspondence.surface_points`.
    - `stiffness`: a positive length in units of the square root of Y's area, by default 0.005. Noise of the
      map is smoothed if its wavelength is shorter. A stiffness of 0.03 makes the registered mesh of a noisy
      map smooth, but moves it farther away from the target.
    - `scale`: the factor by which X is first scaled. With None (the default), X is scaled to the area of Y.
      Give 1 for a partial shape and a full shape in the same unit of length.

    **Raises:** `InputError` if the points do not fit the meshes, or the stiffness is not positive or too
    large. `ArithmeticError` if the deformation does not converge.
    """
    if not 0 < stiffness <= LARGEST_STIFFNESS:
        raise InputError(
            f"the stiffness is {stiffness}: give a positive number of at most {LARGEST_STIFFNESS:g}, such as "
            f"{DEFAULT_STIFFNESS}."
        )
    points = check_surface_points(points, mesh_y, "points")
    if len(points) != len(mesh_x.vertices):
        raise InputError(
            f"{mesh_x.name}: there are {len(points)} points for {len(mesh_x.vertices)} vertices: give one "
            "point for each vertex."
        )
    root = np.sqrt(mesh_y.area)
    # Positions are relative to the middle of Y, because large coordinates would lose digits.
    target = replace(mesh_y, vertices=mesh_y.vertices - mesh_y.middle)
    mapped = points.positions(target)
    around = Neighborhoods(mesh_x, root / np.sqrt(mesh_x.area) if scale is None else scale)
    areas = around.size**2 * mesh_x.vertex_areas
    # A vertex of no or little area still follows the map.
    areas = np.maximum(areas, 0.1 * np.median(areas[areas > 0]))
    bridging = _bridging(mesh_x, target, points, _TORN_LENGTH * root)
    unguided = bridging | _islands(around, areas, mapped, root)
    if unguided.any():
        guides = np.where(unguided, np.where(bridging, _BRIDGING * areas, 0), areas)
        moved = _moved_along(around, target, guides, mapped, stiffness * root)
        mapped = np.where(unguided[:, None], moved, mapped)
    # A partial shape X cannot cover all of Y.
    covers = scale is None or around.size**2 * mesh_x.area >= mesh_y.area
    positions, similarities = _deformed(around, target, mapped, areas, stiffness * root, covers)
    similarities = Similarities(similarities.rotations, around.size * similarities.scales)
    positions, similarities, *_ = follow_surroundings(mesh_x, mesh_y, positions + mesh_y.middle, similarities)
    bridged = float(mesh_x.average(bridging))
    if bridged > _MUCH_BRIDGED:
        warnings.warn(
            f"{mesh_y.name}: thin slits cut the target. {bridged:.0%} of the area of {mesh_x.name} lies at "
            "slits and moves with its surroundings, but the map is less accurate there: fill the slits.",
            stacklevel=2,
        )
    return RegisteredMesh(mesh_x, mesh_y, positions, similarities, bridged)


def _deformed(
    around: Neighborhoods,
    target: Mesh,
    mapped: Float64[np.ndarray, "m 3"],
    areas: Float64[np.ndarray, " m"],
    stiffness: float,
    covers: bool,
) -> tuple[Float64[np.ndarray, "m 3"], Similarities]:
    """Deform X in `_ROUNDS`. Return its positions, and the similarities that take the scaled X to them."""
    mesh_x = around.mesh
    targets, positions, similarities = mapped.copy(), mapped, around.similarities(mapped)
    weights, is_first = areas.copy(), True
    normals = _normals(mesh_x.vertices, mesh_x)
    for of_round in _ROUNDS:
        loose = weights < areas
        is_needed = covers if of_round.cover else is_first or loose.any()
        if not is_needed:
            continue
        if of_round.pull:
            weights = np.where(loose, of_round.pull * areas, weights)
            surface = SurfaceTree(target)
        if of_round.cover:
            uncovered = UncoveredVertices(mesh_x, target)
        before, attraction = weights, None
        for step in range(of_round.deformations):
            if of_round.pull:
                nearest, _ = surface.nearest(positions[loose])
                targets[loose] = _halfway(nearest, mapped[loose], target)
            if of_round.cover and step % 2 == 0:  # the search is slow
                attraction = uncovered.attraction(positions, of_round.cover * weights / before)
            positions = _follow(around, similarities, weights, targets, stiffness, positions, attraction)
            similarities = around.similarities(positions)
            flipped = _flipped_faces(mesh_x, normals, positions, similarities)
            # The first deformation uses transformations that are fitted to the map itself, which is noisy.
            continues = of_round.pull or attraction or flipped.any() or is_first
            if not continues:
                break
            is_first = False
            near = np.zeros(len(weights))
            near[mesh_x.faces[flipped]] = 1
            for _ in range(of_round.neighbors):
                near = around.averaging @ near
            weights = np.where(near > 0, of_round.factor * weights, weights)
    return positions, similarities


def _bridging(mesh_x: Mesh, mesh_y: Mesh, points: SurfacePoints, width: float) -> Bool[np.ndarray, " m"]:
    """Return a mask of the vertices of X that are matched to lips of slits which X does not have."""
    at_lips = at_slits(mesh_y, width)[mesh_y.faces[points.faces]].any(axis=1)
    own = mesh_x.boundary_vertices.copy()
    own[mesh_x.faces[own[mesh_x.faces].any(axis=1)]] = True
    return at_lips & ~own


def _islands(
    around: Neighborhoods, areas: Float64[np.ndarray, " m"], mapped: Float64[np.ndarray, "m 3"], root: float
) -> Bool[np.ndarray, " m"]:
    """Return a mask of the islands: small groups of vertices that torn edges separate from all others."""
    lengths = np.linalg.norm(around.vectors, axis=1)
    mapped_lengths = np.linalg.norm(around.differences(mapped), axis=1)
    torn = mapped_lengths > _TORN_FACTOR * lengths + _TORN_LENGTH * root
    number, component = connected_components(around.edges[~torn], len(areas))
    share = np.bincount(component, areas, number) / areas.sum()
    return (share < _ISLAND)[component] & around.mesh.referenced_vertices


def _moved_along(
    around: Neighborhoods,
    target: Mesh,
    weights: Float64[np.ndarray, " m"],
    mapped: Float64[np.ndarray, "m 3"],
    stiffness: float,
) -> Float64[np.ndarray, "m 3"]:
    """Move vertices of little or no weight with their surroundings, and then all vertices to the target."""
    positions, similarities = mapped, around.similarities(mapped)
    for _ in range(_FILLING):
        positions = _follow(around, similarities, weights, mapped, stiffness, positions)
        similarities = around.similarities(positions)
    return RegisteredMesh(around.mesh, target, positions, similarities).surface_points.positions(target)


def points_of_map(
    mesh_x: Mesh, mesh_y: Mesh, pointwise_map: ArrayLike, *, scale: float | None = None
) -> SurfacePoints:
    """Convert a map to vertices T (m,) into a map to points between the vertices, for `register_mesh`.

    The matches of a map to vertices jump from vertex to vertex. A first registration with a stiffness of 0.01
    smooths these jumps. `scale` is that of `register_mesh`.

    **Raises:** `InputError` if the map does not fit the meshes.
    """
    vertices = check_pointwise_map(pointwise_map, mesh_x, mesh_y)
    # An unreferenced vertex of Y is replaced by the nearest point of the surface.
    points, _ = nearest_surface_points(mesh_y.vertices[vertices], mesh_y)
    smooth = register_mesh(mesh_x, mesh_y, points, stiffness=_STIFFNESS_OF_MAPS, scale=scale)
    return smooth.surface_points


def _follow(
    around: Neighborhoods,
    similarities: Similarities,
    weights: Float64[np.ndarray, " m"],
    targets: Float64[np.ndarray, "m 3"],
    stiffness: float,
    positions: Float64[np.ndarray, "m 3"],
    attraction: Attraction | None = None,
) -> Float64[np.ndarray, "m 3"]:
    """Solve for positions with weighted targets and edge vectors, where the given positions are wrong."""
    system = csr_array(diags_array(weights) + stiffness**2 * around.laplacian)
    right = stiffness**2 * around.divergence(similarities) + weights[:, None] * targets
    if attraction is not None:
        system, right = system + attraction.matrix(), right + attraction.right_side()
    residual = right - system @ positions
    # Let r be the largest ratio of a vertex's residual to the vertex's weight. Without an attraction, the
    # system is an M-matrix with the row sums `weights`, so no position has an error above r. The bound is
    # also valid if small weights make the system ill-conditioned.
    moving = (np.abs(residual).max(axis=1) > _KEPT * stiffness * weights).astype(float)
    rows = np.flatnonzero(around.averaging @ moving)
    if not len(rows):
        return positions
    if len(rows) < len(weights):
        system, residual = system[rows][:, rows], residual[rows]
    preconditioner = diags_array(1 / system.diagonal())
    tolerances = _TOLERANCE * np.linalg.norm(right, axis=0)
    moved = positions.copy()
    with one_blas_thread():
        for axis, tolerance in enumerate(tolerances):
            # With an absolute tolerance, the accuracy does not depend on the number of vertices that move.
            found, unfinished = cg(
                system, residual[:, axis], rtol=0, atol=tolerance, M=preconditioner, maxiter=10 * len(weights)
            )
            if unfinished:
                raise ArithmeticError(
                    "the deformation onto the target did not converge: give another stiffness."
                )
            moved[rows, axis] += found
    return moved


def _halfway(
    nearest: SurfacePoints, mapped: Float64[np.ndarray, "p 3"], mesh_y: Mesh
) -> Float64[np.ndarray, "p 3"]:
    """Move each point of Y halfway towards a given position, in the plane of its triangle."""
    # Vertices that are pulled to the nearest points of Y would slide along it, away from the map.
    positions = nearest.positions(mesh_y)
    normals = mesh_y.area_vectors[nearest.faces]
    squares = (normals**2).sum(axis=1, keepdims=True)
    offsets = mapped - positions
    along = (offsets * normals).sum(axis=1, keepdims=True)
    # A triangle without area has no normal, so the offsets of its points are not projected.
    offsets -= normals * ratio(along, squares)
    return positions + 0.5 * offsets


def _flipped_faces(
    mesh_x: Mesh,
    normals: Float64[np.ndarray, "f 3"],
    positions: Float64[np.ndarray, "m 3"],
    similarities: Similarities,
) -> Bool[np.ndarray, " f"]:
    """Return the mask `RegisteredMesh.flipped_faces`, given the normals of the source's faces."""
    rotations = similarities.rotations
    first, second, third = mesh_x.faces.T
    sums = rotations[first] + rotations[second] + rotations[third]
    return similarities.hand * np.einsum("fi,fij,fj->f", _normals(positions, mesh_x), sums, normals) < 0


def _normals(vertices: Float64[np.ndarray, "n 3"], mesh: Mesh) -> Float64[np.ndarray, "f 3"]:
    """Return the area vectors of a mesh with other positions, faster than a new mesh does."""
    first, second, third = mesh.faces.T
    origins = vertices[first]
    return np.cross(vertices[second] - origins, vertices[third] - origins)


def _angles(corners: Float64[np.ndarray, "f 3 3"]) -> Float64[np.ndarray, "f 3"]:
    """Return the angles of triangles in radians, given the positions of their corners."""
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    crossed = np.linalg.norm(np.cross(ahead, behind), axis=2)
    return np.arctan2(crossed, (ahead * behind).sum(axis=2))
