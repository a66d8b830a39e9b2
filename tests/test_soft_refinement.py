import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from messages import refused
from sampled_cases import first_always
from scipy.spatial.distance import cdist
from synthetic import in_precision, random_spectrum, stacked

from jaxsmw.core.banks import Logarithm, Meyer, Warped
from jaxsmw.core.functional_map import WaveletProblem, encode, pull_back
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.soft_maps import NearestFew, Recovery, Sinkhorn, Softmax
from jaxsmw.core.soft_refinement import WaveletPreservationLayer, refine_softly
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares
from jaxsmw.core.solutions.descriptors import DescriptorPair
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum

M, K = 120, 8
# These temperatures are high because the embedded vertices of random spectra are far from each other.
RECOVERIES = {"softmax": Softmax(10.0), "few": NearestFew(5, 10.0), "sinkhorn": Sinkhorn(10.0, 6)}


@pytest.fixture(scope="module")
def pair():
    """A shape, a shuffled and disturbed copy, and an initial map with a third of its matches wrong."""
    generator = np.random.default_rng(0)
    x = random_spectrum(M, K)
    order = generator.permutation(M)
    disturbed = x.eigenvectors[order] + 0.05 * generator.normal(size=(M, K))
    y = Spectrum(x.eigenvalues, disturbed, x.vertex_areas[order], x.mask[order])
    truth = np.argsort(order)
    initial_map = np.where(generator.random(M) < 1 / 3, generator.integers(0, M, M), truth)
    return x, y, jnp.asarray(initial_map, jnp.int32)


def points(m=150, n=140, d=4):
    generator = np.random.default_rng(1)
    sets = (jnp.asarray(generator.normal(size=(size, d))) for size in (m, n))
    areas = (jnp.asarray(generator.uniform(0.5, 1.5, size)) for size in (m, n))
    return *sets, *areas


def dense(recovery: Recovery, queries, database, a, b):
    """Returns the shares of all queries as a dense matrix."""
    return np.asarray(recovery(queries, database, a, b).pull_back(jnp.eye(database.shape[0])))


def test_softmax_follows_its_definition():
    queries, database, a, b = points()
    distances = cdist(queries, database, "sqeuclidean")
    a_, b_ = np.asarray(a / a.sum()), np.asarray(b / b.sum())
    temperature = 0.7 * a_ @ distances.min(axis=1)
    expected = b_ * np.exp(-distances / temperature)
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(dense(Softmax(0.7), queries, database, a, b), expected, atol=1e-12)
    # NearestFew gives the shares that Softmax would give if the database contained only the nearest rows.
    few = np.where(distances <= np.sort(distances, axis=1)[:, 4:5], expected, 0)
    few /= few.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(dense(NearestFew(5, 0.7), queries, database, a, b), few, atol=1e-12)
    found = NearestFew(5, 0.7)(queries, database, a, b)
    np.testing.assert_array_equal(found.pointwise_map(), distances.argmin(axis=1))
    np.testing.assert_allclose(
        dense(NearestFew(1000, 0.7), queries, database, a, b), expected, atol=1e-12
    )  # 1000 is more than the number of database rows


@pytest.mark.parametrize("recovery", RECOVERIES.values(), ids=RECOVERIES)
def test_rows_without_area_get_no_share_and_change_no_share(recovery):
    queries, database, a, b = points()
    padded = jnp.concatenate([database, queries[:7]]), jnp.concatenate([b, jnp.zeros(7)])
    shares = dense(recovery, queries, padded[0], a, padded[1])
    np.testing.assert_array_equal(shares[:, -7:], 0)
    np.testing.assert_allclose(shares[:, :-7], dense(recovery, queries, database, a, b), atol=1e-12)


def test_nearest_few_allows_fewer_rows_with_area_than_requested():
    queries, database, a, b = points(n=9)
    b = b.at[3:].set(0)
    shares = dense(NearestFew(5), queries, database, a, b)
    np.testing.assert_array_equal(shares[:, 3:], 0)
    np.testing.assert_allclose(shares.sum(axis=1), 1)


