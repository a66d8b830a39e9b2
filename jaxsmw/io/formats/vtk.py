"""VTK legacy files (https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html)."""

from __future__ import annotations

import re
from typing import NoReturn
from urllib.parse import quote, unquote

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Formatted, Polygons, omissions, width_of
from jaxsmw.io.formats.text import damaged, excerpt, export_again, numbers_of
from jaxsmw.io.formats.vtk_cells import (
    LINE,
    POLYGON,
    STRIP,
    VERTEX,
    Cells,
    add_array,
    arrays_of,
    cells_of,
    check_array,
    joined,
    polygons_of,
)
from jaxsmw.io.mesh_data import MeshData
from jaxsmw.wording import count_of

_TYPES = {
    **{"bit": "bit", "char": "i1", "signed_char": "i1", "unsigned_char": "u1", "short": "i2"},
    **{"unsigned_short": "u2", "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8"},
    **{"vtktypeint64": "i8", "vtktypeuint64": "u8", "float": "f4", "double": "f8", "vtkidtype": "i4"},
}
_NAMES = {
    **{"i1": "signed_char", "u1": "unsigned_char", "i2": "short", "u2": "unsigned_short", "i4": "int"},
    **{"u4": "unsigned_int", "i8": "vtktypeint64", "u8": "vtktypeuint64", "f4": "float", "f8": "double"},
}
_KINDS = {"VERTICES": VERTEX, "LINES": LINE, "POLYGONS": POLYGON, "TRIANGLE_STRIPS": STRIP}
# The attributes with a fixed number of columns.
_COLUMNS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1}
_COLUMNS["EDGE_FLAGS"] = 1


def parse_vtk(data: bytes) -> Polygons:
    """Parse a text or binary file up to version 5.1 with a POLYDATA or an UNSTRUCTURED_GRID."""
    return _Reader(data).polygons()


