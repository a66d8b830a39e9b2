"""Hypotheses, and the extremities of bodies from which some of them follow."""

import numpy as np
import pytest
from synthetic import body_with_arms, sphere_mesh

from jaxsmw import creature_pair
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.geodesics import geodesic_distances
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.search.hypotheses import plausible_pairings
from jaxsmw.matching.search.proxies import Proxy
from jaxsmw.matching.shape import PreparedShape


def reduced(mesh, unit=None):
    return Proxy(PreparedShape.of(mesh, compute_spectrum(mesh, 4)), unit or mesh.area**0.5)


def ends_of(mesh):
    """The extremities of a mesh, and their vertices."""
    proxy = reduced(mesh)
    return proxy.extremities, proxy.samples.vertices[proxy.extremities.samples]


@pytest.fixture(scope="module")
def creature():
    """Two poses of a body, and the extremities of both."""
    pair = creature_pair(vertices=1000)
    return pair, ends_of(pair.source), ends_of(pair.target)


def test_the_tips_of_arms_are_extremities():
    mesh = body_with_arms()
    _, vertices = ends_of(mesh)
    tips = mesh.vertices[vertices[:2], 0]
    assert sorted(np.sign(tips)) == [-1, 1] and np.abs(tips).min() > 0.9 * np.abs(mesh.vertices[:, 0]).max()


@pytest.mark.slow
def test_distances_run_along_the_surface(creature):
    """Distances between samples are slightly too long. The unit of distances is the mean of `remoteness`."""
    pair, (ends, vertices), _ = creature
    assert 3 <= len(vertices) <= 6
    exact = geodesic_distances(pair.source, vertices)[:, vertices]
    between = ~np.eye(len(vertices), dtype=bool)
    ratio = ends.distances[between] / exact[between]
    assert ratio.max() / ratio.min() < 1.1
    assert ends.remoteness.mean() == pytest.approx(1)
    assert (np.diff(ends.remoteness) <= 0).all()


def test_the_true_pairing_is_among_the_most_plausible(creature):
    pair, (x, vertices_x), (y, vertices_y) = creature
    points = SurfacePoints(pair.truth.faces[vertices_x], pair.truth.weights[vertices_x])
    reach = geodesic_distances(pair.target, points)[:, vertices_y]
    true = np.sort(reach, axis=1)[:, 0] < 0.1 * pair.target.area**0.5
    assert true.sum() >= 3  # vertices that are extremities of both bodies
    best = dict(zip(np.flatnonzero(true), reach.argmin(axis=1)[true], strict=True))
    pairings = plausible_pairings(x, y, 72)  # of 720 possible pairings
    assert any(all(dict(pairing).get(a) == b for a, b in best.items()) for pairing in pairings)


def test_the_unit_and_the_vertex_numbers_have_no_effect(creature):
    pair, (_, vertices), _ = creature
    mesh = pair.source
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    _, others = ends_of(make_mesh(50 * mesh.vertices[order] + 3, np.argsort(order)[mesh.faces]))
    assert len(others) == len(vertices)
    apart = geodesic_distances(mesh, vertices)[:, order[others]] / mesh.area**0.5
    assert apart.min(axis=0).max() < 0.02 and apart.min(axis=1).max() < 0.02


def test_pairings_are_one_to_one_and_symmetric_in_both_bodies(creature):
    _, (x, _), (y, _) = creature
    forward, backward = plausible_pairings(x, y, 5), plausible_pairings(y, x, 5)
    assert len(forward) == 5
    for pairing in forward:
        assert len(set(pairing[:, 0])) == len(set(pairing[:, 1])) == min(len(x.samples), len(y.samples))
        assert (pairing >= 0).all() and (pairing < [len(x.samples), len(y.samples)]).all()
    for one, other in zip(forward, backward, strict=True):
        assert set(map(tuple, one)) == set(map(tuple, other[:, ::-1]))


def test_orientations_tell_the_belly_from_the_back(creature):
    """The true counterpart has a similar orientation, and the mirror image the opposite one."""
    pair, (x, vertices_x), _ = creature
    proxies = reduced(pair.source), reduced(pair.target)
    truth = pair.truth.nearest_corners(pair.target)
    counterparts = proxies[1].samples.nearest[truth[proxies[0].samples.vertices]]
    of_x = proxies[0].orientations(x.samples)
    of_y = proxies[1].orientations(proxies[1].samples.nearest[truth[vertices_x]])[counterparts]
    assert np.corrcoef(of_x.ravel(), of_y.ravel())[0, 1] > 0.8
    assert np.abs(of_x).max() > 0.8 and np.abs(of_x).max() <= 1 + 1e-12
    np.testing.assert_allclose(of_x, -of_x.transpose(0, 2, 1), atol=1e-12)
    np.testing.assert_allclose(proxies[0].mirror().orientations(x.samples), -of_x, atol=1e-9)


def test_every_connected_component_has_extremities():
    mesh = body_with_arms()
    n = len(mesh.vertices)
    apart = make_mesh(
        np.concatenate([mesh.vertices, 0.5 * mesh.vertices + 9]), np.concatenate([mesh.faces, mesh.faces + n])
    )
    ends, vertices = ends_of(apart)
    assert (vertices < n).any() and (vertices >= n).any() and np.isfinite(ends.distances).all()
    (pairing, *_) = plausible_pairings(ends, ends, 1)
    np.testing.assert_array_equal(pairing[:, 0], pairing[:, 1])


def test_a_sphere_has_extremities():
    mesh = make_mesh(*sphere_mesh(1))
    ends, vertices = ends_of(mesh)
    assert 1 <= len(vertices) <= 6 and np.isfinite(ends.remoteness).all()
