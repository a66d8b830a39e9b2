"""Shape models: alignment, modes, and the measures of a model."""

import numpy as np
import pytest
from messages import refused
from scipy.spatial.transform import Rotation

from jaxsmw.collection.shape_models import ShapeModel, align, shape_model
from jaxsmw.creature import CREATURES, creature
from jaxsmw.errors import InputError

N, VERTICES = 8, 60


def random_shapes(seed: int = 0, *, count: int = N, spread: float = 0.1) -> np.ndarray:
    """Return random variations of one cloud of points."""
    generator = np.random.default_rng(seed)
    template = generator.normal(size=(VERTICES, 3)) * [1, 2, 3]
    return template + spread * generator.normal(size=(count, VERTICES, 3))


def random_weights(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 3, VERTICES)


def moved(shapes: np.ndarray, seed: int, *, scale: bool = False, fixed: int | None = 0) -> np.ndarray:
    """Move every shape by another rigid motion (and scale it), except for one shape."""
    generator = np.random.default_rng(seed)
    result = np.empty_like(shapes)
    for i, shape in enumerate(shapes):
        factor = generator.uniform(0.1, 5) if scale else 1.0
        result[i] = factor * Rotation.random(rng=generator).apply(shape) + 20 * generator.normal(size=3)
    if fixed is not None:
        result[fixed] = shapes[fixed]
    return result


def inner(model: ShapeModel, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.einsum("v,...vc,...vc->...", model.weights, u, v)


def centroid_size(shape: np.ndarray, weights: np.ndarray) -> float:
    weights = weights / weights.sum()
    return float(np.sqrt(weights @ ((shape - weights @ shape) ** 2).sum(axis=1)))


# ---- Alignment


@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("reference", [0, 3])
def test_alignment_does_not_depend_on_rigid_motions_of_the_shapes(scale: bool, reference: int) -> None:
    shapes, weights = random_shapes(), random_weights()
    options = {"scale": scale, "weights": weights, "reference": reference}
    first = align(shapes, **options)
    second = align(moved(shapes, 5, fixed=reference), **options)
    np.testing.assert_allclose(second.aligned, first.aligned, atol=1e-8)
    np.testing.assert_allclose(second.mean, first.mean, atol=1e-8)
    np.testing.assert_allclose(second.scales, first.scales, rtol=1e-9)


def test_alignment_with_scale_does_not_depend_on_the_sizes_of_the_shapes() -> None:
    shapes = random_shapes()
    other = moved(shapes, 5, scale=True)
    first, second = align(shapes, scale=True), align(other, scale=True)
    ratio = centroid_size(second.mean, np.ones(VERTICES)) / centroid_size(first.mean, np.ones(VERTICES))
    center = shapes[0].mean(axis=0)
    np.testing.assert_allclose(second.aligned - center, ratio * (first.aligned - center), atol=1e-8)
    sizes = [centroid_size(shape, np.ones(VERTICES)) for shape in other]
    assert centroid_size(second.mean, np.ones(VERTICES)) == pytest.approx(np.mean(sizes), rel=1e-9)


@pytest.mark.parametrize("scale", [False, True])
def test_alignment_returns_the_motions_of_the_shapes(scale: bool) -> None:
    shapes = moved(random_shapes(), 2, fixed=None)
    found = align(shapes, scale=scale, weights=random_weights(), reference=2)
    again = found.scales[:, None, None] * np.einsum("icd,ivd->ivc", found.rotations, shapes)
    np.testing.assert_allclose(again + found.translations[:, None], found.aligned, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found.rotations), 1)
    np.testing.assert_array_equal(found.rotations[2], np.eye(3))
    np.testing.assert_allclose(found.mean, found.aligned.mean(axis=0), atol=1e-12)
    if not scale:
        np.testing.assert_allclose(found.aligned[2], shapes[2], atol=1e-12)
        np.testing.assert_array_equal(found.scales, 1)


