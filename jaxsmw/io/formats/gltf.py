"""A reader of glTF 2.0 files: all meshes of the scene, joined to one surface."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import first_equal_rows
from jaxsmw.io.formats.data import COLORS, Polygons, Skin, unique_name, unique_names
from jaxsmw.io.formats.gltf_accessors import COLUMNS, DAMAGED, Document, as_floats
from jaxsmw.wording import count_of

# The largest accepted numbers of vertices, triangle corners, displacements and weights. There is one
# displacement per vertex and blend shape, and one weight per vertex and joint.
LARGEST_VERTICES, LARGEST_CORNERS, LARGEST_SHAPES, LARGEST_WEIGHTS = 10**7, 6 * 10**7, 2**24, 2**25
RECORD = "jaxsmw"
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_IGNORED = re.compile(r"POSITION|NORMAL|TANGENT|TEXCOORD_0|(JOINTS|WEIGHTS)_\d+")


def parse_gltf(data: bytes, folder: Path) -> Polygons:
    """Parse a `.gltf` file, which is JSON. The buffers are data URIs, or files in `folder` or below."""
    return _Scene(Document(data, folder)).polygons()


def parse_glb(data: bytes) -> Polygons:
    """Parse a `.glb` file, which is binary and contains the buffer."""
    if data[:4] != b"glTF":
        raise InputError("does not begin with glTF: export the mesh again as a .glb file.")
    return _Scene(Document(data, None)).polygons()


@dataclass
class _Part:
    """Vertices and their data, from one primitive or from several primitives with the same attributes.

    `joints` (n, k) contains the joints of each vertex, as node indices. `weights` (n, k) contains the weights
    of these joints.
    """

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

    def __init__(self, document: Document) -> None:
        self.document = document
        self.parts: list[_Part] = []
        self.vertices = self.corners = self.ignored = 0
        self.notes: list[str] = []
        self.record: dict[str, Any] = {}
        nodes = self._nodes()
        for node, matrix in nodes:
            if "mesh" in node:
                self._add_mesh(node, matrix)
        if "nodes" not in document.json:
            for number in range(len(document.list_of(document.json, "meshes"))):
                self._add_mesh({"mesh": number}, np.eye(4))

    def _nodes(self) -> list[tuple[dict[str, Any], np.ndarray]]:
        """Return the nodes of the scene with their global transforms, parents before children."""
        document = self.document
        nodes = document.list_of(document.json, "nodes")
        if "scenes" in document.json:
            scene = document.item("scenes", document.json.get("scene", 0))
            roots = document.list_of(scene, "nodes")
        else:
            children = [document.list_of(document.item("nodes", i), "children") for i in range(len(nodes))]
            below = {str(child) for some in children for child in some}
            roots = [i for i in range(len(nodes)) if str(i) not in below]
        found: list[tuple[dict[str, Any], np.ndarray]] = []
        visited: set[int] = set()
        pending = [(root, np.eye(4)) for root in reversed(roots)]
        while pending:
            number, above = pending.pop()
            node = document.item("nodes", number)
            if number in visited:
                raise InputError(f"node {number} has several parents, {DAMAGED}")
            visited.add(number)
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = above @ self._matrix(node)
            found.append((node, matrix))
            pending += [(child, matrix) for child in reversed(document.list_of(node, "children"))]
        return found

    def _matrix(self, node: dict[str, Any]) -> np.ndarray:
        """Return the transform of a node relative to its parent (4, 4)."""
        numbers = self.document.numbers
        given = numbers(node, "matrix", 16)
        if given is not None:
            return given.reshape(4, 4).T
        matrix = np.eye(4)
        rotation = numbers(node, "rotation", 4)
        if rotation is not None:
            x, y, z, w = rotation
            matrix[:3, :3] = [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        scale, translation = numbers(node, "scale", 3), numbers(node, "translation", 3)
        matrix[:3, :3] *= 1 if scale is None else scale
        matrix[:3, 3] = 0 if translation is None else translation
        return matrix

    def _add_mesh(self, node: dict[str, Any], matrix: np.ndarray) -> None:
        """Add the primitives of a node's mesh. Primitives with the same attributes share their vertices."""
        document = self.document
        mesh = document.item("meshes", node["mesh"])
        extras, names = mesh.get("extras"), []
        if isinstance(extras, dict):  # extras may have any type
            listed = extras.get("targetNames")
            names = [str(name) for name in listed] if isinstance(listed, list) else []
            record = extras.get(RECORD)
            self.record = record if isinstance(record, dict) else {}
        nodes_of_joints = None
        if "skin" in node:
            nodes_of_joints = document.list_of(document.item("skins", node["skin"]), "joints")
            matrix = np.eye(4)  # the node's transform does not move a skinned mesh
        parts: dict[str, _Part] = {}
        for primitive in document.list_of(mesh, "primitives"):
            if not isinstance(primitive, dict):
                document.refuse("primitives")
            if document.integer(primitive, "mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
                self.ignored += 1
                continue
            if "KHR_draco_mesh_compression" in document.dict_of(primitive, "extensions"):
                raise InputError(
                    "is compressed with KHR_draco_mesh_compression: export the mesh without compression."
                )
            key = repr((primitive.get("attributes"), primitive.get("targets")))
            if key not in parts:
                parts[key] = self._part(primitive, matrix, names, nodes_of_joints)
                self.parts.append(parts[key])
            part = parts[key]
            with np.errstate(over="ignore", invalid="ignore"):
                is_mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0)
            part.faces.append(self._faces(primitive, part, is_mirrored))
            part.names.append(str(node.get("name", mesh.get("name", f"mesh {node['mesh']}"))))

    def _part(
        self, primitive: dict[str, Any], matrix: np.ndarray, names: list[str], nodes: list[Any] | None
    ) -> _Part:
        """Return the vertices of a primitive, with their data."""
        document = self.document
        attributes = document.dict_of(primitive, "attributes")
        vertices = as_floats(*document.accessor(attributes.get("POSITION"), (3,)))
        n = len(vertices)
        self.vertices += n
        if self.vertices > LARGEST_VERTICES:
            raise InputError(f"describes more than {LARGEST_VERTICES} vertices: decimate the mesh.")
        data: dict[str, np.ndarray] = {}
        for name, index in attributes.items():
            if _IGNORED.fullmatch(name):
                continue
            if str(document.item("accessors", index).get("type")) in COLUMNS:
                columns = (3, 4) if name.startswith("COLOR_") else (1, 2, 3, 4)
                values, is_fraction = document.accessor(index, columns, n)
                if is_fraction and not (name == "COLOR_0" and values.dtype == np.uint8):
                    values = as_floats(values, is_fraction).astype(np.float32)
                chosen = COLORS if name == "COLOR_0" else name.removeprefix("_") or name
                data[unique_name(chosen, data)] = values[:, 0] if values.shape[1] == 1 else values
            else:
                self.notes.append(f"The vertex data {name[:40]!a} were ignored, because they are matrices.")
        coordinates = None
        if "TEXCOORD_0" in attributes:
            coordinates = as_floats(*document.accessor(attributes["TEXCOORD_0"], (2,), n))
            coordinates[:, 1] = 1 - coordinates[:, 1]  # glTF counts v from the top of the picture
        shapes: dict[str, np.ndarray] = {}
        targets = document.list_of(primitive, "targets")
        names = names[: len(targets)] + [f"target {number}" for number in range(len(names), len(targets))]
        for name, target in zip(unique_names(names), targets, strict=True):
            if not isinstance(target, dict):
                document.refuse("targets")
            if self.vertices * (len(shapes) + 1) > LARGEST_SHAPES:
                raise InputError("has too many blend shapes for its vertices: export fewer blend shapes.")
            moves = np.zeros((n, 3))
            if "POSITION" in target:
                moves = as_floats(*document.accessor(target["POSITION"], (3,), n))
            shapes[name] = _times(moves, matrix)
        joints, weights = self._skin(attributes, nodes, n)
        with np.errstate(over="ignore", invalid="ignore"):
            vertices = _times(vertices, matrix) + matrix[:3, 3]
        return _Part(vertices, self.vertices - n, data, coordinates, shapes, joints, weights)

    def _skin(
        self, attributes: dict[str, Any], nodes: list[Any] | None, n: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the joints of each vertex, as node indices, and the weights of these joints.

        Both arrays have the shape (n, 4 s) for s sets of attributes JOINTS_i and WEIGHTS_i.
        """
        document = self.document
        sets: list[tuple[np.ndarray, np.ndarray]] = []
        while nodes is not None and f"JOINTS_{len(sets)}" in attributes:
            number = len(sets)
            joints, _ = document.accessor(attributes[f"JOINTS_{number}"], (4,), n)
            weights = as_floats(*document.accessor(attributes.get(f"WEIGHTS_{number}"), (4,), n))
            is_valid = joints.dtype.kind == "u"
            joints = joints.astype(np.int64)
            if not is_valid or (joints[weights != 0] >= len(nodes)).any():
                raise InputError(f"a vertex uses a joint that the skin does not have, {DAMAGED}")
            for node in nodes:
                document.item("nodes", node)
            sets.append((np.array([*nodes, 0])[np.minimum(joints, len(nodes))], weights))
        if not sets:
            return np.empty((n, 0), np.int64), np.empty((n, 0))
        joints, weights = (np.hstack(parts) for parts in zip(*sets, strict=True))
        return joints, weights

    def _faces(self, primitive: dict[str, Any], part: _Part, is_mirrored: bool) -> np.ndarray:
        """Return the triangles of a primitive (f, 3), as vertex indices of the joined mesh."""
        n, mode = len(part.vertices), primitive.get("mode", _TRIANGLES)
        if "indices" in primitive:
            values, _ = self.document.accessor(primitive["indices"], (1,))
            indices = values[:, 0].astype(np.int64)
            if values.dtype.kind != "u" or (len(indices) and indices.max() >= n):
                raise InputError(
                    f"a triangle uses a vertex that does not exist among {count_of(n, 'vertex')}, {DAMAGED}"
                )
        else:
            indices = np.arange(n)
        self.corners += len(indices) if mode == _TRIANGLES else 3 * len(indices)
        if self.corners > LARGEST_CORNERS:
            raise InputError(
                f"describes more than {LARGEST_CORNERS} corners of triangles: decimate the mesh."
            )
        if mode == _TRIANGLES:
            if len(indices) % 3:
                raise InputError(f"has {len(indices)} corners, which do not form triangles, {DAMAGED}")
            faces = indices.reshape(-1, 3)
        else:
            i = np.arange(max(len(indices) - 2, 0))
            second, third = (i + 1 + i % 2, i + 2 - i % 2) if mode == _STRIP else (i + 1, i + 2)
            faces = np.stack(
                [indices[i if mode == _STRIP else 0 * i], indices[second], indices[third]], axis=1
            )
        return part.first + (faces[:, [0, 2, 1]] if is_mirrored else faces)

    def polygons(self) -> Polygons:
        """Join all parts."""
        groups = [
            (faces, name) for part in self.parts for faces, name in zip(part.faces, part.names, strict=True)
        ]
        if not groups:
            raise InputError("contains no triangles: export the mesh again as triangles.")
        vertices = np.concatenate([part.vertices for part in self.parts])
        faces = np.concatenate([faces for faces, _ in groups])
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
        face_data, label_names = {}, {}
        if len(groups) > 1:
            number = {name: i for i, name in enumerate(dict.fromkeys(name for _, name in groups))}
            face_data["group"] = np.repeat([number[name] for _, name in groups], [len(f) for f, _ in groups])
            label_names["group"] = tuple(number)
        polygons = Polygons(
            vertices,
            faces.ravel(),
            np.full(len(faces), 3),
            tuple(notes),
            data,
            face_data,
            self._texture(faces.ravel(), len(vertices)),
            self._shapes(len(vertices)),
            self._joined_skin(len(vertices)),
            label_names,
        )
        if self.record and len(self.parts) == 1:
            polygons = _without_copies(polygons, self.record, self.document)
        return polygons._replace(weld=_has_copies(polygons.vertices))

    def _texture(self, corners: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray] | None:
        known = [part for part in self.parts if part.coordinates is not None]
        if not known:
            return None
        number = np.full(n, -1)
        first = 0
        for part in known:
            count = len(part.vertices)
            number[part.first : part.first + count] = np.arange(first, first + count)
            first += count
        coordinates = np.concatenate([part.coordinates for part in known if part.coordinates is not None])
        return coordinates, number[corners]

    def _shapes(self, n: int) -> dict[str, np.ndarray]:
        """Return all blend shapes. A blend shape that a part lacks does not displace the part's vertices."""
        names = list(dict.fromkeys(name for part in self.parts for name in part.shapes))
        if len(names) * n > LARGEST_SHAPES:
            raise InputError("has too many blend shapes for its vertices: export fewer blend shapes.")
        shapes = {name: np.zeros((n, 3)) for name in names}
        for part in self.parts:
            for name, moves in part.shapes.items():
                shapes[name][part.first : part.first + len(moves)] = moves
        return shapes

    def _joined_skin(self, n: int) -> Skin | None:
        used = [part.joints[part.weights != 0] for part in self.parts]
        nodes = sorted(set(np.concatenate(used).tolist())) if used else []
        if not nodes:
            return None
        if len(nodes) * n > LARGEST_WEIGHTS:
            raise InputError("has too many joints for its vertices: export a skin with fewer joints.")
        found = [(node, self.document.item("nodes", node).get("name")) for node in nodes]
        names = unique_names(
            [name if isinstance(name, str) and name else f"node {node}" for node, name in found]
        )
        weights = np.zeros((n, len(nodes)))
        for part in self.parts:
            column = np.minimum(np.searchsorted(nodes, part.joints), len(nodes) - 1)
            row = np.broadcast_to(part.first + np.arange(len(part.joints))[:, None], column.shape)
            np.add.at(weights, (row, column), part.weights)  # the weights at unused joints are 0
        return Skin(tuple(names), weights)


def _times(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        return vectors if np.array_equal(matrix[:3, :3], np.eye(3)) else vectors @ matrix[:3, :3].T


def _has_copies(vertices: np.ndarray) -> bool:
    return bool((first_equal_rows(vertices) != np.arange(len(vertices))).any())


def _without_copies(polygons: Polygons, record: dict[str, Any], document: Document) -> Polygons:
    """Join the vertices that `format_gltf` duplicated along texture seams.

    `record` lists the original of each vertex.
    """
    n = len(polygons.vertices)
    original, texture = (
        document.view(record.get(key), 0, n, "i4", 1)[:, 0].astype(np.int64)
        for key in ("vertices", "texture")
    )
    known = texture >= 0
    vertices, first = np.unique(original, return_index=True)
    textures, first_texture = np.unique(texture[known], return_index=True)
    if (
        not np.array_equal(vertices, np.arange(len(vertices)))
        or not np.array_equal(textures, np.arange(len(textures)))
        or (texture < -1).any()
    ):
        raise InputError(f"the record of duplicate vertices is not valid, {DAMAGED}")
    coordinates = (
        None if polygons.texture is None else polygons.texture[0][np.flatnonzero(known)[first_texture]]
    )
    skin = polygons.skin
    return polygons._replace(
        vertices=polygons.vertices[first],
        corners=original[polygons.corners],
        vertex_data={name: values[first] for name, values in polygons.vertex_data.items()},
        texture=None if coordinates is None else (coordinates, texture[polygons.corners]),
        blend_shapes={name: moves[first] for name, moves in polygons.blend_shapes.items()},
        skin=None if skin is None else Skin(skin.joints, skin.weights[first]),
    )
