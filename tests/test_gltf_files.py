"""glTF files of all layouts are read as one surface, VTK opens written files, and damaged files are refused."""

import base64
import json
import struct
import sys
from dataclasses import replace
from pathlib import Path

import DracoPy
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_samples import sample
from messages import assert_names, refusal
from scipy.spatial.transform import Rotation
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOGeometry import vtkGLTFReader

from jaxsmw.creature import creature
from jaxsmw.errors import InputError
from jaxsmw.io import read_mesh, read_mesh_data, write_mesh_data

CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "f4")
FACES = np.array([0, 1, 2, 0, 2, 3], "u2")


class Builder:
    """A glTF document that grows by accessors."""

    def __init__(self):
        self.json = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": []}
        self.buffer = b""

    def view(self, content: bytes, **more) -> int:
        self.buffer += bytes(-len(self.buffer) % 4)
        self.json["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(content), **more}
        )
        self.buffer += content
        return len(self.json["bufferViews"]) - 1

    def add(self, values: np.ndarray, view: int | None = None, **more) -> int:
        rows = values.reshape(len(values), -1)
        self.json["accessors"].append({
            "bufferView": self.view(values.tobytes()) if view is None else view,
            "componentType": CODES[values.dtype.str[1:]], "count": len(values), "type": SHAPES[rows.shape[1]], **more,
        })  # fmt: skip
        return len(self.json["accessors"]) - 1

    def mesh(self, *primitives: dict, **more) -> int:
        self.json["meshes"].append({"primitives": list(primitives), **more})
        return len(self.json["meshes"]) - 1

    def nodes(self, *nodes: dict, roots: list[int] | None = None) -> None:
        self.json["nodes"] = list(nodes)
        self.json["scenes"] = [{"nodes": roots if roots is not None else list(range(len(nodes)))}]

    def save(self, folder: Path, kind: str = "glb") -> Path:
        document = json.loads(json.dumps(self.json))
        buffer = {"byteLength": len(self.buffer)}
        document["buffers"] = [buffer]
        path = folder / f"m.{'glb' if kind == 'glb' else 'gltf'}"
        if kind == "glb":
            path.write_bytes(glb(json.dumps(document).encode(), self.buffer))
            return path
        if kind == "data":
            buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(self.buffer).decode()
        else:
            (folder / "sub").mkdir(exist_ok=True)
            buffer["uri"] = "sub/a%20b.bin"
            (folder / "sub" / "a b.bin").write_bytes(self.buffer)
        path.write_text(json.dumps(document))
        return path


