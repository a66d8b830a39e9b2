"""The tables of the script `calibrate_scores` are correct for known measurements."""

import numpy as np
import pytest
from calibrate_scores import Measured, calibration, tables
from report_helpers import cells

pytestmark = pytest.mark.study


def test_tables_summarise_the_measurements():
    true = np.linspace(0, 0.2, 100)  # half of the errors are gross
    right, wrong = Measured(true, true, 0.1), Measured(true, true[::-1].copy(), 0.9)
    shares, tenths, _ = map(cells, tables({"a": [right], "b": [wrong, wrong]}))
    assert shares[2] == ["a", "1", "100.0", "100.0", "1.00", "50.00%", "20%"]
    assert shares[3] == ["b", "2", "100.0", "100.0", "-1.00", "50.00%", "0%"]
    assert len(tenths) == 12 and tenths[-1][0] == "180.0 to 200.0"
    # The group with the largest expected errors contains the ten largest true errors of the first pair, and
    # the ten smallest true errors of each other pair.
    assert float(tenths[-1][1]) == round(1e3 * (true[-10:].mean() + 2 * true[:10].mean()) / 3, 1)


def test_predicted_probabilities_are_compared_with_the_share_of_wrong_maps():
    """Maps with known probabilities are wrong at random."""
    random, errors = np.random.default_rng(0), np.full(100, 0.01)
    maps = []
    for probability in random.uniform(size=4000):
        # Three of 100 errors exceed 0.25 on a wrong map, and one of 100 on another map.
        large = np.arange(100) < (3 if random.uniform() < probability else 1)
        maps.append(Measured(np.where(large, 0.3, errors), errors, probability))
    rows = cells(calibration(maps))[2:]
    assert sum(int(row[1]) for row in rows) == 4000
    for row in rows:
        predicted, share = (float(cell.rstrip("%")) / 100 for cell in row[2:])
        assert share == pytest.approx(predicted, abs=0.06)
