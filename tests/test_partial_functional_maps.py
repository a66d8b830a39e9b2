"""The energies of partial functional maps agree with NumPy, and the method matches a cut shape."""

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import grid_mesh, random_spectrum

import jaxsmw
from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.benchmark.opponents import partial_functional_maps as steps
from jaxsmw.benchmark.opponents.base import MethodInput
from jaxsmw.benchmark.opponents.partial_functional_maps import (
    PartialMap,
    SurfaceGradient,
    partial_functional_map,
)
from jaxsmw.benchmark.opponents.registry import METHODS, suited_methods
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.creature import creature
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import describe, paired_spectra
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.runtime.compilation import compiled

pytestmark = pytest.mark.study

K, D = 40, 8


class Case:
    """A full shape Y, the part X of Y above a plane with permuted vertices, and a noisy initial map."""

    def __init__(self) -> None:
        generator = np.random.default_rng(0)
        self.full = creature("quadruped", vertices=1200, pose="stand", seed=3)
        centers = self.full.vertices[self.full.faces].mean(axis=1)
        kept = self.full.faces[centers[:, 2] > np.quantile(centers[:, 2], 0.4)]
        self.truth = generator.permutation(np.unique(kept))
        number = np.full(len(self.full.vertices), -1)
        number[self.truth] = np.arange(len(self.truth))
        self.partial: Mesh = make_mesh(self.full.vertices[self.truth], number[kept])
        pair = Pair(self.partial, self.full, True)
        self.x, self.y = describe(pair, *paired_spectra(pair, K), D)
        self.covered = np.isin(np.arange(len(self.full.vertices)), self.truth)
        wrong = generator.random(len(self.truth)) < 0.3
        self.initial_map = np.where(
            wrong, generator.integers(0, len(self.full.vertices), len(wrong)), self.truth
        )

    def matched(self, x: Spectrum, y: Spectrum, initial_map: np.ndarray, iterations: int = 2) -> PartialMap:
        gradient = SurfaceGradient.of(self.full, y)
        return compiled(partial_functional_map)(
            x, y, gradient, jnp.asarray(initial_map), iterations=iterations
        )


@pytest.fixture(scope="module")
def case() -> Case:
    return Case()


@pytest.fixture(scope="module")
def found(case) -> PartialMap:
    return case.matched(case.x, case.y, case.initial_map)


def test_fidelity_and_map_energy_are_those_of_the_paper():
    generator = np.random.default_rng(0)
    c, a, b = (generator.normal(size=shape) for shape in ((5, 8), (5, 4), (8, 4)))
    weights = generator.random((5, 8))
    norms = np.linalg.norm(c.T @ a - b, axis=0)
    expected = norms[:-1].mean() + norms[-1]
    assert steps.fidelity(*map(jnp.asarray, (c, a, b))) == pytest.approx(expected, rel=1e-2)
    gram = c @ c.T
    off = gram - np.diag(np.diag(gram))
    expected = np.sum((c * weights) ** 2) + 100 * np.sum(off**2) + np.sum((np.diag(gram) - 1) ** 2)
    assert steps.map_energy(jnp.asarray(c), jnp.asarray(weights)) == pytest.approx(expected)
    rotation, _ = np.linalg.qr(generator.normal(size=(8, 5)))
    assert steps.map_energy(jnp.asarray(rotation.T), jnp.zeros((5, 8))) == pytest.approx(0, abs=1e-12)


def test_weights_are_distances_from_a_slanted_diagonal():
    k_x, k_y = 4, 10
    weights = np.asarray(steps.slanted_weights(k_x, k_y))
    # The paper's matrix of weights is the transpose of `weights`.
    normal = np.array([1, k_x / k_y, 0]) / np.hypot(1, k_x / k_y)
    for row in range(k_x):
        for column in range(k_y):
            distance = np.linalg.norm(np.cross(normal, [column, row, 0]))
            fading = np.exp(-0.03 * np.hypot(column + 1, row + 1))
            assert weights[row, column] == pytest.approx(fading * distance, abs=1e-12)
    assert weights[0, 0] == 0 and weights[2, 5] == pytest.approx(0, abs=1e-12)


