import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import random_spectrum, sphere_mesh, to_namespace

from jaxsmw.core.arrays import replaced
from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import make_mesh

SIGNATURES = [heat_kernel_signature, wave_kernel_signature, wavelet_signature]


@pytest.mark.parametrize("signature", SIGNATURES)
def test_mean_is_one_signs_do_not_matter_and_vertices_differ(signature, namespace):
    spectrum = to_namespace(random_spectrum(80, 30), namespace)
    values = signature(spectrum, dimensions=17)
    assert values.shape == (80, 17) and (values >= 0).all()
    np.testing.assert_allclose(spectrum.vertex_areas @ values, 1)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (1, 30))
    flipped = eqx.tree_at(lambda s: s.eigenvectors, spectrum, spectrum.eigenvectors * signs)
    np.testing.assert_allclose(signature(flipped, dimensions=17), values, rtol=1e-12)
    assert np.std(np.asarray(values), axis=0).min() > 0.01


@pytest.mark.parametrize("signature", SIGNATURES)
def test_scale_cancels_and_several_zero_eigenvalues_are_allowed(signature, namespace):
    spectrum = to_namespace(random_spectrum(80, 30), namespace)
    scaled = eqx.tree_at(lambda s: s.eigenvalues, spectrum, spectrum.eigenvalues * 100)
    np.testing.assert_allclose(signature(scaled), signature(spectrum), rtol=1e-9)
    twin = eqx.tree_at(lambda s: s.eigenvalues, spectrum, replaced(spectrum.eigenvalues, 1, 0))
    assert np.isfinite(signature(twin)).all()


@pytest.mark.parametrize("signature", SIGNATURES)
def test_signatures_of_a_sphere_are_nearly_constant(signature):
    spectrum = compute_spectrum(make_mesh(*sphere_mesh(4)), 36)
    values = np.asarray(signature(spectrum, dimensions=10))
    assert np.std(values, axis=0).max() < 0.06


@pytest.mark.parametrize("signature", SIGNATURES)
def test_signatures_can_be_compiled_and_differentiated(signature):
    spectrum = random_spectrum(40, 12)
    np.testing.assert_allclose(jax.jit(signature)(spectrum), signature(spectrum), rtol=1e-9)
    slope = jax.grad(lambda v: jnp.sum(signature(eqx.tree_at(lambda s: s.eigenvectors, spectrum, v)) ** 2))(
        spectrum.eigenvectors
    )
    assert np.isfinite(slope).all() and jnp.any(slope != 0)


def test_signatures_follow_their_definitions(namespace):
    spectrum = to_namespace(random_spectrum(30, 20), namespace)
    values, squares = np.asarray(spectrum.eigenvalues), np.asarray(spectrum.eigenvectors) ** 2
    times = np.geomspace(4 * np.log(10) / values[-1], 4 * np.log(10) / values[1], 8)
    weights = np.exp(-times[:, None] * values)
    np.testing.assert_allclose(
        heat_kernel_signature(spectrum, dimensions=8), squares @ (weights / weights.sum(1, keepdims=True)).T
    )
    low, high = np.log(values[1]), np.log(values[-1])
    # The centres of the Gaussians are at least two standard deviations (14 steps) from the ends of the range.
    step = (high - low) / (7 + 28)
    energies = low + 14 * step + np.arange(8) * step
    weights = np.exp(-((energies[:, None] - np.log(values[1:])) ** 2) / (2 * (7 * step) ** 2))
    np.testing.assert_allclose(
        wave_kernel_signature(spectrum, dimensions=8),
        squares[:, 1:] @ (weights / weights.sum(1, keepdims=True)).T,
    )
