import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from messages import assert_names, refused
from pygsp import filters as pygsp_filters
from pygsp import graphs as pygsp_graphs
from sampled_cases import first_always
from synthetic import to_namespace

from jaxsmw.core.arrays import is_traced
from jaxsmw.core.banks import (
    CubicSpline,
    ExponentialWindow,
    Gabor,
    HalfCosine,
    Heat,
    Held,
    Identity,
    Itersine,
    Logarithm,
    LowPass,
    MexicanHat,
    Meyer,
    Papadakis,
    Power,
    Regular,
    Simoncelli,
    SimpleTight,
    SoftmaxFrame,
    SpectralDistribution,
    Warped,
    frame_function,
)

WARPS = {
    "logarithm": Logarithm(),
    "power": Power(),
    "distribution": SpectralDistribution(),
}
# These banks are Parseval frames if they have at least 5 filters.
PARSEVAL_OF_ANY_SIZE = {
    "meyer": Meyer,
    "simple tight": SimpleTight,
    "itersine": Itersine,
    "itersine, overlap 4": lambda filters: Itersine(filters, overlap=4),
    "half cosine": HalfCosine,
    **{
        f"half cosine, {name}": lambda filters, w=warp: Warped(HalfCosine(filters), w)
        for name, warp in WARPS.items()
    },
}
PARSEVAL = {name: make(6) for name, make in PARSEVAL_OF_ANY_SIZE.items()} | {
    "held": Held(),
    "simoncelli": Simoncelli(),
    "papadakis": Papadakis(),
    "regular": Regular(),
    "identity": Identity(),
    "softmax": SoftmaxFrame(np.random.default_rng(5).uniform(0.5, 3, size=(4, 7))),
    "softmax, power": Warped(SoftmaxFrame(np.random.default_rng(6).uniform(0.5, 3, size=(3, 5))), Power()),
}
BANKS = PARSEVAL | {
    "cubic spline": CubicSpline(),
    "cubic spline, normalized": CubicSpline(4, 7, normalize=True),
    "mexican hat": MexicanHat(),
    "heat": Heat([1, 5, 20]),
    "gabor": Gabor(),
    "exponential window": ExponentialWindow(),
    "low pass": LowPass(),
    "mexican hat, power": Warped(MexicanHat(), Power(0.7)),
}


def spectrum(seed=0, k=30, lambda_max=50.0, namespace="jax"):
    """Returns k distinct, unevenly spaced eigenvalues from 0 to lambda_max."""
    steps = np.random.default_rng(seed).uniform(0.1, 2, k - 1)
    return to_namespace(np.concatenate([[0], np.cumsum(steps)]) * (lambda_max / steps.sum()), namespace)


def respond(bank, points, eigenvalues):
    return bank(points, eigenvalues)


compiled_sample = jax.jit(respond)


def sample(bank, points, eigenvalues):
    """Samples a bank, for arrays of JAX with a program that is compiled only once per bank."""
    return (compiled_sample if is_traced(points) else respond)(bank, points, eigenvalues)


each_bank = pytest.mark.parametrize("bank", BANKS.values(), ids=BANKS.keys())
each_warp = pytest.mark.parametrize("warp", WARPS.values(), ids=WARPS.keys())


@pytest.mark.parametrize("make", PARSEVAL_OF_ANY_SIZE.values(), ids=PARSEVAL_OF_ANY_SIZE.keys())
@settings(max_examples=10)
@given(filters=st.sampled_from([5, 6, 9]), lambda_max=st.floats(1e-3, 1e4), seed=st.integers(0, 2**31))
def test_squares_sum_to_one(make, filters, lambda_max, seed):
    eigenvalues = spectrum(seed, 30, lambda_max)
    points = jnp.asarray(np.random.default_rng(seed).uniform(0, lambda_max, 30))
    for where in (points, eigenvalues):
        responses = sample(make(filters), where, eigenvalues)
        assert responses.shape == (filters, 30)
        np.testing.assert_allclose(frame_function(responses), 1, atol=1e-12)