@pytest.mark.parametrize("recovery", [Softmax(0.01), NearestFew(5, 0.01)], ids=["softmax", "few"])
def test_soft_maps_at_low_temperature_are_nearest_neighbors(pair, recovery):
    x, y, initial_map = pair
    soft = refine_softly(x, y, initial_map, recovery=recovery, iterations=2)
    hard = refine(x, y, initial_map, iterations=3)
    assert soft.result == RESULTS.successful
    np.testing.assert_array_equal(soft.soft_map.pointwise_map(), hard.pointwise_map)
    np.testing.assert_allclose(soft.functional_map, hard.functional_map, atol=1e-9)


@pytest.mark.parametrize("convention", ["pullback", "pushforward"])
def test_a_soft_map_of_one_row_each_is_a_pointwise_map(pair, convention):
    x, y, initial_map = pair
    one = NearestFew(1)(y.eigenvectors[initial_map], y.eigenvectors, x.vertex_areas, y.vertex_areas)
    np.testing.assert_array_equal(pull_back(one, y.eigenvectors), pull_back(initial_map, y.eigenvectors))
    hard, soft = (encode(t, x, y, convention=convention) for t in (initial_map, one))
    np.testing.assert_allclose(soft, hard, atol=1e-14)
    g = Meyer(4)(x.eigenvalues, x.eigenvalues)
    for norm in ("area", "frobenius"):
        problem = WaveletProblem(x, y, g, g, convention)
        energies = (problem.energy(t, norm=norm) for t in (initial_map, one))
        expected, found = (energy(hard) for energy in energies)
        np.testing.assert_allclose(found, expected)


def leaves_and_directions(pair):
    """Returns the variables for which derivatives are tested, and one direction for each variable."""
    x, y, _ = pair
    leaves = {
        "eigenvalues of X": x.eigenvalues,
        "eigenvalues of Y": y.eigenvalues,
        "eigenvectors of X": x.eigenvectors,
        "eigenvectors of Y": y.eigenvectors,
        "vertex areas of Y": y.vertex_areas,
        "bank": jnp.asarray(10.0),
        "temperature": jnp.asarray(10.0),
        "weight": jnp.asarray(1.0),
        "descriptors": jnp.asarray(np.random.default_rng(2).normal(size=(M, 3))),
    }
    generator = np.random.default_rng(3)
    directions = {
        name: jnp.asarray(generator.normal(size=leaf.shape)) * jnp.mean(jnp.abs(leaf))
        for name, leaf in leaves.items()
    }
    return leaves, directions


def refined(pair, leaves, recovery, solution, **options):
    x, y, initial_map = pair
    x = Spectrum(leaves["eigenvalues of X"], leaves["eigenvectors of X"], x.vertex_areas, x.mask)
    y = Spectrum(leaves["eigenvalues of Y"], leaves["eigenvectors of Y"], leaves["vertex areas of Y"], y.mask)
    if solution == "descriptors":
        described = leaves["descriptors"]
        solution = RegularizedLeastSquares(
            orthogonality=None,
            descriptor_preservation=leaves["weight"],
            descriptors=DescriptorPair.project(described, described[::-1], x, y),
            tolerance=1e-8,
        )
    refiner = WaveletPreservation(Warped(Meyer(4), Logarithm(leaves["bank"])), solution)
    recovery = eqx.tree_at(lambda r: r.temperature, recovery, leaves["temperature"])
    return refine_softly(x, y, initial_map, refiner=refiner, recovery=recovery, **options)


