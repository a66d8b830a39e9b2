from dataclasses import replace

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from synthetic import body_with_arms, bumpy_mesh

from jaxsmw.geometry import sampling
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.geometry.sampling import coarse_edges
from jaxsmw.matching.judge import (
    area_shape_difference,
    dirichlet_energy_ratio,
    discontinuous_parts,
    distortion,
    expected_error,
    orientation_reversal,
)
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.settings import ExpectedErrorSettings, ScoreSettings
from jaxsmw.wording import percentage


@pytest.fixture(scope="module")
def mesh():
    """A sphere with an arm on the left and an arm on the right."""
    return body_with_arms()


@pytest.fixture(scope="module")
def spectrum(mesh):
    return compute_spectrum(mesh, 60)


def test_the_identity_has_no_faults(mesh, spectrum):
    identity = np.arange(len(mesh.vertices))
    assert dirichlet_energy_ratio(Pair(mesh, mesh), identity, spectrum) == 1
    assert not discontinuous_parts(Pair(mesh, mesh), identity).any()
    assert not orientation_reversal(Pair(mesh, mesh), identity, spectrum).any()


def test_the_area_shape_difference_is_zero_for_isometries_and_known_for_a_constant_map(mesh, spectrum):
    pair, n = Pair(mesh, mesh), len(mesh.vertices)
    identity = np.arange(n)
    assert area_shape_difference(pair, identity, spectrum, spectrum) == pytest.approx(0, abs=1e-5)
    # Pulled back by a constant map, all functions are constant: the operator has rank 1.
    values = np.asarray(spectrum.eigenvectors)[5, :20]
    expected = np.sqrt((19 + (values @ values - 1) ** 2) / 20)
    constant = np.full(n, 5)
    assert area_shape_difference(pair, constant, spectrum, spectrum) == pytest.approx(expected, rel=1e-5)


def test_a_head_that_grows_has_a_larger_area_shape_difference_than_a_bent_body():
    mesh = bumpy_mesh(3)
    grown = make_mesh(
        mesh.vertices * np.where(mesh.vertices[:, 2:] > 0, 1 + mesh.vertices[:, 2:], 1), mesh.faces
    )
    identity, spectrum = np.arange(len(mesh.vertices)), compute_spectrum(mesh, 30)
    difference = area_shape_difference(Pair(mesh, grown), identity, spectrum, compute_spectrum(grown, 30))
    assert difference > 0.3


def test_scores_do_not_depend_on_unit_or_numbering():
    mesh = bumpy_mesh(3)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    other = make_mesh(50 * mesh.vertices[order] + 3, np.argsort(order)[mesh.faces])
    spectrum = compute_spectrum(mesh, 40)
    assert dirichlet_energy_ratio(Pair(mesh, other), np.argsort(order), spectrum) == pytest.approx(1)
    assert not orientation_reversal(Pair(mesh, other), np.argsort(order), spectrum).any()


def test_inside_out_meshes_have_no_orientation_reversal(mesh, spectrum):
    identity = np.arange(len(mesh.vertices))
    inside_out = make_mesh(mesh.vertices, mesh.faces[:, ::-1])
    for x, y in ((mesh, inside_out), (inside_out, mesh), (inside_out, inside_out)):
        assert not orientation_reversal(Pair(x, y), identity, spectrum).any()


def test_swapped_limbs_have_discontinuities_and_orientation_reversal(mesh, spectrum):
    arms = np.abs(mesh.vertices[:, 0]) > 1
    _, mirrored = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    swapped = np.where(arms, mirrored, np.arange(len(mesh.vertices)))
    off = discontinuous_parts(Pair(mesh, mesh), swapped)
    assert off[arms].all() and not off[~arms].any()
    reversed_ = orientation_reversal(Pair(mesh, mesh), swapped, spectrum)
    assert reversed_[arms].mean() > 0.8 and reversed_[~arms].mean() < 0.05
    assert (
        distortion(Pair(mesh, mesh), swapped, spectrum)
        > dirichlet_energy_ratio(Pair(mesh, mesh), swapped, spectrum)
        > 1.2
    )
    mirror_image = orientation_reversal(Pair(mesh, mesh), mirrored, spectrum)
    assert mirror_image.mean() > 0.95
    assert distortion(Pair(mesh, mesh), mirrored, spectrum) > 3 * dirichlet_energy_ratio(
        Pair(mesh, mesh), mirrored, spectrum
    )


