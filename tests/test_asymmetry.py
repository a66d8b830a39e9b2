"""The asymmetry of bodies and of paired bones: closed forms, files and bad input."""

import csv
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_refused
from messages import refused
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

from jaxsmw import read_mesh, write_mesh
from jaxsmw.collection import asymmetry, mirror_points
from jaxsmw.creature import creature
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import read_mesh_data

MIRROR = np.array([-1.0, 1.0, 1.0])
HALF = 30


def symmetric_shape(seed: int) -> np.ndarray:
    """Points on both sides of the plane x = 0. The counterpart of point i is point i + HALF, and vice versa."""
    right = np.random.default_rng(seed).normal(size=(HALF, 3)) * [1, 2, 3] + [3, 0, 0]
    return np.vstack([right, right * MIRROR])


def counterpart(shape: np.ndarray) -> np.ndarray:
    return np.roll(shape, HALF, axis=0)


def asymmetric_field(seed: int, size: float = 0.1) -> np.ndarray:
    """Displacements that change sign under the exchange of both sides, without rigid motion."""
    base = symmetric_shape(0)
    field = np.random.default_rng(seed).normal(size=base.shape)
    field = field - counterpart(field) * MIRROR
    motions = [np.broadcast_to(axis, base.shape) for axis in np.eye(3)]
    motions += [np.cross(axis, base - base.mean(axis=0)) for axis in np.eye(3)]
    basis = np.linalg.qr(np.stack([motion.ravel() for motion in motions], axis=1))[0]
    field = field.ravel() - basis @ (basis.T @ field.ravel())
    return size * field.reshape(base.shape)


def turned(shapes: list[np.ndarray]) -> list[np.ndarray]:
    return [Rotation.random(rng=i).apply(shape) + i for i, shape in enumerate(shapes)]


def test_symmetric_bodies_have_no_asymmetry():
    shapes = turned([symmetric_shape(seed) for seed in range(4)])
    found = asymmetry(shapes, [counterpart(shape) for shape in shapes])
    assert np.abs(found.differences).max() < 1e-9
    _, sides, interaction = found.analysis_of_variance()
    assert sides.sum_of_squares < 1e-18 and interaction.sum_of_squares < 1e-18


def test_the_difference_is_twice_a_known_displacement():
    field = asymmetric_field(1, size=1e-4)
    shape = symmetric_shape(0) + field
    found = asymmetry([shape], [counterpart(shape)])
    # The mirror image of the counterpart has the opposite displacement. Rotations are of second order.
    frame = found.alignment.rotations[0]
    np.testing.assert_allclose(found.differences[0] @ frame, 2 * field, atol=1e-7)
    assert found.probability == 1 and np.isnan(found.analysis_of_variance()[0].f)


def test_directional_and_fluctuating_asymmetry_are_told_apart():
    common, own = asymmetric_field(1, 1e-3), [asymmetric_field(seed, 1e-4) for seed in range(2, 8)]
    own = [field - np.mean(own, axis=0) for field in own]
    shapes = [symmetric_shape(0) + common + field for field in own]
    found = asymmetry(shapes, [counterpart(shape) for shape in shapes])
    np.testing.assert_allclose(found.directional, 2 * common, atol=2e-5)
    np.testing.assert_allclose(found.fluctuating, 2 * np.array(own), atol=2e-5)
    assert found.probability < 0.05


def test_opposite_asymmetries_are_not_directional():
    fields = [sign * asymmetric_field(seed) for seed in range(1, 5) for sign in (1, -1)]
    shapes = [symmetric_shape(0) + field for field in fields]
    found = asymmetry(shapes, [counterpart(shape) for shape in shapes])
    assert found.probability > 0.9


def test_the_probability_is_that_of_all_exchanges():
    """Three equal individuals: all eight exchanges are equally likely, and two of them have no smaller mean."""
    shapes = [symmetric_shape(0) + asymmetric_field(1)] * 3
    others = [counterpart(shape) for shape in shapes]
    found = asymmetry(shapes, others, permutations=9999)
    assert found.probability == pytest.approx(0.25, abs=0.02)
    assert found.probability == asymmetry(shapes, others, permutations=9999).probability


