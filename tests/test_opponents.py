"""Opponents agree with plain NumPy implementations of their papers, and solve cases with a known result."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from synthetic import bumpy_mesh, random_spectrum

from jaxsmw.benchmark.opponents.base import HostMethod, MethodInput
from jaxsmw.benchmark.opponents.baselines import Staged, Unrefined, ZoomOut
from jaxsmw.benchmark.opponents.registry import METHODS, PEERS, known_methods
from jaxsmw.benchmark.opponents.smooth_shells import SmoothShells
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.matching.spectral_pair import SpectralPair

pytestmark = pytest.mark.study

M, N, K = 200, 180, 40


@pytest.fixture
def pair() -> MethodInput:
    generator = np.random.default_rng(0)
    x, y = random_spectrum(M, K, seed=1), random_spectrum(N, K, seed=2)
    samples = tuple(jnp.asarray(generator.choice(n, 80, replace=False)) for n in (M, N))
    return MethodInput(SpectralPair(x, y, samples), jnp.asarray(generator.integers(0, N, M)))


def nearest(queries, database) -> np.ndarray:
    return cdist(queries, database).argmin(axis=1)


def test_zoomout_is_iterative_upsampling(pair):
    x, y = pair.spectra.both
    t = np.asarray(pair.initial_map)
    for k in (10, 15, 20, 25):
        a, b = np.asarray(x.eigenvectors[:, :k]), np.asarray(y.eigenvectors[:, :k])
        c = (a * np.asarray(x.vertex_areas)[:, None]).T @ b[t]
        t = nearest(a, b @ c.T)
    found = ZoomOut("", first=10, step=5, number_of_eigenvectors=25)(pair)
    np.testing.assert_array_equal(found, t)


def test_zoomout_on_samples_searches_all_vertices_at_the_end(pair):
    x, y = pair.spectra.both
    s_x, s_y = (np.asarray(vertices[:60]) for vertices in pair.spectra.samples)
    phi, psi = np.asarray(x.eigenvectors), np.asarray(y.eigenvectors)
    c = (phi[:, :10] * np.asarray(x.vertex_areas)[:, None]).T @ psi[np.asarray(pair.initial_map), :10]
    t = nearest(phi[s_x, :10], psi[s_y, :10] @ c.T)
    for k in (10, 15, 20):
        c = np.linalg.lstsq(phi[s_x, :k], psi[s_y[t], :k])[0]
        t = nearest(phi[s_x, :k], psi[s_y, :k] @ c.T)
    found = ZoomOut("", first=10, step=5, number_of_eigenvectors=20, number_of_samples=60)(pair)
    np.testing.assert_array_equal(found, nearest(phi[:, :20], psi[:, :20] @ c.T))


def test_spectral_icp_takes_the_nearest_rotation(pair):
    icp = METHODS["icp"]
    (x, y), t = pair.spectra.both, np.asarray(pair.initial_map)
    for _ in range(4):
        c = (np.asarray(x.eigenvectors) * np.asarray(x.vertex_areas)[:, None]).T @ np.asarray(y.eigenvectors)[
            t
        ]
        u, _, v = np.linalg.svd(c)
        t = nearest(np.asarray(x.eigenvectors), np.asarray(y.eigenvectors) @ (u @ v).T)
    (stage,) = icp.stages
    found = Staged("", (replace(stage, number_of_eigenvectors=K, iterations=4),))(pair)
    np.testing.assert_array_equal(found, t)


def test_all_methods_repair_a_noisy_initial_map():
    """X is Y with its vertices in another order, and 10 % of the initial matches are wrong."""
    generator = np.random.default_rng(0)
    mesh_y = bumpy_mesh(3)
    y = compute_spectrum(mesh_y, 120)
    n = len(y.mask)
    order = generator.permutation(n)
    mesh_x = make_mesh(mesh_y.vertices[order], np.argsort(order)[mesh_y.faces])
    x = Spectrum(y.eigenvalues, y.eigenvectors[order], y.vertex_areas[order], y.mask)
    x = x.with_positions(y.positions[order], y.normals[order])
    initial_map = np.where(generator.random(n) < 0.1, generator.integers(0, n, n), order)
    samples = generator.choice(n, 550, replace=False)
    on_both = jnp.asarray(np.argsort(order)[samples]), jnp.asarray(samples)
    spectra = SpectralPair(x, y, on_both)
    pair = MethodInput(spectra, jnp.asarray(initial_map), (mesh_x, mesh_y), init=initial_map)
    for name, method in METHODS.items():
        if method.partial_only or isinstance(method, SmoothShells):
            continue  # tested in files of their own
        if isinstance(method, ZoomOut):
            # JAX compiles the program anew for each size, so large steps save time.
            method = replace(method, step=50)
        found = method(pair)
        wrong = np.mean(np.asarray(found)[:n] != order)
        assert wrong > 0.08 if isinstance(method, Unrefined) else wrong < 0.02, name


@pytest.mark.filterwarnings("ignore::ImportWarning")
def test_other_libraries_run_the_same_zoomout():
    """Other libraries receive no padding and no unreferenced vertices. Returned maps use our vertex numbers."""
    peers = {name: method for name, method in known_methods().items() if name in PEERS}
    if not peers:
        pytest.skip("neither pyFM nor geomfum is installed: pip install '.[peers]'")
    generator = np.random.default_rng(0)
    order = generator.permutation(300)
    y = random_spectrum(300, 120, seed=1)
    x = Spectrum(y.eigenvalues, y.eigenvectors[order], y.vertex_areas[order], y.mask)
    initial_map = jnp.asarray(np.where(generator.random(300) < 0.3, generator.integers(0, 300, 300), order))
    samples = (jnp.arange(200), jnp.arange(200))
    expected = METHODS["zoomout"](MethodInput(SpectralPair(x, y, samples), initial_map))
    # These spectra have an unreferenced vertex at the beginning, and padding at the end.
    x, y = (
        Spectrum(s.eigenvalues, *(jnp.roll(a, 1, axis=0) for a in (s.eigenvectors, s.vertex_areas, s.mask)))
        for s in (x.pad(320), y.pad(310))
    )
    shifted = jnp.roll(jnp.pad(initial_map + 1, (0, 20)), 1)
    mesh = make_mesh(generator.normal(size=(301, 3)), np.arange(1, 301).reshape(-1, 3))
    for name, peer in peers.items():
        found = peer(MethodInput(SpectralPair(x, y, samples), shifted, (mesh, mesh)))
        found = np.asarray(found)[1:301] - 1
        assert np.mean(found != order) < 0.02
        if name == "pyfm-zoomout":
            np.testing.assert_array_equal(found, expected)


def test_unreferenced_vertices_receive_matches_and_are_never_matches():
    """Methods in NumPy receive meshes in which all vertices are referenced."""
    mesh = bumpy_mesh(2)
    n = len(mesh.vertices)
    stray = make_mesh(np.concatenate([[[5.0, 0, 0]], mesh.vertices, [[0, 9.0, 0]]]), mesh.faces + 1)
    spectrum = compute_spectrum(stray, 20).with_descriptors(jnp.ones((n + 2, 3)))
    order = np.random.default_rng(0).permutation(n)

    class Shuffled(HostMethod):
        def match(self, initial_map, x, y):
            np.testing.assert_array_equal(x.mesh.vertices, mesh.vertices)
            np.testing.assert_array_equal(x.mesh.faces, mesh.faces)
            np.testing.assert_array_equal(initial_map, np.arange(n))
            np.testing.assert_array_equal(y.eigenvectors, np.asarray(spectrum.eigenvectors)[1:-1])
            assert x.descriptors.shape == (n, 3) and x.vertex_areas.shape == (n,)
            return order

    padded = spectrum.pad(n + 20)
    pair = MethodInput(SpectralPair(padded, padded), jnp.arange(n + 20), (stray, stray))
    found = Shuffled()(pair)
    assert found.shape == (n + 2,)
    np.testing.assert_array_equal(found[1:-1], order + 1)
    assert stray.referenced_vertices[found].all()
