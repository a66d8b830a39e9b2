"""Solutions: methods that compute a functional map from a pointwise map.

The refiner `WaveletPreservation` uses a `Solution` in every iteration. The solutions minimise the
wavelet-preservation energy exactly or approximately. `RegularizedLeastSquares` minimises a sum of this energy
and other terms.
"""

from jaxsmw.core.functional_map import WaveletProblem
from jaxsmw.core.solutions.closed_form import (
    Filtering,
    LeastSquares,
    NearestOrthogonal,
    PreparedFiltering,
    Solution,
)
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
