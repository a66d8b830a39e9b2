from .bilateral import Asymmetry, asymmetry, mirror_points
from .completion import Completion, complete_mesh
from .conditioning import GaussianModel, Posterior
from .consistency import edge_errors
from .files import read_shape_model
from .graph import choose_edges, shape_distances
from .hands import choose_hands
from .matching import match_collection
from .pairs import match_pairs
from .result import Collection, MatchedEdge
from .semilandmarks import (
    Semilandmarks,
    Sliders,
    bending_energy_matrix,
    place_semilandmarks,
    read_sliders,
    slide,
    slide_semilandmarks,
)
from .shape_models import ProcrustesAlignment, ShapeModel, align, shape_model
from .shapes import PreparedShape, prepare_collection
from .synchronization import Network, synchronize

__all__ = [
    "Asymmetry",
    "Collection",
    "Completion",
    "GaussianModel",
    "MatchedEdge",
    "Network",
    "Posterior",
    "PreparedShape",
    "ProcrustesAlignment",
    "Semilandmarks",
    "ShapeModel",
    "Sliders",
    "align",
    "asymmetry",
    "bending_energy_matrix",
    "choose_edges",
    "choose_hands",
    "complete_mesh",
    "edge_errors",
    "match_collection",
    "match_pairs",
    "mirror_points",
    "place_semilandmarks",
    "prepare_collection",
    "read_shape_model",
    "read_sliders",
    "shape_distances",
    "shape_model",
    "slide",
    "slide_semilandmarks",
    "synchronize",
]
