"""The JSON part, the buffers and the accessors of glTF 2.0 files.

The specification is https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.lines import excerpt
from jaxsmw.runtime.files import read_bytes

DAMAGED = "so the file is damaged: export the mesh again."
TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
# Files may require these extensions, which do not change how positions, faces and attributes are read.
_HARMLESS = re.compile(r"KHR_mesh_quantization|(KHR|EXT)_(materials|texture|lights|animation|xmp).*")


class Document:
    """The parts of a glTF file, with checks of all indices and sizes.

    **Arguments:**

    - `data`: the contents of a `.gltf` file (JSON) or of a `.glb` file.
    - `folder`: the folder of the file, or None if buffers in other files are not permitted.
    """

    def __init__(self, data: bytes, folder: Path | None) -> None:
        self.folder = folder
        self.binary: bytes | None = None
        self.buffers: dict[int, bytes] = {}
        text = self._unpack(data) if data[:4] == b"glTF" else data
        try:
            self.json = json.loads(text.decode("utf-8-sig"), parse_constant=_refuse_constant)
        except (ValueError, RecursionError):
            raise InputError(
                "contains no valid JSON, so the file is not glTF or damaged: export the mesh again."
            ) from None
        asset = self.json.get("asset") if isinstance(self.json, dict) else None
        asset = asset if isinstance(asset, dict) else {}
        version, least = (
            str(asset.get(key, default)) for key, default in (("version", ""), ("minVersion", "2.0"))
        )
        if not re.fullmatch(r"2\.\d{1,3}", version, re.ASCII) or least != "2.0":
            raise InputError("does not have the version 2.0 of glTF: export the mesh again as glTF 2.0.")
        for name in self.list_of(self.json, "extensionsRequired"):
            if not isinstance(name, str) or not _HARMLESS.fullmatch(name):
                raise InputError(
                    f"needs the extension {excerpt(str(name))}, which is not supported: export the mesh "
                    "without compression and without this extension."
                )

    def _unpack(self, data: bytes) -> bytes:
        """Return the JSON chunk of a GLB file, and keep its binary chunk."""
        version, length = (int.from_bytes(data[i : i + 4], "little") for i in (4, 8))
        if version != 2:
            raise InputError(
                f"has the version {version} of the GLB format: export the mesh again as glTF 2.0."
            )
        if length != len(data) or length < 20:
            raise InputError(
                f"declares {length} bytes, but has {len(data)}, so the file is truncated or damaged: export "
                "the mesh again."
            )
        chunks, position = [], 12
        while position < length:
            size, kind = (int.from_bytes(data[i : i + 4], "little") for i in (position, position + 4))
            if position + 8 + size > length:
                raise InputError(f"a chunk of the file declares {size} bytes, {DAMAGED}")
            chunks.append((kind, data[position + 8 : position + 8 + size]))
            position += 8 + size
        if chunks[0][0] != _JSON:
            raise InputError(f"does not begin with a JSON chunk, {DAMAGED}")
        if len(chunks) > 1 and chunks[1][0] == _BINARY:
            self.binary = chunks[1][1]
        return chunks[0][1]

    def list_of(self, parent: dict[str, Any], key: str) -> list[Any]:
        """Return the list under a key of an object, or an empty list if the key is missing."""
        value = parent.get(key, [])
        if not isinstance(value, list):
            self.refuse(key)
        return value

    def dict_of(self, parent: dict[str, Any], key: str) -> dict[str, Any]:
        """Return the object under a key of another object, or an empty object if the key is missing."""
        value = parent.get(key, {})
        if not isinstance(value, dict):
            self.refuse(key)
        return value

    def integer(self, parent: dict[str, Any], key: str, default: int | None = None) -> int:
        """Return the non-negative integer under a key of an object."""
        value = parent.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
            self.refuse(key)
        return value

    def numbers(self, parent: dict[str, Any], key: str, count: int) -> np.ndarray | None:
        """Return the list of finite numbers under a key of an object, or None if the key is missing."""
        if key not in parent:
            return None
        values = self.list_of(parent, key)
        if len(values) != count or not all(type(value) in (int, float) for value in values):
            self.refuse(key)
        array = np.array([float(value) if abs(value) < 1e300 else np.inf for value in values])
        if not np.isfinite(array).all():
            self.refuse(key)
        return array

    def item(self, key: str, index: Any) -> dict[str, Any]:
        """Return an element of a list at the top level, such as an accessor."""
        items = self.list_of(self.json, key)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            number = index if isinstance(index, int) and abs(index) < 2**63 else excerpt(str(index)[:99])
            raise InputError(f"uses {key}[{number}], but the length of {key} is {len(items)}, {DAMAGED}")
        if not isinstance(items[index], dict):
            self.refuse(key)
        return items[index]

    def refuse(self, key: str) -> NoReturn:
        raise InputError(f"the value of {key!a} is not valid, {DAMAGED}")

    def buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer, which is in the file itself, in a data URI or in another file."""
        if index not in self.buffers:
            description = self.item("buffers", index)
            length = self.integer(description, "byteLength")
            uri = description.get("uri")
            if uri is None and index == 0 and self.binary is not None:
                content = self.binary
            elif isinstance(uri, str):
                content = _decoded(uri) if uri.startswith("data:") else self._external(uri)
            else:
                raise InputError(f"has no contents for buffer {index}, {DAMAGED}")
            if len(content) < length:
                raise InputError(
                    f"declares {length} bytes in buffer {index}, but the buffer has {len(content)}, so "
                    "the file is truncated or damaged: export the mesh again."
                )
            self.buffers[index] = content[:length]
        return self.buffers[index]

    def _external(self, uri: str) -> bytes:
        """Return the contents of a file in the folder of the glTF file or below."""
        name = unquote(uri)
        parts = name.split("/")
        if (
            self.folder is None
            or re.search(r"[:\\\0]", name)
            or name.startswith("/")
            or {"", ".", ".."} & {*parts}
        ):
            raise InputError(
                f"uses the buffer {excerpt(uri)}, which is not a file in the folder of this file: put the "
                "buffer into the same folder, or export a .glb file."
            )
        path = self.folder / name
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise InputError(
                f"uses the buffer {excerpt(uri)}, which links to another folder: put the buffer into the "
                "same folder, or export a .glb file."
            )
        try:
            return read_bytes(path)
        except InputError:
            raise InputError(
                f"uses the buffer {excerpt(uri)}, which cannot be read: put the buffer into the same folder, "
                "or export a .glb file."
            ) from None

    def view(self, index: Any, offset: int, count: int, kind: str, columns: int) -> np.ndarray:
        """Return `count` rows of a buffer view as numbers (count, columns). The rows start at `offset`."""
        description = self.item("bufferViews", index)
        if "EXT_meshopt_compression" in self.dict_of(description, "extensions"):
            raise InputError(
                "is compressed with EXT_meshopt_compression: export the mesh without compression."
            )
        buffer = self.buffer(self.integer(description, "buffer"))
        start, length = self.integer(description, "byteOffset", 0), self.integer(description, "byteLength")
        row = np.dtype(kind).itemsize * columns
        stride = self.integer(description, "byteStride", row)
        if stride < row or start + length > len(buffer):
            raise InputError(f"buffer view {index} does not fit its buffer, {DAMAGED}")
        if count and offset + stride * (count - 1) + row > length:
            raise InputError(f"an accessor needs more bytes than buffer view {index} has, {DAMAGED}")
        if not count:
            return np.empty((0, columns), kind)
        return np.ndarray(
            (count, columns), "<" + kind, buffer, start + offset, (stride, np.dtype(kind).itemsize)
        ).astype(kind)

    def accessor(
        self, index: Any, columns: tuple[int, ...], rows: int | None = None
    ) -> tuple[np.ndarray, bool]:
        """Return the numbers of an accessor (rows, columns), and whether these numbers represent fractions.

        A fraction is stored as an integer, which `as_floats` divides by the largest integer of its type.

        **Arguments:**

        - `columns`: the permitted numbers of columns.
        - `rows`: the necessary number of rows, or None for any number.
        """
        description = self.item("accessors", index)
        kind = TYPES.get(self.integer(description, "componentType"))
        width = COLUMNS.get(str(description.get("type")), 0)
        count = self.integer(description, "count")
        if kind is None or width not in columns:
            raise InputError(f"accessor {index} does not have a suitable type, {DAMAGED}")
        if rows is not None and count != rows:
            raise InputError(f"accessor {index} has {count} elements instead of {rows}, {DAMAGED}")
        if "bufferView" in description:
            offset = self.integer(description, "byteOffset", 0)
            values = self.view(description["bufferView"], offset, count, kind, width)
        elif rows is None:  # limits memory: an accessor without data can state any number of elements
            raise InputError(f"accessor {index} has no buffer view, {DAMAGED}")
        else:
            values = np.zeros((count, width), kind)
        if "sparse" in description:
            self._replace(values, self.dict_of(description, "sparse"), kind)
        return values, description.get("normalized") is True and kind[0] in "iu"

    def _replace(self, values: np.ndarray, sparse: dict[str, Any], kind: str) -> None:
        """Replace the rows that a sparse accessor lists."""
        count = self.integer(sparse, "count")
        where, what = self.dict_of(sparse, "indices"), self.dict_of(sparse, "values")
        kind_of_index = TYPES.get(self.integer(where, "componentType"), "f4")
        if kind_of_index[0] != "u" or count > len(values):
            raise InputError(f"a sparse accessor does not have valid indices, {DAMAGED}")
        offset = self.integer(where, "byteOffset", 0)
        indices = self.view(where.get("bufferView"), offset, count, kind_of_index, 1)[:, 0]
        if count and indices.max() >= len(values):
            raise InputError(f"a sparse accessor replaces an element that does not exist, {DAMAGED}")
        offset = self.integer(what, "byteOffset", 0)
        values[indices] = self.view(what.get("bufferView"), offset, count, kind, values.shape[1])


def as_floats(values: np.ndarray, is_fraction: bool) -> np.ndarray:
    """Return numbers of an accessor as float64.

    A fraction is stored as an integer, which is divided by the largest integer of its type.
    """
    if not is_fraction:
        return values.astype(np.float64)
    return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _decoded(uri: str) -> bytes:
    """Return the contents of a data URI in base64."""
    head, comma, content = uri.partition(",")
    try:
        if not comma or not head.endswith(";base64"):
            raise ValueError
        return base64.b64decode(content, validate=True)
    except (ValueError, binascii.Error):
        raise InputError(f"contains a data URI that is not valid base64, {DAMAGED}") from None
