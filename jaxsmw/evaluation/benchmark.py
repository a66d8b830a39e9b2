"""A data set measured with one command: precomputed, matched by several methods, evaluated, and kept.

Whatever interrupts it, what is finished is on the disk, and the same command goes on from there.
"""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Int64
from tqdm import tqdm

from jaxsmw.core.functional_map import encode
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.descriptors import describe
from jaxsmw.errors import InputError
from jaxsmw.evaluation.datasets import DataPair, DataSet, read_pairs
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.evaluation.journal import Journal, Row, claimed_directory
from jaxsmw.evaluation.metrics import LARGEST_THRESHOLD, THRESHOLDS, coverage, geodesic_error
from jaxsmw.evaluation.opponents.opponents import (
    FIRST_EIGENVECTORS,
    MOST_EIGENVECTORS,
    MOST_SAMPLES,
    Method,
    PreparedPair,
    Published,
    published_file,
    read_published_map,
)
from jaxsmw.evaluation.workers import run_tasks
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.initial_maps.starts import Start, initial_map, other_starts
from jaxsmw.io.mesh_files import read_mesh
from jaxsmw.matching import paired_spectra
from jaxsmw.runtime.batches import pad_rows, padded_size
from jaxsmw.runtime.cache import recomputing
from jaxsmw.runtime.compilation import release_programs
from jaxsmw.runtime.provenance import code_digest, commit, machine, measured_code, versions
from jaxsmw.runtime.threads import one_blas_thread

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

    - `init`: what all methods start from: a descriptor (see `jaxsmw.match`), or a directory with maps
      `X_Y.map` computed elsewhere.
    - `mirrored`: take the mirrored truth where a map is nearer to that, for methods and starts that cannot
      tell left from right.
    - `evaluated_points`: so many rows of each ground truth, the same for all methods; all if None.
    - `seed`: of their draw.

    **Raises:** `InputError` if `init` is neither.
    """

    init: str = "shot"
    mirrored: bool = False
    evaluated_points: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.init not in get_args(Start) and not Path(self.init).is_dir():
            raise InputError(
                f"{self.init!r} is no start: choose from {', '.join(get_args(Start))}, or give a directory "
                "with maps X_Y.map."
            )


@dataclass(frozen=True)
class Task:
    """What is still missing of one pair."""

    pair: DataPair
    methods: dict[str, Method]


def choose_pairs(data_set: DataSet, wanted: str | None, seed: int) -> list[DataPair]:
    """The pairs of a data set that are wanted, in the set's order.

    **Arguments:**

    - `wanted`: how many, drawn without replacement (all if there are no more), or a file that lists some
      whose truth is known (see `read_pairs`), each of which counts once; all of the set's own if None.
    - `seed`: of the draw.

    **Raises:** `InputError` if the number is not positive, or the truth of a listed pair is not known.
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
    known = {pair.names: pair for pair in (*pairs, *data_set.others)}
    listed = read_pairs(wanted, data_set.shapes)
    if unknown := [names for names in listed if names not in known]:
        raise InputError(
            f"{wanted}: {data_set.directory} does not say which points of {' and '.join(unknown[0])} are the "
            "same: remove the pair from the list."
        )
    return [known[names] for names in dict.fromkeys(listed)]


class Results(NamedTuple):
    """What a benchmark found, every value as text.

    **Attributes:**

    - `rows`: one for each measured pair and method, in this order: `source`, `target`, `method`, `machine`,
      `result`, `seconds` (from the start to the map, without compilation), the `truth` that counted,
      `FIGURES`, and `curve`, the shares of points with an error of at most `CURVE`.
    - `shapes`: for each shape the `digest` of its file, its number of `vertices` and how long its spectrum
      and descriptors took.
    - `failures`: which shapes and pairs could not be measured, and why.
    """

    rows: list[Row]
    shapes: dict[str, Row]
    failures: dict[str, str]

    def check(self) -> None:
        """Pass only if all could be measured.

        **Raises:** `InputError` that gives every cause with its shapes and pairs.
        """
        if not self.failures:
            return
        causes: dict[str, list[str]] = {}
        for name, cause in self.failures.items():
            causes.setdefault(cause, []).append(name)
        lines = [f"{_some(names)}: {cause}" for cause, names in causes.items()]
        raise InputError(
            "\n".join(
                ["not everything could be measured; mend this and start again, the rest is kept:", *lines]
            )
        )


