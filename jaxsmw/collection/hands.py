"""The hand of each shape of a collection: whether the shape or its mirror image corresponds to the others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool

from jaxsmw.collection.consistency import Edge
from jaxsmw.repair.chirality import Decision


def choose_hands(number: int, decisions: Mapping[Edge, Decision]) -> Bool[np.ndarray, " N"]:
    """Divide the shapes of a collection into two hands that agree best with the evidence of all edges.

    The evidence of an edge is positive if the two shapes seem to be of opposite hands. A symmetric matrix
    contains the evidence of all edges with the opposite sign. The signs of the leading eigenvector of this
    matrix give the first hands (synchronisation over the group of two elements; Singer, "Angular
    synchronization by eigenvectors and semidefinite programming", 2011). The function then reverses the hands
    of single shapes, one after another, as long as each reversal improves the agreement with the evidence.

    **Arguments:**

    - `number`: the number N of shapes.
    - `decisions`: for each compared edge (i, j), the `Decision`. Decisions without
      evidence, and decisions on symmetric shapes, are ignored.

    **Returns:** An array (N,), True for shapes whose mirror image is matched. At most half are True.
    """
    agreement = np.zeros((number, number))
    for (i, j), decision in decisions.items():
        if decision.evidence is not None and decision.asymmetric:
            agreement[i, j] = agreement[j, i] = -decision.evidence
    if not agreement.any():
        return np.zeros(number, bool)
    _, vectors = np.linalg.eigh(agreement)
    hands = np.where(vectors[:, -1] < 0, -1.0, 1.0)
    for _ in range(number):
        gain = -hands * (agreement @ hands)
        if gain.max() <= 0:
            break
        hands[gain.argmax()] *= -1
    mirrored = hands < 0
    return (
        ~mirrored
        if 2 * mirrored.sum() > number or (2 * mirrored.sum() == number and mirrored[0])
        else mirrored
    )
