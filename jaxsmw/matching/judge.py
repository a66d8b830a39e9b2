"""Measures of maps without ground truth: how much a map distorts, and where it is probably wrong.

The functions share these arguments. `pair` is the `Pair` of the source X (m vertices) and the target Y (n
vertices). `pointwise_map` is T: X -> Y (m,), 0-based vertices of Y. `reverse_map` is a map Y -> X (n,),
0-based vertices of X. `spectrum_x` and `spectrum_y` are the spectra of X and Y in `Pair.units_of_length`,
without padding and with a few hundred eigenvectors. `settings` and `scores` are settings of
`jaxsmw.matching.settings`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.mesh import Mesh, connected_components, extend_from
from jaxsmw.geometry.sampling import coarse_edges
from jaxsmw.matching.outcome import StageRun
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.settings import ExpectedErrorSettings, ScoreSettings

_DEFAULT = ScoreSettings()


def dirichlet_energy_ratio(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    spectrum_x: Spectrum,
    settings: ScoreSettings = _DEFAULT,
) -> float:
    """Return the Dirichlet energy of the matched positions, divided by the energy of X's own positions.

    Both energies are computed from the same first eigenvectors of X. More eigenvectors would also capture
    errors of single matches. The energy of these errors grows with the density of the mesh. For true maps
    between poses of one body, the ratio is about 1, even if the triangulations differ. For true maps between
    non-isometric shapes, the ratio is up to 1.1. Discontinuous maps have larger ratios.

    **Returns:** The ratio, a float without unit, for positions in `Pair.units_of_length`.
    """
    m, n = (len(mesh.vertices) for mesh in pair.meshes)
    resolved = max(2, min(m, n) // settings.vertices_per_eigenvector)
    eigenvalues, eigenvectors, areas = (
        np.asarray(part)
        for part in (spectrum_x.eigenvalues, spectrum_x.eigenvectors, spectrum_x.vertex_areas)
    )
    eigenvalues, eigenvectors = eigenvalues[:resolved], eigenvectors[:, :resolved]

    def energy(positions: Float[np.ndarray, "m 3"]) -> float:
        # A constant offset of the positions has no energy but would cause rounding errors.
        centered = positions - pair.mesh_x.average(positions)
        # The eigenvectors keep their type, because a converted copy of them takes too much memory on large
        # meshes.
        weighted = (areas * centered.T).astype(eigenvectors.dtype)
        return float(np.sum(eigenvalues * (weighted @ eigenvectors) ** 2))

    unit_x, unit_y = pair.units_of_length
    matched = pair.mesh_y.vertices[pointwise_map]
    return energy(matched / unit_y) / energy(pair.mesh_x.vertices / unit_x)


def distortion(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    spectrum_x: Spectrum,
    settings: ScoreSettings = _DEFAULT,
) -> float:
    """Return the distortion of a map, which is 1 for isometries and larger for worse maps.

    The distortion is the `dirichlet_energy_ratio` times `1 + orientation_weight * share`, where `share` is
    the share of X's area with `orientation_reversal`. Without the factor for orientation reversal, a map that
    mirrors the body would have a smaller distortion than a map with swapped legs. An energy ratio below 1 is
    replaced by its inverse, because a map that collapses a part of X is as wrong as a map that stretches it.
    If Y is a partial shape, large parts of X have no match. The energy ratio r of a correct map can then fall
    to the share s of X's area that Y covers. In this case, r is replaced by the larger of r and s / r.

    Correct maps from `Registration` have a distortion of at most 1.12 between poses of one body, and at most
    1.2 between non-isometric shapes. Most maps with swapped limbs have a distortion above 1.3.

    **Returns:** The distortion, a float without unit. For two full shapes, the distortion is at least 1.
    """
    reversed_ = orientation_reversal(pair, pointwise_map, spectrum_x, settings)
    share = float(pair.mesh_x.average(reversed_))
    ratio = dirichlet_energy_ratio(pair, pointwise_map, spectrum_x, settings)
    area_x, area_y = pair.areas
    least = min(1.0, area_y / area_x) if pair.partial else 1.0
    ratio = max(ratio, least / max(ratio, 1e-6))
    return ratio * (1 + settings.orientation_weight * share)


def discontinuous_parts(
    pair: Pair, pointwise_map: Int64[np.ndarray, " m"], settings: ScoreSettings = _DEFAULT
) -> Bool[np.ndarray, " m"]:
    """Find the vertices of X that discontinuities of the map separate from the largest part of X.

    An edge is discontinuous if its ends have matches that are far apart (`ScoreSettings` contains the
    thresholds). After the removal of discontinuous edges, X consists of one or more connected components. All
    components except the component of largest area are discontinuous parts.

    **Returns:** A mask (m,), True for vertices in discontinuous parts.
    """
    mesh = pair.mesh_x
    edges, nearest = coarse_edges(mesh)
    before, after = edge_lengths(pair, edges, pointwise_map)
    kept = edges[after < np.maximum(settings.discontinuity_distance, settings.discontinuity_ratio * before)]
    _, component = connected_components(kept, len(mesh.vertices))
    component = component[nearest]
    return component != np.argmax(np.bincount(component, mesh.vertex_areas))


def orientation_reversal(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    spectrum_x: Spectrum,
    settings: ScoreSettings = _DEFAULT,
) -> Bool[np.ndarray, " m"]:
    """Find the vertices of X around which the map exchanges left and right, as on swapped limbs.

    The matches of the three corners of a triangle of X form a triangle on Y. The area of the triangle on Y is
    taken as negative if the triangle is oriented opposite to Y's surface. The density of signed area is
    the ratio of this area to the area on X. The density is smoothed by projection onto X's first
    eigenvectors. The orientation is reversed where the smoothed density is below a threshold.

    **Returns:** A mask (m,), True for vertices around which the orientation is reversed.
    """
    mesh_x, mesh_y = pair.meshes
    unit_x, unit_y = pair.units_of_length
    corners = pointwise_map[mesh_x.faces]
    a, b, c = (mesh_y.vertices[corner] for corner in corners.T)
    normals = mesh_y.vertex_normals[corners].sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    covered = 0.5 * np.sum(np.cross(b - a, c - a) * normals, axis=1) / unit_y**2
    if mesh_x.is_inside_out != mesh_y.is_inside_out:
        covered = -covered
    # If the corners of a triangle have matches far apart, the area on Y is very large. The signed area is
    # limited, so that a single triangle does not outweigh all of its neighbours.
    most = 2 * mesh_x.face_areas / unit_x**2
    covered = np.clip(covered, -most, most)
    at_vertices = np.bincount(mesh_x.faces.ravel(), np.repeat(covered / 3, 3), len(mesh_x.vertices))
    eigenvectors = np.asarray(spectrum_x.eigenvectors)
    eigenvectors = eigenvectors[:, : settings.orientation_eigenvectors]
    return eigenvectors @ (eigenvectors.T @ at_vertices) < settings.orientation_threshold


def area_shape_difference(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    settings: ScoreSettings = _DEFAULT,
) -> float:
    """Measure how much a map changes areas.

    The measure is the norm of D - I, where D is the area-based shape difference and I is the identity. D is
    an operator on functions on Y (Rustamov et al. 2013). For two functions f and g on Y, the operator
    compares two inner products: the product of f and g on Y, and the product of their pull-backs f ∘ T and
    g ∘ T on X. In the basis of the first eigenfunctions of Y, the operator is a symmetric matrix. This matrix
    is the identity if the map preserves areas.

    **Returns:** The root mean square difference between the eigenvalues of the operator and 1, without unit.
    Typical values are 0.03 to 0.12 between poses of one body, and 0.15 to 0.5 between different animals.
    """
    used = slice(settings.area_eigenvectors)
    pulled_back = np.asarray(spectrum_y.eigenvectors[:, used], np.float64)[pointwise_map]
    areas = np.asarray(spectrum_x.vertex_areas, np.float64)
    eigenvalues = np.linalg.eigvalsh((areas * pulled_back.T) @ pulled_back)
    return float(np.sqrt(np.mean((eigenvalues - 1) ** 2)))


def edge_lengths(
    pair: Pair, edges: Int64[np.ndarray, "e 2"], pointwise_map: Int64[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Compute the lengths of edges (e, 2) of X, and the distances between the matches of their ends.

    **Returns:** The lengths of the edges on X (e,), and the Euclidean distances between the matches on Y
    (e,), both in `Pair.units_of_length`.
    """
    unit_x, unit_y = pair.units_of_length
    placed = (pair.mesh_x.vertices / unit_x, pair.mesh_y.vertices[pointwise_map] / unit_y)
    before, after = (np.linalg.norm(np.diff(v[edges], axis=1)[:, 0], axis=1) for v in placed)
    return before, after


