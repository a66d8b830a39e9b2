"""Fits the judge of the search: how evidence without ground truth becomes the probability of a right map.

    python scripts/learn_judge.py DATA_DIRECTORY [--pairs N] [--seed SEED] [--maps FILE.json]
        [--output FILE.md]

`DATA_DIRECTORY` contains the data sets of `docs/datasets.md`. The script draws N pairs of each data set and
of each kind of made shapes: people, animals, an ape and people, bodies with topological noise, teeth of both
sides, jaws, halves of a brain, parts called partial and parts called full, creatures, and bumpy bodies with
their mirror images. `search` always runs all hypotheses, and returns maps that differ from each other. A map
is right if its mean error is below 0.1 and at most 10 % of its errors exceed 0.25. The unit of errors is the
square root of the area.

The probabilities of the maps of a pair are those of `jaxsmw.matching.search.evidence.probabilities`, and the
script maximises their likelihood. It prints the weights of all kinds together. For the tables of results, the
maps of each kind are judged by the weights of all other kinds. With `--maps`, the evidence is kept in a file,
and a later run continues there.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import common_landmarks, make_parser, scan_files, side_of, write_text
from jaxtyping import Bool, Float, Int64
from scipy.optimize import minimize
from scipy.spatial import KDTree

from jaxsmw import Mesh, Pair, creature_pair, make_mesh, read_mesh
from jaxsmw.benchmark.datasets import choose_pairs, open_data_set
from jaxsmw.benchmark.tables import markdown
from jaxsmw.matching.preparation import prepare
from jaxsmw.matching.search.evidence import probabilities
from jaxsmw.matching.search.search import Judged, search
from jaxsmw.matching.stages import PRESETS
from jaxsmw.matching.starts import make_start
from jaxsmw.runtime.provenance import made_with
from jaxsmw.runtime.threads import one_blas_thread

# A map is right if its mean error, and the share of its errors above `GROSS`, are below these limits.
MEAN, GROSS, SHARE = 0.1, 0.25, 0.1
# The ends of the groups of maps in the table of reliability.
GROUPS = (0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1)
# The penalty of large weights, which keeps them finite.
PENALTY = 0.05
# The weights from which the fit begins, with the intercept first.
FIRST = np.array([-1.5, -2.0, -1.0, 0.5, -3.0])


class KnownPair(NamedTuple):
    """Two meshes, whether they are called partial, and vertices of X with their true matches."""

    kind: str
    x: Mesh
    y: Mesh
    partial: bool
    vertices: Int64[np.ndarray, " p"]
    truth: Int64[np.ndarray, " p"]


def of_data_sets(data: Path, number: int, seed: int) -> Iterator[KnownPair]:
    """Draw pairs of data sets with ground truth for all vertices."""
    for kind, name, partial in (
        ("people", "faust_r", False),
        ("people", "shrec19_r", False),
        ("animals", "smal_r", False),
        ("animals", "tosca_r", False),
        ("ape and people", "tosca_nonisometric", False),
        ("topological noise", "shrec16_topology", False),
        ("parts", "shrec16_partial", True),
        ("parts called full", "shrec16_partial", False),
    ):
        if not (data / name).is_dir():
            continue
        for pair in choose_pairs(open_data_set(data / name), str(number), seed):
            x, y = (read_mesh(file) for file in pair.meshes)
            truth = pair.ground_truth(x, y)
            targets = truth.targets
            matches = targets if isinstance(targets, np.ndarray) else targets.nearest_corners(y)
            yield KnownPair(kind, x, y, partial, truth.source_vertices, matches)


def of_landmarks(data: Path, number: int, seed: int) -> Iterator[KnownPair]:
    """Draw pairs of scans with manual landmarks, half of the teeth from opposite sides."""
    random = np.random.default_rng(seed)
    for kind, name in (("teeth", "primate_molars"), ("jaws", "mouse_mandibles")):
        files = scan_files(data / name) if (data / name).is_dir() else []
        drawn = 0
        while files and drawn < number:
            x, y = (files[i] for i in random.choice(len(files), 2, replace=False))
            if kind == "teeth" and (side_of(x) != side_of(y)) != bool(drawn % 2):
                continue
            drawn += 1
            meshes, landmarks = [read_mesh(x), read_mesh(y)], common_landmarks(x, y)
            vertices = [
                mesh.referenced_indices[
                    KDTree(mesh.vertices[mesh.referenced_indices]).query(own.positions)[1]
                ]
                for mesh, own in zip(meshes, landmarks, strict=True)
            ]
            yield KnownPair(kind, *meshes, False, *vertices)


def of_brains(data: Path) -> Iterator[KnownPair]:
    """Yield both halves of a brain in both directions."""
    files = sorted((data / "brain_halves").glob("*.off"))
    for x, y in (files, files[::-1]) if len(files) == 2 else ():
        meshes = read_mesh(x), read_mesh(y)
        same = np.arange(len(meshes[0].vertices))
        yield KnownPair("brain", *meshes, False, same, same)


def of_creatures(number: int, seed: int) -> Iterator[KnownPair]:
    """Make creatures, and parts of creatures that are called full."""
    for drawn in range(number):
        kind = ("biped", "quadruped")[drawn % 2]
        pair = creature_pair(kind, vertices=1500, seed=seed + drawn)
        x, y, truth = pair.source, pair.target, pair.truth.nearest_corners(pair.target)
        yield KnownPair("creatures", x, y, False, np.arange(len(truth)), truth)
        along = x.vertices[:, np.argmax(np.ptp(x.vertices, axis=0))]
        kept = along > np.quantile(along, (0.6, 0.4)[drawn // 2 % 2])
        part = make_mesh(x.vertices, x.faces[kept[x.faces].all(axis=1)], name="part")
        used = part.referenced_indices
        yield KnownPair("parts called full", part, y, False, used, truth[used])


def of_bumpy_bodies(number: int, seed: int) -> Iterator[KnownPair]:
    """Make bumpy bodies, and match them to bent copies and to bent mirror images."""
    ball = creature_pair("biped", vertices=2500).source
    directions = ball.vertices - ball.middle
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for drawn in range(number):
        random = np.random.default_rng(seed + drawn)
        centers = random.normal(size=(20, 3))
        centers /= np.linalg.norm(centers, axis=1, keepdims=True)
        heights = np.exp(40 * (sphere @ centers.T - 1)) @ random.choice([-1, 1], 20)
        body = sphere * (1 + 0.3 * np.tanh(heights))[:, None] * [1.6, 1.1, 1]
        bent = body + 0.1 * np.sin(2 * body[:, [1, 2, 0]] + random.uniform(0, 6, 3))
        order = random.permutation(len(body))
        other, faces = np.empty_like(bent), order[ball.faces]
        other[order] = bent * ([-1, 1, 1] if drawn % 2 else [1, 1, 1])
        meshes = make_mesh(body, ball.faces), make_mesh(other, faces[:, ::-1] if drawn % 2 else faces)
        yield KnownPair("bumpy bodies", *meshes, False, np.arange(len(order)), order)


class JudgedPair(NamedTuple):
    """The evidence of the maps of a pair, their mean errors and their shares of gross errors, by maps."""

    kind: str
    evidence: Float[np.ndarray, "c e"]
    errors: Float[np.ndarray, "c 2"]

    @property
    def right(self) -> Bool[np.ndarray, " c"]:
        """Whether each map is right as a whole."""
        return (self.errors < [MEAN, SHARE]).all(axis=1)


def judged_pair(known: KnownPair) -> JudgedPair:
    """Search with all hypotheses, and compare the maps with the truth."""
    preset = PRESETS["accurate"].fitted(min(len(mesh.referenced_indices) for mesh in (known.x, known.y)))
    assert preset.search is not None
    preset = replace(preset, search=replace(preset.search, certain=1.0))
    pair = Pair.make(known.x, known.y, partial=known.partial)
    with one_blas_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        prepared = prepare(pair.without_shortcuts(), preset.sizes, given=pair)
        start = make_start(prepared, "shot")
        prepared = prepared.describe(preset.number_of_descriptors)
        maps = search(prepared, start, prepared.usable(preset), mirror="auto")
    rows = [(list(one.evidence), errors_of(known, one)) for one in maps if one.evidence is not None]
    evidence, errors = zip(*rows, strict=True)
    return JudgedPair(known.kind, np.array(evidence, float), np.array(errors))


def errors_of(known: KnownPair, judged: Judged) -> tuple[float, float]:
    """Return the mean error of a map, and its share of gross errors."""
    offsets = known.y.vertices[judged.pointwise_map[known.vertices]] - known.y.vertices[known.truth]
    errors = np.linalg.norm(offsets, axis=1) / known.y.area**0.5
    return float(errors.mean()), float(np.mean(errors > GROSS))


def features(evidence: Float[np.ndarray, "c e"]) -> Float[np.ndarray, "c f"]:
    """Return what the log-odds depend on linearly, in the order of `Evidence`, with the intercept first."""
    deformation, *others, discontinuity = evidence.T
    columns = np.ones(len(evidence)), np.log(deformation + 0.01), *others, np.sqrt(discontinuity)
    return np.stack(columns, axis=1)


def fitted(pairs: Sequence[JudgedPair]) -> Float[np.ndarray, " f"]:
    """Return the weights of the largest likelihood: that one of the right maps is right, or none."""

    def loss(weights: Float[np.ndarray, " f"]) -> float:
        total = 0.0
        for pair in pairs:
            shares = probabilities(features(pair.evidence) @ weights)
            right = pair.right
            total -= np.log(max(shares[right].sum() if right.any() else 1 - shares.sum(), 1e-9))
        return float(total + PENALTY * weights[1:] @ weights[1:])

    return minimize(loss, FIRST).x


def tables(pairs: Sequence[JudgedPair]) -> Iterator[str]:
    """Yield the weights, the results of each kind, and the reliability of the probabilities."""
    weights = fitted(pairs)
    yield "Weights: " + ", ".join(f"{weight:.2f}" for weight in weights)
    rows = [["", "pairs", "right map exists", "right", "wrong and silent", "right and flagged"]]
    predicted, actual = [], []
    for kind in dict.fromkeys(pair.kind for pair in pairs):
        own = [pair for pair in pairs if pair.kind == kind]
        others = fitted([pair for pair in pairs if pair.kind != kind])
        shares = [probabilities(features(pair.evidence) @ others) for pair in own]
        best = [
            (of_pair.max(), pair.right[of_pair.argmax()]) for of_pair, pair in zip(shares, own, strict=True)
        ]
        numbers = (
            len(own),
            sum(pair.right.any() for pair in own),
            sum(right for _, right in best),
            sum(not right and share > 0.5 for share, right in best),
            sum(right and share <= 0.5 for share, right in best),
        )
        rows.append([kind, *map(str, numbers)])
        predicted += [share for share, _ in best]
        actual += [right for _, right in best]
    rows.append(["all", *(str(sum(int(row[column]) for row in rows[1:])) for column in range(1, 6))])
    yield "Each kind is judged by the weights of the other kinds:\n\n" + markdown(rows)
    chances, rights = np.array(predicted), np.array(actual)
    groups = [["probability", "maps", "mean probability", "right"]]
    for low, high in pairwise(GROUPS):
        own_group = (low <= chances) & ((chances < high) | (high == 1))
        if own_group.any():
            figures = f"{chances[own_group].mean():.0%}", f"{rights[own_group].mean():.0%}"
            groups.append([f"{low:.0%} to {high:.0%}", str(own_group.sum()), *figures])
    yield "Reliability of the probabilities of the best maps:\n\n" + markdown(groups)


def main() -> None:
    parser = make_parser(__doc__, pairs=8)
    parser.add_argument("data", metavar="DATA_DIRECTORY", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="seed of the choice of pairs (default: 0)")
    parser.add_argument("--maps", metavar="FILE.json", type=Path, help="file in which the evidence is kept")
    parser.add_argument("--output", metavar="FILE.md", type=Path, help="also write the tables to this file")
    options = parser.parse_args()
    data, number, seed = options.data, options.pairs, options.seed
    stored: list[dict[str, Any]] = []
    if options.maps and options.maps.exists():
        stored = json.loads(options.maps.read_text("utf-8"))
    sources = (
        of_data_sets(data, number, seed),
        of_landmarks(data, number, seed),
        of_brains(data),
        of_creatures(number, seed),
        of_bumpy_bodies(number, seed),
    )
    for position, known in enumerate(known for source in sources for known in source):
        if position < len(stored):
            continue
        pair = judged_pair(known)
        stored.append({"kind": pair.kind, "evidence": pair.evidence.tolist(), "errors": pair.errors.tolist()})
        print(known.kind, known.x.name, known.y.name, *pair.right, flush=True)
        if options.maps:
            write_text(options.maps, json.dumps(stored))
    pairs = [JudgedPair(row["kind"], np.array(row["evidence"]), np.array(row["errors"])) for row in stored]
    page = "\n\n".join((*tables(pairs), made_with() + "\n"))
    print(page)
    if options.output:
        write_text(options.output, page)


if __name__ == "__main__":
    main()
