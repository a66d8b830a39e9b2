"""Soft maps: each point corresponds to several points, with differentiable shares of its area.

A `Recovery` computes a soft map from two point sets. `Softmax` uses the distances alone. `NearestFew` uses
the distances to the nearest points only. With `Sinkhorn`, every point also receives the share that its area
implies.
"""

from __future__ import annotations

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.core.checks import as_parameter, check_between
from jaxsmw.core.products import product
from jaxsmw.core.search import in_blocks, nearest_neighbor

# The number of queries per block. Distances from one block to all database rows are in memory at once.
_BLOCK = 128


class SoftMap(eqx.Module):
    """A transport plan between two point sets: the part of each query's area that goes to each database row.

    The plan is `P_ij = a_i w_ij / sum_j w_ij` with `w_ij = b_j exp(g_j - |q_i - y_j|² / temperature)`. The
    matrix P is never stored as a whole. Its rows sum to the areas of the queries exactly. Its columns sum to
    the areas of the database rows up to the `residual`.

    **Attributes:**

    - `queries`, `database`: the points q (m, d) and y (n, d), up to a common shift.
    - `query_areas`, `database_areas`: a (m,) and b (n,), each with sum 1, zero for ignored points. A query of
      zero area still gets the shares that its position implies.
    - `potentials`: g (n,), without unit. A high potential raises the share of a row. Zero for rows of zero
      area.
    - `temperature`: the temperature, in squared units of the points.
    - `residual`: the share of the total area, from 0 to 1, that rows receive in excess of their own area. NaN
      if the residual was not computed (`Softmax`).
    - `converged`: whether the residual is at most the tolerance. False if the residual is NaN.
    - `iterations`: the number of iterations of `sinkhorn` that were done.
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
        """Returns the mean of functions on Y, such as colours, over the shares of each query.

        **Arguments:**

        - `functions_on_y`: the values of p functions at the database rows (n, p), in any unit.

        **Returns:** The values of the p functions at the queries (m, p), in the same unit.

        **Raises:** `ValueError` if the values are not of shape (n, p).
        """
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
        """Returns the most probable database row of each query (m,): the row with the largest share per area.

        (The largest share itself would favour the larger of two neighbouring vertices.)
        """
        everywhere = jnp.where(self.database_areas > 0, self.potentials, -jnp.inf)

        def most_probable(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
            densities = _log_kernel(self.database, block, self.temperature) + everywhere[:, None]
            return jnp.argmax(densities, axis=0).astype(jnp.int32)

        return in_blocks(most_probable, self.queries, _BLOCK)


class SparseSoftMap(eqx.Module):
    """A soft map with a few database rows per query.

    **Attributes:**

    - `rows`: (m, t), the t database rows of each query, nearest first.
    - `shares`: (m, t), the shares of these database rows. The shares of each query sum to 1.
    """

    rows: Int32[Array, "m t"]
    shares: Float[Array, "m t"]

    def pull_back(self, functions_on_y: Float[Array | np.ndarray, "n p"]) -> Float[Array, "m p"]:
        """Returns the mean of functions on Y, such as colours, over the shares of each query.

        **Arguments:**

        - `functions_on_y`: the values of p functions at the database rows (n, p), in any unit.

        **Returns:** The values of the p functions at the queries (m, p), in the same unit.

        **Raises:** `ValueError` if the values do not have two dimensions.
        """
        functions = jnp.asarray(functions_on_y, self.shares.dtype)
        if functions.ndim != 2:
            raise ValueError(f"functions on Y have shape {functions.shape}, where (n, p) is needed")
        # The rows are processed one by one, because all rows at once would need t times the memory.
        taken = zip(self.rows.T, self.shares.T, strict=True)
        return sum((share[:, None] * functions[row] for row, share in taken), jnp.zeros((), functions.dtype))

    def pointwise_map(self) -> Int32[Array, " m"]:
        """Returns the nearest database row of each query, (m,)."""
        return self.rows[:, 0]


PointwiseMap = Int[Array, " m"] | SoftMap | SparseSoftMap
"""T: X -> Y, one vertex of Y per vertex of X, or a soft map from X to Y."""


def pull_back(pointwise_map: PointwiseMap, functions_on_y: Float[Array, "n p"]) -> Float[Array, "m p"]:
    """Returns functions on Y (n, p) as functions on X (m, p), `P f`, without storing the matrix P (m, n)."""
    if isinstance(pointwise_map, (SoftMap, SparseSoftMap)):
        return pointwise_map.pull_back(functions_on_y)
    return functions_on_y[pointwise_map]


class Recovery(eqx.Module):
    """A way to compute a soft map from the distances between two point sets."""

    @abc.abstractmethod
    def __call__(
        self,
        queries: Float[Array, "m d"],
        database: Float[Array, "n d"],
        query_areas: Float[Array, " m"],
        database_areas: Float[Array, " n"],
    ) -> SoftMap | SparseSoftMap:
        """Returns the soft map from the queries to the database. Rows of zero area get no share.

        **Arguments:**

        - `queries`, `database`: points (m, d) and (n, d) in d dimensions, in the same unit.
        - `query_areas`, `database_areas`: the areas of the points, (m,) and (n,), in any unit.
        """


class Softmax(Recovery):
    """Soft maps with shares proportional to the area of a row times `exp(-distance² / temperature)`.

    **Arguments:**

    - `temperature`: a positive number, in the unit that `sinkhorn` describes.

    **Raises:** `ValueError` if the temperature is not one positive, finite number.
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
        transport = _normalized(queries, database, query_areas, database_areas, self.temperature)
        b = transport.database_areas
        unknown, no_iterations = jnp.asarray(jnp.nan, b.dtype), jnp.asarray(0, jnp.int32)
        return transport.soft_map(jnp.zeros_like(b), unknown, jnp.asarray(False), no_iterations)


