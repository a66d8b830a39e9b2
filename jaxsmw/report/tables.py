"""The results of a benchmark in publishable form: tables, curves, and a columnar file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxsmw.evaluation.benchmark import Results
from jaxsmw.evaluation.datasets import DataSet
from jaxsmw.evaluation.intervals import CONFIDENCE, Interval, mean_interval
from jaxsmw.evaluation.journal import Row
from jaxsmw.evaluation.measurement import CURVE, RESULT_COLUMNS, Settings
from jaxsmw.evaluation.opponents.base import Method
from jaxsmw.report.figures import draw_quality_curves, save_figure
from jaxsmw.runtime.files import atomic_write

REFERENCE = "mwp"
"""The method that the differences of all other methods refer to."""


class MethodSummary(NamedTuple):
    """The figures of one method over all pairs on which the method did not fail.

    **Attributes:**

    - `mean`, `median`: the mean and the median of the pairs' mean errors, x 10^-3 of the square root of the
      target's area.
    - `difference`: the mean difference of the pairs' mean errors from those of `REFERENCE`, x 10^-3; NaN for
      `REFERENCE` itself.
    - `within`: the mean share of points with an error of at most 0.05.
    - `area_under_curve`: the mean area under the correspondence quality curve.
    - `coverage`: the mean coverage of the target.
    - `seconds`: the median time from the initial map to the result; NaN for published maps.
    - `pipeline_seconds`: the median time including the precomputation of both shapes.
    - `failures`: the number of pairs on which the method failed.
    - `curve`: the mean correspondence quality curve at the thresholds `CURVE` (t,).
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
    """Summarises the results of `jaxsmw.evaluation.benchmark.run_benchmark`, by method.

    **Arguments:**

    - `results`: the results.
    - `seed`: the seed of the bootstrap intervals.
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
    """Returns the mean errors of successful rows by pair, x 10^-3."""
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
    """Returns the seconds of precomputation of both shapes of a pair."""
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
    """Returns a Markdown table with one row for each method."""
    header = ["method", *(title for title, _ in _COLUMNS)]
    rows = [[name, *(text(summary) for _, text in _COLUMNS)] for name, summary in summaries.items()]
    return markdown([header, *rows])


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table of text cells; the first row is the header."""
    return "".join(
        "| " + " | ".join(cells) + " |\n" for cells in (rows[0], ["---"] * len(rows[0]), *rows[1:])
    )


_LATEX = str.maketrans({"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "−": "$-$", "—": "---"})


def latex_table(summaries: Mapping[str, MethodSummary]) -> str:
    """Returns the same table for LaTeX with booktabs rules, and the smallest mean error in bold."""
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
    """Writes `summary.md`, `table.tex`, `curves.png` and `results.parquet`; returns the summaries."""
    summaries = summarize_methods(results, seed=settings.seed)
    parts = [
        f"# {data_set.name}",
        _introduction(data_set, results, settings),
        markdown_table(summaries),
        "\n".join(f"- **{name}**: {methods[name].reference}" for name in summaries),
        "Single pairs: `results.csv`, `results.parquet`; shapes: `shapes.csv`; origin: `provenance.json`.",
    ]
    _write(directory / "summary.md", "\n\n".join(parts) + "\n")
    _write(directory / "table.tex", latex_table(summaries))
    curves = {name: (CURVE, summary.curve) for name, summary in summaries.items()}
    means = {name: summary.mean / 1e3 for name, summary in summaries.items()}
    save_figure(directory / "curves.png", draw_quality_curves(curves, mean_errors=means))
    write_parquet(directory / "results.parquet", results.rows)
    return summaries


def _introduction(data_set: DataSet, results: Results, settings: Settings) -> str:
    """Returns the paragraph above the table of `summary.md`."""
    pairs = len({(row["source"], row["target"]) for row in results.rows})
    points = "all points" if settings.evaluated_points is None else f"{settings.evaluated_points} points"
    machines = "; ".join(sorted({row["machine"] for row in results.rows}))
    sentences = [
        f"{pairs} of {len(data_set.pairs)} pairs ({data_set.layout}); all methods start from the same "
        f"initial map ({Path(settings.init).name}).",
        "Errors are mean geodesic errors x 10⁻³ of the square root of the target's area, at "
        f"{points} of the ground truth.",
        "Mean and median are over the pairs on which a method did not fail; the difference is taken pair by "
        f"pair and has a {CONFIDENCE:.0%} bootstrap interval.",
        f"Times are medians over the pairs, without compilation, on {machines}; local workers have one "
        "core each.",
    ]
    if results.failures:
        sentences.append(f"{len(results.failures)} shapes or pairs could not be measured.")
    return " ".join(sentences)


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Writes all rows with their types, for pandas and polars; `curve` is a list of shares."""
    import pyarrow
    import pyarrow.parquet

    table = pyarrow.Table.from_pylist(
        [{name: RESULT_COLUMNS[name](text) for name, text in row.items()} for row in rows]
    )
    with atomic_write(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)
