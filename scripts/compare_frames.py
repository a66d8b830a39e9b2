"""Compares frames, ways to compute the functional map, and conventions, on remeshed FAUST and TOSCA.

    python scripts/compare_frames.py DATA_DIRECTORY [--output DIR] [--pairs N] [--workers N] [--quick]

DATA_DIRECTORY contains `faust_r` and `tosca_r` (docs/datasets.md). The pairs are evenly spread over the lists
of both sets. `jaxsmw.benchmark.compare` stores the results of each pair in three directories of DIR, from
which docs/frame_study.md makes its tables: `variants` (all frames and controls), and on a quarter of the
pairs `parameters` (the numbers of eigenvectors, filters and iterations) and `times` (a few variants in a
single process). The script writes all tables to `summary.md`. After an interruption, the same command
continues. With `--quick`, the script compares every twentieth variant on one pair of each set.
"""

from __future__ import annotations

import os

import numpy as np
from common import evenly_spread, make_parser, write_text
from jaxtyping import Float

from jaxsmw import InputError, LeastSquares, Stage, WaveletPreservation, banks
from jaxsmw.banks import CubicSpline, FilterBank, Identity, Meyer, SpectralDistribution, Warped, tighten
from jaxsmw.benchmark import compare, open_data_set
from jaxsmw.benchmark.comparison import Compared
from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.functional_map import WaveletProblem
from jaxsmw.core.solutions.closed_form import Filtering, NearestOrthogonal, PreparedFiltering, Solution
from jaxsmw.core.solutions.regularized import RegularizedLeastSquares
from jaxsmw.runtime.files import make_directory
from jaxsmw.runtime.provenance import made_with

FILTERS, ITERATIONS = 6, 5
SOLUTIONS: dict[str, Solution] = {
    "filtering": Filtering(),
    "least squares": LeastSquares(),
    "least squares, Frobenius norm": LeastSquares(norm="frobenius"),
    "regularized": RegularizedLeastSquares(),
}
TIMED = (*(f"Meyer: {name}" for name in SOLUTIONS), "cubic spline: filtering", "cubic spline: least squares")
EIGENVECTORS = (20, 40, 60, 80, 100, 120, 150)


class Scaled(FilterBank):
    """A bank, multiplied by a number that gives its frame function this mean over a shape's eigenvalues.

    `Filtering` with the scaled Meyer frame therefore multiplies the functional map C by the mean.
    """

    bank: FilterBank
    mean: float = 1.0

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        mean = banks.frame_function(self.bank(eigenvalues, eigenvalues)).mean()
        return self.bank(points, eigenvalues) * (self.mean / mean) ** 0.5


class BandMask(Filtering):
    """`Filtering` with a smooth mask around the diagonal in place of the kernel of a frame.

    With d the distance from the diagonal in octaves, divided by a half-width, the mask is 1 for d <= 0.5,
    falls like a cosine, and is 0 for d >= 1.5. Octaves count from the edge of the Meyer scaling function. The
    entries of the mask and of the kernel have the same sum. No filter bank has this mask as its kernel,
    because for equal spectra the mask has negative eigenvalues.
    """

    def prepare(self, problem: WaveletProblem) -> PreparedFiltering:
        prepared = super().prepare(problem)
        xp, total = namespace(prepared.kernel), prepared.kernel.sum()
        octaves_out, octaves_in = (
            xp.log2(xp.maximum(spectrum.eigenvalues / spectrum.eigenvalues[-1] * 2.0 ** (FILTERS - 1), 1))
            for spectrum in problem.spectra
        )
        distance = abs(octaves_out[:, None] - octaves_in[None, :])

        def mask(half_width: Array) -> Array:
            return 0.5 * (1 + xp.cos(np.pi * xp.clip(distance / half_width - 0.5, 0, 1)))

        low, high = xp.full_like(total, 1e-3), xp.full_like(total, 100)
        for _ in range(40):  # bisection
            middle = (low + high) / 2
            narrow = mask(middle).sum() < total
            low, high = xp.where(narrow, middle, low), xp.where(narrow, high, middle)
        return prepared._replace(kernel=mask(high))