# A vertex with this detour, in `Pair.units_of_length`, is in the overlap with a probability of one half. The
# odds fall with this power of the detour. (Entry R39 of docs/research_log.md)
_EVEN_DETOUR, _POWER = 0.03, 2
# A detour of zero counts like this share of the even detour.
_LEAST = 0.1
# The log-odds are averaged over neighbourhoods of about this radius, in the same units, by at most this
# number of averages over neighbouring vertices.
_SMOOTHED, _MOST_AVERAGES = 0.04, 20


def detours(
    pair: Pair, pointwise_map: Int64[np.ndarray, " m"], reverse_map: Int64[np.ndarray, " n"]
) -> Float[np.ndarray, " m"]:
    """Return the distance from each vertex of X to its image under the map and then the reverse map.

    **Returns:** The Euclidean distances (m,), in the unit of X in `Pair.units_of_length`.
    """
    vertices = pair.mesh_x.vertices
    offsets = vertices - vertices[reverse_map[pointwise_map]]
    return np.linalg.norm(offsets, axis=1) / pair.units_of_length[0]


def overlap_probability(
    pair: Pair, pointwise_map: Int64[np.ndarray, " m"], reverse_map: Int64[np.ndarray, " n"]
) -> Float[np.ndarray, " m"]:
    """Predict how probably each vertex of X has a counterpart on Y.

    Each vertex receives a match, even if the other shape lacks its true point. The match is then, for
    example, at the boundary of Y, and the reverse map does not lead from there back to the vertex. A vertex
    with a small detour is therefore probably in the overlap. The prediction is wrong where a part of X
    without a counterpart is matched to a part of Y without a counterpart. On coarse meshes, detours are
    compared with the mean length of the edges, because no match is more exact. The log-odds are averaged over
    small neighbourhoods.

    **Returns:** The probabilities (m,), from 0 to 1.
    """
    sides = zip(pair.meshes, pair.units_of_length, strict=True)
    edge, edge_y = (float(mesh.lengths(mesh.edges).mean()) / unit for mesh, unit in sides)
    far = detours(pair, pointwise_map, reverse_map) / max(_EVEN_DETOUR, edge, edge_y)
    averages = min(round((_SMOOTHED / edge) ** 2), _MOST_AVERAGES)
    log_odds = _averaged(pair.mesh_x, -_POWER * np.log(far + _LEAST), averages)
    return 1 / (1 + np.exp(-log_odds))


