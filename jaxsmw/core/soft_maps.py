"""Soft maps, which match each query point to several database points with differentiable shares.

A `Recovery` computes a soft map from two point sets. `Softmax` computes the shares of a query from its
distances to all points. `NearestFew` uses only the points that are nearest to the query. `Sinkhorn` adjusts
the shares so that each database point receives a total area equal to its own area.
"""

from __future__ import annotations

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int32

from jaxsmw.core.arrays import Array, in_blocks
from jaxsmw.core.checks import as_parameter, check_between, check_integer
from jaxsmw.core.linear_algebra import product
from jaxsmw.core.module import Module, field, jitted
from jaxsmw.core.search import nearest_neighbor

# The number of queries per block. The distances from all queries of a block to all database rows are stored
# at the same time.
_BLOCK = 128


class SoftMap(Module):
    """A soft map from m query points to n database points, in the form of a transport plan.

    Entry `P_ij` of the plan P (m, n) is the part of the area of query i that is sent to database row j. The
    plan is `P_ij = a_i w_ij / sum_k w_ik` with `w_ij = b_j exp(g_j - |q_i - y_j|² / temperature)`. The share
    that query i gives to row j is `w_ij / sum_k w_ik`. The matrix P is never stored as a whole. Row i of P
    sums to the area a_i. If `sinkhorn` computed the map, column j of P sums to the area b_j up to the
    `residual`. For maps between shapes, the queries are the vertices of X, and the database rows are the
    vertices of Y.

    **Attributes:**

    - `queries`, `database`: the points q (m, d) and y (n, d), in the same unit. The points are shifted so
      that the area-weighted mean of the database is the origin.
    - `query_areas`, `database_areas`: the areas a (m,) and b (n,), without unit, each with sum 1. Ignored
      points have area zero. The shares of a query of area zero are still computed from its position.
    - `potentials`: g (n,), dimensionless. A database row with a higher potential receives larger shares from
      all queries. The potential is zero for rows of zero area, and for all rows of a map of `Softmax`.
    - `temperature`: the temperature, a scalar array in squared units of the points.
    - `residual`: the area that database rows receive in excess of their own areas, divided by the total area;
      NaN for a map of `Softmax`.
    - `converged`: whether the residual is at most the argument `tolerance` of `sinkhorn`.
    - `iterations`: the number of iterations that `sinkhorn` ran; 0 for a map of `Softmax`.
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
        """Pull functions on Y (n, p), such as colours, back to the queries (m, p).

        A query receives the mean of the values at the database rows, weighted with the shares of the query.

        **Raises:** `ValueError` if the values do not have shape (n, p).
        """
        functions = jnp.asarray(functions_on_y, self.database.dtype)
        if functions.ndim != 2 or functions.shape[0] != self.database.shape[0]:
            raise ValueError(
                f"functions on Y have shape {functions.shape}, but ({self.database.shape[0]}, p) is needed: "
                "give one row for each vertex of Y"
            )
        weights = _log(self.database_areas) + self.potentials

        def mean(block: Float[Array, "block d"]) -> Float[Array, "block p"]:
            log_shares = _log_kernel(self.database, block, self.temperature) + weights[:, None]
            return product(jax.nn.softmax(log_shares, axis=0).T, functions)

        return in_blocks(jax.checkpoint(mean), self.queries, _BLOCK)

    @eqx.filter_jit
    def pointwise_map(self) -> Int32[Array, " m"]:
        """Return, for each query, the index of the database row with the largest share per area, (m,).

        Shares alone would favour rows of large area.
        """
        everywhere = jnp.where(self.database_areas > 0, self.potentials, -jnp.inf)

        def most_probable(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
            densities = _log_kernel(self.database, block, self.temperature) + everywhere[:, None]
            return jnp.argmax(densities, axis=0).astype(jnp.int32)

        return in_blocks(most_probable, self.queries, _BLOCK)


class SparseSoftMap(Module):
    """A soft map from m query points to n database points, in which each query has at most t nonzero shares.

    **Attributes:**

    - `rows`: (m, t), the 0-based indices of the t database rows of each query, int32, nearest first.
    - `shares`: (m, t), the share of each database row in `rows`. The shares of each query sum to 1.
    """

    rows: Int32[Array, "m t"]
    shares: Float[Array, "m t"]

    def pull_back(self, functions_on_y: Float[Array | np.ndarray, "n p"]) -> Float[Array, "m p"]:
        """Pull functions on Y (n, p) back to the queries (m, p), as `SoftMap.pull_back` does."""
        functions = jnp.asarray(functions_on_y, self.shares.dtype)
        if functions.ndim != 2:
            raise ValueError(
                f"functions on Y have shape {functions.shape}, but (n, p) is needed: give one row for each "
                "vertex of Y"
            )
        # The loop saves memory: an array (m, t, p) would be large.
        taken = zip(self.rows.T, self.shares.T, strict=True)
        return sum((share[:, None] * functions[row] for row, share in taken), jnp.zeros((), functions.dtype))

    def pointwise_map(self) -> Int32[Array, " m"]:
        """Return, for each query, the index of the nearest database row, (m,)."""
        return self.rows[:, 0]


class Recovery(Module):
    """A method that computes a soft map from the distances between two point sets.

    This class is the abstract base class of recoveries, for the argument `recovery` of `refine_softly` and
    `WaveletPreservationLayer`. There, the m queries are embedded vertices of X, and the n database rows are
    embedded vertices of Y. Ready subclasses are `Softmax`, `NearestFew` and `Sinkhorn`. A subclass
    defines `__call__(queries, database, query_areas, database_areas)`.

    The ready subclasses have a `temperature`, a positive, finite number, by default 0.1. Its unit is the
    area-weighted mean squared distance from queries to their nearest database rows (`sinkhorn` explains the
    unit). Lower temperatures give sharper maps.

    **Raises:** The constructors raise `TypeError` if a number is not an integer, and `ValueError` if an
    argument is not a single positive, finite number.
    """

    @abc.abstractmethod
    def __call__(
        self,
        queries: Float[Array, "m d"],
        database: Float[Array, "n d"],
        query_areas: Float[Array, " m"],
        database_areas: Float[Array, " n"],
    ) -> SoftMap | SparseSoftMap:
        """Return the soft map from the queries to the database. Database rows of zero area have share zero.

        **Arguments:**

        - `queries`, `database`: query points (m, d) and database points (n, d), in the same unit.
        - `query_areas`, `database_areas`: the areas of the points, (m,) and (n,), in any unit. Padded
          vertices have area zero.
        """


class _Tempered(Recovery):
    """A recovery with a temperature."""

    @property
    @abc.abstractmethod
    def temperature(self) -> Float[Array, ""]:
        """The temperature, in the unit that `Recovery` describes."""

    def __check_init__(self) -> None:
        check_between(self, "temperature", self.temperature)

    def __call__(
        self,
        queries: Float[Array, "m d"],
        database: Float[Array, "n d"],
        query_areas: Float[Array, " m"],
        database_areas: Float[Array, " n"],
    ) -> SoftMap | SparseSoftMap:
        return self._map_from(_normalized(queries, database, query_areas, database_areas, self.temperature))

    @abc.abstractmethod
    def _map_from(self, transport: _Transport) -> SoftMap | SparseSoftMap:
        """Return the soft map of scaled inputs."""


class Softmax(_Tempered):
    """A recovery in which each query gives shares to all database rows, and larger shares to nearer rows.

    The share of a database row is proportional to its area times `exp(-distance² / temperature)`, where
    `distance` is the distance between the query and the row; see `Recovery`. The result is a `SoftMap`.
    """

    temperature: Float[Array, ""] = field(converter=as_parameter, default=0.1)

    def _map_from(self, transport: _Transport) -> SoftMap:
        b = transport.database_areas
        unknown, no_iterations = jnp.asarray(jnp.nan, b.dtype), jnp.asarray(0, jnp.int32)
        return transport.soft_map(jnp.zeros_like(b), unknown, jnp.asarray(False), no_iterations)


class NearestFew(_Tempered):
    """A recovery in which each query gives shares only to its nearest database rows.

    The shares of these rows are those of `Softmax`. They are differentiable, but derivatives treat the choice
    of the rows as constant. The result is a `SparseSoftMap`. On CPUs, `NearestFew` is slow in float64,
    because sorting then takes most of the time.

    **Arguments:**

    - `number`: the number of database rows per query, an integer of at least 1. If fewer than `number` rows
      have positive area, the remaining shares are zero.
    - `temperature`: see `Recovery`.
    """

    number: int = field(static=True, default=10)
    temperature: Float[Array, ""] = field(converter=as_parameter, default=0.1)

    def __check_init__(self) -> None:
        check_integer("number", self.number)
        if self.number < 1:
            raise ValueError(f"NearestFew needs at least 1 row, not {self.number}")

    def _map_from(self, transport: _Transport) -> SparseSoftMap:
        queries, database, _, b, temperature = transport
        settled_queries, settled = lax.stop_gradient((queries, database))
        unit = jnp.asarray(1, queries.dtype)

        def nearest(block: Float[Array, "block d"]) -> Int32[Array, "block t"]:
            closeness = jnp.where((b > 0)[:, None], _log_kernel(settled, block, unit), -jnp.inf)
            return lax.top_k(closeness.T, min(self.number, b.shape[0]))[1]

        rows = in_blocks(nearest, settled_queries, _BLOCK)
        # The loop saves memory: an array (m, t, d) would be large.
        squares = [jnp.sum((queries - database[row]) ** 2, axis=1) for row in rows.T]
        exponents = -jnp.stack(squares, axis=1) / temperature
        return SparseSoftMap(rows, jax.nn.softmax(exponents + _log(b)[rows], axis=1))


class Sinkhorn(_Tempered):
    """A recovery by entropy-regularised optimal transport, which preserves the areas of database rows.

    The function `sinkhorn` computes the `SoftMap`. If the iterations end before they reach the tolerance, no
    error is raised, and the attribute `converged` of the map is False.

    **Arguments:**

    - `temperature`: see `Recovery`. Lower temperatures need more iterations.
    - `iterations`, `tolerance`: as in `sinkhorn`.
    """

    temperature: Float[Array, ""] = field(converter=as_parameter, default=0.1)
    iterations: int = field(static=True, default=10)
    tolerance: float = field(static=True, default=0.01)

    def __check_init__(self) -> None:
        check_integer("iterations", self.iterations)
        if self.iterations < 1 or not self.tolerance > 0:
            raise ValueError(
                f"Sinkhorn needs at least 1 iteration and a positive tolerance, not {self.iterations} and "
                f"{self.tolerance}"
            )

    def _map_from(self, transport: _Transport) -> SoftMap:
        return _sinkhorn_map(transport, self.iterations, self.tolerance)


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
    """Return the entropy-regularised optimal transport plan between two point sets, as a `SoftMap`.

    The method is that of Cuturi 2013, "Sinkhorn distances: lightspeed computation of optimal transport". A
    transport plan distributes the areas of the queries over the areas of the database rows. The returned plan
    minimises the mean squared distance minus `temperature` times the entropy of the plan. A nearest-neighbour
    map can send many queries to one row and no query to another row. In the returned plan, the area that each
    row receives from all queries equals the row's own area, up to the tolerance.

    The iterations update the logarithms of Sinkhorn's scaling factors. Each iteration recomputes the
    distances in blocks of queries, so no array of size m x n is stored, not even for derivatives through all
    iterations.

    **Arguments:**

    - `queries`, `database`: query points (m, d) and database points (n, d) in d dimensions, in the same unit.
    - `query_areas`, `database_areas`: the areas of the points, (m,) and (n,), in any unit. The areas of each
      point set are divided by their sum. Points of zero area send no area, receive no area, and do not affect
      other points.
    - `temperature`: a positive number. Its unit is the area-weighted mean squared distance from queries to
      their nearest database rows. The unit is at least `sqrt(eps)` times the area-weighted variance of the
      queries, where eps is the machine epsilon of the float type. Lower temperatures give sharper maps and
      need more iterations. If the temperature is below eps times the variance, which is the rounding error of
      squared distances, this error is the temperature, and derivatives with respect to the temperature are
      zero. If the temperature is not positive, the result is NaN.
    - `iterations`: the maximum number of iterations, an integer of at least 1. Iterations after convergence
      are skipped. Under `jax.vmap` on accelerators, they run but change nothing.
    - `tolerance`: a positive number. The iterations stop when `SoftMap.residual`, the share of misplaced
      area, is at most the tolerance.

    **Returns:** A `SoftMap` from the m queries to the n database rows. If the iterations do not converge, or
    if the result is not finite, no error is raised, but the attribute `converged` of the map is False.

    **Raises:** `ValueError` if `iterations` is below 1.
    """
    if iterations < 1:
        raise ValueError(f"sinkhorn needs at least 1 iteration, not {iterations}")
    arrays = map(jnp.asarray, (queries, database, query_areas, database_areas, temperature))
    return _sinkhorn_map(_normalized(*arrays), iterations, tolerance)


class _SinkhornState(NamedTuple):
    """The variables of Sinkhorn's iterations. The residual is that of `potentials`, not of `following`."""

    potentials: Float[Array, " n"]
    following: Float[Array, " n"]
    residual: Float[Array, ""]
    iterations: Int32[Array, ""]


