"""The contents of a mesh file: the parsed polygons, and the mesh together with its data."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.wording import count_of

NOTHING: Mapping[str, Any] = MappingProxyType({})
COLORS, NORMALS, TEXTURE_OF_CORNERS = "colors", "normals", "texcoord"


class Texture(NamedTuple):
    """Texture coordinates of a mesh.

    Along a seam, one vertex has several texture vertices.

    **Attributes:**

    - `coordinates`: the coordinates (u, v) of the texture vertices (t, 2), float64, in units of the picture's
      width and height. The origin of the picture is its lower left corner.
    - `corners`: the 0-based texture vertex of each corner of each triangle (f, 3), int64. The number -1 marks
      a corner without a texture vertex.
    """

    coordinates: np.ndarray
    corners: np.ndarray


class Skin(NamedTuple):
    """The weights that bind the vertices of a mesh to the joints of a skeleton.

    **Attributes:**

    - `joints`: the names of the joints, a tuple of distinct strings.
    - `weights`: the weight of each joint at each vertex (n, joints), float64. The weights are finite numbers
      without unit, as in the file. They are usually from 0 to 1 with sum 1 at each vertex, but neither range
      nor sum is checked.
    """

    joints: tuple[str, ...]
    weights: np.ndarray


Corners: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Texture coordinates (t, 2), and the texture vertex of each corner of each polygon."""


class Polygons(NamedTuple):
    """The polygons of a file, and the data on them.

    `corners` lists the corners of all faces, one face after another. `sizes` contains the number of corners
    of each face. `face_data` has one row per polygon. `texture` consists of texture coordinates (t, 2) and
    the texture vertex of each entry of `corners`. `weld` is True if the format duplicates vertices at seams.
    `lines` is the number of lines besides the faces. `strips` marks the faces that are triangle strips.
    """

    vertices: Float64[np.ndarray, "n 3"]
    corners: np.ndarray
    sizes: Int64[np.ndarray, " f"]
    notes: tuple[str, ...] = ()
    vertex_data: Mapping[str, np.ndarray] = NOTHING
    face_data: Mapping[str, np.ndarray] = NOTHING
    texture: tuple[np.ndarray, np.ndarray] | None = None
    blend_shapes: Mapping[str, np.ndarray] = NOTHING
    skin: Skin | None = None
    label_names: Mapping[str, tuple[str, ...]] = NOTHING
    weld: bool = False
    lines: int = 0
    strips: Bool[np.ndarray, " f"] | None = None

    @property
    def is_strip(self) -> Bool[np.ndarray, " f"]:
        return np.zeros(len(self.sizes), bool) if self.strips is None else self.strips


