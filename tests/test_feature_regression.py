import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from synthetic import random_spectrum, stacked

from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum

M, K, D = 250, 12, 5


@pytest.fixture
def pair():
    """Two spectra with descriptors, an initial map and the true map.

    Y is X in another vertex order, with mixed features and noise. In the initial map, 40 % of the matches are
    random.
    """
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
    initial_map = np.where(generator.random(M) < 0.4, generator.integers(0, M, M), truth)
    return x, y, jnp.asarray(initial_map, jnp.int32), truth


def features(spectrum):
    return np.hstack([spectrum.eigenvectors * np.sqrt(spectrum.vertex_areas.sum()), spectrum.descriptors])


def predicted(moments_xx, moments_xy, moments_yy):
    """Return the matrix that predicts features of X from features of Y, and the precision of the residual."""

    def least_squares(cross, gram):
        return cross @ np.linalg.inv(gram + 1e-3 * np.eye(len(gram)))

    matrix = np.zeros(moments_xy.shape)
    matrix[:K, :K] = least_squares(moments_xy[:K, :K], moments_yy[:K, :K])
    matrix[K:, K:] = least_squares(moments_xy[K:, K:], moments_yy[K:, K:])
    residual = moments_xx - matrix @ moments_xy.T - moments_xy @ matrix.T + matrix @ moments_yy @ matrix.T
    return matrix, np.linalg.inv(residual + 0.03 * np.eye(len(residual)))


@pytest.mark.parametrize("partial", [False, True], ids=["full", "partial"])
def test_refinement_agrees_with_the_definition(pair, partial, refine):
    """The reference computes two iterations without whitening, masks or blocks."""
    x, y, initial_map, _ = pair
    a, b = features(x), features(y)
    w_x, w_y = (np.asarray(s.vertex_areas / s.vertex_areas.sum()) for s in (x, y))
    t = np.asarray(initial_map)
    reverse_map = None
    for _ in range(2):
        if partial and reverse_map is not None:
            forward_squared = cdist(a, b @ matrix.T, "mahalanobis", VI=precision)[np.arange(M), t] ** 2
            distances = cdist(b, a @ reverse_matrix.T, "mahalanobis", VI=reverse_precision)
            backward_squared = distances[np.arange(M), reverse_map] ** 2
            # The residuals of the reverse map are larger than those of the forward map, so only w_y changes.
            assert w_x @ forward_squared < w_y @ backward_squared
            w_y = w_y / (1 + (backward_squared / (w_x @ forward_squared)) ** 2)
            w_y /= w_y.sum()
        xx, xy, yy = (p.T @ (w_x[:, None] * q) for p, q in ((a, a), (a, b[t]), (b[t], b[t])))
        if reverse_map is not None:
            pairs = (a[reverse_map], a[reverse_map]), (a[reverse_map], b), (b, b)
            xx, xy, yy = (
                (m + p.T @ (w_y[:, None] * q)) / 2 for m, (p, q) in zip((xx, xy, yy), pairs, strict=True)
            )
        matrix, precision = predicted(xx, xy, yy)
        t = cdist(a, b @ matrix.T, "mahalanobis", VI=precision).argmin(axis=1)
        reverse_matrix, reverse_precision = predicted(yy, xy.T, xx)
        reverse_map = cdist(b, a @ reverse_matrix.T, "mahalanobis", VI=reverse_precision).argmin(axis=1)
    found = refine(
        x, y, initial_map, refiner=FeatureRegression(), iterations=2, partial=partial, history=True
    )
    np.testing.assert_array_equal(found.pointwise_map, t)
    np.testing.assert_allclose(found.functional_map, matrix[:K, :K], atol=1e-10)
    distances = cdist(a, b @ matrix.T, "mahalanobis", VI=precision)[np.arange(M), t]
    np.testing.assert_allclose(found.history.objective[1], w_x @ distances**2, rtol=1e-8)
    log_determinants = np.linalg.slogdet(precision)[1] + np.linalg.slogdet(reverse_precision)[1]
    per_feature = -log_determinants / 2 / (a.shape[1] + b.shape[1])
    np.testing.assert_allclose(found.history.energy[1], per_feature, rtol=1e-8)


