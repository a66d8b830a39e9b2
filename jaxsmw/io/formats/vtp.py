"""VTK XML files of polygons (https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html)."""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import zlib
from collections.abc import Sequence
from itertools import pairwise
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Formatted, Polygons, omissions, unique_name, width_of
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
from jaxsmw.runtime.files import largest_contents
from jaxsmw.wording import count_of

_TYPES = {
    **{"Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4"},
    **{"Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8"},
}
_NAMES = {kind: name for name, kind in _TYPES.items()}
# The kinds of cells. The rows of CellData begin with the vertices and end with the strips.
_KINDS = {"Verts": VERTEX, "Lines": LINE, "Polys": POLYGON, "Strips": STRIP}
_COMPRESSORS = {"vtkZLibDataCompressor", "vtkLZMADataCompressor", "vtkLZ4DataCompressor"}


def parse_vtp(data: bytes) -> Polygons:
    """Parse a file with PolyData. Several pieces become one mesh."""
    file = _Reader(data)
    pieces = file.root.findall("PolyData/Piece")
    if not pieces:
        raise export_again("contains no piece of PolyData")
    points, cells, point_data, cell_data, textures = zip(*map(file.piece, pieces), strict=True)
    first = np.cumsum([0, *map(len, points[:-1])])
    shifted = [
        of_piece._replace(corners=of_piece.corners + at) for of_piece, at in zip(cells, first, strict=True)
    ]
    coordinates = [texture for texture in textures if texture is not None]
    return polygons_of(
        np.concatenate(points),
        joined(shifted),
        _common(point_data),
        _common(cell_data),
        np.concatenate(coordinates) if len(coordinates) == len(pieces) else None,
    )


