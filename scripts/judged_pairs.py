"""Pairs of many kinds of shapes with known matches, on which the search is judged, and tables of the results.

The pairs come from data sets (`docs/datasets.md`) and from made shapes: people, animals, an ape and people,
bodies with topological noise, teeth of both sides, jaws, halves of a brain, parts called partial and parts
called full, a mask and a head, creatures, bumpy bodies with their mirror images, and two parts of one body,
some of which share nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from benchmark_overlap import pairs_of_cuts
from common import common_landmarks, scan_files, side_of
from jaxtyping import Int, Int64
from scipy.spatial import KDTree
from scipy.stats import binomtest

from jaxsmw import PRESETS, Mesh, Pair, Preset, creature_pair, geodesic_error, make_mesh, read_mesh
from jaxsmw.benchmark.datasets import choose_pairs, open_data_set
from jaxsmw.evaluation import GroundTruth
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.preparation import PreparedPair, prepare
from jaxsmw.matching.starts import make_start
from jaxsmw.runtime.threads import one_blas_thread

# A map is right if its mean geodesic error, and the share of its errors above `GROSS`, are below these limits
# (unit: the square root of the area). Euclidean errors are too small where legs stand close together.
MEAN, GROSS, SHARE = 0.1, 0.25, 0.05
# The largest number of points at which an error is measured.
POINTS = 1000
# The ends of the groups of maps by probability.
GROUPS = (0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1)

TWO_PARTS = "two parts"
"""The kind of two parts of one body, which have weights of their own."""


class KnownPair(NamedTuple):
    """Two meshes, whether they are called partial, and vertices of X with their true matches."""

    kind: str
    x: Mesh
    y: Mesh
    partial: bool
    vertices: Int64[np.ndarray, " p"]
    truth: Int64[np.ndarray, " p"]

    @property
    def names(self) -> tuple[str, str]:
        """Names of the meshes, which no other pair has."""
        x, y = (Path(mesh.name).stem for mesh in (self.x, self.y))
        return f"{self.kind}: {x}", y

    def errors(self, pointwise_map: Int[np.ndarray, " m"]) -> tuple[float, float]:
        """Return the mean error of a map, and its share of gross errors."""
        if not len(self.vertices):
            return np.inf, 1.0  # two parts that share nothing have no right map
        truth = GroundTruth(self.vertices, self.truth)
        points = min(POINTS, len(self.vertices))
        found = geodesic_error(self.y, pointwise_map, truth, number_of_samples=points)
        return float(found.mean), float(np.mean(found.errors > GROSS))


@contextmanager
def prepared(known: KnownPair) -> Iterator[tuple[PreparedPair, Start, Preset]]:
    """Prepare a pair for the preset `accurate`, and yield the start SHOT and the usable preset as well.

    Inside of the context, warnings are ignored, and the linear algebra uses one thread.
    """
    preset = PRESETS["accurate"].fitted(min(len(mesh.referenced_indices) for mesh in (known.x, known.y)))
    pair = Pair.make(known.x, known.y, partial=known.partial)
    with one_blas_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shapes = prepare(pair.without_shortcuts(), preset.sizes, given=pair)
        start = make_start(shapes, "shot")
        shapes = shapes.describe(preset.number_of_descriptors)
        yield shapes, start, shapes.usable(preset)


def is_right(mean: float, gross: float) -> bool:
    """Return whether a map with this mean error and this share of gross errors is right as a whole."""
    return mean < MEAN and gross < SHARE


def known_pairs(data: Path, number: int, seed: int) -> Iterator[KnownPair]:
    """Draw at most `number` pairs of each data set and of each kind of made shapes."""
    return chain(
        of_data_sets(data, number, seed),
        of_landmarks(data, number, seed),
        of_brains(data),
        of_masks(data),
        of_creatures(number, seed),
        of_bumpy_bodies(number, seed),
        of_two_parts(data, number, seed),
    )


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
            meshes = read_mesh(x), read_mesh(y)
            at_x, at_y = (
                mesh.referenced_indices[
                    KDTree(mesh.vertices[mesh.referenced_indices]).query(own.positions)[1]
                ]
                for mesh, own in zip(meshes, common_landmarks(x, y), strict=True)
            )
            yield KnownPair(kind, *meshes, False, at_x, at_y)


def of_brains(data: Path) -> Iterator[KnownPair]:
    """Yield both halves of a brain in both directions."""
    files = sorted((data / "brain_halves").glob("*.off"))
    for x, y in (files, files[::-1]) if len(files) == 2 else ():
        meshes = read_mesh(x), read_mesh(y)
        same = np.arange(len(meshes[0].vertices))
        yield KnownPair("brain", *meshes, False, same, same)


def of_masks(data: Path) -> Iterator[KnownPair]:
    """Yield a mask and a head of different people in both directions, with landmarks."""
    folder = data / "open_shells"
    if folder.is_dir():
        meshes = read_mesh(folder / "mask.off"), read_mesh(folder / "head.off")
        landmarks = np.loadtxt(folder / "landmarks.csv", delimiter=",", skiprows=1, dtype=np.int64).T
        for x, y in ((0, 1), (1, 0)):
            yield KnownPair("mask", meshes[x], meshes[y], False, landmarks[x], landmarks[y])


def of_creatures(number: int, seed: int) -> Iterator[KnownPair]:
    """Make creatures, and parts of creatures that are called full."""
    for drawn in range(number):
        kind = ("biped", "quadruped")[drawn % 2]
        pair = creature_pair(kind, vertices=1500, seed=seed + drawn)
        x, y, truth = pair.source, pair.target, pair.truth.nearest_corners(pair.target)
        yield KnownPair("creatures", x, y, False, np.arange(len(truth)), truth)
        along = x.vertices[:, np.argmax(np.ptp(x.vertices, axis=0))]
        kept = along > np.quantile(along, (0.6, 0.4)[drawn // 2 % 2])
        part = make_mesh(x.vertices, x.faces[kept[x.faces].all(axis=1)], name=f"part of {x.name}")
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
        meshes = (
            make_mesh(body, ball.faces, name=f"bumpy body {seed + drawn}"),
            make_mesh(
                other,
                faces[:, ::-1] if drawn % 2 else faces,
                name="its mirror image" if drawn % 2 else "itself, bent",
            ),
        )
        yield KnownPair("bumpy bodies", *meshes, False, np.arange(len(order)), order)


def of_two_parts(data: Path, number: int, seed: int) -> Iterator[KnownPair]:
    """Draw pairs of cuts of one body, which are called partial, with the truth where they overlap."""
    folder = data / "shrec16_partial"
    pairs = list(pairs_of_cuts(folder)) if folder.is_dir() else []
    for drawn in np.random.default_rng(seed).permutation(len(pairs))[:number]:
        pair = pairs[drawn]
        shared = np.flatnonzero(pair.inside)
        matches = pair.points.nearest_corners(pair.target.mesh)[shared]
        yield KnownPair(TWO_PARTS, pair.source.mesh, pair.target.mesh, True, shared, matches)


class Judged(NamedTuple):
    """The map of a pair: its mean error, whether it is right, and with which probability.

    `among` states whether this map or another one of the search is right.
    """

    kind: str
    error: float
    right: bool
    among: bool
    probability: float
    seconds: float = np.nan

    @property
    def silent(self) -> bool:
        """Whether the map looks right."""
        return self.probability >= 0.5


def count_table(results: Sequence[Judged], among: str) -> list[list[str]]:
    """Return the numbers of right, silent and flagged maps of each kind; `among` is the title of a column."""
    rows = [["", "pairs", "right", among, "wrong and silent", "right and flagged"]]
    for kind in (*dict.fromkeys(result.kind for result in results), "all"):
        own = [result for result in results if kind in (result.kind, "all")]
        counts = (
            len(own),
            sum(result.right for result in own),
            sum(result.among for result in own),
            sum(result.silent and not result.right for result in own),
            sum(result.right and not result.silent for result in own),
        )
        rows.append([kind, *map(str, counts)])
    return rows


class Group(NamedTuple):
    """Maps with similar probabilities: their number, their mean probability, and the share that it predicts.

    `least` and `most` are the ends of the 95 % interval of the share (Wilson 1927).
    """

    limits: str
    number: int
    probability: float
    share: float
    least: float
    most: float


def grouped(
    probabilities: Sequence[float], outcomes: Sequence[bool], ends: Sequence[float] = GROUPS
) -> list[Group]:
    """Return the groups of maps that are not empty. The last group contains its upper end."""
    predicted, happened = np.array(probabilities), np.array(outcomes)
    groups = []
    for low, high in pairwise(ends):
        own = (low <= predicted) & ((predicted < high) | (high == ends[-1]))
        if own.any():
            number, events = int(own.sum()), int(happened[own].sum())
            least, most = binomtest(events, number).proportion_ci(method="wilson")
            mean, share = float(predicted[own].mean()), events / number
            groups.append(Group(f"{low:.0%} to {high:.0%}", number, mean, share, float(least), float(most)))
    return groups


def reliability(results: Sequence[Judged]) -> list[Group]:
    """Return the groups of results by the probability that the map is right."""
    return grouped([result.probability for result in results], [result.right for result in results])


def reliability_table(results: Sequence[Judged]) -> list[list[str]]:
    """Return the mean probability and the share of right maps of each group."""
    rows = [["probability", "maps", "mean probability", "right"]]
    for group in reliability(results):
        interval = f"{group.share:.1%} [{group.least:.1%}, {group.most:.1%}]"
        rows.append([group.limits, str(group.number), f"{group.probability:.1%}", interval])
    return rows
