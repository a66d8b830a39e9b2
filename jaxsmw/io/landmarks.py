"""Landmarks: named points on one mesh, their files, their coordinate system, and their distance to the mesh.

jaxsmw has its own readers of landmark files, because other libraries read these formats without checks. A
damaged file must cause one clear error message, and a coordinate system must not be guessed.
"""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxsmw.choices import CoordinateSystem
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.mesh import LARGEST_EXTENT, Mesh
from jaxsmw.geometry.surface_distance import bounding_box_diagonal, distances_to_surface
from jaxsmw.io.formats.text import is_number
from jaxsmw.runtime.files import atomic_write, read_bytes, size_of_file
from jaxsmw.wording import count_of

# Limits for the mean distance from landmarks to the surface, as fractions of the diagonal of the box around
# the mesh. Landmarks whose mean distance is above `FAR` may be in the wrong coordinate system. The mean
# distance of landmarks in the right coordinate system is below `NEAR` in all data sets. If the median
# distance is above `ELSEWHERE`, the landmarks have another unit, or belong to another mesh.
FAR, NEAR, ELSEWHERE = 0.05, 0.02, 0.03
# The factors between usual units of length: metres, centimetres, inches, millimetres and micrometres.
_UNITS = tuple(factor for unit in (1000.0, 100.0, 10.0, 25.4, 1e6) for factor in (unit, 1 / unit))

# Control characters, line separators, and characters that UTF-8 or XML cannot represent.
_NOT_IN_NAMES = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufffe\uffff]")
_NOT_IN_NUMBERS = re.compile(r"[^0-9+\-.eE\n]")

# The functions that parse and format each kind of file, in modules of `jaxsmw.io.formats`.
_PARSERS = {
    ".mrk.json": "markups.parse_markups",
    ".fcsv": "landmark_tables.parse_fcsv",
    ".pp": "landmark_xml.parse_picked_points",
    ".mps": "landmark_xml.parse_point_set",
    ".csv": "landmark_tables.parse_table",
    ".txt": "landmark_tables.parse_table",
}
_FORMATTERS = {
    ".mrk.json": "markups.format_markups",
    ".fcsv": "landmark_tables.format_fcsv",
    ".pp": "landmark_xml.format_picked_points",
    ".csv": "landmark_tables.format_csv",
    ".txt": "landmark_tables.format_txt",
}
LANDMARK_SUFFIXES = (".mrk.json", ".fcsv", ".pp", ".mps")
"""The suffixes of files that certainly contain named points. Many tables contain something else."""
# Files of these formats always state a coordinate system.
_WITH_SYSTEM = (".mrk.json", ".fcsv")
SYSTEMS: dict[str, CoordinateSystem] = {"LPS": "LPS", "1": "LPS", "RAS": "RAS", "0": "RAS"}
"""The names of coordinate systems in files of 3D Slicer, which used numbers before version 4.11."""

