"""Runs tasks in worker processes: on this machine, or on a Dask cluster.

Everything that one core per worker needs is set in the workers. The calling process keeps its environment,
its JAX caches and its other child processes.
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
    """Processes on this machine with one core each, which use JAX on the CPU whatever other devices exist.

    The processes end immediately if the `with` block ends by an exception.
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
    """A process that is started with one core.

    The variables must be there when the process starts: a worker imports the main module of the calling
    program before it runs any function of ours, and with that module perhaps NumPy and JAX, which read them
    once.
    """

    def start(self) -> None:
        with _environment(_ONE_CORE | {"XLA_FLAGS": _one_thread_flags()}):
            super().start()


class _OneCoreContext(SpawnContext):
    """Starts processes with one core each, and remembers them."""

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
    """Sets environment variables while a process starts, which takes milliseconds, and restores them."""
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


# Two threads that start processes at once would restore each other's variables.
_starting = threading.Lock()


def _start_worker() -> None:
    """Makes a worker ignore Ctrl-C, which the calling process handles, and end with the calling process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _call_in_worker(function: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """Calls a function in a worker; before that, releases compiled programs if they take too much memory.

    A worker meets many pairs of different sizes, and compiles programs for each.
    """
    release_programs()
    return function(*arguments, **options)


class _DaskWorkers(Executor):
    """The workers of a Dask cluster, which need the same care as local workers."""

    def __init__(self, executor: Executor):
        self._executor = executor

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Submits a call, like `concurrent.futures.Executor.submit`."""
        return self._executor.submit(_call_in_worker, function, *arguments, **options)


@contextmanager
def open_executor(workers: int, scheduler: str | None = None) -> Iterator[Executor]:
    """Starts local worker processes, or connects to the workers of a Dask cluster.

    **Arguments:**

    - `workers`: the number of local processes; ignored if `scheduler` is given.
    - `scheduler`: the address of a Dask scheduler, for example `tcp://host:8786`.

    **Raises:** `InputError` if Dask is not installed, or if no scheduler answers at the address.
    """
    if scheduler is None:
        with Workers(workers) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--scheduler needs Dask's distributed: install it with pip install 'jaxsmw[cluster]'."
        ) from None
    try:
        # Checked here because a client that fails for lack of a port leaves threads that log errors later.
        if urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}").port is None:
            raise ValueError("the address has no port")
        client = Client(scheduler, timeout=5, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"{scheduler}: no Dask scheduler answers there ({error}): start one, or give its address."
        ) from error
    with client:
        yield _DaskWorkers(client.get_executor(pure=False, retries=2))


def run_tasks(
    function: Callable[[Task], Result], tasks: Mapping[str, Task], executor: Executor
) -> Iterator[tuple[str, Result | BaseException]]:
    """Submits every task to an executor, and yields the name and the result of each as soon as it is done.

    A task that raised an exception yields the exception instead of a result.
    """
    futures = {executor.submit(function, task): name for name, task in tasks.items()}
    for future in as_completed(futures):
        # Removed from the dictionary so that a result is freed once it was yielded.
        name = futures.pop(future)
        error = future.exception()
        yield name, future.result() if error is None else error
