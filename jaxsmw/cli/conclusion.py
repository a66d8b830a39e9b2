"""The end of a match: its errors, its report and its times."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxsmw.cli.console import Stopwatch, report_progress, show
from jaxsmw.cli.measurement import measure_errors
from jaxsmw.cli.method import preset_name
from jaxsmw.cli.outputs import report_written

if TYPE_CHECKING:
    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.matching import Correspondence


def measure_match(
    correspondence: Correspondence,
    truth: GroundTruth | None,
    settings: Mapping[str, Any],
    stopwatch: Stopwatch,
    others: Mapping[str, Any],
) -> dict[str, GeodesicError]:
    """Returns the errors of the initial, the other and the refined maps, by name; none without a truth."""
    if truth is None:
        return {}
    maps = {
        "initial": correspondence.initial_map,
        **others,
        "refined": correspondence.pointwise_map,
    }
    with stopwatch.step("geodesic errors"):
        return measure_errors(correspondence.mesh_y, maps, truth, settings)


def write_match_report(
    directory: str,
    correspondence: Correspondence,
    errors: Mapping[str, GeodesicError],
    options: argparse.Namespace,
    stopwatch: Stopwatch,
    *,
    up: Any,
) -> None:
    """Write the report of a match; its summary lists the options as settings."""
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
        )
    report_written(*written)


def show_match(errors: Mapping[str, GeodesicError], stopwatch: Stopwatch) -> None:
    """Print the errors and the times."""
    for name, error in errors.items():
        show(f"{name + ' map:':12} {error}")
    show(f"time:        {stopwatch.summary()} (compilation included)")
