"""Measures registered meshes of remeshed bodies, and landmarks carried between teeth, jaws and skulls.

    pip install -e ".[benchmark,peers]"
    python scripts/benchmark_transfer.py DATA_DIRECTORY faust_r tosca_r smal_r --output docs/results/transfer
    python scripts/benchmark_transfer.py DATA_DIRECTORY primate_molars --pairs 40 --init shot

Pairs are drawn with seed 0. If a data set has fewer pairs than `--pairs`, the script also matches its pairs
in the reverse direction. Each result is stored in `OUTPUT/DATA_SET.csv` when it is measured. After an
interruption, the same command continues from the stored results. Distances of landmarks are in thousandths of
the diagonal of the target's bounding box.

Four methods carry landmarks from the source to the target:

- the registered mesh;
- the pointwise map alone;
- rigid alignment, and then projection to the nearest point of the target;
- rigid alignment, non-rigid coherent point drift (pycpd), and then the same projection.

Coherent point drift runs with three settings of alpha and beta. Twelve settings were tested on six pairs of
molars and six pairs of mandibles, and these three were the best. Molars of opposite sides are matched with
`mirror="yes"`. For such pairs, all methods use the mirror image of the source.
"""

from __future__ import annotations

import functools
import itertools
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
from common import common_landmarks, make_parser, measure_pairs, scan_files, side_of
from jaxtyping import Float64

from jaxsmw import Mesh, geodesic_error, match, read_ground_truth, read_mesh
from jaxsmw.benchmark.journal import Journal
from jaxsmw.choices import MatchInit
from jaxsmw.errors import InputError
from jaxsmw.geometry import farthest_point_samples, nearest_surface_points
from jaxsmw.geometry.alignment import align_rigidly
from jaxsmw.geometry.surface_distance import bounding_box_diagonal
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.runtime.provenance import made_with
from jaxsmw.transfer import RegisteredMesh, transfer_landmarks

# Rigid alignment and coherent point drift use this number of points of each shape.
_POINTS = 1000


def main() -> None:
    """Measure the data sets that the command line names, and print a summary of each."""
    parser = make_parser(__doc__, data="DATA_DIRECTORY", output="transfer", pairs=20)
    parser.add_argument("sets", nargs="+", metavar="DATA_SET")
    parser.add_argument(
        "--init", choices=get_args(MatchInit), default="auto", help="initial map of scans (default: auto)"
    )
    options = parser.parse_args()
    for name in options.sets:
        measure = _measure_body if name in _BODIES else functools.partial(_measure_scan, init=options.init)
        pairs = _draw(options.data / name, options.pairs)
        journal = measure_pairs(
            options.output / f"{name}.csv",
            pairs,
            lambda pair: (pair[0].stem, pair[1].stem),
            measure,
        )
        print(f"{name}: {_summary(journal)}\n{made_with()}", flush=True)


_BODIES = ("faust_r", "tosca_r", "smal_r")


def _draw(directory: Path, number: int) -> list[tuple[Path, Path]]:
    """Return at most `number` pairs of meshes of a data set, in random order.

    If there are fewer pairs, the same pairs in the reverse direction follow.
    """
    listing = directory / "test_pairs.txt"
    if listing.exists():
        by_name = {file.stem: file for file in directory.rglob("*.off")}
        lines = (line.split() for line in listing.read_text("utf-8").splitlines())
        pairs = [(by_name[Path(x).stem], by_name[Path(y).stem]) for x, y, *_ in lines]
    else:
        pairs = list(itertools.combinations(scan_files(directory), 2))
    if not pairs:
        raise InputError(f"{directory}: contains no meshes: give the directory of the data sets.")
    drawn = [pairs[i] for i in np.random.default_rng(0).permutation(len(pairs))]
    return [*drawn, *((y, x) for x, y in drawn)][:number]


def _measure_body(files: tuple[Path, Path]) -> dict[str, Any]:
    """Measure the errors of the map and of the registered mesh for a pair with ground truth."""
    mesh_x, mesh_y = map(read_mesh, files)
    truth_files = [files[0].parents[1] / "corres" / f"{file.stem}.vts" for file in files]
    truth = read_ground_truth(truth_files, mesh_x, mesh_y)
    correspondence, registered, seconds = _register(mesh_x, mesh_y, mirrored=False)
    points = correspondence.surface_points()
    return {
        "error_of_points": 1e3 * geodesic_error(mesh_y, points, truth).mean,
        "error_of_registered": 1e3 * geodesic_error(mesh_y, registered.surface_points, truth).mean,
        "share_within": float((registered.distances < 0.005 * np.sqrt(mesh_y.area)).mean()),
        "flipped": float(registered.flipped_faces.mean()),
        **seconds,
    }


