from .attributes import registered_data, transfer_attributes
from .landmarks import TransferredLandmarks, transfer_landmarks
from .registered_mesh import RegisteredMesh, register_mesh
from .small_components import match_small_components

__all__ = [
    "RegisteredMesh",
    "TransferredLandmarks",
    "match_small_components",
    "register_mesh",
    "registered_data",
    "transfer_attributes",
    "transfer_landmarks",
]
