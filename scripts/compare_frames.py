"""Compares frames, conventions and ways to compute the functional map, on remeshed FAUST and TOSCA.

    python scripts/compare_frames.py DATA_DIRECTORY [--output DIRECTORY] [--pairs N] [--seed N]
                                     [--workers N] [--quick]

The script needs the extra `dev`: `pip install -e ".[dev]"`.

DATA_DIRECTORY contains `faust_r` and `tosca_r`, the remeshed sets of Ren et al. (2018). Each set consists of
meshes (`off/NAME.off`), ground truth (`corres/NAME.vts`), and the file `test_pairs.txt` with two names per
line. The script writes the figures and these files to the output directory:

- `summary.md`: all tables;
- `results.csv`: the results of each variant on each pair;
- `parameters.csv`: the errors for each combination of the numbers of eigenvectors, filters and iterations;
- `invariance.csv`: the similarity of wavelets around corresponding points;
- `times.csv`: the times of each way to compute the functional map, and of the nearest-neighbour search;
- `provenance.json`: versions, machine, seeds and settings.

After an interruption, the same command continues from the saved results.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
from common import make_parser
from frame_study import measurement, variants
from frame_study.drawing import draw_figures
from frame_study.measurement import (
    DATA_SETS,
    INVARIANCE_FRAMES,
    PairName,
    Settings,
    Task,
    files_of,
    measure,
    measure_times,
)
from frame_study.summary import Study, write_summary
from frame_study.variants import QUICK_FRAMES, Variant, frames, twins
from tqdm import tqdm

from jaxsmw import InputError
from jaxsmw.benchmark.journal import Journal, Row
from jaxsmw.report.figures import check_drawable
from jaxsmw.report.summary import provenance
from jaxsmw.runtime.files import atomic_write, make_directory
from jaxsmw.runtime.provenance import claimed_directory, code_digest, measured_code
from jaxsmw.runtime.workers import Workers, run_tasks

QUICK = Settings(
    pairs=2,
    iterations=2,
    evaluated_points=200,
    wavelet_centers=20,
    frames=QUICK_FRAMES,
    parameter_pairs=1,
    parameter_eigenvectors=(20, 40),
    parameter_filters=(2, 6),
    parameter_iterations=2,
)


def evenly_spread(items: Sequence, count: int) -> list:
    """Return `count` items, spread evenly from the first to the last, or all items if there are fewer."""
    places = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[int(place)] for place in np.round(places)]


def select_pairs(data: Path, count: int) -> list[PairName]:
    pairs = []
    for data_set in DATA_SETS:
        listing = data / data_set / "test_pairs.txt"
        if not listing.is_file():
            raise InputError(f"{listing}: does not exist: give the directory that holds {data_set}.")
        lines = [line.split() for line in listing.read_text("utf-8").splitlines() if line.strip()]
        if wrong := [line for line in lines if len(line) != 2]:
            raise InputError(f"{listing}: {' '.join(wrong[0])!r} does not name two shapes: correct the line.")
        pairs += [PairName(data_set, *line) for line in evenly_spread(lines, count)]
    return pairs


def digest(data: Path, pairs: list[PairName]) -> str:
    """Return a hash of the contents of all files of the pairs."""
    found = hashlib.sha256()
    for pair in pairs:
        for name in pair[1:]:
            mesh, truth = files_of(data, pair.data_set, name)
            found.update(mesh.read_bytes())
            found.update(truth.read_bytes())
    return found.hexdigest()[:16]


class Journals:
    """The result tables of a study, and the rows that each table must contain when the study is complete."""

    def __init__(self, output: Path, pairs: list[PairName], settings: Settings, measured: list[Variant]):
        self.pairs, self.settings, self.measured = pairs, settings, measured
        self.parameters_of = {
            pair
            for data_set in DATA_SETS
            for pair in evenly_spread([p for p in pairs if p.data_set == data_set], settings.parameter_pairs)
        }
        self.parameters_wanted = [
            (k, filters) for k in settings.parameter_eigenvectors for filters in settings.parameter_filters
        ]
        self.invariance_wanted = [
            (frame, scale) for frame in INVARIANCE_FRAMES for scale in range(settings.number_of_filters)
        ]
        self.results = Journal(output / "results.csv", [*PairName._fields, *Variant._fields])
        self.parameters = Journal(output / "parameters.csv", [*PairName._fields, "eigenvectors", "filters"])
        self.invariance = Journal(output / "invariance.csv", [*PairName._fields, "frame", "scale"])

    def missing(self) -> Iterator[Task]:
        """Yield one task for each pair with missing rows."""
        for pair in self.pairs:
            parameters = self.parameters_wanted if pair in self.parameters_of else []
            task = Task(
                pair,
                [variant for variant in self.measured if (*pair, *variant) not in self.results],
                [cell for cell in parameters if (*pair, *cell) not in self.parameters],
                [cell for cell in self.invariance_wanted if (*pair, *cell) not in self.invariance],
            )
            if task.variants or task.parameters or task.wavelets:
                yield task

    def append(self, results: list[Row], parameters: list[Row], invariance: list[Row]) -> None:
        self.results.append(results)
        self.parameters.append(parameters)
        self.invariance.append(invariance)

    def sort(self) -> None:
        """Sort all rows, so that their order does not depend on the order in which workers finish."""
        self.results.sort((*pair, *variant) for pair in self.pairs for variant in self.measured)
        self.parameters.sort(
            (*pair, *cell)
            for pair in self.pairs
            if pair in self.parameters_of
            for cell in self.parameters_wanted
        )
        self.invariance.sort((*pair, *cell) for pair in self.pairs for cell in self.invariance_wanted)


def run(data: Path, journals: Journals, workers: int) -> None:
    """Measure the missing rows pair by pair in worker processes, and save the rows after each pair.

    **Raises:** `InputError` if some pairs could not be measured. All other pairs are measured before the
    error is raised.
    """
    tasks = list(journals.missing())
    if not tasks:
        return
    progress = tqdm(
        total=len(journals.pairs),
        initial=len(journals.pairs) - len(tasks),
        desc="pairs",
        unit="pair",
        smoothing=0,
    )
    failed: list[str] = []
    named = {" ".join(task.name): task for task in tasks}
    with progress, Workers(min(workers, len(tasks))) as executor:
        for name, result in run_tasks(partial(measure, data, settings=journals.settings), named, executor):
            if isinstance(result, BaseException):
                failed.append(f"{name} ({result})")
            else:
                journals.append(*result)
            progress.update()
    if failed:
        raise InputError(
            f"{len(failed)} pairs could not be measured ({'; '.join(failed)}), and the results of the other "
            "pairs are kept: repair the files of the failed pairs, and run the same command again."
        )


def measured_times(
    output: Path, data: Path, pairs: list[PairName], measured: list[Variant], settings: Settings
) -> list[Row]:
    """Return the time of each way to compute the functional map, from `times.csv` if this file exists.

    If the file does not exist, a single worker process measures the times. No other measurements run at
    the same time.
    """
    path = output / "times.csv"
    key = [*PairName._fields, *Variant._fields]
    if not path.exists():
        print("measuring the time of each update", file=sys.stderr)
        firsts = [next(pair for pair in pairs if pair.data_set == data_set) for data_set in DATA_SETS]
        with Workers(1) as executor:
            rows = executor.submit(measure_times, data, firsts, measured, settings).result()
        with atomic_write(path) as temporary:
            Journal(temporary, key).append(rows)
    return Journal(path, key).rows


def main() -> None:
    parser = make_parser(__doc__, data="DATA_DIRECTORY", seed=True)
    parser.add_argument(
        "--output",
        type=Path,
        help="output directory (default: docs/frames, with --quick a new temporary directory)",
    )
    parser.add_argument(
        "--pairs", type=int, help="number of pairs from each data set (default: 40, with --quick 2)"
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=os.cpu_count(),
        help="number of worker processes (default: %(default)s)",
    )
    parser.add_argument("--quick", action="store_true", help="run a small study that exercises all parts")
    options = parser.parse_args()
    settings = replace(QUICK if options.quick else Settings(), seed=options.seed)
    if options.pairs is not None:
        settings = replace(settings, pairs=options.pairs)
    output = options.output or (
        Path(tempfile.mkdtemp(prefix="jaxsmw-frames-")) if options.quick else Path("docs/frames")
    )
    try:
        if settings.pairs < 1 or options.workers < 1 or settings.seed < 0:
            raise InputError("--pairs and --workers must be at least 1, and --seed at least 0.")
        study(options.data, output, settings, options.workers)
    except InputError as error:
        sys.exit(f"compare_frames: {error}")
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted; the same command with --output {output} continues from the saved results")


def study(data: Path, output: Path, settings: Settings, workers: int) -> None:
    """Run the study: measure all pairs, write the summary, and draw the figures."""
    check_drawable()
    jax.config.update("jax_platforms", "cpu")
    pairs = select_pairs(data, settings.pairs)
    code = [*measured_code(), Path(variants.__file__), Path(measurement.__file__)]
    origin = {
        "settings": asdict(settings),
        "versions": {**provenance(), "code": code_digest(code)},
        "data": {"digest of the pairs' files": digest(data, pairs)},
    }
    with claimed_directory(make_directory(output), origin):
        every = variants.variants(settings.frames)
        same = twins(every, frames(settings.number_of_filters))
        measured = [variant for variant in every if variant not in same]
        journals = Journals(output, pairs, settings, measured)
        run(data, journals, workers)
        journals.sort()
        times = measured_times(output, data, pairs, measured, settings)
        if code_digest(code) != origin["versions"]["code"]:
            raise InputError(
                f"{output}: its results come from different versions of the code, because the code changed "
                "during the study: remove this directory, and start again."
            )
        whole = Study(journals.results.rows, times, pairs, every, same, settings)
        with atomic_write(output / "summary.md") as temporary:
            temporary.write_text(write_summary(whole, journals.invariance.rows), "utf-8")
        draw_figures(output, data, whole, journals.parameters.rows)
    print(output / "summary.md")


if __name__ == "__main__":
    main()
