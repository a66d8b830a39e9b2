"""What stages start from, and what they leave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

from jaxsmw.core.arrays import Array, is_traced
from jaxsmw.core.refinement import Refinement
from jaxsmw.core.refiner import Problem, Refiner, State
from jaxsmw.core.results import RESULTS
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.threads import one_blas_thread

Computed = TypeVar("Computed")


class Start(NamedTuple):
    """A map from which stages start.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `origin`: where the map comes from: the name of an initial map, `"map"` for a given map, `"landmarks"`,
      or `"stages"` for the map of earlier stages.
    - `excluded`: a mask of the vertices of X (m,) that the first stage leaves out; None to use all vertices.
      If the stage iterates on samples, the vertices are left out only in its first functional map.
    """

    pointwise_map: Int64[np.ndarray, " m"]
    origin: str = "stages"
    excluded: Bool[np.ndarray, " m"] | None = None


@dataclass(frozen=True, eq=False)
class StageRun:
    """A stage that has run on a pair, with the state from which further results can be computed.

    **Attributes:**

    - `stage`: the `Stage`.
    - `spectra`: the spectra of the pair.
    - `refinement`: the `Refinement`, with arrays of the executor that has run the stage.
    """

    stage: Stage
    spectra: SpectralPair
    refinement: Refinement

    @cached_property
    def seen(self) -> SpectralPair:
        """The spectra that the stage has seen."""
        return self.spectra.seen_by(self.stage)

    def reverse_map(self) -> Int64[np.ndarray, " n"]:
        """Return the map Y -> X (n,) of all vertices, 0-based vertices of X, from the last state."""
        return np.asarray(self._computed(_reverse_map)).astype(np.int64)

    def embeddings(self) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
        """Return the embeddings of X and Y in which the last search has compared vertices."""
        x, y = self._computed(_embeddings)
        return np.asarray(x), np.asarray(y)

    def _computed(self, function: Callable[[Refiner, Problem, State], Computed]) -> Computed:
        problem = Problem(*self.seen.both, partial=self.spectra.partial)
        if is_traced(self.refinement.pointwise_map):
            from jaxsmw.runtime.compilation import compiled

            # Stages with other levels share the program.
            return compiled(function)(self.stage.refiner.with_traced_levels(), problem, self.refinement.state)
        with np.errstate(all="ignore"), one_blas_thread():
            return function(self.stage.refiner, problem, self.refinement.state)


def _reverse_map(refiner: Refiner, problem: Problem, state: State) -> Int32[Array, " n"]:
    return refiner.recover_reverse(refiner.prepare(problem), state)


def _embeddings(
    refiner: Refiner, problem: Problem, state: State
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    return refiner.embeddings(refiner.prepare(problem), state)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The outcome of several stages.

    **Attributes:**

    - `initial_map`: the map from which the first stage started (m,), 0-based vertices of Y.
    - `runs`: one `StageRun` per stage, up to the first stage that failed.
    """

    initial_map: Int64[np.ndarray, " m"]
    runs: tuple[StageRun, ...] = ()

    @cached_property
    def successful(self) -> bool:
        """Whether all stages succeeded."""
        return all(bool(run.refinement.result == RESULTS.successful) for run in self.runs)

    @cached_property
    def pointwise_map(self) -> Int64[np.ndarray, " m"]:
        """The map of the last stage that has run (m,), or the initial map if no stage has run."""
        if not self.runs:
            return self.initial_map
        return np.asarray(self.last.refinement.pointwise_map).astype(np.int64)

    @property
    def last(self) -> StageRun:
        """The last stage that has run."""
        return self.runs[-1]

    def followed_by(self, later: Outcome) -> Outcome:
        """Return the outcome of these stages and later ones, which started from their map."""
        return Outcome(self.initial_map, self.runs + later.runs)
