"""How far scores that need no ground truth can be trusted.

    python scripts/calibrate_scores.py DATA_SET_DIRECTORY ... [--pairs N] [--seed SEED] [--preset NAME]
        [--output FILE.md]

Two tables, over pairs drawn at random from each data set (see `docs/datasets.md`):

- `Correspondence.expected_error` of a preset's outcomes beside the true errors: their rank correlation, and
  how many gross errors (over a tenth of the square root of the area) lie in the tenth of the vertices for
  which it is largest; then what errors vertices have, by what was expected of them.
- for `accurate`, how often each score prefers the map that it ends at to one of the body's mirror image,
  which the same stages, but for mending, make of the mirrored truth. Only for sets that have that, vertex by
  vertex. The uncertainty of the regression is that of one begun from the map.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxsmw.repair.faults import flaw, stretch
from jaxtyping import Float64
from scipy.stats import spearmanr
from tqdm import tqdm

from jaxsmw import InputError, geodesic_error, match, read_mesh
from jaxsmw.evaluation.benchmark import choose_pairs
from jaxsmw.evaluation.datasets import DataPair, DataSet, open_data_set
from jaxsmw.matching import Correspondence
from jaxsmw.presets import PRESETS, Preset
from jaxsmw.report.tables import markdown
from jaxsmw.runtime.files import atomic_write
from jaxsmw.runtime.provenance import made_with

GROSS, TENTH = 0.1, 0.1
# What the preset does after its first stage, without looking for mirrored limbs.
AS_IT_STARTS = tuple(replace(stage, mending=None) for stage in PRESETS["accurate"][1:])


class Measured(NamedTuple):
    """One pair: true and expected errors of some vertices; for each score, direct and mirrored."""

    true: Float64[np.ndarray, " p"]
    expected: Float64[np.ndarray, " p"]
    scores: dict[str, tuple[float, float]]


def measure(
    pair: DataPair, seed: int, preset: Preset = "accurate", number_of_samples: int | None = 1000
) -> Measured:
    """Match a pair and look at its outcome with and without the truth."""
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
        turned = match(mesh_x, mesh_y, init=mirrored.everywhere(mesh_x), preset=AS_IT_STARTS)
        direct, other = (looks(result) for result in (found, turned))
        scores = {name: (direct[name], other[name]) for name in direct}
    expected = found.expected_error()[error.source_vertices]
    return Measured(error.errors[known], expected[known], scores)


def looks(found: Correspondence) -> dict[str, float]:
    """Scores of a map, the smaller the better."""
    meshes, pointwise_map = (found.mesh_x, found.mesh_y), found.pointwise_map
    regression = match(*meshes, init=pointwise_map, preset=AS_IT_STARTS[0]).refinement.state
    return {
        "stretch": stretch(*meshes, pointwise_map, found.spectrum_x),
        "uncertainty of the regression": float(regression.uncertainty),
        "flaw": flaw(*meshes, pointwise_map, found.spectrum_x),
    }


def tables(measured: dict[str, list[Measured]]) -> Iterator[str]:
    """The page, in parts."""
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
    yield "Errors x 10⁻³; the worst tenth is that of each pair.\n\n" + markdown(rows)

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
    yield "All vertices, in tenths by the error expected:\n\n" + markdown(rows)

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
    parser.add_argument("--pairs", metavar="N", default="20", help="of each set (default: 20)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (default: 0)")
    parser.add_argument("--preset", choices=PRESETS, default="accurate", help="(default: accurate)")
    parser.add_argument("--output", metavar="FILE.md", type=Path, help="gets the tables as well")
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # about meshes, of which each would tell

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
