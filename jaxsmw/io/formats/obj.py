"""Wavefront OBJ files (https://paulbourke.net/dataformats/obj/)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Formatted, Polygons, is_color, omissions, texture_or_note
from jaxsmw.io.formats.text import excerpt, export_again, numbers, polygon_lines, text
from jaxsmw.io.mesh_data import COLORS, MeshData

# A dictionary from each kind of label to the keyword of its lines in OBJ files. Such a line sets the label of
# all faces below it, up to the next line with this keyword.
_LABELS = {"group": "g", "object": "o", "material": "usemtl"}
_NO_NAME = "default"


def parse_obj(data: bytes) -> Polygons:
    """Parse the lines `v`, `vt`, `f`, `g`, `o` and `usemtl`. All groups and objects become one mesh."""
    content = re.sub(r"\\\n+", " ", text(data)) if b"\\" in data else text(data)
    vertex, face = _lines("v"), _lines("f")
    vertex_lines = vertex.findall(content)
    vertices = numbers(vertex_lines, 3)
    if not len(vertices):
        raise InputError("has no line that begins with v: export the mesh again as an OBJ file.")
    lines = face.findall(content)
    ends_in_face = bool(lines) and not content.endswith("\n") and content.endswith(lines[-1])
    slashed = lines if any("/" in line for line in lines) else []
    if slashed:  # corners of the form vertex/texture/normal
        lines = re.sub(r"/\S*", "", "\n".join(lines)).split("\n")
    corners, sizes = polygon_lines([f"{len(line.split())} {line}" for line in lines])
    if not lines and re.search(r"^\s*surf\s", content, re.MULTILINE):
        raise InputError("contains free-form surfaces but no faces: export the mesh as triangles.")
    if ends_in_face and sizes[-1] < 3:
        raise export_again("ends in the middle of a face, so the file is truncated")
    if (corners == 0).any():
        raise export_again("a face uses vertex 0, but OBJ files count from 1")
    face_at = cache(lambda: [match.start() for match in face.finditer(content)])  # found on demand
    written, corners = corners, _counted_backward(corners, sizes, vertex, face_at, content)
    outside = (corners < 1) | (corners > len(vertices))
    if outside.any():
        raise InputError(
            f"a face uses vertex {written[outside.argmax()]:.15g}, but the file has {len(vertices)} v lines: "
            "correct the index or restore the missing vertices."
        )
    labels, names = _labels(content, face_at)
    texture, notes = texture_or_note(lambda: _texture(content, slashed, sizes, face_at))
    return Polygons(
        vertices,
        corners - 1,
        sizes,
        vertex_data=_vertex_colors(vertex_lines),
        face_data=labels,
        texture=texture,
        label_names=names,
        notes=notes,
        lines=len(_lines("l").findall(content)),
    )


def _lines(keyword: str) -> re.Pattern[str]:
    """Return a pattern for all lines that begin with a keyword."""
    return re.compile(rf"^[^\S\n]*{keyword}(?!\S)[^\S\n]*(.*)$", re.MULTILINE)


def _counted_backward(
    corners: np.ndarray,
    sizes: np.ndarray,
    pattern: re.Pattern[str],
    face_at: Callable[[], list[int]],
    content: str,
) -> np.ndarray:
    """Convert negative indices to positive indices. Index -1 is the last element above the face."""
    if not (corners < 0).any():
        return corners
    element_at = [match.start() for match in pattern.finditer(content)]
    above = np.repeat(np.searchsorted(element_at, face_at()), sizes)
    return np.where(corners < 0, corners + above + 1, corners)


def _vertex_colors(lines: list[str]) -> dict[str, Float64[np.ndarray, "n 3"]]:
    """Return the colours that some programs write after the positions, if every line has six numbers."""
    if len(lines[0].split()) != 6 or any(len(line.split()) != 6 for line in lines):
        return {}
    return {COLORS: numbers(lines, 6)[:, 3:]}


def _texture(
    content: str, lines: Sequence[str], sizes: np.ndarray, face_at: Callable[[], list[int]]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the texture coordinates, and the texture vertex of each corner (-1 for none)."""
    if not re.search(r"[^/\s]/[^/\s]", "\n".join(lines)):  # no corner has a texture vertex
        return None
    # A corner begins with the number of its vertex.
    words = [word.split("/") for line in lines for word in line.split() if word[0] != "/"]
    texts = [word[1] if len(word) > 1 else "" for word in words]
    if not any(texts):
        return None
    if len(texts) != sizes.sum():
        raise export_again("a corner of a face has no vertex")
    for word in texts:
        if word and not re.fullmatch(r"[+-]?\d{1,15}", word, re.ASCII):
            raise export_again(f"{excerpt(word)} is written where a texture vertex should be")
    has_texture = np.array([word != "" for word in texts])
    pattern = _lines("vt")
    written = [f"{line} 0" if len(line.split()) == 1 else line for line in pattern.findall(content)]
    coordinates = numbers(written, 2)
    indices = np.array([int(word or 1) for word in texts])
    indices = _counted_backward(indices, sizes, pattern, face_at, content)
    outside = has_texture & ((indices < 1) | (indices > len(coordinates)))
    if outside.any():
        raise export_again(
            f"a face uses texture vertex {texts[int(outside.argmax())]}, but the file has {len(coordinates)} "
            "vt lines"
        )
    return coordinates, np.where(has_texture, indices - 1, -1)


