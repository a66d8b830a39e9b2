"""SmoothShells keeps its closed forms, recovers known maps from any pose, and matches the authors' errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

import jaxsmw
from jaxsmw.benchmark.datasets import open_data_set
from jaxsmw.benchmark.opponents import smooth_shells as steps
from jaxsmw.benchmark.opponents.base import MethodInput
from jaxsmw.benchmark.opponents.registry import METHODS
from jaxsmw.benchmark.opponents.smooth_shells import smooth_shells
from jaxsmw.creature import creature
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.stages import Sizes

pytestmark = pytest.mark.study

TURN = Rotation.from_euler("xyz", [100, 40, -70], degrees=True).as_matrix()


@pytest.fixture(scope="module")
def surface() -> steps._UnitSurface:
    mesh = bumpy_mesh(3)
    return steps._UnitSurface.of(mesh, np.zeros((len(mesh.vertices), 0)), 60)


def turned_copy(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """A rotated copy in another vertex order: vertex i of the copy is vertex `order[i]` of the mesh."""
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    return make_mesh(mesh.vertices[order] @ TURN.T + 3, np.argsort(order)[mesh.faces]), order


def no_descriptors(mesh: Mesh) -> np.ndarray:
    return np.zeros((len(mesh.vertices), 0))


def test_a_shell_is_the_filtered_surface(surface):
    level = 12
    positions = np.zeros_like(surface.positions)
    for number, (phi, dual) in enumerate(zip(surface.eigenvectors.T, surface.dual.T, strict=True), start=1):
        positions += np.outer(phi, dual @ surface.positions) / (1 + np.exp(0.2 * (number - level)))
    shell = surface.shell(level)
    # Frequencies far above the level are left out, because their filter values are at most 0.001.
    np.testing.assert_allclose(shell.positions, positions, atol=1e-4)
    assert shell.level == level
    np.testing.assert_allclose(np.linalg.norm(shell.normals, axis=1), 1)
    # Coefficients from samples are nearly those from all vertices.
    sampled = shell.sample(np.arange(0, len(positions), 2))
    functions = shell.eigenvectors @ np.linspace(-1, 1, 2 * level).reshape(level, 2)
    np.testing.assert_allclose(sampled.dual.T @ functions[::2], shell.dual.T @ functions, atol=5e-4)


def test_a_turned_shell_is_a_fixed_point_of_the_rigid_deformation(surface):
    shell = surface.shell(20)
    # The shell of level 20 contains higher frequencies, which the first 20 eigenvectors cannot represent.
    low = shell.eigenvectors @ (shell.dual.T @ shell.positions)
    shell = shell._replace(positions=low)
    turned = low @ TURN.T
    np.testing.assert_allclose(
        surface.rotations_to(low, turned), np.broadcast_to(TURN, (len(low), 3, 3)), atol=1e-8
    )
    moved = steps._as_rigid_as_possible(surface, shell, turned, turned)
    np.testing.assert_allclose(moved, turned, atol=1e-10)


def test_the_rigid_deformation_lowers_its_energy(surface):
    shell = surface.shell(20)
    targets = shell.positions * [1.5, 1.0, 0.7]
    start = shell.eigenvectors @ (shell.dual.T @ targets)
    moved = steps._as_rigid_as_possible(surface, shell, targets, start)

    def energy(positions: np.ndarray) -> float:
        fidelity = surface.dual[:, 0] / surface.eigenvectors[:, 0] @ ((positions - targets) ** 2).sum(axis=1)
        rotations = surface.rotations_to(shell.positions, positions)
        means = 0.5 * np.einsum("en,nij->eij", abs(surface.differences).toarray(), rotations)
        stretched = surface.differences @ positions
        stretched -= np.einsum("eij,ej->ei", means, surface.differences @ shell.positions)
        return fidelity + steps._RIGIDITY * surface.weights @ (stretched**2).sum(axis=1)

    assert energy(moved) < energy(start)
    generator = np.random.default_rng(0)
    for _ in range(5):
        step = 1e-2 * shell.eigenvectors @ generator.normal(size=(20, 3))
        assert energy(moved) < energy(moved + step)


@pytest.mark.sampled
def test_a_turned_copy_is_recovered_exactly():
    body = creature("biped", vertices=800)
    copy, order = turned_copy(body)
    prepared = prepare(Pair(copy, body), Sizes(30)).describe(15)
    descriptors = [np.asarray(spectrum.descriptors) for spectrum in prepared.spectra.both]
    found = smooth_shells(copy, body, *descriptors, number_of_eigenvectors=60, proposals=30)
    np.testing.assert_array_equal(found, order)
    again = smooth_shells(copy, body, *descriptors, number_of_eigenvectors=60, proposals=30)
    np.testing.assert_array_equal(again, found)
    # From the given pose alone, the map is wrong: the other poses are needed.
    alone = smooth_shells(copy, body, *descriptors, number_of_eigenvectors=60, proposals=1)
    assert np.mean(alone != order) > 0.2


@pytest.mark.parametrize("wrong", [{"number_of_eigenvectors": 0}, {"proposals": 0}])
def test_impossible_settings_are_refused(wrong):
    mesh = bumpy_mesh(2)
    with pytest.raises(InputError, match="give at least 1"):
        smooth_shells(mesh, mesh, no_descriptors(mesh), no_descriptors(mesh), **wrong)


@pytest.mark.sampled
def test_the_error_is_at_most_the_error_of_the_authors_program(shared):
    pair = open_data_set(shared / "data/faust_r").known_pairs["tr_reg_000", "tr_reg_004"]
    mesh_x, mesh_y = map(jaxsmw.read_mesh, pair.meshes)
    truth = pair.ground_truth(mesh_x, mesh_y)
    method = METHODS["smooth-shells"]
    given = MethodInput.prepare(
        Pair(mesh_x, mesh_y),
        names=pair.names,
        sizes=Sizes(30, number_of_samples=1000),
        number_of_descriptors=method.number_of_descriptors,
    )
    found = replace(method, last_level=200)(given)
    theirs = np.loadtxt(shared / "oracle/smooth_shells/tr_reg_000__tr_reg_004.txt", dtype=int)
    mean = {
        program: jaxsmw.geodesic_error(mesh_y, pointwise_map, truth, number_of_samples=200).mean
        for program, pointwise_map in (
            ("ours", np.asarray(found)[: len(mesh_x.vertices)]),
            ("theirs", theirs),
        )
    }
    assert mean["ours"] < 1.15 * mean["theirs"] < 0.02, mean
