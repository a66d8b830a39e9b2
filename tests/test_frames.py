import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from sampled_cases import first_always
from synthetic import to_namespace

from jaxsmw.core.arrays import is_traced
from jaxsmw.core.arrays import namespace as namespace_of
from jaxsmw.core.banks import (
    CubicSpline,
    FilterBank,
    FrameBounds,
    Gabor,
    HalfCosine,
    Heat,
    Identity,
    Itersine,
    LowPass,
    MexicanHat,
    Meyer,
    SpectralDistribution,
    Warped,
    frame_bounds,
    frame_function,
    tighten,
)

EIGENVALUES = jnp.asarray(np.cumsum(np.random.default_rng(0).uniform(0, 2, 40)) - 0.5).at[0].set(0)
COVERING = [
    CubicSpline(),
    MexicanHat(8, 30),
    Heat([1, 10]),
    Gabor(5, 0.4),
    Warped(Gabor(), SpectralDistribution()),
]


compiled_respond = jax.jit(lambda bank, eigenvalues: bank(eigenvalues, eigenvalues))


def respond(bank, eigenvalues):
    """Samples a bank at the eigenvalues, for arrays of JAX with one program, not one for each operation."""
    return compiled_respond(bank, eigenvalues) if is_traced(eigenvalues) else bank(eigenvalues, eigenvalues)


class Impulse(FilterBank):
    """One filter with response 3 at the largest eigenvalue and 0.5 everywhere else."""

    def __call__(self, points, eigenvalues):
        return namespace_of(points).where(points == eigenvalues[-1], 3.0, 0.5)[None, :]


def test_the_frame_function_is_the_sum_of_squares():
    responses = jnp.asarray([[1.0, 2.0, 0.0], [3.0, -1.0, 0.0]])
    np.testing.assert_array_equal(frame_function(responses), [10, 5, 0])


@pytest.mark.parametrize("over", ["eigenvalues", "interval"])
@pytest.mark.parametrize("bank", first_always([Meyer(), Itersine(), HalfCosine(4), Identity()]))
def test_bounds_of_parseval_banks_are_one(bank, over, namespace):
    eigenvalues = to_namespace(EIGENVALUES, namespace)
    bounds = frame_bounds(bank, eigenvalues, over=over)
    assert isinstance(bounds, FrameBounds)
    np.testing.assert_allclose(bounds, 1, atol=1e-12)


def test_bounds_are_the_extrema_at_the_eigenvalues_or_on_the_interval(namespace):
    eigenvalues = to_namespace(EIGENVALUES, namespace)
    at_eigenvalues = frame_bounds(Heat([2.0]), eigenvalues[5:])
    first = float(eigenvalues[5] / eigenvalues[-1])
    np.testing.assert_allclose(at_eigenvalues, [np.exp(-4), np.exp(-4 * first)])
    np.testing.assert_allclose(frame_bounds(Heat([2.0]), eigenvalues[5:], over="interval"), [np.exp(-4), 1])
    np.testing.assert_allclose(frame_bounds(Impulse(), eigenvalues, over="interval"), [0.25, 9])
    bank = CubicSpline()
    inner, outer = frame_bounds(bank, eigenvalues), frame_bounds(bank, eigenvalues, over="interval")
    assert outer.lower < inner.lower < inner.upper < outer.upper
    np.testing.assert_allclose(outer, [1.281025, 2.123018], atol=1e-5)
    np.testing.assert_allclose(
        frame_bounds(MexicanHat(), eigenvalues, over="interval"), [0.176830, 0.270027], atol=1e-5
    )


@pytest.mark.parametrize("bank", first_always([CubicSpline(8), MexicanHat(8), Gabor(8), Heat([1, 10, 50])]))
def test_the_default_resolution_is_as_fine_as_documented(bank):
    coarse = frame_bounds(bank, EIGENVALUES, over="interval")
    fine = frame_bounds(bank, EIGENVALUES, over="interval", resolution=100_001)
    np.testing.assert_allclose(coarse, fine, rtol=1e-5)
    rough = frame_bounds(CubicSpline(), EIGENVALUES, over="interval", resolution=5)
    assert rough.upper < frame_bounds(CubicSpline(), EIGENVALUES, over="interval").upper - 0.01


