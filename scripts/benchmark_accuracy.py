"""How accurate the own pipeline is, from mesh files with a SHOT start, on remeshed FAUST and TOSCA.

    python scripts/benchmark_accuracy.py DATA_DIRECTORY [--pairs N] [--samples N] [--output FILE.csv]

DATA_DIRECTORY holds `faust_r` and `tosca_r` (each with `off/`, `corres/` and `test_pairs.txt`). Per pair: the
mean geodesic error of the initial map, and after refinement at the MWP paper's setting and at the setting of
its authors' demo, x 10^-3 of the square root of the target's area.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxsmw import InputError, match, read_mesh
from jaxsmw.evaluation.ground_truth import read_ground_truth
from jaxsmw.evaluation.metrics import geodesic_error
from jaxsmw.report.summary import provenance

DATA_SETS = ("faust_r", "tosca_r")


@dataclass(frozen=True)
class Setting:
    """What a column of the table was computed with."""

    name: str
    number_of_eigenvectors: int
    iterations: int


# The MWP paper's tables, and the demonstration in its authors' program; both with 6 filters.
SETTINGS = (Setting("paper (100, 6, 3)", 100, 3), Setting("demo (128, 6, 5)", 128, 5))


def pairs_of(directory: Path, count: int) -> Iterator[tuple[str, str]]:
    lines = (directory / "test_pairs.txt").read_text().splitlines()
    for line in lines[:count]:
        source, target = line.split()
        yield source, target


def errors_of_pair(directory: Path, source: str, target: str, samples: int | None) -> dict[str, float]:
    """Mean errors x 10^-3 by column."""
    mesh_x, mesh_y = (read_mesh(directory / "off" / f"{name}.off") for name in (source, target))
    truth = read_ground_truth(
        [directory / "corres" / f"{name}.vts" for name in (source, target)], mesh_x, mesh_y
    )
    errors = {}
    for setting in SETTINGS:
        result = match(
            mesh_x,
            mesh_y,
            number_of_eigenvectors=setting.number_of_eigenvectors,
            iterations=setting.iterations,
        )
        for column, pointwise_map in (("initial", result.initial_map), (setting.name, result.pointwise_map)):
            error = geodesic_error(mesh_y, pointwise_map, truth, number_of_samples=samples)
            errors[column] = 1e3 * error.mean
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--pairs", type=int, default=20, help="per data set (default: %(default)s)")
    parser.add_argument("--samples", type=int, help="rows of the ground truth per pair (default: all)")
    parser.add_argument("--output", type=Path, help="write the table as CSV, too")
    options = parser.parse_args()
    print(json.dumps(provenance()))

    rows: list[dict[str, str | float]] = []
    for data_set in DATA_SETS:
        directory = options.data / data_set
        if not (directory / "test_pairs.txt").is_file():
            raise InputError(f"{directory}: has no test_pairs.txt; give the directory that holds {data_set}.")
        print(f"\n| {data_set} | initial | " + " | ".join(setting.name for setting in SETTINGS) + " |")
        print("|---|" + "---|" * (1 + len(SETTINGS)))
        of_set = []
        for source, target in pairs_of(directory, options.pairs):
            errors = errors_of_pair(directory, source, target, options.samples)
            of_set.append(list(errors.values()))
            rows.append({"data set": data_set, "source": source, "target": target, **errors})
            print(
                f"| {source} {target} | " + " | ".join(f"{e:.1f}" for e in errors.values()) + " |", flush=True
            )
        for name, statistic in (("mean", np.mean), ("median", np.median)):
            print(f"| **{name}** | " + " | ".join(f"{e:.1f}" for e in statistic(of_set, axis=0)) + " |")
    if options.output:
        with options.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
