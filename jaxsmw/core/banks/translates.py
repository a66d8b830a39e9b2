"""Filter banks of evenly spaced copies (translates) of one window."""

from __future__ import annotations

import abc
import math

from jaxtyping import Float

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.banks.base import Eigenvalues, FilterBank, Points, Responses, check_number_of_filters
from jaxsmw.core.checks import as_parameter, check_between, check_integer
from jaxsmw.core.module import field


class _UniformTranslates(FilterBank):
    """Evenly spaced translates of one window, of which `overlap` cover each point of [0, lambda_max]."""

    filters: int = field(static=True, default=6)
    overlap: int = field(static=True, default=2)

    def __check_init__(self) -> None:
        check_integer(f"the overlap of {type(self).__name__}", self.overlap)
        check_number_of_filters(self, self.filters, self.overlap)

    @abc.abstractmethod
    def window(self, position: Float[Array, "filters p"]) -> Responses:
        """Return the window at positions in (-1/2, 1/2), which are in units of the window's width."""

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        xp = namespace(points, eigenvalues)
        steps = points / eigenvalues[-1] * (self.filters - self.overlap + 1)
        centres = xp.arange(self.filters, dtype=points.dtype) + (1 - self.overlap / 2)
        position = (steps[None, :] - centres[:, None]) / self.overlap
        return xp.where(xp.abs(position) < 0.5, self.window(position), 0)


class Itersine(_UniformTranslates):
    """A Parseval frame of evenly spaced translates of the window `sin(pi/2 cos²(pi u))`.

    Here u is the difference between the eigenvalue and the centre of the window, in units of the window's
    width. The windows are zero for u below -1/2 or above 1/2. The first window passes the lowest eigenvalues.
    The window is the iterated sine of Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs",
    2014. The squared windows sum to a constant because `overlap` is even.

    **Arguments:**

    - `filters`: the number of filters, at least `overlap`, by default 6.
    - `overlap`: the number of windows that overlap at each eigenvalue, an even number of at least 2, by
      default 2.
    """

    def __check_init__(self) -> None:
        if self.overlap < 2 or self.overlap % 2:
            raise ValueError(f"the overlap of Itersine must be even and positive, not {self.overlap}")

    def window(self, position: Float[Array, "filters p"]) -> Responses:
        xp = namespace(position)
        return math.sqrt(2 / self.overlap) * xp.sin(math.pi / 2 * xp.cos(math.pi * position) ** 2)


class HalfCosine(_UniformTranslates):
    """A Parseval frame of evenly spaced translates of the Hann window `cos²(pi u)`, with u as in `Itersine`.

    The filters are the uniform translates of Shuman, Wiesmeyr, Holighaus and Vandergheynst, "Spectrum-adapted
    tight graph wavelet and vertex-frequency frames", 2015. The squared filters of that paper sum to `3
    overlap / 8`. Here the filters are scaled so that their squares sum to one.

    **Arguments:**

    - `filters`: the number of filters, at least `overlap`, by default 6.
    - `overlap`: the number of windows that overlap at each eigenvalue, at least 3, by default 3.
    """

    overlap: int = field(static=True, default=3)

    def __check_init__(self) -> None:
        if self.overlap < 3:
            raise ValueError(f"the overlap of HalfCosine must be at least 3, not {self.overlap}")

    def window(self, position: Float[Array, "filters p"]) -> Responses:
        return math.sqrt(8 / (3 * self.overlap)) * namespace(position).cos(math.pi * position) ** 2


class Gabor(FilterBank):
    """A filter bank of Gaussians with evenly spaced centres from 0 to lambda_max. The bank is not tight.

    The filters correspond to the windows of a short-time Fourier transform. In Shuman, Ricaud and
    Vandergheynst, "Vertex-frequency analysis on graphs", 2016, every eigenvalue is the centre of a window.
    This bank has only `filters` centres. Each Gaussian is 1 at its centre.

    **Arguments:**

    - `filters`: the number of filters, at least 2, by default 6.
    - `width`: the standard deviation of the Gaussians, in units of the spacing between their centres,
      positive, by default 0.5.
    """

    filters: int = field(static=True, default=6)
    width: Float[Array, ""] = field(converter=as_parameter, default=0.5)

    def __check_init__(self) -> None:
        check_number_of_filters(self, self.filters, 2)
        check_between(self, "width", self.width)

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        xp = namespace(points, eigenvalues, self.width)
        steps = points / eigenvalues[-1] * (self.filters - 1)
        centres = xp.arange(self.filters, dtype=points.dtype)
        offsets = (steps[None, :] - centres[:, None]) / xp.asarray(self.width, points.dtype)
        return xp.exp(-(offsets**2) / 2)
