"""Tight frames made of smooth transitions between neighbouring bands: octave bands and pairs of bands."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank, check_number_of_filters
from jaxsmw.core.checks import as_parameter, check_between


class _Transitions(FilterBank):
    """Bands with transitions between them: cos(theta_1), sin(theta_1) cos(theta_2), …, sin(theta_L).

    Each theta rises from 0 to pi/2. The squares sum to cos² + sin² = 1 because each transition starts where
    the previous transition has ended.
    """

    @abc.abstractmethod
    def transitions(
        self, points: Float[Array, " p"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "wavelets p"]:
        """Returns the progress of each transition from 0 to 1: theta / (pi / 2)."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        theta = jnp.pi / 2 * self.transitions(points, eigenvalues[-1])
        fall, rise = jnp.cos(theta), jnp.sin(theta)
        return jnp.concatenate([fall[:1], rise[:-1] * fall[1:], rise[-1:]])


class _DyadicBands(_Transitions):
    """Octave bands: each band rises over one octave and falls over the next. The last band never falls."""

    filters: int = eqx.field(static=True, default=6)

    def __check_init__(self) -> None:
        check_number_of_filters(self, self.filters, 2)

    @abc.abstractmethod
    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        """Returns the transition as a function of a linear ramp; both run from 0 to 1."""

    def transitions(
        self, points: Float[Array, " p"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "wavelets p"]:
        # Only the eigenvalue 0 is 100 octaves below the largest eigenvalue, and 2^octaves must not overflow.
        octaves = np.minimum(np.arange(self.filters - 1, 0, -1), 100)
        ratios = (points / lambda_max)[None, :] * jnp.asarray(2.0**octaves, points.dtype)[:, None]
        return self.profile(jnp.clip(ratios - 1, 0, 1))


def meyer_polynomial(ramp: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns nu(u), elementwise, for an array of any shape with numbers u from 0 to 1.

    nu is the polynomial of least degree with nu(u) + nu(1 - u) = 1 and 3 vanishing derivatives at 0 and 1.
    """
    return ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)


class Meyer(_DyadicBands):
    """The Meyer tight frame: octave bands whose squares sum to one exactly.

    Leonardi and Van De Ville, "Tight wavelet frames on multislice graphs", 2013. Section 4.2 of the MWP paper
    uses this frame. The scaling function passes the lowest band, which is the *largest* spatial scale. The
    bank would not be tight if the scaling function and the finest wavelet were exchanged.

    **Arguments:**

    - `filters`: the number of filters including the scaling function, at least 2.

    **Raises:** `TypeError` if `filters` is not an integer; `ValueError` for fewer than 2 filters.
    """

    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        return meyer_polynomial(ramp)


class SimpleTight(_DyadicBands):
    """The simple tight frame: the octave bands of `Meyer`, but each band rises like sin².

    Göbel, Blanchard and von Luxburg, "Construction of tight frames on graphs and application to denoising",
    2018, after Coulhon, Kerkyacharian and Petrushev 2012.

    **Arguments:**

    - `filters`: the number of filters including the scaling function, at least 2.

    **Raises:** `TypeError` if `filters` is not an integer; `ValueError` for fewer than 2 filters.
    """

    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        sine, cosine = jnp.sin(jnp.pi / 2 * ramp), jnp.cos(jnp.pi / 2 * ramp)
        # This is the angle whose sine is sine², in a form that is smooth at both ends.
        return 2 / jnp.pi * jnp.arctan2(sine**2, cosine * jnp.sqrt(1 + sine**2))


class _TwoBands(_Transitions):
    """A low-pass and a high-pass filter with one transition, which starts at an edge."""

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=1 / 3)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge, high=1.0)

    @abc.abstractmethod
    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        """Returns the transition from 0 to 1 as a function of `lambda / edge - 1`."""

    def transitions(
        self, points: Float[Array, " p"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "wavelets p"]:
        edge = lambda_max * jnp.asarray(self.edge, points.dtype)
        return self.profile(points / edge - 1)[None, :]


class Held(_TwoBands):
    """A low-pass and a high-pass filter with a cubic transition over one octave.

    Held, Storath, Massopust and Forster, "Steerable wavelet frames based on the Riesz transform", 2010.

    **Arguments:**

    - `edge`: the start of the octave relative to lambda_max, in (0, 1). Above 1/2 the high-pass filter does
      not reach one.

    **Raises:** `ValueError` if the edge is not one number in (0, 1).
    """

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        ramp = jnp.clip(excess, 0, 1)
        return ramp**2 * (3 - 2 * ramp)


class Simoncelli(_TwoBands):
    """A low-pass and a high-pass filter with a transition over one octave that is linear in log lambda.

    Portilla and Simoncelli, "A parametric texture model based on joint statistics of complex wavelet
    coefficients", 2000.

    **Arguments:**

    - `edge`: the start of the octave relative to lambda_max, in (0, 1). Above 1/2 the high-pass filter does
      not reach one.

    **Raises:** `ValueError` if the edge is not one number in (0, 1).
    """

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        return jnp.log2(1 + jnp.clip(excess, 0, 1))


class Papadakis(_TwoBands):
    """A low-pass and a high-pass filter with a linear transition from the edge to 5/3 of the edge.

    Romero, Alexander, Baid, Jain and Papadakis, "The geometry and the analytic properties of isotropic
    multiresolution analysis", 2009.

    **Arguments:**

    - `edge`: the start of the transition relative to lambda_max, in (0, 1). Above 3/5 the high-pass filter
      does not reach one.

    **Raises:** `ValueError` if the edge is not one number in (0, 1).
    """

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=3 / 8)

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        return jnp.clip(1.5 * excess, 0, 1)


class Regular(_Transitions):
    """A low-pass and a high-pass filter with a transition over the whole interval.

    The angle is `pi/4 (1 + s)`. The number s results from `2 lambda / lambda_max - 1` by `degree`
    applications of `sin(pi/2 ·)` (Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs",
    2014).

    **Arguments:**

    - `degree`: how often the sine is applied, 0 or more. Higher degrees make the transition steeper.

    **Raises:** `ValueError` if the degree is negative.
    """

    degree: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        if self.degree < 0:
            raise ValueError(f"the degree of Regular cannot be negative, but is {self.degree}")

    def transitions(
        self, points: Float[Array, " p"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "wavelets p"]:
        sine = jnp.clip(2 * points / lambda_max - 1, -1, 1)
        for _ in range(self.degree):
            sine = jnp.sin(jnp.pi / 2 * sine)
        return (1 + sine)[None, :] / 2
