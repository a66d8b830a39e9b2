"""Stages run one after the other, and maps that look wrong are repaired."""

from dataclasses import fields, replace
from functools import partial, partialmethod

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from synthetic import body_with_arms, refine_and_repair

from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.errors import InputError
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.matching.executor import run
from jaxsmw.matching.judge import Judge, detours, distortion, overlap
from jaxsmw.matching.match import match
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search import repair
from jaxsmw.matching.search.repair import refine_further
from jaxsmw.matching.settings import JudgeSettings, RepairSettings
from jaxsmw.matching.stages import PRESETS, Preset, Stage
from jaxsmw.report.summary import summarize

LEVELS = (20, 20, 40, 40)
STAGE = Stage(FeatureRegression(LEVELS))
REPAIR = RepairSettings()
UNREPAIRED = Preset(repeated=(STAGE,))
SAMPLED = replace(STAGE, number_of_samples=90)
ENDING = replace(SAMPLED, ends_on_samples=True)


@pytest.fixture(scope="module")
def body():
    """A mesh and its spectrum."""
    mesh = body_with_arms(3)
    return mesh, compute_spectrum(mesh, 40)


@pytest.fixture(scope="module")
def mirrored(body):
    """The map of the body to its mirror image."""
    mesh, _ = body
    return KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])[1]


@pytest.fixture(scope="module")
def swapped(body, mirrored):
    """The map of the body to itself that exchanges the arms."""
    mesh, _ = body
    return np.where(np.abs(mesh.vertices[:, 0]) > 1, mirrored, np.arange(len(mesh.vertices)))


@pytest.fixture(scope="module")
def identity(body):
    return np.arange(len(body[0].vertices))


def prepared_body(body, initial_map, origin="map"):
    """Return the prepared pair of the body and itself, and the start from a map."""
    mesh, spectrum = body
    prepared = PreparedPair.from_spectra(Pair(mesh, mesh), spectrum, spectrum)
    kind = {"has_alternatives": origin == "shot", "is_rigid": origin == "aligned"}
    return prepared, Start(np.asarray(initial_map, np.int64), origin, **kind)


@pytest.fixture
def given_alternatives(monkeypatch):
    """Return a function that lets repair try given maps instead of computed alternatives."""

    def give(*maps):
        class Given:
            has_creases, deformation = False, None

            def __init__(self, *_):
                pass

            def best(self, *_, **__):
                if not maps:
                    raise AssertionError("an alternative initial map was computed")
                return iter(maps)

            def different(self, _, others):
                return tuple(others)

        monkeypatch.setattr(repair, "Alternatives", Given)

    return give


def outcome(body, initial_map, repair=REPAIR, stages=(STAGE,), init="map"):
    """Return the share of the area that has wrong matches, and the scored map."""
    prepared, start = prepared_body(body, initial_map, init)
    preset, mesh = Preset(repeated=tuple(stages), repair=repair), body[0]
    found = refine_and_repair(prepared, start, preset)
    found = refine_further(prepared, start, preset, found)
    assert found.successful
    wrong = found.pointwise_map != np.arange(len(mesh.vertices))
    return mesh.vertex_areas[wrong].sum() / mesh.area, found


def test_swapped_limbs_are_repaired(body, swapped):
    assert outcome(body, swapped, None)[0] > 0.1
    assert outcome(body, swapped)[0] < 0.02


@pytest.mark.slow
def test_an_alternative_initial_map_helps_where_a_single_round_does_not(
    body, swapped, mirrored, identity, given_alternatives
):
    """A single round keeps the mirrored map, but alternative initial maps lead to the right map."""
    mesh, spectrum = body
    settings = replace(REPAIR, rounds=1)
    assert distortion(Pair(mesh, mesh), mirrored, spectrum) > 1.3
    given_alternatives(swapped, identity)
    wrong, found = outcome(body, mirrored, settings, init="shot")
    assert wrong < 0.02 and not np.array_equal(found.outcome.initial_map, mirrored) and not found.suspicious
    wrong, alone = outcome(body, mirrored, settings)
    assert wrong > 0.5 and alone.suspicious and alone.distortion > 1.3


