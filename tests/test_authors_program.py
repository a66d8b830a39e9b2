"""Agreement with what the MWP authors' own program computed on real pairs."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsmw.core.refinement import RESULTS, WaveletPreservation, refine
from jaxsmw.core.spectrum import Spectrum

SETTINGS = {"demo": 128, "paper": 100}


@pytest.fixture(params=["faust_r_002_007", "faust_r_000_004"])
def reference(shared, request):
    return dict(np.load(shared / "oracle" / f"{request.param}.npz"))


def spectrum(reference: dict, side: str, k: int, dtype: type) -> Spectrum:
    areas = reference[f"{side}_vertex_areas"]
    return Spectrum(
        jnp.asarray(reference[f"{side}_eigenvalues"][:k], dtype),
        jnp.asarray(reference[f"{side}_eigenvectors"][:, :k], dtype),
        jnp.asarray(areas, dtype),
        jnp.ones(len(areas), bool),
    )


def run(reference: dict, setting: str, iterations: int, dtype: type = np.float64, **options):
    x, y = (spectrum(reference, side, SETTINGS[setting], dtype) for side in "xy")
    start = jnp.asarray(reference["T0"].astype(np.int32))
    refiner = WaveletPreservation(pseudo_inverse=options.pop("pseudo_inverse", "least_squares"))
    refined = refine(x, y, start, refiner=refiner, iterations=iterations, **options)
    assert refined.result == RESULTS.successful
    return np.asarray(refined.pointwise_map), np.asarray(refined.functional_map)


@pytest.mark.parametrize("setting", SETTINGS)
def test_every_iteration(reference, setting):
    for iteration in range(1, 6):
        t, c = run(reference, setting, iteration)
        assert np.mean(t == reference[f"{setting}_T"][:, iteration - 1]) >= 0.999
        np.testing.assert_allclose(c, reference[f"{setting}_C"][iteration - 1], atol=1e-8)


@pytest.mark.parametrize("setting", SETTINGS)
def test_sampled_variant(reference, setting):
    samples = {
        f"samples_{side}": jnp.asarray(reference[f"{setting}_samples{number}"].astype(np.int32))
        for side, number in (("x", 1), ("y", 2))
    }
    t, c = run(reference, setting, 5, **samples)
    assert np.mean(t == reference[f"{setting}_Tfast"]) >= 0.999
    np.testing.assert_allclose(c, reference[f"{setting}_Cfast"], atol=1e-8)


@pytest.mark.parametrize("setting", SETTINGS)
def test_float32_agrees_at_nearly_all_vertices(reference, setting):
    t, _ = run(reference, setting, 5, np.float32)
    assert np.mean(t == reference[f"{setting}_T"][:, 4]) >= 0.99


def test_area_weighted_pseudo_inverse_is_close_but_not_equal(reference):
    t, c = run(reference, "paper", 1, pseudo_inverse="area")
    difference = np.abs(c - reference["paper_C"][0]).max()
    assert 1e-6 < difference < 0.3
    assert np.mean(t == reference["paper_T"][:, 0]) > 0.5
