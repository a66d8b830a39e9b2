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
    """The base class of solutions: methods that compute a functional map C from a pointwise map T.

    The refiner `WaveletPreservation` takes a solution as its argument `solution`. Ready subclasses are
    `Filtering` (the default), `LeastSquares`, `RegularizedLeastSquares` and `NearestOrthogonal`.

    A subclass must define `solve`, and may define `prepare`, which computes values that `solve` needs in
    every iteration. The class is generic: if these values have the type `Values`, the subclass derives from
    `Solution[Values]`. In the pullback convention (the default), C maps functions on Y ("in") to functions on
    X ("out"), so C has shape (k_X, k_Y). In the pushforward convention, C maps functions on X ("in") to
    functions on Y ("out"), so C has shape (k_Y, k_X).
    """

    def prepare(self, problem: WaveletProblem) -> PreparedT:
        """Return the values that `solve` needs and that do not depend on the pointwise map.

        A refinement calls `prepare` only once, before the first iteration. The base class returns None.

        **Arguments:**

        - `problem`: a `WaveletProblem`, which contains the spectra of both shapes, the responses of the
          filter bank, and the convention of C.
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
        """Compute the functional map C that corresponds to a pointwise map T.

        **Arguments:**

        - `problem`: a `WaveletProblem`, which contains the spectra of both shapes, the responses of the
          filter bank, and the convention of C.
        - `prepared`: the values that `prepare` returned for this problem; None if the subclass does not
          define `prepare`.
        - `pointwise_map`: the map T. It is either an integer array (m,) with one 0-based vertex of Y per
          vertex of X, or a `SoftMap` or `SparseSoftMap` from X to Y.
        - `previous`: the functional map (k_out, k_in) of the previous iteration, or None in the first
          iteration. An iterative solver can start from this map.

        **Returns:** The functional map C (k_out, k_in), without unit, and a status code, which is a member of
        `RESULTS`.
        """
