"""Everything about one match in one directory."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64

from jaxsmw.core.filters import FilterBank
from jaxsmw.core.refinement import WaveletPreservation
from jaxsmw.evaluation.metrics import LARGEST_THRESHOLD, GeodesicError
from jaxsmw.files import atomic_write, make_directory
from jaxsmw.matching import Correspondence
from jaxsmw.provenance import machine, versions
from jaxsmw.report.figures import (
    draw_correspondence,
    draw_filters,
    draw_functional_map,
    draw_quality_curves,
    save_figure,
)
from jaxsmw.report.page import write_page
from jaxsmw.report.rendering import Axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure


REPORT_FILES = (
    "report.html",
    "correspondence.png",
    "functional_map.png",
    "filters.png",
    "quality.png",
    "summary.json",
)
"""What `write_report` may write."""


def write_report(
    directory: str | os.PathLike[str],
    correspondence: Correspondence,
    *,
    errors: Mapping[str, GeodesicError] | None = None,
    settings: Mapping[str, Any] | None = None,
    up: Axis | None = None,
) -> None:
    """Write the pictures of a match, an interactive page and a summary to a directory.

    The error that is to be expected (`Correspondence.expected_error`) is among them, and if given the true
    one.

    **Arguments:**

    - `directory`: made if it is not there; it gets `report.html` (both bodies to turn, with the figures),
      `correspondence.png`, `functional_map.png`, `filters.png` (if a stage has any), `quality.png` (with
      errors only) and `summary.json`.
    - `correspondence`: the match.
    - `errors`: geodesic errors by name, the last of them that of `correspondence.pointwise_map`.
    - `settings`: what else to note in the summary.
    - `up`: the axis of the meshes that points up; see `jaxsmw.report.rendering.stand` for the default.

    **Raises:** `InputError` if the directory cannot be written to, or matplotlib is missing.
    """
    directory = make_directory(directory)
    errors = errors or {}
    final = list(errors.values())[-1] if errors else None
    expected = correspondence.expected_error()
    per_vertex = {"Expected error": expected}
    if final is not None:
        per_vertex = {"Error": _per_vertex(final, len(correspondence.pointwise_map)), **per_vertex}

    figures = {
        "correspondence": draw_correspondence(
            correspondence.mesh_x,
            correspondence.mesh_y,
            correspondence.pointwise_map,
            errors=per_vertex,
            up=up,
        ),
        "functional_map": draw_functional_map(
            correspondence.functional_map,
            convention=getattr(correspondence.stages[-1].refiner, "convention", "pullback"),
        ),
    }
    captions = {"functional_map": "The functional map C."}
    for stage in correspondence.stages:
        if isinstance(stage.refiner, WaveletPreservation):
            eigenvalues = np.asarray(correspondence.spectrum_x.eigenvalues)[: stage.number_of_eigenvectors]
            figures["filters"] = draw_bank(stage.refiner.bank, eigenvalues)
            captions["filters"] = "The filters over the eigenvalues of the source (area 1)."
    if errors:
        figures["quality"] = draw_errors(errors)
        captions["quality"] = "The share of vertices within a geodesic error."
    for name, figure in figures.items():
        save_figure(directory / f"{name}.png", figure)

    facts = summarize(correspondence, errors, expected)
    write_page(
        directory / "report.html",
        correspondence.mesh_x,
        correspondence.mesh_y,
        correspondence.pointwise_map,
        title=f"{Path(correspondence.mesh_x.name).name} to {Path(correspondence.mesh_y.name).name}",
        statistics=facts,
        errors=per_vertex,
        figures=[(caption, (directory / f"{name}.png").read_bytes()) for name, caption in captions.items()],
        up=up,
    )
    summary = {
        "settings": dict(settings or {}),
        "result": facts,
        "errors": {name: error.as_dictionary() for name, error in errors.items()},
        "provenance": provenance(),
    }
    with atomic_write(directory / "summary.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=2) + "\n", "utf-8")


def draw_bank(bank: FilterBank, eigenvalues: Float[np.ndarray, " k"]) -> Figure:
    """The filters of a bank over the eigenvalues of a shape, with their frame function."""
    spectrum = jnp.asarray(eigenvalues)
    grid = jnp.linspace(0, spectrum[-1], 1000)
    return draw_filters(np.asarray(grid), np.asarray(bank(grid, spectrum)), eigenvalues)


def draw_errors(errors: Mapping[str, GeodesicError]) -> Figure:
    """The correspondence quality curves of some maps, with their mean errors."""
    thresholds = np.linspace(0, LARGEST_THRESHOLD, 251)
    return draw_quality_curves(
        {
            name: (thresholds, error.correspondence_quality_curve(thresholds))
            for name, error in errors.items()
        },
        mean_errors={name: error.mean for name, error in errors.items()},
    )


def summarize(
    correspondence: Correspondence,
    errors: Mapping[str, GeodesicError],
    expected_error: Float[np.ndarray, " m"],
) -> dict[str, str]:
    """The facts of a match, labelled and ready to print."""
    facts = {
        "vertices": f"{len(correspondence.mesh_x.vertices)} to {len(correspondence.mesh_y.vertices)}",
        "functional map": "{} x {}".format(*correspondence.functional_map.shape),
        "iterations": str(correspondence.iterations),
    }
    for name, error in errors.items():
        facts[f"mean error, {name} map"] = f"{error.mean:.4f} √area"
        facts[f"within 0.05, {name} map"] = f"{error.within[0.05]:.1%}"
    facts["expected error, mean"] = f"{expected_error.mean():.4f} √area"
    return facts | {f"time, {stage}": f"{time:.2f} s" for stage, time in correspondence.seconds.items()}


def provenance() -> dict[str, str]:
    """What a figure depends on besides its input: versions and machine."""
    return {**versions(), "machine": machine(), "device": jax.devices()[0].device_kind}


def _per_vertex(error: GeodesicError, m: int) -> Float64[np.ndarray, " m"]:
    """The errors spread over the source's vertices, NaN where none is known, the mean where several are."""
    total = np.bincount(error.source_vertices, error.errors, minlength=m)
    count = np.bincount(error.source_vertices, minlength=m)
    return np.divide(total, count, out=np.full(m, np.nan), where=count > 0)
