"""Checks the memory that the process may use, and returns free memory to the operating system."""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable
from functools import cache

from jaxsmw.errors import InputError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

# The smallest limit of address space, in bytes, with which `jaxsmw match` ran on two cores.
_LEAST_ADDRESS_SPACE = 2 * 10**9
# The smallest time between two searches for free memory, in seconds. A search takes 20 to 90 ms.
_INTERVAL = 10.0


def check_address_space() -> None:
    """Raise `InputError` if JAX and SciPy would abort or hang while they are loaded (`ulimit -v`)."""
    if resource is None:
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _LEAST_ADDRESS_SPACE:
        raise InputError(
            f"the address space of this process is limited to {limit / 1e9:.2f} GB, but its libraries need "
            "at least 2 GB: raise the limit (ulimit -v)."
        )


def return_free_memory() -> None:
    """Return memory that the process has freed to the operating system, at most once in ten seconds.

    The compiler allocates several hundred MiB in its threads. The allocator of glibc keeps freed memory for
    the thread that allocated it, so other threads cannot use it.
    """
    global _previous
    if time.monotonic() - _previous < _INTERVAL:
        return
    if (trim := _trim()) is not None:
        trim(0)
    _previous = time.monotonic()


# Commands that end sooner do not search.
_previous = time.monotonic()


@cache
def _trim() -> Callable[[int], int] | None:
    """Return `malloc_trim` of glibc, or None on other systems."""
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
