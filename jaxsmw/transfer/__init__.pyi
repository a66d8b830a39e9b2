from .attributes import registered_data, transfer_attributes
from .landmarks import TransferredLandmarks, transfer_landmarks
from .registered_mesh import RegisteredMesh, register_mesh
from .small_components import match_small_components
from .volumes import TransferredVolume, transfer_volume

__all__ = [
    "RegisteredMesh",
    "TransferredLandmarks",
    "TransferredVolume",
    "match_small_components",
    "register_mesh",
    "registered_data",
    "transfer_attributes",
    "transfer_landmarks",
    "transfer_volume",
]
