"""The measurements of a benchmark: of the precomputation for a shape, and of several methods on a pair."""

from __future__ import annotations

import hashlib
import os
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxsmw.benchmark.datasets import AnyPair
from jaxsmw.benchmark.journal import Row
from jaxsmw.benchmark.opponents.base import MOST_SAMPLES, Measured, Method, MethodInput
from jaxsmw.benchmark.opponents.baselines import PublishedMaps, read_published_map
from jaxsmw.choices import DEFAULT_MATCH_INIT, MatchInit
from jaxsmw.errors import InputError
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.evaluation.metrics import (
    LARGEST_THRESHOLD,
    THRESHOLDS,
    coverage,
    geodesic_error,
    overlap_scores,
)
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.io.meshes import read_mesh
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.stages import Sizes
from jaxsmw.runtime.cache import recomputing
from jaxsmw.runtime.provenance import machine
from jaxsmw.runtime.threads import one_blas_thread

CURVE = np.linspace(0, LARGEST_THRESHOLD, 51)
"""The thresholds of stored correspondence quality curves, in units of the square root of the area of Y."""

FIGURES = (
    "mean",
    "median",
    *(f"within_{threshold}" for threshold in THRESHOLDS),
    "area_under_curve",
    "unreachable",
    "coverage",
)
"""The statistics of a map that are stored in addition to its correspondence quality curve.

Geodesic errors and thresholds are in units of the square root of the area of Y.
"""


OPTIONAL_FIGURES = ("overlap_source", "overlap_target", "balanced_accuracy", "probability")
"""The statistics of a map that older files lack, and that are NaN for methods that do not predict them.

For pairs of two parts, `overlap_source` and `overlap_target` are the intersection over union of the predicted
and the true overlap, and `balanced_accuracy` is its mean over both parts; see
`jaxsmw.evaluation.overlap_scores`. `probability` is the attribute of `Correspondence`.
"""


def read_curve(text: str) -> list[float]:
    """Parse the shares of a stored correspondence quality curve, one for each threshold in `CURVE`.

    **Raises:** `ValueError` if the text does not contain one number for each threshold.
    """
    shares = [float(share) for share in text.split()]
    if len(shares) != len(CURVE):
        raise ValueError(f"the curve has {len(shares)} shares instead of {len(CURVE)}")
    return shares


RESULT_COLUMNS: dict[str, Callable[[str], Any]] = {
    "source": str,
    "target": str,
    "method": str,
    "machine": str,
    "result": str,
    "seconds": float,
    "truth": str,
    **dict.fromkeys(FIGURES, float),
    **dict.fromkeys(OPTIONAL_FIGURES, float),
    "curve": read_curve,
}
"""A dictionary from the name of each column of `results.csv` to the function that parses its values.

The file contains one row for each pair and method. `result` is `successful`, or a sentence that explains why
the method failed. `seconds` is the wall time from the initial map to the final map, without compilation
(`docs/evaluation.md`). `truth` is the ground truth with which the errors were computed, `direct` or
`mirrored`.
"""

SHAPE_COLUMNS: dict[str, Callable[[str], Any]] = {
    "shape": str,
    "digest": str,
    "vertices": int,
    "seconds_spectrum": float,
    "seconds_descriptors": float,
}
"""A dictionary from the name of each column of `shapes.csv` to the function that parses its values.

The file contains one row for each shape. `digest` is a hash of the mesh file. `seconds_spectrum` and
`seconds_descriptors` are the wall times of the precomputation, or NaN if `compare` has measured the shape,
because `compare` uses the cache.
"""


@dataclass(frozen=True)
class Settings:
    """The settings of a benchmark. Results depend only on these settings, the data and the code.

    **Attributes:**

    - `init`: the initial map from which all methods start: a directory with maps `X_Y.map`, or a name that
      `jaxsmw.match` accepts. With `"auto"` (default), all methods start from `"shot"`; `accurate`, which
      calls `match`, also starts from `"aligned"` for asymmetric shapes.
    - `mirrored`: whether errors are computed for both the direct and the mirrored ground truth, and those
      with the smaller mean are stored, for initial maps that do not distinguish left from right.
    - `evaluated_points`: the number of ground-truth points at which each map is evaluated; None for all.
    - `seed`: the seed of the random draw of these points.

    **Raises:** `InputError` if `init` is neither the name of an initial map nor a directory.
    """

    init: str = DEFAULT_MATCH_INIT
    mirrored: bool = False
    evaluated_points: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        # Unlike `Path.is_dir`, `os.path.isdir` raises no error if a name is too long for the file system.
        if not self.is_named and not os.path.isdir(self.init):
            raise InputError(
                f"{self.init!r} is not an initial map: choose from {', '.join(get_args(MatchInit))}, or give "
                "a directory with maps X_Y.map."
            )

    @property
    def is_named(self) -> bool:
        """Whether the initial maps are computed, and not read from a directory."""
        return self.init in get_args(MatchInit)

    def check(self, pairs: Sequence[AnyPair]) -> None:
        """Raise `InputError` if the directory `init` does not contain a map for every pair."""
        if not self.is_named:
            PublishedMaps(Path(self.init)).check(pairs)


