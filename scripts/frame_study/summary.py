"""Computes paired differences between variants, and writes the tables of the study."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from frame_study.measurement import INVARIANCE_FRAMES, MOVE, SEARCH, PairName, Settings
from frame_study.variants import CONVENTIONS, DEFAULT, GAINS, UPDATES, Variant
from jaxsmw.benchmark.intervals import CONFIDENCE, RESAMPLES, Interval, mean_interval
from jaxsmw.benchmark.journal import Row
from jaxsmw.benchmark.tables import markdown
from jaxsmw.core.functional_map import Convention

SETTLED = 0.05
"""A map settles in the first iteration that moves less than this share of the matches."""


class Comparison(NamedTuple):
    """A comparison of one variant with the default on the same pairs.

    Errors are in thousandths of the square root of the area. Means and medians leave out failed pairs, so
    they must be read together with the number of failures.

    **Attributes:**

    - `mean`, `median`: the mean and the median error of the variant over the pairs on which it did not fail.
    - `difference`: the mean paired difference with its confidence interval. A paired difference is the
      variant's error minus the default's error on the same pair. Pairs on which the variant or the default
      failed are left out.
    - `better`: the share of all pairs on which the variant has a smaller error than the default.
    - `failures`: the number of pairs on which the variant failed.
    """

    mean: float
    median: float
    difference: Interval
    better: float
    failures: int


def compare(errors: Float64[np.ndarray, " p"], reference: Float64[np.ndarray, " p"], seed: int) -> Comparison:
    """Compare the errors of a variant with the errors of the default, pair by pair.

    If the variant failed on a pair, its error is NaN, and the variant is counted as not better than the
    default.
    """
    succeeded = np.isfinite(errors)
    differences = (errors - reference)[succeeded & np.isfinite(reference)]
    return Comparison(
        float(errors[succeeded].mean()) if succeeded.any() else np.nan,
        float(np.median(errors[succeeded])) if succeeded.any() else np.nan,
        mean_interval(differences, seed),
        float(np.mean(errors < reference)),
        int(np.sum(~succeeded)),
    )


class Study:
    """The results of a study for each variant and each pair."""

    def __init__(
        self,
        rows: Iterable[Row],
        times: Iterable[Row],
        pairs: Sequence[PairName],
        variants: Sequence[Variant],
        twins: Mapping[Variant, Variant],
        settings: Settings,
    ):
        self._rows = {
            (_variant(row), PairName(row["data_set"], row["source"], row["target"])): row for row in rows
        }
        self._times: dict[Variant, list[float]] = {}
        for row in times:
            self._times.setdefault(_variant(row), []).append(float(row["milliseconds"]))
        self.variants, self.twins, self.settings = variants, twins, settings
        data_sets = dict.fromkeys(pair.data_set for pair in pairs)
        self.pairs = {name: [pair for pair in pairs if pair.data_set == name] for name in data_sets}
        self.pairs["both"] = list(pairs)
        self.comparisons = {
            (variant, name): compare(
                self.errors(variant, name), self.errors(DEFAULT, name), seed=settings.seed
            )
            for variant in variants
            for name in self.pairs
        }

    def column(self, variant: Variant, data_set: str, name: str) -> list[str]:
        measured = self.twins.get(variant, variant)
        return [self._rows[measured, pair][name] for pair in self.pairs[data_set]]

    def numbers(self, variant: Variant, data_set: str, name: str) -> Float64[np.ndarray, " p"]:
        return np.array([float(text) for text in self.column(variant, data_set, name)])

    def errors(self, variant: Variant, data_set: str) -> Float64[np.ndarray, " p"]:
        """Return the errors after the last iteration, in thousandths of the square root of the area."""
        return 1e3 * self.numbers(variant, data_set, f"error_{self.settings.iterations}")

    def median_settling(self, variant: Variant, data_set: str) -> float:
        """Return the median, over all pairs, of the iteration in which the map settles (see `SETTLED`).

        The median is infinite if at least half of the maps never settle. The median leaves out pairs on which
        the variant failed.
        """
        last = self.settings.iterations
        moved = np.array([self.numbers(variant, data_set, f"moved_{i}") for i in range(1, last + 1)])
        still = moved < SETTLED
        settled = np.where(still.any(axis=0), 1 + still.argmax(axis=0), np.inf)
        succeeded = np.isfinite(moved).all(axis=0)
        return float(np.median(settled[succeeded])) if succeeded.any() else np.nan

    def interval(self, variant: Variant | None, data_set: str) -> Interval:
        """Return the mean paired difference from the default, with its confidence interval.

        If there are no measurements, all values are NaN.
        """
        found = None if variant is None else self.comparisons.get((variant, data_set))
        return Interval(np.nan, np.nan, np.nan) if found is None else found.difference

    def contrast(self, variant: Variant, reference: Variant, data_set: str) -> str:
        """Return a text with the mean difference between the errors of two variants.

        The mean leaves out pairs on which at least one of the variants failed. If only some pairs are left
        out, the text states their number.
        """
        differences = self.errors(variant, data_set) - self.errors(reference, data_set)
        both = np.isfinite(differences)
        text = str(mean_interval(differences[both], self.settings.seed))
        return text if both.all() or not both.any() else f"{text}, {np.sum(~both)} failed"

    def relative_energy(self, variant: Variant, data_set: str) -> float:
        """Return the mean energy ratio E(C) / E(0).

        The ratio is comparable between frames whose filters have different heights.
        """
        succeeded = np.isfinite(self.errors(variant, data_set))
        energies, of_zero = (
            self.numbers(variant, data_set, name)[succeeded] for name in ("energy", "energy_of_zero")
        )
        return float(np.mean(energies / of_zero)) if succeeded.any() else np.nan

    def milliseconds(self, variant: Variant) -> float:
        return float(np.median(self._times[self.twins.get(variant, variant)]))

    def failures(self) -> Counter[tuple[Variant, str]]:
        """Return the number of failed pairs for each variant and each failure message."""
        counts: Counter[tuple[Variant, str]] = Counter()
        for variant in self.variants:
            if variant not in self.twins:
                results = self.column(variant, "both", "result")
                counts.update((variant, result) for result in results if result != "successful")
        return counts


def _variant(row: Row) -> Variant:
    return Variant(*(row[name] for name in Variant._fields))


def write_summary(study: Study, invariance: Sequence[Row]) -> str:
    """Return all tables as Markdown."""
    return "\n\n".join([*_introduction(study), *_comparisons(study), *_invariances(study, invariance)]) + "\n"


def _introduction(study: Study) -> list[str]:
    """Return the title, and the paragraphs that explain the columns of all tables."""
    settings = study.settings
    counts = ", ".join(f"{len(pairs)} of {name}" for name, pairs in study.pairs.items() if name != "both")
    search = study.milliseconds(SEARCH)
    start = {name: 1e3 * study.numbers(DEFAULT, name, "error_0").mean() for name in study.pairs}
    return [
        "# Frames compared",
        f"The pairs ({counts}) are evenly spread over the lists of the data sets. All variants start from "
        "the same SHOT matches (mean error "
        + ", ".join(f"{error:.1f} on {name}" for name, error in start.items())
        + f"). They use {settings.number_of_eigenvectors} eigenvectors per shape and {settings.iterations} "
        f"iterations. If the number of filters of a bank can be chosen, it is {settings.number_of_filters}. "
        "`scripts/compare_frames.py` wrote this page. `provenance.json` contains versions, seeds and "
        "settings. `results.csv` contains the results of every pair.",
        _list(
            "**error**: the mean geodesic error, in units of 10⁻³ times the square root of the target's "
            f"area. All variants are evaluated at the same {settings.evaluated_points} points of the ground "
            "truth.",
            "**difference**: the mean over the pairs of a paired difference. The paired difference is the "
            "error of the variant minus the error of the default (Meyer, filtering, pullback) on the same "
            f"pair. Brackets contain the {CONFIDENCE:.0%} bootstrap interval (BCa, {RESAMPLES} resamples of "
            "pairs). Pairs share shapes, so the intervals are somewhat too narrow. If there were no true "
            f"differences, {1 - CONFIDENCE:.0%} of the intervals would still miss zero by chance.",
            "**better**: the share of pairs on which the error is smaller than the error of the default. A "
            "failed pair is counted as not better.",
            "**energy**: the ratio E(C) / E(0) for the last C. E is the energy of eq. (5) of the MWP paper "
            "under the last pointwise map, in the area norm and with the variant's own frame. The band mask "
            "uses the energy of the Meyer frame.",
            f"**settles**: the first iteration in which fewer than {SETTLED:.0%} of the matches move by more "
            f"than {MOVE} times the square root of the area, which is about the length of an edge. The table "
            "states the median over the pairs.",
            "**update**: the milliseconds to compute a functional map from a pointwise map, without the "
            f"search, which takes {search:.0f} ms. The table states the median over several runs on one "
            "core, for one pair of each data set.",
            "**condition**: the condition number of the first least-squares problem. For the regularized "
            "update, the problem is its wavelet term. The table states the median over the pairs. In "
            "float32, a matrix with a condition number above 10⁵ is numerically singular.",
            "**failed**: the number of pairs on which the update reported a failure. Means and medians leave "
            "these pairs out.",
            "`=`: the variant provably equals filtering, so it is not computed again. In the pushforward "
            "convention and the area norm, least squares divides columns by the frame function. The frame "
            "function of a Parseval frame is 1.",
        ),
    ]


def _comparisons(study: Study) -> list[str]:
    """Return the tables that compare the variants."""
    parts = []
    for convention in CONVENTIONS:
        parts += [
            f"## Mean error and difference, {convention}, both data sets",
            _overview(study, convention),
        ]
    parts += [
        "## Ablations, both data sets",
        _ablations(study),
        "## What the update changes within a frame, pullback",
        "Each paired difference is the error with one update minus the error with another update.",
        _updates_within_frames(study),
        "## What scaling and tightening change, pullback",
        "The table states paired differences of the error. A scaled bank is multiplied by a number that "
        "gives its frame function a mean of 1. A tightened bank is replaced by its canonical tight frame, "
        "whose frame function is 1 everywhere.",
        _tightening(study),
        "## The height of C",
        "The table states the mean error of filtering with the Meyer frame if every iteration multiplies C "
        "by a number.",
        _gains(study),
    ]
    for convention in CONVENTIONS:
        for name in study.pairs:
            parts += [
                f"## {convention.capitalize()}, {name if name != 'both' else 'both data sets'}",
                _details(study, convention, name),
            ]
    return parts


def _invariances(study: Study, invariance: Sequence[Row]) -> list[str]:
    """Return the table of the invariance of wavelets, and the failures."""
    return [
        "## Invariance of wavelets under near-isometry",
        "The table compares the values, at corresponding vertices, of wavelets around corresponding vertices "
        "of the two shapes. It states the relative difference and the correlation. The relative difference "
        "is 0 for equal wavelets and 1.41 for unrelated wavelets. Both values are medians over "
        f"{study.settings.wavelet_centers} centres and over the pairs. "
        "Scale 0 is the scaling function, and the last scale is the finest.",
        _invariance(study, invariance),
        "## Failures",
        _failures(study),
    ]


def _overview(study: Study, convention: Convention) -> str:
    header = ["frame", *UPDATES]
    frames = dict.fromkeys(variant.frame for variant in study.variants)
    rows = []
    for frame in frames:
        cells = [frame]
        for update in UPDATES:
            variant = Variant(frame, update, convention)
            found = study.comparisons[variant, "both"]
            text = f"{_number(found.mean)} ({found.difference!s})"
            cells.append(("= " if variant in study.twins else "") + _failing(text, found))
        rows.append(cells)
    return _table(header, rows)


def _failing(text: str, found: Comparison) -> str:
    if not found.failures:
        return text
    return "failed" if np.isnan(found.mean) else f"{text}, {found.failures} failed"


def _ablations(study: Study) -> str:
    labelled = (
        ("default", DEFAULT),
        ("no filter", Variant("no filter", "filtering", "pullback")),
        ("one low-pass filter", Variant("low-pass (1 filter)", "filtering", "pullback")),
        ("band mask of the same width, no frame", Variant("Meyer", "band mask", "pullback")),
        ("non-tight, not normalised", Variant("cubic spline", "filtering", "pullback")),
        ("non-tight, solved exactly", Variant("cubic spline", "least squares (area)", "pullback")),
        ("non-tight, tightened", Variant("cubic spline, tightened", "filtering", "pullback")),
        ("filtered, then projected", Variant("Meyer", "projected", "pullback")),
        ("projected only", Variant("no filter", "projected", "pullback")),
        ("default, other convention", Variant("Meyer", "filtering", "pushforward")),
    )
    data_sets = [name for name in study.pairs if name != "both"]
    rows = []
    for label, variant in labelled:
        if variant in study.variants:
            least = np.min(study.numbers(variant, "both", "least_kernel_eigenvalue"))
            cells = [f"{label} ({variant.frame}, {variant.update})"]
            for name in [*data_sets, "both"]:
                found = study.comparisons[variant, name]
                cells += [_failing(_number(found.mean), found), str(found.difference)]
            rows.append([*cells, f"−{-least:.2g}" if least < -1e-4 else "≥ 0"])
    header = ["", *(title for name in [*data_sets, "both"] for title in (name, "difference"))]
    return _table([*header, "least eigenvalue of the kernel"], rows) + (
        "\n\nThe last column states the smallest eigenvalue divided by the largest eigenvalue of the kernel "
        "by which C₀ is multiplied, for X with itself. The column states the minimum over all pairs. The "
        "kernel of a frame has no negative eigenvalue."
    )


def _updates_within_frames(study: Study) -> str:
    contrasts = (
        ("least squares (area)", "filtering"),
        ("least squares (Frobenius)", "least squares (area)"),
        ("regularized", "least squares (area)"),
    )
    rows = []
    for frame in study.settings.frames:
        cells = []
        for update, reference in contrasts:
            variant, base = (Variant(frame, name, "pullback") for name in (update, reference))
            cells.append(study.contrast(variant, base, "both"))
        rows.append([frame, *cells])
    return _table(["frame", *(f"{update} − {reference}" for update, reference in contrasts)], rows)


def _tightening(study: Study) -> str:
    contrasts = (
        *(("scaled", update, "", update) for update in UPDATES),
        *(("tightened", update, "scaled", update) for update in UPDATES),
        ("tightened", "filtering", "", "least squares (area)"),
    )
    rows = []
    for frame in study.settings.frames:
        if f"{frame}, tightened" in study.settings.frames:
            cells = [frame]
            for kind, update, reference_kind, reference in contrasts:
                variant, base = (
                    Variant(f"{frame}, {of}" if of else frame, name, "pullback")
                    for of, name in ((kind, update), (reference_kind, reference))
                )
                cells.append(study.contrast(variant, base, "both"))
            rows.append(cells)
    header = [
        f"{kind}, {update} − {reference_kind or 'plain'}" + (f", {reference}" if reference != update else "")
        for kind, update, reference_kind, reference in contrasts
    ]
    # The rows are differences between variants and the columns are banks, because there are more differences
    # than banks.
    return _table(["", *(row[0] for row in rows)], zip(header, *(row[1:] for row in rows), strict=True))


def _gains(study: Study) -> str:
    updates = sorted(("filtering", *GAINS), key=lambda name: GAINS.get(name, 1.0))
    rows = []
    for convention in CONVENTIONS:
        variants = [Variant("Meyer", update, convention) for update in updates]
        for name in study.pairs:
            cells = [_number(study.comparisons[variant, name].mean) for variant in variants]
            rows.append([convention, name, *cells])
    return _table(["", "", *(f"x {GAINS.get(update, 1.0)}" for update in updates)], rows)


def _details(study: Study, convention: Convention, data_set: str) -> str:
    header = ["frame", "update", "error", "median", f"difference [{CONFIDENCE:.0%}]", "better", "energy"]
    header += ["settles", "update, ms", "condition", "failed"]
    rows = []
    for variant in study.variants:
        if variant.convention == convention:
            found = study.comparisons[variant, data_set]
            conditions = study.numbers(variant, data_set, "condition_number")
            settling = study.median_settling(variant, data_set)
            rows.append(
                [
                    variant.frame,
                    ("= " if variant in study.twins else "") + variant.update,
                    _number(found.mean),
                    _number(found.median),
                    str(found.difference),
                    "default" if variant == DEFAULT else f"{found.better:.0%}",
                    _significant(study.relative_energy(variant, data_set)),
                    f"> {study.settings.iterations}" if np.isinf(settling) else _significant(settling),
                    "—" if np.isnan(found.mean) else _significant(study.milliseconds(variant)),
                    "" if np.isnan(conditions).all() else _significant(float(np.median(conditions))),
                    str(found.failures) if found.failures else "",
                ]
            )
    return _table(header, rows)


def _invariance(study: Study, rows: Sequence[Row]) -> str:
    table = []
    for name in study.pairs:
        if name != "both":
            for frame in INVARIANCE_FRAMES:
                for what in ("relative_difference", "correlation"):
                    medians = [
                        np.median(
                            [
                                float(row[what])
                                for row in rows
                                if (row["data_set"], row["frame"], row["scale"]) == (name, frame, str(scale))
                            ]
                        )
                        for scale in range(study.settings.number_of_filters)
                    ]
                    table.append([name, frame, what.replace("_", " "), *(f"{m:.3f}" for m in medians)])
    return _table(["", "frame", "", *(f"scale {s}" for s in range(study.settings.number_of_filters))], table)


def _failures(study: Study) -> str:
    counts = study.failures()
    if not counts:
        return "None."
    total = len(study.pairs["both"])
    return _table(
        ["frame", "update", "convention", "failed", "message"],
        [[*variant, f"{count} of {total}", sentence] for (variant, sentence), count in counts.items()],
    )


def _number(value: float, digits: int = 1) -> str:
    return "—" if np.isnan(value) else f"{value:.{digits}f}"


def _significant(value: float) -> str:
    """Format a number with at least three significant digits, without an exponent if possible."""
    if not np.isfinite(value):
        return "—" if np.isnan(value) else "∞"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}" if abs(value) < 1e5 else f"{value:.0e}"


def _list(*items: str) -> str:
    return "\n".join(f"- {item}" for item in items)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return markdown([header, *rows]).strip()
