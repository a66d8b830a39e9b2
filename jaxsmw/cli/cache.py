"""`jaxsmw cache`: show and clear the stored spectra, descriptors and programs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from jaxsmw.cli.console import show

if TYPE_CHECKING:
    from jaxsmw.runtime.cache import Content

HELP = "show or clear the cache of spectra, descriptors and programs"

_MIB = 2**20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "--clear",
        action="store_true",
        help="remove everything in the cache; later commands compute it again",
    )


def run(options: argparse.Namespace) -> None:
    """Print where the cache lies and what it contains, and clear it if requested.

    **Raises:** `InputError` if the cache cannot be read or cleared.
    """
    from jaxsmw.runtime.cache import cache_contents, cache_directory, cache_limit, clear_cache

    place = cache_directory()
    if place is None:
        show("The cache is disabled, because JAXSMW_CACHE is empty or off, or you have no home directory.")
        return
    contents = cache_contents()
    if options.clear:
        clear_cache()
        show(f"{place} is cleared: {_files(contents)}, {_size(contents)} MiB.")
        return
    limit = f"{cache_limit() / 2**30:g} GiB without compiled programs"
    lines = {
        "directory": f"{place} (set JAXSMW_CACHE to change it)",
        "limit": f"{limit} (set JAXSMW_CACHE_LIMIT to change it)",
        **{one.kind: f"{_files([one])}, {_size([one])} MiB" for one in contents},
        "total": f"{_files(contents)}, {_size(contents)} MiB",
    }
    for name, text in lines.items():
        show(f"{name + ':':<20} {text}")


def _files(contents: list[Content]) -> str:
    number = sum(one.files for one in contents)
    return "1 file" if number == 1 else f"{number} files"


def _size(contents: list[Content]) -> str:
    return f"{sum(one.size for one in contents) / _MIB:.1f}"
