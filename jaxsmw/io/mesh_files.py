"""Readers of mesh files in the formats OFF, OBJ, PLY, STL and MAT, and writers of OFF and PLY files.

Vertices must keep their order, and a damaged file must cause one clear error message. Therefore this module
does not use the readers of other libraries. The reader of libigl accepts indices out of range and aborts the
process on some invalid headers. The reader of trimesh splits and drops vertices of OBJ files, and it cannot
read binary PLY files whose polygons have different numbers of corners.
"""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from numpy.typing import ArrayLike

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, count_of, first_equal_rows, make_mesh
from jaxsmw.io.mat_files import find_structs, is_real, parse_variables
from jaxsmw.io.text import is_number
from jaxsmw.runtime.files import atomic_write, read_bytes


def read_mesh(path: str | os.PathLike[str], *, weld: bool = False) -> Mesh:
    """Read a triangle mesh from an OFF, OBJ, PLY, STL or MAT file.

    Vertices keep the order of the file. An STL file contains only the corners of triangles, so corners at
    exactly the same position become one vertex. The vertices of an STL file are numbered in the order in
    which their positions first appear. Faces with more than three corners are split into fans of triangles.
    Colours, normals and texture coordinates are ignored.

    **Arguments:**

    - `path`: the file. The suffix, in upper or lower case, determines the format:
        - `.off`: a text file, optionally with colours or normals (COFF, NOFF).
        - `.obj`: a text file. Only the `v` and `f` lines are read.
        - `.ply`: a text file, or a binary file in either byte order.
        - `.stl`: a text file or a binary file.
        - `.mat`: a file with a struct that has the coordinates X, Y and Z (or a matrix VERT) and the 1-based
          faces TRIV, such as `surface` in the TOSCA data set. The struct may be a field of another struct, as
          in the files of `write_spectrum`.
    - `weld`: if True, vertices at exactly the same position are merged. Faces then use only the
        lowest-numbered of these vertices. The other vertices stay in the mesh without faces, so no vertex is
        renumbered. Welding has no effect on an STL file, whose corners are always merged.

    **Returns:**

    A `Mesh` whose `name` is the path, with positions (n, 3) in the unit of the file and 0-based faces (f, 3).
    The `notes` of the mesh report changes such as dropped faces, and peculiarities such as unreferenced
    vertices.

    **Raises:**

    `InputError` if the file cannot be read, does not have the format of its suffix, ends early, or contains
    data after the declared end. `InputError` is also raised if `make_mesh` refuses the mesh, for example
    because an index is out of range, a position is not finite, or all faces are degenerate.
    """
    path = Path(path)
    data = read_bytes(path)
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise InputError(
            f"{path}: the suffix {path.suffix!r} does not belong to a known mesh format: convert the "
            f"mesh to one of {', '.join(_PARSERS)}."
        )
    try:
        polygons = parse(data)
        faces = _fans(polygons.corners, polygons.sizes)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    notes = list(polygons.notes)
    large = int((polygons.sizes > 3).sum())
    if large:
        notes.append(f"{count_of(large, 'face')} with more than three corners split into triangles.")
    return make_mesh(polygons.vertices, faces, name=str(path), weld=weld, notes=notes)


class _Polygons(NamedTuple):
    """The polygons of a file.

    `corners` lists the corners of all faces, one face after another. `sizes` contains the number of corners
    of each face.
    """

    vertices: Float64[np.ndarray, "n 3"]
    corners: np.ndarray
    sizes: Int64[np.ndarray, " f"]
    notes: tuple[str, ...] = ()


def _fans(corners: np.ndarray, sizes: Int64[np.ndarray, " f"]) -> np.ndarray:
    """Split each polygon (c0, c1, …) into the triangles (c0, ci, ci+1), and return all triangles (t, 3)."""
    if (sizes < 3).any():
        at = int((sizes < 3).argmax())
        raise InputError(
            f"face {at} has {count_of(int(sizes[at]), 'corner')}, but needs at least three: remove the face."
        )
    per_face = sizes - 2
    apex = np.repeat(np.cumsum(sizes) - sizes, per_face)
    step = np.arange(len(apex)) - np.repeat(np.cumsum(per_face) - per_face, per_face)
    return np.stack([corners[apex], corners[apex + step + 1], corners[apex + step + 2]], axis=1)


def _text(data: bytes) -> str:
    """Decode the text of a file, convert all line ends to newlines, and remove comments."""
    # Latin-1 can decode every byte, and the parsers need only ASCII characters.
    text = data.removeprefix(codecs.BOM_UTF8).replace(b"\r", b"\n").decode("latin-1")
    return re.sub("#[^\n]*", "", text) if "#" in text else text


