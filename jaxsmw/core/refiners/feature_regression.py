"""Refinement by regression: the features of matched vertices, each linearly from the other's."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.core.pointwise_map import chosen_patches
from jaxsmw.core.products import product
from jaxsmw.core.refinement import Problem, Samples
from jaxsmw.core.refiners.coarse_to_fine import CoarseToFine, check_descriptors, doubted
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import Patches, nearest_neighbor, nearest_neighbor_in_patches
from jaxsmw.core.spectrum import Spectrum

# Beside variances of features, about 1. From a third to three times of either, results hardly change.
_RIDGE, _LEAST_RESIDUAL = 1e-3, 0.03


class FeatureRegression(CoarseToFine):
    """Matches along which the features of both shapes predict each other best, from coarse to fine.

    The features of a vertex are its eigenvectors' values and its descriptors (`Spectrum.descriptors`), if
    there are any. Along the matches of both directions those of X are regressed on those of Y, eigenvectors
    on eigenvectors, which is the functional map by least squares (Ovsjanikov et al. 2012), and descriptors on
    descriptors. The covariance of what this leaves unexplained tells how far each combination of features
    can be trusted, and the next matches are the most likely ones: nearest in the Mahalanobis distance. The
    same is done from Y to X. At first few eigenvectors count, then more, as in ZoomOut (Melzi et al. 2019).

    It does not presuppose isometry, so that it ends nearer the truth than `WaveletPreservation`, if it
    starts from a map as good as the outcome of that: docs/accuracy.md measures both.

    **Arguments:**

    - `levels`: how many eigenvectors count in each iteration (of the shape with more of them; of the other in
      proportion); after these all of them count.
    - `partial`: for shapes of which one is a part of the other. Many vertices of the whole have no match on
      the part: the worse one's match fits, beside the part's on average, the less it counts.
    - `search`: how the last matches are found, among all vertices. `"exhaustive"` compares all with all;
      `"patches"` leaves out patches of the target that are too far away, for which it looks at what
      eigenvectors say alone; `"auto"` does that on CPUs from 15 000 vertices.
    """

    def prepare(self, spectrum_x: Spectrum, spectrum_y: Spectrum, samples: Samples | None = None) -> Problem:
        """Collect the features of the vertices to be matched, and of all, among which their matches are.

        **Raises:** `ValueError` if only one shape has descriptors, or they differ in number.
        """
        check_descriptors(spectrum_x, spectrum_y)
        all_x, all_y = _Features.of(spectrum_x), _Features.of(spectrum_y)
        if samples is None:
            patches = chosen_patches(self.search, spectrum_x, spectrum_y)
            return Problem(spectrum_x, spectrum_y, _Prepared(all_x, all_y, all_x, all_y, patches))
        spectrum_x, spectrum_y = spectrum_x.sample(samples[0]), spectrum_y.sample(samples[1])
        sampled_x, sampled_y = _Features.of(spectrum_x), _Features.of(spectrum_y)
        return Problem(spectrum_x, spectrum_y, _Prepared(sampled_x, sampled_y, all_x, all_y, None))

    def update(
        self, problem: Problem, pointwise_map: Int[Array, " m"], previous: Any
    ) -> tuple[Regression, RESULTS]:
        """Regress along the matches, and along those of the way back, which `previous` gives as well."""
        x, y, all_x, all_y, _ = problem.prepared
        iteration = jnp.asarray(0, jnp.int32)
        if previous is None:
            moments = _Moments.along(x.values, all_y.values[pointwise_map], x.weights)
        else:
            iteration = previous.iteration + 1
            way_back = previous.backward.search(y, all_x)
            weights_x, weights_y = x.weights, y.weights
            if self.partial:
                residuals_x = previous.forward.residuals(x, all_y, pointwise_map)
                residuals_y = previous.backward.residuals(y, all_x, way_back)
                weights_x, weights_y = doubted(weights_x, residuals_x, weights_y, residuals_y)
            forth = _Moments.along(x.values, all_y.values[pointwise_map], weights_x)
            back = _Moments.along(all_x.values[way_back], y.values, weights_y)
            moments = _Moments(*((a + b) / 2 for a, b in zip(forth, back, strict=True)))
        counts_x, counts_y = self.counting_eigenvectors(problem, iteration)
        functional_map, forward = _regress(moments, counts_x, counts_y)
        _, backward = _regress(moments.turned, counts_y, counts_x)
        return Regression(functional_map, forward, backward, iteration), RESULTS.successful  # type: ignore[return-value]

    def recover(self, problem: Problem, updated: Any) -> Int32[Array, " m"]:
        """The most likely vertices."""
        if problem.prepared.patches is None:
            return updated.forward.search(problem.prepared.x, problem.prepared.all_y)
        # The first coordinates depend on eigenvectors alone, in which patches are compact.
        k = problem.spectrum_x.eigenvalues.shape[0]
        queries, database = self.embeddings(problem, updated)
        return nearest_neighbor_in_patches(queries[:, :k], database[:, :k], *problem.prepared.patches)

    def energy(self, problem: Problem, updated: Any, pointwise_map: Int[Array, " m"]) -> Float[Array, ""]:
        """How uncertain predictions are; see `Regression.uncertainty`."""
        return updated.uncertainty

    def embeddings(
        self, problem: Problem, updated: Any
    ) -> tuple[Float[Array, "m d_x"], Float[Array, "n d_x"]]:
        """Points at distances that are those of Mahalanobis, between features of X and what Y predicts."""
        return updated.forward.embeddings(problem.prepared.x, problem.prepared.all_y)


class _Features(NamedTuple):
    """Of one shape's vertices: eigenvectors and descriptors, shares of the area, which are on the surface."""

    values: Float[Array, "n d"]
    weights: Float[Array, " n"]
    mask: Bool[Array, " n"]

    @classmethod
    def of(cls, spectrum: Spectrum) -> _Features:
        area = jnp.sum(spectrum.vertex_areas)
        values = spectrum.eigenvectors * jnp.sqrt(area)  # of mean square 1, whatever the unit of length
        if spectrum.descriptors is not None:
            values = jnp.concatenate([values, spectrum.descriptors], axis=1)
        return cls(values, spectrum.vertex_areas / area, spectrum.mask)


