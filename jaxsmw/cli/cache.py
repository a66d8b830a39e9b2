"""`jaxsmw cache`: show and clear the stored spectra, descriptors and programs."""

from __future__ import annotations

import argparse

from jaxsmw.cli.console import show
from jaxsmw.wording import count_of

HELP = "show or clear the cache of spectra, descriptors and programs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "--clear", action="store_true", help="remove everything in the cache; later commands compute it again"
    )


def run(options: argparse.Namespace) -> None:
    """Print where the cache lies and what it contains, and clear it if requested."""
    from jaxsmw.runtime.cache import cache_contents, cache_directory, cache_limit, clear_cache

    place = cache_directory()
    if place is None:
        show("The cache is disabled, because JAXSMW_CACHE is empty or off, or you have no home directory.")
        return
    contents = cache_contents()
    total = _files([size for sizes in contents.values() for size in sizes])
    if options.clear:
        clear_cache()
        show(f"{place} is cleared: {total}.")
        return
    limit = f"{cache_limit() / 2**30:g} GiB without compiled programs"
    lines = {
        "directory": f"{place} (set JAXSMW_CACHE to change it)",
        "limit": f"{limit} (set JAXSMW_CACHE_LIMIT to change it)",
        **{kind: _files(sizes) for kind, sizes in contents.items()},
        "total": total,
    }
    for name, text in lines.items():
        show(f"{name + ':':<20} {text}")


def _files(sizes: list[int]) -> str:
    return f"{count_of(len(sizes), 'file')}, {sum(sizes) / 2**20:.1f} MiB"
