"""Small components, such as eyes, are matched to their counterparts, and move rigidly with their surroundings."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh, sphere_mesh

import jaxsmw
from jaxsmw import Mesh, make_mesh
from jaxsmw.geometry.surface_distance import nearest_surface_points
from jaxsmw.transfer import match_small_components, register_mesh

TURN = Rotation.from_euler("zyx", [40, -70, 110], degrees=True).as_matrix()
BALL, BALL_FACES = sphere_mesh(1)
# Two pairs of equal eyes on opposite sides of the body. The last two eyes are at the same place: one encloses
# the other.
EYES = ((1.2, 0.3, 0), (1.2, -0.3, 0), (-1, 0, 0.8), (-1, 0, 0.8))
RADII = (0.15, 0.15, 0.12, 0.08)


def with_eyes(centers=EYES, radii=RADII) -> Mesh:
    """A body of 642 vertices, followed by eyes of 42 vertices each."""
    return joined(
        bumpy_mesh(3), *((np.array(c) + r * BALL, BALL_FACES) for c, r in zip(centers, radii, strict=True))
    )


def joined(body: Mesh, *parts: tuple[np.ndarray, np.ndarray]) -> Mesh:
    vertices, faces, n = [body.vertices], [body.faces], len(body.vertices)
    for points, triangles in parts:
        vertices.append(points)
        faces.append(triangles + n)
        n += len(points)
    return make_mesh(np.vstack(vertices), np.vstack(faces))


def eye(number: int) -> np.ndarray:
    """The vertices of an eye."""
    return 642 + 42 * number + np.arange(42)


def on_the_body(mesh: Mesh, matches: np.ndarray) -> np.ndarray:
    """A map that is only known on the body: all other vertices have the match of vertex 0."""
    return np.where(mesh.referenced_vertices, matches, matches[0])


def test_meshes_without_small_components_keep_their_map():
    mesh = bumpy_mesh(3)
    given = np.arange(642)[::-1].copy()
    found, left_out = match_small_components(mesh, with_eyes(), given, scale=1.0)
    assert found is given and left_out == 0


@pytest.mark.parametrize("matrix", [np.eye(3), 7 * TURN, TURN @ np.diag([-1.0, 1, 1])])
def test_every_eye_is_matched_to_itself_in_any_order(matrix):
    mesh = with_eyes()
    order = np.random.default_rng(0).permutation(
        len(mesh.vertices)
    )  # new vertex i is the old vertex order[i]
    number = np.argsort(order)
    faces = np.vstack([mesh.faces, mesh.small_faces])
    turned = make_mesh((mesh.vertices @ matrix.T)[order] + [1e4, 0, 0], number[faces][::-1])
    scale = np.cbrt(abs(np.linalg.det(matrix)))
    found, left_out = match_small_components(mesh, turned, on_the_body(mesh, number), scale=scale)
    np.testing.assert_array_equal(found, number)
    assert left_out == 0


def test_equal_components_at_one_place_keep_their_order():
    mesh = with_eyes([EYES[0]] * 3, [0.1] * 3)
    found, _ = match_small_components(mesh, mesh, on_the_body(mesh, np.arange(768)), scale=1.0)
    np.testing.assert_array_equal(found, np.arange(768))


def test_an_eye_does_not_take_the_counterpart_of_another_eye():
    """The target lacks the first eye. Its match is a vertex of the body, and the other eyes keep theirs."""
    mesh, target = with_eyes(), with_eyes(EYES[1:], RADII[1:])
    found, left_out = match_small_components(mesh, target, on_the_body(mesh, np.arange(810) % 642), scale=1.0)
    assert (found[eye(0)] < 642).all()
    for number in range(1, 4):
        np.testing.assert_array_equal(found[eye(number)], eye(number - 1))
    areas = [Mesh(mesh.vertices, mesh.small_faces[i * 80 : i * 80 + 80]).area for i in range(4)]
    assert left_out == pytest.approx(areas[0] / (mesh.area + sum(areas)))


def test_components_far_from_any_counterpart_are_left_out():
    mesh, target = with_eyes(EYES[:1], RADII[:1]), with_eyes(EYES[2:3], RADII[:1])
    found, left_out = match_small_components(mesh, target, on_the_body(mesh, np.arange(684)), scale=1.0)
    assert (found[eye(0)] < 642).all() and left_out > 0
    # The matches are the nearest vertices of the body.
    distances = np.linalg.norm(mesh.vertices[eye(0), None] - target.vertices[:642], axis=2)
    np.testing.assert_array_equal(found[eye(0)], distances.argmin(axis=1))


def test_duplicates_of_welding_follow_their_component():
    """Duplicates along a seam of an eye have the matches of the eye, not of the body."""
    eyes = with_eyes()
    vertices = np.vstack([eyes.vertices, eyes.vertices[eye(1)]])
    faces = np.vstack([eyes.faces, eyes.small_faces])
    at = np.flatnonzero(np.isin(faces, eye(1)).all(axis=1))[:40]
    faces[at] += len(eyes.vertices) - eye(1)[0]
    mesh = make_mesh(vertices, faces, weld=True)
    assert len(mesh.small_faces) == len(eyes.small_faces)
    found, _ = match_small_components(mesh, eyes, on_the_body(mesh, np.r_[np.arange(810), eye(1)]), scale=1.0)
    np.testing.assert_array_equal(found, np.r_[np.arange(810), eye(1)])


def test_specks_without_area_do_no_harm():
    body = bumpy_mesh(3)
    point, line = np.full((3, 3), 2.0), np.outer([2.0, 2.1, 2.2], np.ones(3))
    mesh = joined(body, (point, np.array([[0, 1, 2]])), (line, np.array([[0, 1, 2]])))
    assert len(mesh.small_faces) == 2
    found, left_out = match_small_components(mesh, mesh, on_the_body(mesh, np.arange(648)), scale=1.0)
    np.testing.assert_array_equal(found[:642], np.arange(642))
    assert set(found[642:645]) <= {642, 643, 644} and set(found[645:]) <= {645, 646, 647} and left_out == 0


@pytest.mark.parametrize("with_counterparts", [True, False])
def test_registered_meshes_keep_the_shapes_of_small_components(with_counterparts):
    """The body is stretched along x. Eyes are not, and lie at their counterparts if there are some."""
    mesh, stretch = with_eyes(EYES[:3], RADII[:3]), np.array([1.3, 1, 1])
    body = Mesh(bumpy_mesh(3).vertices * stretch, bumpy_mesh(3).faces)
    parts = [(stretch * c + 0.1 * BALL, BALL_FACES) for c in EYES[:3]] if with_counterparts else []
    target = joined(body, *parts)
    points = nearest_surface_points(np.vstack([body.vertices, *3 * [body.vertices[:42]]]), target)[0]
    registered = register_mesh(mesh, target, points)
    for number, center in enumerate(EYES[:3]):
        found = registered.vertices[eye(number)]
        lengths = np.linalg.norm(found - found.mean(axis=0), axis=1)
        np.testing.assert_allclose(lengths, lengths[0], rtol=1e-6)
        offset = np.linalg.norm(found.mean(axis=0) - stretch * center)
        assert offset < (1e-6 if with_counterparts else 0.2)
        if with_counterparts:
            assert lengths[0] == pytest.approx(0.1, rel=1e-6)


@pytest.mark.slow
def test_match_sends_eyes_to_eyes_in_both_directions():
    mesh = with_eyes()
    found = jaxsmw.match(mesh, mesh, preset="fast", init=np.arange(810))
    np.testing.assert_array_equal(found.pointwise_map[642:], np.arange(642, 810))
    np.testing.assert_array_equal(found.reverse_map()[642:], np.arange(642, 810))
    assert found.left_out == 0 and len(found.surface_points()) == len(found.reverse_surface_points()) == 810
    assert np.isfinite(found.expected_error()).all()


def test_match_warns_if_much_is_left_out():
    centers = [*EYES[:3], (0, 1.2, 0), (0, -1.2, 0)]
    mesh, body = with_eyes(centers, [0.19] * 5), bumpy_mesh(3)
    with pytest.warns(UserWarning, match="% of the source's area lies in small components"):
        found = jaxsmw.match(mesh, body, preset="fast", init=np.arange(852) % 642)
    assert 0.05 < found.left_out < 0.25
    assert (found.pointwise_map < 642).all()
