"""Differentiable refinement, with soft maps instead of pointwise maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int, Int32

from jaxsmw.core.arrays import Array
from jaxsmw.core.checks import check_array, check_kind, check_option, counts_iterations
from jaxsmw.core.functional_map import FunctionalMap, PointwiseMap
from jaxsmw.core.module import Module, field, jitted
from jaxsmw.core.refinement import check_spectra, checked, diagnose
from jaxsmw.core.refiner import Problem, State
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.soft_maps import Recovery, SoftMap, Softmax, SparseSoftMap
from jaxsmw.core.spectrum import Spectrum

Differentiation = Literal["unrolled", "checkpointed", "implicit"]
Step = Callable[[FunctionalMap], tuple[FunctionalMap, RESULTS]]
"""A function that takes a functional map, and returns the next functional map and a status code."""


class SoftRefinement(Module):
    """The outcome of `refine_softly`, a pytree.

    **Attributes:**

    - `functional_map`: the final functional map C (k_out, k_in), without unit, in the refiner's `convention`.
      By default, C is a pullback (k_X, k_Y), which takes functions on Y to functions on X. After a failure, C
      contains NaN or meaningless numbers.
    - `soft_map`: the `SoftMap` or `SparseSoftMap` from X (m vertices) to Y (n vertices) that the recovery
      computes from C.
    - `result`: the status code, a member of `RESULTS`. `RESULTS[result]` is a sentence that explains it.
    - `iterations`: the number of functional maps that were computed after the first functional map.
    - `change`: the Frobenius norm of the change of C in the last iteration, divided by the Frobenius norm of
      C. The change is 0 at a fixed point.
    """

    functional_map: FunctionalMap
    soft_map: SoftMap | SparseSoftMap
    result: RESULTS
    iterations: Int32[Array, ""]
    change: Float[Array, ""]


@counts_iterations
@jitted
def refine_softly(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    pointwise_map: PointwiseMap,
    *,
    refiner: WaveletPreservation = WaveletPreservation(),  # noqa: B008 (immutable)
    recovery: Recovery = Softmax(),  # noqa: B008 (immutable)
    iterations: int = 5,
    differentiation: Differentiation = "checkpointed",
    tolerance: float = 1e-4,
) -> SoftRefinement:
    """Refine a map by Algorithm 1 of the MWP paper with soft maps instead of nearest neighbours.

    The outcome is differentiable with respect to the spectra, the parameters of the filter bank, the weights
    and descriptors of the solution, the temperature of the recovery, and the initial map if it is a soft map.
    No array of size m x n is stored, not even for derivatives.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices) and of target Y (n vertices). Two
      full shapes should each have area 1, as from `compute_spectrum`. The shapes of a partial pair need the
      same unit of length.
    - `pointwise_map`: the initial map X -> Y: an integer array (m,) with one 0-based vertex of Y per vertex
      of X, or a `SoftMap`, or a `SparseSoftMap`.
    - `refiner`: a `WaveletPreservation`, which computes functional maps from soft maps. Its attribute
      `search` has no effect.
    - `recovery`: the `Recovery` that computes soft maps from functional maps. At lower temperatures, the
      results are closer to those of `jaxsmw.refine`, but the derivatives are larger and less informative.
    - `iterations`: the number of functional maps after the first functional map, an integer of at least 1.
      With `"implicit"`, `iterations` is an upper limit.
    - `differentiation`: how derivatives are computed. `"unrolled"` differentiates through all iterations.
      `"checkpointed"` (the default) gives the same derivatives with less memory: the backward pass computes
      the intermediate values of each iteration again. `"implicit"` iterates up to a fixed point C = F(C, θ),
      where F is one iteration and θ are its parameters, by `optimistix.fixed_point`. The derivatives follow
      from the implicit function theorem, `dC = (I - dF/dC)^-1 dF/dθ dθ`, and GMRES solves this linear system.
      The memory then does not grow with the number of iterations, and the outcome has no derivative with
      respect to the initial map.
    - `tolerance`: a positive number, which only `"implicit"` uses. The tolerance limits the error of the
      fixed point, relative to the largest entry of the first functional map. GMRES uses the same tolerance.

    **Returns:** A `SoftRefinement`. Numerical failures raise no error, so compare its `result` with
    `RESULTS.successful`. If `"implicit"` has too few `iterations`, `result` is
    `RESULTS.fixed_point_not_reached`.

    **Raises:** `ValueError` if `iterations` is below 1, `tolerance` is not positive, `differentiation` is
    unknown, the initial map has the wrong size, or the spectra have different float types. `TypeError` if an
    argument has the wrong type. With `"implicit"`, derivatives fail if there are too few iterations or if
    GMRES does not reach its tolerance. Reverse-mode derivatives then raise equinox's runtime error, and
    forward-mode derivatives are NaN.
    """
    check_option("differentiation", differentiation, get_args(Differentiation))
    check_kind("refiner", refiner, WaveletPreservation, "WaveletPreservation()")
    check_kind("recovery", recovery, Recovery, "Softmax()")
    check_spectra(spectrum_x, spectrum_y)
    if not tolerance > 0:
        raise ValueError(f"refine_softly needs a positive tolerance, not {tolerance}")
    matches = _matches(pointwise_map, spectrum_x.mask.shape[0], spectrum_y.mask.shape[0])
    prepared = refiner.prepare(Problem(spectrum_x, spectrum_y))
    first, result = refiner.update(prepared, pointwise_map, None)
    first_result = checked(first, result)

    def recover(functional_map: FunctionalMap) -> SoftMap | SparseSoftMap:
        points = refiner.embeddings(prepared, State(functional_map))
        return recovery(*points, *_areas(spectrum_x, spectrum_y))

    def step(functional_map: FunctionalMap) -> tuple[FunctionalMap, RESULTS]:
        following, how = refiner.update(prepared, recover(functional_map), State(functional_map))
        return following.functional_map, checked(following, how)

    if differentiation == "implicit":
        loop = _to_the_fixed_point(step, first.functional_map, iterations, tolerance)
    else:
        step = jax.checkpoint(step) if differentiation == "checkpointed" else step
        loop = _through_iterations(step, first.functional_map, first_result, iterations)
    moved, norm = (
        jnp.sqrt(jnp.sum(lax.stop_gradient(c) ** 2)) for c in (loop.last_change, loop.functional_map)
    )
    result = where(first_result == RESULTS.successful, loop.result, first_result)
    result = diagnose(spectrum_x, spectrum_y, matches, result)
    soft_map = recover(loop.functional_map)
    return SoftRefinement(loop.functional_map, soft_map, result, loop.iterations, moved / norm)


def _matches(pointwise_map: PointwiseMap, m: int, n: int) -> Int[Array, "m ..."] | None:
    """Return the vertices of Y that an initial map contains, or None for a dense soft map."""
    if isinstance(pointwise_map, SoftMap):
        sizes = pointwise_map.queries.shape[0], pointwise_map.database.shape[0]
        if sizes != (m, n):
            raise ValueError(
                f"the initial map is a soft map from {sizes[0]} to {sizes[1]} points, but X has {m} vertices "
                f"and Y has {n}: give a soft map from the vertices of X to the vertices of Y"
            )
        return None
    sparse = isinstance(pointwise_map, SparseSoftMap)
    matches = pointwise_map.rows if isinstance(pointwise_map, SparseSoftMap) else pointwise_map
    check_array("initial map", matches)
    if matches.shape[0] != m or matches.ndim != 1 + sparse:
        raise ValueError(
            f"the initial map has shape {matches.shape}, but X has {m} vertices: give one row for each "
            "vertex of X"
        )
    return matches


class WaveletPreservationLayer(Module):
    """A neural-network layer that matches two shapes by features of their vertices.

    The layer computes a soft map from the distances between the features of X and Y, and refines it by
    `refine_softly`. It is a pytree, whose trainable parameters are its array leaves, such as the
    parameters of the filter bank and the temperatures of both recoveries. `equinox.partition` can freeze some
    of them. The layer is a pure function of arrays, so flax and haiku models can also call it.

    **Arguments:**

    - `recovery_of_features`: the `Recovery` that computes the initial soft map from the features. The default
      is `Softmax()`.
    - `refiner`, `recovery`, `iterations`, `differentiation`, `tolerance`: as in `refine_softly`.

    **Raises:** `TypeError` if `recovery_of_features` is not a `Recovery`. A call raises the errors of
    `refine_softly`.
    """

    refiner: WaveletPreservation = WaveletPreservation()
    recovery_of_features: Recovery = Softmax()
    recovery: Recovery = Softmax()
    iterations: int = field(static=True, default=2)
    differentiation: Differentiation = field(static=True, default="checkpointed")
    tolerance: float = field(static=True, default=1e-4)

    def __check_init__(self) -> None:
        check_kind("recovery of features", self.recovery_of_features, Recovery, "Softmax()")

    def __call__(
        self,
        features_x: Float[Array, "m d"],
        features_y: Float[Array, "n d"],
        spectrum_x: Spectrum,
        spectrum_y: Spectrum,
    ) -> SoftRefinement:
        """Match two shapes by the features of their vertices. Return a `SoftRefinement`.

        **Arguments:**

        - `features_x`, `features_y`: d features of each vertex of X (m, d) and of Y (n, d), in the same unit.
          Corresponding vertices should be close to each other in feature space.
        - `spectrum_x`, `spectrum_y`: the spectra of the source X (m vertices) and the target Y (n vertices).

        **Raises:** `ValueError` if the features do not have one row per vertex, or if X and Y have different
        numbers of features, besides the errors of `refine_softly`.
        """
        needed = [(s.mask.shape[0], features_x.shape[-1]) for s in (spectrum_x, spectrum_y)]
        found = [features_x.shape, features_y.shape]
        if found != needed:
            raise ValueError(
                "the features have shapes {} and {}, but {} and {} are needed: give one row for each vertex, "
                "and the same number of features on X and Y".format(*found, *needed)
            )
        return refine_softly(
            spectrum_x,
            spectrum_y,
            self.recovery_of_features(features_x, features_y, *_areas(spectrum_x, spectrum_y)),
            refiner=self.refiner,
            recovery=self.recovery,
            iterations=self.iterations,
            differentiation=self.differentiation,
            tolerance=self.tolerance,
        )


def _areas(*spectra: Spectrum) -> Iterator[Float[Array, " n"]]:
    return (jnp.where(spectrum.mask, spectrum.vertex_areas, 0) for spectrum in spectra)


class _Iterated(NamedTuple):
    """The final functional map, its last change, the status code, and the number of iterations."""

    functional_map: FunctionalMap
    last_change: FunctionalMap
    result: RESULTS
    iterations: Int32[Array, ""]


def _through_iterations(
    step: Step, first: FunctionalMap, first_result: RESULTS, iterations: int
) -> _Iterated:
    """Run a fixed number of iterations. Derivatives are computed through all iterations."""

    def follow(state: tuple[Array, Array, RESULTS], _: None) -> tuple[tuple[Array, Array, RESULTS], None]:
        current, result = state[1:]
        following, how = step(current)
        return (current, following, where(result == RESULTS.successful, how, result)), None

    (previous, last, result), _ = lax.scan(follow, (first, first, first_result), None, length=iterations)
    return _Iterated(last, last - previous, result, jnp.asarray(iterations, jnp.int32))


def _to_the_fixed_point(step: Step, first: FunctionalMap, iterations: int, tolerance: float) -> _Iterated:
    """Iterate up to the fixed point. Derivatives are computed by the implicit function theorem."""
    last, done, converged = _fixed_point(lambda c: step(c)[0], first, iterations, tolerance)
    # The fixed-point solver returns neither the status code of an update nor the last change of the
    # functional map. One more iteration computes both.
    after, result = step(lax.stop_gradient(last))
    unsettled = (result == RESULTS.successful) & ~converged
    return _Iterated(last, after - last, where(unsettled, RESULTS.fixed_point_not_reached, result), done)


def _fixed_point(
    step: Callable[[FunctionalMap], FunctionalMap], first: FunctionalMap, iterations: int, tolerance: float
) -> tuple[FunctionalMap, Int32[Array, ""], Bool[Array, ""]]:
    """Return the fixed point of a step, the number of iterations, and whether the iterations converged."""
    # These imports are local because they take as long as the computation of an eigenbasis.
    import lineax as lx
    import optimistix as optx

    # Division by the largest entry of the first functional map makes the tolerance relative. The solver
    # computes in the default float type, because optimistix does not accept float32 while jax_enable_x64 is
    # set.
    unit = lax.stop_gradient(jnp.max(jnp.abs(first)))

    def scaled_step(scaled: FunctionalMap, _: None) -> FunctionalMap:
        return (step(scaled.astype(first.dtype) * unit) / unit).astype(float)

    solution: optx.Solution = optx.fixed_point(
        scaled_step,
        optx.FixedPointIteration(rtol=0.0, atol=tolerance),
        (lax.stop_gradient(first) / unit).astype(float),
        max_steps=iterations,
        adjoint=optx.ImplicitAdjoint(lx.GMRES(tolerance, tolerance)),
        throw=False,
    )
    converged = jnp.asarray(solution.result == optx.RESULTS.successful)
    functional_map = _differentiable_if(converged, solution.value.astype(first.dtype) * unit)
    return functional_map, solution.stats["num_steps"].astype(jnp.int32), converged


@jax.custom_jvp
def _differentiable_if(converged: Bool[Array, ""], functional_map: FunctionalMap) -> FunctionalMap:
    """Return the functional map, with NaN derivatives unless it is a fixed point."""
    return functional_map


@_differentiable_if.defjvp
def _derivative_if(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    converged, functional_map = primals
    known = jnp.where(converged, 1.0, jnp.nan).astype(functional_map.dtype)
    return functional_map, tangents[1] * known
