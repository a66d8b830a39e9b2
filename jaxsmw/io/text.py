"""Recognition of numbers in text files."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)


def is_number(word: str, *, finite: bool = True) -> bool:
    """Return whether a word is a decimal number in the usual notation, such as `-1.5e3`.

    Unlike Python's `float`, this function refuses words with underscores (`1_0`) and words with digits of
    other scripts.

    **Arguments:**

    - `finite`: if False, `nan` and `inf` are also accepted. The caller must then check for such values.
    """
    return bool(_NUMBER.fullmatch(word)) or (not finite and bool(_NOT_FINITE.fullmatch(word)))
