"""Soft maps: what a point corresponds to, spread over several, so that it can be differentiated.

A `Recovery` makes one of two point sets: `Softmax` by distances alone, `NearestFew` among the nearest only,
`Sinkhorn` so that every point gives and takes its share.
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.core.checks import as_parameter, check_between
from jaxsmw.core.products import product
from jaxsmw.core.search import in_blocks, nearest_neighbor

# Queries whose distances to all database rows are had at once.
_BLOCK = 128


class SoftMap(eqx.Module):
    """A transport plan between two point sets: how much of each query's area goes to each database row.

    `P_ij = a_i b_j exp(g_j - |q_i - y_j|² / temperature) / (the same without a_i, summed over j)`, never
    stored as a whole. Its rows sum to the queries' areas exactly, its columns to the database's as far as
    `residual` says.

    **Attributes:**

    - `queries`, `database`: the points q (m, d) and y (n, d), up to a common shift.
    - `query_areas`, `database_areas`: a (m,) and b (n,), of sum 1; zero for points that do not count. A query
      of zero area gets what any other in its place would get.
    - `potentials`: g (n,), without unit: the higher, the more a row is sought after; 0 for rows of zero area.
    - `temperature`: in the points' squared unit.
    - `residual`: the share of the area, from 0 to 1, that arrives where there is too much already; NaN where
      nobody looked (`Softmax`).
    - `converged`: whether that is at most the tolerance; False if a number went wrong, or nobody looked.
    - `iterations`: how many were done.
    """

    queries: Float[Array, "m d"]
    database: Float[Array, "n d"]
    query_areas: Float[Array, " m"]
    database_areas: Float[Array, " n"]
    potentials: Float[Array, " n"]
    temperature: Float[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]
    iterations: Int32[Array, ""]

    @eqx.filter_jit
    def pull_back(self, functions_on_y: Float[Array | np.ndarray, "n p"]) -> Float[Array, "m p"]:
        """The mean of functions over where each query's area goes; of positions, for example, or colours."""
        functions = jnp.asarray(functions_on_y, self.database.dtype)
        if functions.ndim != 2 or functions.shape[0] != self.database.shape[0]:
            raise ValueError(
                f"functions on Y have shape {functions.shape}, where ({self.database.shape[0]}, p) is needed"
            )
        weights = _log(self.database_areas) + self.potentials

        def mean(block: Float[Array, "block d"]) -> Float[Array, "block p"]:
            log_shares = _log_kernel(self.database, block, self.temperature) + weights[:, None]
            return product(jax.nn.softmax(log_shares, axis=0).T, functions)

        return in_blocks(jax.checkpoint(mean), self.queries, _BLOCK)

    @eqx.filter_jit
    def pointwise_map(self) -> Int32[Array, " m"]:
        """The likeliest database row of each query: the one that gets most of it per area.

        (The one that gets most in all would be, between neighbours, the one of the larger area.)
        """
        everywhere = jnp.where(self.database_areas > 0, self.potentials, -jnp.inf)

        def likeliest(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
            densities = _log_kernel(self.database, block, self.temperature) + everywhere[:, None]
            return jnp.argmax(densities, axis=0).astype(jnp.int32)

        return in_blocks(likeliest, self.queries, _BLOCK)


class SparseSoftMap(eqx.Module):
    """A soft map of which few database rows are known for each query.

    **Attributes:**

    - `rows`: (m, t), the nearest first.
    - `shares`: (m, t), of sum 1.
    """

    rows: Int32[Array, "m t"]
    shares: Float[Array, "m t"]

    def pull_back(self, functions_on_y: Float[Array | np.ndarray, "n p"]) -> Float[Array, "m p"]:
        """The mean of functions over each query's rows."""
        functions = jnp.asarray(functions_on_y, self.shares.dtype)
        if functions.ndim != 2:
            raise ValueError(f"functions on Y have shape {functions.shape}, where (n, p) is needed")
        # One after the other, as all of them take t times the memory.
        taken = zip(self.rows.T, self.shares.T, strict=True)
        return sum((share[:, None] * functions[row] for row, share in taken), jnp.zeros((), functions.dtype))

    def pointwise_map(self) -> Int32[Array, " m"]:
        """The nearest database row of each query."""
        return self.rows[:, 0]


PointwiseMap = Int[Array, " m"] | SoftMap | SparseSoftMap
"""T: X -> Y, one vertex of Y for each of X, or a soft map from X to Y."""


def pull_back(pointwise_map: PointwiseMap, functions_on_y: Float[Array, "n p"]) -> Float[Array, "m p"]:
    """Functions on Y as functions on X: `P f`, P of size m x n never being stored."""
    if isinstance(pointwise_map, (SoftMap, SparseSoftMap)):
        return pointwise_map.pull_back(functions_on_y)
    return functions_on_y[pointwise_map]


class Recovery(eqx.Module):
    """How a soft map follows from the distances between two point sets."""

    @abc.abstractmethod
    def __call__(
        self,
        queries: Float[Array, "m d"],
        database: Float[Array, "n d"],
        query_areas: Float[Array, " m"],
        database_areas: Float[Array, " n"],
    ) -> SoftMap | SparseSoftMap:
        """The soft map from the queries to the database; rows of zero area get nothing."""


class Softmax(Recovery):
    """Each row gets of a query what its area times `exp(-distance² / temperature)` is among all rows'.

    **Arguments:**

    - `temperature`: positive, in the units of `sinkhorn`.
    """

    temperature: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.1)

    def __check_init__(self) -> None:
        check_between(self, "temperature", self.temperature)

    def __call__(
        self,
        queries: Float[Array, "m d"],
        database: Float[Array, "n d"],
        query_areas: Float[Array, " m"],
        database_areas: Float[Array, " n"],
    ) -> SoftMap:
        """See `Recovery`."""
        queries, database, a, b, scale = _prepared(
            queries, database, query_areas, database_areas, self.temperature
        )
        return SoftMap(
            queries,
            database,
            a,
            b,
            jnp.zeros_like(b),
            scale,
            jnp.asarray(jnp.nan, b.dtype),
            jnp.asarray(False),
            jnp.asarray(0, jnp.int32),
        )


