"""Figures and the interactive page: what they show must be what they were given."""

import base64
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_hex
from matplotlib.image import imread
from synthetic import grid_mesh, random_spectrum, sphere_mesh

from jaxsmw.core.banks import Meyer
from jaxsmw.core.functional_map import encode
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.mesh_files import read_mesh
from jaxsmw.report import colors, figures, rendering
from jaxsmw.report import page as page_module
from jaxsmw.report.figures import (
    draw_correspondence,
    draw_filters,
    draw_functional_map,
    draw_mesh,
    draw_quality_curves,
    save_figure,
)
from jaxsmw.report.page import ShownMap, eigenvectors_on_page, write_page
from jaxsmw.report.rendering import camera_axes, choose_azimuth, render, stand, stand_pair

ROOT = Path(__file__).resolve().parents[1]


def ellipsoid(*half_axes: float, subdivisions: int = 3, name: str = "ellipsoid") -> Mesh:
    vertices, faces = sphere_mesh(subdivisions)
    return Mesh(vertices * half_axes, faces.astype(np.int64), name)


def renumbered(mesh: Mesh, seed: int = 0) -> tuple[Mesh, np.ndarray]:
    """The same surface with shuffled vertices and faces, and the new number of each vertex."""
    generator = np.random.default_rng(seed)
    order = generator.permutation(len(mesh.vertices))
    number = np.argsort(order)
    faces = generator.permutation(number[mesh.faces])
    return replace(mesh, vertices=mesh.vertices[order], faces=faces), number


TALL = ellipsoid(0.6, 1.2, 0.3)  # a y-up standing body


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users run it: without run-time checks of types, which would forestall our own sentences."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


# ---- Colours


def test_oklab_against_published_values() -> None:
    # CSS Color Module Level 4: sRGB white, red and blue in OKLab.
    lab = np.array([[1, 0, 0], [0.627955, 0.224863, 0.125846], [0.452014, -0.032457, -0.311528]])
    assert np.allclose(colors._oklab_to_srgb(lab), [[1, 1, 1], [1, 0, 0], [0, 0, 1]], atol=2e-3)


@given(st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_srgb_round_trip(color: list[float]) -> None:
    assert np.allclose(colors.linear_to_srgb(colors.srgb_to_linear(np.array(color))), color, atol=1e-5)


def test_position_colors_tell_places_apart_smoothly() -> None:
    mesh = stand(TALL)
    color = colors.position_colors(mesh)
    assert color.min() >= 0 and color.max() <= 1
    edges = mesh.edges
    assert np.abs(color[edges[:, 0]] - color[edges[:, 1]]).max() < 0.2
    # Ends of each axis, and above all right against left.
    ends = [(mesh.vertices[:, axis].argmin(), mesh.vertices[:, axis].argmax()) for axis in range(3)]
    difference = [np.abs(color[low] - color[high]).max() for low, high in ends]
    assert min(difference) > 0.15 and min(difference[:2]) > 0.4


def test_position_colors_follow_vertices_not_their_numbers_or_unit() -> None:
    mesh, number = renumbered(TALL)
    expected = colors.position_colors(stand(TALL))
    assert np.allclose(colors.position_colors(stand(mesh))[number], expected)
    scaled = replace(TALL, vertices=1e6 * TALL.vertices + [1e6, 0, -3e6])
    assert np.allclose(colors.position_colors(stand(scaled)), expected, atol=1e-3)


def test_position_colors_of_a_flat_mesh_ignore_the_missing_direction() -> None:
    vertices, faces = grid_mesh(9, 9)
    flat = Mesh(vertices, faces)
    noisy = replace(flat, vertices=vertices + 1e-12 * np.random.default_rng(0).normal(size=vertices.shape))
    difference = colors.position_colors(stand(flat)) - colors.position_colors(stand(noisy))
    assert np.abs(difference).max() < 1e-6


def test_unused_vertices_do_not_change_the_colors_of_others() -> None:
    stray = replace(TALL, vertices=np.concatenate([TALL.vertices, [[50.0, -9, 7]]]))
    n = len(TALL.vertices)
    expected = colors.position_colors(stand(TALL))
    assert np.allclose(colors.position_colors(stand(stray))[:n], expected)


def test_error_colors_darken_with_the_error() -> None:
    color = colors.error_colors(np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, np.inf, np.nan]), 0.5)
    luminance = colors.srgb_to_linear(color) @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luminance[:6]) < -0.02)
    assert np.array_equal(color[6], color[5])
    assert np.array_equal(color[7], colors.PLAIN)


def test_signed_colors_are_blue_below_and_red_above_as_strongly() -> None:
    values = np.array([-2, -1, -0.5, 0, 0.5, 1, 2])
    for on_dark in (False, True):
        color = colors.signed_colors(values, 1.0, on_dark=on_dark)
        assert np.array_equal(color[[0, -1]], color[[1, -2]])
        assert np.ptp(color[3]) < 0.03 and np.all(color[:3, 2] > color[:3, 0] + 0.2)
        assert np.all(color[4:, 0] > color[4:, 2] + 0.2)
        luminance = colors.srgb_to_linear(color) @ [0.2126, 0.7152, 0.0722]
        # Zero is the ground; what is far from it stands out, on either side.
        assert np.all(np.diff(luminance[3:6]) * (1 if on_dark else -1) > 0.05)
        assert np.all(np.diff(luminance[1:4]) * (-1 if on_dark else 1) > 0.05)


# ---- Standing and looking


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_stand_turns_the_named_axis_up(up: Any) -> None:
    direction = {"x": 0, "y": 1, "z": 2}[up[-1]]
    marked = replace(TALL, vertices=np.concatenate([TALL.vertices, np.zeros((3, 3)), np.eye(3)]))
    standing = stand(marked, up)
    frame = (standing.vertices[-3:] - standing.vertices[-6:-3]) * np.sqrt(TALL.area)
    assert np.allclose(frame[direction], [0, -1 if up[0] == "-" else 1, 0])
    assert np.linalg.det(frame) == pytest.approx(1)
    assert standing.area == pytest.approx(1)
    used = standing.vertices[: len(TALL.vertices)]
    assert np.allclose(used.min(axis=0), -used.max(axis=0))


def test_default_up_axis() -> None:
    person, animal = np.array([0.4, 1, 0.3]), np.array([0.3, 0.6, 1])
    y_up, z_up = stand(ellipsoid(*person)), stand(ellipsoid(*person[[0, 2, 1]]))
    assert np.ptp(y_up.vertices, axis=0).argmax() == np.ptp(z_up.vertices, axis=0).argmax() == 1
    # An animal in a z-up file is long along y.
    assert np.ptp(stand(ellipsoid(*animal[[0, 2, 1]])).vertices, axis=0).argmax() == 2


def test_real_bodies_stand_upright(shared: Path) -> None:
    person = stand(read_mesh(shared / "data/faust_r/off/tr_reg_002.off"))
    assert np.ptp(person.vertices, axis=0).argmax() == 1
    other = stand(read_mesh(shared / "data/tosca_nonisometric/off/8_woman_02.off"))
    assert np.ptp(other.vertices, axis=0).argmax() == 1
    cat = stand(read_mesh(shared / "data/tosca_r/off/cat0.off"))
    assert np.ptp(cat.vertices, axis=0).argmax() == 2 and np.ptp(cat.vertices, axis=0).argmin() == 0


