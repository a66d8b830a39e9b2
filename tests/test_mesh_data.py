"""Meshes keep the data on their vertices and faces in all formats, also in files of other programs."""

import json
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_samples import sample
from messages import assert_names
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkBitArray, vtkPoints, vtkStringArray
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkUnstructuredGrid
from vtkmodules.vtkIOLegacy import vtkPolyDataReader, vtkPolyDataWriter, vtkUnstructuredGridWriter
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLPolyDataWriter

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.io import (
    MeshData,
    Skeleton,
    Skin,
    Texture,
    read_mesh,
    read_mesh_data,
    write_mesh,
    write_mesh_data,
)

SUFFIXES = [".off", ".obj", ".ply", ".stl", ".mat", ".vtk", ".vtp", ".gltf", ".glb", ".npz", ".gii", ".pial"]
# What the formats keep of the sample: vertex data, face data, and other attributes.
ALL_VERTEX_DATA = {"colors", "temperature", "flow", "index", "flags", "short", "long"}
KEPT = {
    ".off": ({"colors"}, {"colors"}, set()),
    ".obj": ({"colors"}, {"group"}, {"texture", "label_names"}),
    ".ply": (ALL_VERTEX_DATA, {"colors", "group", "stress"}, {"texture"}),
    ".stl": (set(), set(), set()),
    ".mat": (ALL_VERTEX_DATA, {"colors", "group", "stress"}, {"texture", "skin", "label_names"}),
    ".vtk": (ALL_VERTEX_DATA, {"colors", "group", "stress"}, {"texture"}),
    ".vtp": (ALL_VERTEX_DATA, {"colors", "group", "stress"}, {"texture"}),
    ".gltf": (ALL_VERTEX_DATA, set(), {"texture", "blend_shapes", "skin"}),
    ".glb": (ALL_VERTEX_DATA, set(), {"texture", "blend_shapes", "skin"}),
    ".npz": (
        ALL_VERTEX_DATA,
        {"colors", "group", "stress"},
        {"texture", "blend_shapes", "skin", "label_names"},
    ),
    ".gii": (ALL_VERTEX_DATA, set(), set()),
    ".pial": (set(), set(), set()),
}
SINGLE = (".stl", ".gltf", ".glb", ".gii", ".pial")  # formats with float32


def close(suffix: str) -> float:
    return 1e-6 if suffix in SINGLE else 0.0


@pytest.mark.parametrize("seam", [False, True])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_data_are_read_back(tmp_path, suffix, seam):
    data = sample(seam=seam)
    notes = write_mesh_data(tmp_path / f"m{suffix}", data)
    again = read_mesh_data(tmp_path / f"m{suffix}")
    vertex_data, face_data, others = KEPT[suffix]
    limit = close(suffix)
    if suffix == ".stl":
        corners, found = data.mesh.vertices[data.faces], again.mesh.vertices[again.faces]
        assert np.allclose(corners, found, atol=limit) and len(again.mesh.vertices) == 6
    else:
        assert np.array_equal(again.faces, data.faces)
        assert np.allclose(again.mesh.vertices, data.mesh.vertices, rtol=0, atol=limit)
        assert np.array_equal(again.mesh.faces, data.mesh.faces)
    assert set(again.vertex_data) == vertex_data and set(again.face_data) == face_data
    for name in vertex_data:
        factor = 255 if (suffix, name) == (".obj", "colors") else 1
        assert np.allclose(again.vertex_data[name] * factor, data.vertex_data[name], rtol=1e-15, atol=limit)
    for name in face_data:
        assert np.array_equal(again.face_data[name], data.face_data[name])
    if "texture" in others:
        found, expected = again.texture, data.texture
        at = expected.coordinates[expected.corners]
        assert np.allclose(found.coordinates[found.corners], at, rtol=0, atol=limit)
        if not seam or suffix in (".obj", ".mat", ".gltf", ".glb", ".npz"):
            assert np.array_equal(found.corners, expected.corners)
            assert np.allclose(found.coordinates, expected.coordinates, rtol=0, atol=limit)
    else:
        assert again.texture is None
    if "blend_shapes" in others:
        assert list(again.blend_shapes) == list(data.blend_shapes)
        for name, moves in data.blend_shapes.items():
            assert np.allclose(again.blend_shapes[name], moves, rtol=0, atol=limit)
    if "skin" in others:
        assert again.skin.joints == data.skin.joints
        assert np.allclose(again.skin.weights, data.skin.weights, rtol=0, atol=limit)
        assert np.array_equal(again.skin.skeleton.parents, data.skin.skeleton.parents)
        matrices = (skin.skeleton.bind_matrices for skin in (again.skin, data.skin))
        assert np.allclose(*matrices, rtol=0, atol=10 * limit)
    assert again.label_names == (data.label_names if "label_names" in others else {})
    assert_notes_name_what_is_lost(notes, data, again)


