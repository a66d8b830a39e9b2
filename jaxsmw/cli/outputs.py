"""Checks of output paths before the computation, and messages that name each written file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsmw.cli.console import report_progress
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    from jaxsmw.choices import Axis
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.geometry.mesh import Mesh


def check_outputs(
    inputs: Iterable[str | None],
    *,
    files: Iterable[str | None] = (),
    figures: Iterable[str | None] = (),
    pages: Iterable[str | None] = (),
    directories: Sequence[tuple[str, Sequence[str]]] = (),
) -> None:
    """Check before a long computation that all outputs can be written.

    No output may replace an input or another output. Paths are compared after symbolic links are resolved.
    Paths that are None are ignored.

    **Arguments:**

    - `inputs`: the files that the command reads.
    - `files`: the files that the command writes, except figures and pages.
    - `figures`: the pictures that the command writes (PNG, PDF or SVG).
    - `pages`: the interactive HTML pages that the command writes.
    - `directories`: a list of pairs (directory, names). The command creates the directory, and writes files
      with these names into the directory. A directory may occur in several pairs.

    **Raises:** `InputError` if an output cannot be written; the message names its path.
    """
    files, figures, pages = ([path for path in paths if path] for paths in (files, figures, pages))
    written = [*files, *figures, *pages]
    written += [os.path.join(directory, name) for directory, names in directories for name in names]
    _refuse_clashes(filter(None, inputs), written, [directory for directory, _ in directories])
    for path in files:
        _check_writable(path)
    for path in figures:
        from jaxsmw.report.figures import check_figure_path

        check_figure_path(path)
    for path in pages:
        _check_page(path)
    for path, _ in directories:
        from jaxsmw.runtime.files import check_directory

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


def report_directories(directory: str | None) -> list[tuple[str, tuple[str, ...]]]:
    """Return a list with the directory of a report and the names of its files, as `check_outputs` expects.

    The list is empty if `directory` is None.

    **Raises:** `InputError` if a report is requested, but matplotlib is missing.
    """
    if directory is None:
        return []
    from jaxsmw.report.figures import check_drawable

    check_drawable()
    from jaxsmw.report.summary import REPORT_FILES

    return [(directory, REPORT_FILES)]


def is_page(path: str) -> bool:
    """Return whether a file name has the suffix of an HTML page, `.html` or `.htm`."""
    return Path(path).suffix.lower() in (".html", ".htm")


def _check_page(path: str) -> None:
    from jaxsmw.report.figures import check_drawable

    if not is_page(path):
        raise InputError(f"{path}: pages are written as .html: choose a name that ends in .html.")
    check_drawable()
    _check_writable(path)


def _check_writable(path: str) -> None:
    from jaxsmw.runtime.files import check_writable

    check_writable(path)


def report_written(*paths: str | os.PathLike[str]) -> None:
    """Print the names of written files on standard error. The option `--quiet` suppresses these messages."""
    for path in paths:
        report_progress(f"wrote {path}")


def write_comparison_page(
    path: str,
    mesh_x: Mesh,
    mesh_y: Mesh,
    maps: Mapping[str, Any],
    errors: Mapping[str, GeodesicError],
    *,
    partial: bool,
    up: Axis | None,
) -> None:
    """Write an interactive page that shows several maps and their errors.

    The page labels each map with its file name without suffix. If two of these labels are equal, the page
    uses the file names with suffix instead. If two file names are equal, the page uses the full paths.

    **Arguments:**

    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y.
    - `maps`: a dictionary from the path of each file to its map X -> Y (m,).
    - `errors`: a dictionary from the same paths to the geodesic errors; empty if errors are unknown.
    - `partial`: whether one mesh is a partial shape and the other mesh the full shape.
    - `up`: the axis of the meshes that points up; None to guess the axis.
    """
    from jaxsmw.report.summary import write_comparison

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
