"""The decision whether X or the mirror image of X corresponds to Y."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.choices import Mirror
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, mirrored_descriptors, shot_descriptors
from jaxsmw.matching.descriptors import PrincipalAxes
from jaxsmw.matching.executor import run
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.search.proxies import Proxy, distance_error
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.cache import cached
from jaxsmw.runtime.threads import side_by_side

# The approximate number of evenly spread samples of each shape. If a shape has fewer than `_FEWEST` samples,
# X itself is matched without a comparison, because fewer samples do not suffice for a regression with 50
# features.
_SAMPLES, _FEWEST = 1000, 100
# The sets of radii of SHOT, in units of 0.06 times the square root of the area. For each set, coarse maps are
# computed both from X and from its mirror image. With the usual radius alone, descriptors hardly distinguish
# a tooth from its mirror image. (Entry R20 of docs/research_log.md)
_RADII = ((2, 4, 8), (4, 8))
# The stage that refines coarse maps.
_STAGE = Stage(FeatureRegression(levels=(8, 8, 11, 11, 15, 15, 20, 20)), number_of_descriptors=30)
# The radii of SHOT when the asymmetry is computed. (Entry R23)
_ASYMMETRY_RADII = (3, 6)
# Shapes are asymmetric if the mean asymmetry of X and Y is at least `ASYMMETRIC_FROM`. If it is smaller by up
# to `ASYMMETRY_DOUBT`, the decision is doubtful where the evidence supports the mirror image. (Entry R23)
ASYMMETRIC_FROM, ASYMMETRY_DOUBT = 0.61, 0.04
# For asymmetric shapes, the mirror image of X is matched if the evidence is at least `MIRRORED_FROM`. The
# decision is doubtful if the evidence differs from this value by less than `DOUBT`. (Entry R21)
MIRRORED_FROM, DOUBT = 0.05, 0.05


class Hands:
    """A comparison that decides whether X or the mirror image of X corresponds to Y.

    X and its mirror image have the same distances along the surface, and the same spectrum. They differ only
    in descriptors that distinguish left from right, such as SHOT. If the mirror image of X corresponds to Y,
    few descriptors of X itself agree with descriptors of Y. The map of X itself then does not preserve
    distances.

    Most bodies are their own mirror image, up to pose. For these bodies, the map of X and the map of its
    mirror image preserve distances equally well. However, both maps are coarse, and one of them can be wrong
    by chance. The asymmetry of a shape measures how much the shape differs from its own mirror image. Teeth
    have a larger asymmetry than most bodies.

    The evidence is the logarithm of a ratio: the distance error of the map of X itself, divided by the
    distance error of the map of its mirror image. Positive evidence supports the mirror image. The distance
    error of a map is the mean absolute difference between the distance of two points of X and the distance of
    their matches.

    **Arguments:**

    - `pair`: two full shapes, the source X (m vertices) and the target Y (n vertices).
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, from `paired_spectra`.
    """

    def __init__(self, pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum) -> None:
        self.x, self.y = side_by_side(_proxy, (pair.mesh_x, spectrum_x), (pair.mesh_y, spectrum_y))

    def decide(self, mirror: Mirror = "auto") -> Decision:
        """Decide whether X or its mirror image is matched.

        With `mirror="auto"`, the mirror image is matched if the mean asymmetry of X and Y is large enough,
        and if the evidence supports the mirror image. With `"yes"` and `"no"`, only the asymmetry is
        computed. With `"auto"`, X itself is matched if a shape has too few samples.
        """
        given = Decision(mirror == "yes")
        if min(len(shape.areas) for shape in (self.x, self.y)) < _FEWEST:
            return given
        try:
            with warnings.catch_warnings():
                # SHOT warns if samples are sparse, but sparse samples only make the evidence less reliable.
                warnings.simplefilter("ignore")
                asymmetry = self.asymmetry()
                if mirror != "auto":
                    return given._replace(asymmetric=asymmetry >= ASYMMETRIC_FROM)
                if asymmetry < ASYMMETRIC_FROM - ASYMMETRY_DOUBT:
                    return given
                return decide(self.evidence(), asymmetry)
        except InputError:  # the samples are too sparse for SHOT
            return given

    def asymmetry(self) -> float:
        """Return the mean asymmetry of X and Y.

        The samples of a shape are mapped to the samples of its own mirror image by nearest SHOT descriptors.
        The asymmetry of the shape is the distance error of this map, divided by the distance error of a
        random map (seed 0). The asymmetry is near 0 for a shape that is its own mirror image, and near 1 for
        a shape without any similarity to its mirror image.

        **Raises:** `InputError` if the samples are too sparse for SHOT.
        """
        return float(np.mean(side_by_side(_asymmetry, self.x, self.y)))

    def evidence(self) -> float:
        """Compare a coarse map of X with a coarse map of the mirror image of X.

        The samples are spread evenly over each shape. The initial maps take each sample to the sample with
        the nearest SHOT descriptor. The SHOT descriptors have large radii. A feature regression with few
        eigenvectors refines these maps. The comparison is repeated for several sets of radii. If
        both maps are wrong, one map can be much better than the other map by chance. Therefore the method
        returns the smallest evidence. The method stops as soon as the evidence is clearly too small to
        support the mirror image.

        **Returns:** The evidence, a number without unit. Positive evidence supports the mirror image.

        **Raises:** `InputError` if the samples are too sparse for SHOT.
        """
        least = np.inf
        for radii in _RADII:
            x, mirrored_x, y, _ = self._describe(radii)
            own, mirrored = (self._error(hand, y, *self._map(hand, y)) for hand in (x, mirrored_x))
            least = min(least, _log_ratio(own, mirrored))
            if least < MIRRORED_FROM - DOUBT:
                break
        return float(least)

    def _describe(self, radii: tuple[int, ...]) -> list[_Hand]:
        """Compute descriptors of four shapes: X, the mirror image of X, Y, and the mirror image of Y."""
        shot_x, shot_y = side_by_side(lambda shape: _shot(shape, radii), self.x, self.y)
        shapes = [self.x, self.x, self.y, self.y]
        shot = [
            np.hstack(descriptors)
            for own in (shot_x, shot_y)
            for descriptors in (own, [mirrored_descriptors(one) for one in own])
        ]
        areas = [shape.areas / len(shapes) for shape in shapes]
        axes = PrincipalAxes.of(zip(shot, areas, strict=True), _STAGE.number_of_descriptors)
        components = map(axes.components, shot)
        return [_Hand(*hand) for hand in zip(shapes, shot, components, strict=True)]

    @staticmethod
    def _error(
        x: _Hand, y: _Hand, forward: Int64[np.ndarray, " s"], backward: Int64[np.ndarray, " t"]
    ) -> float:
        """Return the sum of the distance errors of a map and of its reverse map."""
        return distance_error(x.shape, y.shape, forward) + distance_error(y.shape, x.shape, backward)

    def _map(self, x: _Hand, y: _Hand) -> tuple[Int64[np.ndarray, " s"], Int64[np.ndarray, " t"]]:
        """Map each sample to the sample with the nearest descriptor, and refine this map.

        **Returns:** The refined map (s,) and its reverse map (t,).
        """
        spectra = SpectralPair(x.shape.sampled_spectrum(x.components), y.shape.sampled_spectrum(y.components))
        outcome = run([_STAGE], spectra, Start(_nearest(x.shot, y.shot)))
        return outcome.pointwise_map, outcome.last.reverse_map()


def _proxy(argument: tuple[Mesh, Spectrum]) -> Proxy:
    mesh, spectrum = argument
    return Proxy(mesh, spectrum, poisson_disk_samples(mesh, _SAMPLES), mesh.area**0.5)


def _asymmetry(shape: Proxy) -> float:
    """Return the asymmetry of a shape, which is kept in the cache; see `Hands.asymmetry`."""

    def compute() -> dict[str, np.ndarray]:
        shot = _shot(shape, _ASYMMETRY_RADII)
        # All descriptors have the same norm, so the nearest descriptor has the largest inner product.
        mirrored = np.hstack([mirrored_descriptors(one) for one in shot])
        matches = np.argmax(np.hstack(shot) @ mirrored.T, axis=1)
        random = np.random.default_rng(0).permutation(len(matches))
        ratio = distance_error(shape, shape, matches) / distance_error(shape, shape, random)
        return {"asymmetry": np.asarray(ratio)}

    inputs = shape.mesh.vertices, shape.mesh.faces, _SAMPLES, *_ASYMMETRY_RADII
    return float(cached("asymmetry", inputs, compute)["asymmetry"])


def _shot(shape: Proxy, radii: tuple[int, ...]) -> list[Float[np.ndarray, "s 352"]]:
    return [
        shot_descriptors(shape.mesh, radius=multiple * SHOT_RADIUS, samples=shape.samples)
        for multiple in radii
    ]


class _Hand(NamedTuple):
    """A shape or its mirror image, with SHOT descriptors at its samples and their principal components."""

    shape: Proxy
    shot: Float[np.ndarray, "s r"]
    components: Float[np.ndarray, "s d"]


def _nearest(x: Float[np.ndarray, "s r"], y: Float[np.ndarray, "t r"]) -> Int64[np.ndarray, " s"]:
    """Return the index of Y's nearest SHOT descriptor for each SHOT descriptor of X."""
    # A matrix product takes a fraction of the time of `cdist`.
    return np.argmax(x @ y.T - 0.5 * (y**2).sum(axis=1), axis=1)


