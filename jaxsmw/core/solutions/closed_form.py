"""Solutions in closed form: filtering, the exact minimiser, and the nearest orthogonal matrix."""

from __future__ import annotations

from typing import NamedTuple, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks import frame_function
from jaxsmw.core.checks import check_choice
from jaxsmw.core.functional_map import (
    Norm,
    PseudoInverse,
    WaveletProblem,
    dual_eigenvectors,
    multiscale_kernel,
)
from jaxsmw.core.products import product
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.soft_maps import PointwiseMap
from jaxsmw.core.solutions.base import PreparedT, Solution


class PreparedFiltering(NamedTuple):
    """The values that `Filtering` prepares.

    **Attributes:**

    - `kernel`: the `multiscale_kernel`.
    - `dual_out`: the `dual_eigenvectors` of the shape that C maps to.
    """

    kernel: Float[Array, "k_out k_in"]
    dual_out: Float[Array, "n_out k_out"]


class Filtering(Solution[PreparedFiltering]):
    """Filtering of the unfiltered functional map C_0: `C = sum_l g_l(Lambda_out) C_0 g_l(Lambda_in)` (eq. 8).

    The sum is one elementwise product; no system is solved. For a Parseval frame with orthonormal inputs, C
    is the minimiser of the energy (see `jaxsmw.core.functional_map`). If the inputs are not orthonormal, C is
    close to the minimiser. For banks that are not Parseval frames, C is only a smoothed map.

    **Arguments:**

    - `pseudo_inverse`: the pseudo-inverse of the eigenvectors of the shape that C maps to; see
      `dual_eigenvectors`. Samples always use least squares.

    **Raises:** `ValueError` for an unknown `pseudo_inverse`.
    """

    pseudo_inverse: PseudoInverse = eqx.field(static=True, default="area")

    def __check_init__(self) -> None:
        check_choice("pseudo_inverse", self.pseudo_inverse, get_args(PseudoInverse))

    def prepare(self, problem: WaveletProblem) -> PreparedFiltering:
        """Returns the multiscale kernel and the dual eigenvectors."""
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
        """Returns the functional map of eq. (8), (k_out, k_in), and `RESULTS.successful`."""
        unfiltered = problem.encode(pointwise_map, prepared.dual_out)
        return unfiltered * prepared.kernel, RESULTS.successful  # type: ignore[return-value]


class NearestOrthogonal(Solution[PreparedT]):
    """The matrix with orthonormal rows or columns that is nearest to the map of another solution.

    With `Filtering` and the bank `Identity`, this solution is the update of spectral ICP (Ovsjanikov et al.
    2012).

    **Arguments:**

    - `solution`: the solution whose map is replaced by the nearest orthogonal matrix.
    """

    solution: Solution[PreparedT] = Filtering()  # type: ignore[assignment]

    def prepare(self, problem: WaveletProblem) -> PreparedT:
        """Returns the values that the other solution prepares."""
        return self.solution.prepare(problem)

    def solve(
        self,
        problem: WaveletProblem,
        prepared: PreparedT,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Returns the polar factor of the map of `solution`, (k_out, k_in), and the result of `solution`."""
        functional_map, result = self.solution.solve(problem, prepared, pointwise_map, previous)
        left, _, right = jnp.linalg.svd(functional_map, full_matrices=False)
        return product(left, right), result


class LeastSquares(Solution[None]):
    """The exact minimiser of the wavelet-preservation energy for any frame, by one Cholesky factorisation.

    `solve` reports `RESULTS.undetermined_functional_map` if some eigenvalue of the shape that C maps from is
    passed by no filter. It reports `RESULTS.singular_system` if the gram matrix is singular to working
    precision.

    **Arguments:**

    - `norm`: how the energy weights vertices, `"area"` or `"frobenius"`; see `WaveletProblem.energy`.

    **Raises:** `ValueError` for an unknown norm.
    """

    norm: Norm = eqx.field(static=True, default="area")

    def __check_init__(self) -> None:
        check_choice("norm", self.norm, get_args(Norm))

    def solve(
        self,
        problem: WaveletProblem,
        prepared: None,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Returns the minimiser of the energy, (k_out, k_in), and a member of `RESULTS`."""
        energy = problem.energy(pointwise_map, norm=self.norm)
        _, responses_in = problem.responses
        frame = frame_function(responses_in)
        precision = frame.shape[0] * jnp.finfo(frame.dtype).eps
        covers = jnp.min(frame) > precision * jnp.max(frame)
        result = where(energy.is_regular(), RESULTS.successful, RESULTS.singular_system)
        return energy.minimizer(), where(covers, result, RESULTS.undetermined_functional_map)
