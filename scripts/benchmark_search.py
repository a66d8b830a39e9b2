"""Measures the search for the right map: how often its map is right, and how reliable its probabilities are.

    python scripts/benchmark_search.py DATA_DIRECTORY [--pairs N] [--seed SEED] [--output DIR] [--hypotheses]

`DATA_DIRECTORY` contains the data sets of `docs/datasets.md`. The script draws N pairs of each kind of
`scripts/judged_pairs.py`, and matches them by `jaxsmw.match` with its defaults. It writes `pairs.csv`, which
a later run continues, the tables `search.md`, and the reliability curve `search.png`.

- A map is right if its mean geodesic error is below 0.1 and less than 5 % of its errors exceed 0.25, in units
  of the square root of the area. It is silent if its probability is at least one half.
- *right among four*: the map or one of the first three alternatives is right.
- The reliability curve groups the maps by probability. The bars are 95 % intervals of the share of right maps
  (Wilson 1927).

With `--hypotheses`, the script compares the kinds of hypothesis instead. Each kind runs in a race of its own.
The script writes `hypotheses.csv`, and the table `hypotheses.md`: for each kind of hypothesis, the number of
pairs for which the race finds a right map, and the number of those for which no other kind does.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import make_parser, measure_pairs, write_text
from judged_pairs import (
    Judged,
    KnownPair,
    count_table,
    is_right,
    known_pairs,
    prepared,
    reliability,
    reliability_table,
)

from jaxsmw import match
from jaxsmw.benchmark.tables import markdown
from jaxsmw.matching.executor import run
from jaxsmw.matching.search.hypotheses import HYPOTHESES
from jaxsmw.matching.search.race import race
from jaxsmw.matching.search.search import read_pair, readings_of
from jaxsmw.report.figures import new_figure, save_figure, style_axes
from jaxsmw.runtime.provenance import made_with

# The number of alternatives among which the right map should be.
ALTERNATIVES = 3


def read(row: Mapping[str, Any]) -> Judged:
    """Return the result that a row of `pairs.csv` states."""
    kind, _ = row["source"].split(": ", 1)
    error, probability, seconds = (float(row[name]) for name in ("error", "probability", "seconds"))
    return Judged(kind, error, bool(int(row["right"])), bool(int(row["among"])), probability, seconds)


def judged(known: KnownPair) -> dict[str, Any]:
    """Match a pair with the defaults, and compare the map and its alternatives with the truth."""
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = match(known.x, known.y, partial=known.partial)
    seconds = time.process_time() - start
    others = [one.pointwise_map for one in found.alternatives[:ALTERNATIVES]]
    errors = [known.errors(one) for one in (found.pointwise_map, *others)]
    right = [is_right(*of_map) for of_map in errors]
    return {
        "error": f"{errors[0][0]:.5f}",
        "gross": f"{errors[0][1]:.5f}",
        "right": int(right[0]),
        "among": int(any(right)),
        "probability": f"{found.probability:.5f}",
        "seconds": f"{seconds:.2f}",
    }


def found_by_kinds(known: KnownPair) -> dict[str, Any]:
    """Return whether the first map, and the race of each kind of hypothesis, are right."""
    with prepared(known) as (shapes, start, preset):
        outcome = run(preset.before_final, shapes.spectra, start)
        reading, both_hands = read_pair(shapes, outcome.pointwise_map, mirrors=True)
        readings = readings_of(reading, both_hands=both_hands)
        row: dict[str, Any] = {FIRST: int(is_right(*known.errors(outcome.pointwise_map)))}
        for kind in HYPOTHESES:
            maps = [one.reading.extended(one.matches) for one in race(readings, [], [kind])]
            row[kind.__name__] = int(any(is_right(*known.errors(one)) for one in maps))
    return row


# The column of the map of the first start.
FIRST = "first map"


def hypothesis_table(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return, for each kind of shape and of hypothesis, how many pairs have a right map, and only by this."""
    kinds = [row["source"].split(": ", 1)[0] for row in rows]
    found = {name: np.array([bool(int(row[name])) for row in rows]) for name in rows[0] if name in NAMES}
    table = [["", "pairs", *found, "any"]]
    for kind in (*dict.fromkeys(kinds), "all"):
        own = np.array([kind in (of_row, "all") for of_row in kinds])
        by_name = [own & right for right in found.values()]
        table.append(
            [kind, str(own.sum()), *(str(right.sum()) for right in (*by_name, np.any(by_name, axis=0)))]
        )
    number = np.sum(list(found.values()), axis=0)
    table.append(["only this", "", *(str(np.sum(right & (number == 1))) for right in found.values()), ""])
    return table


# The columns of `hypotheses.csv` that tell which maps are right.
NAMES = (FIRST, *(kind.__name__ for kind in HYPOTHESES))


def tables(results: Sequence[Judged]) -> str:
    """Return the results of each kind, and the reliability of the probabilities."""
    rows = count_table(results, "right among four")
    rows[0] += ["mean error x10^-3", "CPU seconds"]
    for row in rows[1:]:
        own = [result for result in results if row[0] in (result.kind, "all")]
        error = 1e3 * np.mean([result.error for result in own if np.isfinite(result.error)])
        row += [f"{error:.1f}", f"{np.median([result.seconds for result in own]):.1f}"]
    groups = markdown(reliability_table(results))
    parts = "# Search", markdown(rows), "Reliability of the probabilities:", groups, made_with()
    return "\n\n".join(parts) + "\n"


def draw(results: Sequence[Judged], file: Path) -> None:
    """Draw the reliability curve."""
    figure = new_figure(5.0, 4.2, plot=True)
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for _, number, stated, share, least, most in reliability(results):
        axes.errorbar(stated, share, [[share - least], [most - share]], color="C0", marker="o", capsize=3)
        axes.annotate(
            str(number),
            (stated, least),
            xytext=(0, -5),
            textcoords="offset points",
            fontsize=8,
            ha="center",
            va="top",
        )
    axes.set(xlabel="probability that the map is right", ylabel="share of right maps", ylim=(-0.02, 1.04))
    style_axes(axes)
    save_figure(file, figure)


def main() -> None:
    parser = make_parser(__doc__, data="DATA_DIRECTORY", pairs=8, output="search", seed=True)
    parser.add_argument("--hypotheses", action="store_true", help="compare the kinds of hypothesis")
    options = parser.parse_args()
    pairs = known_pairs(options.data, options.pairs, options.seed)
    if options.hypotheses:
        file = options.output / "hypotheses.csv"
        rows = measure_pairs(file, pairs, lambda known: known.names, found_by_kinds).rows
        text = f"{markdown(hypothesis_table(rows))}\n\n{made_with()}\n"
        print(text)
        write_text(options.output / "hypotheses.md", text)
        return
    journal = measure_pairs(options.output / "pairs.csv", pairs, lambda known: known.names, judged)
    results = [read(row) for row in journal.rows]
    text = tables(results)
    print(text)
    write_text(options.output / "search.md", text)
    draw(results, options.output / "search.png")


if __name__ == "__main__":
    main()
