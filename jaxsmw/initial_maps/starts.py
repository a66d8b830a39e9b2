"""Where refinement starts: maps by descriptors, landmarks, functional maps, the ends of limbs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial as partial_function
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import InitialMap
from jaxsmw.core.functional_map import encode, multiscale_kernel
from jaxsmw.core.pointwise_map import chosen_patches, decode, spectral_embeddings
from jaxsmw.core.refinement import WaveletPreservation
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.core.solutions import DescriptorPair, RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import Compared, compared, paired_shot
from jaxsmw.errors import InputError
from jaxsmw.geometry.geodesics import SurfacePoints, check_indices, check_surface_points, geodesic_distances
from jaxsmw.geometry.mesh import Mesh, extend_to_unused, units_of_length
from jaxsmw.geometry.sampling import farthest_point_samples, spread_samples
from jaxsmw.geometry.shot import SHOT_RADIUS
from jaxsmw.presets import Outcome, Stage, doubt, fitting, run_stage
from jaxsmw.repair.extremities import extremities, likely_pairings
from jaxsmw.repair.faults import alike, distinct, flaw
from jaxsmw.runtime.batches import pad_rows, padded_size
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.threads import side_by_side

Start = InitialMap

_SIGNATURES = {
    "wks": wave_kernel_signature,
    "hks": heat_kernel_signature,
    "wavelet": wavelet_signature,
}

# Distances to landmarks beside SHOT descriptors, which are unit vectors: 1/2 sqrt(area) weighs as much as a
# SHOT descriptor's length. Between 1 and 3 the starts on real pairs hardly change.
_LANDMARK_WEIGHT = 2.0
# Commutativity with the Laplacian beside preservation of SHOT in the functional start. On eight real pairs
# the mean error of the start was 0.055 for 10, 0.052 for 100, 0.076 for 1, and 0.313 without it.
_START_COMMUTATIVITY = 10.0


def initial_map(
    mesh_x: Mesh,
    mesh_y: Mesh,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    init: Start | ArrayLike | SurfacePoints = "shot",
    partial: bool = False,
) -> Int64[np.ndarray, " m"]:
    """The map T: X -> Y (m,) that refinement starts from; `match` explains the choices.

    The spectra are those of `paired_spectra`, and `partial` is what was said there. On a mesh of more than
    15 000 vertices descriptors are computed and compared at about 10 000 evenly spread ones, and every other
    vertex of X takes the match of the nearest of them.

    **Raises:** `InputError` for an unknown descriptor, or an array that is neither a map nor landmarks;
    `ArithmeticError` if numbers went wrong on the way to `"functional"`.
    """
    if isinstance(init, SurfacePoints):
        init = check_surface_points(init, mesh_y, "initial map").nearest_corners(mesh_y)
    if not isinstance(init, str):
        given = np.asarray(init)
        if not np.issubdtype(given.dtype, np.integer):
            raise InputError(f"the initial map has type {given.dtype}; it must be integer vertex indices.")
        if given.ndim == 1:
            return extend_to_unused(mesh_x, _checked_map(init, mesh_x, mesh_y))
    x, y = compared(mesh_x, mesh_y, spectrum_x, spectrum_y)
    if not isinstance(init, str):
        features_x, features_y = _landmark_features(given, x, y, partial)
    elif init == "shot":
        features_x, features_y = paired_shot(x, y, partial)
    elif init in _SIGNATURES:
        features_x, features_y = (np.asarray(_SIGNATURES[init](side.spectrum)) for side in (x, y))
    elif init == "functional":
        features_x, features_y = _functional_embeddings(x, y, paired_shot(x, y, partial))
    else:
        raise InputError(
            f"{init!r} is no initial map: choose shot, {', '.join(_SIGNATURES)}, functional, landmarks "
            "or a map."
        )
    if not np.isfinite(features_x).all() or not np.isfinite(features_y).all():
        raise InputError(
            f"{mesh_x.name} to {mesh_y.name}: {init!r} descriptors are not defined on these meshes with "
            f"{len(spectrum_x.eigenvalues)} eigenvectors; ask for more, or start from another map."
        )
    start = _nearest(features_x, features_y, x, y)
    if not isinstance(init, str):
        start[given[:, 0]] = given[:, 1]
    return extend_to_unused(mesh_x, start)


def other_starts(
    mesh_x: Mesh, mesh_y: Mesh, spectrum_x: Spectrum, spectrum_y: Spectrum, *, partial: bool = False
) -> Iterator[Int64[np.ndarray, " m"]]:
    """Initial maps, one by one, for when `init="shot"` fails: where one swaps limbs, another often does not.

    Three by way of functional maps: nearest neighbours of SHOT from Y to X, too, as a functional map,
    filtered like the paper's, and read back: first the mean of both directions, by neighbourhoods of several
    sizes side by side; then from Y to X alone, by the usual ones; then the mean of both by these.

    Of two whole bodies with descriptors (`describe`) two more, by the ends of their limbs, paired in all ways
    that distances between them allow: from each, nearest neighbours in SHOT and in distances to the ends,
    refined with few eigenvectors; the two least doubtful outcomes that are not alike.
    """
    x, y = compared(mesh_x, mesh_y, spectrum_x, spectrum_y)
    spectra = [spectrum.truncate(_PAPER_EIGENVECTORS) for spectrum in (spectrum_x, spectrum_y)]
    shot: dict[float, tuple[np.ndarray, np.ndarray]] = {}
    for radii, share_of_back in _OTHER_STARTS:
        for radius in radii:
            if radius not in shot:
                shot[radius] = paired_shot(x, y, partial, radius)
        features_x, features_y = (
            np.hstack(of_shape) for of_shape in zip(*(shot[radius] for radius in radii), strict=True)
        )
        there, back = _nearest(features_x, features_y, x, y), _nearest(features_y, features_x, y, x)
        share = spectra[0].eigenvalues.dtype.type(share_of_back)
        start = compiled(_both_ways)(*jax.device_put((there, back, share)), *spectra)
        yield extend_to_unused(mesh_x, np.asarray(start).astype(np.int64))
    if not partial and spectrum_x.descriptors is not None:
        yield from _starts_from_extremities(x, y, shot[SHOT_RADIUS], spectrum_x)


def _starts_from_extremities(
    x: Compared,
    y: Compared,
    shot: tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]],
    everything: Spectrum,
) -> Iterator[Int64[np.ndarray, " m"]]:
    """From `shot` of what is compared; judged by the spectrum of all of X."""
    fewest = min(int(side.mesh.used_vertices.sum()) for side in (x, y))
    stage = fitting(_ROUGHLY, fewest)
    m = len(x.spectrum.mask)
    # Refinement begins with a few eigenvectors, for which as many matches are enough.
    asking = spread_samples(x.mesh, stage.number_of_samples or fewest)
    rows = x.rows(asking.vertices)
    answered = asking.nearest if x.samples is None else asking.nearest[x.samples.vertices]
    spectrum_x, spectrum_y = (
        spectrum.pad(padded_size(len(spectrum.mask))) for spectrum in stage.view(x.spectrum, y.spectrum)
    )
    samples_x, samples_y = (
        jax.device_put(side.rows(farthest_point_samples(side.mesh, stage.number_of_samples or fewest)))
        for side in (x, y)
    )
    outcomes = []
    ends = side_by_side(lambda side: extremities(side.mesh), x, y)
    units = units_of_length(x.mesh, y.mesh, False)
    reach = [
        _reach(side, of_side.vertices, unit) for side, of_side, unit in zip((x, y), ends, units, strict=True)
    ]
    for pairing in likely_pairings(*ends, _PAIRINGS):
        features_x, features_y = (
            np.hstack([described, to_ends[:, chosen]])
            for described, to_ends, chosen in zip(shot, reach, pairing.T, strict=True)
        )
        nearest = _nearest_compared(features_x[rows], features_y, y)[answered]
        start = jax.device_put(pad_rows(nearest, len(spectrum_x.mask)))
        refinement = run_stage(
            stage, spectrum_x, start, spectrum_y=spectrum_y, samples=(samples_x, samples_y)
        )
        if refinement.result == RESULTS.successful:
            found = _everywhere(np.asarray(refinement.pointwise_map)[:m].astype(np.int64), x, y)
            flawed = flaw(x.mesh, y.mesh, found, everything)
            outcomes.append((doubt(Outcome([refinement], start, flawed)), found))
    outcomes.sort(key=lambda outcome: outcome[0])
    unlike = distinct((found for _, found in outcomes), partial_function(alike, x.mesh, y.mesh))
    for found in islice(unlike, _LEAST_DOUBTFUL):
        yield extend_to_unused(x.mesh, found)


# Enough to find the place of limbs.
_ROUGHLY = Stage(FeatureRegression((8, 8, 11, 11, 15, 15, 20, 20)), 20, 30, 8, 500)
_PAIRINGS, _LEAST_DOUBTFUL = 16, 2


# Radii, and how much the way back counts. Wide neighbourhoods see more of the body, in less detail.
_OTHER_STARTS = (
    ((SHOT_RADIUS, 2 * SHOT_RADIUS, 4 * SHOT_RADIUS), 0.5),
    ((SHOT_RADIUS,), 1.0),
    ((SHOT_RADIUS,), 0.5),
)
_PAPER_EIGENVECTORS = 100


def _both_ways(
    there: Int[Array, " m"],
    back: Int[Array, " n"],
    share: Float[Array, ""],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
) -> Int[Array, " m"]:
    """The map X -> Y of a mean of two functional maps, of a map there and of one back, which has a share."""
    responses = WaveletPreservation().problem(spectrum_x, spectrum_y).responses
    of_there, of_back = encode(there, spectrum_x, spectrum_y), encode(back, spectrum_y, spectrum_x).T
    mean = (1 - share) * of_there + share * of_back
    patches = chosen_patches("auto", spectrum_x, spectrum_y)
    return decode(mean * multiscale_kernel(*responses), spectrum_x, spectrum_y, patches=patches)


def _nearest(
    features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"], x: Compared, y: Compared
) -> Int64[np.ndarray, " m"]:
    """The nearest neighbours of all of X's vertices, from features of those that are compared."""
    return _everywhere(_nearest_compared(features_x, features_y, y), x, y)


