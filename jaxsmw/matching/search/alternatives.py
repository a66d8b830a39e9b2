"""Alternative maps, for pairs whose usual initial map leads to exchanged limbs or to an upside-down body."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, count, islice, repeat
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples
from jaxsmw.geometry.shot import SHOT_RADIUS
from jaxsmw.matching.executor import run
from jaxsmw.matching.judge import Judge, Scored
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search.proxies import Proxy, deformation, extremities, map_difference, plausible_pairings
from jaxsmw.matching.settings import RepairSettings
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.threads import side_by_side

# A map of samples: for each sample of X, the 0-based index of a sample of Y.
SampleMap = Int64[np.ndarray, " s"]
# The identity and the half turns about the three principal axes, as factors of the three coordinates.
_HALF_TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


class _Candidate(NamedTuple):
    """A refined map of samples, and its score; see `Judge.score`."""

    score: float
    matches: SampleMap


class Alternatives:
    """Alternative maps of a pair, computed and compared on proxies of about a thousand samples.

    docs/how_it_works.md lists the initial maps. A feature regression with few eigenvectors refines them. Five
    refinements of samples take about as long as one refinement at all vertices. For a partial pair, only SHOT
    gives initial maps, because the extremities and axes of a part differ from those of the full shape.

    **Arguments:**

    - `prepared`: the pair with its spectra.
    - `settings`: the settings of the repair.
    """

    def __init__(self, prepared: PreparedPair, settings: RepairSettings) -> None:
        self.prepared, self.pair, self.settings = prepared, prepared.pair, settings
        sides = zip(prepared.shapes, self.pair.units_of_length, strict=True)
        self.x, self.y = side_by_side(self._proxy, *sides)
        chosen = settings.alternatives
        self._stage = Stage(
            FeatureRegression(chosen.levels),
            number_of_descriptors=0 if prepared.x.spectrum.descriptors is None else chosen.descriptors,
        )
        partial = self.pair.partial
        sampled = self.x.sampled_spectrum(), self.y.sampled_spectrum()
        self._spectra = SpectralPair(*sampled, partial=partial, common_limit=partial)
        # Distortions need few eigenvectors.
        x, y = (side.spectrum.truncate(chosen.eigenvectors) for side in prepared.shapes)
        self._judged_spectra = SpectralPair(x, y)

    @property
    def _judge(self) -> Judge:
        # If the judge were an attribute, both objects would refer to each other. Python frees such objects
        # late, and with them all arrays of the pair.
        return Judge(self.pair, self._judged_spectra, self.settings.judge, self.deformation)

    def _proxy(self, side: tuple[PreparedShape, float]) -> Proxy:
        shape, unit = side
        number = min(self.settings.alternatives.samples, len(shape.mesh.referenced_indices))
        samples = SurfaceSamples.along_surface(shape.mesh, farthest_point_samples(shape.mesh, number))
        return Proxy(shape.mesh, shape.spectrum, samples, unit)

    @property
    def has_creases(self) -> bool:
        """Whether `best` can use crease eigenvectors."""
        shapes = self.prepared.shapes
        available = all(shape.spectrum.crease_eigenvectors is not None for shape in shapes)
        return available and self.settings.alternatives.crease_eigenvectors > 0

    def deformation(self, pointwise_map: Int64[np.ndarray, " m"]) -> float:
        """Return the deformation of a map X -> Y (m,), measured on the proxies."""
        radius = self.settings.alternatives.patch_radius
        return deformation(self.x, self.y, self._reduced(pointwise_map), radius)

    def different(self, best: Scored, others: Sequence[Scored]) -> tuple[Scored, ...]:
        """Return the other maps that differ from the given map and from each other.

        Two maps differ if they differ on at least the first share of `AlternativeSettings.different_areas`.
        """
        kept = [best]
        for other in others:
            reduced = self._reduced(other.pointwise_map)
            known = (self._reduced(one.pointwise_map) for one in kept)
            least = self.settings.alternatives.different_areas[0]
            if all(self._difference(reduced, one) >= least for one in known):
                kept.append(other)
        return tuple(kept[1:])

    def best(
        self, known: Int64[np.ndarray, " m"], *, only_better: bool = False, creased: bool = False
    ) -> Iterator[Int64[np.ndarray, " m"]]:
        """Yield alternative maps that differ from each other. Maps with better scores mostly come first.

        All initial maps are refined. For each fault of the best refined maps, a refinement without the faulty
        samples gives a further map. The most promising of all these maps are then refined once more, with
        `fine_levels`. Afterwards, right maps are easier to distinguish from wrong maps. (Table R40)

        **Arguments:**

        - `known`: a map X -> Y (m,), which is refined as a further initial map.
        - `only_better`: whether the iterator ends at the first map that does not differ from `known`.
        - `creased`: whether the first refinement uses crease eigenvectors; see `has_creases`.

        **Returns:** An iterator over maps T: X -> Y (m,), 0-based vertices of Y.
        """
        chosen, usual = self.settings.alternatives, self._reduced(known)
        stage = self._stage
        if creased:
            stage = replace(stage, number_of_crease_eigenvectors=chosen.crease_eigenvectors)
        coarse = self._refined(stage, chain(self._initial_maps(), [usual]))
        repaired = self._without_faults(stage, islice(self._distinct(coarse), chosen.repaired))
        coarse = sorted(coarse + repaired, key=lambda candidate: candidate.score)
        promising = islice(self._distinct(_within(chosen.coarse_margin, coarse)), chosen.promising)
        finer = self._stage.with_levels(chosen.fine_levels)
        fine = self._refined(finer, [candidate.matches for candidate in promising])
        for candidate in self._distinct(_within(chosen.margin, fine)):
            if only_better and self._difference(candidate.matches, usual) < chosen.different_areas[0]:
                return
            yield self._extended(candidate.matches)

    def _distinct(self, candidates: Sequence[_Candidate]) -> Iterator[_Candidate]:
        """Choose candidates that differ from each other, and yield them.

        The given candidates must be sorted by their scores. Each yielded candidate differs from all earlier
        ones on a minimum share of X's area; see `AlternativeSettings.different_areas`.
        """
        areas = self.settings.alternatives.different_areas
        # Each entry contains a candidate and its smallest difference from the candidates yielded so far.
        differences = [(candidate, 1.0) for candidate in candidates]
        for number in count():
            least = areas[min(max(number - 1, 0), len(areas) - 1)]
            chosen = next((candidate for candidate, area in differences if area >= least), None)
            if chosen is None:
                return
            yield chosen
            differences = [
                (other, min(area, self._difference(other.matches, chosen.matches)))
                for other, area in differences
            ]

    def _difference(self, first: SampleMap, second: SampleMap) -> float:
        return map_difference(self.x, self.y, first, second, self.settings.alternatives.different_distance)

    def _without_faults(self, stage: Stage, candidates: Iterable[_Candidate]) -> list[_Candidate]:
        """For each fault of each candidate, refine the map of samples without the faulty ones."""
        starts, faults = [], []
        for candidate in candidates:
            for fault in self._judge.faults(self._extended(candidate.matches)):
                starts.append(candidate.matches)
                faults.append(fault[self.x.samples.vertices])
        return self._refined(stage, starts, faults)

    def _initial_maps(self) -> Iterator[SampleMap]:
        """Yield the initial maps, each from the samples of X to the samples of Y."""
        settings = self.settings.alternatives
        usual, at = self._usual_shot(), (self.x.samples, self.y.samples)
        for radii in settings.radii:
            of_x, of_y = zip(
                *(usual if r == 1 else self.prepared.shot_of_radius(r * SHOT_RADIUS, at) for r in radii),
                strict=True,
            )
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
        ends = extremities(self.x), extremities(self.y)
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
            shot[shape.compared_rows(proxy.samples.vertices)]
            for shot, shape, proxy in zip(
                self.prepared.shot, self.prepared.shapes, (self.x, self.y), strict=True
            )
        )

    def _refined(
        self,
        stage: Stage,
        initial: Iterable[SampleMap],
        faults: Iterable[Bool[np.ndarray, " s"] | None] = repeat(None),
    ) -> list[_Candidate]:
        """Refine maps of samples by a stage, and return the successful results, the best score first.

        With `faults`, map number i is refined without the samples of X in the mask `faults[i]`.
        """
        fitted = stage.fitted(min(len(self.x.areas), len(self.y.areas)))
        starts = (Start(start, excluded=fault) for start, fault in zip(initial, faults, strict=False))
        candidates = []
        # All refinements are started first. The host scores a finished refinement while the others run.
        for outcome in [run([fitted], self._spectra, start) for start in starts]:
            if outcome.successful:
                matches = outcome.pointwise_map
                score = self._judge.score_map(self._extended(matches), outcome.uncertainty)
                candidates.append(_Candidate(score, matches))
        return sorted(candidates, key=lambda candidate: candidate.score)

    def _reduced(self, pointwise_map: Int64[np.ndarray, " m"]) -> SampleMap:
        return self.y.samples.nearest[pointwise_map[self.x.samples.vertices]]

    def _extended(self, matches: SampleMap) -> Int64[np.ndarray, " m"]:
        everywhere = self.y.samples.vertices[matches][self.x.samples.nearest]
        return extend_to_unreferenced(self.pair.mesh_x, everywhere)


def _within(margin: float, candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the candidates whose scores exceed the best score by at most `margin`."""
    return [one for one in candidates if one.score <= candidates[0].score + margin]


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
