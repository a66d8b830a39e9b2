from .blend_shapes import read_blend_shapes, write_blend_shapes
from .exchange import ImportedMap, make_functional_map, to_geomfum, to_pyfm, to_torch
from .landmark_files import read_landmark_file, write_landmark_file
from .landmarks import FrameDistances, LandmarkMatch, Landmarks, check_frame, find_frame, match_landmarks
from .maps import read_landmarks, read_pointwise_map, write_pointwise_map
from .mesh_data import LabelTable, MeshData, Overlay, Skeleton, Skin, Texture
from .meshes import read_mesh, read_mesh_data, write_mesh, write_mesh_data
from .overlays import read_overlay, write_overlay
from .spectra import make_spectrum, read_functional_map, read_spectrum, write_functional_map, write_spectrum
from .volumes import Volume, read_volume, write_volume

__all__ = [
    "FrameDistances",
    "ImportedMap",
    "LabelTable",
    "LandmarkMatch",
    "Landmarks",
    "MeshData",
    "Overlay",
    "Skeleton",
    "Skin",
    "Texture",
    "Volume",
    "check_frame",
    "find_frame",
    "make_functional_map",
    "make_spectrum",
    "match_landmarks",
    "read_blend_shapes",
    "read_functional_map",
    "read_landmark_file",
    "read_landmarks",
    "read_mesh",
    "read_mesh_data",
    "read_overlay",
    "read_pointwise_map",
    "read_spectrum",
    "read_volume",
    "to_geomfum",
    "to_pyfm",
    "to_torch",
    "write_blend_shapes",
    "write_functional_map",
    "write_landmark_file",
    "write_mesh",
    "write_mesh_data",
    "write_overlay",
    "write_pointwise_map",
    "write_spectrum",
    "write_volume",
]
