"""The outcome of several stages, and how it is scored and judged."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Int, Int64

from jaxsmw.core.refinement import Refinement
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.pair import Pair
from jaxsmw.repair.scores import discontinuous_parts, distortion, orientation_reversal, same_map
from jaxsmw.repair.settings import RepairSettings


class Outcome(NamedTuple):
    """The outcome of several stages.

    **Attributes:**

    - `refinements`: one per stage, up to the first stage that failed.
    - `initial_map`: the map from which the first stage started, (m,).
    - `distortion`: `jaxsmw.repair.scores.distortion` of the last map; None if nobody looked.
    - `suspicious`: whether limbs may still be swapped, or the body may be upside down.
    """

    refinements: list[Refinement]
    initial_map: Int[Array, " m"]
    distortion: float | None = None
    suspicious: bool = False

    @property
    def successful(self) -> bool:
        """Whether no stage failed."""
        return all(bool(found.result == RESULTS.successful) for found in self.refinements)

    @property
    def pointwise_map(self) -> Int[Array, " m"]:
        """The map of the last stage."""
        return self.refinements[-1].pointwise_map if self.refinements else self.initial_map


def score(outcome: Outcome, uncertainty_weight: float = RepairSettings().uncertainty_weight) -> float:
    """The score of an outcome beside other outcomes of the same two shapes: lower is better.

    The logarithm of the distortion, plus the weighted uncertainty of the last state that has one.
    """
    if not outcome.successful:
        return np.inf
    uncertainties = [found.state.uncertainty for found in outcome.refinements]
    known = [uncertainty for uncertainty in uncertainties if uncertainty is not None]
    return float(np.log(outcome.distortion or 1) + uncertainty_weight * (known[-1] if known else 0))


@dataclass(frozen=True)
class Judge:
    """Judges outcomes for one pair without ground truth.

    **Attributes:**

    - `pair`: the meshes.
    - `spectrum_x`: X's spectrum with the most eigenvectors, which show faults best; may be padded.
    - `settings`: the numbers.
    """

    pair: Pair
    spectrum_x: Spectrum
    settings: RepairSettings

    def judged(self, outcome: Outcome) -> Outcome:
        """The outcome with its distortion."""
        if not outcome.successful:
            return outcome._replace(distortion=np.inf, suspicious=True)
        found = distortion(self.pair, self._matches(outcome), self.spectrum_x, self.settings.scores)
        return outcome._replace(distortion=found, suspicious=not found < self.settings.suspicious)

    def score(self, outcome: Outcome) -> float:
        """See `score`."""
        return score(outcome, self.settings.uncertainty_weight)

    def faults(self, outcome: Outcome) -> list[Bool[np.ndarray, " m"]]:
        """The vertices with reversed orientation, and the discontinuous parts, if worth a repair."""
        mesh_x, found, scores = self.pair.mesh_x, self._matches(outcome), self.settings.scores
        both = (
            orientation_reversal(self.pair, found, self.spectrum_x, scores),
            discontinuous_parts(self.pair, found, scores),
        )
        areas = mesh_x.vertex_areas / mesh_x.area
        low, high = self.settings.negligible_area, self.settings.excessive_area
        return [fault for fault in both if low < areas[fault].sum() < high]

    def looks_right(self, outcome: Outcome) -> bool:
        """Whether nothing is left to repair."""
        assert outcome.distortion is not None
        slightly_distorted = outcome.distortion < self.settings.doubtful
        return not outcome.suspicious or (slightly_distorted and not self.faults(outcome))

    def same(self, first: Outcome, second: Outcome) -> bool:
        """Whether two outcomes are the same map except for details."""
        return same_map(self.pair, self._matches(first), self._matches(second), self.settings.scores)

    def largest_group(self, outcomes: Iterable[Outcome]) -> list[Outcome]:
        """The largest group of outcomes that are the same map as one of them."""
        outcomes = list(outcomes)
        return max(([o for o in outcomes if self.same(one, o)] for one in outcomes), key=len)

    def _matches(self, outcome: Outcome) -> Int64[np.ndarray, " m"]:
        return np.asarray(outcome.pointwise_map)[: len(self.pair.mesh_x.vertices)].astype(np.int64)
