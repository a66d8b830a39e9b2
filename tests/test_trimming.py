"""The larger shape of a partial pair is trimmed, and the pair is matched again."""

from dataclasses import replace

import numpy as np
import pytest
from sampled_cases import first_always
from scipy.spatial import KDTree

from jaxsmw import creature_pair, geodesic_error, make_mesh, match, read_mesh
from jaxsmw.benchmark.datasets import open_data_set
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.search.trimming import trimmed, trimmed_stage
from jaxsmw.matching.settings import SearchSettings
from jaxsmw.matching.stages import Preset, Stage

TRIMMED = Preset(
    repeated=(
        Stage(FeatureRegression((10, 20, 30)), number_of_descriptors=20),
        Stage(Registration((30, 60))),
    ),
    final=(Stage(Registration((60, 60))),),
    search=SearchSettings(certain=0.0),
)
WHOLE = replace(TRIMMED, search=replace(TRIMMED.search, trims=0))


@pytest.fixture(scope="module")
def pose():
    """Two poses of a body with different triangulations, and the true map of the vertices of the first."""
    found = creature_pair(vertices=1500)
    return found.source, found.target, found.truth.nearest_corners(found.target)


@pytest.fixture(scope="module")
def part(pose):
    """The front of the body in the first pose. All vertices keep their numbers."""
    whole = pose[0]
    front = whole.vertices[:, 2] > np.median(whole.vertices[:, 2])
    return make_mesh(whole.vertices, whole.faces[front[whole.faces].all(axis=1)], name="front")


