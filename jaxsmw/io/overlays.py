"""Readers and writers of overlays: files with numbers on the vertices of a mesh, but without the mesh."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from jaxsmw.errors import InputError, naming
from jaxsmw.io.formats.polygons import unique_names
from jaxsmw.io.mesh_data import Overlay
from jaxsmw.runtime.files import atomic_write, read_bytes

# The functions of `jaxsmw.io.formats.brain` that parse and format files with a suffix. FreeSurfer names
# files with one number per vertex as it likes, such as lh.curv and lh.thickness.
_FUNCTIONS = {
    ".gii": ("parse_gifti_overlay", "format_gifti_overlay"),
    ".annot": ("parse_annotation", "format_annotation"),
    "": ("parse_morphometry", "format_morphometry"),
}
_HEMISPHERES = ("lh.", "rh.")
OVERLAY_SUFFIXES = (".func.gii", ".shape.gii", ".label.gii", ".annot")
"""The suffixes of files that certainly are overlays."""
# Words of file names that say what a file contains, but not what it describes.
_NOT_IN_NAMES = (".gii", ".annot", ".label", ".func", ".shape")


def read_overlay(path: str | os.PathLike[str]) -> Overlay:
    """Read data on the vertices of a brain, from a file that does not contain the surface.

    The files need the extra `brain`. Arrays without a name in the file get the name of the file, without
    hemisphere and suffix: `curv` for `lh.curv`.

    **Arguments:**

    - `path`: the file. Its name determines the format:
        - `.gii`, such as `.func.gii`, `.shape.gii` and `.label.gii`: a GIFTI file. A label without a name
          gets the digits of its number as name.
        - `.annot`: labels of FreeSurfer. Vertices without a label get an own label, which is called `???`.
        - other names, such as `lh.curv` and `lh.thickness`: a file of FreeSurfer with one number per vertex.

    **Returns:** An `Overlay`. Its labels are numbered from 0 in the order of the file's table, which also
    contains their numbers in the file. `Overlay.added_to` adds the overlay to the data of the mesh.

    **Raises:** `InputError` if the file cannot be read or is damaged, or the extra is not installed.
    """
    data = read_bytes(path)
    with naming(path):
        if not data:
            raise InputError("is empty: export the overlay again.")
        overlay = _function(path, 0)(data)
    names = dict(zip(overlay.values, _names(Path(path), list(overlay.values)), strict=True))
    return replace(
        overlay,
        values={names[name]: values for name, values in overlay.values.items()},
        labels={names[name]: table for name, table in overlay.labels.items()},
        name=str(path),
    )


def write_overlay(path: str | os.PathLike[str], overlay: Overlay) -> tuple[str, ...]:
    """Write data on the vertices of a brain, without the surface.

    The write is atomic: an incomplete file never appears at `path`.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix determines the format: `.gii` for GIFTI and
      `.annot` for labels of FreeSurfer. A name that begins with `lh.` or `rh.` and has another suffix is a
      file of FreeSurfer with one number per vertex.
    - `overlay`: an `Overlay`. Labels in GIFTI files have the numbers of their table. Labels without colours
      get colours if the format needs them.

    **Returns:** A tuple of sentences about what the format cannot hold.

    **Raises:** `InputError` for another name, data that the format cannot hold, or a file that cannot be
    written.
    """
    check_overlay_name(path)
    with naming(path):
        content, notes = _function(path, 1)(overlay)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return notes


def check_overlay_name(path: str | os.PathLike[str]) -> None:
    """Refuse a file name that belongs to no format in which overlays can be written."""
    file = Path(path)
    if file.suffix.lower() not in (".gii", ".annot") and not file.name.startswith(_HEMISPHERES):
        raise InputError(
            f"{path}: overlays cannot be written as {file.suffix!r}: choose a name that ends in .func.gii, "
            ".label.gii or .annot, or a name such as lh.curv."
        )


def _function(path: str | os.PathLike[str], which: int) -> Callable[..., Any]:
    suffix = Path(path).suffix.lower()
    name = _FUNCTIONS[suffix if suffix in _FUNCTIONS else ""][which]
    return getattr(import_module("jaxsmw.io.formats.brain"), name)


def _names(path: Path, names: list[str]) -> list[str]:
    """Return the names of arrays, with the name of the file in place of names that say nothing."""
    stem = path.name
    for word in _NOT_IN_NAMES:
        stem = stem.removesuffix(word)
    for hemisphere in _HEMISPHERES:
        stem = stem.removeprefix(hemisphere)
    return unique_names(
        [stem or name if name in ("label", "shape", "value", "data") else name for name in names]
    )
