"""The methods that the paper compares itself with, written from their papers, in the library's own loop.

Every method takes a prepared pair, with the same spectra and the same start, and gives a pointwise map.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.core.banks import Identity
from jaxsmw.core.functional_map import encode
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.refinement import Refiner, WaveletPreservation, refine
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions import Filtering, NearestOrthogonal
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.evaluation.datasets import DataPair
from jaxsmw.evaluation.ground_truth import read_pointwise_map
from jaxsmw.evaluation.opponents.bcicp import bcicp
from jaxsmw.evaluation.opponents.cpd import DriftRecovery
from jaxsmw.evaluation.opponents.partial_functional_maps import SurfaceGradient, partial_functional_map
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.presets import PRESETS, Preset, Stage, chosen_stages, refine_in_stages
from jaxsmw.runtime.batches import pad_rows
from jaxsmw.runtime.compilation import compiled


@dataclass(frozen=True, eq=False)
class PreparedPair:
    """What methods work on.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: with at least as many eigenvectors as any method asks for.
    - `start`: the initial T: X -> Y (m,).
    - `samples`: vertices of X and of Y in farthest-point order, for methods that iterate on samples.
    - `reverse_start`: the initial map Y -> X (n,), for methods that work in `both_directions`.
    - `meshes`: X and Y, for methods that look at edges.
    - `names`: of X and Y, for maps on files.
    - `partial`: whether one shape is a part of the other, so that spectra only have a range in common.
    - `other_starts`: computes further ones, one by one, for methods that doubt the first.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    start: Int[Array, " m"]
    samples: tuple[Int[Array, " s_x"], Int[Array, " s_y"]]
    reverse_start: Int[Array, " n"] | None = None
    meshes: tuple[Mesh, Mesh] | None = None
    names: tuple[str, str] = ("X", "Y")
    partial: bool = False
    other_starts: Callable[[], Iterable[Int[Array, " m"]]] = tuple

    def seen_in(self, stage: Stage) -> tuple[Spectrum, Spectrum]:
        """Both spectra as a stage sees them; of a partial pair with the eigenvectors in common."""
        return stage.view(self.spectrum_x, self.spectrum_y, partial=self.partial)

    def truncated(self, k: int) -> tuple[Spectrum, Spectrum]:
        """Both spectra with k eigenvectors; of a partial pair with those that they have in common."""
        return self.seen_in(Stage(number_of_eigenvectors=k))

    def sampled(self, count: int | None) -> tuple[Int[Array, " s_x"] | None, Int[Array, " s_y"] | None]:
        """The first samples of both, or none."""
        samples_x, samples_y = self.samples
        return (None, None) if count is None else (samples_x[:count], samples_y[:count])


class Method(abc.ABC):
    """A way from a start to a map.

    **Attributes:**

    - `number_of_eigenvectors`: the largest number it uses.
    - `number_of_descriptors`: the largest number it uses of what `PreparedPair` has.
    - `reference`: where it is published, with what settings.
    - `both_directions`: whether it needs `PreparedPair.reverse_start`.
    - `whole_only`: whether it makes no sense where one shape is a part of the other.
    - `partial_only`: whether it makes no sense otherwise.
    """

    number_of_eigenvectors: int
    reference: str
    number_of_descriptors: int = 0
    both_directions: bool = False
    whole_only: bool = False
    partial_only: bool = False

    @abc.abstractmethod
    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        """The map, and how its computation ended."""

    def check(self, pairs: Sequence[DataPair]) -> None:
        """Whether some pairs can be measured, before any is.

        **Raises:** `InputError` if one cannot.
        """
        if self.whole_only and any(pair.partial for pair in pairs):
            raise InputError(f"{self.reference}: is for whole shapes: leave it out of --methods.")
        if self.partial_only and not all(pair.partial for pair in pairs):
            raise InputError(f"{self.reference}: is for parts of shapes: leave it out of --methods.")


@dataclass(frozen=True)
class Start(Method):
    """The initial map itself."""

    reference: str
    number_of_eigenvectors: int = 1

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        return pair.start, RESULTS.successful  # type: ignore[return-value]


