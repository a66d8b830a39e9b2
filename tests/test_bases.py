"""Wavelet filtering on several bases at once: the bases, their joined functional maps, and stages with them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from messages import refused
from synthetic import bumpy_mesh, random_spectrum

from jaxsmw import InputError, Stage, WaveletPreservation, compute_spectrum, match
from jaxsmw.banks import Gabor
from jaxsmw.benchmark import compare
from jaxsmw.core.functional_map import dual_eigenvectors
from jaxsmw.core.refinement import refine, refine_at_once
from jaxsmw.core.refiner import Problem
from jaxsmw.core.soft_refinement import refine_softly
from jaxsmw.core.solutions.closed_form import LeastSquares
from jaxsmw.core.spectrum import Basis
from jaxsmw.geometry import add_bases, crease_eigenvectors
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.shape import PreparedShape, prepare_shapes
from jaxsmw.matching.spectral_pair import common_range
from jaxsmw.matching.stages import Sizes
from jaxsmw.runtime.batches import refine_pairs

N, K = 300, 12
JOINED = WaveletPreservation(bases=("laplacian", "other"))


def with_other(spectrum, seed):
    """Return a spectrum with a basis `"other"` of orthonormal random functions."""
    areas = np.asarray(spectrum.vertex_areas, np.float64)
    values = np.random.default_rng(seed).normal(size=(len(areas), K)) * (areas > 0)[:, None]
    columns = np.linalg.qr(np.sqrt(areas)[:, None] * values)[0]
    functions = np.divide(columns, np.sqrt(areas)[:, None], where=areas[:, None] > 0, out=0 * columns)
    dtype = spectrum.eigenvectors.dtype
    eigenvalues = jnp.asarray(np.linspace(0, 9, K) ** 2, dtype)
    return spectrum.with_bases((Basis("other", eigenvalues, jnp.asarray(functions, dtype)),))


@pytest.fixture(scope="module")
def pair():
    """Spectra of X and of Y, a renumbered copy, with a further basis; and a map that is partly wrong."""
    generator = np.random.default_rng(0)
    x = with_other(random_spectrum(N, K), 1)
    order = generator.permutation(N)
    y = x.sample(jnp.asarray(order))
    y = dataclasses.replace(y, vertex_areas=x.vertex_areas[order])
    truth = np.argsort(order)
    wrong = generator.random(N) < 0.3
    return x, y, jnp.asarray(np.where(wrong, generator.integers(0, N, N), truth)), truth


def with_signs(spectrum, seed):
    """Return a spectrum in which some eigenvectors of each basis have the opposite sign."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(2, K)).astype(spectrum.eigenvectors.dtype)
    (basis,) = spectrum.bases
    return dataclasses.replace(
        spectrum,
        eigenvectors=spectrum.eigenvectors * signs[:1],
        bases=(dataclasses.replace(basis, eigenvectors=basis.eigenvectors * signs[1:]),),
    )


def test_one_basis_is_refined_as_without_bases(pair):
    x, y, initial_map, _ = pair
    usual = refine(x.with_bases(()), y.with_bases(()), initial_map)
    ignoring = refine(x, y, initial_map, refiner=WaveletPreservation(bases=("laplacian",)))
    np.testing.assert_array_equal(usual.pointwise_map, ignoring.pointwise_map)
    np.testing.assert_array_equal(usual.functional_map, ignoring.functional_map)