class _Prepared(NamedTuple):
    """The vertices to be matched of both shapes, all of both, and patches if the search is to use them."""

    x: _Features
    y: _Features
    all_x: _Features
    all_y: _Features
    patches: tuple[Patches, Patches] | None


class Prediction(NamedTuple):
    """What turns features of both shapes into points that are the nearer, the likelier a match."""

    queries: Float[Array, "d_out d_out"]
    database: Float[Array, "d_in d_out"]
    uncertainty: Float[Array, ""]

    def embeddings(
        self, asking: _Features, answering: _Features
    ) -> tuple[Float[Array, "m d_out"], Float[Array, "n d_out"]]:
        """The points."""
        return product(asking.values, self.queries), product(answering.values, self.database)

    def search(self, asking: _Features, answering: _Features) -> Int32[Array, " m"]:
        """The likeliest matches."""
        return nearest_neighbor(*self.embeddings(asking, answering), database_mask=answering.mask)

    def residuals(
        self, asking: _Features, answering: _Features, matches: Int[Array, " m"]
    ) -> Float[Array, " m"]:
        """Squared distances of matches."""
        queries, database = self.embeddings(asking, answering)
        return jnp.sum((queries - database[matches]) ** 2, axis=1)


class Regression(NamedTuple):
    """What `FeatureRegression` hands on: a functional map, and predictions of X by Y and of Y by X."""

    functional_map: Float[Array, "k_x k_y"]
    forward: Prediction
    backward: Prediction
    iteration: Int32[Array, ""]

    @property
    def uncertainty(self) -> Float[Array, ""]:
        """The mean logarithm of what standard deviation predictions leave, over features of both shapes.

        (Of their principal components: half the logarithm of the residual covariances' determinants.)
        """
        features = self.forward.queries.shape[-1] + self.backward.queries.shape[-1]
        return (self.forward.uncertainty + self.backward.uncertainty) / features


class _Moments(NamedTuple):
    """Mean products of features along matches."""

    xx: Float[Array, "d_x d_x"]
    xy: Float[Array, "d_x d_y"]
    yy: Float[Array, "d_y d_y"]

    @classmethod
    def along(
        cls, x: Float[Array, "m d_x"], y: Float[Array, "m d_y"], weights: Float[Array, " m"]
    ) -> _Moments:
        weighted_x, weighted_y = x * weights[:, None], y * weights[:, None]
        return cls(product(x.T, weighted_x), product(x.T, weighted_y), product(y.T, weighted_y))

    @property
    def turned(self) -> _Moments:
        return _Moments(self.yy, self.xy.T, self.xx)


def _regress(
    moments: _Moments, counts_x: Bool[Array, " k_x"], counts_y: Bool[Array, " k_y"]
) -> tuple[Float[Array, "k_x k_y"], Prediction]:
    """The functional map, and the prediction of x by y with those eigenvectors of both that count."""
    k_x, k_y = counts_x.shape[0], counts_y.shape[0]
    descriptors = moments.xx.shape[0] - k_x
    keep_x, keep_y = (jnp.pad(k, (0, descriptors), constant_values=True) for k in (counts_x, counts_y))
    xx = jnp.where(keep_x[:, None] & keep_x[None, :], moments.xx, 0)
    xy = jnp.where(keep_x[:, None] & keep_y[None, :], moments.xy, 0)
    yy = jnp.where(keep_y[:, None] & keep_y[None, :], moments.yy, 0)
    # Eigenvectors by eigenvectors, descriptors by descriptors.
    of_x, of_y = (jnp.arange(len(keep)) < k for keep, k in ((keep_x, k_x), (keep_y, k_y)))
    gram = jnp.where(of_y[:, None] == of_y[None, :], yy, 0) + _RIDGE * jnp.eye(yy.shape[0], dtype=yy.dtype)
    cross = jnp.where(of_x[:, None] == of_y[None, :], xy, 0)
    matrix = jsp.linalg.solve(gram, cross.T, assume_a="pos").T
    explained = product(matrix, xy.T)
    residual = xx - explained - explained.T + product(product(matrix, yy), matrix.T)
    identity = jnp.eye(residual.shape[0], dtype=residual.dtype)
    factor = jnp.linalg.cholesky(residual + _LEAST_RESIDUAL * identity)
    # Triangular, so that each coordinate is of the features up to its own. One that does not count is left
    # out: it would add the same to all distances, and its rounding.
    whitening = jnp.where(keep_x[:, None], jsp.linalg.solve_triangular(factor, identity, lower=True).T, 0)
    uncertainty = jnp.sum(jnp.where(keep_x, jnp.log(jnp.diagonal(factor)), 0))
    return matrix[:k_x, :k_y], Prediction(whitening, product(matrix.T, whitening), uncertainty)
