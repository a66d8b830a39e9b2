"""Strips of slivers, as scanners and decimation leave them, do not end a refinement on samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from synthetic import sphere_mesh

from jaxsmw.core.functional_map import dual_eigenvectors
from jaxsmw.core.linear_algebra import is_regular, product, regularized
from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.sampling import farthest_point_samples

AXES = [1.0, 1.3, 2.1]
K = 30


def body(strips):
    """An ellipsoid, with strips of triangles along its surface that hang on one vertex each."""
    vertices, faces = sphere_mesh(3)
    generator, number = np.random.default_rng(0), len(vertices)
    vertices, faces = [vertices], [faces]
    for start in generator.choice(number, strips, replace=False):
        along = np.cross(vertices[0][start], generator.normal(size=3))
        along /= np.linalg.norm(along)
        angles = np.linspace(0.05, 0.4, 8)[:, None]
        middle = (1 + 1e-5) * (np.cos(angles) * vertices[0][start] + np.sin(angles) * along)
        beside = 1e-5 * np.cross(vertices[0][start], along)
        left = number + np.arange(7)
        right = left + 8
        vertices += [middle + beside, middle - beside]
        faces += [[[start, number, number + 8]]]
        faces += [np.stack(corners, 1) for corners in ([left, left + 1, right], [left + 1, right + 1, right])]
        number += 16
    return make_mesh(np.concatenate(vertices) * AXES, np.concatenate(faces))


def sampled(mesh):
    """The spectrum in float32, and the samples."""
    spectrum = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf,
        compute_spectrum(mesh, K),
    )
    return spectrum, jnp.asarray(farthest_point_samples(mesh, 120))


@pytest.fixture(scope="module")
def clean():
    return body(0)


@pytest.fixture(scope="module")
def scan():
    return body(12)


def gram(spectrum, samples):
    eigenvectors = spectrum.eigenvectors[samples]
    return product(eigenvectors.T, eigenvectors)


def test_regular_gram_matrices_are_not_changed(clean):
    regular = gram(*sampled(clean))
    assert is_regular(regular)
    np.testing.assert_array_equal(regularized(regular), regular)


def test_vectors_that_vanish_at_all_samples_have_small_dual_vectors(scan):
    """The dual vectors are no longer than the vectors, as in the inner product of the surface."""
    spectrum, samples = sampled(scan)
    assert not is_regular(gram(spectrum, samples))
    at_samples = spectrum.sample(samples)
    dual = dual_eigenvectors(at_samples, "least_squares")
    lengths = jnp.sum(dual**2, axis=0) / jnp.sum(at_samples.vertex_areas)
    assert jnp.all(lengths <= 1.001 / len(samples)) and jnp.max(lengths) > 0.5 / len(samples)


@pytest.mark.slow
@pytest.mark.parametrize("refiner", first_always([Registration((10, 20, K)), WaveletPreservation()]))
def test_scans_with_slivers_are_matched(clean, scan, refiner):
    (x, samples_x), (y, samples_y) = sampled(clean), sampled(scan)
    number = len(clean.vertices)
    truth = jnp.arange(number)
    back = jnp.concatenate([truth, jnp.zeros(len(scan.vertices) - number, truth.dtype)])
    into = refine(x, y, truth, refiner=refiner, samples=(samples_x, samples_y))
    out_of = refine(y, x, back, refiner=refiner, samples=(samples_y, samples_x))
    for refined, target in ((into, scan), (out_of, clean)):
        assert refined.result == RESULTS.successful
        matches = target.vertices[np.asarray(refined.pointwise_map[:number])]
        errors = np.linalg.norm(matches - clean.vertices, axis=1) / np.sqrt(clean.area)
        assert errors.mean() < (0.01 if isinstance(refiner, Registration) else 0.1)
