"""Compare the maps of `jaxsmw.match` by NumPy with those by JAX, on pairs of every kind.

    python scripts/compare_backends.py --data DATA --pairs 6 --output backends.csv

DATA is a directory with data sets that `jaxsmw benchmark` reads. The same number of pairs is taken from each
set, evenly spread over its pairs. The file gets one row per pair: the share of vertices with equal matches,
the mean geodesic error of both maps at 500 vertices in units of the square root of the area, and the seconds
of both backends. An interrupted run continues where it stopped. The summary lists the means for each set, and
the mean difference of the errors with a 95 % confidence interval from 10 000 bootstrap samples of the pairs.
"""

import csv
import time
import warnings
from pathlib import Path

import numpy as np
from common import make_parser

from jaxsmw import geodesic_error, match, read_mesh
from jaxsmw.benchmark.datasets import DataPair, open_data_set
from jaxsmw.choices import Backend, PresetName
from jaxsmw.errors import InputError

BACKENDS: tuple[Backend, ...] = ("numpy", "jax")
FIELDS = ("data set", "pair", "equal", *(f"error, {name}" for name in BACKENDS), *BACKENDS)
POINTS = 500


def compared(pair: DataPair, preset: PresetName) -> dict[str, float]:
    """Match a pair with both backends, and return the numbers of its row."""
    meshes = [read_mesh(file) for file in pair.meshes]
    truth, maps = pair.ground_truth(*meshes), []
    row: dict[str, float] = {}
    for name in BACKENDS:
        began = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = match(*meshes, preset=preset, partial=pair.partial, backend=name)
        row[name] = time.perf_counter() - began
        error = geodesic_error(meshes[1], found.pointwise_map, truth, number_of_samples=POINTS)
        row[f"error, {name}"] = error.mean
        maps.append(found.pointwise_map)
    return {"equal": float(np.mean(maps[0] == maps[1])), **row}


def interval(differences: np.ndarray) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the mean."""
    draws = np.random.default_rng(0).choice(differences, (10_000, len(differences)))
    low, high = np.quantile(draws.mean(axis=1), [0.025, 0.975])
    return float(low), float(high)


def main() -> None:
    parser = make_parser(__doc__, pairs=6)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--preset", default="accurate")
    parser.add_argument("--output", type=Path, default=Path("backends.csv"), metavar="FILE")
    options = parser.parse_args()
    rows = list(csv.DictReader(options.output.open())) if options.output.exists() else []
    known = {(row["data set"], row["pair"]) for row in rows}
    with options.output.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if not rows:
            writer.writeheader()
        for directory in sorted(path for path in options.data.iterdir() if path.is_dir()):
            try:
                pairs = open_data_set(directory).pairs
            except InputError:
                continue
            for number in sorted({*np.linspace(0, len(pairs) - 1, options.pairs).astype(int).tolist()}):
                pair = pairs[number]
                if (directory.name, pair.name) in known:
                    continue
                row = {"data set": directory.name, "pair": pair.name, **compared(pair, options.preset)}
                writer.writerow(row)
                file.flush()
                rows.append({key: str(value) for key, value in row.items()})
                print(
                    {
                        key: round(value, 5) if isinstance(value, float) else value
                        for key, value in row.items()
                    },
                    flush=True,
                )
    for name in [*dict.fromkeys(row["data set"] for row in rows), "all"]:
        of_set = [row for row in rows if name in (row["data set"], "all")]
        numbers = {key: np.array([float(row[key]) for row in of_set]) for key in FIELDS[2:]}
        differences = 1e3 * (numbers["error, numpy"] - numbers["error, jax"])
        low, high = interval(differences)
        print(
            f"{name}: {len(of_set)} pairs, {np.mean(numbers['equal']):.2%} of the matches equal; mean errors "
            f"x 10^-3: NumPy {1e3 * numbers['error, numpy'].mean():.2f}, JAX "
            f"{1e3 * numbers['error, jax'].mean():.2f}, difference {differences.mean():+.2f} "
            f"({low:+.2f} to {high:+.2f})"
        )


if __name__ == "__main__":
    main()
