"""Differentiable soft maps and differentiable refinement.

The page `docs/gradients.md` explains their use.
"""

from jaxsmw.core.functional_map import pull_back
from jaxsmw.core.soft_maps import (
    NearestFew,
    Recovery,
    Sinkhorn,
    SoftMap,
    Softmax,
    SparseSoftMap,
    sinkhorn,
)
from jaxsmw.core.soft_refinement import SoftRefinement, WaveletPreservationLayer, refine_softly

__all__ = [
    "NearestFew",
    "Recovery",
    "Sinkhorn",
    "SoftMap",
    "SoftRefinement",
    "Softmax",
    "SparseSoftMap",
    "WaveletPreservationLayer",
    "pull_back",
    "refine_softly",
    "sinkhorn",
]
