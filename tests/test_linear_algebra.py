"""Factorisations under `jit`, `vmap` and `grad`, and the refinement of batches of pairs on CPUs."""

import os
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
import pytest
from sampled_cases import first_always
from synthetic import random_spectrum, to_namespace

from jaxsmw.core import linear_algebra
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.soft_refinement import refine_softly
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares, NearestOrthogonal
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.runtime.batches import stack

BATCH = 4
SOLUTIONS = {
    "filtering": Filtering(),
    "least squares": LeastSquares(),
    "regularized": RegularizedLeastSquares(),
    "nearest orthogonal": NearestOrthogonal(LeastSquares()),
}
REFINERS = {name: WaveletPreservation(solution=solution) for name, solution in SOLUTIONS.items()}
REFINERS |= {"regression": FeatureRegression(), "registration": Registration()}


def batch_of_pairs(vertices, eigenvectors, dtype=np.float32):
    """Four pairs of shapes with positions and normals, as arrays with a leading axis, and their maps."""
    spectra = []
    for seed in range(2 * BATCH):
        points = np.random.default_rng(seed).normal(size=(vertices, 3)).astype(dtype)
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        spectrum = random_spectrum(vertices, eigenvectors, seed=seed, dtype=dtype)
        spectra.append(spectrum.with_positions(jnp.asarray(points), jnp.asarray(normals)))
    maps = np.random.default_rng(0).integers(0, vertices, (BATCH, vertices))
    return stack(spectra[:BATCH]), stack(spectra[BATCH:]), jnp.asarray(maps)


def refine_batch(name, vertices, eigenvectors):
    """Refine a batch of pairs, which must not wait for ever, and print that the maps are those of a loop."""
    x, y, maps = batch_of_pairs(vertices, eigenvectors)

    def run(x, y, t):
        return refine(x, y, t, refiner=REFINERS[name])

    for _ in range(3):
        batch = jax.block_until_ready(jax.vmap(run)(x, y, maps))
    loop = jax.lax.map(lambda pair: run(*pair), (x, y, maps))
    assert (batch.result == RESULTS.successful).all() and (loop.result == RESULTS.successful).all()
    assert np.mean(batch.pointwise_map == loop.pointwise_map) > 0.99
    print("refined")


@pytest.mark.slow
@pytest.mark.parametrize("name", first_always(sorted(REFINERS, key=lambda name: name != "regression")))
def test_a_batch_of_pairs_does_not_wait_for_ever(name):
    """Without a loop around LAPACK, the batch of `FeatureRegression` waits for ever (jaxlib 0.10)."""
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here.parent), str(here), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, __file__, name],
        env=os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": ""},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.stdout.strip() == "refined", done.stderr


def lapack_calls(function, *arguments):
    """The numbers of batch dimensions of all calls of LAPACK in a program for CPUs."""
    text = jax.jit(function).lower(*arguments).as_text()
    return re.findall(r'@lapack_.*num_batch_dims = "(\d+)"', text)


@pytest.mark.parametrize("name", first_always(sorted(REFINERS, key=lambda name: name != "registration")))
def test_batches_of_pairs_call_lapack_matrix_by_matrix(name):
    x, y, maps = batch_of_pairs(40, 6)
    samples = jnp.arange(0, 40, 2), jnp.arange(1, 40, 2)

    def run(x, y, t, partial=False):
        refiner = REFINERS[name]
        return refine(x, y, t, refiner=refiner, samples=samples, partial=partial, history=True)

    calls = lapack_calls(jax.vmap(run), x, y, maps)
    calls += lapack_calls(jax.vmap(jax.vmap(run)), *jax.tree.map(lambda leaf: leaf[None], (x, y, maps)))
    if name == "registration":
        calls += lapack_calls(jax.vmap(lambda *pair: run(*pair, partial=True)), x, y, maps)
    assert calls and set(calls) == {"0"}


@pytest.mark.parametrize(
    "name", first_always(["least squares", "nearest orthogonal", "filtering", "regularized"], always=2)
)
def test_derivatives_of_batches_call_lapack_matrix_by_matrix(name):
    x, y, maps = batch_of_pairs(40, 6)
    refiner = WaveletPreservation(solution=SOLUTIONS[name])

    def loss(eigenvectors, x, y, t):
        moved = eqx.tree_at(lambda s: s.eigenvectors, x, eigenvectors)
        return jnp.sum(refine_softly(moved, y, t, refiner=refiner, iterations=2).functional_map ** 2)

    def total(eigenvectors, x, y, t):
        return jnp.sum(jax.vmap(loss)(eigenvectors, x, y, t))

    arguments = x.eigenvectors, x, y, maps
    calls = lapack_calls(jax.vmap(jax.grad(loss)), *arguments) + lapack_calls(jax.grad(total), *arguments)
    assert set(calls) <= {"0"} and bool(calls) == (name != "filtering")


def symmetric(function):
    return lambda matrix, *right: function((matrix + matrix.T) / 2, *right)


def polar_factor(matrix):
    left, _, right = jnp.linalg.svd(matrix, full_matrices=False)
    return left @ right