def glb(text: bytes, buffer: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    buffer += bytes(-len(buffer) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def square(**primitive) -> Builder:
    file = Builder()
    file.mesh({"attributes": {"POSITION": file.add(SQUARE)}, "indices": file.add(FACES), **primitive})
    file.nodes({"mesh": 0})
    return file


# ------------------------------------------------------------------------------------------ layouts


@pytest.mark.parametrize("kind", ["glb", "data", "file"])
def test_buffers_inside_and_outside_of_the_file_are_read(tmp_path, kind):
    mesh = read_mesh(square().save(tmp_path, kind))
    assert np.array_equal(mesh.vertices, SQUARE) and mesh.faces.ravel().tolist() == FACES.tolist()
    assert mesh.notes == ()


def test_interleaved_quantized_and_sparse_accessors_are_decoded(tmp_path):
    file = Builder()
    rows = np.zeros(4, [("p", "<i2", 3), ("pad", "<u2"), ("uv", "<u2", 2), ("c", "u1", 4)])
    rows["p"] = SQUARE * 32767
    rows["p"][0] = -32768
    rows["uv"] = SQUARE[:, :2] * 65535
    rows["c"] = np.arange(16).reshape(4, 4)
    view = file.view(rows.tobytes(), byteStride=rows.itemsize)
    attributes = {
        "POSITION": file.add(rows["p"], view, normalized=True),
        "TEXCOORD_0": file.add(rows["uv"], view, byteOffset=8, normalized=True),
        "COLOR_0": file.add(rows["c"], view, byteOffset=12, normalized=True),
        "_LABEL": file.add(np.array([7, 8, 9, 10], "u1")),
        "_MATRIX": file.add(np.zeros((4, 16), "f4")),
        "NORMAL": file.add(np.zeros((4, 3), "f4")),
    }
    sparse = {
        "count": 2,
        "indices": {"bufferView": file.view(np.array([1, 3], "u1").tobytes()), "componentType": 5121},
        "values": {"bufferView": file.view(np.array([[1, 2, 3], [4, 5, 6]], "f4").tobytes())},
    }
    target = {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse}
    file.json["accessors"].append(target)
    number = len(file.json["accessors"]) - 1
    file.mesh(
        {"attributes": attributes, "indices": file.add(FACES), "targets": [{"POSITION": number}, {}]},
        extras={"targetNames": ["up"]},
    )
    data = read_mesh_data(file.save(tmp_path))
    assert np.array_equal(data.mesh.vertices[1:], SQUARE[1:]) and data.mesh.vertices[0].tolist() == [
        -1,
        -1,
        -1,
    ]
    uv = SQUARE[:, :2] * [1, -1] + [0, 1]
    assert np.array_equal(data.texture.coordinates, uv) and np.array_equal(data.texture.corners, data.faces)
    assert (
        np.array_equal(data.vertex_data["colors"], rows["c"]) and data.vertex_data["colors"].dtype == np.uint8
    )
    assert data.vertex_data["LABEL"].tolist() == [7, 8, 9, 10] and set(data.vertex_data) == {
        "colors",
        "LABEL",
    }
    assert data.blend_shapes["up"].tolist() == [[0, 0, 0], [1, 2, 3], [0, 0, 0], [4, 5, 6]]
    assert not data.blend_shapes["target 1"].any()
    (note,) = data.mesh.notes
    assert_names(note, "'_MATRIX'", "ignored", "matrices")


def test_transforms_of_nodes_are_applied_in_the_order_of_the_scene(tmp_path):
    file = square()
    half = np.sqrt(0.5)
    file.nodes(
        {"mesh": 0, "name": "last"},
        {"children": [2], "translation": [10, 0, 0], "rotation": [0, 0, half, half], "scale": [2, 2, 2]},
        {"mesh": 0, "name": "first", "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},
        {"mesh": 0, "name": "not in the scene"},
        roots=[1, 0],
    )
    data = read_mesh_data(file.save(tmp_path))
    moved = (SQUARE * [-1, 1, 1] + [0, 0, 5]) @ [[0, 2, 0], [-2, 0, 0], [0, 0, 2]] + [10, 0, 0]
    assert np.allclose(data.mesh.vertices, np.concatenate([moved, SQUARE]), atol=1e-12)
    mirrored = FACES.reshape(-1, 3)[:, [0, 2, 1]]
    assert np.array_equal(data.faces, np.concatenate([mirrored, FACES.reshape(-1, 3) + 4]))
    assert data.label_names == {"group": ("first", "last")} and data.face_data["group"].tolist() == [
        0,
        0,
        1,
        1,
    ]


def test_a_scene_of_trimesh_is_read_as_trimesh_places_it(tmp_path):
    scene = trimesh.Scene()
    for i, shape in enumerate([trimesh.creation.icosphere(1), trimesh.creation.box()]):
        matrix = trimesh.transformations.rotation_matrix(0.3 + i, [1, 2, 3])
        matrix[:3, 3] = [3 * i, 1, 2]
        scene.add_geometry(shape, transform=matrix, geom_name=f"part {i}")
    for name in ("m.glb", "folder/m.gltf"):
        (tmp_path / "folder").mkdir(exist_ok=True)
        path = tmp_path / name
        if name.endswith("glb"):
            scene.export(path)
        else:
            for file, content in trimesh.exchange.gltf.export_gltf(scene).items():
                (path.parent / file.replace("model.gltf", "m.gltf")).write_bytes(content)
        joined = trimesh.load(path, process=False).to_mesh()
        data = read_mesh_data(path)
        # trimesh orders the nodes by itself.
        ours, theirs = (np.round(m[f].reshape(-1, 9), 5) + 0.0 for m, f in
                        ((data.mesh.vertices, data.faces), (joined.vertices, joined.faces)))  # fmt: skip
        assert len(data.mesh.vertices) == len(joined.vertices)
        assert np.allclose(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)], atol=2e-5)


@pytest.mark.parametrize(("mode", "indices", "faces"), [
    (4, None, [[0, 1, 2]]),
    (4, [2, 1, 0, 3, 2, 0], [[2, 1, 0], [3, 2, 0]]),
    (5, [0, 1, 3, 2], [[0, 1, 3], [1, 2, 3]]),
    (6, [0, 1, 2, 3], [[0, 1, 2], [0, 2, 3]]),
])  # fmt: skip
def test_all_modes_of_triangles_are_read(tmp_path, mode, indices, faces):
    file = Builder()
    attributes = {"POSITION": file.add(SQUARE[: 3 if indices is None else 4])}
    primitive = {"attributes": attributes, "mode": mode}
    if indices is not None:
        primitive["indices"] = file.add(np.array(indices, "u4"))
    lines = {"attributes": attributes, "mode": 1}
    file.mesh(primitive, lines)
    data = read_mesh_data(file.save(tmp_path))
    assert data.faces.tolist() == faces and data.mesh.notes[0] == "1 primitive of points or lines ignored."


def test_primitives_share_vertices_and_may_lack_data(tmp_path):
    file = Builder()
    shared = {"POSITION": file.add(SQUARE), "TEXCOORD_0": file.add(SQUARE[:, :2].copy())}
    other = {"POSITION": file.add(SQUARE + np.float32([0, 0, 1])), "_HEAT": file.add(SQUARE[:, 0].copy())}
    halves = [file.add(FACES[:3]), file.add(FACES[3:])]
    file.mesh(
        *({"attributes": shared, "indices": one} for one in halves),
        {"attributes": other, "indices": halves[0]},
    )
    data = read_mesh_data(file.save(tmp_path))
    assert len(data.mesh.vertices) == 8 and data.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6]]
    assert data.texture.corners.tolist() == [[0, 1, 2], [0, 2, 3], [-1, -1, -1]]
    assert data.vertex_data == {} and "'HEAT' were ignored" in data.mesh.notes[0]


