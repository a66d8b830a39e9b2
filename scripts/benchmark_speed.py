"""How fast the refinement of one pair is, beside the matrix products that it cannot do without.

    python scripts/benchmark_speed.py [--repeats N] [--vertices M N] [--eigenvectors K]

Ratios of medians, all measured in turns in one process: refinement at the paper's setting (3 iterations,
float32) against three products (M x K) (K x N) alone, in the fastest of several ways to have them, and
against the same refinement with a plain argmin over a stored distance matrix. Then the host's stages.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxsmw.core.refinement import Refiner, WaveletPreservation, refine
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.creature import creature_pair
from jaxsmw.geometry.eigenbasis import eigenpairs
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.report.summary import provenance

ITERATIONS = 3


class PlainSearch(WaveletPreservation):
    """The same method with the search one writes first."""

    def recover(self, problem, functional_map):
        database = problem.spectrum_y.eigenvectors @ functional_map.T
        products = problem.spectrum_x.eigenvectors @ database.T
        return jnp.argmin(0.5 * jnp.sum(database**2, axis=1) - products, axis=1).astype(jnp.int32)


def random_spectrum(generator: np.random.Generator, n: int, k: int) -> Spectrum:
    orthonormal, _ = np.linalg.qr(generator.standard_normal((n, k)))
    return Spectrum(
        jnp.asarray(4 * np.pi * np.arange(k), jnp.float32),
        jnp.asarray(np.sqrt(n) * orthonormal, jnp.float32),
        jnp.full(n, 1 / n, jnp.float32),
        jnp.ones(n, bool),
    )


def medians(candidates: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each candidate, run in turns so that a busy moment hits all of them."""
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for run in range(repeats + 1):
        for name, candidate in candidates.items():
            start = time.perf_counter()
            jax.block_until_ready(candidate())
            if run:  # the first one compiles
                seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(times)) for name, times in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--vertices", type=int, nargs=2, default=(6890, 7000))
    parser.add_argument("--eigenvectors", type=int, default=100)
    options = parser.parse_args()
    os.environ["JAXSMW_CACHE"] = "off"
    print(json.dumps(provenance()))

    generator = np.random.default_rng(0)
    m, n = options.vertices
    x, y = (random_spectrum(generator, size, options.eigenvectors) for size in (m, n))
    start = jnp.asarray(generator.integers(0, n, m), jnp.int32)
    product = jax.jit(lambda a, b: a @ b.T)
    # In blocks that stay in the processor's cache, of which as little as possible is kept.
    blocks = jnp.pad(x.eigenvectors, ((0, -m % 256), (0, 0))).reshape(-1, 256, options.eigenvectors)
    blocked = jax.jit(lambda a, b: jax.lax.map(lambda block: jnp.max(block @ b.T, axis=1), a))
    a, b = np.asarray(x.eigenvectors), np.asarray(y.eigenvectors)
    out = np.empty((m, n), np.float32)

    def refinement(refiner: Refiner) -> Callable[[], object]:
        return lambda: refine(x, y, start, refiner=refiner, iterations=ITERATIONS)

    seconds = medians(
        {
            "products, JAX": lambda: [product(x.eigenvectors, y.eigenvectors) for _ in range(ITERATIONS)],
            "products, JAX in blocks": lambda: [blocked(blocks, y.eigenvectors) for _ in range(ITERATIONS)],
            "products, NumPy": lambda: [np.matmul(a, b.T, out=out) for _ in range(ITERATIONS)],
            "refinement": refinement(WaveletPreservation()),
            "refinement, plain argmin": refinement(PlainSearch()),
        },
        options.repeats,
    )
    floor = min(median for name, median in seconds.items() if name.startswith("products"))
    print(f"\n{m} x {n} vertices, k = {options.eigenvectors}, {ITERATIONS} iterations, float32\n")
    print("| | seconds | of the fastest products |\n|---|---|---|")
    for name, median in seconds.items():
        print(f"| {name} | {median:.3f} | {median / floor:.2f} |")

    mesh = creature_pair(vertices=7000).source
    host = medians(
        {
            "SHOT": lambda: shot_descriptors(mesh),
            "eigenbasis, k = 100": lambda: eigenpairs(mesh, 100),
        },
        3,
    )
    print(f"\nHost stages, {len(mesh.vertices)} vertices\n\n| | seconds |\n|---|---|")
    for name, median in host.items():
        print(f"| {name} | {median:.2f} |")


if __name__ == "__main__":
    main()
