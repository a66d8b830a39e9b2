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
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.search.race import SAME_HAND, hand_evidence
from jaxsmw.matching.search.reading import Reading
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.matching.stages import Preset
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress

# The number of pairs whose hands are compared, divided by the number of shapes.
_COMPARED_PER_SHAPE = 1.5
# This number of pairs is compared first. If all of them are their own mirror images, no further pairs are
# compared.
_COMPARED_FIRST = 5


def choose_hands(number: int, evidence: Mapping[Edge, float]) -> Bool[np.ndarray, " N"]:
    """Choose one of two hands for each shape of a collection, from the evidence of all edges.

    The signs of the leading eigenvector of the matrix of evidence give the first hands (synchronisation over
    the group of two elements; Singer, "Angular synchronization by eigenvectors and semidefinite programming",
    2011). The hands of single shapes are then reversed, one after another, as long as this improves the
    agreement with the evidence.

    **Arguments:**

    - `number`: the number N of shapes.
    - `evidence`: the evidence that the shapes of each compared edge (i, j) have opposite hands; see
      `compare_hands`. The edge consists of the 0-based numbers of two shapes.

    **Returns:** A Boolean array (N,), whose entry i is True if the mirror image of shape i is matched. At
    most half of the entries are True.
    """
    agreement = np.zeros((number, number))
    for (i, j), of_edge in evidence.items():
        agreement[i, j] = agreement[j, i] = -of_edge
    if agreement.min() >= 0:
        return np.zeros(number, bool)  # all pairs are of one hand; they need not connect all shapes
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
) -> dict[Edge, float]:
    """Compare the hands of the pairs of a sparse graph, and keep the evidence in the store.

    A few pairs are compared first. If one of them is not its own mirror image, all other pairs are compared.

    **Returns:** For each compared edge, the log-odds that its shapes have opposite hands.
    """

    def evidence(edge: Edge) -> float:
        x, y = (shapes[number] for number in edge)

        def compute() -> dict[str, np.ndarray]:
            reading = Reading.of(PreparedPair.of(Pair(x.mesh, y.mesh), x, y))
            return {"evidence": np.array(hand_evidence(reading))}

        key_x, key_y = (shape_key(shape, preset, eigensolver) for shape in (x, y))
        return float(store.get("evidence", (*key_x, *key_y), compute)["evidence"])

    edges = choose_edges(shape_distances(shapes), edges_per_shape=_COMPARED_PER_SHAPE, seed=seed)
    first = edges[:: max(1, len(edges) // _COMPARED_FIRST)][:_COMPARED_FIRST]
    compared = {edge: evidence(edge) for edge in first}
    if all(of_edge == SAME_HAND for of_edge in compared.values()):
        return compared
    for number, edge in enumerate(edges):
        if edge not in compared:
            compared[edge] = evidence(edge)
        progress("hands", number + 1, len(edges))
    return compared
