"""Landmarks: named points on one mesh, their coordinate system, and their distance to the mesh."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxsmw.choices import CoordinateSystem
from jaxsmw.errors import InputError, check_choice, naming
from jaxsmw.geometry.mesh import LARGEST_EXTENT, Mesh
from jaxsmw.geometry.surface_distance import bounding_box_diagonal, distances_to_surface
from jaxsmw.io.formats.text import is_number
from jaxsmw.wording import count_of

# Limits for the mean distance from landmarks to the surface, as fractions of the diagonal of the box around
# the mesh. Landmarks whose mean distance is above `_FAR` may be in the wrong coordinate system. The mean
# distance of landmarks in the right coordinate system is below `_NEAR` in all data sets. If the median
# distance is above `_ELSEWHERE`, the landmarks have another unit, or belong to another mesh.
_FAR, _NEAR, _ELSEWHERE = 0.05, 0.02, 0.03
# The factors between usual units of length: metres, centimetres, inches, millimetres and micrometres.
_UNITS = tuple(factor for unit in (1000.0, 100.0, 10.0, 25.4, 1e6) for factor in (unit, 1 / unit))
_OTHER_SYSTEM: dict[str, CoordinateSystem] = {"LPS": "RAS", "RAS": "LPS"}
# The largest number of landmarks in a file, so that no file can use gigabytes of memory.
_MOST_LANDMARKS = 2**20

# Control characters, line separators, and characters that UTF-8 or XML cannot represent.
_NOT_IN_NAMES = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufffe\uffff]")
_NOT_IN_NUMBERS = re.compile(r"[^0-9+\-.eE\n]")


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

    **Raises:** `InputError` if there are no landmarks, the positions are not an array (l, 3), or a coordinate
    is above 1e60 or not finite. `InputError` is also raised if a name is empty, repeated or not one line of
    text.
    """

    names: tuple[str, ...]
    positions: Float64[np.ndarray, "l 3"]
    coordinates: CoordinateSystem | None = None
    name: str = "landmarks"
    notes: tuple[str, ...] = ()
    unit: str | None = None

    def __post_init__(self) -> None:
        with naming(self.name):
            if self.coordinates is not None:
                check_choice(self.coordinates, CoordinateSystem, "a coordinate system")
            _check_points(self.names, self.positions, lambda i: f"landmark {i + 1}")

    def __len__(self) -> int:
        return len(self.names)

    def flipped(self) -> Landmarks:
        """Return the landmarks in the other coordinate system: the signs of x and y are reversed.

        LPS becomes RAS, and RAS becomes LPS. An unknown coordinate system stays unknown.
        """
        other = None if self.coordinates is None else _OTHER_SYSTEM[self.coordinates]
        return replace(self, positions=self.positions * np.array([-1.0, -1.0, 1.0]), coordinates=other)

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
        """Return the same positions with a coordinate system that the file of the landmarks does not state.

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
        if missing := [name for name in names if name not in row]:
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
    usable = _are_usable(positions).all(axis=1)
    if not usable.all():
        raise InputError(
            f"{place(int(usable.argmin()))} has a coordinate that is not a finite number below "
            "1e60: correct the position."
        )
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


def _are_usable(positions: Float64[np.ndarray, "*any"]) -> np.ndarray:
    """Return which coordinates are finite and at most 1e60. The squares of such numbers do not overflow."""
    return np.abs(positions) <= LARGEST_EXTENT


class PointList:
    """The points of a file, which a parser adds in the order of the file.

    `noun` says what the numbers of the points count in messages, such as lines.
    """

    def __init__(self, noun: str) -> None:
        self._noun = noun
        self._names: list[str] = []
        self._numbers: list[int] = []
        self._coordinates: list[str | float] = []
        self._left_out: list[int] = []

    @property
    def next(self) -> int:
        """The 1-based number of the next point."""
        return len(self._numbers) + len(self._left_out) + 1

    def add(self, name: str, position: Sequence[str] | Sequence[float], line: int | None = None) -> None:
        """Add a point whose three coordinates are floats or words. Without a name, its number is its name."""
        self._names.append(name or str(self.next))
        self._numbers.append(line or self.next)
        self._coordinates += position

    def leave_out(self) -> None:
        """Leave the next point out."""
        self._left_out.append(self.next)

    def positions(self) -> Float64[np.ndarray, "l 3"]:
        """Return the positions of all points. Refuse words that are not decimal numbers."""
        words = [word for word in self._coordinates if isinstance(word, str)]
        try:
            # `float` also accepts words that are not decimal numbers, such as `1_0` and `nan`.
            if _NOT_IN_NUMBERS.search("\n".join(words)):
                raise ValueError
            return np.array(list(map(float, self._coordinates)), dtype=np.float64).reshape(-1, 3)
        except ValueError:
            at = next(i for i, word in enumerate(words) if not is_number(word))
            cure = "write decimals with a point" if "," in words[at] else "correct the number"
            raise InputError(
                f"{self._noun} {self._numbers[at // 3]} has {words[at][:40]!a} where a coordinate should be, "
                f"which is not a finite number: {cure}."
            ) from None

    def landmarks(
        self,
        coordinates: CoordinateSystem | None = None,
        *,
        positions: Float64[np.ndarray, "l 3"] | None = None,
        notes: tuple[str, ...] = (),
        why_left_out: str = "",
        unit: str | None = None,
    ) -> Landmarks:
        """Return the landmarks, perhaps with other positions. A note says which points were left out."""
        positions = self.positions() if positions is None else positions
        _check_points(self._names, positions, lambda i: f"{self._noun} {self._numbers[i]}")
        if self._left_out:
            listed = ", ".join(map(str, self._left_out[:10])) + (", …" if len(self._left_out) > 10 else "")
            total = count_of(self.next - 1, "point")
            notes += (f"{len(self._left_out)} of {total} left out because {why_left_out}: number {listed}.",)
        return Landmarks(tuple(self._names), positions, coordinates, notes=notes, unit=unit)


def check_count(count: int) -> None:
    """Refuse more than a million landmarks."""
    if count > _MOST_LANDMARKS:
        raise InputError(f"contains more than {_MOST_LANDMARKS} landmarks: give fewer landmarks.")


class LandmarkMatch(NamedTuple):
    """The result of `match_landmarks`: three tuples of names, in the order of the set that contains them.

    **Attributes:**

    - `names`: the names in both sets of landmarks, in the order of the first set.
    - `only_first`, `only_second`: the names in only one of the two sets.
    """

    names: tuple[str, ...]
    only_first: tuple[str, ...]
    only_second: tuple[str, ...]


def match_landmarks(first: Landmarks, second: Landmarks) -> LandmarkMatch:
    """Match the landmarks of two meshes by their names. Names that differ in case are different.

    **Returns:** A `LandmarkMatch`. Pass its `names` to `Landmarks.select` to bring the landmarks of both
    meshes into the same order.

    **Raises:** `InputError` if the landmarks have no common name.
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

    - `as_read`, `flipped`: the mean distance from the landmarks to the surface, as they are and after
      `Landmarks.flipped`.
    """

    as_read: float
    flipped: float


def find_frame(landmarks: Landmarks, mesh: Mesh) -> FrameDistances:
    """Measure how far landmarks are from a surface, with and without reversed signs of x and y.

    A change between the coordinate systems LPS and RAS reverses these signs. The landmarks and the mesh must
    have the same unit.

    **Returns:** The mean distances as `FrameDistances`.
    """
    as_read, flipped = (
        float(distances_to_surface(points.positions, mesh).mean())
        for points in (landmarks, landmarks.flipped())
    )
    return FrameDistances(as_read, flipped)


def check_frame(landmarks: Landmarks, mesh: Mesh) -> tuple[str, ...]:
    """Check that landmarks, in the unit of a mesh, lie on its surface without a conversion of coordinates.

    **Returns:** A tuple with a sentence for each landmark whose distance to the surface is above 2 % of the
    diagonal of the box around the mesh.

    **Raises:** `InputError` if the median distance of the landmarks to the surface is above 3 % of the
    diagonal. `InputError` is also raised if their mean distance is above 5 % of the diagonal, but would be
    below 2 % in the other coordinate system. If the landmarks seem to have another unit, the message
    names the factor between the units.
    """
    diagonal = bounding_box_diagonal(mesh)
    distances = distances_to_surface(landmarks.positions, mesh)
    as_read, usual = float(distances.mean()), float(np.median(distances))
    if as_read > _FAR * diagonal and (flipped := find_frame(landmarks, mesh).flipped) < _NEAR * diagonal:
        here, other = landmarks.coordinates, landmarks.flipped().coordinates
        change = f"after a change from {here} to {other}" if other else "with the signs of x and y reversed"
        cure = f'set coordinates="{other}"' if other else "reverse the signs of x and y in the file"
        raise InputError(
            f"{landmarks.name}: the landmarks are on average {as_read:.3g} from the surface of {mesh.name} "
            f"as read, and {flipped:.3g} {change}: {cure}."
        )
    if usual > _ELSEWHERE * diagonal:
        raise InputError(
            f"{landmarks.name}: the median distance of the landmarks to the surface of {mesh.name} is "
            f"{usual:.3g}, but its diagonal is {diagonal:.3g}: {_cure_of_unit(landmarks, mesh, diagonal)}."
        )
    return tuple(
        f"{landmarks.name}: the landmark {landmarks.names[i]!a} is {distances[i]:.3g} from the surface of "
        f"{mesh.name}, which is {100 * distances[i] / diagonal:.3g} % of the diagonal of the mesh."
        for i in np.flatnonzero(distances > _NEAR * diagonal).tolist()
    )


def _cure_of_unit(landmarks: Landmarks, mesh: Mesh, diagonal: float) -> str:
    """Return the advice for landmarks far from a surface, with a conversion factor if the unit is wrong."""
    for factor in _UNITS:
        scaled = factor * landmarks.positions
        if _are_usable(scaled).all() and distances_to_surface(scaled, mesh).mean() < _NEAR * diagonal:
            return f"multiply the positions by {factor:.4g}, which converts them to the unit of the mesh"
    return "give landmarks of this mesh, in its unit and coordinates"
