"""A broken numerical library causes one sentence instead of a wrong map. Each test breaks one library on purpose."""

import numpy as np
import pytest
import robust_laplacian
import scipy.sparse as sp
from messages import refused
from synthetic import bumpy_mesh

from jaxsmw.errors import InputError
from jaxsmw.geometry import eigenbasis
from jaxsmw.geometry.eigenbasis import compute_spectrum
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
