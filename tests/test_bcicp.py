"""Each step of BCICP agrees with a plain NumPy implementation, and the method recovers known maps."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from synthetic import bumpy_mesh, grid_mesh

import jaxsmw
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.evaluation.datasets import open_data_set
from jaxsmw.evaluation.opponents import bcicp as steps
from jaxsmw.evaluation.opponents.bcicp import bcicp
from jaxsmw.geometry.mesh import Mesh, make_mesh

pytestmark = pytest.mark.study

K = 20


@pytest.fixture(scope="module")
def body() -> tuple[Mesh, Spectrum]:
    mesh = bumpy_mesh(3)
    return mesh, jaxsmw.compute_spectrum(mesh, K)


@pytest.fixture(scope="module")
def copy(body) -> tuple[Mesh, Spectrum, np.ndarray]:
    """A copy of the body in another vertex order: vertex i of the copy is vertex `order[i]` of the body."""
    return permuted(body[0])


@pytest.fixture(scope="module")
def surfaces(body, copy):
    return steps._Surface.of(copy[0], copy[1]), steps._Surface.of(*body)


def permuted(mesh: Mesh, seed: int = 0) -> tuple[Mesh, Spectrum, np.ndarray]:
    order = np.random.default_rng(seed).permutation(len(mesh.vertices))
    other = make_mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    return other, jaxsmw.compute_spectrum(other, K), order


def scrambled(truth: np.ndarray, mesh: Mesh, seed: int = 1) -> np.ndarray:
    """Return `truth` with 10 % random matches, and with a cap of the mesh matched to the opposite side."""
    generator = np.random.default_rng(seed)
    initial_map = np.where(generator.random(len(truth)) < 0.1, generator.permutation(truth), truth)
    cap = mesh.vertices @ [0.6, 0.0, 0.8] > 0.8
    assert 0.03 < cap.mean() < 0.12
    initial_map[cap] = truth[cdist(-mesh.vertices[cap], mesh.vertices).argmin(axis=1)]
    return initial_map


def random_maps(surfaces, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    n = len(surfaces[0].areas)
    generator = np.random.default_rng(seed)
    return generator.integers(0, n, n), generator.integers(0, n, n)


def dense_adjacency(mesh: Mesh) -> np.ndarray:
    adjacency = np.zeros((len(mesh.vertices),) * 2)
    for face in mesh.faces:
        for i, j in zip(face, np.roll(face, 1), strict=True):
            adjacency[i, j] = adjacency[j, i] = 1
    return adjacency


def with_wrong_disc(x, y, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the true map with a small disc matched to the opposite side, and a mask of this disc."""
    disc = np.linalg.norm(x.positions - x.positions[7], axis=1) < 0.12
    assert 3 < disc.sum() < 30
    t = truth.copy()
    t[disc] = cdist(-x.positions[disc], y.positions).argmin(axis=1)
    return t, disc


def test_the_bijective_step_minimizes_the_sum_of_four_distances(surfaces):
    x, y = surfaces
    t, u = random_maps(surfaces)
    phi, psi = x.eigenvectors, y.eigenvectors
    p, q = np.eye(len(u))[t], np.eye(len(t))[u]

    def functional(dual_areas, out, matrix, basis):
        left, _, right = np.linalg.svd((out * dual_areas[:, None]).T @ matrix @ basis)
        return left @ right

    c_xy, c_yx = functional(x.areas, phi, p, psi), functional(y.areas, psi, q, phi)
    c_xx, c_yy = functional(x.areas, phi, p @ q, phi), functional(y.areas, psi, q @ p, psi)
    squared = (
        cdist(phi, psi @ c_xy.T) ** 2
        + cdist(phi @ c_yx.T, psi) ** 2
        + cdist(phi, psi @ (c_xx.T @ c_xy).T) ** 2
        + cdist(phi @ (c_yy.T @ c_yx).T, psi) ** 2
    )
    found = steps._bijective_step(x, y, t, u)
    np.testing.assert_array_equal(found[0], squared.argmin(axis=1))
    np.testing.assert_array_equal(found[1], squared.argmin(axis=0))


def test_coverage_improves_and_covered_vertices_stay_covered(surfaces):
    _, y = surfaces
    t, u = random_maps(surfaces)
    improved = steps._improve_coverage(y, t, u)
    assert set(t) < set(improved)
    assert len(set(improved)) > len(set(t)) + 50
    changed = improved != t
    np.testing.assert_array_equal(u[improved[changed]], np.flatnonzero(changed))
    # A vertex stays uncovered only if a new match to this vertex would leave another vertex uncovered.
    for uncovered in set(range(len(u))) - set(improved):
        assert np.sum(improved == improved[u[uncovered]]) == 1


