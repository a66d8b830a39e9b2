"""Pictures of meshes have the right camera, visibility and light."""

from dataclasses import replace

import numpy as np
import pytest
from report_helpers import TALL, ellipsoid, renumbered, uniform
from synthetic import grid_mesh

from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report import colors, rendering
from jaxsmw.report.rendering import camera_axes, choose_azimuth, render
from jaxsmw.report.standing import stand

SPHERE = stand(ellipsoid(1, 1, 1, subdivisions=4), "y")
RADIUS = 0.5 / np.sqrt(np.pi)  # the radius of a sphere with area 1


def test_people_are_seen_from_the_front_and_animals_from_the_side() -> None:
    person, animal = stand(ellipsoid(0.5, 1, 0.2), "y"), stand(ellipsoid(0.2, 0.5, 1), "y")
    assert 0 <= np.degrees(choose_azimuth([person])) < 25
    assert 50 < np.degrees(choose_azimuth([animal])) < 90
    assert choose_azimuth([person, person]) == pytest.approx(choose_azimuth([person]))
    axes = camera_axes(choose_azimuth([person]))
    assert np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) == pytest.approx(1)


def test_a_sphere_covers_a_disc_without_cracks() -> None:
    picture = render(SPHERE, uniform(SPHERE, 1, 0, 0), azimuth=0.3, scale=500.0, width=320, height=300)
    assert picture.shape == (300, 320, 4) and picture.dtype == np.uint8
    assert picture[..., 3].sum() / 255 == pytest.approx(np.pi * (500 * RADIUS) ** 2, rel=0.005)
    y, x = np.mgrid[:300, :320] + 0.5
    distance = np.hypot(x - 160, y - 150)
    assert np.all(picture[distance < 500 * RADIUS - 2, 3] == 255)
    assert np.all(picture[distance > 500 * RADIUS + 2] == 0)
    red = picture[picture[..., 3] > 0]
    assert np.all(red[:, 0] > 80) and np.all(red[:, 1:3] < 10)


def test_light_comes_from_the_upper_left() -> None:
    picture = render(SPHERE, uniform(SPHERE, 0.5, 0.5, 0.5), azimuth=1.0, scale=500.0, width=300, height=300)
    brightness = picture[..., 0].astype(int)
    assert brightness[100, 100] > brightness[150, 150] > brightness[220, 220]


def test_the_nearer_surface_hides_the_farther() -> None:
    towards = camera_axes(0.4)[2]
    n = len(SPHERE.vertices)
    two = replace(
        SPHERE,
        vertices=np.concatenate([SPHERE.vertices + 0.4 * towards, SPHERE.vertices - 0.4 * towards]),
        faces=np.concatenate([SPHERE.faces, SPHERE.faces + n]),
    )
    color = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], n, axis=0)
    for order in (1, -1):
        turned = replace(two, faces=two.faces[::order])
        picture = render(turned, color, azimuth=0.4, scale=300.0, width=200, height=200)
        visible = picture[picture[..., 3] == 255]
        assert np.all(visible[:, 2] == 0) and np.all(visible[:, 0] > 50)


def test_a_picture_depends_on_the_surface_only() -> None:
    mesh = stand(TALL)
    color = colors.position_colors(mesh)

    def picture(mesh: Mesh, color: np.ndarray) -> np.ndarray:
        return render(mesh, color, azimuth=0.3, scale=200.0, width=200, height=220).astype(int)

    expected = picture(mesh, color)
    other, number = renumbered(mesh)
    order = np.argsort(number)
    assert np.abs(picture(other, color[order]) - expected).max() <= 1
    # An inside-out mesh has the same lighting.
    inside_out = replace(mesh, faces=mesh.faces[:, ::-1])
    assert np.abs(picture(inside_out, color) - expected).max() <= 1


def test_the_chunk_size_does_not_change_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = grid_mesh(3, 3)
    mesh = stand(Mesh(vertices, faces))
    color = colors.position_colors(mesh)
    pictures = []
    for chunk in (10, 1000, 10**9):
        monkeypatch.setattr(rendering, "_CHUNK", chunk)
        pictures.append(render(mesh, color, azimuth=0.0, scale=100.0, width=140, height=140))
    assert np.array_equal(pictures[0], pictures[2]) and np.array_equal(pictures[1], pictures[2])
    assert (pictures[0][..., 3] == 255).sum() == pytest.approx(100**2 * np.cos(rendering.ELEVATION), rel=0.03)


def test_bodies_larger_than_the_picture_are_cut_off() -> None:
    color = uniform(SPHERE, 0, 1, 0)
    large = render(SPHERE, color, azimuth=0.0, scale=400.0, width=300, height=300)
    small = render(SPHERE, color, azimuth=0.0, scale=400.0, width=100, height=60)
    # The pictures may differ only in ambient occlusion, which a convex body has only near its outline.
    assert np.abs(large[120:180, 100:200].astype(int) - small).max() <= 12
    assert np.all(small[..., 3] == 255)
