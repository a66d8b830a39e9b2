"""The result of `match`: a map from X to Y, the spectra, and statistics of the map."""

from __future__ import annotations

import functools
import warnings
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy.typing import ArrayLike

from jaxsmw.choices import Backend
from jaxsmw.core.arrays import is_traced, namespace
from jaxsmw.core.functional_map import encode
from jaxsmw.core.refinement import Refinement
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_candidates
from jaxsmw.errors import InputError
from jaxsmw.geometry.assignment import one_to_one_map
from jaxsmw.geometry.mesh import Mesh, extend_from, extend_to_unreferenced
from jaxsmw.geometry.surface_points import SurfacePoints, check_pointwise_map
from jaxsmw.matching.judge import distortion, estimate_error, overlap_probability
from jaxsmw.matching.outcome import Outcome, StageRun, Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search.alternatives import Alternative
from jaxsmw.matching.settings import ExpectedErrorSettings
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Preset, Stage
from jaxsmw.matching.starts import INITIAL_MAPS
from jaxsmw.transfer.registered_mesh import DEFAULT_STIFFNESS, RegisteredMesh, register_mesh

if TYPE_CHECKING:
    from jaxsmw.core.soft_maps import SoftMap
else:
    SoftMap = Any  # its module imports JAX


class Overlap(NamedTuple):
    """How probably each vertex of two partial shapes has a counterpart on the other shape.

    **Attributes:** `of_x`, `of_y`: the probabilities of the vertices of X (m,) and of Y (n,), from 0 to 1.
    """

    of_x: Float[np.ndarray, " m"]
    of_y: Float[np.ndarray, " n"]

    @property
    def masks(self) -> tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]]:
        """Masks of X (m,) and of Y (n,), True for vertices that probably have a counterpart."""
        return self.of_x >= 0.5, self.of_y >= 0.5


