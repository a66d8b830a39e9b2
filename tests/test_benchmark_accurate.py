"""The benchmark's `accurate` is `jaxsmw.match`, on every kind of pair."""

import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh
from test_shortcuts import bent_tube

from jaxsmw import Correspondence, Mesh, creature_pair, geodesic_error, make_mesh, match, read_mesh
from jaxsmw.benchmark.datasets import DataPair, open_data_set
from jaxsmw.benchmark.measurement import FIGURES, OPTIONAL_FIGURES, Settings, measure_pairs, measure_shape
from jaxsmw.benchmark.opponents.baselines import _SHARED_STEPS, Unrefined
from jaxsmw.benchmark.opponents.registry import METHODS
from jaxsmw.evaluation import coverage, overlap_scores
from jaxsmw.io.meshes import write_mesh
from jaxsmw.runtime.cache import cached


class Case(NamedTuple):
    """Two shapes with equal numbers of vertices, and what shows that `match` took the intended way."""

    source: Mesh
    target: Mesh
    shows: Callable[[Correspondence], bool]
    partial: bool = False
    init: str = "auto"  # "map" for a directory with the true map


def moved(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    return make_mesh(Rotation.random(random_state=3).apply(vertices), faces)


def body() -> Mesh:
    return creature_pair(vertices=700).source


def whole() -> Case:
    mesh = body()
    return Case(mesh, make_mesh(mesh.vertices * [1, 1.1, 0.95], mesh.faces), lambda f: f.init == "shot")


def mirrored() -> Case:
    mesh, image = bumpy_mesh(3), bumpy_mesh(3).mirrored()
    return Case(mesh, moved(image.vertices, image.faces), lambda f: f.mirrored)


def other_init() -> Case:
    mesh = bumpy_mesh(3)
    noise = 0.004 * np.random.default_rng(1).normal(size=mesh.vertices.shape)
    return Case(mesh, moved(mesh.vertices + noise, mesh.faces), lambda f: f.init == "aligned", init="aligned")


def given() -> Case:
    return whole()._replace(init="map", shows=lambda f: f.init is None)


def coarse() -> Case:
    mesh = bumpy_mesh(2)
    return Case(mesh, mesh, lambda f: f.preset.stages[-1].number_of_descriptors == 0, init="map")


def part() -> Case:
    mesh = body()
    front = mesh.vertices[:, 2] > np.median(mesh.vertices[:, 2])
    cut = make_mesh(mesh.vertices, mesh.faces[front[mesh.faces].all(axis=1)])
    return Case(cut, mesh, lambda f: not f.spectrum_y.mask.all(), partial=True)


def fused() -> Case:
    mesh = bent_tube(0.5, spacing=0.11)
    return Case(
        mesh,
        make_mesh(mesh.vertices * [1, 1.1, 1], mesh.faces),
        lambda f: f.pair.without_shortcuts() is not f.pair,
    )


CASES = (whole, given, part, mirrored, other_init, coarse, fused)


@pytest.mark.slow
@pytest.mark.parametrize("case", first_always(CASES, always=2), ids=lambda case: case.__name__)
def test_the_method_accurate_gives_the_map_of_match(case, tmp_path):
    source, target, shows, partial, init = case()
    files = tmp_path / "x.off", tmp_path / "y.off"
    for path, mesh in zip(files, (source, target), strict=True):
        write_mesh(path, mesh)
    np.savetxt(tmp_path / "x_y.map", np.arange(len(source.vertices)) + 1, fmt="%d")
    pair = DataPair("x", "y", *files, partial=partial)
    settings = Settings(str(tmp_path) if init == "map" else init, evaluated_points=300)
    (row,) = measure_pairs([(pair, {"accurate": METHODS["accurate"]})], settings, 30)

    meshes = [read_mesh(path) for path in files]
    start = np.arange(len(source.vertices)) if init == "map" else init
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = match(*meshes, init=start, partial=partial)
    assert shows(found)
    assert _SHARED_STEPS & found.seconds.keys() >= {"eigenbases", "initial map"}
    error = geodesic_error(
        meshes[1], found.pointwise_map, pair.ground_truth(*meshes), number_of_samples=300, seed=0
    )
    expected = (
        error.mean,
        error.median,
        *error.within.values(),
        error.area_under_curve(),
        error.unreachable,
        coverage(meshes[1], found.pointwise_map),
    )
    assert [float(row[name]) for name in FIGURES] == pytest.approx(expected, abs=1e-7)
    assert float(row["probability"]) == pytest.approx(found.probability, abs=1e-7)
    assert row["result"] == "successful" and float(row["seconds"]) > 0


@pytest.mark.usefixtures("unchecked")
def test_the_seconds_leave_out_steps_whose_results_all_methods_share(monkeypatch):
    """Nothing is read from the cache, so that steps that were run before take their usual time."""
    inputs, calls = ["steps of match"], []

    def matched(*meshes, **options):
        cached("spectrum", inputs, lambda: calls.append(1) or {"values": np.zeros(1)})
        shared = {"eigenbases": 100.0, "initial map": 50.0, "descriptors": 20.0, "samples": 10.0}
        own = {"crease eigenvectors": 1.0, "refinement": 2.0, "final stages": 4.0}
        return SimpleNamespace(pointwise_map=np.arange(3), seconds=shared | own)

    monkeypatch.setattr("jaxsmw.benchmark.opponents.baselines.match", matched)
    pair = SimpleNamespace(meshes=(None, None), init="auto", spectra=SimpleNamespace(partial=False))
    for _ in range(2):
        seconds = METHODS["accurate"].measure(pair).seconds
        assert seconds == 7
    assert len(calls) == 2


def test_a_method_that_fails_does_not_stop_other_methods(tmp_path):
    class Broken(Unrefined):
        def __call__(self, pair):
            raise ArithmeticError("it went wrong")

    write_mesh(tmp_path / "x.off", bumpy_mesh(3))
    pair = DataPair("x", "x", tmp_path / "x.off", tmp_path / "x.off")
    methods = {"broken": Broken(), "initial": METHODS["initial"]}
    broken, initial = measure_pairs([(pair, methods)], Settings("hks", evaluated_points=50), 10)
    assert broken["result"] == "it went wrong" and broken["mean"] == broken["seconds"] == "nan"
    assert initial["result"] == "successful" and float(initial["mean"]) < 0.1


def test_shapes_that_are_too_coarse_for_descriptors_are_measured(tmp_path):
    write_mesh(tmp_path / "x.off", bumpy_mesh(2))
    (row,) = measure_shape(("x", tmp_path / "x.off"), 20)
    assert float(row["seconds_descriptors"]) >= 0


@pytest.mark.sampled
def test_the_overlap_of_two_real_parts_is_measured(shared):
    data_set = open_data_set(shared / "data" / "partial_smal")
    pair = data_set.known_pairs["cuts_19_cow_04", "cuts_9_dog_01"]
    methods = {name: METHODS[name] for name in ("initial", "accurate")}
    initial, accurate = measure_pairs([(pair, methods)], Settings(evaluated_points=100), 100)
    assert {initial[name] for name in OPTIONAL_FIGURES} == {"nan"} != initial["mean"]
    meshes = [read_mesh(path) for path in pair.meshes]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matched = match(*meshes, partial=True)
    scores = list(map(overlap_scores, matched.overlap(), pair.true_overlap(*meshes)))
    expected = (
        *(score.intersection_over_union for score in scores),
        np.mean([score.balanced_accuracy for score in scores]),
        matched.probability,
    )
    assert [float(accurate[name]) for name in OPTIONAL_FIGURES] == pytest.approx(expected, abs=1e-7)
    assert float(accurate["overlap_source"]) > 0.3 and float(accurate["overlap_target"]) > 0.3
