"""The page of a collection works in a browser with mouse, keyboard and touch, and without WebGL."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_pages import OpenPage, differ
from collection_samples import HOSTILE, NAMES, collection, edge
from report_helpers import embedded

from jaxsmw.collection.shape_models import shape_model
from jaxsmw.report.collection_page import write_collection_page

pytestmark = pytest.mark.browser


class CollectionPage(OpenPage):
    """An open page of a collection, whose small pictures are drawn."""

    def settle(self) -> None:
        super().settle()
        for _ in range(100):
            if self.run("return jaxsmw.state.pictures") in (
                0,
                len(self.run("return JSON.parse(document.getElementById('data').textContent).names")),
            ):
                break
            time.sleep(0.1)

    @property
    def shown(self) -> tuple[int, int]:
        return self.state["a"], self.state["b"]

    def center(self, selector: str, index: int = 0) -> tuple[int, int]:
        """The middle of an element in the window, after scrolling to it."""
        script = """
            const element = document.querySelectorAll(arguments[0])[arguments[1]];
            element.scrollIntoView({ block: "center" });
            const { left, top, width, height } = element.getBoundingClientRect();
            return [left + width / 2, top + height / 2];
        """
        x, y = self.run(script, selector, index)
        self.settle()
        return round(x), round(y)

    def on_edge(self, index: int) -> tuple[int, int]:
        """A point of the window on the line of a pair, where no node covers the line."""
        self.center("#graph")
        script = """
            const line = document.querySelectorAll("#graph .reach")[arguments[0]];
            const [x1, y1, x2, y2] = ["x1", "y1", "x2", "y2"].map((name) => Number(line.getAttribute(name)));
            for (let share = 0.1; share < 0.9; share += 0.02) {
                const point = new DOMPoint(x1 + share * (x2 - x1), y1 + share * (y2 - y1));
                const { x, y } = point.matrixTransform(line.getScreenCTM());
                if (document.elementFromPoint(Math.round(x), Math.round(y)) === line) return [x, y];
            }
        """
        x, y = self.run(script, index)
        return round(x), round(y)

    @property
    def tip(self) -> str:
        return self.run("const tip = document.getElementById('tip'); return tip.hidden ? '' : tip.innerText")


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("collection") / "page.html"
    write_collection_page(path, **collection(), up="y")
    return path


@pytest.fixture
def page(browser: Any, page_file: Path) -> Iterator[CollectionPage]:
    browser.get_log("browser")
    yield CollectionPage(browser, page_file, width=1000, height=800)
    assert browser.get_log("browser") == []


def vertex_in_front(page: CollectionPage, side: str) -> int:
    """A vertex that a click at its place picks."""
    box = page.find(f"#canvas-{side}").rect
    for share in np.linspace(0.4, 0.6, 9):
        page.point_at(
            round(box["x"] + share * box["width"]), round(box["y"] + box["height"] / 2), click=False
        )
        if page.state["vertex"] is not None:
            return page.state["vertex"]
    raise AssertionError("no vertex is visible")


def test_page_draws_all_shapes_in_the_same_colors(page: CollectionPage) -> None:
    assert page.browser.title == page.find("h1").text == "Five foxes"
    assert page.state["pictures"] == len(NAMES) and page.shown == (0, 1)
    for side in "ab":
        saturated = np.ptp(page.view(side), axis=2) > 40
        assert 0.04 < saturated.mean() < 0.7
        assert not saturated[[0, -1]].any() and not saturated[:, [0, -1]].any()
    assert page.run("return jaxsmw.colors('a')") == page.run("return jaxsmw.colors('b')")
    # Every small picture contains a coloured body that differs from the other pictures.
    script = """
        return [...document.querySelectorAll(".thumb canvas")].map((canvas) =>
            Array.from(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data));
    """
    pictures = np.array(page.run(script)).reshape(len(NAMES), -1, 4)
    assert ((pictures[..., 3] > 200).mean(axis=1) > 0.03).all()
    assert (np.ptp(pictures[..., :3], axis=2) > 40).any(axis=1).all()
    assert all((pictures[i] != pictures[j]).mean() > 0.01 for i in range(len(NAMES)) for j in range(i))


def test_clicks_open_shapes_as_a_or_b(page: CollectionPage) -> None:
    before = {side: page.view(side) for side in "ab"}
    thumbs = page.browser.find_elements("css selector", ".thumb")
    thumbs[3].click()
    assert page.shown == (0, 3) and differ(before["b"], page.view("b")) > 0.02
    assert differ(before["a"], page.view("a")) < 0.9 and page.find("#choose-b").get_property("value") == "3"
    page.find("input[name=side][value=a]").click()
    thumbs[2].click()
    assert page.shown == (2, 3)
    opened = [thumb.get_attribute("aria-pressed") for thumb in thumbs]
    assert opened == ["false", "false", "true", "true", "false"]
    assert [badge.text for badge in page.browser.find_elements("css selector", ".thumb .badge")] == ["A", "B"]
    page.run(
        "const s = document.getElementById('choose-b'); s.value = 4; s.dispatchEvent(new Event('change'))"
    )
    assert page.shown == (2, 4)


def test_one_shape_can_be_enlarged(page: CollectionPage) -> None:
    width = page.find("#canvas-b").size["width"]
    page.find("input[name=view][value=one]").click()
    page.settle()
    assert not page.find("#canvas-a").is_displayed()
    assert page.find("#canvas-b").size["width"] > 1.8 * width
    page.browser.find_elements("css selector", ".thumb")[2].click()
    assert page.shown == (0, 2)
    page.find("input[name=view][value=two]").click()
    page.settle()
    assert page.find("#canvas-a").is_displayed() and page.find("#canvas-b").size["width"] == width


def test_pointing_marks_the_same_vertex_on_both_shapes(page: CollectionPage) -> None:
    vertex = vertex_in_front(page, "a")
    assert page.state["marked"] == [[vertex], [vertex]]
    a, b = (np.reshape(page.run("return jaxsmw.positions(arguments[0])", i), (-1, 3)) for i in (0, 1))
    distance = np.linalg.norm(a[vertex] - b[vertex])
    assert (
        page.readout == f"Vertex {vertex} of the template · {distance:.3f} √area from A to B, after alignment"
    )
    x, y = page.place("b", vertex)
    page.point_at(*page.place("a", vertex), click=True)
    assert page.state["pinned"] and page.state["vertex"] == vertex
    page.look_away()
    assert page.state["marked"] == [[vertex], [vertex]]
    box = page.find("#canvas-a").rect
    page.point_at(int(box["x"]) + 8, int(box["y"] + box["height"]) - 8, click=True)
    assert page.state["marked"] == [[], []] and page.readout.startswith("Point at a shape")
    # The shape on the right picks the same vertex at its place, unless the surface hides the vertex.
    page.point_at(x, y, click=False)
    assert page.state["marked"][0] == page.state["marked"][1] != []


def test_touch_marks_a_vertex(page: CollectionPage) -> None:
    vertex = vertex_in_front(page, "b")
    x, y = page.place("b", vertex)
    page.look_away()
    touch = {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]}
    page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", touch)
    page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.settle()
    assert page.state["vertex"] == vertex and page.state["pinned"]


def test_cameras_turn_together_or_alone(page: CollectionPage) -> None:
    start = {side: page.view(side) for side in "ab"}
    page.drag("a", 90)
    page.look_away()
    turned = {side: page.view(side) for side in "ab"}
    assert all(differ(start[side], turned[side]) > 0.03 for side in "ab")
    page.find("#linked").click()
    page.drag("b", 90)
    page.look_away()
    assert differ(turned["a"], page.view("a")) == 0 and differ(turned["b"], page.view("b")) > 0.03
    page.find("#reset").click()
    assert all(differ(page.view(side), start[side]) == 0 for side in "ab")


def test_colors_show_differences_or_nothing(page: CollectionPage) -> None:
    match = page.view("a")
    assert not page.find(".scale").is_displayed()
    page.choose("difference")
    assert page.find(".scale").is_displayed() and differ(match, page.view("a")) > 0.03
    a, b = (np.reshape(page.run("return jaxsmw.positions(arguments[0])", i), (-1, 3)) for i in (0, 1))
    colors = np.reshape(page.run("return jaxsmw.colors('a')"), (-1, 3))
    darkest = colors.sum(axis=1).argmin()
    distances = np.linalg.norm(a - b, axis=1)
    assert distances[darkest] > np.quantile(distances, 0.95)
    assert colors[distances.argmin()].min() > 200
    page.choose("plain")
    assert np.ptp(page.view("a")[60:], axis=2).max() < 30  # below the caption
    page.choose("match")
    assert differ(match, page.view("a")) == 0


def test_keys_turn_bodies_and_move_between_shapes(page: CollectionPage) -> None:
    from selenium.webdriver.common.keys import Keys

    canvas = page.find("#canvas-a")
    start = page.view("b")
    canvas.send_keys(Keys.ARROW_RIGHT)
    assert differ(start, page.view("b")) > 0.02
    canvas.send_keys("0")
    assert differ(start, page.view("b")) == 0
    first = page.find(".thumb")
    first.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    focused = page.browser.switch_to.active_element
    assert focused.text.strip() == NAMES[2]
    focused.send_keys(Keys.ENTER)
    assert page.shown == (0, 2)
    # One stop of the Tab key for all pictures, and one for each plot.
    for selector in (".thumb", "#graph .node", "#scores .node"):
        stops = page.run(
            f"return [...document.querySelectorAll('{selector}')].filter((e) => e.tabIndex === 0).length"
        )
        assert stops == 1
    page.run("document.querySelector('#scores .node').focus()")
    for key in (Keys.END, Keys.ARROW_LEFT):
        page.browser.switch_to.active_element.send_keys(key)
    assert page.tip.startswith(NAMES[3])
    page.browser.switch_to.active_element.send_keys(" ")
    assert page.shown == (0, 3)


def test_graph_marks_doubtful_pairs_and_opens_pairs(page: CollectionPage) -> None:
    edges = collection()["edges"]
    assert len(page.browser.find_elements("css selector", "#graph .edge")) == len(edges)
    assert len(page.browser.find_elements("css selector", "#graph .edge.doubtful")) == 1
    # Doubtful lines are drawn last.
    page.point_at(*page.on_edge(len(edges) - 1), click=False)
    assert page.tip.split("\n") == [
        "stand → walk",
        f"Expected error 30.5 ‰ of √area. Doubtful. {edges[1].sentence(NAMES)}",
    ]
    page.point_at(*page.on_edge(len(edges) - 1), click=True)
    assert page.shown == (1, 2)
    page.find("summary").click()
    page.find(".pair[data-edge='3']").click()
    assert page.shown == (1, 4)
    page.point_at(*page.center("#graph [data-shape='3']"), click=False)
    assert page.tip.startswith("sit")
    page.point_at(*page.center("#graph [data-shape='3']"), click=True)
    assert page.shown == (1, 3)
    # The page scrolls up to the shapes.
    top = page.run("return document.getElementById('stage').getBoundingClientRect().top")
    assert 0 <= top < 450
    assert page.run("return document.querySelectorAll('#graph image').length") == len(NAMES)


def test_nodes_of_the_graph_do_not_overlap(page: CollectionPage) -> None:
    script = "return [...document.querySelectorAll('#graph .disc')].map((e) => { const b = e.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2, b.width / 2]; })"
    places = np.array(page.run(script))
    box = page.find("#graph").rect
    distances = np.linalg.norm(places[:, None, :2] - places[:, :2], axis=2)[np.triu_indices(len(NAMES), 1)]
    assert distances.min() > 2 * places[0, 2]
    assert np.ptp(places[:, 0]) < box["width"] and np.ptp(places[:, 1]) < box["height"]


@pytest.mark.parametrize("width", [1400, 390])
def test_names_and_nodes_of_a_large_graph_do_not_overlap(browser: Any, tmp_path: Path, width: int) -> None:
    """On a phone there is no room for names. The layout places many of the shapes near each other."""
    generator = np.random.default_rng(0)
    arguments = collection()
    shapes = [arguments["registered"][i % 5] * generator.normal(1, 0.05, 3) for i in range(25)]
    names = [f"a rather long name {i}" if i % 2 else f"{i}" for i in range(25)]
    edges = [edge(i, j, 5.0, doubtful=i % 3 == 0) for i in range(25) for j in (i - 1, i - 7) if j >= 0]
    model = shape_model(shapes)
    changes = {"names": names, "registered": shapes, "edges": edges, "model": model, "warning": "Look."}
    write_collection_page(tmp_path / "page.html", **(arguments | changes), up="y")
    page = CollectionPage(browser, tmp_path / "page.html", width=width, height=900)
    # A node with its name is one box.
    script = """
        return [...document.querySelectorAll("#graph .node")].map((node) =>
            [...node.querySelectorAll(".disc, text")].map((e) => e.getBoundingClientRect())).map((boxes) =>
            ["left", "top", "right", "bottom"].map((side, i) =>
                Math[i < 2 ? "min" : "max"](...boxes.map((box) => box[side]))));
    """
    boxes = np.array(page.run(script))
    assert len(boxes) == 25
    for i, one in enumerate(boxes):
        apart = (boxes[:, :2] >= one[2:] - 1).any(axis=1) | (boxes[:, 2:] <= one[:2] + 1).any(axis=1)
        assert np.flatnonzero(~apart).tolist() == [i]
    box = page.run(
        "const b = document.querySelector('#graph').getBoundingClientRect(); return [b.left, b.right]"
    )
    assert boxes[:, 0].min() >= box[0] and boxes[:, 2].max() <= box[1]
    assert len(page.browser.find_elements("css selector", "#graph text")) == (25 if width == 1400 else 0)
    # The warning does not touch the sentence above it.
    script = "const b = (s) => document.querySelector(s).getBoundingClientRect(); return b('header .fault').top - b('.lead').bottom"
    assert page.run(script) > 8


def test_badges_are_above_the_bodies(page: CollectionPage) -> None:
    """In the small pictures, the rows beside the badges contain nothing but background."""
    script = """
        const thumb = document.querySelector(".thumb"), canvas = thumb.querySelector("canvas");
        const { data, width, height } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        const first = [...data.keys()].find((at) => at % 4 === 3 && data[at] > 128);
        const style = getComputedStyle(canvas), box = canvas.getBoundingClientRect();
        const top = parseFloat(style.paddingTop);
        const body = box.top + top + (Math.floor(first / 4 / width) / height) * (box.height - top);
        return [...thumb.querySelectorAll("small, .badge")].map((e) => body - e.getBoundingClientRect().bottom);
    """
    distances = page.run(script)
    assert len(distances) == 2 and min(distances) >= 0


def test_sliders_deform_the_mean(page: CollectionPage) -> None:
    model = collection()["model"]
    data = embedded(page.path.read_text("utf-8"))
    kept = len(data["model"]["modes"])
    sliders = page.browser.find_elements("css selector", ".mode input")
    assert len(sliders) == kept >= 2 and page.state["scores"] == [0] * kept
    page.center("#canvas-mean")
    start, mean = page.view("mean"), np.reshape(page.run("return jaxsmw.deformed"), (-1, 3))
    set_slider = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'))"
    page.run(set_slider, sliders[0], 2)
    assert page.state["scores"] == [2] + [0] * (kept - 1)
    moved = np.reshape(page.run("return jaxsmw.deformed"), (-1, 3))
    unit = np.sqrt(np.sum(model.weights[:, None] * (moved - mean) ** 2))
    size = np.sqrt(np.sum(model.weights[:, None] * (mean - model.weights @ mean) ** 2))
    known = np.sqrt(np.sum(model.weights[:, None] * (model.mean - model.weights @ model.mean) ** 2))
    assert unit / size == pytest.approx(2 * np.sqrt(model.variances[0]) / known, rel=1e-2)
    assert differ(start, page.view("mean")) > 0.01
    assert page.find(".mode output").text == "2.0 σ" and "chosen scores" in page.find("#mean-caption").text
    page.find("#reset-modes").click()
    assert page.state["scores"] == [0] * kept and differ(start, page.view("mean")) < 0.001
    page.run(
        "const s = document.getElementById('scores-of'); s.value = 3; s.dispatchEvent(new Event('change'))"
    )
    np.testing.assert_allclose(page.state["scores"], np.clip(data["model"]["scores"][3], -3, 3), atol=1e-3)


def test_modes_can_be_played(page: CollectionPage) -> None:
    page.center(".mode button")
    play = page.find(".mode button")
    play.click()
    seen, end = set(), time.monotonic() + 20  # a busy machine draws only a few pictures per second
    while len(seen) <= 2 and time.monotonic() < end:
        time.sleep(0.1)
        seen.add(page.state["scores"][0])
    assert len(seen) > 2 and play.text == "Stop"
    play.click()
    stopped = page.state["scores"]
    time.sleep(0.2)
    assert page.state["scores"] == stopped and play.text == "Play"


def test_scores_are_plotted(page: CollectionPage) -> None:
    scores = np.array(embedded(page.path.read_text("utf-8"))["model"]["scores"])
    script = "return [...document.querySelectorAll('#scores .node')].sort((a, b) => a.dataset.shape - b.dataset.shape).map((node) => node.querySelector('.dot')).map((e) => { const b = e.getBoundingClientRect(); return [b.x, b.y]; })"

    def fit(chosen: tuple[int, int]) -> float:
        """The largest distance between the plotted places and an affine map of the scores, in pixels."""
        places = np.array(page.run(script))
        known = np.hstack([scores[:, chosen], np.ones((len(scores), 1))])
        matrix = np.linalg.lstsq(known, places, rcond=None)[0]
        assert matrix[0, 0] > 0 > matrix[1, 1] and abs(matrix[0, 1]) < 1e-2 > abs(matrix[1, 0])
        return float(np.abs(known @ matrix - places).max())

    assert fit((0, 1)) < 0.5
    page.run("const s = document.getElementById('across'); s.value = 1; s.dispatchEvent(new Event('change'))")
    page.run("const s = document.getElementById('upward'); s.value = 0; s.dispatchEvent(new Event('change'))")
    assert fit((1, 0)) < 0.5
    page.point_at(*page.center("#scores [data-shape='4']"), click=False)
    assert page.tip.split("\n")[0] == "blend" and "σ across" in page.tip
    page.point_at(*page.center("#scores [data-shape='4']"), click=True)
    assert page.shown == (0, 4)
    # Nodes of the shapes that are shown are drawn over the other nodes.
    order = page.run(
        "return [...document.querySelectorAll('#scores .node')].map((node) => node.dataset.shape)"
    )
    assert order[:3] == ["1", "2", "3"] and set(order[3:]) == {"0", "4"}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_fits_a_phone(browser: Any, page_file: Path, scheme: str) -> None:
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    page = CollectionPage(browser, page_file, width=390, height=844)
    assert page.run("return document.documentElement.scrollWidth") <= 390
    script = """
        return [...document.querySelectorAll("main :is(canvas, button, select, input, svg)")]
            .filter((e) => e.offsetParent && !e.closest("#gallery, .table, .choice"))
            .map((e) => e.getBoundingClientRect()).filter((b) => b.left < 0 || b.right > 390).length;
    """
    assert page.run(script) == 0
    for side in ("a", "b", "mean"):
        page.center(f"#canvas-{side}")
        corner = page.view(side)[-20, 20]
        assert corner.min() > 200 if scheme == "light" else corner.max() < 60
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_page_is_useful_without_webgl(browser: Any, page_file: Path) -> None:
    script = """
        const original = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
            return kind.startsWith("webgl") ? null : original.call(this, kind, ...rest);
        };
    """
    added = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": script})
    try:
        page = CollectionPage(browser, page_file, width=1000, height=800)
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)
    assert "does not support WebGL" in page.find("#no-webgl").text
    assert not page.find("#canvas-a").is_displayed() and not page.find("#deform").is_displayed()
    thumbs = page.browser.find_elements("css selector", ".thumb")
    assert [thumb.text.split("\n")[0] for thumb in thumbs] == NAMES
    thumbs[2].click()
    assert page.shown == (0, 2)
    assert len(page.browser.find_elements("css selector", "#graph .node")) == len(NAMES)
    page.point_at(*page.center("#scores [data-shape='3']"), click=False)
    assert page.tip.startswith("sit")
    browser.get_log("browser")  # three.js reports the missing context


def test_hostile_texts_are_shown_as_plain_text(browser: Any, tmp_path: Path) -> None:
    arguments = collection()
    arguments["names"] = [HOSTILE, *NAMES[1:]]
    arguments["edges"] = [edge(0, 1, 1.0, doubtful=True)]
    arguments |= {"title": HOSTILE, "notes": [HOSTILE], "warning": HOSTILE, "left_out": {HOSTILE: HOSTILE}}
    write_collection_page(tmp_path / "page.html", **arguments)
    browser.get_log("browser")
    page = CollectionPage(browser, tmp_path / "page.html", width=1300, height=900)
    assert browser.title == page.find("h1").text == page.find(".notes li").text == HOSTILE
    assert (
        page.find(".thumb span").text == HOSTILE
        and page.find("#choose-a option").get_property("text") == HOSTILE
    )
    assert page.run("return document.querySelector('.pair').textContent") == f"{HOSTILE} → stand"
    page.point_at(*page.on_edge(0), click=False)
    assert HOSTILE in page.tip
    # The only images are those of the graph and of the tooltip.
    assert page.run("return [window.hacked, document.images.length]") == [None, 1]
    assert browser.get_log("browser") == []


@pytest.mark.parametrize("count", [1, 2])
def test_small_collections_are_shown(browser: Any, tmp_path: Path, count: int) -> None:
    arguments = collection()
    shapes = arguments["registered"][:count]
    arguments |= {"names": NAMES[:count], "registered": shapes, "model": shape_model(shapes), "edges": []}
    write_collection_page(tmp_path / "page.html", **arguments)
    browser.get_log("browser")
    page = CollectionPage(browser, tmp_path / "page.html", width=1300, height=900)
    assert page.find("#canvas-a").is_displayed() == page.find("#graph").is_displayed() == (count == 2)
    assert page.find("#deform").is_displayed() == page.find("#scores").is_displayed() == (count == 2)
    assert len(browser.find_elements("css selector", ".mode")) == count - 1
    assert vertex_in_front(page, "b") >= 0
    # A plot of one mode has no direction up, so all points are on one line.
    assert not page.find("#upward").is_displayed()
    script = "return [...document.querySelectorAll('#scores .dot')].map((e) => e.getBoundingClientRect().y)"
    assert np.ptp(page.run(script) or [0]) == 0
    assert browser.get_log("browser") == []
