"""Measures how many pairs per second a device refines, one by one and in batches.

    python scripts/benchmark_batches.py [--vertices N] [--eigenvectors K] [--batch-sizes B ...] [--quick]

Each candidate refines the same random pairs in float32, with 3 iterations per pair. The following candidates
take turns in one process:

- a Python loop over `refine`;
- `jax.lax.map`;
- `jax.vmap` with several batch sizes;
- `jaxsmw.refine_pairs`. The time of `refine_pairs` includes the transfer of initial maps and results.

The lower bound is the time of the matrix products of all iterations, computed in full float32 precision. The
table also states the temporary memory of each compiled program. This memory excludes the program's arguments.
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
from benchmark_speed import ITERATIONS, medians
from jax import lax
from jaxtyping import Array, Int

from jaxsmw.core.refinement import Refinement, refine
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.report.summary import provenance
from jaxsmw.runtime.batches import bytes_per_pair, refine_pairs, stack

Pair = tuple[Spectrum, Spectrum, Int[Array, " m"]]


def refine_one(pair: Pair) -> Refinement:
    return refine(*pair, iterations=ITERATIONS)


def one_by_one(batch: Pair) -> Refinement:
    return lax.map(refine_one, batch)


def in_batches(batch: Pair, size: int) -> Refinement:
    return lax.map(refine_one, batch, batch_size=size)


def random_spectrum(generator: np.random.Generator, n: int, k: int) -> Spectrum:
    """Return a spectrum of random numbers for n vertices and k eigenvectors."""
    orthonormal, _ = np.linalg.qr(generator.standard_normal((n, k)))
    return Spectrum(
        jnp.asarray(4 * np.pi * np.arange(k), jnp.float32),
        jnp.asarray(np.sqrt(n) * orthonormal, jnp.float32),
        jnp.full(n, 1 / n, jnp.float32),
        jnp.ones(n, bool),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--vertices", type=int, default=5000, help="per shape (default: %(default)s)")
    parser.add_argument("--eigenvectors", type=int, default=100, help="per shape (default: %(default)s)")
    parser.add_argument("--pairs", type=int, default=64, help="(default: %(default)s)")
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[2, 4, 8, 16, 32, 64])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="refine 8 pairs once, in batches of 2 and 8")
    options = parser.parse_args()
    if options.quick:
        options.pairs, options.batch_sizes, options.repeats = 8, [2, 8], 1
    os.environ["JAXSMW_CACHE"] = "off"
    print(json.dumps(provenance()))

    n, k, count = options.vertices, options.eigenvectors, options.pairs
    generator = np.random.default_rng(0)
    shapes = [random_spectrum(generator, n, k) for _ in range(8)]
    pairs = [(i % 8, (i // 8 + i + 1) % 8) for i in range(count)]
    initial_maps = [jnp.asarray(generator.integers(0, n, n), jnp.int32) for _ in pairs]
    x, y = (stack([shapes[pair[side]] for pair in pairs]) for side in (0, 1))
    batch = x, y, jnp.stack(initial_maps)

    # `products` computes the matrix products of one iteration for all pairs. Only the maximum of each column
    # is kept.
    @jax.jit
    def products(a: Array, b: Array) -> Array:
        return lax.map(
            lambda pair: jnp.max(jnp.matmul(pair[0], pair[1].T, precision=lax.Precision.HIGHEST), axis=0),
            (a, b),
            batch_size=min(4, count),
        )

    separate = [(shapes[i], shapes[j], T) for (i, j), T in zip(pairs, initial_maps, strict=True)]

    programs = {"lax.map": jax.jit(one_by_one)}
    for size in options.batch_sizes:
        if size <= count:
            programs[f"vmap of {size}"] = jax.jit(partial(in_batches, size=size))
    memory = {
        name: program.lower(batch).compile().memory_analysis().temp_size_in_bytes
        for name, program in programs.items()
    }

    def run(program: Callable[[Pair], Refinement]) -> Callable[[], object]:
        return lambda: program(batch)

    seconds = medians(
        {
            "products alone": lambda: [products(x.eigenvectors, y.eigenvectors) for _ in range(ITERATIONS)],
            "loop": lambda: [refine_one(pair) for pair in separate],
            **{name: run(program) for name, program in programs.items()},
            "refine_pairs": lambda: [
                refined.pointwise_map
                for _, refined in refine_pairs(shapes, pairs, initial_maps, iterations=ITERATIONS)
            ],
        },
        options.repeats,
    )
    print(f"\n{count} pairs of shapes with {n} vertices each, k = {k}, {ITERATIONS} iterations, float32")
    print(f"estimated memory of one pair with its arguments: {bytes_per_pair(n, n, k) / 2**20:.0f} MiB\n")
    print("| | pairs per second | time, products = 1 | program's memory, MiB |\n|---|---|---|---|")
    for name, median in seconds.items():
        taken = f"{memory[name] / 2**20:.0f}" if name in memory else "—"
        print(f"| {name} | {count / median:.1f} | {median / seconds['products alone']:.2f} | {taken} |")


if __name__ == "__main__":
    main()
