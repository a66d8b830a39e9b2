import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh, in_precision, stacked, to_namespace

from jaxsmw.core.refinement import refine
from jaxsmw.core.refiner import Problem
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration, _nearest_rotations
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.creature import creature_pair
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import make_mesh

K = 60


def changed(mesh, order, motion):
    """Return the mesh with reordered vertices that are moved by `motion`."""
    place = np.argsort(order)
    return make_mesh(motion(mesh.vertices[order]), place[mesh.faces])


@pytest.fixture(scope="module")
def pair():
    """Two spectra, an initial map that is nearly right, the true map, and the mesh of X.

    Y is a rotated, scaled, translated and renumbered copy of X.
    """
    mesh = bumpy_mesh(3)
    generator = np.random.default_rng(0)
    order = generator.permutation(len(mesh.vertices))
    turn = Rotation.from_rotvec([0.3, 2.2, -1.0]).as_matrix()
    moved = changed(mesh, order, lambda vertices: 7 * vertices @ turn.T + [100, -50, 3])
    truth = np.argsort(order)
    disturbed = mesh.vertices + 0.15 * generator.normal(size=mesh.vertices.shape)
    initial_map = truth[KDTree(mesh.vertices).query(disturbed)[1]]
    return (
        compute_spectrum(mesh, K),
        compute_spectrum(moved, K),
        jnp.asarray(initial_map, jnp.int32),
        truth,
        mesh,
    )


