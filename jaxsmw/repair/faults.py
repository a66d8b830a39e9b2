"""What is wrong with a pointwise map between two surfaces, as far as can be told without the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.mesh import Mesh, connected_pieces, units_of_length
from jaxsmw.geometry.sampling import spread_edges

_Item = TypeVar("_Item")

# Neighbours whose matches are farther apart than this, in square roots of the area, and than so many times
# their own distance, are torn apart. Matches of neighbours are 0.03 apart on bodies of 5000 vertices.
_TORN, _STRETCHED = 0.1, 3.0
# Where the smoothed density of signed area is below this, orientation is reversed: 1 is what isometries have.
_REVERSED = -0.2
# It is smoothed in the span of so many eigenvectors, and counts in the flaw by this weight.
_EIGENVECTORS, _WEIGHT_OF_REVERSED = 50, 4
# Maps are alike that differ by more than so many square roots of the area on less than such a share of it.
_APART, _NEARLY_NOTHING = 0.1, 0.03
# What `expected_error` makes of how far off one comes back, and of how much distances between neighbours
# change: so, errors on real pairs are 0.8 to 1.4 times what is expected.
_DETOUR, _DISTORTION = 0.5, 2.0
# What it thinks of a piece that is misplaced as a whole, in square roots of the piece's area.
_MISPLACED = 0.5
# The time for which heat flows that evens out single vertices' signs: it spreads over a disk of radius 0.06.
_HEAT_TIME = 1e-3


def stretch(
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int64[np.ndarray, " m"],
    spectrum_x: Spectrum,
    *,
    partial: bool = False,
) -> float:
    """The Dirichlet energy of matches' positions over that of X's own, in the span of X's eigenvectors.

    About 1 for the true map between poses of one body, whatever their triangulations; up to 1.1 between
    bodies of different kinds; maps that tear have more. What single vertices scatter, which is the more the
    denser the mesh, lies beyond the span.

    **Arguments:**

    - `spectrum_x`: of X, some hundred eigenvectors; what is beyond X's vertices is padding.
    - `partial`: whether one mesh is a part of the other, in the same unit of length.
    """
    m = len(mesh_x.vertices)
    eigenvalues, eigenvectors, areas = (
        np.asarray(part)
        for part in (spectrum_x.eigenvalues, spectrum_x.eigenvectors, spectrum_x.vertex_areas)
    )

    def energy(positions: Float[np.ndarray, "m 3"]) -> float:
        # The constant has no energy, but would leave its rounding errors.
        centered = positions - np.average(positions, axis=0, weights=mesh_x.vertex_areas)
        # In the type of the eigenvectors, of which a large mesh has no room for a copy.
        weighted = (areas[:m] * centered.T).astype(eigenvectors.dtype)
        return float(np.sum(eigenvalues * (weighted @ eigenvectors[:m]) ** 2))

    unit_x, unit_y = units_of_length(mesh_x, mesh_y, partial)
    return energy(mesh_y.vertices[pointwise_map] / unit_y) / energy(mesh_x.vertices / unit_x)


def flaw(
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int64[np.ndarray, " m"],
    spectrum_x: Spectrum,
    *,
    partial: bool = False,
) -> float:
    """How bad a map looks: its `stretch`, the more so the more of X has `reversed_orientation`.

    What shrinks is as bad as what stretches, but between a part and the whole, much of which has no place.
    Stretch alone would have a body mapped to its mirror image rather than one leg to the other. What
    registration ends with has up to 1.12 between poses of one body and up to 1.2 between bodies of different
    kinds where it is right, mostly above 1.3 where limbs are swapped.
    """
    reversed_ = reversed_orientation(mesh_x, mesh_y, pointwise_map, spectrum_x, partial=partial)
    share = float(mesh_x.vertex_areas[reversed_].sum() / mesh_x.area)
    stretched = stretch(mesh_x, mesh_y, pointwise_map, spectrum_x, partial=partial)
    if not partial:
        stretched = max(stretched, 1 / max(stretched, 1e-6))
    return stretched * (1 + _WEIGHT_OF_REVERSED * share)


def torn_off(
    mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Int64[np.ndarray, " m"], *, partial: bool = False
) -> Bool[np.ndarray, " m"]:
    """True for vertices of X outside the largest piece that is left where edges that the map tears are cut.

    Limbs that are swapped as a whole come off so.
    """
    edges, nearest = spread_edges(mesh_x)
    before, after = _lengths(edges, mesh_x, mesh_y, pointwise_map, partial)
    kept = edges[after < np.maximum(_TORN, _STRETCHED * before)]
    _, piece = connected_pieces(kept, len(mesh_x.vertices))
    piece = piece[nearest]
    return piece != np.argmax(np.bincount(piece, mesh_x.vertex_areas))


def reversed_orientation(
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int64[np.ndarray, " m"],
    spectrum_x: Spectrum,
    *,
    partial: bool = False,
) -> Bool[np.ndarray, " m"]:
    """True for vertices of X around which the map turns left into right, as where limbs are swapped.

    **Arguments:**

    - `spectrum_x`: of X; what is beyond X's vertices is padding. In the span of its first eigenvectors the
      area that triangles cover on Y, negative where they come to lie upside down, is smoothed.
    - `partial`: whether one mesh is a part of the other, in the same unit of length.
    """
    unit_x, unit_y = units_of_length(mesh_x, mesh_y, partial)
    corners = pointwise_map[mesh_x.faces]
    a, b, c = (mesh_y.vertices[corner] for corner in corners.T)
    normals = mesh_y.vertex_normals[corners].sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    covered = 0.5 * np.sum(np.cross(b - a, c - a) * normals, axis=1) / unit_y**2
    if mesh_x.is_inside_out != mesh_y.is_inside_out:
        covered = -covered
    # One triangle that is torn wide open should not outvote all around it.
    most = 2 * mesh_x.face_areas / unit_x**2
    covered = np.clip(covered, -most, most)
    at_vertices = np.bincount(mesh_x.faces.ravel(), np.repeat(covered / 3, 3), len(mesh_x.vertices))
    eigenvectors = np.asarray(spectrum_x.eigenvectors)[: len(mesh_x.vertices), :_EIGENVECTORS]
    return eigenvectors @ (eigenvectors.T @ at_vertices) < _REVERSED


def alike(
    mesh_x: Mesh,
    mesh_y: Mesh,
    one: Int64[np.ndarray, " m"],
    other: Int64[np.ndarray, " m"],
    *,
    partial: bool = False,
) -> bool:
    """Whether two maps are the same but for details; `partial`: one mesh is a part of the other."""
    _, unit_y = units_of_length(mesh_x, mesh_y, partial)
    apart = np.linalg.norm(mesh_y.vertices[one] - mesh_y.vertices[other], axis=1) > _APART * unit_y
    return bool(mesh_x.vertex_areas[apart].sum() < _NEARLY_NOTHING * mesh_x.area)


def distinct(items: Iterable[_Item], alike: Callable[[_Item, _Item], bool]) -> Iterator[_Item]:
    """Those that are not like one before."""
    found: list[_Item] = []
    for item in items:
        if not any(alike(item, other) for other in found):
            found.append(item)
            yield item


def expected_error(
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int64[np.ndarray, " m"],
    way_back: Int64[np.ndarray, " n"],
    spectrum_x: Spectrum,
    *,
    partial: bool = False,
) -> Float[np.ndarray, " m"]:
    """How far from the truth matches may be, as far as the map gives it away, in square roots of Y's area.

    Two signs, evened out over the surroundings: how far from where it began one comes back to, there and
    `way_back`; and how much distances between neighbours change. Where limbs are swapped (`torn_off`,
    `reversed_orientation`) more is expected, in proportion to their size. docs/accuracy.md tells how well
    this ranks vertices. A map that is wrong and consistent throughout passes for right.

    **Arguments:**

    - `way_back`: a map Y -> X.
    - `spectrum_x`: of X; heat flowing in it evens out the signs.
    - `partial`: whether one mesh is a part of the other, in the same unit of length.
    """
    units = units_of_length(mesh_x, mesh_y, partial)
    detour = np.linalg.norm(mesh_x.vertices - mesh_x.vertices[way_back[pointwise_map]], axis=1) / units[0]
    change = np.abs(np.subtract(*_lengths(mesh_x.edges, mesh_x, mesh_y, pointwise_map, partial)))
    ends, m = mesh_x.edges.ravel(), len(mesh_x.vertices)
    distortion = np.bincount(ends, np.repeat(change, 2), m) / np.maximum(np.bincount(ends, minlength=m), 1)
    eigenvalues, eigenvectors, areas = (
        np.asarray(part, np.float64)
        for part in (spectrum_x.eigenvalues, spectrum_x.eigenvectors, spectrum_x.vertex_areas)
    )
    signs = _DETOUR * detour + _DISTORTION * distortion
    heat = np.exp(-_HEAT_TIME * eigenvalues) * (eigenvectors.T @ (areas * signs))
    misplaced = torn_off(mesh_x, mesh_y, pointwise_map, partial=partial)
    misplaced |= reversed_orientation(mesh_x, mesh_y, pointwise_map, spectrum_x, partial=partial)
    # The larger a limb is, the farther from its place it can be.
    inside = misplaced[mesh_x.edges].all(axis=1)
    number, piece = connected_pieces(mesh_x.edges[inside], m)
    sizes = np.sqrt(np.bincount(piece, areas, number))[piece]
    expected = np.maximum(eigenvectors @ heat, 0) + _MISPLACED * misplaced * sizes
    return expected * units[1] / mesh_y.area**0.5


def _lengths(
    edges: Int64[np.ndarray, "e 2"],
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int64[np.ndarray, " m"],
    partial: bool,
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Lengths of edges of X, and distances of their ends' matches, in `units_of_length`."""
    unit_x, unit_y = units_of_length(mesh_x, mesh_y, partial)
    placed = (mesh_x.vertices / unit_x, mesh_y.vertices[pointwise_map] / unit_y)
    before, after = (np.linalg.norm(np.diff(v[edges], axis=1)[:, 0], axis=1) for v in placed)
    return before, after
