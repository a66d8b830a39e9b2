r"""Functional maps: the matrix form of a pointwise map, and the energy of wavelet preservation.

The functional map C comes in two conventions, named after the direction of C:

- **pullback** (default): `C` (k_X, k_Y) maps functions on Y to functions on X, `C_0 = Phi_X^+ P Phi_Y`. The
  program of the MWP authors uses this convention.
- **pushforward**: `C` (k_Y, k_X) maps functions on X to functions on Y, `C_0 = Phi_Y^+ P^T Phi_X`. The MWP
  paper prints this convention.

This module calls the shape that C maps from "in" and the shape that C maps to "out". In both conventions
every vertex x of X has a weight w_x, an input vector a_x and an output vector b_x, and C should map a_x to
b_x. In the area norm, each vertex has its area as its weight. In the Frobenius norm, which the paper uses in
eq. (5), all vertices have the same weight:

| convention  | norm      | weight w_x | input a_x          | output b_x                           |
|-------------|-----------|------------|--------------------|--------------------------------------|
| pullback    | area      | area_X(x)  | Phi_Y(T(x))        | Phi_X(x)                             |
| pullback    | frobenius | 1          | Phi_Y(T(x))        | Phi_X(x)                             |
| pushforward | area      | area_X(x)  | Phi_X(x)           | area_Y(T(x)) Phi_Y(T(x)) / area_X(x) |
| pushforward | frobenius | 1          | area_X(x) Phi_X(x) | area_Y(T(x)) Phi_Y(T(x))             |

In the last line, inputs and outputs are the columns of `Phi_X^+` and `Phi_Y^+ P^T`, as in the paper. The
energy of eq. (5) is

    E(C) = sum_l sum_x w_x || C g_l(Lambda_in) a_x - g_l(Lambda_out) b_x ||².

The sum over scales is an elementwise product, `sum_l g_l(Lambda_out) M g_l(Lambda_in) = M * (G_out^T G_in)`.
So the energy depends on two moments only. They require no loop over scales and no array of size m x n:

    E(C) = <C, C gram> - 2 <C, cross> + constant
    gram = (sum_x w a a^T) * (G_in^T G_in)        cross = (sum_x w b a^T) * (G_out^T G_in)

The minimiser solves the (k_in, k_in) system `C gram = cross`. If the inputs are orthonormal, the gram matrix
is diagonal and holds the frame function. The minimiser is then `cross` with its columns divided by the frame
function. For a Parseval frame this minimiser is the filtered map of eq. (8). The inputs are always
orthonormal in the pushforward convention with the area norm, and in the pullback convention if T preserves
area. `docs/frames.md` derives all of this.
"""

from __future__ import annotations

from typing import Literal, TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.scipy as jsp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from jaxsmw.core.banks import frame_function
from jaxsmw.core.products import product
from jaxsmw.core.soft_maps import PointwiseMap, pull_back
from jaxsmw.core.spectrum import Spectrum

Convention = Literal["pullback", "pushforward"]
PseudoInverse = Literal["area", "least_squares"]
Norm = Literal["area", "frobenius"]

Side = TypeVar("Side")


def out_and_in(convention: Convention, of_x: Side, of_y: Side) -> tuple[Side, Side]:
    """Returns a quantity of X and the same quantity of Y in the order of C: out first, in second.

    The function is its own inverse: given (out, in), it returns (X, Y).
    """
    return (of_x, of_y) if convention == "pullback" else (of_y, of_x)


def dual_eigenvectors(spectrum: Spectrum, pseudo_inverse: PseudoInverse) -> Float[Array, "n k"]:
    """Returns the transpose (n, k) of the pseudo-inverse `Phi^+` (k, n) of the eigenvectors.

    **Arguments:**

    - `spectrum`: the shape.
    - `pseudo_inverse`: `"area"` for `Phi^T A`, the projection in the inner product of the surface (the
      paper); `"least_squares"` for `(Phi^T Phi)^-1 Phi^T`, in which all vertices have the same weight (the
      authors' program). The difference is small if the vertices are spread evenly. On samples, only
      `"least_squares"` is a pseudo-inverse.
    """
    if pseudo_inverse == "area":
        return spectrum.eigenvectors * spectrum.vertex_areas[:, None]
    gram = product(spectrum.eigenvectors.T, spectrum.eigenvectors)
    return jsp.linalg.cho_solve(jsp.linalg.cho_factor(gram), spectrum.eigenvectors.T).T


