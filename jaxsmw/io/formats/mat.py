"""MATLAB's `.mat` files: variables, matrices, and meshes as structs.

MATLAB code for functional maps uses the following names. `T12` is the pointwise map from shape 1 to shape 2,
with 1-based vertices. `C21` is the functional map that takes functions on shape 2 to functions on shape 1. A
shape is a struct with the fields `surface`, `evals`, `evecs` and `A`. The field `surface` is a struct with
the coordinates `X`, `Y` and `Z` and the faces `TRIV`. The field `A` contains the vertex areas. In this
library, X is shape 1 and Y is shape 2, so `T12` is T and `C21` is C.

SciPy reads the files, and pymatreader the files of format 7.3, which are HDF5. Both allocate whatever a file
declares: a compressed variable can unpack to a thousand times its size, and a cell array can declare a
billion cells that the file does not contain. Therefore this module adds up the sizes of all arrays first.
"""

from __future__ import annotations

import io
import math
import os
import re
import struct
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy.io
from jaxtyping import Float64
from scipy.io.matlab import MatWriteError, matfile_version

from jaxsmw.errors import InputError, naming
from jaxsmw.io.formats.polygons import Formatted, Polygons, omissions, texture_or_note
from jaxsmw.io.mesh_data import MeshData, Skeleton, Skin
from jaxsmw.runtime.files import atomic_write, largest_contents, read_bytes

POINTWISE_MAP, FUNCTIONAL_MAP = "T12", "C21"

# The data types of elements, and the number of bytes per number for some of them. All others have 1 byte.
_MATRIX, _COMPRESSED = 14, 15
_BYTES_OF_NUMBER = {3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 17: 2, 18: 4}
# The array classes cell, struct and object.
_CONTAINERS = 1, 2, 3
# Each array adds this number of bytes to the counted memory, even if it is empty. The limit on the memory
# therefore also limits the number of arrays. SciPy takes at least 10 microseconds per array, and reads a few
# KiB of numbers in this time.
_BYTES_PER_ARRAY = 4096
# The same for an object of an HDF5 file, because h5py takes half a millisecond per object.
_BYTES_PER_OBJECT = 2**16
# The largest accepted size of all field names of a struct, in bytes. The limit allows 1000 fields with names
# of 64 bytes. The structs of shapes have about ten fields.
_LONGEST_NAMES = 64 * 1000


def is_mat_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file name has the suffix `.mat`, in upper or lower case."""
    return Path(path).suffix.lower() == ".mat"


def read_variables(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the variables of a `.mat` file of any size; see `parse_variables`. Messages name the file."""
    data = read_bytes(path, largest=None)
    with naming(path):
        return parse_variables(data)


def parse_variables(data: bytes) -> dict[str, Any]:
    """Parse the contents of a `.mat` file into a dictionary from the names of variables to their values.

    Structs become dictionaries, and axes of length 1 are dropped. Refuse contents that are larger than both
    1 GiB and four times the size of the file (`jaxsmw.runtime.files.largest_contents`).
    """
    is_hdf5 = data.startswith((b"MATLAB 7.3", b"\x89HDF")) or data[124:126] in (b"\0\2", b"\2\0")
    try:
        if is_hdf5:
            variables = _hdf5_variables(data)
        else:
            variables = scipy.io.loadmat(io.BytesIO(unpacked(data)), simplify_cells=True)
    except InputError:
        raise
    except Exception:  # SciPy and h5py can raise any exception for damaged files
        what = "a damaged file of MATLAB's format 7.3" if is_hdf5 else "damaged or not a .mat file"
        raise InputError(
            f"is {what}: save it again, with save(..., '-v7') in MATLAB or with scipy.io.savemat in Python."
        ) from None
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def _hdf5_variables(data: bytes) -> dict[str, Any]:
    try:
        import h5py
        from pymatreader import read_mat
    except ImportError:
        raise InputError(
            "is in MATLAB's format 7.3, which needs the package pymatreader: run pip install "
            "'jaxsmw[matlab]', or save it in MATLAB with save(..., '-v7')."
        ) from None
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # objects of classes, which no shape needs
        path = Path(folder, "variables.mat")
        path.write_bytes(data)
        with h5py.File(path) as file:
            _check_hdf5(h5py, file, largest_contents(len(data)))
        variables = read_mat(path)
    return dict(sorted(variables.items()))


