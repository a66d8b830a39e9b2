"""PLY files in the Polygon File Format (https://paulbourke.net/dataformats/ply/)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import (
    TEXTURE_OF_CORNERS,
    Formatted,
    Polygons,
    is_color,
    is_texture_of_vertices,
    omissions,
    texture_or_note,
    width_of,
)
from jaxsmw.io.formats.text import damaged, excerpt, export_again, is_number
from jaxsmw.io.mesh_data import COLORS, NORMALS, MeshData, texture_at_corners, texture_of_corners

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8"},
}
_TYPE_NAMES = {kind: name for name, kind in _TYPES.items()}
# Newer programs name the number of bits.
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
# Properties that become the columns of one array.
_COLUMNS_OF = {COLORS: ("red", "green", "blue", "alpha"), NORMALS: ("nx", "ny", "nz")}
_TEXTURES = ("s", "t"), ("u", "v"), ("texture_u", "texture_v")
_CORNERS = "vertex_indices", "vertex_index"


class _Property(NamedTuple):
    """A property of a PLY element, which has one number or one list of numbers per row.

    `type` is the type of the numbers in the body, and `declared` is their type in the header. `length` is the
    type in which the lengths of the lists are stored, or None if each row has one number.
    """

    type: np.dtype
    length: np.dtype | None
    declared: np.dtype


class _Column(NamedTuple):
    """The values of a property in all rows, one row after another, and the number of values in each row."""

    values: np.ndarray = np.empty(0)
    sizes: np.ndarray = np.empty(0, np.int64)


def parse_ply(data: bytes) -> Polygons:
    """Parse a text file, or a binary file in either byte order."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if first is None:
        raise InputError("does not begin with ply: export the mesh again as a PLY file.")
    newline = first[1]
    last = re.search(newline + rb"end_header[ \t]*" + newline, data)
    if last is None:
        raise export_again("the header has no end_header line, so the file is truncated or damaged")
    header = data[first.end() : last.start()].decode("latin-1").split(newline.decode())
    encoding, elements = _ply_header(header)
    body = data[last.end() :]
    if encoding == "ascii":
        body = _binary(body)
    tables, offset = {}, 0
    for name, (count, properties) in elements.items():
        try:
            tables[name], offset = _ply_table(body, offset, count, properties)
        except EOFError:
            raise export_again(
                f"the header declares {count} rows of {excerpt(name)}, but the file ends within these rows, "
                "so the file is truncated or its header is wrong"
            ) from None
    if body[offset:].strip(b"\0 \t\r\n"):
        raise export_again("continues after the last declared row, so the header is wrong")

    vertex, face, strips = (tables.get(name, {}) for name in ("vertex", "face", "tristrips"))
    position = [vertex[axis].values for axis in "xyz" if axis in vertex and (vertex[axis].sizes == 1).all()]
    if len(position) < 3:
        raise export_again("has no properties x, y and z for its vertices")
    corners, strip = (next((table[c] for c in _CORNERS if c in table), None) for table in (face, strips))
    if corners is None and elements.get("face", (0, {}))[0]:
        raise InputError("has no faces with vertex_indices: export the mesh again as a triangle mesh.")
    corners = corners or _Column()  # a point cloud, or strips only
    vertex_data = _numbers_of(vertex, elements["vertex"][1], {*"xyz"})
    face_data = _numbers_of(face, elements.get("face", (0, {}))[1], {*_CORNERS, TEXTURE_OF_CORNERS})
    texture, notes = texture_or_note(lambda: _texture(face.get(TEXTURE_OF_CORNERS), corners, vertex_data))
    polygons = Polygons(
        np.stack(position, axis=1, dtype=np.float64),
        *corners,
        notes=notes,
        vertex_data=_grouped(vertex_data),
        face_data=_grouped(face_data),
        texture=texture,
        lines=elements.get("edge", (0, {}))[0],
    )
    return polygons if strip is None else _with_strips(polygons, strip)


