"""The graph of a collection: which pairs of shapes are matched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.sparse.csgraph import minimum_spanning_tree

from jaxsmw.choices import EDGES_PER_SHAPE
from jaxsmw.collection.consistency import Edge, check_pairs
from jaxsmw.errors import InputError, check_number, check_whole_number
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.runtime.cache import Store

# Low eigenvalues describe the proportions of a body. High eigenvalues depend on the mesh.
_COMPARED_EIGENVALUES = 50
# (Table R26 of docs/research_log.md)
_RANDOM_SHARE = 0.25


def shape_distances(shapes: Sequence[PreparedShape]) -> Float64[np.ndarray, "N N"]:
    """Compute how much the shapes of a collection differ, without matching them.

    The distance is the root mean square of two parts, each divided by its median over all pairs. The first
    part compares the logarithms of the eigenvalues, which hardly change with the pose (Reuter, Wolter,
    Peinecke, "Laplace-Beltrami spectra as Shape-DNA of surfaces and solids", 2006). The second part compares
    the second moments of the descriptors over the surface, which do change.

    **Arguments:**

    - `shapes`: the N shapes, each a `PreparedShape`. Without descriptors, only eigenvalues are compared.

    **Returns:** A symmetric matrix of distances (N, N), without unit and with a zero diagonal.
    """
    features = [[_log_eigenvalues(shape) for shape in shapes]]
    if all(shape.spectrum.descriptors is not None for shape in shapes):
        features.append([_moments(shape) for shape in shapes])
    squared = np.zeros((len(shapes), len(shapes)))
    for rows in features:
        part = np.linalg.norm(np.array(rows)[:, None] - np.array(rows)[None], axis=2)
        usual = np.median(part[~np.eye(len(shapes), dtype=bool)]) if len(shapes) > 1 else 1.0
        squared += (part / max(usual, np.finfo(float).tiny)) ** 2 / len(features)
    return np.sqrt(squared)


def _log_eigenvalues(shape: PreparedShape) -> Float64[np.ndarray, " k"]:
    values = np.asarray(shape.spectrum.eigenvalues, np.float64)[1 : _COMPARED_EIGENVALUES + 1]
    # Several eigenvalues of a mesh with several components are zero.
    return np.log(np.maximum(values, 1e-6 * values.max()))


def _moments(shape: PreparedShape) -> Float64[np.ndarray, " q"]:
    values = np.asarray(shape.spectrum.descriptors, np.float64)
    areas = np.asarray(shape.spectrum.vertex_areas, np.float64)
    return np.sqrt((areas / areas.sum()) @ values**2)


def choose_edges(
    distances: Float64[np.ndarray, "N N"],
    *,
    edges_per_shape: float | int = EDGES_PER_SHAPE,
    random_share: float = _RANDOM_SHARE,
    matched: Sequence[Edge] = (),
    seed: int = 0,
) -> list[Edge]:
    """Choose the pairs of a collection that are matched.

    The minimum spanning tree connects all shapes through similar shapes. Edges to the nearest neighbours of
    each shape form cycles. The other edges are random: they keep the paths between any two shapes short, and
    reveal errors that all similar shapes share.

    **Arguments:**

    - `distances`: the distances of the shapes (N, N), in any unit; see `shape_distances`.
    - `edges_per_shape`: the number of edges divided by N, if there are so many pairs.
    - `random_share`: the share of random edges, from 0 to 1.
    - `matched`: edges that are already matched and are kept. Only edges of the other shapes are then new.
    - `seed`: the seed of the random edges, an integer of at least 0.

    **Returns:** The edges in ascending order, as tuples (i, j) of 0-based numbers with i < j.

    **Raises:** `InputError` if an argument is not as described.
    """
    distances = np.asarray(distances)
    if not (
        distances.dtype.kind in "iuf"
        and distances.ndim == 2
        and distances.shape[0] == distances.shape[1] > 0
        and np.isfinite(distances).all()
        and (distances >= 0).all()
    ):
        raise InputError(
            f"the distances are {distances.dtype.name} of shape {distances.shape}: give a square matrix of "
            "finite numbers that are not negative."
        )
    number, distances = len(distances), distances.astype(np.float64)
    check_number("edges_per_shape", edges_per_shape, positive=True)
    check_number("random_share", random_share, most=1.0)
    check_whole_number("seed", seed, 0)
    kept = {(min(edge), max(edge)) for edge in check_pairs(matched, number, "given edge")}
    if alike := [i for i, j in kept if i == j]:
        raise InputError(f"a given edge joins shape {alike[0]} to itself: leave the edge out.")
    old = {shape for edge in kept for shape in edge}
    wanted = [(i, j) for i in range(number) for j in range(i + 1, number) if not old >= {i, j}]
    new = number - len(old)
    most = min(len(wanted), round(edges_per_shape * new)) if old else round(edges_per_shape * number)
    # The tree prefers edges that are already matched. All lengths are positive, because SciPy ignores edges
    # of length zero.
    lengths = distances + 1e-6 * (1 + distances.max(initial=0))
    for edge in kept:
        lengths[edge] *= 1e-6
    tree = minimum_spanning_tree(np.triu(lengths, 1)).tocoo()
    added = set(zip(tree.row.tolist(), tree.col.tolist(), strict=True)) - kept
    generator = np.random.default_rng(seed)
    random = [wanted[row] for row in generator.permutation(len(wanted))]
    added |= set(random[: round(random_share * most)])
    order = np.argsort(distances + np.diag(np.full(number, np.inf)), axis=1, kind="stable")
    possible = set(wanted)
    for rank in range(number - 1):
        nearest = [(min(i, j), max(i, j)) for i, j in enumerate(order[:, rank].tolist())]
        for edge in sorted(possible & set(nearest), key=lambda edge: distances[edge]):
            if len(added) >= most:
                break
            added.add(edge)
    return sorted(kept | added)


def extended_graph(
    shapes: Sequence[PreparedShape], edges_per_shape: float | int, *, seed: int, store: Store
) -> list[Edge]:
    """Choose edges as `choose_edges` does, and keep those of an earlier call with the same store.

    Edges of removed shapes are dropped, and edges of new shapes are added. The names of shapes identify them.
    """
    names = [shape.mesh.name for shape in shapes]
    inputs = (float(edges_per_shape), _RANDOM_SHARE, seed)
    stored = store.load("graph", inputs)
    matched: list[Edge] = []
    if stored is not None:
        row = {name: number for number, name in enumerate(names)}
        pairs = stored["edges"].reshape(-1, 2).tolist()
        matched = [(row[a], row[b]) for a, b in pairs if a in row and b in row]
    edges = choose_edges(
        shape_distances(shapes),
        edges_per_shape=edges_per_shape,
        random_share=_RANDOM_SHARE,
        matched=matched,
        seed=seed,
    )
    store.save("graph", inputs, {"edges": np.array([[names[i], names[j]] for i, j in edges])})
    return edges
