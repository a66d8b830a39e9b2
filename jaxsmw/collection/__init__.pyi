from .bilateral import Asymmetry, asymmetry, mirror_points
from .consistency import edge_errors
from .graph import choose_edges, shape_distances
from .hands import choose_hands
from .matching import match_collection
from .pairs import match_pairs
from .result import Collection, MatchedEdge
from .shape_models import ProcrustesAlignment, ShapeModel, align, shape_model
from .shapes import PreparedShape, prepare_collection
from .synchronization import Network, synchronize

__all__ = [
    "Asymmetry",
    "Collection",
    "MatchedEdge",
    "Network",
    "PreparedShape",
    "ProcrustesAlignment",
    "ShapeModel",
    "align",
    "asymmetry",
    "choose_edges",
    "choose_hands",
    "edge_errors",
    "match_collection",
    "match_pairs",
    "mirror_points",
    "prepare_collection",
    "shape_distances",
    "shape_model",
    "synchronize",
]
