"""Functions that read the input files of commands."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

from jaxsmw.choices import IndexBase, MatchInit
from jaxsmw.cli.arguments import path
from jaxsmw.cli.console import report_progress, say
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int64

    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.geometry.mesh import Mesh


def check_inputs(*paths: str | None) -> None:
    """Check that input files exist, before libraries are imported for a second."""
    from jaxsmw.runtime.files import size_of_file

    for file in filter(None, paths):
        size_of_file(file)


def read_mesh_file(file: str, *, weld: bool) -> Mesh:
    """Read a mesh, and print a summary of it as progress messages."""
    from jaxsmw.io.meshes import read_mesh

    mesh = read_mesh(file, weld=weld)
    report_mesh(file, mesh)
    return mesh


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
        _note_index_base(file, index_base)
    return read_ground_truth(files, mesh_x, mesh_y, index_base=index_base)


def read_maps(
    files: Sequence[str], mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None
) -> dict[str, Int64[np.ndarray, " m"]]:
    """Read pointwise maps X -> Y. The keys of the result are the file names."""
    from jaxsmw.io.maps import read_pointwise_map

    maps = {}
    for file in files:
        _note_index_base(file, index_base)
        maps[file] = read_pointwise_map(file, mesh_x, mesh_y, index_base=index_base)
    return maps


def initial_map_choice(text: str) -> str:
    """An argument type for the values of `--init`."""
    kind, _, file = text.partition(":")
    if file and kind in ("landmarks", "map"):
        for name in initial_map_files(text):
            path(name)
    elif text not in get_args(MatchInit):
        choices = (*get_args(MatchInit), "landmarks:FILE", "landmarks:SOURCE_FILE,TARGET_FILE", "map:FILE")
        raise argparse.ArgumentTypeError(f"{text!r} is not an initial map: choose from {', '.join(choices)}")
    return text


def initial_map_files(init: str) -> list[str]:
    """Return the file names in a value of `--init`. In `landmarks:A,B`, the comma may belong to one name."""
    kind, _, file = init.partition(":")
    source, _, target = file.partition(",")
    if kind == "landmarks" and source and target and not os.path.lexists(file):
        return [source, target]
    return [file] if file else []


def check_initial_map_files(init: str) -> None:
    """Check the landmark files in a value of `--init`, before any mesh is read."""
    files = initial_map_files(init)
    if not init.startswith("landmarks:"):
        return
    from jaxsmw.io.landmark_files import LANDMARK_SUFFIXES, check_readable_suffix

    if len(files) > 1:
        for file in files:
            check_readable_suffix(file)
    # A single file must contain a source vertex and a target vertex per line.
    elif files[0].lower().endswith(LANDMARK_SUFFIXES) or _has_positions(files[0]):
        raise InputError(
            f"{files[0]}: contains landmarks of one mesh only: give the landmarks of both meshes, as --init "
            "landmarks:SOURCE_FILE,TARGET_FILE."
        )


def _has_positions(file: str) -> bool:
    """Return whether a table contains positions of landmarks, and not pairs of vertices."""
    from jaxsmw.io.landmark_files import read_landmark_file
    from jaxsmw.io.maps import Table

    with suppress(InputError):
        Table(Path(file), columns=2)
        return False
    with suppress(InputError):
        read_landmark_file(file)
        return True
    return False


def read_initial_map(
    init: str, mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None
) -> MatchInit | Int64[np.ndarray, "l 2"] | Int64[np.ndarray, " m"]:
    """Convert a value of `--init` to the argument `init` of `jaxsmw.match`."""
    from jaxsmw.io.maps import read_landmarks, read_pointwise_map

    match initial_map_files(init):
        case []:
            return cast("MatchInit", init)
        case [file]:
            _note_index_base(file, index_base)
            read = read_landmarks if init.startswith("landmarks:") else read_pointwise_map
            return read(file, mesh_x, mesh_y, index_base=index_base)
        case files:
            return _read_landmark_files(files, (mesh_x, mesh_y))


def _read_landmark_files(files: Sequence[str], meshes: tuple[Mesh, Mesh]) -> Int64[np.ndarray, "l 2"]:
    """Read landmarks on X and on Y, and return the nearest vertices of those with a name in both files."""
    from jaxsmw.io.landmark_files import read_landmark_file
    from jaxsmw.io.landmarks import match_landmarks
    from jaxsmw.transfer.landmarks import landmark_vertices
    from jaxsmw.wording import count_of

    both = [read_landmark_file(file) for file in files]
    matched = match_landmarks(*both)
    for landmarks, alone in zip(both, (matched.only_first, matched.only_second), strict=True):
        for note in landmarks.notes:
            report_progress(f"{landmarks.name}: {note}")
        if alone:
            number = count_of(len(alone), "landmark")
            say(f"note: {landmarks.name}: {number} without a partner, such as {alone[0]!a}.")
    return landmark_vertices(both[0].select(matched.names), both[1].select(matched.names), *meshes)


def _note_index_base(file: str, index_base: IndexBase | None) -> None:
    """Print a note that the indices of a `.mat` file are read as 1-based, unless `--index-base` is given."""
    from jaxsmw.io.formats.mat import is_mat_file

    if index_base is None and is_mat_file(file):
        say(
            f"note: {file} is read with indices from 1, as usual in MATLAB; if its indices start from 0, add "
            "--index-base 0."
        )
