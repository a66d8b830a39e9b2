"""Checks the memory that the process may use, and releases memory that it no longer uses."""

from __future__ import annotations

import ctypes
import sys

from jaxsmw.errors import InputError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

# The smallest limit of address space, in bytes, with which `jaxsmw match` ran on two cores.
_LEAST_ADDRESS_SPACE = 2 * 10**9


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


def release_freed_memory() -> None:
    """Return freed memory to the system.

    The allocator of glibc keeps freed blocks between blocks in use. Over many pairs of different sizes, this
    memory would grow to several times the memory of one pair. Other allocators are left alone.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