def test_the_map_of_the_best_score_is_chosen(body, mirrored, identity, monkeypatch, given_alternatives):
    monkeypatch.setattr(Judge, "score", lambda self, outcome: -outcome.distortion)
    given_alternatives(identity)
    wrong, found = outcome(body, mirrored, replace(REPAIR, rounds=0), init="shot")
    assert wrong > 0.5 and found.suspicious


def test_a_large_fault_makes_a_map_suspicious(body, swapped, identity):
    """Swapped arms are a fault even if distortions of any size are accepted."""
    lenient = JudgeSettings(suspicious=100.0, doubtful=100.0)
    generous = replace(lenient, suspicious_area=1.0)
    stages = (Stage(FeatureRegression((40,))),)
    wrong, found = outcome(body, swapped, replace(REPAIR, judge=generous), stages)
    assert wrong > 0.1 and not found.suspicious
    wrong, found = outcome(body, swapped, replace(REPAIR, judge=lenient), stages)
    assert wrong < 0.02 and not found.suspicious


@pytest.mark.parametrize(
    ("init", "non_isometric", "coarse_from", "passes"),
    [
        ("shot", 10.0, 10.0, []),
        ("shot", 0.0, 10.0, [(30,), (30,)]),
        ("shot", 0.0, 0.0, [(10, 20), (20,), (30,)]),
        ("aligned", 10.0, 10.0, [(10, 20), (20,), (30,)]),
    ],
)
def test_stages_run_again_for_shapes_that_differ_in_form(body, init, non_isometric, coarse_from, passes):
    vertices, stage = body[0].vertices, Stage(FeatureRegression((30,)))
    noise = np.random.default_rng(0).normal(scale=0.3, size=vertices.shape)
    start = KDTree(vertices).query(vertices + noise)[1]
    settings = replace(
        REPAIR, judge=JudgeSettings(suspicious=2.0, suspicious_area=1.0), non_isometric=non_isometric, passes=2,
        coarse_from=coarse_from, coarse_levels=((10, 20), (20,)),
    )  # fmt: skip
    _, once = outcome(body, start, replace(settings, non_isometric=10.0), [stage])
    _, found = outcome(body, start, settings, [stage], init)
    expected = once
    for levels in passes:
        _, expected = outcome(body, expected.pointwise_map, None, [stage.with_levels(levels)])
    np.testing.assert_array_equal(found.pointwise_map, expected.pointwise_map)
    assert not found.suspicious
    changed = bool(np.any(found.pointwise_map != once.pointwise_map))
    assert changed == bool(passes)


def test_passes_do_not_clear_the_suspicion(body, identity):
    """Passes lower the distortion of a wrong map, but the map stays wrong."""
    judge = JudgeSettings(suspicious=1.001, suspicious_area=1.0, doubtful=10.0)
    settings = replace(REPAIR, judge=judge, non_isometric=0.0, passes=1)
    prepared, start = prepared_body(body, identity)
    once = refine_and_repair(prepared, start, UNREPAIRED)
    preset = replace(UNREPAIRED, repair=settings)
    for suspicious in (True, False):
        found = refine_further(prepared, start, preset, replace(once, suspicious=suspicious))
        assert found.suspicious == suspicious and found.distortion < 10
        assert len(found.outcome.runs) == 1


