"""Alternative maps are computed and compared on proxies."""

import gc
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import mean_error, refine_and_repair

from jaxsmw import creature_pair, geodesic_error, match, read_mesh
from jaxsmw.benchmark.datasets import open_data_set
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.errors import InputError
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, farthest_point_samples
from jaxsmw.matching.judge import Judge, Scored
from jaxsmw.matching.outcome import Outcome
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.search.alternatives import Alternatives
from jaxsmw.matching.search.proxies import Proxy, deformation, distance_error, map_difference
from jaxsmw.matching.settings import AlternativeSettings, JudgeSettings
from jaxsmw.matching.stages import PRESETS, Preset, Sizes, Stage
from jaxsmw.matching.starts import METHODS, make_start

REPAIR = PRESETS["accurate"].repair
# Fewer samples and levels, which compile faster.
FEW = {"samples": 250, "levels": (8, 11, 15, 20), "fine_levels": (15, 20, 20, 20)}
REPAIR = replace(REPAIR, alternatives=replace(REPAIR.alternatives, **FEW))


@pytest.fixture(scope="module")
def pair():
    """Two poses of a body with different triangulations."""
    found = creature_pair(vertices=900)
    return found.source, found.target, found.truth.nearest_corners(found.target)


TWO_STAGES = Preset((Stage(FeatureRegression((20,))),), (Stage(FeatureRegression((20, 40))),))


def reduced(mesh, number=300):
    samples = SurfaceSamples.along_surface(mesh, farthest_point_samples(mesh, number))
    return Proxy(mesh, compute_spectrum(mesh, 4), samples, mesh.area**0.5)


def moved(mesh, rotation, shift=2.0):
    return Mesh(mesh.vertices @ rotation.as_matrix().T + shift, mesh.faces, mesh.name)


def prepared(mesh_x, mesh_y, *, creases=0, **options):
    return prepare(Pair.make(mesh_x, mesh_y, **options), Sizes(60, creases, 500)).describe(30)


