"""The initial map without refinement. All other methods start from this map."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Array, Int

from jaxsmw.benchmark.opponents.base import Method, MethodInput
from jaxsmw.core.results import RESULTS


@dataclass(frozen=True)
class Unrefined(Method):
    """A method that returns the initial map unchanged."""

    reference: str = "the initial map of all other methods, from nearest neighbours in descriptor space"
    number_of_eigenvectors: int = 1

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Return the map X -> Y and the status code; see `Method`."""
        return pair.initial_map, RESULTS.successful  # type: ignore[return-value]


UNREFINED = Unrefined()
