"""Initial maps, from which refinement begins: nearest neighbours in features, or given maps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import get_args

import numpy as np
from jaxtyping import Float, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import DEFAULT_INITIAL_MAP, InitialMap
from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.alignment import align_rigidly, oriented_points
from jaxsmw.geometry.geodesics import geodesic_distances
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.geometry.sampling import poisson_disk_samples
from jaxsmw.geometry.surface_points import SurfacePoints, check_pointwise_map, check_surface_points
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.shape import PreparedShape

INITIAL_MAPS: tuple[InitialMap, ...] = get_args(InitialMap)
"""The names of the initial maps."""


def initial_map(
    pair: Pair,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    init: InitialMap | ArrayLike | SurfacePoints = DEFAULT_INITIAL_MAP,
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
        - `"positions"`: nearest neighbours in the given positions and in normals, for meshes that are already
          aligned in one frame, in the same unit of length.
        - an integer array (m,): a given pointwise map, as 0-based vertices of Y.
        - a `SurfacePoints` with m points on Y: a map to points on faces. Each point is replaced by the
          nearest corner of its face.
        - an integer array (l, 2): landmarks, with a vertex of X and its match on Y in each row, both 0-based.
          The initial map is then computed by nearest-neighbour search in SHOT and in geodesic distances to
          the landmarks.

    **Returns:** The initial map as an integer array (m,), 0-based vertices of Y. With SHOT, the function
    issues a `UserWarning` if a mesh is too coarse for SHOT at more than 1 % of its vertices.

    **Raises:** `InputError` for an unknown name, an array that is neither a map nor landmarks, or indices
    that are out of range or belong to unreferenced vertices. `InputError` is also raised for a spectrum of
    another mesh, a mesh that is too coarse for SHOT, or signatures that are not finite. `ArithmeticError` if
    the functional map of `"functional"` cannot be computed.
    """
    return make_start(PreparedPair.from_spectra(pair, spectrum_x, spectrum_y), init).pointwise_map


def make_start(prepared: PreparedPair, init: InitialMap | ArrayLike | SurfacePoints) -> Start:
    """Return the start of a prepared pair from the initial map that `initial_map` describes."""
    init = check_initial_map(prepared.pair, init)
    mesh_x = prepared.pair.mesh_x
    if isinstance(init, str):
        matches = nearest_map(prepared, _finite(prepared, init, METHODS[init](prepared)))
        return Start(extend_to_unreferenced(mesh_x, matches), init)
    if init.ndim == 1:
        return Start(extend_to_unreferenced(mesh_x, init), "map")
    matches = nearest_map(prepared, _finite(prepared, "landmark", _landmark_features(prepared, init)))
    matches[init[:, 0]] = init[:, 1]
    return Start(extend_to_unreferenced(mesh_x, matches), "landmarks")


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
    _check_landmarks(pair, given)
    return given


_Features = tuple[Float[np.ndarray, "a d"], Float[np.ndarray, "b d"]]
"""Features of X (a, d) and of Y (b, d), with one row per compared vertex."""


def _finite(prepared: PreparedPair, name: str, features: _Features) -> _Features:
    if all(np.isfinite(of_shape).all() for of_shape in features):
        return features
    raise InputError(
        f"{prepared.pair.name}: {name} descriptors are not defined on these meshes with "
        f"{len(prepared.x.spectrum.eigenvalues)} eigenvectors: compute more eigenvectors, or choose another "
        "initial map."
    )


def _checked_map(pair: Pair, init: ArrayLike) -> Int64[np.ndarray, " m"]:
    mesh_x, mesh_y = pair.meshes
    matches = check_pointwise_map(init, mesh_x, mesh_y, "initial map")
    unused = ~mesh_y.referenced_vertices[matches] & mesh_x.referenced_vertices
    if unused.any():
        raise InputError(
            f"the initial map sends {unused.sum()} vertices to vertices of {mesh_y.name} that are in no "
            f"face, for example vertex {np.flatnonzero(unused)[0]} to vertex {matches[unused][0]}: "
            "choose vertices in faces."
        )
    return matches


def _shot_features(prepared: PreparedPair) -> _Features:
    return prepared.shot


def _signature_features(signature: Callable[[Spectrum], Array], prepared: PreparedPair) -> _Features:
    of_x, of_y = (np.asarray(signature(shape.compared_spectrum)) for shape in prepared.shapes)
    return of_x, of_y


