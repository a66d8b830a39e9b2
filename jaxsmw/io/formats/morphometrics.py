"""Parsers and writers of landmarks in the files of morphometrics and of statistical shape models.

- `.tps` of tpsDig (https://sbmorphometrics.org) and geomorph, with one specimen and three coordinates.
- `.nts` of NTSYS and geomorph.
- `.pts` of IDAV Landmark, and the `.pts` of faces (iBUG).
- `.json` of Scalismo.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.landmark_tables import parse_table
from jaxsmw.io.formats.markups import parse_json, parse_markups
from jaxsmw.io.formats.polygons import unique_names
from jaxsmw.io.formats.text import export_again, is_number
from jaxsmw.io.landmarks import Landmarks, PointList, check_count
from jaxsmw.wording import count_of

# Landmark, and Morpho after it, write this number for a coordinate that is missing.
_MISSING = 9999.0
_WHY_LEFT_OUT = "the file marks their positions as missing"


def parse_tps(text: str) -> Landmarks:
    """Parse a `.tps` file with the landmarks of one specimen. They have no names."""
    lines = _filled(text)
    starts = [i for i, (_, line) in enumerate(lines) if re.match(r"LM3?\s*=", line, re.IGNORECASE)]
    if not starts:
        raise InputError("has no line LM3=NUMBER, so it is not a .tps file: export the landmarks again.")
    if len(starts) > 1:
        raise InputError(
            f"contains {len(starts)} specimens: save the landmarks of each specimen in its own file."
        )
    number, line = lines[starts[0]]
    count = _count(line.partition("=")[2], number)
    rows = lines[starts[0] + 1 : starts[0] + 1 + count]
    points = PointList("line")
    for number, line in rows:
        _add(points, number, "", line.split())
    if len(rows) < count:
        raise _truncated(count, len(rows))
    rest = [line.partition("=")[0].strip().upper() for _, line in lines[starts[0] + 1 + count :]]
    if rest and is_number(rest[0].split()[0]):
        raise export_again(f"has more than the declared {count_of(count, 'landmark')}", "landmarks")
    notes = tuple(f"The lines {key} were ignored." for key in ("SCALE", "CURVES") if key in rest)
    return points.landmarks(notes=notes, why_left_out=_WHY_LEFT_OUT)


def format_tps(landmarks: Landmarks) -> str:
    return format_specimens(["0"], landmarks.positions[None])


def format_specimens(names: Sequence[str], positions: Float64[np.ndarray, "N l 3"]) -> str:
    """Return the text of a `.tps` file with the positions of l landmarks on N specimens, which have names."""
    blocks = []
    for name, points in zip(names, positions.tolist(), strict=True):
        rows = "\n".join(" ".join(map(repr, position)) for position in points)
        blocks.append(f"LM3={len(points)}\n{rows}\nID={name}\n")
    return "\n".join(blocks)


def parse_nts(text: str) -> Landmarks:
    """Parse an NTSYS matrix with a row for each landmark, or with one row for all landmarks of a specimen.

    The header contains the kind of matrix, the numbers of rows and columns, and 1 with a number for missing
    values, or 0. The letter L after a number of rows announces names.
    """
    lines = [(number, line) for number, line in _filled(text) if not line.startswith(('"', "'"))]
    header = lines[0][1].split() if lines else []
    named = re.fullmatch(r"(\d{1,9})(L?)", header[1], re.IGNORECASE) if len(header) > 3 else None
    columns = re.fullmatch(r"(\d{1,9})L?", header[2], re.IGNORECASE) if named else None
    if header[:1] != ["1"] or not named or not columns:
        raise InputError(
            "does not begin with the header of an NTSYS matrix, such as '1 20 3 0 dim=3': export the "
            "landmarks again."
        )
    rows, width = int(named[1]), int(columns[1])
    dimension = re.search(r"dim\s*=\s*(\d+)", lines[0][1], re.IGNORECASE)
    if dimension and dimension[1] != "3":
        raise InputError(f"has landmarks with {dimension[1]} coordinates: give landmarks with three.")
    is_specimen = width != 3
    if is_specimen and (rows != 1 or width % 3):
        raise InputError(
            f"contains {count_of(rows, 'row')} of {count_of(width, 'number')}: save the landmarks of each "
            "specimen in its own file, with three coordinates per landmark."
        )
    missing = header[4] if header[3] == "1" and len(header) > 4 else ""
    words = [(number, word) for number, line in lines[1:] for word in line.split()]
    labels = [word for _, word in words[: rows * bool(named[2])]]
    values = words[len(labels) :]
    if len(values) != rows * width:
        raise _truncated(rows * width // 3, len(values) // 3)
    points = PointList("line")
    for i in range(0, len(values), 3):
        name = labels[i // 3] if labels and not is_specimen else ""
        position = [word for _, word in values[i : i + 3]]
        if missing and missing in position:
            points.leave_out()
        else:
            points.add(name, position, values[i][0])
    return points.landmarks(why_left_out=_WHY_LEFT_OUT)


def format_nts(landmarks: Landmarks) -> str:
    names = words_of(landmarks.names)
    rows = "\n".join(" ".join(map(repr, position)) for position in landmarks.positions.tolist())
    return f"1 {len(names)}L 3 0 dim=3\n{' '.join(names)}\n{rows}\n"


def parse_pts(text: str) -> Landmarks:
    """Parse a `.pts` file of Landmark, of a face, or a table without a header."""
    lines = _filled(text)
    head = lines[0][1].lower()
    if re.match(r"version\s*:", head):
        return _parse_face(lines)
    if not head.startswith("version"):
        return parse_table(text)
    count = _count(lines[1][1] if len(lines) > 1 else "", 2)
    if len(lines) - 2 != count:
        raise _truncated(count, len(lines) - 2)
    points = PointList("line")
    for number, line in lines[2:]:
        name, *position = line.split()
        _add(points, number, name, position)
    return points.landmarks(why_left_out=_WHY_LEFT_OUT)


def _parse_face(lines: list[tuple[int, str]]) -> Landmarks:
    """Parse `n_points: NUMBER` and the positions between braces."""
    content = [line for _, line in lines]
    if content.count("{") != 1 or content[-1] != "}":
        raise export_again("has no list of points between braces, so the file is damaged", "landmarks")
    first = content.index("{")
    declared = next((line for line in content[:first] if line.lower().startswith("n_points")), "")
    count = _count(declared.partition(":")[2], 2)
    rows = lines[first + 1 : -1]
    if len(rows) != count:
        raise _truncated(count, len(rows))
    points = PointList("line")
    for number, line in rows:
        _add(points, number, "", line.split())
    return points.landmarks(why_left_out=_WHY_LEFT_OUT)


def format_pts(landmarks: Landmarks) -> str:
    """Return a file of Landmark."""
    rows = [
        f"{name} {' '.join(map(repr, position))}"
        for name, position in zip(words_of(landmarks.names), landmarks.positions.tolist(), strict=True)
    ]
    return "\n".join(["Version 1.0", str(len(rows)), *rows, ""])


def parse_scalismo(text: str) -> Landmarks:
    """Parse a list of objects with `id` and `coordinates`, or a file of 3D Slicer with the suffix `.json`."""
    document = parse_json(text)
    if isinstance(document, dict) and "markups" in document:
        return parse_markups(text)
    if not isinstance(document, list) or not all(isinstance(point, dict) for point in document):
        raise InputError(
            "contains neither a list of landmarks of Scalismo nor a Markups file of 3D Slicer: export the "
            "landmarks again."
        )
    points = PointList("landmark")
    for number, point in enumerate(document, start=1):
        name, position = point.get("id", ""), point.get("coordinates")
        if not isinstance(name, str):
            raise export_again(f"landmark {number} has an id that is not text", "landmarks")
        if not isinstance(position, list) or [type(value) for value in position] != [float] * 3:
            raise export_again(
                f"landmark {number} has coordinates that are not a list of three numbers", "landmarks"
            )
        points.add(name.strip(), position)
    return points.landmarks()


def format_scalismo(landmarks: Landmarks) -> str:
    points = [
        {"id": name, "coordinates": position}
        for name, position in zip(landmarks.names, landmarks.positions.tolist(), strict=True)
    ]
    return json.dumps(points, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _filled(text: str) -> list[tuple[int, str]]:
    """Return the lines that are not blank, without surrounding blanks, and their 1-based numbers."""
    lines = re.split("\r\n|\r|\n", text)
    check_count(len(lines) // 2)
    return [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]


def _count(word: str, number: int) -> int:
    if not re.fullmatch(r"\s*\d{1,9}\s*", word, re.ASCII):
        raise export_again(f"line {number} does not state the number of landmarks", "landmarks")
    return int(word)


def _add(points: PointList, number: int, name: str, position: Sequence[str]) -> None:
    """Add a point, or leave it out if its position is missing."""
    if len(position) != 3:
        raise InputError(
            f"line {number} has {count_of(len(position), 'coordinate')} instead of three: give landmarks of "
            "a mesh, not of a picture."
        )
    if all(is_number(word) and float(word) == _MISSING for word in position) or "nan" in map(
        str.lower, position
    ):
        points.leave_out()
    else:
        points.add(name, position, number)


def _truncated(declared: int, found: int) -> InputError:
    return export_again(
        f"declares {count_of(declared, 'landmark')}, but contains {found}, so the file is damaged",
        "landmarks",
    )


def words_of(names: Iterable[str]) -> list[str]:
    """Return names as words of tables in which blanks separate the cells, with underscores."""
    words = unique_names(re.sub(r"[\s\"']", "_", name) for name in names)
    return [word.replace(" ", "_") for word in words]
