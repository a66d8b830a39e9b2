"""The function `match`, which computes the correspondence of two meshes, and its result."""

from __future__ import annotations

import functools
import logging
import warnings
from collections.abc import Sequence
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import (
    DEFAULT_INITIAL_MAP,
    DEFAULT_MATCH_INIT,
    DEFAULT_MIRROR,
    DEFAULT_PRESET,
    Eigensolver,
    Laplacian,
    MatchInit,
    Mirror,
)
from jaxsmw.core.refinement import Refinement
from jaxsmw.core.refiner import Problem, Refiner, State, reverse_map
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.soft_maps import SoftMap, sinkhorn
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_candidates
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.assignment import one_to_one_map
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh, MeshLike, extend_to_unreferenced
from jaxsmw.initial_maps import check_initial_map
from jaxsmw.pair import Pair, paired_spectra
from jaxsmw.preparation import PreparedPair, prepare, program_size
from jaxsmw.presets import Preset, PresetName, choose_preset
from jaxsmw.repair.chirality import Decision, Hands
from jaxsmw.repair.expected_error import expected_error
from jaxsmw.repair.outcome import Outcome
from jaxsmw.repair.rounds import refine_in_stages
from jaxsmw.repair.scores import discontinuous_parts, orientation_reversal
from jaxsmw.repair.settings import WITHOUT_REPAIR, RepairSettings
from jaxsmw.repair.wrong_probability import wrong_probability
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size
from jaxsmw.runtime.progress import timed
from jaxsmw.runtime.threads import one_blas_thread
from jaxsmw.stage import Stage
from jaxsmw.transfer.registered_mesh import DEFAULT_STIFFNESS, RegisteredMesh, register_mesh

logger = logging.getLogger("jaxsmw")


