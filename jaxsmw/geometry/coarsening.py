"""A smooth subspace of far fewer dimensions than a surface has vertices."""

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


class Coarsening(NamedTuple):
    """A generalised eigenproblem seen in a subspace.

    **Attributes:**

    - `prolongation`: P (n, c), from coefficients to values at vertices; its rows sum to one.
    - `stiffness`, `mass`: P^T W P and P^T A P, (c, c).
    - `smooth`: from values (n, j) to what of them cells can show, and a little beyond.

    Prolongation and smoothing are in single precision, whose errors are far below those of the subspace.
    """

    prolongation: sp.csr_matrix
    stiffness: sp.csc_matrix
    mass: sp.csc_matrix
    smooth: Callable[[np.ndarray], np.ndarray]


def coarsen(stiffness: sp.csc_matrix, mass: sp.csc_matrix, dimensions: int) -> Coarsening:
    """Smoothed aggregation: vertices in cells around evenly spread ones, the cells' indicators smoothed.

    Vaněk, Mandel, Brezina, "Algebraic multigrid by smoothed aggregation for second and fourth order elliptic
    problems", Computing 1996, in a single step whatever the size of the cells: one and a half times
    their reach in edges is the degree of the Chebyshev polynomial that smooths. (Their reach alone costs a
    fifth less, and makes errors of eigenvalues ten times as large.)

    **Arguments:**

    - `stiffness`: W (n, n), symmetric, of one connected component; its entries are the mesh's edges.
    - `mass`: A (n, n).
    - `dimensions`: how many are wanted; the outcome is near it, and at most about n / 4.

    **Raises:** `RuntimeError` if W has no positive diagonal, a vertex so many neighbours that the smoothed
    indicators would overlap everywhere, or much of the area cells much larger than elsewhere.
    """
    n = stiffness.shape[0]
    if (most := int(np.diff(stiffness.indptr).max())) > _MOST_NEIGHBORS:
        raise RuntimeError(f"a vertex has {most - 1} neighbours")
    # With seeds more than r edges apart a cell has on average about 1.25 (r + 1)² vertices.
    radius = max(1, round((n / (1.25 * dimensions)) ** 0.5) - 1)
    stiffness = stiffness.tocsr()
    edges = sp.csr_matrix(
        (np.ones(stiffness.nnz, bool), stiffness.indices, stiffness.indptr), stiffness.shape
    )
    cells = _cells(edges, radius)
    areas = cells.T @ mass.diagonal()
    share = areas[areas > _LARGE * areas.sum() / min(dimensions, len(areas))].sum() / areas.sum()
    if share > _MOST_IN_LARGE:
        raise RuntimeError(f"{share:.0%} of its area is in triangles much larger than the others")
    smoother = _Smoother(stiffness, cells.shape[0] / cells.shape[1])
    degree = (3 * (radius + 1) + 1) // 2
    prolongation = smoother(cells, degree)
    rough = smoother.single()
    return Coarsening(
        prolongation.astype(np.float32),
        (prolongation.T @ (stiffness @ prolongation)).tocsc(),
        (prolongation.T @ (mass @ prolongation)).tocsc(),
        lambda values: rough(values.astype(np.float32), degree - 1),
    )


_MOST_NEIGHBORS = 100
# A cell is large from four times the area that each would have if all had the same.
_LARGE, _MOST_IN_LARGE = 4, 0.1


def _cells(graph: sp.csr_matrix, radius: int) -> sp.csr_matrix:
    """Which vertex is in which cell, (n, c): with the seed that is the fewest edges away."""
    n = graph.shape[0]
    seeds = maximal_independent_set(graph, radius)
    _, _, nearest = dijkstra(graph, indices=seeds, unweighted=True, min_only=True, return_predecessors=True)
    cell = np.searchsorted(seeds, nearest)
    return sp.csr_matrix((np.ones(n), cell, np.arange(n + 1)), shape=(n, len(seeds)))


class _Smoother:
    """Chebyshev polynomials of D^-1 W, D the diagonal of W, that leave constants and damp what is rough.

    Rough is what cells of a given size cannot show: eigenvalues of D^-1 W from about 1.5 times the largest
    over that size. (Between 1 and 3 times the eigenvalues of a body come out about as well.)
    """

    def __init__(self, stiffness: sp.csr_matrix, size: float):
        diagonal = stiffness.diagonal()
        if not (diagonal > 0).all():
            raise RuntimeError("the stiffness matrix has no positive diagonal")
        root = sp.diags(1 / np.sqrt(diagonal))
        start = np.random.default_rng(0).standard_normal(len(diagonal))
        found = eigsh(root @ stiffness @ root, 1, v0=start, tol=1e-2, return_eigenvectors=False)
        highest = 1.05 * float(found[0])
        lowest = highest * min(1.5 / size, 0.5)
        self.center, self.half = (highest + lowest) / 2, (highest - lowest) / 2
        self.operator = sp.diags(1 / diagonal) @ stiffness

    def single(self) -> _Smoother:
        """The same in single precision."""
        other = copy(self)
        other.operator = self.operator.astype(np.float32)
        return other

    def __call__(self, vectors: Matrix, degree: int) -> Matrix:
        """p(D^-1 W) times vectors, p of the degree, by the three-term recurrence."""
        slope = self.center / self.half
        ratio = 1 / slope
        step = (self.operator @ vectors) * (-1 / self.center)
        vectors = vectors + step
        for _ in range(degree - 1):
            previous, ratio = ratio, 1 / (2 * slope - ratio)
            # In place, where they are dense: these are the largest arrays there are.
            step *= ratio * previous
            change = self.operator @ vectors
            change *= 2 * ratio / self.half
            step -= change
            vectors += step
        return vectors
