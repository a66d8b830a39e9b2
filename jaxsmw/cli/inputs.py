"""Functions that read the input files of commands."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, get_args

from jaxsmw.choices import IndexBase, InitialMap
from jaxsmw.cli.arguments import path
from jaxsmw.cli.console import report_progress, say

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int64

    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.geometry.mesh import Mesh


def read_mesh_file(file: str, *, weld: bool) -> Mesh:
    """Read a mesh, and print its description on standard error unless `--quiet` is given.

    **Raises:** `InputError` if `jaxsmw.read_mesh` refuses the file.
    """
    from jaxsmw.io.mesh_files import read_mesh

    mesh = read_mesh(file, weld=weld)
    for sentence in describe_mesh(mesh):
        report_progress(f"{file}: {sentence}")
    return mesh


def describe_mesh(mesh: Mesh) -> list[str]:
    """Return sentences that describe a mesh: its notes, its size and its defects."""
    from jaxsmw.geometry.mesh import diagnose

    return [*mesh.notes, *diagnose(mesh).sentences()]


def read_truth(
    files: Sequence[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None
) -> GroundTruth:
    """Read the ground truth of a pair with `jaxsmw.read_ground_truth`.

    **Raises:** `InputError` if the files cannot be read or do not fit the meshes.
    """
    from jaxsmw.evaluation.ground_truth import read_ground_truth

    for file in files:
        _note_index_base(file, index_base)
    return read_ground_truth(files, mesh_x, mesh_y, index_base=index_base)


def read_maps(
    files: Sequence[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None
) -> dict[str, Int64[np.ndarray, " m"]]:
    """Read pointwise maps X -> Y with `jaxsmw.read_pointwise_map`.

    **Returns:** A dictionary from the name of each file to its map (m,), as 0-based vertices of Y.

    **Raises:** `InputError` if a file cannot be read or does not fit the meshes.
    """
    from jaxsmw.io.map_files import read_pointwise_map

    maps = {}
    for file in files:
        _note_index_base(file, index_base)
        maps[file] = read_pointwise_map(file, mesh_x, mesh_y, index_base=index_base)
    return maps


def initial_map(text: str) -> str:
    """Return `text` if the option `--init` accepts this value.

    The option accepts the names of initial maps, `landmarks:FILE` and `map:FILE`.

    **Raises:** `argparse.ArgumentTypeError` for any other text.
    """
    kind, _, file = text.partition(":")
    if file and kind in _INITIAL_MAP_FILES:
        path(file)
    elif text not in get_args(InitialMap):
        choices = (*get_args(InitialMap), *(f"{kind}:FILE" for kind in _INITIAL_MAP_FILES))
        raise argparse.ArgumentTypeError(f"{text!r} is not an initial map: choose from {', '.join(choices)}")
    return text


_INITIAL_MAP_FILES = ("landmarks", "map")


def initial_map_file(init: str) -> str | None:
    """Return the file name in a value of `--init`, or None if the value contains no file name."""
    return init.partition(":")[2] or None


def read_initial_map(init: str, mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None) -> Any:
    """Convert a value of `--init` to the argument `init` of `jaxsmw.match`.

    **Returns:** The name of an initial map, landmarks (l, 2), or a pointwise map (m,). Vertices are 0-based.

    **Raises:** `InputError` if the file cannot be read or does not fit the meshes.
    """
    from jaxsmw.io.map_files import read_landmarks, read_pointwise_map

    kind, _, file = init.partition(":")
    if not file:
        return init
    _note_index_base(file, index_base)
    read = read_landmarks if kind == "landmarks" else read_pointwise_map
    return read(file, mesh_x, mesh_y, index_base=index_base)


def _note_index_base(file: str, index_base: IndexBase | None) -> None:
    """For a `.mat` file without `--index-base`, print a note that indices are read as 1-based."""
    from jaxsmw.io.mat_files import is_mat_file

    if index_base is None and is_mat_file(file):
        say(
            f"note: {file} is read with indices from 1, as usual in MATLAB; if its indices start from 0, add "
            "--index-base 0."
        )
