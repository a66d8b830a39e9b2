"""Proxies, which are shapes reduced to evenly spread samples."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.sparse import coo_array, csgraph, csr_array, vstack
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from jaxsmw.core.arrays import namespace
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.alignment import oriented_points, symmetries
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, mirrored_descriptors, sampled_shot_descriptors
from jaxsmw.matching.shape import PreparedShape

SampleMap = Int64[np.ndarray, " s"]
"""A map of samples: for each sample of X, the 0-based index of a sample of Y."""

# The number of samples of each shape. With fewer samples, the bumps of a folded surface are lost.
SAMPLES = 1000
# The radius of the patches that a right map moves nearly rigidly, in units of the square root of the area,
# and the least number of samples in a patch. Smaller patches would fit any matches.
_PATCH, _FEWEST = 0.2, 8
# The smallest distance between two extremities, in units of the square root of the shape's own area, and the
# largest number of extremities. The number of pairings grows very fast with it.
_APART, _MOST_EXTREMITIES = 0.35, 6
# The regularisation of the regression of slopes, as a share of the variance of a patch.
_FLAT = 0.02


class Extremities(NamedTuple):
    """The extremities of a body, in descending order of their remoteness.

    The remoteness of a sample is the root mean square of its distances to all points of the surface.

    **Attributes:**

    - `samples`: the samples at the extremities (e,), as 0-based indices of the samples of a `Proxy`.
    - `distances`: the distances between extremities (e, e) along the surface, divided by the mean remoteness
      of all e extremities.
    - `remoteness`: the remoteness of each extremity (e,), divided by the same mean.
    """

    samples: Int64[np.ndarray, " e"]
    distances: Float[np.ndarray, "e e"]
    remoteness: Float[np.ndarray, " e"]


class Proxy:
    """A shape reduced to s evenly spread samples.

    **Arguments:**

    - `shape`: the shape (n vertices), a `PreparedShape`.
    - `unit`: the unit of length of `positions` and `distances`, in the coordinates of the mesh; see
      `Pair.units_of_length`.

    **Attributes:**

    - `mesh`, `spectrum`, `unit`: the mesh and the spectrum of the shape, and its unit of length.
    - `samples`: the samples, as `SurfaceSamples`.
    - `areas`: the share of the surface area that belongs to each sample (s,). The shares have the sum 1.
    - `positions`: the positions of the samples (s, 3).
    - `normals`: the outward mean normals of the regions of the samples (s, 3).
    - `mirrored`: whether positions, normals and SHOT are those of the mirror image.
    """

    def __init__(self, shape: PreparedShape, unit: float) -> None:
        mesh, compared = shape.mesh, shape.compared
        self.mesh, self.spectrum, self.unit, self.mirrored = mesh, shape.spectrum, unit, False
        among = mesh.referenced_indices if compared is None else compared.vertices
        # Of several vertices at one position, such as those of a seam, all but one would have no area.
        among = among[np.sort(np.unique(mesh.vertices[among], axis=0, return_index=True)[1])]
        number = min(SAMPLES, len(among))
        vertices = farthest_point_samples(mesh, number, among)
        self.samples = SurfaceSamples.along_surface(mesh, vertices, compared)
        areas = np.bincount(self.samples.nearest, mesh.vertex_areas, number)
        self.areas = areas / mesh.area
        self.positions = mesh.vertices[self.samples.vertices] / unit
        outward = mesh.vertex_areas * mesh.vertex_normals.T * (-1 if mesh.is_inside_out else 1)
        sums = [np.bincount(self.samples.nearest, row, len(self.areas)) for row in outward]
        normals = np.stack(sums, axis=1)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals = normals / np.maximum(lengths, np.finfo(float).tiny)
        self._shot: dict[int, Float[np.ndarray, "s 352"]] = {}  # by radius, shared with mirror images

    def mirror(self) -> Proxy:
        """Return the proxy of the mirror image, which shares the distances and SHOT of this proxy."""
        self.distances  # noqa: B018 (computed once, for both)
        mirrored = self._without("slopes", "sides")
        mirrored.positions, mirrored.normals = (rows * [-1, 1, 1] for rows in (self.positions, self.normals))
        mirrored.mirrored = not self.mirrored
        return mirrored

    def in_unit(self, unit: float) -> Proxy:
        """Return the proxy in another unit of length."""
        factor = self.unit / unit
        other = self._without("patches", "extremities", "slopes", "sides")
        other.unit, other.positions, other._shot = unit, factor * self.positions, {}
        vars(other)["distances"] = factor * self.distances
        return other

    def _without(self, *names: str) -> Proxy:
        """Return a copy that computes the properties of these names again."""
        other = copy.copy(self)
        for name in names:
            vars(other).pop(name, None)
        return other

    def shot(self, radius: int) -> Float[np.ndarray, "s 352"]:
        """Return SHOT at the samples, with a radius in units of 0.06, in `unit`.

        **Raises:** `InputError` if the samples are too sparse for SHOT.
        """
        known = self._shot
        if radius not in known:
            in_unit = radius * SHOT_RADIUS * self.unit / self.mesh.area**0.5
            known[radius] = sampled_shot_descriptors(self.mesh, self.samples, radius=in_unit)
        return mirrored_descriptors(known[radius]) if self.mirrored else known[radius]

    def sampled_spectrum(self, descriptors: Float[np.ndarray, "s d"] | None) -> Spectrum:
        """Return the spectrum at the samples, with all else of the proxy and perhaps with descriptors."""
        at_samples = self.spectrum.sample(self.samples.vertices)
        xp, dtype = namespace(at_samples.eigenvectors), at_samples.eigenvectors.dtype
        area = float(np.sum(self.spectrum.vertex_areas))
        positions = self.positions * self.unit * (area / self.mesh.area) ** 0.5
        sampled = replace(at_samples, vertex_areas=xp.asarray(self.areas * area, dtype))
        sampled = sampled.with_positions(xp.asarray(positions, dtype), xp.asarray(self.normals, dtype))
        columns = None if descriptors is None else xp.asarray(descriptors, dtype)
        return sampled.with_descriptors(columns).with_crease_eigenvectors(None)

    def distance_error(self, matches: SampleMap) -> float:
        """Return the mean absolute change of distances under a map from the samples to themselves (s,)."""
        change = np.abs(self.distances - self.distances[np.ix_(matches, matches)])
        return float(self.areas @ change @ self.areas)

    @functools.cached_property
    def distances(self) -> Float[np.ndarray, "s s"]:
        """The lengths of the shortest paths between the samples.

        A path consists of straight steps between samples whose regions are adjacent. The distance between
        samples on different connected components is their Euclidean distance.
        """
        pairs = self.samples.adjacent(self.mesh)
        lengths = np.linalg.norm(np.diff(self.positions[pairs], axis=1)[:, 0], axis=1)
        graph = coo_array((lengths, tuple(pairs.T)), (len(self.areas),) * 2).tocsr()
        distances = csgraph.dijkstra(graph + graph.T)  # takes less time than `directed=False`
        if not np.isfinite(distances).all():
            straight = cdist(self.positions, self.positions)
            distances = np.where(np.isfinite(distances), distances, straight)
        return distances

    @functools.cached_property
    def on_boundary(self) -> Bool[np.ndarray, " s"]:
        """Whether a sample's region touches the boundary of the surface."""
        on_boundary = np.zeros(len(self.mesh.vertices))
        on_boundary[self.mesh.boundary_edges.ravel()] = 1
        return np.bincount(self.samples.nearest, on_boundary, len(self.areas)) > 0

    @functools.cached_property
    def patches(self) -> Float[np.ndarray, "s s"]:
        """The weights of the samples in the patch around each sample. Each row has the sum 1."""
        distances = self.distances
        fewest = min(_FEWEST, len(distances)) - 1
        radii = np.maximum(_PATCH, np.partition(distances, fewest, axis=1)[:, fewest])
        weights = (distances <= radii[:, None]) * self.areas
        return weights / weights.sum(axis=1, keepdims=True)

    @functools.cached_property
    def extremities(self) -> Extremities:
        """The extremities of the body, such as the ends of its limbs, at most six.

        Extremities are the local maxima of the mean squared distance to the whole surface (Hilaga et al.
        2001, "Topology matching for fully automatic similarity estimation of 3D shapes").
        """
        distances = self.distances
        remoteness = np.sqrt(self.areas @ distances**2)
        apart = _APART * self.mesh.area**0.5 / self.unit
        around = np.where(distances < apart, remoteness, 0).max(axis=1)
        ends = np.flatnonzero(remoteness >= around)
        ends = ends[np.argsort(-remoteness[ends], kind="stable")][:_MOST_EXTREMITIES]
        unit = max(remoteness[ends].mean(), np.finfo(np.float64).tiny)
        return Extremities(ends, distances[np.ix_(ends, ends)] / unit, remoteness[ends] / unit)

    @functools.cached_property
    def turns(self) -> list[Int64[np.ndarray, " n"]]:
        """The maps of the vertices to themselves (n,) by the rotations that are symmetries of the shape."""
        mesh, sampled = self.mesh, self.samples.vertices
        among, placed, normals = mesh.referenced_indices, mesh.vertices / self.unit, mesh.vertex_normals
        rotations = symmetries(placed[sampled], normals[sampled])
        if not rotations:
            return []
        tree = KDTree(oriented_points(placed[among], normals[among]))
        turned = (oriented_points(turn.apply(placed), turn.turn(normals)) for turn in rotations)
        return [among[tree.query(points)[1]] for points in turned]

    @functools.cached_property
    def slopes(self) -> csr_array:
        """The operator that takes a function (s,) to its slopes along the first axis, the second, and so on.

        The slopes (3 s,) are those of a linear regression on the patch around each sample.
        """
        rows, columns = np.nonzero(self.patches)
        offsets = self.positions[columns] - (self.patches @ self.positions)[rows]
        weighted = self.patches[rows, columns, None] * offsets
        starts = np.searchsorted(rows, np.arange(len(self.areas)))
        moments = np.add.reduceat(weighted[:, :, None] * offsets[:, None], starts)
        # A flat patch does not tell how functions change along its normal.
        sizes = np.maximum(np.trace(moments, axis1=1, axis2=2), np.finfo(float).tiny)
        inverses = np.linalg.inv(moments + _FLAT * sizes[:, None, None] * np.eye(3))
        values = np.einsum("pa,pab->bp", weighted, inverses[rows])
        shape = (len(self.areas),) * 2
        return vstack([csr_array((along_axis, (rows, columns)), shape) for along_axis in values], "csr")

    @functools.cached_property
    def sides(self) -> Float[np.ndarray, "s e e"]:
        """The orientations with respect to the extremities of the body."""
        return self.orientations(self.extremities.samples)

    def orientations(self, ends: Int64[np.ndarray, " e"]) -> Float[np.ndarray, "s e e"]:
        """Return on which side of a body each sample is, with respect to each two of e samples.

        The directions away from the two samples and the normal span a volume, which is positive on one side
        of the body, such as the belly, and negative on the other. The direction away from a sample is the
        gradient of the distance from it. The measure is the orientation of Ren et al. (2018), "Continuous
        and orientation-preserving correspondences via functional maps".

        **Returns:** The signed volumes (s, e, e) for unit vectors, from -1 to 1. The volumes of the mirror
        image have the opposite signs.
        """
        slopes = self.slopes @ self.distances[:, ends]
        gradients = np.moveaxis(slopes.reshape(3, len(self.areas), len(ends)), 0, 2)
        gradients = gradients / np.maximum(
            np.linalg.norm(gradients, axis=2, keepdims=True), np.finfo(float).tiny
        )
        return np.cross(self.normals[:, None], gradients) @ gradients.transpose(0, 2, 1)
