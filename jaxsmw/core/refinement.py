"""The loop between functional and pointwise map. Every refiner plugs its half-steps into it."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.core.banks import FilterBank, Meyer, sample_bank
from jaxsmw.core.checks import all_finite, check_choice, check_kind, counts_iterations
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.pointwise_map import Search, chosen_patches, decode, spectral_embeddings
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.soft_maps import PointwiseMap
from jaxsmw.core.solutions import Filtering, Solution, WaveletProblem
from jaxsmw.core.spectrum import Spectrum


class Problem(eqx.Module):
    """A pair of shapes and what a refiner prepared for it once, to be used in every iteration."""

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    prepared: Any = None


Samples = tuple[Int[Array, " s_x"], Int[Array, " s_y"]]
"""Vertices of X and of Y that stand for all."""


class Refiner(eqx.Module):
    """One method of refinement: how a functional map follows from a pointwise map, and the way back.

    `refine` hands on between the half-steps whatever pytree `update` makes; for most methods that is the
    functional map itself, otherwise `functional_map` says how to get it.
    """

    @abc.abstractmethod
    def prepare(self, spectrum_x: Spectrum, spectrum_y: Spectrum, samples: Samples | None = None) -> Problem:
        """Compute what stays the same in all iterations: among all vertices, or on samples of them.

        The problem's `spectrum_x` is that of the vertices to be matched.
        """

    @abc.abstractmethod
    def update(
        self,
        problem: Problem,
        pointwise_map: Int[Array, " m"],
        previous: Any,
    ) -> tuple[Any, RESULTS]:
        """The functional map that follows from a pointwise map, and how its computation ended.

        `previous` is the one that the pointwise map was recovered from; None in the first iteration.
        """

    @abc.abstractmethod
    def recover(self, problem: Problem, updated: Any) -> Int32[Array, " m"]:
        """The pointwise map that follows from a functional map."""

    @abc.abstractmethod
    def energy(self, problem: Problem, updated: Any, pointwise_map: Int[Array, " m"]) -> Float[Array, ""]:
        """What the method wants to be small, for the history."""

    def functional_map(self, updated: Any) -> Float[Array, "k_out k_in"]:
        """The functional map in what `update` made."""
        return updated

    def embeddings(self, problem: Problem, updated: Any) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Two point sets, of the vertices to be matched and of all of Y, in which matches lie close together.

        In the units of the method. Points on triangles are found between them.
        """
        return spectral_embeddings(self.functional_map(updated), problem.spectrum_x, problem.spectrum_y)

    def objective(self, problem: Problem, updated: Any, pointwise_map: Int[Array, " m"]) -> Float[Array, ""]:
        """The area-weighted mean squared distance between matched embeddings, for the history."""
        queries, database = self.embeddings(problem, updated)
        areas = problem.spectrum_x.vertex_areas
        return jnp.sum(areas * jnp.sum((queries - database[pointwise_map]) ** 2, axis=1)) / jnp.sum(areas)

    def is_settled(self, updated: Any) -> Bool[Array, ""]:
        """Whether matches that no longer change will stay as they are: not while settings still vary."""
        return jnp.asarray(True)


class History(eqx.Module):
    """What happened in each iteration; NaN for iterations that an early stop made needless.

    **Attributes:**

    - `changed`: (iterations,), share of source vertices whose match changed. While iterating on samples it
      is the share of samples; NaN where there is nothing to compare with (their first and last iteration).
    - `energy`: (iterations,), `Refiner.energy` of the functional map and the pointwise map it was made of;
      for `WaveletPreservation` the energy of eq. (5).
    - `objective`: (iterations,), `Refiner.objective` of the functional map and the map recovered from it.
    - `pointwise_maps`: (iterations, m), the map recovered in each iteration; after an early stop the last
      one, -1 throughout on failure. None when iterating on samples: those turns map no other vertices.
    """

    changed: Float[Array, " iterations"]
    energy: Float[Array, " iterations"]
    objective: Float[Array, " iterations"]
    pointwise_maps: Int32[Array, "iterations m"] | None


class Refinement(eqx.Module):
    """The outcome of `refine`, a pytree.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), one vertex of Y per vertex of X; -1 throughout on failure.
    - `functional_map`: the C that gave it.
    - `updated`: what the refiner's last update made, for its other methods; often C itself.
    - `result`: a member of `RESULTS`; compare with `RESULTS.successful`.
    - `iterations`: how many were done (fewer than asked for after an early stop).
    - `history`: a `History` when asked for, else None.
    """

    pointwise_map: Int32[Array, " m"]
    functional_map: Float[Array, "k_out k_in"]
    updated: Any
    result: RESULTS
    iterations: Int32[Array, ""]
    history: History | None

    def unpadded(self, number_of_vertices: int) -> Refinement:
        """The same without what `Spectrum.pad` added to X."""
        history = self.history
        if history is not None and history.pointwise_maps is not None:
            maps = history.pointwise_maps[:, :number_of_vertices]
            history = dataclasses.replace(history, pointwise_maps=maps)
        kept = self.pointwise_map[:number_of_vertices]
        return dataclasses.replace(self, pointwise_map=kept, history=history)


