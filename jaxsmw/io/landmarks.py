"""Landmarks: named points on one mesh, their coordinate system, and their distance to the mesh."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxsmw.choices import CoordinateSystem
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.mesh import LARGEST_EXTENT, Mesh
from jaxsmw.geometry.surface_distance import bounding_box_diagonal, distances_to_surface

# Limits for the mean distance from landmarks to the surface, as fractions of the diagonal of the box around
# the mesh. Landmarks whose mean distance is above `FAR` may be in the wrong coordinate system. The mean
# distance of landmarks in the right coordinate system is below `NEAR` in all data sets. If the median
# distance is above `ELSEWHERE`, the landmarks have another unit, or belong to another mesh.
FAR, NEAR, ELSEWHERE = 0.05, 0.02, 0.03
# The factors between usual units of length: metres, centimetres, inches, millimetres and micrometres.
_UNITS = tuple(factor for unit in (1000.0, 100.0, 10.0, 25.4, 1e6) for factor in (unit, 1 / unit))

# Control characters, line separators, and characters that UTF-8 or XML cannot represent.
_NOT_IN_NAMES = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufffe\uffff]")


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
        if not self.names:
            raise InputError(f"{self.name}: there are no landmarks: give at least one.")
        if self.coordinates is not None:
            check_choice(self.coordinates, CoordinateSystem, "a coordinate system")
        if self.positions.shape != (len(self.names), 3):
            raise InputError(
                f"{self.name}: positions have the shape {self.positions.shape} instead of "
                f"({len(self.names)}, 3): give one position for each name."
            )
        wrong = ~usable(self.positions).all(axis=1)
        if wrong.any():
            raise InputError(
                f"{self.name}: a coordinate of {self.names[wrong.argmax()]!a} is not a finite number below "
                f"{LARGEST_EXTENT:.0e}: correct the position."
            )
        if faulty := first_faulty_name(self.names):
            shown = ascii(self.names[faulty.row][:40])
            raise InputError(f"{self.name}: the name {shown} {faulty.fault}: rename the landmark.")

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


def usable(positions: Float64[np.ndarray, "*any"]) -> np.ndarray:
    """Return which coordinates are finite and at most 1e60. The squares of such numbers do not overflow."""
    return np.abs(positions) <= LARGEST_EXTENT


class FaultyName(NamedTuple):
    """A faulty name: its 0-based row, the row of an earlier equal name (or None), and the fault in words."""

    row: int
    earlier: int | None
    fault: str


def first_faulty_name(names: Sequence[str]) -> FaultyName | None:
    """Return the first name that is empty, repeated or not one line of text. Return None if all are good."""
    if len(set(names)) == len(names) and not any(map(_fault, names)):
        return None
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        if fault := _fault(name):
            return FaultyName(i, None, fault)
        if (earlier := first.setdefault(name, i)) != i:
            return FaultyName(i, earlier, "is repeated")
    return None


def _fault(name: str) -> str:
    """Return what is wrong with the name of a landmark, or an empty string."""
    if not name:
        return "is empty"
    if name != name.strip():
        return "begins or ends with a blank"
    return "contains a line break or another control character" if _NOT_IN_NAMES.search(name) else ""


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
        if usable(scaled).all() and distances_to_surface(scaled, mesh).mean() < NEAR * diagonal:
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
