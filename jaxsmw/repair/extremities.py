"""The extremities of a body, such as the ends of its limbs, and pairings of the extremities of two bodies."""

from __future__ import annotations

from functools import partial
from itertools import permutations
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float64, Int64
from scipy.sparse.csgraph import dijkstra

from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import coarse_edges, poisson_disk_samples
from jaxsmw.repair.settings import ExtremitySettings

# This finite value replaces the infinite distance between two connected components. The value is larger than
# any distance within a component, and it is the same for both bodies.
_ELSEWHERE = 10.0


class Extremities(NamedTuple):
    """The extremities of a body, in descending order of their remoteness.

    The remoteness of a vertex is the root mean square of its distances to all points of the surface.

    **Attributes:**

    - `vertices`: the vertices at the extremities (e,).
    - `distances`: the distances between extremities (e, e) along the surface, in units of the mean remoteness
      of the extremities; inf between connected components.
    - `remoteness`: the remoteness of each extremity (e,), in units of the mean remoteness of the extremities.
    """

    vertices: Int64[np.ndarray, " e"]
    distances: Float64[np.ndarray, "e e"]
    remoteness: Float64[np.ndarray, " e"]


def extremities(
    mesh: Mesh,
    settings: ExtremitySettings = ExtremitySettings(),  # noqa: B008 (immutable)
) -> Extremities:
    """Find the extremities of a body, such as the ends of its limbs.

    Extremities are the local maxima of the mean squared distance to the whole surface (Hilaga et al. 2001,
    "Topology matching for fully automatic similarity estimation of 3D shapes"). Distances are measured along
    edges, so all distances are a few percent too long.

    **Arguments:**

    - `mesh`: the surface.
    - `settings`: the number of samples, the smallest distance between extremities, and the largest number of
      extremities.

    **Returns:** The `Extremities`, at most `settings.most` of them.
    """
    edges, nearest = coarse_edges(mesh)
    nodes, tails_and_heads = np.unique(edges, return_inverse=True)
    tails, heads = tails_and_heads.reshape(edges.shape).T
    lengths = np.linalg.norm(np.diff(mesh.vertices[edges], axis=1)[:, 0], axis=1) / mesh.area**0.5
    graph = sp.csr_array((lengths, (tails, heads)), (len(nodes), len(nodes)))
    search = partial(dijkstra, graph, directed=False)

    samples = np.intersect1d(nodes, nearest[poisson_disk_samples(mesh, settings.samples).vertices])
    distances = search(indices=np.searchsorted(nodes, samples))
    remoteness = np.sqrt(np.mean(np.where(np.isfinite(distances), distances, 0) ** 2, axis=0))
    highest = np.ones(len(nodes), bool)
    highest[tails[remoteness[tails] < remoteness[heads]]] = False
    highest[heads[remoteness[heads] < remoteness[tails]]] = False
    candidates = np.flatnonzero(highest)
    around = search(indices=candidates, limit=settings.distance)
    ends = candidates[remoteness[candidates] >= np.where(around < np.inf, remoteness, 0).max(axis=1)]
    ends = ends[np.argsort(-remoteness[ends], kind="stable")][: settings.most]
    distances = search(indices=ends)[:, ends]
    unit = max(remoteness[ends].mean(), np.finfo(np.float64).tiny)
    return Extremities(nodes[ends], distances / unit, remoteness[ends] / unit)


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
    fewer, more = (x, y) if len(x.vertices) <= len(y.vertices) else (y, x)
    partners = np.array(list(permutations(range(len(more.vertices)), len(fewer.vertices))))
    of_fewer, of_more = (
        np.where(np.isfinite(ends.distances), ends.distances, _ELSEWHERE) for ends in (fewer, more)
    )
    between = of_more[partners[:, :, None], partners[:, None, :]] - of_fewer
    cost = np.sum(between**2, axis=(1, 2)) / 2
    cost += np.sum((more.remoteness[partners] - fewer.remoteness) ** 2, axis=1)
    best = partners[np.argsort(cost, kind="stable")[:number]]
    pairings = [np.stack([np.arange(len(partner)), partner], axis=1) for partner in best]
    return pairings if fewer is x else [pairing[:, ::-1] for pairing in pairings]
