r"""Pointwise maps written as functional maps, and the update that preserves wavelets.

Everything here comes in two conventions, named after what the functional map C does:

- **pullback** (default): `C` (k_X, k_Y) takes functions on Y to functions on X, `C_0 = Phi_X^+ P Phi_Y`.
  This is what the MWP authors' program computes.
- **pushforward**: `C` (k_Y, k_X) takes functions on X to functions on Y, `C_0 = Phi_Y^+ P^T Phi_X`, as the
  paper prints.

Both write the same thing. Give every vertex x of X a weight w_x (its area) and two vectors, what the map is
fed with and what it should return:

| convention  | fed a_x                | should return b_x                          |
|-------------|------------------------|--------------------------------------------|
| pullback    | Phi_Y(T(x))            | Phi_X(x)                                   |
| pushforward | Phi_X(x)               | Phi_Y(T(x)) · area_Y(T(x)) / area_X(x)     |

Then the wavelet-preservation energy (eq. 5, area-weighted) is

    E(C) = sum_l sum_x w_x || C g_l(Lambda_in) a_x - g_l(Lambda_out) b_x ||^2

and since `sum_l g_l(Lambda_out) M g_l(Lambda_in) = M * (G_out^T G_in)`, elementwise, it only depends on the
two moments `sum w b a^T` and `sum w a a^T`: no loop over scales, nothing of size m x n.
"""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Float, Int

from jaxsmw.core.filters import frame_function
from jaxsmw.core.spectrum import Spectrum

Convention = Literal["pullback", "pushforward"]
PseudoInverse = Literal["area", "least_squares"]


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
    gram = spectrum.eigenvectors.T @ spectrum.eigenvectors
    return jsp.linalg.cho_solve(jsp.linalg.cho_factor(gram), spectrum.eigenvectors.T).T


def encode(
    pointwise_map: Int[Array, " m"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
    pseudo_inverse: PseudoInverse = "area",
) -> Float[Array, "k_out k_in"]:
    """The functional map C_0 of a pointwise map T: X -> Y, unfiltered.

    **Arguments:**

    - `pointwise_map`: T, one vertex of Y per vertex of X.
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
    pointwise_map: Int[Array, " m"],
    dual_out: Float[Array, "n_out k_out"],
    eigenvectors_in: Float[Array, "n_in k_in"],
    *,
    convention: Convention,
) -> Float[Array, "k_out k_in"]:
    """`encode` with the dual eigenvectors of the shape that C leads to already at hand."""
    # A padded vertex of X has a zero row on its side of the product, whatever its entry of T says.
    if convention == "pullback":
        return dual_out.T @ eigenvectors_in[pointwise_map]
    return dual_out[pointwise_map].T @ eigenvectors_in


def multiscale_kernel(
    responses_out: Float[Array, "filters k_out"], responses_in: Float[Array, "filters k_in"]
) -> Float[Array, "k_out k_in"]:
    """All scales in one: `sum_l g_l(Lambda_out) C g_l(Lambda_in)` is `C` times this kernel, elementwise."""
    return responses_out.T @ responses_in


def wavelet_energy(
    functional_map: Float[Array, "k_out k_in"],
    pointwise_map: Int[Array, " m"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    responses_x: Float[Array, "filters k_x"],
    responses_y: Float[Array, "filters k_y"],
    *,
    convention: Convention = "pullback",
) -> Float[Array, ""]:
    """How badly C preserves wavelets at all scales under T: the energy of eq. (5), area-weighted.

    For any functional map and filter bank; the formula stands at the top of this module. A map that
    preserves nothing, C = 0, has the energy `sum_i G(lambda_i)`: for a Parseval frame in the pullback
    convention k_X.

    **Returns:** The energy, a non-negative scalar (up to rounding, as it is a difference of large sums).
    """
    weights = spectrum_x.vertex_areas[:, None]
    matched = spectrum_y.eigenvectors[pointwise_map]
    if convention == "pullback":
        fed, returned = matched, spectrum_x.eigenvectors
        responses_in, responses_out = responses_y, responses_x
    else:
        stretch = spectrum_y.vertex_areas[pointwise_map] / jnp.where(
            spectrum_x.vertex_areas > 0, spectrum_x.vertex_areas, jnp.inf
        )
        fed, returned = spectrum_x.eigenvectors, matched * stretch[:, None]
        responses_in, responses_out = responses_x, responses_y
    gram = (weights * fed).T @ fed * multiscale_kernel(responses_in, responses_in)
    cross = (weights * returned).T @ fed * multiscale_kernel(responses_out, responses_in)
    constant = jnp.sum(weights * returned**2, axis=0) @ frame_function(responses_out)
    return jnp.sum(functional_map * (functional_map @ gram - 2 * cross)) + constant
