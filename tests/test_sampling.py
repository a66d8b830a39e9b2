import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial.distance import cdist, pdist
from synthetic import sphere_mesh

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.sampling import farthest_point_samples, independent_vertices, spread_samples


def bumpy():
    vertices, faces = sphere_mesh(3)
    return make_mesh(
        vertices * [1.0, 1.3, 2.1] + 0.01 * np.random.default_rng(0).normal(size=vertices.shape), faces
    )


def test_each_sample_is_the_farthest_from_those_before():
    mesh = bumpy()
    samples = farthest_point_samples(mesh, 50)
    for index in range(1, 50):
        nearest = cdist(mesh.vertices, mesh.vertices[samples[:index]]).min(axis=1)
        assert nearest[samples[index]] == nearest.max()


def test_samples_are_spread_evenly():
    mesh = bumpy()
    samples = farthest_point_samples(mesh, 50)
    covering = cdist(mesh.vertices, mesh.vertices[samples]).min(axis=1).max()
    assert pdist(mesh.vertices[samples]).min() >= covering


def test_renumbering_chooses_the_same_points():
    mesh = bumpy()
    order = np.random.default_rng(1).permutation(len(mesh.vertices))
    renumbered = make_mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    np.testing.assert_array_equal(
        order[farthest_point_samples(renumbered, 30)], farthest_point_samples(mesh, 30)
    )


def test_all_used_vertices_once_and_no_more():
    vertices, faces = sphere_mesh(1)
    mesh = make_mesh(np.concatenate([vertices, [[9.0, 9.0, 9.0]]]), faces)
    assert sorted(farthest_point_samples(mesh, 42)) == list(range(42))
    for number in (0, 43):
        with pytest.raises(InputError, match="42 used vertices"):
            farthest_point_samples(mesh, number)


@pytest.mark.parametrize("number", [100, 400])
def test_spread_samples_leave_neither_gaps_nor_clusters(number):
    """Also where one end of the mesh is much finer than the other."""
    vertices, faces = sphere_mesh(5)
    vertices = vertices + np.array([0, 0, 0.5])
    mesh = make_mesh(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces)
    samples = spread_samples(mesh, number)
    assert 0.75 * number < len(samples.vertices) < 1.3 * number
    distance = (0.7 * mesh.area / number) ** 0.5
    chosen = mesh.vertices[samples.vertices]
    assert pdist(chosen).min() > distance
    away = cdist(mesh.vertices, chosen)
    rows = np.arange(len(away))
    np.testing.assert_allclose(away[rows, samples.nearest], away.min(axis=1), rtol=1e-12)
    # Next to everything is one, but for what the grid leaves out: a box's diagonal.
    assert away.min(axis=1).max() < 1.6 * distance


def test_more_samples_than_vertices_are_all_of_them():
    mesh = bumpy()
    samples = spread_samples(mesh, 10**6)
    np.testing.assert_array_equal(samples.vertices, np.arange(len(mesh.vertices)))
    np.testing.assert_array_equal(samples.nearest, np.arange(len(mesh.vertices)))


def test_unused_vertices_do_not_stand_for_others():
    vertices, faces = sphere_mesh(3)
    mesh = make_mesh(np.insert(vertices, 5, 0.0, axis=0), faces + (faces >= 5))
    samples = spread_samples(mesh, 60)
    assert 5 not in samples.vertices and len(samples.nearest) == len(mesh.vertices)


@pytest.mark.parametrize("radius", [1, 3])
def test_independent_vertices_are_a_largest_such_set(radius):
    """No two within the radius, and no other could be added: by distances in the graph."""
    from scipy.sparse.csgraph import shortest_path

    mesh = bumpy()
    n = len(mesh.vertices)
    edges = np.concatenate([mesh.edges, mesh.edges[:, ::-1], np.stack([np.arange(n)] * 2, axis=1)])
    graph = sp.csr_matrix((np.ones(len(edges)), edges.T), shape=(n, n))
    chosen = independent_vertices(graph, radius)
    steps = shortest_path(graph, unweighted=True)
    among = steps[np.ix_(chosen, chosen)] + 99 * np.eye(len(chosen))
    assert among.min() > radius
    assert steps[chosen].min(axis=0).max() <= radius
