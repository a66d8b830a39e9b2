import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh, grid_mesh, sphere_mesh

from jaxsmw.errors import InputError
from jaxsmw.geometry import shot
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.sampling import SurfaceSamples
from jaxsmw.geometry.shot import shot_descriptors


@pytest.fixture(scope="module")
def bumpy():
    return bumpy_mesh()


@pytest.fixture(scope="module")
def descriptors(bumpy):
    return shot_descriptors(bumpy)


def agree(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether 99 % of the descriptors are equal. Rounding may flip the local axes of a few
    descriptors."""
    return np.mean(np.abs(a - b).max(axis=1) < 1e-5) > 0.99


def test_descriptors_are_non_negative_unit_rows_of_352(bumpy, descriptors):
    assert descriptors.shape == (len(bumpy.vertices), 352)
    assert (descriptors >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize(
    "move",
    [
        lambda v: v * 1e-3,
        lambda v: v * 1e5,
        lambda v: v + np.array([3.0, -2.0, 9.0]),
        lambda v: v @ Rotation.from_euler("xyz", (0.3, 1.2, -2.0)).as_matrix().T,
    ],
    ids=["smaller", "larger", "moved", "rotated"],
)
def test_invariant_to_similarity(bumpy, descriptors, move):
    assert agree(shot_descriptors(make_mesh(move(bumpy.vertices), bumpy.faces)), descriptors)


def test_renumbering_vertices_renumbers_descriptors(bumpy, descriptors):
    order = np.random.default_rng(0).permutation(len(bumpy.vertices))
    renumbered = make_mesh(bumpy.vertices[order], np.argsort(order)[bumpy.faces])
    assert agree(shot_descriptors(renumbered), descriptors[order])


def test_an_inside_out_mesh_has_the_same_descriptors(bumpy, descriptors):
    assert agree(shot_descriptors(make_mesh(bumpy.vertices, bumpy.faces[:, ::-1])), descriptors)


def test_distinguishes_a_mirror_image(bumpy, descriptors):
    mirrored = make_mesh(bumpy.vertices * [-1, 1, 1], bumpy.faces[:, ::-1])
    distance = np.linalg.norm(shot_descriptors(mirrored) - descriptors, axis=1)
    assert np.median(distance) > 0.1


def test_distinguishes_vertices_despite_noise(bumpy, descriptors):
    generator = np.random.default_rng(0)
    spacing = np.sqrt(bumpy.area / len(bumpy.vertices))
    noisy = make_mesh(
        bumpy.vertices + 0.03 * spacing * generator.normal(size=bumpy.vertices.shape), bumpy.faces
    )
    products = shot_descriptors(noisy) @ descriptors.T
    distance = np.linalg.norm(bumpy.vertices[products.argmax(axis=1)] - bumpy.vertices, axis=1)
    assert np.mean(distance < 2 * spacing) > 0.5


def test_the_size_of_blocks_has_no_effect(bumpy, descriptors, monkeypatch):
    monkeypatch.setattr(shot, "_PAIRS_PER_BLOCK", 5000)
    np.testing.assert_allclose(shot_descriptors(bumpy), descriptors, atol=1e-5)


def test_a_flat_square_fills_one_bin_of_the_cosine():
    """On a plane, all normals equal z or -z, so only one of the cosine bins is not empty."""
    descriptors = shot_descriptors(make_mesh(*grid_mesh(40, 40)), radius=0.2)
    bins = descriptors.reshape(-1, 32, 11).sum(axis=1)
    extreme = np.maximum(bins[:, 0], bins[:, 10])
    np.testing.assert_allclose(extreme, bins.sum(axis=1), rtol=1e-5)


def test_the_radius_has_an_effect(bumpy, descriptors):
    assert np.abs(shot_descriptors(bumpy, radius=0.09) - descriptors).max() > 0.1


def test_unreferenced_vertices_get_zeros_and_coincident_vertices_get_finite_values(bumpy, descriptors):
    vertices = np.concatenate([bumpy.vertices, bumpy.vertices[:1]])
    with_unreferenced = shot_descriptors(make_mesh(vertices, bumpy.faces))
    assert (with_unreferenced[-1] == 0).all()
    assert agree(with_unreferenced[:-1], descriptors)
    faces = np.concatenate([bumpy.faces, [[len(vertices) - 1, *bumpy.faces[0, 1:]]]])
    assert np.isfinite(shot_descriptors(make_mesh(vertices, faces))).all()


def test_too_coarse_meshes_are_refused():
    coarse = make_mesh(*sphere_mesh(1))
    with pytest.raises(InputError, match="use a finer mesh, or the initial map 'wks'"):
        shot_descriptors(coarse)
    with pytest.raises(InputError, match=r"use a finer mesh\.$"):
        shot_descriptors(coarse, required=True)
    assert np.isfinite(shot_descriptors(coarse, radius=0.5)).all()
    vertices, faces = sphere_mesh(4)
    far = np.concatenate([vertices, np.eye(3) + 50])
    patch = np.concatenate([faces, len(vertices) + np.array([[0, 1, 2]])])
    flag = make_mesh(np.concatenate([far, far[-3:] + 9, far[-3:] + 20, far[-3:] + 30] * 1), patch)
    assert np.isfinite(shot_descriptors(flag)).all()


def test_some_vertices_without_neighbors_cause_a_warning():
    vertices, faces = sphere_mesh(3)
    lonely = np.arange(30).reshape(10, 3)
    far = np.repeat(np.arange(10.0)[:, None] * 5 + 20, 3, axis=0) + np.tile(np.eye(3), (10, 1))
    mesh = make_mesh(np.concatenate([vertices, far]), np.concatenate([faces, lonely + len(vertices)]))
    with pytest.warns(UserWarning, match="fewer than 3"):
        descriptors = shot_descriptors(mesh, radius=0.1)
    assert (descriptors[len(vertices) :] == 0).all()


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan")])
def test_radius_must_be_positive(bumpy, radius):
    with pytest.raises(InputError, match="must be positive"):
        shot_descriptors(bumpy, radius=radius)


def test_samples_act_like_the_vertices_of_a_coarser_mesh(bumpy):
    """The vertices of the coarse mesh are the samples of the fine mesh, and both have similar descriptors."""
    coarse, fine = bumpy, bumpy_mesh(5)
    n = len(coarse.vertices)
    np.testing.assert_allclose(fine.vertices[:n], coarse.vertices, atol=1e-12)
    _, nearest = KDTree(coarse.vertices).query(fine.vertices)
    described = shot_descriptors(fine, samples=SurfaceSamples(np.arange(n), nearest))
    assert described.shape == (n, 352)
    difference, usual = (
        np.median(np.linalg.norm(a - described, axis=1))
        for a in (shot_descriptors(coarse), np.roll(described, 1, axis=0))
    )
    assert difference < 0.2 * usual


def test_all_vertices_as_samples_change_nothing(bumpy, descriptors):
    everything = np.arange(len(bumpy.vertices))
    same = shot_descriptors(bumpy, samples=SurfaceSamples(everything, everything))
    np.testing.assert_allclose(same, descriptors, atol=1e-5)
