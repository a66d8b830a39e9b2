"""How many pairs a second a device refines, one by one and side by side, beside its matrix products.

    python scripts/benchmark_batches.py [--vertices N] [--eigenvectors K] [--batch-sizes B ...] [--quick]

Ways to run over the same pairs, in turns in one process, in float32, 3 iterations: a Python loop over
`refine`, `jax.lax.map`, `jax.vmap` of several sizes, and `jaxsmw.refine_pairs`, which is what users call and
which includes the transfer of starts and results. The floor is the matrix products of all iterations alone,
in full float32. Memory is what the compiled program says it takes besides its arguments.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from benchmark_speed import ITERATIONS, medians, random_spectrum
from jax import lax
from jaxtyping import Array, Int

from jaxsmw.core.refinement import Refinement, refine
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.report.summary import provenance
from jaxsmw.runtime.batches import bytes_per_pair, refine_pairs, stack

Pair = tuple[Spectrum, Spectrum, Int[Array, " m"]]


def one(pair: Pair) -> Refinement:
    return refine(*pair, iterations=ITERATIONS)


def mapped(batch: Pair) -> Refinement:
    return lax.map(one, batch)


def side_by_side(batch: Pair, size: int) -> Refinement:
    return lax.map(one, batch, batch_size=size)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--vertices", type=int, default=5000)
    parser.add_argument("--eigenvectors", type=int, default=100)
    parser.add_argument("--pairs", type=int, default=64, help="(default: %(default)s)")
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[2, 4, 8, 16, 32, 64])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="8 pairs, batches of 2 and 8, one repeat")
    options = parser.parse_args()
    if options.quick:
        options.pairs, options.batch_sizes, options.repeats = 8, [2, 8], 1
    os.environ["JAXSMW_CACHE"] = "off"
    print(json.dumps(provenance()))

    n, k, count = options.vertices, options.eigenvectors, options.pairs
    generator = np.random.default_rng(0)
    shapes = [random_spectrum(generator, n, k) for _ in range(8)]
    pairs = [(i % 8, (i // 8 + i + 1) % 8) for i in range(count)]
    starts = [jnp.asarray(generator.integers(0, n, n), jnp.int32) for _ in pairs]
    x, y = (stack([shapes[pair[side]] for pair in pairs]) for side in (0, 1))
    batch = x, y, jnp.stack(starts)

    # What all iterations of one pair multiply, several pairs at once, of which only a maximum is kept.
    @jax.jit
    def products(a: Array, b: Array) -> Array:
        return lax.map(
            lambda pair: jnp.max(jnp.matmul(pair[0], pair[1].T, precision=lax.Precision.HIGHEST), axis=0),
            (a, b),
            batch_size=min(4, count),
        )

    separate = [(shapes[i], shapes[j], start) for (i, j), start in zip(pairs, starts, strict=True)]

    programs = {"lax.map": jax.jit(mapped)}
    for size in options.batch_sizes:
        if size <= count:
            programs[f"vmap of {size}"] = jax.jit(partial(side_by_side, size=size))
    memory = {
        name: program.lower(batch).compile().memory_analysis().temp_size_in_bytes
        for name, program in programs.items()
    }

    def run(program: Callable[[Pair], Refinement]) -> Callable[[], object]:
        return lambda: program(batch)

    seconds = medians(
        {
            "products alone": lambda: [products(x.eigenvectors, y.eigenvectors) for _ in range(ITERATIONS)],
            "loop": lambda: [one(pair) for pair in separate],
            **{name: run(program) for name, program in programs.items()},
            "refine_pairs": lambda: [
                refined.pointwise_map
                for _, refined in refine_pairs(shapes, pairs, starts, iterations=ITERATIONS)
            ],
        },
        options.repeats,
    )
    print(f"\n{count} pairs of {n} vertices, k = {k}, {ITERATIONS} iterations, float32")
    print(f"estimated memory of one pair with its arguments: {bytes_per_pair(n, n, k) / 2**20:.0f} MiB\n")
    print("| | pairs per second | time, products = 1 | program's memory, MiB |\n|---|---|---|---|")
    for name, median in seconds.items():
        taken = f"{memory[name] / 2**20:.0f}" if name in memory else "—"
        print(f"| {name} | {count / median:.1f} | {median / seconds['products alone']:.2f} | {taken} |")


if __name__ == "__main__":
    main()
