"""The errors of maps against the ground truth."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, get_args

from jaxsmw.choices import GeodesicMethod
from jaxsmw.cli.arguments import path, refuse_without, whole_number
from jaxsmw.cli.console import report_progress

if TYPE_CHECKING:
    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.geometry.mesh import Mesh


def add_ground_truth(parser: argparse.ArgumentParser, *, required: bool, purpose: str) -> None:
    """Add `--ground-truth`; the help begins with the purpose and lists the forms of files."""
    parser.add_argument(
        "--ground-truth",
        metavar="FILE",
        type=path,
        nargs="+",
        required=required,
        help=f"{purpose}: target vertices, one per line; or two .vts files, of the source and of the target; "
        "or a .baryc_gt file; or a file with two columns, a source and a target vertex",
    )


def add_evaluation(parser: argparse.ArgumentParser) -> None:
    """Add the options of geodesic errors; an option that is not given is None."""
    parser.add_argument(
        "--evaluation-samples",
        metavar="N",
        type=whole_number(1),
        help="measure the error at N random vertices (default: at all vertices with a known truth)",
    )
    parser.add_argument(
        "--seed", type=whole_number(0), help="seed for the choice of --evaluation-samples (default: 0)"
    )
    default, *_ = get_args(GeodesicMethod)
    parser.add_argument(
        "--geodesics",
        choices=get_args(GeodesicMethod),
        help="geodesic distances: strips is nearly always within 0.5 %% of exact, and much faster (default: "
        f"{default})",
    )


def check_evaluation(options: argparse.Namespace) -> None:
    """Refuse options of `add_evaluation` that have no effect.

    **Raises:** `InputError` that names the option.
    """
    measured = bool(options.ground_truth)
    refuse_without(options, "--ground-truth", measured, "evaluation_samples", "geodesics")
    refuse_without(options, "--evaluation-samples", bool(options.evaluation_samples), "seed")


def evaluation_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Returns the given options of `add_evaluation` as arguments of `jaxsmw.geodesic_error`."""
    settings = {
        "method": options.geodesics,
        "number_of_samples": options.evaluation_samples,
        "seed": options.seed,
    }
    return {name: value for name, value in settings.items() if value is not None}


def measure_errors(
    mesh_y: Mesh, maps: Mapping[str, Any], truth: GroundTruth, settings: Mapping[str, Any]
) -> dict[str, GeodesicError]:
    """Returns the geodesic error of each map, by name; `settings` are those of `evaluation_settings`."""
    from jaxsmw.evaluation.metrics import geodesic_error

    report_progress("geodesic errors ...")
    return {
        name: geodesic_error(mesh_y, pointwise_map, truth, **settings) for name, pointwise_map in maps.items()
    }
