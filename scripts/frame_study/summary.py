"""Paired differences with confidence intervals, and the tables made of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from frame_study.measurement import INVARIANCE_FRAMES, MOVE, SEARCH, PairName, Settings
from frame_study.variants import CONVENTIONS, DEFAULT, GAINS, UPDATES, Variant
from jaxsmw.core.functional_map import Convention
from jaxsmw.evaluation.intervals import CONFIDENCE, RESAMPLES, Interval, mean_interval
from jaxsmw.evaluation.journal import Row

SETTLED = 0.05
"""An iteration in which fewer matches than this share move is the one in which a map settles."""


class Comparison(NamedTuple):
    """One variant against the default on the same pairs; errors x 10^-3 of the square root of the area.

    Means and medians are over the pairs on which it did not fail, which is why failures stand beside them.
    """

    mean: float
    median: float
    difference: Interval
    better: float
    failures: int


def compare(errors: Float64[np.ndarray, " p"], reference: Float64[np.ndarray, " p"], seed: int) -> Comparison:
    """A variant's errors against the default's, pair by pair; NaN where a variant failed.

    A pair on which it failed counts as one on which it is not better.
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
    """The main table in memory, by variant and pair."""

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
        """After the last iteration, x 10^-3."""
        return 1e3 * self.numbers(variant, data_set, f"error_{self.settings.iterations}")

    def median_settling(self, variant: Variant, data_set: str) -> float:
        """The median iteration in which the map settles; infinite where half of the pairs or more did not."""
        last = self.settings.iterations
        moved = np.array([self.numbers(variant, data_set, f"moved_{i}") for i in range(1, last + 1)])
        still = moved < SETTLED
        settled = np.where(still.any(axis=0), 1 + still.argmax(axis=0), np.inf)
        succeeded = np.isfinite(moved).all(axis=0)
        return float(np.median(settled[succeeded])) if succeeded.any() else np.nan

    def interval(self, variant: Variant | None, data_set: str) -> Interval:
        """The difference from the default, NaN for a variant that there is not."""
        found = None if variant is None else self.comparisons.get((variant, data_set))
        return Interval(np.nan, np.nan, np.nan) if found is None else found.difference

    def contrast(self, variant: Variant, reference: Variant, data_set: str) -> str:
        """One variant minus another on the pairs on which neither failed, and on how many one did."""
        differences = self.errors(variant, data_set) - self.errors(reference, data_set)
        both = np.isfinite(differences)
        text = str(mean_interval(differences[both], self.settings.seed))
        return text if both.all() or not both.any() else f"{text}, {np.sum(~both)} failed"

    def relative_energy(self, variant: Variant, data_set: str) -> float:
        """The mean of E(C) / E(0), which makes frames of different height comparable."""
        succeeded = np.isfinite(self.errors(variant, data_set))
        energies, of_zero = (
            self.numbers(variant, data_set, name)[succeeded] for name in ("energy", "energy_of_zero")
        )
        return float(np.mean(energies / of_zero)) if succeeded.any() else np.nan

    def milliseconds(self, variant: Variant) -> float:
        return float(np.median(self._times[self.twins.get(variant, variant)]))

    def failures(self) -> Counter[tuple[Variant, str]]:
        """How often each variant ended with which sentence."""
        counts: Counter[tuple[Variant, str]] = Counter()
        for variant in self.variants:
            if variant not in self.twins:
                results = self.column(variant, "both", "result")
                counts.update((variant, result) for result in results if result != "successful")
        return counts


def _variant(row: Row) -> Variant:
    return Variant(*(row[name] for name in Variant._fields))


