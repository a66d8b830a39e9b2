"""The figures of the frame study."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from frame_study.measurement import DATA_SETS, INVARIANCE_FRAMES, PairName, Settings, read_pair, wavelets
from frame_study.summary import Study
from frame_study.variants import ABLATIONS, CONVENTIONS, UPDATES, Variant, frames
from jaxsmw import compute_spectrum
from jaxsmw.benchmark.journal import Row
from jaxsmw.core.functional_map import Convention
from jaxsmw.report.figures import draw_forest, draw_functions, draw_heat_maps, save_figure
from jaxsmw.report.rendering import camera_axes, choose_azimuth
from jaxsmw.report.standing import stand
from jaxsmw.report.summary import draw_bank


def draw_figures(output: Path, data: Path, study: Study, parameters: Sequence[Row]) -> None:
    """Write all figures of the study as PNG files."""
    for data_set in DATA_SETS:
        _draw_wavelets(output, data, study.pairs[data_set][0], study.settings)
    for convention in CONVENTIONS:
        _draw_differences(output / f"differences_{convention}.png", study, convention)
    _draw_parameters(output, parameters, study.settings)


def _draw_wavelets(output: Path, data: Path, pair: PairName, settings: Settings) -> None:
    """Draw the filters, and one wavelet of each scale around corresponding points of both bodies."""
    mesh_x, mesh_y, truth = read_pair(data, pair)
    meshes = mesh_x, mesh_y
    spectra = [compute_spectrum(mesh, settings.number_of_eigenvectors) for mesh in meshes]
    # The wavelets are centred at the point of the source nearest to the viewer, because this point is
    # visible.
    standing = [stand(mesh) for mesh in meshes]
    towards = camera_axes(choose_azimuth(standing))[2]
    row = np.argmax(standing[0].vertices[truth.source_vertices] @ towards)
    centers = truth.source_vertices[[row]], np.asarray(truth.targets)[[row]]
    scales = range(settings.number_of_filters)
    titles = ["scaling function", *(f"wavelet, scale {scale}" for scale in scales[1:])]
    banks = frames(settings.number_of_filters)
    for frame in INVARIANCE_FRAMES:
        functions = [
            np.concatenate([wavelets(banks[frame], spectrum, scale, center) for scale in scales])
            for spectrum, center in zip(spectra, centers, strict=True)
        ]
        figure = draw_functions(meshes, functions, titles=titles, marked=[int(c[0]) for c in centers])
        name = frame.lower().replace(" ", "_")
        save_figure(output / f"wavelets_{pair.data_set}_{name}.png", figure)
        if pair.data_set == DATA_SETS[0]:
            eigenvalues = np.asarray(spectra[0].eigenvalues)
            save_figure(output / f"filters_{name}.png", draw_bank(banks[frame], eigenvalues))


def _draw_differences(path: Path, study: Study, convention: Convention) -> None:
    """Draw the confidence interval of the difference from the default, for each frame and each ablation."""
    rows = {frame: {update: (frame, update) for update in UPDATES} for frame in study.settings.frames}
    rows |= {f"{frame}, {update}": {"filtering": (frame, update)} for frame, update in ABLATIONS}

    def intervals(data_set: str, update: str) -> Float64[np.ndarray, "rows 3"]:
        cells = [row.get(update) for row in rows.values()]
        variants = [cell and Variant(*cell, convention) for cell in cells]
        return np.array([study.interval(variant, data_set) for variant in variants])

    panels = {name: {update: intervals(name, update) for update in UPDATES} for name in DATA_SETS}
    figure = draw_forest(panels, rows=list(rows), xlabel="error minus the default's (x 10⁻³ √area)")
    save_figure(path, figure)


def _draw_parameters(output: Path, parameters: Sequence[Row], settings: Settings) -> None:
    """Draw two heat maps of the mean error.

    The first heat map shows the error against the numbers of eigenvectors and filters. The second heat map
    shows the error against the numbers of eigenvectors and iterations.
    """
    ks, filters = settings.parameter_eigenvectors, settings.parameter_filters
    iterations = range(1, settings.parameter_iterations + 1)
    errors = {}
    for data_set in DATA_SETS:
        rows = [row for row in parameters if row["data_set"] == data_set]
        errors[data_set] = np.zeros((len(ks), len(filters), len(iterations)))
        for (i, j), _ in np.ndenumerate(errors[data_set][:, :, 0]):
            cell = str(ks[i]), str(filters[j])
            of_cell = [row for row in rows if (row["eigenvectors"], row["filters"]) == cell]
            series = [[1e3 * float(row[f"error_{t}"]) for t in iterations] for row in of_cell]
            errors[data_set][i, j] = np.mean(series, axis=0)
    usual = filters.index(settings.number_of_filters)
    for name, columns, tables in (
        ("filters", filters, {data_set: e[:, :, -1] for data_set, e in errors.items()}),
        ("iterations", iterations, {data_set: e[:, usual, :] for data_set, e in errors.items()}),
    ):
        figure = draw_heat_maps(
            tables,
            rows=("eigenvectors k", ks),
            columns=(name, columns),
            label="mean error (x 10⁻³ √area)",
        )
        save_figure(output / f"parameters_{name}.png", figure)
