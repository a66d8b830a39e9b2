"""Ground truth, and metrics of maps such as geodesic errors."""

import lazy_loader

# `__init__.pyi` lists the public names. A module is loaded when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