def test_bounds_are_traced_and_keep_the_precision():
    single = jax.jit(lambda bank, e: frame_bounds(bank, e, over="interval"))(
        CubicSpline(), EIGENVALUES.astype(jnp.float32)
    )
    assert single.lower.dtype == jnp.float32
    np.testing.assert_allclose(single, [1.281025, 2.123018], atol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"over": "graph"}, "eigenvalues"), ({"over": "interval", "resolution": 1}, "at least 2")],
)
def test_invalid_options_are_refused(options, message):
    # In tests, the run-time type check refuses an unknown word before frame_bounds does.
    with pytest.raises((ValueError, TypeError), match=message):
        frame_bounds(Meyer(), EIGENVALUES, **options)


@pytest.mark.parametrize("bank", COVERING)
def test_tightened_banks_are_parseval_and_proportional(bank, namespace):
    eigenvalues = to_namespace(EIGENVALUES, namespace)
    plain, tight = respond(bank, eigenvalues), respond(tighten(bank), eigenvalues)
    np.testing.assert_allclose(frame_function(tight), 1, atol=1e-12)
    np.testing.assert_allclose(tight * np.sqrt(frame_function(plain))[None, :], plain, atol=1e-12)
    single = respond(tighten(bank), eigenvalues.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(frame_function(single), 1, atol=1e-6)


@pytest.mark.parametrize(
    "bank", [Meyer(), Itersine(overlap=4), HalfCosine(), Identity(), tighten(CubicSpline())]
)
def test_tightening_does_not_change_a_parseval_bank(bank, namespace):
    eigenvalues = to_namespace(EIGENVALUES, namespace)
    expected = respond(bank, eigenvalues)
    np.testing.assert_allclose(respond(tighten(bank), eigenvalues), expected, atol=1e-14)


def test_tightened_banks_are_pytrees_and_differentiable():
    bank = tighten(Gabor(4, 0.4))
    assert len(jax.tree.leaves(bank)) == 1
    np.testing.assert_allclose(respond(bank, EIGENVALUES), bank(EIGENVALUES, EIGENVALUES), atol=1e-14)
    check_grads(
        lambda *arguments: respond(*jax.tree.map(jnp.asarray, arguments)),
        (bank, EIGENVALUES[:9]),
        order=1,
        eps=1e-6,
        rtol=1e-5,
    )


def test_tightened_responses_vanish_with_the_frame_function():
    bank = LowPass(0.25)
    responses = tighten(bank)(EIGENVALUES, EIGENVALUES)
    passed = np.asarray(EIGENVALUES) < 0.49 * float(EIGENVALUES[-1])
    np.testing.assert_allclose(responses[0, passed], 1, atol=1e-15)
    slope = jax.jit(jax.grad(lambda b, e: jnp.sum(tighten(b)(e, e)), argnums=(0, 1)))
    slopes = slope(bank, EIGENVALUES)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
    # These filters underflow far from their centres, and their squares underflow closer to the centres.
    narrow = Gabor(3, 0.007)
    points = jnp.asarray([0.0, 0.25, 0.3, 0.4, 0.49, 1.0])
    plain, tight = narrow(points, points), tighten(narrow)(points, points)
    assert frame_function(plain)[3] == 0 < plain[1, 3]
    np.testing.assert_array_equal(frame_function(tight), jnp.asarray([1.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
    slopes = jax.grad(lambda b, p: jnp.sum(tighten(b)(p, p)), argnums=(0, 1))(narrow, points)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
    assert slopes[1][1] == 0


class Constant(FilterBank):
    """Two filters with the same constant response."""

    value: jax.Array

    def __call__(self, points, eigenvalues):
        return namespace_of(points).full((2, len(points)), self.value)


def test_tightening_does_not_hide_nan(namespace):
    eigenvalues = to_namespace(EIGENVALUES, namespace)
    bank = Constant(jnp.asarray(jnp.nan))
    assert np.isnan(tighten(bank)(eigenvalues, eigenvalues)).all()
    assert np.isnan(frame_bounds(tighten(bank), eigenvalues)).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_tightened_low_pass_filter_still_stops_high_eigenvalues(dtype, namespace):
    eigenvalues = to_namespace(EIGENVALUES, namespace).astype(dtype)
    for bank in (LowPass(), tighten(LowPass())):
        assert frame_bounds(bank, eigenvalues).lower == 0
        assert (bank(eigenvalues, eigenvalues) >= 0).all()


@pytest.mark.parametrize("shape", [lambda p: (len(p),), lambda p: (3, 5)], ids=["flat", "short"])
def test_responses_of_a_wrong_shape_are_refused(shape):
    class Misshapen(FilterBank):
        def __call__(self, points, eigenvalues):
            return jnp.ones(shape(points))

    with pytest.raises(
        ValueError, match=r"Misshapen returned responses of shape .* \(filters, 40\) is needed"
    ):
        frame_bounds(Misshapen(), EIGENVALUES)
