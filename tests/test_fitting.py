"""Rigid motions with large overlap, and fits of parts by locally rigid motions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import body_with_arms
from test_hypotheses import reduced

from jaxsmw import creature_pair, make_mesh
from jaxsmw.creature import creature
from jaxsmw.geometry.alignment import patch_motions
from jaxsmw.geometry.currents import Oriented, overlapping_alignments
from jaxsmw.matching.search.fitting import fits

TURN = Rotation.from_euler("xyz", [140, -35, 70], degrees=True).as_matrix()


def oriented(mesh, kept=slice(None)):
    return Oriented(mesh.vertices[kept], mesh.vertex_normals[kept], mesh.vertex_areas[kept])


@pytest.fixture(scope="module")
def body():
    """A creature with area 1."""
    mesh = creature("quadruped", vertices=600, pose="walk")
    return make_mesh(mesh.vertices / mesh.area**0.5, mesh.faces)


def test_the_motion_of_two_overlapping_parts_is_found(body):
    """Three quarters of a body, and another three quarters of the turned body, share only a half."""
    length = body.vertices[:, 2]
    front, rear = length > np.quantile(length, 0.25), length < np.quantile(length, 0.75)
    moved = body.vertices @ TURN.T + [1, 2, 3]
    y = Oriented(moved[rear], body.vertex_normals[rear] @ TURN.T, body.vertex_areas[rear])
    motions = overlapping_alignments(oriented(body, front), y, 20)
    apart = [np.linalg.norm(motion.apply(body.vertices) - moved, axis=1).mean() for motion in motions]
    assert min(apart) < 0.15
    first, second = (motion.apply(body.vertices[front]) for motion in motions[:2])
    assert np.sqrt(((first - second) ** 2).sum(axis=1).mean()) > 0.12


def test_surfaces_of_opposite_orientation_do_not_overlap(body):
    x = oriented(body)
    (aligned,) = overlapping_alignments(x, x, 1)
    assert np.linalg.norm(aligned.apply(x.positions) - x.positions, axis=1).max() < 0.06
    (other,) = overlapping_alignments(x, x._replace(normals=-x.normals), 1)
    assert np.linalg.norm(other.apply(x.positions) - x.positions, axis=1).mean() > 0.2


def test_the_motions_of_patches_are_exact_for_a_rigid_motion():
    mesh = body_with_arms(2)
    patches = np.random.default_rng(0).uniform(size=(5, len(mesh.vertices)))
    patches /= patches.sum(axis=1, keepdims=True)
    goals, normals = mesh.vertices @ TURN.T + [1, 2, 3], mesh.vertex_normals @ TURN.T
    found = patch_motions(patches, mesh.vertices, mesh.vertex_normals, goals, normals)
    np.testing.assert_allclose(found.rotations, np.broadcast_to(TURN, (5, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(found.offsets, np.tile([1.0, 2.0, 3.0], (5, 1)), atol=1e-9)
    assert found.deformations.max() < 1e-12


@pytest.fixture(scope="module")
def front():
    """The front of a creature, the whole creature in another pose, and the true points of its vertices."""
    pair = creature_pair(vertices=1000)
    mesh = pair.source
    ahead = mesh.vertices[:, 2] > np.quantile(mesh.vertices[:, 2], 0.45)
    part = make_mesh(mesh.vertices, mesh.faces[ahead[mesh.faces].all(axis=1)])
    return part, pair.target, pair.truth.positions(pair.target)


@pytest.fixture(scope="module")
def found(front):
    part, whole, _ = front
    return list(fits(reduced(part, whole.area**0.5), reduced(whole, whole.area**0.5)))


def test_the_best_fit_carries_a_part_to_its_place(front, found):
    part, whole, true = front
    unit = whole.area**0.5
    vertices = reduced(part, unit).samples.vertices
    errors = np.linalg.norm(found[0].positions - true[vertices] / unit, axis=1)
    assert np.median(errors) < 0.03


def test_fits_differ_and_the_best_comes_first(found):
    assert 1 < len(found) <= 4
    assert [fit.cost for fit in found] == sorted(fit.cost for fit in found)
    apart = np.linalg.norm(found[0].positions - found[1].positions, axis=1)
    assert apart.max() > 0.1
