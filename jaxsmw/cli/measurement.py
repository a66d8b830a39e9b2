"""Measures the geodesic errors of maps and the quality of matches, and defines the options for this."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias, get_args

from jaxsmw.choices import GeodesicMethod
from jaxsmw.cli.arguments import path, refuse_without, whole_number
from jaxsmw.cli.console import Stopwatch, report_progress, show
from jaxsmw.wording import MOST_LISTED, percentage

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int64

    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.geometry.mesh import Mesh
    from jaxsmw.geometry.surface_points import SurfacePoints
    from jaxsmw.matching.correspondence import Correspondence

    Maps: TypeAlias = Mapping[str, Int64[np.ndarray, " m"] | SurfacePoints]


def add_ground_truth(parser: argparse.ArgumentParser, *, required: bool, purpose: str) -> None:
    """Add `--ground-truth`. The help text begins with `purpose`, before the list of accepted files."""
    parser.add_argument(
        "--ground-truth",
        metavar="FILE",
        type=path,
        nargs="+",
        required=required,
        help=f"{purpose}: a file with one target vertex per line, a file with a source and a target vertex "
        "per line, a .baryc_gt file, or two .vts files (source first). Two other files are read like .vts "
        "files: line i of both contains the vertices of the same point. For two partial shapes, one .vts or "
        ".map file with -1 for source vertices without a counterpart",
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
    """Refuse options of `add_evaluation` that have no effect because another option is missing."""
    measured = bool(options.ground_truth)
    refuse_without(options, "--ground-truth", measured, "evaluation_samples", "geodesics")
    refuse_without(options, "--evaluation-samples", bool(options.evaluation_samples), "seed")


def measure_errors(
    options: argparse.Namespace, mesh_y: Mesh, maps: Maps, truth: GroundTruth
) -> dict[str, GeodesicError]:
    """Measure the geodesic errors of maps X -> Y, by their names, with the options of `add_evaluation`."""
    from jaxsmw.evaluation.metrics import geodesic_error

    report_progress("geodesic errors ...")
    default, *_ = get_args(GeodesicMethod)
    return {
        name: geodesic_error(
            mesh_y,
            pointwise_map,
            truth,
            method=options.geodesics or default,
            number_of_samples=options.evaluation_samples,
            seed=options.seed or 0,
        )
        for name, pointwise_map in maps.items()
    }


def estimate_error(correspondence: Correspondence, stopwatch: Stopwatch) -> Float[np.ndarray, " m"]:
    """Return the expected error of each match (m,), as a fraction of sqrt(area of Y).

    The correspondence keeps the result, so the time of the first call is the time of the step.
    """
    with stopwatch.step("expected error", announced=True):
        return correspondence.expected_error()


def show_quality(correspondence: Correspondence) -> None:
    """Print one line with the quality of a match."""
    parts = [
        f"distortion {correspondence.distortion:.3f} (1 for isometries)",
        _expected(correspondence),
        f"wrong as a whole with probability {percentage(correspondence.wrong_probability())}",
    ]
    if correspondence.left_out:
        parts.append(f"{correspondence.left_out:.1%} of the source has no counterpart (small components)")
    show(f"quality:     {', '.join(parts)}")
    others = correspondence.alternatives
    for number, other in enumerate(others[:MOST_LISTED], 1):
        name = "other maps:" if number == 1 else ""
        show(
            f"{name:12} {number}. {other.difference}, right with probability {percentage(other.probability)}"
        )
    if others:
        if len(others) > MOST_LISTED:
            show(f"{'':12} and {len(others) - MOST_LISTED} more")
        show(f"{'':12} no map is right with probability {percentage(correspondence.none_probability())}")


def _expected(correspondence: Correspondence) -> str:
    """Return the mean expected error as text. Of partial shapes, it is that of the predicted overlap."""
    errors, weights = correspondence.expected_error(), correspondence.mesh_x.vertex_areas
    where = ""
    if correspondence.pair.partial:
        weights, where = weights * correspondence.overlap()[0], " in the predicted overlap"
    if not weights.sum():
        return "no predicted overlap"
    mean = errors @ weights / weights.sum()
    return f"area-weighted mean expected error{where} {1e3 * mean:.2f} x 10^-3 sqrt(area)"


def show_match(
    correspondence: Correspondence, errors: Mapping[str, GeodesicError], stopwatch: Stopwatch
) -> None:
    """Print the quality of a match, the errors of all maps and the times of all steps on standard output."""
    show_quality(correspondence)
    for name, error in errors.items():
        show(f"{name + ' map:':12} {error}")
    show(f"time:        {stopwatch.summary()}")
