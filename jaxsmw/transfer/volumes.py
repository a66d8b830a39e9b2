"""Transfer of volumes: the boundary of a tetrahedral mesh moves to the target, and its interior follows."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import OptimizeResult, minimize

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import connected_components
from jaxsmw.geometry.surface_distance import bounding_box_diagonal, nearest_surface_points
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.io.volumes import Volume, check_volume, signed_volumes
from jaxsmw.runtime.threads import one_blas_thread
from jaxsmw.transfer.registered_mesh import RegisteredMesh

# A vertex of the volume's boundary is at the source's surface up to this distance, a fraction of the diagonal
# of the box around the source. At least the share _AT_SURFACE of the boundary's vertices must be there.
_NEAR, _AT_SURFACE = 0.01, 0.25
# Inverted tetrahedra are mended together with those up to _RINGS edges away. _LIFT is the weight α of the
# original shapes, and _STEPS the largest number of steps of L-BFGS.
_RINGS, _LIFT, _STEPS = 4, 1e-5, 300


@dataclass(frozen=True, eq=False)
class TransferredVolume:
    """The result of `transfer_volume`: n vertices and t tetrahedra inside the target.

    **Attributes:**

    - `volume`: the `Volume` in the target, in the unit of Y. If the map mirrors X, two corners of each
      tetrahedron are swapped, so that the signs of the volumes stay the same.
    - `on_surface`: a mask (n,), True for the vertices at the surface of X, whose positions the registered
      mesh determines.
    - `inverted`: a mask (t,), True for tetrahedra whose volume is zero or has changed its sign.
    """

    volume: Volume
    on_surface: Bool[np.ndarray, " n"]
    inverted: Bool[np.ndarray, " t"]

    def sentences(self) -> tuple[str, ...]:
        """Return sentences about the vertices at the surface and the inverted tetrahedra."""
        inverted, total = int(self.inverted.sum()), len(self.inverted)
        return (
            f"volume: {int(self.on_surface.sum())} of {len(self.on_surface)} vertices lie at the surface; "
            f"{inverted} of {total} tetrahedra are inverted ({inverted / total:.3%}).",
        )


def transfer_volume(volume: Volume, registered: RegisteredMesh) -> TransferredVolume:
    """Move a tetrahedral mesh inside X to the inside of Y.

    Boundary vertices at the surface of X, which need not be vertices of X, move with their triangles to the
    registered mesh. A small offset from the surface is rotated and scaled with its neighbourhood. All other
    vertices, also those of cavities, move by an affine transformation plus a harmonic displacement, so that
    affine deformations are exact. Around inverted tetrahedra, the lifted content is then minimised with a
    fixed boundary (Du, Aigerman, Zhou, Kovalsky, Yan, Kaufman, Ju 2020). A tetrahedron can stay inverted if
    its boundary is folded, for example if all its corners are on the boundary.

    **Arguments:**

    - `volume`: a `Volume` in the unit and the coordinate system of X. Its boundary lies at the surface of X;
      cavities need not.
    - `registered`: the `RegisteredMesh` of X on Y.

    **Raises:** `InputError` if `jaxsmw.io.volumes.check_volume` refuses the volume, or less than a quarter of
    its boundary's vertices are at the surface of X: at most 1 % of the diagonal of X away.
    """
    check_volume(volume)
    vertices, tets = volume.vertices, volume.tets
    mesh_x, mesh_y = registered.mesh_x, registered.mesh_y
    points, distances = nearest_surface_points(vertices, mesh_x)
    # The vertices of the boundary, and those of no tetrahedron.
    outer = np.ones(len(vertices), dtype=bool)
    outer[tets] = False
    outer[igl.boundary_facets(tets)[0]] = True
    near = outer & (distances <= _NEAR * bounding_box_diagonal(mesh_x))
    if near.sum() < _AT_SURFACE * outer.sum():
        diagonals = np.linalg.norm(np.ptp(vertices, axis=0)), bounding_box_diagonal(mesh_x)
        raise InputError(
            f"{volume.name}: {near.sum()} of {outer.sum()} vertices of the boundary are at the surface of "
            f"{mesh_x.name}, and the diagonals of the boxes are {diagonals[0]:.3g} and {diagonals[1]:.3g}: "
            "give a volume inside this mesh, in its unit and coordinates."
        )
    # A part that is nowhere at the surface would have no position, so its boundary moves likewise.
    edges = np.stack([np.repeat(tets[:, :1], 3, axis=1), tets[:, 1:]], axis=2).reshape(-1, 2)
    _, part = connected_components(edges, len(vertices))
    fixed = near | (outer & ~np.isin(part, part[near]))
    images = _images(vertices[fixed], SurfacePoints(points.faces[fixed], points.weights[fixed]), registered)
    hand = registered.similarities.hand * np.sign(signed_volumes(vertices, tets[:1])[0])
    with one_blas_thread():
        positions = _harmonic(vertices, tets, fixed, images)
        positions = _without_inversions(vertices, positions, tets, fixed, hand)
    inverted = hand * signed_volumes(positions, tets) <= 0
    moved = volume.at(positions, f"{volume.name} on {mesh_y.name}", mirrored=registered.similarities.hand < 0)
    return TransferredVolume(moved, near, inverted)


def _images(
    positions: Float64[np.ndarray, "p 3"], points: SurfacePoints, registered: RegisteredMesh
) -> Float64[np.ndarray, "p 3"]:
    """Move points with their nearest points of X to the registered mesh, and rotate and scale offsets."""
    corners, similarities = registered.mesh_x.faces[points.faces], registered.similarities
    weights = points.weights * similarities.scales[corners]
    offsets = positions - points.positions(registered.mesh_x)
    turned = np.einsum("pk,pkij,pj->pi", weights, similarities.rotations[corners], offsets)
    # Projections onto Y would invert more tetrahedra.
    return registered.carry(points) + turned


def _harmonic(
    vertices: Float64[np.ndarray, "n 3"],
    tets: Int64[np.ndarray, "t 4"],
    fixed: Bool[np.ndarray, " n"],
    images: Float64[np.ndarray, "p 3"],
) -> Float64[np.ndarray, "n 3"]:
    """Move vertices by the affine transformation that fits the images, and a harmonic displacement."""
    # Without the affine part, a boundary that is free would not follow affine deformations.
    known = np.column_stack([vertices, np.ones(len(vertices))])
    affine = known @ np.linalg.lstsq(known[fixed], images, rcond=None)[0]
    return affine + igl.harmonic(vertices, tets, np.flatnonzero(fixed), images - affine[fixed], 1)


def _without_inversions(
    vertices: Float64[np.ndarray, "n 3"],
    positions: Float64[np.ndarray, "n 3"],
    tets: Int64[np.ndarray, "t 4"],
    fixed: Bool[np.ndarray, " n"],
    hand: float,
) -> Float64[np.ndarray, "n 3"]:
    """Minimise the lifted content of the tetrahedra around inverted ones, until none is inverted.

    The content of a tetrahedron with edges D and original edges E is the square root of the determinant of
    DᵀD + α EᵀE. It is smooth, and larger for an inverted tetrahedron than for the space that it covers.
    """
    near = np.zeros(len(vertices), dtype=bool)
    near[tets[hand * signed_volumes(positions, tets) <= 0]] = True
    for _ in range(_RINGS):
        near[tets[near[tets].any(axis=1)]] = True
    moving = near & ~fixed
    patch = tets[moving[tets].any(axis=1)]
    if not len(patch):
        return positions
    edges = vertices[patch[:, 1:]] - vertices[patch[:, :1]]
    scale = np.abs(signed_volumes(positions, patch)).sum() / np.abs(signed_volumes(vertices, patch)).sum()
    lifted = _LIFT * scale ** (2 / 3) * edges @ edges.transpose(0, 2, 1)
    moved = positions.copy()

    def content(free: Float64[np.ndarray, " d"]) -> tuple[float, Float64[np.ndarray, " d"]]:
        moved[moving] = free.reshape(-1, 3)
        edges = moved[patch[:, 1:]] - moved[patch[:, :1]]
        gram = edges @ edges.transpose(0, 2, 1) + lifted
        contents = np.sqrt(np.linalg.det(gram))
        slopes = contents[:, None, None] * np.linalg.solve(gram, edges)
        slopes = np.concatenate([-slopes.sum(axis=1, keepdims=True), slopes], axis=1).reshape(-1, 3)
        total = [np.bincount(patch.ravel(), slopes[:, axis], len(vertices)) for axis in range(3)]
        return contents.sum(), np.stack(total, axis=1)[moving].ravel()

    def stop(intermediate_result: OptimizeResult) -> None:
        moved[moving] = intermediate_result.x.reshape(-1, 3)
        if (hand * signed_volumes(moved, patch) > 0).all():
            raise StopIteration

    found = minimize(
        content,
        positions[moving].ravel(),
        jac=True,
        method="L-BFGS-B",
        callback=stop,
        options={"maxiter": _STEPS, "ftol": 0},
    )
    moved[moving] = found.x.reshape(-1, 3)
    before, after = (int((hand * signed_volumes(at, tets) <= 0).sum()) for at in (positions, moved))
    return moved if after < before else positions
