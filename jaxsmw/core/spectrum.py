"""The Spectrum: all that the traced core knows of a shape."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Spectrum(eqx.Module):
    """The first k eigenpairs of a shape's Laplace–Beltrami operator, as a pytree of arrays.

    `W phi = lambda A phi` with W the positive semi-definite cotangent stiffness and A the lumped vertex
    areas; the eigenvectors are orthonormal in the areas, `Phi^T A Phi = I`.

    Written for one shape. A stack of shapes of equal size (every leaf with a leading axis) goes through
    `jax.vmap`; sizes differ, so smaller shapes are padded with vertices that have `mask` False, zero area
    and zero eigenvectors. A vertex that no face uses is just such a vertex.

    **Attributes:**

    - `eigenvalues`: (k,), ascending, in units of 1 / length².
    - `eigenvectors`: (n, k).
    - `vertex_areas`: (n,), in units of length²; zero where masked.
    - `mask`: (n,), True for vertices of the surface.
    - `descriptors`: (n, d), what else is known of each vertex, or None. Comparable between shapes; zero where
      masked. Only methods that say so look at them.
    - `positions`, `normals`: (n, 3) each, or None: where the vertices are, in units of length, and unit
      vectors that point outwards; zero where masked. Only methods that say so look at them.
    """

    eigenvalues: Float[Array, " k"]
    eigenvectors: Float[Array, "n k"]
    vertex_areas: Float[Array, " n"]
    mask: Bool[Array, " n"]
    descriptors: Float[Array, "n d"] | None = None
    positions: Float[Array, "n 3"] | None = None
    normals: Float[Array, "n 3"] | None = None

    def truncate(self, number_of_eigenvectors: int) -> Spectrum:
        """The same shape with its first eigenpairs only."""
        return dataclasses.replace(
            self,
            eigenvalues=self.eigenvalues[:number_of_eigenvectors],
            eigenvectors=self.eigenvectors[:, :number_of_eigenvectors],
        )

    def scale(self, factor: float) -> Spectrum:
        """The same shape with every area multiplied by a factor, every length by its square root."""
        return dataclasses.replace(
            self,
            eigenvalues=self.eigenvalues / factor,
            eigenvectors=self.eigenvectors / factor**0.5,
            vertex_areas=self.vertex_areas * factor,
            positions=None if self.positions is None else self.positions * factor**0.5,
        )

    def describe(self, descriptors: Float[Array, "n d"] | None) -> Spectrum:
        """The same shape with other descriptors, or none.

        **Raises:** `ValueError` if there is not a row for each vertex.
        """
        self._check_rows("descriptors", descriptors)
        return dataclasses.replace(self, descriptors=descriptors)

    def place(self, positions: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Spectrum:
        """The same shape with these positions, in its own unit of length, and unit normals.

        **Raises:** `ValueError` if there is not a row for each vertex.
        """
        self._check_rows("positions", positions, 3)
        self._check_rows("normals", normals, 3)
        return dataclasses.replace(self, positions=positions, normals=normals)

    def pad(self, number_of_vertices: int) -> Spectrum:
        """The same shape with masked vertices up to a given number.

        **Raises:** `ValueError` if it has more vertices already.
        """
        rows = number_of_vertices - self.mask.shape[0]
        if rows < 0:
            raise ValueError(f"a shape of {self.mask.shape[0]} vertices does not fit {number_of_vertices}")
        if rows == 0:
            return self
        return self._at_vertices(lambda field: jnp.pad(field, ((0, rows), *((0, 0),) * (field.ndim - 1))))

    def sample(self, vertices: Int[Array, " s"]) -> Spectrum:
        """The shape seen at some evenly spread vertices only, each standing for the same share of the area.

        The eigenvectors are no longer orthonormal there, so only the least-squares pseudo-inverse makes
        sense of them.
        """
        share = jnp.sum(self.vertex_areas) / vertices.shape[0]
        sampled = self._at_vertices(lambda field: field[vertices])
        return dataclasses.replace(sampled, vertex_areas=jnp.full(vertices.shape, share))

    def _check_rows(self, name: str, rows: Array | None, columns: int | None = None) -> None:
        if rows is None:
            return
        n, shape = self.mask.shape[0], jnp.shape(rows)
        if len(shape) != 2 or shape[0] != n or columns not in (None, shape[1]):
            row = "a row" if columns is None else f"a row of {columns} numbers"
            raise ValueError(f"{name} have shape {shape}, but {row} is needed for each of the {n} vertices")

    def _at_vertices(self, change: Callable[[Array], Array]) -> Spectrum:
        """The same shape with everything that it has of each vertex changed."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "eigenvalues"]
        of_vertices = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return dataclasses.replace(self, **{name: change(field) for name, field in of_vertices.items()})
