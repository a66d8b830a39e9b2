import os
import socket
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from sampled_cases import first_always
from synthetic import random_spectrum

from jaxsmw.core.banks import CubicSpline
from jaxsmw.core.refinement import refine, refine_at_once
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions.closed_form import LeastSquares
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.runtime import batches as batch
from jaxsmw.runtime.batches import bytes_per_pair, padded_size, refine_pairs, stack

SIZES = 150, 170, 260, 300
PAIRS = [(0, 1), (1, 0), (2, 3), (0, 3), (1, 1), (0, 1), (3, 2)]


def make_problem(dtype=np.float64):
    spectra = [random_spectrum(n, 10, seed=n, dtype=dtype) for n in SIZES]
    generator = np.random.default_rng(0)
    starts = [jnp.asarray(generator.integers(0, SIZES[y], SIZES[x])) for x, y in PAIRS]
    return spectra, starts


@pytest.mark.parametrize("n", [1, 5, 127, 128, 129, 2047, 2049, 4344, 5000, 6890, 27894, 100_000])
def test_padding_is_small_and_sizes_are_few(n):
    padded = padded_size(n)
    assert n <= padded <= max(n * 9 / 8, n + 127)
    assert padded_size(padded) == padded


def test_at_most_17_padded_sizes_cover_4001_to_16000_vertices():
    assert len({padded_size(n) for n in range(4001, 16001)}) <= 17


@pytest.mark.slow
@pytest.mark.parametrize("batch_size", [None, 3])
@pytest.mark.parametrize(
    ("refiner", "pairs"),
    first_always(
        [
            (WaveletPreservation(), 7),
            (WaveletPreservation(CubicSpline(5), LeastSquares(), convention="pushforward"), 2),
            (WaveletPreservation(solution=RegularizedLeastSquares()), 2),
        ],
        names=2,
    ),
    ids=["filtering", "least squares", "regularized"],
)
def test_batched_pairs_get_the_results_of_single_pairs(refiner, pairs, batch_size):
    spectra, starts = make_problem()
    options = dict(refiner=refiner, iterations=3, history=True)
    found = dict(refine_pairs(spectra, PAIRS[:pairs], starts[:pairs], batch_size=batch_size, **options))
    assert sorted(found) == list(range(pairs))
    for position, (x, y) in enumerate(PAIRS[:pairs]):
        alone = refine(spectra[x], spectra[y], starts[position], **options)
        refined = found[position]
        assert refined.result == RESULTS.successful and alone.result == RESULTS.successful
        np.testing.assert_array_equal(refined.pointwise_map, alone.pointwise_map)
        np.testing.assert_allclose(refined.functional_map, alone.functional_map, atol=1e-9)
        np.testing.assert_array_equal(refined.history.pointwise_maps, alone.history.pointwise_maps)
        np.testing.assert_allclose(refined.history.energy, alone.history.energy, rtol=1e-9)


@pytest.mark.slow
def test_samples_and_early_stops_give_the_results_of_single_pairs():
    spectra, starts = make_problem()
    samples = [jnp.asarray(np.random.default_rng(n).choice(n, 60, replace=False)) for n in SIZES]
    some, its_starts = PAIRS[:3], starts[:3]
    for position, refined in refine_pairs(spectra, some, its_starts, samples=samples, batch_size=2):
        x, y = PAIRS[position]
        alone = refine(spectra[x], spectra[y], starts[position], samples=(samples[x], samples[y]))
        np.testing.assert_array_equal(refined.pointwise_map, alone.pointwise_map)
    some, its_starts = PAIRS[:2], starts[:2]
    options = dict(refiner=FeatureRegression(), starts_on_samples=True, ends_on_samples=True)
    found = refine_pairs(spectra, some, its_starts, samples=samples, batch_size=2, **options)
    for position, refined in found:
        x, y = PAIRS[position]
        both = samples[x], samples[y]
        alone = refine(spectra[x], spectra[y], starts[position], samples=both, **options)
        np.testing.assert_array_equal(refined.pointwise_map, alone.pointwise_map)
        assert set(np.flatnonzero(refined.pointwise_map >= 0)) == set(np.asarray(samples[x]).tolist())
    options = dict(iterations=30, stop_when_unchanged=True)
    for position, refined in refine_pairs(spectra, some, its_starts, batch_size=4, **options):
        x, y = PAIRS[position]
        alone = refine(spectra[x], spectra[y], starts[position], **options)
        assert refined.iterations == alone.iterations
        np.testing.assert_array_equal(refined.pointwise_map, alone.pointwise_map)


