"""Surfaces of brains and overlays on them: GIFTI (https://www.nitrc.org/projects/gifti), and FreeSurfer.

nibabel reads and writes these files. It unpacks whatever a GIFTI file contains, and allocates the table of
labels that an annotation declares. Therefore this module checks these sizes first. nibabel gives a vertex of
an annotation a wrong label if the table lacks the vertex's label, so this module looks the labels up.
"""

from __future__ import annotations

import base64
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Int64

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Formatted, Polygons, omissions, unique_name, width_of
from jaxsmw.io.formats.text import damaged, export_again, refuse_entities
from jaxsmw.io.mesh_data import COLORS, NORMALS, LabelTable, MeshData, Overlay
from jaxsmw.runtime.files import largest_contents
from jaxsmw.wording import count_of

# The intents of arrays in GIFTI files, and the names of arrays that have no name.
_LABEL, _VECTOR, _POINTS, _TRIANGLES, _NODE_INDEX = 1002, 1007, 1008, 1009, 2002
_COLORS = {2003: 3, 2004: 4}
_NAMES = {_LABEL: "label", _VECTOR: "vector", 2001: "time series", 2003: COLORS, 2004: COLORS, 2005: "shape"}
_SHAPE, _NONE = 2005, 0
# The types of numbers in GIFTI files: NIfTI's codes of uint8, int32 and float32.
_TYPES = {"u1": 2, "i4": 8, "f4": 16}
# The largest number of rows of a table of labels. FreeSurfer's numbers of cortical regions are below 15 000.
_MOST_LABELS = 2**16
# The name and the colour of vertices without a label.
_NO_LABEL = "???"


def parse_gifti(data: bytes) -> Polygons:
    """Parse a GIFTI file with one surface. Further arrays with one row per vertex become vertex data."""
    image = _image(data)
    points, triangles = (
        [array.data for array in image.darrays if array.intent == intent] for intent in (_POINTS, _TRIANGLES)
    )
    if not points and not triangles:
        raise InputError(
            "contains no surface, only data on one: give the file of the surface as the mesh, and this file "
            "as an overlay."
        )
    if len(points) != 1 or len(triangles) != 1:
        raise InputError(
            f"contains {count_of(len(points), 'list')} of points and {count_of(len(triangles), 'list')} of "
            "triangles instead of one each: save each surface in its own file."
        )
    vertices, faces = _rows(points[0]), _rows(triangles[0])
    overlay = _overlay(image, len(vertices))
    return Polygons(
        vertices.astype(np.float64),
        faces.ravel(),
        np.full(len(faces), 3),
        notes=overlay.notes,
        vertex_data=overlay.values,
        label_names={name: table.names for name, table in overlay.labels.items()},
    )


def _rows(array: np.ndarray) -> np.ndarray:
    if array.ndim != 2 or array.shape[1] != 3:
        raise damaged(f"points or triangles have the shape {array.shape} instead of three columns")
    return array


def parse_gifti_overlay(data: bytes) -> Overlay:
    """Parse the arrays of a `.gii` file that contains data on the vertices of a surface."""
    image = _image(data)
    if any(array.intent in (_POINTS, _TRIANGLES) for array in image.darrays):
        raise InputError("contains a surface, not an overlay: give it as a mesh.")
    overlay = _overlay(image, None)
    if not overlay.values:
        raise InputError("contains no data on vertices: give a file with at least one array.")
    return overlay


def _overlay(image: Any, n: int | None) -> Overlay:
    """Return the arrays of a GIFTI file with n rows. None means the number of rows of the first array."""
    values: dict[str, np.ndarray] = {}
    labels: dict[str, LabelTable] = {}
    notes: list[str] = []
    if any(array.intent == _NODE_INDEX for array in image.darrays):
        raise InputError(
            "contains values for some vertices only (NODE_INDEX): write a value for every vertex, for "
            "example with ConvertDset -pad_to_node of SUMA."
        )
    for array in image.darrays:
        if array.intent in (_POINTS, _TRIANGLES):
            continue
        numbers = array.data[:, 0] if array.data.shape[1:] == (1,) else array.data
        n = len(numbers) if n is None else n
        # mris_convert writes the path of the file as name.
        stated = (array.meta.get("Name") or "").strip().rsplit("/")[-1]
        name = unique_name(stated or _NAMES.get(array.intent, "data"), values)
        if len(numbers) != n or numbers.ndim > 2:
            notes.append(f"The array {name!a} was left out, because it does not have one row per vertex.")
            continue
        if _COLORS.get(array.intent) == width_of(numbers) and numbers.dtype.kind == "f":
            name = unique_name(COLORS, values)
        table = image.labeltable.labels if array.intent == _LABEL else []
        if table and numbers.ndim == 1 and numbers.dtype.kind in "iu":
            numbers, labels[name] = _labels(numbers.astype(np.int64), table)
        values[name] = numbers
    return Overlay(values, labels, notes=tuple(notes))


