from .core.banks import (
    CubicSpline,
    ExponentialWindow,
    FilterBank,
    FrameBounds,
    Gabor,
    HalfCosine,
    Heat,
    Held,
    Identity,
    Itersine,
    Logarithm,
    LowPass,
    MexicanHat,
    Meyer,
    Papadakis,
    Power,
    Regular,
    Simoncelli,
    SimpleTight,
    SoftmaxFrame,
    SpectralDistribution,
    Warp,
    Warped,
    frame_bounds,
    frame_function,
    tighten,
)
from .core.functional_map import QuadraticEnergy, encode, multiscale_kernel
from .core.pointwise_map import decode, decode_to_triangles, search_patches
from .core.refinement import History, Refinement, refine
from .core.refiner import Problem, Refiner, State
from .core.refiners.feature_regression import FeatureRegression
from .core.refiners.registration import Registration
from .core.refiners.wavelet_preservation import WaveletPreservation
from .core.results import RESULTS
from .core.search import nearest_neighbor
from .core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from .core.soft_maps import (
    NearestFew,
    Recovery,
    Sinkhorn,
    SoftMap,
    Softmax,
    SparseSoftMap,
    pull_back,
    sinkhorn,
)
from .core.soft_refinement import SoftRefinement, WaveletPreservationLayer, refine_softly
from .core.solutions import (
    DescriptorPair,
    Filtering,
    LeastSquares,
    NearestOrthogonal,
    RegularizedLeastSquares,
    Solution,
    WaveletProblem,
)
from .core.spectrum import Spectrum
from .core.triangles import nearest_point_on_triangles
from .descriptors import describe
from .errors import InputError
from .evaluation.datasets import DataPair, DataSet, open_data_set
from .evaluation.ground_truth import GroundTruth, read_ground_truth
from .evaluation.metrics import GeodesicError, coverage, geodesic_error
from .geometry.assignment import one_to_one_map
from .geometry.creature import CreaturePair, creature_pair
from .geometry.eigenbasis import compute_spectrum
from .geometry.geodesics import SurfacePoints, geodesic_distances
from .geometry.mesh import Mesh, diagnose, make_mesh
from .geometry.sampling import farthest_point_samples
from .geometry.shot import shot_descriptors
from .initial_maps import initial_map
from .io.map_files import read_pointwise_map, write_pointwise_map
from .io.mesh_files import read_mesh, write_mesh
from .io.spectra import (
    make_spectrum,
    read_functional_map,
    read_spectrum,
    write_functional_map,
    write_spectrum,
)
from .matching import Correspondence, match
from .pair import Pair, paired_spectra
from .preparation import PreparedPair, prepare
from .presets import PRESETS, Preset
from .repair.settings import RepairSettings
from .runtime.batches import refine_pairs, stack
from .runtime.compilation import compiler_options
from .stage import Stage

__version__: str
__all__ = [
    "PRESETS",
    "RESULTS",
    "Correspondence",
    "CreaturePair",
    "CubicSpline",
    "DataPair",
    "DataSet",
    "DescriptorPair",
    "ExponentialWindow",
    "FeatureRegression",
    "FilterBank",
    "Filtering",
    "FrameBounds",
    "Gabor",
    "GeodesicError",
    "GroundTruth",
    "HalfCosine",
    "Heat",
    "Held",
    "History",
    "Identity",
    "InputError",
    "Itersine",
    "LeastSquares",
    "Logarithm",
    "LowPass",
    "Mesh",
    "MexicanHat",
    "Meyer",
    "NearestFew",
    "NearestOrthogonal",
    "Pair",
    "Papadakis",
    "Power",
    "PreparedPair",
    "Preset",
    "Problem",
    "QuadraticEnergy",
    "Recovery",
    "Refinement",
    "Refiner",
    "Registration",
    "Regular",
    "RegularizedLeastSquares",
    "RepairSettings",
    "Simoncelli",
    "SimpleTight",
    "Sinkhorn",
    "SoftMap",
    "SoftRefinement",
    "Softmax",
    "SoftmaxFrame",
    "Solution",
    "SparseSoftMap",
    "SpectralDistribution",
    "Spectrum",
    "Stage",
    "State",
    "SurfacePoints",
    "Warp",
    "Warped",
    "WaveletPreservation",
    "WaveletPreservationLayer",
    "WaveletProblem",
    "compiler_options",
    "compute_spectrum",
    "coverage",
    "creature_pair",
    "decode",
    "decode_to_triangles",
    "describe",
    "diagnose",
    "encode",
    "farthest_point_samples",
    "frame_bounds",
    "frame_function",
    "geodesic_distances",
    "geodesic_error",
    "heat_kernel_signature",
    "initial_map",
    "make_mesh",
    "make_spectrum",
    "match",
    "multiscale_kernel",
    "nearest_neighbor",
    "nearest_point_on_triangles",
    "one_to_one_map",
    "open_data_set",
    "paired_spectra",
    "prepare",
    "pull_back",
    "read_functional_map",
    "read_ground_truth",
    "read_mesh",
    "read_pointwise_map",
    "read_spectrum",
    "refine",
    "refine_pairs",
    "refine_softly",
    "search_patches",
    "shot_descriptors",
    "sinkhorn",
    "stack",
    "tighten",
    "wave_kernel_signature",
    "wavelet_signature",
    "write_functional_map",
    "write_mesh",
    "write_pointwise_map",
    "write_spectrum",
]
