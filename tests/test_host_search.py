import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial.distance import cdist
from synthetic import bumpy_mesh

from jaxsmw.core import host_search
from jaxsmw.core.host_search import nearest_in_both, nearest_neighbor
from jaxsmw.core.search import SearchProblem
from jaxsmw.core.search import nearest_neighbor as nearest_neighbor_jax
from jaxsmw.geometry.eigenbasis import compute_spectrum

METHODS = ["exhaustive", "tree", "clusters"]


@pytest.fixture(params=METHODS)
def method(request, monkeypatch):
    """Force one of the searches."""
    force(monkeypatch, request.param)
    return request.param


def force(monkeypatch, method):
    if method == "tree":
        monkeypatch.setattr(host_search, "_SHARE", np.inf)
        monkeypatch.setattr(host_search, "_QUERIES_PER_AXIS", 0)
        monkeypatch.setattr(host_search, "_LEAF", 1)
    else:
        monkeypatch.setattr(host_search, "_SHARE", -1)
    if method == "clusters":
        for name, value in (
            ("_CLUSTERED_FROM", 1),
            ("_POINTS_PER_QUERY", 10**6),
            ("_NEEDED", np.inf),
            ("_CLUSTER", 10),
            ("_PARTS", 2),
        ):
            monkeypatch.setattr(host_search, name, value)


def brute_force(queries, database):
    return cdist(queries, database).argmin(axis=1)


# Some sizes are close to multiples of the block size (256); in two cases, there are more dimensions than rows.
@pytest.mark.parametrize(
    ("m", "n", "d"),
    [
        (1, 1, 1),
        (0, 5, 3),
        (257, 63, 20),
        (600, 1, 3),
        (255, 64, 1),
        (256, 500, 20),
        (50, 3, 30),
        (9, 40, 60),
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_equals_brute_force(m, n, d, dtype, method):
    generator = np.random.default_rng(0)
    queries, database = (generator.normal(size=(rows, d)).astype(dtype) for rows in (m, n))
    nearest = nearest_neighbor(queries, database)
    assert nearest.dtype == np.int32
    np.testing.assert_array_equal(nearest, brute_force(queries, database))


def test_a_database_of_several_chunks_equals_brute_force(monkeypatch):
    monkeypatch.setattr(host_search, "_CHUNK", 100)
    generator = np.random.default_rng(0)
    queries, database = generator.normal(size=(300, 20)), generator.normal(size=(901, 20))
    np.testing.assert_array_equal(nearest_neighbor(queries, database), brute_force(queries, database))


def test_ties_go_to_the_lowest_index(method):
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]], np.float32)
    for repeats in (1, 40, 3000):
        database = np.tile(corners, (repeats, 1))
        database[4:8] = -database[4:8] * -1  # some zeros become negative zeros
        queries = np.array([[0.1, 0.1], [1.9, 0.1], [0.2, 1.9], [3.0, 3.0]], np.float32)
        assert nearest_neighbor(queries, database).tolist() == [0, 1, 2, 3]


def test_exhaustive_search_gives_equal_distances_to_the_lowest_index():
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]])
    queries = np.array([[1.0, 1.0], [2.0, 1.0], [3.0, 3.0]])
    for repeats in (1, 100):
        assert nearest_neighbor(queries, np.tile(corners, (repeats, 1))).tolist() == [0, 1, 3]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_repeated_rows_of_round_numbers_are_removed(dtype):
    rows = np.stack(np.meshgrid(np.arange(-4, 4), np.arange(8)), axis=-1).reshape(-1, 2).astype(dtype)
    distinct = host_search._distinct_rows(np.tile(rows, (50, 1)), None)
    np.testing.assert_array_equal(distinct, np.arange(64))


def test_rows_with_equal_hashes_stay_apart(monkeypatch):
    class NoFactors:
        def integers(self, high, size, dtype):
            return np.zeros(size, dtype)

    database = np.array([[0.0, 1.0], [0.0, 1.0], [3.0, 4.0], [3.0, 4.0]])
    expected = nearest_neighbor(database, database)
    monkeypatch.setattr(np.random, "default_rng", lambda seed: NoFactors())
    assert nearest_neighbor(database, database).tolist() == expected.tolist() == [0, 0, 2, 2]


@pytest.mark.parametrize("n", [5, 300])
def test_masked_rows_are_never_chosen(n, method):
    generator = np.random.default_rng(0)
    queries, database = generator.normal(size=(80, 4)), generator.normal(size=(n, 4))
    mask = generator.random(n) < 0.3
    mask[-1] = True
    database[~mask] = np.nan
    nearest = nearest_neighbor(queries, database, mask)
    np.testing.assert_array_equal(nearest, np.flatnonzero(mask)[brute_force(queries, database[mask])])


def test_indices_are_in_range_for_nan_and_infinity_and_for_masks_without_rows(method):
    generator = np.random.default_rng(0)
    queries, database = generator.normal(size=(300, 4)), generator.normal(size=(50, 4))
    queries[::2] = np.nan
    huge = nearest_neighbor(1e200 * database, 1e200 * database)
    nearest = nearest_neighbor(queries, database)
    np.testing.assert_array_equal(nearest[1::2], brute_force(queries[1::2], database))
    queries[0], database[7], database[8], database[9] = np.inf, np.nan, np.inf, -np.inf
    for result in (
        huge,
        nearest,
        nearest_neighbor(queries, database),
        nearest_neighbor(queries, database, np.zeros(50, bool)),
    ):
        assert result.min() >= 0 and result.max() < 50