def _check_hdf5(h5py: Any, file: Any, limit: int) -> None:
    """Walk through all groups, arrays and referenced cells as pymatreader does, and add up their memory."""
    memory, pending, groups = 0, [file], set()
    while pending:
        item = pending.pop()
        memory += _BYTES_PER_OBJECT
        if memory > limit:
            raise _too_large()
        if isinstance(item, h5py.Group):
            if item in groups:
                raise ValueError("a group contains itself, or is in two groups")
            groups.add(item)
            keys = [key for key in item if key != "#refs#"]
            if any(isinstance(item.get(key, getlink=True), h5py.ExternalLink) for key in keys):
                raise ValueError("a link to another file")
            pending += [item[key] for key in keys]
            continue
        if item.external or item.is_virtual:
            raise ValueError("an array in another file")
        memory += item.size * (64 if item.dtype == np.uint16 else 8)  # each character becomes an object
        if memory > limit:
            raise _too_large()
        if item.dtype == object:
            pending += [file[reference] for reference in item[()].ravel()]


def unpacked(data: bytes) -> bytes:
    """Return an equivalent file of the "MAT-File Format", level 5, without compressed variables."""
    if matfile_version(io.BytesIO(data))[0] == 0:
        return data  # level 4 has neither compression nor nested arrays
    order = "<" if data[126:128] == b"IM" else ">"
    remaining = largest_contents(len(data))
    elements, position = [data[:128]], 128
    while position < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, position)
        element = data[position : position + 8 + size]
        if len(element) < 8 + size:
            raise ValueError("a variable ends early")
        position += len(element)
        if kind == _COMPRESSED:
            element = _inflated(element[8:], order, remaining)
        remaining -= _memory(element, order, remaining)
        elements.append(element)
    return b"".join(elements)


def _inflated(data: bytes, order: str, limit: int) -> bytes:
    """Unpack a variable to the size that its tag declares, which is at most `limit` bytes."""
    stream = zlib.decompressobj()
    tag = stream.decompress(data, 8)
    _, size = struct.unpack(f"{order}II", tag)
    if size > limit:
        raise _too_large()
    # `decompress` would treat a size of 0 as no limit.
    contents = stream.decompress(stream.unconsumed_tail, size) if size else b""
    if len(contents) < size:
        raise ValueError("a compressed variable ends early")
    return tag + contents


