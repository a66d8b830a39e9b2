import inspect
import logging
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from messages import refused
from sampled_cases import first_always
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from synthetic import bumpy_mesh, mean_error
from threadpoolctl import threadpool_info, threadpool_limits

from jaxsmw.core.banks import FilterBank, Meyer
from jaxsmw.core.functional_map import encode, multiscale_kernel
from jaxsmw.core.refiner import State
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.solutions.closed_form import LeastSquares
from jaxsmw.creature import creature_pair
from jaxsmw.errors import InputError
from jaxsmw.geometry import eigenbasis
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching import descriptors, shape
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.match import match, match_prepared
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import describe, paired_spectra
from jaxsmw.matching.stages import PRESETS, Preset, Stage, choose_preset
from jaxsmw.matching.starts import INITIAL_MAPS, METHODS, initial_map
from jaxsmw.runtime import threads as threads_module

STAGE = Stage(WaveletPreservation(bank=Meyer(4)), number_of_eigenvectors=30)
OPTIONS = {"preset": STAGE, "mirror": "no"}


@pytest.fixture(scope="module")
def pair():
    """A bumpy body, a rotated, scaled, renumbered and slightly noisy copy, and the true map."""
    mesh_x = bumpy_mesh(number=1100)
    generator = np.random.default_rng(1)
    order = generator.permutation(len(mesh_x.vertices))
    turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    vertices = 7 * (mesh_x.vertices + 0.001 * generator.normal(size=mesh_x.vertices.shape)) @ turn.T
    mesh_y = make_mesh(vertices[order], np.argsort(order)[mesh_x.faces], name="copy")
    return mesh_x, mesh_y, np.argsort(order)


@pytest.fixture(scope="module")
def usual(pair):
    """The result of `OPTIONS`, with its history."""
    return match(*pair[:2], **OPTIONS, history=True)


