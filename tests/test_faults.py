"""What is wrong with a map, told without the truth."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from synthetic import bumpy_mesh

from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.faults import reversed_orientation, stretch, torn_off
from jaxsmw.geometry.mesh import make_mesh


@pytest.fixture(scope="module")
def body():
    """A sphere with an arm to the left and one to the right, and its eigenvectors."""
    sphere = bumpy_mesh(4)
    directions = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1, keepdims=True)
    length = 1 + 1.5 * np.exp(-10 * (1 - np.abs(directions[:, 0])))
    mesh = make_mesh(directions * length[:, None], sphere.faces)
    return mesh, np.asarray(compute_spectrum(mesh, 60).eigenvectors)


def test_the_identity_has_no_faults(body):
    mesh, eigenvectors = body
    identity = np.arange(len(mesh.vertices))
    assert stretch(mesh, mesh, identity) == 1
    assert not torn_off(mesh, mesh, identity).any()
    assert not reversed_orientation(mesh, mesh, identity, eigenvectors).any()


def test_neither_unit_nor_numbering_matters():
    mesh = bumpy_mesh(3)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    other = make_mesh(50 * mesh.vertices[order] + 3, np.argsort(order)[mesh.faces])
    eigenvectors = np.asarray(compute_spectrum(mesh, 40).eigenvectors)
    assert stretch(mesh, other, np.argsort(order)) == pytest.approx(1)
    assert not reversed_orientation(mesh, other, np.argsort(order), eigenvectors).any()


def test_an_inside_out_mesh_is_no_mirror_image(body):
    mesh, eigenvectors = body
    identity = np.arange(len(mesh.vertices))
    inside_out = make_mesh(mesh.vertices, mesh.faces[:, ::-1])
    for x, y in ((mesh, inside_out), (inside_out, mesh), (inside_out, inside_out)):
        assert not reversed_orientation(x, y, identity, eigenvectors).any()


def test_swapped_limbs_are_torn_off_and_reversed(body):
    mesh, eigenvectors = body
    arms = np.abs(mesh.vertices[:, 0]) > 1
    _, mirrored = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    swapped = np.where(arms, mirrored, np.arange(len(mesh.vertices)))
    off = torn_off(mesh, mesh, swapped)
    assert off[arms].all() and not off[~arms].any()
    reversed_ = reversed_orientation(mesh, mesh, swapped, eigenvectors)
    assert reversed_[arms].mean() > 0.8 and reversed_[~arms].mean() < 0.05
    assert stretch(mesh, mesh, swapped) > 1.2
    mirror_image = reversed_orientation(mesh, mesh, mirrored, eigenvectors)
    assert mirror_image.mean() > 0.95


def test_coarse_meshes_are_not_torn_by_their_own_edges():
    mesh = bumpy_mesh(1)
    assert not torn_off(mesh, mesh, np.arange(len(mesh.vertices))).any()