def test_stand_makes_faces_agree() -> None:
    mixed = TALL.faces.copy()
    mixed[::3] = mixed[::3, ::-1]
    for faces in (TALL.faces, mixed):
        standing = stand(replace(TALL, faces=faces))
        outwards = np.einsum("ij,ij->i", standing.vertex_normals, standing.vertices)
        assert np.all(outwards > 0) or np.all(outwards < 0)
        assert np.array_equal(np.sort(standing.faces), np.sort(faces))


@pytest.mark.usefixtures("unchecked")
def test_stand_refuses_what_it_cannot_show() -> None:
    with pytest.raises(InputError, match="nothing to draw"):
        stand(replace(TALL, vertices=0 * TALL.vertices))
    with pytest.raises(InputError, match="choose one of x, y, z"):
        stand(TALL, "w")  # type: ignore[arg-type]


def test_a_part_stays_small_beside_the_whole() -> None:
    part = replace(TALL, faces=TALL.faces[TALL.vertices[TALL.faces, 1].min(axis=1) > 0])
    assert part.area < 0.5 * TALL.area
    whole = stand(TALL)
    shown_part, shown_whole = stand_pair(part, TALL)
    assert shown_whole.area == pytest.approx(1) and shown_part.area == pytest.approx(part.area / TALL.area)
    assert np.array_equal(shown_whole.vertices, whole.vertices)
    assert stand_pair(TALL, part)[0].area == pytest.approx(TALL.area / part.area)
    # The whole in another unit is as large as before, and of a part in millimetres nothing can be said.
    for other in (1.2, 1000.0):
        assert stand_pair(replace(TALL, vertices=other * TALL.vertices), TALL)[0].area == pytest.approx(1)


def test_people_are_seen_from_the_front_and_animals_from_the_side() -> None:
    person, animal = stand(ellipsoid(0.5, 1, 0.2), "y"), stand(ellipsoid(0.2, 0.5, 1), "y")
    assert 0 <= np.degrees(choose_azimuth([person])) < 25
    assert 50 < np.degrees(choose_azimuth([animal])) < 90
    assert choose_azimuth([person, person]) == pytest.approx(choose_azimuth([person]))
    axes = camera_axes(choose_azimuth([person]))
    assert np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) == pytest.approx(1)


# ---- Rendering

SPHERE = stand(ellipsoid(1, 1, 1, subdivisions=4), "y")
RADIUS = 0.5 / np.sqrt(np.pi)  # of a sphere with area 1


def uniform(mesh: Mesh, *color: float) -> np.ndarray:
    return np.tile(np.array(color, dtype=float), (len(mesh.vertices), 1))


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
    # Inside out it is lit the same.
    inside_out = replace(mesh, faces=mesh.faces[:, ::-1])
    assert np.abs(picture(inside_out, color) - expected).max() <= 1


def test_large_and_many_triangles_go_through_any_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = grid_mesh(3, 3)
    mesh = stand(Mesh(vertices, faces))
    color = colors.position_colors(mesh)
    pictures = []
    for chunk in (10, 1000, 10**9):
        monkeypatch.setattr(rendering, "_CHUNK", chunk)
        pictures.append(render(mesh, color, azimuth=0.0, scale=100.0, width=140, height=140))
    assert np.array_equal(pictures[0], pictures[2]) and np.array_equal(pictures[1], pictures[2])
    assert (pictures[0][..., 3] == 255).sum() == pytest.approx(100**2 * np.cos(rendering.ELEVATION), rel=0.03)


def test_what_reaches_beyond_the_picture_is_cut_off() -> None:
    color = uniform(SPHERE, 0, 1, 0)
    large = render(SPHERE, color, azimuth=0.0, scale=400.0, width=300, height=300)
    small = render(SPHERE, color, azimuth=0.0, scale=400.0, width=100, height=60)
    # Ambient occlusion apart, of which a convex body has none inside.
    assert np.abs(large[120:180, 100:200].astype(int) - small).max() <= 12
    assert np.all(small[..., 3] == 255)


