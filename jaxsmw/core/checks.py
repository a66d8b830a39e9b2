"""Settings of modules: how they become arrays, and checks made when a module is built."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

Function = TypeVar("Function", bound=Callable)


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


def check_kind(name: str, value: Any, *kinds: type) -> None:
    """**Raises:** `TypeError` if an argument is of none of these kinds."""
    if isinstance(value, kinds):
        return
    shown = repr(value) if isinstance(value, str | int | float | type | None) else type(value).__name__
    shown = "an array" if isinstance(value, jax.Array) else shown
    needed = "an array" if kinds[0] is np.ndarray else f"a {kinds[0].__name__}"
    raise TypeError(f"the {name} is {shown}, but {needed} is needed")


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


def counts_iterations(function: Function) -> Function:
    """Let a compiled function take any integer as its `iterations`, and nothing else.

    Outside of `equinox.filter_jit`, which would trace a NumPy integer.

    **Raises:** (by the function returned) `TypeError` for what is no integer, or has no value yet as it is
    traced; `ValueError` for fewer than one.
    """

    @functools.wraps(function, updated=())
    def checked(*arguments: Any, **options: Any) -> Any:
        if "iterations" in options:
            given = options["iterations"]
            try:
                iterations = operator.index(given)
            except TypeError:
                raise TypeError(
                    f"{function.__name__} needs a whole number of iterations that is known when it is "
                    f"compiled, such as 3, not {given!r}"
                ) from None
            if iterations < 1:
                raise ValueError(f"{function.__name__} needs at least 1 iteration, not {iterations}")
            options["iterations"] = iterations
        return function(*arguments, **options)

    return checked  # type: ignore[return-value]
