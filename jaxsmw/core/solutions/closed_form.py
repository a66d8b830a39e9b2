"""Solutions in closed form: filtering, the exact minimiser, and the nearest orthogonal matrix."""

from __future__ import annotations

from typing import NamedTuple, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks import frame_function
from jaxsmw.core.checks import check_option
from jaxsmw.core.functional_map import (
    Norm,
    PseudoInverse,
    WaveletProblem,
    dual_eigenvectors,
    multiscale_kernel,
)
from jaxsmw.core.linear_algebra import nearest_orthogonal
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.soft_maps import PointwiseMap
from jaxsmw.core.solutions.base import PreparedT, Solution


class PreparedFiltering(NamedTuple):
    """The matrices that `Filtering` computes before the iterations.

    **Attributes:**

    - `kernel`: the `multiscale_kernel` of the filter bank on both shapes, (k_out, k_in), without unit.
    - `dual_out`: the `dual_eigenvectors` of the shape that C maps to, (n_out, k_out), in units of length.
    """

    kernel: Float[Array, "k_out k_in"]
    dual_out: Float[Array, "n_out k_out"]


class Filtering(Solution[PreparedFiltering]):
    """A solution that filters the functional map C_0 of a pointwise map T. It is meant for Parseval frames.

    The result is `C = sum_l g_l(Lambda_out) C_0 g_l(Lambda_in)` (equation (8) of the MWP paper), where g_l
    are the filters of the bank. The diagonal matrix Lambda_out contains the eigenvalues of the shape that C
    maps to. The diagonal matrix Lambda_in contains the eigenvalues of the shape that C maps from. The sum
    equals the elementwise product of C_0 and the `multiscale_kernel` of the bank, so no linear system is
    solved.

    If the bank is a Parseval frame, C minimises the wavelet-preservation energy in the area norm. In the
    default pullback convention, C is the exact minimiser only if T preserves area; otherwise C is only close
    to the minimiser. If the bank is not a Parseval frame, C does not minimise this energy.

    **Arguments:**

    - `pseudo_inverse`: the form of the pseudo-inverse `Phi^+`. The columns of Phi are the eigenvectors of the
      shape that C maps to. `"area"` (the default) is `Phi^T A`, where the diagonal matrix A contains the
      vertex areas. `"least_squares"` is `(Phi^T Phi)^-1 Phi^T`, in which all vertices have the same weight.
      When a refiner iterates on samples, `Filtering` always uses `"least_squares"`.

    **Raises:** `ValueError` if `pseudo_inverse` is unknown.
    """

    pseudo_inverse: PseudoInverse = eqx.field(static=True, default="area")

    def __check_init__(self) -> None:
        check_option("pseudo_inverse", self.pseudo_inverse, get_args(PseudoInverse))

    def prepare(self, problem: WaveletProblem) -> PreparedFiltering:
        """Return the multiscale kernel, and the dual eigenvectors of the shape that C maps to."""
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
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Return the filtered map C (k_out, k_in), and `RESULTS.successful`; see `Filtering`."""
        unfiltered = problem.encode(pointwise_map, prepared.dual_out)
        return unfiltered * prepared.kernel, RESULTS.successful  # type: ignore[return-value]


class NearestOrthogonal(Solution[PreparedT]):
    """A solution that replaces the functional map of another solution by the nearest orthogonal matrix.

    The new map (k_out, k_in) has no unit. It has orthonormal columns, or orthonormal rows if k_out is below
    k_in. With `solution=Filtering()` and the bank `Identity()`, this solution is the update of spectral ICP
    (Ovsjanikov et al. 2012). The status code is that of the other solution. If the other solution's map
    contains NaN, all entries of the new map are NaN.

    **Arguments:**

    - `solution`: the `Solution` whose functional map is replaced. The default is `Filtering()`.
    """

    solution: Solution[PreparedT] = Filtering()  # type: ignore[assignment]

    def prepare(self, problem: WaveletProblem) -> PreparedT:
        """Return the values that the other solution prepares."""
        return self.solution.prepare(problem)

    def solve(
        self,
        problem: WaveletProblem,
        prepared: PreparedT,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Return the polar factor (k_out, k_in) of the other solution's map, and the status code."""
        functional_map, result = self.solution.solve(problem, prepared, pointwise_map, previous)
        return nearest_orthogonal(functional_map), result


class LeastSquares(Solution[None]):
    """The solution that minimises the wavelet-preservation energy exactly, for any frame.

    Equation (5) of the MWP paper defines the energy. One Cholesky factorisation of the energy's gram matrix
    (k_in, k_in) gives the minimiser C (k_out, k_in).

    The status code is `RESULTS.successful`, `RESULTS.undetermined_functional_map` or
    `RESULTS.singular_system`. The functional map is undetermined if all filters are zero at an eigenvalue of
    the shape that C maps from. The system is singular if the gram matrix is singular to working precision.

    **Arguments:**

    - `norm`: the weights of the vertices of X in the energy. `"area"` (the default) weights each vertex by
      its area. `"frobenius"` gives all vertices the same weight, as in equation (5) of the MWP paper.

    **Raises:** `ValueError` if `norm` is unknown.
    """

    norm: Norm = eqx.field(static=True, default="area")

    def __check_init__(self) -> None:
        check_option("norm", self.norm, get_args(Norm))

    def solve(
        self,
        problem: WaveletProblem,
        prepared: None,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Return the minimiser C (k_out, k_in) of the energy, and a status code; see `LeastSquares`."""
        energy = problem.energy(pointwise_map, norm=self.norm)
        _, responses_in = problem.responses
        frame = frame_function(responses_in)
        precision = frame.shape[0] * jnp.finfo(frame.dtype).eps
        covers = jnp.min(frame) > precision * jnp.max(frame)
        result = where(energy.is_regular(), RESULTS.successful, RESULTS.singular_system)
        return energy.minimizer(), where(covers, result, RESULTS.undetermined_functional_map)
