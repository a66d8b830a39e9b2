"""Meshes together with their colours, textures, blend shapes, skins and other data, and overlays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.errors import InputError, naming
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.wording import count_of

COLORS, NORMALS = "colors", "normals"
"""The names of the vertex data with these meanings."""


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


class Skeleton(NamedTuple):
    """The joints of a skin in the bind pose: the pose in which they were bound to the mesh.

    **Attributes:**

    - `parents`: the number of the parent of each joint (joints,), int64; -1 for a joint without a parent.
    - `bind_matrices`: the place of each joint (joints, 4, 4), float64. A matrix takes the coordinates of the
      joint to those of the mesh. glTF stores the inverses.
    """

    parents: np.ndarray
    bind_matrices: np.ndarray


class Skin(NamedTuple):
    """The weights that bind the vertices of a mesh to the joints of a skeleton.

    **Attributes:**

    - `joints`: the names of the joints, a tuple of distinct strings.
    - `weights`: the weight of each joint at each vertex (n, joints), float64. The weights are finite numbers
      without unit, as in the file. They are usually from 0 to 1 with sum 1 at each vertex, but neither range
      nor sum is checked.
    - `skeleton`: the `Skeleton`, or None if the file does not say where the joints are.
    """

    joints: tuple[str, ...]
    weights: np.ndarray
    skeleton: Skeleton | None = None


@dataclass(frozen=True, eq=False)
class MeshData:
    """A mesh together with everything that a file says about its vertices and faces.

    The constructor checks all lengths, types and indices, so a `MeshData` is always consistent.

    **Attributes:**

    - `mesh`: the `Mesh` that matching uses, with n vertices. The positions are in the unit of the file.
    - `faces`: all triangles of the file (f, 3), int64, 0-based vertices of `mesh`, in the order of the file,
      before cleaning and welding. Polygons are split into fans of triangles.
    - `vertex_data`: a dictionary from names to arrays (n,) or (n, c) with numbers for each vertex: integers,
      floats, or Booleans, which are stored as uint8. Colours are called `colors`; they are uint8, or floats
      from 0 to 1. Normals are called `normals`.
    - `face_data`: a dictionary from names to arrays (f,) or (f, c) with numbers for each triangle, of the
      same types.
    - `texture`: a `Texture`, or None.
    - `blend_shapes`: a dictionary from the names of blend shapes (morph targets) to displacements (n, 3) of
      the vertices, float64, in the unit of the vertices.
    - `skin`: a `Skin`, or None.
    - `label_names`: a dictionary from the names of arrays of labels 0, 1, … in `vertex_data` or `face_data`
      to tuples of the names of the labels. For example, `face_data["group"]` of an OBJ file contains the
      number of each triangle's group, and `label_names["group"]` contains the names of all groups.

    **Raises:** `InputError` if an array has a wrong length or type, an index is out of range, or a
    displacement, weight or texture coordinate is not finite.
    """

    mesh: Mesh
    faces: np.ndarray
    vertex_data: Mapping[str, np.ndarray] = field(default_factory=dict)
    face_data: Mapping[str, np.ndarray] = field(default_factory=dict)
    texture: Texture | None = None
    blend_shapes: Mapping[str, np.ndarray] = field(default_factory=dict)
    skin: Skin | None = None
    label_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.mesh.vertices)
        with naming(self.mesh.name):
            faces = _indices(self.faces, n, "faces", "vertices")
            checked = {
                "faces": faces,
                "vertex_data": _rows(self.vertex_data, "vertex data", n, "vertex"),
                "face_data": _rows(self.face_data, "face data", len(faces), "face"),
                "blend_shapes": {
                    name: _real(values, f"the blend shape {name!a}", (n, 3))
                    for name, values in self.blend_shapes.items()
                },
                "texture": None if self.texture is None else checked_texture(self.texture, len(faces)),
                "skin": None if self.skin is None else _checked_skin(Skin(*self.skin), n),
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

    def _check_labels(self) -> None:
        for name, names in self.label_names.items():
            arrays = [data[name] for data in (self.vertex_data, self.face_data) if name in data]
            if not arrays or any(
                array.ndim != 1 or array.dtype.kind not in "iu" or not _within(array, len(names))
                for array in arrays
            ):
                raise InputError(
                    f"the array of labels {name!a} must contain integers from 0 to {len(names) - 1}, one for "
                    "each label name: correct the array or the names."
                )


class LabelTable(NamedTuple):
    """The names of the labels 0, 1, … of an array.

    **Attributes:**

    - `names`: the names of the labels, a tuple of strings.
    - `keys`: the number of each label in its file (labels,), int64.
    - `colors`: the red, green, blue and alpha components of each label's colour, floats (labels, 4) from 0
      to 1; None if the file has no colours.
    """

    names: tuple[str, ...]
    keys: np.ndarray
    colors: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Overlay:
    """Numbers or labels on the n vertices of a mesh, from a file that does not contain the mesh itself.

    **Attributes:**

    - `values`: a dictionary from names to arrays (n,) or (n, c) with numbers for each vertex.
    - `labels`: a dictionary from the names of arrays of labels 0, 1, … to their tables, each a `LabelTable`.
    - `name`: the name of the overlay in messages. The name of an overlay from a file is the file's path.
    - `notes`: a tuple of sentences about data that were left out.
    """

    values: Mapping[str, np.ndarray]
    labels: Mapping[str, LabelTable] = field(default_factory=dict)
    name: str = "overlay"
    notes: tuple[str, ...] = ()

    def added_to(self, data: MeshData) -> MeshData:
        """Return the data of a mesh with those of the overlay, which replace vertex data of the same name.

        **Raises:** `InputError` if the overlay does not have one row for each vertex of the mesh.
        """
        n = len(data.mesh.vertices)
        for name, values in self.values.items():
            if len(values) != n:
                raise InputError(
                    f"{self.name}: has values {name!a} for {count_of(len(values), 'vertex')}, but "
                    f"{data.mesh.name} has {n}: give an overlay of this mesh."
                )
        kept = {name: names for name, names in data.label_names.items() if name not in self.values}
        own = {name: table.names for name, table in self.labels.items()}
        vertex_data = {**data.vertex_data, **self.values}
        face_data = {name: values for name, values in data.face_data.items() if name not in self.values}
        return replace(data, vertex_data=vertex_data, face_data=face_data, label_names={**kept, **own})

    def with_values_of(self, data: MeshData) -> Overlay:
        """Return the overlay with the values that a mesh has under the same names."""
        return replace(self, values={name: data.vertex_data[name] for name in self.values})


def _rows(data: Mapping[str, Any], what: str, count: int, noun: str) -> dict[str, np.ndarray]:
    """Check data with one row per vertex or face. Integers and floats keep their types."""
    checked = {}
    for name, values in data.items():
        array = np.asarray(values)
        if not name or array.ndim not in (1, 2) or array.dtype.kind not in "biuf" or not array.shape[-1]:
            raise InputError(
                f"the {what} {name!a} are {array.dtype.name} of shape {array.shape}: give each array a "
                f"name, and one number or one row of numbers for each {noun}."
            )
        if len(array) != count:
            raise InputError(
                f"the {what} {name!a} have {count_of(len(array), 'row')}, but need {count}: give one row "
                f"for each {noun}."
            )
        checked[name] = _canonical(array[:, 0] if array.shape[1:] == (1,) else array)
    return checked


def _checked_skin(skin: Skin, n: int) -> Skin:
    joints = tuple(map(str, skin.joints))
    if len(set(joints)) != len(joints) or not joints:
        raise InputError("the names of the joints are not distinct: give each joint its own name.")
    weights = _real(skin.weights, "the skin", (n, len(joints)))
    skeleton = None if skin.skeleton is None else _checked_skeleton(Skeleton(*skin.skeleton), len(joints))
    return Skin(joints, weights, skeleton)


def _checked_skeleton(skeleton: Skeleton, number: int) -> Skeleton:
    matrices = _real(skeleton.bind_matrices, "the bind matrices", (number, 4, 4))
    if (matrices[:, 3] != [0, 0, 0, 1]).any() or (np.linalg.det(matrices[:, :3, :3]) == 0).any():
        raise InputError(
            "a bind matrix has no inverse, or its last row is not 0 0 0 1: export the skin again."
        )
    parents = np.asarray(skeleton.parents)
    if parents.shape != (number,) or parents.dtype.kind not in "iu" or not _within(parents + 1, number + 1):
        raise InputError(
            f"the parents of the joints are not {number} integers from -1 to {number - 1}: give each joint "
            "the number of its parent, or -1."
        )
    above = parents.astype(np.int64)
    for _ in range(number.bit_length()):  # each round doubles the number of generations
        above = np.where(above < 0, -1, above[above])
    if (above >= 0).any():
        raise InputError("a joint is its own ancestor: give each joint a parent above it, or -1.")
    return Skeleton(parents.astype(np.int64), matrices)


def checked_texture(texture: Texture, f: int) -> Texture:
    """Check the texture of f triangles."""
    coordinates, corners = texture
    coordinates = _real(coordinates, "the texture", (*np.shape(coordinates)[:1], 2))
    corners = _indices(corners, len(coordinates), "the texture's corners", "texture vertices", -1)
    if len(corners) != f:
        raise InputError(
            f"the texture has {count_of(len(corners), 'row')} of corners, but the mesh has "
            f"{count_of(f, 'face')}: give one row for each face."
        )
    return Texture(coordinates, corners)


def _real(values: Any, what: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "*shape"]:
    array = np.asarray(values)
    if array.shape != shape or array.dtype.kind not in "biuf":
        raise InputError(
            f"{what} is {array.dtype.name} of shape {array.shape}, but needs numbers of shape {shape}: "
            "give an array of this shape."
        )
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"{what} contains a number that is not finite: repair the numbers.")
    return array


def _within(array: np.ndarray, count: int, first: int = 0) -> bool:
    return not array.size or bool(array.min() >= first and array.max() < count)


def _canonical(array: np.ndarray) -> np.ndarray:
    """Return a contiguous copy of Booleans as uint8, and of other numbers in types that all formats have."""
    kinds = {"b": np.uint8, "f2": np.float32, "f16": np.float64, "f12": np.float64}
    kind = kinds.get(array.dtype.str[1:], kinds.get(array.dtype.kind, array.dtype.newbyteorder("=")))
    return np.array(array, dtype=kind, order="C")


def _indices(values: Any, count: int, what: str, whole: str, first: int = 0) -> Int64[np.ndarray, "f 3"]:
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
        raise InputError(
            f"{what} are {array.dtype.name} of shape {array.shape}: give integers of shape (number of faces, "
            "3)."
        )
    if not _within(array, count, first):
        raise InputError(f"{what} use a number outside the {count} {whole}: correct the indices.")
    return array.astype(np.int64)


def texture_at_corners(texture: Texture) -> Float64[np.ndarray, "f 6"]:
    """Return the texture coordinates (u0, v0, u1, v1, u2, v2) of each triangle. Missing ones are NaN."""
    coordinates, corners = texture
    return np.vstack([coordinates, [[np.nan, np.nan]]])[corners].reshape(-1, 6)


def texture_of_corners(
    corners: np.ndarray, at_corners: Float64[np.ndarray, "c 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return texture vertices, and the texture vertex of each corner, given the coordinates of all corners.

    Corners of one vertex with equal coordinates share a texture vertex. The texture vertices of vertex 0 come
    first, then those of vertex 1, and so on. A corner whose coordinates are NaN has none.
    """
    has_texture = np.isfinite(at_corners).all(axis=1)
    rows = np.column_stack([corners, at_corners])[has_texture]
    distinct, number = np.unique(rows, axis=0, return_inverse=True)
    of_corner = np.full(len(corners), -1)
    of_corner[has_texture] = number.ravel()
    return distinct[:, 1:], of_corner
