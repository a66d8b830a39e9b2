"""Warps of the eigenvalue axis, and filter banks on a warped spectrum."""

from __future__ import annotations

import abc

from jaxtyping import Float

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.banks.base import Eigenvalues, FilterBank, Points, Responses
from jaxsmw.core.checks import as_parameter, check_between
from jaxsmw.core.module import Module, field


class Warp(Module):
    """The base class of warps: monotone maps of the eigenvalue axis, for use in `Warped(bank, warp)`.

    Ready subclasses are `Logarithm`, `Power` and `SpectralDistribution`. A subclass must define
    `__call__(points, eigenvalues)`. The warped points must be non-negative and increase with the points, but
    these conditions are not checked. A constant factor in a warp has no effect on the banks of
    `jaxsmw.banks`, because these banks depend only on ratios of eigenvalues.
    """

    @abc.abstractmethod
    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Float[Array, " p"]:
        """Return the warped points (p,), in any unit; `FilterBank` describes the arguments."""


class Warped(FilterBank):
    """A filter bank evaluated on a warped spectrum: the filters are `g_l(warp(lambda))`.

    If `bank` is a Parseval frame, `Warped(bank, warp)` is also a Parseval frame. The construction is that of
    Shuman, Wiesmeyr, Holighaus and Vandergheynst, "Spectrum-adapted tight graph wavelet and vertex-frequency
    frames", 2015.

    **Arguments:**

    - `bank`: any `FilterBank` with filters g_l.
    - `warp`: a `Warp`. `Logarithm` widens the bands of `Itersine` and `HalfCosine` at higher eigenvalues, as
      in a bank of wavelets. `SpectralDistribution` gives these bands equal numbers of eigenvalues.
    """

    bank: FilterBank
    warp: Warp

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        return self.bank(self.warp(points, eigenvalues), self.warp(eigenvalues, eigenvalues))


class Logarithm(Warp):
    """The warp `log(1 + strength lambda / lambda_max)` of the eigenvalues lambda, for `Warped`.

    The warp is nearly linear for eigenvalues below `lambda_max / strength` and nearly logarithmic for larger
    eigenvalues. The `strength` is a positive number, by default 10; others raise `ValueError`.
    """

    strength: Float[Array, ""] = field(converter=as_parameter, default=10.0)

    def __check_init__(self) -> None:
        check_between(self, "strength", self.strength)

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Float[Array, " p"]:
        xp = namespace(points, eigenvalues, self.strength)
        return xp.log1p(xp.asarray(self.strength, points.dtype) * (points / eigenvalues[-1]))


class Power(Warp):
    """The warp `(lambda / lambda_max)^exponent` of the eigenvalues lambda, for `Warped`.

    The `exponent` is a positive number; others raise `ValueError`. With the default of 0.5, the square root
    turns eigenvalues into frequencies.
    """

    exponent: Float[Array, ""] = field(converter=as_parameter, default=0.5)

    def __check_init__(self) -> None:
        check_between(self, "exponent", self.exponent)

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Float[Array, " p"]:
        xp = namespace(points, eigenvalues, self.exponent)
        relative = points / eigenvalues[-1]
        # For exponents below 1 the slope at the eigenvalue 0 is infinite, so gradients use the slope 0 there.
        positive = xp.where(relative > 0, relative, 1)
        return xp.where(relative > 0, positive ** xp.asarray(self.exponent, points.dtype), 0)


class SpectralDistribution(Warp):
    """The warp that maps each eigenvalue to its index in the spectrum, for `Warped`.

    Between eigenvalues, the warp is linear. With this warp, the windows of `Itersine` and `HalfCosine` pass
    equal numbers of eigenvalues, except at both ends of the spectrum. The warp is that of Shuman, Wiesmeyr,
    Holighaus and Vandergheynst, "Spectrum-adapted tight graph wavelet and vertex-frequency frames", 2015. The
    eigenvalues of a surface grow nearly linearly with their index (Weyl's law), so this warp has little
    effect on surfaces.

    A repeated eigenvalue is mapped to the mean of its indices, so a bank treats all functions of an
    eigenspace equally.
    """

    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Float[Array, " p"]:
        xp = namespace(points, eigenvalues)
        # Eigensolvers return repeated eigenvalues as nearly equal numbers, so eigenvalues are compared with a
        # tolerance.
        tolerance = 1e-6 * eigenvalues[-1]
        below = xp.searchsorted(eigenvalues, eigenvalues - tolerance, side="left")
        not_above = xp.searchsorted(eigenvalues, eigenvalues + tolerance, side="right")
        index = (below + not_above - 1).astype(points.dtype) / 2
        return xp.interp(points, eigenvalues, index).astype(points.dtype)
