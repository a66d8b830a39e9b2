"""Methods that run on what this library already has, and methods that read the maps of other programs.

- `UNREFINED`: the initial map, from which all other methods start.
- `MWP`: Algorithm 1 of Hu, Li, Liu, Liu, *Efficient deformable shape correspondence via multiscale spectral
  manifold wavelets preservation*, CVPR 2021, with the settings of the paper: 100 eigenvectors, a Meyer frame
  of 6 filters, and 3 iterations. `MWP_SAMPLED` iterates on 500 samples of each shape, similarly to the fast
  variant of the authors. `NO_FILTER` has the 3 iterations of MWP, without filters.
- `ACCURATE`: `jaxsmw.match` with the preset `accurate`.
- `SPECTRAL_ICP`: the iterative refinement of Ovsjanikov, Ben-Chen, Solomon, Butscher, Guibas, *Functional
  maps: a flexible representation of maps between shapes*, ACM Transactions on Graphics 31(4), 2012. Each of
  10 iterations encodes the pointwise map as a functional map of size 100, replaces the functional map by the
  nearest orthogonal matrix, and then searches for nearest neighbours.
- `ZOOMOUT`: Melzi, Ren, Rodolà, Sharma, Wonka, Ovsjanikov, *ZoomOut: spectral upsampling for efficient shape
  correspondence*, ACM Transactions on Graphics 38(6), 2019. The iterations have the sizes k = 20, 25, ...,
  120. `ZOOMOUT_SAMPLED` iterates on 1000 samples of each shape (section 4.3 of the paper).
- `PublishedMaps`: maps from files `X_Y.map`.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Int64

from jaxsmw.benchmark.datasets import AnyPair
from jaxsmw.benchmark.opponents.base import (
    MOST_SAMPLES,
    Measured,
    Method,
    MethodInput,
    PointwiseMap,
    successful,
)
from jaxsmw.choices import DEFAULT_BACKEND, Backend, Template
from jaxsmw.core.banks import Identity
from jaxsmw.core.functional_map import encode
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.solutions.closed_form import Filtering, NearestOrthogonal
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.maps import read_pointwise_map
from jaxsmw.io.meshes import read_mesh
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.executor import refine_stage, run, run_batches
from jaxsmw.matching.match import match
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Preset, PresetName, Stage, choose_preset
from jaxsmw.runtime.backends import chosen_backend
from jaxsmw.runtime.cache import recomputing


@dataclass(frozen=True)
class Unrefined(Method):
    """A method that returns the initial map unchanged."""

    reference: str = "the initial map of all other methods, from nearest neighbours in descriptor space"
    number_of_eigenvectors: int = 1

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        return pair.initial_map


@dataclass(frozen=True)
class PublishedMaps(Method):
    """A method that reads the map of each pair from a directory; see `read_published_map`."""

    directory: Path
    reference: str = field(init=False)
    number_of_eigenvectors: int = 1  # the smallest number that a benchmark can compute

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference", f"maps in {self.directory.name}, computed elsewhere")

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        assert pair.meshes is not None
        return read_published_map(self.directory, pair.names, pair.meshes)

    def measure(self, pair: MethodInput) -> Measured:
        return Measured(self(pair), np.nan)

    def check(self, pairs: Sequence[AnyPair]) -> None:
        """Raise `InputError` if the directory has no map for a pair."""
        missing = [pair for pair in pairs if not _published_file(self.directory, pair.names).is_file()]
        if missing:
            raise InputError(
                f"{_published_file(self.directory, missing[0].names)}: is missing ({len(missing)} of "
                f"{len(pairs)} maps are missing): add the maps, or use --pairs FILE with a list of the pairs "
                "that have maps."
            )


def read_published_map(
    directory: Path, names: tuple[str, str], meshes: tuple[Mesh, Mesh]
) -> Int64[np.ndarray, " m"]:
    """Read the map X -> Y (m,) from `X_Y.map`, which contains one vertex of Y per line, counted from 1.

    **Raises:** `InputError` if the file is missing or does not fit the meshes.
    """
    return read_pointwise_map(_published_file(directory, names), *meshes, index_base=1)


def _published_file(directory: Path, names: tuple[str, str]) -> Path:
    return directory / f"{'_'.join(names)}.map"


@dataclass(frozen=True)
class Staged(Method):
    """A method that runs one or several stages, one after another, from the initial map."""

    reference: str
    stages: tuple[Stage, ...] = (Stage(),)
    number_of_eigenvectors: int = field(init=False)
    number_of_crease_eigenvectors: int = field(init=False)
    number_of_descriptors: int = field(init=False)
    bases: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        preset = Preset(self.stages)
        object.__setattr__(self, "bases", preset.sizes.bases)
        object.__setattr__(self, "number_of_eigenvectors", preset.sizes.number_of_eigenvectors)
        object.__setattr__(self, "number_of_crease_eigenvectors", preset.sizes.number_of_crease_eigenvectors)
        object.__setattr__(self, "number_of_descriptors", preset.number_of_descriptors)

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        return _successful_map(run(self.stages, pair.spectra, _start(pair)))

    def measure_all(self, pairs: Sequence[MethodInput]) -> list[Measured | ArithmeticError]:
        """Measure several pairs, in batches where JAX refines them.

        Batches pad shapes to a few sizes, so that JAX compiles few programs. The seconds of each pair in a
        batch are those of the batch, divided by the number of pairs.
        """
        by_numpy = chosen_backend("auto") == "numpy" and all(s.refiner.uses_namespaces for s in self.stages)
        if by_numpy or any(pair.spectra.partial for pair in pairs):
            return super().measure_all(pairs)
        began = time.perf_counter()
        outcomes = run_batches(self.stages, [(pair.spectra, _start(pair)) for pair in pairs])
        seconds = (time.perf_counter() - began) / len(pairs)
        results: list[Measured | ArithmeticError] = []
        for outcome in outcomes:
            try:
                results.append(Measured(_successful_map(outcome), seconds))
            except ArithmeticError as error:
                results.append(error)
        return results


def _start(pair: MethodInput) -> Start:
    return Start(np.asarray(pair.initial_map, np.int64))


def _successful_map(outcome: Outcome) -> PointwiseMap:
    return successful(outcome.pointwise_map, outcome.last.refinement.result)


@dataclass(frozen=True)
class Matched(Method):
    """A method that calls `jaxsmw.match` with a preset, on the meshes and the argument `init` of the pair.

    `match` prepares the pair itself. The seconds leave out the steps whose results all methods share
    (`_SHARED_STEPS`). Nothing is read from the cache, so all steps take as long as for new shapes. Through a
    `template`, which is a mesh file or the name of a built-in shape, all steps count.
    """

    reference: str
    preset: PresetName | Preset
    template: str | None = None
    partial_only: bool = False
    backend: Backend = DEFAULT_BACKEND
    number_of_eigenvectors: int = field(init=False)

    def __post_init__(self) -> None:
        number = choose_preset(self.preset).sizes.number_of_eigenvectors
        object.__setattr__(self, "number_of_eigenvectors", number)

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        return self._match(pair).pointwise_map

    def measure(self, pair: MethodInput) -> Measured:
        with recomputing():
            result = self._match(pair)
        own_steps = (t for step, t in result.seconds.items() if step not in _SHARED_STEPS)
        return Measured(result.pointwise_map, sum(own_steps), result)

    def _match(self, pair: MethodInput) -> Correspondence:
        assert pair.meshes is not None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the errors are measured, so suspicions need no message
            return match(
                *pair.meshes,
                preset=self.preset,
                init=pair.init,
                partial=pair.spectra.partial,
                template=None if self.template is None else _template(self.template),
                backend=self.backend,
            )


def _template(name: str) -> Mesh | Template:
    """Return the name of a built-in template, or read the mesh file of a template."""
    return next((known for known in get_args(Template) if known == name), None) or read_mesh(name)


def through_template(template: str) -> Matched:
    """Return the method that matches two partial shapes through a template.

    **Raises:** `InputError` if the file of the template cannot be read.
    """
    _template(template)  # before the benchmark starts
    reference = f"preset accurate, through the template {Path(template).name}"
    return Matched(reference, "accurate", template=template, partial_only=True)


# The steps in `Correspondence.seconds` whose results are in `MethodInput`.
_SHARED_STEPS = {"eigenbases", "initial map", "descriptors", "samples"}

_UNFILTERED = WaveletPreservation(Identity())
_UNFILTERED_ON_SAMPLES = WaveletPreservation(Identity(), Filtering(pseudo_inverse="least_squares"))


@dataclass(frozen=True)
class ZoomOut(Method):
    """The method ZoomOut (Melzi et al. 2019), which refines a map with more eigenvectors in each iteration.

    With samples (section 4.3 of the paper), each iteration computes the functional map and the pointwise map
    from the samples only. After the last iteration, one search finds the matches of all vertices.

    The size k of the functional map grows from `first` to `number_of_eigenvectors` in steps of `step`.
    """

    reference: str
    first: int = 20
    step: int = 5
    number_of_eigenvectors: int = 120
    number_of_samples: int | None = None

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        pointwise_map, refiner = pair.initial_map, _UNFILTERED
        if self.number_of_samples is not None:
            refiner, first = _UNFILTERED_ON_SAMPLES, self._seen(pair, self.first)
            functional_map = encode(pair.initial_map, *first.both)
            pointwise_map = decode(functional_map, *_at_samples(first).both)
        for k in range(self.first, self.number_of_eigenvectors + 1, self.step):
            seen = self._seen(pair, k)
            stage = Stage(refiner, number_of_eigenvectors=k, iterations=1)
            refined = refine_stage(stage, _at_samples(seen), pointwise_map)
            pointwise_map = refined.pointwise_map
        if self.number_of_samples is not None:
            pointwise_map = decode(refined.functional_map, *seen.both)
        return successful(pointwise_map, refined.result)

    def _seen(self, pair: MethodInput, k: int) -> SpectralPair:
        stage = Stage(number_of_eigenvectors=k, number_of_samples=self.number_of_samples)
        return pair.spectra.seen_by(stage)


def _at_samples(pair: SpectralPair) -> SpectralPair:
    """Restrict both spectra to the samples. Without samples, return the pair unchanged."""
    if pair.samples is None:
        return pair
    x, y = (spectrum.sample(rows) for spectrum, rows in zip(pair.both, pair.samples, strict=True))
    return replace(pair, x=x, y=y, samples=None)


UNREFINED = Unrefined()
MWP = Staged("Hu, Li, Liu, Liu 2021: k = 100, Meyer with 6 filters, 3 iterations")
MWP_SAMPLED = Staged(
    "Hu, Li, Liu, Liu 2021: the method mwp, but on 500 samples", (Stage(number_of_samples=500),)
)
NO_FILTER = Staged("MWP without filters: k = 100, 3 iterations", (Stage(_UNFILTERED),))
ACCURATE = Matched(
    "jaxsmw.match with its preset accurate, which continues from the result of mwp", "accurate"
)
SPECTRAL_ICP = Staged(
    "Ovsjanikov et al. 2012, spectral ICP: k = 100, 10 iterations",
    (Stage(WaveletPreservation(Identity(), NearestOrthogonal(Filtering())), iterations=10),),
)
ZOOMOUT = ZoomOut("Melzi et al. 2019: k = 20, 25, ..., 120")
ZOOMOUT_SAMPLED = ZoomOut(
    "Melzi et al. 2019: k = 20, 25, ..., 120 on 1000 samples", number_of_samples=MOST_SAMPLES
)
