"""The names of the compared methods on the command line and in results.

A method is imported when it is looked up, so the help text of the command line shows all names without JAX.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from jaxsmw.benchmark.datasets import AnyPair
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    from jaxsmw.benchmark.opponents.base import Method


class Methods(Mapping[str, "Method"]):
    """A mapping from names to methods, made from a dictionary of the places where the methods are defined."""

    def __init__(self, places: Mapping[str, str]) -> None:
        self._places = places

    def __getitem__(self, name: str) -> Method:
        return resolve_name(f"{__package__}.{self._places[name]}")

    def __contains__(self, name: object) -> bool:
        return name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


METHODS = Methods(
    {
        "initial": "baselines:UNREFINED",
        "mwp": "baselines:MWP",
        "accurate": "baselines:ACCURATE",
        "mwp-sampled": "baselines:MWP_SAMPLED",
        "no-filter": "baselines:NO_FILTER",
        "icp": "baselines:SPECTRAL_ICP",
        "cpd": "cpd:CPD",
        "smooth-shells": "smooth_shells:SMOOTH_SHELLS",
        "pfm": "partial_functional_maps:PARTIAL_FUNCTIONAL_MAPS",
        "zoomout": "baselines:ZOOMOUT",
        "zoomout-sampled": "baselines:ZOOMOUT_SAMPLED",
    }
)
"""The methods that need no other library, in the order of the rows of tables."""

# The beginning of the name of a method that matches two partial shapes through a template.
_THROUGH = "accurate:"

PEERS = Methods({"pyfm-zoomout": "peers:PYFM", "geomfum-zoomout": "peers:GEOMFUM"})
"""The methods of other libraries, which a benchmark can measure if the libraries are installed."""


def known_methods() -> dict[str, Method]:
    """Return `METHODS` and the methods of other installed libraries."""
    return {**METHODS, **{name: peer for name, peer in PEERS.items() if peer.is_available}}


def suited_methods(pairs: Sequence[AnyPair]) -> dict[str, Method]:
    """Return the known methods that can match all pairs."""
    return {name: method for name, method in known_methods().items() if method.suits(pairs)}


def find_methods(names: Iterable[str], others: Sequence[str] = ()) -> dict[str, Method]:
    """Return methods by name.

    A name can also be the path of a directory with maps `X_Y.map` of another program. The name of the method
    is then the name of the directory. `accurate:TEMPLATE` is `accurate` through a template, which is a mesh
    file or a built-in shape; see `jaxsmw.match`. Duplicate names are ignored.
    The message about an unknown name also lists `others`, which are names that the caller accepts.

    **Raises:** `InputError` if a name is neither a known method nor a directory, if two directories or two
    templates have the same name, or if a template cannot be read.
    """
    from jaxsmw.benchmark.opponents.baselines import PublishedMaps, through_template

    available, methods = known_methods(), {}
    for name in dict.fromkeys(names):
        if name in available:
            methods[name] = available[name]
            continue
        if name.startswith(_THROUGH):
            template = name.removeprefix(_THROUGH)
            short = Path(template).name
            if _THROUGH + short in methods:
                raise InputError(f"{template}: another template already has the name {short}: rename it.")
            methods[_THROUGH + short] = through_template(template)
            continue
        # Unlike `Path.is_dir`, `os.path.isdir` raises no error if a name is too long for the file system.
        if not os.path.isdir(name):
            listed = list(dict.fromkeys([*available, *others]))
            near = difflib.get_close_matches(name, listed, n=1)
            meant = f" (did you mean {near[0]!r}?)" if near else ""
            raise InputError(
                f"{name!r} is not a method{meant}: choose from {', '.join(listed)}, or give a directory with "
                "maps X_Y.map."
            )
        directory = Path(name).resolve()
        if directory.name in {**available, **methods}:
            raise InputError(
                f"{directory}: another method already has the name {directory.name}: rename the directory."
            )
        methods[directory.name] = PublishedMaps(directory)
    return methods
