"""How functions are compiled where they are called from the host."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeVar

import equinox as eqx
import jax

Function = TypeVar("Function", bound=Callable)


def compiler_options() -> dict[str, str | bool]:
    """What to give `jax.jit` as its `compiler_options`, for searches in particular.

    On CPUs XLA leaves products and sums to a library (YNNPACK) that takes longer to wake its threads than a
    small one lasts: without it a search in patches takes half the time (docs/speed.md). There are none for
    other devices, or where XLA does not know the option. JAX accepts options in the outermost `jax.jit` only,
    which is why `jaxsmw.refine`, to be called from other compiled functions, does not set them itself. They
    are for JAX's default backend, whatever `jax.default_device` says.
    """
    return dict(_options_for(jax.default_backend()))


@cache
def _options_for(backend: str) -> dict[str, str | bool]:
    if backend != "cpu":
        return {}
    try:
        jax.jit(lambda: 0).lower().compile(_OPTIONS)
    except (jax.errors.JaxRuntimeError, ValueError):
        return {}
    return _OPTIONS


_OPTIONS: dict[str, str | bool] = {"xla_cpu_experimental_ynn_fusion_type": ""}


def compiled(function: Function) -> Function:
    """The function compiled with `compiler_options`, to be called from the host; the same for the same."""
    return _compiled(function, jax.default_backend())


@cache
def _compiled(function: Function, backend: str) -> Function:
    # Equinox passes on what it does not know; its types do not say so.
    return eqx.filter_jit(function, compiler_options=_options_for(backend))  # type: ignore[call-overload]
