"""The command line `jaxsmw`, with one module per command."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command in `sys.argv` and end the process.

    The exit code is 0 for success, 2 for bad input and 1 for any other failure. An interrupted process dies
    of the signal.
    """
    # Nothing is imported before interruptions are handled, because Ctrl-C in an import leaves a traceback.
    from jaxsmw.cli.interruption import end_when_interrupted

    end_when_interrupted()
    import sys

    from jaxsmw.cli.run import run_command

    sys.exit(run_command(sys.argv[1:]))