def _labels(
    content: str, face_at: Callable[[], list[int]]
) -> tuple[dict[str, Int64[np.ndarray, " f"]], dict[str, tuple[str, ...]]]:
    """Return the group, the object and the material of each face as labels, and the names of the labels."""
    labels, names_of = {}, {}
    for label, keyword in _LABELS.items():
        lines = list(_lines(keyword).finditer(content)) if f"{keyword} " in content else []
        if not lines:
            continue
        above = np.searchsorted([line.start() for line in lines], face_at()).tolist()
        written = [_NO_NAME] + [" ".join(_decoded(line[1]).split()) or _NO_NAME for line in lines]
        number = {name: i for i, name in enumerate(dict.fromkeys(written[i] for i in above))}
        labels[label] = np.array([number[written[i]] for i in above], np.int64)
        names_of[label] = tuple(number)
    return labels, names_of


def _decoded(name: str) -> str:
    """Decode a name as UTF-8 if its bytes are valid UTF-8. The file was decoded as Latin-1 before."""
    try:
        return name.encode("latin-1").decode("utf-8")
    except UnicodeDecodeError:
        return name


def format_obj(data: MeshData) -> Formatted:
    """Format positions, colours, texture coordinates, triangles and the labels of `parse_obj` as text."""
    colors = data.vertex_data.get(COLORS, np.empty(0))
    columns = data.mesh.vertices
    if _fits_vertices(COLORS, colors):
        scale = 255 if colors.dtype == np.uint8 else 1
        columns = np.hstack([columns, colors / scale])
    lines = [f"v {' '.join(map(repr, row))}" for row in columns.tolist()]
    corners = [[str(i + 1) for i in row] for row in data.faces.tolist()]
    if data.texture is not None:
        coordinates, of_corner = data.texture
        lines += [f"vt {u!r} {v!r}" for u, v in coordinates.tolist()]
        corners = [
            [c if t < 0 else f"{c}/{t + 1}" for c, t in zip(row, textures, strict=True)]
            for row, textures in zip(corners, of_corner.tolist(), strict=True)
        ]
    faces = [f"f {' '.join(row)}" for row in corners]
    for label, keyword in reversed(_LABELS.items()):
        if _fits_faces(data, label):
            faces = _with_labels(faces, data.face_data[label], keyword, data.label_names[label])
    notes = omissions(
        data,
        "OBJ",
        vertex_data=_fits_vertices,
        face_data=lambda name, _: _fits_faces(data, name),
        label_names=lambda name, _: _fits_faces(data, name),
        texture=True,
    )
    return "\n".join([*lines, *faces, ""]).encode(), notes


def _fits_vertices(name: str, values: np.ndarray) -> bool:
    return is_color(name, values) and values.shape[1] == 3


def _fits_faces(data: MeshData, name: str) -> bool:
    """Return whether an OBJ file can store the face data with this name."""
    names = data.label_names.get(name, ())
    return (
        name in _LABELS
        and name in data.face_data
        and bool(names)
        and all(line == " ".join(line.split()) and not re.search(r"[#\\]|^$", line) for line in names)
    )


def _with_labels(faces: list[str], labels: np.ndarray, keyword: str, names: tuple[str, ...]) -> list[str]:
    """Write the name of a label above each face whose label differs from that of the previous face."""
    changes = np.concatenate([[True], labels[1:] != labels[:-1]])
    return [
        f"{keyword} {names[label]}\n{face}" if change else face
        for face, label, change in zip(faces, labels.tolist(), changes.tolist(), strict=True)
    ]