def test_seams_of_other_programs_are_welded_for_matching(tmp_path):
    file = Builder()
    corners = SQUARE[FACES]
    file.mesh({"attributes": {"POSITION": file.add(corners), "_I": file.add(np.arange(6, dtype="u1"))}})
    data = read_mesh_data(file.save(tmp_path))
    assert np.array_equal(data.mesh.vertices, corners) and data.faces.ravel().tolist() == list(range(6))
    assert data.mesh.faces.tolist() == [[0, 1, 2], [0, 2, 5]] and len(data.vertex_data["I"]) == 6
    assert "Welding changed 1 face" in data.mesh.notes[0]


def test_skins_name_their_joints(tmp_path):
    file = square()
    attributes = file.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = file.add(
        np.array([[0, 1, 9, 0], [2, 0, 0, 0], [1, 2, 0, 0], [1, 1, 0, 0]], "u1")
    )
    weights = np.array([[255, 0, 0, 0], [255, 0, 0, 0], [51, 204, 0, 0], [51, 204, 0, 0]], "u1")
    attributes["WEIGHTS_0"] = file.add(weights, normalized=True)
    file.nodes(
        {"mesh": 0, "skin": 0, "translation": [9, 9, 9]},
        {"name": "hip"},
        {},
        {"name": "hip"},
        {"name": "unused"},
    )
    file.json["skins"] = [{"joints": [3, 1, 2, 4]}]
    data = read_mesh_data(file.save(tmp_path))
    assert np.array_equal(data.mesh.vertices, SQUARE), "the joints alone move a skinned mesh"
    assert data.skin.joints == ("hip", "node 2", "hip (2)", "unused") and data.skin.skeleton is None
    assert np.allclose(data.skin.weights, [[0, 0, 1, 0], [0, 1, 0, 0], [0.2, 0.8, 0, 0], [1, 0, 0, 0]])


