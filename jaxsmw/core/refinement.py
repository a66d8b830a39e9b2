"""The refinement loop, which alternates between functional maps and pointwise maps for any refiner."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

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


class History(eqx.Module):
    """A record of each iteration. Numbers are NaN for iterations that an early stop skipped.

    **Attributes:**

    - `changed`: (iterations,), the share of source vertices whose match changed. With samples, `changed` is
      the share of samples. It is then NaN in the first and last iteration, which have no earlier map to
      compare with.
    - `energy`: (iterations,), `Refiner.energy` of the state and the pointwise map from which the state
      follows; for `WaveletPreservation` the energy of eq. (5).
    - `objective`: (iterations,), `Refiner.objective` of the state and the map recovered from the state.
    - `pointwise_maps`: (iterations, m), the map recovered in each iteration. Skipped iterations repeat the
      last map; a failure fills all entries with -1. None with samples, because the iterations then map only
      the samples.
    """

    changed: Float[Array, " iterations"]
    energy: Float[Array, " iterations"]
    objective: Float[Array, " iterations"]
    pointwise_maps: Int32[Array, "iterations m"] | None


class Refinement(eqx.Module):
    """The outcome of `refine`, a pytree.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), one vertex of Y per vertex of X; all -1 after a failure.
    - `functional_map`: the C (k_out, k_in) from which the pointwise map was recovered.
    - `state`: the refiner's last state.
    - `result`: a member of `RESULTS`; compare it with `RESULTS.successful`.
    - `iterations`: the number of iterations done, fewer than requested after an early stop.
    - `history`: a `History` if requested, else None.
    """

    pointwise_map: Int32[Array, " m"]
    state: State
    result: RESULTS
    iterations: Int32[Array, ""]
    history: History | None

    @property
    def functional_map(self) -> Float[Array, "*batch k_out k_in"]:
        """The functional map of the last state."""
        return self.state.functional_map

    def unpadded(self, number_of_vertices: int) -> Refinement:
        """Returns the same outcome without the vertices that `Spectrum.pad` added to X.

        **Arguments:**

        - `number_of_vertices`: the number of vertices of X before padding.
        """
        history = self.history
        if history is not None and history.pointwise_maps is not None:
            maps = history.pointwise_maps[:, :number_of_vertices]
            history = dataclasses.replace(history, pointwise_maps=maps)
        kept = self.pointwise_map[:number_of_vertices]
        return dataclasses.replace(self, pointwise_map=kept, history=history)


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
    partial: bool = False,
    stop_when_unchanged: bool = False,
    history: bool = False,
) -> Refinement:
    """Refine a pointwise map T: X -> Y by alternating functional and pointwise maps (Algorithm 1).

    The function is pure and jit-compiled. It is compiled again only when sizes or static settings change. For
    many pairs of equal size use `jax.vmap`, or `jax.lax.map` if memory is scarce.

    With samples, the first functional map is computed from all vertices, the iterations run on the samples,
    and the last search is over all vertices. With `WaveletPreservation`, this is the MWP authors' fast
    variant.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `pointwise_map`: the initial map T (m,), one vertex of Y per vertex of X.
    - `refiner`: the method.
    - `iterations`: the number of functional maps, each followed by its pointwise map; an integer, at least 1.
    - `samples`: vertices of X (s_x,) and of Y (s_y,) on which to iterate. They should be evenly spread and
      outnumber the eigenvectors.
    - `partial`: whether one shape is a part of the other. Both shapes must then have the same unit of length.
    - `stop_when_unchanged`: whether to skip the remaining iterations once no match changes. (Under `vmap`
      every pair takes as long as the slowest pair, but has the same result as alone.)
    - `history`: whether to record a `History`, which takes about a tenth more time.

    **Returns:** A `Refinement`. Numerical failures raise no error: check the attribute `result`.

    **Raises:** `ValueError` for fewer than one iteration, an initial map that is not one vertex per vertex of
    X, samples that are not a pair, or spectra of two float types; `TypeError` if `iterations` or the entries
    of the initial map are not integers, or another argument has the wrong type.
    """
    _check_arguments(spectrum_x, spectrum_y, pointwise_map, refiner, samples)
    pointwise_map = pointwise_map.astype(jnp.int32)
    problem = Problem(spectrum_x, spectrum_y, samples, partial)
    prepared = in_full = refiner.prepare(dataclasses.replace(problem, samples=None))
    first_map = pointwise_map
    if samples is not None:
        prepared = refiner.prepare(problem)
        first_map = jnp.full(samples[0].shape, -1, jnp.int32)
    loop = _Loop(refiner, prepared, stop_when_unchanged, history, keeps_maps=history and samples is None)
    progress = loop.init(in_full, pointwise_map, first_map)
    if samples is None:
        # The last search is an iteration of the same loop, because a search takes longer to compile than
        # anything else.
        is_last = jnp.arange(iterations) == iterations - 1
        progress, records = lax.scan(loop.step, progress, is_last)
        refined = progress.pointwise_map
    else:
        progress, records = lax.scan(loop.step, progress, jnp.zeros(iterations - 1, bool))
        refined, _, objective = loop.search(in_full, progress.state, pointwise_map)
        records = records.completed(progress.energy, objective)
    result = diagnose(spectrum_x, spectrum_y, pointwise_map, progress.result)
    successful = result == RESULTS.successful
    return Refinement(
        jnp.where(successful, refined, -1),
        progress.state,
        result,
        progress.iterations,
        records.history(successful) if history else None,
    )


class _Progress(NamedTuple):
    """The variables of the loop."""

    pointwise_map: Int32[Array, " s"]
    state: State
    result: RESULTS
    energy: Float[Array, ""]
    iterations: Int32[Array, ""]
    unchanged: Bool[Array, ""]
    finished: Bool[Array, ""]


class _Record(NamedTuple):
    """The entries of the `History` for one iteration or, stacked, for all iterations."""

    changed: Float[Array, "*iterations"]
    energy: Float[Array, "*iterations"]
    objective: Float[Array, "*iterations"]
    pointwise_map: Int32[Array, "*iterations m"] | None

    def completed(self, energy: Float[Array, ""], objective: Float[Array, ""]) -> _Record:
        """Returns the record of a loop on samples, extended by the last iteration, a search of all vertices.

        The first map of the samples and the last map of all vertices have no earlier map to compare with.
        """
        undefined = jnp.asarray(jnp.nan, self.changed.dtype)
        return _Record(
            jnp.append(self.changed.at[:1].set(undefined), undefined),
            jnp.append(self.energy, energy),
            jnp.append(self.objective, objective),
            None,
        )

    def history(self, successful: Bool[Array, ""]) -> History:
        """Returns the `History`. All entries of its maps are -1 if the refinement was not successful."""
        maps = self.pointwise_map
        if maps is not None:
            maps = jnp.where(successful, maps, -1)
        return History(self.changed, self.energy, self.objective, maps)


@dataclass(frozen=True, eq=False)
class _Loop:
    """Algorithm 1 on one prepared problem: `init`, then `step` until `terminate`.

    A step searches for the pointwise map of the current state, then updates the state. The last step does not
    update the state.
    """

    refiner: Refiner
    prepared: Prepared
    stop_when_unchanged: bool
    history: bool
    keeps_maps: bool

    def init(
        self, in_full: Prepared, pointwise_map: Int32[Array, " m"], first_map: Int32[Array, " s"]
    ) -> _Progress:
        """Computes the first state, from the initial map of all vertices.

        `first_map` is compared with the map of the first iteration. It is the initial map or, with samples,
        an array of -1.
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
        """Runs one iteration, or nothing if the loop has terminated."""
        if not self.stop_when_unchanged:
            return self._iterate(progress, is_last)
        return lax.cond(
            self.terminate(progress), self._stay, self._iterate, progress, is_last | progress.unchanged
        )

    def terminate(self, progress: _Progress) -> Bool[Array, ""]:
        """Returns whether the last iteration is done."""
        return progress.finished

    def search(
        self, prepared: Prepared, state: State, before: Int32[Array, " s"]
    ) -> tuple[Int32[Array, " s"], Float[Array, ""], Float[Array, ""]]:
        """Returns the pointwise map of a state, the share of matches that changed, and the objective."""
        after = self.refiner.recover(prepared, state)
        mask = prepared.spectrum_x.mask
        changed = jnp.sum((after != before) & mask) / jnp.sum(mask)
        objective = self.refiner.objective(prepared, state, after) if self.history else self._undefined
        return after, changed.astype(self._undefined.dtype), objective

    def _iterate(self, progress: _Progress, is_last: Bool[Array, ""]) -> tuple[_Progress, _Record]:
        after, changed, objective = self.search(self.prepared, progress.state, progress.pointwise_map)
        record = _Record(changed, progress.energy, objective, after if self.keeps_maps else None)

        def update() -> tuple[State, RESULTS, Array, Array]:
            state, result = self.refiner.update(self.prepared, after, progress.state)
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
            raise ValueError("samples must be a pair: the sampled vertices of X and those of Y")
        check_kind("samples of X", samples[0], np.ndarray, jax.Array)
        check_kind("samples of Y", samples[1], np.ndarray, jax.Array)
    if pointwise_map.shape != spectrum_x.mask.shape:
        raise ValueError(
            f"the initial map has shape {pointwise_map.shape}, but X has {len(spectrum_x.mask)} vertices: "
            "give one vertex of Y for each vertex of X"
        )
    if not jnp.issubdtype(pointwise_map.dtype, jnp.integer):
        raise TypeError(f"the initial map has type {pointwise_map.dtype}; it must be integer vertex indices")