def frames() -> dict[str, FilterBank]:
    """Return the compared banks by name, with `FILTERS` filters if their number can be chosen."""
    not_tight = {
        "cubic spline": CubicSpline(FILTERS),
        "Mexican hat": banks.MexicanHat(FILTERS),
        "heat": banks.Heat(2.0 ** np.arange(FILTERS)),  # one octave apart, as in the Meyer frame
        "Gabor": banks.Gabor(FILTERS),
    }
    return {
        "Meyer": Meyer(FILTERS),
        "simple tight": banks.SimpleTight(FILTERS),
        "itersine": banks.Itersine(FILTERS),
        "half-cosine": banks.HalfCosine(FILTERS),
        "Meyer, warped by the spectrum": Warped(Meyer(FILTERS), SpectralDistribution()),
        "itersine, warped by the spectrum": Warped(banks.Itersine(FILTERS), SpectralDistribution()),
        "half-cosine, warped by a logarithm": Warped(banks.HalfCosine(FILTERS), banks.Logarithm()),
        "Held (2 filters)": banks.Held(),
        "Simoncelli (2 filters)": banks.Simoncelli(),
        "Papadakis (2 filters)": banks.Papadakis(),
        "regular (2 filters)": banks.Regular(),
        **not_tight,
        **{f"{name}, scaled": Scaled(bank) for name, bank in not_tight.items()},
        **{f"{name}, tightened": tighten(bank) for name, bank in not_tight.items()},
        "exponential window (1 filter)": banks.ExponentialWindow(),
        "low-pass (1 filter)": banks.LowPass(),
        "no filter": Identity(),
    }


def variants() -> dict[str, Compared]:
    """Return all frames with all solutions, and the controls, by names such as `Meyer: least squares`."""
    grid = [(frame, name) for frame in frames() for name in SOLUTIONS]
    parts = {f"{frame}: {name}": (frames()[frame], SOLUTIONS[name]) for frame, name in grid}
    for factor in (0.7, 1.2, 1.5, 2, 3):
        parts[f"Meyer x {factor}: filtering"] = Scaled(Meyer(FILTERS), factor), Filtering()
    parts["Meyer: nearest orthogonal"] = Meyer(FILTERS), NearestOrthogonal()
    reversed_ = {name: pair for name, pair in parts.items() if name.endswith((": filtering", "orthogonal"))}
    parts["no filter: nearest orthogonal"] = Identity(), NearestOrthogonal()
    parts["band mask: filtering"] = Meyer(FILTERS), BandMask()
    refiners: dict[str, Compared] = {name: WaveletPreservation(*pair) for name, pair in parts.items()}
    for name, pair in reversed_.items():
        refiners[f"{name}, pushforward"] = WaveletPreservation(*pair, convention="pushforward")
    return refiners


def parameters() -> dict[str, Compared]:
    """Return stages of the Meyer frame with several numbers of eigenvectors, filters and iterations."""
    numbers = [(k, filters, 10) for k in EIGENVECTORS for filters in range(2, 9)]
    numbers += [(k, FILTERS, iterations) for k in EIGENVECTORS for iterations in range(1, 10)]
    return {
        f"k = {k}, {filters} filters, {iterations} iterations": Stage(
            WaveletPreservation(Meyer(filters)), number_of_eigenvectors=k, iterations=iterations
        )
        for k, filters, iterations in numbers
    }


def main() -> None:
    parser = make_parser(__doc__, data="DATA_DIRECTORY", output="docs/frames", pairs=40)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--quick", action="store_true", help="few variants on one pair of each set")
    options = parser.parse_args()
    count, every = (1, 20) if options.quick else (options.pairs, 1)
    parts = [
        f"# Frames compared\n\nThe [frame study](../frame_study.md) discusses these tables. {made_with()}"
    ]
    try:
        sets = [open_data_set(options.data / name).pairs for name in ("faust_r", "tosca_r")]
        timed = {name: variants()[name] for name in TIMED}
        for title, methods, share, workers in (
            ("variants", variants(), 1, options.workers),
            ("parameters", parameters(), 4, options.workers),
            ("times", timed, 4, 1),
        ):
            pairs = [pair for of_set in sets for pair in evenly_spread(of_set, -(-count // share))]
            comparison = compare(
                dict(list(methods.items())[::every]),
                pairs,
                iterations=ITERATIONS,
                evaluated_points=1000,
                workers=workers,
                output=make_directory(options.output) / title,
            )
            parts.append(f"## {title.capitalize()}, {len(comparison.pairs)} pairs\n\n{comparison}")
            write_text(options.output / "summary.md", "\n\n".join(parts))
    except InputError as error:
        parser.exit(2, "\n".join([*error.lines(), ""]))


if __name__ == "__main__":
    main()