def posed(file: dict, buffer: bytes) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that the nodes of a written file pose, by its matrices, and the stored vertices."""

    def numbers(index, kind="f4"):
        accessor = file["accessors"][index]
        view = file["bufferViews"][accessor["bufferView"]]
        width = {"VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        rows = np.frombuffer(buffer, np.uint8, view["byteLength"], view["byteOffset"]).reshape(
            accessor["count"], -1
        )
        return rows.copy().view(kind)[:, :width]

    def local(node):
        if "matrix" in node:
            return np.reshape(node["matrix"], (4, 4)).T
        turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix() @ np.diag(
            node.get("scale", [1] * 3)
        )
        return np.block([[turn, np.reshape(node.get("translation", [0] * 3), (3, 1))], [0, 0, 0, 1]])

    places, pending = {}, [(number, np.eye(4)) for number in file["scenes"][0]["nodes"]]
    for number, above in pending:
        places[number] = above @ local(file["nodes"][number])
        pending += [(child, places[number]) for child in file["nodes"][number].get("children", [])]
    skin, attributes = file["skins"][0], file["meshes"][0]["primitives"][0]["attributes"]
    inverses = numbers(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    motions = np.stack([places[node] for node in skin["joints"]]) @ inverses
    vertices = numbers(attributes["POSITION"]).astype(float)
    total = np.zeros((len(vertices), 4, 4))
    for part in range(sum(name.startswith("JOINTS") for name in attributes)):
        joints, weights = numbers(attributes[f"JOINTS_{part}"], "u2"), numbers(attributes[f"WEIGHTS_{part}"])
        total += np.einsum("nj,njab->nab", weights, motions[joints])
    return np.einsum("nab,nb->na", total, np.c_[vertices, np.ones(len(vertices))])[:, :3], vertices


def test_the_nodes_of_a_written_skeleton_pose_the_mesh(tmp_path):
    data = sample(seam=False)
    write_mesh_data(tmp_path / "m.gltf", data)
    file = json.loads((tmp_path / "m.gltf").read_text())
    buffer = base64.b64decode(file["buffers"][0]["uri"].split(",")[1])
    bound, vertices = posed(file, buffer)
    assert np.allclose(bound, vertices, atol=1e-5), "in the bind pose, the mesh stays as it is"
    nodes = {node["name"]: node for node in file["nodes"]}
    assert "matrix" in nodes["joint 3"] and "rotation" in nodes["joint 0"] and nodes["joint 0"]["scale"]
    # A turn of joint 4 moves what hangs on it (joints 0, 1, 3 and 5) about its place.
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2])
    nodes["joint 4"]["rotation"] = (
        (Rotation.from_quat(nodes["joint 4"]["rotation"]) * turn).as_quat().tolist()
    )
    found, _ = posed(file, buffer)
    moved = 1 - data.skin.weights[:, [2]]
    matrix = data.skin.skeleton.bind_matrices[4]
    motion = matrix @ np.block([[turn.as_matrix(), np.zeros((3, 1))], [0, 0, 0, 1]]) @ np.linalg.inv(matrix)
    turned = vertices @ motion[:3, :3].T + motion[:3, 3]
    assert np.allclose(found, moved * turned + (1 - moved) * vertices, atol=1e-5)


def test_joints_of_other_programs_have_parents_and_places(tmp_path):
    """Nodes between joints count in places, and are left out. Joints of several skins are joined."""
    file = square()
    attributes = file.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = file.add(np.zeros((4, 4), "u1"))
    attributes["WEIGHTS_0"] = file.add(np.array([[1, 0, 0, 0]] * 4, "f4"))
    places = np.tile(np.eye(4, dtype="f4"), (2, 1, 1))
    places[:, :3, 3] = [[1, 2, 3], [4, 5, 6]]
    matrices = np.linalg.inv(places)
    matrices[0, 3] += [1e-7, 0, 0, -1e-6]  # rounding errors of the exporter
    inverses = file.add(matrices.swapaxes(1, 2).reshape(2, 16))
    file.nodes(
        {"mesh": 0, "skin": 0},
        {"name": "hand"},
        {"children": [1]},
        {"name": "arm", "children": [2]},
        roots=[0, 3],
    )
    file.json["skins"] = [{"joints": [3, 1], "inverseBindMatrices": inverses}]
    skin = read_mesh_data(file.save(tmp_path)).skin
    assert skin.joints == ("hand", "arm") and skin.skeleton.parents.tolist() == [1, -1]
    assert np.allclose(skin.skeleton.bind_matrices, places[::-1], atol=1e-5)
    assert np.array_equal(skin.skeleton.bind_matrices[:, 3], [[0, 0, 0, 1]] * 2)
    assert np.array_equal(skin.weights, [[0, 1]] * 4)
    broken = file.add(np.zeros((2, 16), "f4"))
    file.json["skins"] = [{"joints": [3, 1], "inverseBindMatrices": broken}]
    data = read_mesh_data(file.save(tmp_path))
    assert data.skin.skeleton is None and "places of the joints were ignored" in " ".join(data.mesh.notes)
    # Another skin of the same joints has the right matrices.
    file.json["nodes"].append({"mesh": 0, "skin": 1})
    file.json["scenes"][0]["nodes"].append(4)
    file.json["skins"].append({"joints": [3, 1], "inverseBindMatrices": inverses})
    skin = read_mesh_data(file.save(tmp_path)).skin
    assert np.allclose(skin.skeleton.bind_matrices, places[::-1], atol=1e-5)
    file.json["accessors"][broken]["count"] = 1
    assert "a skin has 1 bind matrices for 2 joints" in refused_file(file.save(tmp_path))


@pytest.mark.parametrize("seam", [False, True])
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_vtk_opens_written_files(tmp_path, suffix, seam):
    data = sample(seam=seam)
    # VTK reads only four joints per vertex, and no integers other than joints and colours.
    weights = data.skin.weights * [1, 0, 1, 1, 0, 1]
    skin = data.skin._replace(weights=weights / weights.sum(axis=1, keepdims=True))
    vertex_data = {
        name: values for name, values in data.vertex_data.items() if name not in ("flags", "short")
    }
    data = replace(data, vertex_data=vertex_data, skin=skin)
    write_mesh_data(tmp_path / f"m{suffix}", data)
    reader = vtkGLTFReader()
    reader.SetFileName(str(tmp_path / f"m{suffix}"))
    reader.Update()
    mesh = reader.GetOutput()
    while hasattr(mesh, "GetBlock"):
        mesh = mesh.GetBlock(0)
    arrays = (mesh.GetPointData().GetArray(i) for i in range(mesh.GetPointData().GetNumberOfArrays()))
    found = {array.GetName(): vtk_to_numpy(array) for array in arrays}
    faces = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    assert mesh.GetNumberOfPoints() == (10 if seam else 7) + seam
    points = vtk_to_numpy(mesh.GetPoints().GetData())
    assert np.allclose(points[faces], data.mesh.vertices[data.faces], atol=1e-6)
    for name, values in data.vertex_data.items():
        at_corners = found["COLOR_0" if name == "colors" else f"_{name}"][faces].astype(float)
        factor = 255 if name == "colors" and at_corners.max() <= 1 else 1
        assert np.allclose(at_corners * factor, values[data.faces], atol=1e-4)
    uv = found["TEXCOORD_0"] * [1, -1] + [0, 1]
    assert np.allclose(uv[faces], data.texture.coordinates[data.texture.corners], atol=1e-6)
    for i, moves in enumerate(data.blend_shapes.values()):
        assert np.allclose(found[f"target{i}_position"][faces], moves[data.faces], atol=1e-6)
    weights = np.zeros((len(points), 6))
    np.add.at(weights, (np.arange(len(points))[:, None], found["JOINTS_0"].astype(int)), found["WEIGHTS_0"])
    assert np.allclose(weights[faces], data.skin.weights[data.faces], atol=1e-6)


# --------------------------------------------------------------------------------------- compression


def compressed(vertices, faces, colors=None, **more) -> Builder:
    """A file whose mesh is compressed by Google's library, without loss of positions."""
    file = Builder()
    content = DracoPy.encode(vertices, faces, quantization_bits=0, preserve_order=True, colors=colors, **more)
    attributes = {"POSITION": file.add(vertices, view=0)}
    if colors is not None:
        attributes["COLOR_0"] = file.add(colors, view=0)
    indices = file.add(faces.ravel(), view=0)
    for accessor in file.json["accessors"]:
        del accessor["bufferView"]
    names = {DracoPy.AttributeType.POSITION: "POSITION", DracoPy.AttributeType.COLOR: "COLOR_0"}
    listed = DracoPy.decode(content).attributes
    numbers = {names[attribute["attribute_type"]]: attribute["unique_id"] for attribute in listed}
    extension = {"bufferView": file.view(content), "attributes": numbers}
    file.mesh({"attributes": attributes, "indices": indices, "extensions": {DRACO: extension}})
    file.json["extensionsRequired"] = [DRACO]
    file.nodes({"mesh": 0})
    return file


