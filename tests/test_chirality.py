"""The search for the hand of a pair: left and right teeth, and bodies that are their own mirror image."""

import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

import jaxsmw
from jaxsmw import Mesh, Pair, creature_pair, make_mesh, match, paired_spectra
from jaxsmw.geometry.shot import mirrored_descriptors, shot_descriptors
from jaxsmw.matching.search import chirality
from jaxsmw.matching.search.chirality import (
    ASYMMETRIC_FROM,
    ASYMMETRY_DOUBT,
    DOUBT,
    MIRRORED_FROM,
    Hands,
    decide,
)


@pytest.fixture(scope="module")
def lump() -> Mesh:
    """A lump without symmetry."""
    return bumpy_mesh(4)


def turned(mesh: Mesh, *, seed: int = 0) -> Mesh:
    """The mesh in another place, with other numbers of the vertices: vertex i becomes `order[i]`."""
    order = np.random.default_rng(seed).permutation(len(mesh.vertices))
    vertices = np.empty_like(mesh.vertices)
    vertices[order] = Rotation.random(random_state=seed).apply(mesh.vertices) * 3 + 1
    return make_mesh(vertices, order[mesh.faces], name="turned")


def order_of(mesh: Mesh, *, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).permutation(len(mesh.vertices))


def share_right(found: np.ndarray, mesh: Mesh) -> float:
    """The share of vertices whose match is near the right match on the turned mesh."""
    order = order_of(mesh)
    back = np.argsort(order)[found]
    apart = np.linalg.norm(mesh.vertices[back] - mesh.vertices, axis=1)
    return float((apart < 0.1 * mesh.area**0.5).mean())


def test_a_mirror_image_keeps_numbers_and_normals_point_outward(lump):
    image = lump.mirrored()
    np.testing.assert_array_equal(image.vertices, lump.vertices * [-1, 1, 1])
    assert not image.is_inside_out
    np.testing.assert_allclose(image.vertex_normals, lump.vertex_normals * [-1, 1, 1], atol=1e-12)
    np.testing.assert_array_equal(image.mirrored().faces, lump.faces)
    np.testing.assert_array_equal(image.mirrored().vertices, lump.vertices)


def test_descriptors_of_a_mirror_image_are_those_of_the_surface_in_another_order(lump):
    of_image = shot_descriptors(lump.mirrored(), radius=0.2)
    of_itself = shot_descriptors(lump, radius=0.2)
    np.testing.assert_allclose(mirrored_descriptors(of_itself), of_image, atol=1e-5)
    assert np.abs(of_itself - of_image).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("opposite", first_always([True, False]))
def test_auto_finds_the_hand_of_a_lump(lump, opposite):
    target = turned(lump.mirrored() if opposite else lump)
    found = match(lump, target, preset="fast", mirror="auto")
    assert found.mirrored is opposite
    assert found.mirror_evidence is not None
    assert (found.mirror_evidence > 0) is opposite
    assert not found.suspicious
    assert share_right(found.pointwise_map, lump) > 0.95
    same = match(lump, target, preset="fast", mirror="yes" if opposite else "no")
    np.testing.assert_array_equal(same.pointwise_map, found.pointwise_map)
    assert same.mirror_evidence is None


def test_the_given_hand_is_used(lump):
    target = turned(lump)
    with pytest.warns(UserWarning, match="limbs may be swapped or mirrored"):
        given = match(lump, target, preset="fast", mirror="yes")
    with pytest.warns(UserWarning, match="limbs may be swapped or mirrored"):
        alone = match(lump.mirrored(), target, preset="fast", mirror="no")
    assert (given.mirrored, alone.mirrored, given.mirror_evidence) == (True, False, None)
    assert ", mirrored" in repr(given)
    np.testing.assert_array_equal(given.pointwise_map, alone.pointwise_map)


@pytest.mark.slow
def test_a_mirrored_result_is_in_terms_of_the_source():
    lump = bumpy_mesh(3)
    target = turned(lump.mirrored())
    found = match(lump, target, mirror="yes")
    assert found.mesh_x is lump
    own, _ = paired_spectra(Pair.make(lump, target), 20)
    np.testing.assert_allclose(found.spectrum_x.positions, own.positions, atol=1e-6)
    np.testing.assert_allclose(found.spectrum_x.normals, own.normals, atol=1e-6)
    points = found.surface_points()
    places = np.einsum("pc,pcd->pd", points.weights, target.vertices[target.faces[points.faces]])
    right = target.vertices[order_of(lump)]
    assert np.median(np.linalg.norm(places - right, axis=1)) < 0.02 * target.area**0.5
    assert np.median(found.expected_error()) < 0.02
    assert found.distortion < 1.1


@pytest.mark.sampled
def test_a_creature_is_its_own_mirror_image(lump):
    pair = creature_pair(vertices=1500)
    found = match(pair.source, pair.target, preset="fast", mirror="auto")
    assert not found.mirrored
    alone = match(pair.source, pair.target, preset="fast", mirror="no")
    np.testing.assert_array_equal(found.pointwise_map, alone.pointwise_map)