@dataclass(frozen=True, eq=False, repr=False)
class Correspondence:
    """The result of `match`: a map from X to Y, the spectra, and statistics of the map.

    The methods `surface_points`, `one_to_one`, `soft_map`, `expected_error`, `wrong_probability` and others
    compute further results. The results of `surface_points` and `expected_error` are kept, so further calls
    cost no time. In all results, an unreferenced vertex has the value of the nearest referenced vertex.

    **Attributes:**

    - `pair`: the `Pair` of the source X (m vertices) and the target Y (n vertices).
    - `pointwise_map`: T: X -> Y (m,), int64. Entry i is the match of vertex i of X, as a 0-based vertex of Y.
    - `functional_map`: the functional map of the last iteration, a property without unit. Its shape is
      (k_X, k_Y) for a pullback, which is the usual convention, and (k_Y, k_X) for a pushforward.
    - `initial_map`: the map from which refinement started (m,), int64, as 0-based vertices of Y.
    - `origin`: where the first initial map comes from; see `Start`. If the search chose another map,
      `initial_map` is the map from which that map was refined.
    - `preset`: the `Preset` with the stages of refinement and the settings of the search, adapted to the
      meshes; see `Preset.fitted`.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y in `Pair.units_of_length`, each a `Spectrum` with the
      k_X or k_Y eigenvectors that the last stage uses. If a mesh was cut before it was matched
      (`jaxsmw.geometry.cut_shortcuts`), or was trimmed (`jaxsmw.matching.search.trimming`), the spectrum
      belongs to the cut or trimmed mesh. The mask of the spectrum is False for trimmed vertices.
    - `stage`: the last `Stage`. After trimming, its levels are `SearchSettings.trimmed_levels`.
    - `refinement`: the `Refinement` of the last stage. The `Refinement` contains a `History` if `match` was
      called with `history=True`.
    - `iterations`: the total number of iterations of all stages.
    - `distortion`: the distortion of the map (`jaxsmw.matching.judge.distortion`), a number without unit. The
      distortion is 1 for isometries and larger for worse maps.
    - `probability`: the probability, from 0 to 1, that the map is right as a whole: not turned, not mirrored,
      and without exchanged limbs.
    - `alternatives`: other maps that could be right, as a tuple of `Alternative`, the most probable first.
    - `mirrored`: True if the mirror image of X was matched instead of X, because X and Y are of opposite
      hands, such as a left and a right tooth. Entry i of `pointwise_map` is always the match of vertex i of
      X, even if X was mirrored.
    - `left_out`: the share of X's area in small components that have no counterpart on Y and only move with
      their surroundings; see `jaxsmw.transfer.match_small_components`.
    - `shared`: the `Overlap` on the template, if the shapes were matched through one, else None.
    - `seconds`: a dictionary from the name of each step to its wall time in seconds. If JAX refines meshes of
      a certain size for the first time, the time includes compilation.
    """

    pair: Pair
    pointwise_map: Int64[np.ndarray, " m"]
    initial_map: Int64[np.ndarray, " m"]
    origin: str
    preset: Preset
    spectrum_x: Spectrum
    spectrum_y: Spectrum
    stage: Stage
    refinement: Refinement
    iterations: int
    distortion: float
    probability: float
    alternatives: tuple[Alternative, ...] = ()
    mirrored: bool = False
    left_out: float = 0.0
    shared: Overlap | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        prepared: PreparedPair,
        start: Start,
        preset: Preset,
        outcome: Outcome,
        probability: float,
        alternatives: tuple[Alternative, ...] = (),
    ) -> Correspondence:
        """Make the result of `match`, which refers to the vertices of the given meshes.

        **Raises:** `ArithmeticError` if a stage failed.
        """
        pair = prepared.given
        last = outcome.last.refinement
        if last.result != RESULTS.successful:
            cure = ' If the units of length differ, set scale="unknown".' if pair.partial else ""
            raise ArithmeticError(f"{pair.name}: {sentence(last.result)}{cure}")
        refined_map = extend_to_unreferenced(prepared.pair.mesh_x, outcome.pointwise_map)
        pointwise_map, left_out = pair.with_small_components(refined_map)
        seen = outcome.last.seen
        return cls(
            pair=pair,
            pointwise_map=pointwise_map,
            initial_map=outcome.initial_map,
            origin=start.origin,
            preset=preset,
            spectrum_x=seen.x.reflect() if prepared.mirrored else seen.x,
            spectrum_y=seen.y,
            stage=outcome.last.stage,
            refinement=replace(
                last, pointwise_map=namespace(last.pointwise_map).asarray(pointwise_map, np.int32)
            ),
            iterations=sum(int(run.refinement.iterations) for run in outcome.runs),
            distortion=distortion(prepared.pair, outcome.pointwise_map, seen.x),
            probability=probability,
            alternatives=alternatives,
            mirrored=prepared.mirrored,
            left_out=left_out,
        )

    def __repr__(self) -> str:
        m, n = (len(mesh.vertices) for mesh in self.pair.meshes)
        flag = (", mirrored" if self.mirrored else "") + (", suspicious" if self.suspicious else "")
        judged = f"right with probability {self.probability:.2f}, distortion {self.distortion:.3f}{flag}"
        return f"Correspondence({self.pair.name}: {m} to {n} vertices, {judged})"

    @property
    def suspicious(self) -> bool:
        """Whether the map is wrong with a probability above one half."""
        return self.probability < 0.5

    @property
    def mesh_x(self) -> Mesh:
        """The source X."""
        return self.pair.mesh_x

    @property
    def mesh_y(self) -> Mesh:
        """The target Y."""
        return self.pair.mesh_y

    @property
    def init(self) -> str | None:
        """The name of the initial map, such as `"shot"`; None if a map or landmarks were given."""
        return self.origin if self.origin in INITIAL_MAPS else None

    @property
    def matched_pair(self) -> Pair:
        """The pair with the mirror image of X in place of X, if it was matched."""
        return self.pair.mirrored() if self.mirrored else self.pair

    @property
    def backend(self) -> Backend:
        """What has run the last stage: `"numpy"` or `"jax"`."""
        return "jax" if is_traced(self.refinement.pointwise_map) else "numpy"

    @property
    def functional_map(self) -> Float[np.ndarray, "k_out k_in"]:
        """The functional map of the last iteration; see `jaxsmw.Refinement`."""
        return np.asarray(self.refinement.functional_map)

    def to_pyfm(self) -> Any:
        """Return a `FunctionalMapping` of pyFM, in which `mesh1` is Y, `mesh2` is X, and `FM_12` is set.

        Both meshes have their spectra and their own units, as from `jaxsmw.io.to_pyfm`, and the functional
        map fits these units. `jaxsmw.io.make_functional_map` converts in the opposite direction.

        **Raises:** `InputError` if pyFM is not installed, or a spectrum belongs to a cut mesh.
        """
        from jaxsmw.io.exchange import to_pyfm, to_pyfm_mapping

        shape_x, shape_y = (to_pyfm(*side) for side in self._sides)
        return to_pyfm_mapping(shape_x, shape_y, self._map_in_units())

    def to_geomfum(self) -> tuple[Any, Any, Float[np.ndarray, "k_x k_y"]]:
        """Return shape `a`, which is Y, shape `b`, which is X, and the functional map of geomfum.

        Both shapes are as from `jaxsmw.io.to_geomfum`, and the functional map fits their units.

        **Raises:** `InputError` if geomfum is not installed, or a spectrum belongs to a cut mesh.
        """
        from jaxsmw.io.exchange import to_geomfum

        shape_x, shape_y = (to_geomfum(*side) for side in self._sides)
        return shape_y, shape_x, self._map_in_units()

    @property
    def _sides(self) -> tuple[tuple[Mesh, Spectrum], tuple[Mesh, Spectrum]]:
        return (self.mesh_x, self.spectrum_x), (self.mesh_y, self.spectrum_y)

    def _map_in_units(self) -> Float[np.ndarray, "k_x k_y"]:
        """Return the pullback between the eigenbases in the units of the meshes, float64."""
        from jaxsmw.io.exchange import unit_factor

        matrix = np.asarray(self.functional_map, np.float64)
        refiner = self.stage.refiner
        if refiner.convention != "pullback" or refiner.further_bases:
            encoded = encode(self.pointwise_map, self.spectrum_x, self.spectrum_y)
            matrix = np.asarray(encoded, np.float64)
        factor_x, factor_y = (unit_factor(*side) for side in self._sides)
        return matrix * np.sqrt(factor_x / factor_y)

    def surface_points(self) -> SurfacePoints:
        """Compute the match of every vertex of X as a point on a triangle of Y.

        The last stage embeds X and Y in a common space. In this space, `pointwise_map` gives the vertex of Y
        that is nearest to a vertex of X. This method searches the triangles around that vertex of Y for the
        nearest point. For 98 % of the vertices of X, this point is also the nearest point on all triangles of
        Y. `jaxsmw.functional_maps.decode_to_triangles` searches all triangles, which takes 20 times as long.

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

        The method uses the same embeddings as `surface_points`, so `match` is not called again.

        **Returns:** A `SurfacePoints` with n points on X, one for each vertex of Y.
        """
        embedded_x, embedded_y = self._embeddings()
        return self._points_near(self.pair.reversed(), self.reverse_map(), embedded_y, embedded_x)

    def reverse_map(self) -> Int64[np.ndarray, " n"]:
        """Compute the map Y -> X from the embeddings of the last stage, without a second call of `match`.

        **Returns:** The match of every vertex of Y (n,), int64, as a 0-based vertex of X.
        """
        with self._precision():
            reverse = self._last.reverse_map()
        reverse = extend_from(np.asarray(self.spectrum_y.mask), self.mesh_y, reverse)
        return self.pair.reversed().with_small_components(reverse)[0]

    def _points_near(
        self,
        pair: Pair,
        matches: Int64[np.ndarray, " m"],
        queries: Float[np.ndarray, "m d"],
        database: Float[np.ndarray, "n d"],
    ) -> SurfacePoints:
        """Return, for each embedded source vertex, the nearest point on the triangles around its match."""
        mesh_y = pair.mesh_y
        # A vertex of a small component of Y is in no face, so the nearest vertex with faces stands for it.
        matches = extend_to_unreferenced(mesh_y, np.arange(len(mesh_y.vertices)))[matches]
        rows, candidates = mesh_y.faces_around(matches)
        faces, weights = nearest_point_on_candidates(queries, database, mesh_y.faces, rows, candidates)
        faces, weights = np.asarray(faces, np.int64), np.asarray(weights, np.float64)
        return SurfacePoints(faces, weights / weights.sum(axis=1, keepdims=True))

    def registered_mesh(self, *, stiffness: float = DEFAULT_STIFFNESS) -> RegisteredMesh:
        """Deform X onto Y, guided by `surface_points`; see `jaxsmw.transfer.register_mesh`.

        **Arguments:**

        - `stiffness`: a positive length in units of the square root of Y's area. Noise of the map is smoothed
          if its wavelength is shorter than the stiffness. The default is 0.005.

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
            scale=self.pair.scale if self.pair.partial else None,
        )

    def one_to_one(self) -> Int64[np.ndarray, " m"]:
        """Compute a map in which no two referenced vertices of X share a match.

        See `jaxsmw.geometry.one_to_one_map`. The map is intended for shapes with the same triangulation. For
        shapes with different triangulations, the attribute `pointwise_map` has much smaller errors than the
        one-to-one map.

        **Returns:** The map X -> Y (m,), int64, as 0-based vertices of Y.

        **Raises:** `InputError` if X has more referenced vertices than Y, or if the product of the numbers of
        referenced vertices of X and Y is above 20 000².
        """
        queries, database = self._embeddings()
        used = self.mesh_x.referenced_vertices
        matches = one_to_one_map(queries, database, mask_x=used, mask_y=self.mesh_y.referenced_vertices)
        matches = extend_from(np.asarray(self.spectrum_x.mask), self.mesh_x, matches)
        return self.pair.with_small_components(matches)[0]

    def soft_map(self, temperature: float = 0.3, *, iterations: int = 100, tolerance: float = 0.1) -> SoftMap:
        """Compute a soft map that spreads the area of X over Y; see `jaxsmw.learning.sinkhorn`.

        `SoftMap.pull_back` transfers functions smoothly from Y to X. On four remeshed FAUST pairs,
        `SoftMap.pointwise_map` covers 76 to 82 % of Y's vertices, and `Correspondence.pointwise_map` covers
        69 to 75 %. The errors differ by at most 4 %. One iteration takes 0.2 seconds for 5000 vertices, and
        20 iterations are needed.

        The method issues a `UserWarning` if the iterations end before they reach the tolerance.

        **Arguments:**

        - `temperature`: a positive number; see `jaxsmw.learning.sinkhorn`. The unit of the temperature is the
          area-weighted mean squared distance from the embedded vertices of X to their nearest embedded
          vertices of Y. A temperature of 0.1 gives a sharper map than 0.3 and needs more iterations. A
          temperature of 1 gives a softer map than 0.3.
        - `iterations`: the maximum number of iterations, an integer of at least 1.
        - `tolerance`: a number from 0 to 1. The iterations stop when the misplaced area is at most this share
          of the total area. Misplaced area is the area that vertices of Y receive in excess of their own
          areas. If X and Y are different bodies, a tolerance below a few hundredths costs further iterations
          but does not improve the map.

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
        import jax

        from jaxsmw.core.soft_maps import sinkhorn
        from jaxsmw.runtime.compilation import compiled

        with self._precision():
            soft_map = compiled(sinkhorn)(
                *jax.device_put(self._embeddings()),
                query_areas=jax.device_put(self.spectrum_x.vertex_areas),
                database_areas=jax.device_put(self.spectrum_y.vertex_areas),
                temperature=jax.device_put(float(temperature)),
                iterations=iterations,
                tolerance=jax.device_put(float(tolerance)),
            )
        if not soft_map.converged:
            warnings.warn(
                f"the soft map has not converged: after {iterations} iterations, the share of misplaced area "
                f"is {float(soft_map.residual):.3g}, which exceeds the tolerance {tolerance:g}: allow more "
                "iterations, a higher temperature or a larger tolerance.",
                stacklevel=2,
            )
        return soft_map

    def expected_error(self) -> Float[np.ndarray, " m"]:
        """Estimate the geodesic error of every match (m,), divided by the square root of Y's area.

        See `jaxsmw.matching.judge.expected_error`.
        """
        return self._expected_error.copy()

    def overlap_probabilities(self, reverse_map: ArrayLike | None = None) -> Overlap:
        """Predict how probably each vertex has a counterpart on the other shape, for partial shapes.

        See `jaxsmw.matching.judge.overlap_probability`. If the shapes were matched through a template, a
        vertex must in addition lie in the region of the template that both shapes cover.

        **Arguments:**

        - `reverse_map`: a map Y -> X (n,), 0-based vertices of X. By default, `Correspondence.reverse_map`
          computes it. The map of a second match, from Y to X, makes the prediction more accurate.

        **Returns:** An `Overlap`.

        **Raises:** `InputError` if the reverse map does not fit the meshes.
        """
        if reverse_map is None:
            return self._overlap
        return self._overlap_with(check_pointwise_map(reverse_map, self.mesh_y, self.mesh_x, "reverse map"))

    @functools.cached_property
    def _overlap(self) -> Overlap:
        return self._overlap_with(self.reverse_map())

    def _overlap_with(self, reverse: Int64[np.ndarray, " n"]) -> Overlap:
        predicted = Overlap(
            overlap_probability(self.pair, self.pointwise_map, reverse),
            overlap_probability(self.pair.reversed(), reverse, self.pointwise_map),
        )
        if self.shared is None:
            return predicted
        return Overlap(*(np.minimum(*both) for both in zip(predicted, self.shared, strict=True)))

    def overlap(
        self, reverse_map: ArrayLike | None = None
    ) -> tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]]:
        """Predict which vertices have a counterpart on the other shape, for partial shapes.

        **Arguments:** see `overlap_probabilities`.

        **Returns:** A mask of the vertices of X (m,) and a mask of the vertices of Y (n,), True for vertices
        that probably have a counterpart.

        **Raises:** `InputError` if the reverse map does not fit the meshes.
        """
        return self.overlap_probabilities(reverse_map).masks

    def wrong_probability(self) -> float:
        """Return the probability, from 0 to 1, that the map is wrong as a whole: 1 - `probability`."""
        return 1 - self.probability

    def none_probability(self) -> float:
        """Return the probability, from 0 to 1, that neither the map nor an alternative is right."""
        return max(0.0, 1 - self.probability - sum(other.probability for other in self.alternatives))

    @functools.cached_property
    def _expected_error(self) -> Float[np.ndarray, " m"]:
        return self.estimate_error(ExpectedErrorSettings())

    def estimate_error(self, settings: ExpectedErrorSettings) -> Float[np.ndarray, " m"]:
        """Estimate the geodesic error of every match (m,) with other settings; see `expected_error`."""
        with self._precision():
            return estimate_error(
                self.matched_pair,
                self.pointwise_map,
                self._last,
                settings,
            )

    def _embeddings(self) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
        """Return the embeddings of X and Y in the last stage.

        The match of a vertex of X is the nearest vertex of Y in these embeddings. A vertex that was not
        matched, because it is unreferenced or was trimmed, has the embedding of the nearest matched vertex.
        """
        with self._precision():
            of_x, of_y = self._last.embeddings()
        return (
            extend_from(np.asarray(self.spectrum_x.mask), self.mesh_x, of_x),
            extend_from(np.asarray(self.spectrum_y.mask), self.mesh_y, of_y),
        )

    @functools.cached_property
    def _last(self) -> StageRun:
        """The last stage, which has seen the mirror image of X if it was matched."""
        spectrum_x = self.spectrum_x.reflect() if self.mirrored else self.spectrum_x
        spectra = SpectralPair(spectrum_x, self.spectrum_y, partial=self.pair.partial)
        return StageRun(self.stage, spectra, self.refinement)

    def _precision(self) -> AbstractContextManager[None]:
        """Return a context manager in which JAX, if it is used, has the float type of the functional map."""
        if not is_traced(self.refinement.functional_map):
            return nullcontext()
        import jax

        return jax.enable_x64(self.functional_map.dtype == np.float64)
