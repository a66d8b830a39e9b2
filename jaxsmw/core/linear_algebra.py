"""Matrix products and factorisations, which the whole core takes from here.

All factorisations of JAX arrays work under `jax.vmap`, also nested, and all of them have derivatives of both
modes and of any order. If a factorisation fails, the result is NaN.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from jaxsmw.core.arrays import Array, is_traced, namespace, stop_gradient


def _traced() -> Any:
    from jaxsmw.core import traced_linear_algebra

    return traced_linear_algebra


def _or_traced(compute: Callable[..., Array]) -> Callable[..., Array]:
    """Decorate the version for NumPy of a function of `traced_linear_algebra`, to which JAX arrays go."""

    @functools.wraps(compute)
    def choose(*matrices: Array) -> Array:
        if is_traced(*matrices):
            return getattr(_traced(), compute.__name__)(*matrices)
        try:
            return compute(*matrices)
        except np.linalg.LinAlgError:
            return np.full_like(matrices[min(1, len(matrices) - 1)], np.nan)

    return choose


@_or_traced
def product(a: Float[Array, "*a"], b: Float[Array, "*b"]) -> Float[Array, "*product"]:
    """Return the matrix product, in full precision also on accelerators."""
    return np.matmul(a, b)


@_or_traced
def solve_lower(factor: Float[Array, "k k"], right: Float[Array, "k c"]) -> Float[Array, "k c"]:
    """Return `factor^-1 right` for a lower triangular matrix `factor`."""
    return scipy.linalg.solve_triangular(factor, right, lower=True, check_finite=False)


@_or_traced
def cholesky(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """Return the lower Cholesky factor of a positive definite matrix, or NaN if there is none."""
    return scipy.linalg.cholesky((matrix + matrix.T) / 2, lower=True, check_finite=False)


@_or_traced
def solve_positive_definite(
    matrix: Float[Array, "k k"], right: Float[Array, "k c"], factor: Float[Array, "k k"] | None = None
) -> Float[Array, "k c"]:
    """Return `matrix^-1 right` for a positive definite matrix, by its Cholesky factor if it is known."""
    factors = scipy.linalg.cho_factor(matrix, check_finite=False) if factor is None else (factor, True)
    return scipy.linalg.cho_solve(factors, right, check_finite=False)


@_or_traced
def symmetric_eigenvalues(matrix: Float[Array, "k k"]) -> Float[Array, " k"]:
    """Return the eigenvalues of a symmetric matrix in ascending order."""
    return np.linalg.eigvalsh(matrix) if np.isfinite(matrix).all() else np.full_like(matrix[0], np.nan)


@_or_traced
def nearest_orthogonal(matrix: Float[Array, "k l"]) -> Float[Array, "k l"]:
    """Return the nearest matrix with orthonormal columns, or with orthonormal rows if k is below l."""
    left, _, right = np.linalg.svd(matrix, full_matrices=False)
    return left @ right


def rounding(matrix: Float[Array, "k k"]) -> Float[Array, ""]:
    """Return an estimate of the rounding error of a Gram matrix: k times its largest entry times epsilon."""
    xp = namespace(matrix)
    relative = matrix.shape[0] * xp.finfo(matrix.dtype).eps
    return xp.max(xp.diagonal(matrix)) * xp.asarray(relative, matrix.dtype)


def is_regular(matrix: Float[Array, "k k"], factor: Float[Array, "k k"] | None = None) -> Bool[Array, ""]:
    """Return whether a Gram matrix, of which the `cholesky` factor may be known, is non-singular.

    The matrix counts as singular if a pivot of the factor is as small as the rounding error.
    """
    xp = namespace(matrix)
    factor = cholesky(stop_gradient(matrix)) if factor is None else factor
    # If a pivot is negative, the factor contains NaN, and the comparison below is False.
    return xp.min(xp.diagonal(factor) ** 2) > rounding(matrix)


def regularized(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """Add the rounding error to the diagonal of a singular Gram matrix; return a regular one unchanged."""
    xp = namespace(matrix)
    error = xp.where(is_regular(matrix), 0, stop_gradient(rounding(matrix)))
    return matrix + error * xp.eye(matrix.shape[0], dtype=matrix.dtype)
