"""Repeats the comparisons of the MWP paper on all available data sets.

    python scripts/reproduce_paper.py DATA_DIRECTORY [--output DIR] [--only NAME ...]
        [--sets NAME ...] [--pairs N] [--quick]

DATA_DIRECTORY contains data sets in the layouts of `docs/datasets.md`, each in its own directory. Each
experiment uses only the data sets that suit it:

- `table1`: all methods except SmoothShells, on data sets in which both shapes of each pair belong to the same
  class. The results are errors and times (Table 1), and correspondence quality curves (Fig. 4);
- `table2`: MWP, the preset `accurate` and SmoothShells, on the same pairs. The results are errors, and times
  with precomputation (Table 2). SmoothShells takes 20 to 30 s per pair;
- `fig6`: partial shapes, separately for cuts and holes;
- `fig7`: shapes with topological noise;
- `fig9`: targets with other triangulations and resolutions, and other initial maps;
- `nonisometric`: pairs of different classes, compared with published results. Refinement starts from
  published initial maps if the data set contains such maps, and from SHOT otherwise;
- `settings`: MWP and other methods, with the published settings and with other settings, on the data sets of
  `table1`.

In the output directory, the script creates one directory for each run. Each directory contains the same files
that `jaxsmw benchmark` writes. The script writes all tables to `README.md`. After an interruption, the same
command continues from the saved results. With `--quick`, the script takes minutes on shapes with 5000
vertices.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import igl
import numpy as np
from common import make_parser, write_text
from jaxtyping import Int64
from scipy.spatial import KDTree

from jaxsmw import InputError
from jaxsmw.benchmark.benchmark import Results, run_benchmark
from jaxsmw.benchmark.datasets import DataPair, DataSet, choose_pairs, class_of, open_data_set
from jaxsmw.benchmark.measurement import Settings
from jaxsmw.benchmark.opponents.base import Method
from jaxsmw.benchmark.opponents.baselines import PublishedMaps, Staged
from jaxsmw.benchmark.opponents.registry import METHODS, suited_methods
from jaxsmw.benchmark.tables import MethodSummary, markdown, write_tables
from jaxsmw.choices import DEFAULT_MATCH_INIT
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.io.meshes import read_mesh, write_mesh
from jaxsmw.runtime.files import make_directory
from jaxsmw.runtime.workers import open_executor

TABLE2_METHODS = ("mwp", "accurate", "smooth-shells")
FIG9_METHODS = ("initial", "mwp", "mwp-sampled", "zoomout")
# The number of pairs in `fig9` is `--pairs` / FIG9_SHARE, but at least 2. Without `--pairs`, the number of
# pairs is 40 / FIG9_SHARE.
FIG9_SHARE = 4
INITIAL_MAPS = ("shot", "wks", "hks", "wavelet", "functional")
# These initial maps come from descriptors that cannot distinguish left from right. The maps "shot" and
# "functional" come from SHOT, which can distinguish left from right.
_MIRRORED = {"wks", "hks", "wavelet"}


class Run(NamedTuple):
    """One benchmark, which fills one column in the table of its experiment."""

    experiment: str
    name: str
    data_set: DataSet
    pairs: list[DataPair]
    methods: Mapping[str, Method]
    settings: Settings


def find_data_sets(data: Path, names: list[str] | None) -> list[DataSet]:
    """Open the data sets with the given names in a directory, or all data sets if no names are given.

    **Raises:** `InputError` if a named data set cannot be opened, or if there is no data set.
    """
    if names:
        return [open_data_set(data / name) for name in names]
    if not data.is_dir():
        raise InputError(f"{data}: is not a directory: give the directory that holds the data sets.")
    data_sets = []
    for directory in sorted(path for path in data.iterdir() if path.is_dir()):
        try:
            data_sets.append(open_data_set(directory))
        except InputError as error:
            print(f"left out: {error}")
    if not data_sets:
        raise InputError(f"{data}: holds no data set: give the directory that holds the data sets.")
    return data_sets


def is_isometric(data_set: DataSet) -> bool:
    """Return whether each pair consists of full shapes of one class, and no shape has topological noise."""
    special = ("SHREC'16 partial", "SHREC'16 topology")
    within = all(class_of(pair.source) == class_of(pair.target) for pair in data_set.pairs)
    return within and data_set.layout not in special


def table1(data_sets: list[DataSet], options: argparse.Namespace) -> Iterator[Run]:
    """Yield the runs of all methods on full near-isometric shapes."""
    for data_set in filter(is_isometric, data_sets):
        pairs = drawn_pairs(data_set, options)
        every = methods(pairs, options)
        every.pop("smooth-shells", None)  # table2
        yield Run("table1", data_set.name, data_set, pairs, every, same(options))


def table2(data_sets: list[DataSet], options: argparse.Namespace) -> Iterator[Run]:
    """Yield the runs of MWP, `accurate` and SmoothShells on full near-isometric shapes."""
    some = {name: METHODS[name] for name in TABLE2_METHODS}
    for data_set in filter(is_isometric, data_sets):
        yield Run("table2", data_set.name, data_set, drawn_pairs(data_set, options), some, same(options))


def fig6(data_sets: list[DataSet], options: argparse.Namespace) -> Iterator[Run]:
    """Yield the runs that match partial shapes to full shapes."""
    for data_set in data_sets:
        if data_set.layout != "SHREC'16 partial":
            continue
        for kind in ("cuts", "holes"):
            pairs = tuple(pair for pair in data_set.pairs if pair.source.startswith(kind))
            if pairs:
                name, subset = f"{data_set.name}-{kind}", dataclasses.replace(data_set, pairs=pairs)
                some = drawn_pairs(subset, options)
                yield Run("fig6", name, subset, some, methods(pairs, options), same(options))


def fig7(data_sets: list[DataSet], options: argparse.Namespace) -> Iterator[Run]:
    """Yield the runs on shapes with topological noise."""
    for data_set in data_sets:
        if data_set.layout == "SHREC'16 topology":
            pairs = drawn_pairs(data_set, options)
            yield Run("fig7", data_set.name, data_set, pairs, methods(pairs, options), same(options))


def fig9(data_sets: list[DataSet], options: argparse.Namespace) -> Iterator[Run]:
    """Yield the runs with remeshed targets, and the runs from other initial maps."""
    some = {name: METHODS[name] for name in FIG9_METHODS}
    few = argparse.Namespace(**{**vars(options), "pairs": max(2, (options.pairs or 40) // FIG9_SHARE)})
    for data_set in filter(is_isometric, data_sets):
        pairs = drawn_pairs(data_set, few)
        for init in (*INITIAL_MAPS, *published(data_set)):
            setting = same(options, init=init, mirrored=_can_mirror(init, pairs))
            yield Run("fig9", f"{data_set.name}-from-{Path(init).name}", data_set, pairs, some, setting)
        if not all(len(pair.truth) in (0, 2) for pair in pairs):
            continue  # `derive` cannot use ground truth that is stored for each pair instead of each shape
        for name, remesh in MESHINGS.items():
            directory = options.output / "fig9" / f"meshes-{data_set.name}-{name}"
            derived = derive(directory, pairs, name, remesh)
            every = list(derived.pairs)
            yield Run("fig9", f"{data_set.name}-{name}", derived, every, some, same(options))


def nonisometric(data_sets: list[DataSet], options: argparse.Namespace) -> Iterator[Run]:
    """Yield the runs on non-isometric shapes, with published results from the same initial maps."""
    for data_set in data_sets:
        if is_isometric(data_set) or data_set.layout != "a remeshed set":
            continue
        directories = published(data_set)
        # The directory maps/NAME contains initial maps. Other methods refined these initial maps, and their
        # results are in directories whose names begin with NAME.
        initial = [path for path in directories if not path.startswith(tuple(set(directories) - {path}))]
        for init in initial or ["shot"]:
            finished = {
                Path(path).name: PublishedMaps(Path(path)) for path in directories if path not in initial
            }
            name, pairs = f"{data_set.name}-from-{Path(init).name}", drawn_pairs(data_set, options)
            every = methods(pairs, options) | finished
            yield Run("nonisometric", name, data_set, pairs, every, same(options, init=init))


def settings(data_sets: list[DataSet], options: argparse.Namespace) -> Iterator[Run]:
    """Yield the runs with the published settings and with other settings."""
    for data_set in filter(is_isometric, data_sets):
        pairs = drawn_pairs(data_set, options)
        yield Run("settings", data_set.name, data_set, pairs, other_settings(), same(options))


def other_settings() -> dict[str, Method]:
    """Return the methods with their published settings, and with each change in `_CHANGES`."""
    variants = {"initial": METHODS["initial"]}
    for name, changes in _CHANGES.items():
        method = variants[name] = METHODS[name]
        assert dataclasses.is_dataclass(method)
        reference = method.reference.partition(":")[0]
        for change in changes:
            changed: dict[str, Any] = {
                _NAMES.get(setting, setting): value for setting, value in change.items()
            }
            label = ", ".join(f"{setting} = {value}" for setting, value in change.items())
            if isinstance(method, Staged):
                changed = {"stages": tuple(dataclasses.replace(stage, **changed) for stage in method.stages)}
            variants[f"{name}: {label}"] = dataclasses.replace(
                method, reference=f"{reference}, with {label}", **changed
            )
    return variants


_NAMES = {"k": "number_of_eigenvectors"}
_CHANGES: dict[str, list[dict[str, int]]] = {
    "mwp": [{"k": k, "iterations": i} for i in (3, 10) for k in (50, 100, 150, 200) if (k, i) != (100, 3)],
    "icp": [{"k": 20}, {"k": 50}, {"k": 200}, {"iterations": 50}],
    "cpd": [{"k": 20}, {"k": 60}],
    "zoomout": [{"k": 60}, {"k": 200}, {"first": 10}, {"first": 50}, {"step": 1}, {"step": 20}],
}


EXPERIMENTS = {f.__name__: f for f in (table1, table2, fig6, fig7, fig9, nonisometric, settings)}


def drawn_pairs(data_set: DataSet, options: argparse.Namespace) -> list[DataPair]:
    """Return the pairs of a data set that the run measures."""
    return choose_pairs(data_set, None if options.pairs is None else str(options.pairs), options.seed)


def methods(pairs: Sequence[DataPair], options: argparse.Namespace) -> dict[str, Method]:
    """Return all methods that can match the pairs. With `--quick`, return only three fast methods."""
    every = suited_methods(pairs)
    return {name: every[name] for name in ("initial", "mwp", "zoomout-sampled")} if options.quick else every


def same(options: argparse.Namespace, *, init: str = DEFAULT_MATCH_INIT, mirrored: bool = False) -> Settings:
    """Return the benchmark settings of a run. Only the initial map and mirroring differ between runs."""
    return Settings(init, mirrored, 200 if options.quick else None, options.seed)


def published(data_set: DataSet) -> list[str]:
    """Return the directories of the published maps of a data set."""
    return sorted(str(path) for path in (data_set.directory / "maps").glob("*") if path.is_dir())


def _can_mirror(init: str, pairs: list[DataPair]) -> bool:
    """Return whether maps refined from `init` may also be compared with the mirrored ground truth."""
    ambiguous = init in _MIRRORED or "symm" in Path(init).name
    return ambiguous and all(pair.mirrored_truth is not None for pair in pairs)


# A pair of a new mesh and an array. For each vertex of the new mesh, the array contains the old vertex at the
# same position, or -1 if there is no such vertex.
Remeshed = tuple[Mesh, Int64[np.ndarray, " n"]]


def finer(mesh: Mesh) -> Remeshed:
    """Split every face into four faces."""
    vertices, faces = igl.upsample(mesh.vertices, mesh.faces, 1)
    old = np.full(len(vertices), -1)
    old[: len(mesh.vertices)] = np.arange(len(mesh.vertices))
    return make_mesh(vertices, faces), old


def coarser(mesh: Mesh) -> Remeshed:
    """Collapse edges, the shortest edges first, until a quarter of the faces are left."""
    return _decimate(mesh, mesh.vertices, len(mesh.faces) // 4)


def uneven(mesh: Mesh) -> Remeshed:
    """Collapse edges until half of the faces are left. Faces are smaller towards one end of the body."""
    centered = mesh.vertices - mesh.vertices.mean(axis=0)
    _, _, axes = np.linalg.svd(centered, full_matrices=False)
    along = centered @ axes[0]
    along = (along - along.min()) / np.ptp(along)
    return _decimate(mesh, centered * 4 ** along[:, None], len(mesh.faces) // 2)


def _decimate(mesh: Mesh, positions: np.ndarray, faces: int) -> Remeshed:
    _, kept, _, old = igl.decimate(positions, mesh.faces.astype(np.int32), faces)
    return make_mesh(mesh.vertices[old], kept), np.asarray(old)


MESHINGS: dict[str, Callable[[Mesh], Remeshed]] = {"finer": finer, "coarser": coarser, "uneven": uneven}


def derive(directory: Path, pairs: list[DataPair], name: str, remesh: Callable[[Mesh], Remeshed]) -> DataSet:
    """Write a data set with the sources and the remeshed targets of the pairs, and open the data set."""
    listing = directory / "test_pairs.txt"
    if not listing.exists():
        shapes, truths = make_directory(directory / "off"), make_directory(directory / "corres")
        for pair in pairs:
            mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
            truth = pair.ground_truth(mesh_x, mesh_y)
            remeshed, old = remesh(mesh_y)
            new = KDTree(remeshed.vertices).query(mesh_y.vertices)[1]
            new[old[old >= 0]] = np.flatnonzero(old >= 0)
            for shape, mesh, rows in (
                (pair.source, mesh_x, truth.source_vertices),
                (f"{pair.target}-{name}", remeshed, new[truth.targets]),
            ):
                write_mesh(shapes / f"{shape}.off", mesh)
                np.savetxt(truths / f"{shape}.vts", rows + 1, fmt="%d")
        write_text(listing, "".join(f"{pair.source} {pair.target}-{name}\n" for pair in pairs))
    return open_data_set(directory)


def perform(run: Run, output: Path, executor: Executor) -> tuple[Results, dict[str, MethodSummary]]:
    """Measure the missing results of a run, and write its tables."""
    directory = make_directory(output / run.experiment / run.name)
    print(f"{run.experiment}: {run.name}, {len(run.pairs)} of {len(run.data_set.pairs)} pairs")
    results = run_benchmark(run.data_set, run.pairs, directory, run.methods, run.settings, executor)
    if not results.rows:
        return results, {}
    return results, write_tables(directory, run.data_set, results, run.settings, run.methods)


def overview(tables: Mapping[tuple[str, str], Mapping[str, MethodSummary]]) -> str:
    """Return a table for each experiment. Each cell contains the mean error and the seconds of one method."""
    parts = [
        "# The paper's comparisons",
        "Each cell contains the mean error x 10⁻³ √area, and the seconds from the initial map to the result.",
    ]
    for experiment in dict.fromkeys(experiment for experiment, _ in tables):
        columns = {name: summaries for (own, name), summaries in tables.items() if own == experiment}
        names = dict.fromkeys(name for summaries in columns.values() for name in summaries)
        rows = [["method", *(f"[{name}]({experiment}/{name}/summary.md)" for name in columns)]]
        rows += [[name, *(_cell(summaries.get(name)) for summaries in columns.values())] for name in names]
        parts += [f"## {experiment}", markdown(rows)]
    return "\n\n".join(parts)


def _cell(summary: MethodSummary | None) -> str:
    if summary is None:
        return "—"
    seconds = "" if np.isnan(summary.seconds) else f", {summary.seconds:.2f} s"
    return f"{summary.mean:.1f}{seconds}" + (f", {summary.failures} failed" if summary.failures else "")


def main() -> None:
    parser = make_parser(__doc__, data="DATA_DIRECTORY", parts=EXPERIMENTS, output="paper", seed=True)
    parser.add_argument("--sets", nargs="+", metavar="NAME", help="names of data sets to use (default: all)")
    parser.add_argument("--pairs", type=int, help="number of random pairs from each set (default: all)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler")
    parser.add_argument(
        "--quick", action="store_true", help="use only two pairs, three methods and 200 points"
    )
    options = parser.parse_args()
    if options.quick:
        options.pairs = min(options.pairs or 2, 2)
    try:
        data_sets = find_data_sets(options.data, options.sets)
        tables: dict[tuple[str, str], dict[str, MethodSummary]] = {}
        failures: dict[str, str] = {}
        with open_executor(options.workers, options.scheduler) as executor:
            for name in options.only:
                for run in EXPERIMENTS[name](data_sets, options):
                    results, tables[run.experiment, run.name] = perform(run, options.output, executor)
                    for what, why in results.failures.items():
                        failures[f"{run.experiment}, {run.name}, {what}"] = why
                    write_text(options.output / "README.md", overview(tables))
        Results([], {}, failures).check()
    except InputError as error:
        parser.exit(2, "\n".join([*error.lines(), ""]))
    print(options.output / "README.md")


if __name__ == "__main__":
    main()
