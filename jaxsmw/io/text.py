"""What counts as a number in a text file."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)


def is_number(word: str, *, finite: bool = True) -> bool:
    """Whether a word is a decimal number, as every program writes them.

    Python's `float` also accepts underscores (`1_0`) and digits of other scripts, which are typing errors
    here.

    **Arguments:**

    - `word`: a word without spaces.
    - `finite`: False accepts `nan` and `inf`, too, where a later check reports them with the vertex.
    """
    return bool(_NUMBER.fullmatch(word)) or (not finite and bool(_NOT_FINITE.fullmatch(word)))
