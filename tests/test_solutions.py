"""Solutions minimise their energies, have the expected invariances, and report failures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from jaxtyping import TypeCheckError
from sampled_cases import first_always
from synthetic import in_precision, random_spectrum, stacked

from jaxsmw.core.banks import CubicSpline, FilterBank, Meyer, frame_function
from jaxsmw.core.functional_map import QuadraticEnergy, encode
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares
from jaxsmw.core.solutions.descriptors import DescriptorPair
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum

M, N, K_X, K_Y, D = 70, 60, 7, 6, 3
TERMS = (
    "wavelet_preservation",
    "laplacian_commutativity",
    "orthogonality",
    "descriptor_preservation",
    "descriptor_commutativity",
)
OFF = dict.fromkeys(TERMS)
PRECISE = {"tolerance": 1e-10, "max_steps": 2000}


@pytest.fixture
def pair():
    return random_spectrum(M, K_X, seed=1), random_spectrum(N, K_Y, seed=2)


@pytest.fixture
def pointwise_map():
    return jnp.asarray(np.random.default_rng(3).integers(0, N, M))


@pytest.fixture
def descriptors(pair):
    generator = np.random.default_rng(4)
    values = [jnp.asarray(generator.normal(size=(len(s.mask), D))) for s in pair]
    return DescriptorPair.project(*values, *pair, operators=True)


# Without compilation as a whole, each solution compiles about 100 small programs.
@eqx.filter_jit
def solve(solution, pair, pointwise_map, *, bank=None, convention="pullback", previous=None):
    bank = CubicSpline(4) if bank is None else bank
    problem = WaveletPreservation(bank=bank, solution=solution, convention=convention).problem(*pair)
    return solution.solve(problem, solution.prepare(problem), pointwise_map, previous)


def objective(c, pair, pointwise_map, weights, descriptors, *, convention="pullback", bank=None):
    """Returns the objective of `RegularizedLeastSquares`, summed term by term."""
    bank = CubicSpline(4) if bank is None else bank
    problem = WaveletPreservation(bank=bank, convention=convention).problem(*pair)
    eigenvalues_out, eigenvalues_in = (s.eigenvalues for s in problem.spectra)
    k_out, k_in = c.shape
    weights = OFF | weights
    total = 0.0
    if weights["wavelet_preservation"]:
        height = jnp.mean(frame_function(problem.responses[0]))
        total += weights["wavelet_preservation"] / height * problem.energy(pointwise_map)(c)
    if weights["laplacian_commutativity"]:
        largest = jnp.maximum(eigenvalues_out[-1], eigenvalues_in[-1])
        commutator = jnp.diag(eigenvalues_out) @ c - c @ jnp.diag(eigenvalues_in)
        total += weights["laplacian_commutativity"] * jnp.sum((commutator / largest) ** 2)
    if weights["orthogonality"]:
        gram = c.T @ c if k_in <= k_out else c @ c.T
        total += weights["orthogonality"] * jnp.sum((gram - jnp.eye(len(gram))) ** 2)
    x_out = convention == "pullback"
    if weights["descriptor_preservation"]:
        f_out, f_in = descriptors.x.coefficients, descriptors.y.coefficients
        f_out, f_in = (f_out, f_in) if x_out else (f_in, f_out)
        scale = k_out / jnp.sum(f_out**2)
        total += weights["descriptor_preservation"] * scale * jnp.sum((c @ f_in - f_out) ** 2)
    if weights["descriptor_commutativity"]:
        d_out, d_in = descriptors.x.operators, descriptors.y.operators
        d_out, d_in = (d_out, d_in) if x_out else (d_in, d_out)
        scale = k_out / jnp.sum(d_out**2)
        commutators = sum(jnp.sum((c @ d_in[i] - d_out[i] @ c) ** 2) for i in range(D))
        total += weights["descriptor_commutativity"] * scale * commutators
    return total


QUADRATIC = [
    dict.fromkeys(("wavelet_preservation", "laplacian_commutativity", "descriptor_preservation", "descriptor_commutativity"), 1.0),
    {"wavelet_preservation": 1.0},
    {"wavelet_preservation": 0.3, "laplacian_commutativity": 2.0},
    {"wavelet_preservation": 1.0, "descriptor_preservation": 0.7},
    {"wavelet_preservation": 1.0, "descriptor_commutativity": 5.0},
    {"descriptor_preservation": 1.0, "laplacian_commutativity": 10.0},
]  # fmt: skip


def with_weights(weights, descriptors, **options):
    needed = {"descriptor_preservation", "descriptor_commutativity"} & weights.keys()
    return RegularizedLeastSquares(
        **(OFF | weights), descriptors=descriptors if needed else None, **(PRECISE | options)
    )


@pytest.mark.slow
@pytest.mark.parametrize("convention", ["pullback", "pushforward"])
@pytest.mark.parametrize("weights", first_always(QUADRATIC), ids=lambda w: ", ".join(w))
def test_quadratic_objectives_are_minimised_exactly(pair, pointwise_map, descriptors, weights, convention):
    """The result agrees with the dense solution of the k² normal equations."""
    c, result = solve(with_weights(weights, descriptors), pair, pointwise_map, convention=convention)
    assert result == RESULTS.successful

    def loss(vector):
        return objective(
            vector.reshape(c.shape), pair, pointwise_map, weights, descriptors, convention=convention
        )

    origin = jnp.zeros(c.size)
    dense = jnp.linalg.lstsq(jax.jit(jax.hessian(loss))(origin), -jax.jit(jax.grad(loss))(origin))[0]
    np.testing.assert_allclose(c, dense.reshape(c.shape), atol=1e-6)


@pytest.mark.parametrize("norm", ["area", "frobenius"])
@pytest.mark.parametrize("convention", first_always(["pullback", "pushforward"]))
def test_wavelets_alone_give_the_closed_form(pair, pointwise_map, norm, convention):
    options = {"convention": convention}
    exact, _ = solve(LeastSquares(norm), pair, pointwise_map, **options)
    weights = {"wavelet_preservation": 2.0}
    iterative, result = solve(with_weights(weights, None, norm=norm), pair, pointwise_map, **options)
    assert result == RESULTS.successful
    np.testing.assert_allclose(iterative, exact, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("convention", first_always(["pullback", "pushforward"]))
def test_orthogonality_is_minimised_to_first_order(pair, pointwise_map, descriptors, convention):
    weights = dict.fromkeys(TERMS, 0.5)
    c, result = solve(with_weights(weights, descriptors), pair, pointwise_map, convention=convention)
    assert result == RESULTS.successful

    @jax.jit
    def loss(c):
        return objective(c, pair, pointwise_map, weights, descriptors, convention=convention)

    np.testing.assert_allclose(jax.grad(loss)(c), 0, atol=1e-6)
    generator = np.random.default_rng(0)
    for size in (1e-3, 1e-1):
        assert loss(c + size * generator.normal(size=c.shape)) > loss(c)


@pytest.mark.slow
@pytest.mark.parametrize("term", TERMS[1:])
def test_every_weight_changes_the_result_and_lowers_its_term(pair, pointwise_map, descriptors, term):
    @jax.jit
    def term_of(c):
        return objective(c, pair, pointwise_map, {term: 1.0}, descriptors)

    def minimiser(weight):
        weights = {"wavelet_preservation": 1.0, term: weight}
        c, result = solve(with_weights(weights, descriptors), pair, pointwise_map)
        assert result == RESULTS.successful
        return c, term_of(c)

    (weak, cost_weak), (strong, cost_strong) = minimiser(0.01), minimiser(3.0)
    assert jnp.max(jnp.abs(weak - strong)) > 1e-3
    assert cost_strong < 0.9 * cost_weak


def test_wavelet_weight_changes_the_result(pair, pointwise_map):
    light, heavy = (
        solve(with_weights({"wavelet_preservation": w, "orthogonality": 1.0}, None), pair, pointwise_map)[0]
        for w in (0.5, 5.0)
    )
    assert jnp.max(jnp.abs(light - heavy)) > 1e-3


def test_norm_changes_the_result(pair, pointwise_map):
    area, frobenius = (
        solve(RegularizedLeastSquares(norm=norm), pair, pointwise_map)[0] for norm in ("area", "frobenius")
    )
    assert jnp.max(jnp.abs(area - frobenius)) > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("solution", [LeastSquares(), RegularizedLeastSquares(**PRECISE)], ids=["exact", "regularized"])  # fmt: skip
def test_vmap_equals_a_loop(solution):
    pairs = [(random_spectrum(M, K_X, seed=s), random_spectrum(N, K_Y, seed=s + 9)) for s in range(3)]
    maps = [jnp.asarray(np.random.default_rng(s).integers(0, N, M)) for s in range(3)]

    batch, results = eqx.filter_vmap(lambda x, y, t: solve(solution, (x, y), t))(
        *(stacked(*spectra) for spectra in zip(*pairs, strict=True)), jnp.stack(maps)
    )
    for i in range(3):
        alone, result = solve(solution, pairs[i], maps[i])
        assert result == RESULTS.successful
        np.testing.assert_allclose(batch[i], alone, atol=1e-8)
    assert bool(jnp.all(results == RESULTS.successful))


@pytest.mark.slow
def test_derivatives_with_respect_to_weights_and_spectra(pair, pointwise_map, descriptors):
    weights = dict.fromkeys(TERMS, 0.5)

    def loss(weight, shift):
        solution = with_weights(weights, descriptors, tolerance=1e-13)
        solution = eqx.tree_at(lambda s: s.orthogonality, solution, jnp.asarray(weight))
        x, y = pair
        x = eqx.tree_at(lambda s: s.eigenvalues, x, x.eigenvalues + jnp.asarray(shift))
        c, _ = solve(solution, (x, y), pointwise_map)
        return jnp.sum(jnp.sin(3 * c))

    shift = jnp.linspace(0.1, 0.3, K_X)
    arguments = jnp.asarray(0.4), shift
    check_grads(jax.jit(loss), arguments, order=1, modes=["fwd", "rev"], atol=1e-5, rtol=1e-4)


def test_derivative_of_the_closed_form(pair, pointwise_map):
    @jax.jit
    def loss(eigenvectors):
        x = eqx.tree_at(lambda s: s.eigenvectors, pair[0], jnp.asarray(eigenvectors))
        return jnp.sum(jnp.sin(3 * solve(LeastSquares(), (x, pair[1]), pointwise_map)[0]))

    check_grads(loss, (pair[0].eigenvectors,), order=1)


def test_the_solver_begins_with_the_previous_functional_map(pair, pointwise_map):
    c, _ = solve(RegularizedLeastSquares(**PRECISE), pair, pointwise_map)
    hasty = RegularizedLeastSquares(max_steps=3, tolerance=1e-6)
    _, cold = solve(hasty, pair, pointwise_map)
    again, warm = solve(hasty, pair, pointwise_map, previous=c)
    assert cold == RESULTS.solver_not_converged
    assert warm == RESULTS.successful
    np.testing.assert_allclose(again, c, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("convention", first_always(["pullback", "pushforward"]))
def test_signs_of_eigenvectors_do_not_matter(pair, pointwise_map, convention):
    generator = np.random.default_rng(0)
    signs = [jnp.asarray(generator.choice([-1.0, 1.0], k)) for k in (K_X, K_Y)]
    flipped = [
        eqx.tree_at(lambda s: s.eigenvectors, s, s.eigenvectors * sign[None])
        for s, sign in zip(pair, signs, strict=True)
    ]
    out, into = signs if convention == "pullback" else signs[::-1]
    for solution in (LeastSquares("frobenius"), RegularizedLeastSquares(**PRECISE)):
        c, _ = solve(solution, pair, pointwise_map, convention=convention)
        other, _ = solve(solution, flipped, pointwise_map, convention=convention)
        np.testing.assert_allclose(other, out[:, None] * c * into[None], atol=1e-7)


class Gap(FilterBank):
    """A bank whose filters are zero in the middle of the spectrum."""

    def __call__(self, points, eigenvalues):
        return jnp.where(jnp.abs(points / eigenvalues[-1] - 0.5) < 0.2, 0.0, Meyer(3)(points, eigenvalues))


@pytest.mark.slow
@pytest.mark.parametrize("convention", first_always(["pullback", "pushforward"]))
@pytest.mark.parametrize(
    "solution",
    [LeastSquares(), RegularizedLeastSquares(laplacian_commutativity=None)],
    ids=["exact", "regularized"],
)
def test_a_vanishing_frame_function_is_reported(pair, pointwise_map, solution, convention):
    refiner = WaveletPreservation(bank=Gap(), solution=solution, convention=convention)
    refined = refine(*pair, pointwise_map, refiner=refiner)
    assert refined.result == RESULTS.undetermined_functional_map
    assert (refined.pointwise_map == -1).all()
    assert (
        "filters of the bank vanish" in RESULTS[refined.result] and "Filtering()" in RESULTS[refined.result]
    )
    filtering = WaveletPreservation(bank=Gap(), convention=convention)
    assert refine(*pair, pointwise_map, refiner=filtering).result == RESULTS.successful


@pytest.mark.slow
def test_a_map_to_too_few_vertices_is_reported(pair):
    """If all vertices have the same match and the bank has one filter, the Gram matrix has rank 1."""

    class Flat(FilterBank):
        def __call__(self, points, eigenvalues):
            return jnp.ones_like(points)[None]

    wavelets_alone = RegularizedLeastSquares(laplacian_commutativity=None, orthogonality=None)
    for dtype in (jnp.float32, jnp.float64):
        x, y = (in_precision(spectrum, dtype) for spectrum in pair)
        for solution in (LeastSquares(), wavelets_alone):
            refiner = WaveletPreservation(bank=Flat(), solution=solution)
            refined = refine(x, y, jnp.full(M, 5), refiner=refiner)
            assert refined.result == RESULTS.singular_system


def test_a_constant_factor_of_a_bank_does_not_matter(pair, pointwise_map):
    class Raised(FilterBank):
        def __call__(self, points, eigenvalues):
            return 3.0 * CubicSpline(4)(points, eigenvalues)

    solution = RegularizedLeastSquares(orthogonality=0.5, **PRECISE)
    plain, raised = (solve(solution, pair, pointwise_map, bank=bank)[0] for bank in (None, Raised()))
    np.testing.assert_allclose(raised, plain, atol=1e-7)


def test_new_weights_do_not_compile_again(pair, pointwise_map):
    traces = []

    @eqx.filter_jit
    def run(solution):
        traces.append(1)
        return solve(solution, pair, pointwise_map)[0]

    first, second = (run(RegularizedLeastSquares(orthogonality=weight)) for weight in (0.1, 0.7))
    assert len(traces) == 1 and jnp.max(jnp.abs(first - second)) > 1e-3


@pytest.mark.slow
def test_all_solutions_on_samples_agree_with_a_loop_under_vmap():
    pairs = [(random_spectrum(M, K_X, seed=s), random_spectrum(N, K_Y, seed=s + 9)) for s in range(2)]
    maps = jnp.stack([jnp.asarray(np.random.default_rng(s).integers(0, N, M)) for s in range(2)])
    samples_x, samples_y = jnp.arange(0, M, 2), jnp.arange(0, N, 2)
    x, y = (stacked(*spectra) for spectra in zip(*pairs, strict=True))
    for solution in (LeastSquares(), LeastSquares("frobenius"), RegularizedLeastSquares(**PRECISE)):
        options = {"refiner": WaveletPreservation(solution=solution), "iterations": 2}
        options |= {"samples": (samples_x, samples_y)}
        batch = jax.vmap(lambda x, y, t, options=options: refine(x, y, t, **options))(x, y, maps)
        for i, pair in enumerate(pairs):
            alone = refine(*pair, maps[i], **options)
            assert alone.result == RESULTS.successful
            np.testing.assert_allclose(batch.functional_map[i], alone.functional_map, atol=1e-7)


def test_too_few_steps_are_reported(pair, pointwise_map):
    solution = RegularizedLeastSquares(orthogonality=1.0, max_steps=2, tolerance=1e-9)
    refined = refine(*pair, pointwise_map, refiner=WaveletPreservation(solution=solution))
    assert refined.result == RESULTS.solver_not_converged
    assert "max_steps" in RESULTS[refined.result]


def test_nan_in_a_spectrum_is_reported(pair, pointwise_map):
    x, y = pair
    broken = eqx.tree_at(lambda s: s.eigenvectors, x, x.eigenvectors.at[0, 0].set(jnp.nan))
    for solution in (Filtering(), LeastSquares(), RegularizedLeastSquares()):
        refined = refine(broken, y, pointwise_map, refiner=WaveletPreservation(solution=solution))
        assert refined.result == RESULTS.nonfinite_spectrum


@pytest.mark.slow
def test_an_invalid_weight_is_reported_also_in_a_batch(pair, pointwise_map):
    def result(weight):
        solution = RegularizedLeastSquares(orthogonality=weight)
        return refine(*pair, pointwise_map, refiner=WaveletPreservation(solution=solution)).result

    weights = jnp.asarray([0.1, jnp.nan, 0.0, -1.0])
    results = jax.vmap(result)(weights)
    good = results == RESULTS.successful
    np.testing.assert_array_equal(good, [True, False, True, False])
    for weight, fine in zip(weights, good, strict=True):
        assert (jax.jit(result)(weight) == RESULTS.successful) == fine


@pytest.mark.parametrize("operators", first_always([True, False]))
def test_nan_in_descriptors_is_reported(pair, pointwise_map, operators):
    x, y = pair
    values = np.random.default_rng(0).normal(size=(M, D))
    values[3, 1] = np.nan
    other = jnp.asarray(np.random.default_rng(1).normal(size=(N, D)))
    descriptors = DescriptorPair.project(jnp.asarray(values), other, x, y, operators=operators)
    solution = RegularizedLeastSquares(
        descriptors=descriptors,
        descriptor_preservation=1.0,
        descriptor_commutativity=1.0 if operators else None,
    )
    refined = refine(x, y, pointwise_map, refiner=WaveletPreservation(solution=solution))
    assert refined.result == RESULTS.nonfinite_functional_map


def test_descriptors_that_do_not_fit_are_refused(pair, pointwise_map):
    x, y = pair
    f, g = (jnp.ones((n, D)) for n in (M, N))
    with pytest.raises((ValueError, TypeCheckError), match="descriptors"):
        DescriptorPair.project(f[:, 0], g[:, 0], x, y)
    with pytest.raises((ValueError, TypeCheckError), match="descriptors"):
        DescriptorPair.project(g, f, x, y)
    with pytest.raises((ValueError, TypeCheckError), match=r"descriptors|coefficients"):
        DescriptorPair.project(f, g[:, :2], x, y)
    swapped = DescriptorPair.project(g, f, y, x)
    solution = RegularizedLeastSquares(descriptors=swapped, descriptor_preservation=1.0)
    with pytest.raises(ValueError, match=f"expressed in {K_Y} and {K_X} eigenvectors"):
        refine(x, y, pointwise_map, refiner=WaveletPreservation(solution=solution))


def test_projected_descriptors_are_coefficients_and_symmetric_operators(pair):
    x, _ = pair
    coefficients = np.random.default_rng(0).normal(size=(K_X, 2))
    values = x.eigenvectors @ coefficients
    projected = DescriptorPair.project(values, values, x, x, operators=True)
    np.testing.assert_allclose(projected.x.coefficients, coefficients, atol=1e-12)
    # In the eigenbasis, multiplication by a function is a symmetric matrix. For the constant function 1, this
    # matrix is the identity.
    operators = projected.x.operators
    np.testing.assert_allclose(operators, operators.transpose(0, 2, 1), atol=1e-12)
    ones = jnp.ones((M, 1))
    identity = DescriptorPair.project(ones, ones, x, x, operators=True).x.operators[0]
    np.testing.assert_allclose(identity, np.eye(K_X), atol=1e-12)
    assert DescriptorPair.project(values, values, x, x).x.operators is None


def test_descriptors_alone_find_the_functional_map_of_a_copy(pair):
    """Enough descriptors determine the functional map without wavelets."""
    x, _ = pair
    order = jnp.asarray(np.random.default_rng(0).permutation(M))
    y = Spectrum(x.eigenvalues, x.eigenvectors[order], x.vertex_areas[order], x.mask)
    y = eqx.tree_at(
        lambda s: s.eigenvectors, y, y.eigenvectors * jnp.asarray([1.0, -1, 1, 1, -1, 1, -1])[None]
    )
    values = jnp.asarray(np.random.default_rng(1).normal(size=(M, 9)))
    descriptors = DescriptorPair.project(values, values[order], x, y)
    solution = RegularizedLeastSquares(
        wavelet_preservation=None,
        orthogonality=None,
        descriptor_preservation=1.0,
        laplacian_commutativity=1.0,
        descriptors=descriptors,
        **PRECISE,
    )
    c, result = solution.minimize(None, x.eigenvalues, y.eigenvalues)
    assert result == RESULTS.successful
    np.testing.assert_allclose(c, jnp.diag(jnp.asarray([1.0, -1, 1, 1, -1, 1, -1])), atol=1e-8)


def test_float32_stays_float32_and_agrees(pair, pointwise_map):
    single = [in_precision(spectrum, jnp.float32) for spectrum in pair]
    for solution in (LeastSquares(), RegularizedLeastSquares()):
        c, result = solve(solution, single, pointwise_map)
        assert c.dtype == jnp.float32 and result == RESULTS.successful
        np.testing.assert_allclose(c, solve(solution, pair, pointwise_map)[0], atol=5e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"descriptor_preservation": 1.0}, "these weights need descriptors"),
        ({"wavelet_preservation": None}, "C is undetermined without"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"orthogonality": -1.0}, "orthogonality"),
        ({"orthogonality": jnp.ones(3)}, "one number"),
        ({"laplacian_commutativity": float("nan")}, "laplacian_commutativity"),
        ({"max_steps": 0}, "max_steps"),
        ({"resolvent_power": 0.0}, "resolvent_power must be above 0"),
    ],
)
def test_invalid_settings_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RegularizedLeastSquares(**options)


@pytest.mark.parametrize("option", ["convention", "pseudo_inverse"])
def test_an_unknown_choice_is_refused(pair, pointwise_map, option, unchecked):
    with pytest.raises(ValueError, match=f"{option}='other' is unknown"):
        encode(pointwise_map, *pair, **{option: "other"})


def test_descriptors_need_a_weight_and_commutativity_needs_operators(pair):
    values = [jnp.ones((len(s.mask), 1)) for s in pair]
    descriptors = DescriptorPair.project(*values, *pair)
    with pytest.raises(ValueError, match="descriptors need a weight"):
        RegularizedLeastSquares(descriptors=descriptors)
    with pytest.raises(ValueError, match="operators=True"):
        RegularizedLeastSquares(descriptors=descriptors, descriptor_commutativity=1.0)
    complete = DescriptorPair.project(*values, *pair, operators=True)
    with pytest.raises(ValueError, match="operators=True"):
        RegularizedLeastSquares(
            descriptors=DescriptorPair(complete.x, descriptors.y), descriptor_commutativity=1.0
        )


MASKS = {"standard": {}, "resolvent": {"mask": "resolvent"}, "resolvent of power 1": {"mask": "resolvent", "resolvent_power": 1.0}}  # fmt: skip


def map_of_descriptors(values_x, values_y, spectrum_x, spectrum_y, commutativity=0.3, **options):
    """The functional map of descriptors and a mask, in closed form unless `options` add other terms."""
    solution = RegularizedLeastSquares(
        wavelet_preservation=None,
        descriptor_preservation=1.0,
        laplacian_commutativity=commutativity,
        descriptors=DescriptorPair.project(values_x, values_y, spectrum_x, spectrum_y),
        **({"orthogonality": None} | options),
    )
    return solution.minimize(None, spectrum_x.eigenvalues, spectrum_y.eigenvalues)


def values_on(spectrum, seed):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(len(spectrum.mask), 2 * D)))


@pytest.mark.parametrize("mask", MASKS)
def test_descriptors_and_a_mask_give_one_linear_system_per_row(pair, mask):
    """Row i solves `C_i (w F F^T + diag(mask_i²)) = (w F_out F^T)_i` (Donati et al. 2020)."""
    values = [values_on(spectrum, seed) for seed, spectrum in enumerate(pair)]
    c, result = map_of_descriptors(*values, *pair, **MASKS[mask])
    assert result == RESULTS.successful
    f_out, f_in = (
        np.asarray(s.eigenvectors).T @ (np.asarray(s.vertex_areas)[:, None] * f)
        for s, f in zip(pair, values, strict=True)
    )
    eigenvalues = [np.asarray(s.eigenvalues) for s in pair]
    a, b = (e / max(map(np.max, eigenvalues)) for e in eigenvalues)
    if mask != "standard":
        power = MASKS[mask].get("resolvent_power", 0.5)
        a, b = 1 / (a**power - 1j), 1 / (b**power - 1j)
    penalty = 0.3 * np.abs(a[:, None] - b[None]) ** 2
    weight = K_X / np.sum(f_out**2)
    rows = [
        np.linalg.solve(weight * f_in @ f_in.T + np.diag(penalty[i]), weight * f_in @ f_out[i])
        for i in range(K_X)
    ]
    np.testing.assert_allclose(c, rows, atol=1e-12)
    iterated, _ = map_of_descriptors(*values, *pair, orthogonality=1e-12, **PRECISE, **MASKS[mask])
    np.testing.assert_allclose(iterated, c, atol=1e-7)


@pytest.mark.parametrize("options", first_always([MASKS["resolvent"], {}, {"orthogonality": 0.02, **PRECISE}], always=2), ids=str)  # fmt: skip
def test_maps_of_a_batch_of_descriptors_and_their_derivatives(options):
    """One call solves all pairs. Derivatives agree with finite differences and with those of each pair."""
    x, y = (
        stacked(*(random_spectrum(n, k, seed=seed + n) for seed in range(2))) for n, k in ((M, K_X), (N, K_Y))
    )
    values_x, values_y = (jnp.asarray(np.random.default_rng(n).normal(size=(2, n, 2 * D))) for n in (M, N))

    def of_pair(values_x, values_y, x, y, weight):
        return map_of_descriptors(values_x, values_y, x, y, weight, **options)[0]

    @jax.jit
    def of_batch(values_x, values_y, eigenvalues, weight):
        moved = eqx.tree_at(lambda s: s.eigenvalues, x, eigenvalues)
        return jax.vmap(of_pair, (0, 0, 0, 0, None))(values_x, values_y, moved, y, weight)

    # The root of an eigenvalue has no derivative at 0.
    arguments = values_x, values_y, x.eigenvalues + 1, 0.3
    for i in range(2):
        x_i, y_i = (jax.tree.map(lambda leaf, i=i: leaf[i], s) for s in (x, y))
        x_i = eqx.tree_at(lambda s: s.eigenvalues, x_i, x_i.eigenvalues + 1)
        alone = of_pair(values_x[i], values_y[i], x_i, y_i, 0.3)
        np.testing.assert_allclose(of_batch(*arguments)[i], alone, atol=1e-9)
    check_grads(of_batch, arguments, order=1, modes=["fwd", "rev"], atol=1e-5, rtol=1e-4)


def test_too_few_descriptors_for_a_map_are_reported(pair):
    """One descriptor and no mask do not determine the map."""
    values = [values_on(spectrum, seed)[:, :1] for seed, spectrum in enumerate(pair)]
    _, result = map_of_descriptors(*values, *pair, commutativity=None)
    assert result == RESULTS.singular_system
    _, result = map_of_descriptors(*values, *pair)
    assert result == RESULTS.successful


def test_minimize_accepts_another_energy(pair):
    """`minimize` finds the known minimum of a sum of squares."""
    generator = np.random.default_rng(0)
    a, target = generator.normal(size=(K_Y, 20)), generator.normal(size=(K_X, K_Y))
    b = target @ a
    energy = QuadraticEnergy(jnp.asarray(a @ a.T), jnp.asarray(b @ a.T), jnp.asarray(np.sum(b**2)))
    solution = RegularizedLeastSquares(laplacian_commutativity=None, orthogonality=None, **PRECISE)
    c, _ = solution.minimize(energy, pair[0].eigenvalues, pair[1].eigenvalues)
    np.testing.assert_allclose(c, target, atol=1e-8)
    with pytest.raises(ValueError, match="the weight needs an energy"):
        solution.minimize(None, pair[0].eigenvalues, pair[1].eigenvalues)


@pytest.mark.sampled
@pytest.mark.parametrize("convention", ["pullback", "pushforward"])
@pytest.mark.parametrize("norm", ["area", "frobenius"])
@pytest.mark.parametrize("bank", [Meyer(6), CubicSpline(6)], ids=["tight", "general"])
def test_normal_equations_hold_on_real_shapes(shared, bank, convention, norm):
    """The least-squares residual of all scales and vertices is orthogonal to the inputs of C."""
    reference = np.load(shared / "oracle" / "faust_r_002_007.npz")
    x, y = (
        Spectrum(
            jnp.asarray(reference[f"{side}_eigenvalues"][:100]),
            jnp.asarray(reference[f"{side}_eigenvectors"][:, :100]),
            jnp.asarray(reference[f"{side}_vertex_areas"]),
            jnp.ones(len(reference[f"{side}_vertex_areas"]), bool),
        )
        for side in "xy"
    )
    t = reference["T0"].astype(np.int32)
    problem = WaveletPreservation(bank=bank, convention=convention).problem(x, y)
    c, result = LeastSquares(norm).solve(problem, None, jnp.asarray(t), None)
    assert result == RESULTS.successful
    areas = np.asarray(x.vertex_areas)[:, None]
    if convention == "pullback":
        inputs, outputs = y.eigenvectors[t], x.eigenvectors
    else:
        inputs, outputs = x.eigenvectors * areas, (y.eigenvectors * y.vertex_areas[:, None])[t]
    weights = {
        ("pullback", "area"): areas,
        ("pushforward", "area"): 1 / areas,
    }.get((convention, norm), np.ones_like(areas))
    g_out, g_in = (np.asarray(g) for g in problem.responses)
    correlation, size = 0.0, 0.0
    for scale_out, scale_in in zip(g_out, g_in, strict=True):
        given = np.asarray(inputs) * scale_in[None]
        residual = given @ np.asarray(c).T - np.asarray(outputs) * scale_out[None]
        correlation += residual.T @ (weights * given)
        size += np.linalg.norm(np.sqrt(weights) * given) * np.linalg.norm(np.sqrt(weights) * residual)
    assert np.abs(correlation).max() < 1e-10 * size
