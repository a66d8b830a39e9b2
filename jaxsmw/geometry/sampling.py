"""The choice of samples, which are evenly spread vertices of a surface."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float64, Int64
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from jaxsmw.errors import InputError
from jaxsmw.geometry.arrays import first_equal_rows
from jaxsmw.geometry.mesh import Mesh

# If edges are much shorter than the usual errors of matches, even good maps look discontinuous at these
# edges. Therefore a mesh with more than `_DENSE` vertices is reduced to about `_SPREAD` samples.
_DENSE, _SPREAD = 15_000, 5000


def farthest_point_samples(
    mesh: Mesh, number_of_samples: int, among: Int64[np.ndarray, " c"] | None = None
) -> Int64[np.ndarray, " s"]:
    """Choose vertices one by one, each as far as possible from all earlier samples, in Euclidean distance.

    The first sample is the vertex farthest from the centroid of the vertices, so the samples do not depend on
    the order of the vertices. Of several equally far vertices, the lowest-numbered one is chosen.

    **Arguments:**

    - `mesh`: the surface. Unreferenced vertices are never chosen.
    - `number_of_samples`: the number s of samples, from 1 to the number of referenced vertices.
    - `among`: the referenced vertices from which samples are chosen (c,); by default all.

    **Returns:** The samples as 0-based vertex indices (s,), int64, in the order in which they were chosen.

    **Raises:** `InputError` if the number of samples is out of its range.
    """
    referenced = mesh.referenced_indices if among is None else among
    if not 1 <= number_of_samples <= len(referenced):
        raise InputError(
            f"{mesh.name}: cannot choose {number_of_samples} samples from {len(referenced)} referenced "
            f"vertices: choose a number from 1 to {len(referenced)}."
        )
    # Each coordinate is one contiguous row, and all arrays are reused, which makes the loop several times
    # faster.
    positions = np.ascontiguousarray(mesh.vertices[referenced].T)
    offsets, squares, nearest = np.empty_like(positions), *np.empty((2, len(referenced)))
    chosen = np.empty(number_of_samples, dtype=np.int64)
    chosen[0] = np.argmax(_squares_from(positions, positions.mean(axis=1), offsets, squares))
    nearest.fill(np.inf)
    for index in range(1, number_of_samples):
        _squares_from(positions, positions[:, chosen[index - 1]], offsets, squares)
        np.minimum(nearest, squares, out=nearest)
        chosen[index] = np.argmax(nearest)
    return referenced[chosen]


def _squares_from(
    positions: Float64[np.ndarray, "3 n"],
    point: Float64[np.ndarray, " 3"],
    offsets: Float64[np.ndarray, "3 n"],
    squares: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, " n"]:
    """Return the squared distances from a point. The arrays `offsets` and `squares` are overwritten."""
    np.subtract(positions, point[:, None], out=offsets)
    np.multiply(offsets, offsets, out=offsets)
    return np.add.reduce(offsets, axis=0, out=squares)


class SurfaceSamples(NamedTuple):
    """The samples of a surface, and the nearest sample of every vertex.

    **Attributes:**

    - `vertices`: the sampled vertices (s,), 0-based and ascending.
    - `nearest`: (n,), for each vertex of the mesh the row of its nearest sample in `vertices`.
    """

    vertices: Int64[np.ndarray, " s"]
    nearest: Int64[np.ndarray, " n"]

    @classmethod
    def along_surface(
        cls, mesh: Mesh, vertices: Int64[np.ndarray, " s"], among: SurfaceSamples | None = None
    ) -> SurfaceSamples:
        """Return given samples (s,) in ascending order, and each vertex's nearest sample along the edges.

        Limbs that touch each other therefore do not share samples. A vertex of a connected component without
        samples has the sample nearest in space. With `among`, denser samples that contain the given ones,
        paths run from one of them to an adjacent one, which takes less time on a large mesh.
        """
        vertices = np.sort(vertices)
        nodes = np.arange(len(mesh.vertices)) if among is None else among.vertices
        positions, edges = mesh.vertices[nodes], mesh.edges if among is None else among.adjacent(mesh)
        lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
        graph = sp.csr_array((lengths, tuple(edges.T)), (len(nodes),) * 2)
        rows = np.searchsorted(nodes, vertices)
        _, _, source = csgraph.dijkstra(
            graph, directed=False, indices=rows, min_only=True, return_predecessors=True
        )
        nearest = np.searchsorted(rows, source)
        if (apart := source < 0).any():
            _, nearest[apart] = KDTree(mesh.vertices[vertices]).query(positions[apart])
        return cls(vertices, nearest if among is None else nearest[among.nearest])

    def adjacent(self, mesh: Mesh) -> Int64[np.ndarray, "e 2"]:
        """Return the pairs of samples, as rows of `vertices`, whose regions are joined by an edge.

        The lower row of each pair is first, and the pairs are in lexicographic order.
        """
        low, high = np.sort(self.nearest[mesh.edges], axis=1).T
        number = len(self.vertices)
        pairs = np.unique((low * number + high)[low < high])  # faster than unique rows
        return np.stack(np.divmod(pairs, number), axis=1)


def poisson_disk_samples(mesh: Mesh, number_of_samples: int) -> SurfaceSamples:
    """Choose vertices that are evenly spread over the area, regardless of the density of the mesh.

    This is Poisson-disk sampling. The candidates are one vertex from each occupied box of a grid. Any two
    samples are farther apart than a minimum Euclidean distance, which follows from the area and the number of
    samples, and every candidate is within this distance of a sample. The side of a box is a third of this
    distance. Two sheets of surface that are closer to each other share their samples. For many samples, the
    function is much faster than `farthest_point_samples`.

    **Arguments:**

    - `mesh`: the surface with n vertices. Unreferenced vertices are never chosen.
    - `number_of_samples`: the approximate number of samples; a coarse mesh has fewer.
    """
    candidates = mesh.referenced_indices
    # At a minimum distance d, a surface has room for about 0.7 area / d² samples.
    distance = (0.7 * mesh.area / number_of_samples) ** 0.5
    # In each box of a grid around the centroid, only the lowest-numbered vertex remains a candidate.
    positions = mesh.vertices - mesh.middle
    boxes = np.floor(positions[candidates] / (distance / 3)).astype(np.int64)
    candidates = candidates[np.unique(first_equal_rows(boxes))]
    tree = KDTree(positions[candidates])
    pairs = tree.sparse_distance_matrix(tree, distance, output_type="coo_matrix")
    near = sp.csr_matrix((np.ones(pairs.nnz, bool), (pairs.row, pairs.col)), pairs.shape)
    vertices = candidates[maximal_independent_set(near, 1)]
    _, nearest = KDTree(positions[vertices]).query(positions)
    return SurfaceSamples(vertices, nearest)


@lru_cache(maxsize=2)
def coarse_edges(mesh: Mesh) -> tuple[Int64[np.ndarray, "e 2"], Int64[np.ndarray, " n"]]:
    """Return the edges (e, 2) of a coarse graph of the surface, and each vertex's nearest node (n,).

    The nodes are vertices of the mesh. A mesh of at most 15 000 vertices is its own graph. On a larger mesh,
    the nodes are about 5000 evenly spread samples, joined where an edge joins the vertices nearest to them.
    """
    n = len(mesh.vertices)
    if n <= _DENSE:
        return mesh.edges, np.arange(n)
    samples = poisson_disk_samples(mesh, _SPREAD)
    return samples.vertices[samples.adjacent(mesh)], samples.vertices[samples.nearest]


def maximal_independent_set(graph: sp.csr_matrix, radius: int) -> Int64[np.ndarray, " s"]:
    """Choose a maximal set of vertices of a graph that are more than `radius` edges apart, ascending.

    `graph` is a symmetric adjacency matrix (n, n) with a stored diagonal. The algorithm is that of Luby, "A
    simple parallel algorithm for the maximal independent set problem", SIAM J. Comput. 1986, with a fixed
    seed.
    """
    n = graph.shape[0]
    rank = np.random.default_rng(0).permutation(n)
    undecided, chosen = np.ones(n, bool), np.zeros(n, bool)
    # Because of the stored diagonal, every vertex is its own neighbour.
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
