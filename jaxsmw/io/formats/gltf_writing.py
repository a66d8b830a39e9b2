"""A writer of glTF 2.0 files (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html)."""

from __future__ import annotations

import base64
import json
import re
from typing import Any

import numpy as np
from jaxtyping import Int64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.gltf import COLUMNS, RECORD, TYPES
from jaxsmw.io.formats.polygons import Formatted, is_color, omissions, width_of
from jaxsmw.io.mesh_data import MeshData, Skeleton

_VERTICES, _INDICES = 34962, 34963
_COMPONENTS = {kind: number for number, kind in TYPES.items()}
_SHAPES = {columns: name for name, columns in COLUMNS.items()}
_SHEAR = 1e-5  # the axes of a joint count as orthogonal if all cosines are below this number
_LARGEST_EXACT = 2**24  # float32 represents all integers up to this number


def format_gltf(data: MeshData) -> Formatted:
    """Format a JSON file that needs no other file, because its buffer is a data URI."""
    file = _Writer(data)
    uri = b"data:application/octet-stream;base64," + base64.b64encode(file.buffer)
    file.json["buffers"] = [{"byteLength": len(file.buffer), "uri": uri.decode()}]
    return json.dumps(file.json, ensure_ascii=False, indent=1).encode(), file.notes()


