"""Refinement by registration: each surface bent onto the other, low frequencies first."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Float64, Int, Int32

from jaxsmw.core.functional_map import dual_eigenvectors
from jaxsmw.core.pointwise_map import chosen_patches
from jaxsmw.core.products import product
from jaxsmw.core.refinement import Problem, Samples
from jaxsmw.core.refiners.coarse_to_fine import CoarseToFine, check_descriptors, doubted
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import Patches, nearest_neighbor, nearest_neighbor_in_patches
from jaxsmw.core.spectrum import Spectrum

# What counts beside positions in units of the square root of the area: unit normals; and the first so many
# eigenfunctions over the square root of their eigenvalue and one.
_NORMALS, _EIGENFUNCTIONS, _NUMBER_OF_EIGENFUNCTIONS = 0.02, 0.2, 50
# And descriptors, of mean square 1, over this power of how many eigenvectors count: more than positions where
# these are coarse, hardly anything at last.
_DESCRIPTORS, _FALLING = 2.8, 1.5
# The time for which heat flows that averages over a vertex's surroundings: it spreads over a disk of radius
# 0.1. It is longer where the eigenvectors do not reach so far that the last of them fades by this exponent.
_HEAT_TIME, _FADES = 3e-3, 4.0
# Beside the mean square of eigenvectors, where some vertices hardly count.
_RIDGE = 1e-3
# A matrix squared so often leaves its first eigenvector.
_SQUARINGS = 12


class Registration(CoarseToFine):
    """Matches where X, bent onto Y, comes to lie next to it, and Y, bent onto X, next to that.

    Low frequencies of a bent surface are those of its matches: their positions in the span of the first
    eigenvectors, more of them in every iteration, as in smooth shells (Eisenberger, Lähner, Cremers 2020).
    What the surface itself has beyond these, its details, is carried along by the rotation of its
    surroundings, as in as-rigid-as-possible deformation (Sorkine, Alexa 2007); the one that fits best is had
    from averages by heat flow. Of all vertices of a shape all of this is filtering, nothing is solved; where
    eigenvectors are not orthonormal, on samples and on parts, coefficients are by least squares. The next
    matches are nearest in position, normal and the first eigenfunctions, on both surfaces at once, and in
    descriptors (`Spectrum.descriptors`), if there are any, which count less with every level.

    It starts from a map that is nearly right, and ends nearer the truth than methods that know
    eigenfunctions alone: docs/accuracy.md measures both. The spectra need positions and normals, which those
    of `jaxsmw.compute_spectrum` have. Where one surface is the mirror image of the other, rotations are, too.

    **Arguments:**

    - `levels`: how many eigenvectors count in each iteration (of the shape with more of them; of the other in
      proportion); after these all of them count.
    - `partial`: for shapes of which one is a part of the other, in the same unit of length; whole ones are
      compared at area 1. Many vertices of the whole have no match on the part: the worse one's match fits,
      beside the part's on average, the less it counts.
    - `search`: how the last matches are found, among all vertices. `"exhaustive"` compares all with all;
      `"patches"` finds the same but leaves out patches of the target that are too far away; `"auto"` does
      that on CPUs from 15 000 vertices.
    """

    def prepare(self, spectrum_x: Spectrum, spectrum_y: Spectrum, samples: Samples | None = None) -> Problem:
        """Bring both surfaces to one scale.

        **Raises:** `ValueError` if a spectrum has no positions and normals, or descriptors differ in number.
        """
        check_descriptors(spectrum_x, spectrum_y)
        areas = [jnp.sum(spectrum.vertex_areas) for spectrum in (spectrum_x, spectrum_y)]
        if self.partial:
            areas = [jnp.maximum(*areas)] * 2
        all_x, all_y = _Surface.of(spectrum_x, areas[0]), _Surface.of(spectrum_y, areas[1])
        if samples is None:
            there = chosen_patches(self.search, spectrum_x, spectrum_y)
            back = chosen_patches(self.search, spectrum_y, spectrum_x)
            return Problem(spectrum_x, spectrum_y, _Prepared(all_x, all_y, all_x, all_y, there, back))
        spectrum_x, spectrum_y = spectrum_x.sample(samples[0]), spectrum_y.sample(samples[1])
        x, y = all_x.sample(spectrum_x, samples[0]), all_y.sample(spectrum_y, samples[1])
        return Problem(spectrum_x, spectrum_y, _Prepared(x, y, all_x, all_y, None, None))

    def update(
        self, problem: Problem, pointwise_map: Int[Array, " m"], previous: Any
    ) -> tuple[Registered, RESULTS]:
        """Bend X by the matches, and Y by those of the way back."""
        x, y, all_x, all_y, _, patches = problem.prepared
        iteration = jnp.asarray(0, jnp.int32) if previous is None else previous.iteration + 1
        counts_x, counts_y = self.counting_eigenvectors(problem, iteration)
        level = jnp.maximum(jnp.sum(counts_x), jnp.sum(counts_y)).astype(x.weights.dtype)
        descriptors = _DESCRIPTORS / level**_FALLING
        if previous is None:  # The first way back is from where Y is to where X is bent to.
            forth = Bending.along(x, all_y, pointwise_map, counts_x)
            way_back = _nearest(y.points, forth.points(all_x), all_x.mask, patches)
        else:
            answering, asking = _product_space(all_x, y, previous)
            way_back = _nearest(asking, answering, all_x.mask, patches)
            if self.partial:
                bent = previous._replace(descriptors=jnp.zeros_like(descriptors))
                answering, asking = _product_space(all_x, y, bent)
                residuals_y = jnp.sum((asking - answering[way_back]) ** 2, axis=1)
                asking, answering = _product_space(x, all_y, bent)
                residuals_x = jnp.sum((asking - answering[pointwise_map]) ** 2, axis=1)
                weights = doubted(x.weights, residuals_x, y.weights, residuals_y)
                x, y = (side.weigh(each) for side, each in zip((x, y), weights, strict=True))
            forth = Bending.along(x, all_y, pointwise_map, counts_x)
        back = Bending.along(y, all_x, way_back, counts_y)
        return Registered(forth, back, descriptors, iteration), RESULTS.successful  # type: ignore[return-value]

    def recover(self, problem: Problem, updated: Registered) -> Int32[Array, " m"]:
        """The nearest vertices."""
        _, _, _, all_y, patches, _ = problem.prepared
        return _nearest(*self.embeddings(problem, updated), all_y.mask, patches)

    def energy(
        self, problem: Problem, updated: Registered, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """The `objective` of the matches by which X was bent."""
        return self.objective(problem, updated, pointwise_map)

    def embeddings(
        self, problem: Problem, updated: Registered
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Positions, and beside them what else counts, of X bent and as it is, and of Y as it is and bent."""
        x, _, _, all_y, _, _ = problem.prepared
        return _product_space(x, all_y, updated)