@pytest.fixture(scope="module")
def accurate(pair):
    """The result of the default preset."""
    return match(*pair[:2], mirror="no")


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"init": "shout"}, "'shout' is not an initial map"),
        ({"init": np.array([[0, 10**6]])}, "landmark 1000000 is not a vertex"),
        ({"init": np.zeros(3, int)}, "the initial map has 3 entries"),
        ({"partial": True}, "units of length probably differ"),
    ],
)
def test_invalid_arguments_are_refused_before_eigenbases_are_computed(pair, options, fault, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("eigenpairs were computed")

    monkeypatch.setattr("jaxsmw.matching.shape.eigenpairs", refuse)
    mesh_x, mesh_y, _ = pair
    if options == {"partial": True}:
        mesh_y = make_mesh(1000 * mesh_y.vertices, mesh_y.faces)
    with pytest.raises(InputError, match=fault):
        match(mesh_x, mesh_y, **options)


def test_matches_a_noisy_copy(pair):
    mesh_x, mesh_y, truth = pair
    result = match(mesh_x, mesh_y, **OPTIONS, init="shot")
    before = mean_error(mesh_y, result.initial_map, truth)
    after = mean_error(mesh_y, result.pointwise_map, truth)
    assert after < 0.02 < before
    assert result.pointwise_map.dtype == np.int64 and result.pointwise_map.shape == (len(mesh_x.vertices),)
    assert result.functional_map.shape == (30, 30)
    assert result.iterations == 3
    assert list(result.seconds) == ["eigenbases", "initial map", "refinement"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "init", first_always(["shot", "wks", "functional", [[0, 0], [400, 400], [900, 900]]])
)
def test_initial_maps_of_large_meshes_use_samples(pair, init, monkeypatch):
    """Descriptors at a part of the vertices suffice for the right map."""
    mesh_x, mesh_y, truth = pair
    if not isinstance(init, str):
        init = np.array([[i, truth[i]] for i, _ in init])
    spectra = paired_spectra(Pair(mesh_x, mesh_y), 30)
    monkeypatch.setattr(shape, "_COMPARED", 800)
    monkeypatch.setattr(shape, "_COMPARED_FROM", 700)
    start = initial_map(Pair(mesh_x, mesh_y), *spectra, init=init)
    compared = np.unique(start)
    assert 100 < len(compared) < 1000
    if not isinstance(init, str):
        np.testing.assert_array_equal(start[init[:, 0]], init[:, 1])
    result = match(mesh_x, mesh_y, init=init, **OPTIONS)
    assert mean_error(mesh_y, result.pointwise_map, truth) < 0.02


def test_both_shapes_use_the_same_eigensolver(pair, monkeypatch):
    """Only one of the meshes has enough vertices for the approximate eigensolver."""
    mesh_x = pair[0]
    monkeypatch.setattr(eigenbasis, "APPROXIMATE_FROM", 1000)
    smaller = bumpy_mesh(3)
    spectrum_x, spectrum_y = paired_spectra(Pair(mesh_x, smaller), 10)
    for mesh, spectrum in ((mesh_x, spectrum_x), (smaller, spectrum_y)):
        wanted = compute_spectrum(mesh, 10, eigensolver="approximate").eigenvalues
        np.testing.assert_array_equal(spectrum.eigenvalues, wanted)


def test_the_approximate_eigenbasis_is_nearly_as_accurate(pair):
    mesh_x, mesh_y, truth = pair
    exact, approximate = (
        match(mesh_x, mesh_y, eigensolver=solver, **OPTIONS) for solver in ("exact", "approximate")
    )
    assert (exact.spectrum_x.eigenvalues[1:] < approximate.spectrum_x.eigenvalues[1:]).all()
    errors = [mean_error(mesh_y, found.pointwise_map, truth) for found in (exact, approximate)]
    # Without noise, all vertices of the copy would be matched exactly.
    assert errors[1] < errors[0] + 0.003


@pytest.mark.usefixtures("no_programs")
def test_both_backends_give_the_same_map(pair, accurate, compilations):
    """The backend with JAX compiles one program for each stage, and none twice."""
    mesh_x, mesh_y, truth = pair
    by_jax = match(mesh_x, mesh_y, preset="accurate", mirror="no", backend="jax")
    assert compilations.count("jit(refine)") == len(by_jax.preset.stages) == 4
    assert [found.backend for found in (accurate, by_jax)] == ["numpy", "jax"]
    assert (accurate.pointwise_map == by_jax.pointwise_map).mean() > 0.99
    errors = [mean_error(mesh_y, found.pointwise_map, truth) for found in (accurate, by_jax)]
    assert errors[0] == pytest.approx(errors[1], abs=1e-4)


def test_results_are_reproducible_bit_for_bit(pair, usual):
    again = match(*pair[:2], **OPTIONS, history=True)
    np.testing.assert_array_equal(again.pointwise_map, usual.pointwise_map)
    np.testing.assert_array_equal(again.functional_map, usual.functional_map)


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("preset", "programs"),
    [
        ("fast", 1),
        # The last two stages for large meshes differ only in their levels, and share a program.
        (PRESETS["accurate"].large.stages, 3),
        (replace(STAGE, stop_when_unchanged=True), 1),
    ],
    ids=["fast", "large", "stopped"],
)
@pytest.mark.usefixtures("no_programs")
def test_no_program_of_a_stage_is_compiled_twice(pair, preset, programs, compilations):
    match(*pair[:2], preset=preset, init="shot", mirror="no", backend="jax")
    assert compilations.count("jit(refine)") == programs


@pytest.mark.sampled
@pytest.mark.usefixtures("no_programs")
def test_coarse_passes_share_one_program(pair, compilations):
    """The levels are an argument of the program, so only their number and the largest level matter."""
    accurate = PRESETS["accurate"]
    always = replace(accurate, search=replace(accurate.search, non_isometric=0.0, coarse_from=0.0))
    found = match(*pair[:2], preset=always, init="shot", mirror="no", backend="jax")
    assert len(accurate.search.coarse_levels) == 2
    assert compilations.count("jit(refine)") == len(found.preset.stages) + 1


@pytest.mark.sampled
def test_the_reverse_map_of_registration_compares_all_columns():
    creature = creature_pair(vertices=3100)
    truth = creature.truth.nearest_corners(creature.target)
    refiner = Registration((20, 30))
    stage = Stage(refiner, number_of_eigenvectors=30, number_of_samples=400)
    found = match(creature.source, creature.target, preset=stage, init=truth, mirror="no")
    queries, database = (np.asarray(points) for points in found._embeddings())
    assert database.shape[1] > found.functional_map.shape[0]
    with found._precision():
        reverse = found._last.reverse_map()
    _, nearest = KDTree(queries[found.mesh_x.referenced_vertices]).query(database)
    expected = np.flatnonzero(found.mesh_x.referenced_vertices)[nearest]
    agree = reverse == expected
    # In float32, two vertices can have the same distance.
    apart = np.linalg.norm(queries[reverse] - database, axis=1) - np.linalg.norm(
        queries[expected] - database, axis=1
    )
    assert agree.mean() > 0.999 and apart.max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("backend", first_always(["numpy", "jax"]))
