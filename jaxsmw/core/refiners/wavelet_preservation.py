"""The method of the MWP paper: functional maps that preserve spectral manifold wavelets at every scale."""

from __future__ import annotations

from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Int32

from jaxsmw.choices import Search
from jaxsmw.core.banks import FilterBank, Meyer
from jaxsmw.core.banks.base import sample_bank
from jaxsmw.core.checks import check_choice, check_kind
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.pointwise_map import chosen_patches, spectral_embeddings
from jaxsmw.core.refiner import Prepared, Problem, Refiner, State
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import Patches, nearest_vertices
from jaxsmw.core.soft_maps import PointwiseMap
from jaxsmw.core.solutions import Filtering, Solution, WaveletProblem
from jaxsmw.core.spectrum import Spectrum


class PreparedWavelets(Prepared):
    """The values that `WaveletPreservation` computes once per problem.

    **Attributes:**

    - `wavelets`: both shapes, with the responses of the filter bank at their eigenvalues.
    - `solution`: the result of `Solution.prepare`.
    - `patches`: the patches of X and Y, or None if the search uses no patches.
    """

    wavelets: WaveletProblem
    solution: Any
    patches: tuple[Patches, Patches] | None


class WaveletPreservation(Refiner[PreparedWavelets, State]):
    """Multiscale spectral manifold wavelets preservation: Algorithm 1 of the MWP paper, with any frame.

    The functional map preserves the wavelets of all scales. The pointwise map follows by nearest neighbours
    in `spectral_embeddings`.

    **Arguments:**

    - `bank`: the filters.
    - `solution`: the computation of the functional map. `Filtering()` (eq. 8) is meant for Parseval frames,
      whose squared filters sum to one; `LeastSquares()` is exact for every frame; `RegularizedLeastSquares()`
      adds further energy terms.
    - `convention`: the direction of C; see `jaxsmw.core.functional_map`. `"pushforward"` is the paper's
      notation. It is meant for study only, because it fails on real pairs (`spectral_embeddings` says why).
    - `lambda_max`: the eigenvalue at which the bank ends. `"own"` is each shape's largest eigenvalue, which
      cancels a difference in size. `"common"` is the largest eigenvalue of both shapes together.
    - `search`: the search for nearest neighbours. `"exhaustive"` compares all vertices with all vertices.
      `"patches"` finds the same neighbours but skips patches of the target that are too far away. It is
      several times as fast on a CPU, but its compilation takes seconds longer. `"auto"` uses patches on CPUs
      from 15 000 vertices.

    **Raises:** `TypeError` if the bank is not a `FilterBank` or the solution not a `Solution`; `ValueError`
    for an unknown choice.
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
        """Returns both shapes with the responses of the bank at their eigenvalues.

        **Arguments:**

        - `spectrum_x`, `spectrum_y`: source X and target Y.
        - `sampled`: whether the spectra contain samples only.

        **Raises:** `ValueError` if the responses of the bank are not of shape (filters, points).
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
        """Evaluates the bank, and prepares the solution and the search."""
        spectrum_x, spectrum_y = problem.query_spectra()
        wavelets = self.problem(spectrum_x, spectrum_y, sampled=problem.samples is not None)
        patches = chosen_patches(self.search, spectrum_x, spectrum_y)
        return PreparedWavelets(spectrum_x, spectrum_y, wavelets, self.solution.prepare(wavelets), patches)

    def update(
        self, prepared: PreparedWavelets, pointwise_map: PointwiseMap, previous: State | None
    ) -> tuple[State, RESULTS]:
        """Returns the state with the functional map of `Solution.solve`, and the result of this solution."""
        before = None if previous is None else previous.functional_map
        found, result = self.solution.solve(prepared.wavelets, prepared.solution, pointwise_map, before)
        return State(found), result

    def recover(self, prepared: PreparedWavelets, state: State) -> Int32[Array, " m"]:
        """Returns the vertex of Y nearest to each vertex of X in the `embeddings`; see `decode`."""
        queries, database = self.embeddings(prepared, state)
        return nearest_vertices(queries, database, prepared.spectrum_y.mask, prepared.patches)

    def recover_reverse(self, prepared: PreparedWavelets, state: State) -> Int32[Array, " n"]:
        """Returns the vertex of X nearest to each vertex of Y in the `embeddings`, (n,)."""
        queries, database = self.embeddings(prepared, state)[::-1]
        patches = chosen_patches(self.search, prepared.spectrum_y, prepared.spectrum_x)
        return nearest_vertices(queries, database, prepared.spectrum_x.mask, patches)

    def energy(
        self, prepared: PreparedWavelets, state: State, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Returns the energy of eq. (5) in the area norm; see `WaveletProblem.energy`."""
        return prepared.wavelets.energy(pointwise_map)(state.functional_map)

    def embeddings(
        self, prepared: PreparedWavelets, state: State
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Returns the `spectral_embeddings` of the functional map."""
        return spectral_embeddings(
            state.functional_map, prepared.spectrum_x, prepared.spectrum_y, convention=self.convention
        )
