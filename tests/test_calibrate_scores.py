"""The study of scores: what its tables say of pairs whose figures are known."""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from jaxsmw import creature_pair, match

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from calibrate_scores import AS_IT_STARTS, Measured, looks, tables


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if "|" in line]


def test_tables_say_what_was_measured():
    true = np.linspace(0, 0.2, 100)  # half of them gross
    knowing = Measured(true, true, {"flaw": (1.0, 2.0)})
    wrong = Measured(true, true[::-1].copy(), {"flaw": (3.0, 2.0)})
    shares, tenths, scores = map(cells, tables({"a": [knowing], "b": [wrong, wrong]}))
    assert shares[2] == ["a", "1", "100.0", "100.0", "1.00", "50.00%", "20%"]
    assert shares[3] == ["b", "2", "100.0", "100.0", "-1.00", "50.00%", "0%"]
    assert len(tenths) == 12 and tenths[-1][0] == "180.0 to 200.0"
    # The last tenth: ten of the largest errors by the one, twenty of the smallest by the others.
    assert float(tenths[-1][1]) == round(1e3 * (true[-10:].mean() + 2 * true[:10].mean()) / 3, 1)
    assert scores[2:] == [["a", "1 of 1"], ["b", "0 of 2"]]


def test_stages_after_the_first_do_not_mend():
    assert all(stage.mending is None for stage in AS_IT_STARTS)


def test_a_map_is_looked_at_in_every_way():
    pair = creature_pair(vertices=1100)
    found = match(pair.source, pair.target, preset="fast")
    scores = looks(found)
    assert np.isfinite(list(scores.values())).all()
    # The same, with what lies left and right of its middle exchanged.
    other = pair.target.vertices * (-1, 1, 1)
    mirrored = cKDTree(pair.target.vertices).query(other[found.pointwise_map])[1]
    wrong = looks(match(pair.source, pair.target, init=mirrored, preset="fast"))
    assert wrong.keys() == scores.keys() and wrong["flaw"] > scores["flaw"]
