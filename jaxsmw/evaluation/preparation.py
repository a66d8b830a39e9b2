"""Prepares a pair of shapes for the compared methods, in the same way as `jaxsmw.match`."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int64

from jaxsmw.core.functional_map import encode
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.evaluation.datasets import DataPair
from jaxsmw.evaluation.opponents.base import MOST_SAMPLES, MethodInput
from jaxsmw.evaluation.opponents.published_maps import published_file, read_published_map
from jaxsmw.evaluation.opponents.zoomout import FIRST_EIGENVECTORS
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.initial_maps import INITIAL_MAPS, initial_map
from jaxsmw.pair import Pair
from jaxsmw.preparation import PreparedPair, prepare


def prepare_pair(
    data: DataPair,
    mesh_x: Mesh,
    mesh_y: Mesh,
    init: str,
    number_of_eigenvectors: int,
    *,
    number_of_descriptors: int = 0,
    both_directions: bool = False,
) -> MethodInput:
    """Compute the input that all compared methods share: spectra, descriptors, initial maps and samples.

    **Arguments:**

    - `data`: the `DataPair`. The function uses only the names of the shapes and the attribute `partial`.
    - `mesh_x`, `mesh_y`: the meshes of X, with m vertices, and of Y, with n vertices.
    - `init`: either a directory with initial maps in files named `X_Y.map`, or the name of an initial map
      (see `jaxsmw.match`): `"shot"`, `"wks"`, `"hks"`, `"wavelet"`, `"functional"` or `"aligned"`.
    - `number_of_eigenvectors`: the number of eigenvectors that are computed for each shape.
    - `number_of_descriptors`: the number of principal components of the SHOT descriptors; 0 for no
      descriptors.
    - `both_directions`: whether to compute the initial map Y -> X as well.

    **Returns:** A `MethodInput`, with arrays padded to the same sizes as in `jaxsmw.match`.

    **Raises:** `InputError` if a spectrum or an initial map cannot be computed, or if the directory contains
    no valid map X -> Y; `ArithmeticError` if the computation of an initial map fails numerically.
    """
    pair = Pair(mesh_x, mesh_y, data.partial)
    prepared = prepare(
        pair,
        number_of_eigenvectors=number_of_eigenvectors,
        number_of_descriptors=number_of_descriptors,
        number_of_samples=min(MOST_SAMPLES, pair.fewest_vertices()),
        init=_init(init, data.names, pair),
    )
    reverse = _reverse_initial_map(data, prepared, init) if both_directions else None
    return MethodInput.of(prepared, data.names, reverse)


def _init(init: str, names: tuple[str, str], pair: Pair) -> str | Int64[np.ndarray, " m"]:
    """Return `init` if it names an initial map; otherwise read a map from the directory `init`."""
    return init if init in INITIAL_MAPS else read_published_map(Path(init), names, pair.meshes)


def _reverse_initial_map(data: DataPair, prepared: PreparedPair, init: str) -> Int64[np.ndarray, " n"]:
    """Return the initial map Y -> X, which is computed or read in the same way as the initial map X -> Y.

    If a directory with initial maps contains no map Y -> X, the initial map X -> Y is converted to a
    functional map. The map Y -> X is then computed from this functional map.
    """
    names, reversed_ = (data.target, data.source), prepared.pair.reversed()
    if init in INITIAL_MAPS or published_file(Path(init), names).is_file():
        first = _init(init, names, reversed_)
        return initial_map(reversed_, prepared.spectrum_y, prepared.spectrum_x, init=first)
    spectra = prepared.spectrum_x, prepared.spectrum_y
    spectrum_x, spectrum_y = (spectrum.truncate(FIRST_EIGENVECTORS) for spectrum in spectra)
    functional_map = encode(jnp.asarray(prepared.initial_map), spectrum_x, spectrum_y)
    embeddings = spectral_embeddings(functional_map, spectrum_x, spectrum_y)
    reverse = nearest_neighbor(*embeddings[::-1], database_mask=spectrum_x.mask)
    return np.asarray(reverse).astype(np.int64)
