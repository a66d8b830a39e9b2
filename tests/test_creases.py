"""Crease eigenvectors, and their use by stages and by the feature regression."""

import jax.numpy as jnp
import numpy as np
import pytest
from messages import refused
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh, grid_mesh, random_spectrum, sphere_mesh

from jaxsmw import InputError, Stage, compute_spectrum, match
from jaxsmw.benchmark.datasets import open_data_set
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.geometry import crease_eigenvectors
from jaxsmw.geometry.eigenbasis import eigenpairs
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import read_mesh
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import PRESETS

C = 9


def assert_same_span(first, second, areas):
    """Assert that two sets of orthonormal vectors (n, c) span the same space."""
    cosines = np.linalg.svd(first.T @ (areas[:, None] * second), compute_uv=False)
    np.testing.assert_allclose(cosines, 1, atol=1e-6)


@pytest.mark.parametrize("shape", ["flat", "sphere"])
def test_surfaces_of_constant_curvature_have_the_usual_eigenvectors(shape):
    """On a plane, normals are constant. On a sphere, they stretch all lengths by one factor."""
    mesh = make_mesh(*(grid_mesh(14, 20) if shape == "flat" else sphere_mesh(3)))
    _, usual, areas = eigenpairs(mesh, C)
    assert_same_span(crease_eigenvectors(mesh, C), usual, areas)


def test_mean_squares_are_one_and_the_first_is_constant():
    mesh = bumpy_mesh(3)
    found = crease_eigenvectors(mesh, C)
    np.testing.assert_allclose(found[:, 0], 1, atol=1e-6)
    # The mean squares are 1 in the metric with normals, whose areas differ from the areas on the surface.
    assert (np.abs(mesh.average(found**2) - 1) < 0.5).all()
    assert (found[np.argmax(np.abs(found), axis=0), range(C)] > 0).all()


def test_a_fold_separates_the_two_sides():
    """Across a sharp fold, the first crease eigenvector rises more steeply than the usual eigenvector."""
    vertices, faces = grid_mesh(21, 41)
    x = 2 * vertices[:, 0] - 1
    folded = np.stack([np.minimum(x, 0), vertices[:, 1], np.maximum(x, 0)], axis=1)
    mesh = make_mesh(folded, faces)
    usual = np.asarray(compute_spectrum(mesh, 3).eigenvectors[:, 1])
    crease = crease_eigenvectors(mesh, 3)[:, 1]

    def share_of_the_rise(values):
        middle = np.abs(x) < 0.075
        return np.ptp(values[middle]) / np.ptp(values)

    assert share_of_the_rise(crease) > 1.5 * share_of_the_rise(usual)


def test_motion_scale_reflection_and_numbering_do_not_matter():
    mesh = bumpy_mesh(3)
    found = crease_eigenvectors(mesh, C)
    turned = Rotation.random(random_state=1).apply(mesh.vertices) * 250 + [30, -4, 7]
    np.testing.assert_allclose(crease_eigenvectors(make_mesh(turned, mesh.faces), C), found, atol=1e-6)
    np.testing.assert_allclose(crease_eigenvectors(mesh.mirrored(), C), found, atol=1e-6)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    renumbered = make_mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    np.testing.assert_allclose(crease_eigenvectors(renumbered, C), found[order], atol=1e-6)


def test_defective_meshes_have_finite_crease_eigenvectors():
    vertices, faces = sphere_mesh(3)
    far = vertices[:42] * 0.1 + 5
    vertices = np.concatenate([vertices, far, [[0, 0, 9.0]]])  # the last vertex is unreferenced
    component = sphere_mesh(1)[1] + len(sphere_mesh(3)[0])
    fin = np.array([[faces[0, 0], faces[0, 1], faces[40, 2]]])  # its edge has three faces
    vertices[faces[7, 0]] = vertices[faces[7, 1]]  # degenerate faces
    mesh = make_mesh(vertices, np.concatenate([faces, component, fin]))
    found = crease_eigenvectors(mesh, C)
    assert np.isfinite(found).all() and not found[-1].any()


@pytest.mark.parametrize("number", [0, 10_000])
def test_impossible_numbers_are_refused(number):
    with pytest.raises(InputError, match="choose a number from 1 to"):
        crease_eigenvectors(bumpy_mesh(2), number)


def test_stages_refuse_a_negative_number():
    with refused("number_of_crease_eigenvectors", "-1", "at least 0"):
        Stage(FeatureRegression((5,)), number_of_crease_eigenvectors=-1)