CASES = {
    **{name: (recovery, Filtering(), "checkpointed") for name, recovery in RECOVERIES.items()},
    "unrolled": (Softmax(10.0), Filtering(), "unrolled"),
    "implicit": (Softmax(10.0), Filtering(), "implicit"),
    "implicit, few": (NearestFew(5, 10.0), Filtering(), "implicit"),
    "exact": (Softmax(10.0), LeastSquares(), "checkpointed"),
    "descriptors": (Softmax(10.0), "descriptors", "checkpointed"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", first_always(CASES.values(), always=len(RECOVERIES)), ids=CASES)
def test_derivatives_agree_with_finite_differences(pair, case):
    """The next test always compares the other kinds of differentiation with this kind."""
    recovery, solution, differentiation = case
    leaves, directions = leaves_and_directions(pair)
    implicit = differentiation == "implicit"
    options = {"iterations": 100, "tolerance": 1e-12} if implicit else {"iterations": 2}
    generator = np.random.default_rng(4)
    of_map, of_positions = (jnp.asarray(generator.normal(size=(size, K))) for size in (K, M))

    def loss(leaves):
        outcome = refined(pair, leaves, recovery, solution, differentiation=differentiation, **options)
        carried = outcome.soft_map.pull_back(leaves["eigenvectors of Y"])
        return jnp.sum(of_map * outcome.functional_map) + jnp.sum(of_positions * carried), outcome.result

    compiled = jax.jit(loss)
    (_, result), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(leaves)
    assert result == RESULTS.successful
    for name, leaf in leaves.items():
        if solution != "descriptors" and name in ("weight", "descriptors"):
            continue
        step = 1e-5 if solution == "descriptors" else 1e-6
        ahead, behind = (
            compiled(leaves | {name: leaf + sign * step * directions[name]})[0] for sign in (1, -1)
        )
        numerical = float(ahead - behind) / (2 * step)
        assert numerical != 0, name
        analytical = float(jnp.sum(gradient[name] * directions[name]))
        np.testing.assert_allclose(
            analytical, numerical, rtol=2e-3, atol=1e-4 if solution == "descriptors" else 1e-6, err_msg=name
        )


@pytest.mark.slow
def test_all_kinds_of_differentiation_agree_at_a_fixed_point(pair):
    leaves, _ = leaves_and_directions(pair)

    def gradient(differentiation):
        def loss(leaves):
            outcome = refined(
                pair,
                leaves,
                Softmax(10.0),
                Filtering(),
                differentiation=differentiation,
                iterations=60,
                tolerance=1e-12,
            )
            return jnp.sum(outcome.functional_map[:4] ** 2), outcome

        return jax.grad(loss, has_aux=True)(leaves)

    gradients = {way: gradient(way) for way in ("unrolled", "checkpointed", "implicit")}
    for way, (found, outcome) in gradients.items():
        assert outcome.result == RESULTS.successful and outcome.change < 1e-9
        for name, leaf in found.items():
            expected = gradients["unrolled"][0][name]
            tolerance = 1e-7 * float(jnp.abs(expected).max()) + 1e-10
            np.testing.assert_allclose(leaf, expected, atol=tolerance, err_msg=f"{way}, {name}")
    assert gradients["implicit"][1].iterations < 60 == gradients["unrolled"][1].iterations


def test_a_missing_fixed_point_is_reported(pair):
    x, y, initial_map = pair
    few = refine_softly(
        x, y, initial_map, recovery=Softmax(10.0), iterations=2, differentiation="implicit", tolerance=1e-9
    )
    assert few.result == RESULTS.fixed_point_not_reached


@pytest.mark.slow
def test_there_is_no_implicit_derivative_without_a_fixed_point(pair):
    x, y, initial_map = pair

    def loss(temperature, iterations):
        found = refine_softly(
            x,
            y,
            initial_map,
            recovery=Softmax(temperature),
            iterations=iterations,
            differentiation="implicit",
        )
        return jnp.sum(jnp.sin(found.functional_map)), found.result

    def forward(iterations):
        return jax.jvp(lambda t: loss(t, iterations), (jnp.asarray(10.0),), (jnp.asarray(1.0),), has_aux=True)

    value, tangent, result = forward(2)
    assert result == RESULTS.fixed_point_not_reached and jnp.isfinite(value) and jnp.isnan(tangent)
    with pytest.raises(RuntimeError, match="non-finite"):
        jax.block_until_ready(jax.grad(loss, has_aux=True)(jnp.asarray(10.0), 2))
    _, tangent, result = forward(100)
    assert result == RESULTS.successful
    gradient, _ = jax.grad(loss, has_aux=True)(jnp.asarray(10.0), 100)
    np.testing.assert_allclose(tangent, gradient, rtol=1e-2)


def test_a_soft_initial_map_has_a_derivative(pair):
    x, y, _ = pair

    def loss(features):
        initial_map = Softmax(100.0)(features, y.eigenvectors, x.vertex_areas, y.vertex_areas)
        return jnp.sum(
            refine_softly(x, y, initial_map, recovery=Softmax(10.0), iterations=1).functional_map[0]
        )

    assert float(jnp.abs(jax.grad(loss)(x.eigenvectors)).max()) > 1e-6


def test_the_layer_learns_features_that_match(pair):
    x, y, _ = pair
    truth = jnp.argmin(jnp.sum((x.eigenvectors[:, None] - y.eigenvectors[None]) ** 2, axis=2), axis=1)
    layer = WaveletPreservationLayer(recovery_of_features=Softmax(1.0), recovery=Softmax(10.0), iterations=1)
    features_x = x.eigenvectors @ jnp.asarray(np.random.default_rng(0).normal(size=(K, 3)))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(K, 3)))

    def loss(weights):
        outcome = layer(features_x, y.eigenvectors @ weights, x, y)
        error = outcome.soft_map.pull_back(y.eigenvectors) - y.eigenvectors[truth]
        return jnp.mean(jnp.sum(error**2, axis=1)), outcome

    descend = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (first, outcome), _ = descend(weights)
    assert outcome.functional_map.shape == (K, K)
    for _ in range(60):
        (now, outcome), gradient = descend(weights)
        weights -= 0.2 * gradient / jnp.linalg.norm(gradient)
    assert outcome.result == RESULTS.successful and now < 0.1 * first
    # The leaves of the layer are its trainable parameters: two temperatures.
    assert len(jax.tree.leaves(layer)) == 2


