"""Measures the times and the memory of jaxsmw, with NumPy and with JAX, and those of other libraries.

    python scripts/benchmark_speed.py [--quick] [--rounds N] [--only PART ...] [--data FAUST_R] [--output DIR]

- `commands`: whole commands in new processes, from the start of Python until all files are written. A first
  command has an empty cache. Later commands have the cache of a command with other or with the same meshes.
  Two commands also run beside one busy process for each core.
- `one_process`: pairs in one process, whose shapes are already in the cache. Each pair is matched twice. JAX
  compiles its programs only for the first of these matches, because all pairs have different sizes.
- `memory`: the peak memory of one process that matches 98 pairs of many sizes and measures their errors.
- `peers`: jaxsmw, pyFM and geomfum, from the same mesh files and the same initial map, in one process each,
  with the number of lines that a user writes. The pairs are people and, with `--data`, animals of the set
  `smal_r` beside FAUST_R. Libraries that are not installed (`jaxsmw[peers]`) are left out.
- `scale`: pairs of up to a million vertices. Each size is measured twice, each time in a new process: cold,
  with an empty cache, and warm, with the cache of the first process.
- `refinement`: three iterations with 100 eigenvectors, as in the MWP paper, by NumPy and by JAX. The lower
  bound is the time of three products of an (m x k) and a (k x n) matrix.
- `eigenbasis`: the CPU time of 100 eigenpairs, compared with SciPy's `eigsh` with default settings.
- `stages`: the other computations for one shape, such as SHOT and sampling.

All candidates of a comparison take turns, so that other load on the machine affects them equally. Times are
medians. Without `--data`, all shapes are procedural creatures. With `--data`, `commands`, `one_process`,
`peers` and `scale` use people of the remeshed FAUST set, and `memory` uses pairs of all data sets beside this
set. Large shapes are subdivided and made noisy. The script writes the tables to `speed.md` and all
measurements to `speed.json`. With `--quick`, it measures the smallest sizes once, which takes five minutes.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import multiprocessing
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy.sparse as sp
from common import Part, data_sets, make_parser, measure_parts, medians, memory
from jaxtyping import Int64
from scipy.sparse.linalg import eigsh
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from jaxsmw.benchmark.datasets import DataPair, open_data_set
from jaxsmw.choices import Backend, Eigensolver, PresetName
from jaxsmw.core.refinement import refine, refine_at_once
from jaxsmw.creature import CREATURES, creature_pair
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.evaluation.metrics import geodesic_error
from jaxsmw.geometry.eigenbasis import compute_spectrum, eigenpairs
from jaxsmw.geometry.geodesics import geodesic_distances
from jaxsmw.geometry.laplacian import assemble_laplacian
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.geometry.sampling import farthest_point_samples, poisson_disk_samples
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.io.meshes import read_mesh, write_mesh
from jaxsmw.matching.match import match
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import paired_spectra
from jaxsmw.matching.starts import initial_map
from jaxsmw.runtime.threads import one_blas_thread

# Modules with JAX and Matplotlib are imported where they are used, because new processes import this module
# before their memory is measured.

ITERATIONS, EIGENVECTORS, SAMPLES = 3, 100, 500
SIZES = (7000, 20_000, 50_000)
LARGE = (30_000, 100_000, 300_000, 1_000_000)
# The number of pairs in `memory`, and the numbers of pairs after which the memory is stated.
ASSORTED, STATED = 98, (10, 50, 98)
PRESETS: tuple[PresetName, ...] = ("accurate", "paper")

Result = TypeVar("Result")


def wall_and_cpu() -> np.ndarray:
    """Return the wall time, and the CPU time of this process and its finished children, in seconds."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return np.array([time.perf_counter(), time.process_time() + children.ru_utime + children.ru_stime])


def compared(seconds: dict[str, float], of: str) -> list[list[str]]:
    """Return a table with the time of each candidate in seconds, and relative to the candidate `of`."""
    rows = [[name, f"{value:.3f}", f"{value / seconds[of]:.2f}"] for name, value in seconds.items()]
    return [["", "seconds", f"of {of}"], *rows]


