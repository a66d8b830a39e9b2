"""The formulas of functional maps agree with explicit sums over scales and vertices."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import random_spectrum, to_namespace

from jaxsmw.core.arrays import replaced
from jaxsmw.core.banks import Meyer, frame_function
from jaxsmw.core.functional_map import (
    QuadraticEnergy,
    WaveletProblem,
    dual_eigenvectors,
    encode,
    multiscale_kernel,
)
from jaxsmw.core.spectrum import Spectrum

M, N, K_X, K_Y = 60, 50, 12, 9


@pytest.fixture
def pair(namespace):
    return to_namespace((random_spectrum(M, K_X, seed=1), random_spectrum(N, K_Y, seed=2)), namespace)


@pytest.fixture
def pointwise_map(namespace):
    return to_namespace(np.random.default_rng(3).integers(0, N, M), namespace)


def responses(spectrum, *, tight=True):
    bank = Meyer(4)(spectrum.eigenvalues, spectrum.eigenvalues)
    return bank if tight else bank * np.asarray([[1.0], [0.4], [2.0], [1.3]])


def permutation_matrix(pointwise_map):
    return np.eye(N)[np.asarray(pointwise_map)]


@pytest.mark.parametrize("pseudo_inverse", ["area", "least_squares"])
def test_encode_equals_the_matrix_product(pair, pointwise_map, pseudo_inverse):
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


def test_an_eigenvector_that_vanishes_at_all_samples_leaves_the_others_unchanged(namespace):
    """On a scan with slivers, an eigenvector can live on a strip of surface that contains no sample."""
    spectrum = to_namespace(random_spectrum(M, K_X, seed=4), namespace)
    others = np.delete(np.arange(K_X), 5)
    lacking = replace(spectrum, eigenvectors=replaced(spectrum.eigenvectors, (slice(None), 5), 0))
    without = replace(
        spectrum, eigenvalues=spectrum.eigenvalues[others], eigenvectors=spectrum.eigenvectors[:, others]
    )
    dual = dual_eigenvectors(lacking, "least_squares")
    np.testing.assert_array_equal(dual[:, 5], 0)
    expected = dual_eigenvectors(without, "least_squares")
    np.testing.assert_allclose(dual[:, others], expected, rtol=1e-10, atol=1e-12)
    # Fewer samples than eigenvectors remain an error, which refinement reports.
    few = lacking.sample(to_namespace(np.arange(K_X - 1), namespace))
    assert not np.isfinite(dual_eigenvectors(few, "least_squares")).all()


def test_kernel_is_the_sum_over_scales(pair):
    x, y = pair
    c = np.random.default_rng(0).normal(size=(K_X, K_Y))
    g_x, g_y = responses(x), responses(y)
    over_scales = sum(np.diag(a) @ c @ np.diag(b) for a, b in zip(g_x, g_y, strict=True))
    np.testing.assert_allclose(c * multiscale_kernel(g_x, g_y), over_scales, atol=1e-14)


def stacked(pair, pointwise_map, convention, norm):
    """Returns the inputs, outputs and weights of all vertices of X, which define the energy."""
    x, y = pair
    p = permutation_matrix(pointwise_map)
    areas_x = np.asarray(x.vertex_areas)
    if convention == "pullback":
        inputs, outputs = p @ y.eigenvectors, np.asarray(x.eigenvectors)
    else:  # columns of Phi_X^+ and of Phi_Y^+ P^T
        inputs = (np.asarray(x.eigenvectors).T * areas_x).T
        outputs = p @ (np.asarray(y.eigenvectors) * np.asarray(y.vertex_areas)[:, None])
    if norm == "frobenius":
        return inputs, outputs, np.ones(M)
    if convention == "pushforward":
        inputs, outputs = (columns / np.sqrt(areas_x)[:, None] for columns in (inputs, outputs))
        return inputs, outputs, np.ones(M)
    return inputs, outputs, areas_x


def tall_system(pair, pointwise_map, g_x, g_y, convention, norm):
    """Returns both sides of the linear system with one row for each scale and vertex."""
    inputs, outputs, weights = stacked(pair, pointwise_map, convention, norm)
    g_in, g_out = (g_y, g_x) if convention == "pullback" else (g_x, g_y)
    root = np.sqrt(weights)[:, None]
    left = np.concatenate([root * inputs * np.asarray(g)[None] for g in g_in])
    right = np.concatenate([root * outputs * np.asarray(g)[None] for g in g_out])
    return left, right


CASES = [
    (convention, norm, tight)
    for convention in ("pullback", "pushforward")
    for norm in ("area", "frobenius")
    for tight in (True, False)
]


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}, {case[1]}, {'tight' if case[2] else 'general'}")
def case(request, pair, pointwise_map):
    convention, norm, tight = request.param
    g_x, g_y = (responses(spectrum, tight=tight) for spectrum in pair)
    energy = WaveletProblem(*pair, g_x, g_y, convention).energy(pointwise_map, norm=norm)
    return energy, tall_system(pair, pointwise_map, g_x, g_y, convention, norm)


def test_energy_is_the_sum_over_scales_and_vertices(case):
    energy, (left, right) = case
    c = np.random.default_rng(0).normal(size=energy.cross.shape)
    np.testing.assert_allclose(energy(c), np.sum((left @ c.T - right) ** 2), rtol=1e-12)


def test_minimizer_is_the_least_squares_solution_of_the_tall_system(case):
    energy, (left, right) = case
    brute, *_ = np.linalg.lstsq(left, right)
    np.testing.assert_allclose(energy.minimizer(), brute.T, atol=1e-9)
    singular_values = np.linalg.svd(left, compute_uv=False)
    condition = (singular_values[0] / singular_values[-1]) ** 2
    np.testing.assert_allclose(energy.condition_number(), condition, rtol=1e-8)


def test_no_map_has_less_energy_than_the_minimizer(case):
    energy, _ = case
    generator = np.random.default_rng(1)
    best = energy.minimizer()
    np.testing.assert_allclose(jax.grad(energy)(best), 0, atol=1e-9)
    for size in (1e-3, 1e-1, 1.0):
        assert energy(best + size * generator.normal(size=best.shape)) > energy(best)
    # Gradient descent from another map lowers the energy in every step, but not below the minimum.
    c = jnp.asarray(generator.normal(size=best.shape))
    step = 1 / jnp.linalg.eigvalsh(energy.gram)[-1]
    before = jnp.inf
    for _ in range(5):
        c = c - 0.3 * step * jax.grad(energy)(c)
        assert energy(best) < energy(c) < before
        before = energy(c)


def test_minimizer_agrees_with_closed_forms(pair, pointwise_map):
    x, y = pair
    g_x, g_y = (responses(spectrum, tight=False) for spectrum in pair)
    areas_x = np.asarray(x.vertex_areas)
    phi_x, phi_y = np.asarray(x.eigenvectors), np.asarray(y.eigenvectors)
    p = permutation_matrix(pointwise_map)
    inverse_x, inverse_y = (np.asarray(encode_inverse(s)) for s in pair)
    frame_x = np.asarray(frame_function(g_x))

    def solve(convention, norm):
        return WaveletProblem(x, y, g_x, g_y, convention).energy(pointwise_map, norm=norm).minimizer()

    k_yx = np.asarray(g_y).T @ np.asarray(g_x)
    expected = (inverse_y @ p.T @ phi_x * k_yx) / frame_x[None]
    np.testing.assert_allclose(solve("pushforward", "area"), expected, atol=1e-10)
    gram = inverse_x @ inverse_x.T * (np.asarray(g_x).T @ np.asarray(g_x))
    expected = np.linalg.solve(gram, (inverse_y @ p.T @ inverse_x.T * k_yx).T).T
    np.testing.assert_allclose(solve("pushforward", "frobenius"), expected, atol=1e-10)
    gram_y = np.asarray(g_y).T @ np.asarray(g_y)
    for norm, weights in (("area", areas_x), ("frobenius", np.ones(M))):
        gram = (phi_y.T @ p.T * weights) @ p @ phi_y * gram_y
        cross = (phi_x.T * weights) @ p @ phi_y * k_yx.T
        np.testing.assert_allclose(solve("pullback", norm), np.linalg.solve(gram, cross.T).T, atol=1e-10)


def encode_inverse(spectrum):
    return spectrum.eigenvectors.T * spectrum.vertex_areas[None]


def test_padding_changes_nothing(pair, pointwise_map, namespace):
    x, y = pair
    padded = Spectrum(
        x.eigenvalues,
        np.pad(x.eigenvectors, ((0, 7), (0, 0))),
        np.pad(x.vertex_areas, (0, 7)),
        np.pad(x.mask, (0, 7)),
    )
    g_x, g_y = (responses(spectrum, tight=False) for spectrum in pair)
    longer = np.pad(pointwise_map, (0, 7), constant_values=3)
    padded, longer = to_namespace((padded, longer), namespace)
    for convention in ("pullback", "pushforward"):
        for norm in ("area", "frobenius"):
            plain = WaveletProblem(x, y, g_x, g_y, convention).energy(pointwise_map, norm=norm)
            other = WaveletProblem(padded, y, g_x, g_y, convention).energy(longer, norm=norm)
            for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(other), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_energies_add_and_scale():
    generator = np.random.default_rng(0)

    def sum_of_squares(columns):
        a, b = generator.normal(size=(4, columns)), generator.normal(size=(3, columns))
        return QuadraticEnergy(jnp.asarray(a @ a.T), jnp.asarray(b @ a.T), jnp.asarray(np.sum(b**2)))

    first, second = sum_of_squares(9), sum_of_squares(5)
    c = jnp.asarray(generator.normal(size=(3, 4)))
    total = first + jnp.asarray(0.3) * second + QuadraticEnergy.zero(3, 4, jnp.float64)
    np.testing.assert_allclose(total(c), first(c) + 0.3 * second(c), rtol=1e-12)


def test_tight_update_minimises_the_energy_where_the_inputs_are_orthonormal(pair, pointwise_map):
    """Remark 4.1 of the MWP paper holds for any T in the pushforward convention."""
    x, y = pair
    g_x, g_y = responses(x), responses(y)
    update = encode(pointwise_map, x, y, convention="pushforward") * multiscale_kernel(g_y, g_x)
    energy = WaveletProblem(x, y, g_x, g_y, "pushforward").energy(pointwise_map)
    np.testing.assert_allclose(energy.minimizer(), update, atol=1e-12)
    np.testing.assert_allclose(energy.condition_number(), 1, atol=1e-12)
    # In the pullback convention, Remark 4.1 holds for a shape and a copy with permuted vertices.
    order = np.random.default_rng(5).permutation(M)
    copy = Spectrum(x.eigenvalues, x.eigenvectors[order], x.vertex_areas[order], x.mask)
    inverse = np.argsort(order)
    update = encode(inverse, x, copy) * multiscale_kernel(g_x, g_x)
    energy = WaveletProblem(x, copy, g_x, g_x).energy(inverse)
    np.testing.assert_allclose(energy.minimizer(), update, atol=1e-12)
    # The identity has zero energy for this copy, because it preserves all wavelets exactly.
    np.testing.assert_allclose(energy(np.eye(K_X)), 0, atol=1e-12)


def test_energy_of_the_zero_map_is_the_sum_of_the_frame_function(pair, pointwise_map):
    x, y = pair
    g_x, g_y = responses(x), responses(y)
    energy = WaveletProblem(x, y, g_x, g_y).energy(pointwise_map)(np.zeros((K_X, K_Y)))
    np.testing.assert_allclose(energy, np.sum(frame_function(g_x)), rtol=1e-12)
    np.testing.assert_allclose(energy, K_X, rtol=1e-12)
