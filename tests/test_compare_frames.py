"""The script `compare_frames` compares the intended variants, and its page is made from stored comparisons."""

import re
import sys
from pathlib import Path

import compare_frames
import jax.numpy as jnp
import numpy as np
import pytest
from compare_frames import FILTERS, TIMED, BandMask, Scaled, frames, parameters, variants
from synthetic import random_spectrum

from jaxsmw import Meyer, WaveletPreservation
from jaxsmw.banks import frame_bounds, frame_function
from jaxsmw.benchmark import Comparison
from jaxsmw.core.refiner import Problem

pytestmark = pytest.mark.study

ROOT = Path(__file__).parents[1]


def functional_map(refiner: WaveletPreservation) -> np.ndarray:
    x, y = random_spectrum(150, 60, seed=1), random_spectrum(170, 60, seed=2)
    start = jnp.asarray(np.random.default_rng(0).integers(0, 170, 150))
    return np.asarray(refiner.update(refiner.prepare(Problem(x, y)), start, None)[0].functional_map)


def test_a_scaled_bank_has_the_given_mean_and_multiplies_the_functional_map():
    eigenvalues = np.asarray(random_spectrum(150, 60, seed=1).eigenvalues)
    for name, bank in frames().items():
        if name.endswith(", scaled"):
            assert np.mean(frame_function(bank(eigenvalues, eigenvalues))) == pytest.approx(1)
    plain, doubled = (WaveletPreservation(Scaled(Meyer(FILTERS), factor)) for factor in (1.0, 2.0))
    expected = functional_map(WaveletPreservation(Meyer(FILTERS)))
    np.testing.assert_allclose(functional_map(plain), expected, atol=1e-9)
    np.testing.assert_allclose(functional_map(doubled), 2 * expected, atol=1e-9)


def test_the_band_mask_is_as_wide_as_the_kernel_but_belongs_to_no_frame():
    x, y = random_spectrum(300, 60, seed=1), random_spectrum(300, 60, seed=2)
    for convention in ("pullback", "pushforward"):
        refiners = [
            WaveletPreservation(Meyer(FILTERS), convention=convention),
            WaveletPreservation(Meyer(FILTERS), BandMask(), convention=convention),
        ]
        kernel, mask = (np.asarray(one.prepare(Problem(x, y)).solution.kernel) for one in refiners)
        assert mask.min() >= 0 and mask.max() <= 1
        np.testing.assert_allclose(mask.sum(), kernel.sum(), rtol=1e-6)
        kernel, mask = (np.asarray(one.prepare(Problem(x, x)).solution.kernel) for one in refiners)
        np.testing.assert_allclose(mask, mask.T, atol=1e-9)
        eigenvalues = np.linalg.eigvalsh(mask)
        assert eigenvalues[0] < -0.01 * eigenvalues[-1]
        assert np.linalg.eigvalsh(kernel)[0] > -1e-9


def test_the_stored_results_belong_to_the_variants():
    stored = Comparison.read(ROOT / "docs/frames/variants")
    assert set(stored.methods) == set(variants()) and len(stored.pairs) == 80
    assert set(Comparison.read(ROOT / "docs/frames/parameters").methods) == set(parameters())
    assert set(Comparison.read(ROOT / "docs/frames/times").methods) == set(TIMED)
    tight = [
        name
        for name, bank in frames().items()
        if np.allclose(frame_bounds(bank, jnp.arange(100.0)), 1, atol=1e-5)
    ]
    assert {"Meyer", "itersine", "Gabor, tightened", "no filter"} <= set(tight)
    assert not {"cubic spline", "Gabor", "Gabor, scaled", "low-pass (1 filter)"} & set(tight)


def test_the_page_shows_stored_methods_only():
    """Cells of the page name methods of the stored comparisons. The site runs the cells."""
    page = (ROOT / "docs/frame_study.md").read_text("utf-8")
    method = r'"([^"{}]+: (?:filtering|least squares|regularized|nearest orthogonal)[^"{}]*)"'
    named = set(re.findall(method, page))
    assert len(named) > 10 and named <= set(variants())


@pytest.mark.sampled
def test_measured_errors_are_the_stored_ones(shared, tmp_path, monkeypatch):
    command = [
        "compare_frames.py",
        str(shared / "data"),
        "--quick",
        "--workers",
        "1",
        "--output",
        str(tmp_path),
    ]
    monkeypatch.setattr(sys, "argv", command)
    compare_frames.main()
    measured = Comparison.read(tmp_path / "variants")
    stored = Comparison.read(ROOT / "docs/frames/variants").select(measured.methods, measured.pairs)
    for name in measured.methods:
        np.testing.assert_allclose(measured.errors(name), stored.errors(name), rtol=0.02, atol=0.5)
    assert measured.table().strip() in (tmp_path / "summary.md").read_text("utf-8")
