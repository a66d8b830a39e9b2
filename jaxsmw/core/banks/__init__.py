"""Filter banks: a scaling function and wavelets, sampled over the spectrum of a shape.

All banks depend only on ratios of eigenvalues, so the scale of a shape cancels. The first filter passes the
lowest eigenvalues.

- Parseval frames (the squares sum to one): `Meyer`, `SimpleTight`, `Itersine`, `HalfCosine`, `Held`,
  `Simoncelli`, `Papadakis`, `Regular`, `SoftmaxFrame` (with parameters to be learned) and `Identity`. Each of
  these frames remains Parseval in `Warped`.
- Not tight: `CubicSpline`, `MexicanHat`, `Heat`, `Gabor`, `ExponentialWindow` and `LowPass`. `tighten` turns
  any bank into a tight frame.
"""

from jaxsmw.core.banks.base import FilterBank
from jaxsmw.core.banks.dilates import CubicSpline, Heat, MexicanHat
from jaxsmw.core.banks.frames import FrameBounds, frame_bounds, frame_function, tighten
from jaxsmw.core.banks.learned import SoftmaxFrame
from jaxsmw.core.banks.single import ExponentialWindow, Identity, LowPass
from jaxsmw.core.banks.transitions import Held, Meyer, Papadakis, Regular, Simoncelli, SimpleTight
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
