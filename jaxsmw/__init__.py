"""Deformable shape correspondence in JAX by multiscale spectral manifold wavelets preservation.

`__init__.pyi` lists the public names. A name is loaded at its first use, so `jaxsmw --help` does not import
JAX. Importing `jaxsmw` loads almost no other module, so the command line handles Ctrl-C soon after it starts.
"""

from functools import cache


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib import metadata

        return metadata.version("jaxsmw")
    load, _, names = _public()
    return names if name == "__all__" else load(name)


def __dir__() -> list[str]:
    _, list_names, _ = _public()
    return list_names()


@cache
def _public() -> tuple:
    """Return the module's `__getattr__`, `__dir__` and `__all__` for the public names."""
    import lazy_loader

    return lazy_loader.attach_stub(__name__, __file__)