def test_smoothing_averages_positions_of_matches(surfaces, copy):
    x, y = surfaces
    t, _ = random_maps(surfaces)
    averaging = dense_adjacency(copy[0]) + np.eye(len(t))
    averaging /= averaging.sum(axis=1, keepdims=True)
    expected = cdist(np.linalg.matrix_power(averaging, 3) @ y.positions[t], y.positions).argmin(axis=1)
    np.testing.assert_array_equal(steps._smooth(x, y, t, 3), expected)
    np.testing.assert_array_equal(steps._smooth(x, y, t, 0), t)


def test_discontinuous_edges_have_distant_matches(surfaces, body):
    x, y = surfaces
    t, _ = random_maps(surfaces)
    mesh = body[0]
    distance = np.where(dense_adjacency(mesh) > 0, cdist(mesh.vertices, mesh.vertices), np.inf)
    np.fill_diagonal(distance, 0)
    for middle in range(len(t)):
        distance = np.minimum(distance, distance[:, middle, None] + distance[middle])
    expected = distance[t[x.edges[:, 0]], t[x.edges[:, 1]]] > 0.1 * np.sqrt(mesh.area)
    found = steps._discontinuous_edges(x, y, t)
    np.testing.assert_array_equal(found, expected)
    assert 0.5 < found.mean() < 1


def test_a_small_region_with_wrong_matches_is_an_outlier(surfaces, copy):
    x, y = surfaces
    t, disc = with_wrong_disc(x, y, copy[2])
    np.testing.assert_array_equal(steps._outliers(x, y, t), disc)
    assert not steps._outliers(x, y, copy[2]).any()


def test_outliers_are_repaired_by_harmonic_interpolation(surfaces, copy):
    x, y = surfaces
    t, disc = with_wrong_disc(x, y, copy[2])
    adjacency = dense_adjacency(copy[0])
    laplacian = np.diag(adjacency.sum(axis=1)) - adjacency
    known = y.eigenvectors[t[~disc]]
    inside = np.linalg.solve(laplacian[np.ix_(disc, disc)], -laplacian[np.ix_(disc, ~disc)] @ known)
    expected = t.copy()
    expected[disc] = cdist(inside, y.eigenvectors).argmin(axis=1)
    repaired = steps._repair(x, y, t)
    np.testing.assert_array_equal(repaired, expected)
    distance = np.linalg.norm(y.positions[repaired] - y.positions[copy[2]], axis=1)
    assert distance.max() < 0.1 < np.linalg.norm(y.positions[t] - y.positions[copy[2]], axis=1).max()


def errors_after_bcicp(body, copy, initial_map: np.ndarray, reverse: np.ndarray, **options) -> np.ndarray:
    """Return the Euclidean error of each vertex after BCICP, in units of the mean edge length of Y."""
    (mesh_y, spectrum_y), (mesh_x, spectrum_x, truth) = body, copy
    found, _ = bcicp(mesh_x, mesh_y, spectrum_x, spectrum_y, initial_map, reverse, **options)
    edge = np.linalg.norm(np.diff(mesh_y.vertices[mesh_y.edges], axis=1), axis=2).mean()
    return np.linalg.norm(mesh_y.vertices[found] - mesh_y.vertices[truth], axis=1) / edge


def test_scrambled_initial_maps_are_repaired(body, copy):
    truth = copy[2]
    initial_map, reverse = scrambled(truth, copy[0]), scrambled(np.argsort(truth), body[0], seed=3)
    assert np.mean(initial_map != truth) > 0.12
    error = errors_after_bcicp(body, copy, initial_map, reverse)
    assert np.mean(error > 0) < 0.01


@pytest.mark.parametrize("change", [{"iterations": 1}, {"smoothing": 0}])
def test_every_option_changes_the_result(body, copy, surfaces, change):
    options = {"iterations": 2, "smoothing": 5}
    initial_maps = random_maps(surfaces)
    plain, changed = (
        errors_after_bcicp(body, copy, *initial_maps, **chosen) for chosen in (options, options | change)
    )
    assert (plain != changed).any()


