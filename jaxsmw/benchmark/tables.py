"""Writes the results of a benchmark as tables, quality curves and a Parquet file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
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

    - `mean`, `median`: the mean and the median over all pairs of the mean geodesic error, in thousandths of
      the square root of the target's area.
    - `difference`: the mean over the pairs of the error minus the error of the method `REFERENCE`, with its
      confidence interval; NaN for `REFERENCE` itself.
    - `within`, `area_under_curve`, `coverage`: the means over all pairs of the share of points with an error
      of at most 0.05, of the area under the correspondence quality curve, and of the coverage.
    - `overlap`: the mean over all pairs and both shapes of the intersection over union of the predicted and
      the true overlap; NaN for methods that predict no overlap, and for data sets without pairs of parts.
    - `seconds`: the median time in seconds from the initial map to the result; NaN for published maps.
    - `pipeline_seconds`: the same with the precomputation of both shapes.
    - `pairs`: the number of pairs for which the method has a result, and the number of all pairs.
    - `failures`: the number of pairs on which the method failed.
    - `curve`: the mean correspondence quality curve (t,) at the thresholds `CURVE`.
    """

    mean: float
    median: float
    difference: Interval
    within: float
    area_under_curve: float
    coverage: float
    overlap: float
    seconds: float
    pipeline_seconds: float
    pairs: tuple[int, int]
    failures: int
    curve: Float64[np.ndarray, " t"]


def summarize_methods(
    results: Results, *, seed: int = 0, reference: str = REFERENCE
) -> dict[str, MethodSummary]:
    """Summarise the results of a benchmark by the names of the methods; `seed` is that of the bootstrap.

    Means and medians are NaN if the method failed on all pairs.
    """
    summaries = {}
    by_method: dict[str, list[Row]] = {}
    for row in results.rows:
        by_method.setdefault(row["method"], []).append(row)
    of_reference = pair_errors(by_method.get(reference, ()))
    every_pair = {(row["source"], row["target"]) for row in results.rows}
    for name, own in by_method.items():
        good = [row for row in own if row["result"] == "successful"]
        errors = pair_errors(good)
        compared = errors.keys() & of_reference.keys() if name != reference else ()
        differences = np.array([errors[pair] - of_reference[pair] for pair in errors if pair in compared])
        means = np.array(list(errors.values()))
        precomputing = np.array([_precomputing(row, results.shapes) for row in good])
        seconds = _column(good, "seconds")
        curves = [row["curve"].split() for row in good if "curve" in row]
        summaries[name] = MethodSummary(
            mean=_mean(means),
            median=_median(means),
            difference=mean_interval(differences, seed),
            within=_mean(_column(good, "within_0.05")),
            area_under_curve=_mean(_column(good, "area_under_curve")),
            coverage=_mean(_column(good, "coverage")),
            overlap=_mean((_column(good, "overlap_source") + _column(good, "overlap_target")) / 2),
            seconds=_median(seconds),
            pipeline_seconds=_median(seconds + precomputing),
            pairs=(len(own), len(every_pair)),
            failures=len(own) - len(good),
            curve=np.mean(np.array(curves, float), axis=0) if curves else np.full(len(CURVE), np.nan),
        )
    return summaries


def pair_errors(rows: Iterable[Row]) -> dict[tuple[str, str], float]:
    """Return the error of each pair (source, target) on which a method did not fail, in thousandths."""
    return {
        (row["source"], row["target"]): 1e3 * float(row["mean"])
        for row in rows
        if row["result"] == "successful"
    }


def _column(rows: Sequence[Row], name: str) -> Float64[np.ndarray, " r"]:
    return np.array([float(row.get(name, "nan")) for row in rows])


def _mean(values: Float64[np.ndarray, " r"]) -> float:
    return float(values.mean()) if len(values) else np.nan


def _median(values: Float64[np.ndarray, " r"]) -> float:
    return float(np.median(values)) if len(values) else np.nan


def _precomputing(row: Row, shapes: Mapping[str, Row]) -> float:
    """Return the precomputation time of both shapes of a pair, in seconds; NaN if it was not measured."""
    columns, sides = ("seconds_spectrum", "seconds_descriptors"), {row["source"], row["target"]}
    return sum(
        float(shapes[side][column]) if side in shapes else np.nan for side in sides for column in columns
    )


def _text(form: str, value: float) -> str:
    return "—" if np.isnan(value) else form.format(value)


_Columns = tuple[tuple[str, Callable[[MethodSummary], str]], ...]
_MINUS = "minus"
_COLUMNS: _Columns = (
    ("mean error", lambda s: _text("{:.1f}", s.mean)),
    ("median", lambda s: _text("{:.1f}", s.median)),
    (_MINUS, lambda s: str(s.difference)),
    ("within 0.05", lambda s: _text("{:.1%}", s.within)),
    ("area under curve", lambda s: _text("{:.3f}", s.area_under_curve)),
    ("coverage", lambda s: _text("{:.1%}", s.coverage)),
    ("overlap IoU", lambda s: _text("{:.1%}", s.overlap)),
    ("refinement, s", lambda s: _text("{:.2f}", s.seconds)),
    ("with precomputation, s", lambda s: _text("{:.2f}", s.pipeline_seconds)),
    ("pairs", lambda s: str(s.pairs[0]) if s.pairs[0] == s.pairs[1] else "{} of {}".format(*s.pairs)),
    ("failed", lambda s: str(s.failures)),
)


