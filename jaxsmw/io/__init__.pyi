from .map_files import read_landmarks, read_pointwise_map, write_pointwise_map
from .mesh_files import read_mesh, write_mesh
from .spectra import make_spectrum, read_functional_map, read_spectrum, write_functional_map, write_spectrum

__all__ = [
    "make_spectrum",
    "read_functional_map",
    "read_landmarks",
    "read_mesh",
    "read_pointwise_map",
    "read_spectrum",
    "write_functional_map",
    "write_mesh",
    "write_pointwise_map",
    "write_spectrum",
]