FACTORISATIONS = {
    "cholesky": (linear_algebra.cholesky, jnp.linalg.cholesky, (6, 6), None),
    "triangular": (
        linear_algebra.solve_lower,
        lambda factor, right: jsp.linalg.solve_triangular(factor, right, lower=True),
        (6, 6),
        (6, 3),
    ),
    "positive definite": (
        symmetric(linear_algebra.solve_positive_definite),
        symmetric(lambda matrix, right: jsp.linalg.solve(matrix, right, assume_a="pos")),
        (6, 6),
        (6, 3),
    ),
    "eigenvalues": (
        symmetric(linear_algebra.symmetric_eigenvalues),
        symmetric(jnp.linalg.eigvalsh),
        (6, 6),
        None,
    ),
    "tall": (linear_algebra.nearest_orthogonal, polar_factor, (7, 4), None),
    "wide": (linear_algebra.nearest_orthogonal, polar_factor, (4, 7), None),
    "square": (linear_algebra.nearest_orthogonal, polar_factor, (5, 5), None),
}


@pytest.mark.parametrize("name", first_always(FACTORISATIONS, always=4))
def test_factorisations_and_their_derivatives_equal_those_of_jax(name):
    function, expected, shape, right_shape = FACTORISATIONS[name]
    generator = np.random.default_rng(0)
    matrices = jnp.asarray(generator.normal(size=(BATCH, *shape)))
    if name not in ("tall", "wide", "square"):
        matrices = matrices @ matrices.mT + jnp.eye(shape[0])[None]
    arguments = (matrices,)
    if right_shape is not None:
        arguments = (matrices, jnp.asarray(generator.normal(size=(BATCH, *right_shape))))

    def loss(f):
        return lambda *arguments: jnp.sum(jnp.sin(f(*arguments)))

    def total(f):
        return lambda *batch: jnp.sum(jax.vmap(loss(f))(*batch))

    for transform in (
        jax.vmap,
        lambda f: lambda *batch: jax.vmap(jax.vmap(f))(*(part[None] for part in batch)),
        lambda f: jax.vmap(jax.grad(loss(f))),
        lambda f: jax.grad(total(f)),
        lambda f: jax.vmap(jax.jacfwd(loss(f))),
        *([] if name == "eigenvalues" else [lambda f: jax.vmap(jax.hessian(loss(f)))]),
    ):
        found, reference = (jax.jit(transform(f))(*arguments) for f in (function, expected))
        np.testing.assert_allclose(found, reference, rtol=1e-9, atol=1e-11)
        assert set(lapack_calls(transform(function), *arguments)) == {"0"}


def inputs(name, dtype):
    """A matrix that a factorisation accepts, and a right side if it needs one."""
    _, _, shape, right_shape = FACTORISATIONS[name]
    generator = np.random.default_rng(0)
    matrix = generator.normal(size=shape)
    if name not in ("tall", "wide", "square"):
        matrix = matrix @ matrix.T + np.eye(shape[0])
    if name == "triangular":
        matrix = np.tril(matrix)
    right = () if right_shape is None else (generator.normal(size=right_shape),)
    return [array.astype(dtype) for array in (matrix, *right)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", FACTORISATIONS)
def test_factorisations_of_numpy_equal_those_of_jax(name, dtype):
    function, arrays = FACTORISATIONS[name][0], inputs(name, dtype)
    before = [array.copy() for array in arrays]
    found, expected = (function(*to_namespace(arrays, namespace)) for namespace in ("numpy", "jax"))
    assert isinstance(found, np.ndarray) and found.dtype == expected.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=2e-5 if dtype == np.float32 else 1e-12)
    np.testing.assert_array_equal(np.concatenate(arrays, axis=1), np.concatenate(before, axis=1))


@pytest.mark.parametrize("name", FACTORISATIONS)
def test_factorisations_of_nan_are_nan(name, namespace):
    matrix, *right = inputs(name, np.float64)
    found = FACTORISATIONS[name][0](*to_namespace((np.full_like(matrix, np.nan), *right), namespace))
    assert found.shape == FACTORISATIONS[name][1](matrix, *right).shape
    entries = np.tril(np.ones_like(found, bool)) if name == "cholesky" else np.ones_like(found, bool)
    assert np.isnan(np.asarray(found)[entries]).all()


@pytest.mark.parametrize("diagonal", [[1.0, -1.0, 2.0], [0.0, 0.0, 0.0]], ids=str)
def test_matrices_that_are_not_positive_definite_are_no_exception(diagonal, namespace):
    matrix, right = to_namespace((np.diag(diagonal), np.ones((3, 2))), namespace)
    assert not np.isfinite(linear_algebra.cholesky(matrix)).all()
    assert not np.isfinite(linear_algebra.solve_positive_definite(matrix, right)).all()
    assert not linear_algebra.is_regular(matrix)
    assert np.isfinite(linear_algebra.solve_lower(matrix, right)).all() == (diagonal[0] != 0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_singular_matrices_are_regularized_alike(dtype, namespace):
    vectors = np.random.default_rng(0).normal(size=(5, 4))
    vectors[:, 3] = vectors[:, 0]
    singular = to_namespace((vectors.T @ vectors).astype(dtype), namespace)
    assert not linear_algebra.is_regular(singular)
    regular = linear_algebra.regularized(singular)
    assert regular.dtype == dtype
    error = 4 * np.finfo(dtype).eps * np.asarray(singular).diagonal().max()
    np.testing.assert_allclose(regular - singular, error * np.eye(4), rtol=0.1, atol=0.1 * error)
    fine = singular + np.eye(4, dtype=dtype)
    assert linear_algebra.is_regular(fine)
    np.testing.assert_array_equal(linear_algebra.regularized(fine), fine)


if __name__ == "__main__":
    refine_batch(sys.argv[1], 1500, 60)
