"""Data sets, published protocols, and the benchmark of this library's methods beside other methods.

Only the command `jaxsmw benchmark` imports this package. The rest of the library does not need it. Importing
`jaxsmw.benchmark.datasets`, and reading data sets with it, does not import JAX.
"""

import lazy_loader

# `__init__.pyi` lists the public names. A module is loaded when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
