"""Writes the results of a benchmark as tables, quality curves and a Parquet file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxsmw.benchmark.benchmark import Results
from jaxsmw.benchmark.datasets import DataSet
from jaxsmw.benchmark.intervals import CONFIDENCE, Interval, mean_interval
from jaxsmw.benchmark.journal import Row
from jaxsmw.benchmark.measurement import CURVE, RESULT_COLUMNS, Settings
from jaxsmw.benchmark.opponents.base import Method
from jaxsmw.choices import DEFAULT_INITIAL_MAP, DEFAULT_MATCH_INIT
from jaxsmw.report.figures import draw_quality_curves, save_figure
from jaxsmw.runtime.files import atomic_write

REFERENCE = "mwp"
"""The name of the reference method, with which tables compare all other methods."""


class MethodSummary(NamedTuple):
    """The errors and times of one method, over all pairs on which the method did not fail.

    **Attributes:**

    - `mean`, `median`: the mean and the median of the errors of all pairs. The error of a pair is its mean
      geodesic error, in thousandths of the square root of the target's area.
    - `difference`: an `Interval` with the attributes `mean`, `low` and `high`. For each pair, the error of
      the method `REFERENCE` is subtracted from the error of this method. `difference` contains the mean of
      these differences and the confidence interval of this mean, in the same unit as the errors. Pairs on
      which `REFERENCE` failed are left out. `difference` is NaN for `REFERENCE` itself.
    - `within`: the share of points with an error of at most 0.05 times the square root of the target's area.
      The value is the mean over all pairs.
    - `area_under_curve`: the mean area under the correspondence quality curves of all pairs, at most 1.
    - `coverage`: the share of a target's area that belongs to matched vertices, in [0, 1]. The value is the
      mean over all pairs.
    - `seconds`: the median time in seconds from the initial map to the result; NaN for published maps.
    - `pipeline_seconds`: the median time in seconds from the meshes to the result, which includes the
      precomputation of both shapes.
    - `failures`: the number of pairs on which the method failed.
    - `curve`: the mean correspondence quality curve (t,) at the thresholds
      `jaxsmw.benchmark.measurement.CURVE`.
    """

    mean: float
    median: float
    difference: Interval
    within: float
    area_under_curve: float
    coverage: float
    seconds: float
    pipeline_seconds: float
    failures: int
    curve: Float64[np.ndarray, " t"]


def summarize_methods(results: Results, *, seed: int = 0) -> dict[str, MethodSummary]:
    """Summarise the results of a benchmark for each method.

    **Arguments:**

    - `results`: the result of `jaxsmw.benchmark.benchmark.run_benchmark`.
    - `seed`: the seed of the bootstrap intervals.

    **Returns:** A dictionary from the name of each method to its summary. Means and medians are NaN if the
    method failed on all pairs.
    """
    found = {}
    reference = _mean_errors([row for row in results.rows if row["method"] == REFERENCE])
    for name in dict.fromkeys(row["method"] for row in results.rows):
        own = [row for row in results.rows if row["method"] == name]
        good = [row for row in own if row["result"] == "successful"]
        errors = _mean_errors(good)
        differences = np.array(
            [error - reference[pair] for pair, error in errors.items() if pair in reference]
        )
        means = np.array(list(errors.values()))
        precomputing = np.array([_precomputing(row, results.shapes) for row in good])
        seconds = _column(good, "seconds")
        curves = np.array([np.array(row["curve"].split(), float) for row in good]).reshape(-1, len(CURVE))
        found[name] = MethodSummary(
            mean=_mean(means),
            median=_median(means),
            difference=mean_interval(differences if name != REFERENCE else differences[:0], seed),
            within=_mean(_column(good, "within_0.05")),
            area_under_curve=_mean(_column(good, "area_under_curve")),
            coverage=_mean(_column(good, "coverage")),
            seconds=_median(seconds),
            pipeline_seconds=_median(seconds + precomputing),
            failures=len(own) - len(good),
            curve=curves.mean(axis=0) if len(good) else np.full(len(CURVE), np.nan),
        )
    return found


def _mean_errors(rows: Sequence[Row]) -> dict[tuple[str, str], float]:
    """Return the error of each pair (source, target) on which the method did not fail."""
    return {
        (row["source"], row["target"]): 1e3 * float(row["mean"])
        for row in rows
        if row["result"] == "successful"
    }


def _column(rows: Sequence[Row], name: str) -> Float64[np.ndarray, " r"]:
    return np.array([float(row[name]) for row in rows])


def _mean(values: Float64[np.ndarray, " r"]) -> float:
    return float(values.mean()) if len(values) else np.nan


def _median(values: Float64[np.ndarray, " r"]) -> float:
    return float(np.median(values)) if len(values) else np.nan


def _precomputing(row: Row, shapes: Mapping[str, Row]) -> float:
    """Return the precomputation time of both shapes of a pair, in seconds."""
    sides = {row["source"], row["target"]}
    return sum(
        float(shapes[side][column])
        for side in sides
        for column in ("seconds_spectrum", "seconds_descriptors")
    )


def _text(form: str, value: float) -> str:
    return "—" if np.isnan(value) else form.format(value)


_COLUMNS: tuple[tuple[str, Callable[[MethodSummary], str]], ...] = (
    ("mean error", lambda s: _text("{:.1f}", s.mean)),
    ("median", lambda s: _text("{:.1f}", s.median)),
    (f"minus {REFERENCE}", lambda s: str(s.difference)),
    ("within 0.05", lambda s: _text("{:.1%}", s.within)),
    ("area under curve", lambda s: _text("{:.3f}", s.area_under_curve)),
    ("coverage", lambda s: _text("{:.1%}", s.coverage)),
    ("refinement, s", lambda s: _text("{:.2f}", s.seconds)),
    ("with precomputation, s", lambda s: _text("{:.2f}", s.pipeline_seconds)),
    ("failed", lambda s: str(s.failures)),
)


def markdown_table(summaries: Mapping[str, MethodSummary]) -> str:
    """Return a Markdown table with one row for each method in `summaries`."""
    header = ["method", *(title for title, _ in _COLUMNS)]
    rows = [[name, *(text(summary) for _, text in _COLUMNS)] for name, summary in summaries.items()]
    return markdown([header, *rows])


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table of text cells; the first row is the header."""
    return "".join(
        "| " + " | ".join(cells) + " |\n" for cells in (rows[0], ["---"] * len(rows[0]), *rows[1:])
    )


