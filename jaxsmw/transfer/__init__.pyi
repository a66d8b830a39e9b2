from .registered_mesh import RegisteredMesh, register_mesh

__all__ = ["RegisteredMesh", "register_mesh"]
