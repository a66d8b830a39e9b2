"""Status codes that work under `jax.jit` and `jax.vmap`, with an explanation of each code."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Int

from jaxsmw.core.arrays import Array, namespace
from jaxsmw.core.module import Module


class RESULTS(Module):
    """The status code of a refinement.

    Under `jax.vmap`, `result` contains one status code per pair. Compare a status code with a member: `result
    == RESULTS.successful`. `RESULTS[result]` is a text that explains the status and suggests remedies.
    """

    code: Int[Array, "*batch"]

    successful: ClassVar[RESULTS]
    nonfinite_spectrum: ClassVar[RESULTS]
    invalid_initial_map: ClassVar[RESULTS]
    nonfinite_functional_map: ClassVar[RESULTS]
    undetermined_functional_map: ClassVar[RESULTS]
    singular_system: ClassVar[RESULTS]
    fixed_point_not_reached: ClassVar[RESULTS]
    solver_not_converged: ClassVar[RESULTS]

    def __eq__(self, other: object) -> Bool[Array, "*batch"]:  # type: ignore[override]
        return self.code == other.code if isinstance(other, RESULTS) else np.asarray(False)

    def __ne__(self, other: object) -> Bool[Array, "*batch"]:  # type: ignore[override]
        return ~(self == other)

    __hash__ = Module.__hash__

    def __class_getitem__(cls, result: RESULTS) -> str:
        return sentence(result)


_SENTENCES = {
    "successful": "The refinement succeeded: all numbers are finite.",
    "nonfinite_spectrum": (
        "A spectrum contains NaN or infinite numbers, so no map was refined. Check the mesh of that spectrum "
        "and compute the spectrum again."
    ),
    "invalid_initial_map": (
        "The initial map contains vertices of Y that do not exist or are masked, so no map was refined. Give "
        "one index from 0 to n - 1 for each vertex of X, where n is the number of vertices of Y."
    ),
    "nonfinite_functional_map": (
        "The functional map became NaN or infinite. Check the responses of the filter bank, the weights, the "
        "descriptors, and the temperature of soft maps, which must be positive. Numbers can overflow in "
        "float32: scale the surfaces to area 1, or use float64. With samples, use at least as many samples "
        "as eigenvectors."
    ),
    "undetermined_functional_map": (
        "A part of the functional map is undetermined to working precision. If the solution uses wavelets, "
        "all filters of the bank vanish at some eigenvalue: use a filter bank that covers the whole "
        "spectrum. Usually the lowest or the highest band is missing; a low-pass filter adds the lowest "
        "band. If the solution uses only descriptors, the descriptors do not determine the map: use "
        "descriptors of zero mean and similar size. In both cases it may help to use fewer eigenvectors, "
        "float64, or solution=Filtering(), which solves no linear system."
    ),
    "singular_system": (
        "The least-squares problem for the functional map is singular to working precision: the pointwise "
        "map reaches too few vertices of Y to distinguish all eigenvectors. Use a better initial map, more "
        "samples, fewer eigenvectors, float64, or solution=Filtering(), which solves no linear system."
    ),
    "fixed_point_not_reached": (
        "The soft refinement did not reach a fixed point, so its implicit derivatives are unreliable. Use "
        "more iterations, a larger tolerance or a higher temperature, or differentiate through the "
        "iterations instead."
    ),
    "solver_not_converged": (
        "The iterative solver for the functional map did not reach its tolerance. Use a larger max_steps, a "
        "larger tolerance, float64, or smaller weights for orthogonality and commutativity."
    ),
}
for _code, _name in enumerate(_SENTENCES):
    setattr(RESULTS, _name, RESULTS(np.asarray(_code, np.int32)))


def where(condition: Bool[Array, ""] | bool, if_true: RESULTS, if_false: RESULTS) -> RESULTS:
    """Return one of two status codes."""
    xp = namespace(condition, if_true.code, if_false.code)
    return RESULTS(xp.where(condition, if_true.code, if_false.code))


def sentence(result: RESULTS) -> str:
    """Return the text that explains a status code to the user."""
    return tuple(_SENTENCES.values())[int(result.code)]
