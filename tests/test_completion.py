"""Completion of parts: conditional distributions, calibration, the whole method, its files and its command."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_refused, runner
from known_collections import known_collection
from messages import refused
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

from jaxsmw.collection import (
    GaussianModel,
    Posterior,
    ShapeModel,
    complete_mesh,
    read_shape_model,
    shape_model,
)
from jaxsmw.collection.conditioning import Family
from jaxsmw.collection.files import write_model, write_registered, write_summary
from jaxsmw.creature import creature
from jaxsmw.errors import WrongMapWarning
from jaxsmw.geometry.alignment import rigid_fit
from jaxsmw.geometry.eigenbasis import eigenpairs
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.io.mesh_data import MeshData
from jaxsmw.io.meshes import read_mesh_data, write_mesh

N, VERTICES = 8, 500


def random_model(seed: int = 0, *, n: int = 30, p: int = 7) -> GaussianModel:
    random = np.random.default_rng(seed)
    return GaussianModel(
        random.normal(size=(n, 3)), random.normal(size=(p, n, 3)), random.uniform(0.5, 2, p), 0.1
    )


def shapes(mesh: Mesh, count: int, seed: int = 0) -> np.ndarray:
    """Deform a mesh by random smooth fields of decreasing amplitude, more of them than there are shapes."""
    random = np.random.default_rng(seed)
    unit = (mesh.vertices - mesh.average(mesh.vertices)) / np.sqrt(mesh.area)
    frequencies = np.linspace(1, 12, 40)
    waves = frequencies[:, None] * Rotation.random(40, rng=random).as_matrix()[:, 0]
    fields = np.sin(unit @ waves.T + random.uniform(0, 6, 40)) / frequencies
    return unit + 0.08 * fields @ random.normal(size=(count, 40, 3))


def cut(mesh: Mesh, kept: np.ndarray, name: str = "part") -> Mesh:
    return make_mesh(mesh.vertices, mesh.faces[kept[mesh.faces].all(axis=1)], name=name)


# ---- The distribution given some vertices


def test_conditioning_equals_the_formula_for_normal_distributions():
    model = random_model()
    observed = np.arange(30) % 3 == 0
    positions = np.random.default_rng(1).normal(size=(10, 3))
    posterior, _ = model.condition(observed, positions, 0.3)
    flat = model.factors.reshape(7, -1)
    covariance = flat.T @ np.diag(model.variances) @ flat
    rows = np.repeat(observed, 3)
    gain = covariance[:, rows] @ np.linalg.inv(covariance[np.ix_(rows, rows)] + 0.3**2 * np.eye(30))
    mean = model.mean.ravel() + gain @ (positions - model.mean[observed]).ravel()
    exact = covariance - gain @ covariance[rows]
    np.testing.assert_allclose(posterior.mean.ravel(), mean, atol=1e-9)
    found = posterior.factors.reshape(7, -1)
    np.testing.assert_allclose(found.T @ found, exact, atol=1e-9)
    blocks = exact.reshape(30, 3, 30, 3)[np.arange(30), :, np.arange(30)] + 0.1**2 * np.eye(3)
    np.testing.assert_allclose(posterior.covariances, blocks, atol=1e-9)
    np.testing.assert_allclose(
        posterior.standard_deviation**2, np.trace(blocks, axis1=1, axis2=2) / 3, atol=1e-9
    )


def test_a_factor_of_unknown_variance_follows_the_observed_vertices():
    model = random_model()
    shifts = np.broadcast_to(np.eye(3)[:, None], (3, 30, 3))
    free = GaussianModel(
        model.mean,
        np.concatenate([model.factors, shifts]),
        np.concatenate([model.variances, np.full(3, np.inf)]),
        0.1,
    )
    observed, positions = np.arange(30) < 12, np.random.default_rng(1).normal(size=(12, 3))
    first, _ = free.condition(observed, positions, 0.3)
    second, _ = free.condition(observed, positions + np.array([5.0, -7.0, 100.0]), 0.3)
    np.testing.assert_allclose(second.mean - first.mean, np.tile([5.0, -7.0, 100.0], (30, 1)), atol=1e-8)
    np.testing.assert_allclose(second.factors, first.factors, atol=1e-9)


def test_samples_have_the_deviations_and_lie_within_the_radii():
    random = np.random.default_rng(0)
    posterior = Posterior(random.normal(size=(20, 3)), random.normal(size=(5, 20, 3)) * [3, 1, 0.3], 0.2)
    away = np.array([posterior.sample(seed) for seed in range(2000)]) - posterior.mean
    np.testing.assert_allclose(np.sqrt((away**2).mean(axis=(0, 2))), posterior.standard_deviation, rtol=0.1)
    lengths = np.linalg.norm(away, axis=2)
    for probability in (0.5, 0.9, 0.99):
        within = (lengths < posterior.radii(probability)).mean()
        assert within == pytest.approx(probability, abs=0.02)
    np.testing.assert_array_equal(posterior.sample(3), posterior.sample(3))
    assert np.abs(posterior.sample(3) - posterior.sample(4)).max() > 0.1


# ---- Calibration


def functions_of(mesh: Mesh) -> np.ndarray:
    return eigenpairs(mesh, 15)[1]


def test_calibrated_radii_hold_the_hidden_vertices_of_further_shapes():
    mesh = bumpy_mesh(2)
    both = shapes(mesh, 30)
    mean = both[:12].mean(axis=0)
    model = shape_model(both[:12], weights=mesh.vertex_areas)
    family = Family(model.mean, model.modes, model.scores, model.weights, functions_of(mesh))
    observed = mesh.vertices[:, 0] < np.quantile(mesh.vertices[:, 0], 0.6)
    shifts = np.broadcast_to(np.eye(3)[:, None], (3, *mean.shape))
    noise, calibration = family.calibrate(shifts, observed, 0.0)
    distribution = family.model(shifts)
    assert noise >= distribution.residual
    errors, radii = [], []
    for shape in both[12:]:
        placed = rigid_fit(shape, model.mean, mesh.vertex_areas).apply(shape)
        posterior, _ = distribution.condition(observed, placed[observed], noise)
        errors.append(np.linalg.norm(posterior.mean - placed, axis=1)[~observed])
        radii.append(calibration * posterior.radii()[~observed])
    assert 0.8 < (np.array(errors) < np.array(radii)).mean() <= 1
    away = [np.linalg.norm(shape - model.mean, axis=1)[~observed] for shape in both[12:]]
    assert np.mean(errors) < 0.8 * np.mean(away)


# ---- The whole method


@cache
def family_of_creatures() -> tuple[ShapeModel, Mesh, np.ndarray]:
    """Return a model, its mean, and a further shape, which the modes describe."""
    body = creature("biped", vertices=VERTICES)
    model = shape_model(shapes(body, N), weights=body.vertex_areas)
    truth = model.shape(np.sqrt(model.variances) * [1.0, -1.0, 1.0, 0.0, 0.5, 0.0, -0.5])
    return model, make_mesh(model.mean, body.faces, name="mean"), truth


@pytest.mark.filterwarnings("ignore:.*map:UserWarning", "ignore:.*the mesh is coarse there:UserWarning")
def test_a_part_is_completed_in_its_own_coordinates():
    model, mean, truth = family_of_creatures()
    moved = Rotation.from_rotvec([0.1, -0.2, 0.1]).apply(truth) + np.array([3.0, -1.0, 2.0])
    whole = make_mesh(moved, mean.faces)
    shown = mean.vertices[:, 1] < np.quantile(mean.vertices[:, 1], 0.75)
    completed = complete_mesh(cut(whole, shown), model, mean.faces)
    assert (completed.observed == shown).mean() > 0.9
    errors = np.linalg.norm(completed.mesh.vertices - moved, axis=1)
    aligned = rigid_fit(model.mean[shown], moved[shown]).apply(model.mean)
    assert errors[~shown].mean() < 0.8 * np.linalg.norm(aligned - moved, axis=1)[~shown].mean()
    assert errors[shown].mean() < 0.03
    deviation = completed.standard_deviation
    assert deviation[~shown].mean() > 1.5 * deviation[shown].mean()
    assert (errors < completed.posterior.radii())[~shown].mean() > 0.7
    np.testing.assert_array_equal(completed.mesh.faces, mean.faces)


def with_lid(part: Mesh) -> Mesh:
    """Close the boundary of a part whose cut is one loop, by triangles to the middle of the loop."""
    edges = part.boundary_edges
    middle = part.vertices[edges[:, 0]].mean(axis=0)
    lid = np.column_stack([edges[:, ::-1], np.full(len(edges), len(part.vertices))])
    return make_mesh(np.vstack([part.vertices, middle]), np.vstack([part.faces, lid]), name="part with lid")


@pytest.mark.filterwarnings(
    "ignore:.*(the mesh is coarse there|the map to the mean shape|is a closed surface)"
)
def test_a_lid_and_a_wrong_map_are_reported():
    model, mean, truth = family_of_creatures()
    whole = make_mesh(truth, mean.faces)
    shown = mean.vertices[:, 1] > np.quantile(mean.vertices[:, 1], 0.5)
    part = cut(whole, shown)
    with pytest.warns(UserWarning, match=r"part with lid: is a closed surface, but \d\d% .* remove the lid"):
        complete_mesh(with_lid(part), model, mean.faces, preset="paper")
    with pytest.warns(
        WrongMapWarning, match=r"part with lid: the map .* the unit of length and the hand"
    ) as caught:
        completed = complete_mesh(with_lid(part), model, mean.faces, preset="paper")
    assert completed.probability < 0.5 and not any("init=" in str(one.message) for one in caught)


# ---- Files and the command


@pytest.fixture(scope="module")
def directory(tmp_path_factory) -> Path:
    """Results of a collection whose maps are known; shape 2 has the other hand."""
    body = creature("biped", vertices=VERTICES)
    collection = known_collection(shapes(body, N), body.faces, np.arange(N) == 2)
    template = collection.meshes[0]
    folder = tmp_path_factory.mktemp("model")
    files = write_registered(collection, MeshData(template, template.faces), folder, ".ply")
    files += write_model(collection, collection.shape_model(), folder, ".ply")
    write_summary(collection, {}, folder, {}, files)
    return folder


def test_a_model_is_read_as_it_was_written(directory):
    stored = np.load(directory / "modes.npz")
    model, mean = read_shape_model(directory)
    np.testing.assert_allclose(model.mean, stored["mean"], atol=1e-6)
    np.testing.assert_allclose(model.variances, stored["variances"], rtol=1e-4)
    np.testing.assert_allclose(
        np.abs(np.einsum("kvc,kvc,v->k", model.modes, stored["modes"], stored["weights"])), 1, atol=1e-3
    )
    np.testing.assert_allclose(np.linalg.det(model.alignment.rotations), 1)
    assert not model.alignment.scaled
    np.testing.assert_array_equal(mean.faces, stored["faces"])


@pytest.fixture
def run(capsys):
    return runner(capsys)


@pytest.mark.filterwarnings("ignore:.*map:UserWarning", "ignore:.*the mesh is coarse there:UserWarning")
def test_the_command_writes_the_completed_mesh(directory, run, tmp_path):
    model, mean = read_shape_model(directory)
    shape = mean.vertices + 0.5 * (model.aligned[1] - mean.vertices)
    shown = shape[:, 1] < np.quantile(shape[:, 1], 0.7)
    write_mesh(tmp_path / "part.ply", cut(make_mesh(shape, mean.faces), shown))
    outcome = run(
        "complete", tmp_path / "part.ply", "--model", directory, "--output", tmp_path / "whole.ply",
        "--sample", tmp_path / "sample.off", "--seed", "4", "--preset", "paper", "--quiet",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    assert "observed: " in outcome.output and "standard deviation" in outcome.output
    data = read_mesh_data(tmp_path / "whole.ply")
    deviation, observed = data.vertex_data["standard_deviation"], data.vertex_data["observed"]
    assert deviation[observed == 0].mean() > deviation[observed == 1].mean() > 0
    assert (data.vertex_data["radius"] > deviation).all()
    errors = np.linalg.norm(data.mesh.vertices - shape, axis=1)
    assert errors.mean() < 0.03
    sample = read_mesh_data(tmp_path / "sample.off").mesh.vertices
    assert 0 < np.linalg.norm(sample - data.mesh.vertices, axis=1).mean() < 5 * deviation.mean()


# ---- Bad input

BODY = bumpy_mesh(2)
FEW = [BODY.vertices * factor for factor in ([1, 1, 1], [1, 1.1, 1], [1, 1, 1.2], [1.1, 1, 1])]


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"part": (BODY.vertices[:, :2], BODY.faces)}, ("part", "(162, 2)")),
        ({"part": (BODY.vertices, np.empty((0, 3), int))}, ("part", "no faces")),
        ({"part": "skull.ply"}, ("part",)),
        ({"faces": BODY.faces + 1}, ("mean shape", "0 to")),
        ({"faces": BODY.faces[:, :2]}, ("mean shape", "(320, 2)")),
        ({"model": FEW[:1]}, ("1 shape:", "at least three")),
        ({"model": FEW[:2]}, ("2 shapes:", "at least three")),
        ({"model": [FEW[0]] * 3}, ("all its shapes are equal", "different shapes")),
        ({"part": (BODY.vertices / 1000, BODY.faces)}, ("area", "scale")),
    ],
)
def test_bad_arguments_are_refused(changes, facts):
    arguments = {"part": BODY, "faces": BODY.faces, "preset": "paper", "model": FEW} | changes
    model = shape_model(arguments["model"], weights=BODY.vertex_areas)
    with refused(*facts):
        complete_mesh(arguments["part"], model, arguments["faces"], preset=arguments["preset"])


@pytest.mark.parametrize("probability", [-0.1, 1.5, float("nan")])
def test_bad_probabilities_are_refused(probability):
    with refused("probability", "from 0 to 1"):
        Posterior(np.zeros((2, 3)), np.ones((1, 2, 3)), 0.1).radii(probability)


@pytest.mark.parametrize("seed", [-1, True])
def test_bad_seeds_are_refused(seed):
    with refused("seed", "at least 0"):
        Posterior(np.zeros((2, 3)), np.ones((1, 2, 3)), 0.1).sample(seed)


def damaged(directory: Path, place: Path, damage: str) -> None:
    """Copy the files of a model, and damage the copy."""
    place.mkdir()
    (place / "registered").mkdir()
    for file in directory.rglob("*"):
        if file.is_file():
            (place / file.relative_to(directory)).write_bytes(file.read_bytes())
    summary = json.loads((place / "collection.json").read_text("utf-8"))
    if damage == "no modes":
        (place / "modes.npz").unlink()
    elif damage == "cut modes":
        (place / "modes.npz").write_bytes((place / "modes.npz").read_bytes()[:1000])
    elif damage == "an array is missing":
        stored = dict(np.load(place / "modes.npz"))
        del stored["matrices"]
        np.savez(place / "modes.npz", **stored)
    elif damage == "no summary":
        (place / "collection.json").unlink()
    elif damage == "fewer shapes":
        summary["shapes"].pop()
        (place / "collection.json").write_text(json.dumps(summary), "utf-8")
    elif damage == "unlisted":
        summary["files"] = []
        (place / "collection.json").write_text(json.dumps(summary), "utf-8")
    elif damage == "lost mesh":
        (place / "registered" / "shape3.ply").unlink()
    elif damage == "other mesh":
        write_mesh(place / "registered" / "shape3.ply", BODY)


@pytest.mark.parametrize(
    ("damage", "naming"),
    [
        ("no modes", "contains no modes.npz: give the output directory"),
        ("cut modes", "modes.npz: "),
        ("an array is missing", "contains no array called matrices"),
        ("no summary", "does not list the registered meshes"),
        ("fewer shapes", "does not list the registered meshes"),
        ("unlisted", "does not list the registered meshes"),
        ("lost mesh", "shape3.ply: does not exist"),
        ("other mesh", "shape3.ply: has 162 vertices, but modes.npz has 500"),
    ],
)
def test_damaged_models_are_refused(directory, run, tmp_path, damage, naming):
    damaged(directory, tmp_path / "model", damage)
    write_mesh(tmp_path / "part.ply", BODY)
    words = ("--model", tmp_path / "model", "--output", tmp_path / "whole.ply", "--quiet")
    assert_refused(run("complete", tmp_path / "part.ply", *words), naming=naming)
    assert not (tmp_path / "whole.ply").exists()


@pytest.mark.parametrize(
    ("words", "naming"),
    [
        (("--output", "{}/whole.stl"), "no attribute can be written"),
        (("--output", "{}/whole.jpg"), "whole.jpg"),
        (("--output", "{}/part.ply"), "is an input and would be overwritten"),
        (("--output", "{}/a.ply", "--sample", "{}/a.ply"), "two outputs have this name"),
        (("--output", "{}/a.ply", "--seed", "3"), "--seed: has no effect without --sample"),
        (("--output", "{}/a.ply", "--seed", "-3", "--sample", "{}/b.ply"), "-3 is too small"),
        (("--output", "{}/a.ply", "--preset", "best"), "invalid choice: 'best'"),
        (("--output", "{}/no/a.ply"), "no/a.ply"),
    ],
)
def test_bad_options_are_refused(directory, run, tmp_path, words, naming):
    write_mesh(tmp_path / "part.ply", BODY)
    words = [word.format(tmp_path) for word in words]
    outcome = run("complete", tmp_path / "part.ply", "--model", directory, *words, "--quiet")
    assert_refused(outcome, naming=naming)


def test_a_missing_part_is_refused(directory, run, tmp_path):
    outcome = run("complete", tmp_path / "no.ply", "--model", directory, "--output", tmp_path / "whole.ply")
    assert_refused(outcome, naming="no.ply: does not exist")