def in_new_process(cache: Path | str, function: Callable[..., Result], *arguments: Any) -> Result:
    """Call a function in a new process, which uses the given directory as its cache."""
    before = os.environ["JAXSMW_CACHE"]
    os.environ["JAXSMW_CACHE"] = str(cache)
    try:
        spawned = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, spawned, warnings.simplefilter, ("ignore",)) as executor:
            return executor.submit(function, *arguments).result()
    finally:
        os.environ["JAXSMW_CACHE"] = before


class KnownPair(NamedTuple):
    """Two meshes with ground truth."""

    meshes: tuple[Mesh, Mesh]
    truth: GroundTruth
    partial: bool = False

    @classmethod
    def of_creatures(cls, kind: str, vertices: int, seed: int) -> KnownPair:
        pair = creature_pair(kind, vertices=vertices, seed=seed)
        return cls((pair.source, pair.target), GroundTruth.of_all_vertices(pair.truth))

    @classmethod
    def read(cls, pair: DataPair) -> KnownPair:
        x, y = (read_mesh(file) for file in pair.meshes)
        return cls((x, y), pair.ground_truth(x, y), pair.partial)

    def error(
        self, pointwise_map: np.ndarray, *, target: Mesh | None = None, number: int | None = None
    ) -> float:
        """Return the mean geodesic error in thousandths of the square root of the target's area.

        If the map is between subdivided meshes (see `finer`), `target` is the subdivided target, and each
        match is replaced by the nearest vertex of the target in `meshes`. The error is measured at `number`
        random vertices; None for all.
        """
        coarse = self.meshes[1]
        if target is not None:
            pointwise_map = KDTree(coarse.vertices).query(target.vertices[pointwise_map])[1]
        return 1000 * geodesic_error(coarse, pointwise_map, self.truth, number_of_samples=number).mean


def known_pairs(options: argparse.Namespace, number: int) -> list[KnownPair]:
    """Return at most nine pairs of about 5000 vertices: people of FAUST if `--data` is given, else creatures.

    Half of the pairs of FAUST are poses of one person.
    """
    if options.data is None:
        return [KnownPair.of_creatures("quadruped", 5000, seed) for seed in range(number)]
    pairs = open_data_set(options.data).known_pairs
    first = range(2, 2 + 7 * number, 7)
    return [KnownPair.read(pairs[f"tr_reg_{i:03}", f"tr_reg_{i + 5:03}"]) for i in first]


def random_pairs(directory: Path, number: int) -> list[KnownPair]:
    """Return random pairs of a data set, among all pairs with ground truth."""
    pairs = [pair for _, pair in sorted(open_data_set(directory).known_pairs.items())]
    rows = np.sort(np.random.default_rng(0).permutation(len(pairs))[:number])
    return [KnownPair.read(pairs[row]) for row in rows]


def assorted_pairs(options: argparse.Namespace) -> Iterator[KnownPair]:
    """Yield pairs of all data sets in turn, in the directory that contains FAUST_R, or else of creatures."""
    random = np.random.default_rng(0)
    if options.data is None:
        sizes = random.permutation(np.geomspace(1000, 20_000, ASSORTED)).astype(int)
        for seed, size in enumerate(sizes):
            yield KnownPair.of_creatures([*CREATURES][seed % len(CREATURES)], int(size), seed)
        return
    shuffled = [
        [data_set.pairs[number] for number in random.permutation(len(data_set.pairs))]
        for data_set in data_sets(options.data.resolve().parent)
    ]
    for pair in chain.from_iterable(zip_longest(*shuffled)):
        if pair is not None:
            yield KnownPair.read(pair)


def written(meshes: Sequence[Mesh], directory: Path, suffix: str = ".off") -> list[str]:
    """Write the meshes of a pair into a new directory, and return their files."""
    directory.mkdir()
    files = [str(directory / f"{side}{suffix}") for side in ("source", "target")]
    for file, mesh in zip(files, meshes, strict=True):
        write_mesh(file, mesh)
    return files


