"""The edges of a mesh with cotangent weights, and the similarity transformations of its neighbourhoods."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import igl
import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array, diags_array

from jaxsmw.geometry.alignment import nearest_rotations
from jaxsmw.geometry.arrays import ratio
from jaxsmw.geometry.mesh import Mesh

# Values at vertices are averaged over neighbouring vertices _AVERAGINGS times. More averagings enlarge the
# neighbourhood of each vertex. With fewer averagings, the similarity transformations follow the noise of
# the map. (Entry R22 of docs/research_log.md)
_AVERAGINGS = 8
# Cotangent weights of very obtuse triangles are negative, and those of slivers are huge. Weights are limited
# to the range from 1/_WEIGHT_RANGE to _WEIGHT_RANGE times the median weight.
_WEIGHT_RANGE = 10.0
# The scale of a neighbourhood is limited to the range from 1/_SCALE_RANGE to _SCALE_RANGE. Where a map
# collapses a region to a point, the scale would otherwise be zero.
_SCALE_RANGE = 5.0
# The rotations include a reflection only if the determinants of the moments are clearly negative. The sum of
# the determinants must be below -_FLAT times the sum of the cubed Frobenius norms of the moments.
_FLAT = 1e-12


class Similarities(NamedTuple):
    """A similarity transformation for each vertex.

    **Attributes:**

    - `rotations`: (n, 3, 3), orthogonal. All determinants are 1, or all determinants are -1.
    - `scales`: (n,), positive: the factor by which lengths are multiplied.
    """

    rotations: Float64[np.ndarray, "n 3 3"]
    scales: Float64[np.ndarray, " n"]

    @property
    def hand(self) -> float:
        """-1 if the transformations include a reflection, otherwise 1."""
        return float(np.sign(np.linalg.det(self.rotations[0])))

    def of_vectors(self, vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return the vector at each vertex (n, 3), rotated and scaled."""
        return self.scales[:, None] * np.einsum("nij,nj->ni", self.rotations, vectors)


@dataclass(frozen=True, eq=False)
class Neighborhoods:
    """The edges of a mesh (n vertices, e edges), with its lengths multiplied by the factor `size`."""

    mesh: Mesh
    size: float = 1.0

    @cached_property
    def edges(self) -> Int64[np.ndarray, "e 2"]:
        """The edges of the mesh, as pairs of vertices."""
        return self.mesh.edges

    @cached_property
    def vectors(self) -> Float64[np.ndarray, "e 3"]:
        """The vector of each edge of the scaled mesh, from its second vertex to its first vertex."""
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
    def laplacian(self) -> csr_array:
        """The Laplacian of the weighted edges (n, n), positive semi-definite."""
        adjacency = self._matrix(self.weights, self.weights)
        return csr_array(diags_array(adjacency.sum(axis=1)) - adjacency)

    @cached_property
    def components(self) -> tuple[csr_array, csr_array, csr_array]:
        """The components of the weighted vectors from vertex j to vertex i, each a matrix (n, n)."""
        x, y, z = (self.weights * component for component in self.vectors.T)
        return self._matrix(x, -x), self._matrix(y, -y), self._matrix(z, -z)

    @cached_property
    def component_sums(self) -> Float64[np.ndarray, "n 3"]:
        """The sums of the rows of `components`."""
        return np.stack([matrix.sum(axis=1) for matrix in self.components], axis=1)

    @cached_property
    def squared_lengths(self) -> Float64[np.ndarray, " n"]:
        """The weighted sums of squared edge lengths at the vertices, averaged over neighbourhoods."""
        of_edges = self.weights * (self.vectors**2).sum(axis=1)
        return self._averaged(self._matrix(of_edges, of_edges).sum(axis=1))

    def _matrix(self, forward: Float64[np.ndarray, " e"], backward: Float64[np.ndarray, " e"]) -> csr_array:
        """Return a matrix (n, n) with two entries per edge: `forward` at (i, j) and `backward` at (j, i)."""
        first, second = self.edges.T
        at = np.concatenate([first, second]), np.concatenate([second, first])
        n = len(self.mesh.vertices)
        return csr_array((np.concatenate([forward, backward]), at), shape=(n, n))

    @cached_property
    def averaging(self) -> csr_array:
        """The matrix (n, n) that averages each vertex with its weighted neighbours."""
        totals = self.laplacian.diagonal()
        inverse = diags_array(ratio(1.0, totals))
        return csr_array(diags_array(np.ones(len(totals))) - 0.5 * inverse @ self.laplacian)

    def _averaged(self, values: Float64[np.ndarray, "n ..."]) -> Float64[np.ndarray, "n ..."]:
        """Average the values at each vertex with those of its neighbourhood."""
        for _ in range(_AVERAGINGS):
            values = self.averaging @ values
        return values

    def differences(self, values: Float64[np.ndarray, "n ..."]) -> Float64[np.ndarray, "e ..."]:
        """Return the value at the first vertex of each edge minus the value at its second vertex."""
        return values[self.edges[:, 0]] - values[self.edges[:, 1]]

    def similarities(self, positions: Float64[np.ndarray, "n 3"]) -> Similarities:
        """Fit the transformation of each neighbourhood. If most are reflected, all rotations reflect."""
        # The fit is that of as-rigid-as-possible deformation (Sorkine, Alexa 2007), extended by a scale.
        components = zip(self.components, self.component_sums.T, strict=True)
        columns = [total[:, None] * positions - matrix @ positions for matrix, total in components]
        moments = np.stack(columns, axis=2)
        moments = self._averaged(moments.reshape(-1, 9)).reshape(-1, 3, 3)
        # The determinants of a flat mesh are rounding errors, so their signs mean nothing.
        determinants = (moments[:, 0] * np.cross(moments[:, 1], moments[:, 2])).sum(axis=1)
        largest = ((moments**2).sum(axis=(1, 2)) ** 1.5).sum()
        hand = -1.0 if determinants.sum() < -_FLAT * largest else 1.0
        rotations, traces = nearest_rotations(hand * moments)
        scales = ratio(traces, self.squared_lengths, otherwise=1.0)
        return Similarities(hand * rotations, np.clip(scales, 1 / _SCALE_RANGE, _SCALE_RANGE))

    def divergence(self, similarities: Similarities) -> Float64[np.ndarray, "n 3"]:
        """Return the weighted sums of edge vectors to each vertex, transformed by the mean of both ends."""
        matrices = similarities.rotations * similarities.scales[:, None, None]
        sums = np.zeros((len(matrices), 3))
        for axis, (matrix, total) in enumerate(zip(self.components, self.component_sums.T, strict=True)):
            columns = np.ascontiguousarray(matrices[:, :, axis])
            sums += total[:, None] * columns + matrix @ columns
        return 0.5 * sums