def _some(names: Sequence[str]) -> str:
    """The first of them, in words."""
    more = len(names) - _NAMED_FAILURES
    return ", ".join(names[:_NAMED_FAILURES]) + (f" and {more} more" if more > 0 else "")


# So many are named in a message; the others have the same fault.
_NAMED_FAILURES = 3


def run_benchmark(
    data_set: DataSet,
    pairs: Sequence[DataPair],
    output: Path,
    methods: Mapping[str, Method],
    settings: Settings,
    executor: Executor,
) -> Results:
    """Measure what is missing of some pairs; keep each as it comes, and go on where one fails.

    **Arguments:**

    - `data_set`, `pairs`: what to match, of which data set.
    - `output`: a directory that exists; gets `results.csv`, `shapes.csv` and `provenance.json`.
    - `methods`: by the names that they get in tables; for example `METHODS`.
    - `settings`: must be those of results that are there already.
    - `executor`: what works.

    **Returns:** What is known of these pairs and methods. Look at its `failures`, or call its `check`.

    **Raises:** `InputError` if the directory holds results of something else, another process adds to it, or
    maps that were computed elsewhere are missing.
    """
    for method in methods.values():
        method.check(pairs)
    if settings.init not in get_args(Start):
        Published(Path(settings.init)).check(pairs)
    made_with = versions() | {"code": code_digest(measured_code())}
    # Not the path of maps, so that a moved copy of the data is no other start.
    chosen: dict[str, Any] = asdict(settings) | {"init": Path(settings.init).name}
    # The same for most choices of methods, so that more can be added; times of precomputation depend on it.
    most = max(MOST_EIGENVECTORS, *(method.number_of_eigenvectors for method in methods.values()))
    chosen["number_of_eigenvectors"] = most
    origin = {"settings": chosen, "versions": made_with}
    with claimed_directory(output, origin, {"commit": commit()}):
        results = Journal(output / "results.csv", ["source", "target", "method"])
        shapes = Journal(output / "shapes.csv", ["shape"])
        own = data_set.shapes
        if strangers := [row["shape"] for row in shapes.rows if row["shape"] not in own]:
            raise InputError(
                f"{output}: holds results of another data set, with a shape {strangers[0]} that is not in "
                f"{data_set.directory}: give another --output."
            )
        tasks = []
        for pair in pairs:
            missing = {name: methods[name] for name in methods if (*pair.names, name) not in results}
            if missing:
                tasks.append(Task(pair, missing))
        files = {name: file for pair in pairs for name, file in zip(pair.names, pair.meshes, strict=True)}
        for name, file in files.items():
            if (name,) in shapes and shapes[(name,)]["digest"] != _digest(file):
                raise InputError(
                    f"{file}: has changed since results in {output} were measured: give another --output."
                )
        missing_shapes = {name: (name, file) for name, file in files.items() if (name,) not in shapes}

        precompute = partial(measure_shape, number_of_eigenvectors=most)
        measure = partial(measure_pair, settings=settings, number_of_eigenvectors=most)
        failed = {
            **_run("shapes", precompute, missing_shapes, executor, shapes),
            **_run("pairs", measure, {task.pair.name: task for task in tasks}, executor, results),
        }
        # Of a pair all methods or none, so that all are compared on the same pairs.
        known = [pair for pair in pairs if all((name,) in shapes for name in pair.names)]
        by_pair = [[(*pair.names, name) for name in methods] for pair in known]
        finished = [keys for keys in by_pair if all(key in results for key in keys)]
        return Results(
            [results[key] for keys in finished for key in keys],
            {name: shapes[(name,)] for name in files if (name,) in shapes},
            {name: str(error) or type(error).__name__ for name, error in failed.items()},
        )


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16]