@dataclass(frozen=True, eq=False)
class MeshData:
    """A mesh together with everything that a file says about its vertices and faces.

    Use `read_mesh_data` to read a `MeshData` from a file. The constructor checks all lengths, types and
    indices, so a `MeshData` is always consistent.

    **Attributes:**

    - `mesh`: the `Mesh` that matching uses, with n vertices. The positions are in the unit of the file.
    - `faces`: all triangles of the file, in the order of the file, before cleaning and welding. The array
      (f, 3), int64, contains 0-based vertices of `mesh`. Polygons are split into fans of triangles.
    - `vertex_data`: a dictionary from names to arrays (n,) or (n, c) with numbers for each vertex. The arrays
      contain integers, floats or Booleans; Booleans are stored as uint8. Colours are called `colors`; they
      are uint8, or floats from 0 to 1. Normals are called `normals`.
    - `face_data`: a dictionary from names to arrays (f,) or (f, c) with numbers for each triangle, of the
      same types.
    - `texture`: a `Texture`, or None. A `Texture` is a pair of arrays: texture coordinates (t, 2), and the
      0-based texture vertex of each corner (f, 3).
    - `blend_shapes`: a dictionary from the names of blend shapes (morph targets) to displacements (n, 3) of
      the vertices, float64, in the unit of the vertices.
    - `skin`: a `Skin`, or None. A `Skin` is a pair: the names of the joints, and the weight of each joint at
      each vertex (n, joints), without unit.
    - `label_names`: a dictionary for arrays of labels 0, 1, … in `vertex_data` or `face_data`. Its keys are
      the names of these arrays, and its values are tuples of the names of the labels. For example,
      `face_data["group"]` of an OBJ file contains the number of each triangle's group, and
      `label_names["group"]` contains the names of all groups.

    **Raises:** `InputError` if an array has a wrong length or type, an index is out of range, or a
    displacement, weight or texture coordinate is not finite.
    """

    mesh: Mesh
    faces: np.ndarray
    vertex_data: Mapping[str, np.ndarray] = field(default_factory=dict)
    face_data: Mapping[str, np.ndarray] = field(default_factory=dict)
    texture: tuple[np.ndarray, np.ndarray] | None = None
    blend_shapes: Mapping[str, np.ndarray] = field(default_factory=dict)
    skin: tuple[tuple[str, ...], np.ndarray] | None = None
    label_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.mesh.vertices)
        faces = _indices(self.faces, n, "faces", "vertices", self._fail)
        f = len(faces)
        checked = {
            "faces": faces,
            "vertex_data": self._rows(self.vertex_data, "vertex data", n, "vertex"),
            "face_data": self._rows(self.face_data, "face data", f, "face"),
            "blend_shapes": {
                name: _real(values, f"the blend shape {name!a}", (n, 3), self._fail)
                for name, values in self.blend_shapes.items()
            },
            "texture": None if self.texture is None else checked_texture(self.texture, f, self._fail),
            "skin": self._checked_skin(n),
            "label_names": {name: tuple(map(str, names)) for name, names in self.label_names.items()},
        }
        for attribute, value in checked.items():
            object.__setattr__(self, attribute, value)
        self._check_labels()

    @property
    def has_attributes(self) -> bool:
        """Whether there are data besides positions and normals. `transfer_attributes` can transfer them."""
        return bool(
            {*self.vertex_data} - {NORMALS}
            or self.face_data
            or self.texture is not None
            or self.blend_shapes
            or self.skin is not None
        )

    def _fail(self, fault: str) -> InputError:
        return InputError(f"{self.mesh.name}: {fault}")

    def _rows(self, data: Mapping[str, Any], what: str, count: int, noun: str) -> dict[str, np.ndarray]:
        """Check data with one row per vertex or face. Integers and floats keep their types."""
        checked = {}
        for name, values in data.items():
            array = np.asarray(values)
            if not name or array.ndim not in (1, 2) or array.dtype.kind not in "biuf" or not array.shape[-1]:
                raise self._fail(
                    f"the {what} {name!a} are {array.dtype.name} of shape {array.shape}: give each array a "
                    f"name, and one number or one row of numbers for each {noun}."
                )
            if len(array) != count:
                raise self._fail(
                    f"the {what} {name!a} have {count_of(len(array), 'row')}, but need {count}: give one row "
                    f"for each {noun}."
                )
            checked[name] = _canonical(array[:, 0] if array.shape[1:] == (1,) else array)
        return checked

    def _checked_skin(self, n: int) -> Skin | None:
        if self.skin is None:
            return None
        joints, weights = self.skin
        if len(set(joints)) != len(joints) or not joints:
            raise self._fail("the names of the joints are not distinct: give each joint its own name.")
        return Skin(tuple(map(str, joints)), _real(weights, "the skin", (n, len(joints)), self._fail))

    def _check_labels(self) -> None:
        for name, names in self.label_names.items():
            arrays = [data[name] for data in (self.vertex_data, self.face_data) if name in data]
            if not arrays or any(
                array.ndim != 1 or array.dtype.kind not in "iu" or not _within(array, len(names))
                for array in arrays
            ):
                raise self._fail(
                    f"the array of labels {name!a} must contain integers from 0 to {len(names) - 1}, one for "
                    "each label name: correct the array or the names."
                )


