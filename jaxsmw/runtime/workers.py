"""Runs tasks in worker processes on this machine or on a Dask cluster.

Each worker process on this machine is limited to one core. This limit does not affect the calling process:
its environment variables, its JAX caches and its other child processes stay unchanged.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, TypeVar
from urllib.parse import urlsplit

from jaxsmw.errors import InputError
from jaxsmw.runtime.compilation import release_programs

Task = TypeVar("Task")
Result = TypeVar("Result")

# The environment variables that limit a process to one core. If several processes share cores, their threads
# wait for each other in busy loops.
_ONE_CORE = {
    "JAX_PLATFORMS": "cpu",
    "PJRT_NPROC": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
_ONE_THREAD_FLAG = "--xla_cpu_multi_thread_eigen=false"


class Workers(ProcessPoolExecutor):
    """An executor with worker processes on this machine, each limited to one core.

    In the workers JAX runs on the CPU, even if there is a GPU. If an exception ends the `with` block, the
    processes are terminated immediately.

    **Arguments:**

    - `count`: the number of processes.
    """

    def __init__(self, count: int):
        self._context = _OneCoreContext()
        super().__init__(count, self._context, initializer=_start_worker)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Submit a call to a worker, like `concurrent.futures.Executor.submit`."""
        return super().submit(_call_in_worker, function, *arguments, **options)

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        if kind is not None:
            for process in self._context.started:
                process.terminate()
        self.shutdown(wait=True, cancel_futures=True)


class _OneCoreProcess(SpawnProcess):
    """A process that is limited to one core.

    `start` sets the environment variables of the limit before the process starts. Later changes would have no
    effect, because NumPy and JAX read these variables only once, when they are imported. A new process first
    imports the main module of the calling program, and this module may import NumPy and JAX.
    """

    def start(self) -> None:
        with environment(_ONE_CORE | {"XLA_FLAGS": _one_thread_flags()}), _signals_after():
            super().start()


@contextmanager
def _signals_after() -> Iterator[None]:
    """Handle the signals SIGINT, SIGTERM and SIGHUP that arrive in the `with` block at its end.

    If a signal ended this process while it starts another one, the other process would lack its arguments and
    print a traceback. Python handles signals only in the main thread.
    """
    received: list[int] = []
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, lambda signum, _: received.append(signum))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for signum in received:
            os.kill(os.getpid(), signum)  # `raise_signal` would send it to this thread, which may block it


class _OneCoreContext(SpawnContext):
    """A context that creates processes, each limited to one core, and keeps a list of these processes."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *arguments: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]
        process = _OneCoreProcess(*arguments, **options)
        self.started.append(process)
        return process


def _one_thread_flags() -> str:
    flags = os.environ.get("XLA_FLAGS", "")
    return flags if _ONE_THREAD_FLAG in flags else f"{flags} {_ONE_THREAD_FLAG}".strip()


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within the `with` block, and restore the previous values at its end."""
    with _starting:
        before = {name: os.environ.get(name) for name in variables}
        os.environ.update(variables)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


# Without the lock, two threads that start processes at the same time would restore each other's environment
# variables.
_starting = threading.Lock()


def _start_worker() -> None:
    """Make a worker ignore Ctrl-C, and make the worker exit when the calling process exits.

    Only the calling process handles Ctrl-C. Warnings are kept for the calling process; see `run_tasks`.
    """
    warnings.showwarning = lambda message, *_, **__: _warnings.append(message)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


# The warnings of this worker that `run_tasks` has not received yet.
_warnings: list[Warning] = []


def _with_warnings(function: Callable[[Task], Result], task: Task) -> tuple[Result, list[Warning]]:
    """Call a function in a worker. Return the result, and the worker's warnings since the last call."""
    result = function(task)
    issued = _warnings.copy()
    _warnings.clear()
    return result, issued


def _call_in_worker(function: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """Release compiled programs in a worker if they use too much memory, then call a function.

    A worker processes many pairs of different sizes, and each size needs its own compiled programs.
    """
    release_programs()
    return function(*arguments, **options)


class _DaskWorkers(Executor):
    """An executor for the workers of a Dask cluster. Compiled programs are released between tasks."""

    def __init__(self, executor: Executor):
        self._executor = executor

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Submit a call to a worker, like `concurrent.futures.Executor.submit`."""
        return self._executor.submit(_call_in_worker, function, *arguments, **options)


@contextmanager
def open_executor(workers: int, scheduler: str | None = None) -> Iterator[Executor]:
    """Start local worker processes, or connect to the workers of a Dask cluster.

    The function is a context manager. When the `with` block ends, the local processes end or the connection
    is closed.

    **Arguments:**

    - `workers`: the number of local processes; ignored if `scheduler` is given.
    - `scheduler`: the address of a Dask scheduler, for example `tcp://host:8786`; None for local processes.

    **Yields:** An executor for `run_tasks`.

    **Raises:** `InputError` if Dask is not installed, or if no scheduler responds at the address.
    """
    if scheduler is None:
        with Workers(workers) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--scheduler needs Dask's package distributed: run pip install 'jaxsmw[cluster]'."
        ) from None
    try:
        # An address without a port is rejected here, because `Client` would fail and leave threads that log
        # errors later.
        if urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}").port is None:
            raise ValueError("the address has no port")
        client = Client(scheduler, timeout=5, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"{scheduler}: no Dask scheduler answers at this address ({error}): start a scheduler there, or "
            "give the address of a running scheduler."
        ) from error
    with client:
        yield _DaskWorkers(client.get_executor(pure=False, retries=2))


def run_tasks(
    function: Callable[[Task], Result], tasks: Mapping[str, Task], executor: Executor
) -> Iterator[tuple[str, Result | BaseException]]:
    """Submit every task to an executor, and yield the result of each task as soon as the task ends.

    **Arguments:**

    - `function`: the function that is called once with each task. The function and the tasks must be
      picklable.
    - `tasks`: a dictionary from the name of each task to the argument with which `function` is called.
    - `executor`: the executor that runs the calls; see `open_executor`.

    **Yields:** A tuple for each task, with the name of the task and the result of `function`. If `function`
    raised an exception, the tuple contains the exception instead of a result. Tuples are yielded in the order
    in which the tasks end. Warnings that a task issues in a process of `Workers` are issued again in the
    calling process.
    """
    futures = {executor.submit(_with_warnings, function, task): name for name, task in tasks.items()}
    for future in as_completed(futures):
        # The dictionary must not keep the future, because the future holds the result in memory.
        name = futures.pop(future)
        error = future.exception()
        if error is not None:
            yield name, error
            continue
        result, issued = future.result()
        for warning in issued:
            warnings.warn(warning, stacklevel=1)
        yield name, result