@pytest.mark.parametrize("solution", [WaveletPreservation().solution, LeastSquares()])
@pytest.mark.parametrize("sampled", [False, True])
def test_the_functional_map_has_one_block_for_each_basis(pair, solution, sampled):
    """Each block is the functional map that the refiner computes in this basis alone."""
    x, y, initial_map, _ = pair
    samples = (jnp.arange(0, N, 3), jnp.arange(0, N, 3)) if sampled else None
    maps = {}
    for bases in (("laplacian", "other"), ("laplacian",), ("other",)):
        refiner = WaveletPreservation(Gabor(), solution, bases=bases)
        prepared = refiner.prepare(Problem(x, y, samples))
        matches = jnp.arange(100) if sampled else initial_map
        maps[bases] = np.asarray(refiner.update(prepared, matches, None)[0].functional_map)
    joined = maps["laplacian", "other"]
    blocks = np.zeros((2 * K, 2 * K))
    blocks[:K, :K], blocks[K:, K:] = maps["laplacian",], maps["other",]
    np.testing.assert_allclose(joined, blocks, atol=1e-5 * np.abs(blocks).max())
    assert not joined[:K, K:].any() and not joined[K:, :K].any()


def test_bases_are_inverted_one_by_one(pair):
    """Functions of different bases can be nearly equal, so they have no common pseudo-inverse."""
    x, *_ = pair
    twice = x.with_bases((Basis("other", x.eigenvalues, x.eigenvectors),)).joined(("laplacian", "other"))
    for form in ("area", "least_squares"):
        dual = np.asarray(dual_eigenvectors(twice, form))
        np.testing.assert_allclose(dual[:, :K], dual_eigenvectors(x, form), atol=1e-6)
        np.testing.assert_array_equal(dual[:, :K], dual[:, K:])


def test_a_second_basis_adds_what_the_first_lacks(pair):
    """Noise hides the eigenvectors of Y, so only the other basis can find the matches."""
    x, y, initial_map, truth = pair
    noise = jnp.asarray(np.random.default_rng(5).normal(size=(N, K)), y.eigenvectors.dtype)
    noisy = dataclasses.replace(y, eigenvectors=noise)
    correct = [
        np.mean(np.asarray(refine(x, noisy, initial_map, refiner=refiner).pointwise_map) == truth)
        for refiner in (WaveletPreservation(), JOINED)
    ]
    assert correct[0] < 0.1 < 0.8 < correct[1]


def test_signs_and_padding_have_no_effect(pair):
    x, y, initial_map, _ = pair
    expected = refine(x, y, initial_map, refiner=JOINED).pointwise_map
    turned = refine(with_signs(x, 2), with_signs(y, 3), initial_map, refiner=JOINED).pointwise_map
    np.testing.assert_array_equal(turned, expected)
    padded_map = jnp.pad(initial_map, (0, 20))
    padded = refine(x.pad(N + 20), y.pad(N + 33), padded_map, refiner=JOINED)
    np.testing.assert_array_equal(padded.pointwise_map[:N], expected)


def test_scale_has_no_effect_and_truncation_cuts_each_basis(pair):
    x, y, initial_map, _ = pair
    expected = refine(x, y, initial_map, refiner=JOINED).pointwise_map
    scaled = refine(x.scale(4.0), y.scale(4.0), initial_map, refiner=JOINED).pointwise_map
    np.testing.assert_array_equal(scaled, expected)
    cut = x.truncate(5)
    assert cut.eigenvectors.shape == cut.bases[0].eigenvectors.shape == (N, 5)
    (other,) = y.bases
    lower = y.with_bases((dataclasses.replace(other, eigenvalues=other.eigenvalues * 1.5),))
    x_cut, y_cut = common_range(x, lower)
    assert x_cut.bases[0].eigenvalues.shape[0] == K > y_cut.bases[0].eigenvalues.shape[0]


def test_batches_and_both_namespaces_refine_alike(pair):
    x, y, initial_map, _ = pair
    expected = np.asarray(refine(x, y, initial_map, refiner=JOINED).pointwise_map)
    on_host = jax.tree.map(np.asarray, (x, y, initial_map))
    assert np.mean(refine_at_once(*on_host, refiner=JOINED).pointwise_map == expected) > 0.99
    maps = [np.asarray(initial_map)] * 2
    for _, refinement in refine_pairs([x, y], [(0, 1), (0, 1)], maps, refiner=JOINED):
        np.testing.assert_array_equal(refinement.unpadded(N).pointwise_map, expected)


