"""Filter banks: the scaling function and the wavelets, sampled over the spectrum.

Every bank here depends on ratios of eigenvalues only, so that the scale of a shape cancels. The first filter
is the one that passes the lowest eigenvalues.

Parseval (the squares sum to one): `Meyer`, `SimpleTight`, `Itersine`, `HalfCosine`, `Held`, `Simoncelli`,
`Papadakis`, `Regular`, `SoftmaxFrame` (to be learned), and each of them `Warped`; also `Identity`. Not tight:
`CubicSpline`, `MexicanHat`, `Heat`, `Gabor`, `ExponentialWindow`, `LowPass`; `jaxsmw.core.frames.tighten`
makes a tight frame of any.
"""

from __future__ import annotations

import abc
import math
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmw.core.checks import as_parameter, check_between, check_choice


class FilterBank(eqx.Module):
    """A scaling function g_0 and wavelets g_1 … g_L, as functions of the eigenvalue.

    A bank is a pytree: continuous parameters are leaves (traced, learnable), sizes are static. To add one,
    subclass and write `__call__`.
    """

    @abc.abstractmethod
    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        """The responses g_l at some points; on a shape, `bank(eigenvalues, eigenvalues)`.

        **Arguments:**

        - `points`: where to sample, in any order, in [0, lambda_max].
        - `eigenvalues`: those of the shape that the bank is laid out on, ascending; lambda_max is the last.
        """


def sample_bank(
    bank: FilterBank, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
) -> Float[Array, "filters p"]:
    """The responses of a bank; its own, or someone else's, who may have overlooked what shape they need.

    **Raises:** `ValueError` if they have another shape.
    """
    responses = bank(points, eigenvalues)
    if responses.ndim != 2 or responses.shape[1] != points.shape[0]:
        raise ValueError(
            f"the bank {type(bank).__name__} gave responses of shape {responses.shape} at {points.shape[0]} "
            f"points, where (filters, {points.shape[0]}) is needed"
        )
    return responses


def _require_filters(bank: FilterBank, filters: int, least: int) -> None:
    if not isinstance(filters, int | np.integer):
        raise TypeError(f"{type(bank).__name__} needs a whole number of filters, not {filters!r}")
    if filters < least:
        raise ValueError(f"{type(bank).__name__} needs at least {least} filters, not {filters}")


# Partitions of unity made of transitions


class _Transitions(FilterBank):
    """Bands that hand over to each other: cos(theta_1), sin(theta_1) cos(theta_2), …, sin(theta_L).

    Each theta climbs from 0 to pi/2. Because a transition starts only where the one before it has ended, the
    squares sum to cos² + sin² = 1.
    """

    @abc.abstractmethod
    def transitions(
        self, points: Float[Array, " p"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "wavelets p"]:
        """How far each transition has come, from 0 to 1: theta / (pi / 2)."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        theta = jnp.pi / 2 * self.transitions(points, eigenvalues[-1])
        fall, rise = jnp.cos(theta), jnp.sin(theta)
        return jnp.concatenate([fall[:1], rise[:-1] * fall[1:], rise[-1:]])


class _DyadicBands(_Transitions):
    """Octave bands: each rises over one octave and falls over the next; the last one never falls."""

    filters: int = eqx.field(static=True, default=6)

    def __check_init__(self) -> None:
        _require_filters(self, self.filters, 2)

    @abc.abstractmethod
    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        """The transition in terms of a linear one, both from 0 to 1."""

    def transitions(
        self, points: Float[Array, " p"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "wavelets p"]:
        # So many octaves below the largest eigenvalue there is nothing but zero, and soon no float either.
        octaves = np.minimum(np.arange(self.filters - 1, 0, -1), 100)
        ratios = (points / lambda_max)[None, :] * jnp.asarray(2.0**octaves, points.dtype)[:, None]
        return self.profile(jnp.clip(ratios - 1, 0, 1))


def _meyer_polynomial(ramp: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The smallest polynomial with nu(u) + nu(1 - u) = 1 and three vanishing derivatives at both ends."""
    return ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)


