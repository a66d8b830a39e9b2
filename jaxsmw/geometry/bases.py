"""Further bases of functions on a mesh, for wavelet filtering on several bases at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import scipy.linalg
from jaxtyping import Float64

from jaxsmw.core.arrays import namespace
from jaxsmw.core.spectrum import Basis, Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.creases import crease_eigenpairs
from jaxsmw.geometry.mesh import Mesh

Eigenpairs = tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, "n k"]]

_EIGENPAIRS: dict[str, Callable[[Mesh, int], Eigenpairs]] = {"crease": crease_eigenpairs}


def add_bases(mesh: Mesh, spectrum: Spectrum, names: Iterable[str]) -> Spectrum:
    """Compute further bases of a mesh, for `WaveletPreservation(bases=...)`.

    The functions of a basis are the first eigenvectors of an operator, as many as the spectrum has. The
    Gram–Schmidt process, in the order of the eigenvalues, makes them orthonormal with respect to the vertex
    areas of the spectrum. Eigenvectors are cached on disk (`jaxsmw.runtime.cache`).

    **Arguments:**

    - `mesh`: the surface with n vertices, a `Mesh`.
    - `spectrum`: its `Spectrum` with k eigenvectors, as from `compute_spectrum`.
    - `names`: the names of the bases. So far, the only basis is `"crease"`, which consists of the
      `crease_eigenvectors`.

    **Returns:** The spectrum, with one `Basis` for each name as its `bases`.

    **Raises:** `InputError` if a name is unknown, or if a basis cannot be computed.
    """
    areas, number = np.asarray(spectrum.vertex_areas, np.float64), spectrum.eigenvalues.shape[0]
    xp, dtype = namespace(spectrum.eigenvectors), spectrum.eigenvectors.dtype
    # The operators measure areas relative to the area of the surface.
    areas, unit = areas / areas.sum(), areas.sum()
    bases = []
    for name in names:
        if name not in _EIGENPAIRS:
            raise InputError(
                f"{name!r} is not a basis that can be computed: choose from {', '.join(_EIGENPAIRS)}, or "
                "give your own basis (Spectrum.with_bases) to jaxsmw.refine."
            )
        eigenvalues, eigenvectors = _EIGENPAIRS[name](mesh, number)
        try:
            factor = scipy.linalg.cholesky(eigenvectors.T @ (areas[:, None] * eigenvectors))
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"{mesh.name}: the {number} functions of the basis {name!r} depend on each other: use fewer "
                "eigenvectors."
            ) from error
        orthonormal = scipy.linalg.solve_triangular(factor, eigenvectors.T, trans="T").T
        bases.append(
            Basis(name, xp.asarray(eigenvalues / unit, dtype), xp.asarray(orthonormal / np.sqrt(unit), dtype))
        )
    return spectrum.with_bases(tuple(bases))