@dataclass(frozen=True, eq=False, repr=False)
class Correspondence:
    """The result of `match`: a map from X to Y, the spectra, and statistics of the map.

    The methods `surface_points`, `one_to_one`, `soft_map`, `expected_error`, `wrong_probability` and others
    compute further results. The results of `surface_points` and `expected_error` are kept, so further calls
    cost no time.

    **Attributes:**

    - `pair`: the `Pair` of the source X (m vertices) and the target Y (n vertices).
    - `pointwise_map`: T: X -> Y (m,), int64. Entry i is the match of vertex i of X, as a 0-based vertex of Y.
    - `functional_map`: the functional map of the last iteration, a property. Its shape is (k_X, k_Y) for a
      pullback, which is the usual convention, and (k_Y, k_X) for a pushforward.
    - `initial_map`: the map from which refinement started (m,), int64, as 0-based vertices of Y.
    - `init`: the name of the initial map, such as `"shot"`; None if a map or landmarks were given. If repair
      chose an alternative initial map, `initial_map` is the alternative.
    - `preset`: the `Preset` with the stages of refinement and the settings of the repair. For small meshes,
      the stages of a preset differ from the stages in `PRESETS`; see `match`.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y. They contain the k_X and k_Y eigenvectors that the
      last stage uses. Two full shapes are each scaled to area 1. The shapes of a partial pair are scaled by
      one common factor, so that the larger shape has area 1.
    - `refinement`: the `Refinement` of the last stage. The `Refinement` contains a `History` if `match` was
      called with `history=True`.
    - `iterations`: the total number of iterations of all stages.
    - `distortion`: the distortion of the map (`jaxsmw.repair.scores.distortion`), which is 1 for isometries
      and larger for worse maps.
    - `suspicious`: whether the map looks wrong. If the preset has repair, the value is True if limbs still
      look swapped or the body still looks upside down after repair. If the preset has no repair, the value is
      True if the distortion is at least 1.25. In both cases, the value is also True if `match` is uncertain
      whether X or its mirror image corresponds to Y, for example if `mirror_evidence` is between 0 and 0.1.
    - `mirrored`: True if the mirror image of X was matched instead of X, because X and Y are of opposite
      hands, such as a left and a right tooth. Whether X is mirrored or not, entry i of `pointwise_map` is the
      match of vertex i of X.
    - `mirror_evidence`: a logarithm that is positive if the mirror image of X seems to match Y better than X
      itself does; None if `match` did not compare the two. The distance error of a coarse map of X itself is
      at least `exp(mirror_evidence)` times the distance error of a coarse map of the mirror image
      (`jaxsmw.repair.chirality.Hands`). If X and Y differ enough from their own mirror images, a value of at
      least 0.05 leads to `mirrored=True`. Most correct decisions with `mirrored=True` have values above 0.3.
    - `seconds`: a dictionary from the name of each step to its wall time in seconds. The first refinement of
      meshes of a given size includes the time of compilation.
    """

    pair: Pair
    pointwise_map: Int64[np.ndarray, " m"]
    initial_map: Int64[np.ndarray, " m"]
    init: str | None
    preset: Preset
    spectrum_x: Spectrum
    spectrum_y: Spectrum
    refinement: Refinement
    iterations: int
    distortion: float | None = None
    suspicious: bool = False
    mirrored: bool = False
    mirror_evidence: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        m, n = (len(mesh.vertices) for mesh in self.pair.meshes)
        judged = "" if self.distortion is None else f", distortion {self.distortion:.3f}"
        flag = (", mirrored" if self.mirrored else "") + (", suspicious" if self.suspicious else "")
        return f"Correspondence({self.pair.name}: {m} to {n} vertices{judged}{flag})"

    @property
    def mesh_x(self) -> Mesh:
        """The source X."""
        return self.pair.mesh_x

    @property
    def mesh_y(self) -> Mesh:
        """The target Y."""
        return self.pair.mesh_y

    @property
    def functional_map(self) -> Float[np.ndarray, "k_out k_in"]:
        """The functional map of the last iteration, in the convention of the last stage's refiner.

        The shape is (k_X, k_Y) for a pullback, from functions on Y to functions on X. The shape is (k_Y, k_X)
        for a pushforward, from functions on X to functions on Y.
        """
        return np.asarray(self.refinement.functional_map)

    def surface_points(self) -> SurfacePoints:
        """Compute the match of every vertex of X as a point on a triangle of Y.

        The last stage embeds X and Y in a common space. In this space, `pointwise_map` gives the vertex of Y
        that is nearest to a vertex of X. This method searches the triangles around that vertex of Y for the
        nearest point. For 98 % of the vertices of X, no other triangle of Y has a nearer point.
        `jaxsmw.functional_maps.decode_to_triangles` searches all triangles, which takes 20 times as long. An
        unreferenced vertex of X receives the point of the nearest referenced vertex.

        **Returns:** A `SurfacePoints` with m points on Y, one for each vertex of X. Its attribute `faces`
        (m,) contains 0-based rows of `mesh_y.faces`, and its attribute `weights` (m, 3) contains barycentric
        weights.
        """
        points = self._surface_points
        return SurfacePoints(points.faces.copy(), points.weights.copy())

    @functools.cached_property
    def _surface_points(self) -> SurfacePoints:
        return self._points_near(self.pair, self.pointwise_map, *self._embeddings())

    def reverse_surface_points(self) -> SurfacePoints:
        """Compute the match of every vertex of Y as a point on a triangle of X.

        The map Y -> X comes from the same embeddings as `surface_points`, and needs no second match.

        **Returns:** A `SurfacePoints` with n points on X, one for each vertex of Y. An unreferenced vertex of
        Y receives the point of the nearest referenced vertex.
        """
        embedded_x, embedded_y = self._embeddings()
        queries = extend_to_unreferenced(self.mesh_y, embedded_y)
        return self._points_near(self.pair.reversed(), self.reverse_map(), queries, embedded_x)

    def reverse_map(self) -> Int64[np.ndarray, " n"]:
        """Compute the map Y -> X from the embeddings of the last stage, without a second match.

        **Returns:** The match of every vertex of Y (n,), as a 0-based vertex of X. An unreferenced vertex of
        Y receives the match of the nearest referenced vertex.
        """
        with self._precision():
            padded = np.asarray(compiled(reverse_map)(*self._last_stage()))
        return extend_to_unreferenced(self.mesh_y, padded[: len(self.mesh_y.vertices)].astype(np.int64))

    def _points_near(
        self,
        pair: Pair,
        matches: Int64[np.ndarray, " m"],
        queries: Float[np.ndarray, "m d"],
        database: Float[np.ndarray, "n d"],
    ) -> SurfacePoints:
        """Return, for each embedded source vertex, the nearest point on the triangles around its match."""
        mesh_x, mesh_y = pair.meshes
        with self._precision():
            rows, candidates = mesh_y.faces_around(matches)
            # Padding lets pairs of similar sizes share compiled programs.
            padding = padded_size(len(rows)) - len(rows)
            rows, candidates = (np.pad(values, (0, padding), "edge") for values in (rows, candidates))
            padded = (
                pad_rows(queries, program_size(mesh_x)),
                pad_rows(database, program_size(mesh_y)),
                pad_rows(mesh_y.faces, padded_size(len(mesh_y.faces))),
                rows,
                candidates,
            )
            found = compiled(nearest_point_on_candidates)(*jax.device_put(padded))
        faces, weights = (np.asarray(values)[: len(queries)] for values in found)
        # Rounding errors can make weights negative.
        weights = np.maximum(weights.astype(np.float64), 0)
        return SurfacePoints(np.asarray(faces).astype(np.int64), weights / weights.sum(axis=1, keepdims=True))

    def registered_mesh(self, *, stiffness: float = DEFAULT_STIFFNESS) -> RegisteredMesh:
        """Deform X onto Y, guided by `surface_points`; see `jaxsmw.transfer.register_mesh`.

        **Arguments:**

        - `stiffness`: a positive length in units of the square root of Y's area. Noise of the map with
          shorter wavelengths is smoothed. The default is 0.003.

        **Returns:** A `RegisteredMesh`, whose attribute `vertices` (m, 3) contains positions on Y, in the
        unit of Y. `jaxsmw.transfer` transfers landmarks and attributes with a registered mesh.

        **Raises:** `InputError` if the stiffness is not positive and finite; `ArithmeticError` if the
        deformation does not converge.
        """
        return register_mesh(
            self.mesh_x,
            self.mesh_y,
            self.surface_points(),
            stiffness=stiffness,
            same_unit=self.pair.partial,
        )

    def one_to_one(self) -> Int64[np.ndarray, " m"]:
        """Compute a map in which no two referenced vertices of X share a match.

        See `jaxsmw.geometry.one_to_one_map`. The map is intended for shapes with the same triangulation. For
        shapes with different triangulations, the attribute `pointwise_map` has much smaller errors than the
        one-to-one map. An unreferenced vertex of X receives the match of the nearest referenced vertex.

        **Returns:** The map X -> Y (m,), as 0-based vertices of Y.

        **Raises:** `InputError` if X has more referenced vertices than Y, or if X's number of referenced
        vertices times Y's number of referenced vertices is above 20 000².
        """
        queries, database = self._embeddings()
        used = self.mesh_x.referenced_vertices
        found = one_to_one_map(queries, database, mask_x=used, mask_y=self.mesh_y.referenced_vertices)
        return extend_to_unreferenced(self.mesh_x, found)

    def soft_map(self, temperature: float = 0.3, *, iterations: int = 100, tolerance: float = 0.1) -> SoftMap:
        """Compute a soft map that spreads the area of X over Y; see `jaxsmw.learning.sinkhorn`.

        `SoftMap.pull_back` transfers functions smoothly from Y to X. `SoftMap.pointwise_map` covers more of Y
        than `Correspondence.pointwise_map`. On four remeshed FAUST pairs, `SoftMap.pointwise_map` covers 76
        to 82 % of Y's vertices, and `Correspondence.pointwise_map` covers 69 to 75 %. Compared with
        `Correspondence.pointwise_map`, the errors of `SoftMap.pointwise_map` range from 4 % smaller to 2 %
        larger. One iteration takes 0.2 seconds for 5000 vertices, and 20 iterations are needed.

        An unreferenced vertex of X is mapped like the nearest referenced vertex. The method issues a
        `UserWarning` if the share of misplaced area is larger than `tolerance` after the last iteration.

        **Arguments:**

        - `temperature`: a positive number; see `jaxsmw.learning.sinkhorn`. The unit of the temperature is the
          area-weighted mean squared distance from the embedded vertices of X to their nearest embedded
          vertices of Y. A temperature of 0.1 gives a sharper map than 0.3 and needs more iterations. A
          temperature of 1 gives a softer map than 0.3.
        - `iterations`: the maximum number of iterations, an integer of at least 1.
        - `tolerance`: the share of misplaced area, from 0 to 1, at which iterations stop. Misplaced area is
          the area that vertices of Y receive in excess of their own areas. Between two different bodies, a
          tolerance below a few hundredths costs further iterations but does not improve the map.

        **Returns:** A `SoftMap` from the m vertices of X to the n vertices of Y. Its method `pull_back` takes
        p functions on Y (n, p) to functions on X (m, p), and its method `pointwise_map` returns a map X -> Y
        (m,). Its attribute `converged` is True if the tolerance was reached.

        **Raises:** `InputError` if the temperature or the number of iterations is not positive.
        """
        if not temperature > 0 or iterations < 1:
            raise InputError(
                f"a soft map cannot have temperature {temperature} and {iterations} iterations: give a "
                "positive temperature, such as 0.3, and at least 1 iteration."
            )
        with self._precision():
            found = compiled(sinkhorn)(
                *jax.device_put(self._embeddings()),
                query_areas=self.spectrum_x.vertex_areas,
                database_areas=self.spectrum_y.vertex_areas,
                temperature=jnp.asarray(float(temperature)),
                iterations=iterations,
                tolerance=jnp.asarray(float(tolerance)),
            )
        if not found.converged:
            warnings.warn(
                f"the soft map has not converged: after {iterations} iterations, the share of misplaced area "
                f"is {float(found.residual):.3g}, which exceeds the tolerance {tolerance:g}: allow more "
                "iterations, a higher temperature or a larger tolerance.",
                stacklevel=2,
            )
        return found

    def expected_error(self) -> Float[np.ndarray, " m"]:
        """Estimate the geodesic error of every match without ground truth.

        `jaxsmw.repair.expected_error` explains the estimate. An unreferenced vertex of X receives the value
        of the nearest referenced vertex.

        **Returns:** The expected geodesic distance between every match and the true match (m,), divided by
        the square root of Y's area.
        """
        return self._expected_error.copy()

    def wrong_probability(self, expected_error: Float[np.ndarray, " m"] | None = None) -> float | None:
        """Estimate the probability that the map is wrong on a part of the body, without ground truth.

        A map is called wrong if at least 2 % of X's area have errors above 0.25 times the square root of Y's
        area, for example because limbs are swapped. `jaxsmw.repair.wrong_probability` explains the estimate.

        **Arguments:**

        - `expected_error`: the expected error of each match (m,), divided by the square root of Y's area. By
          default, `Correspondence.expected_error` computes it.

        **Returns:** A probability, from 0 to 1; None if `distortion` is None.
        """
        if self.distortion is None:
            return None
        expected = self._expected_error if expected_error is None else expected_error
        return wrong_probability(self.distortion, float(self.mesh_x.average(expected)))

    @functools.cached_property
    def _expected_error(self) -> Float[np.ndarray, " m"]:
        expected = expected_error(
            self.pair.mirrored() if self.mirrored else self.pair,
            self.pointwise_map,
            self.reverse_map(),
            self.spectrum_x,
            self.spectrum_y,
            scores=(self.preset.repair or WITHOUT_REPAIR).scores,
        )
        return extend_to_unreferenced(self.mesh_x, expected)

    def _embeddings(self) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
        """Return the embeddings of X and Y in the last stage.

        The match of a vertex of X is the nearest vertex of Y in these embeddings. An unreferenced vertex of X
        has the same embedding as the nearest referenced vertex.
        """
        with self._precision():
            padded_x, padded_y = map(np.asarray, compiled(_embeddings)(*self._last_stage()))
        queries, database = padded_x[: len(self.mesh_x.vertices)], padded_y[: len(self.mesh_y.vertices)]
        return extend_to_unreferenced(self.mesh_x, queries), database

    def _last_stage(self) -> tuple[Refiner, Problem, State]:
        """Return the refiner, the problem with padded spectra, and the state of the last stage."""
        # If the mirror image of X was matched, the state of the refiner belongs to the mirror image.
        spectrum_x = self.spectrum_x.reflect() if self.mirrored else self.spectrum_x
        # Padding lets pairs of similar sizes share compiled programs.
        pad = compiled(Spectrum.pad)
        padded_x = pad(spectrum_x, program_size(self.mesh_x))
        padded_y = pad(self.spectrum_y, program_size(self.mesh_y))
        problem = Problem(padded_x, padded_y, partial=self.pair.partial)
        return self.preset.stages[-1].refiner, problem, self.refinement.state

    def _precision(self) -> AbstractContextManager[None]:
        """Return a context manager in which JAX uses the float type with which the map was computed."""
        return jax.enable_x64(self.functional_map.dtype == np.float64)


