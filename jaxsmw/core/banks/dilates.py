"""Filter banks that evaluate one function at several scales."""

from __future__ import annotations

import abc
import math

from jaxtyping import Float

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.banks.base import Eigenvalues, FilterBank, Points, Responses, check_number_of_filters
from jaxsmw.core.checks import as_parameter, check_between
from jaxsmw.core.module import field


class _LogSpacedDilates(FilterBank):
    """A scaling function below `lambda_max / ratio`, and one wavelet at several log-spaced scales."""

    filters: int = field(static=True, default=6)
    ratio: Float[Array, ""] = field(converter=as_parameter, default=20.0)
    normalize: bool = field(static=True, default=False)

    def __check_init__(self) -> None:
        check_number_of_filters(self, self.filters, 2)
        check_between(self, "ratio", self.ratio, low=1.0)

    @abc.abstractmethod
    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        """Return the values of the wavelet. Each entry of `scaled` is a scale times an eigenvalue."""

    @abc.abstractmethod
    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        """Return the scaling function at `scaled`, which is `ratio * lambda / lambda_max`."""

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        xp = namespace(points, eigenvalues, self.ratio)
        relative, ratio = points / eigenvalues[-1], xp.asarray(self.ratio, points.dtype)
        # The scales are in units of 1 / lambda_max.
        scales = (2 * ratio) ** xp.linspace(1, 0, self.filters - 1, dtype=points.dtype)
        wavelets = self.wavelet(scales[:, None] * relative[None, :])
        if self.normalize:
            wavelets = xp.sqrt(scales)[:, None] * wavelets
        return xp.concatenate([self.scaling_function(ratio * relative)[None, :], wavelets])


class CubicSpline(_LogSpacedDilates):
    """A filter bank of a cubic-spline wavelet at several scales. The bank is not tight.

    The wavelet is a function of y, which is the scale times the eigenvalue lambda. The wavelet equals y² for
    y below 1, a cubic spline for y from 1 to 2, and 4 / y² for y above 2. The `filters - 1` scales are
    log-spaced from `2 ratio / lambda_max` to `1 / lambda_max`. The scaling function passes the eigenvalues
    below `lambda_max / ratio`.

    The wavelet, also known as "abspline", is from Hammond, Vandergheynst and Gribonval, "Wavelets on graphs
    via spectral graph theory", 2011. The MWP paper compares this filter bank with the Meyer frame. With the
    default parameters, the frame bounds over [0, lambda_max] are 1.28 and 2.12.

    **Arguments:**

    - `filters`: the number of filters including the scaling function, at least 2, by default 6.
    - `ratio`: the wavelets cover the eigenvalues from `lambda_max / ratio` to lambda_max. The ratio is above
      1, by default 20.
    - `normalize`: whether each wavelet is multiplied by the square root of its scale in units of 1 /
      lambda_max. The default is False.
    """

    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        xp = namespace(scaled)
        spline = -5 + 11 * scaled - 6 * scaled**2 + scaled**3
        # The maximum avoids a division by zero in the branch that `where` does not select.
        tail = 4 / xp.maximum(scaled, 2) ** 2
        return xp.where(scaled < 1, scaled**2, xp.where(scaled < 2, spline, tail))

    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        # At zero, the scaling function equals the maximum of the wavelet. The wavelet has this maximum at
        # `scaled = 2 - 1 / sqrt(3)`.
        return (1 + 2 / (3 * math.sqrt(3))) * namespace(scaled).exp(-((scaled / 0.6) ** 4))


class MexicanHat(_LogSpacedDilates):
    """A filter bank of the Mexican-hat wavelet `y exp(-y)` at several scales. The bank is not tight.

    Here y is the scale times the eigenvalue lambda. In space, this wavelet corresponds to the second
    derivative of a Gaussian. The wavelet is that of Perraudin et al., "GSPBOX: A toolbox for signal
    processing on graphs", 2014. The scales and the arguments are those of `CubicSpline`. With the default
    parameters, the frame bounds over [0, lambda_max] are 0.177 and 0.270.
    """

    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        return scaled * namespace(scaled).exp(-scaled)

    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        return 1.2 / math.e * namespace(scaled).exp(-((scaled / 0.4) ** 4))


class Heat(FilterBank):
    """A filter bank of heat kernels `exp(-t lambda / lambda_max)`, with several diffusion times t.

    The bank is not tight, and all its filters are low-pass filters. The kernels are those of Sun, Ovsjanikov
    and Guibas, "A concise and provably informative multi-scale signature based on heat diffusion", 2009.

    **Arguments:**

    - `times`: (filters,), one or more positive diffusion times t, in units of 1 / lambda_max.
    """

    times: Float[Array, " filters"] = field(converter=as_parameter)

    def __check_init__(self) -> None:
        check_between(self, "times", self.times, ndim=1)
        if not self.times.size:
            raise ValueError("the times of Heat must be a list of at least one time")

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        xp = namespace(points, eigenvalues, self.times)
        relative = points / eigenvalues[-1]
        return xp.exp(-xp.asarray(self.times, points.dtype)[:, None] * relative[None, :])
