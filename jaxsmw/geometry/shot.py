"""SHOT descriptors: histograms of normals in a local frame, which distinguish left from right."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64, Int32, Int64
from scipy.spatial import KDTree

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples
from jaxsmw.runtime.cache import cached

_AZIMUTH, _ELEVATION, _RADIAL, _COSINE = 8, 2, 2, 11  # `_histograms` assumes `_ELEVATION == _RADIAL == 2`
SHOT_DIMENSION = _AZIMUTH * _ELEVATION * _RADIAL * _COSINE
_FEWEST_NEIGHBORS = 3
SHOT_RADIUS = 0.06
"""The radius of SHOT neighbourhoods in the MWP paper, in units of the square root of the area."""
# The approximate number of (vertex, neighbour) pairs in a block of vertices. A pair takes about 300 bytes,
# so the histograms of a block stay in the processor's cache.
_PAIRS_PER_BLOCK = 30_000


def shot_descriptors(
    mesh: Mesh,
    *,
    radius: float = SHOT_RADIUS,
    samples: SurfaceSamples | None = None,
    required: bool = False,
) -> Float32[np.ndarray, "n 352"]:
    """Compute SHOT descriptors (signatures of histograms of orientations), one per vertex.

    SHOT is defined by Salti, Tombari, Di Stefano, "SHOT: Unique signatures of histograms for surface and
    texture description", CVIU 2014. The neighbours of a vertex are all vertices within the radius. The
    weighted scatter matrix of the neighbours gives the axes of a local reference frame. The x and z axes
    point to the side with more neighbours.

    The frame divides the neighbourhood into 32 sectors: 8 ranges of azimuth times 2 ranges of elevation times
    2 ranges of distance. Each sector has an 11-bin histogram of the cosine of the angle between a neighbour's
    normal and the z axis. A neighbour contributes to the two nearest bins in each of azimuth, elevation,
    distance and cosine, with the weights of linear interpolation. Each descriptor is scaled to unit length.

    Descriptors are invariant to rotation, translation and scale, but not to reflection, so they distinguish
    left from right. An inside-out mesh has the same descriptors. Results are cached on disk
    (`jaxsmw.runtime.cache`).

    **Arguments:**

    - `mesh`: the surface with n vertices, consistently oriented.
    - `radius`: the radius of the neighbourhoods, positive, in units of the square root of the area. The
      default, 0.06, is the radius in the MWP paper.
    - `samples`: the s samples of the mesh as `SurfaceSamples` (`jaxsmw.geometry.sampling`), or None. If
      samples are given, descriptors are computed only at the samples, and only samples are used as
      neighbours. The normal of a sample is the mean normal of the vertices nearest to the sample. Without
      samples, the time grows with the square of the number of vertices.
    - `required`: whether the caller needs SHOT. If False (the default), messages about coarse meshes also
      explain how to match without SHOT.

    **Returns:** Dimensionless descriptors as float32, (n, 352) for all vertices or (s, 352) for the samples.
    The row is zero for unreferenced vertices and for vertices with fewer than 3 neighbours. The function
    issues a `UserWarning` if more than 1 % of the vertices have fewer than 3 neighbours.

    **Raises:** `InputError` if the radius is not positive, or if most vertices have fewer than 3 neighbours.
    """
    if not radius > 0:
        raise InputError(f"the SHOT radius is {radius}, but must be positive: the usual choice is 0.06.")

    def compute() -> dict[str, np.ndarray]:
        if samples is None:
            vertices = mesh.referenced_indices
            normals = mesh.vertex_normals[vertices]
        else:
            vertices, number = samples.vertices, len(samples.vertices)
            weighted = mesh.vertex_areas[:, None] * mesh.vertex_normals
            normals = np.stack([np.bincount(samples.nearest, axis, number) for axis in weighted.T], axis=1)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
        positions = mesh.vertices[vertices] / np.sqrt(mesh.area)
        if mesh.is_inside_out:
            normals = -normals

        tree = KDTree(positions)
        neighbors = tree.query_ball_point(positions, radius, return_length=True, workers=-1) - 1
        lonely = np.mean(neighbors < _FEWEST_NEIGHBORS)
        if lonely > 0.5:
            raise InputError(_too_coarse(mesh, lonely, radius, required))

        # Single precision is accurate enough for descriptors.
        descriptors = np.zeros((len(vertices), SHOT_DIMENSION), np.float32)
        block_of_vertex = np.cumsum(neighbors + 1) // _PAIRS_PER_BLOCK
        for block in np.split(np.arange(len(vertices)), np.flatnonzero(np.diff(block_of_vertex)) + 1):
            pairs = KDTree(positions[block]).sparse_distance_matrix(tree, radius, output_type="ndarray")
            # Pairs of vertices at the same position are left out, because they define no direction.
            apart = pairs["v"] > 0
            center, neighbor, distance = (pairs[column][apart] for column in "ijv")
            descriptors[block] = _histograms(positions, normals, block, center, neighbor, distance, radius)
        descriptors = mesh.spread(descriptors) if samples is None else descriptors
        return {"descriptors": descriptors, "lonely": np.asarray(lonely)}

    chosen = () if samples is None else samples
    result = cached("shot", (mesh.vertices, mesh.faces, radius, *chosen), compute)
    if (lonely := float(result["lonely"])) > 0.01:
        warnings.warn(_too_coarse(mesh, lonely, radius, required), stacklevel=2)
    return result["descriptors"]


def mirrored_descriptors(descriptors: Float32[np.ndarray, "n 352"]) -> Float32[np.ndarray, "n 352"]:
    """Return the SHOT descriptors (n, 352) of the mirror image of a surface, given those of the surface."""
    # A reflection reverses the order of the ranges of azimuth and changes nothing else.
    sectors = descriptors.reshape(len(descriptors), _AZIMUTH, -1)
    return np.ascontiguousarray(sectors[:, ::-1]).reshape(descriptors.shape)


def _too_coarse(mesh: Mesh, lonely: float, radius: float, required: bool) -> str:
    avoidance = ", or the initial map 'wks' with the preset 'paper', which do not use SHOT"
    return (
        f"{mesh.name}: {lonely:.0%} of the vertices have fewer than {_FEWEST_NEIGHBORS} neighbours within "
        f"the SHOT radius of {radius:.3g} sqrt(area), because the mesh is coarse there: use a finer mesh"
        f"{'' if required else avoidance}."
    )


def _histograms(
    positions: np.ndarray,
    normals: np.ndarray,
    block: Int64[np.ndarray, " b"],
    center: Int64[np.ndarray, " p"],
    neighbor: Int64[np.ndarray, " p"],
    distance: Float64[np.ndarray, " p"],
    radius: float,
) -> Float64[np.ndarray, "b 352"]:
    """Return the descriptors of a block from pairs of a `center` in the block and a `neighbor`."""
    # `center` counts within the block. Lengths are in units of the square root of the area.
    offsets = positions.take(neighbor, axis=0) - positions[block].take(center, axis=0)
    frames = _local_frames(offsets, center, radius - distance, len(block)).take(center, axis=0)
    x, y, z = np.einsum("pad,pd->ap", frames, offsets)
    cosine = np.einsum("pd,pd->p", frames[:, 2], normals.take(neighbor, axis=0))

    # Each coordinate is scaled so that the integer b is the centre of bin b.
    azimuth = np.arctan2(y, x) * (_AZIMUTH / (2 * np.pi)) - 0.5
    elevation = np.arcsin(np.clip(z / distance, -1, 1)) * (_ELEVATION / np.pi) + (_ELEVATION - 1) / 2
    shell = distance * (_RADIAL / radius) - 0.5
    bin_of_cosine = (1 + np.clip(cosine, -1, 1)) * ((_COSINE - 1) / 2)

    # A pair contributes to two bins each of azimuth, elevation, distance and cosine. Elevation and distance
    # have only two bins, so every pair has weights for all four combinations. Each row of `histogram`
    # is one bin of azimuth and cosine at one vertex. The columns of `histogram` are the four combinations of
    # elevation and distance.
    upper, outer = np.clip(elevation, 0, 1), np.clip(shell, 0, 1)
    shares = np.empty((len(center), _ELEVATION * _RADIAL))
    for low, of_elevation in enumerate((1 - upper, upper)):
        for near, of_distance in enumerate((1 - outer, outer)):
            np.multiply(of_elevation, of_distance, out=shares[:, low * _RADIAL + near])
    histogram = np.zeros((len(block) * _AZIMUTH * _COSINE, _ELEVATION * _RADIAL))
    first, each = center.astype(np.int32) * (_AZIMUTH * _COSINE), np.arange(len(center) + 1, dtype=np.int32)
    for sector, sector_weight in _two_nearest(azimuth):
        start = first + sector % _AZIMUTH * _COSINE
        for level, level_weight in _two_nearest(bin_of_cosine):
            rows = start + np.clip(level, 0, _COSINE - 1)  # beyond the last bin, the weight is zero
            weights = sector_weight * level_weight
            histogram += sp.csc_array((weights, rows, each), (len(histogram), len(center))) @ shares
    shape = len(block), _AZIMUTH, _COSINE, _ELEVATION * _RADIAL
    descriptors = histogram.reshape(shape).swapaxes(2, 3).reshape(len(block), SHOT_DIMENSION)
    descriptors[np.bincount(center, minlength=len(block)) < _FEWEST_NEIGHBORS] = 0
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return descriptors / np.where(norms > 0, norms, 1)


def _local_frames(
    offsets: Float64[np.ndarray, "p 3"],
    center: Int64[np.ndarray, " p"],
    weight: Float64[np.ndarray, " p"],
    size: int,
) -> Float64[np.ndarray, "b 3 3"]:
    """Return a right-handed frame per vertex; its rows x to z are axes of decreasing scatter."""
    scatter = np.zeros((size, 3, 3))
    for row in range(3):
        for column in range(row, 3):
            products = weight * offsets[:, row] * offsets[:, column]
            scatter[:, row, column] = scatter[:, column, row] = np.bincount(center, products, size)
    _, axes = np.linalg.eigh(scatter)

    def towards_majority(axis: np.ndarray) -> np.ndarray:
        height = np.einsum("pd,pd->p", axis.take(center, axis=0), offsets)
        majority = np.bincount(center, np.sign(height), size)
        # The axis points to the side with more neighbours. On regular meshes, both sides can have equally
        # many neighbours. Then the axis points to the side with the larger weighted sum of heights.
        tied = majority == 0
        majority[tied] = np.bincount(center, weight * height, size)[tied]
        return np.where(majority >= 0, 1.0, -1.0)[:, None] * axis

    x, z = towards_majority(axes[:, :, 2]), towards_majority(axes[:, :, 0])
    return np.stack([x, np.cross(z, x), z], axis=1)


def _two_nearest(
    coordinate: Float64[np.ndarray, " p"],
) -> list[tuple[Int32[np.ndarray, " p"], Float64[np.ndarray, " p"]]]:
    """Return the two bins nearest to each coordinate, each with its weight in linear interpolation."""
    lower = np.floor(coordinate)
    upper_weight = coordinate - lower
    bins = lower.astype(np.int32)
    return [(bins, 1 - upper_weight), (bins + 1, upper_weight)]
