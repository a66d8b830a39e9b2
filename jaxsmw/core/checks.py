"""Conversions and checks of arguments."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import numpy as np
from jaxtyping import Bool

from jaxsmw.core.arrays import Array, float_type, is_array, is_tracer, namespace
from jaxsmw.core.module import Module, leaves

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def as_parameter(value: Array | float | Sequence[float | int]) -> Array:
    """Return a continuous parameter as an array of the default float type, which JAX can trace."""
    entries = value if isinstance(value, list | tuple) else (value,)
    return namespace(*entries).asarray(value, dtype=float_type())


def all_finite(tree: object) -> Bool[Array, ""]:
    """Return whether the arrays of floats in a pytree, at least one, contain only finite numbers."""
    inexact = [leaf for leaf in leaves(tree) if np.issubdtype(leaf.dtype, np.inexact)]
    xp = namespace(*inexact)
    return xp.all(xp.stack([xp.all(xp.isfinite(leaf)) for leaf in inexact]))


def check_integer(name: str, value: object) -> None:
    """Raise `TypeError` if the value of an option is not an integer."""
    if not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be an integer, not {value!r}")


def check_option(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise `ValueError` if the value of an option is not one of the choices."""
    if value not in choices:
        raise ValueError(f"{name}={value!r} is unknown: choose one of {', '.join(choices)}")


def check_array(name: str, value: object) -> None:
    """Raise `TypeError` if the value is not an array of NumPy or JAX."""
    if not is_array(value):
        check_kind(name, value, np.ndarray)


def check_kind(name: str, value: object, kind: type, example: str = "") -> None:
    """Raise `TypeError` if the value does not have the type `kind`, of which `example` is a value."""
    if isinstance(value, kind):
        return
    shown = repr(value) if isinstance(value, str | int | float | type | None) else type(value).__name__
    shown = "an array" if is_array(value) else shown
    needed = {np.ndarray: "an array", int: "an integer"}.get(kind, f"a {kind.__name__}")
    if isinstance(value, type) and issubclass(value, kind):
        cure = f": create it with {value.__name__}()"
    else:
        cure = f", such as {example}" if example else ""
    raise TypeError(f"the {name} is {shown}, but {needed} is needed{cure}")


def check_matches(name: str, pointwise_map: Array | np.ndarray, number_of_vertices: int) -> None:
    """Check that a map has one integer per vertex of X.

    **Raises:** `ValueError` if the map has another shape; `TypeError` if it is not an array of integers.
    """
    check_array(name, pointwise_map)
    if pointwise_map.shape != (number_of_vertices,):
        raise ValueError(
            f"the {name} has shape {pointwise_map.shape}, but X has {number_of_vertices} vertices: give one "
            "vertex of Y for each vertex of X"
        )
    if not np.issubdtype(pointwise_map.dtype, np.integer):
        raise TypeError(f"the {name} has type {pointwise_map.dtype}, but integer vertex indices are needed")


def check_between(
    owner: Module, name: str, value: Array, *, low: float = 0.0, high: float = math.inf, ndim: int = 0
) -> None:
    """Raise `ValueError` unless a parameter has `ndim` dimensions and lies strictly between its limits.

    Of a traced parameter, only the number of dimensions is checked.
    """
    if value.ndim != ndim:
        wanted = "one number" if ndim == 0 else "a list of numbers"
        raise ValueError(f"the {name} of {type(owner).__name__} must be {wanted}, not of shape {value.shape}")
    if is_tracer(value):
        return
    # NumPy makes this comparison, because under `jax.jit`, JAX traces even comparisons between constants.
    host = np.asarray(value)
    if not ((low < host) & (host < high)).all():
        limits = f"between {low:g} and {high:g}" if math.isfinite(high) else f"finite and above {low:g}"
        raise ValueError(f"the {name} of {type(owner).__name__} must be {limits}, not {host}")


def counts_iterations(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Decorate a compiled function so that its argument `iterations` may be an integer of any type.

    Apply this decorator outside `equinox.filter_jit`, which would otherwise trace a NumPy integer. The
    decorated function raises `TypeError` if `iterations` is not an integer or is traced, and `ValueError` if
    it is below 1.
    """

    @functools.wraps(function, updated=())
    def checked(*arguments: Parameters.args, **options: Parameters.kwargs) -> Returned:
        if "iterations" in options:
            options["iterations"] = _whole_number(function.__name__, options["iterations"])
        return function(*arguments, **options)

    return checked


def _whole_number(caller: str, iterations: object) -> int:
    try:
        number = operator.index(iterations)  # type: ignore[arg-type]
    except TypeError:
        raise TypeError(
            f"{caller} needs a whole number of iterations that is known at compile time, such as 3, "
            f"not {iterations!r}"
        ) from None
    if number < 1:
        raise ValueError(f"{caller} needs at least 1 iteration, not {number}")
    return number
