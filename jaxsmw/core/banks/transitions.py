"""Parseval frames of octave bands or of two bands, with smooth transitions, and banks of a single filter."""

from __future__ import annotations

import abc
import math

import numpy as np
from jaxtyping import Float

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.banks.base import Eigenvalues, FilterBank, Points, Responses, check_number_of_filters
from jaxsmw.core.checks import as_parameter, check_between, check_integer
from jaxsmw.core.module import field


class _Transitions(FilterBank):
    """A bank with the filters cos(theta_1), sin(theta_1) cos(theta_2), …, sin(theta_L).

    Each angle theta_l rises from 0 to pi/2 in the transition from one band to the next. The transitions do
    not overlap, so the squared filters sum to one.
    """

    @abc.abstractmethod
    def transitions(self, points: Points, lambda_max: Float[Array, ""]) -> Float[Array, "wavelets p"]:
        """Return the angle of each transition, divided by pi / 2. The quotient rises from 0 to 1."""

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        theta = math.pi / 2 * self.transitions(points, eigenvalues[-1])
        xp = namespace(theta)
        fall, rise = xp.cos(theta), xp.sin(theta)
        return xp.concatenate([fall[:1], rise[:-1] * fall[1:], rise[-1:]])


class _DyadicBands(_Transitions):
    """Octave bands. Each filter rises over one octave and falls over the next octave.

    The first filter only falls, and the last filter only rises.
    """

    filters: int = field(static=True, default=6)

    def __check_init__(self) -> None:
        check_number_of_filters(self, self.filters, 2)

    @abc.abstractmethod
    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        """Return `theta / (pi / 2)`, which rises from 0 to 1 as `ramp` rises from 0 to 1."""

    def transitions(self, points: Points, lambda_max: Float[Array, ""]) -> Float[Array, "wavelets p"]:
        # The limit of 100 octaves prevents overflow of `2.0**octaves`. It does not change the responses,
        # because no positive eigenvalue is 100 octaves below lambda_max.
        xp = namespace(points, lambda_max)
        octaves = np.minimum(np.arange(self.filters - 1, 0, -1), 100)
        ratios = (points / lambda_max)[None, :] * xp.asarray(2.0**octaves, points.dtype)[:, None]
        return self.profile(xp.clip(ratios - 1, 0, 1))