def _embeddings(
    refiner: Refiner, problem: Problem, state: State
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    return refiner.embeddings(refiner.prepare(problem), state)


def match(
    mesh_x: Mesh | MeshLike,
    mesh_y: Mesh | MeshLike,
    *,
    preset: PresetName | Preset | Stage | Sequence[Stage] = DEFAULT_PRESET,
    init: MatchInit | ArrayLike | SurfacePoints = DEFAULT_MATCH_INIT,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    partial: bool = False,
    mirror: Mirror = DEFAULT_MIRROR,
    history: bool = False,
) -> Correspondence:
    """Find for every vertex of X the vertex of Y at the same point of the body.

    The function issues a `UserWarning` if the map looks wrong (after repair, if the preset has repair), if X
    and its mirror image match Y about equally well, or if a mesh is too coarse for the descriptors of the
    preset.

    **Arguments:**

    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y (n vertices), in any unit of length. Each
      argument is a `Mesh`, a mesh of trimesh, pyFM, geomfum or PyVista, or a tuple of vertices and faces; see
      `make_mesh`.
    - `preset`: the method of refinement, which is one of the following. The number of eigenvectors of a
      preset (a name or a `Preset`) is limited to half the number of vertices of the smaller mesh. If a mesh
      does not have more vertices than the preset has samples, the preset uses all vertices instead of
      samples. If you give stages instead of a preset, `match` uses the stages unchanged.

        - `"accurate"` (the default): three stages, with repair; see `jaxsmw.PRESETS`.
        - `"paper"`: the method of the MWP paper.
        - `"fast"`: the method of the MWP paper on 500 samples of each shape.
        - a `Preset`.
        - a `Stage`, or a list or tuple of stages. An example is
          `Stage(WaveletPreservation(bank=Meyer(8)), number_of_eigenvectors=60)`.

    - `init`: the initial map, which is one of the following.

        - `"auto"` (the default): `"shot"`. The initial map `"aligned"` is refined as well if `partial` is
          False, the preset has repair, and both shapes differ from their own mirror images, as teeth do. The
          map from `"aligned"` is then returned unless the mean expected error of the map from `"shot"` is at
          least 2 % smaller.
        - `"shot"`, `"wks"`, `"hks"` or `"wavelet"`: the initial map sends each vertex of X to the vertex of Y
          with the nearest descriptor of this kind. Only SHOT distinguishes left from right.
          With `"shot"`, repair also tries alternative maps.
        - `"functional"`: the initial map is computed from the functional map that preserves SHOT and commutes
          with the Laplacian (section 3.2 of the MWP paper). This initial map is smoother than the initial map
          `"shot"` and has smaller errors. After refinement, however, the map often has larger errors than
          with `"shot"` (docs/results.md).
        - `"aligned"`: X is scaled to the area of Y and aligned rigidly. The initial map sends each vertex of
          X to the vertex of Y with the most similar SHOT descriptor and position. Use this map for shapes
          that differ little in pose, such as teeth and bones.
        - an integer array (m,) of 0-based vertices of Y, or a `SurfacePoints` with m points on Y: a given
          pointwise map.
        - an integer array (l, 2) of landmarks, where each row contains a vertex of X and its match on Y, both
          0-based. The initial map then sends each vertex of X to the vertex of Y with the most similar
          features. The features are SHOT and the geodesic distances to the landmarks. Give a few landmarks on
          the left side and on the right side of the body.

    - `laplacian`: the discretization of the Laplacian: `"cotangent"`, `"robust"` or `"auto"` (the default).
      `"robust"` also handles non-manifold and badly shaped meshes. `"auto"` chooses `"robust"` for a mesh
      with degenerate triangles or edges with more than two faces, else `"cotangent"`.
    - `eigensolver`: `"exact"`, `"approximate"` or `"auto"` (the default). `"approximate"` takes less time on
      large meshes. `"auto"` chooses `"approximate"` if one mesh has at least 50 000 referenced vertices, else
      `"exact"`.
    - `partial`: True if one mesh is a partial shape and the other mesh the full shape, in the same unit of
      length; see `paired_spectra`. The default is False, for two full shapes.
    - `mirror`: whether X and Y are of opposite hands, such as a left and a right tooth. If they are, the
      mirror image of X is matched instead of X. Whether X is mirrored or not, entry i of the map is the match
      of vertex i of X.

        - `"auto"` (the default): decide by a comparison of coarse maps (`jaxsmw.repair.chirality.Hands`). If
          a coarse map of the mirror image of X preserves distances better than a coarse map of X itself, the
          mirror image is matched. X itself is matched if X and Y are nearly their own mirror images, as
          people and animals are. X itself is also matched if `partial` is True.
        - `"no"`: match X itself.
        - `"yes"`: match the mirror image of X.

    - `history`: whether to record a `History` of the last stage. The result contains the record in its
      attribute `refinement.history`.

    **Returns:** A `Correspondence`, whose attribute `pointwise_map` (m,) is an int64 array of 0-based
    vertices of Y. A `Correspondence` also has the attributes `functional_map`, `spectrum_x`, `spectrum_y`,
    `distortion` and `suspicious`. An unreferenced vertex of X (in no face) receives the match of the nearest
    referenced vertex. Unreferenced vertices of Y are never matched.

    **Raises:** `InputError` if a mesh cannot be used or has too few vertices, if the preset or the initial
    map is unknown or does not fit the meshes, or if another argument is invalid. `ArithmeticError` if the
    computation of the initial map or the refinement fails numerically.
    """
    check_choice(mirror, Mirror, "a mirror setting")
    pair = Pair.make(mesh_x, mesh_y, partial=partial)
    adapts = isinstance(preset, str | Preset)
    chosen, fewest = choose_preset(preset), pair.fewest_vertices()
    if adapts:
        chosen = chosen.fitted(fewest)

    automatic = isinstance(init, str) and init == "auto"
    first_init = DEFAULT_INITIAL_MAP if automatic else init
    check_initial_map(pair, first_init)  # before the eigenbases, which take longer
    compiling = _compile_ahead(pair, chosen, history)
    seconds: dict[str, float] = {}
    with timed("eigenbases", seconds):
        spectra = paired_spectra(
            pair, chosen.number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver
        )
    decision = Decision(mirror == "yes")
    aligns = automatic and chosen.repair is not None  # if the shapes are asymmetric
    if (mirror == "auto" or aligns) and not partial:
        with timed("mirror test", seconds):
            decision = Hands(pair, *spectra).decide(mirror)
        if decision.mirrored and mirror == "auto":
            logger.info("%s: the mirror image of the source is matched", pair.name)
    prepared = prepare(
        pair.mirrored() if decision.mirrored else pair,
        number_of_eigenvectors=chosen.number_of_eigenvectors,
        number_of_descriptors=chosen.number_of_descriptors,
        number_of_samples=chosen.number_of_samples,
        init=first_init,
        descriptors_required=not adapts,
        spectra=(spectra[0].reflect(), spectra[1]) if decision.mirrored else spectra,
    )
    seconds |= prepared.seconds
    starts = [prepared]
    if aligns and decision.asymmetric:
        starts.append(prepared.started_from("aligned"))
        _add_seconds(starts[-1], seconds)
    found = match_prepared(
        pair, starts, chosen, decision, history=history, seconds=seconds, compiling=compiling
    )
    found.warn_if_suspicious()
    return found.correspondence


class Match(NamedTuple):
    """A correspondence, and the data from which its warnings are made.

    **Attributes:**

    - `correspondence`: the `Correspondence`.
    - `prepared`: the prepared pair from which the map was refined. If the mirror image of X was matched, the
      prepared pair contains the mirror image.
    - `outcome`: the `Outcome` of refinement and repair.
    - `decision`: the `Decision` between X and its mirror image.
    """

    correspondence: Correspondence
    prepared: PreparedPair
    outcome: Outcome
    decision: Decision

    def warn_if_suspicious(self) -> None:
        """Issue a `UserWarning` if the map looks wrong, or if the hand of X is doubtful."""
        if self.outcome.suspicious:
            warning = _warning(self.prepared, self.correspondence.preset.repair, self.outcome)
            warnings.warn(warning, stacklevel=3)
        if self.decision.doubtful:
            warnings.warn(_doubt(self.prepared.pair, self.decision), stacklevel=3)


def match_prepared(
    pair: Pair,
    starts: Sequence[PreparedPair],
    preset: Preset,
    decision: Decision = Decision(False),  # noqa: B008 (immutable)
    *,
    history: bool = False,
    seconds: dict[str, float] | None = None,
    compiling: Sequence[Future[object]] = (),
    alternatives: bool = True,
    refined: Sequence[Outcome | None] = (),
) -> Match:
    """Refine the initial maps of a prepared pair, and return the better match.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `starts`: the prepared pair, once for each initial map. The sequence contains one initial map, or
      `"shot"` and `"aligned"` in this order. If `decision.mirrored` is True, the prepared pair contains the
      mirror image of X instead of X.
    - `preset`: the stages and the repair.
    - `decision`: the decision between X and its mirror image.
    - `history`: whether to record a `History` of the last stage.
    - `seconds`: a dictionary to which the times of the steps are added. With None, the steps are not timed,
      and no progress is reported.
    - `compiling`: background compilations that refinement waits for.
    - `alternatives`: whether repair tries alternative maps.
    - `refined`: for each start, the outcome of all stages if the stages already ran; see
      `jaxsmw.repair.batches`.

    **Returns:** The `Match`.

    **Raises:** `ArithmeticError` if refinement fails numerically from every initial map.
    """
    if starts[0].spectrum_x.descriptors is None:
        preset = preset.without_descriptors()
    with _step("refinement", seconds), one_blas_thread():
        wait(compiling)
        outcomes = [
            refine_in_stages(
                start,
                preset.stages,
                preset.repair,
                alternatives=None if alternatives else (),
                history=history,
                refined=known,
            )
            for start, known in zip(starts, refined or [None] * len(starts), strict=True)
        ]
        jax.block_until_ready([outcome.refinements[-1] for outcome in outcomes])
    candidates = [
        (start, outcome) for start, outcome in zip(starts, outcomes, strict=True) if outcome.successful
    ] or [(starts[0], outcomes[0])]
    times = {} if seconds is None else seconds
    found = [
        Match(_correspondence(pair, start, preset, outcome, times, decision), start, outcome, decision)
        for start, outcome in candidates
    ]
    if len(found) == 1:
        return found[0]
    assert preset.repair is not None
    with _step("expected error", seconds):
        from_shot, from_aligned = (
            float(pair.mesh_x.average(one.correspondence.expected_error())) for one in found
        )
    return found[int(from_shot >= preset.repair.aligned_preference * from_aligned)]


def _step(name: str, seconds: dict[str, float] | None) -> AbstractContextManager[None]:
    return nullcontext() if seconds is None else timed(name, seconds)


def _add_seconds(prepared: PreparedPair, seconds: dict[str, float]) -> None:
    """Add the times of a further preparation."""
    seconds |= {step: seconds[step] + time for step, time in prepared.seconds.items()}


def _compile_ahead(pair: Pair, preset: Preset, history: bool) -> list[Future[object]]:
    """Compile the programs of all stages in the background.

    Nothing is compiled for partial pairs, because their numbers of eigenvectors are not known yet. Nothing is
    compiled either if a mesh has no more vertices than the preset has eigenvectors, because `prepare` then
    raises an error.
    """
    if pair.partial or preset.number_of_eigenvectors >= min(len(mesh.vertices) for mesh in pair.meshes):
        return []
    sizes = program_size(pair.mesh_x), program_size(pair.mesh_y)
    # The last stage is compiled first, because its compilation takes the longest time.
    return [stage.compile_ahead(*sizes, history=history) for stage in reversed(preset.stages)]


def _correspondence(
    pair: Pair,
    prepared: PreparedPair,
    preset: Preset,
    outcome: Outcome,
    seconds: dict[str, float],
    decision: Decision,
) -> Correspondence:
    """Make the result of `match`.

    **Raises:** `ArithmeticError` if refinement failed.
    """
    m = len(pair.mesh_x.vertices)
    last = outcome.refinements[-1].unpadded(m)
    if last.result != RESULTS.successful:
        raise ArithmeticError(f"{pair.name}: {sentence(last.result)}")
    spectrum_x, spectrum_y = preset.stages[-1].view(
        prepared.spectrum_x, prepared.spectrum_y, partial=pair.partial
    )
    return Correspondence(
        pair=pair,
        pointwise_map=extend_to_unreferenced(pair.mesh_x, np.asarray(last.pointwise_map).astype(np.int64)),
        initial_map=np.asarray(outcome.initial_map)[:m].astype(np.int64),
        init=prepared.init if isinstance(prepared.init, str) else None,
        preset=preset,
        spectrum_x=spectrum_x.reflect() if decision.mirrored else spectrum_x,
        spectrum_y=spectrum_y,
        refinement=last,
        iterations=sum(int(refinement.iterations) for refinement in outcome.refinements),
        distortion=outcome.distortion,
        suspicious=outcome.suspicious or decision.doubtful,
        mirrored=decision.mirrored,
        mirror_evidence=decision.evidence,
        seconds=seconds,
    )


def _doubt(pair: Pair, decision: Decision) -> str:
    """Return the text of the warning that X and its mirror image match Y about equally well."""
    took = "the mirror image of the source" if decision.mirrored else "the source itself"
    return (
        f"{pair.name}: the source and its mirror image match the target about equally well (evidence "
        f"{decision.evidence:.2f} for the mirror image). {took.capitalize()} was matched. If both meshes are "
        'of the same hand, set mirror="no" (--mirror no); if not, set mirror="yes" (--mirror yes).'
    )


def _warning(prepared: PreparedPair, repair: RepairSettings | None, outcome: Outcome) -> str:
    """Return the text of the warning that a map looks wrong."""
    pair, spectrum_x, init = prepared.pair, prepared.spectrum_x, prepared.init
    settings = repair or WITHOUT_REPAIR
    found = np.asarray(outcome.pointwise_map)[: len(pair.mesh_x.vertices)].astype(np.int64)
    areas = pair.mesh_x.vertex_areas / pair.mesh_x.area
    mirrored = areas[orientation_reversal(pair, found, spectrum_x, settings.scores)].sum()
    cut_off = areas[discontinuous_parts(pair, found, settings.scores)].sum()
    more = not isinstance(init, str | SurfacePoints) and np.ndim(init) == 2
    cure = f"use {'more' if more else 'a few'} landmarks as the initial map"
    if repair is None:
        cure = f'use preset="accurate" (--preset accurate), which repairs such maps, or {cure}'
    if pair.partial:
        cure += ", and check that both meshes have the same unit of length"
    else:
        cure += "; if one mesh is a partial shape, set partial=True (--partial)"
    return (
        f"{pair.name}: limbs may be swapped or mirrored, or the body may be upside down. The map has "
        f"distortion {outcome.distortion:.3f}, reverses the orientation of {mirrored:.0%} of the source's "
        f"area, and separates {cut_off:.0%} of the source's area by discontinuities. Correct maps between "
        f"poses of one body have distortions up to {settings.suspicious}. Correct maps can have larger "
        "distortions between non-isometric shapes, with topological noise, or if one shape is mirrored. "
        "Look at the map with the option --report or, in Python, with jaxsmw.report.summary.write_report. If "
        f"the map is wrong, {cure}."
    )
