"""The variants that the study compares: frames, updates of the functional map, conventions, and ablations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64
from scipy.optimize import brentq

from jaxsmw.core.arrays import Array
from jaxsmw.core.banks import (
    CubicSpline,
    ExponentialWindow,
    FilterBank,
    Gabor,
    HalfCosine,
    Heat,
    Held,
    Identity,
    Itersine,
    Logarithm,
    LowPass,
    MexicanHat,
    Meyer,
    Papadakis,
    Regular,
    Simoncelli,
    SimpleTight,
    SpectralDistribution,
    Warped,
    frame_bounds,
    frame_function,
    tighten,
)
from jaxsmw.core.functional_map import (
    Convention,
    FunctionalMap,
    PointwiseMap,
    WaveletProblem,
    multiscale_kernel,
)
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions.closed_form import (
    Filtering,
    LeastSquares,
    NearestOrthogonal,
    PreparedFiltering,
    Solution,
)
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.core.spectrum import Spectrum

PreparedT = TypeVar("PreparedT")

CONVENTIONS: tuple[Convention, ...] = ("pullback", "pushforward")


class Variant(NamedTuple):
    """A frame, an update (a way to compute the functional map) and a convention."""

    frame: str
    update: str
    convention: Convention


DEFAULT = Variant("Meyer", "filtering", "pullback")

UPDATES: dict[str, Solution] = {
    "filtering": Filtering(),
    "least squares (area)": LeastSquares(),
    "least squares (Frobenius)": LeastSquares(norm="frobenius"),
    "regularized": RegularizedLeastSquares(),
}


def frames(number_of_filters: int) -> dict[str, FilterBank]:
    """Return a dictionary from the name of each compared filter bank to the bank.

    All banks whose size can be chosen have `number_of_filters` filters.
    """
    not_tight = {
        "cubic spline": CubicSpline(number_of_filters),
        "Mexican hat": MexicanHat(number_of_filters),
        # Adjacent scales are one octave apart, as in the Meyer frame.
        "heat": Heat(jnp.asarray(2.0 ** np.arange(number_of_filters))),
        "Gabor": Gabor(number_of_filters),
    }
    return {
        "Meyer": Meyer(number_of_filters),
        "simple tight": SimpleTight(number_of_filters),
        "itersine": Itersine(number_of_filters),
        "half-cosine": HalfCosine(number_of_filters),
        "Meyer, warped by the spectrum": Warped(Meyer(number_of_filters), SpectralDistribution()),
        "itersine, warped by the spectrum": Warped(Itersine(number_of_filters), SpectralDistribution()),
        "half-cosine, warped by a logarithm": Warped(HalfCosine(number_of_filters), Logarithm()),
        "Held (2 filters)": Held(),
        "Simoncelli (2 filters)": Simoncelli(),
        "Papadakis (2 filters)": Papadakis(),
        "regular (2 filters)": Regular(),
        **not_tight,
        **{f"{name}, scaled": Scaled(bank) for name, bank in not_tight.items()},
        **{f"{name}, tightened": tighten(bank) for name, bank in not_tight.items()},
        "exponential window (1 filter)": ExponentialWindow(),
        "low-pass (1 filter)": LowPass(),
        "no filter": Identity(),
    }


QUICK_FRAMES = (
    "Meyer",
    "cubic spline",
    "cubic spline, scaled",
    "cubic spline, tightened",
    "low-pass (1 filter)",
    "no filter",
)

# Each ablation combines a frame with an update that `UPDATES` does not contain. A gain is a factor by which C
# is multiplied. In the nearest-neighbour search, C maps either the queries or the targets, but not both.
# Therefore the gain changes the matches.
GAINS = {f"filtering x {gain}": gain for gain in (0.7, 1.2, 1.5, 2.0, 3.0)}
ABLATIONS = (
    ("Meyer", "projected"),
    ("no filter", "projected"),
    ("Meyer", "band mask"),
    *(("Meyer", name) for name in GAINS),
)


def variants(frame_names: Iterable[str]) -> list[Variant]:
    """Return all variants: every frame with every update in both conventions, and the ablations."""
    grid = [(frame, update) for frame in frame_names for update in UPDATES]
    return [Variant(*cell, convention) for convention in CONVENTIONS for cell in (*grid, *ABLATIONS)]


def twins(names: Iterable[Variant], banks: Mapping[str, FilterBank]) -> dict[Variant, Variant]:
    """Return a dictionary from variants to their twins: other variants that provably give the same result.

    In the pushforward convention and the area norm, least squares divides the columns of the filtered map by
    the frame function. The frame function of a Parseval frame is 1, so least squares equals filtering.
    """
    return {
        name: name._replace(update="filtering")
        for name in names
        if name.update == "least squares (area)"
        and name.convention == "pushforward"
        and is_parseval(banks[name.frame])
    }


def is_parseval(bank: FilterBank) -> bool:
    """Return whether the frame function of a bank is 1 everywhere in [0, lambda_max], up to rounding."""
    bounds = eqx.filter_jit(frame_bounds)(bank, jnp.arange(100.0), over="interval")
    return bool(np.allclose(bounds, 1, atol=1e-5))


class TabulatedPreservation(WaveletPreservation):
    """`WaveletPreservation` with tabulated responses of the bank on both shapes.

    With tabulated responses, all banks share one compiled program.
    """

    responses_x: Float[Array, "filters k_x"] = eqx.field(kw_only=True)
    responses_y: Float[Array, "filters k_y"] = eqx.field(kw_only=True)

    def problem(self, spectrum_x: Spectrum, spectrum_y: Spectrum, *, sampled: bool = False) -> WaveletProblem:
        return WaveletProblem(
            spectrum_x, spectrum_y, self.responses_x, self.responses_y, self.convention, sampled
        )


class BandMask(Filtering):
    """`Filtering` with a given mask instead of the multiscale kernel of the frame."""

    mask: Float[Array, "k_out k_in"] = eqx.field(kw_only=True)

    def prepare(self, problem: WaveletProblem) -> PreparedFiltering:
        return super().prepare(problem)._replace(kernel=self.mask)


class Scaled(FilterBank):
    """A filter bank, scaled so that its frame function has a mean of 1 over a shape's eigenvalues.

    Scaling changes only the height of the filters. `tighten` changes both the height and the shapes of the
    filters.
    """

    bank: FilterBank

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        height = jnp.mean(frame_function(self.bank(eigenvalues, eigenvalues)))
        return self.bank(points, eigenvalues) / jnp.sqrt(height)


class Amplified(Solution[PreparedT]):
    """A solution whose functional map is multiplied by a number."""

    solution: Solution[PreparedT]
    gain: Float[Array, ""]

    def prepare(self, problem: WaveletProblem) -> PreparedT:
        return self.solution.prepare(problem)

    def solve(
        self,
        problem: WaveletProblem,
        prepared: PreparedT,
        pointwise_map: PointwiseMap,
        previous: FunctionalMap | None,
    ) -> tuple[FunctionalMap, RESULTS]:
        functional_map, result = self.solution.solve(problem, prepared, pointwise_map, previous)
        return self.gain * functional_map, result


def refiner(
    variant: Variant,
    bank: FilterBank,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    number_of_filters: int,
) -> TabulatedPreservation:
    """Return the refiner of a variant for a pair.

    The bank is extended by zero filters until it has `number_of_filters` filters.
    """
    tables = [tabulate(bank, spectrum, number_of_filters) for spectrum in (spectrum_x, spectrum_y)]
    if variant.update == "projected":
        solution: Solution = NearestOrthogonal(Filtering())
    elif variant.update in GAINS:
        solution = Amplified(Filtering(), jnp.asarray(GAINS[variant.update], tables[0].dtype))
    elif variant.update == "band mask":
        spectrum_out, spectrum_in = spectrum_x, spectrum_y
        kernel = multiscale_kernel(*tables)
        if variant.convention == "pushforward":
            spectrum_out, spectrum_in, kernel = spectrum_y, spectrum_x, kernel.T
        octaves_out, octaves_in = (
            octaves(np.asarray(spectrum.eigenvalues), number_of_filters)
            for spectrum in (spectrum_out, spectrum_in)
        )
        half_width = matching_half_width(octaves_out, octaves_in, float(kernel.sum()))
        solution = BandMask(mask=jnp.asarray(band_mask(octaves_out, octaves_in, half_width), kernel.dtype))
    else:
        solution = UPDATES[variant.update]
    return TabulatedPreservation(
        solution=solution, convention=variant.convention, responses_x=tables[0], responses_y=tables[1]
    )


_sample_bank: Callable[[FilterBank, Array], Array] = eqx.filter_jit(
    lambda bank, eigenvalues: bank(eigenvalues, eigenvalues)
)


def tabulate(bank: FilterBank, spectrum: Spectrum, number_of_filters: int) -> Float[Array, "filters k"]:
    """Return the responses of a bank on a shape, with zero rows appended up to `number_of_filters`."""
    responses = _sample_bank(bank, spectrum.eigenvalues)
    return jnp.pad(responses, ((0, number_of_filters - len(responses)), (0, 0)))


def octaves(eigenvalues: Float[np.ndarray, " k"], number_of_filters: int) -> Float64[np.ndarray, " k"]:
    """Return the number of octaves from the edge of the Meyer scaling function to each eigenvalue.

    The number is 0 for eigenvalues below this edge.
    """
    edge = eigenvalues[-1] * 2.0 ** (1 - number_of_filters)
    return np.log2(np.maximum(eigenvalues.astype(float), edge) / edge)


def band_mask(
    octaves_out: Float64[np.ndarray, " k_out"], octaves_in: Float64[np.ndarray, " k_in"], half_width: float
) -> Float64[np.ndarray, "k_out k_in"]:
    """Return a smooth mask around the diagonal. No filter bank has this mask as its kernel.

    The variable d is the distance from the diagonal in octaves, divided by the half-width. The mask is 1 for
    d <= 0.5, falls like a cosine from d = 0.5 to d = 1.5, and is 0 for d >= 1.5. If both spectra are
    equal, the mask has negative eigenvalues, because its top is flat. The kernel `G^T G` of a filter bank has
    no negative eigenvalues.
    """
    distance = np.abs(octaves_out[:, None] - octaves_in[None, :])
    return 0.5 * (1 + np.cos(np.pi * np.clip(distance / half_width - 0.5, 0, 1)))


def matching_half_width(
    octaves_out: Float64[np.ndarray, " k_out"], octaves_in: Float64[np.ndarray, " k_in"], total: float
) -> float:
    """Return the half-width, in octaves, for which the entries of `band_mask` sum to `total`."""
    return brentq(lambda width: band_mask(octaves_out, octaves_in, width).sum() - total, 1e-3, 100)


def least_kernel_eigenvalue(
    variant: Variant, bank: FilterBank, spectrum: Spectrum, *, number_of_filters: int
) -> float:
    """Return the ratio of the smallest to the largest eigenvalue of the kernel of a variant.

    The kernel is computed for the pair of a shape with itself. The variant multiplies the unfiltered
    functional map elementwise by this kernel. Up to rounding, the ratio is nonnegative for every filter bank.
    The ratio is negative for `band_mask`.
    """
    method = refiner(variant, bank, spectrum, spectrum, number_of_filters=number_of_filters)
    kernel = multiscale_kernel(method.responses_x, method.responses_y)
    if isinstance(method.solution, BandMask):
        kernel = method.solution.mask
    eigenvalues = np.linalg.eigvalsh(np.asarray(kernel, dtype=float))
    return float(eigenvalues[0] / eigenvalues[-1])