def checked_texture(texture: Corners, f: int, fail: Callable[[str], InputError]) -> Texture:
    """Check the texture of f triangles."""
    coordinates = _real(texture[0], "the texture", (*np.shape(texture[0])[:1], 2), fail)
    corners = _indices(texture[1], len(coordinates), "the texture's corners", "texture vertices", fail, -1)
    if len(corners) != f:
        raise fail(
            f"the texture has {count_of(len(corners), 'row')} of corners, but the mesh has "
            f"{count_of(f, 'face')}: give one row for each face."
        )
    return Texture(coordinates, corners)


def _real(
    values: Any, what: str, shape: tuple[int, ...], fail: Callable[[str], InputError]
) -> Float64[np.ndarray, "*shape"]:
    array = np.asarray(values)
    if array.shape != shape or array.dtype.kind not in "biuf":
        raise fail(
            f"{what} is {array.dtype.name} of shape {array.shape}, but needs numbers of shape {shape}: "
            "give an array of this shape."
        )
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise fail(f"{what} contains a number that is not finite: repair the numbers.")
    return array


def _within(array: np.ndarray, count: int, first: int = 0) -> bool:
    return not array.size or bool(array.min() >= first and array.max() < count)


def _canonical(array: np.ndarray) -> np.ndarray:
    """Return a contiguous copy in native byte order.

    Booleans become uint8, float16 becomes float32, and extended precision becomes float64.
    """
    kind = {"b": np.uint8, "f2": np.float32, "f16": np.float64, "f12": np.float64}
    wanted = kind.get(array.dtype.str[1:], kind.get(array.dtype.kind, array.dtype.newbyteorder("=")))
    return np.array(array, dtype=wanted, order="C")


def _indices(
    values: Any, count: int, what: str, whole: str, fail: Callable[[str], InputError], first: int = 0
) -> Int64[np.ndarray, "f 3"]:
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
        raise fail(
            f"{what} are {array.dtype.name} of shape {array.shape}: give integers of shape (number of faces, "
            "3)."
        )
    if not _within(array, count, first):
        raise fail(f"{what} use a number outside the {count} {whole}: correct the indices.")
    return array.astype(np.int64)


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
        raise InputError(
            "a triangle strip has fewer than three corners, so the file is damaged: export the mesh again."
        )
    per_face = sizes - 2
    face = np.repeat(np.arange(len(sizes)), per_face)
    start = (np.cumsum(sizes) - sizes)[face]
    step = np.arange(len(face)) - (np.cumsum(per_face) - per_face)[face]
    reversed_ = is_strip[face] & (step % 2 == 1)
    first = np.where(is_strip[face], step, 0)
    corners = first + reversed_, np.where(reversed_, step, step + 1), step + 2
    return start[:, None] + np.stack(corners, axis=1), face


def texture_or_note(parse: Callable[[], Corners | None]) -> tuple[Corners | None, tuple[str, ...]]:
    """Parse a texture. Matching does not need a texture, so a note replaces a texture that cannot be read."""
    try:
        return parse(), ()
    except InputError as error:
        return None, (f"The texture was left out: {error}",)


class Written(NamedTuple):
    """The content of a file to write, and sentences about the data that the file does not contain."""

    content: bytes
    notes: tuple[str, ...]


def always(name: str, values: Any) -> bool:
    """The check for an attribute that a format can hold; see `omissions`."""
    return True


def never(name: str, values: Any) -> bool:
    """The check for an attribute that a format cannot hold; see `omissions`."""
    return False


