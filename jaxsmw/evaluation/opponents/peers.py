"""Other libraries' programs on the same spectra and starts, for comparison: an optional environment.

    pip install 'jaxsmw[benchmark,peers]'

Their methods are found by name like ours where their packages are installed. They run in the same process,
on as many cores.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float64, Int, Int64

from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.evaluation.opponents.opponents import (
    FIRST_EIGENVECTORS,
    LAST_EIGENVECTORS,
    ZOOMOUT_STEP,
    Method,
    PreparedPair,
)


class Peer(Method):
    """ZoomOut of another library, with the steps of its paper, from k = 20 to 120.

    Its shape 1 is our Y and its shape 2 our X: its functional maps take functions on 1 to functions on 2, its
    pointwise maps vertices of 2 to vertices of 1.
    """

    number_of_eigenvectors = LAST_EIGENVECTORS
    whole_only = True
    package: str

    def __call__(self, pair: PreparedPair) -> tuple[Int[Array, " m"], RESULTS]:
        x, y = (_Shape.of(spectrum) for spectrum in (pair.spectrum_x, pair.spectrum_y))
        start = np.searchsorted(y.vertices, np.asarray(pair.start)[x.vertices])
        found = np.zeros(pair.start.shape, np.int32)
        found[x.vertices] = y.vertices[self.refine(start, x, y)]
        return jnp.asarray(found), RESULTS.successful  # type: ignore[return-value]

    @abc.abstractmethod
    def refine(self, start: Int64[np.ndarray, " u"], x: _Shape, y: _Shape) -> Int64[np.ndarray, " u"]:
        """The map of X's used vertices to Y's, both counted from 0."""


@dataclass(frozen=True, eq=False)
class _Shape:
    """The vertices of a surface, without padding, in the precision that other libraries work in."""

    vertices: Int64[np.ndarray, " u"]
    eigenvalues: Float64[np.ndarray, " k"]
    eigenvectors: Float64[np.ndarray, "u k"]
    areas: Float64[np.ndarray, " u"]

    @classmethod
    def of(cls, spectrum: Spectrum) -> _Shape:
        used = np.flatnonzero(spectrum.mask)
        arrays = spectrum.eigenvalues, spectrum.eigenvectors[used], spectrum.vertex_areas[used]
        return cls(used, *(np.asarray(array, np.float64) for array in arrays))


class PyFM(Peer):
    """pyFM (`pyfmaps`), by Magnet."""

    reference = "pyFM's zoomout_refine, k = 20, 25, ..., 120, one job"
    package = "pyFM"

    def refine(self, start: Int64[np.ndarray, " u"], x: _Shape, y: _Shape) -> Int64[np.ndarray, " u"]:
        """`pyFM.refine.zoomout_refine`."""
        from pyFM.refine import zoomout_refine
        from pyFM.spectral import p2p_to_FM
        from scipy.sparse import diags_array

        areas = diags_array(x.areas).tocsr()
        first = p2p_to_FM(
            start, y.eigenvectors[:, :FIRST_EIGENVECTORS], x.eigenvectors[:, :FIRST_EIGENVECTORS], A2=areas
        )
        _, found = zoomout_refine(
            first,
            y.eigenvectors,
            x.eigenvectors,
            nit=_STEPS,
            step=ZOOMOUT_STEP,
            A2=areas,
            return_p2p=True,
            n_jobs=1,
        )
        return np.asarray(found)


class Geomfum(Peer):
    """geomfum."""

    reference = "geomfum's ZoomOut, k = 20, 25, ..., 120"
    package = "geomfum"

    def refine(self, start: Int64[np.ndarray, " u"], x: _Shape, y: _Shape) -> Int64[np.ndarray, " u"]:
        """`geomfum.refine.ZoomOut`."""
        from geomfum.basis import EigenBasis
        from geomfum.convert import FmFromP2pConverter, P2pFromFmConverter
        from geomfum.refine import ZoomOut

        bases = [EigenBasis(shape.eigenvalues, shape.eigenvectors) for shape in (y, x)]
        first = FmFromP2pConverter()(start, *(basis.truncate(FIRST_EIGENVECTORS) for basis in bases))
        refined = ZoomOut(nit=_STEPS, step=ZOOMOUT_STEP)(first, *bases)
        return np.asarray(P2pFromFmConverter()(refined, *bases))


_STEPS = (LAST_EIGENVECTORS - FIRST_EIGENVECTORS) // ZOOMOUT_STEP


def installed_peers() -> dict[str, Method]:
    """Those whose packages are there, by name."""
    peers: dict[str, Peer] = {"pyfm-zoomout": PyFM(), "geomfum-zoomout": Geomfum()}
    return {name: peer for name, peer in peers.items() if find_spec(peer.package)}