class NearestFew(Recovery):
    """`Softmax` among the nearest rows alone; which ones these are is not differentiated.

    Fast in float32; in float64 sorting takes most of the time on CPUs.

    **Arguments:**

    - `number`: how many; if there are fewer of positive area, a query's other shares are zero.
    - `temperature`: positive, in the units of `sinkhorn`.
    """

    number: int = eqx.field(static=True, default=10)
    temperature: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.1)

    def __check_init__(self) -> None:
        check_between(self, "temperature", self.temperature)
        if self.number < 1:
            raise ValueError(f"NearestFew needs at least 1 row, not {self.number}")

    def __call__(
        self,
        queries: Float[Array, "m d"],
        database: Float[Array, "n d"],
        query_areas: Float[Array, " m"],
        database_areas: Float[Array, " n"],
    ) -> SparseSoftMap:
        """See `Recovery`."""
        queries, database, _, b, scale = _prepared(
            queries, database, query_areas, database_areas, self.temperature
        )
        settled_queries, settled = lax.stop_gradient((queries, database))
        unit = jnp.asarray(1, queries.dtype)

        def nearest(block: Float[Array, "block d"]) -> Int32[Array, "block t"]:
            closeness = jnp.where((b > 0)[:, None], _log_kernel(settled, block, unit), -jnp.inf)
            return lax.top_k(closeness.T, min(self.number, b.shape[0]))[1]

        rows = in_blocks(nearest, settled_queries, _BLOCK)
        # One after the other, as all differences take t times the memory.
        squares = [jnp.sum((queries - database[row]) ** 2, axis=1) for row in rows.T]
        exponents = -jnp.stack(squares, axis=1) / scale
        return SparseSoftMap(rows, jax.nn.softmax(exponents + _log(b)[rows], axis=1))