@jitted
def _sinkhorn_map(transport: _Transport, iterations: int, tolerance: float | Float[Array, ""]) -> SoftMap:
    queries, database, a, b, temperature = transport
    dtype, (m, d) = queries.dtype, queries.shape
    log_b, rest = _log(b), -m % _BLOCK
    blocks = (
        jnp.pad(queries, ((0, rest), (0, 0))).reshape(-1, _BLOCK, d),
        jnp.pad(a, (0, rest)).reshape(-1, _BLOCK),
    )

    def update(potentials: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """Return the next potentials, and the residual of the given potentials."""

        def add(arrived: Float[Array, " n"], block: tuple[Array, Array]) -> tuple[Float[Array, " n"], None]:
            log_shares = _log_kernel(database, block[0], temperature) + (log_b + potentials)[:, None]
            return arrived + product(jax.nn.softmax(log_shares, axis=0), block[1]), None

        arrived, _ = lax.scan(jax.checkpoint(add), jnp.zeros_like(b), blocks)
        # The area that arrives at a row can underflow to zero. The lower limit `least` keeps the logarithm
        # finite.
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
    return transport.soft_map(last.potentials, last.residual, last.residual <= tolerance, last.iterations)


def _log(areas: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the logarithms of areas: -inf for zero, with the derivative 0 instead of infinity."""
    return jnp.where(areas > 0, jnp.log(jnp.where(areas > 0, areas, 1)), -jnp.inf)


def _log_kernel(
    database: Float[Array, "n d"], block: Float[Array, "block d"], temperature: Float[Array, ""]
) -> Float[Array, "n block"]:
    """Return `-distance² / temperature`, up to a constant that depends only on the query."""
    # The queries are on the last axis, so XLA sums over the database for several queries at once.
    # This layout halves the run time.
    return (2 * product(database, block.T) - jnp.sum(database**2, axis=1)[:, None]) / temperature


class _Transport(NamedTuple):
    """The scaled inputs of a recovery: the temperature is in squared units of the points."""

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
        points, areas = (self.queries, self.database), (self.query_areas, self.database_areas)
        return SoftMap(*points, *areas, potentials, self.temperature, residual, converged, iterations)


def _normalized(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    query_areas: Float[Array, " m"],
    database_areas: Float[Array, " n"],
    temperature: Float[Array, ""],
) -> _Transport:
    """Scale the inputs of a recovery; `sinkhorn` describes the unit of the temperature."""
    a, b = query_areas / jnp.sum(query_areas), database_areas / jnp.sum(database_areas)
    # Distances between points far from the origin have large rounding errors.
    center = lax.stop_gradient(product(b[None, :], database))
    queries, database = queries - center, database - center
    found = nearest_neighbor(*lax.stop_gradient((queries, database)), database_mask=b > 0)
    spread = jnp.sum(a * jnp.sum((queries - product(a[None, :], queries)) ** 2, axis=1))
    unit = jnp.sum(a * jnp.sum((queries - database[found]) ** 2, axis=1))
    eps = jnp.finfo(queries.dtype).eps
    unit = jnp.maximum(unit, eps**0.5 * spread)
    unit = jnp.where(unit > 0, unit, 1)  # The unit is 0 if all queries coincide with one database row.
    relative = temperature.astype(queries.dtype)
    # At temperatures below the rounding error of squared distances, derivatives would overflow.
    absolute = jnp.maximum(relative * unit, eps * spread)
    return _Transport(queries, database, a, b, jnp.where(relative > 0, absolute, jnp.nan))
