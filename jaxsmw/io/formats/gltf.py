"""A reader of glTF 2.0 files: all meshes of the scene, joined to one surface.

The specification is https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

from __future__ import annotations

import base64
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.geometry.arrays import first_equal_rows
from jaxsmw.io.formats.polygons import (
    Polygons,
    check_number_of_vertices,
    face_groups,
    unique_name,
    unique_names,
)
from jaxsmw.io.formats.text import damaged, excerpt, export_again
from jaxsmw.io.mesh_data import COLORS, Skeleton, Skin
from jaxsmw.runtime.files import read_bytes
from jaxsmw.wording import count_of

TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
RECORD = "jaxsmw"
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Files may require these extensions, which do not change how positions, faces and attributes are read.
_HARMLESS = re.compile(r"KHR_mesh_quantization|(KHR|EXT)_(materials|texture|lights|animation|xmp).*")
# An extension that this reader understands, if the package DracoPy is installed.
_DRACO = "KHR_draco_mesh_compression"
_NOT_DATA = re.compile(r"POSITION|NORMAL|TANGENT|TEXCOORD_0|(JOINTS|WEIGHTS)_\d+")
# The largest accepted numbers of triangle corners, displacements and weights. There is one displacement per
# vertex and blend shape, and one weight per vertex and joint.
_MOST_CORNERS, _MOST_DISPLACEMENTS, _MOST_WEIGHTS = 6 * 10**7, 2**24, 2**25
# Bind matrices with a larger condition number have no inverse in float32. Exporters round their last rows.
_SINGULAR, _ROUNDING = 1e8, 1e-4
_NO_SKELETON = "The places of the joints were ignored, because a bind matrix has no inverse."


def parse_gltf(data: bytes, folder: Path) -> Polygons:
    """Parse a `.gltf` file, which is JSON. The buffers are data URIs, or files in `folder` or below."""
    return _Scene(_Document(data, folder)).polygons()


def parse_glb(data: bytes) -> Polygons:
    """Parse a `.glb` file, which is binary and contains the buffer."""
    if data[:4] != b"glTF":
        raise InputError("does not begin with glTF: export the mesh again as a .glb file.")
    return _Scene(_Document(data, None)).polygons()


@dataclass
class _Part:
    """Vertices and their data, from primitives with the same attributes. Joints are numbers of nodes."""

    vertices: np.ndarray
    first: int
    data: dict[str, np.ndarray]
    coordinates: np.ndarray | None
    shapes: dict[str, np.ndarray]
    joints: np.ndarray
    weights: np.ndarray
    faces: list[np.ndarray] = field(default_factory=list)
    names: list[str] = field(default_factory=list)


class _Scene:
    """All parts of the scene of a document, in the order of its nodes."""

    def __init__(self, document: _Document) -> None:
        self.document = document
        self.parts: list[_Part] = []
        self.vertices = self.corners = self.ignored = 0
        self.notes: list[str] = []
        self.record: dict[str, Any] = {}
        self.parents: dict[int, int] = {}  # of the nodes in the scene; -1 for none
        self.bind_matrices: dict[int, np.ndarray | None] = {}  # of nodes that are joints
        self.skins: dict[int, list[Any]] = {}  # the joints of each skin
        for node, matrix in self._nodes():
            if "mesh" in node:
                self._add_mesh(node, matrix)

    def _nodes(self) -> list[tuple[dict[str, Any], np.ndarray]]:
        """Return the nodes of the scene with their global transforms, parents before children."""
        document = self.document
        nodes = document.list_of(document.json, "nodes")
        if "scenes" in document.json:
            roots = document.list_of(document.item("scenes", document.json.get("scene", 0)), "nodes")
        else:
            children = [document.list_of(document.item("nodes", i), "children") for i in range(len(nodes))]
            below = {str(child) for of_node in children for child in of_node}
            roots = [i for i in range(len(nodes)) if str(i) not in below]
        in_scene: dict[int, tuple[dict[str, Any], np.ndarray]] = {}
        pending = [(root, np.eye(4), -1) for root in reversed(roots)]
        while pending:
            number, above, parent = pending.pop()
            node = document.item("nodes", number)
            if number in in_scene:
                raise damaged(f"node {number} has several parents")
            matrix = above @ self._matrix(node)
            in_scene[number] = node, matrix
            self.parents[number] = parent
            pending += [(child, matrix, number) for child in reversed(document.list_of(node, "children"))]
        if "nodes" not in document.json:
            return [({"mesh": i}, np.eye(4)) for i in range(len(document.list_of(document.json, "meshes")))]
        return list(in_scene.values())

    def _matrix(self, node: dict[str, Any]) -> np.ndarray:
        """Return the transform of a node relative to its parent (4, 4)."""
        numbers = self.document.numbers
        if (columns := numbers(node, "matrix", 16)) is not None:
            return columns.reshape(4, 4).T
        matrix = np.eye(4)
        if (rotation := numbers(node, "rotation", 4)) is not None:
            x, y, z, w = rotation
            matrix[:3, :3] = [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        if (scale := numbers(node, "scale", 3)) is not None:
            matrix[:3, :3] *= scale
        if (translation := numbers(node, "translation", 3)) is not None:
            matrix[:3, 3] = translation
        return matrix

    def _add_mesh(self, node: dict[str, Any], matrix: np.ndarray) -> None:
        """Add the primitives of a node's mesh. Primitives with the same attributes share their vertices."""
        document = self.document
        mesh = document.item("meshes", node["mesh"])
        shape_names: list[str] = []
        if isinstance(extras := mesh.get("extras"), dict):  # extras may have any type
            if isinstance(listed := extras.get("targetNames"), list):
                shape_names = [str(name) for name in listed]
            record = extras.get(RECORD)
            self.record = record if isinstance(record, dict) else {}
        nodes_of_joints = None
        if "skin" in node:
            skin, number = document.item("skins", node["skin"]), node["skin"]
            if number not in self.skins:  # many nodes can have the same skin
                self.skins[number] = self._joints(skin)
            nodes_of_joints = self.skins[number]
            matrix = np.eye(4)  # the node's transform does not move a skinned mesh
        parts: dict[str, _Part] = {}
        for primitive in document.list_of(mesh, "primitives"):
            if not isinstance(primitive, dict):
                document.refuse("primitives")
            if document.integer(primitive, "mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
                self.ignored += 1
                continue
            if _DRACO in (extensions := document.dict_of(primitive, "extensions")):
                document.decompress(primitive, document.dict_of(extensions, _DRACO))
            key = repr((primitive.get("attributes"), primitive.get("targets")))
            if key not in parts:
                parts[key] = self._part(primitive, matrix, shape_names, nodes_of_joints)
                self.parts.append(parts[key])
            faces = self._faces(primitive, parts[key])
            is_mirrored = np.linalg.det(matrix[:3, :3]) < 0
            parts[key].faces.append(faces[:, [0, 2, 1]] if is_mirrored else faces)
            parts[key].names.append(str(node.get("name", mesh.get("name", f"mesh {node['mesh']}"))))

    def _part(
        self, primitive: dict[str, Any], matrix: np.ndarray, shape_names: list[str], nodes: list[Any] | None
    ) -> _Part:
        """Return the vertices of a primitive, with their data."""
        document = self.document
        attributes = document.dict_of(primitive, "attributes")
        vertices = document.floats(attributes.get("POSITION"), 3)
        n = len(vertices)
        self.vertices += n
        check_number_of_vertices(self.vertices)
        data = self._vertex_data(attributes, n)
        coordinates = None
        if "TEXCOORD_0" in attributes:
            coordinates = document.floats(attributes["TEXCOORD_0"], 2, n)
            coordinates[:, 1] = 1 - coordinates[:, 1]  # glTF counts v from the top of the picture
        shapes: dict[str, np.ndarray] = {}
        targets = document.list_of(primitive, "targets")
        unnamed = [f"target {number}" for number in range(len(shape_names), len(targets))]
        for name, target in zip(unique_names(shape_names[: len(targets)] + unnamed), targets, strict=True):
            if not isinstance(target, dict):
                document.refuse("targets")
            _check_shapes(self.vertices * (len(shapes) + 1))
            moves = document.floats(target["POSITION"], 3, n) if "POSITION" in target else np.zeros((n, 3))
            shapes[name] = _times(moves, matrix)
        joints, weights = self._skin(attributes, nodes, n)
        vertices = _times(vertices, matrix) + matrix[:3, 3]
        return _Part(vertices, self.vertices - n, data, coordinates, shapes, joints, weights)

    def _vertex_data(self, attributes: dict[str, Any], n: int) -> dict[str, np.ndarray]:
        document = self.document
        data: dict[str, np.ndarray] = {}
        for name, index in attributes.items():
            if _NOT_DATA.fullmatch(name):
                continue
            if COLUMNS.get(str(document.item("accessors", index).get("type")), 16) > 4:
                self.notes.append(f"The vertex data {name[:40]!a} were ignored, because they are matrices.")
                continue
            columns = (3, 4) if name.startswith("COLOR_") else (1, 2, 3, 4)
            values, is_fraction = document.accessor(index, columns, n)
            if is_fraction and not (name == "COLOR_0" and values.dtype == np.uint8):
                values = _as_floats(values, is_fraction).astype(np.float32)
            own_name = COLORS if name == "COLOR_0" else name.removeprefix("_") or name
            data[unique_name(own_name, data)] = values
        return data

    def _joints(self, skin: dict[str, Any]) -> list[Any]:
        """Return the nodes that are the joints of a skin, and keep their bind matrices."""
        document = self.document
        nodes = document.list_of(skin, "joints")
        inverses = np.tile(np.eye(4).ravel(), (len(nodes), 1))
        if "inverseBindMatrices" in skin:
            given = document.floats(skin["inverseBindMatrices"], 16)
            if len(given) < len(nodes):
                raise damaged(f"a skin has {len(given)} bind matrices for {len(nodes)} joints")
            inverses = given[: len(nodes)]
        for node, inverse in zip(nodes, inverses.reshape(-1, 4, 4).swapaxes(1, 2), strict=True):
            document.item("nodes", node)
            is_affine = np.isfinite(inverse).all() and np.abs(inverse[3] - [0, 0, 0, 1]).max() < _ROUNDING
            matrix = None
            if is_affine and np.linalg.cond(inverse[:3, :3]) < _SINGULAR:
                matrix = np.eye(4)
                matrix[:3] = np.linalg.inv(inverse)[:3]
            else:
                self.notes.append(_NO_SKELETON)
            if self.bind_matrices.get(node) is None:
                self.bind_matrices[node] = matrix
        return nodes

    def _skin(
        self, attributes: dict[str, Any], nodes: list[Any] | None, n: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the joints of each vertex (n, 4 s), as numbers of nodes, and their weights, from s sets."""
        document = self.document
        sets: list[tuple[np.ndarray, np.ndarray]] = [(np.empty((n, 0), np.int64), np.empty((n, 0)))]
        while nodes is not None and f"JOINTS_{len(sets) - 1}" in attributes:
            number = len(sets) - 1
            joints, _ = document.accessor(attributes[f"JOINTS_{number}"], (4,), n)
            weights = document.floats(attributes.get(f"WEIGHTS_{number}"), 4, n)
            if joints.dtype.kind != "u" or (joints[weights != 0] >= len(nodes)).any():
                raise damaged("a vertex uses a joint that the skin does not have")
            sets.append((np.array([*nodes, 0])[np.minimum(joints.astype(np.int64), len(nodes))], weights))
        joints, weights = (np.hstack(parts) for parts in zip(*sets, strict=True))
        return joints, weights

    def _faces(self, primitive: dict[str, Any], part: _Part) -> np.ndarray:
        """Return the triangles of a primitive (f, 3), as vertex indices of the joined mesh."""
        n, mode = len(part.vertices), primitive.get("mode", _TRIANGLES)
        indices = np.arange(n)
        if "indices" in primitive:
            values, _ = self.document.accessor(primitive["indices"], (1,))
            indices = values[:, 0].astype(np.int64)
            if values.dtype.kind != "u" or (len(indices) and indices.max() >= n):
                raise damaged(f"a triangle uses a vertex that does not exist among {count_of(n, 'vertex')}")
        self.corners += len(indices) if mode == _TRIANGLES else 3 * len(indices)
        if self.corners > _MOST_CORNERS:
            raise InputError(f"describes more than {_MOST_CORNERS} corners of triangles: decimate the mesh.")
        if mode == _TRIANGLES:
            if len(indices) % 3:
                raise damaged(f"has {len(indices)} corners, which do not form triangles")
            return part.first + indices.reshape(-1, 3)
        i = np.arange(max(len(indices) - 2, 0))
        odd, first = (i % 2, i) if mode == _STRIP else (0, 0 * i)
        return part.first + indices[np.stack([first, i + 1 + odd, i + 2 - odd], axis=1)]

    def polygons(self) -> Polygons:
        """Join all parts."""
        groups = [
            (faces, name) for part in self.parts for faces, name in zip(part.faces, part.names, strict=True)
        ]
        if not groups:
            raise InputError("contains no triangles: export the mesh again as triangles.")
        vertices = np.concatenate([part.vertices for part in self.parts])
        corners = np.concatenate([faces for faces, _ in groups]).ravel()
        notes = [f"{count_of(self.ignored, 'primitive')} of points or lines ignored."] if self.ignored else []
        notes += dict.fromkeys(self.notes)
        data = {}
        for name in dict.fromkeys(name for part in self.parts for name in part.data):
            arrays = [part.data[name] for part in self.parts if name in part.data]
            if len(arrays) == len(self.parts) and len({(a.dtype, a.shape[1:]) for a in arrays}) == 1:
                data[name] = np.concatenate(arrays)
            else:
                notes.append(
                    f"The vertex data {name!a} were ignored, because only some primitives have them."
                )
        face_data, label_names = face_groups(
            [name for _, name in groups], [len(faces) for faces, _ in groups]
        )
        polygons = Polygons(
            vertices,
            corners,
            np.full(len(corners) // 3, 3),
            tuple(notes),
            data,
            face_data,
            self._texture(corners),
            self._shapes(len(vertices)),
            self._joined_skin(len(vertices)),
            label_names,
        )
        if self.record and len(self.parts) == 1:
            polygons = _without_copies(polygons, self.record, self.document)
        equal = first_equal_rows(polygons.vertices)
        return polygons._replace(weld=bool((equal != np.arange(len(equal))).any()))

    def _texture(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        coordinates = [part.coordinates for part in self.parts if part.coordinates is not None]
        if not coordinates:
            return None
        has_texture = np.repeat(
            [part.coordinates is not None for part in self.parts], [len(part.vertices) for part in self.parts]
        )
        return np.concatenate(coordinates), np.where(has_texture, np.cumsum(has_texture) - 1, -1)[corners]

    def _shapes(self, n: int) -> dict[str, np.ndarray]:
        """Return all blend shapes. A blend shape that a part lacks does not displace the part's vertices."""
        names = dict.fromkeys(name for part in self.parts for name in part.shapes)
        _check_shapes(len(names) * n)
        return {
            name: np.concatenate(
                [part.shapes.get(name, np.zeros(part.vertices.shape)) for part in self.parts]
            )
            for name in names
        }

    def _joined_skin(self, n: int) -> Skin | None:
        if not any((part.weights != 0).any() for part in self.parts):
            return None
        nodes = sorted(self.bind_matrices)  # with joints that move no vertex, but other joints
        if len(nodes) * n > _MOST_WEIGHTS:
            raise InputError("has too many joints for its vertices: export a skin with fewer joints.")
        names = [self.document.item("nodes", node).get("name") for node in nodes]
        joints = unique_names(
            name if isinstance(name, str) and name else f"node {node}"
            for node, name in zip(nodes, names, strict=True)
        )
        weights = np.zeros((n, len(nodes)))
        for part in self.parts:
            column = np.minimum(np.searchsorted(nodes, part.joints), len(nodes) - 1)
            row = np.broadcast_to(part.first + np.arange(len(part.joints))[:, None], column.shape)
            np.add.at(weights, (row, column), part.weights)  # the weights at unused joints are 0
        return Skin(tuple(joints), weights, self._skeleton(nodes))

    def _skeleton(self, nodes: list[int]) -> Skeleton | None:
        """Return the skeleton of joints, or None if the file does not say where they are."""
        matrices = [matrix for node in nodes if (matrix := self.bind_matrices[node]) is not None]
        if len(matrices) < len(nodes) or np.array_equal(matrices, np.tile(np.eye(4), (len(nodes), 1, 1))):
            return None
        nearest = {node: number for number, node in enumerate(nodes)}  # the nearest joint at or above a node
        parents = []
        for node in nodes:
            passed, above = [], self.parents.get(node, -1)
            while above >= 0 and above not in nearest:
                passed.append(above)
                above = self.parents.get(above, -1)
            parents.append(nearest.get(above, -1))
            nearest |= dict.fromkeys(passed, parents[-1])
        return Skeleton(np.array(parents), np.stack(matrices))


def _check_shapes(displacements: int) -> None:
    if displacements > _MOST_DISPLACEMENTS:
        raise InputError("has too many blend shapes for its vertices: export fewer blend shapes.")


def _times(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Apply the linear part of a transform to vectors (n, 3)."""
    return vectors if np.array_equal(matrix[:3, :3], np.eye(3)) else vectors @ matrix[:3, :3].T


def _without_copies(polygons: Polygons, record: dict[str, Any], document: _Document) -> Polygons:
    """Join the vertices that `format_gltf` duplicated along texture seams, and listed in `record`."""
    original, texture = (
        document.view(record.get(key), 0, len(polygons.vertices), "i4", 1)[:, 0].astype(np.int64)
        for key in ("vertices", "texture")
    )
    vertices, first = np.unique(original, return_index=True)
    # The number -1 marks vertices without a texture vertex.
    textures, first_texture = np.unique(np.append(texture, -1), return_index=True)
    textures, first_texture = textures[1:], first_texture[1:]
    if (texture < -1).any() or any(
        not np.array_equal(distinct, np.arange(len(distinct))) for distinct in (vertices, textures)
    ):
        raise damaged("the record of duplicate vertices is not valid")
    skin = polygons.skin
    return polygons._replace(
        vertices=polygons.vertices[first],
        corners=original[polygons.corners],
        vertex_data={name: values[first] for name, values in polygons.vertex_data.items()},
        texture=None
        if polygons.texture is None
        else (polygons.texture[0][first_texture], texture[polygons.corners]),
        blend_shapes={name: moves[first] for name, moves in polygons.blend_shapes.items()},
        skin=None if skin is None else skin._replace(weights=skin.weights[first]),
    )


class _Document:
    """The parts of a glTF file, with checks of all indices and sizes. Other files are in `folder`."""

    def __init__(self, data: bytes, folder: Path | None) -> None:
        self.folder = folder
        self.binary: bytes | None = None
        self.buffers: dict[int, bytes] = {}
        self.decompressed: dict[int, np.ndarray] = {}  # the rows of compressed accessors
        text = self._unpack(data) if data[:4] == b"glTF" else data
        try:
            self.json = json.loads(text.decode("utf-8-sig"), parse_constant=_refuse_constant)
        except (ValueError, RecursionError):
            raise export_again("contains no valid JSON, so the file is not glTF or damaged") from None
        asset = self.json.get("asset") if isinstance(self.json, dict) else None
        asset = asset if isinstance(asset, dict) else {}
        version, least = str(asset.get("version", "")), str(asset.get("minVersion", "2.0"))
        if not re.fullmatch(r"2\.\d{1,3}", version, re.ASCII) or least != "2.0":
            raise InputError("does not have the version 2.0 of glTF: export the mesh again as glTF 2.0.")
        for name in self.list_of(self.json, "extensionsRequired"):
            if name != _DRACO and not (isinstance(name, str) and _HARMLESS.fullmatch(name)):
                raise InputError(
                    f"needs the extension {excerpt(str(name))}, which is not supported: export the mesh "
                    "without compression and without this extension."
                )

    def _unpack(self, data: bytes) -> bytes:
        """Return the JSON chunk of a GLB file, and keep its binary chunk."""
        version, length = (int.from_bytes(data[i : i + 4], "little") for i in (4, 8))
        if version != 2:
            raise InputError(
                f"has the version {version} of the GLB format: export the mesh again as glTF 2.0."
            )
        if length != len(data) or length < 20:
            raise export_again(
                f"declares {length} bytes, but has {len(data)}, so the file is truncated or damaged"
            )
        chunks, position = [], 12
        while position < length:
            size, kind = (int.from_bytes(data[i : i + 4], "little") for i in (position, position + 4))
            if position + 8 + size > length:
                raise damaged(f"a chunk of the file declares {size} bytes")
            chunks.append((kind, data[position + 8 : position + 8 + size]))
            position += 8 + size
        if chunks[0][0] != _JSON:
            raise damaged("does not begin with a JSON chunk")
        if len(chunks) > 1 and chunks[1][0] == _BINARY:
            self.binary = chunks[1][1]
        return chunks[0][1]

    def refuse(self, key: str) -> NoReturn:
        raise damaged(f"the value of {key!a} is not valid")

    def list_of(self, parent: dict[str, Any], key: str) -> list[Any]:
        """Return the list under a key of an object, or an empty list if the key is missing."""
        if not isinstance(value := parent.get(key, []), list):
            self.refuse(key)
        return value

    def dict_of(self, parent: dict[str, Any], key: str) -> dict[str, Any]:
        """Return the object under a key of another object, or an empty object if the key is missing."""
        if not isinstance(value := parent.get(key, {}), dict):
            self.refuse(key)
        return value

    def integer(self, parent: dict[str, Any], key: str, default: int | None = None) -> int:
        """Return the non-negative integer under a key of an object."""
        value = parent.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
            self.refuse(key)
        return value

    def numbers(self, parent: dict[str, Any], key: str, count: int) -> np.ndarray | None:
        """Return the list of finite numbers under a key of an object, or None if the key is missing."""
        if key not in parent:
            return None
        values = self.list_of(parent, key)
        if len(values) != count or not all(type(v) in (int, float) and abs(v) < 1e300 for v in values):
            self.refuse(key)
        return np.array(values, dtype=np.float64)

    def item(self, key: str, index: Any) -> dict[str, Any]:
        """Return an element of a list at the top level, such as an accessor."""
        items = self.list_of(self.json, key)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            number = index if isinstance(index, int) and abs(index) < 2**63 else excerpt(str(index)[:99])
            raise damaged(f"uses {key}[{number}], but the length of {key} is {len(items)}")
        if not isinstance(items[index], dict):
            self.refuse(key)
        return items[index]

    def buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer, which is in the file itself, in a data URI or in another file."""
        if index not in self.buffers:
            description = self.item("buffers", index)
            length = self.integer(description, "byteLength")
            uri = description.get("uri")
            if uri is None and index == 0 and self.binary is not None:
                content = self.binary
            elif isinstance(uri, str):
                content = _decoded(uri) if uri.startswith("data:") else self._external(uri)
            else:
                raise damaged(f"has no contents for buffer {index}")
            if len(content) < length:
                raise export_again(
                    f"declares {length} bytes in buffer {index}, but the buffer has {len(content)}, so the "
                    "file is truncated or damaged"
                )
            self.buffers[index] = content[:length]
        return self.buffers[index]

    def _external(self, uri: str) -> bytes:
        """Return the contents of a file in the folder of the glTF file or below."""
        name = unquote(uri)
        is_relative = not re.search(r"[:\\\0]", name) and not {"", ".", ".."} & {*name.split("/")}
        fault = "is not a file in the folder of this file"
        if self.folder is not None and is_relative:
            path = self.folder / name
            fault = "links to another folder"
            if path.resolve().is_relative_to(self.folder.resolve()):
                try:
                    return read_bytes(path)
                except InputError:
                    fault = "cannot be read"
        raise InputError(
            f"uses the buffer {excerpt(uri)}, which {fault}: put the buffer into the same folder, or export "
            "a .glb file."
        )

    def decompress(self, primitive: dict[str, Any], compressed: dict[str, Any]) -> None:
        """Read the accessors of a primitive that are compressed by Draco.

        The accessors still state the types and the numbers of elements.
        """
        index = compressed.get("bufferView")
        length = self.integer(self.item("bufferViews", index), "byteLength")
        mesh = _draco_mesh(self.view(index, 0, length, "u1", 1).tobytes())
        arrays = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
        attributes = self.dict_of(primitive, "attributes")
        found: list[tuple[Any, np.ndarray]] = [(primitive.get("indices"), mesh.faces.reshape(-1, 1))]
        for name, number in self.dict_of(compressed, "attributes").items():
            array = arrays.get(number) if isinstance(number, int) else None
            if array is None or name not in attributes:
                raise damaged(f"the compressed attribute {excerpt(str(name))} does not exist")
            found.append((attributes[name], array.reshape(len(array), -1)))
        for accessor, values in found:
            self.item("accessors", accessor)
            if not np.array_equal(self.decompressed.setdefault(accessor, values), values, equal_nan=True):
                raise damaged(f"accessor {accessor} belongs to several compressed primitives")

    def view(self, index: Any, offset: int, count: int, kind: str, columns: int) -> np.ndarray:
        """Return `count` rows of a buffer view as numbers (count, columns). The rows start at `offset`."""
        description = self.item("bufferViews", index)
        if "EXT_meshopt_compression" in self.dict_of(description, "extensions"):
            raise InputError(
                "is compressed with EXT_meshopt_compression: export the mesh without compression."
            )
        buffer = self.buffer(self.integer(description, "buffer"))
        start, length = self.integer(description, "byteOffset", 0), self.integer(description, "byteLength")
        size = np.dtype(kind).itemsize
        stride = self.integer(description, "byteStride", size * columns)
        if stride < size * columns or start + length > len(buffer):
            raise damaged(f"buffer view {index} does not fit its buffer")
        if not count:
            return np.empty((0, columns), kind)
        if offset + stride * (count - 1) + size * columns > length:
            raise damaged(f"an accessor needs more bytes than buffer view {index} has")
        rows = np.ndarray((count, columns), f"<{kind}", buffer, start + offset, (stride, size))
        return rows.astype(kind)

    def accessor(
        self, index: Any, columns: tuple[int, ...], rows: int | None = None
    ) -> tuple[np.ndarray, bool]:
        """Return the numbers of an accessor (rows, columns), and whether these numbers represent fractions.

        `columns` lists the permitted numbers of columns. The argument `rows` is the necessary number of rows,
        or None for any number.
        """
        description = self.item("accessors", index)
        kind = TYPES.get(self.integer(description, "componentType"))
        width = COLUMNS.get(str(description.get("type")), 0)
        count = self.integer(description, "count")
        if kind is None or width not in columns:
            raise damaged(f"accessor {index} does not have a suitable type")
        if rows is not None and count != rows:
            raise damaged(f"accessor {index} has {count} elements instead of {rows}")
        if index in self.decompressed:
            values = self.decompressed[index]
            if values.shape != (count, width):
                raise damaged(f"accessor {index} does not have the shape of its compressed numbers")
            values = values.astype(kind)
        elif "bufferView" in description:
            offset = self.integer(description, "byteOffset", 0)
            values = self.view(description["bufferView"], offset, count, kind, width)
        elif rows is None:  # limits memory: an accessor without data can state any number of elements
            raise damaged(f"accessor {index} has no buffer view")
        else:
            values = np.zeros((count, width), kind)
        if "sparse" in description:
            self._replace(values, self.dict_of(description, "sparse"), kind)
        return values, description.get("normalized") is True and kind[0] in "iu"

    def _replace(self, values: np.ndarray, sparse: dict[str, Any], kind: str) -> None:
        """Replace the rows that a sparse accessor lists."""
        count = self.integer(sparse, "count")
        where, what = self.dict_of(sparse, "indices"), self.dict_of(sparse, "values")
        kind_of_index = TYPES.get(self.integer(where, "componentType"), "f4")
        if kind_of_index[0] != "u" or count > len(values):
            raise damaged("a sparse accessor does not have valid indices")
        offset = self.integer(where, "byteOffset", 0)
        indices = self.view(where.get("bufferView"), offset, count, kind_of_index, 1)[:, 0]
        if count and indices.max() >= len(values):
            raise damaged("a sparse accessor replaces an element that does not exist")
        offset = self.integer(what, "byteOffset", 0)
        values[indices] = self.view(what.get("bufferView"), offset, count, kind, values.shape[1])

    def floats(self, index: Any, columns: int, rows: int | None = None) -> np.ndarray:
        """Return the numbers of an accessor (rows, columns), or the fractions that they represent."""
        return _as_floats(*self.accessor(index, (columns,), rows))


def _as_floats(values: np.ndarray, is_fraction: bool) -> np.ndarray:
    """Return numbers as float64. Fractions are integers, divided by the largest integer of their type."""
    if not is_fraction:
        return values.astype(np.float64)
    return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)


def _draco_mesh(data: bytes) -> Any:
    """Decompress a mesh. On 10 000 damaged files, DracoPy raised exceptions or returned wrong numbers."""
    try:
        import DracoPy
    except ImportError:
        raise InputError(
            f"is compressed with {_DRACO}, which needs the package DracoPy: run pip install "
            "'jaxsmw[draco]', or export the mesh without compression."
        ) from None
    try:
        mesh = DracoPy.decode(data)
        mesh.faces, mesh.attributes  # noqa: B018 (point clouds have no faces)
    except Exception:  # any exception is possible for damaged files
        raise export_again("contains a compressed mesh that is not complete") from None
    return mesh


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _decoded(uri: str) -> bytes:
    """Return the contents of a data URI in base64."""
    head, comma, content = uri.partition(",")
    try:
        if not comma or not head.endswith(";base64"):
            raise ValueError
        return base64.b64decode(content, validate=True)
    except ValueError:
        raise damaged("contains a data URI that is not valid base64") from None
