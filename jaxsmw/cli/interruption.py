"""The end of the process on Ctrl-C: soon, at any moment, with one line and without unfinished files.

Python's own way, an exception in whatever code happens to run, does not serve. Compiled code delays the
exception until it returns. Callbacks of JAX print the exception and go on. Imports of extension modules turn
it into other errors. Here the process ends at once instead, from its main thread or from a thread that waits
for the signal.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

# The main thread ends the process as soon as it runs Python code; after this time the other thread does.
_PATIENCE = 0.2

_message = "jaxsmw: interrupted; output files are complete or were not written.\n"
# Held from the first interruption on.
_ending = threading.Lock()


def end_when_interrupted() -> None:
    """End this process on SIGINT from now on, unless its parent had the signal ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        return
    signal.signal(signal.SIGINT, _end)
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_wait_for_signal, args=(reading,), daemon=True).start()


def announce_consequence(consequence: str) -> None:
    """Let the line say from now on what an interruption means for a command with a progress bar."""
    global _message
    # The cursor is behind the bar.
    _message = f"\njaxsmw: interrupted; {consequence}.\n"


@contextmanager
def quiet_children() -> Iterator[None]:
    """Python processes that this thread starts in the block say nothing about an interruption.

    A terminal sends SIGINT to them, too, but they inherit a blocked SIGINT. In this process another thread
    takes the signal. The process that removes the semaphores of `multiprocessing` gives no warnings.
    """
    silenced = "ignore::UserWarning:multiprocessing.resource_tracker"
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, [os.environ.get("PYTHONWARNINGS"), silenced]))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _wait_for_signal(reading: int) -> None:
    while os.read(reading, 1) != bytes([signal.SIGINT]):
        pass  # another signal
    time.sleep(_PATIENCE)
    _end()
    # The main thread was first, but does not get on, for example because nobody reads its message.
    time.sleep(1)
    _die()


def _end(*_: Any) -> None:
    if not _ending.acquire(blocking=False):
        return
    console = -1
    with suppress(OSError):  # standard error may be closed
        console = os.dup(2)
        # Other threads go on for a moment. What they print would follow the one line.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
    _remove_unfinished_files()
    with suppress(OSError):  # nobody may read standard error
        # A terminal shows "^C" where the cursor is.
        line = f"\n{_message.lstrip()}" if os.isatty(console) else _message
        # Not `print`, which fails within another `print`.
        os.write(console, line.encode(errors="surrogateescape"))
    _die()


def _remove_unfinished_files() -> None:
    with suppress(Exception):  # the module may be half loaded
        if files := sys.modules.get("jaxsmw.runtime.files"):
            files.remove_unfinished()


def _die() -> None:
    """Die of SIGINT: a shell ends its loop only if the process in the loop dies of the signal."""
    with suppress(Exception):
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        else:  # here `signal.signal` refuses to work
            import ctypes

            ctypes.pythonapi.PyOS_setsig(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    os._exit(128 + signal.SIGINT)
