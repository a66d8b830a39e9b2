"""Writes reports of one match, and pages that compare several maps of a pair."""

from __future__ import annotations

import io
import json
import logging
import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsmw.choices import Axis
from jaxsmw.core.arrays import Array
from jaxsmw.core.banks import FilterBank
from jaxsmw.core.banks.base import sample_bank
from jaxsmw.core.functional_map import Convention, encode
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.evaluation.metrics import LARGEST_THRESHOLD, GeodesicError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import check_pointwise_map
from jaxsmw.io.landmarks import Landmarks
from jaxsmw.matching.advice import verdict
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import paired_spectra
from jaxsmw.report.figures import (
    draw_correspondence,
    draw_filters,
    draw_functional_map,
    draw_quality_curves,
    save_figure,
)
from jaxsmw.report.page import EXPECTED_ERROR, ShownMap, write_page
from jaxsmw.report.page_data import eigenvectors_on_page
from jaxsmw.runtime.backends import device
from jaxsmw.runtime.files import atomic_write, make_directory
from jaxsmw.runtime.progress import timed
from jaxsmw.runtime.provenance import machine, versions
from jaxsmw.transfer.registered_mesh import RegisteredMesh
from jaxsmw.wording import percentage, short_names

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
"""The files that `write_report` may write."""

# The largest number of other maps on a page.
_MOST_SHOWN = 10
_QUALITY_CAPTION = (
    "The share of matches whose geodesic error is at most a threshold. Higher curves are better."
)
_FILTERS_CAPTION = (
    "The responses of all filters as functions of the eigenvalue. Ticks mark the eigenvalues of the source, "
    "scaled to area 1."
)
_ERROR_MEANINGS = {
    "Error": "The distance along the surface between each match and the true point on the target.",
    EXPECTED_ERROR: (
        "An estimate of the distance between each match and the true point on the target. The estimate does "
        "not use the true points."
    ),
}


