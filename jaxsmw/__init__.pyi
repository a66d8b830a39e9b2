from . import banks, benchmark, collection, evaluation, functional_maps, geometry, io, learning, transfer
from .collection.matching import match_collection
from .collection.pairs import match_pairs
from .core.banks import CubicSpline, FilterBank, Meyer
from .core.functional_map import encode
from .core.pointwise_map import decode
from .core.refinement import History, Refinement, refine
from .core.refiner import Refiner
from .core.refiners.feature_regression import FeatureRegression
from .core.refiners.registration import Registration
from .core.refiners.wavelet_preservation import WaveletPreservation
from .core.results import RESULTS
from .core.solutions.closed_form import Filtering, LeastSquares
from .core.spectrum import Spectrum
from .creature import creature_pair
from .errors import InputError
from .evaluation.ground_truth import read_ground_truth
from .evaluation.metrics import geodesic_error
from .geometry.eigenbasis import compute_spectrum
from .geometry.mesh import Mesh, make_mesh
from .io.maps import read_pointwise_map, write_pointwise_map
from .io.meshes import read_mesh, write_mesh
from .matching.correspondence import Correspondence
from .matching.match import match
from .matching.pair import Pair
from .matching.preparation import paired_spectra
from .matching.settings import SearchSettings
from .matching.stages import PRESETS, Preset, Stage
from .matching.starts import initial_map
from .runtime.batches import refine_pairs, stack
from .runtime.compilation import compiler_options

__version__: str
__all__ = [
    "PRESETS",
    "RESULTS",
    "Correspondence",
    "CubicSpline",
    "FeatureRegression",
    "FilterBank",
    "Filtering",
    "History",
    "InputError",
    "LeastSquares",
    "Mesh",
    "Meyer",
    "Pair",
    "Preset",
    "Refinement",
    "Refiner",
    "Registration",
    "SearchSettings",
    "Spectrum",
    "Stage",
    "WaveletPreservation",
    "banks",
    "benchmark",
    "collection",
    "compiler_options",
    "compute_spectrum",
    "creature_pair",
    "decode",
    "encode",
    "evaluation",
    "functional_maps",
    "geodesic_error",
    "geometry",
    "initial_map",
    "io",
    "learning",
    "make_mesh",
    "match",
    "match_collection",
    "match_pairs",
    "paired_spectra",
    "read_ground_truth",
    "read_mesh",
    "read_pointwise_map",
    "refine",
    "refine_pairs",
    "stack",
    "transfer",
    "write_mesh",
    "write_pointwise_map",
]
