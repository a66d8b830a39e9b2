"""Landmarks, suggestions, the registered source and the help of the page work with mouse, keyboard and touch."""

import base64
import json
import re
import shlex
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_pages import OpenPage, differ
from report_helpers import TALL, renumbered
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io import Landmarks
from jaxsmw.report.page import EXPECTED_ERROR, ShownMap, write_page
from jaxsmw.report.rendering import camera_axes, choose_azimuth
from jaxsmw.report.standing import stand_pair

pytestmark = pytest.mark.browser

HOSTILE = '</li><img src=x onerror="window.hacked=1">\'&"'

# The two files have different units, origins and up axes, so displayed and original coordinates differ.
_TARGET, NUMBER = renumbered(TALL, seed=1)
SOURCE = replace(
    TALL,
    vertices=100 * TALL.vertices * (1 + 0.2 * np.sin(4 * TALL.vertices[:, [1]])) + [300, -50, 1000],
    name="/data/my source.off",
)
TARGET = replace(_TARGET, vertices=3 * _TARGET.vertices[:, [0, 2, 1]] * [1, -1, 1] - 7, name="target.ply")
MESHES = {"x": SOURCE, "y": TARGET}


def diagonal(mesh: Mesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))


def visible(side: str) -> np.ndarray:
    """Return the vertices that face the initial camera, the most central vertex first."""
    pair = stand_pair(SOURCE, TARGET)
    axes = camera_axes(choose_azimuth(list(pair)))
    standing = pair["xy".index(side)]
    order = np.argsort(np.linalg.norm(standing.vertices @ axes[:2].T, axis=1))
    return order[(standing.vertex_normals @ axes[2])[order] > 0.8]


WEAK = int(visible("x")[20])  # the expected error is highest around this vertex


def expected_error() -> np.ndarray:
    distance = np.linalg.norm(SOURCE.vertices - SOURCE.vertices[WEAK], axis=1) / diagonal(SOURCE)
    errors = 0.01 + 0.2 * np.exp(-((distance / 0.1) ** 2))
    errors[[3, 4]] = np.nan, np.inf  # a single outlier must not attract the suggestion
    return errors


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("landmarks") / "page.html"
    shown = {"map": ShownMap(NUMBER, {EXPECTED_ERROR: expected_error()})}
    write_page(path, SOURCE, TARGET, shown, title="Two", registered=TARGET.vertices[NUMBER])
    return path


def test_the_page_opens_with_the_landmarks_of_a_transfer(browser: Any, tmp_path: Path) -> None:
    vertices = visible("x")[[0, 30]]
    names = ("nose <b>", "chin")
    given = (
        Landmarks(names, SOURCE.vertices[vertices], name="/data/source.mrk.json", coordinates="LPS"),
        Landmarks(names, TARGET.vertices[NUMBER[vertices]]),
    )
    path = tmp_path / "page.html"
    write_page(path, SOURCE, TARGET, {"map": ShownMap(NUMBER)}, title="Two", landmarks=given)
    page = OpenPage(browser, path)
    assert page.find("#landmark-mode").get_attribute("aria-pressed") == "true"
    found = page.run("return jaxsmw.landmarks.entries")
    assert tuple(entry["name"] for entry in found) == names
    for entry, vertex in zip(found, vertices, strict=True):
        np.testing.assert_allclose(
            entry["positions"]["x"], SOURCE.vertices[vertex], atol=1e-4 * diagonal(SOURCE)
        )
        np.testing.assert_allclose(
            entry["positions"]["y"], TARGET.vertices[NUMBER[vertex]], atol=1e-4 * diagonal(TARGET)
        )
    assert page.find("#landmark-format-x").get_attribute("value") == "LPS"
    assert "2 of them on both bodies" in page.find("#landmark-status").text


