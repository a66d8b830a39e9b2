"""MATLAB's `.mat` files with a struct of coordinates and 1-based faces."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.io
from scipy.io.matlab import MatWriteError

from jaxsmw.errors import InputError
from jaxsmw.io.formats.data import NOTHING, MeshData, Polygons, Skin, Written, always, omissions
from jaxsmw.io.mat_files import find_structs, is_real, parse_variables


def parse_mat(data: bytes) -> Polygons:
    """Parse a `.mat` file with one struct that has faces TRIV and columns X, Y, Z (or a matrix VERT).

    The struct may be nested in other structs.
    """
    structs = find_structs(parse_variables(data), "TRIV")
    if len(structs) > 1:
        raise InputError(
            f"contains {len(structs)} shapes ({', '.join(structs)}): save each shape in a separate file."
        )
    name, surface = next(iter(structs.items()), ("", {}))
    columns = ("X", "Y", "Z") if "X" in surface else ("VERT",)
    given = [field for field in ("TRIV", *columns) if field in surface]
    for field in given:
        if not is_real(surface[field]):  # a conversion to float64 would drop imaginary parts
            raise InputError(
                f"{f'{name}.{field}'.lstrip('.')} is not an array of real numbers: save real coordinates and "
                "vertex indices."
            )
    vertices = faces = np.empty(0)
    if len(given) == 1 + len(columns) and len({len(surface[field]) for field in columns}) == 1:
        vertices = np.column_stack([surface[field] for field in columns]).astype(np.float64)
        faces = surface["TRIV"].astype(np.float64)
        faces = faces[None] if faces.shape == (3,) else faces  # one face
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise InputError(
            "contains no struct 'surface' with X, Y, Z (or VERT) and TRIV, as in the TOSCA data set: save "
            "such a struct, or export the mesh as OFF or PLY."
        )
    return _with_data(Polygons(vertices, faces.ravel() - 1, np.full(len(faces), 3)), surface)


def _with_data(polygons: Polygons, surface: Mapping[str, Any]) -> Polygons:
    """Read the further mesh data of the struct, and add these data to the polygons."""
    n, f = len(polygons.vertices), len(polygons.sizes)
    texture, skin = surface.get("texture"), surface.get("skin")
    names = {name: tuple(_words(words)) for name, words in _struct(surface.get("label_names")).items()}
    return polygons._replace(
        vertex_data={name: _rows(values, n) for name, values in _struct(surface.get("vertex_data")).items()},
        face_data={name: _rows(values, f) for name, values in _struct(surface.get("face_data")).items()},
        blend_shapes={
            name: _rows(values, n) for name, values in _struct(surface.get("blend_shapes")).items()
        },
        texture=_texture(texture, f) if isinstance(texture, dict) else None,
        skin=_skin(skin, n) if isinstance(skin, dict) else None,
        label_names=names,
    )


def _struct(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else NOTHING


def _rows(values: Any, count: int) -> np.ndarray:
    """Reshape an array to `count` rows if `parse_variables` dropped one of its axes."""
    array = np.asarray(values)
    return array.reshape(count, -1) if array.ndim < 2 and array.size and array.size % count == 0 else array


def _words(value: Any) -> list[str]:
    return [str(word) for word in np.atleast_1d(np.asarray(value, dtype=object)).ravel().tolist()]


def _texture(struct: Mapping[str, Any], f: int) -> tuple[np.ndarray, np.ndarray]:
    coordinates, corners = (struct.get(field, np.empty(0)) for field in ("coordinates", "corners"))
    if not is_real(coordinates) or not is_real(corners) or (corners != np.floor(corners)).any():
        raise InputError(
            "the texture has no arrays of real numbers called coordinates and corners: save both arrays."
        )
    coordinates = coordinates.reshape(-1, 2) if coordinates.size % 2 == 0 else coordinates
    if coordinates.ndim != 2 or corners.size != 3 * f or not (np.abs(corners) <= len(coordinates)).all():
        raise InputError(
            "the texture does not have one texture vertex for each corner of each face: save the texture "
            "again."
        )
    return coordinates.astype(np.float64), corners.reshape(f, 3).astype(np.int64).ravel() - 1


def _skin(struct: Mapping[str, Any], n: int) -> Skin:
    return Skin(tuple(_words(struct.get("joints", []))), _rows(struct.get("weights", []), n))


def _is_field(name: str, _: Any = None) -> bool:
    """Return whether MATLAB accepts a name as the field of a struct."""
    return bool(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,30}", name))


def format_mat(data: MeshData) -> Written:
    """Format the mesh and its data as a struct `surface`, with 1-based faces and texture vertices."""

    def fields(values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in values.items() if _is_field(name)}

    surface: dict[str, Any] = dict(zip("XYZ", data.mesh.vertices.T, strict=True))
    surface["TRIV"] = data.faces + 1.0
    labels = {name: _cells(names) for name, names in data.label_names.items()}
    parts = {"vertex_data": data.vertex_data, "face_data": data.face_data, "blend_shapes": data.blend_shapes}
    parts["label_names"] = labels
    surface |= {part: fields(values) for part, values in parts.items() if fields(values)}
    if data.texture is not None:
        surface["texture"] = {"coordinates": data.texture[0], "corners": data.texture[1] + 1.0}
    if data.skin is not None:
        surface["skin"] = {"joints": _cells(data.skin[0]), "weights": data.skin[1]}
    file = io.BytesIO()
    try:
        scipy.io.savemat(file, {"surface": surface}, do_compression=True, oned_as="column")
    except MatWriteError:
        raise InputError(
            "an array is larger than 4 GiB, the limit of .mat files: write a .npz file."
        ) from None
    notes = omissions(
        data,
        "MATLAB",
        vertex_data=_is_field,
        face_data=_is_field,
        blend_shapes=_is_field,
        label_names=_is_field,
        texture=always,
        skin=always,
    )
    return Written(file.getvalue(), notes)


def _cells(words: tuple[str, ...]) -> np.ndarray:
    cells = np.empty(len(words), dtype=object)
    cells[:] = words
    return cells
