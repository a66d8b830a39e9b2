"""The ZoomOut implementations of other libraries, as methods for `jaxsmw benchmark`.

The methods are available if their libraries are installed:

    pip install 'jaxsmw[benchmark,peers]'

Both methods have the settings of the ZoomOut paper (see `baselines`), and run on the same number of cores as
all other methods. In both libraries, Y is shape 1 and X is shape 2. Functional maps take functions on shape 1
to functions on shape 2, and pointwise maps take vertices of shape 2 to vertices of shape 1.

- `PyFM` calls the function `zoomout_refine` of Robin Magnet's pyFM (`pyfmaps` on the package index) with
  `n_jobs=1`.
- `Geomfum` uses the class `ZoomOut` of geomfum.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64

from jaxsmw.benchmark.opponents.base import HostMethod, HostShape
from jaxsmw.benchmark.opponents.baselines import ZOOMOUT

_STEPS = (ZOOMOUT.number_of_eigenvectors - ZOOMOUT.first) // ZOOMOUT.step


class PyFM(HostMethod):
    """The ZoomOut implementation of pyFM."""

    reference = "pyFM's zoomout_refine, k = 20, 25, ..., 120, one job"
    package = "pyFM"
    number_of_eigenvectors = ZOOMOUT.number_of_eigenvectors

    def match(
        self, initial_map: Int64[np.ndarray, " u"], x: HostShape, y: HostShape
    ) -> Int64[np.ndarray, " u"]:
        from pyFM.refine import zoomout_refine
        from pyFM.spectral import p2p_to_FM
        from scipy.sparse import diags_array

        areas = diags_array(x.vertex_areas).tocsr()
        bases = [shape.eigenvectors[:, : ZOOMOUT.first] for shape in (y, x)]
        first = p2p_to_FM(initial_map, *bases, A2=areas)
        _, pointwise_map = zoomout_refine(
            first,
            y.eigenvectors,
            x.eigenvectors,
            nit=_STEPS,
            step=ZOOMOUT.step,
            A2=areas,
            return_p2p=True,
            n_jobs=1,
        )
        return np.asarray(pointwise_map)


class Geomfum(HostMethod):
    """The ZoomOut implementation of geomfum."""

    reference = "geomfum's ZoomOut, k = 20, 25, ..., 120"
    package = "geomfum"
    number_of_eigenvectors = ZOOMOUT.number_of_eigenvectors

    def match(
        self, initial_map: Int64[np.ndarray, " u"], x: HostShape, y: HostShape
    ) -> Int64[np.ndarray, " u"]:
        from geomfum.basis import EigenBasis
        from geomfum.convert import FmFromP2pConverter, P2pFromFmConverter
        from geomfum.refine import ZoomOut

        bases = [EigenBasis(shape.eigenvalues, shape.eigenvectors) for shape in (y, x)]
        first = FmFromP2pConverter()(initial_map, *(basis.truncate(ZOOMOUT.first) for basis in bases))
        refined = ZoomOut(nit=_STEPS, step=ZOOMOUT.step)(first, *bases)
        return np.asarray(P2pFromFmConverter()(refined, *bases))


PYFM, GEOMFUM = PyFM(), Geomfum()
