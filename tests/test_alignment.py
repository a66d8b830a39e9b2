"""Rigid alignment, and the initial map that uses it."""

import equinox as eqx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

from jaxsmw import Pair, creature_pair, initial_map, make_mesh, match, matching, paired_spectra
from jaxsmw.core.results import RESULTS
from jaxsmw.geometry.alignment import align_rigidly

LUMP = bumpy_mesh(3)


@pytest.mark.parametrize("seed", range(5))
def test_a_moved_copy_is_aligned_exactly(seed):
    generator = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=seed), generator.normal(size=3)
    moved = turn.apply(LUMP.vertices)[generator.permutation(len(LUMP.vertices))] + shift
    motion = align_rigidly(LUMP.vertices, moved)
    np.testing.assert_allclose(motion.rotation, turn.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(motion.apply(LUMP.vertices), turn.apply(LUMP.vertices) + shift, atol=1e-6)


def test_the_motion_is_never_a_reflection():
    motion = align_rigidly(LUMP.vertices, LUMP.vertices * [-1, 1, 1])
    assert np.linalg.det(motion.rotation) == pytest.approx(1)


def test_noise_and_other_points_are_aligned_closely():
    generator = np.random.default_rng(0)
    turn = Rotation.random(random_state=1)
    long = np.array([1, 1.3, 2])
    fine = turn.apply(bumpy_mesh(4).vertices * long)
    noisy = LUMP.vertices * long + 0.01 * generator.normal(size=LUMP.vertices.shape)
    motion = align_rigidly(noisy, fine)
    assert (Rotation.from_matrix(motion.rotation) * turn.inv()).magnitude() < 0.02


@pytest.mark.parametrize("partial", [False, True])
def test_the_initial_map_of_a_moved_copy_is_right(partial):
    turn, scale = Rotation.random(random_state=2), 1.0 if partial else 5.0
    order = np.random.default_rng(0).permutation(len(LUMP.vertices))
    vertices = np.empty_like(LUMP.vertices)
    vertices[order] = scale * turn.apply(LUMP.vertices) - 3
    target = make_mesh(vertices, order[LUMP.faces])
    pair = Pair.make(LUMP, target, partial=partial)
    spectra = paired_spectra(pair, 20)
    np.testing.assert_array_equal(initial_map(pair, *spectra, init="aligned"), order)


def test_mirrored_shapes_are_aligned_as_their_mirror_images():
    image = LUMP.mirrored()
    target = make_mesh(image.vertices, image.faces)
    found = match(LUMP, target, preset="paper", init="aligned", mirror="yes")
    np.testing.assert_array_equal(found.initial_map, np.arange(len(LUMP.vertices)))


def _expected(found):
    return found.expected_error().mean()


@pytest.mark.parametrize("mirror", ["auto", "no"])
def test_asymmetric_shapes_are_matched_from_both_initial_maps(mirror):
    """The lump differs from its mirror image, so `match` keeps the better of two maps."""
    generator = np.random.default_rng(1)
    noise = 0.004 * generator.normal(size=LUMP.vertices.shape)
    target = make_mesh(Rotation.random(random_state=3).apply(LUMP.vertices + noise), LUMP.faces)
    chosen = match(LUMP, target, preset="paper", mirror=mirror)
    each = {init: match(LUMP, target, preset="paper", init=init, mirror="no") for init in ("shot", "aligned")}
    best = min(each, key=lambda init: _expected(each[init]))
    assert _expected(each["shot"]) != _expected(each["aligned"])
    assert chosen.init == best
    np.testing.assert_array_equal(chosen.pointwise_map, each[best].pointwise_map)
    assert {"mirror test", "expected error"} <= chosen.seconds.keys()


def test_bodies_are_matched_from_descriptors_alone():
    pair = creature_pair(vertices=700)
    found = match(pair.source, pair.target, preset="paper")
    assert found.init == "shot" and "expected error" not in found.seconds


def test_a_failed_refinement_does_not_hide_a_successful_one(monkeypatch):
    """With two initial maps, `match` ignores an outcome that failed."""
    real, failed = matching.refine_in_stages, []

    def refine_in_stages(prepared, *arguments, **settings):
        outcome = real(prepared, *arguments, **settings)
        if prepared.init == "shot":
            failed.append(prepared.init)
            last = outcome.refinements[-1]
            outcome.refinements[-1] = eqx.tree_at(lambda r: r.result, last, RESULTS.nonfinite_functional_map)
        return outcome

    monkeypatch.setattr(matching, "refine_in_stages", refine_in_stages)
    found = match(LUMP, LUMP, preset="paper", mirror="no")
    assert failed == ["shot"] and found.init == "aligned"
