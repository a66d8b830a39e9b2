"""What all parsers return and all writers need: polygons with their data, and names for the data."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.text import damaged
from jaxsmw.io.mesh_data import COLORS, MeshData, Skin
from jaxsmw.wording import count_of

TEXTURE_OF_CORNERS = "texcoord"
"""The name of the data of faces that contain texture coordinates with seams."""

TextureOfCorners: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Texture coordinates (t, 2), and the texture vertex of each corner in a list of corners, or -1."""
Parsed = TypeVar("Parsed")
"""What a parser returns."""
Formatted: TypeAlias = tuple[bytes, tuple[str, ...]]
"""The bytes of a file, and sentences about the data that it does not contain."""


Part: TypeAlias = tuple[str, np.ndarray, np.ndarray]
"""A named part of a scene: its vertices (n, 3), and its faces (f, 3) as indices of them."""


class Polygons(NamedTuple):
    """The polygons of a file, and the data on them.

    `corners` lists the corners of all faces, one face after another. `sizes` contains the number of corners
    of each face. `strips` marks the faces that are triangle strips; None means none. `face_data` has one row
    per face. `weld` is True if the format duplicates vertices at seams. `lines` counts lines besides the
    faces.
    """

    vertices: Float64[np.ndarray, "n 3"]
    corners: np.ndarray = np.empty(0)
    sizes: Int64[np.ndarray, " f"] = np.empty(0, np.int64)
    notes: tuple[str, ...] = ()
    vertex_data: Mapping[str, np.ndarray] = {}
    face_data: Mapping[str, np.ndarray] = {}
    texture: TextureOfCorners | None = None
    blend_shapes: Mapping[str, np.ndarray] = {}
    skin: Skin | None = None
    label_names: Mapping[str, tuple[str, ...]] = {}
    weld: bool = False
    lines: int = 0
    strips: Bool[np.ndarray, " f"] | None = None


def triangles_of(
    sizes: Int64[np.ndarray, " f"], is_strip: Bool[np.ndarray, " f"]
) -> tuple[Int64[np.ndarray, "t 3"], Int64[np.ndarray, " t"]]:
    """Split polygons and triangle strips into triangles.

    The triangles of a polygon (c0, c1, …) are (c0, ci, ci+1), and a polygon of two corners has none. The
    triangles of a strip are (ci, ci+1, ci+2), and every second of them is reversed.

    Return the corners of each triangle (t, 3), as indices into the list of all corners, and the face from
    which each triangle comes (t,).
    """
    if (sizes < 2).any():
        at = int((sizes < 2).argmax())
        raise InputError(
            f"face {at} has {count_of(int(sizes[at]), 'corner')}, but needs at least three: remove the face."
        )
    if (sizes[is_strip] < 3).any():
        raise damaged("a triangle strip has fewer than three corners")
    per_face = sizes - 2
    face = np.repeat(np.arange(len(sizes)), per_face)
    start = (np.cumsum(sizes) - sizes)[face]
    step = np.arange(len(face)) - (np.cumsum(per_face) - per_face)[face]
    odd = is_strip[face] & (step % 2 == 1)
    first = np.where(is_strip[face], step, 0)
    corners = first + odd, np.where(odd, step, step + 1), step + 2
    return start[:, None] + np.stack(corners, axis=1), face


# The largest number of vertices of a scene, in which a small file can repeat its meshes.
_MOST_VERTICES = 10**7


def check_number_of_vertices(number: int) -> None:
    """Refuse a scene with too many vertices."""
    if number > _MOST_VERTICES:
        raise InputError(f"describes more than {_MOST_VERTICES} vertices: decimate the mesh.")