class Meyer(_DyadicBands):
    """The Meyer tight frame: octave bands whose squares sum to one exactly.

    Leonardi and Van De Ville, "Tight wavelet frames on multislice graphs", 2013; the frame of the MWP
    paper's section 4.2. The scaling function passes the lowest band, i.e. the *largest* spatial scale:
    exchanged with the finest wavelet the bank would no longer be tight.

    **Arguments:**

    - `filters`: how many, scaling function included; at least 2.
    """

    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        return _meyer_polynomial(ramp)


class SimpleTight(_DyadicBands):
    """The simple tight frame: the octave bands of `Meyer`, each of which rises like sin².

    Göbel, Blanchard and von Luxburg, "Construction of tight frames on graphs and application to denoising",
    2018, after Coulhon, Kerkyacharian and Petrushev 2012.

    **Arguments:**

    - `filters`: how many, scaling function included; at least 2.
    """

    def profile(self, ramp: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        sine, cosine = jnp.sin(jnp.pi / 2 * ramp), jnp.cos(jnp.pi / 2 * ramp)
        # The angle whose sine is sine², written so that it is smooth at both ends.
        return 2 / jnp.pi * jnp.arctan2(sine**2, cosine * jnp.sqrt(1 + sine**2))


class _TwoBands(_Transitions):
    """A low-pass and a high-pass filter that meet above an edge."""

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=1 / 3)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge, high=1.0)

    @abc.abstractmethod
    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        """The transition, from 0 to 1, in terms of `lambda / edge - 1`."""

    def transitions(
        self, points: Float[Array, " p"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "wavelets p"]:
        edge = lambda_max * jnp.asarray(self.edge, points.dtype)
        return self.profile(points / edge - 1)[None, :]


class Held(_TwoBands):
    """A low-pass and a high-pass filter that meet over one octave, along a cubic.

    Held, Storath, Massopust and Forster, "Steerable wavelet frames based on the Riesz transform", 2010.

    **Arguments:**

    - `edge`: where the octave starts, relative to lambda_max; in (0, 1), above 1/2 the high-pass filter does
      not come to one.
    """

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        ramp = jnp.clip(excess, 0, 1)
        return ramp**2 * (3 - 2 * ramp)


class Simoncelli(_TwoBands):
    """A low-pass and a high-pass filter that meet over one octave, evenly in the logarithm.

    Portilla and Simoncelli, "A parametric texture model based on joint statistics of complex wavelet
    coefficients", 2000.

    **Arguments:**

    - `edge`: where the octave starts, relative to lambda_max; in (0, 1), above 1/2 the high-pass filter does
      not come to one.
    """

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        return jnp.log2(1 + jnp.clip(excess, 0, 1))


class Papadakis(_TwoBands):
    """A low-pass and a high-pass filter that meet between an edge and 5/3 of it, evenly in the angle.

    Romero, Alexander, Baid, Jain and Papadakis, "The geometry and the analytic properties of isotropic
    multiresolution analysis", 2009.

    **Arguments:**

    - `edge`: where the transition starts, relative to lambda_max; in (0, 1), above 3/5 the high-pass filter
      does not come to one.
    """

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=3 / 8)

    def profile(self, excess: Float[Array, " p"]) -> Float[Array, " p"]:
        return jnp.clip(1.5 * excess, 0, 1)


class Regular(_Transitions):
    """A low-pass and a high-pass filter that meet over the whole interval, the steeper the higher the degree.

    The angle is `pi/4 (1 + s)`, where s is `2 lambda / lambda_max - 1` under `sin(pi/2 ·)`, applied `degree`
    times (Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs", 2014).

    **Arguments:**

    - `degree`: how often the sine is applied; 0 for none.
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


# Translates


class _UniformTranslates(FilterBank):
    """One window, moved along the spectrum in even steps.

    `overlap` of the windows meet everywhere in [0, lambda_max], so that their squares sum to a constant
    wherever those of all integer translates of the window do.
    """

    filters: int = eqx.field(static=True, default=6)
    overlap: int = eqx.field(static=True, default=2)

    def __check_init__(self) -> None:
        _require_filters(self, self.filters, self.overlap)

    @abc.abstractmethod
    def window(self, position: Float[Array, "filters p"]) -> Float[Array, "filters p"]:
        """The window on (-1/2, 1/2)."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        steps = points / eigenvalues[-1] * (self.filters - self.overlap + 1)
        centres = jnp.arange(self.filters, dtype=points.dtype) + (1 - self.overlap / 2)
        position = (steps[None, :] - centres[:, None]) / self.overlap
        return jnp.where(jnp.abs(position) < 0.5, self.window(position), 0)