def test_float32_finds_the_same_far_from_the_origin(method):
    generator = np.random.default_rng(0)
    database = generator.normal(size=(1000, 10)) + 1000
    queries = database[generator.permutation(1000)] + 1e-2 * generator.normal(size=(1000, 10))
    queries, database = queries.astype(np.float32), database.astype(np.float32)
    np.testing.assert_array_equal(nearest_neighbor(queries, database), brute_force(queries, database))


@pytest.fixture(scope="module")
def spaces():
    """Two embeddings of a surface: as in `Registration`, and only by eigenvectors."""
    spectrum = compute_spectrum(bumpy_mesh(4), 60)
    return embeddings(spectrum)


def embeddings(spectrum):
    generator = np.random.default_rng(0)
    eigenvectors = np.asarray(spectrum.eigenvectors)
    scaled = 0.2 * eigenvectors / np.sqrt(1 + np.asarray(spectrum.eigenvalues))
    joint = np.hstack([spectrum.positions, 0.02 * np.asarray(spectrum.normals), scaled])
    turned, _ = np.linalg.qr(np.eye(60) + generator.normal(size=(60, 60)) / np.sqrt(60))
    return {
        "registration": (joint + 0.002 * generator.normal(size=joint.shape), joint),
        "wavelets": (eigenvectors, eigenvectors @ turned),
    }


@pytest.mark.parametrize(
    ("name", "dtype"),
    first_always(
        [
            ("registration", np.float32),
            ("registration", np.float64),
            ("wavelets", np.float32),
            ("wavelets", np.float64),
        ],
        always=3,
        names=2,
    ),
)
def test_all_methods_and_jax_give_the_same_on_surfaces(spaces, name, dtype, monkeypatch):
    queries, database = (points.astype(dtype) for points in spaces[name])
    exact = brute_force(queries, database)
    for method in METHODS:
        force(monkeypatch, method)
        np.testing.assert_array_equal(nearest_neighbor(queries, database), exact)
    same = np.asarray(nearest_neighbor_jax(jnp.asarray(queries), jnp.asarray(database))) == exact
    assert np.mean(same) > 0.999


def test_most_clusters_are_excluded():
    points = np.asarray(compute_spectrum(bumpy_mesh(5), 30).eigenvectors)
    members = host_search._halved(points, 10)
    clusters = host_search._Clusters.of(points, np.arange(len(points)), points.mean(axis=0), members)
    assert [len(level.centers) for level in clusters.levels] == [128, 1024]
    block = host_search._halved(points, 128)[3]
    assert len(clusters.needed(points[block])) < 0.15 * len(clusters.members)
    np.testing.assert_array_equal(clusters.search(points[block]), block)


def test_groups_contain_all_points():
    points = np.random.default_rng(0).normal(size=(1001, 3))
    groups = host_search._halved(points, 40)
    assert groups.shape == (32, 32)
    assert set(groups.ravel()) == set(range(1001))


@pytest.mark.parametrize(("name", "expected"), [("registration", "_by_tree"), ("wavelets", "_exhaustive")])
def test_the_tree_is_chosen_where_it_excludes_most_points(spaces, name, expected, monkeypatch):
    chosen = []
    for method in ("_by_tree", "_exhaustive"):
        original = getattr(host_search, method)
        monkeypatch.setattr(
            host_search,
            method,
            lambda *a, _method=method, _original=original: chosen.append(_method) or _original(*a),
        )
    nearest_neighbor(*spaces[name])
    assert chosen == [expected]


@pytest.mark.parametrize("cores", [1, 2, 5])
def test_the_number_of_cores_changes_nothing(spaces, cores, monkeypatch):
    problems = [SearchProblem(*(points.astype(np.float32) for points in space)) for space in spaces.values()]
    expected = [nearest_neighbor(*problem) for problem in problems]
    monkeypatch.setattr(host_search, "_cores", lambda: cores)
    monkeypatch.setattr(host_search, "_THREADS_FROM", 0)
    for found, wanted in zip(nearest_in_both(*problems), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_small_searches_start_no_threads(monkeypatch):
    monkeypatch.setattr(host_search, "_cores", lambda: 2)
    monkeypatch.setattr(host_search, "ThreadPoolExecutor", None)
    points = np.random.default_rng(0).normal(size=(1000, 5))
    np.testing.assert_array_equal(nearest_neighbor(points, points), np.arange(1000))
    with pytest.raises(TypeError):
        nearest_neighbor(np.tile(points, (6, 1)), points)


def test_two_searches_can_have_different_sizes(method):
    generator = np.random.default_rng(0)
    problems = [
        SearchProblem(generator.normal(size=(m, d)), generator.normal(size=(n, d)), np.arange(n) % 3 != 1)
        for m, n, d in ((30, 200, 4), (300, 2, 1))
    ]
    for problem, found in zip(problems, nearest_in_both(*problems), strict=True):
        distances = cdist(problem.queries, problem.database) + np.where(problem.database_mask, 0, np.inf)
        np.testing.assert_array_equal(found, np.argmin(distances, axis=1))