# The weight of the commutativity with the Laplacian; the preservation of SHOT has weight 1. On eight pairs of
# real bodies, the mean geodesic error of the initial maps is 0.313 with weight 0, 0.076 with weight 1, 0.055
# with weight 10, and 0.052 with weight 100.
_COMMUTATIVITY = 10.0


def _functional_features(prepared: PreparedPair) -> _Features:
    """Compute spectral embeddings that are aligned by a functional map (section 3.2 of the MWP paper).

    **Raises:** `ArithmeticError` if the functional map cannot be computed.
    """
    import jax
    import jax.numpy as jnp

    from jaxsmw.core.solutions.descriptors import DescriptorPair
    from jaxsmw.core.solutions.regularized import RegularizedLeastSquares

    spectrum_x, spectrum_y = jax.device_put([shape.compared_spectrum for shape in prepared.shapes])
    dtype = spectrum_x.eigenvectors.dtype
    shot_x, shot_y = (jnp.asarray(descriptors, dtype) for descriptors in prepared.shot)
    on_samples = any(shape.compared is not None for shape in prepared.shapes)
    projected = DescriptorPair.project(
        shot_x, shot_y, spectrum_x, spectrum_y, pseudo_inverse="least_squares" if on_samples else "area"
    )
    solution = RegularizedLeastSquares(
        wavelet_preservation=None,
        orthogonality=None,
        descriptor_preservation=jnp.asarray(1.0, dtype),
        laplacian_commutativity=jnp.asarray(_COMMUTATIVITY, dtype),
        descriptors=projected,
    )
    functional_map, result = solution.minimize(None, spectrum_x.eigenvalues, spectrum_y.eigenvalues)
    if result != RESULTS.successful:
        raise ArithmeticError(f"{prepared.pair.name}: {sentence(result)}")
    embedded_x, embedded_y = spectral_embeddings(functional_map, spectrum_x, spectrum_y)
    return np.asarray(embedded_x), np.asarray(embedded_y)


# The alignment uses about this number of evenly spread samples per shape.
_SAMPLES = 2000
# The weight of positions relative to SHOT. Positions are in units of the square root of the area. (Entry R24)
_POSITION_WEIGHT = 3.0


def _aligned_features(prepared: PreparedPair) -> _Features:
    """Align X with Y rigidly, in comparable units, and append the weighted positions to SHOT."""
    positions, samples, normals = [], [], []
    for shape, unit in zip(prepared.shapes, prepared.pair.units_of_length, strict=True):
        scaled = shape.mesh.vertices / unit
        spread = poisson_disk_samples(shape.mesh, _SAMPLES)
        samples.append(scaled[spread.vertices])
        normals.append(shape.mesh.vertex_normals[spread.vertices])
        positions.append(shape.at_compared(scaled))
    motion = align_rigidly(samples[0], samples[1], normals[1])
    placed = motion.apply(positions[0]), positions[1]
    of_x, of_y = (
        np.hstack([shot, _POSITION_WEIGHT * where]) for shot, where in zip(prepared.shot, placed, strict=True)
    )
    return of_x, of_y


def _given_positions(prepared: PreparedPair) -> _Features:
    """Return the given positions and normals, for meshes that lie in one frame."""
    _, unit = prepared.pair.units_of_length

    def placed(shape: PreparedShape) -> Float[np.ndarray, "a 6"]:
        outward = -1 if shape.mesh.is_inside_out else 1
        # Positions far from the origin would have rounding errors in float32.
        positions = (shape.mesh.vertices - prepared.y.mesh.middle) / unit
        return shape.at_compared(oriented_points(positions, outward * shape.mesh.vertex_normals))

    return placed(prepared.x), placed(prepared.y)


METHODS: dict[InitialMap, Callable[[PreparedPair], _Features]] = {
    "shot": _shot_features,
    "wks": partial(_signature_features, wave_kernel_signature),
    "hks": partial(_signature_features, heat_kernel_signature),
    "wavelet": partial(_signature_features, wavelet_signature),
    "functional": _functional_features,
    "aligned": _aligned_features,
    "positions": _given_positions,
}
"""A dictionary from the name of each initial map to the function that computes its features.

The features of X (a, d) and of Y (b, d) at the compared vertices are matched by nearest neighbours.
"""

# Distances to landmarks, in units of the square root of the area, are multiplied by this weight. A distance
# of half a unit becomes 1, which is the norm of a SHOT descriptor. On pairs of real bodies, weights from 1 to
# 3 give nearly the same maps.
_LANDMARK_WEIGHT = 2.0
# This finite value replaces the infinite distance between two connected components. It is larger than any
# distance within a component.
_ELSEWHERE = 100.0