# ---- Figures


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bodies in figures smaller than usual, to save time."""
    monkeypatch.setattr(figures, "_BODY_SIZE", (300, 300))


def pixels(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def panels(figure: Any) -> dict[str, np.ndarray]:
    """The pictures of bodies in a figure by their role."""
    return {axes.get_label(): np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images}


@pytest.mark.usefixtures("small")
def test_correspondence_transfers_colors() -> None:
    other, number = renumbered(replace(TALL, name="other"))
    figure = draw_correspondence(TALL, other, number)
    shown = panels(figure)
    assert list(shown) == ["Source", "Target"]
    # The true map paints the same picture twice.
    assert np.abs(shown["Source"].astype(int) - shown["Target"]).max() <= 1
    wrong = panels(draw_correspondence(TALL, other, np.roll(number, 1)))
    assert np.array_equal(wrong["Target"], shown["Target"])
    assert np.abs(wrong["Source"].astype(int) - shown["Source"]).max() > 50
    covered = np.mean(shown["Source"][..., 3] == 255)
    assert 0.15 < covered < 0.5
    # Pixel for pixel: the panel is in the figure as it was rendered.
    image = pixels(figure)
    target = shown["Target"]
    inside = target[..., 3] == 255
    place = figure.axes[1].get_position()
    left, top = round(place.x0 * image.shape[1]), round((1 - place.y1) * image.shape[0])
    window = image[top : top + target.shape[0], left : left + target.shape[1]]
    assert np.array_equal(window[inside], target[..., :3][inside])


@pytest.mark.usefixtures("small")
def test_correspondence_with_errors() -> None:
    n = len(TALL.vertices)
    errors = np.where(TALL.vertices[:, 1] > 0, 0.3, 0.0)
    errors[0] = np.nan
    figure = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": errors})
    image = panels(figure)["Error on the source"].astype(int)
    height = image.shape[0]
    upper, lower = image[height // 4], image[3 * height // 4]
    upper, lower = upper[upper[:, 3] == 255], lower[lower[:, 3] == 255]
    assert upper[:, 1].max() < lower[:, 1].min()
    scale = next(axes for axes in figure.axes if axes.get_label() == "error scale")
    assert scale.get_ylim() == pytest.approx((0, 0.3))
    wider = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": errors}, error_limit=1.0)
    assert np.abs(panels(wider)["Error on the source"].astype(int) - image).max() > 50
    silent = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": np.full(n, np.nan)})
    assert len(panels(silent)) == 3
    both = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": errors, "Doubt": 2 * errors})
    assert list(panels(both))[2:] == ["Error on the source", "Doubt on the source"]
    scale = next(axes for axes in both.axes if axes.get_label() == "error scale")
    assert scale.get_ylim() == pytest.approx((0, 0.6))


@pytest.mark.usefixtures("small")
def test_view_options_change_the_picture() -> None:
    # A pointed body, so that every view differs.
    vertices = TALL.vertices * (1 + 0.5 * np.clip(TALL.vertices @ [[0.3], [1], [0.6]], 0, None))
    body = replace(TALL, vertices=vertices)
    images = [pixels(draw_mesh(body, up=up, azimuth=azimuth)) for up, azimuth in
              [(None, None), ("y", 0.0), ("y", 90.0), ("z", 0.0), ("-y", 0.0)]]  # fmt: skip
    assert len({image.tobytes() for image in images}) == len(images)
    same = pixels(draw_mesh(body, up="y"))
    assert np.array_equal(images[0], same)


@pytest.mark.usefixtures("small", "unchecked")
def test_draw_mesh_in_given_colors() -> None:
    red = pixels(draw_mesh(TALL, uniform(TALL, 1, 0, 0)))
    body = np.any(red < 250, axis=2)
    assert 0.3 < body.mean() < 0.7
    assert np.mean(red[body][:, 0] > 2 * red[body][:, 1] + 20) > 0.98
    plain = pixels(draw_mesh(TALL))
    assert np.ptp(plain, axis=2).max() < 12 and np.ptp(plain) > 100
    for bad in (0.5 * np.ones((3, 3)), 255 * uniform(TALL, 1, 0, 0), uniform(TALL, np.nan, 0, 0)):
        with pytest.raises(InputError, match="between 0 and 1"):
            draw_mesh(TALL, bad)


@pytest.mark.usefixtures("unchecked")
def test_functional_map_figure() -> None:
    matrix = np.diag([1.0, -2.0, 0.5]) @ np.eye(3, 5)
    figure = draw_functional_map(matrix)
    axes = figure.axes[0]
    assert np.array_equal(axes.images[0].get_array(), matrix)
    assert axes.images[0].get_clim() == (-2, 2)
    assert (axes.get_ylabel(), axes.get_xlabel()) == ("eigenfunction of X", "eigenfunction of Y")
    pushed = draw_functional_map(matrix, convention="pushforward").axes[0]
    assert (pushed.get_ylabel(), pushed.get_xlabel()) == ("eigenfunction of Y", "eigenfunction of X")
    # Zero is white, the largest entries are strongly red and blue.
    middle = axes.images[0].to_rgba(matrix)[..., :3]
    assert middle[0, 4].min() > 0.95
    assert middle[1, 1, 2] > middle[1, 1, 0] + 0.2 and middle[0, 0, 0] > middle[0, 0, 2] + 0.2
    assert np.ptp(pixels(figure)) > 200
    draw_functional_map(np.zeros((2, 2)))
    for bad in (np.ones(3), np.array([[np.nan]]), np.zeros((0, 3))):
        with pytest.raises(InputError, match="functional map"):
            draw_functional_map(bad)


@pytest.mark.usefixtures("unchecked")
def test_filter_figure() -> None:
    grid = np.linspace(0, 10, 50)
    responses = np.stack([np.cos(grid / 7) ** 2, np.sin(grid / 7), 0.3 + 0 * grid])
    eigenvalues = np.array([0.0, 2.5, 9.0])
    figure = draw_filters(grid, responses, eigenvalues)
    lines = figure.axes[0].get_lines()
    assert len(lines) == 5
    for line, response in zip(lines, responses, strict=False):
        assert np.array_equal(line.get_ydata(), response)
    assert np.allclose(lines[3].get_ydata(), (responses**2).sum(axis=0))
    assert np.array_equal(lines[4].get_xdata(), eigenvalues)
    assert len({to_hex(line.get_color()) for line in lines}) == 5
    assert len(figure.legends[0].get_texts()) == 5
    pixels(figure)
    with pytest.raises(InputError, match="filters, p"):
        draw_filters(grid, responses.T, eigenvalues)


@pytest.mark.usefixtures("unchecked")
def test_quality_curves() -> None:
    thresholds = np.linspace(0, 0.25, 26)
    names = ["$x_1", "_hidden", *(f"method {i}" for i in range(18))]
    curves = {name: (thresholds, 1 - np.exp(-(i + 1) * 5 * thresholds)) for i, name in enumerate(names)}
    figure = draw_quality_curves(curves, mean_errors={"$x_1": 0.01234})
    axes = figure.axes[0]
    lines = axes.get_lines()
    for line, (_, shares) in zip(lines, curves.values(), strict=True):
        assert np.allclose(line.get_ydata(), 100 * shares)
    assert len({(line.get_color(), str(line._dash_pattern)) for line in lines}) == len(names)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["$x_1: 0.0123", *names[1:]]
    assert axes.get_xlim() == (0, 0.25)
    # The legend stands beside the curves, not on them, and all of it within the figure.
    pixels(figure)
    legend = figure.legends[0].get_window_extent()
    assert legend.x0 > axes.get_window_extent().x1
    assert figure.bbox.fully_containsx(legend.x1) and figure.bbox.y0 < legend.y0 < legend.y1 < figure.bbox.y1
    with pytest.raises(InputError, match="at least one"):
        draw_quality_curves({})
    with pytest.raises(InputError, match="as many shares"):
        draw_quality_curves({"a": (thresholds, thresholds[1:])})
    with pytest.raises(InputError, match="no quality curves for b"):
        draw_quality_curves({"a": (thresholds, thresholds)}, mean_errors={"b": 1.0})


@pytest.mark.usefixtures("small")
def test_save_figure(tmp_path: Path) -> None:
    for suffix, magic in ((".png", b"\x89PNG"), (".PDF", b"%PDF"), (".svg", b"<?xml")):
        first, second = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
        save_figure(first, draw_mesh(TALL))
        save_figure(second, draw_mesh(TALL))
        assert first.read_bytes().startswith(magic)
        assert first.read_bytes() == second.read_bytes()
    figure = draw_mesh(TALL)
    image = imread(tmp_path / "a.png")
    assert image.shape[:2] == pixels(figure).shape[:2] and max(image.shape) >= 300
    assert np.allclose(255 * image[..., :3], pixels(figure), atol=1)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"\.png, \.pdf or \.svg"):
        save_figure(tmp_path / "c.jpg", figure)
    with pytest.raises(InputError, match="not a directory"):
        save_figure(tmp_path / "nowhere" / "c.png", figure)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("small")
def test_hostile_names_in_figures() -> None:
    body = replace(TALL, name="/secret/dir/$\\frac{$_\udcff.off")
    figure = draw_correspondence(body, body, np.arange(len(body.vertices)))
    pixels(figure)
    shown = " ".join(text.get_text() for text in figure.texts)
    assert "$\\frac{$_?.off" in shown and "secret" not in shown
    body = replace(TALL, name="long" * 50 + ".off")
    figure = draw_correspondence(body, body, np.arange(len(body.vertices)))
    pixels(figure)
    boxes = [text.get_window_extent() for text in figure.texts]
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.x1 for box in boxes)
    assert boxes[1].x1 < boxes[3].x0


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(InputError, match=r"pip install 'jaxsmw\[report\]'"):
        draw_functional_map(np.eye(3))
    shown = ShownMap(np.arange(len(TALL.vertices)))
    write_page(tmp_path / "page.html", TALL, TALL, {"map": shown}, title="no figures needed")


def test_matplotlib_is_imported_late_and_pyplot_never() -> None:
    script = (
        "import sys, jaxsmw.report.page, jaxsmw.report.figures as f; assert 'matplotlib' not in sys.modules; "
        "f.draw_functional_map([[1.0]]); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


def _page(mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Any, *, errors: Any = None, **options: Any) -> None:
    shown = ShownMap(pointwise_map, errors or {})
    write_page(os.devnull, mesh_x, mesh_y, {"map": shown}, title="", **options)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("show", [draw_correspondence, _page])
def test_bad_maps_and_errors_are_refused(show: Callable[..., Any]) -> None:
    n = len(TALL.vertices)
    good = np.arange(n)
    for bad in (good[1:], good.astype(float), good[None], good + 1, good - 1):
        with pytest.raises(InputError, match="is the direction right"):
            show(TALL, TALL, bad)
    for errors in (np.zeros(n - 1), np.full(n, -0.1)):
        with pytest.raises(InputError, match="non-negative"):
            show(TALL, TALL, good, errors={"Error": errors})
    for limit in (0, -1, np.nan, np.inf):
        with pytest.raises(InputError, match="positive"):
            show(TALL, TALL, good, errors={"Error": np.zeros(n)}, error_limit=limit)


# ---- The page, as a file

HOSTILE = '</script></title><img src=x onerror="window.hacked=1"><b>\'&{{script}}'


def embedded(page: str) -> dict[str, Any]:
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert data
    return json.loads(data[1])


def decode(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def test_page_holds_the_data_and_nothing_from_elsewhere(tmp_path: Path) -> None:
    other, number = renumbered(ellipsoid(0.5, 1.1, 0.4, name="/home/someone/other.off"))
    errors = np.linspace(0, 0.1, len(number))
    named = {"Error": errors, "Expected <error>": errors / 2}
    matrix = np.arange(6.0).reshape(2, 3)
    maps = {"A <b>": ShownMap(number, named, matrix, "pushforward"), "B": ShownMap(number[::-1])}
    write_page(tmp_path / "page.html", TALL, other, maps, title="One", error_limit=0.05)
    page = (tmp_path / "page.html").read_text("utf-8")
    data = embedded(page)
    for side, standing in zip("xy", stand_pair(TALL, other), strict=True):
        assert np.allclose(decode(data[side]["vertices"], "<f4").reshape(-1, 3), standing.vertices, atol=1e-6)
        assert np.array_equal(decode(data[side]["faces"], "<u4").reshape(-1, 3), standing.faces)
    first, second = data["maps"]
    assert (first["name"], second["name"]) == ("A <b>", "B")
    assert np.array_equal(decode(first["map"], "<u4"), number)
    assert np.array_equal(decode(second["map"], "<u4"), number[::-1])
    assert list(first["errors"]) == data["error_names"] == list(named) and second["errors"] == {}
    for name, values in named.items():
        assert np.allclose(decode(first["errors"][name], "<f4"), values)
    assert np.array_equal(decode(first["functional"]["values"], "<f4").reshape(2, 3), matrix)
    assert first["functional"]["pushforward"] and second["functional"] is None
    scale = decode(data["scales"]["error"], "u1").reshape(-1, 3)
    assert np.array_equal(scale, np.round(255 * colors.error_colors(np.linspace(0, 0.05, 256), 0.05)))
    assert data["limit"] == 0.05
    assert 'value="error-1"><span>Expected &lt;error&gt;<' in page and "<span>A &lt;b&gt;<" in page
    assert 'value="wavelets"' not in page
    assert "someone" not in page and "other.off · 642 vertices" in page and "≥ 0.05 √area" in page
    assert "{{" not in page.split("<script>")[0]
    # The one address is the name of a namespace, which nobody fetches.
    assert set(re.findall(r"https?://[^\s\"'`<]+", page)) == {"http://www.w3.org/1999/xhtml"}
    assert not re.search(r"<(link|iframe|object)|@import|\burl\(", page.split("<script>")[0])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html"]


def test_errors_are_shown_on_the_scale_of_the_best_map(tmp_path: Path) -> None:
    n = len(TALL.vertices)
    maps = {
        name: ShownMap(np.arange(n), {"Error": np.full(n, error)} if error else {})
        for name, error in {"bad": 0.7, "good": 0.02, "unknown": 0}.items()
    }
    write_page(tmp_path / "page.html", TALL, TALL, maps, title="t")
    assert embedded((tmp_path / "page.html").read_text("utf-8"))["limit"] == pytest.approx(0.02)


@pytest.mark.usefixtures("unchecked")
def test_pages_without_what_they_need_are_refused() -> None:
    n = len(TALL.vertices)
    with pytest.raises(InputError, match="no map"):
        write_page(os.devnull, TALL, TALL, {}, title="")
    shown = {"map": ShownMap(np.arange(n))}
    with pytest.raises(InputError, match=r"7 vertices, but it has 642"):
        write_page(
            os.devnull, TALL, TALL, shown, title="", spectra=(random_spectrum(n, 5), random_spectrum(7, 5))
        )
    shown = {"map": ShownMap(np.arange(n), functional_map=np.array([[np.nan]]))}
    with pytest.raises(InputError, match="functional map"):
        write_page(os.devnull, TALL, TALL, shown, title="")


def test_page_of_a_usual_mesh_is_small(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    n = 7000
    mesh = Mesh(generator.normal(size=(n, 3)), generator.integers(0, n, (2 * n, 3)))
    shown = ShownMap(np.arange(n), {"Error": generator.random(n)}, np.eye(100))
    for spectra, limit in ((None, 1.6e6), ((random_spectrum(n, 120), random_spectrum(n, 120)), 3.5e6)):
        write_page(tmp_path / "page.html", mesh, mesh, {"map": shown}, title="t", spectra=spectra)
        assert (tmp_path / "page.html").stat().st_size < limit


def test_large_meshes_get_fewer_eigenvectors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n = len(TALL.vertices)
    spectra = random_spectrum(n, 60), random_spectrum(n, 60)
    for room, eigenvectors in ((10**6, 60), (50 * n, 25), (39 * n, 0)):
        monkeypatch.setattr(page_module, "_VALUES", room)
        write_page(tmp_path / "p", TALL, TALL, {"map": ShownMap(np.arange(n))}, title="", spectra=spectra)
        page = (tmp_path / "p").read_text("utf-8")
        shown = embedded(page)["x"].get("eigenvectors", {"codes": "", "units": ""})
        assert len(decode(shown["units"], "<f4")) == eigenvectors
        assert len(decode(shown["codes"], "i1")) == eigenvectors * n <= room / 2
        assert ('value="wavelets"' in page) == (eigenvectors > 0)
        assert min(eigenvectors_on_page(TALL, TALL), 60) == eigenvectors


def test_same_input_same_page(tmp_path: Path) -> None:
    n = len(TALL.vertices)
    spectra = random_spectrum(n, 30), random_spectrum(n, 30)
    for name in ("a", "b"):
        write_page(tmp_path / name, TALL, TALL, {"map": ShownMap(np.arange(n))}, title="t", spectra=spectra)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_viewer_bundle_is_licensed_and_sealed() -> None:
    assets = ROOT / "jaxsmw" / "report" / "assets"
    viewer, license = (assets / "viewer.js").read_text("utf-8"), (assets / "THREE-LICENSE").read_text("utf-8")
    assert license.strip() in viewer and "MIT" in license
    # Neither may the script end its element early, nor open a comment that hides the end.
    assert "</script" not in viewer.lower() and "<!--" not in viewer
    lock = json.loads((ROOT / "scripts" / "build_viewer" / "package-lock.json").read_text("utf-8"))
    assert all("resolved" not in package for package in lock["packages"].values())


# ---- The page, in a browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A headless Chromium with software rendering."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if not chromium or not driver:
        message = "the page is tested in Chromium: install chromium and chromedriver"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-dev-shm-usage",
        "--disable-sync",
        "--no-first-run",
        f"--user-data-dir={tmp_path_factory.mktemp('chromium')}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=Service(driver))
    yield chrome
    chrome.quit()


class OpenPage:
    """One page in the browser, with a user's eyes and hands."""

    def __init__(self, browser: Any, path: Path, *, width: int = 840, height: int = 600) -> None:
        self.browser, self.path = browser, path
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(path.as_uri())
        self.settle()

    def settle(self) -> None:
        """Wait for what has been asked for to be drawn."""
        self.browser.execute_async_script(
            "const [done] = arguments, next = requestAnimationFrame; next(() => next(() => setTimeout(done, 30)))"
        )

    def find(self, selector: str) -> Any:
        return self.browser.find_element("css selector", selector)

    def run(self, script: str, *arguments: Any) -> Any:
        return self.browser.execute_script(script, *arguments)

    @property
    def state(self) -> dict[str, Any]:
        return self.run("return jaxsmw.state")

    @property
    def readout(self) -> str:
        return self.find("#readout").text

    def view(self, side: str) -> np.ndarray:
        """The pixels of one canvas."""
        self.settle()
        png = self.find(f"#canvas-{side}").screenshot_as_png
        return np.round(255 * imread(io.BytesIO(png))[..., :3]).astype(int)

    def place(self, side: str, vertex: int) -> tuple[int, int]:
        point = self.run("return jaxsmw.project(arguments[0], arguments[1])", side, vertex)
        return round(point["x"]), round(point["y"])

    def mouse(self) -> Any:
        from selenium.webdriver.common.action_chains import ActionChains

        return ActionChains(self.browser, duration=30)

    def look_away(self) -> None:
        """Take the pointer off the bodies."""
        self.point_at(3, 3, click=False)

    def point_at(self, x: int, y: int, *, click: bool) -> None:
        actions = self.mouse()
        actions.w3c_actions.pointer_action.move_to_location(x, y)
        if click:
            actions.w3c_actions.pointer_action.click()
        actions.perform()
        self.settle()

    def drag(self, side: str, across: int) -> None:
        canvas = self.find(f"#canvas-{side}")
        self.mouse().move_to_element(canvas).click_and_hold().move_by_offset(across, 0).release().perform()
        self.settle()

    def choose(self, coloring: str) -> None:
        self.find(f"input[value={coloring}]").click()
        self.settle()