def encode(
    pointwise_map: PointwiseMap,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
    pseudo_inverse: PseudoInverse = "area",
) -> Float[Array, "k_out k_in"]:
    """Returns the unfiltered functional map C_0 of a pointwise map T: X -> Y.

    **Arguments:**

    - `pointwise_map`: T, one vertex of Y per vertex of X (m,), or a soft map from X to Y.
    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `convention`: `"pullback"` gives `Phi_X^+ P Phi_Y` (k_X, k_Y). `"pushforward"` gives `Phi_Y^+ P^T Phi_X`
      (k_Y, k_X).
    - `pseudo_inverse`: `"area"` or `"least_squares"`; see `dual_eigenvectors`.
    """
    spectrum_out, spectrum_in = out_and_in(convention, spectrum_x, spectrum_y)
    dual_out = dual_eigenvectors(spectrum_out, pseudo_inverse)
    return _encode(pointwise_map, dual_out, spectrum_in.eigenvectors, convention)


def _encode(
    pointwise_map: PointwiseMap,
    dual_out: Float[Array, "n_out k_out"],
    eigenvectors_in: Float[Array, "n_in k_in"],
    convention: Convention,
) -> Float[Array, "k_out k_in"]:
    """Returns `encode` for given dual eigenvectors: a sum over the vertices of X in both conventions.

    Padded vertices of X contribute nothing, because their rows in the array of X are zero.
    """
    of_x, of_y = out_and_in(convention, dual_out, eigenvectors_in)
    dual_out, eigenvectors_in = out_and_in(convention, of_x, pull_back(pointwise_map, of_y))
    return product(dual_out.T, eigenvectors_in)


def multiscale_kernel(
    responses_out: Float[Array, "filters k_out"], responses_in: Float[Array, "filters k_in"]
) -> Float[Array, "k_out k_in"]:
    """Returns the kernel K (k_out, k_in) of a bank, for which filtering is an elementwise product.

    `sum_l g_l(Lambda_out) C g_l(Lambda_in)` equals `C * K` for every C (k_out, k_in). The arguments are the
    responses (filters, k) of the bank at the eigenvalues of the shapes that C maps to and maps from.
    """
    return product(responses_out.T, responses_in)


class QuadraticEnergy(eqx.Module):
    """The energy `E(C) = <C, C gram> - 2 <C, cross> + constant`.

    Every sum of squares `sum ||C a - b||²` has this form, for any number of columns a and b. Energies can be
    added, and multiplied by a weight.

    **Attributes:**

    - `gram`: `sum a a^T` (k_in, k_in), positive semi-definite.
    - `cross`: `sum b a^T` (k_out, k_in).
    - `constant`: `sum ||b||²`, the energy of C = 0.
    """

    gram: Float[Array, "k_in k_in"]
    cross: Float[Array, "k_out k_in"]
    constant: Float[Array, ""]

    @classmethod
    def zero(cls, k_out: int, k_in: int, dtype: DTypeLike) -> QuadraticEnergy:
        """Returns the energy that is zero for every C."""
        return cls(jnp.zeros((k_in, k_in), dtype), jnp.zeros((k_out, k_in), dtype), jnp.zeros((), dtype))

    def __call__(self, functional_map: Float[Array, "k_out k_in"]) -> Float[Array, ""]:
        """Returns the energy of a functional map.

        The energy is a difference of large sums, so rounding can make the result slightly negative.
        """
        return jnp.sum(functional_map * (product(functional_map, self.gram) - 2 * self.cross)) + self.constant

    def __add__(self, other: QuadraticEnergy) -> QuadraticEnergy:
        return QuadraticEnergy(
            self.gram + other.gram, self.cross + other.cross, self.constant + other.constant
        )

    def __rmul__(self, weight: Float[Array, ""]) -> QuadraticEnergy:
        return QuadraticEnergy(weight * self.gram, weight * self.cross, weight * self.constant)

    def minimizer(self) -> Float[Array, "k_out k_in"]:
        """Returns the functional map of least energy, (k_out, k_in), by one Cholesky factorisation.

        The result is NaN or meaningless if the gram matrix is singular; see `is_regular`.
        """
        return jsp.linalg.cho_solve((self.cholesky(), True), self.cross.T).T

    def cholesky(self) -> Float[Array, "k_in k_in"]:
        """Returns the lower Cholesky factor of the gram matrix, (k_in, k_in)."""
        return jnp.linalg.cholesky(self.gram, symmetrize_input=False)

    def is_regular(self) -> Bool[Array, ""]:
        """Returns whether the gram matrix differs from a singular matrix by more than rounding."""
        # The pivots of a singular matrix are rounding errors, or NaN from the first negative pivot on.
        pivots = jnp.diagonal(self.cholesky()) ** 2
        return jnp.min(pivots) > self.rounding()

    def rounding(self) -> Float[Array, ""]:
        """Returns the rounding error of the gram matrix.

        The error is the largest diagonal entry times k_in times the precision of the float type.
        """
        relative = self.gram.shape[0] * jnp.finfo(self.gram.dtype).eps
        return jnp.max(jnp.diagonal(self.gram)) * jnp.asarray(relative, self.gram.dtype)

    def condition_number(self) -> Float[Array, ""]:
        """Returns the ratio of the largest to the smallest eigenvalue of the gram matrix.

        The ratio is infinite if the matrix is singular.
        """
        eigenvalues = jnp.linalg.eigvalsh(self.gram)
        return eigenvalues[-1] / jnp.maximum(eigenvalues[0], 0)


