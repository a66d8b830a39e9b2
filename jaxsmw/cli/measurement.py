"""Measures the geodesic errors of maps, and defines the options of this measurement."""

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
    """Add `--ground-truth`.

    **Arguments:**

    - `required`: whether the command requires the option.
    - `purpose`: the beginning of the help text, before the list of accepted files.
    """
    parser.add_argument(
        "--ground-truth",
        metavar="FILE",
        type=path,
        nargs="+",
        required=required,
        help=f"{purpose}: a file with one target vertex per line, a file with a source and a target vertex "
        "per line, a .baryc_gt file, or two .vts files (source first). Two other files are read like .vts "
        "files: line i of both contains the vertices of the same point",
    )


def add_evaluation(parser: argparse.ArgumentParser) -> None:
    """Add `--evaluation-samples`, `--seed` and `--geodesics`. Omitted options are None."""
    parser.add_argument(
        "--evaluation-samples",
        metavar="N",
        type=whole_number(1),
        help="number of random vertices at which errors are measured (default: all vertices with ground "
        "truth)",
    )
    parser.add_argument(
        "--seed", type=whole_number(0), help="seed for the random choice of --evaluation-samples (default: 0)"
    )
    default, *_ = get_args(GeodesicMethod)
    parser.add_argument(
        "--geodesics",
        choices=get_args(GeodesicMethod),
        help="method for geodesic distances: strips is much faster than exact, and its distances nearly "
        f"always differ from the exact distances by less than 0.5 %% (default: {default})",
    )


def check_evaluation(options: argparse.Namespace) -> None:
    """Refuse options of `add_evaluation` that have no effect because another option is missing.

    **Raises:** `InputError` that names the first given option that has no effect.
    """
    measured = bool(options.ground_truth)
    refuse_without(options, "--ground-truth", measured, "evaluation_samples", "geodesics")
    refuse_without(options, "--evaluation-samples", bool(options.evaluation_samples), "seed")


def evaluation_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the given options of `add_evaluation` as keyword arguments of `jaxsmw.geodesic_error`."""
    settings = {
        "method": options.geodesics,
        "number_of_samples": options.evaluation_samples,
        "seed": options.seed,
    }
    return {name: value for name, value in settings.items() if value is not None}


def measure_errors(
    mesh_y: Mesh, maps: Mapping[str, Any], truth: GroundTruth, settings: Mapping[str, Any]
) -> dict[str, GeodesicError]:
    """Measure the geodesic error of each map.

    **Arguments:**

    - `maps`: a dictionary from names to maps X -> Y. A map is an array (m,) of 0-based vertices of Y, or one
      `SurfacePoints` with m points on Y.
    - `settings`: keyword arguments of `jaxsmw.geodesic_error`; see `evaluation_settings`.

    **Returns:** A dictionary from the name of each map to its geodesic errors.
    """
    from jaxsmw.evaluation.metrics import geodesic_error

    report_progress("geodesic errors ...")
    return {
        name: geodesic_error(mesh_y, pointwise_map, truth, **settings) for name, pointwise_map in maps.items()
    }
