"""BCICP: every step against its plain statement, the whole against cases with a known answer."""

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

K = 20


@pytest.fixture(scope="module")
def body() -> tuple[Mesh, Spectrum]:
    mesh = bumpy_mesh(3)
    return mesh, jaxsmw.compute_spectrum(mesh, K)


@pytest.fixture(scope="module")
def copy(body) -> tuple[Mesh, Spectrum, np.ndarray]:
    """The body with its vertices in another order: vertex i of the copy is vertex `order[i]` of the body."""
    return permuted(body[0])


@pytest.fixture(scope="module")
def surfaces(body, copy):
    return steps._Surface.of(copy[0], copy[1]), steps._Surface.of(*body)


def permuted(mesh: Mesh, seed: int = 0) -> tuple[Mesh, Spectrum, np.ndarray]:
    order = np.random.default_rng(seed).permutation(len(mesh.vertices))
    other = make_mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    return other, jaxsmw.compute_spectrum(other, K), order


def scrambled(truth: np.ndarray, mesh: Mesh, seed: int = 1) -> np.ndarray:
    """A start of which a tenth is random, and a connected cap is mapped to the other side."""
    generator = np.random.default_rng(seed)
    start = np.where(generator.random(len(truth)) < 0.1, generator.permutation(truth), truth)
    cap = mesh.vertices @ [0.6, 0.0, 0.8] > 0.8
    assert 0.03 < cap.mean() < 0.12
    start[cap] = truth[cdist(-mesh.vertices[cap], mesh.vertices).argmin(axis=1)]
    return start


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


