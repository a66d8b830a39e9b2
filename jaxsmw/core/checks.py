"""Settings of modules: how they become arrays, and checks made when a module is built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool


def as_parameter(value: ArrayLike | Sequence[float | int]) -> Array:
    """A continuous setting as an array of the default float type, so that it is traced."""
    return jnp.asarray(value, dtype=float)


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether there is neither NaN nor infinity in any array of a pytree."""
    inexact = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in inexact]))


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """**Raises:** `ValueError` if the value of an option is none of the choices."""
    if value not in choices:
        raise ValueError(f"{name}={value!r} is none of {', '.join(choices)}")


def check_between(
    owner: eqx.Module, name: str, value: Array, *, low: float = 0.0, high: float = math.inf, ndim: int = 0
) -> None:
    """Check a parameter; not its value while it is traced and has none yet.

    **Raises:** `ValueError` if it has another number of dimensions, or is not finite and strictly between
    the limits.
    """
    if value.ndim != ndim:
        wanted = "one number" if ndim == 0 else "a list of numbers"
        raise ValueError(f"the {name} of {type(owner).__name__} must be {wanted}, not of shape {value.shape}")
    if isinstance(value, jax.core.Tracer):
        return
    # On the host, because under jit even a comparison of constants is traced.
    host = np.asarray(value)
    if not ((low < host) & (host < high)).all():
        limits = f"between {low:g} and {high:g}" if math.isfinite(high) else f"finite and above {low:g}"
        raise ValueError(f"the {name} of {type(owner).__name__} must be {limits}, not {host}")
