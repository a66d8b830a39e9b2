"""Refinement by regression of features."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from scipy.spatial.distance import cdist
from synthetic import random_spectrum

from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum

M, K, D = 250, 12, 5


@pytest.fixture
def pair():
    """A shape with descriptors; a copy of it in another order, whose features are mixed and disturbed."""
    generator = np.random.default_rng(0)
    x = random_spectrum(M, K).with_descriptors(jnp.asarray(generator.normal(size=(M, D))))
    order = generator.permutation(M)
    mixing = np.linalg.qr(generator.normal(size=(K, K)))[0]
    y = Spectrum(
        x.eigenvalues,
        x.eigenvectors[order] @ mixing + 0.3 * generator.normal(size=(M, K)),
        x.vertex_areas[order],
        x.mask[order],
        x.descriptors[order] @ generator.normal(size=(D, D)) + 0.3 * generator.normal(size=(M, D)),
    )
    truth = np.argsort(order)
    start = np.where(generator.random(M) < 0.4, generator.integers(0, M, M), truth)
    return x, y, jnp.asarray(start, jnp.int32), truth


def features(spectrum):
    return np.hstack([spectrum.eigenvectors * np.sqrt(spectrum.vertex_areas.sum()), spectrum.descriptors])


def predicted(moments_xx, moments_xy, moments_yy):
    """The matrix that predicts x, and the precision of its residual, from their definitions."""

    def least_squares(cross, gram):
        return cross @ np.linalg.inv(gram + 1e-3 * np.eye(len(gram)))

    matrix = np.zeros(moments_xy.shape)
    matrix[:K, :K] = least_squares(moments_xy[:K, :K], moments_yy[:K, :K])
    matrix[K:, K:] = least_squares(moments_xy[K:, K:], moments_yy[K:, K:])
    residual = moments_xx - matrix @ moments_xy.T - moments_xy @ matrix.T + matrix @ moments_yy @ matrix.T
    return matrix, np.linalg.inv(residual + 0.03 * np.eye(len(residual)))


@pytest.mark.parametrize("partial", [False, True], ids=["whole", "part"])
def test_is_what_its_definition_says(pair, partial):
    """Two turns, written out without whitening, masks or blocks."""
    x, y, start, _ = pair
    a, b = features(x), features(y)
    w_x, w_y = (np.asarray(s.vertex_areas / s.vertex_areas.sum()) for s in (x, y))
    t = np.asarray(start)
    back = None
    for _ in range(2):
        if partial and back is not None:
            forth_squared = cdist(a, b @ matrix.T, "mahalanobis", VI=precision)[np.arange(M), t] ** 2
            back_squared = (
                cdist(b, a @ matrix_back.T, "mahalanobis", VI=precision_back)[np.arange(M), back] ** 2
            )
            # Here the way back fits worse.
            assert w_x @ forth_squared < w_y @ back_squared
            w_y = w_y / (1 + (back_squared / (w_x @ forth_squared)) ** 2)
            w_y /= w_y.sum()
        xx, xy, yy = (p.T @ (w_x[:, None] * q) for p, q in ((a, a), (a, b[t]), (b[t], b[t])))
        if back is not None:
            pairs = (a[back], a[back]), (a[back], b), (b, b)
            xx, xy, yy = (
                (m + p.T @ (w_y[:, None] * q)) / 2 for m, (p, q) in zip((xx, xy, yy), pairs, strict=True)
            )
        matrix, precision = predicted(xx, xy, yy)
        t = cdist(a, b @ matrix.T, "mahalanobis", VI=precision).argmin(axis=1)
        matrix_back, precision_back = predicted(yy, xy.T, xx)
        back = cdist(b, a @ matrix_back.T, "mahalanobis", VI=precision_back).argmin(axis=1)
    found = refine(x, y, start, refiner=FeatureRegression(), iterations=2, partial=partial, history=True)
    np.testing.assert_array_equal(found.pointwise_map, t)
    np.testing.assert_allclose(found.functional_map, matrix[:K, :K], atol=1e-10)
    distances = cdist(a, b @ matrix.T, "mahalanobis", VI=precision)[np.arange(M), t]
    np.testing.assert_allclose(found.history.objective[1], w_x @ distances**2, rtol=1e-8)
    log_determinants = np.linalg.slogdet(precision)[1] + np.linalg.slogdet(precision_back)[1]
    per_feature = -log_determinants / 2 / (a.shape[1] + b.shape[1])
    np.testing.assert_allclose(found.history.energy[1], per_feature, rtol=1e-8)


def test_mends_a_copy_whose_features_are_mixed(pair):
    x, y, start, truth = pair
    found = refine(x, y, start, refiner=FeatureRegression(), iterations=5)
    assert found.result == RESULTS.successful
    assert np.mean(np.asarray(found.pointwise_map) == truth) > 0.95
    blind = refine(
        x.with_descriptors(None), y.with_descriptors(None), start, refiner=FeatureRegression(), iterations=5
    )
    assert np.mean(np.asarray(blind.pointwise_map) == truth) < np.mean(
        np.asarray(found.pointwise_map) == truth
    )


def test_levels_are_truncated_spectra(pair):
    """Eigenvectors that do not count might as well not be there."""
    x, y, start, _ = pair
    found = refine(x, y, start, refiner=FeatureRegression((5, 5, 5)), iterations=3)
    truncated = refine(x.truncate(5), y.truncate(5), start, refiner=FeatureRegression(), iterations=3)
    np.testing.assert_array_equal(found.pointwise_map, truncated.pointwise_map)
    np.testing.assert_allclose(found.functional_map[:5, :5], truncated.functional_map, atol=1e-10)
    assert not found.functional_map[5:].any() and not found.functional_map[:, 5:].any()


def test_levels_count_in_proportion_on_the_smaller_spectrum(pair):
    x, y, start, _ = pair
    found = refine(x.truncate(6), y, start, refiner=FeatureRegression((4,)), iterations=1)
    assert found.functional_map.shape == (6, K)
    assert found.functional_map[:2, :4].any()
    assert not found.functional_map[2:].any() and not found.functional_map[:, 4:].any()


def test_does_not_stop_before_the_last_level(pair):
    x, y, start, _ = pair
    refiner = FeatureRegression((3, 3, 3, 3, 3, 3, 3, 3))
    found = refine(x, y, start, refiner=refiner, iterations=40, stop_when_unchanged=True)
    assert 9 < found.iterations < 40


def test_samples_ask_and_all_vertices_answer(pair):
    x, y, start, truth = pair
    samples = jnp.arange(0, M, 2), jnp.arange(1, M, 2)
    found = refine(x, y, start, refiner=FeatureRegression(), iterations=4, samples=(samples[0], samples[1]))
    assert np.mean(np.asarray(found.pointwise_map) == truth) > 0.9


def test_patches_decide_by_eigenvectors_alone(pair):
    """With matches of eigenvectors in the metric that descriptors have no part in."""
    x, y, start, truth = pair
    maps = [
        refine(x, y, start, refiner=FeatureRegression(search=search), iterations=1).pointwise_map
        for search in ("exhaustive", "patches")
    ]
    blind = refine(
        x.with_descriptors(None), y.with_descriptors(None), start, refiner=FeatureRegression(), iterations=1
    )
    np.testing.assert_array_equal(maps[1], blind.pointwise_map)
    assert np.mean(np.asarray(maps[0]) == truth) > np.mean(np.asarray(maps[1]) == truth)


def test_vmap_is_the_loop(pair):
    x, y, start, _ = pair
    pairs = [(x, y), (y, x)]
    stacked = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *side) for side in zip(*pairs, strict=True)]
    both = eqx.filter_vmap(lambda *arguments: refine(*arguments, refiner=FeatureRegression((4, 8))))(
        *stacked, jnp.stack([start, start])
    )
    for row, (one, other) in enumerate(pairs):
        alone = refine(one, other, start, refiner=FeatureRegression((4, 8)))
        np.testing.assert_array_equal(both.pointwise_map[row], alone.pointwise_map)


def test_rows_that_are_not_those_of_the_vertices_are_refused(pair):
    x, _, _, _ = pair
    with pytest.raises(
        ValueError, match=rf"descriptors have shape \(3, 2\); one row per vertex .*\({M}, d\)"
    ):
        x.with_descriptors(jnp.zeros((3, 2)))
    with pytest.raises(ValueError, match=rf"positions have shape .*; one row per vertex .*\({M}, 3\)"):
        x.with_positions(jnp.zeros((M - 1, 3)), jnp.zeros((M - 1, 3)))


def test_descriptors_that_are_no_numbers_are_reported(pair):
    x, y, start, _ = pair
    broken = x.with_descriptors(x.descriptors.at[3, 1].set(jnp.nan))
    found = refine(broken, y, start, refiner=FeatureRegression())
    assert found.result == RESULTS.nonfinite_spectrum and (np.asarray(found.pointwise_map) == -1).all()


def test_what_cannot_work_is_refused(pair):
    x, y, start, _ = pair
    with pytest.raises(ValueError, match="X has 5 descriptors and Y has 0"):
        refine(x, y.with_descriptors(None), start, refiner=FeatureRegression())
    with pytest.raises(ValueError, match="needs at least 1 eigenvector"):
        FeatureRegression((20, 0))
    with pytest.raises((ValueError, TypeCheckError), match="search"):
        FeatureRegression(search="quick")
