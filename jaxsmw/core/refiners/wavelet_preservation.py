"""The method of the MWP paper: functional maps that preserve spectral manifold wavelets at every scale."""

from __future__ import annotations

from collections.abc import Sequence
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
from jaxsmw.core.spectrum import Spectrum, by_basis
from jaxsmw.errors import InputError


class PreparedWavelets(Prepared):
    """The result of `WaveletPreservation.prepare`. `solution` is the result of `Solution.prepare`."""

    wavelets: WaveletProblem
    solution: Any


class WaveletPreservation(Refiner[PreparedWavelets, State]):
    """The refiner of the MWP paper: Algorithm 1, with any filter bank and any solution.

    In each iteration, the refiner computes a functional map that preserves the wavelets of all scales. A
    nearest-neighbour search in the `spectral_embeddings` of this functional map then gives the pointwise map.

    With several bases, each basis has its own functional map, computed from the same pointwise map. The
    functional map C of the refinement contains them as blocks on its diagonal, in the order of `bases`. The
    embeddings therefore contain the coordinates in all bases side by side. Hybrid functional maps (Bastian,
    Xie, Navab, Lähner 2024) join the Laplacian and an elastic basis in this way.

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
    - `bases`: the names of the bases. `"laplacian"` (the only default) means the eigenvectors of the
      Laplacian, and every other name a `Basis` of the spectra, such as `"crease"`. The bank is laid out on
      the eigenvalues of each basis.

    **Raises:** `TypeError` if `bank` is not a `FilterBank` or `solution` is not a `Solution`; `ValueError` if
    `convention` or `lambda_max` is unknown, or if `bases` is not a tuple of different names.
    """

    bank: FilterBank = Meyer()
    solution: Solution = Filtering()
    convention: Convention = field(static=True, default="pullback")
    lambda_max: Literal["own", "common"] = field(static=True, default="own")
    bases: tuple[str, ...] = field(static=True, default=("laplacian",))

    def __check_init__(self) -> None:
        check_kind("bank", self.bank, FilterBank, "Meyer()")
        check_kind("solution", self.solution, Solution, "LeastSquares()")
        check_option("convention", self.convention, get_args(Convention))
        check_option("lambda_max", self.lambda_max, ("own", "common"))
        named = isinstance(self.bases, tuple) and all(isinstance(name, str) for name in self.bases)
        if not named or not self.bases or len(set(self.bases)) < len(self.bases):
            raise InputError(
                f'bases is {self.bases!r}: give a tuple of different names such as ("laplacian", "crease").'
            )

    @property
    def uses_namespaces(self) -> bool:
        """Whether the solution takes its namespace from its arrays."""
        return self.solution.uses_namespaces

    @property
    def further_bases(self) -> tuple[str, ...]:
        """The names in `bases`, except the Laplacian's."""
        return tuple(name for name in self.bases if name != "laplacian")

    def problem(self, spectrum_x: Spectrum, spectrum_y: Spectrum, *, sampled: bool = False) -> WaveletProblem:
        """Return the `WaveletProblem` of two shapes, of which the spectra can be `sampled`.

        **Raises:** `ValueError` if the responses of the bank do not have shape (filters, eigenvalues).
        `InputError` if a spectrum lacks a basis.
        """
        if self.bases != ("laplacian",):
            spectrum_x, spectrum_y = spectrum_x.joined(self.bases), spectrum_y.joined(self.bases)
        responses_x, responses_y = self._responses(spectrum_x, spectrum_y)
        return WaveletProblem(spectrum_x, spectrum_y, responses_x, responses_y, self.convention, sampled)

    def _responses(
        self, spectrum_x: Spectrum, spectrum_y: Spectrum
    ) -> tuple[Float[Array, "filters k_x"], Float[Array, "filters k_y"]]:
        """Return the responses on X and Y. Each basis has its own filters, which are 0 on other bases.

        The multiscale kernel is therefore zero outside the diagonal blocks of the functional map.
        """
        sides = [by_basis(spectrum, spectrum.eigenvalues) for spectrum in (spectrum_x, spectrum_y)]
        responses = [self._of_basis(*eigenvalues) for eigenvalues in zip(*sides, strict=True)]
        of_x, of_y = (_block_diagonal(blocks) for blocks in zip(*responses, strict=True))
        return of_x, of_y

    def _of_basis(
        self, eigenvalues_x: Float[Array, " k_x"], eigenvalues_y: Float[Array, " k_y"]
    ) -> tuple[Float[Array, "filters k_x"], Float[Array, "filters k_y"]]:
        layout_x, layout_y = eigenvalues_x, eigenvalues_y
        if self.lambda_max == "common":
            xp = namespace(eigenvalues_x, eigenvalues_y)
            layout_x = layout_y = xp.sort(xp.concatenate([eigenvalues_x, eigenvalues_y]))
        return (
            sample_bank(self.bank, eigenvalues_x, layout_x),
            sample_bank(self.bank, eigenvalues_y, layout_y),
        )

    def prepare(self, problem: Problem) -> PreparedWavelets:
        """Evaluate the filter bank, and prepare the solution."""
        spectrum_x, spectrum_y = problem.query_spectra()
        wavelets = self.problem(spectrum_x, spectrum_y, sampled=problem.samples is not None)
        solution = self.solution.prepare(wavelets)
        return PreparedWavelets(wavelets.spectrum_x, wavelets.spectrum_y, wavelets, solution)

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


def _block_diagonal(blocks: Sequence[Float[Array, "filters k_b"]]) -> Float[Array, "all_filters k"]:
    """Return a matrix with the given blocks on its diagonal, and zeros elsewhere."""
    if len(blocks) == 1:
        return blocks[0]
    xp, columns = namespace(*blocks), sum(block.shape[1] for block in blocks)
    rows, before = [], 0
    for block in blocks:
        after = columns - before - block.shape[1]
        rows.append(xp.pad(block, ((0, 0), (before, after))))
        before += block.shape[1]
    return xp.concatenate(rows)
