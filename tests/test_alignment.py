"""Rigid alignment, and the initial map that uses it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh, sphere_mesh, vase_mesh

from jaxsmw import Pair, initial_map, make_mesh, match, paired_spectra
from jaxsmw.geometry.alignment import align_rigidly, symmetries

LUMP = bumpy_mesh(3)


@pytest.mark.parametrize("seed", range(2))
def test_a_moved_copy_is_aligned_exactly(seed):
    generator = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=seed), generator.normal(size=3)
    moved = turn.apply(LUMP.vertices)[generator.permutation(len(LUMP.vertices))] + shift
    motion = align_rigidly(LUMP.vertices, moved)
    np.testing.assert_allclose(motion.rotation, turn.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(motion.apply(LUMP.vertices), turn.apply(LUMP.vertices) + shift, atol=1e-6)


def test_the_motion_is_never_a_reflection():
    motion = align_rigidly(LUMP.vertices, LUMP.vertices * [-1, 1, 1])
    assert np.linalg.det(motion.rotation) == pytest.approx(1)


def test_noise_and_other_points_are_aligned_closely():
    generator = np.random.default_rng(0)
    turn = Rotation.random(random_state=1)
    long = np.array([1, 1.3, 2])
    fine = turn.apply(bumpy_mesh(4).vertices * long)
    noisy = LUMP.vertices * long + 0.01 * generator.normal(size=LUMP.vertices.shape)
    motion = align_rigidly(noisy, fine)
    assert (Rotation.from_matrix(motion.rotation) * turn.inv()).magnitude() < 0.02


@pytest.mark.parametrize("partial", [False, True])
def test_the_initial_map_of_a_moved_copy_is_right(partial):
    turn, scale = Rotation.random(random_state=2), 1.0 if partial else 5.0
    order = np.random.default_rng(0).permutation(len(LUMP.vertices))
    vertices = np.empty_like(LUMP.vertices)
    vertices[order] = scale * turn.apply(LUMP.vertices) - 3
    target = make_mesh(vertices, order[LUMP.faces])
    pair = Pair.make(LUMP, target, partial=partial)
    spectra = paired_spectra(pair, 20)
    np.testing.assert_array_equal(initial_map(pair, *spectra, init="aligned"), order)


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_aligned_meshes_are_matched_by_their_positions(offset):
    """A sphere looks the same from all sides, so only the positions tell which point is which."""
    ball = make_mesh(*sphere_mesh(3))
    order = np.random.default_rng(0).permutation(len(ball.vertices))
    vertices = np.empty_like(ball.vertices)
    vertices[order] = 1.05 * ball.vertices + offset
    source = make_mesh(ball.vertices + offset, ball.faces)
    found = match(source, make_mesh(vertices, order[ball.faces]), init="positions")
    np.testing.assert_array_equal(found.initial_map, order)
    far = np.linalg.norm(ball.vertices - ball.vertices[np.argsort(order)[found.pointwise_map]], axis=1)
    assert far.mean() < 0.1 and not found.mirrored


def test_positions_keep_the_sides_of_a_thin_sheet_apart():
    """The positions of the sides are nearer to each other than to their counterparts on the moved sheet."""
    ball = make_mesh(*sphere_mesh(3))
    thin = make_mesh(ball.vertices * [1, 1, 0.01], ball.faces)
    moved = make_mesh(thin.vertices + np.array([0, 0, 0.03]), thin.faces)
    pair = Pair.make(thin, moved)
    found = initial_map(pair, *paired_spectra(pair, 20), init="positions")
    inside = np.abs(thin.vertices[:, 2]) > 0.005
    same_side = thin.vertices[found, 2] * thin.vertices[:, 2] > 0
    assert same_side[inside].all()


def test_mirrored_shapes_are_aligned_as_their_mirror_images():
    image = LUMP.mirrored()
    target = make_mesh(image.vertices, image.faces)
    found = match(LUMP, target, preset="paper", init="aligned", mirror="yes")
    np.testing.assert_array_equal(found.initial_map, np.arange(len(LUMP.vertices)))


@pytest.mark.sampled
def test_a_bent_shape_is_matched_from_descriptors():
    """No rigid motion brings a bent shape into place, so the map from SHOT is better."""
    straight = bumpy_mesh(4).vertices * [1, 1, 3]
    angle, radius = straight[:, 2] / 3, 3 + straight[:, 1]
    bent = np.stack([straight[:, 0], radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    faces = bumpy_mesh(4).faces
    target = make_mesh(Rotation.random(random_state=4).apply(bent), faces)
    found = match(make_mesh(straight, faces), target)
    apart = np.linalg.norm(target.vertices[found.pointwise_map] - target.vertices, axis=1)
    assert apart.mean() < 0.02 * target.area**0.5


def test_tangent_planes_bring_a_nearly_round_copy_into_its_exact_place():
    """Samples of both surfaces differ, so closest points alone stop at a wrong rotation."""
    mesh = bumpy_mesh(4)
    generator = np.random.default_rng(0)
    turn = Rotation.random(random_state=5)
    x, y = (generator.permutation(len(mesh.vertices))[:1000] for _ in range(2))
    points = turn.apply(mesh.vertices[y])
    coarse = align_rigidly(mesh.vertices[x], points)
    fine = align_rigidly(mesh.vertices[x], points, turn.apply(mesh.vertex_normals[y]))
    off = [(Rotation.from_matrix(motion.rotation) * turn.inv()).magnitude() for motion in (coarse, fine)]
    assert off[1] < 0.01 < off[0]


def test_tangent_planes_are_not_used_for_shapes_that_only_resemble_each_other():
    other = make_mesh(LUMP.vertices * (1 + 0.1 * np.sin(5 * LUMP.vertices)), LUMP.faces)
    plain = align_rigidly(LUMP.vertices, other.vertices)
    with_normals = align_rigidly(LUMP.vertices, other.vertices, other.vertex_normals)
    np.testing.assert_array_equal(with_normals.rotation, plain.rotation)


@pytest.mark.parametrize("folds", [2, 3, 4, 5])
def test_a_vase_with_ribs_has_one_symmetry_fewer_than_ribs(folds):
    mesh = make_mesh(Rotation.random(random_state=1).apply(vase_mesh(folds).vertices), vase_mesh(folds).faces)
    surface = mesh.vertices[::2] / mesh.area**0.5, mesh.vertex_normals[::2]
    turns = [Rotation.from_matrix(motion.rotation) for motion in symmetries(*surface)]
    angles = sorted(round(turn.magnitude() / (2 * np.pi / folds), 1) for turn in turns)
    assert angles == sorted(min(rib, folds - rib) for rib in range(1, folds))
    assert symmetries(*surface, mirrored=True)


def test_the_boundary_of_a_symmetric_sheet_fits_as_well():
    """All points of flat sheets lie in one plane, and so do their moved points."""
    square = np.stack(np.meshgrid(np.arange(40), np.arange(40)), axis=-1).reshape(-1, 2) / 40
    square += np.random.default_rng(0).uniform(-0.01, 0.01, square.shape)
    corner = square[(square < 0.5).any(axis=1)]
    for sheet, turns, reflections in ((square, 3, 4), (corner, 0, 1)):
        surface = np.column_stack([sheet, np.zeros(len(sheet))]), np.tile([0, 0, 1.0], (len(sheet), 1))
        assert len(symmetries(*surface)) == turns
        assert len(symmetries(*surface, mirrored=True)) == reflections
    assert symmetries(surface[0][:10], surface[1][:10]) == []


def test_a_lump_has_no_symmetry():
    surface = LUMP.vertices / LUMP.area**0.5, LUMP.vertex_normals
    assert not symmetries(*surface) and not symmetries(*surface, mirrored=True)
