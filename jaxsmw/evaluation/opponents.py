"""The methods that the paper compares itself with, written from their papers, in the library's own loop.

Every method takes a prepared pair, with the same spectra and the same start, and gives a pointwise map.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, field

import equinox as eqx
from jaxtyping import Array, Int

from jaxsmw.core.filters import Identity
from jaxsmw.core.functional_map import encode
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.refinement import Refiner, WaveletPreservation, refine
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions import Filtering, NearestOrthogonal
from jaxsmw.core.spectrum import Spectrum


@dataclass(frozen=True, eq=False)
class SpectralPair:
    """What methods work on.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: with at least as many eigenvectors as any method asks for.
    - `start`: the initial T: X -> Y (m,).
    - `samples`: vertices of X and of Y in farthest-point order, for methods that iterate on samples.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    start: Int[Array, " m"]
    samples: tuple[Int[Array, " s"], Int[Array, " s"]]


class Method(abc.ABC):
    """A way from a start to a map.

    **Attributes:**

    - `number_of_eigenvectors`: the largest number it uses.
    - `reference`: where it is published, with what settings.
    """

    number_of_eigenvectors: int
    reference: str

    @abc.abstractmethod
    def __call__(self, pair: SpectralPair) -> tuple[Int[Array, " m"], RESULTS]:
        """The map, and how its computation ended."""


@dataclass(frozen=True)
class Start(Method):
    """The initial map itself."""

    reference: str
    number_of_eigenvectors: int = 1

    def __call__(self, pair: SpectralPair) -> tuple[Int[Array, " m"], RESULTS]:
        return pair.start, RESULTS.successful  # type: ignore[return-value]


@dataclass(frozen=True)
class Refined(Method):
    """`jaxsmw.refine` at one number of eigenvectors."""

    reference: str
    refiner: Refiner = field(default_factory=WaveletPreservation)
    number_of_eigenvectors: int = 100
    iterations: int = 3
    number_of_samples: int | None = None

    def __call__(self, pair: SpectralPair) -> tuple[Int[Array, " m"], RESULTS]:
        samples_x, samples_y = (
            None if self.number_of_samples is None else vertices[: self.number_of_samples]
            for vertices in pair.samples
        )
        refined = refine(
            *_truncated(pair, self.number_of_eigenvectors),
            pair.start,
            refiner=self.refiner,
            iterations=self.iterations,
            samples_x=samples_x,
            samples_y=samples_y,
        )
        return refined.pointwise_map, refined.result


_UNFILTERED = WaveletPreservation(Identity())
_UNFILTERED_ON_SAMPLES = WaveletPreservation(Identity(), Filtering(pseudo_inverse="least_squares"))


@dataclass(frozen=True)
class ZoomOut(Method):
    """Iterative spectral upsampling (Melzi et al. 2019): C as the map gives it, of a size that grows.

    With samples (their section 4.3) both halves of an iteration see only these; the last map is searched
    among all vertices.
    """

    reference: str
    first: int = 20
    step: int = 5
    number_of_eigenvectors: int = 120
    number_of_samples: int | None = None

    def __call__(self, pair: SpectralPair) -> tuple[Int[Array, " m"], RESULTS]:
        x, y, pointwise_map, refiner = pair.spectrum_x, pair.spectrum_y, pair.start, _UNFILTERED
        if self.number_of_samples is not None:
            samples_x, samples_y = (vertices[: self.number_of_samples] for vertices in pair.samples)
            x, y, refiner = x.sample(samples_x), y.sample(samples_y), _UNFILTERED_ON_SAMPLES
            first = _encode(pair.start, *_truncated(pair, self.first))
            pointwise_map = _decode(first, x.truncate(self.first), y.truncate(self.first))
        for k in range(self.first, self.number_of_eigenvectors + 1, self.step):
            refined = refine(x.truncate(k), y.truncate(k), pointwise_map, refiner=refiner, iterations=1)
            pointwise_map = refined.pointwise_map
        if self.number_of_samples is not None:
            pointwise_map = _decode(refined.functional_map, *_truncated(pair, k))
        return pointwise_map, refined.result


_encode, _decode = eqx.filter_jit(encode), eqx.filter_jit(decode)


def _truncated(pair: SpectralPair, k: int) -> tuple[Spectrum, Spectrum]:
    return pair.spectrum_x.truncate(k), pair.spectrum_y.truncate(k)


MOST_SAMPLES = 1000
METHODS: dict[str, Method] = {
    "start": Start("nearest neighbours of the descriptors, from which all others start"),
    "mwp": Refined("Hu, Li, Liu, Liu 2021: k = 100, Meyer with 6 filters, 3 iterations"),
    "mwp-sampled": Refined("Hu, Li, Liu, Liu 2021: the same on 500 samples", number_of_samples=500),
    "no-filter": Refined("MWP without filters: k = 100, 3 iterations", _UNFILTERED),
    "icp": Refined(
        "Ovsjanikov et al. 2012, spectral ICP: k = 100, 10 iterations",
        WaveletPreservation(Identity(), NearestOrthogonal(Filtering())),
        iterations=10,
    ),
    "zoomout": ZoomOut("Melzi et al. 2019: k = 20, 25, ..., 120"),
    "zoomout-sampled": ZoomOut(
        "Melzi et al. 2019: k = 20, 25, ..., 120 on 1000 samples", number_of_samples=MOST_SAMPLES
    ),
}
