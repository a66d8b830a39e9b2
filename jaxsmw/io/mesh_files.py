"""The functions `read_mesh` and `write_mesh`. `jaxsmw.io.mesh_data` lists the formats."""

from __future__ import annotations

import os

import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.mesh_data import MESH_SUFFIXES, MeshData, read_mesh_data, write_mesh_data

__all__ = ["MESH_SUFFIXES", "read_mesh", "write_mesh"]


def read_mesh(path: str | os.PathLike[str], *, weld: bool = False) -> Mesh:
    """Read a triangle mesh from an OFF, OBJ, PLY, STL, MAT, VTK, VTP, glTF or NPZ file, or a point cloud.

    Vertices keep the order of the file. An STL file contains only the corners of triangles, so corners at
    the same position become one vertex. The vertices of an STL file are numbered in the order in which their
    positions first appear. Faces with more than three corners are split into fans of triangles, and triangle
    strips into triangles. `read_mesh_data` also returns colours, texture coordinates and other data.

    **Arguments:**

    - `path`: the file. The suffix, in upper or lower case, determines the format:
        - `.off`: a text file, optionally with colours or normals (COFF, NOFF).
        - `.obj`: a text file.
        - `.ply`: a text file, or a binary file in either byte order.
        - `.stl`: a text file or a binary file.
        - `.mat`: a file with a struct, such as `surface` in the TOSCA data set. The struct has the
          coordinates X, Y and Z (or a matrix VERT) and the 1-based faces TRIV. The struct may be nested in
          another struct, as in the files of `write_spectrum`.
        - `.vtk`, `.vtp`: a VTK file of polygons, text or binary.
        - `.gltf`, `.glb`: a glTF 2.0 file. Such a file duplicates vertices along texture seams, so vertices
          at exactly the same position are always welded.
        - `.npz`: a file with the arrays `vertices` and `faces`.
        - `.xyz`, `.pcd`, `.npy`: a point cloud. Files in the other formats are also point clouds if they
          contain no faces. `jaxsmw.geometry.triangulate_points` makes a mesh whose vertices are the points.
    - `weld`: if True, vertices at the same position are merged, as in `make_mesh`. Faces then use only the
        lowest-numbered of these vertices. The other vertices stay in the mesh without faces, so no vertex is
        renumbered. Welding has no effect on an STL file, whose corners are always merged.

    **Returns:**

    A `Mesh` whose `name` is the path, with positions (n, 3) in the unit of the file and 0-based faces (f, 3).
    The `notes` of the mesh report changes such as dropped faces, and peculiarities such as unreferenced
    vertices. Flaws that do not concern the surface are also noted there: faces with two corners, a damaged
    texture, bytes behind the triangles of a binary STL file, or a text STL file without `endsolid`.

    **Raises:**

    `InputError` if the file cannot be read, does not have the format of its suffix, ends early, contains
    lines but no faces, or continues after the declared end. `InputError` is also raised if `make_mesh`
    refuses the mesh, for example because an index is out of range, the position of a corner is not finite, or
    all faces are degenerate.
    """
    return read_mesh_data(path, weld=weld).mesh


def write_mesh(
    path: str | os.PathLike[str], mesh: Mesh, *, colors: ArrayLike | None = None
) -> tuple[str, ...]:
    """Write a mesh to a file in one of the formats of `write_mesh_data`.

    OFF files are text, and PLY files are binary and little endian. `read_mesh` restores the faces and
    the exact vertex positions. glTF and STL files are exceptions, because their positions are float32. The
    write is atomic: an incomplete file never appears at `path`.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix, such as `.off` or `.ply`, determines the format.
    - `mesh`: the mesh with n vertices, a `Mesh`.
    - `colors`: the red, green and blue components of the colour of each vertex (n, 3), as floats from 0 to 1
        or as uint8. None, the default, writes no colours. An OFF file with colours begins with COFF.

    **Returns:** A tuple of sentences about what the format cannot hold, such as colours in an STL file. The
    tuple is empty if the file contains everything.

    **Raises:**

    `InputError` if the suffix is unknown, the file cannot be written, or `colors` has a wrong shape, type or
    range.
    """
    data = {} if colors is None else {"colors": _bytes_of_colors(colors, len(mesh.vertices))}
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
