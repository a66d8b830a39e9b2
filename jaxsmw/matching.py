"""One pair from meshes to correspondence: the pieces of the library in their usual order."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial as partial_function
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int64, Shaped
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from jaxsmw.core.compilation import compile_ahead, compiled
from jaxsmw.core.feature_regression import FeatureRegression
from jaxsmw.core.functional_map import encode, multiscale_kernel
from jaxsmw.core.pointwise_map import chosen_patches, decode, spectral_embeddings
from jaxsmw.core.refinement import Refinement, Refiner, WaveletPreservation, refine
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.search import nearest_neighbor, nearest_neighbor_in_patches
from jaxsmw.core.signatures import heat_kernel_signature, wave_kernel_signature, wavelet_signature
from jaxsmw.core.soft_maps import SoftMap, sinkhorn
from jaxsmw.core.solutions import DescriptorPair, RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_triangles
from jaxsmw.errors import InputError
from jaxsmw.geometry.assignment import one_to_one_map
from jaxsmw.geometry.eigenbasis import Eigensolver, as_spectrum, choose_eigensolver, eigenpairs
from jaxsmw.geometry.extremities import extremities, likely_pairings
from jaxsmw.geometry.faults import expected_error, flaw
from jaxsmw.geometry.geodesics import SurfacePoints, geodesic_distances
from jaxsmw.geometry.laplacian import Laplacian
from jaxsmw.geometry.mesh import Mesh, MeshLike, make_mesh, units_of_length
from jaxsmw.geometry.sampling import Samples, farthest_point_samples, spread_samples
from jaxsmw.geometry.shot import SHOT_RADIUS, shot_descriptors
from jaxsmw.presets import (
    Preset,
    Stage,
    chosen_stages,
    common_range,
    doubt,
    fitting,
    refine_in_stages,
    run_stage,
)

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
    - `stages`: what it was refined by.
    - `spectrum_x`, `spectrum_y`: the spectra that the last stage saw, for area 1.
    - `refinement`: the outcome of the last stage, with its history if asked for.
    - `iterations`: how many were done, in all stages.
    - `partial`: whether one shape is a part of the other.
    - `seconds`: wall time of each part. The first refinement of a size includes its compilation.
    """

    mesh_x: Mesh
    mesh_y: Mesh
    pointwise_map: Int64[np.ndarray, " m"]
    initial_map: Int64[np.ndarray, " m"]
    functional_map: Float[np.ndarray, "k_out k_in"]
    stages: tuple[Stage, ...]
    spectrum_x: Spectrum
    spectrum_y: Spectrum
    refinement: Refinement
    iterations: int
    partial: bool = False
    seconds: dict[str, float] = field(default_factory=dict)

    def surface_points(self) -> SurfacePoints:
        """For every vertex of X the point of Y that is the same, anywhere on Y's triangles (m points).

        Found like `pointwise_map`, but between Y's vertices as well; see `jaxsmw.decode_to_triangles`. Faces
        are rows of `mesh_y.faces`. A vertex of X that no face uses gets the point of the nearest one that a
        face does use.
        """
        with self._precision():
            faces, traced_weights = compiled(nearest_point_on_triangles)(
                *self._embeddings(), jax.device_put(self.mesh_y.faces)
            )
        weights = np.maximum(np.asarray(traced_weights, np.float64), 0)  # without rounding errors
        return SurfacePoints(np.asarray(faces).astype(np.int64), weights / weights.sum(axis=1, keepdims=True))

    def one_to_one(self) -> Int64[np.ndarray, " m"]:
        """For every vertex of X a vertex of Y (m,), no two on one; see `jaxsmw.one_to_one_map`.

        For shapes whose vertices correspond one by one; where triangulations differ, `pointwise_map` is
        nearer the truth, often by far. A vertex of X that no face uses shares the match of the nearest one
        that a face does use; the others share none.

        **Raises:** `InputError` if faces of X use more vertices than those of Y.
        """
        queries, database = (np.asarray(points) for points in self._embeddings())
        used = self.mesh_x.used_vertices
        found = one_to_one_map(queries, database, mask_x=used, mask_y=self.mesh_y.used_vertices)
        return _extend_to_unused(self.mesh_x, found)

    def soft_map(self, temperature: float = 0.3, *, iterations: int = 100, tolerance: float = 0.1) -> SoftMap:
        """How the area of X is spread over Y, every vertex of which gets its share; see `jaxsmw.sinkhorn`.

        For functions to be carried from Y to X smoothly (`SoftMap.pull_back`), and for a pointwise map that
        covers more of Y: on four remeshed FAUST pairs 76 to 82 instead of 69 to 75 % of its vertices, at
        errors from 4 % less to 2 % more. An iteration takes 0.2 seconds for 5000 vertices, and 20 are needed.

        A vertex of X that no face uses is mapped like the nearest one that a face does use. Warns if more of
        the area than `tolerance` is not yet where it belongs.

        **Arguments:**

        - `temperature`: 0.1 is sharper and takes more iterations, 1 is softer.
        - `iterations`, `tolerance`: see `jaxsmw.sinkhorn`. What goes on below a few hundredths is area
          that moves across the body, which gains nothing where bodies differ.

        **Raises:** `InputError` if the temperature is not positive, or there is to be no iteration.
        """
        if not temperature > 0 or iterations < 1:
            raise InputError(
                f"a soft map of temperature {temperature} after {iterations} iterations is none: give a "
                "positive temperature, such as 0.3, and at least 1 iteration."
            )
        with self._precision():
            found = compiled(sinkhorn)(
                *self._embeddings(),
                query_areas=self.spectrum_x.vertex_areas,
                database_areas=self.spectrum_y.vertex_areas,
                temperature=jnp.asarray(float(temperature)),
                iterations=iterations,
                tolerance=jnp.asarray(float(tolerance)),
            )
        if not found.converged:
            warnings.warn(
                f"the soft map is unfinished: after {iterations} iterations {float(found.residual):.3g} of "
                f"the area is not where it belongs, more than {tolerance:g}; allow more iterations, a higher "
                "temperature or a larger tolerance",
                stacklevel=2,
            )
        return found

    def expected_error(self) -> Float[np.ndarray, " m"]:
        """For every vertex of X how far its match may be from the truth, in square roots of Y's area.

        No truth is needed: `jaxsmw.geometry.faults.expected_error` explains, the way back is what the last
        stage finds. A vertex of X that no face uses gets that of the nearest one that a face does use.
        """
        with self._precision():
            way_back = compiled(_way_back)(*self._embeddings(), self.spectrum_x, self.spectrum_y)
        expected = expected_error(
            self.mesh_x,
            self.mesh_y,
            self.pointwise_map,
            np.asarray(way_back).astype(np.int64),
            self.spectrum_x,
            partial=self.partial,
        )
        return _extend_to_unused(self.mesh_x, expected)

    def _embeddings(self) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Points in which matches lie close together; unused vertices of X lie where the nearest do."""
        with self._precision():
            queries, database = compiled(_embeddings)(
                self.stages[-1].refiner, self.refinement.updated, self.spectrum_x, self.spectrum_y
            )
            return jax.device_put(_extend_to_unused(self.mesh_x, np.asarray(queries))), database

    def _precision(self) -> AbstractContextManager[None]:
        """As when the map was computed."""
        return jax.enable_x64(self.functional_map.dtype == np.float64)


def _way_back(
    queries: Float[Array, "m d"], database: Float[Array, "n d"], spectrum_x: Spectrum, spectrum_y: Spectrum
) -> Int[Array, " n"]:
    """The nearest vertex of X to each of Y, among points whose first coordinates depend on eigenvectors."""
    patches = chosen_patches("auto", spectrum_y, spectrum_x)
    if patches is None:
        return nearest_neighbor(database, queries, database_mask=spectrum_x.mask)
    k = spectrum_x.eigenvalues.shape[0]
    return nearest_neighbor_in_patches(database[:, :k], queries[:, :k], *patches)


def _embeddings(
    refiner: Refiner, updated: Any, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    return refiner.embeddings(refiner.prepare(spectrum_x, spectrum_y), updated)


def match(
    mesh_x: Mesh | MeshLike,
    mesh_y: Mesh | MeshLike,
    *,
    preset: Preset | Stage | Sequence[Stage] = "accurate",
    init: Start | ArrayLike = "shot",
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    partial: bool = False,
    history: bool = False,
) -> Correspondence:
    """Say for every vertex of one mesh which vertex of the other is the same point.

    Spectra of both meshes, an initial map, then the stages of a preset. Computed in JAX's default float type.
    What it is at is logged to the logger `"jaxsmw"`.

    **Arguments:**

    - `mesh_x`, `mesh_y`: source X (m vertices) and target Y (n vertices); or meshes of trimesh, pyFM, geomfum
      or PyVista, or tuples of vertices and faces, as `make_mesh` takes them.
    - `preset`: how the map is refined: `"accurate"`; `"paper"`, as the MWP paper has it; `"fast"`, the same
      on samples; or stages of your own, for example
      `Stage(WaveletPreservation(bank=Meyer(8)), number_of_eigenvectors=60)`. See `jaxsmw.PRESETS`, of which
      small meshes get as many eigenvectors and samples as they have vertices for.
    - `init`: where to start: `"shot"`, `"wks"`, `"hks"` or `"wavelet"` for nearest neighbours of that
      descriptor (only SHOT tells left from right); `"functional"` for the functional map that preserves
      SHOT and commutes with the Laplacian (section 3.2 of the MWP paper), smoother and much less wrong to
      begin with; an array (m,) of vertices of Y for a map of your own;
      an array (l, 2) of landmarks, a vertex of X and one of Y in each row, for nearest neighbours in SHOT
      and in geodesic distance to the landmarks (a few, on both sides of the body). After `"shot"` presets
      that mend try `jaxsmw.matching.other_starts`, too, if it looks as if limbs were still swapped.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`.
    - `partial`: one mesh shows only a part of the other, in the same unit of length: see `paired_spectra`.
    - `history`: record what happened in the last stage; see `jaxsmw.refine`.

    **Returns:** A `Correspondence`. A vertex of X that no face uses gets the match of the nearest one that
    a face does use; unused vertices of Y are never matched.

    **Raises:** `InputError` for anything about the arguments that cannot work; `ArithmeticError` if numbers
    went wrong on the way.
    """
    mesh_x, mesh_y = (
        mesh if isinstance(mesh, Mesh) else make_mesh(mesh, name=name)
        for mesh, name in ((mesh_x, "source mesh"), (mesh_y, "target mesh"))
    )
    m, n = len(mesh_x.vertices), len(mesh_y.vertices)
    fewest = min(int(mesh.used_vertices.sum()) for mesh in (mesh_x, mesh_y))
    stages = chosen_stages(preset, fewest, partial=partial)
    k = max(stage.number_of_eigenvectors for stage in stages)
    compiling = []
    # Of a part the number of eigenvectors comes out later; and who is to be refused should not wait.
    if not partial and 0 < k < min(m, n):
        for stage in stages:
            outlines = partial_function(_outlines, m, n, stage)
            compiling.append(compile_ahead(refine, outlines, **stage.settings, history=history))
    seconds: dict[str, float] = {}
    with _stage("eigenbases", seconds):
        spectrum_x, spectrum_y = paired_spectra(
            mesh_x, mesh_y, k, laplacian=laplacian, eigensolver=eigensolver, partial=partial
        )
    for mesh, spectrum in ((mesh_x, spectrum_x), (mesh_y, spectrum_y)):
        if np.asarray(spectrum.eigenvalues)[-1] == 0:
            raise InputError(
                f"{mesh.name}: with {k} eigenvectors nothing is known of it but which "
                "of its separate parts a vertex belongs to; ask for more of them than it has parts, or join "
                "vertices at the same position (weld=True, on the command line --weld)."
            )
    with _stage("initial map", seconds):
        start = initial_map(mesh_x, mesh_y, spectrum_x, spectrum_y, init=init, partial=partial)
    if number_of_descriptors := max(stage.number_of_descriptors for stage in stages):
        with _stage("descriptors", seconds):
            try:
                spectrum_x, spectrum_y = describe(
                    mesh_x, mesh_y, spectrum_x, spectrum_y, number_of_descriptors, partial=partial
                )
            except InputError as error:
                if not isinstance(preset, str):
                    raise
                warnings.warn(f"refinement goes on without descriptors: {error}", stacklevel=2)
                stages = tuple(stage.without_descriptors() for stage in stages)
    samples = None
    if number_of_samples := max(stage.number_of_samples or 0 for stage in stages):
        with _stage("samples", seconds):
            samples_x, samples_y = _side_by_side(
                lambda mesh: farthest_point_samples(mesh, number_of_samples), mesh_x, mesh_y
            )
            samples = jax.device_put(samples_x), jax.device_put(samples_y)
    spectra = [stage.view(spectrum_x, spectrum_y, partial=partial) for stage in stages]
    with _stage("refinement", seconds):
        wait(compiling)
        others: Iterable[Int64[np.ndarray, " m"]] = ()
        if isinstance(init, str) and init == "shot":
            others = other_starts(mesh_x, mesh_y, spectrum_x, spectrum_y, partial=partial)
        refinements, chosen = refine_in_stages(
            spectra,
            jax.device_put(start),
            stages,
            samples,
            meshes=(mesh_x, mesh_y),
            partial=partial,
            other_starts=map(jax.device_put, others),
            history=history,
        )
        last = jax.block_until_ready(refinements[-1])
    if last.result != RESULTS.successful:
        raise ArithmeticError(f"{mesh_x.name} to {mesh_y.name}: {sentence(last.result)}")
    return Correspondence(
        mesh_x=mesh_x,
        mesh_y=mesh_y,
        pointwise_map=_extend_to_unused(mesh_x, np.asarray(last.pointwise_map).astype(np.int64)),
        initial_map=np.asarray(chosen).astype(np.int64),
        functional_map=np.asarray(last.functional_map),
        stages=stages,
        spectrum_x=spectra[-1][0],
        spectrum_y=spectra[-1][1],
        refinement=last,
        iterations=sum(int(refinement.iterations) for refinement in refinements),
        partial=partial,
        seconds=seconds,
    )


def _outlines(
    m: int, n: int, stage: Stage
) -> tuple[tuple[Spectrum, Spectrum, Int[Array, " m"]], dict[str, Int[Array, " s"]]]:
    """The arrays that a stage's refinement gets, as far as their sizes."""
    k, d = stage.number_of_eigenvectors, stage.number_of_descriptors
    x, y = (
        Spectrum(
            jnp.zeros(k),
            jnp.zeros((v, k)),
            jnp.zeros(v),
            jnp.zeros(v, bool),
            jnp.zeros((v, d)) if d else None,
        )
        for v in (m, n)
    )
    names = () if stage.number_of_samples is None else ("samples_x", "samples_y")
    return (x, y, jnp.zeros(m, int)), {name: jnp.zeros(stage.number_of_samples, int) for name in names}


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
    ends (`jaxsmw.presets.common_range`), so that k_X and k_Y differ.

    **Raises:** `InputError` if one cannot be computed (see `jaxsmw.compute_spectrum`), or a part would be too
    small to be one.
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
    if min(mesh_x.area, mesh_y.area) < _SMALLEST_PART * larger:
        raise InputError(
            f"{mesh_x.name} has area {mesh_x.area:.3g} and {mesh_y.name} {mesh_y.area:.3g}, so neither is a "
            "part of the other in the same unit of length: scale one of them."
        )
    return common_range(spectrum_x.scale(mesh_x.area / larger), spectrum_y.scale(mesh_y.area / larger))


def describe(
    mesh_x: Mesh,
    mesh_y: Mesh,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    number_of_descriptors: int,
    *,
    partial: bool = False,
) -> tuple[Spectrum, Spectrum]:
    """The spectra with descriptors: principal components of SHOT on both shapes together, of mean square 1.

    SHOT with the usual radius, and on meshes that are fine enough with one of two thirds, too, side by side.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`, `partial`: see `paired_spectra`.
    - `number_of_descriptors`: d, at most 352; the components in which the shapes' vertices differ most.
    """
    sides = _thinned(mesh_x, mesh_y, spectrum_x, spectrum_y)
    of_radii = [_shot(*sides, partial)]
    if min(len(side.mesh.vertices) for side in sides) >= _FINE:
        with suppress(InputError), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # where a mesh is too coarse for it, the usual one is enough
            of_radii.append(_shot(*sides, partial, _FINE_RADIUS))
    shot = [np.hstack(of_shape) for of_shape in zip(*of_radii, strict=True)]
    weights = [np.asarray(side.spectrum.vertex_areas, np.float64) for side in sides]
    both, weight = np.concatenate(shot), np.concatenate([w / w.sum() / 2 for w in weights])
    centered = both - weight @ both
    variances, directions = np.linalg.eigh(centered.T @ (weight[:, None] * centered))
    first = slice(None, -number_of_descriptors - 1, -1)
    scale = np.sqrt(np.maximum(variances[first], np.finfo(np.float64).tiny))
    components = np.split(centered @ directions[:, first] / scale, [len(shot[0])])
    described = []
    for spectrum, side, found in zip((spectrum_x, spectrum_y), sides, components, strict=True):
        everywhere = found if side.samples is None else found[side.samples.nearest]
        everywhere = everywhere * np.asarray(spectrum.mask)[:, None]
        described.append(spectrum.describe(jax.device_put(everywhere.astype(spectrum.eigenvectors.dtype))))
    return described[0], described[1]


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
    x, y = _thinned(mesh_x, mesh_y, spectrum_x, spectrum_y)
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
    start = _nearest(features_x, features_y, x, y)
    if not isinstance(init, str):
        start[given[:, 0]] = given[:, 1]
    return _extend_to_unused(mesh_x, start)


def other_starts(
    mesh_x: Mesh, mesh_y: Mesh, spectrum_x: Spectrum, spectrum_y: Spectrum, *, partial: bool = False
) -> Iterator[Int64[np.ndarray, " m"]]:
    """Initial maps, one by one, for when `init="shot"` fails: where one swaps limbs, another often does not.

    Three by way of functional maps: nearest neighbours of SHOT from Y to X, too, as a functional map,
    filtered like the paper's, and read back: first the mean of both directions, by neighbourhoods of several
    sizes side by side; then from Y to X alone, by the usual ones; then the mean of both by these.

    Of two whole bodies with descriptors (`describe`) two more, by the ends of their limbs, paired in all ways
    that distances between them allow: from each, nearest neighbours in SHOT and in distances to the ends,
    refined with few eigenvectors; the two least doubtful outcomes.
    """
    x, y = _thinned(mesh_x, mesh_y, spectrum_x, spectrum_y)
    spectra = [spectrum.truncate(_PAPER_EIGENVECTORS) for spectrum in (spectrum_x, spectrum_y)]
    shot: dict[float, tuple[np.ndarray, np.ndarray]] = {}
    for radii, share_of_back in _OTHER_STARTS:
        for radius in radii:
            if radius not in shot:
                shot[radius] = _shot(x, y, partial, radius)
        features_x, features_y = (
            np.hstack(of_shape) for of_shape in zip(*(shot[radius] for radius in radii), strict=True)
        )
        there, back = _nearest(features_x, features_y, x, y), _nearest(features_y, features_x, y, x)
        share = spectra[0].eigenvalues.dtype.type(share_of_back)
        start = compiled(_both_ways)(*jax.device_put((there, back, share)), *spectra)
        yield _extend_to_unused(mesh_x, np.asarray(start).astype(np.int64))
    if not partial and spectrum_x.descriptors is not None:
        yield from _starts_from_extremities(x, y)


def _starts_from_extremities(x: _Thinned, y: _Thinned) -> Iterator[Int64[np.ndarray, " m"]]:
    fewest = min(int(side.mesh.used_vertices.sum()) for side in (x, y))
    stage = fitting(_ROUGHLY, fewest)
    spectrum_x, spectrum_y = stage.view(x.spectrum, y.spectrum)
    samples_x, samples_y = (
        jax.device_put(side.rows(farthest_point_samples(side.mesh, stage.number_of_samples or fewest)))
        for side in (x, y)
    )
    eigenvectors = np.asarray(x.spectrum.eigenvectors)[x.rows(np.arange(len(x.mesh.vertices))), :_JUDGES]
    outcomes = []
    ends = _side_by_side(lambda side: extremities(side.mesh), x, y)
    for landmarks in likely_pairings(*ends, _PAIRINGS):
        start = _nearest_compared(*_landmark_features(landmarks, x, y, False), y)
        refinement = run_stage(
            stage, spectrum_x, jax.device_put(start), spectrum_y=spectrum_y, samples=(samples_x, samples_y)
        )
        if refinement.result == RESULTS.successful:
            found = _everywhere(np.asarray(refinement.pointwise_map).astype(np.int64), x, y)
            outcomes.append((doubt(refinement, flaw(x.mesh, y.mesh, found, eigenvectors)), found))
    outcomes.sort(key=lambda outcome: outcome[0])
    for _, found in outcomes[:_LEAST_DOUBTFUL]:
        yield _extend_to_unused(x.mesh, found)


# Enough to find the place of limbs; judged by as many eigenvectors as what `refine_in_stages` mends.
_ROUGHLY = Stage(FeatureRegression((8, 8, 11, 11, 15, 15, 20, 20)), 20, 60, 8, 1000)
_PAIRINGS, _LEAST_DOUBTFUL, _JUDGES = 16, 2, 50


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
    features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"], x: _Thinned, y: _Thinned
) -> Int64[np.ndarray, " m"]:
    """The nearest neighbours of all of X's vertices, from features of those that are compared."""
    return _everywhere(_nearest_compared(features_x, features_y, y), x, y)


