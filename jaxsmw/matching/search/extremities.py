"""The extremities of a body, such as the ends of its limbs, and pairings of the extremities of two bodies."""

from __future__ import annotations

from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.matching.search.proxies import Proxy


class Extremities(NamedTuple):
    """The extremities of a body, in descending order of their remoteness.

    The remoteness of a sample is the root mean square of its distances to all points of the surface.

    **Attributes:**

    - `samples`: the samples at the extremities (e,), as 0-based indices of the samples of a `Proxy`.
    - `distances`: the distances between extremities (e, e) along the surface, divided by the mean remoteness
      of all e extremities.
    - `remoteness`: the remoteness of each extremity (e,), divided by the same mean.
    """

    samples: Int64[np.ndarray, " e"]
    distances: Float[np.ndarray, "e e"]
    remoteness: Float[np.ndarray, " e"]


# The smallest distance between two extremities, in units of the square root of the area.
_DISTANCE = 0.35
# The largest number of extremities. The number of pairings grows very fast with it.
_MOST = 6


def extremities(proxy: Proxy) -> Extremities:
    """Find the extremities of a body, such as the ends of its limbs, at most six.

    Extremities are the local maxima of the mean squared distance to the whole surface (Hilaga et al. 2001,
    "Topology matching for fully automatic similarity estimation of 3D shapes").
    """
    distances = proxy.distances
    remoteness = np.sqrt(proxy.areas @ distances**2)
    around = np.where(distances < _DISTANCE, remoteness, 0).max(axis=1)
    ends = np.flatnonzero(remoteness >= around)
    ends = ends[np.argsort(-remoteness[ends], kind="stable")][:_MOST]
    unit = max(remoteness[ends].mean(), np.finfo(np.float64).tiny)
    return Extremities(ends, distances[np.ix_(ends, ends)] / unit, remoteness[ends] / unit)


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
