"""The outcomes of computations, as values that work under jit and vmap, with a sentence for each outcome."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool


class RESULTS(eqx.Enumeration):
    """The outcome of a refinement. `RESULTS[result]` is a sentence for the user."""

    successful = "The refinement succeeded: all numbers are finite."
    nonfinite_spectrum = (
        "A spectrum contains NaN or infinite numbers, so no map was refined. Check the mesh of that spectrum "
        "and compute the spectrum again."
    )
    invalid_initial_map = (
        "The initial map contains vertices of Y that do not exist or are masked, so no map was refined. Give "
        "one index from 0 to n - 1 for each vertex of X."
    )
    nonfinite_functional_map = (
        "The functional map became NaN or infinite. Check the responses of the filter bank, the weights, the "
        "descriptors, and the temperature of soft maps, which must be positive. In float32 numbers can "
        "overflow: scale the surfaces to area 1, or use float64. The least-squares pseudo-inverse needs at "
        "least as many samples as eigenvectors, at vertices where the eigenvectors are linearly independent."
    )
    undetermined_functional_map = (
        "A part of the functional map is undetermined to working precision. With wavelets, the frame "
        "function of the filter bank vanishes at an eigenvalue: use a filter bank that covers the whole "
        "spectrum (usually the lowest band is missing, which a low-pass filter adds, or the highest band). "
        "Without wavelets, the descriptors do not determine the map: use descriptors of zero mean and "
        "similar size. In both cases fewer eigenvectors, float64 or solution=Filtering(), which solves no "
        "system, may help."
    )
    singular_system = (
        "The least-squares problem for the functional map is singular to working precision: the pointwise "
        "map reaches too few vertices of Y to tell the eigenvectors apart. Use a better initial map, more "
        "samples, fewer eigenvectors, float64, or solution=Filtering(), which solves no system."
    )
    fixed_point_not_reached = (
        "The soft refinement did not reach a fixed point, so its implicit derivatives are unreliable. Use "
        "more iterations, a larger tolerance or a higher temperature, or differentiate through the "
        "iterations."
    )
    solver_not_converged = (
        "The iterative solver for the functional map did not reach its tolerance. Use more max_steps, a "
        "larger tolerance, float64, or smaller weights for orthogonality and commutativity."
    )


def where(condition: Bool[Array, ""] | bool, if_true: RESULTS | str, if_false: RESULTS | str) -> RESULTS:
    """Returns one of two results, depending on a condition.

    The annotations include `str` because type checkers treat the members of an Enumeration as strings.
    """
    return RESULTS.where(condition, if_true, if_false)  # type: ignore[arg-type]


def sentence(result: RESULTS) -> str:
    """Returns the sentence that explains a result to the user."""
    return RESULTS[result]  # type: ignore[misc]
