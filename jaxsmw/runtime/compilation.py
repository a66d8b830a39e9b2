"""Compilation of functions that are called from Python code, not from other compiled functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import equinox as eqx
import jax

Function = TypeVar("Function", bound=Callable)

_OPTIONS: dict[str, str | bool] = {
    "xla_cpu_experimental_ynn_fusion_type": "",
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
    "xla_backend_optimization_level": "1",
}


def compiler_options() -> dict[str, str | bool]:
    """Return options of `jax.jit` that make searches and compilation fast on CPUs (docs/speed.md).

    XLA's library YNNPACK is disabled, because waking its threads takes longer than a small operation. Long
    sums are not split into several loops; sums of a million numbers are still accurate to within 5e-6. Level
    1 of optimisation instead of level 3 gives the same maps in about the same time. The level is not raised
    if JAX's setting `jax_disable_most_optimizations` asks for the shortest compilation.

    JAX accepts these options only in the outermost `jax.jit`, so `jaxsmw.refine` does not set them itself.
    The options depend on the default backend of JAX, not on `jax.default_device`.

    **Returns:** A dictionary from the names of the options to their values, for the argument
    `compiler_options` of `jax.jit`. Options that the installed XLA does not support are left out. The
    dictionary is empty if the default backend is not the CPU.
    """
    return _options_for(jax.default_backend())


def _options_for(backend: str) -> dict[str, str | bool]:
    if backend != "cpu":
        return {}
    options = {name: value for name, value in _OPTIONS.items() if _known(name, value)}
    if jax.config.read("jax_disable_most_optimizations"):
        options.pop("xla_backend_optimization_level", None)
    return options


@cache
def _known(option: str, value: str | bool) -> bool:
    """Return whether the installed XLA supports an option."""
    try:
        jax.jit(lambda: 0).lower().compile({option: value})
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True


def compiled(function: Function) -> Function:
    """Return the function compiled with `compiler_options`, for calls from Python.

    Equal functions give the same compiled function, which has one program for each combination of sizes and
    settings.
    """
    return _compiled(function, jax.default_backend())


@cache
def _compiled(function: Callable, backend: str) -> Any:
    # The type annotations of Equinox do not declare that Equinox passes unknown options on to JAX.
    return eqx.filter_jit(function, compiler_options=_options_for(backend))  # type: ignore[call-overload]