def _labels(numbers: Int64[np.ndarray, " n"], table: list[Any]) -> tuple[Int64[np.ndarray, " n"], LabelTable]:
    """Return labels as rows of a table, which also has a row for each number that the file's table lacks."""
    of_key = {int(label.key): label for label in table}
    listed = np.array(list(of_key))
    keys = np.concatenate([listed, np.setdiff1d(numbers, listed)])
    names = [str(key) for key in keys.tolist()]
    names[: len(of_key)] = [(label.label or "").strip() or str(key) for key, label in of_key.items()]
    colors = np.zeros((len(keys), 4))
    colors[: len(of_key)] = [[part or 0.0 for part in label.rgba] for label in of_key.values()]
    has_colors = bool(np.isfinite(colors).all() and (colors[:, :3] > 0).any())
    found = LabelTable(tuple(names), keys, np.clip(colors, 0, 1) if has_colors else None)
    return _rows_in(keys, numbers), found


def _image(data: bytes) -> Any:
    """Return nibabel's image of a GIFTI file, after the sizes of its arrays are checked."""
    gifti = _nibabel("gifti")
    _check_gifti(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about a wrong number of arrays, and old versions
            image = gifti.GiftiImage.from_bytes(data)
        arrays = [array.data for array in image.darrays]
        if any(array is None or array.dtype.kind not in "iuf" or not array.ndim for array in arrays):
            raise ValueError
    except Exception:  # nibabel can raise any exception for damaged files
        raise export_again("is not a complete GIFTI file", "surface") from None
    return image


def _check_gifti(data: bytes) -> None:
    """Refuse files that refer to other files, and arrays that unpack to more memory than is permitted."""
    budget = largest_contents(len(data))
    try:
        refuse_entities(data)
        for array in ElementTree.fromstring(data).iter("DataArray"):
            encoding = array.get("Encoding", "")
            if encoding in ("ExternalFileBinary", "GIFTI_ENCODING_EXTBIN"):
                raise InputError(
                    "stores its numbers in another file: write a single file, for example with mris_convert "
                    "or wb_command -gifti-convert."
                )
            if encoding in ("GZipBase64Binary", "GIFTI_ENCODING_B64GZ"):
                for packed in array.iter("Data"):
                    content = base64.b64decode("".join(packed.itertext()))
                    budget -= len(zlib.decompressobj().decompress(content, max(budget, 1) + 1))
            if budget < 0:
                raise InputError("would take more than 1 GiB of memory: decimate the surface.")
    except InputError:
        raise
    except Exception:  # XML, base64 and zlib raise different exceptions
        raise export_again("is not a complete GIFTI file", "surface") from None


def _nibabel(module: str) -> ModuleType:
    try:
        import nibabel
    except ImportError:
        raise InputError(
            "files of brains need the package nibabel: run pip install 'jaxsmw[brain]', or convert the "
            "surface, for example with mris_convert to .vtk."
        ) from None
    return nibabel.gifti if module == "gifti" else nibabel.freesurfer


def format_gifti(data: MeshData) -> Formatted:
    """Format a surface and its vertex data, with numbers of the types uint8, int32 and float32."""
    gifti = _nibabel("gifti")
    image = gifti.GiftiImage()
    _add(gifti, image, data.mesh.vertices.astype(np.float32), _POINTS)
    _add(gifti, image, data.faces.astype(np.int32), _TRIANGLES)
    labels = {
        name: LabelTable(names, np.arange(len(names)))
        for name, names in data.label_names.items()
        if name in data.vertex_data
    }
    names = _add_overlay(gifti, image, Overlay(data.vertex_data, labels))
    notes = omissions(
        data,
        "GIFTI",
        vertex_data=lambda _, values: _compact(values) is not None,
        label_names=lambda name, _: name in names,
    )
    return image.to_bytes(), notes


def format_gifti_overlay(overlay: Overlay) -> Formatted:
    gifti = _nibabel("gifti")
    image = gifti.GiftiImage()
    names = _add_overlay(gifti, image, overlay)
    notes = [
        f"GIFTI files cannot hold the numbers {name!a}, so the file does not contain them."
        for name, values in overlay.values.items()
        if _compact(values) is None
    ]
    notes += [
        f"The names of the labels {name!a} are not in the file, because a GIFTI file has only one table of "
        "labels."
        for name in overlay.labels
        if name not in names
    ]
    return image.to_bytes(), tuple(notes)


def _add_overlay(gifti: Any, image: Any, overlay: Overlay) -> list[str]:
    """Add arrays to a GIFTI file. Return the names of the arrays of labels, which must share one table."""
    labeled: list[str] = []
    for name, given in overlay.values.items():
        values, table = _compact(given), overlay.labels.get(name)
        if table is not None and overlay.labels[labeled[0] if labeled else name].names == table.names:
            labeled.append(name)
            _add(gifti, image, overlay.labels[labeled[0]].keys[given].astype(np.int32), _LABEL, name)
        elif values is not None:
            intent = _SHAPE if values.dtype.kind == "f" and values.ndim == 1 else _NONE
            _add(gifti, image, values, _VECTOR if name == NORMALS else intent, name)
    if labeled:
        table = overlay.labels[labeled[0]]
        colors = _distinct_colors(len(table.names)) if table.colors is None else table.colors
        for row, key in enumerate(table.keys.tolist()):
            label = gifti.GiftiLabel(key, *colors[row].tolist())
            label.label = table.names[row]
            image.labeltable.labels.append(label)
    return labeled


def _add(gifti: Any, image: Any, values: np.ndarray, intent: int, name: str = "") -> None:
    kind = _TYPES[values.dtype.str[1:]]
    meta = gifti.GiftiMetaData({"Name": name} if name else {})
    image.add_gifti_data_array(
        gifti.GiftiDataArray(np.ascontiguousarray(values), intent=intent, datatype=kind, meta=meta)
    )


def _compact(values: np.ndarray) -> np.ndarray | None:
    """Return numbers in a type of GIFTI files; None if they do not fit."""
    if values.dtype.kind == "f":
        with np.errstate(over="ignore"):
            single = values.astype(np.float32)
        return single if (np.isfinite(single) == np.isfinite(values)).all() else None
    if values.dtype == np.uint8:
        return values
    limits = np.iinfo(np.int32)
    return values.astype(np.int32) if ((values >= limits.min) & (values <= limits.max)).all() else None


def parse_surface(data: bytes) -> Polygons:
    """Parse a surface of FreeSurfer, such as `lh.pial`. The unit of its positions is the millimetre."""
    vertices, faces = _read(data, lambda freesurfer, path: freesurfer.read_geometry(path), "surface")
    return Polygons(vertices.astype(np.float64), faces.astype(np.int64).ravel(), np.full(len(faces), 3))


def format_surface(data: MeshData) -> Formatted:
    """Format a surface of FreeSurfer, with float32 positions."""
    content = _written(
        lambda freesurfer, path: freesurfer.write_geometry(
            path, data.mesh.vertices, data.faces, create_stamp="created by jaxsmw"
        )
    )
    return content, omissions(data, "FreeSurfer")


def parse_annotation(data: bytes) -> Overlay:
    """Parse an `.annot` file of FreeSurfer: one label per vertex, with names and colours."""
    _check_annotation(data)
    ids, table, names = _read(
        data, lambda freesurfer, path: freesurfer.read_annot(path, orig_ids=True), "labels"
    )
    if len(table) != len(names):  # a table with gaps has empty rows
        table = table[table[:, :4].any(axis=1)]
    if len(table) != len(names) or not names:
        raise InputError(
            "has a table of labels with gaps: convert the file to .label.gii with mris_convert --annot."
        )
    labels = _rows_in(table[:, 4].astype(np.int64), ids.astype(np.int64))
    colors = np.column_stack([table[:, :3] / 255, 1 - table[:, 3] / 255])
    texts = [name.decode("utf-8", "replace").strip("\0 ") or str(i) for i, name in enumerate(names)]
    if (labels < 0).any():
        labels = np.where(labels < 0, len(texts), labels)
        texts, colors = [*texts, _NO_LABEL], np.vstack([colors, np.zeros((1, 4))])
    found = LabelTable(tuple(texts), np.arange(len(texts)), np.clip(colors, 0, 1))
    return Overlay({"label": labels}, {"label": found})


def _check_annotation(data: bytes) -> None:
    """Check the declared lengths of the labels, of their table and of all names."""
    at = 0

    def integer() -> int:
        nonlocal at
        at += 4
        return struct.unpack_from(">i", data, at - 4)[0]

    def skip(length: int) -> None:
        nonlocal at
        if not 0 <= length <= len(data) - at:
            raise ValueError
        at += length

    try:
        skip(8 * integer())
        has_table, version = integer(), integer()
        rows = integer() if version < 0 else version
        skip(integer())
        entries = integer() if version < 0 else rows
        if not has_table or not 0 < entries <= rows <= _MOST_LABELS:
            raise ValueError
        for _ in range(entries):
            at += 4 * (version < 0)
            skip(integer())
            at += 16
        skip(0)
    except (ValueError, struct.error):
        raise export_again(
            "is not a complete annotation of FreeSurfer with a table of labels", "labels"
        ) from None


def _rows_in(table: Int64[np.ndarray, " k"], numbers: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Return the row of a table that contains each number; -1 if there is none."""
    order = np.argsort(table, kind="stable")
    at = order[np.minimum(np.searchsorted(table[order], numbers), len(table) - 1)]
    return np.where(table[at] == numbers, at, -1)


def format_annotation(overlay: Overlay) -> Formatted:
    """Format labels as an annotation of FreeSurfer, in which each label needs its own colour."""
    if len(overlay.values) != 1 or len(overlay.labels) != 1:
        raise InputError(
            ".annot files hold one array of labels with names: choose a name that ends in .func.gii or "
            ".label.gii."
        )
    (labels,), (found,) = overlay.values.values(), overlay.labels.values()
    colors = _distinct_colors(len(found.names)) if found.colors is None else found.colors
    table = np.rint(255 * np.column_stack([colors[:, :3], 1 - colors[:, 3]])).astype(np.int32)
    if len(np.unique(table[:, :3], axis=0)) != len(table):
        raise InputError(
            "two labels have the same colour, and .annot files tell labels apart by their colours: choose a "
            "name that ends in .label.gii."
        )
    encoded = [text.encode() for text in found.names]
    content = _written(
        lambda freesurfer, path: freesurfer.write_annot(path, labels.astype(np.int32), table, encoded)
    )
    return content, ()


def _distinct_colors(count: int) -> np.ndarray:
    """Return colours (count, 4), from 0 to 1, that differ in their first three columns."""
    # The factor is odd, so numbers below 2^24 stay distinct.
    mixed = (np.arange(1, count + 1) * 0x9E3779B1) % 2**24
    return np.column_stack([mixed >> 16, mixed >> 8 & 255, mixed & 255, np.full(count, 255)]) / 255


def parse_morphometry(data: bytes) -> Overlay:
    """Parse a file of FreeSurfer with one number per vertex, such as `lh.curv` and `lh.thickness`."""
    if not data.startswith(b"\xff\xff\xff"):
        raise InputError(
            "is neither a GIFTI overlay (.gii), an annotation (.annot) nor a file of FreeSurfer with one "
            "number per vertex: convert it with mris_convert, or a CIFTI file with wb_command "
            "-cifti-separate."
        )
    values = _read(data, lambda freesurfer, path: freesurfer.read_morph_data(path), "numbers")
    if len(values) != int.from_bytes(data[3:7], "big") or not len(values):
        raise export_again("ends early, or contains no numbers", "overlay")
    return Overlay({"value": values.astype(np.float32)})


def format_morphometry(overlay: Overlay) -> Formatted:
    if len(overlay.values) != 1 or next(iter(overlay.values.values())).ndim != 1:
        raise InputError(
            "files of FreeSurfer hold one number per vertex: choose a name that ends in .func.gii or "
            ".label.gii."
        )
    (values,) = overlay.values.values()
    content = _written(lambda freesurfer, path: freesurfer.write_morph_data(path, values))
    note = "Files of FreeSurfer with one number per vertex cannot hold the names of labels."
    return content, (note,) if overlay.labels else ()


def _read(data: bytes, read: Callable[[Any, Path], Any], what: str) -> Any:
    """Let nibabel read a file of FreeSurfer. nibabel needs a file with a name."""
    freesurfer = _nibabel("freesurfer")
    with TemporaryDirectory() as folder:
        path = Path(folder, "file")
        path.write_bytes(data)
        try:
            return read(freesurfer, path)
        except Exception:  # nibabel can raise any exception for damaged files
            raise export_again("is not a complete file of FreeSurfer", what) from None


def _written(write: Callable[[Any, Path], None]) -> bytes:
    freesurfer = _nibabel("freesurfer")
    with TemporaryDirectory() as folder:
        path = Path(folder, "file")
        write(freesurfer, path)
        return path.read_bytes()
