"""Estimates of the errors of a collection's maps, from cycles in the graph of matched pairs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from jaxsmw.errors import InputError, check_whole_number

# An edge (i, j) with i < j, as the numbers of its two shapes.
Edge = tuple[int, int]

# Distances above this share of the square root of the area count as this share. At such a distance, a point
# of one limb lies on another limb, and the exact distance gives no further information.
_LARGEST = 0.5
# The sharpness of the weights in each iteration, in units of 1 / error. The values follow the doubling
# sequence that Lerman and Shi recommend. Each edge averages the errors of its cycles. A cycle has a
# small weight if its two other edges have large errors. With a sharpness of 40, the weight is e^-4 if these
# two errors sum to 0.1.
_SHARPNESS = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0)


def check_pairs(pairs: Iterable[Iterable[object]], number: int, kind: str) -> list[tuple[int, int]]:
    """Return pairs of the numbers of shapes as tuples. Messages call such a pair `kind`."""
    checked = []
    for position, pair in enumerate(pairs):
        try:
            i, j = (check_whole_number(kind, shape, 0, number - 1) for shape in pair)
        except (TypeError, ValueError):
            raise InputError(
                f"{kind} {position} is {pair!r}, but there are {number} shapes: give the numbers of two "
                "shapes, counted from 0."
            ) from None
        checked.append((i, j))
    return checked


def triangles(edges: Sequence[Edge]) -> Int64[np.ndarray, "t 3"]:
    """List the triangles of a graph, each with its three shapes in ascending order."""
    neighbors: dict[int, set[int]] = {}
    for i, j in edges:
        neighbors.setdefault(min(i, j), set()).add(max(i, j))
    rows = [
        (i, j, k)
        for i, after in sorted(neighbors.items())
        for j in sorted(after)
        for k in sorted(after & neighbors.get(j, set()))
    ]
    return np.array(rows, np.int64).reshape(-1, 3)


def cycle_error(
    first: Int64[np.ndarray, " i"],
    second: Int64[np.ndarray, " j"],
    third: Int64[np.ndarray, " k"],
    positions: Float64[np.ndarray, "i 3"],
    samples: Int64[np.ndarray, " s"],
) -> float:
    """Return the mean distance between samples of i and their images after the maps i -> j -> k -> i."""
    images = third[second[first[samples]]]
    distances = np.linalg.norm(positions[images] - positions[samples], axis=1)
    return float(np.minimum(distances, _LARGEST).mean())


def edge_errors(
    cycles: Int64[np.ndarray, "c 3"],
    errors: Float64[np.ndarray, " c"],
    prior: Float64[np.ndarray, " e"],
) -> Float64[np.ndarray, " e"]:
    """Estimate the error of each edge's map from the errors of cycles.

    If two maps of a cycle are right, the error of the cycle is the error of the third map. Each iteration
    averages the errors of all cycles through an edge. The weight of a cycle decreases exponentially with the
    estimated errors of its two other edges (cycle-edge message passing; Lerman, Shi, "Robust group
    synchronization via cycle-edge message passing", Foundations of Computational Mathematics 2022).

    **Arguments:**

    - `cycles`: the three edges of each cycle (c, 3), as 0-based indices into `prior`.
    - `errors`: the error of each cycle (c,), in units of the square root of the area. The error is the mean
      distance between samples and their images under the three maps; distances above 0.5 count as 0.5.
    - `prior`: the first estimate of each edge's error (e,), in the same unit, for example the expected error.

    **Returns:** The estimated errors (e,), in the unit of `errors`. An edge without cycles keeps its prior.
    """
    number = prior.shape[0]
    # Each edge receives the errors of its cycles, whose weights depend on their two other edges.
    receiver = cycles.T.reshape(-1)
    others = np.concatenate([cycles[:, [1, 2]], cycles[:, [0, 2]], cycles[:, [0, 1]]])
    message = np.tile(errors, 3)
    estimate = prior
    for sharpness in _SHARPNESS:
        weights = np.exp(-sharpness * estimate[others].sum(axis=1))
        total = np.bincount(receiver, weights, number)
        mean = np.bincount(receiver, weights * message, number) / np.maximum(total, 1e-30)
        estimate = np.where(total > 0, mean, prior)
    return estimate


def estimate_edge_errors(
    edges: Sequence[Edge],
    maps: Mapping[tuple[int, int], Int64[np.ndarray, " _"]],
    positions: Sequence[Float64[np.ndarray, "_ 3"]],
    samples: Sequence[Int64[np.ndarray, " _"]],
    prior: Float64[np.ndarray, " e"],
) -> tuple[Float64[np.ndarray, " e"], Float64[np.ndarray, " c"], Int64[np.ndarray, "c 3"]]:
    """Estimate the errors of edges, given the maps of each edge (i, j) with the keys (i, j) and (j, i).

    **Returns:** The arguments and the result of `edge_errors`: the estimated errors of the edges, the errors
    of the triangles, and the edges of the triangles.
    """
    shapes = triangles(edges)
    row = {frozenset(edge): number for number, edge in enumerate(edges)}
    cycles = np.array(
        [[row[frozenset(side)] for side in ((i, j), (j, k), (i, k))] for i, j, k in shapes], np.int64
    ).reshape(-1, 3)
    errors = np.array(
        [
            np.mean(
                [
                    cycle_error(maps[a, b], maps[b, c], maps[c, a], positions[a], samples[a])
                    for a, b, c in ((i, j, k), (j, k, i), (k, i, j))
                ]
            )
            for i, j, k in shapes
        ]
    )
    if not len(shapes):
        return prior, errors, cycles
    return edge_errors(cycles, errors, prior), errors, cycles


def find_outliers(errors: Mapping[Edge, float], limit: float) -> tuple[int, ...]:
    """Return the shapes whose maps all have an error of at least `limit`, in ascending order."""
    least: dict[int, float] = {}
    for edge, error in errors.items():
        for shape in edge:
            least[shape] = min(error, least.get(shape, error))
    return tuple(sorted(shape for shape, error in least.items() if error >= limit))