def _log_ratio(own: float, mirrored: float) -> float:
    tiny = 1e-9  # With this addend, the result is 0 if both errors are 0.
    return float(np.log((own + tiny) / (mirrored + tiny)))


class Decision(NamedTuple):
    """The decision whether X or the mirror image of X is matched to Y.

    **Attributes:**

    - `mirrored`: whether the mirror image of X corresponds to Y.
    - `evidence`: the evidence for the mirror image, a float without unit: the logarithm of a ratio of
      distance errors; see `Hands`. None if no evidence was computed, for example because the shapes are their
      own mirror images.
    - `doubtful`: whether the decision is uncertain. For asymmetric shapes, the decision is uncertain if the
      evidence is near `MIRRORED_FROM`. If the asymmetry is slightly below `ASYMMETRIC_FROM`, the decision is
      uncertain if the evidence is at least `MIRRORED_FROM`.
    - `asymmetric`: whether the mean asymmetry of X and Y is at least `ASYMMETRIC_FROM`.
    """

    mirrored: bool
    evidence: float | None = None
    doubtful: bool = False
    asymmetric: bool = False


def decide(evidence: float, asymmetry: float) -> Decision:
    """Decide whether X or its mirror image is matched, from the evidence and the mean asymmetry."""
    supported, asymmetric = evidence >= MIRRORED_FROM, asymmetry >= ASYMMETRIC_FROM
    near = abs(evidence - MIRRORED_FROM) < DOUBT
    return Decision(supported and asymmetric, evidence, near if asymmetric else supported, asymmetric)
