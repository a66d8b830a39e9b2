"""The interface of the compared methods: their input and their result.

All methods get the same prepared pair: the same spectra, the same initial map and the same samples.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.evaluation.datasets import DataPair
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.preparation import PreparedPair
from jaxsmw.runtime.padding import pad_rows
from jaxsmw.stage import Stage

MOST_SAMPLES = 1000
"""The number of samples of each shape in a prepared pair. Smaller shapes have fewer; no method uses more."""


@dataclass(frozen=True, eq=False)
class MethodInput:
    """The input of a method: two shapes X and Y, prepared once for all methods.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: the spectra, with at least as many eigenvectors as any method uses.
    - `initial_map`: the initial map X -> Y (m,), 0-based vertices of Y.
    - `samples`: vertices of X and of Y in farthest-point order, for methods that iterate on samples.
    - `reverse_initial_map`: the initial map Y -> X (n,), 0-based vertices of X, for methods that need
      `both_directions`.
    - `meshes`: X and Y, for methods that need edges or faces.
    - `names`: the names of X and Y, for methods that read maps from files.
    - `partial`: whether one shape is a partial shape of the other. The two spectra are then comparable only
      up to the smaller of their largest eigenvalues.
    - `prepared`: the pair as `jaxsmw.match` prepares it, for methods that run a preset.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    initial_map: Int[Array, " m"]
    samples: tuple[Int[Array, " s_x"], Int[Array, " s_y"]]
    reverse_initial_map: Int[Array, " n"] | None = None
    meshes: tuple[Mesh, Mesh] | None = None
    names: tuple[str, str] = ("X", "Y")
    partial: bool = False
    prepared: PreparedPair | None = None

    @classmethod
    def of(
        cls,
        prepared: PreparedPair,
        names: tuple[str, str],
        reverse_initial_map: Int64[np.ndarray, " n"] | None = None,
    ) -> MethodInput:
        """Returns the input of all methods for a pair.

        **Arguments:**

        - `prepared`: the result of `jaxsmw.preparation.prepare`, with samples.
        - `names`: the names of X and Y.
        - `reverse_initial_map`: the initial map Y -> X (n,), or None.
        """
        assert prepared.samples is not None
        spectrum_x, spectrum_y = prepared.padded
        reverse = None
        if reverse_initial_map is not None:
            padded = pad_rows(reverse_initial_map, spectrum_y.mask.shape[0])
            reverse = jnp.asarray(padded, jnp.int32)
        return cls(
            spectrum_x,
            spectrum_y,
            prepared.padded_map(prepared.initial_map),
            prepared.samples,
            reverse,
            prepared.pair.meshes,
            names,
            prepared.pair.partial,
            prepared,
        )

    def seen_in(self, stage: Stage) -> tuple[Spectrum, Spectrum]:
        """Returns both spectra with the eigenvectors and descriptors of a stage.

        The spectra of a partial pair are also cut to their common range.
        """
        return stage.view(self.spectrum_x, self.spectrum_y, partial=self.partial)

    def truncated(self, k: int) -> tuple[Spectrum, Spectrum]:
        """Returns both spectra with k eigenvectors; for a partial pair, with those in the common range."""
        return self.seen_in(Stage(number_of_eigenvectors=k))

    def sampled(self, count: int | None) -> tuple[Int[Array, " s_x"] | None, Int[Array, " s_y"] | None]:
        """Returns the first `count` samples of X and of Y; None for both if `count` is None."""
        samples_x, samples_y = self.samples
        return (None, None) if count is None else (samples_x[:count], samples_y[:count])


class Method(abc.ABC):
    """A method that computes a pointwise map from a prepared pair; the interface of all compared methods.

    **Attributes:**

    - `reference`: the publication and the settings, as text that is printed with the results.
    - `number_of_eigenvectors`: the largest number of eigenvectors that the method uses.
    - `number_of_descriptors`: the largest number of descriptors that the method uses.
    - `both_directions`: whether the method needs `MethodInput.reverse_initial_map`.
    - `full_only`: whether the method is undefined on partial pairs.
    - `partial_only`: whether the method is undefined on pairs of full shapes.
    """

    reference: str
    number_of_eigenvectors: int
    number_of_descriptors: int = 0
    both_directions: bool = False
    full_only: bool = False
    partial_only: bool = False

    @abc.abstractmethod
    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Returns the map X -> Y (m,), 0-based vertices of Y, and a member of `RESULTS`.

        If the result is not successful, the map is invalid; most methods then return -1 everywhere.
        """

    def check(self, pairs: Sequence[DataPair]) -> None:
        """Checks, before any pair is matched, that the method is defined on all pairs.

        **Raises:** `InputError` if the method is undefined on a pair.
        """
        if self.full_only and any(pair.partial for pair in pairs):
            raise InputError(f"{self.reference}: cannot match partial shapes: remove it from --methods.")
        if self.partial_only and not all(pair.partial for pair in pairs):
            raise InputError(f"{self.reference}: matches partial shapes only: remove it from --methods.")

    def suits(self, pairs: Sequence[DataPair]) -> bool:
        """Returns whether the method is defined on all pairs. Unlike `check`, `suits` checks no files."""
        partial = [pair.partial for pair in pairs]
        return not (self.full_only and any(partial)) and not (self.partial_only and not all(partial))


def check_spectrum(mesh: Mesh, spectrum: Spectrum) -> None:
    """Checks that a spectrum, padded or not, has a row for every vertex of a mesh.

    **Raises:** `InputError` if the spectrum has fewer rows than the mesh has vertices.
    """
    rows, n = spectrum.mask.shape[0], len(mesh.vertices)
    if rows < n:
        raise InputError(
            f"{mesh.name}: has {n} vertices, but its spectrum has {rows}: give the spectrum of this mesh."
        )
