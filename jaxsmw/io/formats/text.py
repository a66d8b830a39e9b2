"""Numbers in text files."""

from __future__ import annotations

import codecs
import re

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.errors import InputError
from jaxsmw.wording import count_of

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)


def export_again(fault: str, what: str = "mesh") -> InputError:
    """Return the error for a file that its program should write again."""
    return InputError(f"{fault}: export the {what} again.")


def damaged(fault: str) -> InputError:
    """Return the error for a mesh file that contradicts itself or its format."""
    return export_again(f"{fault}, so the file is damaged")


def refuse_entities(xml: bytes) -> None:
    """Raise a `ValueError` for XML that declares entities, which can expand without limit."""
    if b"<!ENTITY" in xml:
        raise ValueError


def is_number(word: str, *, finite: bool = True) -> bool:
    """Return whether a word is a decimal number in the usual notation, such as `-1.5e3`.

    Unlike `float`, this function refuses underscores (`1_0`) and digits of other scripts. If `finite` is
    False, `nan` and `inf` are also accepted.
    """
    return bool(_NUMBER.fullmatch(word)) or (not finite and bool(_NOT_FINITE.fullmatch(word)))


def text(data: bytes) -> str:
    """Decode the text of a file, convert all line ends to newlines, and remove comments."""
    # Latin-1 can decode every byte, and the parsers need only ASCII characters.
    text = data.removeprefix(codecs.BOM_UTF8).replace(b"\r", b"\n").decode("latin-1")
    return re.sub("#[^\n]*", "", text) if "#" in text else text


def filled_lines(data: bytes) -> list[str]:
    """Return the lines of `text` that are not blank."""
    return [line for line in text(data).split("\n") if line and not line.isspace()]


def numbers(lines: list[str], columns: int) -> Float64[np.ndarray, "lines columns"]:
    """Return the numbers in the first columns of each line."""
    if not lines:
        return np.empty((0, columns))
    try:
        if "" in lines:  # loadtxt would skip an empty line
            raise ValueError
        return np.loadtxt(lines, usecols=range(columns), comments=None, ndmin=2)
    except ValueError:
        culprit = next((line for line in lines if not _starts_with_numbers(line, columns)), lines[0])
        raise export_again(
            f"{excerpt(culprit)} is written where {count_of(columns, 'number')} should be, so the file is "
            "damaged or its header is wrong"
        ) from None


def _starts_with_numbers(line: str, columns: int) -> bool:
    words = line.split()[:columns]
    return len(words) == columns and all(is_number(word, finite=False) for word in words)


def numbers_of(words: list[str], kind: str) -> np.ndarray:
    """Convert words such as `1.5` to an array of numbers of a type such as `f4`."""
    text = " ".join(words)
    try:
        if re.search(r"[^\x20-\x7e]|_", text):  # NumPy would read 1_0 as 10
            raise ValueError
        if kind in ("i8", "u8"):
            return np.array([int(word) for word in words], kind)
        values = np.array(words, np.float64) if words else np.empty(0)
        if kind[0] in "iu" and words:
            limits = np.iinfo(kind)
            if not ((values >= limits.min) & (values <= limits.max) & (values == np.floor(values))).all():
                raise ValueError
        return values.astype(kind)
    except (ValueError, OverflowError):
        culprit = next((word for word in words if not is_number(word, finite=False)), words[0])
        raise damaged(
            f"{excerpt(culprit)} is written among numbers of the type {np.dtype(kind).name}"
        ) from None


def excerpt(line: str) -> str:
    """Return the first 40 characters of a line, escaped for a message."""
    return ascii(" ".join(line.split())[:40])


def polygon_lines(lines: list[str]) -> tuple[Float64[np.ndarray, " corners"], Int64[np.ndarray, " f"]]:
    """Parse lines of the form `size corner corner …`, one per face, into corners and sizes."""
    sizes = numbers(lines, 1)[:, 0]
    longest = max(map(len, lines), default=0)
    possible = (sizes >= 0) & (sizes <= longest) & (np.floor(sizes) == sizes)
    if not possible.all():
        raise export_again(
            f"{excerpt(lines[int(possible.argmin())])} does not begin with the number of corners of a face, "
            "so the file is damaged or its header is wrong"
        )
    sizes = sizes.astype(np.int64)
    starts = np.cumsum(sizes) - sizes
    corners = np.empty(sizes.sum())
    for size in np.unique(sizes).tolist():
        rows = np.flatnonzero(sizes == size)
        table = numbers([lines[i] for i in rows], size + 1)
        corners[starts[rows][:, None] + np.arange(size)] = table[:, 1:]
    return corners, sizes
