"""The report of a match has the right files, texts and times."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_helpers import TALL, embedded, renumbered

from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.evaluation.ground_truth import GroundTruth
from jaxsmw.evaluation.metrics import GeodesicError, geodesic_error
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.match import match
from jaxsmw.matching.search.alternatives import Alternative
from jaxsmw.matching.stages import Stage
from jaxsmw.report.summary import REPORT_FILES, summarize, write_comparison, write_report
from jaxsmw.wording import percentage

SOURCE = replace(TALL, vertices=TALL.vertices * (1 + 0.2 * np.sin(4 * TALL.vertices[:, [1]])), name="X.off")
TARGET, NUMBER = renumbered(replace(SOURCE, name="Y.off"), seed=1)


pytestmark = pytest.mark.usefixtures("small_pictures")


@pytest.fixture(scope="module")
def found() -> Correspondence:
    stage = Stage(WaveletPreservation(convention="pushforward"), number_of_eigenvectors=20, iterations=1)
    return match(SOURCE, TARGET, preset=stage, init=NUMBER)


@pytest.fixture(scope="module")
def errors(found: Correspondence) -> dict[str, GeodesicError]:
    truth = GroundTruth.of_all_vertices(NUMBER)
    maps = {"initial": found.initial_map, "refined": found.pointwise_map}
    return {name: geodesic_error(TARGET, pointwise_map, truth) for name, pointwise_map in maps.items()}


def read(directory: Path) -> tuple[dict[str, Any], str]:
    """Return the summary and the page of a report."""
    summary = json.loads((directory / "summary.json").read_text("utf-8"))
    return summary, (directory / "report.html").read_text("utf-8")


@pytest.mark.slow
def test_the_report_states_the_results_and_the_time_of_every_step(
    found: Correspondence, errors: dict[str, GeodesicError], tmp_path: Path
) -> None:
    given = {"reading": 0.5, **found.seconds, "geodesic errors": 12.25}
    written = write_report(tmp_path, found, errors=errors, seconds=given, settings={"seed": 3})
    summary, page = read(tmp_path)
    _check_results(found, errors, summary, page)
    times = summary["seconds"]
    assert list(times) == [*given, "expected error", "pictures", "total"]
    assert {name: times[name] for name in given} == given
    assert times["expected error"] > 0 and times["pictures"] > 0
    assert times["total"] == pytest.approx(sum(times.values()) - times["total"])
    for name, seconds in times.items():
        assert summary["result"][f"time, {name}"] == f"{seconds:.2f} s"
        assert f"<dt>time, {name}</dt><dd>{seconds:.2f} s</dd>" in page
    assert sorted(written) == sorted(tmp_path.iterdir()) == sorted(tmp_path / name for name in REPORT_FILES)


@pytest.mark.slow
def test_the_report_states_the_times_of_match_by_default(found: Correspondence, tmp_path: Path) -> None:
    write_report(tmp_path, found)
    summary, page = read(tmp_path)
    assert list(summary["seconds"]) == [*found.seconds, "expected error", "pictures", "total"]
    assert set(REPORT_FILES) - {path.name for path in tmp_path.iterdir()} == {"quality.png"}
    # Without ground truth, the page shows only the expected error, and explains it as an estimate.
    assert embedded(page)["error_names"] == ["Expected error"]
    assert re.search(r'<p data-for="error-0">An estimate of the distance .* not use the true points', page)


def _check_results(
    found: Correspondence, errors: dict[str, GeodesicError], summary: dict[str, Any], page: str
) -> None:
    """Check that the summary and the page state the results of the match."""
    assert list(summary) == [
        "settings", "result", "backend", "partial", "scale", "overlap", "distortion", "suspicious",
        "wrong_probability", "alternatives", "errors", "seconds", "provenance",
    ]  # fmt: skip
    assert summary["overlap"] is None  # both shapes are full
    assert summary["settings"] == {"seed": 3}
    assert summary["distortion"] == pytest.approx(1, abs=1e-3) and summary["suspicious"] is False
    assert summary["errors"]["refined"]["mean"] == errors["refined"].mean
    expected = found.expected_error()
    facts = summarize(found, errors)
    shown = {label: text for label, text in summary["result"].items() if not label.startswith("time")}
    assert shown == {label: text for label, text in facts.items() if not label.startswith("time")}
    assert facts["vertices"] == "642 to 642" and facts["iterations"] == "1"
    assert facts["mean error, refined map"] == f"{errors['refined'].mean:.4f} √area"
    assert facts["error at most 0.05, initial map"] == "100.0%"
    mean = np.average(expected, weights=found.mesh_x.vertex_areas)
    assert facts["expected error, mean"] == f"{mean:.4f} √area"
    assert summary["wrong_probability"] == pytest.approx(1 - found.probability)
    assert summary["alternatives"] == []
    assert facts["probability of a wrong map"] == percentage(summary["wrong_probability"])
    assert facts["time, total"] == f"{sum(found.seconds.values()):.2f} s"
    judged = summarize(replace(found, distortion=1.3, probability=0.8), {})
    assert (summary["partial"], summary["scale"]) == (False, 1.0)
    part = replace(found.pair, partial=True, scale=2.0)
    told = {"matched as partial shapes": "yes", "source lengths multiplied by": "2"}
    assert not told.keys() & facts.keys() and told.items() <= summarize(replace(found, pair=part), {}).items()
    assert judged["probability of a wrong map"] == "20 %" and judged["distortion (1 is none)"] == "1.30"
    # The page shows the refined and the initial map in the convention of the refiner.
    refined, initial = embedded(page)["maps"]
    assert (refined["name"], initial["name"]) == ("refined", "initial")
    assert refined["functional"]["pushforward"] and initial["functional"]["pushforward"]


@pytest.mark.slow
def test_the_report_shows_other_maps_that_could_be_right(found: Correspondence, tmp_path: Path) -> None:
    others = (Alternative(NUMBER[::-1].copy(), 0.3, "turned by 180°"), Alternative(NUMBER, 0.004, "mirrored"))
    write_report(tmp_path, replace(found, probability=0.6, alternatives=others))
    summary, page = read(tmp_path)
    assert summary["wrong_probability"] == pytest.approx(0.4) and summary["suspicious"] is False
    assert summary["alternatives"] == [
        {"difference": "turned by 180°", "probability": 0.3},
        {"difference": "mirrored", "probability": 0.004},
    ]
    shown = embedded(page)["maps"]
    assert [one["name"] for one in shown] == [
        "refined",
        "initial",
        "other 1: turned by 180° (probability 30 %)",
        "other 2: mirrored (probability below 1 %)",
    ]
    # The second alternative is the initial map, and the first is neither map.
    assert shown[3]["map"] == shown[1]["map"] != shown[2]["map"]
    assert '<p class="fault">' not in page
    write_report(tmp_path, replace(found, probability=0.1, alternatives=others, mirrored=True))
    _, page = read(tmp_path)
    assert '<p class="fault">Be careful: the map is wrong as a whole with a probability of 90 %' in page
    assert '<p class="fault">The source was matched as its mirror image' in page


def test_a_comparison_explains_its_errors(errors: dict[str, GeodesicError], tmp_path: Path) -> None:
    write_comparison(
        tmp_path / "page.html", SOURCE, TARGET, {"initial": NUMBER}, errors={"initial": errors["initial"]}
    )
    page = (tmp_path / "page.html").read_text("utf-8")
    assert re.search(r'<p data-for="error-0">The distance along the surface between each match', page)
    assert embedded(page)["limit"] == 0.1