@pytest.mark.parametrize(
    "refiner", [WaveletPreservation, FeatureRegression, Registration], ids=lambda r: r.__name__
)
def test_forward_and_reverse_maps_search_the_same_space(pair, refiner, backend):
    mesh_x, mesh_y, truth = pair
    stage = Stage(refiner(), number_of_eigenvectors=30)
    found = match(mesh_x, mesh_y, preset=stage, init=truth, mirror="no", backend=backend)
    assert found.backend == backend
    points = [np.asarray(p) for p in found._embeddings()]
    # Registration also compares columns that are not eigenvectors.
    assert (points[1].shape[1] > found.functional_map.shape[0]) == (refiner is Registration)
    reverse = found._last.reverse_map()
    np.testing.assert_array_equal(found.pointwise_map, KDTree(points[1]).query(points[0])[1])
    np.testing.assert_array_equal(reverse, KDTree(points[0]).query(points[1])[1])


def test_scale_and_rotation_do_not_matter(pair, usual):
    mesh_x, mesh_y, _ = pair
    moved = make_mesh(1e3 * mesh_x.vertices[:, [2, 0, 1]] + 5, mesh_x.faces)
    other = match(moved, mesh_y, **OPTIONS)
    assert np.mean(usual.pointwise_map == other.pointwise_map) > 0.99


@pytest.fixture(scope="module")
def spectra(pair):
    return [compute_spectrum(mesh, 60) for mesh in pair[:2]]


@pytest.fixture(scope="module")
def by_shot(pair, spectra):
    return initial_map(Pair(*pair[:2]), *spectra)


@pytest.mark.slow
@pytest.mark.parametrize("init", ["shot", "wks", "hks", "wavelet", "landmarks", "map"])
def test_every_initial_map_is_better_than_chance_and_differs_from_shot(pair, spectra, by_shot, init):
    mesh_x, mesh_y, truth = pair
    given = init
    if init == "landmarks":
        given = np.stack([np.arange(6) * 100, truth[np.arange(6) * 100]], axis=1)
    if init == "map":
        given = np.where(np.arange(len(truth)) % 2, truth, 0)
    start = by_shot if init == "shot" else initial_map(Pair(mesh_x, mesh_y), *spectra, init=given)
    chance = np.random.default_rng(0).permutation(truth)
    assert mean_error(mesh_y, start, truth) < 0.75 * mean_error(mesh_y, chance, truth)
    if init != "shot":
        assert np.mean(start != by_shot) > 0.1


def test_landmarks_are_matched_to_each_other(pair):
    mesh_x, mesh_y, truth = pair
    landmarks = np.stack([np.arange(6) * 100, truth[np.arange(6) * 100]], axis=1)
    spectra = [compute_spectrum(mesh, 30) for mesh in (mesh_x, mesh_y)]
    start = initial_map(Pair(mesh_x, mesh_y), *spectra, init=landmarks)
    np.testing.assert_array_equal(start[landmarks[:, 0]], landmarks[:, 1])
    assert mean_error(mesh_y, start, truth) < 0.03