def test_models_of_any_library_can_use_the_layer(pair):
    x, y, _ = pair
    layer = WaveletPreservationLayer(recovery_of_features=Softmax(10.0), recovery=Softmax(10.0), iterations=1)

    def apply(parameters, inputs):
        """Applies a linear layer in the style of flax: a pure function of nested dictionaries."""
        return inputs @ parameters["params"]["kernel"]

    def loss(parameters, layer):
        outcome = layer(apply(parameters, x.eigenvectors), apply(parameters, y.eigenvectors), x, y)
        return jnp.mean((outcome.soft_map.pull_back(y.eigenvectors) - x.eigenvectors) ** 2)

    parameters = {"params": {"kernel": jnp.eye(K)[:, :5]}}
    beside, slope = jax.jit(jax.value_and_grad(lambda p: loss(p, layer)))(parameters)
    inside, slopes = jax.jit(jax.value_and_grad(lambda p: loss(p, p["layer"])))(parameters | {"layer": layer})
    assert beside == pytest.approx(float(inside))
    np.testing.assert_allclose(slope["params"]["kernel"], slopes["params"]["kernel"])
    assert 0 < float(jnp.abs(slope["params"]["kernel"]).max()) < float("inf")
    # The loss also has a derivative with respect to the layer.
    assert 0 < abs(float(slopes["layer"].recovery.temperature)) < float("inf")


@pytest.mark.parametrize("recovery", first_always(RECOVERIES.values()), ids=RECOVERIES)
def test_padding_changes_nothing(pair, recovery):
    x, y, initial_map = pair
    options = {"recovery": recovery, "iterations": 2}
    expected = refine_softly(x, y, initial_map, **options)
    found = refine_softly(x.pad(M + 9), y.pad(M + 4), jnp.pad(initial_map, (0, 9)), **options)
    np.testing.assert_allclose(found.functional_map, expected.functional_map, atol=1e-10)


