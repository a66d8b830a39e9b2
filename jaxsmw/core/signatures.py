"""Spectral signatures: the heat kernel signature, the wave kernel signature and a wavelet signature.

All three signatures have the form `f_t(x) = sum_i w_t(lambda_i) phi_i(x)² / sum_i w_t(lambda_i)`. Dimension t
has its own weight function w_t of the eigenvalue. The arrays (n, dimensions) are in units of 1 / area: on a
surface of area 1, the area-weighted mean of each dimension is 1. The signatures do not depend on the signs of
the eigenvectors, and they do not distinguish left from right. All entries are NaN if no eigenvalue is
positive. In the docstrings, lambda_max is the largest eigenvalue, and lambda_min is the smallest positive
eigenvalue.
"""

from __future__ import annotations

import math

from jaxtyping import Float

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.banks import Meyer
from jaxsmw.core.linear_algebra import product
from jaxsmw.core.spectrum import Spectrum


def heat_kernel_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Return the heat kernel signature at log-spaced diffusion times (Sun, Ovsjanikov, Guibas 2009).

    The times run from `4 ln 10 / lambda_max` to `4 ln 10 / lambda_min`.

    **Returns:** The signature (n, dimensions), in units of 1 / area. On a surface of area 1, the
    area-weighted mean of each column is 1. All entries are NaN if no eigenvalue is positive.
    """
    xp = namespace(spectrum.eigenvalues)
    smallest, largest = _positive_range(spectrum)
    times = 4 * math.log(10) / xp.geomspace(largest, smallest, dimensions, dtype=largest.dtype)
    return _signature(spectrum, xp.exp(-times[:, None] * spectrum.eigenvalues[None, :]))


def wave_kernel_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Return the wave kernel signature at evenly spaced logarithmic energies.

    Aubry, Schlickewei, Cremers 2011 define this signature. The weights are Gaussians in the logarithm of the
    eigenvalue. The centres of the Gaussians run in even steps from `log lambda_min + 2 width` to `log
    lambda_max - 2 width`. The `width` (standard deviation) of each Gaussian is 7 steps. The result is as in
    `heat_kernel_signature`.
    """
    xp = namespace(spectrum.eigenvalues)
    smallest, largest = _positive_range(spectrum)
    low, high = xp.log(smallest), xp.log(largest)
    # The outermost centres are `dimensions - 1` steps apart. The first and the last centre are
    # 2 widths away from the ends of the range. One width is 7 steps.
    width = 7 * (high - low) / (dimensions - 1 + 28)
    energies = xp.linspace(low + 2 * width, high - 2 * width, dimensions, dtype=low.dtype)
    positive = spectrum.eigenvalues >= smallest
    log_eigenvalues = xp.log(xp.where(positive, spectrum.eigenvalues, smallest))
    weights = xp.exp(-((energies[:, None] - log_eigenvalues[None, :]) ** 2) / (2 * width**2))
    return _signature(spectrum, xp.where(positive[None, :], weights, 0))


def wavelet_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Return the wavelet signature: the scaled squared norm of the Meyer wavelet at each vertex and scale.

    This signature is a spectral wavelet signature in the sense of Li and Ben Hamza 2013, but with the
    band-pass filter of the Meyer frame from the MWP paper. The filter of each scale is largest at an
    eigenvalue `peak` and passes the eigenvalues from `peak / 2` to `2 peak`. The peaks are log-spaced from
    lambda_min to `lambda_max / 2`. The result is as in `heat_kernel_signature`, and a column is NaN if its
    filter passes no eigenvalue.
    """
    xp = namespace(spectrum.eigenvalues)
    smallest, largest = _positive_range(spectrum)
    peaks = xp.geomspace(smallest, largest / 2, dimensions, dtype=largest.dtype)
    # The second of three Meyer filters on [0, 2 peak] passes the band from peak / 2 to 2 peak.
    wavelets = xp.stack([Meyer(3)(spectrum.eigenvalues, 2 * peak[None])[1] for peak in peaks])
    return _signature(spectrum, wavelets**2)


def _signature(spectrum: Spectrum, weights: Float[Array, "dimensions k"]) -> Float[Array, "n dimensions"]:
    total = namespace(weights).sum(weights, axis=1, keepdims=True)
    return product(spectrum.eigenvectors**2, (weights / total).T)


def _positive_range(spectrum: Spectrum) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the smallest positive and the largest eigenvalue."""
    xp, largest = namespace(spectrum.eigenvalues), spectrum.eigenvalues[-1]
    positive = spectrum.eigenvalues > 1e-6 * largest
    return xp.min(xp.where(positive, spectrum.eigenvalues, largest)), largest