class WaveletPreservation(Refiner):
    """Multiscale spectral manifold wavelets preservation: Algorithm 1 of the MWP paper, with any frame.

    The functional map preserves the wavelets of all scales, the pointwise map is its nearest neighbours.

    **Arguments:**

    - `bank`: the filters.
    - `solution`: how the functional map is found. `Filtering()` (eq. 8) is meant for Parseval frames, whose
      filters' squares sum to one; `LeastSquares()` is exact for every frame; `RegularizedLeastSquares()`
      adds other wishes.
    - `convention`: which way C goes; see `jaxsmw.core.functional_map`. `"pushforward"`, as the paper
      prints, is there for study: on real pairs it fails (`spectral_embeddings` says why).
    - `lambda_max`: where the bank ends: `"own"`, each shape's largest eigenvalue, which makes a difference
      in size cancel; or `"common"`, that of both shapes' eigenvalues taken together.
    - `search`: how nearest neighbours are found. `"exhaustive"` compares all with all; `"patches"` finds the
      same but leaves out patches of the target that are too far away, which is several times as fast on a
      CPU but takes seconds longer to compile; `"auto"` does that on CPUs from 15 000 vertices.

    **Raises:** `TypeError` for what is no bank or solution; `ValueError` for another choice.
    """

    bank: FilterBank = Meyer()
    solution: Solution = Filtering()
    convention: Convention = eqx.field(static=True, default="pullback")
    lambda_max: Literal["own", "common"] = eqx.field(static=True, default="own")
    search: Search = eqx.field(static=True, default="auto")

    def __check_init__(self) -> None:
        check_kind("bank", self.bank, FilterBank)
        check_kind("solution", self.solution, Solution)
        check_choice("convention", self.convention, get_args(Convention))
        check_choice("lambda_max", self.lambda_max, ("own", "common"))
        check_choice("search", self.search, get_args(Search))

    def problem(self, spectrum_x: Spectrum, spectrum_y: Spectrum, *, sampled: bool = False) -> WaveletProblem:
        """The pair with the bank on both shapes' eigenvalues."""
        eigenvalues_x, eigenvalues_y = spectrum_x.eigenvalues, spectrum_y.eigenvalues
        layout_x, layout_y = eigenvalues_x, eigenvalues_y
        if self.lambda_max == "common":
            layout_x = layout_y = jnp.sort(jnp.concatenate([eigenvalues_x, eigenvalues_y]))
        return WaveletProblem(
            spectrum_x,
            spectrum_y,
            sample_bank(self.bank, eigenvalues_x, layout_x),
            sample_bank(self.bank, eigenvalues_y, layout_y),
            self.convention,
            sampled,
        )

    def prepare(self, spectrum_x: Spectrum, spectrum_y: Spectrum, samples: Samples | None = None) -> Problem:
        """Prepare the bank's responses, what the solution wants to be prepared, and the search."""
        if samples is not None:
            spectrum_x, spectrum_y = spectrum_x.sample(samples[0]), spectrum_y.sample(samples[1])
        wavelets = self.problem(spectrum_x, spectrum_y, sampled=samples is not None)
        patches = chosen_patches(self.search, spectrum_x, spectrum_y)
        return Problem(spectrum_x, spectrum_y, (wavelets, self.solution.prepare(wavelets), patches))

    def update(
        self,
        problem: Problem,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """See `Solution.solve`."""
        wavelets, prepared, _ = problem.prepared
        return self.solution.solve(wavelets, prepared, pointwise_map, previous)

    def recover(self, problem: Problem, updated: Float[Array, "k_out k_in"]) -> Int32[Array, " m"]:
        """Nearest neighbours; see `decode`."""
        _, _, patches = problem.prepared
        return decode(
            updated,
            problem.spectrum_x,
            problem.spectrum_y,
            convention=self.convention,
            patches=patches,
        )

    def energy(
        self, problem: Problem, updated: Float[Array, "k_out k_in"], pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Eq. (5), area-weighted; see `WaveletProblem.energy`."""
        wavelets, _, _ = problem.prepared
        return wavelets.energy(pointwise_map)(updated)

    def embeddings(
        self, problem: Problem, updated: Float[Array, "k_out k_in"]
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """See `spectral_embeddings`."""
        return spectral_embeddings(
            updated, problem.spectrum_x, problem.spectrum_y, convention=self.convention
        )


@counts_iterations
@eqx.filter_jit
def refine(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    pointwise_map: Int[Array, " m"],
    *,
    refiner: Refiner = WaveletPreservation(),  # noqa: B008 (immutable)
    iterations: int = 3,
    samples_x: Int[Array, " s_x"] | None = None,
    samples_y: Int[Array, " s_y"] | None = None,
    stop_when_unchanged: bool = False,
    history: bool = False,
) -> Refinement:
    """Refine a pointwise map T: X -> Y by turns of functional map and pointwise map (Algorithm 1).

    Pure and jit-compiled; compiled again only when sizes or static settings change. For many pairs of
    equal size use `jax.vmap`, or `jax.lax.map` where memory counts.

    With samples the first functional map comes from all vertices, then turns are taken on the samples, and
    the last search is over all vertices. With `WaveletPreservation` this is the MWP authors' fast variant.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `pointwise_map`: the initial T, one vertex of Y per vertex of X.
    - `refiner`: the method.
    - `iterations`: how many functional maps, each followed by its pointwise map; an integer, at least 1.
    - `samples_x`, `samples_y`: vertices of X and of Y to iterate on, both or neither; more of them than
      there are eigenvectors, evenly spread.
    - `stop_when_unchanged`: skip the remaining iterations once no match changes. (Under `vmap` all pairs
      cost as much as the slowest, but each still stops where it would alone.)
    - `history`: record a `History`, for about a tenth more time.

    **Returns:** A `Refinement`. Nothing is raised for bad numbers: check its `result`.

    **Raises:** `ValueError` for fewer than one iteration, samples on one side only, an initial map that is
    not one vertex per vertex of X, or spectra of two float types; `TypeError` if `iterations` or what the
    initial map holds is no integer, or an argument is of another kind.
    """
    check_kind("refiner", refiner, Refiner)
    check_spectra(spectrum_x, spectrum_y)
    check_kind("initial map", pointwise_map, np.ndarray, jax.Array)
    if (samples_x is None) != (samples_y is None):
        raise ValueError("samples are needed on both shapes or on neither")
    if samples_x is not None:
        check_kind("samples of X", samples_x, np.ndarray, jax.Array)
        check_kind("samples of Y", samples_y, np.ndarray, jax.Array)
    if pointwise_map.shape != spectrum_x.mask.shape:
        raise ValueError(
            f"the initial map has shape {pointwise_map.shape}, but X has {spectrum_x.mask.shape[0]} vertices"
        )
    if not jnp.issubdtype(pointwise_map.dtype, jnp.integer):
        raise TypeError(f"the initial map has type {pointwise_map.dtype}; it must be integer vertex indices")
    dtype = spectrum_x.eigenvectors.dtype

    whole = working = refiner.prepare(spectrum_x, spectrum_y)
    working_map = pointwise_map = pointwise_map.astype(jnp.int32)
    if samples_x is not None and samples_y is not None:
        working = refiner.prepare(spectrum_x, spectrum_y, (samples_x, samples_y))
        working_map = jnp.full(samples_x.shape, -1, jnp.int32)
    undefined = jnp.asarray(jnp.nan, dtype)
    keeps_maps = history and samples_x is None

    def search(problem: Problem, updated: Any, before: Array) -> tuple[Array, Array, Array]:
        after = refiner.recover(problem, updated)
        mask = problem.spectrum_x.mask
        changed = jnp.sum((after != before) & mask) / jnp.sum(mask)
        objective = refiner.objective(problem, updated, after) if history else undefined
        return after, changed.astype(dtype), objective

    def how(updated: Any, result: RESULTS) -> RESULTS:
        return checked(updated, refiner.functional_map(updated), result)

    def energy(problem: Problem, updated: Any, pointwise_map: Array) -> Array:
        return refiner.energy(problem, updated, pointwise_map) if history else undefined

    def turn(state: _State, last: Bool[Array, ""]) -> tuple[_State, _Record]:
        after, changed, objective = search(working, state.updated, state.pointwise_map)
        record = changed, state.energy, objective, after if keeps_maps else None

        def follow() -> tuple[Any, RESULTS, Array, Array]:
            updated, result = refiner.update(working, after, state.updated)
            result = where(state.result == RESULTS.successful, how(updated, result), state.result)
            return updated, result, energy(working, updated, after), state.iterations + 1

        def keep() -> tuple[Any, RESULTS, Array, Array]:
            return state.updated, state.result, state.energy, state.iterations

        updated, result, preserved, done = lax.cond(last, keep, follow)
        unchanged = (changed == 0) & refiner.is_settled(state.updated)
        return _State(after, updated, result, preserved, done, unchanged, last), record

    def stay(state: _State, _: Bool[Array, ""]) -> tuple[_State, _Record]:
        return state, (undefined, undefined, undefined, state.pointwise_map if keeps_maps else None)

    def step(state: _State, last: Bool[Array, ""]) -> tuple[_State, _Record]:
        if not stop_when_unchanged:
            return turn(state, last)
        return lax.cond(state.finished, stay, turn, state, last | state.unchanged)

    updated, result = refiner.update(whole, pointwise_map, None)
    state = _State(
        working_map,
        updated,
        how(updated, result),
        energy(whole, updated, pointwise_map),
        iterations=jnp.asarray(1, jnp.int32),
        unchanged=jnp.asarray(False),
        finished=jnp.asarray(False),
    )
    if samples_x is None:
        # The last search is a turn like the others: searching is what takes longest to compile.
        last = jnp.arange(iterations) == iterations - 1
        state, records = lax.scan(step, state, last)
        refined = state.pointwise_map
    else:
        state, records = lax.scan(step, state, jnp.zeros(iterations - 1, bool))
        refined, _, objective = search(whole, state.updated, pointwise_map)
        # Nothing to compare the first samples' map with, nor the last one of all vertices.
        changed, energies, objectives, _ = records
        records = (
            jnp.append(changed.at[:1].set(undefined), undefined),
            jnp.append(energies, state.energy),
            jnp.append(objectives, objective),
            None,
        )

    result = diagnose(spectrum_x, spectrum_y, pointwise_map, state.result)
    successful = result == RESULTS.successful
    recorded = None
    if history:
        recorded = History(*records)
        if recorded.pointwise_maps is not None:
            maps = jnp.where(successful, recorded.pointwise_maps, -1)
            recorded = dataclasses.replace(recorded, pointwise_maps=maps)
    return Refinement(
        jnp.where(successful, refined, -1),
        refiner.functional_map(state.updated),
        state.updated,
        result,
        state.iterations,
        recorded,
    )


class _State(NamedTuple):
    """What one turn of the loop hands to the next."""

    pointwise_map: Int32[Array, " s"]
    updated: Any
    result: RESULTS
    energy: Float[Array, ""]
    iterations: Int32[Array, ""]
    unchanged: Bool[Array, ""]
    finished: Bool[Array, ""]


_Record = tuple[Array, Array, Array, Array | None]
"""What one turn adds to the four series of `History`."""


def check_spectra(spectrum_x: Spectrum, spectrum_y: Spectrum) -> None:
    """**Raises:** `TypeError` if these are no spectra, `ValueError` if they are of two float types."""
    check_kind("spectrum of X", spectrum_x, Spectrum)
    check_kind("spectrum of Y", spectrum_y, Spectrum)
    dtype_x, dtype_y = spectrum_x.eigenvectors.dtype, spectrum_y.eigenvectors.dtype
    if dtype_x != dtype_y:
        raise ValueError(
            f"the spectrum of X is {dtype_x} and that of Y {dtype_y}: compute both with the same "
            "jax_enable_x64"
        )


def checked(updated: Any, functional_map: Float[Array, "k_out k_in"], result: RESULTS) -> RESULTS:
    """How an update came out: a failure that its computation reported says more than a NaN."""
    went_well = result == RESULTS.successful
    finite, zero = all_finite(updated), jnp.all(functional_map == 0)
    result = where(went_well & zero, RESULTS.undetermined_functional_map, result)
    return where(went_well & ~finite, RESULTS.nonfinite_functional_map, result)


def diagnose(
    spectrum_x: Spectrum, spectrum_y: Spectrum, matches: Int[Array, "m ..."] | None, result: RESULTS
) -> RESULTS:
    """How a refinement of a start ended: a fault of the spectra or of the start, or else `result`.

    `matches` are the vertices of Y that the start names, some for each vertex of X; None if it names none.
    """
    if matches is not None:
        vertices_y = spectrum_y.mask.shape[0]
        in_range = (matches >= 0) & (matches < vertices_y)
        valid = in_range & spectrum_y.mask[jnp.clip(matches, 0, vertices_y - 1)]
        valid = jnp.all(valid.reshape(valid.shape[0], -1), axis=1)
        result = where(jnp.all(valid | ~spectrum_x.mask), result, RESULTS.invalid_initial_map)
    return where(all_finite((spectrum_x, spectrum_y)), result, RESULTS.nonfinite_spectrum)