def meyer_polynomial(ramp: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the Meyer polynomial nu(u), elementwise, which rises from 0 to 1 for u from 0 to 1.

    Its first 3 derivatives vanish at 0 and 1, and `nu(u) + nu(1 - u) = 1`.
    """
    return ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)


class Meyer(_DyadicBands):
    """The Meyer frame: a filter bank of octave bands that is a Parseval frame.

    The scaling function is 1 up to `lambda_max / 2^L`, where `L = filters - 1` is the number of wavelets. The
    scaling function then falls to 0 over the next octave, while the first wavelet rises. The last wavelet
    rises from `lambda_max / 2` to lambda_max. The frame is that of Leonardi and Van De Ville, "Tight wavelet
    frames on multislice graphs", 2013. Section 4.2 of the MWP paper uses this frame.

    **Arguments:**

    - `filters`: the number of filters including the scaling function, at least 2, by default 6.
    """

    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        return meyer_polynomial(ramp)


class SimpleTight(_DyadicBands):
    """The simple tight frame: a filter bank of octave bands that is a Parseval frame.

    The bands and the argument are those of `Meyer`, but each filter rises like sin² over an octave. The frame
    is that of Göbel, Blanchard and von Luxburg, "Construction of tight frames on graphs and application to
    denoising", 2018. Their construction is based on Coulhon, Kerkyacharian and Petrushev 2012.
    """

    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        xp = namespace(ramp)
        sine, cosine = xp.sin(math.pi / 2 * ramp), xp.cos(math.pi / 2 * ramp)
        # This is `2 / pi * arcsin(sine**2)`, written with `arctan2`, which is smooth at both ends of the
        # ramp.
        return 2 / math.pi * xp.arctan2(sine**2, cosine * xp.sqrt(1 + sine**2))


class _TwoBands(_Transitions):
    """A low-pass and a high-pass filter, with a transition that starts at `edge`."""

    edge: Float[Array, ""] = field(converter=as_parameter, default=1 / 3)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge, high=1.0)

    @abc.abstractmethod
    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        """Return `theta / (pi / 2)` for each value of `excess`, which is `lambda / edge - 1`."""

    def transitions(self, points: Points, lambda_max: Float[Array, ""]) -> Float[Array, "wavelets p"]:
        edge = lambda_max * namespace(points, self.edge).asarray(self.edge, points.dtype)
        return self.profile(points / edge - 1)[None, :]


class Held(_TwoBands):
    """A Parseval frame of a low-pass and a high-pass filter, with a cubic transition over one octave.

    The low-pass filter falls from 1 to 0 between the edge and twice the edge, while the high-pass filter
    rises. The filters are those of Held, Storath, Massopust and Forster, "Steerable wavelet frames based on
    the Riesz transform", 2010.

    **Arguments:**

    - `edge`: the eigenvalue at which the transition starts, as a fraction of lambda_max, in (0, 1), by
      default 1/3. If the edge is above 1/2, the high-pass filter does not reach 1 on [0, lambda_max].
    """

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        ramp = namespace(excess).clip(excess, 0, 1)
        return ramp**2 * (3 - 2 * ramp)


class Simoncelli(_TwoBands):
    """A Parseval frame of a low-pass and a high-pass filter, with a log-linear transition over one octave.

    The filters are the cosine and the sine of an angle that is linear in the logarithm of the eigenvalue,
    between the edge and twice the edge. The argument is that of `Held`. The filters are those of Portilla and
    Simoncelli, "A parametric texture model based on joint statistics of complex wavelet coefficients", 2000.
    """

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        xp = namespace(excess)
        return xp.log2(1 + xp.clip(excess, 0, 1))


class Papadakis(_TwoBands):
    """A Parseval frame of a low-pass and a high-pass filter, with a linear transition.

    The filters are the cosine and the sine of an angle that is linear in the eigenvalue, between the edge and
    5/3 times the edge. The filters are those of Romero, Alexander, Baid, Jain and Papadakis, "The geometry
    and the analytic properties of isotropic multiresolution analysis", 2009.

    **Arguments:**

    - `edge`: the eigenvalue at which the transition starts, as a fraction of lambda_max, in (0, 1), by
      default 3/8. If the edge is above 3/5, the high-pass filter does not reach 1 on [0, lambda_max].
    """

    edge: Float[Array, ""] = field(converter=as_parameter, default=3 / 8)

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        return namespace(excess).clip(1.5 * excess, 0, 1)


class Regular(_Transitions):
    """A Parseval frame of a low-pass and a high-pass filter, with a transition over the whole spectrum.

    The filters are the cosine and the sine of the angle `pi/4 (1 + s)`. To compute s, the function `sin(pi/2
    x)` is applied `degree` times to `x = 2 lambda / lambda_max - 1`. The filters are from Perraudin et al.,
    "GSPBOX: A toolbox for signal processing on graphs", 2014.

    **Arguments:**

    - `degree`: the number of times that the sine is applied, at least 0, by default 3. A higher degree makes
      the transition steeper.
    """

    degree: int = field(static=True, default=3)

    def __check_init__(self) -> None:
        check_integer("the degree of Regular", self.degree)
        if self.degree < 0:
            raise ValueError(f"the degree of Regular cannot be negative, but is {self.degree}")

    def transitions(self, points: Points, lambda_max: Float[Array, ""]) -> Float[Array, "wavelets p"]:
        xp = namespace(points, lambda_max)
        sine = xp.clip(2 * points / lambda_max - 1, -1, 1)
        for _ in range(self.degree):
            sine = xp.sin(math.pi / 2 * sine)
        return (1 + sine)[None, :] / 2


class ExponentialWindow(FilterBank):
    """A filter bank of one infinitely smooth low-pass filter. The bank is not tight.

    The filter is 1 at the eigenvalue 0, 1/2 at half the edge, and 0 beyond the edge. If the eigenvalue lambda
    is expressed as a fraction of lambda_max, the filter is `e(u) / (e(u) + e(1 - u))`. Here `e(u) =
    exp(-slope / u)` and `u = 1 - lambda / edge`. The filter is from Perraudin et al., "GSPBOX: A toolbox for
    signal processing on graphs", 2014.

    **Arguments:**

    - `edge`: the eigenvalue above which the filter is zero, as a fraction of lambda_max, positive, by default
      0.2.
    - `slope`: the steepness of the filter, positive, by default 1. At half the edge, the derivative of the
      filter with respect to `lambda / lambda_max` is `-2 slope / edge`.
    """

    edge: Float[Array, ""] = field(converter=as_parameter, default=0.2)
    slope: Float[Array, ""] = field(converter=as_parameter, default=1.0)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge)
        check_between(self, "slope", self.slope)

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        xp = namespace(points, eigenvalues, self.edge, self.slope)
        edge, slope = (xp.asarray(leaf, points.dtype) for leaf in (self.edge, self.slope))
        # Clipping excludes u = 0 and u = 1, where an exponent is infinite and has no gradient.
        tiny = xp.finfo(points.dtype).eps
        u = xp.clip(1 - points / (eigenvalues[-1] * edge), tiny, 1 - tiny)
        # The logistic function, without overflow.
        return xp.exp(-xp.logaddexp(0, slope / u - slope / (1 - u)))[None, :]


class LowPass(FilterBank):
    """A filter bank of one low-pass filter, for experiments without wavelets. The bank is not tight.

    The filter is the scaling function of `Meyer` with an adjustable edge. The filter is 1 up to the edge, and
    then falls smoothly to 0 at twice the edge.

    **Arguments:**

    - `edge`: the end of the pass band as a fraction of lambda_max, in (0, 1), by default 0.25.
    """

    edge: Float[Array, ""] = field(converter=as_parameter, default=0.25)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge, high=1.0)

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        xp = namespace(points, eigenvalues, self.edge)
        edge = eigenvalues[-1] * xp.asarray(self.edge, points.dtype)
        # Beyond twice the edge, this sine is exactly zero, but the equivalent `cos(pi / 2)` has a rounding
        # error.
        return xp.sin(math.pi / 2 * (1 - meyer_polynomial(xp.clip(points / edge - 1, 0, 1))))[None, :]


class Identity(FilterBank):
    """A filter bank of one filter that is 1 at every eigenvalue, for experiments without filtering.

    The bank is a Parseval frame and has no arguments.
    """

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        return namespace(points).ones_like(points)[None, :]