@pytest.mark.parametrize("scale", [False, True])
def test_alignment_minimises_the_distances_to_the_mean(scale: bool) -> None:
    """No small motion of one shape brings the shape nearer to the mean."""
    weights = random_weights()
    found = align(moved(random_shapes(spread=0.4), 3), scale=scale, weights=weights)
    mean = found.mean - found.weights @ found.mean

    def squared_distance(shape: np.ndarray) -> float:
        return float(found.weights @ ((shape - mean) ** 2).sum(axis=1))

    generator = np.random.default_rng(0)
    for shape in found.aligned:
        centered = shape - found.weights @ shape
        if scale:
            # The least-squares scale of every shape differs from the final scale by one common factor.
            centered *= (
                found.weights @ (centered * mean).sum(axis=1) / (found.weights @ (centered**2).sum(axis=1))
            )
        best = squared_distance(centered)
        for _ in range(10):
            turned = Rotation.from_rotvec(1e-3 * generator.normal(size=3)).apply(centered)
            assert squared_distance(turned) > best
            assert squared_distance(centered + 1e-3 * generator.normal(size=3)) > best


def test_alignment_never_reflects() -> None:
    shape = random_shapes(count=1)[0]
    found = align(np.stack([shape, shape * [-1, 1, 1]]))
    np.testing.assert_allclose(np.linalg.det(found.rotations), 1)
    assert np.abs(found.aligned[1] - shape).max() > 0.1


def test_equal_weights_are_the_default_and_only_ratios_of_weights_matter() -> None:
    shapes, weights = random_shapes(), random_weights()
    np.testing.assert_allclose(
        align(shapes).mean, align(shapes, weights=np.full(VERTICES, 7.0)).mean, atol=1e-12
    )
    np.testing.assert_allclose(
        align(shapes, weights=weights).mean, align(shapes, weights=1e9 * weights).mean, atol=1e-9
    )
    assert np.abs(align(shapes).mean - align(shapes, weights=weights).mean).max() > 1e-4


def test_vertices_without_weight_do_not_influence_the_alignment() -> None:
    shapes, weights = random_shapes(), random_weights()
    weights[:5] = 0
    changed = shapes.copy()
    changed[:, :5] += 100 * np.random.default_rng(0).normal(size=(N, 5, 3))
    np.testing.assert_allclose(
        align(shapes, weights=weights).aligned[:, 5:],
        align(changed, weights=weights).aligned[:, 5:],
        atol=1e-8,
    )


def test_shapes_far_from_the_origin_are_aligned_as_well() -> None:
    shapes = random_shapes()
    far = align(shapes + np.arange(N)[:, None, None] * 1e6)
    np.testing.assert_allclose(far.aligned, align(shapes).aligned, atol=1e-7)


# ---- Modes


@pytest.mark.parametrize("weighted", [False, True])
def test_modes_are_orthonormal_and_reconstruct_the_shapes(weighted: bool) -> None:
    weights = random_weights() if weighted else None
    model = shape_model(moved(random_shapes(), 1), weights=weights)
    assert model.modes.shape == (N - 1, VERTICES, 3) and model.scores.shape == (N, N - 1)
    np.testing.assert_allclose(inner(model, model.modes[:, None], model.modes), np.eye(N - 1), atol=1e-9)
    for scores, shape in zip(model.scores, model.aligned, strict=True):
        np.testing.assert_allclose(model.shape(scores), shape, atol=1e-9)
    np.testing.assert_allclose(np.cov(model.scores.T), np.diag(model.variances), atol=1e-12)
    assert (np.diff(model.variances) < 0).all()
    squared = inner(model, model.aligned - model.mean, model.aligned - model.mean).sum() / (N - 1)
    assert model.total_variance == pytest.approx(squared)
    assert model.compactness()[-1] == pytest.approx(1) and (np.diff(model.compactness()) > 0).all()
    np.testing.assert_array_equal(model.shape(np.zeros(0)), model.mean)


