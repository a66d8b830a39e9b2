"""Evenly spread vertices."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Int64
from scipy.spatial import KDTree

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh


def farthest_point_samples(mesh: Mesh, number_of_samples: int) -> Int64[np.ndarray, " s"]:
    """Vertices chosen one by one, each the farthest from those before, in Euclidean distance.

    The first is the one farthest from the centroid, so that renumbering the vertices chooses the same
    points (ties, which go to the lowest index, aside).

    **Arguments:**

    - `mesh`: the surface; unused vertices are never chosen.
    - `number_of_samples`: at least 1, at most the number of used vertices.

    **Raises:** `InputError` if that many cannot be chosen.
    """
    used = np.flatnonzero(mesh.used_vertices)
    if not 1 <= number_of_samples <= len(used):
        raise InputError(
            f"{mesh.name}: {number_of_samples} samples were asked for, but it has {len(used)} used vertices; "
            f"ask for between 1 and {len(used)}."
        )
    positions = mesh.vertices[used]
    chosen = np.empty(number_of_samples, dtype=np.int64)
    chosen[0] = np.argmax(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))
    squared_distance = np.full(len(used), np.inf)
    for index in range(1, number_of_samples):
        offsets = positions - positions[chosen[index - 1]]
        squared_distance = np.minimum(squared_distance, np.einsum("ud,ud->u", offsets, offsets))
        chosen[index] = np.argmax(squared_distance)
    return used[chosen]


class Samples(NamedTuple):
    """Vertices that stand for a surface.

    **Attributes:**

    - `vertices`: (s,), ascending.
    - `nearest`: (n,), for every vertex of the mesh the position in `vertices` of the nearest sample.
    """

    vertices: Int64[np.ndarray, " s"]
    nearest: Int64[np.ndarray, " n"]


def spread_samples(mesh: Mesh, number_of_samples: int) -> Samples:
    """About so many vertices, spread evenly over the area however dense the mesh is where.

    As many as fit no two of which are nearer to each other, in space, than a distance that follows from the
    area (Poisson-disk sampling); much faster than `farthest_point_samples` when they are many. Two sheets
    nearer to each other than that share their samples.

    **Arguments:**

    - `mesh`: the surface; unused vertices are never chosen.
    - `number_of_samples`: near the outcome where the mesh is finer than the samples; there are fewer where
      vertices are farther apart than they would be.
    """
    candidates = np.flatnonzero(mesh.used_vertices)
    # A set to which nothing can be added has about 0.7 area / distance² members on a surface.
    distance = (0.7 * mesh.area / number_of_samples) ** 0.5
    # One in each box is enough to choose from; that of the lowest number, in a grid from the centroid on.
    positions = mesh.vertices - mesh.vertices[candidates].mean(axis=0)
    boxes = np.floor(positions[candidates] / (distance / 3)).astype(np.int64)
    _, first = np.unique(boxes, axis=0, return_index=True)
    candidates = np.sort(candidates[first])
    tree = KDTree(positions[candidates])
    pairs = tree.sparse_distance_matrix(tree, distance, output_type="coo_matrix")
    near = sp.csr_matrix((np.ones(pairs.nnz, bool), (pairs.row, pairs.col)), pairs.shape)
    vertices = candidates[independent_vertices(near, 1)]
    _, nearest = KDTree(positions[vertices]).query(positions)
    return Samples(vertices, nearest)


@lru_cache(maxsize=2)
def spread_edges(mesh: Mesh) -> tuple[Int64[np.ndarray, "e 2"], Int64[np.ndarray, " n"]]:
    """Pairs of neighbours not too near to each other; and which vertex of these each is nearest to.

    The edges of the mesh, or if it has more than 15 000 vertices those between 5000 evenly spread ones.
    """
    n = len(mesh.vertices)
    if n <= _DENSE:
        return mesh.edges, np.arange(n)
    samples = spread_samples(mesh, _SPREAD)
    pairs = np.unique(np.sort(samples.nearest[mesh.edges], axis=1), axis=0)
    return samples.vertices[pairs[pairs[:, 0] != pairs[:, 1]]], samples.vertices[samples.nearest]


# Between neighbours that are much nearer to each other than maps are accurate, every map is rough.
_DENSE, _SPREAD = 15_000, 5000


def independent_vertices(graph: sp.csr_matrix, radius: int) -> Int64[np.ndarray, " s"]:
    """Vertices of a graph more than a number of edges apart, as many as fit, ascending.

    Luby, "A simple parallel algorithm for the maximal independent set problem", SIAM J. Comput. 1986, with a
    fixed seed.

    **Arguments:**

    - `graph`: (n, n), symmetric; every row has its diagonal.
    - `radius`: the number of edges, at least 1.
    """
    n = graph.shape[0]
    rank = np.random.default_rng(0).permutation(n)
    undecided, chosen = np.ones(n, bool), np.zeros(n, bool)
    # What is gathered around a vertex includes the vertex, by its diagonal.
    around, start = graph.indices, graph.indptr[:-1]
    while undecided.any():
        highest = np.where(undecided, rank, -1)
        for _ in range(radius):
            highest = np.maximum.reduceat(highest[around], start)
        covered = undecided & (highest == rank)
        chosen |= covered
        for _ in range(radius):
            covered = np.logical_or.reduceat(covered[around], start)
        undecided &= ~covered
    return np.flatnonzero(chosen)
