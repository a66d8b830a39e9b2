"""Crease eigenvectors: eigenvectors of a Laplacian that also measures changes of the normals."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float64

from jaxsmw.geometry.eigenbasis import check_number_of_eigenvectors, solve_on_surface
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.runtime.cache import cached

# The weight of unit normals relative to positions, in units of the square root of the area. (Table R43 of
# docs/research_log.md)
_NORMAL_WEIGHT = 0.07
# Edges are lengthened until each triangle inequality holds with this margin, relative to the mean length of
# all edges. Without a margin, the Laplacian of a degenerate triangle is not defined.
_MARGIN = 1e-3


def crease_eigenvectors(mesh: Mesh, number: int) -> Float64[np.ndarray, "n c"]:
    """Compute the first crease eigenvectors of a mesh.

    Crease eigenvectors are the eigenvectors of the Laplace–Beltrami operator of another metric. In this
    metric, the squared length of an edge is the sum of its squared length in space and the squared difference
    of the unit normals at its ends, multiplied by 0.07². Lengths are in units of the square root of the area.
    Unlike the usual eigenvectors, crease eigenvectors depend on how the surface bends, and contain further
    information on the place of a vertex on the body. (Hybrid functional maps use a basis of a thin-shell
    energy for this purpose; Bastian, Xie, Navab, Lähner 2024.)

    Crease eigenvectors do not depend on the scale, position and rotation of the mesh, nor on a reflection.
    The entry of largest absolute value of each eigenvector is positive. Results are cached on disk
    (`jaxsmw.runtime.cache`).

    **Arguments:**

    - `mesh`: the surface with n vertices, a `Mesh`.
    - `number`: the number c of eigenvectors, the constant one included, at least 1 and less than the number
      of referenced vertices.

    **Returns:** The eigenvectors (n, c), without unit, each with mean square 1 in the other metric, and zero
    at unreferenced vertices.

    **Raises:** `InputError` if `number` is out of its range, or if the eigenproblem cannot be solved
    accurately.
    """
    return crease_eigenpairs(mesh, number)[1]


def crease_eigenpairs(
    mesh: Mesh, number: int
) -> tuple[Float64[np.ndarray, " c"], Float64[np.ndarray, "n c"]]:
    """Return the eigenvalues (c,) and the `crease_eigenvectors` (n, c), without unit."""
    check_number_of_eigenvectors(mesh, number)

    def compute() -> dict[str, np.ndarray]:
        eigenvalues, eigenvectors = solve_on_surface(mesh, *_assemble(mesh), number)
        return {"eigenvalues": eigenvalues, "eigenvectors": eigenvectors}

    inputs = mesh.vertices, mesh.faces, number, _NORMAL_WEIGHT
    pairs = cached("crease-eigenpairs", inputs, compute)
    return pairs["eigenvalues"], pairs["eigenvectors"]


def _assemble(mesh: Mesh) -> tuple[sp.csc_matrix, Float64[np.ndarray, " n"]]:
    """Assemble the stiffness matrix (n, n) and vertex areas (n,), of sum 1, of the metric with normals."""
    places = np.hstack([mesh.vertices / np.sqrt(mesh.area), _NORMAL_WEIGHT * mesh.vertex_normals])
    corners = places[mesh.faces]
    # Row i of `lengths` contains, for each corner of triangle i, the length of the opposite edge.
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)
    excess = lengths.sum(axis=1) - 2 * lengths.max(axis=1)
    lengths += np.maximum(_MARGIN * lengths.mean() - excess, 0)[:, None]
    stiffness = -igl.cotmatrix_intrinsic(lengths, mesh.faces).tocsc()
    halves = np.abs(lengths - lengths.sum(axis=1, keepdims=True) / 2)
    areas = np.sqrt(halves.prod(axis=1) * lengths.sum(axis=1) / 2)  # Heron's formula
    return stiffness, mesh.sum_at_vertices(areas / areas.sum() / 3)