class Sinkhorn(Recovery):
    """Soft maps by `sinkhorn`: every row gets its share.

    **Arguments:**

    - `temperature`: positive, in the units of `sinkhorn`.
    - `iterations`, `tolerance`: see there.
    """

    temperature: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.1)
    iterations: int = eqx.field(static=True, default=10)
    tolerance: float = eqx.field(static=True, default=0.01)

    def __check_init__(self) -> None:
        check_between(self, "temperature", self.temperature)
        if self.iterations < 1 or not self.tolerance > 0:
            raise ValueError(
                f"Sinkhorn needs at least 1 iteration and a positive tolerance, not {self.iterations} and "
                f"{self.tolerance}"
            )

    def __call__(
        self,
        queries: Float[Array, "m d"],
        database: Float[Array, "n d"],
        query_areas: Float[Array, " m"],
        database_areas: Float[Array, " n"],
    ) -> SoftMap:
        """See `Recovery`."""
        return sinkhorn(
            queries,
            database,
            query_areas=query_areas,
            database_areas=database_areas,
            temperature=self.temperature,
            iterations=self.iterations,
            tolerance=self.tolerance,
        )


def sinkhorn(
    queries: Float[Array | np.ndarray, "m d"],
    database: Float[Array | np.ndarray, "n d"],
    *,
    query_areas: Float[Array | np.ndarray, " m"],
    database_areas: Float[Array | np.ndarray, " n"],
    temperature: float | Float[Array, ""] = 0.3,
    iterations: int = 200,
    tolerance: float | Float[Array, ""] = 0.01,
) -> SoftMap:
    """The entropy-regularised optimal transport between two point sets, by Sinkhorn's iterations.

    Cuturi, "Sinkhorn distances: lightspeed computation of optimal transport", NeurIPS 2013: of all plans that
    spread the queries' areas over the database's the one of least mean squared distance, less `temperature`
    times entropy. Where nearest neighbours crowd on some rows and leave out others, here each gets its share.
    What is iterated on is the logarithm of Sinkhorn's factors, and distances are computed anew in every
    iteration, in blocks of queries: nothing of size m x n is ever stored, nor for derivatives, which go
    through all iterations.

    **Arguments:**

    - `queries`, `database`: points in d dimensions.
    - `query_areas`, `database_areas`: in any unit: both sides are scaled to sum 1. A point of zero area
      gives and takes nothing, and changes nothing for others.
    - `temperature`: positive, in units of the area-weighted mean squared distance from queries to their
      nearest database rows; if that is less than `sqrt(eps)` times the mean square of the queries about
      their mean, eps being the float type's, in units of this. The lower, the sharper, the more iterations;
      below the rounding errors of squared distances, eps times that mean square, nothing becomes sharper: it
      is as if it were so much, and has no derivative but zero.
    - `iterations`: at most so many; those after convergence are skipped (not under `vmap`, where they do
      nothing).
    - `tolerance`: on `SoftMap.residual`.

    **Returns:** A `SoftMap`. Nothing is raised for bad numbers or want of iterations: see its `converged`.

    **Raises:** `ValueError` for fewer than one iteration.
    """
    if iterations < 1:
        raise ValueError(f"sinkhorn needs at least 1 iteration, not {iterations}")
    queries, database, query_areas, database_areas = map(
        jnp.asarray, (queries, database, query_areas, database_areas)
    )
    queries, database, a, b, scale = _prepared(
        queries, database, query_areas, database_areas, jnp.asarray(temperature)
    )
    dtype, (m, d) = queries.dtype, queries.shape
    log_b, rest = _log(b), -m % _BLOCK
    blocks = (
        jnp.pad(queries, ((0, rest), (0, 0))).reshape(-1, _BLOCK, d),
        jnp.pad(a, (0, rest)).reshape(-1, _BLOCK),
    )

    def turn(potentials: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """The potentials that follow, and the residual of those given."""

        def add(arrived: Float[Array, " n"], block: tuple[Array, Array]) -> tuple[Float[Array, " n"], None]:
            log_shares = _log_kernel(database, block[0], scale) + (log_b + potentials)[:, None]
            return arrived + product(jax.nn.softmax(log_shares, axis=0), block[1]), None

        arrived, _ = lax.scan(jax.checkpoint(add), jnp.zeros_like(b), blocks)
        # What arrives can be too little to tell from nothing; then the potential rises in several turns.
        least = jnp.finfo(dtype).tiny
        wanting = jnp.where(b > 0, log_b - jnp.log(jnp.maximum(arrived, least)), 0)
        return potentials + wanting, jnp.sum(jnp.abs(arrived - b)) / 2

    def step(state: _State, _: None) -> tuple[_State, None]:
        def go_on() -> _State:
            _, potentials, _, done = state
            following, residual = jax.checkpoint(turn)(potentials)
            return potentials, following, residual, done + 1

        return lax.cond(state[2] <= tolerance, lambda: state, go_on), None

    zeros = jnp.zeros_like(b)
    start = zeros, zeros, jnp.asarray(jnp.inf, dtype), jnp.asarray(0, jnp.int32)
    (potentials, _, residual, done), _ = lax.scan(step, start, None, length=iterations)
    return SoftMap(queries, database, a, b, potentials, scale, residual, residual <= tolerance, done)


_State = tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, ""], Int32[Array, ""]]
"""Potentials, those that follow, the residual of the former, and how many iterations were done."""


