"""The page works in a browser with mouse, keyboard and touch."""

import io
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from browser_pages import OpenPage, differ
from report_helpers import TALL, decode, embedded, renumbered

from jaxsmw.core.banks import Meyer
from jaxsmw.core.functional_map import encode
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.io.meshes import read_mesh
from jaxsmw.report import colors
from jaxsmw.report.page import ShownMap, write_page
from jaxsmw.report.page_data import encode_rounded
from jaxsmw.report.rendering import camera_axes, choose_azimuth
from jaxsmw.report.standing import stand_pair

pytestmark = pytest.mark.browser

HOSTILE = '</script></title><img src=x onerror="window.hacked=1"><b>\'&{{script}}'


# This shape is irregular, so its views and vertices differ clearly.
SOURCE = replace(TALL, vertices=TALL.vertices * (1 + 0.2 * np.sin(4 * TALL.vertices[:, [1]])), name="X.off")
TARGET, NUMBER = renumbered(replace(TALL, name="Y.off"), seed=1)


def visible_vertices() -> np.ndarray:
    """Return the source vertices that face the initial camera, the most central vertex first."""
    standing, other = stand_pair(SOURCE, TARGET)
    axes = camera_axes(choose_azimuth([standing, other]))
    facing = standing.vertex_normals @ axes[2]
    off_center = np.linalg.norm(standing.vertices @ axes[:2].T, axis=1)
    order = np.argsort(off_center)
    return order[facing[order] > 0.8]


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Three source vertices share a target vertex, so two target vertices have no source vertex.
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
        "source": [], "target": [], "pinned": False, "mode": "transfer", "map": "map", "filter": 0, "entry": None,
    }  # fmt: skip
    for side in "xy":
        view = page.view(side)
        assert min(view.shape[:2]) > 300
        saturated = np.ptp(view, axis=2) > 40
        assert 0.1 < saturated.mean() < 0.7
        assert len(np.unique(view[saturated] // 32, axis=0)) > 20
        # The body does not touch the edge of its frame.
        assert not saturated[[0, -1]].any() and not saturated[:, [0, -1]].any()
    assert page.find("dt").text == "Mean" and page.find("dd").text == "0.1"


def test_clicks_on_the_source_show_matches_and_errors(page: OpenPage) -> None:
    before = {side: page.view(side) for side in "xy"}
    for vertex in visible_vertices()[[0, 1, 9, 16]].tolist():
        page.point_at(*page.place("x", vertex), click=True)
        target = int(crowded_map()[vertex])
        assert page.state["source"] == [vertex] and page.state["target"] == [target]
        assert page.readout.startswith(f"Source vertex {vertex} → target vertex {target} · error")
        assert ("error unknown" in page.readout) == (vertex == visible_vertices()[1])
        assert f" · expected error {0.2 * (1 - vertex / (len(NUMBER) - 1)):.4f}" in page.readout
    # The mark is visible at the matched vertex.
    x, y = page.place("y", target)
    box = page.find("#canvas-y").rect
    mark = page.view("y")[int(y - box["y"]), int(x - box["x"])]
    assert mark.min() > 240
    assert 0 < differ(before["x"], page.view("x")) < 0.01
    assert 0 < differ(before["y"], page.view("y")) < 0.01


def test_clicks_on_the_target_show_its_source_vertices(page: OpenPage) -> None:
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
    # A click next to the body removes the mark.
    box = page.find("#canvas-x").rect
    page.point_at(int(box["x"]) + 8, int(box["y"] + box["height"]) - 8, click=True)
    assert page.state["source"] == [] and not page.state["pinned"]


def test_modes_change_the_colors(page: OpenPage) -> None:
    transfer = {side: page.view(side) for side in "xy"}
    assert not page.find(".scale").is_displayed()
    page.choose("error-0")
    error = {side: page.view(side) for side in "xy"}
    assert page.find(".errors").text.split("\n") == ["0", "0.1 and above (fraction of √area)", "unknown"]
    assert page.find("#unknown").size["height"] < 2 * page.find(".errors span").size["height"]
    assert page.state["mode"] == "error-0" and page.find(".scale").is_displayed()
    # The page interpolates colours on another grid, so they differ by at most one step of the colour scale.
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
    # Dragging turns the body and does not mark a vertex.
    assert not page.state["pinned"]
    page.find("#reset").click()
    assert all(differ(page.view(side), start[side]) == 0 for side in "xy")


def test_keys_move_the_camera_and_select_vertices(page: OpenPage) -> None:
    from selenium.webdriver.common.keys import Keys

    start = page.view("x")
    canvas = page.find("#canvas-x")
    seen = [start]
    for key in (Keys.ARROW_RIGHT, Keys.ARROW_UP, "+", "-"):
        canvas.send_keys(key)
        seen.append(page.view("x"))
        assert differ(seen[-2], seen[-1]) > 0.01
    canvas.send_keys("0")
    # The pictures are equal except for the frame that shows the keyboard focus.
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


def test_touch_pins_a_vertex(page: OpenPage) -> None:
    vertex = int(visible_vertices()[2])
    x, y = page.place("x", vertex)
    touch = {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]}
    page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", touch)
    page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.settle()
    assert page.state["source"] == [vertex] and page.state["pinned"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_fits_small_screens_in_both_color_schemes(browser: Any, page_file: Path, scheme: str) -> None:
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    page = OpenPage(browser, page_file, width=375, height=667)
    assert page.run("return document.documentElement.scrollWidth") <= 375
    page.run("document.querySelector('.bodies').scrollIntoView()")
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


def test_hostile_texts_are_shown_as_plain_text(browser: Any, tmp_path: Path) -> None:
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
    # Even if text were parsed as HTML, the page would run only its own script.
    page.run("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hacked=1\">')")
    page.settle()
    assert page.run("return window.hacked") is None
    browser.get_log("browser")


# ---- Wavelets, functional maps and several maps

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
    """Return a bound (n, k) on the rounding errors of the page's eigenvectors.

    A rounding error is at most half of the distance between adjacent quantisation levels.
    """
    largest, half = np.abs(values).max(axis=0), 0.5 / 127
    return largest * (2 * half * np.sqrt(np.abs(values) / largest) + half**2) + 1e-6 * largest


def wavelets(spectrum: Spectrum, vertex: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the wavelets of all scales around a vertex (filters, n), and bounds on their errors."""
    responses = np.asarray(Meyer(FILTERS)(spectrum.eigenvalues, spectrum.eigenvalues))
    values = np.asarray(spectrum.eigenvectors)
    off = rounding(values)
    coefficients = responses * values[vertex]
    bound = np.abs(responses * off[vertex]) @ (np.abs(values) + off).T + np.abs(coefficients) @ off.T
    return coefficients @ values.T, bound + 1e-4


def test_wavelets_are_shown_on_both_bodies(comparison: OpenPage, spectra: tuple[Spectrum, Spectrum]) -> None:
    from selenium.webdriver.common.keys import Keys

    comparison.choose("wavelets")
    assert comparison.run("return jaxsmw.functions") == {"x": None, "y": None}
    assert comparison.readout.startswith("Point at a body to see the wavelet around")
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
            # Errors are invisible if all are below 5 % of the colour scale and their root mean square is
            # below 1 %.
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
        told = re.search(r"similarity of the wavelets (\S+) \(1 is the same\)", comparison.readout)
        assert told and float(told[1]) == pytest.approx(cosine, abs=2e-3)
        views.append(comparison.view("x"))
        slider.send_keys(Keys.ARROW_RIGHT)
        comparison.settle()
    assert comparison.state["filter"] == FILTERS - 1
    assert comparison.find("#filter-name").text == f"wavelet {FILTERS - 1} of {FILTERS - 1} (narrowest)"
    assert all(differ(a, b) > 0.02 for a, b in pairwise(views))
    # If a target vertex is picked, the source shows the wavelet around a vertex that is matched to it.
    target = int(NUMBER[first])
    comparison.point_at(*comparison.place("y", target), click=True)
    exact, bound = wavelets(spectra[0], first)
    assert np.all(np.abs(comparison.run("return jaxsmw.functions")["x"] - exact[-1]) <= bound[-1])


def test_real_wavelets_look_the_same_on_the_page(shared: Path) -> None:
    """Rounding has the largest effect on eigenvectors that are large on a limb and small elsewhere."""
    spectrum = compute_spectrum(read_mesh(shared / "data/faust_r/off/tr_reg_062.off"), 100)
    values = np.asarray(spectrum.eigenvectors)
    shown = encode_rounded(values.T)
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


def test_entries_of_the_functional_map_show_their_eigenfunctions(
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
            text
            == f"Entry ({row}, {column}) is {value}: eigenfunction {row} of the source, {column} of the target."
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


def check_mode(page: OpenPage, mode: str) -> None:
    """Checks that buttons, explanation and legend match the mode."""
    checked = "return [...document.querySelectorAll('input[name=mode]:checked')].map(e => e.value)"
    explained = (
        "return [...document.querySelectorAll('[data-for]')].filter(e => "
        "getComputedStyle(e).visibility === 'visible').map(e => e.dataset.for)"
    )
    assert page.run(checked) == page.run(explained) == [page.state["mode"]] == [mode]
    shows_functions = page.run("return jaxsmw.functions")["x"] is not None
    assert shows_functions == (mode in ("wavelets", "eigenfunctions"))
    assert page.find(".reading .signed").is_displayed() == shows_functions
    assert page.find(".reading .errors").is_displayed() == mode.startswith("error")


@pytest.mark.parametrize("mode", ["transfer", "error-0", "wavelets", "plain"])
def test_buttons_explanation_and_legend_follow_the_mode(comparison: OpenPage, mode: str) -> None:
    from selenium.webdriver.common.keys import Keys

    comparison.run("jaxsmw.pick(arguments[0])", int(visible_vertices()[2]))
    comparison.choose(mode)
    check_mode(comparison, mode)
    matrix = comparison.find("#matrix")
    comparison.mouse().move_to_element(matrix).perform()
    comparison.settle()
    height = comparison.run("return arguments[0].getBoundingClientRect().top", matrix)
    check_mode(comparison, "eigenfunctions")
    comparison.look_away()
    check_mode(comparison, mode)
    # The matrix under the pointer does not move when the mode changes.
    assert comparison.run("return arguments[0].getBoundingClientRect().top", matrix) == height
    matrix.send_keys(Keys.ARROW_DOWN)
    check_mode(comparison, "eigenfunctions")
    matrix.send_keys(Keys.ESCAPE)
    check_mode(comparison, mode)
    # The button selects the most recently chosen entry.
    comparison.choose("eigenfunctions")
    check_mode(comparison, "eigenfunctions")
    assert comparison.state["entry"] == [0, 0]
    comparison.choose(mode)
    check_mode(comparison, mode)
    assert comparison.state["entry"] is None


def test_the_first_eigenfunctions_are_not_constant(comparison: OpenPage) -> None:
    comparison.choose("eigenfunctions")
    check_mode(comparison, "eigenfunctions")
    assert comparison.state["entry"] == [1, 1]
    for values in comparison.run("return jaxsmw.functions").values():
        assert np.ptp(values) > 0.1


def test_the_functional_map_is_dark_on_a_dark_page(browser: Any, comparison_file: Path) -> None:
    def emulate(*features: dict[str, str]) -> None:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": list(features)})

    page = OpenPage(browser, comparison_file)
    light = matrix_colors(page)
    emulate({"name": "prefers-color-scheme", "value": "dark"})
    page.settle()
    dark = matrix_colors(page)
    assert np.median(light) > 220 and np.median(dark) < 60
    emulate()


def test_switching_between_maps_changes_everything_that_depends_on_the_map(comparison: OpenPage) -> None:
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
    # An error that is unknown for a map cannot be chosen, and an earlier choice of this error is undone.
    assert [comparison.find(f"input[value=error-{i}]").is_enabled() for i in (0, 1)] == [False, True]
    comparison.choose("error-1")
    comparison.find("input[name=map][value='0']").click()
    assert comparison.state["mode"] == "transfer" and comparison.find("input[value=transfer]").is_selected()
    check("good", 1)
    # A change of the map also changes the wavelets.
    comparison.choose("wavelets")
    similarities = []
    for position in (0, 1):
        comparison.find(f"input[name=map][value='{position}']").click()
        found = re.search(r"similarity of the wavelets (\S+)", comparison.readout)
        assert found
        similarities.append(float(found[1]))
    assert similarities[0] > similarities[1] + 0.2


def test_maps_of_different_sizes_and_without_functional_map_are_shown(browser: Any, tmp_path: Path) -> None:
    n = len(NUMBER)
    errors = {"Error": np.where(np.arange(n) == 3, np.inf, np.where(np.arange(n) == 4, np.nan, 0.01))}
    large = ShownMap(NUMBER, errors, np.diag(np.arange(1.0, 7)))
    shown = {"large": large, "small": replace(large, functional_map=np.eye(2)), "none": ShownMap(NUMBER)}
    write_page(tmp_path / "page.html", SOURCE, TARGET, shown, title="Sizes")
    browser.get_log("browser")
    page = OpenPage(browser, tmp_path / "page.html")
    page.choose("error-0")
    assert page.find("#unknown").is_displayed()
    assert not browser.find_elements("css selector", "input[value=eigenfunctions]")
    page.run("jaxsmw.pick(3)")
    assert page.readout.endswith("error infinite (the match is on a separate component of the surface)")
    from selenium.webdriver.common.keys import Keys

    page.find("#matrix").send_keys(Keys.ARROW_DOWN, Keys.SHIFT, Keys.ARROW_DOWN, Keys.ARROW_RIGHT)
    # The page has no eigenvectors, so there are no eigenfunctions to show.
    entry = "Entry (5, 5) is 6.000: eigenfunction 5 of the source, 5 of the target (which this page does not hold)."
    assert page.find("#entry").text == entry
    assert page.run("return jaxsmw.functions") == {"x": None, "y": None}
    page.find("input[name=map][value='1']").click()
    assert page.find("#entry").text.startswith("Point at") and matrix_colors(page).shape == (2, 2, 3)
    page.find("input[name=map][value='2']").click()
    assert not page.find("#functional").is_displayed()
    page.find("input[name=map][value='0']").click()
    assert page.find("#entry").text == entry and page.find("#functional").is_displayed()
    assert browser.get_log("browser") == []


def test_every_control_works_with_the_keyboard(comparison: OpenPage) -> None:
    from selenium.webdriver.common.keys import Keys

    comparison.choose("wavelets")
    comparison.find("h1").click()
    comparison.run("getSelection().setPosition(document.body, 0)")
    reached: list[str] = []
    for _ in range(14):
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
        "help-open", "map", "mode", "filter", "linked", "reset", "landmark-mode", "vertex", "canvas-x", "canvas-y",
        "matrix", "table",
    ]  # fmt: skip
    for selector, keys, key, value in (
        ("input[name=map]", Keys.ARROW_RIGHT, "map", "bad"),
        ("input[name=mode]:checked", Keys.ARROW_LEFT, "mode", "error-1"),
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


@pytest.mark.parametrize("mode", ["transfer", "error-0", "wavelets", "eigenfunctions"])
def test_page_works_on_a_phone_of_360_pixels(browser: Any, comparison_file: Path, mode: str) -> None:
    feature = {"name": "prefers-reduced-motion", "value": "reduce"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    browser.get_log("browser")
    page = OpenPage(browser, comparison_file, width=360, height=740)
    page.choose(mode)
    assert page.run("return document.documentElement.scrollWidth") <= 360
    for element in browser.find_elements(
        "css selector", ".choice label, .view *, .filter *, canvas, .scale, #entry"
    ):
        if element.is_displayed():
            box = element.rect
            assert box["x"] >= 0 and box["x"] + box["width"] <= 360, element.get_attribute("outerHTML")
    for element in browser.find_elements("css selector", ".choice label, .view label, .view button"):
        assert element.rect["height"] >= 32
    # Both bodies are visible together, and their vertices can be picked.
    boxes = [page.find(f"#canvas-{side}").rect for side in "xy"]
    assert max(box["y"] + box["height"] for box in boxes) - min(box["y"] for box in boxes) < 740
    page.run("document.querySelector('.bodies').scrollIntoView()")
    vertex = int(visible_vertices()[0])
    page.point_at(*page.place("x", vertex), click=True)
    assert page.state["source"] == [vertex] and page.state["target"] == [int(NUMBER[vertex])]
    # The browser prefers reduced motion, so the page has no animations.
    assert page.run("return document.getAnimations().length") == 0
    assert browser.get_log("browser") == []
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
