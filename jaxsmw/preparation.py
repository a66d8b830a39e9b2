"""From a pair of meshes to everything that refinement needs, for `match`, benchmarks and studies alike."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Array, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import Eigensolver, Laplacian
from jaxsmw.core.refiner import Samples
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import describe
from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.initial_maps import InitialMap, initial_map
from jaxsmw.pair import Pair, paired_spectra
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size
from jaxsmw.runtime.progress import timed
from jaxsmw.runtime.threads import side_by_side
from jaxsmw.stage import Stage

# Larger shapes are not padded: their padding costs more memory than compiled programs cost time.
_PADDED_UP_TO = 50_000
# The smallest mesh with two eigenvectors, for half as many eigenvectors as vertices.
_FEWEST_VERTICES = 4


def program_size(mesh: Mesh) -> int:
    """The number of vertices to which a mesh is padded, so that one compiled program serves similar sizes."""
    n = len(mesh.vertices)
    return n if n > _PADDED_UP_TO else padded_size(n)


def fewest_vertices(pair: Pair) -> int:
    """The number of vertices that faces use, on the mesh with fewer of them.

    **Raises:** `InputError` if a mesh has too few to be matched.
    """
    used = [int(mesh.referenced_vertices.sum()) for mesh in pair.meshes]
    for mesh, number in zip(pair.meshes, used, strict=True):
        if number < _FEWEST_VERTICES:
            raise InputError(
                f"{mesh.name}: its faces use {number} vertices, too few to be matched by shape: give a mesh "
                f"of at least {_FEWEST_VERTICES} vertices, or of hundreds for a meaningful result."
            )
    return min(used)


@dataclass(frozen=True, eq=False)
class PreparedPair:
    """A pair with everything that refinement needs.

    **Attributes:**

    - `pair`: the meshes.
    - `spectrum_x`, `spectrum_y`: their spectra, with descriptors if requested.
    - `init`: what was asked for as the initial map.
    - `initial_map`: T: X -> Y (m,).
    - `samples`: vertices of X and Y in farthest-point order, or None.
    - `seconds`: the wall time of each step of the preparation.
    """

    pair: Pair
    spectrum_x: Spectrum
    spectrum_y: Spectrum
    init: InitialMap | ArrayLike | SurfacePoints
    initial_map: Int64[np.ndarray, " m"]
    samples: Samples | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @cached_property
    def padded(self) -> tuple[Spectrum, Spectrum]:
        """Both spectra, padded to the sizes of compiled programs."""
        pad = compiled(Spectrum.pad)
        return (
            pad(self.spectrum_x, program_size(self.pair.mesh_x)),
            pad(self.spectrum_y, program_size(self.pair.mesh_y)),
        )

    def padded_map(self, pointwise_map: Int64[np.ndarray, " m"]) -> Int[Array, " p"]:
        """A map of X's vertices on the device, padded like X."""
        # The type of every later map, so that one program serves all stages.
        padded = pad_rows(pointwise_map, program_size(self.pair.mesh_x)).astype(np.int32)
        return jax.device_put(padded)

    def view(self, stage: Stage) -> tuple[Spectrum, Spectrum]:
        """The padded spectra as a stage sees them."""
        return stage.view(*self.padded, partial=self.pair.partial)


def prepare(
    pair: Pair,
    *,
    number_of_eigenvectors: int,
    number_of_descriptors: int = 0,
    number_of_samples: int = 0,
    init: InitialMap | ArrayLike | SurfacePoints = "shot",
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    descriptors_required: bool = False,
) -> PreparedPair:
    """Computes spectra, initial map, descriptors and samples of a pair.

    **Arguments:**

    - `number_of_eigenvectors`, `number_of_descriptors`, `number_of_samples`: the largest number that any
      stage uses.
    - `init`: see `match`.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`.
    - `descriptors_required`: raise an error if a mesh is too coarse for descriptors, instead of a warning.

    **Raises:** `InputError` for arguments that cannot work; `ArithmeticError` if the initial map cannot be
    computed.
    """
    seconds: dict[str, float] = {}
    with timed("eigenbases", seconds):
        spectra = paired_spectra(pair, number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver)
    for mesh, spectrum in zip(pair.meshes, spectra, strict=True):
        if np.asarray(spectrum.eigenvalues)[-1] == 0:
            raise InputError(
                f"{mesh.name}: {number_of_eigenvectors} eigenvectors only tell to which connected component "
                "a vertex belongs; ask for more eigenvectors than components, or join vertices at the same "
                "position (weld=True, on the command line --weld)."
            )
    with timed("initial map", seconds):
        start = initial_map(pair, *spectra, init=init)
    if number_of_descriptors:
        with timed("descriptors", seconds):
            try:
                spectra = describe(pair, *spectra, number_of_descriptors)
            except InputError as error:
                if descriptors_required:
                    raise
                warnings.warn(f"refinement goes on without descriptors: {error}", stacklevel=3)
    samples = None
    if number_of_samples:
        with timed("samples", seconds):
            samples_x, samples_y = side_by_side(
                lambda mesh: farthest_point_samples(mesh, number_of_samples), *pair.meshes
            )
            samples = jax.device_put(samples_x), jax.device_put(samples_y)
    return PreparedPair(pair, *spectra, init, start, samples, seconds)
