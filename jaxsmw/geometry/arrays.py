"""Operations on arrays that several modules share."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64


def ratio(numerator: np.ndarray | float, denominator: np.ndarray, otherwise: float = 0.0) -> np.ndarray:
    """Return the quotient where the denominator is positive, and `otherwise` elsewhere."""
    shape = np.broadcast_shapes(np.shape(numerator), denominator.shape)
    quotient = np.full(shape, otherwise, np.result_type(numerator, denominator))
    return np.divide(numerator, denominator, out=quotient, where=denominator > 0)


def unit_vectors(vectors: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
    """Return vectors of length 1 with the given directions; vectors of length 0 stay as they are."""
    return ratio(vectors, np.linalg.norm(vectors, axis=1, keepdims=True))


def ranges(
    start: Int64[np.ndarray, " r"], count: Int64[np.ndarray, " r"]
) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """Return all pairs (i, start[i] + j) with 0 <= j < count[i], as two arrays."""
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) + np.repeat(start - (np.cumsum(count) - count), count)


def sides_of(faces: Int64[np.ndarray, "f 3"]) -> tuple[Int64[np.ndarray, " s"], ...]:
    """Return the tail, the head and the opposite corner of side 3 t + k, from corner k of triangle t."""
    return tuple(np.roll(faces, -k, axis=1).ravel() for k in range(3))


def first_equal_rows(rows: np.ndarray) -> Int64[np.ndarray, " n"]:
    """For each row of an array (n, 3), return the index of the first equal row (n,)."""
    order = np.lexsort(rows.T)  # a stable sort: equal rows keep their order
    sorted_rows = rows[order]
    starts = np.ones(len(rows), dtype=bool)
    starts[1:] = (sorted_rows[1:] != sorted_rows[:-1]).any(axis=1)
    lowest = np.empty(len(rows), dtype=np.int64)
    lowest[order] = order[starts][np.cumsum(starts) - 1]
    return lowest