def _table(summaries: Mapping[str, MethodSummary], reference: str) -> list[list[str]]:
    """Return the cells of a table with its header, without columns of numbers that no method has."""
    columns = {title: [text(s) for s in summaries.values()] for title, text in _COLUMNS}
    kept = {
        f"{title} {reference}" if title == _MINUS else title: cells
        for title, cells in columns.items()
        if title == _MINUS or set(cells) != {"—"}
    }
    rows = zip(summaries, *kept.values(), strict=True)
    return [["method", *kept], *map(list, rows)]


def markdown_table(summaries: Mapping[str, MethodSummary], reference: str = REFERENCE) -> str:
    """Return a Markdown table with one row for each method in `summaries`."""
    return markdown(_table(summaries, reference))


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table of text cells; the first row is the header."""
    return "".join(
        "| " + " | ".join(cells) + " |\n" for cells in (rows[0], ["---"] * len(rows[0]), *rows[1:])
    )


_LATEX = str.maketrans({"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "−": "$-$", "—": "---"})


def latex_table(summaries: Mapping[str, MethodSummary]) -> str:
    """Return a LaTeX table (with booktabs) with one row for each method. The smallest mean error is bold."""
    best = min((s.mean for s in summaries.values() if np.isfinite(s.mean)), default=np.nan)
    header, *rows = _table(summaries, REFERENCE)
    lines = [r"\begin{tabular}{l" + "r" * (len(header) - 1) + "}", r"\toprule"]
    lines += [" & ".join(header) + r" \\", r"\midrule"]
    for row, summary in zip(rows, summaries.values(), strict=True):
        cells = [cell.translate(_LATEX) for cell in row]
        if summary.mean == best:
            cells[1] = rf"\textbf{{{cells[1]}}}"
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def write_tables(
    directory: Path, data_set: DataSet, results: Results, settings: Settings, methods: Mapping[str, Method]
) -> dict[str, MethodSummary]:
    """Write `summary.md`, `table.tex`, `curves.png` and `results.parquet`, and return the summaries.

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
    for name, text in (("summary.md", "\n\n".join(parts) + "\n"), ("table.tex", latex_table(summaries))):
        with atomic_write(directory / name) as temporary:
            temporary.write_text(text, "utf-8")
    curves = {name: (CURVE, summary.curve) for name, summary in summaries.items()}
    means = {name: summary.mean / 1e3 for name, summary in summaries.items()}
    save_figure(directory / "curves.png", draw_quality_curves(curves, mean_errors=means))
    write_parquet(directory / "results.parquet", results.rows)
    return summaries


def share_of_pairs(data_set: DataSet, pairs: Collection[tuple[str, str]]) -> str:
    """Return how many pairs of a data set were chosen, such as `2 of 6 pairs`."""
    # A user's list of pairs can contain pairs that the data set does not list.
    listed = {pair.names for pair in data_set.pairs}
    return f"{len(pairs)} of {len(listed)} pairs" if listed.issuperset(pairs) else f"{len(pairs)} given pairs"


def _introduction(data_set: DataSet, results: Results, settings: Settings) -> str:
    """Return the paragraph above the table of `summary.md`."""
    pairs = {(row["source"], row["target"]) for row in results.rows}
    share = share_of_pairs(data_set, pairs)
    points = "all points" if settings.evaluated_points is None else f"{settings.evaluated_points} points"
    machines = "; ".join(sorted({row["machine"] for row in results.rows}))
    initial = DEFAULT_INITIAL_MAP if settings.init == DEFAULT_MATCH_INIT else Path(settings.init).name
    sentences = [
        f"{share} of the data set ({data_set.layout}) were measured. All methods start "
        f"from the same initial map ({initial}).",
        "Errors are mean geodesic errors in thousandths of the square root of the target's area, at "
        f"{points} of the ground truth.",
        "The mean and the median are computed over the pairs on which a method did not fail. The column "
        f"'minus {REFERENCE}' contains the mean over the pairs of the error minus the error of {REFERENCE}, "
        f"with a {CONFIDENCE:.0%} bootstrap interval.",
        f"Times are medians over the pairs, without compilation, on {machines}. Each local worker process "
        "uses one core.",
    ]
    if any(pair.both_partial for pair in data_set.pairs):
        sentences.append(
            "Both shapes of a pair are parts, and errors are measured in their true overlap. The column "
            "'overlap IoU' contains the intersection over union of the predicted and the true overlap."
        )
    if results.failures:
        sentences.append(f"{len(results.failures)} shapes or pairs could not be measured.")
    return " ".join(sentences)


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write rows of results to a Parquet file with typed columns, for pandas and polars."""
    import pyarrow
    import pyarrow.parquet

    table = pyarrow.Table.from_pylist(
        [{name: RESULT_COLUMNS[name](text) for name, text in row.items()} for row in rows]
    )
    with atomic_write(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)
