"""Readers and writers of meshes, alone or together with their data, and the table of all formats.

Vertices must keep their order, and a damaged file must cause one clear error message. Therefore this library
has its own parsers, one per module of `jaxsmw.io.formats`. The reader of libigl accepts indices out of range
and aborts the process on some invalid headers. The reader of trimesh splits and drops vertices of OBJ files,
and cannot read binary PLY files of different polygons. pygltflib parses only the JSON part of glTF files, and
has no checks.

The other libraries were tried on the files of `tests/corpus`, with one to three damages of
`tests/test_fuzzing.py` each. On 1000 damaged VTK legacy files, the reader of VTK 9.7.2 ended the process with
a segmentation fault 15 times, and returned cells with indices or offsets out of range 162 times. On 1000
damaged VTK XML files, it aborted the process twice, hung once, and returned such cells 11 times. cvista-io
has the same readers. On 1000 damaged PCD files, pypcd4 1.5.1 hung twice, and silently returned too few points
25 times. It needs python-lzf, which has no wheels. On 2000 damaged MATLAB files of version 7.3, pymatreader
and h5py only raised exceptions, so these read such files.
"""

from __future__ import annotations

import codecs
import os
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8
from numpy.typing import ArrayLike

from jaxsmw.errors import InputError, naming
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.geometry.point_cloud import triangulate_points
from jaxsmw.io.formats.polygons import Polygons, texture_or_note, triangles_of
from jaxsmw.io.mesh_data import COLORS, NORMALS, MeshData, Texture, checked_texture
from jaxsmw.runtime.files import atomic_write, read_bytes
from jaxsmw.wording import count_of

# The usual suffixes of FreeSurfer's surfaces. Surfaces with other suffixes are known by their first bytes.
_FREESURFER = (".pial", ".white", ".inflated", ".sphere", ".smoothwm", ".midthickness")
# The functions that read and write files with a suffix, as "module:function". A module of `jaxsmw.io.formats`
# is loaded when such a file is opened.
_PARSERS = {
    **{".off": "off:parse_off", ".obj": "obj:parse_obj", ".ply": "ply:parse_ply", ".stl": "stl:parse_stl"},
    **{".mat": "mat:parse_mat", ".vtk": "vtk:parse_vtk", ".vtp": "vtp:parse_vtp", ".npz": "npz:parse_npz"},
    **{".gltf": "gltf:parse_gltf", ".glb": "gltf:parse_glb", ".3mf": "threemf:parse_3mf"},
    **{".dae": "dae:parse_dae"},
    **{".xyz": "points:parse_xyz", ".pcd": "pcd:parse_pcd", ".npy": "points:parse_npy"},
    **{".gii": "brain:parse_gifti"} | dict.fromkeys(_FREESURFER, "brain:parse_surface"),
}
_FORMATTERS = {
    **{".off": "off:format_off", ".obj": "obj:format_obj", ".ply": "ply:format_ply"},
    **{".stl": "stl:format_stl", ".mat": "mat:format_mat", ".vtk": "vtk:format_vtk"},
    **{".vtp": "vtp:format_vtp", ".npz": "npz:format_npz"},
    **{".gltf": "gltf_writing:format_gltf", ".glb": "gltf_writing:format_glb"},
    **{".gii": "brain:format_gifti"} | dict.fromkeys(_FREESURFER, "brain:format_surface"),
}
# The first bytes of FreeSurfer's surfaces, and what messages list as the formats that can be read.
_SURFACE = b"\xff\xff\xfe"
_KNOWN = (*(suffix for suffix in _PARSERS if suffix not in _FREESURFER), "FreeSurfer's lh.pial")
# What converts files that this library does not read, by their suffixes.
_CONVERTERS = {
    **dict.fromkeys((".step", ".stp", ".iges", ".igs", ".brep", ".fcstd"), "FreeCAD"),
    **dict.fromkeys((".nii", ".mgz", ".nrrd", ".mha", ".dcm", ".tif"), "3D Slicer, which segments volumes,"),
    **dict.fromkeys((".gz", ".bz2", ".zip"), "a program that unpacks it"),
    **dict.fromkeys((".las", ".laz", ".e57", ".pts"), "CloudCompare"),
    **dict.fromkeys((".vtu", ".vtm", ".vts", ".vti", ".msh", ".inp", ".mesh", ".med"), "ParaView or meshio"),
    **dict.fromkeys((".ctm", ".wrl", ".x3d", ".asc", ".qobj", ".smf"), "MeshLab"),
}


def _converter(suffix: str) -> str:
    return _CONVERTERS.get(suffix, "Blender or MeshLab")