@pytest.mark.parametrize("make", PARSEVAL_OF_ANY_SIZE.values(), ids=PARSEVAL_OF_ANY_SIZE.keys())
def test_banks_with_more_filters_than_float32_has_octaves_are_parseval(make, namespace):
    eigenvalues = spectrum(namespace=namespace).astype(np.float32)
    np.testing.assert_allclose(frame_function(sample(make(200), eigenvalues, eigenvalues)), 1, atol=1e-5)


@pytest.mark.parametrize("bank_class", [Held, Simoncelli, Papadakis])
@settings(max_examples=20)
@given(edge=st.floats(0.01, 0.99), lambda_max=st.floats(1e-3, 1e4))
def test_squares_of_two_filters_sum_to_one_for_any_edge(bank_class, edge, lambda_max):
    eigenvalues = spectrum(1, 30, lambda_max)
    responses = sample(bank_class(edge), eigenvalues, eigenvalues)
    assert responses.shape == (2, 30)
    np.testing.assert_allclose(frame_function(responses), 1, atol=1e-12)
    assert responses[0, 0] == 1 and responses[1, 0] == 0


@pytest.mark.parametrize("bank", PARSEVAL.values(), ids=PARSEVAL.keys())
def test_squares_sum_to_one_in_single_precision(bank, namespace):
    eigenvalues = spectrum(2, 30, 7.0, namespace).astype(np.float32)
    np.testing.assert_allclose(frame_function(sample(bank, eigenvalues, eigenvalues)), 1, atol=1e-6)


@each_bank
def test_precision_of_the_points_is_kept(bank, namespace):
    eigenvalues = spectrum(namespace=namespace)
    double = sample(bank, eigenvalues, eigenvalues)
    single = sample(bank, *[eigenvalues.astype(np.float32)] * 2)
    assert double.dtype == np.float64 and single.dtype == np.float32
    assert type(double) is type(single) is type(eigenvalues)
    np.testing.assert_allclose(single, double, atol=3e-5)


@each_bank
def test_responses_do_not_depend_on_scale_or_order(bank, namespace):
    eigenvalues = spectrum(namespace=namespace)
    order = np.random.default_rng(0).permutation(30)
    responses = sample(bank, eigenvalues, eigenvalues)
    assert (np.asarray(responses) >= 0).all()
    shuffled = sample(bank, 1e4 * eigenvalues[order], 1e4 * eigenvalues)
    np.testing.assert_allclose(shuffled, responses[:, order], atol=1e-11)


@pytest.mark.parametrize("bank", first_always(BANKS.values(), always=4), ids=BANKS.keys())
def test_compiled_and_batched_banks_give_the_same_responses(bank):
    stack = jnp.stack([spectrum(seed) for seed in range(3)])
    banks = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), bank)
    batched = jax.jit(jax.vmap(lambda b, e: b(e, e)))(banks, stack)
    np.testing.assert_allclose(batched[0], bank(stack[0], stack[0]), atol=1e-13)
    np.testing.assert_allclose(batched[2], sample(bank, stack[2], stack[2]), atol=1e-13)


@each_bank
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_both_namespaces_give_the_same_responses(bank, dtype):
    eigenvalues = spectrum(namespace="numpy")
    eigenvalues[1:4], eigenvalues[10:15] = 0, eigenvalues[10]
    points = np.random.default_rng(0).uniform(0, eigenvalues[-1], 50)
    arrays = points.astype(dtype), eigenvalues.astype(dtype)
    responses, expected = (sample(bank, *to_namespace(arrays, name)) for name in ("numpy", "jax"))
    np.testing.assert_allclose(responses, expected, atol=3e-5 if dtype == np.float32 else 1e-13)


@each_bank
def test_differentiable_in_parameters_points_and_eigenvalues(bank):
    eigenvalues = spectrum(3)
    points = jnp.asarray(np.random.default_rng(5).uniform(0.02, 0.98, 30)) * eigenvalues[-1]
    # check_grads calls the function with NumPy arrays.
    check_grads(
        lambda *arguments: sample(*jax.tree.map(jnp.asarray, arguments)),
        (bank, points, eigenvalues),
        order=1,
        modes=["rev"],
        eps=1e-6,
        rtol=1e-4,
        atol=1e-4,
    )


