"""ZoomOut: iterative spectral upsampling.

This module implements the method of Melzi, Ren, Rodolà, Sharma, Wonka, Ovsjanikov, *ZoomOut: spectral
upsampling for efficient shape correspondence*, ACM Transactions on Graphics 38(6), 2019. Each iteration
encodes the pointwise map as a functional map of size k, searches for nearest neighbours, and increases k.

- `ZOOMOUT` uses the sizes k = 20, 25, ..., 120, and iterates on all vertices.
- `ZOOMOUT_SAMPLED` uses the same sizes, and iterates on 1000 samples of each shape (section 4.3 of the
  paper).
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Array, Int

from jaxsmw.benchmark.opponents.base import MOST_SAMPLES, Method, MethodInput
from jaxsmw.core.banks import Identity
from jaxsmw.core.functional_map import encode
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions import Filtering
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.runtime.compilation import compiled

FIRST_EIGENVECTORS, ZOOMOUT_STEP, LAST_EIGENVECTORS = 20, 5, 120
"""The first size k of the functional map, the step from each size to the next, and the largest size."""

_UNFILTERED = WaveletPreservation(Identity())
_UNFILTERED_ON_SAMPLES = WaveletPreservation(Identity(), Filtering(pseudo_inverse="least_squares"))


@dataclass(frozen=True)
class ZoomOut(Method):
    """The method ZoomOut (Melzi et al. 2019), which refines a map with more eigenvectors in each iteration.

    With samples (section 4.3 of the paper), each iteration computes the functional map and the pointwise map
    from the samples only. After the last iteration, one search finds the matches of all vertices.

    **Attributes:**

    - `reference`: the publication and the settings, as text; see `Method`.
    - `first`: the size k of the functional map in the first iteration.
    - `step`: the increase of k after each iteration.
    - `number_of_eigenvectors`: the largest size k.
    - `number_of_samples`: the number of samples of each shape; None for all vertices.
    """

    reference: str
    first: int = FIRST_EIGENVECTORS
    step: int = ZOOMOUT_STEP
    number_of_eigenvectors: int = LAST_EIGENVECTORS
    number_of_samples: int | None = None

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Return the map X -> Y and the status code; see `Method`."""
        pointwise_map, refiner = pair.initial_map, _UNFILTERED
        samples_x, samples_y = pair.sampled(self.number_of_samples)
        if samples_x is not None:
            refiner, first = _UNFILTERED_ON_SAMPLES, pair.truncated(self.first)
            functional_map = compiled(encode)(pair.initial_map, *first)
            pointwise_map = compiled(decode)(functional_map, *_at(first, samples_x, samples_y))
        for k in range(self.first, self.number_of_eigenvectors + 1, self.step):
            spectra = _at(pair.truncated(k), samples_x, samples_y)
            refined = compiled(refine)(*spectra, pointwise_map, refiner=refiner, iterations=1)
            pointwise_map = refined.pointwise_map
        if samples_x is not None:
            pointwise_map = compiled(decode)(refined.functional_map, *pair.truncated(k))
        return pointwise_map, refined.result


def _at(
    spectra: tuple[Spectrum, Spectrum],
    samples_x: Int[Array, " s_x"] | None,
    samples_y: Int[Array, " s_y"] | None,
) -> tuple[Spectrum, Spectrum]:
    """Restrict both spectra to the samples. Without samples, return both spectra unchanged."""
    if samples_x is None or samples_y is None:
        return spectra
    return spectra[0].sample(samples_x), spectra[1].sample(samples_y)


ZOOMOUT = ZoomOut("Melzi et al. 2019: k = 20, 25, ..., 120")
ZOOMOUT_SAMPLED = ZoomOut(
    "Melzi et al. 2019: k = 20, 25, ..., 120 on 1000 samples", number_of_samples=MOST_SAMPLES
)
