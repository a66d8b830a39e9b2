"""Limits the number of linear-algebra threads, and runs computations side by side."""

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
    """Return a context in which the linear algebra of NumPy and SciPy uses one thread.

    On CPUs the limit also applies to XLA, which uses the LAPACK of SciPy. On small arrays, more threads save
    no time. The threads of OpenBLAS also keep their cores busy while they wait for the next matrix.
    """
    return _libraries().limit(limits=1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    """Return the loaded linear-algebra libraries, whose lookup is slow."""
    return ThreadpoolController()


def side_by_side(compute: Callable[[Side], Result], *sides: Side) -> tuple[Result, ...]:
    """Return the results of a function for X and for Y, or for more arguments, computed in two threads."""
    # Both threads share one context of `one_blas_thread`. With one context per thread, the first thread to
    # end would also remove the limit for the other thread.
    with one_blas_thread(), ThreadPoolExecutor(2) as executor:
        futures = [executor.submit(copy_context().run, compute, side) for side in sides]
        return tuple(future.result() for future in futures)
