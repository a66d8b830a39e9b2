"""Measure how often `Hands` decides correctly whether X or the mirror image of X corresponds to Y.

The first argument is a directory with meshes (.off). For left and right shapes, such as the primate molars,
the directory also contains `chirality.csv` with the columns `name` and `side`. If this file is missing, the
script assumes that no pair needs the mirror image. The script prints one line per pair and a summary.
"""

import time
from pathlib import Path

import numpy as np
from common import make_parser, side_of

from jaxsmw import Pair, paired_spectra, read_mesh
from jaxsmw.matching.search.chirality import Hands


def main() -> None:
    """Decide for random pairs whether to mirror X. Print each decision with its evidence and its time."""
    parser = make_parser(__doc__, pairs=100)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="seed of the choice of pairs (default: 0)")
    options = parser.parse_args()
    files = sorted(options.directory.glob("*.off"))
    generator = np.random.default_rng(options.seed)
    right = doubtful = 0
    for _ in range(options.pairs):
        x, y = (files[i] for i in generator.choice(len(files), 2, replace=False))
        opposite = side_of(x) != side_of(y)
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


if __name__ == "__main__":
    main()
