"""Prepares a pair for the compared methods: spectra, initial maps and samples, padded to common sizes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.core.functional_map import encode
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import describe
from jaxsmw.evaluation.datasets import DataPair
from jaxsmw.evaluation.opponents.base import MOST_SAMPLES, PreparedPair
from jaxsmw.evaluation.opponents.published_maps import published_file, read_published_map
from jaxsmw.evaluation.opponents.zoomout import FIRST_EIGENVECTORS
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.initial_maps.starts import Start, initial_map, other_starts
from jaxsmw.matching import paired_spectra
from jaxsmw.runtime.batches import pad_rows, padded_size


def prepare_pair(
    data: DataPair,
    mesh_x: Mesh,
    mesh_y: Mesh,
    init: str,
    number_of_eigenvectors: int,
    *,
    number_of_descriptors: int = 0,
    both_directions: bool = False,
) -> PreparedPair:
    """Computes everything that the methods share, padded so that a few compiled programs serve all pairs.

    **Arguments:**

    - `data`: the names of the two shapes, and whether X is a partial shape.
    - `mesh_x`, `mesh_y`: X and Y.
    - `init`: a descriptor (see `jaxsmw.match`), or a directory with initial maps `X_Y.map`.
    - `number_of_eigenvectors`: k of both spectra.
    - `number_of_descriptors`: the number of principal components of SHOT; without descriptors if 0.
    - `both_directions`: whether to compute the initial map Y -> X, too.
    """
    meshes = mesh_x, mesh_y
    spectra = paired_spectra(*meshes, number_of_eigenvectors, partial=data.partial)
    if number_of_descriptors:
        spectra = describe(*meshes, *spectra, number_of_descriptors, partial=data.partial)
    start = _start(data.names, meshes, spectra, init, data.partial)
    reverse = None
    if both_directions:
        reverse = _reverse_start(data, meshes, spectra, init, start)
    sizes = [padded_size(len(mesh.vertices)) for mesh in meshes]

    def padded(pointwise_map: Int64[np.ndarray, " m"], size: int) -> Int[Array, " p"]:
        return jnp.asarray(pad_rows(pointwise_map, size), jnp.int32)

    def alternatives() -> Iterator[Int[Array, " p"]]:
        if init == "shot":
            for other in other_starts(*meshes, *spectra, partial=data.partial):
                yield padded(other, sizes[0])

    samples = (
        jnp.asarray(farthest_point_samples(mesh, min(MOST_SAMPLES, int(mesh.used_vertices.sum()))))
        for mesh in meshes
    )
    return PreparedPair(
        spectra[0].pad(sizes[0]),
        spectra[1].pad(sizes[1]),
        padded(start, sizes[0]),
        tuple(samples),  # type: ignore[arg-type]
        None if reverse is None else padded(reverse, sizes[1]),
        meshes,
        data.names,
        data.partial,
        alternatives,
    )


def _start(
    names: tuple[str, str],
    meshes: tuple[Mesh, Mesh],
    spectra: tuple[Spectrum, Spectrum],
    init: str,
    partial: bool,
) -> Int64[np.ndarray, " m"]:
    """Returns the initial map X -> Y, by a descriptor or from a directory."""
    if init in get_args(Start):
        return initial_map(*meshes, *spectra, init=init, partial=partial)
    given = read_published_map(Path(init), names, meshes)
    return initial_map(*meshes, *spectra, init=given, partial=partial)


def _reverse_start(
    data: DataPair,
    meshes: tuple[Mesh, Mesh],
    spectra: tuple[Spectrum, Spectrum],
    init: str,
    start: Int64[np.ndarray, " m"],
) -> Int64[np.ndarray, " n"]:
    """Returns the initial map Y -> X, of the same kind as the initial map X -> Y.

    If the directory has no map Y -> X, the functional map of the initial map X -> Y gives the map Y -> X.
    """
    names = data.target, data.source
    if init in get_args(Start) or published_file(Path(init), names).is_file():
        return _start(names, meshes[::-1], spectra[::-1], init, data.partial)
    spectrum_x, spectrum_y = (spectrum.truncate(FIRST_EIGENVECTORS) for spectrum in spectra)
    functional_map = encode(jnp.asarray(start), spectrum_x, spectrum_y)
    embeddings = spectral_embeddings(functional_map, spectrum_x, spectrum_y)
    reverse = nearest_neighbor(*embeddings[::-1], database_mask=spectrum_x.mask)
    return np.asarray(reverse).astype(np.int64)