class Itersine(_UniformTranslates):
    """Even translates of the window `sin(pi/2 cos²(pi u))`, whose squares sum to one.

    The iterated sine of Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs", 2014. The
    squared window is 1/2 plus odd harmonics only, which cancel among an even number of translates.

    **Arguments:**

    - `filters`: how many; at least `overlap`.
    - `overlap`: how many windows meet; even.
    """

    def __check_init__(self) -> None:
        if self.overlap < 2 or self.overlap % 2:
            raise ValueError(f"the overlap of Itersine must be even and positive, not {self.overlap}")

    def window(self, position: Float[Array, "filters p"]) -> Float[Array, "filters p"]:
        return math.sqrt(2 / self.overlap) * jnp.sin(jnp.pi / 2 * jnp.cos(jnp.pi * position) ** 2)


class HalfCosine(_UniformTranslates):
    """Even translates of the Hann window `cos²(pi u)`, whose squares sum to one.

    The uniform translates of Shuman, Wiesmeyr, Holighaus and Vandergheynst, "Spectrum-adapted tight graph
    wavelet and vertex-frequency frames", 2015; theirs sum to `3/8 overlap`.

    **Arguments:**

    - `filters`: how many; at least `overlap`.
    - `overlap`: how many windows meet; at least 3.
    """

    overlap: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        if self.overlap < 3:
            raise ValueError(f"the overlap of HalfCosine must be at least 3, not {self.overlap}")

    def window(self, position: Float[Array, "filters p"]) -> Float[Array, "filters p"]:
        return math.sqrt(8 / (3 * self.overlap)) * jnp.cos(jnp.pi * position) ** 2


class Gabor(FilterBank):
    """Gaussians at evenly spaced centres, from 0 to lambda_max: short-time Fourier analysis of a shape.

    After Shuman, Ricaud and Vandergheynst, "Vertex-frequency analysis on graphs", 2016, with few centres in
    place of one at every eigenvalue. Not tight.

    **Arguments:**

    - `filters`: how many; at least 2.
    - `width`: standard deviation of the Gaussians, relative to the distance of the centres; positive.
    """

    filters: int = eqx.field(static=True, default=6)
    width: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.5)

    def __check_init__(self) -> None:
        _require_filters(self, self.filters, 2)
        check_between(self, "width", self.width)

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        steps = points / eigenvalues[-1] * (self.filters - 1)
        centres = jnp.arange(self.filters, dtype=points.dtype)
        offsets = (steps[None, :] - centres[:, None]) / jnp.asarray(self.width, points.dtype)
        return jnp.exp(-(offsets**2) / 2)


# Dilates


