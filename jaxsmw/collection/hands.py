"""The hand of each shape of a collection: whether the shape or its mirror image corresponds to the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from jaxsmw.choices import Eigensolver
from jaxsmw.collection.consistency import Edge
from jaxsmw.collection.graph import choose_edges, shape_distances
from jaxsmw.collection.shapes import shape_key
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.search.chirality import Decision, Hands
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.matching.stages import Preset
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress

# The number of pairs whose hands are compared, divided by the number of shapes.
_COMPARED_PER_SHAPE = 1.5
# This number of pairs is compared first. If none of these pairs is asymmetric, no further pairs are compared.
_COMPARED_FIRST = 5


def choose_hands(number: int, decisions: Mapping[Edge, Decision]) -> Bool[np.ndarray, " N"]:
    """Choose one of two hands for each shape of a collection, from the evidence of all edges.

    The signs of the leading eigenvector of the matrix of evidence give the first hands (synchronisation over
    the group of two elements; Singer, "Angular synchronization by eigenvectors and semidefinite programming",
    2011). The hands of single shapes are then reversed, one after another, as long as this improves the
    agreement with the evidence.

    **Arguments:**

    - `number`: the number N of shapes.
    - `decisions`: the `Decision` of each compared edge (i, j), with the 0-based numbers of two shapes. Those
      without evidence and those on symmetric shapes are ignored.

    **Returns:** A Boolean array (N,), whose entry i is True if the mirror image of shape i is matched. At
    most half of the entries are True.
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
    twice = 2 * mirrored.sum()
    return ~mirrored if twice > number or (twice == number and mirrored[0]) else mirrored


def compare_hands(
    shapes: Sequence[PreparedShape],
    preset: Preset,
    eigensolver: Eigensolver,
    *,
    seed: int,
    store: Store,
    progress: Progress,
) -> dict[Edge, Decision]:
    """Compare the hands of the pairs of a sparse graph, and keep each `Decision` in the store.

    A few pairs are compared first. If one of them is asymmetric, all other pairs are compared as well.
    """

    def decision(edge: Edge) -> Decision:
        x, y = (shapes[number] for number in edge)

        def compute() -> dict[str, np.ndarray]:
            decided = Hands(Pair(x.mesh, y.mesh), x.spectrum, y.spectrum).decide("auto")
            evidence = np.nan if decided.evidence is None else decided.evidence
            values = decided.mirrored, evidence, decided.doubtful, decided.asymmetric
            return {"decision": np.array(values, float)}

        key_x, key_y = (shape_key(shape, preset, eigensolver) for shape in (x, y))
        arrays = store.get("hand", (*key_x, *key_y), compute)
        mirrored, evidence, doubtful, asymmetric = arrays["decision"].tolist()
        return Decision(
            bool(mirrored), None if np.isnan(evidence) else evidence, bool(doubtful), bool(asymmetric)
        )

    edges = choose_edges(shape_distances(shapes), edges_per_shape=_COMPARED_PER_SHAPE, seed=seed)
    first = edges[:: max(1, len(edges) // _COMPARED_FIRST)][:_COMPARED_FIRST]
    decisions = {edge: decision(edge) for edge in first}
    if not any(decided.asymmetric for decided in decisions.values()):
        return decisions
    for number, edge in enumerate(edges):
        if edge not in decisions:
            decisions[edge] = decision(edge)
        progress("hands", number + 1, len(edges))
    return decisions