@pytest.mark.parametrize(("mirror", "advice"), [("no", 'mirror="yes"'), ("yes", 'mirror="no"')])
def test_the_warning_of_a_reversed_map_names_the_other_hand(lump, mirror, advice):
    target = lump.mirrored() if mirror == "no" else lump
    with pytest.warns(UserWarning, match=rf"reverses the orientation of 100%.*{advice}"):
        match(lump, target, preset="fast", init=np.arange(len(lump.vertices)), mirror=mirror)


def test_small_meshes_give_no_evidence():
    small = bumpy_mesh(1)
    found = match(small, turned(small), preset="paper", init="wks", mirror="auto")
    assert found.mirror_evidence is None
    assert not found.mirrored


def test_the_hands_of_a_partial_pair_are_not_compared(lump):
    kept = lump.vertices[lump.faces].mean(axis=1)[:, 2] > 0
    part = make_mesh(lump.vertices, lump.faces[kept])
    found = match(part, lump, preset="fast", partial=True, mirror="auto")
    assert (found.mirrored, found.mirror_evidence) == (False, None)
    assert match(part, lump.mirrored(), preset="fast", partial=True, mirror="yes").mirrored


def test_decisions():
    clear, near = MIRRORED_FROM + 1, MIRRORED_FROM + DOUBT / 2
    assert decide(clear, 1.0) == (True, clear, False, True)
    assert decide(-clear, 1.0) == (False, -clear, False, True)
    assert decide(near, 1.0) == (True, near, True, True)
    assert decide(near - DOUBT, 1.0) == (False, near - DOUBT, True, True)
    nearly_symmetric = ASYMMETRIC_FROM - ASYMMETRY_DOUBT / 2
    assert decide(clear, nearly_symmetric) == (False, clear, True, False)
    assert decide(-clear, nearly_symmetric) == (False, -clear, False, False)


@pytest.mark.slow
def test_a_shape_that_is_its_own_mirror_image_has_no_asymmetry(lump):
    creature = creature_pair(vertices=1500)
    for mesh_x, mesh_y, low, high in (
        (creature.source, creature.target, 0.0, 0.5),
        (lump, turned(lump), 0.65, 1.1),
    ):
        pair = Pair.make(mesh_x, mesh_y)
        asymmetry = Hands(pair, *paired_spectra(pair, 20)).asymmetry()
        assert low < asymmetry < high
        mirrored = pair.mirrored()
        assert Hands(mirrored, *paired_spectra(mirrored, 20)).asymmetry() == pytest.approx(
            asymmetry, abs=0.02
        )


def test_the_asymmetry_of_a_known_mesh_is_not_computed_again(lump, monkeypatch, tmp_path):
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path))
    pair = Pair.make(lump, turned(lump))
    hands = Hands(pair, *paired_spectra(pair, 20))
    first = hands.asymmetry()
    monkeypatch.setattr(chirality, "shot_descriptors", lambda *_, **__: pytest.fail("computed again"))
    assert hands.asymmetry() == first


def test_symmetric_shapes_are_not_compared(lump, monkeypatch):
    monkeypatch.setattr(Hands, "asymmetry", lambda self: 0.4)
    monkeypatch.setattr(Hands, "evidence", lambda self: pytest.fail("compared"))
    pair = Pair.make(lump, turned(lump))
    assert Hands(pair, *paired_spectra(pair, 20)).decide() == (False, None, False, False)


@pytest.mark.parametrize(("evidence", "mirrored"), [(0.03, False), (0.07, True)])
def test_a_doubtful_hand_is_flagged(lump, monkeypatch, evidence, mirrored):
    monkeypatch.setattr(Hands, "evidence", lambda self: evidence)
    target = turned(lump.mirrored() if mirrored else lump)  # the chosen hand is right, so the map is right
    with pytest.warns(UserWarning, match="match the target about equally well"):
        found = match(lump, target, preset="fast", mirror="auto")
    assert found.suspicious
    assert found.mirrored is mirrored
    assert found.mirror_evidence == evidence


@pytest.mark.slow
def test_evidence_has_opposite_signs_for_opposite_hands(lump):
    for target, sign in ((turned(lump), -1), (turned(lump.mirrored()), 1)):
        pair = Pair.make(lump, target)
        assert np.sign(Hands(pair, *paired_spectra(pair, 40)).evidence()) == sign


@pytest.mark.sampled
@pytest.mark.parametrize(("names", "opposite"), [(("T04", "J12"), True), (("T04", "Q28"), False)])
def test_hands_of_teeth(shared, names, opposite):
    directory = shared / "data" / "primate_molars"
    pair = Pair.make(*(jaxsmw.read_mesh(directory / f"{name}_sas.off") for name in names))
    decision = Hands(pair, *paired_spectra(pair, 20)).decide()
    assert decision.mirrored is opposite and not decision.doubtful