class NearestFew(Recovery):
    """`Softmax` restricted to the nearest rows of each query. The choice of these rows is not differentiated.

    `NearestFew` is fast in float32. In float64, sorting takes most of the time on CPUs.

    **Arguments:**

    - `number`: the number of rows per query, at least 1. If fewer rows have positive area, the other shares
      are zero.
    - `temperature`: a positive number, in the unit that `sinkhorn` describes.

    **Raises:** `ValueError` if the number is below 1, or the temperature is not one positive, finite number.
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
        transport = _normalized(queries, database, query_areas, database_areas, self.temperature)
        queries, database, _, b, temperature = transport
        settled_queries, settled = lax.stop_gradient((queries, database))
        unit = jnp.asarray(1, queries.dtype)

        def nearest(block: Float[Array, "block d"]) -> Int32[Array, "block t"]:
            closeness = jnp.where((b > 0)[:, None], _log_kernel(settled, block, unit), -jnp.inf)
            return lax.top_k(closeness.T, min(self.number, b.shape[0]))[1]

        rows = in_blocks(nearest, settled_queries, _BLOCK)
        # The rows are processed one by one, because all differences at once would need t times the memory.
        squares = [jnp.sum((queries - database[row]) ** 2, axis=1) for row in rows.T]
        exponents = -jnp.stack(squares, axis=1) / temperature
        return SparseSoftMap(rows, jax.nn.softmax(exponents + _log(b)[rows], axis=1))


class Sinkhorn(Recovery):
    """Soft maps by `sinkhorn`: every database row gets the share that its area implies.

    **Arguments:**

    - `temperature`: a positive number, in the unit that `sinkhorn` describes.
    - `iterations`, `tolerance`: see `sinkhorn`.

    **Raises:** `ValueError` for fewer than 1 iteration, or a temperature or tolerance that is not positive.
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
    """Returns the entropy-regularised optimal transport between two point sets, by Sinkhorn's iterations.

    Cuturi, "Sinkhorn distances: lightspeed computation of optimal transport", NeurIPS 2013. A plan spreads
    the areas of the queries over the areas of the database. The returned plan minimises the mean squared
    distance minus `temperature` times the entropy. Nearest-neighbour maps crowd onto some rows and leave out
    other rows, but this plan gives every row its share.

    The iterations update the logarithms of Sinkhorn's factors. Each iteration recomputes the distances in
    blocks of queries, so no array of size m x n is stored. Derivatives go through all iterations and need no
    such array either.

    **Arguments:**

    - `queries`, `database`: points (m, d) and (n, d) in d dimensions, in the same unit.
    - `query_areas`, `database_areas`: areas (m,) and (n,), in any unit. Both sides are scaled to sum 1.
      Points of zero area neither give nor receive area, and do not affect other points.
    - `temperature`: a positive number. Its unit is the area-weighted mean squared distance from queries to
      their nearest database rows. The unit is at least `sqrt(eps)` times the area-weighted variance of the
      queries, where eps is the precision of the float type. Lower temperatures give sharper maps and need
      more iterations. Temperatures below the rounding error of squared distances, eps times the variance, are
      raised to this value and have derivative zero.
    - `iterations`: the largest number of iterations. Iterations after convergence are skipped; under `vmap`
      they run but change nothing.
    - `tolerance`: the tolerance of `SoftMap.residual`, a share of the total area.

    **Returns:** A `SoftMap`. Numbers that are not finite and missing convergence raise no error: check its
    attribute `converged`.

    **Raises:** `ValueError` for fewer than one iteration.
    """
    if iterations < 1:
        raise ValueError(f"sinkhorn needs at least 1 iteration, not {iterations}")
    arrays = map(jnp.asarray, (queries, database, query_areas, database_areas, temperature))
    transport = _normalized(*arrays)
    potentials, residual, done = _sinkhorn_potentials(transport, iterations, tolerance)
    return transport.soft_map(potentials, residual, residual <= tolerance, done)


class _SinkhornState(NamedTuple):
    """Potentials, their residual, the potentials of the next iteration, and the number of iterations."""

    potentials: Float[Array, " n"]
    following: Float[Array, " n"]
    residual: Float[Array, ""]
    iterations: Int32[Array, ""]


