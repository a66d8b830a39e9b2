from .map_files import read_landmarks, read_pointwise_map, write_pointwise_map
from .mesh_data import MeshData, Skin, Texture, read_mesh_data, write_mesh_data
from .mesh_files import read_mesh, write_mesh
from .spectra import make_spectrum, read_functional_map, read_spectrum, write_functional_map, write_spectrum

__all__ = [
    "MeshData",
    "Skin",
    "Texture",
    "make_spectrum",
    "read_functional_map",
    "read_landmarks",
    "read_mesh",
    "read_mesh_data",
    "read_pointwise_map",
    "read_spectrum",
    "write_functional_map",
    "write_mesh",
    "write_mesh_data",
    "write_pointwise_map",
    "write_spectrum",
]
