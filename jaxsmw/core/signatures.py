"""Spectral signatures: vertex descriptors from heat, waves and wavelets.

All three signatures have the form `f_t(x) = sum_i w_t(lambda_i) phi_i(x)² / sum_i w_t(lambda_i)`, with
weights w_t that pass a band of eigenvalues. On a surface of area 1, each dimension has the area-weighted mean
1. The signatures do not depend on the signs of eigenvectors. They cannot distinguish left from right.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks import Meyer
from jaxsmw.core.products import product
from jaxsmw.core.spectrum import Spectrum


def heat_kernel_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Returns the heat kernel signature at log-spaced times (Sun, Ovsjanikov, Guibas 2009).

    The times run from `4 ln 10 / lambda_max` to `4 ln 10 / lambda_min`, where lambda_min is the smallest
    positive eigenvalue.

    **Arguments:**

    - `spectrum`: the shape with n vertices.
    - `dimensions`: the number of times.

    **Returns:** The signature of each vertex (n, dimensions), in units of 1 / area. On a surface of area 1,
    each column has the area-weighted mean 1. All entries are NaN if no eigenvalue is positive.
    """
    smallest, largest = _positive_range(spectrum)
    times = 4 * jnp.log(10.0) / jnp.geomspace(largest, smallest, dimensions)
    return _signature(spectrum, jnp.exp(-times[:, None] * spectrum.eigenvalues[None, :]))


def wave_kernel_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Returns the wave kernel signature at evenly spaced logarithmic energies.

    Aubry, Schlickewei, Cremers 2011. The weights are Gaussians with a width of 7 steps and centres from
    `log lambda_min + 2 width` to `log lambda_max - 2 width`. lambda_min is the smallest positive eigenvalue.

    **Arguments:**

    - `spectrum`: the shape with n vertices.
    - `dimensions`: the number of energies.

    **Returns:** The signature of each vertex (n, dimensions), in units of 1 / area. On a surface of area 1,
    each column has the area-weighted mean 1. All entries are NaN if no eigenvalue is positive.
    """
    smallest, largest = _positive_range(spectrum)
    low, high = jnp.log(smallest), jnp.log(largest)
    # The distance from each end to the nearest centre is 2 widths of 7 steps. Both ends add 28 steps to the
    # steps between the centres.
    width = 7 * (high - low) / (dimensions - 1 + 28)
    energies = jnp.linspace(low + 2 * width, high - 2 * width, dimensions)
    positive = spectrum.eigenvalues >= smallest
    log_eigenvalues = jnp.log(jnp.where(positive, spectrum.eigenvalues, smallest))
    weights = jnp.exp(-((energies[:, None] - log_eigenvalues[None, :]) ** 2) / (2 * width**2))
    return _signature(spectrum, jnp.where(positive[None, :], weights, 0))


def wavelet_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Returns the squared norms of the Meyer wavelets centred at each vertex, at log-spaced scales.

    This is a spectral wavelet signature in the sense of Li and Ben Hamza 2013, but with the band-pass kernel
    of the MWP paper's frame. The kernel passes eigenvalues from `peak / 2` to `2 peak`. The peaks run from
    lambda_min, the smallest positive eigenvalue, to `lambda_max / 2`.

    **Arguments:**

    - `spectrum`: the shape with n vertices.
    - `dimensions`: the number of scales.

    **Returns:** The signature of each vertex (n, dimensions), in units of 1 / area. On a surface of area 1,
    each column has the area-weighted mean 1. All entries are NaN if no eigenvalue is positive.
    """
    smallest, largest = _positive_range(spectrum)
    peaks = jnp.geomspace(smallest, largest / 2, dimensions)
    # The second of three Meyer filters on [0, 2 peak] passes this band.
    wavelets = jax.vmap(lambda peak: Meyer(3)(spectrum.eigenvalues, 2 * peak[None])[1])(peaks)
    return _signature(spectrum, wavelets**2)


def _signature(spectrum: Spectrum, weights: Float[Array, "dimensions k"]) -> Float[Array, "n dimensions"]:
    return product(spectrum.eigenvectors**2, (weights / jnp.sum(weights, axis=1, keepdims=True)).T)


def _positive_range(spectrum: Spectrum) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the smallest positive and the largest eigenvalue.

    Every connected component has an eigenvalue zero, which is not counted as positive.
    """
    largest = spectrum.eigenvalues[-1]
    positive = spectrum.eigenvalues > 1e-6 * largest
    return jnp.min(jnp.where(positive, spectrum.eigenvalues, largest)), largest
