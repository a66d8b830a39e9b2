"""Parsers of `.pp` files of MeshLab and `.mps` files of MITK (XML), and a writer of `.pp` files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import NoReturn
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.text import export_again, is_number
from jaxsmw.io.landmarks import Landmarks, PointList, check_count

# These limits are far above what any file of points needs. They prevent a malicious file from using gigabytes
# of memory.
_DEEPEST, _LONGEST_TAG = 20, 2**16

# Functions that are called at the beginning and at the end of an element. Their first argument lists the
# names of all ancestors, followed by the name of the element. Their second argument contains the attributes
# or the text.
_OnStart = Callable[[list[str], dict[str, str]], None]
_OnText = Callable[[list[str], str], None]


def _parse_xml(text: str, root: str, on_start: _OnStart, on_text: _OnText | None = None) -> None:
    """Parse XML whose outermost element is `root`, and call a function for each element.

    When an element begins, `on_start` receives its attributes. When an element ends, `on_text` receives its
    text. If the element has children, only the text after the last child is included.
    """
    if re.search(f"<[^<]{{{_LONGEST_TAG}}}", text):
        raise export_again(f"has an element of more than {_LONGEST_TAG} characters", "points")
    # A point of MITK consists of five elements, each with a beginning and an end.
    check_count(max(text.count("<point "), text.count("<point>"), text.count("<") // 16))
    path: list[str] = []
    pieces: list[str] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        if not path and name != root:
            raise InputError(f"is not a {root} file, because it begins with {name[:40]!a}: check the suffix.")
        if len(path) == _DEEPEST:
            raise export_again(f"has more than {_DEEPEST} nested elements", "points")
        path.append(name)
        pieces.clear()
        on_start(path, attributes)

    def end(name: str) -> None:
        if on_text is not None:
            on_text(path, "".join(pieces).strip())
        pieces.clear()
        path.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = _check_doctype
    if on_text is not None:
        parser.CharacterDataHandler = pieces.append
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise InputError(
            f"is not a complete XML file (the error is in line {error.lineno}): export the points again."
        ) from None


def _check_doctype(name: str, system: str | None, public: str | None, has_declarations: int) -> None:
    """Refuse declarations of entities, which can expand to gigabytes. MeshLab's DOCTYPE has none."""
    if has_declarations or system is not None or public is not None:
        raise InputError("has a DOCTYPE with declarations, which are not read: remove the DOCTYPE.")


def parse_picked_points(text: str) -> Landmarks:
    """Parse a `.pp` file of MeshLab (PickedPoints), without the points that nobody has placed."""
    points = PointList("point")

    def on_start(path: list[str], attributes: dict[str, str]) -> None:
        if path[1:] != ["point"]:
            return
        if attributes.get("active", "1").strip() == "0":
            points.leave_out()
            return
        _check_keys(attributes, "xyz", points.next)
        position = [attributes[axis].strip() for axis in "xyz"]
        points.add(attributes.get("name", "").strip(), position)

    _parse_xml(text, "PickedPoints", on_start)
    return points.landmarks(why_left_out="they are not active in MeshLab")


def _check_keys(point: dict[str, str], keys: Iterable[str], number: int) -> None:
    for key in keys:
        if key not in point:
            _refuse(number, f"has no {key}")


def _refuse(number: int, fault: str) -> NoReturn:
    raise export_again(f"point {number} {fault}", "points")


def format_picked_points(landmarks: Landmarks) -> str:
    """Return landmarks as a `.pp` file of MeshLab, which states no coordinate system."""
    points = "".join(
        f' <point x="{x!r}" y="{y!r}" z="{z!r}" active="1" name={quoteattr(name)}/>\n'
        for name, (x, y, z) in zip(landmarks.names, landmarks.positions.tolist(), strict=True)
    )
    head = ' <DocumentData>\n  <templateName name=""/>\n </DocumentData>\n'
    return f"<!DOCTYPE PickedPoints>\n<PickedPoints>\n{head}{points}</PickedPoints>\n"


def parse_point_set(text: str) -> Landmarks:
    """Parse an `.mps` file of MITK (PointSetReaderService in MITK's source code).

    The file contains index coordinates, and its element Geometry3D takes them to world coordinates. MITK's
    world coordinates (https://docs.mitk.org/2024.12/GeometryOverviewPage.html) are the physical coordinates
    of ITK and DICOM, which are LPS in mm. The points have no names, so each point is named by its 1-based
    number. This number is `id` + 1, because MITK counts from 0.
    """
    points: list[dict[str, str]] = []
    geometry: dict[str, dict[str, str]] = {}
    sets = {"point_set": 0, "time_series": 0}

    def on_start(path: list[str], attributes: dict[str, str]) -> None:
        if path[-1] in sets:
            sets[path[-1]] += 1
        elif path[-1] == "point":
            points.append({})
        elif path[-2:-1] == ["Geometry3D"]:
            geometry[path[-1]] = attributes

    def on_text(path: list[str], content: str) -> None:
        if path[-2:-1] == ["point"] and points[-1].setdefault(path[-1], content) != content:
            _refuse(len(points), f"states its {path[-1][:40]!a} twice")

    _parse_xml(text, "point_set_file", on_start, on_text)
    if max(sets.values()) > 1:
        raise InputError("contains several point sets or time steps: save each in its own file.")
    named = PointList("point")
    for number, point in enumerate(points, start=1):
        _check_keys(point, ("id", "x", "y", "z"), number)
        if not re.fullmatch("[0-9]{1,9}", point["id"]):
            _refuse(number, f"has the id {point['id'][:40]!a}, which is not a whole number")
        named.add(str(int(point["id"]) + 1), [point[axis] for axis in "xyz"])
    if not geometry:
        return named.landmarks("LPS")
    matrix, offset = _index_to_world(geometry)
    with np.errstate(all="ignore"):
        positions = named.positions() @ matrix.T + offset
    return named.landmarks("LPS", positions=positions)


def _index_to_world(
    geometry: dict[str, dict[str, str]],
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """Return the matrix and the offset that take index coordinates to world coordinates."""
    matrix, offset = geometry.get("IndexToWorld", {}), geometry.get("Offset", {})
    words = [matrix.get(f"m_{row}_{column}", "") for row in range(3) for column in range(3)]
    words += [offset.get(axis, "") for axis in "xyz"]
    if not all(is_number(word) for word in words):
        raise export_again("the Geometry3D lacks a number in IndexToWorld or Offset", "points")
    values = np.array(words, dtype=np.float64)
    return values[:9].reshape(3, 3), values[9:]