def assert_notes_name_what_is_lost(notes: tuple[str, ...], data: MeshData, again: MeshData) -> None:
    text = " ".join(notes)
    assert all(note.endswith(".") and "\n" not in note for note in notes)
    for attribute, noun in [
        ("vertex_data", "vertex data"), ("face_data", "face data"), ("blend_shapes", "blend shapes")
    ]:  # fmt: skip
        lost = set(getattr(data, attribute)) - set(getattr(again, attribute))
        assert (f"cannot hold the {noun} " in text) == bool(lost)
    assert ("texture coordinates" in text) == (again.texture is None)
    assert ("joints" in text) == (again.skin is None)
    assert ("names of the labels" in text) == (again.label_names == {})


@pytest.mark.parametrize("suffix", [".ply", ".mat", ".vtk", ".vtp", ".npz"])
def test_types_of_data_are_kept(tmp_path, suffix):
    data = sample()
    write_mesh_data(tmp_path / f"m{suffix}", data)
    again = read_mesh_data(tmp_path / f"m{suffix}")
    for name, values in data.vertex_data.items():
        expected = np.dtype(np.int32) if (suffix, name) == (".ply", "long") else values.dtype
        assert again.vertex_data[name].dtype == expected


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_are_the_same_every_time_and_a_second_round_changes_nothing(tmp_path, suffix):
    first, second, third = (tmp_path / f"{name}{suffix}" for name in "abc")
    write_mesh_data(first, sample())
    write_mesh_data(second, sample())
    if suffix != ".mat":  # SciPy writes the time into the header
        assert first.read_bytes() == second.read_bytes()
    again = read_mesh_data(first)
    write_mesh_data(third, again)
    last = read_mesh_data(third)
    assert np.array_equal(last.mesh.vertices, again.mesh.vertices) and np.array_equal(last.faces, again.faces)
    for name, values in again.vertex_data.items():
        assert np.allclose(last.vertex_data[name], values, rtol=1e-15)
    if again.texture is not None:
        assert np.allclose(last.texture.coordinates, again.texture.coordinates, atol=1e-7)
        assert np.array_equal(last.texture.corners, again.texture.corners)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_without_data_is_written_without_notes(tmp_path, suffix):
    mesh = sample().mesh
    notes = write_mesh(tmp_path / f"m{suffix}", mesh)
    assert len(notes) == (suffix == ".stl")
    again = read_mesh_data(tmp_path / f"m{suffix}")
    assert again.vertex_data == {} and again.face_data == {} and again.texture is None and again.skin is None
    assert np.array_equal(again.mesh.faces, mesh.faces) and len(again.faces) == len(mesh.faces)
    assert read_mesh(tmp_path / f"m{suffix}").notes == again.mesh.notes


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".vtk", ".vtp", ".gltf", ".glb", ".mat", ".npz"])
def test_corners_without_texture_stay_without(tmp_path, suffix):
    data = sample()
    corners = data.texture.corners.copy()
    corners[1], corners[3, 2] = -1, -1
    data = MeshData(data.mesh, data.faces, texture=Texture(data.texture.coordinates, corners))
    assert write_mesh_data(tmp_path / f"m{suffix}", data) == ()
    again = read_mesh_data(tmp_path / f"m{suffix}").texture
    assert np.array_equal(again.corners < 0, corners < 0)
    known = corners >= 0
    at = again.coordinates[again.corners[known]]
    assert np.allclose(at, data.texture.coordinates[corners[known]], atol=close(suffix))


