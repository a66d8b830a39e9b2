"""SmoothShells: deforms both surfaces onto each other, from their coarsest smooth shells to the finest.

This module reconstructs the method of Eisenberger, Lähner, Cremers, *Smooth Shells: Multi-Scale Shape
Registration with Functional Maps*, CVPR 2020, arXiv 1905.12512. This implementation was written without the
authors' program. If a step may differ from the paper, the docstring of its function says "our choice".

The smooth shell of level K is a smooth version of a surface. Its positions are the projection of the
surface's positions onto the eigenvectors, and a sigmoid of slope 0.2 removes the frequencies above K:

    S_K = sum_k phi_k <phi_k, x> / (1 + exp(0.2 (k - K)))

The method has two parts:

1. Many initial poses are tried on samples (`_best_matches`). Each pose is a rotation of X. From each pose,
   the shells of both surfaces are aligned from level 6 to level 20. The alignment with the smallest energy
   wins. The energy is the mean squared distance between matched points in the product space.
2. The alignment continues with all vertices from level 20 to level 500 (`_refined`).

Each level takes three steps:

1. The matches give a functional map C and a deformation of the shell, both in the first K eigenvectors. The
   deformation is as rigid as possible (Sorkine, Alexa 2007).
2. The vertices of both surfaces become points of the product space of positions, normals and eigenfunctions
   (`_ProductSpace`). The eigenfunctions of one surface are mapped to the other by C.
3. The new match of each vertex is the nearest vertex in the product space.

Both directions, X onto Y and Y onto X, contribute to the product space (our choice). So do descriptors
(our choice). The paper compares descriptors in the functional map. On two pairs of people, the errors of the
first direction alone are 39 and 71 thousandths. Both directions have errors of 19 and 17 thousandths, and of
14 and 14 thousandths with descriptors.

Each surface has area 1, and its center is the origin. All computations run in NumPy, except for the searches
for nearest vertices, which run in JAX.

`SMOOTH_SHELLS` has the settings of the benchmark: 500 eigenvectors, and 100 initial poses as in the paper.
docs/comparison.md compares its maps with those of the authors' program.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64, Int64
from scipy.spatial.transform import Rotation

from jaxsmw.benchmark.opponents.base import HostMethod, HostShape
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.errors import InputError
from jaxsmw.geometry.alignment import nearest_rotations
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.laplacian import assemble_laplacian
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.runtime.cache import recomputing

# The slope of the sigmoid, and the largest filter value that counts as zero.
_SLOPE, _NEGLIGIBLE = 0.2, 1e-3
# The levels of the initial poses range from _FIRST to _INITIAL. The levels of the refinement range from
# _INITIAL to the number of eigenvectors. From level to level, K grows by these factors.
_FIRST, _INITIAL = 6, 20
_INITIAL_GROWTH, _GROWTH = 1.3, 1.2
# The numbers of samples of X and of Y for the initial poses.
_SAMPLES = (400, 800)
# The weights in the product space. Positions have weight 1. Each eigenfunction is divided by
# sqrt(1 + eigenvalue). The weight of the descriptors is _DESCRIPTORS up to level _INITIAL, and then falls
# like 1 / K. A larger weight at the first levels gave wrong poses.
_NORMALS, _EIGENFUNCTIONS, _DESCRIPTORS = 0.03, 0.5, 0.1
# The weight of the as-rigid-as-possible energy, and the number of its minimisations at each level.
_RIGIDITY, _ROUNDS = 1e-3, 2
# The ridge of least-squares fits on samples, relative to the number of samples.
_RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class _UnitSurface:
    """A shape of area 1, whose center is the origin."""

    mesh: Mesh
    positions: Float64[np.ndarray, "n 3"]
    eigenvalues: Float64[np.ndarray, " k"]
    eigenvectors: Float64[np.ndarray, "n k"]
    dual: Float64[np.ndarray, "n k"]  # `dual.T` computes coefficients
    descriptors: Float64[np.ndarray, "n c"]  # with mean square 1
    differences: sp.csr_array  # row e (e, n) is the difference between the ends of edge e
    weights: Float64[np.ndarray, " e"]  # cotangent weights

    @classmethod
    def of(
        cls, mesh: Mesh, descriptors: Float[np.ndarray, "n c"], number_of_eigenvectors: int
    ) -> _UnitSurface:
        spectrum = compute_spectrum(mesh, number_of_eigenvectors)
        areas = np.asarray(spectrum.vertex_areas, np.float64)
        eigenvectors = np.asarray(spectrum.eigenvectors, np.float64)
        positions = mesh.vertices / np.sqrt(mesh.area)
        above = sp.coo_array(sp.triu(assemble_laplacian(mesh)[0], 1))
        # Edges with negative weights are left out (our choice). With them, the energy would have no minimum.
        kept = above.data < 0
        ends = np.stack([above.row[kept], above.col[kept]], axis=1)
        rows = np.repeat(np.arange(len(ends)), 2)
        entries = np.tile([1.0, -1.0], len(ends))
        return cls(
            mesh,
            positions - areas @ positions / areas.sum(),
            np.asarray(spectrum.eigenvalues, np.float64),
            eigenvectors,
            eigenvectors * areas[:, None],
            np.asarray(descriptors, np.float64),
            sp.csr_array((entries, (rows, ends.ravel())), shape=(len(ends), len(positions))),
            -above.data[kept],
        )

    def shell(self, level: int) -> _Shell:
        numbers = np.arange(1, len(self.eigenvalues) + 1)
        filters = 1 / (1 + np.exp(np.minimum(_SLOPE * (numbers - level), 50)))
        used = filters > _NEGLIGIBLE
        coefficients = filters[used, None] * (self.dual[:, used].T @ self.positions)
        positions = self.eigenvectors[:, used] @ coefficients
        first = slice(level)
        return _Shell(
            self.eigenvalues[first],
            self.eigenvectors[:, first],
            self.dual[:, first],
            positions,
            self.normals(positions),
            self.descriptors,
        )

    def normals(self, positions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return the unit normal of each vertex after the vertices moved to new positions."""
        return replace(self.mesh, vertices=positions).vertex_normals

    def rotations_to(
        self, positions: Float64[np.ndarray, "n 3"], moved: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3 3"]:
        """Return, for each vertex, the rotation that best turns its edges into its moved edges."""
        before, after = self.differences @ positions, self.differences @ moved
        products = self.weights[:, None] * (after[:, :, None] * before[:, None, :]).reshape(-1, 9)
        return nearest_rotations((abs(self.differences).T @ products).reshape(-1, 3, 3))[0]

    def turned_laplacian(
        self, positions: Float64[np.ndarray, "n 3"], rotations: Float64[np.ndarray, "n 3 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Return the Laplacian of positions whose edges are turned by the mean rotation of their ends."""
        means = 0.5 * (abs(self.differences) @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        turned = np.einsum("eij,ej->ei", means, self.differences @ positions)
        return self.differences.T @ (self.weights[:, None] * turned)


class _Shell(NamedTuple):
    """The smooth shell of level K at s vertices, which are all vertices or samples."""

    eigenvalues: Float64[np.ndarray, " K"]
    eigenvectors: Float64[np.ndarray, "s K"]
    dual: Float64[np.ndarray, "s K"]
    positions: Float64[np.ndarray, "s 3"]
    normals: Float64[np.ndarray, "s 3"]
    descriptors: Float64[np.ndarray, "s c"]

    @property
    def level(self) -> int:
        """K."""
        return len(self.eigenvalues)

    @property
    def points(self) -> Float64[np.ndarray, "s d"]:
        """The weighted positions, normals and eigenfunctions of the vertices."""
        smooth = self.eigenvectors / np.sqrt(1 + self.eigenvalues)
        return np.hstack([self.positions, _NORMALS * self.normals, _EIGENFUNCTIONS * smooth])

    @property
    def weighted_descriptors(self) -> Float64[np.ndarray, "s c"]:
        """The descriptors, multiplied by the weight that they have at level K."""
        return _DESCRIPTORS * min(1, _INITIAL / self.level) * self.descriptors

    def sample(self, rows: Int64[np.ndarray, " r"]) -> _Shell:
        """Return the shell at some of its vertices. Coefficients are then least-squares fits."""
        kept = self.eigenvectors[rows]
        gram = kept.T @ kept + _RIDGE * len(rows) * np.eye(self.level)
        dual = np.linalg.solve(gram, kept.T).T
        arrays = (self.positions, self.normals, self.descriptors)
        return _Shell(self.eigenvalues, kept, dual, *(array[rows] for array in arrays))

    def coefficients_after(
        self, targets: Float64[np.ndarray, "s 3"], rigid: Float64[np.ndarray, "K 3"]
    ) -> Float64[np.ndarray, "K 3"]:
        """Return the coefficients of positions that are near `targets` and as rigid as possible."""
        # The positions p minimise `|p - targets|^2` plus `_RIGIDITY` times a Dirichlet energy, at whose
        # minimum the Laplacian has the coefficients `rigid`. In the eigenvectors, the system is diagonal.
        fitted = self.dual.T @ targets
        return (fitted + _RIGIDITY * rigid) / (1 + _RIGIDITY * self.eigenvalues[:, None])


class _Matches(NamedTuple):
    """The matches of vertices of X on Y (s_x,), and of vertices of Y on X (s_y,)."""

    forward: Int64[np.ndarray, " s_x"]
    backward: Int64[np.ndarray, " s_y"]


class _ProductSpace(NamedTuple):
    """Points of X (s_x, d) and of Y (s_y, d). Matched vertices should have the same point."""

    x: Float64[np.ndarray, "s_x d"]
    y: Float64[np.ndarray, "s_y d"]

    @classmethod
    def of(
        cls,
        shells: tuple[_Shell, _Shell],
        moved_x: Float64[np.ndarray, "s_x d"],
        moved_y: Float64[np.ndarray, "s_y d"],
    ) -> _ProductSpace:
        """Return the product space of two shells and of the points to which their vertices moved."""
        x, y = shells
        return cls(
            np.hstack([moved_x, x.points, x.weighted_descriptors]),
            np.hstack([y.points, moved_y, y.weighted_descriptors]),
        )

    def matches(self) -> _Matches:
        """Return the nearest neighbours in both directions."""
        return _Matches(_nearest(self.x, self.y), _nearest(self.y, self.x))

    def energy(self, matches: _Matches) -> float:
        """Return the mean squared distance between matched points, summed over both directions."""
        forward = ((self.x - self.y[matches.forward]) ** 2).sum(axis=1).mean()
        return float(forward + ((self.y - self.x[matches.backward]) ** 2).sum(axis=1).mean())


def smooth_shells(
    mesh_x: Mesh,
    mesh_y: Mesh,
    descriptors_x: Float[np.ndarray, "m c"],
    descriptors_y: Float[np.ndarray, "n c"],
    *,
    number_of_eigenvectors: int = 500,
    proposals: int = 100,
    seed: int = 0,
) -> Int64[np.ndarray, " m"]:
    """Match two shapes with SmoothShells (Eisenberger, Lähner, Cremers 2020).

    **Arguments:**

    - `mesh_x`, `mesh_y`: the meshes of X (m vertices) and of Y (n vertices), without unreferenced vertices.
    - `descriptors_x`, `descriptors_y`: comparable descriptors of X (m, c) and of Y (n, c), each with mean
      square 1, such as principal components of SHOT.
    - `number_of_eigenvectors`: the last level, at least 1. Meshes with fewer vertices have fewer levels.
    - `proposals`: the number of initial poses, at least 1. The first pose is the given pose of X. All other
      poses are uniformly random rotations (our choice; the paper draws a Markov chain of deformations).
    - `seed`: the seed of the random rotations.

    **Returns:** The map X -> Y (m,), 0-based vertices of Y.

    **Raises:** `InputError` if `number_of_eigenvectors` or `proposals` is less than 1, or if a mesh has too
    few vertices.
    """
    if number_of_eigenvectors < 1 or proposals < 1:
        raise InputError(
            f"SmoothShells was called with {number_of_eigenvectors} eigenvectors and {proposals} initial "
            "poses: give at least 1 of each."
        )
    count = min(number_of_eigenvectors, len(mesh_x.vertices) - 1, len(mesh_y.vertices) - 1)
    surfaces = _UnitSurface.of(mesh_x, descriptors_x, count), _UnitSurface.of(mesh_y, descriptors_y, count)
    first = min(_INITIAL, count)
    return _refined(surfaces, first, count, _best_matches(surfaces, first, proposals, seed)).forward


def _levels(first: int, last: int, growth: float) -> Iterator[int]:
    """Yield levels that grow from `first` to `last`, each by the factor `growth` or at least by 1."""
    level = min(first, last)
    yield level
    while level < last:
        level = min(last, max(level + 1, round(level * growth)))
        yield level


def _nearest(queries: Float64[np.ndarray, "s d"], database: Float64[np.ndarray, "r d"]) -> np.ndarray:
    """Return, for each query, the index of the nearest row of the database."""
    both = (points.astype(np.float32) for points in (queries, database))
    return np.asarray(nearest_neighbor(*both)).astype(np.int64)


def _mapped(x: _Shell, y: _Shell, matches: Int64[np.ndarray, " s"]) -> Float64[np.ndarray, "K d"]:
    """Return the coefficients of the points of Y's shell to which the vertices of X are matched."""
    return x.dual.T @ y.points[matches]


def _best_matches(
    surfaces: tuple[_UnitSurface, _UnitSurface], last: int, proposals: int, seed: int
) -> _Matches:
    """Try initial poses on samples, and return the matches of all vertices from the best pose."""
    samples_x, samples_y = (
        farthest_point_samples(surface.mesh, min(number, len(surface.positions)))
        for surface, number in zip(surfaces, _SAMPLES, strict=True)
    )
    x, y = surfaces
    sampled = [
        (x.shell(level).sample(samples_x), y.shell(level).sample(samples_y))
        for level in _levels(_FIRST, last, _INITIAL_GROWTH)
    ]
    random = Rotation.random(proposals - 1, rng=seed).as_matrix() if proposals > 1 else []
    poses = [_aligned(sampled, rotation) for rotation in (np.eye(3), *random)]
    best, _ = min(poses, key=lambda pose: pose[1])
    shells, few = (x.shell(last), y.shell(last)), sampled[-1]
    return _Matches(
        _extended(*shells, *few, best.forward), _extended(*shells[::-1], *few[::-1], best.backward)
    )


def _extended(
    x: _Shell, y: _Shell, few_x: _Shell, few_y: _Shell, matches: Int64[np.ndarray, " s"]
) -> Int64[np.ndarray, " m"]:
    """Extend matches of samples to all vertices. The coefficients of the matches give a smooth map."""
    mapped = x.eigenvectors @ _mapped(few_x, few_y, matches)
    return _nearest(
        np.hstack([mapped, x.weighted_descriptors]), np.hstack([y.points, y.weighted_descriptors])
    )


def _aligned(
    sampled: Sequence[tuple[_Shell, _Shell]], rotation: Float64[np.ndarray, "3 3"]
) -> tuple[_Matches, float]:
    """Align the shells of the samples after a rotation of X. Return the matches and their energy."""

    # The rotation of X is known, so the deformation need not estimate rotations (our choice). The deformation
    # is near to the rotated shell in the same Dirichlet energy as in `_refined`.
    def turned(shell: _Shell, turn: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "s d"]:
        return shell._replace(positions=shell.positions @ turn.T, normals=shell.normals @ turn.T).points

    def moved(
        x: _Shell, y: _Shell, matches: Int64[np.ndarray, " s"], turn: Float64[np.ndarray, "3 3"]
    ) -> Float64[np.ndarray, "s d"]:
        rigid = x.eigenvalues[:, None] * (x.dual.T @ x.positions @ turn.T)
        coefficients = _mapped(x, y, matches)
        coefficients[:, :3] = x.coefficients_after(y.positions[matches], rigid)
        points = x.eigenvectors @ coefficients
        lengths = np.linalg.norm(points[:, 3:6], axis=1, keepdims=True)
        points[:, 3:6] *= _NORMALS / np.maximum(lengths, np.finfo(float).tiny)
        return points

    # The first matches compare only positions, normals and descriptors, because C is unknown.
    x, y = sampled[0]
    space = _ProductSpace(
        np.hstack([turned(x, rotation)[:, :6], x.weighted_descriptors]),
        np.hstack([y.points[:, :6], y.weighted_descriptors]),
    )
    matches = space.matches()
    for x, y in sampled:
        space = _ProductSpace.of(
            (x, y), moved(x, y, matches.forward, rotation), moved(y, x, matches.backward, rotation.T)
        )
        matches = space.matches()
    return matches, space.energy(matches)


def _refined(
    surfaces: tuple[_UnitSurface, _UnitSurface], first: int, last: int, matches: _Matches
) -> _Matches:
    """Align the shells of all vertices, level by level, and return the matches of the last level."""
    moved: list[Float64[np.ndarray, "s 3"]] | None = None
    for level in _levels(first, last, _GROWTH):
        shells = surfaces[0].shell(level), surfaces[1].shell(level)
        both = list(zip(surfaces, shells, shells[::-1], matches, strict=True))
        if moved is None:
            moved = [x.eigenvectors @ (x.dual.T @ y.positions[images]) for _, x, y, images in both]
        moved = [
            _as_rigid_as_possible(surface, x, y.positions[images], positions)
            for (surface, x, y, images), positions in zip(both, moved, strict=True)
        ]
        points = []
        for (surface, x, y, images), positions in zip(both, moved, strict=True):
            mapped = x.eigenvectors @ _mapped(x, y, images)[:, 6:]
            points.append(np.hstack([positions, _NORMALS * surface.normals(positions), mapped]))
        matches = _ProductSpace.of(shells, *points).matches()
    return matches


def _as_rigid_as_possible(
    surface: _UnitSurface,
    shell: _Shell,
    targets: Float64[np.ndarray, "s 3"],
    positions: Float64[np.ndarray, "s 3"],
) -> Float64[np.ndarray, "s 3"]:
    """Move a shell near to target positions, as rigidly as possible (Sorkine, Alexa 2007)."""
    for _ in range(_ROUNDS):
        rotations = surface.rotations_to(shell.positions, positions)
        rigid = shell.eigenvectors.T @ surface.turned_laplacian(shell.positions, rotations)
        positions = shell.eigenvectors @ shell.coefficients_after(targets, rigid)
    return positions


@dataclass(frozen=True)
class SmoothShells(HostMethod):
    """A method that ignores the initial map, and matches both shapes with `smooth_shells`.

    The time of the method includes the computation of its `last_level` eigenvectors, which no other method
    uses.
    """

    reference: str
    number_of_eigenvectors: int = 1
    number_of_descriptors: int = 15
    last_level: int = 500

    def match(
        self, initial_map: Int64[np.ndarray, " u"], x: HostShape, y: HostShape
    ) -> Int64[np.ndarray, " u"]:
        descriptors = (shape.descriptors[:, : self.number_of_descriptors] for shape in (x, y))
        with recomputing():
            return smooth_shells(x.mesh, y.mesh, *descriptors, number_of_eigenvectors=self.last_level)


SMOOTH_SHELLS = SmoothShells(
    "our reconstruction of Eisenberger, Lähner, Cremers 2020: 500 eigenvectors, 100 initial poses"
)