# The formats whose files begin with text, even if numbers are binary.
_TEXT = (".off", ".obj", ".ply", ".vtk", ".pcd")
POINT_CLOUD_SUFFIXES = (".xyz", ".pcd", ".npy")
"""The suffixes of files that contain only points."""
MESH_SUFFIXES = tuple(suffix for suffix in _PARSERS if suffix not in (*POINT_CLOUD_SUFFIXES, ".npz"))
"""The suffixes of files that are certainly meshes. Many `.npz` files contain something else."""


def _loaded(function: str) -> Callable[..., Any]:
    module, name = function.split(":")
    return getattr(import_module(f"jaxsmw.io.formats.{module}"), name)


def read_mesh(path: str | os.PathLike[str], *, weld: bool | float = False) -> Mesh:
    """Read a triangle mesh, or a point cloud, from a file in any format of `read_mesh_data`.

    Vertices keep the order of the file. Corners of an STL file at the same position become one vertex, and
    the vertices are numbered in the order in which their positions first appear. Faces with more than three
    corners are split into fans of triangles, and triangle strips into triangles. The points of a point cloud
    become the vertices of a mesh, as in `jaxsmw.geometry.triangulate_points`.

    **Arguments:**

    - `path`: the file. The suffix, in upper or lower case, determines the format: `.off`, `.obj`, `.ply`,
        `.stl`, `.mat`, `.vtk`, `.vtp`, `.gltf`, `.glb`, `.3mf`, `.dae`, `.npz`, `.gii`, `.xyz`, `.pcd` or
        `.npy`. Surfaces of FreeSurfer, such as `lh.pial`, may have any other suffix.
    - `weld`: if True or a tolerance, vertices at the same position are merged, as in `make_mesh`. Faces then
        use only the lowest-numbered of these vertices. The other vertices stay in the mesh without faces, so
        no vertex is renumbered. The vertices of STL and glTF files are always welded.

    **Returns:** A `Mesh` whose `name` is the path, with positions (n, 3) in the unit of the file and 0-based
    faces (f, 3). The `notes` of the mesh report changes such as dropped faces, and peculiarities such as
    unreferenced vertices. They also report flaws that do not concern the surface, such as a damaged texture.

    **Raises:** `InputError` if the file cannot be read, does not have the format of its suffix, ends early,
    contains lines but no faces, or continues after the declared end. `InputError` is also raised if
    `make_mesh` refuses the mesh, for example because an index is out of range, the position of a corner is
    not finite, or all faces are degenerate.
    """
    return read_mesh_data(path, weld=weld).mesh


