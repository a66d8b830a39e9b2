"""The interface of the compared methods: their input and their output.

All methods receive the same prepared pair, with the same spectra, the same initial map and the same samples.
"""

from __future__ import annotations

import abc
import time
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.choices import DEFAULT_INITIAL_MAP, DEFAULT_MATCH_INIT
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching.executor import SpectralPair, padded_map
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.stages import Sizes
from jaxsmw.matching.starts import make_start

MOST_SAMPLES = 1000
"""The number of samples of each shape in a prepared pair. No method uses more samples.

If a shape has fewer referenced vertices, both shapes have the same smaller number of samples. This is the
number of referenced vertices of the shape with the fewest.
"""

PointwiseMap = Int[Array, " m"] | Int[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class MethodInput:
    """The input of a method: two shapes X and Y, prepared once for all methods.

    **Attributes:**

    - `spectra`: the spectra and samples of X and Y, with at least as many eigenvectors as any method uses.
      The spectra of a partial pair are comparable only in their common range of eigenvalues, to which
      `SpectralPair.seen_by` cuts them. Spectra and maps may be padded.
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
        number_of_eigenvectors: int,
        number_of_descriptors: int = 0,
    ) -> MethodInput:
        """Compute the input that all methods share: spectra, descriptors, the initial map and samples.

        **Arguments:**

        - `pair`: the source X (m vertices) and the target Y (n vertices).
        - `names`, `init`: the attributes of the same names. With `"auto"`, the initial map is `"shot"`.
        - `number_of_eigenvectors`: the number of eigenvectors of each shape, at least 1.
        - `number_of_descriptors`: the number of principal components of SHOT; 0 for no descriptors.

        **Returns:** A `MethodInput`, padded like the arrays of `jaxsmw.match`.

        **Raises:** `InputError` if a spectrum, a descriptor or the initial map cannot be computed;
        `ArithmeticError` if the computation of the initial map fails numerically.
        """
        automatic = isinstance(init, str) and init == DEFAULT_MATCH_INIT
        samples = min(MOST_SAMPLES, pair.fewest_vertices())
        prepared = prepare(pair, Sizes(number_of_eigenvectors, number_of_samples=samples))
        start = make_start(prepared, DEFAULT_INITIAL_MAP if automatic else init)
        if number_of_descriptors:
            prepared = prepared.describe(number_of_descriptors)
        return cls(prepared.spectra.padded, padded_map(start.pointwise_map), pair.meshes, names, init)


class Method(abc.ABC):
    """The base class of all compared methods. A method computes a pointwise map from a prepared pair.

    A subclass must define `__call__`, `reference` and `number_of_eigenvectors`. `METHODS` in
    `jaxsmw.benchmark.opponents.registry` contains the available methods.

    **Attributes:**

    - `reference`: the publication and the settings of the method, as text that is printed with the results.
    - `number_of_eigenvectors`: the largest number of eigenvectors that the method uses.
    - `number_of_descriptors`: the largest number of descriptors that the method uses.
    - `full_only`: whether the method matches only pairs of full shapes.
    - `partial_only`: whether the method matches only partial pairs.
    """

    reference: str
    number_of_eigenvectors: int
    number_of_descriptors: int = 0
    full_only: bool = False
    partial_only: bool = False

    @abc.abstractmethod
    def __call__(self, pair: MethodInput) -> PointwiseMap:
        """Return the pointwise map X -> Y (m,), 0-based vertices of Y, which may be padded.

        **Raises:** `ArithmeticError` if the method fails numerically.
        """

    def measure(self, pair: MethodInput) -> tuple[PointwiseMap, float]:
        """Return the map of `__call__`, and the seconds from the initial map to this map.

        The seconds are NaN if the map was computed elsewhere.
        """
        began = time.perf_counter()
        found = jax.block_until_ready(self(pair))
        return found, time.perf_counter() - began

    def check(self, pairs: Sequence[DataPair]) -> None:
        """Check that the method can match all pairs. A benchmark calls `check` before it matches any pair.

        **Raises:** `InputError` if the method cannot match a pair.
        """
        if self.full_only and any(pair.partial for pair in pairs):
            raise InputError(
                f"{self.reference}: cannot match partial shapes: remove this method from --methods."
            )
        if self.partial_only and not all(pair.partial for pair in pairs):
            raise InputError(
                f"{self.reference}: matches partial shapes only: remove this method from --methods."
            )

    def suits(self, pairs: Sequence[DataPair]) -> bool:
        """Return whether the method can match all pairs. Unlike `check`, `suits` does not look for files."""
        partial = [pair.partial for pair in pairs]
        return not (self.full_only and any(partial)) and not (self.partial_only and not all(partial))


def successful(pointwise_map: Int[Array, " m"], result: RESULTS) -> Int[Array, " m"]:
    """Return the map of a refinement. Raise `ArithmeticError` if its status code is not `successful`."""
    if result != RESULTS.successful:
        raise ArithmeticError(sentence(result))
    return pointwise_map


def check_spectrum(mesh: Mesh, spectrum: Spectrum) -> None:
    """Check that a spectrum, padded or not, has a row for every vertex of a mesh.

    **Raises:** `InputError` if the spectrum has fewer rows than the mesh has vertices.
    """
    rows, n = spectrum.mask.shape[0], len(mesh.vertices)
    if rows < n:
        raise InputError(
            f"{mesh.name}: has {n} vertices, but its spectrum has {rows} rows: give the spectrum of this "
            "mesh."
        )