@dataclass(frozen=True)
class Published(Method):
    """Maps that others computed, on files in a directory; see `read_published_map`."""

    directory: Path
    number_of_eigenvectors: int = 1

    @property
    def reference(self) -> str:  # type: ignore[override]
        """Where the maps lie."""
        return f"maps in {self.directory.name}, computed elsewhere"

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        assert pair.meshes is not None
        pointwise_map = read_published_map(self.directory, pair.names, pair.meshes)
        padded = jnp.asarray(pad_rows(pointwise_map, pair.spectrum_x.mask.shape[0]), jnp.int32)
        return padded, RESULTS.successful  # type: ignore[return-value]

    def check(self, pairs: Sequence[DataPair]) -> None:
        """Whether there is a map for each of some pairs."""
        missing = [pair for pair in pairs if not published_file(self.directory, pair.names).is_file()]
        if missing:
            raise InputError(
                f"{published_file(self.directory, missing[0].names)}: is missing, like {len(missing)} of "
                f"{len(pairs)} maps: add them, or choose pairs with --pairs FILE."
            )


def published_file(directory: Path, names: tuple[str, str]) -> Path:
    """Where the map between two shapes lies among maps as they circulate."""
    return directory / f"{'_'.join(names)}.map"


def read_published_map(
    directory: Path, names: tuple[str, str], meshes: tuple[Mesh, Mesh]
) -> Int64[np.ndarray, " m"]:
    """The map X -> Y from a directory as they circulate: `X_Y.map`, a vertex per line counted from 1.

    **Raises:** `InputError` if it is missing or does not fit the meshes.
    """
    return read_pointwise_map(published_file(directory, names), *meshes, index_base=1)


@dataclass(frozen=True)
class Refined(Method):
    """`jaxsmw.refine` at one number of eigenvectors."""

    reference: str
    refiner: Refiner = field(default_factory=WaveletPreservation)
    number_of_eigenvectors: int = 100
    iterations: int = 3
    number_of_samples: int | None = None

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
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
    """One of `jaxsmw.PRESETS`."""

    reference: str
    preset: Preset

    @property
    def number_of_eigenvectors(self) -> int:  # type: ignore[override]
        """That of the stage with most of them."""
        return max(stage.number_of_eigenvectors for stage in PRESETS[self.preset])

    @property
    def number_of_descriptors(self) -> int:  # type: ignore[override]
        """That of the stage with most of them."""
        return max(stage.number_of_descriptors for stage in PRESETS[self.preset])

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        fewest = min(int(spectrum.mask.sum()) for spectrum in (pair.spectrum_x, pair.spectrum_y))
        return _refined(pair, *chosen_stages(self.preset, fewest, partial=pair.partial))


def _refined(pair: PreparedPair, *stages: Stage) -> tuple[Int[Array, " m"], RESULTS]:
    spectra = [pair.seen_in(stage) for stage in stages]
    outcome = refine_in_stages(
        spectra,
        pair.start,
        stages,
        pair.samples,
        meshes=pair.meshes,
        partial=pair.partial,
        other_starts=pair.other_starts(),
    )
    return outcome.pointwise_map, outcome.refinements[-1].result


# ZoomOut's published sizes of C.
FIRST_EIGENVECTORS, ZOOMOUT_STEP, LAST_EIGENVECTORS = 20, 5, 120

_UNFILTERED = WaveletPreservation(Identity())
_UNFILTERED_ON_SAMPLES = WaveletPreservation(Identity(), Filtering(pseudo_inverse="least_squares"))


@dataclass(frozen=True)
class ZoomOut(Method):
    """Iterative spectral upsampling (Melzi et al. 2019): C as the map gives it, of a size that grows.

    With samples (their section 4.3) both halves of an iteration see only these; the last map is searched
    among all vertices.
    """

    reference: str
    first: int = FIRST_EIGENVECTORS
    step: int = ZOOMOUT_STEP
    number_of_eigenvectors: int = LAST_EIGENVECTORS
    number_of_samples: int | None = None

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        pointwise_map, refiner = pair.start, _UNFILTERED
        samples_x, samples_y = pair.sampled(self.number_of_samples)
        if samples_x is not None:
            refiner, first = _UNFILTERED_ON_SAMPLES, pair.truncated(self.first)
            functional_map = compiled(encode)(pair.start, *first)
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
    """Both shapes, seen at samples only if there are any."""
    if samples_x is None or samples_y is None:
        return spectra
    return spectra[0].sample(samples_x), spectra[1].sample(samples_y)


