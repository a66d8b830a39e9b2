"""Compilation of functions that are called from Python code, not from other compiled functions."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future
from functools import cache
from pathlib import Path
from threading import Lock, Thread
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax import ShapeDtypeStruct
from jaxtyping import PyTree

from jaxsmw.runtime.traced_programs import Structure, UndescribedError, flatten, rebuild, traced

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

    If JAX stores compiled programs on disk, a later process neither traces nor compiles the function
    (`jaxsmw.runtime.traced_programs`). Equal functions give the same compiled function.
    """
    return _compiled(function, jax.default_backend())  # type: ignore[return-value]


@cache
def _compiled(function: Callable, backend: str) -> _CompiledFunction:
    return _CompiledFunction(function, backend)


class _Program(NamedTuple):
    """A compiled program from arrays to arrays, and the structure of its result."""

    run: Callable
    structure: Structure


_Arguments = tuple[tuple[PyTree, ...], Mapping[str, PyTree]]


class _CompiledFunction:
    """A function with its compiled programs, one for each combination of sizes and settings.

    The program is None if it cannot be stored on disk. JAX then keeps it in memory.
    """

    def __init__(self, function: Callable, backend: str):
        self._function, self._backend = function, backend
        # The type annotations of Equinox do not declare that Equinox passes unknown options on to JAX.
        self._jitted: Any = eqx.filter_jit(function, compiler_options=_options_for(backend))  # type: ignore[call-overload]
        self._programs: dict[Hashable, Future[_Program | None]] = {}
        self._lock = Lock()

    def __call__(self, *positional: PyTree, **named: PyTree) -> PyTree:
        """Call the function. Compile it first if needed, or wait for its compilation in the background."""
        arguments = positional, named
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments)):
            return self._jitted(*positional, **named)
        future, is_new = self._reserved(arguments)
        if is_new:
            self._load(future, arguments, ahead=False)
        if (program := future.result()) is None:
            return self._jitted(*positional, **named)
        return rebuild(program.structure, program.run(*flatten(arguments)[1]))

    def compile_ahead(self, arguments: _Arguments) -> Future[_Program | None]:
        """Start to compile the program for given arguments in the background."""
        future, is_new = self._reserved(arguments)
        x64 = jax.config.read("jax_enable_x64")

        def compile_now() -> None:
            with jax.enable_x64(x64):  # threads do not inherit this setting
                self._load(future, arguments, ahead=True)

        if is_new:
            Thread(target=compile_now).start()
        return future

    def _reserved(self, arguments: _Arguments) -> tuple[Future[_Program | None], bool]:
        """Return the future of the program for given arguments, and whether the caller must load it."""
        leaves, structure = jax.tree.flatten(arguments)
        key = structure, tuple(map(_kind, leaves)), _stores_programs(), jax.config.read("jax_enable_x64")
        with self._lock:
            future = self._programs.get(key)
            # After a failure, the next call tries again.
            is_new = future is None or (future.done() and future.exception() is not None)
            if future is None or is_new:
                future = self._programs[key] = Future()
            return future, is_new

    def _load(self, future: Future[_Program | None], arguments: _Arguments, *, ahead: bool) -> None:
        try:
            program = self._stored_program(arguments)
            if program is None and ahead:
                self._jitted.lower(*arguments[0], **arguments[1]).compile()
            future.set_result(program)
        except BaseException as error:
            future.set_exception(error)

    def _stored_program(self, arguments: _Arguments) -> _Program | None:
        if self._backend != "cpu" or not _stores_programs():
            return None
        try:
            structure, arrays = flatten(arguments)
            if not all(map(_is_plain, arrays)):
                return None
            shapes = [ShapeDtypeStruct(a.shape, jax.dtypes.canonicalize_dtype(a.dtype)) for a in arrays]
            exported, result = traced(self._function, structure, shapes)
        except (UndescribedError, ValueError):
            # JAX raises `ValueError` for operations that it cannot store. If the function itself raised the
            # error, it raises the error again when it is traced without being stored.
            return None
        function = jax.jit(exported.call, compiler_options=_options_for(self._backend))
        return _Program(function.lower(*shapes).compile(), result)


def _stores_programs() -> bool:
    settings: Any = jax.config  # JAX declares no types for its settings
    return bool(settings.jax_enable_compilation_cache and settings.jax_compilation_cache_dir)


def _kind(leaf: Any) -> Hashable:
    """Return what distinguishes the programs for an argument: the type of an array, or any other value."""
    if not eqx.is_array(leaf) and not isinstance(leaf, np.ndarray):
        return type(leaf), leaf
    return leaf.shape, jax.dtypes.canonicalize_dtype(leaf.dtype), _is_plain(leaf)


def _is_plain(array: jax.Array | np.ndarray) -> bool:
    """Return whether an array is a NumPy array, or is on the first device and has a type of its own."""
    if isinstance(array, np.ndarray):
        return True
    return not array.weak_type and array.devices() == {jax.local_devices()[0]}


def compile_ahead(
    function: Callable, arguments: Callable[[], _Arguments], **settings: object
) -> Future[_Program | None]:
    """Start to compile `compiled(function)` in the background, for arguments of given sizes.

    A later call of `compiled(function)` with such arguments waits for the program.

    **Arguments:**

    - `arguments`: a function without parameters that returns the arrays passed to `function`: a tuple of
      positional arguments and a mapping of named arguments. JAX only determines the sizes of the arrays.
    - `settings`: the remaining keyword arguments of `function`.

    **Returns:** A future that is done when the program is compiled, or when compilation raised an exception.
    """
    # Equinox traces only arrays. An array that is broadcast from one element takes almost no memory.
    positional, named = jax.tree.map(
        lambda shape: np.broadcast_to(np.zeros((), shape.dtype), shape.shape), jax.eval_shape(arguments)
    )
    program = _compiled(function, jax.default_backend())
    return program.compile_ahead((positional, {**named, **settings}))


def release_programs() -> None:
    """Release all compiled programs if the process uses a large share of its allowed memory maps.

    On Linux, the programs for a few dozen pairs of different sizes would use up all memory maps, and LLVM
    would end the process. JAX compiles released programs again or loads them from the disk. Call this
    function only between pairs of many, because it also releases the programs of the caller.
    """
    try:
        used = Path("/proc/self/maps").read_bytes().count(b"\n")
        available = int(Path("/proc/sys/vm/max_map_count").read_text("ascii"))
    except (OSError, ValueError):
        return
    if used > _LARGEST_SHARE * available:
        _compiled.cache_clear()
        jax.clear_caches()
