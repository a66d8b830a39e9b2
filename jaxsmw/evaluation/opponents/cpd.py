r"""Pointwise maps by Coherent Point Drift: the recovery of Rodolà, Moeller and Cremers (2015).

E. Rodolà, M. Moeller, D. Cremers, *Point-wise map recovery and refinement from functional correspondence*,
VMV 2015, arXiv 1506.05603; A. Myronenko, X. Song, *Point set registration: Coherent Point Drift*, IEEE TPAMI
32 (2010). Written from the papers, to be compared with.

Nearest neighbours read a functional map back well if it is (nearly) a rotation of one spectral embedding onto
the other. Where shapes are not isometric it is not, and what is left is a non-rigid registration of two point
sets in k dimensions. The embedding that C maps (`Phi_Y C^T`, "centroids") moves, smoothly; the other
(`Phi_X`, "data") stays. Every data point is drawn from a mixture of isotropic Gaussians around the centroids,
one variance s for all, plus a share w of uniform noise; every vertex counts the same, whatever its area. The
displacement combines Gaussian kernels `G` (n, n) at the centroids `Y`; for moved centroids T, EM alternates

    P_ji proportional to exp(-||x_i - t_j||^2 / 2 s), the noise to (2 pi s)^(d/2) w n / ((1 - w) m)
    (diag(P 1) G + stiffness s I) W = P X - diag(P 1) Y,    T = Y + G W
    s = sum_ij P_ji ||x_i - t_j||^2 / (d sum P)

until the penalised likelihood stands still. The match of x is the centroid most probable for it: the nearest.

Nothing of size m x n is stored, nor n x n. P is made a block of data points at a time. G is replaced by a
factor `L L^T` of low rank (`kernel_factor`); then `G W = L b`, and the M-step is a ridge regression of the
displacements on the columns of L, `(L^T diag(P 1) L + stiffness s I) b = L^T (P X - diag(P 1) Y)`: Woodbury's
identity, without inverting anything small. With L of full rank it is the method itself.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.core.banks import FilterBank, Identity
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.products import product
from jaxsmw.core.refinement import Problem, WaveletPreservation
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.spectrum import Spectrum

# Data points whose probabilities are in memory at once.
_BLOCK = 128
# As in Myronenko's program: a smaller variance (of point sets of unit variance) is rounding.
_LEAST_VARIANCE = 1e-8


class Drift(eqx.Module):
    """The outcome of `coherent_point_drift`.

    **Attributes:**

    - `centroids`: (n, d), where they moved to, in the frame and unit of the data; masked ones mean nothing.
    - `variance`: the last one, in squares of the data's root mean square distance from its mean.
    - `iterations`: how many were done.
    """

    centroids: Float[Array, "n d"]
    variance: Float[Array, ""]
    iterations: Int32[Array, ""]


def coherent_point_drift(
    data: Float[Array, "m d"],
    centroids: Float[Array, "n d"],
    *,
    data_mask: Bool[Array, " m"] | None = None,
    centroids_mask: Bool[Array, " n"] | None = None,
    width: float = 2.0,
    stiffness: float = 3.0,
    outliers: float = 0.1,
    rank: int = 300,
    iterations: int = 150,
    tolerance: float = 1e-5,
) -> Drift:
    """Move centroids smoothly until they explain the data; see the top of this module.

    Both point sets are first brought to zero mean and unit variance, each by itself. The defaults are those
    of Myronenko's program, but for the rank: there it is the square root of n, and the kernel exact unless
    asked. On a real pair of 5000 vertices the error of the map was 22.4, 20.8, 20.8 (x 10^-3) for rank 70,
    300, 1200 at k = 30, and 17.2, 11.4, 11.3 for rank 150, 600, 1200 at k = 100.

    **Arguments:**

    - `data`, `centroids`: points in d dimensions; neither set may be one point only.
    - `data_mask`, `centroids_mask`: rows with False count for nothing.
    - `width`: beta of the papers, the standard deviation of the kernel: how far points move together.
    - `stiffness`: lambda of the papers, the weight of smoothness.
    - `outliers`: w, the share of the data that no centroid explains; at least 0, below 1.
    - `rank`: columns of the kernel's factor, see `kernel_factor`.
    - `iterations`: the most that are done.
    - `tolerance`: stop when the objective changes by less than this share of itself.

    **Raises:** `ValueError` for a number out of range.
    """
    if not (width > 0 and stiffness > 0 and 0 <= outliers < 1 and rank >= 1 and iterations >= 1):
        raise ValueError(
            "coherent point drift needs a positive width, stiffness, rank and number of iterations, and "
            f"outliers from 0 to below 1, not {width}, {stiffness}, {rank}, {iterations} and {outliers}"
        )
    data_mask = jnp.ones(data.shape[0], bool) if data_mask is None else data_mask
    centroids_mask = jnp.ones(centroids.shape[0], bool) if centroids_mask is None else centroids_mask
    settings = [jnp.asarray(value, data.dtype) for value in (width, stiffness, outliers, tolerance)]
    return _drift(data, centroids, data_mask, centroids_mask, *settings, jnp.int32(iterations), rank=rank)


def kernel_factor(
    points: Float[Array, "n d"], mask: Bool[Array, " n"], *, width: float | Float[Array, ""], rank: int
) -> Float[Array, "n rank"]:
    """A factor L of the Gaussian kernel matrix: `exp(-||p_i - p_j||^2 / 2 width^2)` is nearly `L L^T`.

    A Cholesky factorisation that eliminates, in each step, the point that the ones before explain worst, and
    stops at the rank: a Nyström approximation on points spread over the set, chosen by the set alone. It
    takes `rank` rows of the kernel matrix and about `n rank^2` operations. Columns beyond the numerical rank
    are zero, and so are rows of masked points.
    """
    n = points.shape[0]
    rounding = 32 * jnp.finfo(points.dtype).eps
    half_norms = 0.5 * jnp.sum(points**2, axis=1)

    def eliminate(
        step: Int[Array, ""], state: tuple[Float[Array, "rank n"], Float[Array, " n"]]
    ) -> tuple[Float[Array, "rank n"], Float[Array, " n"]]:
        rows, unexplained = state
        pivot = jnp.argmax(unexplained)
        half_distances = half_norms + half_norms[pivot] - product(points, points[pivot])
        kernel = jnp.exp(-jnp.maximum(half_distances, 0) / width**2)
        row = kernel - product(rows[:, pivot], rows)
        row = row / jnp.sqrt(jnp.maximum(unexplained[pivot], rounding))
        row = jnp.where(unexplained > rounding, row, 0)
        return rows.at[step].set(row), (unexplained - row**2).at[pivot].set(0)

    start = jnp.zeros((rank, n), points.dtype), mask.astype(points.dtype)
    rows, _ = lax.fori_loop(0, rank, eliminate, start)
    return rows.T


def recover_by_drift(
    functional_map: Float[Array, "k_x k_y"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    rank: int = 300,
    iterations: int = 50,
) -> Int32[Array, " m"]:
    """The pointwise map T: X -> Y (m,) of a functional map, by Coherent Point Drift instead of `decode`.

    C is in the pullback convention, `Phi_X^+ P Phi_Y`; it need not be orthogonal. The embedding of Y drifts,
    and each vertex of X is matched with the unmasked vertex of Y that came nearest.

    The settings are those of a published run of the method on FAUST (k = 30, C from spectral ICP; the
    `exp_teaser` of github.com/daviddao/GPU-Programming-TUM): the standard ones of `coherent_point_drift`, 50
    iterations, after which it has come to rest or nearly.
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y)
    drift = coherent_point_drift(
        queries,
        database,
        data_mask=spectrum_x.mask,
        centroids_mask=spectrum_y.mask,
        rank=rank,
        iterations=iterations,
    )
    return nearest_neighbor(queries, drift.centroids, database_mask=spectrum_y.mask)