@pytest.mark.parametrize(
    ("options", "is_as_requested"),
    [
        ({"preset": replace(STAGE, iterations=1)}, lambda found: found.iterations == 1),
        (
            {"preset": replace(STAGE, number_of_eigenvectors=25)},
            lambda found: found.functional_map.shape == (25, 25),
        ),
        (
            {"preset": replace(STAGE, refiner=WaveletPreservation(bank=Meyer(6)))},
            lambda found: multiplies(found, Meyer(6)) and not multiplies(found, Meyer(4)),
        ),
        (
            {"preset": replace(STAGE, refiner=WaveletPreservation(bank=Meyer(4), solution=LeastSquares()))},
            lambda found: not multiplies(found, Meyer(4)),
        ),
        (
            {"preset": replace(STAGE, number_of_samples=150)},
            lambda found: found.refinement.history.pointwise_maps is None,  # as always on samples
        ),
        (
            {"laplacian": "robust"},
            lambda found: np.array_equal(
                found.spectrum_x.eigenvalues,
                compute_spectrum(found.mesh_x, 30, laplacian="robust").eigenvalues,
            ),
        ),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_every_option_has_its_effect(pair, usual, options, is_as_requested):
    mesh_x, mesh_y, _ = pair
    assert not is_as_requested(usual)
    assert is_as_requested(match(mesh_x, mesh_y, **(OPTIONS | options), history=True))


def multiplies(found: Correspondence, bank: FilterBank) -> bool:
    """Return whether filtering with the bank (equation (8) of the MWP paper) gives the last map."""
    x, y = found.spectrum_x, found.spectrum_y
    before = jnp.asarray(found.refinement.history.pointwise_maps[-2])
    kernel = multiscale_kernel(*(bank(s.eigenvalues, s.eigenvalues) for s in (x, y)))
    return np.allclose(found.functional_map, encode(before, x, y) * kernel, atol=1e-6)


@pytest.mark.slow
def test_history_ends_when_the_map_no_longer_changes(pair):
    patient = replace(STAGE, iterations=30, stop_when_unchanged=True)
    result = match(*pair[:2], preset=patient, history=True)
    assert result.iterations < 30
    changed = result.refinement.history.changed
    assert changed.shape == (30,)
    assert changed[0] > 0.1 and changed[result.iterations - 1] == 0
    assert np.isnan(changed[result.iterations :]).all()
    assert match(*pair[:2], **OPTIONS).refinement.history is None


def test_unreferenced_vertices_do_not_change_other_matches(pair, usual):
    mesh_x, mesh_y, _ = pair
    stray_x = make_mesh(
        np.insert(mesh_x.vertices, 5, mesh_x.vertices[9] * 1.01, axis=0), mesh_x.faces + (mesh_x.faces >= 5)
    )
    stray_y = make_mesh(np.insert(mesh_y.vertices, 0, 0.0, axis=0), mesh_y.faces + 1)
    result = match(stray_x, stray_y, **OPTIONS).pointwise_map
    assert np.mean(np.delete(result, 5) == usual.pointwise_map + 1) > 0.99
    assert result[5] == result[10]


def test_stages_leave_the_cores_to_xla(pair, monkeypatch):
    """Waiting OpenBLAS threads slow down all other computations, so refinement runs with one BLAS thread."""

    def threads() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    def watched(*arguments, **options):
        meanwhile.append(threads())
        return match_prepared(*arguments, **options)

    meanwhile: list[list[int]] = []
    monkeypatch.setattr("jaxsmw.matching.match.match_prepared", watched)
    threads_module._libraries.cache_clear()  # other tests load libraries that bring their own BLAS
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        match(*pair[:2], **OPTIONS)
        assert threads() == before and 2 in before
    assert meanwhile == [[1] * len(before)]


def test_stages_are_logged(pair, caplog, monkeypatch):
    # An earlier command in this process may have changed the logger.
    monkeypatch.setattr(logging.getLogger("jaxsmw"), "handlers", [caplog.handler])
    monkeypatch.setattr(logging.getLogger("jaxsmw"), "propagate", False)
    with caplog.at_level(logging.INFO, "jaxsmw"):
        match(*pair[:2], preset=replace(STAGE, number_of_samples=100))
    steps = ["eigenbases", "samples", "initial map", "refinement"]
    assert caplog.messages == [f"{step} ..." for step in steps]


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"preset": replace(STAGE, number_of_eigenvectors=10**6)}, "cannot compute 1000000 eigenvectors"),
        ({"preset": replace(STAGE, number_of_samples=10**6)}, "cannot choose 1000000 samples"),
        ({"preset": ()}, "give one of fast, paper, accurate, or stages"),
        ({"init": "shoot"}, "choose shot"),
        ({"init": [0, 1]}, "has 2 entries"),
        ({"init": np.zeros(1100)}, "must be integer"),
        ({"init": np.full(1100, -1)}, "between 0 and 1099"),
        ({"init": np.full(1100, 1100)}, "count from 1"),
        ({"init": np.ma.masked_array(np.zeros(1100, int), np.arange(1100) < 2)}, "masked in part"),
        ({"init": SurfacePoints(np.zeros(2, int), np.zeros((2, 3)))}, "barycentric weights"),
        ({"init": np.zeros((3, 3), int)}, "shape"),
        ({"init": np.zeros((0, 2), int)}, "shape"),
        ({"init": np.array([[0, 1100]])}, "landmark 1100"),
        ({"init": np.array([[0, 5], [3, 5], [0, 300]])}, "landmark 0 of .* has two matches, 5 and 300 of"),
        ({"init": np.array([[-1, 0]])}, "landmark -1"),
    ],
    ids=str,
)
def test_invalid_arguments_are_refused(pair, options, fault):
    with pytest.raises(InputError, match=fault):
        match(*pair[:2], **(OPTIONS | options))


