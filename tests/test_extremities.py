import numpy as np
import pytest
from synthetic import body_with_arms, sphere_mesh

from jaxsmw import creature_pair
from jaxsmw.geometry.geodesics import SurfacePoints, geodesic_distances
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.repair.extremities import extremities, plausible_pairings


@pytest.fixture(scope="module")
def creature():
    """Two poses of a body, and the extremities of both."""
    pair = creature_pair(vertices=2000)
    return pair, extremities(pair.source), extremities(pair.target)


def test_the_tips_of_arms_are_extremities():
    mesh = body_with_arms()
    found = extremities(mesh)
    tips = mesh.vertices[found.vertices[:2], 0]
    assert sorted(np.sign(tips)) == [-1, 1] and np.abs(tips).min() > 0.9 * np.abs(mesh.vertices[:, 0]).max()


@pytest.mark.slow
def test_distances_run_along_the_surface(creature):
    """Distances along edges are slightly too long. The unit of distances is the mean of `remoteness`."""
    pair, ends, _ = creature
    assert 3 <= len(ends.vertices) <= 6
    exact = geodesic_distances(pair.source, ends.vertices)[:, ends.vertices]
    between = ~np.eye(len(ends.vertices), dtype=bool)
    ratio = ends.distances[between] / exact[between]
    assert ratio.max() / ratio.min() < 1.1
    assert ends.remoteness.mean() == pytest.approx(1)
    assert (np.diff(ends.remoteness) <= 0).all()


def test_the_true_pairing_is_among_the_most_plausible(creature):
    pair, x, y = creature
    points = SurfacePoints(pair.truth.faces[x.vertices], pair.truth.weights[x.vertices])
    reach = geodesic_distances(pair.target, points)[:, y.vertices]
    true = np.sort(reach, axis=1)[:, 0] < 0.1 * pair.target.area**0.5
    assert true.sum() >= 3  # vertices that are extremities of both bodies
    best = dict(zip(np.flatnonzero(true), reach.argmin(axis=1)[true], strict=True))
    pairings = plausible_pairings(x, y, 72)  # of 720 possible pairings
    assert any(all(dict(pairing).get(a) == b for a, b in best.items()) for pairing in pairings)


def test_the_unit_and_the_vertex_numbers_have_no_effect(creature):
    pair, ends, _ = creature
    mesh = pair.source
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    other = extremities(make_mesh(50 * mesh.vertices[order] + 3, np.argsort(order)[mesh.faces]))
    assert len(other.vertices) == len(ends.vertices)
    apart = geodesic_distances(mesh, ends.vertices)[:, order[other.vertices]] / mesh.area**0.5
    assert apart.min(axis=0).max() < 0.02 and apart.min(axis=1).max() < 0.02


def test_pairings_are_one_to_one_and_symmetric_in_both_bodies(creature):
    _, x, y = creature
    forward, backward = plausible_pairings(x, y, 5), plausible_pairings(y, x, 5)
    assert len(forward) == 5
    for pairing in forward:
        assert len(set(pairing[:, 0])) == len(set(pairing[:, 1])) == min(len(x.vertices), len(y.vertices))
        assert (pairing >= 0).all() and (pairing < [len(x.vertices), len(y.vertices)]).all()
    for one, other in zip(forward, backward, strict=True):
        assert set(map(tuple, one)) == set(map(tuple, other[:, ::-1]))


def test_every_connected_component_has_extremities():
    mesh = body_with_arms()
    n = len(mesh.vertices)
    apart = make_mesh(
        np.concatenate([mesh.vertices, 0.5 * mesh.vertices + 9]), np.concatenate([mesh.faces, mesh.faces + n])
    )
    ends = extremities(apart)
    assert (ends.vertices < n).any() and (ends.vertices >= n).any() and np.isinf(ends.distances).any()
    (pairing, *_) = plausible_pairings(ends, ends, 1)
    np.testing.assert_array_equal(pairing[:, 0], pairing[:, 1])


def test_a_sphere_has_extremities():
    mesh = make_mesh(*sphere_mesh(1))
    ends = extremities(mesh)
    assert 1 <= len(ends.vertices) <= 6 and np.isfinite(ends.remoteness).all()
