"""The first eigenpairs of a mesh's Laplace–Beltrami operator: from Mesh to Spectrum."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse as sp
from jaxtyping import Float64
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu
from threadpoolctl import threadpool_limits

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.cache import cached
from jaxsmw.geometry.laplacian import Laplacian, assemble_laplacian, choose_laplacian
from jaxsmw.geometry.mesh import Mesh

# On a surface of area 1, where the first non-zero eigenvalue of a body lies between 1 and 30.
_SHIFT = -1e-2
# What an eigenbasis must fulfil: residuals relative to the largest eigenvalue, and |Phi^T A Phi - I|.
_RESIDUAL_TOLERANCE = 1e-6
_ORTHONORMALITY_TOLERANCE = 1e-8
# Below this many vertices a dense solver is as fast, and never in doubt.
_DENSE = 400


def compute_spectrum(
    mesh: Mesh, number_of_eigenvectors: int = 100, *, laplacian: Laplacian = "auto"
) -> Spectrum:
    """The Spectrum of a mesh, scaled to area 1 so that the unit of the file does not matter.

    Computed in float64 on the host, by shift-invert Lanczos with a fixed start vector, so that the same
    mesh gives the same Spectrum; each eigenvector's largest entry is positive. Connected components are
    solved one by one and merged. Residuals and orthonormality are checked, and eigenvalues counted: where
    a copy of a multiple one is missing, ARPACK takes over. Results are kept on disk
    (`jaxsmw.geometry.cache`).

    **Arguments:**

    - `mesh`: the surface, n vertices.
    - `number_of_eigenvectors`: k, at least 1 and less than the number of used vertices.
    - `laplacian`: which discretisation; see `assemble_laplacian`.

    **Returns:** A `Spectrum` of JAX's default float type (float32 unless `jax_enable_x64` is set). Vertices
    that no face uses are masked.

    **Raises:** `InputError` if k does not fit the mesh or the eigenproblem cannot be solved accurately.
    """
    return as_spectrum(mesh, *eigenpairs(mesh, number_of_eigenvectors, laplacian=laplacian))


def as_spectrum(
    mesh: Mesh,
    eigenvalues: Float64[np.ndarray, " k"],
    eigenvectors: Float64[np.ndarray, "n k"],
    vertex_areas: Float64[np.ndarray, " n"],
) -> Spectrum:
    """The `eigenpairs` of a mesh for JAX, in its default float type."""
    arrays = eigenvalues, eigenvectors, vertex_areas, mesh.used_vertices
    return Spectrum(*(jnp.asarray(array) for array in arrays))


def eigenpairs(
    mesh: Mesh, number_of_eigenvectors: int, *, laplacian: Laplacian = "auto"
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, "n k"], Float64[np.ndarray, " n"]]:
    """`compute_spectrum` in NumPy float64: eigenvalues, eigenvectors, vertex areas, for total area 1."""
    used = np.flatnonzero(mesh.used_vertices)
    if not 1 <= number_of_eigenvectors < len(used):
        raise InputError(
            f"{mesh.name}: {number_of_eigenvectors} eigenvectors were asked for, but a mesh with {len(used)} "
            f"used vertices has between 1 and {len(used) - 1} to give; ask for fewer or use a finer mesh."
        )
    if laplacian == "auto":
        laplacian = choose_laplacian(mesh)

    def compute() -> dict[str, np.ndarray]:
        stiffness, areas = assemble_laplacian(mesh, laplacian=laplacian)
        areas = areas / areas.sum()
        with threadpool_limits(1, "blas"):
            values, vectors = _solve(stiffness[used][:, used], areas[used], number_of_eigenvectors, mesh.name)
        largest = np.argmax(np.abs(vectors), axis=0)
        eigenvectors = np.zeros((len(mesh.vertices), number_of_eigenvectors))
        eigenvectors[used] = vectors * np.sign(vectors[largest, np.arange(number_of_eigenvectors)])
        return {"eigenvalues": values, "eigenvectors": eigenvectors, "vertex_areas": areas}

    result = cached("spectrum", (mesh.vertices, mesh.faces, number_of_eigenvectors, laplacian), compute)
    return result["eigenvalues"], result["eigenvectors"], result["vertex_areas"]


def _solve(stiffness: sp.csc_matrix, areas: np.ndarray, k: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The k smallest eigenpairs over all connected components."""
    number_of_components, component = connected_components(stiffness, directed=False)
    values, members, vectors = [], [], []
    for label in range(number_of_components):
        vertices = np.flatnonzero(component == label)
        block = stiffness[vertices][:, vertices]
        block_values, block_vectors = _solve_component(block, areas[vertices], min(k, len(vertices)), name)
        values.append(block_values)
        vectors.append(block_vectors)
        members.append(vertices)
    if number_of_components == 1:
        return values[0], vectors[0]
    origin = np.repeat(np.arange(number_of_components), [len(v) for v in values])
    column = np.concatenate([np.arange(len(v)) for v in values])
    smallest = np.argsort(np.concatenate(values), kind="stable")[:k]
    eigenvectors = np.zeros((len(areas), k))
    for position, index in enumerate(smallest):
        eigenvectors[members[origin[index]], position] = vectors[origin[index]][:, column[index]]
    return np.concatenate(values)[smallest], eigenvectors


