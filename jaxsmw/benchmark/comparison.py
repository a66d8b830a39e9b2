"""Compares methods on the same pairs: `compare` measures them, and a `Comparison` holds the results."""

from __future__ import annotations

import itertools
import os
import pickle
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Float64, Int

from jaxsmw.benchmark.benchmark import Results, run_benchmark
from jaxsmw.benchmark.datasets import AnyPair, DataPair, DataSet, MeshPair, open_data_set
from jaxsmw.benchmark.intervals import Interval, mean_interval
from jaxsmw.benchmark.journal import Journal
from jaxsmw.benchmark.measurement import RESULT_COLUMNS, Settings, shapes_of
from jaxsmw.benchmark.opponents.base import Method, MethodInput, PointwiseMap
from jaxsmw.benchmark.opponents.baselines import Matched, Staged
from jaxsmw.benchmark.opponents.registry import find_methods
from jaxsmw.benchmark.tables import markdown_table, pair_errors, summarize_methods
from jaxsmw.choices import DEFAULT_MATCH_INIT, ITERATIONS, NUMBER_OF_EIGENVECTORS, PresetName
from jaxsmw.core.arrays import Array
from jaxsmw.core.banks import FilterBank
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.creature import CreaturePair
from jaxsmw.errors import InputError, check_whole_number
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.geometry.mesh import Mesh, as_mesh
from jaxsmw.geometry.surface_points import SurfacePoints, check_points, check_pointwise_map
from jaxsmw.matching.stages import Preset, Stage, choose_preset
from jaxsmw.report.figures import draw_intervals, save_figure
from jaxsmw.runtime.files import make_directory
from jaxsmw.runtime.provenance import read_provenance, value_digest
from jaxsmw.runtime.workers import Workers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MapFunction = Callable[[Spectrum, Spectrum, Int[Array, " m"]], PointwiseMap]
"""A function that takes the spectra of X and Y and an initial map X -> Y (m,), and returns a map X -> Y (m,).

Maps contain 0-based vertices of Y. The arrays of the spectra are JAX arrays, as from `paired_spectra`.
"""

Compared = Method | Refiner | Stage | Sequence[Stage] | Preset | MapFunction | str
"""The kinds of method that `compare` accepts."""

TruePair = tuple[Mesh, Mesh, GroundTruth | SurfacePoints | Int[np.ndarray, " m"]]
"""The source X, the target Y and the true points on Y of some or all vertices of X."""


