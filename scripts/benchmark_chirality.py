"""Measure how often `Hands` decides correctly whether X or the mirror image of X corresponds to Y.

The first argument is a directory with meshes (.off). For left and right shapes, such as the primate molars,
the directory also contains `chirality.csv` with the columns `name` and `side`. If this file is missing, the
script assumes that no pair needs the mirror image. The script prints one line per pair and a summary.
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np

from jaxsmw import Pair, paired_spectra, read_mesh
from jaxsmw.matching.search.chirality import Hands


def main() -> None:
    """Decide for random pairs whether to mirror X. Print each decision with its evidence and its time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--pairs", type=int, default=100, help="number of random pairs (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the choice of pairs (default: 0)")
    options = parser.parse_args()
    files, sides = sorted(options.directory.glob("*.off")), _sides(options.directory / "chirality.csv")
    generator = np.random.default_rng(options.seed)
    right = doubtful = 0
    for _ in range(options.pairs):
        x, y = (files[i] for i in generator.choice(len(files), 2, replace=False))
        opposite = _side(sides, x) != _side(sides, y)
        pair = Pair.make(read_mesh(x), read_mesh(y))
        spectra = paired_spectra(pair, 20)
        start = time.perf_counter()
        decision = Hands(pair, *spectra).decide()
        seconds = time.perf_counter() - start
        right += decision.mirrored == opposite
        doubtful += decision.doubtful
        verdict = "right" if decision.mirrored == opposite else "WRONG"
        print(f"{x.stem} {y.stem}: opposite {opposite}, {decision}, {verdict}, {seconds:.1f} s", flush=True)
    print(f"{right} of {options.pairs} decisions are right; {doubtful} are marked as doubtful")


def _sides(file: Path) -> dict[str, str]:
    """Return a dictionary from the name of each shape to its side; empty if the file does not exist."""
    if not file.exists():
        return {}
    with open(file) as rows:
        return {row["name"]: row["side"] for row in csv.DictReader(rows)}


def _side(sides: dict[str, str], file: Path) -> str | None:
    """Return the side of a shape. The file name may end in `_sas` even if the name in `sides` does not."""
    return sides.get(file.stem, sides.get(file.stem.removesuffix("_sas")))


if __name__ == "__main__":
    main()