@each_bank
def test_gradients_are_finite_everywhere(bank):
    simple = spectrum(k=33)
    repeated = simple.at[1:4].set(0).at[-3:].set(50.0).at[10:15].set(20.0)
    on_every_edge = jnp.arange(33.0)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=jax.eval_shape(bank, simple, simple).shape))
    slope = jax.jit(jax.value_and_grad(lambda b, e: jnp.sum(weights * b(e, e)), argnums=(0, 1)))
    for eigenvalues in (simple, repeated, on_every_edge):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope(bank, eigenvalues)))


@pytest.mark.parametrize(
    ("bank", "other"),
    [
        (Meyer(), Meyer(5)),
        (SimpleTight(), SimpleTight(5)),
        (Itersine(), Itersine(5)),
        (Itersine(), Itersine(overlap=4)),
        (HalfCosine(), HalfCosine(5)),
        (HalfCosine(), HalfCosine(overlap=4)),
        (Regular(), Regular(2)),
        (CubicSpline(), CubicSpline(5)),
        (CubicSpline(), CubicSpline(normalize=True)),
        (MexicanHat(), MexicanHat(5)),
        (MexicanHat(), MexicanHat(normalize=True)),
        (Gabor(), Gabor(5)),
        (BANKS["half cosine"], BANKS["half cosine, distribution"]),
        (BANKS["meyer"], BANKS["simple tight"]),
    ],
)
def test_every_static_parameter_changes_the_result(bank, other):
    eigenvalues = spectrum()
    responses, others = bank(eigenvalues, eigenvalues), other(eigenvalues, eigenvalues)
    assert responses.shape != others.shape or np.abs(responses - others).max() > 1e-2


@each_bank
def test_every_continuous_parameter_changes_the_result(bank, namespace):
    eigenvalues = spectrum(namespace=namespace)
    leaves, structure = jax.tree.flatten(bank)
    for index, leaf in enumerate(leaves):
        moved = jax.tree.unflatten(structure, [*leaves[:index], 1.1 * leaf**0.99, *leaves[index + 1 :]])
        change = sample(moved, eigenvalues, eigenvalues) - sample(bank, eigenvalues, eigenvalues)
        assert np.abs(change).max() > 1e-3


def test_a_softmax_frame_resembles_another_bank_at_its_knots():
    knots = jnp.linspace(0, 20, 33)
    for bank in (Meyer(5), Itersine(4)):
        similar = SoftmaxFrame.like(bank, 33, floor=1e-6)
        np.testing.assert_allclose(sample(similar, knots, knots), sample(bank, knots, knots), atol=1e-5)
    # If a bank is not tight, `SoftmaxFrame.like` preserves only the ratios between its filters.
    squares = sample(Heat([1.0, 10.0]), knots, knots) ** 2
    similar = sample(SoftmaxFrame.like(Heat([1.0, 10.0]), 33), knots, knots) ** 2
    np.testing.assert_allclose(similar[0], squares[0] / squares.sum(axis=0), atol=1e-3)


def test_softmax_frames_depend_only_on_differences_of_logits():
    logits = jnp.asarray(np.random.default_rng(0).normal(size=(4, 7)))
    grid = jnp.linspace(0, 3, 50)
    shifted = SoftmaxFrame(logits + jnp.arange(7.0)[None, :])
    plain = sample(SoftmaxFrame(logits), grid, grid)
    np.testing.assert_allclose(sample(shifted, grid, grid), plain, atol=1e-12)


def test_numbers_of_filters_are_not_traced():
    banks = [Meyer(), SimpleTight(), Itersine(), HalfCosine(), Regular(), Identity()]
    assert not jax.tree.leaves(banks)