@pytest.mark.parametrize("kind", [np.uint8, np.float64])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("suffix", [".off", ".ply", ".vtp", ".glb"])
def test_colors_of_both_types_and_with_alpha_are_kept(tmp_path, suffix, channels, kind):
    colors = np.random.default_rng(1).integers(0, 255, (7, channels)).astype(np.uint8)
    colors = colors if kind == np.uint8 else colors / 255
    mesh = sample().mesh
    data = MeshData(mesh, mesh.faces, vertex_data={"colors": colors})
    write_mesh_data(tmp_path / f"m{suffix}", data)
    again = read_mesh_data(tmp_path / f"m{suffix}").vertex_data["colors"]
    is_plain = suffix == ".ply" and kind == np.float64 and channels == 3
    assert (again.shape == colors.shape and again.dtype.kind == colors.dtype.kind) or is_plain
    assert np.allclose(again, colors, atol=1e-7)


# --------------------------------------------------------------------------- files of other programs


@pytest.mark.parametrize("suffix", [".off", ".obj", ".ply", ".stl", ".glb", ".gltf"])
def test_trimesh_opens_written_files(tmp_path, suffix):
    data = replace(sample(), texture=None)
    write_mesh_data(tmp_path / f"m{suffix}", data)
    other = trimesh.load(tmp_path / f"m{suffix}", process=False, force="mesh")
    assert np.allclose(other.vertices[other.faces], data.mesh.vertices[data.faces], atol=1e-6)
    if suffix in (".off", ".ply", ".glb", ".gltf"):
        assert np.allclose(other.vertices, data.mesh.vertices, rtol=0, atol=close(suffix))
        assert np.array_equal(other.faces, data.faces)
    if suffix in (".ply", ".glb", ".gltf"):
        assert np.array_equal(other.visual.vertex_colors[:, :3], data.vertex_data["colors"])
    if suffix in (".glb", ".gltf"):
        assert np.allclose(other.vertex_attributes["_temperature"].ravel(), data.vertex_data["temperature"])
        assert np.array_equal(other.vertex_attributes["_short"], data.vertex_data["short"])


@pytest.mark.parametrize("seam", [False, True])
@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_trimesh_opens_written_textures(tmp_path, suffix, seam):
    data = replace(sample(seam=seam), vertex_data={})
    write_mesh_data(tmp_path / f"m{suffix}", data)
    other = trimesh.load(tmp_path / f"m{suffix}", process=False, force="mesh")
    assert np.allclose(other.vertices[other.faces], data.mesh.vertices[data.faces], atol=1e-6)
    if (suffix, seam) != (".ply", True):  # trimesh does not read coordinates of corners from PLY files
        at = data.texture.coordinates[data.texture.corners]
        assert np.allclose(other.visual.uv[other.faces], at, atol=1e-6)


def vtk_arrays(attributes) -> dict[str, np.ndarray]:
    arrays = (attributes.GetArray(i) for i in range(attributes.GetNumberOfArrays()))
    return {array.GetName(): vtk_to_numpy(array) for array in arrays if array is not None}


def vtk_cells(lists: list[list[int]]) -> vtkCellArray:
    cells = vtkCellArray()
    for corners in lists:
        cells.InsertNextCell(len(corners), corners)
    return cells


def vtk_array(values: np.ndarray, name: str):
    array = numpy_to_vtk(values, deep=True)
    array.SetName(name)
    return array


@pytest.mark.parametrize(("suffix", "reader"), [(".vtk", vtkPolyDataReader), (".vtp", vtkXMLPolyDataReader)])
@pytest.mark.parametrize("seam", [False, True])
def test_vtk_opens_written_files(tmp_path, suffix, reader, seam):
    data = sample(seam=seam)
    write_mesh_data(tmp_path / f"m{suffix}", data)
    source = reader()
    source.SetFileName(str(tmp_path / f"m{suffix}"))
    source.Update()
    mesh = source.GetOutput()
    assert np.array_equal(vtk_to_numpy(mesh.GetPoints().GetData()), data.mesh.vertices)
    assert np.array_equal(vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()), data.faces.ravel())
    points, cells = vtk_arrays(mesh.GetPointData()), vtk_arrays(mesh.GetCellData())
    for found, expected in ((points, data.vertex_data), (cells, data.face_data)):
        for name, values in expected.items():
            assert np.array_equal(found[name], values) and found[name].dtype == values.dtype
    coordinates = mesh.GetPointData().GetTCoords()
    assert (coordinates is None) == seam
    if seam:
        assert np.array_equal(
            cells["texcoord"].reshape(-1, 3, 2), data.texture.coordinates[data.texture.corners]
        )
    else:
        assert np.array_equal(vtk_to_numpy(coordinates), data.texture.coordinates)


