"""Measures matches between two partial shapes of one body, and the prediction of their overlap.

    pip install -e ".[benchmark]"
    python scripts/benchmark_overlap.py DATA_DIRECTORY/shrec16_partial --output overlap

The pairs are all ordered pairs of cuts of one body for which the smaller share of the overlap is between 40
and 90 % of the area of a cut. The ground truth takes both cuts to their full shape. A vertex of the source is
in the overlap if its true point on the full shape is within 1 % of the square root of the full shape's area
of the target's true points. The error is measured at vertices in the overlap, in thousandths of the square
root of the full shape's area. The intersection over union (IoU) compares the predicted overlap with the true
overlap of the source, weighted by area. Each result is stored in `OUTPUT/overlap.csv` when it is measured,
and the same command continues after an interruption.
"""

from __future__ import annotations

import itertools
import re
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import make_parser, measure_pairs
from jaxtyping import Bool, Float64

from jaxsmw import Mesh, geodesic_error, make_mesh, match, read_ground_truth, read_mesh
from jaxsmw.benchmark.intervals import mean_interval
from jaxsmw.errors import InputError
from jaxsmw.evaluation import GroundTruth
from jaxsmw.geometry import SurfacePoints, nearest_surface_points
from jaxsmw.runtime.provenance import made_with

_SHARES = 0.4, 0.9
# A vertex is in the overlap up to this distance on the full shape, divided by the square root of its area.
_NEAR = 0.01
_EVALUATED = 400


def main() -> None:
    """Measure all pairs, and print a summary."""
    parser = make_parser(__doc__, data="SHREC16_PARTIAL", output="overlap")
    parser.add_argument("--pairs", type=int, help="largest number of pairs (default: all pairs)")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    pairs = itertools.islice(pairs_of_cuts(options.data, *_SHARES), options.pairs)
    file = options.output / "overlap.csv"
    journal = measure_pairs(file, pairs, lambda pair: pair.names, PairOfCuts.measure)
    for name in ("error", "iou", "iou_of_all", "seconds"):
        values = np.array([float(row[name]) for row in journal.rows])
        print(f"{name}: {mean_interval(values, seed=0)}, median {np.median(values):.3f}")
    print(f"{len(journal.rows)} pairs\n{made_with()}", flush=True)


class Cut:
    """A cut of a full shape, with the true point of each vertex on the full shape."""

    def __init__(self, file: Path, full: Mesh) -> None:
        self.mesh, self.name = read_mesh(file), file.stem
        truth = read_ground_truth(file.with_suffix(".baryc_gt"), self.mesh, full)
        self.positions = np.zeros((len(self.mesh.vertices), 3))
        assert isinstance(truth.targets, SurfacePoints)
        self.positions[truth.source_vertices] = truth.targets.positions(full)
        self.on_full = make_mesh(self.positions, self.mesh.faces, name=file.stem)

    def inside(self, other: Cut, unit: float) -> tuple[SurfacePoints, Bool[np.ndarray, " m"]]:
        """Return the true points on another cut, and a mask of the vertices in the overlap."""
        points, distances = nearest_surface_points(self.positions, other.on_full)
        return points, (distances < _NEAR * unit) & self.mesh.referenced_vertices

    def share(self, mask: Bool[np.ndarray, " m"]) -> float:
        """Return the share of the area that a mask covers."""
        return float(self.mesh.average(mask))


class PairOfCuts:
    """Two cuts of one full shape, and their overlap."""

    def __init__(self, source: Cut, target: Cut, unit: float) -> None:
        self.source, self.target, self.unit = source, target, unit
        self.names = source.name, target.name
        self.points, self.inside = source.inside(target, unit)
        self.shares = source.share(self.inside), target.share(target.inside(source, unit)[1])

    def measure(self) -> dict[str, Any]:
        """Match the pair, and return the error in the overlap and the quality of the predicted overlap."""
        mesh_x, mesh_y = self.source.mesh, self.target.mesh
        start = time.perf_counter()
        matched = match(mesh_x, mesh_y, partial=True)
        seconds = time.perf_counter() - start
        used = np.flatnonzero(self.inside)
        truth = GroundTruth(used, SurfacePoints(self.points.faces[used], self.points.weights[used]))
        error = geodesic_error(mesh_y, matched.pointwise_map, truth, number_of_samples=_EVALUATED)
        reached = error.errors[np.isfinite(error.errors)]  # a cut can fall into several components
        return {
            "share_of_source": self.shares[0],
            "share_of_target": self.shares[1],
            "error": 1e3 * float(reached.mean()) * np.sqrt(mesh_y.area) / self.unit,
            "iou": _iou(matched.overlap()[0], self.inside, mesh_x.vertex_areas),
            "iou_of_all": self.shares[0],
            "suspicious": matched.suspicious,
            "seconds": seconds,
        }


def _iou(
    predicted: Bool[np.ndarray, " m"], true: Bool[np.ndarray, " m"], areas: Float64[np.ndarray, " m"]
) -> float:
    return float(areas[predicted & true].sum() / areas[predicted | true].sum())


def pairs_of_cuts(directory: Path, least: float = 0.0, most: float = 1.0) -> Iterator[PairOfCuts]:
    """Yield all ordered pairs of cuts of one body whose smaller share of the overlap is within limits."""
    files = sorted((directory / "cuts").glob("cuts_*_shape_*.off"))
    bodies = sorted({re.sub(r"cuts_(.*)_shape_\d+", r"\1", file.stem) for file in files})
    if not bodies:
        raise InputError(f"{directory}: contains no cuts/cuts_NAME_shape_N.off: give SHREC'16 partial.")
    for body in bodies:
        full = read_mesh(directory / "null" / f"{body}.off")
        parts = [Cut(file, full) for file in files if file.stem.startswith(f"cuts_{body}_shape_")]
        for source, target in itertools.permutations(parts, 2):
            pair = PairOfCuts(source, target, float(np.sqrt(full.area)))
            if least <= min(pair.shares) <= most:
                yield pair


if __name__ == "__main__":
    main()