def write_report(
    directory: str | os.PathLike[str],
    correspondence: Correspondence,
    *,
    errors: Mapping[str, GeodesicError] | None = None,
    settings: Mapping[str, Any] | None = None,
    seconds: Mapping[str, float] | None = None,
    up: Axis | None = None,
    registered: RegisteredMesh | None = None,
    landmarks: tuple[Landmarks, Landmarks] | None = None,
) -> list[Path]:
    """Write pictures of a match, an interactive page and a summary to a directory.

    The function writes `report.html`, an interactive page with both bodies, the map, the initial map and
    other maps that could be right. It also writes `correspondence.png`, `functional_map.png` and
    `summary.json`, `filters.png` if a stage has filters, and `quality.png` if errors are given. The report
    contains the expected error.

    **Arguments:**

    - `directory`: the directory of the report, which is created if it does not exist.
    - `correspondence`: the result of `match`, a `Correspondence`.
    - `errors`: a dictionary from the name of each map to its `GeodesicError`. The last entry must contain the
      errors of `correspondence.pointwise_map`. An entry named `initial` must contain the errors of
      `correspondence.initial_map`.
    - `settings`: a dictionary of settings to include in `summary.json`, serialisable as JSON.
    - `seconds`: a dictionary from the names of the completed steps to their wall times in seconds, by default
      `correspondence.seconds`. The steps must not overlap, because the report adds its own steps and prints
      the sum as the total time.
    - `up`: the axis of the mesh files that points up, such as `"y"` or `"-z"`; by default guessed from each
      mesh (`jaxsmw.report.standing.guess_up`).
    - `registered`: the `RegisteredMesh` that the page shows, by default the result of
      `Correspondence.registered_mesh`.
    - `landmarks`: a pair of `Landmarks`, on X and on Y, with which the page opens; see
      `jaxsmw.report.page.write_page`.

    **Returns:** A list of the paths of the files that were written.

    **Raises:** `InputError` if the directory cannot be written to, if `up` is not an axis, or if matplotlib
    is missing.
    """
    directory = make_directory(directory)
    errors = errors or {}
    steps = dict(correspondence.seconds if seconds is None else seconds)
    if not any("expected error" in step for step in steps):
        with timed("expected error", steps):
            correspondence.expected_error()
    shown = _shown_maps(correspondence, errors)
    overlap = correspondence.overlap() if correspondence.pair.partial else None
    with timed("pictures", steps):
        pictures, captions = _save_figures(
            directory, correspondence, shown["refined"].errors, errors, up, overlap
        )
    wavelets = _last_wavelets(correspondence)
    # The page's table of maps already shows the errors of the initial map and of the refined map.
    others = {name: error for name, error in list(errors.items())[:-1] if name != "initial"}
    write_page(
        directory / "report.html",
        correspondence.mesh_x,
        correspondence.mesh_y,
        shown,
        title=_title(correspondence.mesh_x, correspondence.mesh_y),
        notes=_notes(correspondence),
        spectra=(correspondence.spectrum_x, correspondence.spectrum_y),
        refiner=WaveletPreservation() if wavelets is None else wavelets[0],
        statistics=summarize(correspondence, others, steps),
        error_meanings=_ERROR_MEANINGS,
        figures=[(caption, path.read_bytes()) for path, caption in captions.items()],
        up=up,
        registered=(registered or correspondence.registered_mesh()).vertices,
        landmarks=landmarks,
        overlap=overlap,
    )
    summary = {
        "settings": dict(settings or {}),
        "result": summarize(correspondence, errors, steps),
        "backend": correspondence.backend,
        "partial": correspondence.pair.partial,
        "scale": correspondence.pair.scale,
        "overlap": None
        if overlap is None
        else [mesh.average(mask) for mesh, mask in zip(correspondence.pair.meshes, overlap, strict=True)],
        "distortion": correspondence.distortion,
        "suspicious": correspondence.suspicious,
        "wrong_probability": correspondence.wrong_probability(),
        "alternatives": [
            {"difference": other.difference, "probability": other.probability}
            for other in correspondence.alternatives
        ],
        "errors": {name: error.as_dictionary() for name, error in errors.items()},
        "seconds": {**steps, "total": sum(steps.values())},
        "provenance": provenance(),
    }
    with atomic_write(directory / "summary.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    return [directory / "report.html", *pictures, directory / "summary.json"]


def _notes(correspondence: Correspondence) -> list[str]:
    """Return what must be known before the bodies are compared."""
    notes = []
    if correspondence.suspicious:
        notes.append(f"Be careful: {verdict(correspondence)}")
    if correspondence.shared is not None:
        notes.append("Both shapes were matched to a full shape, the template, and through it to each other.")
    if correspondence.pair.partial:
        shares = [
            f"{mesh.average(mask):.0%}"
            for mesh, mask in zip(correspondence.pair.meshes, correspondence.overlap(), strict=True)
        ]
        notes.append(
            f"The overlap, which has a counterpart on the other shape, is predicted on {shares[0]} of the "
            f"source's area and on {shares[1]} of the target's area. The rest is grey."
        )
    if correspondence.mirrored:
        notes.append(
            "The source was matched as its mirror image, so colours that run from left to right on the "
            "target run from right to left on the source."
        )
    return notes


def _shown_maps(correspondence: Correspondence, errors: Mapping[str, GeodesicError]) -> dict[str, ShownMap]:
    """Return the refined map, the initial map and other maps that could be right, as the page shows them."""
    spectra = correspondence.spectrum_x, correspondence.spectrum_y
    convention = correspondence.preset.stages[-1].refiner.convention
    last = list(errors.values())[-1] if errors else None
    refined = _shown_map(correspondence.pointwise_map, correspondence.functional_map, last, convention)
    initial_map = correspondence.initial_map
    encoded = _encoded(initial_map, *spectra, convention)
    expected = {EXPECTED_ERROR: correspondence.expected_error()}
    others = {
        f"other {number}: {other.difference} (probability {percentage(other.probability)})": _shown_map(
            other.pointwise_map, _encoded(other.pointwise_map, *spectra, convention), None, convention
        )
        for number, other in enumerate(correspondence.alternatives[:_MOST_SHOWN], 1)
    }
    return {
        "refined": replace(refined, errors={**refined.errors, **expected}),
        "initial": _shown_map(initial_map, encoded, errors.get("initial"), convention),
        **others,
    }


def _shown_map(
    pointwise_map: Int[np.ndarray, " m"],
    functional_map: Float[np.ndarray | Array, "k_out k_in"] | None,
    error: GeodesicError | None,
    convention: Convention = "pullback",
) -> ShownMap:
    """Return a map for a page with its functional map, and perhaps with its errors and their statistics."""
    if error is None:
        return ShownMap(pointwise_map, {}, functional_map, convention)
    m = len(pointwise_map)
    total = np.bincount(error.source_vertices, error.errors, minlength=m)
    count = np.bincount(error.source_vertices, minlength=m)
    mean = np.divide(total, count, out=np.full(m, np.nan), where=count > 0)
    shares = {f"error at most {threshold}": f"{share:.1%}" for threshold, share in error.within.items()}
    statistics = {
        "mean error (√area)": f"{error.mean:.4f}",
        "median error (√area)": f"{error.median:.4f}",
        **shares,
        "area under curve": f"{error.area_under_curve():.3f}",
    }
    return ShownMap(pointwise_map, {"Error": mean}, functional_map, convention, statistics)


def _save_figures(
    directory: Path,
    correspondence: Correspondence,
    per_vertex: Mapping[str, Float[np.ndarray | Array, " m"]],
    errors: Mapping[str, GeodesicError],
    up: Axis | None,
    overlap: tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]] | None,
) -> tuple[list[Path], dict[Path, str]]:
    """Write all figures. Return their files, and the captions of the files that are also on the page."""
    mesh_x, mesh_y = correspondence.mesh_x, correspondence.mesh_y
    convention = correspondence.preset.stages[-1].refiner.convention
    figures = {
        "correspondence": draw_correspondence(
            mesh_x, mesh_y, correspondence.pointwise_map, errors=per_vertex, up=up, overlap=overlap
        ),
        "functional_map": draw_functional_map(correspondence.functional_map, convention=convention),
    }
    captions = {}
    if (wavelets := _last_wavelets(correspondence)) is not None:
        refiner, k = wavelets
        figures["filters"] = draw_bank(refiner.bank, np.asarray(correspondence.spectrum_x.eigenvalues)[:k])
        captions["filters"] = _FILTERS_CAPTION
    if errors:
        figures["quality"] = draw_errors(errors)
        captions["quality"] = _QUALITY_CAPTION
    files = {name: directory / f"{name}.png" for name in figures}
    for name, figure in figures.items():
        save_figure(files[name], figure)
    return list(files.values()), {files[name]: caption for name, caption in captions.items()}