@pytest.mark.parametrize(("limit", "used"), [(0.0, False), (10.0, True)])
def test_passes_use_crease_eigenvectors_only_for_similar_shapes(body, limit, used):
    mesh, spectrum = body
    stage = Stage(FeatureRegression((10,)), number_of_crease_eigenvectors=5)
    random = np.random.default_rng(0).normal(size=(len(mesh.vertices), 5))
    noise = np.random.default_rng(1).normal(scale=0.3, size=mesh.vertices.shape)
    start = KDTree(mesh.vertices).query(mesh.vertices + noise)[1]
    settings = replace(REPAIR, non_isometric=0.0, passes=1, pass_tolerance=100.0, without_creases_from=limit)
    first, after = [], []
    for creases in (jnp.asarray(random), jnp.zeros_like(random)):
        creased = spectrum.with_crease_eigenvectors(creases)
        prepared, begin = prepared_body((mesh, creased), start)
        preset = Preset(repeated=(stage,))
        once = refine_and_repair(prepared, begin, preset)
        first.append(once.pointwise_map)
        once = replace(once, outcome=Outcome(begin.pointwise_map))
        found = refine_further(prepared, begin, replace(preset, repair=settings), once)
        after.append(found.pointwise_map)
    assert np.any(first[0] != first[1])
    assert np.any(after[0] != after[1]) == used


def test_passes_that_worsen_the_score_are_undone(body, monkeypatch):
    mesh, _ = body
    noise = np.random.default_rng(0).normal(scale=0.3, size=mesh.vertices.shape)
    start = KDTree(mesh.vertices).query(mesh.vertices + noise)[1]
    settings = replace(REPAIR, non_isometric=0.0, coarse_from=10.0, passes=1, pass_tolerance=1.0)
    prepared, begin = prepared_body(body, start)
    once = refine_and_repair(prepared, begin, Preset(repeated=(Stage(FeatureRegression((30,))),)))
    preset = replace(UNREPAIRED, repair=settings)
    further = partial(refine_further, prepared, begin, preset)

    def score(self, scored, *, after):
        return after if np.any(scored.pointwise_map != once.pointwise_map) else 0.0

    assert refine_further(prepared, begin, replace(preset, repair=replace(settings, passes=0)), once) is once
    for after, kept in ((-1.0, False), (0.9, False), (1.1, True), (np.nan, True)):
        monkeypatch.setattr(Judge, "score", partialmethod(score, after=after))
        assert (further(once) is once) == kept


def test_a_rival_replaces_the_map_if_its_score_is_better_after_the_passes(body, mirrored, identity):
    settings = replace(REPAIR, non_isometric=0.0, passes=1)
    prepared, start = prepared_body(body, identity)
    right = refine_and_repair(prepared, start, UNREPAIRED)
    wrong = refine_and_repair(prepared, start._replace(pointwise_map=mirrored), UNREPAIRED)
    for first, rival, margin, expected in (
        (wrong, right, 0.35, identity),
        (right, wrong, 0.35, identity),
        (wrong, right, 100.0, mirrored),
    ):
        chosen = replace(UNREPAIRED, repair=replace(settings, rival_margin=margin))
        rivalled = replace(first, suspicious=True, rivals=(rival,))
        found = refine_further(prepared, start, chosen, rivalled)
        np.testing.assert_array_equal(found.pointwise_map, expected)
        assert found.suspicious
        # If the map looks right, so does its rival, and the better score decides.
        found = refine_further(prepared, start, chosen, replace(rivalled, suspicious=False))
        np.testing.assert_array_equal(found.pointwise_map, identity)
        assert not found.suspicious


def test_rivals_of_a_map_that_looks_right_look_right_as_well(body, mirrored, identity, given_alternatives):
    given_alternatives(identity)
    judge = JudgeSettings(suspicious=1.0, suspicious_area=1.0)
    settings = replace(REPAIR, rounds=0, non_isometric=10.0)
    for doubtful, margin, number in ((1.0, 100.0, 1), (1.0, 0.0, 0), (1.1, 100.0, 0), (100.0, 100.0, 1)):
        _, found = outcome(
            body,
            mirrored,
            replace(settings, judge=replace(judge, doubtful=doubtful), rival_margin=margin),
            init="shot",
        )
        assert len(found.rivals) == number and found.suspicious == (doubtful == 1)


