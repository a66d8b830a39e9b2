"""Checks the memory that the process may use."""

from __future__ import annotations

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