class _LogSpacedDilates(FilterBank):
    """One wavelet at log-spaced scales, and a scaling function for what lies below `lambda_max / ratio`."""

    filters: int = eqx.field(static=True, default=6)
    ratio: Float[Array, ""] = eqx.field(converter=as_parameter, default=20.0)
    normalize: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        _require_filters(self, self.filters, 2)
        check_between(self, "ratio", self.ratio, low=1.0)

    @abc.abstractmethod
    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        """The wavelet at scale 1."""

    @abc.abstractmethod
    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        """The scaling function, its argument 1 at `lambda_max / ratio`."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        relative, ratio = points / eigenvalues[-1], jnp.asarray(self.ratio, points.dtype)
        # In units of 1 / lambda_max; the coarsest is 2 / lambda_min and the finest 1 / lambda_max.
        scales = (2 * ratio) ** jnp.linspace(1, 0, self.filters - 1, dtype=points.dtype)
        wavelets = self.wavelet(scales[:, None] * relative[None, :])
        if self.normalize:
            wavelets = jnp.sqrt(scales)[:, None] * wavelets
        return jnp.concatenate([self.scaling_function(ratio * relative)[None, :], wavelets])


class CubicSpline(_LogSpacedDilates):
    """Dilates of a wavelet that rises like y², falls like 4 / y² and is a cubic spline between.

    The wavelet of Hammond, Vandergheynst and Gribonval, "Wavelets on graphs via spectral graph theory", 2011
    ("abspline"), and the general one of the MWP paper. Not tight: with the default parameters its frame
    bounds are 1.28 and 2.12.

    **Arguments:**

    - `filters`: how many, scaling function included; at least 2.
    - `ratio`: lambda_max over the smallest eigenvalue that the wavelets have to cover; above 1.
    - `normalize`: multiply each wavelet by the square root of its scale (in units of 1 / lambda_max).
    """

    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        spline = -5 + 11 * scaled - 6 * scaled**2 + scaled**3
        # The maximum keeps the branch that is not taken from dividing by zero.
        tail = 4 / jnp.maximum(scaled, 2) ** 2
        return jnp.where(scaled < 1, scaled**2, jnp.where(scaled < 2, spline, tail))

    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        # As high at zero as the wavelet's maximum, which is at 2 - 1 / sqrt(3).
        return (1 + 2 / (3 * math.sqrt(3))) * jnp.exp(-((scaled / 0.6) ** 4))


class MexicanHat(_LogSpacedDilates):
    """Dilates of the Mexican hat `y exp(-y)`, the second derivative of a Gaussian.

    The wavelet of Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs", 2014, at the
    scales of Hammond, Vandergheynst and Gribonval 2011. Not tight: with the default parameters its frame
    bounds are 0.177 and 0.270.

    **Arguments:**

    - `filters`: how many, scaling function included; at least 2.
    - `ratio`: lambda_max over the smallest eigenvalue that the wavelets have to cover; above 1.
    - `normalize`: multiply each wavelet by the square root of its scale (in units of 1 / lambda_max).
    """

    def wavelet(self, scaled: Float[Array, "wavelets p"]) -> Float[Array, "wavelets p"]:
        return scaled * jnp.exp(-scaled)

    def scaling_function(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        return 1.2 / math.e * jnp.exp(-((scaled / 0.4) ** 4))


class Heat(FilterBank):
    """Heat kernels `exp(-t lambda / lambda_max)`, all of them low-pass.

    Sun, Ovsjanikov and Guibas, "A concise and provably informative multi-scale signature based on heat
    diffusion", 2009. Not tight.

    **Arguments:**

    - `times`: (filters,) of diffusion, in units of 1 / lambda_max; positive.
    """

    times: Float[Array, " filters"] = eqx.field(converter=as_parameter)

    def __check_init__(self) -> None:
        check_between(self, "times", self.times, ndim=1)
        if not self.times.size:
            raise ValueError("the times of Heat must be a list of at least one")

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        relative = points / eigenvalues[-1]
        return jnp.exp(-jnp.asarray(self.times, points.dtype)[:, None] * relative[None, :])


# One filter


class ExponentialWindow(FilterBank):
    """One low-pass filter, infinitely smooth: one at zero, one half at half the edge, zero from the edge on.

    `e(u) / (e(u) + e(1 - u))` with `e(u) = exp(-slope / u)` and `u = 1 - lambda / edge` (Perraudin et al.,
    "GSPBOX: A toolbox for signal processing on graphs", 2014).

    **Arguments:**

    - `edge`: relative to lambda_max; positive.
    - `slope`: how steep, `-2 slope / edge` at one half; positive.
    """

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.2)
    slope: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge)
        check_between(self, "slope", self.slope)

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        edge, slope = (jnp.asarray(leaf, points.dtype) for leaf in (self.edge, self.slope))
        # Away from both ends, where the exponents are infinite and have no gradient.
        tiny = jnp.finfo(points.dtype).eps
        u = jnp.clip(1 - points / (eigenvalues[-1] * edge), tiny, 1 - tiny)
        return jax.nn.sigmoid(slope / (1 - u) - slope / u)[None, :]


class LowPass(FilterBank):
    """One low-pass filter and no wavelets: a control that smooths at a single scale.

    The scaling function of `Meyer`, with an edge of its own. Not tight.

    **Arguments:**

    - `edge`: up to where it is one, relative to lambda_max, in (0, 1); it vanishes from twice the edge on.
    """

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.25)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge, high=1.0)

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        edge = eigenvalues[-1] * jnp.asarray(self.edge, points.dtype)
        # The sine of what is left, because the cosine of pi/2 is not quite zero.
        return jnp.sin(jnp.pi / 2 * (1 - _meyer_polynomial(jnp.clip(points / edge - 1, 0, 1))))[None, :]


class Identity(FilterBank):
    """One filter that passes everything: the control in which nothing is filtered. Parseval."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        return jnp.ones_like(points)[None, :]