@pytest.fixture
def creased():
    """Spectra of X and Y, a renumbered copy with other signs, with crease eigenvectors; and the true map."""
    generator = np.random.default_rng(3)
    n, k, c = 300, 8, 6
    x = random_spectrum(n, k).with_crease_eigenvectors(jnp.asarray(generator.normal(size=(n, c))))
    order = generator.permutation(n)
    signs = jnp.asarray(generator.choice([-1.0, 1.0], c))
    y = x.sample(jnp.asarray(order)).with_crease_eigenvectors(x.crease_eigenvectors[order] * signs[None])
    return x, y, np.argsort(order)


def test_crease_eigenvectors_are_features_of_the_regression(creased):
    """Noise hides the eigenvectors, so only crease eigenvectors find the matches. Their signs do not matter."""
    x, y, truth = creased
    generator = np.random.default_rng(5)
    start = jnp.asarray(
        np.where(generator.random(300) < 0.5, generator.integers(0, 300, 300), truth), jnp.int32
    )
    shares = []
    for with_creases in (True, False):
        sides = (
            (x, y) if with_creases else (x.with_crease_eigenvectors(None), y.with_crease_eigenvectors(None))
        )
        noisy = sides[1].eigenvectors + 3 * generator.normal(size=y.eigenvectors.shape)
        y_noisy = type(y)(
            y.eigenvalues, noisy, y.vertex_areas, y.mask, crease_eigenvectors=sides[1].crease_eigenvectors
        )
        found = refine(sides[0], y_noisy, start, refiner=FeatureRegression(), iterations=4)
        shares.append(np.mean(np.asarray(found.pointwise_map) == truth))
    assert shares[0] > 0.95 and shares[1] < 0.5


def test_shapes_need_equally_many(creased):
    x, y, truth = creased
    with pytest.raises(ValueError, match="X has 6 crease eigenvectors and Y has 4"):
        refine(
            x,
            y.with_crease_eigenvectors(y.crease_eigenvectors[:, :4]),
            jnp.asarray(truth, jnp.int32),
            refiner=FeatureRegression(),
            iterations=1,
        )
    with pytest.raises(ValueError, match="crease eigenvectors have shape"):
        x.with_crease_eigenvectors(jnp.zeros((4, 4)))


def test_a_stage_uses_crease_eigenvectors_only_if_both_shapes_have_them(creased):
    x, y, _ = creased
    stage = Stage(FeatureRegression((5, 8)), number_of_crease_eigenvectors=4)
    seen = SpectralPair(x, y).seen_by(stage)
    assert [side.crease_eigenvectors.shape[1] for side in seen.both] == [4, 4]
    lacking = SpectralPair(x, y.with_crease_eigenvectors(None)).seen_by(stage).both
    assert [side.crease_eigenvectors for side in lacking] == [None, None]
    assert SpectralPair(x, y).seen_by(Stage(FeatureRegression((5, 8)))).x.crease_eigenvectors is None
    assert stage.fitted(6).number_of_crease_eigenvectors == 3
    padded = x.pad(320)
    assert padded.crease_eigenvectors.shape == (320, 6) and not padded.crease_eigenvectors[300:].any()


def test_the_preset_uses_crease_eigenvectors_on_small_meshes_only():
    accurate = PRESETS["accurate"]
    assert accurate.fitted(5000).sizes.number_of_crease_eigenvectors == 25
    assert accurate.fitted(15_000).sizes.number_of_crease_eigenvectors == 0


@pytest.mark.slow
def test_match_computes_them_for_its_stages():
    mesh = bumpy_mesh(3)
    with_creases, without = (
        match(
            mesh,
            mesh,
            preset=Stage(FeatureRegression((5, 8)), number_of_descriptors=5, number_of_crease_eigenvectors=c),
        )
        for c in (6, 0)
    )
    assert with_creases.spectrum_x.crease_eigenvectors.shape == (len(mesh.vertices), 6)
    assert without.spectrum_x.crease_eigenvectors is None
    assert "crease eigenvectors" in with_creases.seconds and "crease eigenvectors" not in without.seconds


def test_poses_of_one_person_have_related_crease_eigenvectors(shared):
    """Along the true map, a linear map predicts most of the crease eigenvectors from those of another pose."""
    data_set = open_data_set(shared / "data" / "faust_r")
    pair = next(pair for pair in data_set.pairs if pair.names == ("tr_reg_000", "tr_reg_004"))
    x, y = (read_mesh(file) for file in pair.meshes)
    truth = pair.ground_truth(x, y)
    of_x, of_y = crease_eigenvectors(x, 25)[truth.source_vertices], crease_eigenvectors(y, 25)[truth.targets]
    residual = of_x - of_y @ np.linalg.lstsq(of_y, of_x, rcond=None)[0]
    explained = 1 - residual.var(axis=0)[1:] / of_x.var(axis=0)[1:]
    assert explained[:10].min() > 0.8 and explained.mean() > 0.6