class _Surface(NamedTuple):
    """What is known of some vertices of a shape, in units of the square root of the area.

    `points` are positions, normals and eigenfunctions, each times what it counts.
    """

    eigenvectors: Float[Array, "n k"]
    dual: Float[Array, "n k"]
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
        """All vertices."""
        if spectrum.positions is None or spectrum.normals is None:
            raise ValueError(
                "Registration needs positions and normals, which a spectrum lacks: compute_spectrum gives "
                "them, and Spectrum.with_positions adds them"
            )
        dtype = spectrum.eigenvectors.dtype
        weights = spectrum.vertex_areas / jnp.sum(spectrum.vertex_areas)
        center = product(weights, spectrum.positions)
        positions = (spectrum.positions - center[None]) / jnp.sqrt(area)
        eigenvalues, eigenvectors = spectrum.eigenvalues * area, spectrum.eigenvectors * jnp.sqrt(area)
        first = slice(min(_NUMBER_OF_EIGENFUNCTIONS, eigenvalues.shape[0]))
        smooth = eigenvectors[:, first] / jnp.sqrt(1 + eigenvalues[None, first])
        points = [positions, _NORMALS * spectrum.normals, _EIGENFUNCTIONS * smooth]
        last = eigenvalues[-1]
        time = jnp.maximum(_HEAT_TIME, jnp.where(last > 0, _FADES / last, 0))
        return cls(
            spectrum.eigenvectors,
            dual_eigenvectors(spectrum, "area"),
            weights,
            jnp.exp(-time * eigenvalues),
            time,
            positions,
            spectrum.normals,
            jnp.concatenate(points, axis=1).astype(dtype),
            jnp.zeros((len(weights), 0), dtype) if spectrum.descriptors is None else spectrum.descriptors,
            spectrum.mask,
        )

    def sample(self, spectrum: Spectrum, vertices: Int[Array, " s"]) -> _Surface:
        """Some of them, whose spectrum is given, for all."""
        dual = dual_eigenvectors(spectrum, "least_squares")
        weights = jnp.full(vertices.shape, 1 / vertices.shape[0], self.weights.dtype)
        fields = (self.positions, self.normals, self.points, self.descriptors, self.mask)
        return _Surface(
            spectrum.eigenvectors, dual, weights, self.heat, self.time, *(field[vertices] for field in fields)
        )

    def weigh(self, weights: Float[Array, " s"]) -> _Surface:
        """The same where some vertices count less in what eigenvectors are fitted to."""
        weighted = self.eigenvectors * weights[:, None]
        gram = product(self.eigenvectors.T, weighted)
        ridge = _RIDGE * jnp.trace(gram) / gram.shape[0] * jnp.eye(gram.shape[0], dtype=gram.dtype)
        return self._replace(dual=jsp.linalg.solve(gram + ridge, weighted.T, assume_a="pos").T)


