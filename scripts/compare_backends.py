"""Compares the maps of `jaxsmw.match` by NumPy with those by JAX, on pairs of every kind.

    python scripts/compare_backends.py DATA [--pairs N] [--preset NAME] [--output DIR]

DATA is a directory with data sets that `jaxsmw benchmark` reads. The same number of pairs is taken from each
set, evenly spread over its pairs. For each set, the script prints the errors and times of both backends, and
the mean difference of the errors with its 95 % bootstrap interval. `jaxsmw.benchmark.compare` stores the
results of each pair in DIR, so an interrupted run continues where it stopped.
"""

from common import data_sets, evenly_spread, make_parser

from jaxsmw.benchmark import compare
from jaxsmw.benchmark.opponents.baselines import Matched
from jaxsmw.matching.stages import choose_preset
from jaxsmw.runtime.files import make_directory


def main() -> None:
    parser = make_parser(__doc__, data="DATA", output="backends", pairs=6)
    parser.add_argument("--preset", default="accurate")
    options = parser.parse_args()
    name, preset = options.preset, choose_preset(options.preset)
    methods = {
        "NumPy": Matched(f"the preset {name} by NumPy", preset, backend="numpy"),
        "JAX": Matched(f"the preset {name} by JAX", preset, backend="jax"),
    }
    for data_set in data_sets(options.data):
        pairs = evenly_spread(data_set.pairs, options.pairs)
        output = make_directory(options.output) / data_set.name
        print(f"{data_set.name}:\n{compare(methods, pairs, evaluated_points=500, output=output)}", flush=True)


if __name__ == "__main__":
    main()
