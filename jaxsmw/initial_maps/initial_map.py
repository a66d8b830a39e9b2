"""The choice of an initial map."""

from __future__ import annotations

from typing import get_args

import numpy as np
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import InitialMap
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import SampledPair, paired_shot, sample_pair
from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import SurfacePoints, check_indices, check_surface_points
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.initial_maps.functional import functional_features
from jaxsmw.initial_maps.landmarks import landmark_features
from jaxsmw.initial_maps.nearest import nearest_map
from jaxsmw.initial_maps.signatures import SIGNATURES, signature_features
from jaxsmw.pair import Pair

INITIAL_MAPS: tuple[InitialMap, ...] = get_args(InitialMap)
"""The initial maps that have a name."""


def initial_map(
    pair: Pair,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    init: InitialMap | ArrayLike | SurfacePoints = "shot",
) -> Int64[np.ndarray, " m"]:
    """The map T: X -> Y (m,) from which refinement starts; `match` explains the choices.

    On a mesh with more than 15 000 vertices, descriptors are computed and compared at about 10 000 evenly
    spread vertices. The other vertices of X get the match of the nearest of these.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: see `paired_spectra`.
    - `init`: a name, a map (m,) of vertices or `SurfacePoints` of Y, or landmarks (l, 2).

    **Raises:** `InputError` for an unknown name, or an array that is neither a map nor landmarks;
    `ArithmeticError` if the functional map of `"functional"` cannot be computed.
    """
    if isinstance(init, SurfacePoints):
        init = check_surface_points(init, pair.mesh_y, "initial map").nearest_corners(pair.mesh_y)
    if isinstance(init, str):
        sampled = sample_pair(pair, spectrum_x, spectrum_y)
        return extend_to_unreferenced(pair.mesh_x, nearest_map(sampled, *_features(sampled, init)))
    given = np.asarray(init)
    if not np.issubdtype(given.dtype, np.integer):
        raise InputError(f"the initial map has type {given.dtype}; it must be integer vertex indices.")
    if given.ndim == 1:
        return extend_to_unreferenced(pair.mesh_x, _checked_map(pair, init))
    sampled = sample_pair(pair, spectrum_x, spectrum_y)
    found = nearest_map(sampled, *_finite(sampled, "landmark", landmark_features(sampled, given)))
    found[given[:, 0]] = given[:, 1]
    return extend_to_unreferenced(pair.mesh_x, found)


_Features = tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]


def _features(sampled: SampledPair, init: str) -> _Features:
    """The features of both shapes by which a named initial map compares vertices."""
    if init == "shot":
        features = paired_shot(sampled)
    elif init in SIGNATURES:
        features = signature_features(sampled, init)
    elif init == "functional":
        features = functional_features(sampled)
    else:
        raise InputError(
            f"{init!r} is not an initial map: choose {', '.join(INITIAL_MAPS)}, landmarks or a map."
        )
    return _finite(sampled, init, features)


def _finite(sampled: SampledPair, init: str, features: _Features) -> _Features:
    if all(np.isfinite(of_shape).all() for of_shape in features):
        return features
    raise InputError(
        f"{sampled.pair.name}: {init} descriptors are not defined on these meshes with "
        f"{len(sampled.x.spectrum.eigenvalues)} eigenvectors; ask for more eigenvectors, or give another "
        "initial map."
    )


def _checked_map(pair: Pair, init: ArrayLike) -> Int64[np.ndarray, " m"]:
    mesh_x, mesh_y = pair.meshes
    given = check_indices(init, len(mesh_y.vertices), f"initial map on {mesh_y.name}: vertex")
    if len(given) != (m := len(mesh_x.vertices)):
        raise InputError(f"the initial map has {len(given)} entries, but {mesh_x.name} has {m} vertices.")
    unused = ~mesh_y.referenced_vertices[given] & mesh_x.referenced_vertices
    if unused.any():
        raise InputError(
            f"the initial map sends {unused.sum()} vertices to vertices of {mesh_y.name} that no face uses, "
            f"for example {np.flatnonzero(unused)[0]} to {given[unused][0]}; send them to the surface."
        )
    return given