def _landmark_features(prepared: PreparedPair, landmarks: Int[np.ndarray, "l 2"]) -> _Features:
    """Append the weighted geodesic distances to all landmarks to SHOT."""
    features = []
    units = prepared.pair.units_of_length
    for shape, vertices, unit, shot in zip(prepared.shapes, landmarks.T, units, prepared.shot, strict=True):
        distances = geodesic_distances(shape.mesh, vertices.astype(np.int64)).T / unit
        distances = _LANDMARK_WEIGHT * np.where(np.isfinite(distances), distances, _ELSEWHERE)
        features.append(np.hstack([shot, shape.at_compared(distances)]))
    return features[0], features[1]


def _check_landmarks(pair: Pair, landmarks: np.ndarray) -> None:
    if landmarks.shape[1:] != (2,) or not len(landmarks):
        raise InputError(
            f"the initial map is an array of shape {landmarks.shape}: give shape (m,) for a map, or (l, 2) "
            "for landmarks."
        )
    for vertex in landmarks[:, 0]:
        if len(matches := np.unique(landmarks[landmarks[:, 0] == vertex, 1])) > 1:
            raise InputError(
                f"landmark {vertex} of {pair.mesh_x.name} has two matches, {matches[0]} and {matches[1]} of "
                f"{pair.mesh_y.name}: remove one of them."
            )
    for mesh, vertices in zip(pair.meshes, landmarks.T, strict=True):
        outside = (vertices < 0) | (vertices >= len(mesh.vertices))
        if outside.any() or not mesh.referenced_vertices[vertices].all():
            wrong = vertices[outside] if outside.any() else vertices[~mesh.referenced_vertices[vertices]]
            raise InputError(
                f"landmark {wrong[0]} is not a vertex in a face of {mesh.name}: choose a vertex in a face, "
                f"from 0 to {len(mesh.vertices) - 1}."
            )


# The number of queries that `check_nearest` checks, and the tolerance relative to the squared norms.
_CHECKED_QUERIES, _TOLERANCE = 32, 1e-4


def check_nearest(
    queries: Float[np.ndarray, "a d"],
    database: Float[np.ndarray, "b d"],
    usable: Int64[np.ndarray, " u"],
    nearest: Int64[np.ndarray, " a"],
) -> None:
    """Check a few results of a nearest-neighbour search in float64, because all maps depend on this search.

    A broken installation, a broken processor or a compiler fault would otherwise give a wrong map without a
    message. Points with NaN are not checked here.

    **Raises:** `ArithmeticError` if a result is not usable, or is farther than the nearest row by more than
    the rounding errors of float32.
    """
    rows = np.linspace(0, len(queries) - 1, _CHECKED_QUERIES).astype(int)
    few, all_rows = queries[rows].astype(np.float64), database[usable].astype(np.float64)
    sizes, size = (all_rows**2).sum(axis=1), (few**2).sum(axis=1)
    if not (np.isfinite(sizes).all() and np.isfinite(size).all()):
        return
    squared = size[:, None] - 2 * few @ all_rows.T + sizes
    reached = ((few - database[nearest[rows]].astype(np.float64)) ** 2).sum(axis=1)
    tolerance = _TOLERANCE * (size + sizes.max())
    if not (np.isin(nearest[rows], usable).all() and (reached <= squared.min(axis=1) + tolerance).all()):
        raise ArithmeticError(
            "wrong nearest neighbours were found, so numerical results of this installation cannot be "
            "trusted: install numpy, scipy, jax and jaxlib again, and unset XLA_FLAGS and JAX_PLATFORMS."
        )


def nearest_map(prepared: PreparedPair, features: _Features) -> Int64[np.ndarray, " m"]:
    """Compute a pointwise map of all vertices of X (m,) by nearest-neighbour search in feature space.

    **Raises:** `ArithmeticError` if the search is wrong; see `check_nearest`.
    """
    x, y = prepared.shapes
    dtype, mask = y.spectrum.eigenvectors.dtype, np.asarray(y.compared_spectrum.mask)
    of_x, of_y = (of_shape.astype(dtype) for of_shape in features)
    xp = namespace(y.spectrum.eigenvectors)
    nearest = np.asarray(nearest_neighbor(xp.asarray(of_x), xp.asarray(of_y), database_mask=mask), np.int64)
    check_nearest(of_x, of_y, np.flatnonzero(mask), nearest)
    return x.everywhere(nearest if y.compared is None else y.compared.vertices[nearest])
