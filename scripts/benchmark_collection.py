"""Compares consistent maps of collections with maps of single pairs, and measures ablations of collections.

    pip install -e ".[benchmark]"
    python scripts/benchmark_collection.py DATA_DIRECTORY faust_r smal_r shrec19_r tosca_nonisometric
    python scripts/benchmark_collection.py DATA_DIRECTORY tosca_r/cat tosca_r/dog
    python scripts/benchmark_collection.py DATA_DIRECTORY primate_molars mouse_mandibles --pairs 40
    python scripts/benchmark_collection.py DATA_DIRECTORY smal_r --ablations
    python scripts/benchmark_collection.py DATA_DIRECTORY faust_r --growth 35 70 140 280

Each data set is matched as one collection. `SET/CLASS` selects the shapes whose names begin with CLASS. The
script draws random ordered pairs (seed 0). For each pair, the script measures the error of the map through
the template, and the error of the map that `jaxsmw.match` returns. Errors are mean geodesic distances to the
ground truth, in thousandths of the square root of the target's area. For sets with landmarks, the error is
the mean distance of carried landmarks to manual landmarks. The unit is then a thousandth of the diagonal of
the target's bounding box. On these sets, the registered mesh of `match` carries the landmarks, as in
`scripts/benchmark_transfer.py`.

`--growth` measures the time and the memory of collections with the given numbers of shapes. The script
decimates the shapes of the data set to about 1500 vertices. If more shapes are needed, each shape is repeated
with other numbers of vertices, so that all triangulations differ.

Finished pairs are kept in OUTPUT, so that an interrupted benchmark can be continued.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import igl
import numpy as np
from common import common_landmarks, make_parser, scan_files
from jaxtyping import Float64
from tqdm import tqdm

from jaxsmw import geodesic_error, make_mesh, match, read_ground_truth, read_mesh
from jaxsmw.benchmark.intervals import mean_interval
from jaxsmw.benchmark.journal import Journal
from jaxsmw.choices import DEFAULT_PRESET, EDGES_PER_SHAPE
from jaxsmw.collection import Collection, match_collection
from jaxsmw.collection.synchronization import vertex_map_between, vertices_as_points
from jaxsmw.errors import InputError
from jaxsmw.geometry import nearest_surface_points
from jaxsmw.geometry.surface_distance import bounding_box_diagonal
from jaxsmw.matching.stages import PRESETS
from jaxsmw.runtime.provenance import made_with
from jaxsmw.transfer import transfer_landmarks

# A pair is counted as lost if its mean error exceeds this number of thousandths.
_LOST = 100
_TRIANGLES = 1000

_DEFAULT = "default"
ABLATIONS: dict[str, tuple[float, dict[str, float]]] = {
    _DEFAULT: (EDGES_PER_SHAPE, {}),
    "2 edges per shape": (2, {}),
    "6 edges per shape": (6, {}),
    "random graph": (EDGES_PER_SHAPE, {"graph._RANDOM_SHARE": 1.0}),
    "no random edges": (EDGES_PER_SHAPE, {"graph._RANDOM_SHARE": 0.0}),
    "best paths alone": (EDGES_PER_SHAPE, {"synchronization._ITERATIONS": 0}),
    "means without robust weights": (EDGES_PER_SHAPE, {"synchronization._ROBUST_SCALE": 1e3}),
    "no second match": (EDGES_PER_SHAPE, {"matching._ROUNDS": 0}),
    "every edge matched again": (
        EDGES_PER_SHAPE,
        {"consistent_maps._CONTRADICTED_FROM": 0.0, "matching._ROUNDS": 1},
    ),
}
"""A dictionary from the name of each ablation to its edges per shape, and to its changed constants."""


def main() -> None:
    """Measure the collections that the command line names, and print a summary of each."""
    parser = make_parser(__doc__, data="DATA_DIRECTORY", output="collections", pairs=200)
    parser.add_argument("sets", nargs="+", metavar="DATA_SET")
    parser.add_argument("--preset", choices=tuple(PRESETS), default=DEFAULT_PRESET)
    parser.add_argument("--ablations", action="store_true", help="also measure all ablations")
    parser.add_argument(
        "--growth", type=int, nargs="+", metavar="N", help="measure N shapes instead of errors"
    )
    parser.add_argument("--no-direct", action="store_true", help="leave out the matches of single pairs")
    options = parser.parse_args()
    for name in options.sets:
        for number in options.growth or ():
            print(f"{name}: {json.dumps(_growth(options.data, name, number))}", flush=True)
        if options.growth:
            continue
        for ablation in ABLATIONS if options.ablations else [_DEFAULT]:
            print(f"{name}, {ablation}: {json.dumps(_measure(options, name, ablation))}", flush=True)
    print(made_with())


def _files(directory: Path, name: str) -> list[Path]:
    data_set, _, prefix = name.partition("/")
    files = [file for file in scan_files(directory / data_set) if file.name.startswith(prefix)]
    if len(files) < 2:
        raise InputError(f"{directory / data_set}: contains {len(files)} meshes: give a data set with two.")
    return files


def _measure(options: argparse.Namespace, name: str, ablation: str) -> dict[str, Any]:
    """Match a collection, and measure the errors of its maps."""
    edges_per_shape, constants = ABLATIONS[ablation]
    direct = ablation == _DEFAULT and not options.no_direct
    files = _files(options.data, name)
    meshes = [read_mesh(file) for file in files]
    place = options.output / name.replace("/", "_")
    work = place / "work"
    work.mkdir(parents=True, exist_ok=True)
    with tqdm() as bar, ExitStack() as changed:
        for constant, value in constants.items():
            changed.enter_context(patch(f"jaxsmw.collection.{constant}", value))

        def progress(step: str, done: int, number: int) -> None:
            bar.total, bar.n = number, done
            bar.set_description(step)

        start = time.perf_counter()
        collection = match_collection(
            meshes,
            names=[file.stem for file in files],
            preset=options.preset,
            edges_per_shape=edges_per_shape,
            directory=work,
            progress=progress,
        )
    seconds = time.perf_counter() - start
    measure = _measure_truth if (files[0].parents[1] / "corres").is_dir() else _measure_landmarks
    pairs = list(itertools.permutations(range(len(files)), 2))
    pairs = [pairs[row] for row in np.random.default_rng(0).permutation(len(pairs))[: options.pairs]]
    journal = Journal(place / "direct.csv", ("source", "target"))
    through, single = [], []
    for i, j in tqdm(pairs, desc="pairs"):
        through.append(measure(collection, files, i, j, None))
        if not direct:
            continue
        key = (files[i].stem, files[j].stem)
        if key not in journal:
            mirrored = bool(collection.mirrored[i] != collection.mirrored[j])
            single_match = match(
                collection.meshes[i],
                collection.meshes[j],
                preset=options.preset,
                mirror="yes" if mirrored else "no",
            )
            error = measure(collection, files, i, j, single_match)
            journal.append([{"source": key[0], "target": key[1], "error": error}])
        single.append(float(journal[key]["error"]))
    result: dict[str, Any] = {
        "shapes": len(files),
        "edges": len(collection.edges),
        "replaced": sum(edge.decision == "replaced" for edge in collection.edges),
        "contradicted": sum(edge.decision == "contradicted" for edge in collection.edges),
        "outliers": [collection.names[shape] for shape in collection.outliers],
        "through_template": _summary(np.array(through)),
        "cycles": _cycles(collection) if ablation == _DEFAULT else {},
        "seconds": seconds,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    if single:
        result["direct"] = _summary(np.array(single))
        result["ratio"] = float(np.mean(through) / np.mean(single))
    if options.ablations and ablation == _DEFAULT:
        points, template = collection.points, collection.meshes[collection.template]
        errors = []
        for i, j in pairs:
            of_pair = points[i], points[j], template, collection.meshes[i], collection.meshes[j]
            unregistered = SimpleNamespace(pointwise_map=vertex_map_between(*of_pair))
            errors.append(_measure_truth(collection, files, i, j, unregistered))
        result["without_registered_meshes"] = _summary(np.array(errors))
    return result


def _growth(directory: Path, name: str, number: int) -> dict[str, Any]:
    """Measure the time and the memory of a collection of small meshes, in a separate process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_matched_growth, _files(directory, name), number).result()


