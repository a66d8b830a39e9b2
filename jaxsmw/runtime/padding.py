"""Common sizes for shapes, so that one compiled program serves shapes of similar sizes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Shaped

from jaxsmw.core.search import BLOCK

# Sizes are multiples of an eighth of the power of two below them, and of the block size of the search.
# Padding is at most an eighth of a padded shape, and all shapes from 4000 to 16 000 vertices share 17 sizes.
_SUBDIVISION = 8


def padded_size(number_of_vertices: int) -> int:
    """Returns the common size for a number of vertices: the number of vertices after padding.

    One program serves all shapes of this size.
    """
    power = 2 ** max(number_of_vertices - 1, 1).bit_length() // 2
    step = max(power // _SUBDIVISION, BLOCK)
    return -(-number_of_vertices // step) * step


def pad_rows(rows: Shaped[np.ndarray, "n ..."], number_of_rows: int) -> Shaped[np.ndarray, "p ..."]:
    """Returns an array (n, ...) with rows of zeros appended, up to a given number of rows.

    The rows of a host array then match the rows of a padded `Spectrum`. `number_of_rows` must be at least n.
    """
    return np.pad(rows, ((0, number_of_rows - len(rows)), *((0, 0),) * (rows.ndim - 1)))
