"""Measures whether maps depend on the machine, and whether a long run needs more and more memory or time.

    python scripts/benchmark_reliability.py [--data FAUST_R] [--only PART ...] [--pairs N] [--output DIR]

FAUST_R is the directory of the remeshed FAUST set. Without it, pairs of procedural creatures are matched.

- `determinism`: matches the same pairs with other numbers of threads, without AVX-512 instructions, in
  batches of several sizes, and again without any change.
- `long_run`: matches N pairs (2000 by default) of small creatures of different sizes in one process, and
  records memory, memory maps, open files and the time of each pair.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from common import Part, make_parser, measure_parts, memory
from scipy.spatial import KDTree
from tqdm import tqdm

from jaxsmw.collection import match_pairs
from jaxsmw.creature import creature, creature_pair
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.meshes import read_mesh
from jaxsmw.matching.match import match
from jaxsmw.report.figures import save_figure

# The number of pairs of `determinism`, and the numbers of vertices of the creatures.
COMPARED_PAIRS = 6
VERTICES = 5000
# The smallest and largest number of vertices of the creatures of `long_run`, and the number of sizes.
SMALLEST, LARGEST, SIZES = 500, 760, 6
# The instruction sets beyond AVX2, in the names of NumPy.
AVX512 = "AVX512F,AVX512CD,AVX512_SKX,AVX512_CLX,AVX512_CNL,AVX512_ICL,AVX512_SPR"
# Each condition is a set of environment variables. Maps are compared with those of the named condition.
TWO_THREADS, ONE_BY_ONE = "2 threads", "match_pairs, one pair at a time"
CONDITIONS: dict[str, tuple[str, dict[str, str]]] = {
    TWO_THREADS: ("", {}),
    "2 threads, again": (TWO_THREADS, {}),
    "1 thread": (TWO_THREADS, {"NPROC": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}),
    "4 threads": (TWO_THREADS, {"NPROC": "4", "OPENBLAS_NUM_THREADS": "4", "OMP_NUM_THREADS": "4"}),
    "without AVX-512": (
        TWO_THREADS,
        {
            "XLA_FLAGS": "--xla_cpu_max_isa=AVX2",
            "OPENBLAS_CORETYPE": "Haswell",
            "NPY_DISABLE_CPU_FEATURES": AVX512,
        },
    ),
    ONE_BY_ONE: ("", {"BATCH_SIZE": "1"}),
    "match_pairs, two pairs at a time": (ONE_BY_ONE, {"BATCH_SIZE": "2"}),
    "match_pairs, all pairs at a time": (ONE_BY_ONE, {"BATCH_SIZE": str(COMPARED_PAIRS)}),
}


def pairs(data: str, number: int) -> list[tuple[Mesh, Mesh]]:
    """Return pairs of people of FAUST, or pairs of creatures if `data` is empty."""
    if not data:
        kinds = ("quadruped", "biped", "dragon")
        both = [creature_pair(kinds[seed % 3], vertices=VERTICES, seed=seed) for seed in range(number)]
        return [(pair.source, pair.target) for pair in both]
    files = sorted((Path(data) / "off").glob("*.off"))
    step = len(files) // (2 * number)
    meshes = [read_mesh(file) for file in files[:: max(step, 1)]]
    return [(meshes[2 * i], meshes[2 * i + 1]) for i in range(number)]


def matched(data: str, file: str) -> None:
    """Match all pairs in this process, and write their maps to a file."""
    of_data = pairs(data, COMPARED_PAIRS)
    if size := os.environ.get("BATCH_SIZE"):
        meshes = [mesh for pair in of_data for mesh in pair]
        numbers = [(2 * i, 2 * i + 1) for i in range(len(of_data))]
        results = dict(match_pairs(meshes, numbers, batch_size=int(size)))
        maps = [results[number].pointwise_map for number in range(len(of_data))]
    else:
        maps = [match(*pair).pointwise_map for pair in of_data]
    np.savez(file, *maps)


def determinism(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the shares of vertices whose matches change in other conditions."""
    data = str(options.data.resolve()) if options.data else ""
    of_data = pairs(data, COMPARED_PAIRS)
    rows: list[list[str]] = []
    maps: dict[str, list[np.ndarray]] = {}
    measured = {}
    for name, (reference, variables) in CONDITIONS.items():
        with tempfile.TemporaryDirectory() as directory:
            file = str(Path(directory) / "maps.npz")
            code = "import sys, benchmark_reliability as b; b.matched(*sys.argv[1:])"
            environment = {**os.environ, **variables, "JAXSMW_CACHE": "off", "PYTHONWARNINGS": "ignore"}
            path = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
            environment["PYTHONPATH"] = os.pathsep.join(filter(None, path))
            subprocess.run([sys.executable, "-c", code, data, file], env=environment, check=True)
            with np.load(file) as arrays:
                maps[name] = [arrays[key] for key in arrays.files]
        if not reference:
            continue
        changed = [float(np.mean(a != b)) for a, b in zip(maps[name], maps[reference], strict=True)]
        moved = []
        for a, b, (_, target) in zip(maps[name], maps[reference], of_data, strict=True):
            lengths = np.linalg.norm(target.vertices[a] - target.vertices[b], axis=1)
            moved.append(float(lengths[a != b].mean() / edge_length(target)) if (a != b).any() else 0.0)
        rows.append(
            [
                name,
                reference,
                f"{100 * np.mean(changed):.3f}%",
                f"{100 * np.max(changed):.3f}%",
                f"{np.max(moved):.1f}",
            ]
        )
        measured[name] = {"changed": changed, "moved": moved}
    yield (
        "Determinism",
        f"{COMPARED_PAIRS} pairs, preset accurate. The last column is the largest mean distance between "
        "matches that differ, in edge lengths of the target.",
        [["condition", "compared with", "changed matches, mean", "worst pair", "distance"], *rows],
        measured,
    )