def test_compressed_meshes_keep_positions_order_and_data(tmp_path):
    mesh = creature(vertices=500)
    vertices, faces = mesh.vertices.astype("f4"), mesh.faces.astype("u4")
    colors = np.random.default_rng(0).integers(0, 256, (len(vertices), 3), np.uint8)
    data = read_mesh_data(compressed(vertices, faces, colors).save(tmp_path))
    np.testing.assert_array_equal(data.mesh.vertices, vertices)
    np.testing.assert_array_equal(data.faces, faces)
    np.testing.assert_array_equal(data.vertex_data["colors"], colors)


def test_compressed_meshes_contradict_their_accessors(tmp_path):
    square = SQUARE, FACES.astype("u4").reshape(-1, 3)
    for change, fault in {
        "accessors__0__count": "accessor 0 does not have the shape of its compressed numbers",
        "accessors__1__count": "accessor 1 does not have the shape of its compressed numbers",
    }.items():
        file = compressed(*square)
        file.json["accessors"][int(change[11])]["count"] = 3
        assert fault in refused_file(file.save(tmp_path))
    file = compressed(*square)
    primitive = file.json["meshes"][0]["primitives"][0]
    primitive["extensions"][DRACO]["attributes"]["POSITION"] = 7
    assert "the compressed attribute 'POSITION' does not exist" in refused_file(file.save(tmp_path))