def poly_data() -> vtkPolyData:
    """PolyData with points, lines, polygons, strips and arrays of several kinds."""
    random = np.random.default_rng(0)
    mesh, points = vtkPolyData(), vtkPoints()
    points.SetData(numpy_to_vtk(np.round(random.normal(size=(8, 3)), 2).astype(np.float32), deep=True))
    mesh.SetPoints(points)
    mesh.SetVerts(vtk_cells([[0], [1, 2]]))
    mesh.SetLines(vtk_cells([[0, 1, 2]]))
    mesh.SetPolys(vtk_cells([[0, 1, 2], [2, 1, 3, 4], [4, 5, 6]]))
    mesh.SetStrips(vtk_cells([[0, 3, 5, 6, 7], [1, 4, 7]]))
    mesh.GetCellData().SetScalars(vtk_array(np.arange(8) * 1.5, "my cell"))
    mesh.GetCellData().AddArray(vtk_array(np.arange(24, dtype=np.uint8).reshape(8, 3), "rgb"))
    at_points = mesh.GetPointData()
    at_points.SetScalars(vtk_array(random.integers(0, 256, (8, 4)).astype(np.uint8), "RGBA"))
    at_points.AddArray(vtk_array(random.integers(-(2**60), 2**60, 8), "int64 %"))
    at_points.SetNormals(vtk_array(np.round(random.normal(size=(8, 3)), 3), "Normals"))
    at_points.SetVectors(vtk_array(np.round(random.normal(size=(8, 3)), 3), "velocity"))
    at_points.SetTCoords(vtk_array(np.arange(16.0).reshape(8, 2) / 16, "uv"))
    at_points.SetTensors(vtk_array(np.round(random.normal(size=(8, 9)), 3), "tensor"))
    words = vtkStringArray()
    words.SetName("words")
    for i in range(30):
        words.InsertNextValue("a word " * i)
    mesh.GetFieldData().AddArray(words)
    return mesh


def check_poly_data(data: MeshData, *, bits: bool = False) -> None:
    expected = poly_data()
    assert np.array_equal(data.mesh.vertices, vtk_to_numpy(expected.GetPoints().GetData()))
    strips = [[0, 3, 5], [5, 3, 6], [5, 6, 7], [1, 4, 7]]
    assert data.faces.tolist() == [[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 5, 6], *strips]
    cells = [3, 4, 4, 5, 6, 6, 6, 7]
    for name, values in vtk_arrays(expected.GetCellData()).items():
        assert np.array_equal(data.face_data[name], values[cells])
    arrays = vtk_arrays(expected.GetPointData())
    assert np.array_equal(data.texture.coordinates, arrays.pop("uv"))
    assert np.array_equal(data.texture.corners, data.faces)
    assert set(data.vertex_data) == {*arrays, *(["bits"] if bits else [])}
    for name, values in arrays.items():
        assert np.array_equal(data.vertex_data[name], values)
        assert data.vertex_data[name].dtype == values.dtype
    assert_names(data.mesh.notes[0], "3 cells ignored", "points and lines")


@pytest.mark.parametrize(("is_binary", "version"), [*product([False, True], [42, 51])])
def test_legacy_files_of_vtk_are_read(tmp_path, is_binary, version):
    mesh, bits = poly_data(), vtkBitArray()
    bits.SetName("bits")
    for i in range(8):
        bits.InsertNextValue(i % 3 == 0)
    mesh.GetPointData().AddArray(bits)
    writer = vtkPolyDataWriter()
    writer.SetInputData(mesh)
    writer.SetFileType(2 if is_binary else 1)
    writer.SetFileVersion(version)
    writer.SetFileName(str(tmp_path / "m.vtk"))
    writer.Write()
    data = read_mesh_data(tmp_path / "m.vtk")
    check_poly_data(data, bits=True)
    assert data.vertex_data["bits"].tolist() == [1, 0, 0, 1, 0, 0, 1, 0]


