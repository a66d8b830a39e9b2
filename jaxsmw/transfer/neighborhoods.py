"""The edges of a mesh with cotangent weights, and the similarity transformations of its neighbourhoods."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import igl
import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array, diags_array

from jaxsmw.geometry.mesh import Mesh

# Cotangent weights of very obtuse triangles are negative, and those of slivers are huge. Weights are limited
# to the range from 1/_WEIGHT_RANGE to _WEIGHT_RANGE times the median weight.
_WEIGHT_RANGE = 10.0
# The scale of a neighbourhood is limited to the range from 1/_SCALE_RANGE to _SCALE_RANGE. Where a map
# collapses a region to a point, the scale would otherwise be zero.
_SCALE_RANGE = 5.0
# The rotations include a reflection only if the determinants of the moments are clearly negative. Their sum
# must be below minus this fraction of the summed cubes of the largest singular values.
_FLAT = 1e-12


class Similarities(NamedTuple):
    """A similarity transformation for each vertex.

    **Attributes:**

    - `rotations`: (n, 3, 3), orthogonal. All determinants are 1, or all determinants are -1.
    - `scales`: (n,), positive.
    """

    rotations: Float64[np.ndarray, "n 3 3"]
    scales: Float64[np.ndarray, " n"]

    def of_vectors(self, vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return the vector at each vertex (n, 3), rotated and scaled."""
        return self.scales[:, None] * np.einsum("nij,nj->ni", self.rotations, vectors)


@dataclass(frozen=True, eq=False)
class Neighborhoods:
    """The edges of a mesh, which is scaled by the factor `size`, with positive weights.

    **Attributes:**

    - `mesh`: the mesh, with n vertices and e edges.
    - `size`: the factor by which lengths of the mesh are multiplied.
    """

    mesh: Mesh
    size: float = 1.0

    @cached_property
    def edges(self) -> Int64[np.ndarray, "e 2"]:
        """The edges of the mesh, as pairs of vertices."""
        return self.mesh.edges

    @cached_property
    def vectors(self) -> Float64[np.ndarray, "e 3"]:
        """The vector of each edge of the scaled mesh, from the edge's second vertex to its first vertex."""
        return self.size * self.differences(self.mesh.vertices)

    @cached_property
    def weights(self) -> Float64[np.ndarray, " e"]:
        """The cotangent weights of the edges, limited to a range of positive numbers."""
        cotangents = csr_array(igl.cotmatrix(self.mesh.vertices, self.mesh.faces))
        weights = np.nan_to_num(cotangents[self.edges[:, 0], self.edges[:, 1]], posinf=np.inf, neginf=-np.inf)
        usable = weights[(weights > 0) & np.isfinite(weights)]
        median = np.median(usable) if len(usable) else 1.0
        return np.clip(weights, median / _WEIGHT_RANGE, median * _WEIGHT_RANGE)

    @cached_property
    def incidence(self) -> csr_array:
        """The matrix (n, e) that takes values on edges to signed sums at vertices."""
        e = np.arange(len(self.edges))
        signs = np.repeat([1.0, -1.0], len(e))
        shape = len(self.mesh.vertices), len(e)
        return csr_array((signs, (self.edges.T.ravel(), np.tile(e, 2))), shape=shape)

    @cached_property
    def laplacian(self) -> csr_array:
        """The Laplacian of the weighted edges (n, n), positive semi-definite."""
        return csr_array(self.incidence @ diags_array(self.weights) @ self.incidence.T)

    @cached_property
    def averaging(self) -> csr_array:
        """The matrix (n, n) that averages each vertex with its weighted neighbours."""
        totals = self.laplacian.diagonal()
        inverse = np.divide(1, totals, out=np.zeros_like(totals), where=totals > 0)
        return csr_array(diags_array(np.ones(len(totals))) - 0.5 * diags_array(inverse) @ self.laplacian)

    def differences(self, values: Float64[np.ndarray, "n ..."]) -> Float64[np.ndarray, "e ..."]:
        """Return the value at the first vertex minus the value at the second vertex of each edge."""
        return values[self.edges[:, 0]] - values[self.edges[:, 1]]

    def similarities(self, positions: Float64[np.ndarray, "n 3"], averagings: int) -> Similarities:
        """Fit a similarity transformation to each neighbourhood, from the mesh to other positions.

        More averagings enlarge the neighbourhood of each vertex. The fit is that of as-rigid-as-possible
        deformation (Sorkine, Alexa 2007), extended by a scale. If most neighbourhoods are reflected, all
        rotations include a reflection.
        """
        vectors = self.vectors
        products = self.weights[:, None, None] * self.differences(positions)[:, :, None] * vectors[:, None, :]
        lengths = self.weights * (vectors**2).sum(axis=1)
        sums = abs(self.incidence) @ np.column_stack([products.reshape(-1, 9), lengths])
        for _ in range(averagings):
            sums = self.averaging @ sums
        moments, lengths = sums[:, :9].reshape(-1, 3, 3), sums[:, 9]
        left, singular, right = np.linalg.svd(moments)
        # The determinants of a flat mesh are rounding errors, so their signs mean nothing.
        hand = -1.0 if np.linalg.det(moments).sum() < -_FLAT * (singular[:, 0] ** 3).sum() else 1.0
        flip = np.where(np.linalg.det(left @ right) * hand < 0, -1.0, 1.0)
        left[:, :, 2] *= flip[:, None]
        singular[:, 2] *= flip
        scales = np.divide(singular.sum(axis=1), lengths, out=np.ones(len(lengths)), where=lengths > 0)
        return Similarities(left @ right, np.clip(scales, 1 / _SCALE_RANGE, _SCALE_RANGE))

    def transformed(self, similarities: Similarities) -> Float64[np.ndarray, "e 3"]:
        """Return the vector of each edge, transformed by the mean of the transformations of its vertices."""
        matrices = similarities.rotations * similarities.scales[:, None, None]
        means = 0.5 * (matrices[self.edges[:, 0]] + matrices[self.edges[:, 1]])
        return np.einsum("eij,ej->ei", means, self.vectors)
