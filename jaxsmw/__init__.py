"""Deformable shape correspondence in JAX by multiscale spectral manifold wavelets preservation.

The public names stand in `__init__.pyi`; they are loaded when first used, so that `jaxsmw --help` need not
wait for JAX.
"""

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        # Imported late: this module takes as long to load as all the rest of `jaxsmw --help`.
        from importlib import metadata

        return metadata.version("jaxsmw")
    return _load(name)
