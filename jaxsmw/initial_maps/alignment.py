"""Features for the initial map of two shapes that rigid alignment brings close together, such as teeth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxsmw.descriptors import SampledPair
from jaxsmw.geometry.alignment import align_rigidly
from jaxsmw.geometry.sampling import poisson_disk_samples

# The alignment uses about this number of evenly spread samples per shape.
_SAMPLES = 2000
# The weight of positions relative to SHOT. Positions are in units of the square root of the area. (Entry R24)
_POSITION_WEIGHT = 3.0


def aligned_features(sampled: SampledPair) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Align X with Y rigidly, and return SHOT and weighted positions of the compared vertices.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.

    **Returns:** The features of X (m, d) and of Y (n, d), with one row per compared vertex and d = 355.
    The positions of X are those after the alignment.

    **Raises:** `InputError` if a mesh is too coarse for SHOT.
    """
    return tuple(  # type: ignore[return-value]
        np.hstack([shot, _POSITION_WEIGHT * positions])
        for shot, positions in zip(sampled.shot, _aligned_positions(sampled), strict=True)
    )


def _aligned_positions(sampled: SampledPair) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "n 3"]]:
    """Align X with Y rigidly, in comparable units, and return the positions of the compared vertices.

    **Returns:** The positions of X after the alignment (m, 3) and of Y (n, 3), with one row per compared
    vertex, in the units of `Pair.units_of_length`.
    """
    positions, samples, normals = [], [], []
    for side, unit in zip(sampled.sides, sampled.pair.units_of_length, strict=True):
        scaled = side.mesh.vertices / unit
        spread = poisson_disk_samples(side.mesh, _SAMPLES)
        samples.append(scaled[spread.vertices])
        normals.append(side.mesh.vertex_normals[spread.vertices])
        positions.append(scaled if side.samples is None else scaled[side.samples.vertices])
    motion = align_rigidly(samples[0], samples[1], normals[1])
    return motion.apply(positions[0]), positions[1]
