"""Spectral signatures: what a vertex looks like to heat, to waves and to wavelets.

All three are `f_t(x) = sum_i w_t(lambda_i) phi_i(x)^2 / sum_i w_t(lambda_i)` with weights that pass some band
of eigenvalues; on a surface of area 1 each dimension has the area-weighted mean 1. They are invariant to
eigenvector signs, and blind to the difference of left and right.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks import Meyer
from jaxsmw.core.products import product
from jaxsmw.core.spectrum import Spectrum


def heat_kernel_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Heat kernel signature at log-spaced times (Sun, Ovsjanikov, Guibas 2009).

    Times run from `4 ln 10 / lambda_max` to `4 ln 10 / lambda_min`, lambda_min the smallest positive
    eigenvalue. NaN where none is positive.
    """
    smallest, largest = _positive_range(spectrum)
    times = 4 * jnp.log(10.0) / jnp.geomspace(largest, smallest, dimensions)
    return _signature(spectrum, jnp.exp(-times[:, None] * spectrum.eigenvalues[None, :]))


def wave_kernel_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Wave kernel signature at evenly spaced logarithmic energies (Aubry, Schlickewei, Cremers 2011).

    Gaussians of width 7 steps, centred from `log lambda_min + 2 width` to `log lambda_max - 2 width`.
    """
    smallest, largest = _positive_range(spectrum)
    low, high = jnp.log(smallest), jnp.log(largest)
    # The centres keep 2 widths of 7 steps away from both ends: 28 steps more than between them.
    width = 7 * (high - low) / (dimensions - 1 + 28)
    energies = jnp.linspace(low + 2 * width, high - 2 * width, dimensions)
    positive = spectrum.eigenvalues >= smallest
    log_eigenvalues = jnp.log(jnp.where(positive, spectrum.eigenvalues, smallest))
    weights = jnp.exp(-((energies[:, None] - log_eigenvalues[None, :]) ** 2) / (2 * width**2))
    return _signature(spectrum, jnp.where(positive[None, :], weights, 0))


def wavelet_signature(spectrum: Spectrum, *, dimensions: int = 100) -> Float[Array, "n dimensions"]:
    """Squared norms of the Meyer wavelets centred at each vertex, at log-spaced scales.

    A spectral-wavelet signature in the sense of Li and Ben Hamza 2013, with the band-pass kernel of the
    MWP paper's frame in place of theirs. It passes `peak / 2` to `2 peak`, with peaks from lambda_min to
    `lambda_max / 2`.
    """
    smallest, largest = _positive_range(spectrum)
    peaks = jnp.geomspace(smallest, largest / 2, dimensions)
    # Of three Meyer filters on [0, 2 peak] the middle one is that band.
    wavelets = jax.vmap(lambda peak: Meyer(3)(spectrum.eigenvalues, 2 * peak[None])[1])(peaks)
    return _signature(spectrum, wavelets**2)


def _signature(spectrum: Spectrum, weights: Float[Array, "dimensions k"]) -> Float[Array, "n dimensions"]:
    return product(spectrum.eigenvectors**2, (weights / jnp.sum(weights, axis=1, keepdims=True)).T)


def _positive_range(spectrum: Spectrum) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The smallest positive and the largest eigenvalue; each component has one that is zero."""
    largest = spectrum.eigenvalues[-1]
    positive = spectrum.eigenvalues > 1e-6 * largest
    return jnp.min(jnp.where(positive, spectrum.eigenvalues, largest)), largest
