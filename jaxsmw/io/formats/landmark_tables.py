"""Parsers and writers of landmarks in tables: `.csv` and `.txt` files, and the `.fcsv` files of 3D Slicer.

Python's module `csv` splits the lines into cells, and leaves every cell as text.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from typing import NamedTuple

from jaxsmw.choices import CoordinateSystem
from jaxsmw.errors import InputError
from jaxsmw.io.formats.text import export_again, is_number
from jaxsmw.io.landmarks import Landmarks, PointList, check_count
from jaxsmw.wording import count_of

SYSTEMS: dict[str, CoordinateSystem] = {"LPS": "LPS", "1": "LPS", "RAS": "RAS", "0": "RAS"}
"""The names of coordinate systems in files of 3D Slicer, which used numbers before version 4.11."""

_NAME_COLUMNS = ("name", "label", "landmark", "id", "point", "")
_LONGEST_LINE = 2**16
_FCSV_COLUMNS = ["id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label", "desc"]
_FCSV_COLUMNS += ["associatedNodeID"]


class _Columns(NamedTuple):
    """The number of columns of a table, the 0-based columns of x, y and z, and that of the names if any."""

    total: int
    positions: list[int]
    name: int | None

    def add_to(self, points: PointList, line: int, cells: list[str]) -> None:
        """Add the point in a row of the table."""
        name = "" if self.name is None else cells[self.name]
        points.add(name, [cells[column] for column in self.positions], line)


def parse_table(text: str) -> Landmarks:
    """Parse rows of `name x y z` or `x y z`, with or without a line of column names.

    The separator is the first of semicolon, tab and comma that occurs at least twice in the first line. If
    there is none, blanks separate the cells.
    """
    lines = _lines(text)
    first = next((line for line in lines if line.strip()), "")
    bare = re.sub('"[^"]*"', "", first)
    separator = next((mark for mark in ";\t," if bare.count(mark) >= 2), " ")
    if separator == " ":
        lines = [line.replace("\t", " ").strip() for line in lines]
    rows = _rows(lines, separator)
    number, cells = next(rows, (0, []))
    if not cells:
        raise InputError("is empty: give a file with one landmark per line.")
    has_header = not any(_is_value(cell) for cell in cells[-3:])
    columns = _named_columns(number, cells) if has_header else _usual_columns(number, cells)
    points = PointList("line")
    for number, cells in rows if has_header else _rows(lines, separator):
        if len(cells) != columns.total:
            raise InputError(
                f"line {number} has {count_of(len(cells), 'value')} instead of {columns.total}: correct the "
                "line, and put names that contain the separator in double quotes."
            )
        columns.add_to(points, number, cells)
    return points.landmarks()


def _is_value(cell: str) -> bool:
    """Return whether a cell is a number; `nan`, `inf` and decimal commas are accepted."""
    return is_number(cell.replace(",", "."), finite=False)


def _lines(text: str) -> list[str]:
    """Split a text into lines. Refuse a text with too many lines or with a very long line."""
    check_count(max(text.count("\n"), text.count("\r")))
    lines = re.split("\r\n|\r|\n", text)
    longest = max(range(len(lines)), key=lambda i: len(lines[i]))
    if len(lines[longest]) > _LONGEST_LINE:
        raise InputError(
            f"line {longest + 1} has more than {_LONGEST_LINE} characters, so this is not a table of "
            "landmarks: give one landmark per line."
        )
    return lines


def _rows(lines: list[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each line that is not empty."""
    # Each line ends with a newline. A quoted name over several lines therefore contains a newline, and is
    # refused later.
    reader = csv.reader(
        (f"{line}\n" for line in lines), delimiter=separator, skipinitialspace=True, strict=True
    )
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                yield reader.line_num, cells
    except csv.Error:
        raise InputError(
            f"the quotes near line {reader.line_num} are not closed or not doubled: correct the line."
        ) from None


def _usual_columns(number: int, cells: list[str]) -> _Columns:
    """Return the columns of a table without column names."""
    count = len(cells)
    if count not in (3, 4):
        raise InputError(
            f"line {number} has {count_of(count, 'value')}: give x, y and z, or a name, x, y and z, and put "
            "names that contain the separator in double quotes."
        )
    return _Columns(count, [count - 3, count - 2, count - 1], 0 if count == 4 else None)


