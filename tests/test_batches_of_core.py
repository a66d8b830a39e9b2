"""Public functions of the core in batches, on several devices, for padded shapes, and under differentiation."""

import dataclasses
import inspect
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from sampled_cases import first_always
from synthetic import random_spectrum

import jaxsmw
from jaxsmw import (
    CubicSpline,
    FeatureRegression,
    Filtering,
    LeastSquares,
    Meyer,
    Registration,
    WaveletPreservation,
    banks,
    decode,
    encode,
    functional_maps,
    learning,
    refine,
    stack,
)
from jaxsmw.functional_maps import (
    DescriptorPair,
    NearestOrthogonal,
    RegularizedLeastSquares,
    decode_to_triangles,
    heat_kernel_signature,
    multiscale_kernel,
    nearest_neighbor,
    nearest_point_on_triangles,
    wave_kernel_signature,
    wavelet_signature,
)
from jaxsmw.learning import (
    NearestFew,
    Sinkhorn,
    Softmax,
    WaveletPreservationLayer,
    pull_back,
    refine_softly,
    sinkhorn,
)

BATCH, K = 4, 6
SIZES_X, SIZES_Y = (40, 46) * 2, (43, 39) * 2
SAMPLES = jnp.arange(0, 36, 2), jnp.arange(1, 37, 2)
FACES = jnp.asarray(np.random.default_rng(0).integers(0, 39, (50, 3)))


def shape(vertices, seed):
    generator = np.random.default_rng(seed)
    points = jnp.asarray(generator.normal(size=(vertices, 3)))
    normals = points / jnp.linalg.norm(points, axis=1, keepdims=True)
    spectrum = random_spectrum(vertices, K, seed=seed).with_positions(points, normals)
    return spectrum.with_descriptors(jnp.asarray(generator.normal(size=(vertices, 8))))


def make_pairs():
    """Pairs of shapes of different sizes, with a pointwise map and a functional map each."""
    generator = np.random.default_rng(1)
    return [
        (
            shape(m, seed),
            shape(n, seed + BATCH),
            jnp.asarray(generator.integers(0, n, m)),
            jnp.asarray(generator.normal(size=(K, K))),
        )
        for seed, (m, n) in enumerate(zip(SIZES_X, SIZES_Y, strict=True))
    ]


def make_batch(pairs):
    """The same pairs, padded to one size."""
    x, y, maps, functional = zip(*pairs, strict=True)
    padded = [jnp.pad(t, (0, max(SIZES_X) - len(t))) for t in maps]
    return stack(x), stack(y), jnp.stack(padded), jnp.stack(functional)


def refined(**settings):
    return lambda x, y, t, c: refine(x, y, t, **settings).functional_map


def softly(**settings):
    return lambda x, y, t, c: refine_softly(x, y, t, iterations=2, **settings).functional_map


def of_descriptors(**options):
    def solve(x, y, t, c):
        pair = DescriptorPair.project(x.descriptors, y.descriptors, x, y, operators=True)
        solution = RegularizedLeastSquares(
            wavelet_preservation=None, descriptor_preservation=1.0, descriptors=pair, **options
        )
        return solution.minimize(None, x.eigenvalues, y.eigenvalues)[0]

    return solve


def soft_map(recovery):
    return lambda x, y, t, c: recovery(x.positions, y.positions, x.vertex_areas, y.vertex_areas)


def problem(x, y):
    return WaveletPreservation(CubicSpline(4)).problem(x, y)


