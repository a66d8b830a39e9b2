import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from synthetic import random_spectrum

from jaxsmw.core.pointwise_map import decode, matching_objective, nearest_neighbor, spectral_embeddings


# Around the sizes of blocks (128) and chunks (64).
@pytest.mark.parametrize(
    ("m", "n", "d"),
    [
        (1, 1, 1),
        (1, 63, 3),
        (2, 64, 20),
        (127, 65, 3),
        (128, 130, 1),
        (129, 500, 20),
        (600, 1, 3),
        (255, 64, 1),
        (256, 128, 3),
        (257, 63, 20),
    ],
)
def test_equals_brute_force(m, n, d):
    search = jax.jit(nearest_neighbor)
    for seed in range(10):
        generator = np.random.default_rng(seed)
        queries, database = generator.normal(size=(m, d)), generator.normal(size=(n, d))
        nearest = search(jnp.asarray(queries), jnp.asarray(database))
        assert nearest.dtype == jnp.int32
        np.testing.assert_array_equal(nearest, cdist(queries, database).argmin(axis=1))


def test_ties_go_to_the_lowest_index():
    corners = jnp.asarray([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]])
    for repeats in (1, 40, 100):
        database = jnp.tile(corners, (repeats, 1))
        assert nearest_neighbor(jnp.asarray([[1.0, 1.0], [2.0, 1.0], [3.0, 3.0]]), database).tolist() == [
            0,
            1,
            3,
        ]


@pytest.mark.parametrize("n", [5, 100, 300])
def test_masked_rows_are_never_chosen(n):
    generator = np.random.default_rng(0)
    queries, database = generator.normal(size=(80, 4)), generator.normal(size=(n, 4))
    mask = generator.random(n) < 0.3
    mask[-1] = True
    nearest = nearest_neighbor(jnp.asarray(queries), jnp.asarray(database), database_mask=jnp.asarray(mask))
    allowed = np.flatnonzero(mask)
    np.testing.assert_array_equal(nearest, allowed[cdist(queries, database[mask]).argmin(axis=1)])


def test_padding_changes_nothing():
    generator = np.random.default_rng(0)
    queries, database = (
        jnp.asarray(generator.normal(size=(90, 5))),
        jnp.asarray(generator.normal(size=(70, 5))),
    )
    padded = jnp.concatenate([database, jnp.zeros((200, 5))])
    mask = jnp.arange(270) < 70
    np.testing.assert_array_equal(
        nearest_neighbor(queries, padded, database_mask=mask), nearest_neighbor(queries, database)
    )


def test_float32_finds_the_same_far_from_the_origin():
    """Scores lose digits where norms are large against distances; the exact second look makes up for it."""
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
    """50 000 x 50 000 distances would take 10 GB in float32; the compiled program has to do with 1/50."""
    points = jax.ShapeDtypeStruct((50_000, 100), jnp.float32)
    memory = jax.jit(nearest_neighbor).lower(points, points).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 200e6


@pytest.mark.parametrize("convention", ["pullback", "pushforward"])
def test_decode_minimises_the_matching_objective(convention):
    x, y = random_spectrum(40, 8, seed=1), random_spectrum(30, 6, seed=2)
    shape = (8, 6) if convention == "pullback" else (6, 8)
    functional_map = jnp.asarray(np.random.default_rng(0).normal(size=shape))
    t = decode(functional_map, x, y, convention=convention)
    queries, database = spectral_embeddings(functional_map, x, y, convention=convention)
    distances = cdist(queries, database) ** 2
    np.testing.assert_array_equal(t, distances.argmin(axis=1))
    objective = matching_objective(functional_map, t, x, y, convention=convention)
    np.testing.assert_allclose(objective, np.asarray(x.vertex_areas) @ distances.min(axis=1), rtol=1e-10)
    worse = matching_objective(functional_map, t.at[0].set((t[0] + 1) % 30), x, y, convention=convention)
    assert worse > objective
