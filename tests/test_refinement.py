"""The refinement loop has the expected invariances, reports failures, and compiles once for each size."""

import functools
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from messages import assert_names, refused
from sampled_cases import first_always
from synthetic import in_precision, random_spectrum, stacked

from jaxsmw.core.banks import CubicSpline, FilterBank, Meyer
from jaxsmw.core.functional_map import encode, multiscale_kernel
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiner import Problem, Refiner, State
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum

M, K = 300, 15


def permuted(spectrum: Spectrum, order: np.ndarray) -> Spectrum:
    return Spectrum(
        spectrum.eigenvalues, spectrum.eigenvectors[order], spectrum.vertex_areas[order], spectrum.mask[order]
    )


@pytest.fixture(scope="module")
def pair():
    """A spectrum, a disturbed and shuffled copy, a map with a third of its matches wrong, and the true map."""
    generator = np.random.default_rng(0)
    x = random_spectrum(M, K)
    order = generator.permutation(M)
    y = permuted(x, order)
    y = eqx.tree_at(lambda s: s.eigenvectors, y, y.eigenvectors + 0.02 * generator.normal(size=(M, K)))
    truth = np.argsort(order)
    initial_map = np.where(generator.random(M) < 1 / 3, generator.integers(0, M, M), truth)
    return x, y, jnp.asarray(initial_map, jnp.int32), truth


REFINERS = {
    "default": WaveletPreservation(),
    "least-squares pseudo-inverse": WaveletPreservation(solution=Filtering("least_squares")),
    "exact": WaveletPreservation(solution=LeastSquares()),
    "exact, frobenius": WaveletPreservation(solution=LeastSquares("frobenius")),
    "exact, pushforward": WaveletPreservation(
        bank=CubicSpline(5), solution=LeastSquares(), convention="pushforward"
    ),
    "regularized": WaveletPreservation(solution=RegularizedLeastSquares()),
    "pushforward": WaveletPreservation(convention="pushforward"),
    "common": WaveletPreservation(lambda_max="common"),
    "three filters": WaveletPreservation(bank=Meyer(3)),
}
ALL_REFINERS = REFINERS | {
    "regression": FeatureRegression(),
    "regression, coarse to fine": FeatureRegression((4, 8)),
}
# CI always checks the default refiner and the regression.
SIMPLEST_FIRST = first_always(
    sorted(ALL_REFINERS, key=lambda name: name not in ("default", "regression")), always=2
)


def test_recovers_a_disturbed_copy(pair, refine):
    x, y, initial_map, truth = pair
    refined = refine(x, y, initial_map, iterations=5)
    assert refined.result == RESULTS.successful
    assert np.mean(np.asarray(initial_map) == truth) < 0.75
    assert np.mean(np.asarray(refined.pointwise_map) == truth) > 0.95


@pytest.fixture(scope="module")
def plain_loop(pair):
    """A function that runs three iterations of a refiner step by step, once for each refiner."""
    x, y, initial_map, _ = pair

    @functools.cache
    def run(name):
        refiner = REFINERS[name]
        problem = refiner.problem(x, y)
        t, c = initial_map, None
        for _ in range(3):
            if isinstance(refiner.solution, Filtering):
                kernel = multiscale_kernel(*problem.responses)
                options = {
                    "convention": refiner.convention,
                    "pseudo_inverse": refiner.solution.pseudo_inverse,
                }
                c = kernel * encode(t, x, y, **options)
            elif isinstance(refiner.solution, LeastSquares):
                c = problem.energy(t, norm=refiner.solution.norm).minimizer()
            else:
                c, _ = refiner.solution.solve(problem, None, t, c)
            t = decode(c, x, y, convention=refiner.convention)
        return t, c

    return run