# A bank to be learned


class SoftmaxFrame(FilterBank):
    """Filters whose squares are a softmax, so that they sum to one whatever (finite) the parameters are.

    `g_l(lambda)² = exp(z_l) / sum_j exp(z_j)`, each z_l linear in lambda between evenly spaced knots. Every
    Parseval frame of positive filters is one up to the resolution of the knots; to learn one, start
    `like` a known bank and follow the gradient. On eigenvalues whose low end matters, wrap it in
    `Warped(…, Power())`, which spaces the knots evenly in frequency.

    **Arguments:**

    - `logits`: (filters, knots), z at the knots, from 0 to lambda_max; at least 2 knots. Adding a constant to
      a column changes nothing.
    """

    logits: Float[Array, "filters knots"] = eqx.field(converter=as_parameter)

    def __check_init__(self) -> None:
        if self.logits.ndim != 2 or self.logits.shape[0] < 1 or self.logits.shape[1] < 2:
            raise ValueError(
                f"the logits of SoftmaxFrame have shape {self.logits.shape}, where (filters, knots) with at "
                "least 2 knots is needed"
            )

    @classmethod
    def like(cls, bank: FilterBank, knots: int = 32, *, floor: float = 0.01) -> SoftmaxFrame:
        """A frame that agrees with a bank at its knots, up to the bank's frame function.

        Of a bank that is adapted to a spectrum, with that for evenly spaced eigenvalues.

        **Arguments:**

        - `bank`: any bank, of any sign: squares are what counts.
        - `knots`: how many; at least 2.
        - `floor`: raises filters where they are less, since one that is zero cannot be learned.

        **Raises:** `ValueError` for fewer than 2 knots, or a floor outside 1e-12 to 1.
        """
        if knots < 2 or not 1e-12 <= floor < 1:
            raise ValueError(
                f"SoftmaxFrame.like needs at least 2 knots and a floor from 1e-12 to 1, not {knots}, {floor}"
            )
        points = jnp.linspace(0, 1, knots)
        return cls(2 * jnp.log(jnp.maximum(jnp.abs(sample_bank(bank, points, points)), floor)))

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        knots = jnp.linspace(0, 1, self.logits.shape[1], dtype=points.dtype)
        relative, logits = points / eigenvalues[-1], self.logits.astype(points.dtype)
        heights = jax.vmap(lambda z: jnp.interp(relative, knots, z))(logits)
        return jnp.exp(jax.nn.log_softmax(heights, axis=0) / 2)


# Banks adapted to the spectrum


class Warp(eqx.Module):
    """A monotone map of the spectrum; what it maps lambda to is up to its scale."""

    @abc.abstractmethod
    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        """The warped points, from the points and the eigenvalues of a shape as a bank gets them."""


class Warped(FilterBank):
    """A bank laid out on a warped spectrum: `g_l(warp(lambda))`. A Parseval bank stays Parseval.

    Shuman, Wiesmeyr, Holighaus and Vandergheynst, "Spectrum-adapted tight graph wavelet and vertex-frequency
    frames", 2015.

    **Arguments:**

    - `bank`: any bank; uniform translates come out as wavelets under a `Logarithm`, and as bands of equally
      many eigenvalues under the `SpectralDistribution`.
    - `warp`: the warp.
    """

    bank: FilterBank
    warp: Warp

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        return self.bank(self.warp(points, eigenvalues), self.warp(eigenvalues, eigenvalues))


class Logarithm(Warp):
    """`log(1 + strength lambda / lambda_max)`: linear below `lambda_max / strength`, logarithmic above.

    **Arguments:**

    - `strength`: positive.
    """

    strength: Float[Array, ""] = eqx.field(converter=as_parameter, default=10.0)

    def __check_init__(self) -> None:
        check_between(self, "strength", self.strength)

    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        return jnp.log1p(jnp.asarray(self.strength, points.dtype) * (points / eigenvalues[-1]))