def nearest(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    used = np.flatnonzero(mesh.referenced_vertices)
    return used[KDTree(mesh.vertices[used]).query(points)[1]]


def rough(mesh: Mesh, true: np.ndarray) -> np.ndarray:
    """An initial map with random errors of about a twentieth of the body's size."""
    noise = 0.05 * mesh.area**0.5 * np.random.default_rng(0).normal(size=(len(true), 3))
    return nearest(mesh, mesh.vertices[true] + noise)


def covered(pose, part) -> np.ndarray:
    """The vertices of the second pose whose true points are on the part."""
    _, target, truth = pose
    back = KDTree(target.vertices[truth]).query(target.vertices)[1]
    return part.referenced_vertices[back]


def mean_error(mesh, found, truth, used):
    offsets = mesh.vertices[found[used]] - mesh.vertices[truth[used]]
    return float(np.linalg.norm(offsets, axis=1).mean() / mesh.area**0.5)


@pytest.fixture(scope="module")
def trimmed_match(pose, part):
    """The match of the part from a rough initial map, with trimming."""
    _, target, truth = pose
    return match(part, target, partial=True, preset=TRIMMED, init=rough(target, truth))


def test_the_larger_shape_is_trimmed_to_the_region_of_the_smaller_shape(pose, part):
    whole, _, _ = pose
    identity = np.arange(len(whole.vertices))
    pair, back = Pair(part, whole, True), nearest(part, whole.vertices)
    found = trimmed(pair, identity, back, 1.0)
    assert found.mesh_x is part and found.partial
    assert found.mesh_y.vertices is whole.vertices
    assert 1.0 < found.mesh_y.area / part.area < 1.15
    assert found.mesh_y.referenced_vertices[part.referenced_vertices].mean() > 0.99
    # The removed faces are recorded, so that faces keep the numbers of the given mesh.
    np.testing.assert_array_equal(whole.faces[found.mesh_y.face_numbers], found.mesh_y.faces)
    other = trimmed(pair.reversed(), back, identity, 1.0)
    np.testing.assert_array_equal(other.mesh_x.faces, found.mesh_y.faces)
    assert other.mesh_y is part


def test_small_pieces_of_the_trimmed_shape_are_left_out(pose, part):
    """A few wrong matches far away do not keep faces there."""
    whole, _, _ = pose
    identity = np.arange(len(whole.vertices))
    back = nearest(part, whole.vertices)
    far = int(np.argmin(whole.vertices[:, 2]))
    back[far] = far  # the map and the reverse map agree on this vertex, which is not on the part
    kept = trimmed(Pair(part, whole, True), identity, back, 1.0).mesh_y.referenced_vertices
    assert not kept[far] and kept.any()


@pytest.mark.filterwarnings("ignore:.*wrong as a whole")  # the rough map before trimming
@pytest.mark.parametrize("reverse", first_always([False, True]))
def test_a_trimmed_pair_is_matched_better(pose, part, trimmed_match, reverse):
    """The map of the part is more accurate after trimming. The part may also be the target."""
    _, target, truth = pose
    mask = covered(pose, part)
    if reverse:
        back = nearest(part, part.vertices[KDTree(target.vertices[truth]).query(target.vertices)[1]])
        source, goal, true, used = target, part, back, mask
    else:
        source, goal, true, used = part, target, truth, part.referenced_vertices
    init = rough(goal, true)
    before = match(source, goal, partial=True, preset=WHOLE, init=init)
    after = match(source, goal, partial=True, preset=TRIMMED, init=init) if reverse else trimmed_match
    errors = [mean_error(goal, found.pointwise_map, true, used) for found in (before, after)]
    assert errors[1] < 0.9 * errors[0]
    # Equal numbers of eigenvectors belong to the trimmed pair.
    k_x, k_y = after.functional_map.shape
    assert k_x == k_y == 60 and min(before.functional_map.shape) < 60
    assert after.pair.meshes == (source, goal)
    for spectrum, mesh in ((after.spectrum_x, source), (after.spectrum_y, goal)):
        assert not (np.asarray(spectrum.mask) & ~mesh.referenced_vertices).any()


def test_all_vertices_have_matches_after_trimming(pose, part, trimmed_match):
    """Vertices that were trimmed have the matches of their nearest neighbours that were not trimmed."""
    target, found = pose[1], trimmed_match
    kept = np.asarray(found.spectrum_y.mask)
    assert 0.3 < kept.mean() < 0.8
    reverse = found.reverse_map()
    used = np.flatnonzero(kept)
    near = used[KDTree(target.vertices[used]).query(target.vertices)[1]]
    np.testing.assert_array_equal(reverse, reverse[near])
    assert part.referenced_vertices[reverse].all() and kept[found.pointwise_map].all()
    points = found.surface_points()
    offsets = points.positions(target) - target.vertices[found.pointwise_map]
    assert np.linalg.norm(offsets, axis=1).max() < 0.1 * target.area**0.5
    back = found.reverse_surface_points()
    assert (back.faces < len(part.faces)).all() and np.isfinite(back.weights).all()
    assert np.isfinite(found.expected_error()).all()
    _, mask_y = found.overlap()
    expected = covered(pose, part)
    assert (mask_y & expected).sum() > 0.85 * (mask_y | expected).sum()


def test_the_trimmed_stage_is_the_last_stage_with_lower_levels(pose, part):
    pair, search = Pair(part, pose[0], True), replace(TRIMMED.search, trimmed_levels=(20, 40, 200))
    stage = trimmed_stage(pair, replace(TRIMMED, search=search))
    # No level exceeds the number of eigenvectors of the last stage.
    assert stage == TRIMMED.stages[-1].with_levels((20, 40, 60))
    without_levels = Stage(number_of_eigenvectors=40)
    unchanged = trimmed_stage(pair, replace(TRIMMED, final=(without_levels,), search=search))
    assert unchanged == without_levels
    share = 1.001 * pose[0].area / part.area
    for other, settings in (
        (pair, None),
        (pair, replace(search, trims=0)),
        (pair, replace(search, trimmed_from=share)),
        (replace(pair, partial=False), search),
    ):
        assert trimmed_stage(other, replace(TRIMMED, search=settings)) is None


@pytest.mark.slow
def test_full_shapes_and_parts_of_similar_area_are_not_trimmed(pose, part):
    source, target, truth = pose
    same = nearest(part, part.vertices)
    for *meshes, init in ((source, target, truth), (part, part, same)):
        found = match(*meshes, partial=True, preset=TRIMMED, init=init, mirror="no")
        assert np.asarray(found.spectrum_y.mask).sum() == meshes[1].referenced_vertices.sum()


@pytest.mark.slow
@pytest.mark.usefixtures("no_programs")
def test_all_trims_share_one_program(pose, part, compilations):
    _, target, truth = pose
    twice = replace(TRIMMED, search=replace(TRIMMED.search, trims=2))
    found = match(part, target, partial=True, preset=twice, init=rough(target, truth), backend="jax")
    assert len(found.preset.before_final) == 2
    assert found.backend == "jax"
    assert compilations.count("jit(refine)") == 3


def test_a_scaled_part_has_the_same_map(pose, part, trimmed_match):
    _, target, truth = pose
    small = make_mesh(part.vertices / 8, part.faces, name="front")
    scaled = match(small, target, partial=True, scale=8.0, preset=TRIMMED, init=rough(target, truth))
    assert np.mean(trimmed_match.pointwise_map == scaled.pointwise_map) > 0.99


@pytest.mark.parametrize("wrong", [{"trims": -1}, {"trimmed_from": 0.0}, {"trimmed_area": 0.0}])
def test_wrong_settings_of_trimming_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        SearchSettings(**wrong)


@pytest.mark.sampled
def test_trimming_lowers_the_error_of_a_real_part(shared):
    data = open_data_set(shared / "data" / "shrec16_partial")
    pair = next(one for one in data.pairs if one.names == ("cuts_david_shape_3", "david"))
    meshes = [read_mesh(file) for file in pair.meshes]
    truth = pair.ground_truth(*meshes)
    found = match(*meshes, partial=True)
    # Without trimming, the error is 0.011.
    assert geodesic_error(meshes[1], found.pointwise_map, truth, number_of_samples=300).mean < 0.008
    assert np.asarray(found.spectrum_y.mask).mean() < 0.8
