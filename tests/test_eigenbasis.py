"""Eigenbases agree with known eigenvalues and with an independent program, for good and bad meshes."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from messages import refused
from sampled_cases import first_always
from synthetic import body_with_arms, bumpy_mesh, grid_mesh, sphere_mesh

from jaxsmw.errors import InputError
from jaxsmw.geometry import eigenbasis
from jaxsmw.geometry.eigenbasis import compute_spectrum, eigenpairs
from jaxsmw.geometry.laplacian import assemble_laplacian, choose_laplacian
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.io.meshes import read_mesh
from jaxsmw.runtime.threads import side_by_side


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("JAXSMW_CACHE", "off")


def orthonormality(spectrum) -> float:
    gram = spectrum.eigenvectors.T @ (spectrum.vertex_areas[:, None] * spectrum.eigenvectors)
    return float(np.abs(gram - np.eye(len(gram))).max())


def joined(*meshes: Mesh) -> Mesh:
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return make_mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=False)]),
    )


def test_the_sphere_has_the_known_eigenvalues():
    """The sphere of area 1 has eigenvalues 4 pi l (l + 1) with multiplicity 2 l + 1, up to discretization."""
    mesh = make_mesh(*sphere_mesh(4))
    spectrum = compute_spectrum(mesh, 49)
    exact = 4 * np.pi * np.concatenate([np.full(2 * l + 1, l * (l + 1)) for l in range(7)])  # noqa: E741
    np.testing.assert_allclose(spectrum.eigenvalues[1:], exact[1:], rtol=0.03)
    assert spectrum.eigenvalues[0] < 1e-9
    np.testing.assert_allclose(spectrum.eigenvectors[:, 0], 1, atol=1e-8)
    np.testing.assert_allclose(jnp.sum(spectrum.vertex_areas), 1)
    assert orthonormality(spectrum) < 1e-10


def test_the_square_has_the_known_eigenvalues():
    """The unit square with a free boundary has the eigenvalues pi^2 (i^2 + j^2) for integers i, j >= 0."""
    spectrum = compute_spectrum(make_mesh(*grid_mesh(60, 60)), 20)
    i, j = np.mgrid[:8, :8]
    exact = np.sort((np.pi**2 * (i**2 + j**2)).ravel())[:20]
    np.testing.assert_allclose(spectrum.eigenvalues, exact, rtol=0.02, atol=1e-8)


def test_the_exact_solver_equals_a_dense_one():
    mesh = make_mesh(*grid_mesh(30, 25))
    mesh = make_mesh(mesh.vertices + 0.004 * np.random.default_rng(0).normal(size=(750, 3)), mesh.faces)
    eigenvalues, eigenvectors, areas = eigenpairs(mesh, 40)
    stiffness, full_areas = assemble_laplacian(mesh)
    exact, vectors = scipy.linalg.eigh(stiffness.toarray(), np.diag(full_areas / full_areas.sum()))
    np.testing.assert_allclose(eigenvalues, np.maximum(exact[:40], 0), rtol=1e-9, atol=1e-8)
    overlap = np.abs(eigenvectors.T @ (areas[:, None] * vectors[:, :40]))
    np.testing.assert_allclose(np.diag(overlap), 1, atol=1e-6)


def test_the_unit_of_the_file_has_no_effect():
    vertices, faces = sphere_mesh(3)
    small, large = (eigenpairs(make_mesh(vertices * scale, faces), 30) for scale in (1e-3, 1e4))
    np.testing.assert_allclose(small[0], large[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(small[2], large[2], rtol=1e-12)


def test_results_are_reproducible_with_canonical_signs():
    mesh = make_mesh(*sphere_mesh(3))
    first, second = eigenpairs(mesh, 30), eigenpairs(mesh, 30)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    largest = np.abs(first[1]).argmax(axis=0)
    assert (first[1][largest, np.arange(30)] > 0).all()


def test_components_keep_all_multiplicities():
    """The spectrum of two spheres and a triangle contains each sphere eigenvalue twice, and 0 three times."""
    sphere = make_mesh(*sphere_mesh(3))
    triangle = make_mesh(np.eye(3) + 5, [[0, 1, 2]])
    mesh = joined(sphere, triangle, make_mesh(sphere.vertices + 9, sphere.faces))
    spectrum = compute_spectrum(mesh, 50)
    single, flat = (
        eigenpairs(part, k)[0] * mesh.area / part.area for part, k in ((sphere, 30), (triangle, 2))
    )
    np.testing.assert_allclose(
        spectrum.eigenvalues,
        np.sort(np.concatenate([single, single, flat, flat[1:]]))[:50],
        rtol=1e-6,
        atol=1e-9,
    )
    assert (spectrum.eigenvalues[:3] < 1e-9).all() and spectrum.eigenvalues[3] > 1
    assert orthonormality(spectrum) < 1e-10


def test_unreferenced_vertices_are_masked():
    vertices, faces = sphere_mesh(2)
    plain = compute_spectrum(make_mesh(vertices, faces), 10)
    spectrum = compute_spectrum(make_mesh(np.insert(vertices, 7, 100.0, axis=0), faces + (faces >= 7)), 10)
    assert not spectrum.mask[7] and spectrum.mask.sum() == len(vertices)
    assert (spectrum.eigenvectors[7] == 0).all() and spectrum.vertex_areas[7] == 0
    np.testing.assert_allclose(spectrum.eigenvalues, plain.eigenvalues, atol=1e-9)


@pytest.mark.parametrize("k", [1, 2, 60, 160, 161])
def test_few_and_nearly_all_eigenvectors_are_orthonormal(k):
    mesh = make_mesh(*sphere_mesh(2))
    assert orthonormality(compute_spectrum(mesh, k)) < 1e-9


def test_spectra_are_cached_by_content(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path))
    vertices, faces = sphere_mesh(2)
    first = eigenpairs(make_mesh(vertices, faces), 12)
    monkeypatch.setattr(eigenbasis, "_solve", None)
    for a, b in zip(first, eigenpairs(make_mesh(vertices, faces, name="other"), 12), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(TypeError):
        eigenpairs(make_mesh(vertices, faces), 13)
    with pytest.raises(TypeError):
        eigenpairs(make_mesh(vertices, faces), 12, laplacian="robust")
    with pytest.raises(TypeError):
        eigenpairs(make_mesh(vertices * 1.01, faces), 12)


def test_a_single_triangle_has_a_spectrum():
    spectrum = compute_spectrum(make_mesh(np.eye(3), [[0, 1, 2]]), 2)
    assert spectrum.eigenvalues[0] == 0 < spectrum.eigenvalues[1]


@pytest.mark.parametrize("k", [0, -1, 162, 10**9])
def test_impossible_numbers_of_eigenvectors_are_refused(k):
    with refused(str(k), "162 referenced vertices", "1 to 161"):
        compute_spectrum(make_mesh(*sphere_mesh(2)), k)


def test_two_threads_give_the_results_of_one():
    meshes = make_mesh(*sphere_mesh(3)), body_with_arms()
    for mesh, (values, vectors, _) in zip(
        meshes, side_by_side(lambda mesh: eigenpairs(mesh, 40), *meshes), strict=True
    ):
        alone = eigenpairs(mesh, 40)
        np.testing.assert_array_equal(values, alone[0])
        np.testing.assert_array_equal(vectors, alone[1])


def test_nonmanifold_meshes_use_the_robust_laplacian():
    vertices, faces = grid_mesh(12, 12)
    vertices = vertices + 0.02 * np.random.default_rng(0).normal(size=vertices.shape)
    fin = make_mesh(np.concatenate([vertices, [[0.5, 0.5, 0.4]]]), np.concatenate([faces, [[65, 66, 144]]]))
    assert len(fin.nonmanifold_edges) == 1
    assert choose_laplacian(fin) == "robust"
    assert choose_laplacian(make_mesh(vertices, faces)) == "cotangent"
    assert orthonormality(compute_spectrum(fin, 20)) < 1e-9
    cotangent = compute_spectrum(fin, 20, laplacian="cotangent").eigenvalues
    robust = compute_spectrum(fin, 20).eigenvalues
    assert not np.allclose(cotangent, robust, rtol=1e-6)
    np.testing.assert_allclose(cotangent, robust, rtol=0.2, atol=1e-8)


def test_zero_area_faces_need_the_robust_laplacian():
    vertices, faces = grid_mesh(12, 12)
    # This triangle along a boundary edge has no area, because its third corner is on the edge.
    sliver = make_mesh(
        np.concatenate([vertices, [(vertices[0] + vertices[1]) / 2]]), np.concatenate([faces, [[0, 1, 144]]])
    )
    assert orthonormality(compute_spectrum(sliver, 20)) < 1e-9
    with pytest.raises(InputError, match="zero-area faces"):
        compute_spectrum(sliver, 20, laplacian="cotangent")


def test_the_robust_laplacian_ignores_unreferenced_vertices():
    vertices, faces = sphere_mesh(2)
    plain = compute_spectrum(make_mesh(vertices, faces), 10, laplacian="robust")
    gap = make_mesh(np.insert(vertices, 3, 9.0, axis=0), faces + (faces >= 3))
    spectrum = compute_spectrum(gap, 10, laplacian="robust")
    np.testing.assert_allclose(spectrum.eigenvalues, plain.eigenvalues, atol=1e-8)
    assert not spectrum.mask[3]


def test_inaccurate_solutions_are_retried_then_refused(monkeypatch):
    mesh = make_mesh(*sphere_mesh(3))
    calls, arpack = [], eigenbasis._arpack

    def sloppy(*arguments, **_):
        calls.append("lanczos")
        values, vectors = arpack(*arguments)
        return values, vectors + 1e-3

    def spy(*arguments):
        calls.append("arpack")
        return arpack(*arguments)

    monkeypatch.setattr(eigenbasis, "_lanczos", sloppy)
    monkeypatch.setattr(eigenbasis, "_arpack", spy)
    assert orthonormality(compute_spectrum(mesh, 20)) < 1e-9
    assert calls == ["lanczos", "arpack"]
    monkeypatch.setattr(eigenbasis, "_arpack", lambda *_: (np.ones(20), np.ones((642, 20))))
    with pytest.raises(InputError, match="could not be computed accurately"):
        compute_spectrum(mesh, 20)


@pytest.mark.parametrize("k", [1, 2, 5, 30, 50])
def test_no_copy_of_a_multiple_eigenvalue_is_missing(k, monkeypatch):
    """An icosahedral sphere has eigenvalues of multiplicity up to five.

    A single Krylov space contains only one copy of each eigenvalue.
    """
    monkeypatch.setattr(eigenbasis, "_arpack", lambda *_: pytest.fail("ARPACK was needed"))
    stiffness, areas = assemble_laplacian(make_mesh(*sphere_mesh(3)))
    mass = sp.diags(areas / areas.sum()).tocsc()
    exact = scipy.linalg.eigh(stiffness.toarray(), mass.toarray(), eigvals_only=True)
    found = eigenpairs(make_mesh(*sphere_mesh(3)), k)[0]
    np.testing.assert_allclose(found, exact[:k], rtol=1e-8, atol=1e-8)
    assert not eigenbasis._misses_some(stiffness, mass, exact[:k])
    if k > 30:
        for lost in (5, k // 2):
            assert eigenbasis._misses_some(stiffness, mass, np.delete(exact, lost)[:k])


@pytest.mark.parametrize("length", [0.01, 1, 1000])
def test_eigenvalues_are_exact_on_shapes_far_from_weyls_law(length, monkeypatch):
    """On a thin strip, eigenvalues grow with the square of their index, so the solver must correct its shift."""
    monkeypatch.setattr(eigenbasis, "_arpack", lambda *_: pytest.fail("ARPACK was needed"))
    vertices, faces = grid_mesh(12, 60)
    vertices = (vertices + 0.003 * np.random.default_rng(0).normal(size=vertices.shape)) * [1, length, 1]
    mesh = make_mesh(vertices, faces)
    stiffness, areas = assemble_laplacian(mesh)
    mass = np.diag(areas / areas.sum())
    exact = scipy.linalg.eigh(stiffness.toarray(), mass, eigvals_only=True, subset_by_index=(0, 39))
    eigenvalues = eigenpairs(mesh, 40)[0]
    np.testing.assert_allclose(eigenvalues, np.maximum(exact, 0), rtol=1e-8, atol=1e-7)


@pytest.mark.slow
def test_an_ordinary_body_does_not_need_arpack(monkeypatch):
    monkeypatch.setattr(eigenbasis, "_arpack", lambda *_: pytest.fail("ARPACK was needed"))
    mesh = bumpy_mesh(number=1500)
    stiffness, areas = assemble_laplacian(mesh)
    eigenvalues, _, _ = eigenpairs(mesh, 100)
    exact = scipy.linalg.eigh(
        stiffness.toarray(), np.diag(areas / areas.sum()), eigvals_only=True, subset_by_index=(0, 99)
    )
    np.testing.assert_allclose(eigenvalues, exact, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("numbering", first_always(["at random", "as subdivided"]))
def test_the_approximate_eigenbasis_is_near_the_exact_one(numbering):
    mesh = bumpy_mesh(5)
    if numbering == "at random":
        order = np.random.default_rng(1).permutation(len(mesh.vertices))
        mesh = make_mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    k = 60
    exact, approximate = (eigenpairs(mesh, k, eigensolver=solver) for solver in ("exact", "approximate"))
    assert approximate[0][0] == 0
    excess = approximate[0][1:] / exact[0][1:] - 1
    assert excess.min() > 0 and excess.max() < 0.006
    weighted = exact[2][:, None] * approximate[1]
    np.testing.assert_allclose(approximate[1].T @ weighted, np.eye(k), atol=1e-10)
    # The last eigenvectors are left out, because they mix with eigenvectors beyond the end of the basis.
    inside = weighted.T @ exact[1][:, : k - 5]
    assert np.sqrt(1 - np.sum(inside**2, axis=0)).max() < 0.05
    np.testing.assert_array_equal(approximate[1], eigenpairs(mesh, k, eigensolver="approximate")[1])


@pytest.mark.parametrize("subdivisions", [4, 5])
def test_the_approximation_error_does_not_grow_with_the_mesh(subdivisions):
    mesh = bumpy_mesh(subdivisions)
    exact, approximate = (eigenpairs(mesh, 15, eigensolver=s)[0] for s in ("exact", "approximate"))
    np.testing.assert_allclose(approximate, exact, rtol=0.006)


def test_all_copies_of_a_multiple_eigenvalue_are_approximated():
    exact, approximate = (
        eigenpairs(make_mesh(*sphere_mesh(5)), 49, eigensolver=s)[0] for s in ("exact", "approximate")
    )
    np.testing.assert_allclose(approximate, exact, rtol=0.02)


def graded_sphere(subdivisions):
    """A sphere whose triangles are about twenty times as long at one end as at the other."""
    vertices, faces = sphere_mesh(subdivisions)
    vertices = vertices + np.array([0, 0, 0.9])
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def bipyramid():
    turn = np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn), np.zeros(1500)], axis=1)
    edge = np.stack([np.arange(1500), np.roll(np.arange(1500), -1)], axis=1)
    faces = [np.insert(edge, 2, 1500, axis=1), np.insert(edge[:, ::-1], 2, 1501, axis=1)]
    return np.concatenate([rim, [[0, 0, 1], [0, 0, -1]]]), np.concatenate(faces)


def stretched(factor):
    vertices, faces = grid_mesh(60, 60)
    return vertices * [1, factor, 1], faces


@pytest.mark.parametrize(
    "shape",
    [bipyramid(), graded_sphere(5), stretched(20)],
    ids=["hubs", "graded", "stretched"],
)
def test_where_the_approximation_fails_the_exact_solver_takes_over(shape):
    mesh = make_mesh(*shape)
    with pytest.warns(RuntimeWarning, match="cannot be approximated"):
        found = eigenpairs(mesh, 20, eigensolver="approximate")
    for a, b in zip(found, eigenpairs(mesh, 20, eigensolver="exact"), strict=True):
        np.testing.assert_array_equal(a, b)


def falls_back(mesh, k):
    """Return whether the exact solver takes over. If not, check that the approximation is accurate."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.filterwarnings("always", ".*cannot be approximated", RuntimeWarning)
        approximate, *_ = eigenpairs(mesh, k, eigensolver="approximate")
    if not caught:
        np.testing.assert_allclose(approximate, eigenpairs(mesh, k, eigensolver="exact")[0], rtol=0.06)
    return bool(caught)