def _last_wavelets(correspondence: Correspondence) -> tuple[WaveletPreservation, int] | None:
    """Return the refiner and the number of eigenvectors of the last stage that preserves wavelets, if any."""
    for stage in reversed(correspondence.preset.stages):
        if isinstance(stage.refiner, WaveletPreservation):
            return stage.refiner, stage.number_of_eigenvectors
    return None


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
    """Write an interactive page with several maps of one pair. The page shows one map at a time.

    The page also shows the functional maps, and the wavelets of the MWP paper's filter bank. If the
    eigenvectors of the meshes cannot be computed, the function issues a warning, and the page shows no
    functional maps and no wavelets.

    **Arguments:**

    - `path`: the HTML file.
    - `mesh_x`, `mesh_y`: source X (m vertices) and target Y (n vertices).
    - `pointwise_maps`: a dictionary from the name of each map to the map T: X -> Y (m,), in the order of the
      page.
    - `errors`: a dictionary from the same names to the `GeodesicError` of each map. The page shows them as
      colours, as correspondence quality curves, and in a table of statistics.
    - `partial`: whether one mesh is a partial shape and the other mesh the full shape, in the same unit of
      length.
    - `up`: the axis of the mesh files that points up, as in `write_report`.

    **Raises:** `InputError` if the maps do not fit the meshes, if the file cannot be written, if `up` is not
    an axis, or if errors are given and matplotlib is missing.
    """
    errors = errors or {}
    maps = {name: check_pointwise_map(targets, mesh_x, mesh_y) for name, targets in pointwise_maps.items()}
    spectra = _spectra_on_page(mesh_x, mesh_y, partial)
    figures = []
    if errors:
        curves = io.BytesIO()
        draw_errors(errors).savefig(curves, format="png", metadata={})
        figures = [(_QUALITY_CAPTION, curves.getvalue())]
    shown = {
        name: _shown_map(targets, _encoded(targets, *spectra) if spectra else None, errors.get(name))
        for name, targets in maps.items()
    }
    write_page(
        path,
        mesh_x,
        mesh_y,
        shown,
        title=_title(mesh_x, mesh_y),
        spectra=spectra,
        error_meanings=_ERROR_MEANINGS,
        figures=figures,
        up=up,
    )


