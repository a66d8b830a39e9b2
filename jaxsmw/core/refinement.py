"""The refinement loop, which alternates between functional maps and pointwise maps for any refiner."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple, TypedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.choices import ITERATIONS
from jaxsmw.core.checks import all_finite, check_kind, counts_iterations
from jaxsmw.core.refiner import Prepared, Problem, Refiner, Samples, State
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError


class History(eqx.Module):
    """A record of the iterations of `refine`, stored in `Refinement.history` if `history=True`.

    If the refinement stopped early, `changed`, `energy` and `objective` contain NaN for the skipped
    iterations.

    **Attributes:**

    - `changed`: (iterations,), the share of X's vertices whose match changed in each iteration, from 0 to 1.
      If the refinement uses samples, `changed` is computed from the samples of X only. The first entry is
      then NaN unless `starts_on_samples` is True, and the last entry is NaN unless `ends_on_samples` is True.
    - `energy`: (iterations,), the result of `Refiner.energy` in each iteration, computed from the state and
      from the pointwise map that produced this state. For `WaveletPreservation`, this is the energy of
      equation (5) of the MWP paper, which has no unit.
    - `objective`: (iterations,), the result of `Refiner.objective` in each iteration, computed from the state
      and from the pointwise map that was recovered from this state. The objective is the mean squared
      distance between matched points of the embeddings, in the squared unit of the embeddings; lower is
      better.
    - `pointwise_maps`: (iterations, m), the map X -> Y that was recovered in each iteration. Each row
      contains a 0-based vertex of Y for each of the m vertices of X. The rows of skipped iterations repeat
      the final map. After a failure, all entries of `pointwise_maps` are -1. `pointwise_maps` is None if the
      refinement uses samples, because the iterations then map only the samples.
    """

    changed: Float[Array, " iterations"]
    energy: Float[Array, " iterations"]
    objective: Float[Array, " iterations"]
    pointwise_maps: Int32[Array, "iterations m"] | None


class Refinement(eqx.Module):
    """The outcome of `refine`, a pytree.

    **Attributes:**

    - `pointwise_map`: the refined map T: X -> Y (m,), one 0-based vertex of Y per vertex of X; all entries
      are -1 after a failure.
    - `functional_map`: the functional map C (k_out, k_in), without unit, from which the pointwise map was
      recovered. This property returns `state.functional_map`. By default, C is a pullback (k_X, k_Y), which
      takes functions on Y to functions on X. If the refiner's `convention` is `"pushforward"`, C (k_Y, k_X)
      takes functions on X to functions on Y. After a failure, C contains NaN or meaningless numbers.
    - `state`: the final `State` of the refiner, which contains the functional map.
    - `result`: the status code, a member of `RESULTS`. Compare `result` with `RESULTS.successful`.
      `RESULTS[result]` is a sentence that explains the status.
    - `iterations`: the number of iterations that were run. If the refinement stopped early, this number is
      smaller than the requested number.
    - `history`: a `History`, or None if `refine` was called with `history=False`.
    """

    pointwise_map: Int32[Array, " m"]
    state: State
    result: RESULTS
    iterations: Int32[Array, ""]
    history: History | None

    @property
    def functional_map(self) -> Float[Array, "*batch k_out k_in"]:
        """The functional map of the final state."""
        return self.state.functional_map

    def unpadded(self, number_of_vertices: int) -> Refinement:
        """Return the same refinement without the vertices that `Spectrum.pad` added to X.

        **Arguments:**

        - `number_of_vertices`: the number of vertices of X before padding.
        """
        history = self.history
        if history is not None and history.pointwise_maps is not None:
            maps = history.pointwise_maps[:, :number_of_vertices]
            history = dataclasses.replace(history, pointwise_maps=maps)
        kept = self.pointwise_map[:number_of_vertices]
        return dataclasses.replace(self, pointwise_map=kept, history=history)


class RefineSettings(TypedDict, total=False):
    """The arguments of `refine` that are the same for all pairs of a batch."""

    refiner: Refiner
    iterations: int
    starts_on_samples: bool
    ends_on_samples: bool
    partial: bool
    stop_when_unchanged: bool
    history: bool


@counts_iterations
@eqx.filter_jit
def refine(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    pointwise_map: Int[Array, " m"],
    *,
    refiner: Refiner = WaveletPreservation(),  # noqa: B008 (immutable)
    iterations: int = ITERATIONS,
    samples: Samples | None = None,
    starts_on_samples: bool = False,
    ends_on_samples: bool = False,
    partial: bool = False,
    stop_when_unchanged: bool = False,
    history: bool = False,
) -> Refinement:
    """Refine a pointwise map T: X -> Y by alternating between functional maps and pointwise maps.

    The loop is Algorithm 1 of the MWP paper, generalised to any refiner. The function is pure and
    jit-compiled. JAX compiles the function again only when sizes or static settings change. For many pairs of
    equal size, use `jax.vmap`, or `jax.lax.map` if memory is scarce. For pairs of different sizes, use
    `jaxsmw.refine_pairs`.

    If samples are given, only the first and the last step use all vertices. The first step computes a
    functional map from the initial map of all vertices. The last step recovers the refined map of all
    vertices. All steps in between use only the samples. The fast variant of the MWP authors' program also
    iterates on samples. `starts_on_samples` restricts the first step to the samples, and `ends_on_samples`
    restricts the last step to the samples. If one call ends on samples and the next call starts on the same
    samples, the two calls save one search of all vertices.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices) and of target Y (n vertices). Unless
      `partial` is True, each shape should have area 1, as from `compute_spectrum`.
    - `pointwise_map`: the initial map T, an integer array (m,). Entry i is the match of vertex i of X, as the
      index of a vertex of Y, from 0 to n - 1.
    - `refiner`: the method, a `Refiner`. The default is `WaveletPreservation()`, the method of the MWP paper.
    - `iterations`: the number of iterations, an integer of at least 1. Each iteration computes a functional
      map and then a pointwise map.
    - `samples`: a tuple of two integer arrays: the 0-based vertices of X (s_x,) and of Y (s_y,) on which the
      refinement iterates. The samples should be evenly spread and outnumber the eigenvectors. With None, all
      iterations use all vertices.
    - `starts_on_samples`: whether the first functional map is computed from the samples only. If True, the
      initial map of all other vertices of X is ignored.
    - `ends_on_samples`: whether the last step matches only the samples. If True, the refined map contains -1
      for each vertex of X that is not a sample.
    - `partial`: whether one shape is a part of the other. If True, both shapes must have the same unit of
      length.
    - `stop_when_unchanged`: whether to skip the remaining iterations once no match changes. Under `jax.vmap`,
      every pair takes as long as the slowest pair, but the results are the same as without `jax.vmap`.
    - `history`: whether to record a `History`. Recording increases the run time by about 10 %.

    **Returns:** A `Refinement`, whose attributes include `pointwise_map` (m,) with 0-based vertices of Y,
    `functional_map` (k_out, k_in) without unit, and `result`. Numerical failures raise no error, so compare
    `result` with `RESULTS.successful`. After a failure, all entries of `pointwise_map` are -1.

    **Raises:** `ValueError` if `iterations` is below 1, the initial map does not have shape (m,), `samples`
    is not a pair, or the two spectra have different float types. `ValueError` is also raised if
    `starts_on_samples` or `ends_on_samples` is True, but `samples` is None or
    `refiner.matches_samples_with_all` is False. `TypeError` if `iterations` or the entries of the initial map
    are not integers, or if another argument has the wrong type.
    """
    _check_arguments(spectrum_x, spectrum_y, pointwise_map, refiner, samples)
    check_samples_use(refiner, samples is not None, starts_on_samples, ends_on_samples)
    pointwise_map = pointwise_map.astype(jnp.int32)
    problem = Problem(spectrum_x, spectrum_y, samples, partial)
    prepared = in_full = refiner.prepare(dataclasses.replace(problem, samples=None))
    used, first_map = spectrum_x.mask, pointwise_map
    if samples is not None:
        prepared = refiner.prepare(problem)
        first_map = jnp.full(samples[0].shape, -1, jnp.int32)
    loop = _Loop(refiner, prepared, stop_when_unchanged, history, keeps_maps=history and samples is None)
    if samples is not None and starts_on_samples:
        used = used & jnp.zeros_like(used).at[samples[0]].set(True)
        first_map = pointwise_map[samples[0]]
        progress = loop.init(prepared, first_map, first_map)
    else:
        progress = loop.init(in_full, pointwise_map, first_map)
    if samples is None or ends_on_samples:
        # The last search is a part of the loop. Outside the loop, the search would have to be compiled a
        # second time, and a search takes longer to compile than any other part of the program.
        is_last = jnp.arange(iterations) == iterations - 1
        progress, records = lax.scan(loop.step, progress, is_last)
        refined = progress.pointwise_map
        if samples is not None:
            refined = jnp.full(pointwise_map.shape, -1, jnp.int32).at[samples[0]].set(refined)
    else:
        progress, records = lax.scan(loop.step, progress, jnp.zeros(iterations - 1, bool))
        refined = refiner.recover(in_full, progress.state)
        records = records.completed(progress.energy, loop.objective(in_full, progress.state, refined))
    if samples is not None and not starts_on_samples:
        records = records.without_first_change()
    result = diagnose(spectrum_x, spectrum_y, pointwise_map, progress.result, used)
    successful = result == RESULTS.successful
    return Refinement(
        jnp.where(successful, refined, -1),
        progress.state,
        result,
        progress.iterations,
        records.history(successful) if history else None,
    )


class _Progress(NamedTuple):
    """The variables of the refinement loop."""

    pointwise_map: Int32[Array, " s"]
    state: State
    result: RESULTS
    energy: Float[Array, ""]
    iterations: Int32[Array, ""]
    unchanged: Bool[Array, ""]
    finished: Bool[Array, ""]


class _Record(NamedTuple):
    """The values that `History` contains for one iteration.

    A stacked record contains the values for all iterations.
    """

    changed: Float[Array, "*iterations"]
    energy: Float[Array, "*iterations"]
    objective: Float[Array, "*iterations"]
    pointwise_map: Int32[Array, "*iterations m"] | None

    def completed(self, energy: Float[Array, ""], objective: Float[Array, ""]) -> _Record:
        """Append a last entry, for the search that matches all vertices after the iterations on samples.

        The last map cannot be compared with an earlier map of the same vertices, so its entry in `changed` is
        NaN.
        """
        return _Record(
            jnp.append(self.changed, jnp.asarray(jnp.nan, self.changed.dtype)),
            jnp.append(self.energy, energy),
            jnp.append(self.objective, objective),
            None,
        )

    def without_first_change(self) -> _Record:
        """Return the record with NaN as the first entry of `changed`.

        The first map of the samples cannot be compared with an earlier map.
        """
        return self._replace(changed=self.changed.at[:1].set(jnp.nan))

    def history(self, successful: Bool[Array, ""]) -> History:
        """Return the `History`. If the refinement failed, all entries of its pointwise maps are -1."""
        maps = self.pointwise_map
        if maps is not None:
            maps = jnp.where(successful, maps, -1)
        return History(self.changed, self.energy, self.objective, maps)


@dataclass(frozen=True, eq=False)
class _Loop:
    """Algorithm 1 of the MWP paper for one prepared problem.

    `init` computes the first state. Then each call of `step` runs one iteration, until `terminate` returns
    True. Each step recovers a pointwise map from the current state. Every step except the last step then
    computes the next state from this map.
    """

    refiner: Refiner
    prepared: Prepared
    stop_when_unchanged: bool
    history: bool
    keeps_maps: bool

    def init(
        self, in_full: Prepared, pointwise_map: Int32[Array, " m"], first_map: Int32[Array, " s"]
    ) -> _Progress:
        """Compute the first state from the initial map.

        `pointwise_map` is the initial map of all vertices or, with `starts_on_samples`, of the samples.

        The first iteration compares its map with `first_map` to count the changed matches. Usually
        `first_map` is the same as `pointwise_map`. If samples are given without `starts_on_samples`, all
        entries of `first_map` are -1.
        """
        state, result = self.refiner.update(in_full, pointwise_map, None)
        return _Progress(
            first_map,
            state,
            checked(state, result),
            self._energy(in_full, state, pointwise_map),
            iterations=jnp.asarray(1, jnp.int32),
            unchanged=jnp.asarray(False),
            finished=jnp.asarray(False),
        )

    def step(self, progress: _Progress, is_last: Bool[Array, ""]) -> tuple[_Progress, _Record]:
        """Run one iteration, or do nothing if the loop has terminated."""
        if not self.stop_when_unchanged:
            return self._iterate(progress, is_last)
        return lax.cond(
            self.terminate(progress), self._stay, self._iterate, progress, is_last | progress.unchanged
        )

    def terminate(self, progress: _Progress) -> Bool[Array, ""]:
        """Return whether the loop has finished its last iteration."""
        return progress.finished

    def objective(
        self, prepared: Prepared, state: State, pointwise_map: Int32[Array, " s"]
    ) -> Float[Array, ""]:
        """Return the objective of the map that was recovered from a state; NaN without a history."""
        return self.refiner.objective(prepared, state, pointwise_map) if self.history else self._undefined

    def _iterate(self, progress: _Progress, is_last: Bool[Array, ""]) -> tuple[_Progress, _Record]:
        after, previous = self.refiner.recover_both(self.prepared, progress.state)
        mask = self.prepared.spectrum_x.mask
        changed = jnp.sum((after != progress.pointwise_map) & mask) / jnp.sum(mask)
        record = _Record(
            changed.astype(self._undefined.dtype),
            progress.energy,
            self.objective(self.prepared, progress.state, after),
            after if self.keeps_maps else None,
        )

        def update() -> tuple[State, RESULTS, Array, Array]:
            state, result = self.refiner.update(self.prepared, after, previous)
            result = where(progress.result == RESULTS.successful, checked(state, result), progress.result)
            return state, result, self._energy(self.prepared, state, after), progress.iterations + 1

        def keep() -> tuple[State, RESULTS, Array, Array]:
            return progress.state, progress.result, progress.energy, progress.iterations

        state, result, energy, iterations = lax.cond(is_last, keep, update)
        unchanged = (changed == 0) & self.refiner.is_settled(progress.state)
        return _Progress(after, state, result, energy, iterations, unchanged, is_last), record

    def _stay(self, progress: _Progress, _: Bool[Array, ""]) -> tuple[_Progress, _Record]:
        undefined = self._undefined
        maps = progress.pointwise_map if self.keeps_maps else None
        return progress, _Record(undefined, undefined, undefined, maps)

    def _energy(self, prepared: Prepared, state: State, pointwise_map: Int[Array, " _"]) -> Float[Array, ""]:
        return self.refiner.energy(prepared, state, pointwise_map) if self.history else self._undefined

    @property
    def _undefined(self) -> Float[Array, ""]:
        return jnp.asarray(jnp.nan, self.prepared.spectrum_x.eigenvectors.dtype)


def _check_arguments(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    pointwise_map: Int[Array, " m"],
    refiner: Refiner,
    samples: Samples | None,
) -> None:
    check_kind("refiner", refiner, Refiner)
    check_spectra(spectrum_x, spectrum_y)
    check_kind("initial map", pointwise_map, np.ndarray, jax.Array)
    if samples is not None:
        if not isinstance(samples, tuple) or len(samples) != 2:
            raise ValueError(
                "samples must be a pair: give a tuple of the sampled vertices of X and the sampled vertices "
                "of Y"
            )
        check_kind("samples of X", samples[0], np.ndarray, jax.Array)
        check_kind("samples of Y", samples[1], np.ndarray, jax.Array)
    if pointwise_map.shape != spectrum_x.mask.shape:
        raise ValueError(
            f"the initial map has shape {pointwise_map.shape}, but X has {len(spectrum_x.mask)} vertices: "
            "give one vertex of Y for each vertex of X"
        )
    if not jnp.issubdtype(pointwise_map.dtype, jnp.integer):
        raise TypeError(
            f"the initial map has type {pointwise_map.dtype}, but its entries must be integer vertex indices"
        )


def check_samples_use(refiner: Refiner, sampled: bool, starts: bool, ends: bool) -> None:
    """Check the arguments `starts_on_samples` and `ends_on_samples` of `refine`.

    **Raises:** `InputError` if one of the two arguments is True, but there are no samples, or
    `refiner.matches_samples_with_all` is False.
    """
    if not (starts or ends):
        return
    if not sampled:
        raise InputError(
            "refinement cannot start or end on samples, because there are no samples: give samples."
        )
    if not refiner.matches_samples_with_all:
        raise InputError(
            f"{type(refiner).__name__} matches samples of X with samples of Y, so refinement cannot start or "
            "end on samples: use FeatureRegression or Registration."
        )


def check_spectra(spectrum_x: Spectrum, spectrum_y: Spectrum) -> None:
    """Check that both arguments are spectra and have the same float type.

    **Raises:** `TypeError` if an argument is not a `Spectrum`; `ValueError` if the spectra have different
    float types.
    """
    check_kind("spectrum of X", spectrum_x, Spectrum)
    check_kind("spectrum of Y", spectrum_y, Spectrum)
    dtype_x, dtype_y = spectrum_x.eigenvectors.dtype, spectrum_y.eigenvectors.dtype
    if dtype_x != dtype_y:
        raise ValueError(
            f"the spectrum of X has type {dtype_x}, but the spectrum of Y has type {dtype_y}: compute both "
            "spectra with the same jax_enable_x64"
        )


def checked(state: State, result: RESULTS) -> RESULTS:
    """Check the state that an update computed, and return the status code of the update.

    If `result` is a failure, this failure is returned unchanged. A state also counts as a failure if it
    contains NaN or infinity, or if all entries of its functional map are zero.
    """
    went_well = result == RESULTS.successful
    finite, zero = all_finite(state), jnp.all(state.functional_map == 0)
    result = where(went_well & zero, RESULTS.undetermined_functional_map, result)
    return where(went_well & ~finite, RESULTS.nonfinite_functional_map, result)


def diagnose(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    matches: Int[Array, "m ..."] | None,
    result: RESULTS,
    used: Bool[Array, " m"] | None = None,
) -> RESULTS:
    """Check the inputs of a refinement, and return the status code of the refinement.

    If a spectrum contains NaN or infinity, or the initial map is invalid, the status code names this fault.
    If the inputs are valid, `result` is returned unchanged.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `matches`: the initial map (m, ...), as one or several vertices of Y per vertex of X; None for a dense
      soft map, which contains no vertex indices.
    - `result`: the status code of the refinement loop.
    - `used`: a mask of the vertices of X whose matches must be valid (m,). The default is the mask of X.
    """
    if matches is not None:
        vertices_y = spectrum_y.mask.shape[0]
        in_range = (matches >= 0) & (matches < vertices_y)
        valid = in_range & spectrum_y.mask[jnp.clip(matches, 0, vertices_y - 1)]
        valid = jnp.all(valid.reshape(valid.shape[0], -1), axis=1)
        checked_vertices = spectrum_x.mask if used is None else used
        result = where(jnp.all(valid | ~checked_vertices), result, RESULTS.invalid_initial_map)
    return where(all_finite((spectrum_x, spectrum_y)), result, RESULTS.nonfinite_spectrum)
