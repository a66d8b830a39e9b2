"""Spectral signatures, the features of the initial maps `wks`, `hks` and `wavelet`.

Spectral signatures do not distinguish left from right.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Array, Float

from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import SampledPair

SIGNATURES: dict[str, Callable[[Spectrum], Array]] = {
    "wks": wave_kernel_signature,
    "hks": heat_kernel_signature,
    "wavelet": wavelet_signature,
}
"""A dictionary from the name of each initial map to the function that computes its signature."""


def signature_features(
    sampled: SampledPair, name: str
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Compute a spectral signature on both shapes.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `name`: a key of `SIGNATURES`: `"wks"`, `"hks"` or `"wavelet"`.

    **Returns:** The signatures of X (m, d) and of Y (n, d), with one row per compared vertex.
    """
    signature = SIGNATURES[name]
    return np.asarray(signature(sampled.x.spectrum)), np.asarray(signature(sampled.y.spectrum))