def test_padding_and_signs_have_no_effect(body, copy):
    (mesh_y, spectrum_y), (mesh_x, spectrum_x, truth) = body, copy
    initial_map, reverse = scrambled(truth, mesh_x), scrambled(np.argsort(truth), mesh_y, seed=3)
    plain = bcicp(mesh_x, mesh_y, spectrum_x, spectrum_y, initial_map, reverse, iterations=3)
    n = len(truth)
    padded = bcicp(
        mesh_x,
        mesh_y,
        spectrum_x.pad(n + 9),
        spectrum_y.pad(n + 5),
        np.pad(initial_map, (0, 9)),
        np.pad(reverse, (0, 5)),
        iterations=3,
    )
    for found, expected in zip(padded, plain, strict=True):
        np.testing.assert_array_equal(found[:n], expected)
        assert not found[n:].any()
    signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], K))
    flipped = eqx.tree_at(lambda s: s.eigenvectors, spectrum_x, spectrum_x.eigenvectors * signs[None, :])
    for found, expected in zip(
        bcicp(mesh_x, mesh_y, flipped, spectrum_y, initial_map, reverse, iterations=3), plain, strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def nonmanifold_mesh() -> Mesh:
    """A mesh of a closed body, an open sheet with nonmanifold edges, and an unreferenced vertex."""
    body = bumpy_mesh(2)
    sheet, faces = grid_mesh(6, 6)
    n = len(body.vertices)
    vertices = np.concatenate(
        [body.vertices, [[9.0, 9.0, 9.0]], 0.3 * sheet + np.array([3, 0, 0]), [[3.1, 0.1, 0.5]]]
    )
    third = [[n + 1, n + 2, n + 1 + len(sheet)], [n + 1, n + 7, n + 1 + len(sheet)]]
    return make_mesh(vertices, np.concatenate([body.faces, faces + n + 1, third, [[n + 2, n + 7, n + 37]]]))


def test_nonmanifold_meshes_with_unreferenced_vertices_get_valid_maps():
    mesh = nonmanifold_mesh()
    assert len(mesh.nonmanifold_edges) and len(mesh.boundary_edges) and not mesh.referenced_vertices.all()
    spectrum, n = jaxsmw.compute_spectrum(mesh, K), len(mesh.vertices)
    used = np.flatnonzero(mesh.referenced_vertices)
    unreferenced = np.flatnonzero(~mesh.referenced_vertices)
    generator = np.random.default_rng(0)
    initial_map = np.where(generator.random(n) < 0.2, generator.choice(used, n), np.arange(n))
    initial_map[unreferenced] = unreferenced
    surface = steps._Surface.of(mesh, spectrum)
    # BCICP must not treat a small connected component as an outlier.
    assert surface.areas[surface.component > 0].sum() < 0.05
    assert not steps._outliers(surface, surface, np.arange(len(used))).any()
    for found in bcicp(mesh, mesh, spectrum, spectrum, initial_map, initial_map, iterations=2, smoothing=5):
        assert found.dtype == np.int64 and found.shape == (n,)
        assert mesh.referenced_vertices[found[used]].all()
        np.testing.assert_array_equal(found[unreferenced], unreferenced)


def test_impossible_arguments_are_refused(body, copy):
    (mesh_y, spectrum_y), (mesh_x, spectrum_x, truth) = body, copy
    good = mesh_x, mesh_y, spectrum_x, spectrum_y, truth, np.argsort(truth)
    n = len(truth)
    for number, wrong, message in [
        (4, truth[:-1], "not a pointwise map"),
        (4, truth[:0], "not a pointwise map"),
        (5, np.full(n, n), "no face references"),
        (5, np.full(n, -1), "no face references"),
        (3, spectrum_y.truncate(K - 1), "eigenvectors"),
        (2, spectrum_x.sample(jnp.arange(n - 1)), "but its spectrum"),
    ]:
        arguments = list(good)
        arguments[number] = wrong
        with pytest.raises(InputError, match=message):
            bcicp(*arguments)
    with pytest.raises(InputError, match="0 iterations"):
        bcicp(*good, iterations=0)


def test_the_error_is_close_to_the_error_of_the_published_map(shared):
    """The pair consists of a gorilla and a man. Its initial maps and the result of BCICP are published."""
    directory = shared / "data" / "tosca_nonisometric"
    data_set = open_data_set(directory)
    (pair,) = [p for p in data_set.pairs if (p.source, p.target) == ("8_gorilla_02", "8_man_02")]
    mesh_x, mesh_y = jaxsmw.read_mesh(pair.source_file), jaxsmw.read_mesh(pair.target_file)

    def stored(kind: str, x: str, y: str, mesh_x: Mesh, mesh_y: Mesh) -> np.ndarray:
        file = directory / "maps" / kind / f"{x}_{y}.map"
        return jaxsmw.read_pointwise_map(file, mesh_x, mesh_y, index_base=1)

    initial_map = stored("WKSini_direct", pair.source, pair.target, mesh_x, mesh_y)
    reverse = stored("WKSini_direct", pair.target, pair.source, mesh_y, mesh_x)
    published = stored("WKSini_direct_BCICP", pair.source, pair.target, mesh_x, mesh_y)
    spectrum_x, spectrum_y = (jaxsmw.compute_spectrum(mesh, 50) for mesh in (mesh_x, mesh_y))
    found, _ = bcicp(mesh_x, mesh_y, spectrum_x, spectrum_y, initial_map, reverse, iterations=3)
    truth = pair.ground_truth(mesh_x, mesh_y)
    mean = {
        name: jaxsmw.geodesic_error(mesh_y, t, truth, number_of_samples=200).mean
        for name, t in (("initial", initial_map), ("found", found), ("published", published))
    }
    assert mean["found"] < 1.5 * mean["published"] < 0.5 * mean["initial"], mean