def test_sums_of_squares_are_those_of_a_table_of_two_factors():
    shapes = [symmetric_shape(seed) + asymmetric_field(seed + 9) for seed in range(5)]
    weights = np.random.default_rng(3).uniform(1, 2, 2 * HALF)
    found = asymmetry(shapes, [counterpart(shape) for shape in shapes], weights=weights)
    table = found.alignment.aligned.reshape(2, 5, -1)
    shares = np.repeat(weights / weights.sum(), 3)
    rows, columns, mean = table.mean(axis=0), table.mean(axis=1, keepdims=True), table.mean(axis=(0, 1))
    expected = (
        2 * np.sum(shares * (rows - mean) ** 2),
        5 * np.sum(shares * (columns - mean) ** 2),
        np.sum(shares * (table - rows - columns + mean) ** 2),
    )
    effects = found.analysis_of_variance()
    np.testing.assert_allclose([effect.sum_of_squares for effect in effects], expected)
    total = np.sum(shares * (table - mean) ** 2)
    assert sum(effect.sum_of_squares for effect in effects) == pytest.approx(total)
    assert [effect.degrees_of_freedom for effect in effects] == [4, 1, 4]
    assert effects[1].f == pytest.approx(expected[1] / (expected[2] / 4))


@pytest.mark.parametrize("scale", [False, True])
def test_rigid_motions_and_exchanged_sides_change_nothing(scale):
    shapes = [symmetric_shape(seed) + asymmetric_field(seed) for seed in range(4)]
    others = [counterpart(shape) for shape in shapes]
    first = asymmetry(shapes, others, scale=scale)
    moved = asymmetry(turned(shapes), turned(others[::-1])[::-1], scale=scale)
    exchanged = asymmetry(others, shapes, scale=scale)
    for other in (moved, exchanged):
        np.testing.assert_allclose(
            np.linalg.norm(other.differences, axis=2), np.linalg.norm(first.differences, axis=2), atol=1e-8
        )
        assert other.probability == first.probability


def test_a_difference_of_size_counts_unless_it_is_removed():
    left = symmetric_shape(0)
    assert np.abs(asymmetry([left], [1.1 * left * MIRROR]).differences).max() > 0.1
    assert np.abs(asymmetry([left], [1.1 * left * MIRROR], scale=True).differences).max() < 1e-9


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (([np.eye(3)], []), ("1 shapes", "0 counterparts", "one for each shape")),
        (([], []), ("no shape", "at least one")),
        (([np.eye(3)], [np.eye(4)[:, :3]]), ("4 vertices", "3")),
        (([np.eye(3) * np.nan], [np.eye(3)]), ("not finite",)),
        (([np.ones((3, 3))], [np.eye(3)]), ("single point",)),
    ],
)
def test_unusable_shapes_are_refused(arguments, facts):
    with refused(*facts):
        asymmetry(*arguments)


@pytest.mark.parametrize("settings", [{"permutations": 0}, {"seed": -1}, {"weights": -np.ones(3)}])
def test_unusable_settings_are_refused(settings):
    with refused(*settings):
        asymmetry([np.eye(3)], [np.eye(3)], **settings)


@pytest.mark.sampled
def test_mirror_points_lie_on_the_other_side():
    body = creature("mammal", vertices=800)
    points = mirror_points(body).positions(body)
    assert np.linalg.norm(points - body.vertices * MIRROR, axis=1).mean() < 0.02 * body.area**0.5


# ---- The command


@pytest.fixture
def bones(tmp_path: Path) -> Path:
    """Left bones and their right counterparts, as a collection writes them, with reversed faces."""
    left = bumpy_mesh(1)
    for number in range(3):
        noise = 0.01 * np.random.default_rng(number).normal(size=left.vertices.shape)
        write_mesh(tmp_path / f"left{number}.ply", make_mesh(left.vertices + noise, left.faces))
        mirrored = (left.vertices - noise) * MIRROR
        write_mesh(tmp_path / f"right{number}.ply", make_mesh(mirrored, left.faces[:, ::-1]))
    return tmp_path


