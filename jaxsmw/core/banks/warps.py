"""Warps, and banks on a warped spectrum."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank
from jaxsmw.core.checks import as_parameter, check_between


class Warp(eqx.Module):
    """A monotone map of the spectrum. A constant factor in the map has no effect on any bank."""

    @abc.abstractmethod
    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        """Returns the warped points (p,).

        **Arguments:**

        - `points`: (p,), points in [0, lambda_max], in any order.
        - `eigenvalues`: (k,), the eigenvalues of the shape, ascending, in the same unit. The last eigenvalue
          is lambda_max.
        """


class Warped(FilterBank):
    """A bank evaluated on a warped spectrum: `g_l(warp(lambda))`. A Parseval bank stays Parseval.

    Shuman, Wiesmeyr, Holighaus and Vandergheynst, "Spectrum-adapted tight graph wavelet and vertex-frequency
    frames", 2015.

    **Arguments:**

    - `bank`: any bank. A `Logarithm` turns uniform translates into wavelets. A `SpectralDistribution` turns
      uniform translates into bands with equal numbers of eigenvalues.
    - `warp`: the warp.
    """

    bank: FilterBank
    warp: Warp

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        return self.bank(self.warp(points, eigenvalues), self.warp(eigenvalues, eigenvalues))


class Logarithm(Warp):
    """The warp `log(1 + strength lambda / lambda_max)`.

    The warp is nearly linear below `lambda_max / strength` and nearly logarithmic above.

    **Arguments:**

    - `strength`: a positive number.

    **Raises:** `ValueError` if the strength is not one positive, finite number.
    """

    strength: Float[Array, ""] = eqx.field(converter=as_parameter, default=10.0)

    def __check_init__(self) -> None:
        check_between(self, "strength", self.strength)

    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        return jnp.log1p(jnp.asarray(self.strength, points.dtype) * (points / eigenvalues[-1]))


class Power(Warp):
    """The warp `(lambda / lambda_max)^exponent`; the square root turns eigenvalues into frequencies.

    **Arguments:**

    - `exponent`: a positive number.

    **Raises:** `ValueError` if the exponent is not one positive, finite number.
    """

    exponent: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.5)

    def __check_init__(self) -> None:
        check_between(self, "exponent", self.exponent)

    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        relative = points / eigenvalues[-1]
        # For exponents below 1 the slope at the eigenvalue 0 is infinite. Gradients use the slope 0 there.
        positive = jnp.where(relative > 0, relative, 1)
        return jnp.where(relative > 0, positive ** jnp.asarray(self.exponent, points.dtype), 0)


class SpectralDistribution(Warp):
    """The number of eigenvalues below lambda, with linear interpolation between eigenvalues.

    This is the warp of Shuman, Wiesmeyr, Holighaus and Vandergheynst 2015. Under this warp, uniform
    translates pass equal numbers of eigenvalues; the first and the last translate pass half as many.

    The warp maps a simple eigenvalue to its index, and a repeated eigenvalue to the mean of its indices. So a
    bank treats all functions of an eigenspace equally. If all eigenvalues are simple, the responses at the
    eigenvalues depend only on the indices. By Weyl's law the eigenvalues of a surface grow nearly evenly, so
    this warp is nearly linear, and its effect is small.
    """

    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        # Eigensolvers return repeated eigenvalues as nearly equal numbers.
        tolerance = 1e-6 * eigenvalues[-1]
        below = jnp.searchsorted(eigenvalues, eigenvalues - tolerance, side="left")
        not_above = jnp.searchsorted(eigenvalues, eigenvalues + tolerance, side="right")
        index = (below + not_above - 1).astype(points.dtype) / 2
        return jnp.interp(points, eigenvalues, index)
