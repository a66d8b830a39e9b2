"""Functions that read the input files of commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from jaxsmw.choices import IndexBase
from jaxsmw.cli.console import report_progress, say
from jaxsmw.runtime.files import size_of_file

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int64

    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.geometry.mesh import Mesh


def check_inputs(*paths: str | None) -> None:
    """Check that input files exist, before libraries are imported for a second."""

    for file in filter(None, paths):
        size_of_file(file)


def read_meshes(*files: str, weld: bool) -> list[Mesh]:
    """Read meshes, and print a summary of each as progress messages."""
    from jaxsmw.io.meshes import read_mesh

    meshes = []
    for file in files:
        meshes.append(read_mesh(file, weld=weld))
        report_mesh(file, meshes[-1])
    return meshes


def report_mesh(file: str, mesh: Mesh) -> None:
    """Print the size, the notes and the unusual elements of a mesh as progress messages."""
    from jaxsmw.geometry.mesh import diagnose

    size, *unusual = diagnose(mesh).brief_sentences()
    for line in filter(None, (size, " ".join(mesh.notes), *unusual)):
        report_progress(f"{file}: {line}")


def read_truth(
    files: Sequence[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None
) -> GroundTruth:
    """Read the ground truth of a pair."""
    from jaxsmw.evaluation.ground_truth import read_ground_truth

    for file in files:
        note_index_base(file, index_base)
    return read_ground_truth(files, mesh_x, mesh_y, index_base=index_base)


def read_maps(
    files: Sequence[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None
) -> dict[str, Int64[np.ndarray, " m"]]:
    """Read pointwise maps X -> Y. The keys of the result are the file names."""
    from jaxsmw.io.maps import read_pointwise_map

    maps = {}
    for file in files:
        note_index_base(file, index_base)
        maps[file] = read_pointwise_map(file, mesh_x, mesh_y, index_base=index_base)
    return maps


def note_index_base(file: str, index_base: IndexBase | None) -> None:
    """Print a note that the indices of a `.mat` file are read as 1-based, unless `--index-base` is given."""
    from jaxsmw.io.formats.mat import is_mat_file

    if index_base is None and is_mat_file(file):
        say(
            f"note: {file} is read with indices from 1, as usual in MATLAB; if its indices start from 0, add "
            "--index-base 0."
        )
