"""Measures how many pairs per second a device refines, one by one and in batches.

    python scripts/benchmark_batches.py [--quick | --device] [--data FAUST_R] [--output DIR]

- `paper`: three iterations for random pairs in float32. The candidates are a Python loop over `refine`,
  `jax.lax.map`, `jax.vmap` with several batch sizes, and `jaxsmw.refine_pairs`. The time of `refine_pairs`
  includes the transfer of initial maps and results.
- `methods`: `jax.vmap` over pairs of random shapes, compared with the same pairs one after the other, for
  several refiners and solutions, and for `encode` by least squares.
- `descriptors`: functional maps of 128 descriptors and the resolvent mask. One call for all linear systems is
  compared with one call per row of C, as in the loop of many programs, and with NumPy.
- `accurate`: all stages of the preset `"accurate"` in float32, without a search. The candidates are several
  batch sizes of `run_batches`, which includes the transfer of initial maps and results. The last row is
  `jaxsmw.match_pairs`, which also computes initial maps and searches for better maps, on the host.

The candidates of a table take turns in one process. The lower bound is the time of all matrix products of a
program, computed in full float32 precision and in batches. The script finds these products in the traced
program. For `paper`, the table also states the temporary memory of each compiled program, which excludes the
program's arguments.

On an accelerator, the script also refines pairs of shapes on the CPU, and states the share of vertices at
which both devices give equal matches. The shapes are creatures or, with `--data`, people of the remeshed
FAUST set. With `--data`, the script also states the errors of both devices' maps. The script writes the
tables to `batches.md` and all numbers to `batches.json` in DIR.

With `--device`, the script measures an accelerator that is available only for a short time: `paper` with 100
and 128 eigenvectors, the agreement with the CPU, and `accurate`. The script prints each table when it is
measured, and ends after less than four minutes, even if tables are missing.
"""

from __future__ import annotations

import argparse
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from benchmark_speed import ITERATIONS, KnownPair
from common import Part, make_parser, measure_parts, medians
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr
from jaxtyping import Array, Int

from jaxsmw.benchmark.datasets import open_data_set
from jaxsmw.collection.pairs import match_pairs, prepare_task
from jaxsmw.collection.shapes import prepare_collection
from jaxsmw.core.functional_map import encode
from jaxsmw.core.refinement import Refinement, refine
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.solutions.closed_form import LeastSquares
from jaxsmw.core.solutions.descriptors import DescriptorPair, ProjectedDescriptors
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.creature import CREATURES, creature
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.meshes import read_mesh
from jaxsmw.matching.executor import run_batches
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import PRESETS, PresetName
from jaxsmw.runtime.batches import bytes_per_pair, refine_pairs, stack
from jaxsmw.runtime.compilation import compiler_options
from jaxsmw.runtime.threads import one_blas_thread

Pair = tuple[Spectrum, Spectrum, Int[Array, " m"]]

# The floor is measured in batches of at most this number of products.
PRODUCTS = 16
# Products with less than this share of all operations are left out of the floor.
NEGLIGIBLE = 1e-3
# The settings of `--device`.
DEVICE = {
    "only": ["paper", "agreement", "accurate"],
    "eigenvectors": [100, 128],
    "batch_sizes": [16, 64],
    "repeats": 3,
    "shapes": 9,
    "compared": 4,
    "seconds": 225.0,
}


