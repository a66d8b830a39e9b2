"""Figures for papers and talks, drawn by matplotlib without a display.

The functions need the extra `jaxsmw[report]`, and raise an `InputError` if matplotlib is missing. They return
each figure as a `matplotlib.figure.Figure`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from jaxsmw.choices import Axis
from jaxsmw.core.arrays import Array
from jaxsmw.core.functional_map import Convention
from jaxsmw.errors import InputError, check_number, check_suffix
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import check_pointwise_map
from jaxsmw.report.colors import ERROR_LIMIT, PLAIN, error_colors, position_colors
from jaxsmw.report.inputs import check_errors, check_functional_map
from jaxsmw.report.rendering import camera_axes, choose_azimuth, render
from jaxsmw.report.standing import stand, stand_pair, visible
from jaxsmw.runtime.files import atomic_write, check_writable
from jaxsmw.wording import printable, short_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The resolution in pixels per inch. Bodies are rendered at exactly this resolution.
_DPI = 200
# The largest height and width of a body, in pixels.
_BODY_SIZE = (800, 800)
_LONGEST_NAME = 36
# `_LEGEND_LINE` is the height of one line of a legend, in inches. `_SCALE_WIDTH` is the width of the margin
# for the error scale, in pixels.
_LEGEND_LINE, _SCALE_WIDTH = 0.24, 190

INK, FAINT = "#1d2430", "#79818c"
"""The colours of text and of lines."""

LINE_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, which colour-blind readers can tell apart."""

# The lines also differ in style, because colours are lost in black-and-white prints.
_LINE_STYLES = ("solid", (0, (6, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (10, 2, 3, 2)))


def draw_correspondence(
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int[np.ndarray | Array, " m"],
    *,
    errors: Mapping[str, Float[np.ndarray | Array, " m"]] = MappingProxyType({}),
    error_limit: float = ERROR_LIMIT,
    up: Axis | None = None,
    azimuth: float | None = None,
    overlap: tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]] | None = None,
) -> Figure:
    """Draw a map by colours: each vertex of X has the colour of its match on Y.

    The colour of each vertex of Y depends on its position on the body. Both bodies are shown from the same
    direction. Each body is scaled to area 1, unless the ratio of the areas suggests a partial shape; see
    `jaxsmw.report.standing.stand_pair`. If the map is good, the colours of X are as smooth as the colours of
    Y, and corresponding limbs have the same colours.

    **Arguments:**

    - `mesh_x`, `mesh_y`: source (m vertices) and target (n vertices), each a `Mesh` in any unit of length.
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `errors`: a dictionary from the name of each kind of error to an array (m,), as in
      `jaxsmw.report.page.ShownMap`. For each array, a panel shows the errors as colours on X.
    - `error_limit`: the error at which the colour scale ends, as a fraction of sqrt(area of Y). The colours
      of two figures are comparable if their limits are equal.
    - `up`: the axis of the mesh files that points up, such as `"y"` or `"-z"`; by default guessed from each
      mesh (`jaxsmw.report.standing.guess_up`).
    - `azimuth`: the direction from which the bodies are seen, in degrees from the front of the body towards
      its left; by default chosen for the bodies (`jaxsmw.report.rendering.choose_azimuth`).
    - `overlap`: masks of X (m,) and of Y (n,), False for vertices without a counterpart, which are grey. By
      default, all vertices have colours.

    **Raises:** `InputError` if the map or the errors do not fit the meshes, if the limit is not positive, or
    if `up` is not an axis.
    """
    indices = check_pointwise_map(pointwise_map, mesh_x, mesh_y)
    shown_x, shown_y = stand_pair(mesh_x, mesh_y, up, indices)
    colors_y = position_colors(shown_y)
    colors = [colors_y[indices], colors_y]
    if overlap is not None:
        colors = [np.where(mask[:, None], of, PLAIN) for mask, of in zip(overlap, colors, strict=True)]
    panels = [_Panel("Source", shown_x, colors[0]), _Panel("Target", shown_y, colors[1])]
    if not errors:
        return _draw_panels(panels, azimuth)
    check_number("error_limit", error_limit, positive=True)
    checked = check_errors(mesh_x, errors)
    for name, values in checked.items():
        panels.append(_Panel(f"{name} on the source", shown_x, error_colors(values, error_limit)))
    figure = _draw_panels(panels, azimuth, right_margin=_SCALE_WIDTH)
    _draw_scale(figure, error_limit, "error (fraction of √area)")
    if any(np.isnan(values).any() for values in checked.values()):
        _draw_unknown(figure)
    return figure


