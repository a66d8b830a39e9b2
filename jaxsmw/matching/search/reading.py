"""A reading of a pair: which hand the source has, and whether one shape is a part of the other."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import KDTree

from jaxsmw.errors import InputError
from jaxsmw.geometry.alignment import symmetries
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.geometry.scale import may_be_part
from jaxsmw.matching.descriptors import PrincipalAxes
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search.proxies import Proxy, SampleMap
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Preset
from jaxsmw.runtime.threads import side_by_side

# The radii of the SHOT descriptors by which candidate maps are refined, in units of 0.06, and the number of
# their principal components.
_RADII, NUMBER_OF_DESCRIPTORS = (1, 2, 4), 30

DIFFERENT = 0.2
"""Two maps differ at a point if its two matches are so far apart, in units of the square root of the area."""
COMMON = 0.25
"""The share of the area that two parts of a body have in common at least, if they can be matched."""


@dataclass(frozen=True, eq=False)
class Reading:
    """One way to read a pair, with the proxies on which its candidate maps are refined and judged.

    **Attributes:**

    - `prepared`: the `PreparedPair`. Its attributes `mirrored` and `pair.partial` tell how the pair is read.
    - `x`, `y`: the proxies of X (s samples) and of Y (t samples), in `Pair.units_of_length`.
    - `first`: the first map of the reading, from SHOT, on the samples (s,). None if there is no such map.
    - `two_parts`: whether both shapes are read as parts of a body, so that any region may lack a counterpart.
    """

    prepared: PreparedPair
    x: Proxy
    y: Proxy
    first: SampleMap | None = None
    two_parts: bool = False

    @classmethod
    def of(cls, prepared: PreparedPair) -> Reading:
        """Return the reading of a prepared pair.

        If the pair was called partial, and each mesh may be a part of a body, both shapes are read as parts.
        """

        def proxy(side: tuple[int, float]) -> Proxy:
            number, unit = side
            made = Proxy(prepared.shapes[number], unit)
            made.distances  # noqa: B018 (both shapes side by side)
            return made

        x, y = side_by_side(proxy, *enumerate(prepared.pair.units_of_length))
        two_parts = prepared.pair.partial and all(map(may_be_part, prepared.given.meshes))
        return cls(prepared, x, y, two_parts=two_parts)

    def mirror(self) -> Reading:
        """Return the reading in which X has the other hand. It has no first map."""
        return replace(self, prepared=self.prepared.mirror(), x=self.x.mirror(), first=None)

    def with_first(self, pointwise_map: Int64[np.ndarray, " m"]) -> Reading:
        """Return the reading whose first map is a map X -> Y (m,)."""
        return replace(self, first=self.reduced(pointwise_map))

    def is_asymmetric(self) -> bool:
        """Return whether both shapes differ from their own mirror images, as teeth do, but people do not.

        Samples are matched to samples of the mirror image by SHOT. The asymmetry is the distance error of
        this map, divided by that of a random map (seed 0). (Entry R23 of docs/research_log.md) SHOT cannot
        tell points of a smooth shape apart, such as a vase, so its mirror image is aligned with it as well.
        """

        def asymmetry(side: Proxy) -> float:
            own, mirrored = (
                np.hstack([one.shot(radius) for radius in _ASYMMETRY_RADII]) for one in (side, side.mirror())
            )
            matches = np.argmax(own @ mirrored.T, axis=1)  # all descriptors have the same norm
            random = np.random.default_rng(0).permutation(len(matches))
            return side.distance_error(matches) / max(side.distance_error(random), np.finfo(float).tiny)

        try:
            if np.mean(side_by_side(asymmetry, self.x, self.y)) < _ASYMMETRIC:
                return False
        except InputError:  # the samples are too sparse for SHOT
            return False
        # The limits of a symmetry hold for surfaces of area 1.
        both = ((side.positions * side.unit / side.mesh.area**0.5, side.normals) for side in (self.x, self.y))
        return not any(symmetries(*side, mirrored=True) for side in both)

    def described(self, preset: Preset) -> Reading:
        """Return the reading whose prepared pair has the descriptors that a preset uses."""
        prepared, number = self.prepared, preset.number_of_descriptors
        if not number or prepared.x.spectrum.descriptors is not None:
            return self
        return replace(self, prepared=prepared.describe(number))

    @cached_property
    def spectra(self) -> SpectralPair:
        """The spectra at the samples, with principal components of SHOT.

        The axes are the same for both hands of X, because they are fitted to both hands of both shapes.

        If the samples are too sparse for SHOT, the spectra have no descriptors.
        """
        both, twins = (self.x, self.y), (self.x.mirror(), self.y.mirror())
        rows: list[Float[np.ndarray, "s c"]] = []
        with suppress(InputError):
            rows = [np.hstack([side.shot(radius) for radius in _RADII]) for side in both + twins]
        components: list[Float[np.ndarray, "s d"] | None] = [None, None]
        if rows:
            weights = (side.areas / len(rows) for side in both + twins)
            axes = PrincipalAxes.of(zip(rows, weights, strict=True), NUMBER_OF_DESCRIPTORS)
            components = [axes.components(of_side) for of_side in rows[:2]]
        x, y = (side.sampled_spectrum(of_side) for side, of_side in zip(both, components, strict=True))
        partial = self.prepared.pair.partial
        return SpectralPair(x, y, partial=partial, common_limit=partial)

    def reduced(self, pointwise_map: Int64[np.ndarray, " m"]) -> SampleMap:
        """Return the map of the samples of a map X -> Y (m,)."""
        return self.y.samples.nearest[pointwise_map[self.x.samples.vertices]]

    def extended(self, matches: SampleMap) -> Int64[np.ndarray, " m"]:
        """Return a map X -> Y (m,) in which every vertex has the match of its sample."""
        everywhere = self.y.samples.vertices[matches][self.x.samples.nearest]
        return extend_to_unreferenced(self.prepared.pair.mesh_x, everywhere)

    def reverse(self, matches: SampleMap) -> Int64[np.ndarray, " t"]:
        """Return the map Y -> X (t,) in which each sample has the sample of X whose match is nearest."""
        return self.y.distances[:, matches].argmin(axis=1)

    def shared_areas(self, matches: SampleMap) -> Float[np.ndarray, " s"]:
        """Return the area (s,) that each sample of X represents, in all 1.

        If Y is a part of X, only the samples to which the reverse of a map takes Y have an area. The matches
        of other samples are arbitrary, because these samples have no counterpart.
        """
        if not self.prepared.pair.source_is_whole:
            return self.x.areas
        return np.bincount(self.reverse(matches), self.y.areas, len(self.x.areas))

    def difference(self, first: SampleMap, second: SampleMap) -> float:
        """Return the share of X's area, from 0 to 1, on which two maps of samples differ.

        If Y is a part of X, the share is that of the area that either map takes to Y, see `shared_areas`.
        """
        areas = (self.shared_areas(first) + self.shared_areas(second)) / 2
        return float(areas @ (self.y.distances[first, second] > DIFFERENT))

    def agreement(self, matches: SampleMap) -> float:
        """Return the share of X's area, from 0 to 1, on which a map of samples agrees with the first map.

        Without a first map, the share is 0.2, or 0.65 for two parts. This is between the shares of
        right and of wrong maps.
        """
        if self.first is None:
            return _UNKNOWN_AGREEMENT[self.two_parts]
        return 1 - self.difference(self.first, matches)

    @cached_property
    def nearest(self) -> SampleMap:
        """The map to the samples of Y at the nearest given positions (s,)."""
        placed_x, placed_y = (side.positions * side.unit for side in (self.x, self.y))
        return KDTree(placed_y).query(placed_x)[1]

    def excess(self, matches: SampleMap) -> Float[np.ndarray, " s"]:
        """Return how much farther matches (s,) lie than the nearest samples, as given, in units of Y."""
        placed = self.x.positions * self.x.unit / self.y.unit
        matched, nearest = (
            np.linalg.norm(placed - self.y.positions[samples], axis=1) for samples in (matches, self.nearest)
        )
        return matched - nearest


_UNKNOWN_AGREEMENT = 0.2, 0.65
# The radii of SHOT, in units of 0.06, and the least mean asymmetry of asymmetric shapes. (Entry R23)
_ASYMMETRY_RADII, _ASYMMETRIC = (3, 6), 0.61