class MatrixProduct(NamedTuple):
    """The shapes of the factors of a `jax.lax.dot_general`, and its dimension numbers."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    dimensions: Any

    @property
    def operations(self) -> int:
        """The number of multiplications."""
        (contracted, _), (batch, _) = self.dimensions
        shared = np.prod([self.left[axis] for axis in (*contracted, *batch)])
        return int(np.prod(self.left) * np.prod(self.right) // shared)


def matrix_products(function: Callable, *arguments: Any) -> Counter[MatrixProduct]:
    """Return how often a function computes each matrix product, counting loops of unknown length once."""
    counts: Counter[MatrixProduct] = Counter()

    def add(jaxpr: Jaxpr, times: int) -> None:
        for equation in jaxpr.eqns:
            if equation.primitive.name == "dot_general":
                left, right = (
                    variable.aval.shape
                    for variable in equation.invars
                    if isinstance(variable.aval, jax.core.ShapedArray)
                )
                counts[MatrixProduct(left, right, equation.params["dimension_numbers"])] += times
            inner = times * equation.params.get("length", 1) if equation.primitive.name == "scan" else times
            for value in jax.tree.leaves(
                list(equation.params.values()), is_leaf=lambda leaf: isinstance(leaf, ClosedJaxpr | Jaxpr)
            ):
                if isinstance(value, ClosedJaxpr | Jaxpr):
                    add(value.jaxpr if isinstance(value, ClosedJaxpr) else value, inner)

    add(jax.make_jaxpr(function)(*arguments).jaxpr, 1)
    return counts


def time_of_products(products: Counter[MatrixProduct], count: int, repeats: int) -> float:
    """Return the seconds that the given products take for `count` pairs, in full float32 precision."""
    size = min(PRODUCTS, count)
    everything = sum(product.operations * times for product, times in products.items())
    generator = np.random.default_rng(0)
    candidates, times_of = {}, {}
    for number, (product, times) in enumerate(products.items()):
        if product.operations * times < NEGLIGIBLE * everything:
            continue
        factors = [
            jnp.asarray(generator.standard_normal((size, *shape)), jnp.float32)
            for shape in (product.left, product.right)
        ]

        def maximum(left: Array, right: Array, dimensions: Any = product.dimensions) -> Array:
            return jnp.max(lax.dot_general(left, right, dimensions, precision=lax.Precision.HIGHEST), axis=-1)

        each = jax.jit(jax.vmap(maximum))
        candidates[str(number)], times_of[str(number)] = partial(each, *factors), times
    measured = medians(candidates, repeats)
    return sum(seconds * times_of[name] for name, seconds in measured.items()) * count / size


def rates(seconds: dict[str, float], count: int, floor: float) -> list[list[str]]:
    """Return a table with the pairs per second of each candidate, and its time divided by the floor."""
    rows = [
        [name, f"{count / median:.3g}", f"{median / floor:.2f}"]
        for name, median in {"products alone": floor, **seconds}.items()
    ]
    return [["", "pairs per second", "time, products = 1"], *rows]


def refine_one(pair: Pair) -> Refinement:
    return refine(*pair, iterations=ITERATIONS)


def random_spectrum(generator: np.random.Generator, n: int, k: int) -> Spectrum:
    """Return a spectrum of random numbers for n vertices and k eigenvectors."""
    orthonormal, _ = np.linalg.qr(generator.standard_normal((n, k)))
    return Spectrum(
        jnp.asarray(4 * np.pi * np.arange(k), jnp.float32),
        jnp.asarray(np.sqrt(n) * orthonormal, jnp.float32),
        jnp.full(n, 1 / n, jnp.float32),
        jnp.ones(n, bool),
    )


def paper(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the pairs per second of several ways to refine random pairs with the preset `"paper"`."""
    for k in options.eigenvectors:
        yield paper_with(k, options)