class WaveletProblem(eqx.Module):
    """Two shapes, the responses of a filter bank on both, and the convention of C.

    Solutions do not depend on the convention. They use the methods of this class, which return quantities of
    the shapes in the order of C: the shape that C maps to ("out"), then the shape that C maps from ("in").

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: source X and target Y.
    - `responses_x`, `responses_y`: the responses of the bank at the eigenvalues of X (filters, k_x) and of Y
      (filters, k_y).
    - `convention`: `"pullback"` or `"pushforward"`.
    - `sampled`: whether the spectra contain samples only, on which eigenvectors are not orthonormal.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    responses_x: Float[Array, "filters k_x"]
    responses_y: Float[Array, "filters k_y"]
    convention: Convention = eqx.field(static=True, default="pullback")
    sampled: bool = eqx.field(static=True, default=False)

    def out_and_in(self, of_x: Side, of_y: Side) -> tuple[Side, Side]:
        """Returns a quantity of X and the same quantity of Y in the order of C: out first, in second."""
        return out_and_in(self.convention, of_x, of_y)

    @property
    def spectra(self) -> tuple[Spectrum, Spectrum]:
        """The spectra in the order of C: out first, in second."""
        return self.out_and_in(self.spectrum_x, self.spectrum_y)

    @property
    def responses(self) -> tuple[Float[Array, "filters k_out"], Float[Array, "filters k_in"]]:
        """The responses in the order of C: out first, in second."""
        return self.out_and_in(self.responses_x, self.responses_y)

    def encode(
        self, pointwise_map: PointwiseMap, dual_out: Float[Array, "n_out k_out"]
    ) -> Float[Array, "k_out k_in"]:
        """Returns the unfiltered functional map C_0 (k_out, k_in) of a pointwise map; see `encode`.

        **Arguments:**

        - `pointwise_map`: T, one vertex of Y per vertex of X (m,), or a soft map from X to Y.
        - `dual_out`: the `dual_eigenvectors` (n_out, k_out) of the shape that C maps to.
        """
        _, spectrum_in = self.spectra
        return _encode(pointwise_map, dual_out, spectrum_in.eigenvectors, self.convention)

    def energy(self, pointwise_map: PointwiseMap, *, norm: Norm = "area") -> QuadraticEnergy:
        """Returns the energy of eq. (5): how badly functional maps preserve wavelets at all scales under T.

        The docstring of the module `jaxsmw.core.functional_map` states the formula, which holds for every
        filter bank. Call the result with a functional map to get the energy of this map. `minimizer()` of the
        result is the exact solution, also for frames that are not tight. The map C = 0 preserves nothing and
        has the energy `constant`. In the pullback convention with the area norm, this constant is `sum_i
        G_X(lambda_i)`, which is k_X for a Parseval frame.

        **Arguments:**

        - `pointwise_map`: T, one vertex of Y per vertex of X (m,), or a soft map from X to Y.
        - `norm`: `"area"` to weight vertices by area, `"frobenius"` for equal weights, as in eq. (5) of the
          paper.
        """
        weights, inputs, outputs = self._weights_inputs_outputs(pointwise_map, norm)
        responses_out, responses_in = self.responses
        return QuadraticEnergy(
            product((weights * inputs).T, inputs) * multiscale_kernel(responses_in, responses_in),
            product((weights * outputs).T, inputs) * multiscale_kernel(responses_out, responses_in),
            product(jnp.sum(weights * outputs**2, axis=0), frame_function(responses_out)),
        )

    def _weights_inputs_outputs(
        self, pointwise_map: PointwiseMap, norm: Norm
    ) -> tuple[Float[Array, "m 1"], Float[Array, "m k_in"], Float[Array, "m k_out"]]:
        """Returns w_x, a_x and b_x of the vertices of X: one row of the table at the top of this module."""
        mask, eigenvectors_x = self.spectrum_x.mask[:, None], self.spectrum_x.eigenvectors
        areas_x = jnp.where(mask, self.spectrum_x.vertex_areas[:, None], 0)
        if self.convention == "pullback":
            inputs = pull_back(pointwise_map, self.spectrum_y.eigenvectors)
            return areas_x if norm == "area" else mask.astype(areas_x.dtype), inputs, eigenvectors_x
        outputs = pull_back(pointwise_map, dual_eigenvectors(self.spectrum_y, "area"))
        if norm == "area":
            return areas_x, eigenvectors_x, outputs / jnp.where(areas_x > 0, areas_x, jnp.inf)
        return jnp.ones_like(areas_x), eigenvectors_x * areas_x, jnp.where(mask, outputs, 0)
