"""The refinement loop, which alternates between functional maps and pointwise maps for any refiner."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypedDict

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from jaxsmw.choices import ITERATIONS
from jaxsmw.core.arrays import Array, cond, namespace, replaced, scan
from jaxsmw.core.checks import all_finite, check_array, check_kind, check_matches, counts_iterations
from jaxsmw.core.module import Module, jitted
from jaxsmw.core.refiner import Prepared, Problem, Refiner, Samples, State
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError


class History(NamedTuple):
    """A record of the iterations of `refine`, stored in `Refinement.history` if `history=True`.

    If the refinement stopped early, `changed`, `energy` and `objective` are NaN for the skipped iterations.

    **Attributes:**

    - `changed`: (iterations,), the share of X's vertices whose match changed in each iteration, from 0 to 1.
      With samples, only the samples of X count. The first entry is then NaN unless `starts_on_samples` is
      True, and the last entry is NaN unless `ends_on_samples` is True.
    - `energy`: (iterations,), the result of `Refiner.energy` for each state and the map that produced it. For
      `WaveletPreservation`, this is the energy of equation (5) of the MWP paper, which has no unit.
    - `objective`: (iterations,), the result of `Refiner.objective` for each state and the map that was
      recovered from it: the mean squared distance between matched points of the embeddings.
    - `pointwise_maps`: (iterations, m), the map X -> Y that was recovered in each iteration, 0-based. The
      rows of skipped iterations repeat the final map. After a failure, all entries are -1. With samples,
      `pointwise_maps` is None, because the iterations then map only the samples.
    """

    changed: Float[Array, "*iterations"]
    energy: Float[Array, "*iterations"]
    objective: Float[Array, "*iterations"]
    pointwise_maps: Int32[Array, "*iterations m"] | None


class Refinement(Module):
    """The outcome of `refine`, a pytree.

    **Attributes:**

    - `pointwise_map`: the refined map T: X -> Y (m,), one 0-based vertex of Y per vertex of X; all entries
      are -1 after a failure.
    - `functional_map`: the functional map C (k_out, k_in), without unit, from which the pointwise map was
      recovered, in the refiner's `convention`. By default, C is a pullback (k_X, k_Y), which takes functions
      on Y to functions on X. After a failure, C contains NaN or meaningless numbers.
    - `state`: the final `State` of the refiner, which contains the functional map.
    - `result`: the status code, a member of `RESULTS`. `RESULTS[result]` is a sentence that explains it.
    - `iterations`: the number of iterations that were run, fewer than requested if the refinement stopped
      early.
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
        """Return the refinement without the vertices that `Spectrum.pad` added to X.

        `number_of_vertices` is the number of vertices of X before padding.
        """
        history = self.history
        if history is not None and history.pointwise_maps is not None:
            maps = history.pointwise_maps[:, :number_of_vertices]
            history = history._replace(pointwise_maps=maps)
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
@jitted
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
    jit-compiled. For many pairs, use `jax.vmap`, which is a loop on CPUs, or `jaxsmw.refine_pairs`.

    If samples are given, only the first functional map and the last pointwise map are computed from all
    vertices, as in the fast variant of the MWP authors' program. `starts_on_samples` and `ends_on_samples`
    restrict these two steps to the samples. If one call ends on samples and the next call starts on the same
    samples, the two calls save one search of all vertices.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices) and of target Y (n vertices). Unless
      `partial` is True, each shape should have area 1, as from `compute_spectrum`.
    - `pointwise_map`: the initial map T, an integer array (m,) of 0-based vertices of Y.
    - `refiner`: the method, a `Refiner`. The default is `WaveletPreservation()`, the method of the MWP paper.
    - `iterations`: the number of iterations, an integer of at least 1; 3 by default. Each iteration computes
      a functional map and then a pointwise map.
    - `samples`: a tuple of two integer arrays: the 0-based vertices of X (s_x,) and of Y (s_y,) on which the
      refinement iterates. The samples should be evenly spread and outnumber the eigenvectors. With None, all
      iterations use all vertices.
    - `starts_on_samples`: whether the first functional map is computed from the samples only. The initial map
      of all other vertices of X is then ignored.
    - `ends_on_samples`: whether the last step matches only the samples. The refined map then contains -1 for
      each vertex of X that is not a sample.
    - `partial`: whether one shape is a part of the other. Both shapes then need the same unit of length.
    - `stop_when_unchanged`: whether to skip the remaining iterations once no match changes. Under `jax.vmap`
      on accelerators, every pair takes as long as the slowest pair, with the same results.
    - `history`: whether to record a `History`, which increases the run time by about 10 %.

    **Returns:** A `Refinement`. Numerical failures raise no error, so compare its `result` with
    `RESULTS.successful`. After a failure, all entries of its `pointwise_map` are -1.

    **Raises:** `ValueError` if `iterations` is below 1, the initial map does not have shape (m,), `samples`
    is not a pair, or the two spectra have different float types. `ValueError` is also raised if
    `starts_on_samples` or `ends_on_samples` is True, but `samples` is None or
    `refiner.matches_samples_with_all` is False. `TypeError` if `iterations` or the entries of the initial map
    are not integers, or if another argument has the wrong type.
    """
    _check_arguments(spectrum_x, spectrum_y, pointwise_map, refiner, samples)
    check_samples_use(refiner, samples is not None, starts_on_samples, ends_on_samples)
    xp = namespace(spectrum_x.eigenvectors, spectrum_y.eigenvectors, pointwise_map)
    # `diagnose` reports invalid matches. NumPy would raise an error for an index out of range.
    initial_map, last = pointwise_map.astype(xp.int32), spectrum_y.mask.shape[0] - 1
    pointwise_map = xp.clip(initial_map, 0, last)
    problem = Problem(spectrum_x, spectrum_y, samples, partial)
    prepared = in_full = refiner.prepare(dataclasses.replace(problem, samples=None))
    used, first_map = spectrum_x.mask, pointwise_map
    if samples is not None:
        prepared = refiner.prepare(problem)
        first_map = xp.full(samples[0].shape, -1, xp.int32)
    loop = _Loop(refiner, prepared, stop_when_unchanged, history, keeps_maps=history and samples is None)
    if samples is not None and starts_on_samples:
        used = used & replaced(xp.zeros_like(used), samples[0], True)
        first_map = pointwise_map[samples[0]]
        progress = loop.start(prepared, first_map, first_map)
    else:
        progress = loop.start(in_full, pointwise_map, first_map)
    if samples is None or ends_on_samples:
        # The last search is a part of the loop. Outside the loop, the search would have to be compiled a
        # second time, and a search takes longer to compile than any other part of the program.
        is_last = xp.arange(iterations) == iterations - 1
        progress, records = scan(loop.step, progress, is_last)
        refined = progress.pointwise_map
        if samples is not None:
            refined = replaced(xp.full(pointwise_map.shape, -1, xp.int32), samples[0], refined)
    else:
        nothing = xp.zeros(0, loop.undefined.dtype)
        records = History(nothing, nothing, nothing, None)
        if iterations > 1:
            progress, records = scan(loop.step, progress, xp.zeros(iterations - 1, bool))
        refined = refiner.recover(in_full, progress.state)
        objective = loop.recorded(refiner.objective, in_full, progress.state, refined)
        # There is no map to compare `refined` with.
        records = History(
            xp.append(records.changed, loop.undefined),
            xp.append(records.energy, progress.energy),
            xp.append(records.objective, objective),
            None,
        )
    if samples is not None and not starts_on_samples:
        # The first map of the samples has no predecessor either.
        records = records._replace(changed=replaced(records.changed, slice(1), xp.nan))
    result = diagnose(spectrum_x, spectrum_y, initial_map, progress.result, used)
    successful = result == RESULTS.successful
    refined = xp.where(successful, refined, -1)
    if records.pointwise_maps is not None:
        maps = xp.where(successful, records.pointwise_maps, -1)
        records = records._replace(pointwise_maps=maps)
    recorded = records if history else None
    return Refinement(refined, progress.state, result, progress.iterations, recorded)


# `refine` without compilation. The arrays can be of NumPy if the refiner takes its namespace from its arrays.
refine_at_once = inspect.unwrap(refine)


class _Progress(NamedTuple):
    """The variables of the refinement loop."""

    pointwise_map: Int32[Array, " s"]
    state: State
    result: RESULTS
    energy: Float[Array, ""]
    iterations: Int32[Array, ""]
    unchanged: Bool[Array, ""]
    finished: Bool[Array, ""]


@dataclass(frozen=True, eq=False)
class _Loop:
    """Algorithm 1 of the MWP paper for one prepared problem.

    Each step recovers a pointwise map from the current state. Every step except the last step then computes
    the next state from this map.
    """

    refiner: Refiner
    prepared: Prepared
    stop_when_unchanged: bool
    history: bool
    keeps_maps: bool

    def start(
        self, prepared: Prepared, pointwise_map: Int32[Array, " m"], first_map: Int32[Array, " s"]
    ) -> _Progress:
        """Compute the first state from the initial map. The first step compares its map with `first_map`."""
        xp = namespace(pointwise_map)
        state, result = _update(self.refiner, prepared, pointwise_map, None)
        return _Progress(
            first_map,
            state,
            checked(state, result),
            self.recorded(self.refiner.energy, prepared, state, pointwise_map),
            iterations=xp.asarray(1, xp.int32),
            unchanged=xp.asarray(False),
            finished=xp.asarray(False),
        )

    def step(self, progress: _Progress, is_last: Bool[Array, ""]) -> tuple[_Progress, History]:
        """Run one iteration, or do nothing if the loop has finished."""
        if not self.stop_when_unchanged:
            return self._iterate(progress, is_last)
        return cond(progress.finished, self._stay, self._iterate, progress, is_last | progress.unchanged)

    def recorded(
        self, measure: Callable[..., Float[Array, ""]], *arguments: Prepared | State | Int32[Array, " s"]
    ) -> Float[Array, ""]:
        """Return the measure, or NaN without a history."""
        return measure(*arguments) if self.history else self.undefined

    @property
    def undefined(self) -> Float[Array, ""]:
        eigenvectors = self.prepared.spectrum_x.eigenvectors
        return namespace(eigenvectors).asarray(np.nan, eigenvectors.dtype)

    def _iterate(self, progress: _Progress, is_last: Bool[Array, ""]) -> tuple[_Progress, History]:
        after, previous = self.refiner.recover_both(self.prepared, progress.state)
        mask, xp = self.prepared.spectrum_x.mask, namespace(after)
        changed = xp.sum((after != progress.pointwise_map) & mask) / xp.sum(mask)
        record = History(
            changed.astype(self.undefined.dtype),
            progress.energy,
            self.recorded(self.refiner.objective, self.prepared, progress.state, after),
            after if self.keeps_maps else None,
        )

        def update() -> tuple[State, RESULTS, Array, Array]:
            state, result = _update(self.refiner, self.prepared, after, previous)
            result = where(progress.result == RESULTS.successful, checked(state, result), progress.result)
            energy = self.recorded(self.refiner.energy, self.prepared, state, after)
            return state, result, energy, progress.iterations + 1

        def keep() -> tuple[State, RESULTS, Array, Array]:
            return progress.state, progress.result, progress.energy, progress.iterations

        state, result, energy, iterations = cond(is_last, keep, update)
        unchanged = (changed == 0) & self.refiner.is_settled(progress.state)
        return _Progress(after, state, result, energy, iterations, unchanged, is_last), record

    def _stay(self, progress: _Progress, _: Bool[Array, ""]) -> tuple[_Progress, History]:
        maps = progress.pointwise_map if self.keeps_maps else None
        return progress, History(self.undefined, self.undefined, self.undefined, maps)


def _update(
    refiner: Refiner, prepared: Prepared, pointwise_map: Int32[Array, " s"], previous: State | None
) -> tuple[State, RESULTS]:
    """Return what `update` of the refiner returns, or raise `TypeError` if it is no state with a status."""
    updated: Any = refiner.update(prepared, pointwise_map, previous)
    if not isinstance(updated, tuple) or len(updated) != 2 or not isinstance(updated[0], State):
        raise TypeError(
            f"{type(refiner).__name__}.update must return a State and a status code: return "
            "State(functional_map), RESULTS.successful"
        )
    return updated


def _check_arguments(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    pointwise_map: Int[Array, " m"],
    refiner: Refiner,
    samples: Samples | None,
) -> None:
    check_kind("refiner", refiner, Refiner, "WaveletPreservation()")
    check_spectra(spectrum_x, spectrum_y)
    check_matches("initial map", pointwise_map, len(spectrum_x.mask))
    if samples is not None:
        if not isinstance(samples, tuple) or len(samples) != 2:
            raise ValueError(
                "samples must be a pair: give a tuple of the sampled vertices of X and the sampled vertices "
                "of Y"
            )
        check_array("samples of X", samples[0])
        check_array("samples of Y", samples[1])


def check_samples_use(refiner: Refiner, sampled: bool, starts: bool, ends: bool) -> None:
    """Raise `InputError` if refinement cannot start or end on samples; see `refine`."""
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
    """Raise `TypeError` or `ValueError` unless both arguments are spectra of the same float type."""
    check_kind("spectrum of X", spectrum_x, Spectrum)
    check_kind("spectrum of Y", spectrum_y, Spectrum)
    dtype_x, dtype_y = spectrum_x.eigenvectors.dtype, spectrum_y.eigenvectors.dtype
    if dtype_x != dtype_y:
        raise ValueError(
            f"the spectrum of X has type {dtype_x}, but the spectrum of Y has type {dtype_y}: compute both "
            "spectra with the same jax_enable_x64"
        )


def checked(state: State, result: RESULTS) -> RESULTS:
    """Return the status code of an update, or of a failure of its state.

    A state is a failure if it contains NaN or infinity, or if its functional map is zero.
    """
    went_well = result == RESULTS.successful
    functional_map = state.functional_map
    finite, zero = all_finite(state), namespace(functional_map).all(functional_map == 0)
    result = where(went_well & zero, RESULTS.undetermined_functional_map, result)
    return where(went_well & ~finite, RESULTS.nonfinite_functional_map, result)


def diagnose(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    matches: Int[Array, "m ..."] | None,
    result: RESULTS,
    used: Bool[Array, " m"] | None = None,
) -> RESULTS:
    """Return the status code `result` of a refinement, or the code of a fault of its inputs.

    A spectrum is faulty if it contains NaN or infinity. `matches` are one or several vertices of Y per vertex
    of X, which must be valid where `used` is True; by default, on the mask of X. A dense soft map has no
    matches.
    """
    if matches is not None:
        xp = namespace(spectrum_y.mask, matches)
        vertices_y = spectrum_y.mask.shape[0]
        in_range = (matches >= 0) & (matches < vertices_y)
        valid = in_range & spectrum_y.mask[xp.clip(matches, 0, vertices_y - 1)]
        valid = xp.all(valid.reshape(valid.shape[0], -1), axis=1)
        checked_vertices = spectrum_x.mask if used is None else used
        result = where(xp.all(valid | ~checked_vertices), result, RESULTS.invalid_initial_map)
    return where(all_finite((spectrum_x, spectrum_y)), result, RESULTS.nonfinite_spectrum)