@pytest.mark.parametrize(
    "name",
    first_always(
        sorted(REFINERS, key=lambda name: name not in ("default", "exact", "regularized")), always=3
    ),
)
def test_refine_equals_a_plain_loop(pair, plain_loop, name, refine):
    x, y, initial_map, _ = pair
    t, c = plain_loop(name)
    refined = refine(x, y, initial_map, refiner=REFINERS[name])
    assert refined.result == RESULTS.successful
    np.testing.assert_array_equal(refined.pointwise_map, t)
    np.testing.assert_allclose(refined.functional_map, c, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in REFINERS if name != "default"])
def test_every_option_changes_the_result(name, refine):
    x, y = random_spectrum(M, K, seed=1), random_spectrum(M, K, seed=2)
    y = eqx.tree_at(lambda s: s.eigenvalues, y, y.eigenvalues * 1.5)
    initial_map = jnp.asarray(np.random.default_rng(0).integers(0, M, M))
    default = refine(x, y, initial_map, iterations=1).functional_map
    other = refine(x, y, initial_map, iterations=1, refiner=REFINERS[name]).functional_map
    assert jnp.max(jnp.abs(default - other)) > 1e-3


def products(jaxpr):
    """Return all matrix products of a program and of its nested programs."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda p: hasattr(p, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from products(inner)


@pytest.mark.parametrize("refiner", ALL_REFINERS.values(), ids=ALL_REFINERS)
def test_products_use_the_highest_precision(pair, refiner):
    """GPUs use a lower precision by default, and small differences can change matches."""
    x, y, initial_map, _ = pair
    arrays, rest = eqx.partition((x, y, initial_map, refiner), eqx.is_array)

    def refined(arrays):
        x, y, initial_map, refiner = eqx.combine(arrays, rest)
        return eqx.filter(refine(x, y, initial_map, refiner=refiner), eqx.is_array)

    found = list(products(jax.make_jaxpr(refined)(arrays).jaxpr))
    assert len(found) >= 3
    highest = (jax.lax.Precision.HIGHEST,) * 2
    assert {equation.params["precision"] for equation in found} == {highest}


@pytest.mark.parametrize("name", SIMPLEST_FIRST)
def test_signs_of_eigenvectors_do_not_matter(pair, name, refine):
    x, y, initial_map, _ = pair
    refiner = ALL_REFINERS[name]
    generator = np.random.default_rng(4)
    flipped = [
        eqx.tree_at(lambda s: s.eigenvectors, s, s.eigenvectors * generator.choice([-1.0, 1.0], (1, K)))
        for s in (x, y)
    ]
    np.testing.assert_array_equal(
        refine(*flipped, initial_map, refiner=refiner).pointwise_map,
        refine(x, y, initial_map, refiner=refiner).pointwise_map,
    )


def test_basis_within_an_eigenspace_does_not_matter(pair, refine):
    """The two eigenvectors of a double eigenvalue are determined only up to a rotation."""
    x, y, initial_map, _ = pair
    x, y = (
        eqx.tree_at(lambda s: s.eigenvalues, s, s.eigenvalues.at[5].set(s.eigenvalues[4])) for s in (x, y)
    )
    rotation = jnp.asarray([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    turned = eqx.tree_at(
        lambda s: s.eigenvectors, x, x.eigenvectors.at[:, 4:6].set(x.eigenvectors[:, 4:6] @ rotation)
    )
    np.testing.assert_array_equal(
        refine(turned, y, initial_map).pointwise_map, refine(x, y, initial_map).pointwise_map
    )


def test_renumbering_vertices_renumbers_the_map(pair, refine):
    x, y, initial_map, _ = pair
    generator = np.random.default_rng(4)
    order_x, order_y = generator.permutation(M), generator.permutation(M)
    renumbered_initial_map = jnp.argsort(jnp.asarray(order_y))[initial_map[order_x]]
    renumbered = refine(permuted(x, order_x), permuted(y, order_y), renumbered_initial_map)
    np.testing.assert_array_equal(
        order_y[renumbered.pointwise_map], np.asarray(refine(x, y, initial_map).pointwise_map)[order_x]
    )


@pytest.mark.parametrize("factor", [1e-2, 1e3])
def test_common_scale_does_not_matter(pair, factor, refine):
    x, y, initial_map, _ = pair
    scaled = [
        Spectrum(s.eigenvalues / factor**2, s.eigenvectors / factor, s.vertex_areas * factor**2, s.mask)
        for s in (x, y)
    ]
    np.testing.assert_array_equal(
        refine(*scaled, initial_map).pointwise_map, refine(x, y, initial_map).pointwise_map
    )


@pytest.mark.parametrize("name", SIMPLEST_FIRST)
def test_padding_changes_nothing(pair, name, refine):
    x, y, initial_map, _ = pair
    refiner = ALL_REFINERS[name]
    plain = refine(x, y, initial_map, refiner=refiner, history=True)
    wide = refine(x.pad(M + 70), y.pad(M + 33), jnp.pad(initial_map, (0, 70)), refiner=refiner, history=True)
    np.testing.assert_array_equal(wide.pointwise_map[:M], plain.pointwise_map)
    np.testing.assert_allclose(wide.functional_map, plain.functional_map, atol=1e-12)
    for series in ("changed", "energy", "objective"):
        np.testing.assert_allclose(
            getattr(wide.history, series), getattr(plain.history, series), rtol=1e-9, atol=1e-12
        )


def test_different_numbers_of_vertices_and_eigenvectors(refine):
    x, y = random_spectrum(80, 12, seed=1), random_spectrum(90, 10, seed=2)
    initial_map = jnp.asarray(np.random.default_rng(0).integers(0, 90, 80))
    refined = refine(x, y, initial_map)
    assert refined.functional_map.shape == (12, 10)
    assert refined.pointwise_map.shape == (80,)
    assert refine(x, y, initial_map, refiner=REFINERS["pushforward"]).functional_map.shape == (10, 12)


def test_history_describes_every_iteration(pair, refine):
    x, y, initial_map, _ = pair
    refiner = WaveletPreservation()
    maps = [initial_map, *(refine(x, y, initial_map, iterations=i).pointwise_map for i in range(1, 5))]
    history = refine(x, y, initial_map, iterations=4, history=True).history
    for i in range(4):
        assert history.changed[i] == np.mean(np.asarray(maps[i]) != np.asarray(maps[i + 1]))
        c = refine(x, y, initial_map, iterations=i + 1).functional_map
        energy = refiner.problem(x, y).energy(maps[i])(c)
        np.testing.assert_allclose(history.energy[i], energy, rtol=1e-9)
        objective = refiner.objective(refiner.prepare(Problem(x, y)), State(c), maps[i + 1])
        np.testing.assert_allclose(history.objective[i], objective, rtol=1e-9)
        np.testing.assert_array_equal(history.pointwise_maps[i], maps[i + 1])
    assert refine(x, y, initial_map).history is None


def test_stops_when_the_map_no_longer_changes(pair, refine):
    x, y, initial_map, _ = pair
    patient = refine(x, y, initial_map, iterations=40)
    stopped = refine(x, y, initial_map, iterations=40, stop_when_unchanged=True, history=True)
    assert patient.iterations == 40
    assert stopped.iterations < 40
    np.testing.assert_array_equal(patient.pointwise_map, stopped.pointwise_map)
    np.testing.assert_allclose(patient.functional_map, stopped.functional_map, atol=1e-12)
    done = int(stopped.iterations)
    assert np.isfinite(stopped.history.energy[: done - 1]).all()
    assert np.isnan(stopped.history.energy[done:-1]).all()
    assert np.all(np.asarray(stopped.history.pointwise_maps[done:]) == np.asarray(stopped.pointwise_map))


def test_refinement_iterates_on_samples_and_ends_on_all_vertices(pair, refine):
    x, y, initial_map, _ = pair
    generator = np.random.default_rng(1)
    samples_x, samples_y = (jnp.asarray(generator.choice(M, 60, replace=False)) for _ in range(2))
    refiner = WaveletPreservation()
    kernel = multiscale_kernel(*refiner.problem(x, y).responses)
    c = kernel * encode(initial_map, x, y)
    for _ in range(3):
        t = decode(c, x.sample(samples_x), y.sample(samples_y))
        c = kernel * np.linalg.lstsq(x.eigenvectors[samples_x], y.eigenvectors[samples_y][t])[0]
    refined = refine(x, y, initial_map, iterations=4, samples=(samples_x, samples_y), history=True)
    np.testing.assert_allclose(refined.functional_map, c, atol=1e-10)
    np.testing.assert_array_equal(refined.pointwise_map, decode(jnp.asarray(c), x, y))
    assert np.isnan(refined.history.changed[jnp.asarray([0, 3])]).all()
    assert np.isfinite(refined.history.changed[1:3]).all()
    assert refined.history.pointwise_maps is None
    with pytest.raises((ValueError, TypeCheckError), match="samples"):
        refine(x, y, initial_map, samples=(samples_x,))


@pytest.mark.slow
def test_refinement_can_start_and_end_on_samples(pair, refine):
    x, y, initial_map, _ = pair
    generator = np.random.default_rng(1)
    samples = tuple(jnp.asarray(generator.choice(M, 60, replace=False)) for _ in range(2))
    refiner = FeatureRegression((4, 8, K))
    prepared = refiner.prepare(Problem(x, y, samples))
    maps, state = [initial_map[samples[0]]], None
    for _ in range(3):
        state, _ = refiner.update(prepared, maps[-1], state)
        after, state = refiner.recover_both(prepared, state)
        maps.append(after)
    options = dict(refiner=refiner, iterations=3, samples=samples, starts_on_samples=True, history=True)
    others = np.setdiff1d(np.arange(M), samples[0])
    # The entries of other vertices may be missing.
    refined = refine(x, y, initial_map.at[others].set(-1), **options)
    np.testing.assert_allclose(refined.functional_map, state.functional_map, atol=1e-12)
    changed = [np.mean(after != before) for before, after in pairwise(maps)]
    np.testing.assert_allclose(refined.history.changed, [*changed[:2], np.nan])
    everywhere = refiner.recover(refiner.prepare(Problem(x, y)), state)
    np.testing.assert_array_equal(refined.pointwise_map, everywhere)
    ended = refine(x, y, initial_map, ends_on_samples=True, **options)
    np.testing.assert_array_equal(ended.pointwise_map[samples[0]], maps[3])
    assert (ended.pointwise_map[others] == -1).all() and ended.iterations == 3
    np.testing.assert_allclose(ended.history.changed, changed)
    invalid = refine(x, y, initial_map.at[samples[0][5]].set(-1), **options)
    assert invalid.result == RESULTS.invalid_initial_map


def test_refinement_that_starts_in_full_and_ends_on_samples_has_no_first_change(pair, refine):
    x, y, initial_map, _ = pair
    samples = (jnp.arange(0, M, 4), jnp.arange(1, M, 4))
    options = dict(refiner=FeatureRegression(), iterations=3, samples=samples, history=True)
    ended, usual = (
        refine(x, y, initial_map, ends_on_samples=True, **options),
        refine(x, y, initial_map, **options),
    )
    np.testing.assert_array_equal(ended.functional_map, usual.functional_map)
    np.testing.assert_array_equal(ended.pointwise_map[::4], usual.pointwise_map[::4])
    assert np.isnan(ended.history.changed[0]) and np.isfinite(ended.history.changed[1:]).all()


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"refiner": FeatureRegression(), "starts_on_samples": True}, "there are no samples"),
        ({"refiner": FeatureRegression(), "ends_on_samples": True}, "there are no samples"),
        ({"samples": (jnp.arange(50),) * 2, "ends_on_samples": True}, "WaveletPreservation matches samples"),
    ],
    ids=str,
)
def test_starting_and_ending_on_samples_is_refused_without_them(pair, options, fault, refine):
    x, y, initial_map, _ = pair
    with pytest.raises(ValueError, match=fault):
        refine(x, y, initial_map, **options)


def test_vmap_over_pairs_equals_a_loop():
    pairs = [(random_spectrum(M, K, seed=s), random_spectrum(M, K, seed=s + 10)) for s in range(3)]
    initial_maps = jnp.asarray(np.random.default_rng(0).integers(0, M, (3, M)))
    xs, ys = (stacked(*side) for side in zip(*pairs, strict=True))
    for options in ({}, {"stop_when_unchanged": True}, {"history": True}):
        batched = jax.vmap(lambda x, y, t, o=options: refine(x, y, t, **o))(xs, ys, initial_maps)
        for index, (x, y) in enumerate(pairs):
            alone = refine(x, y, initial_maps[index], **options)
            np.testing.assert_array_equal(batched.pointwise_map[index], alone.pointwise_map)
            np.testing.assert_allclose(batched.functional_map[index], alone.functional_map, atol=1e-12)
            assert batched.iterations[index] == alone.iterations


@pytest.mark.sampled
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux reports peak memory in /proc")
def test_memory_stays_far_below_all_distances():
    """All 30 000 x 30 000 distances would take 3.6 GB. The process must use less than 0.7 GB."""
    program = """
