"""One pair from meshes to correspondence: the pieces of the library in their usual order."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial as partial_function
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int64
from numpy.typing import ArrayLike

from jaxsmw.core.pointwise_map import chosen_patches
from jaxsmw.core.refinement import Refinement, Refiner, refine
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.search import nearest_neighbor, nearest_neighbor_in_patches
from jaxsmw.core.soft_maps import SoftMap, sinkhorn
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_triangles
from jaxsmw.descriptors import describe
from jaxsmw.errors import InputError
from jaxsmw.geometry.assignment import one_to_one_map
from jaxsmw.geometry.eigenbasis import Eigensolver, as_spectrum, choose_eigensolver, eigenpairs
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.laplacian import Laplacian
from jaxsmw.geometry.mesh import Mesh, MeshLike, extend_to_unused, make_mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.initial_maps.starts import Start, initial_map, other_starts
from jaxsmw.presets import SUSPICIOUS, Preset, Stage, chosen_stages, common_range, refine_in_stages
from jaxsmw.repair.faults import expected_error
from jaxsmw.runtime.batches import pad_rows, padded_size
from jaxsmw.runtime.compilation import compile_ahead, compiled, release_programs
from jaxsmw.runtime.threads import one_blas_thread, side_by_side

logger = logging.getLogger("jaxsmw")


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
    - `flaw`: how much the map stretches X and turns it inside out, 1 for isometries
      (`jaxsmw.repair.faults.flaw`); None where the preset does not look.
    - `suspicious`: whether limbs may be swapped, or the body turned round, by that.
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
    flaw: float | None = None
    suspicious: bool = False
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
        return extend_to_unused(self.mesh_x, found)

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

        No truth is needed: `jaxsmw.repair.faults.expected_error` explains, the way back is what the last
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
        return extend_to_unused(self.mesh_x, expected)

    def _embeddings(self) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Points in which matches lie close together; unused vertices of X lie where the nearest do."""
        with self._precision():
            queries, database = compiled(_embeddings)(
                self.stages[-1].refiner, self.refinement.updated, self.spectrum_x, self.spectrum_y
            )
            return jax.device_put(extend_to_unused(self.mesh_x, np.asarray(queries))), database

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
    init: Start | ArrayLike | SurfacePoints = "shot",
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
      begin with; an array (m,) of vertices of Y, or m `SurfacePoints`, for a map of your own;
      an array (l, 2) of landmarks, a vertex of X and one of Y in each row, for nearest neighbours in SHOT
      and in geodesic distance to the landmarks (a few, on both sides of the body). After `"shot"` presets
      that mend try `other_starts`, too, if it looks as if limbs were still swapped.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`.
    - `partial`: one mesh shows only a part of the other, in the same unit of length: see `paired_spectra`.
      (Presets tell their refiners; tell one of your own, as in `Registration(partial=True)`.)
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
    if not isinstance(partial, bool | np.bool):
        raise InputError(f"partial is {partial!r}; give True or False.")
    m, n = len(mesh_x.vertices), len(mesh_y.vertices)
    # Programs compiled for one pair serve all others of about its size.
    size_x, size_y = (size if size > _NOT_PADDED else padded_size(size) for size in (m, n))
    for mesh in (mesh_x, mesh_y):
        if (used := int(mesh.used_vertices.sum())) < _FEWEST_VERTICES:
            raise InputError(
                f"{mesh.name}: its faces use {used} vertices, too few to be matched by shape: give a mesh of "
                f"at least {_FEWEST_VERTICES}; of hundreds, for the result to mean anything."
            )
    fewest = min(int(mesh.used_vertices.sum()) for mesh in (mesh_x, mesh_y))
    stages = chosen_stages(preset, fewest, partial=partial)
    k = max(stage.number_of_eigenvectors for stage in stages)
    release_programs()
    compiling = []
    # Of a part the number of eigenvectors comes out later; and who is to be refused should not wait.
    if not partial and k < min(m, n):
        for stage in reversed(stages):  # the last ones take longest
            outlines = partial_function(_outlines, size_x, size_y, stage)
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
            samples_x, samples_y = side_by_side(
                lambda mesh: farthest_point_samples(mesh, number_of_samples), mesh_x, mesh_y
            )
            samples = jax.device_put(samples_x), jax.device_put(samples_y)
    pad = compiled(Spectrum.pad)
    padded = pad(spectrum_x, size_x), pad(spectrum_y, size_y)

    def from_host(start: Int64[np.ndarray, " m"]) -> Int[Array, " p"]:
        return jax.device_put(pad_rows(start, size_x))

    with _stage("refinement", seconds), one_blas_thread():
        wait(compiling)
        others: Iterable[Int64[np.ndarray, " m"]] = ()
        if isinstance(init, str) and init == "shot":
            others = other_starts(mesh_x, mesh_y, spectrum_x, spectrum_y, partial=partial)
        outcome = refine_in_stages(
            [stage.view(*padded, partial=partial) for stage in stages],
            from_host(start),
            stages,
            samples,
            meshes=(mesh_x, mesh_y),
            partial=partial,
            other_starts=map(from_host, others),
            history=history,
        )
        last = jax.block_until_ready(outcome.refinements[-1]).unpadded(m)
    if last.result != RESULTS.successful:
        raise ArithmeticError(f"{mesh_x.name} to {mesh_y.name}: {sentence(last.result)}")
    if outcome.suspicious:
        warnings.warn(
            f"{mesh_x.name} to {mesh_y.name}: limbs may be swapped, or the body turned round, for the map "
            f"has flaw {outcome.flaw:.3f} and right ones have up to {SUSPICIOUS} (more between bodies of "
            "different kinds, where one touches itself, or one is the mirror image of the other): look at it "
            "(--report, in Python jaxsmw.report.summary.write_report), and if it is so "
            f"{_what_may_help(init, partial)}",
            stacklevel=2,
        )
    spectrum_x, spectrum_y = stages[-1].view(spectrum_x, spectrum_y, partial=partial)
    return Correspondence(
        mesh_x=mesh_x,
        mesh_y=mesh_y,
        pointwise_map=extend_to_unused(mesh_x, np.asarray(last.pointwise_map).astype(np.int64)),
        initial_map=np.asarray(outcome.initial_map)[:m].astype(np.int64),
        functional_map=np.asarray(last.functional_map),
        stages=stages,
        spectrum_x=spectrum_x,
        spectrum_y=spectrum_y,
        refinement=last,
        iterations=sum(int(refinement.iterations) for refinement in outcome.refinements),
        flaw=outcome.flaw,
        suspicious=outcome.suspicious,
        partial=partial,
        seconds=seconds,
    )


def _what_may_help(init: Start | ArrayLike | SurfacePoints, partial: bool) -> str:
    """Where a map came out wrong."""
    more = not isinstance(init, str | SurfacePoints) and np.ndim(init) == 2
    landmarks = f"start from {'more' if more else 'a few'} landmarks"
    if partial:
        return f"{landmarks}, and see that both meshes have the same unit of length"
    return f"{landmarks}, or say that one is a part of the other if it is (partial=True, --partial)"


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
            positions=jnp.zeros((v, 3)),
            normals=jnp.zeros((v, 3)),
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
    pairs = side_by_side(
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


# From here on memory is dearer than compiling.
_NOT_PADDED = 50_000
# Of which half as many eigenvectors make sense: the constant, and one besides.
_FEWEST_VERTICES = 4
# A thousandth of a body's area shows nothing of its kind.
_SMALLEST_PART = 1e-3


@contextmanager
def _stage(name: str, seconds: dict[str, float]) -> Iterator[None]:
    logger.info("%s ...", name)
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start
