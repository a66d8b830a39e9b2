from .datasets import DataPair, DataSet, open_data_set
from .ground_truth import GroundTruth, read_ground_truth
from .metrics import GeodesicError, coverage, geodesic_error

__all__ = [
    "DataPair",
    "DataSet",
    "GeodesicError",
    "GroundTruth",
    "coverage",
    "geodesic_error",
    "open_data_set",
    "read_ground_truth",
]
