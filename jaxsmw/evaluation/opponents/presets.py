"""This library's own methods: MWP at one number of eigenvectors, and the presets of `jaxsmw.PRESETS`.

MWP is written from Hu, Li, Liu, Liu, *Efficient deformable shape correspondence via multiscale spectral
manifold wavelets preservation*, CVPR 2021, Algorithm 1. `MWP` has the settings of the paper: 100
eigenvectors, a Meyer frame of 6 filters, 3 iterations. `MWP_SAMPLED` iterates on 500 samples of each shape,
like the fast variant of the authors.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Array, Int

from jaxsmw.core.refinement import Refiner, WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.evaluation.opponents.base import Method, PreparedPair
from jaxsmw.presets import PRESETS, Preset, Stage, chosen_stages, refine_in_stages


@dataclass(frozen=True)
class Refined(Method):
    """Refines the initial map with `jaxsmw.refine`, at one number of eigenvectors."""

    reference: str
    refiner: Refiner = field(default_factory=WaveletPreservation)
    number_of_eigenvectors: int = 100
    iterations: int = 3
    number_of_samples: int | None = None

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        """See `Method`."""
        return _refined(
            pair,
            Stage(
                self.refiner,
                self.number_of_eigenvectors,
                iterations=self.iterations,
                number_of_samples=self.number_of_samples,
            ),
        )


@dataclass(frozen=True)
class Chosen(Method):
    """Refines the initial map with one of `jaxsmw.PRESETS`."""

    reference: str
    preset: Preset

    @property
    def number_of_eigenvectors(self) -> int:  # type: ignore[override]
        """The largest number of eigenvectors of any stage."""
        return max(stage.number_of_eigenvectors for stage in PRESETS[self.preset])

    @property
    def number_of_descriptors(self) -> int:  # type: ignore[override]
        """The largest number of descriptors of any stage."""
        return max(stage.number_of_descriptors for stage in PRESETS[self.preset])

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        """See `Method`."""
        fewest = min(int(spectrum.mask.sum()) for spectrum in (pair.spectrum_x, pair.spectrum_y))
        return _refined(pair, *chosen_stages(self.preset, fewest, partial=pair.partial))


def _refined(pair: PreparedPair, *stages: Stage) -> tuple[Int[Array, " m"], RESULTS]:
    spectra = [pair.seen_in(stage) for stage in stages]
    outcome = refine_in_stages(
        spectra,
        pair.initial_map,
        stages,
        pair.samples,
        meshes=pair.meshes,
        partial=pair.partial,
        other_starts=pair.alternative_initial_maps(),
    )
    return outcome.pointwise_map, outcome.refinements[-1].result


MWP = Refined("Hu, Li, Liu, Liu 2021: k = 100, Meyer with 6 filters, 3 iterations")
MWP_SAMPLED = Refined("Hu, Li, Liu, Liu 2021: as mwp, but on 500 samples", number_of_samples=500)
ACCURATE = Chosen("this library's preset accurate, which continues from the result of mwp", "accurate")
