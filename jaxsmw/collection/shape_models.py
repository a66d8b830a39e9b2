"""The statistical shape model of a collection: generalised Procrustes alignment, mean shape and modes.

All shapes have the same n vertices, and vertex i is the same point of the body on every shape. Means over the
surface are weighted sums over the vertices, and the weights sum to 1. The distance of two shapes is therefore
in the unit of length of the shapes, and does not depend on the resolution.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float64, Real
from scipy.spatial.distance import cdist

from jaxsmw.errors import InputError, check_whole_number
from jaxsmw.geometry.alignment import nearest_rotations
from jaxsmw.geometry.mesh import numeric_rows
from jaxsmw.runtime.threads import one_blas_thread

# The alignment ends when the mean changes by less than this multiple of its size, or after `_MOST_ROUNDS`.
_TOLERANCE = 1e-10
_MOST_ROUNDS = 1000
# Modes are left out if their standard deviation is below this multiple of the size of the mean.
_SMALLEST_DEVIATION = 1e-6
# The absolute values of two scores count as equal if their relative difference is below this number.
# Rounding errors therefore do not change the sign of a mode.
_EQUAL_SCORES = 1e-6
# The number of vertices for which displacements are computed at once.
_BLOCK = 1024

Shapes = Real[np.ndarray, "N n 3"] | Sequence[Real[np.ndarray, "_ 3"]]
"""The positions of n corresponding vertices on N shapes, as one array or as a sequence of arrays (n, 3)."""


@dataclass(frozen=True, eq=False)
class ProcrustesAlignment:
    """The result of `align`. Vertex v of shape i moves to `scales[i] * rotations[i] @ v + translations[i]`.

    **Attributes:**

    - `aligned`: the aligned shapes (N, n, 3), in the unit of length of the shapes.
    - `mean`: the mean of the aligned shapes (n, 3), in the same unit.
    - `rotations`: a rotation without reflection for each shape (N, 3, 3).
    - `translations`: a translation for each shape (N, 3), in the same unit.
    - `scales`: a positive factor for each shape (N,). The factors are 1 if shapes keep their size.
    - `weights`: the weights of the vertices (n,), with the sum 1.
    - `scaled`: whether the alignment changed the sizes of shapes.
    """

    aligned: Float64[np.ndarray, "N n 3"]
    mean: Float64[np.ndarray, "n 3"]
    rotations: Float64[np.ndarray, "N 3 3"]
    translations: Float64[np.ndarray, "N 3"]
    scales: Float64[np.ndarray, " N"]
    weights: Float64[np.ndarray, " n"]
    scaled: bool


def align(
    shapes: Shapes,
    *,
    scale: bool = False,
    weights: Real[np.ndarray, " _"] | None = None,
    reference: int = 0,
) -> ProcrustesAlignment:
    """Align shapes to their mean, by generalised Procrustes analysis.

    Each round moves every shape to the mean, in the least-squares sense, and then updates the mean (Gower,
    "Generalized Procrustes analysis", Psychometrika 1975; Goodall, "Procrustes methods in the statistical
    analysis of shape", JRSS B 1991). The first mean is the reference shape. The rounds end when the mean
    changes by less than 1e-10 of its centroid size, or after 1000 rounds.

    **Arguments:**

    - `shapes`: the positions of n corresponding vertices on N shapes, as an array (N, n, 3) or a sequence of
      arrays (n, 3). Without `scale`, all shapes need the same unit of length.
    - `scale`: whether to scale each shape to fit the mean in the least-squares sense. One common factor then
      gives the mean the average size of the given shapes.
    - `weights`: non-negative weights of the vertices (n,), such as vertex areas. By default, all weights are
      equal.
    - `reference`: the 0-based index of the shape whose rotation and centroid do not change.

    **Returns:** A `ProcrustesAlignment`, in the unit of length of the shapes.

    **Raises:** `InputError` if an argument is not as described, or a shape is a single point.
    """
    points = _checked(shapes)
    count, n, _ = points.shape
    shares = _checked_weights(weights, n)
    reference = check_whole_number("reference", reference, 0, count - 1)
    if not isinstance(scale, bool | np.bool):
        raise InputError(f"scale is {scale!r}: give True or False.")
    centroids = np.einsum("v,ivc->ic", shares, points)
    products = _inner_products(points, centroids, shares)
    squared_sizes = np.einsum("icic->i", products)
    for index in np.flatnonzero(_is_point(squared_sizes, centroids)):
        raise InputError(f"shape {index} is a single point; leave the shape out.")

    rotations, scales = _rotations_and_scales(products, squared_sizes, reference, scale=scale)
    rotations = rotations[reference].T @ rotations
    rotations[reference] = np.eye(3)
    translations = centroids[reference] - scales[:, None] * np.einsum("icd,id->ic", rotations, centroids)
    aligned = np.empty_like(points)
    for i, shape in enumerate(points):
        # Centred coordinates have small rounding errors, even if a shape is far from the origin.
        aligned[i] = scales[i] * ((shape - centroids[i]) @ rotations[i].T) + centroids[reference]
    return ProcrustesAlignment(aligned, aligned.mean(axis=0), rotations, translations, scales, shares, scale)


class DistanceCurve(NamedTuple):
    """The mean of distances for each number of modes, and its standard error, in the unit of the shapes."""

    numbers_of_modes: tuple[int, ...]
    mean: Float64[np.ndarray, " numbers"]
    standard_error: Float64[np.ndarray, " numbers"]

    @classmethod
    def of(cls, numbers: tuple[int, ...], distances: Float64[np.ndarray, "numbers p"]) -> DistanceCurve:
        """Average distances (numbers, p) over their second axis."""
        error = distances.std(axis=1, ddof=1) / np.sqrt(distances.shape[1])
        return cls(numbers, distances.mean(axis=1), error)


@dataclass(frozen=True, eq=False)
class ShapeModel:
    """The mean of aligned shapes and the modes in which the shapes differ from the mean.

    The modes are the principal components of the shapes (Cootes, Taylor, Cooper, Graham, "Active shape
    models", CVIU 1995), for the inner product sum_i w_i u_i · v_i of displacements u and v with the weights w
    of the vertices. If one score changes by s, the root mean square displacement over the surface is s.

    **Attributes:**

    - `alignment`: the `ProcrustesAlignment` of the N shapes.
    - `modes`: the displacements of each mode (k, n, 3), without unit and orthonormal. The score of each mode
      with the largest absolute value is positive.
    - `variances`: the variance of the scores of each mode (k,), decreasing, in squared units of length. Sums
      of squares are divided by N - 1.
    - `scores`: the inner products (N, k) of the displacements of each shape with the modes, in units of
      length.
    - `total_variance`: the sum of the variances of all modes, including modes that the model leaves out.
    """

    alignment: ProcrustesAlignment
    modes: Float64[np.ndarray, "k n 3"]
    variances: Float64[np.ndarray, " k"]
    scores: Float64[np.ndarray, "N k"]
    total_variance: float

    def __repr__(self) -> str:
        count, n, _ = self.aligned.shape
        return f"ShapeModel({count} shapes, {n} vertices, {len(self.modes)} modes)"

    @property
    def mean(self) -> Float64[np.ndarray, "n 3"]:
        """The mean of the aligned shapes (n, 3)."""
        return self.alignment.mean

    @property
    def aligned(self) -> Float64[np.ndarray, "N n 3"]:
        """The aligned shapes (N, n, 3)."""
        return self.alignment.aligned

    @property
    def weights(self) -> Float64[np.ndarray, " n"]:
        """The weights of the vertices (n,), with the sum 1."""
        return self.alignment.weights

    def shape(self, scores: Real[np.ndarray, " j"]) -> Float64[np.ndarray, "n 3"]:
        """Return the vertices (n, 3) of the shape whose first j modes have the given scores (j,).

        All other scores are 0. Positions and scores are in the unit of length of the model.

        **Raises:** `InputError` if there are more scores than modes, or a score is not finite.
        """
        scores = _numbers("scores", scores)
        if scores.ndim != 1 or len(scores) > len(self.modes) or not np.isfinite(scores).all():
            raise InputError(
                f"the scores have shape {scores.shape}: give at most {len(self.modes)} finite numbers, one "
                "for each mode."
            )
        return self.mean + np.tensordot(scores, self.modes[: len(scores)], axes=1)

    def project(self, shape: Real[np.ndarray, "_ 3"]) -> Float64[np.ndarray, " k"]:
        """Return the scores (k,) of a shape (n, 3), after its alignment to the mean, in units of length.

        The unit of the shape matters only if the model does not remove differences of size. For a shape of
        the collection, the result equals its row in the attribute `scores`.

        **Raises:** `InputError` if the shape has another number of vertices or is a single point.
        """
        shape = numeric_rows(shape, "vertices", "the shape").astype(np.float64)
        if len(shape) != len(self.mean):
            raise InputError(f"the shape has {len(shape)} vertices, but the model has {len(self.mean)}.")
        if not np.isfinite(shape).all():
            raise InputError("the shape has coordinates that are not finite; give finite coordinates.")
        centroid = self.weights @ shape
        centered = shape - centroid
        mean = self.mean - self.weights @ self.mean
        squared_size = float(self.weights @ (centered**2).sum(axis=1))
        if _is_point(squared_size, centroid):
            raise InputError("the shape is a single point; give a shape with distinct vertices.")
        weighted = self.weights[:, None] * mean
        rotations, fit = nearest_rotations((weighted.T @ centered)[None])
        factor = fit[0] / squared_size * self._common_factor(mean) if self.alignment.scaled else 1.0
        displacements = factor * (centered @ rotations[0].T) - mean
        return np.einsum("v,vc,kvc->k", self.weights, displacements, self.modes, optimize=True)

    def _common_factor(self, mean: Float64[np.ndarray, "n 3"]) -> float:
        """Return the factor that `align` applies to shapes after their least-squares fit to the mean."""
        # Every aligned shape A satisfies |A|² = factor * <A, mean>. Averaged over all shapes, the left side
        # is |mean|² plus the variance, and the right side is factor * |mean|².
        squared_mean = float(self.weights @ (mean**2).sum(axis=1))
        count = len(self.scores)
        return 1 + self.total_variance * (count - 1) / count / squared_mean

    def compactness(self) -> Float64[np.ndarray, " k"]:
        """Return the shares of the total variance (k,): entry i is the share of the first i + 1 modes."""
        # Without variance there are no modes, and the result is empty.
        return np.cumsum(self.variances) / (self.total_variance or 1.0)

    def generalisation(self, numbers_of_modes: Sequence[int]) -> DistanceCurve:
        """Measure how well the model describes new shapes, by leaving out one shape at a time.

        A model of the other N - 1 shapes reconstructs the shape that was left out (Davies, "Learning shape:
        optimal models for analysing natural variability", 2002; Styner et al., "Evaluation of 3D
        correspondence methods for model building", IPMI 2003). The error of a shape is the mean distance
        over the surface between the shape and its reconstruction. The shapes are not aligned again.

        **Arguments:**

        - `numbers_of_modes`: numbers of modes, from 0 (the mean alone) to N - 2.

        **Returns:** A `DistanceCurve` of the errors of the N shapes.
        """
        count = len(self.scores)
        if count < 2:
            raise InputError("leaving out one shape needs at least two shapes.")
        numbers = _checked_numbers(numbers_of_modes, count - 2, f"the other {count - 1} shapes determine")
        coordinates = _coordinates(self.alignment)
        residuals = np.zeros((len(numbers), *coordinates.shape))
        with one_blas_thread():
            for i, left_out in enumerate(coordinates):
                others = np.delete(coordinates, i, axis=0)
                mean = others.mean(axis=0)
                modes = _directions(others - mean, _smallest_norm(self.alignment))
                scores = modes @ (left_out - mean)
                for at, number in enumerate(numbers):
                    residuals[at, i] = left_out - mean - scores[:number] @ modes[:number]
        errors = np.array([self._mean_lengths(of_number, coordinates) for of_number in residuals])
        return DistanceCurve.of(numbers, errors.reshape(len(numbers), count))

    def specificity(
        self, numbers_of_modes: Sequence[int], *, samples: int = 1000, seed: int = 0
    ) -> DistanceCurve:
        """Measure how much random shapes of the model resemble shapes of the collection.

        The scores of a random shape have a normal distribution with the variances of the modes. Its distance
        is the mean distance over the surface from the shape of the collection at the smallest
        root-mean-square distance (Davies 2002; Styner et al. 2003).

        **Arguments:**

        - `numbers_of_modes`: numbers of modes, from 0 (the mean alone) to k.
        - `samples`: the number of random shapes, at least 2.
        - `seed`: the random seed. The random numbers of a mode do not depend on `numbers_of_modes`.

        **Returns:** A `DistanceCurve` of the distances of the random shapes.
        """
        samples = check_whole_number("samples", samples, 2)
        seed = check_whole_number("seed", seed, 0)
        numbers = _checked_numbers(numbers_of_modes, len(self.modes), "the model has")
        coordinates = _coordinates(self.alignment)
        # Random numbers are drawn mode by mode, so further modes do not change the numbers of the first
        # modes.
        normal = np.random.default_rng(seed).standard_normal((len(self.modes), samples)).T
        drawn = normal * np.sqrt(self.variances)
        distances = []
        for number in numbers:
            random_shapes = np.zeros((samples, coordinates.shape[1]))
            random_shapes[:, :number] = drawn[:, :number]
            if coordinates.shape[1]:
                random_shapes -= coordinates[cdist(random_shapes, coordinates).argmin(axis=1)]
            distances.append(self._mean_lengths(random_shapes, coordinates))
        return DistanceCurve.of(numbers, np.array(distances).reshape(len(numbers), samples))

    def _mean_lengths(
        self, fields: Float64[np.ndarray, "p r"], coordinates: Float64[np.ndarray, "N r"]
    ) -> Float64[np.ndarray, " p"]:
        """Return the mean lengths of displacement fields, given in the basis of `_coordinates`."""
        combinations = fields @ (coordinates / (coordinates**2).sum(axis=0)).T
        lengths = np.zeros(len(fields))
        for block, displacements in _displacements(self.alignment):
            values = (combinations @ displacements).reshape(len(fields), len(self.weights[block]), 3)
            lengths += np.sqrt(np.einsum("pvc,pvc->pv", values, values)) @ self.weights[block]
        return lengths


def shape_model(
    shapes: Shapes,
    *,
    scale: bool = False,
    weights: Real[np.ndarray, " _"] | None = None,
    reference: int = 0,
    number_of_modes: int | None = None,
) -> ShapeModel:
    """Align shapes, and compute their mean and the modes of their variation.

    **Arguments:**

    - `shapes`, `scale`, `weights`, `reference`: the arguments of `align`.
    - `number_of_modes`: the largest number of modes; None for all modes, at most N - 1. Modes whose standard
      deviation is below 1e-6 of the size of the mean are left out as rounding errors.

    **Returns:** A `ShapeModel`, in the unit of length of the shapes.

    **Raises:** `InputError` if an argument is not as described.
    """
    if number_of_modes is not None:
        number_of_modes = check_whole_number("number_of_modes", number_of_modes, 1)
    alignment = align(shapes, scale=scale, weights=weights, reference=reference)
    return modes_of(alignment, number_of_modes)


def modes_of(alignment: ProcrustesAlignment, number_of_modes: int | None = None) -> ShapeModel:
    """Compute the modes of aligned shapes; see `shape_model`."""
    coordinates = _coordinates(alignment)
    squared = (coordinates**2).sum(axis=0)
    variances = squared / max(len(coordinates) - 1, 1)
    scores = coordinates[:, :number_of_modes]
    modes = np.empty((scores.shape[1], *alignment.mean.shape))
    combinations = (scores / squared[:number_of_modes]).T
    for block, displacements in _displacements(alignment):
        modes[:, block] = (combinations @ displacements).reshape(modes[:, block].shape)
    return ShapeModel(alignment, modes, variances[:number_of_modes], scores, float(variances.sum()))


def _checked(shapes: Shapes) -> Float64[np.ndarray, "N n 3"]:
    if not isinstance(shapes, Iterable) or len(shapes) == 0:
        raise InputError("there is no shape; give at least one shape.")
    shapes = [numeric_rows(shape, "vertices", f"shape {index}") for index, shape in enumerate(shapes)]
    sizes = [len(shape) for shape in shapes]
    for index, size in enumerate(sizes):
        if size != sizes[0]:
            raise InputError(
                f"shape {index} has {size} vertices, but shape 0 has {sizes[0]}; give shapes in the "
                f"triangulation of one template."
            )
        if not np.isfinite(shapes[index]).all():
            raise InputError(f"shape {index} has coordinates that are not finite; leave the shape out.")
    return np.asarray(shapes, dtype=np.float64)


def _is_point(
    squared_sizes: Float64[np.ndarray, "*N"] | float, centroids: Float64[np.ndarray, "*N 3"]
) -> Bool[np.ndarray, "*N"] | np.bool_:
    """Return whether all vertices of a shape are at its centroid, except for rounding errors."""
    return squared_sizes <= (1e-12 * np.abs(centroids).max(axis=-1)) ** 2


def _checked_weights(weights: Real[np.ndarray, " _"] | None, n: int) -> Float64[np.ndarray, " n"]:
    if weights is None:
        return np.full(n, 1 / n)
    values = _numbers("weights", weights)
    if values.shape != (n,):
        raise InputError(f"the weights have shape {values.shape}: give {n} weights, one for each vertex.")
    if not (np.isfinite(values).all() and values.min() >= 0 and values.max() > 0):
        raise InputError("the weights must be finite, not negative and not all zero, such as vertex areas.")
    values = values / values.max()
    return values / values.sum()


def _numbers(name: str, values: object) -> Float64[np.ndarray, "*shape"]:
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise InputError(f"the {name} are {array.dtype.name}: give numbers.")
    return array.astype(np.float64)


def _checked_numbers(numbers: Sequence[int], most: int, reason: str) -> tuple[int, ...]:
    if not isinstance(numbers, Iterable):
        raise InputError(f"numbers_of_modes is {numbers!r}: give a list of whole numbers.")
    checked = tuple(check_whole_number("the number of modes", number) for number in numbers)
    for number in checked:
        if not 0 <= number <= most:
            raise InputError(f"the number of modes is {number}, but {reason} {most}; choose 0 to {most}.")
    return checked


def _inner_products(
    points: Float64[np.ndarray, "N n 3"],
    centroids: Float64[np.ndarray, "N 3"],
    weights: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "N 3 N 3"]:
    """Return the weighted inner products of the centred coordinates."""
    count = len(points)
    products = np.zeros((3 * count, 3 * count))
    for block in _blocks(len(weights)):
        rows = (points[:, block] - centroids[:, None]) * np.sqrt(weights[block])[:, None]
        rows = rows.transpose(0, 2, 1).reshape(3 * count, -1)
        products += rows @ rows.T
    return products.reshape(count, 3, count, 3)


def _rotations_and_scales(
    products: Float64[np.ndarray, "N 3 N 3"],
    squared_sizes: Float64[np.ndarray, " N"],
    reference: int,
    *,
    scale: bool,
) -> tuple[Float64[np.ndarray, "N 3 3"], Float64[np.ndarray, " N"]]:
    """Return the rotations and scales of all shapes, in rounds whose time does not depend on n."""
    count = len(squared_sizes)
    flat = products.reshape(3 * count, 3 * count)
    size = np.sqrt(squared_sizes).mean()
    # The mean shape is sum_i P_i (X_i - centroid_i). `combination` holds the 3 x 3 matrices P_i side by side.
    combination = np.zeros((3, 3 * count))
    combination[:, 3 * reference : 3 * reference + 3] = np.eye(3)
    with one_blas_thread():
        for _ in range(_MOST_ROUNDS):
            covariances = (combination @ flat).reshape(3, count, 3).transpose(1, 0, 2)
            rotations, fit = nearest_rotations(covariances)
            scales = fit / squared_sizes if scale else np.ones(count)
            updated = (scales[:, None, None] * rotations / count).transpose(1, 0, 2).reshape(3, 3 * count)
            if scale:
                factor = size / np.sqrt(_squared_norm(updated, flat))
                updated, scales = factor * updated, factor * scales
            change = np.sqrt(_squared_norm(updated - combination, flat))
            combination = updated
            if change <= _TOLERANCE * size:
                break
    return rotations, scales


def _squared_norm(combination: Float64[np.ndarray, "3 q"], products: Float64[np.ndarray, "q q"]) -> float:
    """Return the squared norm of a linear combination of shapes, given their inner products."""
    return max(float(np.sum((combination @ products) * combination)), 0.0)


def _blocks(n: int) -> Iterator[slice]:
    for start in range(0, n, _BLOCK):
        yield slice(start, min(start + _BLOCK, n))


def _displacements(alignment: ProcrustesAlignment) -> Iterator[tuple[slice, Float64[np.ndarray, "N q"]]]:
    """Yield each block of vertices with its displacements from the mean, one row per shape."""
    for block in _blocks(len(alignment.mean)):
        yield block, (alignment.aligned[:, block] - alignment.mean[block]).reshape(len(alignment.aligned), -1)


def _smallest_norm(alignment: ProcrustesAlignment) -> float:
    """Return the norm of the scores of a mode below which the mode is a rounding error."""
    centered = alignment.mean - alignment.weights @ alignment.mean
    size = np.sqrt(alignment.weights @ (centered**2).sum(axis=1))
    return float(_SMALLEST_DEVIATION * size * np.sqrt(max(len(alignment.aligned) - 1, 1)))


def _coordinates(alignment: ProcrustesAlignment) -> Float64[np.ndarray, "N r"]:
    """Return the scores of all modes: the coordinates of the shapes in the orthonormal basis of the modes."""
    # One QR decomposition per block of vertices reduces the displacements to an N x N matrix with the same
    # inner products. Its small singular values are accurate, unlike small eigenvalues of a matrix of inner
    # products.
    count = len(alignment.aligned)
    reduced = np.zeros((0, count))
    for block, displacements in _displacements(alignment):
        weighted = np.repeat(np.sqrt(alignment.weights[block]), 3)[:, None] * displacements.T
        reduced = scipy.linalg.qr(
            np.vstack([reduced, weighted]), mode="r", overwrite_a=True, check_finite=False
        )[0][:count]
    _, values, right = np.linalg.svd(reduced, full_matrices=False)
    scores = (values[:, None] * right)[values > _smallest_norm(alignment)].T
    sizes = np.abs(scores)
    first = (sizes >= (1 - _EQUAL_SCORES) * sizes.max(axis=0)).argmax(axis=0)
    return scores * np.sign(scores[first, np.arange(scores.shape[1])])


def _directions(centered: Float64[np.ndarray, "N r"], smallest: float) -> Float64[np.ndarray, "k r"]:
    """Return orthonormal directions of decreasing variance, without rounding errors."""
    if centered.size == 0:
        return np.zeros((0, centered.shape[1]))
    _, values, right = np.linalg.svd(centered, full_matrices=False)
    return right[values > smallest]
