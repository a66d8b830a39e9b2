"""Defines the options of the matching method, and calls `jaxsmw.match` with these options."""

from __future__ import annotations

import argparse
import sys
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from typing import TYPE_CHECKING, get_args

from jaxsmw.choices import (
    DEFAULT_BACKEND,
    DEFAULT_MATCH_INIT,
    DEFAULT_MIRROR,
    DEFAULT_PRESET,
    ITERATIONS,
    NUMBER_OF_EIGENVECTORS,
    Backend,
    MatchInit,
    Mirror,
    PresetName,
    Scale,
    Template,
)
from jaxsmw.cli.arguments import add_eigenproblem, add_values, option_of, whole_number
from jaxsmw.cli.banks import add_bank, bounds_unless_tight, make_bank
from jaxsmw.cli.console import Stopwatch, report_progress, say, show
from jaxsmw.cli.inputs import InitialMap
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    from jaxsmw.geometry.mesh import Mesh
    from jaxsmw.matching.correspondence import Correspondence
    from jaxsmw.matching.stages import Stage

# A dictionary from the name of each solution to its class, as "module:class" in `jaxsmw.core.solutions`, and
# its arguments. The first solution is the solution of the MWP paper.
_SOLUTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "filtering": ("closed_form:Filtering", ()),
    "least-squares": ("closed_form:LeastSquares", ()),
    "least-squares-frobenius": ("closed_form:LeastSquares", ("frobenius",)),
    "regularized": ("regularized:RegularizedLeastSquares", ()),
}
_PAPER_SOLUTION = next(iter(_SOLUTIONS))

# The options that change the method of the MWP paper, as attributes of the parsed options.
_CHANGES = (
    "eigenvectors",
    "bank",
    "filters",
    "solution",
    "iterations",
    "samples",
    "stop_when_unchanged",
)
# The preset that the options in `_CHANGES` modify.
_PAPER: PresetName = "paper"


