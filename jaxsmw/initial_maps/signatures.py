"""The initial maps `wks`, `hks` and `wavelet`: spectral signatures, which do not tell left from right."""

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
"""The signatures by the names of their initial maps."""


def signature_features(
    sampled: SampledPair, name: str
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """A signature of both shapes."""
    signature = SIGNATURES[name]
    return np.asarray(signature(sampled.x.spectrum)), np.asarray(signature(sampled.y.spectrum))
