"""Prepares a pair for refinement: computes its spectra, initial map, descriptors and samples."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Array, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import Eigensolver, Laplacian
from jaxsmw.core.refiner import Samples
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.creases import crease_eigenvectors
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.matching.descriptors import SampledPair, describe, sample_pair
from jaxsmw.matching.pair import Pair, paired_spectra
from jaxsmw.matching.stages import Stage
from jaxsmw.matching.starts import InitialMap, check_initial_map, initial_map
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size
from jaxsmw.runtime.progress import timed
from jaxsmw.runtime.threads import side_by_side

# Meshes with more vertices than this number are not padded, because padding would need too much memory.
_PADDED_UP_TO = 50_000


def program_size(mesh: Mesh) -> int:
    """Return the number of vertices to which a mesh is padded.

    Meshes of similar sizes are padded to the same number, so they share compiled programs. Meshes with more
    than 50 000 vertices are not padded.
    """
    n = len(mesh.vertices)
    return n if n > _PADDED_UP_TO else padded_size(n)


@dataclass(frozen=True, eq=False)
class PreparedPair:
    """The result of `prepare`, which contains the data that refinement needs.

    **Attributes:**

    - `pair`: the `Pair` of the source X (m vertices) and the target Y (n vertices).
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, each a `Spectrum` in `Pair.units_of_length`, without
      padding. The spectra contain descriptors and crease eigenvectors if they were requested.
    - `init`: the argument `init` of `prepare`, from which the initial map was computed.
    - `initial_map`: T: X -> Y (m,), int64, as 0-based vertices of Y.
    - `samples`: the samples of X (s,) and of Y (s,), a pair of arrays of 0-based vertices in farthest-point
      order; None if no samples were requested.
    - `sampled`: the `SampledPair` with the vertices at which descriptors are compared; None if `init` is not
      a name and no descriptors were requested.
    - `seconds`: a dictionary from the name of each step of the preparation to its wall time in seconds.
    - `laplacian`, `eigensolver`: the arguments of `prepare`.
    - `trimmed`: whether the larger shape of a partial pair was trimmed; see
      `jaxsmw.matching.search.trimming`. The
      spectra of such a pair have equal numbers of eigenvectors.
    """

    pair: Pair
    spectrum_x: Spectrum
    spectrum_y: Spectrum
    init: InitialMap | ArrayLike | SurfacePoints
    initial_map: Int64[np.ndarray, " m"]
    samples: Samples | None = None
    sampled: SampledPair | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    laplacian: Laplacian = "auto"
    eigensolver: Eigensolver = "auto"
    trimmed: bool = False

    def started_from(self, init: InitialMap) -> PreparedPair:
        """Return the prepared pair with another initial map.

        The `seconds` of the result contain only the time of the new initial map.

        **Raises:** `InputError` or `ArithmeticError` if `jaxsmw.initial_map` cannot compute the map.
        """
        seconds: dict[str, float] = {}
        with timed("initial map", seconds):
            start = initial_map(self.pair, self.spectrum_x, self.spectrum_y, init=init, sampled=self.sampled)
        return replace(self, init=init, initial_map=start, seconds=seconds)

    def with_crease_eigenvectors(self, number: int) -> PreparedPair:
        """Return the prepared pair with crease eigenvectors in its spectra.

        The `seconds` of the result also contain the time of the crease eigenvectors.

        **Arguments:**

        - `number`: the number of crease eigenvectors of each shape, at least 1; see
          `jaxsmw.geometry.crease_eigenvectors`.

        **Raises:** `InputError` if the crease eigenvectors cannot be computed.
        """
        seconds = dict(self.seconds)
        with timed("crease eigenvectors", seconds):
            of_x, of_y = side_by_side(lambda mesh: crease_eigenvectors(mesh, number), *self.pair.meshes)
        return replace(
            self,
            spectrum_x=self.spectrum_x.with_crease_eigenvectors(jax.device_put(of_x)),
            spectrum_y=self.spectrum_y.with_crease_eigenvectors(jax.device_put(of_y)),
            seconds=seconds,
        )

    @cached_property
    def padded(self) -> tuple[Spectrum, Spectrum]:
        """Both spectra, padded to the sizes that `program_size` returns."""
        pad = compiled(Spectrum.pad)
        return (
            pad(self.spectrum_x, program_size(self.pair.mesh_x)),
            pad(self.spectrum_y, program_size(self.pair.mesh_y)),
        )

    def padded_map(self, pointwise_map: Int64[np.ndarray, " m"]) -> Int[Array, " p"]:
        """Return a map of X's vertices (m,) as a JAX array (p,), padded with zeros to `program_size`."""
        # The map is converted to int32, the type that refinement returns. For another type, JAX would compile
        # a second program.
        padded = pad_rows(pointwise_map, program_size(self.pair.mesh_x)).astype(np.int32)
        return jax.device_put(padded)

    def view(self, stage: Stage, *, padded: bool = True) -> tuple[Spectrum, Spectrum]:
        """Return the spectra, restricted to the data that a stage uses; see `Stage.view`.

        **Arguments:**

        - `stage`: the stage.
        - `padded`: whether the spectra are padded to the sizes that `program_size` returns.
        """
        spectra = self.padded if padded else (self.spectrum_x, self.spectrum_y)
        # The spectra of a trimmed pair have equal numbers of eigenvectors, so they need no common limit.
        return stage.view(*spectra, partial=self.pair.partial and not self.trimmed)