def read_mesh_data(path: str | os.PathLike[str], *, weld: bool | float = False) -> MeshData:
    """Read a mesh together with all data on its vertices and faces.

    The data of each format:

    - `.off`: a text file with colours of vertices and faces, normals, and texture coordinates (COFF, NOFF,
      STOFF).
    - `.obj`: the `vt` lines become the texture. The `g`, `o` and `usemtl` lines become the face data `group`,
      `object` and `material`. These arrays (f,) contain 0-based integers, and `label_names` contains the
      names. Colours that follow the positions are read as well.
    - `.ply`: a text file, or a binary file in either byte order, with all properties that have equally many
      numbers in all rows. Properties `a_0`, `a_1`, … become the columns of an array `a`. The texture comes
      from the lists `texcoord` of the faces or vertices, or from the vertex properties `s` and `t`, `u` and
      `v`, or `texture_u` and `texture_v`.
    - `.stl`: a text or binary file, which contains no data.
    - `.mat`: a struct, such as `surface` in the TOSCA data set, with the coordinates X, Y and Z (or a matrix
      VERT) and the 1-based faces TRIV. The struct may be nested in another struct, as in the files of
      `write_spectrum`. It also has the data that `write_mesh_data` writes. Files of MATLAB's format 7.3 need
      the extra `matlab`.
    - `.vtk`: all arrays on points and cells. The file is a VTK legacy file up to version 5.1, text or binary.
      It contains a POLYDATA or an UNSTRUCTURED_GRID of triangles, polygons and triangle strips.
    - `.vtp`: all arrays on points and cells. The file is a VTK XML file in any encoding, and may be
      compressed. Compression with LZ4 needs the extra `vtk`.
    - `.gltf`, `.glb`: glTF 2.0 files. The attribute TEXCOORD_0 is the texture, and COLOR_0 becomes `colors`.
      Further attributes, morph targets and skins are read as well. If the file has several parts, the face
      data `group` contains 0-based integers, and `label_names` contains the names of the parts. Draco
      compression needs the extra `draco`.
    - `.3mf`: all objects of the build, at their places. Vertices of different objects stay different. The
      unit of the file, colours and textures are not read. The face data `group` is as in glTF files.
    - `.dae`: all geometries of the scene of a COLLADA file, at their places, skinned ones in their bind pose.
      Textures are not read. The files need the extra `collada`. The face data `group` is as in glTF files.
    - `.npz`: the arrays that `write_mesh_data` writes, such as `vertices`, `faces` and `vertex_data/NAME`.
    - `.gii`: a GIFTI file with one surface, and all arrays with one row per vertex. Labels are numbered from
      0 in the order of the file's table. Positions are those of the file, without its transform. GIFTI and
      FreeSurfer's files need the extra `brain`.
    - `.pial`, `.white`, `.inflated` and others: a surface of FreeSurfer, which contains no data. The geometry
      of the volume is not read. `jaxsmw.io.read_overlay` reads data on the vertices from their own files.
    - `.xyz`: a text file with one point per line. Columns 4 to 6 become `normals` if they are unit vectors.
      Further columns are ignored.
    - `.pcd`: all fields of a file of the Point Cloud Library, which may be text, binary or compressed. The
      fields `normal_x`, `normal_y` and `normal_z` become `normals`.
    - `.npy`: an array with one row per point. It has the same columns as an `.xyz` file.

    If a file has no faces, `jaxsmw.geometry.triangulate_points` adds faces, with the help of `normals`.

    A glTF file duplicates vertices along texture seams. Duplicates that `write_mesh_data` recorded are
    joined. All other duplicates are vertices, but the faces of `MeshData.mesh` use only one vertex per
    position. The transforms of the nodes are applied, and all meshes of the scene are joined in the order of
    the nodes. Skinned meshes stay in their bind pose. Buffers in other files are read only if these files are
    in the folder of the glTF file or in its subfolders. Normals, tangents, animations and pictures in glTF
    files are not read.

    **Arguments:**

    - `path`, `weld`: as for `read_mesh`. Welding changes `MeshData.mesh`, but not `MeshData.faces`.

    **Returns:** A `MeshData` with n vertices and f triangles, in the units of the file. Each triangle has the
    data of the polygon or strip from which it comes.

    **Raises:** `InputError` if `read_mesh` refuses the file, or if its data is damaged, for example because
    an array has a wrong length. A damaged texture is left out with a note.
    """
    path = Path(path)
    data = read_bytes(path)
    suffix = path.suffix.lower()
    if suffix not in _PARSERS:
        if not data.startswith(_SURFACE):
            raise InputError(
                f"{path}: the suffix {path.suffix!r} does not belong to a known mesh format: convert the "
                f"mesh with {_converter(suffix)} to one of {', '.join(_KNOWN)}."
            )
        suffix = _FREESURFER[0]
    with naming(path):
        polygons = _parse(data, suffix, path.parent)
        if not len(polygons.vertices):
            raise InputError("contains no vertices: export the mesh again.")
        is_strip = np.zeros(len(polygons.sizes), bool) if polygons.strips is None else polygons.strips
        at, polygon = triangles_of(polygons.sizes, is_strip)
        faces = polygons.corners[at]
        notes = [*polygons.notes, *_notes(polygons.sizes[~is_strip], polygons.lines, len(faces))]
        of_corners = polygons.texture
        texture, lost = texture_or_note(
            lambda: of_corners and checked_texture(Texture(of_corners[0], of_corners[1][at]), len(at))
        )
    # `MeshData` refuses arrays that are too short.
    face_data = {
        name: values[polygon] if values.ndim and len(values) > polygon.max(initial=-1) else values
        for name, values in polygons.face_data.items()
    }
    if polygons.weld and weld is False:
        weld = 0.0
    if len(faces):
        mesh = make_mesh(polygons.vertices, faces, name=str(path), weld=weld, notes=notes)
    else:
        normals = polygons.vertex_data.get(NORMALS)
        mesh = triangulate_points(polygons.vertices, normals, name=str(path), notes=notes)
        faces, face_data, texture, lost = mesh.faces, {}, None, ()
    return MeshData(
        replace(mesh, notes=(*mesh.notes, *lost)),
        faces.astype(np.int64),
        vertex_data=polygons.vertex_data,
        face_data=face_data,
        texture=texture,
        blend_shapes=polygons.blend_shapes,
        skin=polygons.skin,
        label_names=polygons.label_names,
    )


def _parse(data: bytes, suffix: str, folder: Path) -> Polygons:
    if not data:
        raise InputError("is empty: export the mesh again.")
    if suffix in _TEXT and data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError("is UTF-16 text, which cannot be read: save the file as UTF-8.")
    # Damaged files can contain numbers that overflow, or signalling NaN. `make_mesh` refuses them later.
    with np.errstate(all="ignore"):
        parse = _loaded(_PARSERS[suffix])
        return parse(data, folder) if suffix == ".gltf" else parse(data)


