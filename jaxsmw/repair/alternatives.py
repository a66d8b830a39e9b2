"""Alternative initial maps, for pairs on which the usual initial map exchanges limbs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from itertools import islice

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Int64

from jaxsmw.core.functional_map import encode, multiscale_kernel
from jaxsmw.core.pointwise_map import chosen_patches, decode
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import SampledPair, paired_shot, sample_pair
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.geometry.sampling import farthest_point_samples, poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_RADIUS
from jaxsmw.initial_maps.landmarks import distance_features
from jaxsmw.initial_maps.nearest import nearest_among_compared, nearest_map, to_all_vertices
from jaxsmw.pair import Pair
from jaxsmw.repair.extremities import extremities, plausible_pairings
from jaxsmw.repair.outcome import Outcome, score
from jaxsmw.repair.scores import distinct, distortion, same_map
from jaxsmw.repair.settings import RepairSettings
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size
from jaxsmw.runtime.threads import side_by_side
from jaxsmw.stage import Stage

_Shot = tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]


def alternative_initial_maps(
    pair: Pair,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    settings: RepairSettings = RepairSettings(),  # noqa: B008 (immutable)
) -> Iterator[Int64[np.ndarray, " m"]]:
    """Yield alternative initial maps, which are computed one by one.

    Each of the first alternative initial maps is computed from two functional maps. A nearest-neighbour
    search in SHOT from X to Y gives one functional map, and a search from Y to X gives another functional
    map. The weighted mean of both functional maps is filtered as in the MWP paper and converted to a
    pointwise map. `RepairSettings.alternatives` lists the radii of SHOT and the weights.

    For two full shapes with descriptors (`describe`), further maps come from pairings of the extremities of X
    with the extremities of Y. The pairings are selected by the distances between extremities. For each
    pairing, a nearest-neighbour search in SHOT and in distances to the extremities gives a map. A feature
    regression with few eigenvectors refines this map. Of the refined maps, the best-scoring maps that differ
    from each other are yielded.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y in comparable units, from `paired_spectra`.
    - `settings`: the settings of the repair.

    **Returns:** An iterator over maps T: X -> Y (m,), 0-based vertices of Y.

    **Raises:** `InputError` if a mesh is too coarse for SHOT, or a spectrum belongs to another mesh.
    """
    sampled = sample_pair(pair, spectrum_x, spectrum_y)

    @cache
    def shot(multiple: int) -> _Shot:
        return paired_shot(sampled, multiple * SHOT_RADIUS)

    for multiples, weight in settings.alternatives:
        features_x, features_y = (np.hstack(side) for side in zip(*map(shot, multiples), strict=True))
        k = settings.alternative_eigenvectors
        truncated = spectrum_x.truncate(k), spectrum_y.truncate(k)
        yield extend_to_unreferenced(
            pair.mesh_x, _in_both_directions(sampled, features_x, features_y, weight, *truncated)
        )
    if not pair.partial and spectrum_x.descriptors is not None:
        yield from _by_extremities(sampled, shot(1), spectrum_x, settings)


def _in_both_directions(
    sampled: SampledPair,
    features_x: Float[np.ndarray, "a d"],
    features_y: Float[np.ndarray, "b d"],
    weight: float,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
) -> Int64[np.ndarray, " m"]:
    """Compute the pointwise map from the weighted mean of two functional maps.

    A nearest-neighbour search in feature space from X to Y gives the functional map of weight `1 - weight`. A
    search from Y to X gives the functional map of weight `weight`.
    """
    reversed_ = SampledPair(sampled.pair.reversed(), sampled.y, sampled.x)
    forward = nearest_map(sampled, features_x, features_y)
    backward = nearest_map(reversed_, features_y, features_x)
    on_device = jax.device_put((forward, backward, spectrum_x.eigenvalues.dtype.type(weight)))
    found = compiled(_decode_mean)(on_device, spectrum_x, spectrum_y)
    return np.asarray(found).astype(np.int64)


def _decode_mean(
    maps_and_weight: tuple[Int[Array, " m"], Int[Array, " n"], Float[Array, ""]],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
) -> Int[Array, " m"]:
    forward, backward, reverse_weight = maps_and_weight
    responses = WaveletPreservation().problem(spectrum_x, spectrum_y).responses
    of_forward = encode(forward, spectrum_x, spectrum_y)
    of_backward = encode(backward, spectrum_y, spectrum_x).T
    mean = (1 - reverse_weight) * of_forward + reverse_weight * of_backward
    patches = chosen_patches("auto", spectrum_x, spectrum_y)
    return decode(mean * multiscale_kernel(*responses), spectrum_x, spectrum_y, patches=patches)


def _by_extremities(
    sampled: SampledPair, shot: _Shot, spectrum_x: Spectrum, settings: RepairSettings
) -> Iterator[Int64[np.ndarray, " m"]]:
    """Yield maps from pairings of extremities.

    `spectrum_x` is the spectrum at all vertices of X, which is needed for the scores.
    """
    pair = sampled.pair
    refinement = _CoarseRefinement(sampled, settings)
    ends = side_by_side(lambda side: extremities(side.mesh, settings.extremities), *sampled.sides)
    distances = [
        distance_features(side, of_side.vertices, unit)
        for side, of_side, unit in zip(sampled.sides, ends, pair.units_of_length, strict=True)
    ]
    outcomes = []
    for pairing in plausible_pairings(*ends, settings.extremity_pairings):
        features_x, features_y = (
            np.hstack([described, to_ends[:, chosen]])
            for described, to_ends, chosen in zip(shot, distances, pairing.T, strict=True)
        )
        outcome = refinement(features_x, features_y)
        if outcome.successful:
            found = np.asarray(outcome.pointwise_map)[: len(sampled.x.spectrum.mask)].astype(np.int64)
            everywhere = to_all_vertices(sampled, found)
            measured = distortion(pair, everywhere, spectrum_x, settings.scores)
            outcome = outcome._replace(distortion=measured)
            outcomes.append((score(outcome, settings.uncertainty_weight), everywhere))
    outcomes.sort(key=lambda outcome: outcome[0])
    same = partial(same_map, pair, settings=settings.scores)
    for everywhere in islice(distinct((found for _, found in outcomes), same), settings.extremity_maps):
        yield extend_to_unreferenced(pair.mesh_x, everywhere)


class _CoarseRefinement:
    """A function that computes maps by nearest-neighbour search and refines them by a feature regression.

    A coarse feature regression suffices to determine the match of each limb. The nearest-neighbour search is
    made only for evenly spread vertices of X, and every other vertex receives the match of the nearest such
    vertex.
    """

    def __init__(self, sampled: SampledPair, settings: RepairSettings) -> None:
        fewest = sampled.pair.fewest_vertices()
        self.stage = Stage(
            FeatureRegression(levels=settings.extremity_levels),
            number_of_descriptors=settings.extremity_descriptors,
            number_of_samples=settings.extremity_samples,
        ).fitted(fewest)
        count = self.stage.number_of_samples or fewest
        queries = poisson_disk_samples(sampled.x.mesh, count)
        self.sampled = sampled
        self.rows = sampled.x.rows(queries.vertices)
        samples = sampled.x.samples
        self.nearest_query = queries.nearest if samples is None else queries.nearest[samples.vertices]
        self.spectrum_x, self.spectrum_y = (
            spectrum.pad(padded_size(len(spectrum.mask)))
            for spectrum in self.stage.view(sampled.x.spectrum, sampled.y.spectrum)
        )
        self.samples = tuple(
            jax.device_put(side.rows(farthest_point_samples(side.mesh, count))) for side in sampled.sides
        )

    def __call__(self, features_x: Float[np.ndarray, "m d"], features_y: Float[np.ndarray, "n d"]) -> Outcome:
        """Run the feature regression and return its outcome, whose distortion is None."""
        nearest = nearest_among_compared(features_x[self.rows], features_y, self.sampled.y)
        padded = pad_rows(nearest[self.nearest_query], len(self.spectrum_x.mask))
        first = jax.device_put(padded.astype(np.int32))
        return Outcome([self.stage.run(self.spectrum_x, self.spectrum_y, first, self.samples)], first)