def compare(
    methods: Mapping[str, Compared] | Sequence[str],
    pairs: DataSet | str | os.PathLike[str] | Iterable[DataPair | CreaturePair | TruePair],
    *,
    number_of_eigenvectors: int = NUMBER_OF_EIGENVECTORS,
    iterations: int = ITERATIONS,
    init: str = DEFAULT_MATCH_INIT,
    evaluated_points: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    output: str | os.PathLike[str] | None = None,
    quiet: bool = False,
) -> Comparison:
    """Match all pairs with all methods from the same initial maps, and measure the errors and times.

    Each shape is prepared once for all methods and pairs. If the comparison is interrupted or killed, the
    same call with the same `output` measures only what is missing. A later call with the same `output` can
    add pairs, and methods that need no more eigenvectors than the first call computed.

    **Arguments:**

    - `methods`: the methods by name, or a list of names. A method is one of the following.

        - a `Refiner`, which runs with the arguments `number_of_eigenvectors` and `iterations`. A refiner with
          levels has its own numbers.
        - a `Stage`, or a list or tuple of stages, with their own numbers.
        - a function `f(spectrum_x, spectrum_y, start_map)` that returns a map X -> Y (m,) of 0-based vertices
          of Y. Its arguments are the spectra of X (m vertices) and Y, as `paired_spectra` returns them with
          `number_of_eigenvectors`, and the initial map X -> Y (m,). If the function raises an
          `ArithmeticError`, the method has failed on this pair.
        - a `Preset` or the name of a preset, which `jaxsmw.match` runs with its search.
        - the name of a method that `jaxsmw benchmark --help` lists: `"zoomout"`, `"icp"`, `"cpd"`,
          `"initial"` (the initial map without refinement) and others.

    - `pairs`: a data set (a `DataSet` or its directory), or pairs with ground truth: each is a `DataPair`, a
      `CreaturePair`, or a tuple `(mesh_x, mesh_y, truth)`. In a tuple, `truth` is a `GroundTruth`, or the
      true points of all vertices of X: a map (m,) or `SurfacePoints`.
    - `number_of_eigenvectors`: the number for refiners without levels, and for functions; 100 by default.
      Each shape gets as many eigenvectors as any method needs, or as in the first call with `output`.
    - `iterations`: the number for refiners without levels; 3 by default.
    - `init`: the initial map of all methods, a name that `jaxsmw.match` accepts, or a directory with maps in
      files `X_Y.map`. With `"auto"` (the default), it is `"shot"`; presets may also try others.
    - `evaluated_points`: the number of ground-truth points at which all maps are evaluated; None for all.
    - `seed`: the seed of the draw of these points and of the bootstrap.
    - `workers`: the number of worker processes, each on one core of the CPU. With None (the default), this
      process runs one pair after another, or batches of pairs if JAX has an accelerator. A script must call
      `compare` with workers below `if __name__ == "__main__":`, and functions must be defined in a module.
    - `output`: a directory for the results, made if missing. With None, nothing is kept.
    - `quiet`: whether to hide the progress bars.

    **Returns:** A `Comparison`. A method that fails on a pair has no error there. A pair is left out if it
    cannot be prepared; a `UserWarning` names the cause.

    **Raises:** `InputError` if there are no methods or pairs, if a method or pair is of no known kind, if a
    pair has no ground truth, or if two pairs or two different meshes have the same name. `InputError` is also
    raised if `output` contains results of other data, settings, methods or versions, if an argument is out of
    range, if a method cannot be sent to workers, if the workers end abruptly, or if no pair could be
    measured, for example because a function returns no map. If the code of a method raises another error on
    the first pair, the comparison ends with an `InputError` at once, whose `__cause__` is that error.
    """
    check_whole_number("number_of_eigenvectors", number_of_eigenvectors, 1)
    check_whole_number("iterations", iterations, 1)
    check_whole_number("seed", seed, 0)
    for name, number in (("evaluated_points", evaluated_points), ("workers", workers)):
        if number is not None:
            check_whole_number(name, number, 1)
    every = _named_methods(methods, number_of_eigenvectors, iterations)
    chosen = _known_pairs(pairs)
    settings = Settings(init, evaluated_points=evaluated_points, seed=seed)
    if workers is not None:
        _check_sendable(every)
    with _directory(output) as directory, nullcontext() if workers is None else Workers(workers) as executor:
        try:
            results = run_benchmark(
                None,
                chosen,
                directory,
                every,
                settings,
                executor,
                quiet=quiet,
                number_of_eigenvectors=_computed_number(directory, number_of_eigenvectors, every),
                timed_shapes=False,
                stops_at_fault=True,
            )
        except BrokenProcessPool as error:
            raise InputError(
                "the worker processes ended abruptly: let scripts call compare below "
                "`if __name__ == '__main__':`, or use fewer workers if memory is short."
            ) from error
    if not results.rows:
        results.check()
    for cause in results.causes():
        warnings.warn(f"could not be measured: {cause}", stacklevel=2)
    return Comparison(results, seed)