def test_a_right_map_between_coarse_meshes_is_not_distorted():
    """With 200 vertices, right matches are often one edge from the truth, which is no distortion."""
    fine, noise = body_with_arms(), np.random.default_rng(0).normal(size=(2562, 3))
    x, y = (
        make_mesh(*igl.decimate(fine.vertices + amount * noise, fine.faces, 400)[:2]) for amount in (0, 0.03)
    )
    assert len(x.vertices) == len(y.vertices) == 202
    truth = KDTree(y.vertices).query(x.vertices)[1]
    spectrum = compute_spectrum(x, len(x.vertices) // 2)
    by_all = ScoreSettings(vertices_per_eigenvector=1)
    excess, excess_by_all = (
        distortion(Pair(x, y), truth, spectrum, s) - 1 for s in (ScoreSettings(), by_all)
    )
    assert 0 <= excess < 0.4 * excess_by_all


def test_edges_of_coarse_meshes_are_not_discontinuities():
    mesh = bumpy_mesh(1)
    assert not discontinuous_parts(Pair(mesh, mesh), np.arange(len(mesh.vertices))).any()


def test_a_map_that_collapses_is_distorted(spectrum, mesh):
    assert distortion(Pair(mesh, mesh), np.zeros(len(mesh.vertices), np.int64), spectrum) > 1e3
    part = np.flatnonzero(mesh.vertices[:, 2] > 0.5 * mesh.vertices[:, 2].max())
    shrunk = part[KDTree(mesh.vertices[part]).query(mesh.vertices)[1]]
    assert dirichlet_energy_ratio(Pair(mesh, mesh), shrunk, spectrum) < 0.8
    assert distortion(Pair(mesh, mesh), shrunk, spectrum) > 1.25
    # If Y is a part of X, shrinking is no distortion, because large parts of X have no match.
    row = np.full(len(mesh.vertices), -1)
    row[part] = np.arange(len(part))
    faces = row[mesh.faces]
    piece = Mesh(mesh.vertices[part], faces[(faces >= 0).all(axis=1)])
    assert distortion(Pair(mesh, piece, True), row[shrunk], spectrum) < 1.12
    # A collapse is a distortion of partial pairs as well, whichever shape is the part.
    assert distortion(Pair(mesh, piece, True), np.zeros_like(shrunk), spectrum) > 1e3
    assert distortion(Pair(mesh, mesh, True), np.zeros_like(shrunk), spectrum) > 1e3


def test_averages_weight_vertices_with_their_areas(mesh):
    values = mesh.vertices[:, :2]
    np.testing.assert_allclose(
        mesh.average(values), (mesh.vertex_areas[:, None] * values).sum(axis=0) / mesh.area, atol=1e-12
    )
    assert mesh.average(np.full(len(mesh.vertices), 3.0)) == pytest.approx(3)


def test_excluded_vertices_have_no_area_and_the_shape_keeps_its_area(spectrum, mesh):
    left_out = mesh.vertices[:, 0] > 0
    kept = spectrum.excluding(jnp.asarray(left_out))
    assert not kept.vertex_areas[left_out].any()
    ratio = kept.vertex_areas[~left_out] / spectrum.vertex_areas[~left_out]
    np.testing.assert_allclose(
        ratio, spectrum.vertex_areas.sum() / spectrum.vertex_areas[~left_out].sum(), rtol=1e-5
    )


def test_scattered_matches_are_no_distortion(spectrum, mesh):
    """Independent errors of about one edge cause no distortion, unlike a map of an arm to one vertex."""
    edge = np.sqrt(mesh.area / len(mesh.vertices))
    moved = mesh.vertices + edge * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    _, rough = KDTree(mesh.vertices).query(moved)
    edges = mesh.edges
    before, after = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (mesh.vertices, moved))
    assert np.sum(after**2) > 2 * np.sum(before**2)
    assert 0.8 < dirichlet_energy_ratio(Pair(mesh, mesh), rough, spectrum) < 1.1
    astray = np.where(mesh.vertices[:, 0] > 1, np.argmax(mesh.vertices[:, 2]), np.arange(len(mesh.vertices)))
    assert dirichlet_energy_ratio(Pair(mesh, mesh), astray, spectrum) > 1.1


def test_swapped_arms_are_discontinuous_on_dense_meshes(mesh, monkeypatch):
    """On dense meshes, discontinuities are detected on edges between evenly spread vertices."""
    arms = np.abs(mesh.vertices[:, 0]) > 1
    _, mirrored = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    swapped = np.where(arms, mirrored, np.arange(len(mesh.vertices)))
    coarse_edges.cache_clear()
    monkeypatch.setattr(sampling, "_DENSE", 1000)
    monkeypatch.setattr(sampling, "_SPREAD", 500)
    off = discontinuous_parts(Pair(mesh, mesh), swapped)
    assert off[arms].mean() > 0.8 and off[~arms].mean() < 0.1
    coarse_edges.cache_clear()


def test_the_expected_error_of_a_perfect_map_is_zero(mesh, spectrum):
    identity = np.arange(len(mesh.vertices))
    assert expected_error(Pair(mesh, mesh), identity, identity, spectrum, spectrum).max() == 0


