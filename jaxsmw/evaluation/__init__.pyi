from .datasets import DataPair, DataSet, open_data_set
from .ground_truth import GroundTruth, read_ground_truth
from .metrics import GeodesicError, coverage, geodesic_error
from .protocols import Protocol, protocol_pairs

__all__ = [
    "DataPair",
    "DataSet",
    "GeodesicError",
    "GroundTruth",
    "Protocol",
    "coverage",
    "geodesic_error",
    "open_data_set",
    "protocol_pairs",
    "read_ground_truth",
]
