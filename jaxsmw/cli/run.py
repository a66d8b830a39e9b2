"""The execution of one command, from its arguments to its exit code."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from jaxsmw.cli.console import flush_output, log_to_console, say
from jaxsmw.cli.parser import make_parser
from jaxsmw.errors import InputError


def run_command(arguments: Sequence[str]) -> int:
    """Run a command, and print one sentence on standard error if it fails.

    `arguments` are the words of the command line after `jaxsmw`.

    **Returns:** The exit code: 0 for success, 2 for bad input, 1 for any other failure.
    """
    try:
        try:
            _run(arguments)
        finally:
            flush_output()
    except SystemExit as ending:  # the parser exits after the help and after bad arguments
        return int(ending.code or 0)
    except InputError as error:
        message, *notes = error.lines()
        say(f"jaxsmw: {message}")
        for note in notes:
            say(note)
        return 2
    except ArithmeticError as error:
        say(f"jaxsmw: {error}")
        return 1
    except MemoryError as error:
        detail = f" ({error})" if str(error) else ""
        say(
            f"jaxsmw: this machine has too little memory{detail}: give smaller meshes, or smaller "
            "numbers of vertices, eigenvectors or samples."
        )
        return 1
    except BrokenPipeError:  # the reader of standard output, such as `head`, has ended
        return 1
    return 0


def _run(arguments: Sequence[str]) -> None:
    options = make_parser().parse_args(arguments)
    log_to_console(quiet=options.quiet)
    shown: set[str] = set()

    def show_once(message: Warning | str, *_: object, **__: object) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            say(f"warning: {message}")

    with warnings.catch_warnings():
        warnings.showwarning = show_once
        from jaxsmw.runtime.cache import cache_compiled_programs
        from jaxsmw.runtime.files import check_working_directory
        from jaxsmw.runtime.memory import check_address_space

        check_address_space()
        check_working_directory()
        cache_compiled_programs()
        options.run(options)
