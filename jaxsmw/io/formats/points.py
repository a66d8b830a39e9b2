"""Point clouds in text files with one point per line, and in NumPy's `.npy` files."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float64, Shaped

from jaxsmw.errors import InputError
from jaxsmw.io.formats.npz import read_array
from jaxsmw.io.formats.polygons import Polygons
from jaxsmw.io.formats.text import filled_lines, is_number, numbers
from jaxsmw.io.mesh_data import NORMALS

# Columns 4 to 6 are normals if the length of every vector differs from 1 by less than this number.
# Otherwise the columns contain something else, such as colours.
_UNIT = 0.01


def parse_xyz(data: bytes) -> Polygons:
    """Parse a text file whose lines begin with x, y and z, separated by spaces, tabs, commas or semicolons.

    Each line is first split at spaces, tabs and semicolons. If this gives at least three words, and all words
    are numbers without a decimal point, commas are decimal commas. Otherwise, commas also separate words.

    A first line without any number is a header. A first line with one whole number is the number of points.
    """
    if b"\0" in data[:4096]:
        raise InputError("is not a text file in ASCII or UTF-8: save the points as text.")
    lines = filled_lines(data)
    if lines and not any(map(is_number, _words(lines[0]))):
        lines = lines[1:]
    if lines and re.fullmatch(r"\s*\d{1,18}\s*", lines[0]):
        if int(lines[0]) != len(lines) - 1:
            raise InputError(
                f"the first line declares {int(lines[0])} points, but {len(lines) - 1} lines follow, so the "
                "file is truncated or its first line is wrong: export the points again."
            )
        lines = lines[1:]
    if not lines:
        raise InputError("contains no points: export the points again, one per line.")
    rows = [" ".join(_words(line)) for line in lines]
    columns = min(len(row.split()) for row in rows)
    return points_of_table(numbers(rows, max(columns, 3)))


def _words(line: str) -> list[str]:
    """Return the words of a line, with points instead of decimal commas."""
    words = line.replace(";", " ").split()
    if len(words) >= 3 and all(re.fullmatch(r"[+-]?\d+(,\d+)?(e[+-]?\d+)?", word, re.I) for word in words):
        return [word.replace(",", ".") for word in words]
    return line.replace(";", " ").replace(",", " ").split()


def parse_npy(data: bytes) -> Polygons:
    """Parse an array with one row per point, whose columns are x, y, z, and perhaps the normal."""
    table = read_array(data)
    if table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "iuf":
        raise InputError(
            f"contains an array of {table.dtype.name} of shape {table.shape}: save numbers of shape (number "
            "of points, 3)."
        )
    return points_of_table(table)


def points_of_table(table: Shaped[np.ndarray, "n columns"]) -> Polygons:
    """Return points without faces from a table. Columns 4 to 6 become normals if they are unit vectors."""
    table = table.astype(np.float64)
    normals = {NORMALS: table[:, 3:6]} if table.shape[1] >= 6 and _are_unit(table[:, 3:6]) else {}
    used = 6 if normals else 3
    notes: tuple[str, ...] = ()
    if table.shape[1] > used:
        rest = f"{used + 1} to {table.shape[1]}" if table.shape[1] > used + 1 else str(used + 1)
        notes = (f"Columns ignored: {rest}, which are not unit normals.",)
    return Polygons(table[:, :3], notes=notes, vertex_data=normals)


def _are_unit(vectors: Float64[np.ndarray, "n 3"]) -> bool:
    return bool((np.abs(np.linalg.norm(vectors, axis=1) - 1) < _UNIT).all())
