"""Fits the judge of the search: how evidence without ground truth becomes the probability of a right map.

    python scripts/learn_judge.py DATA_DIRECTORY [--pairs N] [--seed SEED] [--kind KIND] [--maps FILE.json]
        [--output FILE.md]

`DATA_DIRECTORY` contains the data sets of `docs/datasets.md`. The script draws N pairs of each kind of
`scripts/judged_pairs.py`. `search` always runs all hypotheses, and returns maps that differ from each other.

The probabilities of the maps of a pair are those of `jaxsmw.matching.search.evidence`, and the script
maximises their likelihood. Except for two parts of one body, each pair with right and wrong maps counts once
more, with a small weight, as if no right map had been found. The script prints the weights of all kinds
together. For the tables of results, the maps of each kind are judged by the weights of all other kinds. Two
parts of one body have weights of their own, and each body is a kind. `--kind "two parts"` draws only such
pairs. With `--maps`, the features of the maps are kept in a file, and a later run with the same options
continues there.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import make_parser, write_text
from jaxtyping import Bool, Float
from judged_pairs import (
    TWO_PARTS,
    Judged,
    KnownPair,
    count_table,
    is_right,
    known_pairs,
    prepared,
    reliability_table,
)
from scipy.optimize import minimize

from jaxsmw.benchmark.tables import markdown
from jaxsmw.matching.search.evidence import probability, shares
from jaxsmw.matching.search.search import search
from jaxsmw.runtime.provenance import made_with

# The penalty of large weights, which keeps them finite.
PENALTY = 0.1
# The weights from which the fit begins, with the intercept first.
FIRST = np.array([-6.0, -1.0, -3.0, -2.0, 2.0, 2.0])
# How much a pair counts without its right maps. Few pairs have no right map, and without such pairs nearly
# every map would be called right.
WITHOUT_RIGHT = 0.2


class JudgedPair(NamedTuple):
    """The features of the maps of a pair, their mean errors and their shares of gross errors, by maps."""

    kind: str
    features: Float[np.ndarray, "c f"]
    errors: Float[np.ndarray, "c 2"]

    @property
    def right(self) -> Bool[np.ndarray, " c"]:
        """Whether each map is right as a whole."""
        return np.array([is_right(*errors) for errors in self.errors], bool)

    def without_right(self) -> JudgedPair | None:
        """Return the pair as if no right map had been found, or None if it has no right map or no other.

        Two parts do not count again, because many of them share nothing, and have no right map.
        """
        wrong = ~self.right
        if wrong.all() or not wrong.any() or self.kind.startswith(TWO_PARTS):
            return None
        return self._replace(features=self.features[wrong], errors=self.errors[wrong])


def judged_pair(known: KnownPair) -> JudgedPair:
    """Search with all hypotheses, and compare the maps with the truth."""
    with prepared(known) as (shapes, start, preset):
        assert preset.search is not None
        preset = replace(preset, search=replace(preset.search, certain=1.0))
        maps = search(shapes, start, preset, mirror="auto")
    kind = known.kind
    if kind == TWO_PARTS:
        kind += f" ({Path(known.x.name).stem.split('_')[1]})"
    maps = [one for one in maps if np.isfinite(one.log_odds)]
    errors = [known.errors(one.pointwise_map) for one in maps]
    return JudgedPair(kind, np.array([one.evidence.features for one in maps]), np.array(errors))


def shares_of(pair: JudgedPair, weights: Float[np.ndarray, " f"]) -> Float[np.ndarray, " c"]:
    """Return the probability of each map of a pair to be right."""
    log_odds = (pair.features @ weights).tolist()
    return shares(log_odds) * probability(max(log_odds))


def fitted(pairs: Sequence[JudgedPair]) -> Float[np.ndarray, " f"]:
    """Return the weights of the largest likelihood: that one of the right maps is right, or none."""

    weighted = [(pair, 1.0) for pair in pairs]
    weighted += [(wrong, WITHOUT_RIGHT) for pair in pairs if (wrong := pair.without_right()) is not None]

    def loss(weights: Float[np.ndarray, " f"]) -> float:
        total = 0.0
        for pair, weight in weighted:
            shares, right = shares_of(pair, weights), pair.right
            total -= weight * np.log(max(shares[right].sum() if right.any() else 1 - shares.sum(), 1e-9))
        return float(total + PENALTY * weights[1:] @ weights[1:])

    return minimize(loss, FIRST).x


def tables(pairs: Sequence[JudgedPair]) -> Iterator[str]:
    """Yield the weights, the results of each kind, and the reliability of the probabilities."""
    weights = fitted(pairs)
    yield "Weights: " + ", ".join(f"{weight:.2f}" for weight in weights)
    judged = []
    for kind in dict.fromkeys(pair.kind for pair in pairs):
        others = fitted([pair for pair in pairs if pair.kind != kind])
        for pair in pairs:
            if pair.kind == kind:
                shares, right = shares_of(pair, others), pair.right
                best = shares.argmax()
                error, probability = float(pair.errors[best, 0]), float(shares[best])
                judged.append(Judged(kind, error, bool(right[best]), bool(right.any()), probability))
    counts = markdown(count_table(judged, "right map exists"))
    yield "Each kind is judged by the weights of the other kinds:\n\n" + counts
    groups = markdown(reliability_table(judged))
    yield "Reliability of the probabilities of the best maps:\n\n" + groups


def main() -> None:
    parser = make_parser(__doc__, data="DATA_DIRECTORY", pairs=8, seed=True)
    parser.add_argument("--kind", help="draw only pairs of this kind")
    parser.add_argument("--maps", metavar="FILE.json", type=Path, help="file in which the features are kept")
    parser.add_argument("--output", metavar="FILE.md", type=Path, help="also write the tables to this file")
    options = parser.parse_args()
    data, number, seed = options.data, options.pairs, options.seed
    stored: list[dict[str, Any]] = []
    if options.maps and options.maps.exists():
        stored = json.loads(options.maps.read_text("utf-8"))
    drawn = (pair for pair in known_pairs(data, number, seed) if options.kind in (None, pair.kind))
    for position, known in enumerate(drawn):
        if position < len(stored):
            continue
        pair = judged_pair(known)
        stored.append({"kind": pair.kind, "features": pair.features.tolist(), "errors": pair.errors.tolist()})
        print(known.kind, known.x.name, known.y.name, *pair.right, flush=True)
        if options.maps:
            write_text(options.maps, json.dumps(stored))
    pairs = [JudgedPair(row["kind"], np.array(row["features"]), np.array(row["errors"])) for row in stored]
    groups = [[pair for pair in pairs if pair.kind.startswith(TWO_PARTS) == two] for two in (False, True)]
    page = "\n\n".join((*chain.from_iterable(map(tables, filter(None, groups))), made_with() + "\n"))
    print(page)
    if options.output:
        write_text(options.output, page)


if __name__ == "__main__":
    main()
