"""The method of the MWP paper: functional maps that preserve spectral manifold wavelets at every scale."""

from __future__ import annotations

from typing import Any, Literal, get_args

from jaxtyping import Float, Int

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.banks import FilterBank, Meyer
from jaxsmw.core.banks.base import sample_bank
from jaxsmw.core.checks import check_kind, check_option
from jaxsmw.core.functional_map import Convention, PointwiseMap, WaveletProblem
from jaxsmw.core.module import field
from jaxsmw.core.refiner import Prepared, Problem, Refiner, State
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions.closed_form import Filtering, Solution
from jaxsmw.core.spectrum import Spectrum


class PreparedWavelets(Prepared):
    """The result of `WaveletPreservation.prepare`. `solution` is the result of `Solution.prepare`."""

    wavelets: WaveletProblem
    solution: Any


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

    **Raises:** `TypeError` if `bank` is not a `FilterBank` or `solution` is not a `Solution`; `ValueError` if
    `convention` or `lambda_max` is unknown.
    """

    bank: FilterBank = Meyer()
    solution: Solution = Filtering()
    convention: Convention = field(static=True, default="pullback")
    lambda_max: Literal["own", "common"] = field(static=True, default="own")

    def __check_init__(self) -> None:
        check_kind("bank", self.bank, FilterBank)
        check_kind("solution", self.solution, Solution)
        check_option("convention", self.convention, get_args(Convention))
        check_option("lambda_max", self.lambda_max, ("own", "common"))

    @property
    def uses_namespaces(self) -> bool:
        """Whether the solution takes its namespace from its arrays."""
        return self.solution.uses_namespaces

    def problem(self, spectrum_x: Spectrum, spectrum_y: Spectrum, *, sampled: bool = False) -> WaveletProblem:
        """Return the `WaveletProblem` of two shapes, of which the spectra can be `sampled`.

        **Raises:** `ValueError` if the responses of the bank do not have shape (filters, eigenvalues).
        """
        eigenvalues_x, eigenvalues_y = spectrum_x.eigenvalues, spectrum_y.eigenvalues
        xp = namespace(eigenvalues_x, eigenvalues_y)
        layout_x, layout_y = eigenvalues_x, eigenvalues_y
        if self.lambda_max == "common":
            layout_x = layout_y = xp.sort(xp.concatenate([eigenvalues_x, eigenvalues_y]))
        return WaveletProblem(
            spectrum_x,
            spectrum_y,
            sample_bank(self.bank, eigenvalues_x, layout_x),
            sample_bank(self.bank, eigenvalues_y, layout_y),
            self.convention,
            sampled,
        )

    def prepare(self, problem: Problem) -> PreparedWavelets:
        """Evaluate the filter bank, and prepare the solution."""
        spectrum_x, spectrum_y = problem.query_spectra()
        wavelets = self.problem(spectrum_x, spectrum_y, sampled=problem.samples is not None)
        return PreparedWavelets(spectrum_x, spectrum_y, wavelets, self.solution.prepare(wavelets))

    def update(
        self, prepared: PreparedWavelets, pointwise_map: PointwiseMap, previous: State | None
    ) -> tuple[State, RESULTS]:
        """Compute the functional map with `solution`."""
        before = None if previous is None else previous.functional_map
        found, result = self.solution.solve(prepared.wavelets, prepared.solution, pointwise_map, before)
        return State(found), result

    def energy(
        self, prepared: PreparedWavelets, state: State, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Return the energy of equation (5) of the MWP paper, with the vertex areas as weights."""
        return prepared.wavelets.energy(pointwise_map)(state.functional_map)
