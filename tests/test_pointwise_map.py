import numpy as np
import pytest
from scipy.spatial.distance import cdist
from synthetic import random_spectrum, to_namespace

from jaxsmw.core.arrays import replaced
from jaxsmw.core.pointwise_map import (
    decode,
    decode_to_triangles,
    spectral_embeddings,
)
from jaxsmw.core.refiner import Problem, State
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation


@pytest.mark.parametrize("convention", ["pullback", "pushforward"])
def test_decode_finds_nearest_neighbours_and_the_objective_is_their_distance(convention, namespace):
    x, y = to_namespace((random_spectrum(40, 8, seed=1), random_spectrum(30, 6, seed=2)), namespace)
    shape = (8, 6) if convention == "pullback" else (6, 8)
    functional_map = to_namespace(np.random.default_rng(0).normal(size=shape), namespace)
    t = decode(functional_map, x, y, convention=convention)
    queries, database = spectral_embeddings(functional_map, x, y, convention=convention)
    distances = cdist(queries, database) ** 2
    np.testing.assert_array_equal(t, distances.argmin(axis=1))
    refiner = WaveletPreservation(convention=convention)
    prepared, state = refiner.prepare(Problem(x, y)), State(functional_map)
    objective = refiner.objective(prepared, state, t)
    np.testing.assert_allclose(objective, np.asarray(x.vertex_areas) @ distances.min(axis=1), rtol=1e-10)
    worse = refiner.objective(prepared, state, replaced(t, 0, (t[0] + 1) % 30))
    assert worse > objective


@pytest.mark.parametrize("convention", ["pullback", "pushforward"])
def test_decode_to_triangles_is_never_farther_than_decode(convention, namespace):
    x, y = to_namespace((random_spectrum(40, 8, seed=1), random_spectrum(30, 6, seed=2)), namespace)
    generator = np.random.default_rng(0)
    shape = (8, 6) if convention == "pullback" else (6, 8)
    functional_map = to_namespace(generator.normal(size=shape), namespace)
    faces_y = np.array([np.roll(np.arange(30), -corner) for corner in (0, 1, 7)]).T
    queries, database = spectral_embeddings(functional_map, x, y, convention=convention)
    arguments = functional_map, x, y, to_namespace(faces_y, namespace)
    faces, weights = decode_to_triangles(*arguments, convention=convention)
    there = np.einsum("mc,mcd->md", weights, np.asarray(database)[faces_y[np.asarray(faces)]])
    distances = np.linalg.norm(there - np.asarray(queries), axis=1)
    to_vertices = cdist(queries, database).min(axis=1)
    assert (distances <= to_vertices + 1e-12).all()
    assert (distances < to_vertices - 1e-6).mean() > 0.5
