"""Parser and writer of landmarks in the Markups files (`.mrk.json`) of 3D Slicer.

The format is version 1.0.3 of the Markups schema
(https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json).
"""

from __future__ import annotations

import json
from typing import Any, NoReturn

from jaxsmw.choices import CoordinateSystem
from jaxsmw.errors import InputError
from jaxsmw.io.formats.landmark_tables import SYSTEMS
from jaxsmw.io.formats.text import export_again
from jaxsmw.io.landmarks import Landmarks, PointList
from jaxsmw.wording import count_of

_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
_NOT_DEFINED = ("undefined", "preview", "missing")


def parse_markups(text: str) -> Landmarks:
    """Parse the control points of a Markups file. The file must contain a single list of points."""
    markup = _single_list(parse_json(text))
    coordinates, notes = _coordinate_system(markup)
    unit = markup.get("coordinateUnits")
    if unit is not None and not isinstance(unit, str):
        unit, notes = None, (*notes, "The unit of the coordinates was ignored, because it is not text.")
    control_points = markup.get("controlPoints", [])
    if not isinstance(control_points, list):
        raise export_again("controlPoints is not a list", "markups")
    points = PointList("control point")
    for number, point in enumerate(control_points, start=1):
        if not isinstance(point, dict):
            _refuse(number, "is not an object")
        if not _is_defined(point, number):
            points.leave_out()
            continue
        label, position = point.get("label", ""), point.get("position")
        if not isinstance(label, str):
            _refuse(number, "has a label that is not text")
        # All numbers are floats here, because `parse_json` also parses integers as floats.
        if not isinstance(position, list) or [type(value) for value in position] != [float] * 3:
            _refuse(number, "has a position that is not a list of three numbers")
        points.add(label.strip(), position)
    return points.landmarks(
        coordinates, notes=notes, why_left_out="Slicer has no defined position for them", unit=unit
    )


def parse_json(text: str) -> Any:
    """Parse JSON with all numbers as floats, and refuse objects that repeat a key."""
    try:
        # Integers become floats, because `int` refuses integers with many digits. Deep nesting causes a
        # RecursionError.
        return json.loads(text, parse_int=float, object_pairs_hook=_object)
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        place = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise InputError(
            f"is not a complete JSON file (the error is{place or ' its depth'}): export the markups again."
        ) from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    properties = dict(pairs)
    if len(properties) < len(pairs):
        raise export_again("states a property twice, so its meaning is not clear", "markups")
    return properties


def _single_list(document: Any) -> dict[str, Any]:
    """Check that a file contains one markup, and that the markup is a point list. Return the markup."""
    markups = document.get("markups") if isinstance(document, dict) else None
    if not isinstance(markups, list) or not all(isinstance(markup, dict) for markup in markups):
        raise InputError("is not a Markups file of 3D Slicer: export a point list as .mrk.json.")
    if len(markups) != 1:
        raise InputError(
            f"contains {count_of(len(markups), 'markup')} instead of one point list: save each point list in "
            "its own file."
        )
    kind = markups[0].get("type")
    if kind != "Fiducial":
        raise InputError(
            f"contains a markup of the type {_excerpt(kind)}: convert it to a point list "
            "(type 'Fiducial') in 3D Slicer."
        )
    return markups[0]


def _coordinate_system(markup: dict[str, Any]) -> tuple[CoordinateSystem, tuple[str, ...]]:
    """Return the coordinate system of a markup, and notes. If the markup states no system, LPS applies."""
    if "coordinateSystem" not in markup:
        return "LPS", ("The file states no coordinate system, so LPS applies, the default of the format.",)
    stated = markup["coordinateSystem"]
    if not isinstance(stated, str) or stated not in SYSTEMS:
        raise export_again(
            f"the coordinate system {_excerpt(stated)} is neither LPS (1) nor RAS (0)", "markups"
        )
    return SYSTEMS[stated], ()


def _is_defined(point: dict[str, Any], number: int) -> bool:
    """Return whether a control point has a defined position. A position without a status is defined."""
    status = point.get("positionStatus", "defined")
    if status != "defined" and status not in _NOT_DEFINED:
        _refuse(number, f"has the unknown position status {_excerpt(status)}")
    return status == "defined"


def _excerpt(value: Any) -> str:
    """Return the first 40 characters of a text, or the type of any other value, for an error message."""
    return ascii(value[:40]) if isinstance(value, str) else f"that is a {type(value).__name__}"


def _refuse(number: int, fault: str) -> NoReturn:
    raise export_again(f"control point {number} {fault}", "markups")


def format_markups(landmarks: Landmarks) -> str:
    """Return a Markups file with one point per line. Without a unit in the file, Slicer assumes mm."""
    # The orientation is the identity in Slicer's RAS axes, so two of its entries are negative in LPS axes.
    sign = -1.0 if landmarks.coordinates == "LPS" else 1.0
    points = [
        {
            "id": str(number),
            "label": name,
            "description": "",
            "associatedNodeID": "",
            "position": position,
            "orientation": [sign, 0.0, 0.0, 0.0, sign, 0.0, 0.0, 0.0, 1.0],
            "selected": True,
            "locked": False,
            "visibility": True,
            "positionStatus": "defined",
        }
        for number, (name, position) in enumerate(
            zip(landmarks.names, landmarks.positions.tolist(), strict=True), start=1
        )
    ]
    markup: dict[str, Any] = {
        "type": "Fiducial",
        "coordinateSystem": landmarks.coordinates,
        **({} if landmarks.unit is None else {"coordinateUnits": landmarks.unit}),
        "locked": False,
        "fixedNumberOfControlPoints": False,
        "labelFormat": "%N-%d",
        "lastUsedControlPointNumber": len(points),
        "controlPoints": [],
    }
    text = json.dumps({"@schema": _SCHEMA, "markups": [markup]}, indent=2)
    lines = ",\n".join(json.dumps(point, ensure_ascii=False, allow_nan=False) for point in points)
    return text.replace('"controlPoints": []', f'"controlPoints": [\n{lines}\n]') + "\n"
