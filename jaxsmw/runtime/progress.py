"""Messages about the progress of a computation, and the times of its steps."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

logger = logging.getLogger("jaxsmw")

Progress = Callable[[str, int, int], None]
"""A function that is called with the name of a step, the number of finished parts and the number of parts."""


def no_progress(step: str, done: int, number: int) -> None:
    """Report nothing; a `Progress`."""


Step = Callable[[str], AbstractContextManager[None]]
"""A function that takes the name of a step, and returns the context in which the step runs."""


def no_step(name: str) -> AbstractContextManager[None]:
    """Return a context that reports nothing; a `Step`."""
    return nullcontext()


@contextmanager
def timed(name: str, seconds: dict[str, float]) -> Iterator[None]:
    """Log the name of a step, and add the wall time of the block to `seconds[name]`.

    If the block raises an exception, no time is added.
    """
    logger.info("%s ...", name)
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