def paper_with(k: int, options: argparse.Namespace) -> Part:
    """Return the pairs per second of several ways to refine random pairs with k eigenvectors."""
    n, count = options.vertices, options.pairs
    generator = np.random.default_rng(0)
    shapes = [random_spectrum(generator, n, k) for _ in range(8)]
    pairs = [(i % 8, (i // 8 + i + 1) % 8) for i in range(count)]
    initial_maps = [jnp.asarray(generator.integers(0, n, n), jnp.int32) for _ in pairs]
    x, y = (stack([shapes[pair[side]] for pair in pairs]) for side in (0, 1))
    batch = x, y, jnp.stack(initial_maps)
    separate = [(shapes[i], shapes[j], T) for (i, j), T in zip(pairs, initial_maps, strict=True)]
    programs = {"lax.map": jax.jit(partial(lax.map, refine_one))}
    for size in options.batch_sizes:
        programs[f"vmap of {size}"] = jax.jit(partial(lax.map, refine_one, batch_size=size))
    memory = {}
    for name, program in programs.items():
        analysis = program.lower(batch).compile().memory_analysis()
        assert analysis is not None
        memory[name] = analysis.temp_size_in_bytes
    seconds = medians(
        {
            "loop": lambda: [refine_one(pair) for pair in separate],
            **{name: partial(program, batch) for name, program in programs.items()},
            "refine_pairs": lambda: [
                refined.pointwise_map
                for _, refined in refine_pairs(shapes, pairs, initial_maps, iterations=ITERATIONS)
            ],
        },
        options.repeats,
    )
    products = matrix_products(refine_one, separate[0])
    floor = time_of_products(products, count, options.repeats)
    operations = 2 * sum(product.operations * times for product, times in products.items())
    header, *rows = rates(seconds, count, floor)
    table = [[*header, "program's memory, MiB"]]
    for name, *row in rows:
        table.append([name, *row, f"{memory[name] / 2**20:.0f}" if name in memory else "—"])
    return (
        f"Preset paper, k = {k}",
        f"{count} pairs of shapes with {n} vertices each, {ITERATIONS} iterations, float32, on "
        f"{jax.devices()[0].device_kind}. The products of one pair take {operations / 1e9:.3g} GFLOP. The "
        f"estimated memory of one pair with its arguments is {bytes_per_pair(n, n, k) / 2**20:.0f} MiB.",
        table,
        {"seconds": seconds, "products": floor, "memory": memory, "pairs": count},
    )


def methods(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the time of a batch by `jax.vmap`, relative to its pairs one after the other."""
    n, k, count = options.vertices, options.eigenvectors[0], min(options.pairs, 8)
    generator = np.random.default_rng(0)

    def random_shape() -> Spectrum:
        points = generator.standard_normal((n, 3)).astype(np.float32)
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        return random_spectrum(generator, n, k).with_positions(jnp.asarray(points), jnp.asarray(normals))

    pairs: list[Pair] = [
        (random_shape(), random_shape(), jnp.asarray(generator.integers(0, n, n), jnp.int32))
        for _ in range(count)
    ]
    x, y, maps = zip(*pairs, strict=True)
    batch = stack(x), stack(y), jnp.stack(maps)
    step = max(1, n // 1000)
    samples = jnp.arange(0, n - step, step), jnp.arange(1, n - step + 1, step)
    levels = tuple(range(min(20, k), k, 20))
    refiners: dict[str, Refiner] = {
        "Filtering": WaveletPreservation(),
        "LeastSquares": WaveletPreservation(solution=LeastSquares()),
        "RegularizedLeastSquares": WaveletPreservation(solution=RegularizedLeastSquares()),
        "FeatureRegression": FeatureRegression(levels),
        "Registration": Registration(levels),
    }

    def encoded(x: Spectrum, y: Spectrum, pointwise_map: Array) -> Array:
        return jnp.asarray(encode(pointwise_map, x, y, pseudo_inverse="least_squares"))

    calls: dict[str, Callable] = {
        name: partial(refine, refiner=refiner, samples=samples, iterations=ITERATIONS)
        for name, refiner in refiners.items()
    }
    calls["encode, least squares"] = encoded
    rows, measured = [["", "CPU ms per pair, one by one", "of this time in a batch"]], {}
    for name, call in calls.items():
        refine_one, refine_batch = (
            jax.jit(function, compiler_options=compiler_options()) for function in (call, jax.vmap(call))
        )
        with one_blas_thread():
            seconds = medians(
                {
                    "pairs": partial(lambda one: [one(*pair) for pair in pairs], refine_one),
                    "batch": partial(refine_batch, *batch),
                },
                options.repeats,
                time.process_time,
            )
        measured[name] = seconds
        per_pair, share = 1e3 * seconds["pairs"] / count, seconds["batch"] / seconds["pairs"]
        rows.append([name, f"{per_pair:.3g}", f"{share:.2f}"])
    yield (
        "Methods",
        f"{count} pairs of shapes with {n} vertices each, of which about 1000 are samples, k = {k}, "
        f"{ITERATIONS} iterations, float32.",
        rows,
        {"seconds": measured, "pairs": count},
    )


def descriptors(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the times of functional maps of descriptors, by one call per row of C and by one call in all."""
    count, number = min(options.pairs, 4), 128
    generator = np.random.default_rng(0)
    names = ["a call per row", "NumPy, row by row", "a call per pair", "one call", "one call, with gradient"]
    rows, measured = [["k", *names]], {}
    for k in options.sizes:
        arrays = [jnp.asarray(generator.standard_normal((count, k, number)), jnp.float32) for _ in range(2)]
        gaps = generator.uniform(0.5, 1.5, (2, count, k))
        arrays += [jnp.asarray(eigenvalues, jnp.float32) for eigenvalues in np.cumsum(gaps, axis=2)]

        def functional_map(f_x: Array, f_y: Array, eigenvalues_x: Array, eigenvalues_y: Array) -> Array:
            solution = RegularizedLeastSquares(
                wavelet_preservation=None,
                orthogonality=None,
                descriptor_preservation=jnp.float32(1),
                laplacian_commutativity=jnp.float32(10),
                mask="resolvent",
                descriptors=DescriptorPair(ProjectedDescriptors(f_x), ProjectedDescriptors(f_y)),
            )
            return jnp.asarray(solution.minimize(None, eigenvalues_x, eigenvalues_y)[0])

        @jax.jit
        def systems(f_x: Array, f_y: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
            """Return the matrix that all rows share, the diagonals that differ, and the right sides."""
            a, b = (jnp.sqrt(values / jnp.maximum(x[-1], y[-1])) for values in (x, y))
            a, b = a[:, None], b[None, :]
            scale = f_x.shape[0] / jnp.sum(f_x**2)
            penalty = 10 * (a - b) ** 2 / ((1 + a**2) * (1 + b**2))
            return scale * f_y @ f_y.T, penalty, scale * f_x @ f_y.T

        def total(*arrays: Array) -> Array:
            return jnp.sum(jax.vmap(functional_map)(*arrays) ** 2)

        each = [[array[i] for array in arrays] for i in range(count)]
        solve_row = jax.jit(
            lambda gram, penalty, right: jax.scipy.linalg.solve(
                gram + jnp.diag(penalty), right, assume_a="pos"
            ),
            compiler_options=compiler_options(),
        )
        one = jax.jit(functional_map, compiler_options=compiler_options())
        batch = jax.jit(jax.vmap(functional_map), compiler_options=compiler_options())
        gradient = jax.jit(jax.grad(total, (0, 1)), compiler_options=compiler_options())

        def row_by_row(
            each: list[list[Array]] = each, systems: Callable = systems, solve: Callable = solve_row
        ) -> list:
            return [
                solve(gram, *row)
                for gram, *parts in (systems(*pair) for pair in each)
                for row in zip(*parts, strict=True)
            ]

        def in_numpy(each: list[list[Array]] = each, systems: Callable = systems) -> list:
            return [
                np.linalg.solve(gram + np.diag(penalty), right)
                for gram, *parts in (map(np.asarray, systems(*pair)) for pair in each)
                for penalty, right in zip(*parts, strict=True)
            ]

        candidates = (
            row_by_row,
            in_numpy,
            partial(lambda each, one: [one(*pair) for pair in each], each, one),
            partial(batch, *arrays),
            partial(gradient, *arrays),
        )
        difference = np.max(np.abs(np.reshape(in_numpy(), (count, k, k)) - batch(*arrays)))
        assert difference < 1e-3, difference
        with one_blas_thread():
            seconds = medians(dict(zip(names, candidates, strict=True)), options.repeats, time.process_time)
        measured[k] = seconds
        rows.append([str(k), *(f"{1e3 * seconds[name] / count:.3g}" for name in names)])
    yield (
        "Maps of descriptors",
        f"CPU milliseconds per pair, for {count} pairs with {number} descriptors and the resolvent mask, "
        "float32.",
        rows,
        {"seconds": measured, "pairs": count},
    )


class Shapes(NamedTuple):
    """The meshes of several shapes, their names, and the ordered pairs to match, as positions in `meshes`."""

    meshes: list[Mesh]
    names: list[str]
    pairs: list[tuple[int, int]]


def chosen_shapes(options: argparse.Namespace) -> Shapes:
    """Return people of the remeshed FAUST set if `--data` is given, else creatures in several poses."""
    pairs = list(permutations(range(options.shapes), 2))[: options.pairs]
    if options.data is not None:
        names = [f"tr_reg_{number:03}" for number in range(0, 7 * options.shapes, 7)]
        return Shapes([read_mesh(options.data / "off" / f"{name}.off") for name in names], names, pairs)
    # Each creature has another seed, because the meshes of one creature have equal triangles in all poses.
    kinds = [(kind, pose) for kind, poses in CREATURES.items() for pose in poses]
    meshes = [
        creature(kind, vertices=options.vertices, pose=pose, seed=seed)
        for seed, (kind, pose) in enumerate(kinds[: options.shapes])
    ]
    return Shapes(meshes, [mesh.name for mesh in meshes], pairs)


def accurate(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the pairs per second of the preset `"accurate"`, without and with a search."""
    shapes = chosen_shapes(options)
    preset, count = PRESETS["accurate"], len(shapes.pairs)
    tasks = prepared_tasks(shapes, "accurate")
    preset = preset.fitted(min(len(mesh.vertices) for mesh in shapes.meshes))

    def in_batches_of(size: int) -> Callable[[], object]:
        return lambda: [
            outcome.pointwise_map for outcome in run_batches(preset.stages, tasks, batch_size=size)
        ]

    candidates = {f"batches of {size}": in_batches_of(size) for size in (1, *options.batch_sizes)}
    seconds = medians(candidates, options.repeats)
    products: Counter[MatrixProduct] = Counter()
    for stage in preset.stages:
        spectra, first = tasks[0]
        seen = spectra.seen_by(stage)
        traced = partial(refine, samples=seen.samples, **stage.settings())
        products += matrix_products(traced, *seen.both, jnp.asarray(first.pointwise_map))
    floor = time_of_products(products, count, options.repeats)
    note = (
        f"{count} ordered pairs of {len(shapes.meshes)} shapes with about {len(shapes.meshes[0].vertices)} "
        "vertices each, float32."
    )
    numbers = {"seconds": seconds, "products": floor, "pairs": count}
    yield "Preset accurate", note, rates(seconds, count, floor), numbers
    largest = max(options.batch_sizes)

    def matched() -> list[object]:
        found = match_pairs(shapes.meshes, shapes.pairs, batch_size=largest)
        return [outcome.pointwise_map for _, outcome in found]

    whole = medians({"match_pairs": matched}, 1)
    note += f" match_pairs runs in batches of {largest}."
    numbers = {"seconds": whole, "products": floor, "pairs": count}
    yield "Preset accurate, with initial maps and search", note, rates(whole, count, floor), numbers


def agreement(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the share of vertices at which the maps of the accelerator equal the maps of the CPU."""
    device, cpu = jax.devices()[0], jax.devices("cpu")[-1]
    if device == cpu:
        print("\nagreement: left out, because it needs an accelerator.")
        return
    shapes = chosen_shapes(options)
    shapes = shapes._replace(pairs=shapes.pairs[:: max(1, len(shapes.pairs) // options.compared)])
    header = ["equal matches", "smallest share of a pair"]
    if options.data is not None:
        header += ["error x10^-3", "error of the CPU"]
    names: tuple[PresetName, ...] = ("paper", "accurate")
    for name in names:
        tasks = prepared_tasks(shapes, name)
        maps = [
            [outcome.pointwise_map for outcome in run_batches(PRESETS[name].stages, tasks, devices=[one])]
            for one in (device, cpu)
        ]
        equal = [float(np.mean(ours == its)) for ours, its in zip(*maps, strict=True)]
        row = [f"{np.mean(equal):.2%}", f"{min(equal):.2%}"]
        measured: dict[str, object] = {"equal": equal}
        if options.data is not None:
            errors = [errors_of(options.data, shapes, of_device) for of_device in maps]
            row += [f"{np.mean(of_device):.2f}" for of_device in errors]
            measured["errors"] = errors
        yield (
            f"Agreement with the CPU, {name}",
            f"{len(shapes.pairs)} ordered pairs of {len(shapes.meshes)} shapes, all stages, without a "
            "search, float32 on both devices.",
            [header, row],
            measured,
        )


def errors_of(data: Path, shapes: Shapes, maps: Sequence[np.ndarray]) -> list[float]:
    """Return the mean geodesic error of each map, in thousandths of the square root of the area."""
    known = open_data_set(data).known_pairs
    pairs = (KnownPair.read(known[shapes.names[i], shapes.names[j]]) for i, j in shapes.pairs)
    return [pair.error(pointwise_map) for pair, pointwise_map in zip(pairs, maps, strict=True)]


def prepared_tasks(shapes: Shapes, preset: PresetName) -> list[tuple[SpectralPair, Start]]:
    """Return the spectra of all pairs, with initial maps from SHOT."""
    prepared_shapes, _ = prepare_collection(shapes.meshes, PRESETS[preset])
    tasks = (prepare_task(prepared_shapes[i], prepared_shapes[j]) for i, j in shapes.pairs)
    return [(task.prepared.spectra, task.start) for task in tasks]


PARTS = {
    "paper": paper,
    "methods": methods,
    "descriptors": descriptors,
    "accurate": accurate,
    "agreement": agreement,
}


def main() -> None:
    parser = make_parser(__doc__, parts=PARTS, faust=True, output="batches", pairs=64)
    parser.add_argument("--vertices", type=int, default=5000, help="per shape (default: %(default)s)")
    parser.add_argument("--eigenvectors", type=int, nargs="+", default=[100], help="per random shape")
    parser.add_argument("--shapes", type=int, default=10, help="number of real shapes (default: %(default)s)")
    parser.add_argument("--compared", type=int, default=20, help="number of pairs that the CPU also refines")
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[4, 16, 64])
    sizes = [30, 50, 100, 200, 300]
    parser.add_argument("--sizes", type=int, nargs="+", default=sizes, help="k of the maps of descriptors")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="refine 8 pairs once, in batches of 2 and 8")
    parser.add_argument("--device", action="store_true", help="measure an accelerator within four minutes")
    parser.add_argument("--seconds", type=float, help="end after so many seconds, with the tables until then")
    if parser.parse_args().device:
        parser.set_defaults(**DEVICE)
    options = parser.parse_args()
    if options.quick:
        options.pairs, options.batch_sizes, options.repeats = 8, [2, 8], 1
    options.batch_sizes = [size for size in options.batch_sizes if size <= options.pairs]
    os.environ["JAXSMW_CACHE"] = "off"
    timer = threading.Timer(options.seconds or 0, end, [options.seconds])
    if options.seconds is not None:
        timer.start()
    try:
        measure_parts("Batches", PARTS, options)
    finally:
        timer.cancel()


def end(seconds: float) -> None:
    """End the process, even during a compilation."""
    print(f"\nended after {seconds:g} s: later tables are missing.", flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
