"""The command line: the parser of all commands, and the execution of one of them."""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

from jaxsmw.cli import (
    asymmetry,
    benchmark,
    cache,
    collection,
    complete,
    demo,
    evaluate,
    match,
    render,
    spectrum,
    transfer,
)
from jaxsmw.cli.arguments import add_quiet, shortened
from jaxsmw.cli.console import flush_output, log_to_console, say, show
from jaxsmw.errors import InputError
from jaxsmw.runtime.files import check_working_directory


def run_command(arguments: Sequence[str]) -> int:
    """Run the command with the given words after `jaxsmw`, and print one sentence if it fails.

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
        from jaxsmw.runtime.memory import check_address_space

        check_address_space()
        check_working_directory()
        cache_compiled_programs()
        options.run(options)


# The help lists the commands in this order.
_COMMANDS = {
    "demo": demo,
    "match": match,
    "transfer": transfer,
    "collection": collection,
    "asymmetry": asymmetry,
    "complete": complete,
    "evaluate": evaluate,
    "benchmark": benchmark,
    "spectrum": spectrum,
    "render": render,
    "cache": cache,
}


class Parser(argparse.ArgumentParser):
    """A parser that prints one sentence for bad arguments and exits with code 2."""

    def __init__(self, **settings: Any) -> None:
        # Abbreviated options are not allowed, because a new option with the same beginning would make an
        # abbreviation ambiguous.
        super().__init__(allow_abbrev=False, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown options first. For `--outptu`, argparse would report that `--output` is missing."""
        words = sys.argv[1:] if args is None else list(args)
        if (unknown := self._unknown_option(words)) is not None:
            import difflib

            nearest = difflib.get_close_matches(unknown, self._option_string_actions, n=1)
            cure = f": did you mean {nearest[0]}?" if nearest else ""
            self.error(f"unknown option {shortened(unknown)!r}{cure}")
        return super().parse_known_args(words, namespace)

    def _unknown_option(self, words: Sequence[str]) -> str | None:
        """Return the name of the first unknown option. The name of `--x=3` is `--x`."""
        options = self._option_string_actions
        if not {"-h", "--help"}.isdisjoint(words):
            return None
        for i, word in enumerate(words):
            if word == "--" or (self._subparsers and not word.startswith("-")):
                # Only positional arguments follow `--`. The options of a command follow its name.
                return None
            name = word.partition("=")[0]
            # Like argparse, treat negative numbers and words with blanks as values.
            if name in options or " " in word or not re.match(r"-(?!\.?\d).", word):
                continue
            # The words `--up -z` are not reported here: argparse reports that the value of `--up` is missing.
            if len(word) > 2 or i == 0 or words[i - 1] not in options or options[words[i - 1]].nargs == 0:
                return name
        return None

    def print_help(self, file: object = None) -> None:
        """Print the help. Unlike argparse, raise an error if standard output cannot be written."""
        show(self.format_help().rstrip())

    def error(self, message: str) -> NoReturn:
        """Print a message on standard error, and exit with code 2."""
        say(f"{self.prog}: {message} (see {self.prog} --help)")
        sys.exit(2)


def make_parser() -> Parser:
    """Return the parser of all commands. The attribute `run` of its result is the command's function."""
    parser = Parser(
        prog="jaxsmw",
        description="Match two triangle meshes (OFF, OBJ, PLY, STL, VTK, glTF or MATLAB's MAT) of the same "
        "kind of body in different poses: find for every vertex of one mesh the same point on the other.",
    )
    parser.add_argument("--version", action=_Version)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, command in _COMMANDS.items():
        subparser = commands.add_parser(name, help=command.HELP)
        command.add_arguments(subparser)
        add_quiet(subparser)
        subparser.set_defaults(run=command.run)
    return parser


class _Version(argparse.Action):
    """Prints the version, which is looked up only on request, because the look-up is slow."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(
            option_strings, argparse.SUPPRESS, nargs=0, default=argparse.SUPPRESS, help="print the version"
        )

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        import jaxsmw

        show(f"jaxsmw {jaxsmw.__version__}")
        parser.exit()
