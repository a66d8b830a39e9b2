"""Asymmetry: how bodies differ from their own mirror images, or left bones from right bones.

The asymmetry of one individual has two parts. The directional asymmetry is the mean over all individuals, as
if all hearts lie on the left. The fluctuating asymmetry is what remains, and differs from one individual to
the next (Klingenberg, Barluenga, Meyer, "Shape analysis of symmetric structures: quantifying variation among
individuals and asymmetry", Evolution 2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Real

from jaxsmw.choices import DEFAULT_PRESET, PresetName
from jaxsmw.collection.shape_models import ProcrustesAlignment, Shapes, align
from jaxsmw.errors import InputError, check_whole_number
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.match import match

# A reflection of space. Any other one gives the same result, because shapes are aligned by rotations.
_REFLECTION = np.array([-1.0, 1.0, 1.0])


class Effect(NamedTuple):
    """One row of the Procrustes analysis of variance.

    **Attributes:**

    - `name`: `"individuals"` (how individuals differ), `"sides"` (directional asymmetry) or
      `"individuals x sides"` (fluctuating asymmetry).
    - `sum_of_squares`: the sum of squared displacements, in squared units of length. Displacements are root
      mean squares over the surface.
    - `degrees_of_freedom`: N - 1, 1 and N - 1. The number of coordinates of a shape, a common factor, is
      left out.
    - `f`: the mean square divided by that of the last row; NaN in the last row, and for one individual.
    """

    name: str
    sum_of_squares: float
    degrees_of_freedom: int
    f: float


@dataclass(frozen=True, eq=False)
class Asymmetry:
    """The result of `asymmetry`, for N individuals and n vertices.

    **Attributes:**

    - `alignment`: the `ProcrustesAlignment` of the N shapes and then of the N mirror images of their
      counterparts.
    - `probability`: the probability of a directional asymmetry at least as large if left and right are
      equal in the mean, from random exchanges of both sides of each individual. It is 1 for one individual.
    """

    alignment: ProcrustesAlignment
    probability: float

    @cached_property
    def _sides(self) -> Float64[np.ndarray, "2 N n 3"]:
        aligned = self.alignment.aligned
        return aligned.reshape(2, len(aligned) // 2, *aligned.shape[1:])

    @property
    def symmetric(self) -> Float64[np.ndarray, "N n 3"]:
        """The mean of each shape and the mirror image of its counterpart (N, n, 3), in units of length."""
        return self._sides.mean(axis=0)

    @cached_property
    def differences(self) -> Float64[np.ndarray, "N n 3"]:
        """The displacement from the mirror image of the counterpart to each vertex (N, n, 3).

        The displacements are in the unit of length of the shapes. A shape without asymmetry has none.
        """
        return self._sides[0] - self._sides[1]

    @property
    def directional(self) -> Float64[np.ndarray, "n 3"]:
        """The directional asymmetry: the mean of the `differences` over all individuals (n, 3)."""
        return self.differences.mean(axis=0)

    @property
    def fluctuating(self) -> Float64[np.ndarray, "N n 3"]:
        """The fluctuating asymmetry: the `differences` minus their mean (N, n, 3).

        It contains the errors of the maps. Only repeated measurements of an individual tell both apart.
        """
        return self.differences - self.directional

    def analysis_of_variance(self) -> tuple[Effect, Effect, Effect]:
        """Return the Procrustes analysis of variance by individuals and sides.

        The model is that of Klingenberg et al. (2002), without replicates: each shape is the sum of the mean,
        an effect of the individual, half an effect of the side, and their interaction.
        """
        count = len(self.differences)
        individuals = self.symmetric - self.symmetric.mean(axis=0)
        sums = (
            2 * self.mean_squares(individuals).sum(),
            count / 2 * self.mean_squares(self.directional),
            self.mean_squares(self.fluctuating).sum() / 2,
        )
        freedom = (count - 1, 1, count - 1)
        names = ("individuals", "sides", "individuals x sides")
        with np.errstate(divide="ignore", invalid="ignore"):
            squares = np.divide(sums, freedom)
            ratios = squares[:2] / squares[2]
        rows = zip(names, map(float, sums), freedom, (*ratios.tolist(), np.nan), strict=True)
        first, second, third = (Effect(*row) for row in rows)
        return first, second, third

    def mean_squares(self, fields: Float64[np.ndarray, "*N n 3"]) -> Float64[np.ndarray, "*N"]:
        """Return the mean squares over the surface of displacements (n, 3), in squared units of length."""
        return np.asarray((fields**2).sum(axis=-1) @ self.alignment.weights)


def asymmetry(
    shapes: Shapes,
    counterparts: Shapes,
    *,
    scale: bool = False,
    weights: Real[np.ndarray, " _"] | None = None,
    permutations: int = 999,
    seed: int = 0,
) -> Asymmetry:
    """Compare N shapes with the mirror images of their counterparts on the other side.

    All 2 N shapes are aligned together by generalised Procrustes analysis, with rotations only.

    **Arguments:**

    - `shapes`: the positions of n corresponding vertices on N individuals, as for `align`.
    - `counterparts`: for each vertex, its counterpart on the other side of the same individual, of the same
      shape. For a symmetric body, such as a skull, the counterparts lie on the same mesh; `mirror_points`
      finds them. For paired bones, the shapes are left bones, and the counterparts are right bones.
    - `scale`, `weights`: the arguments of `align`. With `scale`, differences of size do not count.
    - `permutations`: the number of random exchanges of the sides, at least 1.
    - `seed`: the random seed.

    **Returns:** An `Asymmetry`, in the unit of length and in the frame of the first shape.

    **Raises:** `InputError` if an argument is not as described.
    """
    permutations = check_whole_number("permutations", permutations, 1)
    seed = check_whole_number("seed", seed, 0)
    if len(shapes) != len(counterparts):
        raise InputError(
            f"there are {len(shapes)} shapes, but {len(counterparts)} counterparts: give one for each shape."
        )
    mirrored = [np.asarray(points) * _REFLECTION for points in counterparts]
    alignment = align([*shapes, *mirrored], scale=scale, weights=weights)
    count = len(shapes)
    weighted = alignment.aligned[:count] - alignment.aligned[count:]
    weighted *= np.sqrt(alignment.weights)[:, None]
    products = np.tensordot(weighted, weighted, axes=((1, 2), (1, 2)))
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (permutations, count))
    signs = np.vstack([np.ones(count), signs])  # the sides as they are count as one exchange
    squares = np.einsum("pi,ij,pj->p", signs, products, signs)
    return Asymmetry(alignment, float(np.mean(squares >= squares[0] * (1 - 1e-12))))


def mirror_points(mesh: Mesh, *, preset: PresetName = DEFAULT_PRESET) -> SurfacePoints:
    """Find for each vertex of a symmetric body its counterpart on the other side, such as the other ear.

    The body is matched to its own mirror image. The match is smoothed by registration; see `register_mesh`.

    **Arguments:**

    - `mesh`: a `Mesh` with n vertices, nearly its own mirror image, in nearly symmetric pose.
    - `preset`: the name of the preset of `jaxsmw.match`.

    **Returns:** n `SurfacePoints` on the mesh.

    **Raises:** As `jaxsmw.match`.
    """
    return match(mesh, mesh, mirror="yes", preset=preset).registered_mesh().surface_points
