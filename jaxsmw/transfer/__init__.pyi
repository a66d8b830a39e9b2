from .attributes import registered_data, transfer_attributes
from .landmarks import TransferredLandmarks, transfer_landmarks
from .registered_mesh import RegisteredMesh, register_mesh

__all__ = [
    "RegisteredMesh",
    "TransferredLandmarks",
    "register_mesh",
    "registered_data",
    "transfer_attributes",
    "transfer_landmarks",
]
