"""Checks of settings, made when a module is built."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """**Raises:** `ValueError` if the value of an option is none of the choices."""
    if value not in choices:
        raise ValueError(f"{name}={value!r} is none of {', '.join(choices)}")


def check_between(
    owner: eqx.Module, name: str, value: Array, *, low: float = 0.0, high: float = math.inf
) -> None:
    """Check a parameter, unless it is traced and has no value yet.

    **Raises:** `ValueError` if it is not finite and strictly between the limits.
    """
    if isinstance(value, jax.core.Tracer):
        return
    # On the host, because under jit even a comparison of constants is traced.
    host = np.asarray(value)
    if not ((low < host) & (host < high)).all():
        limits = f"between {low:g} and {high:g}" if math.isfinite(high) else f"finite and above {low:g}"
        raise ValueError(f"the {name} of {type(owner).__name__} must be {limits}, not {host}")