# The approximate eigensolver divides the surface into cells. Their radius is about one edge length for the grid of
# size 60 with k = 40, and about three edge lengths for size 120 with k = 10.
@pytest.mark.slow
@pytest.mark.parametrize(("size", "k"), first_always([(60, 40), (120, 10)], names=2))
@pytest.mark.parametrize("noise", first_always([0.1, 0, 0.3]))
@pytest.mark.parametrize("factor", [1, 2, 4, 6, 20])
def test_an_approximation_is_accurate_or_refused(size, k, factor, noise):
    vertices, faces = grid_mesh(size, size)
    vertices = vertices * [1, factor, 1]
    edge = 1 / (size - 1)
    vertices = vertices + noise * edge * np.random.default_rng(0).normal(size=vertices.shape)
    verdict = falls_back(make_mesh(vertices, faces), k)
    if factor <= 2 or factor == 20:
        assert verdict == (factor == 20)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1, 3, 5, 10, 20])
def test_a_region_of_bad_triangles_is_detected(factor):
    """The mesh is an even grid, except that ten columns of triangles are `factor` times as long."""
    (width, height), part = (100, 100), 10
    vertices, faces = grid_mesh(width, height)
    column = np.arange(len(vertices)) % width
    steps = np.where(np.arange(1, width) <= width - 1 - part, 1.0, factor)
    places = np.concatenate([[0], np.cumsum(steps)]) / (height - 1)
    stretched_sheet = np.stack([places[column], vertices[:, 1], vertices[:, 2]], axis=1)
    assert not falls_back(make_mesh(stretched_sheet, faces), 40) or factor > 3


