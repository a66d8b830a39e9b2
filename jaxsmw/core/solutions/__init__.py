"""Solutions compute functional maps from pointwise maps: by filtering, exactly, or with further energy terms.

A `Solution` is one way to minimise the wavelet-preservation energy. `WaveletPreservation` uses a solution.
"""

from jaxsmw.core.functional_map import WaveletProblem
from jaxsmw.core.solutions.base import Solution
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares, NearestOrthogonal, PreparedFiltering
from jaxsmw.core.solutions.descriptors import DescriptorPair, ProjectedDescriptors
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares

__all__ = [
    "DescriptorPair",
    "Filtering",
    "LeastSquares",
    "NearestOrthogonal",
    "PreparedFiltering",
    "ProjectedDescriptors",
    "RegularizedLeastSquares",
    "Solution",
    "WaveletProblem",
]
