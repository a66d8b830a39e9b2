"""The initial map without refinement. All other methods start from the same map."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Array, Int

from jaxsmw.core.results import RESULTS
from jaxsmw.evaluation.opponents.base import Method, MethodInput


@dataclass(frozen=True)
class Unrefined(Method):
    """Returns the initial map unchanged."""

    reference: str = "nearest neighbours of the descriptors: the initial map of all other methods"
    number_of_eigenvectors: int = 1

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """See `Method`."""
        return pair.initial_map, RESULTS.successful  # type: ignore[return-value]


UNREFINED = Unrefined()
