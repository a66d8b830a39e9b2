from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial.distance import cdist
from synthetic import bumpy_mesh

from jaxsmw.core.search import (
    SearchProblem,
    make_patches,
    nearest_in_both,
    nearest_neighbor,
    nearest_neighbor_in_patches,
    queries_per_block,
    search_in_patches,
)
from jaxsmw.geometry.eigenbasis import compute_spectrum


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
def test_two_searches_in_one_loop_equal_two_searches(sizes):
    """The numbers of queries, of rows and of dimensions can differ."""
    generator = np.random.default_rng(0)
    problems = [
        SearchProblem(
            jnp.asarray(generator.normal(size=(m, d))),
            jnp.asarray(generator.normal(size=(n, d))),
            jnp.arange(n) % 3 != 1,
        )
        for m, n, d in sizes
    ]
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
    monkeypatch.setattr("jaxsmw.core.search.queries_per_block", lambda m, n: size)
    check_against_brute_force(nearest_neighbor, 300, 450, 7, draws=3)


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


def in_patches(queries, database, *, size=20, rank=3, query_mask=None, database_mask=None):
    patches = (
        make_patches(rows, jnp.ones(len(rows), bool) if mask is None else mask, size=size, rank=rank)
        for rows, mask in ((queries, query_mask), (database, database_mask))
    )
    return nearest_neighbor_in_patches(queries, database, *patches)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("m", "n", "d"),
    first_always(
        [(1, 1, 1), (130, 210, 5), (3, 50, 2), (50, 3, 30), (300, 300, 1), (257, 500, 20)], always=2, names=3
    ),
)
def test_search_in_patches_equals_brute_force_for_random_points(m, n, d):
    """If points are spread evenly in all dimensions, the search cannot skip any patch."""
    check_against_brute_force(in_patches, m, n, d, draws=5)


@pytest.fixture(scope="module")
def embedding():
    """The spectral embedding of a surface in 30 dimensions."""
    return compute_spectrum(bumpy_mesh(4), 30).eigenvectors


@pytest.mark.parametrize("dtype", first_always([jnp.float32, jnp.float64]))
@pytest.mark.parametrize("noise", first_always([0.3, 0.0, 3.0]))
def test_search_in_patches_equals_exhaustive_search_on_surfaces(embedding, dtype, noise):
    """The noise levels give a perfect map, a poor map and a random map."""
    generator = np.random.default_rng(0)
    turned, _ = np.linalg.qr(np.eye(30) + noise * generator.normal(size=(30, 30)) / np.sqrt(30))
    database = jnp.asarray(embedding @ (turned * generator.uniform(0.1, 1, 30)), dtype)
    queries = embedding.astype(dtype)
    found, wanted = jax.jit(in_patches)(queries, database), jax.jit(nearest_neighbor)(queries, database)
    same = np.asarray(found) == np.asarray(wanted)
    assert same.mean() > (0.999 if dtype == jnp.float32 else 1 - 1e-9)
    exact = [
        np.linalg.norm(np.asarray(queries - database[rows], np.float64), axis=1) for rows in (found, wanted)
    ]
    np.testing.assert_allclose(*exact, rtol=1e-6 if dtype == jnp.float32 else 1e-13)


@pytest.mark.slow
def test_patches_contain_all_points_and_have_equal_sizes(embedding):
    mask = jnp.asarray(np.random.default_rng(0).random(len(embedding)) < 0.9)
    patches = make_patches(embedding, mask, size=40, rank=4)
    numbers, masks = (field.reshape(-1, field.shape[2]) for field in (patches.rows, patches.mask))
    assert numbers.shape[1] == -(-2562 // numbers.shape[0]) and 28 <= numbers.shape[1] <= 57
    np.testing.assert_array_equal(np.sort(numbers[masks]), np.flatnonzero(mask))
    everywhere = jnp.var(embedding[:, :6], axis=0).sum()
    for rows, valid in zip(numbers, masks, strict=True):
        assert not valid.any() or jnp.var(embedding[rows[valid]][:, :6], axis=0).sum() < 0.3 * everywhere


@pytest.mark.slow
def test_patches_ignore_masked_points(embedding):
    generator = np.random.default_rng(0)
    query_mask, database_mask = (jnp.asarray(generator.random(2562) < 0.5) for _ in range(2))
    found = in_patches(embedding, embedding, query_mask=query_mask, database_mask=database_mask)
    wanted = nearest_neighbor(embedding, embedding, database_mask=database_mask)
    np.testing.assert_array_equal(found[query_mask], wanted[query_mask])


@pytest.mark.slow
def test_patches_break_ties_like_the_exhaustive_search(embedding):
    """Every point occurs twice, in rows that are far apart."""
    twice = jnp.concatenate([embedding, embedding])
    np.testing.assert_array_equal(in_patches(embedding, twice, size=64), jnp.arange(2562))


@pytest.mark.sampled
def test_search_in_patches_gives_the_same_under_vmap(embedding):
    turned = jnp.stack([embedding, embedding * jnp.linspace(1, 0.1, 30)[None, :]])
    looped = [in_patches(embedding, database) for database in turned]
    np.testing.assert_array_equal(jax.vmap(in_patches, (None, 0))(embedding, turned), jnp.stack(looped))


@pytest.mark.slow
def test_most_patches_are_skipped(embedding):
    for scales, most in ((jnp.ones(30), 0.15), (jnp.linspace(1, 0.1, 30), 0.3)):
        ones = jnp.ones(2562, bool)
        queries, database = (make_patches(embedding, ones, size=size, rank=4) for size in (100, 20))
        _, searched = search_in_patches(embedding, embedding * scales[None, :], queries, database)
        assert 0 < searched.patches.mean() / database.mask[..., 0].size < most


@pytest.mark.slow
def test_most_regions_are_skipped():
    points = compute_spectrum(bumpy_mesh(5), 30).eigenvectors
    ones = jnp.ones(len(points), bool)
    queries, database = (make_patches(points, ones, size=size, rank=4) for size in (100, 20))
    assert database.rows.shape[:2] == (32, 16)
    found, searched = search_in_patches(points, points, queries, database)
    np.testing.assert_array_equal(found, jnp.arange(len(points)))
    assert 0 < searched.regions.mean() < 0.3 * 32


@pytest.mark.slow
def test_search_in_patches_never_stores_all_distances():
    points, mask = jax.ShapeDtypeStruct((50_000, 100), jnp.float32), jax.ShapeDtypeStruct((50_000,), bool)
    patches = [jax.eval_shape(partial(make_patches, size=s, rank=5), points, mask) for s in (128, 128)]
    memory = jax.jit(nearest_neighbor_in_patches).lower(points, points, *patches).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 200e6
