"""A data set measured with one command: precomputed, matched by several methods, evaluated, and kept.

Whatever interrupts it, what is finished is on the disk, and the same command goes on from there.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int
from tqdm import tqdm

import jaxsmw
from jaxsmw.core.batch import padded_size
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.errors import InputError
from jaxsmw.evaluation.datasets import DataPair, DataSet, read_pairs
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.evaluation.journal import Journal, Row, claim_directory, code_digest
from jaxsmw.evaluation.metrics import LARGEST_THRESHOLD, THRESHOLDS, coverage, geodesic_error
from jaxsmw.evaluation.opponents import METHODS, MOST_SAMPLES, SpectralPair
from jaxsmw.evaluation.workers import run_tasks
from jaxsmw.geometry.cache import recomputing
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.mesh_files import read_mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.matching import Start, initial_map

CURVE = np.linspace(0, LARGEST_THRESHOLD, 51)
"""Where correspondence quality curves are kept, in square roots of the area."""
FIGURES = (
    "mean",
    "median",
    *(f"within_{threshold}" for threshold in THRESHOLDS),
    "area_under_curve",
    "unreachable",
    "coverage",
)
"""What is kept of each map besides its curve; lengths in square roots of the area."""


@dataclass(frozen=True)
class Settings:
    """All that results depend on besides data and code.

    **Attributes:**

    - `init`: what all methods start from; see `jaxsmw.match`.
    - `evaluated_points`: so many rows of each ground truth, the same for all methods; all if None.
    - `seed`: of their draw.
    """

    init: Start = "shot"
    evaluated_points: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class Task:
    """What is still missing of one pair."""

    pair: DataPair
    methods: tuple[str, ...]


def choose_pairs(data_set: DataSet, wanted: str | None, seed: int) -> list[DataPair]:
    """The pairs of a data set that are wanted, in the set's order.

    **Arguments:**

    - `wanted`: how many, drawn without replacement (all if there are no more), or a file that lists them (see
      `read_pairs`); all if None.
    - `seed`: of the draw.

    **Raises:** `InputError` if the number is not positive, or the file names pairs that the set has not.
    """
    pairs = list(data_set.pairs)
    if wanted is None:
        return pairs
    if re.fullmatch(r"[+-]?\d+", wanted):
        count = int(wanted)
        if count < 1:
            raise InputError(f"{count} pairs cannot be measured: ask for at least 1.")
        rows = np.random.default_rng(seed).permutation(len(pairs))[:count]
        return [pairs[row] for row in np.sort(rows)]
    known = {(pair.source, pair.target): pair for pair in pairs}
    listed = read_pairs(wanted, data_set.shapes)
    if unknown := [names for names in listed if names not in known]:
        raise InputError(
            f"{wanted}: {' to '.join(unknown[0])} is not a pair of {data_set.directory}, which has "
            f"{len(pairs)}: remove it from the list."
        )
    return [known[names] for names in dict.fromkeys(listed)]


class Results(NamedTuple):
    """What a benchmark found, every value as text.

    **Attributes:**

    - `rows`: one for each pair and method, in this order: `source`, `target`, `method`, `result`, `seconds`
      (from the start to the map, without compilation), `FIGURES`, and `curve`, the shares of points with an
      error of at most `CURVE`.
    - `shapes`: for each shape its number of `vertices` and how long its spectrum and descriptors took.
    """

    rows: list[Row]
    shapes: dict[str, Row]


def run_benchmark(
    pairs: Sequence[DataPair],
    output: Path,
    methods: Sequence[str],
    settings: Settings,
    executor: Executor,
) -> Results:
    """Measure what is missing of some pairs; keep each as it comes.

    **Arguments:**

    - `pairs`: what to match.
    - `output`: a directory that exists; gets `results.csv`, `shapes.csv` and `provenance.json`.
    - `methods`: keys of `jaxsmw.evaluation.opponents.METHODS`.
    - `settings`: must be those of results that are there already.
    - `executor`: what works.

    **Raises:** `InputError` if the directory holds results of something else, or pairs could not be measured
    (all others are kept).
    """
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise InputError(f"{unknown[0]!r} is no method: choose from {', '.join(METHODS)}.")
    code = sorted(Path(jaxsmw.__file__).parent.glob("[ceg][ove]*/*.py"))
    claim_directory(output, {"settings": asdict(settings), "versions": {"code": code_digest(code)}})
    results = Journal(output / "results.csv", ["source", "target", "method"])
    shapes = Journal(output / "shapes.csv", ["shape"])
    tasks = []
    for pair in pairs:
        missing = tuple(name for name in methods if (pair.source, pair.target, name) not in results)
        if missing:
            tasks.append(Task(pair, missing))
    needed = {}
    for task in tasks:
        needed[task.pair.source] = task.pair.source_file
        needed[task.pair.target] = task.pair.target_file
    largest = max(method.number_of_eigenvectors for method in METHODS.values())
    missing_shapes = [(name, file) for name, file in needed.items() if (name,) not in shapes]

    failed: list[str] = []
    _run("shapes", partial(measure_shape, k=largest), missing_shapes, executor, shapes, failed)
    _run("pairs", partial(measure_pair, k=largest, settings=settings), tasks, executor, results, failed)
    if failed:
        raise InputError(
            f"{len(failed)} could not be measured, the others are kept in {output}: {'; '.join(failed)}. "
            "Mend them and start again."
        )
    return Results(
        [results[pair.source, pair.target, name] for pair in pairs for name in methods],
        {name: shapes[(name,)] for pair in pairs for name in (pair.source, pair.target)},
    )


def _run(
    what: str, measure: Any, tasks: Sequence[Any], executor: Executor, journal: Journal, failed: list[str]
) -> None:
    """Measure all tasks with a progress bar; note which fail and go on."""
    if not tasks:
        return
    with tqdm(total=len(tasks), desc=what, unit=what[:-1], smoothing=0) as progress:
        run_tasks(
            measure,
            tasks,
            executor,
            keep=lambda _, rows: journal.append(rows),
            failed=lambda task, error: failed.append(f"{_name(task)} ({error})"),
            advance=progress.update,
        )


def _name(task: Any) -> str:
    return task.pair.name if isinstance(task, Task) else task[0]


def measure_shape(shape: tuple[str, Path], k: int) -> list[Row]:
    """Precompute what all pairs of a shape share, and note how long each part took."""
    name, file = shape
    with recomputing():
        seconds, mesh = {}, read_mesh(file)
        for what, compute in (
            ("spectrum", lambda: compute_spectrum(mesh, k)),
            ("descriptors", lambda: shot_descriptors(mesh)),
        ):
            began = time.perf_counter()
            compute()
            seconds[f"seconds_{what}"] = f"{time.perf_counter() - began:.4f}"
    return [{"shape": name, "vertices": len(mesh.vertices), **seconds}]


def measure_pair(task: Task, k: int, settings: Settings) -> list[Row]:
    """Match a pair with every method and measure the maps; a row for each."""
    mesh_x, mesh_y = (read_mesh(file) for file in (task.pair.source_file, task.pair.target_file))
    truth = task.pair.ground_truth(mesh_x, mesh_y)
    m, pair = len(mesh_x.vertices), _spectral_pair(mesh_x, mesh_y, k, settings.init)
    rows = []
    for name in task.methods:
        method = METHODS[name]
        sizes = pair.spectrum_x.eigenvectors.shape, pair.spectrum_y.eigenvectors.shape
        if (name, sizes) not in _compiled:
            jax.block_until_ready(method(pair))
            _compiled.add((name, sizes))
        began = time.perf_counter()
        pointwise_map, result = jax.block_until_ready(method(pair))
        seconds = time.perf_counter() - began
        identity = {"source": task.pair.source, "target": task.pair.target, "method": name}
        ending = "successful" if result == RESULTS.successful else sentence(result)
        figures = _evaluate(mesh_y, np.asarray(pointwise_map)[:m], truth, settings)
        rows.append(identity | {"result": ending, "seconds": f"{seconds:.5f}"} | figures)
    return rows


# Methods whose programs for these sizes this process has compiled already: times are of what comes after.
_compiled: set[tuple[str, Any]] = set()


def _spectral_pair(mesh_x: Mesh, mesh_y: Mesh, k: int, init: Start) -> SpectralPair:
    """Spectra, start and samples, padded so that few programs serve all pairs."""
    spectrum_x, spectrum_y = (compute_spectrum(mesh, k) for mesh in (mesh_x, mesh_y))
    start = initial_map(mesh_x, mesh_y, spectrum_x, spectrum_y, init=init)
    sizes = [padded_size(len(mesh.vertices)) for mesh in (mesh_x, mesh_y)]
    samples_x, samples_y = (farthest_point_samples(mesh, MOST_SAMPLES) for mesh in (mesh_x, mesh_y))
    return SpectralPair(
        spectrum_x.pad(sizes[0]),
        spectrum_y.pad(sizes[1]),
        jnp.asarray(np.pad(start, (0, sizes[0] - len(start))), jnp.int32),
        (jnp.asarray(samples_x), jnp.asarray(samples_y)),
    )


def _evaluate(
    mesh_y: Mesh, pointwise_map: Int[np.ndarray, " m"], truth: GroundTruth, settings: Settings
) -> Row:
    """The figures of one map; all NaN where it failed."""
    if (pointwise_map < 0).any():
        return dict.fromkeys(FIGURES, "nan") | {"curve": " ".join(["nan"] * len(CURVE))}
    error = geodesic_error(
        mesh_y, pointwise_map, truth, number_of_samples=settings.evaluated_points, seed=settings.seed
    )
    figures = (
        error.mean,
        error.median,
        *error.within.values(),
        error.area_under_curve(),
        error.unreachable,
        coverage(mesh_y, pointwise_map),
    )
    curve = error.correspondence_quality_curve(CURVE)
    return {name: f"{value:.7f}" for name, value in zip(FIGURES, figures, strict=True)} | {
        "curve": " ".join(f"{share:.5f}" for share in curve)
    }