def _run(
    what: str,
    measure: Callable[[Any], list[Row]],
    tasks: Mapping[str, Any],
    executor: Executor,
    journal: Journal,
) -> dict[str, BaseException]:
    """Measure all tasks with a progress bar, keep what comes, and go on where one fails."""
    if not tasks:
        return {}
    failed: dict[str, BaseException] = {}
    with tqdm(total=len(tasks), desc=what, unit=what[:-1], smoothing=0) as progress:
        for name, result in run_tasks(measure, tasks, executor):
            if isinstance(result, BaseException):
                failed[name] = result
            else:
                journal.append(result)
            progress.update()
    return {name: failed[name] for name in tasks if name in failed}


def measure_shape(shape: tuple[str, Path], number_of_eigenvectors: int) -> list[Row]:
    """Precompute what all pairs of a shape share, and note how long each part took."""
    name, file = shape
    with recomputing():
        seconds, mesh = {}, read_mesh(file)
        for what, compute in (
            ("spectrum", lambda: compute_spectrum(mesh, number_of_eigenvectors)),
            ("descriptors", lambda: shot_descriptors(mesh)),
        ):
            began = time.perf_counter()
            compute()
            seconds[f"seconds_{what}"] = f"{time.perf_counter() - began:.4f}"
    return [{"shape": name, "digest": _digest(file), "vertices": len(mesh.vertices), **seconds}]


def measure_pair(task: Task, settings: Settings, number_of_eigenvectors: int) -> list[Row]:
    """Match a pair with every method and measure the maps; a row for each."""
    release_programs()
    data = task.pair
    mesh_x, mesh_y = (read_mesh(file) for file in data.meshes)
    truths = {"direct": data.ground_truth(mesh_x, mesh_y)}
    if settings.mirrored:
        truths["mirrored"] = data.ground_truth(mesh_x, mesh_y, mirrored=True)
    methods = task.methods.values()
    pair = prepare_pair(
        data,
        mesh_x,
        mesh_y,
        settings.init,
        number_of_eigenvectors,
        number_of_descriptors=max(method.number_of_descriptors for method in methods),
        both_directions=any(method.both_directions for method in methods),
    )
    rows = []
    for name, method in task.methods.items():
        pointwise_map, result, seconds = _timed(name, method, pair)
        ending = "successful" if result == RESULTS.successful else sentence(result)
        figures = _evaluate(mesh_y, pointwise_map[: len(mesh_x.vertices)], truths, settings)
        identity = {"source": data.source, "target": data.target, "method": name, "machine": machine()}
        rows.append(identity | {"result": ending, "seconds": f"{seconds:.5f}"} | figures)
    return rows


def _timed(name: str, method: Method, pair: PreparedPair) -> tuple[Int[np.ndarray, " m"], RESULTS, float]:
    """The map and its seconds, without compilation; NaN for a map that was computed elsewhere."""
    for _ in range(2):
        compiling_before, began = _compiling.seconds, time.perf_counter()
        with one_blas_thread():
            pointwise_map, result = jax.block_until_ready(method(pair))
        seconds = time.perf_counter() - began
        compiling = _compiling.seconds - compiling_before
        seconds -= compiling
        known = name in _warm and not compiling
        _warm.add(name)
        # What else a first run does, such as imports, disappears in a long one.
        if known or seconds > _LONG:
            break
    return np.asarray(pointwise_map), result, np.nan if isinstance(method, Published) else seconds


_LONG = 60
# The methods that this process has run before.
_warm: set[str] = set()


class _Compiling:
    """Counts the seconds that XLA has spent compiling in this process."""

    def __init__(self) -> None:
        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.seconds += duration_secs


_compiling = _Compiling()


