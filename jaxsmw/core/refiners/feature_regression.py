"""Refinement by linear regression between the features of matched vertices."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.linear_algebra import cholesky, product, solve_lower, solve_positive_definite
from jaxsmw.core.module import field
from jaxsmw.core.refiner import Prepared, Problem
from jaxsmw.core.refiners.coarse_to_fine import (
    CoarseToFine,
    CoarseToFineState,
    check_features,
    partial_matching_weights,
)
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import SearchProblem, nearest_in_both, nearest_neighbor
from jaxsmw.core.spectrum import Spectrum

# _RIDGE is the ridge of the regression, and _LEAST_RESIDUAL is added to the variances of the residuals.
# Features have a variance of about 1. The results hardly change if either number is multiplied by a factor
# between 1/3 and 3.
_RIDGE, _LEAST_RESIDUAL = 1e-3, 0.03


class FeatureRegression(CoarseToFine["PreparedFeatures", "Regression"]):
    """A refiner that finds matches by linear regression between the features of both shapes.

    The features of a vertex are the values of the eigenvectors and, if the spectra have them, the descriptors
    and the crease eigenvectors. Each iteration regresses the features of vertices of X on the features of
    their matches. The first iteration uses the matches of the initial map. Later iterations use the matches
    of the map and of the reverse map. Eigenvectors are regressed on eigenvectors, which gives the functional
    map by least squares (Ovsjanikov et al. 2012). Descriptors and crease eigenvectors together are regressed
    on descriptors and crease eigenvectors. The covariance of the residuals measures how accurately each
    combination of features is predicted. This covariance defines a Mahalanobis distance between the features
    of a vertex of X and the features predicted from a vertex of Y. The next match of a vertex of X is the
    nearest vertex of Y in this distance. For the reverse map, the features of Y are regressed on the features
    of X in the same way.

    The method does not assume isometry. If the initial map is as accurate as a map from
    `WaveletPreservation`, refinement makes the map more accurate (docs/accuracy.md). On partial pairs,
    vertices of the full shape with large residuals receive smaller weights (`partial_matching_weights`).

    **Arguments:** `levels`, which `CoarseToFine` describes.
    """

    @property
    def uses_namespaces(self) -> bool:
        """Always True."""
        return True

    def prepare(self, problem: Problem) -> PreparedFeatures:
        """Collect the features of all vertices and of the samples.

        **Raises:** `ValueError` if the shapes have different numbers of descriptors or of crease
        eigenvectors.
        """
        check_features(problem.spectrum_x, problem.spectrum_y)
        all_x, all_y = _Features.of(problem.spectrum_x), _Features.of(problem.spectrum_y)
        spectrum_x, spectrum_y = problem.query_spectra()
        if problem.samples is None:
            x, y = all_x, all_y
        else:
            x, y = _Features.of(spectrum_x), _Features.of(spectrum_y)
        return PreparedFeatures(spectrum_x, spectrum_y, x, y, all_x, all_y, problem.partial)

    def update(
        self, prepared: PreparedFeatures, pointwise_map: Int[Array, " m"], previous: Regression | None
    ) -> tuple[Regression, RESULTS]:
        """Compute both regressions from matched features. Return the next state and `RESULTS.successful`."""
        x, y, all_x, all_y = prepared.x, prepared.y, prepared.all_x, prepared.all_y
        if previous is None:
            iteration = namespace(pointwise_map).asarray(0, np.int32)
            moments = _Moments.along(x.values, all_y.values[pointwise_map], x.weights)
        else:
            iteration = previous.iteration + 1
            assert previous.reverse_map is not None  # `recover_both` adds it
            reverse_map = previous.reverse_map
            weights_x, weights_y = x.weights, y.weights
            if prepared.partial:
                residuals_x = previous.forward.residuals(x, all_y, pointwise_map)
                residuals_y = previous.backward.residuals(y, all_x, reverse_map)
                weights_x, weights_y = partial_matching_weights(
                    weights_x, residuals_x, weights_y, residuals_y
                )
            forward = _Moments.along(x.values, all_y.values[pointwise_map], weights_x)
            backward = _Moments.along(all_x.values[reverse_map], y.values, weights_y)
            moments = _Moments(*((a + b) / 2 for a, b in zip(forward, backward, strict=True)))
        active_x, active_y = self.active_eigenvectors(prepared, iteration)
        functional_map, prediction = _regress(moments, active_x, active_y)
        _, reverse_prediction = _regress(moments.reversed, active_y, active_x)
        state = Regression(functional_map, iteration, prediction, reverse_prediction)
        return state, RESULTS.successful

    def recover(self, prepared: PreparedFeatures, state: Regression) -> Int32[Array, " m"]:
        """Return, for each vertex of X, the nearest vertex of Y in the Mahalanobis distance, (m,)."""
        queries, database = self.embeddings(prepared, state)
        return nearest_neighbor(queries, database, database_mask=prepared.all_y.mask)

    def recover_both(
        self, prepared: PreparedFeatures, state: Regression
    ) -> tuple[Int32[Array, " m"], Regression]:
        """Return the result of `recover` (m,), and the state with the `reverse_map` of Y's vertices.

        Distances of the reverse map are computed by the prediction of the features of Y.
        """
        pointwise_map, reverse_map = nearest_in_both(
            SearchProblem(*self.embeddings(prepared, state), prepared.all_y.mask),
            SearchProblem(*state.backward.embeddings(prepared.y, prepared.all_x), prepared.all_x.mask),
        )
        return pointwise_map, replace(state, reverse_map=reverse_map)

    def recover_reverse(self, prepared: PreparedFeatures, state: Regression) -> Int32[Array, " n"]:
        """Return, for each vertex of Y, the nearest vertex of X in the `embeddings`, (n,)."""
        database, queries = self.embeddings(prepared, state)
        return nearest_neighbor(queries, database, database_mask=prepared.all_x.mask)

    def energy(
        self, prepared: PreparedFeatures, state: Regression, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Return the uncertainty of the predictions; see `Regression.uncertainty`."""
        return state.uncertainty

    def embeddings(
        self, prepared: PreparedFeatures, state: Regression
    ) -> tuple[Float[Array, "m d_x"], Float[Array, "n d_x"]]:
        """Return dimensionless points (m, d_x) for X and (n, d_x) for Y, with d_x features of X.

        Their distance is the Mahalanobis distance between the features of a vertex of X and the features
        predicted from a vertex of Y.
        """
        return state.forward.embeddings(prepared.x, prepared.all_y)


