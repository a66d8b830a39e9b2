"""The discrete Laplace–Beltrami operator of a mesh, as a stiffness matrix and vertex areas."""

from __future__ import annotations

from typing import Literal

import igl
import numpy as np
import robust_laplacian
import scipy.sparse as sp
from jaxtyping import Float64

from jaxsmw.choices import Laplacian
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh


def choose_laplacian(mesh: Mesh) -> Literal["cotangent", "robust"]:
    """Choose the Laplacian that `"auto"` stands for; see `jaxsmw.geometry.compute_spectrum`."""
    return "robust" if mesh.degenerate_faces.any() or len(mesh.nonmanifold_edges) else "cotangent"


def assemble_laplacian(
    mesh: Mesh, *, laplacian: Laplacian = "auto"
) -> tuple[sp.csc_matrix, Float64[np.ndarray, " n"]]:
    """Assemble the stiffness matrix W and the lumped vertex areas A of the problem `W phi = lambda A phi`.

    **Returns:** The dimensionless matrix W (n, n), which is symmetric and positive semi-definite, and the
    areas A (n,), in the squared unit of the mesh. Both are zero at unreferenced vertices.

    **Raises:** `InputError` if the Laplacian contains NaN or a referenced vertex has no positive area.
    """
    if laplacian == "auto":
        laplacian = choose_laplacian(mesh)
    if laplacian == "robust":
        # The package robust_laplacian requires that every vertex belongs to a face.
        stiffness, mass = robust_laplacian.mesh_laplacian(*mesh.compact())
        masses = mass.diagonal()
        if not np.isfinite(stiffness.data).all() or not (masses > 0).all():
            raise InputError(
                f"{mesh.name}: the robust Laplacian contains NaN, or a vertex has no positive area: remesh "
                "the surface, or remove the triangles without area."
            )
        used = mesh.referenced_indices
        scatter = sp.csc_matrix(
            (np.ones(len(used)), (used, np.arange(len(used)))), (len(mesh.vertices), len(used))
        )
        return (scatter @ stiffness @ scatter.T).tocsc(), mesh.spread(masses)
    stiffness = -igl.cotmatrix(mesh.vertices, mesh.faces).tocsc()
    areas = mesh.vertex_areas
    if not np.isfinite(stiffness.data).all() or (areas[mesh.referenced_indices] <= 0).any():
        raise InputError(
            f"{mesh.name}: the cotangent Laplacian is undefined on zero-area faces: use the robust Laplacian "
            "(laplacian='robust')."
        )
    return stiffness, areas
