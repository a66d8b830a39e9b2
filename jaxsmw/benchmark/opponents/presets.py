"""This library's own methods: MWP with a fixed number of eigenvectors, and the presets of `jaxsmw.PRESETS`.

MWP is Algorithm 1 of Hu, Li, Liu, Liu, *Efficient deformable shape correspondence via multiscale spectral
manifold wavelets preservation*, CVPR 2021. `MWP` has the settings of the paper: 100 eigenvectors, a Meyer
frame of 6 filters, and 3 iterations. `MWP_SAMPLED` has the same settings, but iterates on 500 samples of each
shape. The authors of the paper have a similar fast variant.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Array, Int

from jaxsmw.benchmark.opponents.base import Method, MethodInput
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.matching.match import match
from jaxsmw.matching.presets import PRESETS, PresetName
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.cache import recomputing
from jaxsmw.runtime.compilation import compiled


@dataclass(frozen=True)
class Refined(Method):
    """A method that refines the initial map with one refiner and a fixed number of eigenvectors.

    **Attributes:**

    - `reference`: the publication and the settings, as text; see `Method`.
    - `refiner`: the refiner. The default is `WaveletPreservation()`, the refiner of MWP.
    - `number_of_eigenvectors`: the number of eigenvectors of both shapes.
    - `iterations`: the number of iterations.
    - `number_of_samples`: the number of samples of each shape on which the refiner iterates; None for all
      vertices.
    """

    reference: str
    refiner: Refiner = field(default_factory=WaveletPreservation)
    number_of_eigenvectors: int = 100
    iterations: int = 3
    number_of_samples: int | None = None

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Return the map X -> Y and the status code; see `Method`."""
        stage = Stage(
            self.refiner,
            number_of_eigenvectors=self.number_of_eigenvectors,
            iterations=self.iterations,
            number_of_samples=self.number_of_samples,
        )
        samples = None
        if self.number_of_samples is not None:
            samples_x, samples_y = pair.samples
            samples = samples_x[: self.number_of_samples], samples_y[: self.number_of_samples]
        found = compiled(refine)(
            *pair.seen_in(stage), pair.initial_map, samples=samples, partial=pair.partial, **stage.settings
        )
        return found.pointwise_map, found.result


@dataclass(frozen=True)
class Chosen(Method):
    """A method that refines the initial map with one of `jaxsmw.PRESETS`, exactly as `jaxsmw.match` does.

    No other method uses crease eigenvectors or trims shapes. Crease eigenvectors, and the spectra and
    descriptors of trimmed pairs, are therefore computed as a part of the method. They are computed anew for
    each pair, and their time counts.

    **Attributes:**

    - `reference`: the publication and the settings, as text; see `Method`.
    - `preset`: the name of the preset.
    """

    reference: str
    preset: PresetName

    @property
    def number_of_eigenvectors(self) -> int:  # type: ignore[override]
        """The largest number of eigenvectors that a stage of the preset uses."""
        return PRESETS[self.preset].sizes.number_of_eigenvectors

    @property
    def number_of_descriptors(self) -> int:  # type: ignore[override]
        """The largest number of descriptors that a stage of the preset uses."""
        return PRESETS[self.preset].number_of_descriptors

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Return the map X -> Y and the status code; see `Method`."""
        assert pair.prepared is not None
        given = pair.prepared.pair
        with recomputing():
            found = match(*given.meshes, preset=self.preset, partial=given.partial)
        return found.refinement.pointwise_map, found.refinement.result


MWP = Refined("Hu, Li, Liu, Liu 2021: k = 100, Meyer with 6 filters, 3 iterations")
MWP_SAMPLED = Refined("Hu, Li, Liu, Liu 2021: the method mwp, but on 500 samples", number_of_samples=500)
ACCURATE = Chosen("this library's preset accurate, which continues from the result of mwp", "accurate")