class _Features(NamedTuple):
    """The eigenvectors, descriptors and crease eigenvectors of a shape, and vertex weights with sum 1."""

    values: Float[Array, "n d"]
    weights: Float[Array, " n"]
    mask: Bool[Array, " n"]

    @classmethod
    def of(cls, spectrum: Spectrum) -> _Features:
        xp = namespace(spectrum.eigenvectors)
        area = xp.sum(spectrum.vertex_areas)
        # The square root of the area scales each eigenvector to mean square 1, whatever the unit of length.
        values = spectrum.eigenvectors * xp.sqrt(area)
        further = [spectrum.descriptors, spectrum.crease_eigenvectors]
        values = xp.concatenate([values, *(f for f in further if f is not None)], axis=1)
        return cls(values, spectrum.vertex_areas / area, spectrum.mask)


class PreparedFeatures(Prepared):
    """The features of the vertices to be matched (`x`, `y`) and of all vertices (`all_x`, `all_y`)."""

    x: _Features
    y: _Features
    all_x: _Features
    all_y: _Features
    partial: bool = field(static=True)


class Prediction(NamedTuple):
    """A linear prediction of features, for a nearest-neighbour search in the Mahalanobis distance.

    The matrices `queries` and `database` take the features of query vertices and of target vertices to the
    points of the search. `uncertainty` is half the log-determinant of the covariance of the residuals,
    without unit. Eigenvectors that the iteration does not use are left out.
    """

    queries: Float[Array, "d_out d_out"]
    database: Float[Array, "d_in d_out"]
    uncertainty: Float[Array, ""]

    def embeddings(
        self, queries: _Features, targets: _Features
    ) -> tuple[Float[Array, "m d_out"], Float[Array, "n d_out"]]:
        return product(queries.values, self.queries), product(targets.values, self.database)

    def residuals(
        self, queries: _Features, targets: _Features, matches: Int[Array, " m"]
    ) -> Float[Array, " m"]:
        """Return the squared distance from each query vertex to its match, (m,), without unit."""
        points, database = self.embeddings(queries, targets)
        return namespace(points).sum((points - database[matches]) ** 2, axis=1)


