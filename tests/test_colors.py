"""Colours show positions, errors and signs, and depend on nothing else."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from report_helpers import TALL, renumbered
from synthetic import grid_mesh

from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report import colors
from jaxsmw.report.standing import stand


def test_oklab_matches_published_values() -> None:
    # CSS Color Module Level 4 publishes these OKLab values for white, red and blue in sRGB.
    lab = np.array([[1, 0, 0], [0.627955, 0.224863, 0.125846], [0.452014, -0.032457, -0.311528]])
    assert np.allclose(colors._oklab_to_srgb(lab), [[1, 1, 1], [1, 0, 0], [0, 0, 1]], atol=2e-3)


@given(st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_srgb_round_trip(color: list[float]) -> None:
    assert np.allclose(colors.linear_to_srgb(colors.srgb_to_linear(np.array(color))), color, atol=1e-5)


def test_position_colors_vary_smoothly_and_differ_between_opposite_ends() -> None:
    mesh = stand(TALL)
    color = colors.position_colors(mesh)
    assert color.min() >= 0 and color.max() <= 1
    edges = mesh.edges
    assert np.abs(color[edges[:, 0]] - color[edges[:, 1]]).max() < 0.2
    # The colours of the two ends of the body differ more along the first two axes than along the third axis.
    ends = [(mesh.vertices[:, axis].argmin(), mesh.vertices[:, axis].argmax()) for axis in range(3)]
    difference = [np.abs(color[low] - color[high]).max() for low, high in ends]
    assert min(difference) > 0.15 and min(difference[:2]) > 0.4


def test_position_colors_do_not_depend_on_vertex_numbers_or_units() -> None:
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


def test_unreferenced_vertices_do_not_change_the_colors_of_others() -> None:
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


def test_signed_colors_are_blue_below_zero_and_red_above() -> None:
    values = np.array([-2, -1, -0.5, 0, 0.5, 1, 2])
    for on_dark in (False, True):
        color = colors.signed_colors(values, 1.0, on_dark=on_dark)
        assert np.array_equal(color[[0, -1]], color[[1, -2]])
        assert np.ptp(color[3]) < 0.03 and np.all(color[:3, 2] > color[:3, 0] + 0.2)
        assert np.all(color[4:, 0] > color[4:, 2] + 0.2)
        luminance = colors.srgb_to_linear(color) @ [0.2126, 0.7152, 0.0722]
        # The contrast with the background grows with the absolute value.
        assert np.all(np.diff(luminance[3:6]) * (1 if on_dark else -1) > 0.05)
        assert np.all(np.diff(luminance[1:4]) * (-1 if on_dark else 1) > 0.05)