def _common(pieces: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate each array that all pieces contain, if its number of columns is the same in all pieces."""
    return {
        name: np.concatenate([piece[name] for piece in pieces])
        for name in pieces[0]
        if len({piece[name].shape[1:] if name in piece else None for piece in pieces}) == 1
    }


class _Reader:
    """The XML tree of a file, and a decoder of its arrays."""

    def __init__(self, data: bytes) -> None:
        appended = re.search(rb"<AppendedData\b([^>]*)>\s*_", data)
        xml = data if appended is None else data[: appended.start()] + b"</VTKFile>"
        self.appended = b"" if appended is None else data[appended.end() :].rpartition(b"</AppendedData>")[0]
        self.is_raw = appended is not None and b"raw" in appended[1]
        self.budget = largest_contents(len(data))
        try:
            if b"<!" in re.sub(rb"<!--.*?-->|<!\[CDATA\[", b"", xml, flags=re.DOTALL):
                raise ValueError  # refuses declarations of entities, which can expand without limit
            self.root = ElementTree.fromstring(xml)
        except (ElementTree.ParseError, LookupError, ValueError):
            raise export_again("is not a complete XML file") from None
        if self.root.tag != "VTKFile" or self.root.get("type") != "PolyData":
            raise InputError("is not a VTK file of the type PolyData: extract the surface and save it again.")
        version = self.root.get("version", "0.1")
        if not re.fullmatch(r"[0-2]\.\d{1,3}", version, re.ASCII):
            raise InputError(f"has the unknown version {excerpt(version)}: save the mesh in version 1.0.")
        orders = {"LittleEndian": "<", "BigEndian": ">"}
        headers = {"UInt32": "u4", "UInt64": "u8"}
        order, header = self.root.get("byte_order", "LittleEndian"), self.root.get("header_type", "UInt32")
        self.compressor = self.root.get("compressor", "")
        if order not in orders or header not in headers:
            raise damaged(f"has the unknown byte order {order!a} or header type {header!a}")
        if self.compressor and self.compressor not in _COMPRESSORS:
            raise InputError(
                f"is compressed with {excerpt(self.compressor)}, which is not supported: save it with "
                "ZLib or without compression."
            )
        self.order, self.header = orders[order], np.dtype(orders[order] + headers[header])

    def piece(
        self, piece: ElementTree.Element
    ) -> tuple[np.ndarray, Cells, dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray | None]:
        """Return the points and cells of a piece, the arrays on both, and the texture of the points."""
        n = _integer(piece, "NumberOfPoints", 0)
        position = piece.find("Points/DataArray")
        if position is None:
            raise damaged("a piece has no points")
        points = self.array(position, n, 3).astype(np.float64)
        cells = joined([self.cells(piece, kind) for kind in _KINDS])
        point_data, texture = self.data(piece, "PointData", n)
        cell_data, _ = self.data(piece, "CellData", len(cells.sizes))
        return points, cells, point_data, cell_data, texture

    def data(
        self, piece: ElementTree.Element, tag: str, count: int
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Return the arrays on the points or cells of a piece, and the texture coordinates of the points."""
        arrays: dict[str, np.ndarray] = {}
        section, coordinates = piece.find(tag), None
        if section is None:
            return arrays, coordinates
        texture = section.get("TCoords") if tag == "PointData" else None
        for element in section.findall("DataArray"):
            values = self.array(element, count, _integer(element, "NumberOfComponents", 1))
            name = element.get("Name", "")
            if name == texture and values.shape[1] >= 2 and coordinates is None:
                coordinates = values
            else:
                add_array(arrays, name, values)
        return arrays, coordinates

    def cells(self, piece: ElementTree.Element, tag: str) -> Cells:
        """Return the cells of one kind that a piece contains."""
        count = _integer(piece, f"NumberOf{tag}", 0)
        arrays = {element.get("Name"): element for element in piece.findall(f"{tag}/DataArray")}
        if not count:
            return cells_of(_KINDS[tag], np.zeros(1), np.empty(0, np.int64))
        if not {"offsets", "connectivity"} <= set(arrays):
            raise damaged(f"the {tag} have no offsets or no connectivity")
        ends = self.array(arrays["offsets"], count, 1)[:, 0]
        if not 0 <= ends[-1] < 2**53:
            raise damaged(f"the offsets of the {tag} are not valid")
        corners = self.array(arrays["connectivity"], int(ends[-1]), 1)[:, 0]
        return cells_of(_KINDS[tag], np.concatenate([[0], ends.astype(np.int64)]), corners.astype(np.int64))

    def array(self, element: ElementTree.Element, rows: int, columns: int) -> np.ndarray:
        """Return the numbers of a DataArray (rows, columns)."""
        kind = check_array(_TYPES, element.get("type", ""), columns)
        count, form, text = rows * columns, element.get("format", "ascii"), element.text or ""
        if form == "ascii":
            values = numbers_of(text.split(), kind)
        elif form == "binary":
            values = self.decode(text.strip().encode("ascii", "replace"), False, count, kind)
        elif form == "appended":
            content = self.appended[_integer(element, "offset", 0) :]
            values = self.decode(content, self.is_raw, count, kind)
        else:
            raise damaged(f"has an array in the unknown format {excerpt(form)}")
        if len(values) != count:
            raise damaged(
                f"the array {element.get('Name', '')[:40]!a} has {count_of(len(values), 'number')} instead "
                f"of {count}"
            )
        return values.reshape(rows, columns)

    def decode(self, content: bytes, is_raw: bool, count: int, kind: str) -> np.ndarray:
        """Decode numbers from raw bytes or base64, which begin with their size and can be compressed."""
        expected = count * np.dtype(kind).itemsize
        if expected > self.budget:
            raise damaged(f"declares {count_of(count, 'number')}, more than the file contains")
        self.budget -= expected
        size = self.header.itemsize
        if not self.compressor:
            written, _ = _taken(content, size + expected, is_raw)
            if np.frombuffer(written, self.header, 1)[0] != expected:
                raise damaged(f"an array does not have {count_of(count, 'number')}")
            unpacked = written[size:]
        else:
            head, _ = _taken(content, 3 * size, is_raw)
            blocks, block, last = np.frombuffer(head, self.header).tolist()
            total = (blocks - 1) * block + (last or block) if blocks else 0
            if total != expected:
                raise damaged(f"an array does not have {count_of(count, 'number')}")
            head, content = _taken(content, (3 + blocks) * size, is_raw)
            sizes = np.frombuffer(head, self.header)[3:].tolist()
            packed, _ = _taken(content, sum(sizes), is_raw)
            ends = np.cumsum([0, *sizes]).tolist()
            unpacked = b"".join(
                self.unpack(packed[start:end], last or block if number == blocks - 1 else block)
                for number, (start, end) in enumerate(pairwise(ends))
            )
        return np.frombuffer(unpacked, self.order + kind).astype(kind)

    def unpack(self, packed: bytes, size: int) -> bytes:
        """Unpack a compressed block, which must have the given size."""
        try:
            if self.compressor == "vtkZLibDataCompressor":
                unpacked = zlib.decompressobj().decompress(packed, size or 1)
            elif self.compressor == "vtkLZMADataCompressor":
                unpacked = lzma.LZMADecompressor(memlimit=2**28).decompress(packed, size or 1)
            else:
                unpacked = _unpack_lz4(packed, size)
        except (zlib.error, lzma.LZMAError, EOFError):
            unpacked = b""
        if len(unpacked) != size:
            raise damaged("a compressed array cannot be unpacked")
        return unpacked


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    """Unpack a block that is compressed with LZ4; return nothing if the block is damaged."""
    try:
        import lz4.block
    except ImportError:
        raise InputError(
            "is compressed with LZ4, which needs the package lz4: run pip install "
            "'jaxsmw[vtk]', or save the file with ZLib."
        ) from None
    try:
        return lz4.block.decompress(packed, uncompressed_size=min(size, 255 * len(packed)))
    except (lz4.block.LZ4BlockError, ValueError):
        return b""


def _taken(content: bytes, size: int, is_raw: bool) -> tuple[bytes, bytes]:
    """Return the first `size` bytes of raw content or of base64 text, and the content behind them.

    Base64 text is read to the end of a group of four characters.
    """
    length = size if is_raw else (size + 2) // 3 * 4
    part = content[:length]
    if not is_raw:
        try:
            part = base64.b64decode(part, validate=True)
        except binascii.Error:
            part = b""
    if len(part) < size:
        raise export_again("an array ends early, so the file is truncated or damaged")
    return part[:size], content[length:]


def _integer(element: ElementTree.Element, name: str, default: int) -> int:
    word = element.get(name, str(default)).strip()
    if not re.fullmatch(r"\d{1,18}", word, re.ASCII):
        raise damaged(f"{excerpt(word)} is written where the number {name} should be")
    return int(word)


def format_vtp(data: MeshData) -> Formatted:
    """Format PolyData in version 1.0, with arrays in base64 and compressed with zlib."""
    point_data, cell_data, coordinates = arrays_of(data)
    n, f = len(data.mesh.vertices), len(data.faces)
    point_data, cell_data = ({k: v for k, v in d.items() if k.isprintable()} for d in (point_data, cell_data))
    texture = unique_name("texture", point_data)
    if coordinates is not None:
        point_data[texture] = coordinates
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64" '
        'compressor="vtkZLibDataCompressor">',
        f'<PolyData><Piece NumberOfPoints="{n}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{f}">',
        "<PointData>" if coordinates is None else f'<PointData TCoords="{texture}">',
        *(_array(name, values) for name, values in point_data.items()),
        "</PointData><CellData>",
        *(_array(name, values) for name, values in cell_data.items()),
        "</CellData><Points>",
        _array("Points", data.mesh.vertices),
        "</Points><Polys>",
        _array("connectivity", data.faces.ravel()),
        _array("offsets", 3 * np.arange(1, f + 1)),
        "</Polys></Piece></PolyData></VTKFile>",
        "",
    ]
    notes = omissions(data, "VTP", vertex_data=_fits, face_data=_fits, texture=True)
    return "\n".join(lines).encode(), notes


def _fits(name: str, _: np.ndarray) -> bool:
    """Return whether XML allows every character of a name."""
    return name.isprintable()


def _array(name: str, values: np.ndarray) -> str:
    """Return a DataArray with one compressed block."""
    kind = values.dtype.str[1:]
    content = values.astype("<" + kind).tobytes()
    packed = zlib.compress(content)
    header = np.array([1, len(content), 0, len(packed)] if content else [0, 0, 0], "<u8").tobytes()
    text = base64.b64encode(header) + base64.b64encode(packed if content else b"")
    return (
        f'<DataArray type="{_NAMES[kind]}" Name={quoteattr(name)} NumberOfComponents="{width_of(values)}" '
        f'format="binary">{text.decode()}</DataArray>'
    )