def test_known_modes_are_recovered() -> None:
    """Two displacements that no rigid motion imitates, with uncorrelated scores."""
    generator = np.random.default_rng(4)
    weights = random_weights() / random_weights().sum()
    mean = generator.normal(size=(VERTICES, 3)) * [1, 2, 3]
    mean -= weights @ mean
    translations = [np.tile(axis, (VERTICES, 1)) for axis in np.eye(3)]
    turns = [np.cross(axis, mean) for axis in np.eye(3)]
    fields = np.array([*translations, *turns, *generator.normal(size=(2, VERTICES, 3))])
    scaled = (fields * np.sqrt(weights)[:, None]).reshape(len(fields), -1)
    modes = np.linalg.qr(scaled.T)[0].T[-2:].reshape(2, VERTICES, 3) / np.sqrt(weights)[:, None]
    scores = 0.01 * np.array([[3.0, 0], [-3, 0], [0, 1], [0, -1]])
    shapes = mean + np.tensordot(scores, modes, axes=1)
    model = shape_model(moved(shapes, 9), weights=weights, reference=0)
    # Rotations change the shapes only by squares of the scores.
    np.testing.assert_allclose(model.mean, mean, atol=1e-4)
    np.testing.assert_allclose(model.variances[:2], [2 * 0.03**2 / 3, 2 * 0.01**2 / 3], rtol=1e-2)
    for mode, known in zip(model.modes, modes, strict=False):
        assert abs(inner(model, mode, known)) > 0.999
    assert model.compactness()[1] > 0.999


def test_large_collections_of_many_vertices_are_computed_in_blocks() -> None:
    """The result for more vertices than one block is the singular value decomposition."""
    generator = np.random.default_rng(0)
    n = 2500
    shapes = generator.normal(size=(n, 3)) + 0.1 * generator.normal(size=(5, n, 3))
    model = shape_model(shapes)
    flat = (model.aligned - model.mean).reshape(5, -1) / np.sqrt(n)
    left, values, _ = np.linalg.svd(flat, full_matrices=False)
    np.testing.assert_allclose(model.variances, values[:4] ** 2 / 4)
    np.testing.assert_allclose(np.abs(model.scores), np.abs(left * values)[:, :4], atol=1e-9)
    np.testing.assert_allclose(inner(model, model.modes[:, None], model.modes), np.eye(4), atol=1e-9)


@pytest.mark.parametrize("scale", [False, True])
def test_projection_returns_the_scores_of_a_shape_in_any_pose(scale: bool) -> None:
    shapes = random_shapes(spread=0.3)
    model = shape_model(shapes, scale=scale, weights=random_weights())
    for shape, scores in zip(moved(shapes, 8, scale=scale, fixed=None), model.scores, strict=True):
        np.testing.assert_allclose(model.project(shape), scores, atol=1e-7)


def test_number_of_modes_limits_the_model() -> None:
    whole, model = shape_model(random_shapes()), shape_model(random_shapes(), number_of_modes=3)
    assert len(model.modes) == len(model.variances) == model.scores.shape[1] == len(model.compactness()) == 3
    np.testing.assert_allclose(model.modes, whole.modes[:3])
    np.testing.assert_allclose(model.scores, whole.scores[:, :3])
    np.testing.assert_allclose(model.compactness(), whole.compactness()[:3])
    np.testing.assert_allclose(model.project(random_shapes()[2]), model.scores[2], atol=1e-8)
    assert len(shape_model(random_shapes(), number_of_modes=99).modes) == N - 1


def test_signs_of_modes_are_fixed() -> None:
    model = shape_model(random_shapes())
    largest = np.abs(model.scores).argmax(axis=0)
    assert (model.scores[largest, np.arange(N - 1)] > 0).all()
    # Both scores of two shapes are equally large, so the first shape decides.
    pair = random_shapes(count=2)
    assert shape_model(pair).scores[0, 0] > 0 and shape_model(pair[::-1]).scores[0, 0] > 0