def prepare_pair(
    data: DataPair,
    mesh_x: Mesh,
    mesh_y: Mesh,
    init: str,
    number_of_eigenvectors: int,
    *,
    number_of_descriptors: int = 0,
    both_directions: bool = False,
) -> PreparedPair:
    """Spectra, start and samples, padded so that few programs serve all pairs."""
    meshes = mesh_x, mesh_y
    spectra = paired_spectra(*meshes, number_of_eigenvectors, partial=data.partial)
    if number_of_descriptors:
        spectra = describe(*meshes, *spectra, number_of_descriptors, partial=data.partial)
    start = _start(data.names, meshes, spectra, init, data.partial)
    reverse = None
    if both_directions:
        reverse = _reverse_start(data, meshes, spectra, init, start)
    sizes = [padded_size(len(mesh.vertices)) for mesh in meshes]

    def padded(pointwise_map: Int64[np.ndarray, " m"], size: int) -> Int[Array, " p"]:
        return jnp.asarray(pad_rows(pointwise_map, size), jnp.int32)

    def others() -> Iterator[Int[Array, " p"]]:
        if init == "shot":
            for other in other_starts(*meshes, *spectra, partial=data.partial):
                yield padded(other, sizes[0])

    samples = (
        jnp.asarray(farthest_point_samples(mesh, min(MOST_SAMPLES, int(mesh.used_vertices.sum()))))
        for mesh in meshes
    )
    return PreparedPair(
        spectra[0].pad(sizes[0]),
        spectra[1].pad(sizes[1]),
        padded(start, sizes[0]),
        tuple(samples),  # type: ignore[arg-type]
        None if reverse is None else padded(reverse, sizes[1]),
        meshes,
        data.names,
        data.partial,
        others,
    )


def _start(
    names: tuple[str, str],
    meshes: tuple[Mesh, Mesh],
    spectra: tuple[Spectrum, Spectrum],
    init: str,
    partial: bool,
) -> Int64[np.ndarray, " m"]:
    if init in get_args(Start):
        return initial_map(*meshes, *spectra, init=init, partial=partial)
    given = read_published_map(Path(init), names, meshes)
    return initial_map(*meshes, *spectra, init=given, partial=partial)


def _reverse_start(
    data: DataPair,
    meshes: tuple[Mesh, Mesh],
    spectra: tuple[Spectrum, Spectrum],
    init: str,
    start: Int64[np.ndarray, " m"],
) -> Int64[np.ndarray, " n"]:
    """The same kind of start from Y to X; where none was published, from the start's functional map."""
    names = data.target, data.source
    if init in get_args(Start) or published_file(Path(init), names).is_file():
        return _start(names, meshes[::-1], spectra[::-1], init, data.partial)
    spectrum_x, spectrum_y = (spectrum.truncate(FIRST_EIGENVECTORS) for spectrum in spectra)
    functional_map = encode(jnp.asarray(start), spectrum_x, spectrum_y)
    embeddings = spectral_embeddings(functional_map, spectrum_x, spectrum_y)
    reverse = nearest_neighbor(*embeddings[::-1], database_mask=spectrum_x.mask)
    return np.asarray(reverse).astype(np.int64)


def _evaluate(
    mesh_y: Mesh,
    pointwise_map: Int[np.ndarray, " m"],
    truths: Mapping[str, GroundTruth],
    settings: Settings,
) -> Row:
    """The figures of one map against the truth that it is nearest to; all NaN where it failed."""
    if (pointwise_map < 0).any():
        return dict.fromkeys(("truth", *FIGURES), "nan") | {"curve": " ".join(["nan"] * len(CURVE))}
    errors = {
        name: geodesic_error(
            mesh_y, pointwise_map, truth, number_of_samples=settings.evaluated_points, seed=settings.seed
        )
        for name, truth in truths.items()
    }
    nearest = min(errors, key=lambda name: errors[name].mean)
    error = errors[nearest]
    figures = (
        error.mean,
        error.median,
        *error.within.values(),
        error.area_under_curve(),
        error.unreachable,
        coverage(mesh_y, pointwise_map),
    )
    curve = error.correspondence_quality_curve(CURVE)
    return {
        "truth": nearest,
        **{name: f"{value:.7f}" for name, value in zip(FIGURES, figures, strict=True)},
        "curve": " ".join(f"{share:.5f}" for share in curve),
    }
