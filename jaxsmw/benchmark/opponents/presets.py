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
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.presets import PRESETS, PresetName
from jaxsmw.matching.search.rounds import refine_in_stages
from jaxsmw.matching.search.trimming import complete
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.cache import recomputing


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
        found = stage.run(*pair.seen_in(stage), pair.initial_map, pair.samples, partial=pair.partial)
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
        return PRESETS[self.preset].number_of_eigenvectors

    @property
    def number_of_descriptors(self) -> int:  # type: ignore[override]
        """The largest number of descriptors that a stage of the preset uses."""
        return PRESETS[self.preset].number_of_descriptors

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Return the map X -> Y and the status code; see `Method`."""
        assert pair.prepared is not None
        prepared, preset = pair.prepared, PRESETS[self.preset]
        given = prepared.pair
        surfaces = given.without_shortcuts() if preset.cuts_shortcuts else given
        preset = preset.fitted(surfaces.fewest_vertices())
        if surfaces is not given:
            prepared = prepare(
                surfaces,
                number_of_eigenvectors=preset.number_of_eigenvectors,
                number_of_descriptors=preset.number_of_descriptors,
                number_of_samples=preset.number_of_samples,
                init=prepared.init,
            )
        if preset.number_of_crease_eigenvectors:
            with recomputing():
                prepared = prepared.with_crease_eigenvectors(preset.number_of_crease_eigenvectors)
        outcome = refine_in_stages(prepared, preset.judged_stages, preset.repair)
        with recomputing():
            _, outcome = complete(prepared, preset.judged_stages, preset.final_stages, preset.repair, outcome)
        return outcome.pointwise_map, outcome.refinements[-1].result


MWP = Refined("Hu, Li, Liu, Liu 2021: k = 100, Meyer with 6 filters, 3 iterations")
MWP_SAMPLED = Refined("Hu, Li, Liu, Liu 2021: the method mwp, but on 500 samples", number_of_samples=500)
ACCURATE = Chosen("this library's preset accurate, which continues from the result of mwp", "accurate")
