"""Runs tasks in worker processes on this machine or on a Dask cluster.

A worker on this machine is limited to one core; the calling process and its other children stay unchanged.
loky 3.7 saves only 40 lines: its workers outlive a killed caller, and its resource tracker unblocks SIGINT.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import TypeVar
from urllib.parse import urlsplit

from jaxsmw.errors import InputError

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
    """An executor with `count` worker processes on this machine, each limited to one core of the CPU.

    If an exception ends the `with` block, the processes are terminated immediately.
    """

    def __init__(self, count: int):
        super().__init__(count, _OneCoreContext(), initializer=_start_worker)

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        if kind is not None:
            for process in list((self._processes or {}).values()):
                process.terminate()
        self.shutdown(wait=True, cancel_futures=True)


class _OneCoreProcess(SpawnProcess):
    def start(self) -> None:
        # Later changes of the environment would have no effect: a new process first imports the main module
        # of the calling program, which may import NumPy and JAX, and both read these variables only once.
        flags = os.environ.get("XLA_FLAGS", "")
        if _ONE_THREAD_FLAG not in flags:
            flags = f"{flags} {_ONE_THREAD_FLAG}".strip()
        with environment(_ONE_CORE | {"XLA_FLAGS": flags}), _signals_after():
            super().start()


@contextmanager
def _signals_after() -> Iterator[None]:
    """Handle signals at the end of the block. A new process whose caller ends would print a traceback."""
    received: list[int] = []
    before = {}
    if threading.current_thread() is threading.main_thread():  # Python handles signals only there
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
    Process = _OneCoreProcess


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within the block."""
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
    """Leave Ctrl-C and warnings to the calling process, and exit when the calling process exits."""
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


def _run_in_worker(function: Callable[[Task], Result], task: Task) -> tuple[Result, list[Warning]]:
    """Return the result of a task, and the worker's warnings since the last task."""
    result = function(task)
    issued = _warnings.copy()
    _warnings.clear()
    return result, issued


def _runs_in_dask() -> bool:
    """Return whether this call is a task of a Dask worker, which need not be a child process."""
    if (distributed := sys.modules.get("distributed")) is None:
        return False
    with suppress(ValueError):
        return distributed.get_worker() is not None
    return False


@contextmanager
def open_executor(workers: int, scheduler: str | None = None) -> Iterator[Executor]:
    """Start local worker processes, or connect to the workers of a Dask cluster, for a `with` block.

    **Arguments:**

    - `workers`: the number of local processes; ignored if `scheduler` is given.
    - `scheduler`: the address of a Dask scheduler, for example `tcp://host:8786`; None for local processes.
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
        yield client.get_executor(pure=False, retries=2)


def run_tasks(
    function: Callable[[Task], Result], tasks: Mapping[str, Task], executor: Executor | None
) -> Iterator[tuple[str, Result | BaseException]]:
    """Yield the name of each task, and its result or the exception that it raised, as soon as it ends.

    Without an executor, this process runs the tasks in their order. For an executor, the function and the
    tasks must be picklable. Warnings of local workers are issued in this process.
    """
    if executor is None:
        for name, task in tasks.items():
            try:
                outcome: Result | BaseException = function(task)
            except Exception as fault:
                outcome = fault
            yield name, outcome
        return
    futures = {executor.submit(_run_in_worker, function, task): name for name, task in tasks.items()}
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
