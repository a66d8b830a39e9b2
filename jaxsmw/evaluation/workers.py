"""Runs tasks in worker processes: on this machine, or on a Dask cluster.

The settings that limit a process to one core apply to the workers only. The environment, the JAX caches and
the other child processes of the calling process stay unchanged.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
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

# One core per process: thread pools that share cores wait for each other in busy loops.
_ONE_CORE = {
    "JAX_PLATFORMS": "cpu",
    "PJRT_NPROC": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
_ONE_THREAD_FLAG = "--xla_cpu_multi_thread_eigen=false"


class Workers(ProcessPoolExecutor):
    """Worker processes on this machine with one core each. JAX runs on the CPU, even if there is a GPU.

    If an exception ends the `with` block, the processes are terminated at once.

    **Arguments:**

    - `count`: the number of processes.
    """

    def __init__(self, count: int):
        self._context = _OneCoreContext()
        super().__init__(count, self._context, initializer=_start_worker)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Submits a call, like `concurrent.futures.Executor.submit`."""
        return super().submit(_call_in_worker, function, *arguments, **options)

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        if kind is not None:
            for process in self._context.started:
                process.terminate()
        self.shutdown(wait=True, cancel_futures=True)


class _OneCoreProcess(SpawnProcess):
    """A process that is limited to one core.

    The environment variables must be set before the process starts. NumPy and JAX read these variables only
    once, on import. A worker imports the main module of the calling program, and perhaps NumPy and JAX with
    it, before it runs any function of this library.
    """

    def start(self) -> None:
        with _environment(_ONE_CORE | {"XLA_FLAGS": _one_thread_flags()}):
            super().start()


class _OneCoreContext(SpawnContext):
    """Starts processes with one core each, and keeps a list of them."""

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
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Sets environment variables for the milliseconds in which a process starts, then restores them."""
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


# Without the lock, two threads that start processes at the same time would restore each other's variables.
_starting = threading.Lock()


def _start_worker() -> None:
    """Makes a worker ignore Ctrl-C, and makes it exit when the calling process exits.

    The calling process handles Ctrl-C.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _call_in_worker(function: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """Calls a function in a worker, after releasing compiled programs if they take too much memory.

    A worker processes many pairs of different sizes, and each size needs its own compiled programs.
    """
    release_programs()
    return function(*arguments, **options)


class _DaskWorkers(Executor):
    """The workers of a Dask cluster. Like local workers, they release compiled programs between tasks."""

    def __init__(self, executor: Executor):
        self._executor = executor

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Submits a call, like `concurrent.futures.Executor.submit`."""
        return self._executor.submit(_call_in_worker, function, *arguments, **options)


@contextmanager
def open_executor(workers: int, scheduler: str | None = None) -> Iterator[Executor]:
    """Starts local worker processes, or connects to the workers of a Dask cluster.

    The function is a context manager. The local processes or the connection end with the `with` block.

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
            "--scheduler needs Dask's package distributed: install it with pip install 'jaxsmw[cluster]'."
        ) from None
    try:
        # Checked first, because a client that fails for lack of a port leaves threads that log errors later.
        if urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}").port is None:
            raise ValueError("the address has no port")
        client = Client(scheduler, timeout=5, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"{scheduler}: no Dask scheduler answers at this address ({error}): start a scheduler, or give "
            "its address."
        ) from error
    with client:
        yield _DaskWorkers(client.get_executor(pure=False, retries=2))


def run_tasks(
    function: Callable[[Task], Result], tasks: Mapping[str, Task], executor: Executor
) -> Iterator[tuple[str, Result | BaseException]]:
    """Submits every task to an executor, and yields the result of each task as soon as the task ends.

    **Arguments:**

    - `function`: called once with each task. The function and the tasks must be picklable.
    - `tasks`: the tasks by name.
    - `executor`: runs the calls; see `open_executor`.

    **Yields:** The name of a task and its result, in the order in which the tasks end. If a task raised an
    exception, the exception takes the place of the result.
    """
    futures = {executor.submit(function, task): name for name, task in tasks.items()}
    for future in as_completed(futures):
        # Removed from the dictionary, so that the memory of a result is freed after the result is yielded.
        name = futures.pop(future)
        error = future.exception()
        yield name, future.result() if error is None else error
