"""The final steps of `match`, `transfer` and `demo`: errors, the report, and lines on quality and times."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxsmw.cli.console import Stopwatch, report_progress, show
from jaxsmw.cli.measurement import measure_errors
from jaxsmw.cli.method import preset_name
from jaxsmw.cli.outputs import report_written

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int64

    from jaxsmw.choices import Axis
    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.geometry.geodesics import SurfacePoints
    from jaxsmw.io.landmarks import Landmarks
    from jaxsmw.matching.correspondence import Correspondence
    from jaxsmw.transfer.registered_mesh import RegisteredMesh


def measure_match(
    correspondence: Correspondence,
    truth: GroundTruth | None,
    settings: Mapping[str, Any],
    stopwatch: Stopwatch,
    others: Mapping[str, Int64[np.ndarray, " m"] | SurfacePoints],
) -> dict[str, GeodesicError]:
    """Measure the geodesic errors of the initial map, `others` and the refined map, by their names.

    The result is empty if there is no ground truth.
    """
    if truth is None:
        return {}
    maps = {"initial": correspondence.initial_map, **others, "refined": correspondence.pointwise_map}
    with stopwatch.step("geodesic errors"):
        return measure_errors(correspondence.mesh_y, maps, truth, settings)


def estimate_error(correspondence: Correspondence, stopwatch: Stopwatch) -> Float[np.ndarray, " m"]:
    """Return the expected error of each match (m,), as a fraction of sqrt(area of Y).

    The correspondence keeps the result, so the time of the first call is the time of the step.
    """
    report_progress("expected error ...")
    with stopwatch.step("expected error"):
        return correspondence.expected_error()


def show_quality(correspondence: Correspondence) -> None:
    """Print one line with the quality of a match."""
    from jaxsmw.wording import percentage

    parts = []
    if correspondence.distortion is not None:
        parts.append(f"distortion {correspondence.distortion:.3f} (1 for isometries)")
    mean = correspondence.mesh_x.average(correspondence.expected_error())
    parts.append(f"area-weighted mean expected error {1e3 * mean:.2f} x 10^-3 sqrt(area)")
    if (probability := correspondence.wrong_probability()) is not None:
        parts.append(f"wrong on a part of the body with probability {percentage(probability)}")
    if correspondence.left_out:
        parts.append(f"{correspondence.left_out:.1%} of the source has no counterpart (small components)")
    if correspondence.suspicious:
        parts.append("the map is suspicious")
    show(f"quality:     {', '.join(parts)}")


def write_match_report(
    directory: str,
    correspondence: Correspondence,
    errors: Mapping[str, GeodesicError],
    options: argparse.Namespace,
    stopwatch: Stopwatch,
    *,
    up: Axis | None,
    registered: RegisteredMesh | None = None,
    landmarks: tuple[Landmarks, Landmarks] | None = None,
) -> None:
    """Write the report of a match to a directory; its summary contains the options of the command."""
    from jaxsmw.report.summary import write_report

    report_progress("report ...")
    settings = {**vars(options), "preset": preset_name(options)}
    del settings["run"]
    with stopwatch.step("report"):
        written = write_report(
            directory,
            correspondence,
            errors=errors,
            settings=settings,
            seconds=stopwatch.steps(),
            up=up,
            registered=registered,
            landmarks=landmarks,
        )
    report_written(*written)


def show_match(
    correspondence: Correspondence, errors: Mapping[str, GeodesicError], stopwatch: Stopwatch
) -> None:
    """Print the quality of a match, the errors of all maps and the times of all steps on standard output."""
    show_quality(correspondence)
    for name, error in errors.items():
        show(f"{name + ' map:':12} {error}")
    show(f"time:        {stopwatch.summary()} (compilation included)")