def test_expected_errors_are_large_where_the_map_is_wrong(mesh, spectrum):
    """The wrong maps have swapped limbs or scattered matches."""
    identity = np.arange(len(mesh.vertices))
    arms = np.abs(mesh.vertices[:, 0]) > 1
    _, mirrored = KDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])
    swapped = np.where(arms, mirrored, identity)
    expected = expected_error(Pair(mesh, mesh), swapped, swapped, spectrum, spectrum)
    size = (mesh.vertex_areas[arms].sum() / 2 / mesh.area) ** 0.5
    assert 0.4 * size < expected[arms].min() and np.median(expected[~arms]) < 0.2 * size

    top = mesh.vertices[:, 2] > np.quantile(mesh.vertices[:, 2], 0.8)
    distance = 0.05 * mesh.area**0.5
    moved = mesh.vertices + distance * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    _, scattered = KDTree(mesh.vertices).query(moved)
    found = np.where(top, scattered, identity)
    expected = expected_error(Pair(mesh, mesh), found, identity, spectrum, spectrum)
    truly = np.linalg.norm(mesh.vertices[found] - mesh.vertices, axis=1) / mesh.area**0.5
    worst = expected >= np.quantile(expected, 0.8)
    assert truly[worst].sum() > 0.8 * truly.sum()
    assert 0.3 < expected[top].mean() / truly[top].mean() < 3


def test_expected_errors_are_larger_if_the_map_changes_areas(mesh, spectrum):
    """The factor applies to full shapes only."""
    identity = np.arange(len(mesh.vertices))
    swollen = make_mesh(mesh.vertices * np.where(mesh.vertices[:, 2:] > 0, [1.5, 1.5, 1], 1), mesh.faces)
    spectra = spectrum, compute_spectrum(swollen, 40)
    settings = ExpectedErrorSettings()
    for partial in (False, True):
        arguments = Pair(mesh, swollen, partial), identity, identity, *spectra
        expected = expected_error(*arguments)
        without = expected_error(*arguments, replace(settings, area_weight=0.0))
        difference = area_shape_difference(Pair(mesh, swollen), identity, *spectra)
        growth = settings.area_weight * np.log(difference / settings.isometric_difference)
        factor = 1 if partial else 1 + growth
        assert growth > 0.3
        np.testing.assert_allclose(expected, factor * without, rtol=1e-12)


def test_the_distance_of_a_mesh_from_the_origin_does_not_matter():
    """The spectra are in float32, which would lose digits of positions far from the origin."""
    near = bumpy_mesh(3)
    far = make_mesh(near.vertices + 1e5, near.faces)
    identity = np.arange(len(near.vertices))
    with jax.enable_x64(False):
        here, there = compute_spectrum(near, 40), compute_spectrum(far, 40)
    np.testing.assert_allclose(there.positions, here.positions, atol=1e-5)
    for x, y, spectrum in ((near, far, here), (far, near, there), (far, far, there)):
        assert dirichlet_energy_ratio(Pair(x, y), identity, spectrum) == pytest.approx(1, abs=1e-4)


def test_lengths_on_a_partial_shape_use_the_unit_of_the_full_shape(mesh):
    """Scaling the partial shape to area 1 would enlarge its lengths."""
    kept = mesh.vertices[:, 0] < 1
    old, faces = np.unique(mesh.faces[kept[mesh.faces].all(axis=1)], return_inverse=True)
    part = make_mesh(mesh.vertices[old], faces.reshape(-1, 3))
    spectrum = compute_spectrum(part, 40).scale(part.area / mesh.area)
    assert dirichlet_energy_ratio(Pair(part, mesh, True), old, spectrum) == pytest.approx(1)
    assert dirichlet_energy_ratio(Pair(part, mesh), old, spectrum) < 0.95
    assert not orientation_reversal(Pair(part, mesh, True), old, spectrum).any()
    back = KDTree(part.vertices).query(mesh.vertices)[1]
    expected = expected_error(Pair(part, mesh, True), old, back, spectrum, compute_spectrum(mesh, 40))
    assert expected.max() == pytest.approx(0, abs=1e-12)


def test_errors_on_a_partial_shape_are_in_its_own_unit(mesh, spectrum):
    """On a target with a smaller area, the same displacements are larger errors."""
    kept = mesh.vertices[:, 0] < 1
    old, faces = np.unique(mesh.faces[kept[mesh.faces].all(axis=1)], return_inverse=True)
    part = make_mesh(mesh.vertices[old], faces.reshape(-1, 3))
    found = KDTree(part.vertices).query(mesh.vertices)[1]
    spectra = spectrum, compute_spectrum(part, 40).scale(part.area / mesh.area)
    expected = expected_error(Pair(mesh, part, True), found, old, *spectra)
    gone = mesh.vertices[:, 0] > 1.3
    placed = np.linalg.norm(mesh.vertices - part.vertices[found], axis=1)[gone] / part.area**0.5
    assert 0.5 < expected[gone].mean() / placed.mean() < 4
    halved = make_mesh(part.vertices, part.faces[: len(part.faces) // 2])
    assert halved.area < 0.8 * part.area
    smaller = expected_error(Pair(mesh, halved, True), found, old, *spectra)
    np.testing.assert_allclose(smaller.max() / expected.max(), (part.area / halved.area) ** 0.5, rtol=0.2)


def test_percentages_are_never_quite_certain():
    assert [percentage(p) for p in (0.004, 0.03, 0.5, 0.994)] == ["below 1 %", "3 %", "50 %", "above 99 %"]
