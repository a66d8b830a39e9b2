"""Functional maps: solutions, energies, nearest-neighbour searches, descriptors and spectral signatures.

`docs/mathematics.md` explains the equations behind these functions and classes.
"""

from jaxsmw.core.functional_map import QuadraticEnergy, WaveletProblem, encode, multiscale_kernel
from jaxsmw.core.pointwise_map import decode, decode_to_triangles
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.core.solutions.closed_form import Filtering, LeastSquares, NearestOrthogonal, Solution
from jaxsmw.core.solutions.descriptors import DescriptorPair
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.core.triangles import nearest_point_on_triangles
from jaxsmw.matching.preparation import describe

__all__ = [
    "DescriptorPair",
    "Filtering",
    "LeastSquares",
    "NearestOrthogonal",
    "QuadraticEnergy",
    "RegularizedLeastSquares",
    "Solution",
    "WaveletProblem",
    "decode",
    "decode_to_triangles",
    "describe",
    "encode",
    "heat_kernel_signature",
    "multiscale_kernel",
    "nearest_neighbor",
    "nearest_point_on_triangles",
    "wave_kernel_signature",
    "wavelet_signature",
]