@dataclass(frozen=True)
class BCICP(Method):
    """Bijective and continuous ICP; see `jaxsmw.evaluation.opponents.bcicp`."""

    reference: str
    number_of_eigenvectors: int = 50
    both_directions: bool = True
    whole_only: bool = True

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        assert pair.meshes is not None and pair.reverse_start is not None
        maps = (np.asarray(start).astype(np.int64) for start in (pair.start, pair.reverse_start))
        pointwise_map, _ = bcicp(*pair.meshes, *pair.truncated(self.number_of_eigenvectors), *maps)
        return jnp.asarray(pointwise_map, jnp.int32), RESULTS.successful  # type: ignore[return-value]


@dataclass(frozen=True)
class PartialFunctionalMaps(Method):
    """Of a part X and a whole Y; see `jaxsmw.evaluation.opponents.partial_functional_maps`."""

    reference: str
    number_of_eigenvectors: int = 100
    number_of_descriptors: int = 15
    turns: int = 5
    partial_only: bool = True

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        assert pair.meshes is not None
        spectra = pair.seen_in(
            Stage(
                number_of_eigenvectors=self.number_of_eigenvectors,
                number_of_descriptors=self.number_of_descriptors,
            )
        )
        gradient = SurfaceGradient.of(pair.meshes[1], spectra[1])
        found = compiled(partial_functional_map)(*spectra, gradient, pair.start, turns=self.turns)
        return found.pointwise_map, found.result


MOST_SAMPLES = 1000
METHODS: dict[str, Method] = {
    "start": Start("nearest neighbours of the descriptors, from which all others start"),
    "mwp": Refined("Hu, Li, Liu, Liu 2021: k = 100, Meyer with 6 filters, 3 iterations"),
    "accurate": Chosen("this library's preset, from the outcome of mwp", "accurate"),
    "mwp-sampled": Refined("Hu, Li, Liu, Liu 2021: the same on 500 samples", number_of_samples=500),
    "no-filter": Refined("MWP without filters: k = 100, 3 iterations", _UNFILTERED),
    "icp": Refined(
        "Ovsjanikov et al. 2012, spectral ICP: k = 100, 10 iterations",
        WaveletPreservation(Identity(), NearestOrthogonal(Filtering())),
        iterations=10,
    ),
    "cpd": Refined(
        "Rodolà, Moeller, Cremers 2015: k = 30, 3 times C and its recovery by Coherent Point Drift",
        DriftRecovery(),
        number_of_eigenvectors=30,
    ),
    "bcicp": BCICP(
        "our reconstruction of Ren, Poulenard, Wonka, Ovsjanikov 2018: k = 50, 10 iterations (maps "
        "published for tosca_nonisometric are better)"
    ),
    "pfm": PartialFunctionalMaps(
        "our reconstruction of Rodolà, Cosmo, Bronstein, Torsello, Cremers 2017, partial functional maps: "
        "k = 100, 5 turns"
    ),
    "zoomout": ZoomOut("Melzi et al. 2019: k = 20, 25, ..., 120"),
    "zoomout-sampled": ZoomOut(
        "Melzi et al. 2019: k = 20, 25, ..., 120 on 1000 samples", number_of_samples=MOST_SAMPLES
    ),
}


MOST_EIGENVECTORS = max(method.number_of_eigenvectors for method in METHODS.values())


def known_methods() -> dict[str, Method]:
    """Ours, and those of other libraries that are installed."""
    from jaxsmw.evaluation.opponents.peers import installed_peers

    return METHODS | installed_peers()


def suited_methods(pairs: Sequence[DataPair]) -> dict[str, Method]:
    """The known methods that make sense for all of some pairs."""
    some, every = any(pair.partial for pair in pairs), all(pair.partial for pair in pairs)
    return {
        name: method
        for name, method in known_methods().items()
        if not (some and method.whole_only) and not (method.partial_only and not every)
    }


def find_methods(names: Iterable[str]) -> dict[str, Method]:
    """The methods of some names, or of directories with maps computed elsewhere, whose name they then take.

    **Raises:** `InputError` if one is neither, or two would be called the same.
    """
    known, found = known_methods(), {}
    for name in dict.fromkeys(names):
        directory = Path(name).resolve()
        if name in known:
            found[name] = known[name]
            continue
        if not directory.is_dir():
            raise InputError(
                f"{name!r} is no method: choose from {', '.join(known)}, or give a directory with maps "
                "X_Y.map."
            )
        if directory.name in {**known, **found}:
            raise InputError(
                f"{directory}: another method is called {directory.name} already: rename the directory."
            )
        found[directory.name] = Published(directory)
    return found
