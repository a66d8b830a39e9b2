"""The tables of the script `benchmark_search` count right, silent and flagged maps."""

import sys

import benchmark_search
import learn_judge
import numpy as np
import pytest
from benchmark_search import draw, tables
from judged_pairs import Judged, KnownPair, of_bumpy_bodies, of_creatures, of_two_parts
from learn_judge import JudgedPair
from report_helpers import cells

from jaxsmw import creature_pair

pytestmark = pytest.mark.study

RESULTS = [
    Judged("people", 0.01, True, True, 0.97, 3.0),
    Judged("people", 0.03, True, True, 0.45, 5.0),
    Judged("teeth", 0.3, False, True, 0.6, 7.0),
    Judged("teeth", 0.2, False, False, 0.2, 9.0),
]


def test_tables_count_right_silent_and_flagged_maps():
    rows = {row[0]: row[1:] for row in cells(tables(RESULTS))}
    assert rows["people"] == ["2", "2", "2", "0", "1", "20.0", "4.0"]
    assert rows["teeth"] == ["2", "0", "1", "1", "0", "250.0", "8.0"]
    assert rows["all"] == ["4", "2", "3", "1", "1", "135.0", "6.0"]
    assert rows["95% to 98%"][:2] == ["1", "97.0%"] and rows["95% to 98%"][2].startswith("100.0% [")


def test_the_judge_is_fitted_to_the_evidence_of_other_kinds():
    """The map of a pair is the more probable one, which is the less deformed one."""
    features = np.array([[1, np.log(0.02), 0, np.log(0.06), 1, 0], [1, 0, 0.5, -1, 0.1, 0]])
    pair, wrong = np.array([[0.01, 0], [0.3, 0.5]]), np.array([[0.2, 0.3], [0.3, 0.5]])
    pairs = [JudgedPair(kind, features, pair) for kind in ("people", "people", "teeth", "jaws")]
    weights, counts, reliability = learn_judge.tables([*pairs, JudgedPair("jaws", features, wrong)])
    rows = {row[0]: row[1:] for row in cells(counts)}
    assert rows["people"] == ["2", "2", "2", "0", "0"]
    assert rows["jaws"] == ["2", "1", "1", "1", "0"]
    assert rows["all"] == ["5", "4", "4", "1", "0"]
    assert weights.startswith("Weights: ") and sum(int(row[1]) for row in cells(reliability)[2:]) == 5


def test_the_reliability_curve_is_drawn(tmp_path):
    draw(RESULTS, tmp_path / "search.png")
    assert (tmp_path / "search.png").stat().st_size > 5000


def test_errors_of_a_known_pair():
    pair = creature_pair(vertices=600)
    true = pair.true_map
    rows = np.arange(len(true))
    known = KnownPair("creatures", pair.source, pair.target, False, rows, true)
    assert known.errors(true) == (0, 0)
    turned = known.errors(np.roll(true, 300))
    assert turned[0] > 0.1 and turned[1] > 0.1
    assert known._replace(vertices=rows[:0]).errors(true) == (np.inf, 1.0)  # two parts that share nothing


@pytest.mark.sampled
def test_two_parts_of_one_body_have_the_truth_of_their_overlap(shared):
    """Both cuts are taken to their full shape."""
    pairs = list(of_two_parts(shared / "data", 6, 0))
    assert len(pairs) == 6 and all(pair.partial for pair in pairs)
    assert any(len(pair.vertices) for pair in pairs)
    for pair in pairs:
        assert len(pair.truth) == len(pair.vertices) <= len(pair.x.vertices)


def test_an_interrupted_measurement_continues(monkeypatch, tmp_path, capsys):
    """Pairs with a result are not matched again. Names of pairs are unique."""
    pairs = [*of_creatures(2, 0), *of_bumpy_bodies(2, 0)]
    assert len({pair.names for pair in pairs}) == len(pairs) == 6
    matched = []

    def judged(known):
        matched.append(known.names)
        return {"error": 0.01, "gross": 0, "right": 1, "among": 1, "probability": 0.9, "seconds": 1.0}

    monkeypatch.setattr(benchmark_search, "judged", judged)
    monkeypatch.setattr(sys, "argv", ["benchmark_search.py", str(tmp_path), "--output", str(tmp_path)])
    for drawn in (pairs[:4], pairs):
        monkeypatch.setattr(benchmark_search, "known_pairs", lambda *_, drawn=drawn: iter(drawn))
        benchmark_search.main()
    assert len(matched) == 6
    rows = {row[0]: row[1:] for row in cells((tmp_path / "search.md").read_text())}
    assert rows["all"][:3] == ["6", "6", "6"]
