"""Numbers and names as text, for messages and reports."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from pathlib import PurePath

MOST_LISTED = 3
"""The largest number of other maps that a message lists."""


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun in the singular or the plural."""
    if number != 1:
        noun = noun.removesuffix("ex") + "ices" if noun.endswith("ex") else noun + "s"
    return f"{number} {noun}"


def short_names(paths: Sequence[str]) -> list[str]:
    """Return file names, each with as many of its directories as are needed to tell different files apart.

    Question marks replace bytes that are not valid UTF-8.
    """
    files = [PurePath(path.encode("utf-8", "replace").decode()) for path in paths]
    last = 1
    while len({file.parts[-last:] for file in files}) < len({file.parts for file in files}):
        last += 1
    return [str(PurePath(*file.parts[-last:])) if file.parts else "" for file in files]


def percentage(probability: float) -> str:
    """Return a probability as text, for example `12 %`, `below 1 %` or `above 99 %`."""
    if probability < 0.01:
        return "below 1 %"
    return "above 99 %" if probability > 0.99 else f"{100 * probability:.0f} %"


def printable(line: str) -> str:
    r"""Return a line of text with an escape sequence such as `\x1b` in place of each control character.

    File names can contain line breaks, codes that control a terminal, and bytes that are not valid UTF-8.
    """
    if line.isprintable():
        return line
    return "".join(ascii(c)[1:-1] if unicodedata.category(c) in _CONTROL else c for c in line)


# Control characters, surrogates, and separators of lines and paragraphs.
_CONTROL = frozenset({"Cc", "Cs", "Zl", "Zp"})
