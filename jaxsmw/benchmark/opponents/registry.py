"""The names of the compared methods on the command line and in results."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.benchmark.opponents.base import Method
from jaxsmw.benchmark.opponents.baselines import (
    ACCURATE,
    MWP,
    MWP_SAMPLED,
    NO_FILTER,
    SPECTRAL_ICP,
    UNREFINED,
    ZOOMOUT,
    ZOOMOUT_SAMPLED,
    PublishedMaps,
)
from jaxsmw.benchmark.opponents.cpd import CPD
from jaxsmw.benchmark.opponents.partial_functional_maps import PARTIAL_FUNCTIONAL_MAPS
from jaxsmw.benchmark.opponents.peers import installed_peers
from jaxsmw.benchmark.opponents.smooth_shells import SMOOTH_SHELLS
from jaxsmw.errors import InputError

METHODS: dict[str, Method] = {
    "initial": UNREFINED,
    "mwp": MWP,
    "accurate": ACCURATE,
    "mwp-sampled": MWP_SAMPLED,
    "no-filter": NO_FILTER,
    "icp": SPECTRAL_ICP,
    "cpd": CPD,
    "smooth-shells": SMOOTH_SHELLS,
    "pfm": PARTIAL_FUNCTIONAL_MAPS,
    "zoomout": ZOOMOUT,
    "zoomout-sampled": ZOOMOUT_SAMPLED,
}
"""A dictionary from names to the methods that need no other library, in the order of the rows of tables."""

MOST_EIGENVECTORS = max(method.number_of_eigenvectors for method in METHODS.values())
"""The largest number of eigenvectors that any of `METHODS` uses."""


def known_methods() -> dict[str, Method]:
    """Return `METHODS` and the methods of other installed libraries, as a dictionary from name to method."""
    return METHODS | installed_peers()


def suited_methods(pairs: Sequence[DataPair]) -> dict[str, Method]:
    """Return the known methods that can match all pairs, as a dictionary from name to method."""
    return {name: method for name, method in known_methods().items() if method.suits(pairs)}


def find_methods(names: Iterable[str]) -> dict[str, Method]:
    """Return methods by name.

    **Arguments:**

    - `names`: names of known methods, or paths of directories with maps of other programs (files named
      `X_Y.map`). Duplicate names are ignored.

    **Returns:** A dictionary from the name of each method to the method. For a directory with maps, the name
    of the method is the name of the directory.

    **Raises:** `InputError` if a name is neither a known method nor a directory, or if two methods would have
    the same name.
    """
    known, found = known_methods(), {}
    for name in dict.fromkeys(names):
        if name in known:
            found[name] = known[name]
            continue
        # Unlike `Path.is_dir`, `os.path.isdir` raises no error if a name is too long for the file system.
        if not os.path.isdir(name):
            raise InputError(
                f"{name!r} is not a method: choose from {', '.join(known)}, or give a directory with maps "
                "X_Y.map."
            )
        directory = Path(name).resolve()
        if directory.name in {**known, **found}:
            raise InputError(
                f"{directory}: another method already has the name {directory.name}: rename the directory."
            )
        found[directory.name] = PublishedMaps(directory)
    return found
