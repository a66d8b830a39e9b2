"""Reads the input files of commands, and defines the values of `--init`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, cast, get_args

from jaxsmw.choices import IndexBase, MatchInit
from jaxsmw.cli.arguments import path
from jaxsmw.cli.console import report_progress, say
from jaxsmw.errors import InputError
from jaxsmw.runtime.files import size_of_file
from jaxsmw.wording import count_of

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int64

    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.geometry.mesh import Mesh


def check_inputs(*paths: str | None) -> None:
    """Check that input files exist, before libraries are imported for a second."""

    for file in filter(None, paths):
        size_of_file(file)


def read_meshes(*files: str, weld: bool | float) -> list[Mesh]:
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


def _note_index_base(file: str, index_base: IndexBase | None) -> None:
    """Print a note that the indices of a `.mat` file are read as 1-based, unless `--index-base` is given."""
    from jaxsmw.io.formats.mat import is_mat_file

    if index_base is None and is_mat_file(file):
        say(
            f"note: {file} is read with indices from 1, as usual in MATLAB; if its indices start from 0, add "
            "--index-base 0."
        )


class InitialMap(NamedTuple):
    """A value of `--init`: its text, and the files that it names. `kind` says what the files contain."""

    text: str
    kind: Literal["name", "landmarks", "map"]
    files: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str) -> InitialMap:
        """An argument type. In `landmarks:A,B`, the comma may belong to one name."""
        kind, _, file = text.partition(":")
        if file and kind == "map":
            return cls(text, "map", (path(file),))
        if file and kind == "landmarks":
            source, _, target = file.partition(",")
            is_pair = source and target and not os.path.lexists(file)
            return cls(text, "landmarks", (path(source), path(target)) if is_pair else (path(file),))
        if text in get_args(MatchInit):
            return cls(text, "name")
        choices = (*get_args(MatchInit), "landmarks:FILE", "landmarks:SOURCE_FILE,TARGET_FILE", "map:FILE")
        raise argparse.ArgumentTypeError(f"{text!r} is not an initial map: choose from {', '.join(choices)}")

    def check(self) -> None:
        """Check the names and the kind of landmark files, before any mesh is read."""
        if self.kind != "landmarks":
            return
        from jaxsmw.io.landmark_files import LANDMARK_SUFFIXES, check_readable_suffix

        if len(self.files) > 1:
            for file in self.files:
                check_readable_suffix(file)
        # A single file must contain a source vertex and a target vertex per line.
        elif self.files[0].lower().endswith(LANDMARK_SUFFIXES) or _has_positions(self.files[0]):
            raise InputError(
                f"{self.files[0]}: contains landmarks of one mesh only: give the landmarks of both meshes, "
                "as --init landmarks:SOURCE_FILE,TARGET_FILE."
            )

    def read(
        self, mesh_x: Mesh, mesh_y: Mesh, *, index_base: IndexBase | None
    ) -> MatchInit | Int64[np.ndarray, "l 2"] | Int64[np.ndarray, " m"]:
        """Return the argument `init` of `jaxsmw.match`."""
        from jaxsmw.io.maps import read_landmarks, read_pointwise_map

        if self.kind == "name":
            return cast("MatchInit", self.text)
        if len(self.files) > 1:
            return _read_landmark_files(self.files, mesh_x, mesh_y)
        _note_index_base(self.files[0], index_base)
        read = read_landmarks if self.kind == "landmarks" else read_pointwise_map
        return read(self.files[0], mesh_x, mesh_y, index_base=index_base)


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


def _read_landmark_files(files: tuple[str, ...], mesh_x: Mesh, mesh_y: Mesh) -> Int64[np.ndarray, "l 2"]:
    """Read landmarks on X and on Y, and return the nearest vertices of those with a name in both files."""
    from jaxsmw.io.landmark_files import read_landmark_file
    from jaxsmw.io.landmarks import match_landmarks
    from jaxsmw.transfer.landmarks import landmark_vertices

    both = [read_landmark_file(file) for file in files]
    matched = match_landmarks(*both)
    for landmarks, alone in zip(both, (matched.only_first, matched.only_second), strict=True):
        for note in landmarks.notes:
            report_progress(f"{landmarks.name}: {note}")
        if alone:
            number = count_of(len(alone), "landmark")
            say(f"note: {landmarks.name}: {number} without a partner, such as {alone[0]!a}.")
    return landmark_vertices(both[0].select(matched.names), both[1].select(matched.names), mesh_x, mesh_y)