# Each case is a function of two spectra, a pointwise map and a functional map. These have derivatives with respect
# to the eigenvectors, the positions and the functional map.
DIFFERENTIABLE = {
    "descriptors and mask": of_descriptors(orthogonality=None, mask="resolvent"),
    "sinkhorn": lambda x, y, t, c: sinkhorn(x.positions, y.positions, query_areas=x.vertex_areas, database_areas=y.vertex_areas, iterations=5).pull_back(y.positions),
    "refine, least squares": refined(refiner=WaveletPreservation(solution=LeastSquares())),
    "refine_softly, sinkhorn": softly(recovery=Sinkhorn()),
    "refine": refined(),
    "refine, regularized": refined(refiner=WaveletPreservation(solution=RegularizedLeastSquares(tolerance=1e-10))),
    "refine, nearest orthogonal": refined(refiner=WaveletPreservation(solution=NearestOrthogonal(Filtering()))),
    "refine, regression": refined(refiner=FeatureRegression((3, 5)), iterations=4),
    "refine, registration": refined(refiner=Registration((3, 5)), iterations=4),
    "refine, samples": refined(samples=SAMPLES),
    "refine, partial": refined(refiner=FeatureRegression(), partial=True),
    "refine_softly, softmax": softly(recovery=Softmax()),
    "refine_softly, few": softly(recovery=NearestFew(4)),
    "refine_softly, implicit": lambda x, y, t, c: refine_softly(x, y, t, iterations=200, recovery=Softmax(3.0), differentiation="implicit", tolerance=1e-8).functional_map,
    "layer": lambda x, y, t, c: WaveletPreservationLayer(iterations=1)(x.eigenvectors, y.eigenvectors @ c, x, y).functional_map,
    "descriptors and orthogonality": of_descriptors(orthogonality=0.01, tolerance=1e-10),
    "descriptor commutativity": of_descriptors(orthogonality=None, descriptor_commutativity=0.1, tolerance=1e-10),
    "encode": lambda x, y, t, c: encode(t, x, y),
    "encode, least squares": lambda x, y, t, c: encode(t, x, y, pseudo_inverse="least_squares", convention="pushforward"),
    "energy": lambda x, y, t, c: problem(x, y).energy(t)(c),
    "minimizer": lambda x, y, t, c: problem(x, y).energy(t).minimizer(),
    "condition number": lambda x, y, t, c: problem(x, y).energy(t).condition_number(),
    "soft map": lambda x, y, t, c: pull_back(soft_map(Softmax())(x, y, t, c), y.positions),
    "sparse soft map": lambda x, y, t, c: pull_back(soft_map(NearestFew(3))(x, y, t, c), y.positions),
    "pull_back": lambda x, y, t, c: pull_back(t, y.positions),
    "heat kernel signature": lambda x, y, t, c: heat_kernel_signature(x, dimensions=5),
    "wave kernel signature": lambda x, y, t, c: wave_kernel_signature(x, dimensions=5),
    "wavelet signature": lambda x, y, t, c: wavelet_signature(x, dimensions=5),
    "projection": lambda x, y, t, c: DescriptorPair.project(x.descriptors, y.descriptors, x, y, operators=True),
    "kernel": lambda x, y, t, c: multiscale_kernel(c, c),
    "frames": lambda x, y, t, c: [banks.frame_function(banks.tighten(CubicSpline(4))(x.eigenvalues, x.eigenvalues) * c[:1]), banks.frame_bounds(Meyer(), x.eigenvalues).lower],
}  # fmt: skip
OTHERS = {
    "decode": lambda x, y, t, c: decode(c, x, y),
    "decode_to_triangles": lambda x, y, t, c: decode_to_triangles(c, x, y, FACES),
    "nearest_neighbor": lambda x, y, t, c: nearest_neighbor(x.positions, y.positions, database_mask=y.mask),
    "nearest_point_on_triangles": lambda x, y, t, c: nearest_point_on_triangles(
        x.positions, y.positions, FACES
    ),
    "matches of soft maps": lambda x, y, t, c: soft_map(Sinkhorn())(x, y, t, c).pointwise_map(),
    "early stops": lambda x, y, t, c: refine(x, y, t, iterations=30, stop_when_unchanged=True).pointwise_map,
    "history": lambda x, y, t, c: refine(x, y, t, history=True).history,
}
CASES = DIFFERENTIABLE | OTHERS