class LandmarkPage(OpenPage):
    """A page in the landmark mode."""

    def __init__(self, browser: Any, path: Path, **size: int) -> None:
        super().__init__(browser, path, **size)
        self.find("#landmark-mode").click()
        self.settle()
        self.run("document.querySelector('.bodies').scrollIntoView()")
        self.settle()

    @property
    def report(self) -> dict[str, Any]:
        return self.run("return jaxsmw.landmarks")

    @property
    def entries(self) -> list[dict[str, Any]]:
        return self.report["entries"]

    @property
    def names(self) -> list[str]:
        return [entry["name"] for entry in self.entries]

    def text(self, name: str) -> str:
        return self.run("return document.getElementById(arguments[0]).textContent", name)

    def between(self, side: str, vertex: int) -> tuple[int, int]:
        """Return the pixel in the middle of a triangle at a vertex."""
        mesh = MESHES[side]
        face = mesh.faces[np.flatnonzero((mesh.faces == vertex).any(axis=1))[0]]
        corners = [self.run("return jaxsmw.project(arguments[0], arguments[1])", side, int(v)) for v in face]
        return tuple(round(sum(corner[axis] for corner in corners) / 3) for axis in "xy")

    def click(self, side: str, vertex: int) -> tuple[int, int]:
        place = self.between(side, vertex)
        self.point_at(*place, click=True)
        return place

    def add(self, rank: int) -> None:
        """Places a landmark, with the proposed point on the target."""
        self.click("x", int(visible("x")[rank]))
        self.press("a")

    def press(self, *keys: str, on: str = "#landmark-list") -> None:
        """Presses a key, while the keys before it are held."""
        self.run("document.querySelector(arguments[0]).focus()", on)
        actions, (*held, last) = self.mouse(), keys
        for key in held:
            actions.key_down(key)
        actions.send_keys(last)
        for key in held:
            actions.key_up(key)
        actions.perform()
        self.settle()

    def pull(self, start: dict[str, float], across: int, down: int, *, release: bool = True) -> None:
        """Drags the mouse from a place in the window."""
        actions = self.mouse()
        pointer = actions.w3c_actions.pointer_action
        x, y = round(start["x"]), round(start["y"])
        pointer.move_to_location(x, y).pointer_down()
        pointer.move_to_location(x + across // 2, y + down // 2).move_to_location(x + across, y + down)
        if release:
            pointer.pointer_up()
        actions.perform()
        self.settle()

    def drop(self, side: str, files: dict[str, str | bytes]) -> None:
        """Drops files on a body."""
        encoded = [
            [name, base64.b64encode(text.encode() if isinstance(text, str) else text).decode()]
            for name, text in files.items()
        ]
        self.run(
            "const transfer = new DataTransfer(), [side, files] = arguments;"
            "for (const [name, text] of files)"
            "  transfer.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));"
            "document.querySelector(`#canvas-${side}`).dispatchEvent(new DragEvent('drop',"
            "  { dataTransfer: transfer, bubbles: true, cancelable: true }))",
            side,
            encoded,
        )
        self.settle()
        self.settle()

    def save(self, side: str, directory: Path) -> Path:
        """Saves the landmarks of a body, and returns the downloaded file."""
        before = set(directory.iterdir())
        self.browser.execute_cdp_cmd(
            "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(directory)}
        )
        self.find(f"[data-save={side}]").click()
        for _ in range(100):
            new = [path for path in set(directory.iterdir()) - before if path.suffix != ".crdownload"]
            if new and new[0].stat().st_size:
                return new[0]
            time.sleep(0.05)
        raise AssertionError("nothing was downloaded")

    def touch(self, kind: str, *point: float) -> None:
        points = [{"x": point[0], "y": point[1]}] if point else []
        self.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def tap(self, x: float, y: float) -> None:
        self.touch("touchStart", x, y)
        self.touch("touchEnd")
        self.settle()


@pytest.fixture
def page(browser: Any, page_file: Path) -> Iterator[LandmarkPage]:
    browser.get_log("browser")
    yield LandmarkPage(browser, page_file, width=1100, height=700)
    assert browser.get_log("browser") == []


def on_surface(side: str, point: dict[str, Any]) -> np.ndarray:
    """Return a point of the page in the original coordinates, from its triangle and weights."""
    mesh = MESHES[side]
    return np.array(point["weights"]) @ mesh.vertices[mesh.faces[point["face"]]]


def near(place: dict[str, float], pixel: tuple[int, int], tolerance: float = 1) -> bool:
    return bool(np.hypot(place["x"] - pixel[0], place["y"] - pixel[1]) <= tolerance)


# ---- Placing landmarks


def test_clicks_place_points_on_triangles_of_both_bodies(page: LandmarkPage) -> None:
    clear = {side: page.view(side) for side in "xy"}
    assert page.text("landmark-status").startswith("Click a point on one body")
    first, second = visible("x")[0], visible("y")[5]
    pixel = page.click("x", int(first))
    (entry,) = page.entries
    assert entry["name"] == "L1" and entry["y"] is None and near(entry["screen"]["x"], pixel)
    assert min(entry["x"]["weights"]) > 0.1 and sum(entry["x"]["weights"]) == pytest.approx(1)
    assert page.text("landmark-status").startswith("L1: click the matching point on the target")
    assert "only on the source" in page.text("landmark-list")
    # A second click on the same body moves the point.
    pixel = page.click("x", int(visible("x")[9]))
    (entry,) = page.entries
    assert near(entry["screen"]["x"], pixel)
    pixel = page.click("y", int(second))
    (entry,) = page.entries
    assert near(entry["screen"]["y"], pixel) and page.report["proposal"] is None
    assert page.text("landmark-status").startswith("L1 is complete")
    for side in "xy":
        view = page.view(side)
        assert 0.001 < differ(clear[side], view) < 0.02
        # The markers on both bodies have the colour of the entry in the list.
        shown = page.run(
            "return getComputedStyle(document.querySelector('#landmark-list i')).backgroundColor"
        )
        color = [int(value) for value in re.findall(r"\d+", shown)]
        assert (np.abs(view - color).max(axis=2) < 12).sum() > 40
    # The next landmark may begin on the target.
    page.click("y", int(visible("y")[30]))
    assert page.names == ["L1", "L2"] and page.entries[1]["x"] is None
    assert page.report["proposal"]["side"] == "x"


def test_clicks_beside_the_bodies_and_outside_the_mode_place_nothing(page: LandmarkPage) -> None:
    box = page.run(
        "const {left, bottom} = document.querySelector('#canvas-x').getBoundingClientRect(); return [left, bottom]"
    )
    page.point_at(int(box[0]) + 8, int(box[1]) - 8, click=True)
    assert page.entries == []
    page.find("#landmark-mode").click()
    assert not page.find("#landmarks").is_displayed() and not page.report["active"]
    page.click("x", int(visible("x")[0]))
    assert page.entries == [] and page.state["pinned"]
    page.find("#landmark-mode").click()
    assert not page.state["pinned"]


def test_the_map_proposes_the_second_point(page: LandmarkPage) -> None:
    vertex = int(visible("x")[0])
    page.click("x", vertex)
    proposal = page.report["proposal"]
    assert proposal["side"] == "y"
    # The map is a renumbering, so the corners of the triangle are matched with the corners of another triangle.
    (entry,) = page.entries
    corners = TARGET.vertices[NUMBER[SOURCE.faces[entry["x"]["face"]]]]
    expected = np.array(entry["x"]["weights"]) @ corners
    assert np.linalg.norm(on_surface("y", proposal["point"]) - expected) < 1e-5 * diagonal(TARGET)
    hollow = page.view("y")
    # A click on the hollow marker accepts it.
    page.point_at(*(round(proposal["screen"][axis]) for axis in "xy"), click=True)
    (entry,) = page.entries
    assert entry["y"] == proposal["point"]
    assert page.report["proposal"] is None and differ(hollow, page.view("y")) > 0
    # The reverse direction, by the button.
    page.click("y", int(NUMBER[visible("x")[40]]))
    assert page.report["proposal"]["side"] == "x"
    page.find("#landmark-accept").click()
    last = page.entries[1]
    assert np.linalg.norm(SOURCE.vertices[visible("x")[40]] - last["positions"]["x"]) < 0.1 * diagonal(SOURCE)


def test_markers_are_dragged_over_the_surface(page: LandmarkPage) -> None:
    from selenium.webdriver.common.keys import Keys

    page.add(0)
    page.add(40)
    start = page.entries[0]["screen"]["x"]
    vertex = int(visible("x")[9])
    camera = page.place("x", vertex)
    page.pull(start, 20, 14)
    moved = page.entries[0]
    assert near(moved["screen"]["x"], (round(start["x"]) + 20, round(start["y"]) + 14))
    assert page.report["selected"] == "L1" and len(page.names) == 2
    assert page.place("x", vertex) == camera, "the body must not turn with the marker"
    page.press(Keys.CONTROL, "z")
    assert near(page.entries[0]["screen"]["x"], (round(start["x"]), round(start["y"])))
    page.press(Keys.CONTROL, Keys.SHIFT, "z")
    assert page.entries[0] == moved
    # A marker that is pulled off the body stays on it.
    page.pull(moved["screen"]["x"], 400, 0)
    assert np.isfinite(page.entries[0]["positions"]["x"]).all() and len(page.names) == 2
    page.press(Keys.CONTROL, "z")
    # Escape ends a drag where it began.
    page.pull(moved["screen"]["x"], -15, 10, release=False)
    assert page.entries[0]["x"] != moved["x"]
    page.press(Keys.ESCAPE)
    assert page.entries[0]["x"] == moved["x"]
    page.mouse().release().perform()
    # Afterwards, the mouse turns the body again.
    page.drag("x", 60)
    assert page.place("x", vertex) != camera and page.entries[0]["x"] == moved["x"]


def test_changes_are_undone_and_redone(page: LandmarkPage) -> None:
    from selenium.webdriver.common.keys import Keys

    page.add(0)
    page.add(40)
    page.press(Keys.DELETE)
    assert page.names == ["L1"]
    for _ in range(5):
        page.press(Keys.CONTROL, "z")
    assert page.names == [] and not page.find("#landmark-undo").is_enabled()
    for _ in range(5):
        page.find("#landmark-redo").click()
    assert not page.find("#landmark-redo").is_enabled()
    assert page.names == ["L1"]
    page.find("#landmark-undo").click()
    assert page.names == ["L1", "L2"]
    # Undone to half a pair, the pair is open again. A new change ends the changes that could be redone.
    page.press(Keys.CONTROL, "z")
    assert page.report["selected"] == "L2" and page.report["proposal"]["side"] == "y"
    page.press(Keys.ESCAPE)
    assert page.names == ["L1"] and not page.find("#landmark-redo").is_enabled()


def test_escape_cancels_half_a_pair(page: LandmarkPage) -> None:
    from selenium.webdriver.common.keys import Keys

    page.add(0)
    page.click("x", int(visible("x")[40]))
    assert page.names == ["L1", "L2"]
    page.press(Keys.ESCAPE, on="#canvas-x")
    assert page.names == ["L1"] and page.report["proposal"] is None and page.report["selected"] is None
    page.press(Keys.ESCAPE)
    assert page.names == ["L1"]


def test_the_keyboard_does_everything(page: LandmarkPage) -> None:
    from selenium.webdriver.common.keys import Keys

    # The crosshair appears in the middle of the body; Shift and arrows move it; Enter sets a point there.
    page.press(Keys.SHIFT, Keys.ARROW_RIGHT, on="#canvas-x")
    page.press(Keys.SHIFT, Keys.ARROW_UP, on="#canvas-x")
    assert page.find("#crosshair-x").is_displayed()
    box = page.run(
        "const {left, top, width, height} = document.querySelector('#canvas-x').getBoundingClientRect(); return [left, top, width, height]"
    )
    page.press(Keys.ENTER, on="#canvas-x")
    (entry,) = page.entries
    assert near(entry["screen"]["x"], (box[0] + box[2] / 2 + 8, box[1] + box[3] / 2 - 8))
    page.press("a", on="#canvas-x")
    assert page.entries[0]["y"] is not None
    page.press(Keys.SHIFT, Keys.ARROW_DOWN, on="#canvas-x")
    page.press("m", on="#canvas-x")
    assert page.names == ["L1"] and page.entries[0]["x"] != entry["x"]
    for _ in range(4):
        page.press(Keys.SHIFT, Keys.ARROW_DOWN, on="#canvas-x")
    page.press(Keys.ENTER, on="#canvas-x")
    page.press("a", on="#canvas-x")
    assert page.names == ["L1", "L2"] and page.report["selected"] == "L2"
    # The list.
    page.press(Keys.ARROW_UP)
    assert page.report["selected"] == "L1"
    active = page.find("#landmark-list").get_attribute("aria-activedescendant")
    assert page.find(f"#{active} b").text == "L1"
    assert page.find(f"#{active}").get_attribute("aria-selected") == "true"
    page.press(Keys.ENTER)
    page.mouse().send_keys("nose", Keys.ENTER).perform()
    assert page.names == ["nose", "L2"]
    assert page.run("return document.activeElement.id") == "landmark-list"
    page.press(Keys.END)
    page.press(Keys.BACKSPACE)
    assert page.names == ["nose"] and page.report["selected"] == "nose"
    # Letters and deletions in the field of the name are text.
    page.press("a", on="#landmark-name")
    page.press(Keys.BACKSPACE, on="#landmark-name")
    assert page.names == ["nose"]


def test_every_control_of_the_panel_has_a_name_and_shows_the_focus(page: LandmarkPage) -> None:
    from selenium.webdriver.common.keys import Keys

    page.add(0)
    reached: list[str] = []
    page.run("document.querySelector('#canvas-y').focus()")
    for _ in range(20):
        page.mouse().send_keys(Keys.TAB).perform()
        name, outline = page.run(
            "const e = document.activeElement, shown = e.type === 'file' ? e.parentElement : e;"
            "return [e.id || `save-${e.dataset.save}`, getComputedStyle(shown).outlineStyle]"
        )
        if name == "overlay":
            break
        assert outline not in ("none", ""), name
        reached.append(name)
    assert reached == [
        "landmark-suggest", "landmark-undo", "landmark-delete", "landmark-list", "landmark-name",
        "landmark-file-x", "save-x", "landmark-format-x", "landmark-file-y", "save-y", "landmark-format-y",
        "landmark-command", "landmark-copy",
    ]  # fmt: skip
    unnamed = page.run(
        "return [...document.querySelectorAll('#landmarks :is(input, button, select), #registered input')].filter("
        "e => !(e.ariaLabel || e.textContent || e.labels?.[0]?.textContent.trim())).map(e => e.id)"
    )
    assert unnamed == []


def test_names_must_be_unique_and_are_shown_as_text(page: LandmarkPage, tmp_path: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    page.add(0)
    page.add(40)
    field = page.find("#landmark-name")
    for name, problem in (("L1", "Another landmark is named L1"), ("  ", "The name is empty")):
        page.run("arguments[0].value = ''; arguments[0].focus()", field)
        field.send_keys(name, Keys.ENTER)
        assert page.text("landmark-problem").startswith(problem) and page.names == ["L1", "L2"]
    page.run("arguments[0].value = ''; arguments[0].focus()", field)
    field.send_keys(HOSTILE, Keys.ENTER)
    assert page.names == ["L1", HOSTILE] and page.text("landmark-problem") == ""
    assert page.find("#landmark-list li[aria-selected=true] b").text == HOSTILE
    assert page.run("return [document.images.length, window.hacked]") == [0, None]
    # The name survives both formats.
    for value in ("LPS", ""):
        page.run(
            "const e = document.querySelector('#landmark-format-x'); e.value = arguments[0]; e.dispatchEvent(new Event('change'))",
            value,
        )
        saved = page.save("x", tmp_path)
        page.drop("x", {saved.name: saved.read_text("utf-8")})
        assert page.names == ["L1", HOSTILE] and page.text("landmark-problem") == ""


def test_a_typed_name_stays_with_its_landmark(page: LandmarkPage) -> None:
    page.add(0)
    page.add(40)
    page.find("#landmark-name").click()
    page.mouse().send_keys("tail").perform()
    # A press on another marker selects that landmark before the field loses the focus.
    other = page.entries[0]["screen"]["x"]
    page.point_at(round(other["x"]), round(other["y"]), click=True)
    assert page.names == ["L1", "L2tail"] and page.report["selected"] == "L1"
    assert page.find("#landmark-name").get_property("value") == "L1"


def test_the_command_is_copied(page: LandmarkPage) -> None:
    page.add(0)
    page.find("#landmark-copy").click()
    page.settle()
    told = page.text("landmark-status")
    if told != "The command is copied.":  # the browser may refuse access to the clipboard
        assert told.startswith("The command is selected")
        assert page.run("return getSelection().toString().trim()") == page.text("landmark-command")


def test_touch_places_and_drags_on_a_phone_of_360_pixels(browser: Any, page_file: Path) -> None:
    browser.get_log("browser")
    page = LandmarkPage(browser, page_file, width=360, height=740)
    assert page.run("return document.documentElement.scrollWidth") <= 360
    page.tap(*page.between("x", int(visible("x")[0])))
    proposal = page.report["proposal"]
    page.tap(proposal["screen"]["x"], proposal["screen"]["y"])
    (entry,) = page.entries
    assert entry["y"] == proposal["point"]
    start = entry["screen"]["x"]
    camera = page.place("x", int(visible("x")[9]))
    page.touch("touchStart", start["x"] + 9, start["y"])  # a finger does not meet the middle of a marker
    page.touch("touchMove", start["x"] + 15, start["y"] + 8)
    page.touch("touchMove", start["x"] + 20, start["y"] + 16)
    page.touch("touchEnd")
    page.settle()
    (moved,) = page.entries
    assert near(moved["screen"]["x"], (start["x"] + 20, start["y"] + 16))
    assert page.place("x", int(visible("x")[9])) == camera
    for element in browser.find_elements("css selector", "#landmarks *, #registered *"):
        if element.is_displayed():
            box = element.rect
            assert box["x"] >= 0 and box["x"] + box["width"] <= 360, element.get_attribute("outerHTML")
    for element in browser.find_elements("css selector", "#landmarks button, #landmarks select, .button"):
        assert not element.is_displayed() or element.rect["height"] >= 32
    assert browser.get_log("browser") == []


# ---- Files


def parse(path: Path) -> tuple[list[str], np.ndarray]:
    text = path.read_text("utf-8")
    if path.suffix == ".json":
        (markup,) = json.loads(text)["markups"]
        assert markup["type"] == "Fiducial"
        points = markup["controlPoints"]
        assert {point["positionStatus"] for point in points} == {"defined"}
        return [point["label"] for point in points], np.array([point["position"] for point in points])
    head, *lines = text.splitlines()
    assert head == "name,x,y,z"
    rows = [line.split(",") for line in lines]
    return [row[0] for row in rows], np.array([[float(cell) for cell in row[1:]] for row in rows])


@pytest.mark.parametrize("form", ["LPS", "RAS", ""])
def test_saved_files_contain_the_placed_points(page: LandmarkPage, tmp_path: Path, form: str) -> None:
    for rank in (0, 25, 40):
        page.add(rank)
    page.click("x", int(visible("x")[60]))  # half a pair is not saved
    assert page.text("landmark-count").startswith("The files contain 3 landmarks")
    entries = page.entries[:3]
    for side, mesh in MESHES.items():
        page.run(
            "const e = document.querySelector(`#landmark-format-${arguments[0]}`); e.value = arguments[1];"
            "e.dispatchEvent(new Event('change'))",
            side,
            form,
        )
        path = page.save(side, tmp_path)
        stem = {"x": "my_source", "y": "target"}[side]
        assert path.name == f"{stem}-landmarks{'.mrk.json' if form else '.csv'}"
        names, positions = parse(path)
        assert names == ["L1", "L2", "L3"]
        if form:
            assert json.loads(path.read_text())["markups"][0]["coordinateSystem"] == form
        # The saved points are the points on the triangles of the original mesh.
        expected = np.array([on_surface(side, entry[side]) for entry in entries])
        assert np.abs(positions - expected).max() < 1e-7 * diagonal(mesh)
        assert np.array_equal(positions, [entry["positions"][side] for entry in entries])
    suffix = ".mrk.json" if form else ".csv"
    command = shlex.split(page.text("landmark-command"))
    assert command == [
        "jaxsmw", "match", "my source.off", "target.ply", "--init",
        f"landmarks:my_source-landmarks{suffix},target-landmarks{suffix}", "--output", "map.txt",
    ]  # fmt: skip


def test_saved_files_load_again_exactly(page: LandmarkPage, page_file: Path, tmp_path: Path) -> None:
    for rank in (0, 25, 40):
        page.add(rank)
    before = page.entries
    saved = {side: page.save(side, tmp_path) for side in "xy"}
    again = LandmarkPage(page.browser, page_file, width=1100, height=700)
    assert again.entries == []
    again.drop("x", {saved["x"].name: saved["x"].read_bytes()})
    assert again.names == ["L1", "L2", "L3"] and "only on the source" in again.text("landmark-list")
    # The button loads files as well.
    again.find("#landmark-file-y").send_keys(str(saved["y"]))
    again.settle()
    again.settle()
    assert "3 of them on both bodies; coordinates LPS, used as they are" in again.text("landmark-status")
    for old, new in zip(before, again.entries, strict=True):
        for side, mesh in MESHES.items():
            off = np.subtract(old["positions"][side], new["positions"][side])
            assert np.abs(off).max() < 1e-7 * diagonal(mesh)
    assert not any(entry["notes"].get(side) for entry in again.entries for side in "xy")


def markups(names: list[str], positions: np.ndarray, system: str | None = "LPS", **point: Any) -> str:
    points = [
        {"label": name, "position": list(position)} | point
        for name, position in zip(names, positions.tolist(), strict=True)
    ]
    header = {} if system is None else {"coordinateSystem": system}
    return json.dumps({"markups": [{"type": "Fiducial", "controlPoints": points} | header]})


def table(names: list[str], positions: np.ndarray, separator: str = ",", head: str = "name,x,y,z\n") -> str:
    rows = [
        separator.join([name, *map(repr, place)])
        for name, place in zip(names, positions.tolist(), strict=True)
    ]
    return head + "\n".join(rows) + "\n"


def fcsv(names: list[str], positions: np.ndarray) -> str:
    rows = [
        f"vtk_{name},{x!r},{y!r},{z!r},0,0,0,1,1,1,0,{name},,"
        for name, (x, y, z) in zip(names, positions.tolist(), strict=True)
    ]
    header = "# Markups fiducial file version = 4.11\n# CoordinateSystem = 0\n"
    return (
        header
        + "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
        + "\n".join(rows)
    )


def picked_points(names: list[str], positions: np.ndarray) -> str:
    points = "".join(
        f'<point x="{x!r}" y="{y!r}" z="{z!r}" active="1" name="{name}"/>'
        for name, (x, y, z) in zip(names, positions.tolist(), strict=True)
    )
    return f"<!DOCTYPE PickedPoints><PickedPoints>{points}</PickedPoints>"


FILES = {
    "a.mrk.json": markups,
    "b.fcsv": fcsv,
    "c.csv": table,
    "d.txt": lambda names, positions: "\ufeff" + table(names, positions, " ", ""),
    "e.CSV": lambda names, positions: table(names, positions, ";", "").replace("\n", "\r\n"),
    "f.txt": lambda names, positions: table(names, positions, "\t", "name\tx\ty\tz\n"),
    "g.pp": picked_points,
}


@pytest.mark.parametrize("name", FILES)
def test_files_are_matched_by_name(page: LandmarkPage, name: str) -> None:
    names = ["nose", "tail", "left"]
    vertices = visible("x")[[0, 25, 40]]
    page.drop("x", {name: FILES[name](names, SOURCE.vertices[vertices])})
    page.drop(
        "y",
        {name: FILES[name]([*names[::-1], "more"], TARGET.vertices[[*NUMBER[vertices[::-1]], 0]])},
    )
    assert page.text("landmark-problem") == ""
    assert page.names == ["nose", "tail", "left", "more"]
    for entry, vertex in zip(page.entries, vertices, strict=False):
        for side, mesh, at in (("x", SOURCE, vertex), ("y", TARGET, NUMBER[vertex])):
            assert np.linalg.norm(entry["positions"][side] - mesh.vertices[at]) < 1e-6 * diagonal(mesh)
    assert "4 landmarks on the target, 3 of them on both bodies" in page.text("landmark-status")
    assert "leave out 1" in page.text("landmark-count")
    system = {"a.mrk.json": "LPS", "b.fcsv": "RAS"}.get(name, "LPS")
    assert page.find("#landmark-format-y").get_property("value") == system


def test_undefined_points_are_left_out_and_far_points_get_a_note(page: LandmarkPage) -> None:
    positions = SOURCE.vertices[visible("x")[:4]].copy()
    positions[2] += 0.04 * diagonal(SOURCE) * SOURCE.vertex_normals[visible("x")[2]]
    content = json.loads(markups(["a", "b", "c", "d"], positions))
    content["markups"][0]["controlPoints"][3]["positionStatus"] = "undefined"
    page.drop("x", {"some.mrk.json": json.dumps(content)})
    assert page.names == ["a", "b", "c"]
    assert "1 lay off the surface" in page.text(
        "landmark-status"
    ) and "1 without a defined position" in page.text("landmark-status")
    note = page.entries[2]["notes"]["x"]
    told = re.fullmatch(r"moved (\S+) \((\S+) % of the diagonal\) to the source", note)
    assert told and float(told[1]) == pytest.approx(0.04 * diagonal(SOURCE), rel=0.02)
    assert float(told[2]) == pytest.approx(4, rel=0.03) and note in page.text("landmark-list")


def test_a_flip_of_the_coordinate_system_is_suggested_and_never_silent(page: LandmarkPage) -> None:
    vertices = visible("x")[[0, 25, 40]]
    flipped = SOURCE.vertices[vertices] * [-1, -1, 1]
    page.drop("x", {"ras.mrk.json": markups(["a", "b", "c"], flipped, "RAS")})
    problem = page.text("landmark-problem")
    assert (
        problem.startswith("ras.mrk.json: as written, in RAS, the landmarks lie ")
        and "LPS and RAS" in problem
    )
    assert page.names == []
    page.find("#landmark-flip").click()
    assert page.names == ["a", "b", "c"] and page.text("landmark-problem") == ""
    found = np.array([entry["positions"]["x"] for entry in page.entries])
    assert np.abs(found - SOURCE.vertices[vertices]).max() < 1e-6 * diagonal(SOURCE)
    assert page.find("#landmark-format-x").get_property("value") == "LPS"
    assert not page.find("#landmark-question").is_displayed()
    # If a flip does not help, the page does not offer it.
    page.drop("x", {"metres.csv": table(["a", "b", "c"], SOURCE.vertices[vertices] / 1000)})
    assert "the same unit" in page.text("landmark-problem")
    assert not page.find("#landmark-flip").is_displayed()
    page.find("#landmark-as-written").click()
    assert page.names == ["a", "b", "c"] and "3 lay off the surface" in page.text("landmark-status")


ONE = np.zeros((1, 3))
BAD_FILES: dict[str, tuple[str | bytes, str]] = {
    "mesh.off": ("OFF", "not a landmark file"),
    "no suffix": ("a,1,2,3", "not a landmark file"),
    "empty.csv": ("", "no landmarks"),
    "header.csv": ("name,x,y,z\n", "no landmarks"),
    "two columns.csv": ("a,1\n", "row 1 has 2 columns"),
    "five columns.csv": ("a,1,2,3\nb,1,2,3,4\n", "row 2 has 5 columns"),
    "words.csv": ("a,1,2,3\nb,one,2,3\n", "landmark 2 does not have three finite coordinates"),
    "nan.csv": ("a,1,2,3\nb,nan,2,3\n", "three finite coordinates"),
    "huge.csv": ("a,1e999,2,3\n", "three finite coordinates"),
    "double.csv": ("a,1,2,3\na,4,5,6\n", "two landmarks are named a"),
    "many.csv": ("1,2,3\n" * 1001, "1001 landmarks"),
    "nul.csv": ("a,1,2,3\0\n", "not text in UTF-8"),
    "utf16.csv": ("a,1,2,3\n".encode("utf-16"), "not text in UTF-8"),
    "latin.csv": ("é,1,2,3\n".encode("latin-1"), "not text in UTF-8"),
    "cut.mrk.json": (markups(["a"], ONE)[:-9], "not valid JSON"),
    "list.mrk.json": ("[1, 2]", "0 lists of control points"),
    "null.mrk.json": ("null", "0 lists of control points"),
    "two.mrk.json": (json.dumps({"markups": json.loads(markups(["a"], ONE))["markups"] * 2}), "2 lists"),
    "text.mrk.json": ('{"markups": [{"controlPoints": "abc"}]}', "not a list"),
    "string.mrk.json": ('{"markups": [{"controlPoints": [{"position": ["1", 2, 3]}]}]}', "three finite"),
    "none.mrk.json": ('{"markups": [{"controlPoints": [null]}]}', "three finite"),
    "system.mrk.json": (markups(["a"], ONE, "XYZ"), "the coordinate system is XYZ"),
    "all undefined.mrk.json": (markups(["a"], ONE, positionStatus="undefined"), "no landmarks"),
    "short.fcsv": ("vtk_1,1,2\n", "three finite coordinates"),
    "system.fcsv": ("# CoordinateSystem = 7\n", "the coordinate system is 7"),
    "cut.pp": ("<PickedPoints><point x='1'", "not valid XML"),
    "bomb.pp": ('<!DOCTYPE p [<!ENTITY a "aa">]><p>&a;</p>', "entities"),
    "empty.pp": ("<PickedPoints/>", "no landmarks"),
    "words.pp": ("<p><point name='a' x='1' y='' z='3'/></p>", "three finite"),
    f"{HOSTILE.replace('/', '')}.csv": ("a,1\n", "row 1 has 2 columns"),
}


def test_bad_files_give_one_sentence_and_change_nothing(page: LandmarkPage) -> None:
    page.add(0)
    before = page.entries
    for name, (content, fault) in BAD_FILES.items():
        page.drop("x", {name: content})
        for _ in range(20):
            problem = page.text("landmark-problem")
            if problem.startswith(f"{name}: "):
                break
            page.settle()
        assert problem.startswith(f"{name}: ") and fault in problem and problem.endswith("."), (name, problem)
        assert problem.count(". ") == 0 and "\n" not in problem
        assert page.entries == before
    page.drop("y", {"a.csv": "a,1,2,3", "b.csv": "a,1,2,3"})
    assert page.text("landmark-problem").startswith("2 files were dropped on the target")
    assert page.run("return [document.images.length, window.hacked]") == [0, None]
    page.add(40)
    assert page.text("landmark-problem") == ""


# ---- Suggestions, the registered source and help


def along_edges(vertices: list[int]) -> np.ndarray:
    """Return the distances along edges from source vertices to all source vertices."""
    i, j = SOURCE.edges.T
    lengths = np.linalg.norm(SOURCE.vertices[i] - SOURCE.vertices[j], axis=1)
    graph = coo_array((lengths, (i, j)), shape=(len(SOURCE.vertices),) * 2)
    return np.asarray(dijkstra(graph.tocsr(), directed=False, indices=vertices))


def test_landmarks_are_suggested_where_the_expected_error_is_high(page: LandmarkPage) -> None:
    start = page.place("x", WEAK)
    found = []
    for _ in range(3):
        page.find("#landmark-suggest").click()
        suggestion = page.report["suggestion"]
        found.append(suggestion["vertex"])
        assert f"source vertex {suggestion['vertex']}" in page.text("landmark-status")
        # The camera turns until the hollow marker faces the viewer.
        screen = page.report["proposal"]["screen"]
        assert page.report["proposal"]["side"] == "x"
        box = page.run(
            "const r = document.querySelector('#canvas-x').getBoundingClientRect(); return [r.x, r.right, r.y, r.bottom]"
        )
        assert box[0] < screen["x"] < box[1] and box[2] < screen["y"] < box[3]
    distance = np.linalg.norm(SOURCE.vertices[found] - SOURCE.vertices[WEAK], axis=1) / diagonal(SOURCE)
    assert distance[0] < 0.04, "the first suggestion is in the middle of the weak part"
    assert along_edges(found)[:, found][np.triu_indices(3, 1)].min() > 0.12 * diagonal(SOURCE)
    assert page.place("x", WEAK) != start
    page.press("a")
    (entry,) = page.entries
    assert np.allclose(entry["positions"]["x"], SOURCE.vertices[found[-1]], atol=1e-5 * diagonal(SOURCE))
    assert page.report["proposal"]["side"] == "y"


def test_suggestions_keep_away_from_landmarks_and_come_to_an_end(page: LandmarkPage) -> None:
    page.drop("x", {"a.csv": table(["a"], SOURCE.vertices[[WEAK]])})
    found = []
    for _ in range(200):
        page.find("#landmark-suggest").click()
        if not page.report["suggestion"]:
            break
        found.append(page.report["suggestion"]["vertex"])
    assert len(found) > 5 and page.text("landmark-status").startswith("There are no further suggestions")
    between = along_edges([WEAK, *found])[:, [WEAK, *found]]
    assert between[np.triu_indices(len(between), 1)].min() > 0.12 * diagonal(SOURCE)


def test_without_expected_errors_there_is_no_suggestion(browser: Any, tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", SOURCE, TARGET, {"map": ShownMap(NUMBER)}, title="Two")
    page = LandmarkPage(browser, tmp_path / "page.html", width=1100, height=700)
    assert not page.find("#landmark-suggest").is_displayed()
    assert not page.find("#registered").is_displayed()
    page.add(0)
    assert page.names == ["L1"]


def test_the_slider_moves_the_source_onto_the_target(page: LandmarkPage) -> None:
    page.find("#landmark-mode").click()
    plain = page.view("y")
    page.find("#overlay").click()
    views = []
    for share in (0, 50, 100):
        page.run(
            "const e = document.querySelector('#blend'); e.value = arguments[0]; e.dispatchEvent(new Event('input'))",
            share,
        )
        views.append(page.view("y"))
    assert all(differ(a, b) > 0.03 for a, b in pairwise(views))
    # The registered source covers the target exactly and has the same colours.
    assert differ(plain, views[2]) < 0.02 < differ(plain, views[0])
    page.press("\ue012", on="#blend")  # the left arrow key
    assert page.find("#blend").get_attribute("aria-valuetext") == "99 % registered"
    page.choose("plain")
    assert differ(views[2], page.view("y")) > 0.1
    page.choose("transfer")
    page.find("#overlay").click()
    assert differ(plain, page.view("y")) == 0 and not page.find("#blend").is_enabled()


@pytest.mark.parametrize("width", [360, 1100])
def test_help_opens_and_closes(browser: Any, page_file: Path, width: int) -> None:
    from selenium.webdriver.common.keys import Keys

    page = OpenPage(browser, page_file, width=width, height=740)
    dialog = page.find("#help")
    assert not dialog.is_displayed()
    page.find("#help-open").send_keys(Keys.ENTER)
    page.settle()
    assert dialog.is_displayed()
    box = dialog.rect
    assert box["x"] >= 0 and box["x"] + box["width"] <= width and box["height"] <= 740
    assert page.run("const d = arguments[0]; return d.scrollWidth - d.clientWidth", dialog) == 0
    text = dialog.text
    for option in (
        "--alternatives 3", "--partial", "--scale unknown", "--weld", "--mirror", "unit",
        "--init landmarks:SOURCE_FILE,TARGET_FILE",
    ):  # fmt: skip
        assert option in text
    page.mouse().send_keys(Keys.ESCAPE).perform()
    assert not dialog.is_displayed()
    page.find("#help-open").click()
    page.find("#help button").click()
    assert not dialog.is_displayed()