def flat() -> tuple[Mesh, Spectrum]:
    """Returns a square of side 3, and the spectrum of a square of side 1 with two padded vertices."""
    vertices, faces = grid_mesh(9, 9)
    mesh = make_mesh(3 * vertices, faces)
    return mesh, jaxsmw.compute_spectrum(mesh, 5).pad(len(vertices) + 2)


def test_total_variation_of_a_linear_function_is_its_slope_times_the_area():
    mesh, spectrum = flat()
    gradient = SurfaceGradient.of(mesh, spectrum)
    assert float(gradient.areas.sum()) == pytest.approx(1)
    function = np.pad(mesh.vertices / 3 @ [3.0, 4.0, 0.0], (0, 2), constant_values=99)
    assert gradient.total_variation(jnp.asarray(function)) == pytest.approx(5, rel=1e-3)
    assert gradient.total_variation(jnp.ones(len(function))) == pytest.approx(0, abs=1e-9)
    with pytest.raises(InputError, match="but its spectrum"):
        SurfaceGradient.of(mesh, random_spectrum(20, 5))


def test_derivatives_agree_with_finite_differences():
    mesh, spectrum = flat()
    gradient, generator = SurfaceGradient.of(mesh, spectrum), np.random.default_rng(0)
    n = spectrum.mask.shape[0]

    def energy(v):
        return steps.region_energy(v, jnp.asarray(0.3), spectrum, gradient)

    area = np.sum(np.asarray(spectrum.vertex_areas) * (np.tanh(6 * (0.7 - 0.5)) + 1) / 2)
    assert energy(jnp.full(n, 0.7)) == pytest.approx(steps.REGION_WEIGHTS[0] * (0.3 - area) ** 2)
    v, along = (jnp.asarray(generator.random(n)) for _ in range(2))
    slope = (energy(v + 1e-6 * along) - energy(v - 1e-6 * along)) / 2e-6
    assert jnp.vdot(jax.grad(energy)(v), along) == pytest.approx(float(slope), rel=1e-5)
    # Where the gradient of the function vanishes, the derivative of its norm must be zero, not NaN.
    assert (jax.grad(gradient.total_variation)(jnp.ones(n)) == 0).all()


def test_the_covered_region_and_the_map_are_recovered(case, found):
    assert found.result == RESULTS.successful
    areas, region = np.asarray(case.y.vertex_areas), np.asarray(found.region)
    union = areas @ np.maximum(region, case.covered)
    assert areas @ np.minimum(region, case.covered) > 0.85 * union
    assert areas @ region == pytest.approx(float(case.x.vertex_areas.sum()), abs=0.03)
    gram = np.asarray(found.functional_map @ found.functional_map.T)
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-9)

    def distance(pointwise_map) -> np.ndarray:
        difference = case.full.vertices[np.asarray(pointwise_map)] - case.full.vertices[case.truth]
        return np.linalg.norm(difference, axis=1) / np.sqrt(case.full.area)

    assert distance(found.pointwise_map).mean() < 0.03 < 0.1 < distance(case.initial_map).mean()


def test_padding_does_not_matter(case, monkeypatch):
    m, n = len(case.truth), len(case.full.vertices)
    # More steps towards a minimum amplify rounding errors.
    monkeypatch.setattr(steps, "_MAP_STEPS", 10)
    monkeypatch.setattr(steps, "_REGION_STEPS", 10)
    jax.clear_caches()
    plain = case.matched(case.x, case.y, case.initial_map, iterations=1)
    padded = case.matched(
        case.x.pad(m + 9), case.y.pad(n + 5), np.pad(case.initial_map, (0, 9)), iterations=1
    )
    assert np.mean(np.asarray(padded.pointwise_map[:m] == plain.pointwise_map)) > 0.99
    np.testing.assert_allclose(padded.functional_map, plain.functional_map, atol=1e-6)
    np.testing.assert_allclose(padded.region[:n], plain.region, atol=1e-6)
    assert not padded.region[n:].any()


