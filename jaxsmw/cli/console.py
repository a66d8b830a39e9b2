"""Commands print results on standard output, and messages on standard error."""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from jaxsmw.errors import InputError
from jaxsmw.wording import printable

_logger = logging.getLogger("jaxsmw")


def show(text: str) -> None:
    """Print a result, which can have several lines, on standard output."""
    with _writing_output():
        print("\n".join(map(printable, text.split("\n"))), flush=True)


def flush_output() -> None:
    """Flush the buffer of standard output."""
    with _writing_output():
        if sys.stdout is not None:
            sys.stdout.flush()


@contextmanager
def _writing_output() -> Iterator[None]:
    """Raise `BrokenPipeError` if the reader of standard output has ended, `InputError` for other failures."""
    try:
        yield
    except OSError as error:
        # At exit, Python flushes standard output again. Standard output is redirected to the null device, so
        # Python does not report the same error twice.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise
        raise InputError(
            f"standard output: cannot be written ({error.strerror}): redirect standard output to a disk with "
            "free space."
        ) from error


def say(message: str) -> None:
    """Print a message as one line on standard error, with options in place of arguments of functions."""
    if sys.stderr is not None:
        with suppress(OSError):  # the command continues even if a message cannot be printed
            print(printable(with_options(message)), file=sys.stderr, flush=True)


# An argument that a message of the library recommends.
_ARGUMENT = re.compile(
    r"\b(coordinates|index_base|laplacian|mirror|partial|preset|scale|template|weld)="
    r"(?:True|([01])(?!\.?\w)|([\"'])(\w+)\3)"
)

# What a message names in words of Python, and the options that do the same.
_NAMES = {
    "Correspondence.alternatives": "match --alternatives 3",
    "init=landmarks": "--init landmarks:FILE",
    "template=mesh": "--template FILE",
    "jaxsmw.report.summary.write_report": "--report DIR",
}

# An argument for a number that an option without the first words sets.
_SIZE = re.compile(r"\bnumber_of_(eigenvectors|samples)\b")


def with_options(message: str) -> str:
    """Return a message of the library with options such as `--weld` in place of arguments."""

    def option(argument: re.Match[str]) -> str:
        value = argument[2] or argument[4]
        return f"--{argument[1].replace('_', '-')}" + (f" {value}" if value else "")

    for name, words in _NAMES.items():
        message = message.replace(name, words)
    return _SIZE.sub(r"--\1", _ARGUMENT.sub(option, message))


def report_progress(message: str) -> None:
    """Print a progress message on standard error. The option `--quiet` suppresses these messages."""
    _logger.info("%s", message)


def log_to_console(*, quiet: bool) -> None:
    """Print the library's log messages on standard error. With `quiet`, print only warnings and errors."""
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
    def step(self, name: str, *, announced: bool = False) -> Iterator[None]:
        """Record the time of the block as a step. Times of several steps with one name are added up."""
        if announced:
            report_progress(f"{name} ...")
        began = time.perf_counter()
        yield
        self.add({name: time.perf_counter() - began})

    def add(self, seconds: dict[str, float]) -> None:
        """Add the times of further steps, in seconds."""
        for name, more in seconds.items():
            self._seconds[name] = self._seconds.get(name, 0.0) + more

    def steps(self) -> dict[str, float]:
        """Return the time of each step in seconds; `other` is the time outside of all steps."""
        total = time.perf_counter() - self._began
        return {**self._seconds, "other": total - sum(self._seconds.values())}

    def summary(self) -> str:
        """Return the total time and the time of each step as text."""
        steps = self.steps()
        listed = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in steps.items())
        return f"{sum(steps.values()):.2f} s: {listed}"
