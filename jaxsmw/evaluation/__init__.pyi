from .ground_truth import GroundTruth, read_ground_truth, read_true_overlap
from .metrics import GeodesicError, OverlapScores, coverage, geodesic_error, overlap_scores

__all__ = [
    "GeodesicError",
    "GroundTruth",
    "OverlapScores",
    "coverage",
    "geodesic_error",
    "overlap_scores",
    "read_ground_truth",
    "read_true_overlap",
]
