"""Point clouds in the PCD format of the Point Cloud Library (https://pointclouds.org/documentation/)."""

from __future__ import annotations

import math

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Polygons
from jaxsmw.io.formats.text import excerpt, export_again, filled_lines, numbers
from jaxsmw.io.mesh_data import NORMALS
from jaxsmw.wording import count_of

_KINDS = {"F": "f", "I": "i", "U": "u"}
_NORMAL_FIELDS = ("normal_x", "normal_y", "normal_z")
# Unpacked points are refused if they exceed both this number of bytes and four times their packed size.
_LARGEST = 2**28
_ENCODINGS = "ascii", "binary", "binary_compressed"
# The name of padding fields, which contain no data.
_PADDING = "_"


def parse_pcd(data: bytes) -> Polygons:
    """Parse a text file, a binary file, or a file in the format `binary_compressed`."""
    record, points, encoding, body = _header(data)
    if encoding == "ascii":
        table = _from_text(body, record, points)
    elif encoding == "binary_compressed":
        table = _decompressed(body, record, points)
    else:
        size = points * record.itemsize
        if len(body) < size:
            raise export_again(
                f"the header declares {points} points, but the file ends earlier, so the file is truncated",
                "points",
            )
        table = np.frombuffer(body[:size], record)
    columns = {name: table[name] for name in record.names or () if not name.startswith(_PADDING)}
    for axis in "xyz":
        if axis not in columns or columns[axis].shape[1:] != (1,):
            raise InputError(
                f"has no field {axis} with one number for each point: export the points again, with x, y "
                "and z."
            )
    vertices = np.stack([columns.pop(axis).reshape(-1) for axis in "xyz"], axis=1).astype(np.float64)
    if all(name in columns and columns[name].shape[1:] == (1,) for name in _NORMAL_FIELDS):
        columns[NORMALS] = np.stack([columns.pop(name).reshape(-1) for name in _NORMAL_FIELDS], axis=1)
    return Polygons(vertices, vertex_data=columns)


def _header(data: bytes) -> tuple[np.dtype, int, str, bytes]:
    """Return the record type and the number of the points, the encoding, and the rest of the file."""
    entries: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in entries:
        end = data.find(b"\n", offset)
        if end < 0 or end > 2**16:
            raise export_again("has no line DATA at the end of its header, so the file is damaged", "points")
        words = data[offset:end].decode("latin-1").split()
        offset = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    counts = entries.get("COUNT", ["1"] * len(names))
    described = list(zip(names, entries.get("SIZE", []), entries.get("TYPE", []), counts, strict=False))
    # All padding fields have the name `_`, but the fields of a record type need different names.
    fields = [
        (name if name != _PADDING else f"{_PADDING}{at}", *rest) for at, (name, *rest) in enumerate(described)
    ]
    encoding = "".join(entries["DATA"])
    try:
        if len(described) != len(names) or len(counts) != len(names) or not names:
            raise ValueError
        kinds = [(name, f"<{_KINDS[kind]}{int(size)}", (int(count),)) for name, size, kind, count in fields]
        record = np.dtype(kinds)
        width, height = (int(*entries.get(key, ["1"])) for key in ("WIDTH", "HEIGHT"))
        points = int(*entries.get("POINTS", [str(width * height)]))
        if (
            min(count for *_, (count,) in kinds) < 1
            or min(width, height) < 0
            or points != width * height
            or encoding not in _ENCODINGS
        ):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise export_again(
            f"the header is damaged (fields {excerpt(' '.join(names))}, data {excerpt(encoding)})",
            "points",
        ) from None
    return record, points, encoding, data[offset:]


def _from_text(body: bytes, record: np.dtype, points: int) -> np.ndarray:
    """Return the points of a text file, as an array of records."""
    lines = filled_lines(body)
    if len(lines) != points:
        raise InputError(
            f"the header declares {points} points, but is followed by {len(lines)} lines, so the file is "
            "truncated or its header is wrong: export the points again."
        )
    names = record.names or ()
    declared, written = record.itemsize, len(lines[0].split()) if lines else 0
    if written * 8 < declared:  # no number takes more than 8 bytes
        raise InputError(
            f"the header declares {declared} bytes for each point, but the first point has "
            f"{count_of(written, 'number')}: export the points again."
        )
    widths = [math.prod(record[name].shape) for name in names]
    values = np.split(numbers(lines, sum(widths)), np.cumsum(widths)[:-1], axis=1)
    table = np.empty(len(lines), [(name, "f8", (width,)) for name, width in zip(names, widths, strict=True)])
    for name, columns in zip(names, values, strict=True):
        table[name] = columns
    return table


def _decompressed(body: bytes, record: np.dtype, points: int) -> np.ndarray:
    """Return the points of a compressed file, which stores all values of a field one after another."""
    packed, size = np.frombuffer(body[:8].ljust(8, b"\0"), "<u4").tolist()
    expected = points * record.itemsize
    if len(body) < 8 + packed:
        raise export_again("ends within the compressed points, so it is truncated", "points")
    if size != expected:
        raise InputError(
            f"declares {size} bytes of compressed points where the header requires {expected}, so the file "
            "is damaged: export the points again."
        )
    if size > max(_LARGEST, 4 * len(body)):
        raise InputError(
            f"contains {size >> 20} MiB of compressed points: export the points again without compression."
        )
    fields = lzf_decompressed(body[8 : 8 + packed], size)
    table, offset = np.empty(points, record), 0
    for name in record.names or ():
        table[name] = np.frombuffer(fields, record[name], points, offset)
        offset += points * record[name].itemsize
    return table


def lzf_decompressed(packed: bytes, size: int) -> bytes:
    """Decompress data in the LZF format of Marc Lehmann's LibLZF to exactly `size` bytes.

    After a control byte c below 32, c + 1 literal bytes follow. Any other control byte means a copy of
    earlier output. The upper three bits of the control byte are the length minus 2. If these bits are all
    set, the next byte is added to the length. The lower five bits and the following byte are the distance
    minus 1.
    """
    out, at = bytearray(), 0
    try:
        while at < len(packed):
            control = packed[at]
            at += 1
            if control < 32:
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - packed[at] - 1
            at += 1
            if start < 0 or len(out) > size:
                raise IndexError
            # The copy can be longer than the available output. The available bytes are then repeated.
            repeated = out[start : start + length + 2]
            out += (repeated * (length + 2))[: length + 2] if len(repeated) < length + 2 else repeated
    except IndexError:
        out = bytearray()
    if len(out) != size or at != len(packed):
        raise export_again("contains damaged compressed points", "points")
    return bytes(out)