def _notes(sizes: Int64[np.ndarray, " f"], lines: int, triangles: int) -> list[str]:
    """Return notes on faces that are no triangles. Refuse a file that contains only lines."""
    notes = []
    edges, large = int((sizes == 2).sum()), int((sizes > 3).sum())
    if (edges or lines) and not triangles:
        raise InputError(
            f"contains {count_of(edges + lines, 'line')} (edges or faces with 2 corners), but no triangles, "
            "so it describes no surface: export the mesh with its faces."
        )
    if edges:
        notes.append(f"{count_of(edges, 'face')} with 2 corners ignored: lines are not part of a surface.")
    if large:
        notes.append(f"{count_of(large, 'face')} with more than three corners split into triangles.")
    return notes


def check_mesh_suffix(path: str | os.PathLike[str]) -> None:
    """Refuse a file name whose suffix belongs to no format in which meshes can be written."""
    if Path(path).suffix.lower() not in _FORMATTERS:
        raise InputError(
            f"{path}: meshes cannot be written as {Path(path).suffix!r}: choose a name that ends in "
            f"{', '.join(_FORMATTERS)}."
        )


def check_attribute_suffix(path: str | os.PathLike[str]) -> None:
    """Refuse a file name whose suffix belongs to no format in which attributes can be written."""
    check_mesh_suffix(path)
    if Path(path).suffix.lower() == ".stl":
        raise InputError(
            f"{path}: STL files contain only triangles, so no attribute can be written: choose a name that "
            "ends in .ply, .vtp or .glb."
        )


def write_mesh(
    path: str | os.PathLike[str], mesh: Mesh, *, colors: ArrayLike | None = None
) -> tuple[str, ...]:
    """Write a mesh, and perhaps colours, as `write_mesh_data` does.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix, such as `.off` or `.ply`, determines the format.
    - `mesh`: the mesh with n vertices, a `Mesh`.
    - `colors`: the red, green and blue components of the colour of each vertex (n, 3), as floats from 0 to 1
        or as uint8. None, the default, writes no colours. An OFF file with colours begins with COFF.

    **Returns:** A tuple of sentences about what the format cannot hold, such as colours in an STL file.

    **Raises:** `InputError` if `write_mesh_data` raises it, or `colors` has a wrong shape, type or range.
    """
    data = {} if colors is None else {COLORS: _bytes_of_colors(colors, len(mesh.vertices))}
    return write_mesh_data(path, MeshData(mesh, mesh.faces, vertex_data=data))


def _bytes_of_colors(colors: ArrayLike, n: int) -> UInt8[np.ndarray, "n 3"]:
    array = np.asarray(colors)
    if array.shape != (n, 3):
        raise InputError(
            f"colors have shape {array.shape}, but {n} vertices need ({n}, 3): give one row for each vertex."
        )
    if array.dtype == np.uint8:
        return array
    if array.dtype.kind != "f" or not ((array >= 0) & (array <= 1)).all():
        raise InputError(
            "colors are neither uint8 nor floats from 0 to 1: convert the colors to one of these types."
        )
    return np.rint(255 * array.astype(np.float64)).astype(np.uint8)


def write_mesh_data(path: str | os.PathLike[str], data: MeshData) -> tuple[str, ...]:
    """Write a mesh together with all data on its vertices and faces.

    `read_mesh_data` lists the formats, and reads the same data from the file, in the precision of the format:
    float32 in STL, glTF, GIFTI and FreeSurfer's files, and float64 in the other formats. Colours in OBJ
    files become floats. Vertices keep their order in all formats except STL. glTF files need one texture
    vertex per vertex, so vertices are duplicated along texture seams. The file records the duplicates, and
    `read_mesh_data` joins them again. The write is atomic: an incomplete file never appears at `path`.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix determines the format: `.off`, `.obj`, `.ply`,
        `.stl`, `.mat`, `.vtk`, `.vtp`, `.gltf`, `.glb`, `.npz`, `.gii`, or one of FreeSurfer's suffixes
        `.pial`, `.white`, `.inflated`, `.sphere`, `.smoothwm` and `.midthickness`.
    - `data`: a `MeshData`. The file contains all triangles of `data.faces`, including triangles that cleaning
        dropped from `data.mesh`.

    **Returns:** A tuple of sentences about the data that the format cannot hold, which is empty for `.npz`.

    **Raises:** `InputError` for another suffix, positions that the format cannot hold, or a file that cannot
    be written.
    """
    path = Path(path)
    check_mesh_suffix(path)
    with naming(path):
        content, notes = _loaded(_FORMATTERS[path.suffix.lower()])(data)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return notes
