"""Text files in the Object File Format (http://www.geomview.org/docs/html/OFF.html)."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Formatted, Polygons, are_vertices, is_color, omissions
from jaxsmw.io.formats.text import export_again, filled_lines, numbers, polygon_lines
from jaxsmw.io.mesh_data import COLORS, NORMALS, MeshData
from jaxsmw.wording import count_of


def parse_off(data: bytes) -> Polygons:
    """Parse a text file, with the colours, normals and texture coordinates that its keyword announces."""
    lines = filled_lines(data)
    # Some programs write the numbers of vertices and faces on the line of the keyword, sometimes without a
    # space after the keyword.
    keyword = re.match(r"\s*((?:ST)?C?N?)OFF\s*(.*)", lines[0]) if lines else None
    if keyword is None:
        raise InputError("does not begin with OFF, COFF or NOFF: export the mesh again as an OFF file.")
    if keyword[2].startswith("BINARY"):
        raise InputError("is a binary OFF file: save the mesh as text, or as binary PLY.")
    lines = ([keyword[2]] if keyword[2] else []) + lines[1:]
    counts = re.match(r"\s*(\d{1,18})\s+(\d{1,18})(\s|$)", lines[0]) if lines else None
    if counts is None:
        raise export_again("lacks valid numbers of vertices and faces after the keyword OFF")
    n, f = int(counts[1]), int(counts[2])
    lines = lines[1:]
    if len(lines) != n + f:
        raise export_again(
            f"the header declares {n} vertices and {f} faces, but is followed by "
            f"{count_of(len(lines), 'line')}, so the file is truncated or its header is wrong"
        )
    vertices, rows = numbers(lines[:n], 3), lines[n:]
    corners, sizes = polygon_lines(rows)
    vertex_data, coordinates = _vertex_data(lines[:n], keyword[1])
    texture = None
    if coordinates is not None and are_vertices(corners, n):
        texture = coordinates, corners.astype(np.int64)
    return Polygons(
        vertices,
        corners,
        sizes,
        vertex_data=vertex_data,
        face_data=_face_data(rows, sizes),
        texture=texture,
    )


def _vertex_data(lines: list[str], keyword: str) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Return normals and colours, and texture coordinates, if all lines have the announced columns."""
    first = len(lines[0].split()) if keyword and lines else 0
    normals, coordinates = 3 * ("N" in keyword), 2 * ("ST" in keyword)
    colors = first - 3 - normals - coordinates
    if not first or colors not in ((3, 4) if "C" in keyword else (0,)):
        return {}, None
    table = _columns(lines, first)
    if table is None:
        return {}, None
    data = {NORMALS: table[:, 3:6]} if normals else {}
    if colors:
        data[COLORS] = _colors(lines, table, slice(3 + normals, 3 + normals + colors))
    return data, table[:, first - coordinates :] if coordinates else None


def _face_data(lines: list[str], sizes: np.ndarray) -> dict[str, np.ndarray]:
    """Return the colours of the faces if each line ends with three or with four components of a colour."""
    size = int(sizes[0]) if len(sizes) else 0
    colors = len(lines[0].split()) - 1 - size if size else 0
    if colors not in (3, 4) or (sizes != size).any():
        return {}
    table = _columns(lines, 1 + size + colors)
    return {} if table is None else {COLORS: _colors(lines, table, slice(1 + size, None))}


def _columns(lines: list[str], width: int) -> Float64[np.ndarray, "lines columns"] | None:
    """Return the lines as a table, or None if a line does not consist of `width` finite numbers."""
    if any(len(line.split()) != width for line in lines):
        return None
    try:
        table = numbers(lines, width)
    except InputError:
        return None
    return table if np.isfinite(table).all() else None


def _colors(lines: list[str], table: Float64[np.ndarray, "lines columns"], columns: slice) -> np.ndarray:
    """Return bytes if all components are whole numbers up to 255, without an alpha that is opaque."""
    values = table[:, columns]
    whole = not any(set(".eE") & set(word) for line in lines for word in line.split()[columns])
    if whole and ((values >= 0) & (values <= 255)).all():
        values = values.astype(np.uint8)
    opaque = 255 if values.dtype == np.uint8 else 1.0
    return values[:, :3] if values.shape[1] == 4 and (values[:, 3] == opaque).all() else values


def format_off(data: MeshData) -> Formatted:
    """Format positions, triangles and colours as text."""
    # `repr` returns the shortest text from which `float` restores the same number.
    vertices = [f"{x!r} {y!r} {z!r}" for x, y, z in data.mesh.vertices.tolist()]
    faces = [f"3 {i} {j} {k}" for i, j, k in data.faces.tolist()]
    keyword = "OFF"
    if is_color(COLORS, colors := data.vertex_data.get(COLORS, _NONE)):
        vertices, keyword = _with_colors(vertices, colors), "COFF"
    if is_color(COLORS, colors := data.face_data.get(COLORS, _NONE)):
        faces = _with_colors(faces, colors)
    content = "\n".join([keyword, f"{len(vertices)} {len(faces)} 0", *vertices, *faces, ""])
    return content.encode(), omissions(data, "OFF", vertex_data=is_color, face_data=is_color)


_NONE = np.empty(0)


def _with_colors(lines: list[str], colors: Float64[np.ndarray, "rows c"] | np.ndarray) -> list[str]:
    """Append a colour to each line. Colours without an alpha component become opaque."""
    if colors.shape[1] == 3:
        opaque = np.full((len(colors), 1), 255 if colors.dtype == np.uint8 else 1.0, colors.dtype)
        colors = np.hstack([colors, opaque])
    return [f"{line} {' '.join(map(repr, row))}" for line, row in zip(lines, colors.tolist(), strict=True)]