def bent(x, y, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The true map, but for a small disc that lies on the other side; and which vertices that are."""
    disc = np.linalg.norm(x.positions - x.positions[7], axis=1) < 0.12
    assert 3 < disc.sum() < 30
    t = truth.copy()
    t[disc] = cdist(-x.positions[disc], y.positions).argmin(axis=1)
    return t, disc


def test_the_bijective_step_is_one_search_over_four_conditions(surfaces):
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


def test_coverage_improves_and_loses_nothing(surfaces):
    _, y = surfaces
    t, u = random_maps(surfaces)
    improved = steps._improve_coverage(y, t, u)
    assert set(t) < set(improved)
    assert len(set(improved)) > len(set(t)) + 50
    changed = improved != t
    np.testing.assert_array_equal(u[improved[changed]], np.flatnonzero(changed))
    # What is still uncovered could only have been covered by uncovering something.
    for uncovered in set(range(len(u))) - set(improved):
        assert np.sum(improved == improved[u[uncovered]]) == 1


def test_smoothing_averages_in_space(surfaces, copy):
    x, y = surfaces
    t, _ = random_maps(surfaces)
    averaging = dense_adjacency(copy[0]) + np.eye(len(t))
    averaging /= averaging.sum(axis=1, keepdims=True)
    expected = cdist(np.linalg.matrix_power(averaging, 3) @ y.positions[t], y.positions).argmin(axis=1)
    np.testing.assert_array_equal(steps._smooth(x, y, t, 3), expected)
    np.testing.assert_array_equal(steps._smooth(x, y, t, 0), t)


def test_torn_edges_are_those_with_distant_images(surfaces, body):
    x, y = surfaces
    t, _ = random_maps(surfaces)
    mesh = body[0]
    distance = np.where(dense_adjacency(mesh) > 0, cdist(mesh.vertices, mesh.vertices), np.inf)
    np.fill_diagonal(distance, 0)
    for middle in range(len(t)):
        distance = np.minimum(distance, distance[:, middle, None] + distance[middle])
    expected = distance[t[x.edges[:, 0]], t[x.edges[:, 1]]] > 0.1 * np.sqrt(mesh.area)
    found = steps._torn_edges(x, y, t)
    np.testing.assert_array_equal(found, expected)
    assert 0.5 < found.mean() < 1


def test_outliers_are_the_small_pieces(surfaces, copy):
    x, y = surfaces
    t, disc = bent(x, y, copy[2])
    np.testing.assert_array_equal(steps._outliers(x, y, t), disc)
    assert not steps._outliers(x, y, copy[2]).any()


def test_repair_interpolates_harmonically(surfaces, copy):
    x, y = surfaces
    t, disc = bent(x, y, copy[2])
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


def mended(body, copy, start: np.ndarray, back: np.ndarray, **options) -> np.ndarray:
    """Euclidean error of each vertex after BCICP, in edges of average length."""
    (mesh_y, spectrum_y), (mesh_x, spectrum_x, truth) = body, copy
    found, _ = bcicp(mesh_x, mesh_y, spectrum_x, spectrum_y, start, back, **options)
    edge = np.linalg.norm(np.diff(mesh_y.vertices[mesh_y.edges], axis=1), axis=2).mean()
    return np.linalg.norm(mesh_y.vertices[found] - mesh_y.vertices[truth], axis=1) / edge


def test_a_scrambled_copy_is_mended(body, copy):
    truth = copy[2]
    start, back = scrambled(truth, copy[0]), scrambled(np.argsort(truth), body[0], seed=3)
    assert np.mean(start != truth) > 0.12
    error = mended(body, copy, start, back)
    assert np.mean(error > 0) < 0.01


@pytest.mark.parametrize("change", [{"iterations": 1}, {"smoothing": 0}])
def test_every_option_matters(body, copy, surfaces, change):
    options = {"iterations": 2, "smoothing": 5}
    start, back = random_maps(surfaces)
    assert (
        mended(body, copy, start, back, **options) != mended(body, copy, start, back, **options | change)
    ).any()


def test_padding_and_signs_do_not_matter(body, copy):
    (mesh_y, spectrum_y), (mesh_x, spectrum_x, truth) = body, copy
    start, back = scrambled(truth, mesh_x), scrambled(np.argsort(truth), mesh_y, seed=3)
    plain = bcicp(mesh_x, mesh_y, spectrum_x, spectrum_y, start, back, iterations=3)
    n = len(truth)
    padded = bcicp(
        mesh_x,
        mesh_y,
        spectrum_x.pad(n + 9),
        spectrum_y.pad(n + 5),
        np.pad(start, (0, 9)),
        np.pad(back, (0, 5)),
        iterations=3,
    )
    for found, expected in zip(padded, plain, strict=True):
        np.testing.assert_array_equal(found[:n], expected)
        assert not found[n:].any()
    signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], K))
    flipped = eqx.tree_at(lambda s: s.eigenvectors, spectrum_x, spectrum_x.eigenvectors * signs[None, :])
    for found, expected in zip(
        bcicp(mesh_x, mesh_y, flipped, spectrum_y, start, back, iterations=3), plain, strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def hostile_mesh() -> Mesh:
    """A body, a separate open sheet, three sheets at one edge, and a vertex of no face in between."""
    body = bumpy_mesh(2)
    sheet, faces = grid_mesh(6, 6)
    n = len(body.vertices)
    vertices = np.concatenate(
        [body.vertices, [[9.0, 9.0, 9.0]], 0.3 * sheet + np.array([3, 0, 0]), [[3.1, 0.1, 0.5]]]
    )
    third = [[n + 1, n + 2, n + 1 + len(sheet)], [n + 1, n + 7, n + 1 + len(sheet)]]
    return make_mesh(vertices, np.concatenate([body.faces, faces + n + 1, third, [[n + 2, n + 7, n + 37]]]))


def test_hostile_meshes():
    mesh = hostile_mesh()
    assert len(mesh.nonmanifold_edges) and len(mesh.boundary_edges) and not mesh.used_vertices.all()
    spectrum, n = jaxsmw.compute_spectrum(mesh, K), len(mesh.vertices)
    used = np.flatnonzero(mesh.used_vertices)
    unused = np.flatnonzero(~mesh.used_vertices)
    generator = np.random.default_rng(0)
    start = np.where(generator.random(n) < 0.2, generator.choice(used, n), np.arange(n))
    start[unused] = unused
    surface = steps._Surface.of(mesh, spectrum)
    assert surface.areas[surface.component > 0].sum() < 0.05  # a small component is no outlier
    assert not steps._outliers(surface, surface, np.arange(len(used))).any()
    for found in bcicp(mesh, mesh, spectrum, spectrum, start, start, iterations=2, smoothing=5):
        assert found.dtype == np.int64 and found.shape == (n,)
        assert mesh.used_vertices[found[used]].all()
        np.testing.assert_array_equal(found[unused], unused)


def test_maps_that_cannot_be_are_refused(body, copy):
    (mesh_y, spectrum_y), (mesh_x, spectrum_x, truth) = body, copy
    good = mesh_x, mesh_y, spectrum_x, spectrum_y, truth, np.argsort(truth)
    n = len(truth)
    for number, wrong, message in [
        (4, truth[:-1], "no map"),
        (4, truth[:0], "no map"),
        (5, np.full(n, n), "no surface"),
        (5, np.full(n, -1), "no surface"),
        (3, spectrum_y.truncate(K - 1), "eigenvectors"),
        (2, spectrum_x.sample(jnp.arange(n - 1)), "but its spectrum"),
    ]:
        arguments = list(good)
        arguments[number] = wrong
        with pytest.raises(InputError, match=message):
            bcicp(*arguments)
    with pytest.raises(InputError, match="0 iterations"):
        bcicp(*good, iterations=0)


def test_a_published_result_is_nearly_reached(shared):
    """Gorilla to man, from the published starts: what the authors' program made of them is beside them."""
    directory = shared / "data" / "tosca_nonisometric"
    data_set = open_data_set(directory)
    (pair,) = [p for p in data_set.pairs if (p.source, p.target) == ("8_gorilla_02", "8_man_02")]
    mesh_x, mesh_y = jaxsmw.read_mesh(pair.source_file), jaxsmw.read_mesh(pair.target_file)

    def stored(kind: str, x: str, y: str, mesh_x: Mesh, mesh_y: Mesh) -> np.ndarray:
        file = directory / "maps" / kind / f"{x}_{y}.map"
        return jaxsmw.read_pointwise_map(file, mesh_x, mesh_y, index_base=1)

    start = stored("WKSini_direct", pair.source, pair.target, mesh_x, mesh_y)
    back = stored("WKSini_direct", pair.target, pair.source, mesh_y, mesh_x)
    published = stored("WKSini_direct_BCICP", pair.source, pair.target, mesh_x, mesh_y)
    spectrum_x, spectrum_y = (jaxsmw.compute_spectrum(mesh, 50) for mesh in (mesh_x, mesh_y))
    found, _ = bcicp(mesh_x, mesh_y, spectrum_x, spectrum_y, start, back, iterations=3)
    truth = pair.ground_truth(mesh_x, mesh_y)
    mean = {
        name: jaxsmw.geodesic_error(mesh_y, t, truth, number_of_samples=200).mean
        for name, t in (("start", start), ("found", found), ("published", published))
    }
    assert mean["found"] < 1.5 * mean["published"] < 0.5 * mean["start"], mean
