"""Banks of one window that moves along the spectrum in even steps."""

from __future__ import annotations

import abc
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank, check_number_of_filters
from jaxsmw.core.checks import as_parameter, check_between


class _UniformTranslates(FilterBank):
    """One window that moves along the spectrum in even steps.

    `overlap` windows cover each point of [0, lambda_max]. If the squares of all integer translates of the
    window sum to a constant, the squares of the filters also sum to a constant.
    """

    filters: int = eqx.field(static=True, default=6)
    overlap: int = eqx.field(static=True, default=2)

    def __check_init__(self) -> None:
        check_number_of_filters(self, self.filters, self.overlap)

    @abc.abstractmethod
    def window(self, position: Float[Array, "filters p"]) -> Float[Array, "filters p"]:
        """Returns the window at positions in (-1/2, 1/2)."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        steps = points / eigenvalues[-1] * (self.filters - self.overlap + 1)
        centres = jnp.arange(self.filters, dtype=points.dtype) + (1 - self.overlap / 2)
        position = (steps[None, :] - centres[:, None]) / self.overlap
        return jnp.where(jnp.abs(position) < 0.5, self.window(position), 0)


class Itersine(_UniformTranslates):
    """Evenly spaced translates of the window `sin(pi/2 cos²(pi u))`. Their squares sum to one.

    This is the iterated sine of Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs", 2014.
    The squared window is 1/2 plus odd harmonics. The harmonics of an even number of translates cancel.

    **Arguments:**

    - `filters`: the number of filters, at least `overlap`.
    - `overlap`: the number of windows that cover each point, an even number, at least 2.

    **Raises:** `TypeError` if `filters` is not an integer; `ValueError` if a parameter is outside its range.
    """

    def __check_init__(self) -> None:
        if self.overlap < 2 or self.overlap % 2:
            raise ValueError(f"the overlap of Itersine must be even and positive, not {self.overlap}")

    def window(self, position: Float[Array, "filters p"]) -> Float[Array, "filters p"]:
        return math.sqrt(2 / self.overlap) * jnp.sin(jnp.pi / 2 * jnp.cos(jnp.pi * position) ** 2)


class HalfCosine(_UniformTranslates):
    """Evenly spaced translates of the Hann window `cos²(pi u)`. Their squares sum to one.

    These are the uniform translates of Shuman, Wiesmeyr, Holighaus and Vandergheynst, "Spectrum-adapted tight
    graph wavelet and vertex-frequency frames", 2015. In that paper the squares sum to `3/8 overlap`.

    **Arguments:**

    - `filters`: the number of filters, at least `overlap`.
    - `overlap`: the number of windows that cover each point, at least 3.

    **Raises:** `TypeError` if `filters` is not an integer; `ValueError` if a parameter is outside its range.
    """

    overlap: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        if self.overlap < 3:
            raise ValueError(f"the overlap of HalfCosine must be at least 3, not {self.overlap}")

    def window(self, position: Float[Array, "filters p"]) -> Float[Array, "filters p"]:
        return math.sqrt(8 / (3 * self.overlap)) * jnp.cos(jnp.pi * position) ** 2


class Gabor(FilterBank):
    """Gaussians with evenly spaced centres from 0 to lambda_max: short-time Fourier analysis of a shape.

    The bank follows Shuman, Ricaud and Vandergheynst, "Vertex-frequency analysis on graphs", 2016, but with
    few centres instead of one centre at every eigenvalue. The bank is not tight.

    **Arguments:**

    - `filters`: the number of filters, at least 2.
    - `width`: the standard deviation of the Gaussians relative to the spacing of the centres, positive.

    **Raises:** `TypeError` if `filters` is not an integer; `ValueError` if a parameter is outside its range.
    """

    filters: int = eqx.field(static=True, default=6)
    width: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.5)

    def __check_init__(self) -> None:
        check_number_of_filters(self, self.filters, 2)
        check_between(self, "width", self.width)

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        steps = points / eigenvalues[-1] * (self.filters - 1)
        centres = jnp.arange(self.filters, dtype=points.dtype)
        offsets = (steps[None, :] - centres[:, None]) / jnp.asarray(self.width, points.dtype)
        return jnp.exp(-(offsets**2) / 2)
