"""The search for the hand of a pair: whether X or the mirror image of X corresponds to Y."""

from __future__ import annotations

import warnings
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int64
from scipy.sparse import coo_array, csgraph
from scipy.spatial.distance import cdist

from jaxsmw.core.refiner import Problem, Refiner, State
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import principal_components
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, mirrored_descriptors, shot_descriptors
from jaxsmw.pair import Pair
from jaxsmw.repair.settings import ChiralitySettings
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size
from jaxsmw.runtime.threads import side_by_side
from jaxsmw.stage import Stage

_Map = Int64[np.ndarray, " s"]
_Distances = Float[np.ndarray, "s s"]


class Hands:
    """A comparison of the two hands of a pair: X itself, and the mirror image of X.

    Both hands have the same distances along the surface, and the same spectrum. Only descriptors that
    distinguish left from right differ, such as SHOT. If the mirror image of X corresponds to Y, descriptors
    of X itself agree with Y only in scattered places, and lead to a map that does not preserve distances. The
    evidence compares how well maps of both hands preserve distances. Most bodies are their own mirror image,
    up to pose; for these bodies, maps of both hands preserve distances equally well.

    All evidence is the logarithm of a ratio: the distance error of the map of X itself, divided by the
    distance error of the map of its mirror image. Positive evidence supports the mirror image. The distance
    error of a map is the mean absolute difference between the distance of two points of X and the distance of
    their matches.

    **Arguments:**

    - `pair`: two full shapes, the source X (m vertices) and the target Y (n vertices).
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, from `paired_spectra`.
    - `settings`: the settings of the search.
    """

    def __init__(
        self,
        pair: Pair,
        spectrum_x: Spectrum,
        spectrum_y: Spectrum,
        settings: ChiralitySettings = ChiralitySettings(),  # noqa: B008 (immutable)
    ) -> None:
        self.settings = settings
        self.stage = Stage(
            FeatureRegression(levels=settings.levels), number_of_descriptors=settings.descriptors
        )
        self.x, self.y = side_by_side(self._shape, (pair.mesh_x, spectrum_x), (pair.mesh_y, spectrum_y))

    def evidence(self) -> float | None:
        """Compare coarse maps of both hands.

        The coarse maps come from nearest neighbours of SHOT with large radii, and are refined by a feature
        regression with few eigenvectors, at evenly spread samples. Several sets of radii give several pairs
        of maps. The least evidence counts, because by chance one of two wrong maps can be much better than
        the other. Further sets are not tried once the evidence is too small for the mirror image.

        **Returns:** The evidence for the mirror image, without unit; None if a mesh is too coarse.
        """
        if min(len(shape.areas) for shape in (self.x, self.y)) < self.settings.fewest_samples:
            return None
        least = np.inf
        for radii in self.settings.radii:
            try:
                least = min(least, self._evidence_of(radii))
            except InputError:  # the samples are too sparse for these radii
                return None
            if least < self.settings.mirrored_from - self.settings.doubt:
                break
        return float(least)

    def _evidence_of(self, radii: tuple[int, ...]) -> float:
        """Return the evidence of the maps from SHOT with the given radii."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # sparse samples only weaken the evidence
            shot_x, shot_y = side_by_side(lambda shape: self._shot(shape, radii), self.x, self.y)
        mirrored = np.hstack([mirrored_descriptors(one) for one in shot_x])
        shot = [np.hstack(shot_x), mirrored, np.hstack(shot_y)]
        areas = [self.x.areas / 2, self.x.areas / 2, self.y.areas]
        components = principal_components(
            np.concatenate(shot), np.concatenate(areas) / 2, self.stage.number_of_descriptors
        )
        *of_x, of_y = np.split(components, np.cumsum([len(rows) for rows in shot])[:-1])
        errors = []
        for features, described in zip(shot[:2], of_x, strict=True):
            first = np.argmin(cdist(features, shot[2]), axis=1)
            forward, backward = self._refined(first, described, of_y)
            errors.append(
                _distance_error(self.x, self.y, forward) + _distance_error(self.y, self.x, backward)
            )
        return _log_ratio(*errors)

    def _shape(self, argument: tuple[Mesh, Spectrum]) -> _Shape:
        mesh, spectrum = argument
        return _Shape(mesh, poisson_disk_samples(mesh, self.settings.samples), spectrum)

    def _shot(self, shape: _Shape, radii: tuple[int, ...]) -> list[Float[np.ndarray, "s 352"]]:
        return [
            shot_descriptors(shape.mesh, radius=multiple * SHOT_RADIUS, samples=shape.samples)
            for multiple in radii
        ]

    def _refined(
        self, first: _Map, described_x: Float[np.ndarray, "s d"], described_y: Float[np.ndarray, "t d"]
    ) -> tuple[_Map, Int64[np.ndarray, " t"]]:
        """Refine a map from X to Y, and return the refined map and its reverse map."""
        spectra = self.x.described(described_x), self.y.described(described_y)
        size = max(padded_size(len(spectrum.mask)) for spectrum in spectra)
        views = [spectrum.pad(size) for spectrum in self.stage.view(*spectra)]
        start = jax.device_put(pad_rows(first, size).astype(np.int32))
        found = self.stage.run(views[0], views[1], start)
        reverse = compiled(_reverse_map)(self.stage.refiner, Problem(views[0], views[1]), found.state)
        forward, backward = (np.asarray(T).astype(np.int64) for T in (found.pointwise_map, reverse))
        return forward[: len(described_x)], backward[: len(described_y)]


class _Shape:
    """A shape with its evenly spread samples. Lengths are in units of the square root of the area."""

    def __init__(self, mesh: Mesh, samples: SurfaceSamples, spectrum: Spectrum) -> None:
        self.mesh, self.samples, self.spectrum = mesh, samples, spectrum
        areas = np.bincount(samples.nearest, mesh.vertex_areas, len(samples.vertices))
        self.areas = areas / mesh.area

    def described(self, descriptors: Float[np.ndarray, "s d"]) -> Spectrum:
        """Return the spectrum at the samples, with their areas and with the given descriptors."""
        sampled = self.spectrum.sample(jnp.asarray(self.samples.vertices))
        dtype = sampled.eigenvectors.dtype
        return Spectrum(
            sampled.eigenvalues,
            sampled.eigenvectors,
            jnp.asarray(self.areas, dtype),
            sampled.mask,
            jnp.asarray(descriptors, dtype),
        )

    @cached_property
    def distances(self) -> _Distances:
        """Distances between the samples: lengths of shortest paths over samples with adjacent regions.

        Between two connected components, the distance is the distance in space.
        """
        nearest, vertices = self.samples.nearest, self.samples.vertices
        pairs = np.unique(np.sort(nearest[self.mesh.edges], axis=1), axis=0)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        places = self.mesh.vertices[vertices] / self.mesh.area**0.5
        lengths = np.linalg.norm(np.diff(places[pairs], axis=1)[:, 0], axis=1)
        graph = coo_array((lengths, tuple(pairs.T)), (len(vertices),) * 2).tocsr()
        along = csgraph.dijkstra(graph, directed=False)
        return np.where(np.isfinite(along), along, cdist(places, places))


def _distance_error(x: _Shape, y: _Shape, found: _Map) -> float:
    """Return the mean absolute difference between distances on X and distances of the matches on Y."""
    return float(x.areas @ np.abs(x.distances - y.distances[np.ix_(found, found)]) @ x.areas)


def _log_ratio(own: float, mirrored: float) -> float:
    tiny = 1e-9  # two maps without distance errors are equally good
    return float(np.log((own + tiny) / (mirrored + tiny)))


def _reverse_map(refiner: Refiner, problem: Problem, state: State) -> Int[Array, " n"]:
    return refiner.recover_reverse(refiner.prepare(problem), state)


class Decision(NamedTuple):
    """The hand of a pair.

    **Attributes:**

    - `mirrored`: whether the mirror image of X corresponds to Y.
    - `evidence`: the evidence for the mirror image; see `Hands`. None if the hand was given.
    - `doubtful`: whether the evidence is near the threshold.
    """

    mirrored: bool
    evidence: float | None = None
    doubtful: bool = False


def decide(evidence: float | None, settings: ChiralitySettings = ChiralitySettings()) -> Decision:  # noqa: B008
    """Decide between the hands of a pair.

    **Arguments:**

    - `evidence`: the evidence for the mirror image, or None if there is none.
    - `settings`: the thresholds.
    """
    if evidence is None:
        return Decision(False)
    return Decision(
        evidence >= settings.mirrored_from, evidence, abs(evidence - settings.mirrored_from) < settings.doubt
    )