def test_signs_of_eigenvectors_do_not_matter(pair):
    x, y, initial_map = pair
    signs = jnp.asarray([[1.0, -1.0] * (K // 2)])
    turned = eqx.tree_at(lambda s: s.eigenvectors, y, y.eigenvectors * signs)
    options = {"recovery": Softmax(10.0), "iterations": 2}
    expected, found = (refine_softly(x, shape, initial_map, **options) for shape in (y, turned))
    np.testing.assert_allclose(found.functional_map * signs, expected.functional_map, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("differentiation", first_always(["checkpointed", "implicit"]))
def test_vmap_over_pairs_equals_a_loop(pair, differentiation):
    x, y, initial_map = pair
    options = {"recovery": Softmax(10.0), "iterations": 30, "differentiation": differentiation}

    def loss(x, y, initial_map):
        return jnp.sum(refine_softly(x, y, initial_map, **options).functional_map[0])

    two = [(x, y, initial_map), (y, x, initial_map[::-1])]
    both = stacked(*two)
    gradient = jax.grad(lambda v, x, y, s: loss(eqx.tree_at(lambda z: z.eigenvectors, x, v), y, s))
    found = jax.vmap(gradient)(both[0].eigenvectors, *both)
    for each, (a, b, s) in zip(found, two, strict=True):
        np.testing.assert_allclose(each, gradient(a.eigenvectors, a, b, s), atol=1e-5)


@pytest.mark.slow
def test_float32_in_float32_out(pair):
    spectra = in_precision(pair[:2], np.float32)
    for recovery in RECOVERIES.values():
        for differentiation in ("checkpointed", "implicit"):
            found = refine_softly(*spectra, pair[2], recovery=recovery, differentiation=differentiation)
            assert found.functional_map.dtype == jnp.float32
            assert found.change.dtype == jnp.float32


@pytest.mark.slow
@pytest.mark.parametrize("recovery", first_always([Softmax(), NearestFew()]), ids=["softmax", "few"])
@pytest.mark.parametrize("differentiation", ["checkpointed", "implicit"])
def test_derivatives_need_far_less_than_a_matrix_of_all_pairs(recovery, differentiation):
    n, k = 5000, 20
    spectrum = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape, np.dtype(np.float32) if a.dtype == np.float64 else a.dtype),
        jax.eval_shape(lambda: Spectrum(jnp.ones(k), jnp.ones((n, k)), jnp.ones(n), jnp.ones(n, bool))),
    )

    def loss(x, y, initial_map):
        soft = refine_softly(
            x, y, initial_map, recovery=recovery, iterations=8, differentiation=differentiation
        )
        return jnp.sum(soft.soft_map.pull_back(y.eigenvectors) ** 2)

    program = jax.jit(jax.grad(loss, allow_int=True)).lower(
        spectrum, spectrum, jax.ShapeDtypeStruct((n,), jnp.int32)
    )
    assert program.compile().memory_analysis().temp_size_in_bytes < n * n * 4 / 3


def test_failures_are_reported(pair):
    x, y, initial_map = pair
    damaged = eqx.tree_at(lambda s: s.eigenvectors, y, y.eigenvectors.at[3, 2].set(jnp.nan))
    assert refine_softly(x, damaged, initial_map).result == RESULTS.nonfinite_spectrum
    # All entries of a map are -1 if its refinement failed.
    for nowhere in (initial_map.at[0].set(M), -jnp.ones_like(initial_map)):
        assert refine_softly(x, y, nowhere).result == RESULTS.invalid_initial_map
    few = NearestFew(3)(x.eigenvectors, y.eigenvectors, x.vertex_areas, y.vertex_areas)
    assert refine_softly(x, y, few).result == RESULTS.successful
    elsewhere = eqx.tree_at(lambda t: t.rows, few, few.rows.at[4, 2].set(M))
    assert refine_softly(x, y, elsewhere).result == RESULTS.invalid_initial_map
    # A training step can produce a negative temperature.
    below_zero = eqx.tree_at(lambda r: r.temperature, Softmax(), jnp.asarray(-0.1))
    assert refine_softly(x, y, initial_map, recovery=below_zero).result == RESULTS.nonfinite_functional_map


@pytest.mark.slow
@pytest.mark.parametrize(
    "recovery", first_always([Softmax(), NearestFew(5), Sinkhorn()]), ids=["softmax", "few", "sinkhorn"]
)
def test_a_common_shift_changes_nothing_in_single_precision(recovery):
    queries, database, a, b = (value.astype(jnp.float32) for value in points())
    far = jnp.asarray([[1000.0, -300.0, 500.0, 0.0]], jnp.float32)
    queries, database = (jnp.round(p * 64) / 64 for p in (queries, database))  # makes shifts exact
    expected = recovery(queries, database, a, b).pull_back(database)
    found = recovery(queries + far, database + far, a, b).pull_back(database)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_functions_of_another_shape_are_refused(pair):
    x, y, _ = pair
    for recovery in (Softmax(), NearestFew(3)):
        found = recovery(x.eigenvectors, y.eigenvectors, x.vertex_areas, y.vertex_areas)
        with pytest.raises((ValueError, TypeCheckError)):
            found.pull_back(y.eigenvectors[:, 0])


def test_invalid_arguments_are_refused(pair):
    x, y, initial_map = pair
    with pytest.raises(ValueError, match="positive tolerance, not 0"):
        refine_softly(x, y, initial_map, tolerance=0.0)
    with pytest.raises((TypeError, TypeCheckError)):
        refine_softly(x, y, initial_map, recovery=0.1)
    with pytest.raises(ValueError, match=r"initial map has shape \(117,\)"):
        refine_softly(x, y, initial_map[:-3])
    short = Softmax()(x.eigenvectors[3:], y.eigenvectors, x.vertex_areas[3:], y.vertex_areas)
    with refused("117 to 120 points", "X has 120 vertices", "Y has 120", error=ValueError):
        refine_softly(x, y, short)
    with pytest.raises(ValueError, match="Sinkhorn needs at least 1 iteration"):
        Sinkhorn(iterations=0)
    with pytest.raises((TypeError, TypeCheckError), match="iterations"):
        Sinkhorn(iterations=2.5)
    with pytest.raises((TypeError, TypeCheckError), match="number"):
        NearestFew(2.5)
    with pytest.raises((TypeError, TypeCheckError), match=r"recovery.of.features"):
        WaveletPreservationLayer(recovery_of_features=0.1)
    with pytest.raises((ValueError, TypeCheckError), match="features"):
        WaveletPreservationLayer()(x.eigenvectors, y.eigenvectors[:, 1:], x, y)
    with pytest.raises((ValueError, TypeCheckError), match="differentiation"):
        refine_softly(x, y, initial_map, differentiation="forward")
    with pytest.raises(ValueError, match="same jax_enable_x64"):
        refine_softly(x, jax.tree.map(lambda a: a.astype(jnp.float32), y), initial_map)
    with pytest.raises(ValueError, match="at least 1 row"):
        NearestFew(0)
    for recovery in (Softmax, NearestFew, Sinkhorn):
        with pytest.raises(ValueError, match=f"temperature of {recovery.__name__}"):
            recovery(temperature=0.0)


@pytest.mark.parametrize("loop", [refine, refine_softly])
def test_iterations_must_be_an_integer(pair, loop):
    x, y, initial_map = pair
    two = loop(x, y, initial_map, iterations=2)
    for integer in (np.int64(2), np.uint8(2), jnp.asarray(2)):
        np.testing.assert_array_equal(
            loop(x, y, initial_map, iterations=integer).functional_map, two.functional_map
        )
    for other in (2.0, np.float64(2), "2", None):
        with pytest.raises(TypeError, match=f"{loop.__name__} needs a whole number of iterations"):
            loop(x, y, initial_map, iterations=other)
    with pytest.raises(TypeError, match="known at compile time"):
        jax.jit(lambda number: loop(x, y, initial_map, iterations=number).functional_map)(2)
    for few in (0, np.int64(-1)):
        with pytest.raises(ValueError, match=f"{loop.__name__} needs at least 1 iteration, not {few}"):
            loop(x, y, initial_map, iterations=few)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", first_always([np.float32, np.float64]))
@pytest.mark.parametrize("kind", first_always([Softmax, NearestFew, Sinkhorn]))
def test_derivatives_exist_at_the_lowest_temperatures(pair, kind, dtype):
    x, y, initial_map = in_precision(pair, dtype)

    def size(temperature, factor):
        scaled = eqx.tree_at(lambda s: s.eigenvectors, y, y.eigenvectors * factor)
        options = {"recovery": kind(temperature=temperature), "iterations": 2}
        return jnp.sum(refine_softly(x, scaled, initial_map, **options).functional_map ** 2)

    differentiate = jax.jit(jax.value_and_grad(size, (0, 1)))
    one = jnp.asarray(1, dtype)
    # At these low temperatures, every soft map is a nearest-neighbour map, so the temperature has no effect.
    value, (_, expected) = differentiate(jnp.asarray(1e-5), one)
    for temperature in (1e-12, 1e-30, 1e-37):
        found, (in_temperature, in_factor) = differentiate(jnp.asarray(temperature), one)
        assert float(in_temperature) == 0
        np.testing.assert_allclose(found, value, rtol=1e-5)
        np.testing.assert_allclose(in_factor, expected, rtol=1e-4)
