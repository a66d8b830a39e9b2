"""Runs stages: pads the spectra of a pair, and runs one compiled program per stage, or batches of pairs.

Shapes of similar sizes are padded to one size, so that they share compiled programs. Only this module and
`jaxsmw.runtime.batches` pad shapes. All maps that go in and come out have one entry per vertex of X.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.batches import pad_rows, program_size, refine_pairs
from jaxsmw.runtime.compilation import compile_ahead, compiled


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

    @property
    def has_alternatives(self) -> bool:
        """Whether alternative maps can exist. They are variants of the initial map from SHOT."""
        return self.origin == "shot"

    @property
    def is_rigid(self) -> bool:
        """Whether the map comes from a rigid alignment of shapes that differ in form, not in pose."""
        return self.origin == "aligned"


@dataclass(frozen=True, eq=False)
class StageRun:
    """A stage that has run on a pair, with the state from which further results can be computed.

    **Attributes:**

    - `stage`: the `Stage`.
    - `spectra`: the spectra of the pair, without padding.
    - `refinement`: the `Refinement`, whose vertices may be padded.
    """

    stage: Stage
    spectra: SpectralPair
    refinement: Refinement

    @cached_property
    def seen(self) -> SpectralPair:
        """The spectra that the stage has seen."""
        return self.spectra.seen_by(self.stage)

    def reverse_map(self) -> Int64[np.ndarray, " n"]:
        """Return the map Y -> X (n,) of all vertices, 0-based vertices of X, from the last state."""
        reverse = compiled(recover_reverse)(*self._arguments)
        return np.asarray(reverse)[: self.spectra.y.mask.shape[0]].astype(np.int64)

    def embeddings(self) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
        """Return the embeddings of X and Y in which the last search has compared vertices."""
        x, y = (np.asarray(points) for points in compiled(_embeddings)(*self._arguments))
        return x[: self.spectra.x.mask.shape[0]], y[: self.spectra.y.mask.shape[0]]

    @property
    def _arguments(self) -> tuple[Refiner, Problem, State]:
        problem = Problem(*self.seen.padded.both, partial=self.spectra.partial)
        return self.stage.refiner, problem, self.refinement.state


def _embeddings(
    refiner: Refiner, problem: Problem, state: State
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    return refiner.embeddings(refiner.prepare(problem), state)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The outcome of several stages.

    **Attributes:**

    - `initial_map`: the map from which the first stage started (m,), 0-based vertices of Y.
    - `runs`: one `StageRun` per stage, up to the first stage that failed.
    """

    initial_map: Int64[np.ndarray, " m"]
    runs: tuple[StageRun, ...] = ()

    @cached_property
    def successful(self) -> bool:
        """Whether all stages succeeded."""
        return all(bool(run.refinement.result == RESULTS.successful) for run in self.runs)

    @cached_property
    def pointwise_map(self) -> Int64[np.ndarray, " m"]:
        """The map of the last stage that has run (m,), or the initial map if no stage has run."""
        if not self.runs:
            return self.initial_map
        padded = np.asarray(self.last.refinement.pointwise_map)
        return padded[: len(self.initial_map)].astype(np.int64)

    @property
    def last(self) -> StageRun:
        """The last stage that has run."""
        return self.runs[-1]

    @property
    def uncertainty(self) -> float:
        """The uncertainty of the last stage whose refiner computes one; 0 if there is none."""
        known = [u for run in self.runs if (u := run.refinement.state.uncertainty) is not None]
        return float(known[-1]) if known else 0.0

    def followed_by(self, later: Outcome) -> Outcome:
        """Return the outcome of these stages and later ones, which started from their map."""
        return Outcome(self.initial_map, self.runs + later.runs)


