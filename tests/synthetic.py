"""Synthetic spectra and simple meshes that several test files share."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from jaxsmw.core.refinement import Refinement, refine, refine_at_once
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.geometry.mesh import Mesh, make_mesh


def random_spectrum(n: int, k: int, *, seed: int = 0, dtype: type = np.float64) -> Spectrum:
    """A spectrum with random eigenvectors, which does not belong to any mesh.

    The eigenvectors are orthonormal with respect to random vertex areas. The eigenvalues grow as Weyl's law
    predicts.
    """
    generator = np.random.default_rng(seed)
    areas = generator.uniform(0.5, 1.5, n)
    areas /= areas.sum()
    orthonormal, _ = np.linalg.qr(generator.normal(size=(n, k)))
    eigenvalues = np.concatenate([[0.0], np.cumsum(generator.uniform(0.5, 1.5, k - 1)) * 4 * np.pi])
    return Spectrum(
        jnp.asarray(eigenvalues, dtype),
        jnp.asarray(orthonormal / np.sqrt(areas)[:, None], dtype),
        jnp.asarray(areas, dtype),
        jnp.ones(n, bool),
    )


def stacked(*trees: Any) -> Any:
    """Stack the arrays of several spectra, or of other trees of equal structure."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


Namespace = Literal["jax", "numpy"]


def to_namespace(tree: Any, name: Namespace) -> Any:
    """Convert the arrays of a tree to JAX or NumPy."""
    return jax.tree.map({"jax": jnp, "numpy": np}[name].asarray, tree)


def refine_in(name: Namespace, *arrays: Any, samples: Any = None, **settings: Any) -> Refinement:
    """Call `refine` for arrays of JAX, or run it at once for the same arrays of NumPy."""
    arrays, samples = to_namespace((arrays, samples), name)
    if name == "jax":
        return refine(*arrays, samples=samples, **settings)
    if not settings.get("refiner", WaveletPreservation()).uses_namespaces:
        pytest.skip("the refiner is written for JAX")
    with np.errstate(all="ignore"):
        return refine_at_once(*arrays, samples=samples, **settings)


def in_precision(tree: Any, dtype: type) -> Any:
    """Convert the floating-point arrays of a tree to another type."""
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype == float else leaf, tree)


def mean_error(mesh: Mesh, pointwise_map: np.ndarray, truth: np.ndarray) -> float:
    """The mean distance between matches and true matches, in units of the square root of the area."""
    offsets = mesh.vertices[pointwise_map] - mesh.vertices[truth]
    return float(np.linalg.norm(offsets, axis=1).mean() / mesh.area**0.5)


def grid_mesh(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a triangulated unit square."""
    y, x = np.mgrid[0 : 1 : rows * 1j, 0 : 1 : columns * 1j]
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns], axis=1)
    upper = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return vertices, np.concatenate([lower, upper])


def sphere_mesh(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of the unit sphere, as an icosahedron whose faces are subdivided.

    The sphere has 10 * 4^subdivisions + 2 vertices.
    """
    golden = (1 + np.sqrt(5)) / 2
    vertices = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    vertices = np.array(
        vertices + [np.roll(v, 1) for v in vertices] + [np.roll(v, 2) for v in vertices], float
    )
    edge = np.linalg.norm(vertices[:, None] - vertices, axis=2)
    near = edge < 2.1
    faces = np.array(
        [
            (a, b, c) if np.linalg.det(vertices[[a, b, c]]) > 0 else (a, c, b)
            for a in range(12)
            for b in range(a + 1, 12)
            for c in range(b + 1, 12)
            if near[a, b] and near[b, c] and near[a, c]
        ]
    )
    for _ in range(subdivisions):
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        unique, position = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
        middle = len(vertices) + position.reshape(3, -1)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        a, b, c = faces.T
        ab, bc, ca = middle
        faces = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
        )
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def spiral_sphere(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of the unit sphere, with any number of vertices along a spiral."""
    height = 1 - (2 * np.arange(number) + 1) / number
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(number)
    radius = np.sqrt(1 - height**2)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    faces = ConvexHull(vertices).simplices.astype(np.int64)
    inward = np.linalg.det(vertices[faces]) < 0
    faces[inward] = faces[inward, ::-1]
    return vertices, faces


def bumpy_mesh(subdivisions: int = 4, *, number: int | None = None) -> Mesh:
    """A sphere that is deformed by waves without symmetry.

    With `number`, it has this number of vertices, and otherwise the vertices of `sphere_mesh`.
    """
    vertices, faces = sphere_mesh(subdivisions) if number is None else spiral_sphere(number)
    waves = np.sin(vertices @ np.random.default_rng(0).normal(size=(3, 12)) * 3) @ np.linspace(0.02, 0.06, 12)
    return make_mesh(vertices * (1 + waves)[:, None], faces)


def vase_mesh(folds: int, *, number: int = 2000) -> Mesh:
    """A round body with `folds` vertical ribs, which a turn by one rib brings onto itself."""
    vertices, faces = spiral_sphere(number)
    around, height = np.arctan2(vertices[:, 1], vertices[:, 0]), vertices[:, 2]
    ribs = 0.3 * (1 - height**2) ** 1.5 * np.cos(folds * around)
    return make_mesh(vertices * (1 + ribs + 0.2 * height - 0.3 * height**2)[:, None] * [1, 1, 1.5], faces)


def body_with_arms(subdivisions: int = 4) -> Mesh:
    """The sphere of `bumpy_mesh` with an arm on the left and an arm on the right."""
    sphere = bumpy_mesh(subdivisions)
    directions = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1, keepdims=True)
    length = 1 + 1.5 * np.exp(-10 * (1 - np.abs(directions[:, 0])))
    return make_mesh(directions * length[:, None], sphere.faces)
