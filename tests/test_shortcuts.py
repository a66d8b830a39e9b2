"""Shortcuts of a surface that is fused with itself, and how they are cut before a match."""

from dataclasses import replace

import igl
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

from jaxsmw import (
    InputError,
    geodesic_error,
    make_mesh,
    match,
    match_collection,
    match_pairs,
    read_mesh,
)
from jaxsmw.benchmark.datasets import choose_pairs, open_data_set
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.geometry import SurfacePoints, cut_shortcuts, geodesic_distances
from jaxsmw.geometry.mesh import Mesh, diagnose
from jaxsmw.geometry.shortcuts import points_on_uncut
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.settings import SearchSettings
from jaxsmw.matching.stages import PRESETS, Preset, Stage


def bent_tube(gap: float, *, spacing: float = 0.08, thickness: float = 0.3) -> Mesh:
    """A tube around most of a circle of radius 1, whose ends are round.

    `gap` is the distance between the centres of the ends. If it is less than twice the thickness, the ends
    are fused.
    """
    half = np.arcsin(gap / 2)
    along = np.linspace(half, 2 * np.pi - half, 400)
    line = np.stack([np.cos(along), np.sin(along), 0.2 * np.sin(3 * along)], axis=1)
    extent = np.arange(-1.6, 1.6, spacing)
    grid = np.stack(np.meshgrid(extent, extent, extent, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
    distance = KDTree(line).query(grid)[0]
    size = len(extent)
    vertices, faces = igl.marching_cubes(distance - thickness, np.ascontiguousarray(grid), size, size, size)[
        :2
    ]
    return make_mesh(vertices, faces, name="tube")


def handles(mesh: Mesh) -> float:
    """The number of handles of a connected mesh, by Euler's formula with V, E and F of the mesh itself."""
    manifold = igl.split_nonmanifold(mesh.faces)[0]
    boundaries = len(igl.boundary_loop_all(manifold))
    return 1 - (igl.euler_characteristic(manifold) + boundaries) / 2


@pytest.fixture(scope="module")
def fused():
    return bent_tube(0.5)


@pytest.fixture(scope="module")
def separate():
    return bent_tube(0.75)


@pytest.fixture(scope="module")
def cut(fused):
    return cut_shortcuts(fused)


def lost_faces(mesh: Mesh, cut: Mesh) -> np.ndarray:
    return mesh.faces[np.isin(mesh.face_numbers, cut.dropped_faces)]


def test_the_contact_is_cut(fused, separate, cut):
    assert handles(fused) == 1
    assert handles(separate) == handles(cut) == 0
    assert np.array_equal(cut.vertices, fused.vertices)
    assert np.array_equal(cut.faces, fused.faces[np.isin(fused.face_numbers, cut.face_numbers)])
    assert diagnose(cut).components == 1
    # All lost faces are near the contact, whose middle is (1, 0, 0).
    distance = np.linalg.norm(fused.vertices[lost_faces(fused, cut)] - [1, 0, 0], axis=2)
    assert 0 < distance.size < 0.1 * len(fused.faces)
    assert distance.max() < 0.4


def test_distances_across_the_contact_become_long(fused, separate, cut):
    def between_ends(mesh: Mesh) -> float:
        ends = [np.argmin(np.linalg.norm(mesh.vertices - [0.7, y, 0], axis=1)) for y in (0.7, -0.7)]
        return float(geodesic_distances(mesh, ends[:1])[0, ends[1]])

    assert between_ends(fused) < 2
    assert between_ends(cut) == pytest.approx(between_ends(separate), rel=0.05)
    assert between_ends(separate) > 3


@pytest.mark.parametrize("scale", [1e-45, 1e-3, 1e4, 1e45])
def test_cuts_do_not_depend_on_the_position(fused, cut, scale):
    turn = Rotation.random(random_state=1).as_matrix()
    moved = replace(fused, vertices=scale * fused.vertices @ turn.T + scale)
    assert np.array_equal(cut_shortcuts(moved).dropped_faces, cut.dropped_faces)


def test_mirror_images_have_the_same_cuts(fused, cut):
    assert np.array_equal(cut_shortcuts(fused.mirrored()).dropped_faces, cut.dropped_faces)


def test_inside_out_surfaces_are_cut(fused):
    inside_out = replace(fused, faces=np.ascontiguousarray(fused.faces[:, ::-1]))
    assert handles(cut_shortcuts(inside_out)) == 0


def test_the_order_of_vertices_and_faces_does_not_matter(fused, cut):
    random = np.random.default_rng(0)
    order, faces = random.permutation(len(fused.vertices)), random.permutation(len(fused.faces))
    permuted = make_mesh(fused.vertices[order], np.argsort(order)[fused.faces[faces]])
    lost = np.sort(faces[cut_shortcuts(permuted).dropped_faces])
    assert np.array_equal(lost, cut.dropped_faces)


def test_dropped_faces_of_the_file_stay_dropped(fused):
    faces = np.concatenate([fused.faces[:5], fused.faces])  # the first five faces occur twice
    mesh = make_mesh(fused.vertices, faces)
    cut = cut_shortcuts(mesh)
    assert len(mesh.dropped_faces) == 5
    assert set(mesh.dropped_faces) < set(cut.dropped_faces)
    assert np.array_equal(faces[cut.face_numbers], cut.faces)
    assert len(cut.faces) + len(cut.dropped_faces) == len(faces)


@pytest.mark.parametrize("thickness", [0.2, 0.4])
def test_smooth_handles_are_not_cut(thickness):
    ring = bent_tube(0.05, thickness=thickness)
    assert handles(ring) == 1
    assert cut_shortcuts(ring) is ring


def test_surfaces_without_handles_stay_unchanged(separate):
    for mesh in (separate, bumpy_mesh(2)):
        assert cut_shortcuts(mesh) is mesh
    # Boundary loops are not handles, even if they touch each other.
    punched = make_mesh(separate.vertices, separate.faces[np.arange(len(separate.faces)) % 7 > 0])
    assert cut_shortcuts(punched) is punched


@pytest.mark.slow
def test_porous_surfaces_stay_unchanged(fused, monkeypatch):
    def copies(number: int) -> Mesh:
        shifts = 4.0 * np.arange(number)[:, None, None] * [1, 0, 0]
        faces = fused.faces + len(fused.vertices) * np.arange(number)[:, None, None]
        return make_mesh((fused.vertices + shifts).reshape(-1, 3), faces.reshape(-1, 3))

    several, many = copies(12), copies(31)
    # Also with few base points, each component has a base point.
    monkeypatch.setattr("jaxsmw.geometry.shortcuts._REACHED", 1)
    cut = cut_shortcuts(several)
    assert len(igl.boundary_loop_all(cut.faces)) == 2 * 12
    assert diagnose(cut).components == 12
    assert cut_shortcuts(many) is many


def test_nonmanifold_surfaces_are_cut(fused):
    """A face that stands on an edge does not hide the handle."""
    fin = np.concatenate([fused.vertices, fused.vertices[fused.faces[0, :1]] * 1.05])
    a, b, _ = fused.faces[0]
    mesh = make_mesh(fin, np.concatenate([fused.faces, [[a, b, len(fin) - 1]]]))
    assert len(mesh.nonmanifold_edges) == 1
    assert len(cut_shortcuts(mesh).faces) < len(mesh.faces)


def test_components_without_loops_do_no_harm(fused, cut):
    """All edges of two folded triangles are in the tree of shortest paths."""
    n = len(fused.vertices)
    corners = np.array([[3, 0, 0], [4, 0, 0], [3.5, 1, 0], [3.5, 0.3, 1]])
    faces = np.concatenate([fused.faces, n + np.array([[0, 1, 2], [1, 0, 3]])])
    mesh = make_mesh(np.concatenate([fused.vertices, corners]), faces)
    assert np.array_equal(cut_shortcuts(mesh).dropped_faces, cut.dropped_faces)


SHORT = Stage(FeatureRegression((10, 15, 20)), number_of_descriptors=20)
# A search that always takes the first map.
NEVER = SearchSettings(certain=0.0, non_isometric=1e3)
SEARCHED = Preset(repeated=(SHORT,), search=NEVER)


@pytest.mark.slow
def test_match_cuts_both_meshes_if_the_preset_has_a_search(fused, separate):
    """Maps refer to the vertices of the given meshes, and vertices that a cut isolates have matches."""
    assert not PRESETS["paper"].cuts_shortcuts
    assert not PRESETS["fast"].cuts_shortcuts
    assert PRESETS["accurate"].cuts_shortcuts
    pair = Pair(fused, separate)
    cut = pair.without_shortcuts()
    assert len(cut.mesh_x.faces) < len(fused.faces)
    assert cut.mesh_y is separate
    assert Pair(separate, separate).without_shortcuts().mesh_x is separate
    found = {}
    for cuts in (True, False):
        preset = replace(SEARCHED, search=replace(NEVER, cut_shortcuts=cuts))
        found[cuts] = match(fused, separate, preset=preset, init="shot", mirror="no")
        assert found[cuts].mesh_x is fused
        assert found[cuts].pointwise_map.shape == (len(fused.vertices),)
    # The spectrum of the cut tube is closer to the spectrum of the separate tube.
    eigenvalues = {cuts: np.asarray(one.spectrum_x.eigenvalues)[1:10] for cuts, one in found.items()}
    target = np.asarray(found[True].spectrum_y.eigenvalues)[1:10]
    difference = {cuts: np.abs(np.log(values / target)).max() for cuts, values in eigenvalues.items()}
    assert difference[True] < 0.2 < difference[False]
    direct = match(cut.mesh_x, separate, preset=SHORT, init="shot", mirror="no")
    assert np.array_equal(direct.pointwise_map, found[True].pointwise_map)


def test_isolated_vertices_receive_the_match_of_their_neighbor(fused, separate, monkeypatch):
    """A vertex that loses all its faces is matched like the nearest other vertex."""
    gone = 100
    holed = replace(fused, faces=fused.faces[(fused.faces != gone).all(axis=1)])
    monkeypatch.setattr("jaxsmw.matching.pair.cut_shortcuts", lambda mesh: holed if mesh is fused else mesh)
    found = match(fused, separate, preset=SEARCHED, init="shot", mirror="no").pointwise_map
    distance = np.linalg.norm(fused.vertices - fused.vertices[gone], axis=1)
    distance[gone] = np.inf
    assert found[gone] == found[np.argmin(distance)]


def test_presets_fit_the_cut_meshes(fused, separate, monkeypatch):
    """A cut can leave fewer vertices than a stage has samples."""
    holed = replace(fused, faces=fused.faces[(fused.faces > 30).all(axis=1)])
    monkeypatch.setattr("jaxsmw.matching.pair.cut_shortcuts", lambda mesh: holed)
    stage = replace(SHORT, number_of_samples=len(fused.vertices) - 5)
    found = match(fused, fused, preset=replace(SEARCHED, repeated=(stage,)), init="shot", mirror="no")
    assert found.preset.stages[0].number_of_samples is None


@pytest.mark.slow
def test_surface_points_as_initial_map_refer_to_the_given_faces(fused, separate):
    first = match(separate, fused, preset=SEARCHED, init="shot", mirror="no")
    points = first.surface_points()
    again = match(separate, fused, preset=SEARCHED, init=points, mirror="no")
    assert np.array_equal(again.initial_map, points.nearest_corners(fused))


def test_pairs_of_a_collection_are_cut(fused, separate):
    """The results refer to the given meshes."""
    (_, found), (_, backward) = match_pairs([fused, separate], [(0, 1), (1, 0)], preset=SEARCHED)
    assert found.mesh_x is backward.mesh_y is fused
    direct = match(fused, separate, preset=SEARCHED, init="shot", mirror="no")
    assert np.allclose(found.spectrum_x.eigenvalues, direct.spectrum_x.eigenvalues, rtol=1e-4)


def test_points_on_a_cut_surface_keep_their_positions(fused, cut):
    random = np.random.default_rng(0)
    points = SurfacePoints(random.permutation(len(cut.faces)), random.dirichlet(np.ones(3), len(cut.faces)))
    on_fused = points_on_uncut(points, cut, fused)
    assert np.array_equal(fused.faces[on_fused.faces], cut.faces[points.faces])
    assert np.array_equal(on_fused.weights, points.weights)


@pytest.mark.slow
def test_collections_are_cut(fused, separate):
    """The points of the template lie on the given surfaces."""
    found = match_collection(
        [separate, fused, fused.mirrored()], preset=SEARCHED, mirror=[False, False, True]
    )
    assert np.array_equal(found.meshes[1].faces, fused.faces)
    middle = [
        (mesh.vertices[mesh.faces[points.faces]] * points.weights[:, :, None]).sum(axis=1)
        for mesh, points in zip(found.meshes, found.points, strict=True)
    ]
    # Mirrored tubes have mirrored points.
    assert np.median(np.linalg.norm(middle[1] - middle[2] * [-1, 1, 1], axis=1)) < 0.1
    distance = np.linalg.norm(middle[0] - middle[1], axis=1)
    assert np.quantile(distance, 0.9) < 0.3


def test_the_setting_is_checked():
    settings = SearchSettings()
    object.__setattr__(settings, "cut_shortcuts", "no")
    with pytest.raises(InputError, match="cut_shortcuts is 'no': give True or False"):
        settings.__post_init__()  # without the run-time type checks of the tests


@pytest.mark.sampled
@pytest.mark.filterwarnings("ignore:.*wrong as a whole:UserWarning")
def test_real_contacts(shared):
    """With topological noise, the map becomes better if contacts are cut."""
    data = open_data_set(shared / "data" / "shrec16_topology")
    pair = next(one for one in choose_pairs(data, None, 0) if "kid06" in one.name)
    mesh_x, mesh_y = map(read_mesh, pair.meshes)
    assert handles(mesh_x) == 3
    assert handles(cut_shortcuts(mesh_x)) == 0
    truth, errors = pair.ground_truth(mesh_x, mesh_y), []
    preset = PRESETS["accurate"]
    for cuts in (True, False):
        chosen = replace(preset, search=replace(preset.search, cut_shortcuts=cuts))
        found = match(mesh_x, mesh_y, preset=chosen)
        errors.append(geodesic_error(mesh_y, found.pointwise_map, truth, number_of_samples=300).mean)
    assert errors[0] < 0.9 * errors[1]
    assert errors[0] < 0.03
