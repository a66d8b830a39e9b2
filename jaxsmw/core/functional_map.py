r"""Pointwise maps written as functional maps, and the update that preserves wavelets.

Everything here comes in two conventions, named after what the functional map C does:

- **pullback** (default): `C` (k_X, k_Y) takes functions on Y to functions on X, `C_0 = Phi_X^+ P Phi_Y`.
  This is what the MWP authors' program computes.
- **pushforward**: `C` (k_Y, k_X) takes functions on X to functions on Y, `C_0 = Phi_Y^+ P^T Phi_X`, as the
  paper prints.

Both write the same thing. Give every vertex x of X a weight w_x and two vectors, what the map is fed with and
what it should return. Vertices count by their area, the norm of the surface, or all the same, the plain
Frobenius norm in which eq. (5) is printed:

| convention  | norm      | weight w_x | fed a_x            | should return b_x                          |
|-------------|-----------|------------|--------------------|--------------------------------------------|
| pullback    | area      | area_X(x)  | Phi_Y(T(x))        | Phi_X(x)                                   |
| pullback    | frobenius | 1          | Phi_Y(T(x))        | Phi_X(x)                                   |
| pushforward | area      | area_X(x)  | Phi_X(x)           | Phi_Y(T(x)) area_Y(T(x)) / area_X(x)       |
| pushforward | frobenius | 1          | area_X(x) Phi_X(x) | area_Y(T(x)) Phi_Y(T(x))                   |

(The last line holds the columns of `Phi_X^+` and `Phi_Y^+ P^T`, as printed.) The energy of eq. (5) is then

    E(C) = sum_l sum_x w_x || C g_l(Lambda_in) a_x - g_l(Lambda_out) b_x ||^2,

and since `sum_l g_l(Lambda_out) M g_l(Lambda_in) = M * (G_out^T G_in)`, elementwise, it needs two moments
only, no loop over scales and nothing of size m x n:

    E(C) = <C, C gram> - 2 <C, cross> + constant
    gram = (sum_x w a a^T) * (G_in^T G_in)        cross = (sum_x w b a^T) * (G_out^T G_in)

Its minimiser solves the (k_in, k_in) system `C gram = cross`. Where the fed vectors are orthonormal (always
in the pushforward convention with the area norm; in the pullback where T preserves area) the gram matrix
is the frame function on the diagonal, and the minimiser is `cross` with its columns divided by it: for a
Parseval frame that is filtering alone, eq. (8). `docs/frames.md` derives all of this.
"""

from __future__ import annotations

from typing import Literal

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