def draw_values(
    mesh: Mesh, values: Mapping[str, Float64[np.ndarray, " n"]], unit: str, *, up: Axis | None = None
) -> Figure:
    """Draw non-negative values at the n vertices of a mesh as colours, in one panel for each name.

    The scale ends at the largest of the 98th percentiles. The label of the scale is `unit`. `up` is the axis
    that points up, as in `draw_correspondence`.
    """
    limit = max(float(np.quantile(of_panel, 0.98)) for of_panel in values.values())
    limit = float(f"{limit:.1g}") or 1.0
    shown = stand(mesh, up)
    panels = [_Panel(name, shown, error_colors(of_panel, limit)) for name, of_panel in values.items()]
    figure = _draw_panels(panels, None, right_margin=_SCALE_WIDTH)
    _draw_scale(figure, limit, unit)
    return figure


def draw_mesh(
    mesh: Mesh,
    colors: Float64[np.ndarray, "n 3"] | None = None,
    *,
    up: Axis | None = None,
    azimuth: float | None = None,
) -> Figure:
    """Draw one shaded mesh, a `Mesh` with n vertices in any unit of length.

    **Arguments:**

    - `colors`: one sRGB colour in [0, 1] per vertex (n, 3); by default, the mesh is grey.
    - `up`, `azimuth`: the axis that points up and the direction of view, as in `draw_correspondence`.

    **Raises:** `InputError` if the colours do not fit the mesh, or if `up` is not an axis.
    """
    n = len(mesh.vertices)
    if colors is None:
        colors = np.tile(PLAIN, (n, 1))
    elif np.shape(colors) != (n, 3) or not (np.min(colors) >= 0 and np.max(colors) <= 1):
        raise InputError(
            f"the colours of {mesh.name} must be {n} rows of red, green and blue between 0 and 1, but have "
            f"shape {np.shape(colors)} and values from {np.min(colors)} to {np.max(colors)}."
        )
    return _draw_panels([_Panel("", stand(mesh, up), np.asarray(colors, dtype=float))], azimuth)


