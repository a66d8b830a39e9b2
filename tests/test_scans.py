"""Raw scans are matched as they are: lost vertices are moved, and small components take no part."""

import numpy as np
import pytest
from synthetic import bumpy_mesh

import jaxsmw
from jaxsmw.geometry import Mesh
from jaxsmw.geometry.mesh import connected_components


def scan(lost: float = np.nan) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface with a lost vertex, and two specks of one triangle each."""
    mesh = bumpy_mesh(4)
    vertices = np.vstack([mesh.vertices, mesh.vertices[mesh.faces[:2].ravel()] + [3, 0, 0]])
    vertices[100, 1] = lost
    n = len(mesh.vertices)
    return vertices, np.vstack([mesh.faces, [[n, n + 1, n + 2], [n + 3, n + 4, n + 5]]])


@pytest.mark.parametrize("lost", [np.nan, np.inf, -1e30, 5e4])
def test_a_lost_vertex_and_specks_are_left_out(lost):
    vertices, faces = scan(lost)
    mesh = jaxsmw.make_mesh(vertices, faces)
    whole = bumpy_mesh(4)
    around = (whole.faces == 100).any(axis=1)
    np.testing.assert_array_equal(mesh.faces, whole.faces[~around])
    assert sorted(mesh.dropped_faces) == sorted(
        [*np.flatnonzero(around), len(whole.faces), len(whole.faces) + 1]
    )
    neighbors = np.setdiff1d(whole.faces[around], [100])
    np.testing.assert_allclose(mesh.vertices[100], whole.vertices[neighbors].mean(axis=0))
    kept = np.arange(len(vertices)) != 100
    np.testing.assert_array_equal(mesh.vertices[kept], vertices[kept])
    text = " ".join(mesh.notes)
    assert "1 vertex without a usable position" in text and "number 100 (counted from 0)" in text
    assert f"{around.sum()} faces dropped" in text
    assert "2 small components" in text and "(2 faces)" in text


def test_many_lost_vertices_are_refused():
    vertices, faces = scan()
    vertices[:20] = np.nan
    with pytest.raises(jaxsmw.InputError, match="not a finite number at 21 vertices"):
        jaxsmw.make_mesh(vertices, faces)


def test_components_stay_if_none_has_half_of_the_area():
    ball = bumpy_mesh(2)
    triangle = 0.01 * np.eye(3)
    apart = np.array([5, 0, 0])
    vertices = np.vstack([ball.vertices, ball.vertices + apart, ball.vertices - apart, triangle])
    n = len(ball.vertices)
    faces = np.vstack([ball.faces, ball.faces + n, ball.faces + 2 * n, [[3 * n, 3 * n + 1, 3 * n + 2]]])
    mesh = jaxsmw.make_mesh(vertices, faces)
    assert len(mesh.faces) == len(faces) and not mesh.notes


@pytest.mark.parametrize(
    ("size", "open_", "kept"), [(0.15, False, False), (0.3, False, True), (0.15, True, True)]
)
def test_closed_bubbles_take_no_part(size, open_, kept):
    """A bubble has 2 % or 8 % of the area. An open surface of 2 % can be a severed limb."""
    outside = bumpy_mesh(3)
    bubble = outside.faces[1:] if open_ else outside.faces
    n = len(outside.vertices)
    vertices = np.vstack([outside.vertices, size * outside.vertices])
    mesh = jaxsmw.make_mesh(vertices, np.vstack([outside.faces, bubble + n]))
    assert mesh.referenced_vertices[n:].all() == kept and mesh.referenced_vertices[:n].all()
    assert any("small component" in note for note in mesh.notes) != kept


@pytest.mark.slow
def test_specks_move_with_their_surroundings():
    vertices, faces = scan()
    target = bumpy_mesh(4)
    found = jaxsmw.match((vertices, faces), target, preset="fast", init=np.arange(len(vertices)) % 2562)
    used = found.mesh_x.referenced_vertices
    distances = np.linalg.norm(vertices[~used][1:, None] - target.vertices, axis=2)
    np.testing.assert_array_equal(found.pointwise_map[~used][1:], distances.argmin(axis=1))
    assert found.left_out == pytest.approx(2 / 5120, rel=0.5)


def test_skulls_are_read_as_scanned(shared):
    for name in ("WSB", "B6FVBF1"):
        mesh: Mesh = jaxsmw.read_mesh(shared / f"data/mouse_skulls/{name}.ply")
        assert np.isfinite(mesh.vertices).all()
        _, component = connected_components(mesh.edges, len(mesh.vertices))
        assert len(np.unique(component[mesh.faces[:, 0]])) == 1
        assert "without a usable position" in mesh.notes[1] and "small components" in mesh.notes[2]
