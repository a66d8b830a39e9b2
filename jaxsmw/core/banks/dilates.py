"""Banks of one kernel at several scales."""

from __future__ import annotations

import abc
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank, check_number_of_filters
from jaxsmw.core.checks import as_parameter, check_between


class _LogSpacedDilates(FilterBank):
    """One wavelet at log-spaced scales, and a scaling function for eigenvalues below `lambda_max / ratio`."""

    filters: int = eqx.field(static=True, default=6)
    ratio: Float[Array, ""] = eqx.field(converter=as_parameter, default=20.0)
    normalize: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        check_number_of_filters(self, self.filters, 2)
        check_between(self, "ratio", self.ratio, low=1.0)

    @abc.abstractmethod
    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        """Returns the wavelet of scale 1."""

    @abc.abstractmethod
    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        """Returns the scaling function; its argument is 1 at `lambda_max / ratio`."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        relative, ratio = points / eigenvalues[-1], jnp.asarray(self.ratio, points.dtype)
        # The scales are in units of 1 / lambda_max. The coarsest scale is 2 / lambda_min, with lambda_min =
        # lambda_max / ratio. The finest scale is 1 / lambda_max.
        scales = (2 * ratio) ** jnp.linspace(1, 0, self.filters - 1, dtype=points.dtype)
        wavelets = self.wavelet(scales[:, None] * relative[None, :])
        if self.normalize:
            wavelets = jnp.sqrt(scales)[:, None] * wavelets
        return jnp.concatenate([self.scaling_function(ratio * relative)[None, :], wavelets])


class CubicSpline(_LogSpacedDilates):
    """Dilates of a wavelet that rises like y², falls like 4 / y² and is a cubic spline in between.

    This is the wavelet of Hammond, Vandergheynst and Gribonval, "Wavelets on graphs via spectral graph
    theory", 2011 ("abspline"), and the general wavelet of the MWP paper. The bank is not tight: its frame
    bounds are 1.28 and 2.12 with the default parameters.

    **Arguments:**

    - `filters`: the number of filters including the scaling function, at least 2.
    - `ratio`: lambda_max over the smallest eigenvalue that the wavelets cover, above 1.
    - `normalize`: whether each wavelet is multiplied by the square root of its scale (in units of
      1 / lambda_max).

    **Raises:** `TypeError` if `filters` is not an integer; `ValueError` if a parameter is outside its range.
    """

    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        spline = -5 + 11 * scaled - 6 * scaled**2 + scaled**3
        # The maximum avoids a division by zero in the branch that is not taken.
        tail = 4 / jnp.maximum(scaled, 2) ** 2
        return jnp.where(scaled < 1, scaled**2, jnp.where(scaled < 2, spline, tail))

    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        # The value at zero is the maximum of the wavelet, at 2 - 1 / sqrt(3).
        return (1 + 2 / (3 * math.sqrt(3))) * jnp.exp(-((scaled / 0.6) ** 4))


class MexicanHat(_LogSpacedDilates):
    """Dilates of the Mexican hat `y exp(-y)`, the second derivative of a Gaussian.

    This is the wavelet of Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs", 2014, at the
    scales of Hammond, Vandergheynst and Gribonval 2011. The bank is not tight: its frame bounds are 0.177 and
    0.270 with the default parameters.

    **Arguments:**

    - `filters`: the number of filters including the scaling function, at least 2.
    - `ratio`: lambda_max over the smallest eigenvalue that the wavelets cover, above 1.
    - `normalize`: whether each wavelet is multiplied by the square root of its scale (in units of
      1 / lambda_max).

    **Raises:** `TypeError` if `filters` is not an integer; `ValueError` if a parameter is outside its range.
    """

    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        return scaled * jnp.exp(-scaled)

    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        return 1.2 / math.e * jnp.exp(-((scaled / 0.4) ** 4))


class Heat(FilterBank):
    """Heat kernels `exp(-t lambda / lambda_max)`. All of them are low-pass filters.

    Sun, Ovsjanikov and Guibas, "A concise and provably informative multi-scale signature based on heat
    diffusion", 2009. The bank is not tight.

    **Arguments:**

    - `times`: (filters,), the diffusion times t in units of 1 / lambda_max, positive.

    **Raises:** `ValueError` if the times are not a list of one or more positive, finite numbers.
    """

    times: Float[Array, " filters"] = eqx.field(converter=as_parameter)

    def __check_init__(self) -> None:
        check_between(self, "times", self.times, ndim=1)
        if not self.times.size:
            raise ValueError("the times of Heat must be a list of at least one time")

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        relative = points / eigenvalues[-1]
        return jnp.exp(-jnp.asarray(self.times, points.dtype)[:, None] * relative[None, :])
