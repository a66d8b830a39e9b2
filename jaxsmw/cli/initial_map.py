"""The option `--init`: the name of an initial map, or files with landmarks or with a map."""

from __future__ import annotations

import argparse
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, cast, get_args

from jaxsmw.choices import IndexBase, MatchInit
from jaxsmw.cli.arguments import path
from jaxsmw.cli.console import report_progress, say
from jaxsmw.cli.inputs import note_index_base
from jaxsmw.errors import InputError
from jaxsmw.wording import count_of

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int64

    from jaxsmw.geometry.mesh import Mesh


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
        note_index_base(self.files[0], index_base)
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
