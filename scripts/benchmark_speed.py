"""Measures how long parts of the library take, and compares these times with lower bounds or other libraries.

    python scripts/benchmark_speed.py [--quick] [--only PART ...] [--data FAUST_R] [--output DIR]

- `refinement`: the time of three iterations in float32 with 100 eigenvectors (as in the MWP paper), for
  shapes of several sizes. The candidates are exhaustive search, search in patches, refinement on samples, and
  a plain argmin over stored distances. The lower bound is the time of three products of an (m x k) and a (k x
  n) matrix, in the fastest of several implementations.
- `eigenbasis`: the CPU time of 100 exact or approximate eigenpairs, compared with SciPy's shift-invert
  `eigsh` with default settings. The note above the table states the errors of the approximate eigenvalues.
- `side_by_side_eigenbases`: the time to compute two eigenbases concurrently, in threads and in processes,
  compared with the time to compute one eigenbasis.
- `stages`: the times of other computations on the host for one shape, such as SHOT and sampling.
- `command`: wall time and CPU time of whole commands, from the start of Python until the outputs are written,
  with and without the results of earlier commands. Some commands also run beside busy processes.
- `later_pairs`: the time of `match` for each of several pairs in one process, after a first pair.
- `throughput`: the pairs per minute of one process of jaxsmw, and of ten processes of each other library.
- `peers`: the time from two mesh files to the refined map, and the time of refinement alone. pyFM and geomfum
  are included if they are installed (`jaxsmw[peers]`).
- `scale`: the time from two mesh files of up to a million vertices to the refined map. The script measures
  each size twice, each time in a new process: cold, with an empty cache, and warm, with the cache of the
  first process. The table states times, peak memory and errors. Power laws in the number of vertices are
  fitted to the times and the memory. The table states the exponents.

The candidates of a comparison take turns in one process, so that other load on the machine affects all
candidates equally. Each ratio is computed from median times. The shapes are procedural creatures. To obtain
the large shapes, the script splits edges of a creature and moves its vertices at random. With `--data`, the
parts `peers` and `scale` use two people of the remeshed FAUST set instead of creatures. The script writes
three files to DIR: the tables to `speed.md`, all measurements to `speed.json`, and a plot of the times
against the sizes to `speed.png`. With `--quick`, the script measures only the smallest sizes, which takes
three minutes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, permutations
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse as sp
from common import Part, make_parser, measure_parts, medians
from jaxtyping import Array, Float32, Int64
from scipy.sparse.linalg import eigsh
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from jaxsmw.choices import Eigensolver, Search
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.creature import creature_pair
from jaxsmw.geometry.eigenbasis import compute_spectrum, eigenpairs
from jaxsmw.geometry.geodesics import geodesic_distances, geodesic_distances_between
from jaxsmw.geometry.laplacian import assemble_laplacian
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.geometry.sampling import farthest_point_samples, poisson_disk_samples
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.io.meshes import read_mesh, write_mesh
from jaxsmw.matching.match import match
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import paired_spectra
from jaxsmw.matching.stages import PresetName, Stage
from jaxsmw.matching.starts import initial_map
from jaxsmw.report.figures import save_figure
from jaxsmw.runtime.cache import cache_compiled_programs
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.threads import one_blas_thread, side_by_side

ITERATIONS, EIGENVECTORS, SAMPLES = 3, 100, 500
SIZES = (7000, 20_000, 50_000)
LARGE = (100_000, 300_000, 1_000_000)
XLA_DEFAULTS = ", XLA's defaults"
# For shapes with more than this number of vertices, a matrix of all distances would take gigabytes.
STORED = 10_000


class PlainSearch(WaveletPreservation):
    """Wavelet preservation with the simplest search: an argmin over a stored matrix of all distances."""

    def recover(self, prepared, state):
        queries, database = self.embeddings(prepared, state)
        products = queries @ database.T
        return jnp.argmin(0.5 * jnp.sum(database**2, axis=1)[None, :] - products, axis=1).astype(jnp.int32)


def wall_and_cpu() -> np.ndarray:
    """Return the wall time, and the CPU time of this process and its finished children, in seconds."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return np.array([time.perf_counter(), time.process_time() + children.ru_utime + children.ru_stime])


def compared(seconds: dict[str, float], of: str) -> list[list[str]]:
    """Return a table with the time of each candidate in seconds, and relative to the candidate `of`."""
    rows = [[name, f"{value:.3f}", f"{value / seconds[of]:.2f}"] for name, value in seconds.items()]
    return [["", "seconds", f"of {of}"], *rows]


