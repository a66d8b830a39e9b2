"""Compilation of functions that are called from Python code, not from other compiled functions."""

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
# Linux limits the number of memory maps of a process. Compiled programs are released when the process uses
# more than this share of the limit. For each new combination of sizes, the compiled programs use up to 3 % of
# the limit and up to 250 MB of memory.
_LARGEST_SHARE = 0.25


def compiler_options() -> dict[str, str | bool]:
    """Return options of `jax.jit` that make nearest-neighbour searches fast on CPUs.

    Pass the result to `jax.jit` as `compiler_options`. By default, XLA uses the library YNNPACK for products
    and sums on CPUs. Waking the threads of YNNPACK takes longer than a small operation. The options disable
    YNNPACK, which reduces the time of a search in patches by 28 to 37 %. By default, XLA also splits each
    long sum into several loops to reduce rounding errors. The options disable this splitting, so compilation
    takes 30 % less time (docs/speed.md). Sums of a million numbers are still accurate to within 5e-6.

    JAX accepts these options only in the outermost `jax.jit`. Other compiled functions may call
    `jaxsmw.refine`, so `jaxsmw.refine` does not set the options itself. The options depend on the default
    backend of JAX, not on `jax.default_device`.

    **Returns:** A dictionary from the names of the options to their values. Options that the installed XLA
    does not support are left out. The dictionary is empty if the default backend is not the CPU.
    """
    return dict(_options_for(jax.default_backend()))


@cache
def _options_for(backend: str) -> dict[str, str | bool]:
    return {name: value for name, value in _OPTIONS.items() if backend == "cpu" and _known(name, value)}


def _known(option: str, value: str | bool) -> bool:
    """Return whether the installed XLA supports an option."""
    try:
        jax.jit(lambda: 0).lower().compile({option: value})
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True


def compiled(function: Function) -> Function:
    """Return the function compiled with `compiler_options`, for calls from Python.

    Do not call the compiled function inside another compiled function. If `compiled` is called again with the
    same function, it returns the same compiled function.
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
    """Start to compile `compiled(function)` in the background, for arguments of given sizes.

    Wait for the returned future before you call `compiled(function)`. Otherwise the call compiles the program
    again.

    **Arguments:**

    - `arguments`: a function without parameters. It returns the arrays that are passed to `function`: a
      tuple of positional arguments and a mapping of named arguments. JAX traces `arguments` to determine the
      sizes of the arrays, and does not compute the arrays.
    - `settings`: the remaining keyword arguments of `function`.

    **Returns:** A future that is done when the program is compiled. If compilation raises an exception, the
    future stores the exception. A later call of `compiled(function)` with the same arguments raises the
    exception again.
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
    """Release all compiled programs if the process uses a large share of its allowed memory maps.

    Commands call this function between pairs. Functions that match many pairs also call it. Functions that
    match one pair must not call it, because `jax.clear_caches` also clears the programs of the caller. On
    Linux, the programs for a few dozen pairs of different sizes would use up all memory maps of the process.
    LLVM would then end the process. JAX compiles released programs again when they are needed, or loads them
    from the disk. On other systems the function does nothing.
    """
    try:
        used = Path("/proc/self/maps").read_bytes().count(b"\n")
        available = int(Path("/proc/sys/vm/max_map_count").read_text("ascii"))
    except (OSError, ValueError):
        return
    if used > _LARGEST_SHARE * available:
        jax.clear_caches()