@pytest.mark.parametrize(
    ("mode", "compressor", "order", "header"),
    [
        *product(
            ["ascii", "binary", "base64", "raw"], ["none", "zlib", "lz4", "lzma"], ["little", "big"], [32, 64]
        )
    ],
)
def test_xml_files_of_vtk_are_read(tmp_path, mode, compressor, order, header):
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(poly_data())
    writer.SetDataMode(["ascii", "binary", "base64", "raw"].index(mode) if mode != "raw" else 2)
    writer.SetEncodeAppendedData(mode == "base64")
    writer.SetCompressorType(["none", "zlib", "lz4", "lzma"].index(compressor))
    writer.SetByteOrder(["big", "little"].index(order))
    writer.SetHeaderType(header)
    if compressor != "none":
        writer.SetBlockSize(48)  # several blocks per array, the last of them smaller
    writer.SetFileName(str(tmp_path / "m.vtp"))
    writer.Write()
    check_poly_data(read_mesh_data(tmp_path / "m.vtp"))


def test_lz4_without_its_package_is_refused(tmp_path, monkeypatch):
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(poly_data())
    writer.SetCompressorTypeToLZ4()
    writer.SetFileName(str(tmp_path / "m.vtp"))
    writer.Write()
    monkeypatch.setitem(sys.modules, "lz4", None)
    monkeypatch.setitem(sys.modules, "lz4.block", None)
    with pytest.raises(InputError, match=r"run pip install 'jaxsmw\[vtk\]', or save"):
        read_mesh(tmp_path / "m.vtp")


@pytest.mark.parametrize(("is_binary", "version"), [*product([False, True], [42, 51])])
def test_unstructured_grids_of_vtk_are_read(tmp_path, is_binary, version):
    grid, points = vtkUnstructuredGrid(), vtkPoints()
    for position in np.random.default_rng(0).normal(size=(6, 3)):
        points.InsertNextPoint(position)
    grid.SetPoints(points)
    for kind, corners in [(5, [0, 1, 2]), (3, [0, 1]), (9, [2, 1, 3, 4]), (6, [2, 3, 4, 5]), (7, [0, 4, 5])]:
        grid.InsertNextCell(kind, len(corners), corners)
    grid.GetCellData().AddArray(vtk_array(np.arange(5, dtype=np.int32), "part"))
    writer = vtkUnstructuredGridWriter()
    writer.SetInputData(grid)
    writer.SetFileType(2 if is_binary else 1)
    writer.SetFileVersion(version)
    writer.SetFileName(str(tmp_path / "m.vtk"))
    writer.Write()
    data = read_mesh_data(tmp_path / "m.vtk")
    assert data.faces.tolist() == [[0, 1, 2], [2, 1, 3], [2, 3, 4], [2, 3, 4], [4, 3, 5], [0, 4, 5]]
    assert data.face_data["part"].tolist() == [0, 2, 2, 3, 3, 4]
    grid.InsertNextCell(10, 4, [0, 1, 2, 3])
    grid.GetCellData().Initialize()
    writer.Write()
    with pytest.raises(InputError, match=r"cells of type 10.*extract the surface"):
        read_mesh(tmp_path / "m.vtk")


def test_pieces_become_one_mesh(tmp_path):
    pieces = []
    for first in (0.0, 5.0):
        pieces.append(
            f"""<Piece NumberOfPoints="4" NumberOfVerts="1" NumberOfPolys="1">
            <Points><DataArray type="Float32" NumberOfComponents="3">{first} 0 0 1 0 0 1 1 0 0 1 0</DataArray></Points>
            <CellData><DataArray type="Int32" Name="c">{int(first)} {int(first) + 1}</DataArray></CellData>
            <Verts><DataArray type="Int32" Name="connectivity">0</DataArray>
            <DataArray type="Int32" Name="offsets">1</DataArray></Verts>
            <Polys><DataArray type="Int32" Name="connectivity">0 1 2 3</DataArray>
            <DataArray type="Int32" Name="offsets">4</DataArray></Polys></Piece>"""
        )
    (tmp_path / "m.vtp").write_text(
        f'<?xml version="1.0"?><VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>'
        f"{''.join(pieces)}</PolyData></VTKFile>"
    )
    data = read_mesh_data(tmp_path / "m.vtp")
    assert data.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    assert data.face_data["c"].tolist() == [1, 1, 6, 6] and data.mesh.vertices[4].tolist() == [5, 0, 0]