def _named_columns(number: int, cells: list[str]) -> _Columns:
    """Return the columns of a table whose first line contains their names."""
    titles = [cell.lower() for cell in cells]
    if any(titles.count(axis) != 1 for axis in "xyz"):
        raise InputError(
            f"line {number} is neither a landmark nor a list of columns with x, y and z: give x, y and z, or "
            "a name, x, y and z in each line."
        )
    others = [title for title in titles if title not in ("x", "y", "z")]
    surplus = next((title for title in others if title not in _NAME_COLUMNS), "")
    if surplus or len(others) > 1:
        raise InputError(
            f"line {number} names the column {surplus or others[1]!a}, but a table has only x, y, z and one "
            "column of names: give the landmarks of one mesh in only these columns."
        )
    name = titles.index(others[0]) if others else None
    return _Columns(len(titles), [titles.index(axis) for axis in "xyz"], name)


def format_csv(landmarks: Landmarks) -> str:
    return _format_table(landmarks, ",")


def format_txt(landmarks: Landmarks) -> str:
    return _format_table(landmarks, "\t")


def _format_table(landmarks: Landmarks, separator: str) -> str:
    text = io.StringIO()
    writer = csv.writer(text, delimiter=separator, lineterminator="\n")
    writer.writerow(["name", "x", "y", "z"])
    for name, position in zip(landmarks.names, landmarks.positions.tolist(), strict=True):
        writer.writerow([name, *map(repr, position)])
    return text.getvalue()


def parse_fcsv(text: str) -> Landmarks:
    """Parse an `.fcsv` file of 3D Slicer (vtkMRMLMarkupsFiducialStorageNode in Slicer's source code).

    Newer versions append a 15th value, which has no column name. This value is the status of the position
    (0 undefined, 1 preview, 2 defined).
    """
    lines = _lines(text)
    stated = dict(_setting(line) for line in lines if line.startswith("#"))
    columns, order = _fcsv_columns(stated)
    points = PointList("line")
    for number, cells in _rows(["" if line.startswith("#") else line for line in lines], ","):
        if len(cells) < columns.total:
            raise InputError(
                f"line {number} has {count_of(len(cells), 'value')} instead of {columns.total}, so the file "
                "is truncated or damaged: export the markups again."
            )
        if order == _FCSV_COLUMNS and cells[len(order) : len(order) + 1] in (["0"], ["1"]):
            points.leave_out()
        else:
            columns.add_to(points, number, cells)
    system = stated.get("coordinatesystem")
    if system is not None and system not in SYSTEMS:
        raise export_again(f"the coordinate system {system[:40]!a} is neither LPS (1) nor RAS (0)", "markups")
    return points.landmarks(
        None if system is None else SYSTEMS[system],
        notes=("The file states no coordinate system.",) if system is None else (),
        why_left_out="Slicer has no defined position for them",
    )


def _setting(line: str) -> tuple[str, str]:
    """Return the key, in lower case, and the value of a comment of the form `# key = value`."""
    key, _, value = line[1:].partition("=")
    return key.strip().lower(), value.strip()


def _fcsv_columns(stated: dict[str, str]) -> tuple[_Columns, list[str]]:
    """Return the `_Columns` of an `.fcsv` file, and the names of all columns in their order."""
    if "columns" in stated:
        order = [title.strip() for title in stated["columns"].split(",")]
    elif "markups fiducial file version" in stated:
        order = _FCSV_COLUMNS
    else:
        raise InputError(
            "lacks the line '# columns = id,x,y,z,…' of 3D Slicer: export the markups again, or rename a "
            "plain table to .csv."
        )
    if any(order.count(axis) != 1 for axis in "xyz") or order.count("label") > 1:
        raise export_again("the line '# columns = …' does not name x, y and z once each", "markups")
    name = order.index("label") if "label" in order else None
    return _Columns(len(order), [order.index(axis) for axis in "xyz"], name), order


def format_fcsv(landmarks: Landmarks) -> str:
    """Return landmarks as an `.fcsv` file of 3D Slicer. The coordinate system must be known."""
    text = io.StringIO()
    text.write(
        "# Markups fiducial file version = 4.11\n"
        f"# CoordinateSystem = {landmarks.coordinates}\n"
        f"# columns = {','.join(_FCSV_COLUMNS)}\n"
    )
    writer = csv.writer(text, lineterminator="\n")
    for number, name in enumerate(landmarks.names, start=1):
        position = map(repr, landmarks.positions[number - 1].tolist())
        # The orientation (0, 0, 0, 1) and the flags visible, selected and not locked are Slicer's defaults.
        writer.writerow([number, *position, 0, 0, 0, 1, 1, 1, 0, name, "", ""])
    return text.getvalue()