class _Reader:
    """A cursor in a file, and the parts of the mesh that were read so far."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = 0
        version = re.match(r"# vtk DataFile Version (\d)\.\d+\s*$", self.raw_line() or "", re.IGNORECASE)
        if version is None:
            raise export_again("does not begin with '# vtk DataFile Version'")
        self.major = int(version[1])
        if not 1 <= self.major <= 5:
            raise InputError(f"has the unknown version {version[1]}: save the mesh in version 5.1 or older.")
        self.raw_line()  # the title
        encoding = (self.raw_line() or "").strip().upper()
        if encoding not in ("ASCII", "BINARY"):
            raise damaged(f"{excerpt(encoding)} is written where ASCII or BINARY should be")
        self.binary = encoding == "BINARY"
        self.points: np.ndarray | None = None
        self.cells: dict[str, Cells] = {}
        self.kinds: np.ndarray | None = None
        self.arrays: dict[str, dict[str, np.ndarray]] = {"POINT_DATA": {}, "CELL_DATA": {}, "": {}}
        self.section, self.rows = "", 0
        self.coordinates: np.ndarray | None = None

    def polygons(self) -> Polygons:
        while (line := self.line()) is not None:
            self.statement(line.split())
        if self.points is None:
            raise InputError("contains no POINTS: save a POLYDATA or an UNSTRUCTURED_GRID with triangles.")
        cells = joined([self.cells[keyword] for keyword in (*_KINDS, "CELLS") if keyword in self.cells])
        if self.kinds is not None:
            if len(self.kinds) != len(cells.sizes):
                raise damaged(
                    f"has {count_of(len(cells.sizes), 'cell')}, but {len(self.kinds)} types of cells"
                )
            cells = cells._replace(kinds=self.kinds)
        elif "CELLS" in self.cells:
            raise damaged("contains CELLS without CELL_TYPES")
        return polygons_of(
            self.points, cells, self.arrays["POINT_DATA"], self.arrays["CELL_DATA"], self.coordinates
        )

    def statement(self, words: list[str]) -> None:
        """Read a statement and the numbers after it. `words` contains the words of the first line."""
        keyword = words[0].upper()
        match [keyword, *words[1:]]:
            case ["DATASET", kind]:
                if kind.upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
                    raise InputError(
                        f"contains a {excerpt(kind)} instead of POLYDATA or UNSTRUCTURED_GRID: extract the "
                        "surface first."
                    )
            case ["POINTS", count, kind] if self.points is None:
                self.points = self.take(_count(count), 3, kind).astype(np.float64)
            case ["VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS" | "CELLS", count, size] if (
                keyword not in self.cells
            ):
                self.cells[keyword] = self.take_cells(_KINDS.get(keyword, 0), _count(count), _count(size))
            case ["CELL_TYPES", count] if self.kinds is None:
                self.kinds = self.take(_count(count), 1, "int")[:, 0].astype(np.int64)
            case ["POINT_DATA" | "CELL_DATA", count]:
                self.section, self.rows = keyword, _count(count)
            case ["FIELD", _, count]:
                for _ in range(min(_count(count), len(self.data))):
                    self.field_array()
            case _ if self.section:
                self.attribute([keyword, *words[1:]])
            case _:
                self.refuse(words)

    def attribute(self, words: list[str]) -> None:
        """Read an attribute of the points or of the cells."""
        match words:
            case ["SCALARS", name, kind, *columns] if len(columns) < 2:
                table = (self.line() or "").split()
                if table[:1] != ["LOOKUP_TABLE"]:
                    self.refuse(table)
                values = self.take(self.rows, _count(*columns) if columns else 1, kind)
            case ["COLOR_SCALARS", name, columns]:
                values = self.take(self.rows, _count(columns), "unsigned_char" if self.binary else "float")
                if not self.binary:  # text files contain floats from 0 to 1
                    values = np.rint(255 * np.clip(np.nan_to_num(values), 0, 1)).astype(np.uint8)
            case ["LOOKUP_TABLE", _, size]:
                self.take(_count(size), 4, "unsigned_char" if self.binary else "float")
                return
            case ["TEXTURE_COORDINATES", name, columns, kind]:
                values = self.take(self.rows, _count(columns), kind)
                if self.section == "POINT_DATA" and values.shape[1] >= 2:
                    self.coordinates = values
                    return
            case [keyword, name, kind] if keyword in _COLUMNS:
                values = self.take(self.rows, _COLUMNS[keyword], kind)
            case _:
                self.refuse(words)
        add_array(self.arrays[self.section], unquote(name), values)

    def field_array(self) -> None:
        """Read an array of a FIELD. Arrays of strings are skipped."""
        match (self.line() or "").split():
            case [name, columns, rows, "string"]:
                self.skip_strings(_count(columns) * _count(rows))
            case [name, columns, rows, kind]:
                values = self.take(_count(rows), _count(columns), kind)
                if self.section and values.shape[1]:
                    add_array(self.arrays[self.section], unquote(name), values)
            case words:
                self.refuse(words)

    def refuse(self, words: list[str]) -> NoReturn:
        if not words:
            raise export_again("ends early, so the file is truncated")
        raise damaged(f"contains the invalid line {excerpt(' '.join(words))}")

    def raw_line(self) -> str | None:
        """Return the next line, or None at the end of the file."""
        if self.position >= len(self.data):
            return None
        end = self.data.find(b"\n", self.position)
        end = len(self.data) if end < 0 else end
        line = self.data[self.position : end].decode("latin-1")
        self.position = end + 1
        return line

    def line(self) -> str | None:
        """Return the next line that is not empty and not part of a METADATA block."""
        while (line := self.raw_line()) is not None:
            if line.split() == ["METADATA"]:
                while (self.raw_line() or "").strip():
                    pass
            elif line.strip():
                return line
        return None

    def take(self, rows: int, columns: int, name: str) -> np.ndarray:
        """Return the next numbers as an array (rows, columns). `name` is the VTK type of the numbers."""
        kind = check_array(_TYPES, name.lower(), columns)
        count = rows * columns
        values = self.take_bytes(count, kind) if self.binary else self.take_words(count, kind)
        return values.reshape(rows, columns)

    def take_bytes(self, count: int, kind: str) -> np.ndarray:
        size = (count + 7) // 8 if kind == "bit" else count * np.dtype(kind).itemsize
        start, self.position = self.position, self.position + size
        if self.position > len(self.data):
            self.truncated(count)
        if kind == "bit":
            return np.unpackbits(np.frombuffer(self.data, np.uint8, size, start), count=count)
        return np.frombuffer(self.data, ">" + kind, count, start).astype(kind)

    def take_words(self, count: int, kind: str) -> np.ndarray:
        if 2 * count > len(self.data) - self.position + 1:  # a number takes at least a digit and a space
            self.truncated(count)
        words: list[str] = []
        while len(words) < count:
            if (line := self.raw_line()) is None:
                self.truncated(count)
            words += line.split()
        if len(words) > count:
            raise damaged(f"continues after {count_of(count, 'number')}")
        return numbers_of(words, "u1" if kind == "bit" else kind)

    def truncated(self, count: int) -> NoReturn:
        raise export_again(
            f"declares {count_of(count, 'number')}, but the file ends within them, so the file is truncated "
            "or damaged"
        )

    def skip_strings(self, count: int) -> None:
        """Skip strings. In text files, strings are lines. In binary files, the length precedes the string."""
        for _ in range(count):
            if not self.binary:
                if self.raw_line() is None:
                    self.truncated(count)
                continue
            head = self.data[self.position : self.position + 8]
            # The two highest bits determine how many bytes the length of the string takes.
            size = (8, 4, 2, 1)[head[0] >> 6] if head else 1
            length = int.from_bytes(head[:size], "big") & ((1 << (8 * size - 2)) - 1)
            self.position += size + length
            if self.position > len(self.data):
                self.truncated(count)

    def take_cells(self, kind: int, count: int, size: int) -> Cells:
        """Return cells: offsets and corners since version 5, sizes and corners before."""
        if self.major >= 5:
            parts = []
            for keyword, length in (("OFFSETS", count), ("CONNECTIVITY", size)):
                words = (self.line() or "").split()
                if len(words) != 2 or words[0].upper() != keyword:
                    self.refuse(words)
                parts.append(self.take(length, 1, words[1])[:, 0])
            return cells_of(kind, *parts)
        stream = self.take(size, 1, "int")[:, 0].astype(np.int64)
        width = int(stream[0]) + 1 if size else 1
        if count * width == size and (stream[::width] == width - 1).all():  # all cells have equal sizes
            return Cells(
                np.full(count, kind), np.full(count, width - 1), stream.reshape(count, width)[:, 1:].ravel()
            )
        starts: list[int] = []
        position = 0
        while len(starts) < count and position < size and 0 <= stream[position] < size:
            starts.append(position)
            position += int(stream[position]) + 1
        if position != size or len(starts) != count:
            raise damaged(
                f"declares {count_of(count, 'cell')} in {count_of(size, 'number')}, which contain other cells"
            )
        is_corner = np.ones(size, dtype=bool)
        is_corner[starts] = False
        return Cells(np.full(count, kind), stream[starts], stream[is_corner])


def _count(word: str) -> int:
    if not re.fullmatch(r"\d{1,18}", word, re.ASCII):
        raise damaged(f"{excerpt(word)} is written where a count should be")
    return int(word)


def format_vtk(data: MeshData) -> Formatted:
    """Format a binary POLYDATA in version 3.0, which all programs read."""
    point_data, cell_data, coordinates = arrays_of(data)
    n, f = len(data.mesh.vertices), len(data.faces)
    cells = np.column_stack([np.full(f, 3), data.faces])
    parts = [
        b"# vtk DataFile Version 3.0\nmesh\nBINARY\nDATASET POLYDATA\n",
        *(f"POINTS {n} double\n".encode(), data.mesh.vertices.astype(">f8").tobytes(), b"\n"),
        *(f"POLYGONS {f} {4 * f}\n".encode(), cells.astype(">i4").tobytes(), b"\n"),
    ]
    if point_data or coordinates is not None:
        parts.append(f"POINT_DATA {n}\n".encode())
    if coordinates is not None:
        parts += [b"TEXTURE_COORDINATES texture 2 double\n", coordinates.astype(">f8").tobytes(), b"\n"]
    parts += _field(point_data)
    if cell_data:
        parts += [f"CELL_DATA {f}\n".encode(), *_field(cell_data)]
    notes = omissions(data, "VTK", vertex_data=True, face_data=True, texture=True)
    return b"".join(parts), notes


def _field(arrays: dict[str, np.ndarray]) -> list[bytes]:
    """Return the lines and bytes of a FIELD that contains the arrays."""
    parts = [f"FIELD FieldData {len(arrays)}\n".encode()] if arrays else []
    for name, values in arrays.items():
        kind = values.dtype.str[1:]
        parts.append(f"{quote(name)} {width_of(values)} {len(values)} {_NAMES[kind]}\n".encode())
        parts += [values.astype(">" + kind).tobytes(), b"\n"]
    return parts
