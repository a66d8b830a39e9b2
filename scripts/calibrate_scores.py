"""Compares expected errors and scores, which need no ground truth, with true errors.

    python scripts/calibrate_scores.py DATA_SET_DIRECTORY ... [--pairs N | FILE] [--seed SEED]
        [--preset NAME ...] [--output FILE.md]

The script draws pairs at random from each data set (see `docs/datasets.md`), matches them with each preset,
and prints three tables:

- The first table compares `Correspondence.expected_error` with the true errors. The table states the rank
  correlation of expected and true errors, and the share of gross errors. A gross error exceeds 0.1 times the
  square root of the area. For each pair, the script selects the 10 % of the vertices with the largest
  expected errors. The last column states which share of all gross errors lies at the selected vertices.
- For the second table, the script sorts the vertices of all pairs by expected error, and divides them into
  ten groups of equal size. The table states the true errors of each group.
- The third table compares `Correspondence.wrong_probability` with the share of wrong maps. A map is wrong if
  at least 2 % of its errors exceed 0.25 times the square root of the area. `scripts/learn_judge.py` fits the
  numbers on which the probability depends.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import make_parser, write_text
from jaxtyping import Float64
from judged_pairs import grouped
from scipy.stats import spearmanr
from tqdm import tqdm

from jaxsmw import geodesic_error, match, read_mesh
from jaxsmw.benchmark.datasets import DataPair, choose_pairs, open_data_set
from jaxsmw.benchmark.tables import markdown
from jaxsmw.matching.stages import PRESETS, PresetName
from jaxsmw.runtime.provenance import made_with

GROSS, TENTH = 0.1, 0.1
# A map is wrong if its share of errors above WRONG_ERROR is at least WRONG_SHARE.
WRONG_SHARE, WRONG_ERROR = 0.02, 0.25
# The third table groups the maps by predicted probability. These numbers are the limits of the groups.
PROBABILITIES = (0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 1)


class Measured(NamedTuple):
    """The errors of the evaluated vertices of one pair (p,), and the predicted probability of a wrong map."""

    true: Float64[np.ndarray, " p"]
    expected: Float64[np.ndarray, " p"]
    probability: float

    @property
    def wrong(self) -> bool:
        """Whether the map is wrong."""
        return bool(np.mean(self.true > WRONG_ERROR) >= WRONG_SHARE)


def measure(
    pair: DataPair, seed: int, preset: PresetName = "accurate", number_of_samples: int | None = 1000
) -> Measured:
    """Match a pair, and measure the errors of the result."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    result = match(mesh_x, mesh_y, preset=preset, partial=pair.partial)
    truth = pair.ground_truth(mesh_x, mesh_y)
    error = geodesic_error(
        mesh_y, result.pointwise_map, truth, number_of_samples=number_of_samples, seed=seed
    )
    finite = np.isfinite(error.errors)
    expected = result.expected_error()[error.source_vertices]
    return Measured(error.errors[finite], expected[finite], result.wrong_probability())


def calibration(maps: Sequence[Measured]) -> str:
    """Return a table that compares predicted probabilities with the shares of wrong maps."""
    rows = [["probability", "maps", "mean probability", "wrong"]]
    for group in grouped([m.probability for m in maps], [m.wrong for m in maps], PROBABILITIES):
        figures = f"{group.probability:.1%}", f"{group.share:.1%}"
        rows.append([group.limits, str(group.number), *figures])
    return markdown(rows)


def tables(measured: dict[str, list[Measured]]) -> Iterator[str]:
    """Yield the three tables as Markdown."""
    rows = [
        ["", "pairs", "mean error", "mean expected", "rank correlation", "gross errors", "in the worst tenth"]
    ]
    for name, pairs in measured.items():
        gross = [pair.true > GROSS for pair in pairs]
        held = [
            np.sum(wrong[np.argsort(-pair.expected)[: max(1, round(TENTH * len(wrong)))]])
            for pair, wrong in zip(pairs, gross, strict=True)
        ]
        total = sum(wrong.sum() for wrong in gross)
        rows.append(
            [
                name,
                str(len(pairs)),
                f"{1e3 * np.mean([pair.true.mean() for pair in pairs]):.1f}",
                f"{1e3 * np.mean([pair.expected.mean() for pair in pairs]):.1f}",
                f"{np.median([spearmanr(pair.expected, pair.true).statistic for pair in pairs]):.2f}",
                f"{np.mean(np.concatenate(gross)):.2%}",
                f"{sum(held) / total:.0%}" if total else "—",
            ]
        )
    yield (
        "Errors x 10⁻³ √area. The last column is the share of all gross errors that belong to the 10 % of "
        "each pair's vertices with the largest expected errors.\n\n" + markdown(rows)
    )

    everything = [pair for pairs in measured.values() for pair in pairs]
    true, expected = (
        np.concatenate([getattr(pair, name) for pair in everything]) for name in ("true", "expected")
    )
    ends = np.quantile(expected, np.linspace(0, 1, 11))
    rows = [["expected, x 10⁻³", "mean error", "median", "gross"]]
    for low, high in pairwise(ends):
        own = true[(low <= expected) & (expected <= high)]
        figures = own.mean(), np.median(own)
        rows.append([f"{1e3 * low:.1f} to {1e3 * high:.1f}", *(f"{1e3 * figure:.1f}" for figure in figures)])
        rows[-1].append(f"{np.mean(own > GROSS):.1%}")
    yield "Vertices of all pairs, in ten groups of equal size by expected error:\n\n" + markdown(rows)

    yield "Probability that a map is wrong:\n\n" + calibration(everything)


def main() -> None:
    parser = make_parser(__doc__, seed=True)
    parser.add_argument("data_sets", metavar="DATA_SET_DIRECTORY", nargs="+", type=Path)
    parser.add_argument(
        "--pairs",
        metavar="N | FILE",
        default="20",
        help="number of pairs from each data set, or a list of pairs (default: 20)",
    )
    parser.add_argument(
        "--preset",
        nargs="+",
        choices=PRESETS,
        default=["accurate"],
        help="presets that match the pairs (default: accurate)",
    )
    parser.add_argument("--output", metavar="FILE.md", type=Path, help="also write the tables to this file")
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # hides warnings about the quality of each mesh

    drawn: list[tuple[str, DataPair]] = []
    for directory in options.data_sets:
        data_set = open_data_set(directory)
        drawn += [(data_set.name, pair) for pair in choose_pairs(data_set, options.pairs, options.seed)]
    measured: dict[str, list[Measured]] = {}
    for preset, (data_set_name, pair) in tqdm(list(product(options.preset, drawn)), unit="map"):
        name = data_set_name if len(options.preset) == 1 else f"{data_set_name}, {preset}"
        measured.setdefault(name, []).append(measure(pair, options.seed, preset))
    page = "\n".join((*tables(measured), made_with() + "\n"))
    print(page)
    if options.output:
        write_text(options.output, page)


if __name__ == "__main__":
    main()
