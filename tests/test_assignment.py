from itertools import permutations

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from messages import refused

from jaxsmw.errors import InputError
from jaxsmw.geometry import assignment
from jaxsmw.geometry.assignment import one_to_one_map


@pytest.fixture
def generator():
    return np.random.default_rng(0)


def cost(x, y, found):
    return np.sum((x - y[found]) ** 2)


@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 6), (3, 6), (6, 6)])
def test_the_map_has_the_lowest_cost_of_all_permutations(generator, m, n):
    x, y = generator.normal(size=(m, 4)), generator.normal(size=(n, 4))
    found = one_to_one_map(x, y)
    assert found.dtype == np.int64 and len(set(found)) == m
    best = min(cost(x, y, np.array(each)) for each in permutations(range(n), m))
    assert cost(x, y, found) == pytest.approx(best, rel=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_target_is_used_twice_among_5000(generator, dtype):
    x = generator.normal(size=(5000, 3)).astype(dtype)
    y = x[generator.permutation(5000)] + (0.02 * generator.normal(size=(5000, 3))).astype(dtype)
    found = one_to_one_map(x, y)
    np.testing.assert_array_equal(np.sort(found), np.arange(5000))


def test_a_renumbering_is_recovered(generator):
    x, order = generator.normal(size=(400, 5)), generator.permutation(400)
    np.testing.assert_array_equal(one_to_one_map(x, x[order]), np.argsort(order))
    np.testing.assert_array_equal(one_to_one_map(x + 1e3, x[order] + 1e3), np.argsort(order))
    signs = np.array([1, -1, -1, 1, -1])
    np.testing.assert_array_equal(one_to_one_map(signs * x, signs * x[order]), np.argsort(order))


def test_masked_vertices_are_not_matched(generator):
    x, y = generator.normal(size=(50, 4)), generator.normal(size=(60, 4))
    mask_x, mask_y = generator.random(50) < 0.7, generator.random(60) < 0.8
    x[~mask_x], y[~mask_y] = np.nan, np.nan
    found = one_to_one_map(x, y, mask_x=mask_x, mask_y=mask_y)
    assert (found[~mask_x] == -1).all() and mask_y[found[mask_x]].all()
    alone = one_to_one_map(x[mask_x], y[mask_y])
    np.testing.assert_array_equal(found[mask_x], np.flatnonzero(mask_y)[alone])


def test_equal_points_get_different_targets():
    found = one_to_one_map(np.zeros((7, 3)), np.zeros((7, 3)))
    np.testing.assert_array_equal(np.sort(found), np.arange(7))


def test_arrays_of_wrong_shapes_are_named(generator, unchecked):
    x = generator.normal(size=(5, 3))
    with refused("mask_x", "(4,)", "embedding_x", "5 points"):
        one_to_one_map(x, x, mask_x=np.ones(4, bool))
    with refused("embedding_y", "(5,)", "one point per row"):
        one_to_one_map(x, x[:, 0])


def test_impossible_problems_are_refused(generator, monkeypatch):
    x = generator.normal(size=(5, 3))
    with pytest.raises(InputError, match=r"5 vertices of the source .* 4 of the target, .*: swap"):
        one_to_one_map(x, x[:4])
    mask = np.arange(5) < 3
    with pytest.raises(InputError, match=r"5 vertices of the source .* 3 of the target"):
        one_to_one_map(x, x, mask_y=mask)
    one_to_one_map(x, x[:4], mask_x=mask)
    with pytest.raises(InputError, match="NaN or infinity"):
        one_to_one_map(x, np.where(x == x[0, 0], np.inf, x))
    with pytest.raises((InputError, TypeCheckError), match="mask"):
        one_to_one_map(x, x, mask_x=mask[:4])
    with pytest.raises((InputError, TypeCheckError), match=r"dimensions|embedding_y"):
        one_to_one_map(x, x[:, :2])
    monkeypatch.setattr(assignment, "_LARGEST", 24)
    with pytest.raises(InputError, match="would take"):
        one_to_one_map(x, x)
