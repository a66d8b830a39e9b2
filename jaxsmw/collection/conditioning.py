"""Gaussian models of shapes: estimated from few shapes, conditioned on a part, and calibrated.

A shape is the mean, plus a random combination of factors, plus an isotropic residual. The factors are the
modes of the shapes, smooth fields for what the modes leave out, and motions of the whole shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float64
from scipy.optimize import isotonic_regression, minimize_scalar
from scipy.stats import chi2
from scipy.stats import norm as normal
from scipy.stats import t as student

from jaxsmw.errors import InputError, check_number, check_whole_number
from jaxsmw.runtime.threads import one_blas_thread

# Calibration evaluates the errors at most at this number of vertices of each shape.
_EVALUATED = 200
# The radii of the calibrated posterior hold this share of the vertices of shapes that were left out.
_SHARE = 0.9
# The noise is at most this multiple of the standard deviation of the shapes. With more noise, the mean shape
# would be the best completion.
_MOST_NOISE = 10
# Variances below this multiple of the total variance are rounding errors.
_SMALLEST = 1e-12


@dataclass(frozen=True, eq=False)
class Posterior:
    """The distribution of a whole shape, given the positions of some of its vertices.

    The shape is `mean` plus the sum of the factors, with independent standard normal numbers as coefficients,
    plus an independent residual of each coordinate. All lengths are in one unit.

    **Attributes:**

    - `mean`: the posterior mean of the vertices (n, 3).
    - `factors`: displacements of the vertices (q, n, 3), whose outer products sum to the covariance matrix.
    - `residual`: the standard deviation of the residual of each coordinate.
    """

    mean: Float64[np.ndarray, "n 3"]
    factors: Float64[np.ndarray, "q n 3"]
    residual: float

    @property
    def covariances(self) -> Float64[np.ndarray, "n 3 3"]:
        """The covariance matrix of the position of each vertex (n, 3, 3)."""
        fields = self.factors.transpose(1, 2, 0)
        return fields @ fields.transpose(0, 2, 1) + self.residual**2 * np.eye(3)

    @property
    def standard_deviation(self) -> Float64[np.ndarray, " n"]:
        """The standard deviation of each vertex (n,): the root of the mean variance of its coordinates."""
        return np.sqrt((self.factors**2).sum(axis=(0, 2)) / 3 + self.residual**2)

    def radii(self, probability: float = _SHARE) -> Float64[np.ndarray, " n"]:
        """Return the radii (n,) of balls around the vertices that hold the true vertices with a probability.

        The squared distance is a sum of scaled chi-squared variables. A scaled chi-squared distribution with
        the same mean and variance replaces its distribution (Satterthwaite 1946).

        **Raises:** `InputError` if the probability is not between 0 and 1.
        """
        check_number("probability", probability, most=1.0)
        covariances = self.covariances
        variance, squares = np.trace(covariances, axis1=1, axis2=2), (covariances**2).sum(axis=(1, 2))
        return np.sqrt(squares / variance * chi2.ppf(probability, variance**2 / squares))

    def sample(self, seed: int) -> Float64[np.ndarray, "n 3"]:
        """Draw the vertices of a random shape (n, 3) from the posterior, given a seed of at least 0."""
        random = np.random.default_rng(check_whole_number("seed", seed, 0))
        shape = self.mean + np.tensordot(random.standard_normal(len(self.factors)), self.factors, axes=1)
        return shape + self.residual * random.standard_normal(shape.shape)


@dataclass(frozen=True, eq=False)
class GaussianModel:
    """A normal distribution of shapes with n vertices.

    **Attributes:**

    - `mean`: the mean of the vertices (n, 3).
    - `factors`: displacements of the vertices (p, n, 3), whose coefficients are independent.
    - `variances`: the variances of the coefficients (p,). An infinite variance means that nothing is known
      about the coefficient, such as a translation.
    - `residual`: the standard deviation of the independent residual of each coordinate.
    """

    mean: Float64[np.ndarray, "n 3"]
    factors: Float64[np.ndarray, "p n 3"]
    variances: Float64[np.ndarray, " p"]
    residual: float

    def condition(
        self, observed: Bool[np.ndarray, " n"], positions: Float64[np.ndarray, "o 3"], noise: float
    ) -> tuple[Posterior, Float64[np.ndarray, " p"]]:
        """Compute the distribution of the shape, given the positions of the observed vertices.

        An observed position is the mean plus the combination of factors plus noise. This is the posterior
        shape model of Albrecht, Lüthi, Gerig and Vetter ("Posterior shape models", MedIA 2013).

        **Arguments:**

        - `observed`: a mask of the vertices (n,).
        - `positions`: the positions of the observed vertices (o, 3), in the unit of the model.
        - `noise`: the standard deviation of the noise of each coordinate, positive.

        **Returns:** The `Posterior` and the means of the coefficients (p,).
        """
        seen = self.factors[:, observed].reshape(len(self.factors), -1)
        goals = (positions - self.mean[observed]).ravel()
        with one_blas_thread():
            means, root = _solve(seen @ seen.T, seen @ goals, 1 / self.variances, noise)
            mean = self.mean + np.tensordot(means, self.factors, axes=1)
            return Posterior(mean, np.tensordot(root.T, self.factors, axes=1), self.residual), means


def _solve(
    gram: Float64[np.ndarray, "p p"],
    products: Float64[np.ndarray, " p"],
    precisions: Float64[np.ndarray, " p"],
    noise: float,
) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p p"]]:
    """Return the posterior means of the coefficients (p,), and a root R of their covariance R Rᵀ."""
    precision = gram / noise**2 + np.diag(precisions)
    # Factors have different units. With a unit diagonal, the Cholesky decomposition is accurate.
    sizes = 1 / np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
    try:
        lower = np.linalg.cholesky(sizes[:, None] * precision * sizes)
    except np.linalg.LinAlgError:
        raise InputError("the observed vertices do not determine the position: give a larger part.") from None
    root = sizes[:, None] * scipy.linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).T
    return root @ (root.T @ products) / noise**2, root


class _Estimate(NamedTuple):
    """A distribution of coordinates in the basis of all modes, and of smooth fields beyond the modes."""

    center: Float64[np.ndarray, " r"]
    directions: Float64[np.ndarray, "k r"]
    variances: Float64[np.ndarray, " k"]
    spectrum: Float64[np.ndarray, " j"]  # the variance of the coefficients of each smooth function
    residual: float  # the variance that is left, of each coordinate


class Family:
    """Shapes with the same n vertices, from which Gaussian models are estimated.

    What the modes of few shapes leave out is smooth, so it is correlated between vertices. It is described by
    combinations of smooth functions on the mean shape, whose variances do not increase with their frequency.
    These variances and the residual are maximum-likelihood estimates from shapes that were left out.
    """

    def __init__(
        self,
        mean: Float64[np.ndarray, "n 3"],
        modes: Float64[np.ndarray, "r n 3"],
        scores: Float64[np.ndarray, "N r"],
        weights: Float64[np.ndarray, " n"],
        functions: Float64[np.ndarray, "n j"],
    ) -> None:
        """Take the complete shape model of N shapes, and smooth functions, the smoothest first."""
        self.mean, self.modes, self.scores, self.weights = mean, modes, scores, weights
        roots = np.sqrt(weights)[:, None]
        orthonormal, _ = np.linalg.qr(roots * functions)
        self.functions = np.divide(orthonormal, roots, out=np.zeros_like(orthonormal), where=roots > 0)
        # The coefficients of the modes in the smooth functions.
        self._smooth = np.einsum("vj,v,rvc->rjc", self.functions, weights, modes, optimize=True)
        self._whole = self._estimate(scores)
        self._others = [self._estimate(np.delete(scores, i, axis=0)) for i in range(len(scores))]

    def _estimate(self, scores: Float64[np.ndarray, "N r"]) -> _Estimate:
        residuals = np.zeros_like(scores)
        for i, left_out in enumerate(scores):
            center, directions, _ = _components(np.delete(scores, i, axis=0))
            away = left_out - center
            residuals[i] = away - (away @ directions.T) @ directions
        smooth = np.tensordot(residuals, self._smooth, axes=1)
        spectrum = isotonic_regression((smooth**2).mean(axis=(0, 2)), increasing=False).x
        left = (residuals**2).sum() - (smooth**2).sum()
        smallest = _SMALLEST * max(float(scores.var(axis=0).sum()), np.finfo(float).tiny)
        return _Estimate(
            *_components(scores),
            spectrum[spectrum > smallest],
            max(float(left) / (3 * len(scores)), smallest),
        )

    @property
    def spread(self) -> float:
        """The standard deviation of the shapes around their mean, of each coordinate."""
        return float(np.sqrt(self.scores.var(axis=0).sum() / 3))

    def model(self, motions: Float64[np.ndarray, "g n 3"]) -> GaussianModel:
        """Return the distribution of a further shape, up to motions of which nothing is known."""
        kind, fields = self._whole, self._fields(motions)
        return GaussianModel(
            self.mean + np.tensordot(kind.center, self.modes, axes=1),
            np.tensordot(self._factors(kind, len(motions)), fields, axes=1),
            _variances(kind, len(motions)),
            float(np.sqrt(kind.residual)),
        )

    def _fields(self, motions: Float64[np.ndarray, "g n 3"]) -> Float64[np.ndarray, "p n 3"]:
        n, number = self.functions.shape
        smooth = np.einsum("vj,cd->jcvd", self.functions, np.eye(3)).reshape(3 * number, n, 3)
        return np.concatenate([self.modes, smooth, motions])

    def _factors(self, kind: _Estimate, motions: int) -> Float64[np.ndarray, "q p"]:
        """Return the factors of an estimate as combinations of `_fields`."""
        smooth = np.eye(3 * len(kind.spectrum), 3 * self.functions.shape[1])
        return scipy.linalg.block_diag(kind.directions, smooth, np.eye(motions))

    def calibrate(
        self,
        motions: Float64[np.ndarray, "g n 3"],
        observed: Bool[np.ndarray, " n"],
        error: float,
    ) -> tuple[float, float]:
        """Find the noise and the calibration with which parts of shapes that were left out are completed.

        Each shape is completed from its observed vertices by a model of the other shapes. A random
        combination of the smooth functions is added to the observed positions, because the errors of maps are
        smooth. `error` is its root mean square length. The noise has the largest
        predictive likelihood of the hidden vertices. It is larger than the residual, because neighbouring
        vertices have similar residuals and errors. The calibration is the factor of the standard deviations
        with which the radii of a further shape hold 90 % of its true hidden vertices.

        **Returns:** The noise, a standard deviation in the unit of the shapes, and the calibration.
        """
        hidden = np.flatnonzero(~observed if not observed.all() else observed)
        hidden = hidden[:: -(-len(hidden) // _EVALUATED)]
        fields = self._fields(motions)
        seen, unseen = fields[:, observed].reshape(len(fields), -1), fields[:, hidden]
        gram, modes = seen @ seen.T, len(self.modes)
        smooth = slice(modes, modes + 3 * self.functions.shape[1])
        random = np.random.default_rng(0)
        cases = []
        for kind, left_out in zip(self._others, self.scores, strict=True):
            factors, away = self._factors(kind, len(motions)), left_out - kind.center
            field = random.standard_normal(smooth.stop - smooth.start)
            field *= error / np.linalg.norm(field)
            cases.append(
                (
                    factors @ gram @ factors.T,
                    factors @ (gram[:, :modes] @ away + gram[:, smooth] @ field),
                    1 / _variances(kind, len(motions)),
                    np.tensordot(factors, unseen, axes=1),
                    np.tensordot(away, unseen[:modes], axes=1),
                    float(np.sqrt(kind.residual)),
                )
            )

        def completed(noise: float) -> Sequence[Posterior]:
            """Return the distributions of the errors at the hidden vertices."""
            results = []
            for products, goals, precisions, factors, true, residual in cases:
                means, root = _solve(products, goals, precisions, noise)
                errors = np.tensordot(means, factors, axes=1) - true
                results.append(Posterior(errors, np.tensordot(root.T, factors, axes=1), residual))
            return results

        def surprise(logarithm: float) -> float:
            return float(np.mean([_surprise(one) for one in completed(float(np.exp(logarithm)))]))

        least = np.sqrt(self._whole.residual)
        most = max(_MOST_NOISE * self.spread, 2 * least)
        with one_blas_thread():
            found = minimize_scalar(surprise, bounds=np.log([least, most]), options={"xatol": 0.1})
            noise = float(np.exp(found.x))
            ratios = np.array(
                [np.linalg.norm(one.mean, axis=1) / one.radii(_SHARE) for one in completed(noise)]
            )
        # Vertices of one shape have similar errors, so the N shapes are a small sample. A further value of a
        # small normal sample has Student's t distribution, which is wider. (Entry R52)
        number = len(cases)
        level = (1 + _SHARE) / 2
        wider = student.ppf(level, number - 1) / normal.ppf(level) * np.sqrt(1 + 1 / number)
        return noise, float(wider * np.quantile(ratios, _SHARE))


def _surprise(errors: Posterior) -> float:
    """Return the mean negative logarithm of the density of the errors, up to a constant."""
    covariances = errors.covariances
    solved = np.linalg.solve(covariances, errors.mean[:, :, None])[:, :, 0]
    return float(((solved * errors.mean).sum(axis=1) + np.linalg.slogdet(covariances)[1]).mean() / 2)


def _variances(kind: _Estimate, motions: int) -> Float64[np.ndarray, " q"]:
    return np.concatenate([kind.variances, np.repeat(kind.spectrum, 3), np.full(motions, np.inf)])


def _components(
    scores: Float64[np.ndarray, "N r"],
) -> tuple[Float64[np.ndarray, " r"], Float64[np.ndarray, "k r"], Float64[np.ndarray, " k"]]:
    """Return the mean of some shapes, their principal components and the variances along them."""
    center = scores.mean(axis=0)
    _, values, right = np.linalg.svd(scores - center, full_matrices=False)
    kept = values**2 > _SMALLEST * max(float((values**2).sum()), np.finfo(float).tiny)
    return center, right[kept], values[kept] ** 2 / max(len(scores) - 1, 1)
