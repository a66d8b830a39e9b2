"""The interface of the compared methods, which all receive the same prepared pair (`MethodInput`).

Methods that run in NumPy derive from `HostMethod`, which hands them shapes without unreferenced vertices.
"""

from __future__ import annotations

import abc
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int, Int64

from jaxsmw.benchmark.datasets import AnyPair
from jaxsmw.choices import DEFAULT_INITIAL_MAP, DEFAULT_MATCH_INIT
from jaxsmw.core.arrays import Array
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, extend_to_unreferenced, make_mesh
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Sizes
from jaxsmw.matching.starts import make_start

MOST_SAMPLES = 1000
"""The largest number of samples that a method uses. Both shapes have fewer if one has fewer vertices."""

PointwiseMap = Int[Array, " m"] | Int[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class MethodInput:
    """The input of a method: two shapes X and Y, prepared once for all methods.

    **Attributes:**

    - `spectra`: the spectra and samples of X and Y, with at least as many eigenvectors as any method uses.
      `SpectralPair.seen_by` makes the spectra of a partial pair comparable.
    - `initial_map`: the initial map X -> Y (m,), 0-based vertices of Y.
    - `meshes`: the meshes of X and Y, for methods that need edges or faces.
    - `names`: the names of X and Y, for methods that read maps from files.
    - `init`: the initial map as the argument `init` of `jaxsmw.match`, for methods that call `match`.
    """

    spectra: SpectralPair
    initial_map: Int[Array, " m"]
    meshes: tuple[Mesh, Mesh] | None = None
    names: tuple[str, str] = ("X", "Y")
    init: str | Int64[np.ndarray, " vertices"] = DEFAULT_MATCH_INIT

    @classmethod
    def prepare(
        cls,
        pair: Pair,
        *,
        names: tuple[str, str] = ("X", "Y"),
        init: str | Int64[np.ndarray, " vertices"] = DEFAULT_MATCH_INIT,
        sizes: Sizes,
        number_of_descriptors: int = 0,
    ) -> MethodInput:
        """Compute the input that all methods share: spectra, descriptors, the initial map and samples.

        With `"auto"`, the initial map is `"shot"`. The descriptors are principal components of SHOT. A small
        mesh has fewer samples than `sizes` states.

        **Raises:** `InputError` if a spectrum, a descriptor or the initial map cannot be computed;
        `ArithmeticError` if the computation of the initial map fails numerically.
        """
        automatic = isinstance(init, str) and init == DEFAULT_MATCH_INIT
        samples = min(sizes.number_of_samples, pair.fewest_vertices())
        prepared = prepare(pair, sizes._replace(number_of_samples=samples))
        start = make_start(prepared, DEFAULT_INITIAL_MAP if automatic else init)
        if number_of_descriptors:
            prepared = prepared.describe(number_of_descriptors)
        initial_map = start.pointwise_map.astype(np.int32)
        return cls(prepared.spectra, initial_map, pair.meshes, names, init)


class Measured(NamedTuple):
    """The map that a method has computed, and the time that this took.

    **Attributes:**

    - `pointwise_map`: the pointwise map X -> Y (m,), 0-based vertices of Y.
    - `seconds`: the seconds from the initial map to the map; NaN if it was computed elsewhere.
    - `correspondence`: if the method calls `match`, its `Correspondence`, which also predicts the overlap of
      two parts and the probability that the map is right; otherwise None.
    """

    pointwise_map: PointwiseMap
    seconds: float
    correspondence: Correspondence | None = None


class Method(abc.ABC):
    """The base class of all compared methods. A method computes a pointwise map from a prepared pair.

    **Attributes:**

    - `reference`: the publication and the settings of the method, as text that is printed with the results.
    - `number_of_eigenvectors`, `number_of_crease_eigenvectors`, `number_of_descriptors`: the largest numbers
      that the method uses.
    - `bases`: the names of the bases that the method uses besides the Laplacian's.
    - `package`: the import name of the optional package that the method needs; an empty text for none.
    - `full_only`: whether the method matches only pairs of full shapes.
    - `partial_only`: whether the method matches only partial pairs.
    """

    reference: str
    number_of_eigenvectors: int
    number_of_crease_eigenvectors: int = 0
    number_of_descriptors: int = 0
    bases: tuple[str, ...] = ()
    package: str = ""
    full_only: bool = False
    partial_only: bool = False

    @abc.abstractmethod
    def __call__(self, pair: MethodInput) -> PointwiseMap:
        """Return the pointwise map X -> Y (m,), 0-based vertices of Y.

        **Raises:** `ArithmeticError` if the method fails numerically.
        """

    @property
    def is_available(self) -> bool:
        """Whether the package that the method needs is installed."""
        return not self.package or find_spec(self.package) is not None

    def measure(self, pair: MethodInput) -> Measured:
        """Compute the map, and measure its time."""
        began = time.perf_counter()
        pointwise_map = np.asarray(self(pair))  # waits for JAX
        return Measured(pointwise_map, time.perf_counter() - began)

    def measure_all(self, pairs: Sequence[MethodInput]) -> list[Measured | ArithmeticError]:
        """Measure several pairs, one after another unless a subclass batches them.

        **Returns:** For each pair, what `measure` returns, or the error that it raises if the method fails.
        """
        results: list[Measured | ArithmeticError] = []
        for pair in pairs:
            try:
                results.append(self.measure(pair))
            except ArithmeticError as error:
                results.append(error)
        return results

    def check(self, pairs: Sequence[AnyPair]) -> None:
        """Raise `InputError` if the method cannot match a pair. A benchmark checks all pairs at first."""
        if not self.suits(pairs):
            fault = "cannot match partial shapes" if self.full_only else "matches partial shapes only"
            raise InputError(f"{self.reference}: {fault}: remove this method from --methods.")

    def suits(self, pairs: Sequence[AnyPair]) -> bool:
        """Return whether the method can match all pairs. Unlike `check`, `suits` does not look for files."""
        partial = [pair.partial for pair in pairs]
        return not (self.full_only and any(partial)) and not (self.partial_only and not all(partial))


def successful(pointwise_map: Int[Array, " m"], result: RESULTS) -> Int[Array, " m"]:
    """Return the map of a refinement. Raise `ArithmeticError` if its status code is not `successful`."""
    if result != RESULTS.successful:
        raise ArithmeticError(sentence(result))
    return pointwise_map


@dataclass(frozen=True, eq=False)
class HostShape:
    """A shape without unreferenced vertices, in NumPy float64.

    **Attributes:**

    - `mesh`: the mesh with its u referenced vertices.
    - `vertices`: the number of each referenced vertex in the given mesh (u,).
    - `spectrum`: the spectrum of the given mesh.
    """

    mesh: Mesh
    vertices: Int64[np.ndarray, " u"]
    spectrum: Spectrum

    @classmethod
    def of(cls, mesh: Mesh, spectrum: Spectrum) -> HostShape:
        """Return a mesh and its spectrum without unreferenced vertices."""
        used = mesh.referenced_indices
        if len(used) < len(mesh.vertices):
            mesh = make_mesh(*mesh.compact(), name=mesh.name)
        return cls(mesh, used, spectrum)

    @property
    def eigenvalues(self) -> Float64[np.ndarray, " k"]:
        """The eigenvalues (k,)."""
        return np.asarray(self.spectrum.eigenvalues, np.float64)

    @cached_property
    def eigenvectors(self) -> Float64[np.ndarray, "u k"]:
        """The eigenvectors at the referenced vertices (u, k)."""
        return self._rows(self.spectrum.eigenvectors)

    @property
    def vertex_areas(self) -> Float64[np.ndarray, " u"]:
        """The vertex areas (u,)."""
        return self._rows(self.spectrum.vertex_areas)

    @property
    def descriptors(self) -> Float64[np.ndarray, "u d"]:
        """The descriptors (u, d)."""
        assert self.spectrum.descriptors is not None
        return self._rows(self.spectrum.descriptors)

    def _rows(self, array: Float[Array, "n ..."]) -> Float64[np.ndarray, "u ..."]:
        return np.asarray(array, np.float64)[self.vertices]


class HostMethod(Method):
    """The base class of methods in NumPy that match full shapes without unreferenced vertices.

    An unreferenced vertex receives the match of the nearest referenced vertex.
    """

    full_only = True

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        assert pair.meshes is not None
        mesh_x, _ = pair.meshes
        x, y = (HostShape.of(mesh, s) for mesh, s in zip(pair.meshes, pair.spectra.both, strict=True))
        initial_map = np.searchsorted(y.vertices, np.asarray(pair.initial_map)[x.vertices])
        images = np.zeros(len(mesh_x.vertices), np.int64)
        images[x.vertices] = y.vertices[self.match(initial_map, x, y)]
        return extend_to_unreferenced(mesh_x, images)

    @abc.abstractmethod
    def match(
        self, initial_map: Int64[np.ndarray, " u"], x: HostShape, y: HostShape
    ) -> Int64[np.ndarray, " u"]:
        """Return the map X -> Y (u,) between the referenced vertices, which are counted from 0."""
