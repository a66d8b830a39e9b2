"""Work on many processes: those of this machine, or those of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TypeVar
from urllib.parse import urlsplit

from jaxsmw.errors import InputError

Task = TypeVar("Task")
Result = TypeVar("Result")

# One core for each process: thread pools that share cores spin against each other.
_ONE_CORE = {
    "JAX_PLATFORMS": "cpu",
    "PJRT_NPROC": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
_ONE_THREAD_FLAG = "--xla_cpu_multi_thread_eigen=false"


class Workers(ProcessPoolExecutor):
    """Processes on this machine with one core each; they end at once when the work is given up.

    Results are those of JAX on the CPU, whatever other devices there are.
    """

    def __init__(self, count: int):
        os.environ.update(_ONE_CORE)
        flags = os.environ.get("XLA_FLAGS", "")
        if _ONE_THREAD_FLAG not in flags:
            os.environ["XLA_FLAGS"] = f"{flags} {_ONE_THREAD_FLAG}".strip()
        super().__init__(count, multiprocessing.get_context("spawn"), initializer=_start_worker)

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        if kind is not None:
            for process in multiprocessing.active_children():
                process.terminate()
        self.shutdown(wait=True, cancel_futures=True)


def _start_worker() -> None:
    """Leave Ctrl-C to the parent process, and end with it however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def open_executor(workers: int, scheduler: str | None = None) -> Iterator[Executor]:
    """Processes on this machine, or the workers of a Dask scheduler at an address such as `tcp://host:8786`.

    **Raises:** `InputError` if Dask is not installed or nothing answers at the address.
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
        # A client that fails for want of a port leaves threads behind that complain later.
        if urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}").port is None:
            raise ValueError("it has no port")
        client = Client(scheduler, timeout=5, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"{scheduler}: no Dask scheduler answers there ({error}): start one, or give its address."
        ) from error
    with client:
        yield client.get_executor(pure=False, retries=2)


def run_tasks(
    function: Callable[[Task], Result], tasks: Mapping[str, Task], executor: Executor
) -> Iterator[tuple[str, Result | BaseException]]:
    """Give every task to a worker; yield its name and its result, or the error, as soon as it is there."""
    futures = {executor.submit(function, task): name for name, task in tasks.items()}
    for future in as_completed(futures):
        # Popped, so that what was yielded need not stay in memory.
        name = futures.pop(future)
        error = future.exception()
        yield name, future.result() if error is None else error
