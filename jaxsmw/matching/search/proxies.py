"""Proxies, which are shapes reduced to evenly spread samples."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.sparse import coo_array, csgraph
from scipy.spatial.distance import cdist

from jaxsmw.core.arrays import namespace
from jaxsmw.core.spectrum import Spectrum
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
# Two samples are neighbours if their distance along the surface is smaller, in the same units.
_NEIGHBOURS = 0.12


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
        mirrored = copy.copy(self)
        mirrored.positions, mirrored.normals = (rows * [-1, 1, 1] for rows in (self.positions, self.normals))
        mirrored.mirrored = not self.mirrored
        return mirrored

    def in_unit(self, unit: float) -> Proxy:
        """Return the proxy in another unit of length."""
        factor = self.unit / unit
        other = copy.copy(self)
        other.unit, other.positions, other._shot = unit, factor * self.positions, {}
        # Everything that depends on distances is computed again.
        for name in ("patches", "neighbours"):
            vars(other).pop(name, None)
        vars(other)["distances"] = factor * self.distances
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
    def neighbours(self) -> Int64[np.ndarray, "2 p"]:
        """The pairs of neighbouring samples, one in each column."""
        return np.array(np.nonzero(np.triu(self.distances < _NEIGHBOURS, 1)))