def test_results_are_deterministic() -> None:
    first, second = (shape_model(random_shapes(), scale=True, weights=random_weights()) for _ in range(2))
    for name in ("mean", "modes", "variances", "scores", "aligned"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    np.testing.assert_array_equal(
        first.specificity([2], samples=50, seed=3).mean, second.specificity([2], samples=50, seed=3).mean
    )
    assert first.specificity([2], samples=50, seed=4).mean != first.specificity([2], samples=50, seed=3).mean


# ---- Measures of a model


def mean_length(model: ShapeModel, field: np.ndarray) -> float:
    return float(model.weights @ np.linalg.norm(field, axis=1))


@pytest.mark.parametrize("number_of_modes", [None, 2])
def test_generalisation_agrees_with_models_of_the_other_shapes(number_of_modes: int | None) -> None:
    model = shape_model(random_shapes(spread=0.3), weights=random_weights(), number_of_modes=number_of_modes)
    numbers = (0, 1, 4, N - 2)
    curve = model.generalisation(numbers)
    errors = np.empty((len(numbers), N))
    roots = np.repeat(np.sqrt(model.weights), 3)
    for i, shape in enumerate(model.aligned):
        others = np.delete(model.aligned, i, axis=0)
        mean = others.mean(axis=0)
        modes = np.linalg.svd((others - mean).reshape(N - 1, -1) * roots, full_matrices=False)[2]
        weighted = (shape - mean).ravel() * roots
        for at, number in enumerate(numbers):
            rest = (weighted - modes[:number].T @ (modes[:number] @ weighted)) / roots
            errors[at, i] = mean_length(model, rest.reshape(-1, 3))
    assert curve.numbers_of_modes == numbers
    np.testing.assert_allclose(curve.mean, errors.mean(axis=1), rtol=1e-9)
    np.testing.assert_allclose(curve.standard_error, errors.std(axis=1, ddof=1) / np.sqrt(N), rtol=1e-9)
    assert (np.diff(curve.mean) < 0).all()


def test_generalisation_does_not_use_directions_that_only_the_left_out_shape_has() -> None:
    """All shapes but one differ in one direction, so no number of modes describes the other shape."""
    generator = np.random.default_rng(2)
    mean, along, other = generator.normal(size=(3, VERTICES, 3))
    shapes = np.stack([mean + 0.01 * t * along for t in (-1.0, 0.5, 0.2, 0.3)] + [mean + 0.05 * other])
    model = shape_model(shapes)
    curve = model.generalisation([1, 3])
    assert curve.mean[1] > 0.5 * mean_length(model, 0.05 * other) / len(shapes)


@pytest.mark.parametrize("number_of_modes", [None, 4])
def test_specificity_agrees_with_distances_of_random_shapes(number_of_modes: int | None) -> None:
    model = shape_model(random_shapes(spread=0.3), weights=random_weights(), number_of_modes=number_of_modes)
    samples, seed, numbers = 40, 7, (0, 1, 4)
    normal = np.random.default_rng(seed).standard_normal((len(model.modes), samples))
    curve = model.specificity(numbers, samples=samples, seed=seed)
    for at, number in enumerate(numbers):
        distances = []
        for sample in range(samples):
            shape = model.shape((normal[:, sample] * np.sqrt(model.variances))[:number])
            fields = shape - model.aligned
            nearest = inner(model, fields, fields).argmin()
            distances.append(mean_length(model, fields[nearest]))
        assert curve.mean[at] == pytest.approx(np.mean(distances))
        assert curve.standard_error[at] == pytest.approx(
            np.std(distances, ddof=1) / np.sqrt(samples), abs=1e-12
        )


@pytest.mark.sampled
def test_shapes_of_a_real_kind_have_a_compact_model() -> None:
    """Few modes describe poses of one body, and more modes describe new shapes better."""
    meshes = [creature("quadruped", vertices=600, pose=pose) for pose in CREATURES["quadruped"]]
    model = shape_model(np.stack([mesh.vertices for mesh in meshes]), weights=meshes[0].vertex_areas)
    assert model.compactness()[2] > 0.8
    curve = model.generalisation(range(len(meshes) - 1))
    assert curve.mean[-1] < curve.mean[0]


# ---- Small collections and invalid input


def test_one_shape_has_no_modes() -> None:
    shape = random_shapes(count=1)
    model = shape_model(shape)
    np.testing.assert_allclose(model.mean, shape[0], atol=1e-12)
    assert model.modes.shape == (0, VERTICES, 3) and model.scores.shape == (1, 0)
    assert model.total_variance == 0 and model.compactness().shape == (0,)
    assert model.project(shape[0]).shape == (0,)
    assert model.specificity([0], samples=3).mean == pytest.approx([0])
    with pytest.raises(InputError, match="at least two shapes"):
        model.generalisation([0])


@pytest.mark.parametrize("scale", [False, True])
def test_identical_shapes_have_no_modes(scale: bool) -> None:
    shapes = moved(np.repeat(random_shapes(count=1), 5, axis=0), 3, scale=scale)
    model = shape_model(shapes, scale=scale)
    assert len(model.modes) == 0 and model.total_variance == 0
    curve = model.generalisation([0, 3])
    np.testing.assert_allclose(curve.mean, 0, atol=1e-7)
    np.testing.assert_allclose(model.aligned, np.broadcast_to(model.mean, shapes.shape), atol=1e-7)


def test_two_shapes_have_one_mode() -> None:
    model = shape_model(moved(random_shapes(count=2), 1))
    assert len(model.modes) == 1 and model.scores[0, 0] == pytest.approx(-model.scores[1, 0])
    assert model.generalisation([0]).mean == pytest.approx(
        mean_length(model, model.aligned[0] - model.aligned[1])
    )


def bad(index: int, value: float) -> np.ndarray:
    shapes = random_shapes()
    shapes[index, 3, 1] = value
    return shapes


@pytest.mark.parametrize(
    ("shapes", "options", "facts"),
    [
        ([], {}, "no shape"),
        (np.zeros((2, 0, 3)), {}, "no vertices"),
        (bad(4, np.nan), {}, "shape 4; coordinates; not finite"),
        (bad(2, np.inf), {}, "shape 2; coordinates; not finite"),
        ([np.eye(3), np.ones((4, 3))], {}, "shape 1; 4 vertices; shape 0; 3"),
        ([np.eye(3), np.full((3, 3), 0.1)], {}, "shape 1; single point"),
        (None, {}, "no shape"),
        (np.eye(3), {}, "shape 0; vertices; numeric array"),
        ([np.eye(3), [["a", "b", "c"]]], {}, "shape 1; vertices; numeric array"),
        ([np.eye(2)], {}, "shape 0; vertices; numeric array of shape (number of vertices, 3)"),
        (random_shapes(), {"scale": "no"}, "scale; 'no'; True; False"),
        (random_shapes(), {"weights": ["a"]}, "weights; str32; numbers"),
        (random_shapes(), {"weights": 1.0}, "weights; shape ()"),
        (random_shapes(), {"reference": 1.0}, "reference; 1.0"),
        (random_shapes(), {"number_of_modes": 2.5}, "number_of_modes; 2.5"),
        (random_shapes(), {"weights": np.ones(3)}, "weights; shape (3,); 60 weights"),
        (random_shapes(), {"weights": -np.ones(VERTICES)}, "weights; finite; not negative"),
        (random_shapes(), {"weights": np.zeros(VERTICES)}, "weights; finite; not negative"),
        (random_shapes(), {"weights": np.full(VERTICES, np.nan)}, "weights; finite"),
        (random_shapes(), {"reference": N}, "reference; 8; a whole number from 0 to 7"),
        (random_shapes(), {"reference": -1}, "reference; -1"),
        (random_shapes(), {"number_of_modes": 0}, "number_of_modes; 0; a whole number of at least 1"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_shapes_and_options_are_refused(shapes: object, options: dict, facts: str) -> None:
    with refused(*facts.split("; ")):
        shape_model(shapes, **options)


@pytest.mark.usefixtures("unchecked")
def test_invalid_uses_of_a_model_are_refused() -> None:
    model = shape_model(random_shapes())
    for call, facts in (
        (lambda: model.shape(np.zeros(N)), "scores; shape (8,); at most 7 finite numbers"),
        (lambda: model.shape(np.array([np.nan])), "finite numbers"),
        (lambda: model.project(np.eye(3)), "shape; 3 vertices; model; 60"),
        (lambda: model.shape(["a"]), "scores; str32; numbers"),
        (lambda: model.project("a"), "shape; vertices; numeric array"),
        (lambda: model.generalisation(3), "numbers_of_modes; 3; a list of whole numbers"),
        (lambda: model.specificity([1.5]), "number of modes; 1.5; a whole number"),
        (lambda: model.specificity([1], seed=-1), "seed; -1"),
        (lambda: model.specificity([1], samples=10.0), "samples; 10.0"),
        (lambda: model.project(bad(0, np.nan)[0]), "not finite"),
        (lambda: model.project(np.full((VERTICES, 3), 0.1)), "a single point"),
        (
            lambda: model.generalisation([N - 1]),
            "number of modes; 7; 7 shapes determine 6",
        ),
        (lambda: model.specificity([N]), "number of modes; 8; model; 7"),
        (lambda: model.specificity([-1]), "number of modes; -1"),
        (lambda: model.specificity([1], samples=1), "samples; 1; a whole number of at least 2"),
    ):
        with refused(*facts.split("; ")):
            call()
