"""Starts: the initial maps from which refinement begins, each computed from features of both shapes."""

from __future__ import annotations

from collections.abc import Callable
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import InitialMap
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.core.solutions import DescriptorPair, RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.alignment import align_rigidly
from jaxsmw.geometry.geodesics import SurfacePoints, check_indices, check_surface_points, geodesic_distances
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.geometry.sampling import poisson_disk_samples
from jaxsmw.matching.descriptors import SampledPair, SampledShape, sample_pair
from jaxsmw.matching.pair import Pair
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size

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
    - `sampled`: the `SampledPair` that `jaxsmw.matching.descriptors.sample_pair` returns for this pair, if it
      was
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


SIGNATURES: dict[str, Callable[[Spectrum], Array]] = {
    "wks": wave_kernel_signature,
    "hks": heat_kernel_signature,
    "wavelet": wavelet_signature,
}
"""A dictionary from the name of each initial map to the function that computes its signature."""


def signature_features(
    sampled: SampledPair, name: str
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Compute a spectral signature on both shapes.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `name`: a key of `SIGNATURES`: `"wks"`, `"hks"` or `"wavelet"`.

    **Returns:** The signatures of X (m, d) and of Y (n, d), with one row per compared vertex.
    """
    signature = SIGNATURES[name]
    return np.asarray(signature(sampled.x.spectrum)), np.asarray(signature(sampled.y.spectrum))


# The weight of the commutativity with the Laplacian; the preservation of SHOT has weight 1. On eight pairs of
# real bodies, the mean geodesic error of the initial maps is 0.313 with weight 0, 0.076 with weight 1, 0.055
# with weight 10, and 0.052 with weight 100.
_COMMUTATIVITY = 10.0


def functional_features(
    sampled: SampledPair,
) -> tuple[Float[np.ndarray, "m k_x"], Float[np.ndarray, "n k_x"]]:
    """Compute spectral embeddings of both shapes, aligned by a functional map.

    The functional map is computed by least squares from two conditions: it should preserve SHOT and commute
    with the Laplacian (section 3.2 of the MWP paper).

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.

    **Returns:** The embeddings of X (m, k_X) and of Y (n, k_X), with one row per compared vertex.

    **Raises:** `ArithmeticError` if the functional map cannot be computed. `InputError` if a mesh is too
    coarse for SHOT.
    """
    spectrum_x, spectrum_y = sampled.x.spectrum, sampled.y.spectrum
    dtype = spectrum_x.eigenvectors.dtype
    shot_x, shot_y = (jnp.asarray(descriptors, dtype) for descriptors in sampled.shot)
    on_samples = any(shape.samples is not None for shape in sampled.sides)
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
        raise ArithmeticError(f"{sampled.pair.name}: {sentence(result)}")
    embedded_x, embedded_y = spectral_embeddings(functional_map, spectrum_x, spectrum_y)
    return np.asarray(embedded_x), np.asarray(embedded_y)


# The alignment uses about this number of evenly spread samples per shape.
_SAMPLES = 2000
# The weight of positions relative to SHOT. Positions are in units of the square root of the area. (Entry R24)
_POSITION_WEIGHT = 3.0


def aligned_features(sampled: SampledPair) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Align X with Y rigidly, and return SHOT and weighted positions of the compared vertices.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.

    **Returns:** The features of X (m, d) and of Y (n, d), with one row per compared vertex and d = 355.
    The positions of X are those after the alignment.

    **Raises:** `InputError` if a mesh is too coarse for SHOT.
    """
    return tuple(  # type: ignore[return-value]
        np.hstack([shot, _POSITION_WEIGHT * positions])
        for shot, positions in zip(sampled.shot, _aligned_positions(sampled), strict=True)
    )


def _aligned_positions(sampled: SampledPair) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "n 3"]]:
    """Align X with Y rigidly, in comparable units, and return the positions of the compared vertices.

    **Returns:** The positions of X after the alignment (m, 3) and of Y (n, 3), with one row per compared
    vertex, in the units of `Pair.units_of_length`.
    """
    positions, samples, normals = [], [], []
    for side, unit in zip(sampled.sides, sampled.pair.units_of_length, strict=True):
        scaled = side.mesh.vertices / unit
        spread = poisson_disk_samples(side.mesh, _SAMPLES)
        samples.append(scaled[spread.vertices])
        normals.append(side.mesh.vertex_normals[spread.vertices])
        positions.append(scaled if side.samples is None else scaled[side.samples.vertices])
    motion = align_rigidly(samples[0], samples[1], normals[1])
    return motion.apply(positions[0]), positions[1]


# Distances to landmarks, in units of the square root of the area, are multiplied by this weight. A distance
# of half a unit becomes 1, which is the norm of a SHOT descriptor. On pairs of real bodies, weights from 1 to
# 3 give nearly the same maps.
_WEIGHT = 2.0
# This finite value replaces the infinite distance between two connected components. It is larger than any
# distance within a component.
_ELSEWHERE = 100.0