@dataclass(frozen=True, eq=False)
class Comparison:
    """The results of several methods on the same pairs, as `compare` returns them.

    Errors are mean geodesic errors of a map in thousandths of the square root of the target's area.
    `print(comparison)` prints `table()`.

    **Attributes:**

    - `results`: the stored results.
    - `seed`: the seed of the bootstrap.
    """

    results: Results
    seed: int = 0

    @classmethod
    def read(cls, output: str | os.PathLike[str], *, seed: int = 0) -> Comparison:
        """Read the results that `compare` or `jaxsmw benchmark` stored in the directory `output`.

        A method that was added later can lack results for some pairs; see `table`.

        **Raises:** `InputError` if the directory contains no results, or if they are damaged.
        """
        path = Path(output) / "results.csv"
        if not path.is_file():
            raise InputError(f"{path}: does not exist: give the output directory of a comparison.")
        required = {"source", "target", "method", "result", "mean"}
        journal = Journal(
            path,
            ("source", "target", "method"),
            RESULT_COLUMNS,
            optional=RESULT_COLUMNS.keys() - required,
            read_only=True,
        )
        return cls(Results(journal.rows, {}, {}), seed)

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """One dictionary per pair and method, for example for `pandas.DataFrame`.

        The keys are the columns of `results.csv`; see `jaxsmw.benchmark.measurement.RESULT_COLUMNS`. `mean`
        and `median` are in units of the square root of the target's area.
        """
        return [{name: RESULT_COLUMNS[name](text) for name, text in row.items()} for row in self.results.rows]

    @cached_property
    def methods(self) -> tuple[str, ...]:
        """The names of the methods."""
        return tuple(dict.fromkeys(row["method"] for row in self.results.rows))

    @cached_property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """The names of the source and the target of each pair."""
        return tuple(dict.fromkeys((row["source"], row["target"]) for row in self.results.rows))

    def errors(self, method: str) -> Float64[np.ndarray, " p"]:
        """Return the error of a method on each of the p `pairs`; NaN where it failed or has no result."""
        by_pair = self._errors[self._checked(method)]
        return np.array([by_pair.get(pair, np.nan) for pair in self.pairs])

    def difference(self, method: str, reference: str) -> Interval:
        """Return the mean paired difference: the error of a method minus that of a reference on each pair.

        The interval is a BCa bootstrap interval (Efron 1987) over the pairs on which both succeeded.
        """
        differences = self.errors(method) - self.errors(reference)
        return mean_interval(differences[np.isfinite(differences)], self.seed)

    def differences(self, reference: str | None = None) -> dict[str, Interval]:
        """Return the `difference` of each other method from a reference, by default from the first method."""
        reference = self._checked(reference)
        return {name: self.difference(name, reference) for name in self.methods if name != reference}

    def table(self, reference: str | None = None) -> str:
        """Return a Markdown table with one row for each method.

        The columns are those of `jaxsmw benchmark`. The differences are those from the reference, by default
        from the first method. All other numbers are those of the pairs on which the method did not fail. The
        column `pairs` shows "2 of 30" if the method has results for 2 of the 30 `pairs`; `select` the pairs
        that all methods share before you compare means.
        """
        reference = self._checked(reference)
        summaries = summarize_methods(self.results, seed=self.seed, reference=reference)
        return markdown_table(summaries, reference)

    def plot(self, path: str | os.PathLike[str] | None = None, reference: str | None = None) -> Figure:
        """Draw the `differences` with their 95 % intervals, and return the figure.

        **Arguments:**

        - `path`: a file to which the figure is saved, such as `"frames.png"`; None to save nothing.
        - `reference`: the reference, by default the first method.

        **Raises:** `InputError` if the file cannot be written, if matplotlib is missing, or if there is no
        other method.
        """
        reference = self._checked(reference)
        label = f"difference from {reference} (×10⁻³ √area)"
        figure = draw_intervals(self.differences(reference), label)
        if path is not None:
            save_figure(path, figure)
        return figure

    def select(
        self, methods: Iterable[str] | None = None, pairs: Iterable[tuple[str, str]] | None = None
    ) -> Comparison:
        """Return the comparison of some methods, in their order, on some pairs; by default, of all."""
        names = [self._checked(name) for name in (self.methods if methods is None else methods)]
        kept = self.pairs if pairs is None else [tuple(pair) for pair in pairs]
        by_key = {(row["source"], row["target"], row["method"]): row for row in self.results.rows}
        rows = [by_key[key] for pair in kept for name in names if (key := (*pair, name)) in by_key]
        return replace(self, results=self.results._replace(rows=rows))

    def __str__(self) -> str:
        """The `table` with differences from the first method."""
        return self.table()

    @cached_property
    def _errors(self) -> dict[str, dict[tuple[str, str], float]]:
        return {
            name: pair_errors(row for row in self.results.rows if row["method"] == name)
            for name in self.methods
        }

    def _checked(self, method: str | None) -> str:
        if method is None:
            return self.methods[0]
        if method not in self.methods:
            raise InputError(
                f"{method!r} is not a method of this comparison: choose from {', '.join(self.methods)}."
            )
        return method