def test_partial_must_be_a_truth_value(pair):
    untyped = inspect.unwrap(Pair.make.__func__)  # without the run-time type checks of the tests
    with pytest.raises(InputError, match="partial is 'yes': give True or False"):
        untyped(Pair, *pair[:2], partial="yes")


def test_maps_and_landmarks_must_lie_on_the_surface(pair):
    mesh_x, mesh_y, _ = pair
    stray = make_mesh(np.insert(mesh_y.vertices, 0, 0.0, axis=0), mesh_y.faces + 1)
    with pytest.raises(InputError, match="in no face"):
        match(mesh_x, stray, **OPTIONS, init=np.zeros(len(mesh_x.vertices), int))
    with pytest.raises(InputError, match="landmark 0"):
        match(mesh_x, stray, **OPTIONS, init=np.array([[0, 0]]))


def test_nonfinite_results_raise_an_error(pair):
    class Broken(WaveletPreservation):
        def update(self, prepared, pointwise_map, previous):
            state, result = super().update(prepared, pointwise_map, previous)
            return State(state.functional_map * jnp.nan), result

    with pytest.raises(ArithmeticError, match="NaN or infinite"):
        match(*pair[:2], preset=Stage(Broken(), number_of_eigenvectors=20))


def test_the_initial_map_by_shot_takes_nearest_neighbours(pair):
    from jaxsmw.geometry.shot import shot_descriptors

    mesh_x, mesh_y, _ = pair
    spectra = [compute_spectrum(mesh, 10) for mesh in (mesh_x, mesh_y)]
    distances = cdist(shot_descriptors(mesh_x), shot_descriptors(mesh_y))
    np.testing.assert_array_equal(initial_map(Pair(mesh_x, mesh_y), *spectra), distances.argmin(axis=1))


def test_fine_meshes_are_described_at_two_scales(pair, monkeypatch):
    mesh_x, mesh_y, truth = pair
    spectra = paired_spectra(Pair(mesh_x, mesh_y), 30)
    coarse = describe(Pair(mesh_x, mesh_y), *spectra, 60)
    monkeypatch.setattr(descriptors, "FINE_FROM", 1000)
    described = describe(Pair(mesh_x, mesh_y), *spectra, 60)
    assert described[0].descriptors.shape == coarse[0].descriptors.shape == (len(truth), 60)
    for x, y in (described, coarse):  # the mean square over both shapes is 1
        squares = [
            np.asarray(s.vertex_areas) @ np.asarray(s.descriptors) ** 2 / np.sum(s.vertex_areas)
            for s in (x, y)
        ]
        np.testing.assert_allclose((squares[0] + squares[1]) / 2, 1, rtol=1e-3)
    assert np.abs(np.asarray(described[0].descriptors - coarse[0].descriptors)).max() > 0.1


@pytest.mark.slow
def test_the_functional_initial_map_is_better_than_nearest_neighbours(pair):
    mesh_x, mesh_y, truth = pair
    spectra = [compute_spectrum(mesh, 30) for mesh in (mesh_x, mesh_y)]
    nearest, functional = (
        mean_error(mesh_y, initial_map(Pair(mesh_x, mesh_y), *spectra, init=init), truth)
        for init in ("shot", "functional")
    )
    assert functional < 0.5 * nearest


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        ({"refiner": Meyer()}, "refiner"),
        ({"iterations": 0}, "at least 1"),
        ({"number_of_samples": 10}, "too few for 100 eigenvectors"),
        ({"number_of_descriptors": 353}, "number_of_descriptors is 353"),
    ],
    ids=str,
)
def test_invalid_stages_are_refused(settings, fault):
    with pytest.raises((InputError, TypeCheckError), match=fault):
        Stage(**settings)


def test_presets_match_a_copy_accurately(pair, usual, accurate):
    mesh_x, mesh_y, truth = pair
    paper = match(mesh_x, mesh_y, preset="paper")
    errors = [mean_error(mesh_y, found.pointwise_map, truth) for found in (accurate, paper)]
    assert max(errors) < 0.002
    assert accurate.iterations == 3 + 4 + 4 + 4 and accurate.functional_map.shape == (200, 200)
    assert len(accurate.preset.stages) == 4 != len(usual.preset.stages) and accurate.distortion < 1.05
    assert paper.functional_map.shape == (100, 100) != usual.functional_map.shape
    steps = ["eigenbases", "samples", "crease eigenvectors", "initial map", "descriptors", "refinement"]
    assert list(accurate.seconds) == [*steps, "final stages"]
    assert accurate.expected_error().mean() < 0.002
    points = accurate.surface_points()
    distances = np.linalg.norm(points.positions(mesh_y) - mesh_y.vertices[truth], axis=1)
    assert np.median(distances) < 0.01 * mesh_y.area**0.5