def products(x: Spectrum, y: Spectrum) -> dict[str, Callable[[], object]]:
    """Return functions that multiply the eigenvector matrices of X and Y `ITERATIONS` times, by name.

    The time of the fastest function is a lower bound for the time of an exhaustive search.
    """
    # Each block of products fits into the processor's cache. Only the maximum of each row is kept.
    rows = x.eigenvectors
    blocks = jnp.pad(rows, ((0, -rows.shape[0] % 256), (0, 0))).reshape(-1, 256, rows.shape[1])

    def blocked(a: Float32[Array, "b 256 k"], b: Float32[Array, "n k"]) -> Float32[Array, "b 256"]:
        return jax.lax.map(lambda block: jnp.max(block @ b.T, axis=1), a)

    usual, ours = jax.jit(blocked), compiled(blocked)
    ways: dict[str, Callable[[], object]] = {
        "products, JAX in blocks": lambda: [ours(blocks, y.eigenvectors) for _ in range(ITERATIONS)],
        f"products, JAX in blocks{XLA_DEFAULTS}": lambda: [
            usual(blocks, y.eigenvectors) for _ in range(ITERATIONS)
        ],
    }
    if rows.shape[0] <= STORED:
        product = jax.jit(lambda a, b: a @ b.T)
        a, b = np.asarray(rows), np.asarray(y.eigenvectors)
        out = np.empty((a.shape[0], b.shape[0]), a.dtype)
        ways["products, JAX"] = lambda: [product(rows, y.eigenvectors) for _ in range(ITERATIONS)]
        ways["products, NumPy"] = lambda: [np.matmul(a, b.T, out=out) for _ in range(ITERATIONS)]
    return ways


def refinement(options: argparse.Namespace) -> Iterator[Part]:
    """For each size, yield the times of several ways to refine one pair."""
    for size in options.sizes:
        pair = creature_pair(vertices=size)
        meshes = pair.source, pair.target
        x, y = (compute_spectrum(mesh, EIGENVECTORS, eigensolver="exact") for mesh in meshes)
        start = jnp.asarray(initial_map(Pair(*meshes), x, y, init="shot" if size <= STORED else "wks"))
        samples = [jnp.asarray(farthest_point_samples(mesh, SAMPLES)) for mesh in meshes]

        def refined(refiner: Refiner, *sampled: Any, run=refine, x=x, y=y, start=start) -> Callable[[], Any]:

            def once() -> Any:
                with one_blas_thread():  # `match` also limits BLAS to one thread
                    return jax.block_until_ready(
                        run(x, y, start, refiner=refiner, iterations=ITERATIONS, samples=sampled or None)
                    )

            return once

        ours = compiled(refine)
        exhaustive, patches = (WaveletPreservation(search=search) for search in ("exhaustive", "patches"))
        candidates = {
            "all with all": refined(exhaustive, run=ours),
            "in patches": refined(patches, run=ours),
            f"all with all{XLA_DEFAULTS}": refined(exhaustive),
            f"in patches{XLA_DEFAULTS}": refined(patches),
            "on samples": refined(exhaustive, *samples, run=ours),
            "on samples, in patches": refined(patches, *samples, run=ours),
        }
        if size <= STORED:
            candidates["plain argmin"] = refined(PlainSearch(), run=ours)
        alone = products(x, y)
        seconds = medians(alone | candidates, options.repeats if size <= STORED else 3)
        floor = min(alone, key=lambda name: seconds[name])
        same = [
            float(np.mean(np.asarray(candidates[a]().pointwise_map == candidates[b]().pointwise_map)))
            for a, b in (("all with all", "in patches"), ("on samples", "on samples, in patches"))
        ]
        m, n = (mesh.vertices.shape[0] for mesh in meshes)
        yield (
            f"Refinement, {m} x {n} vertices",
            f"k = {EIGENVECTORS}, {ITERATIONS} iterations, float32. Search in patches finds {same[0]:.3%} of "
            f"the matches of the exhaustive search, and {same[1]:.3%} on samples.",
            compared(seconds, floor),
            {"vertices": [m, n], "seconds": seconds, "same": same},
        )


def eigenbasis(options: argparse.Namespace) -> Iterator[Part]:
    """For each size, yield the CPU times of several eigensolvers on one shape."""
    for size in [*options.sizes, *LARGE[: 0 if options.quick else 1]]:
        mesh = finer(creature_pair(vertices=min(size, SIZES[-1])).source, size)
        stiffness, areas = assemble_laplacian(mesh)
        masses = sp.diags(areas / areas.sum()).tocsc()

        def usual(stiffness=stiffness, masses=masses) -> object:
            with threadpool_limits(1, "blas"):
                return eigsh(stiffness, EIGENVECTORS, masses, sigma=-1e-2)

        def ours(solver: Eigensolver, mesh=mesh) -> np.ndarray:
            return eigenpairs(mesh, EIGENVECTORS, eigensolver=solver)[0]

        seconds = medians(
            {
                "SciPy's eigsh": usual,
                "exact": lambda: ours("exact"),
                "approximate": lambda: ours("approximate"),
            },
            3,
            time.process_time,
            warm=False,
        )
        excess = ours("approximate")[1:] / ours("exact")[1:] - 1
        yield (
            f"Eigenbasis, {len(mesh.vertices)} vertices",
            f"{EIGENVECTORS} eigenpairs, one thread, CPU time. Our times include the assembly of the "
            f"Laplacian and a check of the result. Approximate eigenvalues are {excess.mean():.2%} too large "
            f"on average, and at most {excess.max():.2%} too large.",
            compared(seconds, "SciPy's eigsh"),
            {"vertices": len(mesh.vertices), "seconds": seconds, "excess": excess.tolist()},
        )