def test_samples_belong_to_the_nearest_along_the_surface():
    """Two parallel sheets that nearly touch share no samples."""
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 2, indexing="ij"), -1).reshape(-1, 2)
    corners = np.arange(64).reshape(8, 8)
    a, b, c, d = (
        part.ravel() for part in (corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    sheets = [np.column_stack([grid, np.full(64, height)]) for height in (0.0, 0.01)]
    mesh = Mesh(np.concatenate(sheets), np.concatenate([faces, faces + 64]))
    samples = SurfaceSamples.along_surface(mesh, np.array([0, 64 + 63]))
    assert (samples.nearest == np.repeat([0, 1], 64)).all()
    alone = SurfaceSamples.along_surface(mesh, np.array([3, 0]))  # no sample on the second sheet
    assert alone.vertices.tolist() == [0, 3]
    assert (alone.nearest[:64] == alone.nearest[64:]).mean() > 0.9


def test_rigid_motions_have_no_deformation_and_reflections_have(pair):
    mesh, _, _ = pair
    rotation = Rotation.random(random_state=0)
    x, y = reduced(mesh), reduced(moved(mesh, rotation))
    np.testing.assert_array_equal(x.samples.vertices, y.samples.vertices)
    identity = np.arange(len(x.areas))
    assert deformation(x, y, identity, 0.3) < 1e-12 and distance_error(x, y, identity) < 1e-12
    mirrored = Proxy(mesh.mirrored(), x.spectrum, x.samples, mesh.area**0.5)
    assert distance_error(x, mirrored, identity) < 1e-12
    assert deformation(x, mirrored, identity, 0.3) > 0.01


def test_deformation_is_the_residual_of_procrustes_alignment(pair):
    mesh_x, mesh_y, truth = pair
    x, y = reduced(mesh_x, 80), reduced(mesh_y, 90)
    found = y.samples.nearest[truth[x.samples.vertices]]
    expected = 0.0
    for sample, area in enumerate(x.areas):
        patch = x.distances[sample] < 0.4
        weights = x.areas[patch] / x.areas[patch].sum()
        source, target = (p - weights @ p for p in (x.positions[patch], y.positions[found[patch]]))
        rotation, _ = Rotation.align_vectors(target, source, weights=weights)
        residual = weights @ np.sum((rotation.apply(source) - target) ** 2, axis=1)
        expected += area * residual / (weights @ np.sum(source**2 + target**2, axis=1))
    assert deformation(x, y, found, 0.4) == pytest.approx(expected, rel=1e-6)


def test_wrong_maps_deform_more_than_the_true_map(pair):
    mesh_x, mesh_y, truth = pair
    x, y = reduced(mesh_x), reduced(mesh_y)
    found = y.samples.nearest[truth[x.samples.vertices]]
    random = (
        np.random.default_rng(0).permutation(len(y.areas))[: len(found)]
        if len(found) <= len(y.areas)
        else None
    )
    measure = partial(deformation, x, y, radius=0.3)
    assert measure(found) < 0.5 * measure(random)


def test_the_best_alternative_is_right_and_does_not_depend_on_the_position_in_space(pair):
    mesh_x, mesh_y, truth = pair
    nonsense = np.zeros_like(truth)
    first, *others = Alternatives(prepared(mesh_x, mesh_y), REPAIR).best(nonsense)
    assert first.dtype == np.int64 and first.shape == truth.shape
    assert mean_error(mesh_y, first, truth) < 0.08
    assert len(others) <= 3
    turned = moved(mesh_x, Rotation.random(random_state=1)), moved(mesh_y, Rotation.random(random_state=2))
    (again, *_) = Alternatives(prepared(*turned), REPAIR).best(nonsense)
    assert np.mean(again == first) > 0.99


def test_the_arrays_of_a_pair_are_freed_without_garbage_collection(pair):
    mesh_x, mesh_y, truth = pair
    start = prepared(mesh_x, mesh_y)
    next(Alternatives(start, REPAIR).best(truth))
    gc.collect()
    gc.disable()
    try:
        arrays = len(jax.live_arrays())
        next(Alternatives(start, REPAIR).best(truth))
        assert len(jax.live_arrays()) == arrays
    finally:
        gc.enable()


def test_alternatives_of_partial_pairs_come_from_descriptors_alone(pair):
    mesh_x, mesh_y, truth = pair
    whole = Alternatives(prepared(mesh_x, mesh_y), REPAIR)
    part = Alternatives(prepared(mesh_x, mesh_y, partial=True), REPAIR)
    radii, pairings = REPAIR.alternatives.radii, REPAIR.alternatives.pairings
    assert len(list(part._initial_maps())) == len(radii)
    assert len(list(whole._initial_maps())) == len(radii) + pairings + 4
    assert next(part.best(truth)).shape == (len(mesh_x.vertices),)


def test_known_maps_are_refined_as_well(pair):
    """On a body without descriptors and limbs, only a given map is right."""
    mesh_x, mesh_y, truth = pair
    alone = Alternatives(prepared(mesh_x, mesh_y), REPAIR)
    alone._initial_maps = lambda: iter(())
    assert mean_error(mesh_y, next(alone.best(truth)), truth) < 0.05


def test_only_better_maps_that_differ_from_the_known_map_are_tried(pair):
    mesh_x, mesh_y, truth = pair
    found = Alternatives(prepared(mesh_x, mesh_y), REPAIR)
    assert not list(found.best(truth, only_better=True))
    upside_down = truth[np.argsort(np.argsort(-mesh_x.vertices[:, 1]))]
    better = next(found.best(upside_down, only_better=True))
    assert mean_error(mesh_y, better, truth) < 0.08


def test_outcomes_with_nearly_the_same_map_are_no_rivals(pair):
    mesh_x, mesh_y, truth = pair
    upside_down = truth[np.argsort(np.argsort(-mesh_x.vertices[:, 1]))]
    slightly_different = truth.copy()
    slightly_different[:10] = upside_down[:10]
    start = prepared(mesh_x, mesh_y)
    right, similar, wrong, again = (
        Scored(Outcome(one), 1.0) for one in (truth, slightly_different, upside_down, upside_down)
    )
    found = Alternatives(start, REPAIR).different(right, [similar, wrong, again])
    assert len(found) == 1 and found[0] is wrong
    assert Alternatives(start, REPAIR).different(right, [similar]) == ()


@pytest.mark.parametrize(
    ("init", "compared", "finalists", "is_partial", "compares"),
    [
        ("shot", 0.5, 1, False, True),
        ("shot", 10.0, 1, False, False),
        ("shot", 0.5, 0, False, False),
        ("shot", 0.5, 1, True, False),
        ("wks", 0.5, 1, False, False),
    ],
)
def test_maps_that_look_right_are_compared(
    pair, monkeypatch, init, compared, finalists, is_partial, compares
):
    """An alternative map replaces a map that looks right if its score is better."""
    mesh_x, mesh_y, truth = pair
    asked = []

    def best(self, known, *, only_better):
        asked.append(only_better)
        yield truth

    monkeypatch.setattr(Alternatives, "best", best)
    monkeypatch.setattr(Judge, "score", lambda self, scored: -float(len(scored.outcome.runs) == 1))
    judge = JudgeSettings(suspicious=100.0, suspicious_area=1.0)
    settings = replace(REPAIR, judge=judge, compared=compared, finalists=finalists)
    pair = prepared(mesh_x, mesh_y, partial=is_partial)
    start = make_start(pair, "shot")._replace(origin=init, has_alternatives=METHODS[init].has_alternatives)
    found = refine_and_repair(pair, start, replace(TWO_STAGES, repair=settings))
    assert asked == [True] * compares and not found.suspicious
    assert len(found.outcome.runs) == (1 if compares else 2)


def test_creased_alternatives_are_right_and_use_other_features(pair, monkeypatch):
    mesh_x, mesh_y, truth = pair
    creased = prepared(mesh_x, mesh_y, creases=12)
    found = Alternatives(creased, REPAIR)
    numbers = []
    refined = Alternatives._refined

    def recorded(self, stage, *arguments):
        seen = self._spectra.seen_by(stage).both
        numbers.append([0 if s.crease_eigenvectors is None else s.crease_eigenvectors.shape[1] for s in seen])
        return refined(self, stage, *arguments)

    monkeypatch.setattr(Alternatives, "_refined", recorded)
    assert mean_error(mesh_y, next(found.best(np.zeros_like(truth), creased=True)), truth) < 0.08
    # The first refinement and the repair of its faults use crease eigenvectors. The second refinement does not.
    assert numbers == [[12, 12], [12, 12], [0, 0]]
    without = replace(REPAIR, alternatives=replace(REPAIR.alternatives, crease_eigenvectors=0))
    assert found.has_creases and not Alternatives(creased, without).has_creases
    assert not Alternatives(prepared(mesh_x, mesh_y), REPAIR).has_creases


@pytest.mark.parametrize(
    ("creases", "is_partial", "non_isometric", "score", "tried", "replaced"),
    [
        (12, False, 10.0, -1.0, True, True),
        (12, False, 10.0, 1.0, True, False),  # the further map has a worse score
        (12, False, 0.0, -1.0, False, False),  # the shapes are not near-isometric
        (12, True, 10.0, -1.0, False, False),
        (0, False, 10.0, -1.0, False, False),
    ],
)
def test_a_second_attempt_uses_crease_eigenvectors(
    pair, monkeypatch, creases, is_partial, non_isometric, score, tried, replaced
):
    """If the first attempt ends with a suspicious map, alternatives with crease eigenvectors are tried."""
    mesh_x, mesh_y, truth = pair
    asked = []

    def best(self, known, *, only_better=False, creased=False):
        asked.append((known.tolist(), creased))
        yield from [truth] * creased

    monkeypatch.setattr(Alternatives, "best", best)
    monkeypatch.setattr(Judge, "score", lambda self, scored: score * (len(scored.outcome.runs) == 1))
    settings = replace(
        REPAIR,
        judge=JudgeSettings(suspicious=0.1, doubtful=0.1),
        non_isometric=non_isometric,
        finalists=1,
        rounds=0,
    )
    pair = prepared(mesh_x, mesh_y, partial=is_partial, creases=creases)
    found = refine_and_repair(pair, make_start(pair, "shot"), replace(TWO_STAGES, repair=settings))
    assert [creased for _, creased in asked] == [False] + [True] * tried
    assert all(known == asked[0][0] for known, _ in asked)  # both attempts also start from the usual map
    assert len(found.outcome.runs) == (1 if replaced else 2)
    assert found.suspicious


@pytest.mark.sampled
def test_a_pair_that_only_crease_eigenvectors_match_right(shared):
    """The two cats have a mean error above 0.1 without the second attempt."""
    cats = open_data_set(shared / "data" / "tosca_r")
    pair = next(one for one in cats.pairs if one.names == ("cat4", "cat9"))
    meshes = [read_mesh(file) for file in pair.meshes]
    found = match(*meshes)
    truth = pair.ground_truth(*meshes)
    assert geodesic_error(meshes[1], found.pointwise_map, truth, number_of_samples=300).mean < 0.03
    assert not found.suspicious


@pytest.mark.parametrize(
    "wrong",
    [
        {"promising": 0},
        {"repaired": -1},
        {"crease_eigenvectors": -1},
        {"fine_levels": ()},
        {"different_areas": (0.03, 0.0)},
    ],
)
def test_wrong_settings_of_alternatives_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        AlternativeSettings(**wrong)


def test_the_difference_of_two_maps_is_a_share_of_the_area(pair):
    """Matches that are close in space but not along the surface are different."""
    mesh, _, _ = pair
    proxy = reduced(mesh)
    identity = np.arange(len(proxy.areas))
    assert map_difference(proxy, proxy, identity, identity, 0.2) == 0
    apart = proxy.distances / np.linalg.norm(proxy.positions[:, None] - proxy.positions, axis=2).clip(1e-9)
    moved = identity.copy()
    moved[:50] = np.argmax(apart[:50], axis=1)
    far = proxy.distances[identity, moved] > 0.2
    assert far.any()
    expected = pytest.approx(proxy.areas[far].sum())
    assert map_difference(proxy, proxy, identity, moved, 0.2) == expected
    # On the small piece of a partial pair, distances are small, because their unit comes from the full shape.
    piece = Proxy(mesh, proxy.spectrum, proxy.samples, 100 * mesh.area**0.5)
    assert map_difference(proxy, piece, identity, moved, 0.2) == 0


def test_further_alternatives_differ_from_all_maps_before_them(unchecked):
    """The maps 0, 1 and 2 are variants of one map, and so are 3 and 4. Map 5 differs from 0 by too little."""
    places = np.array([0.0, 0.05, 0.11, 0.5, 0.53, 0.02])
    candidates = [SimpleNamespace(matches=number) for number in range(6)]
    for areas, expected in (((0.03, 0.03, 0.2), [0, 1, 2, 3]), ((0.03, 0.2), [0, 1, 3]), ((0.4,), [0, 3])):
        settings = replace(REPAIR, alternatives=replace(REPAIR.alternatives, different_areas=areas))
        alternatives = SimpleNamespace(
            settings=settings, _difference=lambda one, other: abs(places[one] - places[other])
        )
        chosen = Alternatives._distinct(alternatives, candidates)
        assert [one.matches for one in chosen] == expected


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("names", "looks_right"),
    [
        # After the first refinement on proxies, an upside-down map has the best score without more pairings.
        (("hippo_walking", "dog2"), False),
        # The usual map exchanges the front legs, but it looks right.
        (("muybridge_132_133_07", "muybridge_074_01"), True),
    ],
)
def test_animals_are_matched_in_any_position(shared, names, looks_right):
    """Alternative maps correct maps of real animals, and random rotations of both shapes change little."""
    animals = open_data_set(shared / "data" / "smal_r")
    pair = next(one for one in (*animals.pairs, *animals.others) if one.names == names)
    meshes = [read_mesh(file) for file in pair.meshes]
    truth = pair.ground_truth(*meshes)
    preset = PRESETS["accurate"]
    sizes = preset.sizes._replace(number_of_crease_eigenvectors=0)
    unrepaired = prepare(Pair.make(*meshes), sizes).describe(preset.number_of_descriptors)
    wrong = refine_and_repair(
        unrepaired,
        make_start(unrepaired, "shot"),
        Preset(
            preset.first, preset.repeated + preset.final, repair=replace(preset.repair, finalists=0, rounds=0)
        ),
    )
    assert wrong.suspicious != looks_right

    def mean_error(found):
        return geodesic_error(meshes[1], found, truth, number_of_samples=300).mean

    assert mean_error(wrong.pointwise_map) > 0.1
    turned = [moved(mesh, Rotation.random(random_state=seed)) for seed, mesh in enumerate(meshes)]
    found, again = (match(*shapes).pointwise_map for shapes in (meshes, turned))
    assert max(mean_error(found), mean_error(again)) < 0.035
    distances = np.linalg.norm(meshes[1].vertices[found] - meshes[1].vertices[again], axis=1)
    assert np.mean(distances > 0.05 * meshes[1].area ** 0.5) < 0.02
