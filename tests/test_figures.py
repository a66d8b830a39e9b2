"""Figures have the right contents, are saved to files, and refuse bad input."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.image import imread
from report_helpers import TALL, renumbered, uniform
from synthetic import bumpy_mesh

from jaxsmw.errors import InputError
from jaxsmw.report import figures
from jaxsmw.report.figures import (
    draw_correspondence,
    draw_filters,
    draw_functional_map,
    draw_functions,
    draw_intervals,
    draw_mesh,
    draw_quality_curves,
    save_figure,
)
from jaxsmw.report.page import ShownMap, write_page
from jaxsmw.wording import short_names

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws bodies smaller than usual, to save time."""
    monkeypatch.setattr(figures, "_BODY_SIZE", (300, 300))


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws bodies so small that only the texts of a figure are of use."""
    monkeypatch.setattr(figures, "_BODY_SIZE", (60, 60))


def pixels(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def panels(figure: Any) -> dict[str, np.ndarray]:
    """Return a dictionary from axis labels to the images of the bodies in a figure."""
    return {axes.get_label(): np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images}


@pytest.mark.usefixtures("small")
def test_points_without_a_counterpart_are_grey() -> None:
    n = len(TALL.vertices)
    masks = np.zeros(n, bool), np.ones(n, bool)
    shown = panels(draw_correspondence(TALL, TALL, np.arange(n), overlap=masks))
    source, target = (panel[panel[..., 3] == 255][:, :3].astype(int) for panel in shown.values())
    assert np.ptp(source, axis=1).max() < 20 and np.ptp(target, axis=1).max() > 100


@pytest.mark.usefixtures("small")
def test_correspondence_transfers_colors() -> None:
    other, number = renumbered(replace(TALL, name="other"))
    figure = draw_correspondence(TALL, other, number)
    shown = panels(figure)
    assert list(shown) == ["Source", "Target"]
    # With the ground truth, the pictures of source and target are equal.
    assert np.abs(shown["Source"].astype(int) - shown["Target"]).max() <= 1
    wrong = panels(draw_correspondence(TALL, other, np.roll(number, 1)))
    assert np.array_equal(wrong["Target"], shown["Target"])
    assert np.abs(wrong["Source"].astype(int) - shown["Source"]).max() > 50
    covered = np.mean(shown["Source"][..., 3] == 255)
    assert 0.15 < covered < 0.5
    # The figure contains the rendered picture without resampling.
    image = pixels(figure)
    target = shown["Target"]
    inside = target[..., 3] == 255
    place = figure.axes[1].get_position()
    left, top = round(place.x0 * image.shape[1]), round((1 - place.y1) * image.shape[0])
    window = image[top : top + target.shape[0], left : left + target.shape[1]]
    assert np.array_equal(window[inside], target[..., :3][inside])


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_correspondence_shows_errors_on_the_source() -> None:
    n = len(TALL.vertices)
    errors = np.where(TALL.vertices[:, 1] > 0, 0.3, 0.0)
    errors[0] = np.nan
    figure = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": errors})
    image = panels(figure)["Error on the source"].astype(int)
    height = image.shape[0]
    upper, lower = image[height // 4], image[3 * height // 4]
    upper, lower = upper[upper[:, 3] == 255], lower[lower[:, 3] == 255]
    assert upper[:, 1].max() < lower[:, 1].min()
    assert np.array_equal(image[..., 3] == 255, panels(figure)["Source"][..., 3] == 255)
    wider = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": errors}, error_limit=1.0)
    assert np.abs(panels(wider)["Error on the source"].astype(int) - image).max() > 50
    silent = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": np.full(n, np.nan)})
    assert len(panels(silent)) == 3
    both = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": errors, "Other": 2 * errors})
    assert list(panels(both))[2:] == ["Error on the source", "Other on the source"]


def error_scale(figure: Any) -> Any:
    return next(axes for axes in figure.axes if axes.get_label() == "error scale")


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_the_scale_of_errors_is_the_same_for_all_maps() -> None:
    n = len(TALL.vertices)
    shown = {}
    for size in (0.001, 0.1, 0.7):
        figure = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": np.linspace(0, size, n)})
        assert error_scale(figure).get_ylim() == pytest.approx((0, 0.1))
        labels = [text.get_text() for text in error_scale(figure).get_yticklabels()]
        assert labels[0] == "0" and labels[-1] == "0.1 and\nabove"
        image = panels(figure)["Error on the source"]
        shown[size] = image[image[..., 3] == 255].mean()
    # Smaller errors have lighter colours.
    assert shown[0.001] > 1.1 * shown[0.1] > 1.1 * shown[0.7]
    wider = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": np.ones(n)}, error_limit=0.25)
    assert error_scale(wider).get_ylim() == pytest.approx((0, 0.25))


@pytest.mark.usefixtures("small")
def test_the_color_of_unknown_errors_is_explained() -> None:
    n = len(TALL.vertices)
    known = np.zeros(n)
    unknown = np.where(np.arange(n) == 3, np.nan, known)
    for errors, texts in ((known, []), (unknown, ["unknown"])):
        figure = draw_correspondence(TALL, TALL, np.arange(n), errors={"Error": errors})
        assert [text.get_text() for legend in figure.legends for text in legend.get_texts()] == texts
        pixels(figure)
        for part in (*figure.legends, *error_scale(figure).get_yticklabels()):
            assert part.get_window_extent().x1 <= figure.bbox.x1


@pytest.mark.usefixtures("small")
def test_view_options_change_the_picture() -> None:
    # This body has a pointed end, so all views of it differ.
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
def test_functional_map_figure_shows_the_matrix_with_axis_labels() -> None:
    matrix = np.diag([1.0, -2.0, 0.5]) @ np.eye(3, 5)
    figure = draw_functional_map(matrix)
    axes = figure.axes[0]
    assert np.array_equal(axes.images[0].get_array(), matrix)
    assert axes.images[0].get_clim() == (-2, 2)
    labels = "eigenfunction of X (source)", "eigenfunction of Y (target)"
    assert (axes.get_ylabel(), axes.get_xlabel()) == labels
    pushed = draw_functional_map(matrix, convention="pushforward").axes[0]
    assert (pushed.get_ylabel(), pushed.get_xlabel()) == labels[::-1]
    # Zero is white. The largest entries are clearly red and blue.
    middle = axes.images[0].to_rgba(matrix)[..., :3]
    assert middle[0, 4].min() > 0.95
    assert middle[1, 1, 2] > middle[1, 1, 0] + 0.2 and middle[0, 0, 0] > middle[0, 0, 2] + 0.2
    assert np.ptp(pixels(figure)) > 200
    draw_functional_map(np.zeros((2, 2)))
    for bad in (np.ones(3), np.array([[np.nan]]), np.zeros((0, 3))):
        with pytest.raises(InputError, match="functional map"):
            draw_functional_map(bad)


@pytest.mark.usefixtures("unchecked")
def test_filter_figure_shows_responses_frame_function_and_eigenvalues() -> None:
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
    with pytest.raises(InputError, match=r"must have shape \(filters, p\)"):
        draw_filters(grid, responses.T, eigenvalues)


@pytest.mark.usefixtures("unchecked")
def test_quality_curves_are_distinguishable_and_in_the_legend() -> None:
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
    # The whole legend is inside the figure, next to the curves.
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
def test_figures_are_saved_reproducibly_or_not_at_all(tmp_path: Path) -> None:
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
    with pytest.raises(InputError, match="nowhere does not exist: create the directory"):
        save_figure(tmp_path / "nowhere" / "c.png", figure)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("small")
def test_hostile_names_are_drawn_as_plain_text() -> None:
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


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (("a/mesh.off", "b/mesh.off"), ("a/mesh.off", "b/mesh.off")),
        (("/data/s1/left/mesh.off", "/data/s2/left/mesh.off"), ("s1/left/mesh.off", "s2/left/mesh.off")),
        (("/data/mesh.off", "mesh.off"), ("data/mesh.off", "mesh.off")),
        (("a/mesh.off", "a/mesh.off"), ("mesh.off", "mesh.off")),
        (("a/x.off", "b/y.off"), ("x.off", "y.off")),
        (("", "mesh"), ("", "mesh")),
    ],
)
def test_short_names_tell_files_of_one_name_apart(names: tuple[str, str], shown: tuple[str, str]) -> None:
    assert tuple(short_names(names)) == shown


@pytest.mark.usefixtures("tiny")
def test_titles_are_short_names() -> None:
    names = "/data/s1/left/mesh.off", "/data/s2/left/mesh.off"
    shown = short_names(names)
    bodies = [replace(TALL, name=name) for name in names]
    identity = np.arange(len(TALL.vertices))
    figure = draw_correspondence(*bodies, identity, errors={"Error": np.zeros(len(identity))})
    captions = [text.get_text() for text in figure.texts[1::2]]
    assert captions == [f"{name}\n642 vertices" for name in (*shown, shown[0])]


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("difference", [0, 119])
def test_long_titles_tell_files_apart(difference: int) -> None:
    names = ["".join("ab"[side] if i == difference else "x" for i in range(120)) + ".off" for side in (0, 1)]
    for folder in ("", "folder/"):
        bodies = [replace(TALL, name=folder + name) for name in names]
        figure = draw_correspondence(*bodies, np.arange(len(TALL.vertices)))
        shown = [figure.texts[i].get_text().split("\n")[0] for i in (1, 3)]
        assert shown[0] != shown[1] and max(map(len, shown)) <= 36


def test_without_matplotlib_only_figures_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(InputError, match=r"pip install 'jaxsmw\[report\]'"):
        draw_functional_map(np.eye(3))
    shown = ShownMap(np.arange(len(TALL.vertices)))
    write_page(tmp_path / "page.html", TALL, TALL, {"map": shown}, title="no figures needed")


@pytest.mark.slow
def test_matplotlib_is_imported_on_first_use_and_without_pyplot() -> None:
    script = (
        "import sys, jaxsmw.report.page, jaxsmw.report.figures as f; assert 'matplotlib' not in sys.modules; "
        "f.draw_functional_map([[1.0]]); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


def test_interval_figure_shows_every_estimate() -> None:
    figure = draw_intervals(
        {"p": (1.0, 0.5, 2.0), "q": (np.nan,) * 3, "r": (-20.0, -30.0, -10.0)}, "difference"
    )
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["p", "q", "r"]
    (drawn,) = (line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 3)
    np.testing.assert_array_equal(drawn, [1, np.nan, -20])
    low, high = axes.get_xlim()
    assert low < -30 and high > 2
    (axes,) = draw_intervals({"p": (0.12, -0.03, 0.31), "q": (np.nan,) * 3}, "difference").axes
    assert axes.get_xscale() == "linear"
    assert {"0", "+0.1", "+0.2", "+0.3"} <= {text.get_text() for text in axes.get_xticklabels()}
    with pytest.raises(InputError, match="nothing to draw"):
        draw_intervals({}, "difference")


def test_functions_on_bodies_are_red_above_and_blue_below_zero() -> None:
    mesh = bumpy_mesh(3)
    up = np.sign(mesh.vertices[:, 2])
    figure = draw_functions([mesh, mesh], [np.stack([up, -up])] * 2, titles=["f", "g"], marked=[0, 1], up="z")
    pictures = [np.asarray(axes.images[0].get_array(), dtype=float) for axes in figure.axes]
    assert len(pictures) == 4
    for picture, sign in zip(pictures, (1, 1, -1, -1), strict=True):
        seen = picture[..., 3] == 255
        redness = np.where(seen, picture[..., 0] - picture[..., 2], 0)
        half = len(redness) // 2
        assert sign * redness[: half - 20].sum() > 0 > sign * redness[half + 20 :].sum()
    with pytest.raises(InputError, match="shape"):
        draw_functions([mesh], [up[None]], titles=["f", "g"], marked=[0])
