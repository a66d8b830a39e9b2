"""The output of commands: results go to standard output, all messages to standard error."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from jaxsmw.errors import InputError

_logger = logging.getLogger("jaxsmw")


def show(text: str) -> None:
    """Print a result on standard output.

    **Raises:** `InputError` if standard output cannot be written; `BrokenPipeError` if nobody reads it.
    """
    with _writing_output():
        print(text, flush=True)


def flush_output() -> None:
    """Write the buffer of standard output.

    **Raises:** As `show`.
    """
    with _writing_output():
        if sys.stdout is not None:
            sys.stdout.flush()


@contextmanager
def _writing_output() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        # Python writes the buffer once more at its end, and would report the same error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise
        raise InputError(
            f"standard output: cannot be written ({error.strerror}): redirect it to a place with free space."
        ) from error


def say(message: str) -> None:
    """Print a message on standard error."""
    if sys.stderr is not None:
        with suppress(OSError):  # a lost message is no reason to stop the work
            print(message, file=sys.stderr, flush=True)


def report_progress(message: str) -> None:
    """Print a message on standard error, except with `--quiet`."""
    _logger.info("%s", message)


def log_to_console(*, quiet: bool) -> None:
    """Let the library's log messages appear on standard error; with `quiet`, warnings and errors only."""
    _logger.handlers, _logger.propagate = [_Handler()], False
    _logger.setLevel(logging.WARNING if quiet else logging.INFO)


class _Handler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        say(record.getMessage())


class Stopwatch:
    """The wall time of a command and of its steps."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._seconds: dict[str, float] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Measure a block as a step. The times of steps with the same name are added."""
        began = time.perf_counter()
        yield
        self.add({name: time.perf_counter() - began})

    def add(self, seconds: dict[str, float]) -> None:
        """Add steps that were measured elsewhere: seconds by the name of the step."""
        for name, more in seconds.items():
            self._seconds[name] = self._seconds.get(name, 0.0) + more

    def steps(self) -> dict[str, float]:
        """Returns the seconds of each step so far; `other` is the time outside of all steps."""
        total = time.perf_counter() - self._began
        return {**self._seconds, "other": total - sum(self._seconds.values())}

    def summary(self) -> str:
        """Returns the total time and the time of each step."""
        steps = self.steps()
        listed = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in steps.items())
        return f"{sum(steps.values()):.2f} s: {listed}"
