"""Threads on computers with few cores: both shapes at once, without threads that wait for each other."""

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
    """Returns a context in which the linear algebra of NumPy and SciPy uses one thread.

    On CPUs this also holds for XLA, which uses the LAPACK of SciPy. More threads gain nothing on small
    arrays. Worse, the threads of OpenBLAS keep their cores busy after each matrix while they wait for the
    next.
    """
    return _libraries().limit(limits=1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    """Returns the loaded libraries. To look them up takes longer than many callers do."""
    return ThreadpoolController()


def side_by_side(compute: Callable[[Side], Result], x: Side, y: Side) -> tuple[Result, Result]:
    """Returns the results of a function for X and for Y, computed at the same time in two threads."""
    # The limit has to enclose both threads. With one limit per thread, the end of one would lift the other.
    with one_blas_thread(), ThreadPoolExecutor(2) as executor:
        futures = [executor.submit(copy_context().run, compute, side) for side in (x, y)]
        result_x, result_y = (future.result() for future in futures)
    return result_x, result_y