def test_scaling_function_passes_the_lowest_band_and_each_filter_its_octaves():
    filters, lambda_max = 6, 64.0
    grid = np.linspace(0, lambda_max, 641)
    responses = np.asarray(sample(Meyer(filters), jnp.asarray(grid), jnp.asarray(grid)))
    assert responses[0, 0] == 1 and (responses[1:, 0] == 0).all()
    assert responses[-1, -1] == pytest.approx(1) and np.allclose(responses[:-1, -1], 0)
    for index in range(filters):
        first_edge = lambda_max / 2 ** (filters - index)
        below = 0 if index == 0 else first_edge
        above = lambda_max if index == filters - 1 else first_edge * 4
        outside = (grid < below - 1e-9) | (grid > above + 1e-9)
        np.testing.assert_allclose(responses[index, outside], 0, atol=1e-12)
        assert (responses[index, (grid > below + 0.2) & (grid < above - 0.2)] > 0).all()


@pytest.mark.parametrize(
    "bank", [Held(), Simoncelli(), Papadakis(), Regular(), LowPass(), ExponentialWindow()]
)
def test_first_filter_is_a_low_pass(bank):
    grid = jnp.linspace(0, 9, 200)
    low = np.asarray(sample(bank, grid, grid)[0])
    assert low[0] == pytest.approx(1) and low[-1] == pytest.approx(0) and (np.diff(low) <= 1e-12).all()


def test_the_cubic_spline_has_the_frame_bounds_of_the_paper():
    grid = jnp.linspace(0, 3, 5000)
    covered = frame_function(sample(CubicSpline(), grid, grid))
    assert 1.28 < covered.min() < 1.29 and 2.11 < covered.max() < 2.125


def test_some_banks_follow_closed_forms():
    grid = np.linspace(0, 4, 41)
    relative = grid / 4

    def respond(bank):
        return np.asarray(sample(bank, jnp.asarray(grid), jnp.asarray(grid)))

    np.testing.assert_array_equal(respond(Identity()), np.ones((1, 41)))
    np.testing.assert_allclose(respond(Heat([3.0, 7.0])), [np.exp(-3 * relative), np.exp(-7 * relative)])
    centres = np.asarray([0, 1 / 3, 2 / 3, 1])
    gaussians = np.exp(-((relative - centres[:, None]) ** 2) / (2 * (0.4 / 3) ** 2))
    np.testing.assert_allclose(respond(Gabor(4, 0.4)), gaussians)
    # In a Meyer frame with two filters, the scaling function begins to fall at lambda_max / 2.
    np.testing.assert_allclose(respond(LowPass(0.5)), respond(Meyer(2))[:1], atol=1e-15)
    window = respond(ExponentialWindow(0.8, 2.0))[0]
    assert window[16] == pytest.approx(0.5) and (window[32:] == 0).all()
    slope = jax.jacfwd(lambda x: ExponentialWindow(0.8, 2.0)(x, jnp.asarray(grid)))(jnp.asarray([1.6]))
    assert float(slope[0, 0, 0]) * 4 == pytest.approx(-2 * 2 / 0.8)


@each_warp
def test_warps_are_monotone(warp):
    eigenvalues = spectrum()
    warped = np.asarray(warp(jnp.linspace(0, eigenvalues[-1], 1001), eigenvalues))
    assert warped[0] == 0 and (np.diff(warped) > 0).all()


@pytest.mark.parametrize("bank", [HalfCosine(), Itersine(), CubicSpline()])
def test_the_spectral_distribution_removes_the_spacing_of_eigenvalues(bank):
    eigenvalues = spectrum()
    adapted = Warped(bank, SpectralDistribution())
    responses = adapted(eigenvalues, eigenvalues)
    for distorted in (eigenvalues**2, jnp.expm1(eigenvalues / 10), spectrum(9)):
        np.testing.assert_allclose(adapted(distorted, distorted), responses, atol=1e-12)
    evenly = jnp.arange(30.0)
    np.testing.assert_allclose(bank(evenly, evenly), responses, atol=1e-12)


