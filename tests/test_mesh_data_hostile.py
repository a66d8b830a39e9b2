"""Damaged and hostile VTK, VTP, NPZ, OBJ, PLY and MAT files are refused in one sentence, with little memory."""

import base64
import io
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from command_line import assert_refused, write_pair
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_samples import sample
from messages import refusal

from jaxsmw.errors import InputError
from jaxsmw.io import read_mesh_data, write_mesh_data

POINTS = "POINTS 3 float\n0 0 0 1 0 0 0 1 0\n"
HEAD = "# vtk DataFile Version 3.0\ntitle\nASCII\nDATASET POLYDATA\n"
NEW = HEAD.replace("3.0", "5.1")
CELL = "POLYGONS 1 4\n3 0 1 2\n"
VTK = HEAD + POINTS + CELL


def binary_vtk(points: int = 3, sizes: bytes = struct.pack(">4i", 3, 0, 1, 2), more: bytes = b"") -> bytes:
    head = HEAD.replace("ASCII", "BINARY").encode() + f"POINTS {points} float\n".encode()
    return head + np.eye(3, dtype=">f4").tobytes() + b"\nPOLYGONS 1 4\n" + sizes + b"\n" + more


def vtp(points: str = "0 0 0 1 0 0 0 1 0", corners: str = "0 1 2", ends: str = "3", *, n: object = 3, f: object = 1,
        point_type: str = "Float32", form: str = "ascii", more: str = "", attributes: str = "", data: str = "") -> str:  # fmt: skip
    return (
        f'<?xml version="1.0"?><VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" {attributes}>'
        f'<PolyData><Piece NumberOfPoints="{n}" NumberOfPolys="{f}"><PointData>{data}</PointData><Points>'
        f'<DataArray type="{point_type}" NumberOfComponents="3" format="{form}" {more}>{points}</DataArray></Points>'
        f'<Polys><DataArray type="Int64" Name="connectivity">{corners}</DataArray>'
        f'<DataArray type="Int64" Name="offsets">{ends}</DataArray></Polys></Piece></PolyData></VTKFile>'
    )


def packed(*header: int, content: bytes = b"", kind: str = "<u4") -> str:
    return (base64.b64encode(np.array(header, kind).tobytes()) + base64.b64encode(content)).decode()


ZLIB = 'compressor="vtkZLibDataCompressor"'
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
BOMB = zlib.compress(bytes(10**7))
ENTITIES = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]><VTKFile>&b;</VTKFile>'


