"""The method of the MWP paper: functional maps that preserve spectral manifold wavelets at every scale."""

from __future__ import annotations

from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Int32

from jaxsmw.choices import Search
from jaxsmw.core.banks import FilterBank, Meyer
from jaxsmw.core.banks.base import sample_bank
from jaxsmw.core.checks import check_kind, check_option
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.pointwise_map import chosen_patches
from jaxsmw.core.refiner import Prepared, Problem, Refiner, State
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import Patches, nearest_vertices
from jaxsmw.core.soft_maps import PointwiseMap
from jaxsmw.core.solutions import Filtering, Solution, WaveletProblem
from jaxsmw.core.spectrum import Spectrum


class PreparedWavelets(Prepared):
    """The result of `WaveletPreservation.prepare`. `solution` is the result of `Solution.prepare`.

    `patches` are the `Patches` of X and of Y, or None if the search uses no patches.
    """

    wavelets: WaveletProblem
    solution: Any
    patches: tuple[Patches, Patches] | None


class WaveletPreservation(Refiner[PreparedWavelets, State]):
    """The refiner of the MWP paper: Algorithm 1, with any filter bank and any solution.

    In each iteration, the refiner computes a functional map that preserves the wavelets of all scales. A
    nearest-neighbour search in the `spectral_embeddings` of this functional map then gives the pointwise map.

    **Arguments:**

    - `bank`: the `FilterBank`. The default is `Meyer()`, the Parseval frame of the MWP paper.
    - `solution`: the `Solution` that computes the functional map from a pointwise map. `Filtering()` (the
      default) computes C by equation (8) of the MWP paper and is meant for Parseval frames. `LeastSquares()`
      computes the exact minimiser of the energy for every frame. `RegularizedLeastSquares()` minimises a sum
      of the energy and other terms, such as orthogonality. `NearestOrthogonal()` makes the functional map of
      another solution orthogonal.
    - `convention`: the direction of the functional map C; see `encode`. The `"pushforward"` of the MWP paper
      is meant for study only, because it fails on real pairs (see
      `jaxsmw.core.pointwise_map.spectral_embeddings`).
    - `lambda_max`: the eigenvalue at which the filter bank ends. With `"own"` (the default), the bank ends at
      each shape's own largest eigenvalue, so scaling a shape has no effect. With `"common"`, the bank ends at
      the larger of the two shapes' largest eigenvalues on both shapes.
    - `search`: the method of nearest-neighbour search. `"exhaustive"` compares all vertices of X with all
      vertices of Y. `"patches"` finds the same neighbours but skips patches of Y that are too far away. For
      large shapes on a CPU, the search in patches is several times as fast, but takes some seconds longer to
      compile. `"auto"` (the default) chooses `"patches"` on CPUs if the geometric mean of the numbers of
      vertices is at least 15 000, and `"exhaustive"` otherwise.

    **Raises:** `TypeError` if `bank` is not a `FilterBank` or `solution` is not a `Solution`; `ValueError` if
    `convention`, `lambda_max` or `search` is unknown.
    """

    bank: FilterBank = Meyer()
    solution: Solution = Filtering()
    convention: Convention = eqx.field(static=True, default="pullback")
    lambda_max: Literal["own", "common"] = eqx.field(static=True, default="own")
    search: Search = eqx.field(static=True, default="auto")

    def __check_init__(self) -> None:
        check_kind("bank", self.bank, FilterBank)
        check_kind("solution", self.solution, Solution)
        check_option("convention", self.convention, get_args(Convention))
        check_option("lambda_max", self.lambda_max, ("own", "common"))
        check_option("search", self.search, get_args(Search))

    def problem(self, spectrum_x: Spectrum, spectrum_y: Spectrum, *, sampled: bool = False) -> WaveletProblem:
        """Return the `WaveletProblem` of two shapes, of which the spectra can be `sampled`.

        **Raises:** `ValueError` if the responses of the bank do not have shape (filters, eigenvalues).
        """
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

    def prepare(self, problem: Problem) -> PreparedWavelets:
        """Evaluate the filter bank, and prepare the solution and the nearest-neighbour search."""
        spectrum_x, spectrum_y = problem.query_spectra()
        wavelets = self.problem(spectrum_x, spectrum_y, sampled=problem.samples is not None)
        patches = chosen_patches(self.search, spectrum_x, spectrum_y)
        return PreparedWavelets(spectrum_x, spectrum_y, wavelets, self.solution.prepare(wavelets), patches)

    def update(
        self, prepared: PreparedWavelets, pointwise_map: PointwiseMap, previous: State | None
    ) -> tuple[State, RESULTS]:
        """Compute the functional map with `solution`."""
        before = None if previous is None else previous.functional_map
        found, result = self.solution.solve(prepared.wavelets, prepared.solution, pointwise_map, before)
        return State(found), result

    def recover(self, prepared: PreparedWavelets, state: State) -> Int32[Array, " m"]:
        """Return, for each vertex of X, the nearest vertex of Y in the `embeddings`, (m,)."""
        queries, database = self.embeddings(prepared, state)
        return nearest_vertices(queries, database, prepared.spectrum_y.mask, prepared.patches)

    def recover_reverse(self, prepared: PreparedWavelets, state: State) -> Int32[Array, " n"]:
        """Return, for each vertex of Y, the nearest vertex of X in the `embeddings`, (n,)."""
        queries, database = self.embeddings(prepared, state)[::-1]
        patches = chosen_patches(self.search, prepared.spectrum_y, prepared.spectrum_x)
        return nearest_vertices(queries, database, prepared.spectrum_x.mask, patches)

    def energy(
        self, prepared: PreparedWavelets, state: State, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Return the energy of equation (5) of the MWP paper, with the vertex areas as weights."""
        return prepared.wavelets.energy(pointwise_map)(state.functional_map)