def omissions(data: MeshData, form: str, **holds: Callable[[str, Any], bool]) -> tuple[str, ...]:
    """Return a sentence for each kind of data that a format cannot hold.

    **Arguments:**

    - `form`: the name of the format.
    - `holds`: one check for each attribute of `MeshData` that the format can hold, under the name of the
      attribute. A check receives the name and the value of an entry, such as an array in `vertex_data`. The
      check returns whether the format can hold the entry.
    """
    skin = dict.fromkeys(data.skin[0]) if data.skin is not None else {}
    kinds: dict[str, tuple[str, Mapping[str, Any]]] = {
        "vertex_data": ("the vertex data ", data.vertex_data),
        "face_data": ("the face data ", data.face_data),
        "blend_shapes": ("the blend shapes ", data.blend_shapes),
        "skin": ("the joints ", skin),
        "label_names": ("the names of the labels ", data.label_names),
    }
    notes = []
    for attribute, (what, values) in kinds.items():
        fits = holds.get(attribute, never)
        names = [name for name, value in values.items() if not fits(name, value)]
        listed = ", ".join(map(ascii, names[:5])) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
        if names:
            notes.append(f"{form} files cannot hold {what}{listed}, so the file does not contain them.")
    if data.texture is not None and "texture" not in holds:
        notes.append(f"{form} files cannot hold texture coordinates, so the file does not contain them.")
    return tuple(notes)


def is_color(name: str, values: np.ndarray) -> bool:
    """Return whether an array contains colours: bytes, or floats from 0 to 1, in three or four columns."""
    if name != COLORS or values.ndim != 2 or values.shape[1] not in (3, 4):
        return False
    return values.dtype == np.uint8 or (values.dtype.kind == "f" and _unit(values))


def _unit(values: np.ndarray) -> bool:
    return bool(((values >= 0) & (values <= 1)).all())


def texture_at_corners(texture: tuple[np.ndarray, np.ndarray]) -> Float64[np.ndarray, "f 6"]:
    """Return the texture coordinates (u0, v0, u1, v1, u2, v2) of each triangle. Missing ones are NaN."""
    coordinates, corners = texture
    return np.vstack([coordinates, [[np.nan, np.nan]]])[corners].reshape(-1, 6)


def texture_of_corners(
    corners: np.ndarray, at_corners: Float64[np.ndarray, "c 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return texture vertices, and the texture vertex of each corner, given the coordinates of all corners.

    Two corners share a texture vertex if they belong to the same vertex and have equal texture coordinates.
    The texture vertices of vertex 0 come first, then the texture vertices of vertex 1, and so on. A corner
    has no texture vertex if its texture coordinates are NaN.
    """
    known = np.isfinite(at_corners).all(axis=1)
    rows = np.column_stack([corners, at_corners])[known]
    distinct, number = np.unique(rows, axis=0, return_inverse=True)
    of_corner = np.full(len(corners), -1)
    of_corner[known] = number.ravel()
    return distinct[:, 1:], of_corner


def is_texture_of_vertices(data: MeshData) -> bool:
    """Return whether texture vertex i belongs to vertex i for all i, so that there is no seam."""
    return (
        data.texture is not None
        and len(data.texture[0]) == len(data.mesh.vertices)
        and np.array_equal(data.texture[1], data.faces)
    )


def unique_name(name: str, taken: Collection[str]) -> str:
    """Return a name that is not taken: the name itself, or the name with a number in parentheses."""
    chosen, number = name, len(taken)  # a search from number 1 is slow if many names are equal
    while chosen in taken:
        number += 1
        chosen = f"{name} ({number})"
    return chosen


def unique_names(names: Iterable[str]) -> list[str]:
    """Return the names, with numbers in parentheses after repeated names."""
    chosen: dict[str, None] = {}
    numbers: dict[str, int] = {}
    for name in names:
        one = name
        while one in chosen:
            numbers[name] = numbers.get(name, 1) + 1
            one = f"{name} ({numbers[name]})"
        chosen[one] = None
    return list(chosen)