def shapes_of(pairs: Iterable[AnyPair]) -> Iterator[tuple[str, Path | Mesh]]:
    """Yield the name of each shape of the pairs, and its mesh or mesh file. Shapes can repeat."""
    for pair in pairs:
        x, y = pair.meshes
        yield pair.source, x
        yield pair.target, y


def shape_digest(file: Path | Mesh) -> str:
    """Return a short hash of the contents of a mesh file, or of a mesh."""
    if isinstance(file, Mesh):
        return hashlib.sha256(file.vertices.tobytes() + file.faces.tobytes()).hexdigest()[:16]
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise InputError(
            f"{file}: cannot be read ({error.strerror}): check the path and its permissions."
        ) from error


def _mesh(file: Path | Mesh) -> Mesh:
    return file if isinstance(file, Mesh) else read_mesh(file)


def measure_shape(
    shape: tuple[str, Path | Mesh], number_of_eigenvectors: int, *, timed: bool = True
) -> list[Row]:
    """Compute and cache the spectrum and SHOT of a shape (name, mesh or its file), and measure their times.

    Unless `timed`, what the cache contains is not computed again, and the times are NaN.

    **Returns:** A list with one row, which has the keys of `SHAPE_COLUMNS`.

    **Raises:** `InputError` if the file cannot be read, or if its spectrum cannot be computed.
    """
    name, file = shape
    with recomputing() if timed else nullcontext():
        seconds, mesh = {}, _mesh(file)
        for what, compute, refusals in (
            ("spectrum", lambda: compute_spectrum(mesh, number_of_eigenvectors), []),
            # A mesh can be too coarse for SHOT. Methods that need no SHOT can match this mesh nevertheless.
            ("descriptors", lambda: shot_descriptors(mesh), [InputError]),
        ):
            began = time.perf_counter()
            with suppress(*refusals):
                compute()
            seconds[f"seconds_{what}"] = f"{time.perf_counter() - began:.4f}" if timed else "nan"
    return [{"shape": name, "digest": shape_digest(file), "vertices": len(mesh.vertices), **seconds}]


class MethodError(InputError):
    """The error for a fault in the code of a method, such as a misspelled name; the fault is its cause."""


Task = tuple[AnyPair, Mapping[str, Method]]
"""A pair, and the methods by name that match it."""


def measure_pairs(tasks: Sequence[Task], settings: Settings, number_of_eigenvectors: int) -> list[Row]:
    """Match pairs with several methods each, and measure the errors of the maps.

    **Returns:** A list with one row for each pair and method, which has the keys of `RESULT_COLUMNS`. The
    statistics and the seconds of a method that failed are NaN.

    **Raises:** `InputError` if a file cannot be read, or if a pair cannot be prepared; `MethodError` if a
    method raises any error but these two; `ArithmeticError` if the computation of an initial map fails
    numerically.
    """
    prepared = [_PreparedTask.of(*task, settings, number_of_eigenvectors) for task in tasks]
    rows = []
    for name in dict.fromkeys(name for _, methods in tasks for name in methods):
        matched = [one for one, (_, methods) in zip(prepared, tasks, strict=True) if name in methods]
        method = next(methods[name] for _, methods in tasks if name in methods)
        with _naming_method(name):
            results = _timed(name, method, [one.input for one in matched])
        for one, measured in zip(matched, results, strict=True):
            rows.append(one.row(name, measured, settings))
    return rows


@contextmanager
def _naming_method(name: str) -> Iterator[None]:
    """Raise a `MethodError` that names the method and the line for each unexpected error in the block."""
    try:
        yield
    except (InputError, ArithmeticError):
        raise
    except Exception as error:
        lines = traceback.extract_tb(error.__traceback__)
        # The fault is probably not in this package or in another library that the method calls.
        foreign = (f"{Path(__file__).parents[1]}{os.sep}", "<@beartype")
        own = [one for one in lines if not one.filename.startswith(foreign)]
        line = ([one for one in own if "site-packages" not in one.filename] or own or lines)[-1]
        raise MethodError(
            f"the method {name} raised {type(error).__name__} at {line.filename}, line {line.lineno} "
            f"({error}): correct its code."
        ) from error


