"""Samples are far apart, evenly spread, on the surface, and independent of the vertex numbers."""

import numpy as np
import pytest
import scipy.sparse as sp
from messages import refused
from scipy.spatial.distance import cdist, pdist
from synthetic import sphere_mesh

from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.sampling import farthest_point_samples, maximal_independent_set, poisson_disk_samples


def bumpy():
    vertices, faces = sphere_mesh(3)
    return make_mesh(
        vertices * [1.0, 1.3, 2.1] + 0.01 * np.random.default_rng(0).normal(size=vertices.shape), faces
    )


def test_each_sample_is_the_farthest_from_the_earlier_ones():
    mesh = bumpy()
    samples = farthest_point_samples(mesh, 50)
    for index in range(1, 50):
        nearest = cdist(mesh.vertices, mesh.vertices[samples[:index]]).min(axis=1)
        assert nearest[samples[index]] == nearest.max()


def test_farthest_point_samples_are_spread_evenly():
    mesh = bumpy()
    samples = farthest_point_samples(mesh, 50)
    covering = cdist(mesh.vertices, mesh.vertices[samples]).min(axis=1).max()
    assert pdist(mesh.vertices[samples]).min() >= covering


def test_samples_do_not_depend_on_the_numbering():
    mesh = bumpy()
    order = np.random.default_rng(1).permutation(len(mesh.vertices))
    renumbered = make_mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    np.testing.assert_array_equal(
        order[farthest_point_samples(renumbered, 30)], farthest_point_samples(mesh, 30)
    )


def test_all_referenced_vertices_can_be_samples_but_no_others():
    vertices, faces = sphere_mesh(1)
    mesh = make_mesh(np.concatenate([vertices, [[9.0, 9.0, 9.0]]]), faces)
    assert sorted(farthest_point_samples(mesh, 42)) == list(range(42))
    for number in (0, 43):
        with refused(str(number), "42 referenced vertices", "1 to 42"):
            farthest_point_samples(mesh, number)


@pytest.mark.parametrize("number", [100, 400])
def test_poisson_disk_samples_leave_neither_gaps_nor_clusters(number):
    """One end of this mesh is much finer than the other end."""
    vertices, faces = sphere_mesh(5)
    vertices = vertices + np.array([0, 0, 0.5])
    mesh = make_mesh(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces)
    samples = poisson_disk_samples(mesh, number)
    assert 0.75 * number < len(samples.vertices) < 1.3 * number
    distance = (0.7 * mesh.area / number) ** 0.5
    chosen = mesh.vertices[samples.vertices]
    assert pdist(chosen).min() > distance
    away = cdist(mesh.vertices, chosen)
    rows = np.arange(len(away))
    np.testing.assert_allclose(away[rows, samples.nearest], away.min(axis=1), rtol=1e-12)
    # The distance from a vertex to its nearest sample is at most `distance` plus the diagonal of a grid box.
    assert away.min(axis=1).max() < 1.6 * distance


def test_more_samples_than_vertices_give_all_vertices():
    mesh = bumpy()
    samples = poisson_disk_samples(mesh, 10**6)
    np.testing.assert_array_equal(samples.vertices, np.arange(len(mesh.vertices)))
    np.testing.assert_array_equal(samples.nearest, np.arange(len(mesh.vertices)))


def test_unreferenced_vertices_are_never_samples():
    vertices, faces = sphere_mesh(3)
    mesh = make_mesh(np.insert(vertices, 5, 0.0, axis=0), faces + (faces >= 5))
    samples = poisson_disk_samples(mesh, 60)
    assert 5 not in samples.vertices and len(samples.nearest) == len(mesh.vertices)


@pytest.mark.parametrize("radius", [1, 3])
def test_a_maximal_independent_set_is_independent_and_maximal(radius):
    """Chosen vertices are farther apart than the radius in graph distance, and no vertex can be added."""
    from scipy.sparse.csgraph import shortest_path

    mesh = bumpy()
    n = len(mesh.vertices)
    edges = np.concatenate([mesh.edges, mesh.edges[:, ::-1], np.stack([np.arange(n)] * 2, axis=1)])
    graph = sp.csr_matrix((np.ones(len(edges)), edges.T), shape=(n, n))
    chosen = maximal_independent_set(graph, radius)
    steps = shortest_path(graph, unweighted=True)
    among = steps[np.ix_(chosen, chosen)] + 99 * np.eye(len(chosen))
    assert among.min() > radius
    assert steps[chosen].min(axis=0).max() <= radius
