"""The parsed contents of a landmark file, with checks of names and positions."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxsmw.choices import CoordinateSystem
from jaxsmw.errors import InputError
from jaxsmw.io.landmarks import Landmarks, first_faulty_name, usable
from jaxsmw.io.text import is_number
from jaxsmw.wording import count_of

MOST_LANDMARKS = 2**20
"""The largest number of landmarks in a file, so that no file can use gigabytes of memory."""

_NOT_IN_NUMBERS = re.compile(r"[^0-9+\-.eE\n]")

SYSTEMS: dict[str, CoordinateSystem] = {"LPS": "LPS", "1": "LPS", "RAS": "RAS", "0": "RAS"}
"""The names of coordinate systems in files of 3D Slicer, which used numbers before version 4.11."""


class Entries(NamedTuple):
    """The landmarks of a file, in the order of the file.

    `numbers` contains the place of each landmark in the file, such as a line number. `noun` names what these
    numbers count, such as `line`. Messages contain the noun and the number.
    """

    names: list[str]
    positions: Float64[np.ndarray, "l 3"]
    noun: str
    numbers: Sequence[int]
    coordinates: CoordinateSystem | None = None
    notes: tuple[str, ...] = ()
    unit: str | None = None

    def landmarks(self, path: str) -> Landmarks:
        """Check names and coordinates, and return the landmarks of the file `path`."""
        if not self.names:
            raise InputError("contains no landmarks: give a file with at least one.")
        wrong = ~usable(self.positions).all(axis=1)
        if wrong.any():
            raise InputError(
                f"{self._place(int(wrong.argmax()))} has a coordinate that is not a finite number below "
                "1e60: correct the position."
            )
        if faulty := first_faulty_name(self.names):
            place = self._place(faulty.row)
            if faulty.earlier is None:
                raise InputError(f"the name in {place} {faulty.fault}: rename the landmark.")
            raise InputError(
                f"{self._place(faulty.earlier)} and {place} have the same name "
                f"{self.names[faulty.row][:40]!a}: give each landmark its own name."
            )
        return Landmarks(tuple(self.names), self.positions, self.coordinates, path, self.notes, self.unit)

    def _place(self, i: int) -> str:
        return f"{self.noun} {self.numbers[i]}"


def check_count(count: int) -> None:
    """Refuse more than `MOST_LANDMARKS` landmarks."""
    if count > MOST_LANDMARKS:
        raise InputError(f"contains more than {MOST_LANDMARKS} landmarks: give fewer landmarks.")


def parse_positions(words: list[str], noun: str, numbers: Sequence[int]) -> Float64[np.ndarray, "l 3"]:
    """Parse the coordinates of all landmarks. `noun` and `numbers` are as in `Entries`.

    **Raises:** `InputError` if a word is not a number. The message names the first such landmark.
    """
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


def left_out(numbers: Sequence[int], total: int, why: str) -> tuple[str, ...]:
    """Return a note with the numbers of the landmarks that were left out, or no note if there are none."""
    if not numbers:
        return ()
    listed = ", ".join(map(str, numbers[:10])) + (", …" if len(numbers) > 10 else "")
    return (f"{len(numbers)} of {count_of(total, 'point')} left out because {why}: number {listed}.",)
