"""`jaxsmw benchmark --verify` measures a tenth of stored results again, and says whether they hold."""

import csv
import json
from pathlib import Path

import pytest
from messages import refused
from test_benchmark import scape  # noqa: F401 (a fixture)

from jaxsmw import InputError
from jaxsmw.benchmark.datasets import open_data_set
from jaxsmw.benchmark.journal import Journal
from jaxsmw.benchmark.verification import Comparison, StoredResults
from jaxsmw.cli.run import run_command


@pytest.mark.parametrize(
    ("stored", "measured", "holds"),
    [
        (0.1, 0.1, True),
        (0.1, 0.1019, True),
        (0.1, 0.1021, False),
        (0.001, 0.00149, True),
        (0.001, 0.00151, False),
        (float("nan"), float("nan"), True),
        (float("nan"), 0.1, False),
        (0.1, float("nan"), False),
    ],
)
def test_an_error_holds_if_the_new_error_is_close(stored, measured, holds):
    assert Comparison("a", "b", "mwp", stored, measured).holds == holds


def change(path: Path, column: str, value: str) -> None:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(row | {column: value} for row in rows)


@pytest.fixture(scope="module")
def results(scape, tmp_path_factory) -> Path:  # noqa: F811
    output = tmp_path_factory.mktemp("results")
    methods = ("--methods", "initial", "mwp", "--evaluation-samples", "200", "--seed", "3")
    assert run_command(["benchmark", str(scape), "--output", str(output), *methods, "--workers", "1"]) == 0
    return output / "results.csv"


@pytest.mark.slow
def test_unchanged_results_hold(scape, results, capsys):  # noqa: F811
    before = {path: path.read_bytes() for path in results.parent.iterdir()}
    assert run_command(["benchmark", str(scape), "--verify", str(results), "--workers", "1"]) == 0
    out = capsys.readouterr().out
    assert "| initial | 1 | 1 | 1 | 0 |" in out and "| mwp | 1 | 1 | 1 | 0 |" in out
    assert out.endswith("All 2 errors hold: they differ by at most 2 %, or by at most 0.0005.\n")
    assert {path: path.read_bytes() for path in results.parent.iterdir()} == before


@pytest.mark.slow
def test_changed_results_do_not_hold(scape, results, tmp_path, capsys):  # noqa: F811
    for file in ("results.csv", "provenance.json"):
        (tmp_path / file).write_bytes((results.parent / file).read_bytes())
    change(tmp_path / "results.csv", "mean", "0.9")
    assert run_command(["benchmark", str(scape), "--verify", str(tmp_path / "results.csv")]) == 1
    printed = capsys.readouterr()
    assert "| initial | 1 | 0 | 0 |" in printed.out
    assert "2 of 2 errors do not hold" in printed.err and "0.9000 is stored" in printed.err


@pytest.mark.slow
def test_other_pairs_are_drawn_with_another_seed(scape, results):  # noqa: F811
    stored, data_set = StoredResults(results), open_data_set(scape)
    drawn = {tuple(pair.names for pair in stored.draw(data_set, seed)) for seed in range(30)}
    assert all(len(pairs) == 1 for pairs in drawn) and len(drawn) == 6
    assert stored.settings.evaluated_points == 200 and stored.settings.seed == 3


def write_results(directory: Path, *, rows: str = "", settings: object = None) -> Path:
    stored = {"init": "shot", "mirrored": False, "evaluated_points": None, "seed": 0}
    (directory / "provenance.json").write_text(json.dumps({"settings": settings or stored}))
    columns = (
        "source,target,method,machine,result,seconds,truth,mean,median,within_0.02,within_0.05,within_0.1,"
        "area_under_curve,unreachable,coverage,curve\n"
    )
    (directory / "results.csv").write_text(columns + rows)
    return directory / "results.csv"


ROW = "a,b,mwp,m,successful,1,direct,0.1,0.1,1,1,1,1,0,1," + " ".join(["1"] * 51) + "\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d / "missing.csv", "missing.csv: is not a file"),
        (lambda d: write_results(d), "contains no results"),
        (lambda d: write_results(d, rows=ROW, settings={"init": "wks"}), "does not contain the settings"),
        (
            lambda d: write_results(
                d, rows=ROW, settings={"init": "wks", "mirrored": False, "evaluated_points": 5, "seed": 0}
            ),
            "was measured with the initial maps wks: give them with --init",
        ),
    ],
)
def test_results_that_cannot_be_verified_are_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        StoredResults(change(tmp_path), "shot")


def test_missing_provenance_is_named(tmp_path):
    path = write_results(tmp_path, rows=ROW)
    (tmp_path / "provenance.json").unlink()
    with pytest.raises(InputError, match=r"provenance.json: cannot be read"):
        StoredResults(path, "shot")


def test_results_of_another_data_set_are_refused(scape, tmp_path):  # noqa: F811
    stored = StoredResults(write_results(tmp_path, rows=ROW), "shot")
    with refused("pair a to b", "not in"):
        stored.draw(open_data_set(scape), 0)


def test_methods_with_maps_from_a_directory_must_be_given(tmp_path):
    stored = StoredResults(write_results(tmp_path, rows=ROW + ROW.replace("mwp", "theirs")), "shot")
    with refused("method theirs", "maps", "directory"):
        stored.chosen_methods(None, ["mwp"])
    assert stored.chosen_methods(None, ["mwp", "theirs"]) == ["mwp", "theirs"]
    assert stored.chosen_methods(["mwp"], ["mwp"]) == ["mwp"]
    assert stored.chosen_methods([str(tmp_path / "theirs")], ["mwp"]) == [str(tmp_path / "theirs")]
    with refused("zoomout", "no results", "mwp, theirs"):
        stored.chosen_methods(["zoomout"], ["mwp"])


def test_options_without_effect_are_refused(scape, tmp_path, capsys):  # noqa: F811
    path = write_results(tmp_path, rows=ROW)
    assert run_command(["benchmark", str(scape), "--verify", str(path), "--pairs", "3"]) == 2
    assert "--pairs has no effect: leave it out" in capsys.readouterr().err


def test_an_unfinished_line_is_named_and_kept(tmp_path):
    path = write_results(tmp_path, rows=ROW + "a,c,mwp")
    before = path.read_bytes()
    with pytest.warns(UserWarning, match=r"results\.csv: ends in an unfinished line, which is ignored"):
        assert len(StoredResults(path, "shot").rows) == 1
    assert path.read_bytes() == before
    Journal(path, ["source", "target", "method"])
    assert path.read_bytes() == before.removesuffix(b"a,c,mwp")