class Busy(AbstractContextManager):
    """Processes that keep all cores busy while the context is entered."""

    def __enter__(self) -> None:
        loop = [sys.executable, "-c", "while True: pass"]
        self.processes = [subprocess.Popen(loop) for _ in range(os.cpu_count() or 1)]

    def __exit__(self, *_: object) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def run_python(arguments: Sequence[str], cache: Path, kept: Path | None = None) -> np.ndarray:
    """Run Python in a new process, and return its wall and CPU seconds.

    `cache` is the cache directory, which is emptied first. With `kept`, it contains a copy of that directory.
    """
    shutil.rmtree(cache, ignore_errors=True)
    if kept is not None:
        shutil.copytree(kept, cache)
    start = wall_and_cpu()
    environment = {**os.environ, "JAXSMW_CACHE": str(cache)}
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=environment)
    return wall_and_cpu() - start


def commands(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the times of whole commands in new processes, for meshes of 5000 vertices."""
    timed, other = known_pairs(options, 2)
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        files, of_others = (written(pair.meshes, root / str(i)) for i, pair in enumerate((timed, other)))
        # All commands have the same cache directory, because JAX finds a program only in the directory where
        # it was stored.
        cache, program, output = root / "cache", ["-m", "jaxsmw"], ["--output", str(root / "output")]
        # Each candidate has a command, the cache that an earlier command left, and busy processes beside it.
        candidates: dict[str, tuple[list[str], Path | None, AbstractContextManager]] = {}
        for name, extra in {
            "`match`": [],
            "`match --backend jax`": ["--backend", "jax"],
            "`match --preset paper`": ["--preset", "paper"],
        }.items():
            match_timed, match_others = (
                [*program, "match", *of_pair, *extra, *output] for of_pair in (files, of_others)
            )
            same, others = (root / f"{name}, {kind} meshes" for kind in ("same", "other"))
            for command, copy in ((match_timed, same), (match_others, others)):
                run_python(command, cache)
                shutil.copytree(cache, copy)
            candidates |= {
                f"{name}, first": (match_timed, None, nullcontext()),
                f"{name}, other meshes": (match_timed, others, nullcontext()),
                f"{name}, same meshes": (match_timed, same, nullcontext()),
            }
            if not extra:
                candidates |= {
                    f"{name}, first, beside busy processes": (match_timed, None, Busy()),
                    f"{name}, same meshes, beside busy processes": (match_timed, same, Busy()),
                }
        other_commands = {
            "`demo`": [*program, "demo", "--output", str(root / "demo")],
            "`--help`": [*program, "--help"],
            "`import jaxsmw`": ["-c", "import jaxsmw"],
            "`import jax`": ["-c", "import jax"],
        }
        candidates |= {name: (command, None, nullcontext()) for name, command in other_commands.items()}
        times: dict[str, list[np.ndarray]] = {name: [] for name in candidates}
        for _ in range(options.rounds):
            for name, (command, kept, beside) in candidates.items():
                with beside:
                    times[name].append(run_python(command, cache, kept))
    seconds = {name: np.median(of_rounds, axis=0).tolist() for name, of_rounds in times.items()}
    rows = [["", "wall seconds", "CPU seconds", "wall seconds, relative to quiet"]]
    for name, (wall, cpu) in seconds.items():
        quiet = name.removesuffix(", beside busy processes")
        relative = "" if quiet == name else f"{wall / seconds[quiet][0]:.2f}"
        rows.append([name, f"{wall:.2f}", f"{cpu:.2f}", relative])
    m, n = (len(mesh.vertices) for mesh in timed.meshes)
    yield (
        f"Commands, {m} and {n} vertices",
        "Each command ran in a new process. A first command has an empty cache, and so do the last four. "
        "Other commands have the cache of a command with other meshes or with the same meshes. One busy "
        f"process ran for each core. Times are medians of {options.rounds} rounds.",
        rows,
        {"seconds": seconds},
    )


def one_process(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the times of pairs in one process, whose shapes are already in the cache."""
    pairs = known_pairs(options, max(2, options.rounds))
    rows, measured = [["preset", "backend", "", "wall s", "CPU s", "shortest", "longest"]], {}
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        files = [written(pair.meshes, root / str(number)) for number, pair in enumerate(pairs)]
        for preset in PRESETS:
            for backend in ("numpy", "jax"):
                times = in_new_process(root / "cache", matched_twice, files, preset, backend)
                for name, of_pairs in zip(("sizes are new", "same pair again"), times, strict=True):
                    wall, cpu = np.median(of_pairs, axis=0)
                    walls = [of_pair[0] for of_pair in of_pairs]
                    numbers = (f"{value:.2f}" for value in (wall, cpu, min(walls), max(walls)))
                    rows.append([preset, backend, name, *numbers])
                measured[f"{preset}, {backend}"] = times
    yield (
        "One process, shapes kept",
        f"Times from arrays to map of {len(pairs)} pairs of about 5000 vertices in one process. The cache "
        "contains all shapes. Times are medians; the last two columns are wall times.",
        rows,
        {"seconds": measured},
    )


def matched_twice(
    files: list[list[str]], preset: PresetName, backend: Backend
) -> tuple[list[list[float]], list[list[float]]]:
    """Match pairs of known shapes twice. Return wall and CPU seconds of the first and second matches."""
    pairs = [[read_mesh(file) for file in of_pair] for of_pair in files]
    for pair in pairs:
        match(*pair, preset=preset, backend="numpy")  # fills the cache
    first: list[list[float]] = []
    again: list[list[float]] = []
    # The pairs are new, because each source is matched to the target of the next pair.
    for (source, _), (_, target) in zip(pairs, [*pairs[1:], pairs[0]], strict=True):
        for times in (first, again):
            arrays = [(mesh.vertices, mesh.faces) for mesh in (source, target)]
            start = wall_and_cpu()
            match(*(make_mesh(*mesh) for mesh in arrays), preset=preset, backend=backend)
            times.append((wall_and_cpu() - start).tolist())
    return first, again


def memory_of_many(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the memory of one process that matches many pairs of many sizes."""
    number = 4 if options.quick else ASSORTED
    with tempfile.TemporaryDirectory() as cache:
        history = in_new_process(cache, matched_assorted, options, number)
    rows = [["pairs", "peak memory, GiB", "memory, GiB", "mean error x10^-3", "median", "seconds per pair"]]
    for stated in sorted({min(number, stated) for stated in STATED}):
        seen = np.array(history[:stated])
        error, median, seconds = seen[:, 2].mean(), np.median(seen[:, 2]), np.median(seen[:, 3])
        peak, resident = seen[-1, :2]
        rows.append(
            [str(stated), f"{peak:.2f}", f"{resident:.2f}", f"{error:.1f}", f"{median:.1f}", f"{seconds:.2f}"]
        )
    sizes = [size for *_, size in history]
    yield (
        "Memory of many pairs",
        f"{number} pairs whose larger mesh has {min(sizes)} to {max(sizes)} vertices, matched by the preset "
        "accurate in one process. Errors are measured in the same process, at 400 points per pair.",
        rows,
        {"history": history},
    )


def matched_assorted(options: argparse.Namespace, number: int) -> list[list[float]]:
    """Match assorted pairs. Return peak and memory in GiB, error, seconds and vertices of each pair."""
    history = []
    for pair in islice(assorted_pairs(options), number):
        start = time.perf_counter()
        pointwise_map = match(*pair.meshes, partial=pair.partial).pointwise_map
        seconds = time.perf_counter() - start
        error = pair.error(pointwise_map, number=400)
        size = max(len(mesh.vertices) for mesh in pair.meshes)
        history.append([memory("VmHWM"), memory("VmRSS"), error, seconds, size])
    return history


def peers(options: argparse.Namespace) -> Iterator[Part]:
    """Yield the times and errors of several libraries, from the same mesh files and initial maps."""
    number = 2 if options.quick else 12
    if options.data is None:
        yield compared_peers("creatures", known_pairs(options, number))
        return
    for directory in (options.data, options.data.resolve().with_name("smal_r")):
        yield compared_peers(directory.name, random_pairs(directory, number))


def compared_peers(name_of_set: str, pairs: list[KnownPair]) -> Part:
    columns = ["lines", "first pair, wall s", "later pairs, wall s", "CPU s", "of ours", "refinement, s"]
    rows, measured, first = [["", *columns, "error x10^-3", "median"]], {}, 0.0
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        files = [written(pair.meshes, root / str(number)) for number, pair in enumerate(pairs)]
        starts = []
        for of_pair in files:
            mesh_x, mesh_y = map(read_mesh, of_pair)
            pair = Pair(mesh_x, mesh_y)
            starts.append(initial_map(pair, *paired_spectra(pair, EIGENVECTORS)))
        for name, (library, refined_from_files, *settings) in LIBRARIES.items():
            if not find_spec(library):
                print(f"\npeers: {library} is not installed: install it with pip install 'jaxsmw[peers]'.")
                continue
            arguments = library, refined_from_files, settings, files, starts
            times, maps = in_new_process("off", timed_library, *arguments)
            errors = [pair.error(found, number=1000) for pair, found in zip(pairs, maps, strict=True)]
            wall, cpu, refining = np.median(times[1:], axis=0)
            measured[name] = {"seconds": times, "errors": errors}
            first = first or cpu  # the first candidate is ours
            lines = str(lines_of_code(refined_from_files))
            seconds = [f"{value:.2f}" for value in (times[0][0], wall, cpu, refining)]
            seconds.insert(3, f"{cpu / first:.1f}")
            rows.append([name, lines, *seconds, f"{np.mean(errors):.1f}", f"{np.median(errors):.1f}"])
    return (
        f"Peers, {name_of_set}",
        f"Times from two mesh files of about 5000 vertices to the map, for {len(pairs)} pairs, each library "
        "in one process, without a cache. Initial maps are given, except to pyFM with its defaults. Later "
        "pairs are medians. Errors are means over 1000 points, and over the pairs. Lines are those of the "
        "user's program from files to map, with imports.",
        rows,
        {"measured": measured},
    )


def lines_of_code(function: Callable[..., object]) -> int:
    """Return the number of lines of a function's statements, without its docstring and its stopwatch."""
    (definition,) = ast.parse(inspect.getsource(function)).body
    assert isinstance(definition, ast.FunctionDef)
    kept = [
        one
        for one in definition.body
        if not isinstance(one, ast.Expr) or not isinstance(one.value, ast.Constant)
        if "begin" not in {name.id for name in ast.walk(one) if isinstance(name, ast.Name)}
        or isinstance(one, ast.Return)
    ]
    return sum((one.end_lineno or one.lineno) - one.lineno + 1 for one in kept)


# A method returns its map and the seconds of its refinement.
Refined = tuple[np.ndarray, float]


def timed_library(
    library: str,
    refined_from_files: Callable[..., Refined],
    settings: list[Any],
    files: list[list[str]],
    starts: list[np.ndarray],
) -> tuple[list[list[float]], list[np.ndarray]]:
    """Match pairs. Return the wall, CPU and refinement seconds of each pair, and the maps."""
    for module in {"pyFM": ("mesh", "functional", "refine", "spectral"), "geomfum": ("refine", "shape")}.get(
        library, ()
    ):
        import_module(f"{library}.{module}")
    times, maps = [], []
    for of_pair, start in zip(files, starts, strict=True):
        begin = wall_and_cpu()
        pointwise_map, refining = refined_from_files(of_pair, start, *settings)
        times.append([*(wall_and_cpu() - begin).tolist(), refining])
        maps.append(np.asarray(pointwise_map))
    return times, maps


def ours_from_files(files: list[str], start: np.ndarray, preset: PresetName, backend: Backend) -> Refined:
    import jaxsmw

    result = jaxsmw.match(*map(jaxsmw.read_mesh, files), preset=preset, init=start, backend=backend)
    return result.pointwise_map, result.seconds["refinement"]


def pyfm_defaults_from_files(files: list[str], _: np.ndarray) -> Refined:
    """Match with pyFM's default descriptors, and ten steps of ZoomOut from 50 eigenvectors."""
    from pyFM.functional import FunctionalMapping
    from pyFM.mesh import TriMesh

    x, y = (TriMesh.load(file) for file in files)
    model = FunctionalMapping(y, x)
    model.preprocess()
    model.fit(verbose=False)
    begin = time.perf_counter()
    return model.get_p2p(model.zoomout_refine(step=1)), time.perf_counter() - begin


# With 16 steps of 5 eigenvectors, ZoomOut goes from 20 to 100 eigenvectors.
STEPS, STEP = 16, 5


def pyfm_from_files(files: list[str], start: np.ndarray) -> Refined:
    from pyFM.mesh import TriMesh
    from pyFM.refine import zoomout_refine
    from pyFM.spectral import p2p_to_FM

    x, y = (TriMesh.load(file).process(k=EIGENVECTORS) for file in files)
    begin = time.perf_counter()
    k = EIGENVECTORS - STEPS * STEP
    functional_map = p2p_to_FM(start, y.eigenvectors[:, :k], x.eigenvectors[:, :k], A2=x.A)
    bases = (shape.eigenvectors[:, :EIGENVECTORS] for shape in (y, x))
    _, pointwise_map = zoomout_refine(
        functional_map, *bases, nit=STEPS, step=STEP, A2=x.A, return_p2p=True, n_jobs=-1
    )
    return pointwise_map, time.perf_counter() - begin


def geomfum_from_files(files: list[str], start: np.ndarray) -> Refined:
    """Refine by geomfum's ZoomOut with vertex areas.

    Its default ignores vertex areas, and is slower and less accurate.
    """
    from geomfum.convert import FmFromP2pConverter, P2pFromFmConverter
    from geomfum.laplacian import LaplacianSpectrumFinder
    from geomfum.refine import ZoomOut
    from geomfum.shape import TriangleMesh

    find = LaplacianSpectrumFinder(spectrum_size=EIGENVECTORS)
    x, y = (find(TriangleMesh.from_file(file), as_basis=True, recompute=True) for file in files)
    begin = time.perf_counter()
    k = EIGENVECTORS - STEPS * STEP
    convert = FmFromP2pConverter(pseudo_inverse=True)
    functional_map = convert(start, y.truncate(k), x.truncate(k))
    refined = ZoomOut(nit=STEPS, step=STEP, fm_from_p2p_converter=convert)(functional_map, y, x)
    return P2pFromFmConverter()(refined, y, x), time.perf_counter() - begin


# The package, the method, and the method's further arguments.
LIBRARIES: dict[str, tuple[Any, ...]] = {
    "jaxsmw, paper, NumPy": ("jaxsmw", ours_from_files, "paper", "numpy"),
    "jaxsmw, paper, JAX": ("jaxsmw", ours_from_files, "paper", "jax"),
    "jaxsmw, accurate, NumPy": ("jaxsmw", ours_from_files, "accurate", "numpy"),
    "pyFM, its defaults": ("pyFM", pyfm_defaults_from_files),
    "pyFM, ZoomOut 20 to 100": ("pyFM", pyfm_from_files),
    "geomfum, ZoomOut 20 to 100": ("geomfum", geomfum_from_files),
}


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


class FromFiles(NamedTuple):
    """The measurements of a match from two mesh files to the map."""

    seconds: dict[str, float]  # the wall time of each step
    cpu: float  # seconds
    peak: float  # memory of the process in GiB
    maps: tuple[np.ndarray, np.ndarray]  # initial and refined


def matched_from_files(files: list[str], preset: PresetName) -> FromFiles:
    """Match two mesh files, and measure the time of each step and the peak memory of the process."""
    start = wall_and_cpu()
    meshes = [read_mesh(file) for file in files]
    seconds = {"reading": float((wall_and_cpu() - start)[0])}
    result = match(*meshes, preset=preset)
    wall, cpu = (wall_and_cpu() - start).tolist()
    seconds |= result.seconds
    seconds["other"] = wall - sum(seconds.values())
    return FromFiles(seconds, cpu, memory("VmHWM"), (result.initial_map, result.pointwise_map))


def scale(options: argparse.Namespace) -> Iterator[Part]:
    """For each preset, yield times and memory for shapes of several sizes, cold and warm."""
    (pair,) = known_pairs(options, 1)
    sizes = (10_000,) if options.quick else LARGE
    for preset in PRESETS:
        runs: list[list[FromFiles]] = []  # cold and warm
        errors: list[list[float]] = []
        for size in sizes:
            meshes = [finer(mesh, size, seed=size + side) for side, mesh in enumerate(pair.meshes)]
            with tempfile.TemporaryDirectory() as directory:
                files = written(meshes, Path(directory) / "meshes", ".ply")
                cache = Path(directory) / "cache"
                runs.append([in_new_process(cache, matched_from_files, files, preset) for _ in range(2)])
            errors.append([pair.error(of_run, target=meshes[1]) for of_run in runs[-1][0].maps])
        steps = list(dict.fromkeys(chain.from_iterable(cold.seconds for cold, _ in runs)))
        totals = ["cold, wall", "CPU", "warm, wall", "CPU"]
        rows = [["vertices", *steps, *totals, "peak GiB", "initial error", "refined error"]]
        measured = []
        for size, (cold, warm), of_size in zip(sizes, runs, errors, strict=True):
            both = [[sum(run.seconds.values()), run.cpu] for run in (cold, warm)]
            seconds = (*(cold.seconds.get(step, 0) for step in steps), *chain(*both))
            numbers = [*(f"{value:.1f}" for value in seconds), f"{max(cold.peak, warm.peak):.2f}"]
            rows.append([str(size), *numbers, *(f"{error:.1f}" for error in of_size)])
            measured.append(
                {
                    "vertices": size,
                    "seconds": cold.seconds,
                    "cold and warm": both,
                    "peak GiB": [cold.peak, warm.peak],
                    "errors": of_size,
                }
            )
        yield (
            f"Scale, {preset}",
            f"Times of the preset {preset} from two PLY files to the map in seconds, without the start of "
            "Python. The steps are those of the cold process, which has an empty cache. The warm process "
            "has the cache of the cold one. Errors are mean geodesic errors x10^-3.",
            rows,
            {"measured": measured},
        )


def refinement(options: argparse.Namespace) -> Iterator[Part]:
    """For each size, yield the times to refine one pair by NumPy and by JAX."""
    import jax
    import jax.numpy as jnp

    from jaxsmw.runtime.compilation import compiled

    for size in options.sizes:
        pair = creature_pair(vertices=size)
        meshes = pair.source, pair.target
        spectra = [compute_spectrum(mesh, EIGENVECTORS, eigensolver="exact") for mesh in meshes]
        start = initial_map(Pair(*meshes), *spectra, init="wks")
        samples = tuple(farthest_point_samples(mesh, SAMPLES) for mesh in meshes)
        of_numpy = jax.tree.map(np.asarray, (*spectra, start))
        of_jax = jax.tree.map(jnp.asarray, (*spectra, start))

        def once(run: Callable, arguments: tuple, samples: tuple | None = None) -> Callable[[], Any]:
            def refined() -> Any:
                with one_blas_thread():  # `match` also limits BLAS to one thread
                    return run(*arguments, iterations=ITERATIONS, samples=samples)

            return refined

        def products(
            a: np.ndarray = of_numpy[0].eigenvectors, b: np.ndarray = of_numpy[1].eigenvectors.T
        ) -> None:
            # Each block of products fits into the processor's cache. Only the maximum of each row is kept.
            for row in range(0, ITERATIONS * len(a), 256):
                (a[row % len(a) :][:256] @ b).max(axis=1)

        by_jax = once(compiled(refine), of_jax)
        begin = time.perf_counter()
        jax.block_until_ready(by_jax())
        first = time.perf_counter() - begin
        candidates = {
            "matrix products alone": products,
            "NumPy": once(refine_at_once, of_numpy),
            "NumPy, on samples": once(refine_at_once, of_numpy, samples),
            "JAX": by_jax,
            "JAX, on samples": once(compiled(refine), of_jax, tuple(map(jnp.asarray, samples))),
        }
        seconds = medians(candidates, options.rounds)
        m, n = (len(mesh.vertices) for mesh in meshes)
        yield (
            f"Refinement, {m} x {n} vertices",
            f"k = {EIGENVECTORS}, {ITERATIONS} iterations, float32. The first refinement by JAX took "
            f"{first:.2f} s, because it was compiled.",
            compared(seconds, "matrix products alone"),
            {"vertices": [m, n], "seconds": seconds, "first": first},
        )


def eigenbasis(options: argparse.Namespace) -> Iterator[Part]:
    """For each size, yield the CPU times of several eigensolvers on one shape."""
    for size in [*options.sizes, *([] if options.quick else [100_000])]:
        mesh = finer(creature_pair(vertices=min(size, SIZES[-1])).source, size)
        stiffness, areas = assemble_laplacian(mesh)
        masses = sp.diags(areas / areas.sum()).tocsc()

        def usual(stiffness: sp.csc_matrix = stiffness, masses: sp.csc_matrix = masses) -> object:
            with threadpool_limits(1, "blas"):
                return eigsh(stiffness, EIGENVECTORS, masses, sigma=-1e-2)

        def ours(solver: Eigensolver, mesh: Mesh = mesh) -> np.ndarray:
            return eigenpairs(mesh, EIGENVECTORS, eigensolver=solver)[0]

        candidates: dict[str, Callable[[], object]] = {
            "SciPy's eigsh": usual,
            "exact": partial(ours, "exact"),
            "approximate": partial(ours, "approximate"),
        }
        seconds = medians(candidates, options.rounds, time.process_time, warm=False)
        excess = ours("approximate")[1:] / ours("exact")[1:] - 1
        yield (
            f"Eigenbasis, {len(mesh.vertices)} vertices",
            f"{EIGENVECTORS} eigenpairs, one thread, CPU time. Our times include the assembly of the "
            f"Laplacian and a check of the result. Approximate eigenvalues are {excess.mean():.2%} too large "
            f"on average, and at most {excess.max():.2%} too large.",
            compared(seconds, "SciPy's eigsh"),
            {"vertices": len(mesh.vertices), "seconds": seconds, "excess": excess.tolist()},
        )


def stages(options: argparse.Namespace) -> Iterator[Part]:
    """For each size, yield the times of computations on the host for one shape."""
    for size in options.sizes:
        mesh = creature_pair(vertices=size).source
        sources = np.arange(0, len(mesh.vertices), len(mesh.vertices) // 100)
        spread = poisson_disk_samples(mesh, 10_000)
        with tempfile.TemporaryDirectory() as directory:
            file = Path(directory) / "mesh.off"
            write_mesh(file, mesh)
            candidates: dict[str, Callable[[], object]] = {
                "eigenbasis": partial(eigenpairs, mesh, EIGENVECTORS, eigensolver="exact"),
                "10 000 samples": partial(poisson_disk_samples, mesh, 10_000),
                "SHOT of all": partial(shot_descriptors, mesh),
                "SHOT of samples": partial(shot_descriptors, mesh, samples=spread),
                "farthest points": partial(farthest_point_samples, mesh, SAMPLES),
                "geodesics from 100": partial(geodesic_distances, mesh, sources),
                "reading OFF": partial(read_mesh, file),
            }
            seconds = medians(candidates, options.rounds, warm=False)
        yield (
            f"Stages, {len(mesh.vertices)} vertices",
            f"k = {EIGENVECTORS}, {SAMPLES} samples.",
            compared(seconds, "eigenbasis"),
            {"vertices": len(mesh.vertices), "seconds": seconds},
        )


PARTS = {
    "commands": commands,
    "one_process": one_process,
    "memory": memory_of_many,
    "peers": peers,
    "scale": scale,
    "refinement": refinement,
    "eigenbasis": eigenbasis,
    "stages": stages,
}


def main() -> None:
    parser = make_parser(__doc__, parts=PARTS, faust=True, output="speed")
    parser.add_argument("--quick", action="store_true", help="measure only the smallest sizes, once")
    parser.add_argument("--rounds", type=int, default=5, help="runs of each candidate (default: %(default)s)")
    options = parser.parse_args()
    options.sizes = SIZES
    if options.quick:
        options.sizes, options.rounds = SIZES[:1], 1
    os.environ["JAXSMW_CACHE"] = "off"
    measure_parts("Speed", PARTS, options)


if __name__ == "__main__":
    main()
