"""Compilation of functions that are called from Python code, not from other compiled functions."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax import ShapeDtypeStruct
from jaxtyping import PyTree

from jaxsmw.runtime.traced_programs import UndescribedError, describe, rebuild, traced

Function = TypeVar("Function", bound=Callable)

_OPTIONS: dict[str, str | bool] = {
    "xla_cpu_experimental_ynn_fusion_type": "",
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
    "xla_backend_optimization_level": "1",
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
    takes 30 % less time (docs/speed.md). Sums of a million numbers are still accurate to within 5e-6. Level 1
    of optimisation instead of level 3 reduces the compilation time by a further 20 %. The programs return the
    same maps and take about the same time.

    JAX accepts these options only in the outermost `jax.jit`. Other compiled functions may call
    `jaxsmw.refine`, so `jaxsmw.refine` does not set the options itself. The options depend on the default
    backend of JAX, not on `jax.default_device`. If JAX's setting `jax_disable_most_optimizations` asks for
    the shortest compilation, the options do not raise the level of optimisation.

    **Returns:** A dictionary from the names of the options to their values. Options that the installed XLA
    does not support are left out. The dictionary is empty if the default backend is not the CPU.
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

    If JAX stores compiled programs on disk, the traced programs are stored as well
    (`jaxsmw.runtime.traced_programs`). A later process then neither traces nor compiles the function.

    Do not call the compiled function inside another compiled function. If `compiled` is called again with the
    same function, it returns the same compiled function.
    """
    return _compiled(function, jax.default_backend())  # type: ignore[return-value]


@cache
def _compiled(function: Callable, backend: str) -> _CompiledFunction:
    return _CompiledFunction(function, backend)


class _CompiledFunction:
    """A function with its compiled programs, one for each combination of sizes and settings."""

    def __init__(self, function: Callable, backend: str):
        self._function, self._backend = function, backend
        # The type annotations of Equinox do not declare that Equinox passes unknown options on to JAX.
        self._jitted: Any = eqx.filter_jit(function, compiler_options=_options_for(backend))  # type: ignore[call-overload]
        self._programs: dict[Hashable, Future[tuple[Callable, Any]]] = {}
        self._lock = Lock()

    def __call__(self, *positional: PyTree, **named: PyTree) -> PyTree:
        """Call the function, and compile it first if needed."""
        program, arrays = self._stored_program(positional, named)
        if program is None:
            return self._jitted(*positional, **named)
        run, structure = program
        return rebuild(structure, run(*arrays))

    def compile(self, positional: tuple[PyTree, ...], named: Mapping[str, PyTree]) -> None:
        """Compile the program for given arguments. Later calls with such arguments find it."""
        program, _ = self._stored_program(positional, named)
        if program is None:
            self._jitted.lower(*positional, **named).compile()

    def _stored_program(
        self, positional: tuple[PyTree, ...], named: Mapping[str, PyTree]
    ) -> tuple[tuple[Callable, Any] | None, list[Any]]:
        """Return a program that takes arrays and the structure of its result, and the arrays.

        The program is None if it cannot be stored on disk.
        """
        settings: Any = jax.config  # JAX declares no types for its settings
        stores = settings.jax_enable_compilation_cache and settings.jax_compilation_cache_dir
        if self._backend != "cpu" or not stores:
            return None, []
        try:
            structure, arrays = describe((positional, dict(named)))
        except UndescribedError:
            return None, []
        if not all(map(_is_plain, arrays)):
            return None, []
        shapes = [ShapeDtypeStruct(a.shape, jax.dtypes.canonicalize_dtype(a.dtype)) for a in arrays]
        key = str(structure), tuple((s.shape, s.dtype) for s in shapes), jax.config.read("jax_enable_x64")
        with self._lock:
            first = key not in self._programs
            future = self._programs.setdefault(key, Future())
        if first:
            try:
                future.set_result(self._loaded(structure, shapes))
            except (UndescribedError, ValueError) as error:
                future.set_exception(error)
            except BaseException as error:
                del self._programs[key]  # the next call tries again
                future.set_exception(error)
        try:
            return future.result(), arrays
        except (UndescribedError, ValueError):
            # JAX raises `ValueError` for operations that it cannot store. If the function itself raised the
            # error, it raises the error again when it is traced without being stored.
            return None, []

    def _loaded(self, structure: Any, shapes: list[ShapeDtypeStruct]) -> tuple[Callable, Any]:
        program = traced(self._function, structure, shapes)
        function = jax.jit(program.exported.call, compiler_options=_options_for(self._backend))
        return function.lower(*shapes).compile(), program.structure


def _is_plain(array: jax.Array | np.ndarray) -> bool:
    """Return whether an array is a NumPy array, or is on the first device and has a type of its own."""
    if isinstance(array, np.ndarray):
        return True
    if isinstance(array, jax.core.Tracer) or array.weak_type:
        return False
    return array.devices() == {jax.local_devices()[0]}


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
    program = _compiled(function, jax.default_backend())
    x64 = jax.config.read("jax_enable_x64")

    def compile_now() -> Any:
        with jax.enable_x64(x64):  # threads do not inherit this setting
            shapes = jax.eval_shape(arguments)
            # Equinox traces only arrays. An array that is broadcast from one element takes almost no memory.
            positional, named = jax.tree.map(
                lambda shape: np.broadcast_to(np.zeros((), shape.dtype), shape.shape), shapes
            )
            program.compile(positional, {**named, **settings})

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
        _compiled.cache_clear()
        jax.clear_caches()