class DriftRecovery(WaveletPreservation):
    """A refiner whose pointwise maps are recovered by drift, for `jaxsmw.refine`.

    Without a filter (the default) its functional maps are `Phi_X^+ P Phi_Y`, least squares without
    orthogonality: one iteration is the recovery, more are the refinement, of C by T and of T by C in turn.
    (How exactly the paper updates C was not at hand; this is the update of C by least squares.)

    **Arguments:** those of `WaveletPreservation`, and

    - `rank`, `drift_iterations`: see `recover_by_drift`.

    **Raises:** `ValueError` for the pushforward convention.
    """

    bank: FilterBank = Identity()
    rank: int = eqx.field(static=True, default=300)
    drift_iterations: int = eqx.field(static=True, default=50)

    def __check_init__(self) -> None:
        if self.convention != "pullback":
            raise ValueError(
                f"DriftRecovery moves Phi_Y C^T: its convention is pullback, not {self.convention}"
            )

    def recover(self, problem: Problem, functional_map: Float[Array, "k_x k_y"]) -> Int32[Array, " m"]:
        """See `recover_by_drift`."""
        return recover_by_drift(
            functional_map,
            problem.spectrum_x,
            problem.spectrum_y,
            rank=self.rank,
            iterations=self.drift_iterations,
        )


