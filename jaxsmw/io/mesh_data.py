"""Readers and writers of meshes together with their data, and the table of all formats of mesh files.

Vertices must keep their order, and a damaged file must cause one clear error message. Therefore this library
has its own parsers, one per module of `jaxsmw.io.formats`. The reader of libigl accepts indices out of range
and aborts the process on some invalid headers. The reader of trimesh splits and drops vertices of OBJ files.
It also cannot read binary PLY files whose polygons have different numbers of corners. pygltflib parses only
the JSON part of glTF files, and has no checks.

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
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.point_cloud import triangulate_points
from jaxsmw.io.formats.data import (
    NORMALS,
    Corners,
    MeshData,
    Polygons,
    Skin,
    Texture,
    Written,
    checked_texture,
    texture_or_note,
    triangles_of,
)
from jaxsmw.io.formats.gltf import parse_glb, parse_gltf
from jaxsmw.io.formats.gltf_writing import format_glb, format_gltf
from jaxsmw.io.formats.mat import format_mat, parse_mat
from jaxsmw.io.formats.npz import format_npz, parse_npz
from jaxsmw.io.formats.obj import format_obj, parse_obj
from jaxsmw.io.formats.off import format_off, parse_off
from jaxsmw.io.formats.pcd import parse_pcd
from jaxsmw.io.formats.ply import format_ply, parse_ply
from jaxsmw.io.formats.stl import format_stl, parse_stl
from jaxsmw.io.formats.vtk import format_vtk, parse_vtk
from jaxsmw.io.formats.vtp import format_vtp, parse_vtp
from jaxsmw.io.formats.xyz import parse_npy, parse_xyz
from jaxsmw.runtime.files import atomic_write, read_bytes
from jaxsmw.wording import count_of

__all__ = ["MESH_SUFFIXES", "MeshData", "Skin", "Texture", "read_mesh_data", "write_mesh_data"]

_PARSERS: dict[str, Callable[[bytes], Polygons]] = {
    ".off": parse_off,
    ".obj": parse_obj,
    ".ply": parse_ply,
    ".stl": parse_stl,
    ".mat": parse_mat,
    ".vtk": parse_vtk,
    ".vtp": parse_vtp,
    ".glb": parse_glb,
    ".npz": parse_npz,
    ".xyz": parse_xyz,
    ".pcd": parse_pcd,
    ".npy": parse_npy,
}
_FORMATTERS: dict[str, Callable[[MeshData], Written]] = {
    ".off": format_off,
    ".obj": format_obj,
    ".ply": format_ply,
    ".stl": format_stl,
    ".mat": format_mat,
    ".vtk": format_vtk,
    ".vtp": format_vtp,
    ".gltf": format_gltf,
    ".glb": format_glb,
    ".npz": format_npz,
}
# The formats whose files begin with text, even if numbers are binary.
_TEXT = (".off", ".obj", ".ply", ".vtk", ".pcd")
MESH_SUFFIXES = tuple(suffix for suffix in _FORMATTERS if suffix != ".npz")
"""The suffixes of files that are certainly meshes. Many `.npz` files contain something else."""
POINT_CLOUD_SUFFIXES = tuple(suffix for suffix in _PARSERS if suffix not in _FORMATTERS)
"""The suffixes of files that contain only points."""


def read_mesh_data(path: str | os.PathLike[str], *, weld: bool = False) -> MeshData:
    """Read a mesh together with all data on its vertices and faces.

    The data of each format:

    - `.off`: colours of vertices and faces, normals, and texture coordinates (COFF, NOFF, STOFF).
    - `.obj`: the `vt` lines become the texture. The `g`, `o` and `usemtl` lines become the face data `group`,
      `object` and `material`. These arrays (f,) contain 0-based integers, and `label_names` contains the
      names. Colours that follow the positions are read as well.
    - `.ply`: all properties with one number per row. Properties `a_0`, `a_1`, … become the columns of an
      array `a`, and so do lists of the same length in all rows. The texture comes from the lists `texcoord`
      of the faces or vertices, or from the vertex properties `s` and `t`, `u` and `v`, or `texture_u` and
      `texture_v`.
    - `.stl`: none.
    - `.mat`: the data that `write_mesh_data` writes into the struct, besides vertices and faces.
    - `.vtk`: all arrays on points and cells. The file is a VTK legacy file up to version 5.1, text or binary.
      It contains a POLYDATA or an UNSTRUCTURED_GRID of triangles, polygons and triangle strips.
    - `.vtp`: all arrays on points and cells. The file is a VTK XML file in any encoding, and may be
      compressed. Compression with LZ4 needs the extra `vtk`.
    - `.gltf`, `.glb`: glTF 2.0 files. The attribute TEXCOORD_0 is the texture, and COLOR_0 becomes `colors`.
      Further attributes, morph targets and skins are read as well. If the file has several parts, the face
      data `group` contains 0-based integers, and `label_names` contains the names of the parts.
    - `.npz`: the arrays that `write_mesh_data` writes, such as `vertices`, `faces` and `vertex_data/NAME`.
    - `.xyz`: a text file with one point per line. Columns 4 to 6 become `normals` if they are unit vectors.
      Further columns are ignored.
    - `.pcd`: all fields of a file of the Point Cloud Library, which may be text, binary or compressed. The
      fields `normal_x`, `normal_y` and `normal_z` become `normals`.
    - `.npy`: an array with one row per point. It has the same columns as an `.xyz` file.

    If a file has no faces, `jaxsmw.geometry.triangulate_points` adds faces, with the help of `normals`.

    A glTF file duplicates vertices along texture seams. Duplicates that `write_mesh_data` recorded are
    joined. `MeshData.mesh` keeps all other duplicates as vertices. However, the faces of `MeshData.mesh` use
    only one vertex per position, as if `weld` were True.
    The transforms of the nodes are applied, and all meshes of the scene are joined in the order of the nodes.
    Skinned meshes stay in their bind pose. Buffers in other files are read only if these files are in the
    folder of the glTF file or in its subfolders. Normals, tangents, animations and pictures in glTF files are
    not read.

    **Arguments:**

    - `path`: the file. The suffix, in upper or lower case, determines the format.
    - `weld`: if True, vertices at the same position are merged in `MeshData.mesh`, as `read_mesh`
        explains. `MeshData.faces` are not welded.

    **Returns:**

    A `MeshData` with n vertices and f triangles, in the units of the file. Its attributes are `mesh`, `faces`
    (f, 3), `vertex_data`, `face_data`, `texture`, `blend_shapes`, `skin` and `label_names`. Triangle strips,
    and polygons with more than three corners, are split into triangles. Each triangle has the data of its
    strip or polygon.

    **Raises:**

    `InputError` if `read_mesh` refuses the file, or if its data is damaged, for example because an array has
    a wrong length. A damaged texture is left out with a note.
    """
    path = Path(path)
    data = read_bytes(path)
    suffix = path.suffix.lower()
    if suffix != ".gltf" and suffix not in _PARSERS:
        raise InputError(
            f"{path}: the suffix {path.suffix!r} does not belong to a known mesh format: convert the "
            f"mesh to one of {', '.join([*_FORMATTERS, *POINT_CLOUD_SUFFIXES])}."
        )
    _check_readable(path, data)
    try:
        # Damaged files can contain numbers that overflow, or signalling NaN. `make_mesh` refuses them later.
        with np.errstate(all="ignore"):
            polygons = parse_gltf(data, path.parent) if suffix == ".gltf" else _PARSERS[suffix](data)
        at, polygon = triangles_of(polygons.sizes, polygons.is_strip)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    faces = polygons.corners[at]
    notes = list(polygons.notes)
    sizes = polygons.sizes[~polygons.is_strip]
    edges = int((sizes == 2).sum())
    if (edges or polygons.lines) and not len(faces):
        raise InputError(
            f"{path}: contains {count_of(edges + polygons.lines, 'line')} (edges or faces with 2 corners), "
            "but no triangles, so it describes no surface: export the mesh with its faces."
        )
    if edges:
        notes.append(f"{count_of(edges, 'face')} with 2 corners ignored: lines are not part of a surface.")
    large = int((sizes > 3).sum())
    if large:
        notes.append(f"{count_of(large, 'face')} with more than three corners split into triangles.")
    if len(faces) or not len(polygons.vertices):
        mesh = make_mesh(polygons.vertices, faces, name=str(path), weld=weld or polygons.weld, notes=notes)
    else:
        normals = polygons.vertex_data.get(NORMALS)
        mesh = triangulate_points(polygons.vertices, normals, name=str(path), notes=notes)
        faces = mesh.faces
        polygons = polygons._replace(face_data={}, texture=None)  # data of no faces
    texture, lost = texture_or_note(lambda: _texture(polygons.texture, at))
    return MeshData(
        replace(mesh, notes=(*mesh.notes, *lost)),
        faces.astype(np.int64),
        vertex_data=polygons.vertex_data,
        face_data={name: _repeated(values, polygon) for name, values in polygons.face_data.items()},
        texture=texture,
        blend_shapes=polygons.blend_shapes,
        skin=polygons.skin,
        label_names=polygons.label_names,
    )


def _texture(texture: Corners | None, at: Int64[np.ndarray, "t 3"]) -> Corners | None:
    return None if texture is None else checked_texture((texture[0], texture[1][at]), len(at), InputError)


def _check_readable(path: Path, data: bytes) -> None:
    if not data:
        raise InputError(f"{path}: is empty: export the mesh again.")
    if path.suffix.lower() in _TEXT and data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"{path}: is UTF-16 text, which cannot be read: save the file as UTF-8.")


def _repeated(values: np.ndarray, polygon: Int64[np.ndarray, " t"]) -> np.ndarray:
    """Return the data of the triangles: each row is a copy of the row of the triangle's polygon.

    Arrays that are too short are returned unchanged, because `MeshData` refuses them.
    """
    if values.ndim == 0 or len(values) <= polygon.max(initial=-1):
        return values
    return values[polygon]


def check_mesh_suffix(path: str | os.PathLike[str]) -> None:
    """Check that a file's suffix belongs to a format in which meshes can be written.

    **Raises:** `InputError` if the suffix belongs to no format.
    """
    if Path(path).suffix.lower() not in _FORMATTERS:
        raise InputError(
            f"{path}: meshes cannot be written as {Path(path).suffix!r}: choose a name that ends in "
            f"{', '.join(_FORMATTERS)}."
        )


def check_attribute_suffix(path: str | os.PathLike[str]) -> None:
    """Check that a file's suffix belongs to a format in which meshes can be written with attributes.

    **Raises:** `InputError` if the suffix belongs to no format, or to a format that holds only triangles.
    """
    check_mesh_suffix(path)
    if Path(path).suffix.lower() == ".stl":
        raise InputError(
            f"{path}: STL files contain only triangles, so no attribute can be written: choose a name that "
            "ends in .ply, .vtp or .glb."
        )


def write_mesh_data(path: str | os.PathLike[str], data: MeshData) -> tuple[str, ...]:
    """Write a mesh together with all data on its vertices and faces.

    The docstring of `read_mesh_data` lists the formats. `read_mesh_data` reads the same data from the file,
    in the precision of the format: float32 in STL and glTF files, and float64 in the other formats. Colours
    in OBJ files become floats.

    Vertices keep their order in all formats except STL. glTF files need one texture vertex per vertex, so
    vertices are duplicated along texture seams. The file records the duplicates, and `read_mesh_data` joins
    them again.

    The write is atomic: an incomplete file never appears at `path`.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix determines the format: `.off`, `.obj`, `.ply`,
        `.stl`, `.mat`, `.vtk`, `.vtp`, `.gltf`, `.glb` or `.npz`.
    - `data`: a `MeshData`. The file contains all triangles of `data.faces`, including triangles that cleaning
        dropped from `data.mesh`.

    **Returns:** A tuple of sentences about the data that the format cannot hold. The tuple is empty if the
    file contains everything. Only a `.npz` file can contain all data of any `MeshData`.

    **Raises:** `InputError` for another suffix, positions that the format cannot hold, or a file that cannot
    be written.
    """
    path = Path(path)
    check_mesh_suffix(path)
    try:
        written = _FORMATTERS[path.suffix.lower()](data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    with atomic_write(path) as temporary:
        temporary.write_bytes(written.content)
    return written.notes
