"""Runs stages: one compiled program per stage on one pair, or batches of pairs.

Shapes of similar sizes are padded to one size, so that they share compiled programs. All maps that go in and
come out have one entry per vertex of X.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Int64

from jaxsmw.core.refinement import refine
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.matching.outcome import Outcome, StageRun, Start
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.batches import pad_rows, program_size, refine_pairs
from jaxsmw.runtime.compilation import compile_ahead, compiled


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
        settings = stage.settings(partial=seen.partial)
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

    **Raises:** `ValueError` if a pair is partial, or a start excludes vertices.
    """
    if any(pair.partial or start.excluded is not None for pair, start in tasks):
        raise ValueError("batches contain only full shapes and starts that use all vertices")
    maps = [np.asarray(start.pointwise_map) for _, start in tasks]
    outcomes = [Outcome(start.pointwise_map) for _, start in tasks]
    for stage in stages:
        seen = _seen_by(stage, [pair for pair, _ in tasks])
        shapes = {id(spectrum): spectrum for pair in seen for spectrum in pair.both}
        samples = {
            id(spectrum): of_shape
            for pair in seen
            for spectrum, of_shape in zip(pair.both, pair.samples or (), strict=False)
        }
        row = {key: number for number, key in enumerate(shapes)}
        refined = refine_pairs(
            list(shapes.values()),
            [(row[id(pair.x)], row[id(pair.y)]) for pair in seen],
            maps,
            samples=[samples[key] for key in shapes] if samples else None,
            batch_size=batch_size,
            devices=devices,
            **stage.settings(),
        )
        for number, refinement in refined:
            maps[number] = np.asarray(refinement.pointwise_map)
            # After a failure, later stages still run for this pair, but their results are ignored.
            if (before := outcomes[number]).successful:
                runs = (*before.runs, StageRun(stage, tasks[number][0], refinement))
                outcomes[number] = Outcome(before.initial_map, runs)
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

    compile_ahead(refine, arguments, **stage.settings(partial=partial))


def _outline(stage: Stage, number_of_vertices: int) -> Spectrum:
    """Return a spectrum of zeros, of which only the sizes matter."""
    n, k, d = number_of_vertices, stage.number_of_eigenvectors, stage.number_of_descriptors
    c = stage.number_of_crease_eigenvectors
    spectrum = Spectrum(jnp.zeros(k), jnp.zeros((n, k)), jnp.zeros(n), jnp.zeros(n, bool))
    described = spectrum.with_descriptors(jnp.zeros((n, d)) if d else None)
    creased = described.with_crease_eigenvectors(jnp.zeros((n, c)) if c else None)
    return creased.with_positions(jnp.zeros((n, 3)), jnp.zeros((n, 3)))
