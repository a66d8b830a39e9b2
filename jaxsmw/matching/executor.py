"""Runs stages: pads the spectra of a pair, and runs one compiled program per stage, or batches of pairs.

Only this module pads shapes, so that all shapes of similar sizes share compiled programs. All maps that go in
and come out have one entry per vertex of X.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int64

from jaxsmw.core.refinement import Refinement, RefineSettings, refine
from jaxsmw.core.refiner import Problem, Refiner, Samples, State, recover_reverse
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_candidates
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.batches import pad_rows, padded_size, refine_pairs
from jaxsmw.runtime.compilation import compile_ahead, compiled

# Shapes with more vertices than this number are not padded, because padding would need too much memory.
_PADDED_UP_TO = 50_000


def program_size(number_of_vertices: int) -> int:
    """Return the number of vertices to which a shape is padded; large shapes are not padded."""
    return number_of_vertices if number_of_vertices > _PADDED_UP_TO else padded_size(number_of_vertices)


@dataclass(frozen=True, eq=False)
class SpectralPair:
    """Two spectra in comparable units, on which stages run.

    **Attributes:**

    - `x`, `y`: the spectra of X (m vertices) and Y (n vertices), each a `Spectrum`.
    - `samples`: samples of X (s,) and of Y (s,) in farthest-point order, as 0-based vertices; None if no
      stage iterates on samples.
    - `partial`: whether one of the shapes is a partial shape.
    - `common_limit`: whether both spectra must end at a common eigenvalue; see `common_range`.
    """

    x: Spectrum
    y: Spectrum
    samples: Samples | None = None
    partial: bool = False
    common_limit: bool = False

    @property
    def both(self) -> tuple[Spectrum, Spectrum]:
        """The spectra of X and Y."""
        return self.x, self.y

    @cached_property
    def padded(self) -> SpectralPair:
        """The pair with padded spectra."""
        pad = compiled(Spectrum.pad)
        x, y = (pad(spectrum, program_size(spectrum.mask.shape[0])) for spectrum in (self.x, self.y))
        return SpectralPair(x, y, self.samples, self.partial, self.common_limit)

    def seen_by(self, stage: Stage) -> SpectralPair:
        """Return the pair, restricted to the eigenvectors, descriptors and samples that a stage uses.

        If one of the spectra has no crease eigenvectors, the result has none either. This happens in a
        collection if only one of two meshes is large.
        """
        spectra = self.x, self.y
        creased = all(spectrum.crease_eigenvectors is not None for spectrum in spectra)
        number_of_creases = stage.number_of_crease_eigenvectors if creased else 0
        x, y = (
            spectrum.truncate(stage.number_of_eigenvectors)
            .with_descriptors(_first(spectrum.descriptors, stage.number_of_descriptors))
            .with_crease_eigenvectors(_first(spectrum.crease_eigenvectors, number_of_creases))
            for spectrum in spectra
        )
        fewer = any(
            now.eigenvalues.shape != all_.eigenvalues.shape for now, all_ in zip((x, y), spectra, strict=True)
        )
        if self.common_limit and fewer:
            x, y = common_range(x, y)
        samples = None
        if stage.number_of_samples is not None and self.samples is not None:
            samples = (
                self.samples[0][: stage.number_of_samples],
                self.samples[1][: stage.number_of_samples],
            )
        return SpectralPair(x, y, samples, self.partial, self.common_limit)


def _first(columns: Float[Array, "n d"] | None, number: int) -> Float[Array, "n c"] | None:
    """Return the first columns of an array; None if there is no array, or if the number is 0."""
    return columns[:, :number] if number and columns is not None else None


def common_range(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Spectrum, Spectrum]:
    """Cut two spectra at a common limit.

    The limit is the largest eigenvalue of X or the largest eigenvalue of Y, whichever is smaller. Eigenpairs
    with eigenvalues above this limit are removed. The MWP paper truncates the spectra of partial shapes in
    the same way.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, each a `Spectrum`, in the same unit of length.

    **Returns:** The spectra of X and Y with k_X and k_Y eigenvectors, in the same unit. One of the spectra is
    unchanged.
    """
    spectra = spectrum_x, spectrum_y
    last = min(float(spectrum.eigenvalues[-1]) for spectrum in spectra)
    cut = [s.truncate(int((np.asarray(s.eigenvalues) <= last).sum())) for s in spectra]
    return cut[0], cut[1]


class Start(NamedTuple):
    """A map from which stages start.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `origin`: where the map comes from: the name of an initial map, `"map"` for a given map, `"landmarks"`,
      or `"stages"` for the map of earlier stages.
    - `excluded`: a mask of the vertices of X (m,) that the first stage leaves out; None to use all vertices.
      If the stage iterates on samples, the vertices are left out only in its first functional map.
    """

    pointwise_map: Int64[np.ndarray, " m"]
    origin: str = "stages"
    excluded: Bool[np.ndarray, " m"] | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """The outcome of several stages.

    **Attributes:**

    - `initial_map`: the map from which the first stage started (m,), 0-based vertices of Y.
    - `refinements`: one `Refinement` per stage, up to the first stage that failed.
    """

    initial_map: Int64[np.ndarray, " m"]
    refinements: tuple[Refinement, ...] = ()

    @cached_property
    def successful(self) -> bool:
        """Whether all stages succeeded."""
        return all(bool(found.result == RESULTS.successful) for found in self.refinements)

    @cached_property
    def pointwise_map(self) -> Int64[np.ndarray, " m"]:
        """The map of the last stage that has run (m,), or the initial map if no stage has run."""
        if not self.refinements:
            return self.initial_map
        return np.asarray(self.last.pointwise_map)[: len(self.initial_map)].astype(np.int64)

    @property
    def last(self) -> Refinement:
        """The refinement of the last stage that has run."""
        return self.refinements[-1]

    @property
    def uncertainty(self) -> float:
        """The uncertainty of the last stage whose refiner computes one; 0 if there is none."""
        known = [u for found in self.refinements if (u := found.state.uncertainty) is not None]
        return float(known[-1]) if known else 0.0

    def followed_by(self, later: Outcome) -> Outcome:
        """Return the outcome of these stages and later ones, which started from their map."""
        return Outcome(self.initial_map, self.refinements + later.refinements)


def run(
    stages: Sequence[Stage], spectra: SpectralPair, starts: Iterable[Start], *, history: bool = False
) -> Iterator[Outcome]:
    """Run stages on one pair from each start.

    The function does not wait for the last stage of a start, so that the device refines further starts while
    the host looks at a finished one.

    **Arguments:**

    - `stages`: the stages, in the order in which they run. A start runs no stage after its first failure.
    - `spectra`: the spectra and samples of the pair.
    - `starts`: the starts.
    - `history`: whether to record a `History` of each stage; see `jaxsmw.refine`.

    **Returns:** An iterator over one `Outcome` per start, in the order of the starts.
    """
    seen = [spectra.padded.seen_by(stage) for stage in stages]
    return (_run_one(stages, seen, start, history) for start in starts)


def _run_one(stages: Sequence[Stage], seen: Sequence[SpectralPair], start: Start, history: bool) -> Outcome:
    refinements: list[Refinement] = []
    matches = padded_map(start.pointwise_map)
    for number, (stage, spectra) in enumerate(zip(stages, seen, strict=True)):
        if number and refinements[-1].result != RESULTS.successful:
            break
        if number == 0 and start.excluded is not None:
            excluded = jnp.asarray(pad_rows(start.excluded, len(spectra.x.mask)))
            spectra = replace(spectra, x=spectra.x.excluding(excluded))
        x, y, samples, partial = spectra.x, spectra.y, spectra.samples, spectra.partial
        settings: RefineSettings = {**stage.settings, "partial": partial, "history": history}
        found = compiled(refine)(x, y, matches, samples=samples, **settings)
        refinements.append(found)
        matches = found.pointwise_map
    return Outcome(start.pointwise_map, tuple(refinements))


def run_batches(
    stages: Sequence[Stage],
    tasks: Sequence[tuple[SpectralPair, Start]],
    *,
    batch_size: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> list[Outcome]:
    """Run stages on many pairs of full shapes in batches, each stage for all pairs before the next stage.

    **Arguments:**

    - `stages`: the stages, in the order in which they run.
    - `tasks`: each pair with its start. Pairs with the same spectrum object share it on the devices.
    - `batch_size`, `devices`: see `jaxsmw.refine_pairs`.

    **Returns:** One `Outcome` per task.
    """
    spectra: dict[int, Spectrum] = {}
    samples: dict[int, Int[Array, " s"] | None] = {}
    for pair, _ in tasks:
        for spectrum, of_side in zip((pair.x, pair.y), pair.samples or (None, None), strict=True):
            spectra.setdefault(id(spectrum), spectrum)
            samples.setdefault(id(spectrum), of_side)
    row = {key: number for number, key in enumerate(spectra)}
    pairs = [(row[id(pair.x)], row[id(pair.y)]) for pair, _ in tasks]
    maps = [np.asarray(start.pointwise_map) for _, start in tasks]
    outcomes = [Outcome(start.pointwise_map) for _, start in tasks]
    for stage in stages:
        alone = [SpectralPair(spectrum, spectrum).seen_by(stage).x for spectrum in spectra.values()]
        chosen = None
        if stage.number_of_samples is not None:
            chosen = [
                of_shape[: stage.number_of_samples] for of_shape in samples.values() if of_shape is not None
            ]
        refined = refine_pairs(
            alone,
            pairs,
            maps,
            samples=chosen,
            batch_size=batch_size,
            devices=devices,
            **stage.settings,
        )
        for number, found in refined:
            maps[number] = np.asarray(found.pointwise_map)
            # After a failure, later stages still run for this pair, but their results are ignored.
            if outcomes[number].successful:
                before = outcomes[number]
                outcomes[number] = Outcome(before.initial_map, (*before.refinements, found))
    return outcomes


def padded_map(pointwise_map: Int64[np.ndarray, " m"]) -> Int[Array, " p"]:
    """Return a map as a padded JAX array of the type that refinement returns, as programs expect it."""
    padded = pad_rows(pointwise_map, program_size(len(pointwise_map)))
    return jax.device_put(padded.astype(np.int32))


def compile_stage(
    stage: Stage, number_x: int, number_y: int, *, partial: bool = False, history: bool = False
) -> None:
    """Compile the program of a stage in the background. Both shapes must have its number of eigenvectors.

    **Arguments:**

    - `stage`: the stage.
    - `number_x`, `number_y`: the numbers of vertices of X and of Y.
    - `partial`: whether one of the shapes is a partial shape.
    - `history`: whether the program records a `History`; see `jaxsmw.refine`.
    """
    sizes = program_size(number_x), program_size(number_y)

    def arguments() -> tuple[tuple, dict[str, Any]]:
        samples = None
        if (s := stage.number_of_samples) is not None:
            samples = (jnp.zeros(s, int),) * 2
        x, y = (_outline(stage, size) for size in sizes)
        return (x, y, jnp.zeros(sizes[0], jnp.int32)), {"samples": samples}

    settings: RefineSettings = {**stage.settings, "partial": partial, "history": history}
    compile_ahead(refine, arguments, **settings)


def _outline(stage: Stage, number_of_vertices: int) -> Spectrum:
    """Return a spectrum of zeros, of which only the sizes matter."""
    n, k, d = number_of_vertices, stage.number_of_eigenvectors, stage.number_of_descriptors
    c = stage.number_of_crease_eigenvectors
    spectrum = Spectrum(jnp.zeros(k), jnp.zeros((n, k)), jnp.zeros(n), jnp.zeros(n, bool))
    described = spectrum.with_descriptors(jnp.zeros((n, d)) if d else None)
    creased = described.with_crease_eigenvectors(jnp.zeros((n, c)) if c else None)
    return creased.with_positions(jnp.zeros((n, 3)), jnp.zeros((n, 3)))


def reverse_map(refiner: Refiner, spectra: SpectralPair, state: State) -> Int64[np.ndarray, " n"]:
    """Return the map Y -> X (n,) of all vertices, 0-based vertices of X, from the last state of a stage.

    **Arguments:**

    - `refiner`: the refiner of the stage.
    - `spectra`: the spectra that the stage has seen, without padding; see `SpectralPair.seen_by`.
    - `state`: the `State` of the refiner.
    """
    found = compiled(recover_reverse)(refiner, _problem(spectra), state)
    return np.asarray(found)[: spectra.y.mask.shape[0]].astype(np.int64)


def embeddings(
    refiner: Refiner, spectra: SpectralPair, state: State
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """Return the embeddings of X and Y in which a stage has compared vertices; see `reverse_map`."""
    padded = compiled(_embeddings)(refiner, _problem(spectra), state)
    x, y = (np.asarray(points) for points in padded)
    return x[: spectra.x.mask.shape[0]], y[: spectra.y.mask.shape[0]]


def _problem(spectra: SpectralPair) -> Problem:
    return Problem(spectra.padded.x, spectra.padded.y, partial=spectra.partial)


def _embeddings(
    refiner: Refiner, problem: Problem, state: State
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    return refiner.embeddings(refiner.prepare(problem), state)


def nearest_rows(
    queries: Float[np.ndarray, "a d"], database: Float[np.ndarray, "b d"], mask: Bool[np.ndarray, " b"]
) -> Int64[np.ndarray, " a"]:
    """Return the row of the nearest point of the database for each query (a,), 0-based.

    **Arguments:**

    - `queries`, `database`: the points, (a, d) and (b, d), of the same float type.
    - `mask`: the rows of the database that may be returned (b,).
    """

    def padded(rows: np.ndarray) -> Array:
        return jax.device_put(pad_rows(rows, padded_size(len(rows))))

    found = compiled(nearest_neighbor)(padded(queries), padded(database), database_mask=padded(mask))
    return np.asarray(found)[: len(queries)].astype(np.int64)


def nearest_points(
    queries: Float[np.ndarray, "m d"],
    database: Float[np.ndarray, "n d"],
    faces: Int64[np.ndarray, "f 3"],
    rows: Int64[np.ndarray, " c"],
    candidates: Int64[np.ndarray, " c"],
) -> tuple[Int64[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    """Return the nearest point on given candidate triangles for each query.

    **Arguments:**

    - `queries`, `database`: the queries (m, d), and the corners of the triangles (n, d).
    - `faces`: the triangles (f, 3), as rows of the database.
    - `rows`, `candidates`: pairs of a query (c,) and a triangle (c,) that is a candidate for it.

    **Returns:** The triangle (m,), and the barycentric weights (m, 3) of the point on it.
    """
    padding = padded_size(len(rows)) - len(rows)
    rows, candidates = (np.pad(values, (0, padding), "edge") for values in (rows, candidates))
    padded = (
        pad_rows(queries, program_size(len(queries))),
        pad_rows(database, program_size(len(database))),
        pad_rows(faces, padded_size(len(faces))),
        rows,
        candidates,
    )
    found = compiled(nearest_point_on_candidates)(*jax.device_put(padded))
    nearest, weights = (np.asarray(values)[: len(queries)] for values in found)
    return nearest.astype(np.int64), weights.astype(np.float64)
