"""Everything about one match in one directory."""

from __future__ import annotations

import io
import json
import logging
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from jaxsmw.core.banks import FilterBank
from jaxsmw.core.functional_map import Convention, encode
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.evaluation.metrics import LARGEST_THRESHOLD, GeodesicError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching import Correspondence
from jaxsmw.pair import Pair, paired_spectra
from jaxsmw.repair.settings import RepairSettings
from jaxsmw.report.figures import (
    draw_correspondence,
    draw_filters,
    draw_functional_map,
    draw_quality_curves,
    save_figure,
)
from jaxsmw.report.inputs import check_map
from jaxsmw.report.page import ShownMap, eigenvectors_on_page, write_page
from jaxsmw.report.rendering import Axis
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.files import atomic_write, make_directory
from jaxsmw.runtime.provenance import machine, versions

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


_QUALITY_CAPTION = "The share of vertices within a geodesic error."


def write_report(
    directory: str | os.PathLike[str],
    correspondence: Correspondence,
    *,
    errors: Mapping[str, GeodesicError] | None = None,
    settings: Mapping[str, Any] | None = None,
    up: Axis | None = None,
) -> list[Path]:
    """Write the pictures of a match, an interactive page and a summary to a directory.

    The error that is to be expected (`Correspondence.expected_error`) is among them, and if given the true
    one.

    **Arguments:**

    - `directory`: made if it is not there; it gets `report.html` (both bodies to turn, with the map and the
      one it started from, wavelets and figures), `correspondence.png`, `functional_map.png`, `filters.png`
      (if a stage has any), `quality.png` (with errors only) and `summary.json`.
    - `correspondence`: the match.
    - `errors`: geodesic errors by name, `initial` that of `correspondence.initial_map`, the last of them that
      of `correspondence.pointwise_map`.
    - `settings`: what else to note in the summary.
    - `up`: the axis of the meshes that points up; see `jaxsmw.report.rendering.stand` for the default.

    **Returns:** The files that were written.

    **Raises:** `InputError` if the directory cannot be written to, or matplotlib is missing.
    """
    directory = make_directory(directory)
    errors = errors or {}
    final = list(errors.values())[-1] if errors else None
    expected = correspondence.expected_error()
    m = len(correspondence.pointwise_map)
    per_vertex = {} if final is None else {"Error": _per_vertex(final, m)}
    per_vertex["Expected error"] = expected
    convention: Convention = getattr(correspondence.stages[-1].refiner, "convention", "pullback")

    figures = {
        "correspondence": draw_correspondence(
            correspondence.mesh_x,
            correspondence.mesh_y,
            correspondence.pointwise_map,
            errors=per_vertex,
            up=up,
        ),
        "functional_map": draw_functional_map(correspondence.functional_map, convention=convention),
    }
    captions = {}
    refiner = WaveletPreservation()
    for stage in correspondence.stages:
        if isinstance(stage.refiner, WaveletPreservation):
            refiner = stage.refiner
            eigenvalues = np.asarray(correspondence.spectrum_x.eigenvalues)[: stage.number_of_eigenvectors]
            figures["filters"] = draw_bank(stage.refiner.bank, eigenvalues)
            captions["filters"] = "The filters over the eigenvalues of the source (area 1)."
    if errors:
        figures["quality"] = draw_errors(errors)
        captions["quality"] = _QUALITY_CAPTION
    for name, figure in figures.items():
        save_figure(directory / f"{name}.png", figure)

    spectra = correspondence.spectrum_x, correspondence.spectrum_y
    start = ShownMap(
        correspondence.initial_map,
        {"Error": _per_vertex(errors["initial"], m)} if "initial" in errors else {},
        _encoded(correspondence.initial_map, *spectra, convention),
        convention,
        _main_figures(errors.get("initial")),
    )
    outcome = ShownMap(
        correspondence.pointwise_map,
        per_vertex,
        correspondence.functional_map,
        convention,
        _main_figures(final),
    )
    others = {name: error for name, error in list(errors.items())[:-1] if name != "initial"}
    write_page(
        directory / "report.html",
        correspondence.mesh_x,
        correspondence.mesh_y,
        {"refined": outcome, "initial": start},
        title=_title(correspondence.mesh_x, correspondence.mesh_y),
        spectra=spectra,
        refiner=refiner,
        statistics=summarize(correspondence, others, expected),
        figures=[(caption, (directory / f"{name}.png").read_bytes()) for name, caption in captions.items()],
        up=up,
    )
    facts = summarize(correspondence, errors, expected)
    summary = {
        "settings": dict(settings or {}),
        "result": facts,
        "flaw": correspondence.distortion,
        "suspicious": correspondence.suspicious,
        "errors": {name: error.as_dictionary() for name, error in errors.items()},
        "provenance": provenance(),
    }
    with atomic_write(directory / "summary.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    names = ("report.html", *(f"{name}.png" for name in figures), "summary.json")
    return [directory / name for name in names]


def write_comparison(
    path: str | os.PathLike[str],
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_maps: Mapping[str, Int[np.ndarray | Array, " m"]],
    *,
    errors: Mapping[str, GeodesicError] | None = None,
    partial: bool = False,
    up: Axis | None = None,
) -> None:
    """Write an interactive page with several maps of one pair, one shown at a time.

    It shows their functional maps and the wavelets of the paper's bank as well, unless the eigenvectors of
    the meshes cannot be computed, of which it warns.

    **Arguments:**

    - `path`: the HTML file.
    - `mesh_x`, `mesh_y`: source X (m vertices) and target Y (n vertices).
    - `pointwise_maps`: T: X -> Y (m,) by name, in this order.
    - `errors`: their geodesic errors by the same names; the page shows them in colours, states the main
      figures of all maps side by side, and has their correspondence quality curves.
    - `partial`: whether one mesh shows a part of the other; see `jaxsmw.match`.
    - `up`: the axis of the meshes that points up; see `jaxsmw.report.rendering.stand` for the default.

    **Raises:** `InputError` if the maps do not fit the meshes, or the file cannot be written; with errors if
    matplotlib is missing.
    """
    errors = errors or {}
    maps = {name: check_map(mesh_x, mesh_y, pointwise_map) for name, pointwise_map in pointwise_maps.items()}
    spectra = _spectra_on_page(mesh_x, mesh_y, partial)
    figures = []
    if errors:
        curves = io.BytesIO()
        draw_errors(errors).savefig(curves, format="png", metadata={})
        figures = [(_QUALITY_CAPTION, curves.getvalue())]
    shown = {
        name: ShownMap(
            pointwise_map,
            {"Error": _per_vertex(errors[name], len(pointwise_map))} if name in errors else {},
            _encoded(pointwise_map, *spectra) if spectra else None,
            statistics=_main_figures(errors.get(name)),
        )
        for name, pointwise_map in maps.items()
    }
    write_page(
        path,
        mesh_x,
        mesh_y,
        shown,
        title=_title(mesh_x, mesh_y),
        spectra=spectra,
        figures=figures,
        up=up,
    )


def _spectra_on_page(mesh_x: Mesh, mesh_y: Mesh, partial: bool) -> tuple[Spectrum, Spectrum] | None:
    fewest = min(int(mesh.used_vertices.sum()) for mesh in (mesh_x, mesh_y))
    number = min(eigenvectors_on_page(mesh_x, mesh_y), fewest // 2)
    if not number:
        return None
    logging.getLogger("jaxsmw").info("eigenbases ...")
    try:
        return paired_spectra(Pair(mesh_x, mesh_y, partial), number)
    except InputError as error:
        warnings.warn(f"the page does without wavelets: {error}", stacklevel=3)
        return None


def _encoded(
    pointwise_map: Int[np.ndarray, " m"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    convention: Convention = "pullback",
) -> Float[np.ndarray, "k_out k_in"]:
    """The functional map of a pointwise map, in the precision of the spectra."""
    with jax.enable_x64(spectrum_x.eigenvectors.dtype == np.float64):
        encoded = compiled(encode)(
            jax.device_put(pointwise_map), spectrum_x, spectrum_y, convention=convention
        )
        return np.asarray(encoded)


def _title(mesh_x: Mesh, mesh_y: Mesh) -> str:
    return f"{Path(mesh_x.name).name} to {Path(mesh_y.name).name}"


def _main_figures(error: GeodesicError | None) -> dict[str, str]:
    """What stands in a row of a table of maps."""
    if error is None:
        return {}
    shares = {f"within {threshold}": f"{share:.1%}" for threshold, share in error.within.items()}
    area = f"{error.area_under_curve():.3f}"
    mean, median = f"{error.mean:.4f}", f"{error.median:.4f}"
    return {"mean error (√area)": mean, "median (√area)": median, **shares, "area under curve": area}


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
    if correspondence.distortion is not None:
        doubt = (
            f"; above {RepairSettings().suspicious} limbs may be swapped" if correspondence.suspicious else ""
        )
        facts["flaw (1 is none)"] = f"{correspondence.distortion:.2f}{doubt}"
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
