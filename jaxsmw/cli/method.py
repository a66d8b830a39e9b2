"""The options that choose how two meshes are matched, and the match itself."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any, get_args

from jaxsmw.choices import (
    DEFAULT_INITIAL_MAP,
    DEFAULT_PRESET,
    ITERATIONS,
    NUMBER_OF_EIGENVECTORS,
    IndexBase,
    InitialMap,
    PresetName,
    Search,
)
from jaxsmw.cli.arguments import add_eigenproblem, whole_number
from jaxsmw.cli.banks import add_bank, bounds_unless_tight, make_bank
from jaxsmw.cli.console import Stopwatch, report_progress, say
from jaxsmw.cli.inputs import initial_map, read_initial_map
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
    from jaxsmw.geometry.mesh import Mesh
    from jaxsmw.matching import Correspondence
    from jaxsmw.stage import Stage

# The class and the arguments of each solution. The first solution is the paper's.
_SOLUTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "filtering": ("Filtering", ()),
    "least-squares": ("LeastSquares", ()),
    "least-squares-frobenius": ("LeastSquares", ("frobenius",)),
    "regularized": ("RegularizedLeastSquares", ()),
}
_PAPER_SOLUTION = next(iter(_SOLUTIONS))

# The options that change the paper's method, as attributes of the options.
_CHANGES = (
    "eigenvectors",
    "bank",
    "filters",
    "solution",
    "iterations",
    "samples",
    "search",
    "stop_when_unchanged",
)
# The preset that these options need.
_PAPER: PresetName = "paper"


def add_method(parser: argparse.ArgumentParser) -> None:
    """Add the options of the method."""
    group = parser.add_argument_group("method")
    group.add_argument(
        "--init",
        metavar="INITIAL_MAP",
        type=initial_map,
        default=DEFAULT_INITIAL_MAP,
        help=f"initial map: {', '.join(get_args(InitialMap))}, landmarks:FILE or map:FILE (default: "
        "%(default)s). shot, wks, hks and wavelet take nearest neighbours of that descriptor; functional "
        "takes the functional map that preserves shot. A landmarks file has a source and a target vertex per "
        "line. Only shot, functional and landmarks tell left from right",
    )
    group.add_argument(
        "--preset",
        choices=get_args(PresetName),
        help="method of refinement: paper is that of the MWP paper; fast is the same on samples; accurate "
        f"refines three to four times as long as paper (default: {DEFAULT_PRESET}; {_PAPER} with any option "
        "of the next group)",
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
    """Add the options in `_CHANGES`; an option that is not given is None."""
    group.add_argument(
        "--eigenvectors",
        metavar="N",
        type=whole_number(1),
        help=f"number of eigenvectors per shape (default: {NUMBER_OF_EIGENVECTORS})",
    )
    add_bank(group)
    group.add_argument(
        "--solution",
        choices=tuple(_SOLUTIONS),
        help="computation of the functional map: filtering is for banks that are tight frames; least-squares "
        "is exact for all banks, -frobenius with equal weight for every vertex; regularized adds "
        f"commutativity with the Laplacian and orthogonality (default: {_PAPER_SOLUTION})",
    )
    group.add_argument(
        "--iterations",
        metavar="N",
        type=whole_number(1),
        help=f"number of iterations (default: {ITERATIONS})",
    )
    group.add_argument(
        "--samples",
        metavar="N",
        type=whole_number(1),
        help="iterate on N samples per shape, and search all vertices in the last step (default: iterate on "
        "all vertices)",
    )
    default_search, *_ = get_args(Search)
    group.add_argument(
        "--search",
        choices=get_args(Search),
        help="search for nearest neighbours: exhaustive and patches find the same ones, patches faster on "
        f"large meshes; auto takes the faster of the two (default: {default_search})",
    )
    group.add_argument(
        "--stop-when-unchanged",
        action="store_true",
        default=None,
        help="stop as soon as an iteration changes no match",
    )


def check_preset(options: argparse.Namespace) -> None:
    """Refuse options that change the paper's method together with another preset.

    **Raises:** `InputError` that names the option.
    """
    if options.preset not in (None, _PAPER) and (changes := _changes(options)):
        raise InputError(
            f"{changes[0]}: changes the paper's method, but --preset {options.preset} is another method: "
            "leave one of the two options out."
        )


def preset_name(options: argparse.Namespace) -> PresetName:
    """Returns the name of the given preset, of the paper's if an option changes it, or of the default."""
    return options.preset or (_PAPER if _changes(options) else DEFAULT_PRESET)


def _changes(options: argparse.Namespace) -> list[str]:
    """Returns the given options that change the paper's method."""
    return [f"--{name.replace('_', '-')}" for name in _CHANGES if getattr(options, name) is not None]


def match_meshes(
    options: argparse.Namespace,
    mesh_x: Mesh,
    mesh_y: Mesh,
    stopwatch: Stopwatch,
    *,
    partial: bool = False,
    index_base: IndexBase | None = None,
) -> Correspondence:
    """Match two meshes with the options of `add_method`.

    **Arguments:**

    - `index_base`: the number of the first vertex in a file of `--init`.

    **Raises:** `InputError` if an option does not fit the meshes.
    """
    import jax

    from jaxsmw.matching import match

    changes = _changes(options)
    if changes and options.preset is None:
        report_progress(
            f"note: preset {_PAPER} replaces {DEFAULT_PRESET}, because {' and '.join(changes)} "
            f"{'changes' if len(changes) == 1 else 'change'} the paper's method."
        )
    with jax.enable_x64(options.precision == "float64"):
        correspondence = match(
            mesh_x,
            mesh_y,
            preset=_changed_stage(options) if changes else preset_name(options),
            init=read_initial_map(options.init, mesh_x, mesh_y, index_base=index_base),
            laplacian=options.laplacian,
            eigensolver=options.eigensolver,
            partial=partial,
        )
    stopwatch.add(correspondence.seconds)
    return correspondence


def _changed_stage(options: argparse.Namespace) -> Stage:
    """Returns the paper's method with the given changes."""
    from jaxsmw.stage import Stage

    settings: dict[str, Any] = {
        "number_of_eigenvectors": options.eigenvectors,
        "iterations": options.iterations,
        "number_of_samples": options.samples,
        "stop_when_unchanged": options.stop_when_unchanged,
    }
    return Stage(_changed_refiner(options), **_given(settings))


def _changed_refiner(options: argparse.Namespace) -> WaveletPreservation:
    from jaxsmw.core import solutions
    from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation

    settings: dict[str, Any] = {"search": options.search}
    if options.bank or options.filters:
        settings["bank"] = make_bank(options.bank, options.filters)
    if options.solution:
        name, arguments = _SOLUTIONS[options.solution]
        settings["solution"] = getattr(solutions, name)(*arguments)
    refiner = WaveletPreservation(**_given(settings))
    if options.bank and isinstance(refiner.solution, solutions.Filtering):
        _note_loose_frame(options.bank, bounds_unless_tight(refiner.bank))
    return refiner


def _note_loose_frame(name: str, bounds: tuple[float, float] | None) -> None:
    if bounds:
        lower, upper = bounds
        say(
            f"note: {name} is not a tight frame (bounds {lower:.2g} and {upper:.2g}), but filtering is meant "
            "for tight frames; --solution least-squares is exact for every bank."
        )


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings that are not None; the library has defaults for the others."""
    return {name: value for name, value in settings.items() if value is not None}