def _log(areas: Float[Array, " n"]) -> Float[Array, " n"]:
    """Logarithms; -inf for zero, without the infinite derivative."""
    return jnp.where(areas > 0, jnp.log(jnp.where(areas > 0, areas, 1)), -jnp.inf)


def _log_kernel(
    database: Float[Array, "n d"], block: Float[Array, "block d"], temperature: Float[Array, ""]
) -> Float[Array, "n block"]:
    """Squared distances, negative, in units of temperature, up to a constant of each query.

    Queries last, as sums over the database then run over them side by side, in half the time.
    """
    return (2 * product(database, block.T) - jnp.sum(database**2, axis=1)[:, None]) / temperature


def _prepared(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    query_areas: Float[Array, " m"],
    database_areas: Float[Array, " n"],
    temperature: Float[Array, ""],
) -> tuple[
    Float[Array, "m d"], Float[Array, "n d"], Float[Array, " m"], Float[Array, " n"], Float[Array, ""]
]:
    """What every recovery computes with.

    Points about their centre, so that squares of coordinates do not drown distances; areas of sum 1; and the
    temperature in the points' squared unit, from one in units of the mean squared nearest distance. NaN if it
    is not positive, as steps of training may make it: then so is what follows. Not below what squared
    distances are rounded by: exponents would be nothing but rounding errors, and derivatives overflow.
    """
    a, b = query_areas / jnp.sum(query_areas), database_areas / jnp.sum(database_areas)
    center = lax.stop_gradient(product(b[None, :], database))
    queries, database = queries - center, database - center
    found = nearest_neighbor(*lax.stop_gradient((queries, database)), database_mask=b > 0)
    spread = jnp.sum(a * jnp.sum((queries - product(a[None, :], queries)) ** 2, axis=1))
    unit = jnp.sum(a * jnp.sum((queries - database[found]) ** 2, axis=1))
    eps = jnp.finfo(queries.dtype).eps
    unit = jnp.maximum(unit, eps**0.5 * spread)
    unit = jnp.where(unit > 0, unit, 1)  # all in one place, met exactly: any unit does
    relative = temperature.astype(queries.dtype)
    absolute = jnp.maximum(relative * unit, eps * spread)
    return queries, database, a, b, jnp.where(relative > 0, absolute, jnp.nan)
