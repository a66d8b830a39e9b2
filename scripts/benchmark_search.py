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
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import make_parser, measure_pairs, write_text
from judged_pairs import KnownPair, is_right, known_pairs
from scipy.stats import binomtest

from jaxsmw import match
from jaxsmw.benchmark.tables import markdown
from jaxsmw.report.figures import new_figure, save_figure, style_axes
from jaxsmw.runtime.provenance import made_with

# The ends of the groups of maps by probability.
GROUPS = (0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1)
# The number of alternatives among which the right map should be.
ALTERNATIVES = 3


class Judged(NamedTuple):
    """The result of one pair: whether its map is right, and with which probability."""

    kind: str
    error: float
    right: bool
    among: bool
    probability: float
    seconds: float

    @classmethod
    def read(cls, row: Mapping[str, Any]) -> Judged:
        """Return the result that a row of `pairs.csv` states."""
        kind, _ = row["source"].split(": ", 1)
        error, probability, seconds = (float(row[name]) for name in ("error", "probability", "seconds"))
        return cls(kind, error, bool(int(row["right"])), bool(int(row["among"])), probability, seconds)

    @property
    def silent(self) -> bool:
        """Whether the map looks right."""
        return self.probability >= 0.5


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
    head = ["", "pairs", "right", "right among four", "wrong and silent", "right and flagged"]
    rows = [[*head, "mean error x10^-3", "CPU seconds"]]
    own_of = {kind: [one for one in results if one.kind == kind] for kind in (one.kind for one in results)}
    for kind, own in {**own_of, "all": results}.items():
        counts = (
            len(own),
            sum(one.right for one in own),
            sum(one.among for one in own),
            sum(one.silent and not one.right for one in own),
            sum(one.right and not one.silent for one in own),
        )
        error, seconds = 1e3 * np.mean([one.error for one in own]), np.median([one.seconds for one in own])
        rows.append([kind, *map(str, counts), f"{error:.1f}", f"{seconds:.1f}"])
    groups = [["probability", "maps", "mean probability", "right"]]
    for low, high, own in grouped(results):
        stated, (share, least, most) = reliability(own)
        interval = f"{share:.1%} [{least:.1%}, {most:.1%}]"
        groups.append([f"{low:.0%} to {min(high, 1):.0%}", str(len(own)), f"{stated:.1%}", interval])
    parts = "# Search", markdown(rows), "Reliability of the probabilities:", markdown(groups), made_with()
    return "\n\n".join(parts) + "\n"


def grouped(results: Sequence[Judged]) -> list[tuple[float, float, list[Judged]]]:
    """Return the groups of results with similar probabilities that are not empty, with their limits."""
    limits = [*pairwise(GROUPS[:-1]), (GROUPS[-2], np.inf)]
    groups = [(low, high, [one for one in results if low <= one.probability < high]) for low, high in limits]
    return [group for group in groups if group[2]]


def reliability(own: Sequence[Judged]) -> tuple[float, tuple[float, float, float]]:
    """Return the mean probability of a group, and its share of right maps with a 95 % interval."""
    right = sum(one.right for one in own)
    least, most = binomtest(right, len(own)).proportion_ci(method="wilson")
    return float(np.mean([one.probability for one in own])), (right / len(own), float(least), float(most))


def draw(results: Sequence[Judged], file: Path) -> None:
    """Draw the reliability curve."""
    figure = new_figure(5.0, 4.2, plot=True)
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for _, _, own in grouped(results):
        stated, (share, least, most) = reliability(own)
        axes.errorbar(stated, share, [[share - least], [most - share]], color="C0", marker="o", capsize=3)
        axes.annotate(str(len(own)), (stated, share), xytext=(5, -11), textcoords="offset points", fontsize=8)
    axes.set(xlabel="probability that the map is right", ylabel="share of right maps", ylim=(-0.02, 1.04))
    style_axes(axes)
    save_figure(file, figure)


def main() -> None:
    parser = make_parser(__doc__, pairs=8, output="search")
    parser.add_argument("data", metavar="DATA_DIRECTORY", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="seed of the choice of pairs (default: 0)")
    options = parser.parse_args()
    pairs = known_pairs(options.data, options.pairs, options.seed)
    journal = measure_pairs(options.output / "pairs.csv", pairs, lambda known: known.names, judged)
    results = [Judged.read(row) for row in journal.rows]
    text = tables(results)
    print(text)
    write_text(options.output / "search.md", text)
    draw(results, options.output / "search.png")


if __name__ == "__main__":
    main()
