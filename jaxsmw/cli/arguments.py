"""Command-line arguments that several commands share, and argument types for `argparse`."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Mapping
from typing import get_args

from jaxsmw.choices import APPROXIMATE_FROM, Axis, Eigensolver, IndexBase, Laplacian, Scale
from jaxsmw.errors import InputError

# Larger numbers are refused, because JAX uses 32-bit integers by default.
_LARGEST_NUMBER = 2**31 - 1
_LONGEST_SHOWN = 60

MAP_FORMS = (
    "a text file with one target vertex per line, a .npy, .npz or .safetensors file, or a .mat file (counted "
    "from 1)"
)


def whole_number(least: int, most: int = _LARGEST_NUMBER) -> Callable[[str], int]:
    """Return an argument type that accepts whole numbers from `least` to `most`, both included."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{shortened(text)!r} is not a whole number") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"{value} is too small: give at least {least}")
        if value > most:
            raise argparse.ArgumentTypeError(f"{shortened(text)} is too large: give at most {most}")
        return value

    return convert


def path(text: str) -> str:
    """An argument type for names that a file or directory could have, whether or not it exists."""
    if not text:
        raise argparse.ArgumentTypeError("the name is empty: give the name of a file or directory")
    try:
        os.lstat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        fault = getattr(error, "strerror", None) or error
        raise argparse.ArgumentTypeError(
            f"{shortened(text)!r} cannot be used ({fault}): choose another name"
        ) from None
    return text


def _number(text: str) -> float:
    """Return a number, or NaN if the text is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def positive_number(text: str) -> float:
    """An argument type for positive numbers."""
    number = _number(text)
    if 0 < number < math.inf:
        return number
    raise argparse.ArgumentTypeError(f"{shortened(text)!r} is not a positive number")


def _scale(text: str) -> float | Scale:
    (unknown,) = get_args(Scale)
    if text == unknown:
        return unknown
    try:
        return positive_number(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"{shortened(text)!r} is no scale: give a positive number or {unknown}"
        ) from None


def shortened(text: str) -> str:
    """Shorten a text for a message."""
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…"


def add_values(
    parser: argparse._ActionsContainer, kind: Callable[[str], object], helps: Mapping[str, str]
) -> None:
    """Add options with a value of one argument type. The keys of `helps` are like `--output FILE`."""
    for words, text in helps.items():
        option, _, metavar = words.partition(" ")
        parser.add_argument(option, metavar=metavar, type=kind, help=text)


def add_paths(parser: argparse._ActionsContainer, helps: Mapping[str, str]) -> None:
    """Add options with the name of a file or directory, as `add_values` does."""
    add_values(parser, path, helps)


def add_seed(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add `--seed`. The help text begins with `purpose`."""
    parser.add_argument("--seed", type=whole_number(0), default=0, help=f"{purpose} (default: %(default)s)")


def add_processes(parser: argparse.ArgumentParser, *, default: int | None, purpose: str) -> None:
    """Add `--workers` and `--scheduler`, which exclude each other. `purpose` is the help of `--workers`."""
    processes = parser.add_mutually_exclusive_group()
    processes.add_argument("--workers", metavar="N", type=whole_number(1), default=default, help=purpose)
    processes.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a Dask scheduler, whose workers match the pairs"
    )


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Add `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="print no progress messages")


def add_source_and_target(parser: argparse.ArgumentParser) -> None:
    """Add the arguments `SOURCE` and `TARGET`, both meshes."""
    parser.add_argument(
        "source",
        type=path,
        metavar="SOURCE",
        help="source mesh; each of its vertices receives a match on the target",
    )
    parser.add_argument("target", type=path, metavar="TARGET", help="target mesh")


def add_eigenproblem(parser: argparse._ActionsContainer) -> None:
    """Add `--laplacian` and `--eigensolver`."""
    parser.add_argument(
        "--laplacian",
        choices=get_args(Laplacian),
        default="auto",
        help="discretization of the Laplacian: robust accepts degenerate triangles and non-manifold edges; "
        "auto chooses robust for meshes that need it, and cotangent for all other meshes (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--eigensolver",
        choices=get_args(Eigensolver),
        default="auto",
        help="method that computes eigenvectors. approximate is fast on large meshes. If all "
        "triangles have similar sizes and shapes, the approximate eigenvalues have errors of a few tenths of "
        "a per cent. If approximate would be inaccurate, a warning is printed and exact is used instead. "
        f"auto chooses approximate for meshes with at least {APPROXIMATE_FROM} vertices, and exact for "
        "smaller meshes (default: %(default)s)",
    )


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add `--weld` and `--index-base`, which say how files are read."""
    add_weld(parser)
    parser.add_argument(
        "--index-base",
        type=int,
        choices=get_args(IndexBase),
        help="number of the first vertex in map, landmark and ground-truth files (default: 1 in .mat, "
        ".baryc_gt, two .vts and two-column ground-truth files, and 0 in all other files)",
    )


def add_weld(parser: argparse.ArgumentParser) -> None:
    """Add `--weld`."""
    parser.add_argument(
        "--weld",
        metavar="TOLERANCE",
        nargs="?",
        const=True,
        default=False,
        type=_tolerance,
        help="merge vertices at the same position, and vertices at boundaries up to this distance, in the "
        "unit of the mesh (default: decided from the gap between the widths of cracks and the lengths of "
        "edges)",
    )


def _tolerance(text: str) -> float:
    """An argument type for lengths of at least 0. Python would take a mesh behind `--weld` for its length."""
    number = _number(text)
    if 0 <= number < math.inf:
        return number
    raise argparse.ArgumentTypeError(
        f"{shortened(text)!r} is not a length: give a number, or put --weld behind the meshes"
    )


def add_partial(parser: argparse.ArgumentParser, *, with_scale: bool) -> None:
    """Add `--partial`, and perhaps `--scale`."""
    condition = "" if with_scale else "; both must have the same unit of length"
    parser.add_argument(
        "--partial",
        action="store_true",
        help=f"declare that one mesh or both meshes are partial shapes of the body{condition}",
    )
    if with_scale:
        parser.add_argument(
            "--scale",
            type=_scale,
            help="for partial shapes: the number by which lengths on the source are multiplied to become "
            "lengths in the target's unit, or unknown to estimate it (default: 1, for the same unit of "
            "length)",
        )


def add_up(parser: argparse.ArgumentParser) -> None:
    """Add `--up`."""
    parser.add_argument(
        "--up",
        choices=get_args(Axis),
        help="axis of the mesh that points up in pictures (default: guessed from the mesh); to choose a "
        "negative axis, write for example --up=-z",
    )


def refuse_without(options: argparse.Namespace, needed: str, is_given: bool, *names: str) -> None:
    """Refuse the options `names`, which have no effect, unless the option `needed` is given."""
    for name in names:
        value = getattr(options, name)
        if not is_given and value is not None and value is not False and value != []:
            option = option_of(name)
            raise InputError(
                f"{option}: has no effect without {needed}: add {needed}, or leave {option} out."
            )


def option_of(name: str) -> str:
    """Return the option of an attribute of the parsed options, such as `--index-base` for `index_base`."""
    return f"--{name.replace('_', '-')}"
