"""The command line `jaxsmw`. Each command has its own module."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command in `sys.argv` and end the process.

    The exit code is 0 for success, 2 for bad input and 1 for any other failure. After an interruption
    (Ctrl-C), the signal SIGINT terminates the process.
    """
    # The signal handler is installed before all other imports. Without the handler, Ctrl-C during an import
    # would print a traceback.
    from jaxsmw.cli.interruption import end_when_interrupted

    end_when_interrupted()
    import gc
    import sys

    # Imports create many objects and almost no garbage.
    gc.set_threshold(100_000, 20, 20)
    from jaxsmw.cli.run import run_command

    code = run_command(sys.argv[1:])
    # Before Python ends, it searches all objects for garbage, which takes most of a second. It leaves out
    # frozen objects.
    gc.freeze()
    sys.exit(code)