def side_by_side_eigenbases(options: argparse.Namespace) -> Iterator[Part]:
    """For each size, yield the times to compute the eigenbases of two shapes concurrently.

    The times exclude the start of the processes.
    """
    for size in options.sizes:
        pair = creature_pair(vertices=size)
        meshes = [pair.source, pair.target]
        spawned = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(2, spawned, initializer=keep, initargs=(meshes,)) as pool:
            keep(meshes)

            def by_processes(pool=pool) -> object:
                return list(pool.map(eigenbasis_in_one_thread, range(2)))

            seconds = medians(
                {
                    "one": partial(eigenbasis_in_one_thread, 0),
                    "both, in threads": lambda: side_by_side(eigenbasis_of, 0, 1),
                    "both, by two processes": by_processes,
                },
                options.repeats,
            )
        m, n = (len(mesh.vertices) for mesh in meshes)
        yield (
            f"Eigenbases side by side, {m} and {n} vertices",
            f"Wall-clock time of {EIGENVECTORS} eigenpairs for each shape, with one BLAS thread for each "
            "shape.",
            compared(seconds, "one"),
            {"vertices": [m, n], "seconds": seconds},
        )


kept_meshes: list[Mesh] = []
"""The meshes whose eigenbases this process computes."""


def keep(meshes: Sequence[Mesh]) -> None:
    kept_meshes[:] = meshes


def eigenbasis_of(number: int) -> None:
    eigenpairs(kept_meshes[number], EIGENVECTORS)


def eigenbasis_in_one_thread(number: int) -> None:
    with one_blas_thread():
        eigenbasis_of(number)


