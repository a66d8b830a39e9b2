"""Refinement by registration: each surface is deformed onto the other, from low to high frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int32

from jaxsmw.core.arrays import Array, fori_loop, namespace
from jaxsmw.core.functional_map import dual_eigenvectors
from jaxsmw.core.linear_algebra import product, solve_positive_definite
from jaxsmw.core.module import field
from jaxsmw.core.refiner import Prepared, Problem, Samples
from jaxsmw.core.refiners.coarse_to_fine import (
    CoarseToFine,
    CoarseToFineState,
    check_features,
    partial_matching_weights,
)
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import SearchProblem, nearest_in_both, nearest_neighbor
from jaxsmw.core.spectrum import Spectrum

# Positions have weight 1, in units of the square root of the area. _NORMALS is the weight of unit normals.
# _EIGENFUNCTIONS is the weight of the first _NUMBER_OF_EIGENFUNCTIONS eigenfunctions, each of which is
# divided by sqrt(1 + eigenvalue).
_NORMALS, _EIGENFUNCTIONS, _NUMBER_OF_EIGENFUNCTIONS = 0.02, 0.2, 50
# Each descriptor has mean square 1. The weight of descriptors is _DESCRIPTORS / level**_FALLING. Descriptors
# therefore outweigh positions at low levels and have little effect at the last level.
_DESCRIPTORS, _FALLING = 2.8, 1.5
# Heat flow of duration _HEAT_TIME averages over a disk around each vertex. The radius of the disk is 0.1
# times the square root of the area. If the spectrum has few eigenvectors, the duration is longer, because
# heat flow must reduce the last eigenvector to at most exp(-_DECAY) times its size.
_HEAT_TIME, _DECAY = 3e-3, 4.0
# _RIDGE is the ridge of the least-squares fit on partial shapes, relative to the mean diagonal entry of the
# gram matrix.
_RIDGE = 1e-3
# `_nearest_rotations` squares each matrix _SQUARINGS times. The result is nearly the projection onto the
# eigenvector of the largest eigenvalue.
_SQUARINGS = 12


class Registration(CoarseToFine["PreparedSurfaces", "Registered"]):
    """A refiner that deforms X onto Y, and Y onto X, from low to high frequencies.

    In each iteration, the positions of the matches are projected onto the first eigenvectors. The projected
    positions form the smooth part of the deformed surface. The number of eigenvectors increases as in smooth
    shells (Eisenberger, Lähner, Cremers 2020). The details of the original surface are rotated and added to
    the smooth part. Each vertex has its own rotation, as in as-rigid-as-possible deformation (Sorkine, Alexa
    2007). Heat flow averages over the neighbourhood of each vertex, and the best rotation is computed from
    these averages. If one shape is a mirror image of the other, all rotations include a reflection. On
    samples and on partial shapes, eigenvectors are not orthonormal, so coefficients are computed by least
    squares. On full shapes without samples, no linear system is solved.

    The next matches are the nearest vertices in a joint space of both surfaces. The coordinates of this space
    are positions, normals, the first eigenfunctions, and descriptors if the spectra have them. The weight of
    the descriptors decreases as the number of eigenvectors increases.

    The initial map must be nearly correct. From a nearly correct map, `Registration` gives a more accurate
    map than refiners that use only eigenfunctions (docs/accuracy.md). Both spectra must contain positions and
    normals, which `jaxsmw.compute_spectrum` computes and `Spectrum.with_positions` adds.

    Both shapes are scaled to area 1. Partial pairs are scaled by a common factor instead, and vertices of the
    full shape with large residuals receive smaller weights (`partial_matching_weights`). A residual is the
    squared distance from a vertex to its match in the joint space, without descriptors.

    **Arguments:** `levels`, which `CoarseToFine` describes.
    """

    @property
    def uses_namespaces(self) -> bool:
        """Always True."""
        return True

    def prepare(self, problem: Problem) -> PreparedSurfaces:
        """Scale both surfaces and prepare the search.

        **Raises:** `ValueError` if a spectrum has no positions or no normals, or if the shapes have different
        numbers of descriptors.
        """
        spectrum_x, spectrum_y = problem.spectrum_x, problem.spectrum_y
        check_features(spectrum_x, spectrum_y)
        xp = namespace(spectrum_x.eigenvectors)
        areas = [xp.sum(spectrum.vertex_areas) for spectrum in (spectrum_x, spectrum_y)]
        if problem.partial:
            areas = [xp.maximum(*areas)] * 2
        all_x, all_y = _Surface.of(spectrum_x, areas[0]), _Surface.of(spectrum_y, areas[1])
        x, y = all_x, all_y
        spectrum_x, spectrum_y = problem.query_spectra()
        if problem.samples is not None:
            x = all_x.sample(spectrum_x, problem.samples[0])
            y = all_y.sample(spectrum_y, problem.samples[1])
        return PreparedSurfaces(spectrum_x, spectrum_y, x, y, all_x, all_y, problem.samples, problem.partial)

    def update(
        self, prepared: PreparedSurfaces, pointwise_map: Int[Array, " m"], previous: Registered | None
    ) -> tuple[Registered, RESULTS]:
        """Compute the deformations from the matches. Return the next state and `RESULTS.successful`."""
        x, y, all_x, all_y = prepared.x, prepared.y, prepared.all_x, prepared.all_y
        xp = namespace(pointwise_map)
        iteration = xp.asarray(0, xp.int32) if previous is None else previous.iteration + 1
        active_x, active_y = self.active_eigenvectors(prepared, iteration)
        level = xp.maximum(xp.sum(active_x), xp.sum(active_y)).astype(x.weights.dtype)
        weight = _DESCRIPTORS / level**_FALLING
        if previous is None:
            # Y is not deformed yet, so the first reverse map uses only the deformation of X.
            (forward,) = _deformations(_Matched(x, all_y, pointwise_map, active_x))
            (deformed,) = _deformed((forward, all_x))
            reverse_map = nearest_neighbor(y.points, deformed, database_mask=all_x.mask)
            (backward,) = _deformations(_Matched(y, all_x, reverse_map, active_y))
        else:
            assert previous.reverse_map is not None  # `recover_both` adds it
            reverse_map = previous.reverse_map
            if prepared.partial:
                x, y = _without_missing_parts(prepared, previous, pointwise_map, reverse_map)
            forward, backward = _deformations(
                _Matched(x, all_y, pointwise_map, active_x), _Matched(y, all_x, reverse_map, active_y)
            )
        functional_map = x.coefficients(all_y.eigenvectors[pointwise_map])
        state = Registered(functional_map, iteration, forward, backward, weight)
        return state, RESULTS.successful

    def recover(self, prepared: PreparedSurfaces, state: Registered) -> Int32[Array, " m"]:
        """Return, for each vertex of X, the nearest vertex of Y in the `embeddings`, (m,)."""
        queries, database = self.embeddings(prepared, state)
        return nearest_neighbor(queries, database, database_mask=prepared.all_y.mask)

    def recover_both(
        self, prepared: PreparedSurfaces, state: Registered
    ) -> tuple[Int32[Array, " m"], Registered]:
        """Return the result of `recover` (m,), and the state with the `reverse_map` of Y's vertices."""
        points_x, points_y = _product_space(prepared.all_x, prepared.all_y, state, state.descriptor_weight)
        queries_x, queries_y = points_x, points_y
        if prepared.samples is not None:
            queries_x, queries_y = (
                points[rows] for points, rows in zip((points_x, points_y), prepared.samples, strict=True)
            )
        pointwise_map, reverse_map = nearest_in_both(
            SearchProblem(queries_x, points_y, prepared.all_y.mask),
            SearchProblem(queries_y, points_x, prepared.all_x.mask),
        )
        return pointwise_map, replace(state, reverse_map=reverse_map)

    def recover_reverse(self, prepared: PreparedSurfaces, state: Registered) -> Int32[Array, " n"]:
        """Return, for each vertex of Y, the nearest vertex of X in the `embeddings`, (n,)."""
        database, queries = self.embeddings(prepared, state)
        return nearest_neighbor(queries, database, database_mask=prepared.x.mask)

    def energy(
        self, prepared: PreparedSurfaces, state: Registered, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Return the `objective` at `pointwise_map`, the map from which the state was computed."""
        return self.objective(prepared, state, pointwise_map)

    def embeddings(
        self, prepared: PreparedSurfaces, state: Registered
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Return points in the joint space of both surfaces, (m, d) for X and (n, d) for Y.

        Each point contains the weighted position, normal and eigenfunctions of a vertex twice, after
        deformation and without deformation. The weighted descriptors of the vertex follow. The deformation of
        X is in the first coordinates, and that of Y in the second. Positions are in units of the square root
        of the area.
        """
        return _product_space(prepared.x, prepared.all_y, state, state.descriptor_weight)


class _Surface(NamedTuple):
    """The data of all vertices of a shape, or only of the samples.

    Positions are in units of the square root of the area. `points` contains the positions, normals and
    eigenfunctions, multiplied by their weights. `dual` is the transposed pseudo-inverse of the
    eigenvectors. It is None for all vertices, whose eigenvectors are orthonormal with the weights `areas`.
    """

    eigenvectors: Float[Array, "n k"]
    dual: Float[Array, "n k"] | None
    areas: Float[Array, " n"]
    weights: Float[Array, " n"]
    heat: Float[Array, " k"]
    time: Float[Array, ""]
    positions: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    points: Float[Array, "n d"]
    descriptors: Float[Array, "n c"]
    mask: Bool[Array, " n"]

    @classmethod
    def of(cls, spectrum: Spectrum, area: Float[Array, ""]) -> _Surface:
        """Return the surface of a spectrum. Lengths are divided by the square root of `area`."""
        if spectrum.positions is None or spectrum.normals is None:
            raise ValueError(
                "Registration needs positions and normals, but a spectrum lacks them: use compute_spectrum, "
                "which provides them, or add them by Spectrum.with_positions"
            )
        xp, dtype = namespace(spectrum.eigenvectors), spectrum.eigenvectors.dtype
        weights = spectrum.vertex_areas / xp.sum(spectrum.vertex_areas)
        center = product(weights, spectrum.positions)
        positions = (spectrum.positions - center[None]) / xp.sqrt(area)
        eigenvalues, eigenvectors = spectrum.eigenvalues * area, spectrum.eigenvectors * xp.sqrt(area)
        first = slice(min(_NUMBER_OF_EIGENFUNCTIONS, eigenvalues.shape[0]))
        smooth = eigenvectors[:, first] / xp.sqrt(1 + eigenvalues[None, first])
        points = [positions, _NORMALS * spectrum.normals, _EIGENFUNCTIONS * smooth]
        last = eigenvalues[-1]
        time = xp.maximum(_HEAT_TIME, xp.where(last > 0, _DECAY / last, 0))
        return cls(
            spectrum.eigenvectors,
            None,
            spectrum.vertex_areas,
            weights,
            xp.exp(-time * eigenvalues),
            time,
            positions,
            spectrum.normals,
            xp.concatenate(points, axis=1).astype(dtype),
            xp.zeros((len(weights), 0), dtype) if spectrum.descriptors is None else spectrum.descriptors,
            spectrum.mask,
        )

    def sample(self, spectrum: Spectrum, vertices: Int[Array, " s"]) -> _Surface:
        """Return the data of the given vertices (s,), of which `spectrum` is the spectrum."""
        dual = dual_eigenvectors(spectrum, "least_squares")
        weights = namespace(vertices).full(vertices.shape, 1 / vertices.shape[0], self.weights.dtype)
        fields = (self.positions, self.normals, self.points, self.descriptors, self.mask)
        return _Surface(
            spectrum.eigenvectors,
            dual,
            weights,
            weights,
            self.heat,
            self.time,
            *(field[vertices] for field in fields),
        )

    def coefficients(self, functions: Float[Array, "n c"]) -> Float[Array, "k c"]:
        """Return the coefficients of functions in the eigenvectors."""
        if self.dual is None:  # An array `dual` of all vertices would take as much memory as `eigenvectors`.
            return product(self.eigenvectors.T, functions * self.areas[:, None])
        return product(self.dual.T, functions)

    def reweighted(self, weights: Float[Array, " s"]) -> _Surface:
        """Return the same vertices with new weights for the least-squares fit of coefficients."""
        weighted = self.eigenvectors * weights[:, None]
        gram = product(self.eigenvectors.T, weighted)
        xp = namespace(gram)
        ridge = _RIDGE * xp.trace(gram) / gram.shape[0] * xp.eye(gram.shape[0], dtype=gram.dtype)
        return self._replace(dual=solve_positive_definite(gram + ridge, weighted.T).T)


class PreparedSurfaces(Prepared):
    """The vertices to be matched (`x`, `y`), and all vertices (`all_x`, `all_y`)."""

    x: _Surface
    y: _Surface
    all_x: _Surface
    all_y: _Surface
    samples: Samples | None
    partial: bool = field(static=True)


class Deformation(NamedTuple):
    """A deformation of one surface onto another, as coefficients in the eigenvectors of the first surface.

    `own` are the coefficients of its positions, and `matched` those of the positions, normals and
    eigenfunctions of the matches, zero for inactive eigenvectors. `moments` are the coefficients of 24
    functions that heat flow has smoothed: positions, matched positions, the products of positions with
    matched positions, and the products of normals with matched normals. Positions are in units of the square
    root of the area.
    """

    own: Float[Array, "k_x 3"]
    matched: Float[Array, "k_x d"]
    moments: Float[Array, "k_x 24"]


class _Matched(NamedTuple):
    """A surface, all vertices of the other surface, and the matches from which a deformation follows."""

    surface: _Surface
    other: _Surface
    matches: Int[Array, " s"]
    active: Bool[Array, " k"]


def _deformations(*given: _Matched) -> list[Deformation]:
    """Compute the deformation of each surface onto its other surface.

    Most rows of all surfaces form one array, because JAX would take twice as long to compile two arrays.
    """

    def products(own: Float[Array, "s 3"], matched: Float[Array, "s 3"]) -> Float[Array, "s 9"]:
        return (own[:, :, None] * matched[:, None, :]).reshape(-1, 9)

    xp = namespace(given[0].surface.positions)
    surfaces = [one.surface for one in given]
    points = [one.other.points[one.matches] for one in given]
    own = xp.concatenate([surface.positions for surface in surfaces])
    matched = xp.concatenate([rows[:, :3] for rows in points])
    normals = xp.concatenate([surface.normals for surface in surfaces])
    matched_normals = xp.concatenate([one.other.normals[one.matches] for one in given])
    averaged = xp.concatenate(
        [own, matched, products(own, matched), products(normals, matched_normals)], axis=1
    )
    found = []
    for one, rows, of_matches in zip(given, _split(averaged, surfaces), points, strict=True):
        coefficients = one.surface.coefficients(xp.concatenate([rows, of_matches], axis=1))
        active = xp.where(one.active[:, None], coefficients, 0)
        moments = one.surface.heat[:, None] * coefficients[:, :24]
        found.append(Deformation(active[:, :3], active[:, 24:], moments))
    return found


def _split(rows: Float[Array, "r ..."], surfaces: Sequence[_Surface]) -> list[Float[Array, "_ ..."]]:
    """Divide an array that contains the rows of several surfaces, one surface after the other."""
    return namespace(rows).split(rows, np.cumsum([len(surface.weights) for surface in surfaces])[:-1])


class Registered(CoarseToFineState):
    """The state of `Registration`: the deformations of X onto Y (`forward`) and of Y onto X (`backward`).

    `descriptor_weight` is the weight of descriptors relative to positions.
    """

    forward: Deformation
    backward: Deformation
    descriptor_weight: Float[Array, ""]


def _product_space(
    x: _Surface, y: _Surface, state: Registered, weight: Float[Array, ""]
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    """Return points in the joint space of both surfaces; see `Registration.embeddings`.

    The points of two vertices x and y are close together if the deformed x is close to y on Y, and the
    deformed y is close to x on X.
    """
    deformed_x, deformed_y = _deformed((state.forward, x), (state.backward, y))
    xp = namespace(x.points)
    return (
        xp.concatenate([deformed_x, x.points, weight * x.descriptors], axis=1),
        xp.concatenate([y.points, deformed_y, weight * y.descriptors], axis=1),
    )


def _deformed(*given: tuple[Deformation, _Surface]) -> list[Float[Array, "_ d"]]:
    """Return the weighted positions, normals and eigenfunctions (s, d) of the vertices after deformation.

    Most rows of all surfaces form one array, as in `_deformations`.
    """
    surfaces = [surface for _, surface in given]
    xp = namespace(surfaces[0].positions)
    low = [product(surface.eigenvectors, xp.concatenate(deformed, axis=1)) for deformed, surface in given]

    def together(columns: slice) -> Float[Array, "r c"]:
        return xp.concatenate([rows[:, columns] for rows in low])

    rotations = _rotations(together(slice(-24, None)), surfaces)
    details = xp.concatenate([surface.positions for surface in surfaces]) - together(slice(3))
    normals = xp.concatenate([surface.normals for surface in surfaces])
    details, normals = (xp.sum(rotations * vectors[:, None, :], axis=2) for vectors in (details, normals))
    turned = xp.concatenate([together(slice(3, 6)) + details, _NORMALS * normals], axis=1)
    # Each row of `low` contains the own position, the position, normal and eigenfunctions of the match, and
    # the moments.
    return [
        xp.concatenate([rows, smooth[:, 9:-24]], axis=1)
        for rows, smooth in zip(_split(turned, surfaces), low, strict=True)
    ]


def _without_missing_parts(
    prepared: PreparedSurfaces,
    state: Registered,
    pointwise_map: Int[Array, " s"],
    reverse_map: Int[Array, " t"],
) -> tuple[_Surface, _Surface]:
    """Return both surfaces, with the vertex weights of `partial_matching_weights`."""
    x, y = prepared.x, prepared.y
    xp = namespace(state.descriptor_weight)
    no_descriptors = xp.zeros_like(state.descriptor_weight)
    targets, queries = _product_space(prepared.all_x, y, state, no_descriptors)
    residuals_y = xp.sum((queries - targets[reverse_map]) ** 2, axis=1)
    queries, targets = _product_space(x, prepared.all_y, state, no_descriptors)
    residuals_x = xp.sum((queries - targets[pointwise_map]) ** 2, axis=1)
    weights_x, weights_y = partial_matching_weights(x.weights, residuals_x, y.weights, residuals_y)
    return x.reweighted(weights_x), y.reweighted(weights_y)


def _rotations(moments: Float[Array, "r 24"], surfaces: Sequence[_Surface]) -> Float[Array, "r 3 3"]:
    """Return the rotations that best align the neighbourhoods of vertices with those of their matches.

    If one surface is a mirror image of the other, all rotations include a reflection.
    """
    xp = namespace(moments)
    own, matched = moments[:, :3], moments[:, 3:6]
    products, normals = (part.reshape(-1, 3, 3) for part in (moments[:, 6:15], moments[:, 15:]))
    # The moments are averages, weighted by the heat kernel around each vertex. In each direction of the
    # tangent plane, the weighted variance of positions is twice the heat time. After the division by twice
    # the heat time, the variance is 1, like the squared length of a unit normal.
    times = xp.concatenate([xp.broadcast_to(one.time, one.weights.shape) for one in surfaces])
    variances = (products - own[:, :, None] * matched[:, None, :]) / (2 * times[:, None, None])
    covariances = variances + normals
    weights = xp.concatenate([surface.weights for surface in surfaces])
    signs = [
        xp.where(xp.sum(rows) < 0, -xp.ones_like(rows), xp.ones_like(rows))
        for rows in _split(weights * _determinants(covariances), surfaces)
    ]
    sign = xp.concatenate(signs)[:, None, None]
    return sign * _nearest_rotations(sign * covariances)


def _determinants(matrices: Float[Array, "s 3 3"]) -> Float[Array, " s"]:
    a, b, c = (matrices[:, row] for row in range(3))
    return namespace(matrices).sum(a * namespace(matrices).linalg.cross(b, c), axis=1)


def _nearest_rotations(covariances: Float[Array, "s 3 3"]) -> Float[Array, "s 3 3"]:
    """Return, for each covariance S, the rotation R that maximises the trace of R S (Horn 1987).

    The trace is a quadratic form in the unit quaternion of R. The best quaternion is the eigenvector for the
    largest eigenvalue of this form.
    """
    xp = namespace(covariances)
    table = xp.asarray(_rotations_of_quaternions(), covariances.dtype)
    quadratic = product(covariances.mT.reshape(-1, 9), table)
    sizes = xp.sqrt(xp.sum(quadratic**2, axis=1))[None]
    # Adding the identity makes all eigenvalues non-negative, so the largest eigenvalue dominates the powers
    # of the matrix. The vertices are on the last axis, along which processors compute several at once.
    identity = xp.eye(4, dtype=covariances.dtype).reshape(16, 1)
    powers = quadratic.T / xp.where(sizes > 0, sizes, 1) + identity
    powers = fori_loop(_SQUARINGS, lambda _, powers: _squared(powers), powers)
    largest = xp.argmax(powers[::5], axis=0)
    each = xp.arange(len(largest))
    quaternions = powers.reshape(4, 4, -1)[largest, :, each].T
    products = (quaternions[:, None] * quaternions[None]).reshape(16, -1)
    products = products / xp.sum(quaternions**2, axis=0)[None]
    return product(products.T, table.T).reshape(-1, 3, 3)


def _squared(matrices: Float[Array, "16 s"]) -> Float[Array, "16 s"]:
    """Return the squares of symmetric matrices (4, 4), divided by their traces."""
    row = matrices.reshape(4, 4, -1)

    def product_of(i: int, j: int) -> Float[Array, " s"]:
        return row[i, 0] * row[0, j] + row[i, 1] * row[1, j] + row[i, 2] * row[2, j] + row[i, 3] * row[3, j]

    upper = {(i, j): product_of(i, j) for i in range(4) for j in range(i, 4)}
    trace = upper[0, 0] + upper[1, 1] + upper[2, 2] + upper[3, 3]
    entries = [upper[min(i, j), max(i, j)] for i in range(4) for j in range(4)]
    return namespace(matrices).stack(entries) / trace[None]


@cache
def _rotations_of_quaternions() -> Float64[np.ndarray, "9 16"]:
    """Return the linear map from products of two components of a quaternion to its rotation matrix."""
    signs = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1]])
    units = np.arange(4)
    # The product of two of the quaternion units 1, i, j and k is again one of these units, or its negative.
    multiplication = np.zeros((4, 4, 4))
    multiplication[units[:, None], units, units[:, None] ^ units] = signs
    # A unit quaternion q rotates a vector v to q v q*.
    rotations = np.einsum("ajc,cbi,b->ijab", multiplication, multiplication, [1, -1, -1, -1])
    return rotations[1:, 1:].reshape(9, 16)
