"""Refinement that can be differentiated: soft maps between the updates of the functional map."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

from jaxsmw.core.checks import check_choice, check_kind, counts_iterations
from jaxsmw.core.refinement import check_spectra, checked, diagnose
from jaxsmw.core.refiner import Problem, State
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.soft_maps import PointwiseMap, Recovery, SoftMap, Softmax, SparseSoftMap
from jaxsmw.core.spectrum import Spectrum

Differentiation = Literal["unrolled", "checkpointed", "implicit"]


class SoftRefinement(eqx.Module):
    """The outcome of `refine_softly`, a pytree.

    **Attributes:**

    - `functional_map`: C.
    - `soft_map`: the soft map X -> Y that follows from it.
    - `result`: a member of `RESULTS`; compare with `RESULTS.successful`.
    - `iterations`: how many functional maps were made after the first.
    - `change`: how much the last one changed C, relative to its Frobenius norm: 0 at a fixed point.
    """

    functional_map: Float[Array, "k_out k_in"]
    soft_map: SoftMap | SparseSoftMap
    result: RESULTS
    iterations: Int32[Array, ""]
    change: Float[Array, ""]


@counts_iterations
@eqx.filter_jit
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
    """Algorithm 1 with soft maps in place of nearest neighbours, differentiable in all that it is given.

    Spectra, start if it is soft, parameters of the bank, weights and descriptors of the solution, and the
    temperature. Nothing of size m x n is stored, nor for derivatives.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `pointwise_map`: the start, a pointwise map or a soft one from X to Y.
    - `refiner`: how functional maps follow from maps; its `search` is not used.
    - `recovery`: how soft maps follow from functional ones. Low temperatures are nearer to `jaxsmw.refine`,
      with larger and less telling derivatives.
    - `iterations`: how many functional maps are made after the first, at least 1; with `"implicit"` at most
      so many.
    - `differentiation`: how derivatives are had.
        - `"unrolled"`: back through all iterations, as automatic differentiation does.
        - `"checkpointed"`: the same derivatives; what they need within an iteration is computed anew.
        - `"implicit"`: iterate up to a fixed point C = F(C, θ), where `dC = (I - dF/dC)^-1 dF/dθ dθ`
          (implicit function theorem), by `optimistix.fixed_point`; the linear system is solved by GMRES, its
          products being derivatives of one iteration. Takes no more memory for more iterations, and the
          start has no derivative.
    - `tolerance`: with `"implicit"`, on changes of C beside its largest entry, and of the linear solver.

    **Returns:** A `SoftRefinement`. Nothing is raised for bad numbers: check its `result`. With `"implicit"`
    it is `RESULTS.fixed_point_not_reached` if `iterations` were too few.

    **Raises:** `ValueError` for fewer than one iteration, a tolerance that is not positive, another
    `differentiation`, a start of another size, or spectra of two float types; `TypeError` for what is no
    refiner or recovery, or iterations that are no integer. With `"implicit"`, derivatives (not the outcome)
    raise equinox's runtime error where iterations were too few (are NaN, in forward mode), or GMRES does not
    come to its tolerance.
    """
    check_choice("differentiation", differentiation, get_args(Differentiation))
    check_kind("refiner", refiner, WaveletPreservation)
    check_kind("recovery", recovery, Recovery)
    check_spectra(spectrum_x, spectrum_y)
    if not tolerance > 0:
        raise ValueError(f"refine_softly needs a positive tolerance, not {tolerance}")
    m, n = spectrum_x.mask.shape[0], spectrum_y.mask.shape[0]
    matches: Array | None = None
    if isinstance(pointwise_map, SoftMap):
        sizes = pointwise_map.queries.shape[0], pointwise_map.database.shape[0]
        if sizes != (m, n):
            raise ValueError(
                f"the start maps {sizes[0]} points to {sizes[1]}, but the shapes have {m} and {n} vertices"
            )
    else:
        sparse = isinstance(pointwise_map, SparseSoftMap)
        matches = pointwise_map.rows if isinstance(pointwise_map, SparseSoftMap) else pointwise_map
        check_kind("initial map", matches, np.ndarray, jax.Array)
        if matches.shape[0] != m or matches.ndim != 1 + sparse:
            raise ValueError(f"the initial map has shape {matches.shape}, but X has {m} vertices")
    prepared = refiner.prepare(Problem(spectrum_x, spectrum_y))
    first, result = refiner.update(prepared, pointwise_map, None)
    start, start_went = first.functional_map, checked(first, result)

    def recover(functional_map: Float[Array, "k_out k_in"]) -> SoftMap | SparseSoftMap:
        points = refiner.embeddings(prepared, State(functional_map))
        return recovery(*points, *_areas(spectrum_x, spectrum_y))

    def step(functional_map: Float[Array, "k_out k_in"]) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        following, how = refiner.update(prepared, recover(functional_map), State(functional_map))
        return following.functional_map, checked(following, how)

    if differentiation == "implicit":
        last, done, converged = _fixed_point(lambda c: step(c)[0], start, iterations, tolerance)
        # Once more, for what the solver does not tell: how the update went, and how far it still moves.
        before, (after, went) = last, step(lax.stop_gradient(last))
        unsettled = (went == RESULTS.successful) & ~converged
        went = where(unsettled, RESULTS.fixed_point_not_reached, went)
    else:
        turn = jax.checkpoint(step) if differentiation == "checkpointed" else step

        def follow(state: _State, _: None) -> tuple[_State, None]:
            functional_map, so_far = state[1:]
            following, how = turn(functional_map)
            return (functional_map, following, where(so_far == RESULTS.successful, how, so_far)), None

        (before, last, went), _ = lax.scan(follow, (start, start, start_went), None, length=iterations)
        after, done = last, jnp.asarray(iterations, jnp.int32)
    moved, norm = (jnp.sqrt(jnp.sum(lax.stop_gradient(c) ** 2)) for c in (after - before, last))
    went = where(start_went == RESULTS.successful, went, start_went)
    went = diagnose(spectrum_x, spectrum_y, matches, went)
    return SoftRefinement(last, recover(last), went, done, moved / norm)


class WaveletPreservationLayer(eqx.Module):
    """A layer for models of one's own: features of both shapes in, functional map and soft map out.

    The soft map between the features is refined by `refine_softly`. It has no parameters but those of its
    modules, which are leaves, as those of any equinox module: train them all, or freeze what is not to be
    learned (`equinox.partition`). As a pure function of arrays it also is part of a flax or haiku model.

    **Arguments:**

    - `refiner`: how functional maps follow from maps.
    - `recovery_of_features`: how the first soft map follows from the features.
    - `recovery`, `iterations`, `differentiation`, `tolerance`: see `refine_softly`.
    """

    refiner: WaveletPreservation = WaveletPreservation()
    recovery_of_features: Recovery = Softmax()
    recovery: Recovery = Softmax()
    iterations: int = eqx.field(static=True, default=2)
    differentiation: Differentiation = eqx.field(static=True, default="checkpointed")
    tolerance: float = eqx.field(static=True, default=1e-4)

    def __call__(
        self,
        features_x: Float[Array, "m d"],
        features_y: Float[Array, "n d"],
        spectrum_x: Spectrum,
        spectrum_y: Spectrum,
    ) -> SoftRefinement:
        """Match two shapes by features of their vertices: near in feature space is likely the same point.

        **Raises:** `ValueError` unless features are one row per vertex, of one width; see `refine_softly`.
        """
        needed = [(s.mask.shape[0], features_x.shape[-1]) for s in (spectrum_x, spectrum_y)]
        found = [features_x.shape, features_y.shape]
        if found != needed:
            raise ValueError(
                "features have shapes {} and {}, where {} and {} are needed".format(*found, *needed)
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


def _fixed_point(
    step: Callable[[Float[Array, "k_out k_in"]], Float[Array, "k_out k_in"]],
    start: Float[Array, "k_out k_in"],
    iterations: int,
    tolerance: float,
) -> tuple[Float[Array, "k_out k_in"], Int32[Array, ""], Bool[Array, ""]]:
    """Where iterations come to rest, how many that took, and whether they did."""
    import lineax as lx  # here, as importing them takes as long as an eigenbasis
    import optimistix as optx

    # In units of the largest entry, as what is wanted is precision relative to C as a whole; and in the
    # default float type, since optimistix takes no float32 while jax_enable_x64 is set.
    unit = lax.stop_gradient(jnp.max(jnp.abs(start)))

    def scaled_step(scaled: Float[Array, "k_out k_in"], _: None) -> Float[Array, "k_out k_in"]:
        return (step(scaled.astype(start.dtype) * unit) / unit).astype(float)

    solution: optx.Solution = optx.fixed_point(
        scaled_step,
        optx.FixedPointIteration(rtol=0.0, atol=tolerance),
        (lax.stop_gradient(start) / unit).astype(float),
        max_steps=iterations,
        adjoint=optx.ImplicitAdjoint(lx.GMRES(tolerance, tolerance)),
        throw=False,
    )
    converged = jnp.asarray(solution.result == optx.RESULTS.successful)
    functional_map = _known_to_rest(solution.value.astype(start.dtype) * unit, converged)
    return functional_map, solution.stats["num_steps"].astype(jnp.int32), converged


@jax.custom_jvp
def _known_to_rest(
    functional_map: Float[Array, "k_out k_in"], at_rest: Bool[Array, ""]
) -> Float[Array, "k_out k_in"]:
    """The same; where it is no fixed point, the formula for the derivatives of one does not hold: NaN."""
    return functional_map


@_known_to_rest.defjvp
def _derivative_at_rest(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    functional_map, at_rest = primals
    known = jnp.where(at_rest, 1.0, jnp.nan).astype(functional_map.dtype)
    return functional_map, tangents[0] * known


_State = tuple[Float[Array, "k_out k_in"], Float[Array, "k_out k_in"], RESULTS]
"""The functional map before, the last one, and how it went so far."""
