"""The functional map of a pointwise map, and the wavelet-preservation energy.

The pointwise map T: X -> Y has a matrix P (m, n), whose row x has a one in column T(x) and zeros elsewhere.
Phi_X and Phi_Y contain the eigenvectors as columns. C_0 is the functional map of T before any filtering. A
functional map C has one of two conventions:

- **pullback** (default, as in the MWP authors' program): `C` (k_X, k_Y) maps functions on Y to functions on
  X, and `C_0 = Phi_X^+ P Phi_Y`.
- **pushforward** (as in the equations of the MWP paper): `C` (k_Y, k_X) maps functions on X to functions on
  Y, and `C_0 = Phi_Y^+ P^T Phi_X`.

C maps from the shape "in" to the shape "out". Every vertex x of X has a weight w_x, an input vector a_x and
an output vector b_x, and ideally, C maps a_x to b_x:

| convention  | norm      | weight w_x | input a_x          | output b_x                           |
|-------------|-----------|------------|--------------------|--------------------------------------|
| pullback    | area      | area_X(x)  | Phi_Y(T(x))        | Phi_X(x)                             |
| pullback    | frobenius | 1          | Phi_Y(T(x))        | Phi_X(x)                             |
| pushforward | area      | area_X(x)  | Phi_X(x)           | area_Y(T(x)) Phi_Y(T(x)) / area_X(x) |
| pushforward | frobenius | 1          | area_X(x) Phi_X(x) | area_Y(T(x)) Phi_Y(T(x))             |

For a bank with filters g_l, equation (5) of the MWP paper defines the energy

    E(C) = sum_l sum_x w_x || C g_l(Lambda_in) a_x - g_l(Lambda_out) b_x ||².

The diagonal matrices Lambda contain the eigenvalues, and the matrices G contain the responses of the filters,
one row per filter. For every matrix M, `sum_l g_l(Lambda_out) M g_l(Lambda_in)` is the elementwise product `M
* (G_out^T G_in)`, so the energy needs no loop over filters and no array of size m x n:

    E(C) = <C, C gram> - 2 <C, cross> + constant
    gram = (sum_x w a a^T) * (G_in^T G_in)        cross = (sum_x w b a^T) * (G_out^T G_in)

The minimiser solves `C gram = cross`. If `sum_x w a a^T` is the identity, `gram` is diagonal and contains the
values of the frame function. For a Parseval frame, the minimiser is then the filtered map of equation (8) of
the MWP paper. In the area norm, this holds for pushforwards, and for pullbacks if T preserves area
(`docs/frames.md`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, get_args

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import DTypeLike

from jaxsmw.core.arrays import Array, namespace, rows_at
from jaxsmw.core.banks import frame_function
from jaxsmw.core.checks import check_option
from jaxsmw.core.linear_algebra import (
    is_regular,
    product,
    regularized,
    solve_positive_definite,
    symmetric_eigenvalues,
)
from jaxsmw.core.module import Module, field, looped
from jaxsmw.core.spectrum import Spectrum, by_basis

if TYPE_CHECKING:
    from jaxsmw.core.soft_maps import SoftMap, SparseSoftMap

    PointwiseMap = Int[Array, " m"] | SoftMap | SparseSoftMap
else:
    PointwiseMap = Any  # the module of soft maps imports JAX

Convention = Literal["pullback", "pushforward"]
PseudoInverse = Literal["area", "least_squares"]
Norm = Literal["area", "frobenius"]

Side = TypeVar("Side")

FunctionalMap = Float[Array, "k_out k_in"]
"""A functional map C, which takes functions on the shape "in" to functions on the shape "out"."""


def out_and_in(convention: Convention, of_x: Side, of_y: Side) -> tuple[Side, Side]:
    """Return the two arguments in the order (out, in), or convert (out, in) to (X, Y)."""
    check_option("convention", convention, get_args(Convention))
    return (of_x, of_y) if convention == "pullback" else (of_y, of_x)


def dual_eigenvectors(spectrum: Spectrum, pseudo_inverse: PseudoInverse) -> Float[Array, "n k"]:
    """Return the transposed pseudo-inverse of the eigenvectors: `Phi^+` (k, n) as an array (n, k).

    `"area"` computes `Phi^+ = Phi^T A`, where the diagonal matrix A contains the vertex areas, as in the MWP
    paper: the projection in the inner product of the surface. `"least_squares"` computes `(Phi^T Phi)^-1
    Phi^T`, in which all vertices have the same weight, as in the MWP authors' program. The two forms are
    nearly equal if the vertices are spread evenly. The eigenvectors of samples (`Spectrum.sample`) are not
    orthonormal and need `"least_squares"`. The result has the unit of length, where the eigenvectors have 1 /
    length. The bases of a `JoinedSpectrum` are inverted one by one.
    """
    check_option("pseudo_inverse", pseudo_inverse, get_args(PseudoInverse))
    if pseudo_inverse == "area":
        return spectrum.eigenvectors * spectrum.vertex_areas[:, None]
    duals = [_least_squares(part) for part in by_basis(spectrum, spectrum.eigenvectors)]
    return duals[0] if len(duals) == 1 else namespace(*duals).concatenate(duals, axis=1)


def _least_squares(eigenvectors: Float[Array, "n k"]) -> Float[Array, "n k"]:
    gram = product(eigenvectors.T, eigenvectors)
    if eigenvectors.shape[0] >= gram.shape[0]:
        # An eigenvector of a sliver can vanish at all samples. Its coefficients are then nearly zero. Fewer
        # samples than eigenvectors remain an error.
        gram = regularized(gram)
    return solve_positive_definite(gram, eigenvectors.T).T


@looped
def encode(
    pointwise_map: PointwiseMap,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
    pseudo_inverse: PseudoInverse = "area",
) -> FunctionalMap:
    """Return the functional map C_0 of a pointwise map T: X -> Y, without any filtering and without unit.

    **Arguments:**

    - `pointwise_map`: the map T, as an integer array (m,) with one 0-based vertex of Y per vertex of X, or as
      a `SoftMap` or a `SparseSoftMap` from X to Y.
    - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices, k_X eigenvectors) and of target Y (n
      vertices, k_Y eigenvectors). Two full shapes need equal areas, such as the area 1 from
      `compute_spectrum`. The shapes of a partial pair need the same unit of length.
    - `convention`: the direction of C_0. `"pullback"` (the default) gives `Phi_X^+ P Phi_Y` (k_X, k_Y), which
      maps functions on Y to functions on X. `"pushforward"` gives `Phi_Y^+ P^T Phi_X` (k_Y, k_X), which maps
      functions on X to functions on Y. P (m, n) is the matrix of T.
    - `pseudo_inverse`: `"area"` (the default) uses `Phi^+ = Phi^T A`, where the diagonal matrix A contains
      the vertex areas. `"least_squares"` uses `Phi^+ = (Phi^T Phi)^-1 Phi^T`, which samples need.

    **Raises:** `ValueError` for an unknown convention or pseudo-inverse.
    """
    spectrum_out, spectrum_in = out_and_in(convention, spectrum_x, spectrum_y)
    dual_out = dual_eigenvectors(spectrum_out, pseudo_inverse)
    return encode_by(dual_out, pointwise_map, spectrum_in.eigenvectors, convention)


def encode_by(
    dual_out: Float[Array, "n_out k_out"],
    pointwise_map: PointwiseMap,
    eigenvectors_in: Float[Array, "n_in k_in"],
    convention: Convention,
) -> FunctionalMap:
    """Return the result of `encode` from the `dual_eigenvectors` of the shape that it maps to."""
    of_x, of_y = out_and_in(convention, dual_out, eigenvectors_in)
    dual_out, eigenvectors_in = out_and_in(convention, of_x, pull_back(pointwise_map, of_y))
    return product(dual_out.T, eigenvectors_in)


def pull_back(pointwise_map: PointwiseMap, functions_on_y: Float[Array, "n p"]) -> Float[Array, "m p"]:
    """Pull functions on Y (n, p) back to X (m, p), along a pointwise map or a soft map from X to Y.

    With a pointwise map, each vertex of X receives the value at its match. With a soft map, each vertex of X
    receives the mean of the values on Y, weighted with the shares of the vertex. No array of size m x n is
    stored.

    Entries of a pointwise map are not checked. JAX replaces an index above n - 1 by n - 1, and NumPy raises
    `IndexError`. Both count a negative index from the end. If a refinement failed, all entries of its map are
    -1, so check `Refinement.result` first.

    **Raises:** `ValueError` if the map is a soft map and `functions_on_y` has the wrong shape.
    """
    if hasattr(pointwise_map, "pull_back"):
        return pointwise_map.pull_back(functions_on_y)
    return rows_at(functions_on_y, pointwise_map)


def multiscale_kernel(
    responses_out: Float[Array, "filters k_out"], responses_in: Float[Array, "filters k_in"]
) -> Float[Array, "k_out k_in"]:
    """Return the multiscale kernel K (k_out, k_in), which turns filtering into an elementwise product.

    For a bank with filters g_l and any functional map C (k_out, k_in), the filtered map `sum_l
    g_l(Lambda_out) C g_l(Lambda_in)` equals the elementwise product `C * K`. The responses g_l (filters, k)
    at the eigenvalues of the shapes "out" and "in", and the kernel, are numbers without unit.
    """
    return product(responses_out.T, responses_in)


class QuadraticEnergy(Module):
    """A quadratic function of the functional map C: `E(C) = <C, C gram> - 2 <C, cross> + constant`.

    Here `<A, B>` is the sum of the elementwise product of the matrices A and B. Every sum of squares `sum_i
    ||C a_i - b_i||²` has this form. `energy(C)` returns the energy of C, `energy + other` adds two energies,
    and `weight * energy` multiplies an energy by an array of shape ().

    **Attributes:**

    - `gram`: (k_in, k_in), `sum_i a_i a_i^T`, positive semi-definite.
    - `cross`: (k_out, k_in), `sum_i b_i a_i^T`.
    - `constant`: (), `sum_i ||b_i||²`, which is the energy of C = 0. Its unit is that of the energy.
    """

    gram: Float[Array, "k_in k_in"]
    cross: Float[Array, "k_out k_in"]
    constant: Float[Array, ""]

    __array_ufunc__: ClassVar[None] = None  # weights of NumPy leave the multiplication to `__rmul__`

    @classmethod
    def zero(cls, k_out: int, k_in: int, dtype: DTypeLike) -> QuadraticEnergy:
        """Return the energy that is zero for every C."""
        return cls(np.zeros((k_in, k_in), dtype), np.zeros((k_out, k_in), dtype), np.zeros((), dtype))

    def __call__(self, functional_map: FunctionalMap) -> Float[Array, ""]:
        """Return the energy of a functional map. Rounding errors can make it slightly negative."""
        terms = functional_map * (product(functional_map, self.gram) - 2 * self.cross)
        return namespace(terms).sum(terms) + self.constant

    def __add__(self, other: QuadraticEnergy) -> QuadraticEnergy:
        return QuadraticEnergy(
            self.gram + other.gram, self.cross + other.cross, self.constant + other.constant
        )

    def __rmul__(self, weight: Float[Array, ""]) -> QuadraticEnergy:
        return QuadraticEnergy(weight * self.gram, weight * self.cross, weight * self.constant)

    def minimizer(self) -> FunctionalMap:
        """Return the functional map of least energy, (k_out, k_in), by one Cholesky factorisation.

        If the gram matrix is singular, the map is NaN or meaningless; `is_regular` detects this.
        """
        return solve_positive_definite(self.gram, self.cross.T).T

    def is_regular(self) -> Bool[Array, ""]:
        """Return whether the gram matrix is non-singular to working precision."""
        return is_regular(self.gram)

    def condition_number(self) -> Float[Array, ""]:
        """Return the ratio of the extreme eigenvalues of the gram matrix, infinite if it is singular."""
        eigenvalues = symmetric_eigenvalues(self.gram)
        return eigenvalues[-1] / namespace(eigenvalues).maximum(eigenvalues[0], 0)


class WaveletProblem(Module):
    """The data that a `Solution` needs to compute the functional map C of a pointwise map from X to Y.

    The properties `spectra` and `responses` are pairs in the order (out, in): first the shape that C maps to,
    then the shape that C maps from. A solution can therefore use the same code for both conventions.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices) and of target Y (n vertices), of the
      same scale; see `encode`.
    - `responses_x`, `responses_y`: the responses of the filter bank, without unit, at the eigenvalues of X,
      (filters, k_x), and of Y, (filters, k_y).
    - `convention`: the direction of C; see `encode`.
    - `sampled`: whether the spectra contain only samples of the vertices. Their eigenvectors are not
      orthonormal.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    responses_x: Float[Array, "filters k_x"]
    responses_y: Float[Array, "filters k_y"]
    convention: Convention = field(static=True, default="pullback")
    sampled: bool = field(static=True, default=False)

    def out_and_in(self, of_x: Side, of_y: Side) -> tuple[Side, Side]:
        """Return the two arguments in the order (out, in), or convert (out, in) to (X, Y)."""
        return out_and_in(self.convention, of_x, of_y)

    @property
    def spectra(self) -> tuple[Spectrum, Spectrum]:
        """The spectra of the two shapes in the order (out, in)."""
        return self.out_and_in(self.spectrum_x, self.spectrum_y)

    @property
    def responses(self) -> tuple[Float[Array, "filters k_out"], Float[Array, "filters k_in"]]:
        """The responses on the two shapes in the order (out, in)."""
        return self.out_and_in(self.responses_x, self.responses_y)

    def energy(self, pointwise_map: PointwiseMap, *, norm: Norm = "area") -> QuadraticEnergy:
        """Return the wavelet-preservation energy (equation (5) of the MWP paper) as a function of C.

        The module `jaxsmw.core.functional_map` states the formula, which holds for every filter bank. In the
        pullback convention with the area norm, the energy of C = 0 is `sum_i G_X(lambda_i)`, where G_X is the
        frame function on X. For a Parseval frame this sum is k_X.

        **Arguments:**

        - `pointwise_map`: the map T, as in the function `encode`.
        - `norm`: `"area"` (the default) weights each vertex of X by its area; the energy then has no unit.
          `"frobenius"` gives all vertices the same weight, as in equation (5) of the MWP paper.
        """
        weights, inputs, outputs = self._weights_inputs_outputs(pointwise_map, norm)
        responses_out, responses_in = self.responses
        return QuadraticEnergy(
            product(inputs.T, weights * inputs) * multiscale_kernel(responses_in, responses_in),
            product((weights * outputs).T, inputs) * multiscale_kernel(responses_out, responses_in),
            product(namespace(outputs).sum(weights * outputs**2, axis=0), frame_function(responses_out)),
        )

    def _weights_inputs_outputs(
        self, pointwise_map: PointwiseMap, norm: Norm
    ) -> tuple[Float[Array, "m 1"], Float[Array, "m k_in"], Float[Array, "m k_out"]]:
        """Return the weights w_x, inputs a_x and outputs b_x that the module docstring defines."""
        xp = namespace(self.spectrum_x.eigenvectors)
        mask, eigenvectors_x = self.spectrum_x.mask[:, None], self.spectrum_x.eigenvectors
        areas_x = xp.where(mask, self.spectrum_x.vertex_areas[:, None], 0)
        if self.convention == "pullback":
            inputs = pull_back(pointwise_map, self.spectrum_y.eigenvectors)
            return areas_x if norm == "area" else mask.astype(areas_x.dtype), inputs, eigenvectors_x
        outputs = pull_back(pointwise_map, dual_eigenvectors(self.spectrum_y, "area"))
        if norm == "area":
            return areas_x, eigenvectors_x, outputs / xp.where(areas_x > 0, areas_x, xp.inf)
        return xp.ones_like(areas_x), eigenvectors_x * areas_x, xp.where(mask, outputs, 0)
