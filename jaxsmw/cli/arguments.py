"""Arguments that several commands share, and the types of arguments."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from typing import get_args

from jaxsmw.choices import APPROXIMATE_FROM, Axis, Eigensolver, IndexBase, Laplacian
from jaxsmw.errors import InputError

# JAX counts with 32 bits.
_LARGEST_NUMBER = 2**31 - 1
_LONGEST_SHOWN = 60

MAP_FORMS = "one target vertex per line, or a .npy file, or a .mat file counted from 1"


def whole_number(least: int, most: int = _LARGEST_NUMBER) -> Callable[[str], int]:
    """Returns an argument type: the whole numbers between two limits."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{_shortened(text)!r} is not a whole number") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"{value} is too small: give at least {least}")
        if value > most:
            raise argparse.ArgumentTypeError(f"{_shortened(text)} is too large: give at most {most}")
        return value

    return convert


def path(text: str) -> str:
    """Argument type: the name of a file or directory, which need not exist."""
    if not text:
        raise argparse.ArgumentTypeError("the name is empty: give the name of a file or directory")
    try:
        os.lstat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        fault = getattr(error, "strerror", None) or error
        raise argparse.ArgumentTypeError(
            f"{_shortened(text)!r} cannot be used ({fault}): choose another name"
        ) from None
    return text


def _shortened(text: str) -> str:
    """Returns the beginning of a long text, for a message."""
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…"


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Add `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="print no progress messages")


def add_source_and_target(parser: argparse.ArgumentParser) -> None:
    """Add the source and the target mesh."""
    parser.add_argument(
        "source", type=path, metavar="SOURCE", help="source mesh: every vertex gets a match on the target"
    )
    parser.add_argument("target", type=path, metavar="TARGET", help="target mesh")


def add_eigenproblem(parser: argparse._ActionsContainer) -> None:
    """Add `--laplacian` and `--eigensolver`."""
    parser.add_argument(
        "--laplacian",
        choices=get_args(Laplacian),
        default="auto",
        help="robust accepts degenerate triangles and non-manifold edges; auto is robust where a mesh needs "
        "it, otherwise cotangent (default: %(default)s)",
    )
    parser.add_argument(
        "--eigensolver",
        choices=get_args(Eigensolver),
        default="auto",
        help="approximate is fast on large meshes, and its eigenvalues are within a few per mille where "
        "triangles are even; where it would be far off, exact takes over with a warning; auto is approximate "
        f"from {APPROXIMATE_FROM} vertices on, otherwise exact (default: %(default)s)",
    )


def add_weld(parser: argparse.ArgumentParser) -> None:
    """Add `--weld`."""
    parser.add_argument("--weld", action="store_true", help="merge vertices at exactly the same position")


def add_index_base(parser: argparse.ArgumentParser) -> None:
    """Add `--index-base`."""
    parser.add_argument(
        "--index-base",
        type=int,
        choices=get_args(IndexBase),
        help="number of the first vertex in map, landmark and ground-truth files (default: 0, and 1 in .mat, "
        ".vts, .baryc_gt and two-column ground-truth files)",
    )


def add_partial(parser: argparse.ArgumentParser) -> None:
    """Add `--partial`."""
    parser.add_argument(
        "--partial",
        action="store_true",
        help="one mesh is a partial shape and the other the full shape, in the same unit of length",
    )


def add_up(parser: argparse.ArgumentParser) -> None:
    """Add `--up`."""
    parser.add_argument(
        "--up",
        choices=get_args(Axis),
        help="axis that points up in pictures (default: guessed from the mesh); write --up=-z for -z",
    )


def refuse_without(options: argparse.Namespace, needed: str, is_given: bool, *names: str) -> None:
    """Refuse options that have no effect without another option.

    **Arguments:**

    - `needed`: the other option, for the message.
    - `is_given`: whether the other option is given.
    - `names`: the options, as attributes of `options`.

    **Raises:** `InputError` for the first option that has no effect.
    """
    for name in names:
        value = getattr(options, name)
        if not is_given and value is not None and value is not False:
            option = f"--{name.replace('_', '-')}"
            raise InputError(
                f"{option}: has no effect without {needed}: add {needed}, or leave {option} out."
            )