@partial(jax.jit, static_argnames="rank")
def _drift(
    data: Float[Array, "m d"],
    centroids: Float[Array, "n d"],
    data_mask: Bool[Array, " m"],
    centroids_mask: Bool[Array, " n"],
    width: Float[Array, ""],
    stiffness: Float[Array, ""],
    outliers: Float[Array, ""],
    tolerance: Float[Array, ""],
    iterations: Int32[Array, ""],
    *,
    rank: int,
) -> Drift:
    """`coherent_point_drift`, compiled once per sizes and rank."""
    x, mean, scale = _normalized(data, data_mask)
    y, _, _ = _normalized(centroids, centroids_mask)
    factor = kernel_factor(y, centroids_mask, width=width, rank=rank)
    d, points = data.shape[1], jnp.sum(data_mask).astype(x.dtype)

    def step(state: _State) -> _State:
        moved = y + product(factor, state.coefficients)
        expected = _expectation(x, data_mask, moved, centroids_mask, state.variance, outliers)
        objective = (
            stiffness / 2 * jnp.sum(state.coefficients**2)
            + d / 2 * points * jnp.log(state.variance)
            - expected.log_likelihood
        )
        coefficients = _maximization(expected, y, factor, stiffness * state.variance)
        return _State(
            coefficients,
            _variance(expected, x, y + product(factor, coefficients)),
            objective,
            change=jnp.abs(1 - state.objective / objective),
            iterations=state.iterations + 1,
        )

    def goes_on(state: _State) -> Bool[Array, ""]:
        drifting = (state.change > tolerance) & (state.variance > _LEAST_VARIANCE)
        return drifting & (state.iterations < iterations)

    infinite = jnp.asarray(jnp.inf, x.dtype)
    start = _State(
        jnp.zeros((rank, d), x.dtype),
        # The mean of all squared distances: both sets have zero mean and a mean squared norm of 1.
        jnp.asarray(2 / d, x.dtype),
        objective=infinite,
        change=infinite,
        iterations=jnp.asarray(0, jnp.int32),
    )
    end = lax.while_loop(goes_on, step, start)
    moved = mean[None, :] + scale * (y + product(factor, end.coefficients))
    return Drift(moved, end.variance, end.iterations)


class _State(NamedTuple):
    """What one iteration of EM hands to the next; the objective is that before its M-step."""

    coefficients: Float[Array, "rank d"]
    variance: Float[Array, ""]
    objective: Float[Array, ""]
    change: Float[Array, ""]
    iterations: Int32[Array, ""]


class _Expected(NamedTuple):
    """What the M-step needs of the probabilities P (n, m): `P X`, `P 1` and `P^T 1`, and their likelihood."""

    weighted_data: Float[Array, "n d"]
    per_centroid: Float[Array, " n"]
    per_point: Float[Array, " m"]
    log_likelihood: Float[Array, ""]