def test_large_meshes_have_stages_of_their_own():
    accurate, large = PRESETS["accurate"], PRESETS["accurate"].fitted(15_000).stages
    assert accurate.fitted(14_999).stages == accurate.stages != large == accurate.large.stages
    assert large[1].ends_on_samples and large[2].starts_on_samples
    assert large[0].number_of_samples == 1000 and accurate.stages[0].number_of_samples is None
    assert accurate.without_descriptors().fitted(15_000).number_of_descriptors == 0
    small = accurate.large.fitted(900).stages
    assert not any(
        stage.starts_on_samples or stage.ends_on_samples or stage.number_of_samples for stage in small
    )


@pytest.mark.slow
def test_the_stages_for_large_meshes_are_as_accurate(pair, usual):
    mesh_x, mesh_y, truth = pair
    large = Preset(PRESETS["accurate"].large.stages)
    found = match(mesh_x, mesh_y, preset=large)
    assert mean_error(mesh_y, found.pointwise_map, truth) < 0.002
    assert found.iterations == 3 + 4 + 4 + 4 and (found.pointwise_map >= 0).all()


@pytest.mark.slow
def test_presets_fit_small_meshes():
    """A mesh of 162 vertices has neither 200 eigenvectors nor 1000 samples."""
    mesh = bumpy_mesh(2)
    with pytest.warns(UserWarning, match="continues without descriptors: .* coarse"):
        found = match(mesh, mesh, init=np.arange(162))
    assert found.functional_map.shape == (81, 81)
    last = found.preset.stages[-1]
    assert last.number_of_samples is None and last.number_of_descriptors == 0
    with pytest.raises(InputError, match="coarse"):
        match(
            mesh,
            mesh,
            init=np.arange(162),
            preset=Stage(FeatureRegression(), number_of_eigenvectors=30, number_of_descriptors=20),
        )


def test_an_unknown_preset_is_refused():
    with refused("'exact'", "preset", "fast, paper, accurate"):
        choose_preset("exact")
    with pytest.raises((InputError, TypeCheckError), match="preset"):
        choose_preset(3)


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        ({"iterations": "3"}, "iterations"),
        ({"number_of_eigenvectors": 10.5}, "number_of_eigenvectors"),
        ({"number_of_eigenvectors": -3}, "number_of_eigenvectors is -3"),
        ({"number_of_samples": 500.0}, "number_of_samples"),
    ],
)
def test_stage_sizes_must_be_positive_integers(settings, fault):
    with pytest.raises((InputError, TypeCheckError), match=fault):
        Stage(**settings)


def test_a_mesh_of_one_triangle_is_refused(pair):
    triangle = make_mesh(np.eye(3), np.array([[0, 1, 2]]), name="triangle.off")
    with pytest.raises(InputError, match=r"triangle\.off: its faces use 3 vertices, .* at least 4"):
        match(triangle, pair[1])


@pytest.mark.slow
def test_triangle_soup_is_refused_with_a_hint_to_weld(pair):
    mesh = pair[0]
    soup = make_mesh(mesh.vertices[mesh.faces.ravel()], np.arange(mesh.faces.size).reshape(-1, 3))
    with pytest.raises(InputError, match=r"largest of the 30 eigenvalues is zero.*weld=True"):
        match(soup, mesh, preset=Stage(number_of_eigenvectors=30))


@pytest.mark.parametrize("soup_first", [False, True])
def test_the_message_names_the_mesh_of_a_partial_pair_that_has_only_zero_eigenvalues(soup_first):
    whole = bumpy_mesh(2)
    faces = np.arange(whole.faces.size).reshape(-1, 3)
    meshes = [whole, make_mesh(whole.vertices[whole.faces.ravel()], faces, name="soup.off")]
    with pytest.raises(InputError, match=r"^soup\.off: the largest of the 30 eigenvalues is zero"):
        match(*meshes[:: -1 if soup_first else 1], preset=Stage(number_of_eigenvectors=30), partial=True)


@pytest.fixture(scope="module")
def part(pair):
    """The upper two thirds of the bumpy body as X, the full shape as Y in the same unit, and the true map."""
    whole = pair[0]
    kept = whole.vertices[:, 2] > np.quantile(whole.vertices[:, 2], 1 / 3)
    faces = whole.faces[kept[whole.faces].all(axis=1)]
    old, faces = np.unique(faces, return_inverse=True)
    return (
        make_mesh(5 * whole.vertices[old], faces.reshape(-1, 3)),
        make_mesh(5 * whole.vertices, whole.faces),
        old,
    )


