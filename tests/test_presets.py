"""Stages one after the other, from one start or several."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from synthetic import body_with_arms

from jaxsmw import presets
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.matching import match
from jaxsmw.presets import Stage, refine_in_stages
from jaxsmw.repair.faults import flaw
from jaxsmw.report.summary import summarize

STAGE = Stage(FeatureRegression((20, 20, 40, 40)), 40, iterations=4)
MENDING = replace(STAGE, mending=STAGE)


@pytest.fixture(scope="module")
def body():
    """The mesh, what stages see of it and itself, and a map of it to itself that swaps its arms."""
    mesh = body_with_arms()
    spectrum = compute_spectrum(mesh, 40)
    _, mirrored = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    arms = np.abs(mesh.vertices[:, 0]) > 1
    swapped = np.where(arms, mirrored, np.arange(len(mesh.vertices)))
    return mesh, (spectrum, spectrum), jnp.asarray(swapped, jnp.int32)


def outcome(body, stages, start, **options):
    mesh, spectra, _ = body
    found = refine_in_stages([spectra] * len(stages), start, stages, meshes=(mesh, mesh), **options)
    assert found.successful
    wrong = np.asarray(found.pointwise_map) != np.arange(len(mesh.vertices))
    return mesh.vertex_areas[wrong].sum() / mesh.area, found


def test_swapped_limbs_are_mended(body):
    assert outcome(body, [STAGE], body[2])[0] > 0.1
    assert outcome(body, [MENDING], body[2])[0] < 0.02


def test_padding_changes_nothing(body):
    mesh, (spectrum, _), swapped = body
    found = refine_in_stages([(spectrum, spectrum)], swapped, [MENDING], meshes=(mesh, mesh))
    n = len(mesh.vertices)
    padded = spectrum.pad(n + 20)
    more = refine_in_stages([(padded, padded)], jnp.pad(swapped, (0, 20)), [MENDING], meshes=(mesh, mesh))
    np.testing.assert_array_equal(more.pointwise_map[:n], found.pointwise_map)


def test_another_start_helps_where_mending_does_not(body, monkeypatch):
    """With no round to mend in; and the start that did it is told."""
    mesh, (spectrum, _), swapped = body
    stage = MENDING
    monkeypatch.setattr(presets, "_ROUNDS", 1)
    # Nothing is left to tell the arms apart by: all that mending could keep is turned round.
    _, turned = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    start, identity = jnp.asarray(turned, jnp.int32), jnp.arange(len(mesh.vertices), dtype=jnp.int32)
    assert flaw(mesh, mesh, turned, spectrum) > 1.3
    wrong, found = outcome(body, [stage], start, other_starts=[swapped, identity])
    assert wrong < 0.02 and found.initial_map is not start and not found.suspicious
    wrong, alone = outcome(body, [stage], start)
    assert wrong > 0.5 and alone.suspicious and alone.flaw > 1.3


def test_what_looks_right_goes_before_what_is_less_doubtful(body, monkeypatch):
    mesh = body[0]
    _, turned = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    start, identity = jnp.asarray(turned, jnp.int32), jnp.arange(len(mesh.vertices), dtype=jnp.int32)
    monkeypatch.setattr(presets, "doubt", lambda outcome: -outcome.flaw)
    wrong, found = outcome(body, [MENDING], start, other_starts=[identity])
    assert wrong < 0.02 and not found.suspicious


def test_where_nothing_looks_right_what_three_starts_agree_on_is_taken(body, monkeypatch):
    mesh = body[0]
    _, turned = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    start, identity = jnp.asarray(turned, jnp.int32), jnp.arange(len(mesh.vertices), dtype=jnp.int32)
    starts = [start, identity, start]
    wrong, found = outcome(body, [MENDING], start, other_starts=starts)
    assert wrong < 0.02 and not found.suspicious  # it looks right, whatever the others are
    monkeypatch.setattr(presets, "SUSPICIOUS", 0.5)
    monkeypatch.setattr(presets, "DOUBTFUL", 0.5)
    wrong, found = outcome(body, [MENDING], start, other_starts=starts)
    assert wrong > 0.5 and found.suspicious
    wrong, found = outcome(body, [MENDING], start, other_starts=starts[:2])
    assert wrong < 0.02 and found.suspicious  # two are not enough


def test_no_other_start_is_asked_for_without_need(body):
    def none():
        raise AssertionError("a start was asked for")
        yield

    identity = jnp.arange(len(body[0].vertices), dtype=jnp.int32)
    wrong, found = outcome(body, [MENDING], identity, other_starts=none())
    assert wrong < 0.02 and found.initial_map is identity
    # Nor by stages that do not mend.
    outcome(body, [STAGE], body[2], other_starts=none())


def test_what_still_looks_wrong_is_said(body):
    mesh, _, _ = body
    _, turned = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    with pytest.warns(UserWarning, match="limbs may be swapped, or the body turned round"):
        found = match(mesh, mesh, preset=MENDING, init=turned)
    assert found.suspicious and found.flaw > 1.3
    facts = summarize(found, {}, found.expected_error())
    assert facts["flaw (1 is none)"] == f"{found.flaw:.2f}; above 1.12 limbs may be swapped"
    right = match(mesh, mesh, preset=MENDING, init=np.arange(len(mesh.vertices)))
    assert right.flaw < 1.1 and not right.suspicious