def _nearest_compared(
    features_x: Float[np.ndarray, "a d"], features_y: Float[np.ndarray, "b d"], y: _Thinned
) -> Int64[np.ndarray, " a"]:
    dtype = y.spectrum.eigenvectors.dtype
    nearest = compiled(nearest_neighbor)(
        *(jax.device_put(features.astype(dtype)) for features in (features_x, features_y)),
        database_mask=y.spectrum.mask,
    )
    return np.asarray(nearest).astype(np.int64)


def _everywhere(found: Int64[np.ndarray, " a"], x: _Thinned, y: _Thinned) -> Int64[np.ndarray, " m"]:
    """A map between vertices that are compared, for all vertices of X."""
    if y.samples is not None:
        found = y.samples.vertices[found]
    return found if x.samples is None else found[x.samples.nearest]


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

    def rows(self, vertices: Int64[np.ndarray, " v"]) -> Int64[np.ndarray, " v"]:
        """Where what is known of vertices, or of the samples nearest to them, stands."""
        return vertices if self.samples is None else self.samples.nearest[vertices]


# Descriptors tell no more apart than what is a few hundredths of the square root of the area away, for which
# ten thousand vertices are plenty.
_COMPARED, _COMPARED_FROM = 10_000, 15_000
# A thousandth of a body's area shows nothing of its kind.
_SMALLEST_PART = 1e-3
# The smaller neighbourhoods hold ten vertices from this many on.
_FINE, _FINE_RADIUS = 2000, 2 / 3 * SHOT_RADIUS
# Descriptors of wider neighbourhoods vary more slowly.
_SPREAD = 2000