def test_soft_refinement_and_derivatives_use_all_bases(pair):
    x, y, initial_map, _ = pair

    def size(functions):
        basis = dataclasses.replace(x.bases[0], eigenvectors=functions)
        soft = refine_softly(x.with_bases((basis,)), y, initial_map, refiner=JOINED, iterations=1)
        return jnp.sum(soft.functional_map**2)

    gradient = jax.grad(size)(x.bases[0].eigenvectors)
    assert jnp.isfinite(gradient).all() and jnp.abs(gradient).max() > 0


def test_refused_bases(pair):
    x, y, initial_map, _ = pair
    for bases in ((), ("crease", "crease")):
        with refused("bases", "tuple of different names"):
            WaveletPreservation(bases=bases)
    with pytest.raises(InputError, match="no basis 'crease'"):
        refine(x, y, initial_map, refiner=WaveletPreservation(bases=("crease",)))
    with pytest.raises(ValueError, match="one row for each vertex"):
        x.with_bases((Basis("other", x.eigenvalues, x.eigenvectors[:7]),))
    with refused("'waves' is not a basis", "crease"):
        add_bases(bumpy_mesh(2), compute_spectrum(bumpy_mesh(2), 5), ["waves"])


def test_the_crease_basis_is_orthonormal_and_spans_crease_eigenvectors():
    mesh = bumpy_mesh(3)
    spectrum = add_bases(mesh, compute_spectrum(mesh, K), ["crease"])
    (basis,) = spectrum.bases
    functions, areas = np.asarray(basis.eigenvectors, float), np.asarray(spectrum.vertex_areas, float)
    np.testing.assert_allclose(functions.T @ (areas[:, None] * functions), np.eye(K), atol=1e-5)
    crease = crease_eigenvectors(mesh, K)
    coefficients = functions.T @ (areas[:, None] * crease)
    np.testing.assert_allclose(functions @ coefficients, crease, atol=1e-4)
    # The first functions of a basis do not depend on how many there are.
    assert np.abs(np.tril(coefficients, -1)).max() < 1e-4
    eigenvalues = np.asarray(basis.eigenvalues)
    assert eigenvalues[0] == 0 and (np.diff(eigenvalues) >= 0).all()


@pytest.mark.filterwarnings("ignore:mesh to mesh")
def test_stages_presets_and_comparisons_compute_the_bases_that_they_need():
    meshes = bumpy_mesh(3), bumpy_mesh(number=600)
    stage = Stage(WaveletPreservation(bases=("laplacian", "crease")), number_of_eigenvectors=K)
    correspondence = match(*meshes, preset=stage)
    assert correspondence.functional_map.shape == (2 * K, 2 * K)
    assert correspondence.spectrum_x.eigenvectors.shape[1] == K
    assert correspondence.surface_points().faces.shape == (len(meshes[0].vertices),)
    usual = match(*meshes, preset=Stage(number_of_eigenvectors=K))
    assert usual.spectrum_x.bases == () and (usual.pointwise_map != correspondence.pointwise_map).any()
    truth = correspondence.pointwise_map
    methods = {"usual": Stage(number_of_eigenvectors=K), "joined": stage}
    measured = compare(methods, [(*meshes, truth)], quiet=True)
    assert measured.errors("joined") == 0 < measured.errors("usual")


def test_prepared_shapes_keep_their_bases_in_files():
    (shape,) = prepare_shapes([bumpy_mesh(2)], Sizes(5, bases=("crease",)))
    again = PreparedShape.from_arrays(shape.arrays(), "again")
    assert again.spectrum.bases == shape.spectrum.bases and again.spectrum.bases[0].name == "crease"


def test_partial_pairs_cut_each_basis_at_its_own_limit():
    part, whole = bumpy_mesh(2), bumpy_mesh(3)
    prepared = prepare(Pair(part, whole, partial=True), Sizes(K, bases=("crease",)))
    for spectrum in prepared.spectra.both:
        assert [basis.name for basis in spectrum.bases] == ["crease"]
