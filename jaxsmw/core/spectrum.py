"""The spectrum of a shape: eigenpairs of the Laplacian, vertex areas, and further data of the vertices."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsmw.core.arrays import Array, namespace, rows_at
from jaxsmw.core.module import Module, field
from jaxsmw.errors import InputError


class Basis(Module):
    """Further functions on a surface, with frequencies, for `WaveletPreservation(bases=...)`.

    The functions Psi are orthonormal with respect to the vertex areas A of the `Spectrum` that contains the
    basis: `Psi^T A Psi = I`. They are zero at masked vertices. `jaxsmw.geometry.add_bases` computes
    bases, and `Spectrum.with_bases` accepts any basis.

    **Attributes:**

    - `name`: the name, by which refiners choose a basis.
    - `eigenvalues`: (k,), ascending, in any unit that both shapes share, because filters depend only on their
      ratios.
    - `eigenvectors`: (n, k), in units of 1 / length.
    """

    name: str = field(static=True)
    eigenvalues: Float[Array, " k"]
    eigenvectors: Float[Array, "n k"]

    def truncate(self, number_of_eigenvectors: int) -> Basis:
        """Return the basis with only its first `number_of_eigenvectors` functions."""
        return dataclasses.replace(
            self,
            eigenvalues=self.eigenvalues[:number_of_eigenvectors],
            eigenvectors=self.eigenvectors[:, :number_of_eigenvectors],
        )


class Spectrum(Module):
    """The first k eigenpairs of a shape's Laplacian and the vertex areas, as a pytree of arrays.

    `compute_spectrum` computes the spectrum of a mesh. The eigenpairs solve `W phi = lambda A phi`. W is the
    positive semi-definite stiffness matrix of cotangent weights (the Laplace–Beltrami operator), and the
    diagonal matrix A contains the vertex areas. The eigenvectors Phi are orthonormal with respect to A:
    `Phi^T A Phi = I`.

    For `jax.vmap`, `jaxsmw.stack` stacks the arrays of several shapes along a new leading axis, and pads
    smaller shapes with masked vertices. Unreferenced vertices (vertices that no face references) are also
    masked. All vertex arrays are zero at masked vertices.

    The unit of length is the same in all attributes and otherwise arbitrary. `compute_spectrum` chooses the
    unit in which the area is 1.

    **Attributes:**

    - `eigenvalues`: (k,), ascending, in units of 1 / length².
    - `eigenvectors`: (n, k), in units of 1 / length.
    - `vertex_areas`: (n,), in units of length².
    - `mask`: (n,), True for vertices of the surface, False for masked vertices.
    - `descriptors`: (n, d), vertex descriptors that are comparable between shapes, without unit; or None.
      Only the refiners `FeatureRegression` and `Registration` use descriptors.
    - `crease_eigenvectors`: (n, c), without unit; or None. Unlike `eigenvectors`, they depend on how the
      surface bends; see `jaxsmw.geometry.crease_eigenvectors`. Only `FeatureRegression` uses them.
    - `positions`, `normals`: (n, 3), the vertex positions in units of length, and the outward unit normals;
      or None. Only `Registration` uses them.
    - `bases`: further bases, each a `Basis`. Only `WaveletPreservation` uses them.
    """

    eigenvalues: Float[Array, " k"]
    eigenvectors: Float[Array, "n k"]
    vertex_areas: Float[Array, " n"]
    mask: Bool[Array, " n"]
    descriptors: Float[Array, "n d"] | None = None
    positions: Float[Array, "n 3"] | None = None
    normals: Float[Array, "n 3"] | None = None
    crease_eigenvectors: Float[Array, "n c"] | None = None
    bases: tuple[Basis, ...] = ()

    def truncate(self, number_of_eigenvectors: int) -> Spectrum:
        """Return the spectrum with only the first `number_of_eigenvectors` eigenpairs, also of each basis."""
        return dataclasses.replace(
            self,
            eigenvalues=self.eigenvalues[:number_of_eigenvectors],
            eigenvectors=self.eigenvectors[:, :number_of_eigenvectors],
            bases=tuple(basis.truncate(number_of_eigenvectors) for basis in self.bases),
        )

    def scale(self, factor: float) -> Spectrum:
        """Return the spectrum of the shape whose areas are multiplied by a positive `factor`."""
        factor = float(factor)  # a number of NumPy would change the float type of the arrays
        return dataclasses.replace(
            self,
            eigenvalues=self.eigenvalues / factor,
            eigenvectors=self.eigenvectors / factor**0.5,
            vertex_areas=self.vertex_areas * factor,
            positions=None if self.positions is None else self.positions * factor**0.5,
            bases=tuple(
                dataclasses.replace(
                    basis,
                    eigenvalues=basis.eigenvalues / factor,
                    eigenvectors=basis.eigenvectors / factor**0.5,
                )
                for basis in self.bases
            ),
        )

    def reflect(self) -> Spectrum:
        """Return the spectrum of the mirror image, which negates the first coordinate of vectors."""
        flip = namespace(self.eigenvectors).asarray([[-1, 1, 1]])
        return dataclasses.replace(
            self,
            positions=None if self.positions is None else self.positions * flip.astype(self.positions.dtype),
            normals=None if self.normals is None else self.normals * flip.astype(self.normals.dtype),
        )

    def with_descriptors(self, descriptors: Float[Array, "n d"] | None) -> Spectrum:
        """Return the spectrum with the given descriptors (n, d) or None.

        **Raises:** `ValueError` if the descriptors do not have one row per vertex.
        """
        self._check_rows("descriptors", descriptors)
        return dataclasses.replace(self, descriptors=descriptors)

    def with_crease_eigenvectors(self, crease_eigenvectors: Float[Array, "n c"] | None) -> Spectrum:
        """Return the spectrum with the given crease eigenvectors (n, c) or None.

        **Raises:** `ValueError` if the crease eigenvectors do not have one row per vertex.
        """
        self._check_rows("crease eigenvectors", crease_eigenvectors)
        return dataclasses.replace(self, crease_eigenvectors=crease_eigenvectors)

    def with_positions(self, positions: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Spectrum:
        """Return the spectrum with the given vertex positions and unit normals.

        The positions must have the same unit of length as the vertex areas.

        **Raises:** `ValueError` if an array does not have one row of 3 numbers per vertex.
        """
        self._check_rows("positions", positions, 3)
        self._check_rows("normals", normals, 3)
        return dataclasses.replace(self, positions=positions, normals=normals)

    def with_bases(self, bases: tuple[Basis, ...]) -> Spectrum:
        """Return the spectrum with the given further bases, or with none.

        **Raises:** `ValueError` if the functions of a basis do not have one row per vertex.
        """
        for basis in bases:
            self._check_rows(f"functions of the basis {basis.name!r}", basis.eigenvectors)
        return dataclasses.replace(self, bases=tuple(bases))

    def joined(self, names: tuple[str, ...]) -> JoinedSpectrum:
        """Return the spectrum whose eigenpairs are those of several bases, one basis after another.

        **Arguments:**

        - `names`: names of bases. `"laplacian"` means the eigenpairs of the spectrum itself.

        **Raises:** `InputError` if the spectrum has no basis of a name.
        """
        known: dict[str, Basis | Spectrum] = {"laplacian": self}
        known |= {basis.name: basis for basis in self.bases}
        if missing := [name for name in names if name not in known]:
            raise InputError(
                f"a spectrum has no basis {missing[0]!r}: compute it (jaxsmw.geometry.add_bases), or give "
                "your own (Spectrum.with_bases)."
            )
        parts = [known[name] for name in names]
        xp = namespace(self.eigenvectors)
        others = {one.name: getattr(self, one.name) for one in dataclasses.fields(Spectrum)}
        others |= {
            "eigenvalues": xp.concatenate([part.eigenvalues for part in parts]),
            "eigenvectors": xp.concatenate([part.eigenvectors for part in parts], axis=1),
            "bases": (),
        }
        return JoinedSpectrum(**others, sizes=tuple(part.eigenvalues.shape[0] for part in parts))

    def pad(self, number_of_vertices: int) -> Spectrum:
        """Return the spectrum with masked vertices appended, so that it has `number_of_vertices` vertices.

        **Raises:** `ValueError` if the shape already has more vertices.
        """
        xp = namespace(self.eigenvectors)
        rows = number_of_vertices - self.mask.shape[0]
        if rows < 0:
            raise ValueError(
                f"a shape of {self.mask.shape[0]} vertices does not fit into {number_of_vertices} vertices: "
                f"pad it to {self.mask.shape[0]} vertices or more"
            )
        if rows == 0:
            return self
        return self._map_vertex_arrays(
            lambda array: xp.pad(array, ((0, rows), *((0, 0),) * (array.ndim - 1)))
        )

    def sample(self, vertices: Int[Array, " s"]) -> Spectrum:
        """Return the spectrum at the given vertices only (the samples), which should be evenly spread.

        All samples receive the same area, and their areas sum to the area of the shape. The eigenvectors are
        not orthonormal on samples, so their pseudo-inverse must be computed by least squares.
        """
        xp = namespace(self.vertex_areas)
        share = xp.sum(self.vertex_areas) / vertices.shape[0]
        sampled = self._map_vertex_arrays(lambda array: rows_at(array, vertices))
        return dataclasses.replace(sampled, vertex_areas=xp.full(vertices.shape, share))

    def excluding(self, vertices: Bool[Array, " n"]) -> Spectrum:
        """Return the spectrum with area zero where the mask `vertices` is True, and the same total area."""
        xp = namespace(self.vertex_areas, vertices)
        areas = xp.where(vertices, 0, self.vertex_areas)
        return dataclasses.replace(self, vertex_areas=areas * (xp.sum(self.vertex_areas) / xp.sum(areas)))

    def _check_rows(self, name: str, rows: Array | None, columns: int | None = None) -> None:
        if rows is None:
            return
        n, shape = self.mask.shape[0], rows.shape
        if len(shape) != 2 or shape[0] != n or columns not in (None, shape[1]):
            needed = f"({n}, {'d' if columns is None else columns})"
            raise ValueError(
                f"the {name} have shape {shape}, but {needed} is needed: give one row for each vertex"
            )

    def _map_vertex_arrays(self, change: Callable[[Array], Array]) -> Spectrum:
        """Return the spectrum with a function applied to all arrays that have one row per vertex."""
        names = [one.name for one in dataclasses.fields(Spectrum) if one.name not in ("eigenvalues", "bases")]
        present = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        changed: dict[str, Any] = {name: change(array) for name, array in present.items()}
        changed["bases"] = tuple(
            dataclasses.replace(basis, eigenvectors=change(basis.eigenvectors)) for basis in self.bases
        )
        return dataclasses.replace(self, **changed)


class JoinedSpectrum(Spectrum):
    """The eigenpairs of several bases side by side, the result of `Spectrum.joined`.

    Functions of one basis are orthonormal, but functions of different bases are not orthogonal. The
    attribute `sizes` contains the number of functions of each basis.
    """

    sizes: tuple[int, ...] = field(static=True, default=())


def by_basis(spectrum: Spectrum, array: Float[Array, "*rows k"]) -> list[Float[Array, "*rows k_b"]]:
    """Return an array in parts, one for the eigenpairs of each basis, which its last axis counts."""
    if not isinstance(spectrum, JoinedSpectrum):
        return [array]
    ends = np.cumsum(spectrum.sizes).tolist()
    return [array[..., end - size : end] for end, size in zip(ends, spectrum.sizes, strict=True)]