def test_recovers_a_copy_with_mixed_features_better_with_descriptors(pair, refine):
    x, y, initial_map, truth = pair
    found = refine(x, y, initial_map, refiner=FeatureRegression(), iterations=5)
    assert found.result == RESULTS.successful
    assert np.mean(np.asarray(found.pointwise_map) == truth) > 0.95
    blind = refine(
        x.with_descriptors(None),
        y.with_descriptors(None),
        initial_map,
        refiner=FeatureRegression(),
        iterations=5,
    )
    assert np.mean(np.asarray(blind.pointwise_map) == truth) < np.mean(
        np.asarray(found.pointwise_map) == truth
    )


def test_a_level_equals_a_truncated_spectrum(pair, refine):
    x, y, initial_map, _ = pair
    found = refine(x, y, initial_map, refiner=FeatureRegression((5, 5, 5)), iterations=3)
    truncated = refine(x.truncate(5), y.truncate(5), initial_map, refiner=FeatureRegression(), iterations=3)
    np.testing.assert_array_equal(found.pointwise_map, truncated.pointwise_map)
    np.testing.assert_allclose(found.functional_map[:5, :5], truncated.functional_map, atol=1e-10)
    assert not found.functional_map[5:].any() and not found.functional_map[:, 5:].any()


def test_levels_are_proportionally_smaller_on_the_smaller_spectrum(pair, refine):
    x, y, initial_map, _ = pair
    found = refine(x.truncate(6), y, initial_map, refiner=FeatureRegression((4,)), iterations=1)
    assert found.functional_map.shape == (6, K)
    assert found.functional_map[:2, :4].any()
    assert not found.functional_map[2:].any() and not found.functional_map[:, 4:].any()


def test_does_not_stop_before_the_last_level(pair, refine):
    x, y, initial_map, _ = pair
    refiner = FeatureRegression((3, 3, 3, 3, 3, 3, 3, 3))
    found = refine(x, y, initial_map, refiner=refiner, iterations=40, stop_when_unchanged=True)
    assert 9 < found.iterations < 40


def test_samples_are_queries_and_all_vertices_are_targets(pair, refine):
    x, y, initial_map, truth = pair
    samples = jnp.arange(0, M, 2), jnp.arange(1, M, 2)
    found = refine(
        x, y, initial_map, refiner=FeatureRegression(), iterations=4, samples=(samples[0], samples[1])
    )
    assert np.mean(np.asarray(found.pointwise_map) == truth) > 0.9


def test_vmap_equals_a_loop(pair):
    x, y, initial_map, _ = pair
    pairs = [(x, y), (y, x)]
    both = eqx.filter_vmap(lambda *arguments: refine(*arguments, refiner=FeatureRegression((4, 8))))(
        *(stacked(*side) for side in zip(*pairs, strict=True)), jnp.stack([initial_map, initial_map])
    )
    for row, (one, other) in enumerate(pairs):
        alone = refine(one, other, initial_map, refiner=FeatureRegression((4, 8)))
        np.testing.assert_array_equal(both.pointwise_map[row], alone.pointwise_map)


def test_arrays_with_a_wrong_number_of_rows_are_refused(pair):
    x, _, _, _ = pair
    with pytest.raises(
        ValueError, match=rf"descriptors have shape \(3, 2\), but \({M}, d\) .* one row for each vertex"
    ):
        x.with_descriptors(jnp.zeros((3, 2)))
    with pytest.raises(ValueError, match=rf"positions have shape .*, but \({M}, 3\) .* one row for each"):
        x.with_positions(jnp.zeros((M - 1, 3)), jnp.zeros((M - 1, 3)))


def test_nan_in_descriptors_is_reported(pair, refine):
    x, y, initial_map, _ = pair
    broken = x.with_descriptors(x.descriptors.at[3, 1].set(jnp.nan))
    found = refine(broken, y, initial_map, refiner=FeatureRegression())
    assert found.result == RESULTS.nonfinite_spectrum and (np.asarray(found.pointwise_map) == -1).all()


def test_invalid_descriptors_and_settings_are_refused(pair, refine):
    x, y, initial_map, _ = pair
    with pytest.raises(ValueError, match="X has 5 descriptors and Y has 0"):
        refine(x, y.with_descriptors(None), initial_map, refiner=FeatureRegression())
    with pytest.raises(ValueError, match="needs at least 1 eigenvector"):
        FeatureRegression((20, 0))