import re
import jax.numpy as jnp
import numpy as np
from jaxsmw import Spectrum, refine
generator = np.random.default_rng(0)
n, k = 30_000, 20
def spectrum():
    vectors = jnp.asarray(generator.normal(size=(n, k)), jnp.float32)
    return Spectrum(jnp.arange(k, dtype=jnp.float32), vectors, jnp.full(n, 1 / n, jnp.float32), jnp.ones(n, bool))
t = refine(spectrum(), spectrum(), jnp.zeros(n, jnp.int32), iterations=1).pointwise_map
assert len(np.unique(t)) > 1
# getrusage is not used, because its peak would include the memory of the parent process.
print(re.search(r"VmHWM:\\s*(\\d+) kB", open("/proc/self/status").read())[1])
"""
    # Unlike in other tests, the computation takes longer than the compilation.
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "false"}
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) * 1024 < 0.7e9


def test_compiles_once_per_size_and_setting():
    traces = []

    class Counting(WaveletPreservation):
        def update(self, problem, pointwise_map, previous):
            traces.append(1)
            return super().update(problem, pointwise_map, previous)

    refiner = Counting()
    initial_map = jnp.zeros(50, jnp.int32)
    refine(random_spectrum(50, 5, seed=0), random_spectrum(40, 5, seed=1), initial_map, refiner=refiner)
    traced = len(traces)
    for seed in range(3):
        pair = random_spectrum(50, 5, seed=seed), random_spectrum(40, 5, seed=seed + 5)
        refine(*pair, initial_map + seed, refiner=refiner)
    assert len(traces) == traced
    refine(random_spectrum(50, 6), random_spectrum(40, 6), initial_map, refiner=refiner)
    assert len(traces) > traced


def test_float32_in_float32_out(refine):
    x, y = (random_spectrum(M, K, seed=s, dtype=np.float32) for s in (0, 1))
    refined = refine(x, y, jnp.zeros(M, jnp.int32), history=True)
    assert refined.functional_map.dtype == jnp.float32
    assert refined.history.energy.dtype == jnp.float32


@pytest.mark.parametrize(
    ("damage", "result"),
    [
        (lambda x, y, t: (eqx.tree_at(lambda s: s.eigenvectors, x, x.eigenvectors.at[0, 3].set(jnp.nan)), y, t), RESULTS.nonfinite_spectrum),
        (lambda x, y, t: (x, eqx.tree_at(lambda s: s.eigenvalues, y, y.eigenvalues.at[2].set(jnp.inf)), t), RESULTS.nonfinite_spectrum),
        (lambda x, y, t: (x, y, t.at[3].set(M)), RESULTS.invalid_initial_map),
        (lambda x, y, t: (x, y, t.at[3].set(-1)), RESULTS.invalid_initial_map),
        (lambda x, y, t: (x, eqx.tree_at(lambda s: s.mask, y, y.mask.at[t[0]].set(False)), t), RESULTS.invalid_initial_map),
        (lambda x, y, t: (eqx.tree_at(lambda s: s.vertex_areas, x, x.vertex_areas * 1e307), eqx.tree_at(lambda s: s.eigenvectors, y, y.eigenvectors * 1e10), t), RESULTS.nonfinite_functional_map),
    ],
)  # fmt: skip
def test_failures_are_reported_and_return_no_map(pair, damage, result, refine):
    x, y, initial_map, _ = pair
    refined = refine(*damage(x, y, initial_map), iterations=4, history=True)
    assert refined.result == result
    assert (refined.pointwise_map == -1).all() and (refined.history.pointwise_maps == -1).all()
    assert len(RESULTS[result]) > 40


def test_an_early_failure_is_reported(pair, refine):
    """Successful iterations do not hide an earlier failure."""

    class FailsAtFirst(WaveletPreservation):
        def update(self, problem, pointwise_map, previous):
            functional_map, result = super().update(problem, pointwise_map, previous)
            return functional_map, RESULTS.singular_system if previous is None else result

    x, y, initial_map, _ = pair
    assert refine(x, y, initial_map, refiner=FailsAtFirst()).result == RESULTS.singular_system


def test_too_few_samples_are_reported(pair, refine):
    x, y, initial_map, _ = pair
    few = jnp.arange(5)
    refined = refine(x, y, initial_map, samples=(few, few))
    assert refined.result == RESULTS.nonfinite_functional_map


def test_unknown_settings_are_refused():
    for name, maker in {
        "convention": WaveletPreservation,
        "lambda_max": WaveletPreservation,
        "pseudo_inverse": Filtering,
        "norm": LeastSquares,
    }.items():
        with pytest.raises((ValueError, TypeError), match=name):
            maker(**{name: "pullbakc"})


def test_the_initial_map_needs_one_match_per_vertex(pair, refine):
    x, y, initial_map, _ = pair
    with pytest.raises(ValueError, match="X has 300 vertices"):
        refine(x, y, initial_map[:10])


def test_at_least_one_iteration_is_needed(pair):
    with pytest.raises(ValueError, match="at least 1 iteration"):
        refine(*pair[:3], iterations=0)


def test_the_loop_accepts_new_refiners(pair, refine):
    """This refiner computes the orthogonal functional map of spectral ICP, without wavelets, by JAX alone."""

    class Orthogonal(WaveletPreservation):
        def update(self, prepared, pointwise_map, previous):
            u, _, vt = jnp.linalg.svd(encode(pointwise_map, prepared.spectrum_x, prepared.spectrum_y))
            return State(u @ vt), RESULTS.successful

    x, y, initial_map, truth = pair
    assert issubclass(Orthogonal, Refiner)
    refined = refine(x, y, initial_map, refiner=Orthogonal(), iterations=5)
    np.testing.assert_allclose(refined.functional_map @ refined.functional_map.T, np.eye(K), atol=1e-10)
    assert np.mean(np.asarray(refined.pointwise_map) == truth) > 0.95


def test_default_embeddings_follow_the_convention_of_the_refiner(pair):
    x, y, _, _ = pair
    refiner = WaveletPreservation(convention="pushforward")
    prepared = refiner.prepare(Problem(x, y))
    state = State(jnp.asarray(np.random.default_rng(0).normal(size=(K, K))))
    queries, database = Refiner.embeddings(refiner, prepared, state)
    np.testing.assert_allclose(queries, x.eigenvectors @ state.functional_map.T)
    np.testing.assert_array_equal(database, y.eigenvectors)


def test_an_undetermined_functional_map_is_reported(pair, refine):
    class Nothing(FilterBank):
        def __call__(self, points, eigenvalues):
            return jnp.zeros((2, len(points)))

    x, y, initial_map, _ = pair
    assert (
        refine(x, y, initial_map, refiner=WaveletPreservation(Nothing())).result
        == RESULTS.undetermined_functional_map
    )


@pytest.mark.parametrize("kind", [float, bool])
def test_initial_maps_of_other_types_than_integers_are_refused(pair, kind, refine):
    x, y, _, initial_map = pair
    with pytest.raises(TypeError, match=r"must be integer vertex indices|pointwise_map"):
        refine(x, y, jnp.asarray(initial_map).astype(kind), refiner=WaveletPreservation(), iterations=1)


def test_spectra_of_different_float_types_are_refused(pair, refine):
    x, y, initial_map, _ = pair
    single = in_precision(x, np.float32)
    with refused("spectrum of X", "float32", "spectrum of Y", "float64", error=ValueError):
        refine(single, y, initial_map, stop_when_unchanged=True)


@pytest.mark.parametrize("settings", [dict(bank=Meyer), dict(bank="meyer"), dict(solution="least-squares")])
def test_banks_and_solutions_of_wrong_types_are_refused(settings):
    with pytest.raises((TypeError, TypeCheckError), match=r"bank|solution"):
        WaveletPreservation(**settings)


_ARGUMENTS_OF_WRONG_TYPES = """
import jax.numpy as jnp, jaxsmw, numpy as np
from jaxsmw import Meyer, Registration, Stage, WaveletPreservation, refine

