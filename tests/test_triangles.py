"""The nearest points on triangles agree with libigl and brute force, and have the expected invariances."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from scipy.optimize import nnls
from synthetic import bumpy_mesh, to_namespace

from jaxsmw.core.triangles import nearest_point_on_candidates, nearest_point_on_triangles

# Without compilation as a whole, each size compiles about 50 small programs.
compiled_search = jax.jit(nearest_point_on_triangles)


@pytest.fixture
def generator():
    return np.random.default_rng(0)


@pytest.fixture
def found(namespace):
    """A function that returns faces, weights, and the distance from each query to its nearest point."""
    search = compiled_search if namespace == "jax" else nearest_point_on_triangles

    def find(queries, points, faces, **options):
        face, weights = search(*to_namespace((queries, points, faces), namespace), **options)
        there = np.einsum("qc,qcd->qd", weights, points[faces[np.asarray(face)]])
        return np.asarray(face), np.asarray(weights), np.linalg.norm(queries - there, axis=1)

    return find


def by_brute_force(queries, points, faces):
    """Returns distances by non-negative least squares, with a heavy row that makes the weights sum to 1."""
    heavy = 1e4
    distances = []
    for query in queries:
        each = []
        for face in faces:
            system = np.vstack([points[face].T, np.full(3, heavy)])
            weights, _ = nnls(system, np.append(query, heavy))
            each.append(np.linalg.norm(points[face].T @ (weights / weights.sum()) - query))
        distances.append(min(each))
    return np.array(distances)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_agrees_with_libigl_in_space(generator, dtype, found):
    mesh = bumpy_mesh(3)
    queries = generator.normal(size=(300, 3))
    queries[:100] = mesh.vertices[:100]  # on corners
    expected, _, _ = igl.point_mesh_squared_distance(queries, mesh.vertices, mesh.faces)
    _, weights, distance = found(queries.astype(dtype), mesh.vertices.astype(dtype), mesh.faces)
    assert weights.dtype == dtype
    np.testing.assert_allclose(distance, np.sqrt(expected), atol=2e-6 if dtype == np.float32 else 1e-12)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert weights.min() >= (-1e-7 if dtype == np.float32 else -1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("dimensions", first_always([5, 2, 12]))
def test_agrees_with_brute_force_in_any_dimension(generator, dimensions, found):
    points, queries = generator.normal(size=(20, dimensions)), generator.normal(size=(40, dimensions))
    faces = np.array([generator.choice(20, 3, replace=False) for _ in range(30)])
    _, _, distance = found(queries, points, faces)
    np.testing.assert_allclose(distance, by_brute_force(queries, points, faces), atol=1e-6)


def test_points_of_the_surface_are_their_own_nearest_points(generator, found):
    mesh = bumpy_mesh(3)
    points = np.hstack([mesh.vertices, generator.normal(size=(len(mesh.vertices), 4))])
    faces = generator.integers(len(mesh.faces), size=200)
    weights = generator.dirichlet([1, 1, 1], size=200)
    queries = np.einsum("qc,qcd->qd", weights, points[mesh.faces[faces]])
    face, again, distance = found(queries, points, mesh.faces)
    np.testing.assert_array_equal(face, faces)
    np.testing.assert_allclose(again, weights, atol=1e-9)
    assert distance.max() < 1e-9


@pytest.mark.parametrize("corners", [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [0, 1, 3]])
def test_distances_to_triangles_without_area_are_exact(corners, found):
    """The degenerate triangles are a point, a segment, and three collinear points."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 5, 0], [2, 0, 0]])
    queries = np.array([[0.4, 1, 0], [-1, 0, 0], [3, 0, 0]])
    _, weights, distance = found(queries, points, np.array([corners]))
    high = max(points[corners, 0])
    nearest = np.clip(queries[:, 0], 0, high)
    np.testing.assert_allclose(distance, np.hypot(queries[:, 0] - nearest, queries[:, 1]), atol=1e-12)
    assert np.isfinite(weights).all()


def test_masked_triangles_are_ignored(generator, found, namespace):
    mesh = bumpy_mesh(2)
    queries = generator.normal(size=(50, 3))
    mask = generator.random(len(mesh.faces)) < 0.5
    face, _, distance = found(queries, mesh.vertices, mesh.faces, face_mask=to_namespace(mask, namespace))
    assert mask[face].all()
    _, _, expected = found(queries, mesh.vertices, mesh.faces[mask])
    np.testing.assert_allclose(distance, expected)


def test_vmap_equals_a_loop(generator):
    mesh = bumpy_mesh(2)
    queries = jnp.asarray(generator.normal(size=(3, 40, 3)))
    points = jnp.asarray(mesh.vertices * np.array([1.0, 1.5, 2.0])[:, None, None])
    faces = jnp.asarray(mesh.faces)
    together = jax.jit(jax.vmap(nearest_point_on_triangles, (0, 0, None)))(queries, points, faces)
    for pair in range(3):
        alone = compiled_search(queries[pair], points[pair], faces)
        np.testing.assert_array_equal(together[0][pair], alone[0])
        np.testing.assert_allclose(together[1][pair], alone[1], atol=1e-12)


@pytest.mark.parametrize("search", ["all", "candidates"])
def test_weights_are_never_negative(search, generator, namespace):
    """Without clipping, the weight of the first corner is negative for many points on the opposite edge."""
    points = generator.normal(size=(300, 3)).astype(np.float32)
    faces = np.arange(300).reshape(-1, 3)
    shares = generator.uniform(size=(100, 1)).astype(np.float32)
    corners = points[faces]
    queries = shares * corners[:, 1] + (1 - shares) * corners[:, 2]
    queries += (queries - corners[:, 0]) * np.float32(0.01)
    arguments = to_namespace((queries, points, faces), namespace)
    find = nearest_point_on_triangles
    if search == "candidates":
        find = nearest_point_on_candidates
        arguments += (to_namespace(np.arange(100), namespace),) * 2
    _, weights = (jax.jit(find) if namespace == "jax" else find)(*arguments)
    assert (np.asarray(weights) >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=3e-7)


def test_no_array_of_all_queries_and_triangles_is_stored():
    m, n, f, d = 4000, 3000, 6000, 40
    shapes = (
        jax.ShapeDtypeStruct((m, d), jnp.float32),
        jax.ShapeDtypeStruct((n, d), jnp.float32),
        jax.ShapeDtypeStruct((f, 3), jnp.int32),
    )
    memory = compiled_search.lower(*shapes).compile().memory_analysis()
    assert memory.temp_size_in_bytes < m * f * 4 / 4


def test_candidates_give_the_nearest_point_of_their_triangles(generator, found, namespace):
    points, queries = generator.normal(size=(20, 5)), generator.normal(size=(8, 5))
    faces = np.array([generator.choice(20, 3, replace=False) for _ in range(30)])
    rows = np.repeat(np.arange(8), 7)
    candidates = generator.integers(30, size=len(rows))
    arguments = to_namespace((queries, points, faces, rows, candidates), namespace)
    face, weights = nearest_point_on_candidates(*arguments)
    face, weights = np.asarray(face), np.asarray(weights)
    for query in range(8):
        own = candidates[rows == query]
        _, _, distance = found(queries[query : query + 1], points, faces[own])
        there = weights[query] @ points[faces[face[query]]]
        assert face[query] in own
        np.testing.assert_allclose(np.linalg.norm(there - queries[query]), distance[0], rtol=1e-6)
