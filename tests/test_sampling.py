import numpy as np
import pytest
from scipy.spatial.distance import cdist, pdist
from synthetic import sphere_mesh

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.sampling import farthest_point_samples


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
