"""Coherent Point Drift agrees with a dense NumPy implementation and recovers known matches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from jaxsmw import decode, encode
from jaxsmw.benchmark.opponents.cpd import (
    DriftRecovery,
    coherent_point_drift,
    kernel_factor,
    recover_by_drift,
)
from jaxsmw.core.refiner import Problem
from jaxsmw.core.spectrum import Spectrum

pytestmark = pytest.mark.study


def dense_drift(x, y, iterations, width=2.0, stiffness=3.0, outliers=0.1):
    """Run the algorithm in Fig. 4 of the paper by Myronenko and Song, with dense matrices."""
    (m, d), n = x.shape, len(y)
    mean, (x, y) = x.mean(0), (p - p.mean(0) for p in (x, y))
    scale, (x, y) = np.sqrt((x**2).sum() / m), (p / np.sqrt((p**2).sum() / len(p)) for p in (x, y))
    gram, moved = np.exp(-cdist(y, y, "sqeuclidean") / (2 * width**2)), y
    variance = cdist(x, y, "sqeuclidean").sum() / (d * m * n)
    for _ in range(iterations):
        likelihoods = np.exp(-cdist(moved, x, "sqeuclidean") / (2 * variance))
        noise = (2 * np.pi * variance) ** (d / 2) * outliers / (1 - outliers) * n / m
        p = likelihoods / (likelihoods.sum(0) + noise)
        weights = p.sum(1)
        system = weights[:, None] * gram + stiffness * variance * np.eye(n)
        moved = y + gram @ np.linalg.solve(system, p @ x - weights[:, None] * y)
        variance = (p * cdist(moved, x, "sqeuclidean")).sum() / (d * weights.sum())
    return mean + scale * moved, variance


# The tests share these sizes and ranks, because JAX compiles the program anew for each size, rank or dtype.
M, N, RANK, LOW_RANK = 140, 150, 150, 40
ORDER = np.random.default_rng(1).permutation(N)[:M]


def deformed(d=3, noise=0.0, seed=0):
    """Return data (M, d) and centroids (N, d).

    The data are M of the N centroids after a smooth deformation, a scaling and a translation.
    """
    generator = np.random.default_rng(seed)
    y = generator.uniform(-1, 1, size=(N, d))
    x = 3 * (y + 0.3 * np.sin(2 * y[:, ::-1]))[ORDER] + 2
    return x + noise * generator.normal(size=x.shape), y


@pytest.mark.parametrize(
    "settings", [{}, {"width": 1.0}, {"stiffness": 0.5}, {"outliers": 0.5}, {"outliers": 0.0}]
)
def test_equals_the_dense_method(settings):
    x, y = deformed(noise=0.2)
    plain, _ = dense_drift(x, y, 8)
    moved, variance = dense_drift(x, y, 8, **settings)
    drift = coherent_point_drift(
        jnp.asarray(x), jnp.asarray(y), rank=RANK, iterations=8, tolerance=0.0, **settings
    )
    assert drift.iterations == 8
    np.testing.assert_allclose(drift.centroids, moved, rtol=0, atol=1e-8)
    np.testing.assert_allclose(drift.variance, variance, rtol=1e-8)
    assert not settings or np.abs(moved - plain).max() > 1e-4


def test_low_rank_is_close_to_the_dense_method():
    x, y = deformed(noise=0.2)
    exact, _ = dense_drift(x, y, 8)
    drift = coherent_point_drift(jnp.asarray(x), jnp.asarray(y), rank=LOW_RANK, iterations=8, tolerance=0.0)
    error = np.abs(drift.centroids - exact).max() / np.abs(exact - (3 * y + 2)).max()
    assert 1e-9 < error < 0.01


def test_float32_in_many_dimensions_does_not_underflow():
    """For large d, likelihoods near exp(-d/2) underflow in float32. The noise term underflows in float64 too."""
    x, y = deformed(d=300, noise=0.5)
    exact, variance = dense_drift(x, y, 4, stiffness=1e3)
    scale = np.sqrt(((x - x.mean(0)) ** 2).sum() / M)
    likelihoods = -cdist(x, exact, "sqeuclidean").min(1) / (2 * variance * scale**2)
    assert likelihoods.max() < np.log(1e-46) and 150 * np.log(2 * np.pi * variance) < np.log(1e-300)
    points = jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)
    drift = coherent_point_drift(*points, rank=RANK, iterations=4, tolerance=0.0, stiffness=1e3)
    assert drift.centroids.dtype == jnp.float32
    assert np.sqrt(np.mean((np.asarray(drift.centroids) - exact) ** 2)) < 1e-3
    np.testing.assert_allclose(drift.variance, variance, rtol=1e-3)


def test_kernel_factor_of_full_rank_is_exact():
    y = jnp.asarray(np.random.default_rng(0).normal(size=(60, 4)))
    mask = jnp.arange(60) % 3 > 0
    gram = np.exp(-cdist(y, y, "sqeuclidean") / 2) * np.outer(mask, mask)
    rough, factor = (kernel_factor(y, mask, width=1.0, rank=rank) for rank in (20, 60))
    assert 1e-6 < np.abs(rough @ rough.T - gram).mean() < 0.1
    assert np.abs(factor @ factor.T - gram).max() < 1e-13
    assert (np.asarray(factor)[~np.asarray(mask)] == 0).all()
    assert (np.asarray(factor)[:, 40:] == 0).all()


def test_a_known_displacement_is_recovered():
    """The deformation is so large that a nearest-neighbour search would fail."""
    x, y = deformed()
    drift = coherent_point_drift(jnp.asarray(x), jnp.asarray(y), rank=RANK)
    assert drift.iterations < 150
    nearest, drifted = (cdist(x, centroids).argmin(1) == ORDER for centroids in (3 * y + 2, drift.centroids))
    assert nearest.mean() < 0.4 and drifted.all()
    displacement = np.abs(x - (3 * y + 2)[ORDER]).mean()
    assert np.abs(x - np.asarray(drift.centroids)[ORDER]).mean() < 0.05 * displacement


def test_iterations_and_tolerance_stop_the_drift():
    x, y = (jnp.asarray(points) for points in deformed())
    assert coherent_point_drift(x, y, iterations=3, rank=RANK).iterations == 3
    loose, tight = (coherent_point_drift(x, y, tolerance=t, rank=RANK).iterations for t in (1e-2, 1e-5))
    assert 1 < loose < tight < 150


@pytest.mark.parametrize(
    "wrong", [{"width": 0.0}, {"stiffness": -1.0}, {"outliers": 1.0}, {"rank": 0}, {"iterations": 0}]
)
def test_numbers_out_of_range_raise(wrong):
    x, y = (jnp.asarray(points) for points in deformed())
    with pytest.raises(ValueError, match="needs a positive"):
        coherent_point_drift(x, y, **wrong)


@pytest.fixture(scope="module")
def pair() -> tuple[jax.Array, Spectrum, Spectrum]:
    """Two spectra that no functional map aligns, because the embedding of X is a deformed embedding of Y."""
    x, y = (
        Spectrum(jnp.arange(3.0), jnp.asarray(points), jnp.full(n, 1 / n), jnp.ones(n, bool))
        for points, n in zip(deformed(), (M, N), strict=True)
    )
    return jnp.eye(3), dataclasses.replace(x, eigenvectors=(x.eigenvectors - 2) / 3), y


def flip(spectrum: Spectrum, signs) -> Spectrum:
    return dataclasses.replace(spectrum, eigenvectors=spectrum.eigenvectors * signs[None, :])


def test_recovery_succeeds_where_nearest_neighbours_fail(pair):
    assert np.mean(np.asarray(decode(*pair)) == ORDER) < 0.4
    np.testing.assert_array_equal(recover_by_drift(*pair, rank=RANK), ORDER)


def test_signs_of_eigenvectors_have_no_effect(pair):
    functional_map, x, y = pair
    generator = np.random.default_rng(0)
    signs_x, signs_y = (jnp.asarray(generator.permutation([-1.0, -1.0, 1.0])) for _ in range(2))
    flipped = functional_map * signs_x[:, None] * signs_y[None, :]
    np.testing.assert_array_equal(
        recover_by_drift(flipped, flip(x, signs_x), flip(y, signs_y), rank=RANK),
        recover_by_drift(functional_map, x, y, rank=RANK),
    )


def test_padding_has_no_effect(pair):
    functional_map, x, y = pair
    padded = recover_by_drift(functional_map, x.pad(210), y.pad(200), rank=RANK)
    np.testing.assert_array_equal(padded[:M], ORDER)
    assert (padded < N).all()


def test_masked_points_have_no_effect_at_the_start_or_at_the_end():
    x, y = (jnp.asarray(points) for points in deformed(noise=0.2))
    masked = coherent_point_drift(
        jnp.pad(x, ((0, 70), (0, 0)), constant_values=9.0),
        jnp.pad(y, ((50, 0), (0, 0)), constant_values=9.0),
        data_mask=jnp.arange(210) < M,
        centroids_mask=jnp.arange(200) >= 50,
        rank=RANK,
        iterations=8,
    )
    alone = coherent_point_drift(x, y, rank=RANK, iterations=8)
    np.testing.assert_allclose(masked.centroids[50:], alone.centroids, rtol=0, atol=1e-8)


def test_refiner_recovers_by_drift(pair):
    """`DriftRecovery` computes functional maps by least squares, and pointwise maps by drift."""
    _, x, y = pair
    refiner = DriftRecovery(rank=LOW_RANK, drift_iterations=4)
    prepared = refiner.prepare(Problem(x, y))
    initial_map = jnp.asarray(np.where(np.arange(M) % 3 > 0, ORDER, 0), jnp.int32)
    state, _ = refiner.update(prepared, initial_map, None)
    functional_map = state.functional_map
    np.testing.assert_allclose(functional_map, encode(initial_map, x, y), atol=1e-12)
    found = refiner.recover(prepared, state)
    drifted = recover_by_drift(functional_map, x, y, rank=LOW_RANK, iterations=4)
    np.testing.assert_array_equal(found, drifted)
    assert np.any(found != decode(functional_map, x, y))
    assert np.any(found != recover_by_drift(functional_map, x, y, rank=LOW_RANK, iterations=1))
    with pytest.raises(ValueError, match="pullback"):
        DriftRecovery(convention="pushforward")


def test_the_drift_stores_no_dense_matrix():
    """A dense 50 000 x 50 000 matrix in float32 takes 10 GB. The program needs less than 0.5 GB."""
    points = jax.ShapeDtypeStruct((50_000, 30), jnp.float32)
    compiled = jax.jit(lambda x, y: coherent_point_drift(x, y, rank=100)).lower(points, points).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 500e6