# The largest size of a file in bytes: 128 MiB, about a million lines. A JSON file needs up to 25 times its
# size in memory, so its largest size is 32 MiB. A file of this size contains 50 000 points of Slicer.
_LARGEST, _LARGEST_JSON = 2**27, 2**25
# The largest number of landmarks in a file, so that no file can use gigabytes of memory.
_MOST_LANDMARKS = 2**20


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Named points on one mesh.

    **Attributes:**

    - `names`: l different names, in the order of the file. A name is one line of text that neither begins nor
      ends with a blank.
    - `positions`: positions (l, 3), float64, in the unit and the coordinate system of the file.
    - `coordinates`: the coordinate system, `"LPS"` or `"RAS"`, or None if the file does not state one.
    - `name`: the name of the landmarks in messages. The name of landmarks from a file is the file's path.
    - `notes`: a tuple of sentences about points that were left out, and about what the file does not state.
    - `unit`: the unit of length that the file states, such as `"mm"`, or None if the file does not state one.
      Only `.mrk.json` files state a unit. No method converts positions to another unit.

    **Raises:** `InputError` if there are no landmarks, or if the positions are not an array (l, 3).
    `InputError` is also raised if a name is empty, repeated or not one line of text, or if a coordinate is
    above 1e60 or not finite.
    """

    names: tuple[str, ...]
    positions: Float64[np.ndarray, "l 3"]
    coordinates: CoordinateSystem | None = None
    name: str = "landmarks"
    notes: tuple[str, ...] = ()
    unit: str | None = None

    def __post_init__(self) -> None:
        try:
            if self.coordinates is not None:
                check_choice(self.coordinates, CoordinateSystem, "a coordinate system")
            _check_points(self.names, self.positions, lambda i: f"landmark {i + 1}")
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from None

    def __len__(self) -> int:
        return len(self.names)

    def flipped(self) -> Landmarks:
        """Return the landmarks in the other coordinate system: the signs of x and y are reversed.

        LPS becomes RAS, and RAS becomes LPS. An unknown coordinate system stays unknown.
        """
        other: dict[str | None, CoordinateSystem | None] = {"LPS": "RAS", "RAS": "LPS", None: None}
        positions = np.stack([-self.positions[:, 0], -self.positions[:, 1], self.positions[:, 2]], axis=1)
        return replace(self, positions=positions, coordinates=other[self.coordinates])

    def in_coordinates(self, coordinates: CoordinateSystem) -> Landmarks:
        """Return the landmarks in a coordinate system, `"LPS"` or `"RAS"`.

        **Raises:** `InputError` if the coordinate system of the landmarks is not known.
        """
        check_choice(coordinates, CoordinateSystem, "a coordinate system")
        if self.coordinates is None:
            raise InputError(
                f"{self.name}: the coordinate system of the landmarks is not known, so they cannot be "
                f"converted to {coordinates}: use them as they are, or state their coordinate system."
            )
        return self if self.coordinates == coordinates else self.flipped()

    def stated(self, coordinates: CoordinateSystem) -> Landmarks:
        """Return landmarks with the same positions and the coordinate system `coordinates`.

        Use this method if the file of the landmarks does not state a coordinate system.

        **Raises:** `InputError` if the file states the other coordinate system.
        """
        check_choice(coordinates, CoordinateSystem, "a coordinate system")
        if self.coordinates not in (None, coordinates):
            raise InputError(
                f"{self.name}: states {self.coordinates} coordinates, not {coordinates}: convert the "
                "landmarks."
            )
        return replace(self, coordinates=coordinates)

    def select(self, names: Sequence[str]) -> Landmarks:
        """Return the landmarks with the given names, in the order of the names.

        **Raises:** `InputError` if a name does not exist, or if no name is given.
        """
        row = {name: i for i, name in enumerate(self.names)}
        missing = [name for name in names if name not in row]
        if missing:
            raise InputError(f"{self.name}: no landmark has the name {missing[0][:40]!a}: choose another.")
        return replace(self, names=tuple(names), positions=self.positions[[row[name] for name in names]])


def _check_points(names: Sequence[str], positions: np.ndarray, place: Callable[[int], str]) -> None:
    """Check names and positions. `place` names the place of a landmark in messages."""
    if not names:
        raise InputError("contains no landmarks: give at least one.")
    if positions.shape != (len(names), 3):
        raise InputError(
            f"positions have the shape {positions.shape} instead of ({len(names)}, 3): give one position for "
            "each name."
        )
    wrong = ~_usable(positions).all(axis=1)
    if wrong.any():
        raise InputError(
            f"{place(int(wrong.argmax()))} has a coordinate that is not a finite number below "
            "1e60: correct the position."
        )
    if len(set(names)) == len(names) and not any(map(_fault, names)):
        return
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        if fault := _fault(name):
            raise InputError(f"the name in {place(i)} {fault}: rename the landmark.")
        if (earlier := first.setdefault(name, i)) != i:
            raise InputError(
                f"{place(earlier)} and {place(i)} have the same name {name[:40]!a}: give each landmark its "
                "own name."
            )


def _fault(name: str) -> str:
    """Return what is wrong with the name of a landmark, or an empty string."""
    if not name:
        return "is empty"
    if name != name.strip():
        return "begins or ends with a blank"
    return "contains a line break or another control character" if _NOT_IN_NAMES.search(name) else ""


def _usable(positions: Float64[np.ndarray, "*any"]) -> np.ndarray:
    """Return which coordinates are finite and at most 1e60. The squares of such numbers do not overflow."""
    return np.abs(positions) <= LARGEST_EXTENT


def landmarks_of(
    names: list[str],
    positions: list[str] | Float64[np.ndarray, "l 3"],
    noun: str,
    numbers: Sequence[int],
    **attributes: Any,
) -> Landmarks:
    """Make the landmarks of a file, whose coordinates may still be words, three for each landmark.

    `numbers` contains the place of each landmark in the file, and `noun` says what these numbers count, such
    as lines. Messages contain both. `attributes` are further attributes of `Landmarks`.
    """
    if isinstance(positions, list):
        positions = _parse_positions(positions, noun, numbers)
    _check_points(names, positions, lambda i: f"{noun} {numbers[i]}")
    return Landmarks(tuple(names), positions, **attributes)


def _parse_positions(words: list[str], noun: str, numbers: Sequence[int]) -> Float64[np.ndarray, "l 3"]:
    try:
        # `float` also accepts words that are not decimal numbers, such as `1_0` and `nan`.
        if _NOT_IN_NUMBERS.search("\n".join(words)):
            raise ValueError
        values = np.array(list(map(float, words)), dtype=np.float64)
    except ValueError:
        at = next(i for i, word in enumerate(words) if not is_number(word))
        cure = "write decimals with a point" if "," in words[at] else "correct the number"
        raise InputError(
            f"{noun} {numbers[at // 3]} has {words[at][:40]!a} where a coordinate should be, which is not a "
            f"finite number: {cure}."
        ) from None
    return values.reshape(-1, 3)


def check_count(count: int) -> None:
    """Refuse more than a million landmarks."""
    if count > _MOST_LANDMARKS:
        raise InputError(f"contains more than {_MOST_LANDMARKS} landmarks: give fewer landmarks.")


def left_out(numbers: Sequence[int], total: int, why: str) -> tuple[str, ...]:
    """Return a note with the numbers of the landmarks that were left out, or no note if there are none."""
    if not numbers:
        return ()
    listed = ", ".join(map(str, numbers[:10])) + (", …" if len(numbers) > 10 else "")
    return (f"{len(numbers)} of {count_of(total, 'point')} left out because {why}: number {listed}.",)


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
        landmarks: Landmarks = _function(_PARSERS[suffix])(_decode(data))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return replace(landmarks, name=str(path))


def _function(name: str) -> Any:
    module, _, function = name.partition(".")
    return getattr(import_module(f"jaxsmw.io.formats.{module}"), function)


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
    data = _function(_FORMATTERS[suffix])(landmarks).encode("utf-8")
    _check_size(path, len(data), suffix)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def check_landmark_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a landmark file in lower case; refuse a format that cannot be written."""
    return _suffix(path, list(_FORMATTERS))