def draw_functional_map(
    functional_map: Float[np.ndarray | Array, "k_out k_in"], *, convention: Convention = "pullback"
) -> Figure:
    """Draw a functional map C. Positive entries are red, and negative entries are blue.

    C has the shape (k_X, k_Y) in the convention `"pullback"` and (k_Y, k_X) in the convention
    `"pushforward"`, which determines the axis labels.

    **Raises:** `InputError` if C is not a matrix of finite numbers.
    """
    matrix = check_functional_map(functional_map)
    figure = new_figure(5.0, 4.3, plot=True)
    axes = figure.add_subplot()
    limit = np.abs(matrix).max() or 1.0
    image = axes.imshow(matrix, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
    rows, columns = ("X (source)", "Y (target)")
    if convention == "pushforward":
        rows, columns = columns, rows
    axes.set_ylabel(f"eigenfunction of {rows}")
    axes.set_xlabel(f"eigenfunction of {columns}")
    axes.xaxis.set_label_position("top")
    axes.xaxis.tick_top()
    scale = figure.colorbar(image, ax=axes, shrink=0.9)
    scale.outline.set_visible(False)
    style_axes(axes)
    style_axes(scale.ax)
    return figure


def draw_filters(
    eigenvalue_grid: Float[np.ndarray | Array, " p"],
    responses: Float[np.ndarray | Array, "filters p"],
    eigenvalues: Float[np.ndarray | Array, " k"],
) -> Figure:
    """Draw filter responses g_l(lambda), with the frame function G and the eigenvalues of a shape.

    **Arguments:**

    - `eigenvalue_grid`: the ascending values of lambda at which the responses are given (p,).
    - `responses`: the responses (filters, p), first of the scaling function, then of the wavelets, from the
      coarsest to the finest.
    - `eigenvalues`: the eigenvalues of a shape (k,), which the figure marks on the horizontal axis.

    **Raises:** `InputError` if the responses do not fit the grid.
    """
    grid, curves = np.asarray(eigenvalue_grid, dtype=float), np.asarray(responses, dtype=float)
    if grid.ndim != 1 or curves.ndim != 2 or curves.shape[1:] != grid.shape:
        raise InputError(
            f"filter responses have shape {curves.shape}, but must have shape (filters, p) for a grid of p "
            f"values; the grid has shape {grid.shape}."
        )
    figure = new_figure(6.4, 3.4, plot=True)
    import matplotlib

    axes = figure.add_subplot()
    colors = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(curves)))
    for index, (curve, color) in enumerate(zip(curves, colors, strict=True)):
        name = "wavelet" if index else "scaling function"
        axes.plot(grid, curve, color=color, linewidth=1.8, label=rf"$g_{{{index}}}$ {name}")
    axes.plot(
        grid,
        np.sum(curves**2, axis=0),
        color=INK,
        linewidth=1.2,
        linestyle=(0, (5, 2)),
        label=r"$G=\sum g_l^2$",
    )
    axes.plot(
        np.asarray(eigenvalues),
        np.zeros(np.size(eigenvalues)),
        linestyle="none",
        marker=2,  # a vertical tick below the point
        markersize=4,
        markeredgewidth=0.5,
        color=FAINT,
        clip_on=False,
        label="eigenvalues",
    )
    axes.set_xlim(grid[0], grid[-1])
    axes.set_ylim(bottom=min(0.0, curves.min()))
    axes.set_xlabel("eigenvalue λ")
    axes.set_ylabel("response")
    figure.legend(loc="outside right center", frameon=False, fontsize=8, labelcolor=INK)
    style_axes(axes, grid=True)
    return figure