def edge_length(mesh: Mesh) -> float:
    """Return the mean distance of a vertex to its nearest vertex."""
    return float(KDTree(mesh.vertices).query(mesh.vertices, 2)[0][:, 1].mean())


def status() -> tuple[float, int, int]:
    """Return the memory of this process in MiB, and its numbers of memory maps and open files (Linux)."""
    maps = Path("/proc/self/maps").read_text().count("\n")
    return 1024 * memory("VmRSS"), maps, len(os.listdir("/proc/self/fd"))


def long_run(options: argparse.Namespace) -> Iterator[Part]:
    """Yield memory, memory maps, open files and times over many pairs."""
    generator = np.random.default_rng(0)
    sizes = np.geomspace(SMALLEST, LARGEST, SIZES).astype(int)
    shapes = [
        creature("biped", vertices=int(size), pose=pose, seed=0)
        for size in sizes
        for pose in ("rest", "walk")
    ]
    history = []
    for _ in tqdm(range(options.pairs), desc="pairs", smoothing=0):
        x, y = generator.choice(len(shapes), 2, replace=False)
        start = time.perf_counter()
        match(shapes[x], shapes[y], preset=options.preset)
        history.append((time.perf_counter() - start, *status()))
    tenth = max(1, len(history) // 10)
    rows = []
    for begin in range(0, len(history), tenth):
        part = np.array(history[begin : begin + tenth])
        rows.append(
            [
                f"{begin + 1} to {begin + len(part)}",
                f"{np.median(part[:, 0]):.3f}",
                *(f"{part[:, column].max():.0f}" for column in (1, 2, 3)),
            ]
        )
    yield (
        "Long run",
        f"{len(history)} pairs of {len(shapes)} creatures with {SMALLEST} to {LARGEST} vertices, matched by "
        f"the preset {options.preset} in one process. Times are medians. All other numbers are maxima.",
        [["pairs", "seconds per pair", "memory, MiB", "memory maps", "open files"], *rows],
        {"history": history},
    )


def draw(numbers: dict[str, Any], file: Path) -> None:
    """Plot memory, memory maps, open files and times against the number of matched pairs."""
    if not numbers.get("long_run"):
        return
    history = np.array(numbers["long_run"][0]["history"])
    titles = ("seconds per pair", "memory, MiB", "memory maps", "open files")
    figure, axes = plt.subplots(1, 4, figsize=(14, 3), layout="constrained")
    for axis, title, values in zip(axes, titles, history.T, strict=True):
        axis.plot(np.arange(1, len(values) + 1), values, ".", markersize=2)
        axis.set(title=title, xlabel="matched pairs", ylim=(0, 1.1 * np.quantile(values, 0.999)))
    save_figure(file, figure)
    plt.close(figure)


PARTS = {part.__name__: part for part in (determinism, long_run)}


def main() -> None:
    parser = make_parser(__doc__, parts=PARTS, faust=True, output="reliability", pairs=2000)
    parser.add_argument("--preset", default="accurate", help="the preset of long_run")
    measure_parts("Reliability", PARTS, parser.parse_args(), draw)


if __name__ == "__main__":
    main()
