import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxsmw.core.filters import Meyer, frame_function


@given(
    filters=st.integers(2, 9),
    lambda_max=st.floats(1e-3, 1e4),
    seed=st.integers(0, 2**31),
)
def test_meyer_squares_sum_to_one(filters, lambda_max, seed):
    eigenvalues = jnp.asarray(np.random.default_rng(seed).uniform(0, lambda_max, 50))
    responses = Meyer(filters)(eigenvalues, jnp.asarray(lambda_max))
    assert responses.shape == (filters, 50)
    np.testing.assert_allclose(frame_function(responses), 1, atol=1e-12)


def test_meyer_is_tight_in_float32():
    eigenvalues = jnp.linspace(0, 7, 100, dtype=jnp.float32)
    responses = Meyer(6)(eigenvalues, jnp.float32(7))
    assert responses.dtype == jnp.float32
    np.testing.assert_allclose(frame_function(responses), 1, atol=1e-6)


def test_scaling_function_passes_the_lowest_band_and_each_filter_its_octaves():
    filters, lambda_max = 6, 64.0
    eigenvalues = jnp.linspace(0, lambda_max, 641)
    responses = np.asarray(Meyer(filters)(eigenvalues, jnp.asarray(lambda_max)))
    grid = np.asarray(eigenvalues)
    assert responses[0, 0] == 1 and (responses[1:, 0] == 0).all()
    assert responses[-1, -1] == pytest.approx(1) and np.allclose(responses[:-1, -1], 0)
    for index in range(filters):
        first_edge = lambda_max / 2 ** (filters - index)
        below = 0 if index == 0 else first_edge
        above = lambda_max if index == filters - 1 else first_edge * 4
        outside = (grid < below - 1e-9) | (grid > above + 1e-9)
        np.testing.assert_allclose(responses[index, outside], 0, atol=1e-12)
        assert (responses[index, (grid > below + 0.2) & (grid < above - 0.2)] > 0).all()


def test_meyer_depends_on_the_ratio_to_lambda_max_only():
    eigenvalues = jnp.linspace(0, 3, 40)
    np.testing.assert_allclose(
        Meyer(5)(eigenvalues, jnp.asarray(3.0)), Meyer(5)(1e4 * eigenvalues, jnp.asarray(3e4)), atol=1e-12
    )


def test_meyer_needs_two_filters():
    with pytest.raises(ValueError, match="at least 2"):
        Meyer(1)


def test_meyer_is_differentiable_in_the_eigenvalues():
    eigenvalues = jnp.linspace(0.1, 2.9, 9)
    check_grads(lambda e: Meyer(4)(jnp.asarray(e), jnp.asarray(3.0)), (eigenvalues,), order=1)


@pytest.mark.parametrize("lambda_max", [1, 100])
@pytest.mark.parametrize("filters", [2, 3, 4, 5, 6, 7, 8])
def test_meyer_equals_the_independent_toolbox(shared, lambda_max, filters):
    reference = np.load(shared / "oracle" / f"filters_lmax{lambda_max}.npz")
    key = "meyer" if filters == 6 else f"meyer_Nf{filters}"
    responses = Meyer(filters)(jnp.asarray(reference["x"]), jnp.asarray(float(reference["lmax"])))
    np.testing.assert_allclose(responses.T, reference[key], atol=1e-12)