def check_spectra(spectrum_x: Spectrum, spectrum_y: Spectrum) -> None:
    """Checks that two spectra can be refined together.

    **Raises:** `TypeError` if an argument is not a `Spectrum`; `ValueError` if the float types differ.
    """
    check_kind("spectrum of X", spectrum_x, Spectrum)
    check_kind("spectrum of Y", spectrum_y, Spectrum)
    dtype_x, dtype_y = spectrum_x.eigenvectors.dtype, spectrum_y.eigenvectors.dtype
    if dtype_x != dtype_y:
        raise ValueError(
            f"the spectrum of X is {dtype_x} and that of Y {dtype_y}: compute both with the same "
            "jax_enable_x64"
        )


def checked(state: State, result: RESULTS) -> RESULTS:
    """Returns how an update ended: a failure that the update reports, or else a fault of its state.

    The faults of a state are NaN, infinity, and a functional map of zeros.
    """
    went_well = result == RESULTS.successful
    finite, zero = all_finite(state), jnp.all(state.functional_map == 0)
    result = where(went_well & zero, RESULTS.undetermined_functional_map, result)
    return where(went_well & ~finite, RESULTS.nonfinite_functional_map, result)


def diagnose(
    spectrum_x: Spectrum, spectrum_y: Spectrum, matches: Int[Array, "m ..."] | None, result: RESULTS
) -> RESULTS:
    """Returns how a refinement ended: a fault of the spectra or of the initial map, or else `result`.

    `matches` are the vertices of Y in the initial map, one or several per vertex of X (m, ...). They are None
    if the initial map contains no vertex indices.
    """
    if matches is not None:
        vertices_y = spectrum_y.mask.shape[0]
        in_range = (matches >= 0) & (matches < vertices_y)
        valid = in_range & spectrum_y.mask[jnp.clip(matches, 0, vertices_y - 1)]
        valid = jnp.all(valid.reshape(valid.shape[0], -1), axis=1)
        result = where(jnp.all(valid | ~spectrum_x.mask), result, RESULTS.invalid_initial_map)
    return where(all_finite((spectrum_x, spectrum_y)), result, RESULTS.nonfinite_spectrum)
