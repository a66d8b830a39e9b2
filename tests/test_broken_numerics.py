"""A broken numerical library causes one sentence instead of a wrong map. Each test breaks one library on purpose."""

import jax.numpy as jnp
import numpy as np
import pytest
import robust_laplacian
import scipy.sparse as sp
from messages import refused
from synthetic import bumpy_mesh

import jaxsmw
from jaxsmw import Stage
from jaxsmw.errors import InputError
from jaxsmw.geometry import eigenbasis
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.matching import starts as nearest
from jaxsmw.runtime.cache import recomputing

# `_dense` solves small meshes. The other solvers need more than 400 vertices and few eigenvectors.
SUBDIVISIONS, K = 3, 12


@pytest.fixture(autouse=True)
def no_cache():
    with recomputing():
        yield


def twisted(pairs):
    """Eigenpairs whose first two eigenvectors are not orthogonal."""
    values, vectors = pairs
    vectors = vectors.copy()
    vectors[:, 1] += 0.01 * vectors[:, 0]
    return values, vectors


def swapped(pairs):
    """Orthonormal vectors that are not eigenvectors."""
    values, vectors = pairs
    vectors = vectors.copy()
    vectors[:, [1, 5]] = vectors[:, [5, 1]]
    return values, vectors


def undefined(pairs):
    values, vectors = pairs
    return values, np.where(np.arange(len(vectors))[:, None] == 3, np.nan, vectors)


@pytest.mark.parametrize("fault", [twisted, swapped, undefined])
def test_wrong_eigenvectors_are_refused(monkeypatch, fault):
    for name in ("_lanczos", "_arpack"):
        solver = getattr(eigenbasis, name)
        monkeypatch.setattr(eigenbasis, name, lambda *a, solver=solver: fault(solver(*a)))
    with pytest.raises(InputError, match="could not be computed accurately"):
        compute_spectrum(bumpy_mesh(SUBDIVISIONS), K)


def test_one_broken_solver_is_replaced_by_the_other(monkeypatch):
    expected = compute_spectrum(bumpy_mesh(SUBDIVISIONS), K).eigenvalues
    solver = eigenbasis._lanczos
    monkeypatch.setattr(eigenbasis, "_lanczos", lambda *a: twisted(solver(*a)))
    np.testing.assert_allclose(compute_spectrum(bumpy_mesh(SUBDIVISIONS), K).eigenvalues, expected, atol=1e-6)


@pytest.mark.parametrize("fault", ["negative area", "NaN area", "NaN weight"])
def test_a_wrong_robust_laplacian_is_refused(monkeypatch, fault):
    original = robust_laplacian.mesh_laplacian

    def broken(*arguments):
        stiffness, mass = original(*arguments)
        areas = mass.diagonal()
        if fault == "NaN weight":
            stiffness = stiffness.copy()
            stiffness.data[7] = np.nan
        else:
            areas[3] = -areas[3] if fault == "negative area" else np.nan
        return stiffness, sp.diags(areas)

    monkeypatch.setattr(robust_laplacian, "mesh_laplacian", broken)
    with refused("robust Laplacian", "NaN", "no positive area"):
        compute_spectrum(bumpy_mesh(SUBDIVISIONS), K, laplacian="robust")


def next_row(nearest_neighbor):
    """A search that returns the row after the nearest row."""
    return lambda queries, database, **options: (
        (nearest_neighbor(queries, database, **options) + 1) % len(database)
    )


def last_quarter(nearest_neighbor):
    """A search that is wrong for a quarter of the queries, as if one of four threads had failed."""

    def search(queries, database, **options):
        found = nearest_neighbor(queries, database, **options)
        return jnp.where(jnp.arange(len(found)) < 3 * len(found) // 4, found, 0)

    return search


@pytest.mark.parametrize("fault", [next_row, last_quarter])
def test_a_wrong_search_is_refused(monkeypatch, fault):
    mesh = bumpy_mesh(SUBDIVISIONS)
    other = make_mesh(
        mesh.vertices + 0.01 * np.random.default_rng(0).normal(size=mesh.vertices.shape), mesh.faces
    )
    options = {"preset": Stage(number_of_eigenvectors=K), "mirror": "no"}
    assert len(jaxsmw.match(mesh, other, **options).pointwise_map) == len(mesh.vertices)
    monkeypatch.setattr(nearest, "nearest_neighbor", fault(nearest.nearest_neighbor))
    with pytest.raises(ArithmeticError, match=r"wrong nearest neighbours.*install numpy"):
        jaxsmw.match(mesh, other, **options)


def test_ties_and_masks_are_no_fault():
    """Equal points are equally near, and masked rows are never the nearest."""
    points = np.repeat(np.random.default_rng(0).normal(size=(4, 3)), 10, axis=0)
    usable = np.arange(10, 40)
    squared = ((points[:, None] - points[usable]) ** 2).sum(axis=2)
    found = usable[squared.argmin(axis=1)]
    nearest.check_nearest(points, points, usable, found)
    tied = np.where(found == 20, 29, found)
    assert (tied != found).any()
    nearest.check_nearest(points, points, usable, tied)
    masked = np.where(np.arange(40) == 0, 0, found)
    with pytest.raises(ArithmeticError):
        nearest.check_nearest(points, points, usable, masked)
