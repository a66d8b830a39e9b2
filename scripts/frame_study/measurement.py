"""The measurements on one pair of shapes. Each pair is measured in a worker process on one core."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from common import medians
from jaxtyping import Float, Float64, Int, Int32, Int64

from frame_study.variants import (
    DEFAULT,
    TabulatedPreservation,
    Variant,
    frames,
    least_kernel_eigenvalue,
    refiner,
    tabulate,
)
from jaxsmw import read_mesh
from jaxsmw.benchmark.journal import Row
from jaxsmw.core.arrays import Array
from jaxsmw.core.banks import FilterBank, Meyer
from jaxsmw.core.refinement import Refinement, refine
from jaxsmw.core.refiner import Prepared, Problem, Refiner, State
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.core.solutions.closed_form import LeastSquares
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.evaluation.ground_truth import GroundTruth, read_ground_truth
from jaxsmw.evaluation.metrics import GeodesicError
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.geodesics import geodesic_distances
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import paired_spectra
from jaxsmw.matching.starts import initial_map

DATA_SETS = ("faust_r", "tosca_r")
# Shapes are padded to a multiple of this number of vertices, so that all shapes of a data set share one
# compiled program.
_PADDING = 1024
MOVE = 0.02
"""An iteration moves a match if the old and the new match are farther apart than this Euclidean distance.