def _averaged(mesh: Mesh, values: Float[np.ndarray, " m"], averages: int) -> Float[np.ndarray, " m"]:
    """Replace the value of each vertex by the mean of itself and its neighbours, several times."""
    (first, second), m = mesh.edges.T, len(values)
    numbers = 1 + np.bincount(mesh.edges.ravel(), minlength=m)
    for _ in range(averages):
        sums = values + np.bincount(first, values[second], m) + np.bincount(second, values[first], m)
        values = sums / numbers
    return values


def expected_error(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    reverse_map: Int64[np.ndarray, " n"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    settings: ExpectedErrorSettings = ExpectedErrorSettings(),  # noqa: B008 (immutable)
    scores: ScoreSettings = ScoreSettings(),  # noqa: B008 (immutable)
) -> Float[np.ndarray, " m"]:
    """Estimate the geodesic error of every match without ground truth.

    The estimate is a weighted sum of two quantities, averaged over the neighbourhood of each vertex of X. The
    first quantity is the detour: the distance from a vertex to its image after a round trip via Y. The round
    trip consists of the map and the reverse map. The second quantity is the mean change in length of a
    vertex's edges under the map.

    Maps between non-isometric shapes can be smooth and wrong everywhere. For two full shapes, the weighted
    sum is therefore multiplied by a factor that grows with the `area_shape_difference` of the map.

    Where limbs look swapped (`discontinuous_parts`, `orientation_reversal`), the expected error also grows
    with the size of the limb. `docs/accuracy.md` reports how well the expected errors rank the vertices by
    their true errors. If a map is wrong but consistent everywhere, the expected error does not reveal the
    fault.

    **Returns:** The expected geodesic distance between every match and the true match (m,), divided by the
    square root of Y's area.
    """
    mesh_x = pair.mesh_x
    _, unit_y = pair.units_of_length
    detour = detours(pair, pointwise_map, reverse_map)
    change = np.abs(np.subtract(*edge_lengths(pair, mesh_x.edges, pointwise_map)))
    ends, m = mesh_x.edges.ravel(), len(mesh_x.vertices)
    length_change = np.bincount(ends, np.repeat(change, 2), m) / np.maximum(np.bincount(ends, minlength=m), 1)
    eigenvalues, eigenvectors, areas = (
        np.asarray(part, np.float64)
        for part in (spectrum_x.eigenvalues, spectrum_x.eigenvectors, spectrum_x.vertex_areas)
    )
    signs = settings.detour_weight * detour + settings.distortion_weight * length_change
    heat = np.exp(-settings.heat_time * eigenvalues) * (eigenvectors.T @ (areas * signs))
    misplaced = discontinuous_parts(pair, pointwise_map, scores)
    misplaced |= orientation_reversal(pair, pointwise_map, spectrum_x, scores)
    # On a swapped limb, the error of a match grows with the size of the limb.
    inside = misplaced[mesh_x.edges].all(axis=1)
    number, component = connected_components(mesh_x.edges[inside], m)
    sizes = np.sqrt(np.bincount(component, areas, number))[component]
    expected = np.maximum(eigenvectors @ heat, 0)
    if not pair.partial:
        difference = area_shape_difference(pair, pointwise_map, spectrum_x, spectrum_y, scores)
        expected *= 1 + settings.area_weight * np.log(max(difference / settings.isometric_difference, 1))
    expected += settings.misplaced_weight * misplaced * sizes
    return expected * unit_y / pair.mesh_y.area**0.5


def estimate_error(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    last: StageRun,
    settings: ExpectedErrorSettings = ExpectedErrorSettings(),  # noqa: B008 (immutable)
    scores: ScoreSettings = ScoreSettings(),  # noqa: B008 (immutable)
) -> Float[np.ndarray, " m"]:
    """Estimate the geodesic error of every match of the last stage; see `expected_error`.

    **Returns:** The expected errors (m,), divided by the square root of Y's area. A vertex that was not
    matched has the value of the nearest matched vertex.
    """
    x, y = last.seen.both
    reverse = extend_from(np.asarray(y.mask), pair.mesh_y, last.reverse_map())
    expected = expected_error(pair, pointwise_map, reverse, x, y, settings, scores)
    return extend_from(np.asarray(x.mask), pair.mesh_x, expected)
