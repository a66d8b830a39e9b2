"""Measures landmarks carried between teeth, jaws and skulls, by jaxsmw and by other methods.

    pip install -e ".[benchmark,peers]"
    python scripts/benchmark_landmarks.py DATA_DIRECTORY mouse_mandibles mouse_skulls primate_molars

Pairs are drawn with seed 0. If a data set has fewer pairs than `--pairs`, the script also matches its pairs
in the reverse direction. Each result is stored in `OUTPUT/DATA_SET_GROUP.csv` when it is measured. After an
interruption, the same command continues from the stored results. Distances to the manual landmarks are in
thousandths of the diagonal of the target's bounding box, and in the unit of the files.

Two groups of methods carry landmarks from the source to the target (`--only` chooses one):

- `jaxsmw`: the registered mesh, and the pointwise map alone.
- `opponents`: rigid alignment, and coherent point drift (CPD) by rustcpd 4. The rigid alignment is the best
  of 24 rigid CPDs from the rotations of a cube. Non-rigid CPD follows with each of eight settings of alpha
  and beta. The points are projected to the target. The summary names the best setting on these pairs, which
  favours CPD.

Teeth of opposite sides are matched with `mirror="yes"`. For such pairs, the opponents align the mirror image
of the source.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from common import common_landmarks, draw_scans, make_parser, measure_pairs, side_of
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxsmw import Mesh, match, read_mesh
from jaxsmw.benchmark.intervals import mean_interval
from jaxsmw.benchmark.journal import Journal
from jaxsmw.choices import MatchInit
from jaxsmw.geometry import farthest_point_samples, nearest_surface_points
from jaxsmw.geometry.surface_distance import bounding_box_diagonal
from jaxsmw.io.landmarks import Landmarks
from jaxsmw.runtime.provenance import made_with
from jaxsmw.transfer import transfer_landmarks

# The number of points of each shape that are aligned from all rotations, and that drift.
_ALIGNED, _DRIFTED = 300, 1000
# The strengths of regularisation, and the widths of kernels, in units of the root mean square radius.
_ALPHAS, _BETAS = (2.0, 10.0, 50.0, 200.0), (1.0, 2.0)


def main() -> None:
    """Measure the data sets that the command line names, and print a summary of each."""
    parser = make_parser(__doc__, data="DATA_DIRECTORY", output="landmarks", pairs=40)
    parser.add_argument("sets", nargs="+", metavar="DATA_SET")
    parser.add_argument("--only", choices=_GROUPS, help="one group of methods (default: both)")
    parser.add_argument(
        "--init", choices=get_args(MatchInit), default="auto", help="jaxsmw's initial map (default: auto)"
    )
    options = parser.parse_args()
    for name, group in itertools.product(options.sets, [options.only] if options.only else _GROUPS):
        methods = partial(_jaxsmw, init=options.init) if group == "jaxsmw" else _opponents
        journal = measure_pairs(
            options.output / f"{name}_{group}.csv",
            draw_scans(options.data / name, options.pairs),
            lambda pair: (pair[0].stem, pair[1].stem),
            partial(_measure, methods),
        )
        print(f"{name}, {group}: {_summary(journal)}\n{made_with()}", flush=True)


Carried = dict[str, tuple[Float64[np.ndarray, "l 3"], float]]
"""For each method, the landmarks on the target, and the seconds that the method took."""


def _measure(
    methods: Callable[[Mesh, Mesh, Landmarks, bool], Carried], files: tuple[Path, Path]
) -> dict[str, Any]:
    """Measure the mean distance of carried landmarks to manual landmarks, for each method of a group."""
    mesh_x, mesh_y = map(read_mesh, files)
    marks_x, marks_y = common_landmarks(*files)
    mirrored = side_of(files[0]) != side_of(files[1])
    diagonal = bounding_box_diagonal(mesh_y)
    row: dict[str, Any] = {"mirrored": mirrored, "diagonal": diagonal}
    for method, (positions, seconds) in methods(mesh_x, mesh_y, marks_x, mirrored).items():
        distances = np.linalg.norm(positions - marks_y.positions, axis=1)
        row |= {method: 1e3 * distances.mean() / diagonal, f"{method}_seconds": seconds}
    return row


def _jaxsmw(mesh_x: Mesh, mesh_y: Mesh, marks: Landmarks, mirrored: bool, init: MatchInit) -> Carried:
    start = time.perf_counter()
    correspondence = match(mesh_x, mesh_y, init=init, mirror="yes" if mirrored else "no")
    matched = time.perf_counter()
    registered = transfer_landmarks(marks, correspondence.registered_mesh()).landmarks.positions
    transferred = time.perf_counter()
    corners = nearest_surface_points(marks.positions, mesh_x)[0].nearest_corners(mesh_x)
    alone = mesh_y.vertices[correspondence.pointwise_map[corners]]
    return {"registered": (registered, transferred - start), "map": (alone, matched - start)}


def _opponents(mesh_x: Mesh, mesh_y: Mesh, marks: Landmarks, mirrored: bool) -> Carried:
    from rustcpd import register_deformable

    hand = np.array([-1.0 if mirrored else 1.0, 1, 1])
    samples_x = mesh_x.vertices[farthest_point_samples(mesh_x, _DRIFTED)] * hand
    samples_y = mesh_y.vertices[farthest_point_samples(mesh_y, _DRIFTED)]
    (middle_x, size_x), (middle_y, size_y) = map(_placement, (samples_x, samples_y))
    x, y = (samples_x - middle_x) / size_x, (samples_y - middle_y) / size_y

    def on_target(moved: Float64[np.ndarray, "l 3"]) -> Float64[np.ndarray, "l 3"]:
        return nearest_surface_points(moved * size_y + middle_y, mesh_y)[0].positions(mesh_y)

    start = time.perf_counter()
    place = _best_rigid(x, y)
    landmarks = place((marks.positions * hand - middle_x) / size_x)
    aligned = time.perf_counter() - start
    carried = {"rigid": (on_target(landmarks), aligned)}
    # The landmarks follow the points of X, because CPD moves only the points that it aligns.
    points = np.vstack([place(x), landmarks])
    for alpha, beta in itertools.product(_ALPHAS, _BETAS):
        start = time.perf_counter()
        drift = register_deformable(y, points, alpha=alpha, beta=beta, low_rank=None, parallel=False)
        seconds = aligned + time.perf_counter() - start
        carried[f"cpd_{alpha:g}_{beta:g}"] = on_target(np.asarray(drift.points)[len(x) :]), seconds
    return carried


def _best_rigid(
    x: Float64[np.ndarray, "p 3"], y: Float64[np.ndarray, "p 3"]
) -> Callable[[Float64[np.ndarray, "q 3"]], Float64[np.ndarray, "q 3"]]:
    """Return the similarity of X to Y with the smallest variance, of rigid CPDs from 24 rotations."""
    from rustcpd import register_rigid

    found = []
    for turn in Rotation.create_group("O"):
        fit = register_rigid(y[:_ALIGNED], turn.apply(x[:_ALIGNED]), parallel=False)
        found.append((float(fit.sigma2), turn, fit))
    _, turn, fit = min(found, key=lambda one: one[0])
    rotation, translation = np.asarray(fit.rotation), np.asarray(fit.translation)
    return lambda points: float(fit.scale) * turn.apply(points) @ rotation + translation


def _placement(points: Float64[np.ndarray, "p 3"]) -> tuple[Float64[np.ndarray, " 3"], float]:
    middle = points.mean(axis=0)
    return middle, float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))


def _summary(journal: Journal) -> str:
    """Return the mean distance and the time of each method, with 95 % bootstrap intervals over the pairs."""
    columns = {
        name: np.array([float(row[name]) for row in journal.rows])
        for name in journal.rows[0]
        if name not in ("source", "target", "mirrored")
    }
    diagonals = columns.pop("diagonal")
    methods = [name for name in columns if not name.endswith("_seconds")]
    texts = [
        f"{name} {mean_interval(columns[name], seed=0)}, in the unit of the files "
        f"{1e-3 * (columns[name] * diagonals).mean():.3g}, {np.median(columns[f'{name}_seconds']):.3g} s"
        for name in methods
    ]
    best = min(methods, key=lambda name: columns[name].mean())
    return "\n  ".join([f"{len(journal.rows)} pairs", *texts, f"best: {best}"])


_GROUPS = ("jaxsmw", "opponents")


if __name__ == "__main__":
    main()
