"""Computers with few cores: both shapes at once, and no threads that wait for each other."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from contextvars import copy_context
from functools import cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

Side = TypeVar("Side")
Result = TypeVar("Result")


def one_blas_thread() -> AbstractContextManager[object]:
    """For as long NumPy's and SciPy's linear algebra uses one thread, and XLA's on CPUs, which is SciPy's.

    More gain nothing on small arrays; and OpenBLAS's, done with a matrix, keep their cores busy for another
    while, waiting for the next one.
    """
    return _libraries().limit(limits=1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    """Those loaded; to look for them anew each time would take longer than what many a caller does."""
    return ThreadpoolController()


def side_by_side(compute: Callable[[Side], Result], x: Side, y: Side) -> tuple[Result, Result]:
    """The same for both shapes, in two threads with one core each; what takes long lets the other go on."""
    # One limit around both: each would undo the other's at its end.
    with one_blas_thread(), ThreadPoolExecutor(2) as executor:
        futures = [executor.submit(copy_context().run, compute, side) for side in (x, y)]
        result_x, result_y = (future.result() for future in futures)
    return result_x, result_y
