"""The tables of the script `calibrate_scores` are correct for known measurements."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxsmw import creature_pair, match
from jaxsmw.presets import choose_preset

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from calibrate_scores import WITHOUT_REPAIR, Measured, scores_of, tables

pytestmark = pytest.mark.study


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if "|" in line]


def test_tables_summarise_the_measurements():
    true = np.linspace(0, 0.2, 100)  # half of the errors are gross
    right = Measured(true, true, {"distortion": (1.0, 2.0)})
    wrong = Measured(true, true[::-1].copy(), {"distortion": (3.0, 2.0)})
    shares, tenths, scores = map(cells, tables({"a": [right], "b": [wrong, wrong]}))
    assert shares[2] == ["a", "1", "100.0", "100.0", "1.00", "50.00%", "20%"]
    assert shares[3] == ["b", "2", "100.0", "100.0", "-1.00", "50.00%", "0%"]
    assert len(tenths) == 12 and tenths[-1][0] == "180.0 to 200.0"
    # The group with the largest expected errors contains the ten largest true errors of the first pair, and
    # the ten smallest true errors of each other pair.
    assert float(tenths[-1][1]) == round(1e3 * (true[-10:].mean() + 2 * true[:10].mean()) / 3, 1)
    assert scores[2:] == [["a", "1 of 1"], ["b", "0 of 2"]]


def test_stages_after_the_first_do_not_repair():
    assert choose_preset(WITHOUT_REPAIR).repair is None


@pytest.mark.filterwarnings("ignore:.*limbs may be swapped:UserWarning")
def test_a_mirrored_map_has_a_worse_distortion():
    pair = creature_pair(vertices=1100)
    found = match(pair.source, pair.target, preset="fast")
    scores = scores_of(found)
    assert np.isfinite(list(scores.values())).all()
    # The mirrored map is the found map with left and right exchanged.
    other = pair.target.vertices * (-1, 1, 1)
    mirrored = cKDTree(pair.target.vertices).query(other[found.pointwise_map])[1]
    wrong = scores_of(match(pair.source, pair.target, init=mirrored, preset="fast"))
    assert wrong.keys() == scores.keys() and wrong["distortion"] > scores["distortion"]
