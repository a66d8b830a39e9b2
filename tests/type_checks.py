"""The run-time type checker of the tests."""

import inspect
from collections.abc import Callable
from typing import Any

from beartype import beartype

_checks: dict[tuple[str, str, str], Callable[..., Any]] = {}


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return what `beartype` returns for a function, and make it once for each name and signature.

    jaxtyping passes functions of which only the signature matters: they do nothing, or return an argument. For a
    function inside another function, jaxtyping passes them again whenever the outer function runs. Without this
    cache, `beartype` would compile the same checks each time.
    """
    key = (function.__module__, function.__qualname__, str(inspect.signature(function)))
    if key not in _checks:
        _checks[key] = beartype(function)
    return _checks[key]