def _binary(body: bytes) -> bytes:
    """Convert text to a binary body of float64 numbers, so that one parser serves both encodings."""
    words = body.split()
    try:
        if re.search(rb"[^\s\w.+-]|_", body):  # NumPy would read 1_0 as 10
            raise ValueError
        return np.array(words, dtype=np.float64).tobytes()
    except ValueError:
        texts = (word.decode("latin-1") for word in words)
        culprit = excerpt(next(text for text in texts if not is_number(text, finite=False)))
        raise export_again(f"{culprit} is written where a number should be") from None


def _with_strips(polygons: Polygons, strips: _Column) -> Polygons:
    """Append triangle strips, which have neither data nor a texture. The index -1 begins another strip."""
    begins = strips.values == -1
    number = np.cumsum(begins) + np.repeat(np.arange(len(strips.sizes)), strips.sizes)
    _, strip, sizes = np.unique(number[~begins], return_inverse=True, return_counts=True)
    lost = [name for name, values in polygons.face_data.items() if len(values)]
    what = [*(["texture"] if polygons.texture is not None else []), *map(ascii, lost)]
    note = f"The data of the faces ({', '.join(what)}) were left out, because triangle strips have none."
    used = sizes > 2
    return polygons._replace(
        corners=np.concatenate([polygons.corners, strips.values[~begins][used[strip]]]),
        sizes=np.concatenate([polygons.sizes, sizes[used]]),
        strips=np.repeat([False, True], [len(polygons.sizes), used.sum()]),
        notes=(*polygons.notes, *([note] if what else [])),
        face_data={},
        texture=None,
    )


def _numbers_of(
    table: Mapping[str, _Column], properties: Mapping[str, _Property], others: set[str]
) -> dict[str, np.ndarray]:
    """Return the properties with equally many numbers in all rows, in the declared types, except `others`."""
    data = {}
    for name, (values, sizes) in table.items():
        width = int(sizes[0]) if len(sizes) else 0
        if width and (sizes == width).all() and name not in others:
            declared = values.astype(properties[name].declared)
            # Text can contain numbers that the declared type cannot hold.
            if declared.dtype.kind == "f" or np.array_equal(declared, values, equal_nan=True):
                values = declared
            data[name] = values if width == 1 else values.reshape(-1, width)
    return data


