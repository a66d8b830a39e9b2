"""Checks of output paths before the computation, and messages that name each written file."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsmw.cli.console import Stopwatch, report_progress
from jaxsmw.cli.method import preset_name
from jaxsmw.errors import InputError, check_suffix
from jaxsmw.runtime.files import atomic_write, check_directory, check_writable

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int64
    from matplotlib.figure import Figure

    from jaxsmw.choices import Axis
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.geometry.mesh import Mesh
    from jaxsmw.io.landmarks import Landmarks
    from jaxsmw.matching.correspondence import Correspondence
    from jaxsmw.transfer.registered_mesh import RegisteredMesh


def check_outputs(
    inputs: Iterable[str | None],
    *,
    files: Iterable[str | None] = (),
    figures: Iterable[str | None] = (),
    pages: Iterable[str | None] = (),
    report: str | None = None,
    texture: str | None = None,
    directories: Iterable[tuple[str, Sequence[str]]] = (),
) -> None:
    """Check before a long computation that all outputs can be written.

    No output may replace an input or another output, after symbolic links are resolved. The names of
    `directories` are those of the files that the command writes into the directory.
    """
    files, figures, pages = ([path for path in paths if path] for paths in (files, figures, pages))
    directories = list(directories)
    if figures or pages or report or texture:
        from jaxsmw.report.figures import check_drawable, check_figure_path

        check_drawable()
    if report:
        from jaxsmw.report.summary import REPORT_FILES

        directories.append((report, REPORT_FILES))
    if texture:
        from jaxsmw.report.texture import TEXTURE_FILES

        directories.append((texture, TEXTURE_FILES))
    written = [*files, *figures, *pages]
    written += [os.path.join(directory, name) for directory, names in directories for name in names]
    _refuse_clashes(filter(None, inputs), written, [directory for directory, _ in directories])
    for path in files:
        check_writable(path)
    for path in figures:
        check_figure_path(path)
    for path in pages:
        check_suffix(path, "pages", *_PAGES)
        check_writable(path)
    for path, _ in directories:
        check_directory(path)


def _refuse_clashes(inputs: Iterable[str], files: Iterable[str], directories: Iterable[str]) -> None:
    read = {os.path.realpath(path) for path in inputs}
    taken: set[str] = set()
    for path in files:
        _refuse_place(path, read, taken)
        taken.add(os.path.realpath(path))
    for path in directories:
        _refuse_place(path, read, taken)
        if parents := taken.intersection(map(str, Path(os.path.realpath(path)).parents)):
            raise InputError(
                f"{path}: is inside {parents.pop()}, which is an output file and not a directory: choose "
                "another path for one of the two outputs."
            )


def _refuse_place(path: str, read: set[str], taken: set[str]) -> None:
    place = os.path.realpath(path)
    if place in read:
        raise InputError(f"{path}: is an input and would be overwritten: choose another name.")
    if place in taken:
        raise InputError(f"{path}: two outputs have this name: choose another name for one of the outputs.")


def is_page(path: str) -> bool:
    """Return whether a file name has the suffix of an HTML page."""
    return Path(path).suffix.lower() in _PAGES


_PAGES = (".html", ".htm")


def report_written(*paths: str | os.PathLike[str]) -> None:
    """Print the names of written files as progress messages."""
    for path in paths:
        report_progress(f"wrote {path}")


def write_figure(path: str, figure: Figure) -> None:
    """Write a figure to a file."""
    from jaxsmw.report.figures import save_figure

    save_figure(path, figure)
    report_written(path)


def write_text(path: str, text: str) -> None:
    """Write a text to a file."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")
    report_written(path)


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

    settings = {**vars(options), "init": options.init.text, "preset": preset_name(options)}
    del settings["run"]
    with stopwatch.step("report", announced=True):
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


def write_comparison_page(
    path: str,
    mesh_x: Mesh,
    mesh_y: Mesh,
    maps: Mapping[str, Int64[np.ndarray, " m"]],
    errors: Mapping[str, GeodesicError],
    *,
    partial: bool,
    up: Axis | None,
) -> None:
    """Write an interactive page that shows maps and their errors, by the paths of the maps' files."""
    from jaxsmw.report.summary import write_comparison

    # The shortest labels that differ from each other.
    for shorten in (lambda path: Path(path).stem, lambda path: Path(path).name, str):
        names = {path: shorten(path) for path in maps}
        if len(set(names.values())) == len(maps):
            break
    write_comparison(
        path,
        mesh_x,
        mesh_y,
        {names[path]: pointwise_map for path, pointwise_map in maps.items()},
        errors={names[path]: error for path, error in errors.items()},
        partial=partial,
        up=up,
    )
    report_written(path)
