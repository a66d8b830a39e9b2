"""The tables of docs/comparison.md agree with the published errors and with our results."""

import csv
from pathlib import Path

import pytest
import write_comparison

ROOT = Path(__file__).parents[1]


def test_the_page_contains_the_present_tables():
    text = (ROOT / "docs" / "comparison.md").read_text("utf-8")
    assert write_comparison.written(text) == text, "run scripts/write_comparison.py"


def test_changed_errors_change_the_page(monkeypatch, tmp_path):
    text = (ROOT / "docs" / "comparison.md").read_text("utf-8")
    rows = write_comparison.rows_of

    def changed(path):
        return [row | {"error": "99", "mean": "0.1234"} for row in rows(path)]

    monkeypatch.setattr(write_comparison, "rows_of", changed)
    written = write_comparison.written(text)
    assert "| MWP | no | 99 | 99 | 99 | 99 | 99 (doubtful) |" in written
    assert "| `accurate` | 123.4 |" in written


def test_a_page_without_marks_is_refused():
    with pytest.raises(SystemExit, match="has no comments <!-- published errors -->"):
        write_comparison.written("no tables")


def test_every_published_error_has_a_source():
    with (ROOT / "docs" / "published_errors.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len({(row["method"], row["data"]) for row in rows}) == len(rows) == 65
    assert all(row["source"] and float(row["error"]) > 0 for row in rows)
