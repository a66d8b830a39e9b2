"""Readers and writers of landmark files, and the table of their formats.

jaxsmw has its own readers of landmark files, because other libraries read these formats without checks. A
damaged file must cause one clear error message, and a coordinate system must not be guessed.
"""

from __future__ import annotations

import codecs
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

from jaxsmw.errors import InputError, naming
from jaxsmw.io.formats.landmark_tables import format_csv, format_fcsv, format_txt, parse_fcsv, parse_table
from jaxsmw.io.formats.landmark_xml import format_picked_points, parse_picked_points, parse_point_set
from jaxsmw.io.formats.markups import format_markups, parse_markups
from jaxsmw.io.formats.morphometrics import (
    format_nts,
    format_pts,
    format_scalismo,
    format_tps,
    parse_nts,
    parse_pts,
    parse_scalismo,
    parse_tps,
    words_of,
)
from jaxsmw.io.landmarks import Landmarks, check_count
from jaxsmw.runtime.files import atomic_write, read_bytes, size_of_file


class _Format(NamedTuple):
    """The functions that parse and format a kind of file. `format` is None if it can only be read.

    `is_for_landmarks` is False for tables, which often contain something else. `states_system` is True if
    the files always state a coordinate system. `largest` is the largest size of a file in bytes. `names` says
    which names of landmarks the files can hold.
    """

    parse: Callable[[str], Landmarks]
    format: Callable[[Landmarks], str] | None
    is_for_landmarks: bool = True
    states_system: bool = False
    largest: int = 2**27  # about a million lines
    names: Literal["all", "words", "none"] = "all"


_FORMATS = {
    # JSON needs up to 25 times its size in memory. A file of 32 MiB contains 50 000 points of Slicer.
    ".mrk.json": _Format(parse_markups, format_markups, states_system=True, largest=2**25),
    ".fcsv": _Format(parse_fcsv, format_fcsv, states_system=True),
    ".pp": _Format(parse_picked_points, format_picked_points),
    ".mps": _Format(parse_point_set, None),
    ".tps": _Format(parse_tps, format_tps, names="none"),
    ".nts": _Format(parse_nts, format_nts, names="words"),
    ".pts": _Format(parse_pts, format_pts, names="words"),
    ".json": _Format(parse_scalismo, format_scalismo, is_for_landmarks=False, largest=2**25),
    ".csv": _Format(parse_table, format_csv, is_for_landmarks=False),
    ".txt": _Format(parse_table, format_txt, is_for_landmarks=False),
}
LANDMARK_SUFFIXES = tuple(suffix for suffix, kind in _FORMATS.items() if kind.is_for_landmarks)
"""The suffixes of files that certainly contain named points."""


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
        - `.tps`: a file of tpsDig or geomorph with one specimen. Its landmarks have no names.
        - `.nts`: an NTSYS matrix with a row for each landmark, or one row for all landmarks of a specimen.
        - `.pts`: a file of IDAV Landmark, or of a face with three coordinates per point.
        - `.json`: a list of landmarks of Scalismo.
        - `.csv`, `.txt`: a table with the columns name, x, y and z, or x, y and z. Semicolons, tabs, commas
          or blanks separate the columns. The first line may name the columns, and then their order is free.

    **Returns:** `Landmarks` with l names and positions (l, 3) as in the file. Points are left out if Slicer
    has no defined position for them, if they are not active in MeshLab, or if a `.tps`, `.nts` or `.pts` file
    marks them as missing. The `notes` report these points, a missing coordinate system in a file of Slicer,
    and an ignored unit.

    **Raises:** `InputError` if the file cannot be read, does not have the format of its suffix, or is larger
    than 128 MiB (`.mrk.json`: 32 MiB). `InputError` is also raised if the file contains no landmarks or more
    than 2²⁰ landmarks, if a coordinate is not finite, or if two landmarks have the same name.
    """
    suffix = check_readable_suffix(path)
    _check_size(path, size_of_file(path), suffix)
    data = read_bytes(path)
    with naming(path):
        landmarks = _FORMATS[suffix].parse(_decode(data))
    return replace(landmarks, name=str(path))


def write_landmark_file(path: str | os.PathLike[str], landmarks: Landmarks) -> tuple[str, ...]:
    """Write landmarks to a file. Reading the file returns exactly the same names and positions.

    There are two exceptions: `.tps` files contain no names, and `.nts` and `.pts` files contain underscores
    in place of blanks in names.

    The write is atomic: an incomplete file never appears at `path`. Files of 3D Slicer state their coordinate
    system. Files of the format `.mrk.json` also state their unit if it is known. Files in the other formats
    cannot state a coordinate system, so their readers must know it.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix determines the format: `.mrk.json` or `.fcsv` for
      3D Slicer, `.pp` for MeshLab, `.tps`, `.nts` or `.pts` for morphometrics, `.json` for Scalismo, `.csv`
      for a table with commas, or `.txt` for a table with tabs.
    - `landmarks`: `Landmarks`.

    **Returns:** A tuple with a sentence about names that the format cannot hold, or an empty tuple.

    **Raises:** `InputError` for another suffix, a file that cannot be written, more landmarks or bytes than
    `read_landmark_file` accepts, or for files of Slicer if the coordinate system is not known.
    """
    check_known_system(path, landmarks)
    suffix = check_landmark_suffix(path)
    with naming(path):
        check_count(len(landmarks))
    write = _FORMATS[suffix].format
    assert write is not None
    data = write(landmarks).encode("utf-8")
    _check_size(path, len(data), suffix)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)
    return _lost_names(landmarks, suffix)


def _lost_names(landmarks: Landmarks, suffix: str) -> tuple[str, ...]:
    """Return a sentence about names that a format cannot hold. Numbers from 1 are what a reader assumes."""
    kind, names = _FORMATS[suffix].names, landmarks.names
    if kind == "none" and names != tuple(str(number + 1) for number in range(len(names))):
        return (f"{suffix} files cannot hold names, so the landmarks are only numbered.",)
    if kind == "words" and tuple(words_of(names)) != names:
        return (f"{suffix} files hold neither blanks nor quotes in names, so the file has underscores.",)
    return ()


def check_readable_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a landmark file in lower case; refuse a format that cannot be read."""
    return _suffix(path, list(_FORMATS))


def check_landmark_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a landmark file in lower case; refuse a format that cannot be written."""
    return _suffix(path, [suffix for suffix, kind in _FORMATS.items() if kind.format is not None])


def _suffix(path: str | os.PathLike[str], suffixes: list[str]) -> str:
    for suffix in suffixes:
        if Path(path).name.lower().endswith(suffix):
            return suffix
    raise InputError(
        f"{path}: the suffix {Path(path).suffix!r} is not supported for this landmark file: choose one of "
        f"{', '.join(suffixes)}."
    )


def check_known_system(path: str | os.PathLike[str], landmarks: Landmarks) -> None:
    """Refuse to write landmarks without a coordinate system to a file of 3D Slicer."""
    suffix = check_landmark_suffix(path)
    if landmarks.coordinates is None and _FORMATS[suffix].states_system:
        raise InputError(
            f"{path}: {suffix} files state a coordinate system, but the one of {landmarks.name} is not "
            'known: set coordinates="LPS" or coordinates="RAS", or write a .csv file.'
        )


def _check_size(path: str | os.PathLike[str], size: int, suffix: str) -> None:
    largest = _FORMATS[suffix].largest
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
