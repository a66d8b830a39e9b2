"""Returns free memory of the process to the operating system."""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable
from functools import cache

# The smallest time between two searches for free memory, in seconds. A search takes 20 to 90 ms.
_INTERVAL = 10.0


def return_free_memory() -> None:
    """Return memory that the process has freed to the operating system, at most once in ten seconds.

    The compiler allocates several hundred MiB in its threads. The allocator of glibc keeps freed memory for
    the thread that allocated it, so other threads cannot use it. On systems without glibc the function does
    nothing.
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