def _normalized(
    points: Float[Array, "n d"], mask: Bool[Array, " n"]
) -> tuple[Float[Array, "n d"], Float[Array, " d"], Float[Array, ""]]:
    """Points with zero mean and a mean squared norm of 1, zero where masked; the mean and the scale taken."""
    count = jnp.sum(mask).astype(points.dtype)
    mean = jnp.sum(jnp.where(mask[:, None], points, 0), axis=0) / count
    centered = jnp.where(mask[:, None], points - mean[None, :], 0)
    scale = jnp.sqrt(jnp.sum(centered**2) / count)
    return centered / scale, mean, scale


def _expectation(
    data: Float[Array, "m d"],
    data_mask: Bool[Array, " m"],
    centroids: Float[Array, "n d"],
    centroids_mask: Bool[Array, " n"],
    variance: Float[Array, ""],
    outliers: Float[Array, ""],
) -> _Expected:
    """The E-step, a block of data points at a time; logarithms are shifted so that nothing underflows."""
    (m, d), n = data.shape, centroids.shape[0]
    dtype, blocks = data.dtype, -(-m // _BLOCK)
    density = jnp.sum(centroids_mask).astype(dtype) / jnp.sum(data_mask).astype(dtype)
    log_noise = jnp.log(density * (outliers / (1 - outliers))) + d / 2 * jnp.log(2 * jnp.pi * variance)
    half_norms = jnp.where(centroids_mask, 0.5 * jnp.sum(centroids**2, axis=1), jnp.inf)

    def add(
        moments: Float[Array, "n extended"], block: tuple[Float[Array, "block d"], Float[Array, " block"]]
    ) -> tuple[Float[Array, "n extended"], tuple[Float[Array, " block"], Float[Array, " block"]]]:
        points, counts = block
        half_distances = (
            half_norms[None, :] + 0.5 * jnp.sum(points**2, axis=1)[:, None] - product(points, centroids.T)
        )
        logs = -jnp.maximum(half_distances, 0) / variance
        shift = jnp.maximum(jnp.max(logs, axis=1), log_noise)
        likelihoods = jnp.exp(logs - shift[:, None])
        explained = jnp.sum(likelihoods, axis=1)
        total = explained + jnp.exp(log_noise - shift)
        rows = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1) * (counts / total)[:, None]
        return moments + product(likelihoods.T, rows), (
            counts * explained / total,
            counts * (shift + jnp.log(total)),
        )

    padded = jnp.pad(data, ((0, blocks * _BLOCK - m), (0, 0))).reshape(blocks, _BLOCK, d)
    counts = jnp.pad(data_mask, (0, blocks * _BLOCK - m)).reshape(blocks, _BLOCK).astype(dtype)
    moments, (per_point, logs) = lax.scan(add, jnp.zeros((n, d + 1), dtype), (padded, counts))
    return _Expected(moments[:, :-1], moments[:, -1], per_point.reshape(-1)[:m], jnp.sum(logs))


def _maximization(
    expected: _Expected,
    centroids: Float[Array, "n d"],
    factor: Float[Array, "n rank"],
    ridge: Float[Array, ""],
) -> Float[Array, "rank d"]:
    """The M-step: the displacement, as coefficients of the kernel's factor."""
    weights = expected.per_centroid[:, None]
    gram = product(factor.T, weights * factor) + ridge * jnp.eye(factor.shape[1], dtype=factor.dtype)
    wanted = product(factor.T, expected.weighted_data - weights * centroids)
    return jsp.linalg.cho_solve(jsp.linalg.cho_factor(gram), wanted)


def _variance(expected: _Expected, data: Float[Array, "m d"], moved: Float[Array, "n d"]) -> Float[Array, ""]:
    """The mean squared distance, per dimension, of the data from the centroids that explain it."""
    squares = (
        jnp.sum(expected.per_point[:, None] * data**2)
        + jnp.sum(expected.per_centroid[:, None] * moved**2)
        - 2 * jnp.sum(expected.weighted_data * moved)
    )
    explained = jnp.maximum(jnp.sum(expected.per_centroid), jnp.finfo(data.dtype).tiny)
    return jnp.abs(squares) / (explained * data.shape[1])
