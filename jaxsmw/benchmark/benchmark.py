"""Measures the errors and times of several methods on the pairs of a data set, and stores the results.

If a benchmark was interrupted, a second call of `run_benchmark` with the same arguments measures only the
remaining shapes and pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from jaxsmw.benchmark.datasets import AnyPair, DataSet, first_three
from jaxsmw.benchmark.journal import Journal, Row
from jaxsmw.benchmark.measurement import (
    OPTIONAL_FIGURES,
    RESULT_COLUMNS,
    SHAPE_COLUMNS,
    MethodError,
    Settings,
    Task,
    measure_pairs,
    measure_shape,
    shape_digest,
    shapes_of,
)
from jaxsmw.benchmark.opponents.base import Method
from jaxsmw.benchmark.opponents.registry import METHODS
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.runtime.backends import chosen_backend
from jaxsmw.runtime.provenance import claimed_directory, code_digest, commit, measured_code, versions
from jaxsmw.runtime.workers import run_tasks


class Results(NamedTuple):
    """The results of a benchmark. All values in `rows` and `shapes` are text.

    **Attributes:**

    - `rows`: one row with the keys of `RESULT_COLUMNS` for each pair and method. `run_benchmark` leaves out a
      pair if any of its methods has no result for this pair. `Comparison.read` keeps all stored rows.
    - `shapes`: one row with the keys of `SHAPE_COLUMNS` for each measured shape, by the name of the shape.
    - `failures`: the error message of each shape or pair that could not be measured, by its name.
    """

    rows: list[Row]
    shapes: dict[str, Row]
    failures: dict[str, str]

    def check(self) -> None:
        """Raise `InputError` if a measurement failed, with one note for each cause."""
        if not self.failures:
            return
        error = InputError(
            "some shapes or pairs could not be measured: correct these faults, and run the same benchmark "
            "again (stored results are kept):"
        )
        for cause in self.causes():
            error.add_note(cause)
        raise error

    def causes(self) -> list[str]:
        """Return a text for each cause of failed measurements, with the names of the shapes or pairs."""
        causes: dict[str, list[str]] = {}
        for name, cause in self.failures.items():
            causes.setdefault(cause, []).append(name)
        return [f"{first_three(names)}: {cause}" for cause, names in causes.items()]


def run_benchmark(
    data_set: DataSet | None,
    pairs: Sequence[AnyPair],
    output: Path,
    methods: Mapping[str, Method],
    settings: Settings,
    executor: Executor | None,
    *,
    quiet: bool = False,
    number_of_eigenvectors: int | None = None,
    timed_shapes: bool = True,
    stops_at_fault: bool = False,
) -> Results:
    """Run every method on every pair, and store the errors and times in CSV files.

    Each new result is stored immediately, and stored results are not measured again. If a shape or pair
    cannot be measured, the benchmark continues with the others, and `Results.failures` contains the message.

    **Arguments:**

    - `data_set`, `pairs`: the `DataSet`, and its pairs to match; None for pairs of any origin.
    - `output`: an existing directory for the files `results.csv`, `shapes.csv`, `methods.csv` and
      `provenance.json`.
    - `methods`: the methods by name, for example `METHODS`.
    - `settings`: the `Settings`, which must be those of all results that `output` contains.
    - `executor`: the executor that runs the tasks; see `jaxsmw.runtime.workers.open_executor`. With None,
      this process runs the tasks, in batches of pairs if JAX has an accelerator.
    - `quiet`: whether to hide the progress bars.
    - `number_of_eigenvectors`: the number that is computed for each shape; by default, it suffices for the
      `methods` and for all of `METHODS`.
    - `timed_shapes`: whether to compute shapes anew and measure the time; if False, the cache is used.
    - `stops_at_fault`: whether the first pair raises its `MethodError`, before other pairs are matched.

    **Raises:** `InputError` if `output` contains damaged results, or results that were measured with other
    data, settings, methods or software versions. `InputError` is also raised if another process is adding
    results to `output`, if a method cannot match a pair, or if a file with a map is missing.
    """
    for method in methods.values():
        method.check(pairs)
    settings.check(pairs)
    number = number_of_eigenvectors or _most_eigenvectors(methods)
    with claimed_directory(output, _origin(settings, number), {"commit": commit()}):
        store = _Store(output, data_set, pairs, methods)
        measure = partial(measure_shape, number_of_eigenvectors=number, timed=timed_shapes)
        failed = _measure_all("shapes", measure, store.missing_shapes(), executor, store.shapes, quiet)
        measure = partial(measure_pairs, settings=settings, number_of_eigenvectors=number)
        at_once = _PAIRS_AT_ONCE if executor is None and chosen_backend("auto") == "jax" else 1
        tasks = store.missing_pairs(methods)
        failed |= _measure_in_batches(measure, tasks, at_once, executor, store.results, quiet, stops_at_fault)
        return store.collected(methods, failed)


# The number of pairs that are prepared together for a batch on an accelerator.
_PAIRS_AT_ONCE = 64


def _most_eigenvectors(methods: Mapping[str, Method]) -> int:
    # The time of the precomputation depends on this number, so all results in a directory share it. It also
    # suffices for all of `METHODS`, so that a later benchmark of other methods can add its results.
    return max(method.number_of_eigenvectors for method in (*METHODS.values(), *methods.values()))


def _origin(settings: Settings, number_of_eigenvectors: int) -> dict[str, dict[str, Any]]:
    """Return the contents of `provenance.json`."""
    # Only the name of the directory with initial maps is stored, because its path may change.
    named = asdict(settings) | {"init": Path(settings.init).name}
    return {
        "settings": named | {"number_of_eigenvectors": number_of_eigenvectors},
        "versions": versions() | {"code": code_digest(measured_code())},
    }


class _Store:
    """The result files of a benchmark, which must fit the data set and its present mesh files."""

    def __init__(
        self,
        output: Path,
        data_set: DataSet | None,
        pairs: Sequence[AnyPair],
        methods: Mapping[str, Method],
    ):
        self.pairs = pairs
        self.files = dict(shapes_of(pairs))
        key = ["source", "target", "method"]
        self.results = Journal(output / "results.csv", key, RESULT_COLUMNS, optional=OPTIONAL_FIGURES)
        self.shapes = Journal(output / "shapes.csv", ["shape"], SHAPE_COLUMNS)
        self.methods = Journal(output / "methods.csv", ["method"], {"method": str, "reference": str})
        if data_set is not None:
            own = data_set.shapes
            if strangers := [row["shape"] for row in self.shapes.rows if row["shape"] not in own]:
                raise InputError(
                    f"{output}: contains results of another data set, with a shape {strangers[0]} that is "
                    f"not in {data_set.directory}: give another output directory."
                )
        for name, file in self.files.items():
            if (name,) in self.shapes and self.shapes[(name,)]["digest"] != shape_digest(file):
                raise InputError(
                    f"{file if isinstance(file, Path) else name}: has changed since results in {output} were "
                    "measured: give another output directory."
                )
        # A method that failed on all pairs may have been corrected since.
        measured = {row["method"] for row in self.results.rows}
        self.methods.remove([(name,) for name in methods if name not in measured])
        new = {name: method.reference for name, method in methods.items() if (name,) not in self.methods}
        for name, method in methods.items():
            if name not in new and self.methods[(name,)]["reference"] != method.reference:
                raise InputError(
                    f"{output}: contains results of another method {name}, "
                    f"{self.methods[(name,)]['reference']}, but now it is {method.reference}: give another "
                    "name or another output directory."
                )
        self.methods.append([{"method": name, "reference": text} for name, text in new.items()])

    def missing_shapes(self) -> dict[str, tuple[str, Path | Mesh]]:
        """Return the name and the mesh or its file of each unmeasured shape, by name."""
        return {name: (name, file) for name, file in self.files.items() if (name,) not in self.shapes}

    def missing_pairs(self, methods: Mapping[str, Method]) -> dict[str, Task]:
        """Return the unfinished pairs by name, each with the methods that have no result."""
        tasks: dict[str, Task] = {}
        for pair in self.pairs:
            missing = {name: methods[name] for name in methods if (*pair.names, name) not in self.results}
            if missing:
                tasks[pair.name] = pair, missing
        return tasks

    def collected(self, methods: Mapping[str, Method], failed: Mapping[str, BaseException]) -> Results:
        """Return the results of the pairs for which every method has a result, so methods are comparable."""
        measured = [pair for pair in self.pairs if all((name,) in self.shapes for name in pair.names)]
        by_pair = [[(*pair.names, name) for name in methods] for pair in measured]
        finished = [keys for keys in by_pair if all(key in self.results for key in keys)]
        return Results(
            [self.results[key] for keys in finished for key in keys],
            {name: self.shapes[(name,)] for name in self.files if (name,) in self.shapes},
            {name: str(error) or type(error).__name__ for name, error in failed.items()},
        )


def _measure_in_batches(
    measure: Callable[[list[Task]], list[Row]],
    tasks: Mapping[str, Task],
    at_once: int,
    executor: Executor | None,
    journal: Journal,
    quiet: bool,
    stops_at_fault: bool,
) -> dict[str, BaseException]:
    """Measure batches of pairs as `_measure_all` does, and the pairs of a failed batch one by one."""
    names = list(tasks)
    batches = {names[i]: names[i : i + at_once] for i in range(0, len(names), at_once)}
    of_batches = {first: [tasks[name] for name in batch] for first, batch in batches.items()}
    # A fault on one pair of a batch does not show that the method fails on every pair.
    stops = stops_at_fault and at_once == 1
    failed = _measure_all("pairs", measure, of_batches, executor, journal, quiet, stops)
    if at_once == 1:
        return failed
    alone = {name: tasks[name] for first in failed for name in batches[first]}
    return _measure_in_batches(measure, alone, 1, executor, journal, quiet, stops_at_fault)


def _measure_all(
    what: str,
    measure: Callable[[Any], list[Row]],
    tasks: Mapping[str, Any],
    executor: Executor | None,
    journal: Journal,
    quiet: bool,
    stops_at_fault: bool = False,
) -> dict[str, BaseException]:
    """Run all tasks, append their rows to a journal, and return the exceptions of failed tasks by name.

    With `stops_at_fault`, a `MethodError` of the task that ends first is raised.
    """
    if not tasks:
        return {}
    failed: dict[str, BaseException] = {}
    sizes = {name: len(task) if isinstance(task, list) else 1 for name, task in tasks.items()}
    total = sum(sizes.values())
    with tqdm(total=total, desc=what, unit=what[:-1], smoothing=0, disable=quiet) as progress:
        for number, (name, result) in enumerate(run_tasks(measure, tasks, executor)):
            if stops_at_fault and number == 0 and isinstance(result, MethodError):
                raise result
            if isinstance(result, BaseException):
                failed[name] = result
            else:
                journal.append(result)
            progress.update(sizes[name])
    return {name: failed[name] for name in tasks if name in failed}
