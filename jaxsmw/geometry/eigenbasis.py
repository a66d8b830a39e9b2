"""The first eigenpairs of the Laplace–Beltrami operator of a mesh."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from jaxtyping import Float64
from scipy.sparse import csgraph
from scipy.sparse.linalg import ArpackError, LinearOperator, SuperLU, eigsh, splu

from jaxsmw.choices import APPROXIMATE_FROM, NUMBER_OF_EIGENVECTORS, Eigensolver, Laplacian
from jaxsmw.core.arrays import float_type
from jaxsmw.core.checks import check_kind
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.coarsening import coarsen
from jaxsmw.geometry.laplacian import assemble_laplacian, choose_laplacian
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.runtime.cache import cached
from jaxsmw.runtime.threads import one_blas_thread

# The shift that ARPACK uses for a surface of area 1. The first non-zero eigenvalue of a body of area 1 is
# between 1 and 30.
_SHIFT = -1e-2
# The largest accepted relative residual of an exact solver.
_RESIDUAL_TOLERANCE = 1e-6
# The largest accepted deviation from orthonormality.
_ORTHONORMALITY_TOLERANCE = 1e-8
# Up to this number of vertices, a dense solver is as fast as the sparse solvers and always succeeds.
_DENSE = 400
# The number of vectors in a block. SuperLU holds Python's global lock while it manages memory, so other
# threads must wait. Larger blocks reduce the time for which other threads wait, but need more products to
# converge.
_BLOCK = 4
# The number of subspace dimensions per eigenvector.
_DIMENSIONS_OF_SUBSPACE = 30
# The number of rows of a matrix that fit into the cache.
_ROWS = 1024
# If one more smoothing step lowers an eigenvalue by more than this fraction, the approximation is rejected.
# The relative error of an accepted eigenvalue is up to three times this fraction.
_MOST_LOWERED = 0.015


def compute_spectrum(
    mesh: Mesh,
    number_of_eigenvectors: int = NUMBER_OF_EIGENVECTORS,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
) -> Spectrum:
    """Compute the spectrum of a mesh: the first k eigenpairs of its Laplacian, and its vertex areas.

    The mesh is scaled to area 1, so the unit of length has no effect. The computation uses float64 on the CPU
    and fixed random seeds, so the same mesh gives the same spectrum. The sign of each eigenvector is chosen
    so that its entry of largest absolute value is positive. The eigenpairs of each connected component are
    computed separately and then merged. Results are cached on disk (`jaxsmw.runtime.cache`).

    The exact solver is a shift-invert Lanczos method. The number of eigenvalues, the residuals and the
    orthonormality are checked. If the Lanczos method fails, ARPACK computes the eigenpairs.

    The approximate solver is the Rayleigh–Ritz method in a smooth subspace of far fewer dimensions
    (`jaxsmw.geometry.coarsening`). Its time is nearly proportional to the number of vertices. Its
    eigenvectors are also orthonormal. If the sizes or shapes of the triangles differ too much, the function
    issues a `RuntimeWarning` and uses the exact solver.

    **Arguments:**

    - `mesh`: the surface with n vertices, a `Mesh`.
    - `number_of_eigenvectors`: the number k of eigenvectors, at least 1 and less than the number of
      referenced vertices.
    - `laplacian`: the discretization of the Laplacian. `"cotangent"` means linear finite elements with
      barycentric vertex areas. `"robust"` is the tufted intrinsic Delaunay Laplacian (Sharp and Crane 2020),
      which also handles non-manifold and badly shaped meshes. `"auto"` is robust if a triangle is degenerate
      or an edge has more than two faces, else cotangent.
    - `eigensolver`: `"exact"`, `"approximate"`, or `"auto"`, which is approximate if the mesh has at least 50
      000 referenced vertices. Connected components with fewer than 400 vertices, or fewer than 30 vertices
      per eigenvector, are always solved exactly.

    **Returns:** A `Spectrum` with positions and normals, without descriptors, in units in which the area is
    1. The float type is JAX's default (float32 unless `jax_enable_x64` is set). Unreferenced vertices are
    masked.

    **Raises:** `InputError` if k is not an integer in its range, if the Laplacian or the eigensolver is
    unknown, if faces without area make the cotangent Laplacian undefined, or if the eigenproblem cannot be
    solved accurately. `TypeError` if `mesh` is not a `Mesh`.
    """

    import jax

    pairs = eigenpairs(mesh, number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver)
    return jax.device_put(as_spectrum(mesh, *pairs))


def as_spectrum(
    mesh: Mesh,
    eigenvalues: Float64[np.ndarray, " k"],
    eigenvectors: Float64[np.ndarray, "n k"],
    vertex_areas: Float64[np.ndarray, " n"],
    *,
    dtype: type[np.floating] | None = None,
) -> Spectrum:
    """Return the `eigenpairs` of a mesh as a `Spectrum` of NumPy arrays, by default of JAX's float type."""
    referenced = mesh.referenced_vertices
    # Positions are relative to the centroid. In single precision, absolute positions of a mesh far from the
    # origin would be inaccurate.
    centered = mesh.vertices - mesh.average(mesh.vertices)
    positions = np.where(referenced[:, None], centered / np.sqrt(mesh.area), 0)
    normals = -mesh.vertex_normals if mesh.is_inside_out else mesh.vertex_normals
    dtype = dtype or float_type()
    numbers = eigenvalues, eigenvectors, vertex_areas, positions, normals
    values, vectors, areas, *directions = (array.astype(dtype) for array in numbers)
    return Spectrum(values, vectors, areas, referenced).with_positions(*directions)


