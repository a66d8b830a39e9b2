"""A smooth subspace of functions on a surface, with far fewer dimensions than the surface has vertices."""

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
    """A generalized eigenproblem projected onto a subspace.

    **Attributes:**

    - `prolongation`: P (n, c), from coefficients to values at vertices. Its rows sum to one.
    - `stiffness`, `mass`: P^T W P and P^T A P, (c, c).
    - `smooth`: a low-pass filter for values (n, j). It keeps the frequencies that the cells can represent,
      and slightly higher frequencies.

    Prolongation and smoothing are in single precision, whose errors are far below those of the subspace.
    """

    prolongation: sp.csr_matrix
    stiffness: sp.csc_matrix
    mass: sp.csc_matrix
    smooth: Callable[[np.ndarray], np.ndarray]


def coarsen(stiffness: sp.csc_matrix, mass: sp.csc_matrix, dimensions: int) -> Coarsening:
    """Coarsen an eigenproblem by smoothed aggregation of vertices into cells.

    The cells surround evenly spread seeds. The smoothed indicator functions of the cells span the subspace.
    Vaněk, Mandel, Brezina, "Algebraic multigrid by smoothed aggregation for second and fourth order elliptic
    problems", Computing 1996. Here a single step suffices for cells of any size. The reason is the degree of
    the smoothing Chebyshev polynomial, which is one and a half times the radius of the cells in edges. (With
    a degree equal to the radius, coarsening takes a fifth less time, but the errors of eigenvalues are ten
    times as large.)

    **Arguments:**

    - `stiffness`: W (n, n), symmetric, of one connected component. Its entries are the edges of the mesh.
    - `mass`: A (n, n).
    - `dimensions`: the approximate dimension of the subspace, at most about n / 4.

    **Returns:** The projected eigenproblem.

    **Raises:** `RuntimeError` if the diagonal of W is not positive, if a vertex has so many neighbors that
    smoothed indicators would overlap everywhere, or if large cells cover more than a tenth of the area.
    """
    n = stiffness.shape[0]
    if (most := int(np.diff(stiffness.indptr).max())) > _MOST_NEIGHBORS:
        raise RuntimeError(f"a vertex has {most - 1} neighbors")
    # If seeds are more than r edges apart, a cell has about 1.25 (r + 1)² vertices on average.
    radius = max(1, round((n / (1.25 * dimensions)) ** 0.5) - 1)
    stiffness = stiffness.tocsr()
    edges = sp.csr_matrix(
        (np.ones(stiffness.nnz, bool), stiffness.indices, stiffness.indptr), stiffness.shape
    )
    cells = _cells(edges, radius)
    areas = cells.T @ mass.diagonal()
    share = areas[areas > _LARGE * areas.sum() / min(dimensions, len(areas))].sum() / areas.sum()
    if share > _MOST_IN_LARGE:
        raise RuntimeError(f"{share:.0%} of the area is in triangles much larger than the others")
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
# A cell is large if its area is four times the mean or more. Large cells may cover this share of the area.
_LARGE, _MOST_IN_LARGE = 4, 0.1


def _cells(graph: sp.csr_matrix, radius: int) -> sp.csr_matrix:
    """Return the indicator functions (n, c) of the cells. Each cell has one seed.

    Each vertex joins the cell whose seed is the smallest number of edges away.
    """
    n = graph.shape[0]
    seeds = maximal_independent_set(graph, radius)
    _, _, nearest = dijkstra(graph, indices=seeds, unweighted=True, min_only=True, return_predecessors=True)
    cell = np.searchsorted(seeds, nearest)
    return sp.csr_matrix((np.ones(n), cell, np.arange(n + 1)), shape=(n, len(seeds)))


class _Smoother:
    """Chebyshev polynomials of D^-1 W, with D the diagonal of W, as low-pass filters that keep constants.

    High frequencies are those that cells of a given number of vertices cannot represent: eigenvalues of D^-1
    W above 1.5 times the largest eigenvalue divided by that number. (Factors from 1 to 3 give about the same
    accuracy on bodies.)
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
        """Return this smoother in single precision."""
        other = copy(self)
        other.operator = self.operator.astype(np.float32)
        return other

    def __call__(self, vectors: Matrix, degree: int) -> Matrix:
        """Apply p(D^-1 W), with p of the given degree, to vectors, by the three-term recurrence."""
        slope = self.center / self.half
        ratio = 1 / slope
        step = (self.operator @ vectors) * (-1 / self.center)
        vectors = vectors + step
        for _ in range(degree - 1):
            previous, ratio = ratio, 1 / (2 * slope - ratio)
            # Dense vectors are updated in place, because they are the largest arrays of all.
            step *= ratio * previous
            change = self.operator @ vectors
            change *= 2 * ratio / self.half
            step -= change
            vectors += step
        return vectors
