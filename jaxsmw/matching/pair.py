"""A pair of meshes to be matched, and the units in which they are compared."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int64

from jaxsmw.choices import Scale
from jaxsmw.errors import InputError, check_choice, check_number
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh
from jaxsmw.geometry.scale import estimate_scale, relative_boundary
from jaxsmw.geometry.shortcuts import cut_shortcuts
from jaxsmw.transfer.small_components import match_small_components

# A preset uses at most one eigenvector per two vertices. With fewer vertices, a preset would use fewer than
# two eigenvectors.
_FEWEST_VERTICES = 4
# The area of a closed full shape must be at least this share of the area of the part. The area of a body
# changes by a few per cent between poses.
_SMALLEST_FULL_SHAPE = 0.8


@dataclass(frozen=True, eq=False)
class Pair:
    """Two meshes to be matched, the source X and the target Y, with a flag for partial shapes.

    `Pair.make` makes a pair and checks its arguments; the constructor checks nothing.

    **Attributes:**

    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y (n vertices), each a `Mesh`.
    - `partial`: False for two full shapes. True if one mesh or both meshes are partial shapes.
    - `scale`: for a partial pair, the factor by which lengths on X are multiplied to become lengths in the
      unit of Y. The factor is 1 if both meshes have the same unit. Full shapes ignore the scale.
    """

    mesh_x: Mesh
    mesh_y: Mesh
    partial: bool = False
    scale: float = 1.0

    @classmethod
    def make(
        cls,
        mesh_x: Mesh | MeshLike,
        mesh_y: Mesh | MeshLike,
        *,
        partial: bool = False,
        scale: float | Scale = 1.0,
    ) -> Pair:
        """Make a pair from meshes of this library or of other libraries.

        **Arguments:**

        - `mesh_x`, `mesh_y`: the source X and the target Y, each as a `Mesh` or as any mesh that
          `jaxsmw.make_mesh` accepts.
        - `partial`: see the attribute.
        - `scale`: for a partial pair, the factor by which lengths on X are multiplied to become lengths in
          the unit of Y. With `"unknown"`, the factor is estimated; see `jaxsmw.geometry.estimate_scale`.

        **Returns:** A `Pair`. The function issues a `UserWarning` if the estimated scale is uncertain.

        **Raises:** `InputError` if `jaxsmw.make_mesh` refuses a mesh, or `partial` is not a Boolean.
        `InputError` is also raised if the scale is neither positive nor `"unknown"`, if full shapes have a
        scale, or if the scale cannot be estimated. For a partial pair, `InputError` is also raised if
        one mesh is closed, the other mesh is open, and the closed mesh has a clearly smaller area.
        """
        if not isinstance(partial, bool | np.bool):
            raise InputError(f"partial is {partial!r}: give True or False.")
        mesh_x, mesh_y = (
            as_mesh(mesh, name) for mesh, name in ((mesh_x, "source mesh"), (mesh_y, "target mesh"))
        )
        pair = cls(mesh_x, mesh_y, bool(partial), _known_scale(mesh_x, mesh_y, bool(partial), scale))
        if pair.partial:
            pair._check_areas()
        return pair

    @property
    def meshes(self) -> tuple[Mesh, Mesh]:
        """The meshes X and Y."""
        return self.mesh_x, self.mesh_y

    @property
    def name(self) -> str:
        """The names of both meshes, as text for messages."""
        return f"{self.mesh_x.name} to {self.mesh_y.name}"

    @property
    def units_of_length(self) -> tuple[float, float]:
        """The units of length of X and of Y, two floats.

        Each unit is in the coordinates of the mesh. For two full shapes, the units are the square roots of
        the areas of X and of Y, which compensates for a difference in size. For a partial pair, both units
        are the square root of the larger area.
        """
        root_x, root_y = self.mesh_x.area**0.5, self.mesh_y.area**0.5
        if not self.partial:
            return root_x, root_y
        return max(root_x, root_y / self.scale), max(root_x * self.scale, root_y)

    @property
    def areas(self) -> tuple[float, float]:
        """The areas of X and of Y in `units_of_length`.

        Each area is a float. Two full shapes each have area 1. In a partial pair, the larger shape has area
        1.
        """
        unit_x, unit_y = self.units_of_length
        return self.mesh_x.area / unit_x**2, self.mesh_y.area / unit_y**2

    @property
    def source_is_whole(self) -> bool:
        """Whether Y is the smaller shape of a partial pair, and X is therefore taken as the whole shape."""
        area_x, area_y = self.areas
        return self.partial and area_x > area_y

    def _check_areas(self) -> None:
        """Check that a closed full shape is not clearly smaller than its open part.

        **Raises:** `InputError` if the closed mesh has clearly less area than the open mesh.
        """
        sides = zip(self.meshes, self.areas, map(relative_boundary, self.meshes), strict=True)
        (closed, small, hole), (other, large, boundary) = sorted(sides, key=lambda side: side[2])
        if hole == 0 < boundary and small < _SMALLEST_FULL_SHAPE * large:
            raise InputError(
                f"{other.name} is open and {closed.name} is closed, so {other.name} should be the partial "
                f"shape, but it has {large / small:.3g} times the area: check the units of length, or set "
                'scale="unknown".'
            )

    def fewest_vertices(self) -> int:
        """Count the referenced vertices of each mesh, and return the smaller count.

        **Raises:** `InputError` if a mesh has fewer than 4 referenced vertices, which are too few for
        matching.
        """
        return min(map(number_of_usable_vertices, self.meshes))

    def mirrored(self) -> Pair:
        """Return the pair with the mirror image of X in place of X; see `jaxsmw.Mesh.mirrored`."""
        return replace(self, mesh_x=self.mesh_x.mirrored())

    def without_shortcuts(self) -> Pair:
        """Return the pair with both meshes cut where they are fused with themselves; see `cut_shortcuts`.

        All vertices keep their numbers. If nothing is cut, the result is `self`.
        """
        meshes = cut_shortcuts(self.mesh_x), cut_shortcuts(self.mesh_y)
        return self if meshes == self.meshes else replace(self, mesh_x=meshes[0], mesh_y=meshes[1])

    def with_small_components(
        self, pointwise_map: Int64[np.ndarray, " m"]
    ) -> tuple[Int64[np.ndarray, " m"], float]:
        """Match the small components of X as well; see `jaxsmw.transfer.match_small_components`."""
        unit_x, unit_y = self.units_of_length
        return match_small_components(*self.meshes, pointwise_map, scale=unit_y / unit_x)

    def reversed(self) -> Pair:
        """Return the pair with X and Y exchanged."""
        return Pair(self.mesh_y, self.mesh_x, self.partial, 1 / self.scale)


def _known_scale(mesh_x: Mesh, mesh_y: Mesh, partial: bool, scale: float | Scale) -> float:
    """Return the scale of a pair as a number; see `Pair.make`."""
    if not partial:
        if scale != 1.0:
            raise InputError(
                f"scale is {scale!r}, but full shapes are scaled to the same area: leave the scale out, or "
                "set partial=True."
            )
        return 1.0
    if isinstance(scale, str):
        check_choice(scale, Scale, "a scale")
        estimate = estimate_scale(mesh_x, mesh_y)
        if estimate.uncertain:
            warnings.warn(
                f"{mesh_x.name} to {mesh_y.name}: the estimated scale {estimate.scale:.3g} is uncertain, "
                "because few points of the two shapes resemble each other. If the unit of length is known, "
                "give the scale as a number.",
                stacklevel=4,
            )
        return estimate.scale
    check_number("scale", scale, positive=True)
    if not 1e-100 <= scale <= 1e100:  # areas would overflow
        raise InputError(f"scale is {scale!r}: give a number from 1e-100 to 1e100.")
    return float(scale)


def number_of_usable_vertices(mesh: Mesh) -> int:
    """Count the referenced vertices of a mesh.

    **Raises:** `InputError` if there are fewer than 4, which are too few for matching.
    """
    number = len(mesh.referenced_indices)
    if number < _FEWEST_VERTICES:
        raise InputError(
            f"{mesh.name}: its faces use {number} vertices, which are too few for a match: give a mesh with "
            f"at least {_FEWEST_VERTICES} vertices, or hundreds for a meaningful result."
        )
    return number
