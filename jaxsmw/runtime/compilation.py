"""Compilation of functions that Python calls directly, outside of other compiled functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

Function = TypeVar("Function", bound=Callable)

_OPTIONS: dict[str, str | bool] = {
    "xla_cpu_experimental_ynn_fusion_type": "",
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}
# Compiled programs are released when the process uses more than this share of its memory maps. The programs
# for a pair of new sizes take up to 3 % of the memory maps, and 250 MB of memory.
_LARGEST_SHARE = 0.25


def compiler_options() -> dict[str, str | bool]:
    """Returns options of `jax.jit` that make nearest-neighbour searches fast on CPUs.

    Pass the result to `jax.jit` as `compiler_options`. By default XLA delegates products and sums on CPUs to
    the library YNNPACK. Waking the threads of this library takes longer than a small operation. Without the
    library, a search in patches takes 63 to 72 % of the time. XLA also splits each long sum into several
    loops to reduce rounding errors. With one loop per sum, compilation takes 30 % less time (docs/speed.md).
    Sums of a million numbers are still accurate to within 5e-6.

    JAX accepts these options only in the outermost `jax.jit`. Other compiled functions may call
    `jaxsmw.refine`, so `jaxsmw.refine` does not set the options itself. The options depend on the default
    backend of JAX, not on `jax.default_device`.

    **Returns:** A dictionary from the names of the options to their values. It does not contain options that
    the installed XLA does not support. It is empty if the default backend is not the CPU.
    """
    return dict(_options_for(jax.default_backend()))


@cache
def _options_for(backend: str) -> dict[str, str | bool]:
    return {name: value for name, value in _OPTIONS.items() if backend == "cpu" and _known(name, value)}


def _known(option: str, value: str | bool) -> bool:
    """Returns whether the installed XLA supports an option."""
    try:
        jax.jit(lambda: 0).lower().compile({option: value})
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True


def compiled(function: Function) -> Function:
    """Returns the function compiled with `compiler_options`, for calls from Python.

    Do not call the result inside another compiled function. Repeated calls with the same function return the
    same compiled function.
    """
    return _compiled(function, jax.default_backend())


@cache
def _compiled(function: Function, backend: str) -> Function:
    # The type annotations of Equinox do not declare that Equinox passes unknown options on to JAX.
    return eqx.filter_jit(function, compiler_options=_options_for(backend))  # type: ignore[call-overload]


def compile_ahead(
    function: Callable,
    arguments: Callable[[], tuple[tuple[PyTree, ...], Mapping[str, PyTree]]],
    **settings: object,
) -> Future[object]:
    """Starts to compile `compiled(function)` in the background, for arguments of given sizes.

    Wait for the returned future before you call `compiled(function)`. Otherwise the call compiles the program
    again.

    **Arguments:**

    - `function`: the function to compile.
    - `arguments`: a function without arguments that returns arrays of the given sizes. Its result is a tuple
      of positional arguments and a mapping of named arguments. JAX only traces this function.
    - `settings`: the other arguments of the function, by name.

    **Returns:** A future that is done when the program is compiled. Errors in the arguments stay in this
    future. The call of `compiled(function)` raises them.
    """
    program: Any = compiled(function)  # the annotations of Equinox do not declare `lower`
    x64 = jax.config.read("jax_enable_x64")

    def compile_now() -> object:
        with jax.enable_x64(x64):  # threads do not inherit this setting
            shapes = jax.eval_shape(arguments)
            # Equinox traces only arrays. An array that is broadcast from one element takes almost no memory.
            positional, named = jax.tree.map(
                lambda shape: np.broadcast_to(np.zeros((), shape.dtype), shape.shape), shapes
            )
            return program.lower(*positional, **named, **settings).compile()

    executor = ThreadPoolExecutor(1)
    future = executor.submit(compile_now)
    executor.shutdown(wait=False)
    return future


def release_programs() -> None:
    """Releases all compiled programs of the process if it uses a large share of its memory maps.

    Commands call this function between pairs. Library functions must not call it, because `jax.clear_caches`
    also clears the programs of the caller. On Linux, the programs for a few dozen pairs of different sizes
    would use up all memory maps of the process, and LLVM would then end the process. Released programs are
    compiled again when they are needed. If programs are stored on disk, they are loaded from the disk
    instead. On other systems the function does nothing.
    """
    try:
        used = Path("/proc/self/maps").read_bytes().count(b"\n")
        available = int(Path("/proc/sys/vm/max_map_count").read_text("ascii"))
    except (OSError, ValueError):
        return
    if used > _LARGEST_SHARE * available:
        jax.clear_caches()
