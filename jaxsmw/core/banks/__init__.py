"""Filter banks: a scaling function and wavelet filters, which are functions of the eigenvalue.

All banks of this package depend only on ratios of eigenvalues, so scaling a shape does not change the
responses. By convention, the first filter of a bank is the scaling function, which passes the lowest
eigenvalues.

- The following banks are Parseval frames, whose squared filters sum to one: `Meyer`, `SimpleTight`,
  `Itersine`, `HalfCosine`, `Held`, `Simoncelli`, `Papadakis`, `Regular`, `Identity` and `SoftmaxFrame`. The
  filters of `SoftmaxFrame` can be learned.
- The following banks are not tight: `CubicSpline`, `MexicanHat`, `Heat`, `Gabor`, `ExponentialWindow` and
  `LowPass`. The function `tighten` turns any bank into a tight frame.
"""

from jaxsmw.core.banks.base import FilterBank
from jaxsmw.core.banks.dilates import CubicSpline, Heat, MexicanHat
from jaxsmw.core.banks.frames import FrameBounds, SoftmaxFrame, frame_bounds, frame_function, tighten
from jaxsmw.core.banks.transitions import (
    ExponentialWindow,
    Held,
    Identity,
    LowPass,
    Meyer,
    Papadakis,
    Regular,
    Simoncelli,
    SimpleTight,
)
from jaxsmw.core.banks.translates import Gabor, HalfCosine, Itersine
from jaxsmw.core.banks.warps import Logarithm, Power, SpectralDistribution, Warp, Warped

__all__ = [
    "CubicSpline",
    "ExponentialWindow",
    "FilterBank",
    "FrameBounds",
    "Gabor",
    "HalfCosine",
    "Heat",
    "Held",
    "Identity",
    "Itersine",
    "Logarithm",
    "LowPass",
    "MexicanHat",
    "Meyer",
    "Papadakis",
    "Power",
    "Regular",
    "Simoncelli",
    "SimpleTight",
    "SoftmaxFrame",
    "SpectralDistribution",
    "Warp",
    "Warped",
    "frame_bounds",
    "frame_function",
    "tighten",
]
