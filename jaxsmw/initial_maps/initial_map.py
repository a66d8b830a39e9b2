"""The computation of the initial map of a pair."""

from __future__ import annotations

from typing import get_args

import numpy as np
from jaxtyping import Float, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import InitialMap
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import SampledPair, sample_pair
from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import SurfacePoints, check_indices, check_surface_points
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.initial_maps.alignment import aligned_features
from jaxsmw.initial_maps.functional import functional_features
from jaxsmw.initial_maps.landmarks import check_landmarks, landmark_features
from jaxsmw.initial_maps.nearest import nearest_map
from jaxsmw.initial_maps.signatures import SIGNATURES, signature_features
from jaxsmw.pair import Pair

INITIAL_MAPS: tuple[InitialMap, ...] = get_args(InitialMap)
"""The names of the initial maps."""


def initial_map(
    pair: Pair,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    init: InitialMap | ArrayLike | SurfacePoints = "shot",
    sampled: SampledPair | None = None,
) -> Int64[np.ndarray, " m"]:
    """Compute the pointwise map T: X -> Y from which refinement begins.

    On a mesh with more than 15 000 vertices, descriptors are computed and compared only at about 10 000
    evenly spread samples. Vertices of X that are not samples receive the match of the nearest sample. An
    unreferenced vertex of X receives the match of the nearest referenced vertex.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices), a `Pair`.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y in comparable units, each a `Spectrum` from
      `paired_spectra`.
    - `init`: the name of a method, a given map, or landmarks.
        - `"shot"`: nearest neighbours in SHOT descriptors, which distinguish left from right.
        - `"wks"`, `"hks"`, `"wavelet"`: nearest neighbours in the wave kernel signature, the heat kernel
          signature or the wavelet signature, which do not distinguish left from right.
        - `"functional"`: a pointwise map computed from a functional map that preserves SHOT and commutes with
          the Laplacian.
        - `"aligned"`: nearest neighbours in SHOT descriptors and in space, after X was scaled to the area of
          Y and aligned rigidly. Use this map for rigid shapes such as teeth and bones.
        - an integer array (m,): a given pointwise map, as 0-based vertices of Y.
        - a `SurfacePoints` with m points on Y: a map to points on faces. Each point is replaced by the
          nearest corner of its face.
        - an integer array (l, 2): landmarks, with a vertex of X and its match on Y in each row, both 0-based.
          The initial map is then computed by nearest-neighbour search in SHOT and in geodesic distances to
          the landmarks.
    - `sampled`: the `SampledPair` that `jaxsmw.descriptors.sample_pair` returns for this pair, if it was
      already computed.

    **Returns:** The initial map as an integer array (m,), 0-based vertices of Y. With SHOT, the function
    issues a `UserWarning` if a mesh is too coarse for SHOT at more than 1 % of its vertices.

    **Raises:** `InputError` for an unknown name, an array that is neither a map nor landmarks, or indices
    that are out of range or belong to unreferenced vertices. `InputError` is also raised for a spectrum of
    another mesh, a mesh that is too coarse for SHOT, or signatures that are not finite. `ArithmeticError` if
    the functional map of `"functional"` cannot be computed.
    """
    given = check_initial_map(pair, init)
    if isinstance(given, np.ndarray) and given.ndim == 1:
        return extend_to_unreferenced(pair.mesh_x, given)
    sampled = sampled or sample_pair(pair, spectrum_x, spectrum_y)
    if isinstance(given, str):
        return extend_to_unreferenced(pair.mesh_x, nearest_map(sampled, *_features(sampled, given)))
    found = nearest_map(sampled, *_finite(sampled, "landmark", landmark_features(sampled, given)))
    found[given[:, 0]] = given[:, 1]
    return extend_to_unreferenced(pair.mesh_x, found)


def check_initial_map(
    pair: Pair, init: InitialMap | ArrayLike | SurfacePoints
) -> InitialMap | Int64[np.ndarray, " m"] | Int[np.ndarray, "l 2"]:
    """Check the argument `init` of `initial_map` without computing anything on the meshes.

    **Returns:** The name of a method, a map (m,) of 0-based vertices of Y, or landmarks (l, 2). A
    `SurfacePoints` becomes a map to the nearest corners.

    **Raises:** `InputError` for an unknown name, an array that is neither a map nor landmarks, or indices
    that are out of range or belong to unreferenced vertices.
    """
    if isinstance(init, SurfacePoints):
        init = check_surface_points(init, pair.mesh_y, "initial map").nearest_corners(pair.mesh_y)
    if isinstance(init, str):
        if init not in INITIAL_MAPS:
            raise InputError(
                f"{init!r} is not an initial map: choose {', '.join(INITIAL_MAPS)}, or give landmarks or a "
                "map."
            )
        return init
    given = np.asarray(init)
    if not np.issubdtype(given.dtype, np.integer):
        raise InputError(
            f"the initial map has type {given.dtype}, but must be integer vertex indices: convert the map to "
            "integers."
        )
    if given.ndim == 1:
        return _checked_map(pair, init)
    check_landmarks(pair, given)
    return given


_Features = tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]


def _features(sampled: SampledPair, init: InitialMap) -> _Features:
    """Compute the features of both shapes for the initial map of the given name."""
    if init == "shot":
        features = sampled.shot
    elif init in SIGNATURES:
        features = signature_features(sampled, init)
    elif init == "functional":
        features = functional_features(sampled)
    else:
        features = aligned_features(sampled)
    return _finite(sampled, init, features)


def _finite(sampled: SampledPair, init: str, features: _Features) -> _Features:
    """Return the features, after a check that all entries are finite."""
    if all(np.isfinite(of_shape).all() for of_shape in features):
        return features
    raise InputError(
        f"{sampled.pair.name}: {init} descriptors are not defined on these meshes with "
        f"{len(sampled.x.spectrum.eigenvalues)} eigenvectors: compute more eigenvectors, or choose another "
        "initial map."
    )


def _checked_map(pair: Pair, init: ArrayLike) -> Int64[np.ndarray, " m"]:
    mesh_x, mesh_y = pair.meshes
    given = check_indices(init, len(mesh_y.vertices), f"initial map on {mesh_y.name}: vertex")
    if len(given) != (m := len(mesh_x.vertices)):
        raise InputError(
            f"the initial map has {len(given)} entries, but {mesh_x.name} has {m} vertices: give one entry "
            "for each vertex."
        )
    unused = ~mesh_y.referenced_vertices[given] & mesh_x.referenced_vertices
    if unused.any():
        raise InputError(
            f"the initial map sends {unused.sum()} vertices to vertices of {mesh_y.name} that are in no "
            f"face, for example vertex {np.flatnonzero(unused)[0]} to vertex {given[unused][0]}: choose "
            "vertices in faces."
        )
    return given