def eigenpairs(
    mesh: Mesh,
    number_of_eigenvectors: int,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, "n k"], Float64[np.ndarray, " n"]]:
    """Compute the eigenpairs and the vertex areas of a mesh in float64; see `compute_spectrum`.

    **Returns:** Eigenvalues (k,), eigenvectors (n, k) and vertex areas (n,), in units in which the area is 1.
    """
    check_kind("mesh", mesh, Mesh)
    check_number_of_eigenvectors(mesh, number_of_eigenvectors)
    check_choice(eigensolver, Eigensolver, "an eigensolver")
    check_choice(laplacian, Laplacian, "a Laplacian")
    if laplacian == "auto":
        laplacian = choose_laplacian(mesh)
    if eigensolver == "auto":
        eigensolver = choose_eigensolver(mesh)

    def compute() -> dict[str, np.ndarray]:
        stiffness, areas = assemble_laplacian(mesh, laplacian=laplacian)
        areas = areas / areas.sum()
        values, vectors = solve_on_surface(mesh, stiffness, areas, number_of_eigenvectors, eigensolver)
        return {"eigenvalues": values, "eigenvectors": vectors, "vertex_areas": areas}

    inputs = mesh.vertices, mesh.faces, number_of_eigenvectors, laplacian, eigensolver
    result = cached("spectrum", inputs, compute)
    return result["eigenvalues"], result["eigenvectors"], result["vertex_areas"]


def check_number_of_eigenvectors(mesh: Mesh, number: int) -> None:
    """Refuse a number that `compute_spectrum` would refuse."""
    if not isinstance(number, int | np.integer):
        raise InputError(f"{mesh.name}: the number of eigenvectors is {number!r}: give an integer.")
    referenced = len(mesh.referenced_indices)
    if not 1 <= number < referenced:
        raise InputError(
            f"{mesh.name}: cannot compute {number} eigenvectors from {referenced} referenced vertices: "
            f"choose a number from 1 to {referenced - 1}, or use a finer mesh."
        )


def solve_on_surface(
    mesh: Mesh,
    stiffness: sp.csc_matrix,
    areas: Float64[np.ndarray, " n"],
    number: int,
    eigensolver: Eigensolver = "exact",
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, "n k"]]:
    """Compute the k smallest eigenpairs of a stiffness matrix (n, n) and vertex areas (n,) of a mesh.

    The unit is the unit of the areas. The rest is as in `compute_spectrum`.
    """
    used = mesh.referenced_indices
    if len(used) < len(areas):
        stiffness, areas = stiffness[used][:, used], areas[used]
    with one_blas_thread():
        values, vectors = _solve(stiffness, areas, number, eigensolver, mesh.name)
    # Signs are changed in place, because another copy of the eigenvectors of a large mesh may not fit into
    # memory.
    vectors *= np.where(vectors.max(axis=0) < -vectors.min(axis=0), -1, 1)
    return values, mesh.spread(vectors)