def _solve_component(
    stiffness: sp.csc_matrix, areas: np.ndarray, k: int, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """The k smallest eigenpairs of one connected component, checked."""
    n = len(areas)
    if n <= _DENSE or 3 * k > n:
        attempts = [lambda: _dense(stiffness, areas, k)]
    else:
        attempts = [lambda: _lanczos(stiffness, areas, k), lambda: _arpack(stiffness, areas, k)]
    failure = ""
    for attempt in attempts:
        try:
            eigenvalues, eigenvectors = attempt()
        except (ArpackError, RuntimeError, np.linalg.LinAlgError) as error:
            failure = str(error).splitlines()[0]
            continue
        residual, deviation = _check(stiffness, areas, eigenvalues, eigenvectors)
        if residual <= _RESIDUAL_TOLERANCE and deviation <= _ORTHONORMALITY_TOLERANCE:
            # Of a connected surface the first is zero, whatever rounding made of it.
            eigenvalues = np.maximum(eigenvalues, 0)
            eigenvalues[0] = 0
            return eigenvalues, eigenvectors
        failure = f"relative residual {residual:.1e}, deviation from orthonormality {deviation:.1e}"
    raise InputError(
        f"{name}: its first {k} eigenvectors could not be computed accurately ({failure}); the mesh is "
        "probably badly shaped: try the robust Laplacian (laplacian='robust', on the command line "
        "--laplacian robust), fewer eigenvectors or a remeshed surface."
    )


def _dense(stiffness: sp.csc_matrix, areas: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    scale = 1 / np.sqrt(areas)
    symmetric = scale[:, None] * stiffness.toarray() * scale
    eigenvalues, eigenvectors = scipy.linalg.eigh((symmetric + symmetric.T) / 2, subset_by_index=(0, k - 1))
    return eigenvalues, scale[:, None] * eigenvectors


class _Inverse:
    """A^1/2 (W - shift A)^-1 A^1/2, symmetric, with eigenvalues 1 / (lambda - shift)."""

    def __init__(self, stiffness: sp.csc_matrix, areas: np.ndarray, shift: float = _SHIFT):
        # Without symmetric mode this ordering would be slower by orders of magnitude.
        self.factor = splu(
            (stiffness - shift * sp.diags(areas)).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        self.root = np.sqrt(areas)

    def __call__(self, vector: np.ndarray) -> np.ndarray:
        return self.root * self.factor.solve(self.root * vector)


def _lanczos(stiffness: sp.csc_matrix, areas: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The Lanczos method on `_Inverse`, from one vector until all k have settled, without restarts.

    About 2.3 k products suffice; keeping every vector orthogonal to all before it costs less than ARPACK's
    restarts. What one starting vector could miss, copies of a multiple eigenvalue, is counted.

    **Raises:** `RuntimeError` if they do not settle, or some are missing.
    """
    n, most = len(areas), min(len(areas) - 1, 4 * k + 50)
    inverse = _Inverse(stiffness, areas)
    vectors = np.empty((most + 1, n))
    vectors[0] = np.random.default_rng(0).standard_normal(n)
    vectors[0] /= np.linalg.norm(vectors[0])
    diagonal, beside = np.zeros(most), np.zeros(most)
    look = 2 * k
    for last in range(most):
        following = inverse(vectors[last])
        diagonal[last] = vectors[last] @ following
        following -= diagonal[last] * vectors[last]
        if last:
            following -= beside[last - 1] * vectors[last - 1]
        known = vectors[: last + 1]
        following -= (known @ following) @ known
        beside[last] = np.linalg.norm(following)
        if beside[last] <= np.finfo(float).eps * diagonal[0]:
            raise RuntimeError("the Lanczos vectors span an invariant subspace")
        vectors[last + 1] = following / beside[last]
        if last + 1 == min(look, most):
            wanted = (last + 1 - k, last)
            inverted, combinations = scipy.linalg.eigh_tridiagonal(
                diagonal[: last + 1], beside[:last], select="i", select_range=wanted
            )
            if (beside[last] * np.abs(combinations[-1]) <= _SETTLED * np.abs(inverted)).all():
                break
            look += max(5, k // 20)
    else:
        raise RuntimeError("the Lanczos vectors have not settled")
    # The largest first, which belong to the smallest eigenvalues.
    eigenvalues = 1 / inverted[::-1] + _SHIFT
    eigenvectors = vectors[: last + 1].T @ combinations[:, ::-1]
    if _misses_some(stiffness, areas, eigenvalues):
        raise RuntimeError("a multiple eigenvalue lacks some of its eigenvectors")
    return eigenvalues, eigenvectors / inverse.root[:, None]


# Relative residual of the inverse at which an eigenvector is settled.
_SETTLED = 1e-9


def _misses_some(stiffness: sp.csc_matrix, areas: np.ndarray, eigenvalues: np.ndarray) -> bool:
    """Whether there are more eigenvalues than those found, below the widest gap near their end.

    As many as W - shift A has negative pivots lie below the shift (Sylvester's law of inertia).
    """
    if len(eigenvalues) == 1:
        return False
    gaps = np.diff(eigenvalues[-_NEAR_END:])
    below = len(eigenvalues) - len(gaps) + int(np.argmax(gaps))
    shift = float(eigenvalues[below - 1 : below + 1].mean())
    return int((_Inverse(stiffness, areas, shift).factor.U.diagonal() < 0).sum()) != below


_NEAR_END = 12


def _arpack(stiffness: sp.csc_matrix, areas: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The same by ARPACK, which restarts and takes all the digits it can have."""
    n = len(areas)
    inverse = _Inverse(stiffness, areas)
    operator = LinearOperator((n, n), matvec=lambda vector: inverse(vector.ravel()), dtype=float)
    start = np.random.default_rng(0).standard_normal(n)
    inverted, vectors = eigsh(operator, k, which="LM", ncv=min(n, 3 * k + 50), tol=0, v0=start)
    eigenvalues = 1 / inverted + _SHIFT
    order = np.argsort(eigenvalues, kind="stable")
    return eigenvalues[order], vectors[:, order] / inverse.root[:, None]


def _check(
    stiffness: sp.csc_matrix, areas: np.ndarray, eigenvalues: np.ndarray, eigenvectors: np.ndarray
) -> tuple[float, float]:
    """The largest relative residual |A^-1 W phi - lambda phi|_A / lambda_max, and max |Phi^T A Phi - I|."""
    weighted = areas[:, None] * eigenvectors
    residuals = stiffness @ eigenvectors - weighted * eigenvalues
    norms = np.sqrt(np.sum(residuals**2 / areas[:, None], axis=0))
    deviation = np.abs(eigenvectors.T @ weighted - np.eye(len(eigenvalues))).max()
    # A lone zero eigenvalue gives no scale; one on the surface of area 1 does.
    return float(norms.max() / max(eigenvalues.max(), 1.0)), float(deviation)