def _matched_growth(files: list[Path], number: int) -> dict[str, Any]:
    meshes = []
    for row, file in zip(range(number), itertools.cycle(files), strict=False):
        mesh = read_mesh(file)
        vertices = 1450 + 7 * row % 80
        positions, faces, *_ = igl.decimate(mesh.vertices, mesh.faces, 2 * vertices)
        meshes.append(make_mesh(positions, faces, name=f"{file.stem} {row}"))
    start, start_cpu = time.perf_counter(), time.process_time()
    collection = match_collection(meshes)
    return {
        "shapes": len(collection.meshes),
        "edges": len(collection.edges),
        "seconds": time.perf_counter() - start,
        "cpu_seconds": time.process_time() - start_cpu,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "seconds_of_steps": collection.seconds,
    }


def _measure_truth(collection: Collection, files: list[Path], i: int, j: int, single: Any) -> float:
    """Return the mean error of a map in thousandths, against ground truth."""
    truth_files = [files[shape].parents[1] / "corres" / f"{files[shape].stem}.vts" for shape in (i, j)]
    truth = read_ground_truth(truth_files, collection.meshes[i], collection.meshes[j])
    pointwise_map = collection.pointwise_map(i, j) if single is None else single.pointwise_map
    return 1e3 * geodesic_error(collection.meshes[j], pointwise_map, truth).mean