def stages(options: argparse.Namespace) -> Iterator[Part]:
    """For each size, yield the times of computations on the host for one shape."""
    for size in options.sizes:
        mesh = creature_pair(vertices=size).source
        sources = np.arange(0, len(mesh.vertices), len(mesh.vertices) // 100)
        spread = poisson_disk_samples(mesh, 10_000)
        with tempfile.TemporaryDirectory() as directory:
            file = Path(directory) / "mesh.off"
            write_mesh(file, mesh)
            seconds = medians(
                {
                    "eigenbasis": lambda mesh=mesh: eigenpairs(mesh, EIGENVECTORS, eigensolver="exact"),
                    "10 000 samples": lambda mesh=mesh: poisson_disk_samples(mesh, 10_000),
                    "SHOT of all": lambda mesh=mesh: shot_descriptors(mesh),
                    "SHOT of samples": lambda mesh=mesh, at=spread: shot_descriptors(mesh, samples=at),
                    "farthest points": lambda mesh=mesh: farthest_point_samples(mesh, SAMPLES),
                    "geodesics from 100": lambda mesh=mesh, at=sources: geodesic_distances(mesh, at),
                    "reading OFF": lambda file=file: read_mesh(file),
                },
                3,
                warm=False,
            )
        yield (
            f"Stages, {len(mesh.vertices)} vertices",
            f"k = {EIGENVECTORS}, {SAMPLES} samples.",
            compared(seconds, "eigenbasis"),
            {"vertices": len(mesh.vertices), "seconds": seconds},
        )


class Busy:
    """Processes that keep all cores busy while the context is entered."""

    def __enter__(self) -> None:
        loop = [sys.executable, "-c", "while True: pass"]
        self.processes = [subprocess.Popen(loop) for _ in range(os.cpu_count() or 1)]

    def __exit__(self, *_: object) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def command(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the times of whole commands in new processes, for meshes of 5000 vertices."""
    before, timed = people(options, 2)
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        files = [[str(root / f"{side}_{number}.off") for side in range(2)] for number in range(2)]
        for file, mesh in zip(chain(*files), (*before, *timed), strict=True):
            write_mesh(Path(file), mesh)
        of_before, of_timed = (["match", *of_pair, "--output", str(root / "map.txt")] for of_pair in files)
        paper = ["--preset", "paper"]

        def started(*arguments: str, cache: Path | None = None, own: bool = True) -> Callable[[], object]:
            """Return a function that runs Python, by default with an empty cache.

            With `own` False, only programs are kept from earlier commands.
            """

            def run() -> None:
                for entry in cache.glob("*.npz") if cache and not own else ():
                    if not entry.name.startswith("traced-program-"):
                        entry.unlink()
                with tempfile.TemporaryDirectory() as empty:
                    environment = {**os.environ, "JAXSMW_CACHE": str(cache or empty)}
                    command = [sys.executable, *arguments]
                    subprocess.run(command, check=True, capture_output=True, env=environment)

            return run

        def beside(run: Callable[[], object]) -> Callable[[], object]:
            def busy() -> None:
                with Busy():
                    run()

            return busy

        program = "-m", "jaxsmw"
        kept, of_others = root / "kept", root / "others"
        for extra in ([], paper):
            started(*program, *of_before, *extra, cache=of_others)()
            started(*program, *of_timed, *extra, cache=kept)()
        matches = {
            "first `match`": started(*program, *of_timed),
            "second `match`, other meshes": started(*program, *of_timed, cache=of_others, own=False),
            "second `match`, same meshes": started(*program, *of_timed, cache=kept),
            "first `match --preset paper`": started(*program, *of_timed, *paper),
            "second `match --preset paper`, same meshes": started(*program, *of_timed, *paper, cache=kept),
        }
        others = {
            "`import jax`": started("-c", "import jax"),
            "`import jaxsmw`": started("-c", "import jaxsmw"),
            "`jaxsmw --help`": started(*program, "--help"),
            "`jaxsmw --version`": started(*program, "--version"),
            "first `demo`": started(*program, "demo", "--output", str(root / "demo")),
        }
        busy = {f"{name}, busy": beside(run) for name, run in matches.items()}
        times = medians(matches | others | busy, options.repeats, wall_and_cpu, warm=False)
    rows = [["", "wall seconds", "CPU seconds", "wall seconds beside busy processes", "relative to quiet"]]
    for name in (*matches, *others):
        wall, cpu = times[name]
        row = [name, f"{wall:.2f}", f"{cpu:.2f}", "", ""]
        if beside_busy := times.get(f"{name}, busy"):
            row[3:] = f"{beside_busy[0]:.2f}", f"{beside_busy[0] / wall:.2f}"
        rows.append(row)
    m, n = (len(mesh.vertices) for mesh in timed)
    yield (
        f"Commands, {m} and {n} vertices",
        "Each command ran in a new process. First commands start with an empty cache. Second commands use "
        "the results of an earlier command with other or with the same meshes. One busy process ran for each "
        f"core. Times are medians of {options.repeats} runs.",
        rows,
        {"seconds": times},
    )


def people(options: argparse.Namespace, number: int) -> list[tuple[Mesh, Mesh]]:
    """Return pairs of people of the remeshed FAUST set, or without `--data` of creatures of like size."""
    if options.data is None:
        pairs = (creature_pair(vertices=5000, seed=seed) for seed in range(number))
        return [(pair.source, pair.target) for pair in pairs]
    names = [(f"tr_reg_{i:03}", f"tr_reg_{10 + i:03}") for i in range(number)]
    return [tuple(read_mesh(options.data / "off" / f"{name}.off") for name in pair) for pair in names]


def later_pairs(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the times to match pairs in one process, from arrays to map, after a first pair."""
    first, *others = people(options, 1 + options.repeats)
    rows, measured = [["preset", "wall seconds", "CPU seconds", "shortest", "longest"]], {}
    for preset in ("accurate", "paper"):
        match(*first, preset=preset)
        times = []
        for pair in others:
            arrays = [(mesh.vertices, mesh.faces) for mesh in pair]
            start = wall_and_cpu()
            match(*(make_mesh(*mesh) for mesh in arrays), preset=preset)
            times.append(wall_and_cpu() - start)
        wall, cpu = np.median(times, axis=0)
        walls = [float(time_[0]) for time_ in times]
        rows.append([preset, *(f"{value:.2f}" for value in (wall, cpu, min(walls), max(walls)))])
        measured[preset] = np.array(times).tolist()
    yield (
        "Later pairs",
        f"Times from arrays to map of {len(others)} pairs of about 5000 vertices, in one process and without "
        "a cache, after a first pair. The shortest and the longest time are wall times.",
        rows,
        {"seconds": measured},
    )


class Truth(NamedTuple):
    """Source and target, the vertices of the source with ground truth (r,), and their true matches (r,)."""

    meshes: tuple[Mesh, Mesh]
    rows: Int64[np.ndarray, " r"]
    targets: Int64[np.ndarray, " r"]

    def error(self, pointwise_map: np.ndarray, target: Mesh, number: int | None = None) -> float:
        """Return the mean geodesic error in thousandths of the square root of the target's area.

        The `target` may be subdivided (see `finer`). Each match is replaced by the nearest vertex of the
        target in `meshes`. The error is measured at `number` random vertices; None for all.
        """
        drawn = np.random.default_rng(0).permutation(len(self.rows))[:number]
        coarse, matches = self.meshes[1], pointwise_map[self.rows[drawn]]
        _, nearest = KDTree(coarse.vertices).query(target.vertices[matches])
        distances = geodesic_distances_between(coarse, self.targets[drawn], nearest)
        return 1000 * float(distances.mean()) / coarse.area**0.5


def pair_with_truth(options: argparse.Namespace) -> Truth:
    """Return two people of the remeshed FAUST set if `--data` is given, else two poses of a creature."""
    if options.data is None:
        pair = creature_pair(vertices=SIZES[0])
        return Truth((pair.source, pair.target), np.arange(len(pair.true_map)), pair.true_map)
    return truth_of(options.data, "tr_reg_002", "tr_reg_007")


def truth_of(data: Path, *names: str) -> Truth:
    """Return two people of the remeshed FAUST set."""
    x, y = (read_mesh(data / "off" / f"{name}.off") for name in names)
    rows, targets = (np.loadtxt(data / "corres" / f"{name}.vts", dtype=np.int64) - 1 for name in names)
    return Truth((x, y), rows, targets)


def finer(mesh: Mesh, number_of_vertices: int, *, seed: int = 0) -> Mesh:
    """Split the longest edges of a mesh until it has `number_of_vertices` vertices, and move the vertices.

    The vertices move by random noise, whose standard deviation is 10 % of the mean edge length. The vertices
    of the given mesh keep their indices. A mesh with enough vertices is returned without noise.
    """
    vertices, faces = mesh.vertices, mesh.faces
    while (missing := number_of_vertices - len(vertices)) > 0:
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        edges, edge_of_side = np.unique(sides, axis=0, return_inverse=True)
        lengths = np.linalg.norm(np.diff(vertices[edges], axis=1)[:, 0], axis=1)
        split = np.argsort(-lengths, kind="stable")[:missing]
        middle = np.full(len(edges), -1)
        middle[split] = len(vertices) + np.arange(len(split))
        vertices = np.concatenate([vertices, vertices[edges[split]].mean(axis=1)])
        middles = middle[edge_of_side].reshape(-1, 3)
        faces = np.concatenate([split_faces(faces, middles, number) for number in range(4)])
    if len(vertices) > len(mesh.vertices):
        edge = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean()
        vertices = vertices + 0.1 * edge * np.random.default_rng(seed).standard_normal(vertices.shape)
    return make_mesh(vertices, faces, name=mesh.name)


def split_faces(
    faces: Int64[np.ndarray, "f 3"], middles: Int64[np.ndarray, "f 3"], number: int
) -> Int64[np.ndarray, "g 3"]:
    """Subdivide those faces (f, 3) that have exactly `number` split edges.

    `middles` contains for each corner the new vertex on the edge to the next corner; -1 without a split.
    """
    affected = (middles >= 0).sum(axis=1) == number
    faces, middles = faces[affected], middles[affected]
    # Rotate the corners of each face. If only one edge is split, it becomes the first edge. If only one edge
    # is unsplit, it becomes the last edge.
    first = (np.argmin(middles >= 0, axis=1) + 1) % 3
    if number == 1:
        first = np.argmax(middles, axis=1)
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, turn, axis=1).T
    ab, bc, ca = np.take_along_axis(middles, turn, axis=1).T
    parts = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    return np.concatenate([np.stack(corners, axis=1) for corners in parts[number]])


def peak_memory() -> float:
    """Return the peak memory of this process so far, in GiB."""
    status = Path("/proc/self/status")
    if status.exists():  # the peak of `getrusage` can include the memory of the parent process
        (kilobytes,) = re.findall(r"VmHWM:\s*(\d+) kB", status.read_text("utf-8"))
        return int(kilobytes) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


class FromFiles(NamedTuple):
    """The measurements of a match from two mesh files to the map."""

    seconds: dict[str, float]  # the wall time of each step
    cpu: float  # seconds
    peak: float  # memory of the process in GiB
    maps: tuple[np.ndarray, np.ndarray]  # initial and refined


def matched_from_files(files: list[str], preset: PresetName) -> FromFiles:
    """Match two mesh files, and measure the time of each step and the peak memory of the process."""
    start, start_cpu = time.perf_counter(), time.process_time()
    meshes = [read_mesh(file) for file in files]
    seconds = {"reading": time.perf_counter() - start}
    result = match(*meshes, preset=preset)
    other = time.perf_counter() - start - sum(seconds.values()) - sum(result.seconds.values())
    seconds |= {**result.seconds, "other": other}
    cpu = time.process_time() - start_cpu
    return FromFiles(seconds, cpu, peak_memory(), (result.initial_map, result.pointwise_map))


def in_new_process(cache: Path, function: Callable[..., FromFiles], *arguments: Any) -> FromFiles:
    """Call a function in a new process, which uses the given directory as its cache."""
    before = dict(os.environ)
    os.environ["JAXSMW_CACHE"] = str(cache)
    cache_compiled_programs()  # sets variables that the new process inherits
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
            return executor.submit(function, *arguments).result()
    finally:
        os.environ.clear()
        os.environ.update(before)


def scale(options: argparse.Namespace) -> Iterator[Part]:
    """For each of the presets `paper` and `accurate`, yield times and memory for shapes of several sizes."""
    large = () if options.quick else LARGE
    for preset in ("paper", "accurate"):
        yield scaled(options, preset, (10_000, 30_000, *large))


def scaled(options: argparse.Namespace, preset: PresetName, sizes: Sequence[int]) -> Part:
    """Measure one preset at several sizes, cold and warm."""
    truth = pair_with_truth(options)
    measured: list[dict[str, Any]] = []
    for size in sizes:
        meshes = [finer(mesh, size, seed=size + side) for side, mesh in enumerate(truth.meshes)]
        with tempfile.TemporaryDirectory() as directory:
            files = [str(Path(directory) / f"{side}.ply") for side in range(2)]
            for file, mesh in zip(files, meshes, strict=True):
                write_mesh(Path(file), mesh)
            cold, warm = (
                in_new_process(Path(directory) / "cache", matched_from_files, files, preset) for _ in range(2)
            )
        errors = [truth.error(pointwise_map, meshes[1]) for pointwise_map in cold.maps]
        totals = {}
        for name, run in (("cold", cold), ("warm", warm)):
            totals |= {name: sum(run.seconds.values()), f"{name}, CPU": run.cpu}
        numbers = {"vertices": size, "seconds": cold.seconds, "totals": totals}
        measured.append(numbers | {"peak_gib": cold.peak, "errors": errors})
    # Some stages run only for some sizes, and only then have steps of their own.
    names = [
        list(dict.fromkeys(name for each in measured for name in each[kind]))
        for kind in ("seconds", "totals")
    ]
    columns = [*names[0], *names[1], "peak GiB", "initial error", "refined error"]
    rows = [
        [
            str(each["vertices"]),
            *(f"{each['seconds'].get(name, 0):.1f}" for name in names[0]),
            *(f"{each['totals'][name]:.1f}" for name in names[1]),
            f"{each['peak_gib']:.2f}",
            *(f"{error:.1f}" for error in each["errors"]),
        ]
        for each in measured
    ]

    def exponent(values: list[float]) -> str:
        # The fit leaves out the smallest size, because constant costs dominate the time at this size.
        if min(values[1:]) <= 0:
            return ""
        return f"{np.polyfit(np.log([m['vertices'] for m in measured[1:]]), np.log(values[1:]), 1)[0]:.2f}"

    if len(measured) > 2:
        exponents = [
            exponent([m[kind].get(name, 0) for m in measured])
            for kind, each in zip(("seconds", "totals"), names, strict=True)
            for name in each
        ]
        memory = exponent([m["peak_gib"] for m in measured])
        rows.append(["exponent", *exponents, memory, "", ""])
    return (
        f"Scale, {preset}",
        f"Times of the preset {preset} from two PLY files to the map in seconds, without the start of "
        "Python. Steps are measured cold, with an empty cache. A warm process uses the cache of the cold "
        "process. The peak memory is the memory of the whole cold process. Errors are mean geodesic errors "
        "x10^-3.",
        [["vertices", *columns], *rows],
        {"measured": measured},
    )


def peers(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the times of several libraries to read a pair, to compute eigenbases and to refine a map."""
    truth = pair_with_truth(options)
    missing = [name for name in ("pyFM", "geomfum") if not find_spec(name)]
    if missing:
        print(f"\npeers: {' and '.join(missing)} not installed: install with pip install 'jaxsmw[peers]'.")
    with tempfile.TemporaryDirectory() as directory:
        files = [str(Path(directory) / f"{side}.off") for side in range(2)]
        for file, mesh in zip(files, truth.meshes, strict=True):
            write_mesh(Path(file), mesh)
        # The initial map is computed here, so the times of other libraries do not include its computation.
        pair = Pair(*map(read_mesh, files))
        first = initial_map(pair, *paired_spectra(pair, EIGENVECTORS))
        runs: dict[str, Callable[[list[str]], tuple[np.ndarray, float]]] = {
            "ours": ours_from_files,
            "ours, search in patches": partial(ours_from_files, search="patches"),
            "ours, on samples, in patches": partial(ours_from_files, search="patches", samples=SAMPLES),
        }
        if "pyFM" not in missing:
            runs["pyFM, its defaults"] = pyfm_defaults_from_files
            runs["pyFM, its defaults, ZoomOut on to 100"] = partial(pyfm_defaults_from_files, step=5)
            runs["pyFM, ZoomOut 20 to 100 from our start"] = partial(pyfm_from_files, first=first)
        if "geomfum" not in missing:
            runs["geomfum, ZoomOut 20 to 100 from our start"] = partial(geomfum_from_files, first=first)
        measured: dict[str, dict[str, Any]] = {}
        for turn in range(2 if options.quick else 4):  # the first run of each library includes compilation
            for name, run in runs.items():
                if turn > 1 and name.startswith("geomfum"):
                    continue  # geomfum is timed only once, because each of its runs takes a minute
                start = time.perf_counter()
                pointwise_map, refining = run(files)
                taken = time.perf_counter() - start
                of = measured.setdefault(name, {"all": [], "refining": [], "error": None})
                of["all"].append(taken)
                of["refining"].append(refining)
                of["error"] = truth.error(pointwise_map, truth.meshes[1])
    table = [["", "files to map, seconds", "of ours", "refinement", "of ours", "first time", "error x10^-3"]]
    ours = [float(np.median(measured["ours"][kind][1:])) for kind in ("all", "refining")]
    for name, of in measured.items():
        whole, refining = (float(np.median(of[kind][1:])) for kind in ("all", "refining"))
        table.append(
            [
                name,
                f"{whole:.2f}",
                f"{whole / ours[0]:.1f}",
                f"{refining:.2f}",
                f"{refining / ours[1]:.1f}",
                f"{of['all'][0]:.1f}",
                f"{of['error']:.1f}",
            ]
        )
    m, n = (len(mesh.vertices) for mesh in truth.meshes)
    yield (
        f"Peers, {m} x {n} vertices",
        "Times are medians of runs in one process. Only the first time includes compilation. Our rows use "
        f"k = {EIGENVECTORS} and {ITERATIONS} iterations from SHOT. Rows from our start begin with our "
        "initial map, and leave out the time to compute this map.",
        table,
        {"measured": measured},
    )


def throughput(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the pairs per minute and the errors of several libraries, for pairs of ten meshes of people."""
    if options.data is None:
        print("\nthroughput: left out, because it needs the option --data.")
        return
    names = [f"tr_reg_{number:03}" for number in range(0, 70, 7)]
    pairs = list(permutations(names, 2))
    files = {name: str(options.data / "off" / f"{name}.off") for name in names}
    measured: dict[str, dict[str, Any]] = {}

    def add(name: str, matched: list[tuple[str, str]], maps: list[np.ndarray], seconds: float) -> None:
        truths = [truth_of(options.data, *pair) for pair in matched]
        errors = [truth.error(T, truth.meshes[1], 400) for truth, T in zip(truths, maps, strict=True)]
        measured[name] = {"pairs": len(matched), "seconds": seconds, "errors": errors}

    with tempfile.TemporaryDirectory() as directory:
        for preset in ("accurate", "paper"):
            os.environ["JAXSMW_CACHE"] = str(Path(directory) / preset)
            start = time.perf_counter()
            starts, maps = {}, []  # only the maps are kept, because results contain both spectra
            for pair in tqdm(pairs, f"throughput, {preset}"):
                result = match(*(read_mesh(files[name]) for name in pair), preset=preset)
                starts[pair] = result.initial_map
                maps.append(result.pointwise_map)
            add(f"jaxsmw, {preset}", pairs, maps, time.perf_counter() - start)
        os.environ["JAXSMW_CACHE"] = "off"
    for name, library, run, matched in (
        (
            "pyFM, its defaults, ZoomOut on to 100",
            "pyFM",
            partial(pyfm_defaults_from_files, step=5),
            pairs[::2],
        ),
        ("pyFM, ZoomOut 20 to 100 from our start", "pyFM", pyfm_from_files, pairs[::2]),
        ("geomfum, ZoomOut 20 to 100 from our start", "geomfum", geomfum_from_files, pairs[::6]),
    ):
        if find_spec(library):
            arguments = [([files[x], files[y]], starts[x, y]) for x, y in matched]
            add(name, matched, *in_ten_processes(run, arguments, library))
        else:
            print(f"\nthroughput: {library} not installed: install with pip install 'jaxsmw[peers]'.")
    rows = [["", "pairs", "seconds", "pairs per minute", "error x10^-3"]]
    for name, of in measured.items():
        rate = 60 * of["pairs"] / of["seconds"]
        error = np.mean(of["errors"])
        rows.append([name, str(of["pairs"]), f"{of['seconds']:.0f}", f"{rate:.1f}", f"{error:.1f}"])
    yield (
        "Throughput",
        "Ordered pairs of ten meshes of people, each with about 5000 vertices. jaxsmw runs in one process, "
        "and its times include compilation. Each other library runs in ten processes, and its times leave "
        "out the start of the processes. Errors are measured at 400 points per pair.",
        rows,
        {"measured": measured},
    )


def in_ten_processes(
    run: Callable[..., tuple[np.ndarray, float]], arguments: list[tuple[Any, ...]], library: str
) -> tuple[list[np.ndarray], float]:
    """Call a function in ten processes, each with one BLAS thread.

    **Returns:** The first result of each call, and the seconds of all calls together after the imports.
    """
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(10, spawned, initializer=import_alone, initargs=(library,)) as pool:
        list(pool.map(time.sleep, [5] * 10))  # all processes start
        start = time.perf_counter()
        calls = [pool.submit(run, *of_pair) for of_pair in arguments]
        maps = [call.result()[0] for call in calls]
        return maps, time.perf_counter() - start


def import_alone(library: str) -> None:
    """Import a library, and let BLAS use one thread in this process."""
    import_module(library)
    threadpool_limits(1, "blas")


def ours_from_files(
    files: list[str], search: Search = "auto", samples: int | None = None
) -> tuple[np.ndarray, float]:
    """Match with this library, and return the map and the seconds that refinement takes."""
    refiner = WaveletPreservation(search=search)
    stage = Stage(
        refiner, number_of_eigenvectors=EIGENVECTORS, iterations=ITERATIONS, number_of_samples=samples
    )
    result = match(*map(read_mesh, files), preset=stage)
    return result.pointwise_map, result.seconds["refinement"]


def pyfm_defaults_from_files(
    files: list[str], first: object = None, step: int = 1
) -> tuple[np.ndarray, float]:
    """Match with `pyFM.functional.FunctionalMapping`, its default descriptors, and ZoomOut.

    ZoomOut starts from 50 eigenvectors and takes ten steps, each of which adds `step` eigenvectors. The
    initial map `first` is not used.
    """
    from pyFM.functional import FunctionalMapping
    from pyFM.mesh import TriMesh

    x, y = (TriMesh.load(file) for file in files)
    model = FunctionalMapping(y, x)
    model.preprocess()
    model.fit(verbose=False)
    start = time.perf_counter()
    pointwise_map = model.get_p2p(model.zoomout_refine(step=step))
    return np.asarray(pointwise_map), time.perf_counter() - start


def pyfm_from_files(files: list[str], first: np.ndarray) -> tuple[np.ndarray, float]:
    """Refine an initial map with `pyFM.refine.zoomout_refine` in steps of 5 eigenvectors."""
    from pyFM.mesh import TriMesh
    from pyFM.refine import zoomout_refine
    from pyFM.spectral import p2p_to_FM

    x, y = (TriMesh.load(file).process(k=EIGENVECTORS) for file in files)
    start = time.perf_counter()
    k = EIGENVECTORS - ZOOMOUT_STEPS * 5
    functional_map = p2p_to_FM(first, y.eigenvectors[:, :k], x.eigenvectors[:, :k], A2=x.A)
    _, pointwise_map = zoomout_refine(
        functional_map,
        y.eigenvectors[:, :EIGENVECTORS],
        x.eigenvectors[:, :EIGENVECTORS],
        nit=ZOOMOUT_STEPS,
        step=5,
        A2=x.A,
        return_p2p=True,
        n_jobs=-1,
    )
    return np.asarray(pointwise_map), time.perf_counter() - start


def geomfum_from_files(files: list[str], first: np.ndarray) -> tuple[np.ndarray, float]:
    """Refine an initial map with `geomfum.refine.ZoomOut` in steps of 5 eigenvectors.

    The conversion from pointwise to functional maps uses vertex areas. geomfum's default conversion ignores
    vertex areas, and is slower and less accurate.
    """
    from geomfum.convert import FmFromP2pConverter, P2pFromFmConverter
    from geomfum.laplacian import LaplacianSpectrumFinder
    from geomfum.refine import ZoomOut
    from geomfum.shape import TriangleMesh

    find = LaplacianSpectrumFinder(spectrum_size=EIGENVECTORS)
    x, y = (find(TriangleMesh.from_file(file), as_basis=True, recompute=True) for file in files)
    start = time.perf_counter()
    k = EIGENVECTORS - ZOOMOUT_STEPS * 5
    convert = FmFromP2pConverter(pseudo_inverse=True)
    functional_map = convert(first, y.truncate(k), x.truncate(k))
    refined = ZoomOut(nit=ZOOMOUT_STEPS, step=5, fm_from_p2p_converter=convert)(functional_map, y, x)
    return np.asarray(P2pFromFmConverter()(refined, y, x)), time.perf_counter() - start


# With 16 steps of 5 eigenvectors, ZoomOut goes from 20 to 100 eigenvectors.
ZOOMOUT_STEPS = 16


def draw(numbers: dict[str, Any], file: Path) -> None:
    """Plot the times of `refinement`, `eigenbasis` and `scale`, and the peak memory, against the size."""
    panels: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for part in ("refinement", "eigenbasis"):
        for measured in numbers.get(part, []):
            curves = panels.setdefault(part.capitalize(), {})
            for name, seconds in measured["seconds"].items():
                curves.setdefault(name, []).append((int(np.max(measured["vertices"])), seconds))
    for measured in numbers["scale"][0]["measured"] if numbers.get("scale") else ():
        curves = panels.setdefault("From files to map", {})
        totals = {f"in all, {name}": value for name, value in measured["totals"].items()}
        of_steps = {**measured["seconds"], **totals, "peak memory, GiB": measured["peak_gib"]}
        for name, value in of_steps.items():
            curves.setdefault(name, []).append((measured["vertices"], value))
    if not panels:
        return
    figure, axes = plt.subplots(
        1, len(panels), figsize=(5 * len(panels), 5.5), layout="constrained", squeeze=False
    )
    for axis, (title, curves) in zip(axes[0], panels.items(), strict=True):
        colors: dict[str, str] = {}
        for name, points in curves.items():
            # A dotted line shows a run without our compiler options, or CPU times. The solid line of the same
            # colour shows the run with these options, or wall times.
            usual = name.removesuffix(XLA_DEFAULTS).removesuffix(", CPU")
            color = "black" if "GiB" in name else colors.setdefault(usual, f"C{len(colors)}")
            style = {"color": color, "linestyle": "-" if usual == name else ":", "marker": "o"}
            axis.loglog(*zip(*points, strict=True), label=name, **style)
        axis.set(title=title, xlabel="vertices", ylabel="seconds")
        axis.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    save_figure(file, figure)
    plt.close(figure)


PARTS = {
    part.__name__: part
    for part in (
        refinement,
        eigenbasis,
        side_by_side_eigenbases,
        stages,
        command,
        later_pairs,
        peers,
        throughput,
        scale,
    )
}


def main() -> None:
    parser = make_parser(__doc__, parts=PARTS, faust=True, output="speed")
    parser.add_argument("--quick", action="store_true", help="measure only the smallest sizes")
    options = parser.parse_args()
    options.sizes, options.repeats = (SIZES[:1], 3) if options.quick else (SIZES, 9)
    os.environ["JAXSMW_CACHE"] = "off"

    measure_parts("Speed", PARTS, options, draw)


if __name__ == "__main__":
    main()