def prepare(
    pair: Pair,
    *,
    number_of_eigenvectors: int,
    number_of_descriptors: int = 0,
    number_of_crease_eigenvectors: int = 0,
    number_of_samples: int = 0,
    init: InitialMap | ArrayLike | SurfacePoints = "shot",
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    descriptors_required: bool = False,
    spectra: tuple[Spectrum, Spectrum] | None = None,
) -> PreparedPair:
    """Compute the spectra, the initial map, the descriptors and the samples of a pair.

    **Arguments:**

    - `pair`: a `Pair` of the source X (m vertices) and the target Y (n vertices).
    - `number_of_eigenvectors`: the largest number of eigenvectors that a stage uses, at least 1.
    - `number_of_descriptors`: the largest number of descriptors that a stage uses, from 0 to 352. With 0, no
      descriptors are computed.
    - `number_of_crease_eigenvectors`: the largest number of crease eigenvectors that a stage uses. With 0, no
      crease eigenvectors are computed.
    - `number_of_samples`: the largest number of samples of each shape that a stage uses. With 0, no samples
      are computed.
    - `init`: the initial map; see `match`. The argument is `"shot"`, `"wks"`, `"hks"`, `"wavelet"`,
      `"functional"`, `"aligned"`, a pointwise map (m,) of 0-based vertices of Y, a `SurfacePoints` with m
      points on Y, or an array (l, 2) of landmarks. Each row of landmarks contains a vertex of X and the
      matching vertex of Y, both 0-based.
    - `laplacian`: `"cotangent"`, `"robust"` or `"auto"`; see `jaxsmw.compute_spectrum`.
    - `eigensolver`: `"exact"`, `"approximate"` or `"auto"`; see `jaxsmw.compute_spectrum`.
    - `descriptors_required`: whether to raise `InputError` if a mesh is too coarse for descriptors. If False,
      the function issues a `UserWarning` instead, and the spectra contain no descriptors.
    - `spectra`: the result of `jaxsmw.matching.pair.paired_spectra` for this pair, if it was already
      computed.

    **Returns:** A `PreparedPair` with the attributes `spectrum_x`, `spectrum_y`, `initial_map` (m,) and
    `samples`. The spectra are in `Pair.units_of_length`. The initial map contains 0-based vertices of Y. The
    attribute `samples` is a pair of arrays (s,), with 0-based vertices of X and of Y. If no samples were
    requested, `samples` is None.

    **Raises:** `InputError` if a spectrum cannot be computed, if all requested eigenvalues of a mesh are
    zero, if `init` is unknown or does not fit the meshes, or if a mesh is too coarse for required
    descriptors. `ArithmeticError` if the initial map cannot be computed.
    """
    seconds: dict[str, float] = {}
    if spectra is None:
        # The check runs before the slow computation of the eigenbases.
        check_initial_map(pair, init)
        with timed("eigenbases", seconds):
            spectra = paired_spectra(
                pair, number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver
            )
    sampled = None
    with timed("initial map", seconds):
        if isinstance(init, str) or number_of_descriptors:
            sampled = sample_pair(pair, *spectra)
        start = initial_map(pair, *spectra, init=init, sampled=sampled)
    if number_of_descriptors:
        with timed("descriptors", seconds):
            try:
                spectra = describe(pair, *spectra, number_of_descriptors, sampled=sampled)
            except InputError as error:
                if descriptors_required:
                    raise
                warnings.warn(f"refinement continues without descriptors: {error}", stacklevel=3)
    samples = None
    if number_of_samples:
        with timed("samples", seconds):
            samples = paired_samples(pair, number_of_samples)
    prepared = PreparedPair(
        pair, *spectra, init, start, samples, sampled, seconds, laplacian=laplacian, eigensolver=eigensolver
    )
    if number_of_crease_eigenvectors:
        return prepared.with_crease_eigenvectors(number_of_crease_eigenvectors)
    return prepared


def paired_samples(pair: Pair, number: int) -> Samples:
    """Return samples of X and of Y, a pair of arrays (s,) of 0-based vertices in farthest-point order."""
    of_x, of_y = side_by_side(lambda mesh: farthest_point_samples(mesh, number), *pair.meshes)
    return jax.device_put(of_x), jax.device_put(of_y)
