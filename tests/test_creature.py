"""Creatures have symmetric bodies, well-shaped triangles, natural poses and exact ground truth."""

import igl
import numpy as np
import pytest
from messages import refused
from sampled_cases import first_always
from scipy.sparse.linalg import eigsh

from jaxsmw import creature as creature_module
from jaxsmw.creature import (
    _KINDS,
    _MIRROR,
    CREATURES,
    _Body,
    _grown,
    _random,
    _triangulated,
    creature,
    creature_pair,
)
from jaxsmw.errors import InputError

KINDS = first_always(CREATURES)


@pytest.fixture(autouse=True, scope="module")
def triangulate_anew():
    """Undo `triangulate_creatures_once`, which would hide differences between two triangulations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(creature_module, "_triangulated", _triangulated)
        yield


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def pair(kind):
    return creature_pair(kind, vertices=800, seed=4)


@pytest.fixture(scope="module")
def rest(kind):
    """The source body of `pair`, in the rest pose."""
    return creature(kind, vertices=800, seed=4)


def edge_lengths(vertices, faces):
    ends = vertices[igl.edges(faces)]
    return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)


def pose_of(mesh):
    return mesh.name.split("(")[1].rstrip(")")


def assert_sphere(mesh):
    """Check that a mesh is closed, manifold, connected, without handles, and oriented outward."""
    edges, _, sides, _ = igl.edge_flaps(mesh.faces)
    assert (sides >= 0).all() and igl.is_edge_manifold(mesh.faces)[0]
    directed = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed) == 2 * len(edges)
    assert np.all(igl.is_vertex_manifold(mesh.faces))
    assert igl.facet_components(mesh.faces)[0] == 1
    assert mesh.referenced_vertices.all()
    assert len(mesh.vertices) - len(edges) + len(mesh.faces) == 2
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    assert np.einsum("fx,fx->", a, np.cross(b, c)) > 0


def test_the_body_is_mirror_symmetric_in_the_rest_pose(kind):
    points = np.random.default_rng(0).uniform((-1.2, -0.1, -2.2), (1.2, 1.8, 1.2), size=(20000, 3))
    body = _grown(kind, 3)
    value = body.signed_distance(points)
    assert np.array_equal(value, body.signed_distance(points * _MIRROR))
    assert 0.01 < (value < 0).mean() < 0.2


def test_right_joints_mirror_left_joints(kind, rest):
    body = _grown(kind, 4)
    left, right = np.zeros((2, len(body.joints), 3))
    for name, joint in body.joints.items():
        if "right_" not in name:
            left[joint] = np.random.default_rng(joint).uniform(-0.5, 0.5, size=3)
            right[body.joints[name.replace("left_", "right_")]] = -_MIRROR * left[joint]
    moved = body.posed(rest.vertices, left)
    assert np.linalg.norm(moved - rest.vertices, axis=1).max() > 0.2
    np.testing.assert_allclose(body.posed(rest.vertices * _MIRROR, right), moved * _MIRROR, atol=1e-12)


def test_triangles_are_well_shaped(kind, pair, rest):
    assert len(pair.source.vertices) == 800
    assert 0.95 * 800 <= len(pair.target.vertices) <= 0.99 * 800
    for mesh in (pair.source, pair.target):
        assert_sphere(mesh)
    angles = np.degrees(igl.internal_angles(rest.vertices, rest.faces)).min(axis=1)
    assert angles.min() > 1 and np.quantile(angles, 0.01) > 15 and np.median(angles) > 40
    delaunay = igl.is_intrinsic_delaunay(igl.edge_lengths(rest.vertices, rest.faces), rest.faces)
    assert np.mean(delaunay) > 0.99
    lengths = edge_lengths(rest.vertices, rest.faces)
    assert lengths.max() < 4 * np.median(lengths)


def test_vertices_lie_on_the_zero_set_of_the_signed_distance(kind, rest):
    assert np.abs(_grown(kind, 4).signed_distance(rest.vertices)).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("vertices", "seed"), first_always([(500, 123456789), (733, 2**40)], names=2))
def test_any_size_and_any_seed_give_a_topological_sphere(kind, vertices, seed):
    mesh = creature(kind, vertices=vertices, seed=seed)
    assert len(mesh.vertices) == vertices
    assert_sphere(mesh)


def test_a_body_with_a_handle_is_refused():
    random = np.random.default_rng(0)
    body = _Body(random)
    body.add("0 0 .3 .1, 0 .3 0 .1, 0 0 -.3 .1, 0 -.3 0 .1, 0 0 .3 .1", blend=0.05)
    with pytest.raises(InputError, match="choose another seed"):
        _triangulated(body, 500, random)


@pytest.mark.slow
def test_the_same_seed_gives_identical_pairs():
    first, again = (creature_pair("biped", vertices=600, seed=7) for _ in range(2))
    for mesh, same in ((first.source, again.source), (first.target, again.target)):
        assert np.array_equal(mesh.vertices, same.vertices) and np.array_equal(mesh.faces, same.faces)
        assert mesh.name == same.name
    assert np.array_equal(first.truth.faces, again.truth.faces)
    assert np.array_equal(first.truth.weights, again.truth.weights)


def test_another_seed_gives_another_individual(kind, rest):
    assert np.abs(_grown(kind, 5).signed_distance(rest.vertices)).mean() > 0.005
    stand = _KINDS[kind][1]["stand"]
    angles = [_grown(kind, 4).angles(stand, _random(seed, "stand")) for seed in (4, 5)]
    assert 0.01 < np.abs(angles[0] - angles[1]).mean() < 0.1


def test_poses_deform_the_body_without_stretching_it(kind, rest):
    body = _grown(kind, 4)
    before = edge_lengths(rest.vertices, rest.faces)
    joints = {name.removeprefix("left_").removeprefix("right_") for name in body.joints}
    joints |= set(body.joints)
    for pose, text in _KINDS[kind][1].items():
        assert {entry.split()[0] for entry in text.split(";")} <= joints
        vertices = body.posed(rest.vertices, body.angles(text, _random(4, pose)))
        change = np.abs(edge_lengths(vertices, rest.faces) / before - 1)
        assert 0.005 < change.mean() < 0.08 and np.quantile(change, 0.95) < 0.45
        area = igl.doublearea(vertices, rest.faces).sum() / igl.doublearea(rest.vertices, rest.faces).sum()
        assert 0.95 < area < 1.05
        # Just outside the surface, the winding number is 0 unless the body intersects itself there.
        outside = vertices + 1e-3 * igl.per_vertex_normals(vertices, rest.faces)
        assert (igl.fast_winding_number(vertices, rest.faces, outside) > 0.6).mean() < 0.01


def test_a_vertex_is_the_same_point_in_every_pose(kind, pair, rest):
    assert pose_of(rest) == "rest" and pose_of(pair.source) == "stand"
    stand = creature(kind, vertices=800, pose="stand", seed=4)
    assert np.array_equal(stand.faces, rest.faces)
    assert np.array_equal(stand.faces, pair.source.faces)
    assert np.array_equal(stand.vertices, pair.source.vertices)


def test_the_ground_truth_follows_the_deformation(kind, pair):
    """In the pose of the target, the source vertices coincide with the ground-truth points."""
    m, size = len(pair.source.vertices), np.sqrt(pair.target.area)
    assert pair.truth.faces.shape == (m,) and pair.truth.weights.shape == (m, 3)
    assert pair.truth.faces.min() >= 0 and pair.truth.faces.max() < len(pair.target.faces)
    assert pair.truth.weights.min() >= 0
    np.testing.assert_allclose(pair.truth.weights.sum(axis=1), 1, atol=1e-12)

    moved = creature(kind, vertices=800, pose=pose_of(pair.target), seed=4).vertices
    error = np.linalg.norm(pair.truth.positions(pair.target) - moved, axis=1) / size
    # The horns of the dragon are thinner than the edges, which are about 0.04 long.
    assert error.mean() < 0.004 and error.max() < (0.05 if kind == "dragon" else 0.03)
    # Neighbouring vertices stay close, so no vertex is projected onto another limb or through a thin limb.
    edges = igl.edges(pair.source.faces)
    ends = pair.truth.positions(pair.target)[edges]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() < 0.2 * size
    normals = igl.per_face_normals(pair.target.vertices, pair.target.faces, np.zeros(3))[pair.truth.faces]
    agreement = np.einsum("mx,mx->m", normals, igl.per_vertex_normals(moved, pair.source.faces))
    assert (agreement < 0).mean() < 0.02 and np.median(agreement) > 0.95


def test_the_true_map_consists_of_the_nearest_corners(pair):
    corners = pair.target.faces[pair.truth.faces]
    assert (pair.true_map[:, None] == corners).any(axis=1).all()
    offsets = np.linalg.norm(
        pair.target.vertices[corners] - pair.truth.positions(pair.target)[:, None], axis=2
    )
    chosen = np.linalg.norm(pair.target.vertices[pair.true_map] - pair.truth.positions(pair.target), axis=1)
    np.testing.assert_array_equal(chosen, offsets.min(axis=1))
    assert len(np.unique(pair.true_map)) > 0.5 * len(pair.target.vertices)


def test_the_two_meshes_have_nearly_the_same_spectrum(pair):
    def eigenvalues(mesh):
        stiffness = -igl.cotmatrix(mesh.vertices, mesh.faces).tocsc()
        areas = igl.massmatrix(mesh.vertices, mesh.faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).tocsc()
        start = np.ones(len(mesh.vertices))
        return mesh.area * eigsh(stiffness, 60, areas, sigma=-0.01, v0=start, return_eigenvectors=False)

    ratio = np.sort(eigenvalues(pair.source))[1:] / np.sort(eigenvalues(pair.target))[1:]
    assert np.abs(ratio - 1).mean() < 0.05 and np.abs(ratio - 1).max() < 0.2


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ({"kind": "sphere"}, "'sphere' is unknown: choose one of quadruped"),
        ({"vertices": 499}, "number of vertices of a creature is 499: choose 500 or more"),
        ({"seed": -1}, "seed of a creature is -1: choose 0 or more"),
    ],
)
def test_bad_arguments_are_refused(arguments, fault):
    with pytest.raises(InputError, match=fault):
        creature(**arguments)
    with pytest.raises(InputError, match=fault):
        creature_pair(**arguments)


def test_an_unknown_pose_is_refused():
    with refused("'wave'", "quadruped", "rest, stand"):
        creature("quadruped", pose="wave")
