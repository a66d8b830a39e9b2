"""NumPy's `.npz` files with the arrays of a mesh and its data."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from functools import partial
from typing import IO, Any

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Formatted, Polygons, texture_or_note
from jaxsmw.io.mesh_data import MeshData, Skeleton, Skin
from jaxsmw.runtime.files import largest_contents

_FOLDERS = "vertex_data", "face_data", "blend_shapes", "label_names"


def parse_npz(data: bytes) -> Polygons:
    """Parse the arrays that `format_npz` writes. Other arrays are ignored."""
    arrays = read_arrays(data)
    missing = [name for name in ("vertices", "faces") if name not in arrays]
    if missing:
        raise InputError(f"contains no array called {missing[0]}: save the vertices and the faces.")
    vertices, faces = arrays["vertices"], arrays["faces"]
    if any(array.shape[1:] != (3,) or array.dtype.kind not in "iuf" for array in (vertices, faces)):
        raise InputError(
            f"vertices have the shape {vertices.shape} and faces the shape {faces.shape}: save numbers with "
            "three columns."
        )
    folders: dict[str, dict[str, np.ndarray]] = {folder: {} for folder in _FOLDERS}
    for name, array in arrays.items():
        folder, _, rest = name.partition("/")
        if folder in folders and rest:
            folders[folder][rest] = array
    texture = [arrays[name] for name in ("texture_coordinates", "texture_corners") if name in arrays]
    skin, skeleton = (
        [arrays[name] for name in names if name in arrays]
        for names in (("skin_joints", "skin_weights"), ("skin_parents", "skin_bind_matrices"))
    )
    if len(skin) == 1 or len(skeleton) == 1:
        raise InputError("contains only half of a texture, of a skin or of a skeleton: save both arrays.")
    corners, notes = texture_or_note(lambda: _texture(texture, faces.shape))
    return Polygons(
        vertices.astype(np.float64),
        faces.ravel(),
        np.full(len(faces), 3),
        vertex_data=folders["vertex_data"],
        face_data=folders["face_data"],
        notes=notes,
        texture=corners,
        blend_shapes=folders["blend_shapes"],
        skin=Skin(tuple(map(str, skin[0].ravel())), skin[1], Skeleton(*skeleton) if skeleton else None)
        if skin
        else None,
        label_names={name: tuple(map(str, names.ravel())) for name, names in folders["label_names"].items()},
    )


def _texture(arrays: list[np.ndarray], shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray] | None:
    if not arrays:
        return None
    if len(arrays) == 1:
        raise InputError("contains only half of a texture: save both arrays.")
    coordinates, corners = arrays
    if corners.shape != shape:
        raise InputError(
            f"the texture's corners have the shape {corners.shape}, but the faces have the shape {shape}: "
            "save one row for each face."
        )
    return coordinates, corners.ravel()


def read_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Check the sizes of all arrays of a `.npz` file, and return the arrays by their names."""
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            members = [member for member in file.infolist() if member.filename.endswith(".npy")]
            if sum(member.file_size for member in members) > largest_contents(len(data)):
                raise InputError(
                    "would take more than 1 GiB of memory and more than four times the size of the file: "
                    "write the file again, without other arrays."
                )
            for member in members:
                name = member.filename.removesuffix(".npy")
                arrays[name] = _checked(partial(file.open, member), member.file_size)
    except InputError:
        raise
    except Exception:  # NumPy and zipfile can raise any exception for damaged files
        raise InputError("is damaged or not a .npz file: write the file again.") from None
    return arrays


def read_array(data: bytes) -> np.ndarray:
    """Return the array of a `.npy` file."""
    try:
        return _checked(partial(io.BytesIO, data), len(data))
    except Exception:  # NumPy can raise any exception for damaged files
        raise InputError(
            "is not an array saved by NumPy, or contains pickled objects: save an array of numbers with "
            "numpy.save."
        ) from None


def _checked(open_file: Callable[[], IO[bytes]], size: int) -> np.ndarray:
    """Read an array. Refuse a header that declares more than `size` bytes, a negative length or objects."""
    with open_file() as stream:
        version = np.lib.format.read_magic(stream)
        is_first = version == (1, 0)
        read = np.lib.format.read_array_header_1_0 if is_first else np.lib.format.read_array_header_2_0
        shape, _, kind = read(stream)
        if kind.hasobject or math.prod(shape) * kind.itemsize > size or min(shape, default=0) < 0:
            raise ValueError("the array is larger than its file")
    with open_file() as stream:
        return np.lib.format.read_array(stream)


def format_npz(data: MeshData) -> Formatted:
    """Format a mesh and all its data as arrays, without any loss."""
    arrays: dict[str, Any] = {"vertices": data.mesh.vertices, "faces": data.faces}
    for folder in _FOLDERS:
        for name, values in getattr(data, folder).items():
            arrays[f"{folder}/{name}"] = np.asarray(values)
    if data.texture is not None:
        arrays |= {"texture_coordinates": data.texture.coordinates, "texture_corners": data.texture.corners}
    if data.skin is not None:
        joints, weights, skeleton = data.skin
        arrays |= {"skin_joints": np.array(joints), "skin_weights": weights}
        if skeleton is not None:
            arrays |= {"skin_parents": skeleton.parents, "skin_bind_matrices": skeleton.bind_matrices}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            # `numpy.savez` would refuse names that are also the names of its arguments.
            member = zipfile.ZipInfo(f"{name}.npy")
            member.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, array, allow_pickle=False)
    return file.getvalue(), ()