def test_alternative_initial_maps_are_computed_only_if_needed(body, swapped, identity, given_alternatives):
    given_alternatives()
    wrong, found = outcome(body, identity, init="shot")
    assert wrong < 0.02
    np.testing.assert_array_equal(found.outcome.initial_map, identity)
    outcome(body, swapped, None, init="shot")
    outcome(body, swapped)
    with pytest.raises(AssertionError, match="an alternative initial map was computed"):
        outcome(body, swapped, init="shot")


@pytest.mark.slow
def test_a_map_that_still_looks_wrong_is_reported(body, mirrored, identity):
    mesh, _ = body
    preset = Preset(repeated=(STAGE,), repair=REPAIR)
    with pytest.warns(
        UserWarning,
        match=r"limbs may be swapped or mirrored.* reverses the orientation of 100% .* separates 0%",
    ):
        found = match(mesh, mesh, preset=preset, init=mirrored)
    assert found.suspicious and found.distortion > 1.3
    facts = summarize(found, {})
    assert f"{found.distortion:.2f}; above 1.12 limbs may be swapped" in facts.values()
    trusted = replace(found, suspicious=False)  # the page does not contradict `match`
    assert f"{found.distortion:.2f}" in summarize(trusted, {}).values()
    right = match(mesh, mesh, preset=preset, init=identity)
    assert right.distortion < 1.1 and not right.suspicious


def test_maps_of_presets_without_repair_are_judged(body, mirrored, identity):
    mesh, _ = body
    with pytest.warns(UserWarning, match=r"reverses the orientation of .* use preset=\"accurate\", which"):
        wrong = match(mesh, mesh, preset=Preset((STAGE,)), init=mirrored, mirror="no")
    assert wrong.suspicious and wrong.distortion > 1.25
    facts = summarize(wrong, {})
    assert f"{wrong.distortion:.2f}; above 1.25 limbs may be swapped" in facts.values()
    right = match(mesh, mesh, preset=Preset((STAGE,)), init=identity, mirror="no")
    assert right.distortion < 1.1 and not right.suspicious


def test_default_repair_settings_are_those_of_the_preset_and_documented():
    settings = RepairSettings()
    assert settings == PRESETS["accurate"].repair == PRESETS["accurate"].large.repair
    for field in fields(settings):
        assert f"`{field.name}`" in RepairSettings.__doc__


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: Preset(()), "at least one stage"),
        (lambda: Preset((STAGE,), repair=REPAIR), "repair has no stage to repeat"),
        (lambda: Preset((STAGE,), final=(STAGE,), repair=REPAIR), "repair has no stage to repeat"),
        (lambda: Preset(final=(STAGE,)), "no map to judge"),
        (
            lambda: Preset(repeated=(ENDING,), final=(replace(SAMPLED, starts_on_samples=True),)),
            "before the final stages ends on samples, but its map is judged",
        ),
        (lambda: Preset(repeated=(Stage(),), repair=REPAIR), "WaveletPreservation, which has no levels"),
        (lambda: Preset((STAGE,), large=(STAGE,)), "large is .*: give a Preset or None"),
        (lambda: Preset((SAMPLED, ENDING)), "the last stage ends on samples"),
        (lambda: Preset((ENDING,), (SAMPLED,)), "stage 0 matches only 90 samples: let stage 1"),
        (
            lambda: Preset((ENDING, replace(SAMPLED, number_of_samples=91, starts_on_samples=True))),
            "at most as",
        ),
        (lambda: Stage(FeatureRegression(LEVELS), ends_on_samples=True), "there are no samples"),
        (lambda: Stage(number_of_samples=500, starts_on_samples=True), "WaveletPreservation matches samples"),
        (lambda: Stage(FeatureRegression(LEVELS), number_of_eigenvectors=60), "require 40: leave .* out"),
        (lambda: Stage(FeatureRegression(LEVELS), iterations=3), "require 4: leave iterations out"),
        (lambda: Stage(WaveletPreservation()).with_levels((3,)), "has no levels"),
        (lambda: RepairSettings(rounds=-1), "rounds is -1: give a whole number of at least 0"),
        (lambda: JudgeSettings(suspicious_area=3.0), "suspicious_area is 3.0: give a number from 0 to 1"),
        (lambda: JudgeSettings(suspicious=float("nan")), "suspicious is nan"),
        (lambda: JudgeSettings(uncertainty_weight=-1.0), "uncertainty_weight is -1.0"),
    ],
)
def test_invalid_presets_and_settings_are_refused(make, fault):
    with pytest.raises(InputError, match=fault):
        make()