def draw_quality_curves(
    curves: Mapping[str, tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]],
    *,
    mean_errors: Mapping[str, float] = MappingProxyType({}),
) -> Figure:
    """Draw correspondence quality curves: the shares of matches with at most a given error.

    **Arguments:**

    - `curves`: a dictionary from the name of each map to a pair of arrays: ascending thresholds (p,), as
      fractions of sqrt(area of Y), and shares (p,) in [0, 1].
    - `mean_errors`: a dictionary from the names of some maps to their mean errors, as fractions of sqrt(area
      of Y), for the legend.

    **Raises:** `InputError` if there is no curve, or if the arguments do not fit together.
    """
    if not curves:
        raise InputError("there is no quality curve to draw; give at least one curve.")
    if unknown := mean_errors.keys() - curves.keys():
        raise InputError(
            f"there are mean errors but no quality curves for {', '.join(sorted(unknown))}; give these "
            "curves, or leave out their mean errors."
        )
    figure = new_figure(6.8, max(3.8, 0.6 + _LEGEND_LINE * len(curves)), plot=True)
    axes = figure.add_subplot()
    lines, labels = [], []
    for index, (name, (thresholds, shares)) in enumerate(curves.items()):
        if np.ndim(thresholds) != 1 or np.shape(thresholds) != np.shape(shares):
            raise InputError(
                f"the quality curve {name!r} must have as many shares as thresholds, but has shapes "
                f"{np.shape(shares)} and {np.shape(thresholds)}."
            )
        lines += axes.plot(
            thresholds,
            100 * np.asarray(shares),
            color=LINE_COLORS[index % len(LINE_COLORS)],
            linestyle=_LINE_STYLES[index % len(_LINE_STYLES)],
            linewidth=2,
        )
        labels.append(f"{name}: {mean_errors[name]:.4f}" if name in mean_errors else name)
    axes.set_xlim(min(t[0] for t, _ in curves.values()), max(t[-1] for t, _ in curves.values()))
    axes.set_ylim(0, 101)
    axes.set_xlabel("geodesic error (fraction of √area)")
    axes.set_ylabel("matches with at most this error (%)")
    legend = figure.legend(
        lines,
        labels,
        title="mean error" if mean_errors else None,
        title_fontsize=8,
        loc="outside right center",
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        labelspacing=0.8,
        handlelength=3.5,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
    style_axes(axes, grid=True)
    return figure


def draw_intervals(intervals: Mapping[str, tuple[float, float, float]], label: str) -> Figure:
    """Draw estimates with their intervals, one per row, and a vertical line at zero.

    The scale is linear if nothing is above 10. Otherwise, it is linear up to 1 and logarithmic elsewhere, so
    that small and large estimates are both visible.

    **Arguments:**

    - `intervals`: by the name of the row, an estimate and the lower and upper end of its interval, or NaN.
    - `label`: the label of the horizontal axis.

    **Raises:** `InputError` if there are no rows.
    """
    if not intervals:
        raise InputError("there is nothing to draw: give at least one interval.")
    figure = new_figure(6.5, 1.0 + 0.2 * len(intervals), plot=True)
    from matplotlib.ticker import MaxNLocator, NullLocator, SymmetricalLogLocator

    axes = figure.subplots()
    heights = np.arange(len(intervals), dtype=float)
    estimates, lows, highs = np.array(list(intervals.values()), dtype=float).T
    wide = np.any(np.abs([estimates, lows, highs]) > 10)
    if wide:
        axes.set_xscale("symlog", linthresh=1.0, linscale=1.0)
    axes.axvline(0, color=FAINT, linewidth=0.8)
    axes.hlines(heights, lows, highs, color=LINE_COLORS[0], linewidth=1.4)
    axes.plot(estimates, heights, linestyle="none", marker="o", markersize=3.6, color=LINE_COLORS[0])
    axes.set_yticks(heights, list(intervals))
    axes.set_ylim(len(intervals) - 0.5, -0.5)
    axes.set_xlabel(label)
    axes.xaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=1.0) if wide else MaxNLocator(8))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:+g}".replace("-", "−") if value else "0")
    style_axes(axes)
    axes.grid(axis="x", color="#e6e8ec", linewidth=0.6)
    axes.tick_params(axis="y", length=0)
    return figure


def draw_functions(
    meshes: Sequence[Mesh],
    functions: Sequence[Float[np.ndarray | Array, "functions n"]],
    *,
    titles: Sequence[str],
    marked: Sequence[int],
    up: Axis | None = None,
    azimuth: float | None = None,
) -> Figure:
    """Draw functions on bodies, with one row per body and one column per function.

    Positive values are red, and negative values are blue. All bodies in a column have the same colour scale.
    The scale ends at the 99.5th percentile of the absolute values in the column.

    **Arguments:**

    - `meshes`: the bodies, which may have different numbers of vertices n.
    - `functions`: for each body, an array (functions, n) with the values of all functions at its vertices.
    - `titles`: the titles of the columns, one per function.
    - `marked`: for each body, the 0-based vertex that the figure marks by a ring.
    - `up`, `azimuth`: the axis that points up and the direction of view, as in `draw_correspondence`.

    **Raises:** `InputError` if the functions do not fit the meshes or the titles, or if `up` is not an axis.
    """
    for mesh, values in zip(meshes, functions, strict=True):
        if np.shape(values) != (len(titles), len(mesh.vertices)):
            raise InputError(
                f"{mesh.name}: the functions have shape {np.shape(values)}, but must have shape "
                f"{(len(titles), len(mesh.vertices))}: one row per title and one column per vertex."
            )
    standing = [stand(mesh, up) for mesh in meshes]
    angle, scale, sizes = _layout(standing, azimuth, (280, 420))
    axes = camera_axes(angle)[:2]
    cell_width, heights = max(width for width, _ in sizes), [height for _, height in sizes]
    gap, header = 24, 60
    width = len(titles) * (cell_width + gap) + gap
    height = header + sum(heights) + gap * len(meshes)
    figure = new_figure(width / _DPI, height / _DPI)
    import matplotlib

    colormap = matplotlib.colormaps["RdBu_r"]
    for column, title in enumerate(titles):
        left = gap + column * (cell_width + gap)
        center = (left + cell_width / 2) / width
        figure.text(center, 1 - gap / height, title, ha="center", va="top", fontsize=8, color=INK)
        columns = [np.asarray(of_mesh[column], dtype=float) for of_mesh in functions]
        limit = np.quantile(np.abs(np.concatenate(columns)), 0.995) or 1.0
        top = header
        for mesh, of_mesh, vertex, body_height in zip(standing, columns, marked, heights, strict=True):
            colors = colormap(0.5 + 0.5 * np.clip(of_mesh / limit, -1, 1))[:, :3]
            picture = render(mesh, colors, azimuth=angle, scale=scale, width=cell_width, height=body_height)
            place = (left / width, 1 - (top + body_height) / height, cell_width / width, body_height / height)
            drawing = figure.add_axes(place, label=f"{mesh.name}, {title}")
            drawing.imshow(picture, aspect="auto", interpolation="nearest")
            right, upwards = scale * axes @ mesh.vertices[vertex]
            x, y = cell_width / 2 + right, body_height / 2 - upwards
            for edge, linewidth in ((INK, 1.6), ("white", 0.8)):
                drawing.plot(x, y, "o", mfc="none", mec=edge, mew=linewidth, ms=3.5, clip_on=False)
            drawing.set_axis_off()
            top += body_height + gap
    return figure