def format_glb(data: MeshData) -> Formatted:
    """Format a binary file."""
    file = _Writer(data)
    file.json["buffers"] = [{"byteLength": len(file.buffer)}]
    text = json.dumps(file.json, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [(b"JSON", text), (b"BIN\0", bytes(file.buffer))]
    body = b"".join(len(content).to_bytes(4, "little") + kind + content for kind, content in chunks)
    content = b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body
    return content, file.notes()


class _Writer:
    """The JSON part and the buffer of a file. The file contains one mesh, which has one primitive."""

    def __init__(self, data: MeshData) -> None:
        self.data = data
        self.buffer = bytearray()
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "jaxsmw"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "mesh", "mesh": 0}],
            "meshes": [],
            "bufferViews": [],
            "accessors": [],
        }
        self.original, texture, faces = _split(data)
        attributes = self.attributes(texture)
        primitive = {"attributes": attributes, "mode": 4}
        primitive["indices"] = self.accessor(faces.ravel().astype("u4"), _INDICES)
        mesh: dict[str, Any] = {"primitives": [primitive]}
        extras: dict[str, Any] = {}
        if not np.array_equal(self.original, texture) and data.texture is not None:
            record = {"vertices": self.original, "texture": texture}
            extras[RECORD] = {key: self.view(values.astype("i4")) for key, values in record.items()}
        if data.blend_shapes:
            primitive["targets"] = [self.target(moves) for moves in data.blend_shapes.values()]
            mesh["weights"] = [0.0] * len(data.blend_shapes)
            extras["targetNames"] = list(data.blend_shapes)
        if extras:
            mesh["extras"] = extras
        self.json["meshes"].append(mesh)
        if data.skin is not None:
            self.add_skin(attributes)

    def attributes(self, texture: np.ndarray) -> dict[str, int]:
        """Add the attributes of the vertices, except the skin."""
        data = self.data
        positions = _single(data.mesh.vertices)[self.original]
        attributes = {"POSITION": self.accessor(positions, _VERTICES, limits=True)}
        if data.texture is not None:
            coordinates = np.vstack([data.texture.coordinates, [[0, 1]]])[texture]
            coordinates[:, 1] = 1 - coordinates[:, 1]  # in glTF, v = 0 at the top of the picture
            attributes["TEXCOORD_0"] = self.accessor(_single(coordinates), _VERTICES)
        for name, values in data.vertex_data.items():
            if (stored := _storable(name, values)) is not None:
                is_fraction = is_color(name, values) and stored.dtype == np.uint8
                semantic = _semantic(name, stored)
                attributes[semantic] = self.accessor(
                    stored[self.original], _VERTICES, is_fraction=is_fraction
                )
        return attributes

    def target(self, moves: np.ndarray) -> dict[str, int]:
        return {"POSITION": self.accessor(_single(moves)[self.original], _VERTICES, limits=True)}

    def add_skin(self, attributes: dict[str, int]) -> None:
        """Add a skin whose joints are nodes below one root, with four joints in each pair of attributes."""
        assert self.data.skin is not None
        names, weights, skeleton = self.data.skin
        if len(names) > 65535:
            raise InputError("has more than 65535 joints, the limit of glTF files: write a .npz file.")
        order = np.argsort(-np.abs(weights), axis=1, kind="stable")
        used = max(int((weights != 0).sum(axis=1).max()), 1)
        order = order[:, : 4 * -(-used // 4)]
        # In glTF, joints without weight must have the number 0. The columns are padded with
        # zeros to a multiple of four.
        largest = np.take_along_axis(weights, order, axis=1)
        columns = -order.shape[1] % 4
        joints = np.pad(np.where(largest != 0, order, 0), ((0, 0), (0, columns)))
        largest = np.pad(largest, ((0, 0), (0, columns)))
        joints, largest = joints[self.original].astype(np.uint16), largest[self.original].astype(np.float32)
        for number in range(joints.shape[1] // 4):
            part = slice(4 * number, 4 * number + 4)
            attributes[f"JOINTS_{number}"] = self.accessor(joints[:, part], _VERTICES)
            attributes[f"WEIGHTS_{number}"] = self.accessor(largest[:, part], _VERTICES)
        if skeleton is None:
            # Inverse bind matrices are optional in glTF, but VTK 9.7 ends the process if a file has none.
            skeleton = Skeleton(np.full(len(names), -1), np.tile(np.eye(4), (len(names), 1, 1)))
        parents, matrices = skeleton
        nodes: list[dict[str, Any]] = [{"name": "joints"}, *({"name": name} for name in names)]
        for number, (parent, matrix) in enumerate(zip(parents, matrices, strict=True)):
            nodes[1 + number] |= _transform(
                matrix if parent < 0 else np.linalg.inv(matrices[parent]) @ matrix
            )
            # The nodes of the file are the mesh and these nodes.
            nodes[1 + parent].setdefault("children", []).append(2 + number)
        self.json["nodes"] += nodes
        self.json["nodes"][0]["skin"] = 0
        self.json["scenes"][0]["nodes"].append(1)
        inverses = np.linalg.inv(matrices).swapaxes(1, 2).reshape(-1, 16)
        self.json["skins"] = [
            {
                "joints": list(range(2, 2 + len(names))),
                "inverseBindMatrices": self.accessor(_single(inverses)),
            }
        ]

    def view(self, values: np.ndarray, target: int | None = None) -> int:
        """Add a buffer view. In views of vertex data, each row begins at a multiple of four bytes."""
        rows = values.reshape(len(values), -1)
        width = rows.dtype.itemsize * rows.shape[1]
        stride = width + -width % 4 if target == _VERTICES else width
        content = np.zeros((len(rows), stride), np.uint8)
        content[:, :width] = np.ascontiguousarray(rows.astype(rows.dtype.newbyteorder("<"))).view(np.uint8)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": content.size}
        if target is not None:
            view["target"] = target
        if stride != width:
            view["byteStride"] = stride
        self.buffer += content.tobytes() + bytes(-content.size % 4)
        self.json["bufferViews"].append(view)
        return len(self.json["bufferViews"]) - 1

    def accessor(
        self,
        values: np.ndarray,
        target: int | None = None,
        *,
        limits: bool = False,
        is_fraction: bool = False,
    ) -> int:
        """Add an accessor and its buffer view."""
        accessor: dict[str, Any] = {
            "bufferView": self.view(values, target),
            "componentType": _COMPONENTS[values.dtype.str[1:]],
            "count": len(values),
            "type": _SHAPES[width_of(values)],
        }
        if limits:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        if is_fraction:
            accessor["normalized"] = True
        self.json["accessors"].append(accessor)
        return len(self.json["accessors"]) - 1

    def notes(self) -> tuple[str, ...]:
        return omissions(
            self.data,
            "glTF",
            vertex_data=lambda name, values: _storable(name, values) is not None,
            blend_shapes=True,
            skin=True,
            texture=True,
        )


def _transform(matrix: np.ndarray) -> dict[str, list[float]]:
    """Return the transform of a node, if possible by parts, because animations do not change matrices."""
    from scipy.spatial.transform import Rotation  # 0.1 s, which only skins need

    if np.array_equal(matrix, np.eye(4)):
        return {}
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    scale[0] *= np.sign(np.linalg.det(matrix[:3, :3]))
    axes = matrix[:3, :3] / scale
    if np.abs(axes.T @ axes - np.eye(3)).max() > _SHEAR:
        return {"matrix": matrix.T.ravel().tolist()}
    parts = {"translation": matrix[:3, 3], "rotation": Rotation.from_matrix(axes).as_quat(), "scale": scale}
    return {name: values.tolist() for name, values in parts.items()}


def _single(values: np.ndarray) -> np.ndarray:
    """Return numbers as float32."""
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    if not np.isfinite(single).all():
        raise InputError("a number is too large for glTF files, which have float32: choose another unit.")
    return single


def _split(
    data: MeshData,
) -> tuple[Int64[np.ndarray, " s"], Int64[np.ndarray, " s"], Int64[np.ndarray, "f 3"]]:
    """Split vertices along texture seams, because glTF has one texture vertex per vertex.

    Return the vertex and the texture vertex (-1 for none) of each new vertex. Return also the faces, as
    indices of new vertices. Texture vertices without faces belong to vertex 0.
    """
    n = len(data.mesh.vertices)
    if data.texture is None:
        return np.arange(n), np.arange(n), data.faces
    t = len(data.texture.coordinates)
    pairs = np.column_stack([data.faces.ravel(), data.texture.corners.ravel()])
    alone = np.setdiff1d(np.arange(n), data.faces)
    # Without seams, texture vertex i belongs to vertex i.
    pairs = np.vstack([pairs, np.column_stack([alone, alone if t == n else np.full(len(alone), -1)])])
    unused = np.setdiff1d(np.arange(t), pairs[:, 1])
    pairs = np.vstack([pairs, np.column_stack([np.zeros_like(unused), unused])])
    distinct, number = np.unique(pairs, axis=0, return_inverse=True)
    return distinct[:, 0], distinct[:, 1], number.ravel()[: data.faces.size].reshape(-1, 3)


def _semantic(name: str, values: np.ndarray) -> str:
    """Return the name of the attribute. The names of other programs' data begin with an underscore."""
    if is_color(name, values):
        return "COLOR_0"
    is_texture = re.fullmatch(r"TEXCOORD_[1-9]", name) and width_of(values) == 2
    return name if is_texture and values.dtype == np.float32 else f"_{name}"


def _storable(name: str, values: np.ndarray) -> np.ndarray | None:
    """Return values in a type of glTF that represents them, or None. Floats become float32."""
    if width_of(values) > 4:
        return None
    if values.dtype.kind == "f":
        with np.errstate(over="ignore"):
            stored = values.astype(np.float32)
        return stored if np.isfinite(stored).all() else None
    if values.dtype.itemsize <= 2:
        return values
    is_exact = values.min() >= -_LARGEST_EXACT and values.max() <= _LARGEST_EXACT
    return values.astype(np.float32) if is_exact else None
