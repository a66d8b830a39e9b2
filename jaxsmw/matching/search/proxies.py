"""Proxies, which are shapes reduced to evenly spread samples, and their extremities."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64
from scipy.sparse import coo_array, csgraph
from scipy.spatial.distance import cdist

from jaxsmw.core.arrays import namespace
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.alignment import nearest_rotations
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples


class Proxy:
    """A shape reduced to s evenly spread samples.

    **Arguments:**

    - `mesh`: the shape (n vertices).
    - `spectrum`: the spectrum of the shape (n vertices), without padding.
    - `samples`: evenly spread samples of the mesh, as `SurfaceSamples`.
    - `unit`: the unit of length of `positions` and `distances`, in the coordinates of the mesh; see
      `Pair.units_of_length`.

    **Attributes:**

    - `mesh`, `spectrum`, `samples`: the arguments.
    - `areas`: the share of the surface area that belongs to each sample (s,). The shares have the sum 1.
    - `positions`: the positions of the samples (s, 3).
    """

    def __init__(self, mesh: Mesh, spectrum: Spectrum, samples: SurfaceSamples, unit: float) -> None:
        self.mesh, self.spectrum, self.samples = mesh, spectrum, samples
        areas = np.bincount(samples.nearest, mesh.vertex_areas, len(samples.vertices))
        self.areas = areas / mesh.area
        self.positions = mesh.vertices[samples.vertices] / unit

    def sampled_spectrum(self, descriptors: Float[np.ndarray, "s d"] | None = None) -> Spectrum:
        """Return the spectrum at the samples, with the areas of the samples as vertex areas.

        If `spectrum` has descriptors and crease eigenvectors, the result has them as well.

        **Arguments:**

        - `descriptors`: the descriptors of the samples (s, d); by default, the descriptors of `spectrum`.
        """
        at_samples = self.spectrum.sample(self.samples.vertices)
        xp, dtype = namespace(at_samples.eigenvectors), at_samples.eigenvectors.dtype
        areas = self.areas * float(np.sum(self.spectrum.vertex_areas))
        if descriptors is not None:
            at_samples = at_samples.with_descriptors(xp.asarray(descriptors, dtype))
        return replace(at_samples, vertex_areas=xp.asarray(areas, dtype), positions=None, normals=None)

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


def distance_error(x: Proxy, y: Proxy, matches: Int64[np.ndarray, " s"]) -> float:
    """Return the mean absolute difference between distances on X and distances of the matches on Y.

    **Arguments:**

    - `x`, `y`: the proxies of X (s samples) and Y (t samples).
    - `matches`: the matches of the samples of X (s,), as 0-based indices of samples of Y.
    """
    return float(x.areas @ np.abs(x.distances - y.distances[np.ix_(matches, matches)]) @ x.areas)


def map_difference(
    x: Proxy, y: Proxy, first: Int64[np.ndarray, " s"], second: Int64[np.ndarray, " s"], distance: float
) -> float:
    """Return the share of X's area, from 0 to 1, on which two maps differ.

    Two maps differ at a sample if the distance between its two matches along the surface exceeds `distance`.

    **Arguments:**

    - `x`, `y`: the proxies of X (s samples) and Y (t samples).
    - `first`, `second`: the two maps (s,), as 0-based indices of samples of Y.
    - `distance`: the distance, in the unit of the distances on Y.
    """
    return float(x.areas @ (y.distances[first, second] > distance))


def deformation(x: Proxy, y: Proxy, matches: Int64[np.ndarray, " s"], radius: float) -> float:
    """Measure how far a map deviates from a rigid motion on each patch of X.

    The patch of a sample consists of all samples at a geodesic distance below `radius`. A rotation and a
    translation carry the patch as close as possible to its matches. The residual is the mean squared distance
    that remains, divided by the size of the patch. The size is the variance of the patch's positions plus the
    variance of its matches. The deformation is the mean residual of all patches.

    A map that bends a body at its joints deforms most patches little. A mirrored map deforms most patches,
    because no rotation undoes a reflection. Upside-down maps also deform most patches. The deformation is an
    "as-rigid-as-possible" energy (Sorkine, Alexa 2007).

    **Arguments:**

    - `x`, `y`: the proxies of X (s samples) and Y (t samples).
    - `matches`: the matches of the samples of X (s,), as 0-based indices of samples of Y.
    - `radius`: the radius of the patches, in the unit of the distances.

    **Returns:** The deformation, from 0 for a rigid motion to at most 1.
    """
    weights = (x.distances < radius) * x.areas
    weights /= weights.sum(axis=1, keepdims=True)
    source, target = x.positions, y.positions[matches]
    products = np.einsum("sa,sb->sab", source, target).reshape(-1, 9)
    squares = np.sum(source**2 + target**2, axis=1, keepdims=True)
    columns = weights @ np.hstack([source, target, products, squares])
    mean_x, mean_y = columns[:, :3], columns[:, 3:6]
    covariance = columns[:, 6:15].reshape(-1, 3, 3) - np.einsum("sa,sb->sab", mean_x, mean_y)
    size = columns[:, 15] - np.sum(mean_x**2 + mean_y**2, axis=1)
    _, traces = nearest_rotations(covariance)
    residual = size - 2 * traces
    return float(x.areas @ np.clip(residual / np.maximum(size, np.finfo(float).tiny), 0, 1))


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


# The smallest distance between two extremities, in units of the square root of the area.
_DISTANCE = 0.35
# The largest number of extremities. The number of pairings grows very fast with it.
_MOST = 6


def extremities(proxy: Proxy) -> Extremities:
    """Find the extremities of a body, such as the ends of its limbs, at most six.

    Extremities are the local maxima of the mean squared distance to the whole surface (Hilaga et al. 2001,
    "Topology matching for fully automatic similarity estimation of 3D shapes").
    """
    distances = proxy.distances
    remoteness = np.sqrt(proxy.areas @ distances**2)
    around = np.where(distances < _DISTANCE, remoteness, 0).max(axis=1)
    ends = np.flatnonzero(remoteness >= around)
    ends = ends[np.argsort(-remoteness[ends], kind="stable")][:_MOST]
    unit = max(remoteness[ends].mean(), np.finfo(np.float64).tiny)
    return Extremities(ends, distances[np.ix_(ends, ends)] / unit, remoteness[ends] / unit)


def plausible_pairings(x: Extremities, y: Extremities, number: int) -> list[Int64[np.ndarray, "l 2"]]:
    """Return pairings of the extremities of two bodies, the most plausible pairing first.

    A pairing matches each extremity of the body with fewer extremities to a different extremity of the other
    body. A pairing is plausible if the distances between extremities, and the remoteness of extremities, are
    similar on both bodies. The cost of a pairing is the sum of the squared differences of distances and of
    remoteness. The cost does not distinguish left from right.

    **Arguments:**

    - `x`, `y`: the extremities of X and of Y.
    - `number`: the largest number of pairings to return.

    **Returns:** A list of arrays (l, 2), where l is the number of extremities of the body with fewer
    extremities. Each row pairs the index of an extremity of X with the index of an extremity of Y.
    """
    fewer, more = (x, y) if len(x.samples) <= len(y.samples) else (y, x)
    partners = np.array(list(permutations(range(len(more.samples)), len(fewer.samples))))
    between = more.distances[partners[:, :, None], partners[:, None, :]] - fewer.distances
    cost = np.sum(between**2, axis=(1, 2)) / 2
    cost += np.sum((more.remoteness[partners] - fewer.remoteness) ** 2, axis=1)
    best = partners[np.argsort(cost, kind="stable")[:number]]
    pairings = [np.stack([np.arange(len(partner)), partner], axis=1) for partner in best]
    return pairings if fewer is x else [pairing[:, ::-1] for pairing in pairings]
