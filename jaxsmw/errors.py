"""The exception for input that cannot be used, a category of warnings, and functions that check arguments."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any, get_args


class InputError(ValueError):
    """The exception that functions raise for input that cannot be used; a subclass of `ValueError`.

    The message names the input, its fault and a remedy. The command line prints the message and the notes of
    the exception, and exits with code 2.
    """

    def lines(self) -> list[str]:
        """Return the message and the notes."""
        return [str(self), *getattr(self, "__notes__", ())]


class WrongMapWarning(UserWarning):
    """The category of warnings that a map is probably wrong as a whole."""


@contextmanager
def naming(name: object) -> Iterator[None]:
    """Put the name of a file or of another input before the message of each `InputError` in the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def check_suffix(path: str | PathLike[str], what: str, *suffixes: str) -> None:
    """Refuse a file name that has none of the suffixes, in upper or lower case. `what` is a plural noun."""
    if Path(path).suffix.lower() not in suffixes:
        listed = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
        raise InputError(f"{path}: {what} are written as {listed}: choose a name that ends in {listed}.")


def check_choice(value: object, choices: Any, kind: str) -> None:
    """Raise an error if a value is not one of the choices.

    `choices` is a `Literal` type. The message says that the value is not `kind`, so `kind` is a noun with its
    article, such as "an eigensolver".

    **Raises:** `InputError` if the value is not one of the choices; the message lists them.
    """
    if value not in get_args(choices):
        raise InputError(f"{value!r} is not {kind}: choose {', '.join(get_args(choices))}.")


def check_whole_number(name: str, value: Any, least: int | None = None, most: int | None = None) -> int:
    """Return a whole number of any type as an `int`.

    **Arguments:**

    - `name`: the name of the argument.
    - `value`: the value of the argument.
    - `least`, `most`: the smallest and the largest valid number; None for no limit.

    **Raises:** `InputError` if the value is not a whole number within the limits. Floats such as 3.0 and
    Booleans do not count as whole numbers.
    """
    limits = "" if least is None else f" of at least {least}" if most is None else f" from {least} to {most}"
    number = int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None
    if number is None or (least is not None and number < least) or (most is not None and number > most):
        raise InputError(f"{name} is {value!r}: give a whole number{limits}.")
    return number


def check_number(name: str, value: Any, *, most: float = math.inf, positive: bool = False) -> None:
    """Check that a number is finite and not negative.

    **Arguments:**

    - `name`: the name of the argument.
    - `value`: the value of the argument.
    - `most`: the largest valid number.
    - `positive`: True if the number must be greater than zero.

    **Raises:** `InputError` if the value is not a finite number, or lies outside these limits.
    """
    wanted = "a positive finite number" if positive else "a finite number of at least 0"
    if math.isfinite(most):
        wanted = f"a number from 0 to {most:g}"
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if not (0 <= number <= most and number < math.inf) or (positive and number == 0):
        raise InputError(f"{name} is {value!r}: give {wanted}.")