def test_the_spectral_distribution_gives_bands_equal_numbers_of_eigenvalues():
    eigenvalues = spectrum(k=101) ** 2
    adapted = Warped(Itersine(), SpectralDistribution())(eigenvalues, eigenvalues)
    np.testing.assert_allclose(frame_function(adapted.T), [10.5, 20, 20, 20, 20, 10.5], atol=1e-10)
    plain = frame_function(Itersine()(eigenvalues, eigenvalues).T)
    assert plain.max() > 2 * plain[1:-1].min()


def test_repeated_eigenvalues_have_equal_responses():
    # The eigenvalues of a sphere with their multiplicities, and two further eigenvalues of zero.
    degrees = np.arange(8)
    exact = np.concatenate([[0, 0], np.repeat(degrees * (degrees + 1.0), 2 * degrees + 1)])
    noisy = np.sort(exact + 1e-9 * np.random.default_rng(0).uniform(size=exact.size))
    adapted = Warped(HalfCosine(), SpectralDistribution())
    responses = np.asarray(adapted(jnp.asarray(exact), jnp.asarray(exact)))
    np.testing.assert_allclose(adapted(jnp.asarray(noisy), jnp.asarray(noisy)), responses, atol=1e-12)
    np.testing.assert_allclose((responses**2).sum(axis=0), 1, atol=1e-12)
    for value in np.unique(exact):
        assert np.ptp(responses[:, exact == value], axis=1).max() == 0
    index = SpectralDistribution()(jnp.asarray(exact), jnp.asarray(exact))
    expected = [np.flatnonzero(exact == value).mean() for value in exact]
    np.testing.assert_array_equal(index, expected)


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: HalfCosine(overlap=3.5), ("overlap", "HalfCosine", "an integer", "3.5")),
        (lambda: Itersine(overlap=2.0), ("overlap", "Itersine", "an integer", "2.0")),
        (lambda: Regular(1.5), ("degree", "Regular", "an integer", "1.5")),
        (lambda: Meyer(2.5), ("number of filters", "Meyer", "an integer", "2.5")),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_numbers_that_must_be_integers(make, facts):
    """A half-integer overlap would make a bank that is not tight."""
    with refused(*facts, error=TypeError):
        make()


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: Meyer(1), ("Meyer", "at least 2 filters", "1")),
        (lambda: SimpleTight(0), ("SimpleTight", "at least 2")),
        (lambda: Itersine(1), ("Itersine", "at least 2")),
        (lambda: Itersine(3, overlap=4), ("Itersine", "at least 4")),
        (lambda: Itersine(overlap=3), ("overlap", "Itersine", "even", "positive", "3")),
        (lambda: Itersine(overlap=0), ("overlap", "Itersine", "even", "positive")),
        (lambda: HalfCosine(2), ("HalfCosine", "at least 3")),
        (lambda: HalfCosine(overlap=2), ("overlap", "HalfCosine", "at least 3")),
        (lambda: Held(0.0), ("edge", "Held", "between 0 and 1", "0.0")),
        (lambda: Simoncelli(1.5), ("edge", "Simoncelli", "between 0 and 1")),
        (lambda: Papadakis(-0.1), ("edge", "Papadakis", "between 0 and 1")),
        (lambda: Regular(-1), ("degree", "Regular", "negative")),
        (lambda: SoftmaxFrame([1.0, 2.0]), ("logits", "SoftmaxFrame", "shape (2,)")),
        (lambda: SoftmaxFrame(np.ones((2, 1))), ("at least 2 knots",)),
        (lambda: SoftmaxFrame.like(Meyer(), knots=1), ("at least 2 knots",)),
        (lambda: SoftmaxFrame.like(Meyer(), floor=0.0), ("floor", "at least 1e-12", "below 1")),
        (lambda: SoftmaxFrame.like(Meyer(), floor=np.inf), ("floor", "at least 1e-12", "below 1")),
        (lambda: CubicSpline(1), ("CubicSpline", "at least 2")),
        (lambda: CubicSpline(ratio=1.0), ("ratio", "CubicSpline", "finite", "above 1")),
        (lambda: MexicanHat(1), ("MexicanHat", "at least 2")),
        (lambda: MexicanHat(ratio=np.inf), ("ratio", "MexicanHat", "finite")),
        (lambda: Heat([1.0, -1.0]), ("times", "Heat", "finite", "above 0")),
        (lambda: Heat([]), ("times", "Heat", "a list", "at least one")),
        (lambda: Gabor(1), ("Gabor", "at least 2")),
        (lambda: Gabor(width=np.nan), ("width", "Gabor", "finite", "above 0")),
        (lambda: ExponentialWindow(0.0), ("edge", "ExponentialWindow", "finite", "above 0")),
        (lambda: ExponentialWindow(slope=-1.0), ("slope", "ExponentialWindow", "finite", "above 0")),
        (lambda: LowPass(1.0), ("edge", "LowPass", "between 0 and 1")),
        (lambda: Logarithm(0.0), ("strength", "Logarithm", "finite", "above 0")),
        (lambda: Power(0.0), ("exponent", "Power", "finite", "above 0")),
    ],
)
def test_invalid_parameters_are_refused(make, facts):
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        make()
    assert_names(str(caught.value), *facts)
    assert "\n" not in str(caught.value)


