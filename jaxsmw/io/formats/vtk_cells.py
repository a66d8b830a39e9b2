"""Cells of several types, and arrays on points and cells, for both VTK formats."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import (
    TEXTURE_OF_CORNERS,
    Polygons,
    are_vertices,
    is_texture_of_vertices,
    unique_name,
)
from jaxsmw.io.formats.text import damaged, excerpt, export_again
from jaxsmw.io.mesh_data import MeshData, texture_at_corners, texture_of_corners
from jaxsmw.wording import count_of

# Types of cells (https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html).
VERTEX, LINE, STRIP, POLYGON = 1, 3, 6, 7
_POINTS, _LINES = (0, VERTEX, 2), (LINE, 4)
_SURFACE = 5, STRIP, POLYGON, 9

_MOST_COLUMNS = 2**16


class Cells(NamedTuple):
    """Cells in the order of the file: the type and the number of corners of each cell, and all corners."""

    kinds: Int64[np.ndarray, " c"]
    sizes: Int64[np.ndarray, " c"]
    corners: np.ndarray


def cells_of(kind: int, offsets: np.ndarray, corners: np.ndarray) -> Cells:
    """Make cells of one type from offsets (c + 1,), which begin at 0 and end at the number of corners."""
    offsets = offsets.astype(np.int64)
    sizes = np.diff(offsets)
    if len(offsets) and (offsets[0] != 0 or offsets[-1] != len(corners) or (sizes < 0).any()):
        raise damaged(f"the offsets of the cells do not fit {count_of(len(corners), 'corner')}")
    if not len(offsets) and len(corners):
        raise damaged(f"the cells have {count_of(len(corners), 'corner')}, but no offsets")
    return Cells(np.full(len(sizes), kind), sizes, corners)


def joined(groups: list[Cells]) -> Cells:
    """Concatenate groups of cells."""
    if not groups:
        return Cells(*(np.empty(0, np.int64) for _ in range(3)))
    return Cells(*(np.concatenate(parts) for parts in zip(*groups, strict=True)))


def check_array(types: Mapping[str, str], name: str, columns: int) -> str:
    """Return the NumPy type of an array with the VTK type `name`. Refuse unknown types and bad widths."""
    if name not in types:
        raise InputError(
            f"contains numbers of the unknown type {excerpt(name)}: save the mesh with floats and integers."
        )
    if not 1 <= columns <= _MOST_COLUMNS:
        raise damaged(f"declares an array with {count_of(columns, 'column')}")
    return types[name]


def polygons_of(
    points: Float64[np.ndarray, "n 3"],
    cells: Cells,
    point_data: Mapping[str, np.ndarray],
    cell_data: Mapping[str, np.ndarray],
    coordinates: np.ndarray | None = None,
) -> Polygons:
    """Return the polygons and strips among the cells. Points and lines are ignored.

    `coordinates` contains the texture coordinates of the points (n, 2 or more).
    """
    for data, count, what in ((point_data, len(points), "point"), (cell_data, len(cells.sizes), "cell")):
        for name, values in data.items():
            if len(values) != count:
                raise export_again(
                    f"the array {name[:40]!a} has {count_of(len(values), 'row')}, but the file has "
                    f"{count_of(count, what)}"
                )
    is_supported = np.isin(cells.kinds, _POINTS + _LINES + _SURFACE)
    if not is_supported.all():
        raise InputError(
            f"contains cells of type {cells.kinds[int(is_supported.argmin())]}, which are not triangles or "
            "polygons: extract the surface first."
        )
    used = np.isin(cells.kinds, _SURFACE)
    ignored = int((~used).sum())
    notes = (f"{count_of(ignored, 'cell')} ignored: points and lines are not part of a surface.",)
    sizes, corners = cells.sizes[used], cells.corners[np.repeat(used, cells.sizes)]
    texture = None
    if coordinates is not None and are_vertices(corners, len(points)):
        texture = coordinates[:, :2].astype(np.float64), corners
    of_corners = cell_data.get(TEXTURE_OF_CORNERS)
    face_data = {name: values[used] for name, values in cell_data.items()}
    if of_corners is not None and of_corners.shape[1:] == (6,) and (sizes == 3).all():
        del face_data[TEXTURE_OF_CORNERS]
        texture = texture_of_corners(corners, of_corners[used].reshape(-1, 2).astype(np.float64))
    return Polygons(
        points,
        corners,
        sizes,
        notes=notes if ignored else (),
        vertex_data=point_data,
        face_data=face_data,
        texture=texture,
        strips=cells.kinds[used] == STRIP,
        lines=int(np.isin(cells.kinds, _LINES).sum()),
    )


def add_array(data: dict[str, np.ndarray], name: str, values: np.ndarray) -> None:
    """Add an array with one row per point or cell. If its name is taken, it receives a number."""
    data[unique_name(name or "unnamed", data)] = values


def arrays_of(data: MeshData) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray | None]:
    """Return the arrays on points and on cells, and the texture coordinates of the points.

    The arrays on cells contain a texture with seams.
    """
    cell_data, coordinates = dict(data.face_data), None
    if data.texture is not None and is_texture_of_vertices(data):
        coordinates = data.texture.coordinates
    elif data.texture is not None:
        cell_data[TEXTURE_OF_CORNERS] = texture_at_corners(data.texture)
    return dict(data.vertex_data), cell_data, coordinates