def npz(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def npz_with_header(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    """An archive with an array that declares a shape without containing it."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("vertices.npy", array)
        archive.writestr("faces.npy", array)
    return file.getvalue()


V, F = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float), np.array([[0, 1, 2]])
NPZ = {"vertices": V, "faces": F}
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACE = "element face 1\nproperty list uchar int vertex_indices\n"
PLY_BODY = "end_header\n0 0 0\n1 0 0\n0 1 0\n"


def mat(**more) -> bytes:
    file = io.BytesIO()
    surface = (
        dict(zip("XYZ", V.T[..., None], strict=True)) | {"TRIV": np.array([[1.0, 2, 3], [1, 3, 2]])} | more
    )
    scipy.io.savemat(file, {"surface": surface})
    return file.getvalue()


HOSTILE = {
    # name: (content, what the message must say)
    "empty.vtk": ("", "is empty"),
    "other.vtk": ("OFF\n", "# vtk DataFile"),
    "version 9.vtk": (VTK.replace("3.0", "9.0"), "unknown version 9"),
    "version x.vtk": (VTK.replace("3.0", "x"), "# vtk DataFile"),
    "encoding.vtk": (VTK.replace("ASCII", "UTF8"), "where ASCII or BINARY"),
    "header only.vtk": (HEAD, "contains no POINTS"),
    "volume.vtk": (VTK.replace("POLYDATA", "STRUCTURED_GRID"), "'STRUCTURED_GRID' instead of"),
    "no cells.vtk": (HEAD + POINTS, "no faces"),
    "2^59 points.vtk": (VTK.replace("POINTS 3", f"POINTS {2**59}"), "the file ends within"),
    "2^40 binary points.vtk": (binary_vtk(points=2**40), "the file ends within"),
    "negative count.vtk": (VTK.replace("POINTS 3", "POINTS -3"), "'-3' is written where a count"),
    "count of a word.vtk": (VTK.replace("POINTS 3", "POINTS x"), "'x' is written where a count"),
    "2^59 polygons.vtk": (VTK.replace("POLYGONS 1 4", f"POLYGONS {2**59} 4"), "which contain other cells"),
    "2^59 corners.vtk": (VTK.replace("POLYGONS 1 4", f"POLYGONS 1 {2**59}"), "the file ends within"),
    "two polygons declared.vtk": (VTK.replace("POLYGONS 1 4", "POLYGONS 2 4"), "which contain other cells"),
    "polygon of a billion.vtk": (VTK.replace("3 0 1 2\n", "1000000000 0 1 2\n"), "which contain other cells"),
    "polygon of minus five.vtk": (VTK.replace("3 0 1 2\n", "-5 0 1 2\n"), "which contain other cells"),
    "polygon of minus one.vtk": (VTK.replace("3 0 1 2\n", "-1 0 1 2\n"), "which contain other cells"),
    "polygon of two.vtk": (VTK.replace("1 4\n3 0 1 2", "1 3\n2 0 1"), "2 corners"),
    "polygon of two billion.vtk": (binary_vtk(sizes=struct.pack(">4i", 2**31 - 1, 0, 1, 2)), "which contain other"),
    "lines.vtk": (HEAD + POINTS + "LINES 2 6\n2 0 1\n2 1 2\n", "2 lines"),
    "lines.vtp": (vtp(corners="0 1").replace('Polys', 'Lines').replace('>3</DataArray></Lines', '>2</DataArray></Lines'), "1 line"),
    "index too large.vtk": (VTK.replace("3 0 1 2\n", "3 0 1 3\n"), "uses vertex 3"),
    "index negative.vtk": (VTK.replace("3 0 1 2\n", "3 0 1 -2\n"), "uses vertex -2"),
    "index of 2^40.vtk": (VTK.replace("3 0 1 2\n", f"3 0 1 {2**40}\n"), "among numbers of the type int32"),
    "index fractional.vtk": (VTK.replace("3 0 1 2\n", "3 0 1 1.5\n"), "among numbers of the type int32"),
    "nan.vtk": (VTK.replace("1 0 0 0 1", "nan 0 0 0 1"), "not a finite number"),
    "word.vtk": (VTK.replace("1 0 0 0 1", "one 0 0 0 1"), "'one' is written among numbers"),
    "underscore.vtk": (VTK.replace("1 0 0 0 1", "1_0 0 0 0 1"), "'1_0' is written among numbers"),
    "ten coordinates.vtk": (VTK.replace("0 1 0\nP", "0 1 0 5\nP"), "continues after 9 numbers"),
    "unknown type.vtk": (VTK.replace("float", "quad"), "unknown type 'quad'"),
    "unknown keyword.vtk": (VTK + "CUBES 3\n", "invalid line 'CUBES 3'"),
    "points twice.vtk": (HEAD + POINTS + POINTS, "invalid line 'POINTS 3 float'"),
    "cells without types.vtk": (VTK.replace("POLYDATA", "UNSTRUCTURED_GRID").replace("POLYGONS", "CELLS"), "without CELL_TYPES"),
    "two types.vtk": (HEAD.replace("POLYDATA", "UNSTRUCTURED_GRID") + POINTS + "CELLS 1 4\n3 0 1 2\nCELL_TYPES 2\n5 5\n", "1 cell, but 2 types"),
    "tetrahedron.vtk": (HEAD.replace("POLYDATA", "UNSTRUCTURED_GRID") + POINTS + "CELLS 1 5\n4 0 1 2 0\nCELL_TYPES 1\n10\n", "cells of type 10"),
    "short strip.vtk": (HEAD + POINTS + "TRIANGLE_STRIPS 1 3\n2 0 1\n", "fewer than three corners"),
    "offsets too large.vtk": (NEW + POINTS + "POLYGONS 2 3\nOFFSETS vtktypeint64\n0 1000000000000\nCONNECTIVITY vtktypeint64\n0 1 2\n", "do not fit 3 corners"),
    "offsets decrease.vtk": (NEW + POINTS + "POLYGONS 4 3\nOFFSETS vtktypeint64\n0 3 -3 3\nCONNECTIVITY vtktypeint64\n0 1 2\n", "do not fit 3 corners"),
    "no offsets.vtk": (NEW + POINTS + "POLYGONS 0 3\nOFFSETS vtktypeint64\n\nCONNECTIVITY vtktypeint64\n0 1 2\n", "but no offsets"),
    "connectivity missing.vtk": (NEW + POINTS + "POLYGONS 2 3\nOFFSETS vtktypeint64\n0 3\n", "ends early"),
    "scalars cut.vtk": (VTK + "POINT_DATA 3\nSCALARS a float\nLOOKUP_TABLE default\n1 2\n", "the file ends within"),
    "scalars without table.vtk": (VTK + "POINT_DATA 3\nSCALARS a float\n1 2 3\n", "invalid line '1 2 3'"),
    "scalars of 2^30 columns.vtk": (VTK + f"POINT_DATA 3\nSCALARS a float {2**30}\nLOOKUP_TABLE default\n1 2 3\n", "1073741824 columns"),
    "scalars of no columns.vtk": (VTK + "POINT_DATA 3\nSCALARS a float 0\nLOOKUP_TABLE default\n", "0 columns"),
    "field of 2^60 rows.vtk": (VTK + f"POINT_DATA 3\nFIELD f 1\na 1 {2**59} double\n1 2 3\n", "the file ends within"),
    "field of 2^59 arrays.vtk": (VTK + f"POINT_DATA 3\nFIELD f {2**59}\na 1 3 double\n1 2 3\n", "ends early"),
    "field of 2^59 strings.vtk": (VTK + f"FIELD f 1\na 1 {2**59} string\nx\n", "the file ends within"),
    "binary strings.vtk": (binary_vtk(more=b"FIELD f 1\na 1 2 string\n\x3f\xff\xff\xff\xff\xff\xff\xff"), "the file ends within"),
    "data for two points.vtk": (VTK + "POINT_DATA 2\nSCALARS a float\nLOOKUP_TABLE default\n1 2\n", "'a' has 2 rows, but the file has 3 points"),
    "data for two cells.vtk": (VTK + "CELL_DATA 2\nSCALARS a float\nLOOKUP_TABLE default\n1 2\n", "'a' has 2 rows, but the file has 1 cell"),
    "empty.vtp": ("", "is empty"),
    "cut.vtp": (vtp()[:-20], "not a complete XML file"),
    "entities.vtp": (ENTITIES, "not a complete XML file"),
    "encoding.vtp": (vtp().replace('"1.0"?', '"1.0" encoding="nonsense"?'), "not a complete XML file"),
    "deep.vtp": ("<a>" * 10**5 + "</a>" * 10**5, "not a VTK file of the type PolyData"),
    "other.vtp": ("<svg></svg>", "not a VTK file of the type PolyData"),
    "grid.vtp": (vtp().replace('type="PolyData"', 'type="ImageData"'), "not a VTK file of the type PolyData"),
    "version 7.vtp": (vtp().replace('version="1.0" byte', 'version="7.0" byte'), "unknown version '7.0'"),
    "byte order.vtp": (vtp().replace("LittleEndian", "Middle"), "unknown byte order"),
    "header type.vtp": (vtp(attributes='header_type="UInt8"'), "header type 'UInt8'"),
    "compressor.vtp": (vtp(attributes='compressor="zip"'), "compressed with 'zip'"),
    "no piece.vtp": ('<VTKFile type="PolyData"><PolyData/></VTKFile>', "no piece"),
    "no points.vtp": (vtp().replace("Points>", "Dots>"), "a piece has no points"),
    "no offsets.vtp": (vtp().replace('"offsets"', '"o"'), "no offsets or no connectivity"),
    "2^59 points.vtp": (vtp(n=2**59), "9 numbers instead of 1729382256910270464"),
    "points of a word.vtp": (vtp(n="x"), "'x' is written where the number NumberOfPoints"),
    "2^59 polygons.vtp": (vtp(f=2**59), "1 number instead of"),
    "no polygons.vtp": (vtp(f=0), "no faces"),
    "offsets too large.vtp": (vtp(ends=str(2**50)), "3 numbers instead of 1125899906842624"),
    "offsets negative.vtp": (vtp(ends="-3"), "offsets of the Polys are not valid"),
    "offsets decrease.vtp": (vtp(f=3, ends="3 -3 3"), "do not fit 3 corners"),
    "index too large.vtp": (vtp(corners="0 1 3"), "uses vertex 3"),
    "nan.vtp": (vtp("nan 0 0 1 0 0 0 1 0"), "not a finite number"),
    "word.vtp": (vtp("zero 0 0 1 0 0 0 1 0"), "'zero' is written among numbers"),
    "type.vtp": (vtp(point_type="Float128"), "unknown type 'Float128'"),
    "format.vtp": (vtp(form="hex"), "unknown format 'hex'"),
    "2^20 columns.vtp": (vtp(data=f'<DataArray type="Int8" Name="a" NumberOfComponents="{2**20}">1</DataArray>'), "1048576 columns"),
    "data for two points.vtp": (vtp(data='<DataArray type="Int8" Name="a">1 2</DataArray>'), "'a' has 2 numbers instead of 3"),
    "not base64.vtp": (vtp("@@@@", form="binary"), "an array ends early"),
    "base64 cut.vtp": (vtp(packed(36, content=CORNERS)[:-8], form="binary"), "an array ends early"),
    "size wrong.vtp": (vtp(base64.b64encode(struct.pack("<I", 35) + CORNERS).decode(), form="binary"), "does not have 9 numbers"),
    "2^31 bytes.vtp": (vtp(packed(2**31), form="binary", n=2**31 // 12), "more than the file contains"),
    "nothing appended.vtp": (vtp("", form="appended"), "an array ends early"),
    "offset beyond the end.vtp": (vtp("", form="appended", more=f'offset="{2**50}"'), "an array ends early"),
    "no blocks.vtp": (vtp(packed(0, 0, 0), form="binary", attributes=ZLIB), "does not have 9 numbers"),
    "2^31 blocks.vtp": (vtp(packed(2**31, 0, 0), form="binary", attributes=ZLIB), "does not have 9 numbers"),
    "36 blocks of one byte.vtp": (vtp(packed(36, 1, 0), form="binary", attributes=ZLIB), "an array ends early"),
    "bomb.vtp": (vtp(packed(1, 36, 0, len(BOMB), content=BOMB), form="binary", attributes=ZLIB), "not a finite|no triangle has an area"),
    "block cut.vtp": (vtp(packed(1, 36, 0, 5, content=zlib.compress(CORNERS)[:5]), form="binary", attributes=ZLIB), "cannot be unpacked"),
    "block of junk.vtp": (vtp(packed(1, 36, 0, 6, content=b"junk!!"), form="binary", attributes=ZLIB), "cannot be unpacked"),
    "lzma of junk.vtp": (vtp(packed(1, 36, 0, 6, content=b"junk!!"), form="binary", attributes='compressor="vtkLZMADataCompressor"'), "cannot be unpacked"),
    "lz4 of junk.vtp": (vtp(packed(1, 36, 0, 6, content=b"junk!!"), form="binary", attributes='compressor="vtkLZ4DataCompressor"'), "cannot be unpacked"),
    "empty.npz": (b"", "is empty"),
    "junk.npz": (b"PK\3\4" + bytes(100), "not a .npz file"),
    "cut.npz": (npz(**NPZ)[:-30], "not a .npz file"),
    "no faces.npz": (npz(vertices=V), "no array called faces"),
    "spectrum.npz": (npz(eigenvalues=V), "no array called vertices"),
    "plane.npz": (npz(vertices=V[:, :2], faces=F), "shape (3, 2)"),
    "words.npz": (npz(vertices=V.astype(str), faces=F), "save numbers with three columns"),
    "objects.npz": (npz(vertices=np.array([[None] * 3]), faces=F), "not a .npz file"),
    "nan.npz": (npz(vertices=V * np.nan, faces=F), "not a finite number"),
    "index.npz": (npz(vertices=V, faces=F + 1), "uses vertex 3"),
    "2^59 rows.npz": (npz_with_header((2**59, 3)), "not a .npz file"),
    "10^30 rows.npz": (npz_with_header((10**30, 3)), "not a .npz file"),
    "wide words.npz": (npz_with_header((1, 3), f"<U{2**28}"), "not a .npz file"),
    "negative rows.npz": (npz_with_header((-1, -3)), "not a .npz file"),
    "bomb.npz": (npz_with_header((10**6, 3)), "not a .npz file"),
    "half a skin.npz": (npz(**NPZ, skin_joints=np.array(["a"])), "half of a texture, of a skin or of a skeleton"),
    "half a skeleton.npz": (npz(**NPZ, skin_joints=np.array(["a"]), skin_weights=np.ones((3, 1)), skin_parents=np.array([-1])), "or of a skeleton"),
    "short data.npz": (npz(**NPZ, **{"vertex_data/a": np.ones(2)}), "'a' have 2 rows, but need 3"),
    "single number.npz": (npz(**NPZ, **{"face_data/a": np.array(1.0)}), "shape ()"),
    "short shape.npz": (npz(**NPZ, **{"blend_shapes/a": np.ones((2, 3))}), "the blend shape 'a'"),
    "short skin.npz": (npz(**NPZ, skin_joints=np.array(["a"]), skin_weights=np.ones((2, 1))), "the skin"),
    "labels.npz": (npz(**NPZ, **{"face_data/a": np.array([1]), "label_names/a": np.array(["x"])}), "the array of labels 'a'"),
    "texture without faces.obj": (OBJ, "no faces"),
    "texture.mat": (mat(texture=3.0), None),
    "short data.mat": (mat(vertex_data={"a": np.ones((2, 1))}), "'a' have 2 rows, but need 3"),
    "words as data.mat": (mat(vertex_data={"a": "xyz"}), "the vertex data 'a'"),
    "skin without weights.mat": (mat(skin={"joints": "a"}), "the skin"),
    "half a skeleton.mat": (mat(skin={"joints": "a", "weights": np.ones((3, 1))}, skeleton={"parents": 0.0}), "the skeleton has no arrays"),
    "broken parents.mat": (mat(skin={"joints": "a", "weights": np.ones((3, 1))}, skeleton={"parents": 0.5, "bind_matrices": np.eye(4)}), "the parents of the joints are not"),
    "labels.mat": (mat(label_names={"a": "x"}), "the array of labels 'a'"),
}  # fmt: skip

# Matching does not need a texture: name: (content, what the note about the texture must name).
WITHOUT_TEXTURE = {
    "half a texture.npz": (npz(**NPZ, texture_corners=F), "half of a texture"),
    "texture of other faces.npz": (npz(**NPZ, texture_coordinates=V[:, :2], texture_corners=F.T), "texture's corners have the shape (3, 1)"),
    "texture out of range.npz": (npz(**NPZ, texture_coordinates=V[:, :2], texture_corners=F + 1), "outside the 3 texture vertices"),
    "texture of a number.npz": (npz(**NPZ, texture_coordinates=np.array(1.0), texture_corners=F), "the texture is float64"),
    "texture without corners.mat": (mat(texture={"coordinates": V[:, :2]}), "no arrays of real numbers"),
    "texture too short.mat": (mat(texture={"coordinates": V[:, :2], "corners": F + 1.0}), "one texture vertex for each corner"),
    "texture out of range.mat": (mat(texture={"coordinates": V[:, :2], "corners": np.full((2, 3), 4.0)}), "one texture vertex for each corner"),
    "texture of nan.mat": (mat(texture={"coordinates": V[:, :2], "corners": np.full((2, 3), np.nan)}), "no arrays of real numbers"),
    "texture of nan.vtk": (VTK + "POINT_DATA 3\nTEXTURE_COORDINATES t 2 float\nnan 0 0 0 0 0\n", "a number that is not finite"),
    "texture without vt.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 3/3\n", "uses texture vertex 1, but the file has 0 vt lines"),
    "texture out of range.obj": (OBJ + "f 1/1 2/2 3/3\n", "uses texture vertex 3, but the file has 2 vt lines"),
    "texture zero.obj": (OBJ + "f 1/1 2/2 3/0\n", "uses texture vertex 0"),
    "texture too negative.obj": (OBJ + "f 1/1 2/2 3/-3\n", "uses texture vertex -3"),
    "texture of a word.obj": (OBJ + "f 1/1 2/2 3/c\n", "'c' is written where a texture vertex"),
    "texture of 2^60.obj": (OBJ + f"f 1/1 2/2 3/{2**59}\n", "is written where a texture vertex"),
    "word in vt.obj": (OBJ + "vt x y\nf 1/1 2/2 3/3\n", "'x y' is written where 2 numbers"),
    "nan in vt.obj": (OBJ + "vt nan 0\nf 1/1 2/2 3/3\n", "a number that is not finite"),
    "texture too short.ply": (PLY + PLY_FACE + "property list uchar float texcoord\n" + PLY_BODY + "3 0 1 2 4 0 0 1 1\n", "two texture coordinates for each corner"),
}  # fmt: skip


@pytest.mark.parametrize("name", WITHOUT_TEXTURE)
def test_textures_that_cannot_be_read_are_left_out(tmp_path, name):
    content, fault = WITHOUT_TEXTURE[name]
    data = read_mesh_data(write(tmp_path / name, content))
    assert data.mesh.faces.tolist() == [[0, 1, 2]] and data.texture is None
    (note,) = (note for note in data.mesh.notes if "texture" in note)
    assert fault in note and note.endswith(".")


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> Path:
    return write_pair(tmp_path_factory.mktemp("pair"))


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_one_sentence(tmp_path, name):
    content, fault = HOSTILE[name]
    path = write(tmp_path / name, content)
    if fault is None:  # unusual but valid
        read_mesh_data(path)
        return
    message = refusal(read_mesh_data, path, most_memory=4e6 + 300 * path.stat().st_size)
    assert any(one in message for one in fault.split("|"))


@pytest.mark.parametrize("suffix", [".vtk", ".vtp", ".npz", ".mat", ".ply"])
def test_files_that_end_anywhere_are_refused(tmp_path, suffix):
    write_mesh_data(tmp_path / f"m{suffix}", sample())
    content = (tmp_path / f"m{suffix}").read_bytes()
    path = tmp_path / f"cut{suffix}"
    for length in range(0, len(content) - 2, max(len(content) // 60, 1)):
        path.write_bytes(content[:length])
        if (
            suffix == ".vtk"
            and length > content.index(b"POINT_DATA") - 2
            and b"\n" in content[length - 1 : length + 1]
        ):
            continue  # a file may end after any section
        with pytest.raises(InputError, match=f"cut{suffix}: "):
            read_mesh_data(path)


@pytest.mark.parametrize(
    "name", ["polygon of a billion.vtk", "bomb.vtp", "2^59 rows.npz", "lines.vtk", "m.glb"]
)
def test_the_command_line_refuses_with_code_2(run, pair, tmp_path, name):
    path = write(tmp_path / name, HOSTILE.get(name, (b"glTF" + bytes(40), ""))[0])
    outcome = run("match", path, pair / "y.ply", "--output", tmp_path / "map.txt", "--quiet")
    assert_refused(outcome, naming=name)
    assert sorted(tmp_path.iterdir()) == [path]


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("sound")
    contents = {}
    for suffix in (".vtk", ".vtp", ".npz", ".obj", ".ply", ".off"):
        write_mesh_data(folder / f"m{suffix}", sample())
        contents[suffix] = (folder / f"m{suffix}").read_bytes()
    contents["text.vtk"] = (
        VTK
        + "POINT_DATA 3\nSCALARS a int 1\nLOOKUP_TABLE default\n1 2 3\nFIELD f 1\nb 2 3 float\n1 2 3 4 5 6\n"
    ).encode()
    contents["new.vtk"] = (
        NEW + POINTS + "POLYGONS 2 3\nOFFSETS vtktypeint64\n0 3\nCONNECTIVITY vtktypeint64\n0 1 2\n"
    ).encode()
    contents["text.vtp"] = vtp(data='<DataArray type="Int8" Name="a">1 2 3</DataArray>').encode()
    return contents  # fmt: skip


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_damaged_files_are_read_or_refused(tmp_path_factory, sound, data):
    name = data.draw(st.sampled_from(sorted(sound)))
    content = sound[name]
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(content)))
        stop = data.draw(st.integers(start, min(start + 8, len(content))))
        new = data.draw(
            st.one_of(
                st.binary(max_size=6),
                st.sampled_from([b"\n", b" ", b"-", b"nan", b"99999999999", b"METADATA\n"]),
            )
        )
        content = content[:start] + new + content[stop:]
    path = tmp_path_factory.getbasetemp() / f"damaged{Path(name).suffix or name}"
    path.write_bytes(content)
    message = None
    try:
        mesh = read_mesh_data(path).mesh
    except InputError as error:
        message = str(error)
    if message is None:
        assert np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)
    else:
        assert message.startswith(f"{path}: ") and "\n" not in message
