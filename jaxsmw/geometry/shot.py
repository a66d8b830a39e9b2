"""SHOT descriptors: histograms of normals in a local frame, which distinguish left from right."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64, Int32, Int64, Shaped
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
# The approximate number of (vertex, neighbour) pairs in a block of vertices. A pair takes about 200 bytes,
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
    descriptors, lonely = _cached(mesh, radius, samples, required)
    if lonely > 0.01:
        warnings.warn(_too_coarse(mesh, lonely, radius, "use a finer mesh"), stacklevel=2)
    return descriptors


def sampled_shot_descriptors(
    mesh: Mesh, samples: SurfaceSamples, *, radius: float
) -> Float32[np.ndarray, "s 352"]:
    """Return `shot_descriptors` at samples, without a warning if some samples have few neighbours.

    A caller that ignored the warning of `shot_descriptors` could not run in several threads, because they
    share the filters of warnings.
    """
    return _cached(mesh, radius, samples, required=False)[0]


def _cached(
    mesh: Mesh, radius: float, samples: SurfaceSamples | None, required: bool
) -> tuple[Float32[np.ndarray, "n 352"], float]:
    """Return descriptors, and the share of vertices with few neighbours; see `shot_descriptors`."""
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

        # Single precision is accurate enough for descriptors, and takes less time.
        descriptors = np.zeros((len(vertices), SHOT_DIMENSION), np.float32)
        places, normals = np.ascontiguousarray(positions.T), normals.T.astype(np.float32, order="C")
        tree = KDTree(positions)
        number_of_pairs = 16 * KDTree(positions[::16]).count_neighbors(tree, radius)
        number_of_blocks = min(1 + number_of_pairs // _PAIRS_PER_BLOCK, len(positions))
        number_lonely = 0
        # A block consists of vertices near each other, so the search compares few vertices in vain.
        for block in np.array_split(tree.indices, number_of_blocks):
            pairs = KDTree(positions[block]).sparse_distance_matrix(tree, radius, output_type="ndarray")
            # NumPy sorts integers of 16 bits several times faster. A block has fewer vertices than pairs.
            order = np.argsort(pairs["i"].astype(np.uint16), kind="stable")
            numbers = np.bincount(pairs["i"], minlength=len(block))
            number_lonely += int(np.sum(numbers - 1 < _FEWEST_NEIGHBORS))
            neighbor, distance = pairs["j"][order], pairs["v"][order].astype(np.float32)
            offsets = places.take(neighbor, axis=1) - np.repeat(places[:, block], numbers, axis=1)
            descriptors[block] = _histograms(
                offsets.astype(np.float32), normals.take(neighbor, axis=1), distance, numbers, radius
            )
        lonely = number_lonely / len(vertices)
        if lonely > 0.5:
            cure = "use a finer mesh"
            if not required:
                cure += ", or the initial map 'wks' with the preset 'paper', which do not use SHOT"
            raise InputError(_too_coarse(mesh, lonely, radius, cure))
        descriptors = mesh.spread(descriptors) if samples is None else descriptors
        return {"descriptors": descriptors, "lonely": np.asarray(lonely)}

    chosen = () if samples is None else samples
    result = cached("shot", (mesh.vertices, mesh.faces, radius, "float32", *chosen), compute)
    return result["descriptors"], float(result["lonely"])


def mirrored_descriptors(descriptors: Float32[np.ndarray, "n 352"]) -> Float32[np.ndarray, "n 352"]:
    """Return the SHOT descriptors (n, 352) of the mirror image of a surface, given those of the surface."""
    # A reflection reverses the order of the ranges of azimuth and changes nothing else.
    sectors = descriptors.reshape(len(descriptors), _AZIMUTH, -1)
    return np.ascontiguousarray(sectors[:, ::-1]).reshape(descriptors.shape)


def _too_coarse(mesh: Mesh, lonely: float, radius: float, cure: str) -> str:
    return (
        f"{mesh.name}: {lonely:.0%} of the vertices have fewer than {_FEWEST_NEIGHBORS} neighbours within "
        f"the SHOT radius of {radius:.3g} sqrt(area), because the mesh is coarse there: {cure}."
    )


def _histograms(
    offsets: Float32[np.ndarray, "3 p"],
    normals: Float32[np.ndarray, "3 p"],
    distance: Float32[np.ndarray, " p"],
    numbers: Int64[np.ndarray, " b"],
    radius: float,
) -> Float32[np.ndarray, "b 352"]:
    """Return the descriptors of a block of vertices from pairs of a vertex and a neighbour.

    The first `numbers[0]` pairs belong to the first vertex of the block, and so on. Every vertex is its own
    neighbour. Lengths are in units of the square root of the area.
    """
    apart = distance > 0  # vertices at the same position define no direction, and are left out
    (x, y, z), cosine = _local_coordinates(offsets, normals, radius - distance, numbers)

    # Each coordinate is scaled so that the integer b is the centre of bin b.
    azimuth = np.arctan2(y, x) * (_AZIMUTH / (2 * np.pi)) - 0.5
    sine = np.clip(z / np.where(apart, distance, 1), -1, 1)
    elevation = np.arcsin(sine) * (_ELEVATION / np.pi) + (_ELEVATION - 1) / 2
    shell = distance * (_RADIAL / radius) - 0.5
    bin_of_cosine = (1 + np.clip(cosine, -1, 1)) * ((_COSINE - 1) / 2)

    # A pair contributes to two bins each of azimuth, elevation, distance and cosine. Elevation and distance
    # have only two bins, so every pair has weights for all four combinations. Each row of `histogram`
    # is one bin of azimuth and cosine at one vertex. The columns of `histogram` are the four combinations of
    # elevation and distance.
    size, p = len(numbers), len(distance)
    upper, outer = np.clip(elevation, 0, 1), np.clip(shell, 0, 1)
    shares = np.empty((p, _ELEVATION * _RADIAL), np.float32)
    for low, of_elevation in enumerate(((1 - upper) * apart, upper * apart)):
        for near, of_distance in enumerate((1 - outer, outer)):
            np.multiply(of_elevation, of_distance, out=shares[:, low * _RADIAL + near])
    first = np.repeat(np.arange(size, dtype=np.int32) * (_AZIMUTH * _COSINE), numbers)
    rows, weights = np.empty((p, 4), np.int32), np.empty((p, 4), np.float32)
    for near, (sector, sector_weight) in enumerate(_two_nearest(azimuth)):
        start = first + (sector & (_AZIMUTH - 1)) * _COSINE  # faster than %, and equal for a power of 2
        for low, (level, level_weight) in enumerate(_two_nearest(bin_of_cosine)):
            # Beyond the last bin, the weight is zero.
            np.add(start, np.minimum(level, _COSINE - 1), out=rows[:, 2 * near + low])
            np.multiply(sector_weight, level_weight, out=weights[:, 2 * near + low])
    each = np.arange(0, 4 * p + 1, 4, dtype=np.int32)
    spread = sp.csc_array((weights.ravel(), rows.ravel(), each), (size * _AZIMUTH * _COSINE, p))
    histogram = (spread @ shares).reshape(size, _AZIMUTH, _COSINE, _ELEVATION * _RADIAL)
    descriptors = histogram.swapaxes(2, 3).reshape(size, SHOT_DIMENSION)
    descriptors[_sums(apart, numbers) < _FEWEST_NEIGHBORS] = 0
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return descriptors / np.where(norms > 0, norms, 1)


def _local_coordinates(
    offsets: Float32[np.ndarray, "3 p"],
    normals: Float32[np.ndarray, "3 p"],
    weight: Float32[np.ndarray, " p"],
    numbers: Int64[np.ndarray, " b"],
) -> tuple[Float32[np.ndarray, "3 p"], Float32[np.ndarray, " p"]]:
    """Return offsets in the local frames, and the cosines of the angles between normals and the z axes.

    A local frame is right-handed. Its axes x to z are axes of decreasing scatter.
    """
    scatter = np.empty((len(numbers), 3, 3))
    for row in range(3):
        weighted = weight * offsets[row]
        for column in range(row, 3):
            sums = _sums(weighted * offsets[column], numbers)
            scatter[:, row, column] = scatter[:, column, row] = sums
    _, axes = np.linalg.eigh(scatter)
    x, z = axes[:, :, 2], axes[:, :, 0]
    frames = np.stack([x.T, np.cross(z, x).T, z.T]).astype(np.float32).reshape(9, -1)
    of_pairs = np.repeat(frames, numbers, axis=1).reshape(3, 3, -1)
    coordinates = np.einsum("adp,dp->ap", of_pairs, offsets)

    def towards_majority(height: Float32[np.ndarray, " p"]) -> Float32[np.ndarray, " p"]:
        # The axis points to the side with more neighbours. On regular meshes, both sides can have equally
        # many neighbours. Then the axis points to the side with the larger weighted sum of heights.
        majority = _sums(np.sign(height), numbers)
        side = np.where(majority == 0, _sums(weight * height, numbers), majority)
        return np.repeat(np.where(side >= 0, np.float32(1), np.float32(-1)), numbers)

    sign_x, sign_z = towards_majority(coordinates[0]), towards_majority(coordinates[2])
    coordinates *= np.stack([sign_x, sign_x * sign_z, sign_z])
    return coordinates, sign_z * np.einsum("dp,dp->p", of_pairs[2], normals)


def _sums(values: Shaped[np.ndarray, " p"], numbers: Int64[np.ndarray, " b"]) -> Float64[np.ndarray, " b"]:
    """Return the sum of the first `numbers[0]` values, the sum of the following `numbers[1]` values, ..."""
    return np.add.reduceat(values, np.cumsum(numbers) - numbers, dtype=np.float64)


def _two_nearest(
    coordinate: Float32[np.ndarray, " p"],
) -> list[tuple[Int32[np.ndarray, " p"], Float32[np.ndarray, " p"]]]:
    """Return the two bins nearest to each coordinate, each with its weight in linear interpolation."""
    lower = np.floor(coordinate)
    upper_weight = coordinate - lower
    bins = lower.astype(np.int32)
    return [(bins, 1 - upper_weight), (bins + 1, upper_weight)]
