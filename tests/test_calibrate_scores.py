"""The tables of the script `calibrate_scores` are correct for known measurements."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxsmw import creature_pair, match
from jaxsmw.matching.judge import wrong_probability
from jaxsmw.matching.settings import WrongProbabilitySettings
from jaxsmw.matching.stages import choose_preset

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from calibrate_scores import WITHOUT_REPAIR, Measured, calibration, fitted, scores_of, tables

pytestmark = pytest.mark.study


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if "|" in line]


def test_tables_summarise_the_measurements():
    true = np.linspace(0, 0.2, 100)  # half of the errors are gross
    right = Measured(true, true, 1.01, 0.01, {"distortion": (1.0, 2.0)})
    wrong = Measured(true, true[::-1].copy(), 3.0, 0.2, {"distortion": (3.0, 2.0)})
    shares, tenths, _, scores = map(cells, tables({"a": [right], "b": [wrong, wrong]}))
    assert shares[2] == ["a", "1", "100.0", "100.0", "1.00", "50.00%", "20%"]
    assert shares[3] == ["b", "2", "100.0", "100.0", "-1.00", "50.00%", "0%"]
    assert len(tenths) == 12 and tenths[-1][0] == "180.0 to 200.0"
    # The group with the largest expected errors contains the ten largest true errors of the first pair, and
    # the ten smallest true errors of each other pair.
    assert float(tenths[-1][1]) == round(1e3 * (true[-10:].mean() + 2 * true[:10].mean()) / 3, 1)
    assert scores[2:] == [["a", "1 of 1"], ["b", "0 of 2"]]


def test_the_coefficients_of_the_probability_are_recovered():
    """Maps with known probabilities are wrong at random."""
    random, errors = np.random.default_rng(0), np.full(100, 0.01)
    true = WrongProbabilitySettings(intercept=4.0, distortion_weight=3.0, expected_error_weight=1.5)
    maps = []
    for distortion, expected in zip(
        np.exp(random.exponential(0.5, 4000)), np.exp(random.normal(-4, 1, 4000)), strict=True
    ):
        probability = wrong_probability(distortion, expected, true)
        # Three of 100 errors exceed 0.25 on a wrong map, and one of 100 on another map.
        large = np.arange(100) < (3 if random.uniform() < probability else 1)
        maps.append(Measured(np.where(large, 0.3, errors), errors, distortion, expected, {}))
    found = fitted(maps)
    assert found.distortion_weight == pytest.approx(3, rel=0.15)
    assert found.expected_error_weight == pytest.approx(1.5, rel=0.15)
    assert found.intercept == pytest.approx(4, rel=0.2)
    rows = cells(calibration(maps, true))[2:]
    assert sum(int(row[1]) for row in rows) == 4000
    for row in rows:
        predicted, share = (float(cell.rstrip("%")) / 100 for cell in row[2:])
        assert share == pytest.approx(predicted, abs=0.05)


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