def test_a_failing_pair_does_not_affect_other_pairs():
    spectra, starts = make_problem()
    starts[3] = starts[3].at[5].set(-1)
    spectra[2] = eqx.tree_at(
        lambda s: s.eigenvectors, spectra[2], spectra[2].eigenvectors.at[0, 0].set(jnp.nan)
    )
    found = dict(refine_pairs(spectra, PAIRS, starts, batch_size=7))
    results = [found[position].result for position in range(len(PAIRS))]
    bad = {3: RESULTS.invalid_initial_map, 2: RESULTS.nonfinite_spectrum, 6: RESULTS.nonfinite_spectrum}
    for position, result in enumerate(results):
        assert result == bad.get(position, RESULTS.successful)


def test_both_shapes_may_have_different_numbers_of_eigenvectors():
    x, y = random_spectrum(150, 10), random_spectrum(170, 12, seed=1)
    start = jnp.asarray(np.random.default_rng(0).integers(0, 170, 150))
    ((_, refined),) = refine_pairs([x, y], [(0, 1)], [start])
    assert refined.functional_map.shape == (10, 12)
    np.testing.assert_array_equal(refined.pointwise_map, refine(x, y, start).pointwise_map)


def test_one_compilation_for_each_combination_of_sizes():
    traced = []

    class Counting(WaveletPreservation):
        def update(self, problem, pointwise_map, previous):
            if previous is None:
                traced.append(pointwise_map.shape)
            return super().update(problem, pointwise_map, previous)

    spectra, starts = make_problem()
    combinations = {tuple(padded_size(SIZES[shape]) for shape in pair) for pair in PAIRS}
    assert len(combinations) == 3 < len(PAIRS)
    for _ in range(2):
        dict(refine_pairs(spectra, PAIRS, starts, refiner=Counting()))
        assert len(traced) == len(combinations)
    other = [random_spectrum(n - 3, 10, seed=n) for n in SIZES]
    starts = [jnp.asarray(np.arange(SIZES[x] - 3) % 100) for x, _ in PAIRS]
    dict(refine_pairs(other, PAIRS, starts, refiner=Counting()))
    assert len(traced) == len(combinations)


def test_memory_determines_the_batch_size(monkeypatch):
    spectra, starts = make_problem()
    sizes = []
    original = batch.compiled(batch._refine_batch)

    def spy(pairs, *rest):
        sizes.append(len(pairs[-1]))
        return original(pairs, *rest)

    monkeypatch.setattr(batch, "compiled", lambda function: spy)
    monkeypatch.setattr(batch, "_one_at_a_time", lambda device: False)
    list(refine_pairs(spectra, PAIRS, starts, memory=10**9))
    assert sorted(sizes) == [1, 2, 4]
    sizes.clear()
    list(refine_pairs(spectra, PAIRS, starts, memory=2 * bytes_per_pair(256, 256, 10, 8)))
    assert sorted(sizes) == [1, 1, 1, 2, 2]


@pytest.mark.parametrize(("m", "n", "k"), [(2048, 2048, 50), (2048, 4096, 100), (1024, 1024, 20)])
def test_the_estimated_memory_of_a_pair_agrees_with_the_compiler(m, n, k):
    x, y = (random_spectrum(size, k, seed=size, dtype=np.float32) for size in (m, n))
    start = jnp.zeros(m, jnp.int32)
    batch_size = 4
    shapes = jax.eval_shape(
        lambda: (stack([x] * batch_size), stack([y] * batch_size), jnp.stack([start] * batch_size))
    )
    stats = jax.jit(jax.vmap(lambda x, y, t: refine_at_once(x, y, t).pointwise_map)).lower(*shapes).compile()
    analysis = stats.memory_analysis()
    used = (analysis.temp_size_in_bytes + analysis.argument_size_in_bytes) / batch_size
    assert 0.5 < bytes_per_pair(m, n, k, 4) / used < 2


