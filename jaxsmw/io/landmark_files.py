"""Reader and writer of landmark files: named points in the formats of 3D Slicer, MeshLab, MITK and tables.

jaxsmw has its own readers, because other libraries read these formats without checks. A damaged file must
cause one clear error message, and a coordinate system must not be guessed.
"""

from __future__ import annotations

import codecs
import os
from collections.abc import Callable
from pathlib import Path

from jaxsmw.errors import InputError
from jaxsmw.io.landmark_entries import Entries, check_count
from jaxsmw.io.landmark_tables import format_fcsv, format_table, parse_fcsv, parse_table
from jaxsmw.io.landmarks import Landmarks
from jaxsmw.io.markups_files import format_markups, parse_markups
from jaxsmw.io.point_xml import format_picked_points, parse_picked_points, parse_point_set
from jaxsmw.runtime.files import atomic_write, read_bytes, size_of_file

_PARSERS: dict[str, Callable[[str], Entries]] = {
    ".mrk.json": parse_markups,
    ".fcsv": parse_fcsv,
    ".pp": parse_picked_points,
    ".mps": parse_point_set,
    ".csv": parse_table,
    ".txt": parse_table,
}
_WRITERS: dict[str, Callable[[Landmarks], str]] = {
    ".mrk.json": format_markups,
    ".fcsv": format_fcsv,
    ".pp": format_picked_points,
    ".csv": lambda landmarks: format_table(landmarks, ","),
    ".txt": lambda landmarks: format_table(landmarks, "\t"),
}
LANDMARK_SUFFIXES = tuple(suffix for suffix, parse in _PARSERS.items() if parse is not parse_table)
"""The suffixes of files that certainly contain named points. Many tables contain something else."""
# Files of these formats always state a coordinate system.
_WITH_SYSTEM = (".mrk.json", ".fcsv")

# The largest size of a file in bytes: 128 MiB, about a million lines. A JSON file needs up to 25 times its
# size in memory, so its largest size is 32 MiB. A file of this size contains 50 000 points of Slicer.
_LARGEST, _LARGEST_JSON = 2**27, 2**25


def read_landmark_file(path: str | os.PathLike[str]) -> Landmarks:
    """Read the landmarks of one mesh from a file.

    The file is text in UTF-8. If a landmark has no name, its 1-based number in the file becomes its name.

    **Arguments:**

    - `path`: the file. The suffix, in upper or lower case, determines the format:
        - `.mrk.json`: a Markups file of 3D Slicer with a single point list. A file with several markups is
          refused. If the file states no coordinate system, the default of the format applies, which is LPS.
        - `.fcsv`: a file of 3D Slicer. The coordinate system 0 is RAS, and the coordinate system 1 is LPS.
        - `.pp`: a file of MeshLab (PickedPoints).
        - `.mps`: a point set of MITK, whose world coordinates are LPS.
        - `.csv`, `.txt`: a table with the columns name, x, y and z, or x, y and z. Semicolons, tabs, commas
          or blanks separate the columns. The first line may name the columns, and then their order is free.

    **Returns:** `Landmarks` with l names and positions (l, 3) as in the file. The `name` is the path. The
    attribute `coordinates` is `"LPS"`, `"RAS"` or None. The `unit` is the unit that a `.mrk.json` file
    states, or None. Points are left out if Slicer has no defined position for them, or if they are not active
    in MeshLab. The `notes` report these points, a missing coordinate system in a file of Slicer, and an
    ignored unit.

    **Raises:** `InputError` if the file cannot be read, does not have the format of its suffix, or is larger
    than 128 MiB (`.mrk.json`: 32 MiB). `InputError` is also raised if the file contains no landmarks or more
    than 2²⁰ landmarks, if a coordinate is not finite, or if two landmarks have the same name.
    """
    suffix = check_readable_suffix(path)
    _check_size(path, size_of_file(path), suffix)
    data = read_bytes(path)
    try:
        return _PARSERS[suffix](_decode(data)).landmarks(str(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def write_landmark_file(path: str | os.PathLike[str], landmarks: Landmarks) -> None:
    """Write landmarks to a file. Reading the file returns exactly the same names and positions.

    The write is atomic: an incomplete file never appears at `path`.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix determines the format: `.mrk.json` or `.fcsv` for
      3D Slicer, `.pp` for MeshLab, `.csv` for a table with commas, or `.txt` for a table with tabs.
    - `landmarks`: `Landmarks`. Files of Slicer state their coordinate system. Files of the format `.mrk.json`
      also state their unit if it is known. Files in the other formats cannot state a coordinate system, so
      their readers must know the coordinate system.

    **Raises:** `InputError` for another suffix, for a file that cannot be written, or for more landmarks or
    bytes than `read_landmark_file` accepts. For files of Slicer, `InputError` is also raised if the
    coordinate system of the landmarks is None.
    """
    suffix = check_landmark_suffix(path)
    check_known_system(path, landmarks)
    try:
        check_count(len(landmarks))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    data = _WRITERS[suffix](landmarks).encode("utf-8")
    _check_size(path, len(data), suffix)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def check_landmark_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a landmark file to be written, in lower case.

    **Raises:** `InputError` if landmarks cannot be written in the format of the suffix.
    """
    return _suffix(path, list(_WRITERS))


def check_readable_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a landmark file to be read, in lower case.

    **Raises:** `InputError` if landmarks cannot be read in the format of the suffix.
    """
    return _suffix(path, list(_PARSERS))


def check_known_system(path: str | os.PathLike[str], landmarks: Landmarks) -> None:
    """Check that landmarks have a coordinate system if they are to be written to a file of 3D Slicer.

    **Raises:** `InputError` if the suffix is `.mrk.json` or `.fcsv`, and `landmarks.coordinates` is None.
    """
    suffix = check_landmark_suffix(path)
    if landmarks.coordinates is None and suffix in _WITH_SYSTEM:
        raise InputError(
            f"{path}: {suffix} files state a coordinate system, but the one of {landmarks.name} is not "
            "known: state LPS or RAS (--coordinates), or write a .csv file."
        )


def _suffix(path: str | os.PathLike[str], known: list[str]) -> str:
    """Return the suffix of a landmark file, in lower case."""
    name = Path(path).name
    for suffix in known:
        if name.lower().endswith(suffix):
            return suffix
    raise InputError(
        f"{path}: the suffix {Path(path).suffix!r} is not supported for this landmark file: choose one of "
        f"{', '.join(known)}."
    )


def _check_size(path: str | os.PathLike[str], size: int, suffix: str) -> None:
    """Refuse files that are too large for a file of landmarks. The size is in bytes."""
    largest = _LARGEST_JSON if suffix == ".mrk.json" else _LARGEST
    if size > largest:
        raise InputError(
            f"{path}: is larger than {largest >> 20} MiB, the largest size of a {suffix} file of landmarks: "
            "give fewer landmarks."
        )


def _decode(data: bytes) -> str:
    """Decode the text of a file in UTF-8, with or without a byte order mark."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError("is text in UTF-16: save the file in UTF-8.")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not text in UTF-8 (byte {error.start} is not valid): save the file in UTF-8."
        ) from None
    if "\0" in text:
        raise InputError("contains null characters, so it is not a text file: give a file of landmarks.")
    if not text.strip():
        raise InputError("is empty: give a file with at least one landmark.")
    return text