The unit is the square root of the area. This distance is about the length of an edge.
"""
INVARIANCE_FRAMES = ("Meyer", "cubic spline")
SEARCH = DEFAULT._replace(update="nearest neighbors")
"""The key in `times.csv` of the nearest-neighbour search, which is the second half of an iteration."""
_SERIES = "error", "changed", "moved"
_TIMED_RUNS = 9


@dataclass(frozen=True)
class Settings:
    """All settings that influence the results, except data and code. `provenance.json` stores all fields."""

    pairs: int = 40
    seed: int = 0
    number_of_eigenvectors: int = 100
    number_of_filters: int = 6
    iterations: int = 5
    evaluated_points: int = 1000
    wavelet_centers: int = 200
    frames: tuple[str, ...] = tuple(frames(6))
    parameter_pairs: int = 10
    parameter_eigenvectors: tuple[int, ...] = (20, 40, 60, 80, 100, 120, 150)
    parameter_filters: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8)
    parameter_iterations: int = 10


class PairName(NamedTuple):
    data_set: str
    source: str
    target: str


@dataclass(frozen=True, eq=False)
class MeasuredPair:
    """A pair of shapes with initial map and ground truth, ready for refinement.

    **Attributes:**

    - `mesh_x`, `mesh_y`: source and target.
    - `spectra`: the padded spectra of source and target.
    - `start`: the initial map, padded like the source.
    - `sources`, `targets`: the evaluated vertices of X and their true matches on Y (p,).
    - `distances`: the geodesic distances from `targets` to all vertices of Y (p, n), in units of the square
      root of the area of Y.
    """

    mesh_x: Mesh
    mesh_y: Mesh
    spectra: tuple[Spectrum, Spectrum]
    start: Int32[Array, " m"]
    sources: Int64[np.ndarray, " p"]
    targets: Int64[np.ndarray, " p"]
    distances: Float64[np.ndarray, "p n"]

    def error(self, pointwise_map: Int[np.ndarray, " m"]) -> float:
        """Return the mean geodesic error of a map, in units of the square root of the area of Y."""
        errors = self.distances[np.arange(len(self.sources)), pointwise_map[self.sources]]
        return GeodesicError(errors, self.sources, "strips").mean


def files_of(data: Path, data_set: str, shape: str) -> tuple[Path, Path]:
    """Return the paths of the mesh and of the ground truth of a shape."""
    return data / data_set / "off" / f"{shape}.off", data / data_set / "corres" / f"{shape}.vts"


def read_pair(data: Path, name: PairName) -> tuple[Mesh, Mesh, GroundTruth]:
    """Read source, target and ground truth of a pair."""
    files = [files_of(data, name.data_set, shape) for shape in (name.source, name.target)]
    mesh_x, mesh_y = (read_mesh(mesh) for mesh, _ in files)
    return mesh_x, mesh_y, read_ground_truth([truth for _, truth in files], mesh_x, mesh_y)


def load_pair(data: Path, name: PairName, settings: Settings) -> MeasuredPair:
    """Read a pair, and compute the spectra, the initial map and the distances, which all variants share."""
    mesh_x, mesh_y, truth = read_pair(data, name)
    k = settings.number_of_eigenvectors
    pair = Pair(mesh_x, mesh_y)
    spectra = paired_spectra(pair, k)
    start, padded = initial_map(pair, *spectra), (pad(spectra[0]), pad(spectra[1]))
    rows = np.random.default_rng(settings.seed).permutation(len(truth.source_vertices))
    rows = rows[: settings.evaluated_points]
    sources, targets = truth.source_vertices[rows], np.asarray(truth.targets)[rows]
    different, row = np.unique(targets, return_inverse=True)
    distances = geodesic_distances(mesh_y, different) / np.sqrt(mesh_y.area)
    return MeasuredPair(mesh_x, mesh_y, padded, pad_map(start, padded[0]), sources, targets, distances[row])


def pad(spectrum: Spectrum) -> Spectrum:
    """Pad a spectrum with masked vertices up to the next multiple of `_PADDING`."""
    n = len(spectrum.mask)
    return spectrum.pad(n + -n % _PADDING)


def pad_map(pointwise_map: Int[np.ndarray, " m"], padded: Spectrum) -> Int32[Array, " padded_m"]:
    """Extend a pointwise map to a padded source. The match of each masked vertex is vertex 0."""
    n = len(padded.mask) - len(pointwise_map)
    return jnp.pad(jnp.asarray(pointwise_map, jnp.int32), (0, n))


def map_series(refined: Refinement) -> Int32[np.ndarray, "iterations m"]:
    """Return the pointwise map of every iteration."""
    assert refined.history is not None and refined.history.pointwise_maps is not None
    return np.asarray(refined.history.pointwise_maps)


class Diagnosis(NamedTuple):
    """Properties of a refinement.

    **Attributes:**

    - `energy`: the energy of equation (5) of the MWP paper in the area norm, for the last functional map and
      the last pointwise map.
    - `energy_of_zero`: the same energy for the last pointwise map, but with C = 0 as the functional map.
    - `condition_number`: the condition number of the first least-squares problem; NaN for updates that solve
      no least-squares problem.
    """

    energy: Float[Array, ""]
    energy_of_zero: Float[Array, ""]
    condition_number: Float[Array, ""]


@eqx.filter_jit
def diagnose(
    refiner: TabulatedPreservation,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    start: Int32[Array, " m"],
    pointwise_map: Int32[Array, " m"],
    functional_map: Float[Array, "k_out k_in"],
) -> Diagnosis:
    problem = refiner.problem(spectrum_x, spectrum_y)
    energy = problem.energy(pointwise_map)
    condition_number: Array = jnp.asarray(jnp.nan)
    if isinstance(refiner.solution, LeastSquares | RegularizedLeastSquares):
        condition_number = problem.energy(start, norm=refiner.solution.norm).condition_number()
    return Diagnosis(energy(functional_map), energy.constant, condition_number)


@lru_cache
def _frames(number_of_filters: int) -> dict[str, FilterBank]:
    return frames(number_of_filters)


def measure_variants(
    pair: MeasuredPair, name: PairName, wanted: list[Variant], settings: Settings
) -> list[Row]:
    """Refine a pair with each of the variants, and return one row of `results.csv` per variant."""
    banks, filters = _frames(settings.number_of_filters), settings.number_of_filters
    start = np.asarray(pair.start)
    rows = []
    for variant in wanted:
        began = time.perf_counter()
        method = refiner(variant, banks[variant.frame], *pair.spectra, number_of_filters=filters)
        refined = refine(
            *pair.spectra, pair.start, refiner=method, iterations=settings.iterations, history=True
        )
        maps, successful = map_series(refined), bool(refined.result == RESULTS.successful)
        seconds = time.perf_counter() - began
        diagnosis = diagnose(method, *pair.spectra, pair.start, maps[-1], refined.functional_map)
        least = least_kernel_eigenvalue(
            variant, banks[variant.frame], pair.spectra[0], number_of_filters=filters
        )
        rows.append(
            {
                **name._asdict(),
                **variant._asdict(),
                "result": "successful" if successful else sentence(refined.result),
                **_follow(pair, [start, *maps], successful),
                **{name: f"{value:.6g}" for name, value in diagnosis._asdict().items()},
                "least_kernel_eigenvalue": f"{least:.3g}",
                "seconds": f"{seconds:.4f}",
            }
        )
    return rows


def _follow(pair: MeasuredPair, maps: list[np.ndarray], successful: bool) -> Row:
    """Return the error of each map, and the changes in each iteration.

    The changes are the share of matches that changed, and the share of matches that moved by more than
    `MOVE`. If the refinement failed, all values except the error of the initial map are NaN.
    """
    m, positions = len(pair.mesh_x.vertices), pair.mesh_y.vertices / np.sqrt(pair.mesh_y.area)
    row: dict[str, float] = {"error_0": pair.error(maps[0])}
    for i, (before, after) in enumerate(pairwise(maps), start=1):
        if successful:
            steps = np.linalg.norm(positions[before[:m]] - positions[after[:m]], axis=1)
            measured = pair.error(after), np.mean(before[:m] != after[:m]), np.mean(steps > MOVE)
        else:
            measured = (np.nan,) * 3
        row |= {f"{what}_{i}": value for what, value in zip(_SERIES, measured, strict=True)}
    return {name: f"{value:.7f}" for name, value in row.items()}


def measure_parameters(
    pair: MeasuredPair, name: PairName, wanted: list[tuple[int, int]], settings: Settings
) -> list[Row]:
    """Refine a pair by filtering with the Meyer frame, for several numbers of eigenvectors and filters.

    **Returns:** One row of `parameters.csv` for each (eigenvectors, filters) in `wanted`. The row contains
    the errors of the initial map and of the map after each iteration.
    """
    if not wanted:
        return []
    largest = max(k for k, _ in wanted)
    spectra = [pad(compute_spectrum(mesh, largest)) for mesh in (pair.mesh_x, pair.mesh_y)]
    most = max(settings.parameter_filters)
    rows = []
    for k, filters in wanted:
        cut = spectra[0].truncate(k), spectra[1].truncate(k)
        tables = [tabulate(Meyer(filters), spectrum, most) for spectrum in cut]
        method = TabulatedPreservation(responses_x=tables[0], responses_y=tables[1])
        refined = refine(
            *cut, pair.start, refiner=method, iterations=settings.parameter_iterations, history=True
        )
        series = [np.asarray(pair.start), *map_series(refined)]
        rows.append(
            {
                **name._asdict(),
                "eigenvectors": k,
                "filters": filters,
                **{f"error_{i}": f"{pair.error(T):.7f}" for i, T in enumerate(series)},
            }
        )
    return rows


def measure_invariance(
    pair: MeasuredPair, name: PairName, wanted: list[tuple[str, int]], settings: Settings
) -> list[Row]:
    """Compare the wavelets of both shapes around corresponding vertices, for each frame and scale.

    For two such wavelets, the vectors a and b contain their values at corresponding points. The relative
    difference of the wavelets is `|a - b| / sqrt((|a|² + |b|²) / 2)`. This difference is 0 for equal wavelets
    and sqrt(2) for unrelated wavelets.

    **Returns:** Rows of `invariance.csv`. Each row contains the median correlation and the median relative
    difference over all wavelet centres.
    """
    banks = _frames(settings.number_of_filters)
    vertices = pair.sources, pair.targets
    rows = []
    for frame, scale in wanted:
        a, b = (
            wavelets(banks[frame], spectrum, scale, points[: settings.wavelet_centers])[:, points]
            for spectrum, points in zip(pair.spectra, vertices, strict=True)
        )
        squares = (np.sum(a**2, axis=1) + np.sum(b**2, axis=1)) / 2
        difference = np.sqrt(np.sum((a - b) ** 2, axis=1) / squares)
        centered = [values - values.mean(axis=1, keepdims=True) for values in (a, b)]
        norms = np.prod([np.linalg.norm(values, axis=1) for values in centered], axis=0)
        correlation = np.sum(centered[0] * centered[1], axis=1) / norms
        rows.append(
            {
                **name._asdict(),
                "frame": frame,
                "scale": scale,
                "relative_difference": f"{np.median(difference):.6f}",
                "correlation": f"{np.median(correlation):.6f}",
            }
        )
    return rows


def wavelets(
    bank: FilterBank, spectrum: Spectrum, scale: int, centers: Int[np.ndarray, " c"]
) -> Float64[np.ndarray, "c n"]:
    """Return the wavelets of one scale around c vertices, as values at all n vertices of the shape.

    The wavelets are defined by equation (2) of the MWP paper. Scale 0 is the scaling function.
    """
    eigenvectors = np.asarray(spectrum.eigenvectors, dtype=float)
    response = np.asarray(bank(spectrum.eigenvalues, spectrum.eigenvalues)[scale], dtype=float)
    return (eigenvectors[centers] * response) @ eigenvectors.T


@dataclass(frozen=True)
class Task:
    """A pair, and the measurements that are still missing for this pair."""

    name: PairName
    variants: list[Variant]
    parameters: list[tuple[int, int]]
    wavelets: list[tuple[str, int]]


def measure(data: Path, task: Task, settings: Settings) -> tuple[list[Row], list[Row], list[Row]]:
    """Return the missing rows of `results.csv`, `parameters.csv` and `invariance.csv` for one pair."""
    pair = load_pair(data, task.name, settings)
    return (
        measure_variants(pair, task.name, task.variants, settings),
        measure_parameters(pair, task.name, task.parameters, settings),
        measure_invariance(pair, task.name, task.wavelets, settings),
    )


@eqx.filter_jit
def _prepare(method: Refiner, spectrum_x: Spectrum, spectrum_y: Spectrum) -> Prepared:
    return method.prepare(Problem(spectrum_x, spectrum_y))


@eqx.filter_jit
def _update(
    method: Refiner,
    prepared: Prepared,
    pointwise_map: Int32[Array, " m"],
    previous: State | None,
) -> State:
    return method.update(prepared, pointwise_map, previous)[0]


@eqx.filter_jit
def _search(method: Refiner, prepared: Prepared, state: State) -> Int32[Array, " m"]:
    return method.recover(prepared, state)


def measure_times(data: Path, names: list[PairName], wanted: list[Variant], settings: Settings) -> list[Row]:
    """Measure how long every variant takes to compute a functional map, and time a nearest-neighbour search.

    The variants compute the functional map of the second iteration.

    **Returns:** Rows of `times.csv`, with median milliseconds.
    """
    banks, filters = _frames(settings.number_of_filters), settings.number_of_filters
    candidates: dict[Variant, Callable[[], object]] = {}
    rows = []
    for name in names:
        pair = load_pair(data, name, settings)
        for variant in wanted:
            method = refiner(variant, banks[variant.frame], *pair.spectra, number_of_filters=filters)
            prepared = _prepare(method, *pair.spectra)
            first = _update(method, prepared, pair.start, None)
            following = _search(method, prepared, first)
            candidates[variant] = partial(_update, method, prepared, following, first)
        candidates[SEARCH] = partial(_search, method, prepared, first)
        rows += [
            {**name._asdict(), **variant._asdict(), "milliseconds": f"{1e3 * seconds:.4f}"}
            for variant, seconds in medians(candidates, _TIMED_RUNS).items()
        ]
    return rows