def _numbers(lines: list[str], columns: int) -> Float64[np.ndarray, "lines columns"]:
    """Return the numbers in the first columns of each line."""
    if not lines:
        return np.empty((0, columns))
    try:
        if "" in lines:  # loadtxt would skip an empty line
            raise ValueError
        return np.loadtxt(lines, usecols=range(columns), comments=None, ndmin=2)
    except ValueError:
        culprit = next((line for line in lines if not _starts_with_numbers(line, columns)), lines[0])
        raise InputError(
            f"{_excerpt(culprit)} is written where {count_of(columns, 'number')} should be, so the file is "
            "damaged or its header is wrong: export the mesh again."
        ) from None


def _starts_with_numbers(line: str, columns: int) -> bool:
    words = line.split()[:columns]
    return len(words) == columns and all(is_number(word, finite=False) for word in words)


def _excerpt(line: str) -> str:
    """Return the first 40 characters of a line, escaped for a message."""
    return ascii(" ".join(line.split())[:40])


def _polygon_lines(lines: list[str]) -> tuple[Float64[np.ndarray, " corners"], Int64[np.ndarray, " f"]]:
    """Parse lines of the form `size corner corner …`, one per face, into corners and sizes."""
    sizes = _numbers(lines, 1)[:, 0]
    longest = max(map(len, lines), default=0)
    possible = (sizes >= 0) & (sizes <= longest) & (np.floor(sizes) == sizes)
    if not possible.all():
        raise InputError(
            f"{_excerpt(lines[int(possible.argmin())])} does not begin with the number of corners of a face, "
            "so the file is damaged or its header is wrong: export the mesh again."
        )
    sizes = sizes.astype(np.int64)
    starts = np.cumsum(sizes) - sizes
    rows_of_size = {size: np.flatnonzero(sizes == size) for size in np.unique(sizes).tolist()}
    tables = {size: _numbers([lines[i] for i in rows], size + 1) for size, rows in rows_of_size.items()}
    corners = np.empty(sizes.sum())
    for size, rows in rows_of_size.items():
        corners[starts[rows][:, None] + np.arange(size)] = tables[size][:, 1:]
    return corners, sizes


def _parse_off(data: bytes) -> _Polygons:
    """Parse a text file in the Object File Format (http://www.geomview.org/docs/html/OFF.html)."""
    lines = [line for line in _text(data).split("\n") if line and not line.isspace()]
    # Some programs write the numbers of vertices and faces on the line of the keyword, sometimes without a
    # space after the keyword.
    keyword = re.match(r"\s*(?:ST)?C?N?OFF\s*(.*)", lines[0]) if lines else None
    if keyword is None:
        raise InputError("does not begin with OFF, COFF or NOFF: export the mesh again as an OFF file.")
    if keyword[1].startswith("BINARY"):
        raise InputError("is a binary OFF file: save the mesh as text, or as binary PLY.")
    lines = ([keyword[1]] if keyword[1] else []) + lines[1:]
    counts = re.match(r"\s*(\d{1,18})\s+(\d{1,18})(\s|$)", lines[0]) if lines else None
    if counts is None:
        raise InputError(
            "lacks the numbers of vertices and faces after the keyword OFF: export the mesh again."
        )
    n, f = int(counts[1]), int(counts[2])
    lines = lines[1:]
    if len(lines) != n + f:
        raise InputError(
            f"the header declares {n} vertices and {f} faces, but is followed by "
            f"{count_of(len(lines), 'line')}, so the file is truncated or its header is wrong: export the "
            "mesh again."
        )
    return _Polygons(_numbers(lines[:n], 3), *_polygon_lines(lines[n:]))