def differ(a: np.ndarray, b: np.ndarray) -> float:
    """The share of pixels that differ visibly."""
    return float(np.mean(np.abs(a - b).max(axis=2) > 8)) if a.shape == b.shape else 1.0


# Lumpy, so that views and vertices are easily told apart.
SOURCE = replace(TALL, vertices=TALL.vertices * (1 + 0.2 * np.sin(4 * TALL.vertices[:, [1]])), name="X.off")
TARGET, NUMBER = renumbered(replace(TALL, name="Y.off"), seed=1)


def visible_vertices() -> np.ndarray:
    """Vertices of the source that face the first camera, the most central first."""
    standing, other = stand_pair(SOURCE, TARGET)
    axes = camera_axes(choose_azimuth([standing, other]))
    facing = standing.vertex_normals @ axes[2]
    off_center = np.linalg.norm(standing.vertices @ axes[:2].T, axis=1)
    order = np.argsort(off_center)
    return order[facing[order] > 0.8]


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Three source vertices share a target vertex; the ones they would have gone to stay alone.
    path = tmp_path_factory.mktemp("page") / "page.html"
    errors = np.linspace(0, 0.2, len(NUMBER))
    errors[visible_vertices()[1]] = np.nan
    named = {"Error": errors, "Expected error": np.linspace(0.2, 0, len(NUMBER))}
    shown = {"map": ShownMap(crowded_map(), named)}
    write_page(path, SOURCE, TARGET, shown, title="Two bodies", statistics={"Mean": "0.1"})
    return path