@pytest.mark.parametrize("name", ["07_5c", "11_4e"])
def test_real_mandibles_are_read_and_written_like_vtk(shared, tmp_path, name):
    path = shared / "data" / "mouse_mandibles" / f"{name}.vtk"
    source = vtkPolyDataReader()
    source.SetFileName(str(path))
    source.Update()
    expected = source.GetOutput()
    data = read_mesh_data(path)
    assert np.array_equal(data.mesh.vertices, vtk_to_numpy(expected.GetPoints().GetData()))
    assert np.array_equal(data.faces.ravel(), vtk_to_numpy(expected.GetPolys().GetConnectivityArray()))
    for suffix in (".vtk", ".vtp", ".glb", ".npz"):
        assert write_mesh_data(tmp_path / f"m{suffix}", data) == ()
        again = read_mesh_data(tmp_path / f"m{suffix}")
        assert np.array_equal(again.mesh.vertices, data.mesh.vertices), "float32 in the original file"
        assert np.array_equal(again.faces, data.faces)


# -------------------------------------------------------------------------------- text formats


def test_obj_groups_objects_materials_and_texture(tmp_path):
    path = tmp_path / "m.obj"
    path.write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0 0\nvt 1\nvt 0.5 0.25\n"
        "f 1 2 3\ng left  arm à\nusemtl skin\nf 1/1 3/2/1 4/-2\no head\nf 1/1 2/2 3/3 4/4\ng\nf 1 2/1 5\n",
        encoding="utf-8",
    )
    data = read_mesh_data(path)
    assert data.label_names == {
        "group": ("default", "left arm à"),
        "object": ("default", "head"),
        "material": ("default", "skin"),
    }
    assert data.face_data["group"].tolist() == [0, 1, 1, 1, 0]
    assert data.face_data["object"].tolist() == [0, 0, 1, 1, 1]
    assert data.face_data["material"].tolist() == [0, 1, 1, 1, 1]
    assert data.texture.coordinates.tolist() == [[0, 0], [1, 0], [1, 0], [0.5, 0.25]]
    assert data.texture.corners.tolist() == [[-1] * 3, [0, 1, 2], [0, 1, 2], [0, 2, 3], [-1, 0, -1]]
    write_mesh_data(tmp_path / "n.obj", data)
    again = read_mesh_data(tmp_path / "n.obj")
    assert again.label_names == data.label_names
    assert np.array_equal(again.texture.corners, data.texture.corners)


