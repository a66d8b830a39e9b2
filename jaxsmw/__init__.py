"""Deformable shape correspondence in JAX by multiscale spectral manifold wavelets preservation.

The public names stand in `__init__.pyi`; they are loaded when first used, so that `jaxsmw --help` need not
wait for JAX.
"""

from importlib import metadata

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = metadata.version("jaxsmw")