def _measure_landmarks(collection: Collection, files: list[Path], i: int, j: int, single: Any) -> float:
    """Return the mean distance of carried landmarks to manual landmarks, in thousandths of the diagonal."""
    marks_x, marks_y = common_landmarks(files[i], files[j])
    if single is None:
        on_source, _ = nearest_surface_points(marks_x.positions, collection.meshes[i])
        on_target = collection.registered[j].project(collection.registered[i].project_back(on_source))
        carried = on_target.positions(collection.meshes[j])
    else:
        carried = transfer_landmarks(marks_x, single.registered_mesh()).landmarks.positions
    distances = np.linalg.norm(carried - marks_y.positions, axis=1)
    return 1e3 * float(distances.mean()) / bounding_box_diagonal(collection.meshes[j])


def _cycles(collection: Collection) -> dict[str, float]:
    """Return the cycle errors of the graph, and of maps through the template for random triples of shapes."""
    generator = np.random.default_rng(0)
    number = len(collection.meshes)
    errors = []
    for _ in range(_TRIANGLES if number > 2 else 0):
        i, j, k = generator.choice(number, 3, replace=False)
        mesh = collection.meshes[i]
        vertex = generator.choice(mesh.referenced_indices, 20)
        points = vertices_as_points(mesh)[vertex]
        for before, after in ((i, j), (j, k), (k, i)):
            points = collection.registered[after].project(collection.registered[before].project_back(points))
        offsets = points.positions(mesh) - mesh.vertices[vertex]
        errors.append(np.linalg.norm(offsets, axis=1).mean() / mesh.area**0.5)
    first, final = collection.cycle_errors
    parts = (("template", errors), ("graph_first", first), ("graph_final", final))
    means = {name: float(1e3 * np.mean(values)) if len(values) else float("nan") for name, values in parts}
    return means | {"template_median": float(1e3 * np.median(errors))}


def _summary(errors: Float64[np.ndarray, " p"]) -> dict[str, float]:
    return {
        **mean_interval(errors, 0)._asdict(),
        "median": float(np.median(errors)),
        "largest": float(errors.max()),
        "lost": int((errors > _LOST).sum()),
    }


if __name__ == "__main__":
    main()
