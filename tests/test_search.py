import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial.distance import cdist
from synthetic import to_namespace

from jaxsmw.core.search import SearchProblem, nearest_in_both, nearest_neighbor
from jaxsmw.core.traced_search import queries_per_block


def check_against_brute_force(search, m, n, d, *, draws):
    search = jax.jit(search)
    for seed in range(draws):
        generator = np.random.default_rng(seed)
        queries, database = generator.normal(size=(m, d)), generator.normal(size=(n, d))
        nearest = search(jnp.asarray(queries), jnp.asarray(database))
        assert nearest.dtype == jnp.int32
        np.testing.assert_array_equal(nearest, cdist(queries, database).argmin(axis=1))


# Many sizes are close to multiples of the block size (128) or the chunk size (64).
@pytest.mark.parametrize(
    ("m", "n", "d"),
    first_always(
        [
            (1, 1, 1),
            (127, 65, 3),
            (128, 130, 1),
            (257, 63, 20),
            (1, 63, 3),
            (2, 64, 20),
            (129, 500, 20),
            (600, 1, 3),
            (255, 64, 1),
            (256, 128, 3),
        ],
        always=4,
        names=3,
    ),
)
def test_equals_brute_force(m, n, d):
    check_against_brute_force(nearest_neighbor, m, n, d, draws=10)


@pytest.mark.parametrize(
    "sizes", [((30, 200, 4), (150, 90, 7)), ((64, 64, 3), (64, 64, 3)), ((1, 5, 2), (300, 2, 1))]
)
def test_two_searches_at_once_equal_two_searches(sizes, namespace):
    """The numbers of queries, of rows and of dimensions can differ."""
    generator = np.random.default_rng(0)
    problems = [
        SearchProblem(generator.normal(size=(m, d)), generator.normal(size=(n, d)), np.arange(n) % 3 != 1)
        for m, n, d in sizes
    ]
    problems = to_namespace(problems, namespace)
    for one, found in zip(problems, nearest_in_both(*problems), strict=True):
        distances = cdist(one.queries, one.database) + np.where(one.database_mask, 0, np.inf)
        np.testing.assert_array_equal(found, np.argmin(distances, axis=1))


@pytest.mark.parametrize(
    ("m", "n", "expected"),
    [(300, 5000, 384), (5000, 5000, 5120), (100_000, 100_000, 640), (10**6, 10**6, 128)],
)
def test_blocks_on_accelerators_are_large_but_limited(m, n, expected, monkeypatch):
    assert queries_per_block(m, n) == 128
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert queries_per_block(m, n) == expected


@pytest.mark.parametrize("size", [256, 384])
def test_the_size_of_blocks_changes_no_match(size, monkeypatch):
    monkeypatch.setattr("jaxsmw.core.traced_search.queries_per_block", lambda m, n: size)
    check_against_brute_force(nearest_neighbor, 300, 450, 7, draws=3)


def test_ties_go_to_the_lowest_index(namespace):
    corners = np.asarray([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]])
    queries = np.asarray([[1.0, 1.0], [2.0, 1.0], [3.0, 3.0]])
    for repeats in (1, 40, 100):
        arguments = to_namespace((queries, np.tile(corners, (repeats, 1))), namespace)
        assert nearest_neighbor(*arguments).tolist() == [0, 1, 3]


@pytest.mark.parametrize("n", [5, 100, 300])
def test_masked_rows_are_never_chosen(n, namespace):
    generator = np.random.default_rng(0)
    queries, database = generator.normal(size=(80, 4)), generator.normal(size=(n, 4))
    mask = generator.random(n) < 0.3
    mask[-1] = True
    arguments = to_namespace((queries, database, mask), namespace)
    nearest = nearest_neighbor(*arguments[:2], database_mask=arguments[2])
    allowed = np.flatnonzero(mask)
    np.testing.assert_array_equal(nearest, allowed[cdist(queries, database[mask]).argmin(axis=1)])


def test_padding_changes_nothing(namespace):
    generator = np.random.default_rng(0)
    queries, database = generator.normal(size=(90, 5)), generator.normal(size=(70, 5))
    padded, mask = np.concatenate([database, np.zeros((200, 5))]), np.arange(270) < 70
    queries, database, padded, mask = to_namespace((queries, database, padded, mask), namespace)
    np.testing.assert_array_equal(
        nearest_neighbor(queries, padded, database_mask=mask), nearest_neighbor(queries, database)
    )


def test_float32_finds_the_same_far_from_the_origin():
    """Search scores lose digits if norms are large, so distances decide between the two best candidates."""
    generator = np.random.default_rng(0)
    database = generator.normal(size=(1000, 10)) + 20
    queries = database[generator.permutation(1000)] + 1e-3 * generator.normal(size=(1000, 10))
    single = nearest_neighbor(jnp.asarray(queries, jnp.float32), jnp.asarray(database, jnp.float32))
    exact = cdist(queries, database).argmin(axis=1)
    assert np.mean(np.asarray(single) == exact) == 1


def test_vmap_equals_a_loop():
    generator = np.random.default_rng(0)
    queries, database = (
        jnp.asarray(generator.normal(size=(3, 70, 4))),
        jnp.asarray(generator.normal(size=(3, 90, 4))),
    )
    looped = jnp.stack([nearest_neighbor(q, b) for q, b in zip(queries, database, strict=True)])
    np.testing.assert_array_equal(jax.vmap(nearest_neighbor)(queries, database), looped)


def test_search_never_stores_all_distances():
    """All 50 000 x 50 000 distances would take 10 GB in float32. The program uses less than 0.2 GB."""
    points = jax.ShapeDtypeStruct((50_000, 100), jnp.float32)
    memory = jax.jit(nearest_neighbor).lower(points, points).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 200e6
