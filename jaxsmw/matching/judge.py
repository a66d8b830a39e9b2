"""The outcome of several stages of refinement, its score, and the decision whether repair is needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Int, Int64

from jaxsmw.core.refinement import Refinement
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.scores import (
    area_shape_difference,
    discontinuous_parts,
    distortion,
    orientation_reversal,
)
from jaxsmw.matching.settings import RepairSettings


class Outcome(NamedTuple):
    """The outcome of several stages of refinement.

    **Attributes:**

    - `refinements`: one `Refinement` per stage, up to the first stage that failed.
    - `initial_map`: the initial map of the first stage (m,), 0-based vertices of Y. The initial map and the
      maps of the refinements may be padded.
    - `distortion`: `jaxsmw.matching.scores.distortion` of the final map, or None if it was not computed yet.
    - `deformation`: `jaxsmw.matching.search.proxies.deformation` of the final map; 0 if it was not computed.
    - `suspicious`: whether limbs may still be swapped, or the body may be upside down.
    - `rivals`: other outcomes of repair with nearly the same score. If the map looks right, its rivals look
      right as well.
    """

    refinements: list[Refinement]
    initial_map: Int[Array, " m"]
    distortion: float | None = None
    deformation: float = 0.0
    suspicious: bool = False
    rivals: tuple[Outcome, ...] = ()

    @property
    def successful(self) -> bool:
        """Whether all stages succeeded."""
        return all(bool(found.result == RESULTS.successful) for found in self.refinements)

    @property
    def pointwise_map(self) -> Int[Array, " m"]:
        """The map of the last stage that has run (m,), or the initial map if no stage has run."""
        return self.refinements[-1].pointwise_map if self.refinements else self.initial_map

    def unpadded_map(self, pair: Pair) -> Int64[np.ndarray, " m"]:
        """Return the pointwise map (m,), with one entry for each vertex of the source mesh of the pair."""
        return np.asarray(self.pointwise_map)[: len(pair.mesh_x.vertices)].astype(np.int64)


def score(outcome: Outcome, settings: RepairSettings = RepairSettings()) -> float:  # noqa: B008 (immutable)
    """Return the score of an outcome, for comparison with other outcomes of the same pair; lower is better.

    The score is the logarithm of the distortion plus the weighted uncertainty and the weighted deformation.
    The uncertainty comes from the last stage whose refiner computes an uncertainty. If no refiner computes an
    uncertainty, the uncertainty is zero.

    **Arguments:**

    - `outcome`: the outcome. If the outcome's distortion is None, 1 is used instead.
    - `settings`: the weights of the score.

    **Returns:** The score, without unit. The score is infinite if a stage failed.
    """
    if not outcome.successful:
        return np.inf
    uncertainties = [found.state.uncertainty for found in outcome.refinements]
    known = [uncertainty for uncertainty in uncertainties if uncertainty is not None]
    uncertainty = float(known[-1]) if known else 0.0
    return (
        float(np.log(outcome.distortion or 1))
        + settings.uncertainty_weight * uncertainty
        + settings.deformation_weight * outcome.deformation
    )


@dataclass(frozen=True)
class Judge:
    """The criteria by which outcomes for one pair are judged without ground truth.

    **Attributes:**

    - `pair`: the source X (m vertices) and the target Y.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y with the largest available number of eigenvectors,
      because more eigenvectors make faults easier to detect. The spectra may be padded.
    - `settings`: the thresholds and weights of the repair.
    - `measure_deformation`: a function that takes a map X -> Y (m,) and returns its deformation; None if
      outcomes are judged without deformations.
    """

    pair: Pair
    spectrum_x: Spectrum
    spectrum_y: Spectrum
    settings: RepairSettings
    measure_deformation: Callable[[Int64[np.ndarray, " m"]], float] | None = None

    def judged(self, outcome: Outcome) -> Outcome:
        """Compute the attributes `distortion` and `suspicious` of an outcome, and return the outcome.

        If `measure_deformation` is given, the attribute `deformation` is computed as well. If a stage failed,
        the distortion is infinite and the outcome is suspicious.
        """
        outcome = self.measured(outcome)
        assert outcome.distortion is not None
        suspicious = not outcome.distortion < self.settings.suspicious
        if not suspicious and self.settings.suspicious_area < 1:
            largest = max(map(self.pair.mesh_x.average, self.faults(outcome)), default=0)
            suspicious = bool(largest >= self.settings.suspicious_area)
        return outcome._replace(suspicious=suspicious)

    def measured(self, outcome: Outcome) -> Outcome:
        """Compute the attributes that determine the `score` of an outcome, and return the outcome.

        These are the distortion and, if `measure_deformation` is given, the deformation. If a stage failed,
        the distortion is infinite.
        """
        if not outcome.successful:
            return outcome._replace(distortion=np.inf)
        matches = outcome.unpadded_map(self.pair)
        if self.measure_deformation is not None:
            outcome = outcome._replace(deformation=self.measure_deformation(matches))
        found = distortion(self.pair, matches, self.spectrum_x, self.settings.scores)
        return outcome._replace(distortion=found)

    def score(self, outcome: Outcome) -> float:
        """Return the `score` of an outcome with the weights of the settings; lower is better."""
        return score(outcome, self.settings)

    def faults(self, outcome: Outcome) -> list[Bool[np.ndarray, " m"]]:
        """Return the faults that repair can remove from an outcome, each as a mask of X's vertices (m,).

        The two possible faults are the vertices with orientation reversal and the vertices in discontinuous
        parts. A fault is not returned if its share of X's area is at most `negligible_area` or at least
        `excessive_area` in the settings.
        """
        found, scores = outcome.unpadded_map(self.pair), self.settings.scores
        both = (
            orientation_reversal(self.pair, found, self.spectrum_x, scores),
            discontinuous_parts(self.pair, found, scores),
        )
        low, high = self.settings.negligible_area, self.settings.excessive_area
        return [fault for fault in both if low < self.pair.mesh_x.average(fault) < high]

    def looks_right(self, outcome: Outcome) -> bool:
        """Return whether the map of a judged outcome looks right.

        A map looks right if its outcome is not suspicious. A map without faults also looks right if its
        distortion is below `doubtful` in the settings.
        """
        assert outcome.distortion is not None
        slightly_distorted = outcome.distortion < self.settings.doubtful
        return not outcome.suspicious or (slightly_distorted and not self.faults(outcome))

    def area_change(self, outcome: Outcome) -> float:
        """Return the `area_shape_difference` of an outcome's map.

        The result is near 0 for poses of one body. For partial pairs, the result is 0, because parts of the
        full shape have no match.
        """
        if self.pair.partial:
            return 0.0
        return area_shape_difference(
            self.pair,
            outcome.unpadded_map(self.pair),
            self.spectrum_x,
            self.spectrum_y,
            self.settings.scores,
        )