def test_banks_accept_traced_parameters():
    eigenvalues = spectrum()
    widths = jnp.asarray([0.3, 0.6])
    made = jax.jit(jax.vmap(lambda width: Gabor(4, width)(eigenvalues, eigenvalues)))(widths)
    np.testing.assert_allclose(made[1], Gabor(4, 0.6)(eigenvalues, eigenvalues), atol=1e-14)
    assert np.isfinite(jax.grad(lambda e: jnp.sum(Held(e)(eigenvalues, eigenvalues)))(0.3))
    assert jnp.isfinite(eqx.filter_jit(lambda e: Warped(Gabor(), Power())(e, e))(eigenvalues)).all()


# The following tests compare the banks with an independent toolbox.

PARSEVAL_FACTOR = np.sqrt(9 / 8)  # the squared half cosines of the toolbox sum to 9/8


def as_in_the_toolbox(lambda_max):
    """Returns, for each filter name in the toolbox, our bank and the factors that convert its responses."""
    # With `normalize`, the toolbox uses absolute scales, but we use scales in units of 1 / lambda_max.
    scale_units = np.r_[1, np.full(5, 1 / np.sqrt(lambda_max))]
    logarithm = Logarithm(10 * lambda_max)
    half_cosines = {
        "half_cosine": HalfCosine(),
        "warped_identity": HalfCosine(),
        "warped_log": Warped(HalfCosine(), logarithm),
        "warped_sqrt": Warped(HalfCosine(), Power()),
    }
    return {
        "meyer": (Meyer(), 1),
        **{f"meyer_Nf{filters}": (Meyer(filters), 1) for filters in (2, 3, 4, 5, 7, 8)},
        "simple_tf": (SimpleTight(), 1),
        "abspline": (CubicSpline(), 1),
        "abspline_normalize1": (CubicSpline(normalize=True), scale_units),
        "mexican_hat": (MexicanHat(), 1),
        "mexican_hat_normalize1": (MexicanHat(normalize=True), scale_units),
        "itersine": (Itersine(), 1),
        "itersine_overlap4": (Itersine(overlap=4), 1),
        "held": (Held(), 1),
        "simoncelli": (Simoncelli(), 1),
        "papadakis": (Papadakis(), 1),
        "heat_tau10": (Heat([10.0]), 1),
        "heat_taus": (Heat([1, 2, 5, 10, 20, 50]), 1),
        "expwin": (ExponentialWindow(), 1),
        "warped_log_itersine": (Warped(Itersine(), logarithm), 1),
        **{name: (bank, PARSEVAL_FACTOR) for name, bank in half_cosines.items()},
    }


