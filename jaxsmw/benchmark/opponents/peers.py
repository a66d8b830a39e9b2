"""The ZoomOut implementations of other libraries, as methods for `jaxsmw benchmark`.

The methods need optional packages, and are available only if these packages are installed:

    pip install 'jaxsmw[benchmark,peers]'

`PyFM` and `Geomfum` receive the same spectra and initial maps as all other compared methods, and run on the
same number of cores. Both methods use the settings of the ZoomOut paper (see `baselines`): the number of
eigenvectors k is 20, 25, ..., 120, and every iteration uses all vertices.

- `PyFM` calls the function `zoomout_refine` of Robin Magnet's pyFM (`pyfmaps` on the package index) with
  `n_jobs=1`.
- `Geomfum` uses the class `ZoomOut` of geomfum.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.benchmark.opponents.base import Method, MethodInput, PointwiseMap
from jaxsmw.benchmark.opponents.baselines import ZOOMOUT
from jaxsmw.core.spectrum import Spectrum


class Peer(Method):
    """The base class of methods that call another library's ZoomOut, with k = 20, 25, ..., 120 eigenvectors.

    A subclass must define `refine`, `reference` and `package`. In both libraries, Y is shape 1 and X is
    shape 2. Functional maps take functions on shape 1 to functions on shape 2, and pointwise maps take
    vertices of shape 2 to vertices of shape 1.

    **Attributes:**

    - `package`: the name under which the other library is imported.
    """

    number_of_eigenvectors = ZOOMOUT.number_of_eigenvectors
    full_only = True
    package: str

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        x, y = (_Shape.of(spectrum) for spectrum in pair.spectra.both)
        initial_map = np.searchsorted(y.vertices, np.asarray(pair.initial_map)[x.vertices])
        found = np.zeros(pair.initial_map.shape, np.int32)
        found[x.vertices] = y.vertices[self.refine(initial_map, x, y)]
        return found

    @abc.abstractmethod
    def refine(self, initial_map: Int64[np.ndarray, " u"], x: _Shape, y: _Shape) -> Int64[np.ndarray, " u"]:
        """Return the refined map X -> Y (u,) between the referenced vertices, which are counted from 0.

        **Arguments:**

        - `initial_map`: the initial map X -> Y (u,) between the referenced vertices.
        - `x`, `y`: the spectra of X and Y at their referenced vertices.
        """


@dataclass(frozen=True, eq=False)
class _Shape:
    """The spectrum of a shape at its u referenced vertices, converted to float64 for other libraries."""

    vertices: Int64[np.ndarray, " u"]
    eigenvalues: Float64[np.ndarray, " k"]
    eigenvectors: Float64[np.ndarray, "u k"]
    areas: Float64[np.ndarray, " u"]

    @classmethod
    def of(cls, spectrum: Spectrum) -> _Shape:
        """Convert a spectrum. Padding and unreferenced vertices are left out."""
        used = np.flatnonzero(spectrum.mask)
        arrays = spectrum.eigenvalues, spectrum.eigenvectors[used], spectrum.vertex_areas[used]
        return cls(used, *(np.asarray(array, np.float64) for array in arrays))


class PyFM(Peer):
    """The ZoomOut implementation of pyFM."""

    reference = "pyFM's zoomout_refine, k = 20, 25, ..., 120, one job"
    package = "pyFM"

    def refine(self, initial_map: Int64[np.ndarray, " u"], x: _Shape, y: _Shape) -> Int64[np.ndarray, " u"]:
        from pyFM.refine import zoomout_refine
        from pyFM.spectral import p2p_to_FM
        from scipy.sparse import diags_array

        areas = diags_array(x.areas).tocsr()
        first = p2p_to_FM(
            initial_map,
            y.eigenvectors[:, : ZOOMOUT.first],
            x.eigenvectors[:, : ZOOMOUT.first],
            A2=areas,
        )
        _, found = zoomout_refine(
            first,
            y.eigenvectors,
            x.eigenvectors,
            nit=_STEPS,
            step=ZOOMOUT.step,
            A2=areas,
            return_p2p=True,
            n_jobs=1,
        )
        return np.asarray(found)


class Geomfum(Peer):
    """The ZoomOut implementation of geomfum."""

    reference = "geomfum's ZoomOut, k = 20, 25, ..., 120"
    package = "geomfum"

    def refine(self, initial_map: Int64[np.ndarray, " u"], x: _Shape, y: _Shape) -> Int64[np.ndarray, " u"]:
        from geomfum.basis import EigenBasis
        from geomfum.convert import FmFromP2pConverter, P2pFromFmConverter
        from geomfum.refine import ZoomOut

        bases = [EigenBasis(shape.eigenvalues, shape.eigenvectors) for shape in (y, x)]
        first = FmFromP2pConverter()(initial_map, *(basis.truncate(ZOOMOUT.first) for basis in bases))
        refined = ZoomOut(nit=_STEPS, step=ZOOMOUT.step)(first, *bases)
        return np.asarray(P2pFromFmConverter()(refined, *bases))


_STEPS = (ZOOMOUT.number_of_eigenvectors - ZOOMOUT.first) // ZOOMOUT.step

PYFM, GEOMFUM = PyFM(), Geomfum()