class Regression(CoarseToFineState):
    """The state of `FeatureRegression`: predictions of X from Y (`forward`) and of Y from X (`backward`)."""

    forward: Prediction
    backward: Prediction

    @property
    def uncertainty(self) -> Float[Array, ""]:
        """The mean logarithm of the standard deviation of the residuals; lower is better.

        The mean is taken over the principal components of the residuals of both predictions.
        """
        features = self.forward.queries.shape[-1] + self.backward.queries.shape[-1]
        return (self.forward.uncertainty + self.backward.uncertainty) / features


class _Moments(NamedTuple):
    """Weighted sums of products of features, taken over all pairs of matched vertices."""

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
    def reversed(self) -> _Moments:
        return _Moments(self.yy, self.xy.T, self.xx)


def _regress(
    moments: _Moments, active_x: Bool[Array, " k_x"], active_y: Bool[Array, " k_y"]
) -> tuple[Float[Array, "k_x k_y"], Prediction]:
    """Return the functional map and the prediction of X from Y, which use only active eigenvectors."""
    xp = namespace(moments.xx)
    k_x, k_y = active_x.shape[0], active_y.shape[0]
    descriptors = moments.xx.shape[0] - k_x
    keep_x, keep_y = (xp.pad(k, (0, descriptors), constant_values=True) for k in (active_x, active_y))
    xx = xp.where(keep_x[:, None] & keep_x[None, :], moments.xx, 0)
    xy = xp.where(keep_x[:, None] & keep_y[None, :], moments.xy, 0)
    yy = xp.where(keep_y[:, None] & keep_y[None, :], moments.yy, 0)
    # Eigenvectors are regressed only on eigenvectors, and descriptors only on descriptors.
    eigenvectors_x, eigenvectors_y = (xp.arange(len(keep)) < k for keep, k in ((keep_x, k_x), (keep_y, k_y)))
    gram = xp.where(eigenvectors_y[:, None] == eigenvectors_y[None, :], yy, 0)
    gram = gram + _RIDGE * xp.eye(yy.shape[0], dtype=yy.dtype)
    cross = xp.where(eigenvectors_x[:, None] == eigenvectors_y[None, :], xy, 0)
    matrix = solve_positive_definite(gram, cross.T).T
    explained = product(matrix, xy.T)
    residual = xx - explained - explained.T + product(product(matrix, yy), matrix.T)
    identity = xp.eye(residual.shape[0], dtype=residual.dtype)
    factor = cholesky(residual + _LEAST_RESIDUAL * identity)
    # The whitening is triangular, so coordinate i depends only on features 0 to i. Inactive features are set
    # to zero, because they would add only a constant and rounding errors to the distances.
    whitening = xp.where(keep_x[:, None], solve_lower(factor, identity).T, 0)
    uncertainty = xp.sum(xp.where(keep_x, xp.log(xp.diagonal(factor)), 0))
    return matrix[:k_x, :k_y], Prediction(whitening, product(matrix.T, whitening), uncertainty)
