"""The interface of solutions, and solutions in closed form."""

from __future__ import annotations

import abc
from typing import Generic, NamedTuple, TypeVar, get_args

from jaxtyping import Float

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.banks import frame_function
from jaxsmw.core.checks import check_option
from jaxsmw.core.functional_map import (
    FunctionalMap,
    Norm,
    PointwiseMap,
    PseudoInverse,
    WaveletProblem,
    dual_eigenvectors,
    encode_by,
    multiscale_kernel,
)
from jaxsmw.core.linear_algebra import nearest_orthogonal
from jaxsmw.core.module import Module, field
from jaxsmw.core.results import RESULTS, where

PreparedT = TypeVar("PreparedT")


class Solution(Module, Generic[PreparedT]):
    """The base class of solutions: methods that compute a functional map C from a pointwise map T.

    The refiner `WaveletPreservation` takes a solution as its argument `solution`. Ready subclasses are
    `Filtering` (the default), `LeastSquares`, `RegularizedLeastSquares` and `NearestOrthogonal`. A subclass
    must define `solve`, and may define `prepare`. If the prepared values have the type `Values`, the subclass
    derives from `Solution[Values]`. C maps functions on the shape "in" to functions on the shape "out", which
    are Y and X in the pullback convention (the default).
    """

    @property
    def uses_namespaces(self) -> bool:
        """Whether the methods take their namespace from their arrays; see `Refiner.uses_namespaces`."""
        return False

    def prepare(self, problem: WaveletProblem) -> PreparedT:
        """Return the values that `solve` needs and that do not depend on the pointwise map, by default None.

        A refinement calls `prepare` only once, before the first iteration.
        """
        return None  # type: ignore[return-value]

    @abc.abstractmethod
    def solve(
        self,
        problem: WaveletProblem,
        prepared: PreparedT,
        pointwise_map: PointwiseMap,
        previous: FunctionalMap | None,
    ) -> tuple[FunctionalMap, RESULTS]:
        """Compute the functional map C that corresponds to a pointwise map T.

        **Arguments:**

        - `problem`: the `WaveletProblem`: both spectra, the responses of the filter bank, and the convention
          of C.
        - `prepared`: the values that `prepare` returned for this problem.
        - `pointwise_map`: the map T, as in `encode`.
        - `previous`: the functional map of the previous iteration, or None in the first iteration. An
          iterative solver can start from this map.

        **Returns:** C (k_out, k_in), without unit, and a status code, which is a member of `RESULTS`.
        """


class PreparedFiltering(NamedTuple):
    """The `multiscale_kernel` of the filter bank, and the `dual_eigenvectors` of the shape that C maps to."""

    kernel: Float[Array, "k_out k_in"]
    dual_out: Float[Array, "n_out k_out"]


class Filtering(Solution[PreparedFiltering]):
    """A solution that filters the functional map C_0 of a pointwise map T. It is meant for Parseval frames.

    The result is `C = sum_l g_l(Lambda_out) C_0 g_l(Lambda_in)` (equation (8) of the MWP paper), where g_l
    are the filters of the bank, and the diagonal matrices Lambda_out and Lambda_in contain the eigenvalues of
    the shapes "out" and "in". The sum equals the elementwise product of C_0 and the `multiscale_kernel` of
    the bank, so no linear system is solved.

    If the bank is a Parseval frame, C minimises the wavelet-preservation energy in the area norm. In the
    default pullback convention, C is the exact minimiser only if T preserves area; otherwise C is only close
    to the minimiser. If the bank is not a Parseval frame, C does not minimise this energy.

    **Arguments:**

    - `pseudo_inverse`: the form of the pseudo-inverse of the eigenvectors on the shape "out", `"area"` (the
      default) or `"least_squares"`; see `encode`. On samples, `Filtering` always uses `"least_squares"`.

    **Raises:** `ValueError` if `pseudo_inverse` is unknown.
    """

    pseudo_inverse: PseudoInverse = field(static=True, default="area")

    def __check_init__(self) -> None:
        check_option("pseudo_inverse", self.pseudo_inverse, get_args(PseudoInverse))

    @property
    def uses_namespaces(self) -> bool:
        """Always True."""
        return True

    def prepare(self, problem: WaveletProblem) -> PreparedFiltering:
        spectrum_out, _ = problem.spectra
        pseudo_inverse: PseudoInverse = "least_squares" if problem.sampled else self.pseudo_inverse
        return PreparedFiltering(
            multiscale_kernel(*problem.responses), dual_eigenvectors(spectrum_out, pseudo_inverse)
        )

    def solve(
        self,
        problem: WaveletProblem,
        prepared: PreparedFiltering,
        pointwise_map: PointwiseMap,
        previous: FunctionalMap | None,
    ) -> tuple[FunctionalMap, RESULTS]:
        _, spectrum_in = problem.spectra
        eigenvectors_in, convention = spectrum_in.eigenvectors, problem.convention
        unfiltered = encode_by(prepared.dual_out, pointwise_map, eigenvectors_in, convention)
        return unfiltered * prepared.kernel, RESULTS.successful