def _memory(variable: bytes, order: str, limit: int) -> int:
    """Return the memory in bytes that a variable takes if every number becomes a float64; at most `limit`."""
    memory, pending = 0, [(0, len(variable), False)]
    while pending:
        position, stop, in_container = pending.pop()
        while position + 8 <= stop:
            kind, size = struct.unpack_from(f"{order}II", variable, position)
            if kind >> 16:  # the tag of a small element also contains the element's data of up to 4 bytes
                position += 8
                continue
            start, end = position + 8, position + 8 + size
            if end > stop:
                raise ValueError("an array ends early")
            if kind == _MATRIX:
                memory += _BYTES_PER_ARRAY
                if size:
                    pending.append((start, end, _is_container(variable, start, size, order)))
            elif in_container and size > _LONGEST_NAMES:
                raise ValueError("a struct has too many fields")
            else:
                memory += 8 * (size // _BYTES_OF_NUMBER.get(kind, 1))
            if memory > limit:
                raise _too_large()
            position = end + -size % 8
    return memory


def _is_container(variable: bytes, start: int, size: int, order: str) -> bool:
    """Return whether an array is a cell, struct or object array, which contains all elements it declares."""
    kind, length, flags, _, _, bytes_of_shape = struct.unpack_from(f"{order}6I", variable, start)
    if (kind, length) != (6, 8):
        raise ValueError("an array does not begin with its flags")
    if flags & 0xFF not in _CONTAINERS:
        return False
    shape = struct.unpack_from(f"{order}{min(bytes_of_shape, size) // 4}i", variable, start + 24)
    # Every element takes at least the 8 bytes of its tag.
    if min(shape) < 0 or math.prod(shape) > size // 8:
        raise ValueError("a cell array declares more cells than it contains")
    return True


def _too_large() -> InputError:
    return InputError(
        "would take more than 1 GiB of memory and more than four times the size of the file: save only the "
        "variables that are needed."
    )


def find_structs(variables: Mapping[str, Any], *fields: str) -> dict[str, Mapping[str, Any]]:
    """Return all structs that have the given fields, under their full names such as `S.surface`."""
    structs: dict[str, Mapping[str, Any]] = {}
    pending: list[tuple[str, Mapping[str, Any]]] = [("", variables)]
    while pending:
        name, struct = pending.pop(0)
        if all(field in struct for field in fields):
            structs[name] = struct
        pending += [
            (f"{name}.{key}".lstrip("."), value) for key, value in struct.items() if isinstance(value, dict)
        ]
    return structs


def read_matrix(
    path: str | os.PathLike[str], name: str, *, columns: int | None = None
) -> Float64[np.ndarray, "rows columns"]:
    """Read a matrix of real numbers from a `.mat` file; `columns` is the necessary number of columns, if any.

    If the file contains only one suitable matrix, the matrix may have any name. Otherwise, the matrix `name`
    is read. A matrix with a single row is read as a column, because a list in MATLAB may be either.
    """
    variables = read_variables(path)
    # Axes of length 1 were dropped.
    shapes = {None: None, 1: ()}.get(columns, (columns,))
    matrices = {
        key: value.astype(np.float64)
        for key, value in variables.items()
        if _is_real(value) and shapes in (None, value.shape[1:])
    }
    what = "list of numbers" if columns == 1 else f"matrix of {columns} columns" if columns else "matrix"
    if not matrices:
        contents = f"contains {', '.join(map(ascii, variables))}" if variables else "is empty"
        raise InputError(f"{path}: {contents}, but no {what}: save the {what} as {name}.")
    if len(matrices) > 1 and name not in matrices:
        raise InputError(
            f"{path}: contains more than one {what} ({', '.join(matrices)}): save the right one as {name}."
        )
    matrix = matrices.get(name, next(iter(matrices.values())))
    return matrix[:, None] if matrix.ndim == 1 else matrix


def _is_real(value: Any) -> bool:
    """Return whether a variable is a non-empty list or a non-empty matrix of real numbers."""
    is_array = isinstance(value, np.ndarray) and value.dtype.kind in "iuf"
    return is_array and value.ndim in (1, 2) and value.size > 0


def write_variables(path: str | os.PathLike[str], variables: Mapping[str, Any]) -> None:
    """Write arrays, numbers and dictionaries, which become structs. Lists become columns."""
    with atomic_write(path) as temporary, naming(path):
        temporary.write_bytes(_saved(variables))


def _saved(variables: Mapping[str, Any]) -> bytes:
    file = io.BytesIO()
    try:
        scipy.io.savemat(file, dict(variables), do_compression=True, oned_as="column")
    except MatWriteError:
        raise InputError(
            "a variable is larger than 4 GiB, the limit of .mat files: write a .npz file, or fewer numbers."
        ) from None
    return file.getvalue()


def parse_mat(data: bytes) -> Polygons:
    """Parse a file with one struct, perhaps nested, that has faces TRIV and columns X, Y, Z (or VERT)."""
    structs = find_structs(parse_variables(data), "TRIV")
    if len(structs) > 1:
        raise InputError(
            f"contains {len(structs)} shapes ({', '.join(structs)}): save each shape in a separate file."
        )
    name, surface = next(iter(structs.items()), ("", {}))
    columns = ("X", "Y", "Z") if "X" in surface else ("VERT",)
    fields = [field for field in ("TRIV", *columns) if field in surface]
    for field in fields:
        if not _is_real(surface[field]):  # a conversion to float64 would drop imaginary parts
            raise InputError(
                f"{f'{name}.{field}'.lstrip('.')} is not an array of real numbers: save real coordinates and "
                "vertex indices."
            )
    vertices = faces = np.empty(0)
    if len(fields) == 1 + len(columns) and len({len(surface[field]) for field in columns}) == 1:
        vertices = np.column_stack([surface[field] for field in columns]).astype(np.float64)
        faces = surface["TRIV"].astype(np.float64)
        faces = faces[None] if faces.shape == (3,) else faces  # one face
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise InputError(
            "contains no struct 'surface' with X, Y, Z (or VERT) and TRIV, as in the TOSCA data set: save "
            "such a struct, or export the mesh as OFF or PLY."
        )
    n, f = len(vertices), len(faces)

    def arrays(field: str, rows: int) -> dict[str, np.ndarray]:
        return {key: _rows(values, rows) for key, values in _struct(surface, field).items()}

    texture, skin, skeleton = (_struct(surface, name) for name in ("texture", "skin", "skeleton"))
    corners, notes = texture_or_note(lambda: _texture(texture, f) if texture else None)
    return Polygons(
        vertices,
        faces.ravel() - 1,
        np.full(f, 3),
        vertex_data=arrays("vertex_data", n),
        face_data=arrays("face_data", f),
        blend_shapes=arrays("blend_shapes", n),
        notes=notes,
        texture=corners,
        skin=Skin(
            tuple(_words(skin.get("joints", []))), _rows(skin.get("weights", []), n), _skeleton(skeleton)
        )
        if skin
        else None,
        label_names={key: tuple(_words(names)) for key, names in _struct(surface, "label_names").items()},
    )


def _skeleton(skeleton: Mapping[str, Any]) -> Skeleton | None:
    """Return the skeleton of a struct: parents (0 for none), and bind matrices below each other."""
    if not skeleton:
        return None
    parents, matrices = (np.atleast_1d(skeleton.get(name, [])) for name in ("parents", "bind_matrices"))
    if not _is_real(parents) or not _is_real(matrices) or matrices.shape != (4 * parents.size, 4):
        raise InputError(
            "the skeleton has no arrays of real numbers called parents (joints, 1) and bind_matrices (4 "
            "joints, 4): save both arrays."
        )
    parents = parents.ravel()
    is_whole = np.array_equal(parents, np.floor(parents)) and (np.abs(parents) < 2**31).all()
    return Skeleton(parents.astype(np.int64) - 1 if is_whole else parents, matrices.reshape(-1, 4, 4))


def _struct(struct: Mapping[str, Any], field: str) -> Mapping[str, Any]:
    value = struct.get(field)
    return value if isinstance(value, dict) else {}


def _rows(values: Any, count: int) -> np.ndarray:
    """Reshape an array to `count` rows if `parse_variables` dropped one of its axes."""
    array = np.asarray(values)
    return array.reshape(count, -1) if array.ndim < 2 and array.size and array.size % count == 0 else array


def _words(value: Any) -> list[str]:
    return [str(word) for word in np.atleast_1d(np.asarray(value, dtype=object)).ravel().tolist()]


def _texture(struct: Mapping[str, Any], f: int) -> tuple[np.ndarray, np.ndarray]:
    coordinates, corners = (struct.get(field, np.empty(0)) for field in ("coordinates", "corners"))
    if not _is_real(coordinates) or not _is_real(corners) or (corners != np.floor(corners)).any():
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


def _is_field(name: str, _: Any = None) -> bool:
    """Return whether MATLAB accepts a name as the field of a struct."""
    return bool(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,30}", name))


def format_mat(data: MeshData) -> Formatted:
    """Format the mesh and its data as a struct `surface`, with 1-based faces and texture vertices."""
    surface: dict[str, Any] = dict(zip("XYZ", data.mesh.vertices.T, strict=True))
    surface["TRIV"] = data.faces + 1.0
    labels = {name: _cells(names) for name, names in data.label_names.items()}
    parts = {"vertex_data": data.vertex_data, "face_data": data.face_data, "blend_shapes": data.blend_shapes}
    for part, values in (parts | {"label_names": labels}).items():
        if fields := {name: value for name, value in values.items() if _is_field(name)}:
            surface[part] = fields
    if data.texture is not None:
        surface["texture"] = {"coordinates": data.texture.coordinates, "corners": data.texture.corners + 1.0}
    if data.skin is not None:
        joints, weights, skeleton = data.skin
        surface["skin"] = {"joints": _cells(joints), "weights": weights}
        if skeleton is not None:
            matrices = skeleton.bind_matrices.reshape(-1, 4)
            surface["skeleton"] = {"parents": skeleton.parents + 1.0, "bind_matrices": matrices}
    notes = omissions(
        data,
        "MATLAB",
        vertex_data=_is_field,
        face_data=_is_field,
        blend_shapes=_is_field,
        label_names=_is_field,
        texture=True,
        skin=True,
    )
    return _saved({"surface": surface}), notes


def _cells(words: tuple[str, ...]) -> np.ndarray:
    cells = np.empty(len(words), dtype=object)
    cells[:] = words
    return cells
