"""Matrix products and factorisations of JAX arrays; `jaxsmw.core.linear_algebra` describes the functions.

All factorisations work under `jax.vmap`, also nested, and all of them have derivatives of both modes and of
any order.
"""

from functools import partial

import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jax import lax
from jaxtyping import Array, Float

from jaxsmw.core.traced_batches import in_loop

# By default, GPUs multiply float32 matrices in lower precision. Distances would then lose digits, and
# rounding errors could hide that a linear system is singular.
product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)


# On CPUs, LAPACK calls of jaxlib 0.10 divide a batch among the threads of XLA's pool and wait for them
# (`jax::ParallelBatchMap`). If each thread of the pool waits in such a call, none is left to do the work.
_one_by_one = partial(in_loop, on_all_devices=False)
# These functions have no derivatives. `_cholesky` reads only the lower triangle.
_cholesky = _one_by_one(lambda matrix: lax.linalg.cholesky(matrix, symmetrize_input=False))
_solve_lower = _one_by_one(lambda factor, right: jsp.linalg.solve_triangular(factor, right, lower=True))
_solve_lower_transposed = _one_by_one(
    lambda factor, right: jsp.linalg.solve_triangular(factor, right, lower=True, trans="T")
)
_svd = _one_by_one(lambda matrix: tuple(jnp.linalg.svd(matrix, full_matrices=False)))
_eigenvalues = _one_by_one(lambda matrix: jnp.linalg.eigvalsh(matrix))
_eigenpairs = _one_by_one(lambda matrix: tuple(jnp.linalg.eigh(matrix)))


def solve_lower(factor: Float[Array, "k k"], right: Float[Array, "k c"]) -> Float[Array, "k c"]:
    return lax.custom_linear_solve(
        partial(product, jnp.tril(factor)),
        right,
        lambda _, right: _solve_lower(lax.stop_gradient(factor), right),
        lambda _, right: _solve_lower_transposed(lax.stop_gradient(factor), right),
    )


@jax.custom_jvp
def cholesky(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    return _cholesky((matrix + matrix.T) / 2)


@cholesky.defjvp
def _cholesky_derivative(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
    # Murray 2016, "Differentiation of the Cholesky decomposition".
    factor = cholesky(*primals)
    (change,) = tangents
    inside = solve_lower(factor, solve_lower(factor, (change + change.T) / 2).T)
    lower = jnp.tril(inside) - jnp.diag(jnp.diagonal(inside)) / 2
    return factor, product(factor, lower)


def solve_positive_definite(
    matrix: Float[Array, "k k"], right: Float[Array, "k c"], factor: Float[Array, "k k"] | None = None
) -> Float[Array, "k c"]:
    factor = _cholesky(lax.stop_gradient(matrix).T) if factor is None else lax.stop_gradient(factor)
    return lax.custom_linear_solve(
        partial(product, matrix),
        right,
        lambda _, right: _solve_lower_transposed(factor, _solve_lower(factor, right)),
        symmetric=True,
    )


@jax.custom_jvp
def symmetric_eigenvalues(matrix: Float[Array, "k k"]) -> Float[Array, " k"]:
    return _eigenvalues(matrix)


@symmetric_eigenvalues.defjvp
def _derivative_of_eigenvalues(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    values, vectors = _eigenpairs(*primals)
    return values, jnp.sum(vectors * product(tangents[0], vectors), axis=0)


@jax.custom_jvp
def nearest_orthogonal(matrix: Float[Array, "k l"]) -> Float[Array, "k l"]:
    left, _, right = _svd(matrix)
    return product(left, right)


@nearest_orthogonal.defjvp
def _derivative_of_nearest_orthogonal(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Float[Array, "k l"], Float[Array, "k l"]]:
    nearest = nearest_orthogonal(*primals)
    wide = nearest.shape[0] < nearest.shape[1]
    matrix, tall, change = (part.T if wide else part for part in (*primals, nearest, *tangents))
    # The matrix is `tall stretch`. A change turns the columns of `tall` within their space, by a skew matrix
    # that solves a Sylvester equation, and tilts them out of this space.
    stretch, inside = product(tall.T, matrix), product(tall.T, change)
    _, sizes, right = _svd(lax.stop_gradient(matrix))

    def solve(_: object, skew: Float[Array, "l l"]) -> Float[Array, "l l"]:
        rotated = product(product(right, skew), right.T) / (sizes[:, None] + sizes[None, :])
        return product(product(right.T, rotated), right)

    turn = lax.custom_linear_solve(
        lambda turn: product(turn, stretch) + product(stretch, turn), inside - inside.T, solve, symmetric=True
    )
    derivative = product(tall, turn)
    if tall.shape[0] > tall.shape[1]:
        outside = change - product(tall, inside)
        derivative += solve_positive_definite(stretch, outside.T).T
    return nearest, derivative.T if wide else derivative