def save_figure(path: str | os.PathLike[str], figure: Figure) -> None:
    """Write a figure as PNG, PDF or SVG, as the suffix says. The file is written completely or not at all.

    **Raises:** `InputError` for any other suffix, or if the file cannot be written.
    """
    check_figure_path(path)
    suffix = Path(path).suffix.lower()
    import matplotlib

    with (
        atomic_write(path) as temporary,
        matplotlib.rc_context({"svg.hashsalt": "jaxsmw"}),
        warnings.catch_warnings(),
    ):
        # Names can contain characters that the font lacks. The figure shows a box for each of them.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(temporary, format=suffix[1:], dpi=_DPI, metadata=_METADATA[suffix])


def check_drawable() -> None:
    """Check that matplotlib is installed."""
    try:
        import matplotlib.backends.backend_agg  # noqa: F401
    except ImportError as error:
        raise InputError(
            "matplotlib, which draws figures, is not installed: install it with pip install 'jaxsmw[report]'."
        ) from error


def check_figure_path(path: str | os.PathLike[str]) -> None:
    """Check that `save_figure` can write a file."""
    check_suffix(path, "figures", *_METADATA)
    check_drawable()
    check_writable(path)


# The files contain no dates, because equal figures must give equal files.
_METADATA: dict[str, dict[str, None]] = {".png": {}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


class _Panel(NamedTuple):
    """One body in a figure: the text above it, its upright mesh, and its vertex colours (n, 3)."""

    role: str
    mesh: Mesh
    colors: np.ndarray


def _layout(
    meshes: Sequence[Mesh], azimuth: float | None, largest: tuple[int, int]
) -> tuple[float, float, list[tuple[int, int]]]:
    """Return the azimuth in radians, the pixels per unit of length, and the size of each body in pixels.

    `azimuth` is in degrees. The widest and the highest body fit into the size `largest`.
    """
    angle = choose_azimuth(meshes) if azimuth is None else np.radians(azimuth)
    axes = camera_axes(angle)[:2]
    extents = [2 * np.abs(visible(mesh) @ axes.T).max(axis=0) for mesh in meshes]
    scale = float(np.min(np.divide(largest, np.max(extents, axis=0))))
    return angle, scale, [(int(np.ceil(scale * x)), int(np.ceil(scale * y))) for x, y in extents]


def _draw_panels(panels: Sequence[_Panel], azimuth: float | None, *, right_margin: int = 0) -> Figure:
    """Draw the bodies next to each other at the same scale, with an empty margin in pixels at the right."""
    angle, scale, sizes = _layout([panel.mesh for panel in panels], azimuth, _BODY_SIZE)
    captioned = bool(panels[0].role)
    gap, header, narrowest = (40, 135, _LONGEST_NAME * 12) if captioned else (40, 0, 0)
    widths = [max(width + 2 * gap, narrowest) for width, _ in sizes]
    body_height = max(height for _, height in sizes)
    height, width = body_height + 2 * gap + header, sum(widths) + right_margin

    figure = new_figure(width / _DPI, height / _DPI)
    left, names = 0, _fitting_names([panel.mesh.name for panel in panels])
    for panel, panel_width, name in zip(panels, widths, names, strict=True):
        picture = render(
            panel.mesh, panel.colors, azimuth=angle, scale=scale, width=panel_width, height=body_height
        )
        place = (left / width, gap / height, panel_width / width, body_height / height)
        drawing = figure.add_axes(place, label=panel.role)
        drawing.imshow(picture, aspect="auto", interpolation="nearest")
        drawing.set_axis_off()
        if captioned:
            center, top = (left + panel_width / 2) / width, 1 - gap / height
            figure.text(center, top, panel.role, ha="center", va="top", fontsize=11, color=INK)
            figure.text(
                center,
                top - 50 / height,
                f"{name}\n{len(panel.mesh.vertices)} vertices",
                ha="center",
                va="top",
                fontsize=7.5,
                color=FAINT,
                parse_math=False,
            )
        left += panel_width
    return figure


def _fitting_names(paths: Sequence[str]) -> list[str]:
    """Return short names of files that fit above a panel and that differ for different files."""
    names, half = [printable(name) for name in short_names(paths)], _LONGEST_NAME // 2
    # If the ends of long names are equal, the names are shown from shortly before their first difference.
    first_difference = next((i for i, letters in enumerate(zip_longest(*names)) if len(set(letters)) > 1), 0)
    for start in (0, max(first_difference - half // 2, 0)):
        rest = [f"…{name[start:]}" if start else name for name in names]
        fitting = [n if len(n) <= _LONGEST_NAME else f"{n[: half - 1]}…{n[-half:]}" for n in rest]
        if len(set(fitting)) == len(set(names)):
            break
    return fitting


def _draw_scale(figure: Figure, limit: float, label: str) -> None:
    """Draw the colour bar of `error_colors` at the right edge."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    colors = ListedColormap(error_colors(np.linspace(0, 1, 256), 1.0))
    width = _DPI * figure.get_figwidth()
    axes = figure.add_axes((1 - _SCALE_WIDTH / width, 0.2, 22 / width, 0.5), label="error scale")
    ticks = np.linspace(0, limit, 6)
    scale = figure.colorbar(ScalarMappable(Normalize(0, limit), colors), cax=axes, extend="max", ticks=ticks)
    scale.ax.set_yticklabels([*(f"{tick:g}" for tick in ticks[:-1]), f"{limit:g} and\nabove"])
    scale.set_label(label, fontsize=7.5, color=FAINT)
    scale.outline.set_visible(False)
    style_axes(axes)


def _draw_unknown(figure: Figure) -> None:
    """Draw the colour of unknown values below the colour bar."""
    from matplotlib.patches import Patch

    unknown = Patch(facecolor=PLAIN.tolist(), label="unknown")
    place = (1 - (_SCALE_WIDTH + 10) / (_DPI * figure.get_figwidth()), 0.16)
    figure.legend(handles=[unknown], loc="upper left", bbox_to_anchor=place, frameon=False, fontsize=8)


def new_figure(width: float, height: float, *, plot: bool = False) -> Figure:
    """Return an empty white figure that opens no window. The width and the height are in inches.

    With `plot`, matplotlib chooses the positions of axes and labels automatically.
    """
    check_drawable()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12) if plot else None
    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def style_axes(axes: Axes, *, grid: bool = False) -> None:
    """Give axes the fonts, colours and lines of all figures, and a grid if requested."""
    axes.tick_params(labelsize=8, colors=FAINT, labelcolor=INK, width=0.6, length=3)
    axes.xaxis.label.set(size=9, color=INK)
    axes.yaxis.label.set(size=9, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set(color=FAINT, linewidth=0.6)
    if grid:
        axes.grid(color="#e6e8ec", linewidth=0.6)
        axes.set_axisbelow(True)
