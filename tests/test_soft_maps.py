"""Sinkhorn iterations agree with dense iterations, and have the expected invariances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.special import logsumexp

from jaxsmw.core.soft_maps import SoftMap, sinkhorn

compiled = jax.jit(sinkhorn, static_argnames="iterations")


def points(m=150, n=170, d=4, seed=0, dtype=np.float64):
    """Returns two point sets and their areas. The m queries fill more than one block of queries."""
    generator = np.random.default_rng(seed)
    queries, database = generator.normal(size=(m, d)), generator.normal(size=(n, d))
    areas = {
        "query_areas": jnp.asarray(generator.uniform(0.5, 1.5, m), dtype),
        "database_areas": jnp.asarray(generator.uniform(0.5, 1.5, n), dtype),
    }
    return (jnp.asarray(queries, dtype), jnp.asarray(database, dtype)), areas


def plan(soft: SoftMap) -> np.ndarray:
    """Returns the dense transport plan of a soft map."""
    n = len(soft.database)
    return np.asarray(soft.query_areas)[:, None] * np.asarray(soft.pull_back(jnp.eye(n)))


def dense_plan(queries, database, a, b, temperature, iterations=3000):
    a, b = a / a.sum(), b / b.sum()
    kernel = -cdist(queries, database, "sqeuclidean") / temperature
    g = np.zeros(len(b))
    for _ in range(iterations):
        f = -logsumexp(kernel + np.log(b) + g, axis=1)
        g = -logsumexp(kernel + (np.log(a) + f)[:, None], axis=0)
    return np.exp(kernel + (np.log(a) + f)[:, None] + np.log(b) + g)


@pytest.mark.slow
def test_agrees_with_dense_iterations():
    (queries, database), areas = points()
    soft = compiled(queries, database, **areas, temperature=0.5, iterations=3000, tolerance=1e-13)
    assert soft.converged and soft.iterations < 3000
    nearest = cdist(queries, database, "sqeuclidean").min(axis=1)
    a, b = np.asarray(soft.query_areas), np.asarray(soft.database_areas)
    assert float(soft.temperature) == pytest.approx(0.5 * a @ nearest)
    found = plan(soft)
    np.testing.assert_allclose(
        found, dense_plan(queries, database, a, b, float(soft.temperature)), atol=1e-12
    )
    np.testing.assert_allclose(found.sum(axis=1), a, rtol=1e-12)
    np.testing.assert_allclose(found.sum(axis=0), b, atol=1e-12)
    np.testing.assert_array_equal(soft.pointwise_map(), np.argmax(found / b, axis=1))


@pytest.mark.parametrize("iterations", [1, 5])
def test_the_residual_is_the_error_of_the_columns(iterations):
    (queries, database), areas = points()
    soft = compiled(queries, database, **areas, temperature=0.2, iterations=iterations, tolerance=1e-6)
    assert not soft.converged and soft.iterations == iterations
    columns = plan(soft).sum(axis=0)
    assert float(soft.residual) == pytest.approx(np.abs(columns - np.asarray(soft.database_areas)).sum() / 2)


def test_the_cost_is_close_to_the_cost_of_the_best_assignment():
    (queries, database), _ = points(40, 40, 2)
    areas = {"query_areas": jnp.ones(40), "database_areas": jnp.ones(40)}
    soft = compiled(queries, database, **areas, temperature=0.2, iterations=20000, tolerance=1e-4)
    assert soft.converged
    distances = cdist(queries, database, "sqeuclidean")
    least = distances[linear_sum_assignment(distances)].mean()
    more = np.sum(plan(soft) * distances) - least
    # No plan with these marginals costs less than `least`. The entropy in the objective is at most log 40.
    assert -1e-4 * distances.max() < more < float(soft.temperature) * np.log(40) < 0.4 * least


@pytest.mark.parametrize("place", ["far", "origin"])
def test_padding_changes_nothing(place):
    (queries, database), areas = points()
    soft = compiled(queries, database, **areas, iterations=50)
    far = 1e3 if place == "far" else 0.0
    more = (jnp.concatenate([each, jnp.full((30, 4), far)]) for each in (queries, database))
    padded = compiled(*more, **{name: jnp.pad(each, (0, 30)) for name, each in areas.items()}, iterations=50)
    m, n = len(queries), len(database)
    np.testing.assert_allclose(padded.potentials[:n], soft.potentials, atol=1e-11)
    np.testing.assert_array_equal(padded.potentials[n:], 0)
    np.testing.assert_allclose(plan(padded)[:m, :n], plan(soft), atol=1e-14)
    assert not plan(padded)[m:].any() and not plan(padded)[:, n:].any()
    np.testing.assert_array_equal(padded.pointwise_map()[:m], soft.pointwise_map())
    assert padded.pointwise_map().max() < n and np.isfinite(padded.pull_back(jnp.eye(n + 30))).all()


def test_neither_numbering_nor_signs_nor_units_matter():
    (queries, database), areas = points()
    soft = compiled(queries, database, **areas, iterations=50)
    generator = np.random.default_rng(1)
    p, q = generator.permutation(len(queries)), generator.permutation(len(database))
    factors = 7 * np.array([1.0, -1, 1, -1])
    other = compiled(
        queries[p] * factors[None],
        database[q] * factors[None],
        query_areas=3 * areas["query_areas"][p],
        database_areas=5 * areas["database_areas"][q],
        iterations=50,
    )
    np.testing.assert_allclose(plan(other), plan(soft)[p][:, q], atol=1e-13)
    np.testing.assert_array_equal(q[np.asarray(other.pointwise_map())], np.asarray(soft.pointwise_map())[p])


def test_vmap_equals_a_loop():
    pairs = [points(seed=seed) for seed in range(3)]
    stacked, areas = jax.tree.map(lambda *each: jnp.stack(each), *pairs)

    def run(both, areas):
        soft = sinkhorn(*both, **areas, iterations=40, tolerance=0.02)
        return soft, soft.pull_back(both[1]), soft.pointwise_map()

    together = jax.jit(jax.vmap(run))(stacked, areas)
    alone = [jax.jit(run)(*pair) for pair in pairs]
    # The pairs in the batch need different numbers of iterations.
    assert len({int(soft.iterations) for soft, _, _ in alone}) > 1
    for found, expected in zip(
        jax.tree.leaves(together), zip(*map(jax.tree.leaves, alone), strict=True), strict=True
    ):
        np.testing.assert_allclose(found, np.stack(expected), atol=1e-12)


def test_compiles_once_for_all_temperatures_and_tolerances():
    traces = []

    @jax.jit
    def run(both, areas, temperature, tolerance):
        traces.append(1)
        return sinkhorn(*both, **areas, temperature=temperature, tolerance=tolerance, iterations=3)

    for temperature in (0.1, 0.5, 2.0):
        run(*points(), jnp.asarray(temperature), jnp.asarray(temperature / 100))
    assert len(traces) == 1


def test_derivatives_agree_with_finite_differences():
    (queries, database), areas = points(30, 25, 3)
    areas["query_areas"] = areas["query_areas"].at[3].set(0)
    areas["database_areas"] = areas["database_areas"].at[:2].set(0)

    @jax.jit
    def loss(queries, database, areas):
        soft = sinkhorn(queries, database, **areas, iterations=30, tolerance=0.0)
        return jnp.sum(soft.pull_back(jnp.sin(database)) ** 2)

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(queries, database, areas)
    assert all(np.isfinite(each).all() for each in jax.tree.leaves(gradients))
    generator, step = np.random.default_rng(2), 1e-6
    directions = [jnp.asarray(generator.normal(size=each.shape)) for each in (queries, database)]
    ahead, behind = (
        loss(queries + sign * step * directions[0], database + sign * step * directions[1], areas)
        for sign in (1, -1)
    )
    expected = sum(
        jnp.sum(gradient * direction) for gradient, direction in zip(gradients[:2], directions, strict=True)
    )
    assert float(ahead - behind) / (2 * step) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.slow
def test_iterations_converge_for_degenerate_points():
    one, three = jnp.zeros((1, 2)), jnp.asarray([[0.0, 0], [1, 0], [0, 1]])
    for queries, database in (
        (one, one),
        (one, three),
        (three, one),
        (three, three),
        (jnp.zeros((4, 2)), jnp.zeros((5, 2))),
        (jnp.repeat(three, 3, axis=0), jnp.repeat(three, 2, axis=0)),
        (jnp.zeros((3, 3)), jnp.eye(3)),
    ):
        m, n = len(queries), len(database)
        soft = compiled(queries, database, query_areas=jnp.ones(m), database_areas=jnp.ones(n))
        assert soft.converged, (m, n, float(soft.residual))
        assert np.isfinite(plan(soft)).all()
        np.testing.assert_allclose(plan(soft).sum(axis=0), 1 / n, atol=0.02 / n)


def test_distant_rows_get_their_share():
    """In float32, the share of a distant row underflows to zero in the first iterations."""
    (queries, database), _ = points(60, 60, 2, dtype=np.float32)
    database, ones = database.at[0].set(10.0), jnp.ones(60, jnp.float32)
    soft = compiled(
        queries, database, query_areas=ones, database_areas=ones, temperature=1.0, iterations=1000
    )
    assert soft.potentials.dtype == jnp.float32
    assert soft.converged, float(soft.residual)
    assert soft.potentials[0] > 200  # exp(200) overflows in float32


def test_nan_is_not_reported_as_convergence():
    (queries, database), areas = points(20, 20)
    broken = queries.at[0, 0].set(jnp.nan)
    assert not compiled(broken, database, **areas, iterations=5).converged
    assert not sinkhorn(np.asarray(broken), np.asarray(database), **areas, iterations=5).converged
    with pytest.raises(ValueError, match="at least 1 iteration"):
        sinkhorn(queries, database, **areas, iterations=0)


@pytest.mark.parametrize("what", ["map", "gradient"])
def test_no_array_of_all_queries_and_rows_is_stored(what):
    m, n, d = 6000, 5000, 20
    shapes = [jax.ShapeDtypeStruct(s, jnp.float32) for s in ((m, d), (n, d), (m,), (n,))]

    def run(queries, database, a, b):
        soft = sinkhorn(queries, database, query_areas=a, database_areas=b, iterations=10)
        return jnp.sum(soft.pull_back(database)), soft

    function = run if what == "map" else jax.grad(run, has_aux=True)
    memory = jax.jit(function).lower(*shapes).compile().memory_analysis()
    assert memory.temp_size_in_bytes < m * n * 4 / 4