def _nearest_compared(
    features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"], y: Compared
) -> Int64[np.ndarray, " a"]:
    dtype = y.spectrum.eigenvectors.dtype

    def padded(rows: np.ndarray) -> Array:
        return jax.device_put(pad_rows(rows, padded_size(len(rows))))

    nearest = compiled(nearest_neighbor)(
        *(padded(features.astype(dtype)) for features in (features_x, features_y)),
        database_mask=padded(np.asarray(y.spectrum.mask)),
    )
    return np.asarray(nearest)[: len(features_x)].astype(np.int64)


def _everywhere(found: Int64[np.ndarray, " a"], x: Compared, y: Compared) -> Int64[np.ndarray, " m"]:
    """A map between vertices that are compared, for all vertices of X."""
    if y.samples is not None:
        found = y.samples.vertices[found]
    return found if x.samples is None else found[x.samples.nearest]


def _functional_embeddings(
    x: Compared, y: Compared, shot: tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]
) -> tuple[Float[np.ndarray, "m k_x"], Float[np.ndarray, "n k_x"]]:
    """The `spectral_embeddings` of the functional map that preserves SHOT."""
    spectrum_x, spectrum_y = x.spectrum, y.spectrum
    dtype = spectrum_x.eigenvectors.dtype
    shot_x, shot_y = (jnp.asarray(descriptors, dtype) for descriptors in shot)
    solution = RegularizedLeastSquares(
        wavelet_preservation=None,
        orthogonality=None,
        descriptor_preservation=jnp.asarray(1.0, dtype),
        laplacian_commutativity=jnp.asarray(_START_COMMUTATIVITY, dtype),
        descriptors=DescriptorPair.project(shot_x, shot_y, spectrum_x, spectrum_y),
    )
    functional_map, result = solution.minimize(None, spectrum_x.eigenvalues, spectrum_y.eigenvalues)
    if result != RESULTS.successful:
        raise ArithmeticError(f"{x.mesh.name} to {y.mesh.name}: {sentence(result)}")
    embedded_x, embedded_y = spectral_embeddings(functional_map, spectrum_x, spectrum_y)
    return np.asarray(embedded_x), np.asarray(embedded_y)


