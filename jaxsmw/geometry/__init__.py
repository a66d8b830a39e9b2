"""Meshes on the host: Laplacians, eigenbases, geodesic distances, samples and descriptors."""

import lazy_loader

# The names are in `__init__.pyi`; each module is loaded when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