def check_readable_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a landmark file in lower case; refuse a format that cannot be read."""
    return _suffix(path, list(_PARSERS))


def check_known_system(path: str | os.PathLike[str], landmarks: Landmarks) -> None:
    """Refuse to write landmarks without a coordinate system to a file of 3D Slicer."""
    suffix = check_landmark_suffix(path)
    if landmarks.coordinates is None and suffix in _WITH_SYSTEM:
        raise InputError(
            f"{path}: {suffix} files state a coordinate system, but the one of {landmarks.name} is not "
            "known: state LPS or RAS (--coordinates), or write a .csv file."
        )


def _suffix(path: str | os.PathLike[str], known: list[str]) -> str:
    name = Path(path).name
    for suffix in known:
        if name.lower().endswith(suffix):
            return suffix
    raise InputError(
        f"{path}: the suffix {Path(path).suffix!r} is not supported for this landmark file: choose one of "
        f"{', '.join(known)}."
    )


def _check_size(path: str | os.PathLike[str], size: int, suffix: str) -> None:
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


class LandmarkMatch(NamedTuple):
    """The result of `match_landmarks`.

    **Attributes:**

    - `names`: a tuple of the names in both sets of landmarks, in the order of the first set.
    - `only_first`: a tuple of the names in the first set only, in the order of the first set.
    - `only_second`: a tuple of the names in the second set only, in the order of the second set.
    """

    names: tuple[str, ...]
    only_first: tuple[str, ...]
    only_second: tuple[str, ...]


def match_landmarks(first: Landmarks, second: Landmarks) -> LandmarkMatch:
    """Match the landmarks of two meshes by their names.

    **Arguments:**

    - `first`, `second`: the `Landmarks` of two meshes.

    **Returns:** A `LandmarkMatch` with the attributes `names`, `only_first` and `only_second`, each a tuple.
    Pass `names` to `Landmarks.select` to bring the landmarks of both meshes into the same order.

    **Raises:** `InputError` if the landmarks have no common name. Names that differ in case are different.
    """
    in_first, in_second = set(first.names), set(second.names)
    common = tuple(name for name in first.names if name in in_second)
    if not common:
        raise InputError(
            f"{first.name}: has no landmark with the name of a landmark of {second.name} "
            f"({first.names[0][:40]!a} and {second.names[0][:40]!a} come first): give equal names to "
            "corresponding landmarks."
        )
    return LandmarkMatch(
        names=common,
        only_first=tuple(name for name in first.names if name not in in_second),
        only_second=tuple(name for name in second.names if name not in in_first),
    )


class FrameDistances(NamedTuple):
    """The result of `find_frame`, in the unit of the mesh.

    **Attributes:**

    - `as_read`: the mean distance from the landmarks to the surface, a float.
    - `flipped`: the mean distance from the flipped landmarks (`Landmarks.flipped`) to the surface, a float.
    """

    as_read: float
    flipped: float


def find_frame(landmarks: Landmarks, mesh: Mesh) -> FrameDistances:
    """Measure how far landmarks are from a surface, with and without reversed signs of x and y.

    A change between the coordinate systems LPS and RAS reverses these signs.

    **Arguments:**

    - `landmarks`: `Landmarks` in the unit of the mesh.
    - `mesh`: the `Mesh` to which the landmarks belong.

    **Returns:** `FrameDistances` with the attributes `as_read` and `flipped`. Each is the mean distance from
    the landmarks to the nearest points of the surface, a float in the unit of the mesh.
    """
    as_read, flipped = (
        float(distances_to_surface(points.positions, mesh).mean())
        for points in (landmarks, landmarks.flipped())
    )
    return FrameDistances(as_read, flipped)


def check_frame(landmarks: Landmarks, mesh: Mesh) -> tuple[str, ...]:
    """Check that landmarks lie on a surface as they are, without a conversion between LPS and RAS.

    **Arguments:**

    - `landmarks`: `Landmarks` in the unit of the mesh.
    - `mesh`: the `Mesh` to which the landmarks belong.

    **Returns:** A tuple with a sentence for each landmark whose distance to the surface is above 2 % of the
    diagonal of the box around the mesh.

    **Raises:** `InputError` if the median distance of the landmarks to the surface is above 3 % of the
    diagonal. `InputError` is also raised if their mean distance is above 5 % of the diagonal, but would be
    below 2 % in the other coordinate system. If the landmarks seem to have another unit, the message
    names the factor between the units.
    """
    diagonal = bounding_box_diagonal(mesh)
    distances = distances_to_surface(landmarks.positions, mesh)
    as_read = float(distances.mean())
    if as_read > FAR * diagonal:
        flipped = find_frame(landmarks, mesh).flipped
        if flipped < NEAR * diagonal:
            raise InputError(_flip_message(landmarks, mesh, as_read, flipped))
    if (usual := float(np.median(distances))) > ELSEWHERE * diagonal:
        raise InputError(
            f"{landmarks.name}: the median distance of the landmarks to the surface of {mesh.name} is "
            f"{usual:.3g}, but its diagonal is {diagonal:.3g}: {_cure_of_unit(landmarks, mesh, diagonal)}."
        )
    return tuple(
        f"{landmarks.name}: the landmark {landmarks.names[i]!a} is {distances[i]:.3g} from the surface of "
        f"{mesh.name}, which is {100 * distances[i] / diagonal:.3g} % of the diagonal of the mesh."
        for i in np.flatnonzero(distances > NEAR * diagonal).tolist()
    )


def _cure_of_unit(landmarks: Landmarks, mesh: Mesh, diagonal: float) -> str:
    """Return the advice for landmarks far from a surface, with a conversion factor if the unit is wrong."""
    for factor in _UNITS:
        scaled = factor * landmarks.positions
        if _usable(scaled).all() and distances_to_surface(scaled, mesh).mean() < NEAR * diagonal:
            return f"multiply the positions by {factor:.4g}, which converts them to the unit of the mesh"
    return "give landmarks of this mesh, in its unit and coordinates"


def _flip_message(landmarks: Landmarks, mesh: Mesh, as_read: float, flipped: float) -> str:
    """Return the message for landmarks in the wrong coordinate system. Distances have the mesh's unit."""
    here, other = landmarks.coordinates, landmarks.flipped().coordinates
    change = f"after a change from {here} to {other}" if other else "with the signs of x and y reversed"
    cure = f"give --coordinates {other}" if other else "reverse the signs of x and y in the file"
    return (
        f"{landmarks.name}: the landmarks are on average {as_read:.3g} from the surface of {mesh.name} as "
        f"read, and {flipped:.3g} {change}: {cure}."
    )