x = jaxsmw.Spectrum(jnp.arange(3.0), jnp.ones((5, 3)), jnp.ones(5), jnp.ones(5, bool))
initial_map = jnp.arange(5)
for call in (
    lambda: refine(x, x, initial_map, refiner=WaveletPreservation),
    lambda: refine(x, x, initial_map, refiner="paper"),
    lambda: refine(x, None, initial_map),
    lambda: refine(x, x, [0, 1, 2, 3, 4]),
    lambda: WaveletPreservation("meyer"),
    lambda: Meyer(3.5),
    lambda: Registration([35, 60]),
    lambda: Registration((3.5,)),
    lambda: Registration(35),
    lambda: print(Registration(tuple(np.array([35, 60]))).levels, Stage(iterations=np.int64(2)).iterations),
    lambda: Stage(iterations=True),
    lambda: jaxsmw.Preset((Stage(),), search="accurate"),
    lambda: refine(x, x, initial_map, samples=([1], [1])),
    lambda: jaxsmw.compute_spectrum("mesh.off", 3),
    lambda: jaxsmw.match("mesh.off", "mesh.off"),
    lambda: jaxsmw.compute_spectrum(jaxsmw.make_mesh(np.eye(3), [[0, 1, 2]]), 2, laplacian="Robust"),
):
    try:
        call()
    except (TypeError, jaxsmw.InputError) as error:
        print(error)
