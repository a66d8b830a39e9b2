"""A pair of surfaces to be matched, and their spectra in comparable units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxsmw.choices import Eigensolver, Laplacian
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.eigenbasis import as_spectrum, choose_eigensolver, eigenpairs
from jaxsmw.geometry.mesh import Mesh, MeshLike, make_mesh
from jaxsmw.runtime.threads import side_by_side

# A thousandth of a body's area shows nothing of its shape.
_SMALLEST_PART = 1e-3


@dataclass(frozen=True, eq=False)
class Pair:
    """Source X and target Y, and whether one of them shows only a part of the other.

    **Attributes:**

    - `mesh_x`, `mesh_y`: X (m vertices) and Y (n vertices).
    - `partial`: one mesh is a partial view of the other, in the same unit of length.
    """

    mesh_x: Mesh
    mesh_y: Mesh
    partial: bool = False

    @classmethod
    def make(cls, mesh_x: Mesh | MeshLike, mesh_y: Mesh | MeshLike, *, partial: bool = False) -> Pair:
        """A pair of meshes of this or other libraries; see `jaxsmw.make_mesh`.

        **Raises:** `InputError` if an argument is not a mesh, or `partial` is not a truth value.
        """
        if not isinstance(partial, bool | np.bool):
            raise InputError(f"partial is {partial!r}; give True or False.")
        mesh_x, mesh_y = (
            mesh if isinstance(mesh, Mesh) else make_mesh(mesh, name=name)
            for mesh, name in ((mesh_x, "source mesh"), (mesh_y, "target mesh"))
        )
        return cls(mesh_x, mesh_y, bool(partial))

    @property
    def meshes(self) -> tuple[Mesh, Mesh]:
        """X and Y."""
        return self.mesh_x, self.mesh_y

    @property
    def name(self) -> str:
        """Both names, for messages."""
        return f"{self.mesh_x.name} to {self.mesh_y.name}"

    @property
    def units_of_length(self) -> tuple[float, float]:
        """The lengths that count as 1 on X and on Y: square roots of areas.

        Full shapes have each their own unit, so that a difference in size cancels. For a partial pair both
        units are that of the larger shape.
        """
        roots = self.mesh_x.area**0.5, self.mesh_y.area**0.5
        return (max(roots),) * 2 if self.partial else roots

    def reversed(self) -> Pair:
        """The pair with X and Y exchanged."""
        return Pair(self.mesh_y, self.mesh_x, self.partial)


def paired_spectra(
    pair: Pair,
    number_of_eigenvectors: int,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
) -> tuple[Spectrum, Spectrum]:
    """The spectra of both meshes, in the units in which the meshes are matched.

    Full shapes are each scaled to area 1, so that a difference in size cancels. A partial pair is scaled
    by one factor, which takes the larger shape to area 1. The spectra of a partial pair are then cut to
    their `common_range`, so that k_X and k_Y differ.

    **Arguments:**

    - `number_of_eigenvectors`: k.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`.

    **Raises:** `InputError` if a spectrum cannot be computed (see `jaxsmw.compute_spectrum`), or a mesh is
    too small to be a part of the other mesh.
    """
    if eigensolver == "auto":  # the same for both shapes, because their spectra are compared
        eigensolver = choose_eigensolver(*pair.meshes)
    eigenpairs_x, eigenpairs_y = side_by_side(
        lambda mesh: eigenpairs(mesh, number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver),
        *pair.meshes,
    )
    # Outside of the threads, which do not inherit `jax.enable_x64`.
    spectrum_x, spectrum_y = as_spectrum(pair.mesh_x, *eigenpairs_x), as_spectrum(pair.mesh_y, *eigenpairs_y)
    if not pair.partial:
        return spectrum_x, spectrum_y
    areas = pair.mesh_x.area, pair.mesh_y.area
    if min(areas) < _SMALLEST_PART * max(areas):
        raise InputError(
            f"{pair.mesh_x.name} has area {areas[0]:.3g} and {pair.mesh_y.name} {areas[1]:.3g}, so neither "
            "is a part of the other in the same unit of length: scale one of them."
        )
    scales = (area / max(areas) for area in areas)
    return common_range(
        *(s.scale(factor) for s, factor in zip((spectrum_x, spectrum_y), scales, strict=True))
    )


def common_range(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Spectrum, Spectrum]:
    """Both spectra cut at the smaller of their largest eigenvalues (MWP paper, partial shapes)."""
    spectra = spectrum_x, spectrum_y
    last = min(float(spectrum.eigenvalues[-1]) for spectrum in spectra)
    cut = [s.truncate(int((np.asarray(s.eigenvalues) <= last).sum())) for s in spectra]
    return cut[0], cut[1]