def test_ply_texture_of_vertices_and_of_corners(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {a}\n" for a in "xyz")
    positions = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
    face = "element face 2\nproperty list uchar int vertex_indices\n"
    (tmp_path / "v.ply").write_text(
        f"{head}property float s\nproperty float t\nproperty uchar q\n{face}end_header\n"
        + "".join(f"{p} {i}.5 {i} {i}\n" for i, p in enumerate(positions)) + "3 0 1 2\n3 0 2 3\n"
    )  # fmt: skip
    data = read_mesh_data(tmp_path / "v.ply")
    assert data.texture.coordinates.tolist() == [[0.5, 0], [1.5, 1], [2.5, 2], [3.5, 3]]
    assert data.texture.corners.tolist() == data.faces.tolist()
    assert list(data.vertex_data) == ["q"] and data.vertex_data["q"].dtype == np.uint8
    (tmp_path / "c.ply").write_text(
        f"{head}{face}property list uchar float texcoord\nend_header\n" + "\n".join(positions)
        + "\n4 0 1 2 3 8 0 0 1 0 1 1 0 1\n3 0 2 3 0\n"
    )  # fmt: skip
    data = read_mesh_data(tmp_path / "c.ply")
    corners = data.texture.corners
    assert data.texture.coordinates[corners[:2]].tolist() == [
        [[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]
    ]  # fmt: skip
    assert corners[2].tolist() == [-1, -1, -1] and corners[0, 0] == corners[1, 0]


def test_off_normals_and_texture(tmp_path):
    (tmp_path / "m.off").write_text(
        "STCNOFF\n3 1 0\n0 0 0 0 0 1 0.5 0.5 0.5 1.0 0 0\n1 0 0 0 0 1 1.0 0.5 0.5 1.0 1 0\n"
        "0 1 0 0 0 1 0.5 0.5 0.0 1.0 0 1\n3 0 1 2 0.25 0.5 0.75\n"
    )
    data = read_mesh_data(tmp_path / "m.off")
    assert data.vertex_data["normals"].tolist() == [[0, 0, 1]] * 3
    assert data.vertex_data["colors"].tolist() == [[0.5, 0.5, 0.5], [1, 0.5, 0.5], [0.5, 0.5, 0]]
    assert data.face_data["colors"].tolist() == [[0.25, 0.5, 0.75]]
    assert data.texture.coordinates.tolist() == [[0, 0], [1, 0], [0, 1]]


def skeleton(parents, matrices=None):
    """A skin with one joint, and a skeleton with the given arrays."""
    matrices = np.asarray([np.eye(4)] if matrices is None else matrices, float)
    return {"skin": Skin(("a",), np.ones((3, 1)), Skeleton(parents, matrices))}


# ------------------------------------------------------------------------------------------- checks

TRIANGLE = make_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], name="triangle")
FACES = np.array([[0, 1, 2]])
INCONSISTENT = {
    "faces out of range": ({"faces": np.array([[0, 1, 3]])}, "faces use a number outside the 3 vertices"),
    "negative faces": ({"faces": np.array([[0, 1, -1]])}, "faces use a number outside"),
    "fractional faces": ({"faces": FACES * 1.0}, "faces are float64"),
    "quads": ({"faces": np.array([[0, 1, 2, 0]])}, "give integers of shape"),
    "short vertex data": ({"vertex_data": {"a": [1, 2]}}, "'a' have 2 rows, but need 3"),
    "long face data": ({"face_data": {"a": [1, 2]}}, "'a' have 2 rows, but need 1"),
    "words": ({"vertex_data": {"a": ["x", "y", "z"]}}, "give each array a name, and one number"),
    "no name": ({"vertex_data": {"": [1, 2, 3]}}, "give each array a name"),
    "no columns": ({"vertex_data": {"a": np.empty((3, 0))}}, "one number or one row"),
    "three axes": ({"vertex_data": {"a": np.empty((3, 1, 1))}}, "one number or one row"),
    "texture without faces": ({"texture": Texture(np.zeros((2, 2)), np.zeros((0, 3), int))}, "0 rows of corners"),
    "texture out of range": ({"texture": Texture(np.zeros((2, 2)), FACES)}, "outside the 2 texture vertices"),
    "texture below -1": ({"texture": Texture(np.zeros((2, 2)), FACES - 2)}, "outside the 2 texture vertices"),
    "texture of nan": ({"texture": Texture(np.full((3, 2), np.nan), FACES)}, "not finite"),
    "texture of three columns": ({"texture": Texture(np.zeros((3, 3)), FACES)}, "needs numbers of shape"),
    "short blend shape": ({"blend_shapes": {"a": np.zeros((2, 3))}}, "needs numbers of shape (3, 3)"),
    "blend shape of inf": ({"blend_shapes": {"a": np.full((3, 3), np.inf)}}, "not finite"),
    "short skin": ({"skin": Skin(("a",), np.zeros((2, 1)))}, "needs numbers of shape (3, 1)"),
    "equal joints": ({"skin": Skin(("a", "a"), np.zeros((3, 2)))}, "not distinct"),
    "skin of nan": ({"skin": Skin(("a",), np.full((3, 1), np.nan))}, "not finite"),
    "short bind matrices": (skeleton([-1], np.zeros((2, 4, 4))), "needs numbers of shape (1, 4, 4)"),
    "flat bind matrix": (skeleton([-1], [np.diag([1, 1, 0, 1])]), "a bind matrix has no inverse"),
    "projective bind matrix": (skeleton([-1], [np.diag([1, 1, 1, 2])]), "a bind matrix has no inverse"),
    "parent out of range": (skeleton([1]), "not 1 integers from -1 to 0"),
    "parent of floats": (skeleton([0.5]), "not 1 integers from -1 to 0"),
    "own parent": (skeleton([0]), "is its own ancestor"),
    "labels without data": ({"label_names": {"a": ("x",)}}, "the array of labels 'a'"),
    "labels out of range": ({"face_data": {"a": [1]}, "label_names": {"a": ("x",)}}, "from 0 to 0"),
    "labels of floats": ({"face_data": {"a": [0.0]}, "label_names": {"a": ("x",)}}, "must contain integers"),
}  # fmt: skip


def arrays_in(value):
    """Convert lists of numbers in a dictionary to arrays."""
    is_data = isinstance(value, dict) and all(isinstance(one, list) for one in value.values())
    return {name: np.array(one) for name, one in value.items()} if is_data else value


