"""Measures the search for the right map: how often its map is right, and how reliable its probabilities are.

    python scripts/benchmark_search.py DATA_DIRECTORY [--pairs N] [--seed SEED] [--output DIR]

`DATA_DIRECTORY` contains the data sets of `docs/datasets.md`. The script draws N pairs of each kind of
`scripts/judged_pairs.py`, and matches them by `jaxsmw.match` with its defaults. It writes `pairs.csv`, which
a later run continues, the tables `search.md`, and the reliability curve `search.png`.

- A map is right if its mean geodesic error is below 0.1 and less than 5 % of its errors exceed 0.25, in units
  of the square root of the area. It is silent if its probability is at least one half.
- *right among four*: the map or one of the first three alternatives is right.
- The reliability curve groups the maps by probability. The bars are 95 % intervals of the share of right maps
  (Wilson 1927).
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
    reliability,
    reliability_table,
)

from jaxsmw import match
from jaxsmw.benchmark.tables import markdown
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


def tables(results: Sequence[Judged]) -> str:
    """Return the results of each kind, and the reliability of the probabilities."""
    rows = count_table(results, "right among four")
    rows[0] += ["mean error x10^-3", "CPU seconds"]
    for row in rows[1:]:
        own = [result for result in results if row[0] in (result.kind, "all")]
        error = 1e3 * np.mean([result.error for result in own])
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
        axes.annotate(str(number), (stated, share), xytext=(5, -11), textcoords="offset points", fontsize=8)
    axes.set(xlabel="probability that the map is right", ylabel="share of right maps", ylim=(-0.02, 1.04))
    style_axes(axes)
    save_figure(file, figure)


def main() -> None:
    parser = make_parser(__doc__, data="DATA_DIRECTORY", pairs=8, output="search", seed=True)
    options = parser.parse_args()
    pairs = known_pairs(options.data, options.pairs, options.seed)
    journal = measure_pairs(options.output / "pairs.csv", pairs, lambda known: known.names, judged)
    results = [read(row) for row in journal.rows]
    text = tables(results)
    print(text)
    write_text(options.output / "search.md", text)
    draw(results, options.output / "search.png")


if __name__ == "__main__":
    main()
