"""Alternative maps, for pairs whose usual initial map leads to exchanged limbs or to an upside-down body."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import count, islice

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.mesh import Mesh, extend_to_unreferenced
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, shot_descriptors
from jaxsmw.preparation import PreparedPair
from jaxsmw.repair.extremities import extremities, plausible_pairings
from jaxsmw.repair.outcome import Judge, Outcome
from jaxsmw.repair.proxies import Proxy, deformation
from jaxsmw.repair.settings import RepairSettings
from jaxsmw.runtime.padding import pad_rows, padded_size
from jaxsmw.runtime.threads import side_by_side
from jaxsmw.stage import Stage

# A map of samples: for each sample of X, the 0-based index of a sample of Y.
SampleMap = Int64[np.ndarray, " s"]
# The identity and the half turns about the three principal axes, as factors of the three coordinates.
_HALF_TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


class Alternatives:
    """Alternative maps of a pair, computed and compared on proxies.

    Each shape is reduced to about a thousand samples. A feature regression with few eigenvectors refines many
    initial maps of these samples. All refinements of samples take about as long as one refinement at all
    vertices. An initial map is the result of a nearest-neighbour search in features. There are three kinds of
    features:

    - SHOT with several radii. Each choice of radii gives one map.
    - SHOT and the distances to extremities, such as the ends of limbs. A pairing assigns extremities of X to
      extremities of Y. Each of the most plausible pairings gives one map.
    - SHOT and the positions along the principal axes of inertia. Four rotations align the principal axes of X
      with those of Y, and each rotation gives one map.

    For a partial pair, only the first kind is used, because the extremities and axes of a part differ from
    those of the full shape.

    **Arguments:**

    - `prepared`: the pair with its spectra.
    - `settings`: the settings of the repair.
    """

    def __init__(self, prepared: PreparedPair, settings: RepairSettings) -> None:
        assert prepared.sampled is not None
        self.prepared, self.pair, self.settings = prepared, prepared.pair, settings
        self.sampled = prepared.sampled
        sides = zip(
            self.pair.meshes,
            (prepared.spectrum_x, prepared.spectrum_y),
            self.pair.units_of_length,
            strict=True,
        )
        self.x, self.y = side_by_side(self._proxy, *sides)
        chosen = settings.alternatives
        self._stage = Stage(
            FeatureRegression(chosen.levels),
            number_of_descriptors=0 if prepared.spectrum_x.descriptors is None else chosen.descriptors,
        ).fitted(min(len(self.x.areas), len(self.y.areas)))
        spectra = self._stage.view(
            self.x.sampled_spectrum(), self.y.sampled_spectrum(), partial=self.pair.partial
        )
        self._spectra = [spectrum.pad(padded_size(len(spectrum.mask))) for spectrum in spectra]
        coarse_x, coarse_y = (
            side.truncate(chosen.eigenvectors) for side in (prepared.spectrum_x, prepared.spectrum_y)
        )
        self.judge = Judge(self.pair, coarse_x, coarse_y, settings, self.deformation)

    def _proxy(self, side: tuple[Mesh, Spectrum, float]) -> Proxy:
        mesh, spectrum, unit = side
        number = min(self.settings.alternatives.samples, int(mesh.referenced_vertices.sum()))
        samples = SurfaceSamples.along_surface(mesh, farthest_point_samples(mesh, number))
        return Proxy(mesh, spectrum, samples, unit)

    def deformation(self, pointwise_map: Int64[np.ndarray, " m"]) -> float:
        """Return the deformation of a map X -> Y (m,), measured on the proxies."""
        radius = self.settings.alternatives.patch_radius
        return deformation(self.x, self.y, self._reduced(pointwise_map), radius)

    def best(self, *known: Int64[np.ndarray, " m"]) -> Iterator[Int64[np.ndarray, " m"]]:
        """Yield alternative maps that differ from each other. Maps with better scores mostly come first.

        The best refined maps are repaired. For each fault of such a map, a refinement without the faulty
        vertices gives a further map.

        **Arguments:**

        - `known`: maps X -> Y (m,), which are refined as further initial maps.

        **Returns:** An iterator over maps T: X -> Y (m,), 0-based vertices of Y.
        """
        outcomes = self._refined([*self._initial_maps(), *map(self._reduced, known)])
        repaired = islice(self._distinct(outcomes), self.settings.alternatives.repaired)
        outcomes = self._sorted(outcomes + self._without_faults(list(repaired)))
        score, margin = self.judge.score, self.settings.alternatives.margin
        close = [outcome for outcome in outcomes if score(outcome) <= score(outcomes[0]) + margin]
        for outcome in self._distinct(close):
            yield outcome.unpadded_map(self.pair)

    def _distinct(self, outcomes: Sequence[Outcome]) -> Iterator[Outcome]:
        """Choose outcomes that differ from each other, and yield them.

        The given outcomes must be sorted by their scores. Each yielded outcome differs from all earlier
        outcomes on a minimum share of X's area; see `AlternativeSettings.different_areas`.
        """
        areas = self.settings.alternatives.different_areas
        # Each entry contains an outcome and its smallest difference from the outcomes yielded so far.
        differences = [(outcome, 1.0) for outcome in outcomes]
        for number in count():
            least = areas[min(max(number - 1, 0), len(areas) - 1)]
            chosen = next((outcome for outcome, area in differences if area >= least), None)
            if chosen is None:
                return
            yield chosen
            differences = [
                (other, min(area, self.judge.difference(other, chosen))) for other, area in differences
            ]

    def _without_faults(self, outcomes: Sequence[Outcome]) -> list[Outcome]:
        """For each fault of each outcome, refine the map without the faulty vertices."""
        faulty = [(outcome, fault) for outcome in outcomes for fault in self.judge.faults(outcome)]
        maps = [self._reduced(one.unpadded_map(self.pair)) for one, _ in faulty]
        return self._refined(maps, [fault[self.x.samples.vertices] for _, fault in faulty])

    def _initial_maps(self) -> Iterator[SampleMap]:
        """Yield the initial maps, each from the samples of X to the samples of Y."""
        settings = self.settings.alternatives
        usual = self._usual_shot()
        for radii in settings.radii:
            of_x, of_y = zip(*(usual if r == 1 else self._shot(r) for r in radii), strict=True)
            yield np.argmin(_squares(np.hstack(of_x), np.hstack(of_y)), axis=1)
        if self.pair.partial:
            return
        shot = _squares(*usual)
        yield from self._by_extremities(shot)
        frame_x, frame_y = _principal_frame(self.x), _principal_frame(self.y)
        for signs in _HALF_TURNS:
            positions = settings.position_weight * _squares(frame_x * signs, frame_y)
            yield np.argmin(shot + positions, axis=1)

    def _by_extremities(self, shot: Float[np.ndarray, "s t"]) -> Iterator[SampleMap]:
        """Yield the initial maps from pairings of extremities.

        Pairings with the most similar features come first.

        **Arguments:**

        - `shot`: the squared differences of SHOT (s, t) between the s samples of X and the t samples of Y.
        """
        settings = self.settings.alternatives
        ends = extremities(self.x, settings.extremities), extremities(self.y, settings.extremities)
        # Limbs of different animals differ in length, so distances are divided by their mean.
        to_ends = [
            proxy.distances[:, of_side.samples] / (proxy.areas @ proxy.distances[:, of_side.samples])
            for of_side, proxy in zip(ends, (self.x, self.y), strict=True)
        ]

        def costs(pairing: Int64[np.ndarray, "l 2"], weight: float, rows: slice) -> Float[np.ndarray, "a b"]:
            of_x, of_y = (distances[rows, side] for distances, side in zip(to_ends, pairing.T, strict=True))
            return weight * shot[rows, rows] + settings.distance_weight * _squares(of_x, of_y)

        def residual(pairing: Int64[np.ndarray, "l 2"]) -> float:
            rows = slice(None, None, 3)  # a third of the samples is enough for a comparison
            cost = costs(pairing, 0.3, rows)
            return float(
                np.average(cost.min(axis=1), weights=self.x.areas[rows])
                + np.average(cost.min(axis=0), weights=self.y.areas[rows])
            )

        pairings = plausible_pairings(*ends, settings.compared_pairings)
        for pairing in sorted(pairings, key=residual)[: settings.pairings]:
            yield np.argmin(costs(pairing, 1.0, slice(None)), axis=1)

    def _usual_shot(self) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "t d"]]:
        return tuple(
            shot[side.rows(proxy.samples.vertices)]
            for shot, side, proxy in zip(self.sampled.shot, self.sampled.sides, (self.x, self.y), strict=True)
        )

    def _shot(self, multiple: int) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "t d"]]:
        """Compute SHOT with a multiple of the usual radius at all samples."""

        def of_one(argument: tuple[Proxy, float]) -> Float[np.ndarray, "s d"]:
            proxy, unit = argument
            radius = multiple * SHOT_RADIUS * unit / proxy.mesh.area**0.5
            return shot_descriptors(proxy.mesh, radius=radius, samples=proxy.samples)

        return side_by_side(of_one, *zip((self.x, self.y), self.pair.units_of_length, strict=True))

    def _refined(
        self, initial: Sequence[SampleMap], faults: Sequence[Bool[np.ndarray, " s"]] | None = None
    ) -> list[Outcome]:
        """Refine maps of samples.

        **Arguments:**

        - `initial`: the maps.
        - `faults`: for each map, a mask of the samples of X (s,) that are left out. The default is to use all
          samples.

        **Returns:** The successful outcomes, the best score first. Their maps are extended to all vertices.
        """
        x, y = self._spectra
        size, used = len(x.mask), len(self.x.areas)
        outcomes = []
        for number, start in enumerate(initial):
            weighted = x if faults is None else x.excluding(jnp.asarray(pad_rows(faults[number], size)))
            padded = jax.device_put(pad_rows(start, size).astype(np.int32))
            found = self._stage.run(weighted, y, padded, partial=self.pair.partial)
            if found.result == RESULTS.successful:
                of_samples = np.asarray(found.pointwise_map)[:used].astype(np.int64)
                everywhere = jax.device_put(self._extended(of_samples))
                found = eqx.tree_at(lambda tree: tree.pointwise_map, found, everywhere)
                outcomes.append(self.judge.judged(Outcome([found], everywhere)))
        return self._sorted(outcomes)

    def _sorted(self, outcomes: Sequence[Outcome]) -> list[Outcome]:
        return sorted(outcomes, key=self.judge.score)

    def _reduced(self, pointwise_map: Int64[np.ndarray, " m"]) -> SampleMap:
        return self.y.samples.nearest[pointwise_map[self.x.samples.vertices]]

    def _extended(self, found: SampleMap) -> Int64[np.ndarray, " m"]:
        everywhere = self.y.samples.vertices[found][self.x.samples.nearest]
        return extend_to_unreferenced(self.pair.mesh_x, everywhere)


def _squares(x: Float[np.ndarray, "s d"], y: Float[np.ndarray, "t d"]) -> Float[np.ndarray, "s t"]:
    """Return the squared distance between each row of `x` and each row of `y`."""
    # A matrix product takes a fraction of the time of `cdist`.
    return np.sum(x**2, axis=1)[:, None] + np.sum(y**2, axis=1) - 2 * x @ y.T


def _principal_frame(proxy: Proxy) -> Float[np.ndarray, "s 3"]:
    """Return the positions along the principal axes of inertia, in units of the radius of gyration."""
    centered = proxy.positions - proxy.areas @ proxy.positions
    variances, axes = np.linalg.eigh((proxy.areas * centered.T) @ centered)
    axes = axes[:, ::-1] * [1, 1, np.sign(np.linalg.det(axes[:, ::-1]))]
    return centered @ axes / np.sqrt(variances.sum())