class _Prepared(NamedTuple):
    """The vertices to be matched of both shapes, all of both, and patches if searches are to use them."""

    x: _Surface
    y: _Surface
    all_x: _Surface
    all_y: _Surface
    patches: tuple[Patches, Patches] | None
    patches_back: tuple[Patches, Patches] | None


class Bending(NamedTuple):
    """What bends a surface onto another: coefficients of its eigenvectors.

    - `own`, `matched`: of its positions and of the `points` of their matches, as far as eigenvectors count.
    - `moments`: of averages of positions, matches' positions and products of both, and of normals' products.
    """

    functional_map: Float[Array, "k_x k_y"]
    own: Float[Array, "k_x 3"]
    matched: Float[Array, "k_x d"]
    moments: Float[Array, "k_x 24"]

    @classmethod
    def along(
        cls,
        surface: _Surface,
        other: _Surface,
        matches: Int[Array, " s"],
        counts: Bool[Array, " k_x"],
    ) -> Bending:
        """By matches of vertices of a surface among all of the other."""

        def products(own: Float[Array, "s 3"], matched: Float[Array, "s 3"]) -> Float[Array, "s 9"]:
            return (own[:, :, None] * matched[:, None, :]).reshape(-1, 9)

        own, matched = surface.positions, other.positions[matches]
        normals = products(surface.normals, other.normals[matches])
        averaged = jnp.concatenate([own, matched, products(own, matched), normals], axis=1)

        def coefficients(values: Float[Array, "s d"]) -> Float[Array, "k_x d"]:
            return product(surface.dual.T, values)

        return cls(
            coefficients(other.eigenvectors[matches]),
            jnp.where(counts[:, None], coefficients(own), 0),
            jnp.where(counts[:, None], coefficients(other.points[matches]), 0),
            surface.heat[:, None] * coefficients(averaged),
        )

    def points(self, surface: _Surface) -> Float[Array, "s d"]:
        """Where vertices of the surface come to lie, among the other's `points`."""
        low = product(surface.eigenvectors, jnp.concatenate([self.own, self.matched, self.moments], axis=1))
        own, matched, moments = low[:, :3], low[:, 3:-24], low[:, -24:]
        rotations = _rotations(moments, surface)
        details = surface.positions - own
        positions, normals = (
            jnp.sum(rotations * vectors[:, None, :], axis=2) for vectors in (details, surface.normals)
        )
        return jnp.concatenate([matched[:, :3] + positions, _NORMALS * normals, matched[:, 6:]], axis=1)


