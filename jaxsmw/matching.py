"""One pair from meshes to correspondence: the pieces of the library in their usual order."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int64, Shaped
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from jaxsmw.core.compilation import compile_ahead, compiled
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.pointwise_map import decode_to_triangles, spectral_embeddings
from jaxsmw.core.refinement import History, Refiner, WaveletPreservation, refine
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.core.solutions import DescriptorPair, RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.eigenbasis import Eigensolver, as_spectrum, choose_eigensolver, eigenpairs
from jaxsmw.geometry.geodesics import SurfacePoints, geodesic_distances
from jaxsmw.geometry.laplacian import Laplacian
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import Samples, farthest_point_samples, spread_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, shot_descriptors

logger = logging.getLogger("jaxsmw")

Side = TypeVar("Side")
Result = TypeVar("Result")
Start = Literal["shot", "wks", "hks", "wavelet", "functional"]

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


@dataclass(frozen=True, eq=False)
class Correspondence:
    """The outcome of `match`: for every vertex of X the vertex of Y that is the same point.

    **Attributes:**

    - `mesh_x`, `mesh_y`: source X (m vertices) and target Y (n vertices).
    - `pointwise_map`: T: X -> Y, (m,), 0-based vertices of Y.
    - `initial_map`: what it started from, (m,).
    - `functional_map`: the last C; (k, k), functions on Y to functions on X unless the refiner says
      otherwise.
    - `spectrum_x`, `spectrum_y`: the spectra it was computed with, for area 1.
    - `iterations`: how many were done.
    - `history`: a `jaxsmw.History` if asked for.
    - `seconds`: wall time of each stage. The first refinement of a size includes its compilation.
    """

    mesh_x: Mesh
    mesh_y: Mesh
    pointwise_map: Int64[np.ndarray, " m"]
    initial_map: Int64[np.ndarray, " m"]
    functional_map: Float[np.ndarray, "k_out k_in"]
    spectrum_x: Spectrum
    spectrum_y: Spectrum
    iterations: int
    history: History | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def surface_points(self, *, convention: Convention = "pullback") -> SurfacePoints:
        """For every vertex of X the point of Y that is the same, anywhere on Y's triangles (m points).

        By the functional map; see `jaxsmw.decode_to_triangles`. Faces are rows of `mesh_y.faces`. A vertex of
        X that no face uses gets the point of the nearest one that a face does use.

        **Arguments:**

        - `convention`: that of the refiner.
        """
        with jax.enable_x64(self.functional_map.dtype == np.float64):  # as when it was computed
            faces, traced_weights = compiled(decode_to_triangles)(
                jax.device_put(self.functional_map),
                self.spectrum_x,
                self.spectrum_y,
                jax.device_put(self.mesh_y.faces),
                convention=convention,
            )
        weights = np.maximum(np.asarray(traced_weights, np.float64), 0)  # without rounding errors
        return SurfacePoints(
            _extend_to_unused(self.mesh_x, np.asarray(faces).astype(np.int64)),
            _extend_to_unused(self.mesh_x, weights / weights.sum(axis=1, keepdims=True)),
        )


def match(
    mesh_x: Mesh,
    mesh_y: Mesh,
    *,
    init: Start | ArrayLike = "shot",
    number_of_eigenvectors: int = 100,
    refiner: Refiner = WaveletPreservation(),  # noqa: B008 (immutable)
    iterations: int = 3,
    number_of_samples: int | None = None,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    partial: bool = False,
    stop_when_unchanged: bool = False,
    history: bool = False,
) -> Correspondence:
    """Say for every vertex of one mesh which vertex of the other is the same point.

    Spectra of both meshes, an initial map, then `jaxsmw.refine`. Computed in JAX's default float type.
    Stages are logged to the logger `"jaxsmw"` as they begin.

    **Arguments:**

    - `mesh_x`, `mesh_y`: source X (m vertices) and target Y (n vertices).
    - `init`: where to start: `"shot"`, `"wks"`, `"hks"` or `"wavelet"` for nearest neighbours of that
      descriptor (only SHOT tells left from right); `"functional"` for the functional map that preserves
      SHOT and commutes with the Laplacian (section 3.2 of the MWP paper), smoother and much less wrong to
      begin with; an array (m,) of vertices of Y for a map of your own;
      an array (l, 2) of landmarks, a vertex of X and one of Y in each row, for nearest neighbours in SHOT
      and in geodesic distance to the landmarks (a few, on both sides of the body).
    - `number_of_eigenvectors`: k of both shapes.
    - `refiner`: the method, for example `WaveletPreservation(bank=Meyer(8))`.
    - `iterations`: how many; at least 1.
    - `number_of_samples`: iterate on so many farthest-point samples of each shape (more than k) and search
      all vertices in the last iteration only.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`.
    - `partial`: one mesh shows only a part of the other, in the same unit of length: see `paired_spectra`.
    - `stop_when_unchanged`, `history`: see `jaxsmw.refine`.

    **Returns:** A `Correspondence`. A vertex of X that no face uses gets the match of the nearest one that
    a face does use; unused vertices of Y are never matched.

    **Raises:** `InputError` for anything about the arguments that cannot work; `ArithmeticError` if numbers
    went wrong on the way.
    """
    if not isinstance(refiner, Refiner):
        raise InputError(
            f"refiner is {refiner!r}; give a Refiner such as WaveletPreservation(bank=Meyer(8))."
        )
    if iterations < 1:
        raise InputError(f"{iterations} iterations were asked for; at least 1 is needed.")
    if number_of_samples is not None and number_of_samples < number_of_eigenvectors:
        raise InputError(
            f"{number_of_samples} samples cannot tell {number_of_eigenvectors} eigenvectors apart; use more "
            "samples (five per eigenvector is usual) or fewer eigenvectors."
        )
    settings: dict[str, Any] = {
        "refiner": refiner,
        "iterations": iterations,
        "stop_when_unchanged": stop_when_unchanged,
        "history": history,
    }
    m, n = len(mesh_x.vertices), len(mesh_y.vertices)
    compiling = None
    # Of a part the number of eigenvectors comes out later; and who is to be refused should not wait.
    if not partial and 0 < number_of_eigenvectors < min(m, n):
        sizes = m, n, number_of_eigenvectors, number_of_samples
        compiling = compile_ahead(refine, lambda: _outlines(*sizes), **settings)
    seconds: dict[str, float] = {}
    with _stage("eigenbases", seconds):
        spectrum_x, spectrum_y = paired_spectra(
            mesh_x,
            mesh_y,
            number_of_eigenvectors,
            laplacian=laplacian,
            eigensolver=eigensolver,
            partial=partial,
        )
    for mesh, spectrum in ((mesh_x, spectrum_x), (mesh_y, spectrum_y)):
        if np.asarray(spectrum.eigenvalues)[-1] == 0:
            raise InputError(
                f"{mesh.name}: with {number_of_eigenvectors} eigenvectors nothing is known of it but which "
                "of its separate parts a vertex belongs to; ask for more of them than it has parts, or join "
                "vertices at the same position (weld=True, on the command line --weld)."
            )
    with _stage("initial map", seconds):
        start = initial_map(mesh_x, mesh_y, spectrum_x, spectrum_y, init=init, partial=partial)
    samples: dict[str, Any] = {}
    if number_of_samples is not None:
        with _stage("samples", seconds):
            for side, mesh in (("samples_x", mesh_x), ("samples_y", mesh_y)):
                samples[side] = jax.device_put(farthest_point_samples(mesh, number_of_samples))
    with _stage("refinement", seconds):
        if compiling is not None:
            wait([compiling])
        refinement = jax.block_until_ready(
            compiled(refine)(spectrum_x, spectrum_y, jax.device_put(start), **samples, **settings)
        )
    if refinement.result != RESULTS.successful:
        raise ArithmeticError(f"{mesh_x.name} to {mesh_y.name}: {sentence(refinement.result)}")
    pointwise_map = np.asarray(refinement.pointwise_map).astype(np.int64)
    return Correspondence(
        mesh_x=mesh_x,
        mesh_y=mesh_y,
        pointwise_map=_extend_to_unused(mesh_x, pointwise_map),
        initial_map=start,
        functional_map=np.asarray(refinement.functional_map),
        spectrum_x=spectrum_x,
        spectrum_y=spectrum_y,
        iterations=int(refinement.iterations),
        history=refinement.history,
        seconds=seconds,
    )


def _outlines(
    m: int, n: int, k: int, number_of_samples: int | None
) -> tuple[tuple[Spectrum, Spectrum, Int[Array, " m"]], dict[str, Int[Array, " s"]]]:
    """The arrays that refinement gets, as far as their sizes."""
    x, y = (Spectrum(jnp.zeros(k), jnp.zeros((v, k)), jnp.zeros(v), jnp.zeros(v, bool)) for v in (m, n))
    names = () if number_of_samples is None else ("samples_x", "samples_y")
    return (x, y, jnp.zeros(m, int)), {name: jnp.zeros(number_of_samples, int) for name in names}


def paired_spectra(
    mesh_x: Mesh,
    mesh_y: Mesh,
    number_of_eigenvectors: int,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    partial: bool = False,
) -> tuple[Spectrum, Spectrum]:
    """The spectra of two meshes as they are matched.

    Of two whole bodies each is scaled to area 1, so that a difference in size cancels. Where one is a part of
    the other the larger is, and the other by the same factor; then both are cut where the first of them
    ends (`common_range`), so that k_X and k_Y differ.

    **Raises:** `InputError` if one cannot be computed (see `jaxsmw.compute_spectrum`).
    """
    if eigensolver == "auto":  # the same for both, whose spectra are compared
        eigensolver = choose_eigensolver(mesh_x, mesh_y)
    pairs = _side_by_side(
        lambda mesh: eigenpairs(mesh, number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver),
        mesh_x,
        mesh_y,
    )
    # Out here, as threads do not inherit `jax.enable_x64`.
    spectrum_x, spectrum_y = as_spectrum(mesh_x, *pairs[0]), as_spectrum(mesh_y, *pairs[1])
    if not partial:
        return spectrum_x, spectrum_y
    larger = max(mesh_x.area, mesh_y.area)
    return common_range(spectrum_x.scale(mesh_x.area / larger), spectrum_y.scale(mesh_y.area / larger))


def common_range(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Spectrum, Spectrum]:
    """Two spectra cut at the smaller of their largest eigenvalues (MWP paper, partial shapes)."""
    spectra = spectrum_x, spectrum_y
    last = min(float(spectrum.eigenvalues[-1]) for spectrum in spectra)
    cut = [s.truncate(int((np.asarray(s.eigenvalues) <= last).sum())) for s in spectra]
    return cut[0], cut[1]


def initial_map(
    mesh_x: Mesh,
    mesh_y: Mesh,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    init: Start | ArrayLike = "shot",
    partial: bool = False,
) -> Int64[np.ndarray, " m"]:
    """The map T: X -> Y (m,) that refinement starts from; `match` explains the choices.

    The spectra are those of `paired_spectra`, and `partial` is what was said there. On a mesh of more than
    15 000 vertices descriptors are computed and compared at about 10 000 evenly spread ones, and every other
    vertex of X takes the match of the nearest of them.

    **Raises:** `InputError` for an unknown descriptor, or an array that is neither a map nor landmarks.
    """
    if not isinstance(init, str):
        given = np.asarray(init)
        if not np.issubdtype(given.dtype, np.integer):
            raise InputError(f"the initial map has type {given.dtype}; it must be integer vertex indices.")
        if given.ndim == 1:
            return _extend_to_unused(mesh_x, _checked_map(given, mesh_x, mesh_y))
    samples_x, samples_y = _side_by_side(_compared, mesh_x, mesh_y)
    x, y = _Thinned.make(mesh_x, samples_x, spectrum_x), _Thinned.make(mesh_y, samples_y, spectrum_y)
    if not isinstance(init, str):
        features_x, features_y = _landmark_features(given, x, y, partial)
    elif init == "shot":
        features_x, features_y = _shot(x, y, partial)
    elif init in _SIGNATURES:
        features_x, features_y = (np.asarray(_SIGNATURES[init](side.spectrum)) for side in (x, y))
    elif init == "functional":
        features_x, features_y = _functional_embeddings(x, y, _shot(x, y, partial))
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
    dtype = spectrum_x.eigenvectors.dtype
    nearest = compiled(nearest_neighbor)(
        *(jax.device_put(features.astype(dtype)) for features in (features_x, features_y)),
        database_mask=y.spectrum.mask,
    )
    start = np.asarray(nearest).astype(np.int64)
    if y.samples is not None:
        start = y.samples.vertices[start]
    if x.samples is not None:
        start = start[x.samples.nearest]
    if not isinstance(init, str):
        start[given[:, 0]] = given[:, 1]
    return _extend_to_unused(mesh_x, start)


class _Thinned(NamedTuple):
    """A shape, or where it has too many vertices to compare all, samples of it; `spectrum` is theirs."""

    mesh: Mesh
    samples: Samples | None
    spectrum: Spectrum

    @classmethod
    def make(cls, mesh: Mesh, samples: Samples | None, spectrum: Spectrum) -> _Thinned:
        if samples is not None:
            spectrum = spectrum.sample(jnp.asarray(samples.vertices))
        return cls(mesh, samples, spectrum)


# Descriptors tell no more apart than what is a few hundredths of the square root of the area away, for which
# ten thousand vertices are plenty.
_COMPARED, _COMPARED_FROM = 10_000, 15_000


def _compared(mesh: Mesh) -> Samples | None:
    return spread_samples(mesh, _COMPARED) if len(mesh.vertices) > _COMPARED_FROM else None


def _side_by_side(compute: Callable[[Side], Result], x: Side, y: Side) -> tuple[Result, Result]:
    """The same for both shapes, in two threads with one core each; what takes long lets the other go on."""
    # One limit around both: each would undo the other's at its end.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(2) as executor:
        futures = [executor.submit(copy_context().run, compute, side) for side in (x, y)]
        result_x, result_y = (future.result() for future in futures)
    return result_x, result_y


def _units_of_length(mesh_x: Mesh, mesh_y: Mesh, partial: bool) -> tuple[float, float]:
    """What descriptors measure lengths in: the square root of each area, of a partial pair the larger's."""
    areas = mesh_x.area, mesh_y.area
    return (max(areas) ** 0.5,) * 2 if partial else (areas[0] ** 0.5, areas[1] ** 0.5)


def _shot(
    x: _Thinned, y: _Thinned, partial: bool
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """SHOT of both shapes at one scale."""

    def describe(side: tuple[_Thinned, float]) -> Float[np.ndarray, "n d"]:
        (mesh, samples, _), unit = side
        return shot_descriptors(mesh, radius=SHOT_RADIUS * unit / mesh.area**0.5, samples=samples)

    units = _units_of_length(x.mesh, y.mesh, partial)
    return _side_by_side(describe, (x, units[0]), (y, units[1]))


def _functional_embeddings(
    x: _Thinned, y: _Thinned, shot: tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]
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


def _checked_map(given: np.ndarray, mesh_x: Mesh, mesh_y: Mesh) -> Int64[np.ndarray, " m"]:
    m, n = len(mesh_x.vertices), len(mesh_y.vertices)
    if len(given) != m:
        raise InputError(f"the initial map has {len(given)} entries, but {mesh_x.name} has {m} vertices.")
    if given.min() < 0 or given.max() >= n:
        raise InputError(
            f"the initial map runs from {given.min()} to {given.max()}, but the vertices of {mesh_y.name} "
            f"are 0 to {n - 1}; count from 0."
        )
    unused = ~mesh_y.used_vertices[given] & mesh_x.used_vertices
    if unused.any():
        raise InputError(
            f"the initial map sends {unused.sum()} vertices to vertices of {mesh_y.name} that no face uses, "
            f"for example {np.flatnonzero(unused)[0]} to {given[unused][0]}; send them to the surface."
        )
    return given.astype(np.int64)


def _landmark_features(
    landmarks: np.ndarray, x: _Thinned, y: _Thinned, partial: bool
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """SHOT, and geodesic distances to each landmark."""
    if landmarks.shape[1:] != (2,) or not len(landmarks):
        raise InputError(
            f"the initial map is an array of shape {landmarks.shape}; it must be (m,) for a map or (l, 2) "
            "for landmarks."
        )
    features = []
    units = _units_of_length(x.mesh, y.mesh, partial)
    shot = _shot(x, y, partial)
    for (mesh, samples, _), vertices, unit, described in zip((x, y), landmarks.T, units, shot, strict=True):
        outside = (vertices < 0) | (vertices >= len(mesh.vertices))
        if outside.any() or not mesh.used_vertices[vertices].all():
            wrong = vertices[outside] if outside.any() else vertices[~mesh.used_vertices[vertices]]
            raise InputError(
                f"landmark {wrong[0]} is no vertex of the surface of {mesh.name}, whose vertices are 0 to "
                f"{len(mesh.vertices) - 1}."
            )
        distances = geodesic_distances(mesh, vertices.astype(np.int64)).T / unit
        # Another component is farther than anything on the landmark's own.
        distances = np.where(np.isfinite(distances), distances, 100.0)
        if samples is not None:
            distances = distances[samples.vertices]
        features.append(np.hstack([described, _LANDMARK_WEIGHT * distances]))
    return features[0], features[1]


def _extend_to_unused(mesh_x: Mesh, matches: Shaped[np.ndarray, "m ..."]) -> Shaped[np.ndarray, "m ..."]:
    """Give vertices that no face uses the match of the nearest one that a face does use."""
    used = mesh_x.used_vertices
    if used.all():
        return matches
    _, nearest = KDTree(mesh_x.vertices[used]).query(mesh_x.vertices[~used])
    extended = matches.copy()
    extended[~used] = matches[used][nearest]
    return extended


@contextmanager
def _stage(name: str, seconds: dict[str, float]) -> Iterator[None]:
    logger.info(name)
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start
