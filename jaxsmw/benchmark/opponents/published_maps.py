"""Methods that read the maps of other programs from files named `X_Y.map`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.benchmark.opponents.base import Method, MethodInput
from jaxsmw.core.results import RESULTS
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.map_files import read_pointwise_map
from jaxsmw.runtime.padding import pad_rows


@dataclass(frozen=True)
class PublishedMaps(Method):
    """A method that reads the map of each pair from a directory; see `read_published_map`.

    **Attributes:**

    - `directory`: the directory that contains the files `X_Y.map`.
    - `number_of_eigenvectors`: 1, the smallest number that a benchmark can compute. The method itself uses
      no eigenvectors.
    """

    directory: Path
    number_of_eigenvectors: int = 1

    @property
    def reference(self) -> str:  # type: ignore[override]
        """The text that is printed with the results. It contains the name of the directory."""
        return f"maps in {self.directory.name}, computed elsewhere"

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Return the map X -> Y and the status code; see `Method`."""
        assert pair.meshes is not None
        pointwise_map = read_published_map(self.directory, pair.names, pair.meshes)
        padded = jnp.asarray(pad_rows(pointwise_map, pair.spectrum_x.mask.shape[0]), jnp.int32)
        return padded, RESULTS.successful  # type: ignore[return-value]

    def check(self, pairs: Sequence[DataPair]) -> None:
        """Check that the directory has a map for each pair.

        **Raises:** `InputError` if a map is missing.
        """
        missing = [pair for pair in pairs if not published_file(self.directory, pair.names).is_file()]
        if missing:
            raise InputError(
                f"{published_file(self.directory, missing[0].names)}: is missing ({len(missing)} of "
                f"{len(pairs)} maps are missing): add the maps, or use --pairs FILE with a list of the pairs "
                "that have maps."
            )


def published_file(directory: Path, names: tuple[str, str]) -> Path:
    """Return the path of the map between two shapes, given the names of the source and the target."""
    return directory / f"{'_'.join(names)}.map"


def read_published_map(
    directory: Path, names: tuple[str, str], meshes: tuple[Mesh, Mesh]
) -> Int64[np.ndarray, " m"]:
    """Read the map X -> Y from `X_Y.map`, which contains one vertex of Y per line, counted from 1.

    **Arguments:**

    - `directory`: the directory that contains the file.
    - `names`: the names of X and Y, which form the file name.
    - `meshes`: the meshes of X, with m vertices, and of Y.

    **Returns:** The map (m,), 0-based vertices of Y.

    **Raises:** `InputError` if the file is missing or does not fit the meshes.
    """
    return read_pointwise_map(published_file(directory, names), *meshes, index_base=1)
