"""Judges maps without ground truth: which of two maps is better, and whether a map looks right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64

from jaxsmw.core.refiner import Refiner, State
from jaxsmw.geometry.mesh import extend_from
from jaxsmw.matching.executor import Outcome, SpectralPair, reverse_map
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.scores import (
    area_shape_difference,
    discontinuous_parts,
    distortion,
    expected_error,
    orientation_reversal,
)
from jaxsmw.matching.settings import ExpectedErrorSettings, RepairSettings, ScoreSettings


@dataclass(frozen=True, eq=False)
class Scored:
    """An outcome of stages and its scores.

    **Attributes:**

    - `outcome`: the `Outcome`.
    - `distortion`: `jaxsmw.matching.scores.distortion` of the map; infinite if a stage failed.
    - `deformation`: `jaxsmw.matching.search.proxies.deformation` of the map; 0 if it was not measured.
    - `suspicious`: whether limbs may be swapped, or the body may be upside down.
    - `rivals`: other maps of repair with nearly the same score. If the map looks right, its rivals look right
      as well.
    """

    outcome: Outcome
    distortion: float
    deformation: float = 0.0
    suspicious: bool = False
    rivals: tuple[Scored, ...] = ()

    @property
    def successful(self) -> bool:
        """Whether all stages succeeded."""
        return self.outcome.successful

    @property
    def pointwise_map(self) -> Int64[np.ndarray, " m"]:
        """The map of the last stage (m,), 0-based vertices of Y."""
        return self.outcome.pointwise_map


def score(scored: Scored, settings: RepairSettings = RepairSettings()) -> float:  # noqa: B008 (immutable)
    """Return the score of a map, for comparison with other maps of the same pair; lower is better.

    The score is the logarithm of the distortion plus the weighted uncertainty and the weighted deformation.
    The uncertainty comes from the last stage whose refiner computes an uncertainty. If no refiner computes an
    uncertainty, the uncertainty is zero.

    **Returns:** The score, without unit. The score is infinite if a stage failed.
    """
    if not scored.successful:
        return np.inf
    uncertainties = [found.state.uncertainty for found in scored.outcome.refinements]
    known = [uncertainty for uncertainty in uncertainties if uncertainty is not None]
    uncertainty = float(known[-1]) if known else 0.0
    return (
        float(np.log(scored.distortion))
        + settings.uncertainty_weight * uncertainty
        + settings.deformation_weight * scored.deformation
    )


@dataclass(frozen=True, eq=False)
class Judge:
    """The criteria by which maps of one pair are judged without ground truth.

    **Attributes:**

    - `pair`: the source X (m vertices) and the target Y.
    - `spectra`: the spectra of X and Y with the largest available number of eigenvectors, because more
      eigenvectors make faults easier to detect.
    - `settings`: the thresholds and weights of the repair.
    - `measure_deformation`: a function that takes a map X -> Y (m,) and returns its deformation; None if maps
      are judged without deformations.
    """

    pair: Pair
    spectra: SpectralPair
    settings: RepairSettings
    measure_deformation: Callable[[Int64[np.ndarray, " m"]], float] | None = None

    def judged(self, outcome: Outcome) -> Scored:
        """Measure an outcome, and decide whether it is suspicious. A failed outcome is suspicious."""
        found = self.measured(outcome)
        suspicious = not found.distortion < self.settings.suspicious
        if not suspicious and self.settings.suspicious_area < 1:
            largest = max(map(self.pair.mesh_x.average, self.faults(found.pointwise_map)), default=0)
            suspicious = bool(largest >= self.settings.suspicious_area)
        return Scored(outcome, found.distortion, found.deformation, suspicious)

    def measured(self, outcome: Outcome, *, suspicious: bool = False) -> Scored:
        """Compute what determines the `score` of an outcome."""
        if not outcome.successful:
            return Scored(outcome, np.inf, suspicious=suspicious)
        found = outcome.pointwise_map
        deformation = 0.0 if self.measure_deformation is None else self.measure_deformation(found)
        distorted = distortion(self.pair, found, self.spectra.x, self.settings.scores)
        return Scored(outcome, distorted, deformation, suspicious)

    def score(self, scored: Scored) -> float:
        """Return the `score` of a map with the weights of the settings; lower is better."""
        return score(scored, self.settings)

    def faults(self, pointwise_map: Int64[np.ndarray, " m"]) -> list[Bool[np.ndarray, " m"]]:
        """Return the faults that repair can remove from a map, each as a mask of X's vertices (m,).

        The two possible faults are the vertices with orientation reversal and the vertices in discontinuous
        parts. A fault is not returned if its share of X's area is at most `negligible_area` or at least
        `excessive_area` in the settings.
        """
        scores = self.settings.scores
        both = (
            orientation_reversal(self.pair, pointwise_map, self.spectra.x, scores),
            discontinuous_parts(self.pair, pointwise_map, scores),
        )
        low, high = self.settings.negligible_area, self.settings.excessive_area
        return [fault for fault in both if low < self.pair.mesh_x.average(fault) < high]

    def looks_right(self, scored: Scored) -> bool:
        """Return whether a judged map looks right.

        A map looks right if it is not suspicious. A map without faults also looks right if its distortion is
        below `doubtful` in the settings.
        """
        slightly_distorted = scored.distortion < self.settings.doubtful
        return not scored.suspicious or (slightly_distorted and not self.faults(scored.pointwise_map))

    def area_change(self, scored: Scored) -> float:
        """Return the `area_shape_difference` of a map.

        The result is near 0 for poses of one body. For partial pairs, the result is 0, because parts of the
        full shape have no match.
        """
        if self.pair.partial:
            return 0.0
        return area_shape_difference(
            self.pair, scored.pointwise_map, self.spectra.x, self.spectra.y, self.settings.scores
        )


def estimate_error(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    spectra: SpectralPair,
    refiner: Refiner,
    state: State,
    settings: ExpectedErrorSettings = ExpectedErrorSettings(),  # noqa: B008 (immutable)
    scores: ScoreSettings = ScoreSettings(),  # noqa: B008 (immutable)
) -> Float[np.ndarray, " m"]:
    """Estimate the geodesic error of every match of the last stage; see `expected_error`.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `spectra`: the spectra that the last stage has seen; see `SpectralPair.seen_by`.
    - `refiner`, `state`: the refiner of the last stage, and its `State`.
    - `settings`, `scores`: the settings of `expected_error`.

    **Returns:** The expected errors (m,), divided by the square root of Y's area. A vertex that was not
    matched has the value of the nearest matched vertex.
    """
    known_x, known_y = (np.asarray(spectrum.mask) for spectrum in (spectra.x, spectra.y))
    reverse = extend_from(known_y, pair.mesh_y, reverse_map(refiner, spectra, state))
    expected = expected_error(pair, pointwise_map, reverse, spectra.x, spectra.y, settings, scores)
    return extend_from(known_x, pair.mesh_x, expected)