def test_arguments_that_do_not_fit_together_are_refused(monkeypatch):
    # Run-time type checks are disabled, so the library itself raises the errors.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    spectra, starts = make_problem()
    with pytest.raises(ValueError, match="shape 0 is a str, but a Spectrum is needed"):
        refine_pairs(["cat.off"], [], [])
    with pytest.raises(ValueError, match="7 pairs and 6 initial maps"):
        refine_pairs(spectra, PAIRS, starts[:-1])
    with pytest.raises(ValueError, match="pair 0 is"):
        refine_pairs(spectra[:1], PAIRS, starts)
    with pytest.raises(ValueError, match="pair 0 is"):
        refine_pairs(spectra, [(0, 1, 1)], starts[:1])
    with pytest.raises(TypeError, match="pair 0 has type float"):
        refine_pairs(spectra, PAIRS, [np.asarray(start, float) for start in starts])
    with pytest.raises(ValueError, match="initial map of pair 1"):
        refine_pairs(spectra, PAIRS, [starts[0]] * 7)
    with pytest.raises(ValueError, match="samples of 1"):
        refine_pairs(spectra, PAIRS, starts, samples=[jnp.arange(50)])
    with pytest.raises(ValueError, match="batch_size is 0"):
        refine_pairs(spectra, PAIRS, starts, batch_size=0)
    with pytest.raises(ValueError, match="give at least one JAX device"):
        refine_pairs(spectra, PAIRS, starts, devices=[])
    with pytest.raises(ValueError, match=r"\[10, 11\] eigenvectors"):
        stack([random_spectrum(20, 10), random_spectrum(20, 11)])
    with pytest.raises(ValueError, match="no shapes"):
        stack([])
    with pytest.raises(ValueError, match="does not fit"):
        random_spectrum(20, 5).pad(10)


_PROGRAM = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
output, process, processes, address = sys.argv[1:]
if int(processes) > 1:
    jax.distributed.initialize(address, int(processes), int(process))
import numpy as np
from test_batch import PAIRS, make_problem
from jaxsmw.runtime.batches import refine_pairs
spectra, starts = make_problem()
assert len(jax.devices()) == 4, jax.devices()
found = dict(refine_pairs(spectra, PAIRS, starts, batch_size=2, history=True))
np.savez(
    f"{output}-{process}.npz",
    **{f"{i}-{name}": getattr(found[i], name) for i in found for name in ("pointwise_map", "functional_map")},
)
"""


def run_processes(output, count: int) -> None:
    """Run `_PROGRAM` in several processes that together have four devices."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    here = os.path.dirname(__file__)
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={4 // count}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": here}
    running = [
        subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, output, str(process), str(count), address],
            env=environment, stderr=subprocess.PIPE, text=True,
        )
        for process in range(count)
    ]  # fmt: skip
    try:
        for process in running:
            _, errors = process.communicate(timeout=300)
            assert process.returncode == 0, errors
    finally:
        for process in running:
            process.kill()


@pytest.fixture(scope="module")
def one():
    """The results of all pairs on one device."""
    spectra, starts = make_problem()
    return dict(refine_pairs(spectra, PAIRS, starts, batch_size=2, history=True))


@pytest.mark.parametrize("processes", first_always([2, 1]))
@pytest.mark.cluster
def test_four_devices_give_the_results_of_one(one, tmp_path, processes):
    """The devices belong to one process, or to two processes that communicate over the network."""
    run_processes(tmp_path / "results", processes)
    for process in range(processes):
        with np.load(tmp_path / f"results-{process}.npz") as found:
            assert len(found) == 2 * len(PAIRS)
            for position, refined in one.items():
                np.testing.assert_array_equal(found[f"{position}-pointwise_map"], refined.pointwise_map)
                np.testing.assert_allclose(
                    found[f"{position}-functional_map"], refined.functional_map, atol=1e-12
                )
