"""Spectral ICP, and refinement without any constraint on the functional map.

Spectral ICP is the iterative refinement of Ovsjanikov, Ben-Chen, Solomon, Butscher, Guibas, *Functional maps:
a flexible representation of maps between shapes*, ACM Transactions on Graphics 31(4), 2012. Each iteration
encodes the pointwise map as a functional map, replaces the functional map by the nearest orthogonal matrix,
and then searches for nearest neighbours. `SPECTRAL_ICP` and `NO_FILTER` run in the loop of `jaxsmw.refine`
with 100 eigenvectors, like MWP.

- `SPECTRAL_ICP`: spectral ICP with 10 iterations.
- `NO_FILTER`: the 3 iterations of MWP, without filters.
"""

from __future__ import annotations

from jaxsmw.benchmark.opponents.presets import Refined
from jaxsmw.core.banks import Identity
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.solutions import Filtering, NearestOrthogonal

NO_FILTER = Refined("MWP without filters: k = 100, 3 iterations", WaveletPreservation(Identity()))
SPECTRAL_ICP = Refined(
    "Ovsjanikov et al. 2012, spectral ICP: k = 100, 10 iterations",
    WaveletPreservation(Identity(), NearestOrthogonal(Filtering())),
    iterations=10,
)