_LATEX = str.maketrans({"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "−": "$-$", "—": "---"})


def latex_table(summaries: Mapping[str, MethodSummary]) -> str:
    """Return a LaTeX table with one row for each method in `summaries`.

    The horizontal lines of the table need the LaTeX package booktabs. The smallest mean error is in bold.
    """
    best = min((s.mean for s in summaries.values() if np.isfinite(s.mean)), default=np.nan)
    lines = [r"\begin{tabular}{l" + "r" * len(_COLUMNS) + "}", r"\toprule"]
    lines += [" & ".join(["method", *(title for title, _ in _COLUMNS)]) + r" \\", r"\midrule"]
    for name, summary in summaries.items():
        cells = [cell.translate(_LATEX) for cell in (name, *(text(summary) for _, text in _COLUMNS))]
        if summary.mean == best:
            cells[1] = rf"\textbf{{{cells[1]}}}"
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def write_tables(
    directory: Path, data_set: DataSet, results: Results, settings: Settings, methods: Mapping[str, Method]
) -> dict[str, MethodSummary]:
    """Write `summary.md`, `table.tex`, `curves.png` and `results.parquet` to a directory.

    **Arguments:**

    - `directory`: an existing directory. Existing files of the same names are replaced.
    - `methods`: a dictionary from the name of each method to a `Method`. The dictionary must contain every
      method in `results`.

    **Returns:** A dictionary from the name of each method to its summary.

    **Raises:** `InputError` if a file cannot be written, or if matplotlib is missing.
    """
    summaries = summarize_methods(results, seed=settings.seed)
    parts = [
        f"# {data_set.name}",
        _introduction(data_set, results, settings),
        markdown_table(summaries),
        "\n".join(f"- **{name}**: {methods[name].reference}" for name in summaries),
        "`results.csv` and `results.parquet` contain the results of each pair, `shapes.csv` contains the "
        "times of each shape, and `provenance.json` contains the provenance of the results.",
    ]
    _write(directory / "summary.md", "\n\n".join(parts) + "\n")
    _write(directory / "table.tex", latex_table(summaries))
    curves = {name: (CURVE, summary.curve) for name, summary in summaries.items()}
    means = {name: summary.mean / 1e3 for name, summary in summaries.items()}
    save_figure(directory / "curves.png", draw_quality_curves(curves, mean_errors=means))
    write_parquet(directory / "results.parquet", results.rows)
    return summaries


def _introduction(data_set: DataSet, results: Results, settings: Settings) -> str:
    """Return the paragraph above the table of `summary.md`."""
    pairs = {(row["source"], row["target"]) for row in results.rows}
    # A user's list of pairs can contain pairs that the data set does not list.
    listed = pairs <= {(pair.source, pair.target) for pair in data_set.pairs}
    share = f"{len(pairs)} of {len(data_set.pairs)}" if listed else f"{len(pairs)} given"
    points = "all points" if settings.evaluated_points is None else f"{settings.evaluated_points} points"
    machines = "; ".join(sorted({row["machine"] for row in results.rows}))
    sentences = [
        f"{share} pairs of the data set ({data_set.layout}) were measured. All methods start "
        f"from the same initial map ({_initial_map(settings)}).",
        "Errors are mean geodesic errors in thousandths of the square root of the target's area, at "
        f"{points} of the ground truth.",
        "The mean and the median are computed over the pairs on which a method did not fail. The column "
        f"'minus {REFERENCE}' contains the mean over the pairs of the error minus the error of {REFERENCE}, "
        f"with a {CONFIDENCE:.0%} bootstrap interval.",
        f"Times are medians over the pairs, without compilation, on {machines}. Each local worker process "
        "uses one core.",
    ]
    if results.failures:
        sentences.append(f"{len(results.failures)} shapes or pairs could not be measured.")
    return " ".join(sentences)


def _initial_map(settings: Settings) -> str:
    return DEFAULT_INITIAL_MAP if settings.init == DEFAULT_MATCH_INIT else Path(settings.init).name


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write rows of results to a Parquet file with typed columns, for pandas and polars.

    **Arguments:**

    - `path`: the file to create or to replace.
    - `rows`: rows with the columns `RESULT_COLUMNS`. All values in these rows are text. In the file, the
      column `curve` contains lists of shares.

    **Raises:** `InputError` if the file cannot be written.
    """
    import pyarrow
    import pyarrow.parquet

    table = pyarrow.Table.from_pylist(
        [{name: RESULT_COLUMNS[name](text) for name, text in row.items()} for row in rows]
    )
    with atomic_write(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)
