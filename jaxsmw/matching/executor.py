"""Runs stages: by NumPy or JAX on one pair, or by JAX on batches of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxsmw.core.arrays import Array
from jaxsmw.core.refinement import Refinement, refine, refine_at_once
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.matching.outcome import Outcome, StageRun, Start
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.backends import chosen_backend
from jaxsmw.runtime.threads import side_by_side


def run(stages: Sequence[Stage], spectra: SpectralPair, start: Start) -> Outcome:
    """Run stages on one pair, in their order, until one of them fails.

    NumPy runs a stage if the spectra are arrays of NumPy and the refiner takes its namespace from its arrays.
    JAX runs all other stages, and the function does not wait for the last of them.
    """
    runs: list[StageRun] = []
    matches: Int[Array, " m"] = start.pointwise_map.astype(np.int32)
    for stage in stages:
        if runs and runs[-1].refinement.result != RESULTS.successful:
            break
        seen = spectra.seen_by(stage)
        if not runs and start.excluded is not None:
            seen = replace(seen, x=seen.x.excluding(start.excluded))
        refinement = refine_stage(stage, seen, matches)
        runs.append(StageRun(stage, spectra, refinement))
        matches = refinement.pointwise_map
    return Outcome(start.pointwise_map, tuple(runs))


def run_all(stages: Sequence[Stage], tasks: Sequence[tuple[SpectralPair, Start]]) -> list[Outcome]:
    """Run stages on several pairs of equal sizes: in one batch on accelerators, else in two threads.

    Pairs that batches cannot contain run one after another; see `run_batches`.
    """
    if chosen_backend("auto") == "numpy":
        return list(side_by_side(lambda task: run(stages, *task), *tasks))
    alone = [pair.partial or pair.on_host or start.excluded is not None for pair, start in tasks]
    batch = iter(run_batches(stages, [task for task, one in zip(tasks, alone, strict=True) if not one]))
    return [run(stages, *task) if one else next(batch) for task, one in zip(tasks, alone, strict=True)]


def refine_stage(stage: Stage, seen: SpectralPair, matches: Int[Array, " m"]) -> Refinement:
    """Run a stage on the spectra that it sees, from a map (m,), by NumPy if possible."""
    if seen.on_host and stage.refiner.uses_namespaces:
        settings = stage.settings(partial=seen.partial, traced=False)
        with np.errstate(all="ignore"):  # status codes report failures
            return refine_at_once(*seen.both, np.asarray(matches), samples=seen.samples, **settings)
    from jaxsmw.runtime.compilation import compiled

    settings = stage.settings(partial=seen.partial)
    return compiled(refine)(*seen.both, matches, samples=seen.samples, **settings)


def run_batches(
    stages: Sequence[Stage],
    tasks: Sequence[tuple[SpectralPair, Start]],
    *,
    batch_size: int | None = None,
    devices: Sequence[Any] | None = None,
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
    from jaxsmw.runtime.batches import refine_pairs

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