def test_spectra_of_a_partial_shape_keep_the_unit_of_the_full_shape(part):
    mesh_x, mesh_y, _ = part
    x, y = paired_spectra(Pair(mesh_x, mesh_y, True), 40)
    own = compute_spectrum(mesh_x, 40)
    k = x.eigenvalues.shape[0]
    assert 15 < k < 40 == y.eigenvalues.shape[0]
    np.testing.assert_allclose(x.eigenvalues * mesh_x.area, (own.eigenvalues * mesh_y.area)[:k], rtol=1e-12)
    np.testing.assert_allclose(x.vertex_areas.sum(), mesh_x.area / mesh_y.area, rtol=1e-12)
    gram = x.eigenvectors.T @ (x.vertex_areas[:, None] * x.eigenvectors)
    np.testing.assert_allclose(gram, np.eye(k), atol=1e-9)
    assert x.eigenvalues[-1] <= y.eigenvalues[-1] < (own.eigenvalues * mesh_y.area / mesh_x.area)[k]
    # Exchanging X and Y exchanges their spectra.
    reverse = paired_spectra(Pair(mesh_y, mesh_x, True), 40)
    np.testing.assert_array_equal(reverse[1].eigenvalues, x.eigenvalues)
    whole = paired_spectra(Pair(mesh_x, mesh_y), 40)
    np.testing.assert_array_equal(whole[0].eigenvalues, own.eigenvalues)


def test_a_partial_shape_in_another_unit_is_refused(part):
    mesh_x, mesh_y, _ = part
    shrunken = make_mesh(mesh_x.vertices / 100, mesh_x.faces, name="x.off")
    with pytest.raises(
        InputError, match=r"x.off has area .*, so their units of length probably differ: scale one"
    ):
        match(shrunken, mesh_y, partial=True)


def test_a_partial_shape_is_matched_to_the_full_shape(part):
    mesh_x, mesh_y, truth = part
    found = match(mesh_x, mesh_y, preset=replace(STAGE, number_of_eigenvectors=40), partial=True)
    with pytest.warns(UserWarning, match=r"set partial=True if one mesh is a part of the other"):
        as_wholes = match(mesh_x, mesh_y, preset=replace(STAGE, number_of_eigenvectors=40), mirror="no")
    k_x, k_y = found.functional_map.shape
    assert k_x < k_y == 40
    assert mean_error(mesh_y, found.initial_map, truth) < mean_error(mesh_y, as_wholes.initial_map, truth)
    assert mean_error(mesh_y, found.pointwise_map, truth) < 0.02
    assert mean_error(mesh_y, as_wholes.pointwise_map, truth) > 0.04


@pytest.mark.slow
@pytest.mark.parametrize("init", ["functional", np.array([[0, 0], [400, 400]])], ids=str)
def test_other_initial_maps_work_for_partial_shapes(part, init):
    mesh_x, mesh_y, truth = part
    if not isinstance(init, str):
        init = np.stack([init[:, 0], truth[init[:, 1]]], axis=1)
    found = match(mesh_x, mesh_y, preset=replace(STAGE, number_of_eigenvectors=40), partial=True, init=init)
    assert mean_error(mesh_y, found.initial_map, truth) < 0.15


def test_surface_points_are_more_accurate_than_vertices(pair):
    """The target is a coarser copy, so the true positions are between its vertices."""
    mesh_x, coarse = pair[0], bumpy_mesh(number=600)
    start = KDTree(coarse.vertices).query(mesh_x.vertices)[1]
    result = match(mesh_x, coarse, **OPTIONS, init=start)
    points = result.surface_points()
    scaled = mesh_x.vertices / mesh_x.area**0.5 * coarse.area**0.5
    to_vertices = np.linalg.norm(coarse.vertices[result.pointwise_map] - scaled, axis=1).mean()
    to_points = np.linalg.norm(points.positions(coarse) - scaled, axis=1).mean()
    assert to_points < 0.6 * to_vertices
    assert points.weights.min() >= 0
    np.testing.assert_allclose(points.weights.sum(axis=1), 1, atol=1e-15)