def _parse_obj(data: bytes) -> _Polygons:
    """Parse the `v` and `f` lines of a Wavefront OBJ file. All groups and objects become one mesh."""
    text = re.sub(r"\\\n+", " ", _text(data)) if b"\\" in data else _text(data)
    vertex, face = (re.compile(rf"^[^\S\n]*{keyword}(?!\S)[^\S\n]*(.*)$", re.MULTILINE) for keyword in "vf")
    vertices = _numbers(vertex.findall(text), 3)
    if not len(vertices):
        raise InputError("has no line that begins with v: export the mesh again as an OBJ file.")
    lines = face.findall(text)
    ends_in_face = bool(lines) and not text.endswith("\n") and text.endswith(lines[-1])
    if any("/" in line for line in lines):  # corners of the form vertex/texture/normal
        lines = re.sub(r"/\S*", "", "\n".join(lines)).split("\n")
    corners, sizes = _polygon_lines([f"{len(line.split())} {line}" for line in lines])
    if ends_in_face and sizes[-1] < 3:
        raise InputError("ends in the middle of a face, so the file is truncated: export the mesh again.")
    if (corners == 0).any():
        raise InputError("a face uses vertex 0, but OBJ files count from 1: export the mesh again.")
    if (corners < 0).any():  # a negative index counts backward from the last vertex above its face
        vertex_at = [match.start() for match in vertex.finditer(text)]
        face_at = [match.start() for match in face.finditer(text)]
        above = np.repeat(np.searchsorted(vertex_at, face_at), sizes)
        corners = np.where(corners < 0, corners + above + 1, corners)
    return _Polygons(vertices, corners - 1, sizes)


