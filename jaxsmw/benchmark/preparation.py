"""Prepares a pair of shapes for the compared methods, in the same way as `jaxsmw.match`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Int64

from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.benchmark.opponents.base import MOST_SAMPLES, MethodInput
from jaxsmw.benchmark.opponents.published_maps import read_published_map
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.shapes import Sizes
from jaxsmw.matching.starts import INITIAL_MAPS, make_start


def prepare_pair(
    data: DataPair,
    mesh_x: Mesh,
    mesh_y: Mesh,
    init: str,
    number_of_eigenvectors: int,
    *,
    number_of_descriptors: int = 0,
) -> MethodInput:
    """Compute the input that all compared methods share: spectra, descriptors, the initial map and samples.

    **Arguments:**

    - `data`: the `DataPair`. The function uses only the names of the shapes and the attribute `partial`.
    - `mesh_x`, `mesh_y`: the meshes of X, with m vertices, and of Y, with n vertices.
    - `init`: either a directory with initial maps in files named `X_Y.map`, or the name of an initial map
      (see `jaxsmw.match`): `"shot"`, `"wks"`, `"hks"`, `"wavelet"`, `"functional"` or `"aligned"`.
    - `number_of_eigenvectors`: the number of eigenvectors that are computed for each shape.
    - `number_of_descriptors`: the number of principal components of the SHOT descriptors; 0 for no
      descriptors.

    **Returns:** A `MethodInput`, with arrays padded to the same sizes as in `jaxsmw.match`.

    **Raises:** `InputError` if a spectrum or an initial map cannot be computed, or if the directory contains
    no valid map X -> Y; `ArithmeticError` if the computation of an initial map fails numerically.
    """
    pair = Pair(mesh_x, mesh_y, data.partial)
    start = _init(init, data.names, pair)
    samples = min(MOST_SAMPLES, pair.fewest_vertices())
    prepared = prepare(pair, Sizes(number_of_eigenvectors, number_of_samples=samples))
    first = make_start(prepared, start)
    if number_of_descriptors:
        prepared = prepared.describe(number_of_descriptors)
    return MethodInput.of(prepared, first, data.names)


def _init(init: str, names: tuple[str, str], pair: Pair) -> str | Int64[np.ndarray, " m"]:
    """Return `init` if it names an initial map; otherwise read a map from the directory `init`."""
    return init if init in INITIAL_MAPS else read_published_map(Path(init), names, pair.meshes)
