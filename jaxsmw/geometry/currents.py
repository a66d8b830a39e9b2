"""Rigid motions that lay two surfaces over each other, although only parts of them correspond."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.spatial.transform import Rotation

from jaxsmw.geometry.alignment import Alignment, different_alignments

# The width of the Gaussian kernel, in units of length.
_WIDTH = 0.08
# The number of cells of the grid in each direction.
_CELLS = 32
# The rotations are those of an icosahedron, also after a turn by this angle about each diagonal of a cube.
_TURN = np.deg2rad(25)
_DIAGONALS = np.array([(1, 1, 1), (-1, 1, -1), (1, -1, -1), (-1, -1, 1)]) / np.sqrt(3)
# The number of offsets for each rotation, and the number of cells around an offset in which no other is
# chosen.
_OFFSETS, _AROUND = 3, 2
# Two motions are different if the root mean square distance between the moved points is larger.
_DIFFERENT = 0.12


class Oriented(NamedTuple):
    """A sampled surface.

    **Attributes:** `positions` and unit `normals` of the samples (s, 3), and the `areas` that belong to the
    samples (s,).
    """

    positions: Float[np.ndarray, "s 3"]
    normals: Float[np.ndarray, "s 3"]
    areas: Float[np.ndarray, " s"]

    def moved(self, motion: Alignment) -> Oriented:
        """Return the surface after a rigid motion."""
        return Oriented(motion.apply(self.positions), motion.turn(self.normals), self.areas)


def overlapping_alignments(x: Oriented, y: Oriented, number: int, *, dense: bool = True) -> list[Alignment]:
    """Return rigid motions that lay the surface x over the surface y, those with the largest overlap first.

    The overlap is the inner product of the two surfaces as currents (Vaillant, Glaunès, "Surface matching via
    currents", 2005): the sum of a Gaussian of the distance times the product of the normals, over all pairs
    of points. Surfaces of opposite orientation cancel each other. Parts without a counterpart count nothing,
    so the overlap needs no guess of their extent. For each of several rotations, a fast Fourier transform
    gives the overlap at all offsets at once.

    **Arguments:**

    - `x`, `y`: the surfaces, in a unit of length in which the larger one has an area of about 1.
    - `number`: the largest number of motions. They differ from each other.
    - `dense`: whether all 300 rotations are tried, or only the 60 rotations of an icosahedron.
    """
    middles = x.positions.mean(axis=0), y.positions.mean(axis=0)
    of_x, of_y = (side.positions - middle for side, middle in zip((x, y), middles, strict=True))
    reach = sum(float(np.linalg.norm(points, axis=1).max()) for points in (of_x, of_y)) + 2 * _WIDTH
    cell = 2 * reach / _CELLS
    smoothed = _transformed(y._replace(positions=of_y), cell) * _gaussian(cell)
    found: list[tuple[float, Alignment]] = []
    for rotation in _rotations(dense):
        turned = x._replace(positions=of_x).moved(Alignment(rotation, np.zeros(3)))
        product = (smoothed * np.conj(_transformed(turned, cell))).sum(axis=0)
        overlaps = np.fft.irfftn(product, (_CELLS,) * 3, axes=(0, 1, 2))
        for _ in range(_OFFSETS):
            best = np.array(np.unravel_index(overlaps.argmax(), overlaps.shape))
            offset = ((best + _CELLS // 2) % _CELLS - _CELLS // 2) * cell
            motion = Alignment(rotation, offset + middles[1] - rotation @ middles[0])
            found.append((float(overlaps[tuple(best)]), motion))
            around = (best[:, None] + np.arange(-_AROUND, _AROUND + 1)) % _CELLS
            overlaps[np.ix_(*around)] = -np.inf
    found.sort(key=lambda pair: -pair[0])
    return different_alignments([motion for _, motion in found], x.positions, _DIFFERENT**2, number)


def _rotations(dense: bool) -> Float[np.ndarray, "r 3 3"]:
    turns = [np.eye(3)]
    if dense:
        turns += [*Rotation.from_rotvec(_TURN * _DIAGONALS).as_matrix()]
    icosahedral = Rotation.create_group("I").as_matrix()
    return np.array([rotation @ turn for rotation in icosahedral for turn in turns])


def _gaussian(cell: float) -> Float[np.ndarray, "g g h"]:
    """Return the Fourier transform of the kernel."""
    frequencies = 2 * np.pi * np.fft.fftfreq(_CELLS, cell)
    last = frequencies[: _CELLS // 2 + 1]
    squares = np.add.outer(np.add.outer(frequencies**2, frequencies**2), last**2)
    return np.exp(-0.5 * _WIDTH**2 * squares)


def _transformed(surface: Oriented, cell: float) -> Complex[np.ndarray, "3 g g h"]:
    """Return the Fourier transform of the area vectors of a surface on the grid."""
    shape = (_CELLS,) * 3
    places = surface.positions / cell + _CELLS / 2
    corner = np.floor(places).astype(np.int64)
    field = np.zeros((3, _CELLS**3))
    for step in np.ndindex(2, 2, 2):
        shares = np.prod(1 - np.abs(places - corner - step), axis=1) * surface.areas
        cells = np.ravel_multi_index(tuple(((corner + step) % _CELLS).T), shape)
        for row, normals in zip(field, surface.normals.T, strict=True):
            row += np.bincount(cells, shares * normals, _CELLS**3)
    return np.fft.rfftn(field.reshape(3, *shape), axes=(1, 2, 3))
