"""How functions are compiled where they are called from the host."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

Function = TypeVar("Function", bound=Callable)


def compiler_options() -> dict[str, str | bool]:
    """What to give `jax.jit` as its `compiler_options`, for searches in particular.

    On CPUs XLA leaves products and sums to a library (YNNPACK) that takes longer to wake its threads than a
    small one lasts: without it a search in patches takes half the time. And it makes several loops of each
    long sum, to be rounded less: with one, programs compile in two thirds of the time (docs/speed.md), and
    sums of a million numbers are still right within 5e-6. There are none for other devices, nor those that
    XLA does not know. JAX accepts options in the outermost `jax.jit` only, which is why `jaxsmw.refine`, to
    be called from other compiled functions, does not set them itself. They are for JAX's default backend,
    whatever `jax.default_device` says.
    """
    return dict(_options_for(jax.default_backend()))


@cache
def _options_for(backend: str) -> dict[str, str | bool]:
    return {name: value for name, value in _OPTIONS.items() if backend == "cpu" and _known(name, value)}


def _known(option: str, value: str | bool) -> bool:
    try:
        jax.jit(lambda: 0).lower().compile({option: value})
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True


_OPTIONS: dict[str, str | bool] = {
    "xla_cpu_experimental_ynn_fusion_type": "",
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}


def compiled(function: Function) -> Function:
    """The function compiled with `compiler_options`, to be called from the host; the same for the same."""
    return _compiled(function, jax.default_backend())


@cache
def _compiled(function: Function, backend: str) -> Function:
    # Equinox passes on what it does not know; its types do not say so.
    return eqx.filter_jit(function, compiler_options=_options_for(backend))  # type: ignore[call-overload]


def compile_ahead(
    function: Function, arguments: Callable[[], tuple[tuple, dict[str, Any]]], **settings: Any
) -> Future[object]:
    """Begin to compile in the background what `compiled(function)` needs for arguments of some sizes.

    Wait for the future before the call, or it compiles once more. What is wrong with the arguments is left
    for the call to say.

    **Arguments:**

    - `arguments`: makes arrays of these sizes, by position and by name; it is only traced.
    - `settings`: what else the function gets.
    """
    program: Any = compiled(function)
    x64 = jax.config.read("jax_enable_x64")

    def compile_it() -> object:
        with jax.enable_x64(x64):  # which threads do not inherit
            shapes = jax.eval_shape(arguments)
            # Equinox traces arrays only; these have no memory.
            positional, named = jax.tree.map(
                lambda shape: np.broadcast_to(np.zeros((), shape.dtype), shape.shape), shapes
            )
            return program.lower(*positional, **named, **settings).compile()

    executor = ThreadPoolExecutor(1)
    future = executor.submit(compile_it)
    executor.shutdown(wait=False)
    return future


def release_programs() -> None:
    """Let go of all compiled programs if they take a good part of the memory maps that a process may have.

    On Linux: with a few dozen pairs of unlike sizes they would take all, and LLVM ends a process that gets no
    more. What is still needed is compiled again, or loaded if programs are kept on disk.
    """
    try:
        used = Path("/proc/self/maps").read_bytes().count(b"\n")
        most = int(Path("/proc/sys/vm/max_map_count").read_text("ascii"))
    except (OSError, ValueError):
        return
    if used > _GOOD_PART * most:
        jax.clear_caches()


# A pair of new sizes takes up to three hundredths, and 250 MB.
_GOOD_PART = 0.25
