"""Termination by a signal: the process ends at once, prints one line and leaves no unfinished files.

By default Python raises `KeyboardInterrupt` in the main thread. Compiled code delays this exception until the
code returns to Python. If `KeyboardInterrupt` is raised during garbage collection, Python discards it. If
`KeyboardInterrupt` is raised during the import of an extension module, Python raises another error instead.
Therefore this module ends the process without an exception, by a signal handler in the main thread. If the
main thread is in compiled code, a second thread ends the process.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from _thread import allocate_lock
from contextlib import contextmanager, suppress

# Until the signal handler is installed, Ctrl-C prints a traceback. Therefore this module imports only a few
# modules, which load quickly.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator

# The main thread ends the process as soon as it runs Python code. If the main thread does not run Python code
# within this number of seconds, the second thread ends the process.
_PATIENCE = 0.2

# SIGINT comes from Ctrl-C. SIGTERM comes from `kill`, job schedulers and containers. SIGHUP comes from a
# terminal that closes.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_message = "jaxsmw: interrupted; output files are complete or were not written.\n"
# The thread that ends the process acquires this lock and never releases it, so no second thread interferes.
_ending = allocate_lock()


def end_when_interrupted() -> None:
    """Install a handler that ends this process on signals, except those that were ignored when it started.

    The function must be called in the main thread.
    """
    handled = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    if not handled:
        return
    for number in handled:
        signal.signal(number, _end)
    import threading

    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_wait_for_signal, args=(reading,), daemon=True).start()


def announce_consequence(consequence: str) -> None:
    """Make an interruption say what happens to results. Commands with a progress bar call this function."""
    global _message
    # The message begins with a newline because the cursor is at the end of the progress bar.
    _message = f"\njaxsmw: interrupted; {consequence}.\n"


@contextmanager
def quiet_children() -> Iterator[None]:
    """Prevent processes that this thread starts in the block from printing messages on interruption.

    On Ctrl-C, a terminal also sends SIGINT to child processes. They inherit from this thread that SIGINT is
    blocked. Another thread of this process still receives SIGINT. The warning of Python's resource tracker
    about leaked semaphores is silenced, too.
    """
    from multiprocessing.resource_tracker import ensure_running

    from jaxsmw.runtime.workers import environment

    filters = os.environ.get("PYTHONWARNINGS")
    silenced = "ignore::UserWarning:multiprocessing.resource_tracker"
    # The start of the tracker unblocks SIGINT, so the tracker starts first.
    with environment({"PYTHONWARNINGS": f"{filters},{silenced}" if filters else silenced}):
        ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _wait_for_signal(reading: int) -> None:
    while (number := os.read(reading, 1)[0]) not in _SIGNALS:
        pass  # ignore other signals
    time.sleep(_PATIENCE)
    _end(number)
    # `_end` returns only if the main thread already runs `_end`. The main thread may be stuck, for example
    # because nobody reads the message from a pipe. Therefore this thread ends the process after one second.
    time.sleep(1)
    _die(number)


def _end(number: int, *_: object) -> None:
    if not _ending.acquire(blocking=False):
        return
    console = -1
    with suppress(OSError):  # standard error may be closed
        console = os.dup(2)
        # Other threads can still print until the process ends. Their output is discarded, because it would be
        # mixed with the message.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
    _remove_unfinished_files()
    with suppress(OSError):  # standard error may be a closed pipe
        # A terminal has just printed "^C", so the message starts on a new line.
        line = f"\n{_message.lstrip()}" if os.isatty(console) else _message
        # `print` would fail if the signal had interrupted another call of `print`.
        os.write(console, line.encode(errors="surrogateescape"))
    _die(number)


def _remove_unfinished_files() -> None:
    with suppress(Exception):  # `jaxsmw.runtime.files` may be only partly imported
        if files := sys.modules.get("jaxsmw.runtime.files"):
            files.remove_unfinished()


def _die(number: int) -> None:
    """End the process by a signal. SIGINT also ends a shell loop around the command."""
    with suppress(Exception):
        try:
            signal.signal(number, signal.SIG_DFL)
        except ValueError:  # `signal.signal` is allowed only in the main thread
            import ctypes

            ctypes.pythonapi.PyOS_setsig(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        time.sleep(1)
    os._exit(128 + number)