def test_final_stages_run_once_after_repair(body, swapped, identity, monkeypatch):
    """Repair and passes repeat only the stages before the final stage."""
    mesh, _ = body
    final = Stage(FeatureRegression((30, 40)))
    judge = JudgeSettings(suspicious=1.0)
    repair = replace(REPAIR, judge=judge, non_isometric=0.0, coarse_from=1e3, passes=1)
    preset = Preset(repeated=(STAGE,), final=(final,), repair=repair)
    ran = []

    def watched(stages, spectra, start):
        ran.extend(stages)
        return run(stages, spectra, start)

    for module in ("match", "search.repair"):
        monkeypatch.setattr(f"jaxsmw.matching.{module}.run", watched)
    found = match(mesh, mesh, preset=preset, init=swapped, mirror="no", history=True)
    recorded = replace(final, history=True)
    assert ran.count(recorded) == 1 and ran[-1] == recorded and ran.count(STAGE) > 2
    assert found.refinement.history.energy.shape[0] == 2
    before = match(mesh, mesh, preset=replace(preset, final=()), init=swapped, mirror="no")
    after = match(mesh, mesh, preset=Preset((final,)), init=before.pointwise_map, mirror="no")
    assert np.array_equal(found.pointwise_map, after.pointwise_map)
    assert found.distortion == pytest.approx(after.distortion)
    assert found.suspicious == before.suspicious
    assert found.iterations == before.iterations + 2


def test_sizes_follow_from_levels():
    assert (STAGE.number_of_eigenvectors, STAGE.iterations) == (40, 4)
    assert (Stage().number_of_eigenvectors, Stage().iterations) == (100, 3)
    other = STAGE.with_levels((5, 50))
    assert (other.number_of_eigenvectors, other.iterations) == (50, 2)
    assert replace(STAGE, number_of_samples=300).number_of_samples == 300
    small = STAGE.fitted(60)
    assert small.refiner.levels == (20, 20, 30, 30) and small.number_of_eigenvectors == 30
    with pytest.raises(TypeError, match="positional"):
        Stage(FeatureRegression(LEVELS), 40)


def test_the_overlap_of_two_partial_shapes(body):
    """Two overlapping halves of a body, with the true maps in both directions."""
    mesh, _ = body
    height = mesh.vertices[:, 1]
    keep_x, keep_y = height < np.quantile(height, 0.7), height > np.quantile(height, 0.3)
    x, y = (make_mesh(mesh.vertices, mesh.faces[k[mesh.faces].all(axis=1)]) for k in (keep_x, keep_y))

    def nearest(to: Mesh) -> np.ndarray:
        used = np.flatnonzero(to.referenced_vertices)
        return used[KDTree(mesh.vertices[used]).query(mesh.vertices)[1]]

    pair = Pair.make(x, y, partial=True)
    found = overlap(pair, nearest(y), nearest(x))
    used = x.referenced_vertices
    assert (found == keep_y)[used].mean() > 0.9
    inside = used & y.referenced_vertices
    assert detours(pair, nearest(y), nearest(x))[inside].max() == 0