def write_summary(study: Study, invariance: Sequence[Row]) -> str:
    """All tables as Markdown."""
    settings = study.settings
    counts = ", ".join(f"{len(pairs)} of {name}" for name, pairs in study.pairs.items() if name != "both")
    search = study.milliseconds(SEARCH)
    start = {name: 1e3 * study.numbers(DEFAULT, name, "error_0").mean() for name in study.pairs}
    parts = [
        "# Frames compared",
        f"Pairs: {counts}, evenly spread over their lists. All start from the same SHOT matches (mean error "
        + ", ".join(f"{error:.1f} on {name}" for name, error in start.items())
        + f"), with {settings.number_of_eigenvectors} eigenvectors per shape, {settings.number_of_filters} "
        f"filters where the bank leaves the choice, and {settings.iterations} iterations. Made by "
        "`scripts/compare_frames.py`; versions, seeds and settings stand in `provenance.json`, the numbers "
        "of every pair in `results.csv`.",
        _list(
            "**error**: mean geodesic error x 10⁻³ of the square root of the target's area, at "
            f"{settings.evaluated_points} points of the ground truth, the same for all variants.",
            "**difference**: mean over the pairs of the error minus that of the default (Meyer, filtering, "
            f"pullback) on the same pair, with its {CONFIDENCE:.0%} bootstrap interval (BCa, {RESAMPLES} "
            "resamples of pairs). Pairs share shapes, so the intervals are somewhat too narrow; and of so "
            "many intervals one in twenty would miss zero by chance alone.",
            "**better**: the share of pairs with a smaller error than the default's; a failure is none.",
            "**energy**: E(C) / E(0), eq. (5) of the last C under the last map, in the area norm and in the "
            "variant's own frame (for the band mask in the Meyer frame).",
            f"**settles**: the first iteration in which fewer than {SETTLED:.0%} of the matches move by more "
            f"than {MOVE} square roots of the area (about an edge), median over the pairs.",
            "**update**: milliseconds for one functional map from a pointwise map, without the search "
            f"({search:.0f} ms); median of runs in turns, one core, one pair per data set.",
            "**condition**: condition number of the first least-squares problem (for the regularized update "
            "of its wavelet term), median over the pairs; in float32 anything above 10⁵ means singular.",
            "**failed**: pairs on which the update reported that it failed; errors are over the others.",
            "`=`: provably the same as filtering, so not computed again: in the pushforward convention and "
            "the area norm least squares divides columns by the frame function, 1 for a Parseval frame.",
        ),
    ]
    for convention in CONVENTIONS:
        parts += [
            f"## Mean error and difference, {convention}, both data sets",
            _overview(study, convention),
        ]
    parts += [
        "## Ablations, both data sets",
        _ablations(study),
        "## What the update changes within a frame, pullback",
        "Paired differences of the error, one update minus another.",
        _updates_within_frames(study),
        "## What scaling and tightening change, pullback",
        "Paired differences of the error. Scaled: the bank times one number, so that its frame function is "
        "one in the mean; tightened: its canonical tight frame, the frame function one everywhere.",
        _tightening(study),
        "## The height of C",
        "Mean error of Meyer, filtering, with C times a number in every iteration.",
        _gains(study),
    ]
    for convention in CONVENTIONS:
        for name in study.pairs:
            parts += [
                f"## {convention.capitalize()}, {name if name != 'both' else 'both data sets'}",
                _details(study, convention, name),
            ]
    parts += [
        "## Invariance of wavelets under near-isometry",
        "Wavelets around corresponding vertices of the two shapes, compared at corresponding vertices. "
        f"Medians over {settings.wavelet_centers} centres, and over the pairs, of the relative difference "
        "(0: equal, 1.41: unrelated) and of the correlation. Scale 0 is the scaling function, the last one "
        "the finest.",
        _invariance(study, invariance),
        "## Failures",
        _failures(study),
    ]
    return "\n\n".join(parts) + "\n"


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
    asked = (
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
    for label, variant in asked:
        if variant in study.variants:
            least = np.min(study.numbers(variant, "both", "least_kernel_eigenvalue"))
            cells = [f"{label} ({variant.frame}, {variant.update})"]
            for name in [*data_sets, "both"]:
                found = study.comparisons[variant, name]
                cells += [_failing(_number(found.mean), found), str(found.difference)]
            rows.append([*cells, f"−{-least:.2g}" if least < -1e-4 else "≥ 0"])
    header = ["", *(title for name in [*data_sets, "both"] for title in (name, "difference"))]
    return _table([*header, "least eigenvalue of the kernel"], rows) + (
        "\n\nThe last column: smallest over largest eigenvalue of what C₀ is multiplied with, for X with "
        "itself, the least of all pairs; a frame's cannot be negative."
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
            pair = (Variant(frame, name, "pullback") for name in (update, reference))
            cells.append(study.contrast(*pair, "both"))
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
                pair = (
                    Variant(f"{frame}, {of}" if of else frame, name, "pullback")
                    for of, name in ((kind, update), (reference_kind, reference))
                )
                cells.append(study.contrast(*pair, "both"))
            rows.append(cells)
    header = [
        f"{kind}, {update} − {reference_kind or 'plain'}" + (f", {reference}" if reference != update else "")
        for kind, update, reference_kind, reference in contrasts
    ]
    # A row for each contrast: there are more of them than banks.
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
        ["frame", "update", "convention", "failed", "what it reported"],
        [[*variant, f"{count} of {total}", sentence] for (variant, sentence), count in counts.items()],
    )


def _number(value: float, digits: int = 1) -> str:
    return "—" if np.isnan(value) else f"{value:.{digits}f}"


def _significant(value: float) -> str:
    """Three digits, without an exponent as far as possible."""
    if not np.isfinite(value):
        return "—" if np.isnan(value) else "∞"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}" if abs(value) < 1e5 else f"{value:.0e}"


def _list(*items: str) -> str:
    return "\n".join(f"- {item}" for item in items)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
