"""The figures of the frame study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float64

from frame_study.measurement import DATA_SETS, INVARIANCE_FRAMES, PairName, Settings, read_pair, wavelets
from frame_study.summary import Study
from frame_study.variants import ABLATIONS, CONVENTIONS, UPDATES, Variant, frames
from jaxsmw import compute_spectrum
from jaxsmw.benchmark.journal import Row
from jaxsmw.core.functional_map import Convention
from jaxsmw.errors import InputError
from jaxsmw.report.figures import FAINT, INK, LINE_COLORS, draw_functions, new_figure, save_figure, style_axes
from jaxsmw.report.rendering import camera_axes, choose_azimuth
from jaxsmw.report.standing import stand
from jaxsmw.report.summary import draw_bank

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARKERS = ("o", "s", "D", "^", "v", "P", "X")


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


def draw_forest(
    panels: Mapping[str, Mapping[str, Float[np.ndarray, "rows 3"]]],
    *,
    rows: Sequence[str],
    xlabel: str,
    linear_up_to: float = 1.0,
) -> Figure:
    """Draw estimates with their intervals, and a vertical line at zero, in one or several panels.

    `panels[title][name]` is one series of a panel, (rows, 3): an estimate, and the lower and upper end of its
    interval, or NaN. All panels have the same series. The scale is linear up to `linear_up_to` and
    logarithmic elsewhere, so small and large estimates are both visible.

    **Raises:** `InputError` if a series does not have three numbers per row.
    """
    for title, series in panels.items():
        for name, intervals in series.items():
            if np.shape(intervals) != (len(rows), 3):
                raise InputError(
                    f"{title}, {name}: the array has shape {np.shape(intervals)}, but {len(rows)} rows need "
                    f"shape {(len(rows), 3)}."
                )
    names = list(dict.fromkeys(name for series in panels.values() for name in series))
    pitch = 0.075 * len(names) + 0.1
    figure = new_figure(2.6 + 3.3 * len(panels), 1.2 + pitch * len(rows), plot=True)
    from matplotlib.ticker import NullLocator, SymmetricalLogLocator

    grid = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    heights = np.arange(len(rows), dtype=float)
    for axes, (title, series) in zip(grid, panels.items(), strict=True):
        axes.set_xscale("symlog", linthresh=linear_up_to, linscale=1.0)
        for band in range(0, len(rows), 2):
            axes.axhspan(band - 0.5, band + 0.5, color="#f4f5f7", linewidth=0, zorder=0)
        axes.axvline(0, color=FAINT, linewidth=0.8, zorder=1)
        for index, name in enumerate(names):
            estimate, low, high = np.asarray(series[name], dtype=float).T
            color = LINE_COLORS[index % len(LINE_COLORS)]
            offset = 0.7 * ((index + 0.5) / len(names) - 0.5)
            axes.hlines(heights + offset, low, high, color=color, linewidth=1.1, zorder=2)
            axes.plot(
                estimate,
                heights + offset,
                linestyle="none",
                marker=MARKERS[index % len(MARKERS)],
                markersize=3.4,
                color=color,
                label=name,
                zorder=3,
            )
        axes.set_title(title, fontsize=9, color=INK)
        axes.set_xlabel(xlabel)
        axes.xaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=linear_up_to))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:+g}".replace("-", "−") if value else "0")
        style_axes(axes)
        axes.grid(axis="x", color="#e6e8ec", linewidth=0.6)
        axes.tick_params(axis="y", length=0)
    grid[0].set_yticks(heights, rows)
    grid[0].set_ylim(len(rows) - 0.5, -0.5)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=min(len(names), 4),
        frameon=False,
        fontsize=8,
        labelcolor=INK,
    )
    return figure


def draw_heat_maps(
    panels: Mapping[str, Float[np.ndarray, "rows columns"]],
    *,
    rows: tuple[str, Sequence[object]],
    columns: tuple[str, Sequence[object]],
    label: str,
) -> Figure:
    """Draw tables of positive numbers as heat maps with one logarithmic colour scale.

    `panels` maps the title of each table to its numbers. `rows` and `columns` contain the name of a
    parameter and its values. `label` is the label of the colour scale.

    **Raises:** `InputError` if a table does not fit the rows and columns, or if an entry is not positive.
    """
    shape = len(rows[1]), len(columns[1])
    for title, table in panels.items():
        if np.shape(table) != shape or not (np.isfinite(table).all() and np.min(table) > 0):
            raise InputError(
                f"{title}: the table must have shape {shape} and positive entries, but its shape is "
                f"{np.shape(table)} and its smallest entry is {np.min(table)}."
            )
    size = 1.2 + (0.6 + 0.42 * shape[1]) * len(panels), max(2.6, 1.1 + 0.3 * shape[0])
    figure = new_figure(*size, plot=True)
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    everything = np.concatenate([np.ravel(table) for table in panels.values()])
    norm = LogNorm(everything.min(), max(everything.max(), 1.01 * everything.min()))
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (title, table) in zip(grid, panels.items(), strict=True):
        image = axes.imshow(table, cmap="cividis", norm=norm, aspect="auto", interpolation="nearest")
        for (row, column), value in np.ndenumerate(np.asarray(table)):
            text = f"{value:.1f}" if value < 100 else f"{value:.0f}"
            color = INK if norm(value) > 0.55 else "white"
            axes.text(column, row, text, ha="center", va="center", fontsize=7, color=color)
        axes.set_title(title, fontsize=9, color=INK)
        axes.set_xlabel(columns[0])
        axes.set_xticks(range(shape[1]), [str(value) for value in columns[1]])
        style_axes(axes)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
    grid[0].set_ylabel(rows[0])
    grid[0].set_yticks(range(shape[0]), [str(value) for value in rows[1]])
    scale = figure.colorbar(image, ax=list(grid), pad=0.02)
    scale.set_label(label, fontsize=8, color=INK)
    scale.ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    scale.ax.yaxis.set_minor_locator(NullLocator())
    scale.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    scale.outline.set_visible(False)
    style_axes(scale.ax)
    return figure