def test_the_command_writes_tables_meshes_and_a_picture(run, bones):
    sides = [[bones / f"{side}{number}.ply" for number in range(3)] for side in ("left", "right")]
    done = run("asymmetry", *sides[0], "--other-side", *sides[1], "--output", bones / "out")
    assert done.code == 0 and "directional" in done.output and "fluctuating" in done.output
    with (bones / "out" / "asymmetry.csv").open(newline="") as file:
        rows = {row["mesh"]: row for row in csv.DictReader(file)}
    found = asymmetry(
        *([read_mesh(file).vertices for file in of_side] for of_side in sides),
        weights=read_mesh(sides[0][0]).vertex_areas,
    )
    for number, difference in enumerate(found.differences):
        lengths = np.linalg.norm(difference, axis=1)
        assert float(rows[f"left{number}"]["largest"]) == pytest.approx(lengths.max())
        data = read_mesh_data(bones / "out" / f"left{number}_asymmetry.ply")
        np.testing.assert_allclose(data.vertex_data["asymmetry"], lengths)
        np.testing.assert_allclose(data.vertex_data["difference"], difference)
    with (bones / "out" / "variance.csv").open(newline="") as file:
        effects = list(csv.DictReader(file))
    assert float(effects[1]["f"]) == pytest.approx(found.analysis_of_variance()[1].f)
    mean = read_mesh_data(bones / "out" / "mean.ply")
    assert {"directional_asymmetry", "fluctuating_asymmetry"} <= set(mean.vertex_data)
    assert (bones / "out" / "asymmetry.png").stat().st_size > 10_000


@pytest.mark.sampled
def test_a_single_body_is_compared_with_its_mirror_image(run, tmp_path):
    body = creature("mammal", vertices=700)
    bent = body.vertices + 0.05 * np.outer(body.vertices[:, 0] > 0, [1, 0, 0])
    write_mesh(tmp_path / "body.ply", make_mesh(bent, body.faces))
    assert run("asymmetry", tmp_path / "body.ply", "--output", tmp_path / "out", "--quiet").code == 0
    assert "fluctuating" not in (tmp_path / "out" / "asymmetry.csv").read_text()
    assert not (tmp_path / "out" / "variance.csv").exists()
    data = read_mesh_data(tmp_path / "out" / "body_asymmetry.ply")
    assert np.median(data.vertex_data["asymmetry"]) < 0.06


@pytest.mark.parametrize(
    ("words", "naming"),
    [
        (["left0.ply", "missing.ply"], "missing.ply"),
        (["left0.ply", "left0.ply"], "named left0"),
        (["left0.ply", "left1.ply", "--other-side", "right0.ply"], "same order"),
        (["left0.ply", "other.ply"], "another triangulation"),
        (["left0.ply", "--other-side", "other.ply"], "another triangulation"),
        (["left0.ply", "--other-side", "renumbered.ply"], "another triangulation"),
        (["left0.ply", "--permutations", "0"], "too small"),
        (["left0.ply", "--preset", "unknown"], "unknown"),
        (["left0.ply", "--seed", "-1"], "too small"),
        (["left0.ply", "--up", "up"], "up"),
        (["empty.ply"], "empty.ply"),
        (["text.ply"], "text.ply"),
        ([], "MESH"),
    ],
)
def test_bad_input_of_the_command_is_refused(run, bones, monkeypatch, words, naming):
    monkeypatch.chdir(bones)
    write_mesh("other.ply", bumpy_mesh(number=300))
    left = bumpy_mesh(1)
    write_mesh("renumbered.ply", make_mesh(left.vertices[::-1], len(left.vertices) - 1 - left.faces))
    Path("empty.ply").write_bytes(b"")
    Path("text.ply").write_text("no mesh\n")
    done = run("asymmetry", *words, "--output", "out", "--quiet")
    assert_refused(done, naming=naming)
    assert not (bones / "out").exists() or not list((bones / "out").iterdir())


def test_outputs_never_replace_inputs(run, bones):
    directory = bones / "mean"
    directory.mkdir()
    (bones / "left0.ply").rename(directory / "mean.ply")
    done = run("asymmetry", directory / "mean.ply", "--output", directory)
    assert_refused(done, naming="would be overwritten")