def add_method(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the initial map, the preset and the method."""
    group = parser.add_argument_group("method")
    group.add_argument(
        "--init",
        metavar="INITIAL_MAP",
        type=InitialMap.parse,
        default=DEFAULT_MATCH_INIT,
        help=f"initial map: {', '.join(get_args(MatchInit))}, landmarks:FILE, "
        "landmarks:SOURCE_FILE,TARGET_FILE or map:FILE (default: "
        "%(default)s). auto is shot; with --preset accurate, other initial maps are also tried if the map "
        "is uncertain. With shot, wks, hks "
        "and wavelet, each source vertex is matched to the target vertex with the most similar descriptor. "
        "aligned also compares positions after a rigid alignment. "
        "functional computes a functional map that preserves SHOT descriptors. A landmarks file has a "
        "source and a target vertex per line. Two landmark files contain named points on the source and on "
        "the target, in the formats of "
        "transfer --landmarks. wks, hks and wavelet do not distinguish left from right",
    )
    group.add_argument(
        "--preset",
        choices=get_args(PresetName),
        help="method of refinement: paper is the method of the MWP paper; fast is the same method on "
        "samples; accurate has more stages and a search for the right map, so refinement takes nine to ten "
        f"times as long as with paper (default: {DEFAULT_PRESET}, or {_PAPER} if any option of the next "
        "group is given)",
    )
    group.add_argument(
        "--backend",
        choices=get_args(Backend),
        default=DEFAULT_BACKEND,
        help="what computes the refinement: numpy starts at once, jax compiles it first for the sizes of the "
        "meshes; auto is jax if JAX has an accelerator, else numpy (default: %(default)s)",
    )
    group.add_argument(
        "--mirror",
        choices=get_args(Mirror),
        default=DEFAULT_MIRROR,
        help="whether to match the mirror image of the source, because the meshes are of opposite hands, "
        "such as a left and a right tooth; the map belongs to the same source vertices; auto compares both "
        "hands of shapes that differ from their mirror images (default: %(default)s)",
    )
    group.add_argument(
        "--precision",
        choices=("float32", "float64"),
        default="float32",
        help="floating-point type of the refinement (default: %(default)s)",
    )
    add_eigenproblem(group)
    _add_changes(parser.add_argument_group("changes to the paper's method"))


def _add_changes(group: argparse._ActionsContainer) -> None:
    """Add the options in `_CHANGES`. If the user omits an option, its value is None."""
    add_values(
        group,
        whole_number(1),
        {"--eigenvectors N": f"number of eigenvectors per shape (default: {NUMBER_OF_EIGENVECTORS})"},
    )
    add_bank(group)
    group.add_argument(
        "--solution",
        choices=tuple(_SOLUTIONS),
        help="method that computes the functional map. filtering is meant for banks that are tight frames. "
        "least-squares computes the exact minimiser for all banks. least-squares-frobenius is "
        "least-squares with equal weights for all vertices. regularized is least-squares with additional "
        f"terms for commutativity with the Laplacian and for orthogonality (default: {_PAPER_SOLUTION})",
    )
    add_values(
        group,
        whole_number(1),
        {
            "--iterations N": f"number of iterations (default: {ITERATIONS})",
            "--samples N": "number of samples per shape on which the refiner iterates; the last step matches "
            "all vertices (default: the refiner iterates on all vertices)",
        },
    )
    group.add_argument(
        "--stop-when-unchanged",
        action="store_true",
        default=None,
        help="stop refinement when an iteration changes no match",
    )


def check_method(options: argparse.Namespace) -> None:
    """Check the landmark files of `--init`, and refuse changes to presets other than `paper`."""
    if options.preset not in (None, _PAPER) and (changes := _changes(options)):
        raise InputError(
            f"{changes[0]}: changes the paper's method, but --preset {options.preset} is another method: "
            "leave one of the two options out."
        )
    options.init.check()


def preset_name(options: argparse.Namespace) -> PresetName:
    """Return the name of the preset to use; by default `paper` if an option changes the paper's method."""
    return options.preset or (_PAPER if _changes(options) else DEFAULT_PRESET)


def given_method(options: argparse.Namespace) -> list[str]:
    """Return the names of the given options that matter only if meshes are matched, such as `--preset`."""
    others = {
        "--preset": options.preset is not None,
        "--init": options.init.text != DEFAULT_MATCH_INIT,
        "--mirror": options.mirror != DEFAULT_MIRROR,
    }
    return _changes(options) + [name for name, is_given in others.items() if is_given]


def _changes(options: argparse.Namespace) -> list[str]:
    """Return the names of the given options that change the paper's method, such as `--bank`."""
    return [option_of(name) for name in _CHANGES if getattr(options, name) is not None]


def match_meshes(
    options: argparse.Namespace,
    mesh_x: Mesh,
    mesh_y: Mesh,
    stopwatch: Stopwatch,
    template: Mesh | Template | None = None,
) -> Correspondence:
    """Match two meshes with the options of a command, and print their scale and hand if unknown.

    Some commands have no options `--partial`, `--scale` and `--index-base`.
    """
    from jaxsmw.matching.match import match

    scale: float | Scale | None = getattr(options, "scale", None)
    changes = _changes(options)
    if changes and options.preset is None:
        listed = " and ".join(filter(None, [", ".join(changes[:-1]), changes[-1]]))
        report_progress(
            f"note: preset {_PAPER} replaces {DEFAULT_PRESET}, because {listed} "
            f"{'changes' if len(changes) == 1 else 'change'} the paper's method."
        )
    with _precision(options.precision):
        correspondence = match(
            mesh_x,
            mesh_y,
            preset=_changed_stage(options) if changes else preset_name(options),
            init=options.init.read(mesh_x, mesh_y, index_base=getattr(options, "index_base", None)),
            laplacian=options.laplacian,
            eigensolver=options.eigensolver,
            partial=getattr(options, "partial", False),
            scale=scale or 1.0,
            template=template,
            mirror=options.mirror,
            backend=options.backend,
        )
    stopwatch.add(correspondence.seconds)
    if isinstance(scale, str):
        show(f"scale:       {correspondence.pair.scale:.4g} (lengths on the target / lengths on the source)")
    if correspondence.mirrored:
        show("hand:        the mirror image of the source")
    return correspondence


def _precision(name: str) -> AbstractContextManager[object]:
    """Return a context with the given default type of floats, which is a setting of JAX."""
    if name != "float64" and "jax" not in sys.modules:
        return nullcontext()
    import jax

    return jax.enable_x64(name == "float64")


def _changed_stage(options: argparse.Namespace) -> Stage:
    """Return a stage that runs the MWP paper's method with the changes that the options request."""
    from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
    from jaxsmw.matching.stages import Stage

    place, arguments = _SOLUTIONS[options.solution or _PAPER_SOLUTION]
    module, kind = place.split(":")
    make_solution = getattr(import_module(f"jaxsmw.core.solutions.{module}"), kind)
    refiner = WaveletPreservation(
        bank=make_bank(options.bank, options.filters),
        solution=make_solution(*arguments),
    )
    filtering = kind == "Filtering"
    if options.bank and filtering and (bounds := bounds_unless_tight(refiner.bank)):
        lower, upper = bounds
        say(
            f"note: {options.bank} is not a tight frame (frame bounds {lower:.2g} and {upper:.2g}), but "
            "filtering is meant for tight frames; --solution least-squares is exact for all banks."
        )
    return Stage(
        refiner,
        number_of_eigenvectors=options.eigenvectors or NUMBER_OF_EIGENVECTORS,
        iterations=options.iterations or ITERATIONS,
        number_of_samples=options.samples,
        stop_when_unchanged=bool(options.stop_when_unchanged),
    )
