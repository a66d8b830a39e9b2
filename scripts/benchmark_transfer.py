"""Measures registered meshes of remeshed bodies.

    python scripts/benchmark_transfer.py DATA_DIRECTORY faust_r tosca_r smal_r --output docs/results/transfer

Pairs are drawn with seed 0. Each result is stored in `OUTPUT/DATA_SET.csv` when it is measured. After an
interruption, the same command continues from the stored results.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from common import draw_scans, make_parser, measure_pairs

from jaxsmw import geodesic_error, match, read_ground_truth, read_mesh
from jaxsmw.benchmark.journal import Journal
from jaxsmw.runtime.provenance import made_with


def main() -> None:
    """Measure the data sets that the command line names, and print a summary of each."""
    parser = make_parser(__doc__, data="DATA_DIRECTORY", output="transfer", pairs=20)
    parser.add_argument("sets", nargs="+", metavar="DATA_SET")
    options = parser.parse_args()
    for name in options.sets:
        pairs = draw_scans(options.data / name, options.pairs)
        journal = measure_pairs(
            options.output / f"{name}.csv",
            pairs,
            lambda pair: (pair[0].stem, pair[1].stem),
            _measure,
        )
        print(f"{name}: {_summary(journal)}\n{made_with()}", flush=True)


def _measure(files: tuple[Path, Path]) -> dict[str, Any]:
    """Measure the errors of the map and of the registered mesh for a pair with ground truth."""
    mesh_x, mesh_y = map(read_mesh, files)
    truth_files = [files[0].parents[1] / "corres" / f"{file.stem}.vts" for file in files]
    truth = read_ground_truth(truth_files, mesh_x, mesh_y)
    start = time.perf_counter()
    correspondence = match(mesh_x, mesh_y)
    matched = time.perf_counter()
    registered = correspondence.registered_mesh()
    seconds = {"match_seconds": matched - start, "transfer_seconds": time.perf_counter() - matched}
    points = correspondence.surface_points()
    return {
        "error_of_points": 1e3 * geodesic_error(mesh_y, points, truth).mean,
        "error_of_registered": 1e3 * geodesic_error(mesh_y, registered.surface_points, truth).mean,
        "share_within": float((registered.distances < 0.005 * np.sqrt(mesh_y.area)).mean()),
        "flipped": float(registered.flipped_faces.mean()),
        **seconds,
    }


def _summary(journal: Journal) -> str:
    """Return the mean of each column, with a 95 % bootstrap interval over the pairs."""
    generator = np.random.default_rng(0)
    texts = []
    for column in journal.rows[0]:
        if column not in ("source", "target"):
            values = np.array([float(row[column]) for row in journal.rows])
            means = values[generator.integers(len(values), size=(1000, len(values)))].mean(axis=1)
            low, high = np.quantile(means, [0.025, 0.975])
            texts.append(f"{column} {values.mean():.4g} ({low:.4g} to {high:.4g})")
    return f"{len(journal.rows)} pairs, " + ", ".join(texts)


if __name__ == "__main__":
    main()
