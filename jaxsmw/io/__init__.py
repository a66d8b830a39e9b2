"""Files: meshes, maps, landmarks, and spectra, also of other libraries."""

import lazy_loader

# The names are in `__init__.pyi`; each module is loaded when a name of it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
