"""The parts of collections: graph, cycles, hands, synchronisation and batches."""

import warnings
from dataclasses import replace
from itertools import combinations, permutations

import jax
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from synthetic import bumpy_mesh

from jaxsmw import InputError, creature_pair, match
from jaxsmw.collection import (
    Network,
    choose_edges,
    choose_hands,
    edge_errors,
    hands,
    match_pairs,
    synchronize,
)
from jaxsmw.collection.consistency import cycle_error, estimate_edge_errors, find_outliers, triangles
from jaxsmw.collection.hands import compare_hands
from jaxsmw.collection.pairs import prepare_task
from jaxsmw.collection.shapes import prepare_collection, prepare_shape, preset_key
from jaxsmw.collection.synchronization import carry, robust_mean, vertices_as_points
from jaxsmw.core.banks import LowPass
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.creature import creature
from jaxsmw.geometry.surface_distance import nearest_surface_points
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.executor import run, run_batches
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.search.race import SAME_HAND
from jaxsmw.matching.shape import prepare_shapes
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import PRESETS, Preset, Sizes, Stage
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import no_progress


def random_distances(number, seed=0):
    points = np.random.default_rng(seed).normal(size=(number, 3))
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def is_connected(edges, number):
    rows, columns = np.array(edges).T
    graph = coo_array((np.ones(len(edges)), (rows, columns)), shape=(number, number))
    return connected_components(graph, directed=False)[0] == 1


def test_a_coarse_mesh_is_named_once_with_advice_that_fits():
    bodies = [replace(creature("biped", vertices=500, seed=seed), name=f"body {seed}") for seed in range(2)]
    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always")
        shapes, _ = prepare_collection(bodies, PRESETS["fast"])
        prepare_task(*shapes)
    texts = [str(warning.message) for warning in issued]
    assert [text.split(":")[0] for text in texts] == ["body 0", "body 1"]
    assert all(text.endswith("use a finer mesh.") for text in texts)


# ----------------------------------------------------------------------------------------------------- graph