class NearestOrthogonal(Solution[PreparedT]):
    """A solution that replaces the functional map of another solution by the nearest orthogonal matrix.

    The new map (k_out, k_in) has orthonormal columns, or orthonormal rows if k_out is below k_in. With
    `solution=Filtering()` and the bank `Identity()`, this solution is the update of spectral ICP (Ovsjanikov
    et al. 2012). The status code is that of the other solution. If the other solution's map contains NaN, all
    entries of the new map are NaN.

    **Arguments:**

    - `solution`: the other `Solution`. The default is `Filtering()`.
    """

    solution: Solution[PreparedT] = Filtering()  # type: ignore[assignment]

    @property
    def uses_namespaces(self) -> bool:
        """Whether the other solution takes its namespace from its arrays."""
        return self.solution.uses_namespaces

    def prepare(self, problem: WaveletProblem) -> PreparedT:
        return self.solution.prepare(problem)

    def solve(
        self,
        problem: WaveletProblem,
        prepared: PreparedT,
        pointwise_map: PointwiseMap,
        previous: FunctionalMap | None,
    ) -> tuple[FunctionalMap, RESULTS]:
        functional_map, result = self.solution.solve(problem, prepared, pointwise_map, previous)
        return nearest_orthogonal(functional_map), result


class LeastSquares(Solution[None]):
    """The solution that minimises the wavelet-preservation energy exactly, for any frame.

    One Cholesky factorisation of the energy's gram matrix gives the minimiser C (k_out, k_in) of equation (5)
    of the MWP paper. The status code is `RESULTS.undetermined_functional_map` if all filters are zero at an
    eigenvalue of the shape "in", and `RESULTS.singular_system` if the gram matrix is singular to working
    precision. `norm` (`"area"` or `"frobenius"`) is that of `WaveletProblem.energy`.

    **Raises:** `ValueError` if `norm` is unknown.
    """

    norm: Norm = field(static=True, default="area")

    def __check_init__(self) -> None:
        check_option("norm", self.norm, get_args(Norm))

    @property
    def uses_namespaces(self) -> bool:
        """Always True."""
        return True

    def solve(
        self,
        problem: WaveletProblem,
        prepared: None,
        pointwise_map: PointwiseMap,
        previous: FunctionalMap | None,
    ) -> tuple[FunctionalMap, RESULTS]:
        energy = problem.energy(pointwise_map, norm=self.norm)
        _, responses_in = problem.responses
        frame = frame_function(responses_in)
        xp = namespace(frame)
        precision = frame.shape[0] * xp.finfo(frame.dtype).eps
        covers = xp.min(frame) > precision * xp.max(frame)
        result = where(energy.is_regular(), RESULTS.successful, RESULTS.singular_system)
        return energy.minimizer(), where(covers, result, RESULTS.undetermined_functional_map)
