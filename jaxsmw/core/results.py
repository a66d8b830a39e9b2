"""How a computation ended: a value that travels through jit and vmap, with a sentence for each failure."""

from __future__ import annotations

from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool


class RESULTS(eqx.Enumeration):
    """How a refinement ended; each failure carries the sentence to show a person."""

    successful = "The refinement went through: all numbers are finite."
    nonfinite_spectrum = (
        "A spectrum holds NaN or infinity, so nothing was refined; recompute it and check the mesh it is of."
    )
    invalid_initial_map = (
        "The initial map names target vertices that do not exist or are masked, so nothing was refined; it "
        "needs one index from 0 to n - 1 per source vertex."
    )
    nonfinite_functional_map = (
        "The functional map, or what determines it, became NaN or infinite: look at the filter bank's "
        "responses, the weights, the descriptors and, of soft maps, the temperature, which must be positive. "
        "In float32 it can be overflow (scale the surfaces to area 1, or use float64); with the "
        "least-squares pseudo-inverse it can be that there are fewer samples than eigenvectors, or samples "
        "that do not tell the eigenvectors apart."
    )
    undetermined_functional_map = (
        "Nothing determines a part of the functional map, to working precision: at an eigenvalue the frame "
        "function of the filter bank (or, without wavelets, all that the descriptors hold) vanishes beside "
        "its largest value. Use a bank that covers the whole spectrum (mostly the lowest band is missing, "
        "for which a low-pass filter helps, or the highest), descriptors without their mean and of like "
        "size, fewer eigenvectors, float64, or solution=Filtering(), which solves nothing."
    )
    singular_system = (
        "The least-squares problem for the functional map is singular, to working precision: the pointwise "
        "map reaches too few target vertices to tell the eigenvectors apart; use a better initial map, more "
        "samples, fewer eigenvectors, float64, or solution=Filtering(), which solves nothing."
    )
    fixed_point_not_reached = (
        "The soft refinement did not come to rest, so that its implicit derivatives mean little; give it "
        "more iterations, a larger tolerance or a higher temperature, or differentiate through iterations."
    )
    solver_not_converged = (
        "The iterative solver for the functional map did not reach its tolerance; give it more max_steps, a "
        "larger tolerance, float64, or smaller weights for orthogonality and commutativity."
    )


def where(condition: Bool[Array, ""] | bool, if_true: Any, if_false: Any) -> Any:
    """One result or the other. Type checkers take the members of an Enumeration for plain strings."""
    return RESULTS.where(condition, if_true, if_false)


def sentence(result: RESULTS) -> str:
    """What a result means, for a person."""
    return RESULTS[result]  # type: ignore[misc]