def _register(
    mesh_x: Mesh, mesh_y: Mesh, *, mirrored: bool, init: MatchInit = "auto"
) -> tuple[Correspondence, RegisteredMesh, dict[str, float]]:
    """Match and register a pair, and measure the time of each of these two steps."""
    start = time.perf_counter()
    correspondence = match(mesh_x, mesh_y, init=init, mirror="yes" if mirrored else "no")
    matched = time.perf_counter()
    registered = correspondence.registered_mesh()
    times = {"match_seconds": matched - start, "transfer_seconds": time.perf_counter() - matched}
    return correspondence, registered, times


def _measure_scan(files: tuple[Path, Path], init: MatchInit) -> dict[str, Any]:
    """Measure the distances of carried landmarks to manual landmarks, by several methods."""
    mesh_x, mesh_y = map(read_mesh, files)
    marks_x, marks_y = common_landmarks(*files)
    mirrored = side_of(files[0]) != side_of(files[1])
    correspondence, registered, seconds = _register(mesh_x, mesh_y, mirrored=mirrored, init=init)
    on_source, off_source = nearest_surface_points(marks_x.positions, mesh_x)
    _, off_target = nearest_surface_points(marks_y.positions, mesh_y)
    hand = np.array([-1.0 if mirrored else 1.0, 1, 1])
    carried = {
        "registered": transfer_landmarks(marks_x, registered).landmarks.positions,
        "map": mesh_y.vertices[correspondence.pointwise_map[on_source.nearest_corners(mesh_x)]],
        **_aligned(mesh_x, mesh_y, marks_x.positions, hand),
    }
    unit = 1e-3 * bounding_box_diagonal(mesh_y)
    row: dict[str, Any] = {"mirrored": mirrored}
    for method, positions in carried.items():
        distances = np.linalg.norm(positions - marks_y.positions, axis=1) / unit
        row |= {f"{method}_mean": distances.mean(), f"{method}_median": float(np.median(distances))}
    noise = (off_source / bounding_box_diagonal(mesh_x) * 1e3).mean(), (off_target / unit).mean()
    return {**row, "manual_noise": float(np.mean(noise)), **seconds}


def _aligned(
    mesh_x: Mesh, mesh_y: Mesh, marks: Float64[np.ndarray, "l 3"], hand: Float64[np.ndarray, " 3"]
) -> dict[str, Float64[np.ndarray, "l 3"]]:
    """Carry landmarks by rigid alignment, without and with subsequent coherent point drift."""
    samples_x = mesh_x.vertices[farthest_point_samples(mesh_x, _POINTS)] * hand
    samples_y = mesh_y.vertices[farthest_point_samples(mesh_y, _POINTS)]
    (middle_x, size_x), (middle_y, size_y) = map(_placement, (samples_x, samples_y))
    x, y = (samples_x - middle_x) / size_x, (samples_y - middle_y) / size_y
    motion = align_rigidly(x, y)
    landmarks = motion.apply((marks * hand - middle_x) / size_x)
    moved = {"rigid": landmarks, **_drifted(motion.apply(x), y, landmarks)}
    placed = {name: positions * size_y + middle_y for name, positions in moved.items()}
    return {name: nearest_surface_points(p, mesh_y)[0].positions(mesh_y) for name, p in placed.items()}


def _placement(points: Float64[np.ndarray, "p 3"]) -> tuple[Float64[np.ndarray, " 3"], float]:
    middle = points.mean(axis=0)
    return middle, float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))


def _drifted(
    x: Float64[np.ndarray, "p 3"], y: Float64[np.ndarray, "p 3"], landmarks: Float64[np.ndarray, "l 3"]
) -> dict[str, Float64[np.ndarray, "l 3"]]:
    """Move landmarks by coherent point drift from x to y, once for each of several settings.

    The landmarks are appended to x, because pycpd moves only the points that it aligns.
    """
    from pycpd import DeformableRegistration

    moved = {}
    for alpha, beta in ((2.0, 2.0), (10.0, 1.0), (200.0, 2.0)):
        points = np.vstack([x, landmarks])
        drift = DeformableRegistration(X=y, Y=points, alpha=alpha, beta=beta, max_iterations=100)
        moved[f"cpd_{alpha:g}_{beta:g}"] = drift.register()[0][len(x) :]
    return moved


def _summary(journal: Journal) -> str:
    """Return the mean of each column, with a 95 % bootstrap interval over the pairs."""
    generator = np.random.default_rng(0)
    texts = []
    for column in journal.rows[0]:
        if column not in ("source", "target", "mirrored"):
            values = np.array([float(row[column]) for row in journal.rows])
            means = values[generator.integers(len(values), size=(1000, len(values)))].mean(axis=1)
            low, high = np.quantile(means, [0.025, 0.975])
            texts.append(f"{column} {values.mean():.4g} ({low:.4g} to {high:.4g})")
    return f"{len(journal.rows)} pairs, " + ", ".join(texts)


if __name__ == "__main__":
    main()