@dataclass(frozen=True, eq=False)
class MapMethod(Method):
    """A method that calls a function; see `MapFunction`."""

    name: str
    function: MapFunction
    reference: str
    number_of_eigenvectors: int

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        import jax

        assert pair.meshes is not None
        seen = pair.spectra.seen_by(Stage(number_of_eigenvectors=self.number_of_eigenvectors))
        x, y, initial_map = jax.device_put((*seen.both, np.asarray(pair.initial_map)))
        found = self.function(x, y, initial_map)
        if hasattr(found, "pointwise_map"):
            raise InputError(
                f"the map of the method {self.name} is a {type(found).__name__}: return its .pointwise_map."
            )
        images = np.asarray(found)
        return check_pointwise_map(images, *pair.meshes, f"map of the method {self.name}")


def _named_methods(
    methods: Mapping[str, Compared] | Sequence[str], number_of_eigenvectors: int, iterations: int
) -> dict[str, Method]:
    if isinstance(methods, str) or not isinstance(methods, Mapping | Sequence):
        raise InputError(
            f"methods is of type {type(methods).__name__}: give a dictionary from names to methods, or a "
            "list of names."
        )
    if not methods:
        raise InputError("there are no methods to compare: give at least one.")
    if not isinstance(methods, Mapping):
        if repeated := [name for number, name in enumerate(methods) if name in methods[:number]]:
            raise InputError(f"the method {repeated[0]!r} is listed twice: give every name once.")
        methods = {name: name for name in methods}
    if unnamed := [name for name in methods if not isinstance(name, str)]:
        raise InputError(f"the name of a method is {unnamed[0]!r}: give a text.")
    return {
        name: _as_method(name, method, number_of_eigenvectors, iterations) for name, method in methods.items()
    }


def _as_method(name: str, method: Compared, number_of_eigenvectors: int, iterations: int) -> Method:
    """Return a method of any kind as a `Method`, whose reference changes if the method changes."""
    if isinstance(method, Method):
        return method
    if isinstance(method, str):
        if method in get_args(PresetName):
            return Matched(f"jaxsmw.match with the preset {method}", choose_preset(method))
        return next(iter(find_methods([method], get_args(PresetName)).values()))
    if isinstance(method, Preset):
        return Matched(f"jaxsmw.match with a preset ({value_digest(method)})", method)
    if isinstance(method, Refiner):
        stage = Stage(method)
        if not method.levels:
            stage = replace(stage, number_of_eigenvectors=number_of_eigenvectors, iterations=iterations)
        method = stage
    stages = (method,) if isinstance(method, Stage) else method
    if isinstance(stages, Sequence) and stages and all(isinstance(stage, Stage) for stage in stages):
        shown = ", then ".join(
            f"{type(stage.refiner).__name__} with k = {stage.number_of_eigenvectors} and {stage.iterations} "
            "iterations"
            for stage in stages
        )
        return Staged(f"{shown} ({value_digest(tuple(stages))})", tuple(stages))
    if not callable(method) or isinstance(method, type | FilterBank):
        raise InputError(
            f"the method {name!r} is {method!r}: give a refiner such as WaveletPreservation(bank), one or "
            "several stages, a preset, a function of two spectra and an initial map, or the name of a method."
        )
    shown = getattr(method, "__qualname__", type(method).__name__)
    reference = f"the function {shown} with k = {number_of_eigenvectors} ({value_digest(method)})"
    return MapMethod(name, method, reference, number_of_eigenvectors)