@pytest.mark.parametrize("lambda_max", [1, 100])
@pytest.mark.parametrize("name", as_in_the_toolbox(1))
def test_values_equal_the_independent_toolbox(shared, lambda_max, name):
    reference = np.load(shared / "oracle" / f"filters_lmax{lambda_max}.npz")
    grid = jnp.asarray(reference["x"])
    bank, factors = as_in_the_toolbox(lambda_max)[name]
    expected = reference[name].reshape(grid.size, -1)
    np.testing.assert_allclose(
        sample(bank, grid, grid).T * jnp.broadcast_to(factors, expected.shape), expected, atol=1e-10
    )


@pytest.mark.parametrize("lambda_max", [1, 100])
def test_the_logarithm_and_regular_equal_the_independent_toolbox(shared, lambda_max):
    reference = np.load(shared / "oracle" / f"filters_lmax{lambda_max}.npz")
    grid = jnp.asarray(reference["x"])
    warped = Logarithm(10 * lambda_max)(grid, grid)
    np.testing.assert_allclose(warped, reference["warped_log_wf"], atol=1e-10)
    # The toolbox returns the high-pass filter first. Its low-pass filter is computed as sqrt(1 - high²),
    # which is accurate to only half of the digits near zero.
    low, high = Regular()(grid, grid)
    np.testing.assert_allclose(high, reference["regular"][:, 0], atol=1e-10)
    np.testing.assert_allclose(low**2, reference["regular"][:, 1] ** 2, atol=1e-10)
    np.testing.assert_allclose(low, reference["regular"][:, 1], atol=1e-8)


@pytest.mark.parametrize("lambda_max", [0.37, 41.3])
@pytest.mark.parametrize("filters", first_always([5, 3, 9]))
def test_values_equal_pygsp(lambda_max, filters):
    graph = pygsp_graphs.Graph(lambda_max / 2 * np.asarray([[0.0, 1.0], [1.0, 0.0]]))
    graph.compute_fourier_basis()
    assert graph.lmax == pytest.approx(lambda_max)
    points = np.sort(np.random.default_rng(filters).uniform(0, lambda_max, 60))
    edge = 0.1 * filters / 2
    scale_units = np.r_[1, np.full(filters - 1, 1 / np.sqrt(lambda_max))][:, None]
    pairs = [
        (Meyer(filters), 1, pygsp_filters.Meyer(graph, filters)),
        (SimpleTight(filters), 1, pygsp_filters.SimpleTight(graph, filters)),
        (CubicSpline(filters), 1, pygsp_filters.Abspline(graph, filters)),
        (CubicSpline(filters, 7), 1, pygsp_filters.Abspline(graph, filters, lpfactor=7)),
        (MexicanHat(filters, 7), 1, pygsp_filters.MexicanHat(graph, filters, lpfactor=7)),
        (
            MexicanHat(filters, normalize=True),
            scale_units,
            pygsp_filters.MexicanHat(graph, filters, normalize=True),
        ),
        (Itersine(filters), 1, pygsp_filters.Itersine(graph, filters)),
        (HalfCosine(filters), PARSEVAL_FACTOR, pygsp_filters.HalfCosine(graph, filters)),
        (Heat(np.arange(1.0, filters)), 1, pygsp_filters.Heat(graph, np.arange(1, filters))),
        # PyGSP scales the spectrum to [0, 2], so its edges are twice as large. PyGSP's exponential window
        # falls over an interval as wide as the spectrum.
        (Held(edge), 1, pygsp_filters.Held(graph, 2 * edge)),
        (Simoncelli(edge), 1, pygsp_filters.Simoncelli(graph, 2 * edge)),
        (Papadakis(edge), 1, pygsp_filters.Papadakis(graph, 2 * edge)),
        (ExponentialWindow(1.0, filters), 1, pygsp_filters.Expwin(graph, band_max=0.5, slope=filters)),
    ]
    for bank, factors, peer in pairs:
        responses = factors * np.asarray(sample(bank, jnp.asarray(points), jnp.asarray([0.0, graph.lmax])))
        np.testing.assert_allclose(responses, peer.evaluate(points), atol=1e-10, err_msg=repr(bank))