def assert_equal(expected, of_batch, row, tolerance=1e-7):
    """Check one row of the leaves of a batch, without the rows that were padded."""
    for alone, leaf in zip(jax.tree.leaves(expected), jax.tree.leaves(of_batch), strict=True):
        entry = leaf[row][tuple(slice(size) for size in alone.shape)]
        np.testing.assert_allclose(entry, alone, rtol=tolerance, atol=tolerance)


def test_the_cases_contain_all_public_functions_of_the_core():
    source = Path(__file__).read_text()
    public = {
        name
        for names in (jaxsmw, functional_maps, learning, banks)
        for name in names.__all__
        if inspect.isfunction(value := inspect.unwrap(getattr(names, name)))
        and value.__module__.startswith("jaxsmw.core.")
    }
    assert len(public) > 12 and not {name for name in public if f"{name}(" not in source}


@pytest.mark.parametrize("name", first_always(CASES, always=3))
def test_batches_of_padded_shapes_equal_a_loop_over_the_shapes(name):
    pairs = make_pairs()
    batch = make_batch(pairs)
    alone = jax.jit(CASES[name])
    of_batch = jax.jit(jax.vmap(CASES[name]))(*batch)
    mapped = jax.lax.map(lambda pair: CASES[name](*pair), batch, batch_size=3)
    for row, pair in enumerate(pairs):
        expected = alone(*pair)
        assert_equal(expected, of_batch, row)
        assert_equal(expected, mapped, row)


@pytest.mark.parametrize("name", first_always(DIFFERENTIABLE, always=3))
def test_derivatives_of_batches_equal_a_loop(name):
    batch, factors = make_batch(make_pairs()), jnp.linspace(0.9, 1.1, BATCH)

    def loss(factor, x, y, t, c):
        x = dataclasses.replace(x, eigenvectors=x.eigenvectors * factor, positions=x.positions * factor)
        outputs = jax.tree.leaves(CASES[name](x, y, t, c * factor))
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in outputs)

    def along(factor, *pair):
        return jax.jvp(lambda factor: loss(factor, *pair), (factor,), (jnp.ones_like(factor),))[1]

    alone = jax.jit(jax.grad(loss))
    expected = [
        alone(factors[row], *jax.tree.map(lambda leaf, row=row: leaf[row], batch)) for row in range(BATCH)
    ]
    assert np.isfinite(expected).all()
    for of_batch in (
        jax.vmap(jax.grad(loss)),
        jax.vmap(along),
        jax.grad(lambda *batch: jnp.sum(jax.vmap(loss)(*batch))),
    ):
        np.testing.assert_allclose(jax.jit(of_batch)(factors, *batch), expected, rtol=1e-5, atol=1e-7)


def compare_on_two_devices():
    """Compare batches that are divided among two devices with a loop, and print the names of the cases."""
    assert jax.device_count() == 2
    pairs = make_pairs()
    divided = NamedSharding(Mesh(np.array(jax.devices()), ("pairs",)), PartitionSpec("pairs"))
    batch = jax.device_put(make_batch(pairs), divided)
    for name in ON_TWO_DEVICES:
        alone, of_batch = jax.jit(CASES[name]), jax.jit(jax.vmap(CASES[name]))(*batch)
        for row, pair in enumerate(pairs):
            assert_equal(alone(*pair), of_batch, row)
        print(name)


# Each of these cases ends in another function of the core that has a rule for batches.
ON_TWO_DEVICES = [
    *list(CASES)[:3],
    "refine",
    "refine, regression",
    "refine, registration",
    "decode",
    "history",
]


@pytest.mark.cluster
def test_batches_divided_among_devices_equal_a_loop():
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here.parent), str(here), os.environ.get("PYTHONPATH", "")])
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, __file__],
        env=os.environ
        | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.stdout.splitlines() == ON_TWO_DEVICES, done.stderr


if __name__ == "__main__":
    compare_on_two_devices()
