from .assignment import one_to_one_map
from .bases import add_bases
from .creases import crease_eigenvectors
from .eigenbasis import compute_spectrum
from .geodesics import geodesic_distances, geodesic_matrix
from .mesh import Mesh, diagnose, make_mesh
from .point_cloud import triangulate_points
from .sampling import farthest_point_samples
from .scale import ScaleEstimate, estimate_scale
from .shortcuts import cut_shortcuts
from .shot import shot_descriptors
from .surface_distance import distances_to_surface, nearest_surface_points
from .surface_points import SurfacePoints

__all__ = [
    "Mesh",
    "ScaleEstimate",
    "SurfacePoints",
    "add_bases",
    "compute_spectrum",
    "crease_eigenvectors",
    "cut_shortcuts",
    "diagnose",
    "distances_to_surface",
    "estimate_scale",
    "farthest_point_samples",
    "geodesic_distances",
    "geodesic_matrix",
    "make_mesh",
    "nearest_surface_points",
    "one_to_one_map",
    "shot_descriptors",
    "triangulate_points",
]