def _known_pairs(
    pairs: DataSet | str | os.PathLike[str] | Iterable[DataPair | CreaturePair | TruePair],
) -> list[AnyPair]:
    if isinstance(pairs, str | os.PathLike):
        pairs = open_data_set(pairs)
    if isinstance(pairs, DataSet):
        return list(pairs.pairs)
    if not isinstance(pairs, Iterable):
        raise InputError(
            f"pairs is of type {type(pairs).__name__}: give a data set, its directory, or a list of pairs."
        )
    names: dict[int, str] = {}
    every = [_known_pair(number, pair, names) for number, pair in enumerate(pairs)]
    if not every:
        raise InputError("there are no pairs: give at least one.")
    shapes: dict[str, Path | Mesh] = {}
    for name, mesh in shapes_of(every):
        if shapes.setdefault(name, mesh) != mesh:
            raise InputError(f"two different shapes have the name {name}: give each its own name.")
    all_names = [pair.names for pair in every]
    if len(set(all_names)) < len(all_names):
        repeated = next(pair for number, pair in enumerate(every) if pair.names in all_names[:number])
        raise InputError(f"the pair {repeated.name} is listed twice: give every pair once.")
    return every


def _known_pair(number: int, pair: Any, names: dict[int, str]) -> AnyPair:
    """Return a pair of any kind. `names` are the names of the meshes in memory so far, by their ids."""
    if isinstance(pair, DataPair | MeshPair):
        return pair
    if isinstance(pair, CreaturePair):
        pair = pair.source, pair.target, pair.truth
    if not isinstance(pair, tuple | list) or len(pair) != 3:
        raise InputError(
            f"pair {number} is {type(pair).__name__} without ground truth: give a list of pairs, "
            "each a pair of a data set, a CreaturePair, or a tuple of the source, the target and the true "
            "points on the target."
        )
    meshes = as_mesh(pair[0], "source mesh"), as_mesh(pair[1], "target mesh")
    truth, m = pair[2], len(meshes[0].vertices)
    if not isinstance(truth, GroundTruth):
        targets = check_points(truth, meshes[1], f"pair {number}: ground truth")
        if len(targets) != m:
            raise InputError(
                f"pair {number}: there are {len(targets)} true points for the {m} vertices of the source: "
                "give one true point for each vertex, or a GroundTruth."
            )
        truth = GroundTruth.of_all_vertices(targets)
    source, target = (names.setdefault(id(mesh), _free_name(mesh, names)) for mesh in meshes)
    return MeshPair(source, target, *meshes, truth)


def _free_name(mesh: Mesh, names: Mapping[int, str]) -> str:
    """Return the name of a mesh, with a number behind it if another mesh has this name."""
    numbered = (f"{mesh.name} {number}" for number in itertools.count(2))
    return next(name for name in itertools.chain([mesh.name], numbered) if name not in names.values())


def _computed_number(directory: Path, number_of_eigenvectors: int, methods: Mapping[str, Method]) -> int:
    """Return the number of eigenvectors of each shape, which is that of all results in a directory."""
    needed = {"the argument number_of_eigenvectors": number_of_eigenvectors}
    needed |= {f"the method {name}": method.number_of_eigenvectors for name, method in methods.items()}
    what, most = max(needed.items(), key=lambda item: item[1])
    path = directory / "provenance.json"
    stored = read_provenance(path).get("settings", {}).get("number_of_eigenvectors") if path.exists() else 0
    if not isinstance(stored, int) or stored == 0:
        return most
    if stored < most:
        raise InputError(
            f"{directory}: contains results with {stored} eigenvectors of each shape, on which initial maps "
            f"can depend, but {what} needs {most}: give another output directory, and begin there with this "
            "number."
        )
    return stored


def _check_sendable(methods: Mapping[str, Method]) -> None:
    """Raise `InputError` if a method cannot be sent to a worker process."""
    interactive = not hasattr(sys.modules["__main__"], "__file__")
    for name, method in methods.items():
        try:
            if b"__main__" in pickle.dumps(method) and interactive:
                raise TypeError("it is defined in a notebook or an interactive session")
        except Exception as error:  # pickle raises errors of many types
            raise InputError(
                f"the method {name!r} cannot be sent to worker processes ({error}): define its function at "
                "the top level of a module, or leave out workers."
            ) from error


@contextmanager
def _directory(output: str | os.PathLike[str] | None) -> Iterator[Path]:
    """Make and return the directory of the results; with None, a temporary one."""
    if output is not None:
        yield make_directory(output)
        return
    with TemporaryDirectory(prefix="jaxsmw-compare-") as temporary:
        yield Path(temporary)