@dataclass(frozen=True, eq=False)
class _PreparedTask:
    """A prepared pair with all that is known about its true map."""

    input: MethodInput
    truths: Mapping[str, GroundTruth]
    true_overlap: tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]] | None

    @classmethod
    def of(
        cls,
        data: AnyPair,
        methods: Mapping[str, Method],
        settings: Settings,
        number_of_eigenvectors: int,
    ) -> _PreparedTask:
        mesh_x, mesh_y = (_mesh(file) for file in data.meshes)
        truths = {"direct": data.ground_truth(mesh_x, mesh_y)}
        if settings.mirrored:
            truths["mirrored"] = data.ground_truth(mesh_x, mesh_y, mirrored=True)
        init: Any = settings.init
        if not settings.is_named:
            init = read_published_map(Path(settings.init), data.names, (mesh_x, mesh_y))
        pair = MethodInput.prepare(
            Pair(mesh_x, mesh_y, data.partial),
            names=data.names,
            init=init,
            sizes=Sizes(
                number_of_eigenvectors,
                max(method.number_of_crease_eigenvectors for method in methods.values()),
                MOST_SAMPLES,
                tuple(dict.fromkeys(name for method in methods.values() for name in method.bases)),
            ),
            number_of_descriptors=max(method.number_of_descriptors for method in methods.values()),
        )
        return cls(pair, truths, data.true_overlap(mesh_x, mesh_y))

    def row(self, name: str, measured: Measured | ArithmeticError, settings: Settings) -> Row:
        """Return the row of the method with a name."""
        source, target = self.input.names
        identity = {"source": source, "target": target, "method": name, "machine": machine()}
        if isinstance(measured, ArithmeticError):
            return identity | {"result": str(measured), "seconds": "nan"} | _NO_FIGURES
        assert self.input.meshes is not None
        mesh_x, mesh_y = self.input.meshes
        pointwise_map = np.asarray(measured.pointwise_map)[: len(mesh_x.vertices)]
        figures = _evaluate(mesh_y, pointwise_map, self.truths, settings)
        figures |= _evaluate_prediction(measured.correspondence, self.true_overlap)
        return identity | {"result": "successful", "seconds": f"{measured.seconds:.5f}"} | figures


def _timed(name: str, method: Method, pairs: Sequence[MethodInput]) -> list[Measured | ArithmeticError]:
    """Run a method, and return what it has measured, without the seconds of compilation."""
    for _ in range(2):
        with _compilation_seconds() as compilation, one_blas_thread():
            results = method.measure_all(pairs)
        compiling = sum(compilation) / len(pairs)
        results = [
            one if isinstance(one, ArithmeticError) else one._replace(seconds=one.seconds - compiling)
            for one in results
        ]
        warm = name in _warm and not compilation
        _warm.add(name)
        # The first run of a method takes longer, for example because of imports, so the method runs a second
        # time. In a long first run, the time for imports is negligible.
        if warm or any(isinstance(one, ArithmeticError) or one.seconds > _LONG for one in results):
            break
    return results


# A run that takes longer than this number of seconds is long.
_LONG = 60
# The names of the methods that have run in this process.
_warm: set[str] = set()


@contextmanager
def _compilation_seconds() -> Iterator[list[float]]:
    """Collect the seconds of each compilation of XLA in this process within the block."""
    seconds: list[float] = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            seconds.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield seconds
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


# The statistics of a method that failed.
_NO_FIGURES = {
    **dict.fromkeys(("truth", *FIGURES, *OPTIONAL_FIGURES), "nan"),
    "curve": " ".join(["nan"] * len(CURVE)),
}


def _evaluate(
    mesh_y: Mesh,
    pointwise_map: Int[np.ndarray, " m"],
    truths: Mapping[str, GroundTruth],
    settings: Settings,
) -> Row:
    """Return the statistics of a map for the ground truth, by name, that has the smallest mean error."""
    errors = {
        name: geodesic_error(
            mesh_y, pointwise_map, truth, number_of_samples=settings.evaluated_points, seed=settings.seed
        )
        for name, truth in truths.items()
    }
    truth, error = min(errors.items(), key=lambda named: named[1].mean)
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
        "truth": truth,
        **{name: f"{value:.7f}" for name, value in zip(FIGURES, figures, strict=True)},
        "curve": " ".join(f"{share:.5f}" for share in curve),
    }


def _evaluate_prediction(
    correspondence: Correspondence | None,
    true_overlap: tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]] | None,
) -> Row:
    """Return `OPTIONAL_FIGURES`, by which the predictions of a method are judged."""
    figures = dict.fromkeys(OPTIONAL_FIGURES, np.nan)
    if correspondence is not None:
        figures["probability"] = correspondence.probability
        if true_overlap is not None:
            source, target = map(overlap_scores, correspondence.overlap(), true_overlap)
            figures["overlap_source"] = source.intersection_over_union
            figures["overlap_target"] = target.intersection_over_union
            figures["balanced_accuracy"] = (source.balanced_accuracy + target.balanced_accuracy) / 2
    return {name: f"{value:.7f}" for name, value in figures.items()}