def by_definition(x: Spectrum, y: Spectrum, t, levels):
    """Return the map and the embeddings of X and of Y after one iteration for each level.

    The rotations are computed vertex by vertex with singular value decompositions.
    """

    def own(s):
        a, lam = np.asarray(s.vertex_areas), np.asarray(s.eigenvalues)
        positions = np.asarray(s.positions) - a @ np.asarray(s.positions)
        smooth = 0.2 * np.asarray(s.eigenvectors)[:, :50] / np.sqrt(1 + lam[:50])
        points = np.hstack([positions, 0.02 * np.asarray(s.normals), smooth])
        return positions, np.asarray(s.normals), points

    def deformed(s, o, matches, level):
        phi, a, lam = (np.asarray(f) for f in (s.eigenvectors, s.vertex_areas, s.eigenvalues))
        (positions, normals, _), (_, others, points) = own(s), own(o)
        matched, matched_normals = points[matches], others[matches]
        time = max(3e-3, 4 / lam[-1])
        heat = phi @ (np.exp(-time * lam)[:, None] * phi.T) * a
        low = phi[:, :level] @ phi[:, :level].T * a
        mean_x, mean_y = heat @ positions, heat @ matched[:, :3]
        rotations = []
        for i, row in enumerate(heat):
            second = np.einsum("j,ja,jb->ab", row, positions, matched[:, :3])
            spread = second - np.outer(mean_x[i], mean_y[i])
            normal_products = np.einsum("j,ja,jb->ab", row, normals, matched_normals)
            u, _, vt = np.linalg.svd(spread / (2 * time) + normal_products)
            rotations.append((u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T)
        rotations = np.array(rotations)
        details = np.einsum("iab,ib->ia", rotations, positions - low @ positions)
        place = low @ matched
        place[:, :3] += details
        place[:, 3:6] = 0.02 * np.einsum("iab,ib->ia", rotations, normals)
        return place

    reverse_map = None
    for level in levels:
        forward = deformed(x, y, t, level)
        of_x, of_y = own(x)[2], own(y)[2]
        targets, reverse_queries = (forward, of_y) if reverse_map is None else (queries, database)
        reverse_map = KDTree(targets).query(reverse_queries)[1]
        described = [
            2.8 / level**1.5 * np.asarray(s.descriptors) for s in (x, y) if s.descriptors is not None
        ]
        queries = np.hstack([forward, of_x, *described[:1]])
        database = np.hstack([of_y, deformed(y, x, reverse_map, level), *described[1:]])
        t = KDTree(database).query(queries)[1]
    return t, queries, database


@pytest.mark.parametrize("number_of_descriptors", first_always([5, 0]))
def test_refinement_agrees_with_the_definition(pair, number_of_descriptors, refine):
    x, y, initial_map, *_ = pair
    if number_of_descriptors:
        generator = np.random.default_rng(2)
        x, y = (s.with_descriptors(jnp.asarray(generator.normal(size=(len(s.mask), 5)))) for s in (x, y))
    refiner = Registration((20,))
    found = refine(x, y, initial_map, refiner=refiner, iterations=2, history=True)
    t, queries, database = by_definition(x, y, np.asarray(initial_map), (20, K))
    np.testing.assert_array_equal(found.pointwise_map, t)
    for points, expected in zip(
        refiner.embeddings(refiner.prepare(Problem(x, y)), found.state), (queries, database), strict=True
    ):
        np.testing.assert_allclose(points, expected, atol=1e-8)
    distances = np.sum((queries - database[t]) ** 2, axis=1)
    np.testing.assert_allclose(found.history.objective[1], np.asarray(x.vertex_areas) @ distances, rtol=1e-6)


def test_nearest_rotations_agree_with_singular_value_decompositions(namespace):
    """Some matrices are rotations by 180 degrees, or have a reflection as the nearest orthogonal matrix."""
    generator = np.random.default_rng(0)
    turns = Rotation.random(40, rng=generator).as_matrix()
    covariances = np.concatenate(
        [generator.normal(size=(200, 3, 3)), turns * [1, 2, 3], np.diag([1.0, -1, -1])[None], np.eye(3)[None]]
    )
    assert (np.linalg.det(covariances) < 0).sum() > 50
    u, _, vt = np.linalg.svd(covariances)
    hand = np.linalg.det(u @ vt)
    expected = np.einsum("nia,na,naj->nji", u, np.stack([hand**0, hand**0, hand], axis=1), vt)
    found = np.asarray(_nearest_rotations(to_namespace(covariances, namespace)))
    np.testing.assert_allclose(
        found @ np.swapaxes(found, 1, 2), np.broadcast_to(np.eye(3), found.shape), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=1e-9)
    gain, best = (np.einsum("nij,nji->n", r, covariances) for r in (found, expected))
    np.testing.assert_allclose(gain, best, rtol=1e-3)
    clear = np.abs(gain - best) < 1e-9
    assert clear.mean() > 0.9
    np.testing.assert_allclose(found[clear], expected[clear], atol=1e-4)
    assert np.isfinite(_nearest_rotations(to_namespace(np.zeros((1, 3, 3)), namespace))).all()


def test_a_moved_copy_is_matched_exactly(pair, refine):
    x, y, initial_map, truth, _ = pair
    assert np.mean(np.asarray(initial_map) == truth) < 0.3
    found = refine(x, y, initial_map, refiner=Registration((20, 40)), iterations=4)
    assert found.result == RESULTS.successful
    np.testing.assert_array_equal(found.pointwise_map, truth)
    # The embeddings of matched vertices are equal.
    queries, database = Registration().embeddings(Registration().prepare(Problem(x, y)), found.state)
    np.testing.assert_allclose(queries, np.asarray(database)[truth], atol=1e-6)


def test_a_mirror_image_is_matched_exactly(pair, refine):
    x, _, initial_map, truth, mesh = pair
    order = np.argsort(truth)
    mirrored = changed(mesh, order, lambda vertices: vertices * [-1, 1, 1])
    mirrored = make_mesh(mirrored.vertices, mirrored.faces[:, ::-1])
    found = refine(
        x, compute_spectrum(mirrored, K), initial_map, refiner=Registration((20, 40)), iterations=4
    )
    np.testing.assert_array_equal(found.pointwise_map, truth)


def test_the_orientation_of_faces_does_not_matter(pair, refine):
    x, y, initial_map, _, mesh = pair
    turned = compute_spectrum(make_mesh(mesh.vertices, mesh.faces[:, ::-1]), K)
    np.testing.assert_allclose(turned.normals, x.normals, atol=1e-12)
    np.testing.assert_array_equal(
        *(refine(one, y, initial_map, refiner=Registration()).pointwise_map for one in (turned, x))
    )


@pytest.mark.slow
def test_is_more_accurate_than_refiners_that_use_only_eigenfunctions():
    """The target has another pose and another triangulation than the source."""
    pair = creature_pair(vertices=1200, seed=3)
    x, y = (compute_spectrum(mesh, 100) for mesh in (pair.source, pair.target))
    target, place = pair.target.vertices, pair.truth.positions(pair.target)
    unit = pair.target.area**0.5
    disturbed = place + 0.05 * unit * np.random.default_rng(0).normal(size=place.shape)
    initial_map = jnp.asarray(KDTree(target).query(disturbed)[1], jnp.int32)

    def error(refiner):
        found = refine(x, y, initial_map, refiner=refiner, iterations=4).pointwise_map
        return np.linalg.norm(target[np.asarray(found)] - place, axis=1).mean() / unit

    best = error(Registration((30, 50, 70)))
    for other in (WaveletPreservation(), FeatureRegression((30, 50, 70))):
        assert best < 0.9 * error(other)


@pytest.mark.slow
def test_signs_padding_and_vmap_do_not_change_the_map(pair):
    x, y, initial_map, *_ = pair
    refiner = Registration((20, 40))
    plain = refine(x, y, initial_map, refiner=refiner, history=True)
    generator = np.random.default_rng(4)
    flipped = [
        eqx.tree_at(lambda s: s.eigenvectors, s, s.eigenvectors * generator.choice([-1.0, 1.0], (1, K)))
        for s in (x, y)
    ]
    np.testing.assert_array_equal(
        refine(*flipped, initial_map, refiner=refiner).pointwise_map, plain.pointwise_map
    )
    m = len(initial_map)
    wide = refine(x.pad(m + 30), y.pad(m + 30), jnp.pad(initial_map, (0, 30)), refiner=refiner, history=True)
    np.testing.assert_array_equal(wide.pointwise_map[:m], plain.pointwise_map)
    np.testing.assert_allclose(wide.history.energy, plain.history.energy, rtol=1e-9, atol=1e-12)
    reverse_map = jnp.asarray(KDTree(np.asarray(y.positions)).query(np.asarray(x.positions))[1], jnp.int32)
    both = eqx.filter_vmap(lambda *arguments: refine(*arguments, refiner=refiner))(
        stacked(x, y), stacked(y, x), jnp.stack([initial_map, reverse_map])
    )
    np.testing.assert_array_equal(both.pointwise_map[0], plain.pointwise_map)
    np.testing.assert_array_equal(
        both.pointwise_map[1], refine(y, x, reverse_map, refiner=refiner).pointwise_map
    )


def test_samples_are_queries_and_all_vertices_are_targets(pair, refine):
    x, y, initial_map, truth, _ = pair
    generator = np.random.default_rng(1)
    samples = [jnp.asarray(generator.choice(len(truth), 300, replace=False)) for _ in "xy"]
    found = refine(x, y, initial_map, refiner=Registration((20,)), samples=(samples[0], samples[1]))
    assert np.mean(np.asarray(found.pointwise_map) == truth) > 0.95


def test_the_shapes_can_have_different_numbers_of_eigenvectors(pair, refine):
    """With fewer than 50 eigenvectors, the shapes also have different numbers of smooth coordinates."""
    x, y, initial_map, truth, _ = pair
    found = refine(x.truncate(30), y.truncate(20), initial_map, refiner=Registration((15, 30)), iterations=2)
    assert np.mean(np.asarray(found.pointwise_map) == truth) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("sampled", first_always([True, False]))
@pytest.mark.parametrize("refiner", [Registration((20, 30)), FeatureRegression((20, 30))])
def test_both_maps_of_a_state_are_recovered_together(pair, refiner, sampled, namespace):
    x, y, initial_map, truth = to_namespace(pair[:4], namespace)
    samples = (np.arange(0, len(truth), 3), np.arange(0, len(truth), 4)) if sampled else None
    samples = to_namespace(samples, namespace)
    prepared = refiner.prepare(Problem(x, y, samples))
    start = initial_map[samples[0]] if sampled else initial_map
    update, recover_both = refiner.update, refiner.recover_both
    if namespace == "jax":
        update, recover_both = eqx.filter_jit(update), eqx.filter_jit(recover_both)
    state, _ = update(prepared, start, None)
    state, _ = update(prepared, *recover_both(prepared, state))
    found, completed = recover_both(prepared, state)
    np.testing.assert_array_equal(found, refiner.recover(prepared, state))
    assert state.reverse_map is None
    if isinstance(refiner, Registration):
        everywhere = refiner.recover_reverse(refiner.prepare(Problem(x, y)), state)
        expected = everywhere[samples[1]] if sampled else everywhere
    else:
        expected = nearest_neighbor(*state.backward.embeddings(prepared.y, prepared.all_x))
    np.testing.assert_array_equal(completed.reverse_map, expected)


def test_a_partial_shape_keeps_its_size(pair):
    """A partial pair is scaled by one common factor, whereas two full shapes are each scaled to area 1."""
    x, *_, mesh = pair
    kept = mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0.3
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    part = make_mesh(mesh.vertices[used], faces.reshape(-1, 3))
    y = compute_spectrum(part, 10).scale(part.area / mesh.area)
    spread = []
    for partial in (True, False):
        prepared = Registration().prepare(Problem(x, y, partial=partial))
        positions = np.asarray(prepared.all_x.points)[used, :3], np.asarray(prepared.all_y.points)[:, :3]
        spread.append([np.linalg.norm(points[1:] - points[:-1], axis=1) for points in positions])
    np.testing.assert_allclose(spread[0][1], spread[0][0], rtol=1e-9)
    np.testing.assert_allclose(spread[1][1], spread[1][0] * (mesh.area / part.area) ** 0.5, rtol=1e-9)


def test_float32_stays_float32_and_agrees(pair, refine):
    x, y, initial_map, truth, _ = pair
    single = in_precision((x, y), np.float32)
    found = refine(*single, initial_map, refiner=Registration((20, 40)), iterations=4)
    assert {leaf.dtype for leaf in jax.tree.leaves(found.state)} == {
        np.dtype(np.float32),
        np.dtype(np.int32),
    }
    np.testing.assert_array_equal(found.pointwise_map, truth)


def test_does_not_stop_before_the_last_level(pair, refine):
    x, y, initial_map, *_ = pair
    refiner = Registration((20,) * 8)
    found = refine(x, y, initial_map, refiner=refiner, iterations=40, stop_when_unchanged=True)
    assert 9 < found.iterations < 40


def test_a_single_constant_eigenvector_is_no_failure(pair, refine):
    x, y, initial_map, *_ = pair
    found = refine(x.truncate(1), y.truncate(1), initial_map, refiner=Registration())
    assert found.result == RESULTS.successful and (np.asarray(found.pointwise_map) >= 0).all()


def test_invalid_spectra_and_settings_are_refused(pair, refine):
    x, y, initial_map, *_ = pair
    bare = Spectrum(y.eigenvalues, y.eigenvectors, y.vertex_areas, y.mask)
    with pytest.raises(ValueError, match=r"positions and normals.*Spectrum\.with_positions"):
        refine(x, bare, initial_map, refiner=Registration())
    placed = refine(x, bare.with_positions(y.positions, y.normals), initial_map, refiner=Registration())
    np.testing.assert_array_equal(
        placed.pointwise_map, refine(x, y, initial_map, refiner=Registration()).pointwise_map
    )
    with pytest.raises(ValueError, match="X has 2 descriptors and Y has 0"):
        refine(x.with_descriptors(x.eigenvectors[:, :2]), y, initial_map, refiner=Registration())
    with pytest.raises(ValueError, match="needs at least 1 eigenvector"):
        Registration((20, 0))
    broken = x.with_positions(x.positions.at[3, 1].set(jnp.nan), x.normals)
    found = refine(broken, y, initial_map, refiner=Registration())
    assert found.result == RESULTS.nonfinite_spectrum and (np.asarray(found.pointwise_map) == -1).all()