def choose_eigensolver(*meshes: Mesh) -> Literal["exact", "approximate"]:
    """Choose the eigensolver that `"auto"` stands for if the spectra of the meshes will be compared."""
    most = max(len(mesh.referenced_indices) for mesh in meshes)
    return "exact" if most < APPROXIMATE_FROM else "approximate"


def _solve(
    stiffness: sp.csc_matrix, areas: np.ndarray, k: int, eigensolver: Eigensolver, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the k smallest eigenpairs of a mesh that may have several connected components."""
    number_of_components, component = csgraph.connected_components(stiffness, directed=False)
    if number_of_components == 1:
        return _solve_component(stiffness, areas, k, eigensolver, name)
    values, members, vectors = [], [], []
    for label in range(number_of_components):
        vertices = np.flatnonzero(component == label)
        block = stiffness[vertices][:, vertices]
        block_values, block_vectors = _solve_component(
            block, areas[vertices], min(k, len(vertices)), eigensolver, name
        )
        values.append(block_values)
        vectors.append(block_vectors)
        members.append(vertices)
    origin = np.repeat(np.arange(number_of_components), [len(v) for v in values])
    column = np.concatenate([np.arange(len(v)) for v in values])
    smallest = np.argsort(np.concatenate(values), kind="stable")[:k]
    eigenvectors = np.zeros((len(areas), k))
    for position, index in enumerate(smallest):
        eigenvectors[members[origin[index]], position] = vectors[origin[index]][:, column[index]]
    return np.concatenate(values)[smallest], eigenvectors


def _solve_component(
    stiffness: sp.csc_matrix, areas: np.ndarray, k: int, eigensolver: Eigensolver, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the k smallest eigenpairs of one connected component, and check their accuracy."""
    n = len(areas)
    # Renumbering stores neighbouring vertices close to each other, which suits the processor's cache. Without
    # renumbering, the factorization's fill-reducing ordering is several times worse on some meshes, such as
    # subdivided meshes.
    order = csgraph.reverse_cuthill_mckee(stiffness, symmetric_mode=True)
    stiffness, areas = stiffness[order][:, order], areas[order]
    mass = sp.diags(areas).tocsc()
    solvers = [_dense] if n <= _DENSE or 3 * k > n else [_lanczos, _arpack]
    if eigensolver == "approximate" and n >= max(_DENSE, _DIMENSIONS_OF_SUBSPACE * k):
        solvers.insert(0, _approximate)
    for solver in solvers:
        try:
            eigenvalues, eigenvectors = solver(stiffness, mass, k)
        except (ArpackError, RuntimeError, np.linalg.LinAlgError) as error:
            failure = str(error).splitlines()[0]
        else:
            residual, deviation = _errors(stiffness, areas, eigenvalues, eigenvectors)
            accurate = solver is _approximate or residual <= _RESIDUAL_TOLERANCE
            if accurate and deviation <= _ORTHONORMALITY_TOLERANCE:
                # The first eigenvalue of a connected surface is zero, apart from rounding.
                eigenvalues = np.maximum(eigenvalues, 0)
                eigenvalues[0] = 0
                return eigenvalues, eigenvectors[np.argsort(order)]
            failure = f"relative residual {residual:.1e}, deviation from orthonormality {deviation:.1e}"
        if solver is _approximate:
            warnings.warn(
                f"{name}: eigenvectors cannot be approximated ({failure}) and are computed exactly: remesh "
                "the surface evenly if the exact computation takes too long.",
                RuntimeWarning,
                stacklevel=2,
            )
    raise InputError(
        f"{name}: the first {k} eigenvectors could not be computed accurately ({failure}), probably because "
        "of badly shaped triangles: try the robust Laplacian (laplacian='robust'), fewer eigenvectors, or a "
        "remeshed surface."
    )


def _dense(stiffness: sp.csc_matrix, mass: sp.csc_matrix, k: int) -> tuple[np.ndarray, np.ndarray]:
    scale = 1 / np.sqrt(mass.diagonal())
    symmetric = scale[:, None] * stiffness.toarray() * scale
    eigenvalues, eigenvectors = scipy.linalg.eigh((symmetric + symmetric.T) / 2, subset_by_index=(0, k - 1))
    return eigenvalues, scale[:, None] * eigenvectors


def _factorized(stiffness: sp.csc_matrix, mass: sp.csc_matrix, shift: float) -> SuperLU:
    """Return the LU factors of W - shift A."""
    # Without symmetric mode, the ordering `MMD_AT_PLUS_A` makes the factorization orders of magnitude slower.
    return splu(
        (stiffness - shift * mass).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _number_below(factors: SuperLU) -> int:
    """Return the number of eigenvalues below the shift: by Sylvester's law, the number of negative pivots."""
    return int((factors.U.diagonal() < 0).sum())


def _factorized_midway(stiffness: sp.csc_matrix, mass: sp.csc_matrix, k: int) -> tuple[float, SuperLU]:
    """Return a shift with about k/2 eigenvalues below it, and the LU factors of W - shift A."""
    # Weyl's law gives the first trial shift. On a thin tube, for example, it is far off and corrected.
    following = 2 * np.pi * k / mass.sum()
    for _ in range(4):
        shift = following
        inverse = _factorized(stiffness, mass, shift)
        below = _number_below(inverse)
        if 0.3 * k - 1 <= below <= 0.7 * k + 1:
            break
        following = shift * float(np.clip(0.5 * k / max(below, 1), 0.1, 10))
    return shift, inverse


def _misses_some(stiffness: sp.csc_matrix, mass: sp.csc_matrix, eigenvalues: np.ndarray) -> bool:
    """Return whether an eigenvalue below the largest given one, and not equal to it, is missing."""
    if len(eigenvalues) == 1:
        return False
    shift = float(eigenvalues[-1]) * (1 - 1e-6)
    return _number_below(_factorized(stiffness, mass, shift)) != int((eigenvalues < shift).sum())


def _lanczos(
    stiffness: sp.csc_matrix, mass: sp.csc_matrix, k: int, *, tolerance: float = 1e-10
) -> tuple[np.ndarray, np.ndarray]:
    """Return the k smallest eigenpairs by block Lanczos iterations of (W - shift A)^-1 A, never restarted."""
    # This method stays because it takes 5 to 7 times less time than a tuned `scipy.sparse.linalg.eigsh`. The
    # shift is in the middle of the wanted eigenvalues, so these are at both ends of the spectrum of the
    # inverse, where the method converges fastest: two products with the inverse per eigenpair suffice.
    # Keeping every vector A-orthogonal to all earlier vectors takes less time than ARPACK's restarts. Blocks
    # of b vectors find at most b copies of a multiple eigenvalue, so larger blocks follow if some are
    # missing.
    shift, inverse = _factorized_midway(stiffness, mass, k)
    for size in (_BLOCK, 2 * _BLOCK):
        eigenvalues, eigenvectors = _converged(inverse, shift, mass, k, size, tolerance)
        if not _misses_some(stiffness, mass, eigenvalues):
            return eigenvalues, eigenvectors
    raise RuntimeError("not all copies of a multiple eigenvalue were found")


def _converged(
    inverse: SuperLU, shift: float, mass: sp.csc_matrix, k: int, size: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first k eigenpairs, with residuals below `tolerance`, by blocks of `size` vectors."""
    n = mass.shape[0]
    diagonal = mass.diagonal() if mass.nnz == n else None

    def weighted(vectors: np.ndarray) -> np.ndarray:
        return vectors * diagonal if diagonal is not None else (mass @ vectors.T).T

    def images(vectors: np.ndarray) -> np.ndarray:
        return inverse.solve(weighted(vectors).T).T

    most = min(n - 1, 10 * k + 100)
    vectors = np.empty((2 * k + 100 + size, n))
    # The first eigenvector is constant.
    vectors[0] = 1 / np.sqrt(mass.sum())
    # The random initial block is smoothed. Otherwise, rounding errors would carry the roughness of
    # the block into the eigenvectors.
    block = np.random.default_rng(0).standard_normal((size, n))
    for _ in range(2):
        block = images(block)
        _remove(vectors[:1], block, weighted)
        block, _ = _orthonormal(block, weighted)
    projected = np.zeros((most + 1, most + 1))
    end, look = 1, k + k // 2
    while end + size <= most:
        if end + size > len(vectors):
            vectors = np.concatenate([vectors, np.empty_like(vectors)])
        before, start, end = max(0, end - size), end, end + size
        vectors[start:end] = block
        block = images(block)
        # The large overlaps with the last two blocks are removed first. The rounding errors of large overlaps
        # would hide the small overlaps with earlier blocks.
        large = _remove(vectors[before:end], block, weighted)
        overlaps = _remove(vectors[:end], block, weighted)
        overlaps[:, before:] += large
        projected[start:end, :end], projected[:end, start:end] = overlaps, overlaps.T
        block, left = _orthonormal(block, weighted)
        if end < look:
            continue
        # NumPy's `eigh` is used, because SciPy's `eigh` would hold Python's global lock.
        inverted, combinations = np.linalg.eigh(projected[1:end, 1:end])
        eigenvalues = shift + 1 / inverted
        # Rounding errors can change the sign of a number near zero in `inverted`. A very large eigenvalue
        # then becomes negative. Negative eigenvalues are therefore sorted last.
        wanted = np.argsort(np.where(eigenvalues > 0, eigenvalues, np.inf))[: k - 1]
        residuals = np.linalg.norm(left.T @ combinations[-size:, wanted], axis=0)
        residuals /= np.abs(inverted[wanted])
        if (residuals <= tolerance).all():
            eigenvectors = np.empty((k, n))
            eigenvectors[0] = vectors[0]
            np.matmul(combinations[:, wanted].T, vectors[1:end], out=eigenvectors[1:])
            return np.append(0.0, eigenvalues[wanted]), eigenvectors.T
        # At least about sqrt(k) / 2 more vectors are needed to reduce the residuals by a factor of 10.
        excess = np.fmin(residuals.max() / tolerance, 1e10)
        look = end + size + int(np.sqrt(k) / 2 * np.log10(excess))
    raise RuntimeError("the Lanczos method has not converged")


def _remove(
    known: Float64[np.ndarray, "j n"],
    vectors: Float64[np.ndarray, "b n"],
    weighted: Callable[[np.ndarray], np.ndarray],
) -> Float64[np.ndarray, "b j"]:
    """Make vectors A-orthogonal to known vectors in place. Return the removed overlaps."""
    overlaps = weighted(vectors) @ known.T
    vectors -= overlaps @ known
    return overlaps


def _orthonormal(
    vectors: Float64[np.ndarray, "b n"], weighted: Callable[[np.ndarray], np.ndarray]
) -> tuple[Float64[np.ndarray, "b n"], Float64[np.ndarray, "b b"]]:
    """Factor vectors V into L Q, with A-orthonormal Q and a lower triangular L. Return Q and L."""
    lower = np.eye(len(vectors))
    for _ in range(2):  # the second pass removes the rounding errors of the first pass
        factor = np.linalg.cholesky(weighted(vectors) @ vectors.T)
        vectors, lower = np.linalg.inv(factor) @ vectors, lower @ factor
    return vectors, lower


def _arpack(stiffness: sp.csc_matrix, mass: sp.csc_matrix, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the k smallest eigenpairs to machine precision, by ARPACK's Lanczos method with restarts."""
    n = stiffness.shape[0]
    inverse = LinearOperator((n, n), matvec=_factorized(stiffness, mass, _SHIFT).solve, dtype=float)
    start = np.random.default_rng(0).standard_normal(n)
    return eigsh(stiffness, k, mass, sigma=_SHIFT, OPinv=inverse, ncv=min(n, 3 * k + 50), tol=0, v0=start)


def _approximate(stiffness: sp.csc_matrix, mass: sp.csc_matrix, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the k smallest eigenpairs by the Rayleigh–Ritz method in a smoothed coarse subspace."""
    # More than k eigenvectors are computed, because the last ones of a subspace are the least accurate.
    # Missing eigenvalues are not detected: only the expensive LU factors of W - shift A would reveal them.
    taken = k + max(10, k // 10)
    coarse = coarsen(stiffness, mass, _DIMENSIONS_OF_SUBSPACE * taken)
    if coarse.stiffness.shape[0] < 3 * taken:
        raise RuntimeError(f"a subspace of {coarse.stiffness.shape[0]} dimensions is too small")
    try:
        _, combinations = _lanczos(coarse.stiffness, coarse.mass, taken, tolerance=1e-5)
    except RuntimeError:
        _, combinations = _arpack(coarse.stiffness, coarse.mass, taken)
    n, single = stiffness.shape[0], combinations.astype(np.float32)
    basis = np.empty((n, taken))
    grams = np.zeros((2, taken, taken))  # only the upper triangles of these matrices are filled
    for columns in _slices(taken):
        basis[:, columns] = coarse.smooth(coarse.prolongation @ single[:, columns])
        for gram, matrix in zip(grams, (stiffness, mass), strict=True):
            gram[: columns.stop, columns] = basis[:, : columns.stop].T @ (matrix @ basis[:, columns])
    eigenvalues, combinations = scipy.linalg.eigh(*grams, lower=False, subset_by_index=(0, k - 1))
    # The eigenvectors replace the basis, because both may not fit into memory.
    for start in range(0, n, _ROWS):
        rows = slice(start, start + _ROWS)
        basis[rows, :k] = basis[rows] @ combinations
    eigenvectors = basis[:, :k]
    # The last ten eigenvectors are checked, because they are the least accurate if all triangles are badly
    # shaped. Every third eigenvector is also checked, because any eigenvector can be the least accurate if
    # only one region has badly shaped triangles.
    looked_at = np.union1d(np.arange(1, k, 3), np.arange(max(1, k - 10), k))
    lowered = 0.0
    for columns in _slices(len(looked_at)):
        checked = looked_at[columns]
        smoother = coarse.smooth(eigenvectors[:, checked]).astype(float)
        norms, energies = (np.einsum("nk,nk->k", smoother, matrix @ smoother) for matrix in (mass, stiffness))
        lowered = max(lowered, (eigenvalues[checked] * norms / energies - 1).max())
    if lowered > _MOST_LOWERED:
        raise RuntimeError(f"eigenvalues would be wrong by {lowered:.0%} or more")
    return eigenvalues, eigenvectors


def _slices(number: int) -> Iterator[slice]:
    """Return slices of at most 32 columns, because copies of more columns may not fit into memory."""
    return (slice(start, min(start + 32, number)) for start in range(0, number, 32))


def _errors(
    stiffness: sp.csc_matrix, areas: np.ndarray, eigenvalues: np.ndarray, eigenvectors: np.ndarray
) -> tuple[float, float]:
    """Return the largest |A^-1 W phi - lambda phi|_A / lambda_max and entry of |Phi^T A Phi - I|."""
    deviation, highest = 0.0, 0.0
    for columns in _slices(len(eigenvalues)):
        weighted = areas[:, None] * eigenvectors[:, columns]
        gram = eigenvectors[:, : columns.stop].T @ weighted  # the matrix is symmetric
        gram[columns] -= np.eye(gram.shape[1])
        residuals = stiffness @ eigenvectors[:, columns] - weighted * eigenvalues[columns]
        squares = np.sum(residuals**2 / areas[:, None], axis=0)
        # Unlike `max`, `np.maximum` returns NaN if one of the numbers is NaN.
        deviation, highest = np.maximum(deviation, np.abs(gram).max()), np.maximum(highest, squares.max())
    # The maximum with 1 avoids a division by zero, for example if k = 1.
    return float(np.sqrt(highest) / max(eigenvalues.max(), 1.0)), float(deviation)
