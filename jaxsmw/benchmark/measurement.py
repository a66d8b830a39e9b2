"""The measurements of a benchmark: of the precomputation for a shape, and of several methods on a pair."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.benchmark.journal import Row
from jaxsmw.benchmark.opponents.base import Measured, Method, MethodInput
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
`seconds_descriptors` are the wall times of the precomputation.
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

    def check(self, pairs: Sequence[DataPair]) -> None:
        """Raise `InputError` if the directory `init` does not contain a map for every pair."""
        if not self.is_named:
            PublishedMaps(Path(self.init)).check(pairs)


def file_digest(file: Path) -> str:
    """Return a short hash of the contents of a file."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise InputError(
            f"{file}: cannot be read ({error.strerror}): check the path and its permissions."
        ) from error


def measure_shape(shape: tuple[str, Path], number_of_eigenvectors: int) -> list[Row]:
    """Compute and cache the spectrum and SHOT of a shape (name, mesh file), and measure their wall times.

    **Returns:** A list with one row, which has the keys of `SHAPE_COLUMNS`.

    **Raises:** `InputError` if the file cannot be read, or if its spectrum cannot be computed.
    """
    name, file = shape
    with recomputing():
        seconds, mesh = {}, read_mesh(file)
        for what, compute, refusals in (
            ("spectrum", lambda: compute_spectrum(mesh, number_of_eigenvectors), []),
            # A mesh can be too coarse for SHOT. Methods that need no SHOT can match this mesh nevertheless.
            ("descriptors", lambda: shot_descriptors(mesh), [InputError]),
        ):
            began = time.perf_counter()
            with suppress(*refusals):
                compute()
            seconds[f"seconds_{what}"] = f"{time.perf_counter() - began:.4f}"
    return [{"shape": name, "digest": file_digest(file), "vertices": len(mesh.vertices), **seconds}]


def measure_pair(
    task: tuple[DataPair, Mapping[str, Method]], settings: Settings, number_of_eigenvectors: int
) -> list[Row]:
    """Match a pair with several methods, given by name, and measure the errors of the maps.

    **Returns:** A list with one row for each method, which has the keys of `RESULT_COLUMNS`. The statistics
    and the seconds of a method that failed are NaN.

    **Raises:** `InputError` if a file cannot be read, or if the pair cannot be prepared; `ArithmeticError` if
    the computation of an initial map fails numerically.
    """
    data, methods = task
    mesh_x, mesh_y = (read_mesh(file) for file in data.meshes)
    truths = {"direct": data.ground_truth(mesh_x, mesh_y)}
    if settings.mirrored:
        truths["mirrored"] = data.ground_truth(mesh_x, mesh_y, mirrored=True)
    true_overlap = data.true_overlap(mesh_x, mesh_y)
    init: Any = settings.init
    if not settings.is_named:
        init = read_published_map(Path(settings.init), data.names, (mesh_x, mesh_y))
    pair = MethodInput.prepare(
        Pair(mesh_x, mesh_y, data.partial),
        names=data.names,
        init=init,
        number_of_eigenvectors=number_of_eigenvectors,
        number_of_descriptors=max(method.number_of_descriptors for method in methods.values()),
    )
    rows = []
    for name, method in methods.items():
        try:
            measured = _timed(name, method, pair)
            seconds, ending = measured.seconds, "successful"
            pointwise_map = np.asarray(measured.pointwise_map)[: len(mesh_x.vertices)]
            figures = _evaluate(mesh_y, pointwise_map, truths, settings)
            figures |= _evaluate_prediction(measured.correspondence, true_overlap)
        except ArithmeticError as error:
            seconds, ending, figures = np.nan, str(error), _NO_FIGURES
        identity = {"source": data.source, "target": data.target, "method": name, "machine": machine()}
        rows.append(identity | {"result": ending, "seconds": f"{seconds:.5f}"} | figures)
    return rows


def _timed(name: str, method: Method, pair: MethodInput) -> Measured:
    """Run a method, and return what it has measured, without the seconds of compilation."""
    for _ in range(2):
        with _compilation_seconds() as compilation, one_blas_thread():
            measured = method.measure(pair)
        measured = measured._replace(seconds=measured.seconds - sum(compilation))
        warm = name in _warm and not compilation
        _warm.add(name)
        # The first run of a method takes longer, for example because of imports, so the method runs a second
        # time. In a long first run, the time for imports is negligible.
        if warm or measured.seconds > _LONG:
            break
    return measured


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