_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def _parse_stl(data: bytes) -> _Polygons:
    """Parse an STL file, which is a list of separate triangles (https://www.fabbers.com/tech/STL_Format)."""
    header = 84
    count = int.from_bytes(data[80:header], "little")
    # Both text files and some binary files begin with "solid". Therefore a file is treated as binary if its
    # length fits its header.
    if len(data) >= header and len(data) == header + count * _FACET.itemsize:
        corners = np.frombuffer(data, _FACET, offset=header)["corners"].reshape(-1, 3).astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"facet" in data.lower():
        text = _text(data).lower()
        corners = _numbers(
            [" ".join(words) for words in re.findall(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", text)], 3
        )
        facets = len(re.findall(r"\bendfacet\b", text))
        if len(corners) != 3 * facets or "endsolid" not in text:
            raise InputError(
                f"has {count_of(facets, 'complete facet')} and {count_of(len(corners), 'corner')}, but must "
                "have three corners per facet and end with endsolid, so the file is truncated or damaged: "
                "export the mesh again."
            )
    elif len(data) >= header:
        raise InputError(
            f"the header declares {count} triangles, which does not fit the file's {len(data)} bytes, so the "
            "file is truncated or not in the STL format: export the mesh again."
        )
    else:
        raise InputError("is neither a text nor a binary STL file: export the mesh again.")
    appearance, faces = np.unique(first_equal_rows(corners), return_inverse=True)
    note = (
        "STL files have no shared vertices: corners at the same position were merged into "
        f"{count_of(len(appearance), 'vertex')}, numbered by first appearance."
    )
    return _Polygons(corners[appearance], faces, np.full(len(corners) // 3, 3), (note,))


_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_PLY_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    """A property of a PLY element, which has one number or one list of numbers per row.

    `type` is the type of the numbers. `length` is the type of the lengths of the lists, or None for a
    property with one number per row.
    """

    type: np.dtype
    length: np.dtype | None


class _Column(NamedTuple):
    """The values of a property in all rows, one row after another, and the number of values in each row."""

    values: np.ndarray
    sizes: np.ndarray


def _parse_ply(data: bytes) -> _Polygons:
    """Parse a text or binary file in the Polygon File Format (https://paulbourke.net/dataformats/ply/)."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if first is None:
        raise InputError("does not begin with ply: export the mesh again as a PLY file.")
    newline = first[1]
    last = re.search(newline + rb"end_header[ \t]*" + newline, data)
    if last is None:
        raise InputError(
            "the header has no end_header line, so the file is truncated or damaged: export the mesh again."
        )
    header = data[first.end() : last.start()].decode("latin-1").split(newline.decode())
    encoding, elements = _ply_header(header)
    body = data[last.end() :]
    if encoding == "ascii":
        # Text is converted to a binary body of float64 numbers, so one parser serves both encodings.
        words = body.split()
        try:
            if re.search(rb"[^\s\w.+-]|_", body):  # NumPy would read 1_0 as 10
                raise ValueError
            body = np.array(words, dtype=np.float64).tobytes()
        except ValueError:
            texts = (word.decode("latin-1") for word in words)
            culprit = _excerpt(next(text for text in texts if not is_number(text, finite=False)))
            raise InputError(
                f"{culprit} is written where a number should be: export the mesh again."
            ) from None

    tables, offset = {}, 0
    for name, (count, properties) in elements.items():
        try:
            tables[name], offset = _ply_table(body, offset, count, properties)
        except EOFError:
            raise InputError(
                f"the header declares {count} rows of {_excerpt(name)}, but the file ends within these rows, "
                "so the file is truncated or its header is wrong: export the mesh again."
            ) from None
    if body[offset:].strip():
        raise InputError(
            "continues after the last declared row, so the header is wrong: export the mesh again."
        )

    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    position = [vertex[axis].values for axis in "xyz" if axis in vertex and (vertex[axis].sizes == 1).all()]
    if len(position) < 3:
        raise InputError("has no properties x, y and z for its vertices: export the mesh again.")
    corners = face.get("vertex_indices", face.get("vertex_index"))
    if corners is None:
        raise InputError("has no faces with vertex_indices: export the mesh again as a triangle mesh.")
    return _Polygons(np.stack(position, axis=1, dtype=np.float64), *corners)


def _ply_header(lines: list[str]) -> tuple[str, dict[str, tuple[int, dict[str, _Property]]]]:
    """Return the encoding, and a dictionary from element names to row counts and properties."""
    formats = [line.split()[1:] for line in lines if re.match(r"format(\s|$)", line)]
    if len(formats) != 1 or formats[0] not in [[encoding, "1.0"] for encoding in _PLY_BYTE_ORDERS]:
        raise InputError(
            f"the header does not name exactly one of the formats {', '.join(_PLY_BYTE_ORDERS)} in version "
            "1.0: export the mesh again."
        )
    encoding = formats[0][0]

    def number(name: str) -> np.dtype:
        return np.dtype(np.float64 if encoding == "ascii" else _PLY_BYTE_ORDERS[encoding] + _PLY_TYPES[name])

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
                _PLY_TYPES.get(length, "f")[0] in "iu"
                and kind in _PLY_TYPES
                and properties is not None
                and name not in properties
            ):
                properties[name] = _Property(number(kind), number(length))
            case ["property", kind, name] if (
                kind in _PLY_TYPES and properties is not None and name not in properties
            ):
                properties[name] = _Property(number(kind), None)
            case _:
                raise InputError(
                    f"the header contains the invalid line {_excerpt(line)}: export the mesh again."
                )
    return encoding, elements


def _ply_table(
    body: bytes, offset: int, count: int, properties: dict[str, _Property]
) -> tuple[dict[str, _Column], int]:
    """Return the columns of the table that begins at `offset`, and the offset of the table's end.

    **Raises:** `EOFError` if the body ends within the table.
    """
    shortest = sum((p.length or p.type).itemsize for p in properties.values())
    if count * shortest > len(body) - offset:
        raise EOFError
    if not count or not properties:
        return {name: _Column(np.empty(0), np.empty(0, np.int64)) for name in properties}, offset

    # In most files, all lists of a property have the same length. NumPy then reads all rows together, as one
    # array of records.
    spans, _ = _ply_row(body, offset, properties)
    sizes = {name: size for name, (_, size) in zip(properties, spans, strict=True)}
    lengths = {name: f"length of {name}" for name, (_, length) in properties.items() if length}
    fields: list[tuple] = []
    for name, (kind, length) in properties.items():
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
    for (name, (kind, _)), column in zip(properties.items(), zip(*rows, strict=True), strict=True):
        values = b"".join([body[start : start + size * kind.itemsize] for start, size in column])
        columns[name] = _Column(np.frombuffer(values, kind), np.array([size for _, size in column]))
    return columns, offset


def _ply_row(body: bytes, offset: int, properties: dict[str, _Property]) -> tuple[list[tuple[int, int]], int]:
    """Return the span of each property in a row, and the offset of the row's end.

    A span consists of the offset of the property's first value and the number of the property's values.

    **Raises:** `EOFError` if the body ends within the row.
    """
    spans = []
    for kind, length in properties.values():
        size = 1
        if length:
            start, offset = offset, offset + length.itemsize
            if offset > len(body):
                raise EOFError
            written = np.frombuffer(body, length, 1, start)[0]
            if not 0 <= written <= len(body) or written % 1:
                raise InputError(
                    f"a list declares {written:.15g} numbers, so the file is damaged: export the mesh again."
                )
            size = int(written)
        spans.append((offset, size))
        offset += size * kind.itemsize
    if offset > len(body):
        raise EOFError
    return spans, offset


def _parse_mat(data: bytes) -> _Polygons:
    """Parse a `.mat` file with one struct that has faces TRIV and columns X, Y, Z (or a matrix VERT).

    The struct may be nested in other structs.
    """
    structs = find_structs(parse_variables(data), "TRIV")
    if len(structs) > 1:
        raise InputError(
            f"contains {len(structs)} shapes ({', '.join(structs)}): save each shape in a separate file."
        )
    name, surface = next(iter(structs.items()), ("", {}))
    columns = ("X", "Y", "Z") if "X" in surface else ("VERT",)
    given = [field for field in ("TRIV", *columns) if field in surface]
    for field in given:
        if not is_real(surface[field]):  # a conversion to float64 would drop imaginary parts
            raise InputError(
                f"{f'{name}.{field}'.lstrip('.')} is not an array of real numbers: save real coordinates and "
                "vertex indices."
            )
    vertices = faces = np.empty(0)
    if len(given) == 1 + len(columns) and len({len(surface[field]) for field in columns}) == 1:
        vertices = np.column_stack([surface[field] for field in columns]).astype(np.float64)
        faces = surface["TRIV"].astype(np.float64)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise InputError(
            "contains no struct 'surface' with X, Y, Z (or VERT) and TRIV, as in the TOSCA data set: save "
            "such a struct, or export the mesh as OFF or PLY."
        )
    return _Polygons(vertices, faces.ravel() - 1, np.full(len(faces), 3))


_PARSERS: dict[str, Callable[[bytes], _Polygons]] = {
    ".off": _parse_off,
    ".obj": _parse_obj,
    ".ply": _parse_ply,
    ".stl": _parse_stl,
    ".mat": _parse_mat,
}
MESH_SUFFIXES = tuple(_PARSERS)


def write_mesh(path: str | os.PathLike[str], mesh: Mesh, *, colors: ArrayLike | None = None) -> None:
    """Write a mesh to an OFF file (text) or to a PLY file (binary, little endian).

    `read_mesh` reads the same faces and exactly the same vertex positions from the file. The write is atomic:
    an incomplete file never appears under this name.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix, `.off` or `.ply`, determines the format.
    - `mesh`: the mesh with n vertices, a `Mesh`.
    - `colors`: the red, green and blue components of the colour of each vertex (n, 3), as floats from 0 to 1
        or as uint8. None, the default, writes no colours. An OFF file with colours begins with COFF.

    **Raises:**

    `InputError` for another suffix, colours of another shape, type or range, or a file that cannot be
    written.
    """
    path = Path(path)
    form = _FORMATTERS.get(path.suffix.lower())
    if form is None:
        raise InputError(
            f"{path}: meshes cannot be written as {path.suffix!r}: choose a name that ends in "
            f"{' or '.join(_FORMATTERS)}."
        )
    content = form(mesh, None if colors is None else _bytes_of_colors(colors, len(mesh.vertices)))
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _bytes_of_colors(colors: ArrayLike, n: int) -> UInt8[np.ndarray, "n 3"]:
    array = np.asarray(colors)
    if array.shape != (n, 3):
        raise InputError(
            f"colors have shape {array.shape}, but {n} vertices need ({n}, 3): give one row for each vertex."
        )
    if array.dtype == np.uint8:
        return array
    if array.dtype.kind != "f" or not ((array >= 0) & (array <= 1)).all():
        raise InputError(
            "colors are neither uint8 nor floats from 0 to 1: convert the colors to one of these types."
        )
    return np.rint(255 * array.astype(np.float64)).astype(np.uint8)


def _format_off(mesh: Mesh, colors: UInt8[np.ndarray, "n 3"] | None) -> bytes:
    # `repr` returns the shortest text from which `float` restores the same number.
    vertices = [f"{x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    if colors is not None:
        vertices = [f"{v} {r} {g} {b} 255" for v, (r, g, b) in zip(vertices, colors.tolist(), strict=True)]
    faces = [f"3 {i} {j} {k}" for i, j, k in mesh.faces.tolist()]
    header = ["OFF" if colors is None else "COFF", f"{len(vertices)} {len(faces)} 0"]
    return "\n".join([*header, *vertices, *faces, ""]).encode()


def _format_ply(mesh: Mesh, colors: UInt8[np.ndarray, "n 3"] | None) -> bytes:
    fields: list[tuple] = [(axis, "<f8") for axis in "xyz"]
    if colors is not None:
        fields += [(channel, "u1") for channel in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), fields)
    for axis, values in zip("xyz", mesh.vertices.T, strict=True):
        vertices[axis] = values
    if colors is not None:
        for channel, values in zip(("red", "green", "blue"), colors.T, strict=True):
            vertices[channel] = values
    faces = np.empty(len(mesh.faces), [("size", "u1"), ("corners", "<i4", 3)])
    faces["size"], faces["corners"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property {'double' if kind == '<f8' else 'uchar'} {name}" for name, kind in fields),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


_FORMATTERS: dict[str, Callable[[Mesh, np.ndarray | None], bytes]] = {
    ".off": _format_off,
    ".ply": _format_ply,
}