def _grouped(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Join the components of colours and normals, and numbered properties such as a_0 and a_1, to arrays."""
    groups = {group: names for group, names in _COLUMNS_OF.items() if {*names[:3]} <= data.keys()}
    for name in data:
        stem = name.removesuffix("_0")
        if stem not in ("", name) and f"{stem}_1" in data:
            groups[stem] = tuple(f"{stem}_{i}" for i in range(len(data)))
    for group, names in groups.items():
        columns = {name: data[name] for name in names if name in data}
        if group in data or len({values.dtype for values in columns.values()}) > 1:
            continue
        joined = np.stack(list(columns.values()), axis=1)
        first, *rest = columns
        data = {
            group if name == first else name: joined if name == first else values
            for name, values in data.items()
            if name not in rest
        }
    return data


def _texture(
    of_corners: _Column | None, faces: _Column, vertex_data: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the texture from `texcoord` of the faces or vertices, or from properties such as `s` and `t`."""
    corners = faces.values
    if of_corners is not None and of_corners.sizes.any():
        has_texture = of_corners.sizes > 0
        sizes, of_faces = of_corners.sizes[has_texture], faces.sizes[has_texture]
        width = int(sizes[0] // max(of_faces[0], 1))
        if width not in (2, 3) or (sizes != width * of_faces).any():
            raise export_again("a face does not have two texture coordinates for each corner")
        at_corners = np.full((len(corners), 2), np.nan)
        at_corners[np.repeat(has_texture, faces.sizes)] = of_corners.values.reshape(-1, width)[:, :2]
        return texture_of_corners(corners, at_corners)
    whole = (corners >= 0) & (corners == np.floor(corners))
    for names in ((TEXTURE_OF_CORNERS,), *_TEXTURES):
        columns = [vertex_data[name] for name in names if name in vertex_data]
        coordinates = np.column_stack(columns) if len(columns) == len(names) else np.empty((0, 0))
        if coordinates.shape[1] == 2 and (whole & (corners < len(coordinates))).all():
            for name in names:
                del vertex_data[name]
            return coordinates, corners.astype(np.int64)
    return None


def _ply_header(lines: list[str]) -> tuple[str, dict[str, tuple[int, dict[str, _Property]]]]:
    """Return the encoding, and a dictionary from element names to row counts and properties."""
    formats = [line.split()[1:] for line in lines if re.match(r"format(\s|$)", line)]
    if len(formats) != 1 or formats[0] not in [[encoding, "1.0"] for encoding in _BYTE_ORDERS]:
        raise export_again(
            f"the header does not name exactly one of the formats {', '.join(_BYTE_ORDERS)} in version 1.0"
        )
    encoding = formats[0][0]

    def number(name: str) -> np.dtype:
        return np.dtype(np.float64 if encoding == "ascii" else _BYTE_ORDERS[encoding] + _TYPES[name])

    elements: dict[str, tuple[int, dict[str, _Property]]] = {}
    properties: dict[str, _Property] | None = None
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info" | "format", *_]:
                pass
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count) and name not in elements:
                properties = {}
                elements[name] = int(count), properties
            case ["property", "list", length, kind, name] if (
                _TYPES.get(length, "f")[0] in "iu"
                and kind in _TYPES
                and properties is not None
                and name not in properties
            ):
                properties[name] = _Property(number(kind), number(length), np.dtype(_TYPES[kind]))
            case ["property", kind, name] if (
                kind in _TYPES and properties is not None and name not in properties
            ):
                properties[name] = _Property(number(kind), None, np.dtype(_TYPES[kind]))
            case _:
                raise export_again(f"the header contains the invalid line {excerpt(line)}")
    return encoding, elements


def _ply_table(
    body: bytes, offset: int, count: int, properties: dict[str, _Property]
) -> tuple[dict[str, _Column], int]:
    """Return the columns of the table that begins at `offset`, and its end. `EOFError` if it has none."""
    shortest = sum((p.length or p.type).itemsize for p in properties.values())
    if count * shortest > len(body) - offset:
        raise EOFError
    if not count or not properties:
        return {name: _Column() for name in properties}, offset

    # In most files, all lists of a property have the same length. NumPy then reads all rows together, as one
    # array of records.
    spans, _ = _ply_row(body, offset, properties)
    sizes = {name: size for name, (_, size) in zip(properties, spans, strict=True)}
    lengths = {name: f"length of {name}" for name, (_, length, _) in properties.items() if length}
    fields: list[tuple] = []
    for name, (kind, length, _) in properties.items():
        fields += [(lengths[name], length)] if length else []
        fields += [(name, kind, (sizes[name],))]
    record = np.dtype(fields)
    end = offset + count * record.itemsize
    if end <= len(body):
        table = np.frombuffer(body, record, count, offset)
        if all((table[key] == sizes[name]).all() for name, key in lengths.items()):
            return {
                name: _Column(table[name].ravel(), np.full(count, sizes[name])) for name in properties
            }, end

    rows = []
    for _ in range(count):
        spans, offset = _ply_row(body, offset, properties)
        rows.append(spans)
    columns = {}
    for (name, (kind, _, _)), column in zip(properties.items(), zip(*rows, strict=True), strict=True):
        values = b"".join([body[start : start + size * kind.itemsize] for start, size in column])
        columns[name] = _Column(np.frombuffer(values, kind), np.array([size for _, size in column]))
    return columns, offset


def _ply_row(body: bytes, offset: int, properties: dict[str, _Property]) -> tuple[list[tuple[int, int]], int]:
    """Return the offset and the length of each property in a row, and the end of the row, or `EOFError`."""
    spans = []
    for kind, length, _ in properties.values():
        size = 1
        if length:
            start, offset = offset, offset + length.itemsize
            if offset > len(body):
                raise EOFError
            written = np.frombuffer(body, length, 1, start)[0]
            if not 0 <= written <= len(body) or written % 1:
                raise damaged(f"a list declares {written:.15g} numbers")
            size = int(written)
        spans.append((offset, size))
        offset += size * kind.itemsize
    if offset > len(body):
        raise EOFError
    return spans, offset


def format_ply(data: MeshData) -> Formatted:
    """Format a little-endian binary file. The columns of an array a become the properties a_0, a_1, …."""
    columns = dict(zip("xyz", data.mesh.vertices.T, strict=True))
    lists: dict[str, np.ndarray] = {"vertex_indices": data.faces.astype("<i4")}
    if data.texture is not None and is_texture_of_vertices(data):
        columns |= dict(zip(("s", "t"), data.texture.coordinates.T, strict=True))
    elif data.texture is not None:
        lists[TEXTURE_OF_CORNERS] = texture_at_corners(data.texture)
    reserved = {*"xyz", *(name for pair in _TEXTURES for name in pair)}
    extra, lost_of_vertices = _columns(data.vertex_data, reserved)
    face_extra, lost_of_faces = _columns(data.face_data, {*_CORNERS, TEXTURE_OF_CORNERS})
    vertices, vertex_lines = _table(columns | extra, len(data.mesh.vertices), {})
    faces, face_lines = _table(face_extra, len(data.faces), lists)
    header = [
        *("ply", "format binary_little_endian 1.0"),
        *(f"element vertex {len(vertices)}", *vertex_lines, f"element face {len(faces)}", *face_lines),
        *("end_header", ""),
    ]
    notes = omissions(
        data,
        "PLY",
        vertex_data=lambda name, _: name not in lost_of_vertices,
        face_data=lambda name, _: name not in lost_of_faces,
        texture=True,
    )
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes(), notes


def _columns(data: Mapping[str, np.ndarray], reserved: set[str]) -> tuple[dict[str, np.ndarray], set[str]]:
    """Return columns for a PLY file by name, and the names of the arrays that do not fit."""
    columns: dict[str, np.ndarray] = {}
    lost = set()
    for name, values in data.items():
        components: tuple[str, ...] = _COLUMNS_OF.get(name, ())
        count = width_of(values)
        names = [name] if values.ndim == 1 else [f"{name}_{i}" for i in range(count)]
        if values.ndim == 2 and 3 <= count <= len(components) and (name != COLORS or is_color(name, values)):
            names = list(components[:count])
        stored = _storable(values)
        if stored is None or not re.fullmatch(r"[!-~]+", name) or {*names} & (reserved | {*columns}):
            lost.add(name)
        else:
            columns |= dict(zip(names, np.atleast_2d(stored.T), strict=True))
    return columns, lost


def _storable(values: np.ndarray) -> np.ndarray | None:
    """Return values in a type of PLY that represents them, or None."""
    if values.dtype.str[1:] in _TYPE_NAMES:
        return values
    for kind, low, high in ((np.int32, -(2**31), 2**31 - 1), (np.float64, -(2**53), 2**53)):
        if values.min() >= low and values.max() <= high:
            return values.astype(kind)
    return None


def _table(
    columns: Mapping[str, np.ndarray], count: int, lists: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, list[str]]:
    """Return the records of an element, and the lines of the header that declare its properties."""
    fields: list[tuple] = []
    lines = []
    for name, values in lists.items():
        kind = values.dtype.newbyteorder("<")
        fields += [(f"length of {name}", "u1"), (name, kind, values.shape[1])]
        lines.append(f"property list uchar {_TYPE_NAMES[kind.str[1:]]} {name}")
    for name, values in columns.items():
        fields.append((name, values.dtype.newbyteorder("<")))
        lines.append(f"property {_TYPE_NAMES[values.dtype.str[1:]]} {name}")
    records = np.empty(count, fields)
    for name, values in lists.items():
        records[f"length of {name}"], records[name] = values.shape[1], values
    for name, values in columns.items():
        records[name] = values
    return records, lines