def _spectra_on_page(mesh_x: Mesh, mesh_y: Mesh, partial: bool) -> tuple[Spectrum, Spectrum] | None:
    """Return the spectra for a page, or None if the meshes are too large or, with a warning, unsuitable."""
    pair, room = Pair(mesh_x, mesh_y, partial), eigenvectors_on_page(mesh_x, mesh_y)
    if not room:
        return None
    logging.getLogger("jaxsmw").info("eigenbases ...")
    try:
        return paired_spectra(pair, min(room, pair.fewest_vertices() // 2))
    except InputError as error:
        warnings.warn(f"the page has no wavelets: {error}", stacklevel=3)
        return None


def _encoded(
    pointwise_map: Int[np.ndarray, " m"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    convention: Convention = "pullback",
) -> Float[np.ndarray, "k_out k_in"]:
    """Compute the functional map of a pointwise map, with the float type of the spectra."""
    return np.asarray(encode(pointwise_map, spectrum_x, spectrum_y, convention=convention))


def _title(mesh_x: Mesh, mesh_y: Mesh) -> str:
    return " to ".join(short_names([mesh_x.name, mesh_y.name]))


def draw_bank(bank: FilterBank, eigenvalues: Float[np.ndarray, " k"]) -> Figure:
    """Draw the filters of a bank and their frame function, as functions of the eigenvalue.

    The figure marks the ascending eigenvalues of a shape (k,), and ends at the last eigenvalue.
    """
    grid = np.linspace(0, eigenvalues[-1], 1000, dtype=eigenvalues.dtype)
    return draw_filters(grid, sample_bank(bank, grid, eigenvalues), eigenvalues)


def draw_errors(errors: Mapping[str, GeodesicError]) -> Figure:
    """Draw the correspondence quality curves of maps by their names, with mean errors in the legend."""
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
    seconds: Mapping[str, float] | None = None,
) -> dict[str, str]:
    """Describe the sizes, errors and times of a match as text, by labels in the order of display.

    `errors` and `seconds` are those of `write_report`.
    """
    facts = {
        "probability of a wrong map": percentage(correspondence.wrong_probability()),
        "vertices": f"{len(correspondence.mesh_x.vertices)} to {len(correspondence.mesh_y.vertices)}",
        "functional map": "{} x {}".format(*correspondence.functional_map.shape),
        "iterations": str(correspondence.iterations),
        "refined by": {"numpy": "NumPy", "jax": "JAX"}[correspondence.backend],
    }
    if correspondence.mirrored:
        facts["source mirrored"] = "yes"
    if correspondence.pair.partial:
        facts["matched as partial shapes"] = "yes"
        facts["source lengths multiplied by"] = f"{correspondence.pair.scale:.4g}"
    for name, error in errors.items():
        facts[f"mean error, {name} map"] = f"{error.mean:.4f} √area"
        facts[f"error at most 0.05, {name} map"] = f"{error.within[0.05]:.1%}"
    facts["distortion (1 is none)"] = f"{correspondence.distortion:.2f}"
    expected = correspondence.mesh_x.average(correspondence.expected_error())
    facts["expected error, mean"] = f"{expected:.4f} √area"
    if correspondence.left_out:
        facts["small components without counterpart"] = f"{correspondence.left_out:.1%} of the source's area"
    steps = correspondence.seconds if seconds is None else seconds
    times = {**steps, "total": sum(steps.values())}
    return facts | {f"time, {step}": f"{time:.2f} s" for step, time in times.items()}


def provenance() -> dict[str, str]:
    """Return a dictionary of the facts on which results depend: package versions, machine and device.

    The device is the processor, unless JAX has an accelerator.
    """
    return {**versions(), "machine": machine(), "device": device()}
