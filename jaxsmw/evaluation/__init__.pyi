from .ground_truth import GroundTruth, read_ground_truth
from .metrics import GeodesicError, coverage, geodesic_error

__all__ = ["GeodesicError", "GroundTruth", "coverage", "geodesic_error", "read_ground_truth"]
