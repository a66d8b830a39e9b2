"""Measures how reliable expected errors and scores are, although they are computed without ground truth.

    python scripts/calibrate_scores.py DATA_SET_DIRECTORY ... [--pairs N] [--seed SEED] [--preset NAME]
        [--output FILE.md]

The script draws pairs at random from each data set (see `docs/datasets.md`) and prints three tables:

- `Correspondence.expected_error` of the results of a preset, compared with the true errors: the rank
  correlation, and the share of gross errors (over a tenth of the square root of the area) among the tenth of
  the vertices with the largest expected errors.
- The true errors of all vertices, in tenths by their expected errors.
- For the preset `accurate`: how often each score prefers the result to a mirrored map. The mirrored map is
  computed from the mirrored ground truth, by the same stages without repair. The table covers only data sets
  with a mirrored ground truth for every vertex. The uncertainty comes from a feature regression that starts
  from the map.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.stats import spearmanr
from tqdm import tqdm

from jaxsmw import InputError, geodesic_error, match, read_mesh
from jaxsmw.evaluation.datasets import DataPair, DataSet, choose_pairs, open_data_set
from jaxsmw.matching import Correspondence
from jaxsmw.presets import PRESETS, PresetName
from jaxsmw.repair.scores import dirichlet_energy_ratio, distortion
from jaxsmw.report.tables import markdown
from jaxsmw.runtime.files import atomic_write
from jaxsmw.runtime.provenance import made_with

GROSS, TENTH = 0.1, 0.1
# The stages of the preset after the first, without repair.
WITHOUT_REPAIR = PRESETS["accurate"].stages[1:]


class Measured(NamedTuple):
    """The measurements of one pair.

    **Attributes:**

    - `true`, `expected`: the true and the expected errors of some vertices (p,).
    - `scores`: each score of the direct and of the mirrored map, by name.
    """

    true: Float64[np.ndarray, " p"]
    expected: Float64[np.ndarray, " p"]
    scores: dict[str, tuple[float, float]]


def measure(
    pair: DataPair, seed: int, preset: PresetName = "accurate", number_of_samples: int | None = 1000
) -> Measured:
    """Matches a pair, and measures the errors and the scores of the result."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    found = match(mesh_x, mesh_y, preset=preset, partial=pair.partial)
    truth = pair.ground_truth(mesh_x, mesh_y)
    error = geodesic_error(mesh_y, found.pointwise_map, truth, number_of_samples=number_of_samples, seed=seed)
    known = np.isfinite(error.errors)
    scores: dict[str, tuple[float, float]] = {}
    mirrored = None
    if preset == "accurate":
        with suppress(InputError):
            mirrored = pair.ground_truth(mesh_x, mesh_y, mirrored=True)
    if mirrored is not None and isinstance(mirrored.targets, np.ndarray) and not pair.partial:
        reflected = match(mesh_x, mesh_y, init=mirrored.everywhere(mesh_x), preset=WITHOUT_REPAIR)
        direct, other = (scores_of(result) for result in (found, reflected))
        scores = {name: (direct[name], other[name]) for name in direct}
    expected = found.expected_error()[error.source_vertices]
    return Measured(error.errors[known], expected[known], scores)


def scores_of(found: Correspondence) -> dict[str, float]:
    """Returns the scores of a map by name; lower is better."""
    known = found.pair, found.pointwise_map, found.spectrum_x
    regression = match(*found.pair.meshes, init=found.pointwise_map, preset=WITHOUT_REPAIR[0])
    uncertainty = regression.refinement.state.uncertainty
    assert uncertainty is not None
    return {
        "Dirichlet energy ratio": dirichlet_energy_ratio(*known),
        "uncertainty of the regression": float(uncertainty),
        "distortion": distortion(*known),
    }


def tables(measured: dict[str, list[Measured]]) -> Iterator[str]:
    """Yields the three tables as Markdown."""
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
    yield "Errors x 10⁻³. The worst tenth is determined for each pair separately.\n\n" + markdown(rows)

    everything = [pair for pairs in measured.values() for pair in pairs]
    true, expected = (
        np.concatenate([getattr(pair, name) for pair in everything]) for name in Measured._fields[:2]
    )
    ends = np.quantile(expected, np.linspace(0, 1, 11))
    rows = [["expected, x 10⁻³", "mean error", "median", "gross"]]
    for low, high in pairwise(ends):
        own = true[(low <= expected) & (expected <= high)]
        figures = own.mean(), np.median(own)
        rows.append([f"{1e3 * low:.1f} to {1e3 * high:.1f}", *(f"{1e3 * figure:.1f}" for figure in figures)])
        rows[-1].append(f"{np.mean(own > GROSS):.1%}")
    yield "All vertices, in tenths by their expected errors:\n\n" + markdown(rows)

    names = list(dict.fromkeys(name for pair in everything for name in pair.scores))
    if names:
        rows = [["prefers the direct map to the mirrored one", *names]]
        for data_set, pairs in measured.items():
            if with_both := [pair.scores for pair in pairs if pair.scores]:
                right = [sum(scores[name][0] < scores[name][1] for scores in with_both) for name in names]
                rows.append([data_set, *(f"{number} of {len(with_both)}" for number in right)])
        yield markdown(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data_sets", metavar="DATA_SET_DIRECTORY", nargs="+", type=Path)
    parser.add_argument("--pairs", metavar="N", default="20", help="pairs from each data set (default: 20)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draws (default: 0)")
    parser.add_argument(
        "--preset", choices=PRESETS, default="accurate", help="preset of the matches (default: accurate)"
    )
    parser.add_argument(
        "--output", metavar="FILE.md", type=Path, help="file to which the tables are written, too"
    )
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # about the quality of each mesh

    chosen: list[tuple[DataSet, DataPair]] = []
    for directory in options.data_sets:
        data_set = open_data_set(directory)
        chosen += [(data_set, pair) for pair in choose_pairs(data_set, options.pairs, options.seed)]
    measured: dict[str, list[Measured]] = {}
    for data_set, pair in tqdm(chosen, unit="pair"):
        measured.setdefault(data_set.name, []).append(measure(pair, options.seed, options.preset))
    page = "\n".join((*tables(measured), made_with() + "\n"))
    print(page)
    if options.output:
        with atomic_write(options.output) as temporary:
            temporary.write_text(page, "utf-8")


if __name__ == "__main__":
    main()