def _sinkhorn_potentials(
    transport: _Transport, iterations: int, tolerance: float | Float[Array, ""]
) -> tuple[Float[Array, " n"], Float[Array, ""], Int32[Array, ""]]:
    """Returns the potentials of `sinkhorn`, their residual, and the number of iterations."""
    queries, database, a, b, temperature = transport
    dtype, (m, d) = queries.dtype, queries.shape
    log_b, rest = _log(b), -m % _BLOCK
    blocks = (
        jnp.pad(queries, ((0, rest), (0, 0))).reshape(-1, _BLOCK, d),
        jnp.pad(a, (0, rest)).reshape(-1, _BLOCK),
    )

    def update(potentials: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """Returns the next potentials, and the residual of the given potentials."""

        def add(arrived: Float[Array, " n"], block: tuple[Array, Array]) -> tuple[Float[Array, " n"], None]:
            log_shares = _log_kernel(database, block[0], temperature) + (log_b + potentials)[:, None]
            return arrived + product(jax.nn.softmax(log_shares, axis=0), block[1]), None

        arrived, _ = lax.scan(jax.checkpoint(add), jnp.zeros_like(b), blocks)
        # The arriving area can underflow to zero. Then the potential rises over several iterations.
        least = jnp.finfo(dtype).tiny
        correction = jnp.where(b > 0, log_b - jnp.log(jnp.maximum(arrived, least)), 0)
        return potentials + correction, jnp.sum(jnp.abs(arrived - b)) / 2

    def step(state: _SinkhornState, _: None) -> tuple[_SinkhornState, None]:
        def iterate() -> _SinkhornState:
            following, residual = jax.checkpoint(update)(state.following)
            return _SinkhornState(state.following, following, residual, state.iterations + 1)

        return lax.cond(state.residual <= tolerance, lambda: state, iterate), None

    zeros = jnp.zeros_like(b)
    initial = _SinkhornState(zeros, zeros, jnp.asarray(jnp.inf, dtype), jnp.asarray(0, jnp.int32))
    last, _ = lax.scan(step, initial, None, length=iterations)
    return last.potentials, last.residual, last.iterations


def _log(areas: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns the logarithms of areas: -inf for a zero area, with derivative zero instead of infinity."""
    return jnp.where(areas > 0, jnp.log(jnp.where(areas > 0, areas, 1)), -jnp.inf)


def _log_kernel(
    database: Float[Array, "n d"], block: Float[Array, "block d"], temperature: Float[Array, ""]
) -> Float[Array, "n block"]:
    """Returns `-distance² / temperature` up to a constant per query.

    The queries are on the last axis. So sums over the database are computed for several neighbouring queries
    at once, which halves the time.
    """
    return (2 * product(database, block.T) - jnp.sum(database**2, axis=1)[:, None]) / temperature


class _Transport(NamedTuple):
    """Two point sets with areas, and a temperature, in the form that all recoveries use.

    The points have a common origin near their centre. The areas sum to 1. The temperature is in squared units
    of the points.
    """

    queries: Float[Array, "m d"]
    database: Float[Array, "n d"]
    query_areas: Float[Array, " m"]
    database_areas: Float[Array, " n"]
    temperature: Float[Array, ""]

    def soft_map(
        self,
        potentials: Float[Array, " n"],
        residual: Float[Array, ""],
        converged: Bool[Array, ""],
        iterations: Int32[Array, ""],
    ) -> SoftMap:
        """Returns the soft map with the given potentials."""
        points, areas = (self.queries, self.database), (self.query_areas, self.database_areas)
        return SoftMap(*points, *areas, potentials, self.temperature, residual, converged, iterations)


def _normalized(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    query_areas: Float[Array, " m"],
    database_areas: Float[Array, " n"],
    temperature: Float[Array, ""],
) -> _Transport:
    """Returns the `_Transport` between two point sets, from a temperature in the units of `sinkhorn`.

    The points are shifted to their centre, because rounding would falsify distances between points far from
    the origin. A temperature that is not positive, which a training step can produce, becomes NaN and makes
    the result NaN. A temperature below the rounding error of squared distances is raised to this error.
    Otherwise exponents would consist of rounding errors, and derivatives would overflow.
    """
    a, b = query_areas / jnp.sum(query_areas), database_areas / jnp.sum(database_areas)
    center = lax.stop_gradient(product(b[None, :], database))
    queries, database = queries - center, database - center
    found = nearest_neighbor(*lax.stop_gradient((queries, database)), database_mask=b > 0)
    spread = jnp.sum(a * jnp.sum((queries - product(a[None, :], queries)) ** 2, axis=1))
    unit = jnp.sum(a * jnp.sum((queries - database[found]) ** 2, axis=1))
    eps = jnp.finfo(queries.dtype).eps
    unit = jnp.maximum(unit, eps**0.5 * spread)
    unit = jnp.where(unit > 0, unit, 1)  # any unit suffices if all points coincide
    relative = temperature.astype(queries.dtype)
    absolute = jnp.maximum(relative * unit, eps * spread)
    return _Transport(queries, database, a, b, jnp.where(relative > 0, absolute, jnp.nan))
