"""Blend shapes as a folder of OBJ files, each with the whole mesh in one shape."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import unique_names
from jaxsmw.io.mesh_data import MeshData
from jaxsmw.io.meshes import read_mesh_data, write_mesh
from jaxsmw.runtime.files import make_directory
from jaxsmw.wording import count_of


def read_blend_shapes(folder: str | os.PathLike[str], data: MeshData) -> MeshData:
    """Add the blend shapes of a folder to the data of a mesh, and replace those of the same name.

    **Arguments:**

    - `folder`: a folder of OBJ files with the vertices and faces of the mesh, in the same order. The name of
      a file without its suffix is the name of the blend shape. A file with the positions of the mesh itself
      is no blend shape.
    - `data`: the `MeshData` of the mesh without any expression.

    **Raises:** `InputError` if the folder has no blend shapes, or a file has other vertices or faces.
    """
    try:
        files = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() == ".obj")
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be read as a folder ({error.strerror}): give a folder of OBJ files."
        ) from None
    shapes = {}
    for file in files:
        shape = read_mesh_data(file)
        if len(shape.mesh.vertices) != len(data.mesh.vertices) or not np.array_equal(shape.faces, data.faces):
            raise InputError(
                f"{file}: has {count_of(len(shape.mesh.vertices), 'vertex')} and "
                f"{count_of(len(shape.faces), 'face')} that are not those of {data.mesh.name}: export all "
                "shapes with the vertices in one order."
            )
        moves = shape.mesh.vertices - data.mesh.vertices
        if moves.any():
            shapes[file.stem] = moves
    if not shapes:
        raise InputError(
            f"{folder}: contains no OBJ file with another shape than {data.mesh.name}: export each blend "
            "shape as an OBJ file."
        )
    return replace(data, blend_shapes={**data.blend_shapes, **shapes})


def write_blend_shapes(folder: str | os.PathLike[str], data: MeshData) -> list[Path]:
    """Write an OBJ file with the whole mesh for each blend shape.

    In names of files, underscores replace characters that some systems do not allow.

    **Arguments:**

    - `folder`: the folder, which is created if it does not exist. Files with the names of blend shapes are
      replaced.
    - `data`: a `MeshData` with blend shapes.

    **Returns:** The paths of the files, in the order of the blend shapes.

    **Raises:** `InputError` if there are no blend shapes, or a file cannot be written.
    """
    if not data.blend_shapes:
        raise InputError(f"{data.mesh.name}: has no blend shapes: give a mesh that has some.")
    directory = make_directory(folder)
    names = unique_names(re.sub(r"[^\w .()-]", "_", name).strip(" .") or "_" for name in data.blend_shapes)
    paths = [directory / f"{name}.obj" for name in names]
    for path, moves in zip(paths, data.blend_shapes.values(), strict=True):
        mesh = replace(data.mesh, vertices=data.mesh.vertices + moves, faces=data.faces)
        write_mesh(path, mesh)
    return paths
