"""Compare the maps of `jaxsmw.match` by NumPy with those by JAX, on pairs of every kind.

    python scripts/compare_backends.py --data DATA --pairs 6 --output backends.csv

DATA is a directory with data sets that `jaxsmw benchmark` reads. The same number of pairs is taken from each
set, evenly spread over its pairs. The file gets one row per pair: the share of vertices with equal matches,
the mean geodesic error of both maps at 500 vertices in units of the square root of the area, and the seconds
of both backends. An interrupted run continues where it stopped. The summary lists the means for each set, and
the mean difference of the errors with its 95 % bootstrap interval.
"""

import time
import warnings
from pathlib import Path

import numpy as np
from common import data_sets, make_parser

from jaxsmw import geodesic_error, match, read_mesh
from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.benchmark.intervals import mean_interval
from jaxsmw.benchmark.journal import Journal
from jaxsmw.choices import Backend, PresetName

BACKENDS: tuple[Backend, ...] = ("numpy", "jax")
POINTS = 500


def compared(pair: DataPair, preset: PresetName) -> dict[str, float]:
    """Match a pair with both backends, and return the numbers of its row."""
    meshes = [read_mesh(file) for file in pair.meshes]
    truth, maps = pair.ground_truth(*meshes), []
    errors: dict[str, float] = {}
    seconds: dict[str, float] = {}
    for name in BACKENDS:
        began = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = match(*meshes, preset=preset, partial=pair.partial, backend=name)
        seconds[name] = time.perf_counter() - began
        error = geodesic_error(meshes[1], found.pointwise_map, truth, number_of_samples=POINTS)
        errors[f"error, {name}"] = error.mean
        maps.append(found.pointwise_map)
    return {"equal": float(np.mean(maps[0] == maps[1])), **errors, **seconds}


def main() -> None:
    parser = make_parser(__doc__, pairs=6)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--preset", default="accurate")
    parser.add_argument("--output", type=Path, default=Path("backends.csv"), metavar="FILE")
    options = parser.parse_args()
    journal = Journal(options.output, ("data set", "pair"))
    for data_set in data_sets(options.data):
        pairs = data_set.pairs
        for number in sorted({*np.linspace(0, len(pairs) - 1, options.pairs).astype(int).tolist()}):
            pair = pairs[number]
            if (data_set.name, pair.name) not in journal:
                row = {"data set": data_set.name, "pair": pair.name, **compared(pair, options.preset)}
                journal.append([row])
                print(row, flush=True)
    rows = journal.rows
    for name in [*dict.fromkeys(row["data set"] for row in rows), "all"]:
        of_set = [row for row in rows if name in (row["data set"], "all")]
        equal, by_numpy, by_jax = (
            np.array([float(row[column]) for row in of_set])
            for column in ("equal", "error, numpy", "error, jax")
        )
        mean, low, high = mean_interval(1e3 * (by_numpy - by_jax), seed=0)
        print(
            f"{name}: {len(of_set)} pairs, {equal.mean():.2%} of the matches equal; mean errors x 10^-3: "
            f"NumPy {1e3 * by_numpy.mean():.2f}, JAX {1e3 * by_jax.mean():.2f}, difference {mean:+.2f} "
            f"({low:+.2f} to {high:+.2f})"
        )


if __name__ == "__main__":
    main()