def _checked_map(init: ArrayLike, mesh_x: Mesh, mesh_y: Mesh) -> Int64[np.ndarray, " m"]:
    given = check_indices(init, len(mesh_y.vertices), f"initial map on {mesh_y.name}: vertex")
    if len(given) != (m := len(mesh_x.vertices)):
        raise InputError(f"the initial map has {len(given)} entries, but {mesh_x.name} has {m} vertices.")
    unused = ~mesh_y.used_vertices[given] & mesh_x.used_vertices
    if unused.any():
        raise InputError(
            f"the initial map sends {unused.sum()} vertices to vertices of {mesh_y.name} that no face uses, "
            f"for example {np.flatnonzero(unused)[0]} to {given[unused][0]}; send them to the surface."
        )
    return given


def _landmark_features(
    landmarks: np.ndarray, x: Compared, y: Compared, partial: bool
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """SHOT, and geodesic distances to each landmark."""
    if landmarks.shape[1:] != (2,) or not len(landmarks):
        raise InputError(
            f"the initial map is an array of shape {landmarks.shape}; it must be (m,) for a map or (l, 2) "
            "for landmarks."
        )
    for vertex in landmarks[:, 0]:
        if len(twice := np.unique(landmarks[landmarks[:, 0] == vertex, 1])) > 1:
            raise InputError(
                f"vertex {vertex} of {x.mesh.name} is a landmark that is to be {twice[0]} and {twice[1]} of "
                f"{y.mesh.name}: keep one of them."
            )
    features = []
    units = units_of_length(x.mesh, y.mesh, partial)
    shot = paired_shot(x, y, partial)
    for side, vertices, unit, described in zip((x, y), landmarks.T, units, shot, strict=True):
        mesh = side.mesh
        outside = (vertices < 0) | (vertices >= len(mesh.vertices))
        if outside.any() or not mesh.used_vertices[vertices].all():
            wrong = vertices[outside] if outside.any() else vertices[~mesh.used_vertices[vertices]]
            raise InputError(
                f"landmark {wrong[0]} is no vertex of the surface of {mesh.name}, whose vertices are 0 to "
                f"{len(mesh.vertices) - 1}."
            )
        features.append(np.hstack([described, _reach(side, vertices.astype(np.int64), unit)]))
    return features[0], features[1]


def _reach(side: Compared, vertices: Int64[np.ndarray, " l"], unit: float) -> Float[np.ndarray, "n l"]:
    """Geodesic distances to vertices, as features beside SHOT."""
    distances = geodesic_distances(side.mesh, vertices).T / unit
    # Another component is farther than anything on the vertex's own.
    distances = _LANDMARK_WEIGHT * np.where(np.isfinite(distances), distances, 100.0)
    return distances if side.samples is None else distances[side.samples.vertices]
