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
    from jaxtyping import Float

    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.io.landmarks import Landmarks
    from jaxsmw.matching.correspondence import Correspondence
    from jaxsmw.transfer.registered_mesh import RegisteredMesh


def measure_match(
    correspondence: Correspondence,
    truth: GroundTruth | None,
    settings: Mapping[str, Any],
    stopwatch: Stopwatch,
    others: Mapping[str, Any],
) -> dict[str, GeodesicError]:
    """Measure the geodesic errors of the maps of a match.

    **Arguments:**

    - `truth`: the ground truth, or None.
    - `settings`: keyword arguments of `jaxsmw.geodesic_error`; see `evaluation_settings`.
    - `stopwatch`: the stopwatch to which the time of the measurement is added.
    - `others`: further maps to measure, a dictionary with the names of the maps as keys. The initial map and
      the refined map are always measured.

    **Returns:** A dictionary from the name of each map to its errors. The names are `initial`, the names in
    `others`, and `refined`. The dictionary is empty if there is no ground truth.
    """
    if truth is None:
        return {}
    maps = {
        "initial": correspondence.initial_map,
        **others,
        "refined": correspondence.pointwise_map,
    }
    with stopwatch.step("geodesic errors"):
        return measure_errors(correspondence.mesh_y, maps, truth, settings)


def estimate_error(correspondence: Correspondence, stopwatch: Stopwatch) -> Float[np.ndarray, " m"]:
    """Return the expected error of each match (m,), as a fraction of sqrt(area of Y)."""
    report_progress("expected error ...")
    with stopwatch.step("expected error"):
        return correspondence.expected_error()


def show_quality(correspondence: Correspondence, expected_error: Float[np.ndarray, " m"] | None) -> None:
    """Print one line with the quality of a match. If nothing is known about the quality, print nothing.

    **Arguments:**

    - `expected_error`: the expected error of each match (m,), as a fraction of sqrt(area of Y);
      None if it was not computed.
    """
    parts = []
    if correspondence.distortion is not None:
        parts.append(f"distortion {correspondence.distortion:.3f} (1 for isometries)")
    if expected_error is not None:
        mean = correspondence.mesh_x.average(expected_error)
        parts.append(f"area-weighted mean expected error {1e3 * mean:.2f} x 10^-3 sqrt(area)")
        if (probability := correspondence.wrong_probability(expected_error)) is not None:
            from jaxsmw.wording import percentage

            parts.append(f"wrong on a part of the body with probability {percentage(probability)}")
    if correspondence.left_out:
        parts.append(f"{correspondence.left_out:.1%} of the source has no counterpart (small components)")
    if correspondence.suspicious:
        parts.append("the map is suspicious")
    if parts:
        show(f"quality:     {', '.join(parts)}")


def write_match_report(
    directory: str,
    correspondence: Correspondence,
    errors: Mapping[str, GeodesicError],
    expected_error: Float[np.ndarray, " m"],
    options: argparse.Namespace,
    stopwatch: Stopwatch,
    *,
    up: Any,
    registered: RegisteredMesh | None = None,
    landmarks: tuple[Landmarks, Landmarks] | None = None,
) -> None:
    """Write the report of a match to a directory. The report's summary contains the options of the command.

    **Arguments:**

    - `errors`: the dictionary that `measure_match` returns.
    - `expected_error`: the expected error of each match (m,), as a fraction of sqrt(area of Y).
    - `up`: the axis of the meshes that points up in pictures; None to guess the axis.
    - `registered`: the registered mesh if it was already computed; None otherwise.
    - `landmarks`: the landmarks on the source and on the target. The interactive page of the
      report shows these landmarks when it is opened.
    """
    from jaxsmw.report.summary import write_report

    report_progress("report ...")
    settings = {**vars(options), "preset": preset_name(options)}
    del settings["run"]
    with stopwatch.step("report"):
        written = write_report(
            directory,
            correspondence,
            errors=errors,
            expected_error=expected_error,
            settings=settings,
            seconds=stopwatch.steps(),
            up=up,
            registered=registered,
            landmarks=landmarks,
        )
    report_written(*written)


def show_match(
    correspondence: Correspondence,
    errors: Mapping[str, GeodesicError],
    expected_error: Float[np.ndarray, " m"] | None,
    stopwatch: Stopwatch,
) -> None:
    """Print the quality of a match, the errors of all maps and the times of all steps on standard output.

    `expected_error` is the expected error of each match (m,), as a fraction of sqrt(area of Y),
    or None if it was not computed.
    """
    show_quality(correspondence, expected_error)
    for name, error in errors.items():
        show(f"{name + ' map:':12} {error}")
    show(f"time:        {stopwatch.summary()} (compilation included)")