@pytest.mark.parametrize("number", [2, 3, 7, 40])
def test_the_graph_is_connected_and_has_the_wanted_number_of_edges(number):
    edges = choose_edges(random_distances(number), edges_per_shape=4)
    assert len(edges) == min(4 * number, number * (number - 1) // 2)
    assert all(0 <= i < j < number for i, j in edges) and edges == sorted(set(edges))
    assert is_connected(edges, number)


def test_the_graph_contains_the_minimum_spanning_tree_and_is_connected_with_few_edges():
    # Two clusters: nearest neighbours alone would not connect them.
    points = np.concatenate([np.random.default_rng(0).normal(size=(10, 2)), 50 + np.zeros((10, 2))])
    points[10:] += np.random.default_rng(1).normal(size=(10, 2))
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert is_connected(choose_edges(distances, edges_per_shape=1.5), 20)
    assert is_connected(choose_edges(np.zeros((6, 6)), edges_per_shape=1.5), 6)


def test_added_shapes_add_only_their_own_edges():
    distances = random_distances(20)
    before = choose_edges(distances[:16, :16], edges_per_shape=3)
    after = choose_edges(distances, edges_per_shape=3, matched=before)
    assert set(before) <= set(after)
    added = set(after) - set(before)
    assert len(added) == 3 * 4
    assert all(max(edge) >= 16 for edge in added) and {shape for e in added for shape in e} >= {
        16,
        17,
        18,
        19,
    }
    assert choose_edges(distances, edges_per_shape=3, matched=after) == after


def test_a_removed_shape_does_not_split_the_graph():
    distances = random_distances(6)
    star = [(0, 1), (0, 2), (0, 3)]
    assert is_connected(choose_edges(distances[:4, :4], matched=star), 4)
    # Shape 0 was removed, and with it all edges of the star; shapes 3 and 4 are still matched with each other.
    assert is_connected(choose_edges(distances, edges_per_shape=2, matched=[(1, 2), (3, 4)]), 6)


def test_random_edges_depend_on_the_seed_only():
    distances = random_distances(30)
    first, same, other = (choose_edges(distances, seed=seed) for seed in (0, 0, 1))
    assert first == same
    assert first != other


# ---------------------------------------------------------------------------------------------------- cycles


def test_triangles_are_all_triangles_of_the_graph():
    edges = choose_edges(random_distances(15), edges_per_shape=4)
    known = {frozenset(edge) for edge in edges}
    expected = [
        t for t in combinations(range(15), 3) if all(frozenset(e) in known for e in combinations(t, 2))
    ]
    assert expected and triangles(edges).tolist() == [list(t) for t in expected]


def test_cycle_error_is_the_mean_clipped_distance():
    rng = np.random.default_rng(0)
    first, second, third = (rng.permutation(50) for _ in range(3))
    positions, samples = rng.normal(size=(50, 3)), np.arange(0, 50, 7)
    expected = [min(np.linalg.norm(positions[third[second[first[s]]]] - positions[s]), 0.5) for s in samples]
    assert cycle_error(first, second, third, positions, samples) == pytest.approx(np.mean(expected))
    inverse = np.argsort(second[first])
    assert cycle_error(first, second, inverse, positions, samples) == 0


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_wrong_edges_are_found_by_cycles(share):
    """Each shape has its own numbering, and a wrong edge has a random map."""
    rng = np.random.default_rng(0)
    number, n = 16, 60
    positions = rng.normal(size=(n, 3))
    orders = [rng.permutation(n) for _ in range(number)]
    edges = choose_edges(random_distances(number), edges_per_shape=5)
    wrong = rng.permutation(len(edges))[: round(share * len(edges))]
    maps = {}
    for row, (i, j) in enumerate(edges):
        forward = np.argsort(orders[j])[orders[i]]
        if row in wrong:
            forward = rng.permutation(n)
        maps[i, j], maps[j, i] = forward, np.argsort(forward)
    # Vertex v of shape i is point orders[i][v].
    estimated, errors, cycles = estimate_edge_errors(
        edges,
        maps,
        [positions[order] for order in orders],
        [np.arange(n)] * number,
        np.full(len(edges), 0.01),
    )
    is_wrong = np.isin(np.arange(len(edges)), wrong)
    assert estimated[~is_wrong].max() < 0.05 < 0.3 < estimated[is_wrong].min()
    np.testing.assert_array_equal(errors > 1e-9, is_wrong[cycles].any(axis=1))


def test_an_edge_in_no_cycle_keeps_its_prior():
    prior = np.array([0.1, 0.2, 0.3, 0.7])
    found = edge_errors(np.array([[0, 1, 2]]), np.array([0.05]), prior)
    np.testing.assert_allclose(found, [0.05, 0.05, 0.05, 0.7], rtol=1e-6)


# ----------------------------------------------------------------------------------------------------- hands


def test_hands_agree_with_noisy_evidence():
    rng = np.random.default_rng(0)
    true_hands = rng.random(20) < 0.4
    evidence = {}
    for i, j in combinations(range(20), 2):
        if rng.random() < 0.3:
            true = 1.0 if true_hands[i] != true_hands[j] else -1.0
            evidence[i, j] = 4.0 * true * (-0.3 if rng.random() < 0.1 else 1)
    np.testing.assert_array_equal(choose_hands(20, evidence), true_hands)


def test_at_most_half_of_the_shapes_are_mirrored():
    """Of two equal halves, the half with the first shape is not mirrored."""
    for given in map(np.array, ([0, 1, 1, 1], [1, 0, 0, 1], [0, 0, 1])):
        number = len(given)
        evidence = {(i, j): 2.0 * (given[i] != given[j]) - 1 for i, j in combinations(range(number), 2)}
        found = choose_hands(number, evidence)
        assert (found == given).all() or (found != given).all()
        assert 2 * found.sum() < number or not found[0]
    assert choose_hands(2, {(0, 1): 1.0}).tolist() == [False, True]


def test_shapes_without_evidence_for_other_hands_have_one_hand():
    """Of shapes that are their own mirror images, only a few unconnected pairs are compared."""
    assert not choose_hands(3, {}).any()
    evidence = {(0, 3): -5.1, (1, 2): -5.0, (4, 7): -5.0, (5, 8): -5.0, (6, 9): -5.0}
    assert not choose_hands(10, evidence).any()


@pytest.mark.filterwarnings("ignore:.*use a finer mesh:UserWarning")
def test_a_few_pairs_tell_whether_shapes_are_their_own_mirror_images(monkeypatch):
    """If they are not, the hands of all pairs of the graph are compared, and the store keeps the evidence."""
    shapes, _ = prepare_collection([bumpy_mesh(number=600 + i) for i in range(6)], PRESETS["paper"])
    compared, reports, store = [], [], Store(None)

    def compare(store):
        compared.clear()
        return compare_hands(
            shapes,
            PRESETS["paper"],
            "exact",
            seed=0,
            store=store,
            progress=lambda step, done, total: reports.append((step, done, total)),
        )

    def evidence(value):
        monkeypatch.setattr(hands, "hand_evidence", lambda reading: compared.append(reading) or value)

    evidence(SAME_HAND)
    assert len(compare(store)) == len(compared) == 5 and not reports
    evidence(4.0)
    found = compare(store)
    assert len(found) == len(compared) == 9 and list(found.values()) == [4.0] * 9
    assert reports[-1] == ("hands", 9, 9)
    assert all(reading.prepared.x is not reading.prepared.y for reading in compared)


@pytest.mark.filterwarnings("ignore:.*use a finer mesh:UserWarning")
def test_evidence_of_hands_is_kept_in_the_store(monkeypatch, tmp_path):
    shapes, _ = prepare_collection([bumpy_mesh(number=600 + i) for i in range(2)], PRESETS["paper"])
    compared = []
    monkeypatch.setattr(hands, "hand_evidence", lambda reading: compared.append(reading) or 2.5)
    for _ in range(2):
        found = compare_hands(
            shapes, PRESETS["paper"], "exact", seed=0, store=Store(tmp_path), progress=no_progress
        )
        assert found == {(0, 1): 2.5} and len(compared) == 1


# ------------------------------------------------------------------------------------------- synchronisation


@pytest.fixture(scope="module")
def body():
    return creature(vertices=600, seed=3)


def noisy_network(body, edges, wrong, noise, number, seed=0):
    """A network of copies of one body, whose maps are noisy displacements on the surface."""
    rng = np.random.default_rng(seed)
    maps = {}
    for i, j in edges:
        for key in ((i, j), (j, i)):
            moved = body.vertices + noise * np.sqrt(body.area) * rng.normal(size=body.vertices.shape)
            if frozenset(key) in wrong:
                moved = body.vertices * [-1, 1, 1]
            maps[key] = nearest_surface_points(moved, body)[0]
    errors = {edge: 0.3 if frozenset(edge) in wrong else 0.01 for edge in edges}
    return Network([body] * number, maps, errors)


def test_averages_remove_noise_and_ignore_wrong_edges(body):
    number = 7
    edges = list(combinations(range(number), 2))
    wrong = {frozenset((0, 3)), frozenset((2, 5))}
    network = noisy_network(body, edges, wrong, 0.01, number)
    points = synchronize(network, 0)
    unit = np.sqrt(body.area)

    def error(i, j):
        offsets = points[i].positions(body) - points[j].positions(body)
        return np.linalg.norm(offsets, axis=1).mean() / unit

    direct = (
        np.linalg.norm(network.carried(vertices_as_points(body), 1, 2) - body.vertices, axis=1).mean() / unit
    )
    consistent = np.mean([error(i, j) for i, j in combinations(range(number), 2)])
    assert direct > 0.008
    assert consistent < 0.7 * direct
    assert network.residual(points, 0, 3) > 0.1 > 0.03 > network.residual(points, 0, 1)


def test_exact_maps_stay_exact(body):
    edges = [(0, 1), (1, 2), (2, 3), (0, 3)]
    network = noisy_network(body, edges, set(), 0.0, 4)
    for points in synchronize(network, 2):
        np.testing.assert_allclose(points.positions(body), body.vertices, atol=1e-6)


def test_meshes_far_from_the_origin_are_averaged_as_precisely(body):
    """In single precision, coordinates near 5e6 have steps of 0.5."""
    edges = [(0, 1), (1, 2), (2, 3), (0, 3), (0, 2)]
    far = replace(body, vertices=body.vertices + 5e6)
    near_network = noisy_network(body, edges, set(), 0.01, 4)
    maps = {key: nearest_surface_points(images, body)[0] for key, images in near_network._images.items()}
    shifted = Network([body, far, body, far], maps, near_network.errors)
    unit = np.sqrt(body.area)
    for shape, (near, moved) in enumerate(
        zip(synchronize(near_network, 0), synchronize(shifted, 0), strict=True)
    ):
        offset = 5e6 if shape in (1, 3) else 0.0
        distances = moved.positions(shifted.meshes[shape]) - offset - near.positions(body)
        assert np.abs(distances).max() < 1e-3 * unit


def test_unconnected_shapes_are_refused(body):
    with pytest.raises(ValueError, match="not connected"):
        synchronize(noisy_network(body, [(0, 1)], set(), 0.0, 3), 0)


def test_the_medoid_has_the_smallest_sum_of_path_errors(body):
    edges = {(0, 1): 1.0, (1, 2): 1.0, (2, 3): 1.0, (3, 4): 1.0}
    points = vertices_as_points(body)
    maps = {key: points for edge in edges for key in (edge, edge[::-1])}
    assert Network([body] * 5, maps, edges).medoid() == 2


@pytest.mark.parametrize(
    ("distances", "options", "message"),
    [
        (np.zeros((3, 2)), {}, "square matrix"),
        (np.full((3, 3), np.nan), {}, "finite"),
        (np.ones((3, 3)), {"edges_per_shape": -1}, "positive"),
        (np.ones((3, 3)), {"random_share": 2}, "share"),
        (np.array([["a"]]), {}, "square matrix"),
        (np.zeros((0, 0)), {}, "square matrix"),
        (-np.ones((3, 3)), {}, "not negative"),
        (np.ones((3, 3)), {"edges_per_shape": np.nan}, "edges_per_shape is nan"),
        (np.ones((3, 3)), {"edges_per_shape": "4"}, "edges_per_shape is '4'"),
        (np.ones((3, 3)), {"random_share": True}, "random_share is True"),
        (np.ones((3, 3)), {"seed": -1}, "seed is -1: give a whole number of at least 0"),
        (np.ones((3, 3)), {"seed": 1.0}, "seed is 1.0"),
        (np.ones((3, 3)), {"matched": [(0, 3)]}, "3 shapes"),
        (np.ones((3, 3)), {"matched": [(0, 1), (0, 1.0)]}, "given edge 1 is"),
        (np.ones((3, 3)), {"matched": [3]}, "given edge 0 is 3"),
        (np.ones((3, 3)), {"matched": [(1, 1)]}, "joins shape 1 to itself"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_graphs_are_refused(distances, options, message):
    with pytest.raises(InputError, match=message):
        choose_edges(distances, **options)


def test_shapes_without_any_good_map_are_outliers():
    errors = {(0, 1): 0.01, (1, 2): 0.3, (0, 2): 0.1, (2, 3): 0.2, (0, 3): 0.09}
    assert find_outliers(errors, 0.1) == (2,)
    assert find_outliers(errors, 0.005) == (0, 1, 2, 3)
    assert find_outliers({}, 0.1) == ()


def test_points_inside_torn_triangles_follow_the_nearest_corner(body):
    points = SurfacePoints(np.array([0, 0]), np.array([[0.5, 0.3, 0.2], [0.2, 0.2, 0.6]]))
    images = body.vertices.copy()
    smooth = carry(points, body, images, 1.0)
    np.testing.assert_allclose(smooth, points.positions(body))
    images[body.faces[0, 0]] += 100
    torn = carry(points, body, images, 1.0)
    np.testing.assert_allclose(torn, images[body.faces[0, [0, 2]]])


def test_robust_mean_ignores_outliers():
    candidates = np.random.default_rng(0).normal(size=(9, 5, 3)) * 0.01
    outlying = candidates.copy()
    outlying[0] += 1.0
    found = robust_mean(outlying, np.ones(9), np.zeros((5, 3)), 0.02)
    assert np.abs(found - candidates[1:].mean(axis=0)).max() < 0.01


# --------------------------------------------------------------------------------------------------- batches


@pytest.fixture(scope="module")
def three():
    return [creature(vertices=600, pose=pose, seed=5) for pose in ("rest", "stand", "walk")]


@pytest.fixture(scope="module")
def one_by_one(three):
    return dict(match_pairs(three, PAIRS, preset="paper"))


PAIRS = list(permutations(range(3), 2))[:4]


def test_pairs_are_matched_as_by_match(three, one_by_one):
    assert sorted(one_by_one) == list(range(len(PAIRS)))
    for number, found in one_by_one.items():
        i, j = PAIRS[number]
        assert found.mesh_x is three[i] and found.mesh_y is three[j]
        # All poses have the same triangulation.
        error = three[j].vertices[found.pointwise_map] - three[j].vertices
        direct = match(three[i], three[j], preset="paper", mirror="no")
        reference = three[j].vertices[direct.pointwise_map] - three[j].vertices
        assert np.linalg.norm(error, axis=1).mean() < 1.2 * np.linalg.norm(reference, axis=1).mean() + 1e-3


@pytest.mark.parametrize(
    "preset", ["paper", pytest.param(Preset(PRESETS["accurate"].stages[1:2]), marks=pytest.mark.sampled)]
)
def test_batches_give_the_same_maps(three, one_by_one, preset):
    if preset != "paper":
        one_by_one = dict(match_pairs(three, PAIRS, preset=preset))
    for number, found in match_pairs(three, PAIRS, preset=preset, batch_size=3):
        expected = one_by_one[number]
        assert (found.pointwise_map == expected.pointwise_map).mean() > 0.999
        assert found.distortion == pytest.approx(expected.distortion, rel=1e-3)


def test_batches_are_not_refined_a_second_time(three, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a stage ran on a single pair")

    monkeypatch.setattr("jaxsmw.matching.executor.run", refuse)
    monkeypatch.setattr("jaxsmw.matching.match.run", refuse)
    found = match_pairs(three, PAIRS, preset="paper", batch_size=3)
    assert len(dict(found)) == len(PAIRS)


def test_the_first_failure_of_a_batch_is_reported(three, monkeypatch):
    """Later stages start from the map of the failure, and must not hide its reason."""
    shape = prepare_shape(three[0], PRESETS["paper"], "exact")
    eigenvectors = shape.spectrum.eigenvectors.copy()
    eigenvectors[0, 0] = np.nan
    broken = SpectralPair(shape.spectrum, replace(shape.spectrum, eigenvectors=eigenvectors))
    identity = np.arange(len(three[0].vertices))
    (outcome,) = run_batches([Stage(), Stage()], [(broken, Start(identity))], batch_size=1)
    assert [run.refinement.result == RESULTS.nonfinite_spectrum for run in outcome.runs] == [True]


def test_batches_take_pairs_with_and_without_crease_eigenvectors(three):
    """Large meshes have no crease eigenvectors, so neither do pairs with them."""
    stage = Stage(FeatureRegression((8, 12)), number_of_crease_eigenvectors=4)
    *creased, bare = (shape.spectrum for shape in prepare_shapes(three, Sizes(12, 4)))
    spectra = [*creased, bare.with_crease_eigenvectors(None)]
    tasks = []
    for i, j in ((0, 1), (0, 2), (2, 1), (1, 0)):
        _, nearest = KDTree(three[j].vertices).query(three[i].vertices)
        tasks.append((SpectralPair(spectra[i], spectra[j]), Start(nearest)))
    for outcome, task in zip(run_batches([stage], tasks, batch_size=2), tasks, strict=True):
        alone = run([stage], *task)
        assert outcome.successful and np.mean(outcome.pointwise_map == alone.pointwise_map) > 0.99


def test_presets_of_different_arrays_have_different_keys():
    """The text of a bank abbreviates its arrays."""
    low, high = (Preset((Stage(WaveletPreservation(LowPass(cutoff))),)) for cutoff in (0.25, 0.5))
    same = Preset((Stage(WaveletPreservation(LowPass(0.25))),))
    assert repr(low) == repr(high)
    assert preset_key(low) == preset_key(same) != preset_key(high)


def test_pairs_may_come_from_an_iterator(three, one_by_one):
    found = dict(match_pairs(three, (pair for pair in PAIRS[:1]), preset="paper"))
    np.testing.assert_array_equal(found[0].pointwise_map, one_by_one[0].pointwise_map)


@pytest.mark.parametrize("pair", [(0, 3), (0, -1), (0, 1.0), (0,), (0, 1, 2), "01", 1])
@pytest.mark.usefixtures("unchecked")
def test_bad_pairs_are_refused(three, pair):
    with pytest.raises(InputError, match="pair 1 is"):
        match_pairs(three, [(0, 1), pair])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"devices": []}, "give at least one JAX device"),
        ({"devices": "cpu"}, "devices is 'cpu'"),
        ({"devices": jax.devices()[0]}, "give at least one JAX device"),
        ({"batch_size": 0}, "batch_size is 0"),
        ({"batch_size": 2.0}, "batch_size is 2.0"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_options_of_batches_are_refused(three, options, message):
    with pytest.raises(InputError, match=message):
        match_pairs(three, PAIRS, **options)


def test_reverse_surface_points_come_from_the_same_embeddings():
    pair = creature_pair(vertices=1500, seed=1)
    found = match(pair.source, pair.target, preset="paper", init=pair.true_map, mirror="no")
    reverse = found.reverse_surface_points()
    assert len(reverse) == len(pair.target.vertices)
    # A vertex that is carried there and back returns near to itself.
    there = found.surface_points()
    back = carry(there, pair.target, reverse.positions(pair.source), np.inf)
    detour = np.linalg.norm(back - pair.source.vertices, axis=1) / np.sqrt(pair.source.area)
    assert np.median(detour) < 0.02
    nearest = reverse.nearest_corners(pair.source)
    assert (nearest == found.reverse_map()).mean() > 0.7