def run(stages: Sequence[Stage], spectra: SpectralPair, start: Start) -> Outcome:
    """Run stages on one pair, in their order, until one of them fails.

    The function does not wait for the last stage, so that the device refines further starts while the host
    looks at a finished one.
    """
    runs: list[StageRun] = []
    matches = padded_map(start.pointwise_map)
    for stage in stages:
        if runs and runs[-1].refinement.result != RESULTS.successful:
            break
        seen = spectra.padded.seen_by(stage)
        if not runs and start.excluded is not None:
            excluded = jnp.asarray(pad_rows(start.excluded, len(seen.x.mask)))
            seen = replace(seen, x=seen.x.excluding(excluded))
        settings: RefineSettings = {**stage.settings, "partial": seen.partial}
        refinement = compiled(refine)(*seen.both, matches, samples=seen.samples, **settings)
        runs.append(StageRun(stage, spectra, refinement))
        matches = refinement.pointwise_map
    return Outcome(start.pointwise_map, tuple(runs))


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
    maps = [np.asarray(start.pointwise_map) for _, start in tasks]
    outcomes = [Outcome(start.pointwise_map) for _, start in tasks]
    for stage in stages:
        seen = _seen_by(stage, [pair for pair, _ in tasks])
        # Pairs with and without crease eigenvectors need different programs.
        for creased in (True, False):
            numbers = [
                i for i, pair in enumerate(seen) if (pair.x.crease_eigenvectors is not None) == creased
            ]
            shapes = {id(spectrum): spectrum for i in numbers for spectrum in seen[i].both}
            samples = {
                id(spectrum): of_shape
                for i in numbers
                for spectrum, of_shape in zip(seen[i].both, seen[i].samples or (), strict=False)
            }
            row = {key: number for number, key in enumerate(shapes)}
            refined = refine_pairs(
                list(shapes.values()),
                [(row[id(seen[i].x)], row[id(seen[i].y)]) for i in numbers],
                [maps[i] for i in numbers],
                samples=[samples[key] for key in shapes] if samples else None,
                batch_size=batch_size,
                devices=devices,
                **stage.settings,
            )
            for number, refinement in refined:
                i = numbers[number]
                maps[i] = np.asarray(refinement.pointwise_map)
                # After a failure, later stages still run for this pair, but their results are ignored.
                if (before := outcomes[i]).successful:
                    runs = (*before.runs, StageRun(stage, tasks[i][0], refinement))
                    outcomes[i] = Outcome(before.initial_map, runs)
    return outcomes


def _seen_by(stage: Stage, pairs: Sequence[SpectralPair]) -> list[SpectralPair]:
    """Return the pairs as a stage sees them. Pairs that share a spectrum object still share it."""
    spectra: dict[tuple[int, bool], Spectrum] = {}
    restricted = []
    for pair in pairs:
        seen = pair.seen_by(stage)
        creased = seen.x.crease_eigenvectors is not None
        x, y = (
            spectra.setdefault((id(given), creased), spectrum)
            for given, spectrum in zip(pair.both, seen.both, strict=True)
        )
        restricted.append(replace(seen, x=x, y=y))
    return restricted


def padded_map(pointwise_map: Int64[np.ndarray, " m"]) -> Int[Array, " p"]:
    """Return a map as a padded JAX array of the type that refinement returns, as programs expect it."""
    padded = pad_rows(pointwise_map, program_size(len(pointwise_map)))
    return jax.device_put(padded.astype(np.int32))


def compile_stage(stage: Stage, number_x: int, number_y: int, *, partial: bool = False) -> None:
    """Compile the program of a stage in the background. Both shapes must have its number of eigenvectors.

    **Arguments:**

    - `stage`: the stage.
    - `number_x`, `number_y`: the numbers of vertices of X and of Y.
    - `partial`: whether one of the shapes is a partial shape.
    """
    sizes = program_size(number_x), program_size(number_y)

    def arguments() -> tuple[tuple, dict[str, Any]]:
        samples = None
        if (s := stage.number_of_samples) is not None:
            samples = (jnp.zeros(s, int),) * 2
        x, y = (_outline(stage, size) for size in sizes)
        return (x, y, jnp.zeros(sizes[0], jnp.int32)), {"samples": samples}

    settings: RefineSettings = {**stage.settings, "partial": partial}
    compile_ahead(refine, arguments, **settings)


def _outline(stage: Stage, number_of_vertices: int) -> Spectrum:
    """Return a spectrum of zeros, of which only the sizes matter."""
    n, k, d = number_of_vertices, stage.number_of_eigenvectors, stage.number_of_descriptors
    c = stage.number_of_crease_eigenvectors
    spectrum = Spectrum(jnp.zeros(k), jnp.zeros((n, k)), jnp.zeros(n), jnp.zeros(n, bool))
    described = spectrum.with_descriptors(jnp.zeros((n, d)) if d else None)
    creased = described.with_crease_eigenvectors(jnp.zeros((n, c)) if c else None)
    return creased.with_positions(jnp.zeros((n, 3)), jnp.zeros((n, 3)))