def test_compression_names_the_package_that_it_needs(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    path = compressed(SQUARE, FACES.astype("u4").reshape(-1, 3)).save(tmp_path)
    assert "pip install 'jaxsmw[draco]'" in refused_file(path)


# ------------------------------------------------------------------------------------------ hostile


def changed(**paths):
    """A square whose JSON has other values at some paths, such as accessors__0__count=7."""

    def make() -> Builder:
        file = square()
        for path, value in paths.items():
            *parents, last = (int(key) if key.isdigit() else key for key in path.split("__"))
            place = file.json
            for key in parents:
                place = place[key]
            place[last] = value
        return file

    return make


P = "meshes__0__primitives__0"
DRACO = "KHR_draco_mesh_compression"
SPARSE = {"count": 1, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}}
HOSTILE = {
    "no asset": (changed(asset={}), "version 2.0"),
    "version 1": (changed(asset={"version": "1.0"}), "version 2.0"),
    "version 3": (changed(asset={"version": "3.0"}), "version 2.0"),
    "later version needed": (changed(asset={"version": "2.1", "minVersion": "2.1"}), "version 2.0"),
    "version a list": (changed(asset={"version": [2]}), "version 2.0"),
    "draco without a view": (changed(**{f"{P}__extensions": {DRACO: {}}}), "uses bufferViews['None']"),
    "draco without a mesh": (changed(**{f"{P}__extensions": {DRACO: {"bufferView": 0}}}), "a compressed mesh that is not complete"),
    "draco a word": (changed(**{f"{P}__extensions": {DRACO: "x"}}), f"'{DRACO}' is not valid"),
    "meshopt": (changed(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
    "meshopt, not required": (changed(bufferViews__0__extensions={"EXT_meshopt_compression": {}}), "without compression"),
    "unknown extension": (changed(extensionsRequired=["VENDOR_cubes"]), "VENDOR_cubes"),
    "extensions not a list": (changed(extensionsRequired={"a": 1}), "'extensionsRequired' is not valid"),
    "no meshes": (changed(meshes=[]), "uses meshes[0], but the length of meshes is 0"),
    "meshes a number": (changed(meshes=3), "'meshes' is not valid"),
    "a mesh a word": (changed(meshes__0="x"), "'meshes' is not valid"),
    "primitives a word": (changed(meshes__0__primitives="x"), "'primitives' is not valid"),
    "a primitive a word": (changed(**{P: "x"}), "'primitives' is not valid"),
    "only lines": (changed(**{f"{P}__mode": 1}), "contains no triangles"),
    "unknown mode": (changed(**{f"{P}__mode": -1}), "'mode' is not valid"),
    "no position": (changed(**{f"{P}__attributes": {}}), "the length of accessors is 2"),
    "accessor out of range": (changed(**{f"{P}__indices": 2}), "uses accessors[2], but the length of accessors is 2"),
    "accessor negative": (changed(**{f"{P}__indices": -1}), "uses accessors[-1], but the length of accessors is 2"),
    "accessor true": (changed(**{f"{P}__indices": True}), "uses accessors[True]"),
    "accessor huge": (changed(**{f"{P}__indices": 10**400}), "the length of accessors is 2"),
    "positions of pairs": (changed(accessors__0__type="VEC2"), "does not have a suitable type"),
    "type a list": (changed(accessors__0__type=["VEC3"]), "does not have a suitable type"),
    "unknown component": (changed(accessors__0__componentType=5130), "does not have a suitable type"),
    "indices of floats": (changed(accessors__1__componentType=5126, accessors__1__count=3), "vertex that does not exist"),
    "one vertex too many": (changed(accessors__0__count=5), "needs more bytes than buffer view 0"),
    "2^60 vertices": (changed(accessors__0__count=2**60), "'count' is not valid"),
    "2^52 vertices": (changed(accessors__0__count=2**52), "needs more bytes than buffer view 0"),
    "fractional count": (changed(accessors__0__count=3.5), "'count' is not valid"),
    "no count": (changed(accessors__0={"bufferView": 0, "componentType": 5126, "type": "VEC3"}), "'count'"),
    "no view": (changed(accessors__0={"componentType": 5126, "type": "VEC3", "count": 2**40}), "has no buffer view"),
    "offset too large": (changed(accessors__0__byteOffset=4), "needs more bytes"),
    "view too long": (changed(bufferViews__0__byteLength=10**9), "does not fit its buffer"),
    "view too late": (changed(bufferViews__0__byteOffset=2**50), "does not fit its buffer"),
    "stride zero": (changed(bufferViews__0__byteStride=0), "does not fit its buffer"),
    "stride too small": (changed(bufferViews__0__byteStride=4), "does not fit its buffer"),
    "no such buffer": (changed(bufferViews__0__buffer=1), "uses buffers[1], but the length of buffers is 1"),
    "vertex out of range": (changed(accessors__0__count=3), "a triangle uses a vertex that does not exist"),
    "four corners": (changed(accessors__1__count=4), "4 corners, which do not form triangles"),
    "no corners": (changed(accessors__1__count=0), "no faces"),
    "sparse out of range": (changed(accessors__0__sparse={**SPARSE, "count": 4}, accessors__0__count=3), "a sparse accessor"),
    "sparse of 2^52": (changed(accessors__0__sparse={**SPARSE, "count": 2**52}), "a sparse accessor"),
    "sparse without view": (changed(accessors__0__sparse={**SPARSE, "values": {}}), "uses bufferViews['None']"),
    "texture too short": (changed(**{f"{P}__attributes__TEXCOORD_0": 1}), "does not have a suitable type"),
    "color of indices": (changed(**{f"{P}__attributes__COLOR_0": 1}), "does not have a suitable type"),
    "data too long": (changed(**{f"{P}__attributes___A": 1}), "has 6 elements instead of 4"),
    "targets a word": (changed(**{f"{P}__targets": "x"}), "'targets' is not valid"),
    "target a number": (changed(**{f"{P}__targets": [5]}), "'targets' is not valid"),
    "target too long": (changed(**{f"{P}__targets": [{"POSITION": 1}]}), "does not have a suitable type"),
    "many targets": (changed(**{f"{P}__targets": [{}] * 10**4}), None),
    "node out of range": (changed(scenes=[{"nodes": [4]}]), "uses nodes[4], but the length of nodes is 1"),
    "scene out of range": (changed(scene=3), "uses scenes[3], but the length of scenes is 1"),
    "scene without nodes": (changed(scenes=[{}]), "contains no triangles"),
    "circle": (changed(nodes=[{"mesh": 0, "children": [0]}]), "node 0 has several parents"),
    "circle without scene": (changed(nodes=[{"children": [1]}, {"mesh": 0, "children": [0]}], scenes=[]), "the length of scenes is 0"),
    "short matrix": (changed(nodes=[{"mesh": 0, "matrix": [1, 2]}]), "'matrix' is not valid"),
    "matrix of words": (changed(nodes=[{"mesh": 0, "matrix": ["x"] * 16}]), "'matrix' is not valid"),
    "infinite scale": (changed(nodes=[{"mesh": 0, "scale": [10**400] * 3}]), "'scale' is not valid"),
    "overflowing scales": (changed(nodes=[{"children": [1], "scale": [1e299] * 3}, {"mesh": 0, "scale": [1e299] * 3}], scenes=[{"nodes": [0]}]), "not a finite number"),
    "no scale": (changed(nodes=[{"mesh": 0, "scale": [0, 0, 0]}]), "no triangle has an area"),
    "skin out of range": (changed(nodes=[{"mesh": 0, "skin": 0}]), "uses skins[0], but the length of skins is 0"),
    "record damaged": (changed(meshes__0__extras={"jaxsmw": {"vertices": 0, "texture": 0}}), "record of duplicate"),
    "record without views": (changed(meshes__0__extras={"jaxsmw": {"vertices": 9}}), "uses bufferViews[9], but the length of bufferViews is 2"),
    "record a word": (changed(meshes__0__extras={"jaxsmw": "x"}), None),
    "extras a word": (changed(meshes__0__extras="x"), None),
}  # fmt: skip


def refused_file(path: Path) -> str:
    return refusal(read_mesh, path, most_memory=1e7 + 20 * path.stat().st_size)


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("kind", ["glb", "data"])
def test_hostile_documents_are_refused_in_one_sentence(tmp_path, name, kind):
    make, fault = HOSTILE[name]
    path = make().save(tmp_path, kind)
    if fault is None:  # unusual but valid
        assert len(read_mesh(path).faces) == 2
    else:
        assert fault in refused_file(path)


@pytest.mark.parametrize("uri", [
    "../m.bin", "sub/../../m.bin", "/etc/passwd", "file:///etc/passwd", "http://localhost:1/m.bin", "HTTPS://x/m.bin",
    "C:\\m.bin", "..\\m.bin", "%2e%2e/m.bin", "%2Fetc/passwd", "sub//m.bin", "./m.bin", "", "a\0b", "\\\\host\\m.bin",
    "link.bin", "linked/m.bin",
])  # fmt: skip
def test_buffers_outside_of_the_folder_are_not_read(tmp_path, uri):
    folder = tmp_path / "folder"
    folder.mkdir()
    file = square()
    (tmp_path / "m.bin").write_bytes(file.buffer)
    (folder / "link.bin").symlink_to(tmp_path / "m.bin")
    (folder / "linked").symlink_to(tmp_path)
    path = file.save(folder, "file")
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = uri
    path.write_text(json.dumps(document))
    message = refused_file(path)
    assert "which is not a file in the folder" in message or "which links to another folder" in message
    (folder / "x.glb").write_bytes(glb(path.read_bytes(), b""))
    assert "which is not a file in the folder" in refused_file(folder / "x.glb")


def test_missing_and_short_buffers_are_refused(tmp_path):
    file = square()
    path = file.save(tmp_path, "file")
    buffer = tmp_path / "sub" / "a b.bin"
    buffer.write_bytes(file.buffer[:-1])
    assert f"declares {len(file.buffer)} bytes in buffer 0, but the buffer has" in refused_file(path)
    buffer.unlink()
    assert "which cannot be read" in refused_file(path)
    buffer.mkdir()
    assert "which cannot be read" in refused_file(path)


@pytest.mark.parametrize(
    "uri", ["data:,abc", "data:x;base64", "data:;base64,a", "data:;base64,@@@@", 5, None]
)
def test_invalid_data_uris_are_refused(tmp_path, uri):
    path = square().save(tmp_path, "data")
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = uri
    path.write_text(json.dumps(document))
    assert "data URI" in (message := refused_file(path)) or "no contents for buffer 0" in message


@pytest.mark.parametrize("text", [
    b"", b"{", b"[]", b"3", b"null", b'{"asset": null}', b"\xff\xfe{}", b"[" * 10**6, b'{"asset": NaN}', b"1" * 10**4,
])  # fmt: skip
def test_texts_that_are_not_documents_are_refused(tmp_path, text):
    (tmp_path / "m.gltf").write_bytes(text or b" ")  # an empty file has a sentence of its own
    (tmp_path / "m.glb").write_bytes(glb(text, b""))
    for name in ("m.gltf", "m.glb"):
        assert "JSON" in (message := refused_file(tmp_path / name)) or "version 2.0" in message


@pytest.mark.parametrize(("change", "fault"), [
    (lambda c: c[:-1], "declares"), (lambda c: c + b"\0", "declares"), (lambda c: c[:12], "declares"),
    (lambda c: c[:3], "does not begin with glTF"), (lambda c: b"x" + c[1:], "does not begin with glTF"),
    (lambda c: c[:4] + b"\1" + c[5:], "version 1 of the GLB"), (lambda c: c[:4] + b"\3" + c[5:], "version 3"),
    (lambda c: c[:12] + b"\xff\xff\xff\xff" + c[16:], "a chunk of the file declares 4294967295 bytes"),
    (lambda c: c[:12] + b"\0\0\0\0" + c[16:], "a chunk of the file declares"), (lambda c: c[:16] + b"BIN\0" + c[20:], "JSON chunk"),
])  # fmt: skip
def test_damaged_containers_are_refused(tmp_path, change, fault):
    path = square().save(tmp_path)
    path.write_bytes(change(path.read_bytes()))
    assert fault in refused_file(path)


def test_files_that_end_anywhere_are_refused(tmp_path):
    write_mesh_data(tmp_path / "m.glb", sample())
    content = (tmp_path / "m.glb").read_bytes()
    for length in range(0, len(content), 97):
        (tmp_path / "m.glb").write_bytes(content[:length])
        refused_file(tmp_path / "m.glb")


@pytest.mark.parametrize("key", ["vertices", "texture"])
@pytest.mark.parametrize("wrong", [2**31 - 1, -(2**31), -2, 5])
def test_records_of_copies_with_gaps_are_refused(tmp_path, key, wrong):
    file = square()
    good, bad = np.arange(4, dtype="i4"), np.array([0, 1, 2, wrong], "i4")
    record = {one: file.view((bad if one == key else good).tobytes()) for one in ("vertices", "texture")}
    file.json["meshes"][0]["extras"] = {"jaxsmw": record}
    assert "record of duplicate vertices is not valid" in refused_file(file.save(tmp_path))


def test_repeated_primitives_cannot_fill_the_memory(tmp_path):
    file = Builder()
    position = file.add(np.random.default_rng(0).normal(size=(30000, 3)).astype("f4"))
    indices = file.add(np.zeros(60000, "u2"))
    file.mesh(*({"attributes": {"POSITION": position}, "indices": indices} for _ in range(3000)))
    path = file.save(tmp_path)
    with pytest.raises(InputError, match="corners of triangles"):
        read_mesh(path)
    file.nodes(*({"mesh": 0} for _ in range(400)))
    del file.json["meshes"][0]["primitives"][1:]
    path = file.save(tmp_path)
    with pytest.raises(InputError, match="more than 10000000 vertices"):
        read_mesh(path)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("sound") / "m.glb"
    write_mesh_data(path, sample())
    return path.read_bytes()


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_damaged_files_are_read_or_refused(tmp_path_factory, sound, data):
    path, content = tmp_path_factory.getbasetemp() / "damaged.glb", sound
    at = data.draw(st.integers(12, len(content) - 1))
    if data.draw(st.booleans()):
        at = data.draw(st.integers(12, content.index(b"BIN\0")))  # in the JSON part
    path.write_bytes(content[:at] + bytes([data.draw(st.integers(0, 255))]) + content[at + 1 :])
    message = None
    try:
        mesh = read_mesh_data(path).mesh
    except InputError as error:
        message = str(error)
    if message is None:
        assert np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)
    else:
        assert message.startswith(f"{path}: ") and "\n" not in message


def test_long_chains_and_many_uses_of_a_skin_are_read_quickly(tmp_path):
    """In an earlier version, 30 000 joints below 30 000 other nodes took longer than this test may."""
    file = square()
    attributes = file.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = file.add(np.zeros((4, 4), "u1"))
    attributes["WEIGHTS_0"] = file.add(np.array([[1, 0, 0, 0]] * 4, "f4"))
    chain = [{"children": [number + 2]} for number in range(9999)]
    chain.append({"children": list(range(10001, 20001))})
    file.nodes(
        {"mesh": 0, "skin": 0},
        *chain,
        *[{}] * 10000,
        *[{"mesh": 0, "skin": 0}] * 50,
        roots=[0, 1, *range(20001, 20051)],
    )
    inverses = np.tile(np.eye(4, dtype="f4"), (10000, 1, 1))
    inverses[:, 3, 0] = 1e-9
    inverses[:, 0, 3] = 1
    matrices = file.add(inverses.swapaxes(1, 2).reshape(-1, 16))
    file.json["skins"] = [{"joints": list(range(10001, 20001)), "inverseBindMatrices": matrices}]
    skeleton = read_mesh_data(file.save(tmp_path)).skin.skeleton
    assert (skeleton.parents == -1).all() and np.allclose(skeleton.bind_matrices[:, 0, 3], -1)