def placed(vertices: np.ndarray, faces: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Apply a transform (4, 4) to vertices (n, 3), and keep the orientation of their faces (f, 3)."""
    moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    return moved, faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def joined(parts: Iterable[Part]) -> Polygons:
    """Join the parts of a scene."""
    names, vertices, faces, number = [], [], [], 0
    for name, of_part, corners in parts:
        if len(corners) and not are_vertices(corners, len(of_part)):
            raise damaged(f"a triangle of {name!a} uses a vertex that does not exist")
        names.append(name)
        vertices.append(of_part)
        faces.append(corners + number)
        number += len(of_part)
        check_number_of_vertices(number)
    if not names:
        raise InputError("contains no triangles: export the mesh again as triangles.")
    sizes = [len(of_part) for of_part in faces]
    face_data, label_names = face_groups(names, sizes)
    corners = np.concatenate(faces).ravel()
    return Polygons(
        np.concatenate(vertices),
        corners,
        np.full(sum(sizes), 3),
        face_data=face_data,
        label_names=label_names,
    )


def face_groups(
    names: Sequence[str], sizes: Sequence[int]
) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, ...]]]:
    """Return the face data `group`, and its label names, of parts with the given numbers of faces."""
    if len(names) < 2:
        return {}, {}
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return {"group": np.repeat([numbers[name] for name in names], sizes)}, {"group": tuple(numbers)}


def are_vertices(corners: np.ndarray, n: int) -> bool:
    """Return whether all corners are among n vertices. `make_mesh` refuses other corners."""
    return bool(((corners >= 0) & (corners < n) & (corners == np.floor(corners))).all())


def texture_or_note(parse: Callable[[], Parsed | None]) -> tuple[Parsed | None, tuple[str, ...]]:
    """Parse a texture. Matching does not need a texture, so a note replaces a texture that cannot be read."""
    try:
        return parse(), ()
    except InputError as error:
        return None, (f"The texture was left out: {error}",)


def omissions(data: MeshData, form: str, **holds: bool | Callable[[str, Any], bool]) -> tuple[str, ...]:
    """Return a sentence for each kind of data that a format cannot hold.

    `holds` maps attributes of `MeshData` that the format called `form` can hold to True, or to a function
    that receives the name and the value of an entry, and returns whether the format can hold it.
    """
    kinds: dict[str, tuple[str, Mapping[str, Any]]] = {
        "vertex_data": ("the vertex data", data.vertex_data),
        "face_data": ("the face data", data.face_data),
        "blend_shapes": ("the blend shapes", data.blend_shapes),
        "skin": ("the joints", {} if data.skin is None else dict.fromkeys(data.skin.joints)),
        "label_names": ("the names of the labels", data.label_names),
        "texture": ("texture", {} if data.texture is None else {"coordinates": data.texture}),
    }
    notes = []
    for attribute, (what, values) in kinds.items():
        fits = holds.get(attribute, False)
        names = [n for n, value in values.items() if not (fits if isinstance(fits, bool) else fits(n, value))]
        quoted = names if attribute == "texture" else [*map(ascii, names)]
        listed = ", ".join(quoted[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
        if names:
            notes.append(f"{form} files cannot hold {what} {listed}, so the file does not contain them.")
    return tuple(notes)


def is_color(name: str, values: np.ndarray) -> bool:
    """Return whether an array contains colours: bytes, or floats from 0 to 1, in three or four columns."""
    if name != COLORS or values.ndim != 2 or values.shape[1] not in (3, 4):
        return False
    in_range = values.dtype.kind == "f" and bool(((values >= 0) & (values <= 1)).all())
    return values.dtype == np.uint8 or in_range


def width_of(values: np.ndarray) -> int:
    """Return the number of columns of an array (rows,) or (rows, columns)."""
    return values.shape[1] if values.ndim == 2 else 1


def is_texture_of_vertices(data: MeshData) -> bool:
    """Return whether texture vertex i belongs to vertex i for all i, so that there is no seam."""
    return (
        data.texture is not None
        and len(data.texture.coordinates) == len(data.mesh.vertices)
        and np.array_equal(data.texture.corners, data.faces)
    )


def unique_name(name: str, taken: Collection[str]) -> str:
    """Return a name that is not taken: the name itself, or the name with a number in parentheses."""
    free, number = name, len(taken)  # a search from number 1 is slow if many names are equal
    while free in taken:
        number += 1
        free = f"{name} ({number})"
    return free


def unique_names(names: Iterable[str]) -> list[str]:
    """Return the names, with numbers in parentheses after repeated names."""
    unique: dict[str, None] = {}
    numbers: dict[str, int] = {}
    for name in names:
        free = name
        while free in unique:
            numbers[name] = numbers.get(name, 1) + 1
            free = f"{name} ({numbers[name]})"
        unique[free] = None
    return list(unique)
