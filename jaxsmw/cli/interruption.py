"""The end of the process on Ctrl-C: at once, with one line, without unfinished files.

Python would raise `KeyboardInterrupt` in the main thread. Compiled code delays this exception until the code
returns to Python. Functions that run at a garbage collection swallow the exception, and imports of extension
modules turn it into other errors. Here nothing is raised. A signal handler in the main thread ends the
process; while the main thread runs compiled code, a second thread does.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from _thread import allocate_lock
from contextlib import contextmanager, suppress

# Few and fast imports: Ctrl-C leaves a traceback until the signal is handled.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator

# The main thread ends the process as soon as it runs Python code. The second thread acts after these seconds.
_PATIENCE = 0.2

_message = "jaxsmw: interrupted; output files are complete or were not written.\n"
# The first interruption locks this for good.
_ending = allocate_lock()


def end_when_interrupted() -> None:
    """End this process on SIGINT from now on, unless its parent process ignores the signal for it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        return
    signal.signal(signal.SIGINT, _end)
    import threading

    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_wait_for_signal, args=(reading,), daemon=True).start()


def announce_consequence(consequence: str) -> None:
    """Set the line of a command with a progress bar: what an interruption means for the results."""
    global _message
    # The cursor stands behind the progress bar.
    _message = f"\njaxsmw: interrupted; {consequence}.\n"


@contextmanager
def quiet_children() -> Iterator[None]:
    """Keep the processes that this thread starts in the block from printing at an interruption.

    A terminal sends SIGINT to these processes as well, so they inherit a blocked SIGINT. Another thread of
    this process receives the signal. The process that removes leaked semaphores does not warn of them.
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
    # The main thread was first but is stuck, for example because nobody reads its message.
    time.sleep(1)
    _die()


def _end(*_: object) -> None:
    if not _ending.acquire(blocking=False):
        return
    console = -1
    with suppress(OSError):  # standard error may be closed
        console = os.dup(2)
        # Other threads still run for a moment; their messages would surround the line.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
    _remove_unfinished_files()
    with suppress(OSError):  # nobody may read standard error
        # A terminal has just printed "^C".
        line = f"\n{_message.lstrip()}" if os.isatty(console) else _message
        # `print` would fail if it were interrupted by itself.
        os.write(console, line.encode(errors="surrogateescape"))
    _die()


def _remove_unfinished_files() -> None:
    with suppress(Exception):  # the module may not be loaded completely
        if files := sys.modules.get("jaxsmw.runtime.files"):
            files.remove_unfinished()


def _die() -> None:
    """Die of SIGINT: a shell ends its loop only if the interrupted command dies of the signal."""
    with suppress(Exception):
        try:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        except ValueError:  # refused outside of the main thread
            import ctypes

            ctypes.pythonapi.PyOS_setsig(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    os._exit(128 + signal.SIGINT)