"""


@pytest.mark.slow
def test_arguments_of_wrong_types_are_named():
    """The program runs in its own process, without the run-time type checks of the tests."""
    said = subprocess.run(
        [sys.executable, "-c", _ARGUMENTS_OF_WRONG_TYPES], check=True, capture_output=True, text=True
    )
    facts = (
        ("refiner", "create it with WaveletPreservation()", "Refiner is needed"),
        ("refiner", "'paper'", "Refiner is needed"),
        ("spectrum of Y", "None", "Spectrum is needed"),
        ("initial map", "list", "array is needed"),
        ("bank", "'meyer'", "FilterBank is needed, such as Meyer()"),
        ("filters of Meyer", "integer", "3.5"),
        ("levels", "(3.5,)", "integers"),
        ("levels", "35", "integers"),
        ("(35, 60) 2",),
        ("iterations", "True", "whole number"),
        ("search", "'accurate'", "SearchSettings or None"),
        ("samples of X", "list", "array is needed"),
        ("mesh", "'mesh.off'", "Mesh is needed"),
        ("source mesh", "'mesh.off'", "file name", "jaxsmw.read_mesh"),
        ("'Robust'", "Laplacian", "auto, cotangent, robust"),
    )
    for message, named in zip(said.stdout.splitlines(), facts, strict=True):
        assert_names(message, *named)