def dual_eigenvectors(spectrum: Spectrum, pseudo_inverse: PseudoInverse) -> Float[Array, "n k"]:
    """The transpose of the pseudo-inverse `Phi^+` (k, n) of the eigenvectors.

    **Arguments:**

    - `spectrum`: the shape.
    - `pseudo_inverse`: `"area"` for `Phi^T A`, the projection in the surface's inner product (the paper);
      `"least_squares"` for `(Phi^T Phi)^-1 Phi^T`, every vertex counting the same (the authors' program).
      They differ as little as the vertices are evenly spread. On samples only the second is an inverse.
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
    """The functional map C_0 of a pointwise map T: X -> Y, unfiltered.

    **Arguments:**

    - `pointwise_map`: T, one vertex of Y per vertex of X, or a soft map from X to Y.
    - `convention`: `"pullback"` gives `Phi_X^+ P Phi_Y` (k_X, k_Y), `"pushforward"` gives
      `Phi_Y^+ P^T Phi_X` (k_Y, k_X).
    - `pseudo_inverse`: see `dual_eigenvectors`.
    """
    spectrum_out, spectrum_in = (
        (spectrum_x, spectrum_y) if convention == "pullback" else (spectrum_y, spectrum_x)
    )
    dual_out = dual_eigenvectors(spectrum_out, pseudo_inverse)
    return project_matches(pointwise_map, dual_out, spectrum_in.eigenvectors, convention=convention)


def project_matches(
    pointwise_map: PointwiseMap,
    dual_out: Float[Array, "n_out k_out"],
    eigenvectors_in: Float[Array, "n_in k_in"],
    *,
    convention: Convention,
) -> Float[Array, "k_out k_in"]:
    """`encode` with the dual eigenvectors of the shape that C leads to already at hand."""
    # A padded vertex of X has a zero row on its side of the product, whatever its entry of T says.
    if convention == "pullback":
        return product(dual_out.T, pull_back(pointwise_map, eigenvectors_in))
    return product(pull_back(pointwise_map, dual_out).T, eigenvectors_in)


def multiscale_kernel(
    responses_out: Float[Array, "filters k_out"], responses_in: Float[Array, "filters k_in"]
) -> Float[Array, "k_out k_in"]:
    """All scales in one: `sum_l g_l(Lambda_out) C g_l(Lambda_in)` is `C` times this kernel, elementwise."""
    return product(responses_out.T, responses_in)


class QuadraticEnergy(eqx.Module):
    """`E(C) = <C, C gram> - 2 <C, cross> + constant`: a sum of squares that C enters from the left.

    Every term of the form `sum ||C a - b||^2` is one, however many columns a and b there are; energies add,
    and scale with a weight.

    **Attributes:**

    - `gram`: `sum a a^T`, positive semi-definite.
    - `cross`: `sum b a^T`.
    - `constant`: `sum ||b||^2`, the energy of C = 0.
    """

    gram: Float[Array, "k_in k_in"]
    cross: Float[Array, "k_out k_in"]
    constant: Float[Array, ""]

    @classmethod
    def zero(cls, k_out: int, k_in: int, dtype: DTypeLike) -> QuadraticEnergy:
        """The energy of no term at all."""
        return cls(jnp.zeros((k_in, k_in), dtype), jnp.zeros((k_out, k_in), dtype), jnp.zeros((), dtype))

    def __call__(self, functional_map: Float[Array, "k_out k_in"]) -> Float[Array, ""]:
        """The energy of a functional map; non-negative up to rounding, being a difference of large sums."""
        return jnp.sum(functional_map * (product(functional_map, self.gram) - 2 * self.cross)) + self.constant

    def __add__(self, other: QuadraticEnergy) -> QuadraticEnergy:
        return QuadraticEnergy(
            self.gram + other.gram, self.cross + other.cross, self.constant + other.constant
        )

    def __rmul__(self, weight: Float[Array, ""]) -> QuadraticEnergy:
        return QuadraticEnergy(weight * self.gram, weight * self.cross, weight * self.constant)

    def minimizer(self) -> Float[Array, "k_out k_in"]:
        """The functional map of least energy, by one Cholesky factorisation of the gram matrix.

        NaN or without meaning where the gram matrix is singular; see `is_regular`.
        """
        return jsp.linalg.cho_solve((self.cholesky(), True), self.cross.T).T

    def cholesky(self) -> Float[Array, "k_in k_in"]:
        """The lower Cholesky factor of the gram matrix."""
        return jnp.linalg.cholesky(self.gram, symmetrize_input=False)

    def is_regular(self) -> Bool[Array, ""]:
        """Whether the gram matrix can be told from a singular one in this precision."""
        # The pivots of a singular matrix are rounding errors, or NaN from the first negative one on.
        pivots = jnp.diagonal(self.cholesky()) ** 2
        return jnp.min(pivots) > self.rounding()

    def rounding(self) -> Float[Array, ""]:
        """What cannot be told from zero in the gram matrix: its largest entry times k times the precision."""
        relative = self.gram.shape[0] * jnp.finfo(self.gram.dtype).eps
        return jnp.max(jnp.diagonal(self.gram)) * jnp.asarray(relative, self.gram.dtype)

    def condition_number(self) -> Float[Array, ""]:
        """Largest over smallest eigenvalue of the gram matrix; infinite if it is singular."""
        eigenvalues = jnp.linalg.eigvalsh(self.gram)
        return eigenvalues[-1] / jnp.maximum(eigenvalues[0], 0)


def wavelet_energy(
    pointwise_map: PointwiseMap,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    responses_x: Float[Array, "filters k_x"],
    responses_y: Float[Array, "filters k_y"],
    *,
    convention: Convention = "pullback",
    norm: Norm = "area",
) -> QuadraticEnergy:
    """How badly a functional map preserves wavelets at all scales under T: the energy of eq. (5).

    For any filter bank; the formula stands at the top of this module. Call the result with a functional
    map, or ask it for its `minimizer()`: the exact solution for frames that are not tight. A map that
    preserves nothing, C = 0, has the energy `constant`; in the area norm and the pullback convention that
    is `sum_i G_X(lambda_i)`, for a Parseval frame k_X.

    **Arguments:**

    - `pointwise_map`: T, one vertex of Y per vertex of X, or a soft map from X to Y.
    - `responses_x`, `responses_y`: the bank on the eigenvalues of X and of Y.
    - `convention`: which way C goes, see above.
    - `norm`: `"area"` for the norm of the surface, `"frobenius"` for eq. (5) as printed.
    """
    areas_x = jnp.where(spectrum_x.mask, spectrum_x.vertex_areas, 0)[:, None]
    if convention == "pullback":
        fed, returned = pull_back(pointwise_map, spectrum_y.eigenvectors), spectrum_x.eigenvectors
        responses_in, responses_out = responses_y, responses_x
        weights = areas_x if norm == "area" else spectrum_x.mask.astype(areas_x.dtype)[:, None]
    else:
        fed = spectrum_x.eigenvectors
        returned = pull_back(pointwise_map, dual_eigenvectors(spectrum_y, "area"))
        responses_in, responses_out = responses_x, responses_y
        if norm == "area":
            weights = areas_x
            returned = returned / jnp.where(areas_x > 0, areas_x, jnp.inf)
        else:
            weights = jnp.ones_like(areas_x)
            fed = fed * areas_x
            returned = jnp.where(spectrum_x.mask[:, None], returned, 0)
    return QuadraticEnergy(
        product((weights * fed).T, fed) * multiscale_kernel(responses_in, responses_in),
        product((weights * returned).T, fed) * multiscale_kernel(responses_out, responses_in),
        product(jnp.sum(weights * returned**2, axis=0), frame_function(responses_out)),
    )