@pytest.mark.parametrize("k", [1, 2])
def test_one_or_two_eigenvalues_are_approximated(k):
    mesh = bumpy_mesh(4)
    approximate, exact = (eigenpairs(mesh, k, eigensolver=s)[0] for s in ("approximate", "exact"))
    np.testing.assert_allclose(approximate, exact, rtol=0.01)


@pytest.mark.parametrize("vertices", [(700, 3), (40, 40)])
def test_the_returned_shift_is_the_shift_of_the_factors(vertices):
    positions, faces = grid_mesh(*vertices)
    stiffness, areas = assemble_laplacian(make_mesh(positions * [1, 1000, 1], faces), laplacian="cotangent")
    mass = sp.diags(areas / areas.sum()).tocsc()
    shift, inverse = eigenbasis._factorized_midway(stiffness, mass, 30)
    right = np.random.default_rng(0).normal(size=len(areas))
    np.testing.assert_allclose(
        stiffness @ inverse.solve(right) - shift * (mass @ inverse.solve(right)), right, atol=1e-4
    )


def test_the_eigensolver_depends_on_the_option_and_the_size_of_the_mesh(monkeypatch):
    used = []

    def spy(name):
        solver = getattr(eigenbasis, name)

        def called(*arguments, **options):
            used.append(name)
            return solver(*arguments, **options)

        monkeypatch.setattr(eigenbasis, name, called)

    spy("_approximate")
    spy("_lanczos")
    mesh = bumpy_mesh(4)
    eigenpairs(mesh, 20)
    monkeypatch.setattr(eigenbasis, "APPROXIMATE_FROM", 2000)
    eigenpairs(mesh, 20, eigensolver="exact")
    # The mesh is too small to approximate so many eigenvectors.
    eigenpairs(mesh, 200, eigensolver="approximate")
    assert used == ["_lanczos", "_lanczos", "_lanczos"]
    eigenpairs(mesh, 20)
    assert used[3:] == ["_approximate", "_lanczos"]
    # In tests, the type checker raises an error before the library does.
    with pytest.raises(Exception, match="fast"):
        eigenpairs(mesh, 20, eigensolver="fast")


def test_eigenpairs_equal_those_of_the_authors_program(shared):
    reference = np.load(shared / "oracle" / "faust_r_002_007.npz")
    mesh = read_mesh(shared / "data" / "faust_r" / "off" / "tr_reg_002.off")
    eigenvalues, eigenvectors, areas = eigenpairs(mesh, 128)
    scale = float(reference["x_area"])
    np.testing.assert_allclose(eigenvalues / scale, reference["x_eigenvalues"], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(areas * scale, reference["x_vertex_areas"], rtol=1e-9)
    overlap = np.sum(eigenvectors * areas[:, None] * reference["x_eigenvectors"], axis=0) * np.sqrt(scale)
    np.testing.assert_allclose(np.abs(overlap), 1, atol=1e-6)


def test_the_first_eigenvalue_of_every_component_is_exactly_zero():
    one, two = make_mesh(*sphere_mesh(1)), make_mesh(*grid_mesh(6, 7))
    assert eigenpairs(one, 3)[0][0] == eigenpairs(two, 1)[0][0] == 0
    eigenvalues = eigenpairs(joined(one, two), 6)[0]
    assert (eigenvalues[:2] == 0).all() and eigenvalues[2] > 0.1
