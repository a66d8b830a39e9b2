"""Pads shapes to a few common sizes. One compiled program then serves all shapes of similar sizes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Shaped

from jaxsmw.core.search import BLOCK

# A padded size is a multiple of `power / _SUBDIVISION`, where `power` is the largest power of two below the
# number of vertices. Every padded size is also a multiple of the block size of the search. At most 1/8 of the
# vertices of a padded shape are padding if the padded size is at least 1024. Shapes with 4000 to 16 000
# vertices have only 17 different padded sizes.
_SUBDIVISION = 8


def padded_size(number_of_vertices: int) -> int:
    """Return the number of vertices to which a shape is padded.

    One compiled program serves all shapes with the same padded size.
    """
    power = 2 ** max(number_of_vertices - 1, 1).bit_length() // 2
    step = max(power // _SUBDIVISION, BLOCK)
    return -(-number_of_vertices // step) * step


def pad_rows(rows: Shaped[np.ndarray, "n ..."], number_of_rows: int) -> Shaped[np.ndarray, "p ..."]:
    """Return an array (n, ...) extended by rows of zeros to a given number of rows.

    `number_of_rows` must be at least n.
    """
    return np.pad(rows, ((0, number_of_rows - len(rows)), *((0, 0),) * (rows.ndim - 1)))
