"""Estimates the geodesic error of every match without ground truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.mesh import connected_components
from jaxsmw.pair import Pair
from jaxsmw.repair.overlap import detours
from jaxsmw.repair.scores import (
    area_shape_difference,
    discontinuous_parts,
    edge_lengths,
    orientation_reversal,
)
from jaxsmw.repair.settings import ExpectedErrorSettings, ScoreSettings


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

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `reverse_map`: a map Y -> X (n,), 0-based vertices of X.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, in `Pair.units_of_length` and without padding.
    - `settings`: the weights of the estimate.
    - `scores`: the settings of `discontinuous_parts`, `orientation_reversal` and `area_shape_difference`.

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
