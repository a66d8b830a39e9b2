"""The tetrahedral mesh `Volume`, and its reader and writer by meshio, whose readers are in Python."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.errors import InputError, check_suffix
from jaxsmw.geometry.surface_points import check_indices
from jaxsmw.runtime.files import atomic_write, size_of_file

# The formats by suffix, as meshio names them. All of them keep the order of vertices and cells.
_FORMATS = {".vtu": "vtu", ".vtk": "vtk", ".msh": "gmsh", ".mesh": "medit", ".inp": "abaqus"}
_TETS = "tetra"
_KEPT = "vertex", "line", "triangle"
# A tetrahedron is flat if its volume is at most this fraction of the cube of its longest edge.
_FLAT = 1e-12


@dataclass(frozen=True, eq=False)
class Volume:
    """A tetrahedral mesh, such as a finite-element model of a bone.

    **Attributes:**

    - `vertices`: positions (n, 3), in the unit of the mesh whose surface surrounds them.
    - `tets`: 0-based indices of the corners of each tetrahedron (t, 4).
    - `name`: the name in messages, such as the path of the file.
    - `contents`: the `meshio.Mesh` from which the volume was read, with other cells and data; None for a
      volume that was not read from a file.
    """

    vertices: Float64[np.ndarray, "n 3"]
    tets: Int64[np.ndarray, "t 4"]
    name: str = "volume"
    contents: Any = None

    def __repr__(self) -> str:
        return f"Volume({self.name}: {len(self.vertices)} vertices, {len(self.tets)} tetrahedra)"

    def at(self, vertices: Float64[np.ndarray, "n 3"], name: str, *, mirrored: bool) -> Volume:
        """Return the volume at other positions.

        If `mirrored` is True, two corners of each tetrahedron and triangle are swapped, so that the signs of
        all volumes stay the same.
        """
        tets = _turned_over(self.tets) if mirrored else self.tets
        contents = copy(self.contents)
        if contents is not None:
            contents.points = vertices
            contents.cells = [copy(block) for block in contents.cells]
            for block in contents.cells:
                if mirrored and block.type in ("triangle", _TETS):
                    block.data = _turned_over(block.data)
        return Volume(vertices, tets, name, contents)


def signed_volumes(
    vertices: Float64[np.ndarray, "n 3"], tets: Int64[np.ndarray, "t 4"]
) -> Float64[np.ndarray, " t"]:
    """Return the signed volumes of tetrahedra (t,)."""
    return np.linalg.det(vertices[tets[:, 1:]] - vertices[tets[:, :1]]) / 6


def check_volume(volume: Volume) -> None:
    """Check that a volume has tetrahedra, and that all of them have a volume of the same sign.

    **Raises:** `InputError` if there is no tetrahedron, positions are not finite, indices are out of range,
    or some tetrahedra are flat or have the opposite orientation.
    """
    vertices, tets, name = volume.vertices, volume.tets, volume.name
    if not len(tets):
        raise InputError(f"{name}: contains no tetrahedra: give a volume mesh.")
    check_indices(tets.ravel(), len(vertices), f"{name}: vertex")
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{name}: the position of vertex {finite.argmin()} is not finite: export the volume again."
        )
    edges = np.linalg.norm(vertices[tets[:, 1:]] - vertices[tets[:, :1]], axis=2).max(axis=1)
    volumes = signed_volumes(vertices, tets)
    flat = np.abs(volumes) <= _FLAT * edges**3
    if flat.any():
        raise InputError(
            f"{name}: {flat.sum()} of {len(tets)} tetrahedra have no volume, the first of which is number "
            f"{flat.argmax()}: make the volume mesh again."
        )
    negative = int((volumes < 0).sum())
    if 0 < negative < len(tets):
        raise InputError(
            f"{name}: {negative} of {len(tets)} tetrahedra have a negative volume, and all others have a "
            "positive one: give all tetrahedra the same orientation."
        )


def _turned_over(corners: np.ndarray) -> np.ndarray:
    return np.concatenate([corners[:, :-2], corners[:, :-3:-1]], axis=1)


def read_volume(path: str | os.PathLike[str]) -> Volume:
    """Read a tetrahedral mesh. The formats need the extra `volumes`.

    **Arguments:**

    - `path`: a file of VTK (`.vtu`, `.vtk`), Gmsh (`.msh`), Medit (`.mesh`) or Abaqus (`.inp`).

    **Returns:** A `Volume`, which also keeps points, lines, triangles and all data of the file.

    **Raises:** `InputError` if the file cannot be read or is damaged, if it has cells of other kinds or no
    tetrahedra, or if `check_volume` refuses them.
    """
    size_of_file(path)
    meshio = _meshio(path)
    try:
        contents, _ = _quietly(meshio.read, path, file_format=_FORMATS[Path(path).suffix.lower()])
        vertices = np.asarray(contents.points, np.float64)
        cells = [(str(block.type), np.asarray(block.data)) for block in contents.cells]
        tets = [data.astype(np.int64) for kind, data in cells if kind == _TETS]
    except (Exception, SystemExit):  # meshio ends the program, and raises any exception for damaged files
        raise InputError(f"{path}: is damaged or has another format: export the volume again.") from None
    kinds = sorted({kind for kind, _ in cells})
    if not tets or not {_TETS, *_KEPT}.issuperset(kinds):
        raise InputError(
            f"{path}: contains cells of the types {', '.join(kinds) or 'none'}: give a volume of tetrahedra "
            "with four corners; triangles, lines and vertices may be among them."
        )
    volume = Volume(vertices, np.concatenate(tets), str(path), contents)
    check_volume(volume)
    return volume


def write_volume(path: str | os.PathLike[str], volume: Volume) -> tuple[str, ...]:
    """Write a tetrahedral mesh, with the other cells and the data of the file from which it was read.

    **Arguments:**

    - `path`: the file to create or to replace, in one of the formats of `read_volume`.
    - `volume`: a `Volume`.

    **Returns:** A tuple of sentences of meshio about what the format cannot hold.

    **Raises:** `InputError` for another suffix, or if the file cannot be written.
    """
    meshio, contents = _meshio(path), volume.contents
    if contents is None:
        contents = meshio.Mesh(volume.vertices, [(_TETS, volume.tets)])
    with atomic_write(path) as temporary:
        try:
            form = _FORMATS[Path(path).suffix.lower()]
            _, notes = _quietly(meshio.write, temporary, contents, file_format=form)
        except OSError:
            raise
        except (Exception, SystemExit):
            raise InputError(
                f"{path}: the format cannot hold all cells and data of {volume.name}: choose a name that "
                "ends in .vtu."
            ) from None
    return notes


def check_volume_suffix(path: str | os.PathLike[str]) -> None:
    """Refuse a file name whose suffix belongs to no format of volumes."""
    check_suffix(path, "volumes", *_FORMATS)


def _meshio(path: str | os.PathLike[str]) -> ModuleType:
    """Return the library, after a check of the suffix."""
    check_volume_suffix(path)
    try:
        import meshio
    except ImportError:
        raise InputError(
            f"{path}: volumes need the package meshio: run pip install 'jaxsmw[volumes]'."
        ) from None
    return meshio


def _quietly(function: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[Any, tuple[str, ...]]:
    """Call a function of meshio, which prints its notes. Return its result and the notes."""
    printed = io.StringIO()
    with redirect_stdout(printed), redirect_stderr(printed):
        result = function(*arguments, **options)
    text = " ".join(printed.getvalue().split())
    return result, (text,) if text else ()
