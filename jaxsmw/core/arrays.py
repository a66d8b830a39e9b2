"""Arrays of NumPy or of JAX: the functions of the core take their namespace from their arrays.

NumPy arrays are computed at once. JAX arrays can be traced, so the same functions work under `jax.jit`,
`jax.vmap` and `jax.grad`. The names and arguments of functions are those of the array API standard where the
standard has them. This module adds what the standard lacks, with one version for each namespace. Nothing here
imports JAX, unless an array of JAX exists already.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Int, Shaped

Carry = TypeVar("Carry")
Value = TypeVar("Value")

if TYPE_CHECKING:
    from jax import Array as JaxArray

    Array = JaxArray | np.ndarray
else:
    Array = Any  # an array of NumPy or JAX; jaxtyping checks its shape and its type


def is_traced(*arrays: object) -> bool:
    """Return whether at least one of the arguments is an array of JAX, so that JAX computes with it."""
    # While another thread imports JAX, the module exists, but has no attributes yet.
    kind = getattr(sys.modules.get("jax"), "Array", ())
    return any(isinstance(array, kind) for array in arrays)


def is_array(value: object) -> bool:
    """Return whether the value is an array of NumPy or JAX."""
    return isinstance(value, np.ndarray) or is_traced(value)


def is_tracer(value: object) -> bool:
    """Return whether the numbers of the value are unknown, because JAX is tracing a function of it."""
    return is_traced(value) and isinstance(value, sys.modules["jax"].core.Tracer)


def namespace(*arrays: object) -> Any:
    """Return the module with the functions for the arrays: `jax.numpy` if one is of JAX, else `numpy`."""
    return sys.modules["jax.numpy"] if is_traced(*arrays) else np


def float_type() -> type[np.floating]:
    """Return the default type of floats: float32, unless the setting `jax_enable_x64` of JAX is True.

    The environment variable of the setting counts until JAX is imported.
    """
    config = getattr(sys.modules.get("jax"), "config", None)
    if config is None:
        chosen = os.environ.get("JAX_ENABLE_X64", "").lower() in ("1", "true", "t", "yes", "y", "on")
    else:
        chosen = config.jax_enable_x64
    return np.float64 if chosen else np.float32


def on_host(array: Any) -> Any:
    """Return an array as a NumPy array, with floats of type `float_type()` and integers of type int32."""
    array = np.asarray(array)
    kinds = {"f": float_type(), "i": np.int32}
    return array.astype(kinds[array.dtype.kind], copy=False) if array.dtype.kind in kinds else array


def stop_gradient(array: Array) -> Array:
    """Return the array, as a constant for derivatives."""
    if not is_traced(array):
        return array
    from jax import lax

    return lax.stop_gradient(array)


def rows_at(array: Array, index: Array) -> Array:
    """Return the rows of an array at the indices, of which either can be an array of JAX."""
    return namespace(array, index).asarray(array)[index]


def replaced(array: Array, index: Any, values: Any) -> Array:
    """Return a copy of the array in which the entries at an index have other values."""
    if is_traced(array, values) or (isinstance(index, tuple) and is_traced(*index)) or is_traced(index):
        import jax.numpy as jnp

        return jnp.asarray(array).at[index].set(values)
    copy = np.array(array)
    copy[index] = values
    return copy


def cond(
    predicate: Array, if_true: Callable[..., Value], if_false: Callable[..., Value], *operands: Any
) -> Value:
    """Call one of two functions, as `jax.lax.cond` does."""
    if not is_traced(predicate):
        return (if_true if predicate else if_false)(*operands)
    from jax import lax

    return lax.cond(predicate, if_true, if_false, *operands)


def fori_loop(steps: int, body: Callable[[Any, Array], Array], value: Array) -> Array:
    """Apply `body(step, value)` for the steps 0, 1, …, as `jax.lax.fori_loop` does."""
    if not is_traced(value):
        for step in range(steps):
            value = body(step, value)
        return value
    from jax import lax

    return lax.fori_loop(0, steps, body, value)


def scan(
    step: Callable[[Carry, Any], tuple[Carry, Value]], carry: Carry, entries: Array
) -> tuple[Carry, Value]:
    """Apply `step(carry, entry)` to the entries of an array, and stack the second results.

    These are named tuples of arrays and None. See `jax.lax.scan`.
    """
    if not is_traced(entries):
        rows = []
        for entry in entries:
            carry, row = step(carry, entry)
            rows.append(row)
        kind: Any = type(rows[0])
        columns = zip(*rows, strict=True)
        return carry, kind(*(None if column[0] is None else np.stack(column) for column in columns))
    from jax import lax

    return lax.scan(step, carry, entries)


def in_blocks(
    compute: Callable[[Shaped[Array, "block d"]], Shaped[Array, "block ..."]],
    rows: Shaped[Array, "m d"],
    size: int,
) -> Shaped[Array, "m ..."]:
    """Return the results of a function for blocks of rows, with one result per row (m, ...).

    Blocks have `size` rows. NumPy leaves the last block shorter, and JAX fills it with zeros.
    """
    m, d = rows.shape
    if not is_traced(rows):
        starts = range(0, max(m, 1), size)
        return np.concatenate([compute(rows[start : start + size]) for start in starts])
    import jax.numpy as jnp
    from jax import lax

    blocks = -(-m // size)
    padded = jnp.pad(rows, ((0, blocks * size - m), (0, 0)))
    found = lax.map(compute, padded.reshape(blocks, size, d))
    return found.reshape(blocks * size, *found.shape[2:])[:m]


def segment_min(values: Shaped[Array, " p"], segments: Int[Array, " p"], number: int) -> Shaped[Array, " s"]:
    """Return the smallest value of each of a number of segments, which have at least one value each."""
    if is_traced(values, segments):
        import jax

        return jax.ops.segment_min(values, segments, number)
    least = np.full(number, values.max(), values.dtype)
    np.minimum.at(least, segments, values)
    return least
