"""A subspace of smooth functions on a surface, with far fewer dimensions than the mesh has vertices."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import eigsh

from jaxsmw.geometry.sampling import maximal_independent_set

Matrix = TypeVar("Matrix", np.ndarray, sp.csr_matrix)

_MOST_NEIGHBORS = 100
# A cell is large if its area is more than `_LARGE` times the mean area of a cell. The share of the total area
# in large cells may be at most `_MOST_IN_LARGE`.
_LARGE, _MOST_IN_LARGE = 4, 0.1


class Coarsening(NamedTuple):
    """A generalized eigenproblem, projected onto a subspace of smooth functions; see `coarsen`."""

    prolongation: sp.csr_matrix  # from coefficients to values at vertices; each row sums to one
    stiffness: sp.csc_matrix
    mass: sp.csc_matrix
    # A low-pass filter for values at vertices (n, j). It passes frequencies up to slightly above the highest
    # frequency that the subspace can represent.
    smooth: Callable[[np.ndarray], np.ndarray]


def coarsen(stiffness: sp.csc_matrix, mass: sp.csc_matrix, dimensions: int) -> Coarsening:
    """Coarsen an eigenproblem by smoothed aggregation of vertices into cells around evenly spread seeds.

    The smoothed indicator functions of the cells span the subspace (Vaněk, Mandel, Brezina, "Algebraic
    multigrid by smoothed aggregation for second and fourth order elliptic problems", Computing 1996). Here,
    one step makes cells of any size, because a Chebyshev polynomial smooths the indicator functions.

    **Arguments:**

    - `stiffness`, `mass`: the symmetric matrices (n, n) of one connected component. The stiffness matrix has
      an entry for each edge.
    - `dimensions`: the approximate dimension of the subspace, at most about n / 4.

    **Raises:** `RuntimeError` if the diagonal of the stiffness matrix is not positive, a vertex has 100 or
    more neighbours, or cells larger than four times the mean cell cover more than 10 % of the surface.
    """
    n = stiffness.shape[0]
    if (most := int(np.diff(stiffness.indptr).max())) > _MOST_NEIGHBORS:
        raise RuntimeError(f"a vertex has {most - 1} neighbours")
    # If seeds are more than r edges apart, a cell contains about 1.25 (r + 1)² vertices on average.
    radius = max(1, round((n / (1.25 * dimensions)) ** 0.5) - 1)
    stiffness = stiffness.tocsr()
    edges = sp.csr_matrix(
        (np.ones(stiffness.nnz, bool), stiffness.indices, stiffness.indptr), stiffness.shape
    )
    cells = _cells(edges, radius)
    areas = cells.T @ mass.diagonal()
    share = areas[areas > _LARGE * areas.sum() / min(dimensions, len(areas))].sum() / areas.sum()
    if share > _MOST_IN_LARGE:
        raise RuntimeError(f"{share:.0%} of the area is in triangles that are much larger than the rest")
    smoother = _Smoother(stiffness, cells.shape[0] / cells.shape[1])
    # The degree is 1.5 times the radius of the cells. With a degree equal to the radius, coarsening takes
    # 20 % less time, but the errors of the eigenvalues are ten times as large.
    degree = (3 * (radius + 1) + 1) // 2
    prolongation = smoother(cells, degree)
    rough = smoother.single()
    # Rounding errors in single precision are far smaller than the projection errors.
    return Coarsening(
        prolongation.astype(np.float32),
        (prolongation.T @ (stiffness @ prolongation)).tocsc(),
        (prolongation.T @ (mass @ prolongation)).tocsc(),
        lambda values: rough(values.astype(np.float32), degree - 1),
    )


def _cells(graph: sp.csr_matrix, radius: int) -> sp.csr_matrix:
    """Return the indicator functions (n, c) of the cells: a vertex joins its nearest seed along edges."""
    n = graph.shape[0]
    seeds = maximal_independent_set(graph, radius)
    _, _, nearest = dijkstra(graph, indices=seeds, unweighted=True, min_only=True, return_predecessors=True)
    cell = np.searchsorted(seeds, nearest)
    return sp.csr_matrix((np.ones(n), cell, np.arange(n + 1)), shape=(n, len(seeds)))


class _Smoother:
    """A low-pass filter, a Chebyshev polynomial of D^-1 W, which passes constant functions unchanged."""

    def __init__(self, stiffness: sp.csr_matrix, size: float):
        diagonal = stiffness.diagonal()
        if not (diagonal > 0).all():
            raise RuntimeError("the diagonal of the stiffness matrix is not positive")
        root = sp.diags(1 / np.sqrt(diagonal))
        start = np.random.default_rng(0).standard_normal(len(diagonal))
        found = eigsh(root @ stiffness @ root, 1, v0=start, tol=1e-2, return_eigenvectors=False)
        highest = 1.05 * float(found[0])
        # The filter damps eigenvectors above `lowest`, which cells of `size` vertices cannot represent. (On
        # meshes of bodies, factors from 1 to 3 instead of 1.5 give about the same accuracy.)
        lowest = highest * min(1.5 / size, 0.5)
        self.center, self.half = (highest + lowest) / 2, (highest - lowest) / 2
        self.operator = sp.diags(1 / diagonal) @ stiffness

    def single(self) -> _Smoother:
        """Return a copy of this filter that computes in single precision."""
        other = copy(self)
        other.operator = self.operator.astype(np.float32)
        return other

    def __call__(self, vectors: Matrix, degree: int) -> Matrix:
        """Apply the Chebyshev polynomial of the given degree to vectors (n, j) by a three-term recurrence."""
        slope = self.center / self.half
        ratio = 1 / slope
        step = (self.operator @ vectors) * (-1 / self.center)
        vectors = vectors + step
        for _ in range(degree - 1):
            previous, ratio = ratio, 1 / (2 * slope - ratio)
            # Dense vectors are updated in place to save memory.
            step *= ratio * previous
            change = self.operator @ vectors
            change *= 2 * ratio / self.half
            step -= change
            vectors += step
        return vectors
