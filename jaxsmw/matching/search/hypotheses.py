"""Hypotheses: cheap and different maps of samples, one of which leads to the right map.

Each function in `HYPOTHESES` is one kind of hypothesis. It takes a `Reading` and yields maps of samples. A
new kind is one more function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import KDTree

from jaxsmw.geometry.alignment import alignments, oriented_points
from jaxsmw.matching.search.fitting import fits
from jaxsmw.matching.search.proxies import Extremities, Proxy, SampleMap
from jaxsmw.matching.search.reading import Reading

Hypothesis = Callable[[Reading], Iterator[SampleMap]]
"""A kind of hypothesis: a function from a reading to maps of samples."""

# The sets of radii of SHOT, in units of 0.06, that give one hypothesis each.
_SHOT_RADII = ((1,), (1, 2, 4), (2, 4), (4, 8))
# The weights of positions after an alignment, of positions along principal axes, of the relative distances to
# extremities, and of the orientations with respect to extremities. SHOT has the weight 1.
_ALIGNED, _ALONG_AXES, _TO_EXTREMITIES, _ORIENTED = 9.0, 10.0, 2.25, 0.3
# The number of alignments that differ from each other, and of pairings of extremities: of the most plausible
# ones, those with the most similar features.
_ALIGNMENTS, _PLAUSIBLE, _PAIRINGS = 4, 64, 12
# The identity and the half turns about the three principal axes, as factors of the three coordinates.
_HALF_TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


def by_descriptors(reading: Reading) -> Iterator[SampleMap]:
    """Match samples with similar SHOT of several radii."""
    for radii in _SHOT_RADII:
        of_x, of_y = (np.hstack([side.shot(radius) for radius in radii]) for side in (reading.x, reading.y))
        yield _squares(of_x, of_y).argmin(axis=1)


def by_alignment(reading: Reading) -> Iterator[SampleMap]:
    """Align X rigidly with Y in several ways, and match samples that are near and have similar SHOT."""
    if reading.prepared.pair.partial:  # see `by_fits`
        return
    x, y = reading.x, reading.y
    shot = _shot_squares(reading)
    for motion in alignments(x.positions, y.positions, _ALIGNMENTS):
        yield (shot + _ALIGNED * _squares(motion.apply(x.positions), y.positions)).argmin(axis=1)


def by_given_positions(reading: Reading) -> Iterator[SampleMap]:
    """Match samples at the nearest given positions, in case the meshes were aligned by their owner."""
    if not reading.prepared.mirrored:
        yield reading.nearest


def by_principal_axes(reading: Reading) -> Iterator[SampleMap]:
    """Match samples at similar positions along the principal axes, in each of four orientations."""
    if reading.prepared.pair.partial:
        return
    shot, of_x, of_y = _shot_squares(reading), *map(_principal_frame, (reading.x, reading.y))
    for signs in _HALF_TURNS:
        yield (shot + _ALONG_AXES * _squares(of_x * signs, of_y)).argmin(axis=1)


def by_extremities(reading: Reading) -> Iterator[SampleMap]:
    """Match samples at similar distances from paired extremities, for several pairings.

    The belly and the back have the same distances, so orientations count as well. Pairings with the most
    similar features come first.
    """
    if reading.prepared.pair.partial:
        return
    both = reading.x, reading.y
    shot, ends = _shot_squares(reading), (reading.x.extremities, reading.y.extremities)
    # Limbs of different animals differ in length, so distances are divided by their mean.
    to_ends = [
        side.distances[:, of_side.samples] / (side.areas @ side.distances[:, of_side.samples])
        for side, of_side in zip(both, ends, strict=True)
    ]
    oriented = [side.sides for side in both]

    def costs(pairing: Int64[np.ndarray, "l 2"], weight: float, rows: slice) -> Float[np.ndarray, "a b"]:
        first, second = (pairing[numbers].T for numbers in np.triu_indices(len(pairing), 1))
        distances = (of_side[rows, paired] for of_side, paired in zip(to_ends, pairing.T, strict=True))
        turns = (of_side[rows, a, b] for of_side, a, b in zip(oriented, first, second, strict=True))
        cost = weight * shot[rows, rows] + _TO_EXTREMITIES * _squares(*distances)
        return cost + _ORIENTED * _squares(*turns)

    def residual(pairing: Int64[np.ndarray, "l 2"]) -> float:
        rows = slice(None, None, 3)  # a third of the samples is enough for a comparison
        cost = costs(pairing, 0.3, rows)
        sides = zip((cost.min(axis=1), cost.min(axis=0)), both, strict=True)
        return sum(float(np.average(least, weights=side.areas[rows])) for least, side in sides)

    pairings = plausible_pairings(*ends, _PLAUSIBLE)
    for pairing in sorted(pairings, key=residual)[:_PAIRINGS]:
        yield costs(pairing, 1.0, slice(None)).argmin(axis=1)


def by_fits(reading: Reading) -> Iterator[SampleMap]:
    """Fit the smaller shape to the larger one, of which it may be a part, and match the nearest samples."""
    x, y, pair = reading.x, reading.y, reading.prepared.pair
    if not pair.partial:
        return
    moving, fixed = (y, x) if pair.source_is_whole else (x, y)
    of_fixed = oriented_points(fixed.positions, fixed.normals)
    for fit in fits(moving, fixed):
        queries, database = (fit.features, of_fixed) if moving is x else (of_fixed, fit.features)
        yield KDTree(database).query(queries)[1]


HYPOTHESES: tuple[Hypothesis, ...] = (
    by_descriptors,
    by_alignment,
    by_given_positions,
    by_principal_axes,
    by_extremities,
    by_fits,
)
"""All kinds of hypothesis."""


def _shot_squares(reading: Reading) -> Float[np.ndarray, "s t"]:
    """Return the squared differences of SHOT (s, t) between all samples of X and Y."""
    return _squares(reading.x.shot(1), reading.y.shot(1))


def _squares(x: Float[np.ndarray, "s d"], y: Float[np.ndarray, "t d"]) -> Float[np.ndarray, "s t"]:
    """Return the squared distance between each row of `x` and each row of `y`."""
    # A matrix product takes a fraction of the time of `cdist`.
    return np.sum(x**2, axis=1)[:, None] + np.sum(y**2, axis=1) - 2 * x @ y.T


def _principal_frame(proxy: Proxy) -> Float[np.ndarray, "s 3"]:
    """Return the positions along the principal axes of inertia, in units of the radius of gyration."""
    centered = proxy.positions - proxy.areas @ proxy.positions
    variances, axes = np.linalg.eigh((proxy.areas * centered.T) @ centered)
    axes = axes[:, ::-1] * [1, 1, np.sign(np.linalg.det(axes[:, ::-1]))]
    return centered @ axes / np.sqrt(variances.sum())


def plausible_pairings(x: Extremities, y: Extremities, number: int) -> list[Int64[np.ndarray, "l 2"]]:
    """Return pairings of the extremities of two bodies, the most plausible pairing first.

    A pairing matches each extremity of the body with fewer extremities to a different extremity of the other
    body. A pairing is plausible if the distances between extremities, and the remoteness of extremities, are
    similar on both bodies. The cost of a pairing is the sum of the squared differences of distances and of
    remoteness. The cost does not distinguish left from right.

    **Arguments:**

    - `x`, `y`: the extremities of X and of Y.
    - `number`: the largest number of pairings to return.

    **Returns:** A list of arrays (l, 2), where l is the number of extremities of the body with fewer
    extremities. Each row pairs the index of an extremity of X with the index of an extremity of Y.
    """
    fewer, more = (x, y) if len(x.samples) <= len(y.samples) else (y, x)
    partners = np.array(list(permutations(range(len(more.samples)), len(fewer.samples))))
    between = more.distances[partners[:, :, None], partners[:, None, :]] - fewer.distances
    cost = np.sum(between**2, axis=(1, 2)) / 2
    cost += np.sum((more.remoteness[partners] - fewer.remoteness) ** 2, axis=1)
    best = partners[np.argsort(cost, kind="stable")[:number]]
    pairings = [np.stack([np.arange(len(partner)), partner], axis=1) for partner in best]
    return pairings if fewer is x else [pairing[:, ::-1] for pairing in pairings]
