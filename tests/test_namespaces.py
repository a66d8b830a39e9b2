"""NumPy and JAX give the same maps, the same records and the same status codes."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial import KDTree
from synthetic import bumpy_mesh, in_precision, random_spectrum, refine_in, to_namespace
from threadpoolctl import threadpool_limits

from jaxsmw.core import host_search
from jaxsmw.core.arrays import cond, fori_loop, in_blocks, on_host, replaced, scan, segment_min
from jaxsmw.core.arrays import namespace as namespace_of
from jaxsmw.core.banks import (
    CubicSpline,
    FilterBank,
    Gabor,
    Heat,
    Held,
    Identity,
    Logarithm,
    Meyer,
    SoftmaxFrame,
    tighten,
)
from jaxsmw.core.functional_map import encode
from jaxsmw.core.module import leaves
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.signatures import wave_kernel_signature
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares, NearestOrthogonal
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.matching.executor import run
from jaxsmw.matching.match import match
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.cache import recomputing

K, SAMPLES = 30, 250
WAVELETS = {
    "filtering": WaveletPreservation(),
    "exact": WaveletPreservation(CubicSpline(5), LeastSquares()),
    "nearest orthogonal": WaveletPreservation(Identity(), NearestOrthogonal()),
    "least-squares pseudo-inverse": WaveletPreservation(Meyer(3), Filtering("least_squares")),
    "exact, frobenius, pushforward": WaveletPreservation(
        CubicSpline(5), LeastSquares("frobenius"), convention="pushforward"
    ),
    "heat, common limit": WaveletPreservation(
        Heat([1, 5, 20]), NearestOrthogonal(LeastSquares()), lambda_max="common"
    ),
    "tightened": WaveletPreservation(tighten(Gabor())),
    "softmax": WaveletPreservation(SoftmaxFrame(np.linspace(0.5, 3, 12).reshape(3, 4))),
}
COARSE_TO_FINE = {"regression": FeatureRegression((10, 20)), "registration": Registration((10, 20))}
REFINERS = COARSE_TO_FINE | WAVELETS
ON_SAMPLES = {
    "samples": {},
    "starts on samples": {"starts_on_samples": True},
    "ends on samples": {"ends_on_samples": True},
    "starts and ends on samples": {"starts_on_samples": True, "ends_on_samples": True},
}
SETTINGS = {
    "three iterations": {"iterations": 3},
    "one iteration": {"iterations": 1},
    "stops": {"iterations": 30, "stop_when_unchanged": True},
    "partial": {"partial": True},
}


@pytest.fixture(scope="module")
def pair():
    """Spectra of two meshes of one surface with descriptors and creases, a disturbed map, and samples."""
    meshes = bumpy_mesh(3), bumpy_mesh(number=600)
    spectra = []
    for mesh in meshes:
        spectrum = compute_spectrum(mesh, K)
        signature = np.array(wave_kernel_signature(spectrum, dimensions=4))
        descriptors = (signature - signature.mean(axis=0)) / signature.std(axis=0)
        creases = np.sin(3 * np.asarray(spectrum.positions))
        spectra.append(spectrum.with_descriptors(descriptors).with_crease_eigenvectors(creases))
    generator = np.random.default_rng(0)
    disturbed = meshes[0].vertices + 0.1 * generator.normal(size=meshes[0].vertices.shape)
    initial_map = KDTree(meshes[1].vertices).query(disturbed)[1]
    samples = tuple(generator.choice(len(mesh.vertices), SAMPLES, replace=False) for mesh in meshes)
    return to_namespace((*spectra, initial_map, samples), "numpy")


def check_that_both_agree(pair, dtype, *, on_samples=False, **settings):
    x, y, initial_map, samples = pair
    arrays = *in_precision((x, y), dtype), initial_map
    samples = samples if on_samples else None
    host, traced = (
        refine_in(name, *arrays, samples=samples, history=True, **settings) for name in ("numpy", "jax")
    )
    assert traced.result == RESULTS.successful and host.result == RESULTS.successful
    assert host.iterations == traced.iterations
    assert np.mean(host.pointwise_map == np.asarray(traced.pointwise_map)) > 0.99
    tolerance = 1e-4 if dtype == np.float32 else 1e-9
    np.testing.assert_allclose(host.functional_map, traced.functional_map, atol=tolerance)
    for series, expected in zip(host.history[:3], traced.history[:3], strict=True):
        np.testing.assert_allclose(series, expected, rtol=100 * tolerance, atol=0.01)
    if host.history.pointwise_maps is not None:
        assert np.mean(host.history.pointwise_maps == np.asarray(traced.history.pointwise_maps)) > 0.99
    for one, other in zip(leaves(host), leaves(traced), strict=True):
        assert (one.dtype, one.shape) == (other.dtype, other.shape) and not isinstance(one, jax.Array)


@pytest.mark.parametrize("dtype", first_always([np.float64, np.float32]))
@pytest.mark.parametrize("name", first_always(REFINERS, always=5))
def test_both_namespaces_refine_alike(pair, name, dtype):
    check_that_both_agree(pair, dtype, refiner=REFINERS[name])


@pytest.mark.parametrize("dtype", first_always([np.float32, np.float64]))
@pytest.mark.parametrize(
    ("name", "settings"),
    first_always(
        [
            *(("filtering", settings) for settings in SETTINGS),
            ("regression", "one iteration"),
            ("regression", "partial"),
            ("registration", "partial"),
            *((name, settings) for name in COARSE_TO_FINE for settings in ("three iterations", "stops")),
            ("registration", "one iteration"),
        ],
        always=7,
        names=2,
    ),
)
def test_both_namespaces_refine_alike_with_all_settings(pair, name, settings, dtype):
    check_that_both_agree(pair, dtype, refiner=REFINERS[name], **SETTINGS[settings])


@pytest.mark.parametrize("dtype", first_always([np.float32, np.float64]))
@pytest.mark.parametrize("partial", first_always([False, True]))
@pytest.mark.parametrize(
    ("name", "settings"),
    first_always(
        [
            ("filtering", "samples"),
            ("registration", "starts on samples"),
            ("regression", "starts and ends on samples"),
            ("registration", "ends on samples"),
            ("exact", "samples"),
            ("nearest orthogonal", "samples"),
            ("registration", "samples"),
            ("registration", "starts and ends on samples"),
            ("regression", "samples"),
            ("regression", "starts on samples"),
            ("regression", "ends on samples"),
        ],
        always=4,
        names=2,
    ),
)
def test_both_namespaces_refine_alike_on_samples(pair, name, settings, partial, dtype):
    options = ON_SAMPLES[settings] | {"partial": partial}
    check_that_both_agree(pair, dtype, refiner=REFINERS[name], on_samples=True, **options)


class Vanishing(FilterBank):
    """A bank whose filters are zero above half of the spectrum, or everywhere."""

    share: float

    def __call__(self, points, eigenvalues):
        xp = namespace_of(points)
        return xp.where(points <= self.share * eigenvalues[-1], xp.ones_like(points), 0)[None]


class Flat(FilterBank):
    """A bank with one constant filter."""

    def __call__(self, points, eigenvalues):
        return namespace_of(points).ones_like(points)[None]


def with_entry(array, index, value):
    array = array.copy()
    array[index] = value
    return array


FAULTS = {
    "NaN in X": (lambda x, y, t: (replace(x, eigenvectors=with_entry(x.eigenvectors, (0, 3), np.nan)), y, t), {}, RESULTS.nonfinite_spectrum),
    "X is NaN": (lambda x, y, t: (replace(x, eigenvectors=x.eigenvectors * np.nan), y, t), {}, RESULTS.nonfinite_spectrum),
    "infinite descriptors": (lambda x, y, t: (x, y.with_descriptors(np.copysign(np.inf, y.descriptors)), t), {"number_of_descriptors": 4}, RESULTS.nonfinite_spectrum),
    "infinite eigenvalue": (lambda x, y, t: (x, replace(y, eigenvalues=with_entry(y.eigenvalues, 2, np.inf)), t), {}, RESULTS.nonfinite_spectrum),
    "too large": (lambda x, y, t: (x, y, with_entry(t, 3, 600)), {}, RESULTS.invalid_initial_map),
    "negative": (lambda x, y, t: (x, y, with_entry(t, 3, -1)), {}, RESULTS.invalid_initial_map),
    "far below zero": (lambda x, y, t: (x, y, with_entry(t, 3, -5000)), {}, RESULTS.invalid_initial_map),
    "masked": (lambda x, y, t: (x, replace(y, mask=with_entry(y.mask, t[0], False)), t), {}, RESULTS.invalid_initial_map),
    "no bank": (lambda x, y, t: (x, y, t), {"refiner": WaveletPreservation(Vanishing(-1.0))}, RESULTS.undetermined_functional_map),
    "half a bank": (lambda x, y, t: (x, y, t), {"refiner": WaveletPreservation(Vanishing(0.5), LeastSquares())}, RESULTS.undetermined_functional_map),
    "singular": (lambda x, y, t: (x, y, np.full_like(t, 5)), {"refiner": WaveletPreservation(Flat(), LeastSquares())}, RESULTS.singular_system),
    "zero map": (lambda x, y, t: (x, replace(y, eigenvectors=0 * y.eigenvectors), t), {}, RESULTS.undetermined_functional_map),
    "infinite map": (lambda x, y, t: (replace(x, vertex_areas=x.vertex_areas * 1e307), replace(y, eigenvectors=y.eigenvectors * 1e10), t), {}, RESULTS.nonfinite_functional_map),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_both_namespaces_report_the_same_failure_without_warnings(pair, fault):
    x, y, initial_map, _ = pair
    damage, settings, expected = FAULTS[fault]
    x, y, start = damage(x, y, initial_map)
    for name in ("jax", "numpy"):
        stage = Stage(number_of_eigenvectors=K, history=True, **settings)
        outcome = run([stage], SpectralPair(*to_namespace((x, y), name)), Start(start))
        refinement = outcome.runs[-1].refinement
        assert refinement.result == expected
        assert isinstance(refinement.pointwise_map, jax.Array) == (name == "jax")
        assert (refinement.pointwise_map == -1).all() and (refinement.history.pointwise_maps == -1).all()


@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("name", COARSE_TO_FINE)
@pytest.mark.parametrize(
    "fault", ["X is NaN", "too large", "far below zero", "masked", "infinite descriptors"]
)
def test_coarse_to_fine_refiners_report_failures_without_warnings(pair, name, fault, sampled):
    x, y, initial_map, samples = pair
    damage, _, expected = FAULTS[fault]
    x, y, start = damage(x, y, initial_map)
    settings = {"number_of_descriptors": 4, "number_of_samples": SAMPLES if sampled else None}
    stages = [Stage(REFINERS[name], **settings)]
    outcome = run(stages, SpectralPair(x, y, samples if sampled else None), Start(start))
    assert outcome.runs[-1].refinement.result == expected and not outcome.successful


def test_too_few_samples_are_reported(pair):
    x, y, initial_map, _ = pair
    few = (np.arange(5),) * 2
    for name in ("jax", "numpy"):
        refined = refine_in(name, x, y, initial_map, samples=few)
        assert refined.result == RESULTS.nonfinite_functional_map


@pytest.mark.parametrize("name", ["exact", *COARSE_TO_FINE])
def test_the_number_of_threads_does_not_change_the_map(pair, name, monkeypatch):
    x, y, initial_map, _ = pair
    maps = []
    monkeypatch.setattr(host_search, "_THREADS_FROM", 0)
    for threads in (1, 2):
        monkeypatch.setattr(host_search, "_cores", lambda threads=threads: threads)
        with threadpool_limits(threads):
            refined = refine_in(
                "numpy", *in_precision((x, y), np.float32), initial_map, refiner=REFINERS[name]
            )
        maps.append(refined.pointwise_map)
    np.testing.assert_array_equal(*maps)


@pytest.mark.sampled
def test_the_number_of_threads_does_not_change_a_match(monkeypatch):
    maps = []
    monkeypatch.setattr(host_search, "_THREADS_FROM", 0)
    for threads in (1, 2):
        monkeypatch.setattr(host_search, "_cores", lambda threads=threads: threads)
        with threadpool_limits(threads), recomputing():
            found = match(bumpy_mesh(3), bumpy_mesh(number=600), backend="numpy", mirror="no")
        maps.append(found.pointwise_map)
    np.testing.assert_array_equal(*maps)


class Record(NamedTuple):
    total: Any
    row: Any
    nothing: None


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_changes_of_a_spectrum_keep_its_types(pair, dtype, namespace):
    spectrum = in_precision(to_namespace(pair[0], namespace), dtype)
    vertices = to_namespace(np.arange(0, 600, 7), namespace)
    for changed in (
        spectrum.scale(np.float64(0.3)),
        spectrum.reflect(),
        spectrum.truncate(5),
        spectrum.pad(700),
        spectrum.sample(vertices),
        spectrum.excluding(spectrum.eigenvectors[:, 1] > 0),
    ):
        assert [leaf.dtype for leaf in leaves(changed)] == [leaf.dtype for leaf in leaves(spectrum)]
        assert {type(leaf) for leaf in leaves(changed)} == {type(spectrum.mask)}
    np.testing.assert_allclose(spectrum.excluding(~spectrum.mask).vertex_areas.sum(), 1, rtol=1e-5)


def both(compute, *arrays):
    """Return the results of a function for arrays of JAX, compiled, and for arrays of NumPy, as lists."""
    traced = jax.jit(compute)(*to_namespace(arrays, "jax"))
    return (jax.tree.map(lambda leaf: np.asarray(leaf).tolist(), tree) for tree in (traced, compute(*arrays)))


NUMBERS = np.arange(12.0).reshape(6, 2)


@pytest.mark.parametrize(
    ("compute", "arrays"),
    [
        (lambda a: replaced(a, (slice(None), 1), 7.0), (NUMBERS,)),
        (lambda a, i: replaced(a, i, -1.0), (NUMBERS, np.array([0, 4]))),
        (lambda p, a: cond(p, lambda b: b + 1, lambda b: b * 2, a), (np.array(True), NUMBERS)),
        (lambda p, a: cond(p, lambda b: b + 1, lambda b: b * 2, a), (np.array(False), NUMBERS)),
        (lambda a: fori_loop(3, lambda step, b: b * 2 + step, a), (NUMBERS,)),
        (lambda a: scan(lambda c, row: (c + row.sum(), Record(c, row, None)), a[0, 0], a), (NUMBERS,)),
        (lambda a: in_blocks(lambda b: b.sum(axis=1), a, 4), (NUMBERS,)),
        (lambda a: in_blocks(lambda b: b[:, :1] * b, a, 6), (NUMBERS,)),
        (lambda a, s: segment_min(a, s, 3), (NUMBERS[:, 1], np.array([0, 2, 1, 1, 0, 2]))),
    ],
)  # fmt: skip
def test_functions_of_arrays_give_the_same_in_both_namespaces(compute, arrays):
    traced, host = both(compute, *arrays)
    assert traced == host


def test_inputs_are_not_changed_and_their_namespace_is_kept():
    numbers = NUMBERS.copy()
    assert isinstance(replaced(numbers, 0, 5.0), np.ndarray)
    np.testing.assert_array_equal(numbers, NUMBERS)
    assert namespace_of(numbers) is np and namespace_of(numbers, jnp.zeros(1)) is jnp
    assert isinstance(on_host(jnp.zeros(2, jnp.float32)), np.ndarray)
    assert (
        on_host(np.zeros(2, np.int64)).dtype == np.int32 and on_host(np.zeros(2, np.float32)).dtype == float
    )
    assert on_host(np.zeros(2, bool)).dtype == bool


def _alone():
    """Functions of one argument, which close over NumPy arrays, and the argument."""
    x, y = (to_namespace(random_spectrum(40, 6, seed=seed), "numpy") for seed in (0, 1))
    matches = np.arange(40)[::-1].copy()
    refiner = WaveletPreservation()
    functional_map = encode(matches, x, y)
    return {
        "map of encode": (lambda t: encode(t, x, y), matches),
        "map of energy": (lambda t: refiner.problem(x, y).energy(t)(functional_map), matches),
        "functional map": (lambda c: decode(c, x, y), functional_map),
        "samples": (lambda rows: x.sample(rows).eigenvectors, matches[:9]),
        "mask": (lambda mask: x.excluding(mask).vertex_areas, matches < 5),
        "ratio": (lambda ratio: CubicSpline(ratio=ratio)(x.eigenvalues, x.eigenvalues), np.float64(9)),
        "edge": (lambda edge: Held(edge=edge)(x.eigenvalues, x.eigenvalues), np.float64(0.4)),
        "width": (lambda width: Gabor(width=width)(x.eigenvalues, x.eigenvalues), np.float64(0.4)),
        "strength": (lambda s: Logarithm(s)(x.eigenvalues, x.eigenvalues), np.float64(9)),
        "eigenvalues": (lambda values: Meyer()(values, x.eigenvalues), x.eigenvalues),
        "queries": (lambda rows: nearest_neighbor(rows, y.eigenvectors), x.eigenvectors),
        "database": (lambda rows: nearest_neighbor(x.eigenvectors, rows), y.eigenvectors),
    }


@pytest.mark.parametrize("name", list(_alone()))
def test_each_argument_can_be_traced_alone(name):
    function, argument = _alone()[name]
    expected = function(argument)
    np.testing.assert_allclose(jax.jit(function)(jnp.asarray(argument)), expected, rtol=1e-5, atol=1e-6)
    batch = jnp.stack([jnp.asarray(argument)] * 2)
    np.testing.assert_allclose(jax.vmap(function)(batch)[1], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("unchecked")
def test_searches_refuse_arrays_that_do_not_fit(namespace):
    xp = {"numpy": np, "jax": jnp}[namespace]
    points = xp.zeros((5, 3))
    with pytest.raises(ValueError, match="one entry for each row"):
        nearest_neighbor(points, points, database_mask=xp.ones(3, bool))
    with pytest.raises(ValueError, match="at least one row"):
        nearest_neighbor(points, points[:0])
    with pytest.raises(TypeError, match="same space"):
        nearest_neighbor(points, points[:, :2])