def test_surface_points_and_expected_errors_are_computed_once(pair, monkeypatch):
    found = match(*pair[:2], **OPTIONS)
    points, expected = found.surface_points(), found.expected_error()
    copies = points.weights.copy(), expected.copy()
    points.faces[:], points.weights[:], expected[:] = -1, -1, -1  # a caller may change the results
    for name in ("estimate_error", "nearest_point_on_candidates"):
        monkeypatch.delattr(f"jaxsmw.matching.correspondence.{name}")
    again = found.surface_points()
    np.testing.assert_array_equal(again.weights, copies[0])
    np.testing.assert_array_equal(found.expected_error(), copies[1])
    assert again.faces.min() >= 0
    assert found.registered_mesh().surface_points.faces.shape == again.faces.shape


def test_unreferenced_vertices_get_surface_points_and_expected_errors(pair):
    mesh_x, mesh_y, _ = pair
    extra = make_mesh(np.vstack([mesh_x.vertices, mesh_x.vertices[:1]]), mesh_x.faces)
    found = match(extra, mesh_y, **OPTIONS)
    expected = found.expected_error()
    assert expected[-1] == expected[0] and np.isfinite(expected).all()
    points = found.surface_points()
    assert len(points) == len(extra.vertices)
    assert points.faces[-1] == points.faces[0]
    np.testing.assert_array_equal(points.weights[-1], points.weights[0])


def test_unreferenced_vertices_share_matches_one_to_one(pair):
    mesh_x, mesh_y, truth = pair
    extra = make_mesh(np.vstack([mesh_x.vertices, mesh_x.vertices[:1]]), mesh_x.faces)
    result = match(extra, mesh_y, **OPTIONS)
    found = result.one_to_one()
    assert found.dtype == np.int64 and found[-1] == found[0]
    np.testing.assert_array_equal(np.sort(found[:-1]), np.arange(len(truth)))
    # Both meshes have the same triangulation, so one-to-one matches need not be worse.
    assert mean_error(mesh_y, found[:-1], truth) <= mean_error(mesh_y, result.pointwise_map[:-1], truth)
    fewer = bumpy_mesh(number=600)
    start = KDTree(fewer.vertices).query(mesh_x.vertices)[1]
    with pytest.raises(InputError, match=r"1100 vertices of the source .* 600 .* swap"):
        match(mesh_x, fewer, **OPTIONS, init=start).one_to_one()


def test_soft_map_transfers_positions(pair):
    mesh_x, mesh_y, truth = pair
    extra = make_mesh(np.vstack([mesh_x.vertices, mesh_x.vertices[:1]]), mesh_x.faces)
    result = match(extra, mesh_y, **OPTIONS)
    soft = result.soft_map()
    assert bool(soft.converged) and float(soft.residual) <= 0.05
    carried = np.asarray(soft.pull_back(mesh_y.vertices))
    errors = np.linalg.norm(carried[:-1] - mesh_y.vertices[truth], axis=1) / mesh_y.area**0.5
    assert np.median(errors) < 0.02
    np.testing.assert_array_equal(carried[-1], carried[0])
    assert mean_error(mesh_y, np.asarray(soft.pointwise_map())[:-1], truth) < 0.02
    with pytest.warns(UserWarning, match="not converged: after 1 iterations"):
        result.soft_map(iterations=1, tolerance=1e-9)
    for settings in ({"temperature": 0.0}, {"temperature": np.nan}, {"iterations": 0}):
        with pytest.raises(InputError, match="cannot have"):
            result.soft_map(**settings)


def test_an_initial_map_to_surface_points_uses_their_nearest_corners(pair):
    mesh_x, mesh_y, _ = pair
    start = mesh_y.faces[np.arange(len(mesh_x.vertices)) % len(mesh_y.faces)]
    weights = np.full((len(start), 3), 0.01)
    weights[:, 1] = 0.98
    points = SurfacePoints(np.arange(len(start)) % len(mesh_y.faces), weights)
    with pytest.warns(UserWarning, match="wrong as a whole"):  # the initial map is arbitrary
        found = match(mesh_x, mesh_y, **OPTIONS, init=points)
    np.testing.assert_array_equal(found.initial_map, start[:, 1])


def test_a_spectrum_of_another_mesh_is_refused(pair):
    mesh_x, mesh_y, _ = pair
    spectrum, other = compute_spectrum(mesh_x, 10), compute_spectrum(bumpy_mesh(2), 10)
    with pytest.raises(InputError, match="its spectrum has 162"):
        initial_map(Pair(mesh_x, mesh_y), spectrum, other)


def test_every_name_of_an_initial_map_has_a_method():
    assert tuple(METHODS) == INITIAL_MAPS