def test_signs_do_not_matter(case):
    generator = np.random.default_rng(0)
    flipped = [
        eqx.tree_at(
            lambda s: s.eigenvectors,
            spectrum,
            spectrum.eigenvectors * generator.choice([-1.0, 1.0], (1, spectrum.eigenvectors.shape[1])),
        )
        for spectrum in (case.x, case.y)
    ]
    plain, again = (
        case.matched(*spectra, case.initial_map, iterations=1) for spectra in ((case.x, case.y), flipped)
    )
    assert np.mean(np.asarray(again.pointwise_map == plain.pointwise_map)) > 0.99
    np.testing.assert_allclose(again.region, plain.region, atol=1e-3)


def test_nonfinite_numbers_and_invalid_maps_are_reported(case):
    broken = case.x.with_descriptors(case.x.descriptors.at[3, 2].set(jnp.nan))
    bad_map = np.full_like(case.initial_map, len(case.full.vertices))
    for arguments, expected in [
        ((broken, case.y, case.initial_map), RESULTS.nonfinite_spectrum),
        ((case.x, case.y, bad_map), RESULTS.invalid_initial_map),
        (
            (case.x.with_descriptors(case.x.descriptors * 1e200), case.y, case.initial_map),
            RESULTS.nonfinite_functional_map,
        ),
    ]:
        bad = case.matched(*arguments)
        assert bad.result == expected
        assert (np.asarray(bad.pointwise_map) == -1).all()


def test_arguments_that_do_not_fit_are_refused(case):
    for x, y, options, message in [
        (case.x, case.y, {"iterations": 0}, "at least 1 iteration"),
        (case.x.with_descriptors(None), case.y, {}, "number of descriptors"),
        (case.x, case.y.with_descriptors(case.y.descriptors[:, :3]), {}, "number of descriptors"),
    ]:
        with pytest.raises(ValueError, match=message):
            partial_functional_map(
                x, y, SurfaceGradient.of(case.full, y), jnp.asarray(case.initial_map), **options
            )


def test_the_partial_shape_may_have_more_eigenvectors(case):
    found = case.matched(case.x, case.y.truncate(10), case.initial_map, iterations=1)
    assert case.x.eigenvalues.shape > (10,) and found.functional_map.shape == (10, 10)
    expected = case.matched(case.x.truncate(10), case.y.truncate(10), case.initial_map, iterations=1)
    np.testing.assert_array_equal(found.pointwise_map, expected.pointwise_map)


def test_the_method_is_for_partial_shapes_only():
    partial, full = (DataPair("x", "y", Path("x.off"), Path("y.off"), partial=kind) for kind in (True, False))
    METHODS["pfm"].check([partial])
    with pytest.raises(InputError, match="matches partial shapes only"):
        METHODS["pfm"].check([partial, full])
    assert "pfm" in suited_methods([partial])
    assert "pfm" not in suited_methods([full]) and "pfm" not in suited_methods([partial, full])


def test_the_method_uses_the_prepared_pair(case):
    x, y = (
        case.x.with_descriptors(case.x.descriptors[:, :4]),
        case.y.with_descriptors(case.y.descriptors[:, :4]),
    )
    samples = jnp.arange(50), jnp.arange(50)
    meshes = case.partial, case.full
    spectra = SpectralPair(case.x, case.y, samples, partial=True, common_limit=True)
    pair = MethodInput(spectra, jnp.asarray(case.initial_map), meshes)
    method = replace(METHODS["pfm"], number_of_eigenvectors=K, number_of_descriptors=4, iterations=1)
    mapped = method(pair)
    expected = case.matched(x, y, case.initial_map, iterations=1)
    np.testing.assert_array_equal(mapped, expected.pointwise_map)