class Power(Warp):
    """`(lambda / lambda_max)^exponent`; the square root, by default, turns eigenvalues into frequencies.

    **Arguments:**

    - `exponent`: positive.
    """

    exponent: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.5)

    def __check_init__(self) -> None:
        check_between(self, "exponent", self.exponent)

    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        relative = points / eigenvalues[-1]
        # The slope at zero is infinite, and zero is an eigenvalue: its slope is taken to be zero.
        positive = jnp.where(relative > 0, relative, 1)
        return jnp.where(relative > 0, positive ** jnp.asarray(self.exponent, points.dtype), 0)


class ControlPoints(Warp):
    """A monotone curve through control points, continued as a straight line beyond them.

    The cubic is that of Fritsch and Carlson, "Monotone piecewise cubic interpolation", 1980.

    **Arguments:**

    - `positions`: (c,), ascending, relative to lambda_max; c at least 2.
    - `values`: (c,), ascending; those at positions 0 and 1 are the ends of the warped interval, the first of
      which should be 0.
    - `kind`: `"linear"` between the points, or `"cubic"` with a continuous slope.
    """

    positions: Float[Array, " c"] = eqx.field(converter=as_parameter)
    values: Float[Array, " c"] = eqx.field(converter=as_parameter)
    kind: Literal["linear", "cubic"] = eqx.field(static=True, default="linear")

    def __check_init__(self) -> None:
        check_choice("kind", self.kind, ("linear", "cubic"))
        if self.positions.ndim != 1 or self.positions.shape != self.values.shape or self.values.size < 2:
            raise ValueError(
                "ControlPoints needs as many positions as values and at least 2, "
                f"not arrays of shapes {self.positions.shape} and {self.values.shape}"
            )
        for name, array in (("positions", self.positions), ("values", self.values)):
            if not isinstance(array, jax.core.Tracer) and not (np.diff(np.asarray(array)) > 0).all():
                raise ValueError(f"the {name} of ControlPoints must ascend, but are {np.asarray(array)}")

    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        relative = points / eigenvalues[-1]
        positions, values = (jnp.asarray(leaf, points.dtype) for leaf in (self.positions, self.values))
        if self.kind == "linear":
            return jnp.interp(relative, positions, values, left="extrapolate", right="extrapolate")
        gaps = jnp.diff(positions)
        secants = jnp.diff(values) / gaps
        slopes = jnp.concatenate([secants[:1], (secants[1:] + secants[:-1]) / 2, secants[-1:]])
        # Over each gap the slopes at its ends must lie in a circle of radius 3 secants.
        lengths = jnp.sqrt(jnp.maximum(slopes[1:] ** 2 + slopes[:-1] ** 2, 9 * secants**2))
        shrink = jnp.pad(3 * secants / lengths, 1, constant_values=1)
        slopes *= jnp.minimum(shrink[1:], shrink[:-1])
        inside = jnp.clip(relative, positions[0], positions[-1])
        left = jnp.clip(jnp.searchsorted(positions, inside, side="right") - 1, 0, gaps.size - 1)
        gap = gaps[left]
        u = (inside - positions[left]) / gap
        return (
            jnp.where(relative < inside, slopes[0], slopes[-1]) * (relative - inside)
            + values[left]
            + (values[left + 1] - values[left]) * u**2 * (3 - 2 * u)
            + gap * u * (1 - u) * (slopes[left] * (1 - u) - slopes[left + 1] * u)
        )


class SpectralDistribution(Warp):
    """How many eigenvalues lie below, interpolated linearly: gives every band equally many of them.

    Uniform translates of it all pass equally many eigenvalues, the first and the last half as many. The warp
    of Shuman, Wiesmeyr, Holighaus and Vandergheynst 2015. An eigenvalue is mapped to its index, a
    repeated one to the mean of its indices, so that all of an eigenspace is filtered alike. Where none is
    repeated, the responses at the eigenvalues depend on nothing but their indices. By Weyl's law the
    eigenvalues of a surface grow nearly evenly, so there this warp is close to the identity.
    """

    def __call__(self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]) -> Float[Array, " p"]:
        # What is repeated comes out of an eigensolver as nearly equal.
        tolerance = 1e-6 * eigenvalues[-1]
        below = jnp.searchsorted(eigenvalues, eigenvalues - tolerance, side="left")
        not_above = jnp.searchsorted(eigenvalues, eigenvalues + tolerance, side="right")
        index = (below + not_above - 1).astype(points.dtype) / 2
        return jnp.interp(points, eigenvalues, index)
