"""The ends of a body's limbs, and which of one body may be which of another."""

from __future__ import annotations

from functools import partial
from itertools import permutations
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float64, Int64
from scipy.sparse.csgraph import dijkstra

from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import spread_edges, spread_samples

# So many evenly spread points stand for the surface; no two ends are nearer to each other than this, in
# square roots of the area; and there are too many ways to pair more than so many.
_SPREAD, _APART, _MOST = 200, 0.35, 6


class Extremities(NamedTuple):
    """Points farther from the rest of a body than all around them, the farthest first.

    **Attributes:**

    - `vertices`: (e,), at most 6.
    - `distances`: (e, e), along the surface, in units of their mean remoteness; inf between separate pieces.
    - `remoteness`: (e,), the root mean square distance to the rest of the body, in the same unit.
    """

    vertices: Int64[np.ndarray, " e"]
    distances: Float64[np.ndarray, "e e"]
    remoteness: Float64[np.ndarray, " e"]


def extremities(mesh: Mesh) -> Extremities:
    """The ends of limbs: where the mean squared distance to all of the surface has its local maxima.

    As in Hilaga et al., "Topology matching for fully automatic similarity estimation of 3D shapes", SIGGRAPH
    2001. Distances are those along edges, some per cent too long everywhere.
    """
    edges, nearest = spread_edges(mesh)
    nodes, tails_and_heads = np.unique(edges, return_inverse=True)
    tails, heads = tails_and_heads.reshape(edges.shape).T
    lengths = np.linalg.norm(np.diff(mesh.vertices[edges], axis=1)[:, 0], axis=1) / mesh.area**0.5
    graph = sp.csr_array((lengths, (tails, heads)), (len(nodes), len(nodes)))
    search = partial(dijkstra, graph, directed=False)

    samples = np.intersect1d(nodes, nearest[spread_samples(mesh, _SPREAD).vertices])
    distances = search(indices=np.searchsorted(nodes, samples))
    remoteness = np.sqrt(np.mean(np.where(np.isfinite(distances), distances, 0) ** 2, axis=0))
    highest = np.ones(len(nodes), bool)
    highest[tails[remoteness[tails] < remoteness[heads]]] = False
    highest[heads[remoteness[heads] < remoteness[tails]]] = False
    candidates = np.flatnonzero(highest)
    around = search(indices=candidates, limit=_APART)
    ends = candidates[remoteness[candidates] >= np.where(around < np.inf, remoteness, 0).max(axis=1)]
    ends = ends[np.argsort(-remoteness[ends], kind="stable")][:_MOST]
    distances = search(indices=ends)[:, ends]
    unit = max(remoteness[ends].mean(), np.finfo(np.float64).tiny)
    return Extremities(nodes[ends], distances / unit, remoteness[ends] / unit)


def plausible_pairings(x: Extremities, y: Extremities, number: int) -> list[Int64[np.ndarray, "l 2"]]:
    """Ways to pair the ends of two bodies, the likeliest first: which of X's and which of Y's in each row.

    All ends of the body with fewer of them have a partner. The smaller the squared differences of distances
    between ends, and of their remoteness, the likelier. Distances do not tell left from right.

    **Arguments:**

    - `number`: of ways, at most.
    """
    fewer, more = (x, y) if len(x.vertices) <= len(y.vertices) else (y, x)
    partners = np.array(list(permutations(range(len(more.vertices)), len(fewer.vertices))))
    # Between separate pieces it is farther than on any one, and equally far on both bodies.
    of_fewer, of_more = (np.where(np.isfinite(ends.distances), ends.distances, 10) for ends in (fewer, more))
    between = of_more[partners[:, :, None], partners[:, None, :]] - of_fewer
    cost = np.sum(between**2, axis=(1, 2)) / 2
    cost += np.sum((more.remoteness[partners] - fewer.remoteness) ** 2, axis=1)
    best = partners[np.argsort(cost, kind="stable")[:number]]
    pairings = [np.stack([np.arange(len(partner)), partner], axis=1) for partner in best]
    return pairings if fewer is x else [pairing[:, ::-1] for pairing in pairings]
