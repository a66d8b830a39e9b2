"""The functional map's formulas against the sums over scales and vertices that they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import random_spectrum

from jaxsmw.core.filters import Meyer, frame_function
from jaxsmw.core.functional_map import (
    dual_eigenvectors,
    encode,
    multiscale_kernel,
    wavelet_energy,
)

M, N, K_X, K_Y = 60, 50, 12, 9


@pytest.fixture
def pair():
    return random_spectrum(M, K_X, seed=1), random_spectrum(N, K_Y, seed=2)


@pytest.fixture
def pointwise_map():
    return jnp.asarray(np.random.default_rng(3).integers(0, N, M))


def responses(spectrum, *, tight=True):
    bank = Meyer(4)(spectrum.eigenvalues, spectrum.eigenvalues[-1])
    return bank if tight else bank * jnp.asarray([[1.0], [0.4], [2.0], [1.3]])


def permutation_matrix(pointwise_map):
    return np.eye(N)[np.asarray(pointwise_map)]


@pytest.mark.parametrize("pseudo_inverse", ["area", "least_squares"])
def test_encode_is_the_matrix_product(pair, pointwise_map, pseudo_inverse):
    x, y = pair
    p = permutation_matrix(pointwise_map)
    if pseudo_inverse == "area":
        inverse_x, inverse_y = (s.eigenvectors.T * s.vertex_areas[None] for s in pair)
    else:
        inverse_x, inverse_y = (np.linalg.pinv(s.eigenvectors) for s in pair)
    pullback = encode(pointwise_map, x, y, pseudo_inverse=pseudo_inverse)
    np.testing.assert_allclose(pullback, inverse_x @ p @ y.eigenvectors, atol=1e-12)
    pushforward = encode(pointwise_map, x, y, convention="pushforward", pseudo_inverse=pseudo_inverse)
    np.testing.assert_allclose(pushforward, inverse_y @ p.T @ x.eigenvectors, atol=1e-12)


@pytest.mark.parametrize("pseudo_inverse", ["area", "least_squares"])
def test_dual_eigenvectors_invert(pair, pseudo_inverse):
    for spectrum in pair:
        dual = dual_eigenvectors(spectrum, pseudo_inverse)
        np.testing.assert_allclose(dual.T @ spectrum.eigenvectors, np.eye(dual.shape[1]), atol=1e-12)


def test_kernel_is_the_sum_over_scales(pair):
    x, y = pair
    c = np.random.default_rng(0).normal(size=(K_X, K_Y))
    g_x, g_y = responses(x), responses(y)
    over_scales = sum(np.diag(a) @ c @ np.diag(b) for a, b in zip(g_x, g_y, strict=True))
    np.testing.assert_allclose(c * multiscale_kernel(g_x, g_y), over_scales, atol=1e-14)


@pytest.mark.parametrize("convention", ["pullback", "pushforward"])
@pytest.mark.parametrize("tight", [True, False])
def test_energy_is_the_sum_over_scales_and_vertices(pair, pointwise_map, convention, tight):
    x, y = pair
    g_x, g_y = responses(x, tight=tight), responses(y, tight=tight)
    t = np.asarray(pointwise_map)
    areas_x, areas_y = np.asarray(x.vertex_areas), np.asarray(y.vertex_areas)
    if convention == "pullback":
        fed, returned, g_in, g_out = y.eigenvectors[t], x.eigenvectors, g_y, g_x
    else:
        # Columns of Phi_X^+ and of Phi_Y^+ P^T, each divided by the square root of the vertex area.
        fed = x.eigenvectors
        returned = (areas_y[:, None] * y.eigenvectors)[t] / areas_x[:, None]
        g_in, g_out = g_x, g_y
    c = np.random.default_rng(0).normal(size=(g_out.shape[1], g_in.shape[1]))
    brute = 0.0
    for a, b in zip(g_in, g_out, strict=True):
        for vertex in range(M):
            mismatch = c @ (a * fed[vertex]) - b * returned[vertex]
            brute += areas_x[vertex] * np.sum(mismatch**2)
    energy = wavelet_energy(jnp.asarray(c), pointwise_map, x, y, g_x, g_y, convention=convention)
    np.testing.assert_allclose(energy, brute, rtol=1e-12)


def test_tight_update_minimises_the_energy_where_the_fed_vectors_are_orthonormal(pair, pointwise_map):
    """Remark 4.1: in the pushforward convention for any T, as Phi_X is orthonormal and the frame Parseval."""
    x, y = pair
    g_x, g_y = responses(x), responses(y)
    update = encode(pointwise_map, x, y, convention="pushforward") * multiscale_kernel(g_y, g_x)
    slope = jax.grad(lambda c: wavelet_energy(c, pointwise_map, x, y, g_x, g_y, convention="pushforward"))(
        update
    )
    np.testing.assert_allclose(slope, 0, atol=1e-12)
    # For a permuted copy of one shape the pullback is such a case too.
    order = jnp.asarray(np.random.default_rng(5).permutation(M))
    copy = x.sample(order)
    copy = type(copy)(copy.eigenvalues, copy.eigenvectors, x.vertex_areas[order], copy.mask)
    inverse = jnp.argsort(order)
    update = encode(inverse, x, copy) * multiscale_kernel(g_x, g_x)
    slope = jax.grad(lambda c: wavelet_energy(c, inverse, x, copy, g_x, g_x))(update)
    np.testing.assert_allclose(slope, 0, atol=1e-12)
    # There the energy is what is left of k_X: the wavelets of a copy are preserved exactly.
    identity = jnp.eye(K_X)
    np.testing.assert_allclose(wavelet_energy(identity, inverse, x, copy, g_x, g_x), 0, atol=1e-12)


def test_energy_of_the_zero_map(pair, pointwise_map):
    x, y = pair
    g_x, g_y = responses(x), responses(y)
    energy = wavelet_energy(jnp.zeros((K_X, K_Y)), pointwise_map, x, y, g_x, g_y)
    np.testing.assert_allclose(energy, jnp.sum(frame_function(g_x)), rtol=1e-12)
    np.testing.assert_allclose(energy, K_X, rtol=1e-12)
