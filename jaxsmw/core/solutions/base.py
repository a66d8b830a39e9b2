"""The interface of solutions."""

from __future__ import annotations

import abc
from typing import Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from jaxsmw.core.functional_map import WaveletProblem
from jaxsmw.core.results import RESULTS
from jaxsmw.core.soft_maps import PointwiseMap

PreparedT = TypeVar("PreparedT")


class Solution(eqx.Module, Generic[PreparedT]):
    """A way to compute a functional map that preserves wavelets under a given pointwise map.

    The type parameter is the type of the values that `prepare` returns.
    """

    def prepare(self, problem: WaveletProblem) -> PreparedT:
        """Returns the values that `solve` needs and that do not depend on the pointwise map.

        The default is None.

        **Arguments:**

        - `problem`: both shapes and the responses of the filter bank.
        """
        return None  # type: ignore[return-value]

    @abc.abstractmethod
    def solve(
        self,
        problem: WaveletProblem,
        prepared: PreparedT,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Returns the functional map (k_out, k_in) of a pointwise map, and a member of `RESULTS`.

        **Arguments:**

        - `problem`: both shapes and the responses of the filter bank.
        - `prepared`: the result of `prepare` for this problem.
        - `pointwise_map`: T, one vertex of Y per vertex of X (m,), or a soft map from X to Y.
        - `previous`: the functional map of the previous iteration, from which iterative solvers start; None
          in the first iteration.
        """