def crowded_map() -> np.ndarray:
    crowded = NUMBER.copy()
    seen = visible_vertices()
    crowded[seen[[5, 6]]] = NUMBER[seen[0]]
    return crowded


@pytest.fixture
def page(browser: Any, page_file: Path) -> Iterator[OpenPage]:
    browser.get_log("browser")
    yield OpenPage(browser, page_file)
    assert browser.get_log("browser") == []


def test_page_draws_both_bodies(page: OpenPage) -> None:
    assert page.browser.title == page.find("h1").text == "Two bodies"
    assert page.state == {
        "source": [], "target": [], "pinned": False, "coloring": "transfer", "map": "map", "filter": 0, "entry": None,
    }  # fmt: skip
    for side in "xy":
        view = page.view(side)
        assert min(view.shape[:2]) > 300
        saturated = np.ptp(view, axis=2) > 40
        assert 0.1 < saturated.mean() < 0.7
        assert len(np.unique(view[saturated] // 32, axis=0)) > 20
        # The body stands free in its frame.
        assert not saturated[[0, -1]].any() and not saturated[:, [0, -1]].any()
    assert page.find("dt").text == "Mean" and page.find("dd").text == "0.1"


def test_clicks_on_the_source(page: OpenPage) -> None:
    before = {side: page.view(side) for side in "xy"}
    for vertex in visible_vertices()[[0, 1, 9, 16]].tolist():
        page.point_at(*page.place("x", vertex), click=True)
        target = int(crowded_map()[vertex])
        assert page.state["source"] == [vertex] and page.state["target"] == [target]
        assert page.readout.startswith(f"Source vertex {vertex} → target vertex {target} · error")
        assert ("error not known" in page.readout) == (vertex == visible_vertices()[1])
        assert f" · expected error {0.2 * (1 - vertex / (len(NUMBER) - 1)):.4f}" in page.readout
    # The mark is seen where the map says.
    x, y = page.place("y", target)
    box = page.find("#canvas-y").rect
    mark = page.view("y")[int(y - box["y"]), int(x - box["x"])]
    assert mark.min() > 240
    assert 0 < differ(before["x"], page.view("x")) < 0.01
    assert 0 < differ(before["y"], page.view("y")) < 0.01


def test_clicks_on_the_target_show_where_it_comes_from(page: OpenPage) -> None:
    seen = visible_vertices()
    crowded, deserted, ordinary = NUMBER[seen[[0, 5, 9]]].tolist()
    for vertex, text in (
        (crowded, "3 source vertices: "),
        (deserted, "no source vertex"),
        (ordinary, f"source vertex {seen[9]}"),
    ):
        page.point_at(*page.place("y", vertex), click=True)
        assert page.state["target"] == [vertex]
        assert page.state["source"] == np.flatnonzero(crowded_map() == vertex).tolist()
        assert page.readout.startswith(f"Target vertex {vertex} ← {text}")


def test_pointing_marks_until_a_click_pins(page: OpenPage) -> None:
    first, second = visible_vertices()[[3, 16]].tolist()
    page.point_at(*page.place("x", first), click=False)
    assert page.state["source"] == [first] and not page.state["pinned"]
    page.point_at(*page.place("x", second), click=False)
    assert page.state["source"] == [second]
    page.look_away()
    assert page.state["source"] == [] and page.readout.startswith("Point at the source")
    page.point_at(*page.place("x", first), click=True)
    page.point_at(*page.place("x", second), click=False)
    assert page.state["source"] == [first] and page.state["pinned"]
    # Beside the body: let go.
    box = page.find("#canvas-x").rect
    page.point_at(int(box["x"]) + 8, int(box["y"] + box["height"]) - 8, click=True)
    assert page.state["source"] == [] and not page.state["pinned"]


def test_colorings(page: OpenPage) -> None:
    transfer = {side: page.view(side) for side in "xy"}
    assert not page.find(".scale").is_displayed()
    page.choose("error-0")
    error = {side: page.view(side) for side in "xy"}
    assert page.state["coloring"] == "error-0" and page.find(".scale").is_displayed()
    # Linear interpolation on another grid: one step of the scale apart at most.
    values = np.linspace(0, 0.2, len(NUMBER))
    values[visible_vertices()[1]] = np.nan
    shown = np.reshape(page.run("return jaxsmw.colors('x')"), (-1, 3))
    limit = embedded((page.path).read_text("utf-8"))["limit"]
    assert np.abs(shown - 255 * colors.error_colors(values, limit)).max() < 4
    page.choose("error-1")
    assert page.find(".scale").is_displayed() and differ(error["x"], page.view("x")) > 0.1
    page.choose("plain")
    plain = {side: page.view(side) for side in "xy"}
    for side in "xy":
        assert differ(transfer[side], plain[side]) > 0.1
        assert np.ptp(plain[side], axis=2).max() < 30
    assert differ(error["x"], plain["x"]) > 0.1 and differ(error["y"], plain["y"]) == 0
    page.choose("transfer")
    assert all(differ(page.view(side), transfer[side]) == 0 for side in "xy")


def test_cameras_turn_together_or_alone(page: OpenPage) -> None:
    start = {side: page.view(side) for side in "xy"}
    page.drag("x", 90)
    page.look_away()
    turned = {side: page.view(side) for side in "xy"}
    assert all(differ(start[side], turned[side]) > 0.05 for side in "xy")
    page.find("#linked").click()
    page.drag("y", 90)
    page.look_away()
    assert differ(turned["x"], page.view("x")) == 0
    assert differ(turned["y"], page.view("y")) > 0.05
    # Dragging turns; it marks nothing.
    assert not page.state["pinned"]
    page.find("#reset").click()
    assert all(differ(page.view(side), start[side]) == 0 for side in "xy")


def test_keyboard(page: OpenPage) -> None:
    from selenium.webdriver.common.keys import Keys

    start = page.view("x")
    canvas = page.find("#canvas-x")
    seen = [start]
    for key in (Keys.ARROW_RIGHT, Keys.ARROW_UP, "+", "-"):
        canvas.send_keys(key)
        seen.append(page.view("x"))
        assert differ(seen[-2], seen[-1]) > 0.01
    canvas.send_keys("0")
    # But for the frame that tells where the keys go.
    assert differ(start[20:-20, 20:-20], page.view("x")[20:-20, 20:-20]) == 0
    field = page.find("#vertex")
    field.send_keys("17", Keys.ENTER)
    assert page.state["source"] == [17] and page.state["target"] == [int(crowded_map()[17])]
    field.clear()
    field.send_keys("9999", Keys.TAB)
    assert page.state["source"] == []
    page.run("jaxsmw.pick(17)")
    assert page.state["pinned"] and field.get_property("value") == "17"
    canvas.send_keys(Keys.ESCAPE)
    assert page.state["source"] == [] and field.get_property("value") == ""


def test_touch(page: OpenPage) -> None:
    vertex = int(visible_vertices()[2])
    x, y = page.place("x", vertex)
    touch = {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]}
    page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", touch)
    page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.settle()
    assert page.state["source"] == [vertex] and page.state["pinned"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_small_screens_and_both_schemes(browser: Any, page_file: Path, scheme: str) -> None:
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    page = OpenPage(browser, page_file, width=375, height=667)
    assert page.run("return document.documentElement.scrollWidth") <= 375
    for side in "xy":
        box = page.find(f"#canvas-{side}").rect
        assert box["x"] >= 0 and box["x"] + box["width"] <= 375 and box["width"] > 120
        corner = page.view(side)[-20, 20]
        assert corner.min() > 200 if scheme == "light" else corner.max() < 60
    ink = page.run("return getComputedStyle(document.body).color")
    background = page.run("return getComputedStyle(document.body).backgroundColor")
    brightness = [sum(map(int, re.findall(r"\d+", color)[:3])) for color in (ink, background)]
    assert (brightness[0] < brightness[1]) == (scheme == "light")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_hostile_texts_are_only_texts(browser: Any, tmp_path: Path) -> None:
    from matplotlib.image import imsave

    png = io.BytesIO()
    imsave(png, np.zeros((4, 6)), format="png")
    body = replace(TALL, name=HOSTILE.replace("/", "\\") + "\udcff")
    write_page(
        tmp_path / "page.html",
        body,
        body,
        {HOSTILE: ShownMap(np.arange(len(body.vertices)), statistics={HOSTILE: HOSTILE})},
        title=HOSTILE,
        statistics={HOSTILE: HOSTILE},
        figures=[(HOSTILE, png.getvalue())],
    )
    browser.get_log("browser")
    page = OpenPage(browser, tmp_path / "page.html")
    assert browser.title == page.find("h1").text == page.find("dd").text == HOSTILE
    assert page.find(".figures img").get_attribute("alt") == page.find(".figures figcaption").text == HOSTILE
    assert page.run("return document.querySelector('.figures img').naturalWidth") == 6
    assert page.run("return [window.hacked, document.images.length]") == [None, 1]
    assert page.find(".body span").text.startswith("<\\script><\\title><img src=x onerror=")
    assert page.find("tbody th").text == page.find("tbody td").text == HOSTILE
    assert not browser.find_elements("css selector", "input[value^=error]")
    assert browser.get_log("browser") == []
    # Were a text to get through after all, the page still runs no script but its own.
    page.run("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hacked=1\">')")
    page.settle()
    assert page.run("return window.hacked") is None
    browser.get_log("browser")


# ---- Wavelets, functional maps and several maps, in a browser

EIGENVECTORS, FILTERS = 40, 5


@pytest.fixture(scope="module")
def spectra() -> tuple[Spectrum, Spectrum]:
    return compute_spectrum(SOURCE, EIGENVECTORS), compute_spectrum(TARGET, EIGENVECTORS)


def two_maps() -> dict[str, np.ndarray]:
    return {"good": NUMBER, "bad": np.random.default_rng(5).permutation(NUMBER)}


@pytest.fixture(scope="module")
def comparison_file(tmp_path_factory: pytest.TempPathFactory, spectra: tuple[Spectrum, Spectrum]) -> Path:
    path = tmp_path_factory.mktemp("comparison") / "page.html"
    shown = {
        name: ShownMap(
            pointwise_map,
            {name: np.linspace(0.01, 0.02, len(NUMBER)) * (1 if name == "good" else 9)},
            encode(jnp.asarray(pointwise_map), *spectra),
            statistics={"mean": f"{0.1 * len(name):.2f}"},
        )
        for name, pointwise_map in two_maps().items()
    }
    refiner = WaveletPreservation(Meyer(FILTERS))
    write_page(path, SOURCE, TARGET, shown, title="Two maps", spectra=spectra, refiner=refiner)
    return path


@pytest.fixture
def comparison(browser: Any, comparison_file: Path) -> Iterator[OpenPage]:
    browser.get_log("browser")
    yield OpenPage(browser, comparison_file, width=1280, height=800)
    assert browser.get_log("browser") == []


def rounding(values: np.ndarray) -> np.ndarray:
    """How far eigenvectors (n, k) may be from those on the page: by half a level, whose width varies."""
    largest, half = np.abs(values).max(axis=0), 0.5 / 127
    return largest * (2 * half * np.sqrt(np.abs(values) / largest) + half**2) + 1e-6 * largest


def wavelets(spectrum: Spectrum, vertex: int) -> tuple[np.ndarray, np.ndarray]:
    """The wavelets around a vertex at all scales (filters, n), and how far those on the page may be off."""
    responses = np.asarray(Meyer(FILTERS)(spectrum.eigenvalues, spectrum.eigenvalues))
    values = np.asarray(spectrum.eigenvectors)
    off = rounding(values)
    coefficients = responses * values[vertex]
    bound = np.abs(responses * off[vertex]) @ (np.abs(values) + off).T + np.abs(coefficients) @ off.T
    return coefficients @ values.T, bound + 1e-4


def test_wavelets_on_both_bodies(comparison: OpenPage, spectra: tuple[Spectrum, Spectrum]) -> None:
    from selenium.webdriver.common.keys import Keys

    comparison.choose("wavelets")
    assert comparison.run("return jaxsmw.functions") == {"x": None, "y": None}
    assert comparison.readout.startswith("Point at a body to see the wavelets")
    first, second = visible_vertices()[[0, 9]].tolist()
    slider = comparison.find("#filter")
    assert (
        slider.get_attribute("aria-valuetext") == comparison.find("#filter-name").text == "scaling function"
    )
    comparison.point_at(*comparison.place("x", first), click=False)
    assert comparison.state["source"] == [first]
    comparison.point_at(*comparison.place("x", second), click=True)
    expected = {
        "x": wavelets(spectra[0], second),
        "y": wavelets(spectra[1], int(NUMBER[second])),
    }
    views = []
    for scale in range(FILTERS):
        shown = comparison.run("return jaxsmw.functions")
        limit = np.quantile(np.abs(np.concatenate([shown["x"], shown["y"]])), 0.98)
        for side in "xy":
            exact, bound = (array[scale] for array in expected[side])
            error = np.abs(np.array(shown[side]) - exact)
            assert np.all(error <= bound)
            # What the eye sees: less than a twentieth of the scale anywhere, a hundredth as a rule.
            assert error.max() < 0.05 * limit and np.sqrt(np.mean(error**2)) < 0.01 * limit
            color = np.reshape(comparison.run("return jaxsmw.colors(arguments[0])", side), (-1, 3))
            expected_color = 255 * colors.signed_colors(np.array(shown[side]), limit)
            assert np.abs(color - expected_color).max() < 6
        ends = [comparison.find(f"#signed-{end}").text for end in ("low", "high")]
        assert [float(end.translate({0x2212: "-"})[2:]) for end in ends] == pytest.approx(
            [-limit, limit], rel=0.05
        )
        x, carried = np.array(shown["x"]), np.array(shown["y"])[NUMBER]
        areas = np.asarray(spectra[0].vertex_areas)
        cosine = areas @ (x * carried) / np.sqrt((areas @ x**2) * (areas @ carried**2))
        told = re.search(r"wavelets alike: cosine (\S+)", comparison.readout)
        assert told and float(told[1]) == pytest.approx(cosine, abs=2e-3)
        views.append(comparison.view("x"))
        slider.send_keys(Keys.ARROW_RIGHT)
        comparison.settle()
    assert comparison.state["filter"] == FILTERS - 1
    assert comparison.find("#filter-name").text == f"wavelet {FILTERS - 1} of {FILTERS - 1} (finest)"
    assert all(differ(a, b) > 0.02 for a, b in pairwise(views))
    # The other way round: the wavelet on the source is around what the map takes to the target's vertex.
    target = int(NUMBER[first])
    comparison.point_at(*comparison.place("y", target), click=True)
    exact, bound = wavelets(spectra[0], first)
    assert np.all(np.abs(comparison.run("return jaxsmw.functions")["x"] - exact[-1]) <= bound[-1])


def test_real_wavelets_look_the_same_on_the_page(shared: Path) -> None:
    """Limbs are what makes rounding hard: eigenvectors that are large on a finger and small elsewhere."""
    spectrum = compute_spectrum(read_mesh(shared / "data/faust_r/off/tr_reg_062.off"), 100)
    values = np.asarray(spectrum.eigenvectors)
    shown = page_module._encode_rounded(values.T)
    codes = decode(shown["codes"], "i1").reshape(values.T.shape).astype(float)
    rounded = (np.sign(codes) * codes**2 * decode(shown["units"], "<f4")[:, None]).T
    assert np.all(np.abs(rounded - values) <= rounding(values))
    responses = np.asarray(Meyer()(spectrum.eigenvalues, spectrum.eigenvalues))
    for vertex in range(0, len(values), 500):
        for response in responses:
            exact, found = (v @ (response * v[vertex]) for v in (values, rounded))
            limit = np.quantile(np.abs(exact), 0.98)
            error = np.abs(np.clip(exact, -limit, limit) - np.clip(found, -limit, limit)) / limit
            assert np.sqrt(np.mean(error**2)) < 0.02 and np.mean(error > 0.05) < 0.02


def matrix_colors(page: OpenPage) -> np.ndarray:
    pixels = page.run(
        "const m = document.querySelector('#matrix'), copy = document.createElement('canvas');"
        "Object.assign(copy, { width: m.width, height: m.height });"
        "const context = copy.getContext('2d', { willReadFrequently: true });"
        "context.drawImage(m, 0, 0);"
        "return [m.height, m.width, Array.from(context.getImageData(0, 0, m.width, m.height).data)]"
    )
    return np.reshape(pixels[2], (*pixels[:2], 4))[..., :3]


def test_the_functional_map_and_its_eigenfunctions(
    comparison: OpenPage, spectra: tuple[Spectrum, Spectrum]
) -> None:
    from selenium.webdriver.common.keys import Keys

    matrices = {name: np.asarray(encode(jnp.asarray(of), *spectra)) for name, of in two_maps().items()}
    limit = max(np.abs(matrix).max() for matrix in matrices.values())
    expected = 255 * colors.signed_colors(matrices["good"].ravel(), limit).reshape(
        EIGENVECTORS, EIGENVECTORS, 3
    )
    assert np.abs(matrix_colors(comparison) - expected).max() < 4
    before = comparison.view("x")
    canvas = comparison.find("#matrix")
    comparison.run("arguments[0].scrollIntoView()", canvas)
    box = comparison.run(
        "const {left, top, width} = arguments[0].getBoundingClientRect(); return [left, top, width]", canvas
    )
    row, column = 7, 12
    place = [round(box[i] + (index + 0.5) * box[2] / EIGENVECTORS) for i, index in enumerate((column, row))]

    def check(row: int, column: int) -> None:
        value = f"{matrices['good'][row, column]:.3f}".replace("-", "−")
        text = comparison.find("#entry").text
        assert (
            text == f"C({row}, {column}) = {value}: eigenfunction {row} of the source, {column} of the target"
        )
        functions = comparison.run("return jaxsmw.functions")
        for side, spectrum, index in zip("xy", spectra, (row, column), strict=True):
            values = np.asarray(spectrum.eigenvectors)
            assert np.all(np.abs(functions[side] - values[:, index]) <= rounding(values)[:, index])

    comparison.point_at(*place, click=False)
    check(row, column)
    assert comparison.state["entry"] is None and comparison.find("#ring").is_displayed()
    comparison.look_away()
    assert comparison.run("return jaxsmw.functions") == {"x": None, "y": None}
    assert not comparison.find("#ring").is_displayed()
    comparison.point_at(*place, click=True)
    comparison.look_away()
    assert comparison.state["entry"] == [row, column]
    check(row, column)
    canvas.send_keys(Keys.ARROW_DOWN, Keys.SHIFT, Keys.ARROW_RIGHT)
    check(row + 1, column + 10)
    comparison.choose("transfer")
    assert comparison.state["entry"] is None
    comparison.run("scrollTo(0, 0)")
    assert differ(comparison.view("x"), before) == 0


def test_the_functional_map_on_a_dark_page(browser: Any, comparison_file: Path) -> None:
    def emulate(*features: dict[str, str]) -> None:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": list(features)})

    page = OpenPage(browser, comparison_file)
    light = matrix_colors(page)
    emulate({"name": "prefers-color-scheme", "value": "dark"})
    page.settle()
    dark = matrix_colors(page)
    assert np.median(light) > 220 and np.median(dark) < 60
    emulate()


def test_switching_between_maps(comparison: OpenPage) -> None:
    vertex = int(visible_vertices()[4])
    comparison.run("jaxsmw.pick(arguments[0])", vertex)
    maps = two_maps()

    def check(name: str, scale: int) -> None:
        target = int(maps[name][vertex])
        assert comparison.state["map"] == name and comparison.state["target"] == [target]
        error = scale * np.linspace(0.01, 0.02, len(NUMBER))[vertex]
        assert comparison.readout == f"Source vertex {vertex} → target vertex {target} · {name} {error:.4f}"
        current = comparison.find("[aria-current=true]").text
        assert current.split() == [name, f"{0.1 * len(name):.2f}"]
        shown = np.reshape(comparison.run("return jaxsmw.colors('x')"), (-1, 3))
        target_colors = np.reshape(comparison.run("return jaxsmw.colors('y')"), (-1, 3))
        assert np.array_equal(shown, target_colors[maps[name]])

    check("good", 1)
    good, picture = matrix_colors(comparison), comparison.view("x")
    comparison.find("input[name=map][value='1']").click()
    check("bad", 9)
    assert np.abs(matrix_colors(comparison) - good).max() > 50
    assert differ(picture, comparison.view("x")) > 0.1
    # What is not known of a map cannot be chosen, and does not stay chosen.
    assert [comparison.find(f"input[value=error-{i}]").is_enabled() for i in (0, 1)] == [False, True]
    comparison.choose("error-1")
    comparison.find("input[name=map][value='0']").click()
    assert (
        comparison.state["coloring"] == "transfer" and comparison.find("input[value=transfer]").is_selected()
    )
    check("good", 1)
    # The wavelets follow, too.
    comparison.choose("wavelets")
    alike = []
    for position in (0, 1):
        comparison.find(f"input[name=map][value='{position}']").click()
        found = re.search(r"cosine (\S+)", comparison.readout)
        assert found
        alike.append(float(found[1]))
    assert alike[0] > alike[1] + 0.2


def test_maps_of_different_sizes_and_without_functional_map(browser: Any, tmp_path: Path) -> None:
    n = len(NUMBER)
    errors = {"Error": np.where(np.arange(n) == 3, np.inf, 0.01)}
    large = ShownMap(NUMBER, errors, np.diag(np.arange(1.0, 7)))
    shown = {"large": large, "small": replace(large, functional_map=np.eye(2)), "none": ShownMap(NUMBER)}
    write_page(tmp_path / "page.html", SOURCE, TARGET, shown, title="Sizes")
    browser.get_log("browser")
    page = OpenPage(browser, tmp_path / "page.html")
    page.run("jaxsmw.pick(3)")
    assert page.readout.endswith("error without end (on another component)")
    from selenium.webdriver.common.keys import Keys

    page.find("#matrix").send_keys(Keys.ARROW_DOWN, Keys.SHIFT, Keys.ARROW_DOWN, Keys.ARROW_RIGHT)
    # The page has no eigenvectors to show.
    entry = (
        "C(5, 5) = 6.000: eigenfunction 5 of the source, 5 of the target (not among those this page holds)"
    )
    assert page.find("#entry").text == entry
    assert page.run("return jaxsmw.functions") == {"x": None, "y": None}
    page.find("input[name=map][value='1']").click()
    assert page.find("#entry").text.startswith("Point at") and matrix_colors(page).shape == (2, 2, 3)
    page.find("input[name=map][value='2']").click()
    assert not page.find("#functional").is_displayed()
    page.find("input[name=map][value='0']").click()
    assert page.find("#entry").text == entry and page.find("#functional").is_displayed()
    assert browser.get_log("browser") == []


def test_every_control_is_reached_and_worked_by_keys(comparison: OpenPage) -> None:
    from selenium.webdriver.common.keys import Keys

    comparison.choose("wavelets")
    comparison.find("h1").click()
    comparison.run("getSelection().setPosition(document.body, 0)")
    reached: list[str] = []
    for _ in range(12):
        comparison.mouse().send_keys(Keys.TAB).perform()
        name, outline = comparison.run(
            "const e = document.activeElement, shown = e.type === 'radio' ? e.parentElement : e;"
            "return [e.id || e.name || e.className || e.tagName, getComputedStyle(shown).outlineStyle]"
        )
        if name == "BODY" or name in reached:
            break
        assert outline not in ("none", ""), f"{name} does not show that it has the focus"
        reached.append(name)
    assert reached == [
        "map", "coloring", "filter", "linked", "reset", "vertex", "canvas-x", "canvas-y", "matrix", "table",
    ]  # fmt: skip
    for selector, keys, key, value in (
        ("input[name=map]", Keys.ARROW_RIGHT, "map", "bad"),
        ("input[name=coloring]:checked", Keys.ARROW_LEFT, "coloring", "error-1"),
        ("#vertex", "3" + Keys.ENTER, "source", [3]),
        ("#matrix", Keys.ARROW_RIGHT, "entry", [0, 0]),
        ("#matrix", Keys.ARROW_RIGHT + Keys.ARROW_DOWN, "entry", [1, 1]),
        ("#matrix", Keys.ESCAPE, "entry", None),
        ("#canvas-y", Keys.ESCAPE, "source", []),
    ):
        comparison.find(selector).send_keys(keys)
        assert comparison.state[key] == value
    comparison.find("#linked").send_keys(Keys.SPACE)
    assert not comparison.find("#linked").is_selected()
    unnamed = comparison.run(
        "return [...document.querySelectorAll('input, button, canvas')].filter("
        "e => !(e.ariaLabel || e.textContent || e.labels?.[0]?.textContent.trim())).length"
    )
    assert unnamed == 0


@pytest.mark.parametrize("coloring", ["transfer", "wavelets"])
def test_a_phone_of_360_pixels(browser: Any, comparison_file: Path, coloring: str) -> None:
    feature = {"name": "prefers-reduced-motion", "value": "reduce"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    browser.get_log("browser")
    page = OpenPage(browser, comparison_file, width=360, height=740)
    page.choose(coloring)
    assert page.run("return document.documentElement.scrollWidth") <= 360
    for element in browser.find_elements(
        "css selector", ".choice label, .view *, .filter *, canvas, .scale, #entry"
    ):
        if element.is_displayed():
            box = element.rect
            assert box["x"] >= 0 and box["x"] + box["width"] <= 360, element.get_attribute("outerHTML")
    for element in browser.find_elements("css selector", ".choice label, .view label, .view button"):
        assert element.rect["height"] >= 32
    # Both bodies are seen at once, and their vertices can be touched.
    boxes = [page.find(f"#canvas-{side}").rect for side in "xy"]
    assert max(box["y"] + box["height"] for box in boxes) - min(box["y"] for box in boxes) < 740
    page.run("document.querySelector('.bodies').scrollIntoView()")
    vertex = int(visible_vertices()[0])
    page.point_at(*page.place("x", vertex), click=True)
    assert page.state["source"] == [vertex] and page.state["target"] == [int(NUMBER[vertex])]
    # Nothing moves by itself.
    assert page.run("return document.getAnimations().length") == 0
    assert browser.get_log("browser") == []
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