class Registered(NamedTuple):
    """What `Registration` hands on: what bends X onto Y, and Y onto X, and what descriptors count."""

    forth: Bending
    back: Bending
    descriptors: Float[Array, ""]
    iteration: Int32[Array, ""]

    @property
    def functional_map(self) -> Float[Array, "k_x k_y"]:
        """That of the matches by which X was bent."""
        return self.forth.functional_map


def _product_space(
    x: _Surface, y: _Surface, registered: Registered
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    """Points of both surfaces, at small distances where one comes to lie on the other and vice versa."""
    count = registered.descriptors
    return (
        jnp.concatenate([registered.forth.points(x), x.points, count * x.descriptors], axis=1),
        jnp.concatenate([y.points, registered.back.points(y), count * y.descriptors], axis=1),
    )


def _nearest(
    queries: Float[Array, "m d"],
    database: Float[Array, "n d"],
    mask: Bool[Array, " n"],
    patches: tuple[Patches, Patches] | None,
) -> Int32[Array, " m"]:
    if patches is None:
        return nearest_neighbor(queries, database, database_mask=mask)
    return nearest_neighbor_in_patches(queries, database, *patches)


def _rotations(moments: Float[Array, "s 24"], surface: _Surface) -> Float[Array, "s 3 3"]:
    """The rotations that take surroundings of vertices best to where these are matched.

    All of them with a reflection if the surface as a whole is turned inside out.
    """
    own, matched = moments[:, :3], moments[:, 3:6]
    products, normals = (part.reshape(-1, 3, 3) for part in (moments[:, 6:15], moments[:, 15:]))
    # In the tangential plane the variance is twice the time that heat flows; of normals the square is one.
    covariance = (products - own[:, :, None] * matched[:, None, :]) / (2 * surface.time) + normals
    turned = jnp.sum(surface.weights * jnp.linalg.det(covariance)) < 0
    hand = jnp.where(turned, -1, 1).astype(covariance.dtype)
    return hand * _nearest_rotations(hand * covariance)


def _nearest_rotations(covariances: Float[Array, "s 3 3"]) -> Float[Array, "s 3 3"]:
    """The rotations R that make the trace of R S greatest, from unit quaternions (Horn 1987).

    Both R and its trace with S are quadratic in a quaternion, so that the best one is an eigenvector.
    """
    table = jnp.asarray(_rotations_of_quaternions(), covariances.dtype)
    quadratic = product(covariances.mT.reshape(-1, 9), table).reshape(-1, 4, 4)
    sizes = jnp.sqrt(jnp.sum(quadratic**2, axis=(1, 2), keepdims=True))
    # Without negative eigenvalues the largest is what prevails in powers.
    powers = quadratic / jnp.where(sizes > 0, sizes, 1) + jnp.eye(4, dtype=covariances.dtype)[None]

    def squared(_: Any, powers: Float[Array, "s 4 4"]) -> Float[Array, "s 4 4"]:
        powers = jnp.sum(powers[:, :, :, None] * powers[:, None, :, :], axis=2)
        return powers / jnp.trace(powers, axis1=1, axis2=2)[:, None, None]

    powers = lax.fori_loop(0, _SQUARINGS, squared, powers)
    largest = jnp.argmax(jnp.diagonal(powers, axis1=1, axis2=2), axis=1)
    quaternions = jnp.take_along_axis(powers, largest[:, None, None], axis=1)
    products = quaternions.mT * quaternions / jnp.sum(quaternions**2, axis=2, keepdims=True)
    return product(products.reshape(-1, 16), table.T).reshape(-1, 3, 3)


@cache
def _rotations_of_quaternions() -> Float64[np.ndarray, "9 16"]:
    """What the rotation by a quaternion q is of the products of its components."""
    signs = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1]])
    units = np.arange(4)
    multiplication = np.zeros((4, 4, 4))  # one unit times another is plus or minus a third
    multiplication[units[:, None], units, units[:, None] ^ units] = signs
    rotations = np.einsum("ajc,cbi,b->ijab", multiplication, multiplication, [1, -1, -1, -1])  # q v q*
    return rotations[1:, 1:].reshape(9, 16)