@pytest.mark.parametrize("name", INCONSISTENT)
def test_inconsistent_data_are_refused(name):
    arguments, fault = INCONSISTENT[name]
    with pytest.raises(InputError) as caught:
        MeshData(TRIANGLE, **{"faces": FACES, **{key: arrays_in(value) for key, value in arguments.items()}})
    message = str(caught.value)
    assert message.startswith("triangle: ") and fault in message and message.count(": ") >= 2


def test_booleans_and_single_columns_become_plain_arrays():
    data = MeshData(
        TRIANGLE, FACES,
        vertex_data={"mask": FACES[0] != 1, "one": np.array([[1.5], [2], [3]]), "half": np.ones(3, "f2")},
    )  # fmt: skip
    assert data.vertex_data["mask"].dtype == np.uint8 and data.vertex_data["mask"].tolist() == [1, 0, 1]
    assert data.vertex_data["one"].shape == (3,) and data.vertex_data["half"].dtype == np.float32


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_numbers_beyond_float32_write_nothing(tmp_path, suffix):
    mesh = make_mesh(TRIANGLE.vertices * 1e40, FACES)
    with pytest.raises(InputError, match=r"too large for glTF files.*another unit"):
        write_mesh(tmp_path / f"m{suffix}", mesh)
    assert list(tmp_path.iterdir()) == []


def test_names_that_a_format_cannot_hold_are_reported(tmp_path):
    names = ["plain", "two words", "new\nline", "colors_0"]
    data = MeshData(TRIANGLE, FACES, vertex_data={name: np.arange(3.0) for name in names})
    for suffix, lost in [(".ply", ["two words", "new\nline"]), (".mat", ["two words", "new\nline"]),
                         (".vtk", []), (".vtp", ["new\nline"]), (".glb", []), (".npz", [])]:  # fmt: skip
        notes = write_mesh_data(tmp_path / f"m{suffix}", data)
        again = read_mesh_data(tmp_path / f"m{suffix}")
        assert set(again.vertex_data) == set(names) - set(lost)
        assert len(notes) == bool(lost) and all(ascii(name) in notes[0] for name in lost)


def test_numbers_that_a_format_cannot_hold_are_reported(tmp_path):
    data = MeshData(
        TRIANGLE, FACES,
        vertex_data={"huge": np.array([2**62, 1, 0]), "gap": np.array([np.nan, 1, 2]), "wide": np.zeros((3, 5))},
    )  # fmt: skip
    assert "'huge'" in write_mesh_data(tmp_path / "m.ply", data)[0]
    note = write_mesh_data(tmp_path / "m.glb", data)[0]
    assert all(name in note for name in ("'huge'", "'gap'", "'wide'"))
    json.loads((tmp_path / "m.glb").read_bytes()[20:].split(b"\0")[0].rpartition(b"}")[0] + b"}")
    for suffix in (".vtk", ".vtp", ".npz", ".mat"):
        assert write_mesh_data(tmp_path / f"m{suffix}", data) == ()
        again = read_mesh_data(tmp_path / f"m{suffix}")
        for name, values in data.vertex_data.items():
            assert np.array_equal(again.vertex_data[name], values, equal_nan=True)


def test_welding_changes_only_the_mesh(tmp_path):
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]]
    mesh: Mesh = make_mesh(vertices, [[0, 1, 2], [3, 4, 5]])
    write_mesh(tmp_path / "m.vtp", mesh)
    data = read_mesh_data(tmp_path / "m.vtp", weld=True)
    assert data.mesh.faces.tolist() == [[0, 1, 2], [0, 2, 5]] and data.faces.tolist() == mesh.faces.tolist()
    assert read_mesh(Path(tmp_path / "m.vtp")).faces.tolist() == mesh.faces.tolist()


def test_skins_with_many_joints_per_vertex_are_kept(tmp_path):
    weights = np.random.default_rng(0).uniform(size=(3, 11))
    weights[1, 3:] = 0
    data = MeshData(TRIANGLE, FACES, skin=Skin(tuple(map(str, range(11))), weights))
    write_mesh_data(tmp_path / "m.glb", data)
    assert np.allclose(read_mesh_data(tmp_path / "m.glb").skin.weights, weights, atol=1e-7)