def _thinned(
    mesh_x: Mesh, mesh_y: Mesh, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> tuple[_Thinned, _Thinned]:
    samples_x, samples_y = _side_by_side(_compared, mesh_x, mesh_y)
    return _Thinned.make(mesh_x, samples_x, spectrum_x), _Thinned.make(mesh_y, samples_y, spectrum_y)


def _compared(mesh: Mesh) -> Samples | None:
    return spread_samples(mesh, _COMPARED) if len(mesh.vertices) > _COMPARED_FROM else None


def _side_by_side(compute: Callable[[Side], Result], x: Side, y: Side) -> tuple[Result, Result]:
    """The same for both shapes, in two threads with one core each; what takes long lets the other go on."""
    # One limit around both: each would undo the other's at its end.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(2) as executor:
        futures = [executor.submit(copy_context().run, compute, side) for side in (x, y)]
        result_x, result_y = (future.result() for future in futures)
    return result_x, result_y


def _shot(
    x: _Thinned, y: _Thinned, partial: bool, radius: float = SHOT_RADIUS
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """SHOT of both shapes at one scale."""

    def describe(side: tuple[_Thinned, float]) -> Float[np.ndarray, "n d"]:
        (mesh, samples, _), unit = side
        own_radius = radius * unit / mesh.area**0.5
        if radius <= SHOT_RADIUS or len(mesh.vertices) <= _SPREAD:
            return shot_descriptors(mesh, radius=own_radius, samples=samples)
        fewer = spread_samples(mesh, _SPREAD)
        nearest = fewer.nearest if samples is None else fewer.nearest[samples.vertices]
        return shot_descriptors(mesh, radius=own_radius, samples=fewer)[nearest]

    units = units_of_length(x.mesh, y.mesh, partial)
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
    units = units_of_length(x.mesh, y.mesh, partial)
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