def landmark_features(
    sampled: SampledPair, landmarks: np.ndarray
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Compute SHOT and the weighted geodesic distances to all landmarks, on both shapes.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `landmarks`: landmarks (l, 2) that `check_landmarks` has checked.

    **Returns:** The features of X (m, d) and of Y (n, d), where m and n are the numbers of compared vertices.
    The first 352 columns are SHOT, and the other l columns are distances.

    **Raises:** `InputError` if a mesh is too coarse for SHOT.
    """
    sides = zip(sampled.sides, landmarks.T, sampled.pair.units_of_length, sampled.shot, strict=True)
    of_x, of_y = (
        np.hstack([described, distance_features(side, vertices.astype(np.int64), unit)])
        for side, vertices, unit, described in sides
    )
    return of_x, of_y


def check_landmarks(pair: Pair, landmarks: np.ndarray) -> None:
    """Check that each row of an array of integers contains a vertex of X and its match on Y.

    **Raises:** `InputError` if `landmarks` does not have the shape (l, 2), or gives two matches to one vertex
    of X. `InputError` is also raised if a number in `landmarks` is not a referenced vertex.
    """
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


def distance_features(
    side: SampledShape, vertices: Int64[np.ndarray, " l"], unit: float
) -> Float[np.ndarray, "n l"]:
    """Compute weighted geodesic distances to given vertices, as features that are appended to SHOT.

    **Arguments:**

    - `side`: X or Y, as a `SampledShape`.
    - `vertices`: vertices of the mesh (l,), to which distances are computed.
    - `unit`: a length in the unit of the mesh, by which the distances are divided; see
      `Pair.units_of_length`.

    **Returns:** The weighted distances (n, l) from the n compared vertices to the l given vertices.
    """
    distances = geodesic_distances(side.mesh, vertices).T / unit
    distances = _WEIGHT * np.where(np.isfinite(distances), distances, _ELSEWHERE)
    return distances if side.samples is None else distances[side.samples.vertices]


def nearest_map(
    sampled: SampledPair, features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"]
) -> Int64[np.ndarray, " m"]:
    """Compute a pointwise map of all vertices of X by nearest-neighbour search in feature space.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `features_x`, `features_y`: the features of X (a, d) and of Y (b, d), with one row per compared vertex.

    **Returns:** The map T: X -> Y (m,), 0-based vertices of Y.
    """
    return to_all_vertices(sampled, nearest_among_compared(features_x, features_y, sampled.y))


def nearest_among_compared(
    features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"], y: SampledShape
) -> Int64[np.ndarray, " a"]:
    """Find the nearest row of `features_y` for every row of `features_x`.

    **Arguments:**

    - `features_x`: features (a, d) of X.
    - `features_y`: features (b, d) of Y, with one row per compared vertex.
    - `y`: the shape Y. Rows of masked vertices are never chosen.

    **Returns:** The row numbers in `features_y` (a,), 0-based.

    **Raises:** `ArithmeticError` if some of the found rows are not the nearest; see `_check_nearest`.
    """
    dtype = y.spectrum.eigenvectors.dtype

    def padded(rows: np.ndarray) -> Array:
        return jax.device_put(pad_rows(rows, padded_size(len(rows))))

    nearest = compiled(nearest_neighbor)(
        *(padded(features.astype(dtype)) for features in (features_x, features_y)),
        database_mask=padded(np.asarray(y.spectrum.mask)),
    )
    found = np.asarray(nearest)[: len(features_x)].astype(np.int64)
    usable = np.flatnonzero(np.asarray(y.spectrum.mask)[: len(features_y)])
    _check_nearest(features_x, features_y, usable, found)
    return found


def _check_nearest(
    queries: Float[np.ndarray, "a d"],
    database: Float[np.ndarray, "b d"],
    usable: Int64[np.ndarray, " u"],
    found: Int64[np.ndarray, " a"],
) -> None:
    """Check a few results of a nearest-neighbour search, because all maps depend on this search.

    NumPy computes the distances of some queries to the whole database in float64. A broken installation of
    JAX, a broken processor or a compiler fault would otherwise give a wrong map without a message.

    **Arguments:**

    - `queries`, `database`: the points, (a, d) and (b, d). Points with NaN are not checked here.
    - `usable`: the rows of the database that the search may return (u,).
    - `found`: the row of the database that the search returned for each query (a,).

    **Raises:** `ArithmeticError` if a result is not usable, or is farther than the nearest row by more than
    the rounding errors of float32.
    """
    rows = np.linspace(0, len(queries) - 1, _CHECKED_QUERIES).astype(int)
    few, all_rows = queries[rows].astype(np.float64), database[usable].astype(np.float64)
    sizes, size = (all_rows**2).sum(axis=1), (few**2).sum(axis=1)
    if not (np.isfinite(sizes).all() and np.isfinite(size).all()):
        return
    squared = size[:, None] - 2 * few @ all_rows.T + sizes
    reached = ((few - database[found[rows]].astype(np.float64)) ** 2).sum(axis=1)
    tolerance = _TOLERANCE * (size + sizes.max())
    if not (np.isin(found[rows], usable).all() and (reached <= squared.min(axis=1) + tolerance).all()):
        raise ArithmeticError(
            "JAX returned wrong nearest neighbours, so numerical results of this installation cannot be "
            "trusted: install jax and jaxlib again, and unset XLA_FLAGS and JAX_PLATFORMS."
        )


# The number of queries that `_check_nearest` checks, and the tolerance relative to the squared norms.
_CHECKED_QUERIES, _TOLERANCE = 32, 1e-4


def to_all_vertices(sampled: SampledPair, found: Int64[np.ndarray, " a"]) -> Int64[np.ndarray, " m"]:
    """Extend a map between compared vertices to a pointwise map of all vertices of X.

    **Arguments:**

    - `sampled`: the pair, and the vertices of both shapes at which descriptors are compared.
    - `found`: the match of each compared vertex of X (a,), as a 0-based index into the compared vertices of
      Y.

    **Returns:** The map T: X -> Y (m,), 0-based vertices of Y.
    """
    if sampled.y.samples is not None:
        found = sampled.y.samples.vertices[found]
    return found if sampled.x.samples is None else found[sampled.x.samples.nearest]
