"""The argument parser of the command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from jaxsmw.cli import benchmark, demo, evaluate, match, render, spectrum, transfer
from jaxsmw.cli.arguments import add_quiet
from jaxsmw.cli.console import say, show

# The help lists the commands in this order.
_COMMANDS = {
    "demo": demo,
    "match": match,
    "transfer": transfer,
    "evaluate": evaluate,
    "benchmark": benchmark,
    "spectrum": spectrum,
    "render": render,
}


class Parser(argparse.ArgumentParser):
    """A parser that prints one sentence for bad arguments and exits with code 2."""

    def __init__(self, **settings: Any) -> None:
        # Abbreviated options are not allowed, because a new option with the same beginning would make an
        # abbreviation ambiguous.
        super().__init__(allow_abbrev=False, **settings)

    def print_help(self, file: Any = None) -> None:
        """Print the help on standard output.

        Unlike the method of argparse, this method raises an error if standard output cannot be written. The
        argument `file` is ignored.
        """
        show(self.format_help().rstrip())

    def error(self, message: str) -> NoReturn:
        """Print a message on standard error, and exit with code 2."""
        say(f"{self.prog}: {message} (see {self.prog} --help)")
        sys.exit(2)


def make_parser() -> Parser:
    """Return the parser of all commands. Parsed options contain the command's function as attribute `run`."""
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
    """Prints the version. The version is looked up only on request, because the look-up is slow."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(
            option_strings, argparse.SUPPRESS, nargs=0, default=argparse.SUPPRESS, help="print the version"
        )

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        import jaxsmw

        show(f"jaxsmw {jaxsmw.__version__}")
        parser.exit()
