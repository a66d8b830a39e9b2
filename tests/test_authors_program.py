"""Agreement with the results of the MWP authors' program on real pairs."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions.closed_form import Filtering
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.evaluation.ground_truth import read_ground_truth
from jaxsmw.evaluation.metrics import geodesic_error
from jaxsmw.io.meshes import read_mesh

SETTINGS = {"demo": 128, "paper": 100}


PAIRS = {"faust_r_002_007": ("tr_reg_002", "tr_reg_007"), "faust_r_000_004": ("tr_reg_000", "tr_reg_004")}


@pytest.fixture(params=["faust_r_002_007", pytest.param("faust_r_000_004", marks=pytest.mark.sampled)])
def name(request):
    return request.param


@pytest.fixture
def reference(shared, name):
    return dict(np.load(shared / "oracle" / f"{name}.npz"))


def spectrum(reference: dict, side: str, k: int, dtype: type) -> Spectrum:
    areas = reference[f"{side}_vertex_areas"]
    return Spectrum(
        jnp.asarray(reference[f"{side}_eigenvalues"][:k], dtype),
        jnp.asarray(reference[f"{side}_eigenvectors"][:, :k], dtype),
        jnp.asarray(areas, dtype),
        jnp.ones(len(areas), bool),
    )


def run(reference: dict, setting: str, iterations: int, dtype: type = np.float64, *, start=None, **options):
    x, y = (spectrum(reference, side, SETTINGS[setting], dtype) for side in "xy")
    start = jnp.asarray(reference["T0"].astype(np.int32) if start is None else start)
    names = ("convention", "lambda_max")
    settings = {name: options.pop(name) for name in names if name in options}
    solution = Filtering(options.pop("pseudo_inverse", "least_squares"))
    refiner = WaveletPreservation(solution=solution, **settings)
    refined = refine(x, y, start, refiner=refiner, iterations=iterations, **options)
    assert refined.result == RESULTS.successful
    return np.asarray(refined.pointwise_map), np.asarray(refined.functional_map)


@pytest.mark.parametrize("setting", SETTINGS)
def test_every_iteration_agrees_with_the_reference(reference, setting):
    t = None
    for iteration in range(1, 6):
        t, c = run(reference, setting, 1, start=t)
        assert np.mean(t == reference[f"{setting}_T"][:, iteration - 1]) >= 0.999
        np.testing.assert_allclose(c, reference[f"{setting}_C"][iteration - 1], atol=1e-8)


@pytest.mark.parametrize("setting", SETTINGS)
def test_the_sampled_variant_agrees_with_the_reference(reference, setting):
    samples_x, samples_y = (
        jnp.asarray(reference[f"{setting}_samples{number}"].astype(np.int32)) for number in (1, 2)
    )
    t, c = run(reference, setting, 5, samples=(samples_x, samples_y))
    assert np.mean(t == reference[f"{setting}_Tfast"]) >= 0.999
    np.testing.assert_allclose(c, reference[f"{setting}_Cfast"], atol=1e-8)


@pytest.mark.sampled
@pytest.mark.parametrize("setting", SETTINGS)
def test_float32_agrees_at_nearly_all_vertices(reference, setting):
    t, _ = run(reference, setting, 5, np.float32)
    assert np.mean(t == reference[f"{setting}_T"][:, 4]) >= 0.99


@pytest.fixture
def mean_error(shared, name):
    """Return a function that computes the mean geodesic error of a map at 1000 vertices."""
    directory = shared / "data" / "faust_r"
    mesh_x, mesh_y = (read_mesh(directory / "off" / f"{shape}.off") for shape in PAIRS[name])
    truth = read_ground_truth(
        [directory / "corres" / f"{shape}.vts" for shape in PAIRS[name]], mesh_x, mesh_y
    )
    return lambda t: geodesic_error(mesh_y, t, truth, number_of_samples=1000).mean


@pytest.mark.sampled
def test_float32_is_as_accurate(reference, mean_error):
    single, double = (mean_error(run(reference, "paper", 3, dtype)[0]) for dtype in (np.float32, np.float64))
    assert single == pytest.approx(double, rel=0.01)


@pytest.mark.sampled
def test_pushforward_reaches_fewer_targets_with_larger_errors(reference, mean_error):
    """With the pushforward, C shrinks the queries, so a few targets with small norms attract most queries."""
    pullback, _ = run(reference, "paper", 5)
    pushforward, _ = run(reference, "paper", 5, convention="pushforward")
    assert mean_error(pushforward) > 2 * mean_error(pullback)
    assert len(np.unique(pushforward)) < 0.8 * len(np.unique(pullback))


@pytest.mark.sampled
def test_common_lambda_max_changes_little_for_bodies_of_the_same_size(reference, mean_error):
    """Both bodies have the same size, so their largest eigenvalues are nearly equal."""
    own, _ = run(reference, "paper", 3)
    common, _ = run(reference, "paper", 3, lambda_max="common")
    assert not np.array_equal(own, common)
    assert mean_error(common) < 2 * mean_error(own)


def test_area_weighted_pseudo_inverse_is_close_but_not_equal(reference):
    t, c = run(reference, "paper", 1, pseudo_inverse="area")
    difference = np.abs(c - reference["paper_C"][0]).max()
    assert 1e-6 < difference < 0.3
    assert np.mean(t == reference["paper_T"][:, 0]) > 0.5
